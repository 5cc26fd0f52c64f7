"""The mobile manipulator of gallery_standing in the gallery, and what it shares with others that stand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from models.arrays import Array
from ocp import Audit, TipTask
from ocp.app.frames import frames_along
from ocp.audit.clearance import Nearest
from ocp.tasks.equations import task_errors
from scripts.robots import standing
from scripts.robots.drawing import Scene, animate
from scripts.robots.results import joint_return, save_motion, save_plan

__all__ = ["StandingExample", "animated", "draw", "plan"]


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
    def nearest(self) -> Nearest:
        """The two bodies of the robot that come nearest to each other along the plan."""
        return min(self.audit.clearances["clearance"].pairs, key=lambda pair: pair.distance)

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        found = self.results
        motion = found.motion
        nearest = self.nearest
        errors = task_errors(found.machine, self.task, motion.t, None, motion.joints)
        return {
            "robot": self.name,
            "dof": found.robot.dof,
            "task_rows": len(standing.ROWS),
            "duration_s": found.solution.horizon,
            "cost_local": None,
            "cost_optimal": float(found.solution.cost),
            "tip_error": float(np.abs(errors).max()),
            "momentum_drift_relative": None,
            "joint_return_rad": joint_return(found.solution),
            "audit_passed": self.audit.passed,
            "audit_tolerances": dict(self.tolerances),
            "clearance_m": nearest.distance,
            "clearance_pair": list(nearest.bodies),
            "zmp_margin_local_m": float(found.local.foot_margin.min()),
            "zmp_margin_optimal_m": float(motion.foot_margin.min()),
        }


def plan(coarse: bool = False) -> StandingExample:
    """The plan and its audit; it has one mesh only, `coarse` or not."""
    found = standing.plan()
    audit = found.solution.audit(tolerances=standing.TOLERANCES)
    task = standing.from_rest(standing.circle(found.machine))
    return StandingExample("TIAGo with a load in its hand", found, task, audit, standing.TOLERANCES)


def draw(example: StandingExample, folder: Path, *, animation: bool = True) -> None:
    """mobile_manipulator.png, .gif and .npz."""
    found = example.results
    standing.draw(folder, found)
    save(folder / "mobile_manipulator.npz", example)
    if not animation:
        return
    corners = np.asarray(found.footprint.support.vertices)
    ground = np.column_stack([np.vstack([corners, corners[:1]]), np.zeros(len(corners) + 1)])
    note = (
        f"Grey: footprint; diamond: zero moment point; the arm from the wheels to the hand. A rope pulls the hand "
        f"forward with {standing.PULL:g} N."
    )
    animated(folder / "mobile_manipulator.gif", found, ground, note=note, nearest=example.nearest)


def save(path: Path, example: StandingExample) -> None:
    """Both motions: the plan, and beside it the one instant by instant as NAME.local.csv."""
    found, local = example.results, example.results.local
    save_plan(path, found.machine, found.solution, [example.task])
    names = found.machine.robot.joint_names
    save_motion(path.with_suffix(".local.csv"), names, local.t, local.joints, local.joint_velocities)


def animated(
    path: Path,
    found: standing.Results,
    outline: Array,
    *,
    note: str,
    nearest: Nearest,
    view: tuple[float, float] = (16.0, -50.0),
) -> None:
    """A GIF of the local motion beside the plan, with their zero moment points; arguments as of Scene and animate.

    The bodies that come nearest to each other along the plan are joined by a line.
    """
    note += (
        f" Purple: where {nearest.bodies[0]} and {nearest.bodies[1]} come nearest, {1000 * nearest.distance:.1f} mm."
    )
    robot, machine, scenes = found.robot, found.machine, []
    for title, motion, color in (("instant by instant", found.local, "orange"), ("planned", found.motion, "blue")):
        frames = frames_along(machine, motion.joints)
        zmp = np.column_stack([motion.zero_moment_point, np.zeros(len(motion.t))])
        scenes.append(Scene(title, robot, frames, motion.t, color, outline=outline, mark=zmp, view=view))
        if motion is found.motion:
            scenes[-1] = replace(scenes[-1], nearest_points=nearest.points)
    animate(path, scenes, frames=50, seconds=0.1, note=note)
