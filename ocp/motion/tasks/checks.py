"""Checks of tasks against a machine and a start, before anything is solved: for builders and local resolution alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Joint, Machine
from models.arrays import Array, warn_of_degrees
from ocp.errors import NOT_NUMBERS, ProblemError, floats, format_distinct, real
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.geometry import Bound, is_holonomic, target_size
from ocp.motion.tasks.tip_task import ANGULAR, TipTask

__all__ = [
    "check_closed",
    "check_length",
    "check_rest",
    "check_speed",
    "checked_configuration",
    "checked_horizon",
    "checked_numbers",
    "checked_tasks",
    "checked_weights",
    "dependent_rows",
    "horizon_of",
    "ignorable_joints",
    "inside_limits",
    "rates_at_rest",
]


@dataclass(frozen=True)
class CheckSettings:
    """How finely tasks are looked at before anything is solved, and what counts as nothing.

    Attributes:
        track_samples: Of a track.
        closure_samples: Of a closed track: an odd number, for Simpson's rule.
        closed: Largest gap of a closed path, m and rad.
        ignorable: Relative change below which a joint changes nothing.
        ignorable_samples: Random configurations in which that is looked at.
        rounding: rad or m, of a joint with a limit below 1, else of its limit: how far beyond it rounding may have it.
        still: Largest velocity asked for where the joints are to rest, m/s and rad/s.
    """

    track_samples: int = 201
    closure_samples: int = 2001
    closed: float = 1e-6
    ignorable: float = 1e-9
    ignorable_samples: int = 4
    rounding: float = 1e-9
    still: float = 1e-6


CHECKS = CheckSettings()


def checked_horizon(horizon: Any) -> float:
    """The horizon; ProblemError unless it is a positive, finite number."""
    duration = real(horizon)
    if not 0 < duration < np.inf:
        words = f"horizon must be a positive number of seconds, not {horizon!r}"
        raise ProblemError(words, name="horizon", value=horizon, limit=0.0)
    return duration


def horizon_of(tasks: Sequence[TipTask], horizon: Any) -> float:
    """The horizon, s, or where it is None the time at which the last task ends.

    Raises:
        ProblemError: None is given, and no task says how long it lasts; not a positive number.
    """
    if horizon is None:
        ends = [task.end for task in tasks if task.duration is not None]
        if not ends:
            words = "horizon is missing: no task says how long it lasts; give horizon=... in s"
            raise ProblemError(words, name="horizon")
        horizon = max(ends)
    return checked_horizon(horizon)


def checked_configuration(machine: Machine, joints: Any, base: Any) -> tuple[Array, Array]:
    """Joints (joint_size,) and base (base_size,) at the start; the machine's base_home() if None.

    Raises:
        ProblemError: Wrong sizes, not finite; a quaternion that is not of unit length.

    Warns:
        ModelWarning: Angles that look like degrees.
    """
    if joints is None:
        words = "start_joints are missing; inverse_kinematics(machine, task) finds some for a pose"
        raise ProblemError(words, name="start_joints")
    angles = checked_numbers(joints, machine.joint_size, "start_joints", "one entry for each joint")
    for joint, angle in zip(machine.robot.moving_joints, angles, strict=True):
        if joint.kind != "prismatic":
            warn_of_degrees(angle, "start_joints", joint.name, f"joint {joint.name!r} at")
    home = machine.base_home() if base is None else base
    place = checked_numbers(home, machine.base_size, "start_base", "the machine's base configuration")
    if machine.base_size == 7 and abs(np.linalg.norm(place[3:]) - 1) > 1e-9:
        words = f"start_base has the quaternion {place[3:].tolist()}, which is not of unit length"
        raise ProblemError(words, name="start_base", value=place[3:])
    return angles, place


def inside_limits(what: str, names: Sequence[str], joints: Array, lower: Array, upper: Array, hint: str) -> Array:
    """Joints at an end, nan where they are free, moved onto the limits that rounding has them beyond. Shape (n,).

    Raises:
        ProblemError: A joint farther outside its limits; ends with a hint what to do.
    """
    for name, value, low, high in zip(names, joints.tolist(), lower.tolist(), upper.tolist(), strict=True):
        if value < low - CHECKS.rounding * max(1.0, abs(low)) or value > high + CHECKS.rounding * max(1.0, abs(high)):
            at, least, most = format_distinct(value, low, high)
            verb = "ends" if what.startswith("end") else "starts"
            words = f"{what}: {name!r} {verb} at {at}, outside its limits {least} .. {most}; {hint}"
            raise ProblemError(words, name=name, value=value, limit=(low, high))
    return np.clip(joints, lower, upper)


def checked_weights(weights: Any, size: int) -> Array:
    """Weights of the squared joint rates, ones if None; ProblemError unless they are positive. Shape (size,)."""
    if weights is None:
        return np.ones(size)
    given = checked_numbers(weights, size, "weights", "one for each joint")
    if not (given > 0).all():
        raise ProblemError(f"weights {given.tolist()} must be positive", name="weights", value=given, limit=0.0)
    return given


def checked_numbers(value: Any, size: int, what: str, meaning: str) -> Array:
    """Finite numbers as a flat array; ProblemError, with their name and meaning, unless there are `size` of them."""
    try:
        array = floats(value).ravel()
    except NOT_NUMBERS as error:
        raise ProblemError(f"{what} {value!r} is not numeric", name=what, value=value) from error
    if array.shape != (size,):
        words = f"{what} has {array.size} entries, expected {size}: {meaning}"
        raise ProblemError(words, name=what, value=array, limit=size)
    if not np.isfinite(array).all():
        raise ProblemError(f"{what} {array.tolist()} is not finite", name=what, value=array)
    return array


def checked_tasks(equations: TaskEquations, base: Array, joints: Array, horizon: float, *, start: bool = True) -> None:
    """Raise ProblemError where tasks ask for what no joint moves, what cannot be asked at once, or a jump at the start.

    Args:
        horizon: Where the tasks end, s; 1 for those of a path parameter.
        start: Whether the pose at the start is checked.
    """
    place, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(joints))
    rows = _rows_by_name(equations)
    jacobian = equations.jacobian(place, q)
    if equations.size > len(joints):
        words = f"the task fixes {equations.size} rows {rows} but the machine has only {len(joints)} joints"
        raise ProblemError(words, name="rows", value=equations.size, limit=len(joints))
    unmoved = [row for i, row in enumerate(rows) if all(entry.is_zero() for entry in ca.horzsplit(jacobian[i, :]))]
    if unmoved:
        words = f"rows {rows}: no joint moves the tip in rows {unmoved}; leave them out of the task"
        raise ProblemError(words, name="rows", value=unmoved)
    numeric = ca.Function("jacobian", [place, q], [jacobian])
    rng = np.random.default_rng(0)
    places = [joints, *rng.normal(size=(5, len(joints)))]
    if not any(_has_full_rank(np.array(numeric(base, at))) for at in places):
        words = (
            f"the {equations.size} rows of the task are linearly dependent in every configuration tried: they ask for "
            "the same motion twice or for more than the machine can do; leave out rows"
        )
        raise ProblemError(words, name="rows", value=rows)
    if not any(part.task.is_pose for part in equations.bound):
        return
    times, values = _sampled(equations, horizon, CHECKS.track_samples)
    if not (finite := np.isfinite(values).all(axis=0)).all():
        first = float(times[~finite][0])
        words = f"the task's targets are not finite at {first:g} s"
        raise ProblemError(words, name="task", value=values[:, ~finite][:, 0], time=first)
    _check_rotations(equations, values, times)
    if start:
        for part in equations.bound:
            if not part.task.is_pose:
                continue
            alone = TaskEquations(equations.machine, (part,))
            misfit = np.array(alone.misfit(base, joints, alone.target_function()(0.0)))
            gap = float(np.abs(misfit).max())
            if gap > part.task.start_gap:
                words = (
                    f"at the start joints {joints.tolist()} the frame of {_frame(part)!r} is {gap:.3g} (m or rad) away "
                    f"from where its task begins, more than start_gap = {part.task.start_gap:g}; start from "
                    "inverse_kinematics(machine, task), or allow the gap for the feedback to close"
                )
                raise ProblemError(words, name=_frame(part), value=gap, limit=part.task.start_gap, time=0.0)


def dependent_rows(equations: TaskEquations, base: Array, joints: Array) -> str | None:
    """The task's name where its rows are linearly dependent there, to rounding; None where they are not."""
    if not equations.size:
        return None
    values = np.linalg.svd(np.array(ca.DM(equations.jacobian(base, joints))), compute_uv=False)
    return f"the task of rows {_rows_by_name(equations)}" if values[-1] <= 1e-12 * values[0] else None


