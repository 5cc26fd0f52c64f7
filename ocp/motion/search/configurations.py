"""Plan requests, their start configurations, local motions by resolved-rate control, and limits of the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.checks import Array
from models.machines.machine import hold_joints
from ocp.errors import ProblemError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.tool_motion import Stretch, stretches_of
from ocp.motion.local.collisions import Collision, worst_collisions
from ocp.motion.local.inverse_kinematics import (
    IkOptions,
    Unreachable,
    describe_miss,
    inverse_kinematics,
    inverse_kinematics_at,
)
from ocp.motion.local.rates import LocalMotion, track_tasks, tracking_weights
from ocp.motion.search.joint_space import all_turns, turning_joints, whole_turns_between, whole_turns_into
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.targets import resolving_times
from ocp.motion.tasks.tip_task import TipTask

SearchKind: TypeAlias = Literal["start", "configurations", "global"]
REACH_TOLERANCE = 1e-4
"""Largest pose error at which a pose counts as reached, m or rad."""


@dataclass(frozen=True)
class PlannerSettings:
    """Settings of `ocp.motion.plan.plan`, derived from theory or from the problem families in tests/sweep.

    Attributes:
        ik_starts: Number of random starts of inverse kinematics.
        local_steps: Least number of time steps of a local motion, besides those that its tasks need.
        dampings: Dampings of local motions, relative to the singular values; the next is tried if no motion tracks.
        min_intervals: Least number of mesh intervals.
        coarse_degree, fine_degree: Degrees of collocation; the fine one represents a smooth segment to rounding.
        separated_intervals: Number of intervals of a coarse mesh with separation constraints.
        coarse_options, fine_options: Options of IPOPT. A coarse solve starts from a guess that satisfies its tasks.
        samples_per_interval: Number of samples in a mesh interval at which collisions and deviations are checked.
        compared_samples: Number of time samples at which two motions are compared.
        same_cost, same_path: Two candidates count as one motion if either difference is smaller: relative; rad or m.
        negligible_rate: Mean squared rate that counts as rounding error of a motion at rest, (rad/s)^2 or (m/s)^2.
        tip_tolerance: Largest deviation of a tip from its task at any time, m and rad.
        max_deviation: Deviation on its last mesh beyond which a motion is rejected without an audit, m and rad.
        max_refinements, max_splits, max_intervals: Largest numbers of mesh refinements for the deviation of the tips,
            of parts into which one refinement splits an interval, and of intervals of the last mesh.
        least_progress: Largest share of the deviation that a refinement may leave if the task may be out of reach.
        max_failures: Number of failed candidates of a batch after which no further one is repaired; also of sorted
            initial guesses that are tried, and of motions that are audited if all are requested.
        refusal_time: Processor time after which no further candidate is tried if those before failed for other reasons
            than collisions, s. A time limit of the caller takes its place.
        batch: Number of initial guesses that are solved before the best is audited, if each takes seconds.
        max_separations: Largest number of solves of one candidate with more, or wider, separation constraints.
        max_cost_ratio: A local motion whose cost exceeds that of the best solve by this factor is not solved.
        gain: Relative cost reduction that a motion must promise to be solved with its start fixed.
    """

    ik_starts: int = 64
    local_steps: int = 64
    dampings: tuple[float, ...] = (0.01, 0.1, 1.0)
    min_intervals: int = 8
    coarse_degree: int = 2
    fine_degree: int = 7
    separated_intervals: int = 24
    coarse_options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 60, "tol": 1e-4, "mu_init": 1e-3})
    fine_options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 150})
    samples_per_interval: int = 16
    compared_samples: int = 33
    same_cost: float = 1e-5
    same_path: float = 0.1
    negligible_rate: float = 1e-12
    tip_tolerance: float = 1e-6
    max_deviation: float = float("inf")
    max_refinements: int = 6
    max_splits: int = 4
    max_intervals: int = 400
    least_progress: float = 0.9
    max_failures: int = 8
    refusal_time: float = 20.0
    batch: int = 4
    max_separations: int = 12
    max_cost_ratio: float = 10.0
    gain: float = 0.01


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """Checked arguments of `ocp.motion.plan.plan`.

    Attributes:
        machine, tasks, horizon: As in `plan`.
        stretches: Intervals of time in which the same tasks are active.
        start: Joint positions at the start, rad or m, or None if they are searched. Shape (n,).
        base: Base configuration at the start. Shape (base_size,).
        near: Joint positions from which the machine moves to the start, or None if these do not matter. Shape (n,).
        weights: Weights of the squared joint rates. Shape (n,).
        limits: Limits of joint positions and rates.
        time_cost: Cost of a second if the horizon is free; else None.
        search: How the start is searched.
        cost: Cost of the motion if more than the squared joint rates and the time are weighted, or less; else None.
        rests: Whether the joints are at rest at the start and at the end, if their accelerations are planned.
        actuator_limits: Limits that include those of the actuators; None if these are not limited.
        clearance_constraints: Clearance constraints of the motion, or None.
        settings: Settings of the planner.
        held: Positions of the joints of `whole` that stay at rest and that `machine` does not have, by name.
        whole: Machine with all its joints; None if no joint is held.
    """

    machine: Machine
    tasks: tuple[TipTask, ...]
    horizon: float
    stretches: tuple[Stretch, ...]
    start: Array | None
    base: Array
    weights: Array
    limits: Limits
    cyclic: bool
    seed: int
    time_cost: float | None
    search: SearchKind = "configurations"
    cost: Cost | None = None
    rests: tuple[bool, bool] = (False, False)
    actuator_limits: Limits | None = None
    clearance_constraints: ClearanceConstraints | None = None
    settings: PlannerSettings = field(default_factory=PlannerSettings)
    held: Mapping[str, float] = field(default_factory=dict)
    whole: Machine | None = None
    near: Array | None = None

    def with_held(self, positions: Mapping[str, float]) -> PlanRequest:
        """Return the request with further joints of the machine held at rest at given positions, rad or m."""
        if not positions:
            return self
        free = np.array([name not in positions for name in self.machine.robot.joint_names])
        machine, constraints = hold_joints(self.machine, positions), self.clearance_constraints
        if constraints is not None:
            scene = constraints.scene.with_locked(machine)
            constraints = ClearanceConstraints(scene) if len(scene.pairs) else None
        return replace(
            self,
            machine=machine,
            stretches=stretches_of(machine, self.tasks, self.horizon),
            start=None if self.start is None else self.start[free],
            near=None if self.near is None else self.near[free],
            weights=self.weights[free],
            cost=None if self.cost is None else self.cost.of_joints(free),
            limits=self.limits.of_joints(free),
            actuator_limits=None if self.actuator_limits is None else self.actuator_limits.of_joints(free),
            clearance_constraints=constraints,
            held={**self.held, **positions},
            whole=self.whole or self.machine,
        )

    @property
    def ik_arguments(self) -> dict[str, Any]:
        """Keyword arguments with which `inverse_kinematics` searches for start configurations of the motion."""
        own = IkOptions(base=self.base, limits=self.limits.joints)
        return {"seed": self.seed, "starts": self.settings.ik_starts, "options": own}

    @property
    def redundancy(self) -> int:
        """Largest number of degrees of freedom that the tasks leave undetermined at any time with an active task."""
        sizes = [stretch.equations.size for stretch in self.stretches if stretch.equations is not None]
        return self.machine.joint_size - min(sizes, default=0)

    @cached_property
    def bounds(self) -> JointBounds:
        """Position and rate limits of the machine's joints as arrays."""
        return self.limits.bounds(self.machine)

    @cached_property
    def turning_joints(self) -> NDArray[np.intp]:
        """Indices of the joints whose start angle may be changed by full turns; empty if the start is given."""
        if self.start is not None:
            return np.zeros(0, dtype=np.intp)
        return turning_joints(self.machine.robot, self.bounds.lower, self.bounds.upper)


