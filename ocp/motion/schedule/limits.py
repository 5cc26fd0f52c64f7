"""Limits of a motion along a path, as inequalities in its speed v, acceleration a and jerk j at points of the path.

    speed          k v <= 1
    acceleration   -1 <= p a + q v^2 + r <= 1
    jerk           |p j + q v a + r v^3| <= 1

A row is one such inequality; "line" in a name means the motion along the path. Joint velocities, accelerations and
jerks give (q'), (q', q'') and (q', 3 q'', q'''), derivatives with respect to distance, over their limits. Centripetal
acceleration and the turn rate of the tool limit the speed. Torques m(s) a + b(s) v^2 + c(s) give (m, b, c) over their
limits. Acceleration and jerk of the tool (`ToolLimits`) give those of its coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.checks import NOT_NUMBERS, Array, floats
from ocp.errors import ProblemError, require
from ocp.motion.tasks.speed_profile import LineMotion
from ocp.tolerances import ROUNDING_SHARE

BLOCK_SIZE = 20_000
"""Largest number of points of a path whose limits are evaluated at once, to bound the memory for a long path."""

NO_COEFFICIENT = float(np.sqrt(np.finfo(float).tiny))
"""Size below which a coefficient counts as zero, so that its inverse square is a number."""


class PathLike(Protocol):
    """Interface of a path for which a motion can be timed; models.paths.SmoothPath provides this interface."""

    @property
    def length(self) -> float: ...
    @property
    def bounds(self) -> Array: ...
    def by_piece(self, of_segments: ArrayLike) -> Array: ...
    def curvature(self, distance: ArrayLike) -> Array: ...
    def curvature_jumps(self) -> Array: ...
    def sample_distances(self, per_cell: int = ..., per_segment: int = ...) -> Array: ...


class JointRates(Protocol):
    """Joint positions along a path and their first three derivatives with respect to distance. Shape (M, n) each."""

    @property
    def position(self) -> Array: ...
    @property
    def first(self) -> Array: ...
    @property
    def second(self) -> Array: ...
    @property
    def third(self) -> Array: ...


class TorqueRates(Protocol):
    """Coefficients of joint torques as functions of path speed v and acceleration a: inertia a + drag v^2 + rest.

    Shape (M, n) each.
    """

    @property
    def inertia(self) -> Array: ...
    @property
    def drag(self) -> Array: ...
    @property
    def rest(self) -> Array: ...


class JointPath(Protocol):
    """Interface of joint positions as functions of the distance along a path.

    models.scara_along and ocp.joint_path provide it. With torque limits it also has `torques(distance) -> TorqueRates`.
    """

    @property
    def names(self) -> Sequence[str]: ...
    def at(self, distance: ArrayLike) -> JointRates: ...


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Symmetric limits of joint velocities (rad/s or m/s), accelerations, jerks and torques (Nm or N).

    Each is one number, or has shape (n,). Velocity, acceleration and jerk may be 0 for joints that do not move.

    Raises:
        ProblemError: A limit is negative, or a torque is 0; it may be infinite.
    """

    velocity: ArrayLike = np.inf
    acceleration: ArrayLike = np.inf
    jerk: ArrayLike = np.inf
    torque: ArrayLike = np.inf

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "jerk", "torque"):
            _check(f"joint {name}", getattr(self, name), False, zero=name != "torque")


@dataclass(frozen=True, eq=False)
class ToolLimits:
    """Limits of the tool: angular speed, and acceleration, jerk and velocity along each world axis, in SI units.

    Attributes:
        acceleration, jerk, velocity: Symmetric limits. Shape (3,), or one number for all axes.
        turn_rate: Largest angular speed, rad/s.

    Raises:
        ProblemError: A limit is not positive; it may be infinite.
    """

    acceleration: ArrayLike = np.inf
    jerk: ArrayLike = np.inf
    turn_rate: float = np.inf
    velocity: ArrayLike = np.inf

    def __post_init__(self) -> None:
        for name in ("acceleration", "jerk", "velocity"):
            value = getattr(self, name)
            _check(f"tool {name}", value, False)
            if np.ndim(value) and np.shape(value) != (3,):
                message = f"tool {name} limit has shape {np.shape(value)}; give one number, or one for each axis"
                raise ProblemError(message, name=f"tool {name}", value=np.shape(value), limit=(3,))
        _check("tool turn_rate", self.turn_rate, False, 0)


