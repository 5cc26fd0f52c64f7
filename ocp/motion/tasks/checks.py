"""Checks made before a motion is planned: whether a machine can perform tip tasks from a start configuration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models import Joint, Machine
from models.checks import Array, warn_of_degrees
from ocp.errors import ProblemError, format_distinct, require
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.tip_task import ANGULAR, BoundTask, TipTask


@dataclass(frozen=True)
class CheckSettings:
    """Settings of the checks of tip tasks: numbers of samples and tolerances."""

    track_samples: int = 201  # of a track, a target over time
    closure_samples: int = 2001  # of a closed track: odd, for Simpson's rule
    closed: float = 1e-6  # largest gap of a closed path, m and rad
    ignorable: float = 1e-9  # relative change of required joint rates below which a joint position has no effect
    ignorable_samples: int = 4  # number of random configurations in which that is evaluated
    rounding: float = 1e-9  # tolerance of a joint limit, per range between the limits or limit (at least 1)
    still: float = 1e-6  # largest task velocity where the joints are to be at rest, m/s and rad/s


CHECKS = CheckSettings()


def horizon_of(tasks: Sequence[TipTask], horizon: Any) -> float:
    """Return the horizon of a motion, s, by default the end of the last task; raise ProblemError if there is none."""
    if horizon is None:
        ends = [task.end for task in tasks if task.duration is not None]
        if not ends:
            words = "horizon is missing: no task has a duration; give horizon=... in s"
            raise ProblemError(words, name="horizon")
        horizon = max(ends)
    return require.positive("horizon", horizon)


def checked_configuration(machine: Machine, joints: Any, base: Any) -> tuple[Array, Array]:
    """Check the joint positions (joint_size,) and the base configuration (base_size,) of a start, and return both.

    The base is by default the machine's base_home(). Warns of angles that look like degrees.

    Raises:
        ProblemError: Wrong sizes, a value that is not finite, or a quaternion that is not of unit length.
    """
    if joints is None:
        words = "start is missing; give joint positions: inverse_kinematics(machine, task) finds some for a pose"
        raise ProblemError(words, name="start")
    positions = require.array("start", joints, (machine.joint_size,), meaning="one entry for each joint")
    for joint, angle in zip(machine.robot.moving_joints, positions, strict=True):
        if joint.kind != "prismatic":
            warn_of_degrees(f"start: joint {joint.name!r} at", angle, joint.name)
    home = machine.base_home() if base is None else base
    base_values = require.array("start_base", home, (machine.base_size,), meaning="the machine's base configuration")
    if machine.base_size == 7 and abs(np.linalg.norm(base_values[3:]) - 1) > 1e-9:
        words = f"start_base has the quaternion {base_values[3:].tolist()}, which is not of unit length"
        raise ProblemError(words, name="start_base", value=base_values[3:])
    return positions, base_values


def clip_to_limits(
    machine: Machine, joints: Array, lower: Array, upper: Array, *, label: str, hint: str = "keep within them"
) -> Array:
    """Clip joint positions or velocities (n,), nan where free, that exceed limits by no more than rounding errors.

    Raises:
        ProblemError: A joint is outside its limits; `label` names the values, and `hint` says what to do.
    """
    limits = joints.tolist(), lower.tolist(), upper.tolist()
    for name, value, low, high in zip(machine.robot.joint_names, *limits, strict=True):
        size = high - low if np.isfinite(high - low) else max([1.0, *(abs(x) for x in (low, high) if np.isfinite(x))])
        if value < low - CHECKS.rounding * size or value > high + CHECKS.rounding * size:
            at, least, greatest = format_distinct(value, low, high)
            verb = "ends" if label.startswith("end") else "starts"
            words = f"{label}: {name!r} {verb} at {at}, outside its limits {least} .. {greatest}; {hint}"
            raise ProblemError(words, name=name, value=value, limit=(low, high))
    return np.clip(joints, lower, upper)


def checked_weights(weights: Any, size: int) -> Array:
    """Return weights (size,) of squared joint rates, 1 if None is given; raise ProblemError if one is not positive."""
    if weights is None:
        return np.ones(size)
    return require.array("weights", weights, (size,), sign="positive", meaning="one for each joint")


def checked_tasks(
    equations: TaskEquations, base: Array, joints: Array, horizon: float, *, check_start: bool = True
) -> None:
    """Raise ProblemError if the machine cannot perform the tasks, or if its tip is not at a task's target at the start.

    The horizon is the end of the tasks, s, or 1 for tasks of a path parameter. Without `check_start`, the poses at the
    start are not compared.
    """
    b, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(joints))
    rows = _equation_numbers(equations)
    jacobian = equations.jacobian(b, q)
    if equations.size > len(joints):
        words = f"the task fixes {equations.size} rows {rows} but the machine has only {len(joints)} joints"
        raise ProblemError(words, name="rows", value=equations.size, limit=len(joints))
    unmoved = [row for i, row in enumerate(rows) if all(entry.is_zero() for entry in ca.horzsplit(jacobian[i, :]))]
    if unmoved:
        words = f"rows {rows}: no joint moves the tip in rows {unmoved}; leave them out of the task"
        raise ProblemError(words, name="rows", value=unmoved)
    numeric = ca.Function("jacobian", [b, q], [jacobian])
    configurations = [joints, *np.random.default_rng(0).normal(size=(5, len(joints)))]
    jacobians = [np.array(numeric(base, at)) for at in configurations] if equations.size else []
    ranks = [np.linalg.matrix_rank(each, rtol=1e-9) for each in jacobians if np.isfinite(each).all()]
    if max(ranks, default=0) < equations.size:
        words = f"the {equations.size} rows of the task are linearly dependent in every configuration tried: they "
        words += "prescribe a motion twice or one that the machine cannot make; leave out rows"
        raise ProblemError(words, name="rows", value=rows)
    if not any(part.task.is_pose for part in equations.bound):
        return
    times, values = _sample_targets(equations, horizon, CHECKS.track_samples)
    if not (finite := np.isfinite(values).all(axis=0)).all():
        first = float(times[~finite][0])
        words = f"the task's targets are not finite at {first:g} s"
        raise ProblemError(words, name="task", value=values[:, ~finite][:, 0], time=first)
    _check_rotations(equations, values, times)
    if check_start:
        for part in equations.bound:
            if not part.task.is_pose:
                continue
            alone = TaskEquations(equations.machine, (part,))
            residual = np.array(alone.pose_residual(base, joints, alone.target_function()(0.0)))
            gap = float(np.abs(residual).max())
            if gap > part.task.start_gap:
                words = f"at the start joints {joints.tolist()} the frame of {part.name!r} is {gap:.3g} (m or rad) "
                words += f"away from where its task begins, more than start_gap = {part.task.start_gap:g}; start from "
                words += "inverse_kinematics(machine, task), or allow the gap for the feedback to close"
                raise ProblemError(words, name=part.name, value=gap, limit=part.task.start_gap, time=0.0)


def dependent_rows(equations: TaskEquations, base: Array, joints: Array) -> str | None:
    """Return a text about the task equations if these are linearly dependent in a configuration, else None."""
    if not equations.size:
        return None
    values = np.linalg.svd(np.array(ca.DM(equations.jacobian(base, joints))), compute_uv=False)
    return f"the task of rows {_equation_numbers(equations)}" if values[-1] <= 1e-12 * values[0] else None


def ignorable_joints(equations: TaskEquations, base: Array) -> NDArray[np.bool_]:
    """Return a mask of joints whose positions affect neither the required joint rates nor the base. Shape (n,).

    That is evaluated in random configurations: the rates that do the tasks, the null space, the base motion and the
    cones of tool axes do not depend on such a joint position.
    """
    machine, rng, n = equations.machine, np.random.default_rng(0), equations.machine.joint_size
    b, q, u = (ca.SX.sym("v", size) for size in (machine.base_size, n, n))
    targets = ca.SX.sym("targets", equations.target_size)
    parts = [equations.jacobian(b, q), equations.right(b, q, targets)]
    parts += [machine.base_rate(b, q, u), equations.cone_cosines(b, q, targets)]
    function = ca.Function("requirements", [b, q, u, targets], parts, {"cse": True})
    start = np.array(equations.target_function()(0.0)).ravel()
    ignorable = np.ones(n, dtype=bool)
    for _ in range(CHECKS.ignorable_samples):
        rates, configurations = rng.normal(size=n), np.tile(rng.normal(size=n), (n + 1, 1))
        configurations[np.arange(n), np.arange(n)] += rng.normal(size=n)
        effect = []
        for at in configurations:
            jacobian, right, base_rate, lean = (np.array(value) for value in function(base, at, rates, start))
            inverse = np.linalg.pinv(jacobian, rcond=1e-10)
            effect.append(np.concatenate([np.ravel(v) for v in (inverse @ jacobian, inverse @ right, base_rate, lean)]))
        changes = np.abs(np.array(effect[:-1]) - effect[-1]).max(axis=1, initial=0.0)
        ignorable &= changes <= CHECKS.ignorable * (1 + np.abs(effect[-1]).max(initial=0.0))
    return ignorable


def _equation_numbers(equations: TaskEquations) -> list[int]:
    """Return the numbers of task equations for messages: twist components 0 to 5 of a single task, or row indices."""
    first = equations.bound[0].task
    if len(equations.bound) == 1 and not first.tilts:
        return list(first.chosen)
    return list(range(equations.size))


def _sample_targets(equations: TaskEquations, horizon: float, count: int) -> tuple[Array, Array]:
    """Sample the targets of all tasks at `count` equidistant times from 0 to the horizon; return times and samples."""
    times = np.linspace(0.0, horizon, count)
    return times, np.array(equations.target_function().map(count)(times[None, :]))


def _check_rotations(equations: TaskEquations, values: Array, times: Array) -> None:
    """Raise ProblemError if a target orientation is not a rotation matrix at one of the times."""
    for part, targets in equations.by_task(values):
        if part.task.orientation is not None:
            rotations = targets[part.target_rows["orientation"][0]].T.reshape(-1, 3, 3)
            invalid = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-6
            invalid |= np.linalg.det(rotations) < 0
            if invalid.any():
                time, matrix = float(times[invalid][0]), rotations[invalid][0].T
                words = f"orientation is not a rotation at {time:g} s: {matrix.tolist()}"
                raise ProblemError(words, name="orientation", value=matrix, time=time)


def check_closed(equations: TaskEquations, horizon: float) -> None:
    """Raise ProblemError if a task's target pose, or the integral of its target velocity, does not end as it begins."""
    times, values = _sample_targets(equations, horizon, CHECKS.closure_samples)
    for part, targets in equations.by_task(values):
        task = part.task
        if task.is_pose:
            gap = np.abs(np.delete(targets[:, -1] - targets[:, 0], part.rate_rows)).max()
        else:
            holonomic = part.is_holonomic
            by_row, zeros = dict(zip(task.chosen, targets, strict=True)), np.zeros(CHECKS.closure_samples)
            angular = [by_row.get(row, zeros) for row in ANGULAR]
            linear = [i for i, row in enumerate(task.chosen) if row not in ANGULAR and holonomic[i]]
            displacement = scipy.integrate.simpson(targets[linear], dx=times[1])
            turns = holonomic[[row in ANGULAR for row in task.chosen]].any()
            rotation = _rotation_angle(np.array(angular), times[1]) if turns else 0.0
            gap = max(float(np.abs(displacement).max(initial=0.0)), rotation)
        if gap > CHECKS.closed:
            words = f"cyclic: the task of {part.name!r} is not closed: it ends {gap:.3g} (m or rad) from where it "
            words += "began, and the joints cannot return; close the path"
            raise ProblemError(words, name=part.name, value=gap, limit=CHECKS.closed)


