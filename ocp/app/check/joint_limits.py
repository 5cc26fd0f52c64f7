"""What joints bear, against a motion: positions, velocities, accelerations and jerks at every time, torques at many.

Polynomials are looked at by their Bernstein coefficients, so that nothing between two samples is passed over. Digits
that a file has not leave room: what is beyond a limit by less than they may make is told and not held against it.

What a motion does to a base that nothing holds: the zero moment point under a foot, the way of a floating base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Robot, Standing, inverse_dynamics, momentum, robot_inertia, simplified
from models.arrays import Array
from models.machines.standing import center_of_pressure
from models.spatial import cross, rotation_from_quaternion
from ocp.app.check.data_checks import Fault
from ocp.app.check.interpolation import Indices, Motion, MotionQuantity, polynomial_maxima
from ocp.audit.audit import Audit
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.values import Sampler
from ocp.tolerances import MOMENTUM_SHARE, ROUNDING_SHARE

__all__ = [
    "ORDERS",
    "Row",
    "RowVerdict",
    "audit_rows",
    "floating_torques",
    "integrate_base",
    "limit_rows",
    "momentum_rows",
    "standing_rows",
    "torque_rows",
    "torque_samples",
]

ORDERS = {"position": "", "velocity": "/s", "acceleration": "/s^2", "jerk": "/s^3"}


class RowVerdict(StrEnum):
    """What is said of what was looked at."""

    OK = "ok"
    FAILED = "FAILED"
    UNDECIDED = "not decided"
    """The file has too few digits, or the proof went not far enough."""
    UNLIMITED = "unlimited"
    TOLD = "told"
    """There is nothing to hold it against."""

    @classmethod
    def of(cls, failed: Any) -> RowVerdict:
        """Of what is held against something."""
        return cls.FAILED if failed else cls.OK


@dataclass(frozen=True)
class Row:
    """One line of the table of a check.

    Attributes:
        name: What was looked at, of which joint or bodies.
        value: The worst found. limit: What it may be; None: nothing limits it. Both in `unit`; time: s.
        verdict: What is said of it.
        note: How it was looked at, where that is not plain.
    """

    name: str
    value: float
    limit: float | None
    unit: str
    time: float | None
    verdict: RowVerdict
    note: str = ""


def limit_rows(
    motion: Motion, robot: Robot, joints: Indices, bounds: JointBounds, share: float
) -> tuple[list[Row], list[Fault], list[str]]:
    """Rows and faults of what is limited of each joint, and what could not be looked at.

    Args:
        joints: Which of the joint vector the motion has. share: Of a limit, by which it may be passed.
    """
    rows: list[Row] = []
    faults: list[Fault] = []
    unchecked = []
    for what, per in ORDERS.items():
        quantity = motion.quantity(what)
        if quantity is None:
            if np.isfinite(getattr(bounds, what)[joints]).any():
                unchecked.append(f"{what}, of which so few samples say nothing")
            continue
        note = "" if quantity.closed else "of any motion through the samples, by divided differences"
        most = None if what == "position" else getattr(bounds, what)
        for column, joint in enumerate(joints):
            name = robot.joint_names[joint]
            unit = robot.joint(name).unit + per
            low, high = (bounds.lower[joint], bounds.upper[joint]) if most is None else (-most[joint], most[joint])
            row, slight, fault = _looked(quantity, column, what, name, unit, float(low), float(high), share)
            rows.append(Row(f"{what} of {name}", *row, "; ".join(filter(None, (slight, note)))))
            faults += fault
    return rows, faults, unchecked


def audit_rows(audit: Audit) -> list[Row]:
    """The findings of an audit as rows of a table."""
    verdicts = [RowVerdict.TOLD if f.limit is None else RowVerdict.of(not f.passed) for f in audit.findings]
    return [
        Row(f.name, f.value, f.limit, f.unit, f.time, verdict, f.note)
        for f, verdict in zip(audit.findings, verdicts, strict=True)
    ]


class _Side(NamedTuple):
    """How far every piece of a curve goes towards one of its two limits: values and limit are times `sign`.

    Attributes:
        values: Greatest of each piece, at most what any motion through the samples needs. Shape (N,).
        time: Of the greatest of all. eased: Whether the interpolant itself is beyond where no motion needs to be.
    """

    sign: float
    limit: float
    values: Array
    time: float
    eased: bool

    @classmethod
    def of(cls, quantity: MotionQuantity, column: int, sign: float, limit: float, room: float) -> _Side:
        towards, t = sign * quantity.pieces.coefficients[:, :, column], quantity.pieces.t
        most = np.broadcast_to(quantity.needed[0 if sign > 0 else 1], quantity.blur.shape)[:, column]
        ends, enclosed = np.maximum(towards[:, 0], towards[:, -1]), towards.max(axis=1)
        # of a piece whose enclosure is above the greatest end, or beyond the limit, the greatest value is looked for
        above = np.minimum(enclosed, most) > np.minimum(ends, most).max()
        open_ = np.flatnonzero(above | ((enclosed > limit) & (ends <= limit)))
        values, place = ends.copy(), (towards[:, -1] > towards[:, 0]).astype(float)
        if open_.size and towards.shape[1] > 2:
            values[open_], place[open_] = polynomial_maxima(towards[open_])
        eased = bool((values > np.maximum(most, limit + room)).any())
        values = np.minimum(values, most)
        k = int(values.argmax())
        share = place[k] if towards.shape[1] > 1 else 0.5
        return cls(sign, limit, values, float(t[k] + share * (t[k + 1] - t[k])), eased)

    @property
    def excess(self) -> float:
        """Of the greatest value; below zero of one that has no limit, more so than of any that has."""
        return float(self.values.max() - self.limit)

    @property
    def found(self) -> float:
        return self.sign * float(self.values.max())


def _looked(
    quantity: MotionQuantity, column: int, what: str, name: str, unit: str, low: float, high: float, share: float
) -> tuple[tuple[float, float | None, str, float | None, RowVerdict], str, list[Fault]]:
    """Value, limit, unit, time and verdict of a row, that it is slightly beyond, and the fault it is."""
    t, blur = quantity.pieces.t, np.asarray(quantity.blur)[:, column]
    room = share * max((abs(one) for one in (low, high) if np.isfinite(one)), default=0.0)
    sides = [_Side.of(quantity, column, *one, room) for one in ((1.0, high), (-1.0, -low))]
    if not np.isfinite([low, high]).any():
        worst = max(sides, key=lambda side: float(side.values.max()))
        return (worst.found, None, unit, worst.time, RowVerdict.UNLIMITED), "", []
    sides.sort(key=lambda side: side.excess, reverse=True)
    worst = sides[0]
    beyond = np.any([side.values > side.limit + room for side in sides], axis=0)
    sure = [side.values > side.limit + room + blur for side in sides]
    over = sure[0] | sure[1]
    verdict = RowVerdict.FAILED if over.any() else RowVerdict.UNDECIDED if beyond.any() else RowVerdict.OK
    if verdict is RowVerdict.FAILED and not sure[0].any():
        worst = sides[1]
    found, allowed, time = worst.found, worst.sign * worst.limit, worst.time
    row = found, allowed, unit, time, verdict
    if verdict != "FAILED":
        slight = f"beyond, by less than the {100 * share:g} % allowed" if worst.excess > 0 else ""
        if any(side.eased for side in sides):
            slight = "the interpolant is beyond, which no motion through the samples needs"
        return row, slight if verdict is RowVerdict.OK else "", []
    starts = np.flatnonzero(over & ~np.concatenate([[False], over[:-1]]))
    first = float(t[starts[0]])
    between = ", between two samples" if quantity.closed and time not in t else ""
    stretches = f"; {len(starts)} times, first from {first:.6g} s" if len(starts) > 1 else ""
    share_over = abs(found) / abs(allowed) - 1 if allowed else np.inf
    much = f", {100 * share_over:.3g} % beyond" if 1e-4 < share_over < 10 else ""
    text = f"{found:.5g} {unit} at {time:.6g} s{between}, limit {allowed:.5g}{much}{stretches}"
    return row, "", [Fault(what, name, text, time, first, found, allowed, unit)]


def torque_rows(
    motion: Motion,
    machine: FixedBase | FreeFloating,
    bounds: JointBounds,
    gravity: Array,
    share: float,
    check: Callable[[], None],
) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of torques by inverse dynamics, at five times of every piece.

    Of straight lines at the samples, their velocities and accelerations by differences. A base that floats goes as the
    joints drive it, from rest, without gravity.
    """
    robot = machine.robot
    n = robot.dof
    q, v, a = (ca.SX.sym(name, n) for name in ("q", "v", "a"))
    if isinstance(machine, FreeFloating):
        torque = floating_torques(machine, q, v, a)
    else:
        bodies = simplified(robot, frozenset())
        torque = inverse_dynamics(bodies, q, v, a, (), gravity, machine.world_from_base())
    sampler = Sampler([q, v, a], [torque])
    times, *values = torque_samples(motion)
    if not len(times):
        return [], []
    check()
    found = sampler(*values)[0]
    mean = motion.q.mean(axis=0)
    weight = np.abs(np.array(ca.Function("inertia", [q], [ca.jacobian(torque, a)])(mean)))  # torques are linear in them
    blurred = motion.quantity("acceleration")
    blur = weight @ (np.zeros(n) if blurred is None else np.median(np.asarray(blurred.blur), axis=0))
    rows, faults = [], []
    note = "at samples, by differences" if motion.rule == "linear" else "at five times of every piece"
    for k, name in enumerate(robot.joint_names):
        unit, limit = robot.joint(name).effort_unit, float(bounds.torque[k])
        at = int(np.abs(found[:, k]).argmax())
        value, time = float(found[at, k]), float(times[at])
        verdict = RowVerdict.UNLIMITED
        if np.isfinite(limit):
            beyond = np.abs(found[:, k]) > limit * (1 + share)
            sure = beyond & (np.abs(found[:, k]) > limit * (1 + share) + blur[k])
            verdict = RowVerdict.FAILED if sure.any() else RowVerdict.UNDECIDED if beyond.any() else RowVerdict.OK
            if sure.any():
                first = float(times[np.flatnonzero(sure)[0]])
                text = f"{value:.5g} {unit} at {time:.6g} s, limit {limit:.5g}"
                faults.append(Fault("torque", name, text, time, first, value, limit, unit))
        rows.append(Row(f"torque of {name}", value, limit if np.isfinite(limit) else None, unit, time, verdict, note))
    return rows, faults


