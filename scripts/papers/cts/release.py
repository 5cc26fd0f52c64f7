"""A free rigid body in space under gravity, ejectors and the air: what a captive trajectory follows.

The state is (position in world, quaternion [w, x, y, z], velocity in world, angular velocity in body axes), shape
(13,). World is a frame of constant velocity, such as that of the parent aircraft in steady flight, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models import Link, ModelError
from models.checks import Array, ArrayInput, require
from models.spatial import Expression, cross, expression, quaternion_product, rotation_from_quaternion
from ocp.curves import rk4_step

GRAVITY = 9.80665
STATES = 13

Air = Callable[[Expression, Expression, Expression, Expression], tuple[Expression, Expression]]
"""A function (position, world_from_body rotation, velocity, angular velocity in body) -> (moment, force) of the air in
body axes about the centre of mass, N m and N."""


@dataclass(frozen=True, eq=False)
class Ejector:
    """A piston that pushes the body for a while: force x sin^2 of time, gone after `duration`.

    Attributes:
        force: Peak along `direction`, N.
        duration: s, from time 0.
        point: Where it pushes, in body from the centre of mass. Shape (3,), m.
        direction: In world, made a unit vector. Shape (3,).
    """

    force: float
    duration: float
    point: ArrayInput
    direction: ArrayInput = (0.0, 0.0, -1.0)

    def __post_init__(self) -> None:
        for name in ("force", "duration"):
            value = require.array(f"ejector: {name}", getattr(self, name), ()).item()
            if value <= 0:
                raise ModelError(f"ejector: {name} {value} must be positive")
        point = require.array("ejector: point", self.point, (3,))
        direction = require.array("ejector: direction", self.direction, (3,))
        length = float(np.linalg.norm(direction))
        if length <= 0:
            raise ModelError("ejector: direction (0, 0, 0) points nowhere")
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "direction", direction / length)

    def force_at(self, time: Expression) -> Expression:
        """Force in world at a time. Shape (3, 1), N."""
        phase = time / self.duration
        pulse = self.force * ca.sin(np.pi * phase) ** 2
        return ca.if_else(ca.logic_and(phase > 0, phase < 1), pulse, 0.0) * ca.DM(self.direction)


def no_air(position: Expression, rotation: Expression, velocity: Expression, omega: Expression) -> Any:
    """A body in a vacuum."""
    return ca.DM.zeros(3), ca.DM.zeros(3)


@dataclass(frozen=True)
class SlenderAir:
    """Air on a slender store, quasi-steady and linear in the angle of attack; of the right kind, not of any store.

    Attributes:
        wind: Velocity of the air in world. Shape (3,), m/s.
        density: kg/m^3.
        area, length: Reference area, m^2, and length, m.
        drag, normal: Coefficient of drag, and slope of the normal force, 1/rad.
        margin: Distance of the centre of pressure behind the centre of mass, in lengths.
        damping: Pitch and yaw damping coefficient, positive.
    """

    wind: tuple[float, float, float]
    density: float = 1.0
    area: float = 0.06
    length: float = 2.2
    drag: float = 0.2
    normal: float = 4.0
    margin: float = 0.25
    damping: float = 30.0

    def __call__(self, position: Expression, rotation: Expression, velocity: Expression, omega: Expression) -> Any:
        """Moment, N m, and force, N, in body axes; see Air."""
        air = ca.mtimes(rotation.T, velocity - ca.DM(self.wind))  # velocity through the air, in body
        speed = ca.sqrt(ca.dot(air, air) + 1e-12)
        pressure = self.density * speed / 2 * self.area  # times a velocity gives a force
        force = -pressure * ca.vertcat(self.drag * air[0], self.normal * air[1], self.normal * air[2])
        lever = ca.DM([-self.margin * self.length, 0, 0])
        rates = ca.vertcat(0, omega[1], omega[2])
        return cross(lever, force) - pressure * self.length**2 * self.damping / 2 * rates, force


@dataclass(frozen=True, eq=False)
class Store:
    """A store as it is released.

    Attributes:
        body: Mass and inertia; its centre of mass must be at its origin.
        ejectors: Pistons of the rack.
        air: Force of the air as a function of pose and rates, see Air.
        gravity: m/s^2 along -z.

    Raises:
        ModelError: No mass, an inertia that is not positive definite, a centre of mass off the origin.
    """

    body: Link
    ejectors: Sequence[Ejector] = ()
    air: Air = no_air
    gravity: float = field(default=GRAVITY)

    def __post_init__(self) -> None:
        if self.body.mass <= 0 or float(np.linalg.eigvalsh(self.body.inertia).min()) <= 0:
            raise ModelError(f"store {self.body.name!r}: a free body needs mass and inertia")
        if np.abs(self.body.center_of_mass).max() > 0:
            raise ModelError(f"store {self.body.name!r}: centre of mass {self.body.center_of_mass.tolist()} must be 0")

    def rate(self, state: Expression, time: Expression) -> Expression:
        """Newton and Euler: d state / dt. Shape (13, 1)."""
        state = expression(state)
        position, quaternion, velocity, omega = state[0:3], state[3:7], state[7:10], state[10:13]
        turn = rotation_from_quaternion(quaternion)
        moment, force = self.air(position, turn, velocity, omega)
        pushed = ca.mtimes(turn, force) - ca.DM([0, 0, self.body.mass * self.gravity])
        for ejector in self.ejectors:
            push = ejector.force_at(time)
            pushed += push
            moment += cross(ejector.point, ca.mtimes(turn.T, push))
        inertia = ca.DM(self.body.inertia)
        gyroscopic = cross(omega, ca.mtimes(inertia, omega))
        turning = ca.mtimes(ca.DM(np.linalg.inv(self.body.inertia)), moment - gyroscopic)
        spin = quaternion_product(quaternion, ca.vertcat(0, omega)) / 2
        return ca.vertcat(velocity, spin, pushed / self.body.mass, turning)


def release(store: Store, start: ArrayInput, times: ArrayInput, steps: int = 4) -> Array:
    """Free motion by Runge-Kutta of order 4. Shape (samples, 13).

    Args:
        store: The store.
        start: State at times[0], shape (13,).
        times: Increasing, shape (samples,), s.
        steps: Runge-Kutta steps between two times.

    Raises:
        ModelError: Wrong shapes, a zero quaternion, times that do not increase, no step.
    """
    state = require.array("release: start", start, (STATES,))
    t = np.asarray(times, dtype=float)
    if t.ndim != 1 or t.size < 2 or not (np.diff(t) > 0).all():
        raise ModelError("release: times must be at least two and increase")
    if steps < 1:
        raise ModelError(f"release: steps {steps} must be at least 1")
    if np.linalg.norm(state[3:7]) < 1e-9:
        raise ModelError("release: the quaternion of the start is zero")
    x, time, h = ca.SX.sym("x", STATES), ca.SX.sym("time"), ca.SX.sym("h")
    rate = ca.Function("rate", [x, time], [ca.cse(store.rate(x, time))])
    step = ca.Function("step", [x, time, h], [rk4_step(lambda place, at: rate(at, time + place * h), x, h)])
    states = [np.array(state)]
    for begin, end in pairwise(t):
        now, size = states[-1], (end - begin) / steps
        for k in range(steps):
            now = np.array(step(now, begin + k * size, size)).ravel()
        now[3:7] /= np.linalg.norm(now[3:7])
        states.append(now)
    return np.array(states)


def yaw_pitch(quaternions: ArrayInput) -> Array:
    """Yaw and pitch of the body's x axis, as the rig measures them: nose down is positive pitch. Shape (samples, 2)."""
    w, x, y, z = np.atleast_2d(np.asarray(quaternions, dtype=float)).T
    axis = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    return np.column_stack([np.arctan2(axis[1], axis[0]), -np.arcsin(np.clip(axis[2], -1, 1))])
