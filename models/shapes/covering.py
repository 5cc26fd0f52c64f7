"""Covers of a triangle mesh by a few capsules or one box, whose distances can be computed exactly and fast.

One capsule of least volume is fitted to the mesh. Then the mesh is split across the plane that lowers the covered
volume most, each side gets its own capsule, and so on. A box replaces the capsules where it is clearly smaller.

Every triangle, split at the planes, lies in the capsule of its part. So do all points that a closed surface encloses:
from a point between two planes of a split, a line parallel to the planes meets the surface between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import scipy

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.files import cache_key, load_value, source_version, store_value
from models.shapes.hull import convex_hull, nearest_directions
from models.shapes.shapes import Box, Capsule


@dataclass(frozen=True)
class CoverSettings:
    """Settings of the search for capsules or a box that cover a mesh.

    Lengths and volumes are relative to a mesh whose largest extent is 1.
    """

    parts: int = 3  # largest number of capsules; distances of more would cost more than their fit saves
    worth_a_part: float = 1.07  # factor by which volume (or overhang, by its fourth root) must fall for a part
    worth_a_box: float = 0.7  # volume of the box over that of the capsules below which the box is taken
    split_levels: tuple[float, ...] = (0.12, 0.25, 0.38, 0.5, 0.62, 0.75, 0.88)  # relative positions of trial planes
    growth: float = 1e-9  # margin added to covers, larger than rounding errors
    thinnest: float = 1e-6  # smallest thickness of a box, which must not be zero
    directions: int = 48  # initial directions of capsule axes on a hemisphere
    extremes: int = 256  # directions whose extreme points take part in a fit, a multiple of 32
    trial_directions: int = 24  # directions for a split that is only tried
    trial_extremes: int = 64  # extremes for a split that is only tried
    simplex: tuple[float, ...] = (0.25, 0.25, 0.05, 0.05, 0.2)  # initial steps of the parameters of a capsule
    parameter_tolerance: float = 4e-3  # termination tolerance of these parameters
    volume_tolerance: float = 4e-4  # termination tolerance of the relative volume
    radii: tuple[float, ...] = (1.0, 1.02, 1.06, 1.15, 1.3)  # initial radii, relative to the enclosing cylinder's
    max_triangles: int = 1500  # number of triangles that splits are tried on: the largest ones and the extreme vertices
    grid: int = 6000  # number of points that estimate the covered volume, to about one percent
    samples: int = 150  # number of surface points at which the overhang of a cover is measured


SETTINGS = CoverSettings()

CoverShape: TypeAlias = Capsule | Box


@dataclass(frozen=True, eq=False)
class Cover:
    """A capsule or box that, alone or with others, covers a mesh, and how far it protrudes from the mesh."""

    shape: CoverShape  # capsule or box in the frame of the mesh
    overhang: float  # largest distance of sampled surface points of the shape from the convex hull of the mesh, m


def cover(vertices: ArrayInput, faces: ArrayInput) -> tuple[Cover, ...]:
    """Return capsules, or one box, that together contain every point of a triangle mesh.

    The result is deterministic. It is cached in a file by the content of the mesh, see `models.files`.

    Args:
        vertices: Shape (n, 3), m.
        faces: Triangles as indices of vertices. Shape (m, 3).

    Raises:
        ModelError: A shape is wrong, an entry is not finite, a face has an unknown vertex, or there is no triangle.
    """
    points = require.array("cover: vertices", vertices, ("vertices", 3))
    corners = require.indices("cover: faces", faces, len(points))
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        message = f"cover: faces have shape {corners.shape}, expected (m, 3)"
        raise ModelError(message, name="faces", value=faces, limit=("m", 3))
    triangles = points[corners]
    key = cache_key(source_version(__name__), "cover", triangles)
    known = _from_json(load_value(key), triangles.reshape(-1, 3))
    if known is None:
        known = fit_cover(triangles)
        store_value(key, [_to_json(each) for each in known])
    return known


def fit_cover(triangles: Array) -> tuple[Cover, ...]:
    """Compute the capsules, or the box, that cover triangles of shape (n, 3, 3), m, without using the cache."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    middle, size = (low + high) / 2, max(float((high - low).max()), 1e-12)
    unit = (triangles - middle) / size
    points = unit.reshape(-1, 3)
    hull = _hull_vertices(points)
    extreme_points = points[_extreme_indices(points, _principal_axes(points))]
    grid, box_volume = _volume_samples(points)
    parts, capsules = [unit], [_fit_capsule(points)]
    choices: list[tuple[float, list[CoverShape]]] = []
    first_volume = first_overhang = 1.0
    while True:
        shapes: list[CoverShape] = [
            _enclosing_capsule(each, part.reshape(-1, 3)) for each, part in zip(capsules, parts, strict=True)
        ]
        volume, overhang = _covered_share(shapes, grid), max(_overhang(each, hull) for each in shapes)
        if not choices:
            first_volume, first_overhang = max(volume, 1e-12), max(overhang, 1e-12)
        score = volume / first_volume * min(1.0, overhang / first_overhang) ** 0.25
        choices.append((score * SETTINGS.worth_a_part ** (len(parts) - 1), shapes))
        if len(parts) == SETTINGS.parts:
            break
        k = int(np.argmax([_covered_share([capsule], grid) for capsule in capsules]))
        sides = _best_split(parts[k], capsules[:k] + capsules[k + 1 :], capsules[k], grid)
        if len(sides) < 2:
            break
        parts[k : k + 1] = sides
        capsules[k : k + 1] = [_fit_capsule(side.reshape(-1, 3)) for side in sides]
    shapes = min(choices, key=lambda each: each[0])[1]
    box = _fit_box(points, extreme_points)
    if float(np.prod(box.size)) < SETTINGS.worth_a_box * box_volume * _covered_share(shapes, grid):
        beyond = max(0.0, float(exceedance(box, points).max())) + SETTINGS.growth  # certainly contains every point
        shapes = [Box(box.size + 2 * beyond, box.position, box.rotation)]
    return tuple(Cover(_to_mesh_units(each, middle, size), size * _overhang(each, hull)) for each in shapes)


