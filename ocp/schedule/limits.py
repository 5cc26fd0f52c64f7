"""What a schedule must keep to, and the line speed that it leaves at each place of a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.errors import NOT_NUMBERS, ProblemError, checked_instance, floats
from ocp.schedule.profile import Array, LineMotion

__all__ = [
    "JointLimits",
    "JointPath",
    "JointRates",
    "LineLimits",
    "PathLike",
    "cause_names",
    "check_joints",
    "check_line",
    "curvature_along",
    "joint_demands",
    "line_demands",
    "rates_along",
]


class PathLike(Protocol):
    """What a schedule asks of a path: models.paths.SmoothPath has it."""

    @property
    def length(self) -> float: ...
    @property
    def bounds(self) -> Array: ...
    def by_piece(self, of_segments: ArrayLike) -> Array: ...
    def curvature(self, distance: ArrayLike) -> Array: ...
    def curvature_jumps(self) -> Array: ...
    def dense(self, per_cell: int = ..., per_segment: int = ...) -> Array: ...


class JointRates(Protocol):
    """Joint positions along a path and their first three derivatives by the distance. Shape (M, n) each."""

    @property
    def position(self) -> Array: ...
    @property
    def first(self) -> Array: ...
    @property
    def second(self) -> Array: ...
    @property
    def third(self) -> Array: ...


class JointPath(Protocol):
    """Joints as a function of the distance: models.machines.scara_path.ScaraPath is one."""

    @property
    def names(self) -> Sequence[str]: ...
    def at(self, distance: ArrayLike) -> JointRates: ...


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Greatest joint velocities (rad/s or m/s), accelerations and jerks, symmetric. Shape (n,) or one for all.

    Raises:
        ProblemError: A limit that is not positive; it may be infinite.
    """

    velocity: ArrayLike = np.inf
    acceleration: ArrayLike = np.inf
    jerk: ArrayLike = np.inf

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "jerk"):
            _check(f"joint {name}", getattr(self, name), False)


@dataclass(frozen=True, eq=False)
class LineLimits:
    """Limits of a schedule.

    Attributes:
        speed: Asked line speed, m/s: one, or one for each segment of the task.
        acceleration: Of the line speed, peak, m/s^2. See `peak_acceleration` for a mean one.
        jerk: Of the line speed, m/s^3.
        centripetal: Greatest speed^2 x curvature, m/s^2.
        joints: Of the joints, or None.

    Raises:
        ProblemError: A limit that is not positive, nan, or not finite where it must be.
    """

    speed: ArrayLike
    acceleration: float
    jerk: float
    centripetal: float = np.inf
    joints: JointLimits | None = None

    def __post_init__(self) -> None:
        for name, finite in (("speed", True), ("acceleration", True), ("jerk", True), ("centripetal", False)):
            _check(name, getattr(self, name), finite, 1 if name == "speed" else 0)
        if self.joints is not None:
            checked_instance("joint limits", self.joints, JointLimits)

    def of_joints(self, count: int) -> Array:
        """Velocity, acceleration and jerk limits of `count` joints. Shape (3, count)."""
        given = self.joints or JointLimits()
        rows = []
        for name in ("velocity", "acceleration", "jerk"):
            value = np.asarray(getattr(given, name), dtype=float)
            if value.ndim and value.shape != (count,):
                message = f"joint {name} limits have shape {value.shape}; the arm has {count} joints"
                raise ProblemError(message, name=f"joint {name}", value=value.shape, limit=(count,))
            rows.append(np.broadcast_to(value, (count,)))
        return np.array(rows)


def _check(name: str, value: ArrayLike, finite: bool, dimensions: int = 1) -> None:
    try:
        array = floats(value)
    except NOT_NUMBERS as error:
        raise ProblemError(f"{name} limit {value!r} is not numeric", name=name, value=value) from error
    if array.ndim > dimensions:
        message = f"{name} limit has shape {array.shape}; give one number{', or a row' if dimensions else ''}"
        raise ProblemError(message, name=name, value=array.shape)
    wrong = ~(array > 0) | (finite & ~np.isfinite(array))
    if array.size == 0 or wrong.any():
        bad = float(array[wrong].flat[0]) if array.size else np.nan
        message = f"{name} limit {bad:g} must be positive{' and finite' if finite else ''}"
        raise ProblemError(message, name=name, value=bad, limit=0.0)


