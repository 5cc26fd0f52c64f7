"""Collision bodies of a robot's links, and the rigid parts of a robot with the joints between them.

`collision_bodies` converts the collision elements of a robot description to shapes in the frames of the links.
`RigidParts` merges links that no moving joint separates. `lever_arms` bounds the distance of a body from the joint axes
that move it.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias, get_args
from warnings import warn

import numpy as np

from models.checks import Array, require, set_fields
from models.errors import ModelError, ModelWarning
from models.robot.parts import CollisionShape, Joint, Link
from models.robot.robot import Robot
from models.shapes.covering import cover
from models.shapes.hull import cached_hull
from models.shapes.mesh_files import find_mesh, read_mesh
from models.shapes.shapes import CORNERS, SIDES, Box, Capsule, Cylinder, Mesh, Shape, Sphere, checked_shape

MissingRule: TypeAlias = Literal["raise", "skip"]
Folders: TypeAlias = Sequence[str | os.PathLike[str]]

MAX_CAPSULE_VOLUME = 1.25
"""Largest volume of a capsule that replaces a cylinder, relative to the volume of the cylinder."""


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """A mesh of a link, covered by one or more collision bodies (capsules or a box)."""

    points: Array  # vertices in the frame of the link. Shape (n, 3), m.
    number: int = 0  # index of the mesh among the collision shapes of the link

    @cached_property
    def hull(self) -> Mesh:
        """Convex hull of the mesh in link axes; cubes of half-edge 1 um first replace points that are coplanar."""
        try:
            return Mesh.around(cached_hull(self.points))
        except ModelError:
            return Mesh.around(cached_hull((self.points[:, None] + 1e-6 * CORNERS).reshape(-1, 3)))


@dataclass(frozen=True, eq=False)
class Body:
    """A collision body: a shape that a link of the robot carries.

    Attributes:
        link: Name of the link that carries the shape.
        shape: Shape in the frame of the link.
        overhang: Largest distance, m, by which the shape protrudes from the described geometry; for a mesh from its
            convex hull, as `models.shapes.covering` estimates it.
        mesh: Mesh that the shape covers wholly or in part; None for other shapes.

    Raises:
        ModelError: The link's name is invalid, the shape is none or unbounded, or the overhang is negative.
    """

    link: str
    shape: Shape
    overhang: float = 0.0
    mesh: LinkMesh | None = None

    def __post_init__(self) -> None:
        owner = f"body of link {require.name('body: link', self.link)!r}"
        if not np.isfinite(checked_shape(f"{owner}: shape", self.shape).reach(np.zeros(3))):
            message = f"{owner}: shape {self.shape!r} is unbounded; give a bounded one"
            raise ModelError(message, name="shape", value=self.shape)
        set_fields(self, overhang=require.nonnegative(f"{owner}: overhang", self.overhang, unit="m"))


def collision_bodies(
    robot: Robot,
    *,
    folders: Folders = (),
    missing: MissingRule = "raise",
    covered: Mapping[tuple[str, int], Sequence[Body]] | None = None,
) -> tuple[Body, ...]:
    """Return the collision bodies of a robot's links, in the order of the links.

    Boxes, spheres and capsules are kept. A cylinder becomes its smallest enclosing capsule, whose distances are exact
    and fast, unless the capsule has more than MAX_CAPSULE_VOLUME times its volume. A mesh is covered by a few capsules
    or a box, see `models.shapes.covering.cover`.

    Args:
        folders: Folders to search for meshes before the folder of the URDF file and its parents; see
            `models.shapes.mesh_files.find_mesh`.
        missing: "raise" an error for a mesh that is not found or not readable, or "skip" it with a warning.
        covered: Known bodies of the meshes, by link and index among its collision shapes. Meshes with no bodies are
            skipped, and no file is opened. None: read and cover the meshes.

    Raises:
        ModelError: A mesh is missing or invalid (named with its link), or the robot, a folder or the rule is invalid.

    Warns:
        ModelWarning: Meshes were skipped; names each with its link and the reason.
    """
    require.instance("collision_bodies: robot", robot, Robot)
    require.choice("collision_bodies: missing", missing, get_args(MissingRule))
    if isinstance(folders, str | os.PathLike) or not isinstance(folders, Sequence):
        message = f"collision_bodies: folders must be a list of paths, not {folders!r}"
        raise ModelError(message, name="folders", value=folders)
    find_mesh("", None, folders)  # checks the folders
    bodies: list[Body] = []
    skipped: dict[str, str] = {}
    for link in robot.links:
        for number, shape in enumerate(link.collisions):
            if shape.kind != "mesh":
                bodies.append(_primitive_body(link, shape))
                continue
            name = f"{link.name}: {shape.file}"
            if covered is not None:
                if (link.name, number) not in covered:
                    message = f"link {link.name!r}: no bodies are given that cover its mesh {shape.file!r}"
                    raise ModelError(message, name=link.name, value=shape.file)
                bodies += covered[link.name, number]
                if not covered[link.name, number]:
                    skipped[name] = f"{shape.file!r} of link {link.name!r} was skipped before"
                continue
            try:
                bodies += _mesh_bodies(link, shape, number, folders)
            except ModelError as error:
                if missing == "raise":
                    raise
                skipped[name] = str(error)
    if skipped:
        message = f"collisions of these meshes are not checked: {'; '.join(skipped.values())}"
        warn(ModelWarning(message, name=next(iter(skipped)), value=tuple(skipped)), stacklevel=2)
    return tuple(bodies)


def _primitive_body(link: Link, shape: CollisionShape) -> Body:
    position, rotation, size = np.asarray(shape.translation), np.asarray(shape.rotation), np.asarray(shape.size)
    if shape.kind == "box":
        return Body(link.name, Box(size, position, rotation))
    radius = float(size[0])
    if shape.kind == "sphere":
        return Body(link.name, Sphere(radius, position))
    length = float(size[1])
    half = length / 2 * rotation[:, 2]
    if shape.kind == "capsule":
        return Body(link.name, Capsule(radius, position - half, position + half))
    volume, (capsule_radius, capsule_length), overhang = capsule_around(radius, length)
    if volume <= MAX_CAPSULE_VOLUME * np.pi * radius**2 * length:
        half = (capsule_length / 2) * rotation[:, 2]
        return Body(link.name, Capsule(capsule_radius, position - half, position + half), overhang)
    return Body(link.name, Cylinder(radius, length, position, rotation), radius * (1 / np.cos(np.pi / SIDES) - 1))


def capsule_around(radius: float, length: float) -> tuple[float, tuple[float, float], float]:
    """Return volume (m^3), size (radius, length without caps, m), protrusion (m) of the capsule around a cylinder.

    The capsule has the least volume. With its radius R, the rims of the cylinder of radius r lie on the caps, which
    begin sqrt(R^2 - r^2) before the cylinder's ends.
    """
    largest = float(np.hypot(radius, length / 2))
    # dense near the cylinder's radius, where the cap length changes most
    radii = radius + (largest - radius) * np.linspace(0.0, 1.0, 400) ** 3
    lengths = np.maximum(length - 2 * np.sqrt(np.maximum(radii**2 - radius**2, 0)), 0)
    volumes = np.pi * radii**2 * (lengths + 4 / 3 * radii)
    k = int(volumes.argmin())
    best_radius = float(radii[k]) * (1 + 1e-12)  # keeps the rims inside in spite of rounding
    return float(volumes[k]), (best_radius, float(lengths[k])), best_radius + float(lengths[k]) / 2 - length / 2


def _mesh_bodies(link: Link, shape: CollisionShape, number: int, folders: Folders) -> list[Body]:
    """Return the collision bodies (capsules or a box) that cover a mesh of a link, in the frame of the link."""
    path = find_mesh(shape.file, shape.folder or None, folders)
    if path is None:
        message = (
            f"link {link.name!r}: the mesh {shape.file!r} is not found; give the folder of its package or of the file, "
            "folders=[FOLDER], or skip it, missing='skip'"
        )
        raise ModelError(message, name=shape.file, value=link.name)
    try:
        vertices, faces = read_mesh(path)
        with np.errstate(over="ignore"):  # `cover` refuses what is not finite
            scaled = np.asarray(vertices * shape.size)
        points = scaled[np.unique(faces)] @ shape.rotation.T + shape.translation
        covers, mesh = cover(scaled, faces), LinkMesh(np.asarray(points), number)
    except ModelError as error:
        message = f"link {link.name!r}: {error}"
        raise ModelError(message, name=error.name, value=error.value, limit=error.limit) from error
    pose = shape.rotation, shape.translation
    return [Body(link.name, each.shape.placed(*pose), each.overhang, mesh) for each in covers]


class JointStep(NamedTuple):
    """A moving joint between two rigid parts of a robot (`RigidParts`)."""

    joint: Joint  # its child link names the part below
    rotation: Array  # of the joint frame in the part above. Shape (3, 3).
    translation: Array  # of the joint frame in the part above. Shape (3,), m.
    above: str  # name of the part above


@dataclass(frozen=True)
class RigidParts:
    """Sets of links that no moving joint separates; each set is named after the link nearest to the root."""

    of_link: dict[str, str]  # the part of each link
    pose: dict[str, tuple[Array, Array]]  # rotation and translation of each link in the frame of its part
    step: dict[str, JointStep]  # the joint above each part but the root's

    @classmethod
    def of(cls, robot: Robot) -> RigidParts:
        """Return the rigid parts of a robot, the sets of links that no moving joint separates."""
        parts = cls({robot.root: robot.root}, {robot.root: (np.eye(3), np.zeros(3))}, {})
        for joint in robot.joints:
            rotation, translation = parts.pose[joint.parent]
            rotation, translation = rotation @ joint.rotation, translation + rotation @ joint.translation
            if joint.moves:
                parts.of_link[joint.child], parts.pose[joint.child] = joint.child, (np.eye(3), np.zeros(3))
                parts.step[joint.child] = JointStep(joint, rotation, translation, parts.of_link[joint.parent])
            else:
                parts.of_link[joint.child] = parts.of_link[joint.parent]
                parts.pose[joint.child] = rotation, translation
        return parts

    def path(self, first: str, second: str) -> tuple[list[JointStep], list[JointStep]]:
        """Return the joints from one rigid part up to the part that carries both, and those down to the other part."""
        up, down = self._joints_above(first), self._joints_above(second)
        while up and down and up[-1] is down[-1]:
            up, down = up[:-1], down[:-1]
        return up, down[::-1]

    def common_part(self, first: str, second: str) -> str:
        """Return the rigid part farthest from the root that carries two given parts."""
        up = self.path(first, second)[0]
        return up[-1].above if up else first

    def _joints_above(self, part: str) -> list[JointStep]:
        """Return the moving joints from a rigid part up to the root, the nearest first."""
        steps = []
        while part in self.step:
            steps.append(self.step[part])
            part = steps[-1].above
        return steps

    def adjacent(self, bodied: set[str]) -> set[frozenset[str]]:
        """Return the pairs of parts with bodies (`bodied`) that no other part with bodies separates in the tree."""
        neighbours: dict[str, set[str]] = defaultdict(set)
        for part, step in self.step.items():
            neighbours[part].add(step.above)
            neighbours[step.above].add(part)
        pairs = set()
        for start in bodied:
            visited, queue = {start}, list(neighbours[start])
            while queue:
                part = queue.pop()
                if part in visited:
                    continue
                visited.add(part)
                if part in bodied:
                    pairs.add(frozenset((start, part)))
                else:
                    queue += neighbours[part]
        return pairs


def lever_arms(
    robot: Robot, chain: Sequence[tuple[JointStep, bool]], end: Shape, *, low: Array, high: Array
) -> tuple[list[float], float]:
    """Return upper bounds of the distances of a body's points from the axes of the joints that carry the body.

    Args:
        chain: Joints in order, with True where the chain passes the joint down the tree and False where up.
        end: The body, in the frame of the last rigid part.
        low, high: Limits of the joint vector. Shape (dof,).

    Returns:
        One lever arm per joint, m; and the largest distance of the points from the origin of the first part, if the
        chain goes down, m (inf for a prismatic joint without limits).
    """
    if not chain:
        return [], end.reach(np.zeros(3))
    levers, reach = [], 0.0  # reach: largest distance of the body's points from the origin of the joint at hand
    for k in range(len(chain) - 1, -1, -1):
        step, down = chain[k]
        # origin and axis of the joint in the rigid part behind it, as seen along the chain
        origin = np.zeros(3) if down else step.translation
        axis = np.asarray(step.joint.axis) if down else step.rotation @ step.joint.axis
        if k == len(chain) - 1:
            along = (end.core - origin) @ axis
            squares = ((end.core - origin) ** 2).sum(axis=1)
            levers.append(float(np.sqrt(np.maximum(squares - along**2, 0)).max()) + end.swept_radius)
            reach = float(np.sqrt(squares).max()) + end.swept_radius
        else:
            next_step, next_down = chain[k + 1]
            offset = (next_step.translation if next_down else np.zeros(3)) - origin
            levers.append(float(np.linalg.norm(offset - (offset @ axis) * axis)) + reach)
            reach = float(np.linalg.norm(offset)) + reach
        if step.joint.kind == "prismatic":
            column, ratio, zero = robot.couplings[step.joint.name]
            reach += float(np.abs(ratio * np.array([low[column], high[column]]) + zero).max())
    step, down = chain[0]
    return levers[::-1], reach + (float(np.linalg.norm(step.translation)) if down else 0.0)
