"""Joint positions for a pose: multi-start inverse kinematics under joint limits, and where a task leaves the reach.

Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) from many starts at once, on bounds by projection: joints at a
limit that a step would leave are held for that step. All starts share one mapped casadi function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import CollisionScene, Machine
from models.arrays import Array
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, checked_count, checked_flag, checked_positive, floats, real
from ocp.motion.local.collisions import Collision, checked_collision_scene, find_collisions, slide_apart
from ocp.motion.tasks.checks import checked_configuration
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.geometry import pose_in_reference
from ocp.motion.tasks.tip_task import ANGULAR, TipTask

__all__ = ["IkSolution", "Unreachable", "inverse_kinematics", "inverse_kinematics_at"]

LARGEST_SEED = 2**64


@dataclass(frozen=True)
class InverseSettings:
    """How postures are looked for: Levenberg-Marquardt steps from many starts.

    Attributes:
        tolerance: Largest misfit of a posture, m and rad.
        apart: Postures nearer to each other are one, m and rad.
        iterations: Of each start.
        slide_spread: m: of the starts of slides without limits.
        first_damping: Of the first step.
        least_damping: Below which it does not fall.
        most_damping: At which a start is given up.
        growth: Of the damping after a step that fails.
        shrinkage: Of the damping after a step that succeeds.
        reach_tolerance: A pose missed by less, m or rad, is not called out of reach.
        slid: Postures that touch least, slid along their self-motions where all of them touch.
        simpson_steps: Over which a velocity is summed up to a position.
    """

    tolerance: float = 1e-10
    apart: float = 1e-3
    iterations: int = 100
    slide_spread: float = 1.0
    first_damping: float = 1e-2
    least_damping: float = 1e-12
    most_damping: float = 1e8
    growth: float = 4.0
    shrinkage: float = 0.25
    reach_tolerance: float = 1e-4
    slide_count: int = 8
    simpson_steps: int = 400


INVERSE = InverseSettings()

"""Instants of the horizon at which a task's poses are looked for, the start among them."""


@dataclass(frozen=True)
class IkSolution:
    """Joint positions that put the tip where it is wanted.

    Attributes:
        joints: Shape (joint_size,), rad or m.
        quality: Manipulability of the task times the least distance of a joint from its limits, the latter as a share
            of half its range: 0 at a limit or where the task is singular.
        pose_error: Distance that is left, m or rad, the greatest of all tasks.
    """

    joints: Array
    quality: float
    pose_error: float


class Unreachable(ProblemError):
    """No joint positions were found for a pose.

    Attributes:
        joints: The nearest miss. Shape (joint_size,).
        pose_error: How far it is off, m or rad (2 sin(angle / 2)).
    """

    def __init__(self, message: str, joints: Array, misfit: float, **details: Any) -> None:
        super().__init__(message, **details)
        self.joints = joints
        self.pose_error = misfit

    def __reduce__(self) -> Any:
        """Pickled with what it is made from, and with its fields."""
        return type(self), (*self.args, self.joints, self.pose_error), self.__dict__