def start_configurations(request: PlanRequest) -> Array:
    """Return start configurations (K, n), collision-free ones first, then by manipulability and limit distance."""
    if request.start is not None:
        return request.start[None]
    first = [request.tasks[i] for i in request.stretches[0].tasks if request.tasks[i].is_pose]
    if not first:
        words = "start is missing: no task gives the tip's pose at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    try:
        solutions = inverse_kinematics(request.machine, first, **request.ik_arguments)
    except Unreachable as error:
        raise locate_error(request, error, 0.0) from error
    joints = np.array([solution.joints for solution in solutions])
    colliding = [collision is not None for collision in start_collisions(request, joints)]
    return joints[np.argsort(colliding, kind="stable")]


def start_collisions(
    request: PlanRequest, configurations: Array, pairs: list[int] | None = None
) -> list[Collision | None]:
    """Return for each start configuration (K, n) the closest pair of bodies, or None if the clearance is kept.

    If given, `pairs` are the indices of the only pairs that are checked.
    """
    if request.clearance_constraints is None or pairs == []:
        return [None] * len(configurations)
    scene, times = request.clearance_constraints.scene, np.zeros(len(configurations))
    return worst_collisions(scene, request.base, configurations, times, pairs=pairs)


def check_clear_start(request: PlanRequest, configurations: Array) -> None:
    """Raise ProblemError if the given start configuration is in collision."""
    if (collision := start_collisions(request, configurations)[0]) is not None:
        assert request.clearance_constraints is not None
        scene, name = request.clearance_constraints.scene, " and ".join(collision.bodies)
        ignored = [scene.pair_names(collision.pair)]
        words = f"start: {collision}; give a collision-free start, or ignore this pair of bodies: {ignored=}"
        alternatives = count_clear_configurations(request, collision.time)
        words = "; ".join([words, *describe_alternatives(alternatives)])
        raise ProblemError(words, name=name, value=collision.distance, limit=scene.clearance, time=collision.time)


