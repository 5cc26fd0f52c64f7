"""Surfaces of robots and obstacles, their frames along a motion, and the colours of all pictures.

A link is shown by its visual shapes, or without them by its collision shapes; these are transparent if the description
gives other links visual shapes and this one none. A mesh that is not found is reported and replaced by the collision
shapes. A link with neither is a rod from joint to joint. Nothing is derived from masses and inertias. The colours are
distinguishable with every kind of colour vision (Okabe, Ito 2008).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import CollisionShape, HalfSpace, Machine, ModelError, MovingObstacle, Robot, link_frames
from models.checks import Array
from models.shapes.hull import convex_hull
from models.shapes.mesh_files import Triangles, distinct_rows, find_mesh, join_meshes, read_painted_mesh, without_colors
from models.shapes.shapes import Shape
from ocp.audit.clearance import separation_frames
from ocp.motion.plan import Plan
from ocp.motion.result.path_plan import PathPlan
from ocp.problem.hulls import Separation
from ocp.problem.problem import Problem
from ocp.problem.values import Sampler
from ocp.solution import Solution


@dataclass(frozen=True)
class SurfaceStyle:
    """Colours and resolution of the displayed surfaces.

    Attributes:
        grey, rod: Colours of links without a colour, and of links without a shape: red, green, blue, opacity.
        zone: Colour of collision shapes of a link without visual shapes in a description that has some.
        max_faces: Largest number of faces of a robot.
        min_cell: Initial size of the cells in which corners are merged, m; doubled until there are few enough faces.
        crease: Faces that meet at a larger angle are shaded separately, rad.
        max_neighbours: Largest number of faces at a corner that are shaded as one surface.
        sides, rod_radius: Sides of round shapes; radius of rods, relative to the longest distance between joints.
        patch: Half the side of the drawn part of a plane, relative to the diagonal of what moves in front of it.
    """

    grey: tuple[float, ...] = (0.72, 0.74, 0.78, 1.0)
    rod: tuple[float, ...] = (0.35, 0.38, 0.42, 1.0)
    zone: tuple[float, ...] = (0.55, 0.58, 0.62, 0.22)
    max_faces: int = 200_000
    min_cell: float = 2.5e-4
    crease: float = np.deg2rad(38.0)
    max_neighbours: int = 48
    sides: int = 32
    rod_radius: float = 0.012
    patch: float = 0.8


SURFACE_STYLE = SurfaceStyle()
Solid = tuple[Array, NDArray[np.intp]]
"""Surface of a solid: corners (k, 3), m, and triangles as indices of corners (f, 3)."""


@dataclass(frozen=True, eq=False)
class Part:
    """A surface of triangles that has one colour (red, green, blue and opacity, 0 to 1) and is carried by a link.

    Vertices (n, 3), m, and unit normals (n, 3) are in the frame of the link, faces (f, 3) are indices of vertices.
    """

    link: str
    vertices: Array
    normals: Array
    faces: NDArray[np.intp]
    color: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Appearance:
    """Surfaces with which a robot is displayed, and the reasons why meshes, keyed by file name, are not shown."""

    parts: tuple[Part, ...]
    missing: dict[str, str]


def appearance_of(
    robot: Robot, folders: Sequence[Any] = (), *, meshes: bool = True, most: int = SURFACE_STYLE.max_faces
) -> Appearance:
    """Return the surfaces with which the links of a robot are displayed, even if the robot was modified after reading.

    Mesh files are read if `meshes` is true and are first searched in `folders`. If there are more than `most` faces,
    nearby corners are merged.
    """
    missing: dict[str, str] = {}
    has_visuals = any(link.visuals for link in robot.links)
    surfaces: list[tuple[str, Triangles]] = []
    for link in robot.links:
        triangles_of_link = _triangulate(link.visuals, folders, meshes, missing)
        if not triangles_of_link:  # if other links have visual shapes, this is a keep-out zone
            color = SURFACE_STYLE.zone if has_visuals and not link.visuals else SURFACE_STYLE.grey
            triangles_of_link = _triangulate(link.collisions, folders, meshes, missing, color)
        surfaces += [(link.name, triangles) for triangles in triangles_of_link]
    surfaces += _rods(robot, {name for name, _ in surfaces})
    return Appearance(tuple(_parts(_limit_faces(surfaces, most))), missing)


def _triangulate(
    shapes: Sequence[CollisionShape],
    folders: Sequence[Any],
    meshes: bool,
    missing: dict[str, str],
    default: tuple[float, ...] = SURFACE_STYLE.grey,
) -> list[Triangles]:
    """Convert the shapes of a link to coloured triangles in the link's frame; record missing meshes in `missing`."""
    triangles = []
    for shape in shapes:
        if shape.kind == "mesh" and not meshes:
            continue
        try:
            vertices, faces, colors = _triangles(shape, folders)
        except (ModelError, OSError) as error:
            missing[shape.file] = str(error)
            continue
        color = getattr(shape, "color", None)
        colors = np.where(np.isnan(colors), default if color is None else color, colors)
        vertices_in_link: Array = vertices @ np.asarray(shape.rotation).T + np.asarray(shape.translation)
        triangles.append(Triangles(vertices_in_link, faces, colors))
    return triangles


