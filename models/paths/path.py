"""Task paths of connected segments, and the treatment of points at which a path reverses its direction.

No smooth curve rounds a reversal (a corner of 180 deg). `split_at_reversals` ends the path there, or inserts a bulb
turn of three arcs of 60, 300 and 60 degrees. The bulb leaves the vertex in the direction of arrival and returns to it
in the opposite direction, without a corner. It extends beyond the vertex by 1.37 times its width.

`fit_splines` replaces many short segments, such as the chords by which CAM programs describe a curve, by few splines.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import NOT_NUMBERS, ROUNDING, Array, ArrayInput, check_entries, require, set_fields
from models.errors import ModelError
from models.paths.blends import derivatives_by_arc_length
from models.paths.segments import Line, Segment, bulb_turn, rotation_vector, screw, unit_quaternion
from models.paths.splines import (
    Polyline,
    Spline,
    SplineTable,
    distances_from_chord,
    exponential,
    fit_spline,
    product,
    rotate,
    simplify_polyline,
)  # fmt: skip
from models.spatial import rotation_from_quaternion

SMALLEST_ANGLE = 1e-6
"""Interior angle (rad) below which a corner is a reversal, because its blend would be curved too sharply.

The curvature would be 4e12 / remaining.
"""
FRAME = ("start", "tangent", "normal", "curvature", "torsion")
NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Path:
    """A chain of segments (lines, arcs, helices and splines), each of which starts where the previous segment ends.

    Attributes:
        segments: The segments in order, at least one.
        lengths: Lengths of the segments. Shape (n,), m.
        start, tangent, normal: Start point and frame of each segment at its start, in world; the normal of a line or
            spline is zero. Shape (n, 3), m and unit vectors.
        curvature, torsion: Curvature and torsion of each segment; both zero for a line, torsion zero for an arc. For a
            spline the largest curvature at the ends of its pieces, and zero. Shape (n,), 1/m.
        orientation: Tool orientation at the start of each segment, unit quaternion. Shape (n, 4).
        turn: Rotation vector of the tool along each segment, in the axes of its start orientation. Shape (n, 3), rad.
            For a spline it is nan if the tool turns.

    Raises:
        ModelError: There is no segment, or an entry is no segment; position or orientation has a gap; or a corner
            reverses the direction (180 deg).
    """

    segments: tuple[Segment, ...]
    lengths: Array = field(init=False, repr=False)
    start: Array = field(init=False, repr=False)
    tangent: Array = field(init=False, repr=False)
    normal: Array = field(init=False, repr=False)
    curvature: Array = field(init=False, repr=False)
    torsion: Array = field(init=False, repr=False)
    orientation: Array = field(init=False, repr=False)
    turn: Array = field(init=False, repr=False)

    def __repr__(self) -> str:
        counts = Counter(type(segment).__name__ for segment in self.segments)
        kinds = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in sorted(counts.items()))
        return f"<Path of {self.length:.6g} m: {kinds.lower()}>"

    def __post_init__(self) -> None:
        segments = checked_segments(self.segments)
        set_fields(self, segments=segments, lengths=np.array([segment.length for segment in segments]))
        set_fields(self, **{name: np.array([getattr(each, name) for each in segments]) for name in FRAME})
        self._check_gaps()
        self._set_orientations()
        self._check_corners()

    @classmethod
    def through(cls, points: ArrayInput, orientations: ArrayInput | None = None) -> Path:
        """Return the path of straight lines through given points.

        Args:
            points: Points in world, at least two. A doubled last point, as in recordings, counts once. Shape (n, 3), m.
            orientations: Unit quaternions at the points; None: the tool does not turn. Shape (n, 4).

        Raises:
            ModelError: Wrong sizes or values; or two successive points are equal, and the tool does not turn there.
        """
        corners = require.array("path: points", points, ("points", 3), least=2)
        values = [corners]
        if orientations is not None:
            values.append(require.array("path: orientations", orientations, (len(corners), 4)))
        if len(corners) > 2 and all(np.array_equal(each[-1], each[-2]) for each in values):
            values = [each[:-1] for each in values]
        ends = [part for each in values for part in (each[:-1], each[1:])]
        lines = []
        for number, each in enumerate(zip(*ends, strict=True)):
            try:
                lines.append(Line(*each))
            except ModelError as error:
                words = f"points[{number}] to points[{number + 1}]: {error}"
                raise ModelError(words, name=f"points[{number + 1}]", value=error.value, limit=error.limit) from error
        return cls(tuple(lines))

    @property
    def length(self) -> float:
        """Sum of the lengths of the path's segments, before corners are rounded, m."""
        return float(self.lengths.sum())

    @property
    def turns(self) -> bool:
        """Whether the tool's orientation changes along the path."""
        return bool(np.any(self.turn != 0))

    @property
    def oriented(self) -> bool:
        """Whether any segment specifies a tool orientation."""
        return any(s.start_orientation is not None or s.end_orientation is not None for s in self.segments)

    def at(self, index: Any, distance: ArrayInput) -> tuple[Array, Array, Array, Array]:
        """Return points at distances (m) along given segments, and three derivatives with respect to the distance.

        Shapes: index (M,) of int, distance (M,), each result (M, 3).
        """
        index = require.indices("path: index", index, len(self.segments))
        along = require.array("path: distance", distance)
        frame = self.start[index], self.tangent[index], self.normal[index]
        results = screw(*frame, curvature=self.curvature[index], torsion=self.torsion[index], distance=along)
        if (rows := np.flatnonzero(self.is_spline[index])).size:
            values = self._table.at(index[rows], np.broadcast_to(along, index.shape)[rows])
            for result, value in zip(results, values, strict=True):
                result[rows] = value
        return results

    def turn_at(self, index: NDArray[np.intp], distance: Array) -> tuple[Array, Array, Array]:
        """Return tool orientations in the world, and two derivatives of them, at distances (m) along given segments.

        Shapes: index and distance (M,), results (M, 4), (M, 3), (M, 3), 1, rad/m and rad/m^2.
        """
        rate, own = self.turn[index] / self.lengths[index, None], self.orientation[index]
        quaternion = product(own, exponential(rate * distance[:, None]))
        spin, change = rotate(own, rate), np.zeros_like(rate)
        for row in np.flatnonzero(self.is_spline[index]).tolist():
            spline = self.segments[index[row]]
            if isinstance(spline, Spline) and spline.turns is not None:
                quaternion[row], spin[row], change[row] = spline.turn_at(float(distance[row]))
        return quaternion, spin, change

    @cached_property
    def is_spline(self) -> NDArray[np.bool_]:
        """Whether each segment of the path is a spline. Shape (n,), bool."""
        return np.array([isinstance(segment, Spline) for segment in self.segments])

    @cached_property
    def _table(self) -> SplineTable:
        return SplineTable.of(self.segments, np.cumsum(self.lengths) - self.lengths)

    def corner_angles(self) -> Array:
        """Return the path's interior angle at each vertex, pi if the tangent is continuous. Shape (n - 1,), rad."""
        return _angles(self.at(np.arange(len(self.segments) - 1), self.lengths[:-1])[1], self.tangent[1:])

    def placed(self, position: ArrayInput = (0.0, 0.0, 0.0), orientation: ArrayInput = (1.0, 0.0, 0.0, 0.0)) -> Path:
        """Return the path moved to a given pose in the world; tool orientations rotate with the path.

        Args:
            position: Origin of the path's axes in world. Shape (3,), m.
            orientation: Orientation of the path's axes in world, unit quaternion. Shape (4,).
        """
        origin = require.array("path: position", position, (3,))
        rotation = unit_quaternion(orientation, "path: orientation")
        matrix = np.array(ca.DM(rotation_from_quaternion(rotation)))
        moved_segments: list[Segment] = []
        for i, segment in enumerate(self.segments):
            if isinstance(segment, Spline):
                curves = np.asarray(segment.coefficients) @ matrix.T
                curves[:, 0] += origin
                own = None if segment.references is None else product(rotation, segment.references)
                moved_segments.append(Spline(curves, own, segment.turns))
                continue
            fields: dict[str, Any] = {"start": origin + matrix @ segment.start}
            if isinstance(segment, Line):
                fields["end"] = origin + matrix @ segment.end
            else:
                fields["center"] = origin + matrix @ segment.center
                fields["axis"] = matrix @ segment.axis
            for name in ("start_orientation", "end_orientation"):
                own = getattr(segment, name)
                if own is None and i == 0 and name == "start_orientation":
                    own = NO_ROTATION
                fields[name] = None if own is None else product(rotation, own)
            moved_segments.append(replace(segment, **fields))
        return Path(tuple(moved_segments))

    def _check_gaps(self) -> None:
        ends = self.at(np.arange(len(self.segments)), self.lengths)[0]
        gaps = np.linalg.norm(ends[:-1] - self.start[1:], axis=1)
        if gaps.size and gaps.max() > ROUNDING:
            i = int(gaps.argmax())
            message = (
                f"segment {i} ends at {ends[i].tolist()} m, segment {i + 1} starts at {self.start[i + 1].tolist()} m: "
                f"a gap of {gaps[i]:.3g} m; connect them by a Line"
            )
            raise ModelError(message, name=f"segment {i}", value=float(gaps[i]), limit=ROUNDING)

    def _check_corners(self) -> None:
        angles = self.corner_angles()
        if angles.size and angles.min() < SMALLEST_ANGLE:
            i = int(angles.argmin())
            message = (
                f"at vertex {i + 1}, {self.start[i + 1].tolist()} m, the path turns by 180 deg (interior angle "
                f"{np.degrees(angles[i]):.3g} deg), and no smooth curve rounds a reversal; use split_at_reversals"
            )
            raise ModelError(message, name=f"vertex {i + 1}", value=float(angles[i]), limit=SMALLEST_ANGLE)

    def _set_orientations(self) -> None:
        current = NO_ROTATION
        starts, turns = [], []
        for i, segment in enumerate(self.segments):
            begin = current if segment.start_orientation is None else np.asarray(segment.start_orientation)
            if i and begin is not current:
                gap = float(np.linalg.norm(rotation_vector(current, begin, f"vertex {i}")))
                if gap > ROUNDING:
                    message = (
                        f"at vertex {i} the tool orientation jumps by {np.degrees(gap):.4g} deg, from "
                        f"{current.tolist()} to {begin.tolist()}; turn it along a segment"
                    )
                    raise ModelError(message, name=f"vertex {i}", value=gap, limit=ROUNDING)
            if begin @ current < 0 and i:
                begin = -begin  # the same orientation, with a sign that is continuous from segment to segment
            starts.append(begin)
            if segment.end_orientation is None:
                turns.append(np.zeros(3))
                current = begin
            else:
                current = np.asarray(segment.end_orientation)
                whole = np.full(3, np.nan if np.any(segment.turns) else 0.0) if isinstance(segment, Spline) else None
                turns.append(whole if whole is not None else rotation_vector(begin, current, f"segment {i}"))
                current = current if begin @ current >= 0 else -current
        set_fields(self, orientation=np.array(starts), turn=np.array(turns))