def exceedance(shape: CoverShape, points: Array) -> Array:
    """Return the distances by which points lie outside a capsule or box, zero or negative inside. Shape (n,), m."""
    if isinstance(shape, Capsule):
        return np.asarray(_segment_distances(points, np.asarray(shape.start), np.asarray(shape.end)) - shape.radius)
    return np.asarray((np.abs((points - shape.position) @ shape.rotation) - shape.size / 2).max(axis=1))


def _fit_capsule(points: Array) -> Capsule:
    """Return a capsule of nearly least volume around points; the optimisation uses only the extreme points."""
    frame = _principal_axes(points)
    extreme_points = points[_extreme_indices(points, frame)]
    bases = _bases(np.concatenate([frame.T, _sphere_points(SETTINGS.directions, half=True) @ frame.T]))
    start, basis, volume = _approximate_capsule(extreme_points, bases)
    own = extreme_points @ basis
    result = scipy.optimize.minimize(
        lambda x: _evaluate_capsule(own, x)[0],
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + np.vstack([np.zeros(5), np.diag(SETTINGS.simplex)]),
            "xatol": SETTINGS.parameter_tolerance,
            "fatol": SETTINGS.volume_tolerance * volume,
        },
    )
    return _enclosing_capsule(_capsule_from_parameters(extreme_points, result.x, basis), points)


def _evaluate_capsule(points: Array, parameters: Array) -> tuple[float, float, float, float, Array, Array]:
    """Return volume, radius, ends along the axis, axis direction and axis point of the capsule with given parameters.

    The parameters, shape (5,), are two slopes of the axis (near z), its position across, and the root of the excess
    radius.
    """
    a, b, x, y, excess_root = parameters.tolist()
    length, width = math.sqrt(a * a + b * b + 1), math.sqrt(1 + a * a)
    axis = np.array([a, b, 1.0]) / length
    side = np.array([1.0, 0.0, -a]) / width
    other = np.array([-a * b, width * width, -b]) / (length * width)  # axis x side
    along = (axis[None] @ points.T)[0]
    across = ((side[None] @ points.T)[0] - x) ** 2 + ((other[None] @ points.T)[0] - y) ** 2
    radius = math.sqrt(across.max()) * (1 + excess_root * excess_root)
    caps = np.sqrt(np.maximum(radius * radius - across, 0))
    low, high = float((along + caps).min()), float((along - caps).max())
    if low > high:  # a ball encloses all points
        low = high = (low + high) / 2
    volume = np.pi * (radius * radius) * (high - low + 4 / 3 * radius)
    return volume, radius, low, high, axis, side * x + other * y


