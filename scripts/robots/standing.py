"""Gallery: a mobile manipulator stirs against a rope that would tip it over.

TIAGo (PAL Robotics; the URDF of example-robot-data) stands on its wheels and casters, carries 1 kg in its hand and
leads it round a circle in 2.5 s while a rope pulls the hand forward with 62 N. Resolved instant by instant, its zero
moment point leaves the footprint and joints pass their limits; planned as a whole it stays inside, within all limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import Footprint, Robot, Standing, Surroundings, Wrench, footprint, locked, with_load
from models.arrays import Array
from models.machines.standing import External
from models.machines.standing_motion import StandingMotion, standing_motion
from models.paths import rest_to_rest
from ocp import Clear, Collocation, Problem, Solution, TipTask, resolve_accelerations, solve
from ocp.builders.standing import InFoot, Limits, Weights, standing_problem
from ocp.tasks.tip_task import timed
from scripts.drawing import COLORS, DASHES, sheet

__all__ = ["Results", "draw", "figure", "plan", "problem", "robot_file", "tiago"]

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
        external: The rope.
    """

    file: Path
    machine: Standing
    footprint: Footprint
    solution: Solution
    motion: StandingMotion
    local: StandingMotion
    external: External

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
    found = [file for file in owner.files or [] if file.as_posix().endswith("/" + ending)]
    if not found:
        raise FileNotFoundError(f"the package {package} {owner.version} has no file {ending}")
    return Path(str(owner.locate_file(found[0])))


def tiago(load: float = LOAD) -> tuple[Standing, Footprint]:
    """TIAGo on its wheels and casters, lift and arm free, with a load (kg) in its hand."""
    file = robot_file()
    whole = Robot.from_urdf(file, tip=HAND, inertia="as_given")  # some of the file's inertias are rounded
    ground = footprint(whole)
    robot = locked(whole, {name: 0.0 for name in whole.joint_names if name not in JOINTS})
    robot = with_load(robot, HAND, load) if load else robot
    return Standing(robot, support=ground.support, translation=ground.translation, rotation=ground.rotation), ground


def rope(machine: Standing) -> External:
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
    return timed(task, lambda time: rest_to_rest(time / seconds))


def problem(machine: Standing, *, along: Any = "time", clear: Clear | None = None) -> Problem:
    """The plan to be made: the circle at a given time law, or with the time law left to the plan ("parameter")."""
    robot, hand = machine.robot, circle(machine)
    return standing_problem(
        machine,
        from_rest(hand) if along == "time" else hand,
        START,
        SECONDS,
        zmp=InFoot(MARGIN),
        external=rope(machine),
        weights=WEIGHTS,
        limits=Limits(velocity=SHARE * robot.velocity, torque=SHARE * robot.effort, friction=0.6),
        along=along,
        tip_level="acceleration",
        clear=clear,
    )


def sampled(machine: Standing, solution: Solution, external: External, count: int = 1001) -> StandingMotion:
    """A plan at equal times."""
    share = np.linspace(0.0, 1.0, count)
    values = solution.at_fraction(share)
    joints, velocities, accelerations = (values[name] for name in ("joints", "velocities", "accelerations"))
    return standing_motion(machine, share * solution.horizon, joints, velocities, accelerations, external, ROWS)


def plan() -> Results:
    """Solve the plan and the local motion, about 15 s."""
    machine, ground = tiago()
    pulled = rope(machine)
    local = resolve_accelerations(
        machine, from_rest(circle(machine)), START, SECONDS, external=pulled, step=5e-3, stop_at_lift_off=False
    ).motion
    solution = solve(problem(machine, clear=Clear(Surroundings(machine))), METHOD)
    return Results(robot_file(), machine, ground, solution, sampled(machine, solution, pulled), local, pulled)