def check_line(path: PathLike, limits: LineLimits, joints: JointPath | None) -> JointPath | None:
    """The joints that are limited, None where none are.

    Raises:
        ProblemError: No path, no limits, no joints along a path, or joint limits without joints.
    """
    what = ("length", "bounds", "by_piece", "curvature", "dense")
    missing = [name for name in what if isinstance(path, type) or not hasattr(path, name)]
    if missing:
        hint = "give a SmoothPath, as models.smooth makes it"
        raise ProblemError(f"the path {path!r} has no {missing[0]}; {hint}", name="path", value=path)
    checked_instance("limits", limits, LineLimits)
    if joints is not None:
        check_joints(joints)
    elif limits.joints is not None:
        message = "joint limits need the joints along the path: joints=scara_along(arm, path)"
        raise ProblemError(message, name="joints")
    return joints if limits.joints is not None else None


def check_joints(joints: JointPath) -> None:
    """Raise ProblemError where something has not the names and places of joints along a path."""
    if isinstance(joints, type) or not hasattr(joints, "names") or not callable(getattr(joints, "at", None)):
        message = f"joints must be a function of the distance, as models.scara_along makes it, not {joints!r}"
        raise ProblemError(message, name="joints", value=joints)


def rates_along(joints: JointPath, distance: Array) -> JointRates:
    """Joints at distances (M,), checked.

    Raises:
        ProblemError: Shapes that are not (M, n), a value that is not finite.
    """
    check_joints(joints)
    rates = joints.at(distance)
    shape = (len(distance), len(joints.names))
    for kind in ("position", "first", "second", "third"):
        try:
            value = floats(getattr(rates, kind))
        except (AttributeError, *NOT_NUMBERS) as error:
            message = f"joints along the path: {kind} is missing or not numeric: {error}"
            raise ProblemError(message, name=kind, value=getattr(rates, kind, None)) from error
        if value.shape != shape:
            message = f"joints along the path: {kind} has shape {value.shape}, expected {shape}"
            raise ProblemError(message, name=kind, value=value.shape, limit=shape)
        finite = np.isfinite(value)
        if not finite.all():
            at, joint = np.argwhere(~finite)[0]
            name, bad, place = joints.names[joint], float(value[at, joint]), float(distance[at])
            what = "position" if kind == "position" else f"{kind} derivative"
            message = f"the {what} of joint {name!r} is {bad:g}, not finite, at {place:g} m"
            message += ", the arm is singular there; keep the path away"
            raise ProblemError(message, name=name, value=bad, time=place)
    return rates


def curvature_along(path: PathLike, distance: Array) -> Array:
    """Curvature at distances, shape (M,), 1/m; ProblemError for another shape or what is not finite."""
    value = np.asarray(path.curvature(distance), dtype=float)
    if value.shape != np.shape(distance):
        message = f"the path's curvature has shape {value.shape}, expected {np.shape(distance)}"
        raise ProblemError(message, name="curvature", value=value.shape, limit=np.shape(distance))
    if not np.isfinite(value).all():
        at = int((~np.isfinite(value)).argmax())
        message = f"the path's curvature is {value[at]:g}, not finite, at {distance[at]:g} m: a cusp"
        raise ProblemError(message, name="curvature", value=float(value[at]), time=float(distance[at]))
    return value


def cause_names(joint_names: Sequence[str]) -> tuple[str, ...]:
    """What may bind: the rows of line_demands and joint_demands."""
    of_joints = [f"joint {name!r} {kind}" for kind in ("velocity", "acceleration", "jerk") for name in joint_names]
    return ("centripetal acceleration", *of_joints)


def line_demands(
    limits: LineLimits, curvature: Array | None, rates: JointRates | None
) -> tuple[Array, NDArray[np.float64]]:
    """Demand over limit at unit, steady line speed, and the power of the speed it grows with.

    Shape (C, M) and (C,), the rows being those of cause_names: v^p demand <= 1 is the limit of a steady line speed v.
    """
    count = 0 if rates is None else len(rates.first)
    rows = [np.zeros((1, count)) if curvature is None else curvature[None] / limits.centripetal]
    powers = [2.0]
    if rates is not None:
        number = rates.first.shape[1]
        bounds = limits.of_joints(number)
        for order, derivative in enumerate((rates.first, rates.second, rates.third)):
            rows.append(np.abs(derivative.T) / bounds[order][:, None])
            powers += [order + 1.0] * number
    return np.concatenate(rows), np.array(powers)


def joint_demands(limits: LineLimits, rates: JointRates, motion: LineMotion) -> tuple[Array, Array]:
    """Joint acceleration and jerk over their limits during a motion, and the part of it that a steady speed has.

    q'' v^2 + q' a, and q''' v^3 + 3 q'' v a + q' j. Shape (2 n, M) each.
    """
    v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
    _, most, jerks = limits.of_joints(rates.first.shape[1])
    steady = [rates.second * v**2 / most, rates.third * v**3 / jerks]
    whole = [steady[0] + rates.first * a / most, steady[1] + (3 * rates.second * v * a + rates.first * j) / jerks]
    return np.abs(np.concatenate([x.T for x in whole])), np.abs(np.concatenate([x.T for x in steady]))
