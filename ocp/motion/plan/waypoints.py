"""Lowest-cost joint path of an arm through a sequence of tool poses, and a lower bound of its cost.

The cost is the weighted sum of all joint displacements, or the largest of them, which may be a time. Between waypoints,
no joint moves more than a given step. A global search covers some of the waypoints (see `search.search`). A path
through all waypoints costs no less than one through some of them, so that the bound holds for all. The best paths found
are then extended to all waypoints and shortened there by dynamic programming over neighbouring configurations.
Violations are penalised, so that a path can move out of them. If no path goes through all waypoints, one in the fewest
segments may be requested (see `ocp.motion.search.reconfigurations`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from models import FixedBase
from models.checks import Array
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.local.collisions import Collision, distances_along, find_collisions
from ocp.motion.local.ik_solver import idle_positions
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.planner import PlanOptions, clearance_for
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.dead_end import RelaxationKind, dead_end
from ocp.motion.search.joint_space import TOLERANCE
from ocp.motion.search.lengths import Homogeneous, LargestMotion, PathLength
from ocp.motion.search.reconfigurations import SectionSearch, SectionSettings, Segment, fewest_segments, section_values
from ocp.motion.search.search import MAX_FREE_DIRECTIONS, AtlasSearch, SearchSettings, checked_bound
from ocp.motion.search.shortening import PathPoses, PathProblem, optimise_path, shorten_path
from ocp.motion.search.steps import Steps
from ocp.motion.search.task_search import TOO_MANY_CHARTS, lower_bound_along, tool_motion_bound
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.goals import Cost, Scene, Waypoints
from ocp.motion.tasks.limits import LIMITED, Limits
from ocp.motion.tasks.tip_task import TipTask

WAYPOINT = "waypoint {:g}"
MAX_REDUNDANT_JOINTS = 3
"""Largest number of redundant joints for which a path is searched."""
NO_PATH = "no path through the waypoints keeps all limits"


@dataclass(frozen=True)
class WaypointSettings:
    """Settings of the search for a path through waypoints.

    Attributes:
        stride: With at most one redundant joint, every so many-th waypoint is searched, and half the stride is tried
            next if no path found goes through all.
        first_steps: With two or three redundant joints, number of steps of a first search, which finds short paths.
        steps, strides: Approximate number of steps of the next two searches, and their least strides.
        sample_loss: With two redundant joints, share of the cost of the best path that straight steps between the
            waypoints of the lower bound may lose.
        max_paths: Largest number of paths of a search that are shortened, the lowest cost first.
        widths: Initial and final spacing of the configurations of `shorten_path`, rad or m, before the path is brought
            to a local optimum.
        pose_tolerance: Largest pose error, m and rad.
        search, sections: Settings of the searches with at most one redundant joint, and with more.
    """

    stride: int = 5
    first_steps: int = 6
    steps: int = 20
    strides: tuple[int, int] = (10, 5)
    sample_loss: float = 0.01
    max_paths: int = 2
    widths: tuple[float, float] = (0.06, 2e-3)
    pose_tolerance: float = 1e-6
    search: SearchSettings = field(default_factory=SearchSettings)
    sections: SectionSettings = field(default_factory=SectionSettings)


class _Path(NamedTuple):
    """Joint path through all waypoints, in one or several segments."""

    cost: float
    failure: str  # why the path is not valid; "" if it is
    invalid: NDArray[np.intp]  # waypoints where it is not valid
    joints: Array  # at the waypoints, shape (N, n)
    breaks: tuple[int, ...] = ()  # waypoints after which the arm reconfigures


def plan_path(
    machine: FixedBase, waypoints: Waypoints, options: PlanOptions, *, scene: Scene | Literal[False] | None
) -> PathPlan:
    """Plan the lowest-cost joint path through tool poses, within limits and collision-free at every waypoint.

    The machine has at most three redundant joints for the poses of its tip. If it has two or three, paths are searched
    on sections in which the joint or joints nearest to the base have one of several values (see
    `ocp.motion.search.reconfigurations`). The bound of two is searched on the whole manifolds; that of three follows
    from the motion of the tool alone (`tool_motion_bound`), and is looser. Limits are those of the joint positions and,
    if the cost is the time, of the velocities. Obstacles are static, since a path has no times.

    Raises:
        ProblemError: The request does not fit the machine. Its subclass Unreachable names the waypoint as time.
        DeadEnd: No path goes through all waypoints (in one segment, if reconfigurations are forbidden): where paths
            end, what obstructs them, and by how much the poses or the clearance would have to be relaxed.
        SolveError: No path was found, though some pass a part of the waypoints.
    """
    cost, limits = options.cost, options.limits
    poses = _poses(waypoints, machine.joint_size)
    checked_limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    own_cost = Cost(velocity=0, length=1) if cost is None else require.instance("cost", cost, Cost)
    if own_cost.terms not in (("length",), ("time",)):
        words = "cost: a path through waypoints costs its length or its time, Cost(velocity=0, length=1) or "
        words += f"Cost(velocity=0, time=1), not {own_cost}"
        raise ProblemError(words, name="cost", value=own_cost)
    is_timed = own_cost.terms == ("time",)
    for quantity in LIMITED:
        if getattr(checked_limits, quantity) is not None and not (quantity == "velocity" and is_timed):
            words = f"limits: a path through waypoints has no time, hence no {quantity}; leave it out, or give a step"
            raise ProblemError(words, name=quantity, value=getattr(checked_limits, quantity))
    require.choice("reconfigurations", waypoints.reconfigurations, ("forbidden", "counted"))
    if is_timed:
        if own_cost.weights is not None:
            words = "cost: the time of a path takes no weights; leave them out"
            raise ProblemError(words, name="weights", value=own_cost.weights)
        joint_weights = own_cost.time / checked_limits.bounds(machine, ("velocity",)).velocity
    else:
        joint_weights = np.full(machine.joint_size, float(own_cost.length))
        if own_cost.weights is not None:
            shape, meaning = joint_weights.shape, "one for each joint"
            joint_weights *= require.array("weights", own_cost.weights, shape, sign="nonnegative", meaning=meaning)
    if not joint_weights.any():
        words = "cost: no joint adds to it; give a joint a velocity limit for the time, or a weight for the length"
        raise ProblemError(words, name="velocity" if is_timed else "weights", value=joint_weights)
    words = "a path through waypoints has no time at which obstacles would be somewhere; give static obstacles"
    constraints = clearance_for(machine, checked_limits, scene, why_static=words)
    cost_of_steps = (LargestMotion if is_timed else PathLength)(joint_weights)
    planner = _WaypointPlanner(machine, poses, cost_of_steps, checked_limits, constraints, int(options.seed))
    return planner.plan(waypoints.reconfigurations == "counted")


@dataclass(eq=False)
class _WaypointPlanner:
    """Planner of a path through waypoints, with the checked arguments of `plan_path`."""

    machine: FixedBase
    poses: PathPoses
    cost: Homogeneous
    limits: Limits
    constraints: ClearanceConstraints | None
    seed: int
    settings: WaypointSettings = field(default_factory=WaypointSettings)

    def __post_init__(self) -> None:
        machine, bounds = self.machine, self.limits.bounds(self.machine)
        self.positions, self.rotations, self.step = self.poses
        self.scene = None if self.constraints is None else self.constraints.scene
        self.lower, self.upper = bounds.lower, bounds.upper
        pose = bind(machine, TipTask(position=self.positions[0], orientation=self.rotations[0]))
        idle = idle_positions(self.lower, self.upper)
        options: dict[str, Any] = {"bounds": bounds, "idle": idle, "scene": self.scene}
        self.problem = PathProblem.through_poses(machine, self.poses, self.cost, **options)
        self.manifolds = self.problem.samples[0].manifolds
        self.space = self.manifolds.space
        self._seed_cache = dict[int, Array]()
        if not 0 <= self.manifolds.size <= MAX_REDUNDANT_JOINTS:
            words = f"{machine.robot.name}: {int((~pose.idle).sum())} joints for the {pose.size} rows of a pose"
            words += f"; lock joints until at most {MAX_REDUNDANT_JOINTS} degrees of freedom are left"
            raise ProblemError(words, name="machine", value=self.manifolds.size, limit=MAX_REDUNDANT_JOINTS)
        # with several redundant joints, sections fix those nearest to the base, which move all others
        robot = machine.robot
        names = [joint.name for joint in robot.path_to(robot.tip_link) if joint.name in robot.joint_names]
        nearest = names[: max(self.manifolds.size - 1, 0)]
        self._section_joints = tuple(robot.joint_names.index(name) for name in nearest)

    def plan(self, counted: bool) -> PathPlan:
        """Plan the lowest-cost path through all waypoints, in the fewest segments if `counted`, otherwise in one.

        Some waypoints are searched, and the paths found are extended to all waypoints. If that fails, the waypoints
        where it fails, or more closely spaced ones, are searched as well.
        """
        if counted and self.manifolds.size > 1:
            words = f"reconfigurations='counted' needs at most one free direction, not {self.manifolds.size}"
            raise ProblemError(words, name="reconfigurations", value=self.manifolds.size, limit=1)
        strides, searches_left = self._strides()
        search = self._search_with_stride(strides.pop(0))
        assert search is not None
        paths, bound, segmented = list[_Path](), 0.0, False
        while True:
            split_at_reversals, lower_bound = self._segmented_paths(search, segmented)
            if np.isfinite(lower_bound):
                bound = lower_bound if segmented else max(bound, lower_bound)
                extended = [self._extend(search, chain) for chain in split_at_reversals[: self.settings.max_paths]]
                paths = extended if segmented else paths + extended
                searches_left -= 1
                if any(not path.failure for path in paths) and (searches_left <= 0 or not strides):
                    return self._best_plan(paths, bound)
                next_search = self._search_at_failures(search, paths[-1]) if split_at_reversals else None
                while next_search is None and strides and not segmented:
                    next_search = self._search_with_stride(strides.pop(0), search)
                if next_search is not None:
                    search = next_search
                    continue
            if segmented or not counted:
                break
            segmented = True
        if not np.isfinite(lower_bound):
            raise self._dead_end_error(search)
        if not split_at_reversals and all(path.failure for path in paths):
            paths += self._negligibly_relaxed_paths(search)
        return self._best_plan(paths, bound)

    def _segmented_paths(self, search: AtlasSearch, segmented: bool) -> tuple[list[list[Segment]], float]:
        """Return paths through the waypoints of a search, each a list of segments, and a lower bound of their cost."""
        if segmented:
            result = fewest_segments(search)
            return ([], np.inf) if result is None else ([result[0]], result[1])
        paths, bound = search.paths()
        return [[Segment(0, len(path) - 1, path, search.path_cost(path), bound)] for path in paths], bound

    def _best_plan(self, paths: list[_Path], bound: float) -> PathPlan:
        """Return the plan of the valid path of lowest cost, or raise SolveError with the failures of all paths."""
        paths = sorted(paths, key=lambda path: (bool(path.failure), path.cost))
        if not paths or paths[0].failure:
            reasons = "; ".join(dict.fromkeys(path.failure for path in paths))
            raise SolveError(f"{NO_PATH}{reasons and ': '}{reasons}", name="waypoints")
        best = paths[0]
        if self._section_joints:
            bound = tool_motion_bound(self.machine, self.poses, self.cost, self.limits.bounds(self.machine))
        if self.manifolds.size == MAX_FREE_DIRECTIONS:
            loss, settings = self.settings.sample_loss, self.settings.search
            searched = lower_bound_along(self.problem, best.joints, loss, seeds=self._seeds, settings=settings)
            bound = max(bound, searched)
        lower_bound = checked_bound(bound, best.cost)
        candidates = [Candidate(best.joints[0], best.cost, None, Stage.FINE)]
        for path in paths[1:]:
            reason = Reason(Rejection.INFEASIBLE, path.failure) if path.failure else Reason(Rejection.COSTLIER)
            candidates.append(Candidate(path.joints[0], path.cost, reason, Stage.FINE))
        return PathPlan(
            self.machine,
            best.joints,
            self.limits,
            self.constraints,
            self.poses,
            self.cost,
            tuple(candidates),
            lower_bound or None,
            best.breaks,
        )

    # ---- searched waypoints ------------------------------------------------------------------------------------------

    def _strides(self) -> tuple[list[int], int]:
        """Return the waypoint spacing of each successive search, and the number of searches that are always made."""
        settings, count = self.settings, len(self.positions)
        if not self._section_joints:
            halves = int(np.log2(settings.stride)) + 1
            return [settings.stride // 2**k for k in range(halves)], 1
        # a step must be able to lead from one section to the next
        min_stride = min(4 * settings.sections.radii[1] / np.delete(self.step, self._section_joints).min(), count)
        strides = (max(min(each, count // settings.steps), int(np.ceil(min_stride)), 1) for each in settings.strides)
        return [-(-count // settings.first_steps), *strides], 2

    def _search_with_stride(self, stride: int, known: AtlasSearch | None = None) -> AtlasSearch | None:
        """Return a search over every `stride`-th waypoint; double the stride until few enough charts are needed.

        Return None if it has no more waypoints than a known search.
        """
        last, known_count = len(self.positions) - 1, 1 if known is None else len(known.times)
        while True:
            chosen = np.unique(np.linspace(0, last, -(-last // stride) + 1).round().astype(int))
            if known is not None and not self._section_joints:
                chosen = np.union1d(chosen, known.times.astype(int))
            if len(chosen) <= known_count:
                return None
            try:
                return self._search(chosen, known is not None)
            except ProblemError as error:
                if error.name != TOO_MANY_CHARTS or len(chosen) == 2:
                    raise
            stride *= 2

    def _search_at_failures(self, search: AtlasSearch, path: _Path | None) -> AtlasSearch | None:
        """Return a search that also includes the waypoints where a path is invalid, or None if that is impossible."""
        chosen = search.times.astype(int)
        if path is None or self._section_joints or np.isin(path.invalid, chosen).all():
            return None
        try:
            return self._search(np.union1d(chosen, path.invalid))
        except ProblemError as error:
            if error.name != TOO_MANY_CHARTS:
                raise
            return None

    def _search(self, chosen: NDArray[np.intp], coarse: bool = False) -> AtlasSearch:
        """Return the search for paths over chosen waypoints; all redundant joints but one take fixed values."""
        manifolds = SelfMotionManifolds(self.space, self.manifolds.equations, self.manifolds.targets[chosen])
        distances = np.diff(chosen)[:, None]
        options: dict[str, Any] = {"seeds": lambda k: self._seeds(int(chosen[k])), "scene": self.scene}
        samples = [TimeSample(manifolds, k) for k in range(len(chosen))]
        arguments = self.space, samples, Steps(chosen.astype(float), self.cost, distances * self.step)
        joints, settings = self._section_joints, self.settings.sections
        if not joints:
            return AtlasSearch(*arguments, **options, settings=self.settings.search)
        shared = replace(settings, values=int(settings.values ** (1 / len(joints))))
        values = [
            section_values(
                self.machine.robot.moving_joints[joint].kind == "prismatic",
                self.lower[joint],
                self.upper[joint],
                float((distances * self.step)[:, joint].min()),
                settings=shared,
            )
            for joint in joints
        ]
        sections: dict[str, Any] = {"radius": settings.radii[coarse], "charts": settings.charts}
        return SectionSearch(*arguments, **options, **sections, joints=joints, values=np.array([*product(*values)]))

    def _dead_end_error(self, search: AtlasSearch) -> SolveError:
        """Return the error that names the first waypoint that no path reaches, which the search may have skipped."""
        error, chosen = dead_end(search, WAYPOINT), search.times.astype(int)
        if error is None:
            return SolveError("no path goes through the waypoints", name="waypoints")
        assert error.time is not None
        refined = np.union1d(chosen, np.arange(int(error.time), int(error.until) + 1))
        return (None if len(refined) == len(chosen) else dead_end(self._search(refined), WAYPOINT)) or error

    def _negligibly_relaxed_paths(self, search: AtlasSearch) -> list[_Path]:
        """Return paths that become possible if the poses are relaxed by no more than the pose tolerance.

        If there is none, raise the SolveError that says why.
        """
        uncovered = [float(time) for time, charts in zip(search.times, search.atlas, strict=True) if not len(charts)]
        if uncovered and self._section_joints:
            names = [self.machine.robot.joint_names[joint] for joint in self._section_joints]
            words = f"{NO_PATH}: no configuration was found at waypoint {uncovered[0]:g} on the sections of "
            raise SolveError(words + " and ".join(map(repr, names)), name=names[0], time=uncovered[0])
        error = dead_end(search, WAYPOINT, proven=False)
        if error is None:
            return []
        of_pose = [each for each in error.relaxations if each.kind is not RelaxationKind.CLEARANCE]
        paths = [each.joints for each in of_pose if each.amount <= self.settings.pose_tolerance]
        if not paths:
            raise error
        return [self._extend(search, [Segment(0, len(path) - 1, path, search.path_cost(path), 0.0)]) for path in paths]

    # ---- paths through all waypoints ---------------------------------------------------------------------------------

    def _extend(self, search: AtlasSearch, chain: list[Segment]) -> _Path:
        """Extend path segments through some waypoints to a path through all waypoints.

        The path is invalid if it reconfigures between two waypoints that are not consecutive.
        """
        chosen = search.times.astype(int)
        breaks = [(int(chosen[segment.last]), int(chosen[segment.last + 1])) for segment in chain[:-1]]
        joints, break_numbers = self._interpolate(chosen, chain), tuple(first for first, _ in breaks)
        if distant := [np.arange(*pair) for pair in breaks if pair[1] > pair[0] + 1]:
            failure = "it reconfigures between waypoints that were not searched"
            return _Path(np.inf, failure, np.concatenate(distant), joints, break_numbers)
        paths = []
        for segment in chain:
            first, last = int(chosen[segment.first]), int(chosen[segment.last])
            problem = self.problem.restrict(first, last)
            shortened = shorten_path(joints[first : last + 1], problem, self.settings.widths)
            paths.append(optimise_path(shortened, problem))
        joints = np.concatenate(paths)
        steps = np.delete(self.cost.evaluate(np.diff(joints, axis=0), 1.0), list(break_numbers))
        return _Path(float(steps.sum()), *self._check_path(joints, break_numbers), joints, break_numbers)

    def _seeds(self, number: int) -> Array:
        """Return inverse kinematics solutions at a waypoint, computed at most once for each waypoint."""
        if number not in self._seed_cache:
            try:
                seeds = self.manifolds.seeds(number, self.limits.joints, self.seed + number)
            except Unreachable as error:
                words = f"waypoint {number} at {self.positions[number].round(6).tolist()} m: {error}"
                raise Unreachable(words, **{**vars(error), "time": float(number)}) from error
            self._seed_cache[number] = seeds
        return self._seed_cache[number]

    def _interpolate(self, chosen: NDArray[np.intp], chain: list[Segment]) -> Array:
        """Interpolate the configurations (N, n) of all waypoints between those that were searched, within limits."""
        numbers = np.arange(len(self.positions))
        path = np.concatenate([segment.joints for segment in chain])
        joints = np.column_stack([np.interp(numbers, chosen, column) for column in path.T])
        projected, converged = self.manifolds.project(numbers, joints)
        joints[converged] = projected[converged]
        for segment in chain:
            rows = slice(int(chosen[segment.first]), int(chosen[segment.last]) + 1)
            joints[rows] = self.space.shift_turns(joints[rows], self.lower, self.upper)
        return joints

    def _check_path(self, joints: Array, breaks: tuple[int, ...]) -> tuple[str, NDArray[np.intp]]:
        """Return a text about a requirement that a path violates, "" if none, and the indices of invalid waypoints."""
        names, indices = self.machine.robot.joint_names, np.arange(len(joints))
        errors = np.abs(self.manifolds.linearize(indices, joints)[0]).max(axis=1)
        excess = np.maximum(joints - self.upper, self.lower - joints)
        steps = np.abs(np.diff(joints, axis=0)) - self.step
        steps[list(breaks)] = -self.step
        too_far = (steps > TOLERANCE).any(axis=1)
        invalid = (errors > self.settings.pose_tolerance) | (excess > TOLERANCE).any(axis=1)
        invalid[:-1] |= too_far
        invalid[1:] |= too_far
        colliding: NDArray[np.bool_] = np.zeros(len(joints), dtype=bool)
        if self.scene is not None:
            times, clearance = indices.astype(float), self.scene.clearance
            distances = distances_along(self.scene, np.zeros(0), joints, times, cutoff=clearance)
            colliding = np.asarray((distances < clearance).any(axis=1))
        words = ""
        if errors.max() > self.settings.pose_tolerance:
            words = f"waypoint {int(errors.argmax())} is missed by {errors.max():.2g} m or rad"
        elif excess.max() > TOLERANCE:
            k, j = np.unravel_index(int(excess.argmax()), excess.shape)
            words = f"joint {names[j]!r} passes its limit by {excess.max():.2g} at waypoint {k}"
        elif too_far.any():
            k, j = np.unravel_index(int(steps.argmax()), steps.shape)
            words = f"joint {names[j]!r} moves {steps.max() + self.step[j]:.3g} from waypoint {k} to the next"
        elif self.scene is not None and colliding.any():
            closest: Collision = find_collisions(self.scene, np.zeros(0), joints, indices.astype(float))[0]
            words = f"collision: {closest.bodies[0]} and {closest.bodies[1]} at waypoint {closest.time:g}"
        return words, np.flatnonzero(invalid | colliding)


def _poses(waypoints: Waypoints, size: int) -> PathPoses:
    """Check waypoints, and return their poses and the largest allowed step of each of `size` joints."""
    step = require.broadcast("step", waypoints.step, size, "joints", entries="numbers", sign="positive")
    positions = require.array("positions", waypoints.positions, ("waypoints", 3), least=2)
    quaternions = require.array("quaternions", waypoints.quaternions, ("waypoints", 4), least=2)
    if len(positions) != len(quaternions):
        words = f"there are {len(positions)} positions and {len(quaternions)} quaternions"
        raise ProblemError(words, name="quaternions", value=len(quaternions), limit=len(positions))
    norms = np.linalg.norm(quaternions, axis=1)
    if not (norms > 0).all():
        raise ProblemError(f"quaternion {int(norms.argmin())} is zero", name="quaternions", value=0.0)
    rotations = scipy.spatial.transform.Rotation.from_quat(quaternions[:, [1, 2, 3, 0]])
    return PathPoses(positions, np.asarray(rotations.as_matrix()), step)
