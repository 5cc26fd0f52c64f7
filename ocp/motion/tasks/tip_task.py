"""Tasks of a frame of the machine: rows of its twist, or a pose that it tracks over time.

Pose tasks are differentiated to velocities, with the pose error fed back so that it does not accumulate (Baumgarte
1972): task twist = twist of the target + gain x pose error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, TypeAlias, get_args

import casadi as ca
import numpy as np

from models import ModelError, SmoothPath
from models.checks import Array, ArrayInput
from models.robot.kinematics import checked_rows
from models.spatial import expression
from ocp.errors import ProblemError, require
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
    """Task of one frame: either `velocity`, or a pose by `position` and one of `orientation` and `direction`.

    Tracks are differentiated with respect to their time symbol; a track with a method `rate` is asked for its rate
    instead. A list of tasks stacks them: one for each arm, or one that keeps the base from rotating (rows 0, 1, 2 of
    the root link, velocity zero: reactionless motion).

    Attributes:
        rows: Rows of the twist that the task prescribes: angular 0..2, linear 3..5, along `axes`. Required with
            `velocity`; None selects all rows that the pose defines. A `direction` always prescribes the two rows of the
            tilt, and `rows` select those of the position.
        velocity: Velocity in the rows, along `axes`: constant or function of time (s). Shape (len(rows),).
        position: Origin of the frame in the reference: constant or function of time. Shape (3,), m; if the rows are
            taken along the axes of the reference, the entries of the linear `rows` alone suffice, in their order.
        orientation: Orientation of the frame in the reference: constant or function of time; quaternion [w, x, y, z],
            shape (4,), or matrix, shape (3, 3).
        direction: Direction of the tool axis in the reference, of any nonzero length; the roll about it is free.
            Constant or function of time. Shape (3,).
        within: Half-angle of the cone about the direction in which the tool axis stays, rad, between 0 and pi; None:
            the axis equals the direction.
        tool_axis: Tool axis in the frame. Shape (3,).
        axes: Axes along which the rows are taken: of the world, of the base (root) link, of the frame itself ("tip"),
            or of the reference. They only resolve the twist; the motion is not relative to them.
        link: Name of the link that carries the frame; None for the tip of the robot.
        point: Origin of the frame in the link frame. Shape (3,), m. Only with `link`.
        relative_to: Name of the reference link, to which motion and pose are relative; None for the world.
        gain: Feedback gain of the pose error, 1/s, its rate of decay. Keep it below what the mesh resolves; `plan`
            lowers it to that if there is no start gap to close. At acceleration level the feedback is critically
            damped, and the error of a `velocity` decays at this rate.
        start_gap: Largest pose error at the start, m and rad. If positive, the feedback closes the gap.
        tolerance: Pose error that the audit of a plan accepts in each row, position (m) and orientation (rad), but at
            most 1e-3 of the path along which the tip moves or rotates. Shape (2,).
        begin: Begin of the task, s; its tracks are functions of the time since then.
        duration: Duration of the task, s; None: to the end of the motion.
        breaks: Times since the begin at which tracks are less smooth, where a mesh should have nodes. Shape (k,), s.

    Raises:
        ProblemError: The task is neither a velocity nor a pose, selects rows that it does not define, or has wrong
            sizes or values.
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
        require.choice("axes", self.axes, get_args(Axes))
        for attribute in ("link", "relative_to"):
            name = getattr(self, attribute)
            if name is not None and not require.text(f"tip task: {attribute}", name):
                raise ProblemError(f"tip task: {attribute} is an empty name", name=attribute, value=name)
        for attribute in ("gain", "start_gap", "begin"):
            require.nonnegative(attribute, getattr(self, attribute))
        if self.duration is not None:
            require.positive("duration", self.duration)
        if self.within is not None:
            require.positive("within", self.within, below=np.pi)
            if self.direction is None:
                words = "within is an angle about a direction: give direction=... too"
                raise ProblemError(words, name="within", value=self.within)
        try:
            axis = require.array("tip task: tool_axis", self.tool_axis, (3,))
            object.__setattr__(self, "point", require.array("tip task: point", self.point, (3,)))
            object.__setattr__(self, "rows", self._checked_rows())
            object.__setattr__(self, "breaks", self._checked_breaks())
            pair = require.array("tip task: tolerance", self.tolerance, (2,))
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
        """Return the task of moving along a path, with the tool oriented as the path says.

        If the path has no tool orientation, only the position is prescribed, unless `direction` or `orientation` is
        given. Duration and breaks are those of the path.

        Args:
            path: Path from `models.smooth`.
            speed: Constant, m/s, or a Schedule of the path.
            roll: "free": the tool axis points as the path says and the roll about it is free (within a cone if `within`
                is given); "given": the path prescribes the whole orientation.
            tool_axis: Tool axis in the tool frame. Shape (3,).
            others: Further attributes of the task: `link`, `gain`, `within`, `begin`, ...; `direction` or `orientation`
                replace those of the path.

        Raises:
            ProblemError: `path` is not a path, the speed is not positive, or an attribute is invalid.
        """
        require.choice("roll", roll, get_args(Roll))
        tracks = path_tracks(path, speed)
        attributes: dict[str, Any] = {"position": tracks.position, "duration": tracks.duration, "breaks": tracks.breaks}
        if path.path.oriented and not {"direction", "orientation"} & set(others):
            axis = require.array("tip task: tool_axis", tool_axis, (3,))
            whole = roll == "given"
            attributes |= {"orientation": tracks.orientation} if whole else {"direction": tracks.axis(axis)}
        return cls(tool_axis=tool_axis, **{**attributes, **others})

    def _checked_breaks(self) -> Array:
        times = np.unique(require.array("tip task: breaks", self.breaks, ("times",), least=0))
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
        only_tilt = self.direction is not None and np.size(self.rows) == 0
        rows = () if only_tilt else tuple(checked_rows(self.rows))
        if undefined := [row for row in rows if row not in defined]:
            needs = "rows 0..2 need an orientation, rows 3..5 a position; a direction fixes its own rows"
            raise ProblemError(f"rows {undefined}: {needs}", name="rows", value=undefined, limit=defined)
        return rows

    @property
    def is_pose(self) -> bool:
        """Whether the task prescribes a pose over time."""
        return not (self.position is None and self.orientation is None and self.direction is None)

    @property
    def chosen(self) -> tuple[int, ...]:
        """Rows of the twist that the task prescribes; those of the tilt come before them."""
        return tuple(self.rows or ())

    @property
    def linear(self) -> list[int]:
        """Coordinates 0..2 of the position that the rows prescribe, in their order."""
        return [row - 3 for row in self.chosen if row in LINEAR]

    @property
    def along_reference(self) -> bool:
        """Whether the rows are taken along the axes in which the pose is given."""
        return self.axes == "reference" or (self.axes == "world" and self.relative_to is None)

    @property
    def tilts(self) -> bool:
        """Whether the direction prescribes the two rows of the tilt: not if the axis may move in a cone."""
        return self.direction is not None and self.within is None

    @property
    def size(self) -> int:
        """Number of rows, including those of the tilt."""
        return len(self.chosen) + (2 if self.tilts else 0)

    @property
    def end(self) -> float:
        """End of the task, s; infinite if it lasts to the end of the motion."""
        return np.inf if self.duration is None else float(self.begin + self.duration)


def timed(task: TipTask, clock: Callable[[Any], Any]) -> TipTask:
    """Return a task over a path parameter as a task over time.

    Args:
        task: Task whose tracks are functions of the parameter and whose velocity is per unit of it.
        clock: CasADi function time (s) -> parameter.
    """

    def velocity(time: Any) -> Any:
        parameter = clock(time)
        rate = task.velocity(parameter) if callable(task.velocity) else task.velocity
        return ca.jacobian(parameter, time) * expression(rate)

    poses = ("position", "orientation", "direction")
    tracks: dict[str, Any] = {name: reparametrized(getattr(task, name), clock) for name in poses}
    if task.velocity is not None:
        tracks["velocity"] = velocity
    return replace(task, **tracks)
