"""Motions to several goals within actuator limits, and the solver of plans that satisfy their limits between the nodes.

A smooth plan of least effort needs few intervals. A plan of least time switches from limit to limit and gets nodes at
its switches. Where a limit is still exceeded between the nodes, it is tightened there (`ocp.tightening`). If that costs
too much, the mesh is refined there: the excess of a smooth plan decreases with the square of the interval.

The motion to each goal is a phase with its own machine. A load is picked up or put down at rest only: then the momentum
is zero before and after. Grasping a moving load is an impact; it needs a join of `Phases` declared by hand.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from models import FreeFloating, Machine
from ocp.audit.audit import Audit
from ocp.console import interruptible
from ocp.direct.discretisation import Collocation
from ocp.errors import ProblemError, SolveError, require
from ocp.methods import solve
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error, is_clearance, solve_with_clearance
from ocp.motion.builders.dynamics import DynamicsSetup, Motors, checked_motors, dynamics_problem
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.goals import Cost, Goal
from ocp.motion.tasks.limits import Limits
from ocp.problem.phases import DURATION, Phases
from ocp.problem.problem import Problem, remembers_request
from ocp.problem.values import constant
from ocp.refinement import split
from ocp.solution import Guess, Solution
from ocp.switching import WARM_START_OPTIONS, solve_at_switches
from ocp.tightening import largest_excess, tighten


@remembers_request("dynamics phases")
@interruptible
def dynamics_phases(
    machine: Motors,
    goals: Sequence[Goal],
    *,
    start: Any,
    total: float | None = None,
    limits: Limits | None = None,
    cost: Cost | None = None,
    setup: DynamicsSetup | None = None,
) -> Phases:
    """Declare the optimal control problem of motions to consecutive goals, one phase each, at the least total cost.

    Args:
        machine: Machine during the motion to the first goal, unless the goal has its own.
        goals: At least one, each with joints and a duration; all have the joints of the machine.
        start: Start configuration. Shape (n,), rad or m.
        total: Duration of all phases together, s, if some have a free time; None leaves it free.
        limits, cost, setup: Arguments of `dynamics_problem` for all phases. Velocity and base at the start and base at
            the end are those of the whole motion, clearance applies where the machine is that of the collision scene,
            and the goals give their velocities themselves.

    Raises:
        ProblemError: As `dynamics_problem`; there are no goals; one is a pose, or has no duration; their machines
            differ in the number of joints or in the kind of base; the machine changes while it moves or has momentum; a
            phase with tasks starts at unknown joints; the total duration is impossible; the setup has an
            `end_velocity`.
    """
    goals = checked_goals(goals)
    setup = DynamicsSetup() if setup is None else require.instance("dynamics_phases: setup", setup, DynamicsSetup)
    if setup.end_velocity != "rest":
        words = "end_velocity: every goal has its own; set Goal(velocity=...)"
        raise ProblemError(words, name="end_velocity", value=setup.end_velocity)
    clearance = setup.clearance_constraints
    names = phase_names(goals)
    machines, problems = machines_of(machine, goals), {}
    begin: Any = start
    for k, (name, goal) in enumerate(zip(names, goals, strict=True)):
        known = begin is not None and not np.isnan(np.asarray(begin, dtype=float)).any()
        if k and not known and not (isinstance(goal.tasks, Sequence) and not goal.tasks):
            words = f"{name}: its tasks begin where {names[k - 1]!r} ends; give all joints there"
            raise ProblemError(words, name=name, value=begin)
        own = replace(
            setup,
            start_velocity=setup.start_velocity if k == 0 else goals[k - 1].velocity,
            end_velocity=goal.velocity,
            start_base=setup.start_base if k == 0 else np.full(machines[k].base_size, np.nan),
            end_base=goal.base if goal.base is not None else setup.end_base if k == len(goals) - 1 else None,
            clearance_constraints=clearance if clearance and clearance.scene.machine is machines[k] else None,
        )
        problems[name] = dynamics_problem(
            machines[k], goal.tasks, goal.duration, start=begin, end=goal.joints, limits=limits, cost=cost, setup=own
        )
        begin = goal.joints
    phases = Phases("motions to goals", problems)
    for k in range(1, len(goals)):
        _join(phases, names[k - 1], names[k], goals[k - 1])
    if total is not None:
        duration = require.positive("horizon", total)
        if not any(isinstance(goal.duration, FreeTime) for goal in goals):
            words = "total: every goal has a fixed duration; give one of them FreeTime(...)"
            raise ProblemError(words, name="total", value=total)
        last = phases[names[-1]]
        phases.end("total time", last.begin + last.duration - duration, lower=0.0, upper=0.0, unit="s")
    return phases


def checked_goals(goals: Any) -> tuple[Goal, ...]:
    """Return goals as a tuple; raise ProblemError if one has no duration or no joints, or if two have the same name."""
    checked = tuple(require.each("goals", goals, Goal))
    if not checked:
        raise ProblemError("goals: at least one is needed", name="goals", value=goals)
    names = phase_names(checked)
    if len(set(names)) < len(names):
        raise ProblemError(f"goals: names {list(names)} are not all different", name="goals", value=names)
    for name, goal in zip(names, checked, strict=True):
        if goal.duration is None:
            words = f"{name}: a goal before others needs a duration in s, or FreeTime(...)"
            raise ProblemError(words, name="duration", value=None)
        if goal.has_pose:
            words = f"{name}: joints are needed here; inverse_kinematics(machine, goal.task) finds some for the pose"
            raise ProblemError(words, name="joints", value=None)
    return checked


def phase_names(goals: Sequence[Goal]) -> tuple[str, ...]:
    """Return the names of the phases that lead to goals: the name of each goal or, without one, "leg" and a number."""
    return tuple(goal.name or f"leg {k + 1}" for k, goal in enumerate(goals))


def machines_of(machine: Motors, goals: Sequence[Goal]) -> tuple[Motors, ...]:
    """Return the machine of each phase of a motion to consecutive goals, where loads may be picked up or put down.

    Raises:
        ProblemError: The machine changes its joints or its kind of base, or while it moves or has momentum.
    """
    machines, names = [checked_motors("dynamics_phases", machine)], phase_names(goals)
    for k, (name, goal) in enumerate(zip(names, goals, strict=True)):
        before = machines[-1]
        own = before if goal.machine is None else checked_motors(name, goal.machine)
        if (own.joint_size, own.base_size) != (before.joint_size, before.base_size):
            words = f"{name}: its machine has {own.joint_size} joints and a base of {own.base_size}, the one before "
            words += f"{before.joint_size} and {before.base_size}"
            raise ProblemError(words, name=name, value=own.joint_size, limit=before.joint_size)
        if k and own is not before:
            if not _rests(goals[k - 1]):
                words = f"{name}: a load is picked up or put down at rest; let {names[k - 1]!r} end at rest"
                raise ProblemError(words, name=name, value=goals[k - 1].velocity, limit="rest")
            for each in (own, before):
                if isinstance(each, FreeFloating) and np.any(np.asarray(each.conserved_momentum)):
                    words = f"{name}: a machine that picks up or puts down a load must have no momentum"
                    raise ProblemError(words, name="conserved_momentum", value=each.conserved_momentum, limit=0.0)
        machines.append(own)
    return tuple(machines[1:])


def _rests(goal: Goal) -> bool:
    """Return whether the machine must be at rest at a goal."""
    return isinstance(goal.velocity, str) and goal.velocity == "rest"


def _join(phases: Phases, before: str, after: str, goal: Goal) -> None:
    """Make the states continuous between two phases, except states whose values the goal between the phases fixes."""
    fixed: dict[str, Any] = {}
    if goal.joints is not None and not np.isnan(np.asarray(goal.joints, dtype=float)).any():
        fixed["joints"] = None
    if _rests(goal):
        fixed |= {"velocities": None, "accelerations": None}
    states = [name for name in phases.of(after) if f"{after}.{name}" in phases.declared.states and name != DURATION]
    if any(name not in fixed for name in states):
        phases.join(before, after, {name: value for name, value in fixed.items() if name in states})


POINTS = Collocation(20, degree=5, scheme="legendre")
IPOPT = {"max_iter": 300}
BARRIERS = 0.1, 1e-10
"""Default initial barrier parameter of IPOPT, and the tolerance at which the barrier parameter ends."""
LABELS = r"(?P<phase>[^.;:,\n]*?\.)?(?P<quantity>joints|velocities|accelerations|jerks|torques|power)\[(?P<row>\d+)\]"
"""Regular expression of constraint labels such as "torques[1]", with or without the name of a phase."""


@dataclass(frozen=True)
class MeshSettings:
    """Settings of the search for a plan that satisfies its limits between the nodes of the mesh."""

    meshes: int = 3  # largest number of meshes, each finer than the one before
    splits: int = 3  # number of parts of an interval whose tightened limit costs too much
    excess: float = 1e-5  # largest excess of a limit between the nodes, in its own unit
    cost_increase: float = 1e-3  # largest relative increase of the cost by tightened limits


MESH_SETTINGS = MeshSettings()


@dataclass(frozen=True, eq=False)
class SolveSettings:
    """Settings of a solve that is audited and, if the audit fails, repeated on finer meshes."""

    method: Collocation | None = None  # first mesh; None for that of the planner
    options: Mapping[str, Any] | None = None  # of IPOPT
    tolerances: Mapping[str, float] | None = None  # of the audit by name, see `ocp.audit.audit.audit`
    guess_cost: float = np.inf  # cost of the initial guess, see `barrier_options`; infinite if unknown

    def __post_init__(self) -> None:
        if self.method is not None:
            require.instance("method", self.method, Collocation)
        require.mapping("options", self.options)
        if self.guess_cost != np.inf:
            require.nonnegative("guess_cost", self.guess_cost)

    @property
    def ipopt_options(self) -> dict[str, Any]:
        """IPOPT options given by the user, completed by the defaults of the planner."""
        return {**IPOPT, **(self.options or {})}

    def options_from(self, problem: Problem, mesh: Collocation, guess: Guess) -> dict[str, Any]:
        """Return the IPOPT options for a guess; options given by the user override those that suit the guess."""
        suitable = WARM_START_OPTIONS if isinstance(guess, Solution) else {}
        return {**barrier_options(problem, mesh, self.guess_cost, suitable), **self.ipopt_options}


def audit_error(audit: Audit, solution: Solution) -> SolveError:
    """Return an error about the failed check of an audit whose value exceeds its tolerance by the largest factor."""
    worst = max(audit.failures, key=lambda row: row.value / row.limit if row.limit else np.inf)
    words = f"the audit fails: {worst.name} {worst.value:.2g}"
    return SolveError(words, solution, name=worst.name, value=worst.value, limit=worst.limit, time=worst.time)


def barrier_options(problem: Problem, mesh: Collocation, cost: float, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of IPOPT with an initial barrier parameter that suits a guess of known, finite cost.

    An interior-point method with barrier parameter mu leads to a point whose cost exceeds the least one by mu for each
    limit (Boyd, Vandenberghe 2004, section 11.2.2). If that is more than the cost of the guess, the barrier alone
    determines the result: a motion far away from all limits.
    """
    declared = problem.declared
    bounded: list[Any] = [*declared.states.values(), *declared.controls.values(), *declared.path.values()]
    limits = [np.array([constant(each.lower), constant(each.upper)]) for each in bounded]
    limit_count = sum(int(np.isfinite(pair[:, pair[0] < pair[1]]).sum()) for pair in limits)
    if not np.isfinite(cost) or not limit_count:
        return dict(options)
    largest, (default, smallest) = cost / (limit_count * mesh.intervals * mesh.degree), BARRIERS
    return {**options, "mu_init": max(min(options.get("mu_init", default), largest), smallest)}