@interruptible
def inverse_kinematics(
    machine: Machine,
    task: TipTask | Sequence[TipTask],
    *,
    time: float = 0.0,
    base: Any = None,
    starts: int = 64,
    near: Any = None,
    seed: int = 0,
    limits: bool = True,
    tolerance: float = INVERSE.tolerance,
    apart: float = INVERSE.apart,
    iterations: int = INVERSE.iterations,
    scene: CollisionScene | None = None,
) -> list[IkSolution]:
    """Different joint positions at which the machine is where its pose tasks want it, the best first.

    Where the joints are more than the rows, solutions form families, of which each start gives one member.

    Args:
        machine: Any machine; a floating base stands at `base` meanwhile.
        task: A TipTask with a pose, or several that hold at once; tasks of velocities are left out.
        time: At which the tasks are taken, s.
        base: Base configuration, shape (base_size,); the machine's base_home() if None.
        starts: How many random starts, uniform between the limits, -pi .. pi where there are none.
        near: Further starts, before the random ones. Shape (joint_size,) or (k, joint_size).
        seed: Of the random starts.
        limits: Whether the robot's position limits hold.
        tolerance: Largest misfit of a solution, m and rad.
        apart: Least distance between two solutions, in the greatest joint, angles modulo full turns.
        iterations: Of each start, at most.
        scene: Of the machine; postures in which its bodies come nearer to each other or to obstacles than the
            clearance are left out. Where that leaves none, those that touch least are slid along their self-motions.

    Returns:
        The solutions, at least one, by falling quality.

    Raises:
        Unreachable: No start leads to the pose, with the nearest miss; or none to a posture that is clear, with the
            pair that touches least.
        ProblemError: No pose among the tasks, no joint, wrong sizes or numbers.
    """
    equations = bind(machine, task)
    if not machine.joint_size:
        words = "inverse_kinematics: the robot has no moving joint, and stands where its base is"
        raise ProblemError(words, name="machine", value=machine)
    posed = tuple(part for part in equations.bound if part.task.is_pose)
    if not posed:
        words = "inverse kinematics need a pose: task=TipTask(position=..., orientation=... or direction=...)"
        raise ProblemError(words, name="task")
    equations = TaskEquations(machine, posed)
    for what, number in (("starts", starts), ("iterations", iterations)):
        checked_count(what, number, least=int(what == "iterations"))
    for what, value in (("tolerance", tolerance), ("apart", apart)):
        checked_positive(what, value)
    checked_count("seed", seed, 0, LARGEST_SEED)
    checked_flag("limits", limits)
    if scene is not None:
        checked_collision_scene(scene, machine, limits)
    if not np.isfinite(real(time)):
        raise ProblemError(f"time must be a finite number of seconds, not {time!r}", name="time", value=time)
    size = machine.joint_size
    place = checked_configuration(machine, np.zeros(size), base)[1]
    unbounded = np.full(size, np.inf)
    lower, upper = (machine.robot.lower, machine.robot.upper) if limits else (-unbounded, unbounded)
    first = start_configurations(machine, lower, upper, int(starts), near, seed)
    targets = np.array(equations.target_function()(float(time))).ravel()
    if not np.isfinite(targets).all():
        words = f"the task's targets are not finite at {time:g} s"
        raise ProblemError(words, name="task", value=targets, time=float(time))

    search = _Search(equations, place, targets, lower, upper, tolerance, apart, int(iterations))
    distinct_solutions = search.postures(first, int(starts))
    if scene is None:
        return distinct_solutions
    nearest = _touching(distinct_solutions, scene, place, float(time))
    if all(nearest) and equations.size < size:
        order = sorted(range(len(distinct_solutions)), key=lambda k: -nearest[k].distance)  # type: ignore[union-attr]
        least = np.array([distinct_solutions[k].joints for k in order[: INVERSE.slide_count]])
        moved = slide_apart(
            scene,
            place,
            least,
            float(time),
            jacobian=lambda joints: np.array(equations.jacobian_function(joints, place)),
            back=lambda joints: search.back(joints)[0],
            lower=lower,
            upper=upper,
        )
        distinct_solutions += search.rated(*search.back(moved))
        nearest = _touching(distinct_solutions, scene, place, float(time))
    return _clear(distinct_solutions, nearest, scene, float(time))


def inverse_kinematics_at(
    equations: TaskEquations, targets: Array, *, starts: int, seed: int, limits: bool
) -> list[IkSolution]:
    """As `inverse_kinematics` on a fixed base, of poses whose targets are known; again and again at little cost.

    Raises:
        Unreachable: As there.
    """
    machine, unbounded = equations.machine, np.full(equations.machine.joint_size, np.inf)
    lower, upper = (machine.robot.lower, machine.robot.upper) if limits else (-unbounded, unbounded)
    first = start_configurations(machine, lower, upper, starts, None, seed)
    return _Search(equations, np.zeros(0), targets, lower, upper).postures(first, starts)


