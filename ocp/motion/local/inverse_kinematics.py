"""Inverse kinematics within joint limits: on all branches if an arm has a solver, else from many initial guesses.

Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) from many starts at once, with bounds by projection: joints at a
limit that a step would violate are fixed in that step. All starts share one mapped CasADi function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import CollisionScene, Machine
from models.checks import Array
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.motion.local.collisions import Collision, checked_collision_scene, slide_apart, worst_collisions
from ocp.motion.local.ik_solver import ik_branches, joint_range, sampling_range
from ocp.motion.tasks.checks import checked_configuration
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask

LARGEST_SEED = 2**64


@dataclass(frozen=True)
class IkSettings:
    """Settings of the Levenberg-Marquardt iterations, and of the choice among their solutions."""

    first_damping: float = 1e-2  # damping of the first step
    least_damping: float = 1e-12  # least damping
    most_damping: float = 1e8  # damping at which a start is abandoned
    growth: float = 4.0  # factor of the damping after a step that fails
    shrinkage: float = 0.25  # factor of the damping after a step that succeeds
    slide_count: int = 8  # number of solutions in collision that are moved along their self-motions


IK_SETTINGS = IkSettings()


@dataclass(frozen=True, eq=False)
class IkOptions:
    """Options of `inverse_kinematics`: base configuration, joint limits, accuracy and number of iterations.

    Attributes:
        base: Base configuration, shape (base_size,); the machine's base_home() if None.
        limits: Whether the position limits of the robot apply.
        tolerance: Largest pose error of a solution, m and rad.
        apart: Least distance between two solutions, in the largest joint difference, angles modulo full turns.
        iterations: Largest number of iterations of each start.

    Raises:
        ProblemError: A value is invalid.
    """

    base: Any = None
    limits: bool = True
    tolerance: float = 1e-10
    apart: float = 1e-3
    iterations: int = 100

    def __post_init__(self) -> None:
        require.flag("limits", self.limits)
        require.positive("tolerance", self.tolerance)
        require.positive("apart", self.apart)
        require.count("iterations", self.iterations, least=1)


IK_OPTIONS = IkOptions()


@dataclass(frozen=True)
class IkSolution:
    """Solution of inverse kinematics: joint positions at a target pose."""

    joints: Array  # (n,), rad or m
    quality: float  # manipulability times the least distance of a joint from its limits, as a share of half its range
    pose_error: float  # largest remaining pose error of all tasks, m or rad


class Unreachable(ProblemError):
    """Error raised if inverse kinematics finds no joint positions for a pose.

    Attributes:
        joints: The nearest miss. Shape (joint_size,).
        pose_error: Its pose error, m or rad (2 sin(angle / 2)).
        distance: Largest distance of a tip from its target then, m; nan if it does not apply.
        angle: Largest angle of a tip from its target then, rad; nan if it does not apply.
    """

    def __init__(
        self,
        message: str,
        joints: Array,
        pose_error: float,
        *,
        distance: float = np.nan,
        angle: float = np.nan,
        **details: Any,
    ) -> None:
        super().__init__(message, **details)
        self.joints, self.pose_error = joints, pose_error
        self.distance, self.angle = distance, angle

    def __reduce__(self) -> Any:
        """Return what pickle needs to rebuild the error with its arguments and fields."""
        return type(self), (*self.args, self.joints, self.pose_error), self.__dict__


@interruptible
def inverse_kinematics(
    machine: Machine,
    task: TipTask | Sequence[TipTask],
    *,
    time: float = 0.0,
    starts: int = 64,
    near: Any = None,
    seed: int = 0,
    scene: CollisionScene | None = None,
    options: IkOptions = IK_OPTIONS,
) -> list[IkSolution]:
    """Return distinct configurations in which the machine satisfies its pose tasks, sorted by decreasing quality.

    If the task is one pose of the tip of an arm on a fixed base, its solutions are listed on all branches, see
    `ik_configurations`, of a redundant arm at samples of its free parameters. Damped Gauss-Newton iterations from
    random starts solve other tasks and machines. They complete lists that may be incomplete or have too few members.

    Args:
        machine: Any machine; a floating base does not move.
        task: A TipTask with a pose, or several that hold at once; velocity tasks are ignored.
        time: Time of the tasks, s.
        starts: Number of samples of the free parameters, and of random starts, uniform between the limits, -pi .. pi
            for unlimited joints. Of more solutions of a redundant arm, so many are kept that are far from each other.
            0: only the iterations from `near`.
        near: Further starts, before the random ones. Shape (joint_size,) or (k, joint_size).
        seed: Seed of the samples and of the random starts.
        scene: Collision scene of the machine; solutions closer than the clearance are left out. If that leaves none,
            the ones with the largest distances are moved along their self-motions.
        options: Base, limits and accuracy.

    Raises:
        Unreachable: No start leads to the pose, with the nearest miss; or no solution is collision-free, with the pair
            of the one that is closest to it.
        ProblemError: No task is a pose, the robot has no joint, or a size or number is invalid.
    """
    equations = bind(machine, task)
    if not machine.joint_size:
        raise ProblemError("inverse_kinematics: the robot has no moving joint", name="machine", value=machine)
    if not (pose_tasks := tuple(part for part in equations.bound if part.task.is_pose)):
        words = "inverse kinematics need a pose: task=TipTask(position=..., orientation=... or direction=...)"
        raise ProblemError(words, name="task")
    equations = TaskEquations(machine, pose_tasks)
    require.instance("options", options, IkOptions)
    require.count("starts", starts, least=0)
    require.count("seed", seed, 0, LARGEST_SEED)
    if scene is not None:
        checked_collision_scene(scene, machine, options.limits)
    require.number("time", time, unit="s")
    size = machine.joint_size
    base_values = checked_configuration(machine, np.zeros(size), options.base)[1]
    lower, upper = joint_range(machine, options.limits)
    first = sample_starts(machine, lower, upper, int(starts), near=near, seed=seed)
    targets = np.array(equations.target_function()(float(time))).ravel()
    if not np.isfinite(targets).all():
        words = f"the task's targets are not finite at {time:g} s"
        raise ProblemError(words, name="task", value=targets, time=float(time))

    search = _MultiStart(equations, base_values, targets, lower, upper, options)
    listed, random = search.list_branches(int(starts), int(seed))
    first = first[: len(first) - int(starts) + random]
    solutions = search.solve(np.vstack([first[: len(first) - random], listed, first[len(first) - random :]]), random)
    if scene is None:
        return solutions
    collisions = _closest_collisions(solutions, scene, base_values, float(time))
    if all(collisions) and equations.size < size:
        order = sorted(range(len(solutions)), key=lambda k: -collisions[k].distance)  # type: ignore[union-attr]
        closest = np.array([solutions[k].joints for k in order[: IK_SETTINGS.slide_count]])
        moved = slide_apart(
            scene,
            base_values,
            closest,
            float(time),
            jacobian=lambda joints: np.array(equations.jacobian_function(joints, base_values)),
            back=lambda joints: search.iterate(joints)[0],
            lower=lower,
            upper=upper,
        )
        solutions += search.rank(*search.iterate(moved))
        collisions = _closest_collisions(solutions, scene, base_values, float(time))
    return _collision_free(solutions, collisions, scene, float(time))


def inverse_kinematics_at(
    equations: TaskEquations,
    targets: Array,
    *,
    starts: int,
    seed: int,
    near: Array | None = None,
    options: IkOptions = IK_OPTIONS,
) -> list[IkSolution]:
    """Return IK solutions of a fixed-base machine for numerical task targets, by iterations from initial guesses alone.

    Raises:
        Unreachable: No start leads to the pose.
    """
    lower, upper = joint_range(equations.machine, options.limits)
    first = sample_starts(equations.machine, lower, upper, starts, near=near, seed=seed)
    return _MultiStart(equations, np.zeros(0), targets, lower, upper, options).solve(first, starts)


@dataclass(frozen=True)
class _MultiStart:
    """Iterative solver of the pose tasks of one sample time that starts from many initial guesses at once."""

    equations: TaskEquations
    base: Array
    targets: Array
    lower: Array
    upper: Array
    options: IkOptions = IK_OPTIONS

    def solve(self, first: Array, random: int) -> list[IkSolution]:
        """Return the distinct IK solutions to which guesses (K, n) lead, by decreasing quality, or raise Unreachable.

        Unlimited angles that result from the last `random` guesses are wrapped to -pi .. pi.
        """
        lower, upper = self.lower, self.upper
        q, error = self.iterate(first)
        wrap = self._revolute & ~np.isfinite(lower) & ~np.isfinite(upper)
        last = slice(len(first) - random, None)  # solutions from given starts stay near them
        q[last, wrap] = np.remainder(q[last, wrap] + np.pi, 2 * np.pi) - np.pi
        if not (error <= self.options.tolerance).any():
            nearest = int(error.argmin())
            misses = self.equations.misses(self.base, q[nearest], self.targets)
            details: Any = {"lower": lower, "upper": upper, "misses": misses}
            raise unreachable_error(self.equations, q[nearest], float(error[nearest]), **details)
        return self.rank(q, error)

    def list_branches(self, count: int, seed: int) -> tuple[Array, int]:
        """Return IK solutions (K, n) on all branches if a solver exists, and how many random guesses shall be added."""
        branches = ik_branches(self.equations, self.lower, self.upper) if count else None
        if branches is None:
            return np.zeros((0, len(self.lower))), count
        configurations = branches.configurations(self.targets, count, seed * count, turns=False)
        joints = configurations.joints
        if len(joints) > count and not branches.complete:
            joints = joints[spread_points(np.where(self._revolute, np.sin(joints), joints), count)]
        if branches.complete:
            return joints, 0 if configurations.complete[0] and len(joints) else count
        return joints, count - len(joints)

    def iterate(self, joints: Array) -> tuple[Array, Array]:
        """Run Gauss-Newton iterations from configurations (K, n); return final configurations and pose errors (K,)."""
        fixed = ca.DM(self.base), ca.DM(self.targets)
        function = self.equations.pose_residual_function
        options: Any = {"tolerance": self.options.tolerance, "iterations": int(self.options.iterations), "fixed": fixed}
        return gauss_newton(function, joints, self.lower, self.upper, **options)

    def rank(self, joints: Array, errors: Array) -> list[IkSolution]:
        """Return the distinct IK solutions among configurations, sorted by manipulability times limit distance."""
        solved, lower, upper = np.flatnonzero(errors <= self.options.tolerance), self.lower, self.upper
        if not solved.size:
            return []
        joints, size = joints[solved], self.equations.size
        jacobians = np.array(self.equations.jacobian_function.map(len(solved))(joints.T, ca.DM(self.base)))
        values = np.linalg.svd(jacobians.reshape(size, *joints.shape).transpose(1, 0, 2), compute_uv=False)
        with np.errstate(invalid="ignore"):
            share = np.minimum(joints - lower, upper - joints) / ((upper - lower) / 2)
        margin = np.min(share[:, np.isfinite(upper - lower) & (upper > lower)], axis=1, initial=1.0)
        quality = values.prod(axis=1) * np.maximum(margin, 0.0)
        solutions = [IkSolution(*each) for each in zip(joints, quality.tolist(), errors[solved].tolist(), strict=True)]
        solutions.sort(key=lambda solution: -solution.quality)
        return distinct_solutions(solutions, self._revolute, self.options.apart)

    @property
    def _revolute(self) -> NDArray[np.bool_]:
        """Mask of the revolute joints. Shape (n,)."""
        return np.array([joint.kind != "prismatic" for joint in self.equations.machine.robot.moving_joints])


def sample_starts(machine: Machine, lower: Array, upper: Array, count: int, *, near: Any = None, seed: int) -> Array:
    """Return initial guesses: the configurations `near`, then `count` random ones within limits. Shape (K, n)."""
    size, rng = machine.joint_size, np.random.default_rng(seed)
    revolute = np.array([joint.kind != "prismatic" for joint in machine.robot.moving_joints])
    low, high = sampling_range(lower, upper, revolute)
    first = np.zeros((0, size)) if near is None else np.atleast_2d(require.array("near", near))
    if first.ndim != 2 or first.shape[1] != size:
        words = f"near has shape {first.shape}, ({size},) or (k, {size}) of finite numbers expected"
        raise ProblemError(words, name="near", value=first, limit=(size,))
    starts = np.vstack([first, low + (high - low) * rng.random((count, size))])
    if not len(starts):
        raise ProblemError("starts = 0 and near = None leave no start", name="starts", value=0, limit=1)
    return np.asarray(np.clip(starts, lower, upper))


def gauss_newton(
    function: Any,
    starts: Array,
    lower: Array,
    upper: Array,
    *,
    tolerance: float,
    iterations: int,
    fixed: Sequence[Any] = (),
) -> tuple[Array, Array]:
    """Run damped Gauss-Newton iterations from K starts; return joint positions (K, n) and largest residuals (K,).

    `function` of the joint positions and `fixed` returns a residual and its Jacobian; `tolerance` is the largest
    residual of a solution.
    """
    q = starts.copy()
    count, n = q.shape
    mapped = function.map(count)

    def evaluate(at: Array) -> tuple[Array, Array]:
        residual, jacobian = (np.array(part) for part in mapped(at.T, *fixed))
        return residual.T, jacobian.reshape(len(residual), count, n).transpose(1, 0, 2)

    residual, jacobian = evaluate(q)
    cost, damping = (residual**2).sum(axis=1), np.full(count, IK_SETTINGS.first_damping)
    for _ in range(iterations):
        active = (np.abs(residual).max(axis=1) > tolerance / 10) & (damping < IK_SETTINGS.most_damping)
        if not active.any():
            break
        gradient = np.einsum("kij,ki->kj", jacobian, residual)
        at_limit = ((q <= lower) & (gradient > 0)) | ((q >= upper) & (gradient < 0))
        free = np.where(at_limit[:, None, :], 0.0, jacobian)
        normal = np.einsum("kij,kil->kjl", free, free) + damping[:, None, None] * np.eye(n)
        step = -np.linalg.solve(normal, np.where(at_limit, 0.0, gradient)[:, :, None])[:, :, 0]
        trial = np.clip(q + np.clip(step, -1.0, 1.0), lower, upper)
        trial[~active] = q[~active]
        new_residual, new_jacobian = evaluate(trial)
        new_cost = (new_residual**2).sum(axis=1)
        better = active & (new_cost < cost)
        q[better], residual[better], jacobian[better] = trial[better], new_residual[better], new_jacobian[better]
        cost[better] = new_cost[better]
        decreased = np.maximum(IK_SETTINGS.shrinkage * damping, IK_SETTINGS.least_damping)
        damping = np.where(better, decreased, np.where(active, IK_SETTINGS.growth * damping, damping))
    return q, np.abs(residual).max(axis=1)


def distinct_solutions(
    solutions: list[IkSolution], revolute: NDArray[np.bool_], apart: float = IK_OPTIONS.apart
) -> list[IkSolution]:
    """Drop IK solutions whose joints all differ by less than `apart`, modulo full turns, from an earlier solution."""
    distinct: list[IkSolution] = []
    kept = np.zeros((len(solutions), len(revolute)))
    for solution in solutions:
        difference = solution.joints - kept[: len(distinct)]
        difference[:, revolute] = np.remainder(difference[:, revolute] + np.pi, 2 * np.pi) - np.pi
        if np.abs(difference).max(axis=1).min(initial=np.inf) >= apart:
            kept[len(distinct)] = solution.joints
            distinct.append(solution)
    return distinct


def spread_points(points: Array, count: int) -> NDArray[np.intp]:
    """Select `count` of K points, each the farthest from the points selected before; return their indices."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _closest_collisions(
    solutions: list[IkSolution], scene: CollisionScene, base: Array, time: float
) -> list[Collision | None]:
    """Return for each IK solution the closest pair of bodies that violates the clearance, or None."""
    joints = np.array([solution.joints for solution in solutions])
    return worst_collisions(scene, base, joints, np.full(len(joints), time))


