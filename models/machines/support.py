"""Support polygons: the convex region of the ground that a foot rests on, and its computation from collision shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from models.checks import ROUNDING, Array, ArrayInput, freeze, require, set_fields
from models.errors import ModelError
from models.robot.kinematics import checked_vector, link_frames
from models.robot.parts import CollisionShape
from models.robot.robot import Robot
from models.spatial import FULL_TURN, Expression, Frame


@dataclass(frozen=True, eq=False)
class Support:
    """A support polygon: the convex region of the ground that a foot rests on, in world axes.

    Attributes:
        vertices: Corners in order, in either sense; stored counter-clockwise, without corners on a straight edge. Shape
            (k, 2), m.

    Raises:
        ModelError: Fewer than three corners, a polygon without area, one that is not convex or crosses itself.
    """

    vertices: ArrayInput

    def __post_init__(self) -> None:
        corners: Array = require.array("support: vertices", self.vertices, ("corners", 2), least=3, unit="m")
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
            repeated = corners[lengths.argmin()].tolist()
            message = f"support: corner {repeated} occurs twice in a row; give it once"
            raise ModelError(message, name="vertices", value=repeated)
        next_edges = np.roll(edges, -1, axis=0)
        angles = np.arctan2(_cross(edges, next_edges), (edges * next_edges).sum(axis=1))
        reflex = int(angles.argmin())
        if angles[reflex] < -ROUNDING:
            corner = np.roll(corners, -1, axis=0)[reflex]
            message = (
                f"support: the polygon {corners.tolist()} is not convex at {corner.tolist()}; "
                "the ground carries a foot on the convex hull of its contact points: give that"
            )
            raise ModelError(message, name="vertices", value=corner)
        if angles.sum() > 3 * np.pi:
            message = f"support: the polygon {corners.tolist()} crosses itself; give its corners in order"
            raise ModelError(message, name="vertices", value=corners)
        set_fields(self, vertices=freeze(corners[np.roll(angles, 1) > ROUNDING]))

    @property
    def area(self) -> float:
        """Area of the support polygon, m^2."""
        return _area(self.vertices)

    @property
    def center(self) -> Array:
        """Centre of the support polygon's bounding box. Shape (2,), m."""
        return np.asarray(self.vertices.max(axis=0) + self.vertices.min(axis=0)) / 2

    @property
    def half_widths(self) -> Array:
        """Half the side lengths of the support polygon's bounding box. Shape (2,), m."""
        return np.asarray(np.ptp(self.vertices, axis=0)) / 2

    @cached_property
    def inner_radius(self) -> float:
        """Radius of the largest circle inside the polygon, m, which is the largest `margin` of any point."""
        best = 0.0
        for indices in combinations(range(len(self.offsets)), 3):  # the circle touches three edges
            edges = list(indices)
            system = np.column_stack([self.normals[edges], -np.ones(3)])
            if abs(np.linalg.det(system)) > ROUNDING:
                *point, radius = np.linalg.solve(system, self.offsets[edges])
                if (self.normals @ point - self.offsets >= radius - ROUNDING).all():
                    best = max(best, float(radius))
        return best

    @cached_property
    def normals(self) -> Array:
        """Inward unit normals of the polygon's edges; edge i runs from corner i to the next corner. Shape (k, 2)."""
        edges = np.roll(self.vertices, -1, axis=0) - self.vertices
        return np.asarray(np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None])

    @cached_property
    def offsets(self) -> Array:
        """Signed distances of the polygon's edges from the origin, along their normals. Shape (k,), m."""
        return np.asarray((self.normals * self.vertices).sum(axis=1))

    def distances(self, point: Expression) -> Expression:
        """Return the signed distance of a point from each polygon edge's line, positive inside. Shape (k, 1), m."""
        point = checked_vector("point", point, 2, "x and y on the ground")
        return ca.mtimes(ca.sparsify(ca.DM(self.normals)), point) - ca.DM(self.offsets)

    def margin(self, point: Expression) -> Expression:
        """Return the least signed distance of a point from the lines of the polygon's edges. Shape (1, 1), m.

        Inside, it is how far the point may move before it leaves the polygon. Outside it is negative; its size is the
        distance from the farthest line, which is at most that from the polygon.
        """
        return ca.mmin(ca.densify(self.distances(point)))