@dataclass(frozen=True, eq=False)
class LineLimits:
    """Limits of a motion along a path, including limits of tool and joints, and the requested speed.

    Attributes:
        speed: Requested speed along the path, m/s: one number, or one for each segment of the task.
        acceleration: Peak acceleration along the path, m/s^2. See `peak_acceleration` for a mean one.
        jerk: Largest jerk along the path, m/s^3; infinite for none, the acceleration may then jump.
        centripetal: Largest speed^2 x curvature, m/s^2.
        joints: Joint limits, or None.
        tool: Tool limits, or None.

    Raises:
        ProblemError: A limit is not positive, or not finite where it must be.
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
                require.instance("joint limits" if name == "joints" else "tool limits", getattr(self, name), kind)

    def of_joints(self, count: int) -> Array:
        """Return velocity, acceleration and jerk limits of `count` joints; 0 is replaced by infinity. Shape (3, count).

        A joint with a limit of 0 does not move, so that its limits have no effect; see `check_line`.
        """
        values = self._of_joints(count, ("velocity", "acceleration", "jerk"))
        values[values == 0] = np.inf
        return values

    def torques(self, count: int) -> Array:
        """Return the torque limits of `count` joints. Shape (count,)."""
        return np.asarray(self._of_joints(count, ("torque",))[0])

    def _of_joints(self, count: int, names: tuple[str, ...]) -> Array:
        """Return the joint limits named by `names`, such as "jerk", for `count` joints. Shape (len(names), count)."""
        joints, rows = self.joints or JointLimits(), np.empty((len(names), count))
        for row, name in zip(rows, names, strict=True):
            value = np.asarray(getattr(joints, name), dtype=float)
            if value.ndim and value.shape != (count,):
                message = f"joint {name} limits have shape {value.shape}; the arm has {count} joints"
                raise ProblemError(message, name=f"joint {name}", value=value.shape, limit=(count,))
            row[:] = value
        return rows


def _check(name: str, value: ArrayLike, finite: bool, dimensions: int = 1, *, zero: bool = False) -> None:
    """Raise ProblemError unless a limit is positive, or 0 if `zero`, and finite if `finite`.

    It may have at most `dimensions` array dimensions.
    """
    try:
        array = floats(value)
    except NOT_NUMBERS as error:
        raise ProblemError(f"{name} limit {value!r} is not numeric", name=name, value=value) from error
    if array.ndim > dimensions:
        message = f"{name} limit has shape {array.shape}; give one number{', or a row' if dimensions else ''}"
        raise ProblemError(message, name=name, value=array.shape)
    invalid = ~((array > 0) | (zero & (array == 0))) | (finite & ~np.isfinite(array))
    if array.size == 0 or invalid.any():
        value_at_fault = float(array[invalid].flat[0]) if array.size else np.nan
        message = f"{name} limit {value_at_fault:g} must be positive{' and finite' if finite else ''}"
        raise ProblemError(message, name=name, value=value_at_fault, limit=0.0)
    numbers = np.finfo(float)
    low, high = (float(end) ** 0.2 for end in (numbers.tiny, numbers.max))  # products of five do not overflow
    extreme = array[np.isfinite(array) & (array != 0) & ~((low < array) & (array < high))]
    if extreme.size:
        message = f"{name} limit {extreme[0]:g} is outside the range of sizes {low:.0e} to {high:.0e}: check its unit"
        raise ProblemError(message, name=name, value=float(extreme[0]), limit=(low, high))


def check_line(path: PathLike, limits: LineLimits, joints: JointPath | None) -> JointPath | None:
    """Check the arguments of `schedule`; return the argument `joints`, or None if no joint limits are given.

    Raises:
        ProblemError: Path, limits or joints have the wrong type, or there are joint limits without joints.
    """
    required = ("length", "bounds", "by_piece", "curvature", "sample_distances")
    missing = [name for name in required if isinstance(path, type) or not hasattr(path, name)]
    if missing:
        hint = "give a SmoothPath, as models.smooth makes it"
        raise ProblemError(f"the path {path!r} has no {missing[0]}; {hint}", name="path", value=path)
    require.instance("limits", limits, LineLimits)
    if joints is not None:
        check_joints(joints)
        _check_still(path, limits, joints)
    elif limits.joints is not None:
        message = "joint limits need the joints along the path: joints=scara_along(arm, path)"
        raise ProblemError(message, name="joints")
    return joints if limits.joints is not None else None


def _check_still(path: PathLike, limits: LineLimits, joints: JointPath) -> None:
    """Raise ProblemError if a joint must move along the path although its velocity, acceleration or jerk limit is 0."""
    own, count = limits.joints or JointLimits(), len(joints.names)
    for name in ("velocity", "acceleration", "jerk"):
        is_zero = np.asarray(getattr(own, name), dtype=float).ravel() == 0
        if not is_zero.any() or is_zero.size not in (1, count):  # other sizes are refused with the limits
            continue
        zero = np.broadcast_to(is_zero, (count,))
        places = path.sample_distances()
        slopes = np.abs(np.asarray(rates_along(joints, places).first, dtype=float))
        moves = zero & (slopes.max(axis=0) > ROUNDING_SHARE * slopes.max())
        if moves.any():
            column = int(moves.argmax())
            joint, fastest = joints.names[column], int(slopes[:, column].argmax())
            where = f"moves along the path, at {places[fastest]:.4g} m"
            words = f"joint {joint!r} {where}, but the limit of its {name} is 0"
            raise ProblemError(words, name=joint, value=float(slopes[fastest, column]), limit=0.0)


def check_joints(joints: JointPath) -> None:
    """Raise ProblemError unless an object provides the names and positions of joints along a path."""
    if isinstance(joints, type) or not hasattr(joints, "names") or not callable(getattr(joints, "at", None)):
        message = f"joints must be a function of the distance, as models.scara_along makes it, not {joints!r}"
        raise ProblemError(message, name="joints", value=joints)


def rates_along(joints: JointPath, distance: Array) -> JointRates:
    """Check and return joint positions and their derivatives with respect to distance, at points (M,) of a path.

    Raises:
        ProblemError: A shape is not (M, n), or a value is not finite.
    """
    check_joints(joints)
    rates = joints.at(distance)
    shape = (len(distance), len(joints.names))
    for kind in ("position", "first", "second", "third"):
        value = require.array(f"joints along the path: {kind}", getattr(rates, kind, None), shape, entries="any")
        finite = np.isfinite(value)
        if not finite.all():
            at, joint = np.argwhere(~finite)[0]
            name, number, place = joints.names[joint], float(value[at, joint]), float(distance[at])
            quantity = "position" if kind == "position" else f"{kind} derivative"
            message = f"the {quantity} of joint {name!r} is {number:g}, not finite, at {place:g} m"
            message += ", the arm is singular there; keep the path away"
            raise ProblemError(message, name=name, value=number, time=place)
    return rates


def curvature_along(path: PathLike, distance: Array) -> Array:
    """Return a path's curvature at distances (M,), 1/m; raise ProblemError for a wrong shape or non-finite values."""
    value = require.array("path: curvature", path.curvature(distance), np.shape(distance), entries="any")
    if not np.isfinite(value).all():
        at = int((~np.isfinite(value)).argmax())
        message = f"the path's curvature is {value[at]:g}, not finite, at {distance[at]:g} m: a cusp"
        raise ProblemError(message, name="curvature", value=float(value[at]), time=float(distance[at]))
    return value