def check_rest(equations: TaskEquations, *times: float | None) -> None:
    """Raise ProblemError if a task prescribes motion at a time, s, at which the joints must rest; None is ignored."""
    for time in (time for time in times if time is not None):
        for part, velocity in _moving_tasks(equations, time):
            words = f"the task of {part.name!r} moves at {velocity.tolist()} (m/s or rad/s) at {time:g} s, where the "
            words += "joints are to be at rest; let it come to rest there, or say 'free' for that end"
            raise ProblemError(words, name=part.name, value=velocity, limit=CHECKS.still, time=float(time))


def are_at_rest(equations: TaskEquations | None, time: float) -> bool:
    """Return whether all tasks prescribe rest at a time, s; True if there are no tasks (None)."""
    return equations is None or not any(_moving_tasks(equations, time))


def _moving_tasks(equations: TaskEquations, time: float) -> Iterator[tuple[BoundTask, Array]]:
    """Yield the tasks that prescribe motion at a time, with the prescribed velocities, m/s and rad/s."""
    for part, values in equations.by_task(np.array(equations.target_function()(time)).ravel()):
        velocity = values[part.rate_rows] if part.task.is_pose else values
        if np.linalg.norm(velocity) > CHECKS.still:
            yield part, velocity


def check_length(equations: TaskEquations, base: Array, horizon: float) -> None:
    """Raise ProblemError if a target position is farther from the first joint than the arm is long."""
    for part in equations.bound:
        task = part.task
        if task.position is None or task.axes != "world" or task.relative_to is not None or part.tip.base_size:
            continue
        times, values = _sample_targets(TaskEquations(equations.machine, (part,)), horizon, CHECKS.track_samples)
        positions = values[task.linear].T
        shoulder, reach = _shoulder_and_reach(part.tip, base)
        far = np.linalg.norm(positions - shoulder[task.linear], axis=1)
        worst = int(far.argmax())
        if far[worst] > reach:
            words = f"the task of {part.name!r} leads {far[worst]:.4g} m away from the first joint at "
            words += f"{times[worst]:.4g}, to {positions[worst].tolist()} m, but the arm is at most {reach:.4g} m long"
            raise ProblemError(words, name=part.name, value=float(far[worst]), limit=reach, time=float(times[worst]))


