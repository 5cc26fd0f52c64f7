"""A grasp between two bodies that float: from where it is approached, what the hand bears, and both as one machine.

Twists match at the grasp, so nothing strikes, and the momentum of both as one is that of the one and of the other,
about their common centre of mass,

    P = P1 + P2,    L = L1 + L2 + (c2 - c1) x (m1 P2 - m2 P1) / (m1 + m2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, ModelError, Robot, attach_tool, center_of_mass
from models.machines.machine import with_tip
from models.spatial import Expression, cross
from ocp.errors import NOT_NUMBERS, ProblemError, checked_instance, checked_positive, floats, real
from ocp.problem.problem import Problem

__all__ = ["Cone", "Grasp", "checked_pair", "grasp_wrench", "joined", "motion_of", "pair_momentum"]


@dataclass(frozen=True)
class Cone:
    """Where the chaser's tip may be near the grasp, seen from the frame that is grasped.

    Attributes:
        direction: From the grasp out to where the tip comes from, in the frame that is grasped. Shape (3,).
        half_angle: Of the cone, rad.
        length: From the grasp, up to which it is a cone, m. Before twice that it has opened to all directions.
        depth: How far behind the grasp its apex is, m: so much play is left at the grasp itself.

    Raises:
        ProblemError: No direction, an angle not between 0 and pi/2, lengths that are not positive.
    """

    direction: Any
    half_angle: float
    length: float
    depth: float = 0.01

    def __post_init__(self) -> None:
        try:
            given = floats(self.direction).ravel()
        except NOT_NUMBERS:
            given = np.zeros(0)
        if given.shape != (3,) or not np.isfinite(given).all() or not np.linalg.norm(given) > 0:
            words = f"cone: direction has to be three numbers, not all zero, not {self.direction!r}"
            raise ProblemError(words, name="direction", value=self.direction)
        object.__setattr__(self, "direction", given / np.linalg.norm(given))
        if not checked_positive("cone: half_angle", self.half_angle) < np.pi / 2:
            words = f"cone: half_angle has to be below pi/2, not {self.half_angle}"
            raise ProblemError(words, name="half_angle", value=self.half_angle, limit=np.pi / 2)
        checked_positive("cone: length", self.length)
        checked_positive("cone: depth", self.depth)

    def inside(self, place: Expression) -> Expression:
        """Not below zero within the cone, m. Shape (1, 1).

        Args:
            place: Of the tip, in the frame that is grasped. Shape (3, 1), m.
        """
        from_apex = place + self.depth * ca.DM(self.direction)
        far = ca.fmin(ca.fmax((ca.sumsqr(place) / self.length**2 - 1) / 3, 0), 1)
        opened = far**2 * (3 - 2 * far)
        least = np.cos(self.half_angle) * (1 - opened) - 2 * opened
        return ca.dot(ca.DM(self.direction), from_apex) - least * ca.norm_2(from_apex)


@dataclass(frozen=True)
class Grasp:
    """What the hand bears between tip and target while they are one.

    Attributes:
        force, moment: Greatest sizes, at the tip, N and N m; inf for no limit.

    Raises:
        ProblemError: Numbers that are not positive.
    """

    force: float = np.inf
    moment: float = np.inf

    def __post_init__(self) -> None:
        for what in ("force", "moment"):
            if not real(getattr(self, what)) > 0:
                words = f"grasp: {what} must be positive, not {getattr(self, what)!r}"
                raise ProblemError(words, name=what, value=getattr(self, what), limit=0.0)


def joined(chaser: Robot, target: Robot) -> Robot:
    """The chaser's robot with the target as a link on its tip, held at the target's tip frame.

    Raises:
        ModelError: A robot without a tip, links of the same name.
    """
    turn = np.asarray(target.tip_rotation).T
    shift = -turn @ np.asarray(target.tip_translation)
    return attach_tool(chaser, target, None, shift, rotation=turn, keep_tip=True)


def checked_pair(chaser: Any, target: Any) -> Robot:
    """Both as one robot."""
    for what, machine in (("chaser", chaser), ("target", target)):
        if checked_instance(f"capture: {what}", machine, FreeFloating).robot.tip is None:
            raise ProblemError(f"capture: the robot of the {what} needs a tip", name=what, value=machine)
    if target.base != chaser.base:
        words = f"capture: the chaser floats on a {chaser.base} base, the target on a {target.base} one"
        raise ProblemError(words, name="target", value=target.base, limit=chaser.base)
    if target.joint_size or len(target.robot.links) != 1:
        words = "capture: the target is one body: simplify(lock_joints(robot, ...)) makes one of several"
        raise ProblemError(words, name="target", value=target)
    if not chaser.joint_size:
        raise ProblemError("capture: the chaser has no joints to reach with", name="chaser", value=chaser)
    try:
        return joined(chaser.robot, target.robot)
    except ModelError as error:
        raise ProblemError(f"capture: {error}", name="target", value=error.value) from error


def pair_momentum(chaser: FreeFloating, target: FreeFloating, base: Any, target_base: Any, joints: Any) -> Expression:
    """Of both together, in the order of `FreeFloating.conserved_momentum`, about their common centre of mass.

    Args:
        base, target_base: Configurations of both. Shape (base_size,). joints: Of the chaser. Shape (n,).
    """
    rows = ca.DM.eye(6)[:, chaser.twist_rows]
    own = rows @ ca.vertcat(chaser.conserved_momentum)
    other = rows @ ca.vertcat(target.conserved_momentum)
    one, two = chaser.robot.total_mass, target.robot.total_mass
    arm = center_of_mass(target.robot, ca.DM(0, 1), target.world_from_base(target_base))
    arm -= center_of_mass(chaser.robot, joints, chaser.world_from_base(base))
    crossed = cross(arm, (one * other[3:6] - two * own[3:6]) / (one + two))
    return ca.vertcat(own[0:3] + other[0:3] + crossed, own[3:6] + other[3:6])[chaser.twist_rows]


def motion_of(problem: Problem) -> tuple[Any, Any, Any]:
    """Symbols of base, joints and velocities."""
    states = problem.declared.states
    return states["base"].symbol, states["joints"].symbol, states["velocities"].symbol


def grasp_wrench(pair: FreeFloating, target: FreeFloating, problem: Problem) -> tuple[Any, Any]:
    """What the tip does to the target while detumbling: (force, moment about the tip), world axes. Shape (3, 1) each.

    The rate of the target's momentum, m c'' and (I w)' about its centre of mass.
    """
    base, joints, rates = motion_of(problem)
    body = target.robot.links[0]
    middle = with_tip(pair, body.name, body.center_of_mass)
    center, twist = middle.tip_pose(base, joints), middle.tip_twist(base, joints, rates)
    inertia = ca.mtimes([center.rotation, ca.DM(np.asarray(body.inertia)), center.rotation.T])
    at = ca.vertcat(base, joints, rates)
    along = ca.vertcat(*(problem.declared.dynamics[name] for name in ("base", "joints", "velocities")))
    rate = ca.jtimes(ca.vertcat(ca.mtimes(inertia, twist[0:3]), body.mass * twist[3:6]), at, along)
    arm = center.position - pair.tip_pose(base, joints).position
    return rate[3:6], rate[0:3] + cross(arm, rate[3:6])
