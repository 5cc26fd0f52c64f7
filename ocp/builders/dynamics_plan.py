"""Motions by their drives, solved and audited: plans that hold their limits everywhere, or the reasons why none does.

A smooth plan, of least effort, needs few intervals. One of least time jumps from limit to limit, and has nodes at its
jumps (`ocp.switching`). Where a plan still goes beyond a limit between its nodes, the limit is drawn in there
(`ocp.tightening`), which costs little on a mesh that is fine enough; else the mesh is cut: where limits that are drawn
in cost too much there alone, for a plan that only touches a limit goes beyond it with the square of the width.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from models import Machine
from ocp.builders.clearance import Clear, Kept, keeping_clear, of_clearance, touching_error
from ocp.builders.drives import Motors
from ocp.builders.dynamics import AskedOfDrives, dynamics_problem
from ocp.builders.legs import Leg, checked_legs, dynamics_phases
from ocp.builders.standing.problem import FreeTime
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.errors import ProblemError, SolveError, checked_each, checked_instance, checked_mapping
from ocp.methods import solve
from ocp.problem.problem import Problem
from ocp.refinement import split
from ocp.solution import Solution
from ocp.switching import NEAR, at_switches
from ocp.tasks.checks import checked_horizon
from ocp.tasks.limits import Limits
from ocp.tasks.tip_task import TipTask
from ocp.tightening import exceeded, tighten

__all__ = ["breaks_of", "plan_dynamics", "within_limits"]

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
    clear: Clear | None = None,
    **asked: Unpack[AskedOfDrives],
) -> Solution:
    """Solve `dynamics_problem`, or the legs of `dynamics_phases`, and audit the plan.

    Its limits hold between the nodes, too, to 1e-5 of their units.

    The first plan that passes its audit is returned; where none does, the cheapest that holds everything: it is not
    decided to be a minimum, or costs too much, by about its `tightening_cost`. Least time alone,
    `Effort(torque=0, time=1)`, leaves open what joints do that need not hurry, so that no plan is decided to be the
    best: a small weight of accelerations or torques beside it says it.

    Args:
        machine, start_joints, clear, asked: As for `dynamics_problem`.
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

        def all_legs(clear: Clear | None) -> Problem:
            return dynamics_phases(machine, start_joints, legs, total=total, clear=clear, **asked)

        return within_limits(all_legs, clear, method, (), options, tolerances, driven)
    if total is not None:
        raise ProblemError("total: of legs alone; the horizon is the whole time", name="total", value=total)

    def declare(clear: Clear | None) -> Problem:
        return dynamics_problem(machine, start_joints, horizon, clear=clear, **asked)

    at = () if isinstance(horizon, FreeTime) else breaks_of(asked.get("tasks", ()), checked_horizon(horizon))
    return within_limits(declare, clear, method, at, options, tolerances, {"": (machine, asked.get("limits"))})


def breaks_of(tasks: TipTask | Sequence[TipTask], horizon: float) -> Sequence[float]:
    """Fractions of a horizon at which tasks are less smooth."""
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    times = np.unique(np.concatenate([np.zeros(0), *(task.begin + np.asarray(task.breaks) for task in given)]))
    return [float(at) for at in times / horizon if 0 < at < 1]


def within_limits(
    declare: Callable[[Kept], Problem],
    clear: Kept,
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

    def run(clear: Kept) -> Solution:
        return planned(declare(clear), touching)

    try:
        return keeping_clear(clear, run)
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
            if touching := touching_error(audit, plan):
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
                plan = tighten(problem, own, tolerance=HOLDING.held, options={**NEAR, **settings}, guess=plan)
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
    warm = {**NEAR, **settings}
    try:
        plan = solve(problem, mesh, options=warm if guess else settings, guess=guess)
    except SolveError as error:
        yield "", error
        return
    yield "", _drawn_in(problem, mesh, plan, warm)
    switched = at_switches(problem, mesh, plan, options=settings)
    if switched is not plan:
        yield ", with nodes where it switches", _drawn_in(problem, mesh, switched, warm)


def _drawn_in(
    problem: Problem, mesh: Collocation, plan: Solution, settings: Mapping[str, Any]
) -> Solution | SolveError:
    """A plan that holds its limits between its nodes, and costs hardly more than one that does not; or why not."""
    if exceeded(problem, plan) <= HOLDING.held:
        return plan
    own, most = mesh.with_mesh(plan.control_interpolant.breaks), plan.cost + HOLDING.dearer * abs(plan.cost)
    try:
        drawn = tighten(problem, own, tolerance=HOLDING.held, options=settings, guess=plan, dearest=most)
    except SolveError as error:
        return error
    if drawn.cost <= most:
        return drawn
    words = f"limits that are drawn in between the nodes make it cost {drawn.cost:.6g} for {plan.cost:.6g}"
    return SolveError(words, drawn, name="cost", value=drawn.cost, limit=most)


def _finer(mesh: Collocation, plan: Solution, why: SolveError) -> Collocation:
    """The next mesh: cut where limits drawn in cost the last plan too much, where that alone is wrong; else halved."""
    if plan.drawn_in is None or why.solution is not plan or why.name != "cost":
        return mesh.halved()
    nodes, drawn = plan.control_interpolant.breaks, plan.drawn_in.max(axis=(0, 2))
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
