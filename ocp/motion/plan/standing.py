"""The cheapest motion of a machine that stands unfastened on the ground, from the postures in which it can stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca

from models import Standing
from models.arrays import Array
from ocp.errors import ProblemError, SolveError, checked_flag, checked_instance
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.plan import plan_standing
from ocp.motion.builders.standing.problem import StandingSetup, Weights
from ocp.motion.local.inverse_kinematics import inverse_kinematics
from ocp.motion.plan.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.plan.candidate_queue import CandidateQueue, Solver
from ocp.motion.plan.motion import Part, Plan
from ocp.motion.search.settings import PlannerSettings
from ocp.motion.tasks.checks import check_rest, horizon_of
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["plan_to_stand"]


def plan_to_stand(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: Any,
    *,
    start: Any,
    cyclic: bool,
    weights: Weights | None,
    limits: Limits | None,
    search: str,
    seed: int,
    clearance_constraints: ClearanceConstraints | None,
) -> Plan:
    """Do the tasks with the zero moment point inside the foot, at the least cost of `plan_standing`.

    The joints start and end at rest where their tasks do, else they are free to move. From every posture at the start
    that inverse kinematics finds and that stands, or, with search "start", from the best conditioned that leads to a
    plan.

    Args:
        machine: What stands.
        tasks, horizon, start, limits, search, seed: As of `ocp.motion.plan.plan`.
        cyclic: False: a standing motion is not closed by this.
        weights: Of the parts of the cost. clear: What the motion has to stay clear of, or None.

    Raises:
        ProblemError: A cyclic motion, tasks in intervals of time, a horizon that is no number, or as plan_standing.
        SolveError: No posture leads to a plan that passes its audit.
    """
    checked_flag("cyclic", cyclic)
    if cyclic:
        words = "a standing motion is not closed: give plan_standing the joints at the end, StandingSetup(end=...)"
        raise ProblemError(words, name="cyclic", value=cyclic)
    if weights is not None:
        checked_instance("weights", weights, Weights)
    given = [part.task for part in bind(machine, tasks).bound]
    duration = horizon_of(given, horizon)
    for number, task in enumerate(given):
        if task.begin > 0 or task.end < duration * (1 - 1e-9):
            words = (
                f"task {number} is from {task.begin:g} to {task.end:g} s; a standing motion does all its tasks at once"
            )
            raise ProblemError(words, name=f"task {number}", value=(task.begin, task.end), limit=(0.0, duration))
    equations = bind(machine, given)
    setup = StandingSetup(
        start_velocity=_rest(equations, 0.0),
        end_velocity=_rest(equations, duration),
        clearance_constraints=clearance_constraints,
        symbols=ca.SX if _takes_scalars(equations) else ca.MX,
    )
    options: dict[str, Any] = {"weights": weights, "limits": limits, "setup": setup}
    queue = CandidateQueue(_StandingSolver(machine, given, duration, options, start is not None), PlannerSettings())
    seeds = [Candidate(joints) for joints in _postures(machine, given, start, limits, seed)]
    for batch in [[one] for one in seeds] if search == "start" else [seeds]:
        queue.run(batch)
        if queue.passed:
            break
    return queue.plan()


@dataclass
class _StandingSolver(Solver):
    """Advances candidates of a standing machine, all in one stage: `plan_standing` solves, refines and audits."""

    machine: Standing
    tasks: list[TipTask]
    duration: float
    options: dict[str, Any]
    start_given: bool

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """The candidate, audited or rejected.

        Raises:
            ProblemError, SolveError: Of the start that was given.
        """
        try:
            solution = plan_standing(self.machine, self.tasks, self.duration, start=candidate.start, **self.options)
        except (ProblemError, SolveError) as error:
            if self.start_given or isinstance(error.__cause__, KeyboardInterrupt):
                raise
            return [candidate.rejected(Reason.of_error(Rejection.INFEASIBLE, error))]
        return [replace(candidate, stage=Stage.AUDITED, cost=solution.cost, solution=solution)]

    def plan(self, candidates: Sequence[Candidate]) -> Plan:
        """The plan of which the first one is the motion."""
        best = candidates[0].solution
        assert best is not None
        parts = (Part(0.0, self.duration, ""),)
        return Plan(self.machine, best, parts, tuple(candidates)).with_targets(self.tasks)


def _rest(equations: TaskEquations, time: float) -> Literal["rest", "free"]:
    """Whether the joints rest at a time, as the tasks do."""
    try:
        check_rest(equations, time)
    except ProblemError:
        return "free"
    return "rest"


def _takes_scalars(equations: TaskEquations) -> bool:
    """Whether the tracks are expressions of SX symbols."""
    try:
        equations.targets(ca.SX.sym("time"))
    except (RuntimeError, NotImplementedError):
        return False
    return True


def _postures(machine: Standing, tasks: list[TipTask], start: Any, limits: Limits | None, seed: int) -> list[Array]:
    """Joints at the start, the best conditioned first."""
    if start is not None:
        return [start]
    poses = [task for task in tasks if task.is_pose]
    if not poses:
        words = "start is missing: no task says by a pose where the tip is at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    found = inverse_kinematics(machine, poses, seed=seed, limits=limits is None or limits.joints)
    return [posture.joints for posture in found]