def within_limits(
    declare: Callable[[ClearanceConstraints | None], Problem],
    clearance_constraints: ClearanceConstraints | None,
    machines: Mapping[str, tuple[Machine, Limits | None]],
    *,
    settings: SolveSettings | None = None,
    guess: Guess = None,
) -> Solution:
    """Solve a problem on finer and finer meshes until a plan passes its audit and satisfies its limits everywhere.

    The limits hold between the nodes, too, to 1e-5 of their units. If no plan passes, the feasible plan of least cost
    is returned; its optimality is then undetermined, or it costs too much, by about its `tightening_cost`.

    Args:
        declare: Declares the problem under clearance constraints.
        machines: Machine and limits by the name of the phase, "" without phases. Messages take joint names from them.
        settings, guess: First mesh, solver options and audit tolerances; guess of the first solve.

    Raises:
        SolveError: No plan satisfies its limits; the message has the result of each attempt.
    """
    own = SolveSettings() if settings is None else require.instance("settings", settings, SolveSettings)
    mesh = own.method or POINTS

    in_collision: Solution | None = None  # the last plan, if only its clearance failed

    def solve_problem(problem: Problem, begin: Guess) -> Solution:
        nonlocal in_collision
        try:
            return _first_within_limits(problem, mesh, own, begin)
        except SolveError as error:
            in_collision = error.solution if is_clearance(error.name) else None
            if begin is guess or in_collision is not None:
                raise
        return solve_problem(problem, guess)

    def run(clearance_constraints: ClearanceConstraints | None) -> Solution:
        return solve_problem(declare(clearance_constraints), in_collision or guess)

    try:
        return solve_with_clearance(clearance_constraints, run)
    except SolveError as error:
        raise _with_joint_names(error, machines) from error


