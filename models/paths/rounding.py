"""Rounding of every corner of a path by blends, whose sizes are given as distances or follow from a tolerance.

The remaining distance of a blend is that from its vertex to both of its ends, along the segments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.checks import Array, ArrayInput, require
from models.errors import ModelError, ModelWarning
from models.paths.blends import (
    PAPER_SHAPE,
    BlendKind,
    Ends,
    best_shape,
    cells,
    checked_shape,
    corner_shape,
    cubic,
    polynomial,
    quintic,
)
from models.paths.path import Path
from models.paths.smooth_path import SmoothPath
from models.paths.splines import Spline
from models.spatial import FULL_TURN

Overlap: TypeAlias = Literal["shrink", "refuse"]


@dataclass(frozen=True)
class RoundingSettings:
    """Settings of the algorithms that round the corners of a path."""

    samples: int = 33  # samples of a blend, of the neighbourhood of its maximum, and of one turn of a helix
    reserve: float = 1e-3  # fraction of the tolerance reserved for deviations between the samples
    iterations: int = 60  # largest number of remaining distances tried, and of rounds that shrink overlapping blends
    newton_iterations: int = 4  # Newton iterations to the closest point of a helix or spline
    least_slope: float = 0.1  # slope of the condition of the closest point below which a step is damped
    block: int = 500  # corners processed at once, which bounds the memory
    shortest: float = 1e-12  # relative length below which the rest between two blends is a rounding error
    named: int = 12  # largest number of vertices named in a warning


SETTINGS = RoundingSettings()


class _Corners(NamedTuple):
    """Vertices of a path, and the kind and shape factors of the blends that round them."""

    path: Path
    kind: BlendKind
    shape: Array  # shape factors. Shape (V,).
    vertices: NDArray[np.intp]  # indices of the vertices; 0 is the end of the first segment. Shape (V,).

    def subset(self, chosen: NDArray[np.intp] | slice) -> _Corners:
        """Return only the corners with the given indices."""
        return self._replace(shape=self.shape[chosen], vertices=self.vertices[chosen])

    @property
    def curved(self) -> NDArray[np.intp]:
        """Indices of the corners at which at least one of the two segments is an arc, a helix or a spline."""
        segments = (self.path.curvature > 0) | self.path.is_spline
        return np.flatnonzero(segments[self.vertices] | segments[self.vertices + 1])

    def ends(self, remaining: Array) -> Ends:
        """Return point, unit tangent and curvature vector of the path at both ends of each blend. Shape (V, 3) each."""
        before = self.vertices
        p0, n0, k0, _ = self.path.at(before, self.path.lengths[before] - remaining)
        p1, n1, k1, _ = self.path.at(before + 1, remaining)
        return p0, n0, k0, p1, n1, k1

    def blends(self, remaining: Array) -> Array:
        """Return the coefficients of blends for given distances from vertex to blend end. Shape (V, 6, 3)."""
        p0, n0, k0, p1, n1, k1 = self.ends(remaining)
        rate = (self.shape * remaining)[:, None]
        if self.kind == "cubic":
            return cubic(p0, rate * n0, p1, rate * n1)
        return quintic((p0, rate * n0, rate**2 * k0), (p1, rate * n1, rate**2 * k1))

    def with_best_shape(self, remaining: Array) -> _Corners:
        """Return the corners with the shape factors that give each quintic blend the least peak curvature."""
        shape, curved = corner_shape(self.path.corner_angles()[self.vertices]), self.curved
        shape[curved] = best_shape(self.subset(curved).ends(remaining[curved]), remaining[curved])
        return self._replace(shape=shape)


def _size_blends(
    corners: _Corners, remaining: ArrayInput | None, deviation: ArrayInput | None, overlap: Overlap, free: bool
) -> tuple[_Corners, Array]:
    """Return the corners, with best shape factors if `free`, and the distances (m) from vertices to blend ends.

    Other arguments as for `smooth`.
    """
    require.choice("path: overlap", overlap, get_args(Overlap))
    if (remaining is None) == (deviation is None):
        message = "give either the remaining distance or the deviation, and not both"
        raise ModelError(message, name="deviation", value=deviation)
    path, count = corners.path, len(corners.vertices)
    if remaining is not None:
        requested = require.broadcast("path: remaining", remaining, count, "vertices", unit="m", sign="positive")
        distances = _without_overlap(path, requested, overlap)
        _warn_if_smaller(path, requested, distances)
        return corners.with_best_shape(distances) if free else corners, distances
    tolerance = require.broadcast("path: deviation", deviation, count, "vertices", unit="m", sign="positive")
    distances = _within_tolerance(corners, tolerance, overlap)
    if free and corners.curved.size:
        corners = corners.with_best_shape(distances)
        distances = _within_tolerance(corners, tolerance, overlap)
    return corners, distances


def _within_tolerance(corners: _Corners, tolerance: Array, overlap: Overlap) -> Array:
    """Return the largest distances from vertex to blend end, (V,), m, for which each blend is within its tolerance."""
    path = corners.path
    # at most the segment length, so that every trial curve exists
    longest = np.minimum(path.lengths[:-1], path.lengths[1:])
    distances = _without_overlap(path, _initial_distances(corners, tolerance, longest), overlap)
    # next to an arc the vertex need not be the farthest point, nor a smaller blend the closer one
    curved = corners.curved
    aim = tolerance * (1 - SETTINGS.reserve)
    for _ in range(SETTINGS.iterations):
        subset = corners.subset(curved)
        sizes = distances[curved]
        over = np.maximum(_task_to_blend(subset, sizes), _deviations(subset, sizes)[1]) / tolerance[curved]
        curved, over = curved[over > 1], over[over > 1]
        if not curved.size:
            break
        aim[curved] *= (1 - SETTINGS.reserve) / over
        distances[curved] = _solve_distances(corners.subset(curved), aim[curved], distances[curved])
    return distances


def _warn_if_smaller(path: Path, requested: Array, distances: Array) -> None:
    smaller = np.flatnonzero(distances < requested * (1 - 1e-12))
    if smaller.size:
        worst = int((distances / requested).argmin())
        vertices = tuple((smaller + 1).tolist())
        names = ", ".join(str(vertex) for vertex in vertices[: SETTINGS.named])
        names += f" and {len(vertices) - SETTINGS.named} more" if len(vertices) > SETTINGS.named else ""
        size = float(distances[worst])
        message = (
            f"overlap='shrink': blends are smaller than requested at vertices {names}; at vertex {worst + 1} "
            f"{size:g} of {requested[worst]:g} m, between segments {path.lengths[worst]:g} and "
            f"{path.lengths[worst + 1]:g} m long"
        )
        warn(ModelWarning(message, name=f"vertex {worst + 1}", value=vertices, limit=size), stacklevel=4)


def _without_overlap(path: Path, requested: Array, overlap: Overlap) -> Array:
    if not requested.size:
        return requested
    padded = np.concatenate([[0.0], requested, [0.0]])
    demand = padded[:-1] + padded[1:]  # of each segment
    # rounding errors, such as of 0.1 + 0.2 against 0.3, are no overlap
    factor = np.where(demand > path.lengths * (1 + 1e-12), path.lengths / demand, 1.0)
    if overlap == "refuse" and factor.min() < 1:
        i = int(factor.argmin())
        length = float(path.lengths[i])
        message = (
            f"segment {i}, {length:g} m long, is shorter than the blends at its ends, which take {demand[i]:g} m; "
            "use a smaller remaining distance or overlap='shrink'"
        )
        raise ModelError(message, name=f"segment {i}", value=float(demand[i]), limit=length)
    return np.asarray(requested * np.minimum(factor[:-1], factor[1:]))


def _initial_distances(corners: _Corners, tolerance: Array, longest: Array) -> Array:
    distances, arcs = longest.copy(), corners.curved
    # between two lines the deviation is proportional to the remaining distance, so one trial suffices
    lines = np.setdiff1d(np.arange(len(longest)), arcs, assume_unique=True)
    if lines.size:
        corner, legs = _deviations(corners.subset(lines), longest[lines])
        largest = np.maximum(corner, legs * (1 + SETTINGS.reserve))
        with np.errstate(divide="ignore"):
            distances[lines] = longest[lines] * np.minimum(1.0, tolerance[lines] / largest)
    if arcs.size:
        aim = tolerance[arcs] * (1 - SETTINGS.reserve)
        distances[arcs] = _solve_distances(corners.subset(arcs), aim, longest[arcs])
    return distances


def _solve_distances(corners: _Corners, tolerance: Array, longest: Array) -> Array:
    """Return distances from vertex to blend end, at most `longest`, at which the deviation is within `tolerance`."""
    low, high, trial = np.zeros_like(longest), longest.copy(), longest.copy()
    todo = np.arange(len(longest))
    for number in range(SETTINGS.iterations):
        ratio = np.maximum(*_deviations(corners.subset(todo), trial[todo])) / tolerance[todo]
        fits = ratio <= 1
        low[todo] = np.where(fits, trial[todo], low[todo])
        high[todo] = np.where(fits, high[todo], trial[todo])
        unsettled = (~fits | (ratio < 1 - SETTINGS.reserve)) & (trial[todo] < longest[todo]) | ~fits
        # the deviation is nearly proportional; bisect if that leaves the bracket, and in every fourth iteration
        aim = trial[todo] * (1 - SETTINGS.reserve / 2) / np.maximum(ratio, 1e-12)
        inside = (aim > low[todo]) & (aim < high[todo]) & (number % 4 != 3)
        trial[todo] = np.where(inside, aim, (low[todo] + high[todo]) / 2)
        todo = todo[unsettled]
        if not todo.size:
            break
    if (low <= 0).any():
        i = int((low <= 0).argmax())
        name = f"vertex {corners.vertices[i] + 1}"
        message = f"{name}: no blend stays within the deviation of {tolerance[i]:g} m; use a larger one"
        raise ModelError(message, name=name, limit=float(tolerance[i]))
    return low


def _deviations(corners: _Corners, remaining: Array) -> tuple[Array, Array]:
    """Return the distance of each vertex from its blend, and the largest distance of the blend from its two segments.

    Together they bound the deviation between smooth path and task in both directions. They are sampled uniformly and
    again about the maximum; the second is below the true value by at most 0.1 %. Shape (V,), m.
    """
    path, vertices, curves = corners.path, corners.vertices, corners.blends(remaining)
    u = np.linspace(0, 1, SETTINGS.samples)
    points = polynomial(curves[:, None], u[None, :])
    tip = path.start[vertices + 1][:, None]
    corner = np.linalg.norm(points - tip, axis=-1)
    to_task = _blend_to_task(path, vertices, points, remaining)

    def about(extreme: NDArray[np.intp]) -> Array:
        offsets = np.linspace(-1, 1, SETTINGS.samples) / (SETTINGS.samples - 1)
        return polynomial(curves[:, None], u[np.clip(extreme, 1, SETTINGS.samples - 2)][:, None] + offsets)

    closest = np.linalg.norm(about(corner.argmin(axis=1)) - tip, axis=-1)
    # the distance to the task has a kink where the closer segment changes
    farthest = _blend_to_task(path, vertices, about(to_task.argmax(axis=1)), remaining)
    return (np.minimum(corner.min(axis=1), closest.min(axis=1)), np.maximum(to_task.max(axis=1), farthest.max(axis=1)))


def _task_to_blend(corners: _Corners, remaining: Array) -> Array:
    """Return, for each of V blends, the largest distance of the replaced path points from the blend. Shape (V,), m."""
    path, result = corners.path, np.empty(len(remaining))
    u, v = np.linspace(0, 1, 4 * SETTINGS.samples), np.linspace(0, 1, SETTINGS.samples)
    for first in range(0, len(remaining), SETTINGS.block):
        part = slice(first, first + SETTINGS.block)
        subset, distances = corners.subset(part), remaining[part]
        index = subset.vertices
        tip = path.start[index + 1][:, None]
        points = polynomial(subset.blends(distances)[:, None], u) - tip
        flat, along = np.repeat(index, len(v)), distances[:, None] * v
        before = path.at(flat, (path.lengths[index][:, None] - along).ravel())[0]
        after = path.at(flat + 1, along.ravel())[0]
        task = np.concatenate([x.reshape(len(index), len(v), 3) for x in (before, after)], axis=1) - tip
        square = (points**2).sum(axis=-1)[:, None] - 2 * task @ points.transpose(0, 2, 1)
        nearest = np.clip(square.argmin(axis=2), 1, len(u) - 2)
        row = np.arange(len(index))[:, None]
        distance = np.full(nearest.shape, np.inf)
        for i, j in ((-1, 0), (0, 1)):
            start, end = points[row, nearest + i], points[row, nearest + j]
            chord, offset = end - start, task - start
            part_of = np.clip((offset * chord).sum(axis=-1) / (chord**2).sum(axis=-1), 0, 1)
            distance = np.minimum(distance, np.linalg.norm(offset - part_of[..., None] * chord, axis=-1))
        result[part] = distance.max(axis=1)
    return result


def _blend_to_task(path: Path, vertices: NDArray[np.intp], points: Array, remaining: Array) -> Array:
    """Return distances of points (V, S, 3) of V blends from the closer of the two path parts that a blend replaces."""
    lengths = path.lengths[vertices]
    before = _distance_to_segment(path, vertices, points, lengths - remaining, lengths)
    return np.minimum(before, _distance_to_segment(path, vertices + 1, points, np.zeros(len(vertices)), remaining))


def _distance_to_segment(path: Path, index: NDArray[np.intp], points: Array, first: Array, last: Array) -> Array:
    """Return distances (V, S), m, of points (V, S, 3) from V segments between the distances `first` and `last` (m)."""
    spatial = (path.torsion[index] != 0) | path.is_spline[index]
    if spatial.any():
        result = np.empty(points.shape[:2])
        for rows, distances in ((~spatial, _distance_to_segment), (spatial, _distance_to_curve)):
            if rows.any():
                result[rows] = distances(path, index[rows], points[rows], first[rows], last[rows])
        return result
    offset = points - path.start[index][:, None]
    along = np.einsum("vsi,vi->vs", offset, path.tangent[index])
    across = np.einsum("vsi,vi->vs", offset, path.normal[index])
    k = path.curvature[index][:, None]
    # angle about the center from the start, in the turn of the part's middle
    middle = (first + last)[:, None] / 2
    angle = np.arctan2(k * along, 1 - k * across)
    angle = k * middle + (angle - k * middle + np.pi) % (2 * np.pi) - np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(k > 0, angle / k, along)
    s = np.clip(distance, first[:, None], last[:, None])
    # the position by `screw`, without its derivatives
    turned = k * s / np.pi
    offset -= (s * np.sinc(turned))[..., None] * path.tangent[index][:, None]
    offset -= (k * s**2 / 2 * np.sinc(turned / 2) ** 2)[..., None] * path.normal[index][:, None]
    return np.asarray(np.sqrt(np.einsum("vsi,vsi->vs", offset, offset)))


def _distance_to_curve(path: Path, index: NDArray[np.intp], points: Array, first: Array, last: Array) -> Array:
    """Return the distances of points from parts of helices or splines, by Newton's method from the closest sample."""
    if len(index) > SETTINGS.block:
        parts = [slice(k, k + SETTINGS.block) for k in range(0, len(index), SETTINGS.block)]
        return np.concatenate([_distance_to_curve(path, index[p], points[p], first[p], last[p]) for p in parts])

    def at(s: Array) -> list[Array]:
        return [value.reshape(*s.shape, 3) for value in path.at(np.repeat(index, s.shape[1]), s.ravel())]

    rate = np.where(path.is_spline, 0.0, np.hypot(path.curvature, path.torsion))  # at its end a spline is nearly a line
    turns = float((rate[index] * (last - first)).max()) / FULL_TURN
    share = np.linspace(0, 1, int(SETTINGS.samples * (1 + turns)))
    places = first[:, None] + (last - first)[:, None] * share
    origin = path.start[index][:, None]
    curve_points = at(places)[0] - origin
    square = (curve_points**2).sum(axis=-1)[:, None] - 2 * (points - origin) @ curve_points.transpose(0, 2, 1)
    s = np.take_along_axis(places, square.argmin(axis=2), axis=1)
    for _ in range(SETTINGS.newton_iterations):
        position, tangent, bend, _ = at(s)
        slope = 1 + ((position - points) * bend).sum(axis=-1)
        s = s - ((position - points) * tangent).sum(axis=-1) / np.maximum(slope, SETTINGS.least_slope)
        s = np.clip(s, first[:, None], last[:, None])
    return np.asarray(np.linalg.norm(at(s)[0] - points, axis=-1))