def count_clear_configurations(request: PlanRequest, time: float) -> int | Unreachable | None:
    """Count the collision-free configurations that satisfy the tasks at a time, s; return an error if there are none.

    The result is None if it would prove nothing: no task prescribes a pose at this time, or the base can move.
    """
    tasks = [task for task in request.tasks if task.is_pose and task.begin <= time <= task.end]
    if request.clearance_constraints is None or not tasks or request.machine.base_size:
        return None
    scene, own = request.clearance_constraints.scene, IkOptions(limits=request.limits.joints)
    try:
        return len(inverse_kinematics(request.machine, tasks, time=time, seed=request.seed, scene=scene, options=own))
    except Unreachable as error:
        return error


def describe_alternatives(count: int | Unreachable | None) -> list[str]:
    """Return a list with one text about the number of collision-free configurations; empty if `count` is None."""
    if count is None:
        return []
    if isinstance(count, Unreachable):
        return [f"no other configuration is collision-free then: {count}"]
    plural = "s are" if count > 1 else " is"
    return [f"{count} other configuration{plural} collision-free then, but no motion found passes through them"]


def local_motions_from(request: PlanRequest, configurations: Array) -> list[LocalMotion]:
    """Track the tasks from start configurations (K, n) by resolved-rate control; return a result per time interval.

    Starts that differ by full turns lead to the same motion. Joints that can make a full turn within their limits are
    therefore tracked without limits, and the motion is shifted to mid-range. If it satisfies the tasks, but exceeds the
    limits in every turn, it is tracked within the limits from all turns: there may be more than K motions.

    Raises:
        Unreachable: No joint positions within the limits reach a pose.
    """
    turning, lower, upper = request.turning_joints, request.bounds.lower.copy(), request.bounds.upper.copy()
    lower[turning], upper[turning] = -np.inf, np.inf
    motions = _track_within(request, configurations, lower, upper)
    motions = _within_limits(request, configurations, motions) if turning.size else motions
    if largest_pose_errors(motions).min() > REACH_TOLERANCE:
        _check_reach(request, motions)
    return motions


