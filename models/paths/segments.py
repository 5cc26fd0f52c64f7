"""Segments of a task path: straight lines, circular arcs and helices in space, with tool orientations.

All are curves of constant curvature k and torsion w. With the arc length s, the Frenet frame T, N, B = T x N at the
start, o = sqrt(k^2 + w^2), d = (w T + k B)/o and e = (k T - w B)/o, they are

    r(s) = start + w/o d s + k/o [e sin(o s) + N (1 - cos(o s))]/o,

a translation along the screw axis d and a rotation about it. An arc has w = 0, a line k = 0 as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import atan2, hypot
from typing import Any, ClassVar, TypeAlias

import numpy as np

from models.checks import Array, ArrayInput, freeze, require, set_fields
from models.errors import ModelError
from models.paths.splines import Spline
from models.spatial import FULL_TURN

SHORTEST_SEGMENT = 1e-9
"""Shortest length of a segment, m."""


@dataclass(frozen=True, eq=False)
class Line:
    """A straight segment of a path.

    Attributes:
        start, end: Start and end point in world. Shape (3,), m.
        start_orientation, end_orientation: Tool orientation in world at both ends, unit quaternion [w, x, y, z]. Shape
            (4,). Between them the tool turns about a fixed axis, by the shorter way, in proportion to the distance. A
            start of None continues the segment before (the first one: no rotation); an end of None equals the start.
        curvature, torsion: Zero, 1/m.

    Raises:
        ModelError: An entry is not finite, the length is zero, or a quaternion is not normalised.
    """

    start: ArrayInput
    end: ArrayInput
    start_orientation: ArrayInput | None = None
    end_orientation: ArrayInput | None = None
    curvature: ClassVar[float] = 0.0
    torsion: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            set_fields(self, **{name: require.array(f"line: {name}", getattr(self, name), (3,))})
        _set_orientations(self, "line")
        if self.length <= SHORTEST_SEGMENT:
            message = (
                f"line from {self.start.tolist()} to {self.end.tolist()} m has the length {self.length:g} m; "
                "remove it, or turn the tool along a segment that moves"
            )
            raise ModelError(message, name="length", value=self.length, limit=SHORTEST_SEGMENT)

    @cached_property
    def length(self) -> float:
        """Length of the line, m."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def tangent(self) -> Array:
        """Unit tangent of the line. Shape (3,)."""
        return np.asarray((self.end - self.start) / self.length)

    @property
    def normal(self) -> Array:
        """Zero vector, because a line has no unique normal. Shape (3,)."""
        return np.zeros(3)


class _Circular:
    """Common geometry of arcs and helices: start, center, axis, sweep and, for a helix, rise."""

    start: ArrayInput
    center: ArrayInput
    axis: ArrayInput
    sweep: float
    rise: float

    @property
    def radius(self) -> float:
        """Radius of the circle, or of the cylinder that the helix lies on, m."""
        return float(np.linalg.norm(self.start - self.center))

    @property
    def normal(self) -> Array:
        """Unit normal of the arc or helix at its start, towards the axis. Shape (3,)."""
        return np.asarray((self.center - self.start) / self.radius)

    @property
    def length(self) -> float:
        """Arc length of the arc or helix, m."""
        return float(np.hypot(self.radius * self.sweep, self.rise))

    @property
    def tangent(self) -> Array:
        """Unit tangent of the arc or helix at its start. Shape (3,)."""
        tangential = self.radius * self.sweep * np.cross(self.normal, self.axis)
        return np.asarray((tangential + self.rise * self.axis) / self.length)

    @property
    def curvature(self) -> float:
        """Constant curvature of the arc or helix, 1/m."""
        return self.radius * (self.sweep / self.length) ** 2

    @property
    def torsion(self) -> float:
        """Constant torsion of the arc or helix, 1/m: positive for a right-handed helix, zero for an arc."""
        return self.rise * self.sweep / self.length**2

    @property
    def end(self) -> Array:
        """End point of the arc or helix in the world. Shape (3,), m."""
        frame = self.start, self.tangent, self.normal
        return np.asarray(screw(*frame, curvature=self.curvature, torsion=self.torsion, distance=self.length)[0])


