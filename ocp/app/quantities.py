"""What is drawn over the time of a motion, with its limits: joints, torques, costs, what a base does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from models import FreeFloating, Machine, Standing, inverse_dynamics, simplified
from models.arrays import Array
from models.machines.standing import center_of_pressure
from models.robot.dynamics import GRAVITY
from ocp.app.joint_limits import floating_torques
from ocp.problem.sampling import Sampler
from ocp.tasks.limits import JointBounds

__all__ = ["Curve", "Footing", "footing_of", "joint_curves", "machine_curves", "so_far"]


@dataclass(frozen=True, eq=False)
class Curve:
    """A number over the time of a motion.

    Attributes:
        group: What it is drawn with. name: Of it. unit: "" of a pure number.
        values: At the motion's M times. Shape (M,).
        lower, upper: Its limits, infinite where there is none.
    """

    group: str
    name: str
    unit: str
    values: Array
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True, eq=False)
class Footing:
    """Where the ground pushes on a machine that stands.

    Attributes:
        corners: Of the region under its foot. Shape (k, 2), m.
        points: Zero moment points, at the motion's M times. Shape (M, 2), m.
        forces: Whether forces from outside are known, and in them.
    """

    corners: Array
    points: Array
    forces: bool


def joint_curves(
    machine: Machine, bounds: JointBounds, joints: Array, rates: Array, accelerations: Array | None
) -> list[Curve]:
    """Positions, rates and torques of all joints, shape (M, n) each, with what bounds them."""
    robot, found = machine.robot, []
    torques = None if accelerations is None else _torques(machine, joints, rates, accelerations)
    torque_group = "Torques, without forces from outside" if isinstance(machine, Standing) else "Torques"
    for k, joint in enumerate(robot.moving_joints):
        found.append(Curve("Joints", joint.name, joint.unit, joints[:, k], bounds.lower[k], bounds.upper[k]))
    for k, joint in enumerate(robot.moving_joints):
        most = float(bounds.velocity[k])
        found.append(Curve("Joint rates", joint.name, f"{joint.unit}/s", rates[:, k], -most, most))
    for k, joint in enumerate(robot.moving_joints if torques is not None else ()):
        assert torques is not None
        most = float(bounds.torque[k])
        found.append(Curve(torque_group, joint.name, joint.effort_unit, torques[:, k], -most, most))
    return found


def _torques(machine: Machine, joints: Array, rates: Array, accelerations: Array) -> Array | None:
    """By inverse dynamics, shape (M, n); None of a robot without masses."""
    robot = machine.robot
    if robot.total_mass == 0:
        return None
    q, v, a = (ca.SX.sym(name, robot.dof) for name in ("q", "v", "a"))
    if isinstance(machine, FreeFloating):
        torque = floating_torques(machine, q, v, a)
    else:
        gravity = getattr(machine, "gravity_in_world", GRAVITY)
        frame = machine.world_from_base(())
        torque = inverse_dynamics(simplified(robot), q, v, a, (), gravity, frame)
    found: Array = Sampler([q, v, a], [torque])(joints, rates, accelerations)[0]
    return found


def machine_curves(machine: Machine, base: Array, joints: Array, rates: Array, base_rates: Array | None) -> list[Curve]:
    """Manipulability and speed of the tip; of a floating machine its momentum, where rates of its base are known."""
    robot, found = machine.robot, []
    b, q, v = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", robot.dof), ca.SX.sym("v", robot.dof)
    if robot.tip is not None:
        rows = range(6) if robot.dof >= 6 else range(3, 6) if robot.dof >= 3 else (3, 4)
        what = "of the pose" if robot.dof >= 6 else "of the position" if robot.dof >= 3 else "in the plane"
        twist = machine.tip_twist(b, q, v)
        sampler = Sampler([b, q, v], [machine.manipulability(b, q, rows), ca.norm_2(twist[3:6])])
        index, speed = sampler(base, joints, rates)
        found.append(Curve("The motion", f"manipulability {what}", "", index[:, 0]))
        found.append(Curve("The motion", "speed of the tip", "m/s", speed[:, 0]))
    if isinstance(machine, FreeFloating) and base_rates is not None:
        r = ca.SX.sym("r", machine.base_size)
        whole = machine.momentum(b, q, machine.twist_of_rate(b, r), v)
        own = machine.momentum(b, q, ca.SX(len(machine.twist_rows), 1), v)
        turns = 3 if machine.base_size == 7 else 1
        parts = [whole[:turns], whole[turns:], own[:turns], own[turns:]]
        spin, push, own_spin, own_push = Sampler([b, q, v, r], [ca.norm_2(part) for part in parts])(
            base, joints, rates, base_rates
        )
        for name, value, share, unit in (
            ("moment of momentum", spin, own_spin, "N m s"),
            ("momentum", push, own_push, "N s"),
        ):
            found.append(Curve("Momentum", f"{name}, of the whole", unit, value[:, 0]))
            found.append(Curve("Momentum", f"{name}, of the joints alone", unit, share[:, 0]))
    return found


def footing_of(
    machine: Standing, joints: Array, rates: Array, accelerations: Array, inside: Sequence[Curve] = ()
) -> tuple[Footing, list[Curve]]:
    """Where the ground pushes, and how far from the edge of the foot.

    Args:
        joints, rates, accelerations: Shape (M, n) each.
        inside: How far it is inside each edge, as a problem says that knows of forces from outside; less a margin that
            is the same everywhere. Without, no such forces are known.
    """
    normals, corners = machine.support.normals, np.asarray(machine.support.vertices)
    if len(inside) == len(normals):
        point = ca.SX.sym("point", 2)
        edges = np.array(ca.Function("edges", [point], [machine.support.distances(point)])(np.zeros(2))).ravel()
        rows = np.column_stack([normals, -np.ones(len(normals))])
        told = np.column_stack([one.values for one in inside]) - edges
        found, *_ = np.linalg.lstsq(rows, told.T, rcond=None)
        if np.abs(rows @ found - told.T).max() < 1e-8:  # m: rounding; they are those of one point
            points = np.ascontiguousarray(found[:2].T)
            distances = edges + points @ normals.T
            margin = Curve("Standing", "zero moment point from the edge of the foot", "m", distances.min(axis=1), 0.0)
            return Footing(corners, points, True), [margin]
    q, v, a = (ca.SX.sym(name, machine.joint_size) for name in ("q", "v", "a"))
    point = center_of_pressure(machine.ground_reaction(q, v, a))
    points, inner = Sampler([q, v, a], [point, machine.support.margin(point)])(joints, rates, accelerations)
    words = "zero moment point from the edge of the foot, no forces from outside"
    return Footing(corners, points, False), [Curve("Standing", words, "m", inner[:, 0], 0.0)]


def so_far(t: Array, values: Array) -> Array:
    """The integral of samples (M,) up to each time, by trapezia. Shape (M,)."""
    return np.concatenate([[0.0], np.cumsum(np.diff(t) * (values[1:] + values[:-1]) / 2)])