def smooth(
    path: Path,
    remaining: ArrayInput | None = None,
    *,
    deviation: ArrayInput | None = None,
    kind: BlendKind = "quintic",
    shape: Any = None,
    overlap: Overlap = "shrink",
) -> SmoothPath:
    """Return a path with every corner rounded by a polynomial blend.

    Args:
        path: The path with corners.
        remaining: Distance (m) along the segments from a vertex to both ends of its blend, one for all vertices or one
            for each.
        deviation: Instead of `remaining`, the largest distance (m) between smooth path and task, in both directions.
            The blends are as large as it and the segments allow.
        kind: "quintic", whose curvature is continuous everywhere, or the paper's "cubic", whose curvature is continuous
            between lines only, and only with shape 3.
        shape: Shape factor, lambda of eq. (9): end tangents over the remaining distance; one for all vertices or one
            for each. None: the paper's 3 for a cubic; for a quintic the factor of least peak curvature at each vertex,
            which is the fastest, see `models.paths.blends`.
        overlap: "shrink" makes blends that would overlap on a segment smaller, "refuse" raises.

    Raises:
        ModelError: A distance, deviation or shape is not positive, blends overlap and are refused, or a blend has a
            cusp.

    Warns:
        ModelWarning: Blends are smaller than `remaining`; `value` has their vertices. With a `deviation` there is no
            warning, since smaller blends keep it too.
    """
    count = len(require.instance("smooth: path", path, Path).segments)
    require.choice("blend: kind", kind, get_args(BlendKind))
    free = shape is None and kind == "quintic"
    angles = path.corner_angles()
    factors = corner_shape(angles) if free else checked_shape(PAPER_SHAPE if shape is None else shape, kind, count - 1)
    corners = _Corners(path, kind, factors, np.arange(count - 1))
    corners, distances = _size_blends(corners, remaining, deviation, overlap, free)
    blends = corners.blends(distances)
    padded = np.concatenate([[0.0], distances, [0.0]])
    rests = path.lengths - padded[:-1] - padded[1:]
    long_enough = rests > SETTINGS.shortest * path.lengths
    splines = {
        i: segment.part(float(padded[i]), float(path.lengths[i] - padded[i + 1]))
        for i, segment in enumerate(path.segments)
        if isinstance(segment, Spline) and long_enough[i]
    }
    exact, vertices = np.flatnonzero(long_enough & ~path.is_spline), np.arange(count - 1)
    of_splines = np.repeat(list(splines), [len(np.asarray(each.coefficients)) for each in splines.values()]).astype(int)
    # pieces along the path: the rest of segment i, the blend at vertex i, the rest of segment i + 1
    order = np.argsort(np.concatenate([2 * exact, 2 * vertices + 1, 2 * of_splines]), kind="stable")
    segment = np.concatenate([exact, np.full(count - 1, -1), of_splines])[order]
    blend = np.concatenate([np.full(len(exact), -1), vertices, np.full(len(of_splines), -1)])[order]
    is_curve = order >= len(exact)
    curve = np.where(is_curve, np.cumsum(is_curve) - 1, -1)
    curves = np.concatenate([blends, *(np.asarray(each.coefficients) for each in splines.values())])
    coefficients = curves[order[is_curve] - len(exact)]
    curve_cells = cells(coefficients)
    lengths = rests[segment]
    lengths[is_curve] = np.bincount(curve_cells.curve, curve_cells.length, minlength=len(curves))
    bounds = np.concatenate([[0.0], np.cumsum(lengths)])
    smoothed = SmoothPath(
        path, kind, distances, corners.shape, coefficients, bounds, segment, blend, curve, splines, curve_cells
    )
    if path.turns:
        _check_turns(smoothed)
    return smoothed


def _check_turns(smoothed: SmoothPath) -> None:
    theta = smoothed.charts[1]
    largest = np.linalg.norm(theta, axis=2).sum(axis=1)  # bounds |theta| over the whole segment or blend
    if largest.max() > FULL_TURN:
        bounds = smoothed.bounds[:-1][largest > FULL_TURN]
        u = np.linspace(0, 1, 33)[:, None] ** np.arange(6)
        angle = np.linalg.norm(np.einsum("uk,pkc->puc", u, theta[largest > FULL_TURN]), axis=2).max(axis=1)
        if angle.max() > FULL_TURN:
            message = (
                f"the tool turns by {np.degrees(angle.max()):.4g} deg in the blend at "
                f"{bounds[int(angle.argmax())]:g} m; turn less or use a smaller remaining distance"
            )
            raise ModelError(message, name="orientation", value=float(angle.max()), limit=FULL_TURN)
