"""Vectorised kinematics of a moving-base machine at many states, and a test of whether the machine reaches poses.

With the scaled rates p = sqrt(W) dq/dt, the running cost is |p|^2 / 2. The rates that do a task, A p = v, are the
least-norm solution plus any rates in the null space of A, the self-motions. The base follows, since its momentum is
conserved.

Conserved momentum moves the centre of mass of a free-floating machine on a straight line, whatever its joints do, while
the attitude of the base depends on the path. A pose is therefore out of reach if no joints and no attitude bring the
tips there with the centre of mass where it is then. For this test, the machine has a fixed base and a further joint
that turns it about the centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models import FreeFloating, Machine, center_of_mass
from models.checks import Array
from models.spatial import rotation, rotation_from_quaternion
from ocp.motion.local.inverse_kinematics import Unreachable, gauss_newton, sample_starts, unreachable_error
from ocp.motion.search.configurations import REACH_TOLERANCE
from ocp.motion.search.joint_space import TOLERANCE
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.tip_task import ANGULAR, TipTask
from ocp.problem.values import Sampler
from ocp.tolerances import ROUNDING_SHARE

SIMPSON_STEPS = 400
"""Number of steps of Simpson's rule, which integrates a tip velocity to a displacement."""


class LimitSide(IntEnum):
    """Limit of a joint: lowest or highest position, lowest or highest rate."""

    LOW = 0
    HIGH = 1
    SLOW = 2
    FAST = 3


class TaskKinematics(NamedTuple):
    """Tasks linearised at several states of a machine: linear equations in the scaled joint rates.

    At each of K states, the m equations are A p = v for the rates p of n joints.

    Attributes:
        right, error: Required task rates, and pose errors. Shape (K, m).
        base, drift: The rate of the b base coordinates is base @ p + drift. Shapes (K, b, n), (K, b).
        row_space, lower: A = lower @ row_space', with orthonormal columns of row_space and lower triangular.
            Shapes (K, n, m), (K, m, m).
        null: Orthonormal basis of the null space of A. Shape (K, n, r).
    """

    right: Array
    error: Array
    base: Array
    drift: Array
    row_space: Array
    lower: Array
    null: Array

    def select(self, rows: Any) -> TaskKinematics:
        """Return the linearised tasks at the states with the given indices."""
        return TaskKinematics(*(part[rows] for part in self))

    def task_rates(self, rates: Array) -> Array:
        """Return the rates of the task coordinates (K, m) that scaled joint rates (K, n) cause."""
        return np.asarray(self.lower @ (self.row_space.transpose(0, 2, 1) @ rates[:, :, None]))[:, :, 0]

    def least_rates(self, required: Array) -> Array:
        """Return the least-norm scaled joint rates (K, n) that cause required rates of the task coordinates (K, m)."""
        return np.asarray(self.row_space @ np.linalg.solve(self.lower, required[:, :, None]))[:, :, 0]

    def null_rates(self, rates: Array) -> Array:
        """Project scaled joint rates (K, n) onto the null space of the tasks."""
        return np.asarray(rates - (self.row_space @ (self.row_space.transpose(0, 2, 1) @ rates[:, :, None]))[:, :, 0])

    def base_rates(self, rates: Array) -> Array:
        """Return the base rates (K, b) that scaled joint rates (K, n) cause, without the drift at zero joint rates."""
        return np.asarray((self.base @ rates[:, :, None])[:, :, 0])


