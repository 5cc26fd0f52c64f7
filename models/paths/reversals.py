"""Segments that turn back the way they came: nothing smooth rounds that, so the path is split there, or given width.

The width is that of a light bulb of three arcs of 60, 300 and 60 degrees, which leaves the vertex as it was reached
and comes back to it the other way round, without a corner. It passes the vertex by 1.37 of its width.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.arrays import checked_number
from models.errors import ModelError
from models.paths.path import SMALLEST_ANGLE, Path, checked_segments, interior_angles
from models.paths.segments import Arc, Segment, screw

__all__ = ["Reversal", "chains"]

Reversal: TypeAlias = Literal["split"] | float
"""What becomes of a reversal: the path ends there, or turns round in a bulb of some width, m."""


def chains(segments: Sequence[Segment], reversal: Reversal = "split") -> tuple[tuple[Path, NDArray[np.intp]], ...]:
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
