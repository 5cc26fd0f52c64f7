"""Example machines of the four reproduced papers, with the assumptions for data that the papers do not print."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from models.cts.rig import INCH, Rig, Tunnel
from models.machines.free_floating import FreeFloating
from models.machines.standing import Standing
from models.machines.support import rectangle
from models.robot.parts import Link
from models.robot.robot import planar_chain


def paper_example() -> FreeFloating:
    """Return the planar three-joint free-floating machine of Kim, Kim 2011, section 5.

    Printed: base 100 kg and 66.67 kg m^2 (a plate of 2 m x 2 m), links of 2 kg and 0.7083 kg m^2 (plates of
    2 m x 0.5 m). Assumed, identified from the pattern of Table 1: links 2 m long, arm mounted at (1, 0) m of the
    base, centres of mass at mid-link. In the paper the base starts at pose 0 and the joints at 45, 60, -60 deg; the
    tip moves at (-1, -1) m/s with free orientation.
    """
    base = Link("base", 100.0, inertia=np.diag([33.335, 33.335, 66.67]))
    robot = planar_chain([2.0] * 3, [2.0] * 3, [0.7083] * 3, mount=(1.0, 0.0), base=base)
    return FreeFloating(robot, base="planar")


STANDING_STARTS = {1: np.deg2rad([45.0, 160.0, 240.0, 200.0, 50.0]), 2: np.deg2rad([60.0, 80.0, 295.0, 230.0, 100.0])}
"""Start configurations of the tasks of Tables 1 and 2, rad."""


def standing_example() -> Standing:
    """Return the five-link standing machine of Tables 1 and 2 of Yoo et al. 2004, which moves in the world's y-z plane.

    Each joint angle is relative to the previous link, the first to +y, counter-clockwise seen from +x.

    Assumed, because not printed: centres of mass at mid-link; slender rods; a massless foot with the ankle at the
    world's origin, 0.1 m wide in x (without effect), from y = -0.1 to 0.2 m (from the text), with a stability index
    about y = 0 of half-width 0.1 m (from the tables); the joint limits.
    """
    robot = planar_chain((0.44, 0.44, 0.52, 0.26, 0.18), (6.02, 14.0, 35.0, 3.92, 2.38))
    limits = np.deg2rad([(30, 120), (0, 165), (190, 360), (135, 360), (0, 150)])
    joints = tuple(
        replace(joint, lower=lower, upper=upper) for joint, (lower, upper) in zip(robot.joints, limits, strict=True)
    )
    return Standing(
        replace(robot, joints=joints),
        rotation=[(0, 0, 1), (1, 0, 0), (0, 1, 0)],  # the chain's x, y, z become the world's y, z, x
        support=rectangle((-0.05, 0.05), (-0.1, 0.2)),
        most_stable_point=(0.0, 0.0),
        half_widths=(0.05, 0.1),
    )


def reference_rig(**limits: Any) -> Rig:
    """Return the rig of the reference numbers. Its lengths are assumed: 20, 20, 4, 30, 20, 10 in."""
    return Rig(*(INCH * length for length in (20.0, 20.0, 4.0, 30.0, 20.0, 10.0)), **limits)


def reference_tunnel() -> Tunnel:
    """Return the tunnel of the reference numbers. Assumed: centre (80, 0, 0) in, ranges (60, 48, 40) in, weights 1."""
    return Tunnel(INCH * np.array([80.0, 0.0, 0.0]), INCH * np.array([60.0, 48.0, 40.0]))
