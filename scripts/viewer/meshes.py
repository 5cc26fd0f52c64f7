"""The visual shapes of a URDF's links as triangle meshes, as far as their files are found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from models.arrays import Array
from models.shapes.mesh_files import find_mesh

GREY = (0.72, 0.74, 0.78, 1.0)


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh in the frame of its link.

    Attributes:
        mesh: A trimesh.Trimesh, moved and scaled into the link's frame.
        color: RGBA 0..1, of the URDF; None where the mesh brings its own.
    """

    mesh: Any
    color: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class Shapes:
    """What was found.

    Attributes:
        by_link: Shapes by link name; links without any are left out.
        missing: Mesh files that were not found or not read, as the URDF names them, and why.
    """

    by_link: dict[str, list[Shape]]
    missing: dict[str, str]


def read_shapes(urdf: Path, folders: Sequence[Path] = ()) -> Shapes:
    """Visual shapes of all links: meshes whose files are found, boxes, cylinders and spheres.

    Args:
        urdf: The file.
        folders: Where to look for packages and meshes, see models.shapes.mesh_files.find_mesh.

    Returns:
        The shapes; nothing but a reason for a file that yourdfpy cannot read.
    """
    import yourdfpy

    try:
        description = yourdfpy.URDF.load(str(urdf), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # of lxml, of missing attributes: whatever it is, the lines will do
        return Shapes({}, {str(urdf): f"{type(error).__name__}: {error}"})
    colors = {each.name: each.color for each in description.robot.materials if each.color is not None}
    found: dict[str, list[Shape]] = {}
    missing: dict[str, str] = {}
    for link in description.robot.links:
        for visual in link.visuals:
            name = visual.geometry.mesh.filename if visual.geometry and visual.geometry.mesh else "shape"
            try:
                meshes = _meshes(visual.geometry, urdf, folders)
            except Exception as error:  # broken files, formats without a reader
                missing[name] = f"{type(error).__name__}: {error}"
                continue
            material = visual.material
            color = None if material is None else material.color or colors.get(material.name)
            origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin, dtype=float)
            for mesh in meshes:
                mesh.apply_transform(origin)
                found.setdefault(link.name, []).append(Shape(mesh, _rgba(color, mesh)))
    return Shapes(found, missing)


def _meshes(geometry: Any, urdf: Path, folders: Sequence[Path]) -> list[Any]:
    import trimesh

    if geometry is None:
        return []
    if geometry.box is not None:
        return [trimesh.creation.box(extents=np.asarray(geometry.box.size, dtype=float))]
    if geometry.cylinder is not None:
        cylinder = geometry.cylinder
        return [trimesh.creation.cylinder(radius=float(cylinder.radius), height=float(cylinder.length))]
    if geometry.sphere is not None:
        return [trimesh.creation.icosphere(subdivisions=3, radius=float(geometry.sphere.radius))]
    if geometry.mesh is None:
        return []
    path = find_mesh(geometry.mesh.filename, urdf.resolve().parent, folders)
    if path is None:
        raise FileNotFoundError("not found; say where with --mesh-dir")
    scene = trimesh.load_scene(path)
    scale = np.ones(3) if geometry.mesh.scale is None else np.broadcast_to(geometry.mesh.scale, 3).astype(float)
    parts = []
    for part in scene.dump():
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            part.apply_transform(np.diag([*scale, 1.0]))
            parts.append(part)
    if not parts:
        raise ValueError("no triangles")
    return parts


def _rgba(color: Any, mesh: Any) -> tuple[float, float, float, float] | None:
    if color is not None:
        values: Array = np.clip(np.asarray(color.rgba, dtype=float).ravel(), 0, 1)
        if values.shape == (4,):
            return tuple(values.tolist())
    return None if mesh.visual.defined else GREY