def checked_segments(segments: Any) -> tuple[Segment, ...]:
    """Return segments as a tuple; raise a ModelError if the list is empty or an entry is not a segment."""
    try:
        check_entries(segments)
        checked = tuple(segments)
    except NOT_NUMBERS as error:
        message = f"the path {segments!r} is no sequence of segments"
        raise ModelError(message, name="segments", value=segments) from error
    if not checked:
        raise ModelError("the path has no segment; give at least one Line, Arc or Helix", name="segments", value=())
    for i, segment in enumerate(checked):
        if not isinstance(segment, Segment):
            message = f"segment {i} is {segment!r}; a path consists of Line, Arc, Helix and Spline"
            raise ModelError(message, name=f"segment {i}", value=segment)
    return checked


def interior_angles(segments: Sequence[Segment]) -> Array:
    """Return the interior angle between each segment and the next, pi if they join smoothly. Shape (n - 1,), rad."""
    columns = (np.array([getattr(each, name) for each in segments]) for name in (*FRAME, "length"))
    start, tangent, normal, k, w, length = columns
    ends = screw(start, tangent, normal, curvature=k, torsion=w, distance=length)[1]
    for i, each in enumerate(segments):
        if isinstance(each, Spline):
            ends[i] = derivatives_by_arc_length(np.asarray(each.coefficients)[-1:], np.ones(1))[1]
    return _angles(ends[:-1], tangent[1:])


