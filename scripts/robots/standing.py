"""Gallery: a mobile manipulator stirs against a rope that would tip it over.

TIAGo (PAL Robotics; the URDF of example-robot-data) stands on its wheels and casters, carries 1 kg in its hand and
leads it round a circle in 2.5 s while a rope pulls the hand forward with 62 N. By local resolution, its zero
moment point leaves the footprint and joints exceed their limits; in the plan it stays inside, within all limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import CollisionScene, Footprint, Robot, Standing, Wrench, footprint, lock_joints, with_load
from models.checks import Array
from models.machines.machine import Wrenches, WrenchFunction
from models.machines.standing import StandingMotion, standing_motion
from models.paths import rest_to_rest
from ocp import (
    AccelerationOptions,
    ClearanceConstraints,
    Collocation,
    Problem,
    Solution,
    TipTask,
    resolve_accelerations,
    solve,
)
from ocp.app.view.appearance import frames_along
from ocp.motion.builders.standing.problem import StandingSetup, Weights, standing_problem
from ocp.motion.tasks.limits import InFoot, Limits
from ocp.motion.tasks.tip_task import retime_task
from scripts.drawing import COLORS, DASHES
from scripts.robots.drawing import Scene, page

__all__ = ["Results", "figure", "plan", "problem", "robot_file", "scenes_of", "tiago"]

PACKAGE, FILE = "example-robot-data", "tiago_description/robots/tiago.urdf"
JOINTS = ("torso_lift_joint", *(f"arm_{i}_joint" for i in range(1, 8)))
HAND = "hand_grasping_frame"
ROWS = (3, 4, 5)
START = np.array([0.267, 0.095, 0.228, -1.12, 1.983, 1.835, 0.272, -0.99])  # by inverse kinematics: elbow low, hand out
LOAD = 1.0  # kg
PULL = 62.0  # N
ANCHOR = (2.5, -0.2, 0.85)  # where the rope leads, m
RADIUS, RISE = 0.08, 0.1  # of the circle, m
SECONDS = 2.5
MARGIN = 0.005  # m
SHARE = 0.97  # of the limits of velocity and torque: room for what happens between the points of the grid
WEIGHTS = Weights(acceleration=0.02, velocity=0.2, joint_limits=0.5, manipulability=0.2)
METHOD = Collocation(45, degree=3, scheme="legendre")
TOLERANCES = {"tip": 0.06, "velocities": 1e-3, "zero moment point": 1e-3}
"""Of the audit, m/s^2, m/s (rad/s) and m: how far polynomials stray between the points of the grid."""


@dataclass(frozen=True)
class Results:
    """A plan and the local motion that it is compared with.

    Attributes:
        file: The URDF file. machine: What stands, 8 joints free, the others locked at 0.
        footprint: What it stands on, from its file.
        solution: The plan. motion: The same, sampled.
        local: The least-acceleration motion of the same task.
        wrenches: The rope.
    """

    file: Path
    machine: Standing
    footprint: Footprint
    solution: Solution
    motion: StandingMotion
    local: StandingMotion
    wrenches: WrenchFunction

    @property
    def robot(self) -> Robot:
        return self.machine.robot


def robot_file(ending: str = FILE, package: str = PACKAGE) -> Path:
    """A robot's file in an installed package; ModuleNotFoundError, which says what to install, without it."""
    try:
        owner = distribution(package)
    except PackageNotFoundError:
        raise ModuleNotFoundError(
            f"the robots of the gallery come from the package {package}, which is not installed: pip install {package} "
            "(or all of them: pip install 'selfmotion[gallery]')"
        ) from None
    result = [file for file in owner.files or [] if file.as_posix().endswith("/" + ending)]
    if not result:
        raise FileNotFoundError(f"the package {package} {owner.version} has no file {ending}")
    return Path(str(owner.locate_file(result[0])))


