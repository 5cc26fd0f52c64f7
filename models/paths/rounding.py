"""Rounding every corner of a path: how large each blend is, by distances given or by a tolerance, without overlaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array, ArrayInput, checked_broadcast, checked_choice, checked_instance
from models.errors import ModelError, ModelWarning
from models.paths.arc_length import cells
from models.paths.blends import (
    PAPER_SHAPE,
    BlendKind,
    best_shape,
    checked_shape,
    corner_shape,
    cubic,
    polynomial,
    quintic,
)
from models.paths.path import Path
from models.paths.segments import screw
from models.paths.smooth_path import SmoothPath
from models.spatial import FULL_TURN

__all__ = ["Overlap", "smooth"]

Overlap: TypeAlias = Literal["shrink", "refuse"]


@dataclass(frozen=True)
class RoundingSettings:
    """How corners are rounded.

    Attributes:
        samples: Of a blend whose deviation is looked for, of the neighbourhood of its extreme, and of a turn of a helix
            on which a nearest place is looked for.
        kept_back: Share of the tolerance kept back for what lies between the samples.
        trials: Of remaining distances, and rounds in which neighbours that overlap shrink, at most.
        newton_steps: To a nearest place on a helix.
        gentlest: Slope of the condition for it below which a step is not trusted: near the axis of the helix.
        block: Corners handled at once, which bounds the memory.
        shortest: Rests of a segment between two blends that are shorter, over the segment, are dropped: rounding.
        shown: Vertices named in a warning.
    """

    samples: int = 33
    kept_back: float = 1e-3
    trials: int = 60
    newton_steps: int = 4
    gentlest: float = 0.1
    block: int = 500
    shortest: float = 1e-12
    shown: int = 12


SETTINGS = RoundingSettings()


class _Corners(NamedTuple):
    """Some vertices of a path, and what kind of blends are to round them.

    Attributes:
        shape: Shape factors. Shape (V,).
        vertices: 0 being the end of the first segment. Shape (V,).
    """

    path: Path
    kind: BlendKind
    shape: Array
    vertices: NDArray[np.intp]

    def some(self, chosen: NDArray[np.intp] | slice) -> _Corners:
        """Those of some indices."""
        return self._replace(shape=self.shape[chosen], vertices=self.vertices[chosen])

    @property
    def bent(self) -> NDArray[np.intp]:
        """Indices of those with an arc or a helix on either side."""
        curved = self.path.curvature > 0
        return np.flatnonzero(curved[self.vertices] | curved[self.vertices + 1])

    def ends(self, remaining: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Position, tangent and curvature vector at the start and at the end of the blends. Shape (V, 3) each."""
        before = self.vertices
        p0, n0, k0, _ = self.path.at(before, self.path.lengths[before] - remaining)
        p1, n1, k1, _ = self.path.at(before + 1, remaining)
        return p0, n0, k0, p1, n1, k1

    def blends(self, remaining: Array) -> Array:
        """Polynomials of the blends with some remaining distances, (V,). Shape (V, 6, 3)."""
        p0, n0, k0, p1, n1, k1 = self.ends(remaining)
        rate = (self.shape * remaining)[:, None]
        if self.kind == "cubic":
            return cubic(p0, rate * n0, p1, rate * n1)
        return quintic(p0, rate * n0, rate**2 * k0, p1, rate * n1, rate**2 * k1)

    def shaped(self, remaining: Array) -> _Corners:
        """The same with the shape that suits each best."""
        shape, bent = corner_shape(self.path.corner_angles()[self.vertices]), self.bent
        some = self.some(bent)
        shape[bent] = best_shape(*some.ends(remaining[bent]), remaining[bent])
        return self._replace(shape=shape)


