"""Gallery: a legged mobile manipulator pushes against something that presses on its hand and would tip it over.

ANYmal with a Kinova arm (the URDF of example-robot-data) stands on its four feet, legs locked, 1 kg in its hand. It
pushes to its right with 60 N; the reaction, 60 N on its hand, acts to its left, +y. In 2.5 s the hand gives way to the
left, backwards and up. By local resolution, the zero moment point leaves the support polygon of the feet; in the plan
it stays inside, within all limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import ocp
from models import Footprint, Standing, Wrench, footprint, with_load
from models.machines.machine import WrenchFunction
from ocp import AccelerationOptions, Collocation, Problem, Scene, TipTask, resolve_accelerations
from ocp.motion.builders.standing.problem import StandingSetup, standing_problem
from ocp.motion.tasks.limits import InFoot, Limits
from scripts.robots import standing
from scripts.robots.drawing import animate
from scripts.robots.mobile_manipulator import StandingExample, save
from scripts.robots.robots import RobotFile

__all__ = ["anymal", "draw", "plan", "problem", "reach", "reaction", "task"]

FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
LEGS = {  # of the file's own standing posture
    f"{side}{end}_{joint}": value
    for side, roll in (("L", -0.1), ("R", 0.1))
    for end, sign in (("F", 1), ("H", -1))
    for joint, value in (("HAA", roll), ("HFE", 0.7 * sign), ("KFE", -1.0 * sign))
}
ANYMAL = RobotFile(
    "ANYmal with a Kinova arm",
    "example-robot-data",
    "anymal_b_simple_description/robots/anymal-kinova.urdf",
    {"tip": "j2s6s200_end_effector", "inertia": "as_given", "lock": LEGS},
)
START = np.array([-2.294, 3.884, 1.744, 2.895, 1.013, -1.85])
STEP = (-0.2, 0.2, 0.1)  # of the hand, m
SECONDS = 2.5
LOAD = 1.0  # kg
PUSH = (0.0, -60.0, 0.0)  # of the hand on what resists, N
MARGIN = 0.01  # m
FRICTION = 0.7
LIMITS = Limits(friction=FRICTION, zmp=InFoot(MARGIN))
VIEW = (24.0, -38.0)  # deg
METHOD = Collocation(24, degree=3, scheme="legendre")


def anymal() -> tuple[Standing, Footprint]:
    """ANYmal on its feet, the arm free, with its load."""
    whole = ANYMAL.read()
    ground = footprint(whole, links=FEET)
    robot = with_load(whole, whole.tip_link, LOAD)
    return Standing(robot, support=ground.support, translation=ground.translation, rotation=ground.rotation), ground


def reaction(machine: Standing) -> WrenchFunction:
    """What the push does to the hand: the same force, the other way."""

    def acting(time: Any, tip: Any) -> Sequence[Wrench]:
        return [machine.tip_wrench(tuple(-part for part in PUSH))]

    return acting


def reach(machine: Standing) -> TipTask:
    """The hand on its straight way, over the share 0..1 of it that is done."""
    begin = np.array(ca.DM(machine.tip_pose((), START).position)).ravel()
    return TipTask(position=lambda share: ca.DM(begin) + share * ca.DM(STEP), gain=0.0)


def task(machine: Standing) -> TipTask:
    """The same over the time, s."""
    return standing.from_rest(reach(machine), SECONDS)


def problem(machine: Standing, *, along: Any = "time", **changes: Any) -> Problem:
    """The problem without collisions, at a given time law or with the time law left to the plan ("parameter").

    Args:
        changes: Of the other arguments of standing_problem.
    """
    setup = StandingSetup(wrenches=reaction(machine), tip_level="acceleration", along=along)
    hand = task(machine) if along == "time" else reach(machine)
    options: dict[str, Any] = {"zmp": InFoot(MARGIN), "limits": LIMITS, **changes}
    return standing_problem(machine, hand, SECONDS, start=START, setup=setup, **options)


def plan(coarse: bool = False) -> StandingExample:
    """The plan, its audit and the local motion; it has one mesh only, `coarse` or not."""
    machine, ground = anymal()
    pressed = reaction(machine)
    local = resolve_accelerations(
        machine,
        task(machine),
        SECONDS,
        start=START,
        wrenches=pressed,
        step=5e-3,
        options=AccelerationOptions(stop_at_lift_off=False),
    ).motion
    options: dict[str, Any] = {"limits": LIMITS, "scene": Scene(wrenches=pressed)}
    solution = ocp.plan(machine, task(machine), SECONDS, start=START, **options).solution
    motion = standing.sampled(machine, solution, pressed)
    result = standing.Results(ANYMAL.path, machine, ground, solution, motion, local, pressed)
    return StandingExample(ANYMAL.name, result, task(machine), solution.audit())


def draw(example: StandingExample, folder: Path, *, animation: bool = True) -> None:
    """pushing.png, pushing.gif and pushing.npz."""
    result, nearest = example.results, example.nearest
    force = float(np.linalg.norm(PUSH))
    note = (
        f"ANYmal of {result.robot.total_mass - LOAD:.0f} kg, legs locked, pushes to its right with {force:g} N and "
        f"{LOAD:g} kg in its hand; earlier configurations are pale; disc: zero moment point, grey: inside the "
        f"footprint. The reaction on its hand acts to its left, and the hand moves to the left by {STEP[1]:g} m in "
        f"{SECONDS:g} s. Feet, inertias and limits from its URDF (example-robot-data); both motions have the same path "
        f"and force. Plan: zero moment point {1000 * MARGIN:g} mm inside; {nearest.bodies[0]} and {nearest.bodies[1]} "
        f"come nearest, {1000 * nearest.distance:.1f} mm (in the animation: purple)."
    )
    title = "By local resolution the push tips the robot over; the plan keeps it on its feet"
    look: dict[str, Any] = {"view": VIEW, "prefix": "j2s6s200_"}
    standing.figure(folder / "pushing.png", result, note=note, title=title, **look)
    save(folder / "pushing.npz", example)
    if animation:
        scenes = standing.scenes_of(result, VIEW, nearest.points)
        animate(folder / "pushing.gif", scenes, frames=40, seconds=0.1, note=note)