def check_speed(equations: TaskEquations, rate_limits: Array, begin: float, end: float) -> None:
    """Raise ProblemError if a task is faster than a fixed arm's tip can move anywhere within rate limits (n,).

    A revolute joint moves the tip at most by its rate times the length of the links from its axis to the tip.
    """
    times = np.linspace(begin, end, CHECKS.track_samples)[1:-1]
    values = np.array(equations.target_function().map(len(times))(times[None, :]))
    for part, targets in equations.by_task(values):
        chain = [joint for joint in part.tip.robot.path_to(part.tip.robot.tip_link) if joint.moves]
        task, coupled = part.task, any(joint.mimic is not None for joint in chain)
        if part.tip.base_size or part.reference or task.axes != "world" or coupled or task.start_gap > CHECKS.closed:
            continue
        for speeds, limit, unit in zip(
            _task_speeds(task, targets), _max_tip_speeds(part.tip, chain, rate_limits), ("m/s", "rad/s"), strict=True
        ):
            worst = int(speeds.argmax())
            if speeds[worst] > limit * (1 + CHECKS.closed):
                words = f"at {times[worst]:.4g} s the task of {part.name!r} asks for {speeds[worst]:.4g} {unit}, but "
                words += f"joints at the limits of their rates move it at {limit:.4g} {unit} at most; run it slower"
                speed, time = float(speeds[worst]), float(times[worst])
                raise ProblemError(words, name=part.name, value=speed, limit=limit, time=time)


