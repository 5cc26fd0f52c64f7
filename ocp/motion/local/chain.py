"""Serial chain of joints from the world to a tip, with Newton's method for inverse kinematics.

At the zero configuration each joint k has an axis in the world, a unit screw xi_k. The pose of the tip is the product
of exponentials e_1 .. e_n H with e_k = exp(xi_k q_k) and the pose H at zero (Brockett 1984). A revolute screw satisfies
xi^3 = -xi and a prismatic one xi^2 = 0, so that e_k = 1 + s xi + v xi^2 with (s, v) = (sin q, 1 - cos q) or (q, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.checks import Array
from models.spatial import Frame, cross, expression, rotation
from ocp.problem.values import Sampler

TURN = 2 * np.pi  # angle of a full turn, rad


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of Newton's method for inverse kinematics; lengths are relative to the size of the arm."""

    steps: int = 30  # largest number of steps
    trial_steps: int = 5  # number of steps after which each one must make progress
    progress: float = 1.5  # factor by which a step then reduces the error; near a double root it is 4
    precision: float = 1e-13  # pose error at which the iteration ends, also in rad
    exact: float = 1e-10  # largest pose error of a solution, also in rad
    rough: float = 0.5  # pose error above which a candidate is dropped, also in rad
    largest_step: float = 1.0  # largest change of a joint in a step, rad or m
    damping: float = 1e-14  # added to the squared singular values of the Jacobian: finite at singularities
    singular: float = 1e-5  # least singular value of a regular solution; below it a further one may be hidden
    same: float = 1e-7  # distance below which two solutions count as one, rad or m
    near: float = 1e-2  # distance up to which two solutions count as one if the pose is exact halfway between them


NEWTON = NewtonSettings()


class Motion(NamedTuple):
    """Set of M rigid motions, given by rotation matrices `turn` (M, 3, 3) and translations `shift` (M, 3)."""

    turn: Array
    shift: Array

    def take(self, chosen: NDArray[np.intp]) -> Motion:
        """Return the subset of the rigid motions that has the given indices."""
        return Motion(self.turn[chosen], self.shift[chosen])

    def after(self, first: Motion) -> Motion:
        """Return the rigid motions that result if the motions `first` are applied before the motions of this set."""
        return Motion(self.turn @ first.turn, self.at(first.shift))

    def rotate(self, vectors: Array) -> Array:
        """Return M directions, shape (M, 3), each rotated by the rigid motion with the same index."""
        return np.asarray((self.turn @ vectors[:, :, None])[:, :, 0])

    def at(self, points: Array) -> Array:
        """Return M points, shape (M, 3), each moved by the rigid motion with the same index."""
        return self.rotate(points) + self.shift

    @property
    def inverse(self) -> Motion:
        """Inverses of the rigid motions."""
        turn = self.turn.transpose(0, 2, 1)
        return Motion(turn, -(turn @ self.shift[:, :, None])[:, :, 0])


class SymbolicAxis(NamedTuple):
    """Axis of a joint as CasADi expressions: its unit direction and a point on it. Shapes (3, 1)."""

    direction: Any
    point: Any
    revolute: bool

    def moved(self, motion: Frame) -> SymbolicAxis:
        """Return the axis transformed by a rigid motion."""
        return self._replace(direction=ca.mtimes(motion.rotation, self.direction), point=motion.point(self.point))

    def frame(self, position: Any) -> Frame:
        """Return the rigid motion that a joint position causes: a rotation about the axis or, if prismatic, a shift."""
        if not self.revolute:
            return Frame(ca.DM.eye(3), self.direction * position)
        turn = rotation(self.direction, position)
        return Frame(turn, self.point - ca.mtimes(turn, self.point))

    def angle(self, start: Any, end: Any) -> Any:
        """Return the angle of the rotation about the axis that turns one vector towards another, rad."""
        across = start - ca.dot(start, self.direction) * self.direction
        return ca.atan2(ca.dot(self.direction, cross(across, end)), ca.dot(across, end))

    def terms(self, fixed: Any, vector: Any, sign: int = 1) -> Any:
        """Return coefficients (1, 3) of 1, cos q, sin q in dot(`fixed`, `vector` turned about the axis by `sign` q)."""
        constant = ca.dot(fixed, self.direction) * ca.dot(self.direction, vector)
        sine = sign * ca.dot(fixed, cross(self.direction, vector))
        return ca.horzcat(constant, ca.dot(fixed, vector) - constant, sine)


