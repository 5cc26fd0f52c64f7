"""Grasp between two floating bodies: the approach cone, the loads of the hand, and both bodies as one machine.

The twists match at the grasp, so that there is no impact. The momentum of the pair about its common centre of mass is

    P = P1 + P2,    L = L1 + L2 + (c2 - c1) x (m1 P2 - m2 P1) / (m1 + m2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, ModelError, Robot, attach_tool, center_of_mass
from models.checks import NOT_NUMBERS, floats, real
from models.machines.machine import with_tip
from models.spatial import Expression, cross
from ocp.errors import ProblemError, require
from ocp.problem.problem import Problem

__all__ = ["Cone", "Grasp", "checked_pair", "grasp_wrench", "joined", "motion_of", "pair_momentum"]


@dataclass(frozen=True)
class Cone:
    """Approach cone: region of the chaser's tip near the grasp, in the grasped frame.

    Attributes:
        direction: Direction from the grasp to the approaching tip, in the grasped frame. Shape (3,).
        half_angle: Half opening angle of the cone, rad.
        length: Distance from the grasp up to which it is a cone, m. At twice this distance it is open to all
            directions.
        depth: Distance of the apex behind the grasp, m. It leaves play at the grasp itself.

    Raises:
        ProblemError: The direction is zero, the angle is not between 0 and pi/2, or a length is not positive.
    """

    direction: Any
    half_angle: float
    length: float
    depth: float = 0.01

    def __post_init__(self) -> None:
        try:
            direction = floats(self.direction).ravel()
        except NOT_NUMBERS:
            direction = np.zeros(0)
        if direction.shape != (3,) or not np.isfinite(direction).all() or not np.linalg.norm(direction) > 0:
            words = f"cone: direction must be three numbers, not all zero, not {self.direction!r}"
            raise ProblemError(words, name="direction", value=self.direction)
        object.__setattr__(self, "direction", direction / np.linalg.norm(direction))
        if not require.positive("cone: half_angle", self.half_angle) < np.pi / 2:
            words = f"cone: half_angle must be below pi/2, not {self.half_angle}"
            raise ProblemError(words, name="half_angle", value=self.half_angle, limit=np.pi / 2)
        require.positive("cone: length", self.length)
        require.positive("cone: depth", self.depth)

    def inside(self, place: Expression) -> Expression:
        """Return a function that is not negative inside the cone, m. Shape (1, 1).

        Args:
            place: Position of the tip in the grasped frame. Shape (3, 1), m.
        """
        from_apex = place + self.depth * ca.DM(self.direction)
        share = ca.fmin(ca.fmax((ca.sumsqr(place) / self.length**2 - 1) / 3, 0), 1)
        opened = share**2 * (3 - 2 * share)
        least = np.cos(self.half_angle) * (1 - opened) - 2 * opened
        return ca.dot(ca.DM(self.direction), from_apex) - least * ca.norm_2(from_apex)


@dataclass(frozen=True)
class Grasp:
    """Load limits of the hand that holds the target.

    Attributes:
        force, moment: Largest norms at the tip, N and N m; inf for no limit.

    Raises:
        ProblemError: A limit is not positive.
    """

    force: float = np.inf
    moment: float = np.inf

    def __post_init__(self) -> None:
        for name, limit in vars(self).items():
            if not real(limit) > 0:
                raise ProblemError(f"grasp: {name} must be positive, not {limit!r}", name=name, value=limit, limit=0.0)


def joined(chaser: Robot, target: Robot) -> Robot:
    """Return the chaser's robot with the target as a link on its tip, at the target's tip frame.

    Raises:
        ModelError: A robot has no tip, or links have the same name.
    """
    turn = np.asarray(target.tip_rotation).T
    shift = -turn @ np.asarray(target.tip_translation)
    return attach_tool(chaser, target, None, shift, rotation=turn, keep_tip=True)


def checked_pair(chaser: Any, target: Any) -> Robot:
    """Return the robot of both, see `joined`.

    Raises:
        ProblemError: Machines of other kinds, without tips, with links of the same name, or a target with joints.
    """
    for name, machine in (("chaser", chaser), ("target", target)):
        if require.instance(f"capture: {name}", machine, FreeFloating).robot.tip is None:
            raise ProblemError(f"capture: the robot of the {name} needs a tip", name=name, value=machine)
    if target.base != chaser.base:
        words = f"capture: the chaser floats on a {chaser.base} base, the target on a {target.base} one"
        raise ProblemError(words, name="target", value=target.base, limit=chaser.base)
    if target.joint_size or len(target.robot.links) != 1:
        words = "capture: the target must be one body without joints; use simplified(locked(robot, ...))"
        raise ProblemError(words, name="target", value=target)
    if not chaser.joint_size:
        raise ProblemError("capture: the chaser has no joints to reach with", name="chaser", value=chaser)
    try:
        return joined(chaser.robot, target.robot)
    except ModelError as error:
        raise ProblemError(f"capture: {error}", name="target", value=error.value) from error


def pair_momentum(chaser: FreeFloating, target: FreeFloating, base: Any, target_base: Any, joints: Any) -> Expression:
    """Return the momentum of chaser and target about their common centre of mass.

    It has the order of `FreeFloating.conserved_momentum`.

    Args:
        base, target_base: Configurations of both bases. Shape (base_size,).
        joints: Joints of the chaser. Shape (n,).
    """
    rows = ca.DM.eye(6)[:, chaser.twist_rows]
    own = rows @ ca.vertcat(chaser.conserved_momentum)
    theirs = rows @ ca.vertcat(target.conserved_momentum)
    m1, m2 = chaser.robot.total_mass, target.robot.total_mass
    arm = center_of_mass(target.robot, ca.DM(0, 1), target.world_from_base(target_base))
    arm -= center_of_mass(chaser.robot, joints, chaser.world_from_base(base))
    crossed = cross(arm, (m1 * theirs[3:6] - m2 * own[3:6]) / (m1 + m2))
    return ca.vertcat(own[0:3] + theirs[0:3] + crossed, own[3:6] + theirs[3:6])[chaser.twist_rows]


def motion_of(problem: Problem) -> tuple[Any, Any, Any]:
    """Return the symbols of base, joints and velocities."""
    states = problem.declared.states
    return states["base"].symbol, states["joints"].symbol, states["velocities"].symbol


def grasp_wrench(pair: FreeFloating, target: FreeFloating, problem: Problem) -> tuple[Any, Any]:
    """Return force and moment about the tip that the hand applies to the target, in world axes. Shape (3, 1) each.

    They are the rates of the target's momentum, m c'' and (I w)' about its centre of mass.
    """
    base, joints, rates = motion_of(problem)
    body = target.robot.links[0]
    middle = with_tip(pair, body.name, body.center_of_mass)
    center, twist = middle.tip_pose(base, joints), middle.tip_twist(base, joints, rates)
    inertia = ca.mtimes([center.rotation, ca.DM(np.asarray(body.inertia)), center.rotation.T])
    at = ca.vertcat(base, joints, rates)
    state_rates = ca.vertcat(*(problem.declared.dynamics[name] for name in ("base", "joints", "velocities")))
    rate = ca.jtimes(ca.vertcat(ca.mtimes(inertia, twist[0:3]), body.mass * twist[3:6]), at, state_rates)
    arm = center.position - pair.tip_pose(base, joints).position
    return rate[3:6], rate[0:3] + cross(arm, rate[3:6])
