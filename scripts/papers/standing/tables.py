"""Tables, summary and printed report of the standing paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from models.machines.standing import StandingMotion
from scripts.papers.run import Content, Row, Table, compared, text_table
from scripts.papers.standing.cases import ASSUMED, CHOSEN, GAINS
from scripts.papers.standing.checks import ALLOWED
from scripts.papers.standing.drawing import lowest_point
from scripts.papers.standing.plans import HELD, LIFT_SETTINGS, SETTINGS, Held
from scripts.papers.standing.results import Results

FIGURE = "paper"
REFERENCE = "reference"
REFERENCE_HELD = "reference, held"
"""Where a known number comes from: the figures of the paper (it prints no results), or an independent computation,
whose plans have accelerations held and are compared with ours solved so, not with those drawn."""

KNOWN: tuple[tuple[str, str, str, str, float], ...] = (
    ("table1", "augmented", "index_min", FIGURE, 1.0),
    ("table1", "augmented", "reaches_s", FIGURE, 2 * np.pi),
    ("table1", "augmented", "time_s", REFERENCE, 1.13),
    ("table1", "augmented", "diverges_s", REFERENCE, 1.26),
    ("table1", "as_printed", "index_min", REFERENCE, 0.84),
    ("table1", "pseudo_inverse", "zmp_min_m", REFERENCE, -0.066),
    ("table1", "pseudo_inverse", "zmp_max_m", REFERENCE, 0.250),
    ("table1", "pseudo_inverse", "index_min", REFERENCE, -5.3),
    ("table1", "pseudo_inverse", "cost", REFERENCE, 2.49),
    ("table1", "damped", "cost", REFERENCE, 0.57),
    ("table1", "stabilised", "index_min", REFERENCE, 1.0),
    ("table1", "stabilised", "cost", REFERENCE, 0.17),
    ("table1", "stabilised", "peak_joint_velocity_rad_s", REFERENCE, 0.99),
    ("table1", "stabilised", "peak_joint_acceleration_rad_s2", REFERENCE, 5.9),
    ("table1", "stabilised", "vertical_force_min_n", REFERENCE, 589.0),
    ("table2", "augmented_spring", "index_min", FIGURE, 1.0),
    ("table2", "augmented_spring", "reaches_s", FIGURE, 2 * np.pi),
    *(
        ("table1", key, quantity, REFERENCE_HELD, value)
        for key, values in {
            "optimal_range": (-0.7078, 0.359, 1.02, 3.4),
            "optimal_index_half": (-0.653, 0.499, 1.03, 3.4),
            "optimal_index_nine_tenths": (-0.379, 0.900, 1.08, 3.5),
            "optimal_pinned": (-0.1104, 0.998, 1.26, 4.2),
            "optimal_free": (-1.022, -2.9, 1.09, 3.6),
        }.items()
        for quantity, value in zip(
            ("cost", "index_min", "peak_joint_velocity_rad_s", "peak_joint_acceleration_rad_s2"), values, strict=True
        )
    ),
    ("table2", "optimal_spring", "cost", REFERENCE_HELD, -2.316),
    ("table2", "optimal_spring_index_nine_tenths", "cost", REFERENCE_HELD, -2.235),
    ("table2", "optimal_spring_pinned", "cost", REFERENCE_HELD, -2.000),
    ("minimum_time", "free", "reaches_s", REFERENCE_HELD, 0.457),
    ("minimum_time", "in_foot", "reaches_s", REFERENCE_HELD, 0.503),
    ("minimum_time", "index_nine_tenths", "reaches_s", REFERENCE_HELD, 0.539),
)
"""Task, motion, quantity, source, value."""

CAVEATS = {
    "figure 4": "pinning the zero moment point at acceleration level is unstable: the index is 1 by construction while "
    "the machine lifts off. With the sign of C as printed in (22) it survives, with an index that is not 1: a likely "
    "cause of the figure",
    "local costs": "of the motion up to where it stops, which is before the horizon where it lifts off or diverges",
    "stabilised": "poles and damping are the reference's; the gain of p1 that it leaves open is 0 here. Its cost and "
    "peak acceleration are not met: stabiliser.csv shows what other gains give; none is chosen by it",
    "pinned plans": "accelerations held over intervals leave a pinned point between the nodes: the plan drawn has them "
    "free at Legendre points; the held one is the one of the reference, and its cost still falls with the intervals "
    "(5 % from its limit on Table 1 at 80, see convergence.csv)",
    "reference, held": f"its plans have accelerations held, over {HELD['table1']} intervals of the tables "
    f"and {HELD['minimum_time']} of the lift; they are compared with ours solved so, which cost more "
    "than those drawn where a constraint of the ground or of a torque is active, in proportion to the interval",
    "audit": "every plan drawn is feasible and none is found to be no optimum; where it is not decided audit.txt says "
    "why. A lift is an optimum under limits drawn in to hold between its nodes",
    "figure 10": "text and caption differ in whether the spring pulls: both are shown",
}
PRINTED = (
    "task",
    "motion",
    "reason",
    "time_s",
    "cost",
    "index_min",
    "zmp_min_m",
    "zmp_max_m",
    "vertical_force_min_n",
    "leaves_joint_limits_s",
    "peak_joint_velocity_rad_s",
    "peak_joint_acceleration_rad_s2",
)
"""Columns of the table of motions that are printed; all are in motions.csv."""


def files(results: Results) -> Mapping[str, Content]:
    """What is written beside the figures."""
    return {
        "comparison.csv": Table(comparison_table(results), digits=7),
        "motions.csv": Table(motion_table(results), digits=7),
        "checks.csv": Table(results.checks, digits=5),
        "convergence.csv": Table(results.convergence, digits=9),
        "layers.csv": Table(results.layers, digits=5),
        "stabiliser.csv": Table(results.stabiliser, digits=6),
        "audit.txt": audit_text(results),
        "summary.json": summary(results),
    }


def sound(results: Results) -> bool:
    """Whether every drawn plan holds what it must between its nodes and its audit finds nothing beyond its limit."""
    held = all(row["holds"] for row in results.checks if row["drawn"])
    plotted = [plan for group in results.plans.values() for plan in group.values() if plan.request.has_figure]
    return held and not any(plan.audit.failures for plan in plotted)


def report(results: Results) -> str:
    """Known value, our value and the difference, and every table."""
    motions = [{name: row[name] for name in PRINTED} for row in motion_table(results)]
    apart = max(forms_difference(results).values())
    caveats = "\n".join(f"  {what}: {words}" for what, words in CAVEATS.items())
    return "\n\n".join(
        [
            "Known value, ours and the difference; reaches_s: how far the motion goes before it fails\n"
            + text_table(comparison_table(results), 5),
            "Every motion\n" + text_table(motions, 4),
            "Plans at ten times as many instants\n" + text_table([_short(row) for row in results.checks], 3),
            "Convergence\n" + text_table(results.convergence, 7),
            "Layers over a pinned zero moment point, Table 1\n" + text_table(results.layers, 4),
            "Gains of the stabilised law, Table 1\n" + text_table(results.stabiliser, 4),
            f"Augmented and null-space form differ by at most {apart:.1e} (rad, rad/s, rad/s²)\n{caveats}",
            f"{ASSUMED}.\n{CHOSEN}.\n{GAINS}.\n{SETTINGS}.\n{LIFT_SETTINGS}.",
        ]
    )


def _short(row: Row) -> Row:
    """A row of checks without the bounds that nothing exceeds."""
    names = ("task", "plan", "method", "drawn", "zmp_excess_m", "tip_error_m", "vertical_force_min_n")
    limits = max(value for name, value in row.items() if "excess" in name and not name.startswith("zmp"))
    return {**{name: row[name] for name in names}, "limit_excess": limits, "holds": row["holds"], "audit": row["audit"]}


def audit_text(results: Results) -> str:
    """The audit of every plan."""
    parts = [
        f"{task}, {key}: {plan.request.title}, {plan.request.intervals} intervals\n{plan.audit}"
        for task, group in results.plans.items()
        for key, plan in group.items()
    ]
    return "\n\n".join(parts) + "\n"


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter, nested by what they belong to."""
    content: dict[str, Any] = {
        "paper": {"source": "Yoo, So, Yi, Kim 2004: redundancy resolution with the zero moment point"},
        "assumptions": [ASSUMED, CHOSEN, GAINS, SETTINGS, LIFT_SETTINGS],
        "caveats": CAVEATS,
        "forms_difference": forms_difference(results),
        "table1": {},
        "table2": {},
        "minimum_time": {},
    }
    for row in motion_table(results):
        numbers = {name: value for name, value in row.items() if name not in ("task", "motion", "time_s")}
        content[row["task"]][row["motion"]] = numbers
    for task, laws in results.local.items():
        for key, result in laws.items():
            stopped = result.reason in ("lift_off", "divergence", "breakdown")
            content[task][key] |= {
                "verdict": result.words,
                "fails_s": None if result.reason == "stands" else result.time,
                "stopped_s": result.time if stopped else None,
                "diverges_s": result.diverges,
            }
    checks = {(row["task"], row["plan"]): row for row in results.checks}
    for task, plans in results.plans.items():
        for key, plan in plans.items():
            row = checks[task, key]
            content[task][key] |= {
                "intervals": plan.request.intervals,
                "iterations": plan.solution.iterations,
                "audit_passed": plan.audit.passed,
                "audit": row["audit"],
                "undecided": plan.audit.undecided,
                "held": held_numbers(results.held[task][key]),
                "holds_between_nodes": row["holds"],
                "drawn": plan.request.has_figure,
            }
    for key, plan in results.plans["minimum_time"].items():
        content["minimum_time"][f"{key}_s"] = plan.solution.horizon
    content["convergence"] = results.convergence
    plotted = [row for row in results.checks if row["drawn"]]
    content["checks"] = {
        "allowed": ALLOWED,
        "worst_of_drawn_plans": {name: max(row[name] for row in plotted) for name in ALLOWED},
        "all_drawn_plans_hold": all(row["holds"] for row in plotted),
        "sound": sound(results),
    }
    return content