def _approximate_capsule(points: Array, bases: Array) -> tuple[Array, Array, float]:
    """Fit a capsule to points for each of k bases (k, 3, 3); return parameters, basis and volume of the smallest."""
    x, y, along = np.einsum("pi,kij->jkp", points, bases)
    centre_x, centre_y = ((part.min(axis=1) + part.max(axis=1)) / 2 for part in (x, y))
    rows = np.arange(len(bases))
    for k in range(24):  # shrinking steps towards the farthest point: smallest circle (Badoiu & Clarkson 2003)
        farthest = rows, ((x - centre_x[:, None]) ** 2 + (y - centre_y[:, None]) ** 2).argmax(axis=1)
        centre_x = centre_x + (x[farthest] - centre_x) / (k + 4)
        centre_y = centre_y + (y[farthest] - centre_y) / (k + 4)
    distances = (x - centre_x[:, None]) ** 2 + (y - centre_y[:, None]) ** 2
    radius = np.sqrt(distances.max(axis=1)) * np.array(SETTINGS.radii)[:, None]
    caps = np.sqrt(np.maximum(radius[:, :, None] ** 2 - distances, 0))
    length = np.maximum((along - caps).max(axis=2) - (along + caps).min(axis=2), 0)
    volumes = np.pi * radius**2 * (length + 4 / 3 * radius)
    best = volumes.argmin(axis=0)
    volumes = volumes[best, rows]
    k = int(volumes.argmin())
    excess = np.array(SETTINGS.radii)[best[k]] - 1
    return np.array([0.0, 0.0, centre_x[k], centre_y[k], np.sqrt(excess)]), bases[k], float(volumes[k])


def _capsule_from_parameters(points: Array, parameters: Array, basis: Array) -> Capsule:
    _, radius, low, high, axis, place = _evaluate_capsule(points @ basis, parameters)
    return Capsule(radius + SETTINGS.growth, basis @ (place + low * axis), basis @ (place + high * axis))


def _enclosing_capsule(capsule: Capsule, points: Array) -> Capsule:
    """Return the capsule with its radius increased until it certainly contains every given point."""
    start, end = np.asarray(capsule.start), np.asarray(capsule.end)
    radius = max(capsule.radius, float(_segment_distances(points, start, end).max())) + SETTINGS.growth
    return Capsule(radius, start, end)


def _segment_distances(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-300), 0, 1)
    square = (points - start - share[:, None] * along) ** 2
    return np.asarray(np.sqrt(square[:, 0] + square[:, 1] + square[:, 2]))  # faster than a norm of three columns


def _best_split(part: Array, others: list[Capsule], capsule: Capsule, grid: Array) -> list[Array]:
    """Split a mesh at the plane that gives its parts the smallest covers; return one part if no plane divides it."""
    points = part.reshape(-1, 3)
    frame = _principal_axes(points)
    axes = list(frame.T)
    along = np.asarray(capsule.end) - np.asarray(capsule.start)
    along = along / max(float(np.linalg.norm(along)), 1e-300)
    if 0 < np.abs(along @ frame).max() < 0.98:
        axes.append(along)
    bases = _bases(np.concatenate([frame.T, _sphere_points(SETTINGS.trial_directions, half=True) @ frame.T]))
    triangles = _representative_triangles(part, frame)
    free = grid[np.min([exceedance(each, grid) for each in others], axis=0) > 0] if others else grid

    def covered(fits: list[Capsule]) -> float:
        return 1 - (1 - _covered_share(fits, free)) * len(free) / len(grid)

    def share_of_split(k: int, level: float) -> float:
        sides = [side.reshape(-1, 3) for side in split_triangles(triangles, axes[k], level) if len(side)]
        if len(sides) < 2:
            return np.inf
        points = [side[_extreme_indices(side, frame, SETTINGS.trial_extremes)] for side in sides]
        return covered([_capsule_from_parameters(each, *_approximate_capsule(each, bases)[:2]) for each in points])

    spans = [(float((points @ axis).min()), float(np.ptp(points @ axis))) for axis in axes]
    levels = [(k, low + share * span) for k, (low, span) in enumerate(spans) for share in SETTINGS.split_levels]
    share, k, level = min((share_of_split(k, level), k, level) for k, level in levels)
    for fraction in (SETTINGS.split_levels[0] / 2, SETTINGS.split_levels[0] / 4):
        step = fraction * spans[k][1]
        nearby = [(share_of_split(k, each), each) for each in (level - step, level + step)]
        share, level = min([(share, level), *nearby])
    return [side for side in split_triangles(part, axes[k], level) if len(side)]


