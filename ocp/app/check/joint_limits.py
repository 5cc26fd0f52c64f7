"""Check a motion against joint limits, torque limits, and the conditions of a standing or floating base.

Positions, velocities, accelerations and jerks are bounded at every time by the Bernstein coefficients of the
interpolant; torques are evaluated several times in every interval. The digits of a file leave an error: a violation
smaller than that error is reported but is not a fault.

A standing base is checked by its zero moment point, the vertical force and friction; a floating base moves so that
momentum is conserved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import (
    FixedBase,
    FreeFloating,
    Machine,
    Robot,
    Standing,
    inverse_dynamics,
    momentum,
    robot_inertia,
    simplify,
)
from models.checks import Array, real
from models.machines.standing import center_of_pressure
from models.robot.dynamics import GRAVITY
from models.spatial import cross, rotation_from_quaternion
from ocp.app.check.data_checks import CleanedTrajectory, Fault
from ocp.app.check.interpolation import Indices, Motion, MotionQuantity, polynomial_maxima
from ocp.console import check_time
from ocp.curves import rk4_step
from ocp.errors import ProblemError, require
from ocp.motion.result.plan import ENDS, describe_ends
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.problem.values import Sampler
from ocp.tolerances import MOMENTUM_SHARE, ROUNDING_SHARE

ORDERS = {"position": "", "velocity": "/s", "acceleration": "/s^2", "jerk": "/s^3"}
"""Checked quantities of a joint, and the suffix that turns rad or m into the unit of the quantity."""


class RowVerdict(StrEnum):
    """Verdict on one quantity in the table of results of `selfmotion check`, such as the velocity of a joint."""

    OK = "ok"
    FAILED = "FAILED"
    UNDECIDED = "undetermined"
    """Verdict if the file has too few digits, or the proof is inconclusive."""
    UNLIMITED = "unlimited"
    INFO = "info"
    """Verdict on a value that is given as information, without a requirement."""

    @classmethod
    def of(cls, failed: Any) -> RowVerdict:
        """Return the verdict FAILED or OK for a value that has a limit."""
        return cls.FAILED if failed else cls.OK


@dataclass(frozen=True)
class Row:
    """One line of the table of a check: a quantity with its worst value, its limit and the verdict.

    Attributes:
        name: Quantity, and joint or bodies.
        value: Worst value, in `unit`.
        limit: Limit, in `unit`; None if there is none.
        unit: Unit of value and limit.
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