def _collision_free(
    solutions: list[IkSolution], collisions: list[Collision | None], scene: CollisionScene, time: float
) -> list[IkSolution]:
    """Return the collision-free IK solutions; raise Unreachable, naming a pair of bodies, if there are none."""
    free = [solution for solution, collision in zip(solutions, collisions, strict=True) if collision is None]
    if free:
        return free
    best = max(range(len(solutions)), key=lambda k: collisions[k].distance if collisions[k] else 0.0)  # type: ignore[union-attr]
    collision = collisions[best]
    assert collision is not None
    raise Unreachable(
        f"each of the {len(solutions)} IK solutions is in collision; closest to collision-free: {collision}",
        solutions[best].joints,
        solutions[best].pose_error,
        name=" and ".join(collision.bodies),
        value=collision.distance,
        limit=scene.clearance,
        time=time,
    )


def unreachable_error(
    equations: TaskEquations,
    joints: Array,
    pose_error: float,
    *,
    lower: Array,
    upper: Array,
    misses: tuple[float, float],
) -> Unreachable:
    """Return the error for targets that are out of reach; `misses` are the position (m) and angle (rad) errors."""
    names = [part.name for part in equations.bound]
    limited = np.flatnonzero((joints <= lower) | (joints >= upper))
    at_limit = [equations.machine.robot.joint_names[k] for k in limited]
    where = f", with {at_limit} at their limits" if at_limit else ""
    distance, angle = misses
    return Unreachable(
        f"no joint positions put {names} where the task wants them: the nearest miss is {describe_miss(*misses)} at "
        f"{np.round(joints, 6).tolist()}{where}; ask for a pose within reach, or leave a row free",
        joints,
        pose_error,
        distance=distance,
        angle=angle,
        name=names[0],
        value=pose_error,
    )


def describe_miss(distance: float, angle: float) -> str:
    """Describe a pose error by its distance, m, and angle, rad; a part that is only rounding error is left out."""
    parts = [(distance, "m"), (angle, "rad")]
    return " and ".join(f"{value:.3g} {unit}" for value, unit in parts if value > 1e-9 * (distance + angle)) or "0 m"
