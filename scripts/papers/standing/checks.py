"""Plans looked at between their nodes: zero moment point in its region, limits, tip on its path, ground pushed."""

from __future__ import annotations

import numpy as np

from models.machines.standing import StandingMotion
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Pinned, ZmpRule
from scripts.papers.run import Row
from scripts.papers.standing.cases import machine
from scripts.papers.standing.plans import FINER, LIFT_LIMITS, LIMITS, METHOD_NAMES, Plan

__all__ = ["ALLOWED", "check", "failures", "region_excess"]

ALLOWED = {
    "zmp_excess_m": 1e-3,
    "joint_excess_rad": 1e-6,
    "velocity_excess_rad_s": 1e-6,
    "acceleration_excess_rad_s2": 1e-6,
    "torque_excess_n_m": 1e-6,
    "friction_excess": 1e-6,
    "tip_error_m": 1e-5,
    "vertical_force_missing_n": 1e-6,
}
"""What a plan may be off by, at any of the ten times as many instants."""


def check(key: str, plan: Plan) -> Row:
    """One row of the table of checks: how far each thing is beyond what it may be, 0 where it holds."""
    request, motion = plan.request, plan.motion
    limits = LIFT_LIMITS if request.task == "minimum_time" else LIMITS
    bounds = limits.bounds(machine())
    least = limits.vertical_force or 0.0

    def beyond(values: np.ndarray, most: np.ndarray) -> float:
        return max(0.0, float((np.abs(values) - most).max()))

    by_name = {
        "zmp_excess_m": region_excess(request.rule, motion),
        "joint_excess_rad": max(0.0, float(motion.joint_excess.max())),
        "velocity_excess_rad_s": beyond(motion.joint_velocities, bounds.velocity),
        "acceleration_excess_rad_s2": beyond(motion.joint_accelerations, bounds.acceleration),
        "torque_excess_n_m": beyond(motion.joint_torques, bounds.torque),
        "friction_excess": max(0.0, float(motion.friction.max()) - limits.friction),
        "tip_error_m": plan.tip_error,
        "vertical_force_missing_n": max(0.0, least - float(motion.ground_force[:, 2].min())),
    }
    missed = failures(plan)
    return {
        "task": request.task,
        "plan": key,
        "method": METHOD_NAMES[request.transcription],
        "intervals": request.intervals,
        "instants": request.intervals * FINER,
        "drawn": request.has_figure,
        **by_name,
        "zmp_min_m": float(motion.zero_moment_point[:, 1].min()),
        "zmp_max_m": float(motion.zero_moment_point[:, 1].max()),
        "vertical_force_min_n": float(motion.ground_force[:, 2].min()),
        "holds": all(by_name[name] <= limit for name, limit in ALLOWED.items()),
        "audit": "; ".join(f"{name} {value:.2g} > {most:.2g}" for name, value, most in missed) or "passed",
    }


def failures(plan: Plan) -> list[tuple[str, float, float]]:
    """Findings of the audit beyond their limits: name, value, limit."""
    return [(one.name, one.value, one.limit or 0.0) for one in plan.audit.failures]


def region_excess(rule: ZmpRule, motion: StandingMotion) -> float:
    """How far the zero moment point leaves the region of its rule, m; 0 where it may be anywhere."""
    axes = list(machine().moving_axes)
    points = motion.zero_moment_point[:, axes]
    if isinstance(rule, InFoot):
        return max(0.0, rule.margin - float(motion.foot_margin.min()))
    if isinstance(rule, IndexAtLeast):
        radius = machine().half_widths[axes] * np.sqrt(1 - rule.value)
        return max(0.0, float((np.abs(points - machine().most_stable_point[axes]) - radius).max()))
    if isinstance(rule, Pinned):
        place = np.asarray(machine().most_stable_point if rule.point is None else rule.point, dtype=float)
        return float(np.abs(points - place[axes]).max())
    if isinstance(rule, Anywhere):
        return 0.0
    raise TypeError(f"no region for {rule!r}")
