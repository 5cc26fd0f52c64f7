"""Segments of a task path: straight lines and circular arcs in space, tool orientation carried along.

Both are curves of constant curvature k, and one formula, with the arc length s from the start, serves both:

    r(s) = start + tangent sin(k s)/k + normal (1 - cos(k s))/k.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_number
from models.errors import ModelError
from models.paths.orientation import rotation_vector, unit_quaternion
from models.spatial import FULL_TURN

__all__ = ["Arc", "Line", "Segment", "constant_curvature"]

SHORTEST_SEGMENT = 1e-9
"""Segments below this length (m) count as points."""


@dataclass(frozen=True, eq=False)
class Line:
    """A straight segment.

    Attributes:
        start, end: In world. Shape (3,), m.
        start_orientation, end_orientation: Tool orientation in world at both ends, unit quaternion [w, x, y, z],
            turned between them about a fixed axis, the shorter way, evenly with the distance. Shape (4,); None takes
            what the segment before ends with (the first one: no rotation), or for the end, that of the start.

    Raises:
        ModelError: nan, a zero length, a quaternion that is none.
    """

    start: ArrayInput
    end: ArrayInput
    start_orientation: ArrayInput | None = None
    end_orientation: ArrayInput | None = None

    def __post_init__(self) -> None:
        for what in ("start", "end"):
            object.__setattr__(self, what, checked_array(getattr(self, what), (3,), "line", what))
        _set_orientations(self, "line")
        if self.length <= SHORTEST_SEGMENT:
            message = (
                f"line from {self.start.tolist()} to {self.end.tolist()} m has the length {self.length:g} m; "
                "drop it, or turn the tool along a segment that moves"
            )
            raise ModelError(message, name="length", value=self.length, limit=SHORTEST_SEGMENT)

    @cached_property
    def length(self) -> float:
        """m."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def tangent(self) -> Array:
        """Unit tangent at the start. Shape (3,)."""
        return np.asarray((self.end - self.start) / self.length)

    @property
    def normal(self) -> Array:
        """Unit normal at the start; zero, since a line has none. Shape (3,)."""
        return np.zeros(3)

    @property
    def curvature(self) -> float:
        """1/m."""
        return 0.0


