"""The friction that steps of bipeds are tested with, their mirror images, and machines of another size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models import Foot, Foothold, Robot, Support
from ocp.motion.builders.standing.stances import StancePhase, Steps
from scripts.robots.steps import SIDES

FRICTION = 0.6


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


def resized(steps: Steps, size: float) -> Steps:
    """A machine of other lengths and equal density, torques as its weight, in the times that its pendulums take."""
    time = np.sqrt(size)
    links = tuple(
        replace(
            link,
            mass=size**3 * link.mass,
            center_of_mass=size * np.asarray(link.center_of_mass),
            inertia=size**5 * np.asarray(link.inertia),
            visuals=(),
        )
        for link in steps.robot.links
    )
    joints = tuple(
        replace(
            joint,
            translation=size * np.asarray(joint.translation),
            velocity=None if joint.velocity is None else joint.velocity / time,
            effort=None if joint.effort is None else joint.effort * size**4,
        )
        for joint in steps.robot.joints
    )
    feet = {}
    for name, foot in steps.feet.items():
        assert foot.sole is not None
        sole = Support(size * np.asarray(foot.sole.vertices))
        feet[name] = Foot(foot.link, sole, size * np.asarray(foot.translation), foot.rotation)
    phases = []
    for phase in steps.phases:
        places = {name: Foothold(size * np.asarray(at.position), at.rotation) for name, at in phase.footholds.items()}
        phases.append(StancePhase(places, phase.seconds * time))
    return Steps(Robot(links, joints, name=steps.robot.name, tip=steps.robot.tip), feet, phases, steps.gravity)
