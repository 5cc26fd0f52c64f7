"""Optimal plans of the standing machine: Table 1, Table 2 against the spring, the fastest lift; their convergence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, TypeAlias

import numpy as np

from models import STANDING_STARTS
from models.machines.standing import StandingMotion, standing_motion
from ocp import Audit, Collocation, MultipleShooting, Problem, Solution, TipTask, solve, tighten
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.tasks.equations import task_errors
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Limits, Pinned, ZmpRule
from scripts.papers.run import Row, progress
from scripts.papers.standing.cases import HORIZON, ROWS, Array, led, machine, spring, start_tip, table_task

__all__ = [
    "HELD",
    "LIFT_LIMITS",
    "LIMITS",
    "PLANS",
    "Held",
    "Plan",
    "Request",
    "convergence_rows",
    "fine_motion",
    "held_plans",
    "make",
    "plan_problem",
]

Transcription: TypeAlias = Literal["held", "linear", "points"]
Task: TypeAlias = Literal["table1", "table2", "minimum_time"]

LIMITS = Limits(velocity=6.0, acceleration=60.0, vertical_force=60.0)
LIFT_LIMITS = Limits(velocity=3.0, acceleration=20.0, torque=(200, 350, 250, 60, 30), vertical_force=60.0, friction=0.6)
LIFT_WEIGHTS = Weights(acceleration=1e-5, velocity=0.0, joint_limits=0.0, manipulability=0.0, time=1.0)
LIFT = 0.8  # m
MARGIN = 0.02  # m, inside the foot: -0.08 .. 0.18
HELD: Mapping[str, int] = {"table1": 80, "table2": 80, "minimum_time": 50}  # the reference's, all held
FINER = 10  # of the grid that plans are checked on
EDGE = 1e-9  # of an interval: where its own end is looked at, and not its neighbour's

SETTINGS = (
    "Chosen: cost ∫ 0.01|q''|² + 0.01|q'|² + p1 − 0.5 p2 dt, rest at both ends, |q'| ≤ 6 rad/s, |q''| ≤ 60 rad/s², "
    "vertical force ≥ 60 N; accelerations free at 3 Legendre points of 100 intervals"
)
LIFT_SETTINGS = (
    "Chosen: tip 0.8 m straight up from rest to rest, cost T + 1e-5 ∫|q''|² dt, |torque| ≤ 200, 350, 250, 60, 30 N m, "
    "|q'| ≤ 3 rad/s, |q''| ≤ 20 rad/s², vertical force ≥ 60 N, friction ≤ 0.6; 100 intervals, accelerations linear, "
    "limits drawn in until they hold between the nodes"
)


@dataclass(frozen=True)
class Request:
    """A plan to be made.

    Attributes:
        task: What the tip does. title: For the reader. rule: Where the zero moment point may be.
        transcription: ``points``: accelerations free at Legendre points, for plans that are smooth; ``linear``: linear
            between the nodes, limits drawn in to hold there too, for plans that switch; ``held``: held over the
            intervals, as the reference has them, which costs more where a constraint of the ground is active.
        intervals: Of the plan.
        has_figure: Whether figures and animations show it; such plans must stand every check and their audit.
    """

    task: Task
    title: str
    rule: ZmpRule
    transcription: Transcription = "points"
    intervals: int = 100
    has_figure: bool = True


@dataclass(frozen=True)
class Plan:
    """A plan and what was found of it.

    Attributes:
        request: What was asked.
        solution: The answer.
        motion: On a grid ten times its own, both ends of every interval included.
        tip_error: Greatest distance of the tip from its path there, m.
        audit: Independent of the solver.
    """

    request: Request
    solution: Solution
    motion: StandingMotion
    tip_error: float
    audit: Audit


@dataclass(frozen=True)
class Held:
    """A plan as the reference has it, with accelerations held, and its motion on a grid ten times its own."""

    solution: Solution
    motion: StandingMotion


PLANS: Mapping[str, Mapping[str, Request]] = {
    "table1": {
        "optimal_range": Request("table1", "in the foot less 0.02 m", InFoot(MARGIN)),
        "optimal_index_half": Request("table1", "index ≥ 0.5", IndexAtLeast(0.5)),
        "optimal_index_nine_tenths": Request("table1", "index ≥ 0.9", IndexAtLeast(0.9)),
        "optimal_pinned": Request("table1", "pinned at 0, held", Pinned(), "held", HELD["table1"], has_figure=False),
        "optimal_pinned_points": Request("table1", "pinned at 0", Pinned()),
        "optimal_free": Request("table1", "no ZMP rule", Anywhere()),
    },
    "table2": {
        "optimal_spring": Request("table2", "in the foot less 0.02 m", InFoot(MARGIN)),
        "optimal_spring_index_nine_tenths": Request("table2", "index ≥ 0.9", IndexAtLeast(0.9)),
        "optimal_spring_pinned": Request(
            "table2", "pinned at 0, held", Pinned(), "held", HELD["table2"], has_figure=False
        ),
        "optimal_spring_pinned_points": Request("table2", "pinned at 0", Pinned()),
        "optimal_spring_free": Request("table2", "no ZMP rule", Anywhere()),
    },
    "minimum_time": {
        "free": Request("minimum_time", "no ZMP rule", Anywhere(), "linear"),
        "in_foot": Request("minimum_time", "in the foot less 0.02 m", InFoot(MARGIN), "linear"),
        "index_nine_tenths": Request("minimum_time", "index ≥ 0.9", IndexAtLeast(0.9), "linear"),
    },
}
"""Plans by summary key."""

CONVERGING: tuple[tuple[str, str], ...] = (
    ("table1", "optimal_range"),
    ("table1", "optimal_index_nine_tenths"),
    ("table1", "optimal_pinned"),
    ("table2", "optimal_spring"),
    ("minimum_time", "free"),
    ("minimum_time", "in_foot"),
    ("minimum_time", "index_nine_tenths"),
)
MESHES: Mapping[Transcription, tuple[int, ...]] = {"held": (40, 80, 160), "points": (10, 20, 40)}
LIFT_MESHES: Mapping[Transcription, tuple[int, ...]] = {"held": (25, 50, 100), "linear": (25, 50, 100)}
METHOD_NAMES: Mapping[Transcription, str] = {
    "held": "shooting, held",
    "linear": "shooting, linear",
    "points": "Legendre 3, points",
}


def task_of(task: Task) -> TipTask:
    """Over time, or over the path parameter for the lift."""
    _, y, z = start_tip(1)
    if task == "minimum_time":
        return led(lambda s: [y, z + LIFT * s])
    return table_task(1 if task == "table1" else 2)


def plan_problem(request: Request) -> Problem:
    """The problem of a request."""
    return _problem(request.task, request.rule, "acceleration" if request.transcription == "points" else "position")


@cache  # the same for every mesh
def _problem(task: Task, rule: ZmpRule, tip_level: Literal["position", "acceleration"]) -> Problem:
    start, tips = STANDING_STARTS[2 if task == "table2" else 1], task_of(task)
    if task == "minimum_time":
        setup = StandingSetup(tip_level=tip_level, along="parameter")
        options: dict[str, Any] = {"zmp": rule, "limits": LIFT_LIMITS, "weights": LIFT_WEIGHTS, "setup": setup}
        return standing_problem(machine(), tips, FreeTime(0.2, 3.0, 1.0), start=start, **options)
    setup = StandingSetup(tip_level=tip_level, wrenches=spring() if task == "table2" else ())
    return standing_problem(machine(), tips, HORIZON, start=start, zmp=rule, limits=LIMITS, setup=setup)


def method(transcription: Transcription, intervals: int) -> Any:
    """The transcription of that name."""
    if transcription == "points":
        return Collocation(intervals, degree=3, scheme="legendre")
    return MultipleShooting(intervals, control=transcription)


def solved(request: Request) -> Solution:
    """The answer to a request."""
    # linear accelerations carry joints beyond limits that bind between the nodes, and torques with them
    find = tighten if request.transcription == "linear" else solve
    return find(plan_problem(request), method(request.transcription, request.intervals))


def make(request: Request) -> Plan:
    """Solve, evaluate between the nodes and audit."""
    solution = solved(request)
    motion, progress = fine_motion(request, solution)
    errors = task_errors(machine(), task_of(request.task), progress, motion.joints)
    error = float(np.linalg.norm(errors, axis=1).max())
    limits = {"joints": 1e-6, "velocities": 1e-6, "accelerations": 1e-6}
    if not isinstance(request.rule, Anywhere):
        limits["zero moment point"] = 1e-3
    if request.transcription != "points":  # else the tip's acceleration is constrained, its position watched
        limits["tip"] = 1e-5
    return Plan(request, solution, motion, error, solution.audit(tolerances=limits))


def fine_motion(request: Request, solution: Solution) -> tuple[StandingMotion, Array]:
    """The plan on a grid FINER times its own, at both ends of every interval with the controls of that interval.

    The intervals are the plan's own, be they equal or not.

    Returns:
        The motion, and where on the tip's path it is: times, or path parameters. Shape (M,).
    """
    parts = np.clip(np.linspace(0.0, 1.0, FINER + 1), EDGE, 1.0 - EDGE)
    breaks = solution.control_interpolant.breaks
    fractions = (breaks[:-1, None] + np.diff(breaks)[:, None] * parts).ravel()
    fractions[0], fractions[-1] = 0.0, 1.0
    values = solution.at_fraction(fractions)
    times = fractions * solution.horizon
    q, qd, qdd = values["joints"], values["velocities"], values["accelerations"]
    wrenches = spring() if request.task == "table2" else ()
    progress = values["path"][:, 0] if request.task == "minimum_time" else times
    return standing_motion(machine(), times, q, qd, joint_accelerations=qdd, wrenches=wrenches, rows=ROWS), progress


def held_plans(plans: Mapping[str, Mapping[str, Plan]]) -> dict[str, dict[str, Held]]:
    """The plans as the reference has them, accelerations held over as many intervals. By task and summary key."""
    by_name: dict[str, dict[str, Held]] = {}
    for task, group in plans.items():
        there = {one.request.rule: one.solution for one in group.values() if one.request.transcription == "held"}
        for key, plan in progress(group.items(), f"held, {task}"):
            request = replace(plan.request, transcription="held", intervals=HELD[task])
            solution = there.get(request.rule) or solved(request)
            by_name.setdefault(task, {})[key] = Held(solution, fine_motion(request, solution)[0])
    return by_name


def convergence_rows(plans: Mapping[str, Mapping[str, Plan]], held: Mapping[str, Mapping[str, Held]]) -> list[Row]:
    """Cost by mesh and transcription, and its distance from that of the finest mesh of the better transcription."""
    work: list[tuple[str, str, Transcription, int]] = []
    for task, key in CONVERGING:
        meshes_of = LIFT_MESHES if task == "minimum_time" else MESHES
        work += [(task, key, kind, n) for kind, meshes in meshes_of.items() for n in meshes]
    known: dict[tuple[str, str, Transcription, int], Solution] = {}
    for task, group in plans.items():
        for key, plan in group.items():
            known[task, key, plan.request.transcription, plan.request.intervals] = plan.solution
    for task, answers in held.items():
        known |= {(task, key, "held", HELD[task]): one.solution for key, one in answers.items()}
    costs: dict[tuple[str, str, Transcription, int], float] = {}
    for item in progress(work, "convergence"):
        task, key, kind, intervals = item
        result = known.get(item) or solved(replace(PLANS[task][key], transcription=kind, intervals=intervals))
        costs[item] = result.cost
    rows: list[Row] = []
    for (task, key, kind, intervals), cost in costs.items():
        best: Transcription = "linear" if task == "minimum_time" else "points"
        finest = (LIFT_MESHES if task == "minimum_time" else MESHES)[best][-1]
        reference = costs[task, key, best, finest]
        rows.append(
            {
                "task": task,
                "plan": key,
                "method": METHOD_NAMES[kind],
                "intervals": intervals,
                "cost": cost,
                "difference": cost - reference,
                "percent": 100 * (cost - reference) / abs(reference),
            }
        )
    return rows
