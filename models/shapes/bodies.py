"""The shapes of a robot: what its links' collision elements are, each in the frame of its link.

The rigid parts of a robot, the joints between them, and how far points that they carry are from a joint's axis.
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

from models.arrays import Array, checked_choice, checked_instance, checked_name, checked_nonnegative
from models.errors import ModelError, ModelWarning
from models.robot.parts import CollisionShape, Joint, Link
from models.robot.robot import Robot
from models.shapes.covering import Cover, cover
from models.shapes.hull import convex_hull
from models.shapes.mesh_files import find_mesh, read_mesh
from models.shapes.shapes import CORNERS, SIDES, Box, Capsule, Cylinder, Mesh, Shape, Sphere, checked_shape

MissingRule: TypeAlias = Literal["raise", "skip"]
Folders: TypeAlias = Sequence[str | os.PathLike[str]]

FLAT = 1.25
"""A capsule of this many times the volume of the cylinder that it stands for is too much: the cylinder is kept."""


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """A mesh of a link that bodies cover together.

    Attributes:
        points: Its corners, in the frame of the link. Shape (n, 3), m.
        number: Its place among the collision shapes of the link.
    """

    points: Array
    number: int = 0

    @cached_property
    def hull(self) -> Mesh:
        """Its convex hull, in the frame of the link; of points in a plane, that of cubes of 1 um around them."""
        try:
            return Mesh.around(convex_hull(self.points))
        except ModelError:
            return Mesh.around(convex_hull((self.points[:, None] + 1e-6 * CORNERS).reshape(-1, 3)))


@dataclass(frozen=True, eq=False)
class Body:
    """A shape of a link.

    Attributes:
        link: Name of the link that carries it.
        shape: In the frame of the link.
        overhang: How far it stands out of what the description says at most, m: of a mesh out of its convex hull, as
            `models.shapes.covering` measures it.
        mesh: The mesh that it covers, or a part of; None of other shapes.

    Raises:
        ModelError: A name that is none, something that is no shape or has no end, a negative overhang.
    """

    link: str
    shape: Shape
    overhang: float = 0.0
    mesh: LinkMesh | None = None

    def __post_init__(self) -> None:
        owner = f"body of link {checked_name(self.link, 'body', 'link')!r}"
        reach = checked_shape(self.shape, owner, "shape").reach(np.zeros(3))
        if not np.isfinite(reach):
            raise ModelError(f"{owner}: shape {self.shape!r} has no end", name="shape", value=self.shape)
        object.__setattr__(self, "overhang", checked_nonnegative(self.overhang, owner, "overhang", "m"))


def bodies_of(
    robot: Robot,
    *,
    folders: Folders = (),
    missing: MissingRule = "raise",
    covered: Mapping[tuple[str, int], Sequence[Body]] | None = None,
) -> tuple[Body, ...]:
    """The bodies of a robot's links, from their collision shapes, in the order of the links.

    Boxes, spheres and capsules stay what they are. A cylinder becomes a capsule around it, of which distances are exact
    and cheap, or stays one where that would be of more than FLAT times its volume. A mesh is covered by a few capsules
    or a box: see `models.shapes.covering.cover`.

    Args:
        folders: Where meshes are looked for before the folder of the URDF file and those above it; see
            `models.shapes.mesh_files.find_mesh`.
        missing: What to do about a mesh that is not found or not read: "raise", or "skip" it with a warning.
        covered: Bodies in place of meshes, by the link and the place among its collision shapes; those without any are
            skipped, and no file is opened. None: meshes are read and covered.

    Raises:
        ModelError: A mesh that is missing or broken, named with its link; a robot, folder or rule that is none.

    Warns:
        ModelWarning: Meshes that are skipped, each with its link and why.
    """
    checked_instance(robot, Robot, "bodies_of", "robot")
    checked_choice(missing, get_args(MissingRule), "bodies_of", "missing")
    if isinstance(folders, str | os.PathLike) or not isinstance(folders, Sequence):
        message = f"bodies_of: folders must be a list of paths, not {folders!r}"
        raise ModelError(message, name="folders", value=folders)
    find_mesh("", None, folders)  # says which of them is no path
    found: list[Body] = []
    skipped: dict[str, str] = {}
    for link in robot.links:
        for number, shape in enumerate(link.collisions):
            if shape.kind != "mesh":
                found.append(_simple(link, shape))
                continue
            if covered is not None:
                if (link.name, number) not in covered:
                    message = f"link {link.name!r}: nothing covers its mesh {shape.file!r}"
                    raise ModelError(message, name=link.name, value=shape.file)
                found += covered[link.name, number]
                if not covered[link.name, number]:
                    skipped[f"{link.name}: {shape.file}"] = f"{shape.file!r} of link {link.name!r} was skipped before"
                continue
            try:
                covers, mesh = _covers(link, shape, number, folders)
            except ModelError as error:
                if missing == "raise":
                    raise
                skipped[f"{link.name}: {shape.file}"] = str(error)
                continue
            found += [
                Body(link.name, each.shape.placed(shape.rotation, shape.translation), each.overhang, mesh)
                for each in covers
            ]
    if skipped:
        message = f"links that touch nothing with these meshes: {'; '.join(skipped.values())}"
        warn(ModelWarning(message, name=next(iter(skipped)), value=tuple(skipped)), stacklevel=2)
    return tuple(found)


def _simple(link: Link, shape: CollisionShape) -> Body:
    place, turn, size = np.asarray(shape.translation), np.asarray(shape.rotation), np.asarray(shape.size)
    if shape.kind == "box":
        return Body(link.name, Box(size, place, turn))
    radius = float(size[0])
    if shape.kind == "sphere":
        return Body(link.name, Sphere(radius, place))
    length = float(size[1])
    half = length / 2 * turn[:, 2]
    if shape.kind == "capsule":
        return Body(link.name, Capsule(radius, place - half, place + half))
    around, wide, overhang = capsule_around(radius, length)
    if around <= FLAT * np.pi * radius**2 * length:
        half = (wide[1] / 2) * turn[:, 2]
        return Body(link.name, Capsule(wide[0], place - half, place + half), overhang)
    return Body(link.name, Cylinder(radius, length, place, turn), radius * (1 / np.cos(np.pi / SIDES) - 1))


def capsule_around(radius: float, length: float) -> tuple[float, tuple[float, float], float]:
    """The capsule of least volume around a cylinder.

    With the radius R the rims of the cylinder lie on the caps where these begin sqrt(R^2 - r^2) before its ends.

    Args:
        radius, length: Of the cylinder, m.

    Returns:
        Volume, m^3; radius R and length without the caps, m; how far its poles stand out, m.
    """
    most = float(np.hypot(radius, length / 2))
    # closest at the first, where a little more lets the caps begin much earlier
    tried = radius + (most - radius) * np.linspace(0.0, 1.0, 400) ** 3
    lengths = np.maximum(length - 2 * np.sqrt(np.maximum(tried**2 - radius**2, 0)), 0)
    volumes = np.pi * tried**2 * (lengths + 4 / 3 * tried)
    k = int(volumes.argmin())
    wide = float(tried[k]) * (1 + 1e-12)  # the rims inside whatever rounding does
    return float(volumes[k]), (wide, float(lengths[k])), wide + float(lengths[k]) / 2 - length / 2


def _covers(link: Link, shape: CollisionShape, number: int, folders: Folders) -> tuple[tuple[Cover, ...], LinkMesh]:
    """Of a mesh, scaled, in the axes of the shape; and the mesh in the frame of the link."""
    path = find_mesh(shape.file, shape.folder or None, folders)
    if path is None:
        message = (
            f"link {link.name!r}: the mesh {shape.file!r} is not found: say in which folder its package or the file "
            "lies, folders=[FOLDER], or go on without it, missing='skip'"
        )
        raise ModelError(message, name=shape.file, value=link.name)
    try:
        vertices, faces = read_mesh(path)
        scaled = _scaled(vertices, shape)
        points = scaled[np.unique(faces)] @ shape.rotation.T + shape.translation
        return cover(scaled, faces), LinkMesh(np.asarray(points), number)
    except ModelError as error:
        raise ModelError(
            f"link {link.name!r}: {error}", name=error.name, value=error.value, limit=error.limit
        ) from error


def _scaled(vertices: Array, shape: CollisionShape) -> Array:
    with np.errstate(over="ignore"):  # what is not finite is refused by the cover
        return np.asarray(vertices * shape.size)


class Step(NamedTuple):
    """A moving joint between two rigid parts: its frame in the part above, whose child link is the part below."""

    joint: Joint
    turn: Array
    shift: Array
    above: str


@dataclass(frozen=True)
class RigidParts:
    """Links with no moving joint between them, each part named by its link nearest to the root.

    Attributes:
        of_link: The part of each link.
        place: Rotation and translation of each link in the frame of its part.
        step: The joint above each part but the root's.
    """

    of_link: dict[str, str]
    place: dict[str, tuple[Array, Array]]
    step: dict[str, Step]

    @classmethod
    def of(cls, robot: Robot) -> RigidParts:
        parts = cls({robot.root: robot.root}, {robot.root: (np.eye(3), np.zeros(3))}, {})
        for joint in robot.joints:
            turn, shift = parts.place[joint.parent]
            turn, shift = turn @ joint.rotation, shift + turn @ joint.translation
            if joint.moves:
                parts.of_link[joint.child], parts.place[joint.child] = joint.child, (np.eye(3), np.zeros(3))
                parts.step[joint.child] = Step(joint, turn, shift, parts.of_link[joint.parent])
            else:
                parts.of_link[joint.child] = parts.of_link[joint.parent]
                parts.place[joint.child] = turn, shift
        return parts

    def path(self, one: str, other: str) -> tuple[list[Step], list[Step]]:
        """Joints from one part up to where it meets the other's way, and from there down to the other."""
        up, down = self._above(one), self._above(other)
        while up and down and up[-1] is down[-1]:
            up, down = up[:-1], down[:-1]
        return up, down[::-1]

    def meeting(self, one: str, other: str) -> str:
        """The last part that carries both."""
        up = self.path(one, other)[0]
        return up[-1].above if up else one

    def _above(self, part: str) -> list[Step]:
        """Joints from a part up to the root."""
        found = []
        while part in self.step:
            found.append(self.step[part])
            part = found[-1].above
        return found

    def close(self, bodied: set[str]) -> set[frozenset[str]]:
        """Parts with bodies that a joint connects, or a chain of joints with no body in between."""
        next_to: dict[str, set[str]] = defaultdict(set)
        for part, step in self.step.items():
            next_to[part].add(step.above)
            next_to[step.above].add(part)
        found = set()
        for start in bodied:
            seen, waiting = {start}, list(next_to[start])
            while waiting:
                part = waiting.pop()
                if part in seen:
                    continue
                seen.add(part)
                if part in bodied:
                    found.add(frozenset((start, part)))
                else:
                    waiting += next_to[part]
        return found


