"""Motions by their drives, solved and audited: plans that hold their limits everywhere, or the reasons why none does.

A smooth plan, of least effort, needs few intervals. One of least time jumps from limit to limit, and has nodes at its
jumps (`ocp.switching`). Where a plan still goes beyond a limit between its nodes, the limit is drawn in there
(`ocp.tightening`), which costs little on a mesh that is fine enough; else the mesh is cut: where limits that are drawn
in cost too much there alone, for a plan that only touches a limit goes beyond it with the square of the width.

Motions of several legs: through points on the way, and with loads that are picked up and put down.

Each leg is a phase of its own, `dynamics_problem` with the machine that moves on it, from where the leg before ended.
What goes on from one into the next are the joints and how the base lies, the velocities where the machine does not rest
there, and the accelerations where the jerk is the control.

A load that is picked up or put down changes the machine. It does so at rest: then nothing has to be brought to speed,
joints and base stay where they are, and the momentum of a machine that floats, which is zero before, is zero after,
too. A load that is grasped while it moves jumps in velocity, as after an impact; that is a join of `Phases` to be said
by hand.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np

from models import FreeFloating, Machine
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.errors import (
    ProblemError,
    SolveError,
    checked_choice,
    checked_each,
    checked_instance,
    checked_mapping,
    checked_text,
)
from ocp.methods import solve
from ocp.motion.builders.actuator_limits import Motors, checked_motors
from ocp.motion.builders.clearance import (
    ClearanceConstraints,
    Kept,
    collision_error,
    of_clearance,
    solve_with_clearance,
)
from ocp.motion.builders.dynamics import AskedOfDrives, dynamics_problem
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.checks import checked_horizon
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.phases import DURATION, Phases
from ocp.problem.problem import Problem
from ocp.refinement import split
from ocp.solution import Solution
from ocp.switching import WARM_START_OPTIONS, solve_at_switches
from ocp.tightening import largest_excess, tighten

__all__ = ["Leg", "breaks_of", "checked_legs", "dynamics_phases", "plan_dynamics", "within_limits"]


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a motion, to a point at which something changes or that is to be passed.

    Attributes:
        joints: Where it ends, rad or m, shape (n,); nan where free, None: all are.
        horizon: How long it takes, s, or FreeTime(...).
        end: Whether the joints are at rest at its end, or free to move on through it.
        machine: What moves on it, `with_load` or without; None: as on the leg before.
        tasks: What the tips do on it, of the time since its beginning, which is at joints that are told.
        name: Of its phase; "leg 1", "leg 2", ... if "".
    """

    joints: Any
    horizon: float | FreeTime
    end: Literal["rest", "free"] = "rest"
    machine: Motors | None = None
    tasks: TipTask | Sequence[TipTask] = ()
    name: str = ""


