"""Equations of tip tasks: J u = b for the joint rates u, with drift and feedback in b, or J u' = c for accelerations
u'.

The latter are the former differentiated along the motion. Everything that depends on time alone is in the column of
targets; everything else is a function of configuration and targets, written element by element on SX symbols.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FixedBase, FreeFloating, Machine, ModelError, Robot, Standing
from models.checks import Array
from models.machines.machine import with_tip
from models.robot.kinematics import manipulability_of
from models.spatial import on_scalars
from ocp.errors import ProblemError, require
from ocp.motion.tasks.tip_task import (
    ANGULAR,
    BoundTask,
    TipTask,
    angular_velocity,
    closing_combinations,
    cross_product,
    derivative,
    is_holonomic,
    movable_angular_rows,
    pose_error,
    pose_error_rows,
    pose_in_reference,
    reference_pose,
    relative_twist,
    rotation_of,
    split_targets,
    target_size,
    target_twist,
    task_rows,
)
from ocp.motion.tasks.tracks import on_symbols, track_expression


@dataclass(frozen=True, eq=False)
class TaskEquations:
    """Stacked equations of all tip tasks of a machine, created by `bind`.

    Attributes:
        machine: The machine.
        bound: Its tasks, each with the machines whose tips are its frame and its reference.
        size: Number of rows of all tasks.
    """

    machine: Machine
    bound: tuple[BoundTask, ...]

    @property
    def size(self) -> int:
        return sum(part.task.size for part in self.bound)

    @property
    def pose_rows(self) -> NDArray[np.bool_]:
        """Mask of the task equations that belong to pose tasks, not to velocity tasks. Shape (size,), bool."""
        return np.repeat([part.task.is_pose for part in self.bound], [part.task.size for part in self.bound])

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """Mask of the joints that move neither the frame nor the reference frame of any task. Shape (joint_size,).

        On a floating base or a standing machine no joint is idle: each one moves the base or the balance.
        """
        couplings = self.machine.robot.couplings
        fixed_base = isinstance(self.machine, FixedBase) and not isinstance(self.machine, Standing)
        idle = np.full(self.machine.joint_size, fixed_base)
        for robot in (tip.robot for part in self.bound for tip in (part.tip, part.reference) if tip is not None):
            idle[[couplings[joint.name].column for joint in robot.path_to(robot.tip_link) if joint.moves]] = False
        return idle

    def unit(self, pose: str = "/s", velocity: str = "/s") -> str:
        """Return the units of the task equations as text, for example "rad/s, m/s" for the velocity residual.

        Args:
            pose, velocity: Time units of the rows of pose and of velocity tasks: "" for `error`, "/s^2" for
                `acceleration`.
        """
        units: dict[str, None] = {}
        for task in (part.task for part in self.bound):
            tilt = ["rad"] if task.tilts else []
            kinds = [*tilt, *("rad" if row in ANGULAR else "m" for row in task.chosen)]
            units |= dict.fromkeys(kind + (pose if task.is_pose else velocity) for kind in kinds)
        return ", ".join(units)

    def targets(self, time: Any, pace: Any = 1) -> Any:
        """Return the targets of all tasks (poses and velocities) as a column of expressions of the symbol `time`.

        For each task: the velocity in its rows; or, in its reference and as far as given, position and velocity (3, 3),
        rotation and angular velocity (9, 3), direction and angular velocity (3, 3).

        Args:
            time: Symbol that the tracks are functions of: the time, s, or a path parameter.
            pace: Rate of a path parameter, 1/s.

        Raises:
            ProblemError: A track has a wrong size, is not finite, or depends on anything but the time.
        """
        parts = []
        for task in (part.task for part in self.bound):
            if task.velocity is not None:
                parts.append(
                    pace * track_expression(task.velocity, time, (task.size, 1), what="velocity", begin=task.begin)
                )
            if task.position is not None:
                value = _position_of(task, task.position, time, "position")
                rate = getattr(task.position, "rate", None)
                velocity = derivative(value, time) if rate is None else _position_of(task, rate, time, "position rate")
                parts += [value, pace * velocity]
            if task.orientation is not None:
                value = track_expression(task.orientation, time, ((4, 1), (3, 3)), what="orientation", begin=task.begin)
                rotation = rotation_of(value) if value.shape == (4, 1) else value
                rate = getattr(task.orientation, "rate", None)
                if rate is None:
                    angular = angular_velocity(rotation, ca.reshape(derivative(ca.vec(rotation), time), 3, 3))
                else:
                    angular = track_expression(rate, time, (3, 1), what="orientation rate", begin=task.begin)
                parts += [ca.vec(rotation), pace * angular]
            if task.direction is not None:
                value = track_expression(task.direction, time, (3, 1), what="direction", begin=task.begin)
                length = ca.norm_2(value)
                unit, rate = value / length, getattr(task.direction, "rate", None)
                if rate is None:
                    unit_rate = derivative(unit, time)
                else:
                    unit_rate = track_expression(rate, time, (3, 1), what="direction rate", begin=task.begin) / length
                parts += [unit, pace * cross_product(unit, unit_rate)]
        return ca.densify(ca.vertcat(*parts))

    @on_scalars
    def jacobian(self, base: Any, joints: Any) -> Any:
        """Return the Jacobian J of all tasks with respect to the joint rates u. Shape (size, joint_size)."""
        rows = []
        for part in self.bound:
            columns = relative_twist(part, base, joints, part.tip.tip_jacobian(base, joints), rates=None)
            rows.append(task_rows(part, base, joints, columns))
        symbolic = isinstance(base, ca.SX) or isinstance(joints, ca.SX)
        return ca.densify(ca.cse(ca.vertcat(*rows)) if symbolic else ca.vertcat(*rows))

    @on_scalars
    def right(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the right-hand side b of the task equation J u = b, task velocities minus drift. Shape (size, 1)."""
        return -self.residual(base, joints, ca.DM(self.machine.joint_size, 1), targets)

    @on_scalars
    def residual(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """Return the residual J u - b of the task equation at joint rates u. Shape (size, 1)."""
        rows = []
        for part, target in self.by_task(targets):
            twist = relative_twist(part, base, joints, part.tip.tip_twist(base, joints, rates), rates=rates)
            if part.task.velocity is not None:
                rows.append(task_rows(part, base, joints, twist) - target)
            else:
                rows.append(task_rows(part, base, joints, twist - target_twist(part, base, joints, target)))
        return ca.densify(ca.vertcat(*rows))

    @on_scalars
    def twist(self, base: Any, joints: Any, rates: Any) -> Any:
        """Return the tip velocities in the components that the tasks prescribe, rad/s and m/s. Shape (size, 1)."""
        rows = []
        for part in self.bound:
            twist = relative_twist(part, base, joints, part.tip.tip_twist(base, joints, rates), rates=rates)
            rows.append(task_rows(part, base, joints, twist))
        return ca.densify(ca.vertcat(*rows))

    def deviations(self, base: Any, joints: Any, rates: Any, targets: Any) -> dict[str, dict[str, Any]]:
        """Return the deviations of the tips from their tasks by name, each as arguments of `Problem.watch`.

        For poses these are their errors, "task position" and "task orientation"; for velocities the integral of their
        residual, "task displacement" and "task rotation"; each is judged relative to the path of the tips. If a task is
        enforced at velocity or acceleration level, errors too small for that equation may accumulate. A pose may
        deviate by the start gap of its task, which the feedback closes, and by the tolerance of its task.
        """
        tolerances = self.tolerances
        gaps = np.repeat([part.task.start_gap for part in self.bound], [part.task.size for part in self.bound])
        gaps = np.where(gaps > TipTask.start_gap, gaps, 0.0)  # the default gap is not closed
        error, residual = self.error(base, joints, targets), self.residual(base, joints, rates, targets)
        twist, deviations = self.twist(base, joints, rates), dict[str, dict[str, Any]]()
        for posed, angular, name, unit in (
            (True, False, "task position", "m"),
            (True, True, "task orientation", "rad"),
            (False, False, "task displacement", "m"),
            (False, True, "task rotation", "rad"),
        ):
            rows = np.flatnonzero((self.pose_rows == posed) & (self.turning == angular)).tolist()
            if rows:
                expression = (error if posed else residual)[rows]
                gap = gaps[rows] if posed else 0.0
                bounds = {"lower": -gap, "upper": gap, "integral": not posed, "unit": unit}
                tolerance = tolerances[rows] if posed else None
                deviations[name] = {"expression": expression, "way": twist[rows], "tolerance": tolerance, **bounds}
        return deviations

    @property
    def tolerances(self) -> Array:
        """Accepted pose error of each task equation, m or rad. Shape (size,)."""
        pairs = np.repeat([part.task.tolerance for part in self.bound], [part.task.size for part in self.bound], axis=0)
        return np.asarray(np.where(self.turning, *pairs.T[::-1]))

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Mask of the angular equations among all task equations. Shape (size,), bool."""
        angular: list[bool] = []
        for task in (part.task for part in self.bound):
            angular += [*([True, True] if task.tilts else []), *(row in ANGULAR for row in task.chosen)]
        return np.array(angular, dtype=bool)

    def acceleration(self, base: Any, joints: Any, rates: Any, second: Any, *, progress: Sequence[Any]) -> Any:
        """Return the residual of the task equations for joint accelerations, including pose feedback. Shape (size, 1).

        d/dt (J u - b) + gain (J u - b): the error of a pose decays as e'' + 2 gain e' + gain^2 e = 0.

        Args:
            base, joints, rates: Symbols.
            second: Joint accelerations u', (joint_size, 1).
            progress: The time, as for `targets`; or a path parameter, its pace, which is a symbol too, and the rate of
                the pace, 1/s^2.
        """
        time, pace, change = progress if len(progress) > 1 else (progress[0], 1, 0)
        residual = self.residual(base, joints, rates, self.targets(time, pace))
        symbols, rates_of = [joints, rates, time], [rates, second, 1]
        if self.machine.base_size:
            symbols, rates_of = [base, *symbols], [self.machine.base_rate(base, joints, rates), *rates_of]
        if isinstance(pace, ca.SX | ca.MX):
            symbols, rates_of = [*symbols, pace], [*rates_of[:-1], pace, change]
        gains = np.repeat([float(part.task.gain) for part in self.bound], [part.task.size for part in self.bound])
        return ca.jtimes(residual, ca.vertcat(*symbols), ca.vertcat(*rates_of)) + ca.sparsify(ca.DM(gains)) * residual

    @on_scalars
    def manipulability(self, base: Any, joints: Any) -> Any:
        """Return the manipulability sqrt(det(J J')) for the Jacobian J of all tasks (Yoshikawa 1985). Shape (1, 1)."""
        return manipulability_of(self.jacobian(base, joints))

    @on_scalars
    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the pose errors (target minus pose) of all tasks, m and rad; 0 for velocity tasks. Shape (size, 1)."""
        rows = []
        for part, target in self.by_task(targets):
            if part.task.velocity is not None:
                rows.append(ca.DM(part.task.size, 1))
            else:
                rows.append(task_rows(part, base, joints, pose_error(part, base, joints, target)))
        return ca.densify(ca.vertcat(*rows))

    def gap(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """Return pose minus target for pose tasks, and velocity residual for velocity tasks. Shape (size, 1)."""
        error, residual = self.error(base, joints, targets), self.residual(base, joints, rates, targets)
        return ca.vertcat(*((-error if is_pose else residual)[i] for i, is_pose in enumerate(self.pose_rows)))

    @on_scalars
    def pose_residual(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return a column of pose errors (m, near zero rad) that does not vanish at a rotation error of half a turn.

        In m, and chords of the unit circle (2 sin(angle / 2), near zero the angle in rad). If all rotation is
        prescribed, these are the differences of the frame axes over sqrt 2, otherwise the rows of the half-angle
        vector. Velocity tasks have no entries.
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part, target in self.by_task(targets):
            task = part.task
            if not task.is_pose:
                continue
            position_target, rotation_target = split_targets(task, target)
            reference = reference_pose(part, base, joints)
            rotation = part.tip.tip_pose(base, joints).rotation
            error = pose_error(part, base, joints, target)
            if rotation_target is not None:
                goal = rotation_target[0] if reference is None else ca.mtimes(reference.rotation, rotation_target[0])
                if task.within is not None:
                    rows.append(ca.fmax(float(np.cos(task.within)) - self._cosine(part, base, joints, target), 0))
                elif task.direction is not None:
                    rows.append(goal - ca.mtimes(rotation, ca.DM(task.tool_axis)))
                elif set(task.chosen) >= set(ANGULAR) or set(task.chosen) >= set(movable_angular_rows(part)):
                    rows.append(ca.vec(goal - rotation) / np.sqrt(2))
                else:
                    cosine = (ca.trace(ca.mtimes(goal, rotation.T)) - 1) / 2
                    half = error[0:3] * ca.sqrt(2 / (1 + ca.fmax(cosine, -1 + 1e-9)))
                    angular = [i for i, row in enumerate(task.chosen) if row in ANGULAR]
                    rows.append(task_rows(part, base, joints, ca.vertcat(half, ca.DM(3, 1)))[angular])
            if position_target is not None:
                tilt = 2 if task.tilts else 0
                linear = [tilt + i for i, row in enumerate(task.chosen) if row not in ANGULAR]
                rows.append(task_rows(part, base, joints, ca.vertcat(ca.DM(3, 1), error[3:6]))[linear])
        return ca.densify(ca.vertcat(*rows))

    def misses(self, base: Any, joints: Any, targets: Any) -> tuple[float, float]:
        """Return the largest position error, m, and orientation error, rad, of all tips in a numeric configuration."""
        distance = angle = 0.0
        for part, target in self.by_task(ca.DM(targets)):
            task = part.task
            if not task.is_pose:
                continue
            residual = TaskEquations(self.machine, (part,)).pose_residual(ca.DM(base), ca.DM(joints), target)
            values = np.array(residual).ravel()
            turning = len(values) - (0 if task.position is None else len(task.linear))
            distance = max(distance, float(np.linalg.norm(values[turning:])))
            if task.within is not None:
                turned = np.arccos(np.clip(np.cos(task.within) - values[:turning].sum(), -1.0, 1.0)) - task.within
            else:
                turned = 2 * np.arcsin(min(float(np.linalg.norm(values[:turning])) / 2, 1.0))
            angle = max(angle, float(turned))
        return distance, angle

    @on_scalars
    def cone_cosines(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the cosine of the angle between tool axis and cone axis for each task with a cone. Shape (k, 1)."""
        rows: list[Any] = [ca.DM(0, 1)]
        for part, target in self.by_task(targets):
            if part.task.within is not None:
                rows.append(self._cosine(part, base, joints, target))
        return ca.densify(ca.vertcat(*rows))

    @property
    def cone_angles(self) -> Array:
        """Half-angles, rad, of the cones in which tool axes must stay, one for each task with a cone. Shape (k,)."""
        return np.array([part.task.within for part in self.bound if part.task.within is not None], dtype=float)

    def _cosine(self, part: BoundTask, base: Any, joints: Any, target: Any) -> Any:
        """Return the cosine of the angle between the tool axis of a task and the target direction of the task."""
        _, direction = split_targets(part.task, target)
        reference = reference_pose(part, base, joints)
        goal = direction[0] if reference is None else ca.mtimes(reference.rotation, direction[0])
        return ca.dot(goal, ca.mtimes(part.tip.tip_pose(base, joints).rotation, ca.DM(part.task.tool_axis)))

    def reference_error(self, base: Any, joints: Any, at_base: Array, at_joints: Array) -> Any:
        """Return the differences of the tip poses of velocity tasks between a configuration and a reference one.

        For a start configuration that is free except for the pose of the tip. Shape (rows of all velocity tasks, 1).
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part in self.bound:
            if part.task.velocity is not None:
                position, rotation = (ca.DM(value) for value in pose_in_reference(part, at_base, at_joints))
                bound = part._replace(
                    task=replace(part.task, velocity=None, position=np.zeros(3), orientation=np.eye(3))
                )
                targets = ca.vertcat(position, ca.DM(3, 1), ca.vec(rotation), ca.DM(3, 1))
                rows.append(pose_error_rows(bound, base, joints, targets))
        return ca.vertcat(*rows)

    def by_task(self, targets: Any) -> Iterator[tuple[BoundTask, Any]]:
        """Yield each task together with the task's own rows of the stacked targets of all tasks."""
        at = 0
        for part in self.bound:
            size = target_size(part.task)
            yield part, targets[at : at + size]
            at += size

    def errors(self, t: Any, base: Any, joints: Any) -> Array:
        """Return the pose errors of all tasks along a motion, m and rad; 0 for velocity tasks. Shape (M, size)."""
        bases, positions, targets = self._along(t, base, joints)
        count = len(positions)
        return np.array(self.function.map(count)(bases.T, positions.T, targets)[2]).reshape(-1, count).T

    def _along(self, t: Any, base: Any, joints: Any) -> tuple[Array, Array, Any]:
        """Return base configurations (M, base_size), joint positions (M, joint_size) and targets (_, M) of a motion."""
        times, positions = np.atleast_1d(np.asarray(t, dtype=float)), np.atleast_2d(np.asarray(joints, dtype=float))
        bases = np.zeros((len(times), 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
        return bases, positions, self.target_function().map(len(times))(times[None, :])

    def cone_violations(self, t: Any, base: Any, joints: Any) -> Array:
        """Return the angles by which tool axes leave their cones along a motion, rad. Shape (M, k)."""
        bases, positions, targets = self._along(t, base, joints)
        if not self.cone_angles.size:
            return np.zeros((len(positions), 0))
        cosines = np.array(self._cone_function.map(len(positions))(bases.T, positions.T, targets)).T
        return np.asarray(np.maximum(np.arccos(np.clip(cosines, -1.0, 1.0)) - self.cone_angles, 0.0))

    @cached_property
    def _cone_function(self) -> Any:
        symbols = self._symbols
        return ca.Function("cone_cosines", symbols, [self.cone_cosines(*symbols)], {"cse": True})

    @cached_property
    def function(self) -> Any:
        """CasADi Function of configuration and targets: task matrix J, right-hand side b and pose errors.

        (base, joints, targets) -> (J, b, pose error, pose residual).
        """
        symbols = self._symbols
        rows = [of_targets(*symbols) for of_targets in (self.right, self.error, self.pose_residual)]
        return ca.Function("task", symbols, [self.jacobian(*symbols[:2]), *rows], {"cse": True})

    @cached_property
    def pose_residual_function(self) -> Any:
        """CasADi Function (joints, base, targets) -> (pose residual, its Jacobian in the joint positions)."""
        base, joints, targets = self._symbols
        residual = self.pose_residual(base, joints, targets)
        jacobian = ca.densify(ca.jacobian(residual, joints))
        return ca.Function("pose_residual", [joints, base, targets], [residual, jacobian], {"cse": True})

    @cached_property
    def jacobian_function(self) -> Any:
        """CasADi Function (joints, base) -> Jacobian of all tasks with respect to the joint rates."""
        base, joints, _ = self._symbols
        return ca.Function("jacobian", [joints, base], [self.jacobian(base, joints)], {"cse": True})

    @property
    def _symbols(self) -> tuple[Any, ...]:
        """CasADi symbols for the base configuration, the joint positions and the targets."""
        targets = sum(target_size(part.task) for part in self.bound)
        sizes = {"base": self.machine.base_size, "joints": self.machine.joint_size, "targets": targets}
        return tuple(ca.SX.sym(name, size) for name, size in sizes.items())

    def target_function(self) -> Any:
        """Return the targets of all tasks as a CasADi Function of time, in MX symbols if a target rejects SX."""

        def build(symbols: Any) -> Any:
            time = symbols.sym("time")
            return ca.Function("targets", [time], [self.targets(time)])

        return on_symbols(build)

    def cyclic_rows(self, base: Array, joints: Array) -> Array:
        """Return the combinations of task equations whose integral vanishes over a cyclic motion. Shape (size, k).

        If the joints return to their start, part of the closure conditions follows from the task: all of its rows on a
        fixed base; on a floating base the combinations of rows that are independent of the base pose while the centre
        of mass stays. Rows whose integral depends on the path do not count.

        Raises:
            ProblemError: The momentum moves the centre of mass, and the joints cannot return.
        """
        holonomic = np.concatenate([is_holonomic(part) for part in self.bound])
        directions = np.eye(self.size)[:, holonomic]
        if self.machine.base_size == 0:
            return directions
        if not isinstance(self.machine, FreeFloating):
            return np.zeros((self.size, 0))
        return directions @ closing_combinations(self.machine, self.bound, holonomic, base=base, joints=joints)


def _position_of(task: TipTask, track: Any, time: Any, name: str) -> Any:
    """Return a position target with all three coordinates; a coordinate that is not prescribed is 0. Shape (3, 1)."""
    short = task.along_reference and len(task.linear) < 3
    shapes = ((3, 1), (len(task.linear), 1)) if short else ((3, 1),)
    value = track_expression(track, time, shapes, what=name, begin=task.begin)
    if value.shape[0] == 3:
        return value
    whole = type(value)(3, 1)
    whole[task.linear] = value
    return ca.densify(whole)


def bind(machine: Machine, tasks: TipTask | Sequence[TipTask]) -> TaskEquations:
    """Return the stacked equations of one or several tip tasks in the joint rates of a machine.

    If the robot has no tip, the machine of the equations has the frame of the first task as its tip.

    Raises:
        ProblemError: `machine` or a task has the wrong type, there is no task, a link is unknown, or a task is of the
            tip of a robot that has none.
    """
    if isinstance(machine, type) or not isinstance(getattr(machine, "robot", None), Robot):
        words = f"machine must be a FixedBase(robot), FreeFloating(robot) or Standing(robot, ...), not {machine!r}"
        raise ProblemError(words, name="machine", value=machine)
    listed = (tasks,) if isinstance(tasks, TipTask) else require.each("task", tasks, TipTask)
    if not listed:
        raise ProblemError("task is an empty list; give a TipTask, or several", name="task", value=listed)
    bound = []
    for task in listed:
        try:
            tip = with_tip(machine, task.link, task.point) if task.link is not None else machine
            _ = tip.robot.tip_link
            reference = None if task.relative_to is None else with_tip(machine, task.relative_to)
        except ModelError as error:
            raise ProblemError(str(error), **vars(error)) from error
        bound.append(BoundTask(task, tip, reference))
    return TaskEquations(bound[0].tip if machine.robot.tip is None else machine, tuple(bound))


def task_errors(
    machine: Machine, tasks: TipTask | Sequence[TipTask], t: Any, joints: Any, *, base: Any = None
) -> Array:
    """Return the pose errors of tasks along a motion, m and rad; 0 for velocity tasks. Shape (M, size).

    Args:
        t: Times, s. Shape (M,).
        joints: Joint positions. Shape (M, joint_size).
        base: Base configurations. Shape (M, base_size), or None on a fixed base.

    Returns:
        Shape (M, rows of all tasks).
    """
    return bind(machine, tasks).errors(t, base, joints)
