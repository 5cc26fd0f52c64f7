"""What a schedule must keep to, and the line speed that it leaves at each place of a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ocp.errors import NOT_NUMBERS, ProblemError, checked_instance, floats
from ocp.schedule.profile import Array

__all__ = [
    "JointLimits",
    "JointPath",
    "JointRates",
    "LineLimits",
    "PathLike",
    "ToolLimits",
    "TorqueRates",
    "check_joints",
    "check_line",
    "check_smooth",
    "curvature_along",
    "rates_along",
    "tool_along",
    "torques_along",
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


class TorqueRates(Protocol):
    """Joint torques along a path as a linear form of the line's motion: inertia a + drag v^2 + rest. Shape (M, n)."""

    @property
    def inertia(self) -> Array: ...
    @property
    def drag(self) -> Array: ...
    @property
    def rest(self) -> Array: ...


class JointPath(Protocol):
    """Joints as a function of the distance: models.scara_along and ocp.joint_path make one.

    Where torques are limited it has `torques(distance) -> TorqueRates` too.
    """

    @property
    def names(self) -> Sequence[str]: ...
    def at(self, distance: ArrayLike) -> JointRates: ...


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Greatest joint velocities (rad/s or m/s), accelerations, jerks and torques (Nm or N), symmetric.

    Each of shape (n,), or one for all.

    Raises:
        ProblemError: A limit that is not positive; it may be infinite.
    """

    velocity: ArrayLike = np.inf
    acceleration: ArrayLike = np.inf
    jerk: ArrayLike = np.inf
    torque: ArrayLike = np.inf

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "jerk", "torque"):
            _check(f"joint {name}", getattr(self, name), False)


@dataclass(frozen=True, eq=False)
class ToolLimits:
    """Greatest acceleration (m/s^2) and jerk (m/s^3) of the tool along each axis of the world, and its turn rate.

    Attributes:
        acceleration, jerk: Symmetric. Shape (3,), or one for all axes.
        turn_rate: Greatest angular speed, rad/s.

    Raises:
        ProblemError: A limit that is not positive; it may be infinite.
    """

    acceleration: ArrayLike = np.inf
    jerk: ArrayLike = np.inf
    turn_rate: float = np.inf

    def __post_init__(self) -> None:
        for name in ("acceleration", "jerk"):
            value = getattr(self, name)
            _check(f"tool {name}", value, False)
            if np.ndim(value) and np.shape(value) != (3,):
                message = f"tool {name} limit has shape {np.shape(value)}; give one number, or one for each axis"
                raise ProblemError(message, name=f"tool {name}", value=np.shape(value), limit=(3,))
        _check("tool turn_rate", self.turn_rate, False, 0)


@dataclass(frozen=True, eq=False)
class LineLimits:
    """Limits of a schedule.

    Attributes:
        speed: Asked line speed, m/s: one, or one for each segment of the task.
        acceleration: Of the line speed, peak, m/s^2. See `peak_acceleration` for a mean one.
        jerk: Of the line speed, m/s^3; infinite for none, and the acceleration may then jump.
        centripetal: Greatest speed^2 x curvature, m/s^2.
        joints: Of the joints, or None.
        tool: Of the tool, or None.

    Raises:
        ProblemError: A limit that is not positive, nan, or not finite where it must be.
    """

    speed: ArrayLike
    acceleration: float
    jerk: float
    centripetal: float = np.inf
    joints: JointLimits | None = None
    tool: ToolLimits | None = None

    def __post_init__(self) -> None:
        for name, finite in (("speed", True), ("acceleration", True), ("jerk", False), ("centripetal", False)):
            _check(name, getattr(self, name), finite, 1 if name == "speed" else 0)
        for name, kind in (("joints", JointLimits), ("tool", ToolLimits)):
            if getattr(self, name) is not None:
                checked_instance("joint limits" if name == "joints" else "tool limits", getattr(self, name), kind)

    def of_joints(self, count: int) -> Array:
        """Velocity, acceleration and jerk limits of `count` joints. Shape (3, count)."""
        return self._of_joints(count, ("velocity", "acceleration", "jerk"))

    def torques(self, count: int) -> Array:
        """Torque limits of `count` joints. Shape (count,)."""
        return np.asarray(self._of_joints(count, ("torque",))[0])

    def _of_joints(self, count: int, names: tuple[str, ...]) -> Array:
        given = self.joints or JointLimits()
        rows = []
        for name in names:
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
    numbers = np.finfo(float)
    low, high = (float(end) ** 0.2 for end in (numbers.tiny, numbers.max))  # products of five are numbers
    odd = array[np.isfinite(array) & ~((low < array) & (array < high))]
    if odd.size:
        message = f"{name} limit {odd[0]:g} is no size to compute with, {low:.0e} to {high:.0e}: is its unit right?"
        raise ProblemError(message, name=name, value=float(odd[0]), limit=(low, high))


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


def torques_along(joints: JointPath, distance: Array) -> TorqueRates:
    """Torques at distances (M,), checked.

    Raises:
        ProblemError: Joints that know no torques, shapes that are not (M, n), a value that is not finite.
    """
    if not callable(getattr(joints, "torques", None)):
        message = "torque limits need joints with torques: joints=joint_path(machine, plan)"
        raise ProblemError(message, name="joint torque", value=joints)
    found: TorqueRates = joints.torques(distance)  # type: ignore[attr-defined]
    shape = (len(distance), len(joints.names))
    for kind in ("inertia", "drag", "rest"):
        value = np.asarray(getattr(found, kind), dtype=float)
        if value.shape != shape or not np.isfinite(value).all():
            message = f"torques along the path: {kind} must be finite and of shape {shape}, it has {value.shape}"
            raise ProblemError(message, name=kind, value=value.shape, limit=shape)
    return found


def tool_along(path: PathLike, distance: Array) -> tuple[Array, Array, Array, Array]:
    """Tangent, curvature vector, its rate, and the turn rate at unit speed, at distances (M,). Shape (M, 3) each."""
    missing = [name for name in ("at", "turn") if not callable(getattr(path, name, None))]
    if missing:
        message = f"tool limits need a path with places and turns, as models.smooth makes it; it has no {missing[0]}"
        raise ProblemError(message, name="path", value=path)
    place, turn = path.at(distance), path.turn(distance)  # type: ignore[attr-defined]
    return place.tangent, place.curvature, place.curvature_rate, turn.rate


def check_smooth(path: PathLike, limits: LineLimits, joints: JointPath | None) -> None:
    """Refuse jerk limits of joints or tool on a path whose curvature jumps.

    Raises:
        ProblemError: Where it jumps most.
    """
    of_joints = joints is not None and np.isfinite(limits.of_joints(len(joints.names))[2]).any()
    of_tool = limits.tool is not None and np.isfinite(limits.tool.jerk).any()
    jumps = path.curvature_jumps() if of_joints or of_tool else np.zeros(0)
    if not jumps.size:
        return
    at = int(jumps.argmax())
    if jumps[at] > 1e-9 * (1 + float(path.curvature(path.bounds).max())):
        place, jump, whose = float(path.bounds[at + 1]), float(jumps[at]), "joint" if of_joints else "tool"
        message = (
            f"a {whose} jerk limit cannot be kept at {place:g} m, where the path's curvature jumps by "
            f"{jump:.3g} /m and the {whose} accelerations with it; round the corners with kind='quintic'"
        )
        raise ProblemError(message, name="curvature", value=jump, time=place)