def _volume_samples(points: Array) -> tuple[Array, float]:
    """Return sample points, (k, 3), to estimate volumes of covers of points, and the volume of the sampled box."""
    frame = _principal_axes(points)
    low, high = (points @ frame).min(axis=0), (points @ frame).max(axis=0)
    # The additive recurrence of the generalised golden ratio in three dimensions, the root of x^4 = x + 1.
    shares = (np.arange(1, SETTINGS.grid + 1)[:, None] / 1.2207440846057596 ** np.arange(1, 4) + 0.5) % 1
    wide = 1.5 * np.maximum(high - low, 0.6 * float((high - low).max()))  # nearly every cover is in the box
    return np.asarray(((low + high) / 2 + (shares - 0.5) * wide) @ frame.T), float(np.prod(wide))


def _covered_share(shapes: Sequence[CoverShape], grid: Array) -> float:
    """Return the fraction of grid points that lie in at least one of the shapes, an estimate of the covered volume."""
    if not len(grid):
        return 0.0
    return float((np.min([exceedance(each, grid) for each in shapes], axis=0) <= 0).sum() / len(grid))


def _representative_triangles(triangles: Array, frame: Array) -> Array:
    """Return all triangles of a small mesh; of a large one, the largest ones and extreme vertices (as triangles)."""
    if len(triangles) <= SETTINGS.max_triangles:
        return triangles
    length = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    largest = triangles[np.argsort(-length, kind="stable")[: SETTINGS.max_triangles]]
    points = triangles.reshape(-1, 3)
    return np.concatenate([largest, np.repeat(points[_extreme_indices(points, frame)][:, None], 3, axis=1)])


def split_triangles(triangles: Array, axis: Array, level: float) -> tuple[Array, Array]:
    """Split triangles, shape (m, 3, 3), at the plane axis . x = level; return the lower and the upper triangles."""
    heights = triangles @ axis - level
    below = heights <= 0
    count = below.sum(axis=1)
    low, high = [triangles[count == 3]], [triangles[count == 0]]
    for lone, one_side, other_side in ((below, low, high), (~below, high, low)):
        rows = np.flatnonzero(lone.sum(axis=1) == 1)
        order = (lone[rows].argmax(axis=1)[:, None] + np.arange(3)) % 3
        corners = triangles[rows[:, None], order]
        height = heights[rows[:, None], order]
        a, b, c = (corners[:, k] for k in range(3))
        h = height[:, :1]
        ab, ac = a + (b - a) * (h / (h - height[:, 1:2])), a + (c - a) * (h / (h - height[:, 2:]))
        one_side.append(np.stack([a, ab, ac], axis=1))
        other_side += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return np.concatenate(low), np.concatenate(high)


def _fit_box(points: Array, extreme_points: Array) -> Box:
    """Return a box of nearly least volume around points, with a face and an edge parallel to those of their hull."""
    frames = [_principal_axes(points)]
    try:
        hull = convex_hull(extreme_points)
    except ModelError:  # flat: the principal frame has its normal
        normals, corners = frames[0].T[2:], extreme_points
        edges = corners[1:] - corners[:-1]
    else:
        a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
        areas = np.cross(b - a, c - a)
        size = np.linalg.norm(areas, axis=1)
        largest = np.argsort(-size, kind="stable")[:48]
        normals, edges, corners = areas[largest] / size[largest, None], np.concatenate([b - a, c - b]), hull.vertices
    edges = edges[np.argsort(-np.linalg.norm(edges, axis=1), kind="stable")[:64]]
    for normal in normals:
        flat = edges - np.outer(edges @ normal, normal)
        length = np.linalg.norm(flat, axis=1)
        good = length > 1e-6
        if good.any():
            first = flat[good] / length[good, None]
            second = np.cross(normal, first)
            areas = np.ptp(corners @ first.T, axis=0) * np.ptp(corners @ second.T, axis=0)
            k = int(areas.argmin())
            frames.append(np.stack([first[k], second[k], normal], axis=1))
    volumes = [float(np.prod(np.maximum(np.ptp(corners @ frame, axis=0), SETTINGS.thinnest))) for frame in frames]
    frame = frames[int(np.argmin(volumes))]
    frame = frame if np.linalg.det(frame) > 0 else frame * [1, 1, -1]
    low, high = (points @ frame).min(axis=0), (points @ frame).max(axis=0)
    return Box(np.maximum(high - low, SETTINGS.thinnest), frame @ ((low + high) / 2), frame)