def arms(
    robot: Robot, chain: Sequence[tuple[Step, bool]], end: Shape, low: Array, high: Array
) -> tuple[list[float], float]:
    """How far points of a body at the end of a chain are from each joint's axis at most, and from where it begins.

    Args:
        chain: Joints that are passed down (True) or up the tree, one after the other.
        end: The body, in the frame of the last rigid part.
        low, high: Limits of the joint vector. Shape (dof,).

    Returns:
        The arms, m; and the largest distance of the points from the origin of the first part, where the chain goes
        down, m; inf beyond a slide without limits.
    """
    found, beyond = [], 0.0  # beyond: how far those points are from the next joint's origin
    for k in range(len(chain) - 1, -1, -1):
        step, down = chain[k]
        # In the rigid part behind the joint, as seen along the chain: a point and the direction of its axis.
        origin = np.zeros(3) if down else step.shift
        axis = np.asarray(step.joint.axis) if down else step.turn @ step.joint.axis
        if k == len(chain) - 1:
            along = (end.core - origin) @ axis
            squares = ((end.core - origin) ** 2).sum(axis=1)
            found.append(float(np.sqrt(np.maximum(squares - along**2, 0)).max()) + end.swelling)
            reach = float(np.sqrt(squares).max()) + end.swelling
        else:
            following, going_down = chain[k + 1]
            hop = (following.shift if going_down else np.zeros(3)) - origin
            found.append(float(np.linalg.norm(hop - (hop @ axis) * axis)) + beyond)
            reach = float(np.linalg.norm(hop)) + beyond
        if step.joint.kind == "prismatic":
            column, ratio, offset = robot.couplings[step.joint.name]
            ends = ratio * np.array([low[column], high[column]]) + offset
            reach += float(np.abs(ends).max())
        beyond = reach
    if not chain:
        return [], end.reach(np.zeros(3))
    step, down = chain[0]
    return found[::-1], beyond + (float(np.linalg.norm(step.shift)) if down else 0.0)