def tiago(load: float = LOAD) -> tuple[Standing, Footprint]:
    """TIAGo on its wheels and casters, lift and arm free, with a load (kg) in its hand."""
    file = robot_file()
    whole = Robot.from_urdf(file, tip=HAND, inertia="as_given")  # some of the file's inertias are rounded
    ground = footprint(whole)
    robot = lock_joints(whole, {name: 0.0 for name in whole.joint_names if name not in JOINTS})
    robot = with_load(robot, HAND, load) if load else robot
    return Standing(robot, support=ground.support, translation=ground.translation, rotation=ground.rotation), ground


def rope(machine: Standing) -> WrenchFunction:
    """A constant tension towards the anchor."""

    def acting(time: Any, tip: Any) -> Sequence[Wrench]:
        away = ca.DM(ANCHOR) - tip
        return [machine.tip_wrench(PULL * away / ca.norm_2(away))]

    return acting


def circle(machine: Standing) -> TipTask:
    """The hand on the tilted circle, over the share 0..1 of it that is done."""
    x, y, z = np.array(ca.DM(machine.tip_pose((), START).position)).ravel()

    def place(share: Any) -> list[Any]:
        angle = 2 * np.pi * share
        lift = (1 - ca.cos(angle)) / 2
        return [x + 2 * RADIUS * lift, y + RADIUS * ca.sin(angle), z + RISE * lift]

    return TipTask(position=place, gain=0.0)


def from_rest(task: TipTask, seconds: float = SECONDS) -> TipTask:
    """The same over the time, s, from rest to rest."""
    return retime_task(task, lambda time: rest_to_rest(time / seconds))


def problem(
    machine: Standing, *, along: Any = "time", clearance_constraints: ClearanceConstraints | None = None
) -> Problem:
    """The plan to be made: the circle at a given time law, or with the time law left to the plan ("parameter")."""
    robot, hand = machine.robot, circle(machine)
    return standing_problem(
        machine,
        from_rest(hand) if along == "time" else hand,
        SECONDS,
        start=START,
        zmp=InFoot(MARGIN),
        weights=WEIGHTS,
        limits=Limits(velocity=SHARE * robot.velocity, torque=SHARE * robot.effort, friction=0.6),
        setup=StandingSetup(
            wrenches=rope(machine), along=along, tip_level="acceleration", clearance_constraints=clearance_constraints
        ),
    )


def sampled(machine: Standing, solution: Solution, wrenches: Wrenches, count: int = 1001) -> StandingMotion:
    """A plan at equal times."""
    share = np.linspace(0.0, 1.0, count)
    values = solution.at_fraction(share)
    joints, velocities, accelerations = (values[name] for name in ("joints", "velocities", "accelerations"))
    return standing_motion(
        machine,
        share * solution.horizon,
        joints,
        velocities,
        joint_accelerations=accelerations,
        wrenches=wrenches,
        rows=ROWS,
    )


def plan() -> Results:
    """Solve the plan and the local motion, about 15 s."""
    machine, ground = tiago()
    pulled = rope(machine)
    local = resolve_accelerations(
        machine,
        from_rest(circle(machine)),
        SECONDS,
        start=START,
        wrenches=pulled,
        step=5e-3,
        options=AccelerationOptions(stop_at_lift_off=False),
    ).motion
    solution = solve(problem(machine, clearance_constraints=ClearanceConstraints(CollisionScene(machine))), METHOD)
    return Results(robot_file(), machine, ground, solution, sampled(machine, solution, pulled), local, pulled)


def scenes_of(results: Results, view: tuple[float, float], nearest_points: Array | None = None) -> list[Scene]:
    """The local motion and the plan as scenes, on the ground, with the footprint and their zero moment points.

    Args:
        nearest_points: Of the two bodies that come nearest along the plan. Shape (2, 3), m.
    """
    result = []
    feet = np.asarray(results.footprint.support.vertices)
    for title, motion, color in (("local resolution", results.local, "orange"), ("plan", results.motion, "blue")):
        frames = frames_along(results.machine, motion.joints)
        about: dict[str, Any] = {"view": view, "floor": 0.0, "footprint": feet, "mark": motion.zero_moment_point}
        points = nearest_points if motion is results.motion else None
        result.append(Scene(title, results.robot, frames, motion.t, color, nearest_points=points, **about))
    return result