def _first_within_limits(problem: Problem, mesh: Collocation, settings: SolveSettings, begin: Guess) -> Solution:
    """Return the first plan on finer and finer meshes that passes its audit, or else the feasible plan of least cost;
    raise SolveError if there is none, or if a plan fails only because of collisions.
    """
    reasons: list[str] = []
    failure, last, guess = SolveError(), None, begin
    feasible, costly = list[Solution](), list[tuple[Collocation, Solution]]()
    for _ in range(MESH_SETTINGS.meshes):
        for variant, plan in _attempts(problem, mesh, settings, guess):
            name = f"{mesh.intervals} intervals{variant}"
            if isinstance(plan, SolveError):
                reasons.append(f"{name}: {plan}")
                failure, last = plan, plan.solution or last
                if plan.solution is not None and plan.solution.success:
                    guess = plan.solution
                    costly.append((mesh, guess))
                continue
            audit = plan.audit(tolerances=settings.tolerances)
            if audit.passed:
                return plan
            if collision := collision_error(audit, plan):
                raise collision
            guess = last = plan
            feasible += [plan] if audit.feasible else []
            if audit.failures:
                failure = audit_error(audit, plan)
                reasons.append(f"{name}: {failure}")
        if guess is begin or not isinstance(guess, Solution):
            break
        mesh = _finer(mesh, guess, failure)
    tightened = list[Solution]()
    while costly and not tightened:  # tightened at any cost, on the finest mesh on which that is feasible
        finest = costly[-1][0]
        for plan in [plan for own, plan in costly if own is finest]:
            own = finest.with_mesh(plan.control_interpolant.breaks)
            with suppress(SolveError):
                options = settings.options_from(problem, mesh, plan)
                plan = tighten(problem, own, tolerance=MESH_SETTINGS.excess, options=options, guess=plan)
                audit = plan.audit(tolerances=settings.tolerances)
                tightened += [plan] if audit.feasible else []
                reasons.append(f"{finest.intervals} intervals, tightened at any cost: {audit.sentence}")
        costly = [each for each in costly if each[0] is not finest]
    if feasible or tightened:
        return min(feasible + tightened, key=lambda plan: plan.cost)
    words = "no plan satisfies its limits and passes its audit:\n" + "\n".join(reasons)
    details = {"name": failure.name, "value": failure.value, "limit": failure.limit, "time": failure.time}
    raise SolveError(words, last, failure.conflicts, **details)


