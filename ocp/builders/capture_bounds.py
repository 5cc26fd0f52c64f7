"""Why there is no capture, said before one is planned: bounds that hold whatever the chaser does.

The grasp may be farther off than the arm reaches. And both may have more momentum than the wheels hold: a wheel holds
h a along its axis a, |h| <= I w, and no more than its motor gives it in the time. Turned, the base brings the momentum
along any axis of its own: what counts is the largest sum of all h a.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from models import FreeFloating, Robot, center_of_mass, link_frames, wheels_of
from models.arrays import Array
from ocp.errors import ProblemError
from ocp.tasks.limits import JointBounds

__all__ = ["Start", "held_by_wheels", "require_reach", "require_room"]

ROUNDING = 1e-9
"""Relative; and N m s of a momentum."""


class Start(NamedTuple):
    """Where a capture begins, and until when it may take.

    Attributes:
        base, joints, velocities: Of the chaser; velocities that are free are nan.
        target_base: Configuration of the target.
        approach, detumble: How long the phases last at most, s.
    """

    base: Array
    joints: Array
    velocities: Array
    target_base: Array
    approach: float
    detumble: float


def held_by_wheels(machine: FreeFloating, bounds: JointBounds, start: Start, drives_alone: bool = True) -> float:
    """The largest angular momentum that the wheels of a chaser hold while its base rests, N m s.

    Args:
        bounds: Of its joints.
        start: Of the capture.
        drives_alone: Whether nothing but its motor turns a wheel about its axis: there is no friction.
    """
    robot, time = machine.robot, start.approach + start.detumble
    known = drives_alone and not np.isnan(start.velocities).any()
    spin = np.zeros(6)
    if known:
        twist = np.array(ca.DM(machine.base_twist(start.base, start.joints, start.velocities))).ravel()
        spin[machine.twist_rows] = twist
    spin = np.array(ca.DM(machine.world_from_base(start.base).rotation)).T @ spin[:3]
    frames, free, sides = link_frames(robot, ca.DM(start.joints)), 0.0, [np.zeros(3)]
    for name, inertia in wheels_of(robot).items():
        wheel, k = robot.joint(name), robot.joint_names.index(name)
        size = inertia * bounds.velocity[k]
        if any(joint.moves for joint in robot.path_to(wheel.parent)):  # the arm turns it to any side
            free += size
            continue
        axis = np.array(ca.DM(frames[wheel.parent].rotation)) @ np.asarray(wheel.rotation) @ np.asarray(wheel.axis)
        if known:
            size = min(size, inertia * abs(start.velocities[k] + axis @ spin) + bounds.torque[k] * time)
        if not np.isfinite(size):
            return np.inf
        side = size * (axis if machine.base == "spatial" else axis * [0.0, 0.0, 1.0])
        sides = [corner + sign * side for corner in sides for sign in (1.0, -1.0)]
    return float(free + np.linalg.norm(sides, axis=1).max())


def require_room(machine: FreeFloating, momentum: Array, held: float) -> None:
    """Raise where wheels cannot hold the angular momentum, whatever the attitude of the base at the end.

    Args:
        momentum: Of both, at the start, as of `pair_momentum`.
        held: What the wheels hold at most, N m s.
    """
    angular = [k for k, row in enumerate(machine.twist_rows) if row < 3]
    size = float(np.linalg.norm(np.asarray(momentum)[angular]))
    if size > held * (1 + ROUNDING) + ROUNDING:
        words = (
            f"capture: the pair has an angular momentum of {size:.6g} N m s, of which the wheels hold {held:.6g} at "
            f"most: {size - held:.6g} N m s are missing for it to come to rest. Other wheels, more time, momentum of "
            "the chaser against that of the target, or rest=False help"
        )
        raise ProblemError(words, name="momentum", value=size, limit=held)


def require_reach(chaser: FreeFloating, target: FreeFloating, start: Start, earliest: float) -> None:
    """Raise where the grasp is too far off for the arm at any time.

    Both centres of mass go on as they do, w + v t. The tip is no farther from the chaser's centre of mass than all
    joints in a line take it.

    Args:
        start: With the latest time of the grasp. earliest: The earliest, s.
    """
    arm = _arm(chaser, target)
    way, drift = _apart(chaser, target, start)
    nearest = -(way @ drift) / (drift @ drift) if drift.any() else earliest
    off = float(np.linalg.norm(way + drift * np.clip(nearest, earliest, start.approach)))
    if off > arm * (1 + ROUNDING):
        words = (
            f"capture: the centres of mass of chaser and target are {off:.4g} m apart or more, and the arm reaches "
            f"{arm:.4g} m at most: {off - arm:.4g} m are missing. Start nearer, or let them drift together"
        )
        raise ProblemError(words, name="reach", value=off, limit=arm)


def _apart(chaser: FreeFloating, target: FreeFloating, start: Start) -> tuple[Array, Array]:
    """From the chaser's centre of mass to the target's, m, and how fast that changes. Shape (3,) each."""
    centers, speeds = [], []
    for machine, base, joints in ((target, start.target_base, np.zeros(0)), (chaser, start.base, start.joints)):
        center = center_of_mass(machine.robot, ca.DM(joints), machine.world_from_base(ca.DM(base)))
        centers.append(np.array(ca.DM(center)).ravel())
        momentum = np.eye(6)[:, machine.twist_rows] @ np.asarray(machine.conserved_momentum)
        speeds.append(momentum[3:] / machine.robot.total_mass)
    return centers[0] - centers[1], speeds[0] - speeds[1]


def _arm(chaser: FreeFloating, target: FreeFloating) -> float:
    """How far apart the centres of mass of both are at most while the tip holds the grasp, m."""
    robot, body = chaser.robot, target.robot
    middle = sum(link.mass * _longest(robot, link.name, link.center_of_mass) for link in robot.links if link.mass)
    arm = _longest(robot, str(robot.tip_link), robot.tip_translation) + middle / robot.total_mass
    return arm + float(np.linalg.norm(np.subtract(body.tip_translation, body.links[0].center_of_mass)))


def _longest(robot: Robot, link: str, point: object) -> float:
    """How far a point of a link is from the root's origin at most, m; inf beyond a slide without limits."""
    found = float(np.linalg.norm(np.asarray(point, dtype=float)))
    for joint in robot.path_to(link):
        slides = max(abs(joint.lower), abs(joint.upper)) if joint.kind == "prismatic" else 0.0
        found += float(np.linalg.norm(joint.translation)) + slides
    return found