@interruptible
def dynamics_phases(
    machine: Motors,
    start_joints: Any,
    legs: Sequence[Leg],
    *,
    total: float | None = None,
    clearance_constraints: ClearanceConstraints | None = None,
    **asked: Unpack[AskedOfDrives],
) -> Phases:
    """Legs one after the other as one problem, at the least cost of all together.

    Args:
        machine: On the first leg, unless that says its own.
        start_joints: Shape (n,), rad or m.
        legs: At least one; all have the joints of the machine.
        total: Time of all legs together, s, where theirs are free; None: as long as is best.
        clearance_constraints: What the motion has to stay clear of, on legs whose machine is that of its surroundings.
        asked: Of all legs, as of `dynamics_problem`; `start` and `start_base` where the first begins, `end_base`
            where the last ends.

    Raises:
        ProblemError: As `dynamics_problem`; no legs, another number of joints or another kind of base, a machine that
            changes where it does not rest or carries momentum, a leg with tasks from joints that are not told, a total
            that the legs cannot have, what a leg says itself.
    """
    given = checked_legs(legs)
    if clearance_constraints is not None:
        checked_instance("dynamics_phases: clear", clearance_constraints, ClearanceConstraints)
    for what in ("end_joints", "tasks", "end"):
        if what in asked:
            raise ProblemError(f"{what}: legs say it themselves, Leg({what}=...)", name=what, value=asked.get(what))
    names = [leg.name or f"leg {k + 1}" for k, leg in enumerate(given)]
    if len(set(names)) < len(names):
        raise ProblemError(f"legs: names {names} are not all different", name="legs", value=names)
    movers, problems = _machines(machine, given, names), {}
    options: dict[str, Any] = {
        name: value for name, value in asked.items() if name not in ("start", "start_base", "end_base")
    }
    begin: Any = start_joints
    for k, (name, leg) in enumerate(zip(names, given, strict=True)):
        known = begin is not None and not np.isnan(np.asarray(begin, dtype=float)).any()
        if k and not known and not (isinstance(leg.tasks, Sequence) and not leg.tasks):
            words = f"{name}: its tasks begin where the leg before ends; tell all joints there"
            raise ProblemError(words, name=name, value=begin)
        own: dict[str, Any] = {"start": asked.get("start", "rest") if k == 0 else given[k - 1].end}
        own["start_base"] = asked.get("start_base") if k == 0 else np.full(movers[k].base_size, np.nan)
        if k == len(given) - 1:
            own["end_base"] = asked.get("end_base")
        kept = (
            clearance_constraints
            if clearance_constraints is not None and clearance_constraints.scene.machine is movers[k]
            else None
        )
        problems[name] = dynamics_problem(
            movers[k],
            begin,
            leg.horizon,
            end_joints=leg.joints,
            tasks=leg.tasks,
            end=leg.end,
            clearance_constraints=kept,
            **own,
            **options,
        )
        begin = leg.joints
    phases = Phases("legs", problems)
    for k in range(1, len(given)):
        _join(phases, names[k - 1], names[k], given[k - 1])
    if total is not None:
        duration = checked_horizon(total)
        if not any(isinstance(leg.horizon, FreeTime) for leg in given):
            words = "total: every leg tells its own time; let one of them be free"
            raise ProblemError(words, name="total", value=total)
        last = phases[names[-1]]
        phases.end("total time", last.begin + last.duration - duration, lower=0.0, upper=0.0, unit="s")
    return phases


def checked_legs(legs: Any) -> tuple[Leg, ...]:
    """Legs as a tuple.

    Raises:
        ProblemError: None, or something else; ends that are neither at rest nor free, a name that is no text.
    """
    given = checked_each("legs", legs, Leg)
    if not given:
        raise ProblemError("legs: at least one is needed", name="legs", value=legs)
    for leg in given:
        checked_choice("leg: end", leg.end, ("rest", "free"))
        checked_text("leg: name", leg.name)
    return tuple(given)


def _machines(machine: Motors, legs: Sequence[Leg], names: Sequence[str]) -> list[Motors]:
    """What moves on each leg."""
    found = [checked_motors("dynamics_phases", machine)]
    for k, (name, leg) in enumerate(zip(names, legs, strict=True)):
        own = found[-1] if leg.machine is None else checked_motors(name, leg.machine)
        before = found[-1]
        if (own.joint_size, own.base_size) != (before.joint_size, before.base_size):
            words = f"{name}: its machine has {own.joint_size} joints and a base of {own.base_size}, the one before "
            words += f"{before.joint_size} and {before.base_size}"
            raise ProblemError(words, name=name, value=own.joint_size, limit=before.joint_size)
        if k and own is not before:
            if legs[k - 1].end != "rest":
                words = f"{name}: a load is picked up or put down at rest; say Leg(end='rest') of {names[k - 1]!r}"
                raise ProblemError(words, name=name, value=legs[k - 1].end, limit="rest")
            for one in (own, before):
                if isinstance(one, FreeFloating) and np.any(np.asarray(one.conserved_momentum)):
                    words = f"{name}: a load that is at rest is picked up by a machine without momentum"
                    raise ProblemError(words, name="conserved_momentum", value=one.conserved_momentum, limit=0.0)
        found.append(own)
    return found[1:]


