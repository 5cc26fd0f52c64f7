"""What toppra breaks between its points is found in what it writes: the path of its own first example.

Five random postures of seven joints (seed 9) and random limits of velocity and acceleration, joined by a spline. It
keeps the limits at the points of its grid alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toppra
from toppra.algorithm import TOPPRA
from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

from models import Robot
from ocp.app.files import read_trajectory
from tests.ocp.app.motions import check_motion, joint, link, write_table

SEED, DOF, WAYPOINTS = 9, 7, 5
SHARE = 1e-3
PERIOD = 1e-3
"""s, between samples: what joins them overshoots the kinks of these accelerations, at twice as much by 2 %."""


def example() -> tuple[Any, Any, Any]:
    """toppra's trajectory, and its limits of velocity and acceleration, shape (7,)."""
    rng = np.random.RandomState(SEED)
    configurations = rng.randn(WAYPOINTS, DOF)
    velocity, acceleration = 10 + rng.rand(DOF) * 20, 10 + rng.rand(DOF) * 2
    toppra.setup_logging("ERROR")
    path = toppra.SplineInterpolator(np.linspace(0, 1, WAYPOINTS), configurations)
    limits = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    return TOPPRA(limits, path).compute_trajectory(0, 0), velocity, acceleration


def arm(velocity: Any) -> Robot:
    """Seven bars in a row, whose joints turn about axes across each other."""
    text = '<link name="bar0"/>'
    for k, most in enumerate(velocity.tolist(), start=1):
        limits = f'lower="-9" upper="9" velocity="{most!r}" effort="99"'
        text += link(f"bar{k}", 0.2, 1.0)
        text += joint(f"joint{k}", "revolute", f"bar{k - 1}", f"bar{k}", 0.2, limits, "0 0 1" if k % 2 else "0 1 0")
    return Robot.from_urdf(f'<robot name="seven">{text}</robot>')


@pytest.mark.parametrize("with_rates", [2, 3])
def test_limits_that_toppra_violates_are_reported(with_rates: int, tmp_path: Path) -> None:
    motion, velocity, acceleration = example()
    robot = arm(velocity)
    t = np.append(np.arange(0.0, motion.duration, PERIOD), motion.duration)
    file = write_table(tmp_path / "motion.csv", t, *[motion(t, k) for k in range(with_rates)], names=robot.joint_names)
    limit = dict(zip(robot.joint_names, acceleration.tolist(), strict=True))
    read = read_trajectory(file, joints=robot.joint_names)
    check = check_motion(robot, read, acceleration=limit, scene=False, share=SHARE)
    by_name = {(fault.kind, fault.name): fault for fault in check.faults}
    fine = np.linspace(0.0, motion.duration, 50_001)
    broken = set()
    for kind, order, most in (("velocity", 1, velocity), ("acceleration", 2, acceleration)):
        used = np.abs(motion(fine, order)) / most
        for name, of_joint in zip(robot.joint_names, used.T, strict=True):
            if of_joint.max() > 1 + SHARE:
                broken.add((kind, name))
                fault = by_name[kind, name]
                assert of_joint[np.abs(fine - (fault.time or 0.0)) <= PERIOD].max() > 0.99 * of_joint.max()
                assert abs(fault.value or 0.0) == pytest.approx(of_joint.max() * abs(fault.limit or 0.0), rel=1e-2)
    assert by_name.keys() == broken
    assert broken
