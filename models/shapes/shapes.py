"""Shapes of bodies and obstacles: spheres, capsules, cylinders, boxes, half-spaces, meshes.

Each is the convex hull of a few points, its core, swelled by a distance: what `distance` works with. A shape is given
in some frame: an obstacle in world, the body of a link in the frame of the link.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import cos, pi
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_broadcast,
    checked_indices,
    checked_nonnegative,
    checked_number,
    checked_rotation,
    frozen,
)
from models.errors import ModelError
from models.shapes.hull import Hull, convex_hull

SIDES = 16
"""Of the prism around a cylinder."""
CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""Of the cube of half-edge 1. Shape (8, 3)."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """All points within a radius of a point.

    Attributes:
        radius: m.
        position: Its centre. Shape (3,), m.

    Raises:
        ModelError: A radius that is not positive, a position that is missing or not finite.
    """

    radius: float
    position: ArrayInput = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", checked_number(self.radius, "sphere", "radius", positive=True, unit="m"))
        object.__setattr__(self, "position", _place(self.position, "sphere"))

    @property
    def core(self) -> Array:
        """Shape (1, 3), m."""
        return np.array([self.position])

    @property
    def swelling(self) -> float:
        """How far the shape goes beyond its core, m."""
        return self.radius

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Sphere:
        """The same sphere where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        return Sphere(self.radius, turn @ self.position + shift)

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of its points from a point. Shape (3,), m."""
        return _reach(self, point)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment; a sphere where its ends are one.

    Attributes:
        radius: m; 0 for a bare segment.
        start, end: Ends of the segment. Shape (3,), m.

    Raises:
        ModelError: A radius that is negative, an end that is not finite, a bare point (no radius, no length).
    """

    radius: float
    start: ArrayInput
    end: ArrayInput

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", checked_nonnegative(self.radius, "capsule", "radius", "m"))
        for what in ("start", "end"):
            object.__setattr__(self, what, checked_array(getattr(self, what), (3,), "capsule", what))
        if self.radius == 0 and (self.start == self.end).all():
            raise ModelError("capsule: no radius and no length", name="radius", value=0.0, limit=0.0)

    @property
    def core(self) -> Array:
        """Its ends. Shape (2, 3), m."""
        return np.array([self.start, self.end])

    @property
    def swelling(self) -> float:
        """How far the shape goes beyond its core, m."""
        return self.radius

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Capsule:
        """The same capsule where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        return Capsule(self.radius, turn @ self.start + shift, turn @ self.end + shift)

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of its points from a point. Shape (3,), m."""
        return _reach(self, point)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A solid cylinder about the z axis of its own.

    It counts as the regular prism of SIDES sides around it, whose edges stand out of it by 1/cos(pi / SIDES) - 1,
    2 % of the radius; its ends and the middles of the prism's sides are its own.

    Attributes:
        radius: m.
        length: Along z, m.
        position: Its centre. Shape (3,), m.
        rotation: Its axes as columns. Shape (3, 3).

    Raises:
        ModelError: A radius or length that is not positive, a position that is missing, a rotation that is none.
    """

    radius: float
    length: float
    position: ArrayInput = None
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        for what in ("radius", "length"):
            size = checked_number(getattr(self, what), "cylinder", what, positive=True, unit="m")
            object.__setattr__(self, what, size)
        object.__setattr__(self, "position", _place(self.position, "cylinder"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, "cylinder", "rotation"))

    @property
    def core(self) -> Array:
        """Corners of the prism. Shape (2 SIDES, 3), m."""
        return np.asarray(self.position + self.hull.vertices @ self.rotation.T)

    @cached_property
    def hull(self) -> Hull:
        """The prism in the cylinder's own axes."""
        angles = 2 * pi / SIDES * (np.arange(SIDES) + 0.5)
        around = self.radius / cos(pi / SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])
        half = np.full((SIDES, 1), self.length / 2)
        return convex_hull(np.vstack([np.hstack([around, -half]), np.hstack([around, half])]))

    @property
    def swelling(self) -> float:
        """How far the shape goes beyond its core: nowhere."""
        return 0.0

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Cylinder:
        """The same cylinder where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        return replace(self, position=turn @ self.position + shift, rotation=turn @ self.rotation)

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of the prism's points from a point. Shape (3,), m."""
        return _reach(self, point)


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box.

    Attributes:
        size: Full length of its edges. Shape (3,), m; inf for a box without ends along an axis, as the walls of a wind
            tunnel are: such a one has no core and no distance but to the rig.
        position: Its centre. Shape (3,), m; the origin unless it is said.
        rotation: Its axes as columns. Shape (3, 3).

    Raises:
        ModelError: An edge that is not positive, no finite edge, a position that is none, a rotation that is none.
    """

    size: ArrayInput
    position: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        size = checked_array(self.size, (3,), "box", "size", finite=False, positive=True, unit="m")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "position", _place(self.position, "box"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, "box", "rotation"))
        if np.isinf(size).all():
            raise ModelError("box: every edge is infinite; there is no outside", name="size", value=size)

    @property
    def core(self) -> Array:
        """Its corners, the z edge from one to the next, then y, then x. Shape (8, 3), m.

        Raises:
            ModelError: An edge that is infinite.
        """
        size = checked_array(self.size, (3,), "box", "size", unit="m")
        return np.asarray(self.position + (CORNERS * size / 2) @ self.rotation.T)

    @property
    def swelling(self) -> float:
        """How far the shape goes beyond its core: nowhere."""
        return 0.0

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Box:
        """The same box where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        return replace(self, position=turn @ self.position + shift, rotation=turn @ self.rotation)

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of its points from a point. Shape (3,), m; inf for a box without ends."""
        return _reach(self, point) if np.isfinite(self.size).all() else np.inf


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Everything on one side of a plane: a floor, a wall.

    Attributes:
        normal: Of the plane, out of what is solid; kept at length 1. Shape (3,).
        point: On the plane. Shape (3,), m.

    Raises:
        ModelError: A normal of no length, a point that is missing, something that is not finite.
    """

    normal: ArrayInput
    point: ArrayInput = None

    def __post_init__(self) -> None:
        normal = checked_array(self.normal, (3,), "half-space", "normal")
        length = float(np.linalg.norm(normal))
        if not 0 < length < np.inf:
            raise ModelError(f"half-space: normal {normal.tolist()} has no direction", name="normal", value=normal)
        object.__setattr__(self, "normal", frozen(np.asarray(normal / length)))
        object.__setattr__(self, "point", _place(self.point, "half-space", "point"))

    @property
    def core(self) -> Array:
        """Its point. Shape (1, 3), m."""
        return np.array([self.point])

    @property
    def swelling(self) -> float:
        """Zero: what is solid is said by the normal."""
        return 0.0

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> HalfSpace:
        """The same half-space where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        return HalfSpace(turn @ self.normal, turn @ self.point + shift)

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of its points from a point, which is inf."""
        checked_array(point, (3,), "half-space", "point")
        return np.inf