def _angles(before: Array, after: Array) -> Array:
    # accurate near 0 and pi, unlike the arc cosine
    return np.asarray(2 * np.arctan2(np.linalg.norm(before + after, axis=1), np.linalg.norm(before - after, axis=1)))


class FittedPath(NamedTuple):
    """Path in which `fit_splines` has replaced runs of short segments by splines and lines."""

    path: Path  # the path of n segments
    first: NDArray[np.intp]  # index of the first segment of the given path that each segment replaces. Shape (n,).
    deviation: Array  # deviation that remains for rounding each vertex. Shape (n - 1,), m.


@dataclass(frozen=True)
class RunSettings:
    """Settings of the search for runs of short segments that a spline or a line can replace."""

    simplified: float = 0.5  # deviation of the simplified polyline that shows the corners, relative to the tolerance
    spline: float = 0.75  # largest deviation of a spline, relative to the tolerance; the rest is for the vertices
    sagitta: float = 0.05  # distance of an arc from the chords that stand for it, relative to the tolerance
    long: float = 4.0  # deviation, relative to the tolerance, from a curve that bends on alike; a line with more stays
    straight: float = 0.05  # deviation of the points of such a line from it, relative to the tolerance
    chords: int = 8  # number of chords of the simplified polyline above which an arc or a helix stays as it is