class ReducedKinematics:
    """Kinematics of a machine, and of its tasks if there are any, at many states in terms of scaled joint rates.

    Attributes:
        rows: Number of task equations.
        equations: Task equations, or None.
        root: Square roots of the weights. Shape (n,).
    """

    def __init__(self, machine: Machine, equations: TaskEquations | None, weights: Array) -> None:
        self.root, self.equations, self.rows = np.sqrt(weights), equations, 0 if equations is None else equations.size
        n = machine.joint_size
        b, q, u = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", n), ca.SX.sym("u", n)
        self._targets = None if equations is None else equations.target_function()
        symbols = [b, q]
        parts = [ca.jacobian(machine.base_rate(b, q, u), u), machine.base_rate(b, q, ca.DM.zeros(n))]
        if equations is not None:
            assert self._targets is not None
            symbols.append(targets := ca.SX.sym("targets", self._targets.numel_out()))
            parts += [equations.jacobian(b, q), equations.right(b, q, targets), equations.error(b, q, targets)]
        self._sampler = Sampler(symbols, parts)

    def at(self, base: Array, joints: Array, time: float) -> TaskKinematics:
        """Linearise the tasks at K states, given by base coordinates (K, b) and joint positions (K, n)."""
        count, n = joints.shape
        arguments = [base, joints]
        if self._targets is not None:
            arguments.append(np.array(self._targets(time)).ravel())
        base_jacobian, drift, *task = self._sampler(*arguments)
        matrix, right, error = task if task else (np.zeros((count, 0)),) * 3
        base_jacobian = base_jacobian.reshape(count, n, -1).transpose(0, 2, 1) / self.root
        basis, triangular = np.linalg.qr(matrix.reshape(count, n, self.rows) / self.root[:, None], mode="complete")
        lower = triangular[:, : self.rows].transpose(0, 2, 1).copy()
        for i in range(self.rows):  # regularise dependent task equations
            threshold = ROUNDING_SHARE * np.abs(lower).max(axis=(1, 2)) + np.finfo(float).tiny
            lower[:, i, i] = np.where(np.abs(lower[:, i, i]) < threshold, threshold, lower[:, i, i])
        if self.equations is not None:
            error = np.where(self.equations.pose_rows, error, 0.0)
        row_space, null = basis[:, :, : self.rows], basis[:, :, self.rows :]
        return TaskKinematics(right, error, base_jacobian, drift, row_space, lower, null)

    def estimate_squared_rates(self, base: Array, joints: Array, time: float) -> Array:
        """Estimate the squared norm (K,) of scaled joint rates that perform the tasks; valid far from singularities."""
        if self.equations is None:
            return np.zeros(len(joints))
        tasks = [part.task for part in self.equations.bound]
        gains = np.repeat([float(task.gain) for task in tasks], [task.size for task in tasks])
        task = self.at(base, joints, time)
        rates_squared = ((task.right - gains * task.error) ** 2).sum(axis=1)
        return np.asarray(self.rows * rates_squared / (task.lower**2).sum(axis=(1, 2)))

    def velocity_errors(self, base: Array, joints: Array, rates: Array, time: float) -> tuple[Array, Array]:
        """Return the norms (K,) of the tip velocity errors of joint rates (K, n), and of the required velocities."""
        zeros = np.zeros(len(joints))
        if self.equations is None or self.equations.pose_rows.all():
            return zeros, zeros
        task, rows = self.at(base, joints, time), ~self.equations.pose_rows
        errors = (task.task_rates(rates * self.root) - task.right)[:, rows]
        return np.linalg.norm(errors, axis=1), np.linalg.norm(task.right[:, rows], axis=1)

    def step(
        self,
        base: Array,
        joints: Array,
        task: TaskKinematics,
        rates: Array,
        *,
        interval: tuple[float, float],
        tolerance: float,
    ) -> tuple[Array, Array, Array]:
        """Advance states by one step of the midpoint rule, where scaled joint rates (K, n) determine the self-motion.

        Returns:
            Base (K, b), joints (K, n) and remaining pose errors (K,), which are corrected down to the tolerance.
        """
        (begin, end), start_joints = interval, joints
        duration = end - begin
        half_base = base + duration / 2 * (task.base_rates(rates) + task.drift)
        middle = self.at(_normalize(half_base), joints + duration / 2 * rates / self.root, begin + duration / 2)
        rates = middle.least_rates(middle.right) + middle.null_rates(task.null_rates(rates))
        base = _normalize(base + duration * (middle.base_rates(rates) + middle.drift))
        joints = joints + duration * rates / self.root
        if self.equations is None or self.equations.pose_rows.all():
            return self.correct_poses(base, joints, end, tolerance)

        def remaining(at_end: TaskKinematics, joints: Array) -> Array:
            """Return the tip displacement that velocity tasks prescribe in this step minus the actual displacement."""
            straight = (joints - start_joints) * self.root
            parts = ((1, task), (4, middle), (1, at_end))
            return np.asarray(sum(k / 6 * (duration * each.right - each.task_rates(straight)) for k, each in parts))

        return self.correct_poses(base, joints, end, tolerance, remaining=remaining)

    def correct_poses(
        self,
        base: Array,
        joints: Array,
        time: float,
        tolerance: float,
        *,
        max_steps: int = 3,
        remaining: Callable[[TaskKinematics, Array], Array] | None = None,
    ) -> tuple[Array, Array, Array]:
        """Correct the pose errors of states by Newton steps; return base, joints and remaining pose errors.

        Args:
            tolerance: Pose error, m and rad, below which the iteration ends.
            max_steps: Largest number of Newton steps.
            remaining: Function of linearised tasks and joints that returns the missing displacement in each equation,
                (K, m).
        """
        pose_error = np.zeros(len(joints))
        if self.equations is None or (remaining is None and not self.equations.pose_rows.any()):
            return base, joints, pose_error
        for iteration in range(max_steps + 1):
            task = self.at(base, joints, time)
            error = task.error
            if remaining is not None:
                error = np.where(self.equations.pose_rows, error, remaining(task, joints))
            pose_error = np.abs(error).max(axis=1)
            pose_error = np.where(np.isfinite(pose_error), pose_error, np.inf)
            if iteration == max_steps or pose_error.max(initial=0.0) <= tolerance:
                break
            rates = task.least_rates(error)
            rates /= np.maximum(np.linalg.norm(rates, axis=1, keepdims=True), 1.0)
            base, joints = _normalize(base + task.base_rates(rates)), joints + rates / self.root
        return base, joints, pose_error