def _sized(
    corners: _Corners, remaining: ArrayInput | None, deviation: ArrayInput | None, overlap: Overlap, free: bool
) -> tuple[_Corners, Array]:
    """The corners, shaped if that is free, and their remaining distances, (n - 1,), m. Arguments as of `smooth`."""
    checked_choice(overlap, get_args(Overlap), "path", "overlap")
    if (remaining is None) == (deviation is None):
        message = "give either the remaining distance or the deviation, not both and not neither"
        raise ModelError(message, name="deviation", value=deviation)
    path, count = corners.path, len(corners.vertices)
    if remaining is not None:
        wanted = checked_broadcast(remaining, count, "path", "remaining", "vertices", positive=True, unit="m")
        found = _without_overlap(path, wanted, overlap)
        _warn_of_smaller(path, wanted, found)
        return corners.shaped(found) if free else corners, found
    tolerance = checked_broadcast(deviation, count, "path", "deviation", "vertices", positive=True, unit="m")
    found = _within(corners, tolerance, overlap)
    if free and corners.bent.size:
        corners = corners.shaped(found)
        found = _within(corners, tolerance, overlap)
    return corners, found


def _within(corners: _Corners, tolerance: Array, overlap: Overlap) -> Array:
    """Remaining distances whose blends stay within the tolerance. Shape (V,), m."""
    path = corners.path
    # never longer than a segment, so that every trial is a curve that exists
    longest = np.minimum(path.lengths[:-1], path.lengths[1:])
    found = _without_overlap(path, _from_deviation(corners, tolerance, longest), overlap)
    # next to an arc the vertex need not be the farthest point, nor a smaller blend the nearer one
    bent = corners.bent
    aim = tolerance * (1 - SETTINGS.kept_back)
    for _ in range(SETTINGS.trials):
        some = corners.some(bent)
        over = np.maximum(_from_blend(some, found[bent]), _deviations(some, found[bent])[1]) / tolerance[bent]
        bent, over = bent[over > 1], over[over > 1]
        if not bent.size:
            break
        aim[bent] *= (1 - SETTINGS.kept_back) / over
        found[bent] = _fitted(corners.some(bent), aim[bent], found[bent])
    return found


def _warn_of_smaller(path: Path, wanted: Array, found: Array) -> None:
    smaller = np.flatnonzero(found < wanted * (1 - 1e-12))
    if smaller.size:
        worst = int((found / wanted).argmin())
        vertices = tuple((smaller + 1).tolist())
        shown = ", ".join(str(vertex) for vertex in vertices[: SETTINGS.shown])
        shown += f" and {len(vertices) - SETTINGS.shown} more" if len(vertices) > SETTINGS.shown else ""
        message = (
            f"overlap='shrink': blends are smaller than asked at vertices {shown}; at vertex {worst + 1} "
            f"{found[worst]:g} of {wanted[worst]:g} m, between segments {path.lengths[worst]:g} and "
            f"{path.lengths[worst + 1]:g} m long"
        )
        warn(ModelWarning(message, name=f"vertex {worst + 1}", value=vertices, limit=float(found[worst])), stacklevel=4)


def _without_overlap(path: Path, wanted: Array, overlap: Overlap) -> Array:
    if not wanted.size:
        return wanted
    padded = np.concatenate([[0.0], wanted, [0.0]])
    demand = padded[:-1] + padded[1:]  # of each segment
    # rounding, for example of 0.1 + 0.2 against 0.3, is no overlap
    factor = np.where(demand > path.lengths * (1 + 1e-12), path.lengths / demand, 1.0)
    if overlap == "refuse" and factor.min() < 1:
        i = int(factor.argmin())
        raise ModelError(
            f"segment {i}, {path.lengths[i]:g} m long, has no room for the blends at its ends, which take "
            f"{demand[i]:g} m; take a smaller remaining distance or overlap='shrink'",
            name=f"segment {i}",
            value=float(demand[i]),
            limit=float(path.lengths[i]),
        )
    return np.asarray(wanted * np.minimum(factor[:-1], factor[1:]))


def _from_deviation(corners: _Corners, tolerance: Array, longest: Array) -> Array:
    found, arcs = longest.copy(), corners.bent
    # between two lines the deviation is proportional to the remaining distance: one trial tells the ratio
    lines = np.setdiff1d(np.arange(len(longest)), arcs, assume_unique=True)
    if lines.size:
        some = corners.some(lines)
        corner, legs = _deviations(some, longest[lines])
        largest = np.maximum(corner, legs * (1 + SETTINGS.kept_back))
        with np.errstate(divide="ignore"):
            found[lines] = longest[lines] * np.minimum(1.0, tolerance[lines] / largest)
    if arcs.size:
        found[arcs] = _fitted(corners.some(arcs), tolerance[arcs] * (1 - SETTINGS.kept_back), longest[arcs])
    return found


