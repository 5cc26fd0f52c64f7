"""Task paths of connected segments, and the treatment of points at which a path reverses its direction.

No smooth curve rounds a reversal (a corner of 180 deg). `split_at_reversals` ends the path there, or inserts a bulb
turn of three arcs of 60, 300 and 60 degrees. The bulb leaves the vertex in the direction of arrival and returns to it
in the opposite direction, without a corner. It extends beyond the vertex by 1.37 times its width.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import NOT_NUMBERS, ROUNDING, Array, ArrayInput, check_entries, require
from models.errors import ModelError
from models.paths.segments import Arc, Helix, Line, Segment, product, rotation_vector, screw, unit_quaternion
from models.spatial import rotation_from_quaternion

__all__ = ["Path", "Reversal", "split_at_reversals"]

SMALLEST_ANGLE = 1e-6
"""Interior angle (rad) below which a corner is a reversal, because its blend would be curved too sharply.

The curvature would be 4e12 / remaining.
"""
FRAME = ("start", "tangent", "normal", "curvature", "torsion")
NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Path:
    """A chain of lines, arcs and helices, each starting at the end of the one before.

    Attributes:
        segments: The segments in order, at least one.
        lengths: Lengths of the segments. Shape (n,), m.
        start, tangent, normal: Start point and frame of each segment at its start, in world. Shape (n, 3), m and unit
            vectors.
        curvature, torsion: Curvature and torsion of each segment; both zero for a line, torsion zero for an arc. Shape
            (n,), 1/m.
        orientation: Tool orientation at the start of each segment, unit quaternion. Shape (n, 4).
        turn: Rotation vector of the tool along each segment, in the axes of its start orientation. Shape (n, 3), rad.

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
        object.__setattr__(self, "segments", segments)
        object.__setattr__(self, "lengths", np.array([segment.length for segment in segments]))
        for name in FRAME:
            object.__setattr__(self, name, np.array([getattr(segment, name) for segment in segments]))
        self._check_gaps()
        self._set_orientations()
        self._check_corners()

    @classmethod
    def through(cls, points: ArrayInput, orientations: ArrayInput | None = None) -> Path:
        """Return the path of straight lines through given points.

        Args:
            points: Points in world, at least two. Shape (n, 3), m.
            orientations: Unit quaternions at the points; None: the tool does not turn. Shape (n, 4).

        Raises:
            ModelError: Wrong sizes or values; or two successive points are equal, and the tool does not turn there.
        """
        corners = require.array("path: points", points, ("points", 3), least=2)
        ends: list[Any] = [corners[:-1], corners[1:]]
        if orientations is not None:
            turns = require.array("path: orientations", orientations, (len(corners), 4))
            ends += [turns[:-1], turns[1:]]
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
        """Sum of the lengths of the segments, before corners are rounded, m."""
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
        """Return points on segments and three derivatives with respect to distance, at distances (m) along the
        segments.

        Shapes: index (M,) of int, distance (M,), each result (M, 3).
        """
        index = require.indices("path: index", index, len(self.segments))
        along = require.array("path: distance", distance)
        frame = self.start[index], self.tangent[index], self.normal[index]
        return screw(*frame, curvature=self.curvature[index], torsion=self.torsion[index], distance=along)

    def corner_angles(self) -> Array:
        """Return the interior angle at each vertex, which is pi for a continuous tangent. Shape (n - 1,), rad."""
        index = np.arange(len(self.segments) - 1)
        return _angles(self.at(index, self.lengths[:-1])[1], self.tangent[1:])

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
                turns.append(rotation_vector(begin, current, f"segment {i}"))
                current = current if begin @ current >= 0 else -current
        object.__setattr__(self, "orientation", np.array(starts))
        object.__setattr__(self, "turn", np.array(turns))


def checked_segments(segments: Any) -> tuple[Segment, ...]:
    """Return segments as a tuple; raise a ModelError if there are none or one is not a Line, Arc or Helix."""
    try:
        check_entries(segments)
        checked = tuple(segments)
    except NOT_NUMBERS as error:
        message = f"the path {segments!r} is no sequence of segments"
        raise ModelError(message, name="segments", value=segments) from error
    if not checked:
        raise ModelError("the path has no segment; give at least one Line, Arc or Helix", name="segments", value=())
    for i, segment in enumerate(checked):
        if not isinstance(segment, Line | Arc | Helix):
            message = f"segment {i} is {segment!r}; a path consists of Line, Arc and Helix"
            raise ModelError(message, name=f"segment {i}", value=segment)
    return checked


def interior_angles(segments: Sequence[Segment]) -> Array:
    """Return the interior angle between each segment and the next, pi if they join smoothly. Shape (n - 1,), rad."""
    start, tangent, normal, k, w, length = (
        np.array([getattr(each, name) for each in segments]) for name in (*FRAME, "length")
    )
    return _angles(screw(start, tangent, normal, curvature=k, torsion=w, distance=length)[1][:-1], tangent[1:])


def _angles(before: Array, after: Array) -> Array:
    # accurate near 0 and pi, unlike the arc cosine
    return np.asarray(2 * np.arctan2(np.linalg.norm(before + after, axis=1), np.linalg.norm(before - after, axis=1)))


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


def bulb_turn(segment: Segment, width: float) -> tuple[Arc, Arc, Arc]:
    """Return the three arcs of a bulb-shaped turn that reverses the direction at the end of a segment.

    Their plane contains the segment's curvature vector or, after a line, a horizontal normal of the line.
    """
    frame = np.asarray(segment.start), segment.tangent, segment.normal
    bends: Any = {"curvature": segment.curvature, "torsion": segment.torsion}
    _, ahead, bend, _ = screw(*frame, **bends, distance=segment.length)
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