def torques_along(joints: JointPath, distance: Array) -> TorqueRates:
    """Return the coefficients of the joint torques at distances (M,) along a path; check their shapes and values.

    Raises:
        ProblemError: The joints have no torques, a shape is not (M, n), or a value is not finite.
    """
    if not callable(getattr(joints, "torques", None)):
        message = "torque limits need joints with torques: joints=joint_path(machine, plan)"
        raise ProblemError(message, name="joint torque", value=joints)
    torques: TorqueRates = joints.torques(distance)  # type: ignore[attr-defined]
    shape = len(distance), len(joints.names)
    for kind in ("inertia", "drag", "rest"):
        require.array(f"torques along the path: {kind}", getattr(torques, kind, None), shape)
    return torques


def tool_along(path: PathLike, distance: Array) -> tuple[Array, Array, Array, Array]:
    """Return tangent, curvature vector and derivative of curvature along a path, and the tool's rotation per metre.

    Shape (M, 3) each.
    """
    missing = [name for name in ("at", "turn") if not callable(getattr(path, name, None))]
    if missing:
        message = f"tool limits need a path with places and turns, as models.smooth makes it; it has no {missing[0]}"
        raise ProblemError(message, name="path", value=path)
    place, turn = path.at(distance), path.turn(distance)  # type: ignore[attr-defined]
    return place.tangent, place.curvature, place.curvature_rate, turn.rate


