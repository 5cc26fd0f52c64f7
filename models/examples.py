"""Example machines: two typical robot arms, and the machines of the reproduced papers.

The docstring of each paper's machine names the data that the paper does not print and that are assumed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from models.checks import require
from models.cts.rig import INCH, Rig, Tunnel
from models.machines.free_floating import FreeFloating
from models.machines.standing import Standing
from models.machines.support import rectangle
from models.robot.parts import CollisionShape, Joint, Link
from models.robot.robot import Robot, planar_chain


def paper_example() -> FreeFloating:
    """Return the planar three-joint free-floating machine of Kim and Kim (2011), section 5.

    Printed: base 100 kg and 66.67 kg m^2 (a plate of 2 m x 2 m), links of 2 kg and 0.7083 kg m^2 (plates of
    2 m x 0.5 m). Assumed, identified from the pattern of Table 1: links 2 m long, arm mounted at (1, 0) m of the
    base, centres of mass at mid-link. In the paper the base starts at pose 0 and the joints at 45, 60, -60 deg; the
    tip moves at (-1, -1) m/s with free orientation.
    """
    base = Link("base", 100.0, inertia=np.diag([33.335, 33.335, 66.67]))
    return FreeFloating(planar_chain([2.0] * 3, [2.0] * 3, [0.7083] * 3, mount=(1.0, 0.0), base=base), base="planar")


STANDING_STARTS = {1: np.deg2rad([45.0, 160.0, 240.0, 200.0, 50.0]), 2: np.deg2rad([60.0, 80.0, 295.0, 230.0, 100.0])}
"""Start joint angles of `standing_example`, rad, keyed by the number of the table (1 or 2) in Yoo et al. 2004."""


def standing_example() -> Standing:
    """Return the five-link standing machine of Tables 1 and 2 of Yoo et al. 2004, which moves in the world's y-z plane.

    Each joint angle is relative to the previous link, the first to +y, counter-clockwise seen from +x.

    Assumed, because not printed: centres of mass at mid-link; slender rods; a massless foot with the ankle at the
    world's origin, 0.1 m wide in x (without effect), from y = -0.1 to 0.2 m (from the text), with a stability index
    about y = 0 of half-width 0.1 m (from the tables); the joint limits.
    """
    robot = planar_chain((0.44, 0.44, 0.52, 0.26, 0.18), (6.02, 14.0, 35.0, 3.92, 2.38))
    limits = np.deg2rad([(30, 120), (0, 165), (190, 360), (135, 360), (0, 150)])
    ranges = zip(robot.joints, limits, strict=True)
    joints = tuple(replace(joint, lower=lower, upper=upper) for joint, (lower, upper) in ranges)
    return Standing(
        replace(robot, joints=joints),
        rotation=[(0, 0, 1), (1, 0, 0), (0, 1, 0)],  # the chain's x, y, z become the world's y, z, x
        support=rectangle((-0.05, 0.05), (-0.1, 0.2)),
        most_stable_point=(0.0, 0.0),
        half_widths=(0.05, 0.1),
    )


def reference_rig(**limits: Any) -> Rig:
    """Return the captive trajectory rig of Lee and Lee (2017), with link lengths that are assumed.

    Assumed: 20, 20, 4, 30, 20, 10 in, in the order of the fields of Rig. Keywords are the joint limits of Rig.
    """
    return Rig(*(INCH * length for length in (20.0, 20.0, 4.0, 30.0, 20.0, 10.0)), **limits)


def reference_tunnel() -> Tunnel:
    """Return the wind tunnel of Lee and Lee (2017), with geometry and weights of the cost that are assumed.

    Assumed: centre (80, 0, 0) in, ranges (60, 48, 40) in, weights 1.
    """
    return Tunnel(INCH * np.array([80.0, 0.0, 0.0]), INCH * np.array([60.0, 48.0, 40.0]))


X, Y, Z = np.eye(3)
ALONG = {id(X): ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), id(Y): ((1, 0, 0), (0, 0, 1), (0, -1, 0)), id(Z): np.eye(3)}
"""Rotation matrices that turn the z axis of a cylinder to the axis X, Y or Z, keyed by the `id` of the axis."""
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
"""Data of each link of the example robots.

A row has: name, position in the previous link (m), joint axis, limits of position, velocity and effort (rad, rad/s, N
m), and a homogeneous cylinder: its axis, start and end along it, radius (m), mass (kg).
"""


def example_robot(name: str) -> Robot:
    """Return an example robot with its tip at the flange "tool0", whose z axis points out of the arm.

    Args:
        name: "six_axis", an arm with three parallel axes, or "seven_axis", an arm whose axes intersect at shoulder and
            wrist. Each reaches about 0.9 m from its shoulder.

    Raises:
        ModelError: Another name.
    """
    rows = ROWS[require.choice("example_robot: name", name, ROWS)]
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
    inertia = transverse * np.eye(3) + (axial - transverse) * np.outer(axis, axis)
    return Link(name, mass, middle, inertia, collisions=(shape,))
