"""Target positions and orientations of tasks as functions of time: lines between poses, and motions along paths.

A track is a constant or a function of CasADi time. A track with a method `rate` returns its own rate where a symbolic
derivative with respect to time would be wrong or undefined: at the bounds of the segments of a path and at its ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import casadi as ca
import numpy as np
import scipy

from models import ModelError
from models.checks import NOT_NUMBERS, Array, ArrayInput, real
from models.paths.blends import rest_to_rest
from models.paths.smooth_path import SmoothPath, exponential, path_function, turn_function
from models.spatial import expression, rotation_from_quaternion
from ocp.errors import ProblemError, require
from ocp.motion.tasks.speed_profile import SpeedProfile

Track: TypeAlias = Any  # constant, or function of CasADi time (s) that returns a vector, matrix or list of expressions

_Result = TypeVar("_Result")

MAX_ROTATION_RAD = np.pi - 1e-3  # largest rotation of a `pose_line`, since the sense of half a turn is ambiguous
PATH_ACCELERATION = 1.0
"""Default acceleration along a path, m/s^2. Controllers of robot arms have defaults of about this size for motions on
straight lines (Universal Robots: 1.2 m/s^2)."""
RISE_TIME_S = 0.1  # time in which the default jerk builds up the acceleration along a path, s


class PoseLine(NamedTuple):
    """Position and orientation along a straight line between two poses, as functions of time for a `TipTask`."""

    position: Callable[[Any], Any]
    orientation: Callable[[Any], Any]


def pose_line(
    first: tuple[ArrayInput, ArrayInput],
    second: tuple[ArrayInput, ArrayInput],
    duration: float,
    *,
    pace: Literal["constant", "rest"] = "rest",
) -> PoseLine:
    """Return a motion on a straight line between two poses, with rotation about a fixed axis at the same pace (slerp).

    Args:
        first, second: (Orientation, position), numeric, the orientation a matrix (3, 3) or a quaternion (4,).
        duration: Time from the first pose to the second, s. With pace "rest" the pose is constant before and after.
        pace: "constant" for constant speed, "rest" for the polynomial that starts and ends at rest.

    Raises:
        ProblemError: A size or the duration is wrong, a matrix is no rotation, or the turn is half a turn, thus
            ambiguous.
    """
    require.choice("pace", pace, ("constant", "rest"))
    require.positive("duration", duration)
    (rotation, origin), (turned, end) = (_pose(pose, name) for pose, name in ((first, "first"), (second, "second")))
    vector = scipy.spatial.transform.Rotation.from_matrix(rotation.T @ turned).as_rotvec()
    angle = float(np.linalg.norm(vector))
    if angle > MAX_ROTATION_RAD:
        words = f"the poses are {np.degrees(angle):.4g} deg apart: the sense of the turn is ambiguous"
        raise ProblemError(words, name="poses", value=angle, limit=MAX_ROTATION_RAD)

    def fraction(time: Any) -> Any:
        s = time / duration
        return s if pace == "constant" else rest_to_rest(ca.fmin(ca.fmax(s, 0), 1))

    def position(time: Any) -> Any:
        return ca.DM(origin) + fraction(time) * ca.DM(end - origin)

    def orientation(time: Any) -> Any:
        return ca.mtimes(ca.DM(rotation), rotation_from_quaternion(exponential(fraction(time) * ca.DM(vector))))

    return PoseLine(position, orientation)


@dataclass(frozen=True, eq=False)
class TrackWithRate:
    """Target position, direction or orientation as a function of CasADi time (s), together with its time derivative."""

    track: Callable[[Any], Any]
    rate: Callable[[Any], Any]

    def __call__(self, time: Any) -> Any:
        return self.track(time)


class PathTracks(NamedTuple):
    """Position and orientation, as functions of time, of a tool that moves along a path."""

    position: Callable[[Any], Any]
    orientation: Callable[[Any], Any]
    duration: float  # s
    breaks: Array  # times at which segments of the path or of the speed profile meet, both ends included, (k,), s

    def axis(self, tool_axis: Array) -> Callable[[Any], Any]:
        """Return the direction (3,) of an axis of the tool frame as a function of time with its derivative."""
        rotation, angular_velocity = self.orientation, self.orientation.rate  # type: ignore[attr-defined]

        def direction(time: Any) -> Any:
            return ca.mtimes(rotation(time), ca.DM(tool_axis))

        return TrackWithRate(direction, lambda time: ca.cross(angular_velocity(time), direction(time)))


def ramp_limits(acceleration: float | None, jerk: float | None) -> tuple[float, float]:
    """Return the limits of acceleration, m/s^2, and jerk, m/s^3, along a path; an argument None selects the default."""
    if acceleration is None:
        acceleration = PATH_ACCELERATION
    require.positive("acceleration", acceleration)
    return acceleration, acceleration / RISE_TIME_S if jerk is None else jerk


def checked_speed(speed: Any) -> float:
    """Return a constant speed along a path, m/s, as a float; raise ProblemError if it is not positive and finite."""
    if not 0 < real(speed) < np.inf:
        words = f"speed must be a positive number of m/s, or a Schedule of the path, not {speed!r}"
        raise ProblemError(words, name="speed", value=speed, limit=0.0)
    return float(speed)


def path_tracks(path: SmoothPath, speed: Any) -> PathTracks:
    """Return position and orientation of a tool on a path over time, for problems with symbols=casadi.MX.

    The speed is constant, m/s, or that of a SpeedProfile or Schedule of the path.

    Raises:
        ProblemError: `path` is not a path, the speed is not positive, or the profile is of another path.
    """
    require.instance("path", path, SmoothPath)
    position_of, orientation_of = path_function(path), turn_function(path)
    pace: Callable[[Any], tuple[Any, Any]]
    profile = getattr(speed, "profile", speed)
    if isinstance(profile, SpeedProfile):
        length = float(profile.distance[-1])
        if abs(length - path.length) > 1e-9 * path.length:
            words = f"the schedule is for a path of {length:g} m, this one has {path.length:g} m"
            raise ProblemError(words, name="speed", value=length, limit=path.length)
        motion, duration = profile.function(), profile.duration
        breaks = np.union1d(profile.t, profile.at_distance(np.minimum(path.bounds, length)).t)

        def pace(time: Any) -> tuple[Any, Any]:
            distance, rate, *_ = motion(time)
            return distance, rate

    else:
        constant = checked_speed(speed)
        duration, breaks = path.length / constant, path.bounds / constant

        def pace(time: Any) -> tuple[Any, Any]:
            return constant * time, constant

    def velocity(time: Any) -> Any:
        distance, rate = pace(time)
        return rate * position_of(distance)[1]

    def spin(time: Any) -> Any:
        distance, rate = pace(time)
        return rate * orientation_of(distance)[1]

    position = TrackWithRate(lambda time: position_of(pace(time)[0])[0], velocity)
    orientation = TrackWithRate(lambda time: rotation_from_quaternion(orientation_of(pace(time)[0])[0]), spin)
    return PathTracks(position, orientation, duration, np.asarray(breaks, dtype=float))


def reparametrize(track: Track, clock: Callable[[Any], Any]) -> Track:
    """Convert a target stated over a path parameter to a target over time; `clock` maps a time (s) to the parameter."""
    if not callable(track):
        return track

    def at(time: Any) -> Any:
        return track(clock(time))

    rate = getattr(track, "rate", None)
    return at if rate is None else TrackWithRate(at, lambda time: ca.jacobian(clock(time), time) * rate(clock(time)))


def _pose(pose: tuple[ArrayInput, ArrayInput], name: str) -> tuple[Array, Array]:
    """Check a numeric pose (orientation, position), and return its rotation matrix (3, 3) and position (3,)."""
    try:
        orientation, position = (np.array(ca.DM(expression(part))) for part in pose)
    except NOT_NUMBERS as error:
        words = f"the {name} pose must be (orientation, position) in numbers, not {pose!r}"
        raise ProblemError(words, name=name, value=str(pose)) from error
    if orientation.size == 4 and np.linalg.norm(orientation) > 0:
        orientation = np.array(rotation_from_quaternion(ca.DM(orientation.ravel())))
    rotation = require.rotation(f"{name} pose: orientation", orientation)
    return rotation, require.array(f"{name} pose: position", position.ravel(), (3,))


def on_symbols(build: Callable[[Any], _Result]) -> _Result:
    """Return `build(SX)` with CasADi's SX symbols, or `build(MX)` if an expression does not accept SX symbols."""
    try:
        return build(ca.SX)
    except (RuntimeError, NotImplementedError):
        return build(ca.MX)