@dataclass(frozen=True, eq=False)
class Arc(_Circular):
    """A circular arc in any plane, up to a full circle. `Arc.through` and `Arc.about` construct it.

    Attributes:
        start: Start point in world. Shape (3,), m.
        center: Center of the circle in world. Shape (3,), m.
        axis: Unit vector about which the arc turns, right-handed. Shape (3,).
        sweep: Angle of rotation, rad, in (0, 2 pi].
        start_orientation, end_orientation: As for a Line.
        rise: Zero, m.

    Raises:
        ModelError: An entry is not finite, the radius is zero, the axis is zero or not perpendicular to the radius, or
            the sweep is out of range.
    """

    start: ArrayInput
    center: ArrayInput
    axis: ArrayInput
    sweep: float
    start_orientation: ArrayInput | None = None
    end_orientation: ArrayInput | None = None
    rise: ClassVar[float] = 0.0  # type: ignore[misc]

    def __post_init__(self) -> None:
        radius = _set_circle(self, "arc")
        sweep = require.number("arc: sweep", self.sweep)
        if not 0 < sweep <= FULL_TURN * (1 + 1e-12) or radius * sweep <= SHORTEST_SEGMENT:
            message = (
                f"arc: sweep {sweep:g} rad is outside (0, 2 pi] or its length {radius * sweep:g} m is zero; "
                "reverse the axis for the other sense, use a Helix for several turns"
            )
            raise ModelError(message, name="sweep", value=sweep, limit=(0.0, FULL_TURN))
        set_fields(self, sweep=sweep)
        _set_orientations(self, "arc")

    @classmethod
    def about(
        cls,
        start: ArrayInput,
        center: ArrayInput,
        axis: ArrayInput,
        sweep: float,
        *,
        start_orientation: ArrayInput | None = None,
        end_orientation: ArrayInput | None = None,
    ) -> Arc:
        """Return the arc from `start` around `center` by `sweep` rad about `axis`; a negative sweep turns backwards."""
        turn = require.number("arc: sweep", sweep)
        vector = require.array("arc: axis", axis, (3,))
        return cls(start, center, vector if turn >= 0 else -vector, abs(turn), start_orientation, end_orientation)

    @classmethod
    def through(
        cls,
        start: ArrayInput,
        via: ArrayInput,
        end: ArrayInput,
        *,
        start_orientation: ArrayInput | None = None,
        end_orientation: ArrayInput | None = None,
    ) -> Arc:
        """Return the circular arc from `start` through `via` to `end`. Shape (3,) each, m.

        Raises:
            ModelError: Points coincide or are collinear.
        """
        points = {"start": start, "via": via, "end": end}
        a, b, c = (require.array(f"arc: {name}", point, (3,)) for name, point in points.items())
        ab, ac = b - a, c - a
        axis = np.cross(ab, ac)
        area, size = float(np.linalg.norm(axis)), float(np.linalg.norm(ab) * np.linalg.norm(ac))
        if area <= 1e-9 * size or np.linalg.norm(c - b) <= SHORTEST_SEGMENT:
            message = f"arc through {a.tolist()}, {b.tolist()}, {c.tolist()}: the points lie on a line or coincide"
            raise ModelError(f"{message}; use a Line, or Arc.about for a full circle", name="points", value=(a, b, c))
        # built upon the chord and the angle at `via`: accurate to rounding for flat arcs too, whose center is far away
        chord = float(np.linalg.norm(ac))
        along, axis = ac / chord, axis / area
        axis = axis - (axis @ along) * along
        height = -chord / 2 * float((a - b) @ (c - b)) / area
        center = (a + c) / 2 + height * np.cross(axis, along)
        sweep = 2 * float(np.arctan2(chord / 2, height))
        return cls(a, center, axis, sweep, start_orientation, end_orientation)