@dataclass(frozen=True)
class _Search:
    """For postures that do tasks at one time; arguments as of `inverse_kinematics`."""

    equations: TaskEquations
    base: Array
    targets: Array
    lower: Array
    upper: Array
    tolerance: float = INVERSE.tolerance
    apart: float = INVERSE.apart
    iterations: int = INVERSE.iterations

    def postures(self, first: Array, random: int) -> list[IkSolution]:
        """Those that starts (K, n) lead to, the best first; of the last `random` ones angles without limits come round.

        Raises:
            Unreachable: There is none.
        """
        lower, upper = self.lower, self.upper
        q, misfit = self.back(first)
        wrap = self._turns & ~np.isfinite(lower) & ~np.isfinite(upper)
        last = slice(len(first) - random, None)  # what is near a given start stays there
        q[last, wrap] = np.remainder(q[last, wrap] + np.pi, 2 * np.pi) - np.pi
        if not (misfit <= self.tolerance).any():
            nearest = int(misfit.argmin())
            raise unreachable_error(
                self.equations.machine, self.equations, q[nearest], float(misfit[nearest]), lower, upper
            )
        return self.rated(q, misfit)

    def back(self, joints: Array) -> tuple[Array, Array]:
        """Joints (K, n) and greatest misfits (K,) that others lead to."""
        told = ca.DM(self.base), ca.DM(self.targets)
        function = self.equations.pose_residual_function
        return gauss_newton(function, joints, self.lower, self.upper, self.tolerance, self.iterations, told)

    def rated(self, joints: Array, misfits: Array) -> list[IkSolution]:
        """Those that do the task, the best first, each once."""
        good, lower, upper = np.flatnonzero(misfits <= self.tolerance), self.lower, self.upper
        if not good.size:
            return []
        joints, size = joints[good], self.equations.size
        slopes = np.array(self.equations.jacobian_function.map(len(good))(joints.T, ca.DM(self.base)))
        values = np.linalg.svd(slopes.reshape(size, *joints.shape).transpose(1, 0, 2), compute_uv=False)
        with np.errstate(invalid="ignore"):
            share = np.minimum(joints - lower, upper - joints) / ((upper - lower) / 2)
        margin = np.min(share[:, np.isfinite(upper - lower) & (upper > lower)], axis=1, initial=1.0)
        quality = values.prod(axis=1) * np.maximum(margin, 0.0)
        found = [IkSolution(*each) for each in zip(joints, quality.tolist(), misfits[good].tolist(), strict=True)]
        return distinct_solutions(sorted(found, key=lambda posture: -posture.quality), self._turns, self.apart)

    @property
    def _turns(self) -> NDArray[np.bool_]:
        """Which joints turn. Shape (n,)."""
        return np.array([joint.kind != "prismatic" for joint in self.equations.machine.robot.moving_joints])


def equivalent_pose(machine: Machine, task: TipTask, start: Array, time: float, base: Any = ()) -> TipTask | None:
    """The pose that a task has come to at a time; None where that depends on the way, or has a gap to close.

    Args:
        start, base: Joints and base at the start.
        time: s, from when the task begins.
    """
    if task.is_pose:
        return task if task.start_gap <= INVERSE.reach_tolerance else None
    rows = [row for row in task.chosen if row not in ANGULAR]
    if not rows or task.axes not in ("world", "reference") or (task.axes == "world") != (task.relative_to is None):
        return None
    equations = bind(machine, task)
    times = np.linspace(0.0, time, INVERSE.simpson_steps + 1)
    values = np.array(equations.target_function().map(len(times))(times[None, :]))
    weights = np.ones(INVERSE.simpson_steps + 1)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    moved = np.zeros(3)
    wanted = values[[task.chosen.index(row) for row in rows]]
    moved[[row - 3 for row in rows]] = wanted @ weights * time / INVERSE.simpson_steps / 3
    first, _ = pose_in_reference(equations.bound[0], ca.DM(base), ca.DM(start))
    return replace(task, velocity=None, rows=rows, position=np.array(ca.DM(first)).ravel() + moved)


def start_configurations(machine: Machine, lower: Array, upper: Array, count: int, near: Any, seed: int) -> Array:
    size, rng = machine.joint_size, np.random.default_rng(seed)
    slides = np.array([joint.kind == "prismatic" for joint in machine.robot.moving_joints])
    span = np.where(slides, INVERSE.slide_spread, np.pi)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2 * span, -span))
    high = np.where(np.isfinite(upper), upper, np.where(np.isfinite(lower), lower + 2 * span, span))
    try:
        given = np.zeros((0, size)) if near is None else np.atleast_2d(floats(near))
    except NOT_NUMBERS as error:
        raise ProblemError(f"near {near!r} is not numeric", name="near", value=near, limit=(size,)) from error
    if given.ndim != 2 or given.shape[1] != size or not np.isfinite(given).all():
        words = f"near has shape {given.shape}, ({size},) or (k, {size}) of finite numbers expected"
        raise ProblemError(words, name="near", value=given, limit=(size,))
    both = np.vstack([given, low + (high - low) * rng.random((count, size))])
    if not len(both):
        raise ProblemError("starts = 0 and near = None leave no start", name="starts", value=0, limit=1)
    return np.asarray(np.clip(both, lower, upper))


def idle_positions(lower: Array, upper: Array) -> Array:
    """Where joints stand of which nothing is asked: in the middle of their limits, else within them next to 0."""
    with np.errstate(invalid="ignore"):
        middle = (lower + upper) / 2
    return np.asarray(np.where(np.isfinite(middle), middle, np.clip(0.0, lower, upper)))


