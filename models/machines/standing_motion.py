"""What a motion of a standing machine asks of the ground and of its joints, at sampled times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import ROUNDING, Array, ArrayInput, checked_array
from models.machines.standing import External, Standing, center_of_pressure, wrenches_at
from models.robot.indices import joint_excess, joint_limit_index, manipulability_of
from models.robot.kinematics import center_of_mass
from models.spatial import Expression

Rows: TypeAlias = Sequence[int] | Callable[[Expression], Expression]
"""Whose manipulability is reported: rows of the tip's twist, or any Jacobian as a function of q, (m, n)."""


@dataclass(frozen=True)
class StandingMotion:
    """A motion of a standing machine at M times, and what it takes.

    Attributes:
        t: Times. Shape (M,), s.
        joints, joint_velocities, joint_accelerations: Shape (M, n).
        joint_torques: By inverse dynamics. Shape (M, n), N m or N.
        tip_in_world: Shape (M, 3), m.
        external_force: Sum of the forces from outside, wherever they act, world axes. Shape (M, 3), N.
        center_of_mass: Shape (M, 3), m.
        ground_force: What the ground does to the foot. Shape (M, 3), N.
        zero_moment_point: (x, y). Shape (M, 2), m.
        index: Stability index in x and y, (5)-(6). Shape (M, 2).
        foot_margin: Signed distance of the zero moment point from the edge of the support. Shape (M,), m.
        joint_excess: Of the worst joint beyond its limits, negative inside. Shape (M,), rad or m.
        joint_limit_index: p1 (23). Shape (M,).
        manipulability: p2 (27) of the task's rows. Shape (M,).
    """

    t: Array
    joints: Array
    joint_velocities: Array
    joint_accelerations: Array
    joint_torques: Array
    tip_in_world: Array
    external_force: Array
    center_of_mass: Array
    ground_force: Array
    zero_moment_point: Array
    index: Array
    foot_margin: Array
    joint_excess: Array
    joint_limit_index: Array
    manipulability: Array

    @property
    def friction(self) -> Array:
        """Horizontal over vertical ground force: the coefficient of friction it takes. Shape (M,)."""
        vertical = self.ground_force[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.linalg.norm(self.ground_force[:, :2], axis=1) / vertical
        return np.asarray(np.where(vertical > 0, needed, np.inf))

    @property
    def stays_on_ground(self) -> bool:
        """Whether the ground only ever pushes."""
        return bool((self.ground_force[:, 2] > 0).all())

    @property
    def stays_in_foot(self) -> bool:
        """Whether the zero moment point never leaves the support."""
        return bool((self.foot_margin >= -ROUNDING).all())

    @property
    def stays_in_limits(self) -> bool:
        """Whether every joint stays within its position limits."""
        return bool((self.joint_excess <= ROUNDING).all())

    @property
    def stands(self) -> bool:
        """Whether the machine neither lifts off nor tips: an index of 1 alone does not say so."""
        return self.stays_on_ground and self.stays_in_foot

    def summary(self) -> dict[str, float | bool]:
        """The extremes, by name."""
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

    def __str__(self) -> str:
        lines = [f"Motion of {self.t[-1]:g} s: {'stands' if self.stands else 'DOES NOT STAND'}"]
        for what, values, wrong in (
            ("vertical ground force, N", self.ground_force[:, 2], ~(self.ground_force[:, 2] > 0)),
            ("zero moment point inside the foot by, m", self.foot_margin, ~(self.foot_margin >= -ROUNDING)),
            ("stability index", self.index.min(axis=1), np.zeros(len(self.t), dtype=bool)),
            ("room to the joint limits", -self.joint_excess, ~(self.joint_excess <= ROUNDING)),
        ):
            k = int(np.argmin(values))
            verdict = f", wrong from {self.t[wrong][0]:.4g} s on" if wrong.any() else ""
            lines.append(f"  {what:<42} least {values[k]:>10.4g} at {self.t[k]:.4g} s{verdict}")
        for what, values in (
            ("joint velocity", self.joint_velocities),
            ("joint acceleration", self.joint_accelerations),
            ("joint torque", self.joint_torques),
        ):
            k = int(np.abs(values).max(axis=1).argmax())
            lines.append(f"  {what:<42} peak  {np.abs(values[k]).max():>10.4g} at {self.t[k]:.4g} s")
        return "\n".join(lines)


def motion_function(machine: Standing, external: External | None = None, rows: Rows = (3, 4, 5)) -> Any:
    """What a motion takes at one instant: (time, q, q', q'') -> the attributes of a StandingMotion after those.

    A casadi Function of the names time, q, qd, qdd; of MX symbols where `external` needs them.
    """
    try:
        return _motion_function(machine, external, rows, ca.SX)
    except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
        return _motion_function(machine, external, rows, ca.MX)


def standing_motion(
    machine: Standing,
    t: ArrayInput,
    joints: ArrayInput,
    joint_velocities: ArrayInput,
    joint_accelerations: ArrayInput,
    external: External | None = None,
    rows: Rows = (3, 4, 5),
) -> StandingMotion:
    """Evaluate a motion.

    Args:
        machine: What moves.
        t: Times. Shape (M,), s.
        joints, joint_velocities, joint_accelerations: Shape (M, n).
        external: Wrenches as a function of time and tip position.
        rows: Whose manipulability is reported.

    Raises:
        ModelError: No times, shapes that do not match, nan.
    """
    times = checked_array(t, ("times",), "motion", "t")
    given = {"joints": joints, "joint_velocities": joint_velocities, "joint_accelerations": joint_accelerations}
    shape = (len(times), machine.joint_size)
    parts = [checked_array(part, shape, "motion", name, finite=False) for name, part in given.items()]
    found = evaluate(motion_function(machine, external, rows), times, *parts)
    return StandingMotion(times, *parts, **found)


def evaluate(function: Any, t: Array, q: Array, qd: Array, qdd: Array) -> dict[str, Array]:
    """Outputs of a motion function at M times, by name: (M, k), or (M,) for what is a number at each time."""
    outputs = function.map(len(t))(t[None, :], q.T, qd.T, qdd.T)
    names = [function.name_out(i) for i in range(function.n_out())]
    values = {name: np.array(ca.DM(value)).T for name, value in zip(names, outputs, strict=True)}
    numbers = ("foot_margin", "joint_excess", "joint_limit_index", "manipulability")
    return {name: value[:, 0] if name in numbers else value for name, value in values.items()}


def _motion_function(machine: Standing, external: External | None, rows: Rows, symbols: Any) -> Any:
    n, robot, placement = machine.joint_size, machine.robot, machine.world_from_base()
    time, q, qd, qdd = symbols.sym("time"), symbols.sym("q", n), symbols.sym("qd", n), symbols.sym("qdd", n)
    tip = machine.tip_pose((), q).position
    wrenches = wrenches_at(external, time, tip)
    reaction = machine.ground_reaction(q, qd, qdd, wrenches)
    point = center_of_pressure(reaction)
    outside: Any = sum((ca.densify(wrench.force) for wrench in wrenches), start=ca.DM.zeros(3))
    outputs = {
        "joint_torques": machine.joint_torques(q, qd, qdd, wrenches),
        "tip_in_world": tip,
        "external_force": outside,
        "center_of_mass": center_of_mass(machine.bodies(), q, placement),
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
