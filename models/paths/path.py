"""A task path: segments one after the other, checked.

Segments that turn back the way they came: nothing smooth rounds that, so the path is split there, or given width.

The width is that of a light bulb of three arcs of 60, 300 and 60 degrees, which leaves the vertex as it was reached
and comes back to it the other way round, without a corner. It passes the vertex by 1.37 of its width.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.arrays import (
    NOT_NUMBERS,
    ROUNDING,
    Array,
    ArrayInput,
    check_entries,
    checked_array,
    checked_indices,
    checked_number,
    checked_numbers,
)
from models.errors import ModelError
from models.paths.orientation import product, rotation_matrix, rotation_vector, unit_quaternion
from models.paths.segments import Arc, Helix, Line, Segment, screw

__all__ = ["Path", "Reversal", "split_at_reversals"]

SMALLEST_ANGLE = 1e-6
"""Interior angle (rad) below which a corner counts as a reversal: its blend would bend with 4e12 / remaining."""
FRAME = ("start", "tangent", "normal", "curvature", "torsion")
NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Path:
    """A chain of lines, arcs and helices, each starting where the one before ends.

    Attributes:
        segments: At least one.
        lengths: Of the segments. Shape (n,), m.
        start, tangent, normal: Of each segment, at its start, in world. Shape (n, 3), m and unit vectors.
        curvature, torsion: Of each segment; zero for a line, the torsion for an arc too. Shape (n,), 1/m.
        orientation: Tool orientation at the start of each segment, unit quaternion. Shape (n, 4).
        turn: Rotation vector of each segment in the axes of its start orientation. Shape (n, 3), rad.

    Raises:
        ModelError: No segment, something that is none, a gap in position or orientation, a corner that goes back the
            way it came (180 deg).
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

    def __post_init__(self) -> None:
        segments = checked_segments(self.segments)
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "lengths", np.array([segment.length for segment in segments]))
        for name in FRAME:
            object.__setattr__(self, name, np.array([getattr(segment, name) for segment in segments]))
        self._check_gaps()
        self._set_orientations()
        self._check_corners()

    @classmethod
    def through(cls, points: ArrayInput, orientations: ArrayInput | None = None) -> Path:
        """Straight lines from point to point.

        Args:
            points: In world, at least two. Shape (n, 3), m.
            orientations: At the points, unit quaternions; none turns if None. Shape (n, 4).
        """
        corners = checked_array(points, ("points", 3), "path", "points", least=2)
        if orientations is None:
            return cls(tuple(Line(a, b) for a, b in pairwise(corners)))
        turns = checked_array(orientations, (len(corners), 4), "path", "orientations")
        ends: Iterable[Any] = zip(corners[:-1], corners[1:], turns[:-1], turns[1:], strict=True)
        return cls(tuple(Line(*each) for each in ends))

    @property
    def length(self) -> float:
        """Sum of the segments, before any blend. m."""
        return float(self.lengths.sum())

    @property
    def turns(self) -> bool:
        """Whether the tool's orientation changes anywhere."""
        return bool(np.any(self.turn != 0))

    @property
    def oriented(self) -> bool:
        """Whether the tool's orientation is given anywhere."""
        given = (orientation for s in self.segments for orientation in (s.start_orientation, s.end_orientation))
        return any(orientation is not None for orientation in given)

    def at(self, index: Any, distance: ArrayInput) -> tuple[Array, Array, Array, Array]:
        """Position and three derivatives by the distance, at a distance (m) along segments.

        Shapes: index (M,) of int, distance (M,), each result (M, 3).
        """
        index = checked_indices(index, len(self.segments), "path", "index")
        along = checked_numbers(distance, "path", "distance")
        frame = self.start[index], self.tangent[index], self.normal[index]
        return screw(*frame, self.curvature[index], self.torsion[index], along)

    def corner_angles(self) -> Array:
        """Interior angle at each vertex, pi where the tangent goes on. Shape (n - 1,), rad."""
        index = np.arange(len(self.segments) - 1)
        return _angles(self.at(index, self.lengths[:-1])[1], self.tangent[1:])

    def placed(self, position: ArrayInput = (0.0, 0.0, 0.0), orientation: ArrayInput = (1.0, 0.0, 0.0, 0.0)) -> Path:
        """The path seen from a world in which its own axes have a pose; the tool is turned with it.

        Args:
            position: Of the path's origin in that world. Shape (3,), m.
            orientation: Of the path's axes in that world, unit quaternion. Shape (4,).
        """
        origin = checked_array(position, (3,), "path", "position")
        turned = unit_quaternion(orientation, "path: orientation")
        matrix = rotation_matrix(turned)
        made: list[Segment] = []
        for i, segment in enumerate(self.segments):
            changed: dict[str, Any] = {"start": origin + matrix @ segment.start}
            for what in ("end",) if isinstance(segment, Line) else ("center",):
                changed[what] = origin + matrix @ getattr(segment, what)
            if not isinstance(segment, Line):
                changed["axis"] = matrix @ segment.axis
            for what in ("start_orientation", "end_orientation"):
                given = getattr(segment, what)
                if given is None and i == 0 and what == "start_orientation":
                    given = NO_ROTATION
                changed[what] = None if given is None else product(turned, given)
            made.append(replace(segment, **changed))
        return Path(tuple(made))

    def _check_gaps(self) -> None:
        ends = self.at(np.arange(len(self.segments)), self.lengths)[0]
        gaps = np.linalg.norm(ends[:-1] - self.start[1:], axis=1)
        if gaps.size and gaps.max() > ROUNDING:
            i = int(gaps.argmax())
            message = (
                f"segment {i} ends at {ends[i].tolist()} m, segment {i + 1} starts at {self.start[i + 1].tolist()} m: "
                f"a gap of {gaps[i]:.3g} m; join them by a Line"
            )
            raise ModelError(message, name=f"segment {i}", value=float(gaps[i]), limit=ROUNDING)

    def _check_corners(self) -> None:
        angles = self.corner_angles()
        if angles.size and angles.min() < SMALLEST_ANGLE:
            i = int(angles.argmin())
            message = (
                f"at vertex {i + 1}, {self.start[i + 1].tolist()} m, the path turns by 180 deg (interior angle "
                f"{np.degrees(angles[i]):.3g} deg): nothing smooth rounds a reversal; make two paths, or give it width"
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
                begin = -begin  # the same orientation: the sign goes on from segment to segment
            starts.append(begin)
            if segment.end_orientation is None:
                turns.append(np.zeros(3))
                current = begin
            else:
                current = np.asarray(segment.end_orientation)
                turns.append(rotation_vector(begin, current, f"segment {i}"))
                current = current if begin @ current >= 0 else -current
        object.__setattr__(self, "orientation", np.array(starts))
        object.__setattr__(self, "turn", np.array(turns))


def checked_segments(segments: Any) -> tuple[Segment, ...]:
    """`segments` as a tuple; ModelError unless they are Lines, Arcs and Helices, one at least."""
    try:
        check_entries(segments)
        each = tuple(segments)
    except NOT_NUMBERS as error:
        message = f"the path {segments!r} is no sequence of segments"
        raise ModelError(message, name="segments", value=segments) from error
    if not each:
        raise ModelError("the path has no segment; give at least one Line, Arc or Helix", name="segments", value=())
    for i, segment in enumerate(each):
        if not isinstance(segment, Line | Arc | Helix):
            message = f"segment {i} is {segment!r}; a path is made of Line, Arc and Helix"
            raise ModelError(message, name=f"segment {i}", value=segment)
    return each


def interior_angles(segments: Sequence[Segment]) -> Array:
    """Interior angle between each segment and the next, as of `Path.corner_angles`. Shape (n - 1,), rad."""
    start, tangent, normal, k, w, length = (
        np.array([getattr(each, name) for each in segments]) for name in (*FRAME, "length")
    )
    return _angles(screw(start, tangent, normal, k, w, length)[1][:-1], tangent[1:])


def _angles(before: Array, after: Array) -> Array:
    # exact near 0 and pi, where the arc cosine is not
    return np.asarray(2 * np.arctan2(np.linalg.norm(before + after, axis=1), np.linalg.norm(before - after, axis=1)))


Reversal: TypeAlias = Literal["split"] | float
"""What becomes of a reversal: the path ends there, or turns round in a bulb of some width, m."""


def split_at_reversals(
    segments: Sequence[Segment], reversal: Reversal = "split"
) -> tuple[tuple[Path, NDArray[np.intp]], ...]:
    """Paths of segments that follow each other, which may turn back.

    Args:
        segments: At least one; each starts where the one before ends.
        reversal: "split" ends a path at a reversal and begins another; a width (m) puts a bulb there.

    Returns:
        Each path, and for each of its segments the index of the one given; a bulb has that of the one before it.

    Raises:
        ModelError: As of Path, but for reversals; a width that is not positive.
    """
    each = checked_segments(segments)
    width = 0.0
    if isinstance(reversal, str):
        if reversal != "split":
            message = f"path: reversal {reversal!r} is unknown; use 'split' or a width in m"
            raise ModelError(message, name="reversal", value=reversal, limit=("split",))
    else:
        width = checked_number(reversal, "path", "reversal", positive=True, unit="m")
    back = np.flatnonzero(interior_angles(each) < SMALLEST_ANGLE) + 1
    if not width:
        parts = [np.arange(first, last) for first, last in pairwise([0, *back.tolist(), len(each)])]
        return tuple((Path(tuple(each[i] for i in part)), part) for part in parts)
    made: list[Segment] = []
    index: list[int] = []
    turns = set(back.tolist())
    for i, segment in enumerate(each):
        if i in turns:
            made += bulb(each[i - 1], width)
            index += [i - 1] * 3
        made.append(segment)
        index.append(i)
    return ((Path(tuple(made)), np.array(index)),)


def bulb(segment: Segment, width: float) -> tuple[Arc, Arc, Arc]:
    """Arcs that turn round at the end of a segment, in a plane that is level unless the segment is upright."""
    frame = np.asarray(segment.start), segment.tangent, segment.normal, segment.curvature, segment.torsion
    _, ahead, bend, _ = screw(*frame, segment.length)
    vertex = np.asarray(segment.end)
    across = bend if bend.any() else np.cross([0.0, 0.0, 1.0], ahead)
    if np.linalg.norm(across) < 1e-9:
        across = np.array([1.0, 0.0, 0.0])
    across = across / np.linalg.norm(across)
    radius, axis = width / 2, np.cross(ahead, across)
    middle = vertex + np.sqrt(3) * radius * ahead
    first = Arc.about(vertex, vertex - radius * across, axis, -np.pi / 3)
    second = Arc.about(first.end, middle, axis, 5 * np.pi / 3)
    third = Arc.about(second.end, vertex + radius * across, axis, -np.pi / 3)
    return first, second, third