RUNS = RunSettings()


def fit_splines(
    path: Path, deviation: ArrayInput, *, angle: float = 1e-3, corners: ArrayInput | None = None
) -> FittedPath:
    """Replace runs of many short segments, such as the chords of a curve, by splines and lines within a deviation.

    Each point of the result is within 3/4 of the least deviation of the given path, and vice versa; the splines are
    checked by a bound, not by samples. Their curvature is continuous, and so are two derivatives of it. The number of
    their pieces depends on the shape of the path, not on the number of its segments. Corners remain: vertices at which
    a curve within the deviation would have to bend more sharply than beside them. Long lines and arcs remain exact, and
    collinear lines become one. `smooth` rounds the remaining corners.

    Args:
        deviation: Largest distance (m) between the given path and the smooth one, as for `smooth`.
        angle: Largest angle (rad) between the tool orientations of a spline and of the path at equal parameters,
            checked at the ends and in the middle of each segment.
        corners: Further vertices that remain, for example because the speed changes there; 1 is the end of the first
            segment. Shape (k,).

    Raises:
        ModelError: The deviation or the angle is not positive, or a corner is not a vertex.
    """
    count = len(require.instance("fit_splines: path", path, Path).segments)
    tolerances = require.broadcast("path: deviation", deviation, count - 1, "vertices", unit="m", sign="positive")
    require.positive("path: angle", angle, unit="rad")
    kept: Any = [] if corners is None else require.indices("path: corners", corners, count)
    if count < 3:
        return FittedPath(path, np.arange(count), tolerances)
    tolerance, left = float(tolerances.min()), np.concatenate([[np.inf], tolerances, [np.inf]])
    line, number = _polyline(path, RUNS.sagitta * tolerance)
    is_end = _run_ends(path, line.points, number, tolerance)
    is_end[kept] = True
    ends = np.flatnonzero(is_end)
    segments, first, used = list[Segment](), list[int](), np.zeros(count + 1)
    for i, j in pairwise(ends.tolist()):
        part = slice(int(number[i]), int(number[j]) + 1)
        own = Polyline(line.points[part], None if line.quaternions is None else line.quaternions[part])
        result = _replace_run(path.segments[i:j], own, tolerance, angle) if j - i > 2 else None
        if result is None:
            segments += path.segments[i:j]
            first += range(i, j)
        else:
            segments.append(result[0])
            first.append(i)
            used[[i, j]] = np.maximum(used[[i, j]], result[1])
    return FittedPath(Path(tuple(segments)), np.array(first), (left - used)[first[1:]])


def _polyline(path: Path, sagitta: float) -> tuple[Polyline, NDArray[np.intp]]:
    """Return a polyline within `sagitta` (m) of a path's arcs, and the index of the polyline's point at each vertex."""
    with np.errstate(divide="ignore"):
        chord = np.where(path.is_spline, np.inf, np.sqrt(8 * sagitta / path.curvature))
    counts = np.maximum(np.ceil(path.lengths / chord), 1).astype(int)
    number = np.concatenate([[0], np.cumsum(counts)])
    index = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(number[-1]) - number[index]) / counts[index]
    last = len(counts) - 1
    index, distance = np.append(index, last), np.append(share * path.lengths[index], path.lengths[last])
    points = path.at(index, distance)[0]
    return Polyline(points, path.turn_at(index, distance)[0] if path.turns or path.oriented else None), number


