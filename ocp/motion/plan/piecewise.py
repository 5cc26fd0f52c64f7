"""Tasks that no single motion does: done in the fewest pieces, between which the arm reconfigures.

Where a branch of postures ends, the tool stops, leaves the task, and comes back to the same place of it in another
posture. What is planned are the pieces, each a plan of its part of the tasks' time, and a motion from the end of each
to the beginning of the next, clear of everything, while the tasks wait.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, SolveError, checked_instance
from ocp.methods import solve
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error, solve_with_clearance
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.candidate import Candidate, Stage
from ocp.motion.plan.motion import Part, Plan
from ocp.motion.plan.planner import checked_request, clearance_constraints_for, planned
from ocp.motion.search.configurations import PlanRequest, fix_ignorable_joints, local_motions_from, start_configurations
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask, timed
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["Reconfiguration", "SegmentedPlan", "plan_in_segments"]


@dataclass(frozen=True)
class ReconfigurationSettings:
    """Settings of the motions between pieces.

    Attributes:
        mesh: Of their problem. options: Of IPOPT.
        slowness: Times as long as the straight way takes one round an obstacle.
        detours, sampled: Configurations by which it is tried to go round, of so many that are sampled.
        reach: rad or m: how far these are from what lies between, at most.
        unlimited_rate: rad/s or m/s: of joints whose rate has no limit.
        rate_slack: Share of its limit that a rate may exceed: a joint that goes straight is at its limit all the time.
    """

    mesh: Collocation = field(default_factory=lambda: Collocation(12, 3))
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 200})
    slowness: float = 3.0
    detours: int = 4
    sampled: int = 256
    reach: float = np.pi / 2
    unlimited_rate: float = 1.0
    rate_slack: float = 1e-9


@dataclass(frozen=True, eq=False)
class Reconfiguration:
    """Where the arm leaves its tasks, and comes back to the same place of them in another posture.

    Attributes:
        time: Of the tasks, which wait, s.
        before, after: Joints, rad or m. Shape (n,).
        way: A motion from the one to the other, clear of everything, no joint faster than its limit; its joints do not
            start from rest, as those of a plan. None where none was found: that does not say that there is none.
        why: Why not; "" with a way.
    """

    time: float
    before: Array
    after: Array
    motion: Plan | None
    failure: str = ""

    @property
    def duration(self) -> float:
        """Of the way, s; nan where there is none."""
        return np.nan if self.motion is None else self.motion.horizon

    def __str__(self) -> str:
        far = np.abs(self.after - self.before).max()
        how = f"in {self.duration:.4g} s" if self.motion is not None else f"no clear way was found: {self.failure}"
        return f"at {self.time:.4g} s the arm reconfigures, a joint by {far:.3g}: {how}"


@dataclass(frozen=True, eq=False)
class SegmentedPlan:
    """Motions that do the tasks one after the other.

    Attributes:
        machine: What moves.
        pieces: Each a plan of its part of the tasks, audited; its time begins with 0.
        begins: When each begins in the tasks' time, s; it ends where the next one begins.
        reconfigurations: One between each piece and the next.
        fewest: Reconfigurations that any plan has at least, under the assumptions of `ocp.motion.search.search`.
    """

    machine: FixedBase
    segments: tuple[Plan, ...]
    start_times: tuple[float, ...]
    reconfigurations: tuple[Reconfiguration, ...]
    fewest: int

    @property
    def cost(self) -> float:
        """Of the pieces together, without the reconfigurations."""
        return float(sum(piece.cost for piece in self.segments))

    @property
    def horizon(self) -> float:
        """Of the tasks, s."""
        return self.start_times[-1] + self.segments[-1].horizon

    @property
    def duration(self) -> float:
        """Of the tasks and the reconfigurations, s; nan where one of these has no way."""
        return self.horizon + float(sum(one.duration for one in self.reconfigurations))

    def __repr__(self) -> str:
        return f"<PlanInPieces of {self.horizon:.6g} s: {len(self.segments)} pieces, cost {self.cost:.6g}>"

    def __str__(self) -> str:
        count = len(self.reconfigurations)
        many = f"{count} reconfiguration{'' if count == 1 else 's'}"
        fewest = "none has fewer" if self.fewest == count else f"any has at least {self.fewest}"
        names = ", ".join(self.machine.robot.joint_names)
        lines = [f"plan of {self.horizon:.6g} s for {names}: {many}, {fewest}; cost {self.cost:.6g}"]
        for k, piece in enumerate(self.segments):
            end = self.start_times[k] + piece.horizon
            low = "" if piece.bound is None else f", at least {piece.bound:.6g} any"
            lines.append(f"  {self.start_times[k]:.4g} to {end:.4g} s: cost {piece.cost:.6g}{low}")
            if k < count:
                lines.append(f"  {self.reconfigurations[k]}")
        return "\n".join(lines)


@interruptible
def plan_in_segments(
    machine: FixedBase,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | None = None,
    *,
    start: Any = None,
    weights: Any = None,
    limits: Limits | None = None,
    seed: int = 0,
    obstacles: Any = (),
    clearance: float | None = 0.0,
    ignored: Any = (),
    srdf: Any = None,
    folders: Any = (),
    missing: str = "raise",
) -> SegmentedPlan:
    """Plan tasks in the fewest motions, between which the arm reconfigures, and of these the cheapest.

    Where one motion does, it is one piece: the plan of `plan(..., search="global")`. Else the time of the tasks is cut,
    at instants that come as close as a thousandth of it where that may spare a piece: how few any plan has is told. Of
    places to cut that spare none, those are taken from which the pieces cost least; reconfigurations cost nothing.

    Args:
        machine: On a fixed base.
        tasks, horizon, start, weights, limits, seed: As of `plan`; the tasks are poses that leave at most two
            directions free. With limits of drives, pieces are cut as without, and planned within them.
        obstacles, clearance, ignored, srdf, folders, missing: As of `plan`; obstacles that do not move by themselves,
            since a reconfiguration takes time.

    Raises:
        ProblemError: As `plan`; an obstacle that moves.
        DeadEnd: Somewhere no motion does the tasks for the least while, in whatever posture.
        SolveError: Pieces that could not be planned, however the tasks were cut.
    """
    checked_instance("machine", machine, FixedBase)
    asked = checked_request(machine, tasks, horizon, start, None, False, weights, limits, "global", seed, 1.0)
    clearance_constraints = clearance_constraints_for(
        machine, obstacles, clearance, ignored, srdf, folders, missing, limits
    )
    if clearance_constraints is not None and clearance_constraints.scene.moves_by_itself:
        words = "obstacles that move do not wait while the arm reconfigures; give those that stand still"
        raise ProblemError(words, name="obstacles", value=obstacles)
    asked = replace(asked, clearance_constraints=clearance_constraints)
    postures = start_configurations(asked)
    if asked.start is None:
        postures = fix_ignorable_joints(asked, postures)[1]
    searched = TaskSearch(asked, local_motions_from(asked, postures))
    barred: list[tuple[float, float]] = []
    known: dict[tuple[float, float], Plan] = {}
    error: SolveError | ProblemError | None = None
    while True:
        cut = searched.pieces(barred)
        if cut is None:
            raise error or searched.dead_end() or SolveError("no motion does the tasks in pieces", name="tasks")
        spans, fewest = cut
        for begin, end in spans:
            if (begin, end) in known:
                continue
            try:
                known[begin, end] = _piece(asked, begin, end)
            except (SolveError, Unreachable) as failed:
                if isinstance(failed.__cause__, KeyboardInterrupt):
                    raise
                error = failed
                barred.append((begin, end))
                break
        else:
            break
    pieces = [known[span] for span in spans]
    between = []
    for (begin, _), before, after in zip(spans[1:], pieces, pieces[1:], strict=False):
        ends = before.at(before.horizon)["joints"], after.at(0.0)["joints"]
        between.append(_reconfigured(asked, begin, *ends))
    begins = tuple(begin for begin, _ in spans)
    return SegmentedPlan(machine, tuple(pieces), begins, tuple(between), fewest - 1)


def _piece(asked: PlanRequest, begin: float, end: float) -> Plan:
    """The plan of the tasks from one time to another.

    Raises:
        ProblemError, SolveError: As `plan`.
    """
    tasks = tuple(part for task in asked.tasks if (part := _part(task, begin, end)) is not None)
    stretches = stretches_of(asked.machine, tasks, end - begin)
    start = asked.start if begin == 0 else None
    return planned(replace(asked, tasks=tasks, horizon=end - begin, stretches=stretches, start=start))


def _part(task: TipTask, begin: float, end: float) -> TipTask | None:
    """What of a task is to be done from one time to another, with the first as 0; None if nothing."""
    first, last = max(task.begin, begin), min(task.end, end)
    if last <= first:
        return None
    shift, breaks = first - task.begin, np.asarray(task.breaks)
    inside = breaks[(breaks > shift) & (breaks < last - task.begin)] - shift
    own = replace(task, breaks=()) if shift == 0 else timed(replace(task, breaks=()), lambda time: time + shift)
    return replace(own, begin=first - begin, duration=last - first, breaks=inside)


def _reconfigured(asked: PlanRequest, time: float, before: Array, after: Array) -> Reconfiguration:
    """A motion from one posture to another, straight or round what is in the way."""
    settings, limits = ReconfigurationSettings(), asked.bounds.velocity
    fastest = np.where(np.isfinite(limits), limits, settings.unlimited_rate)
    straight = float((np.abs(after - before) / fastest).max())
    middle, why = (before + after) / 2, ""
    ways = [(middle, straight)]
    if asked.clearance_constraints is not None:
        ways += [
            (via, settings.slowness * straight)
            for via in (middle, *_round(asked, asked.clearance_constraints, before, after, settings))
        ]
    for via, duration in ways:
        try:
            solution = _way(asked, before, via, after, duration, fastest, duration > straight, settings)
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            why = why or str(error).split("\n")[0]
            continue
        candidate = Candidate(before, solution.cost, None, Stage.AUDITED, solution)
        return Reconfiguration(
            time, before, after, Plan(asked.machine, solution, (Part(0.0, duration, ""),), (candidate,))
        )
    return Reconfiguration(time, before, after, None, why)


def _round(
    asked: PlanRequest,
    clearance_constraints: ClearanceConstraints,
    before: Array,
    after: Array,
    settings: ReconfigurationSettings,
) -> Array:
    """Postures that are clear, the nearest to the middle between two others. Shape (K, n)."""
    bounds, least = asked.bounds, clearance_constraints.scene.clearance
    low = np.maximum(np.minimum(before, after) - settings.reach, bounds.lower)
    high = np.minimum(np.maximum(before, after) + settings.reach, bounds.upper)
    some = low + (high - low) * np.random.default_rng(asked.seed).random((settings.sampled, len(before)))
    apart = distances_along(clearance_constraints.scene, np.zeros(0), some, np.zeros(settings.sampled), least)
    free = some[(apart >= least).all(axis=1)]
    return np.asarray(free[np.argsort(((free - (before + after) / 2) ** 2).sum(axis=1))[: settings.detours]])


def _way(
    asked: PlanRequest,
    before: Array,
    via: Array,
    after: Array,
    duration: float,
    fastest: Array,
    apart: bool,
    settings: ReconfigurationSettings,
) -> Solution:
    """The motion of least squared rates from one posture to another that begins from a way by a third.

    Args:
        apart: Whether bodies that come too near are held apart.

    Raises:
        SolveError: None was found that keeps its limits and is clear.
    """
    machine, n, bounds = asked.machine, asked.machine.joint_size, asked.bounds
    guess = {"joints": Samples(np.array([0.0, duration / 2, duration]), np.array([before, via, after]))}

    def run(clearance_constraints: ClearanceConstraints | None) -> Solution:
        problem = Problem("reconfiguration")
        problem.horizon(duration)
        told: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "unit": machine.robot.unit()}
        joints = problem.state("joints", n, initial=before, terminal=after, **told)
        most = (1 + settings.rate_slack) * fastest
        rates = problem.control("rates", n, lower=-most, upper=most, unit=machine.robot.unit("/s"))
        problem.dynamics(joints, rates)
        if clearance_constraints is not None:
            clearance_constraints.declare(problem, machine.base_home(), joints, horizon=duration)
        problem.minimize(running=ca.dot(rates, ca.DM(asked.weights) * rates) / 2)
        solution = solve(problem, settings.mesh, guess=guess, options=settings.options)
        audit = solution.audit()
        if not audit.feasible:
            worst = audit.failures[0]
            raise collision_error(audit, solution) or SolveError(str(worst), solution, name=worst.name)
        return solution

    return solve_with_clearance(asked.clearance_constraints, run) if apart else run(asked.clearance_constraints)