def _track_within(request: PlanRequest, configurations: Array, lower: Array, upper: Array) -> list[LocalMotion]:
    """Track the tasks by resolved-rate control within limits, with the least damping at which a motion succeeds."""
    settings, least_damped = request.settings, list[LocalMotion]()
    all_weights = tracking_weights(request.machine, request.base, configurations[0], request.weights)
    for weights, damping in product(all_weights, settings.dampings):
        motions: list[LocalMotion] = []
        base, joints = np.tile(request.base, (len(configurations), 1)), configurations
        for stretch in request.stretches:
            if stretch.begin > 0:
                joints = _joints_at_new_poses(request, stretch, base, joints, lower, upper)
                if request.stretches[len(motions) - 1].equations is None:
                    motions[-1] = motions[-1].straight_to(joints)
            steps = max(int(np.ceil(settings.local_steps * stretch.duration / request.horizon)), settings.min_intervals)
            times = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.nodes)
            if (equations := stretch.equations) is None:
                motions.append(LocalMotion.stationary(times, base, joints))
            else:
                options: dict[str, Any] = {"weights": weights, "damping": damping}
                times = resolving_times(equations, times)
                tracked = track_tasks(equations, joints, base, times, lower=lower, upper=upper, **options)
                motions.append(tracked.with_cost(request.weights))
            base, joints = motions[-1].base[:, -1], motions[-1].joints[:, -1]
        if largest_pose_errors(motions).min() <= REACH_TOLERANCE:
            return motions
        least_damped = least_damped or motions
    return least_damped


def _within_limits(request: PlanRequest, configurations: Array, motions: Sequence[LocalMotion]) -> list[LocalMotion]:
    """Shift motions by full turns into the joint limits; track a motion anew within limits if no shift suffices."""
    turning, bounds = request.turning_joints, request.bounds
    limits = bounds.lower[turning], bounds.upper[turning]
    joints = np.concatenate([motion.joints for motion in motions], axis=1)[:, :, turning]
    shifts, fits = whole_turns_into(joints, *limits)
    tracked, inside = largest_pose_errors(motions) <= REACH_TOLERANCE, fits.all(axis=1)
    shifted = [motion.take(inside) for motion in motions]
    for motion in shifted:
        motion.joints[:, :, turning] += shifts[inside, None]
    if inside.all():
        return shifted
    starts = [configurations[~inside & ~tracked]]
    for row in np.flatnonzero(~inside & tracked):
        start = configurations[row, turning]
        turned = all_turns(start, np.where(fits[row], start + shifts[row], np.nan), *limits)
        starts.append(np.tile(configurations[row], (len(turned), 1)))
        starts[-1][:, turning] = turned
    others = _track_within(request, np.concatenate(starts), bounds.lower, bounds.upper)
    return [LocalMotion.joined(pair) for pair in zip(shifted, others, strict=True)]


def _joints_at_new_poses(
    request: PlanRequest, stretch: Stretch, base: Array, joints: Array, lower: Array, upper: Array
) -> Array:
    """Return the configurations nearest to `joints` (K, n) that satisfy the tasks of two adjoining time intervals."""
    before = request.stretches[request.stretches.index(stretch) - 1]
    if not any(request.tasks[i].is_pose and new for i, new in zip(stretch.tasks, stretch.new, strict=True)):
        return joints
    tasks = [request.tasks[i] for i in sorted({*before.tasks, *stretch.tasks})]
    own = {"near": joints, "options": IkOptions(base=base[0], limits=request.limits.joints)}
    try:
        solutions = inverse_kinematics(request.machine, tasks, time=stretch.begin, **{**request.ik_arguments, **own})
    except Unreachable as error:
        if request.machine.base_size:  # the base may bring the pose into reach
            return joints
        raise locate_error(request, error, stretch.begin) from error
    turning, candidates = request.turning_joints, [solution.joints for solution in solutions]
    turned = np.tile(candidates, (len(joints), 1, 1))
    turned[:, :, turning] += whole_turns_between(turned, joints[:, None], lower, upper)[:, :, turning]
    distances = (request.weights * (joints[:, None] - turned) ** 2).sum(axis=2)
    return np.asarray(turned[np.arange(len(joints)), distances.argmin(axis=1)])