def _fitted(corners: _Corners, tolerance: Array, longest: Array) -> Array:
    """Remaining distances, at most `longest`, whose deviation is the tolerance, or less at the longest."""
    low, high, trial = np.zeros_like(longest), longest.copy(), longest.copy()
    todo = np.arange(len(longest))
    for number in range(SETTINGS.trials):
        found = np.maximum(*_deviations(corners.some(todo), trial[todo]))
        ratio = found / tolerance[todo]
        fits = ratio <= 1
        low[todo] = np.where(fits, trial[todo], low[todo])
        high[todo] = np.where(fits, high[todo], trial[todo])
        going = (~fits | (ratio < 1 - SETTINGS.kept_back)) & (trial[todo] < longest[todo]) | ~fits
        # nearly proportional; halving where that leads out of the bracket, or does not settle
        aim = trial[todo] * (1 - SETTINGS.kept_back / 2) / np.maximum(ratio, 1e-12)
        inside = (aim > low[todo]) & (aim < high[todo]) & (number % 4 != 3)
        trial[todo] = np.where(inside, aim, (low[todo] + high[todo]) / 2)
        todo = todo[going]
        if not todo.size:
            break
    if (low <= 0).any():
        i = int((low <= 0).argmax())
        name = f"vertex {corners.vertices[i] + 1}"
        message = f"{name}: no blend stays within the deviation; take a larger one"
        raise ModelError(message, name=name, limit=float(tolerance[i]))
    return low


def _deviations(corners: _Corners, remaining: Array) -> tuple[Array, Array]:
    """Distance of the vertex from its blend, and largest distance of the blend from the two segments.

    Between them they bound how far the smooth path strays from the task and the task from the smooth path. Sampled
    evenly and again about the extreme: the first is never below the truth, the second by at most 0.1 %. Shape (V,), m.
    """
    path, vertices, curves = corners.path, corners.vertices, corners.blends(remaining)
    u = np.linspace(0, 1, SETTINGS.samples)
    points = polynomial(curves[:, None], u[None, :])
    tip = path.start[vertices + 1][:, None]
    corner = np.linalg.norm(points - tip, axis=-1)
    near = _from_segments(path, vertices, points, remaining)

    def about(extreme: NDArray[np.intp]) -> Array:
        places = u[np.clip(extreme, 1, SETTINGS.samples - 2)][:, None] + np.linspace(-1, 1, SETTINGS.samples) / (
            SETTINGS.samples - 1
        )
        return polynomial(curves[:, None], places)

    closest = np.linalg.norm(about(corner.argmin(axis=1)) - tip, axis=-1)
    # there is a kink where the other segment gets nearer
    farthest = _from_segments(path, vertices, about(near.argmax(axis=1)), remaining)
    return (np.minimum(corner.min(axis=1), closest.min(axis=1)), np.maximum(near.max(axis=1), farthest.max(axis=1)))


def _from_blend(corners: _Corners, remaining: Array) -> Array:
    """Largest distance of the two stretches that each blend replaces from the blend. Shape (V,), m."""
    path, result = corners.path, np.empty(len(remaining))
    u, v = np.linspace(0, 1, 4 * SETTINGS.samples), np.linspace(0, 1, SETTINGS.samples)
    for first in range(0, len(remaining), SETTINGS.block):
        part = slice(first, first + SETTINGS.block)
        some, away = corners.some(part), remaining[part]
        index = some.vertices
        tip = path.start[index + 1][:, None]
        points = polynomial(some.blends(away)[:, None], u) - tip
        flat, along = np.repeat(index, len(v)), away[:, None] * v
        before = path.at(flat, (path.lengths[index][:, None] - along).ravel())[0]
        after = path.at(flat + 1, along.ravel())[0]
        task = np.concatenate([x.reshape(len(index), len(v), 3) for x in (before, after)], axis=1) - tip
        square = (points**2).sum(axis=-1)[:, None] - 2 * task @ points.transpose(0, 2, 1)
        nearest = np.clip(square.argmin(axis=2), 1, len(u) - 2)
        row = np.arange(len(index))[:, None]
        distance = np.full(nearest.shape, np.inf)
        for one, other in ((-1, 0), (0, 1)):
            start, end = points[row, nearest + one], points[row, nearest + other]
            chord, offset = end - start, task - start
            part_of = np.clip((offset * chord).sum(axis=-1) / (chord**2).sum(axis=-1), 0, 1)
            distance = np.minimum(distance, np.linalg.norm(offset - part_of[..., None] * chord, axis=-1))
        result[part] = distance.max(axis=1)
    return result