@dataclass(frozen=True, eq=False)
class Arc:
    """A circular arc in any plane, up to a full circle. Make it by `Arc.through` or `Arc.about`.

    Attributes:
        start: In world. Shape (3,), m.
        center: In world. Shape (3,), m.
        axis: Unit vector about which the arc turns, right-handed. Shape (3,).
        sweep: Angle turned, rad, in (0, 2 pi].
        start_orientation, end_orientation: As of a Line.

    Raises:
        ModelError: nan, no radius, an axis that is zero or not perpendicular to the radius, a sweep out of range.
    """

    start: ArrayInput
    center: ArrayInput
    axis: ArrayInput
    sweep: float
    start_orientation: ArrayInput | None = None
    end_orientation: ArrayInput | None = None

    def __post_init__(self) -> None:
        for what in ("start", "center", "axis"):
            object.__setattr__(self, what, checked_array(getattr(self, what), (3,), "arc", what))
        sweep = checked_number(self.sweep, "arc", "sweep")
        norm = float(np.linalg.norm(self.axis))
        if norm == 0:
            message = "arc: axis [0, 0, 0] has no direction; give the normal of the arc's plane"
            raise ModelError(message, name="axis", value=self.axis)
        object.__setattr__(self, "axis", self.axis / norm)
        radius = float(np.linalg.norm(self.start - self.center))
        if radius <= SHORTEST_SEGMENT:
            message = f"arc: start {self.start.tolist()} is its center; its radius {radius:g} m is no circle"
            raise ModelError(message, name="radius", value=radius, limit=SHORTEST_SEGMENT)
        slope = abs(float(self.axis @ (self.start - self.center))) / radius
        if slope > 1e-6:
            message = (
                f"arc: axis {self.axis.tolist()} is not perpendicular to the radius from {self.center.tolist()} to "
                f"{self.start.tolist()} (cosine {slope:.3g}); move the center along the axis into the arc's plane"
            )
            raise ModelError(message, name="axis", value=slope, limit=1e-6)
        if not 0 < sweep <= FULL_TURN * (1 + 1e-12) or radius * sweep <= SHORTEST_SEGMENT:
            message = (
                f"arc: sweep {sweep:g} rad is outside (0, 2 pi] or its length {radius * sweep:g} m is zero; "
                "turn the axis round for the other sense, chain arcs for several turns"
            )
            raise ModelError(message, name="sweep", value=sweep, limit=(0.0, FULL_TURN))
        object.__setattr__(self, "sweep", sweep)
        _set_orientations(self, "arc")

    @classmethod
    def about(
        cls,
        start: ArrayInput,
        center: ArrayInput,
        axis: ArrayInput,
        sweep: float,
        start_orientation: ArrayInput | None = None,
        end_orientation: ArrayInput | None = None,
    ) -> Arc:
        """Arc from `start` round `center` by `sweep` rad about `axis`; a negative sweep turns the other way."""
        turn = checked_number(sweep, "arc", "sweep")
        vector = checked_array(axis, (3,), "arc", "axis")
        return cls(start, center, vector if turn >= 0 else -vector, abs(turn), start_orientation, end_orientation)

    @classmethod
    def through(
        cls,
        start: ArrayInput,
        via: ArrayInput,
        end: ArrayInput,
        start_orientation: ArrayInput | None = None,
        end_orientation: ArrayInput | None = None,
    ) -> Arc:
        """Arc from `start` over `via` to `end`. Shape (3,) each, m.

        Raises:
            ModelError: Points that coincide or lie on a line.
        """
        points = {"start": start, "via": via, "end": end}
        a, b, c = (checked_array(point, (3,), "arc", what) for what, point in points.items())
        ab, ac = b - a, c - a
        axis = np.cross(ab, ac)
        area, size = float(np.linalg.norm(axis)), float(np.linalg.norm(ab) * np.linalg.norm(ac))
        if area <= 1e-9 * size or np.linalg.norm(c - b) <= SHORTEST_SEGMENT:
            message = f"arc through {a.tolist()}, {b.tolist()}, {c.tolist()}: the points lie on a line or coincide"
            raise ModelError(f"{message}; use a Line, or Arc.about for a full circle", name="points", value=(a, b, c))
        # to rounding for flat arcs too, whose center is far away: all is built upon the chord and the angle at `via`
        chord = float(np.linalg.norm(ac))
        along, axis = ac / chord, axis / area
        axis = axis - (axis @ along) * along
        height = -chord / 2 * float((a - b) @ (c - b)) / area
        center = (a + c) / 2 + height * np.cross(axis, along)
        sweep = 2 * float(np.arctan2(chord / 2, height))
        return cls(a, center, axis, sweep, start_orientation, end_orientation)

    @property
    def radius(self) -> float:
        """m."""
        return float(np.linalg.norm(self.start - self.center))

    @property
    def length(self) -> float:
        """m."""
        return self.radius * self.sweep

    @property
    def normal(self) -> Array:
        """Unit vector at the start towards the center. Shape (3,)."""
        return np.asarray((self.center - self.start) / self.radius)

    @property
    def tangent(self) -> Array:
        """Unit tangent at the start. Shape (3,)."""
        return np.cross(self.normal, self.axis)

    @property
    def curvature(self) -> float:
        """1/m."""
        return 1 / self.radius

    @property
    def end(self) -> Array:
        """End point in world. Shape (3,), m."""
        place = constant_curvature(self.start, self.tangent, self.normal, self.curvature, self.length)[0]
        return np.asarray(place)


Segment: TypeAlias = Line | Arc


def constant_curvature(
    start: Array, tangent: Array, normal: Array, curvature: float | Array, distance: float | Array
) -> tuple[Array, Array, Array, Array]:
    """Point at `distance` along a line or an arc, and its first three derivatives by the distance.

    Args:
        start, tangent, normal: At distance 0. Shape (..., 3), m and unit vectors.
        curvature: Shape (...), 1/m; zero for a line.
        distance: Shape (...), m.

    Returns:
        Position (m), unit tangent, curvature vector (1/m), its derivative (1/m^2). Shape (..., 3) each.
    """
    k, s = np.asarray(curvature, dtype=float)[..., None], np.asarray(distance, dtype=float)[..., None]
    angle = k * s
    sine, cosine = np.sin(angle), np.cos(angle)
    along = s * np.sinc(angle / np.pi)
    across = k * s**2 / 2 * np.sinc(angle / (2 * np.pi)) ** 2
    position = start + along * tangent + across * normal
    first = cosine * tangent + sine * normal
    second = k * (cosine * normal - sine * tangent)
    return position, first, second, -(k**2) * first


def _set_orientations(segment: Segment, owner: str) -> None:
    for what in ("start_orientation", "end_orientation"):
        if getattr(segment, what) is not None:
            object.__setattr__(segment, what, unit_quaternion(getattr(segment, what), f"{owner}: {what}"))
    if segment.start_orientation is not None and segment.end_orientation is not None:
        rotation_vector(segment.start_orientation, segment.end_orientation, owner)  # refuses half turns
