"""Where a standing plan starts: whether the machine can start there at all, and a first guess of the motion from there.

Limits of the joints, and what the ground bears; the guess is the task done locally, with the spare freedom damped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.machine import Machine
from models.machines.standing import External, Standing
from models.paths import rest_to_rest
from models.robot.dynamics import Wrench
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.motion.local.accelerations import resolve_accelerations
from ocp.motion.tasks.checks import clip_to_limits
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.tip_task import timed
from ocp.motion.tasks.tracks import on_symbols
from ocp.motion.tasks.zmp_rules import Following, IndexAtLeast, Pinned, ZmpRule, foot_edges

__all__ = ["check_freedom", "check_loads", "check_slope", "local_guess", "start_inside", "task_demand"]


@dataclass(frozen=True)
class StartSettings:
    """How a start at rest is judged, and a standing motion guessed.

    Attributes:
        missed: Share of a limit by which it has to be missed to count as missed.
        far: Greatest acceleration that is thought of, rad/s^2 or m/s^2.
        damping: 1/s, of the joint velocities in the null space of the guess.
        steps: Of the guess.
        racing: rad/s or m/s, of a local motion near a singularity, at which the guess stops.
    """

    missed: float = 1e-6
    far: float = 1e6
    damping: float = 2.0
    steps: int = 400
    racing: float = 100.0


STARTS = StartSettings()


def start_inside(machine: Machine, joints: Array, lower: Array, upper: Array) -> Array:
    """The start, moved onto the limits where rounding has it beyond them. Shape (n,).

    Raises:
        ProblemError: A joint that starts outside its limits or has no room between them.
    """
    for name, value, low, high in zip(machine.robot.joint_names, joints, lower, upper, strict=True):
        if not low < high:
            message = f"joint {name!r} cannot move between its limits {low:g} .. {high:g}: lock it there"
            raise ProblemError(message, name=name, value=float(value), limit=(low, high))
    return clip_to_limits("start_joints", machine.robot.joint_names, joints, lower, upper, "start inside them")


def check_freedom(machine: Standing, size: int, zmp: ZmpRule, along: str, tip_level: str, end: str) -> None:
    """Raise ProblemError where tasks and zero moment point ask for all joints, and these are to come to rest besides.

    Args:
        size: Rows of all tasks.
    """
    pinned = len(machine.moving_directions) if isinstance(zmp, Pinned | Following) else 0
    left = machine.joint_size - (size + pinned - (along == "parameter"))
    follows = tip_level == "acceleration" and not pinned  # joints that the tip takes along to its rest
    if left < 0 or (left == 0 and end == "rest" and not follows):
        asked = f"the tip's {size} rows" + (f" and {pinned} of the zero moment point" if pinned else "")
        message = f"{asked} are more than {machine.joint_size} joints can do; ask for less"
        if left == 0:
            message = f"{asked} leave the {machine.joint_size} joints no freedom to come to rest at the end; "
            freer = "pin the point less" if pinned else "tip_level='acceleration'"
            message += f"say end='free', or {freer}"
        raise ProblemError(message, name="tip", value=size + pinned, limit=machine.joint_size)


def check_slope(equations: TaskEquations, joints: Array) -> None:
    """Raise ProblemError where the manipulability, which the cost needs, has no slope at the start."""
    q = ca.SX.sym("q", len(joints))
    slope = ca.Function("slope", [q], [ca.gradient(equations.manipulability(ca.DM(0, 1), q), q)])
    if not np.isfinite(np.array(slope(joints))).all():
        message = (
            f"start_joints {np.round(joints, 4).tolist()}: the task's rows are singular there, and the manipulability "
            "in the cost has no slope; start elsewhere, or say Weights(manipulability=0)"
        )
        raise ProblemError(message, name="start_joints", value=joints)


def check_loads(
    machine: Standing,
    joints: Array,
    wrenches: Sequence[Wrench],
    zmp: ZmpRule,
    least_force: float,
    bounds: JointBounds,
    demand: tuple[Array, Array] | None,
) -> None:
    """Raise ProblemError where no joint accelerations at all would do at the start, from rest.

    Torques, vertical force and zero moment point are linear in them: a linear program finds those that miss the least.

    Args:
        machine, joints, wrenches: At the start.
        zmp, least_force, bounds: What may be, see standing_problem.
        demand: Rows T and values a of what the tasks ask of them, T q'' = a; None where they ask nothing.
    """
    n, rest = machine.joint_size, np.zeros(machine.joint_size)
    qdd = ca.SX.sym("qdd", n)
    reaction = machine.ground_reaction(joints, rest, qdd, wrenches)
    torques = machine.joint_torques(joints, rest, qdd, wrenches)
    effort = bounds.torque
    rows = [
        (torques[i] / effort[i], f"the torque of {name!r}, at most {effort[i]:g} N m (N)")
        for i, name in enumerate(machine.robot.joint_names)
        if np.isfinite(effort[i])
    ]
    low, high = [-1.0] * len(rows), [1.0] * len(rows)
    sides = [(reaction[5] / least_force, f"the vertical force, at least {least_force:g} N")]
    low.append(1.0)
    for normal, offset in _edges(machine, zmp):
        moment = normal[0] * -reaction[1] + normal[1] * reaction[0] - offset * reaction[5]
        scale = machine.weight * machine.support.half_widths.max()
        sides.append((moment / scale, "the place of the zero moment point"))
        low.append(0.0)
    high += [np.inf] * len(sides)
    rows += sides
    values = ca.vertcat(*(value for value, _ in rows))
    function = ca.Function("start", [qdd], [ca.densify(values), ca.densify(ca.jacobian(values, qdd))])
    at_rest, slopes = (np.array(part) for part in function(rest))
    missed = _least_missed(at_rest.ravel(), slopes, np.array(low), np.array(high), bounds.acceleration, demand)
    if missed is None or missed.max(initial=0.0) <= STARTS.missed:
        return
    words = [
        f"{what}, by {100 * share:.3g} %"
        for (_, what), share in zip(rows, missed, strict=True)
        if share > STARTS.missed
    ]
    message = (
        f"start_joints {np.round(joints, 4).tolist()}: whatever the joints do there, limits are missed: "
        f"{'; '.join(words)}; start elsewhere, load the tip less, or allow for more"
    )
    raise ProblemError(message, name="start_joints", value=joints)


def task_demand(equations: TaskEquations, joints: Array, along_parameter: bool) -> tuple[Array, Array]:
    """Rows and values of the accelerations that the tasks ask for at their start, from rest.

    Along a parameter the tip may move along the path's direction as fast as it likes: what remains is across it.
    """
    n = len(joints)

    def made(symbols: Any) -> Any:
        q, qd, time = symbols.sym("q", n), symbols.sym("qd", n), symbols.sym("time")
        pace, change = symbols.sym("pace"), symbols.sym("change")
        rates = (pace, change) if along_parameter else (1, 0)
        asked = -equations.acceleration(ca.DM(0, 1), q, qd, ca.DM(n, 1), time, *rates)
        return ca.Function("asked", [q, qd, time, pace, change], [asked])

    jacobian, asked = np.array(ca.DM(equations.jacobian(ca.DM(0, 1), joints))), on_symbols(made)
    wanted, pushed = (np.array(asked(joints, 0, 0, 0, change)).ravel() for change in (0, 1))
    slope = pushed - wanted
    length = np.linalg.norm(slope)
    direction = slope / length if length > 0 else slope
    across = np.eye(len(slope)) - np.outer(direction, direction)
    return across @ jacobian, across @ wanted


def _edges(machine: Standing, zmp: ZmpRule) -> list[tuple[Array, float]]:
    """Inward normals and offsets of the half-planes that the zero moment point has to be in."""
    edges = list(zip(*foot_edges(machine, zmp), strict=True))
    unit = np.eye(2)
    if isinstance(zmp, IndexAtLeast):
        low, high = zmp.region(machine)
    elif isinstance(zmp, Pinned | Following):
        unit = machine.moving_directions
        low = high = unit @ np.array(ca.DM(zmp.place(machine, ca.DM(0.0)))).ravel()
    else:
        return edges
    for axis, least, greatest in zip(unit, low, high, strict=True):
        edges += [(axis, float(least)), (-axis, -float(greatest))]
    return edges


def _least_missed(
    at_rest: Array, slopes: Array, low: Array, high: Array, most: Array, demand: tuple[Array, Array] | None
) -> Array | None:
    """By how much each row is missed, the sum being least; None where the tasks' demand cannot be met anyway."""
    m, n = slopes.shape
    inside = (at_rest >= low) & (at_rest <= high)
    if inside.all() and (demand is None or not np.any(demand[1])):
        return np.zeros(m)
    rows, wanted = (np.zeros((0, n)), np.zeros(0)) if demand is None else demand
    matrix = np.block([[slopes, np.eye(m), -np.eye(m)], [rows, np.zeros((len(rows), 2 * m))]])
    lower, upper = np.concatenate([low - at_rest, wanted]), np.concatenate([high - at_rest, wanted])
    reach = np.minimum(most, STARTS.far)
    sizes = np.concatenate([np.zeros(n), np.ones(2 * m)])
    settings = {"error_on_fail": False, "highs": {"output_flag": False}}
    shape = {"a": ca.DM(matrix).sparsity(), "h": ca.Sparsity(n + 2 * m, n + 2 * m)}
    solver = ca.conic("start", "highs", shape, settings)
    found = solver(
        a=ca.DM(matrix), g=sizes, lba=lower, uba=upper,
        lbx=np.concatenate([-reach, np.zeros(2 * m)]), ubx=np.concatenate([reach, np.full(2 * m, np.inf)]),
    )  # fmt: skip
    if not solver.stats()["success"]:
        return None
    slack = np.array(found["x"]).ravel()[n:]
    return np.asarray(slack[:m] + slack[m:])


def local_guess(
    machine: Standing,
    equations: TaskEquations,
    joints: Array,
    horizon: float,
    by_parameter: bool,
    external: External | None,
) -> dict[str, Any]:
    """Guesses by name; where the local motion breaks down or races, the last posture before that is kept."""
    tasks = [part.task for part in equations.bound]
    if by_parameter:
        tasks = [timed(task, lambda time: rest_to_rest(time / horizon)) for task in tasks]
    times, still = np.zeros(1), np.zeros((1, joints.size))
    parts = [joints[None, :], still, still]
    try:
        found = resolve_accelerations(
            machine, tasks, joints, horizon, null_damping=STARTS.damping, external=external,
            step=horizon / STARTS.steps, stop_at_lift_off=False, speed_limit=STARTS.racing,
        ).motion  # fmt: skip
    except ProblemError:  # the task and the start are checked: the start is singular, which a plan may still leave
        pass
    else:
        racing = np.asarray((np.abs(found.joint_velocities) > STARTS.racing / 2).any(axis=1))
        sound = int(racing.argmax()) if racing.any() else len(racing)
        times = found.t[:sound]
        parts = [part[:sound] for part in (found.joints, found.joint_velocities, found.joint_accelerations)]
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