def floating_torques(machine: FreeFloating, q: ca.SX, v: ca.SX, a: ca.SX) -> ca.SX:
    """Torques of joints whose base floats, wherever it is: it moves so that the momentum stays what it is. (n, 1)."""
    base = ca.SX.sym("base", machine.base_size)
    rows = ca.SX(ca.DM.eye(6)[:, machine.twist_rows])
    twist = ca.mtimes(rows, machine.base_twist(base, q, v))
    rate = machine.base_rate(base, q, v)
    change = ca.jtimes(twist, ca.vertcat(base, q, v), ca.vertcat(rate, v, a))
    torque = inverse_dynamics(
        machine.robot,
        q,
        v,
        a,
        (),
        (0.0, 0.0, 0.0),
        machine.world_from_base(base),
        base_twist=twist,
        base_acceleration=change,
    )
    return ca.substitute(torque, base, ca.SX(ca.DM(machine.base_home())))


def torque_samples(motion: Motion) -> tuple[Array, Array, Array, Array]:
    """Times, positions, velocities and accelerations where torques are looked at. Shape (K,), (K, n) each."""
    t, h = motion.t, np.diff(motion.t)
    if motion.acceleration is None:
        if len(t) < 3:
            return t[:0], motion.q[:0], motion.q[:0], motion.q[:0]
        slope = np.diff(motion.q, axis=0) / h[:, None]
        left, right = h[:-1, None], h[1:, None]
        v = (slope[:-1] * right + slope[1:] * left) / (left + right)
        return t[1:-1], motion.q[1:-1], v, 2 * np.diff(slope, axis=0) / (left + right)
    places = np.linspace(0.0, 1.0, 5)
    piece = np.repeat(np.arange(len(h)), len(places))
    place = np.tile(places, len(h))
    q, v, a = (one.within(piece, place) for one in (motion.position, motion.velocity, motion.acceleration))
    least = np.broadcast_to(motion.needed("acceleration")[0], (len(h), a.shape[1]))[piece]
    return t[piece] + place * h[piece], q, v, np.clip(a, -least, least)