def _from_segments(path: Path, vertices: NDArray[np.intp], points: Array, remaining: Array) -> Array:
    # distance of points (V, S, 3) from the nearer of the two stretches that a blend replaces
    return np.minimum(
        _distance(path, vertices, points, path.lengths[vertices] - remaining, path.lengths[vertices]),
        _distance(path, vertices + 1, points, np.zeros(len(vertices)), remaining),
    )


def _distance(path: Path, index: NDArray[np.intp], points: Array, first: Array, last: Array) -> Array:
    # of points (V, S, 3) from the stretch first..last of a segment each
    screwed = np.flatnonzero(path.torsion[index] != 0)
    if screwed.size:
        result, others = np.empty(points.shape[:2]), np.flatnonzero(path.torsion[index] == 0)
        if others.size:
            result[others] = _distance(path, index[others], points[others], first[others], last[others])
        result[screwed] = _from_helix(path, index[screwed], points[screwed], first[screwed], last[screwed])
        return result
    offset = points - path.start[index][:, None]
    along = np.einsum("vsi,vi->vs", offset, path.tangent[index])
    across = np.einsum("vsi,vi->vs", offset, path.normal[index])
    k = path.curvature[index][:, None]
    # angle about the center, from the start; in the branch of the stretch's middle
    middle = (first + last)[:, None] / 2
    angle = np.arctan2(k * along, 1 - k * across)
    angle = k * middle + (angle - k * middle + np.pi) % (2 * np.pi) - np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(k > 0, angle / k, along)
    s = np.clip(distance, first[:, None], last[:, None])
    # what screw says of the position, without its derivatives
    turned = k * s / np.pi
    offset -= (s * np.sinc(turned))[..., None] * path.tangent[index][:, None]
    offset -= (k * s**2 / 2 * np.sinc(turned / 2) ** 2)[..., None] * path.normal[index][:, None]
    return np.asarray(np.sqrt(np.einsum("vsi,vsi->vs", offset, offset)))


def _from_helix(path: Path, index: NDArray[np.intp], points: Array, first: Array, last: Array) -> Array:
    # as _distance: the nearest of some places, and Newton steps from there to where the offset is square to the tangent
    if len(index) > SETTINGS.block:
        parts = [slice(k, k + SETTINGS.block) for k in range(0, len(index), SETTINGS.block)]
        return np.concatenate([_from_helix(path, index[p], points[p], first[p], last[p]) for p in parts])
    frame = path.start[index][:, None], path.tangent[index][:, None], path.normal[index][:, None]
    bends = path.curvature[index][:, None], path.torsion[index][:, None]
    turns = float((np.hypot(*bends)[:, 0] * (last - first)).max()) / FULL_TURN
    share = np.linspace(0, 1, int(SETTINGS.samples * (1 + turns)))
    places = first[:, None] + (last - first)[:, None] * share
    there = screw(*frame, *bends, places)[0] - frame[0]
    square = (there**2).sum(axis=-1)[:, None] - 2 * (points - frame[0]) @ there.transpose(0, 2, 1)
    s = np.take_along_axis(places, square.argmin(axis=2), axis=1)
    for _ in range(SETTINGS.newton_steps):
        at, tangent, bend, _ = screw(*frame, *bends, s)
        slope = 1 + ((at - points) * bend).sum(axis=-1)
        s = s - ((at - points) * tangent).sum(axis=-1) / np.maximum(slope, SETTINGS.gentlest)
        s = np.clip(s, first[:, None], last[:, None])
    return np.asarray(np.linalg.norm(screw(*frame, *bends, s)[0] - points, axis=-1))


