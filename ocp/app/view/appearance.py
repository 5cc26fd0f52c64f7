"""What a robot looks like: the visual shapes of its links, where there are none the shapes that it touches with.

Meshes that are not found are told, and what the link touches with is shown instead; faintly where the description gives
other links a look and this one none. Links that have neither are rods from joint to joint. Nothing is ever made up from
masses and inertias.

What colours mean, in every picture: told apart with every kind of colour vision (Okabe, Ito 2008).

Where the links of a robot are along a motion, for pictures and for the view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import CollisionShape, Machine, ModelError, Robot, link_frames
from models.arrays import Array
from models.shapes.mesh_files import Triangles, find_mesh, join_meshes, read_painted_mesh, without_colors
from ocp.problem.values import Sampler

__all__ = [
    "COMPARED",
    "FAULT",
    "LIMIT",
    "PLAN",
    "SCENE",
    "SURFACE_STYLE",
    "TIP",
    "TIP_FRAME",
    "Appearance",
    "Frames",
    "Part",
    "SurfaceStyle",
    "appearance_of",
    "chain",
    "frames_along",
    "frames_function",
    "part_of",
    "rod",
]


@dataclass(frozen=True)
class SurfaceStyle:
    """How surfaces look, and how fine they are.

    Attributes:
        grey, rod: Colours of links without one, and of links without a shape: red, green, blue, opacity.
        zone: Of what a link touches with that a description shows nothing of, while it shows others: a zone, no body.
        most_faces: Of a robot.
        finest: First size of the cells in which corners become one, m; doubled until the faces are few enough.
        crease: Faces that meet in a sharper edge are not shaded as one surface, rad.
        most_around: Faces at a corner, beyond which each is shaded by itself.
        sides: Of what is round.
        rod_radius: Of the greatest reach of the robot's joints.
        patch: Half the side of the piece of a plane that is drawn, of the diagonal of what moves before it.
    """

    grey: tuple[float, ...] = (0.72, 0.74, 0.78, 1.0)
    rod: tuple[float, ...] = (0.35, 0.38, 0.42, 1.0)
    zone: tuple[float, ...] = (0.55, 0.58, 0.62, 0.22)
    most_faces: int = 200_000
    finest: float = 2.5e-4
    crease: float = np.deg2rad(38.0)
    most_around: int = 48
    sides: int = 32
    rod_radius: float = 0.012
    patch: float = 0.8


SURFACE_STYLE = SurfaceStyle()


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of surface of one colour.

    Attributes:
        link: Name of the link that carries it.
        vertices, normals: In the frame of the link. Shape (n, 3) each, m.
        faces: Corners of its triangles. Shape (m, 3).
        color: Red, green, blue and opacity, 0 to 1.
    """

    link: str
    vertices: Array
    normals: Array
    faces: NDArray[np.intp]
    color: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Appearance:
    """What is shown of a robot.

    Attributes:
        parts: Surfaces.
        missing: Meshes that are not shown, as the description names them, and why.
    """

    parts: tuple[Part, ...]
    missing: dict[str, str]


def appearance_of(
    robot: Robot, folders: Sequence[Any] = (), *, meshes: bool = True, most: int = SURFACE_STYLE.most_faces
) -> Appearance:
    """The surfaces of a robot's links.

    Args:
        robot: The robot, however it was changed: shapes move with the links that they were merged into.
        folders: Where meshes are looked for first, see `models.shapes.mesh_files.find_mesh`.
        meshes: Whether files are read at all.
        most: Faces in all, beyond which corners that are near to each other become one.
    """
    missing: dict[str, str] = {}
    dressed = any(link.visuals for link in robot.links)
    found: list[tuple[str, Triangles]] = []
    for link in robot.links:
        shown = _shown(link.visuals, folders, meshes, missing)
        if not shown:  # what a description that shows others leaves out is a zone rather than a body
            zone = dressed and not link.visuals
            shown = _shown(
                link.collisions, folders, meshes, missing, SURFACE_STYLE.zone if zone else SURFACE_STYLE.grey
            )
        found += [(link.name, triangles) for triangles in shown]
    seen = {name for name, _ in found}
    found += [(name, rod) for name, rod in _rods(robot, seen)]
    return Appearance(tuple(_parts(_few(found, most))), missing)


def _shown(
    shapes: Sequence[CollisionShape],
    folders: Sequence[Any],
    meshes: bool,
    missing: dict[str, str],
    plain: tuple[float, ...] = SURFACE_STYLE.grey,
) -> list[Triangles]:
    """The shapes of a link as triangles, in its frame."""
    found = []
    for shape in shapes:
        if shape.kind == "mesh" and not meshes:
            continue
        try:
            vertices, faces, colors = _triangles(shape, folders)
        except (ModelError, OSError) as error:
            missing[shape.file] = str(error)
            continue
        own = getattr(shape, "color", None)
        colors = np.where(np.isnan(colors), plain if own is None else own, colors)
        place: Array = vertices @ np.asarray(shape.rotation).T + np.asarray(shape.translation)
        found.append(Triangles(place, faces, colors))
    return found