def rectangle(x: ArrayInput, y: ArrayInput) -> Support:
    """Return a rectangular support polygon from (lower, upper) bounds of x and y, m.

    Raises:
        ModelError: Not two numbers each, or a side without length.
    """
    x, y = require.array("rectangle: x", x, (2,)), require.array("rectangle: y", y, (2,))
    for name, (lower, upper) in (("x", x), ("y", y)):
        if not lower < upper:
            message = f"rectangle: {name} from {lower:g} to {upper:g} m has no length; give the lower bound first"
            raise ModelError(message, name=name, value=(lower, upper))
    return Support([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _area(corners: Array) -> float:
    return float(_cross(corners, np.roll(corners, -1, axis=0)).sum() / 2)


RIM = 32
"""Number of vertices of the inscribed polygon that represents the circular rim of a cylinder in contact."""


class Footprint(NamedTuple):
    """Contact polygon of a robot with the ground, and the pose of the robot on it.

    With this pose the robot stands on z = 0 of the world: `Standing(robot, support=result.support,
    translation=result.translation, rotation=result.rotation)`.

    Attributes:
        support: Convex hull of the lowest points, in world axes x and y through the root link's origin.
        translation: Root link's origin in the world, above the ground. Shape (3,), m.
        rotation: Root link's axes, as columns, in the world. Shape (3, 3).
        links: Names of the links in contact with the ground.
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
    """Compute the support polygon of a robot from its lowest collision shapes.

    Boxes, cylinders, capsules and spheres are evaluated; meshes are not read. If a foot is a mesh, define the support
    yourself; if a mesh might be lower than the other shapes, name the `links` in contact with the ground.

    Args:
        robot: Robot with the links whose shapes may be in contact.
        q: Joint positions, zeros if None. Shape (dof,), rad or m.
        rotation: Root link's axes, as columns, in the world, z upwards; the identity if None. Shape (3, 3).
        links: Links that may be in contact; all if None.
        depth: Height above the lowest point up to which points count as in contact, m, since wheels and casters deform.

    Raises:
        ModelError: Unknown links, only mesh shapes, a mesh whose origin is below all other shapes, collinear contact
            points, a negative depth, an invalid rotation.
    """
    require.instance("footprint: robot", robot, Robot)
    require.nonnegative("footprint: depth", depth, unit="m")
    if links is not None:
        links = require.each("footprint: links", links, str)
    candidates = robot.links if links is None else [robot.link(name) for name in links]
    upright = require.rotation("footprint: rotation", np.eye(3) if rotation is None else rotation)
    frames = link_frames(robot, np.zeros(robot.dof) if q is None else q, Frame(ca.DM(upright), ca.DM.zeros(3)))
    owners: list[str] = []
    points: list[Array] = []
    meshes: list[tuple[float, str]] = []  # height of the origin, link
    for link in candidates:
        turn, place = (np.array(ca.DM(part)) for part in frames[link.name])
        for shape in (each.placed(turn, place.ravel()) for each in link.collisions):
            if shape.kind == "mesh":
                meshes.append((float(shape.translation[2]), link.name))
            else:
                corners = _corners(shape)
                points.extend(corners)
                owners.extend([link.name] * len(corners))
    if not points:
        mesh_links = sorted({name for _, name in meshes})
        shapes = f"only meshes, in {mesh_links}, which are not read" if meshes else "no collision shapes"
        message = f"footprint: there are {shapes}; give the support yourself, for example models.rectangle(...)"
        raise ModelError(message, name=mesh_links[0] if mesh_links else "shapes", value=tuple(mesh_links))
    cloud = np.array(points)
    height = float(cloud[:, 2].min())
    if meshes and min(meshes)[0] < height:
        low, name = min(meshes)
        message = (
            f"footprint: the mesh of link {name!r} begins {height - low:.3g} m lower than all shapes that are read; "
            "give the support yourself, or name the links that touch the ground"
        )
        raise ModelError(message, name=name, value=low, limit=height)
    in_contact = cloud[:, 2] <= height + depth
    names = tuple(dict.fromkeys(name for name, low in zip(owners, in_contact, strict=True) if low))
    hull = convex_hull(cloud[in_contact, :2])
    if len(hull) < 3:
        message = (
            f"footprint: the links {list(names)} touch the ground in one point or line, on which nothing stands; "
            f"name other links, allow for more depth than {depth:g} m, or give the support yourself"
        )
        raise ModelError(message, name="links", value=names, limit=depth)
    return Footprint(Support(hull), np.array([0.0, 0.0, -height]), upright, names)


def convex_hull(points: ArrayInput) -> Array:
    """Return the corners of the convex hull of points in the plane, counter-clockwise. Shape (k, 2).

    Fewer than three corners if all points are collinear to rounding.
    """
    cloud = np.unique(np.asarray(points, dtype=float), axis=0)  # sorted by x, then y
    if np.linalg.matrix_rank(cloud - cloud[:1], tol=1e-12 * float(np.ptp(cloud, axis=0).max(initial=0.0))) < 2:
        return cloud[[0, -1]] if len(cloud) > 1 else cloud
    return np.asarray(cloud[scipy.spatial.ConvexHull(cloud).vertices])


def _corners(shape: CollisionShape) -> Array:
    """Return the points of a collision shape, in the world, that may touch the ground. Shape (k, 3), m."""
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
            angles = np.arctan2(down[1], down[0]) + FULL_TURN * np.arange(RIM) / RIM  # a vertex at the lowest point
            rim = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RIM)])
            # the lowest part of the rim, to a slope of a thousandth: a wheel stands on its lowest line alone
            rim = rim[rim @ down >= (rim @ down).max() - 1e-3 * radius]
            corners = (ends[:, None] + rim[None]).reshape(-1, 3)
    return np.asarray(corners @ shape.rotation.T + shape.translation)