def _run_ends(path: Path, points: Array, number: NDArray[np.intp], tolerance: float) -> NDArray[np.bool_]:
    """Return for each vertex of a path whether a run of segments that a spline can replace ends there. Shape (n + 1,).

    A curve that is within its deviation from the chord c of a simplified polyline bends by 8 deviation / c from chord
    to chord; where the path bends much more, it has a corner.
    """
    corners = simplify_polyline(points, RUNS.simplified * tolerance)
    steps = np.diff(points[corners], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    bends = np.pi - _angles(steps[:-1] / lengths[:-1, None], steps[1:] / lengths[1:, None])
    sharp = np.minimum(lengths[:-1], lengths[1:]) * bends > 8 * tolerance
    # deviation that each chord would have if it bent as at its ends
    after = np.append(np.where(sharp, np.inf, lengths[:-1] ** 2 * bends / lengths[1:] / 8), np.inf)
    before = np.append(np.inf, np.where(sharp, np.inf, lengths[1:] ** 2 * bends / lengths[:-1] / 8))
    is_long = np.minimum(before, after) > RUNS.long * tolerance
    for k in np.flatnonzero(is_long):
        is_long[k] = distances_from_chord(points[corners[k] : corners[k + 1] + 1]).max() <= RUNS.straight * tolerance
    at_ends = np.zeros(len(points), dtype=bool)
    at_ends[corners[1:-1][sharp]] = True
    at_ends[corners[:-1][is_long]] = at_ends[corners[1:][is_long]] = True
    is_end = at_ends[number]
    inner = np.searchsorted(corners, number[1:]) - np.searchsorted(corners, number[:-1])
    exact = path.is_spline | (inner > RUNS.chords)
    is_end[:-1] |= exact
    is_end[1:] |= exact
    is_end[[0, -1]] = True
    return np.asarray(is_end)


def _replace_run(
    segments: Sequence[Segment], line: Polyline, tolerance: float, angle: float
) -> tuple[Segment, float] | None:
    """Return one segment that replaces a run of segments, and a bound of its deviation (m); None if no segment fits."""
    (points, quaternions), deviation = line, float(distances_from_chord(line.points).max())
    is_line = deviation <= min(RUNS.simplified * tolerance, float(np.linalg.norm(points[-1] - points[0])))
    is_line &= quaternions is None or bool((np.diff(quaternions, axis=0) == 0).all())
    if is_line and all(isinstance(each, Line) for each in segments):
        return Line(points[0], points[-1], segments[0].start_orientation), deviation
    fit = fit_spline(line, (RUNS.spline - RUNS.sagitta) * tolerance, angle, len(segments))
    return None if fit is None else (fit[0], fit[1] + RUNS.sagitta * tolerance)


Reversal: TypeAlias = Literal["split"] | float
"""Treatment of a reversal of direction: "split" ends the path at it; a width (m) inserts a bulb-shaped turn."""


def split_at_reversals(
    segments: Sequence[Segment], reversal: Reversal = "split"
) -> tuple[tuple[Path, NDArray[np.intp]], ...]:
    """Split connected segments into paths at reversals of direction, or insert bulb-shaped turns at the reversals.

    Args:
        segments: At least one; each starts at the end of the one before.
        reversal: "split" ends a path at a reversal and begins another; a width (m) inserts a bulb turn.

    Returns:
        Each path, and for each of its segments the index of the input segment; the arcs of a bulb turn have that of the
        segment before it.

    Raises:
        ModelError: As for Path, except reversals; or the width is not positive.
    """
    segments = checked_segments(segments)
    width = 0.0
    if isinstance(reversal, str):
        if reversal != "split":
            message = f"path: reversal {reversal!r} is unknown; use 'split' or a width in m"
            raise ModelError(message, name="reversal", value=reversal, limit=("split",))
    else:
        width = require.positive("path: reversal", reversal, unit="m")
    reversals = (np.flatnonzero(interior_angles(segments) < SMALLEST_ANGLE) + 1).tolist()
    if not width:
        parts = [np.arange(first, last) for first, last in pairwise([0, *reversals, len(segments)])]
        return tuple((Path(tuple(segments[i] for i in part)), part) for part in parts)
    joined: list[Segment] = []
    index: list[int] = []
    reversal_starts = set(reversals)
    for i, segment in enumerate(segments):
        if i in reversal_starts:
            joined += bulb_turn(segments[i - 1], width)
            index += [i - 1] * 3
        joined.append(segment)
        index.append(i)
    return ((Path(tuple(joined)), np.array(index)),)