def ignorable_joints(equations: TaskEquations, base: Array) -> NDArray[np.bool_]:
    """Which joints may be anywhere without anything changing that tasks and base ask of the joint rates. Shape (n,).

    Judged in random configurations, to rounding: by the rates that do the tasks, by those that are left free, by how
    all of them move the base, and by how tool axes lean.
    """
    machine, rng, n = equations.machine, np.random.default_rng(0), equations.machine.joint_size
    b, q, u = (ca.SX.sym("v", size) for size in (machine.base_size, n, n))
    targets = ca.SX.sym("targets", sum(target_size(part.task) for part in equations.bound))
    parts = [equations.jacobian(b, q), equations.right(b, q, targets)]
    parts += [machine.base_rate(b, q, u), equations.leans(b, q, targets)]
    function = ca.Function("asked", [b, q, u, targets], parts, {"cse": True})
    at_zero = np.array(equations.target_function()(0.0)).ravel()
    found = np.ones(n, dtype=bool)
    for _ in range(CHECKS.ignorable_samples):
        rates, places = rng.normal(size=n), np.tile(rng.normal(size=n), (n + 1, 1))
        places[np.arange(n), np.arange(n)] += rng.normal(size=n)
        seen = []
        for at in places:
            jacobian, right, base_rate, lean = (np.array(part) for part in function(base, at, rates, at_zero))
            inverse = np.linalg.pinv(jacobian, rcond=1e-10)
            seen.append(np.concatenate([np.ravel(v) for v in (inverse @ jacobian, inverse @ right, base_rate, lean)]))
        changes = np.abs(np.array(seen[:-1]) - seen[-1]).max(axis=1, initial=0.0)
        found &= changes <= CHECKS.ignorable * (1 + np.abs(seen[-1]).max(initial=0.0))
    return found