def _normalize(base: Array) -> Array:
    """Return base configurations (K, b) after normalising their quaternions, if they contain any."""
    if base.shape[1] == 7:
        base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1, keepdims=True)
    return base


def limit_rates(
    rates: Array, null: Array, lower: Array, upper: Array, *, max_rates: Array
) -> tuple[Array, NDArray[np.intp]]:
    """Add self-motions to scaled joint rates (K, n) to bring each joint within its limits, where this is possible.

    Args:
        null: Bases of the self-motions. Shape (K, n, r).
        lower, upper: Limits of the scaled rates. Shape (K, n).
        max_rates: Those that are due to rate limits alone. Shape (n,).

    Returns:
        The rates, and for each state the joint that cannot keep a limit and its `LimitSide`, or -1. Shape (K, 2).
    """
    rates, violations = rates.copy(), np.full((len(rates), 2), -1, dtype=np.intp)
    active = np.arange(len(rates))
    for _ in range(2 * rates.shape[1] + 1):  # two limits per joint
        excess = np.maximum(rates[active] - upper[active], lower[active] - rates[active])
        worst = excess.argmax(axis=1)
        beyond = excess[np.arange(len(active)), worst] > TOLERANCE
        violations[active[~beyond]] = -1
        active, worst = active[beyond], worst[beyond]
        if not active.size:
            break
        below = rates[active, worst] < lower[active, worst]
        limit = np.where(below, lower[active, worst], upper[active, worst])
        is_rate_limit = np.abs(limit) >= max_rates[worst]
        side = np.where(below, LimitSide.LOW, LimitSide.HIGH) + np.where(is_rate_limit, LimitSide.SLOW, LimitSide.LOW)
        violations[active] = np.column_stack([worst, side])
        directions = null[active, worst]
        leverage = (directions**2).sum(axis=1)
        change = (limit - rates[active, worst]) / np.maximum(leverage, ROUNDING_SHARE)
        share = np.where(leverage > ROUNDING_SHARE, change, 0.0)
        rates[active] += share[:, None] * (null[active] @ directions[:, :, None])[:, :, 0]
    return rates, violations


STARTS = 64
"""Number of random joint positions and attitudes from which inverse kinematics starts at each time."""
CHECKED_TIMES = 17
"""Number of times at which the reach of poses is tested before the first failure is located by bisection."""


