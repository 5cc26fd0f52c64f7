"""Tracks that a task's frame follows over time: lines between poses, paths run along, tracks run through by a clock.

A track is a constant, or a function of casadi time. One with a method `rate` is asked for its rate, where a derivative
by the time would be half or none: at the bounds of a path's pieces and at its ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from models import ModelError
from models.arrays import Array, ArrayInput
from models.paths.blends import rest_to_rest
from models.paths.functions import path_function, turn_function
from models.paths.orientation import exponential
from models.paths.smooth_path import SmoothPath
from models.spatial import expression, rotation_from_quaternion
from ocp.errors import NOT_NUMBERS, ProblemError, checked_choice, floats, real

__all__ = [
    "PathTracks",
    "PoseLine",
    "Track",
    "on_symbols",
    "path_tracks",
    "pose_line",
    "reparametrized",
    "track_expression",
    "track_with_rate",
]

Track: TypeAlias = Any
"""A constant, or a function: casadi time (s) -> casadi vector or matrix, or a list of expressions."""

_Made = TypeVar("_Made")

LARGEST_TURN = np.pi - 1e-3
"""rad, of a line between poses: half a turn has no axis of its own."""


class PoseLine(NamedTuple):
    """Tracks of a TipTask: `TipTask(position=line.position, orientation=line.orientation)`."""

    position: Callable[[Any], Any]
    orientation: Callable[[Any], Any]


def pose_line(
    first: tuple[ArrayInput, ArrayInput],
    second: tuple[ArrayInput, ArrayInput],
    duration: float,
    *,
    pace: Literal["constant", "rest"] = "rest",
) -> PoseLine:
    """Straight line between two poses, turning about one fixed axis at the same pace (slerp).

    Args:
        first, second: (Orientation, position), the orientation as a matrix (3, 3) or a quaternion (4,); a Frame of
            numbers, such as `machine.tip_pose(base, q)`, will do.
        duration: From the first to the second, s. Before and after it the pose stands still with pace "rest".
        pace: "constant" for constant speed, "rest" for the polynomial that starts and ends at rest.

    Raises:
        ProblemError: Wrong sizes, no rotations, a turn of half a circle, whose sense is ambiguous, a duration that is
            not positive.
    """
    checked_choice("pace", pace, ("constant", "rest"))
    if not 0 < real(duration) < np.inf:
        words = f"duration must be a positive number of seconds, not {duration!r}"
        raise ProblemError(words, name="duration", value=duration, limit=0.0)
    (turn, place), (other, there) = (_pose(pose, what) for pose, what in ((first, "first"), (second, "second")))
    relative = turn.T @ other
    axial = np.array(
        [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(axial)) / 2, (float(np.trace(relative)) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if angle > LARGEST_TURN:
        words = f"the poses are {np.degrees(angle):.4g} deg apart: the sense of the turn is ambiguous"
        raise ProblemError(words, name="poses", value=angle, limit=LARGEST_TURN)
    vector = axial / 2 * (angle / sine if sine > 0 else 1.0)

    def share(time: Any) -> Any:
        s = time / duration
        if pace == "constant":
            return s
        return rest_to_rest(ca.fmin(ca.fmax(s, 0), 1))

    def position(time: Any) -> Any:
        return ca.DM(place) + share(time) * ca.DM(there - place)

    def orientation(time: Any) -> Any:
        return ca.mtimes(ca.DM(turn), rotation_from_quaternion(exponential(share(time) * ca.DM(vector))))

    return PoseLine(position, orientation)


class _Rated:
    """A track that knows its rate."""

    def __init__(self, at: Callable[[Any], Any], rate: Callable[[Any], Any]) -> None:
        self._at, self._rate = at, rate

    def __call__(self, time: Any) -> Any:
        return self._at(time)

    def rate(self, time: Any) -> Any:
        """Velocity of a position or a direction; of an orientation the angular velocity. Shape (3, 1), per s."""
        return self._rate(time)


def track_with_rate(track: Callable[[Any], Any], rate: Callable[[Any], Any]) -> Track:
    """Return a track that knows its rate: of a position or direction the velocity, of an orientation the angular one.

    Args:
        track, rate: Functions of casadi time (s).
    """
    return _Rated(track, rate)


class PathTracks(NamedTuple):
    """What a tool does that runs along a path.

    Attributes:
        position, orientation: Tracks of the tool's frame.
        duration: From one end to the other, s.
        breaks: Times at which pieces meet, of the path or of the pace, both ends included. Shape (k,), s.
    """

    position: Callable[[Any], Any]
    orientation: Callable[[Any], Any]
    duration: float
    breaks: Array

    def axis(self, tool_axis: Array) -> Callable[[Any], Any]:
        """Direction of an axis of the tool's frame, shape (3,), as the path turns it."""
        turn, spin = self.orientation, self.orientation.rate  # type: ignore[attr-defined]

        def at(time: Any) -> Any:
            return ca.mtimes(turn(time), ca.DM(tool_axis))

        return _Rated(at, lambda time: ca.cross(spin(time), at(time)))