def draw(folder: Path, results: Results) -> None:
    """Write mobile_manipulator.png: zero moment point from above, its distance from the edge, rope, limits."""
    note = (
        f"TIAGo of {results.robot.total_mass:.1f} kg with {LOAD:g} kg in its hand on a circle of {SECONDS:g} s; a rope "
        f"pulls the hand forward with {PULL:g} N. Footprint, inertias and limits from its URDF (example-robot-data); "
        f"both motions have the same hand path and force. Plan: zero moment point {1000 * MARGIN:g} mm inside, "
        f"{100 * SHARE:g} % of the limits of velocity and torque."
    )
    figure(folder / "mobile_manipulator.png", results, note=note, force="force of the rope on the hand")


def figure(
    path: Path,
    results: Results,
    *,
    note: str,
    force: str,
    prefix: str = "",
    inset: tuple[float, float, float, float] = (0.1, 0.27, 0.46, 0.46),
) -> None:
    """A plan and the local motion: zero moment point from above, its distance from the edge, force, limits.

    Args:
        path: PNG file.
        note: Fine print.
        force: Title over the force from outside.
        prefix: Of joint names, left out.
        inset: Left, bottom, width and height of the enlarged part, in shares of the picture from above.
    """
    kinds = (("instant by instant", results.local, "orange", 1), ("planned", results.motion, "blue", 0))
    span = (0.0, results.solution.horizon)
    with sheet(path, (2, 2), (8.4, 6.6), note) as (drawn, axes):
        above, edge, outside, shares = axes.flat
        _from_above(above, results, kinds, inset)
        for label, motion, color, dash in kinds:
            edge.plot(motion.t, 1000 * motion.foot_margin, color=COLORS[color], ls=DASHES[dash], label=label)
        edge.axhline(0.0, color=COLORS["black"], lw=0.8)
        low = 1.5 * 1000 * min(0.0, float(results.local.foot_margin.min()), float(results.motion.foot_margin.min()))
        edge.axhspan(low, 0.0, color=COLORS["orange"], alpha=0.12, lw=0)
        edge.set_ylim(bottom=low)
        edge.set(xlabel="time, s", ylabel="mm", title="zero moment point inside the footprint", xlim=span)
        for i, (name, color) in enumerate(zip("xyz", ("black", "green", "purple"), strict=True)):
            values = results.motion.external_force[:, i]
            outside.plot(results.motion.t, values, color=COLORS[color], ls=DASHES[i], label=name)
        outside.set(xlabel="time, s", ylabel="N", title=force, xlim=span)
        outside.legend(ncols=3)
        _shares(shares, results, kinds, prefix)
        drawn.legend(handles=edge.get_lines()[:2], loc="outside upper left", ncols=2)


def _from_above(ax: Any, results: Results, kinds: Any, inset: tuple[float, float, float, float]) -> None:
    """The footprint, and the place of interest enlarged."""
    corners = results.footprint.support.vertices
    points = np.vstack([motion.zero_moment_point for _, motion, _, _ in kinds])
    least, most = points.min(axis=0), points.max(axis=0)
    middle, half = (least + most) / 2, 0.6 * float((most - least).max())
    window = {"xlim": (middle[0] - half, middle[0] + half), "ylim": (middle[1] - half, middle[1] + half)}
    enlarged = ax.inset_axes(inset, xticks=[], yticks=[], **window)
    for part in (ax, enlarged):
        part.fill(*corners.T, color=COLORS["grey"], alpha=0.18, lw=0)
        part.plot(*np.vstack([corners, corners[:1]]).T, color=COLORS["grey"], lw=1)
        for _, motion, color, dash in kinds:
            part.plot(*motion.zero_moment_point.T, color=COLORS[color], ls=DASHES[dash])
        part.set_aspect("equal")
    for _, motion, color, _ in kinds:
        enlarged.plot(*motion.zero_moment_point[0], "o", color=COLORS[color], ms=4)
    for spine in enlarged.spines.values():
        spine.set_visible(True)
    ax.indicate_inset_zoom(enlarged, edgecolor=COLORS["black"])
    ax.plot(*corners.T, "o", color=COLORS["grey"], ms=3)
    title = f"zero moment point from above; inset {200 * half:.0f} cm wide"
    ax.set(xlabel="x, forward, m", ylabel="y, m", title=title)


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
    ax.set(xlabel="peak over limit: bars torque, diamonds velocity", title="joints against their limits")
