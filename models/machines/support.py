"""The region of the ground that a foot rests on: a convex polygon.

Where a robot touches level ground: its support, from the collision shapes of its wheels and feet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial import ConvexHull

from models.arrays import (
    ROUNDING,
    Array,
    ArrayInput,
    checked_array,
    checked_each,
    checked_instance,
    checked_nonnegative,
    checked_rotation,
    frozen,
)
from models.errors import ModelError
from models.robot.kinematics import checked_vector, link_frames
from models.robot.parts import CollisionShape
from models.robot.robot import Robot
from models.spatial import FULL_TURN, Expression, Frame


@dataclass(frozen=True, eq=False)
class Support:
    """Convex polygon on the ground, in world axes.

    Attributes:
        vertices: Corners in order, either way round; stored counter-clockwise, without those on a straight edge.
            Shape (k, 2), m.

    Raises:
        ModelError: Fewer than three corners, a polygon without area, one that is not convex or crosses itself.
    """

    vertices: ArrayInput

    def __post_init__(self) -> None:
        corners: Array = checked_array(self.vertices, ("corners", 2), "support", "vertices", least=3, unit="m")
        size = float(np.ptp(corners, axis=0).max())
        area = _area(corners)
        if abs(area) <= ROUNDING * size**2:
            message = f"support: the polygon {corners.tolist()} has no area; give corners that are not in line"
            raise ModelError(message, name="vertices", value=corners)
        if area < 0:
            corners = corners[::-1]
        edges = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(edges, axis=1)
        if lengths.min() <= ROUNDING * size:
            twice = corners[lengths.argmin()].tolist()
            raise ModelError(
                f"support: corner {twice} occurs twice in a row; give it once", name="vertices", value=twice
            )
        ahead = np.roll(edges, -1, axis=0)
        turns = np.arctan2(_cross(edges, ahead), (edges * ahead).sum(axis=1))
        worst = int(turns.argmin())
        if turns[worst] < -ROUNDING:
            corner = np.roll(corners, -1, axis=0)[worst]
            message = (
                f"support: the polygon {corners.tolist()} is not convex at {corner.tolist()}; "
                "the ground carries a foot on the convex hull of its contact points: give that"
            )
            raise ModelError(message, name="vertices", value=corner)
        if turns.sum() > 3 * np.pi:
            message = f"support: the polygon {corners.tolist()} crosses itself; give its corners in order"
            raise ModelError(message, name="vertices", value=corners)
        object.__setattr__(self, "vertices", frozen(corners[np.roll(turns, 1) > ROUNDING]))

    @property
    def area(self) -> float:
        """m^2."""
        return _area(self.vertices)

    @property
    def center(self) -> Array:
        """Middle of the bounding box. Shape (2,), m."""
        return np.asarray(self.vertices.max(axis=0) + self.vertices.min(axis=0)) / 2

    @property
    def half_widths(self) -> Array:
        """Half the sides of the bounding box. Shape (2,), m."""
        return np.asarray(np.ptp(self.vertices, axis=0)) / 2

    @cached_property
    def inner_radius(self) -> float:
        """Radius of the largest circle inside, m: the largest margin that any point has."""
        offsets = (self.normals * self.vertices).sum(axis=1)
        best = 0.0
        for chosen in combinations(range(len(offsets)), 3):  # it touches three edges (two parallel ones and another)
            edges = list(chosen)
            system = np.column_stack([self.normals[edges], -np.ones(3)])
            if abs(np.linalg.det(system)) > ROUNDING:
                *point, radius = np.linalg.solve(system, offsets[edges])
                if (self.normals @ point - offsets >= radius - ROUNDING).all():
                    best = max(best, float(radius))
        return best

    @cached_property
    def normals(self) -> Array:
        """Inward unit normals of the edges, edge i from corner i to the next. Shape (k, 2)."""
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        return np.asarray(np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None])

    def distances(self, point: Expression) -> Expression:
        """Signed distance of a point from every edge's line, positive inside. Shape (k, 1), m."""
        point = checked_vector(point, 2, "point", "x and y on the ground")
        offsets = (self.normals * self.vertices).sum(axis=1)
        return ca.mtimes(ca.sparsify(ca.DM(self.normals)), point) - ca.DM(offsets)

    def margin(self, point: Expression) -> Expression:
        """Least of :meth:`distances`: how far a point may move before it leaves the polygon. Shape (1, 1), m.

        Negative outside; there its size is the distance from the farthest line, at most that from the polygon.
        """
        return ca.mmin(ca.densify(self.distances(point)))


