"""Global search over all motions that perform the tasks: choice of the time samples, and lower cost bounds."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any
from warnings import warn

import numpy as np
import scipy
from numpy.typing import NDArray

from models import FixedBase, Machine, Sphere
from models.checks import Array
from models.shapes.bodies import RigidParts, lever_arms
from ocp.console import TimeLimitReached
from ocp.errors import BoundWarning, ProblemError
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.configurations import PlanRequest, local_motions_from, locate_error, lowest_cost_motion
from ocp.motion.search.dead_end import DeadEnd, dead_end
from ocp.motion.search.joint_space import FULL_TURN, TOLERANCE, JointSpace
from ocp.motion.search.lengths import Homogeneous
from ocp.motion.search.reconfigurations import fewest_segments, segment_ends
from ocp.motion.search.search import MAX_FREE_DIRECTIONS, AtlasSearch, SearchSettings
from ocp.motion.search.shortening import PathPoses, PathProblem
from ocp.motion.search.steps import SquaredRates, StepCost, Steps
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.targets import targets_along
from ocp.motion.tasks.tip_task import ANGULAR, TipTask
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True)
class SampleSettings:
    """Settings for the choice of the time samples of a global search.

    Attributes:
        lost: Share of the cost that straight steps between the samples may lose, by the dimension of the manifold. On
            surfaces, each sample is expensive: a third of the loss took half as long again.
        steps: Least number of steps over the motion.
        closest: Least distance between samples, as a share of the horizon.
        near_speed_limit: Share of its velocity limit from which on a joint is nearly at it, so that samples are added.
        near_position_limit: The same for position limits: distance to the limit, rad or m.
        subdivisions: Parts into which a step is divided where a segment ends and one segment fewer might do.
        motion_steps: Number of time steps of the returned motions, besides the breaks of the tasks.
    """

    lost: tuple[float, float, float] = (0.0033, 0.0033, 0.045)
    steps: int = 4
    closest: float = 1e-3
    near_speed_limit: float = 0.9
    near_position_limit: float = 1e-3
    subdivisions: int = 4
    motion_steps: int = 64


TOO_MANY_CHARTS = "configurations"
"""Value of the field `name` in the error of a search that needs too many charts of the self-motion manifold."""
LARGER_CHARTS = (1.0, 2.0, 4.0)
"""Factors by which charts are enlarged if there are too many of them."""


class TaskSearch:
    """Global search for motions that perform the tasks of a plan request.

    Attributes:
        request: The request.
        bound: Lower bound of the cost of any motion; inf if there is none.
        times: Times of the samples, s.

    Raises:
        ProblemError: A moving base, a task that is no pose, or too many redundant degrees of freedom.
        Unreachable: At some sample no configuration does the tasks.
    """

    def __init__(
        self, request: PlanRequest, motions: list[LocalMotion], settings: SampleSettings = SampleSettings()
    ) -> None:
        """Choose the time samples and search over the configurations at these times.

        Args:
            request: The request.
            motions: Local motions through its time intervals; the best one determines where samples are needed.
            settings: Settings of the time samples.
        """
        self.request, self._settings = request, settings
        machine, bounds = request.machine, request.bounds
        require_poses(request)
        if machine.base_size:
            words = "search='global' needs a machine on a fixed base; use search='configurations'"
            raise ProblemError(words, name="search", value="global")
        best, self._known_cost = lowest_cost_motion(motions)
        if not np.isfinite(self._known_cost):  # a motion that stops at a limit does not show how far its joints turn
            unlimited = replace(request, limits=replace(request.limits, joints=False))
            motions = local_motions_from(unlimited, motions[0].joints[:, 0])
            best, _ = lowest_cost_motion(motions)
        self.space = JointSpace(machine, bounds.lower, bounds.upper, request.weights)
        self.bound = 0.0
        times = list[Array]()
        for stretch, motion in zip(request.stretches, motions, strict=True):
            if (equations := stretch.equations) is None:
                continue
            free_directions = machine.joint_size - equations.size
            if free_directions > MAX_FREE_DIRECTIONS:
                held = f" ({', '.join(request.held)} are held)" if request.held else ""
                words = f"at t = {stretch.begin:g} s the tasks leave {free_directions} degrees of freedom undetermined:"
                words += f" they prescribe {equations.size} rows, and {machine.joint_size} joints move: "
                words += f"{', '.join(machine.robot.joint_names)}{held}; search='segments' supports at most "
                words += f"{MAX_FREE_DIRECTIONS}. Lock a joint with lock_joints(robot, {{NAME: POSITION}}), add rows "
                words += "or a task, or use search='configurations'"
                count, limit = free_directions, MAX_FREE_DIRECTIONS
                raise ProblemError(words, name="search", value=count, limit=limit, time=stretch.begin)
            steps = int(np.ceil(settings.steps * stretch.duration / request.horizon))
            lost = settings.lost[max(free_directions, 0)]
            joints, periodic = motion.joints[best], self.space.periodic
            cost = SquaredRates(request.weights)
            chosen = choose_samples(motion.t, joints, cost, lost, min_steps=steps, periodic=periodic)
            shared = bool(times) and chosen[0] <= times[-1][-1]  # the stretch before ends there
            times.append(chosen[1:] if shared else chosen)
        if not times:
            words = f"no task is active within the horizon of {request.horizon:g} s; shorten the horizon"
            raise ProblemError(words, name="horizon", value=request.horizon)
        self._search_at(times)

    def _search_at(self, times: list[Array]) -> None:
        """Search over the configurations at time samples; `times` has an array for each interval with active tasks."""
        self._build_search(times)
        self._path, bound = self._search.solve(self._known_cost)
        self.bound = max(self.bound, bound)  # the bound of fewer samples stays valid
        if self._path is not None:
            self._known_cost = max(self._known_cost, self._search.path_cost(self._path))

    def _build_search(self, times: list[Array]) -> None:
        """Build the manifold atlas at time samples; `times` has an array for each time interval with active tasks."""
        request, samples = self.request, list[TimeSample]()
        active = [stretch.equations for stretch in request.stretches if stretch.equations is not None]
        for equations, stretch_times in zip(active, times, strict=True):
            manifolds = self._manifolds(equations, stretch_times)
            samples += [TimeSample(manifolds, index) for index in range(len(stretch_times))]
        self._samples, self._times_by_stretch, self.times = samples, times, np.concatenate(times)
        scene = None if request.clearance_constraints is None else request.clearance_constraints.scene
        limits = request.bounds.velocity * np.diff(self.times)[:, None]
        options: dict[str, Any] = {"seeds": self._seeds, "start": request.start, "scene": scene}
        steps = Steps(self.times, SquaredRates(request.weights), limits)
        self._search = AtlasSearch(self.space, samples, steps, **options)

    def _manifolds(self, equations: TaskEquations, times: Array) -> SelfMotionManifolds:
        """Return the self-motion manifolds of tasks at given times (M,), s."""
        targets = np.array(equations.target_function().map(len(times))(times[None, :])).T
        return SelfMotionManifolds(self.space, equations, targets)

    def dead_end(self) -> DeadEnd | None:
        """Return an error that says where all motions end, and why; None if a motion to the end was found."""
        if self._path is not None:
            return None
        ends = segment_ends(self._search, 0)
        through = len(ends) > 1 and ends[-1] == len(self.times) - 1
        return dead_end(self._search, proven=not np.isfinite(self.bound), segments=len(ends) if through else None)

    def segments(self, barred: Collection[tuple[float, float]] = ()) -> tuple[list[tuple[float, float]], int] | None:
        """Divide the tasks into the fewest segments of one motion each; return times and the least possible number.

        Args:
            barred: Begin and end, s, of intervals that are known to be infeasible in one segment.

        Returns:
            None if the motion cannot be continued somewhere, however the tasks are divided.
        """
        while True:
            spans = [(int(first), int(last)) for first, last in np.searchsorted(self.times, [*barred]).tolist()]
            ends, last = segment_ends(self._search, 0, spans), len(self.times) - 1
            through = bool(ends) and ends[-1] == last
            # any motion ends a segment between two samples, where the next one begins
            fewest = len(segment_ends(self._search, ruled_out=True))
            if not through or len(ends) > fewest:
                divisible = [end for end in ends if end < last and self._can_subdivide[end]]
                if divisible:
                    inside = (np.arange(1, self._settings.subdivisions) / self._settings.subdivisions)[:, None]
                    times_between = self.times[divisible] + inside * np.diff(self.times)[divisible]
                    self._build_search(self._with_samples(times_between.ravel()))
                    continue
            result = fewest_segments(self._search, 0, spans) if through else None
            if result is None:
                return None
            times = self.times.tolist()
            return [(times[segment.first], times[segment.last]) for segment in result[0]], fewest

    @property
    def _can_subdivide(self) -> NDArray[np.bool_]:
        """Mask of the intervals between time samples that are long enough to be subdivided."""
        return np.asarray(np.diff(self.times) > self._settings.closest * self.request.horizon)

    def _with_samples(self, times: Array) -> list[Array]:
        """Insert additional sample times; return the times of each interval in which the same tasks are active."""
        return [np.union1d(own, times[(times > own[0]) & (times < own[-1])]) for own in self._times_by_stretch]

    @property
    def near_cost(self) -> float:
        """Cost of a motion whose relative gap to the lower bound is twice the gap at which the search ends."""
        return self.bound / (1 - 2 * self._search.gap)

    def unresolved(self, cost: float) -> list[tuple[float, float, Array]]:
        """Return cost bound, time and joints of the classes of motions with bounds below `cost` but no known path."""
        return [(bound, float(self.times[k]), joints) for bound, k, joints in self._search.unresolved if bound < cost]

    def refine_samples(self, everywhere: bool = False) -> bool:
        """Add samples near limits of the best path (or `everywhere`) and search again; return whether any was added."""
        if self._path is None:
            return False
        settings, bounds, path = self._settings, self.request.bounds, self._path
        margins = np.minimum(path - bounds.lower, bounds.upper - path).min(axis=1)
        at_limit = margins < settings.near_position_limit
        fast = np.abs(np.diff(path, axis=0)) >= settings.near_speed_limit * self._search.limits
        critical = (everywhere | fast.any(axis=1) | at_limit[1:] | at_limit[:-1]) & self._can_subdivide
        if not critical.any():
            return False
        self._search_at(self._with_samples((self.times[:-1] + self.times[1:])[critical] / 2))
        return True

    def _seeds(self, k: int) -> Array:
        """Return configurations for the tasks at a time sample, from closed-form and iterative inverse kinematics."""
        manifolds, index = self._samples[k]
        try:
            return manifolds.seeds(index, self.request.limits.joints, self.request.seed + k)
        except Unreachable as error:
            raise locate_error(self.request, error, float(self.times[k])) from error

    def local_motions(self, include_costlier: bool = False) -> list[LocalMotion]:
        """Return motions of locally least cost, as one `LocalMotion` for each time interval with the same tasks.

        By default only motions near which the optimum may lie; with `include_costlier` all of them.
        """
        request, settings, motions = self.request, self._settings, list[LocalMotion]()
        paths = self._search.class_representatives(self._known_cost, include_costlier)
        if self._path is not None:
            paths.insert(0, self._path)
        if request.start is None:  # shift joints by full turns to keep their limits
            paths = [self.space.shift_turns(path, request.bounds.lower, request.bounds.upper) for path in paths]
        count, n = len(paths), request.machine.joint_size
        for stretch in request.stretches:
            steps = int(np.ceil(settings.motion_steps * stretch.duration / request.horizon))
            steps = max(steps, settings.steps)
            times = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.nodes)
            samples = np.array([[np.interp(times, self.times, path[:, j]) for j in range(n)] for path in paths])
            samples = samples.reshape(count, n, len(times)).transpose(0, 2, 1)
            if stretch.equations is not None:
                manifolds = self._manifolds(stretch.equations, times)
                indices = np.tile(np.arange(len(times)), count)
                samples = manifolds.project(indices, samples.reshape(-1, n))[0].reshape(samples.shape)
            samples = np.clip(samples, request.bounds.lower, request.bounds.upper)
            base = np.zeros((count, len(times), 0))
            motions.append(LocalMotion.through(times, base, samples, request.weights))
        return motions


def require_poses(request: PlanRequest) -> None:
    """Raise ProblemError if a task of a request for a global search prescribes a velocity instead of a pose."""
    for stretch in request.stretches:
        if stretch.equations is not None and not stretch.equations.pose_rows.all():
            words = "search='global' needs poses, but a task gives velocities; give the tip's position=..."
            raise ProblemError(words, name="search", value="global", time=stretch.begin)


def choose_samples(
    t: Array, joints: Array, step_cost: StepCost, share: float, *, min_steps: int, periodic: NDArray[np.bool_]
) -> Array:
    """Choose few sample times of a motion between which straight steps cost nearly as much as the motion.

    Times are left out greedily, the one that loses least first; at least `min_steps` steps remain. Joints that are
    `periodic`, (n,), turn by at most a quarter of a turn in a step, so that it is known which way round they go.
    """
    chosen = list(range(len(t)))

    def cost(a: int, b: int) -> float:
        return float(step_cost.evaluate(joints[b] - joints[a], t[b] - t[a]))

    def loss(i: int) -> float:
        a, b, c = chosen[i - 1 : i + 2]
        if np.abs(joints[c] - joints[a])[periodic].max(initial=0.0) > FULL_TURN / 4:
            return np.inf
        return cost(a, b) + cost(b, c) - cost(a, c)

    budget = share * sum(cost(a, b) for a, b in pairwise(chosen))
    losses = [np.inf, *(loss(i) for i in range(1, len(chosen) - 1)), np.inf]
    while len(chosen) > min_steps + 1:
        i = int(np.argmin(losses))
        budget -= losses[i]
        if not budget >= 0:
            break
        del chosen[i], losses[i]
        for k in (i - 1, i):
            if 0 < k < len(chosen) - 1:
                losses[k] = loss(k)
    return np.asarray(t[chosen])


def lower_bound_along(
    problem: PathProblem, path: Array, loss: float, *, seeds: Callable[[int], Array], settings: SearchSettings
) -> float:
    """Return a lower bound of the cost of all paths, from few samples chosen along a path of low cost.

    The bound is what the time limit and the largest number of charts allow. It is 0, with a warning, if even large
    charts are too many.

    Args:
        problem: Manifolds, steps and scene; the manifolds are those of one task.
        path: Path of low cost. Shape (K, n).
        loss: Share of its cost that straight steps between the chosen samples may lose.
        seeds: Function that returns configurations at a sample, see `AtlasSearch`.
        settings: Settings of the search.

    Warns:
        BoundWarning: There is no bound.
    """
    times, whole = problem.steps.times, problem.samples[0].manifolds
    options: dict[str, Any] = {"min_steps": 1, "periodic": whole.space.periodic}
    chosen = np.flatnonzero(np.isin(times, choose_samples(times, path, problem.steps.cost, loss, **options)))
    manifolds = SelfMotionManifolds(whole.space, whole.equations, whole.targets[chosen])
    limits = np.add.reduceat(problem.steps.limits, chosen[:-1], axis=0)
    steps = Steps(times[chosen], problem.steps.cost, limits)
    samples = [TimeSample(manifolds, k) for k in range(len(chosen))]
    for growth in LARGER_CHARTS:
        point, curve, surface = (growth * radius for radius in settings.radii)
        larger = replace(settings, radii=(point, curve, surface))
        try:
            search = AtlasSearch(
                whole.space, samples, steps, seeds=lambda k: seeds(int(chosen[k])), scene=problem.scene, settings=larger
            )
            return search.lower_bound(problem.cost(path))
        except TimeLimitReached:
            return 0.0
        except ProblemError as error:
            if error.name != TOO_MANY_CHARTS:
                raise
            refusal = error
    warn(BoundWarning(f"no lower bound of the cost was searched: {refusal}", **vars(refusal)), stacklevel=2)
    return 0.0


def tool_motion_bound(machine: FixedBase, poses: PathPoses, cost: Homogeneous, bounds: JointBounds) -> float:
    """Return a lower bound of the cost of all joint paths through tool poses, for any number of redundant joints.

    It follows from the motion of the tool alone, see `_ToolLevers`. The least cost of a step is at least that of a
    linear program. Each feasible point of the dual program,

        maximise  distances . y,   y >= 0,   dual norm of (levers' y) <= 1,

    gives a lower bound for all steps. Its vertices are enumerated.
    """
    tool = _ToolLevers.of(machine, bounds)
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = np.where(tool.levers > 0, tool.levers / cost.weights, 0.0)
    rows = np.flatnonzero(np.isfinite(rates).all(axis=1))  # a joint that costs nothing takes the tool along
    if not rows.size:
        return 0.0
    limits, count = cost.dual_terms(rates[rows].T), len(rows)
    planes, right = np.vstack([limits, np.eye(count)]), np.append(np.ones(len(limits)), np.zeros(count))
    corners = np.array([*combinations(range(len(planes)), count)])
    corners = corners[np.abs(np.linalg.det(planes[corners])) > 0]
    vertices = np.maximum(np.linalg.solve(planes[corners], right[corners][:, :, None])[:, :, 0], 0.0)
    vertices /= np.maximum((vertices @ limits.T).max(axis=1, keepdims=True), 1.0)  # others are moved into the polytope
    distances = tool.distances(poses.positions, poses.rotations)[:, rows]
    return float((distances @ vertices.T).max(axis=1).sum())


def tool_rate_bound(request: PlanRequest) -> float:
    """Return a lower bound of the cost of all motions that perform pose tasks, for any number of redundant joints.

    The cost is the integral of half the weighted squared joint rates. In a time step h, joints that move by d cost at
    least the sum of w_j d_j^2 / (2 h). With the rows of `_ToolLevers` for each task whose targets are given in world,
    the least cost of the step is at least that of a quadratic program, and thus, for any y >= 0, at least

        (distances . y)^2 / (2 h y' G y),   G = levers W^-1 levers'.

    The best y is found by nonnegative least squares (Lawson, Hanson 1974, section 23.4).
    """
    machine, weights, bound = request.machine, request.weights, 0.0
    for stretch in request.stretches:
        count = max(int(np.ceil(request.settings.local_steps * stretch.duration / request.horizon)), 1)
        times = np.union1d(np.linspace(stretch.begin, stretch.end, count + 1), stretch.nodes)
        levers, distances = [np.zeros((0, machine.joint_size))], [np.zeros((len(times) - 1, 0))]
        for task in (request.tasks[i] for i in stretch.tasks):
            if task.is_pose and task.relative_to is None and task.start_gap <= TipTask.start_gap:
                tool = _ToolLevers.of(bind(machine, task).bound[0].tip, request.bounds)
                levers.append(tool.levers)
                distances.append(tool.task_distances(task, times - task.begin))
        factor, right = np.vstack(levers) / np.sqrt(weights), np.hstack(distances)
        if not len(factor):
            continue
        for row, step in zip(right, np.diff(times), strict=True):
            target = row / max(row.max(initial=0.0), TOLERANCE)
            dual = scipy.optimize.nnls(np.vstack([factor.T, target]), np.append(np.zeros(len(weights)), 1.0))[0]
            spread = float(((factor.T @ dual) ** 2).sum())
            bound += float(row @ dual) ** 2 / (2 * step * spread) if spread > 0 else 0.0
    return bound


def _angles(rotations: Array) -> Array:
    """Return the angles (M - 1,) between successive rotation matrices (M, 3, 3), rad."""
    attitudes = scipy.spatial.transform.Rotation.from_matrix(rotations)
    return np.asarray((attitudes[:-1].inv() * attitudes[1:]).magnitude())


@dataclass(frozen=True, eq=False)
class _ToolLevers:
    """Upper bounds of the motion of a tool: joint displacements d move its points and turn it by at most levers . |d|.

    The points are the tip and, at a wrist, the point of the last axis that is nearest to the axis before it, because
    fewer joints move this point. The last row is the rotation.

    Attributes:
        machine: The machine whose tip is the tool, on a fixed base.
        points: Points of the tool, relative to the tip, along the axes of the tip. Shape (P, 3), m.
        levers: Largest distances of the points from the axes of the joints, 1 for a prismatic joint; in the last row 1
            for a revolute joint and 0 for a prismatic one. Shape (P + 1, n).
    """

    machine: Machine
    points: Array
    levers: Array

    @classmethod
    def of(cls, machine: Machine, bounds: JointBounds) -> _ToolLevers:
        """Return each joint's largest lever arms on a machine's tool over all configurations within joint limits."""
        robot, parts = machine.robot, RigidParts.of(machine.robot)
        chain = parts.path(parts.of_link[robot.root], parts.of_link[robot.tip_link])[1]
        rotation, translation = parts.pose[robot.tip_link]
        tip, axes = translation + rotation @ robot.tip_translation, rotation @ robot.tip_rotation
        points = [tip]
        if len(chain) > 1:
            last, before, offset = chain[-1], np.asarray(chain[-2].joint.axis), np.asarray(chain[-1].translation)
            along = last.rotation @ last.joint.axis
            slope = max(1 - (along @ before) ** 2, ROUNDING_SHARE)
            points.append(((offset @ before) * (along @ before) - offset @ along) / slope * last.joint.axis)
        levers = np.zeros((len(points) + 1, robot.dof))
        down = [(step, True) for step in chain]
        ends = [Sphere(TOLERANCE, point) for point in points]
        arms = [lever_arms(robot, down, end, low=bounds.lower, high=bounds.upper)[0] for end in ends]
        for (joint, *_), *reach in zip(chain, *arms, strict=True):
            column, ratio, _ = robot.couplings[joint.name]
            turn = 0.0 if joint.kind == "prismatic" else 1.0
            levers[:, column] += abs(ratio) * np.array([*(arm if turn else 1.0 for arm in reach), turn])
        return cls(machine, (np.array(points) - tip) @ axes, levers)

    def distances(self, positions: Array, rotations: Array) -> Array:
        """Return displacements of the points, m, and rotations, rad, between successive tip poses (M, 3), (M, 3, 3)."""
        steps = [np.diff(positions + rotations @ point, axis=0) for point in self.points]
        return np.column_stack([*np.linalg.norm(steps, axis=2), _angles(rotations)])

    def task_distances(self, task: TipTask, times: Array) -> Array:
        """Return tool displacements and rotations that a task prescribes between times (M,) after its start."""
        still = {"base": np.zeros((len(times), 0)), "joints": np.zeros((len(times), self.machine.joint_size))}
        (target,) = targets_along(self.machine, [replace(task, begin=0.0, duration=None)], times, **still)
        placed, turned = len(task.linear) == 3, set(ANGULAR) <= set(task.chosen)
        if placed and turned:
            return self.distances(target.position, target.rotation)
        distances = np.zeros((len(times) - 1, len(self.levers)))
        if placed or task.along_reference:
            distances[:, 0] = np.linalg.norm(np.diff(target.position[:, task.linear], axis=0), axis=1)
        if turned:
            distances[:, -1] = _angles(target.rotation)
        elif task.tilts:
            chords = np.linalg.norm(np.diff(target.rotation[:, :, 2], axis=0), axis=1)
            distances[:, -1] = 2 * np.arcsin(np.minimum(chords / 2, 1.0))
        return distances