def _max_tip_speeds(machine: Machine, chain: Sequence[Joint], rate_limits: Array) -> tuple[float, float]:
    """Return upper bounds of the tip's speed, m/s, and angular speed, rad/s, for given joint rate limits (n,)."""
    linear, angular = 0.0, 0.0
    whole = machine.robot.path_to(machine.robot.tip_link)
    after = {joint.name: whole[i + 1 :] for i, joint in enumerate(whole)}
    for joint in chain:
        rate, revolute = float(rate_limits[machine.robot.joint_names.index(joint.name)]), joint.kind != "prismatic"
        length = chain_length(after[joint.name], machine.robot.tip_translation) if revolute else 1.0
        linear += rate * length
        angular += rate if revolute else 0.0
    return linear, angular


def _task_speeds(task: TipTask, targets: Array) -> tuple[Array, Array]:
    """Return the speed, m/s, and angular speed, rad/s, that a task prescribes at M times. Shape (M,) each."""
    angular_rows = [row for row in task.chosen if row in ANGULAR]
    if task.is_pose:
        angular = targets[-3:] if task.tilts else targets[-3:][angular_rows]
        linear = targets[3:6][task.linear] if task.position is not None else targets[:0]
    else:
        turning = np.isin(task.chosen, ANGULAR)
        linear, angular = targets[~turning], targets[turning]
    return np.linalg.norm(linear, axis=0), np.linalg.norm(angular, axis=0)


