"""Checks whether a standing machine can start a motion, and the initial guess of the motion.

The checks are of joint limits and of what the ground and the joints can bear at the start. The guess is the local
motion along the task, with the null-space velocities damped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy

from models.checks import Array
from models.machines.machine import Machine, Wrenches
from models.machines.standing import Standing
from models.paths import rest_to_rest
from models.robot.dynamics import Wrench
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.motion.local.accelerations import AccelerationOptions, resolve_accelerations
from ocp.motion.tasks.checks import clip_to_limits
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.limits import JointBounds, Pinned, ZmpRule, foot_edges
from ocp.motion.tasks.tip_task import retime_task
from ocp.motion.tasks.tracks import on_symbols


@dataclass(frozen=True)
class StartSettings:
    """Settings of the check whether a motion can start from rest, and of the initial guess."""

    violation: float = 1e-6  # relative violation of a limit that is tolerated
    largest_acceleration: float = 1e6  # bound of unlimited accelerations, rad/s^2 or m/s^2
    damping: float = 2.0  # damping of null-space velocities in the guess, 1/s
    steps: int = 400  # number of time steps of the guess
    largest_speed: float = 100.0  # speed of a local motion near a singularity at which the guess stops, rad/s or m/s


STARTS = StartSettings()


def start_inside(machine: Machine, joints: Array, lower: Array, upper: Array) -> Array:
    """Return the start configuration (n,); a joint that exceeds a limit only by rounding is set to the limit."""
    for name, value, low, high in zip(machine.robot.joint_names, joints, lower, upper, strict=True):
        if not low < high:
            message = f"joint {name!r} cannot move between its limits {low:g} .. {high:g}: lock it there"
            raise ProblemError(message, name=name, value=float(value), limit=(low, high))
    return clip_to_limits(machine, joints, lower, upper, label="start")


def check_freedom(
    machine: Standing, size: int, zmp: ZmpRule, *, along_parameter: bool, tip_level: str, ends_at_rest: bool
) -> None:
    """Raise ProblemError if tasks, zero moment point rule and rest at the end need more joints than the machine has."""
    pinned = len(machine.moving_directions) if isinstance(zmp, Pinned) else 0
    left = machine.joint_size - (size + pinned - along_parameter)
    follows = tip_level == "acceleration" and not pinned  # the joints come to rest with the tip
    if left < 0 or (left == 0 and ends_at_rest and not follows):
        rows = f"the tip's {size} rows" + (f" and {pinned} of the zero moment point" if pinned else "")
        message = f"{rows} are more than {machine.joint_size} joints can satisfy; constrain fewer rows"
        if left == 0:
            message = f"{rows} leave the {machine.joint_size} joints no freedom to come to rest at the end; "
            freer = "pin the point less" if pinned else "tip_level='acceleration'"
            message += f"set end_velocity='free', or {freer}"
        raise ProblemError(message, name="tip", value=size + pinned, limit=machine.joint_size)


def check_slope(equations: TaskEquations, joints: Array) -> None:
    """Raise ProblemError if the manipulability in the cost has no finite gradient at the start."""
    q = ca.SX.sym("q", len(joints))
    slope = ca.Function("slope", [q], [ca.gradient(equations.manipulability(ca.DM(0, 1), q), q)])
    if not np.isfinite(np.array(slope(joints))).all():
        message = f"start {np.round(joints, 4).tolist()}: the task's rows are singular there, so that the "
        message += "manipulability in the cost has no gradient; start elsewhere, or set Weights(manipulability=0)"
        raise ProblemError(message, name="start", value=joints)


def check_loads(
    machine: Standing,
    joints: Array,
    wrenches: Sequence[Wrench],
    *,
    zmp: ZmpRule,
    least_force: float,
    bounds: JointBounds,
    demand: tuple[Array, Array] | None,
) -> None:
    """Raise ProblemError if no joint accelerations from rest satisfy the limits of torque and ground reaction.

    Torques, vertical force and zero moment point are linear in the accelerations. A linear program finds the least
    violation. `demand` has matrix T and vector a of the tasks' equations T q'' = a of the accelerations q''.
    """
    n, rest = machine.joint_size, np.zeros(machine.joint_size)
    qdd = ca.SX.sym("qdd", n)
    reaction = machine.ground_reaction(joints, rest, qdd, wrenches)
    torques = machine.joint_torques(joints, rest, qdd, wrenches)
    effort = bounds.torque
    rows = [  # value, least and largest value, name of the limit
        (torques[i] / effort[i], -1.0, 1.0, f"the torque of {name!r}, at most {effort[i]:g} N m (N)")
        for i, name in enumerate(machine.robot.joint_names)
        if np.isfinite(effort[i])
    ]
    rows.append((reaction[5] / least_force, 1.0, np.inf, f"the vertical force, at least {least_force:g} N"))
    scale = machine.weight * machine.support.half_widths.max()
    normals, offsets = foot_edges(machine, zmp)
    if isinstance(zmp, Pinned):
        directions = machine.moving_directions
        place = directions @ np.array(ca.DM(zmp.place(machine, ca.DM(0.0)))).ravel()
        normals, offsets = np.vstack([normals, directions, -directions]), np.concatenate([offsets, place, -place])
    for normal, offset in zip(normals, offsets, strict=True):
        moment = normal[0] * -reaction[1] + normal[1] * reaction[0] - offset * reaction[5]
        rows.append((moment / scale, 0.0, np.inf, "the place of the zero moment point"))
    values, low, high, names = zip(*rows, strict=True)
    column = ca.vertcat(*values)
    function = ca.Function("start", [qdd], [ca.densify(column), ca.densify(ca.jacobian(column, qdd))])
    at_rest, slopes = (np.array(part) for part in function(rest))
    violations = _least_violations(at_rest.ravel(), slopes, np.array(low), np.array(high), bounds.acceleration, demand)
    if violations is None or violations.max(initial=0.0) <= STARTS.violation:
        return
    shares = zip(names, violations, strict=True)
    words = [f"{limit}, by {100 * share:.3g} %" for limit, share in shares if share > STARTS.violation]
    message = f"start {np.round(joints, 4).tolist()}: no joint accelerations satisfy the limits there: "
    message += f"{'; '.join(words)}; start elsewhere, load the tip less, or relax the limits"
    raise ProblemError(message, name="start", value=joints)


def task_demand(equations: TaskEquations, joints: Array, along_parameter: bool) -> tuple[Array, Array]:
    """Return matrix and right side of the linear equations that tasks impose on joint accelerations at rest.

    Along a parameter the acceleration in the path's direction is free, and only the equations across it remain.
    """
    n = len(joints)

    def function_of(symbols: Any) -> Any:
        q, qd, time = symbols.sym("q", n), symbols.sym("qd", n), symbols.sym("time")
        pace, change = symbols.sym("pace"), symbols.sym("change")
        rates = (pace, change) if along_parameter else (1, 0)
        required = -equations.acceleration(ca.DM(0, 1), q, qd, ca.DM(n, 1), progress=(time, *rates))
        return ca.Function("required", [q, qd, time, pace, change], [required])

    jacobian, function = np.array(ca.DM(equations.jacobian(ca.DM(0, 1), joints))), on_symbols(function_of)
    wanted, pushed = (np.array(function(joints, 0, 0, 0, change)).ravel() for change in (0, 1))
    slope = pushed - wanted
    length = np.linalg.norm(slope)
    direction = slope / length if length > 0 else slope
    across = np.eye(len(slope)) - np.outer(direction, direction)
    return across @ jacobian, across @ wanted


def _least_violations(
    at_rest: Array, slopes: Array, low: Array, high: Array, largest: Array, demand: tuple[Array, Array] | None
) -> Array | None:
    """Return the limit violations with the least sum that the tasks permit; None if the tasks cannot be fulfilled."""
    m, n = slopes.shape
    inside = (at_rest >= low) & (at_rest <= high)
    if inside.all() and (demand is None or not np.any(demand[1])):
        return np.zeros(m)
    rows, wanted = (np.zeros((0, n)), np.zeros(0)) if demand is None else demand
    matrix = np.block([[slopes, np.eye(m), -np.eye(m)], [rows, np.zeros((len(rows), 2 * m))]])
    lower, upper = np.concatenate([low - at_rest, wanted]), np.concatenate([high - at_rest, wanted])
    reach = np.minimum(largest, STARTS.largest_acceleration)
    largest_values = np.concatenate([reach, np.full(2 * m, np.inf)])
    solved = scipy.optimize.milp(
        np.concatenate([np.zeros(n), np.ones(2 * m)]),
        constraints=scipy.optimize.LinearConstraint(matrix, lower, upper),
        bounds=scipy.optimize.Bounds(np.concatenate([-reach, np.zeros(2 * m)]), largest_values),
    )
    return None if solved.x is None else np.asarray(solved.x[n : n + m] + solved.x[n + m :])


def local_guess(
    machine: Standing,
    equations: TaskEquations,
    horizon: float,
    joints: Array,
    *,
    by_parameter: bool,
    wrenches: Wrenches,
) -> dict[str, Any]:
    """Return guesses of states and controls, by name, from a resolved-acceleration motion along the tasks.

    After the motion fails or gets too fast, its last configuration is kept.
    """
    tasks = [part.task for part in equations.bound]
    if by_parameter:
        tasks = [retime_task(task, lambda time: rest_to_rest(time / horizon)) for task in tasks]
    times, still = np.zeros(1), np.zeros((1, joints.size))
    parts = [joints[None, :], still, still]
    options = AccelerationOptions(null_damping=STARTS.damping, stop_at_lift_off=False, speed_limit=STARTS.largest_speed)
    try:
        local = resolve_accelerations(
            machine, tasks, horizon, start=joints, wrenches=wrenches, step=horizon / STARTS.steps, options=options
        ).motion
    except ProblemError:  # task and start were checked: the start is singular, and a plan may still leave it
        pass
    else:
        fast = np.asarray((np.abs(local.joint_velocities) > STARTS.largest_speed / 2).any(axis=1))
        count = int(fast.argmax()) if fast.any() else len(fast)
        times = local.t[:count]
        parts = [part[:count] for part in (local.joints, local.joint_velocities, local.joint_accelerations)]
    if times[-1] < horizon * (1 - 1e-9):
        parts = [np.vstack([part, more]) for part, more in zip(parts, (parts[0][-1:], still, still), strict=True)]
        times = np.append(times, times[-1] + horizon / STARTS.steps)
    names = ("joints", "velocities", "accelerations")
    guess: dict[str, Any] = {name: Samples(times, part) for name, part in zip(names, parts, strict=True)}
    at = np.linspace(0.0, 1.0, STARTS.steps + 1)
    along = (rest_to_rest(at), 30 * (at * (1 - at)) ** 2 / horizon, (60 * at - 180 * at**2 + 120 * at**3) / horizon**2)
    for name, values in zip(("path", "path_rate", "path_acceleration"), along, strict=True):
        guess[name] = Samples(at * horizon, values[:, None])
    return guess
