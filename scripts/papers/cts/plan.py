"""Roll over the paper's whole sweep at once, beside the best roll of each target by itself: limits and an obstacle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import Box, Rig, Tunnel, optimal_inverse
from models.checks import Array
from models.cts.clearance import Avoidance, CollisionScene, clearances
from models.cts.rig import INCH, inverse
from models.cts.roll import index_harmonics
from ocp import Collocation, Problem, RollSettings, roll_problem, solve
from scripts.drawing import COLORS, DASHES, sheet

HORIZON = 10.0  # s, the paper's sweep
RATE_LIMIT, ACCELERATION_LIMIT = 0.37, 0.4  # rad/s, rad/s^2
RATE_WEIGHT, ACCELERATION_WEIGHT = 0.05, 0.02  # s^2, s^4
CLEARANCE = 0.05  # m
METHOD = Collocation(intervals=120, degree=3)


@dataclass(frozen=True)
class Course:
    """A roll over time and what it costs.

    Attributes:
        roll, rate: rad, rad/s. Shape (samples,).
        index: I1. Shape (samples,).
        clearance: Least distance of the rig to the obstacle, m. Shape (samples,).
    """

    roll: Array
    rate: Array
    index: Array
    clearance: Array


@dataclass(frozen=True)
class RollPlan:
    """The plan and the roll of each target by itself, at the same times t, s; and whether the plan's audit passed."""

    t: Array
    plan: Course
    single: Course
    cost: float
    passed: bool
    audit: str


def targets(t: Any) -> list[Any]:
    """The paper's sweep, z from -15 to 15 in at 3 in/s."""
    return [100 * INCH, 6 * INCH, (-15 + 3 * t) * INCH, 0.0, 0.0]


def obstacle() -> CollisionScene:
    """A block beside the path of the goose-neck; chosen."""
    return CollisionScene(solids=(Box(INCH * np.array([6.0, 4.0, 4.0]), INCH * np.array([80.0, -9.0, 3.0])),))


def sweep_problem(rig: Rig, tunnel: Tunnel) -> Problem:
    """The problem of the plan."""
    return roll_problem(
        rig,
        tunnel,
        targets,
        HORIZON,
        settings=RollSettings(
            rate_weight=RATE_WEIGHT,
            acceleration_weight=ACCELERATION_WEIGHT,
            rate_limit=RATE_LIMIT,
            acceleration_limit=ACCELERATION_LIMIT,
            symbols=ca.SX,
        ),
        avoidance=Avoidance(obstacle(), clearance=CLEARANCE),
    )


def plan_sweep(rig: Rig, tunnel: Tunnel) -> RollPlan:
    """Solve and audit the plan; evaluate it and the roll of each target by itself on a fine grid."""
    solution = solve(sweep_problem(rig, tunnel), METHOD)
    audit = solution.audit()
    t = np.linspace(0, HORIZON, 401)
    rows = np.array([np.broadcast_to(part, len(t)) for part in targets(t)])
    dense = solution.at(t)
    planned = np.asarray(dense["roll"]).ravel(), np.asarray(dense["rate"]).ravel()
    single = np.array(optimal_inverse(rig, tunnel).map(len(t))(rows, np.zeros((1, len(t))))[0])[5]
    x, phi = ca.SX.sym("x", 5), ca.SX.sym("phi")
    gaps = clearances(rig, inverse(rig, x, phi)[0], obstacle())
    cost = index_harmonics(rig, tunnel, x).value(ca.cos(phi), ca.sin(phi))
    measure = ca.Function("measure", [x, phi], [cost, ca.mmin(ca.vertcat(*gaps.values()))]).map(len(t))

    def course(roll: Array, rate: Array) -> Course:
        index, gap = (np.array(part)[0] for part in measure(rows, roll[None]))
        return Course(roll, rate, index, gap)

    kept = course(*planned)
    alone = course(single, np.gradient(single, t))
    return RollPlan(t, kept, alone, solution.cost, audit.passed, str(audit))


def plan_summary(result: RollPlan) -> dict[str, Any]:
    """The numbers that matter."""

    def of(course: Course) -> dict[str, float]:
        integral = float(np.trapezoid(course.index, result.t))
        return {
            "index_integral_s": integral,
            "rate_max_rad_s": float(np.abs(course.rate).max()),
            "least_clearance_m": float(course.clearance.min()),
        }

    return {
        "plan": of(result.plan),
        "each_target_by_itself": of(result.single),
        "cost": result.cost,
        "audit_passed": result.passed,
        "rate_limit_rad_s": RATE_LIMIT,
        "acceleration_limit_rad_s2": ACCELERATION_LIMIT,
        "clearance_m": CLEARANCE,
    }


def draw_plan(path: Path, result: RollPlan) -> None:
    """Roll, roll rate, I1 and clearance of the plan and of each target by itself."""
    note = (
        f"Least integral of I1 + {RATE_WEIGHT:g} rate² + {ACCELERATION_WEIGHT:g} acceleration² over "
        f"the paper's sweep; rate at most {RATE_LIMIT:g} rad/s, acceleration {ACCELERATION_LIMIT:g} rad/s². Limits, "
        "weights and the obstacle, a block beside the goose-neck, are chosen; so are the link lengths."
    )
    names = ("roll", "rate", "index", "clearance")
    labels = ("roll $q_6$, rad", "roll rate, rad/s", "index $I_1$", "clearance of the rig, m")
    title = "Planned as a whole, the roll satisfies the limits of rate and clearance; target by target, it does not"
    with sheet(path, (2, 2), (8.2, 5.3), note, title=title, sharex=True, xlabel="time, s") as (_, axes):
        for ax, name, label in zip(axes.flat, names, labels, strict=True):
            ax.plot(
                result.t, getattr(result.single, name), ls=DASHES[1], color=COLORS["orange"], label="each by itself"
            )
            ax.plot(result.t, getattr(result.plan, name), color=COLORS["blue"], label="whole trajectory")
            ax.set_ylabel(label)
        limits = ((axes[0, 1], RATE_LIMIT, "limit"), (axes[1, 1], CLEARANCE, "least allowed"))
        for ax, limit, label in limits:
            ax.axhline(limit, color=COLORS["grey"], ls=DASHES[2], label=label)
        for ax in (axes[0, 0], axes[0, 1], axes[1, 1]):
            ax.legend(loc="best")
        axes[1, 1].set_ylim(0, None)