@dataclass(frozen=True, eq=False)
class Mesh:
    """A body of triangles, of which the convex hull counts: hollows and holes are filled.

    Attributes:
        vertices: Shape (n, 3); None where a file is given.
        faces: Triangles of vertices; None for all vertices. Vertices of no triangle do not count. Shape (m, 3).
        position, rotation: Of the mesh's own axes in the frame it is given in. Shapes (3,), m; (3, 3).
        file: STL, OBJ or DAE, read once: vertices and faces are its own.
        scale: m for each unit of the vertices, a number or one for each axis; negative ones mirror.
        hull: Of what counts, scaled, in the mesh's own axes, m.

    Raises:
        ModelError: Vertices and a file, or neither; a file that cannot be read; fewer than 4 vertices or all of them in
            a plane; faces of no vertices; a scale of zero; a position that is none, a rotation that is none.
    """

    vertices: ArrayInput = None
    faces: ArrayInput = None
    position: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))
    file: str | Path | None = None
    scale: ArrayInput = 1.0
    hull: Hull = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.file is not None:
            self._read()
        elif self.vertices is None:
            raise ModelError("mesh: give vertices or a file", name="vertices", value=None)
        vertices = checked_array(self.vertices, ("vertices", 3), "mesh", "vertices", least=4)
        object.__setattr__(self, "vertices", vertices)
        if self.faces is not None:
            faces = checked_indices(self.faces, len(vertices), "mesh", "faces")
            if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
                message = f"mesh: faces have shape {faces.shape}, expected (m, 3)"
                raise ModelError(message, name="faces", value=self.faces, limit=("m", 3))
            object.__setattr__(self, "faces", faces)
        scale = checked_broadcast(self.scale, 3, "mesh", "scale", "axes")
        if not scale.all():
            raise ModelError(f"mesh: scale {scale.tolist()} leaves nothing", name="scale", value=scale, limit=0.0)
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "position", _place(self.position, "mesh"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, "mesh", "rotation"))
        counted = vertices if self.faces is None else vertices[np.unique(self.faces)]
        object.__setattr__(self, "hull", convex_hull(counted * scale))

    @classmethod
    def around(cls, hull: Hull) -> Mesh:
        """The body of a hull, which is not sought again."""
        found = object.__new__(cls)
        parts = {"vertices": hull.vertices, "faces": hull.faces, "position": np.zeros(3), "rotation": np.eye(3)}
        for what, value in {**parts, "file": None, "scale": np.ones(3), "hull": hull}.items():
            object.__setattr__(found, what, value)
        return found

    def _read(self) -> None:
        if self.vertices is not None or self.faces is not None:
            raise ModelError("mesh: give vertices or a file, not both", name="file", value=self.file)
        if not isinstance(self.file, str | Path) or not str(self.file):
            raise ModelError(f"mesh: file {self.file!r} is not a path", name="file", value=self.file)
        from models.shapes.mesh_files import read_mesh

        for what, value in zip(("vertices", "faces"), read_mesh(self.file), strict=True):
            object.__setattr__(self, what, value)

    @property
    def core(self) -> Array:
        """Vertices of the hull. Shape (m, 3), m."""
        return np.asarray(self.position + self.hull.vertices @ self.rotation.T)

    @property
    def swelling(self) -> float:
        """How far the shape goes beyond its core: nowhere."""
        return 0.0

    def placed(self, rotation: ArrayInput, translation: ArrayInput) -> Mesh:
        """The same mesh where its frame has this rotation (3, 3) and position (3,), m, in another."""
        turn, shift = _motion(rotation, translation)
        found = copy(self)  # with its hull, which is not sought again
        object.__setattr__(found, "position", frozen(turn @ self.position + shift))
        object.__setattr__(found, "rotation", frozen(turn @ self.rotation))
        return found

    def reach(self, point: ArrayInput) -> float:
        """Largest distance of its points from a point. Shape (3,), m."""
        return _reach(self, point)