def compose(first: Frame, second: Frame) -> Frame:
    """Return the composition of two rigid motions, of which the second is applied first."""
    return Frame(ca.mtimes(first.rotation, second.rotation), first.point(second.position))


def inverse(frame: Frame) -> Frame:
    """Return the inverse of a rigid motion."""
    return Frame(frame.rotation.T, -ca.mtimes(frame.rotation.T, frame.position))


class Solutions(NamedTuple):
    """Solutions of the inverse kinematics of an arm at M poses of its tip."""

    pose: NDArray[np.intp]  # index of the pose of each solution, (K,)
    joints: Array  # (K, n), those of revolute free joints between -pi and pi
    singular: NDArray[np.bool_]  # which solutions are so near a singularity that others may hide there, (K,)

    @classmethod
    def none(cls, size: int) -> Solutions:
        """Return an empty set of solutions for an arm with `size` joints."""
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, size)), np.zeros(0, dtype=bool))


@dataclass(frozen=True, eq=False)
class Chain:
    """Serial chain of an arm: its joint axes at the zero configuration, in world coordinates."""

    axes: Array  # directions of the axes of all joints, (n, 3)
    points: Array  # points on these axes, (n, 3), m
    revolute: NDArray[np.bool_]  # which joints are revolute; the others are prismatic, (n,)
    position: Array  # of the tip, (3,), m
    rotation: Array  # of the tip, (3, 3)
    order: tuple[int, ...]  # indices of the joints that move the tip, from the base to the tip
    size: float  # largest distance of an axis from the tip, m

    @classmethod
    def of(cls, machine: Machine) -> Chain | None:
        """Return the serial chain from world to tip of a machine; None if the base moves or a joint mimics another."""
        robot = machine.robot
        path = () if robot.tip is None else [joint for joint in robot.path_to(robot.tip_link) if joint.moves]
        if machine.base_size or any(joint.mimic is not None for joint in path):
            return None
        zero = ca.DM(machine.joint_size, 1)
        pose, jacobian = machine.tip_pose((), zero), np.array(ca.DM(machine.tip_jacobian((), zero)))
        position = np.array(ca.DM(pose.position)).ravel()
        angular, linear = jacobian[:3].T, jacobian[3:].T
        revolute = np.linalg.norm(angular, axis=1) > 0.5  # it is one or zero
        axes = np.where(revolute[:, None], angular, linear)
        points = np.where(revolute[:, None], position + np.cross(angular, linear), position)
        order = tuple(robot.joint_names.index(joint.name) for joint in path)
        size = max(float(np.linalg.norm(points[list(order)] - position, axis=1).max(initial=0.0)), 1e-3)
        return cls(axes, points, revolute, position, np.array(ca.DM(pose.rotation)), order, size)

    def extend(self, axes: Array, points: Array) -> Chain:
        """Return the chain with k further revolute joints before the tip, given by axes and points on them (k, 3)."""
        n, count = len(self.axes), len(axes)
        return replace(
            self,
            axes=np.concatenate([self.axes, axes]),
            points=np.concatenate([self.points, points]),
            revolute=np.concatenate([self.revolute, np.ones(count, dtype=bool)]),
            order=(*self.order, *range(n, n + count)),
        )

    @cached_property
    def home(self) -> Frame:
        """Pose of the tip at the zero configuration, as constant CasADi expressions."""
        return Frame(expression(self.rotation), expression(self.position))

    @cached_property
    def _tip_function(self) -> Sampler:
        """Function of joint positions and a goal pose that returns pose error, Jacobian and pose of the tip."""
        joints, turn, shift = ca.SX.sym("q", len(self.axes)), ca.SX.sym("turn", 9), ca.SX.sym("shift", 3)
        frame, moved = Frame(ca.DM.eye(3), ca.DM(3, 1)), list[SymbolicAxis]()
        for j in self.order:
            axis = SymbolicAxis(expression(self.axes[j]), expression(self.points[j]), bool(self.revolute[j]))
            moved.append(axis.moved(frame))
            frame = compose(frame, axis.frame(joints[j]))
        tip = compose(frame, self.home)
        columns = [
            ca.vertcat(axis.direction, cross(axis.direction, tip.position - axis.point) / self.size)
            if axis.revolute
            else ca.vertcat(ca.DM(3, 1), axis.direction / self.size)
            for axis in moved
        ]
        error = ca.mtimes(ca.reshape(turn, 3, 3).T, tip.rotation.T)
        axial = ca.if_else(ca.trace(error) < 1, 3.0, ca.inv_skew(error))
        errors = ca.vertcat(axial, (shift - tip.position) / self.size)
        outputs = [errors, ca.horzcat(*columns), tip.position, tip.rotation.T]  # rotations row by row
        return Sampler([joints, turn, shift], outputs)

    def poses(self, joints: Array) -> tuple[Array, Array]:
        """Return positions (K, 3) and rotations (K, 3, 3) of the tip at joint positions (K, n)."""
        _, _, positions, rotations = self._tip_function(joints, np.zeros(9), np.zeros(3))
        return positions, rotations.reshape(-1, 3, 3)

    def random_configurations(self, count: int, seed: int) -> tuple[Array, Motion]:
        """Return random configurations (count, n) and tip poses; joints are within +-pi rad or +- the arm's size, m."""
        joints = np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, len(self.axes)))
        joints[:, ~self.revolute] *= self.size / np.pi
        positions, rotations = self.poses(joints)
        return joints, Motion(rotations, positions)

    def linearize(self, joints: Array, goal: Motion, free: Sequence[int]) -> tuple[Array, Array]:
        """Return pose errors (K, 6) at joint positions (K, n), and Jacobians (K, 6, m) with respect to the free joints.

        The errors are the rotation as the axial vector 2 sin(angle) / 2, or (3, 3, 3) beyond a right angle, and the
        displacement as a share of the size of the arm.
        """
        errors, jacobians, _, _ = self._tip_function(joints, goal.turn.reshape(-1, 9), goal.shift)
        jacobians = jacobians.reshape(len(joints), len(self.order), 6)
        if tuple(free) != self.order:
            jacobians = jacobians[:, [self.order.index(j) for j in free]]
        return errors, jacobians.transpose(0, 2, 1)

    def refine(self, pose: NDArray[np.intp], joints: Array, free: Sequence[int], goal: Motion) -> Solutions:
        """Refine rough IK solutions `joints` (K, n), of the goal poses with index `pose` (K,), by Newton's method in
        the free joints; return the distinct solutions.
        """
        joints, numbers = joints.copy(), np.array(free, dtype=int)
        error, jacobians = np.full(len(joints), np.inf), np.zeros((len(joints), 6, len(numbers)))
        active = np.arange(len(joints))
        for step in range(NEWTON.steps + 1):
            pose_errors, jacobian = self.linearize(joints[active], goal.take(pose[active]), free)
            worst, previous = np.abs(pose_errors).max(axis=1), error[active]
            error[active], jacobians[active] = worst, jacobian
            # a solution at the limit of rounding no longer improves
            on = (worst > NEWTON.precision) & (worst < (NEWTON.rough if step == 0 else np.inf))
            on &= (worst > NEWTON.exact) | (worst < previous / 2)
            on &= (worst < previous / NEWTON.progress) | (step < NEWTON.trial_steps)
            if step == NEWTON.steps or not on.any():
                break
            active, change = active[on], _damped_steps(jacobian[on], pose_errors[on])
            joints[active[:, None], numbers] += np.clip(change, -NEWTON.largest_step, NEWTON.largest_step)
        good = error <= NEWTON.exact
        return self.distinct(Solutions(pose[good], joints[good], _are_singular(jacobians[good])), free, goal)

    def union(self, first: Solutions, second: Solutions, free: Sequence[int], goal: Motion) -> Solutions:
        """Return the union of two sets of IK solutions, in which no solution occurs twice."""
        if not len(first.pose):
            return second
        parts = (np.concatenate(pair) for pair in zip(first, second, strict=True))
        return self.distinct(Solutions(*parts), free, goal)

    def distinct(self, solutions: Solutions, numbers: Sequence[int], goal: Motion) -> Solutions:
        """Return the IK solutions of goal poses, ordered by pose, with angles from -pi to pi and without duplicates,
        which agree in the joints with given indices.
        """
        pose, joints, singular = solutions
        free = np.array(numbers, dtype=int)
        turns = free[self.revolute[free]]
        joints[:, turns] -= TURN * np.round(joints[:, turns] / TURN)
        order = np.argsort(pose, kind="stable")
        pose, joints, singular = pose[order], joints[order], singular[order]
        first, second = _pairs_of_one_pose(pose)
        difference = joints[second] - joints[first]
        difference[:, turns] -= TURN * np.round(difference[:, turns] / TURN)
        distance = np.abs(difference[:, free]).max(axis=1, initial=0.0)
        same = distance < NEWTON.same
        if (close := np.flatnonzero(~same & (distance < NEWTON.near))).size:
            middle = joints[first[close]] + difference[close] / 2
            pose_errors, _ = self.linearize(middle, goal.take(pose[first[close]]), numbers)
            same[close] = np.abs(pose_errors).max(axis=1) <= NEWTON.exact
        kept = np.ones(len(pose), dtype=bool)
        kept[second[same]] = False
        return Solutions(pose[kept], joints[kept], singular[kept])


