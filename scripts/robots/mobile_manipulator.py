"""The mobile manipulator of standing.py in the gallery, and what it shares with others that stand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ocp import Audit, TipTask
from ocp.audit.clearance import ClosestPair
from ocp.motion.tasks.equations import task_errors
from scripts.robots import standing
from scripts.robots.drawing import animate
from scripts.robots.results import joint_return, save_motion, save_plan

__all__ = ["StandingExample", "draw", "plan", "save"]


@dataclass(frozen=True, eq=False)
class StandingExample:
    """A standing robot's plan and its audit.

    Attributes:
        name: Of the robot, with what it carries.
        results: The plan, and the local motion of the same task.
        task: What the hand does.
        audit: Of the plan. tolerances: Those of the audit that are not the default.
    """

    name: str
    results: standing.Results
    task: TipTask
    audit: Audit
    tolerances: Mapping[str, float] = field(default_factory=dict)

    @property
    def nearest(self) -> ClosestPair:
        """The two bodies of the robot that come nearest to each other along the plan."""
        return min(self.audit.clearances["clearance"].pairs, key=lambda pair: pair.distance)

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        result = self.results
        motion = result.motion
        nearest = self.nearest
        errors = task_errors(result.machine, self.task, motion.t, motion.joints)
        return {
            "robot": self.name,
            "dof": result.robot.dof,
            "task_rows": len(standing.ROWS),
            "duration_s": result.solution.horizon,
            "cost_local": None,
            "cost_optimal": float(result.solution.cost),
            "tip_error": float(np.abs(errors).max()),
            "momentum_drift_relative": None,
            "joint_return_rad": joint_return(result.solution),
            "audit_passed": self.audit.passed,
            "audit_tolerances": dict(self.tolerances),
            "clearance_m": nearest.distance,
            "clearance_pair": list(nearest.bodies),
            "zmp_margin_local_m": float(result.local.foot_margin.min()),
            "zmp_margin_optimal_m": float(motion.foot_margin.min()),
        }


def plan(coarse: bool = False) -> StandingExample:
    """The plan and its audit; it has one mesh only, `coarse` or not."""
    result = standing.plan()
    audit = result.solution.audit(tolerances=standing.TOLERANCES)
    task = standing.from_rest(standing.circle(result.machine))
    return StandingExample("TIAGo with a load in its hand", result, task, audit, standing.TOLERANCES)


def draw(example: StandingExample, folder: Path, *, animation: bool = True) -> None:
    """mobile_manipulator.png, .gif and .npz."""
    result, nearest = example.results, example.nearest
    note = (
        f"TIAGo of {result.robot.total_mass:.0f} kg moves {standing.LOAD:g} kg along a circle in {standing.SECONDS:g} "
        f"s while a rope pulls its hand forward with {standing.PULL:g} N; earlier configurations are pale; disc: zero "
        "moment point, grey: inside the footprint. Footprint, inertias and limits from its URDF (example-robot-data); "
        f"both motions have the same hand path and force. Plan: zero moment point {1000 * standing.MARGIN:g} mm "
        f"inside, {100 * standing.SHARE:g} % of the limits of velocity and torque; {nearest.bodies[0]} and "
        f"{nearest.bodies[1]} come nearest, {1000 * nearest.distance:.1f} mm (in the animation: purple)."
    )
    speed = float((np.abs(result.local.joint_velocities) / result.robot.velocity).max())
    title = f"By local resolution TIAGo tips over, at {speed:.1f} times a speed limit; the plan keeps all limits"
    standing.figure(folder / "mobile_manipulator.png", result, note=note, title=title)
    save(folder / "mobile_manipulator.npz", example)
    if animation:
        scenes = standing.scenes_of(result, (14.0, -50.0), nearest.points)
        animate(folder / "mobile_manipulator.gif", scenes, frames=40, seconds=0.1, note=note)


def save(path: Path, example: StandingExample) -> None:
    """Both motions: the plan, and beside it the one by local resolution as NAME.local.csv."""
    result, local = example.results, example.results.local
    save_plan(path, result.machine, result.solution, [example.task])
    names = result.machine.robot.joint_names
    save_motion(path.with_suffix(".local.csv"), names, local.t, local.joints, local.joint_velocities)