def path_tracks(path: SmoothPath, speed: Any) -> PathTracks:
    """Tracks that run along a path.

    They need symbols=casadi.MX in builders. A mesh with nodes at `breaks` keeps its full order.

    Args:
        path: As `models.smooth` makes it, with the tool's orientation.
        speed: Constant, m/s; or a Schedule of the path (`ocp.motion.schedule.schedule`).

    Raises:
        ProblemError: No path, a speed that is not positive, a schedule of another path.
    """
    if not isinstance(path, SmoothPath):
        raise ProblemError(f"path must be a SmoothPath, as smooth makes it, not {path!r}", name="path", value=path)
    place, turn = path_function(path), turn_function(path)
    pace: Callable[[Any], tuple[Any, Any]]
    if callable(getattr(speed, "time_at", None)) and not isinstance(speed, type):
        length = float(speed.path.length)
        if abs(length - path.length) > 1e-9 * path.length:
            words = f"the schedule is for a path of {length:g} m, this one has {path.length:g} m"
            raise ProblemError(words, name="speed", value=length, limit=path.length)
        motion, duration = speed.function(), float(speed.duration)
        breaks = np.union1d(speed.profile.t, speed.time_at(path.bounds))

        def pace(time: Any) -> tuple[Any, Any]:
            distance, rate, *_ = motion(time)
            return distance, rate

    else:
        if not 0 < real(speed) < np.inf:
            words = f"speed must be a positive number of m/s, or a Schedule of the path, not {speed!r}"
            raise ProblemError(words, name="speed", value=speed, limit=0.0)
        even = float(speed)
        duration, breaks = path.length / even, path.bounds / even

        def pace(time: Any) -> tuple[Any, Any]:
            return even * time, even

    def velocity(time: Any) -> Any:
        distance, rate = pace(time)
        return rate * place(distance)[1]

    def spin(time: Any) -> Any:
        distance, rate = pace(time)
        return rate * turn(distance)[1]

    position = _Rated(lambda time: place(pace(time)[0])[0], velocity)
    orientation = _Rated(lambda time: rotation_from_quaternion(turn(pace(time)[0])[0]), spin)
    return PathTracks(position, orientation, duration, np.asarray(breaks, dtype=float))


def reparametrized(track: Track, clock: Callable[[Any], Any]) -> Track:
    """A track over a parameter, run through by a clock: casadi time (s) -> parameter. Constants stay what they are."""
    if not callable(track):
        return track

    def at(time: Any) -> Any:
        return track(clock(time))

    rate = getattr(track, "rate", None)
    return at if rate is None else _Rated(at, lambda time: ca.jacobian(clock(time), time) * rate(clock(time)))