def _triangles(shape: CollisionShape, folders: Sequence[Any]) -> Triangles:
    """Convert a shape to triangles in its own frame; raise ModelError if its mesh is not found or invalid."""
    size = np.asarray(shape.size, dtype=float)
    if shape.kind == "mesh":
        path = find_mesh(shape.file, shape.folder or None, folders)
        if path is None:
            words = f"the mesh {shape.file!r} is not found; give the folder of its package"
            raise ModelError(words, name=shape.file, value=shape.folder)
        vertices, faces, colors = read_painted_mesh(path)
        mirrored = np.prod(size) < 0
        return Triangles(vertices * size, faces[:, ::-1] if mirrored else faces, colors)
    if shape.kind == "box":
        surface = inflated_hull(size / 2 * list(product((-1.0, 1.0), repeat=3)))
    else:
        ends = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]) * (0.0 if shape.kind == "sphere" else size[1])
        surface = rod(ends[0], ends[1], size[0])[:2] if shape.kind == "cylinder" else inflated_hull(ends, size[0])
    return without_colors(*surface)


def inflated_hull(points: Array, radius: float = 0.0) -> Solid:
    """Return the surface of the convex hull of points (k, 3), inflated by a radius."""
    sides = SURFACE_STYLE.sides
    u, v = np.meshgrid(np.arange(sides) * (2 * np.pi / sides), np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1))
    unit = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    hull = convex_hull((points[:, None] + radius * unit).reshape(-1, 3) if radius > 0 else points)
    return np.asarray(hull.vertices), hull.faces


def rod(start: Array, end: Array, radius: float) -> Triangles:
    """Return the surface of a round rod between two points."""
    axis = (end - start) / np.linalg.norm(end - start)
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    first /= np.linalg.norm(first)
    angle = np.arange(SURFACE_STYLE.sides)[:, None] * (2 * np.pi / SURFACE_STYLE.sides)
    ring = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
    vertices, faces = inflated_hull(np.concatenate([start + ring, end + ring]))
    return Triangles(vertices, faces, np.tile(SURFACE_STYLE.rod, (len(faces), 1)))


def _rods(robot: Robot, shown: set[str]) -> list[tuple[str, Triangles]]:
    """Return rods from joint to joint and to the tip, for links without a surface of their own."""
    ends = [(joint.parent, np.asarray(joint.translation, dtype=float)) for joint in robot.joints]
    if robot.tip is not None:
        ends.append((robot.tip, np.asarray(robot.tip_translation, dtype=float)))
    radius = SURFACE_STYLE.rod_radius * max((float(np.linalg.norm(end)) for _, end in ends), default=0.0)
    tool = robot.tip if robot.tip is not None and np.any(robot.tip_translation) else None
    moving = {joint.child for joint in robot.joints if joint.moves}
    bare_links = {link.name for link in robot.links if link.name not in shown and (link.name in moving or not shown)}
    rods = []
    for k, (link, end) in enumerate(ends):
        to_tip = link == tool and k == len(ends) - 1
        if (link in bare_links or to_tip) and np.linalg.norm(end) > radius:
            rods.append((link, rod(np.zeros(3), end, radius)))
    return rods


def _limit_faces(surfaces: list[tuple[str, Triangles]], most: int) -> list[tuple[str, Triangles]]:
    """Merge nearby vertices of surfaces until the surfaces have at most `most` faces in total."""
    size = SURFACE_STYLE.min_cell
    coarse = surfaces
    while sum(len(mesh.faces) for _, mesh in coarse) > most and size < 1.0:
        coarse = [(link, _merge_corners(mesh, size)) for link, mesh in surfaces]
        size *= 2
    return coarse


