"""Shapes for the tests of distances, and the same ones in coal and as hulls of differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import coal
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from models import Box, Capsule, Cylinder, Frame, HalfSpace, Mesh, Sphere
from models.shapes.distance import distance
from models.shapes.shapes import Shape
from models.spatial import skew

Array = NDArray[np.float64]


def turns(rng: np.random.Generator, count: int) -> Array:
    return np.asarray(Rotation.random(count, random_state=rng).as_matrix())


def random_shape(kind: type, rng: np.random.Generator, spread: float = 0.5) -> Any:
    turn, place = turns(rng, 1)[0], rng.normal(size=3) * spread
    if kind is Sphere:
        return Sphere(rng.uniform(0.05, 0.4), place)
    if kind is Capsule:
        return Capsule(rng.uniform(0.02, 0.3), place, place + rng.normal(size=3) * 0.5)
    if kind is Box:
        return Box(rng.uniform(0.1, 1.5, 3), place, turn)
    if kind is Cylinder:
        return Cylinder(rng.uniform(0.1, 0.6), rng.uniform(0.1, 1.5), place, turn)
    if kind is HalfSpace:
        return HalfSpace(rng.normal(size=3), place)
    return Mesh(rng.normal(size=(rng.integers(5, 15), 3)) * 0.4, None, place, turn)


def random_frame(rng: np.random.Generator, spread: float = 1.0) -> Frame:
    return Frame(turns(rng, 1)[0], (rng.normal(size=3) * spread).reshape(3, 1))


def in_coal(shape: Shape) -> tuple[Any, Any]:
    """The geometry and where it is."""
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius), coal.Transform3s(np.eye(3), shape.position)
    if isinstance(shape, Capsule):
        along = shape.end - shape.start
        length = float(np.linalg.norm(along))
        across = np.linalg.svd(along[None])[2]
        turn = np.column_stack([across[1], np.cross(along / length, across[1]), along / length])
        return coal.Capsule(shape.radius, length), coal.Transform3s(turn, (shape.start + shape.end) / 2)
    if isinstance(shape, Box):
        return coal.Box(*shape.size), coal.Transform3s(shape.rotation, shape.position)
    if isinstance(shape, Cylinder):
        return coal.Cylinder(shape.radius, shape.length), coal.Transform3s(shape.rotation, shape.position)
    assert isinstance(shape, Mesh)
    points = coal.StdVec_Vec3s()
    for vertex in shape.hull.vertices:
        points.append(vertex)
    return coal.Convex.convexHull(points, False, ""), coal.Transform3s(shape.rotation, shape.position)


def by_coal(one: Shape, other: Shape) -> float:
    (first, place), (second, other_place) = in_coal(one), in_coal(other)
    request = coal.DistanceRequest()
    request.enable_signed_distance = True
    return float(coal.distance(first, place, second, other_place, request, coal.DistanceResult()))


def by_differences(one: Shape, other: Shape) -> float:
    """Signed distance from the hull of all differences of points of two cores: its depth, or its point nearest 0."""
    differences = (one.core[:, None] - other.core[None]).reshape(-1, 3)
    swept_radius = one.swept_radius + other.swept_radius
    hull = ConvexHull(differences, qhull_options="QJ1e-12")
    depth = float(hull.equations[:, 3].max())
    if depth < 0:
        return depth - swept_radius
    differences, weight = differences[hull.vertices], 1e3
    shares, _ = nnls(np.vstack([differences.T, np.full(len(differences), weight)]), np.array([0, 0, 0, weight]))
    return float(np.linalg.norm(differences.T @ (shares / shares.sum()))) - swept_radius


def moved_distance(one: Shape, other: Shape, rounding: float = 0.0) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Functions of (vector of a turn, shift) of the first shape: (distance, gradient) and the matrix of second ones."""
    x = ca.SX.sym("x", 6)
    angle = ca.sqrt(ca.sumsqr(x[:3]) + 1e-30)
    skewed = skew(x[:3])
    turn = ca.DM.eye(3) + ca.sin(angle) / angle * skewed + (1 - ca.cos(angle)) / angle**2 * ca.mtimes(skewed, skewed)
    gap = distance(one, other, Frame(turn, x[3:]), rounding=rounding)
    perturbed, slope = ca.hessian(gap, x)
    return ca.Function("gap", [x], [gap, slope]), ca.Function("bent", [x], [perturbed])