def _overhang(shape: CoverShape, hull: Array) -> float:
    """Return how far a shape extends beyond a convex hull, sampled at points of its surface, m."""
    around = _sphere_points(SETTINGS.samples)
    if isinstance(shape, Capsule):
        along = np.asarray(shape.end) - np.asarray(shape.start)
        ends = np.where((around @ along > 0)[:, None], shape.end, shape.start)
        samples = ends + shape.radius * around  # the points of a capsule farthest from a convex set lie on its caps
    else:
        samples = shape.core
    _, inner, outer = nearest_directions(np.broadcast_to(hull, (len(samples), *hull.shape)), samples[:, None])
    return float(np.linalg.norm(outer - inner, axis=1).max())


def _hull_vertices(points: Array) -> Array:
    """Return the vertices of the convex hull of a mesh's points; of a large mesh, only some extreme points."""
    if len(points) > SETTINGS.max_triangles:
        points = points[_extreme_indices(points, _principal_axes(points), 2 * SETTINGS.extremes)]
    try:
        return convex_hull(points).vertices
    except ModelError:  # flat: no hull with a volume
        return points


def _principal_axes(points: Array) -> Array:
    """Return the principal axes of points as columns of a rotation matrix, the axis of largest variance first."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    axes = axes[:, ::-1]
    axes = axes * np.where(((centred @ axes) ** 3).sum(axis=0) < 0, -1, 1)
    return axes if np.linalg.det(axes) > 0 else axes * [1, 1, -1]


def _bases(axes: Array) -> Array:
    """Return rotation matrices whose last columns are the given unit axes. Shape (k, 3, 3)."""
    side = np.eye(3)[np.abs(axes).argmin(axis=1)]
    side = side - (side * axes).sum(axis=1, keepdims=True) * axes
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([side, np.cross(axes, side), axes], axis=2)


@cache
def _sphere_points(count: int, half: bool = False) -> Array:
    """Return unit vectors spread evenly over a sphere or hemisphere by the golden angle. Shape (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1 - k / count if half else 1 - 2 * k / count
    angle = np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _extreme_indices(points: Array, frame: Array, count: int = SETTINGS.extremes) -> Any:
    """Return the indices of points that are extreme in one of `count` directions, where `count` is a multiple of 32."""
    if len(points) <= count:
        return np.arange(len(points))
    directions = np.split(_sphere_points(count) @ frame.T, count // 32)  # in blocks, which bounds the memory
    return np.unique(np.concatenate([(each @ points.T).argmax(axis=1) for each in directions]))


def _to_mesh_units(shape: CoverShape, middle: Array, size: float) -> CoverShape:
    """Convert a shape from coordinates scaled to mesh size 1 to mesh units; enlarge it by a rounding error bound."""
    margin = 16 * float(np.finfo(float).eps * (np.abs(middle).max() + size))
    if isinstance(shape, Capsule):
        return Capsule(shape.radius * size + margin, middle + size * shape.start, middle + size * shape.end)
    return Box(shape.size * size + 2 * margin, middle + size * shape.position, shape.rotation)


def _to_json(each: Cover) -> dict[str, Any]:
    names = ("radius", "start", "end") if isinstance(each.shape, Capsule) else ("size", "position", "rotation")
    return {name: np.asarray(getattr(each.shape, name)).tolist() for name in names} | {"overhang": each.overhang}


def _from_json(value: Any, points: Array) -> tuple[Cover, ...] | None:
    """Return the covers read from a cache entry, or None if they are invalid or miss a point of the mesh."""
    if not isinstance(value, list) or not 0 < len(value) <= SETTINGS.parts:
        return None
    try:
        covers = []
        for each in value:
            fields = {name: entry for name, entry in each.items() if name != "overhang"}
            covers.append(Cover(Capsule(**fields) if "radius" in fields else Box(**fields), float(each["overhang"])))
    except (AttributeError, KeyError, TypeError, ValueError):  # a ModelError is a ValueError
        return None
    enclosed = np.min([exceedance(each.shape, points) for each in covers], axis=0) <= 0
    return tuple(covers) if enclosed.all() else None