Shape: TypeAlias = Sphere | Capsule | Cylinder | Box | HalfSpace | Mesh

KINDS = (Sphere, Capsule, Cylinder, Box, HalfSpace, Mesh)


def checked_shape(value: Any, owner: str, what: str) -> Shape:
    """`value` itself; ModelError naming `owner` and `what` unless it is a shape."""
    if not isinstance(value, KINDS):
        names = ", ".join(kind.__name__ for kind in KINDS)
        message = f"{owner}: {what} must be a shape ({names}), not {value!r}"
        raise ModelError(message, name=what, value=value, limit=names)
    return value


def _place(value: ArrayInput, owner: str, what: str = "position") -> Array:
    if value is None:
        raise ModelError(f"{owner}: {what} is missing; say where it is", name=what, value=None)
    return checked_array(value, (3,), owner, what)


def _motion(rotation: ArrayInput, translation: ArrayInput) -> tuple[Array, Array]:
    turn = checked_rotation(rotation, "shape", "rotation")
    return turn, checked_array(translation, (3,), "shape", "translation")


def _reach(shape: Sphere | Capsule | Cylinder | Box | Mesh, point: ArrayInput) -> float:
    centre = checked_array(point, (3,), "shape", "point")
    return float(np.linalg.norm(shape.core - centre, axis=1).max()) + shape.swelling