def gauss_newton(
    function: Any, first: Array, lower: Array, upper: Array, tolerance: float, iterations: int, told: Sequence[Any] = ()
) -> tuple[Array, Array]:
    """Joints (K, n) and greatest misfits (K,) that the starts lead to.

    Args:
        function: Casadi Function of the joints, and what else is `told` of all, -> (misfit, its Jacobian).
    """
    q = first.copy()
    count, n = q.shape
    mapped = function.map(count)

    def evaluate(at: Array) -> tuple[Array, Array]:
        residual, jacobian = (np.array(part) for part in mapped(at.T, *told))
        rows = len(residual)
        return residual.T, jacobian.reshape(rows, count, n).transpose(1, 0, 2)

    residual, jacobian = evaluate(q)
    cost, damping = (residual**2).sum(axis=1), np.full(count, INVERSE.first_damping)
    for _ in range(iterations):
        busy = (np.abs(residual).max(axis=1) > tolerance / 10) & (damping < INVERSE.most_damping)
        if not busy.any():
            break
        gradient = np.einsum("kij,ki->kj", jacobian, residual)
        held = ((q <= lower) & (gradient > 0)) | ((q >= upper) & (gradient < 0))
        free = np.where(held[:, None, :], 0.0, jacobian)
        normal = np.einsum("kij,kil->kjl", free, free) + damping[:, None, None] * np.eye(n)
        step = -np.linalg.solve(normal, np.where(held, 0.0, gradient)[:, :, None])[:, :, 0]
        trial = np.clip(q + np.clip(step, -1.0, 1.0), lower, upper)
        trial[~busy] = q[~busy]
        new_residual, new_jacobian = evaluate(trial)
        new_cost = (new_residual**2).sum(axis=1)
        better = busy & (new_cost < cost)
        q[better], residual[better], jacobian[better] = trial[better], new_residual[better], new_jacobian[better]
        cost[better] = new_cost[better]
        less, more = np.maximum(INVERSE.shrinkage * damping, INVERSE.least_damping), INVERSE.growth * damping
        damping = np.where(better, less, np.where(busy, more, damping))
    return q, np.abs(residual).max(axis=1)


def distinct_solutions(
    found: list[IkSolution], turns: NDArray[np.bool_], apart: float = INVERSE.apart
) -> list[IkSolution]:
    """Of those nearer than `apart`, full turns not counted, the best."""
    kept: list[IkSolution] = []
    for posture in found:
        for other in kept:
            difference = posture.joints - other.joints
            difference[turns] = np.remainder(difference[turns] + np.pi, 2 * np.pi) - np.pi
            if np.abs(difference).max() < apart:
                break
        else:
            kept.append(posture)
    return kept


def _touching(found: list[IkSolution], scene: CollisionScene, base: Array, time: float) -> list[Collision | None]:
    """Of each posture the pair that is nearest, where it comes nearer than the clearance."""
    touching = [find_collisions(scene, base[None], posture.joints[None], np.array([time])) for posture in found]
    return [each[0] if each else None for each in touching]


def _clear(
    found: list[IkSolution], nearest: list[Collision | None], scene: CollisionScene, time: float
) -> list[IkSolution]:
    """The postures in which nothing comes nearer than the clearance.

    Raises:
        Unreachable: There are none.
    """
    collision_free = [posture for posture, touch in zip(found, nearest, strict=True) if touch is None]
    if collision_free:
        return collision_free
    best = max(range(len(found)), key=lambda k: nearest[k].distance if nearest[k] else 0.0)  # type: ignore[union-attr]
    touch = nearest[best]
    assert touch is not None
    raise Unreachable(
        f"each of the {len(found)} postures found touches; the one that does least: {touch}",
        found[best].joints,
        found[best].pose_error,
        name=" and ".join(touch.bodies),
        value=touch.distance,
        limit=scene.clearance,
        time=time,
    )


def unreachable_error(
    machine: Machine, equations: TaskEquations, joints: Array, misfit: float, lower: Array, upper: Array
) -> Unreachable:
    names = [part.task.link or part.tip.robot.tip_link for part in equations.bound]
    stopped = np.flatnonzero((joints <= lower) | (joints >= upper))
    at_limit = [machine.robot.joint_names[k] for k in stopped]
    where = f", with {at_limit} at their limits" if at_limit else ""
    return Unreachable(
        f"no joint positions put {names} where the task wants them: the nearest miss is {misfit:.3g} (m or rad) at "
        f"{np.round(joints, 6).tolist()}{where}; ask for a pose within reach, leave a row free, or raise starts",
        joints,
        misfit,
        name=names[0],
        value=misfit,
    )
