"""Lowest-cost motion of a machine that stands on the ground without being fastened to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca

from models import Standing
from models.checks import Array
from models.machines.standing import External
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.plan import solve_standing
from ocp.motion.builders.standing.problem import StandingSetup, Weights
from ocp.motion.local.inverse_kinematics import IkOptions, inverse_kinematics
from ocp.motion.plan.candidate_queue import CandidateQueue, Solver
from ocp.motion.plan.planner import PlanOptions
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.search.configurations import PlannerSettings
from ocp.motion.tasks.checks import check_rest, horizon_of
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["plan_to_stand"]


def plan_to_stand(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: Any,
    options: PlanOptions,
    *,
    constraints: ClearanceConstraints | None,
    wrenches: External | None,
) -> SolvedPlan:
    """Plan a motion that satisfies the tasks while the zero moment point stays inside the foot.

    The joints start and end at rest if their tasks do; else they may move there. Candidates start from every
    configuration that inverse kinematics finds and that stands; with search "start", from the best conditioned one that
    leads to a plan.

    Args:
        machine: The standing machine.
        tasks, horizon: As in `ocp.motion.plan.plan`.
        options: Start, limits, search and seed; `cost` weights the terms of the cost, and `cyclic` is False.
        constraints: Clearance constraints, or None.
        wrenches: External wrenches as a function of time and tip position, or None.

    Raises:
        ProblemError: A cyclic motion, tasks that are active only a part of the time, a horizon that is no number, or as
            in `solve_standing`.
        SolveError: No start leads to a plan that passes its audit.
    """
    start, limits, cost = options.start, options.limits, options.cost
    require.flag("cyclic", options.cyclic)
    if options.cyclic:
        words = "a standing motion cannot be cyclic; declare standing_problem with StandingSetup(end=...)"
        raise ProblemError(words, name="cyclic", value=options.cyclic)
    if cost is not None:
        require.instance("cost", cost, Weights)
    all_tasks = [part.task for part in bind(machine, tasks).bound]
    duration = horizon_of(all_tasks, horizon)
    for number, task in enumerate(all_tasks):
        if task.begin > 0 or task.end < duration * (1 - 1e-9):
            words = f"task {number} lasts from {task.begin:g} to {task.end:g} s, not for the whole standing motion"
            raise ProblemError(words, name=f"task {number}", value=(task.begin, task.end), limit=(0.0, duration))
    equations = bind(machine, all_tasks)
    setup = StandingSetup(
        start_velocity=_rest(equations, 0.0),
        end_velocity=_rest(equations, duration),
        external=wrenches,
        clearance_constraints=constraints,
        symbols=ca.SX if _takes_scalars(equations) else ca.MX,
    )
    arguments: dict[str, Any] = {"weights": cost, "limits": limits, "setup": setup}
    solver = _StandingSolver(machine, all_tasks, duration, arguments, start is not None)
    queue = CandidateQueue(solver, PlannerSettings())
    seeds = [Candidate(joints) for joints in _start_configurations(machine, all_tasks, start, limits, options.seed)]
    for batch in [[candidate] for candidate in seeds] if options.search == "start" else [seeds]:
        queue.run(batch)
        if queue.passed:
            break
    return queue.plan()


@dataclass
class _StandingSolver(Solver):
    """Solver of the candidates of a standing machine, with one stage, in which `solve_standing` does everything."""

    machine: Standing
    tasks: list[TipTask]
    duration: float
    options: dict[str, Any]
    start_is_fixed: bool

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """Return the candidate after its solve: audited, or rejected.

        Raises:
            ProblemError, SolveError: Errors of a given start.
        """
        try:
            solution = solve_standing(self.machine, self.tasks, self.duration, start=candidate.start, **self.options)
        except (ProblemError, SolveError) as error:
            if self.start_is_fixed or isinstance(error.__cause__, KeyboardInterrupt):
                raise
            return [candidate.rejected(Reason.of_error(Rejection.INFEASIBLE, error))]
        return [replace(candidate, stage=Stage.AUDITED, cost=solution.cost, solution=solution)]

    def plan(self, candidates: Sequence[Candidate]) -> SolvedPlan:
        """Return the first candidate as the plan, which also lists the others."""
        best = candidates[0].solution
        assert best is not None
        parts = (Part(0.0, self.duration, ""),)
        return SolvedPlan(self.machine, best, parts, tuple(candidates)).with_targets(self.tasks)


def _rest(equations: TaskEquations, time: float) -> Literal["rest", "free"]:
    """Return "rest" if the tips are at rest at a time, else "free"."""
    try:
        check_rest(equations, time)
    except ProblemError:
        return "free"
    return "rest"


def _takes_scalars(equations: TaskEquations) -> bool:
    """Return whether the functions of time in the tasks accept SX symbols."""
    try:
        equations.targets(ca.SX.sym("time"))
    except (RuntimeError, NotImplementedError):
        return False
    return True


def _start_configurations(
    machine: Standing, tasks: list[TipTask], start: Any, limits: Limits | None, seed: int
) -> list[Array]:
    """Return joint vectors at the start, in order of their conditioning."""
    if start is not None:
        return [start]
    poses = [task for task in tasks if task.is_pose]
    if not poses:
        words = "start is missing: no task gives the tip's pose at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    options = IkOptions(limits=limits is None or limits.joints)
    solutions = inverse_kinematics(machine, poses, seed=seed, options=options)
    return [solution.joints for solution in solutions]
