"""Tasks for a frame of the machine: components of the frame's twist, or a pose over time, are prescribed.

Pose tasks are differentiated to velocities, with the pose error fed back so that it does not accumulate (Baumgarte
1972): task twist = twist of the target + gain x pose error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Self, TypeAlias, get_args
from warnings import warn

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, Machine, ModelWarning, SmoothPath, center_of_mass
from models.checks import NOT_NUMBERS, Array, ArrayInput, floats, short_repr
from models.robot.kinematics import checked_rows
from models.spatial import Frame, expression, on_scalars, skew
from ocp.errors import ProblemError, problem_errors, require
from ocp.motion.tasks.speed_profile import rest_profile
from ocp.motion.tasks.tracks import Track, checked_speed, path_tracks, ramp_limits, reparametrize
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD, POSITION_TOLERANCE_M

Velocity: TypeAlias = Any  # constant or function of time with one entry for each row of the task
Axes: TypeAlias = Literal["world", "base", "tip", "reference"]
Roll: TypeAlias = Literal["free", "given"]

ANGULAR, LINEAR = (0, 1, 2), (3, 4, 5)


@dataclass(frozen=True, eq=False)
class TipTask:
    """Task of one frame of a robot: a prescribed velocity, or a pose (position, and orientation or tool direction).

    Functions of time (tracks) are differentiated with respect to their time symbol; a track with a method `rate` is
    asked for its rate instead. A list of tasks stacks them: one for each arm, or one that keeps the base from rotating
    (rows 0, 1, 2 of the root link, velocity zero: reactionless motion).

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

    __repr__ = short_repr

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
            if name is not None:
                require.name(f"tip task: {attribute}", name)
        for attribute in ("gain", "start_gap", "begin"):
            require.nonnegative(attribute, getattr(self, attribute))
        if self.duration is not None:
            require.positive("duration", self.duration)
        if self.within is not None:
            require.positive("within", self.within, below=np.pi)
            if self.direction is None:
                words = "within is an angle about a direction: give direction=... too"
                raise ProblemError(words, name="within", value=self.within)
        axis = require.array("tip task: tool_axis", self.tool_axis, (3,))
        if not np.linalg.norm(axis) > 0:
            raise ProblemError(f"tool_axis {axis.tolist()} has no direction", name="tool_axis", value=axis)
        pair = require.array("tip task: tolerance", self.tolerance, (2,), sign="positive", meaning="m and rad")
        object.__setattr__(self, "tolerance", tuple(pair.tolist()))
        object.__setattr__(self, "tool_axis", axis / np.linalg.norm(axis))
        object.__setattr__(self, "point", require.array("tip task: point", self.point, (3,)))
        object.__setattr__(self, "breaks", self._checked_breaks())
        with problem_errors():
            object.__setattr__(self, "rows", self._checked_rows())
        if self.direction is not None and not callable(self.direction) and _is_zero(self.direction):
            words = f"direction {np.ravel(self.direction).tolist()} has no length; say where the tool axis shall point"
            raise ProblemError(words, name="direction", value=self.direction)
        if self.link is None and np.any(self.point):
            words = "a point is given in the frame of a link: name the link too"
            raise ProblemError(words, name="point", value=self.point)

    @classmethod
    def along(
        cls,
        path: SmoothPath,
        speed: Any,
        *,
        acceleration: float | None = None,
        jerk: float | None = None,
        steady: bool = False,
        roll: Roll = "free",
        **others: Any,
    ) -> Self:
        """Return the task of moving along a path, with the tool orientation that the path specifies.

        The tip starts and ends at rest, because robots do, and moves at the requested speed in between. If the path has
        no tool orientation, only the position is prescribed, unless `direction` or `orientation` is given. Duration and
        breaks are those of the path.

        Args:
            path: Path from `models.smooth`.
            speed: Speed between the two ramps, m/s, or a Schedule of the path, which specifies the whole motion.
            acceleration, jerk: Largest ones along the path, m/s^2 and m/s^3; None: 1 m/s^2, built up in 0.1 s.
            steady: Whether the tip moves at this speed on the whole path, as in a pass that is part of a longer motion.
            roll: "free": the tool axis points as the path says and the roll about it is free (within a cone if `within`
                is given); "given": the path prescribes the whole orientation.
            others: Further attributes of the task; `direction` or `orientation` replace those of the path.

        Raises:
            ProblemError: `path` is not a path, a number is not positive, an attribute is invalid, or acceleration and
                jerk are given for a steady motion or beside a Schedule.

        Warns:
            ModelWarning: The path is too short for the tip to reach the speed between the ramps.
        """
        require.choice("roll", roll, get_args(Roll))
        if hasattr(speed, "profile"):
            _refuse_ramps(
                "the Schedule specifies the speed", acceleration=acceleration, jerk=jerk, steady=steady or None
            )
        elif steady:
            _refuse_ramps("a steady motion has no ramps", acceleration=acceleration, jerk=jerk)
        else:
            require.instance("path", path, SmoothPath)
            requested, ramps = checked_speed(speed), ramp_limits(acceleration, jerk)
            speed = rest_profile(path.length, requested, *ramps)
            if (peak := float(speed.speed.max())) < (1 - LIMIT_SHARE) * requested:
                words = f"the path of {path.length:.4g} m is too short for {requested:g} m/s from rest to rest: at an "
                words += f"acceleration of {ramps[0]:g} m/s^2 the tip reaches {peak:.4g} m/s"
                warn(ModelWarning(words, name="speed", value=requested, limit=peak), stacklevel=2)
        tracks = path_tracks(path, speed)
        attributes: dict[str, Any] = {"position": tracks.position, "duration": tracks.duration, "breaks": tracks.breaks}
        if path.path.oriented and not {"direction", "orientation"} & set(others):
            axis = require.array("tip task: tool_axis", others.get("tool_axis", (0.0, 0.0, 1.0)), (3,))
            whole = roll == "given"
            attributes |= {"orientation": tracks.orientation} if whole else {"direction": tracks.axis(axis)}
        return cls(**{**attributes, **others})

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
        """Indices, 0..5, of the prescribed components of the tip's twist; a prescribed tool direction adds no index."""
        return tuple(self.rows or ())

    @property
    def linear(self) -> list[int]:
        """Indices 0..2 of the position coordinates that the task prescribes, in the order of its equations."""
        return [row - 3 for row in self.chosen if row in LINEAR]

    @property
    def along_reference(self) -> bool:
        """Whether the prescribed components are along the axes of the frame in which the target pose is given."""
        return self.axes == "reference" or (self.axes == "world" and self.relative_to is None)

    @property
    def tilts(self) -> bool:
        """Whether the task prescribes the direction of the tool axis; False if the axis need only lie in a cone."""
        return self.direction is not None and self.within is None

    @property
    def size(self) -> int:
        """Number of scalar equations of the task, including the two equations of a prescribed tool direction."""
        return len(self.chosen) + (2 if self.tilts else 0)

    @property
    def end(self) -> float:
        """End time of the task, s; infinite if the task lasts to the end of the motion."""
        return np.inf if self.duration is None else float(self.begin + self.duration)


