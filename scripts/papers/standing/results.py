"""The standing machine of Yoo et al. 2004 by local laws and by optimal control: what its script draws and tabulates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from models.machines.standing_motion import StandingMotion
from scripts.drawing import Row
from scripts.papers.standing.cases import Local, layer_rows, local_motions, stabiliser_rows
from scripts.papers.standing.checks import check
from scripts.papers.standing.drawing import lowest_point
from scripts.papers.standing.plans import PLANS, Plan, convergence_rows, make

__all__ = ["Results", "comparison_table", "compute", "forms_difference", "motion_table", "progress"]

Item = TypeVar("Item")

FIGURE = "paper"
REFERENCE = "reference"
"""Where a known number comes from: the figures of the paper (it prints no results), or an independent computation."""

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
        ("table1", key, quantity, REFERENCE, value)
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
    ("table2", "optimal_spring", "cost", REFERENCE, -2.316),
    ("table2", "optimal_spring_index_nine_tenths", "cost", REFERENCE, -2.235),
    ("table2", "optimal_spring_pinned", "cost", REFERENCE, -2.000),
    ("minimum_time", "free", "reaches_s", REFERENCE, 0.457),
    ("minimum_time", "in_foot", "reaches_s", REFERENCE, 0.503),
    ("minimum_time", "index_nine_tenths", "reaches_s", REFERENCE, 0.539),
)
"""Task, motion, quantity, source, value."""


@dataclass(frozen=True)
class Results:
    """Everything that is drawn, tabled and summarised.

    Attributes:
        local, plans: By task and summary key.
        checks: A row for each plan, between its nodes.
        layers, stabiliser, convergence: Rows of the tables.
    """

    local: Mapping[str, Mapping[str, Local]]
    plans: Mapping[str, Mapping[str, Plan]]
    checks: list[Row]
    layers: list[Row]
    stabiliser: list[Row]
    convergence: list[Row]


def compute() -> Results:
    """Simulate and solve everything."""
    requests = [(task, key) for task, group in PLANS.items() for key in group]
    plans: dict[str, dict[str, Plan]] = {task: {} for task in PLANS}
    for task, key in progress(requests, "plans"):
        plans[task][key] = make(PLANS[task][key])
    return Results(
        local=local_motions(),
        plans=plans,
        checks=[check(key, plan) for group in plans.values() for key, plan in group.items()],
        layers=layer_rows(),
        stabiliser=stabiliser_rows(),
        convergence=convergence_rows(plans, lambda work: progress(work, "convergence")),
    )


def progress(items: Iterable[Item], title: str) -> Iterable[Item]:
    """The items, with a bar on the terminal while they are worked through."""
    bar: Iterable[Item] = tqdm(items, title, leave=False, disable=None)
    return bar


def motion_table(results: Results) -> list[Row]:
    """Cost, index, limits and peak rates of every motion, local and optimal."""
    rows: list[Row] = []
    for task in results.plans:
        for key, found in results.local.get(task, {}).items():
            verdict = {"reason": found.reason, "time_s": found.time}
            rows.append(_motion_row(task, key, found.case.title, verdict, found.cost, found.motion, found.tip_error))
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
        else:
            ours = float(motions[task, key][quantity])
        rows.append(
            {
                "task": task,
                "motion": key,
                "quantity": quantity,
                "source": source,
                "known": value,
                "ours": ours,
                "difference": ours - value,
            }
        )
    return rows


def forms_difference(results: Results) -> dict[str, float]:
    """Largest difference of the augmented and the null-space form on Table 1 up to the lift-off, by quantity."""
    one, two = (results.local["table1"][key].motion for key in ("augmented", "null_space"))
    kinds: dict[str, Any] = {
        "joints_rad": (one.joints, two.joints),
        "joint_velocities_rad_s": (one.joint_velocities, two.joint_velocities),
        "joint_accelerations_rad_s2": (one.joint_accelerations, two.joint_accelerations),
    }
    return {name: float(np.abs(a - b).max()) for name, (a, b) in kinds.items()}