def _pose(pose: tuple[ArrayInput, ArrayInput], what: str) -> tuple[Array, Array]:
    try:
        orientation, position = (np.array(ca.DM(expression(part))) for part in pose)
    except NOT_NUMBERS as error:
        words = f"the {what} pose must be (orientation, position) in numbers, not {pose!r}"
        raise ProblemError(words, name=what, value=str(pose)) from error
    if orientation.size == 4 and np.linalg.norm(orientation) > 0:
        orientation = np.array(rotation_from_quaternion(ca.DM(orientation.ravel())))
    if orientation.shape != (3, 3) or position.size != 3 or not np.isfinite(position).all():
        words = f"the {what} pose has the shapes {orientation.shape}, {position.shape}; finite (3, 3), (3,) expected"
        raise ProblemError(words, name=what, value=(orientation.shape, position.shape), limit=((3, 3), (3,)))
    if not (np.abs(orientation @ orientation.T - np.eye(3)).max() < 1e-6 and np.linalg.det(orientation) > 0):
        words = f"the {what} pose has the orientation {orientation.tolist()}, which is no rotation"
        raise ProblemError(words, name=what, value=orientation)
    return orientation, position.ravel()


def on_symbols(make: Callable[[Any], _Made]) -> _Made:
    """What `make` makes of SX symbols, or of MX symbols where interpolants and external functions take no others."""
    try:
        return make(ca.SX)
    except (RuntimeError, NotImplementedError):
        return make(ca.MX)


def track_expression(
    track: Any,
    time: Any,
    shapes: tuple[int, int] | tuple[tuple[int, int], ...],
    what: str = "track",
    begin: float = 0.0,
) -> Any:
    """A constant or a function of time as a dense matrix of expressions of the symbol `time`.

    Args:
        track: A constant, or a function: casadi time -> casadi matrix, array, or a list of expressions.
        time: The symbol.
        shapes: The shape it has, or several that it may have.
        what: Its name in errors.
        begin: When the track begins, s, from where on it counts its time.

    Raises:
        ProblemError: Another shape, not finite, or an expression of anything but the time.
    """
    allowed = (shapes,) if isinstance(shapes[0], int) else shapes
    value = _asked(track, time - begin if begin else time, what) if callable(track) else track
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value.ravel())
    if isinstance(value, list | tuple) and any(isinstance(part, ca.SX | ca.MX) for part in value):
        value = ca.vertcat(*value)
    wanted = " or ".join(map(str, allowed))
    if not isinstance(value, ca.SX | ca.MX | ca.DM):
        try:
            value = ca.DM(floats(value))
        except NOT_NUMBERS as error:
            words = f"{what} gives {value!r}, not numbers or expressions of shape {wanted}"
            raise ProblemError(words, name=what, value=value, limit=allowed) from error
    if value.shape not in allowed:
        hint = ": one entry for each row of the task" if what == "velocity" else ""
        words = f"{what} has shape {tuple(value.shape)}, expected {wanted}{hint}"
        raise ProblemError(words, name=what, value=value.shape, limit=allowed)
    if isinstance(value, ca.DM):
        if not np.isfinite(np.array(value)).all():
            found = np.array(value).ravel()
            raise ProblemError(f"{what} {found.tolist()} is not finite", name=what, value=found)
    elif strange := [str(symbol) for symbol in ca.symvar(value) if not ca.is_equal(symbol, time, 1)]:
        words = f"{what} depends on {strange}, but only the time it is called with may occur"
        raise ProblemError(words, name=what, value=strange)
    return ca.densify(value)


def _asked(track: Callable[[Any], Any], time: Any, what: str) -> Any:
    """What a track says; ProblemError where it fails, but for what interpolants say of SX symbols (see on_symbols)."""
    try:
        return track(time)
    except (RuntimeError, NotImplementedError, ProblemError, ModelError):
        raise
    except Exception as error:  # of the function's own
        raise ProblemError(f"{what}: the function fails: {error!r}", name=what, value=track) from error