@dataclass(frozen=True, eq=False)
class Helix(_Circular):
    """A circular helix, or a circle of several turns: a curve of constant curvature and torsion.

    Attributes:
        start: Start point in world. Shape (3,), m.
        center: Center of the circle that the helix starts on, in world. Shape (3,), m.
        axis: Unit vector about which the helix turns, right-handed. Shape (3,).
        sweep: Angle of rotation, rad; positive, any number of turns.
        rise: Displacement along the axis, m; negative for a left-handed screw, zero for a planar curve.
        start_orientation, end_orientation: As for a Line.

    Raises:
        ModelError: An entry is not finite, the radius is zero, the axis is zero or not perpendicular to the radius, or
            the sweep is not positive.
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
        sweep = require.positive("helix: sweep", self.sweep, unit="rad")
        set_fields(self, sweep=sweep, rise=require.number("helix: rise", self.rise))
        if self.length <= SHORTEST_SEGMENT:
            message = f"helix: sweep {sweep:g} rad at radius {radius:g} m has the length {self.length:g} m; remove it"
            raise ModelError(message, name="sweep", value=sweep, limit=SHORTEST_SEGMENT)
        _set_orientations(self, "helix")


Segment: TypeAlias = Line | Arc | Helix | Spline


def screw(
    start: Array,
    tangent: Array,
    normal: Array,
    *,
    curvature: float | Array,
    torsion: float | Array,
    distance: float | Array,
) -> tuple[Array, Array, Array, Array]:
    """Return the point at a distance along a line, arc or helix, and three derivatives with respect to the distance.

    Args:
        start, tangent, normal: Point, unit tangent and unit normal at distance 0. Shape (..., 3), m and unit vectors.
        curvature, torsion: Shape (...), 1/m; both zero for a line, torsion zero for an arc.
        distance: Shape (...), m.

    Returns:
        Position (m), unit tangent, curvature vector (1/m), its derivative (1/m^2). Shape (..., 3) each.
    """
    axial, tangential, inward, rate = screw_axes(tangent, normal, curvature, torsion)
    rate, s = rate[..., None], np.asarray(distance, dtype=float)[..., None]
    angle = rate * s
    sine, cosine = np.sin(angle), np.cos(angle)
    along = s * np.sinc(angle / np.pi)
    across = rate * s**2 / 2 * np.sinc(angle / (2 * np.pi)) ** 2
    position = start + s * axial + along * tangential + across * inward
    turning = cosine * tangential + sine * inward
    return position, axial + turning, rate * (cosine * inward - sine * tangential), -(rate**2) * turning


def screw_axes(
    tangent: Array, normal: Array, curvature: float | Array, torsion: float | Array
) -> tuple[Array, Array, Array, Array]:
    """Return axial and tangential part of a helix's tangent, the vector to its axis (..., 3), and turn rate (rad/m).

    The arguments are those of `screw`.
    """
    k, w = np.asarray(curvature, dtype=float), np.asarray(torsion, dtype=float)
    if not np.any(w):
        return np.zeros_like(tangent), tangent, normal, k
    rate = np.hypot(k, w)
    safe = np.where(rate == 0, 1.0, rate)
    level, steep = np.where(rate == 0, 1.0, k / safe)[..., None], (w / safe)[..., None]
    binormal = np.cross(tangent, normal)
    axial = steep * (steep * tangent + level * binormal)
    return axial, level * (level * tangent - steep * binormal), level * normal, rate


def _set_circle(segment: Any, owner: str) -> float:
    """Check and set start, center and axis of an arc or a helix; return the radius, m."""
    for name in ("start", "center", "axis"):
        set_fields(segment, **{name: require.array(f"{owner}: {name}", getattr(segment, name), (3,))})
    norm = float(np.linalg.norm(segment.axis))
    if norm == 0:
        message = f"{owner}: axis [0, 0, 0] has no direction; give the axis of rotation"
        raise ModelError(message, name="axis", value=segment.axis)
    set_fields(segment, axis=segment.axis / norm)
    radius = float(np.linalg.norm(segment.start - segment.center))
    if radius <= SHORTEST_SEGMENT:
        message = f"{owner}: start {segment.start.tolist()} coincides with the center; the radius {radius:g} m is zero"
        raise ModelError(message, name="radius", value=radius, limit=SHORTEST_SEGMENT)
    slope = abs(float(segment.axis @ (segment.start - segment.center))) / radius
    tolerance = 1e-6
    if slope > tolerance:
        message = (
            f"{owner}: axis {segment.axis.tolist()} is not perpendicular to the radius from {segment.center.tolist()} "
            f"to {segment.start.tolist()} (cosine {slope:.3g}); move the center along the axis to the start's height"
        )
        raise ModelError(message, name="axis", value=slope, limit=tolerance)
    return radius


def _set_orientations(segment: Segment, owner: str) -> None:
    for name in ("start_orientation", "end_orientation"):
        if getattr(segment, name) is not None:
            set_fields(segment, **{name: unit_quaternion(getattr(segment, name), f"{owner}: {name}")})
    if segment.start_orientation is not None and segment.end_orientation is not None:
        rotation_vector(segment.start_orientation, segment.end_orientation, owner)  # refuses half turns


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


LARGEST_TURN = np.pi - 1e-3
"""Largest angle (rad) allowed between two orientations; near pi the shorter of the two rotations is ambiguous."""


def unit_quaternion(value: ArrayInput, label: str) -> Array:
    """Return `value` as a read-only unit quaternion [w, x, y, z]; raise a ModelError if its norm is not 1."""
    quaternion = require.array(f"{label}: quaternion", value, (4,))
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-6:
        message = f"{label}: quaternion {quaternion.tolist()} has the norm {norm:g}; give a unit quaternion"
        raise ModelError(message, name=label, value=quaternion, limit=1.0)
    return freeze(quaternion / norm)


def rotation_vector(first: ArrayInput, second: ArrayInput, owner: str = "orientation") -> Array:
    """Return the vector of the shorter rotation between orientations, second = first exp(vector). Shape (3,), rad.

    Raises:
        ModelError: The orientations differ by nearly half a turn, so the shorter rotation is ambiguous.
    """
    # plain floats: a path has many segments, and numpy is slow for three entries
    p0, p1, p2, p3 = np.asarray(first, dtype=float).tolist()
    q0, q1, q2, q3 = np.asarray(second, dtype=float).tolist()
    scalar = p0 * q0 + p1 * q1 + p2 * q2 + p3 * q3
    x = p0 * q1 - q0 * p1 - (p2 * q3 - p3 * q2)
    y = p0 * q2 - q0 * p2 - (p3 * q1 - p1 * q3)
    z = p0 * q3 - q0 * p3 - (p1 * q2 - p2 * q1)
    if scalar < 0:
        scalar, x, y, z = -scalar, -x, -y, -z
    norm = hypot(x, y, z)
    angle = 2 * atan2(norm, scalar)
    if angle > LARGEST_TURN:
        message = (
            f"{owner}: the tool turns by {np.degrees(angle):.4g} deg in one segment, so the sense of rotation is "
            "ambiguous; split the segment"
        )
        raise ModelError(message, name=owner, value=angle, limit=LARGEST_TURN)
    factor = angle / norm if norm > 0 else 2.0
    return np.array([x * factor, y * factor, z * factor])