def largest_pose_errors(motions: Sequence[LocalMotion]) -> Array:
    """Return the largest pose error of each of K motions over the whole horizon, m or rad. Shape (K,)."""
    return np.asarray(np.max([motion.pose_error for motion in motions], axis=0))


def lowest_cost_motion(motions: Sequence[LocalMotion]) -> tuple[int, float]:
    """Return the index and the cost of the lowest-cost one of K motions among those that reach all poses.

    If none of them does, it is the lowest-cost one of all, and the returned cost is inf.
    """
    costs, tracked = (
        np.sum([motion.cost for motion in motions], axis=0),
        largest_pose_errors(motions) <= REACH_TOLERANCE,
    )
    best = int(np.where(tracked | ~tracked.any(), costs, np.inf).argmin())
    return best, float(costs[best]) if tracked[best] else np.inf


def _check_reach(request: PlanRequest, motions: list[LocalMotion]) -> None:
    """Raise Unreachable if a fixed-base machine cannot reach one of the poses that resolved-rate control missed."""
    if request.machine.base_size:
        return
    limits, starts, seed = request.limits.joints, request.settings.ik_starts, request.seed
    for stretch, motion in zip(request.stretches, motions, strict=True):
        tasks, interval = [request.tasks[i] for i in stretch.tasks], (stretch.begin, stretch.end)
        poses = [task for task in tasks if task.is_pose and task.start_gap <= REACH_TOLERANCE]
        for time in np.unique(motion.worst_time[motion.pose_error > REACH_TOLERANCE]).tolist() if poses else ():
            error = end_of_reach(request.machine, poses, interval, time, limits=limits, starts=starts, seed=seed)
            if error is not None:
                assert error.time is not None
                raise locate_error(request, error, error.time)


def locate_error(request: PlanRequest, error: Unreachable, time: float) -> Unreachable:
    """Return an error whose message also states a time, s, and the positions that the tasks require at this time."""
    places = []
    for number, task in enumerate(request.tasks):
        if task.position is not None and task.begin <= time <= task.end:
            targets = np.array(bind(request.machine, task).target_function()(time)).ravel()
            places.append(f"task {number} is at {np.round(targets[:3], 6).tolist()} m")
    where = f" ({', '.join(places)})" if places else ""
    return Unreachable(f"at {time:.4g} s{where}: {error}", **{**vars(error), "time": time})


REACH_INTERVALS, REACH_BISECTIONS = 32, 24
"""Numbers of intervals at whose ends the reach of tasks is evaluated, and of bisections of the interval of its end."""
END_TOLERANCE = 1e-6
"""Pose error up to which a pose is within reach, m or rad: below the repeatability of arms."""
CONTINUED_SOLUTIONS = 16
"""Number of solutions that are starts of inverse kinematics at the next time, before random starts."""