def _attempts(
    problem: Problem, mesh: Collocation, settings: SolveSettings, guess: Guess
) -> Iterator[tuple[str, Solution | SolveError]]:
    """Solve a problem on a mesh, then with nodes at switching times; yield a label and the plan or error of each."""
    try:
        plan = solve(problem, mesh, options=settings.options_from(problem, mesh, guess), guess=guess)
    except SolveError as error:
        yield "", error
        return
    warm = settings.options_from(problem, mesh, plan)
    yield "", _tighten_limits(problem, mesh, plan, warm)
    switched = solve_at_switches(problem, mesh, plan, options=warm)
    if switched is not plan:
        yield ", with nodes at its switches", _tighten_limits(problem, mesh, switched, warm)


def _tighten_limits(
    problem: Problem, mesh: Collocation, plan: Solution, settings: Mapping[str, Any]
) -> Solution | SolveError:
    """Tighten limits until a plan satisfies the original ones between mesh nodes; return this plan, or the error."""
    if largest_excess(problem, plan) <= MESH_SETTINGS.excess:
        return plan
    own, largest = (
        mesh.with_mesh(plan.control_interpolant.breaks),
        plan.cost + MESH_SETTINGS.cost_increase * abs(plan.cost),
    )
    try:
        result = tighten(problem, own, tolerance=MESH_SETTINGS.excess, options=settings, guess=plan, max_cost=largest)
    except SolveError as error:
        return error
    if result.cost <= largest:
        return result
    words = f"limits tightened between the nodes raise the cost from {plan.cost:.6g} to {result.cost:.6g}"
    return SolveError(words, result, name="cost", value=result.cost, limit=largest)