def _rows_by_name(equations: TaskEquations) -> list[int]:
    """The twist rows of a single task; else the numbers of the stacked rows."""
    alone = equations.bound[0].task
    if len(equations.bound) == 1 and not alone.tilts:
        return list(alone.chosen)
    return list(range(equations.size))


def _frame(part: Bound) -> str:
    """The name of the link that a task moves."""
    return part.task.link or part.tip.robot.tip_link


def _sampled(equations: TaskEquations, horizon: float, count: int) -> tuple[Array, Array]:
    """Equal times (count,) and the targets there, one column each."""
    times = np.linspace(0.0, horizon, count)
    return times, np.array(equations.target_function().map(count)(times[None, :]))


def _parts(equations: TaskEquations, values: Array) -> list[tuple[Bound, Array]]:
    """Each task with its rows of the targets."""
    ends = np.cumsum([target_size(part.task) for part in equations.bound])
    return list(zip(equations.bound, np.split(values, ends[:-1]), strict=True))


def _check_rotations(equations: TaskEquations, values: Array, times: Array) -> None:
    for part, mine in _parts(equations, values):
        if part.task.orientation is not None:
            turn = mine[-12:-3].T.reshape(-1, 3, 3)
            wrong = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-6
            wrong |= np.linalg.det(turn) < 0
            if wrong.any():
                time, found = float(times[wrong][0]), turn[wrong][0].T
                words = f"orientation is no rotation at {time:g} s: {found.tolist()}"
                raise ProblemError(words, name="orientation", value=found, time=time)


def _has_full_rank(jacobian: Array) -> bool:
    if not jacobian.size:  # axes that lean alone
        return True
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(np.isfinite(values).all() and values[-1] > 1e-9 * values[0])


def check_closed(equations: TaskEquations, horizon: float) -> None:
    """Raise ProblemError where a task does not end where it began, as far as that does not depend on the way.

    Poses by their targets, velocities by their integrals.
    """
    times, values = _sampled(equations, horizon, CHECKS.closure_samples)
    for part, mine in _parts(equations, values):
        task = part.task
        if task.is_pose:
            gap = np.abs(np.delete(mine[:, -1] - mine[:, 0], _rate_rows(task))).max()
        else:
            closes = is_holonomic(part)
            none = np.zeros(CHECKS.closure_samples)
            whole = [mine[list(task.chosen).index(row)] if row in task.chosen else none for row in ANGULAR]
            linear = [i for i, row in enumerate(task.chosen) if row not in ANGULAR and closes[i]]
            moved = _integral(mine[linear], times[1])
            turned = _turn(np.array(whole), times[1]) if closes[[row in ANGULAR for row in task.chosen]].any() else 0.0
            gap = max(float(np.abs(moved).max(initial=0.0)), turned)
        if gap > CHECKS.closed:
            words = (
                f"cyclic: the task of {_frame(part)!r} is not closed: it ends {gap:.3g} (m or rad) "
                "from where it began, and the joints cannot return; close the path"
            )
            raise ProblemError(words, name=_frame(part), value=gap, limit=CHECKS.closed)