def limits_by_name(robot: Robot, limits: Mapping[str, Mapping[str, float]]) -> Limits:
    """Combine limits given by joint name with the limits of the robot for all other joints.

    Args:
        robot: The robot.
        limits: For "velocity", "acceleration", "jerk" or "torque" the limits by name of the joint; "" stands for all
            joints that are not named.

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

    Args:
        motion: Motion of the joints.
        robot: The robot.
        joints: Indices of the motion's joints in the joint vector.
        bounds: Limits of the joint vector.
        share: Tolerance relative to a limit.
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
        for column, joint in enumerate(joints):
            name = robot.joint_names[joint]
            unit = robot.joint(name).unit + per
            low, high = (bounds.lower[joint], bounds.upper[joint]) if most is None else (-most[joint], most[joint])
            row, fault = _check_limits(quantity, column, order, name, unit, float(low), float(high), share)
            rows.append(row)
            faults += fault
    return rows, faults, unchecked


def rest_row(motion: Motion, robot: Robot, joints: Indices) -> Row:
    """Return the row about the speed of the joints at both ends of a motion; the verdict is OK if they are at rest."""
    speeds, names = motion.end_speeds(), [robot.joint_names[k] for k in joints]
    units = [robot.joint(name).unit for name in names]
    end, column = (int(k) for k in np.unravel_index(int(speeds.argmax()), speeds.shape))
    text = describe_ends(speeds, names, units)
    verdict = RowVerdict.INFO if text else RowVerdict.OK
    time = float(motion.t[[0, -1][end]])
    return Row(ENDS, float(speeds[end, column]), None, f"{units[column]}/s", time, verdict, text or "at rest")


class _Side(NamedTuple):
    """Largest values of one quantity of a joint towards its upper or lower limit, in each interval between samples.

    Values and limit are multiplied by `sign`.

    Attributes:
        sign: 1 for the upper limit, -1 for the lower.
        limit: The limit.
        values: Maxima, at most the values that every motion through the samples needs. Shape (N,).
        time: Time of the largest value, s.
        eased: Whether the interpolant violates the limit although not every motion through the samples needs to.
    """

    sign: float
    limit: float
    values: Array
    time: float
    eased: bool

    @classmethod
    def of(cls, quantity: MotionQuantity, column: int, sign: float, limit: float, tolerance: float) -> _Side:
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
        return cls(sign, limit, values, float(t[k] + share * (t[k + 1] - t[k])), eased)

    @property
    def excess(self) -> float:
        """Difference between the largest value and the limit; -inf if there is no limit."""
        return float(self.values.max() - self.limit)

    @property
    def worst_value(self) -> float:
        """Largest value towards the limit with its original sign, that is, not multiplied by `sign`."""
        return self.sign * float(self.values.max())


def _check_limits(
    quantity: MotionQuantity, column: int, order: str, name: str, unit: str, low: float, high: float, share: float
) -> tuple[Row, list[Fault]]:
    """Check a quantity of one joint against its limits; return the table row, and a list with a fault or without."""
    note = "" if quantity.closed else "of any motion through the samples, by divided differences"
    t, blur = quantity.pieces.t, np.asarray(quantity.blur)[:, column]
    tolerance = share * max((abs(one) for one in (low, high) if np.isfinite(one)), default=0.0)
    sides = [_Side.of(quantity, column, *one, tolerance) for one in ((1.0, high), (-1.0, -low))]
    if not np.isfinite([low, high]).any():
        worst = max(sides, key=lambda side: float(side.values.max()))
        return Row(f"{order} of {name}", worst.worst_value, None, unit, worst.time, RowVerdict.UNLIMITED, note), []
    sides.sort(key=lambda side: side.excess, reverse=True)
    worst = sides[0]
    beyond = np.any([side.values > side.limit + tolerance for side in sides], axis=0)
    certain = [side.values > side.limit + tolerance + blur for side in sides]
    violated = certain[0] | certain[1]
    verdict = RowVerdict.FAILED if violated.any() else RowVerdict.UNDECIDED if beyond.any() else RowVerdict.OK
    if verdict is RowVerdict.FAILED and not certain[0].any():
        worst = sides[1]
    value, allowed, time = worst.worst_value, worst.sign * worst.limit, worst.time
    remark = ""
    if verdict is RowVerdict.OK and any(side.eased for side in sides):
        remark = "the interpolant is beyond, but not every motion through the samples"
    elif verdict is RowVerdict.OK and worst.excess > 0:
        remark = f"beyond, by less than the {100 * share:g} % allowed"
    note = "; ".join(filter(None, (remark, note)))
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


def effort_rows(
    cleaned: CleanedTrajectory, robot: Robot, bounds: JointBounds, share: float
) -> tuple[list[Row], list[Fault]]:
    """Check torques that the file gives at the samples against the torque limits; return table rows and faults."""
    rows: list[Row] = []
    faults: list[Fault] = []
    if cleaned.efforts is None:
        return rows, faults
    for column, joint in enumerate(cleaned.joints):
        name = robot.joint_names[joint]
        unit, limit = robot.joint(name).effort_unit, float(bounds.torque[joint])
        k = int(np.abs(cleaned.efforts[:, column]).argmax())
        value, time = float(cleaned.efforts[k, column]), float(cleaned.motion.t[k])
        failed = abs(value) > limit * (1 + share)
        verdict = RowVerdict.FAILED if failed else RowVerdict.OK if np.isfinite(limit) else RowVerdict.UNLIMITED
        row_limit = limit if np.isfinite(limit) else None
        rows.append(Row(f"given torque of {name}", value, row_limit, unit, time, verdict, "as given in the file"))
        if failed:
            text = f"the file has {value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
            faults.append(Fault("torque", name, text, time, time, value, limit, unit))
    return rows, faults


def torque_rows(
    motion: Motion, machine: FixedBase | FreeFloating | Standing, bounds: JointBounds, share: float
) -> tuple[list[Row], list[Fault]]:
    """Check joint torques from inverse dynamics at five times of every interval; return table rows and faults.

    With linear interpolation they are evaluated at the samples, with velocities and accelerations by differences. A
    floating base moves as the joints drive it, from rest, without gravity.
    """
    robot = machine.robot
    n = robot.dof
    q, v, a = (ca.SX.sym(name, n) for name in ("q", "v", "a"))
    torque = torque_expression(machine, q, v, a)
    sampler = Sampler([q, v, a], [torque])
    times, *values = torque_samples(motion)
    if not len(times):
        return [], []
    check_time()
    torques = sampler(*values)[0]
    mean = motion.q.mean(axis=0)
    # torques are linear in accelerations
    sensitivity = np.abs(np.array(ca.Function("inertia", [q], [ca.jacobian(torque, a)])(mean)))
    acceleration = motion.quantity("acceleration")
    blur = sensitivity @ (np.zeros(n) if acceleration is None else np.median(np.asarray(acceleration.blur), axis=0))
    rows, faults = [], []
    note = "at samples, by differences" if motion.rule == "linear" else "at five times of every interval"
    for k, name in enumerate(robot.joint_names):
        unit, limit = robot.joint(name).effort_unit, float(bounds.torque[k])
        at = int(np.abs(torques[:, k]).argmax())
        value, time = float(torques[at, k]), float(times[at])
        verdict = RowVerdict.UNLIMITED
        if np.isfinite(limit):
            beyond = np.abs(torques[:, k]) > limit * (1 + share)
            certain = beyond & (np.abs(torques[:, k]) > limit * (1 + share) + blur[k])
            verdict = RowVerdict.FAILED if certain.any() else RowVerdict.UNDECIDED if beyond.any() else RowVerdict.OK
            if certain.any():
                first = float(times[np.flatnonzero(certain)[0]])
                text = f"{value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
                faults.append(Fault("torque", name, text, time, first, value, limit, unit))
        rows.append(Row(f"torque of {name}", value, limit if np.isfinite(limit) else None, unit, time, verdict, note))
    return rows, faults


def torque_expression(machine: Machine, q: ca.SX, v: ca.SX, a: ca.SX) -> ca.SX:
    """Return the joint torques of a machine without external forces as functions of its joint motion. Shape (n, 1).

    A floating base moves so that momentum is conserved.

    Args:
        machine: The machine.
        q, v, a: Symbols of the joint positions, velocities and accelerations. Shape (n, 1) each.
    """
    if not isinstance(machine, FreeFloating):
        gravity = getattr(machine, "gravity_in_world", GRAVITY)
        frame = machine.world_from_base(())
        return inverse_dynamics(simplify(machine.robot), q, v, a, wrenches=(), gravity=gravity, world_from_base=frame)
    base = ca.SX.sym("base", machine.base_size)
    rows = ca.SX(ca.DM.eye(6)[:, machine.twist_rows])
    twist = ca.mtimes(rows, machine.base_twist(base, q, v))
    rate = machine.base_rate(base, q, v)
    change = ca.jtimes(twist, ca.vertcat(base, q, v), ca.vertcat(rate, v, a))
    frame = machine.world_from_base(base)
    torque = inverse_dynamics(
        machine.robot, q, v, a, gravity=(0.0, 0.0, 0.0), world_from_base=frame, base_motion=(twist, change)
    )
    return ca.substitute(torque, base, ca.SX(ca.DM(machine.base_home())))


def torque_samples(motion: Motion) -> tuple[Array, Array, Array, Array]:
    """Return times (K,), s, and positions, velocities and accelerations (K, n) of a motion for inverse dynamics."""
    t, h = motion.t, np.diff(motion.t)
    if motion.acceleration is None:
        if len(t) < 3:
            return t[:0], motion.q[:0], motion.q[:0], motion.q[:0]
        slope = np.diff(motion.q, axis=0) / h[:, None]
        left, right = h[:-1, None], h[1:, None]
        v = (slope[:-1] * right + slope[1:] * left) / (left + right)
        return t[1:-1], motion.q[1:-1], v, 2 * np.diff(slope, axis=0) / (left + right)
    fractions = np.linspace(0.0, 1.0, 5)
    interval = np.repeat(np.arange(len(h)), len(fractions))
    fraction = np.tile(fractions, len(h))
    q, v, a = (one.within(interval, fraction) for one in (motion.position, motion.velocity, motion.acceleration))
    needed = np.broadcast_to(motion.needed("acceleration")[0], (len(h), a.shape[1]))[interval]
    return t[interval] + fraction * h[interval], q, v, np.clip(a, -needed, needed)


def standing_rows(machine: Standing, motion: Motion, friction: float) -> tuple[list[Row], list[Fault]]:
    """Check ground force, zero moment point and friction of a standing machine; return table rows and faults."""
    n = machine.joint_size
    q, v, a = (ca.SX.sym(name, n) for name in ("q", "v", "a"))
    reaction = machine.ground_reaction(q, v, a)
    point = center_of_pressure(reaction)
    slip = ca.norm_2(reaction[3:5])
    sampler = Sampler([q, v, a], [machine.support.margin(point), reaction[5], slip, point])
    times, *values = torque_samples(motion)
    if not len(times):
        return [], []
    margin, push, slide, place = sampler(*values)
    margin, push = margin[:, 0], push[:, 0]
    note = "at samples, by differences" if motion.rule == "linear" else "at five times of every interval"
    rows, faults = [], []

    def check(quantity: str, value: Array, least: float, unit: str, words: str) -> None:
        k = int(value.argmin())
        failed = not value[k] >= least
        time = float(times[k])
        rows.append(Row(quantity, float(value[k]), least, unit, time, RowVerdict.of(failed), note))
        if failed:
            first = float(times[np.flatnonzero(~(value >= least))[0]])
            text = f"{words} at {time:.6g} s, first at {first:.6g} s"
            faults.append(Fault(quantity, machine.robot.root, text, time, first, float(value[k]), least, unit))

    down = int(push.argmin())
    check("vertical force of the ground", push, 0.0, "N", f"the ground would have to pull with {-push[down]:.4g} N")
    out = int(margin.argmin())
    at = f"({place[out, 0]:.4g}, {place[out, 1]:.4g}) m"
    check("zero moment point", margin, 0.0, "m", f"it is {-margin[out]:.4g} m outside the foot, at {at},")
    if np.isfinite(friction):
        spare = friction * push - slide[:, 0]
        k = int(spare.argmin())
        check(
            "friction", spare, 0.0, "N", f"the foot slips: {slide[k, 0]:.4g} N along the ground, {push[k]:.4g} N on it,"
        )
    return rows, faults


def integrate_base(machine: FreeFloating, motion: Motion) -> tuple[Array, list[Row]]:
    """Return the configurations (M, base_size) of a floating base at the samples of a joint motion, and table rows.

    The base starts at its home and moves so that momentum stays zero. The classical Runge-Kutta method takes one step
    in every interval.
    """
    n, size = machine.joint_size, machine.base_size
    base, h = ca.SX.sym("base", size), ca.SX.sym("h")
    q, v = ca.SX.sym("q", n, 3), ca.SX.sym("v", n, 3)

    def rate(place: float, value: ca.SX) -> ca.SX:
        return machine.base_rate(value, q[:, int(2 * place)], v[:, int(2 * place)])

    next_base = rk4_step(rate, base, h)
    if size == 7:
        next_base = ca.vertcat(next_base[:3], next_base[3:] / ca.norm_2(next_base[3:]))
    count = len(motion.t) - 1
    interval = np.arange(count)
    values = [
        [one.within(interval, np.full(count, position)) for position in (0.0, 0.5, 1.0)]
        for one in (motion.position, motion.velocity)
    ]
    stacked = [np.stack(each, axis=1).reshape(count * 3, n).T for each in values]
    step = ca.Function("step", [base, q, v, h], [next_base], {"cse": True})
    steps = step.mapaccum(count)(machine.base_home(), *stacked, np.diff(motion.t)[None])
    bases = np.vstack([machine.base_home(), np.array(steps).T])
    position = bases[:, :2] if size == 3 else bases[:, :3]
    distance = np.linalg.norm(position - position[0], axis=1)
    turns = np.abs(bases[:, 2] - bases[0, 2]) if size == 3 else 2 * np.arccos(np.clip(np.abs(bases[:, 3]), 0.0, 1.0))
    k, j = int(distance.argmax()), int(turns.argmax())
    note = "integrated so that momentum is conserved"
    rows = [
        Row("displacement of the base", float(distance[k]), None, "m", float(motion.t[k]), RowVerdict.INFO, note),
        Row("rotation of the base", float(turns[j]), None, "rad", float(motion.t[j]), RowVerdict.INFO, note),
    ]
    return bases, rows


def momentum_rows(machine: FreeFloating, motion: Motion, bases: Array) -> tuple[list[Row], list[Fault]]:
    """Check that the total momentum is constant under the given base motion; return table rows and faults.

    The velocity of the base is computed by central differences.
    """
    if len(motion.t) < 3:
        return [], []
    robot, size = machine.robot, machine.base_size
    q, v = ca.SX.sym("q", robot.dof), ca.SX.sym("v", robot.dof)
    base, rate = ca.SX.sym("base", size), ca.SX.sym("rate", size)
    frame = machine.world_from_base(base)
    if size == 3:
        spin, speed = ca.vertcat(0, 0, rate[2]), ca.vertcat(rate[0], rate[1], 0)
    else:
        turn = rotation_from_quaternion(base[3:7])
        by_rate = ca.reshape(ca.jtimes(ca.vec(turn), base, ca.vertcat(ca.SX(3, 1), rate[3:7])), 3, 3)
        skew = ca.mtimes(by_rate, turn.T)
        spin, speed = ca.vertcat(skew[2, 1], skew[0, 2], skew[1, 0]), rate[:3]
    twist = ca.vertcat(spin, speed - cross(spin, frame.position))
    joints = momentum(robot, q, v, world_from_base=frame)
    total = joints + ca.mtimes(robot_inertia(robot, q, frame), twist)
    middle = slice(1, -1)
    width = (motion.t[2:] - motion.t[:-2])[:, None]
    rates = (bases[2:] - bases[:-2]) / width
    speeds = motion.v[middle] if motion.v is not None else (motion.q[2:] - motion.q[:-2]) / width
    whole, carried = Sampler([q, v, base, rate], [total, joints])(motion.q[middle], speeds, bases[middle], rates)
    rows, faults = [], []
    for quantity, part, unit in (("moment of momentum", slice(0, 3), "N m s"), ("momentum", slice(3, 6), "N s")):
        change = np.linalg.norm(whole[:, part] - np.median(whole[:, part], axis=0), axis=1)
        size_ = float(np.linalg.norm(carried[:, part], axis=1).max())
        limit = MOMENTUM_SHARE * size_ + ROUNDING_SHARE
        k = int(change.argmax())
        value, time = float(change[k]), float(motion.t[k + 1])
        failed = value > limit
        rows.append(Row(f"change of {quantity}", value, limit, unit, time, RowVerdict.of(failed), "base as given"))
        if failed:
            first = float(motion.t[1:-1][np.flatnonzero(change > limit)[0]])
            sentence = f"{quantity} changes by {value:.4g} {unit} at {time:.6g} s"
            text = f"{sentence}; that of the joints is {size_:.4g}: the given motion of the base is inconsistent"
            faults.append(Fault("momentum", robot.root, text, time, first, value, limit, unit))
    return rows, faults
