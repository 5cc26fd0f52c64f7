"""The mobile manipulator of gallery_standing in the gallery: its audit, its summary, its animation, its plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import Robot
from ocp import Audit
from scripts import gallery_standing as standing
from scripts.gallery_drawing import Scene, animate
from scripts.gallery_frames import frames_along
from scripts.gallery_results import joint_return
from scripts.view_plan import save_plan

__all__ = ["Pushing", "draw", "plan"]


@dataclass(frozen=True, eq=False)
class Pushing:
    """What gallery_standing planned, and the audit of it."""

    results: standing.Results
    audit: Audit

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        found = self.results
        time, motion = ca.SX.sym("time"), found.motion
        hand = ca.Function("hand", [time], [ca.vertcat(*standing.timed(standing.circle(found.machine))(time))])
        wanted = np.array(hand.map(len(motion.t))(motion.t[None, :])).T
        return {
            "robot": "TIAGo with a load in its hand",
            "dof": found.robot.dof,
            "task_rows": len(standing.ROWS),
            "duration_s": found.solution.horizon,
            "cost_local": None,
            "cost_optimal": float(found.solution.cost),
            "tip_error": float(np.abs(motion.tip_in_world - wanted).max()),
            "momentum_drift_relative": None,
            "joint_return_rad": joint_return(found.solution),
            "audit_passed": self.audit.passed,
            "audit_tolerances": standing.TOLERANCES,
            "zmp_margin_local_m": float(found.local.foot_margin.min()),
            "zmp_margin_optimal_m": float(motion.foot_margin.min()),
        }


def plan(coarse: bool = False) -> Pushing:
    """The plan and its audit; it has one mesh only, `coarse` or not."""
    found = standing.plan()
    return Pushing(found, found.solution.audit(tolerances=standing.TOLERANCES))


def draw(example: Pushing, folder: Path, *, animation: bool = True) -> None:
    """mobile_manipulator.png, .gif and .npz."""
    found = example.results
    standing.draw(folder, found)
    robot, machine = found.robot, found.machine
    save_plan(
        folder / "mobile_manipulator.npz",
        found.solution,
        robot,
        {
            "tip": standing.HAND,
            "inertia": "as_given",
            "lock": {joint.name: 0.0 for joint in _whole().moving_joints if joint.name not in standing.JOINTS},
        },
        package=(standing.PACKAGE, standing.FILE),
        translation=machine.translation,
        rotation=machine.rotation,
    )
    if not animation:
        return
    corners = np.asarray(found.footprint.support.vertices)
    ground = np.column_stack([np.vstack([corners, corners[:1]]), np.zeros(len(corners) + 1)])
    scenes = []
    for title, motion, color in (("instant by instant", found.local, "orange"), ("planned", found.motion, "blue")):
        frames = frames_along(robot, motion.joints, None, machine.translation, machine.rotation)
        zmp = np.column_stack([motion.zero_moment_point, np.zeros(len(motion.t))])
        scenes.append(Scene(title, robot, frames, motion.t, color, outline=ground, mark=zmp, view=(16.0, -50.0)))
    note = (
        f"Grey: footprint; diamond: zero moment point; the arm from the wheels to the hand. A rope pulls the hand "
        f"forward with {standing.PULL:g} N."
    )
    animate(folder / "mobile_manipulator.gif", scenes, frames=50, seconds=0.1, note=note)


def _whole() -> Robot:
    return Robot.from_urdf(standing.robot_file(), tip=standing.HAND, inertia="as_given")