def _merge_corners(mesh: Triangles, size: float) -> Triangles:
    """Merge the vertices of a mesh that lie in one grid cell into their mean, and remove degenerate faces."""
    _, cell = distinct_rows(np.floor(mesh.vertices / size).astype(np.int64))
    counts = np.bincount(cell)
    middles = np.stack([np.bincount(cell, column) for column in mesh.vertices.T], axis=1) / counts[:, None]
    faces = cell[mesh.faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    first, _ = distinct_rows(np.sort(faces[proper], axis=1))
    distinct = np.flatnonzero(proper)[np.sort(first)]
    return Triangles(middles, faces[distinct], mesh.colors[distinct])


def _parts(surfaces: list[tuple[str, Triangles]]) -> list[Part]:
    """Group surfaces by link and colour, and return one `Part` for each group."""
    parts = []
    for link in dict.fromkeys(name for name, _ in surfaces):
        mesh = join_meshes([triangles for name, triangles in surfaces if name == link])
        colors = np.round(mesh.colors, 3)
        first, color_index = distinct_rows(colors)
        for k, color in enumerate(colors[first]):
            parts.append(part_of(link, mesh.vertices, mesh.faces[color_index == k], color))
    return parts


def part_of(link: str, vertices: Array, faces: NDArray[np.intp], color: Any) -> Part:
    """Return a surface as a Part, with vertex normals that are averaged over adjacent faces except across creases."""
    places = np.round(vertices, 6) + 0.0
    first, where = distinct_rows(places)
    places, faces = places[first], where[faces]
    a, b, c = (places[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    length = np.linalg.norm(areas, axis=1)
    faces, areas, length = faces[length > 0], areas[length > 0], length[length > 0]
    units = areas / length[:, None]
    corners = faces.ravel()
    order = np.argsort(corners, kind="stable")
    counts = np.bincount(corners, minlength=len(places))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    around = counts[corners]
    few = np.flatnonzero(around <= SURFACE_STYLE.max_neighbours)
    mine = np.repeat(few, around[few])  # pairs of face corners at the same point
    step = np.arange(len(mine)) - np.repeat(np.cumsum(around[few]) - around[few], around[few])
    theirs = order[starts[corners[mine]] + step] // 3
    smooth = (units[mine // 3] * units[theirs]).sum(axis=1) > np.cos(SURFACE_STYLE.crease)
    mine, theirs = mine[smooth], theirs[smooth]
    sums = np.stack([np.bincount(mine, areas[theirs, k], len(corners)) for k in range(3)], axis=1)
    exclusive = around > SURFACE_STYLE.max_neighbours
    sums[exclusive] = units[np.flatnonzero(exclusive) // 3]
    normals = sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-300)[:, None]
    keys = corners.astype(np.int64)
    for column in np.round(normals.T * 100).astype(np.int64) + 100:
        keys = 201 * keys + column
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    color = tuple(float(value) for value in color)
    assert len(color) == 4
    return Part(link, places[corners[first]], normals[first], which.reshape(-1, 3).astype(np.intp), color)


PLAN = "#0072B2"
"""Colour of the plan, or of the main motion."""
COMPARED = "#D55E00"
"""Colour of motions compared with the plan: the pseudo-inverse, the method of a paper, another plan."""
LIMIT = "#6E6E6E"
"""Colour of limits, which are drawn dashed."""
FAULT = "#CC79A7"
"""Colour of violations."""
TIP = "#009E73"
"""Colour of the tip path."""
SCENE = "#6E6E6E"
"""Colour of obstacles."""
TIP_FRAME = "the tip frame"
"""Key of the tip frame in `Frames`; no drawn link can have this name."""


@dataclass(frozen=True)
class Frames:
    """World poses of links and tip in a motion, by link name or TIP_FRAME: rotations (M, 3, 3), origins (M, 3), m."""

    rotations: dict[str, Array]
    positions: dict[str, Array]

    @property
    def tip(self) -> Array:
        """Origin of the tip frame. Shape (M, 3), m."""
        return self.positions[TIP_FRAME]


def frames_along(machine: Machine, joints: Any, base: Any = None) -> Frames:
    """Return the frames of all links, and of the tip if the robot has one, in the world along a motion.

    Joint positions (M, dof) are in the order of robot.joint_names, base configurations have the shape (M, base_size).

    Raises:
        ModelError: A size is wrong.
    """
    robot = machine.robot
    angles = np.atleast_2d(np.asarray(joints, dtype=float))
    count = len(angles)
    place = np.zeros((count, 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
    if angles.shape[1] != robot.dof or place.shape != (count, machine.base_size):
        raise ModelError(
            f"joints and base of the shapes {angles.shape}, {place.shape} do not fit {robot.dof} joints "
            f"{list(robot.joint_names)} and a base of {machine.base_size} entries"
        )
    q, b = ca.SX.sym("q", robot.dof), ca.SX.sym("b", machine.base_size)
    frames = link_frames(robot, q, machine.world_from_base(b))
    if robot.tip is not None:
        frames = {**frames, TIP_FRAME: machine.tip_pose(b, q)}
    entries = [ca.vertcat(ca.vec(frame.rotation), frame.position) for frame in frames.values()]
    values = Sampler([b, q], [ca.densify(ca.SX(ca.vertcat(*entries)))])(place, angles)[0].reshape(count, -1, 12)
    rotations = {name: values[:, i, :9].reshape(-1, 3, 3).transpose(0, 2, 1) for i, name in enumerate(frames)}
    return Frames(rotations, {name: values[:, i, 9:] for i, name in enumerate(frames)})


class Obstacle(NamedTuple):
    """An obstacle for display: the convex hull of points (k, 3), m, inflated by a radius, or a half-space.

    A half-space has one point of its plane and its outward normal. `rotations` (M, 3, 3) and `positions` (M, 3), m, are
    those of the body in world at the times of a motion; None if it is static, with points in world.
    """

    core: Array
    radius: float = 0.0
    normal: Array | None = None
    rotations: Array | None = None
    positions: Array | None = None

    def solid(self, points: Array) -> Solid:
        """Return the surface of the obstacle in its own frame; a half-space becomes a square near points (k, 3)."""
        if self.normal is None:
            return inflated_hull(np.asarray(self.core), self.radius)
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        middle = middle - self.normal * (self.normal @ (middle - self.core[0]))
        side = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        side /= np.linalg.norm(side)
        sides = SURFACE_STYLE.patch * float(np.linalg.norm(high - low)) * np.stack([side, np.cross(self.normal, side)])
        return middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ sides, np.array([[0, 1, 2], [0, 2, 3]])


def obstacles_of_shapes(shapes: Iterable[Shape]) -> list[Obstacle]:
    """Return shapes, given in the world frame, as static obstacles for display."""
    return [
        Obstacle(np.asarray(shape.point, dtype=float)[None], 0.0, np.asarray(shape.normal, dtype=float))
        if isinstance(shape, HalfSpace)
        else Obstacle(np.asarray(shape.core), shape.swept_radius)
        for shape in shapes
    ]


def obstacles_of(parts: Sequence[tuple[Solution, str, Array]]) -> list[Obstacle]:
    """Return, for display, the obstacles that the optimal control problems of a motion declare.

    A moving obstacle is attached to a frame that depends on time but on no state. `parts` are the parts of the motion
    in sequence: a solution; the suffix of the names of its states, "" for a single part; and times in the solution, s.
    """
    static: dict[str, Obstacle] = {}
    moving: dict[str, list[tuple[Any, Array, Array]]] = {}
    for solution, suffix, times in parts:
        problem = solution.problem
        if problem is None:
            continue
        placements: list[tuple[Separation, Any]] | None = None
        for separation in problem.declared.apart.values():
            if not all(name.endswith(suffix) for name in separation.movers):
                continue
            frames_of_hulls = {hull.frame for hull in separation.hulls.values()}
            moving_frames = [frame for frame in frames_of_hulls if _moves(problem, separation, frame)]
            for name, hull in separation.hulls.items():
                if hull.frame < 0:
                    static[name] = Obstacle(hull.core, hull.radius, hull.normal if hull.normal.size else None)
                elif hull.frame in moving_frames:
                    if placements is None:
                        placements = separation_frames(problem, solution, times, suffix)
                    frames = next(frames for known, frames in placements if known is separation)
                    poses = frames.rotations[:, hull.frame], frames.positions[:, hull.frame]
                    moving.setdefault(name, []).append((hull, *poses))
    obstacles = list(static.values())
    for segments in moving.values():
        hull = segments[0][0]
        rotations, positions = (np.concatenate([segment[k] for segment in segments]) for k in (1, 2))
        if len(positions) == sum(len(times) for *_, times in parts):
            obstacles.append(Obstacle(hull.core, hull.radius, None, rotations, positions))
    return obstacles


def obstacles_of_plan(plan: Plan, times: Array) -> list[Obstacle]:
    """Return the obstacles of a plan for display; moving obstacles get their poses at increasing times (M,), s."""
    if isinstance(plan, PathPlan):
        obstacles = () if plan.constraints is None else plan.constraints.scene.obstacles
        return obstacles_of_shapes(shape for shape in obstacles if not isinstance(shape, MovingObstacle))
    return obstacles_of(plan.solved_parts(times))


def _moves(problem: Problem, separation: Separation, frame: int) -> bool:
    """Return whether the frame of an obstacle moves as a function of time alone."""
    if frame < 0:
        return False
    rows = separation.placements[12 * frame : 12 * frame + 12]
    states = ca.vertcat(*(ca.vec(state.symbol) for state in problem.declared.states.values()))
    return bool(ca.depends_on(rows, problem.time)) and not ca.depends_on(rows, states)
