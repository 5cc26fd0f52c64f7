"""Where the links of a robot are along a motion, for pictures and for the view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import Machine, ModelError, Robot, link_frames
from models.arrays import Array
from ocp.problem.sampling import Sampler

__all__ = ["TIP", "Frames", "chain", "frames_along", "frames_function"]

TIP = "the tip frame"
"""Key of the tip among the frames; no link can have it that is also a link of the arm drawn."""


@dataclass(frozen=True)
class Frames:
    """Frames in the world along a motion, by link name and TIP.

    Attributes:
        rotations: Axes as columns. Shape (M, 3, 3) each.
        positions: Origins. Shape (M, 3) each, m.
    """

    rotations: dict[str, Array]
    positions: dict[str, Array]

    @property
    def tip(self) -> Array:
        """Origin of the tip frame. Shape (M, 3), m."""
        return self.positions[TIP]


def frames_function(machine: Machine) -> Callable[[Any, Any], Frames]:
    """A function of (joints, base), as of frames_along, that is made once and called often."""
    robot = machine.robot
    q, b = ca.SX.sym("q", robot.dof), ca.SX.sym("b", machine.base_size)
    found = link_frames(robot, q, machine.world_from_base(b))
    names = [*found]
    entries = [ca.vertcat(ca.vec(frame.rotation), frame.position) for frame in found.values()]
    if robot.tip is not None:
        tip = machine.tip_pose(b, q)
        entries.append(ca.vertcat(ca.vec(tip.rotation), tip.position))
        names.append(TIP)
    sampler = Sampler([b, q], [ca.densify(ca.SX(ca.vertcat(*entries)))])

    def frames(joints: Any, base: Any) -> Frames:
        angles = np.atleast_2d(np.asarray(joints, dtype=float))
        count = len(angles)
        place = np.zeros((count, 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
        if angles.shape[1] != robot.dof or place.shape != (count, machine.base_size):
            raise ModelError(
                f"joints and base of the shapes {angles.shape}, {place.shape} do not fit {robot.dof} joints "
                f"{list(robot.joint_names)} and a base of {machine.base_size} entries"
            )
        values = sampler(place, angles)[0].reshape(count, len(names), 12)
        rotations = {name: values[:, i, :9].reshape(-1, 3, 3).transpose(0, 2, 1) for i, name in enumerate(names)}
        return Frames(rotations, {name: values[:, i, 9:] for i, name in enumerate(names)})

    return frames


def frames_along(machine: Machine, joints: Any, base: Any = None) -> Frames:
    """Frames of all links, and of the tip where the robot has one.

    Args:
        machine: The robot on its base.
        joints: In the order of robot.joint_names. Shape (M, dof).
        base: Shape (M, base_size); None for a fixed base.

    Raises:
        ModelError: Wrong sizes.
    """
    return frames_function(machine)(joints, base)


def chain(robot: Robot) -> list[str]:
    """Links from the root to the tip, and TIP: the arm as a line of points."""
    return [robot.root, *(joint.child for joint in robot.path_to(robot.tip_link)), TIP]