def _join(phases: Phases, before: str, after: str, leg: Leg) -> None:
    """What of one leg goes on in the next: all that is not told at both ends already."""
    told: dict[str, Any] = {}
    if leg.joints is not None and not np.isnan(np.asarray(leg.joints, dtype=float)).any():
        told["joints"] = None
    if leg.end == "rest":
        told |= {"velocities": None, "accelerations": None}
    states = [name for name in phases.of(after) if f"{after}.{name}" in phases.declared.states and name != DURATION]
    if any(told.get(name, "joined") is not None for name in states):
        phases.join(before, after, {name: value for name, value in told.items() if name in states})


POINTS = Collocation(20, degree=5, scheme="legendre")
IPOPT = {"max_iter": 300}
ROWS = r"(?P<phase>[^.;:,\n]*?\.)?(?P<what>joints|velocities|accelerations|jerks|torques|power)\[(?P<row>\d+)\]"
"""Labels of the rows of joints, in a phase or without one."""


@dataclass(frozen=True)
class HoldingSettings:
    """How limits are made to hold between the nodes of a mesh.

    Attributes:
        meshes: That are tried, each finer than the one before.
        pieces: Of an interval in which a tightened limit costs too much: its cost falls to a ninth.
        held: By how much a limit may be exceeded between the nodes, in its own unit.
        dearer: Share of its cost that a plan may cost more for tightened limits; nodes where it switches mend more.
    """

    meshes: int = 3
    pieces: int = 3
    held: float = 1e-5
    dearer: float = 1e-3


HOLDING = HoldingSettings()


@interruptible
def plan_dynamics(
    machine: Motors,
    start_joints: Any,
    horizon: float | FreeTime | Sequence[Leg],
    *,
    total: float | None = None,
    method: Collocation | None = None,
    options: Mapping[str, Any] | None = None,
    tolerances: Mapping[str, float] | None = None,
    clearance_constraints: ClearanceConstraints | None = None,
    **asked: Unpack[AskedOfDrives],
) -> Solution:
    """Solve `dynamics_problem`, or the legs of `dynamics_phases`, and audit the plan.

    Its limits hold between the nodes, too, to 1e-5 of their units.

    The first plan that passes its audit is returned; where none does, the cheapest that holds everything: it is not
    decided to be a minimum, or costs too much, by about its `tightening_cost`. Least time alone,
    `Effort(torque=0, time=1)`, leaves open what joints do that need not hurry, so that no plan is decided to be the
    best: a small weight of accelerations or torques beside it says it.

    Args:
        machine, start_joints, clearance_constraints, asked: As for `dynamics_problem`.
        horizon: Final time, s, or FreeTime(...); or the legs of the motion, each with its own: the plan has a phase for
            each then, `plan.phase(name)`. total: Of legs, see `dynamics_phases`.
        method: The first mesh, controls at the points; 20 Legendre intervals of degree 5 if None, with nodes where
            the tasks' pieces meet. Up to two more are tried, each twice as fine, or finer where it has to be.
        options: Of IPOPT. tolerances: Of the audit, by name, see `ocp.audit.audit.audit`.

    Raises:
        SolveError: No plan holds its limits; says what became of each attempt, and names the joint, the time and the
            limit where one is in the way.
        ProblemError: As `dynamics_problem` and `dynamics_phases`.
    """
    if isinstance(horizon, Sequence) and not isinstance(horizon, str):
        legs = checked_legs(horizon)
        driven, mover = {}, machine
        for k, leg in enumerate(legs):
            mover = leg.machine or mover
            driven[leg.name or f"leg {k + 1}"] = mover, asked.get("limits")

        def all_legs(clearance_constraints: ClearanceConstraints | None) -> Problem:
            return dynamics_phases(
                machine, start_joints, legs, total=total, clearance_constraints=clearance_constraints, **asked
            )

        return within_limits(all_legs, clearance_constraints, method, (), options, tolerances, driven)
    if total is not None:
        raise ProblemError("total: of legs alone; the horizon is the whole time", name="total", value=total)

    def declare(clearance_constraints: ClearanceConstraints | None) -> Problem:
        return dynamics_problem(machine, start_joints, horizon, clearance_constraints=clearance_constraints, **asked)

    at = () if isinstance(horizon, FreeTime) else breaks_of(asked.get("tasks", ()), checked_horizon(horizon))
    return within_limits(
        declare, clearance_constraints, method, at, options, tolerances, {"": (machine, asked.get("limits"))}
    )


