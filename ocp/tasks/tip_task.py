"""What a frame of the machine is asked to do: rows of its twist, or a pose over time that it is held to.

Poses become velocities by differentiation, with the pose error fed back so that it does not accumulate (Baumgarte
1972): wanted twist = twist of the target + gain x pose error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import casadi as ca
import numpy as np

from models import ModelError
from models.arrays import Array, ArrayInput, checked_array
from models.paths.blends import rest_to_rest
from models.paths.functions import path_function
from models.paths.orientation import exponential
from models.paths.smooth_path import SmoothPath
from models.robot.indices import checked_rows
from models.spatial import expression, rotation_from_quaternion
from ocp.errors import NOT_NUMBERS, ProblemError, checked_choice, checked_each, checked_nonnegative, checked_text, real

__all__ = ["Axes", "PoseLine", "TipTask", "Track", "Velocity", "along", "one_of", "pose_line", "timed"]

Track: TypeAlias = Any
"""A constant, or a function: casadi time (s) -> casadi vector or matrix, or a list of expressions."""
Velocity: TypeAlias = Any
"""A track with one entry for each row of the task."""
Axes: TypeAlias = Literal["world", "base", "tip", "reference"]

ANGULAR, LINEAR = (0, 1, 2), (3, 4, 5)
LARGEST_TURN = np.pi - 1e-3


@dataclass(frozen=True, eq=False)
class TipTask:
    """A task of one frame: either `velocity`, or a pose by `position` and one of `orientation` and `direction`.

    Tracks are differentiated by their time symbol; a position with a method `rate`, a function of time, is asked for
    its velocity instead. Several tasks are stacked by giving a list of them: one for each arm, or one that holds the
    base still (rows 0, 1, 2 of the root link, velocity zero: reactionless motion).

    Attributes:
        rows: Which rows of the twist the task fixes: angular 0..2, linear 3..5, along `axes`. Needed with `velocity`;
            otherwise all that the pose defines if None. A `direction` always fixes the two rows of the tilt, and `rows`
            those of the position.
        velocity: In the rows, along `axes`: constant or function of time (s). Shape (len(rows),).
        position: Of the frame's origin, in the reference: constant or function of time. Shape (3,), m; or only its
            entries in the linear `rows`, in their order, where these are taken along the axes of the reference.
        orientation: Of the frame, in the reference: constant or function of time; quaternion [w, x, y, z], shape (4,),
            or matrix, shape (3, 3).
        direction: Of the tool axis, in the reference; the roll about it is free. Constant or function of time, of any
            length but zero. Shape (3,).
        tool_axis: In the frame. Shape (3,).
        axes: Along which axes the rows are taken: of the world, of the base (root) link, of the frame itself ("tip"),
            or of the reference. The twist is the same in all: it is not relative to these axes.
        link: Name of the link whose frame it is; None for the robot's tip.
        point: Origin of the frame in the link's frame. Shape (3,), m. Only with `link`.
        relative_to: Name of the reference, a link relative to which the motion and the pose are meant; None for the
            world.
        gain: Of the feedback of the pose error, 1/s. A rate of decay: leave it below what the mesh resolves. Where
            accelerations are asked for it damps critically, and velocities decay to what a `velocity` asks.
        start_gap: Largest pose error at the start, m and rad. Above zero the feedback closes the gap.

    Raises:
        ProblemError: A task that is not one of the two kinds, rows that it does not define, wrong sizes or values.
    """

    rows: Sequence[int] | None = None
    velocity: Velocity | None = None
    position: Track | None = None
    orientation: Track | None = None
    direction: Track | None = None
    tool_axis: ArrayInput = (0.0, 0.0, 1.0)
    axes: Axes = "world"
    link: str | None = None
    point: ArrayInput = (0.0, 0.0, 0.0)
    relative_to: str | None = None
    gain: float = 1.0
    start_gap: float = 1e-6

    def __post_init__(self) -> None:
        if (self.velocity is None) == (not self.is_pose):
            words = "a tip task needs a velocity or a pose (position, orientation, direction), and not both"
            raise ProblemError(words, name="velocity")
        if self.orientation is not None and self.direction is not None:
            words = "a tip task takes an orientation or a direction of its tool axis, not both"
            raise ProblemError(words, name="direction")
        checked_choice("axes", self.axes, get_args(Axes))
        for what in ("link", "relative_to"):
            name = getattr(self, what)
            if name is not None and not checked_text(f"tip task: {what}", name):
                raise ProblemError(f"tip task: {what} is an empty name", name=what, value=name)
        for what in ("gain", "start_gap"):
            checked_nonnegative(what, getattr(self, what))
        try:
            axis = checked_array(self.tool_axis, (3,), "tip task", "tool_axis")
            object.__setattr__(self, "point", checked_array(self.point, (3,), "tip task", "point"))
            object.__setattr__(self, "rows", self._checked_rows())
        except ModelError as error:
            raise ProblemError(str(error), **vars(error)) from error
        if not np.linalg.norm(axis) > 0:
            raise ProblemError(f"tool_axis {axis.tolist()} has no direction", name="tool_axis", value=axis)
        object.__setattr__(self, "tool_axis", axis / np.linalg.norm(axis))
        if self.link is None and np.any(self.point):
            words = "a point is given in the frame of a link: name the link too"
            raise ProblemError(words, name="point", value=self.point)

    def _checked_rows(self) -> tuple[int, ...]:
        if not self.is_pose:
            if self.rows is None:
                words = "rows are missing: which rows of the twist does the velocity prescribe?"
                raise ProblemError(words, name="rows")
            return tuple(checked_rows(self.rows))
        defined = (ANGULAR if self.orientation is not None else ()) + (LINEAR if self.position is not None else ())
        if self.rows is None:
            return defined
        none = self.direction is not None and np.size(self.rows) == 0
        rows = () if none else tuple(checked_rows(self.rows))
        if strange := [row for row in rows if row not in defined]:
            needs = "rows 0..2 need an orientation, rows 3..5 a position; a direction fixes its own rows"
            raise ProblemError(f"rows {strange}: {needs}", name="rows", value=strange, limit=defined)
        return rows

    @property
    def is_pose(self) -> bool:
        """Whether the task is a pose over time."""
        return not (self.position is None and self.orientation is None and self.direction is None)

    @property
    def chosen(self) -> tuple[int, ...]:
        """The rows, after those of the tilt."""
        return tuple(self.rows or ())

    @property
    def linear(self) -> list[int]:
        """Coordinates 0..2 of the position that the rows fix, in their order."""
        return [row - 3 for row in self.chosen if row in LINEAR]

    @property
    def along_reference(self) -> bool:
        """Whether the rows are taken along the axes in which the pose is given."""
        return self.axes == "reference" or (self.axes == "world" and self.relative_to is None)

    @property
    def size(self) -> int:
        """Number of rows, with those of the tilt."""
        return len(self.chosen) + (2 if self.direction is not None else 0)


def one_of(
    tip_velocity: Velocity | None, rows: Sequence[int] | None, task: TipTask | Sequence[TipTask] | None
) -> list[TipTask]:
    """The tasks, given either as (tip_velocity, rows) or as such; ProblemError when both or neither."""
    if task is None:
        if tip_velocity is None:
            raise ProblemError("a task is missing: give tip_velocity and rows, or task=TipTask(...)", name="task")
        return [TipTask(rows=rows, velocity=tip_velocity)]
    if tip_velocity is not None or rows is not None:
        raise ProblemError("give either tip_velocity and rows, or task, not both", name="task")
    return [task] if isinstance(task, TipTask) else list(checked_each("task", task, TipTask))


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


class _Along:
    """Position track whose velocity is the path's own tangent: at its ends and bounds a derivative would be half."""

    def __init__(self, path: SmoothPath, speed: float) -> None:
        self._at = path_function(path)
        self._speed = speed

    def __call__(self, time: Any) -> Any:
        return self._at(self._speed * time)[0]

    def rate(self, time: Any) -> Any:
        """Velocity. Shape (3, 1), m/s."""
        return self._speed * self._at(self._speed * time)[1]


