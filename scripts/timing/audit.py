"""How long an audit takes beside the solve that it checks, and how both grow with the number of intervals.

What a user waits for is the whole solve, the program built and solved, and the first audit, which derives what it needs
of the problem. Where one program is solved many times, the solve alone and an audit that has all of this remain.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, MultipleShooting, Problem, prepare
from scripts import drawing
from scripts.papers.free_floating.formulations import problem as free_floating
from scripts.papers.run import progress, text_table
from scripts.timing.build_and_solve import growth
from scripts.timing.measure import median, timed

INTERVALS = (50, 100, 200, 400, 800)
GOAL_RATIO = 1.0  # an audit takes at most the time of the solve
GOAL_GROWTH = 1.2  # and grows linearly, within 20 %


def pendulum() -> Problem:
    """A pendulum swung up with a limited torque: a bound that is active along arcs."""
    problem = Problem("pendulum")
    angle = problem.state("angle", initial=0.0, terminal=np.pi)
    rate = problem.state("rate", initial=0.0, terminal=0.0)
    torque = problem.control("torque", lower=-0.8, upper=0.8)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque - ca.sin(angle))
    problem.horizon(8.0)
    problem.minimize(running=torque**2 / 2)
    return problem


CASES: dict[str, tuple[Callable[[], Problem], Callable[[int], Any]]] = {
    "free-floating arm, Radau 3": (free_floating, Collocation),
    "free-floating arm, shooting, linear": (free_floating, partial(MultipleShooting, control="linear")),
    "pendulum, Radau 3": (pendulum, Collocation),
    "pendulum, shooting, held": (pendulum, MultipleShooting),
}
"""Problem, and method on a number of intervals."""


def run(repeats: int = 5) -> dict[str, Any]:
    """Times of solve and audit for every case and number of intervals; the worst ratio, the fastest growth."""
    rows = [
        audit_times(case, n, repeats) for case, n in progress([(case, n) for case in CASES for n in INTERVALS], "audit")
    ]
    by_case = {case: growth([row for row in rows if row["case"] == case], "audit_s") for case in CASES}
    return {
        "rows": rows,
        "growth_over_linear": [{"case": case, "audit": value} for case, value in by_case.items()],
        "worst_ratio": max(row["audit_over_solve"] for row in rows),
        "worst_ratio_to_whole": max(row["first_audit_over_whole"] for row in rows),
        "worst_growth_over_linear": max(by_case.values()),
        "goals": {"worst_ratio": GOAL_RATIO, "worst_growth_over_linear": GOAL_GROWTH},
    }


def audit_times(case: str, intervals: int, repeats: int) -> dict[str, Any]:
    """One row: median times of a solve, built before, and of the audit of its plan; and of its first audit."""
    declare, method = CASES[case]
    prepared = prepare(declare(), method(intervals))
    plan = prepared.solve()
    audit, first = timed(plan.audit)
    solve, judge = median(prepared.solve, repeats), median(plan.audit, repeats)
    return {
        "case": case,
        "intervals": intervals,
        "iterations": plan.iterations,
        "build_s": plan.seconds["build"],
        "solve_s": solve,
        "audit_s": judge,
        "first_audit_s": first,
        "audit_over_solve": judge / solve,
        "first_audit_over_whole": first / (solve + plan.seconds["build"]),
        "audit_ms_an_interval": 1e3 * judge / intervals,
        "passed": audit.passed,
    }


def report(summary: dict[str, Any]) -> str:
    """The times in words."""
    goals = summary["goals"]
    return (
        f"{text_table(summary['rows'], 4)}\n"
        f"audit over solve, worst: {summary['worst_ratio']:.2f}, goal {goals['worst_ratio']:g}; "
        f"the first over the solve with its build: {summary['worst_ratio_to_whole']:.2f}\n"
        f"growth of the audit from 100 to {max(INTERVALS)} intervals over linear, worst: "
        f"{summary['worst_growth_over_linear']:.2f}, goal {goals['worst_growth_over_linear']:g}"
    )


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Times of solve and audit over the number of intervals, a panel for each case."""
    note = (
        "IPOPT with MUMPS, the solve without the build, from the problem's own guess; the audit with its default "
        "limits. Dotted: linear growth from the audit's first time. Medians of one run on one machine."
    )
    title = f"The audit takes at most {summary['worst_ratio_to_whole']:.2f} of the time to build and solve the problem"
    with drawing.sheet(path, (2, 2), (7.0, 5.9), note, title=title, sharex=True, sharey=True) as (_, axes):
        for axis, case in zip(axes.ravel(), CASES, strict=True):
            rows = [row for row in summary["rows"] if row["case"] == case]
            n = [row["intervals"] for row in rows]
            axis.loglog(n, [row["solve_s"] for row in rows], "s--", label="solve")
            axis.loglog(n, [row["audit_s"] for row in rows], "o-", label="audit")
            first = rows[0]["audit_s"]
            axis.loglog(n, [first * k / n[0] for k in n], ":", color=drawing.COLORS["grey"], label="linear growth")
            axis.set(title=case, xticks=n, xticklabels=[str(k) for k in n])
            axis.minorticks_off()
        for axis in axes[-1]:
            axis.set_xlabel("intervals")
        for axis in axes[:, 0]:
            axis.set_ylabel("time, s")
        axes[0, 0].legend()