def _is_zero(vector: Any) -> bool:
    try:
        return not floats(vector).any()
    except NOT_NUMBERS:  # an expression
        return False


def _refuse_ramps(reason: str, **arguments: Any) -> None:
    """Raise ProblemError if an argument of `TipTask.along` that would have no effect is given."""
    for name, value in arguments.items():
        if value is not None:
            raise ProblemError(f"{name}={value!r} has no effect: {reason}; remove it", name=name, value=value)


def retime_task(task: TipTask, clock: Callable[[Any], Any]) -> TipTask:
    """Convert a task stated over a path parameter to a task over time; `clock` maps a time (s) to the parameter."""

    def velocity(time: Any) -> Any:
        parameter = clock(time)
        rate = task.velocity(parameter) if callable(task.velocity) else task.velocity
        return ca.jacobian(parameter, time) * expression(rate)

    poses = ("position", "orientation", "direction")
    tracks: dict[str, Any] = {name: reparametrize(getattr(task, name), clock) for name in poses}
    if task.velocity is not None:
        tracks["velocity"] = velocity
    return replace(task, **tracks)


class BoundTask(NamedTuple):
    """A task with two machines, whose tips are the task's frame and its reference frame (None for the world).

    The methods return expressions of the machine's base configuration and joint positions.
    """

    task: TipTask
    tip: Machine
    reference: Machine | None

    @property
    def name(self) -> str:
        """Name of the link to which the task's frame belongs."""
        return self.task.link or self.tip.robot.tip_link

    @property
    def target_rows(self) -> dict[str, tuple[slice, slice]]:
        """Rows of each prescribed target, and of its velocity (3 rows), in the column of targets, by name: "position"
        (3 rows), "orientation" (9 rows, a rotation matrix by columns) and "direction" (3 rows).
        """
        rows, at = dict[str, tuple[slice, slice]](), 0
        for name, size in (("position", 3), ("orientation", 9), ("direction", 3)):
            if getattr(self.task, name) is not None:
                rows[name] = slice(at, at + size), slice(at + size, at + size + 3)
                at += size + 3
        return rows

    @property
    def target_size(self) -> int:
        """Number of values of the task in the column of targets."""
        return self.task.size if not self.task.is_pose else max(rates.stop for _, rates in self.target_rows.values())

    @property
    def rate_rows(self) -> list[int]:
        """Indices of the velocities and angular velocities in the targets of a pose task."""
        return [row for _, rates in self.target_rows.values() for row in range(rates.start, rates.stop)]

    def split_targets(self, targets: Any) -> tuple[Any, Any]:
        """Split targets into (position, velocity) and (rotation or direction, angular velocity); None if absent."""
        parts = {name: (targets[values], targets[rates]) for name, (values, rates) in self.target_rows.items()}
        if "orientation" in parts:
            parts["orientation"] = ca.reshape(parts["orientation"][0], 3, 3), parts["orientation"][1]
        return parts.get("position"), parts.get("orientation", parts.get("direction"))

    def reference_pose(self, base: Any, joints: Any) -> Frame:
        """Return the pose of the reference frame in the world."""
        if self.reference is None:
            return Frame(ca.DM.eye(3), ca.DM(3, 1))
        return self.reference.tip_pose(base, joints)

    def relative(self, base: Any, joints: Any, twist_of: Callable[[Any], Any]) -> Any:
        """Return twists (6, k) of the tip relative to the reference, in world axes; `twist_of` gives the twists of a
        machine's tip.
        """
        twist = twist_of(self.tip)
        if self.reference is None:
            return twist
        moving = twist_of(self.reference)
        lever = self.tip.tip_pose(base, joints).position - self.reference.tip_pose(base, joints).position
        return twist - ca.vertcat(moving[0:3, :], moving[3:6, :] - ca.mtimes(skew(lever), moving[0:3, :]))

    def twist(self, base: Any, joints: Any, rates: Any) -> Any:
        """Return the twist of the tip relative to the reference at given joint rates, in world axes. Shape (6, 1)."""
        return self.relative(base, joints, lambda machine: machine.tip_twist(base, joints, rates))

    def rows(self, base: Any, joints: Any, twist: Any) -> Any:
        """Return those components of twists (6, k) in world axes that the task prescribes. Shape (size, k)."""
        task = self.task
        angular, linear = twist[0:3, :], twist[3:6, :]
        rotation = None
        if task.axes == "base":
            rotation = self.tip.world_from_base(base).rotation
        elif task.axes == "tip":
            rotation = self.tip.tip_pose(base, joints).rotation
        elif task.axes == "reference" and self.reference is not None:
            rotation = self.reference.tip_pose(base, joints).rotation
        if rotation is not None:
            twist = ca.vertcat(ca.mtimes(rotation.T, angular), ca.mtimes(rotation.T, linear))
        selected = twist[list(task.chosen), :]
        if not task.tilts:
            return selected
        normals = ca.mtimes(self.tip.tip_pose(base, joints).rotation, _tool_normals(task))
        return ca.vertcat(ca.mtimes(normals.T, angular), selected)

    def pose_error(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return rotation error (axis times sine of angle) and position error in world axes. Shape (6, 1)."""
        position_target, goal = self.split_targets(targets)
        pose, reference = self.tip.tip_pose(base, joints), self.reference_pose(base, joints)
        angular, linear = ca.DM(3, 1), ca.DM(3, 1)
        if position_target is not None:
            linear = reference.point(position_target[0]) - pose.position
        if self.task.orientation is not None:
            rotation = ca.mtimes(reference.rotation, goal[0])
            angular = sum((cross_product(pose.rotation[:, i], rotation[:, i]) for i in range(3)), start=ca.DM(3, 1)) / 2
        elif self.task.tilts:
            tool = ca.mtimes(pose.rotation, ca.DM(self.task.tool_axis))
            angular = cross_product(tool, ca.mtimes(reference.rotation, goal[0]))
        return ca.vertcat(angular, linear)

    def target_twist(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the twist of a target relative to the reference, plus pose feedback, in world axes. Shape (6, 1)."""
        rotation = self.reference_pose(base, joints).rotation
        linear, angular = (
            ca.DM(3, 1) if target is None else ca.mtimes(rotation, target[1]) for target in self.split_targets(targets)
        )
        return ca.vertcat(angular, linear) + self.task.gain * self.pose_error(base, joints, targets)

    def pose_in_reference(self, base: Any, joints: Any) -> tuple[Any, Any]:
        """Return position and rotation of the tip in the reference frame."""
        pose, reference = self.tip.tip_pose(base, joints), self.reference_pose(base, joints)
        back = reference.rotation.T
        return ca.mtimes(back, pose.position - reference.position), ca.mtimes(back, pose.rotation)

    def cone_cosine(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the cosine of the angle between the tool axis and the target direction."""
        goal = ca.mtimes(self.reference_pose(base, joints).rotation, self.split_targets(targets)[1][0])
        return ca.dot(goal, ca.mtimes(self.tip.tip_pose(base, joints).rotation, ca.DM(self.task.tool_axis)))

    @property
    def is_holonomic(self) -> NDArray[np.bool_]:
        """Mask of the velocity components that are time derivatives of pose coordinates. Shape (size,)."""
        task = self.task
        if task.is_pose:
            return np.ones(task.size, dtype=bool)
        all_angular = set(self.movable_angular_rows) <= set(task.chosen)
        fixed = task.axes in ("world", "reference")
        return np.array([fixed and (all_angular or row not in ANGULAR) for row in task.chosen], dtype=bool)

    @property
    def movable_angular_rows(self) -> list[int]:
        """World axes, 0..2, about which the joints can rotate the tip."""
        base, joints = ca.SX.sym("base", self.tip.base_size), ca.SX.sym("joints", self.tip.joint_size)
        jacobian = self.tip.tip_jacobian(base, joints)
        return [row for row in ANGULAR if not all(entry.is_zero() for entry in ca.horzsplit(jacobian[row, :]))]


def _tool_normals(task: TipTask) -> Any:
    """Return two unit vectors orthogonal to each other and to the tool axis, in the tool frame. Shape (3, 2)."""
    axis = np.asarray(task.tool_axis)
    _, _, basis = np.linalg.svd(axis[None, :])
    if np.count_nonzero(axis) == 1:
        basis[1:] = np.eye(3)[axis == 0]
    return ca.sparsify(ca.DM(basis[1:].T))


@on_scalars
def cross_product(a: Any, b: Any) -> Any:
    """Return the cross product a x b, computed on scalar symbols."""
    return ca.mtimes(skew(a), b)


def base_independent_combinations(
    machine: FreeFloating, bound_tasks: Sequence[BoundTask], selected: NDArray[np.bool_], *, base: Array, joints: Array
) -> Array:
    """Return the linear combinations of selected task equations that do not change if the base moves but the centre of
    mass does not. Raise ProblemError if the momentum moves the centre of mass, so that the joints cannot return.
    """
    jacobians = []
    for bound in bound_tasks:
        base_jacobian = bound.relative(base, joints, lambda machine: machine.jacobians(base, joints)[0])
        jacobians.append(np.array(ca.DM(bound.rows(ca.DM(base), ca.DM(joints), base_jacobian))))
    frame = machine.world_from_base(base)
    lever = center_of_mass(machine.robot, joints, frame) - frame.position
    center = np.array(ca.DM(ca.horzcat(-skew(lever), ca.DM.eye(3))))[:, machine.twist_rows]
    task = np.vstack(jacobians)[selected]
    closing = _combinations(np.vstack([task, center]), len(task))
    linear = machine.twist_rows.index(3)  # the rows of the angular momentum come first
    if np.any(np.asarray(machine.conserved_momentum)[linear:]):
        without_center = _combinations(task, len(task))
        if without_center.shape[1] < closing.shape[1]:
            words = "cyclic: the linear momentum keeps moving the centre of mass, so the joints and a tip prescribed "
            words += "in the world cannot both return to the start; define the task relative to the base"
            raise ProblemError(words, name="cyclic", value=machine.conserved_momentum)
        closing = without_center
    return closing


def _combinations(jacobian: Array, count: int) -> Array:
    """Return combinations (count, k) of the first `count` rows of a matrix that are in the span of the other rows."""
    left, values, _ = np.linalg.svd(jacobian)
    rank = int(np.sum(values > 1e-9 * max(values[0], 1.0)))
    combinations, shares, _ = np.linalg.svd(left[:count, rank:], full_matrices=False)
    return np.asarray(combinations[:, : int(np.sum(shares > 1e-9))])