def rectangle(x: ArrayInput, y: ArrayInput) -> Support:
    """Rectangular support from (least, greatest) x and y, m.

    Raises:
        ModelError: Not two numbers each, a side without length.
    """
    x, y = checked_array(x, (2,), "rectangle", "x"), checked_array(y, (2,), "rectangle", "y")
    for what, (least, greatest) in (("x", x), ("y", y)):
        if not least < greatest:
            message = f"rectangle: {what} from {least:g} to {greatest:g} m has no length; least first"
            raise ModelError(message, name=what, value=(least, greatest))
    return Support([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _area(corners: Array) -> float:
    return float(_cross(corners, np.roll(corners, -1, axis=0)).sum() / 2)


RIM = 32
"""Points by which the rim of a cylinder is described: its contact is this polygon, inside the true one."""


class Footprint(NamedTuple):
    """What a robot stands on.

    With it the robot stands on z = 0 of the world: `Standing(robot, support=found.support,
    translation=found.translation, rotation=found.rotation)`.

    Attributes:
        support: Convex hull of the lowest points, in axes x and y of the world through the root link's origin.
        translation: The root link's origin in the world, above the ground. Shape (3,), m.
        rotation: The root link's axes, as columns, in the world. Shape (3, 3).
        links: Names of the links that touch the ground.
    """

    support: Support
    translation: Array
    rotation: Array
    links: tuple[str, ...]


def footprint(
    robot: Robot,
    *,
    q: ArrayInput = None,
    rotation: ArrayInput = None,
    links: Sequence[str] | None = None,
    depth: float = 0.005,
) -> Footprint:
    """Support of a robot that stands on whatever of its collision shapes is lowest.

    Boxes, cylinders, capsules and spheres are looked at. Meshes are not read: where a foot is a mesh
    give the support yourself; where a mesh might be lower than what is found name the `links` that touch the ground.

    Args:
        robot: With the links whose shapes may touch the ground, or what carries them.
        q: Joint positions in which it stands, zeros if None. Shape (dof,), rad or m.
        rotation: The root link's axes, as columns, in the world, z upwards; those of the world if None. Shape (3, 3).
        links: Links that may touch the ground; all if None.
        depth: How far above the lowest point a point still counts as touching, m: wheels and casters give way.

    Raises:
        ModelError: Unknown links, no shape but meshes or the origin of a mesh below them, contact points in one line, a
            negative depth, no rotation.
    """
    checked_instance(robot, Robot, "footprint", "robot")
    checked_nonnegative(depth, "footprint", "depth", "m")
    if links is not None:
        links = checked_each(links, str, "footprint", "links")
    standing = robot.links if links is None else [robot.link(name) for name in links]
    upright = checked_rotation(np.eye(3) if rotation is None else rotation, "footprint", "rotation")
    frames = link_frames(robot, np.zeros(robot.dof) if q is None else q, Frame(ca.DM(upright), ca.DM.zeros(3)))
    owners: list[str] = []
    points: list[Array] = []
    meshes: list[tuple[float, str]] = []  # height of the origin, link
    for link in standing:
        turn, place = (np.array(ca.DM(part)) for part in frames[link.name])
        for shape in (each.placed(turn, place.ravel()) for each in link.collisions):
            if shape.kind == "mesh":
                meshes.append((float(shape.translation[2]), link.name))
            else:
                corners = _corners(shape)
                points.extend(corners)
                owners.extend([link.name] * len(corners))
    if not points:
        owning = sorted({name for _, name in meshes})
        what = f"only meshes, in {owning}, which are not read" if meshes else "no collision shapes"
        message = f"footprint: there are {what}; give the support yourself, for example models.rectangle(...)"
        raise ModelError(message, name=owning[0] if owning else "shapes", value=tuple(owning))
    cloud = np.array(points)
    height = float(cloud[:, 2].min())
    if meshes and min(meshes)[0] < height:
        low, name = min(meshes)
        message = (
            f"footprint: the mesh of link {name!r} begins {height - low:.3g} m lower than all shapes that are read; "
            "give the support yourself, or name the links that touch the ground"
        )
        raise ModelError(message, name=name, value=low, limit=height)
    touching = cloud[:, 2] <= height + depth
    names = tuple(dict.fromkeys(name for name, low in zip(owners, touching, strict=True) if low))
    hull = convex_hull(cloud[touching, :2])
    if len(hull) < 3:
        message = (
            f"footprint: the links {list(names)} touch the ground in one point or line, on which nothing stands; "
            f"name other links, allow for more depth than {depth:g} m, or give the support yourself"
        )
        raise ModelError(message, name="links", value=names, limit=depth)
    return Footprint(Support(hull), np.array([0.0, 0.0, -height]), upright, names)


def convex_hull(points: ArrayInput) -> Array:
    """Corners of the convex hull of points in the plane, counter-clockwise, by qhull. Shape (k, 2).

    Fewer than three where all points lie in one line, as far as doubles tell.
    """
    cloud = np.unique(np.asarray(points, dtype=float), axis=0)  # sorted by x, then y
    if np.linalg.matrix_rank(cloud - cloud[:1], tol=1e-12 * float(np.ptp(cloud, axis=0).max(initial=0.0))) < 2:
        return cloud[[0, -1]] if len(cloud) > 1 else cloud
    return np.asarray(cloud[ConvexHull(cloud).vertices])


def _corners(shape: CollisionShape) -> Array:
    """Points of a shape in the world, no mesh, that may be its lowest. Shape (k, 3), m."""
    down = -np.asarray(shape.rotation)[2]  # in the shape's axes
    if shape.kind == "box":
        corners = np.array(np.meshgrid(*([-1, 1] for _ in range(3)))).reshape(3, -1).T * shape.size / 2
    elif shape.kind == "sphere":
        corners = shape.size * down[None, :]
    else:
        radius, length = shape.size
        ends = np.array([[0.0, 0.0, -length / 2], [0.0, 0.0, length / 2]])
        if shape.kind == "capsule":
            corners = ends + radius * down
        else:
            lowest = np.arctan2(down[1], down[0])  # the rim's own lowest point is one of its corners
            angles = lowest + FULL_TURN * np.arange(RIM) / RIM
            rim = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RIM)])
            # level, but for a slope of a thousandth; a wheel stands on its lowest line alone
            rim = rim[rim @ down >= (rim @ down).max() - 1e-3 * radius]
            corners = (ends[:, None] + rim[None]).reshape(-1, 3)
    return np.asarray(corners @ shape.rotation.T + shape.translation)
