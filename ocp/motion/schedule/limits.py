"""What a schedule must keep to, and the line speed that it leaves at each place of a path.

Every limit of a schedule as rows in the speed v, the acceleration a and the jerk j of the line, at places of a path.

    speed          k v <= 1
    acceleration   -1 <= p a + q v^2 + r <= 1
    jerk           |p j + q v a + r v^3| <= 1

Joint velocities, accelerations and jerks give (q'), (q', q'') and (q', 3 q'', q''') over their limits, centripetal
acceleration and the turn rate of the tool a speed, torques (m, b, c) of m(s) a + b(s) v^2 + c(s), and acceleration and
jerk of the tool those of its directions (`ToolLimits`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.errors import NOT_NUMBERS, ProblemError, checked_instance, floats
from ocp.motion.schedule.profile import Array, LineMotion
from ocp.motion.schedule.settings import SETTINGS

__all__ = [
    "JointLimits",
    "JointPath",
    "JointRates",
    "LineLimits",
    "PathLike",
    "Rows",
    "ToolLimits",
    "TorqueRates",
    "check_joints",
    "check_line",
    "check_smooth",
    "curvature_along",
    "limit_names",
    "limit_rows",
    "rates_along",
    "tool_along",
    "torque_rows",
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


class Rows(NamedTuple):
    """Limits at S places.

    Attributes:
        speed: Shape (S, K), s/m.
        acceleration: p, q and r of each row. Shape (S, L, 3).
        jerk: p, q and r of each row. Shape (S, P, 3).
    """

    speed: Array
    acceleration: Array
    jerk: Array

    def take(self, places: NDArray[np.intp] | slice) -> Rows:
        """Those at some of the places."""
        return Rows(self.speed[places], self.acceleration[places], self.jerk[places])

    def steady(self) -> tuple[Array, NDArray[np.intp]]:
        """Greatest steady speed (m/s) at each place, and the row of `causes` that limits it. Shape (S,) each."""
        with np.errstate(divide="ignore", invalid="ignore"):
            room = 1 - np.sign(self.acceleration[:, :, 1]) * self.acceleration[:, :, 2]
            speeds = np.concatenate(
                [
                    1 / self.speed,
                    np.sqrt(np.maximum(room, 0) / np.abs(self.acceleration[:, :, 1])),
                    np.cbrt(1 / np.abs(self.jerk[:, :, 2])),
                ],
                axis=1,
            )
        speeds[np.isnan(speeds)] = np.inf
        if not speeds.shape[1]:
            return np.full(len(speeds), np.inf), np.zeros(len(speeds), dtype=np.intp)
        return speeds.min(axis=1), speeds.argmin(axis=1)

    @property
    def total(self) -> int:
        """Of rows at a place."""
        return sum(kind.shape[1] for kind in self)

    def demands(self, motion: LineMotion) -> Array:
        """Each row of `causes` over its limit, with its sign, during a motion at these places. Shape (S, K + L + P)."""
        v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
        of_a, of_j = self.acceleration, self.jerk
        return np.concatenate(
            [
                self.speed * v,
                of_a[:, :, 0] * a + of_a[:, :, 1] * v**2 + of_a[:, :, 2],
                of_j[:, :, 0] * j + of_j[:, :, 1] * v * a + of_j[:, :, 2] * v**3,
            ],
            axis=1,
        )


def limit_names(limits: LineLimits, joints: JointPath | None) -> tuple[str, ...]:
    """What each row limits, in the order of `Rows.demands`."""
    return tuple(name for kind in _kinds(limits, joints) for name in kind)


def _kinds(limits: LineLimits, joints: JointPath | None) -> tuple[list[str], list[str], list[str]]:
    speed, acceleration, jerk = ["centripetal acceleration"], ["line acceleration"], []
    if np.isfinite(limits.jerk):
        jerk = ["line jerk"]
    if limits.tool is not None:
        speed += ["tool turn rate"]
        acceleration += [f"tool acceleration along {axis}" for axis in "xyz"]
        jerk += [f"tool jerk along {axis}" for axis in "xyz"]
    if joints is not None:
        names = joints.names
        speed += [f"joint {name!r} velocity" for name in names]
        acceleration += [f"joint {name!r} acceleration" for name in names]
        jerk += [f"joint {name!r} jerk" for name in names]
        if torque_rows(limits, joints):
            acceleration += [f"joint {name!r} torque" for name in names]
    return speed, acceleration, jerk


def torque_rows(limits: LineLimits, joints: JointPath | None) -> int:
    """Rows of acceleration that are torques: the last so many."""
    if joints is None or not np.isfinite(limits.torques(len(joints.names))).any():
        return 0
    return len(joints.names)


def limit_rows(
    path: PathLike, limits: LineLimits, joints: JointPath | None, distance: Array, *, torques: bool = True
) -> Rows:
    """Rows of all limits at distances (S,) of a path, those of `causes`; zeros for torques that are not asked for.

    Raises:
        ProblemError: A curvature or joints that are not finite, as at a singular arm, or of a wrong shape.
    """
    if len(distance) <= SETTINGS.block:
        return _rows_at(path, limits, joints, distance, torques)
    # into memory that is there: the parts of a long path and the whole would be twice as much
    speed, acceleration, jerk = (len(kind) for kind in _kinds(limits, joints))
    shapes = ((speed,), (acceleration, 3), (jerk, 3))
    all_of_them = Rows(*(np.empty((len(distance), *shape)) for shape in shapes))
    for first in range(0, len(distance), SETTINGS.block):
        part = _rows_at(path, limits, joints, distance[first : first + SETTINGS.block], torques)
        for kind, own in zip(all_of_them, part, strict=True):
            kind[first : first + SETTINGS.block] = own
    return all_of_them


def _rows_at(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array, torques: bool) -> Rows:
    speed, acceleration, jerk = (np.zeros((len(s), len(kind), 3)) for kind in _kinds(limits, joints))
    if not s.size:
        return Rows(speed[:, :, 0], acceleration, jerk)
    if np.isfinite(limits.centripetal):
        speed[:, 0, 0] = np.sqrt(curvature_along(path, s) / limits.centripetal)
    acceleration[:, 0, 0] = 1 / limits.acceleration
    lines = int(np.isfinite(limits.jerk))
    jerk[:, :lines, 0] = 1 / limits.jerk
    k, m, p = 1, 1, lines
    if limits.tool is not None:
        tangent, bend, rate, turn = tool_along(path, s)
        speed[:, 1, 0] = np.linalg.norm(turn, axis=1) / limits.tool.turn_rate
        most, jerks = (np.broadcast_to(value, (3,)) for value in (limits.tool.acceleration, limits.tool.jerk))
        acceleration[:, 1:4, 0], acceleration[:, 1:4, 1] = tangent / most, bend / most
        jerk[:, p : p + 3] = np.stack([tangent, 3 * bend, rate], axis=2) / jerks[:, None]
        k, m, p = 2, 4, p + 3
    if joints is not None:
        n = len(joints.names)
        rates, (velocities, most, jerks) = rates_along(joints, s), limits.of_joints(n)
        first, second, third = (np.asarray(values, dtype=float) for values in (rates.first, rates.second, rates.third))
        speed[:, k:, 0] = np.abs(first) / velocities
        acceleration[:, m : m + n, 0], acceleration[:, m : m + n, 1] = first / most, second / most
        jerk[:, p:] = np.stack([first, 3 * second, third], axis=2) / jerks[:, None]
        if torques and torque_rows(limits, joints):
            along = torques_along(joints, s)
            values = np.stack([along.inertia, along.drag, along.rest], axis=2)
            acceleration[:, m + n :] = values / limits.torques(n)[:, None]
    return Rows(speed[:, :, 0], acceleration, jerk)