def check_smooth(path: PathLike, limits: LineLimits, joints: JointPath | None) -> None:
    """Raise ProblemError if joint or tool jerks are limited, but jumps of the path's curvature make them infinite."""
    joints_limited = joints is not None and np.isfinite(limits.of_joints(len(joints.names))[2]).any()
    tool_limited = limits.tool is not None and np.isfinite(limits.tool.jerk).any()
    jumps = path.curvature_jumps() if joints_limited or tool_limited else np.zeros(0)
    if not jumps.size:
        return
    at = int(jumps.argmax())
    if jumps[at] > 1e-9 * (1 + float(path.curvature(path.sample_distances()).max())):  # else rounding
        place, jump, owner = float(path.bounds[at + 1]), float(jumps[at]), "joint" if joints_limited else "tool"
        message = f"a {owner} jerk limit cannot be kept at {place:g} m, where the path's curvature jumps by {jump:.3g} "
        message += f"/m and the {owner} accelerations with it; round the corners with kind='quintic'"
        raise ProblemError(message, name="curvature", value=jump, time=place)


class Rows(NamedTuple):
    """Coefficients of the inequalities that limit speed, acceleration and jerk, at S points of a path.

    Attributes:
        speed: k of each row. Shape (S, K), s/m.
        acceleration: p, q and r of each row. Shape (S, L, 3).
        jerk: p, q and r of each row. Shape (S, P, 3).
    """

    speed: Array
    acceleration: Array
    jerk: Array

    def take(self, places: NDArray[Any] | slice) -> Rows:
        """Return the coefficients of all limit inequalities at a subset of the points of the path."""
        return Rows(self.speed[places], self.acceleration[places], self.jerk[places])

    def steady(self) -> Array:
        """Return the greatest permitted constant speed at each point, m/s. Shape (S,)."""
        q, r = self.acceleration[:, :, 1], self.acceleration[:, :, 2]
        with np.errstate(divide="ignore"):
            square = (np.maximum(1 - np.sign(q) * r, 0.0) / np.abs(q)).min(axis=1)
            by_jerk = np.cbrt(1 / np.abs(self.jerk[:, :, 2]).max(axis=1, initial=0.0))
            return np.asarray(np.minimum(np.minimum(1 / self.speed.max(axis=1), np.sqrt(square)), by_jerk))

    @property
    def total(self) -> int:
        """Number of limits at each point of the path."""
        return sum(kind.shape[1] for kind in self)

    def usage(self, motion: LineMotion) -> Array:
        """Return the ratio, with sign, of each limited quantity of a motion to its limit. Shape (S, K + L + P)."""
        v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
        acceleration, jerk = self.acceleration, self.jerk
        return np.concatenate(
            [
                self.speed * v,
                acceleration[:, :, 0] * a + acceleration[:, :, 1] * v**2 + acceleration[:, :, 2],
                jerk[:, :, 0] * j + jerk[:, :, 1] * v * a + jerk[:, :, 2] * v**3,
            ],
            axis=1,
        )


def limit_names(limits: LineLimits, joints: JointPath | None) -> tuple[str, ...]:
    """Return the names of all limits of a motion: those of speed, then of acceleration, then of jerk, as in `Rows`."""
    return tuple(name for kind in _names_by_kind(limits, joints) for name in kind)


def _names_by_kind(limits: LineLimits, joints: JointPath | None) -> tuple[list[str], list[str], list[str]]:
    """Return three lists of limit names: limits of the speed, of the acceleration and of the jerk."""
    speed, acceleration, jerk = ["centripetal acceleration"], ["line acceleration"], []
    if np.isfinite(limits.jerk):
        jerk = ["line jerk"]
    if limits.tool is not None:
        speed += ["tool turn rate", *(f"tool velocity along {axis}" for axis in "xyz")]
        acceleration += [f"tool acceleration along {axis}" for axis in "xyz"]
        jerk += [f"tool jerk along {axis}" for axis in "xyz"]
    if joints is not None:
        names = joints.names
        speed += [f"joint {name!r} velocity" for name in names]
        acceleration += [f"joint {name!r} acceleration" for name in names]
        if np.isfinite(limits.of_joints(len(names))[2]).any():
            jerk += [f"joint {name!r} jerk" for name in names]
        if torque_rows(limits, joints):
            acceleration += [f"joint {name!r} torque" for name in names]
    return speed, acceleration, jerk


