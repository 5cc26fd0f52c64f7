"""A mesh covered by a few capsules, or by one box: what distances are cheap and exact for.

One capsule of least volume is fitted to the mesh. Then the mesh is cut across where that lowers the volume of what is
covered most, each side gets a capsule of its own, and so on up to a few parts; as many are kept as are worth it. A
box is taken instead where it is clearly smaller: distances of boxes take many times longer.
Every triangle, cut at the planes, lies in the capsule of its part, and so do all points that a closed surface encloses:
from a point between two planes of a cut a line parallel to the planes meets the surface between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import minimize

from models.arrays import Array, ArrayInput, checked_array, checked_indices
from models.cache import cache_key, load_value, source_version, store_value
from models.errors import ModelError
from models.shapes.hull import convex_hull, nearest_directions
from models.shapes.shapes import Box, Capsule


@dataclass(frozen=True)
class CoverSettings:
    """How far covers are searched. Lengths and volumes are relative to those of the mesh, whose largest extent is 1.

    Attributes:
        parts: Capsules at most: distances of more of them cost more than their tighter fit saves.
        worth_a_part: By how much the volume covered must fall for each part more; by less where the largest overhang
            falls, too, of which the fourth root counts.
        worth_a_box: Share of the volume covered by capsules below which a box is taken, whose distances cost more.
        cuts: Where cuts are tried, shares of the extent along an axis; the best is then moved by halves of the first.
        growth: By which covers are larger than the fit: more than rounding takes away.
        thinnest: Thickness of a box at least, which must not be zero.
        directions: Axes at which capsules begin, on half a sphere.
        extremes: Directions in which a point that is farthest takes part in a fit, a multiple of 32.
        simplex: The first steps of a search: two slopes of the axis, its place across, root of the excess radius.
        parameter_tolerance, volume_tolerance: Of these parameters, and share of the volume, at which it ends.
        radii: Radii at which a search may begin, of that of the cylinder around all.
        sifted: Triangles that cuts are tried on: the largest, and the corners that are farthest out.
        grid: Points, of which those in a cover tell its volume, to about a hundredth.
        samples: Points of a cover's surface at which its overhang is measured.
    """

    parts: int = 3
    worth_a_part: float = 1.07
    worth_a_box: float = 0.7
    cuts: tuple[float, ...] = (0.12, 0.25, 0.38, 0.5, 0.62, 0.75, 0.88)
    growth: float = 1e-9
    thinnest: float = 1e-6
    directions: int = 48
    extremes: int = 256
    simplex: tuple[float, ...] = (0.25, 0.25, 0.05, 0.05, 0.2)
    parameter_tolerance: float = 4e-3
    volume_tolerance: float = 4e-4
    radii: tuple[float, ...] = (1.0, 1.02, 1.06, 1.15, 1.3)
    sifted: int = 1500
    grid: int = 6000
    samples: int = 150


SETTINGS = CoverSettings()

Covering: TypeAlias = Capsule | Box


@dataclass(frozen=True, eq=False)
class Cover:
    """One of the shapes that cover a mesh.

    Attributes:
        shape: Capsule or box in the frame of the mesh.
        overhang: How far it stands out of the convex hull of the mesh, m: at some points of its surface.
    """

    shape: Covering
    overhang: float


def cover(vertices: ArrayInput, faces: ArrayInput) -> tuple[Cover, ...]:
    """Capsules, or a box, in which every point of a mesh lies.

    The same mesh has the same cover. It is fitted once and kept in a file by its content, see `models.cache`.

    Args:
        vertices: Shape (n, 3), m.
        faces: Triangles of vertices. Shape (m, 3).

    Raises:
        ModelError: Wrong shapes, something that is not finite, faces of no vertices, no triangle.
    """
    points = checked_array(vertices, ("vertices", 3), "cover", "vertices")
    corners = checked_indices(faces, len(points), "cover", "faces")
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        message = f"cover: faces have shape {corners.shape}, expected (m, 3)"
        raise ModelError(message, name="faces", value=faces, limit=("m", 3))
    triangles = points[corners]
    key = cache_key(source_version(__name__), "cover", triangles)
    known = _read(load_value(key), triangles.reshape(-1, 3))
    if known is None:
        known = fitted(triangles)
        store_value(key, [_written(each) for each in known])
    return known


def fitted(triangles: Array) -> tuple[Cover, ...]:
    """The cover of triangles, shape (m, 3, 3), m, whether it is kept or not."""
    middle, size = _middle(triangles.reshape(-1, 3))
    unit = (triangles - middle) / size
    points = _points(unit)
    hull = _hull_corners(points)
    outermost = points[_farthest(points, _principal(points))]
    grid, room = _grid(points)
    parts, capsules = [unit], [_capsule(points)]
    choices: list[tuple[float, int, list[Covering]]] = []
    whole = far = 1.0
    while True:
        shapes: list[Covering] = [_grown(each, _points(part)) for each, part in zip(capsules, parts, strict=True)]
        volume, out = _covered(shapes, grid), max(_overhang(each, hull) for each in shapes)
        whole, far = (whole, far) if choices else (max(volume, 1e-12), max(out, 1e-12))
        score = volume / whole * min(1.0, out / far) ** 0.25 * SETTINGS.worth_a_part ** (len(parts) - 1)
        choices.append((score, len(parts), shapes))
        if len(parts) == SETTINGS.parts:
            break
        others = [capsules[:k] + capsules[k + 1 :] for k in range(len(parts))]
        found = [_best_cut(part, others[k], capsules[k], grid) for k, part in enumerate(parts)]
        least, k = min((cut[0], k) for k, cut in enumerate(found))
        if not np.isfinite(least):
            break
        _, parts[k : k + 1], capsules[k : k + 1] = found[k]
    shapes = min(choices, key=lambda each: each[0])[2]
    box = _box(points, outermost)
    if float(np.prod(box.size)) < SETTINGS.worth_a_box * room * _covered(shapes, grid):
        shapes = [_grown_box(box, points)]
    return tuple(Cover(_scaled(each, middle, size), size * _overhang(each, hull)) for each in shapes)


def inside(shape: Covering, points: Array) -> Array:
    """By how much points lie outside of a capsule or box: zero or below for those inside. Shape (n,), m."""
    if isinstance(shape, Capsule):
        return np.asarray(_to_segment(points, np.asarray(shape.start), np.asarray(shape.end)) - shape.radius)
    own = np.abs((points - shape.position) @ shape.rotation) - shape.size / 2
    return np.asarray(own.max(axis=1))


# ------------------------------------------------------------------------------------------------- one capsule


def _capsule(points: Array) -> Capsule:
    """The capsule of least volume around points, as far as the search finds it; those farthest out tell it."""
    frame = _principal(points)
    few = points[_farthest(points, frame)]
    bases = _bases(np.concatenate([frame.T, _sphere(SETTINGS.directions, half=True) @ frame.T]))
    volumes, centres, excess = _quick(few, bases)
    found = []
    for k in np.argsort(volumes, kind="stable")[:2]:
        own, start = few @ bases[k], np.array([0.0, 0.0, *centres[k], np.sqrt(excess[k])])
        result = minimize(
            lambda x, own=own: float(_measured(own, x[None])[0][0]),
            start,
            method="Nelder-Mead",
            options={
                "initial_simplex": start + np.vstack([np.zeros(5), np.diag(SETTINGS.simplex)]),
                "xatol": SETTINGS.parameter_tolerance,
                "fatol": SETTINGS.volume_tolerance * float(volumes[k]),
            },
        )
        found.append((float(result.fun), int(k), result.x))
    _, k, best = min(found, key=lambda each: each[:2])
    return _grown(_capsule_of(few, best, bases[k]), points)


def _measured(points: Array, parameters: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Capsules about axes near z: volume, radius, both ends along the axis, the axis, a point on it.

    Parameters are the slopes of the axis, its place across, and what makes the radius larger than it need be: a radius
    beyond that of the cylinder around all lets the caps end earlier. Shape (k, 5).
    """
    a, b, x, y, fat = parameters.T
    one, none = np.ones_like(a), np.zeros_like(a)
    axis = np.stack([a, b, one], axis=1) / np.sqrt(a**2 + b**2 + 1)[:, None]
    side = np.stack([one, none, -a], axis=1) / np.sqrt(1 + a**2)[:, None]
    other = np.cross(axis, side)
    along = axis @ points.T
    across = (side @ points.T - x[:, None]) ** 2 + (other @ points.T - y[:, None]) ** 2
    radius = np.sqrt(across.max(axis=1)) * (1 + fat**2)
    caps = np.sqrt(np.maximum(radius[:, None] ** 2 - across, 0))
    low, high = (along + caps).min(axis=1), (along - caps).max(axis=1)
    middle = (low + high) / 2
    low, high = np.where(low > high, middle, low), np.where(low > high, middle, high)  # a ball holds them all
    volume = np.pi * radius**2 * (high - low + 4 / 3 * radius)
    return volume, radius, low, high, axis, side * x[:, None] + other * y[:, None]