def smooth(
    path: Path,
    remaining: ArrayInput | None = None,
    *,
    deviation: ArrayInput | None = None,
    kind: BlendKind = "quintic",
    shape: Any = None,
    overlap: Overlap = "shrink",
) -> SmoothPath:
    """Round every corner of a path.

    Args:
        path: The task.
        remaining: Distance (m) from a vertex at which its blend leaves the segments, measured along them: one for all
            vertices, or one for each.
        deviation: Instead of `remaining`: how far (m) the smooth path may stray from the task and the task from the
            smooth path; the blends are as large as that and the segments allow.
        kind: "quintic", whose curvature is continuous everywhere, or the paper's "cubic", whose curvature is continuous
            between lines only, and only at shape 3.
        shape: End tangents over the remaining distance, lambda of eq. (9), one for all or one for each vertex. If
            None, the paper's 3 for a cubic, and for a quintic that of least peak curvature at each vertex, which is
            run fastest: see models.paths.blends.
        overlap: What happens to blends that would overlap on a segment: "shrink" makes both smaller, "refuse" raises.

    Raises:
        ModelError: A distance, deviation or shape that is not positive; blends that overlap, if refused; a cusp.

    Warns:
        ModelWarning: Blends that were made smaller than `remaining` asks, their vertices being its `value`. A
            `deviation` is kept by smaller ones too, and nothing is said.
    """
    count = len(checked_instance(path, Path, "smooth", "path").segments)
    checked_choice(kind, get_args(BlendKind), "blend", "kind")
    free = shape is None and kind == "quintic"
    angles = path.corner_angles()
    factors = corner_shape(angles) if free else checked_shape(PAPER_SHAPE if shape is None else shape, kind, count - 1)
    corners, distances = _sized(
        _Corners(path, kind, factors, np.arange(count - 1)), remaining, deviation, overlap, free
    )
    coefficients = corners.blends(distances)
    curve_cells = cells(coefficients)
    blend_lengths = np.bincount(curve_cells.curve, curve_cells.length, minlength=len(distances))
    padded = np.concatenate([[0.0], distances, [0.0]])
    rests = path.lengths - padded[:-1] - padded[1:]
    lengths, segment, blend = np.empty(2 * count - 1), np.full(2 * count - 1, -1), np.full(2 * count - 1, -1)
    lengths[::2], lengths[1::2] = rests, blend_lengths
    segment[::2], blend[1::2] = np.arange(count), np.arange(count - 1)
    kept = np.ones(2 * count - 1, dtype=bool)
    kept[::2] = rests > SETTINGS.shortest * path.lengths
    bounds = np.concatenate([[0.0], np.cumsum(lengths[kept])])
    made = path, kind, distances, corners.shape, coefficients, bounds, segment[kept], blend[kept], curve_cells
    smoothed = SmoothPath(*made)
    if path.turns:
        _check_turns(smoothed)
    return smoothed


def _check_turns(smoothed: SmoothPath) -> None:
    theta = smoothed.charts[1]
    largest = np.linalg.norm(theta, axis=2).sum(axis=1)  # bounds |theta| over the whole piece
    if largest.max() > FULL_TURN:
        bounds = smoothed.bounds[:-1][largest > FULL_TURN]
        u = np.linspace(0, 1, 33)[:, None] ** np.arange(6)
        angle = np.linalg.norm(np.einsum("uk,pkc->puc", u, theta[largest > FULL_TURN]), axis=2).max(axis=1)
        if angle.max() > FULL_TURN:
            message = (
                f"the tool turns by {np.degrees(angle.max()):.4g} deg in the blend at "
                f"{bounds[int(angle.argmax())]:g} m; turn less or take a smaller remaining distance"
            )
            raise ModelError(message, name="orientation", value=float(angle.max()), limit=FULL_TURN)