def motion_table(results: Results) -> list[Row]:
    """Cost, index, limits and peak rates of every motion, local and optimal."""
    rows: list[Row] = []
    for task in results.plans:
        for key, result in results.local.get(task, {}).items():
            verdict = {"reason": result.reason, "time_s": result.time}
            rows.append(
                _motion_row(task, key, result.case.title, verdict, result.cost, result.motion, result.tip_error)
            )
        for key, plan in results.plans[task].items():
            motion, title = plan.motion, f"optimal, {plan.request.title}"
            tipping = motion.t[motion.foot_margin < 0]
            verdict = {"reason": "stands", "time_s": float(motion.t[-1])}
            if tipping.size:
                verdict = {"reason": "tips", "time_s": float(tipping[0])}
            rows.append(_motion_row(task, key, title, verdict, plan.solution.cost, motion, plan.tip_error))
    return rows


def _motion_row(
    task: str, key: str, title: str, verdict: Row, cost: float, motion: StandingMotion, tip_error: float
) -> Row:
    extremes = motion.summary()
    beyond = motion.t[motion.joint_excess > 1e-6]
    return {
        "task": task,
        "motion": key,
        "title": title,
        **verdict,
        "reaches_s": float(motion.t[-1]),
        "cost": cost,
        "index_min": float(motion.index[:, 1].min()),
        "zmp_min_m": extremes["zmp_y_min_m"],
        "zmp_max_m": extremes["zmp_y_max_m"],
        "foot_margin_min_m": extremes["foot_margin_min_m"],
        "vertical_force_min_n": extremes["vertical_force_min_n"],
        "joint_excess_max_rad": extremes["joint_excess_max"],
        "leaves_joint_limits_s": float(beyond[0]) if beyond.size else "never",
        "lowest_point_of_arm_m": lowest_point(motion.joints),
        "joint_limit_index_max": extremes["joint_limit_index_max"],
        "manipulability_min_m2": extremes["manipulability_min"],
        "peak_joint_velocity_rad_s": extremes["peak_joint_velocity"],
        "peak_joint_acceleration_rad_s2": extremes["peak_joint_acceleration"],
        "peak_joint_torque_n_m": extremes["peak_joint_torque"],
        "tip_error_m": tip_error,
    }


