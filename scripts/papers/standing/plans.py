"""Optimal plans of the standing machine: Table 1, Table 2 against the spring, the fastest lift; their convergence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from models import STANDING_STARTS
from models.machines.standing_motion import StandingMotion, standing_motion
from ocp import Audit, Collocation, MultipleShooting, Problem, Solution, TipTask, solve
from ocp.builders.standing import (
    Anywhere,
    FreeTime,
    IndexAtLeast,
    InFoot,
    Limits,
    Pinned,
    Weights,
    ZmpRule,
    standing_problem,
)
from ocp.tasks.equations import task_errors
from scripts.papers.run import Row, progress
from scripts.papers.standing.cases import HORIZON, ROWS, Array, led, machine, spring, start_tip, table_task

__all__ = [
    "LIFT_LIMITS",
    "LIMITS",
    "PLANS",
    "Plan",
    "Request",
    "convergence_rows",
    "fine_motion",
    "make",
    "plan_problem",
]

Transcription: TypeAlias = Literal["held", "points"]
Task: TypeAlias = Literal["table1", "table2", "minimum_time"]

LIMITS = Limits(velocity=6.0, acceleration=60.0, vertical_force=60.0)
LIFT_LIMITS = Limits(velocity=3.0, acceleration=20.0, torque=(200, 350, 250, 60, 30), vertical_force=60.0, friction=0.6)
LIFT_WEIGHTS = Weights(acceleration=1e-5, velocity=0.0, joint_limits=0.0, manipulability=0.0, time=1.0)
LIFT = 0.8  # m
MARGIN = 0.02  # m, inside the foot: -0.08 .. 0.18
FINER = 10  # of the grid that plans are checked on
EDGE = 1e-9  # of an interval: where its own end is looked at, and not its neighbour's

SETTINGS = (
    "Chosen: cost ∫ 0.01|q''|² + 0.01|q'|² + p1 − 0.5 p2 dt, rest at both ends, |q'| ≤ 6 rad/s, |q''| ≤ 60 rad/s², "
    "vertical force ≥ 60 N"
)
LIFT_SETTINGS = (
    "Chosen: tip 0.8 m straight up from rest to rest, cost T + 1e-5 ∫|q''|² dt, |torque| ≤ 200, 350, 250, 60, 30 N m, "
    "|q'| ≤ 3 rad/s, |q''| ≤ 20 rad/s², vertical force ≥ 60 N, friction ≤ 0.6; 50 intervals, accelerations held"
)


@dataclass(frozen=True)
class Request:
    """A plan to be made.

    Attributes:
        task: What the tip does. title: For the reader. rule: Where the zero moment point may be.
        transcription: ``held``: accelerations held over the intervals; ``points``: free at Legendre points.
        intervals: Of the plan.
        drawn: Whether figures and animations show it; such plans must stand every check.
    """

    task: Task
    title: str
    rule: ZmpRule
    transcription: Transcription = "held"
    intervals: int = 80
    drawn: bool = True


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


PLANS: Mapping[str, Mapping[str, Request]] = {
    "table1": {
        "optimal_range": Request("table1", "in the foot less 0.02 m", InFoot(MARGIN)),
        "optimal_index_half": Request("table1", "index ≥ 0.5", IndexAtLeast(0.5)),
        "optimal_index_nine_tenths": Request("table1", "index ≥ 0.9", IndexAtLeast(0.9)),
        "optimal_pinned": Request("table1", "pinned at 0, held", Pinned(), drawn=False),
        "optimal_pinned_points": Request("table1", "pinned at 0", Pinned(), "points", 100),
        "optimal_free": Request("table1", "no ZMP rule", Anywhere()),
    },
    "table2": {
        "optimal_spring": Request("table2", "in the foot less 0.02 m", InFoot(MARGIN)),
        "optimal_spring_index_nine_tenths": Request("table2", "index ≥ 0.9", IndexAtLeast(0.9)),
        "optimal_spring_pinned": Request("table2", "pinned at 0, held", Pinned(), drawn=False),
        "optimal_spring_pinned_points": Request("table2", "pinned at 0", Pinned(), "points", 100),
        "optimal_spring_free": Request("table2", "no ZMP rule", Anywhere()),
    },
    "minimum_time": {
        "free": Request("minimum_time", "no ZMP rule", Anywhere(), intervals=50),
        "in_foot": Request("minimum_time", "in the foot less 0.02 m", InFoot(MARGIN), intervals=50),
        "index_nine_tenths": Request("minimum_time", "index ≥ 0.9", IndexAtLeast(0.9), intervals=50),
    },
}
"""Plans by summary key."""

CONVERGING = (
    ("table1", "optimal_range"),
    ("table1", "optimal_index_nine_tenths"),
    ("table1", "optimal_pinned"),
    ("table2", "optimal_spring"),
)
MESHES: Mapping[Transcription, tuple[int, ...]] = {"held": (40, 80, 160), "points": (10, 20, 40)}
LIFT_MESHES = (25, 50, 100)
METHOD_NAMES: Mapping[Transcription, str] = {"held": "shooting, held", "points": "Legendre 3, points"}


def task_of(request: Request) -> TipTask:
    """Over time, or over the path parameter for the lift."""
    _, y, z = start_tip(1)
    if request.task == "minimum_time":
        return led(lambda s: [y, z + LIFT * s])
    return table_task(1 if request.task == "table1" else 2)


def plan_problem(request: Request) -> Problem:
    """The problem of a request."""
    settings: dict[str, Any] = {"zmp": request.rule}
    if request.transcription == "points":
        settings["tip_level"] = "acceleration"
    if request.task == "minimum_time":
        settings |= {"limits": LIFT_LIMITS, "weights": LIFT_WEIGHTS, "along": "parameter"}
        return standing_problem(machine(), task_of(request), STANDING_STARTS[1], FreeTime(0.2, 3.0, 1.0), **settings)
    table = 1 if request.task == "table1" else 2
    settings |= {"limits": LIMITS, "external": spring() if table == 2 else None}
    return standing_problem(machine(), task_of(request), STANDING_STARTS[table], HORIZON, **settings)


def method(transcription: Transcription, intervals: int) -> Any:
    """The transcription of that name."""
    if transcription == "held":
        return MultipleShooting(intervals, control="held")
    return Collocation(intervals, degree=3, scheme="legendre")


def make(request: Request) -> Plan:
    """Solve, evaluate between the nodes and audit."""
    solution = solve(plan_problem(request), method(request.transcription, request.intervals))
    motion, progress = fine_motion(request, solution)
    errors = task_errors(machine(), task_of(request), progress, None, motion.joints)
    error = float(np.linalg.norm(errors, axis=1).max())
    limits = {"joints": 1e-6, "velocities": 1e-6, "accelerations": 1e-6}
    if not isinstance(request.rule, Anywhere):
        limits["zero moment point"] = 1e-3
    if request.transcription == "held":
        limits["tip"] = 1e-5
    return Plan(request, solution, motion, error, solution.audit(tolerances=limits))


def fine_motion(request: Request, solution: Solution) -> tuple[StandingMotion, Array]:
    """The plan on a grid FINER times its own, at both ends of every interval with the controls of that interval.

    Returns:
        The motion, and where on the tip's path it is: times, or path parameters. Shape (M,).
    """
    parts = np.clip(np.linspace(0.0, 1.0, FINER + 1), EDGE, 1.0 - EDGE)
    fractions = ((np.arange(request.intervals)[:, None] + parts) / request.intervals).ravel()
    fractions[0], fractions[-1] = 0.0, 1.0
    values = solution.at_fraction(fractions)
    times = fractions * solution.horizon
    q, qd, qdd = values["joints"], values["velocities"], values["accelerations"]
    external = spring() if request.task == "table2" else None
    progress = values["path"][:, 0] if request.task == "minimum_time" else times
    return standing_motion(machine(), times, q, qd, qdd, external, ROWS), progress


def convergence_rows(plans: Mapping[str, Mapping[str, Plan]]) -> list[Row]:
    """Cost by mesh and transcription, and its distance from that of the finest Legendre mesh."""
    work: list[tuple[str, str, Transcription, int]] = []
    for task, key in CONVERGING:
        work += [(task, key, kind, n) for kind, meshes in MESHES.items() for n in meshes]
    work += [("minimum_time", key, "held", n) for key in PLANS["minimum_time"] for n in LIFT_MESHES]
    known = {(p.request.task, p.request.rule, p.request.transcription, p.request.intervals): p for p in _all(plans)}
    costs: dict[tuple[str, str, Transcription, int], float] = {}
    for item in progress(work, "convergence"):
        task, key, kind, intervals = item
        rule = PLANS[task][key].rule
        request = Request(PLANS[task][key].task, "", rule, kind, intervals)
        done = known.get((request.task, rule, kind, intervals))
        found = done.solution if done else solve(plan_problem(request), method(kind, intervals))
        costs[item] = found.cost
    rows: list[Row] = []
    for (task, key, kind, intervals), cost in costs.items():
        finest: tuple[str, str, Transcription, int] = (task, key, "points", MESHES["points"][-1])
        if task == "minimum_time":
            finest = (task, key, "held", LIFT_MESHES[-1])
        reference = costs[finest]
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


def _all(plans: Mapping[str, Mapping[str, Plan]]) -> list[Plan]:
    return [plan for group in plans.values() for plan in group.values()]
