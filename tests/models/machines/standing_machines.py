"""Standing machines, including spatial ones, and random motions of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from models import Joint, Link, Robot, Standing, Support, merge_robots, planar_chain, rectangle
from tests.models.robot.trees import Array, random_robot, random_rotation

FOOT = Link("foot", 12.0, (0.0, 0.0, 0.05), np.diag([0.2, 0.1, 0.3]))


def beam(name: str, mass: float, length: float) -> Link:
    """A rod along z, 0.05 m thick and 0.1 m wide."""
    side = mass * (length**2 + 0.1**2) / 12
    return Link(name, mass, (0.0, 0.0, length / 2), np.diag([side, side, mass * 0.05**2 / 2]))


def turning(name: str, parent: str, child: str, place: Any, axis: Any) -> Joint:
    """A strong joint without much of a limit."""
    limits: dict[str, Any] = {"lower": -2.8, "upper": 2.8, "velocity": 4.0, "effort": 300.0}
    return Joint(name, "revolute", parent, child, place, axis=axis, **limits)


def standing_arm() -> Standing:
    """Seven joints about z and y in turn on a foot of 0.3 m x 0.4 m; 12 kg of foot, 30 kg of arm, 1.3 m long."""
    lengths, masses = (0.25, 0.15, 0.2, 0.2, 0.2, 0.15, 0.1), (8.0, 6.0, 5.0, 4.5, 3.0, 2.0, 1.5)
    links, joints = [FOOT], []
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        links.append(beam(f"link{i + 1}", mass, length))
        place = (0.0, 0.0, 0.1 if i == 0 else lengths[i - 1])
        axis = (0, 0, 1) if i % 2 == 0 else (0, 1, 0)
        joints.append(turning(f"joint{i + 1}", links[i].name, links[i + 1].name, place, axis))
    robot = Robot(tuple(links), tuple(joints), tip_translation=(0.0, 0.0, lengths[-1]))
    return Standing(robot, support=rectangle((-0.15, 0.15), (-0.2, 0.2)))


def six_joint_arm() -> Standing:
    """Six joints as industrial arms have them, shoulder and wrist offset, on a foot of 0.36 m x 0.36 m; 40 kg."""
    places = ((0, 0, 0.12), (0.05, 0.06, 0.1), (0.35, 0, 0), (0.3, -0.05, 0), (0, 0, 0.08), (0.08, 0, 0))
    axes = ((0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0))
    centers = ((0, 0.02, 0.04), (0.17, 0, 0), (0.15, -0.02, 0), (0, 0, 0.03), (0.04, 0, 0), (0, 0.01, 0.02))
    links, joints = [Link("foot", 18.0, (0.0, 0.0, 0.04), np.diag([0.3, 0.3, 0.5]))], []
    for i, mass in enumerate((6.0, 7.0, 4.5, 2.0, 1.5, 1.0)):
        links.append(Link(f"link{i + 1}", mass, centers[i], mass * np.diag([0.004, 0.01, 0.01])))
        ends = links[i].name, links[i + 1].name
        joint = Joint(f"joint{i + 1}", "revolute", *ends, places[i], axis=axes[i])
        joints.append(replace(joint, lower=-3.0, upper=3.0, velocity=5.0, effort=250.0))
    robot = Robot(tuple(links), tuple(joints), tip_translation=(0.0, 0.02, 0.1))
    return Standing(robot, support=rectangle((-0.18, 0.18), (-0.18, 0.18)))


def two_armed() -> Standing:
    """A body that turns and leans on a foot of 0.24 m x 0.3 m, with two arms of three joints; 8 joints, 46 kg."""
    body = Robot(
        (FOOT, beam("hip", 8.0, 0.2), beam("body", 12.0, 0.5)),
        (turning("yaw", "foot", "hip", (0, 0, 0.1), (0, 0, 1)), turning("lean", "hip", "body", (0, 0, 0.2), (0, 1, 0))),
    )
    shoulder = Link("shoulder", 1.0, (0.0, 0.0, 0.0), 0.002 * np.eye(3))
    joints = (
        turning("swing", "shoulder", "upper", (0, 0, 0), (1, 0, 0)),
        turning("lift", "upper", "lower", (0, 0, 0.3), (0, 1, 0)),
        turning("turn", "lower", "hand", (0, 0, 0.3), (1, 0, 0)),
    )
    arm = Robot((shoulder, beam("upper", 3.0, 0.3), beam("lower", 2.0, 0.3), beam("hand", 1.0, 0.15)), joints)
    sides = {"left_": (0.0, 0.2, 0.45), "right_": (0.0, -0.2, 0.45)}
    robot = merge_robots(body, dict.fromkeys(sides, arm), links=dict.fromkeys(sides, "body"), translations=sides)
    return Standing(robot, support=rectangle((-0.12, 0.12), (-0.15, 0.15)))


def planar_machine(size: int) -> Standing:
    """A chain of `size` links, 1.9 m long and 50 kg, in the y-z plane on a foot from y = -0.12 to 0.2 m."""
    share = np.linspace(1.3, 0.7, size)
    robot = planar_chain(1.9 * share / share.sum(), 50.0 * share**2 / (share**2).sum())
    joints = tuple(replace(joint, lower=-3.0, upper=3.0, velocity=3.0, effort=400.0) for joint in robot.joints)
    turn = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]  # the chain's x, y, z become the world's y, z, x
    return Standing(replace(robot, joints=joints), rotation=turn, support=rectangle((-0.1, 0.1), (-0.12, 0.2)))


def random_standing(rng: np.random.Generator, size: int) -> Standing:
    """A random tree on a triangular foot, its root anywhere in the world."""
    return Standing(
        random_robot(rng, size),
        translation=rng.normal(size=3),
        rotation=random_rotation(rng),
        support=Support([(0, 0), (1, 0), (0, 1)]),
        gravity=float(rng.uniform(1, 12)),
    )


def random_motion(rng: np.random.Generator, machine: Standing) -> tuple[Array, Array, Array]:
    """q, q', q''. Shape (n,) each."""
    n = machine.joint_size
    return rng.normal(size=n), rng.normal(size=n), rng.normal(scale=3.0, size=n)