def check_floating_reach(
    machine: FreeFloating,
    tasks: Sequence[TipTask],
    base: Array,
    start: Array,
    *,
    interval: tuple[float, float],
    bounds: JointBounds,
    seed: int = 0,
) -> None:
    """Raise Unreachable if inverse kinematics from many starts cannot reach a pose with any attitude of the base.

    Velocities in world axes are integrated to positions; orientations from velocities are ignored.

    Args:
        machine: Free-floating machine with conserved momentum.
        tasks: All tasks, each in its own time.
        base, start: Base and joint positions at 0 s. Shapes (base_size,), (n,).
        interval: Begin and end of the time that is checked, s, at CHECKED_TIMES samples. The interval before an
            unreachable pose is bisected ten times.
        bounds: Limits of the joints.
        seed: Seed of the random starts.

    Raises:
        Unreachable: Names the time from which a pose is out of reach, and the least pose error.
    """
    (begin, end), lower, upper = interval, bounds.lower, bounds.upper
    n, attitude_size = machine.joint_size, 1 if machine.base_size == 3 else 4
    rng = np.random.default_rng(seed)
    attitudes = rng.normal(size=(STARTS, 4)) if attitude_size == 4 else rng.uniform(-np.pi, np.pi, (STARTS, 1))
    starts = np.hstack([sample_starts(machine, lower, upper, STARTS, seed=seed), attitudes])
    unlimited = np.full(attitude_size, np.inf)
    limits = np.concatenate([lower, -unlimited]), np.concatenate([upper, unlimited])
    solutions = np.zeros((0, n + attitude_size))  # solutions at the preceding time

    def unreachable_at(time: float) -> Unreachable | None:
        """Return an error if a pose is out of reach at a time; None if all poses can be reached."""
        nonlocal solutions
        poses = []
        for task in tasks:
            if task.begin <= time <= task.end and (task.is_pose or not task.begin):
                pose = _equivalent_pose(machine, task, start, time, base=base)
                poses += [] if pose is None else [pose]
        if not poses:
            return None
        equations = bind(machine, poses)
        targets = np.array(equations.target_function()(time)).ravel()
        z = ca.SX.sym("z", n + attitude_size)
        base_then = _base_about_center_of_mass(machine, base, start, z, time)
        residual = equations.pose_residual(base_then, z[:n], ca.SX(ca.DM(targets)))
        function = ca.Function("pose_residual", [z], [residual, ca.densify(ca.jacobian(residual, z))], {"cse": True})
        guesses = np.vstack([solutions, starts])
        candidates, errors = gauss_newton(function, guesses, *limits, tolerance=REACH_TOLERANCE, iterations=100)
        reached = errors <= REACH_TOLERANCE
        if reached.any():
            solutions = candidates[reached][:STARTS]
            return None
        best = int(errors.argmin())
        place = ca.Function("base", [z], [base_then])(candidates[best])
        misses = equations.misses(place, candidates[best, :n], targets)
        details: dict[str, Any] = {"lower": lower, "upper": upper, "misses": misses}
        return unreachable_error(equations, candidates[best, :n], float(errors[best]), **details)

    reached = begin
    for time in np.linspace(begin, end, CHECKED_TIMES).tolist():
        if (error := unreachable_at(time)) is None:
            reached = time
            continue
        while time - reached > (end - begin) / (CHECKED_TIMES - 1) / 2**10:
            middle = (reached + time) / 2
            if (unreachable_then := unreachable_at(middle)) is None:
                reached = middle
            else:
                time, error = middle, unreachable_then
        error.time = time
        raise error


def _equivalent_pose(machine: Machine, task: TipTask, start: Array, time: float, *, base: Any = ()) -> TipTask | None:
    """Return the pose task with the same effect as a task at a time; None if the pose depends on the path taken.

    Args:
        machine, task: The machine and its task.
        start, base: Joints and base at the start.
        time: Time since the begin of the task, s.
    """
    if task.is_pose:
        return task if task.start_gap <= REACH_TOLERANCE else None
    rows = [row for row in task.chosen if row not in ANGULAR]
    if not rows or task.axes not in ("world", "reference") or (task.axes == "world") != (task.relative_to is None):
        return None
    equations = bind(machine, task)
    times = np.linspace(0.0, time, SIMPSON_STEPS + 1)
    values = np.array(equations.target_function().map(len(times))(times[None, :]))
    displacement = np.zeros(3)
    velocities = values[[task.chosen.index(row) for row in rows]]
    displacement[[row - 3 for row in rows]] = scipy.integrate.simpson(velocities, dx=time / SIMPSON_STEPS)
    origin, _ = equations.bound[0].pose_in_reference(ca.DM(base), ca.DM(start))
    return replace(task, velocity=None, rows=rows, position=np.array(ca.DM(origin)).ravel() + displacement)


def _base_about_center_of_mass(machine: FreeFloating, base: Array, start: Array, z: Any, time: float) -> Any:
    """Return the base configuration that puts the centre of mass where the conserved momentum has moved it.

    z holds the joint positions and the attitude of the base.
    """
    robot, frame, n = machine.robot, machine.world_from_base(ca.DM(base)), machine.joint_size
    joints, attitude = z[:n], z[n:]
    momentum = np.zeros(6)
    momentum[machine.twist_rows] = np.asarray(machine.conserved_momentum)
    center = center_of_mass(robot, ca.DM(start), frame) + time * ca.DM(momentum[3:]) / robot.total_mass
    if attitude.numel() == 1:
        position = center - ca.mtimes(rotation((0, 0, 1), attitude), center_of_mass(robot, joints))
        return ca.vertcat(position[:2], attitude)
    return ca.vertcat(center - ca.mtimes(rotation_from_quaternion(attitude), center_of_mass(robot, joints)), attitude)