def check_rest(equations: TaskEquations, *times: float | None) -> None:
    """Raise ProblemError where a task moves at a time at which the joints are to rest; None: no time."""
    targets = equations.target_function()
    for time in times:
        if time is None:
            continue
        for part, mine in _parts(equations, np.array(targets(time)).ravel()):
            asked = mine[_rate_rows(part.task)] if part.task.is_pose else mine
            if np.linalg.norm(asked) > CHECKS.still:
                words = (
                    f"the task of {_frame(part)!r} moves at {asked.tolist()} (m/s or rad/s) at {time:g} s, where the "
                    "joints are to be at rest; let it come to rest there, or say 'free' for that end"
                )
                raise ProblemError(words, name=_frame(part), value=asked, limit=CHECKS.still, time=float(time))


def check_length(equations: TaskEquations, base: Array, horizon: float) -> None:
    """Raise ProblemError where positions in world are further from the first joint than the arm is long."""
    for part in equations.bound:
        task = part.task
        if task.position is None or task.axes != "world" or task.relative_to is not None or part.tip.base_size:
            continue
        times, values = _sampled(TaskEquations(equations.machine, (part,)), horizon, CHECKS.track_samples)
        wanted = values[task.linear].T
        shoulder, reach = _reach(part.tip, base)
        far = np.linalg.norm(wanted - shoulder[task.linear], axis=1)
        worst = int(far.argmax())
        if far[worst] > reach:
            words = (
                f"the task of {_frame(part)!r} leads {far[worst]:.4g} m away from the first joint at "
                f"{times[worst]:.4g}, to {wanted[worst].tolist()} m, but the arm is at most {reach:.4g} m long"
            )
            raise ProblemError(words, name=_frame(part), value=float(far[worst]), limit=reach, time=float(times[worst]))


def check_speed(equations: TaskEquations, most: Array, begin: float, end: float) -> None:
    """Raise ProblemError where a task is faster than its joints at their limits could move the tip in any posture.

    A joint that turns moves the tip by its rate times the distance, at most the length of the links from its axis on.

    Args:
        equations: Of a fixed base; others are not looked at.
        most: Limits of the joint rates, rad/s or m/s, shape (n,). begin, end: Of the tasks, s.
    """
    times = np.linspace(begin, end, CHECKS.track_samples)[1:-1]
    values = np.array(equations.target_function().map(len(times))(times[None, :]))
    for part, mine in _parts(equations, values):
        chain = [joint for joint in part.tip.robot.path_to(part.tip.robot.tip_link) if joint.moves]
        task, moving = part.task, any(joint.mimic is not None for joint in chain)
        if part.tip.base_size or part.reference or task.axes != "world" or moving or task.start_gap > CHECKS.closed:
            continue
        for asked, limit, unit in zip(
            _speeds(task, mine), _fastest(part.tip, chain, most), ("m/s", "rad/s"), strict=True
        ):
            worst = int(asked.argmax())
            if asked[worst] > limit * (1 + CHECKS.closed):
                words = (
                    f"at {times[worst]:.4g} s the task of {_frame(part)!r} asks for {asked[worst]:.4g} {unit}, "
                    f"but joints at the limits of their rates move it at {limit:.4g} {unit} at most; run it slower"
                )
                told: dict[str, Any] = {"value": float(asked[worst]), "limit": limit, "time": float(times[worst])}
                raise ProblemError(words, name=_frame(part), **told)


def _fastest(machine: Machine, chain: Sequence[Joint], most: Array) -> tuple[float, float]:
    """How fast joints at their limits (n,) move the tip, m/s, and turn it, rad/s, at most."""
    moved, turned = 0.0, 0.0
    for joint in chain:
        rate, turns = float(most[machine.robot.joint_names.index(joint.name)]), joint.kind != "prismatic"
        moved += rate * (_length_from(machine, joint) if turns else 1.0)
        turned += rate if turns else 0.0
    return moved, turned


def _speeds(task: TipTask, targets: Array) -> tuple[Array, Array]:
    """How fast a task moves and turns its tip in its rows. Shape (M,) each, m/s and rad/s."""
    turned = [row for row in task.chosen if row in ANGULAR]
    if task.is_pose:
        spins = targets[-3:] if task.tilts else targets[-3:][turned]
        way = targets[3:6][task.linear] if task.position is not None else targets[:0]
    else:
        at = {row: targets[i] for i, row in enumerate(task.chosen)}
        none = np.zeros((0, targets.shape[1]))
        way, spins = (
            np.array([at[row] for row in at if (row in ANGULAR) == angular]).reshape(-1, none.shape[1])
            for angular in (False, True)
        )
    return np.linalg.norm(way, axis=0), np.linalg.norm(spins, axis=0)