def standing_rows(machine: Standing, motion: Motion, friction: float) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of the zero moment point in its foot, the ground's push, and friction."""
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
    note = "at samples, by differences" if motion.rule == "linear" else "at five times of every piece"
    rows, faults = [], []

    def look(what: str, value: Array, least: float, unit: str, words: str) -> None:
        k = int(value.argmin())
        failed = not value[k] >= least
        time = float(times[k])
        rows.append(Row(what, float(value[k]), least, unit, time, RowVerdict.of(failed), note))
        if failed:
            first = float(times[np.flatnonzero(~(value >= least))[0]])
            text = f"{words} at {time:.6g} s, first at {first:.6g} s"
            faults.append(Fault(what, machine.robot.root, text, time, first, float(value[k]), least, unit))

    down = int(push.argmin())
    look("vertical force of the ground", push, 0.0, "N", f"the ground would have to pull with {-push[down]:.4g} N")
    out = int(margin.argmin())
    at = f"({place[out, 0]:.4g}, {place[out, 1]:.4g}) m"
    look("zero moment point", margin, 0.0, "m", f"it is {-margin[out]:.4g} m outside the foot, at {at},")
    if np.isfinite(friction):
        spare = friction * push - slide[:, 0]
        k = int(spare.argmin())
        look(
            "friction", spare, 0.0, "N", f"the foot slips: {slide[k, 0]:.4g} N along the ground, {push[k]:.4g} N on it,"
        )
    return rows, faults