def figure(
    path: Path, results: Results, *, note: str, title: str, prefix: str = "", view: tuple[float, float] = (14.0, -50.0)
) -> None:
    """The local motion and the plan above: zero moment point near the edge, its distance from the edge, limits.

    Args:
        path: PNG file.
        note, title: As of sheet.
        prefix: Of joint names, left out.
        view: Elevation and azimuth, deg.
    """
    kinds = (("local resolution", results.local, "orange", 1), ("plan", results.motion, "blue", 0))
    span = (0.0, results.solution.horizon)
    scenes = scenes_of(results, view)
    with page(path, scenes, 4, height=7.4, share=1.45, note=note, title=title) as (above, edge, shares):
        _from_above(above, results, kinds)
        for label, motion, color, dash in kinds:
            edge.plot(motion.t, 1000 * motion.foot_margin, color=COLORS[color], ls=DASHES[dash], label=label)
        edge.axhline(0.0, color=COLORS["black"], lw=0.8)
        low = 1.5 * 1000 * min(0.0, float(results.local.foot_margin.min()), float(results.motion.foot_margin.min()))
        edge.axhspan(0.0, 1000.0, color=COLORS["grey"], alpha=0.2, lw=0)
        edge.annotate("tips over", (0.03, low), xycoords=("axes fraction", "data"), fontsize=7, va="bottom")
        edge.set(title="distance to the edge of the support", xlabel="time, s", ylabel="mm", xlim=span)
        edge.legend(fontsize=7, loc="upper left")
        edge.set_ylim(low, 1.3 * 1000 * max(results.local.foot_margin.max(), results.motion.foot_margin.max()))
        _shares(shares, results, kinds, prefix)


def _from_above(ax: Any, results: Results, kinds: Any) -> None:
    """The zero moment points and the edge of the footprint near to them, cm from where the plan begins."""
    corners, origin = np.asarray(results.footprint.support.vertices), results.motion.zero_moment_point[0]
    points = np.vstack([motion.zero_moment_point for _, motion, _, _ in kinds])
    least, most = (100 * (values - origin) for values in (points.min(axis=0), points.max(axis=0)))
    middle, half = (least + most) / 2, 0.65 * float((most - least).max())
    ax.fill(*(100 * (corners - origin)).T, color=COLORS["grey"], alpha=0.2, lw=0)
    ax.plot(*(100 * (np.vstack([corners, corners[:1]]) - origin)).T, color=COLORS["black"], lw=1, label="edge")
    for _, motion, color, dash in kinds:
        path = 100 * (motion.zero_moment_point - origin)
        ax.plot(*path.T, color=COLORS[color], ls=DASHES[dash])
        ax.plot(*path[0], "o", color=COLORS[color], ms=4)
    ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    ax.set(xlabel="forward, cm", ylabel="to the left, cm", title="zero moment point")


def _shares(ax: Any, results: Results, kinds: Any, prefix: str) -> None:
    """Peaks of torques and velocities over their limits, joint by joint."""
    robot = results.robot
    rows: Array = np.arange(robot.dof, dtype=float)
    for place, (_, motion, color, _) in zip((-0.2, 0.2), kinds, strict=True):
        torque = np.abs(motion.joint_torques).max(axis=0) / robot.effort
        speed = np.abs(motion.joint_velocities).max(axis=0) / robot.velocity
        ax.barh(rows + place, torque, height=0.38, color=COLORS[color], alpha=0.75, lw=0)
        ax.plot(speed, rows + place, "D", color=COLORS[color], ms=4, mec="white", mew=0.6, ls="none")
    ax.axvline(1.0, color=COLORS["black"], lw=0.8)
    names = [name.removeprefix(prefix).removesuffix("_joint").replace("_", " ") for name in robot.joint_names]
    ax.set_yticks(rows, names)
    ax.invert_yaxis()
    ax.tick_params(axis="y", labelsize=7)
    ax.set(title="largest value / limit", xlabel="bars: torque, ◆: velocity")