def track_expression(
    track: Any,
    time: Any,
    shapes: tuple[int, int] | tuple[tuple[int, int], ...],
    *,
    label: str = "track",
    begin: float = 0.0,
) -> Any:
    """Return a target (a constant, or a function of the time since it begins) as a dense expression of `time`.

    Raises:
        ProblemError: Another shape than those allowed, a value that is not finite, or an expression of anything but the
            time.
    """
    allowed = (shapes,) if isinstance(shapes[0], int) else shapes
    value = require.call(label, track, time - begin if begin else time) if callable(track) else track
    expected = " or ".join(map(str, allowed))
    try:
        value = expression(value)
    except ModelError as error:
        words = f"{label} gives {value!r}, not numbers or expressions of shape {expected}"
        raise ProblemError(words, name=label, value=value, limit=allowed) from error
    if value.shape not in allowed:
        hint = ": one entry for each row of the task" if label == "velocity" else ""
        words = f"{label} has shape {tuple(value.shape)}, expected {expected}{hint}"
        raise ProblemError(words, name=label, value=value.shape, limit=allowed)
    if isinstance(value, ca.DM):
        if not np.isfinite(np.array(value)).all():
            numbers = np.array(value).ravel()
            raise ProblemError(f"{label} {numbers.tolist()} is not finite", name=label, value=numbers)
    elif others := [str(symbol) for symbol in ca.symvar(value) if not ca.is_equal(symbol, time, 1)]:
        words = f"{label} depends on {others}, but only the time it is called with may occur"
        raise ProblemError(words, name=label, value=others)
    return ca.densify(value)
