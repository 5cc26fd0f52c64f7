"""Robots that stand unfixed on level ground: ground reaction, zero moment point, stability (Yoo et al. 2004).

The ground is the plane z = 0 of the world, z upwards. While the foot stays flat on it, the machine is one on a fixed
base; whether it stays is decided by the required ground reaction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models.checks import ROUNDING, Array, ArrayInput, require, set_fields
from models.errors import ModelError
from models.machines.machine import FixedBase, Wrenches, WrenchFunction, wrenches_at
from models.machines.support import Support
from models.robot.dynamics import Wrench, base_reaction, external_wrench, inverse_dynamics
from models.robot.kinematics import (
    center_of_mass,
    checked_vector,
    joint_excess,
    joint_limit_index,
    joint_vector,
    manipulability_of,
)
from models.robot.parts import massless_error
from models.robot.rebuild import simplify
from models.spatial import Expression, expression


class ZmpRows(NamedTuple):
    """Coefficients of the linear condition on joint accelerations that keeps the zero moment point at a given position.

    J_m q'' + q'^T H_m q' = C, equation (18) of the paper. Row 0 fixes x, row 1 y, as moments about the position, N m.
    """

    jacobian: Expression  # J_m. Shape (2, n).
    hessians: tuple[Expression, Expression]  # the two planes of H_m, symmetric. Shape (n, n) each.
    right: Expression  # C, with gravity and the wrenches. Shape (2, 1).

    def needed(self, qd: Expression) -> Expression:
        """Return the moments that joint accelerations must produce to hold the zero moment point. Shape (2, 1), N m."""
        qd = expression(qd)
        return self.right - ca.vertcat(*(ca.mtimes([qd.T, plane, qd]) for plane in self.hessians))


@dataclass(frozen=True, eq=False, kw_only=True)
class Standing(FixedBase):
    """A robot whose root link, the foot, stands on the ground without being fixed to it.

    In addition to the attributes of FixedBase (`robot`, `translation`, `rotation` of the foot's frame in the world):

    Attributes:
        support: Region of the ground under the foot.
        gravity: m/s^2, downwards.
        most_stable_point: (x, y) at which the stability index is 1; the centre of the support's bounding box if None.
            Shape (2,), m.
        half_widths: Distances in x and y at which the index falls to 0; those of the bounding box if None. Shape (2,),
            m.

    Raises:
        ModelError: No moving joint, no mass, no Support, wrong sizes, a gravity or a half-width that is not positive.
    """

    support: Support
    gravity: float = 9.81
    most_stable_point: ArrayInput = None
    half_widths: ArrayInput = None

    def __post_init__(self) -> None:
        super().__post_init__()
        owner = "standing machine"
        if not isinstance(self.support, Support):
            message = f"{owner}: support must be a Support, as rectangle(...) gives, not {self.support!r}"
            raise ModelError(message, name="support", value=self.support)
        if self.robot.total_mass == 0:
            raise massless_error("nothing presses its foot on the ground")
        set_fields(self, gravity=require.positive(f"{owner}: gravity", self.gravity, unit="m/s^2"))
        point = self.support.center if self.most_stable_point is None else self.most_stable_point
        widths = self.support.half_widths if self.half_widths is None else self.half_widths
        set_fields(self, most_stable_point=require.array(f"{owner}: most_stable_point", point, (2,)))
        set_fields(self, half_widths=require.array(f"{owner}: half_widths", widths, (2,), sign="positive", unit="m"))

    @property
    def weight(self) -> float:
        """Weight of the robot, N."""
        return self.robot.total_mass * self.gravity

    @property
    def gravity_in_world(self) -> Array:
        """Gravitational acceleration in world axes. Shape (3,), m/s^2."""
        return np.array([0.0, 0.0, -self.gravity])

    def ground_reaction(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """Return the ground's wrench on the foot: (moment about the world's origin, force). Shape (6, 1), N m, N."""
        return base_reaction(self.robot, q, qd, qdd, **self._forces(wrenches))

    def zero_moment_point(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """Return the zero moment point, (2, 1), m, about which the ground reaction has no horizontal moment.

        Equations (2), (3) and, corrected, (35), (36) of the paper; only meaningful while the vertical force is
        positive.
        """
        return center_of_pressure(self.ground_reaction(q, qd, qdd, wrenches))

    def joint_torques(
        self, q: Expression, qd: Expression, qdd: Expression, wrenches: Sequence[Wrench] = ()
    ) -> Expression:
        """Return the joint torques (or forces) that a motion requires, by inverse dynamics. Shape (n, 1), N m or N."""
        return inverse_dynamics(self.robot, q, qd, qdd, **self._forces(wrenches))

    def _forces(self, wrenches: Sequence[Wrench]) -> dict[str, Any]:
        """Return keyword arguments of `base_reaction` and `inverse_dynamics`: external wrenches, gravity, foot pose."""
        return {"wrenches": wrenches, "gravity": self.gravity_in_world, "world_from_base": self.world_from_base()}

    def stability_index(self, point: Expression) -> Expression:
        """Return the stability index 1 - ((point - most_stable_point) / half_widths)^2 in x and y. Shape (2, 1).

        Equations (5) and (6) of Yoo et al. 2004.
        """
        offset = checked_vector("point", point, 2, "x and y on the ground") - ca.DM(self.most_stable_point)
        return 1 - (offset / ca.DM(self.half_widths)) ** 2

    def zmp_rows(self, q: Expression, qd: Expression, point: Expression, wrenches: Sequence[Wrench] = ()) -> ZmpRows:
        """Return the linear equation for the joint accelerations that puts the zero moment point at `point` (2,), m."""
        outside = external_wrench(self.robot, q, wrenches, self.world_from_base())
        point = checked_vector("point", point, 2, "x and y on the ground")
        q, qd = joint_vector(self.robot, q), joint_vector(self.robot, qd, "qd")
        jacobian, first, second, right = self._zmp_rows(q, qd, point, outside)
        return ZmpRows(jacobian, (first, second), right)

    @cached_property
    def _zmp_rows(self) -> Any:
        n = self.joint_size
        q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
        point, outside = ca.SX.sym("point", 2), ca.SX.sym("external_wrench", 6)
        x, y = ca.vertsplit(point)

        def moments(velocity: Expression, acceleration: Expression) -> Expression:
            """Return moments of the ground reaction about `point`, eqs. (11), (12) of Yoo et al. 2004. Shape (2, 1)."""
            reaction = self.ground_reaction(q, velocity, acceleration) - outside
            return ca.vertcat(-reaction[1] - x * reaction[5], reaction[0] - y * reaction[5])

        rest = ca.DM.zeros(n)
        jacobian = ca.jacobian(moments(qd, qdd), qdd)
        moving, at_rest = moments(qd, rest), moments(rest, rest)
        planes = [ca.hessian(moving[i], qd)[0] / 2 for i in (0, 1)]
        outputs = [ca.densify(part) for part in (jacobian, *planes, -at_rest)]
        return ca.Function("zmp_rows", [q, qd, point, outside], outputs, {"cse": True})

    @cached_property
    def _sampled_points(self) -> Array:
        """Zero moment points of random motions without external wrenches. Shape (5, 2), m."""
        rng = np.random.default_rng(0)
        points = [ca.DM(self.zero_moment_point(*rng.normal(size=(3, self.joint_size)))) for _ in range(5)]
        return np.array([np.array(point).ravel() for point in points])

    @cached_property
    def moving_directions(self) -> Array:
        """Orthonormal directions on the ground in which joint motion can shift the zero moment point. Shape (k, 2)."""
        _, sizes, directions = np.linalg.svd(self._sampled_points - self._sampled_points.mean(axis=0))
        count = int((sizes > 1e-9 * max(1.0, sizes[0])).sum())
        if count == 2:
            return np.eye(2)
        axes = np.where(np.abs(directions[:count]) < 1e-9, 0.0, directions[:count])
        return np.asarray(axes * np.sign(axes[np.arange(count), np.abs(axes).argmax(axis=1)])[:, None])

    @property
    def moving_axes(self) -> tuple[int, ...]:
        """Indices of the coordinates of the zero moment point that joint motion can change: 0 for x, 1 for y."""
        return tuple(axis for axis in (0, 1) if self.moving_directions[:, axis].any())

    def nearest_reachable(self, point: ArrayInput) -> Array:
        """Return the point nearest to `point` to which joint motion can shift the zero moment point. Shape (2,), m."""
        target = require.array("standing machine: point", point, (2,))
        projection = self.moving_directions.T @ self.moving_directions
        return np.asarray(projection @ target + (np.eye(2) - projection) @ self._sampled_points.mean(axis=0))

    def tip_wrench(self, force: Expression, moment: Expression = (0.0, 0.0, 0.0)) -> Wrench:
        """Return the wrench of a force (N) and a moment (N m), in world axes, that act at the tip. Shape (3,) each."""
        return Wrench(self.robot.tip_link, force, moment, self.robot.tip_translation)


def center_of_pressure(reaction: Expression) -> Expression:
    """Return the zero moment point, (2, 1), m, of a ground reaction (moment about the world's origin, force)."""
    reaction = checked_vector("reaction", reaction, 6, "moment about the world's origin and force")
    return ca.vertcat(-reaction[1], reaction[0]) / reaction[5]


def tip_spring(machine: Standing, stiffness: ArrayInput, rest: ArrayInput) -> WrenchFunction:
    """Return the function that gives the external wrench of a spring at the tip, the force -stiffness (tip - rest).

    Args:
        stiffness: Along world x, y, z. Shape (3,), N/m.
        rest: Position of the tip at which the spring is relaxed. Shape (3,), m.
    """
    require.instance("tip spring: machine", machine, Standing)
    k = require.array("tip spring: stiffness", stiffness, (3,))
    relaxed = require.array("tip spring: rest", rest, (3,))
    return lambda time, tip: [machine.tip_wrench(-ca.DM(k) * (tip - ca.DM(relaxed)))]


Rows: TypeAlias = Sequence[int] | Callable[[Expression], Expression]
"""Task whose manipulability is reported: components of the tip's twist, or a function from q to a Jacobian (m, n)."""


@dataclass(frozen=True)
class StandingMotion:
    """A motion of a standing machine at M sampled times, with the joint torques and ground reaction it requires."""

    t: Array  # times. Shape (M,), s.
    joints: Array  # shape (M, n)
    joint_velocities: Array  # shape (M, n)
    joint_accelerations: Array  # shape (M, n)
    joint_torques: Array  # by inverse dynamics. Shape (M, n), N m or N.
    tip_in_world: Array  # shape (M, 3), m
    external_force: Array  # sum of the external forces, wherever they act, world axes. Shape (M, 3), N.
    center_of_mass: Array  # shape (M, 3), m
    ground_force: Array  # force of the ground on the foot. Shape (M, 3), N.
    zero_moment_point: Array  # (x, y). Shape (M, 2), m.
    index: Array  # stability index in x and y, equations (5) and (6). Shape (M, 2).
    foot_margin: Array  # signed distance of the zero moment point from the edge of the support. Shape (M,), m.
    joint_excess: Array  # largest violation of a joint limit, negative inside. Shape (M,), rad or m.
    joint_limit_index: Array  # p1, equation (23). Shape (M,).
    manipulability: Array  # p2, equation (27), of the task's rows. Shape (M,).

    @property
    def friction(self) -> Array:
        """Required friction coefficient: horizontal over vertical ground force, inf without contact. Shape (M,)."""
        vertical = self.ground_force[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.linalg.norm(self.ground_force[:, :2], axis=1) / vertical
        return np.asarray(np.where(vertical > 0, ratio, np.inf))

    @property
    def stays_on_ground(self) -> bool:
        """Whether the vertical force of the ground on the foot is positive throughout the motion."""
        return bool((self.ground_force[:, 2] > 0).all())

    @property
    def stays_in_foot(self) -> bool:
        """Whether the zero moment point stays in the support polygon of the foot throughout the motion."""
        return bool((self.foot_margin >= -ROUNDING).all())

    @property
    def stays_in_limits(self) -> bool:
        """Whether all joints stay within their position limits throughout the motion."""
        return bool((self.joint_excess <= ROUNDING).all())

    @property
    def stands(self) -> bool:
        """Whether the machine neither lifts off nor tips, which a stability index of 1 does not imply."""
        return self.stays_on_ground and self.stays_in_foot

    def summary(self) -> dict[str, float | bool]:
        """Return extreme values of forces, margins and joint quantities of the motion, and whether the robot stands."""
        zmp = self.zero_moment_point
        return {
            "stands": self.stands,
            "in_joint_limits": self.stays_in_limits,
            "duration_s": float(self.t[-1]),
            "zmp_x_min_m": float(zmp[:, 0].min()),
            "zmp_x_max_m": float(zmp[:, 0].max()),
            "zmp_y_min_m": float(zmp[:, 1].min()),
            "zmp_y_max_m": float(zmp[:, 1].max()),
            "index_min": float(self.index.min()),
            "foot_margin_min_m": float(self.foot_margin.min()),
            "vertical_force_min_n": float(self.ground_force[:, 2].min()),
            "friction_max": float(self.friction.max()),
            "joint_excess_max": float(self.joint_excess.max()),
            "joint_limit_index_max": float(self.joint_limit_index.max()),
            "manipulability_min": float(self.manipulability.min()),
            "peak_joint_velocity": float(np.abs(self.joint_velocities).max()),
            "peak_joint_acceleration": float(np.abs(self.joint_accelerations).max()),
            "peak_joint_torque": float(np.abs(self.joint_torques).max()),
        }


def motion_function(machine: Standing, wrenches: Wrenches = (), rows: Rows = (3, 4, 5)) -> Any:
    """Return the CasADi Function from (time, q, qd, qdd) to the attributes that a `StandingMotion` computes, by name.

    Its symbols are SX, or MX if `wrenches` require it.
    """
    try:
        return _motion_function(machine, wrenches, rows, ca.SX)
    except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
        return _motion_function(machine, wrenches, rows, ca.MX)


def standing_motion(
    machine: Standing,
    t: ArrayInput,
    joints: ArrayInput,
    joint_velocities: ArrayInput,
    *,
    joint_accelerations: ArrayInput,
    wrenches: Wrenches = (),
    rows: Rows = (3, 4, 5),
) -> StandingMotion:
    """Compute joint torques, ground reaction and stability of a standing machine from samples of its motion.

    Args:
        t: Times. Shape (M,), s.
        joints, joint_velocities, joint_accelerations: Shape (M, n).
        wrenches: External wrenches.
        rows: Task of the reported manipulability.

    Raises:
        ModelError: No times, shapes that do not match, nan.
    """
    times = require.array("motion: t", t, ("times",))
    arrays = {"joints": joints, "joint_velocities": joint_velocities, "joint_accelerations": joint_accelerations}
    shape = (len(times), machine.joint_size)
    parts = [require.array(f"motion: {name}", part, shape, entries="numbers") for name, part in arrays.items()]
    function = motion_function(machine, wrenches, rows)
    return StandingMotion(times, *parts, **evaluate_motion(function, times, *parts[:2], qdd=parts[2]))


def evaluate_motion(function: Any, t: Array, q: Array, qd: Array, *, qdd: Array) -> dict[str, Array]:
    """Evaluate a Function of `motion_function` at M times; return its outputs by name: (M, k), or (M,) for scalars."""
    outputs = function.map(len(t))(t[None, :], q.T, qd.T, qdd.T)
    names = [function.name_out(i) for i in range(function.n_out())]
    values = {name: np.array(ca.DM(value)).T for name, value in zip(names, outputs, strict=True)}
    scalars = ("foot_margin", "joint_excess", "joint_limit_index", "manipulability")
    return {name: value[:, 0] if name in scalars else value for name, value in values.items()}


def _motion_function(machine: Standing, wrenches: Wrenches, rows: Rows, symbols: Any) -> Any:
    n, robot, placement = machine.joint_size, machine.robot, machine.world_from_base()
    time, q, qd, qdd = symbols.sym("time"), symbols.sym("q", n), symbols.sym("qd", n), symbols.sym("qdd", n)
    acting = wrenches_at(wrenches, machine, (), q, time=time)
    reaction = machine.ground_reaction(q, qd, qdd, acting)
    point = center_of_pressure(reaction)
    external_force: Any = sum((ca.densify(wrench.force) for wrench in acting), start=ca.DM.zeros(3))
    outputs = {
        "joint_torques": machine.joint_torques(q, qd, qdd, acting),
        "tip_in_world": machine.tip_pose((), q).position,
        "external_force": external_force,
        "center_of_mass": center_of_mass(simplify(robot), q, placement),
        "ground_force": reaction[3:6],
        "zero_moment_point": point,
        "index": machine.stability_index(point),
        "foot_margin": machine.support.margin(point),
        "joint_excess": joint_excess(robot, q),
        "joint_limit_index": joint_limit_index(robot, q),
        "manipulability": manipulability_of(rows(q)) if callable(rows) else machine.manipulability((), q, rows),
    }
    inputs = ["time", "q", "qd", "qdd"]
    values = [ca.densify(value) for value in outputs.values()]
    return ca.Function("motion", [time, q, qd, qdd], values, inputs, list(outputs), {"cse": True})