def _triangles(shape: CollisionShape, folders: Sequence[Any]) -> Triangles:
    """In the axes of the shape; raises ModelError where its mesh is not found or not read."""
    size = np.asarray(shape.size, dtype=float)
    if shape.kind == "mesh":
        path = find_mesh(shape.file, shape.folder or None, folders)
        if path is None:
            words = f"the mesh {shape.file!r} is not found; say in which folder its package lies"
            raise ModelError(words, name=shape.file, value=shape.folder)
        vertices, faces, colors = read_painted_mesh(path)
        mirrored = np.prod(size) < 0
        return Triangles(vertices * size, faces[:, ::-1] if mirrored else faces, colors)
    if shape.kind == "box":
        signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return without_colors(signs * size, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))
    if shape.kind == "cylinder":
        half = size[1] / 2
        return _turned(np.array([[0.0, -half], [size[0], -half], [size[0], half], [0.0, half]]))
    half = size[1] / 2 if shape.kind == "capsule" else 0.0
    angles = np.linspace(-np.pi / 2, 0, SURFACE_STYLE.sides // 4 + 1)
    cap = np.column_stack([np.cos(angles), np.sin(angles)]) * size[0]
    upper = cap[::-1] * [1, -1] + [0, half]
    return _turned(np.concatenate([cap - [0, half], upper if half else upper[1:]]))


def _turned(profile: Array) -> Triangles:
    """What a line of (radius, z), (k, 2), from the axis to the axis, sweeps as it turns about z."""
    sides = SURFACE_STYLE.sides
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radii, heights = profile[:, 0], profile[:, 1]
    points = np.concatenate([radii[:, None, None] * ring, np.tile(heights[:, None, None], (1, sides, 1))], axis=2)
    k, i = (part.ravel() for part in np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij"))
    a, b = k * sides + i, k * sides + (i + 1) % sides
    quads = np.stack([a, b, b + sides, a + sides], axis=1)
    return without_colors(points.reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))


def rod(start: Array, end: Array, radius: float) -> Triangles:
    """A round bar from a point to another."""
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / length
    other = np.eye(3)[int(np.abs(axis).argmin())]
    first = np.cross(axis, other)
    first /= np.linalg.norm(first)
    turn = np.column_stack([first, np.cross(axis, first), axis])
    half = length / 2
    profile = np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    vertices, faces, _ = _turned(profile)
    return Triangles(vertices @ turn.T + (start + end) / 2, faces, np.tile(SURFACE_STYLE.rod, (len(faces), 1)))


def _rods(robot: Robot, seen: set[str]) -> list[tuple[str, Triangles]]:
    """Of links that move and have nothing to show, from where they are joined to where others are; to the tip."""
    ends = [(joint.parent, np.asarray(joint.translation, dtype=float)) for joint in robot.joints]
    if robot.tip is not None:
        ends.append((robot.tip, np.asarray(robot.tip_translation, dtype=float)))
    radius = SURFACE_STYLE.rod_radius * max((float(np.linalg.norm(end)) for _, end in ends), default=0.0)
    tool = robot.tip if robot.tip is not None and np.any(robot.tip_translation) else None
    moved = {joint.child for joint in robot.joints if joint.moves}
    bare_links = {link.name for link in robot.links if link.name not in seen and (link.name in moved or not seen)}
    found = []
    for k, (link, end) in enumerate(ends):
        to_tip = link == tool and k == len(ends) - 1
        if (link in bare_links or to_tip) and np.linalg.norm(end) > radius:
            found.append((link, rod(np.zeros(3), end, radius)))
    return found


def _few(found: list[tuple[str, Triangles]], most: int) -> list[tuple[str, Triangles]]:
    """The same, of at most so many faces in all."""
    size = SURFACE_STYLE.finest
    coarse = found
    while sum(len(one.faces) for _, one in coarse) > most and size < 1.0:
        coarse = [(link, _coarser(one, size)) for link, one in found]
        size *= 2
    return coarse


def _coarser(mesh: Triangles, size: float) -> Triangles:
    """The same with all corners in a cell of a grid made one, in their middle, without faces of no area."""
    cells = np.floor(mesh.vertices / size).astype(np.int64)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    middles = np.stack([np.bincount(cell, column) for column in mesh.vertices.T], axis=1) / counts[:, None]
    faces = cell[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    _, first = np.unique(np.sort(faces[whole], axis=1), axis=0, return_index=True)
    kept = np.flatnonzero(whole)[np.sort(first)]
    return Triangles(middles, faces[kept], mesh.colors[kept])


def _parts(found: list[tuple[str, Triangles]]) -> list[Part]:
    """By link and colour."""
    parts = []
    for link in dict.fromkeys(name for name, _ in found):
        mesh = join_meshes([one for name, one in found if name == link])
        colors, which = np.unique(np.round(mesh.colors, 3), axis=0, return_inverse=True)
        for k, color in enumerate(colors):
            own = mesh.faces[which.ravel() == k]
            if len(own):
                parts.append(part_of(link, mesh.vertices, own, color))
    return parts


def part_of(link: str, vertices: Array, faces: NDArray[np.intp], color: Any) -> Part:
    """A part with normals: those of the faces around a corner that are no sharp edge away, by their area."""
    places, where = np.unique(np.round(vertices, 6) + 0.0, axis=0, return_inverse=True)
    faces = where.ravel()[faces]
    one, two, three = (places[faces[:, k]] for k in range(3))
    areas = np.cross(two - one, three - one)
    length = np.linalg.norm(areas, axis=1)
    faces, areas, length = faces[length > 0], areas[length > 0], length[length > 0]
    units = areas / length[:, None]
    corners = faces.ravel()
    order = np.argsort(corners, kind="stable")
    counts = np.bincount(corners, minlength=len(places))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    around = counts[corners]
    few = np.flatnonzero(around <= SURFACE_STYLE.most_around)
    mine = np.repeat(few, around[few])  # corners, and beside each those at the same place
    step = np.arange(len(mine)) - np.repeat(np.cumsum(around[few]) - around[few], around[few])
    theirs = order[starts[corners[mine]] + step] // 3
    smooth = (units[mine // 3] * units[theirs]).sum(axis=1) > np.cos(SURFACE_STYLE.crease)
    mine, theirs = mine[smooth], theirs[smooth]
    sums = np.stack([np.bincount(mine, areas[theirs, k], len(corners)) for k in range(3)], axis=1)
    alone = around > SURFACE_STYLE.most_around
    sums[alone] = units[np.flatnonzero(alone) // 3]
    normals = sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-300)[:, None]
    fine = np.round(normals * 100).astype(np.int64)
    _, first, which = np.unique(np.column_stack([corners, fine]), axis=0, return_index=True, return_inverse=True)
    color = tuple(float(value) for value in color)
    assert len(color) == 4
    return Part(link, places[corners[first]], normals[first], which.reshape(-1, 3).astype(np.intp), color)


PLAN = "#0072B2"
"""Of the plan, or of the motion that is looked at."""
COMPARED = "#D55E00"
"""Of what it is compared with: the pseudo-inverse, a paper's method, another plan."""
LIMIT = "#6E6E6E"
"""Of what it must not pass; dashed."""
FAULT = "#CC79A7"
"""Of where it does."""
TIP = "#009E73"
"""Of the tip's way."""
SCENE = "#6E6E6E"
"""Of what stands around."""


TIP_FRAME = "the tip frame"
"""Key of the tip among the frames; no link can have it that is also a link of the arm drawn."""


@dataclass(frozen=True)
class Frames:
    """Frames in the world along a motion, by link name and TIP_FRAME.

    Attributes:
        rotations: Axes as columns. Shape (M, 3, 3) each.
        positions: Origins. Shape (M, 3) each, m.
    """

    rotations: dict[str, Array]
    positions: dict[str, Array]

    @property
    def tip(self) -> Array:
        """Origin of the tip frame. Shape (M, 3), m."""
        return self.positions[TIP_FRAME]


def frames_function(machine: Machine) -> Callable[[Any, Any], Frames]:
    """A function of (joints, base), as of frames_along, that is made once and called often."""
    robot = machine.robot
    q, b = ca.SX.sym("q", robot.dof), ca.SX.sym("b", machine.base_size)
    found = link_frames(robot, q, machine.world_from_base(b))
    names = [*found]
    entries = [ca.vertcat(ca.vec(frame.rotation), frame.position) for frame in found.values()]
    if robot.tip is not None:
        tip = machine.tip_pose(b, q)
        entries.append(ca.vertcat(ca.vec(tip.rotation), tip.position))
        names.append(TIP_FRAME)
    sampler = Sampler([b, q], [ca.densify(ca.SX(ca.vertcat(*entries)))])

    def frames(joints: Any, base: Any) -> Frames:
        angles = np.atleast_2d(np.asarray(joints, dtype=float))
        count = len(angles)
        place = np.zeros((count, 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
        if angles.shape[1] != robot.dof or place.shape != (count, machine.base_size):
            raise ModelError(
                f"joints and base of the shapes {angles.shape}, {place.shape} do not fit {robot.dof} joints "
                f"{list(robot.joint_names)} and a base of {machine.base_size} entries"
            )
        values = sampler(place, angles)[0].reshape(count, len(names), 12)
        rotations = {name: values[:, i, :9].reshape(-1, 3, 3).transpose(0, 2, 1) for i, name in enumerate(names)}
        return Frames(rotations, {name: values[:, i, 9:] for i, name in enumerate(names)})

    return frames


def frames_along(machine: Machine, joints: Any, base: Any = None) -> Frames:
    """Frames of all links, and of the tip where the robot has one.

    Args:
        machine: The robot on its base.
        joints: In the order of robot.joint_names. Shape (M, dof).
        base: Shape (M, base_size); None for a fixed base.

    Raises:
        ModelError: Wrong sizes.
    """
    return frames_function(machine)(joints, base)


def chain(robot: Robot) -> list[str]:
    """Links from the root to the tip, and TIP_FRAME: the arm as a line of points."""
    return [robot.root, *(joint.child for joint in robot.path_to(robot.tip_link)), TIP_FRAME]
