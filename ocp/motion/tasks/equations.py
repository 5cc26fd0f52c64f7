"""Equations of tip tasks: J u = b for the joint rates u, with drift and feedback in b, or J u' = c for accelerations
u'.

The latter are the former differentiated along the motion. Everything that depends on time alone is in the column of
targets; everything else is a function of configuration and targets, written element by element on SX symbols.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FixedBase, FreeFloating, Machine, Robot, Standing
from models.checks import Array
from models.machines.machine import with_tip
from models.robot.kinematics import manipulability_of
from models.spatial import on_scalars, rotation_from_quaternion
from ocp.errors import ProblemError, problem_errors, require
from ocp.motion.tasks.tip_task import ANGULAR, BoundTask, TipTask, base_independent_combinations, cross_product
from ocp.motion.tasks.tracks import on_symbols, track_expression


@dataclass(frozen=True, eq=False)
class TaskEquations:
    """Equations of all tip tasks of a machine, stacked in one system; `bind` creates them.

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
    def target_size(self) -> int:
        """Number of target values of all tasks, stacked in one column."""
        return sum(part.target_size for part in self.bound)

    def by_row(self, value_of: Callable[[TipTask], Any]) -> Array:
        """Return for each task equation a value of the task to which the equation belongs. Shape (size, ...)."""
        return np.repeat([value_of(part.task) for part in self.bound], [part.task.size for part in self.bound], axis=0)

    @property
    def pose_rows(self) -> NDArray[np.bool_]:
        """Mask of the task equations that belong to pose tasks, not to velocity tasks. Shape (size,), bool."""
        return np.asarray(self.by_row(lambda task: task.is_pose), dtype=bool)

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """Mask (n,) of joints that move no task frame or reference frame; all False unless the base is fixed."""
        couplings = self.machine.robot.couplings
        fixed_base = isinstance(self.machine, FixedBase) and not isinstance(self.machine, Standing)
        idle = np.full(self.machine.joint_size, fixed_base)
        for robot in (tip.robot for part in self.bound for tip in (part.tip, part.reference) if tip is not None):
            idle[[couplings[joint.name].column for joint in robot.path_to(robot.tip_link) if joint.moves]] = False
        return idle

    def unit(self, pose: str = "/s", velocity: str = "/s") -> str:
        """Return the units of the task equations as a text, with given suffixes for pose and velocity tasks."""
        units: dict[str, None] = {}
        for task in (part.task for part in self.bound):
            tilt = ["rad"] if task.tilts else []
            kinds = [*tilt, *("rad" if row in ANGULAR else "m" for row in task.chosen)]
            units |= dict.fromkeys(kind + (pose if task.is_pose else velocity) for kind in kinds)
        return ", ".join(units)

    def targets(self, time: Any, pace: Any = 1) -> Any:
        """Return the targets of all tasks (poses and their velocities) as a column of expressions of the symbol `time`.

        For each task: the velocity in its rows; or, in its reference and as far as given, position and velocity (3, 3),
        rotation and angular velocity (9, 3), direction and angular velocity (3, 3). If `time` is a path parameter,
        `pace` is its rate, 1/s. Raises ProblemError if a track is invalid, see `track_expression`.
        """
        parts = []
        for task in (part.task for part in self.bound):

            def value_and_rate(
                name: str, *shapes: tuple[int, int], rates: Any = ((3, 1),), task: TipTask = task
            ) -> Any:
                """Return a target and the rate that its track states, or None."""
                track, begin = getattr(task, name), task.begin
                value, rate = track_expression(track, time, shapes, label=name, begin=begin), None
                if hasattr(track, "rate"):
                    rate = track_expression(track.rate, time, rates, label=f"{name} rate", begin=begin)
                return value, rate

            if task.velocity is not None:
                parts.append(pace * value_and_rate("velocity", (task.size, 1))[0])
            if task.position is not None:
                short = task.along_reference and len(task.linear) < 3
                shapes = ((3, 1), (len(task.linear), 1)) if short else ((3, 1),)
                value, rate = value_and_rate("position", *shapes, rates=shapes)
                value = _whole(task, value)
                parts += [value, pace * (_derivative(value, time) if rate is None else _whole(task, rate))]
            if task.orientation is not None:
                value, angular = value_and_rate("orientation", (4, 1), (3, 3))
                rotation = on_scalars(rotation_from_quaternion)(value) if value.shape == (4, 1) else value
                if angular is None:
                    angular = _angular_velocity(rotation, ca.reshape(_derivative(ca.vec(rotation), time), 3, 3))
                parts += [ca.vec(rotation), pace * angular]
            if task.direction is not None:
                value, rate = value_and_rate("direction", (3, 1))
                length = ca.norm_2(value)
                unit = value / length
                unit_rate = _derivative(unit, time) if rate is None else rate / length
                parts += [unit, pace * cross_product(unit, unit_rate)]
        return ca.densify(ca.vertcat(*parts))

    @on_scalars
    def jacobian(self, base: Any, joints: Any) -> Any:
        """Return the Jacobian J of all tasks with respect to the joint rates u. Shape (size, joint_size)."""
        rows = [
            part.rows(base, joints, part.relative(base, joints, lambda machine: machine.tip_jacobian(base, joints)))
            for part in self.bound
        ]
        symbolic = isinstance(base, ca.SX) or isinstance(joints, ca.SX)
        return ca.densify(ca.cse(ca.vertcat(*rows)) if symbolic else ca.vertcat(*rows))

    @on_scalars
    def right(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the right side b of the equation J u = b in joint rates u: task rates minus drift. Shape (size, 1)."""
        return -self.residual(base, joints, ca.DM(self.machine.joint_size, 1), targets)

    @on_scalars
    def residual(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """Return the residual J u - b of the task equation at joint rates u. Shape (size, 1)."""
        rows = []
        for part, target in self.by_task(targets):
            twist = part.twist(base, joints, rates)
            if part.task.is_pose:
                rows.append(part.rows(base, joints, twist - part.target_twist(base, joints, target)))
            else:
                rows.append(part.rows(base, joints, twist) - target)
        return ca.densify(ca.vertcat(*rows))

    @on_scalars
    def twist(self, base: Any, joints: Any, rates: Any) -> Any:
        """Return the tip velocities in the components that the tasks prescribe, rad/s and m/s. Shape (size, 1)."""
        rows = [part.rows(base, joints, part.twist(base, joints, rates)) for part in self.bound]
        return ca.densify(ca.vertcat(*rows))

    def deviations(self, base: Any, joints: Any, rates: Any, targets: Any) -> dict[str, dict[str, Any]]:
        """Return by name the deviations of the tips from their tasks, each as arguments of `Problem.watch`.

        The deviation of a pose task is its error, that of a velocity task the integral of its residual; each is judged
        relative to the path of the tip. A pose may deviate by the start gap of its task, which the feedback closes, and
        by its tolerance.
        """
        tolerances, gaps = self.tolerances, self.by_row(lambda task: task.start_gap)
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
        return np.asarray(np.where(self.turning, *self.by_row(lambda task: task.tolerance).T[::-1]))

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Mask of the angular equations among all task equations. Shape (size,), bool."""
        angular: list[bool] = []
        for task in (part.task for part in self.bound):
            angular += [*([True, True] if task.tilts else []), *(row in ANGULAR for row in task.chosen)]
        return np.array(angular, dtype=bool)

    def acceleration(self, base: Any, joints: Any, rates: Any, second: Any, *, progress: Sequence[Any]) -> Any:
        """Return the residual of the task equations for joint accelerations (n, 1), with feedback. Shape (size, 1).

        d/dt (J u - b) + gain (J u - b): the error of a pose decays as e'' + 2 gain e' + gain^2 e = 0. `progress` is the
        symbol of the time; or a path parameter, its pace, which is a symbol too, and the rate of the pace, 1/s^2.
        """
        time, pace, change = progress if len(progress) > 1 else (progress[0], 1, 0)
        residual = self.residual(base, joints, rates, self.targets(time, pace))
        symbols, rates_of = [joints, rates, time], [rates, second, 1]
        if self.machine.base_size:
            symbols, rates_of = [base, *symbols], [self.machine.base_rate(base, joints, rates), *rates_of]
        if isinstance(pace, ca.SX | ca.MX):
            symbols, rates_of = [*symbols, pace], [*rates_of[:-1], pace, change]
        gains = ca.sparsify(ca.DM(self.by_row(lambda task: float(task.gain))))
        return ca.jtimes(residual, ca.vertcat(*symbols), ca.vertcat(*rates_of)) + gains * residual

    @on_scalars
    def manipulability(self, base: Any, joints: Any) -> Any:
        """Return the manipulability sqrt(det(J J')) for the Jacobian J of all tasks (Yoshikawa 1985). Shape (1, 1)."""
        return manipulability_of(self.jacobian(base, joints))

    @on_scalars
    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return the pose errors (target minus pose) of all tasks, m and rad; 0 for velocity tasks. Shape (size, 1)."""
        rows = []
        for part, target in self.by_task(targets):
            if part.task.is_pose:
                rows.append(part.rows(base, joints, part.pose_error(base, joints, target)))
            else:
                rows.append(ca.DM(part.task.size, 1))
        return ca.densify(ca.vertcat(*rows))

    def gap(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """Return pose minus target for pose tasks, and the velocity residual for velocity tasks. Shape (size, 1)."""
        error, residual = self.error(base, joints, targets), self.residual(base, joints, rates, targets)
        return ca.vertcat(*((-error if is_pose else residual)[i] for i, is_pose in enumerate(self.pose_rows)))

    @on_scalars
    def pose_residual(self, base: Any, joints: Any, targets: Any) -> Any:
        """Return position errors, m, and rotation errors 2 sin(angle / 2), which are nonzero at half a turn.

        If all rotation is prescribed, the rotation errors (near zero the angle in rad) are the differences of the frame
        axes over sqrt 2, otherwise the rows of the half-angle vector. Velocity tasks have no entries. Shape (rows, 1).
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part, target in self.by_task(targets):
            task = part.task
            if not task.is_pose:
                continue
            position_target, rotation_target = part.split_targets(target)
            rotation = part.tip.tip_pose(base, joints).rotation
            error = part.pose_error(base, joints, target)
            if rotation_target is not None:
                goal = ca.mtimes(part.reference_pose(base, joints).rotation, rotation_target[0])
                if task.within is not None:
                    rows.append(ca.fmax(float(np.cos(task.within)) - part.cone_cosine(base, joints, target), 0))
                elif task.direction is not None:
                    rows.append(goal - ca.mtimes(rotation, ca.DM(task.tool_axis)))
                elif set(task.chosen) >= set(ANGULAR) or set(task.chosen) >= set(part.movable_angular_rows):
                    rows.append(ca.vec(goal - rotation) / np.sqrt(2))
                else:
                    cosine = (ca.trace(ca.mtimes(goal, rotation.T)) - 1) / 2
                    half = error[0:3] * ca.sqrt(2 / (1 + ca.fmax(cosine, -1 + 1e-9)))
                    angular = [i for i, row in enumerate(task.chosen) if row in ANGULAR]
                    rows.append(part.rows(base, joints, ca.vertcat(half, ca.DM(3, 1)))[angular])
            if position_target is not None:
                tilt = 2 if task.tilts else 0
                linear = [tilt + i for i, row in enumerate(task.chosen) if row not in ANGULAR]
                rows.append(part.rows(base, joints, ca.vertcat(ca.DM(3, 1), error[3:6]))[linear])
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
        cones = [(part, target) for part, target in self.by_task(targets) if part.task.within is not None]
        return ca.densify(ca.vertcat(ca.DM(0, 1), *[part.cone_cosine(base, joints, target) for part, target in cones]))

    @property
    def cone_angles(self) -> Array:
        """Half-angles, rad, of the cones in which tool axes must stay, one for each task with a cone. Shape (k,)."""
        return np.array([part.task.within for part in self.bound if part.task.within is not None], dtype=float)

    @on_scalars
    def reference_error(self, base: Any, joints: Any, at_base: Array, at_joints: Array) -> Any:
        """Return the pose errors (rows, 1) of the tips of velocity tasks from their poses in a given configuration."""
        rows: list[Any] = [ca.DM(0, 1)]
        for part in (part for part in self.bound if not part.task.is_pose):
            position, rotation = (ca.DM(value) for value in part.pose_in_reference(at_base, at_joints))
            pose = part._replace(task=replace(part.task, velocity=None, position=np.zeros(3), orientation=np.eye(3)))
            targets = ca.vertcat(position, ca.DM(3, 1), ca.vec(rotation), ca.DM(3, 1))
            rows.append(pose.rows(base, joints, pose.pose_error(base, joints, targets)))
        return ca.vertcat(*rows)

    def by_task(self, targets: Any) -> Iterator[tuple[BoundTask, Any]]:
        """Yield each task with its part of the stacked targets of all tasks."""
        at = 0
        for part in self.bound:
            yield part, targets[at : at + part.target_size]
            at += part.target_size

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
        cosines = np.array(self.cone_function.map(len(positions))(bases.T, positions.T, targets)[0]).T
        return np.asarray(np.maximum(np.arccos(np.clip(cosines, -1.0, 1.0)) - self.cone_angles, 0.0))

    @cached_property
    def cone_function(self) -> Any:
        """CasADi Function of base, joints, targets: `cone_cosines`, and their time derivatives per unit joint rate."""
        base, joints, targets = self._symbols
        cosines, rates = self.cone_cosines(base, joints, targets), ca.SX.sym("rates", self.machine.joint_size)
        slopes = ca.jacobian(cosines, joints)
        if self.machine.base_size:
            motion = ca.jacobian(self.machine.base_rate(base, joints, rates), rates)
            slopes += ca.mtimes(ca.jacobian(cosines, base), motion)
        return ca.Function("cones", [base, joints, targets], [cosines, ca.densify(slopes)], {"cse": True})

    @cached_property
    def function(self) -> Any:
        """CasADi Function from base, joints and targets to Jacobian J, right side b, pose error and pose residual."""
        symbols = self._symbols
        rows = [of_targets(*symbols) for of_targets in (self.right, self.error, self.pose_residual)]
        return ca.Function("task", symbols, [self.jacobian(*symbols[:2]), *rows], {"cse": True})

    @cached_property
    def pose_residual_function(self) -> Any:
        """CasADi Function from joints, base and targets to the pose residual and its Jacobian in the joints."""
        base, joints, targets = self._symbols
        residual = self.pose_residual(base, joints, targets)
        jacobian = ca.densify(ca.jacobian(residual, joints))
        return ca.Function("pose_residual", [joints, base, targets], [residual, jacobian], {"cse": True})

    @cached_property
    def jacobian_function(self) -> Any:
        """CasADi Function from joints and base to the Jacobian of all tasks with respect to the joint rates."""
        base, joints, _ = self._symbols
        return ca.Function("jacobian", [joints, base], [self.jacobian(base, joints)], {"cse": True})

    @property
    def _symbols(self) -> tuple[Any, ...]:
        """CasADi symbols for the base configuration, the joint positions and the targets."""
        sizes = {"base": self.machine.base_size, "joints": self.machine.joint_size, "targets": self.target_size}
        return tuple(ca.SX.sym(name, size) for name, size in sizes.items())

    def target_function(self) -> Any:
        """Return the targets of all tasks as a CasADi Function of time, in MX symbols if a target rejects SX."""

        def build(symbols: Any) -> Any:
            time = symbols.sym("time")
            return ca.Function("targets", [time], [self.targets(time)])

        return on_symbols(build)

    def cyclic_rows(self, base: Array, joints: Array) -> Array:
        """Return the combinations of task equations with zero integral over any cyclic motion. Shape (size, k).

        Closure follows from all holonomic rows on a fixed base; on a floating base from the combinations of rows that
        are independent of the base pose while the centre of mass stays.

        Raises:
            ProblemError: The momentum moves the centre of mass, and the joints cannot return.
        """
        holonomic = np.concatenate([part.is_holonomic for part in self.bound])
        directions = np.eye(self.size)[:, holonomic]
        if self.machine.base_size == 0:
            return directions
        if not isinstance(self.machine, FreeFloating):
            return np.zeros((self.size, 0))
        return directions @ base_independent_combinations(self.machine, self.bound, holonomic, base=base, joints=joints)


def _whole(task: TipTask, value: Any) -> Any:
    """Return a position target with all three coordinates; a coordinate that is not prescribed is 0. Shape (3, 1)."""
    if value.shape[0] == 3:
        return value
    whole = type(value)(3, 1)
    whole[task.linear] = value
    return ca.densify(whole)


def _derivative(value: Any, time: Any) -> Any:
    """Return the time derivative of an expression as a dense matrix, zero for a constant."""
    return ca.densify(ca.jacobian(value, time)) if isinstance(value, ca.SX | ca.MX) else ca.DM.zeros(*value.shape)


@on_scalars
def _angular_velocity(rotation: Any, rate: Any) -> Any:
    """Return the angular velocity in world axes from a rotation matrix and its derivative. Shape (3, 1)."""
    spin = ca.mtimes(rate, rotation.T)
    return ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2


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
        with problem_errors():
            tip = with_tip(machine, task.link, task.point) if task.link is not None else machine
            _ = tip.robot.tip_link
            reference = None if task.relative_to is None else with_tip(machine, task.relative_to)
        bound.append(BoundTask(task, tip, reference))
    return TaskEquations(bound[0].tip if machine.robot.tip is None else machine, tuple(bound))


def task_errors(
    machine: Machine, tasks: TipTask | Sequence[TipTask], t: Any, joints: Any, *, base: Any = None
) -> Array:
    """Return the pose errors of tasks at times (M,) of a motion, m and rad; 0 for velocities. Shape (M, rows)."""
    return bind(machine, tasks).errors(t, base, joints)
