"""Example robots for first plans and for tests: arms with typical dimensions and simple shapes."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.arrays import checked_choice
from models.robot.parts import CollisionShape, Joint, Link
from models.robot.robot import Robot

__all__ = ["example_robot"]

X, Y, Z = np.eye(3)
ALONG = {id(X): ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), id(Y): ((1, 0, 0), (0, 0, 1), (0, -1, 0)), id(Z): np.eye(3)}
"""Rotations that align a cylinder with an axis."""
ROWS: dict[str, list[tuple[Any, ...]]] = {
    "six_axis": [
        ("shoulder", (0, 0, 0.09), Z, 3.14, 3.14, 150, Z, -0.05, 0.06, 0.06, 3.5),
        ("upper_arm", (0, 0.135, 0), Y, 3.14, 3.14, 150, X, -0.03, 0.455, 0.055, 8.0),
        ("forearm", (0.425, -0.12, 0), Y, 2.8, 3.14, 150, X, -0.03, 0.41, 0.045, 2.5),
        ("wrist_1", (0.39, 0, 0), Y, 3.14, 3.14, 28, Y, -0.02, 0.125, 0.04, 1.2),
        ("wrist_2", (0, 0.095, 0), Z, 3.14, 3.14, 28, Z, -0.125, 0.03, 0.04, 1.2),
        ("wrist_3", (0, 0, -0.095), Y, 3.14, 3.14, 28, Y, 0.0, 0.08, 0.035, 0.3),
    ],
    "seven_axis": [
        ("link_1", (0, 0, 0.15), Z, 2.96, 1.7, 320, Z, 0.02, 0.23, 0.065, 4.0),
        ("link_2", (0, 0, 0.19), Y, 2.09, 1.7, 320, Z, -0.04, 0.2, 0.06, 4.0),
        ("link_3", (0, 0, 0.2), Z, 2.96, 1.7, 170, Z, 0.0, 0.235, 0.06, 3.0),
        ("link_4", (0, 0, 0.2), -Y, 2.09, 2.2, 170, Z, -0.04, 0.19, 0.055, 2.7),
        ("link_5", (0, 0, 0.19), Z, 2.96, 2.4, 110, Z, 0.0, 0.245, 0.05, 1.7),
        ("link_6", (0, 0, 0.21), Y, 2.09, 3.1, 40, Z, -0.04, 0.075, 0.045, 1.8),
        ("link_7", (0, 0, 0.08), Z, 3.05, 3.1, 40, Z, 0.0, 0.045, 0.04, 0.3),
    ],
}
"""Each link: name, position in the previous link, joint axis, limits of position, velocity, effort (rad, rad/s, N m);
then its body, a homogeneous cylinder: axis, start and end along it, radius (m), mass (kg).
"""


def example_robot(name: str) -> Robot:
    """Return an example robot with its tip at the flange "tool0", whose z axis points out of the arm.

    Args:
        name: "six_axis", an arm with three parallel axes, or "seven_axis", an arm whose axes intersect at shoulder and
            wrist. Each reaches about 0.9 m from its shoulder.

    Raises:
        ModelError: Another name.
    """
    rows = ROWS[checked_choice(name, ROWS, "example_robot", "name")]
    links, joints = [_cylinder("base", Z, 0.0, 0.12 if name == "seven_axis" else 0.03, 0.07, 4.0)], []
    for k, (link, place, axis, limit, velocity, effort, *body) in enumerate(rows, 1):
        limits = {"lower": -limit, "upper": limit, "velocity": velocity, "effort": effort}
        joints.append(Joint(f"joint_{k}", "revolute", links[-1].name, link, place, axis=axis, **limits))
        links.append(_cylinder(link, *body))
    *_, axis, _, end, _, _ = rows[-1]
    flange = Joint("flange", "fixed", links[-1].name, "tool0", end * axis, ALONG[id(axis)])
    return Robot((*links, Link("tool0")), (*joints, flange), "tool0", name=name)


def _cylinder(name: str, axis: Any, begin: float, end: float, radius: float, mass: float) -> Link:
    transverse, axial = mass * (3 * radius**2 + (end - begin) ** 2) / 12, mass * radius**2 / 2
    middle = (begin + end) / 2 * axis
    shape = CollisionShape("cylinder", (radius, end - begin), translation=middle, rotation=ALONG[id(axis)])
    return Link(
        name, mass, middle, transverse * np.eye(3) + (axial - transverse) * np.outer(axis, axis), collisions=(shape,)
    )
