"""Arcs and helices of G2 and G3, from a centre or a radius.

Numbers of a program are rounded, so a centre is hardly ever as far from the end as from the start. It is moved, the
least that is needed, onto the plane that halves the chord: then the arc meets both, and no gap is left to be closed.
LinuxCNC runs a spiral instead, about the centre that is written; the two differ by less than the gap.
"""

from __future__ import annotations

import numpy as np

from models.arrays import Array
from models.paths import Arc, Helix
from models.paths.segments import SHORTEST_SEGMENT
from models.spatial import FULL_TURN
from ocp.tolerances import STANDSTILL

__all__ = ["PLANES", "Gap", "about_center", "center_of_radius"]

PLANES = {170: (0, 1, 2), 180: (2, 0, 1), 190: (1, 2, 0)}
"""First axis, second axis and normal of G17, G18, G19: right-handed, so that G3 turns about the normal."""
RADIUS_SHARE = 1e-3
"""Of the radius: by so much the distances from the centre may differ where numbers have few digits."""


class Gap(Exception):
    """Numbers that make no arc.

    Attributes:
        why: What is wrong.
        size: Of the gap that would be left, m. limit: The largest that is closed, m.
    """

    def __init__(self, why: str, size: float, limit: float) -> None:
        super().__init__(why)
        self.why, self.size, self.limit = why, size, limit


def center_of_radius(start: Array, end: Array, radius: float, clockwise: bool, gap: float) -> Array:
    """Centre of an arc given by its radius, the longer way round if that is negative. In the plane, shape (2,), m.

    Raises:
        Gap: A radius less than half the chord by more than `gap`, or a chord that is none.
    """
    chord = end - start
    length = float(np.hypot(*chord))
    if length == 0:
        raise Gap("an arc by its radius ends where it starts; give I, J, K for a full circle", 0.0, gap)
    short = length / 2 - abs(radius)
    if short > gap and short > RADIUS_SHARE * length / 2:
        raise Gap(f"R is {short:.3g} m less than half the way from start to end", short, gap)
    height = np.sqrt(max(radius**2 - length**2 / 4, 0.0))
    left = np.array([-chord[1], chord[0]]) / length
    return np.asarray((start + end) / 2 + (height if clockwise == (radius < 0) else -height) * left)


def about_center(
    start: Array, end: Array, center: Array, clockwise: bool, turns: int, plane: tuple[int, int, int], gap: float
) -> list[Arc | Helix]:
    """Arcs or helices from start to end: one, or two halves where one centre cannot be moved to serve both ends.

    That is so where a circle nearly closes, but ends nearer to the centre than it starts.

    Args:
        start, end: Shape (3,), m.
        center: In the plane. Shape (2,), m.
        turns: Full turns begun: 1 for an arc up to a full circle.
        plane: First axis, second axis, normal.
        gap: Largest difference of the distances from the centre that counts as rounding, m.

    Raises:
        Gap: A centre that is not in the middle, by more than rounding.
    """
    inside, normal = list(plane[:2]), plane[2]
    first, last = start[inside], end[inside]
    radii = float(np.hypot(*(first - center))), float(np.hypot(*(last - center)))
    if min(radii) <= SHORTEST_SEGMENT:
        raise Gap("the centre is the start or the end of the arc", max(radii), gap)
    off = abs(radii[0] - radii[1])
    allowed = max(gap, min(RADIUS_SHARE * max(radii), 100 * gap))  # two digits fewer than usual, at most
    if off > allowed:
        what = f"start and end are {radii[0]:.6g} and {radii[1]:.6g} m from the centre, {off:.3g} m apart"
        raise Gap(what, off, allowed)
    sweep = _sweep(first - center, last - center, clockwise)
    moved = _moved(center, first, last)
    # what moving the centre does to the far side of the arc
    if np.hypot(*(moved - center)) * (1 - np.cos(sweep / 2)) <= max(2 * off, gap):
        if (first != last).any():
            sweep = _sweep(first - moved, last - moved, clockwise)
        return [_turned(start, end, moved, clockwise, sweep + FULL_TURN * (turns - 1), plane)]
    half = (-sweep if clockwise else sweep) / 2
    cosine, sine = np.cos(half), np.sin(half)
    out = (first - center) * (radii[0] + radii[1]) / (2 * radii[0])
    middle = start.copy()
    middle[inside] = center + np.array([cosine * out[0] - sine * out[1], sine * out[0] + cosine * out[1]])
    total = sweep + FULL_TURN * (turns - 1)
    middle[normal] += (end[normal] - start[normal]) * sweep / 2 / total
    made = []
    for one, other, more in ((start, middle, 0.0), (middle, end, total - sweep)):
        there = _moved(center, one[inside], other[inside])
        turn = _sweep(one[inside] - there, other[inside] - there, clockwise)
        made.append(_turned(one, other, there, clockwise, turn + more, plane))
    return made


def _moved(center: Array, first: Array, last: Array) -> Array:
    """The point nearest to a centre that is as far from one point as from another. Shape (2,) each."""
    chord = last - first
    square = float(chord @ chord)
    return center if square == 0 else np.asarray(center - ((center - (first + last) / 2) @ chord) / square * chord)


def _turned(
    start: Array, end: Array, center: Array, clockwise: bool, sweep: float, plane: tuple[int, int, int]
) -> Arc | Helix:
    axis, middle = np.zeros(3), start.copy()
    axis[plane[2]] = -1.0 if clockwise else 1.0
    middle[list(plane[:2])] = center
    rise = float((end - start) @ axis)
    if sweep <= FULL_TURN * (1 + 1e-12) and abs(rise) <= STANDSTILL:
        return Arc(start, middle, axis, min(sweep, FULL_TURN))
    return Helix(start, middle, axis, sweep, rise)


def _sweep(first: Array, last: Array, clockwise: bool) -> float:
    angle = float(np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last))
    angle = (-angle if clockwise else angle) % FULL_TURN
    return angle if angle > 1e-6 else FULL_TURN  # no arc is meant to turn by less