def _finer(mesh: Collocation, plan: Solution, failure: SolveError) -> Collocation:
    """Return a finer mesh: split the intervals whose tightened limits raise the cost too much, or else halve all."""
    if plan.bound_tightening is None or failure.solution is not plan or failure.name != "cost":
        return mesh.halve()
    nodes, amounts = plan.control_interpolant.breaks, plan.bound_tightening.max(axis=(0, 2))
    parts = np.where(amounts > 0, MESH_SETTINGS.splits, 1)
    return mesh.with_mesh(split(nodes, parts, amounts, MESH_SETTINGS.splits * len(amounts)))


def _with_joint_names(error: SolveError, machines: Mapping[str, tuple[Machine, Limits | None]]) -> SolveError:
    """Return an error with the names of joints in place of their indices: "torques of 'elbow'" for "torques[1]"."""

    def joint_label(label: re.Match[str]) -> str:
        phase, quantity, row = label["phase"] or "", label["quantity"], int(label["row"])
        if phase.removesuffix(".") not in machines:
            return label[0]
        machine, limits = machines[phase.removesuffix(".")]
        names = list(machine.robot.joint_names)
        if quantity == "torques":
            limited_machines = np.isfinite((limits or Limits()).bounds(machine).torque)
            names = [name for name, own in zip(names, limited_machines, strict=True) if own]
        return f"{phase}{quantity} of {names[row]!r}" if row < len(names) else label[0]

    rows = re.compile(LABELS)
    name = None if error.name is None else rows.sub(joint_label, str(error.name))
    details = {"name": name, "value": error.value, "limit": error.limit, "time": error.time}
    return SolveError(rows.sub(joint_label, str(error)), error.solution, error.conflicts, **details)