def _quick(points: Array, bases: Array) -> tuple[Array, Array, Array]:
    """Volumes of capsules about the last axes of bases, their places across, and the share added to the radius.

    Bases: shape (k, 3, 3), as of `_bases`.
    """
    own = np.einsum("pi,kij->kpj", points, bases)
    across, along = own[:, :, :2], own[:, :, 2]
    centres = (across.min(axis=1) + across.max(axis=1)) / 2
    rows = np.arange(len(bases))
    for k in range(24):  # towards the farthest point by less and less: the least circle (Badoiu & Clarkson 2003)
        farthest = ((across - centres[:, None]) ** 2).sum(axis=2).argmax(axis=1)
        centres = centres + (across[rows, farthest] - centres) / (k + 4)
    distances = ((across - centres[:, None]) ** 2).sum(axis=2)
    volumes = []
    for factor in SETTINGS.radii:
        radius = np.sqrt(distances.max(axis=1)) * factor
        caps = np.sqrt(np.maximum(radius[:, None] ** 2 - distances, 0))
        length = np.maximum((along - caps).max(axis=1) - (along + caps).min(axis=1), 0)
        volumes.append(np.pi * radius**2 * (length + 4 / 3 * radius))
    found = np.array(volumes)
    best = found.argmin(axis=0)
    return found[best, rows], centres, np.array(SETTINGS.radii)[best] - 1


