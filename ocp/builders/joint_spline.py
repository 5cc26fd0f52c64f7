"""Joints along a path from any plan, for ocp.schedule: a spline through its samples, and the torques of the machine.

The spline has degree 5, so that the third derivative by the distance, which joint jerks need, is continuous. Torques
are linear in the line's acceleration and squared speed: with joints q(s), inverse dynamics tau(q, rate, acceleration)
and rest tau(q, 0, 0),

    tau = (tau(q, 0, q') - rest) a + (tau(q, q', q'') - rest) v^2 + rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import FixedBase, Machine
from models.robot.dynamics import inverse_dynamics
from ocp.errors import NOT_NUMBERS, ProblemError, checked_count, checked_each, checked_instance, floats
from ocp.schedule import PathLike
from ocp.schedule.profile import Array
from ocp.solution import Solution

__all__ = ["PlannedJoints", "joint_path"]

DEGREE = 5
DERIVATIVES = 3


class _Along(NamedTuple):
    """Joints and three derivatives by the distance. Shape (M, n) each."""

    position: Array
    first: Array
    second: Array
    third: Array


class _Torques(NamedTuple):
    """inertia a + drag v^2 + rest. Shape (M, n) each, Nm or N."""

    inertia: Array
    drag: Array
    rest: Array


@dataclass(frozen=True, eq=False)
class PlannedJoints:
    """Joints of a machine as functions of the distance along a path. Made by `joint_path`.

    Attributes:
        machine: Whose joints.
        names: Of the joints.
        length: Of the path, m.
        error: Largest difference (rad or m) at the samples between them and a spline through every second one: more
            than the spline between them errs.
    """

    machine: Machine
    names: tuple[str, ...]
    length: float
    error: float
    curves: Any
    forces: Any

    def at(self, distance: Any) -> _Along:
        """Joints and their derivatives at distances from the start. Shape (M,), m.

        Raises:
            ProblemError: nan, or a distance off the path by more than rounding.
        """
        s = self._checked(distance)
        return _Along(*(np.array(value).T for value in self.curves.map(len(s))(s[None])))

    def torques(self, distance: Any) -> _Torques:
        """Torques at distances from the start, as a linear form of the line's motion. Shape (M,), m.

        Raises:
            ProblemError: A machine whose base moves; distances as in `at`.
        """
        if self.forces is None:
            message = f"torques along a path need a machine on a fixed base, not a {type(self.machine).__name__}"
            raise ProblemError(message, name="machine", value=self.machine)
        along = self.at(distance)
        inputs = [value.T for value in along[:DERIVATIVES]]
        return _Torques(*(np.array(value).T for value in self.forces.map(len(along.position))(*inputs)))

    def _checked(self, distance: Any) -> Array:
        try:
            s = np.atleast_1d(floats(distance))
        except NOT_NUMBERS as error:
            raise ProblemError(f"distance {distance!r} is not numeric", name="distance", value=distance) from error
        slack = 1e-9 * self.length
        wrong = s[~((s >= -slack) & (s <= self.length + slack))]
        if s.ndim != 1 or wrong.size:
            message = f"distance {s.ravel()[:3].tolist()} m is no row on the path, which is {self.length:g} m long"
            raise ProblemError(message, name="distance", value=distance, limit=self.length)
        return np.asarray(np.clip(s, 0.0, self.length))


def joint_path(
    machine: Machine,
    plan: Solution | tuple[Any, Any],
    path: PathLike,
    *,
    samples: int = 400,
    names: Sequence[str] | None = None,
) -> PlannedJoints:
    """Joints along a path from a plan that runs it at constant speed, or from samples over the distance.

    Args:
        machine: Whose joints they are.
        plan: A solution with states "joints", the path's distance in proportion to its time, as of a tip that keeps
            one speed; or (distances (M,), joints (M, n)), the first distance 0 and the last the path's length.
        path: What the tool runs along.
        samples: Of a solution, evenly in time.
        names: Of the joints; the robot's if None.

    Raises:
        ProblemError: A plan without joints, samples of other shapes, too few, not increasing or not from end to end.
    """
    checked_count("samples", samples, 2 * DEGREE + 3)
    for part in ("robot", "joint_size"):
        if isinstance(machine, type) or not hasattr(machine, part):
            raise ProblemError(f"{machine!r} is no machine; it has no {part}", name="machine", value=machine)
    length = getattr(path, "length", None)
    if not isinstance(length, float | int) or not length > 0:
        raise ProblemError(f"the path {path!r} has no length", name="path", value=path)
    s, joints = _samples(plan, float(length), samples, machine.joint_size)
    own = checked_each("joints along a path: names", machine.robot.joint_names if names is None else names, str)
    if len(own) != machine.joint_size:
        message = f"{len(own)} names for {machine.joint_size} joints"
        raise ProblemError(message, name="names", value=own, limit=machine.joint_size)
    curves = _spline(s, joints)
    half = np.arange(0, len(s), 2)
    half = half if half[-1] == len(s) - 1 else np.append(half, len(s) - 1)
    coarse = np.array(_spline(s[half], joints[half]).map(len(s))(s[None])[0]).T
    error = float(np.abs(coarse - joints).max())
    return PlannedJoints(machine, own, float(length), error, curves, _forces(machine))


def _samples(plan: Any, length: float, samples: int, size: int) -> tuple[Array, Array]:
    """Distances (M,) and joints (M, n) of a plan, checked."""
    if isinstance(plan, tuple):
        try:
            s, joints = (floats(part) for part in plan)
        except NOT_NUMBERS as error:
            raise ProblemError(f"samples are not numeric: {error}", name="plan", value=plan) from error
    else:
        checked_instance("plan", plan, Solution)
        fractions = np.linspace(0.0, 1.0, samples)
        try:
            joints = np.asarray(plan.at_fraction(fractions)["joints"], dtype=float)
        except KeyError as error:
            message = f"the plan {plan.name!r} has no states 'joints'"
            raise ProblemError(message, name="joints", value=plan.name) from error
        s = length * fractions
    if s.ndim != 1 or joints.shape != (len(s), size) or len(s) < 2 * DEGREE + 3:
        message = f"samples have shapes {s.shape} and {joints.shape}; expected (M,) and (M, {size}), M at least 13"
        raise ProblemError(message, name="plan", value=joints.shape, limit=size)
    if not (np.isfinite(s).all() and np.isfinite(joints).all()) or (np.diff(s) <= 0).any():
        raise ProblemError("samples must be finite, at increasing distances", name="plan", value=s)
    if abs(s[0]) > 1e-9 * length or abs(s[-1] - length) > 1e-9 * length:
        message = f"samples go from {s[0]:g} to {s[-1]:g} m, the path from 0 to {length:g} m"
        raise ProblemError(message, name="plan", value=(float(s[0]), float(s[-1])), limit=length)
    s = s.copy()
    s[0], s[-1] = 0.0, length
    return s, joints


def _spline(s: Array, joints: Array) -> Any:
    """casadi Function distance -> joints and three derivatives, (n, 1) each: the spline through samples."""
    # in units of the length, which keeps the derivatives of the fit in range
    unit = float(s[-1])
    fit = ca.interpolant("fit", "bspline", [(s / unit).tolist()], joints.ravel().tolist(), {"degree": [DEGREE]})
    place = ca.MX.sym("distance")
    values = [fit(place / unit)]
    for _ in range(DERIVATIVES):
        values.append(ca.jacobian(values[-1], place))
    return ca.Function("joints", [place], values)


def _forces(machine: Machine) -> Any:
    """casadi Function (q, q', q'') -> inertia, drag and rest; None where the base is not fixed."""
    if not isinstance(machine, FixedBase):
        return None
    q, first, second = (ca.SX.sym(name, machine.joint_size) for name in ("q", "first", "second"))
    still = ca.SX.zeros(machine.joint_size)

    def torque(rate: Any, acceleration: Any) -> Any:
        return inverse_dynamics(
            machine.robot, q, rate, acceleration, world_from_base=machine.world_from_base(ca.DM(0, 1))
        )

    rest = torque(still, still)
    return ca.Function("torques", [q, first, second], [torque(still, first) - rest, torque(first, second) - rest, rest])
