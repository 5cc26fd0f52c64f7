"""A free-flying arm of seven joints carries its tip along a pose line: by the pseudo-inverse, and optimally."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating
from models.spatial import rotation_from_rpy
from ocp import Collocation, TipTask, minimum_velocity_problem, resolve, solve
from ocp.app.view.appearance import frames_along
from ocp.motion.tasks.tracks import pose_line
from scripts.drawing import COLORS, DASHES
from scripts.robots.drawing import Scene, animate, joint_curves, page
from scripts.robots.results import FINE, Example, turning_angle
from scripts.robots.robots import SPACE_ARM

START = (0.3, 0.9, 0.2, -1.6, 0.3, 0.9, 0.4)  # rad
SHIFT = (0.5, 1.5, -0.5)  # m
TURN = (0.4, 0.3, 0.8)  # roll, pitch, yaw in the axes of the tip, rad
DURATION = 20.0  # s
SNAPSHOTS = 4
VIEW = (24.0, -48.0)  # deg
SATELLITE = (0.72, 0.74, 0.78, 1.0)
"""Colour of its body, which is black in its description."""


def plan(coarse: bool = False) -> Example:
    """Both motions; `coarse` for a mesh that a test can afford."""
    machine = FreeFloating(SPACE_ARM.read())
    home, start = machine.base_home(), np.array(START)
    pose = machine.tip_pose(home, start)
    rotation, position = np.array(ca.DM(pose.rotation)), np.array(ca.DM(pose.position)).ravel()
    goal = rotation @ np.array(ca.DM(rotation_from_rpy(*TURN))), position + np.array(SHIFT)
    line = pose_line((rotation, position), goal, DURATION)
    task = TipTask(position=line.position, orientation=line.orientation)
    local = resolve(machine, task, DURATION, start=start, samples=FINE)
    problem = minimum_velocity_problem(machine, task, DURATION, start=start)
    solution = solve(problem, Collocation(intervals=20 if coarse else 50, degree=4))
    facts = {
        "base_turn_local_deg": float(np.degrees(turning_angle(local.base).max())),
        "base_turn_optimal_deg": float(np.degrees(turning_angle(solution["base"]).max())),
        "largest_rate_local_rad_s": float(np.abs(local.joint_rates).max()),
        "largest_rate_optimal_rad_s": float(np.abs(solution["rates"]).max()),
    }
    return Example(SPACE_ARM, machine, task, local, solution, solution.audit(), facts)


def draw(example: Example, folder: Path, *, animation: bool = True) -> None:
    """space_arm.png, space_arm.gif and space_arm.npz."""
    machine, local, solution = example.machine, example.local, example.plan
    robot = machine.robot
    at = solution.at(local.t)
    look: dict[str, Any] = {"view": VIEW, "root_color": SATELLITE}
    scenes = [
        Scene("pseudo-inverse", robot, frames_along(machine, local.joints, local.base), local.t, "orange", **look),
        Scene("plan", robot, frames_along(machine, at["joints"], at["base"]), local.t, "blue", **look),
    ]
    base = robot.link(robot.root).mass
    note = (
        f"{example.file.name} of {robot.total_mass - base:.0f} kg on a free base of {base:.0f} kg, no momentum; "
        "earlier configurations are pale. The pose of the tool is given, and seven joints move it; the base reacts. "
        "Both motions begin in the same configuration. Cost: integral of half the squared joint velocities, which need "
        "not begin at zero."
    )
    path, saved, calmer = folder / "space_arm.png", 1 - solution.cost / local.cost[-1], example.facts
    title = (
        f"The plan costs {100 * saved:.0f} % less than the pseudo-inverse, and the satellite turns by "
        f"{calmer['base_turn_optimal_deg']:.0f}° instead of {calmer['base_turn_local_deg']:.0f}°"
    )
    with page(path, scenes, SNAPSHOTS, height=6.0, share=1.5, note=note, title=title) as (turn, rates, best):
        for scene, poses, dash in zip(scenes, (local.base, at["base"]), DASHES, strict=False):
            angle = np.degrees(turning_angle(poses))
            turn.plot(local.t, angle, color=COLORS[scene.color], ls=dash, label=scene.title)
        turn.set(xlabel="time, s", ylabel="rotation of the satellite, deg")
        turn.legend(loc="upper left", fontsize=7)
        turn.set_ylim(top=1.35 * turn.get_ylim()[1])  # room for the legend
        names = [name.split("_")[-1] for name in robot.joint_names]
        joint_curves(rates, local.t, local.joint_rates, names)
        joint_curves(best, local.t, at["rates"], names, ncols=4, fontsize=6.5, title="joint")
        for ax, scene in zip((rates, best), scenes, strict=True):
            ax.set(xlabel="time, s", title=scene.title)
        rates.set_ylabel("joint velocities, rad/s")
        best.sharey(rates)
        low, high = rates.get_ylim()
        rates.set_ylim(low - 0.35 * (high - low), high)
    example.save(folder / "space_arm.npz")
    if animation:
        animate(folder / "space_arm.gif", scenes, frames=40, seconds=0.1, note=note)
