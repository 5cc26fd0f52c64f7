"""What a frame of the machine is asked to do: rows of its twist, or a pose over time that it is held to.

Poses become velocities by differentiation, with the pose error fed back so that it does not accumulate (Baumgarte
1972): wanted twist = twist of the target + gain x pose error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, TypeAlias, get_args

import casadi as ca
import numpy as np

from models import ModelError, SmoothPath
from models.arrays import Array, ArrayInput, checked_array
from models.robot.indices import checked_rows
from models.spatial import expression
from ocp.errors import ProblemError, checked_choice, checked_nonnegative, checked_positive, checked_text
from ocp.motion.tasks.tracks import Track, path_tracks, reparametrized
from ocp.tolerances import ORIENTATION_TOLERANCE_RAD, POSITION_TOLERANCE_M

__all__ = ["Axes", "Roll", "TipTask", "Velocity", "timed"]

Velocity: TypeAlias = Any
"""A track with one entry for each row of the task."""
Axes: TypeAlias = Literal["world", "base", "tip", "reference"]
Roll: TypeAlias = Literal["free", "given"]

ANGULAR, LINEAR = (0, 1, 2), (3, 4, 5)


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
        within: Angle that the tool axis may lean from the direction, rad, between 0 and pi; None: it may not.
        tool_axis: In the frame. Shape (3,).
        axes: Along which axes the rows are taken: of the world, of the base (root) link, of the frame itself ("tip"),
            or of the reference. The twist is the same in all: it is not relative to these axes.
        link: Name of the link whose frame it is; None for the robot's tip.
        point: Origin of the frame in the link's frame. Shape (3,), m. Only with `link`.
        relative_to: Name of the reference, a link relative to which the motion and the pose are meant; None for the
            world.
        gain: Of the feedback of the pose error, 1/s. A rate of decay: leave it below what the mesh resolves; `plan`
            lowers it to that where there is no gap to close. Where accelerations are asked for it damps critically, and
            velocities decay to what a `velocity` asks.
        start_gap: Largest pose error at the start, m and rad. Above zero the feedback closes the gap.
        tolerance: By how much a plan's audit lets each row of a pose be off, position (m) and orientation (rad), and by
            no more than 1e-3 of the path along which the tip moves or turns. Shape (2,).
        begin: When the task begins, s; its tracks are functions of the time from there on.
        duration: How long it lasts, s; None: to the end of the motion.
        breaks: Times from its beginning at which its tracks are less smooth, where a mesh should have nodes. Shape
            (k,), s.

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
    within: float | None = None
    begin: float = 0.0
    duration: float | None = None
    breaks: ArrayInput = ()
    tolerance: ArrayInput = (POSITION_TOLERANCE_M, ORIENTATION_TOLERANCE_RAD)

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
        for what in ("gain", "start_gap", "begin"):
            checked_nonnegative(what, getattr(self, what))
        if self.duration is not None:
            checked_positive("duration", self.duration)
        if self.within is not None:
            checked_positive("within", self.within, below=np.pi)
            if self.direction is None:
                words = "a tool axis leans within an angle of a direction: give direction=... too"
                raise ProblemError(words, name="within", value=self.within)
        try:
            axis = checked_array(self.tool_axis, (3,), "tip task", "tool_axis")
            object.__setattr__(self, "point", checked_array(self.point, (3,), "tip task", "point"))
            object.__setattr__(self, "rows", self._checked_rows())
            object.__setattr__(self, "breaks", self._checked_breaks())
            pair = checked_array(self.tolerance, (2,), "tip task", "tolerance")
        except ModelError as error:
            raise ProblemError(str(error), **vars(error)) from error
        if not np.linalg.norm(axis) > 0:
            raise ProblemError(f"tool_axis {axis.tolist()} has no direction", name="tool_axis", value=axis)
        object.__setattr__(self, "tool_axis", axis / np.linalg.norm(axis))
        if not (pair > 0).all():
            words = f"tip task: tolerance must be two positive numbers, m and rad, not {self.tolerance!r}"
            raise ProblemError(words, name="tolerance", value=self.tolerance)
        object.__setattr__(self, "tolerance", tuple(pair.tolist()))
        if self.link is None and np.any(self.point):
            words = "a point is given in the frame of a link: name the link too"
            raise ProblemError(words, name="point", value=self.point)

    @classmethod
    def along(
        cls,
        path: SmoothPath,
        speed: Any,
        *,
        roll: Roll = "free",
        tool_axis: ArrayInput = (0.0, 0.0, 1.0),
        **others: Any,
    ) -> Self:
        """The task of running along a path: its position, and the tool as the path turns it.

        Where the path says nothing of the tool's orientation, only the position is asked for, unless `direction` or
        `orientation` says more. Duration and breaks are those of the path.

        Args:
            path: As `models.smooth` makes it.
            speed: Constant, m/s; or a Schedule of the path.
            roll: "free": the tool axis points where the path turns it, the roll about it is free (a `within` lets it
                lean, too); "given": the whole orientation is the path's.
            tool_axis: In the tool's frame. Shape (3,).
            others: Further attributes of the task: `link`, `gain`, `within`, `begin`, ...; `direction` or `orientation`
                instead of the path's.

        Raises:
            ProblemError: No path, a speed that is none, or what the attributes say.
        """
        checked_choice("roll", roll, get_args(Roll))
        tracks = path_tracks(path, speed)
        given: dict[str, Any] = {"position": tracks.position, "duration": tracks.duration, "breaks": tracks.breaks}
        if path.path.oriented and not {"direction", "orientation"} & set(others):
            axis = checked_array(tool_axis, (3,), "tip task", "tool_axis")
            told = {"orientation": tracks.orientation} if roll == "given" else {"direction": tracks.axis(axis)}
            given |= told
        return cls(tool_axis=tool_axis, **{**given, **others})

    def _checked_breaks(self) -> Array:
        times = np.unique(checked_array(self.breaks, ("times",), "tip task", "breaks", least=0))
        last = np.inf if self.duration is None else float(self.duration)
        if not ((times >= 0).all() and (times <= last * (1 + 1e-9)).all()):
            words = f"breaks must be times from the task's beginning to its end, 0 to {last:g} s, not {times.tolist()}"
            raise ProblemError(words, name="breaks", value=times, limit=(0.0, last))
        return times

    def _checked_rows(self) -> tuple[int, ...]:
        if not self.is_pose:
            if self.rows is None:
                words = "rows are missing: which rows of the twist does the velocity prescribe?"
                raise ProblemError(words, name="rows")
            return tuple(checked_rows(self.rows))
        defined = (ANGULAR if self.orientation is not None else ()) + (LINEAR if self.position is not None else ())
        if self.rows is None:
            return defined
        none = self.direction is not None and np.size(self.rows) == 0  # the tilt alone, or a lean
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
    def tilts(self) -> bool:
        """Whether the direction fixes the two rows of the tilt; where the axis may lean it does not."""
        return self.direction is not None and self.within is None

    @property
    def size(self) -> int:
        """Number of rows, with those of the tilt."""
        return len(self.chosen) + (2 if self.tilts else 0)

    @property
    def end(self) -> float:
        """When the task ends, s; infinite where it lasts to the end of the motion."""
        return np.inf if self.duration is None else float(self.begin + self.duration)


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

    changed: dict[str, Any] = {
        name: reparametrized(getattr(task, name), clock) for name in ("position", "orientation", "direction")
    }
    if task.velocity is not None:
        changed["velocity"] = velocity
    return replace(task, **changed)
