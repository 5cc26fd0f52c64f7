"""What a motion does to a base that nothing holds: the zero moment point under a foot, the way of a floating base."""

from __future__ import annotations

import casadi as ca
import numpy as np

from models import FreeFloating, Standing, momentum, robot_inertia
from models.arrays import Array
from models.machines.standing import center_of_pressure
from models.spatial import cross, rotation_from_quaternion
from ocp.app.joint_limits import Row, RowVerdict, states_along
from ocp.app.oddities import Fault
from ocp.app.pieces import Motion
from ocp.problem.sampling import Sampler
from ocp.tolerances import MOMENTUM_SHARE, ROUNDING_SHARE

__all__ = ["floating_base", "momentum_rows", "standing_rows"]


def standing_rows(machine: Standing, motion: Motion, friction: float) -> tuple[list[Row], list[Fault]]:
    """Rows and faults of the zero moment point in its foot, the ground's push, and friction."""
    n = machine.joint_size
    q, v, a = (ca.SX.sym(name, n) for name in ("q", "v", "a"))
    reaction = machine.ground_reaction(q, v, a)
    point = center_of_pressure(reaction)
    slip = ca.norm_2(reaction[3:5])
    sampler = Sampler([q, v, a], [machine.support.margin(point), reaction[5], slip, point])
    times, *values = states_along(motion)
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


def floating_base(machine: FreeFloating, motion: Motion) -> tuple[Array, list[Row]]:
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