@dataclass
class _Reach:
    """Inverse kinematics of tasks at successive times, each started from the solutions at the time before."""

    equations: TaskEquations
    options: dict[str, Any]
    solutions: Array

    def __post_init__(self) -> None:
        self._targets = self.equations.target_function()

    def unreachable_at(self, time: float, limits: bool) -> Unreachable | None:
        """Solve inverse kinematics at a time and store the solutions; return an error if there is no solution."""
        targets = np.array(self._targets(time)).ravel()
        options = {**self.options, "options": IkOptions(limits=limits, tolerance=END_TOLERANCE)}
        for starts in (0, self.options["starts"]):
            if not starts and not len(self.solutions):
                continue
            try:
                options["starts"] = starts
                solved = inverse_kinematics_at(self.equations, targets, near=self.solutions, **options)
            except Unreachable as error:
                unreachable = error
            else:
                self.solutions = np.array([solution.joints for solution in solved[:CONTINUED_SOLUTIONS]])
                return None
        return unreachable


def end_of_reach(
    machine: Machine,
    tasks: Sequence[TipTask],
    interval: tuple[float, float],
    failed: float,
    *,
    limits: bool,
    starts: int,
    seed: int,
) -> Unreachable | None:
    """Return an error that says when and why the tasks leave the workspace of a machine on a fixed base.

    The end is the first time at which the tasks have no solution within the joint limits. A joint ends the reach if it
    is at its limit there and the pose would be within reach without limits. Otherwise the tasks' Jacobian is singular.

    Args:
        machine: The machine.
        tasks: Its pose tasks during the interval.
        interval: Begin and end of the stretch of time, s.
        failed: Time at which no solution was found, s.
        limits, starts, seed: As in `inverse_kinematics`.

    Returns:
        The error with the fields time (the end), name (the joint, or the frame), value, limit, distance and angle (the
        nearest miss at the next of the evaluated times). None if the pose at `failed` is within reach after all.
    """
    begin, end = interval
    reach = _Reach(bind(machine, tasks), {"starts": starts, "seed": seed}, np.zeros((0, machine.joint_size)))
    grid = np.linspace(begin, end, REACH_INTERVALS + 1)
    within = begin
    for beyond in (*grid[grid < failed].tolist(), failed):
        if (miss := reach.unreachable_at(beyond, limits)) is not None:
            break
        within = beyond
    else:
        return None
    first, nearest = beyond, miss
    for _ in range(REACH_BISECTIONS if beyond > within else 0):
        middle = (within + beyond) / 2
        if (error := reach.unreachable_at(middle, limits)) is None:
            within = middle
        else:
            beyond, nearest = middle, error
    for time in grid[grid > within][:1].tolist():
        if (error := reach.unreachable_at(time, limits)) is not None:
            first, miss = time, error
    details: dict[str, Any] = {"name": miss.name, "value": miss.pose_error}
    cause = f"no joint limit ends it, the arm is singular there with joints {np.round(nearest.joints, 6).tolist()}"
    free = _Reach(reach.equations, reach.options, np.vstack([reach.solutions, nearest.joints]))
    if limits and free.unreachable_at(within + (first - within) / REACH_INTERVALS, limits=False) is None:
        cause, joint = _joint_at_limit(machine, nearest.joints)
        details |= joint
    words = f"the reach ends, {cause}; at {first:.4g} s the nearest miss is {describe_miss(miss.distance, miss.angle)}"
    words += "; ask for poses within reach or leave a row free"
    details |= {"distance": miss.distance, "angle": miss.angle, "time": within}
    return Unreachable(words, nearest.joints, miss.pose_error, **details)


def _joint_at_limit(machine: Machine, joints: Array) -> tuple[str, dict[str, Any]]:
    """Return text and fields of an error about the joint that is nearest to its limit and so limits the reach."""
    moving = machine.robot.moving_joints
    limits = [min(joint.lower, joint.upper, key=lambda x: abs(x - q)) for joint, q in zip(moving, joints, strict=True)]
    nearest = int(np.abs(joints - limits).argmin())
    joint, unit = moving[nearest], "m" if moving[nearest].kind == "prismatic" else "rad"
    fields = {"name": joint.name, "value": float(joints[nearest]), "limit": float(limits[nearest])}
    return f"{joint.name!r} is at its limit {limits[nearest]:.5g} {unit}", fields