def _length_from(machine: Machine, joint: Joint) -> float:
    """How far the tip can be from a joint's axis at most, m."""
    robot = machine.robot
    chain = robot.path_to(robot.tip_link)
    after = chain[[other.name for other in chain].index(joint.name) + 1 :]
    return _length(machine, after)


def _length(machine: Machine, joints: Sequence[Joint]) -> float:
    """Of the way along joints to the tip, m: links, and slides where they are longest."""
    length = float(np.linalg.norm(machine.robot.tip_translation))
    length += sum(float(np.linalg.norm(joint.translation)) for joint in joints)
    return length + sum(max(abs(joint.lower), abs(joint.upper)) for joint in joints if joint.kind == "prismatic")


def _reach(machine: Machine, base: Array) -> tuple[Array, float]:
    """Where the first moving joint stands in the world, (3,), and how far from there the tip can be at most."""
    robot = machine.robot
    chain = robot.path_to(robot.tip_link)
    first = next((i for i, joint in enumerate(chain) if joint.moves), len(chain) - 1)
    frame = machine.world_from_base(base)
    turn, shoulder = np.array(ca.DM(frame.rotation)), np.array(ca.DM(frame.position)).ravel()
    for joint in chain[: first + 1]:
        shoulder, turn = shoulder + turn @ joint.translation, turn @ joint.rotation
    slides = [joint for joint in chain[: first + 1] if joint.kind == "prismatic"]
    before = sum(max(abs(joint.lower), abs(joint.upper)) for joint in slides)
    return shoulder, before + _length(machine, chain[first + 1 :])


def _rate_rows(task: TipTask) -> list[int]:
    """Which entries of a pose task's targets are velocities."""
    kinds = [(task.position, [3, 4, 5], 6), (task.orientation, [9, 10, 11], 12), (task.direction, [3, 4, 5], 6)]
    rows, at = [], 0
    for track, mine, size in kinds:
        if track is not None:
            rows += [at + row for row in mine]
            at += size
    return rows


def _integral(values: Array, step: float) -> Array:
    """Simpson's rule over an odd number of samples. Shapes (k, samples) to (k,)."""
    weights = np.ones(CHECKS.closure_samples)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    return np.asarray(values @ weights * step / 3)


def _turn(spin: Array, step: float) -> float:
    """Angle (rad) by which an angular velocity in world axes, shape (3, samples), turns a body in all."""
    turn = np.eye(3)
    for k in range(
        0, CHECKS.closure_samples - 1, 2
    ):  # Magnus' expansion of fourth order over two steps by Simpson's rule
        first, middle, last = spin[:, k], spin[:, k + 1], spin[:, k + 2]
        width = 2 * step
        vector = width / 6 * (first + 4 * middle + last) + width**2 / 12 * np.cross(last, first)
        angle = float(np.linalg.norm(vector))
        if angle > 0:
            cross = np.array(ca.DM(ca.skew(ca.DM(vector / angle))))
            turn = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ turn
    axial = np.array([turn[i, j] - turn[j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    return float(np.arctan2(np.linalg.norm(axial) / 2, (np.trace(turn) - 1) / 2))


def rates_at_rest(equations: TaskEquations, base: Any, joints: Array, rows: NDArray[np.bool_] | None = None) -> Array:
    """Joint velocities to ask for where a motion ends at rest, nan where free. Shape (n,).

    A tip whose acceleration is prescribed comes to rest by itself, one whose velocity is prescribed too: as many joints
    as the tasks have such rows then follow the others, and demanding rest of them too would be redundant. Those that
    move the tip best are left out.

    Args:
        base, joints: Configuration about there.
        rows: Which rows of the tasks come to rest by themselves; all if None. Shape (size,).
    """
    rest = np.zeros(len(joints))
    jacobian = np.array(ca.DM(equations.jacobian(ca.DM(base), joints)))
    if rows is not None:
        jacobian = jacobian[rows]
    for _ in range(len(jacobian)):
        best = int((jacobian**2).sum(axis=0).argmax())
        length = np.linalg.norm(jacobian[:, best])
        if length < CHECKS.ignorable:  # singular: the joints left out move the tip all ways that there are
            break
        direction = jacobian[:, best] / length
        jacobian = jacobian - np.outer(direction, direction @ jacobian)
        rest[best] = np.nan
    return rest
