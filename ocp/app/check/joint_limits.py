"""Interpolate joint samples as controllers do, and check joint limits between the samples.

A file with positions alone is interpolated linearly, one with velocities by cubics (Hermite), and one with
accelerations by quintics, which overestimate an acceleration that jumps. A quantity is therefore compared with a limit
only as far as every motion through the samples needs it (`Motion.needed`), unless the rule of the controller is stated.
Without velocities, any smooth motion through three samples has the acceleration 2 q[t0, t1, t2] at some time between
them, and any through four the jerk 6 q[t0, t1, t2, t3]. A violation smaller than the rounding error of the file's
digits is reported but is not a fault.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from math import comb
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from models import FixedBase, Robot
from models.checks import Array, real
from ocp.errors import ProblemError, require
from ocp.motion.result.plan import ENDS, describe_ends
from ocp.motion.tasks.checks import CHECKS
from ocp.motion.tasks.limits import LIMITED, JointBounds, Limits
from ocp.tolerances import LIMIT_SHARE

Indices: TypeAlias = NDArray[np.intp]
Rule: TypeAlias = Literal["linear", "cubic", "quintic"]
CHECKED_LIMITS = tuple(kind for kind in LIMITED if kind != "power")
"""Limits that can be given to a check."""
ORDERS = {"position": "", "velocity": "/s", "acceleration": "/s^2", "jerk": "/s^3"}
"""Checked quantities of a joint, and the suffix that turns rad or m into the unit of the quantity."""


class RowVerdict(StrEnum):
    """Verdict on one quantity in the table of results of a check, such as the velocity of a joint."""

    OK = "ok"
    FAILED = "FAILED"
    UNDECIDED = "undetermined"
    """Verdict if the file has too few digits, or the proof is inconclusive."""
    UNLIMITED = "unlimited"
    INFO = "info"
    """Verdict on a value that is given as information, without a requirement."""

    @classmethod
    def of(cls, failed: Any, doubtful: Any = False) -> RowVerdict:
        """Return the verdict on a limited value: FAILED if the limit is certainly violated, UNDECIDED if possibly."""
        return cls.FAILED if failed else cls.UNDECIDED if doubtful else cls.OK


@dataclass(frozen=True)
class Row:
    """One line of the table of a check: a quantity with its worst value, its limit and the verdict.

    Attributes:
        name: Quantity, and joint or bodies.
        value, limit: Worst value, and limit (None if there is none), in `unit`.
        time: Time of the worst value, s.
        verdict: Verdict on the value.
        note: Method of the check, if it is not obvious.
    """

    name: str
    value: float
    limit: float | None
    unit: str
    time: float | None
    verdict: RowVerdict
    note: str = ""

    @property
    def urgency(self) -> float:
        """Sort key of the row: 2 if it failed or is undetermined, else how near its value is to its limit, 0 to 1."""
        small, large = sorted(abs(one) for one in (self.value, self.limit or 0.0))
        nearness = small / large if large > 0 else 0.0
        return 2.0 if self.verdict in (RowVerdict.FAILED, RowVerdict.UNDECIDED) else nearness


@dataclass(frozen=True)
class Fault:
    """A fault of a trajectory, such as a violated limit or a jump: what is wrong, where, and by how much.

    Attributes:
        kind: "jump", "velocity", "clearance", "suspicion", ...
        name: Joint, pair of bodies, or waypoint; "" if it concerns the whole trajectory.
        text: Description of the fault.
        time: Time of the worst violation, s; None if it holds throughout.
        first: Time of the first violation, s.
        value, limit: Worst value and allowed value.
        unit: Unit of both values.
        line: Line in the file, if the fault is in one line.
    """

    kind: str
    name: str
    text: str
    time: float | None = None
    first: float | None = None
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    line: int | None = None

    def __str__(self) -> str:
        where = f"{self.name}: " if self.name else ""
        return f"{self.kind}: {where}{self.text}"


# ---- interpolation ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Piecewise polynomials of degree d for n joints: breaks (N + 1,), s, and Bernstein coefficients (N, d + 1, n)."""

    t: Array
    coefficients: Array

    def derivative(self) -> PiecewisePolynomial:
        """Return the time derivative of the piecewise polynomials."""
        degree = self.coefficients.shape[1] - 1
        return PiecewisePolynomial(self.t, degree * np.diff(self.coefficients, axis=1) / np.diff(self.t)[:, None, None])

    def at(self, times: Array) -> Array:
        """Return values (M, n) at times (M,), clipped to the range of `t`; a break belongs to the later interval."""
        interval = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        begin, end = self.t[interval], self.t[interval + 1]
        return self.within(interval, np.clip((times - begin) / (end - begin), 0.0, 1.0))

    def within(self, interval: Indices, fraction: Array) -> Array:
        """Return values (M, n) in the intervals with given indices (M,) at fractions (M,), 0 to 1, of the intervals."""
        own, s = self.coefficients[interval], fraction[:, None]
        degree = own.shape[1] - 1
        terms = (comb(degree, k) * s**k * (1 - s) ** (degree - k) * own[:, k] for k in range(degree + 1))
        return np.asarray(sum(terms))

    @property
    def greatest(self) -> Array:
        """Upper bounds of the absolute values of the polynomials in each interval. Shape (N, n)."""
        return np.asarray(np.abs(self.coefficients).max(axis=1))