def _pairs_of_one_pose(pose: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices (P,) of both members of all pairs of IK solutions that belong to the same pose."""
    if not len(pose) or pose[0] == pose[-1]:
        return np.triu_indices(len(pose), 1)
    first = np.arange(len(pose))[:, None]
    second = first + np.arange(1, int(np.bincount(pose).max()))
    same_pose = second < len(pose)
    second = np.minimum(second, len(pose) - 1)
    first, second = (part[same_pose & (pose[first] == pose[second])] for part in np.broadcast_arrays(first, second))
    return first, second


def _damped_steps(jacobian: Array, pose_errors: Array) -> Array:
    """Return the joint steps (K, m) of Newton's method for pose errors (K, 6), damped at singularities."""
    transposed = jacobian.transpose(0, 2, 1)
    normal = transposed @ jacobian + NEWTON.damping * np.eye(jacobian.shape[2])
    return np.asarray(np.linalg.solve(normal, transposed @ pose_errors[:, :, None])[:, :, 0])


def _are_singular(jacobians: Array) -> NDArray[np.bool_]:
    """Return which of the Jacobians (K, 6, m) have a least singular value near zero."""
    singular = np.ones(len(jacobians), dtype=bool)
    # the other five singular values have a product of at most (|J|^2 / 5)^(5 / 2): the determinant shows most regular J
    if jacobians.shape[2] == 6:
        largest = ((jacobians**2).sum(axis=(1, 2)) / 5) ** 2.5
        singular = np.abs(np.linalg.det(jacobians)) < NEWTON.singular * largest
    if singular.any():
        values = np.linalg.svd(jacobians[singular], compute_uv=False)
        singular[singular] = values[:, -1] < NEWTON.singular
    return singular