def _quick_capsule(points: Array, bases: Array) -> Capsule:
    """The best capsule about any of the last axes of some bases."""
    volumes, centres, excess = _quick(points, bases)
    k = int(volumes.argmin())
    start = np.array([[0.0, 0.0, *centres[k], np.sqrt(excess[k])]])
    return _capsule_of(points, start[0], bases[k])


def _capsule_of(points: Array, parameters: Array, basis: Array) -> Capsule:
    _, radius, low, high, axis, place = (each[0] for each in _measured(points @ basis, parameters[None]))
    return Capsule(float(radius) + SETTINGS.growth, basis @ (place + low * axis), basis @ (place + high * axis))


def _grown(capsule: Capsule, points: Array) -> Capsule:
    """The capsule with a radius that every point is proven to lie in, and a little more."""
    start, end = np.asarray(capsule.start), np.asarray(capsule.end)
    radius = max(capsule.radius, float(_to_segment(points, start, end).max())) + SETTINGS.growth
    return Capsule(radius, start, end)


def _to_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-300), 0, 1)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


# ------------------------------------------------------------------------------------------------------- cuts


def _best_cut(
    part: Array, others: list[Capsule], capsule: Capsule, grid: Array
) -> tuple[float, list[Array], list[Capsule]]:
    """The plane across an axis by which a part's two capsules and the others cover least.

    Returns:
        The share of the grid that is covered, the two sides and their capsules; inf and the part itself where no plane
        cuts it.
    """
    points = _points(part)
    frame = _principal(points)
    axes = list(frame.T)
    along = np.asarray(capsule.end) - np.asarray(capsule.start)
    along = along / max(float(np.linalg.norm(along)), 1e-300)
    if 0 < np.abs(along @ frame).max() < 0.98:
        axes.append(along)
    bases = _bases(np.concatenate([frame.T, _sphere(SETTINGS.directions // 2, half=True) @ frame.T]))
    sifted = _sifted(part, frame)
    free = grid[np.min([inside(each, grid) for each in others], axis=0) > 0] if others else grid

    def covered(fits: list[Capsule]) -> float:
        return 1 - (1 - _covered(fits, free)) * len(free) / len(grid)

    def tried(k: int, level: float) -> float:
        sides = [_points(side) for side in cut(sifted, axes[k], level) if len(side)]
        if len(sides) < 2:
            return np.inf
        return covered([_quick_capsule(side[_farthest(side, frame)], bases) for side in sides])

    spans = [(float((points @ axis).min()), float(np.ptp(points @ axis))) for axis in axes]
    levels = [(k, low + share * span) for k, (low, span) in enumerate(spans) for share in SETTINGS.cuts]
    _, k, level = min((tried(k, level), k, level) for k, level in levels)
    for share in (SETTINGS.cuts[0] / 2, SETTINGS.cuts[0] / 4):
        step = share * spans[k][1]
        _, level = min((tried(k, each), each) for each in (level - step, level, level + step))
    sides = [side for side in cut(part, axes[k], level) if len(side)]
    if len(sides) < 2:
        return np.inf, [part], [capsule]
    fits = [_capsule(_points(side)) for side in sides]
    return covered(fits), sides, fits


def _grid(points: Array) -> tuple[Array, float]:
    """Points spread evenly in a box half as large again as some points, which holds their covers but for a little.

    Returns:
        The points, shape (k, 3), and the volume of the box.
    """
    frame = _principal(points)
    low, high = (points @ frame).min(axis=0), (points @ frame).max(axis=0)
    # The additive recurrence of the generalised golden ratio in three dimensions, the root of x^4 = x + 1.
    shares = (np.arange(1, SETTINGS.grid + 1)[:, None] / 1.2207440846057596 ** np.arange(1, 4) + 0.5) % 1
    wide = 1.5 * np.maximum(high - low, 0.6 * float((high - low).max()))
    return np.asarray(((low + high) / 2 + (shares - 0.5) * wide) @ frame.T), float(np.prod(wide))


def _covered(shapes: Sequence[Covering], grid: Array) -> float:
    """Share of the points of a grid that some shape holds."""
    if not len(grid):
        return 0.0
    return float((np.min([inside(each, grid) for each in shapes], axis=0) <= 0).sum() / len(grid))


def _sifted(triangles: Array, frame: Array) -> Array:
    """The triangles, or where they are many the largest of them and the farthest corners, as triangles of no size."""
    if len(triangles) <= SETTINGS.sifted:
        return triangles
    length = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    largest = triangles[np.argsort(-length, kind="stable")[: SETTINGS.sifted]]
    points = _points(triangles)
    return np.concatenate([largest, np.repeat(points[_farthest(points, frame)][:, None], 3, axis=1)])


def cut(triangles: Array, axis: Array, level: float) -> tuple[Array, Array]:
    """Triangles cut by the plane axis x = level: what lies below and what above. Shapes (m, 3, 3)."""
    heights = triangles @ axis - level
    below = heights <= 0
    count = below.sum(axis=1)
    low, high = [triangles[count == 3]], [triangles[count == 0]]
    for lone, one, two in ((below, low, high), (~below, high, low)):
        which = np.flatnonzero(lone.sum(axis=1) == 1)
        first = lone[which].argmax(axis=1)
        order = (first[:, None] + np.arange(3)) % 3
        corners = triangles[which[:, None], order]
        height = heights[which[:, None], order]
        a, b, c = (corners[:, k] for k in range(3))
        h = height[:, :1]
        ab, ac = a + (b - a) * (h / (h - height[:, 1:2])), a + (c - a) * (h / (h - height[:, 2:]))
        one.append(np.stack([a, ab, ac], axis=1))
        two += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return np.concatenate(low), np.concatenate(high)


# ------------------------------------------------------------------------------------------------------- a box


def _box(points: Array, outermost: Array) -> Box:
    """A box around points of nearly the least volume.

    One of its faces lies along a face of the hull of the outermost points, one of its edges along an edge.
    """
    frames = [_principal(points)]
    try:
        hull = convex_hull(outermost)
    except ModelError:  # flat: the principal frame has its normal
        normals, corners = frames[0].T[2:], outermost
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


def _grown_box(box: Box, points: Array) -> Box:
    """The box with edges that every point is proven to lie in, and a little more."""
    return Box(
        box.size + 2 * max(0.0, float(inside(box, points).max())) + 2 * SETTINGS.growth, box.position, box.rotation
    )


# --------------------------------------------------------------------------------------------------- overhang


def _overhang(shape: Covering, hull: Array) -> float:
    """Largest distance of points of a shape's surface from the hull of some points."""
    around = _sphere(SETTINGS.samples)
    if isinstance(shape, Capsule):
        along = np.asarray(shape.end) - np.asarray(shape.start)
        ends = np.where((around @ along > 0)[:, None], shape.end, shape.start)
        samples = ends + shape.radius * around  # the farthest points of a capsule from a convex set are on its caps
    else:
        samples = shape.core
    _, inner, outer = nearest_directions(np.broadcast_to(hull, (len(samples), *hull.shape)), samples[:, None])
    return float(np.linalg.norm(outer - inner, axis=1).max())


def _hull_corners(points: Array) -> Array:
    """Of a large mesh those of its outermost points alone: their hull is no larger, so that an overhang is not less."""
    if len(points) > SETTINGS.sifted:
        points = points[_farthest(points, _principal(points), 2 * SETTINGS.extremes)]
    try:
        return convex_hull(points).vertices
    except ModelError:  # flat: no hull with a volume
        return points


# ---------------------------------------------------------------------------------------------------- helpers


def _points(triangles: Array) -> Array:
    return triangles.reshape(-1, 3)


def _middle(points: Array) -> tuple[Array, float]:
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, max(float((high - low).max()), 1e-12)


def _principal(points: Array) -> Array:
    """Axes of points, the longest extent first, as columns of a rotation."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    axes = axes[:, ::-1]
    axes = axes * np.where(((centred @ axes) ** 3).sum(axis=0) < 0, -1, 1)
    return axes if np.linalg.det(axes) > 0 else axes * [1, 1, -1]


def _bases(axes: Array) -> Array:
    """Rotations whose last columns are unit axes. Shape (k, 3, 3)."""
    side = np.eye(3)[np.abs(axes).argmin(axis=1)]
    side = side - (side * axes).sum(axis=1, keepdims=True) * axes
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([side, np.cross(axes, side), axes], axis=2)


def _sphere(count: int, half: bool = False) -> Array:
    """Unit vectors spread evenly on the sphere or on a half of it, by the golden angle. Shape (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1 - k / count if half else 1 - 2 * k / count
    angle = np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _farthest(points: Array, frame: Array, count: int = SETTINGS.extremes) -> Any:
    """Indices of the points that are farthest in some of `count` directions, a multiple of 32."""
    if len(points) <= count:
        return np.arange(len(points))
    directions = np.split(_sphere(count) @ frame.T, count // 32)  # in turn: a large mesh fills the memory
    return np.unique(np.concatenate([(points @ each.T).argmax(axis=0) for each in directions]))


def _scaled(shape: Covering, middle: Array, size: float) -> Covering:
    """Back where the mesh is, larger by what rounding may take there."""
    more = 16 * float(np.finfo(float).eps * (np.abs(middle).max() + size))
    if isinstance(shape, Capsule):
        return Capsule(shape.radius * size + more, middle + size * shape.start, middle + size * shape.end)
    return Box(shape.size * size + 2 * more, middle + size * shape.position, shape.rotation)


def _written(each: Cover) -> dict[str, Any]:
    if isinstance(each.shape, Capsule):
        own: dict[str, Any] = {"radius": each.shape.radius}
        own |= {what: np.asarray(getattr(each.shape, what)).tolist() for what in ("start", "end")}
    else:
        own = {what: np.asarray(getattr(each.shape, what)).tolist() for what in ("size", "position", "rotation")}
    return own | {"overhang": each.overhang}


def _read(value: Any, points: Array) -> tuple[Cover, ...] | None:
    """Covers that were kept, where they are whole and hold the mesh's points still."""
    if not isinstance(value, list) or not 0 < len(value) <= SETTINGS.parts:
        return None
    try:
        found = []
        for each in value:
            own = {what: entry for what, entry in each.items() if what != "overhang"}
            found.append(Cover(Capsule(**own) if "radius" in own else Box(**own), float(each["overhang"])))
    except (AttributeError, KeyError, TypeError, ValueError):  # a ModelError is a ValueError
        return None
    held = np.min([inside(each.shape, points) for each in found], axis=0) <= 0
    return tuple(found) if held.all() else None