def breaks_of(tasks: TipTask | Sequence[TipTask], horizon: float) -> Sequence[float]:
    """Fractions of a horizon at which tasks are less smooth."""
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    times = np.unique(np.concatenate([np.zeros(0), *(task.begin + np.asarray(task.breaks) for task in given)]))
    return [float(at) for at in times / horizon if 0 < at < 1]


def within_limits(
    declare: Callable[[Kept], Problem],
    clearance_constraints: Kept,
    method: Collocation | None,
    breaks: Sequence[float],
    options: Mapping[str, Any] | None,
    tolerances: Mapping[str, float] | None,
    driven: Mapping[str, tuple[Machine, Limits | None]],
) -> Solution:
    """The plan of a problem that holds its limits between the nodes and passes its audit; see `plan_dynamics`.

    Args:
        declare: Makes the problem, with what it has to stay clear of.
        breaks: Fractions of the horizon with nodes.
        driven: Machine and limits by the name of the phase, "" where there are no phases: to name joints by.
    """
    mesh = POINTS if method is None else checked_instance("method", method, Collocation)
    settings = {**IPOPT, **checked_mapping("options", options)}
    mesh = mesh.with_nodes_at(breaks)

    touching: Solution | None = None  # what was planned before, the bodies not held apart enough

    def planned(problem: Problem, guess: Solution | None) -> Solution:
        nonlocal touching
        try:
            return _first_that_holds(problem, mesh, settings, tolerances, guess)
        except SolveError as error:
            touching = error.solution if of_clearance(error.name) else None
            if guess is None or touching is not None:
                raise
        return planned(problem, None)

    def run(clearance_constraints: Kept) -> Solution:
        return planned(declare(clearance_constraints), touching)

    try:
        return solve_with_clearance(clearance_constraints, run)
    except SolveError as error:
        raise _by_joint(error, driven) from error


def _first_that_holds(
    problem: Problem,
    mesh: Collocation,
    settings: Mapping[str, Any],
    tolerances: Mapping[str, float] | None,
    guess: Solution | None,
) -> Solution:
    """The plan of `within_limits`, of several meshes, from that of the problem with bodies held less apart.

    Raises:
        SolveError: As it does; at once where a plan is sound but for bodies that touch.
    """
    reasons: list[str] = []
    why, last, begin = SolveError(), None, guess
    feasible, dear = list[Solution](), list[tuple[Collocation, Solution]]()
    for _ in range(HOLDING.meshes):
        for what, plan in _attempts(problem, mesh, settings, guess):
            name = f"{mesh.intervals} intervals{what}"
            if isinstance(plan, SolveError):
                reasons.append(f"{name}: {plan}")
                why, last = plan, plan.solution or last
                if plan.solution is not None and plan.solution.success:
                    guess = plan.solution
                    dear.append((mesh, guess))
                continue
            audit = plan.audit(tolerances=tolerances)
            if audit.passed:
                return plan
            if touching := collision_error(audit, plan):
                raise touching
            guess = last = plan
            feasible += [plan] if audit.feasible else []
            if audit.failures:
                worst = max(audit.failures, key=lambda row: row.value / row.limit if row.limit else np.inf)
                details = {"value": worst.value, "limit": worst.limit, "time": worst.time}
                why = SolveError(f"the audit fails, {worst.name} {worst.value:.2g}", plan, name=worst.name, **details)
                reasons.append(f"{name}: {why}")
        if guess is None or guess is begin:
            break
        mesh = _finer(mesh, guess, why)
    held = list[Solution]()
    while dear and not held:  # what no mesh makes cheap is held at its cost, on the last one where that can be
        finest = dear[-1][0]
        for plan in [plan for own, plan in dear if own is finest]:
            own = finest.with_mesh(plan.control_interpolant.breaks)
            with suppress(SolveError):
                plan = tighten(
                    problem, own, tolerance=HOLDING.held, options={**WARM_START_OPTIONS, **settings}, guess=plan
                )
                audit = plan.audit(tolerances=tolerances)
                held += [plan] if audit.feasible else []
                reasons.append(f"{finest.intervals} intervals, at whatever cost: {audit.sentence}")
        dear = [each for each in dear if each[0] is not finest]
    if feasible or held:
        return min(feasible + held, key=lambda plan: plan.cost)
    words = "no plan holds its limits and passes its audit:\n" + "\n".join(reasons)
    details = {"name": why.name, "value": why.value, "limit": why.limit, "time": why.time}
    raise SolveError(words, last, why.conflicts, **details)