def torque_rows(limits: LineLimits, joints: JointPath | None) -> int:
    """Return the number of torque limits, which are the last acceleration limits in `Rows`."""
    if joints is None or not np.isfinite(limits.torques(len(joints.names))).any():
        return 0
    return len(joints.names)


def limit_rows(
    path: PathLike, limits: LineLimits, joints: JointPath | None, distance: Array, *, torques: bool = True
) -> Rows:
    """Return the coefficients of all limit inequalities, with or without torque limits, at distances (S,) along a path.

    Raises:
        ProblemError: Curvature or joints are not finite, as at a singular arm, or have a wrong shape.
    """
    if len(distance) <= BLOCK_SIZE:
        return _block_rows(path, limits, joints, distance, torques)
    # fill preallocated arrays: concatenating the parts of a long path takes twice the memory
    speed, acceleration, jerk = (len(kind) for kind in _names_by_kind(limits, joints))
    shapes = ((speed,), (acceleration, 3), (jerk, 3))
    whole = Rows(*(np.empty((len(distance), *shape)) for shape in shapes))
    for first in range(0, len(distance), BLOCK_SIZE):
        part = _block_rows(path, limits, joints, distance[first : first + BLOCK_SIZE], torques)
        for kind, rows in zip(whole, part, strict=True):
            kind[first : first + BLOCK_SIZE] = rows
    return whole


def _block_rows(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array, torques: bool) -> Rows:
    """Return the coefficients of all limit inequalities at no more than `BLOCK_SIZE` distances along a path."""
    counts = [len(kind) for kind in _names_by_kind(limits, joints)]
    speed, acceleration, jerk = (np.zeros((len(s), *shape)) for shape in ((counts[0],), (counts[1], 3), (counts[2], 3)))
    if np.isfinite(limits.centripetal):
        speed[:, 0] = np.sqrt(curvature_along(path, s) / limits.centripetal)
    acceleration[:, 0, 0] = 1 / limits.acceleration
    line_jerks = int(np.isfinite(limits.jerk))
    jerk[:, :line_jerks, 0] = 1 / limits.jerk
    k, m, p = 1, 1, line_jerks
    if limits.tool is not None:
        tangent, curvature, rate, turn = tool_along(path, s)
        speed[:, 1] = np.linalg.norm(turn, axis=1) / limits.tool.turn_rate
        each = (limits.tool.acceleration, limits.tool.jerk, limits.tool.velocity)
        accelerations, jerks, velocities = (np.broadcast_to(value, (3,)) for value in each)
        speed[:, 2:5] = np.abs(tangent) / velocities
        acceleration[:, 1:4, 0], acceleration[:, 1:4, 1] = tangent / accelerations, curvature / accelerations
        jerk[:, p : p + 3] = np.stack([tangent, 3 * curvature, rate], axis=2) / jerks[:, None]
        k, m, p = 5, 4, p + 3
    if joints is not None:
        n = len(joints.names)
        rates, (velocities, accelerations, jerks) = rates_along(joints, s), limits.of_joints(n)
        first, second, third = (np.asarray(values, dtype=float) for values in (rates.first, rates.second, rates.third))
        speed[:, k:] = np.abs(first) / velocities
        acceleration[:, m : m + n, 0], acceleration[:, m : m + n, 1] = first / accelerations, second / accelerations
        if jerk.shape[1] > p:
            jerk[:, p:] = np.stack([first, 3 * second, third], axis=2) / jerks[:, None]
        if torques and torque_rows(limits, joints):
            along = torques_along(joints, s)
            values = np.stack([along.inertia, along.drag, along.rest], axis=2)
            acceleration[:, m + n :] = values / limits.torques(n)[:, None]
    for rows in (speed, acceleration, jerk):
        rows[np.abs(rows) < NO_COEFFICIENT] = 0.0  # of a joint that stands still but for rounding
    return Rows(speed, acceleration, jerk)
