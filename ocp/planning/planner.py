"""One call from a machine and its tasks to the cheapest motion that passes its audit, or the reasons why there is none.

Where the start is not given it is searched: inverse kinematics finds postures at the start, in every branch and spread
over the self-motion. Each is followed through the tasks by its local motion, which is the guess of a solve on a coarse
mesh, the start free along its self-motion. Those that lead to the same motion are one; the others are solved on a mesh
with nodes where the tasks' pieces meet, the cheapest first, until none is left that may be cheaper than what was found.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from models import Machine, Standing
from models.arrays import Array
from ocp.audit.audit import Audit
from ocp.builders.tool_motion import CLOCK, Stretch, ToolMotion, stretches_of, tool_motion_problem
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.direct.prepared import Prepared
from ocp.errors import (
    ProblemError,
    RefinementWarning,
    SolveError,
    checked_choice,
    checked_count,
    checked_each,
    checked_flag,
    checked_instance,
    checked_positive,
)
from ocp.local.following import Followed, follow
from ocp.local.inverse_kinematics import LARGEST_SEED, Unreachable, inverse_kinematics
from ocp.methods import solve
from ocp.planning.motion import Candidate, Plan, failed, parts_of
from ocp.planning.standing import plan_to_stand
from ocp.refinement import refine
from ocp.solution import Solution
from ocp.tasks.checks import checked_configuration, checked_horizon, checked_tasks, checked_weights, ignorable_joints
from ocp.tasks.equations import bind
from ocp.tasks.limits import JointBounds, Limits
from ocp.tasks.tip_task import TipTask

__all__ = ["plan"]

Search: TypeAlias = Literal["start", "postures"]

COARSE, FINE = 2, 7
"""Degrees of collocation: smooth pieces are met to rounding by one interval of the high one."""
LEAST_INTERVALS = 8
"""Of a motion, where its pieces are fewer."""
FOLLOWED = 64
"""Steps of the local motions, beside the breaks of the tasks."""
DAMPINGS = (0.01, 0.1, 1.0)
"""Of the local motions, relative to the singular values; the next is tried where no posture follows with one."""
STARTS = 64
"""Random starts of inverse kinematics."""
SAME, NEAR = 1e-5, 0.1
"""Share of the cost, and rad or m: of motions nearer to each other than either one is looked at."""
NOTHING = 1e-12
"""(rad/s)^2 or (m/s)^2: rates of rounding, of what stands still."""
OUT_OF_REACH = 1e-4
"""m or rad: a pose missed by more may be out of reach."""
TIP = 1e-6
"""m and rad: how far a tip may be from its task anywhere, all rows together."""
PLACES = 16
"""Of each interval, at which it is looked for."""
MESHES = 4
"""One cut where the tips stray from the one before."""
TRIED = 8
"""Postures that are taken one after the other, the best conditioned first, before all of them are compared."""
RESERVES = 3
"""Motions like one that does not hold that are tried in its place."""
FAR = 10.0
"""A local motion so many times as dear as the cheapest plan is not worth a solve."""
SOLVER = {"max_iter": 150}
ROUGH = {"max_iter": 60, "tol": 1e-4, "mu_init": 1e-3}
"""On the coarse mesh, from a guess that does its tasks."""


ALIKE = "the same as another one, or of the same cost"


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is asked, checked.

    Attributes:
        machine, tasks, horizon: As of `plan`.
        start: Joints at the start, or None. base: Base there. weights: Of the joint rates.
        limits: Of the joints.
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

    @cached_property
    def bounds(self) -> JointBounds:
        """Of the joints."""
        return self.limits.bounds(self.machine)


@interruptible
def plan(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | Literal["free"] | None = None,
    *,
    start: Any = None,
    start_base: Any = None,
    cyclic: bool = False,
    weights: Any = None,
    limits: Limits | None = None,
    search: Search = "postures",
    seed: int = 0,
    time_cost: float = 1.0,
) -> Plan:
    """Plan the cheapest motion that does the tasks: the least integral of half the squared joint rates.

    Args:
        machine: On a fixed or a floating base; or standing, see `plan_to_stand`, whose cost is that of `plan_standing`.
        tasks: What its tips do; each from its `begin` on for its `duration`.
        horizon: s; None: until the last task ends. "free": the tasks may be done slower than they say, never faster;
            pace and self-motion are found at once, for the least of `time_cost` and joint rates together.
        start: Joints at the start, rad or m, shape (n,); None: wherever the first tasks can begin, which is searched.
        start_base: Base at the start, shape (base_size,); the machine's base_home() if None.
        cyclic: Whether the joints end where they start.
        weights: Of the squared joint rates, shape (n,); all 1 if None.
        limits: Of the joints' positions and rates; the robot's own if None.
        search: "start": from the given start, or from the one that is best conditioned of those that inverse kinematics
            finds; "postures": from all of these, and the cheapest motion is the plan. Each may slide along its
            self-motion.
        seed: Of inverse kinematics.
        time_cost: Of each second where the horizon is free, in units of the cost, (rad/s)^2; the larger, the nearer the
            motion is to that of least time.

    Returns:
        The plan, audited, with every other motion that was found, its cost and why it is not the plan.

    Raises:
        ProblemError: What is asked does not fit the machine, or cannot be asked at once; Unreachable, which is one,
            names the time and the place that is out of reach.
        SolveError: No motion passes its audit; says what became of each posture.
    """
    if isinstance(machine, Standing):
        return plan_to_stand(
            machine,
            tasks,
            horizon,
            start=start,
            cyclic=cyclic,
            weights=weights,
            limits=limits,
            search=search,
            seed=seed,
        )
    asked = _checked(machine, tasks, horizon, start, start_base, cyclic, weights, limits, search, seed, time_cost)
    postures = _postures(asked)
    given = asked.start
    if given is None:
        given, postures = _settled(asked, postures)
    maker = _Maker(asked, given, postures[0])
    told: list[Candidate] = []
    if search == "start" or len(postures) == 1:
        for joints in postures[:TRIED]:
            guess = maker.motion.guess(_followed(asked, joints[None]), 0)
            told.append(maker.solved(joints, guess, thorough=len(postures) == 1))
            if not told[-1].why or len(postures) == 1:
                return maker.plan(told)
    followed = _followed(asked, postures)
    told += _found(maker, _coarse(maker.motion, followed, postures), first=search == "start")
    if all(one.why for one in told):  # whatever helps a solver, and what conflicts if nothing does
        told.append(maker.solved(postures[0], maker.motion.guess(followed, 0), thorough=True))
    return maker.plan(told)


def _checked(
    machine: Machine,
    tasks: Any,
    horizon: Any,
    start: Any,
    start_base: Any,
    cyclic: Any,
    weights: Any,
    limits: Any,
    search: Any,
    seed: Any,
    time_cost: Any,
) -> _Asked:
    checked_choice("search", search, get_args(Search))
    checked_flag("cyclic", cyclic)
    checked_count("seed", seed, 0, LARGEST_SEED)
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    equations = bind(machine, given)
    told = Limits() if limits is None else checked_instance("limits", limits, Limits)
    free = isinstance(horizon, str)
    if free:
        checked_choice("horizon", horizon, ("free",))
    checked_positive("time_cost", time_cost)
    for what in ("acceleration", "jerk", "torque"):
        if getattr(told, what) is not None:
            words = f"limits: least joint velocity knows no {what}; leave it out, and schedule the path under it"
            raise ProblemError(words, name=what, value=getattr(told, what))
    if horizon is None or free:
        ends = [task.end for task in given if task.duration is not None]
        if not ends:
            words = "horizon is missing: no task says how long it lasts; give plan(..., horizon=...) in s"
            raise ProblemError(words, name="horizon")
        horizon = max(ends)
    duration = checked_horizon(horizon)
    place = checked_configuration(machine, np.zeros(machine.joint_size), start_base)[1]
    joints = None if start is None else checked_configuration(machine, start, start_base)[0]
    stretches = stretches_of(machine, given, duration)
    middle = np.zeros(machine.joint_size) if joints is None else joints
    for stretch in stretches:
        if stretch.equations is not None:
            first = stretch is stretches[0] and joints is not None
            checked_tasks(stretch.equations, place, middle, duration, start=first)
    del equations
    if joints is not None:
        _check_inside(machine, joints, told)
    heavy = checked_weights(weights, machine.joint_size)
    return _Asked(
        machine,
        given,
        duration,
        stretches,
        joints,
        place,
        heavy,
        told,
        cyclic,
        int(seed),
        float(time_cost) if free else None,
    )


def _check_inside(machine: Machine, joints: Array, limits: Limits) -> None:
    bounds = limits.bounds(machine)
    for name, value, low, high in zip(machine.robot.joint_names, joints, bounds.lower, bounds.upper, strict=True):
        if not low <= value <= high:
            words = f"start: {name!r} starts at {value:g}, outside its limits {low:g} .. {high:g}; start inside them"
            raise ProblemError(words, name=name, value=float(value), limit=(float(low), float(high)))


# ---- where to start ----------------------------------------------------------------------------------------------


def _postures(asked: _Asked) -> Array:
    """Joints at the start, the best conditioned first. Shape (K, n)."""
    if asked.start is not None:
        return asked.start[None]
    first = [asked.tasks[i] for i in asked.stretches[0].tasks if asked.tasks[i].is_pose]
    if not first:
        words = "start is missing: no task says by a pose where the tip is at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    options: dict[str, Any] = {"base": asked.base, "seed": asked.seed, "limits": asked.limits.joints, "starts": STARTS}
    try:
        found = inverse_kinematics(asked.machine, first, **options)
    except Unreachable as error:
        raise _placed(asked, error, 0.0) from error
    joints = np.array([posture.joints for posture in found])
    return joints


def _settled(asked: _Asked, postures: Array) -> tuple[Array, Array]:
    """Joints at the start, nan where they are free, and the postures moved to those that are told.

    An ignorable coordinate, by whose value nothing that is asked changes but the joint itself (the last joint of an arm
    whose roll is free turns about the tool's axis), has the middle of its range: with it free, every motion would be
    one of a family of the same cost.
    """
    bounds = asked.bounds
    start = np.full(asked.machine.joint_size, np.nan)
    with np.errstate(invalid="ignore"):
        middle = (bounds.lower + bounds.upper) / 2
    ignorable = np.ones(asked.machine.joint_size, dtype=bool)
    for stretch in asked.stretches:
        if stretch.equations is not None:
            ignorable &= ignorable_joints(stretch.equations, asked.base)
    start[ignorable] = np.where(np.isfinite(middle), middle, postures[0])[ignorable]
    return start, np.where(np.isnan(start), postures, start)


def _followed(asked: _Asked, postures: Array) -> list[Followed]:
    """The local motions from all postures through all stretches, with the least damping that lets one of them follow.

    Raises:
        Unreachable: A place on the way that no posture reaches.
    """
    bounds = asked.bounds
    best: list[Followed] = []
    for damping in DAMPINGS:
        found: list[Followed] = []
        base, joints = np.tile(asked.base, (len(postures), 1)), postures
        for stretch in asked.stretches:
            if stretch.begin > 0:
                joints = _begun(asked, stretch, base, joints)
                if asked.stretches[len(found) - 1].equations is None:
                    found[-1] = _straight(found[-1], joints)
            share = max(int(np.ceil(FOLLOWED * stretch.duration / asked.horizon)), LEAST_INTERVALS)
            times = np.union1d(np.linspace(stretch.begin, stretch.end, share + 1), stretch.breaks)
            equations = stretch.equations
            if equations is None:
                found.append(_resting(times, base, joints))
            else:
                soft: dict[str, Any] = {"weights": asked.weights, "damping": damping}
                found.append(follow(equations, joints, base, times, lower=bounds.lower, upper=bounds.upper, **soft))
            base, joints = found[-1].base[:, -1], found[-1].joints[:, -1]
        best = best or found
        if min(_misfits(found)) <= OUT_OF_REACH:
            return found
    _check_reach(asked, best)
    return best


def _begun(asked: _Asked, stretch: Stretch, base: Array, joints: Array) -> Array:
    """Joints (K, n) at which the poses that begin in a stretch are met, each the nearest to where it comes from.

    There they still do what was asked until then.
    """
    before = asked.stretches[asked.stretches.index(stretch) - 1]
    begins = [asked.tasks[i].is_pose and new for i, new in zip(stretch.tasks, stretch.new, strict=True)]
    if not any(begins):
        return joints
    tasks = [asked.tasks[i] for i in sorted({*before.tasks, *stretch.tasks})]
    options: dict[str, Any] = {"near": joints, "seed": asked.seed, "limits": asked.limits.joints, "starts": STARTS}
    try:
        found = inverse_kinematics(asked.machine, tasks, time=stretch.begin, base=base[0], **options)
    except Unreachable as error:
        if asked.machine.base_size:  # which may come nearer
            return joints
        raise _placed(asked, error, stretch.begin) from error
    ways = np.array([posture.joints for posture in found])
    far = (asked.weights * (joints[:, None] - ways) ** 2).sum(axis=2)
    return np.asarray(ways[far.argmin(axis=1)])


def _straight(part: Followed, joints: Array) -> Followed:
    """A motion without a task that leads straight to joints (K, n)."""
    share = ((part.t - part.t[0]) / (part.t[-1] - part.t[0]))[:, None]
    way = (joints - part.joints[:, 0])[:, None]
    rates = np.repeat(way / (part.t[-1] - part.t[0]), len(part.t), axis=1)
    return replace(part, joints=part.joints[:, :1] + share * way, rates=rates)


def _resting(times: Array, base: Array, joints: Array) -> Followed:
    """Where nothing is asked for nothing moves."""
    count, many = len(joints), len(times)
    still = np.zeros((count, many, joints.shape[1]))
    none = np.zeros(count)
    return Followed(
        times, np.repeat(base[:, None], many, axis=1), np.repeat(joints[:, None], many, axis=1), still, none, none, none
    )


def _misfits(followed: list[Followed]) -> list[float]:
    """Of each posture the largest pose error on its way."""
    return np.max([part.misfit for part in followed], axis=0).tolist()  # type: ignore[no-any-return]


def _check_reach(asked: _Asked, followed: list[Followed]) -> None:
    """Raise where no posture follows the tasks and no joints reach them, seen from a fixed base."""
    if asked.machine.base_size:
        return
    for stretch, part in zip(asked.stretches, followed, strict=True):
        poses = [
            asked.tasks[i] for i in stretch.tasks if asked.tasks[i].is_pose and asked.tasks[i].start_gap <= OUT_OF_REACH
        ]
        if not poses:
            continue
        lost = np.unique(part.lost_at[part.misfit > OUT_OF_REACH])
        for time in lost.tolist():
            near = part.joints[:, int(np.searchsorted(part.t, time))]
            try:
                inverse_kinematics(
                    asked.machine, poses, time=time, near=near, limits=asked.limits.joints, tolerance=OUT_OF_REACH
                )
            except Unreachable as error:
                raise _placed(asked, error, time) from error


def _placed(asked: _Asked, error: Unreachable, time: float) -> Unreachable:
    """The same with its time and the places that are asked for there."""
    places = []
    for number, task in enumerate(asked.tasks):
        if task.position is not None and task.begin <= time <= task.end:
            targets = np.array(bind(asked.machine, task).target_function()(time)).ravel()
            places.append(f"task {number} is at {np.round(targets[:3], 6).tolist()} m")
    where = f" ({', '.join(places)})" if places else ""
    return Unreachable(f"at {time:.4g} s{where}: {error}", **{**vars(error), "time": time})


# ---- solving -----------------------------------------------------------------------------------------------------


def _mesh(motion: ToolMotion, degree: int) -> Collocation:
    return Collocation(LEAST_INTERVALS if len(motion.breaks) < LEAST_INTERVALS else 1, degree).with_nodes_at(
        motion.breaks
    )


def _coarse(motion: ToolMotion, followed: list[Followed], postures: Array) -> list[Candidate]:
    """The motions that the postures lead to on a coarse mesh, the cheapest first; of those of one cost the first.

    The start being free, postures of one family lead to one motion. Those that the tasks cannot be followed from are
    tried where they can be followed from none.
    """
    prepared = _mesh(motion, COARSE).prepare(motion.problem, options=ROUGH)
    misfits, costs = np.array(_misfits(followed)), np.sum([part.cost for part in followed], axis=0)
    follows = misfits <= max(OUT_OF_REACH, misfits.min())
    found: list[Candidate] = []
    least = np.inf
    for number in np.lexsort((costs, ~follows)).tolist():
        joints = postures[number]
        if not follows[number] and np.isfinite(least):
            found.append(Candidate(joints, np.nan, "the tasks cannot be followed from there"))
            continue
        if costs[number] > FAR * least:
            found.append(Candidate(joints, float(costs[number]), "far dearer by its local motion"))
            continue
        solution = prepared.solve(guess=motion.guess(followed, number), check=False)
        if solution.success:
            least = min(least, solution.cost)
            found.append(Candidate(joints, solution.cost, "", solution))
        else:
            found.append(Candidate(joints, np.nan, f"no motion was found: {solution.status.split(':')[0]}"))
    found.sort(key=lambda one: np.inf if np.isnan(one.cost) else one.cost)
    return _once(motion, found)


def _once(motion: ToolMotion, found: list[Candidate]) -> list[Candidate]:
    """The same by rising cost; of those of one cost, or that are one motion, all but the first say so."""
    places = np.linspace(0.0, 1.0, 33)
    kept: list[tuple[float, Array]] = []
    for number, one in enumerate(found):
        if one.why or one.solution is None:
            continue
        sample = one.solution.at_fraction(places)
        path = np.hstack([sample[f"joints{stretch.suffix}"] for stretch in motion.stretches])
        if any(abs(one.cost - cost) <= SAME * cost or _near(path, other) for cost, other in kept):
            found[number] = replace(one, why=ALIKE)
        else:
            kept.append((one.cost, path))
    return found


def _near(path: Array, other: Array) -> bool:
    """Whether two motions (M, n) are one, but for what a coarse mesh misses and full turns of joints."""
    apart = path - other
    turns = 2 * np.pi * np.round(apart[0] / (2 * np.pi))
    return bool(np.abs(apart - turns).max() <= NEAR)


def _found(maker: _Maker, coarse: list[Candidate], first: bool) -> list[Candidate]:
    """What becomes on the fine mesh of the motions found on a coarse one; of the `first` that passes, or of all."""
    told = [one for one in coarse if one.why and one.why != ALIKE]
    alike = [one for one in coarse if one.why == ALIKE]
    least, beyond = np.inf, 0.0  # cost of the best, and how much the coarse mesh was wrong, as a share of it
    for candidate in (one for one in coarse if not one.why):
        if candidate.cost > least * (1 + beyond) or (first and np.isfinite(least)):
            told.append(replace(candidate, why="dearer on a coarse mesh", solution=None))
            continue
        # where the first one of its cost does not hold, another one may
        others = [one for one in alike if one.cost >= candidate.cost][:RESERVES]
        for one in (candidate, *others):
            solved = maker.solved(one.start, one.solution)
            told.append(solved)
            if not solved.why:
                beyond = max(beyond, 2 * abs(solved.cost - one.cost) / max(solved.cost, np.finfo(float).tiny))
                least = min(least, solved.cost)
                break
    named = {tuple(one.start) for one in told}
    return told + [replace(one, solution=None) for one in alike if tuple(one.start) not in named]


class _Maker:
    """Makes motions on the fine mesh, all of one prepared problem."""

    def __init__(self, asked: _Asked, start: Array, reference: Array) -> None:
        self.asked, self.reference = asked, reference
        self.free = bool(np.isnan(start).any())
        self.motion = self._declared(start)
        self.mesh = _mesh(self.motion, FINE)
        self._prepared: Prepared | None = None
        self.why: SolveError | None = None  # what the last solve failed of

    def _declared(self, start: Array) -> ToolMotion:
        asked = self.asked
        return tool_motion_problem(
            asked.machine,
            asked.stretches,
            base=asked.base,
            start=start,
            reference=self.reference,
            cyclic=asked.cyclic,
            weights=asked.weights,
            bounds=asked.bounds,
            time_cost=asked.time_cost,
        )

    def solved(self, start: Array, guess: Any, thorough: bool = False) -> Candidate:
        """A motion from a guess, and what is wrong with it; with `thorough` from other starts, too, and why if none.

        Where many starts do equally well, no one of them is decided to be the best; then the motion is judged from the
        start that was found.
        """
        if self._prepared is None:
            self._prepared = self.mesh.prepare(self.motion.problem, options=SOLVER)
        try:
            solution = self._prepared.solve(guess=guess, check=thorough)
            if not solution.success:
                return Candidate(start, np.nan, f"no motion was found: {solution.status.split(':')[0]}")
            solution, audit = self._audited(self.motion, solution)
            if self.free and audit.feasible and audit.optimal is None:
                first = solution[f"joints{self.motion.stretches[0].suffix}"][0]
                held = self._declared(first)
                again, other = self._audited(held, solve(held.problem, self._mesh_of(solution), guess=solution))
                if other.passed and again.cost <= solution.cost * (1 + SAME) + NOTHING * self.motion.horizon:
                    solution, audit = again, other
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            self.why = error
            return Candidate(start, np.nan, str(error).split("\n")[0], error.solution)
        if audit.passed:
            return Candidate(start, solution.cost, "", solution)
        worst = audit.failures[0] if audit.failures else None
        why = f"not decided: {audit.undecided}" if worst is None else f"the audit fails, {worst.name} {worst.value:.2g}"
        return Candidate(start, solution.cost, why, solution)

    def _audited(self, motion: ToolMotion, solution: Solution) -> tuple[Solution, Audit]:
        """A motion, refined where its audit or the way of its tips asks for it, and its audit."""
        audit: Audit = solution.audit()
        for _ in range(MESHES):
            if audit.failures:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RefinementWarning)
                    solution = refine(motion.problem, self._mesh_of(solution), guess=solution, options=SOLVER)
                audit = solution.audit()
                if audit.failures:
                    break
            strays = self._strays(motion, solution)
            if strays.max() <= TIP:
                break
            nodes = solution.state_interpolant.breaks
            cut = np.flatnonzero(strays > TIP / len(strays))
            nodes = np.union1d(nodes, (nodes[cut] + nodes[cut + 1]) / 2)
            solution = solve(motion.problem, self.mesh.with_mesh(nodes), guess=solution, options=SOLVER)
            audit = solution.audit()
        return solution, audit

    def _strays(self, motion: ToolMotion, solution: Solution) -> Array:
        """How far the tips are from their poses in each interval of the mesh, m and rad. Shape (N,)."""
        nodes = solution.state_interpolant.breaks
        at = np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(PLACES) / PLACES).ravel(), 1.0)
        sample, worst = solution.at_fraction(at), np.zeros(len(at))
        for stretch in motion.stretches:
            if stretch.equations is not None:
                base = sample[f"base{stretch.suffix}"] if self.asked.machine.base_size else None
                times, joints = stretch.begin + at * stretch.duration, sample[f"joints{stretch.suffix}"]
                sizes = np.cumsum([part.task.size for part in stretch.equations.bound])[:-1]
                errors = np.split(stretch.equations.errors(times, base, joints), sizes, axis=1)
                for part, own in zip(stretch.equations.bound, errors, strict=True):
                    if part.task.start_gap <= TIP:  # the feedback closes a larger one on the way
                        worst = np.maximum(worst, np.linalg.norm(own, axis=1))
                worst = np.maximum(worst, stretch.equations.overhangs(times, base, joints).max(axis=1, initial=0))
        return np.asarray(np.maximum(worst[:-1], worst[1:]).reshape(-1, PLACES).max(axis=1))

    def _mesh_of(self, solution: Solution) -> Collocation:
        return self.mesh.with_mesh(solution.state_interpolant.breaks)

    def plan(self, told: list[Candidate]) -> Plan:
        """The plan of the cheapest motion that passes, with the others and why they are not the plan.

        Raises:
            SolveError: None passes.
        """
        passing = [one for one in told if not one.why]
        if not passing:
            raise failed(told, self.why)
        best = min(passing, key=lambda one: one.cost)
        ended = [one if one is best or one.why else replace(one, why="dearer") for one in told]
        ended.sort(key=lambda one: (one is not best, np.inf if np.isnan(one.cost) else one.cost))
        assert best.solution is not None
        parts = parts_of(self.motion.stretches)
        if self.asked.time_cost is not None:
            parts = (parts[0]._replace(end=float(best.solution[CLOCK][-1, 0])),)
        return Plan(self.asked.machine, best.solution, parts, tuple(ended))