def polynomial_maxima(coefficients: Array) -> tuple[Array, Array]:
    """Return maxima on [0, 1] of polynomials in Bernstein form (K, d + 1), and where they occur. Shape (K,) each."""
    first, last, count = coefficients[:, 0], coefficients[:, -1], len(coefficients)
    best, argument = np.maximum(first, last), (last > first).astype(float)
    pieces = scipy.interpolate.BPoly(coefficients.T, np.arange(count + 1.0))
    slopes = scipy.interpolate.PPoly.from_bernstein_basis(pieces.derivative())
    stationary = slopes.roots(discontinuity=False, extrapolate=False)
    stationary = stationary[np.isfinite(stationary)]
    owner, values = np.minimum(stationary.astype(int), count - 1), pieces(stationary)
    improved = np.flatnonzero(values > best[owner])
    order = improved[np.argsort(values[improved])]  # of several maxima in one interval the greatest is assigned last
    best[owner[order]], argument[owner[order]] = values[order], stationary[order] - owner[order]
    return best, argument


class MotionQuantity(NamedTuple):
    """A quantity, such as the velocity, of every joint along a motion.

    Attributes:
        pieces: The quantity as polynomials, or the constants between two times that divided differences give.
        blur: Largest error of the quantity due to the digits of the file. Shape (N, n).
        closed: Whether it is that of the interpolant at every time, and not of any motion through the samples at some.
        needed: See `Motion.needed`.
    """

    pieces: PiecewisePolynomial
    blur: Array
    closed: bool
    needed: tuple[Any, Any] = (np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of a joint motion at times (M,), s, and the rule of interpolation between them.

    Velocities or accelerations (M, n) may be None. `stated` says that the controller is known to interpolate by this
    rule, so that the interpolant itself counts.
    """

    t: Array
    q: Array
    v: Array | None = None
    a: Array | None = None
    stated: bool = False

    @property
    def rule(self) -> Rule:
        """Name of the rule of interpolation between the samples: "linear", "cubic" or "quintic"."""
        return "linear" if self.v is None else "cubic" if self.a is None else "quintic"

    def by(self, rule: Rule) -> Motion:
        """Return the same samples with another rule of interpolation; raise ProblemError if they lack values for it."""
        missing = "velocities" if self.v is None else "accelerations" if self.a is None and rule == "quintic" else None
        if rule != "linear" and missing:
            words = f"the rule {rule!r} needs {missing}, which are not given for every joint; omit the rule"
            raise ProblemError(words, name="rule", value=rule)
        v, a = None if rule == "linear" else self.v, self.a if rule == "quintic" else None
        return Motion(self.t, self.q, v, a, stated=True)

    @cached_property
    def position(self) -> PiecewisePolynomial:
        """Positions between the samples as piecewise polynomials of time."""
        h = np.diff(self.t)[:, None]
        q, v, a = self.q, self.v, self.a
        if v is None:
            inner: list[Array] = []
        elif a is None:
            inner = [q[:-1] + h / 3 * v[:-1], q[1:] - h / 3 * v[1:]]
        else:
            inner = [
                q[:-1] + h / 5 * v[:-1],
                q[:-1] + 2 * h / 5 * v[:-1] + h**2 / 20 * a[:-1],
                q[1:] - 2 * h / 5 * v[1:] + h**2 / 20 * a[1:],
                q[1:] - h / 5 * v[1:],
            ]
        return PiecewisePolynomial(self.t, np.stack([q[:-1], *inner, q[1:]], axis=1))

    @cached_property
    def velocity(self) -> PiecewisePolynomial:
        """Velocities as piecewise polynomials of time; piecewise constant if the file has only positions."""
        return self.position.derivative()

    def end_speeds(self) -> Array:
        """Return the absolute joint speeds at the start and the end, 0 for a joint that rests there. Shape (2, n).

        A motion of which only positions are known counts as at rest at an end if its mean speed in the interval there
        is at most the change of speed to the next interval, as under any constant acceleration or jerk from rest.
        """
        rates = np.diff(self.q, axis=0) / np.diff(self.t)[:, None] if self.v is None else self.v
        speeds, tolerated = np.abs(rates[[0, -1]]), max(LIMIT_SHARE * np.abs(rates).max(initial=0.0), CHECKS.still)
        if self.v is None and len(rates) > 1:
            tolerated = np.maximum(tolerated, np.abs(rates[[0, -1]] - rates[[1, -2]]))
        return np.where(speeds > tolerated, speeds, 0.0)

    @cached_property
    def acceleration(self) -> PiecewisePolynomial | None:
        """Accelerations as piecewise polynomials of time; None for linear interpolation."""
        return None if self.v is None else self.velocity.derivative()

    @cached_property
    def digits(self) -> tuple[Array, Array, Array]:
        """Rounding errors of positions, velocities, accelerations: half a unit in the last digit. Shape (n,) each."""
        none = np.zeros(self.q.shape[1])
        return tuple(none if values is None else half_digits(values) for values in (self.q, self.v, self.a))  # type: ignore[return-value]

    def quantity(self, name: str) -> MotionQuantity | None:
        """Return a quantity along the motion, such as "velocity" or "jerk"; None if the samples are too few for it."""
        h = np.diff(self.t)[:, None]
        eq, ev, ea = self.digits
        smooth = {"linear": 0, "cubic": 1, "quintic": 2}[self.rule]
        if name == "position":
            return MotionQuantity(self.position, np.broadcast_to(eq, h.shape[:1] + eq.shape), True)
        if name == "velocity":
            # only the middle Bernstein coefficient contains the difference of positions
            blur = {0: 2 * eq / h, 1: 3 * eq / h + ev, 2: 3.75 * eq / h + 2.5 * ev + 0.2 * h * ea}[smooth]
            return MotionQuantity(self.velocity, blur, True, self.needed(name))
        if name == "acceleration" and smooth:
            assert self.acceleration is not None
            blur = 12 * eq / h**2 + 6 * ev / h if smooth == 1 else 30 * eq / h**2 + 15 * ev / h + 3 * ea
            return MotionQuantity(self.acceleration, blur, True, self.needed(name))
        if name == "jerk" and smooth == 2:
            assert self.acceleration is not None
            blur = 120 * eq / h**3 + 60 * ev / h**2 + 12 * ea / h
            return MotionQuantity(self.acceleration.derivative(), blur, True, self.needed(name))
        values, digits, order = (self.q, eq, 2 if name == "acceleration" else 3) if smooth == 0 else (self.v, ev, 2)
        assert values is not None
        return self._differences(values, digits, order)

    def needed(self, name: str) -> tuple[Any, Any]:
        """Return, for each interval, the least maximum of a quantity, and of its negative, that the samples permit.

        Acceleration: a motion through two samples needs the least acceleration if it switches once from A to -A,
        where A = (2 |e| + sqrt(4 e^2 + h^2 d^2)) / h^2, d is the change of velocity, and e is the displacement minus h
        times the mean of both velocities. Given accelerations count as well. Jerk: three weighted means, with weights 1
        and the Chebyshev polynomials U1 and U2 of the interval; from rest to rest this gives 32 of the 60 that a
        quintic has. Velocity: the peak of a trapezoidal profile, the lowest of all motions that accelerate no harder
        than this interval or its neighbours need; without that bound only the mean velocity would be certain.
        """
        if self.stated or self.v is None:
            return np.inf, np.inf
        h, v, a = np.diff(self.t)[:, None], self.v, self.a
        displacement, change, mean = np.diff(self.q, axis=0), np.diff(v, axis=0), (v[1:] + v[:-1]) / 2
        residual = displacement - h * mean
        if name == "jerk" and a is not None:
            step = np.diff(a, axis=0)
            means = (step * h**2, 4 * h * (change - h * (a[1:] + a[:-1]) / 2), 32 * residual + 3 * h**2 * step)
            jerk = np.abs(means).max(axis=0) / h**3
            return jerk, jerk
        least = (2 * np.abs(residual) + np.sqrt(4 * residual**2 + (h * change) ** 2)) / h**2
        if a is not None:
            least = np.maximum(least, np.maximum(np.abs(a[1:]), np.abs(a[:-1])))
        if name == "acceleration":
            return least, least
        padded = np.pad(least, ((1, 1), (0, 0)))
        hardest = np.maximum(least, np.maximum(padded[2:], padded[:-2]))
        ends = (v[1:] ** 2 + v[:-1] ** 2) / 2

        def peak(sign: float) -> Array:
            middle = hardest * h / 2 + sign * mean
            lowest = middle - np.sqrt(np.maximum(middle**2 - sign * hardest * displacement - ends, 0.0))
            return np.asarray(np.maximum(lowest, np.maximum(sign * v[1:], sign * v[:-1])))

        return peak(1.0), peak(-1.0)

    def _differences(self, values: Array, digits: Array, order: int) -> MotionQuantity | None:
        """Return a time derivative of sampled values by divided differences; None if the samples are too few."""
        if len(self.t) <= order:
            return None
        table, blur = values, np.broadcast_to(digits, values.shape)
        for k in range(1, order + 1):
            width = (self.t[k:] - self.t[:-k])[:, None]
            table, blur = k * np.diff(table, axis=0) / width, k * (blur[1:] + blur[:-1]) / width
        begin, end = self.t[:-order], self.t[order:]
        middle = (begin + end) / 2
        edges = np.concatenate([[begin[0]], (middle[1:] + middle[:-1]) / 2, [end[-1]]])
        return MotionQuantity(PiecewisePolynomial(edges, table[:, None]), blur, False)


def interpolate(times: Array, t: Array, values: Array) -> Array:
    """Interpolate `values` (M, n), given at increasing times `t` (M,), linearly at other times (K,). Shape (K, n)."""
    return np.column_stack([np.interp(times, t, column) for column in values.T])


@np.errstate(over="ignore", invalid="ignore")  # numbers beyond 1e296 overflow when scaled: they have no such digits
def half_digits(values: Array) -> Array:
    """Return the rounding error of each column of numbers: half of its last decimal or binary digit. Shape (n,).

    Columns with digits coarser than a thousandth or with few values count as exact.
    """
    errors = np.asarray(2.0**-53 * np.abs(values).max(axis=0))
    for k, column in enumerate(values.T):
        distinct = np.unique(column)
        if len(distinct) < 20:
            continue
        for power in range(3, 13):
            scaled = distinct * 10.0**power
            if (np.abs(scaled - np.rint(scaled)) <= 1e-14 * np.abs(scaled) + 1e-9).all():
                errors[k] = 0.5 * 10.0**-power
                break
        else:
            if (distinct.astype(np.float32) == distinct).all():
                errors[k] = 2.0**-25 * np.abs(distinct).max()
    return errors


# ---- limits -------------------------------------------------------------------------------------------------------


def limits_by_name(robot: Robot, limits: Mapping[str, Mapping[str, float]]) -> Limits:
    """Combine limits given by joint name with the limits of the robot for all other joints.

    `limits` has for names in CHECKED_LIMITS the limits by name of the joint; "" stands for all joints not named.

    Raises:
        ProblemError: A joint is unknown, or a limit is not a number above 0.
    """
    own = Limits().bounds(FixedBase(robot))
    values: dict[str, Any] = {}
    for quantity, by_name in limits.items():
        for name, value in by_name.items():
            if not real(value) > 0:
                words = f"{quantity} of {name or 'all joints'} must be a number above 0, not {value!r}"
                raise ProblemError(words, name=quantity, value=value, limit=0.0)
            if name and name not in robot.joint_names:
                raise require.unknown(f"joint in {quantity}", name, robot.joint_names)
        defaults = zip(robot.joint_names, getattr(own, quantity), strict=True)
        values[quantity] = np.array([by_name.get(name, by_name.get("", default)) for name, default in defaults])
    return Limits(**values)


def limit_rows(
    motion: Motion, robot: Robot, joints: Indices, bounds: JointBounds, *, share: float
) -> tuple[list[Row], list[Fault], list[str]]:
    """Check a motion against all joint limits; return table rows, faults, and the quantities that could not be checked.

    `joints` are the indices of the motion's joints in the joint vector; `share` is the tolerance relative to a limit.
    """
    rows: list[Row] = []
    faults: list[Fault] = []
    unchecked = []
    for order, per in ORDERS.items():
        quantity = motion.quantity(order)
        if quantity is None:
            if np.isfinite(getattr(bounds, order)[joints]).any():
                unchecked.append(f"{order}, because there are too few samples")
            continue
        most = None if order == "position" else getattr(bounds, order)
        lower, upper = (bounds.lower, bounds.upper) if most is None else (-most, most)
        for column, joint in enumerate(joints):
            name, low, high = robot.joint_names[joint], float(lower[joint]), float(upper[joint])
            row, fault = _check_limits(quantity, column, order, name, robot.joint(name).unit + per, low, high, share)
            rows.append(row)
            faults += fault
    return rows, faults, unchecked


def rest_row(motion: Motion, robot: Robot, joints: Indices) -> Row:
    """Return the table row of the largest joint speed at both ends of a motion, with verdict OK if all joints rest."""
    speeds, names = motion.end_speeds(), [robot.joint_names[k] for k in joints]
    units = [robot.joint(name).unit for name in names]
    end, column = (int(k) for k in np.unravel_index(int(speeds.argmax()), speeds.shape))
    text = describe_ends(speeds, names, units)
    verdict = RowVerdict.INFO if text else RowVerdict.OK
    time = float(motion.t[[0, -1][end]])
    return Row(ENDS, float(speeds[end, column]), None, f"{units[column]}/s", time, verdict, text or "at rest")


class _Side(NamedTuple):
    """Largest values of a joint quantity towards the upper or the lower limit, in each interval between samples.

    Values (N,) and limit are multiplied by `sign`: 1 for the upper limit, -1 for the lower. They are at most what every
    motion through the samples needs; `eased` is true if the interpolant violates the limit, but not every such motion.
    """

    sign: float
    limit: float
    values: Array
    time: float
    eased: bool

    @property
    def worst_value(self) -> float:
        """Value that is nearest to the limit or farthest beyond it, with its original sign."""
        return self.sign * float(self.values.max())


def _side(quantity: MotionQuantity, column: int, sign: float, limit: float, tolerance: float) -> _Side:
    """Return the largest values of a quantity of one joint towards its upper (sign 1) or lower limit (-1)."""
    coefficients, t = sign * quantity.pieces.coefficients[:, :, column], quantity.pieces.t
    needed = np.broadcast_to(quantity.needed[0 if sign > 0 else 1], quantity.blur.shape)[:, column]
    ends, enclosed = np.maximum(coefficients[:, 0], coefficients[:, -1]), coefficients.max(axis=1)
    # refine the intervals whose enclosure exceeds the largest end value or the limit
    above = np.minimum(enclosed, needed) > np.minimum(ends, needed).max()
    refined = np.flatnonzero(above | ((enclosed > limit) & (ends <= limit)))
    values, fractions = ends.copy(), (coefficients[:, -1] > coefficients[:, 0]).astype(float)
    if refined.size and coefficients.shape[1] > 2:
        values[refined], fractions[refined] = polynomial_maxima(coefficients[refined])
    eased = bool((values > np.maximum(needed, limit + tolerance)).any())
    values = np.minimum(values, needed)
    k = int(values.argmax())
    share = fractions[k] if coefficients.shape[1] > 1 else 0.5
    return _Side(sign, limit, values, float(t[k] + share * (t[k + 1] - t[k])), eased)


def _check_limits(
    quantity: MotionQuantity, column: int, order: str, name: str, unit: str, low: float, high: float, share: float
) -> tuple[Row, list[Fault]]:
    """Check a quantity of one joint against its limits; return the table row and a list of at most one fault."""
    note = "" if quantity.closed else "of any motion through the samples, by divided differences"
    t, blur = quantity.pieces.t, np.asarray(quantity.blur)[:, column]
    tolerance = share * max((abs(limit) for limit in (low, high) if np.isfinite(limit)), default=0.0)
    sides = [_side(quantity, column, *side, tolerance) for side in ((1.0, high), (-1.0, -low))]
    if not np.isfinite([low, high]).any():
        worst = max(sides, key=lambda side: float(side.values.max()))
        return Row(f"{order} of {name}", worst.worst_value, None, unit, worst.time, RowVerdict.UNLIMITED, note), []
    sides.sort(key=lambda side: float(side.values.max()) - side.limit, reverse=True)
    beyond, certain = ([side.values > side.limit + tolerance + error for side in sides] for error in (0.0, blur))
    violated = certain[0] | certain[1]
    verdict = RowVerdict.of(violated.any(), np.any(beyond))
    worst = sides[1] if violated.any() and not certain[0].any() else sides[0]
    value, allowed, time = worst.worst_value, worst.sign * worst.limit, worst.time
    if verdict is RowVerdict.OK and any(side.eased for side in sides):
        note = "; ".join(filter(None, ("the interpolant is beyond, but not every motion through the samples", note)))
    elif verdict is RowVerdict.OK and worst.values.max() > worst.limit:
        note = "; ".join(filter(None, (f"beyond, by less than the {100 * share:g} % allowed", note)))
    row = Row(f"{order} of {name}", value, allowed, unit, time, verdict, note)
    if verdict is not RowVerdict.FAILED:
        return row, []
    starts = np.flatnonzero(violated & ~np.concatenate([[False], violated[:-1]]))
    first = float(t[starts[0]])
    between = ", between two samples" if quantity.closed and time not in t else ""
    stretches = f"; {len(starts)} times, first from {first:.6g} s" if len(starts) > 1 else ""
    share_over = abs(value) / abs(allowed) - 1 if allowed else np.inf
    much = f", {100 * share_over:.3g} % beyond" if 1e-4 < share_over < 10 else ""
    text = f"{value:.5g} {unit} at {time:.6g} s{between}, limit {allowed:.5g}{much}{stretches}"
    return row, [Fault(order, name, text, time, first, value, allowed, unit)]