def _attempts(
    problem: Problem, mesh: Collocation, settings: Mapping[str, Any], guess: Solution | None
) -> Iterator[tuple[str, Solution | SolveError]]:
    """Plans on a mesh that hold their limits, or why not; whoever takes them stops at the first that is good enough."""
    warm = {**WARM_START_OPTIONS, **settings}
    try:
        plan = solve(problem, mesh, options=warm if guess else settings, guess=guess)
    except SolveError as error:
        yield "", error
        return
    yield "", _drawn_in(problem, mesh, plan, warm)
    switched = solve_at_switches(problem, mesh, plan, options=settings)
    if switched is not plan:
        yield ", with nodes where it switches", _drawn_in(problem, mesh, switched, warm)


def _drawn_in(
    problem: Problem, mesh: Collocation, plan: Solution, settings: Mapping[str, Any]
) -> Solution | SolveError:
    """A plan that holds its limits between its nodes, and costs hardly more than one that does not; or why not."""
    if largest_excess(problem, plan) <= HOLDING.held:
        return plan
    own, most = mesh.with_mesh(plan.control_interpolant.breaks), plan.cost + HOLDING.dearer * abs(plan.cost)
    try:
        drawn = tighten(problem, own, tolerance=HOLDING.held, options=settings, guess=plan, max_cost=most)
    except SolveError as error:
        return error
    if drawn.cost <= most:
        return drawn
    words = f"limits that are drawn in between the nodes make it cost {drawn.cost:.6g} for {plan.cost:.6g}"
    return SolveError(words, drawn, name="cost", value=drawn.cost, limit=most)


def _finer(mesh: Collocation, plan: Solution, why: SolveError) -> Collocation:
    """The next mesh: cut where limits drawn in cost the last plan too much, where that alone is wrong; else halved."""
    if plan.bound_tightening is None or why.solution is not plan or why.name != "cost":
        return mesh.halved()
    nodes, drawn = plan.control_interpolant.breaks, plan.bound_tightening.max(axis=(0, 2))
    return mesh.with_mesh(split(nodes, np.where(drawn > 0, HOLDING.pieces, 1), drawn, HOLDING.pieces * len(drawn)))


def _by_joint(error: SolveError, driven: Mapping[str, tuple[Machine, Limits | None]]) -> SolveError:
    """The same, rows of joints called by the joints' names: "torques of 'elbow'" for "torques[1]"."""

    def called(found: re.Match[str]) -> str:
        phase, what, row = found["phase"] or "", found["what"], int(found["row"])
        if phase.removesuffix(".") not in driven:
            return found[0]
        machine, limits = driven[phase.removesuffix(".")]
        names = list(machine.robot.joint_names)
        if what == "torques":
            limited = np.isfinite((limits or Limits()).bounds(machine).torque)
            names = [name for name, own in zip(names, limited, strict=True) if own]
        return f"{phase}{what} of {names[row]!r}" if row < len(names) else found[0]

    rows = re.compile(ROWS)
    name = None if error.name is None else rows.sub(called, str(error.name))
    details = {"name": name, "value": error.value, "limit": error.limit, "time": error.time}
    return SolveError(rows.sub(called, str(error)), error.solution, error.conflicts, **details)
