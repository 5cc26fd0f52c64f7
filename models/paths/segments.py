"""Segments of a task path: straight lines, circular arcs and helices in space, tool orientation carried along.

All are curves of constant curvature k and torsion w, and one formula, with the arc length s from the start and
T, N, B = T x N there, serves them all. With o = sqrt(k^2 + w^2), d = (w T + k B)/o and e = (k T - w B)/o

    r(s) = start + w/o d s + k/o [e sin(o s) + N (1 - cos(o s))]/o:

the way along the axis d of the screw, and the way round it. An arc has w = 0, a line k = 0 as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_number
from models.errors import ModelError
from models.paths.orientation import rotation_vector, unit_quaternion
from models.spatial import FULL_TURN

__all__ = ["Arc", "Helix", "Line", "Segment", "screw", "screw_axes"]

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

    @property
    def torsion(self) -> float:
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
        radius = _set_circle(self, "arc")
        sweep = checked_number(self.sweep, "arc", "sweep")
        if not 0 < sweep <= FULL_TURN * (1 + 1e-12) or radius * sweep <= SHORTEST_SEGMENT:
            message = (
                f"arc: sweep {sweep:g} rad is outside (0, 2 pi] or its length {radius * sweep:g} m is zero; "
                "turn the axis round for the other sense, take a Helix for several turns"
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
    def torsion(self) -> float:
        """1/m."""
        return 0.0

    @property
    def end(self) -> Array:
        """End point in world. Shape (3,), m."""
        return np.asarray(screw(self.start, self.tangent, self.normal, self.curvature, 0.0, self.length)[0])


@dataclass(frozen=True, eq=False)
class Helix:
    """A circular helix, or a circle of several turns: of constant curvature and torsion.

    Attributes:
        start: In world. Shape (3,), m.
        center: Of the circle that the helix starts on, in world. Shape (3,), m.
        axis: Unit vector about which the helix turns, right-handed. Shape (3,).
        sweep: Angle turned, rad: any number of turns, above zero.
        rise: Way along the axis meanwhile, m; below zero it screws left-handed, at zero it stays in its plane.
        start_orientation, end_orientation: As of a Line.

    Raises:
        ModelError: nan, no radius, an axis that is zero or not perpendicular to the radius, a sweep that is not above
            zero.
    """

    start: ArrayInput
    center: ArrayInput
    axis: ArrayInput
    sweep: float
    rise: float
    start_orientation: ArrayInput | None = None
    end_orientation: ArrayInput | None = None

    def __post_init__(self) -> None:
        radius = _set_circle(self, "helix")
        sweep = checked_number(self.sweep, "helix", "sweep", positive=True, unit="rad")
        object.__setattr__(self, "sweep", sweep)
        object.__setattr__(self, "rise", checked_number(self.rise, "helix", "rise"))
        if self.length <= SHORTEST_SEGMENT:
            message = f"helix: sweep {sweep:g} rad at the radius {radius:g} m has the length {self.length:g} m; drop it"
            raise ModelError(message, name="sweep", value=sweep, limit=SHORTEST_SEGMENT)
        _set_orientations(self, "helix")

    @property
    def radius(self) -> float:
        """Of the cylinder that it lies on, m."""
        return float(np.linalg.norm(self.start - self.center))

    @property
    def length(self) -> float:
        """m."""
        return float(np.hypot(self.radius * self.sweep, self.rise))

    @property
    def normal(self) -> Array:
        """Unit vector at the start towards the axis. Shape (3,)."""
        return np.asarray((self.center - self.start) / self.radius)

    @property
    def tangent(self) -> Array:
        """Unit tangent at the start. Shape (3,)."""
        round_the_axis = self.radius * self.sweep * np.cross(self.normal, self.axis)
        return np.asarray((round_the_axis + self.rise * self.axis) / self.length)

    @property
    def curvature(self) -> float:
        """1/m."""
        return self.radius * (self.sweep / self.length) ** 2

    @property
    def torsion(self) -> float:
        """1/m; above zero where it screws right-handed."""
        return self.rise * self.sweep / self.length**2

    @property
    def end(self) -> Array:
        """End point in world. Shape (3,), m."""
        return np.asarray(screw(self.start, self.tangent, self.normal, self.curvature, self.torsion, self.length)[0])


Segment: TypeAlias = Line | Arc | Helix


def screw(
    start: Array,
    tangent: Array,
    normal: Array,
    curvature: float | Array,
    torsion: float | Array,
    distance: float | Array,
) -> tuple[Array, Array, Array, Array]:
    """Point at `distance` along a line, an arc or a helix, and its first three derivatives by the distance.

    Args:
        start, tangent, normal: At distance 0. Shape (..., 3), m and unit vectors.
        curvature, torsion: Shape (...), 1/m; both zero for a line, the torsion for an arc.
        distance: Shape (...), m.

    Returns:
        Position (m), unit tangent, curvature vector (1/m), its derivative (1/m^2). Shape (..., 3) each.
    """
    climb, ahead, inward, rate = screw_axes(tangent, normal, curvature, torsion)
    rate, s = rate[..., None], np.asarray(distance, dtype=float)[..., None]
    angle = rate * s
    sine, cosine = np.sin(angle), np.cos(angle)
    along = s * np.sinc(angle / np.pi)
    across = rate * s**2 / 2 * np.sinc(angle / (2 * np.pi)) ** 2
    position = start + s * climb + along * ahead + across * inward
    turning = cosine * ahead + sine * inward
    return position, climb + turning, rate * (cosine * inward - sine * ahead), -(rate**2) * turning


def screw_axes(
    tangent: Array, normal: Array, curvature: float | Array, torsion: float | Array
) -> tuple[Array, Array, Array, Array]:
    """The tangent's part along the axis of the screw and that round it, the part towards it, and the rate of turning.

    Shape (..., 3) three times; (...), rad/m. Arguments as of `screw`.
    """
    k, w = np.asarray(curvature, dtype=float), np.asarray(torsion, dtype=float)
    if not np.any(w):
        return np.zeros_like(tangent), tangent, normal, k
    rate = np.hypot(k, w)
    safe = np.where(rate == 0, 1.0, rate)
    level, steep = np.where(rate == 0, 1.0, k / safe)[..., None], (w / safe)[..., None]
    binormal = np.cross(tangent, normal)
    climb = steep * (steep * tangent + level * binormal)
    return climb, level * (level * tangent - steep * binormal), level * normal, rate


def _set_circle(segment: Any, owner: str) -> float:
    """Check start, center and axis, and set them. Returns the radius, m."""
    for what in ("start", "center", "axis"):
        object.__setattr__(segment, what, checked_array(getattr(segment, what), (3,), owner, what))
    norm = float(np.linalg.norm(segment.axis))
    if norm == 0:
        message = f"{owner}: axis [0, 0, 0] has no direction; give the one that it turns about"
        raise ModelError(message, name="axis", value=segment.axis)
    object.__setattr__(segment, "axis", segment.axis / norm)
    radius = float(np.linalg.norm(segment.start - segment.center))
    if radius <= SHORTEST_SEGMENT:
        message = f"{owner}: start {segment.start.tolist()} is its center; its radius {radius:g} m is no circle"
        raise ModelError(message, name="radius", value=radius, limit=SHORTEST_SEGMENT)
    slope = abs(float(segment.axis @ (segment.start - segment.center))) / radius
    most = 1e-6
    if slope > most:
        message = (
            f"{owner}: axis {segment.axis.tolist()} is not perpendicular to the radius from {segment.center.tolist()} "
            f"to {segment.start.tolist()} (cosine {slope:.3g}); move the center along the axis to the start's height"
        )
        raise ModelError(message, name="axis", value=slope, limit=most)
    return radius


def _set_orientations(segment: Segment, owner: str) -> None:
    for what in ("start_orientation", "end_orientation"):
        if getattr(segment, what) is not None:
            object.__setattr__(segment, what, unit_quaternion(getattr(segment, what), f"{owner}: {what}"))
    if segment.start_orientation is not None and segment.end_orientation is not None:
        rotation_vector(segment.start_orientation, segment.end_orientation, owner)  # refuses half turns