def along(path: SmoothPath, speed: float) -> Callable[[Any], Any]:
    """Position track that runs along a path at constant speed (m/s); it needs symbols=casadi.MX in builders.

    A mesh whose nodes are where the pieces of the path begin, `path.bounds / path.length`, keeps the full order.
    """
    if not isinstance(path, SmoothPath):
        raise ProblemError(f"path must be a SmoothPath, as smooth makes it, not {path!r}", name="path", value=path)
    if not 0 < real(speed) < np.inf:
        words = f"speed must be a positive number of m/s, not {speed!r}"
        raise ProblemError(words, name="speed", value=speed, limit=0.0)
    return _Along(path, float(speed))


class _Timed:
    """Track over a path parameter, run through by a clock; asked for its velocity where the track is."""

    def __init__(self, track: Callable[[Any], Any], clock: Callable[[Any], Any]) -> None:
        self._track, self._clock = track, clock
        if hasattr(track, "rate"):
            self.rate = lambda time: ca.jacobian(clock(time), time) * track.rate(clock(time))

    def __call__(self, time: Any) -> Any:
        return self._track(self._clock(time))


def timed(task: TipTask, clock: Callable[[Any], Any]) -> TipTask:
    """A task over a path parameter as one over time.

    Args:
        task: Its tracks are functions of the parameter, its velocity is per unit of it.
        clock: Casadi time (s) -> parameter.
    """

    def velocity(time: Any) -> Any:
        at = clock(time)
        given = task.velocity(at) if callable(task.velocity) else task.velocity
        return ca.jacobian(at, time) * expression(given)

    tracks = {name: getattr(task, name) for name in ("position", "orientation", "direction")}
    changed: dict[str, Any] = {name: _Timed(track, clock) for name, track in tracks.items() if callable(track)}
    if task.velocity is not None:
        changed["velocity"] = velocity
    return replace(task, **changed)


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
