"""One that walks beside the planar biped of the gallery: TALOS, which loads with flat soles and limits of torque."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models import Foot, Foothold, Robot
from ocp.builders.standing import Steps
from scripts.robots.steps import SIDES, alternating
from tests.models.robot.pinocchio_robots import urdf_file

FRICTION = 0.6
TALOS = ("example-robot-data", "talos_data/robots/talos_reduced_box.urdf")
HELD = {
    f"arm_{side}_{joint}_joint": angle * sign
    for side, sign in (("left", 1), ("right", -1))
    for joint, angle in (("1", 0.25), ("2", 0.17), ("4", -0.6 * sign))
}
"""Joints of TALOS's arms that do not hang straight down, rad."""


def talos() -> Robot:
    """TALOS with its legs free: 90 kg, 12 joints."""
    file = urdf_file(*TALOS)
    whole = Robot.from_urdf(file, inertia="as_given")
    held = {name: HELD.get(name, 0.0) for name in whole.joint_names if not name.startswith("leg")}
    return Robot.from_urdf(file, inertia="as_given", lock=held, tip="base_link")


def talos_steps(count: int, shift: float, swing: float, *, first: str = "right", length: float = 0.2) -> Steps:
    robot = talos()
    feet = {side: Foot.of(robot, f"leg_{side}_6_link") for side in SIDES}
    return Steps(robot, feet, alternating(count, shift, swing, first=first, length=length, wide=0.085))


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