def comparison_table(results: Results) -> list[Row]:
    """Known value, ours and the difference."""
    motions = {(row["task"], row["motion"]): row for row in motion_table(results)}
    rows: list[Row] = []
    for task, key, quantity, source, value in KNOWN:
        if quantity == "diverges_s":
            ours = results.local[task][key].diverges or float("nan")
        elif source == REFERENCE_HELD:
            ours = held_numbers(results.held[task][key])[quantity]
        else:
            ours = float(motions[task, key][quantity])
        names = {"task": task, "motion": key, "quantity": quantity, "source": source}
        rows.append({**names, **compared(value, ours, source="known")})
    return rows


def held_numbers(held: Held) -> dict[str, float]:
    """What is compared with the reference's plans, of ours with accelerations held as well."""
    extremes = held.motion.summary()
    return {
        "cost": held.solution.cost,
        "reaches_s": held.solution.horizon,
        "index_min": float(held.motion.index[:, 1].min()),
        "peak_joint_velocity_rad_s": extremes["peak_joint_velocity"],
        "peak_joint_acceleration_rad_s2": extremes["peak_joint_acceleration"],
    }


def forms_difference(results: Results) -> dict[str, float]:
    """Largest difference of the augmented and the null-space form on Table 1 up to the lift-off, by quantity."""
    one, two = (results.local["table1"][key].motion for key in ("augmented", "null_space"))
    kinds: dict[str, Any] = {
        "joints_rad": (one.joints, two.joints),
        "joint_velocities_rad_s": (one.joint_velocities, two.joint_velocities),
        "joint_accelerations_rad_s2": (one.joint_accelerations, two.joint_accelerations),
    }
    return {name: float(np.abs(a - b).max()) for name, (a, b) in kinds.items()}