def chain_length(joints: Sequence[Joint], point: Any) -> float:
    """Return an upper bound of the distance, m, from the start of a joint chain to a point (3,) of its last link.

    It is infinite if a prismatic joint has no limits.
    """
    length = sum(float(np.linalg.norm(offset)) for offset in (point, *(joint.translation for joint in joints)))
    return length + sum(max(abs(joint.lower), abs(joint.upper)) for joint in joints if joint.kind == "prismatic")


def _shoulder_and_reach(machine: Machine, base: Array) -> tuple[Array, float]:
    """Return the world position (3,) of an arm's first moving joint, and the tip's largest distance from this joint."""
    robot = machine.robot
    chain = robot.path_to(robot.tip_link)
    first = next((i for i, joint in enumerate(chain) if joint.moves), len(chain) - 1)
    frame = machine.world_from_base(base)
    rotation, shoulder = np.array(ca.DM(frame.rotation)), np.array(ca.DM(frame.position)).ravel()
    for joint in chain[: first + 1]:
        shoulder, rotation = shoulder + rotation @ joint.translation, rotation @ joint.rotation
    slides = [joint for joint in chain[: first + 1] if joint.kind == "prismatic"]
    slide_length = sum(max(abs(joint.lower), abs(joint.upper)) for joint in slides)
    return shoulder, slide_length + chain_length(chain[first + 1 :], robot.tip_translation)


def _rotation_angle(velocity: Array, step: float) -> float:
    """Return the angle, rad, of the rotation that results from sampled angular velocities (3, samples) in world."""
    first, middle, last = velocity[:, :-2:2], velocity[:, 1:-1:2], velocity[:, 2::2]
    vectors = step / 3 * (first + 4 * middle + last) + step**2 / 3 * np.cross(last, first, axis=0)
    turns = scipy.spatial.transform.Rotation.from_rotvec(vectors.T)
    return float(reduce(lambda before, turn: turn * before, turns).magnitude())


def rates_at_rest(equations: TaskEquations, base: Any, joints: Array, rows: NDArray[np.bool_] | None = None) -> Array:
    """Return the joint velocities (n,) to prescribe at an end at rest: 0, or nan where the tasks imply rest.

    A tip whose velocity or acceleration is prescribed comes to rest by itself, so that prescribing rest for all joints
    would be redundant. The joints that move the tip most are left free. `rows` is the mask of the task
    equations that come to rest by themselves; all if None.
    """
    rest = np.zeros(len(joints))
    jacobian = np.array(ca.DM(equations.jacobian(ca.DM(base), joints)))
    if rows is not None:
        jacobian = jacobian[rows]
    for _ in range(len(jacobian)):
        best = int((jacobian**2).sum(axis=0).argmax())
        length = np.linalg.norm(jacobian[:, best])
        if length < CHECKS.ignorable:  # singular: the free joints already span all motions of the tip
            break
        direction = jacobian[:, best] / length
        jacobian = jacobian - np.outer(direction, direction @ jacobian)
        rest[best] = np.nan
    return rest
