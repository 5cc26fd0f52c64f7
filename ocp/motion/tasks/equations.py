"""Tasks of a machine's tips as equations of its joint rates, J u = b, the drift and the feedback in b, or of their
derivatives, J u' = c, which are the same equations differentiated along the motion.

Everything that depends on the time alone is the column of targets; everything else is a function of configuration and
targets, written element by element on SX symbols.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FixedBase, FreeFloating, Machine, ModelError, Robot, Standing
from models.arrays import Array
from models.machines.machine import with_tip
from models.robot.indices import manipulability_of
from models.spatial import on_scalars
from ocp.errors import ProblemError, checked_each
from ocp.motion.tasks.geometry import (
    Bound,
    angular_velocity,
    closing_combinations,
    cross_product,
    derivative,
    held_task,
    holding_rows,
    is_holonomic,
    pose_error,
    pose_in_reference,
    reference_pose,
    relative_twist,
    rotation_of,
    rows_of,
    split_targets,
    target_size,
    turning_rows,
    wanted_twist,
)
from ocp.motion.tasks.tip_task import ANGULAR, TipTask
from ocp.motion.tasks.tracks import on_symbols, track_expression

__all__ = ["TaskEquations", "bind", "task_errors"]


@dataclass(frozen=True, eq=False)
class TaskEquations:
    """The stacked equations of some tasks of a machine. Make it with `bind`.

    Attributes:
        machine: The machine.
        bound: Its tasks.
        size: Number of rows of all tasks.
    """

    machine: Machine
    bound: tuple[Bound, ...]

    @property
    def size(self) -> int:
        return sum(part.task.size for part in self.bound)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Which rows are of poses. Shape (size,), bool."""
        return np.repeat([part.task.is_pose for part in self.bound], [part.task.size for part in self.bound])

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """Which joints move neither the frame of a task nor its reference, as the tree says. Shape (joint_size,).

        None of a machine whose base floats or that has to keep its balance: there every joint counts.
        """
        drives = self.machine.robot.couplings
        alone = isinstance(self.machine, FixedBase) and not isinstance(self.machine, Standing)
        idle = np.full(self.machine.joint_size, alone)
        for robot in (tip.robot for part in self.bound for tip in (part.tip, part.reference) if tip is not None):
            idle[[drives[joint.name].column for joint in robot.path_to(robot.tip_link) if joint.moves]] = False
        return idle

    def unit(self, pose: str = "/s", velocity: str = "/s") -> str:
        """Units of the rows, "rad/s, m/s" of `residual`: rad of turning and m of places, with what they are taken per.

        Args:
            pose, velocity: Of the rows of poses and of those of velocities: "" for `error`, "/s^2" for `acceleration`.
        """
        found: dict[str, None] = {}
        for task in (part.task for part in self.bound):
            tilt = ["rad"] if task.tilts else []
            kinds = [*tilt, *("rad" if row in ANGULAR else "m" for row in task.chosen)]
            found |= dict.fromkeys(kind + (pose if task.is_pose else velocity) for kind in kinds)
        return ", ".join(found)

    def targets(self, time: Any, pace: Any = 1) -> Any:
        """What the tasks ask at a time, a column of expressions of the symbol `time`.

        For each task: the velocity in its rows; or position and velocity (3, 3), rotation and angular velocity (9, 3),
        direction and angular velocity (3, 3), as far as given, in its reference.

        Args:
            time: The symbol that the tracks are functions of: the time, s, or a path parameter.
            pace: Its rate, 1/s, where it is a path parameter.

        Raises:
            ProblemError: Wrong sizes, not finite, or an expression of anything but the time.
        """
        parts = []
        for task in (part.task for part in self.bound):
            if task.velocity is not None:
                parts.append(pace * track_expression(task.velocity, time, (task.size, 1), "velocity", task.begin))
            if task.position is not None:
                value = _whole(task, task.position, time, "position")
                rate = getattr(task.position, "rate", None)
                given = derivative(value, time) if rate is None else _whole(task, rate, time, "position rate")
                parts += [value, pace * given]
            if task.orientation is not None:
                value = track_expression(task.orientation, time, ((4, 1), (3, 3)), "orientation", task.begin)
                turn = rotation_of(value) if value.shape == (4, 1) else value
                rate = getattr(task.orientation, "rate", None)
                if rate is None:
                    spin = angular_velocity(turn, ca.reshape(derivative(ca.vec(turn), time), 3, 3))
                else:
                    spin = track_expression(rate, time, (3, 1), "orientation rate", task.begin)
                parts += [ca.vec(turn), pace * spin]
            if task.direction is not None:
                value = track_expression(task.direction, time, (3, 1), "direction", task.begin)
                length = ca.norm_2(value)
                unit, rate = value / length, getattr(task.direction, "rate", None)
                if rate is None:
                    change = derivative(unit, time)
                else:
                    change = track_expression(rate, time, (3, 1), "direction rate", task.begin) / length
                parts += [unit, pace * cross_product(unit, change)]
        return ca.densify(ca.vertcat(*parts))

    @on_scalars
    def jacobian(self, base: Any, joints: Any) -> Any:
        """J, shape (size, joint_size)."""
        rows = []
        for part in self.bound:
            relative = relative_twist(part, base, joints, part.tip.tip_jacobian(base, joints), None)
            rows.append(rows_of(part, base, joints, relative))
        return ca.densify(ca.cse(ca.vertcat(*rows)) if _is_symbolic(base, joints) else ca.vertcat(*rows))

    @on_scalars
    def right(self, base: Any, joints: Any, targets: Any) -> Any:
        """b: what the joint rates have to add to the drift so that the tasks are done. Shape (size, 1)."""
        return -self.residual(base, joints, ca.DM(self.machine.joint_size, 1), targets)

    @on_scalars
    def residual(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """J u - b. Shape (size, 1)."""
        rows = []
        for part, wanted in self._with_targets(targets):
            twist = relative_twist(part, base, joints, part.tip.tip_twist(base, joints, rates), rates)
            if part.task.velocity is not None:
                rows.append(rows_of(part, base, joints, twist) - wanted)
            else:
                rows.append(rows_of(part, base, joints, twist - wanted_twist(part, base, joints, wanted)))
        return ca.densify(ca.vertcat(*rows))

    @on_scalars
    def twist(self, base: Any, joints: Any, rates: Any) -> Any:
        """What the tips do in the rows of the tasks, rad/s and m/s. Shape (size, 1)."""
        rows = []
        for part in self.bound:
            moving = relative_twist(part, base, joints, part.tip.tip_twist(base, joints, rates), rates)
            rows.append(rows_of(part, base, joints, moving))
        return ca.densify(ca.vertcat(*rows))

    def strays(self, base: Any, joints: Any, rates: Any, targets: Any) -> dict[str, dict[str, Any]]:
        """How far the tips stray from their tasks, to be watched: arguments of `Problem.watch` by name.

        Errors of poses, "task position" and "task orientation"; of velocities the integral of what they are missed by,
        "task way" and "task turn"; each judged by the way of the tips. Where a task is held as an equation of
        velocities or accelerations, errors too small for that equation may add up. A pose may be off by the gap at the
        start that its task allows, which the feedback closes, and by the tolerance of its task.
        """
        tolerances = self.tolerances
        gaps = np.repeat([part.task.start_gap for part in self.bound], [part.task.size for part in self.bound])
        gaps = np.where(gaps > TipTask.start_gap, gaps, 0.0)  # no more than the default is no gap
        error, missed = self.error(base, joints, targets), self.residual(base, joints, rates, targets)
        moving, found = self.twist(base, joints, rates), dict[str, dict[str, Any]]()
        for posed, turning, name, unit in (
            (True, False, "task position", "m"),
            (True, True, "task orientation", "rad"),
            (False, False, "task way", "m"),
            (False, True, "task turn", "rad"),
        ):
            rows = np.flatnonzero((self.posed == posed) & (self.turning == turning)).tolist()
            if rows:
                what = (error if posed else missed)[rows]
                off = gaps[rows] if posed else 0.0
                bounds = {"lower": -off, "upper": off, "integral": not posed, "unit": unit}
                allowed = tolerances[rows] if posed else None
                found[name] = {"expression": what, "way": moving[rows], "tolerance": allowed, **bounds}
        return found

    @property
    def tolerances(self) -> Array:
        """By how much each row may be missed, m and rad. Shape (size,)."""
        pairs = np.repeat([part.task.tolerance for part in self.bound], [part.task.size for part in self.bound], axis=0)
        return np.asarray(np.where(self.turning, *pairs.T[::-1]))

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Which rows turn, rather than move. Shape (size,), bool."""
        found: list[bool] = []
        for task in (part.task for part in self.bound):
            found += [*([True, True] if task.tilts else []), *(row in ANGULAR for row in task.chosen)]
        return np.array(found, dtype=bool)

    def acceleration(
        self, base: Any, joints: Any, rates: Any, second: Any, time: Any, pace: Any = 1, change: Any = 0
    ) -> Any:
        """J u' - c, by differentiating `residual` along the motion, with the feedback of its own. Shape (size, 1).

        d/dt (J u - b) + gain (J u - b): the error of a pose decays as e'' + 2 gain e' + gain^2 e = 0.

        Args:
            base, joints, rates: Symbols.
            second: Joint accelerations u', (joint_size, 1).
            time, pace: As of `targets`; a pace other than 1 is a symbol too.
            change: Rate of the pace, 1/s^2.
        """
        residual = self.residual(base, joints, rates, self.targets(time, pace))
        at, moving = [joints, rates, time], [rates, second, 1]
        if self.machine.base_size:
            at, moving = [base, *at], [self.machine.base_rate(base, joints, rates), *moving]
        if isinstance(pace, ca.SX | ca.MX):
            at, moving = [*at, pace], [*moving[:-1], pace, change]
        gains = np.repeat([float(part.task.gain) for part in self.bound], [part.task.size for part in self.bound])
        return ca.jtimes(residual, ca.vertcat(*at), ca.vertcat(*moving)) + ca.sparsify(ca.DM(gains)) * residual

    @on_scalars
    def manipulability(self, base: Any, joints: Any) -> Any:
        """sqrt(det(J J')) of the rows of all tasks (Yoshikawa 1985). Shape (1, 1)."""
        return manipulability_of(self.jacobian(base, joints))

    @on_scalars
    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        """Pose wanted less pose found, in the tasks' rows, m and rad; zero for velocities. Shape (size, 1)."""
        rows = []
        for part, wanted in self._with_targets(targets):
            if part.task.velocity is not None:
                rows.append(ca.DM(part.task.size, 1))
            else:
                rows.append(rows_of(part, base, joints, pose_error(part, base, joints, wanted)))
        return ca.densify(ca.vertcat(*rows))

    def gap(self, base: Any, joints: Any, rates: Any, targets: Any) -> Any:
        """Pose found less pose wanted in the rows of poses, `residual` in those of velocities. Shape (size, 1)."""
        error, residual = self.error(base, joints, targets), self.residual(base, joints, rates, targets)
        return ca.vertcat(*((-error if posed else residual)[i] for i, posed in enumerate(self.posed)))

    @on_scalars
    def misfit(self, base: Any, joints: Any, targets: Any) -> Any:
        """Distance from the poses, one column, without the zeros that `error` has half a turn away.

        m, and chords of the unit circle (2 sin(angle / 2), near zero the angle in rad): for all turning of a frame the
        differences of its axes over sqrt 2, for some rows of it those of the half-angle vector. Velocities have none.
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part, wanted in self._with_targets(targets):
            task = part.task
            if not task.is_pose:
                continue
            place, turning = split_targets(task, wanted)
            reference = reference_pose(part, base, joints)
            turn = part.tip.tip_pose(base, joints).rotation
            error = pose_error(part, base, joints, wanted)
            if turning is not None:
                goal = turning[0] if reference is None else ca.mtimes(reference.rotation, turning[0])
                if task.within is not None:
                    rows.append(ca.fmax(float(np.cos(task.within)) - self._cosine(part, base, joints, wanted), 0))
                elif task.direction is not None:
                    rows.append(goal - ca.mtimes(turn, ca.DM(task.tool_axis)))
                elif set(task.chosen) >= set(ANGULAR) or set(task.chosen) >= set(turning_rows(part)):
                    rows.append(ca.vec(goal - turn) / np.sqrt(2))
                else:
                    cosine = (ca.trace(ca.mtimes(goal, turn.T)) - 1) / 2
                    half = error[0:3] * ca.sqrt(2 / (1 + ca.fmax(cosine, -1 + 1e-9)))
                    angular = [i for i, row in enumerate(task.chosen) if row in ANGULAR]
                    rows.append(rows_of(part, base, joints, ca.vertcat(half, ca.DM(3, 1)))[angular])
            if place is not None:
                tilt = 2 if task.tilts else 0
                linear = [tilt + i for i, row in enumerate(task.chosen) if row not in ANGULAR]
                rows.append(rows_of(part, base, joints, ca.vertcat(ca.DM(3, 1), error[3:6]))[linear])
        return ca.densify(ca.vertcat(*rows))

    @on_scalars
    def leans(self, base: Any, joints: Any, targets: Any) -> Any:
        """Cosines of the angles by which tool axes lean from their directions, of the tasks that let them.

        Shape (number of tasks with `within`, 1).
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part, wanted in self._with_targets(targets):
            if part.task.within is not None:
                rows.append(self._cosine(part, base, joints, wanted))
        return ca.densify(ca.vertcat(*rows))

    @property
    def most_lean(self) -> Array:
        """Angles that the tool axes of `leans` may lean, rad. Shape as of `leans`, (k,)."""
        return np.array([part.task.within for part in self.bound if part.task.within is not None], dtype=float)

    def _cosine(self, part: Bound, base: Any, joints: Any, wanted: Any) -> Any:
        """Of the angle between a task's tool axis and its direction."""
        _, turning = split_targets(part.task, wanted)
        reference = reference_pose(part, base, joints)
        goal = turning[0] if reference is None else ca.mtimes(reference.rotation, turning[0])
        return ca.dot(goal, ca.mtimes(part.tip.tip_pose(base, joints).rotation, ca.DM(part.task.tool_axis)))

    def holding(self, base: Any, joints: Any, at_base: Array, at_joints: Array) -> Any:
        """Pose at (at_base, at_joints) less pose at (base, joints), in the rows of the velocity tasks.

        Shape (rows of all velocity tasks, 1). For a start that is free but for the pose of its task.
        """
        rows: list[Any] = [ca.DM(0, 1)]
        for part in self.bound:
            if part.task.velocity is not None:
                position, turn = (ca.DM(value) for value in pose_in_reference(part, at_base, at_joints))
                held = part._replace(task=held_task(part.task))
                targets = ca.vertcat(position, ca.DM(3, 1), ca.vec(turn), ca.DM(3, 1))
                rows.append(holding_rows(held, base, joints, targets))
        return ca.vertcat(*rows)

    def _with_targets(self, targets: Any) -> Iterator[tuple[Bound, Any]]:
        at = 0
        for part in self.bound:
            size = target_size(part.task)
            yield part, targets[at : at + size]
            at += size

    def errors(self, t: Any, base: Any, joints: Any) -> Array:
        """As `task_errors`. Shape (M, size)."""
        place, angles, targets = self._along(t, base, joints)
        count = len(angles)
        return np.array(self.function().map(count)(place.T, angles.T, targets)[2]).reshape(-1, count).T

    def _along(self, t: Any, base: Any, joints: Any) -> tuple[Array, Array, Any]:
        """Base (M, base_size), joints (M, joint_size) and targets, one column each, along a motion."""
        times, angles = np.atleast_1d(np.asarray(t, dtype=float)), np.atleast_2d(np.asarray(joints, dtype=float))
        place = np.zeros((len(times), 0)) if base is None else np.atleast_2d(np.asarray(base, dtype=float))
        return place, angles, self.target_function().map(len(times))(times[None, :])

    def overhangs(self, t: Any, base: Any, joints: Any) -> Array:
        """Angles by which tool axes lean further than they may, rad, arguments as of `errors`. Shape (M, k)."""
        place, angles, targets = self._along(t, base, joints)
        if not self.most_lean.size:
            return np.zeros((len(angles), 0))
        cosines = np.array(self._lean_function.map(len(angles))(place.T, angles.T, targets)).T
        return np.asarray(np.maximum(np.arccos(np.clip(cosines, -1.0, 1.0)) - self.most_lean, 0.0))

    @cached_property
    def _lean_function(self) -> Any:
        base, joints, targets = self._symbols
        return ca.Function("leans", [base, joints, targets], [self.leans(base, joints, targets)], {"cse": True})

    def function(self) -> Any:
        """Casadi Function (base, joints, targets) -> (J, b, error, misfit)."""
        return self._function

    @cached_property
    def _function(self) -> Any:
        base, joints, targets = self._symbols
        parts = [self.jacobian(base, joints)]
        parts += [what(base, joints, targets) for what in (self.right, self.error, self.misfit)]
        return ca.Function("task", [base, joints, targets], parts, {"cse": True})

    @cached_property
    def misfit_function(self) -> Any:
        """Casadi Function (joints, base, targets) -> (misfit, its Jacobian by the joints)."""
        base, joints, targets = self._symbols
        misfit = self.misfit(base, joints, targets)
        slopes = ca.densify(ca.jacobian(misfit, joints))
        return ca.Function("misfit", [joints, base, targets], [misfit, slopes], {"cse": True})

    @cached_property
    def jacobian_function(self) -> Any:
        """Casadi Function (joints, base) -> J."""
        base, joints, _ = self._symbols
        return ca.Function("jacobian", [joints, base], [self.jacobian(base, joints)], {"cse": True})

    @property
    def _symbols(self) -> tuple[Any, Any, Any]:
        """Of base, joints and targets."""
        base, joints = ca.SX.sym("base", self.machine.base_size), ca.SX.sym("joints", self.machine.joint_size)
        return base, joints, ca.SX.sym("targets", sum(target_size(part.task) for part in self.bound))

    def target_function(self) -> Any:
        """Casadi Function time -> targets, on MX symbols where a track needs them."""

        def made(symbols: Any) -> Any:
            time = symbols.sym("time")
            return ca.Function("targets", [time], [self.targets(time)])

        return on_symbols(made)

    def closing(self, base: Array, joints: Array) -> Array:
        """Directions of the task rows that a closed task closes without the joints returning. Shape (size, k).

        Where the joints return to where they were after a closed task, some of these conditions follow from the task:
        all of its rows on a fixed base; on a floating one, as many combinations of the rows as do not depend on the
        pose of the base, given that the centre of mass stays. Rows whose integral depends on the way do not count.

        Raises:
            ProblemError: The centre of mass moves, and the joints cannot return.
        """
        chosen = np.concatenate([is_holonomic(part) for part in self.bound])
        if self.machine.base_size == 0:
            return np.eye(self.size)[:, chosen]
        found = np.zeros((self.size, 0))
        if isinstance(self.machine, FreeFloating):
            closes = closing_combinations(self.machine, self.bound, chosen, base, joints)
            found = np.zeros((self.size, closes.shape[1]))
            found[chosen] = closes
        return found


def _whole(task: TipTask, track: Any, time: Any, what: str) -> Any:
    """A track of positions with all three coordinates, zero where the task leaves them out. Shape (3, 1)."""
    short = task.along_reference and len(task.linear) < 3
    shapes = ((3, 1), (len(task.linear), 1)) if short else ((3, 1),)
    value = track_expression(track, time, shapes, what, task.begin)
    if value.shape[0] == 3:
        return value
    whole = type(value)(3, 1)
    whole[task.linear] = value
    return ca.densify(whole)


def bind(machine: Machine, tasks: TipTask | Sequence[TipTask]) -> TaskEquations:
    """The equations of a task, or of several stacked, for a machine.

    That of the equations has the frame of the first task for its tip where the robot has none.

    Raises:
        ProblemError: No machine, no task, something else than a task, an unknown link, a task of the tip of a robot
            that has none.
    """
    if isinstance(machine, type) or not isinstance(getattr(machine, "robot", None), Robot):
        words = f"machine must be a FixedBase(robot), FreeFloating(robot) or Standing(robot, ...), not {machine!r}"
        raise ProblemError(words, name="machine", value=machine)
    listed = (tasks,) if isinstance(tasks, TipTask) else checked_each("task", tasks, TipTask)
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
        bound.append(Bound(task, tip, reference))
    return TaskEquations(bound[0].tip if machine.robot.tip is None else machine, tuple(bound))


def task_errors(machine: Machine, tasks: TipTask | Sequence[TipTask], t: Any, base: Any, joints: Any) -> Array:
    """Pose wanted less pose found along a motion, in the rows of the tasks, m and rad; zero for velocities.

    Args:
        t: Times, s. Shape (M,).
        base: Shape (M, base_size), or None on a fixed base.
        joints: Shape (M, joint_size).

    Returns:
        Shape (M, rows of all tasks).
    """
    return bind(machine, tasks).errors(t, base, joints)


def _is_symbolic(*values: Any) -> bool:
    return any(isinstance(value, ca.SX) for value in values)
