"""Two that walk: a planar biped of our own, and TALOS, which loads with flat soles and limits of torque."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from models import Foot, Foothold, Joint, Link, Robot, rectangle
from ocp.builders.standing import StancePhase, Steps, standing_posture, walk
from tests.models.robot.pinocchio_robots import urdf_file
from tests.models.robot.trees import Array

FRICTION = 0.6
SIDES = ("left", "right")
TALOS = ("example-robot-data", "talos_data/robots/talos_reduced_box.urdf")
HELD = {
    f"arm_{side}_{joint}_joint": angle * sign
    for side, sign in (("left", 1), ("right", -1))
    for joint, angle in (("1", 0.25), ("2", 0.17), ("4", -0.6 * sign))
}
"""Joints of TALOS's arms that do not hang straight down, rad."""


def limb(name: str, mass: float, length: float) -> Link:
    """A rod downwards, 0.1 m thick."""
    side = mass * (length**2 + 0.1**2) / 12
    return Link(name, mass, (0.0, 0.0, -length / 2), np.diag([side, side, mass * 0.1**2 / 6]))


def planar_biped() -> Robot:
    """53 kg in the plane y = 0: trunk, thighs and shanks of 0.4 m, feet; hip, knee and ankle of each leg about y."""
    links, joints = [Link("trunk", 30.0, (0.0, 0.0, 0.25), np.diag([0.9, 0.8, 0.3]))], []
    strong: dict[str, Any] = {"axis": (0, 1, 0), "velocity": 6.0, "effort": 200.0}
    for side in SIDES:
        hip, knee, ankle = (f"{side}_{name}" for name in ("hip", "knee", "ankle"))
        thigh, shank, foot = (f"{side}_{name}" for name in ("thigh", "shank", "foot"))
        links += [limb(thigh, 6.0, 0.4), limb(shank, 4.0, 0.4)]
        links += [Link(foot, 1.5, (0.03, 0.0, -0.05), np.diag([0.002, 0.006, 0.006]))]
        down = (0.0, 0.0, -0.4)
        joints += [Joint(hip, "revolute", "trunk", thigh, lower=-1.6, upper=0.8, **strong)]
        joints += [Joint(knee, "revolute", thigh, shank, down, lower=0.0, upper=2.4, **strong)]
        joints += [Joint(ankle, "revolute", shank, foot, down, lower=-1.2, upper=0.9, **strong)]
    return Robot(tuple(links), tuple(joints), name="planar biped", tip="trunk")


def planar_feet() -> dict[str, Foot]:
    sole = rectangle((-0.08, 0.14), (-0.05, 0.05))
    return {side: Foot(f"{side}_foot", sole, (0.0, 0.0, -0.08)) for side in SIDES}


def planar_steps(count: int, shift: float, swing: float, *, first: str = "right", length: float = 0.25) -> Steps:
    """Steps forward, each a length beyond where the other foot stands."""
    return Steps(planar_biped(), planar_feet(), _alternating(count, shift, swing, first, length, 0.0))


def talos() -> Robot:
    """TALOS with its legs free: 90 kg, 12 joints."""
    file = urdf_file(*TALOS)
    whole = Robot.from_urdf(file, inertia="as_given")
    held = {name: HELD.get(name, 0.0) for name in whole.joint_names if not name.startswith("leg")}
    return Robot.from_urdf(file, inertia="as_given", lock=held, tip="base_link")


def talos_steps(count: int, shift: float, swing: float, *, first: str = "right", length: float = 0.2) -> Steps:
    robot = talos()
    feet = {side: Foot.of(robot, f"leg_{side}_6_link") for side in SIDES}
    return Steps(robot, feet, _alternating(count, shift, swing, first, length, 0.085))


def _alternating(
    count: int, shift: float, swing: float, first: str, length: float, wide: float
) -> tuple[StancePhase, ...]:
    sides = {"left": wide, "right": -wide}
    order = [first, *(side for side in SIDES if side != first)]
    steps = [(order[k % 2], Foothold.level((k + 1) * length, sides[order[k % 2]])) for k in range(count)]
    start = {side: Foothold.level(0.0, sides[side]) for side in reversed(order)}
    return walk(start, steps, shift=shift, swing=swing)


def bent(steps: Steps, knee: float = 0.8) -> Array:
    """A start on both feet with knees bent, in balance."""
    near = np.zeros(steps.robot.dof)
    pitches = [i for i, joint in enumerate(steps.robot.moving_joints) if abs(joint.axis[1]) > 0.5]
    near[pitches] = np.tile([-knee / 2, knee, -knee / 2], 2)
    stance = steps.stances[0]
    found = standing_posture(stance, near[steps.order(stance)], steps.balanced(0))
    return np.asarray(steps.in_order(stance, found[None])[0])


def mirrored(steps: Steps) -> Steps:
    """The same steps by the other feet: left and right change places, and y its sign."""
    other = dict(zip(SIDES, reversed(SIDES), strict=True))

    def place(at: Foothold) -> Foothold:
        flip = np.diag([1.0, -1.0, 1.0])
        return Foothold(flip @ at.position, flip @ at.rotation @ flip)

    phases = [
        replace(phase, footholds={other[name]: place(at) for name, at in phase.footholds.items()})
        for phase in steps.phases
    ]
    return replace(steps, phases=tuple(phases))
