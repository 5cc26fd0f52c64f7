"""A Panda goes round a closed tool path again and again: the pseudo-inverse drifts, the cyclic plan returns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.checks import Array
from ocp import Collocation, TipTask, VelocitySetup, inverse_kinematics, minimum_velocity_problem, resolve, solve
from ocp.app.view.appearance import frames_along
from scripts.drawing import COLORS
from scripts.robots.drawing import LEGEND, Scene, animate, joint_curves, page
from scripts.robots.results import Example
from scripts.robots.robots import PANDA

HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
"""The arm's ready posture, rad: inverse kinematics start there."""
CENTER = (0.45, 0.0, 0.25)  # m
RADIUS = 0.18  # m
TILT = 0.4
"""Tangent of the angle by which the tool leans outwards all round."""
LAP = 6.0  # s
LAPS = 6
SAMPLES = 100  # a lap
SHOWN = 3
"""Laps of which the arm is drawn; later it looks as at the start again, although its joints are half a turn away."""
VIEW = (20.0, -50.0)


def circling(center: Any = CENTER, radius: float = RADIUS, tilt: float = TILT, lap: float = LAP) -> TipTask:
    """A level circle at constant speed, the tool pointing down and leaning outwards: six rows, closed."""

    def position(time: Any) -> Any:
        angle = 2 * np.pi * time / lap
        return ca.vertcat(center[0] + radius * ca.cos(angle), center[1] + radius * ca.sin(angle), center[2])

    def orientation(time: Any) -> Any:
        angle = 2 * np.pi * time / lap
        axis = ca.vertcat(tilt * ca.cos(angle), tilt * ca.sin(angle), -1) / np.sqrt(1 + tilt**2)
        side = ca.cross(axis, ca.DM([1, 0, 0]))
        side = side / ca.norm_2(side)
        return ca.horzcat(ca.cross(side, axis), side, axis)

    return TipTask(position=position, orientation=orientation)


def plan(coarse: bool = False) -> Example:
    """Laps by the pseudo-inverse and one lap of the cyclic plan; `coarse` for what a test can afford."""
    machine, task, laps = FixedBase(PANDA.read()), circling(), 3 if coarse else LAPS
    start = inverse_kinematics(machine, task, near=HOME, starts=0)[0].joints
    local = resolve(machine, task, laps * LAP, start=start, samples=laps * SAMPLES + 1)
    problem = minimum_velocity_problem(machine, task, horizon=LAP, cyclic=True, setup=VelocitySetup(near=start))
    solution = solve(problem, Collocation(intervals=24 if coarse else 40, degree=4))
    drift = drifts(local.joints)
    facts = {
        "laps": laps,
        "cost_optimal": laps * float(solution.cost),
        "cost_by_lap_local": np.diff(local.cost[::SAMPLES]),
        "cost_by_lap_optimal": float(solution.cost),
        "drift_by_lap_local_rad": drift,
        "largest_drift_local_rad": float(drift.max()),
        "first_leaves_limits_local_s": leaves_limits(machine, local.t, local.joints),
        "closed_in_limits": leaves_limits(machine, solution.t, solution["joints"]) is None,
    }
    return Example(PANDA, machine, task, local, solution, solution.audit(), facts, {"laps": laps})


def drifts(joints: Array) -> Array:
    """Largest distance of a joint from its first position after 0, 1, 2, ... laps, rad."""
    return np.asarray(np.abs(joints[::SAMPLES] - joints[0]).max(axis=1))


def leaves_limits(machine: FixedBase, t: Array, joints: Array) -> float | None:
    """When a joint first leaves its limits, s."""
    outside = ((joints < machine.robot.lower - 1e-9) | (joints > machine.robot.upper + 1e-9)).any(axis=1)
    return float(t[outside][0]) if outside.any() else None


def repeated(example: Example) -> Array:
    """The cyclic plan at the times of the local motion, lap after lap."""
    into_lap = np.arange(len(example.local.t)) % SAMPLES * LAP / SAMPLES
    return example.plan.at(into_lap)["joints"]


def draw(example: Example, folder: Path, *, animation: bool = True) -> None:
    """panda.png, panda.gif and panda.npz."""
    machine, local, laps = example.machine, example.local, example.more["laps"]
    robot, again = machine.robot, repeated(example)
    look: dict[str, Any] = {"view": VIEW, "floor": 0.0}
    scenes = [
        Scene("pseudo-inverse", robot, frames_along(machine, local.joints), local.t, "orange", **look),
        Scene("cyclic plan", robot, frames_along(machine, again), local.t, "blue", **look),
    ]
    note = (
        f"{example.file.name}: a circle of radius {RADIUS:g} m in {LAP:g} s, the tool leaning "
        f"{np.degrees(np.arctan(TILT)):.0f}° outwards; the arm at the start of each lap (pale) and after {SHOWN} laps. "
        "The base is fixed, the fingers are locked; the pose of the tool is given, and seven joints move it. Cost: "
        "integral of half the squared joint velocities. The pseudo-inverse starts in the solution of inverse "
        "kinematics near the arm's ready configuration."
    )
    left_at = example.facts["first_leaves_limits_local_s"]
    leaves = "" if left_at is None else f" and exceeds the joint limits after {left_at:.0f} s"
    title = f"The pseudo-inverse drifts{leaves}; the cyclic plan does not drift"
    each = example.facts["cost_by_lap_local"]
    note += (
        f" A lap of the cyclic plan costs {example.plan.cost:.2f} rad²/s, the laps of the pseudo-inverse, which need "
        f"not return, {each.min():.2f} to {each.max():.2f}."
    )
    path, starts = folder / "panda.png", [lap * LAP for lap in range(SHOWN + 1)]
    with page(path, scenes, starts, height=6.2, share=1.6, note=note, title=title) as (drift, left, right):
        for name, values, color, mark in (
            ("pseudo-inverse", drifts(local.joints), "orange", "o"),
            ("cyclic plan", drifts(again), "blue", "D"),
        ):
            drift.plot(np.arange(laps + 1), values, "-" + mark, color=COLORS[color], ms=4, label=name)
        drift.set(xlabel="laps", ylabel="largest change of a joint, rad", xticks=range(laps + 1))
        drift.legend(loc="upper left", fontsize=7)
        middle, half = (robot.upper + robot.lower) / 2, (robot.upper - robot.lower) / 2
        for ax, joints, title in ((left, local.joints, scenes[0].title), (right, again, scenes[1].title)):
            joint_curves(ax, local.t / LAP, (joints - middle) / half, map(str, range(1, robot.dof + 1)))
            ax.axhspan(1, 3, color=COLORS["grey"], alpha=0.25, lw=0)
            ax.axhspan(-3, -1, color=COLORS["grey"], alpha=0.25, lw=0)
            ax.set(xlabel="laps", title=title, ylim=(-2.2, 1.6))
        left.set_ylabel("joint position, limits = ±1")
        right.legend(ncols=4, title="joint", **LEGEND)
    example.save(folder / "panda.npz")
    if animation:
        animate(folder / "panda.gif", scenes, frames=6 * laps, seconds=0.18, note=note)