def integrate_base(machine: FreeFloating, motion: Motion) -> tuple[Array, list[Row]]:
    """Configurations of the base at the samples, from its home on, (M, base_size), and rows that tell its way.

    Integrated by the classical Runge-Kutta method, a step for each piece.
    """
    n, size = machine.joint_size, machine.base_size
    base, h = ca.SX.sym("base", size), ca.SX.sym("h")
    q, v = ca.SX.sym("q", n, 3), ca.SX.sym("v", n, 3)

    def slope(at: int, value: ca.SX) -> ca.SX:
        return machine.base_rate(value, q[:, at], v[:, at])

    k1 = slope(0, base)
    k2 = slope(1, base + h / 2 * k1)
    k3 = slope(1, base + h / 2 * k2)
    k4 = slope(2, base + h * k3)
    after = base + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    if size == 7:
        after = ca.vertcat(after[:3], after[3:] / ca.norm_2(after[3:]))
    count = len(motion.t) - 1
    piece = np.arange(count)
    values = [
        [one.within(piece, np.full(count, place)) for place in (0.0, 0.5, 1.0)]
        for one in (motion.position, motion.velocity)
    ]
    given = [np.stack(each, axis=1).reshape(count * 3, n).T for each in values]
    step = ca.Function("step", [base, q, v, h], [after], {"cse": True})
    found = step.mapaccum(count)(machine.base_home(), *given, np.diff(motion.t)[None])
    bases = np.vstack([machine.base_home(), np.array(found).T])
    place = bases[:, :2] if size == 3 else bases[:, :3]
    far = np.linalg.norm(place - place[0], axis=1)
    turns = np.abs(bases[:, 2] - bases[0, 2]) if size == 3 else 2 * np.arccos(np.clip(np.abs(bases[:, 3]), 0.0, 1.0))
    k, j = int(far.argmax()), int(turns.argmax())
    note = "integrated; momentum is conserved by that"
    rows = [
        Row("way of the base", float(far[k]), None, "m", float(motion.t[k]), RowVerdict.TOLD, note),
        Row("turn of the base", float(turns[j]), None, "rad", float(motion.t[j]), RowVerdict.TOLD, note),
    ]
    return bases, rows


def momentum_rows(machine: FreeFloating, motion: Motion, bases: Array) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of the momentum of the whole, which nothing changes, with the base as a file tells it.

    The base's velocity is that of central differences.
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
    for what, part, unit in (("moment of momentum", slice(0, 3), "N m s"), ("momentum", slice(3, 6), "N s")):
        off = np.linalg.norm(whole[:, part] - np.median(whole[:, part], axis=0), axis=1)
        size_ = float(np.linalg.norm(carried[:, part], axis=1).max())
        limit = MOMENTUM_SHARE * size_ + ROUNDING_SHARE
        k = int(off.argmax())
        value, time = float(off[k]), float(motion.t[k + 1])
        failed = value > limit
        rows.append(Row(f"change of {what}", value, limit, unit, time, RowVerdict.of(failed), "base as told"))
        if failed:
            first = float(motion.t[1:-1][np.flatnonzero(off > limit)[0]])
            change = f"{what} changes by {value:.4g} {unit} at {time:.6g} s"
            text = f"{change}; the joints carry {size_:.4g}: the base does not go as it is told"
            faults.append(Fault("momentum", robot.root, text, time, first, value, limit, unit))
    return rows, faults
