"""The serial chain from the world to a tip: its joint axes, and Newton's method to whole poses of the tip.

At the zero configuration each joint k has an axis in the world, a unit screw xi_k. The pose of the tip is the product
of exponentials e_1 .. e_n H with e_k = exp(xi_k q_k) and the pose H at zero (Brockett 1984). A revolute screw satisfies
xi^3 = -xi and a prismatic one xi^2 = 0, so that e_k = 1 + s xi + v xi^2 with (s, v) = (sin q, 1 - cos q) or (q, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.checks import Array

__all__ = ["TURN", "Axis", "Chain", "Motion", "Solutions", "axial", "cross", "dot", "pick"]

TURN = 2 * np.pi
"""Full turn, rad."""
NEXT, AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
SKEW = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1).reshape(3, 9)
"""Maps a vector w to the matrix of w x, row by row."""
IDENTITY = np.eye(3)


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of Newton's method; lengths are shares of the size of the arm.

    Attributes:
        steps: Largest number of steps.
        trial_steps: Number of steps after which each one must make progress.
        progress: Factor by which a step then reduces the error; near a double root it is 4.
        precision: Pose error at which the iteration ends, also in rad.
        exact: Largest pose error of a solution, also in rad.
        rough: Pose error above which a candidate is dropped, also in rad.
        largest_step: Largest change of a joint in a step, rad or m.
        damping: Added to the squared singular values of the Jacobian, so that steps stay finite at singularities.
        singular: Least singular value of the Jacobian of a regular solution. Below it a further solution may lie so
            near that rounding errors hide it.
        same: Distance below which two solutions count as one, rad or m.
        near: Distance up to which two solutions count as one if the pose is exact halfway between them.
    """

    steps: int = 30
    trial_steps: int = 5
    progress: float = 1.5
    precision: float = 1e-13
    exact: float = 1e-10
    rough: float = 0.5
    largest_step: float = 1.0
    damping: float = 1e-14
    singular: float = 1e-5
    same: float = 1e-7
    near: float = 1e-2


NEWTON = NewtonSettings()


def dot(a: Array, b: Array) -> Array:
    """Return the scalar products of vectors."""
    return np.asarray(np.vecdot(a, b))


def cross(a: Array, b: Array) -> Array:
    """Return the vector products of vectors; for small arrays faster than numpy's function."""
    return np.asarray(a[..., NEXT] * b[..., AFTER] - a[..., AFTER] * b[..., NEXT])


def pick(rows: Array, chosen: NDArray[np.intp]) -> Array:
    """Return the rows at these indices; a single row holds for all of them."""
    return rows if len(rows) == 1 else rows[chosen]


def axial(turn: Array) -> Array:
    """Return the axial vectors of rotations, 2 sin(angle) times their axes. Shapes (M, 3, 3) to (M, 3)."""
    return np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)


class Motion(NamedTuple):
    """Rigid motions v -> turn v + shift. Shapes (M, 3, 3), (M, 3)."""

    turn: Array
    shift: Array

    def take(self, chosen: NDArray[np.intp]) -> Motion:
        """Return the motions at these indices."""
        return Motion(self.turn[chosen], self.shift[chosen])

    def after(self, first: Motion) -> Motion:
        """Return the composition with a motion that is applied first."""
        return Motion(self.turn @ first.turn, self.at(first.shift))

    def rotate(self, vectors: Array) -> Array:
        """Return the images of directions (M, 3)."""
        return np.asarray((self.turn @ vectors[:, :, None])[:, :, 0])

    def at(self, points: Array) -> Array:
        """Return the images of points (M, 3)."""
        return self.rotate(points) + self.shift

    @property
    def inverse(self) -> Motion:
        """The inverse motions."""
        turn = self.turn.transpose(0, 2, 1)
        return Motion(turn, -(turn @ self.shift[:, :, None])[:, :, 0])


class Axis(NamedTuple):
    """Axes of joints: unit directions (M, 3), points (M, 3), and whether the joint is revolute or prismatic.

    A single row, (1, 3), holds for all poses.
    """

    direction: Array
    point: Array
    revolute: bool = True

    def take(self, chosen: NDArray[np.intp]) -> Axis:
        """Return the axes at these indices."""
        return self if len(self.point) == 1 else Axis(self.direction[chosen], self.point[chosen], self.revolute)

    def moved(self, motion: Motion) -> Axis:
        """Return the axes moved by a motion."""
        return Axis(motion.rotate(self.direction), motion.at(self.point), self.revolute)

    def by(self, position: Array) -> Motion:
        """Return the motions of the joints by these positions (M,)."""
        if not self.revolute:
            return Motion(np.broadcast_to(IDENTITY, (len(position), 3, 3)), self.direction * position[:, None])
        skew = (self.direction @ SKEW).reshape(-1, 3, 3)
        sine, versine = np.sin(position)[:, None, None], (1 - np.cos(position))[:, None, None]
        turn = IDENTITY + sine * skew + versine * (skew @ skew)
        return Motion(turn, self.point - (turn @ self.point[:, :, None])[:, :, 0])

    def angle(self, start: Array, end: Array) -> Array:
        """Return the angles by which joints rotate vectors (M, 3) towards others, as seen along the axes."""
        across = start - dot(start, self.direction)[:, None] * self.direction
        return np.arctan2(dot(self.direction, cross(across, end)), dot(across, end))


class Solutions(NamedTuple):
    """Solutions of the inverse kinematics at M poses.

    Attributes:
        pose: Pose of each solution. Shape (K,).
        joints: Joint positions, those of revolute free joints between -pi and pi. Shape (K, n).
        singular: Which solutions are so near a singularity that others may hide there. Shape (K,), bool.
    """

    pose: NDArray[np.intp]
    joints: Array
    singular: NDArray[np.bool_]

    @classmethod
    def none(cls, size: int) -> Solutions:
        """Return no solution of an arm with `size` joints."""
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, size)), np.zeros(0, dtype=bool))


@dataclass(frozen=True, eq=False)
class Chain:
    """Joint axes of an arm at the zero configuration, in the world.

    Attributes:
        axes, points: Directions of the axes of all joints, and points on them. Shapes (n, 3), m.
        revolute: Which joints are revolute; the others are prismatic. Shape (n,), bool.
        position, rotation: Pose of the tip. Shapes (3,), (3, 3).
        order: Numbers of the joints that move the tip, from the base to the tip.
        size: Largest distance of an axis from the tip, m.
    """

    axes: Array
    points: Array
    revolute: NDArray[np.bool_]
    position: Array
    rotation: Array
    order: tuple[int, ...]
    size: float

    @classmethod
    def of(cls, machine: Machine) -> Chain | None:
        """Return the chain to the tip of a machine; None if its base moves or a joint of the chain follows another."""
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

    def extended(self, axes: Array, points: Array) -> Chain:
        """Return the chain with further revolute joints between the last joint and the tip. Shapes (k, 3), (k, 3)."""
        n, count = len(self.axes), len(axes)
        return replace(
            self,
            axes=np.concatenate([self.axes, axes]),
            points=np.concatenate([self.points, points]),
            revolute=np.concatenate([self.revolute, np.ones(count, dtype=bool)]),
            order=(*self.order, *range(n, n + count)),
        )

    @cached_property
    def screws(self) -> tuple[Array, Array]:
        """Screws of the joints in the order of the chain, and their squares. Shapes (k, 4, 4)."""
        order = list(self.order)
        axes, points, revolute = self.axes[order], self.points[order], self.revolute[order]
        screws = np.zeros((len(order), 4, 4))
        screws[:, :3, :3] = np.where(revolute[:, None, None], np.cross(np.eye(3), axes[:, None]), 0.0)
        screws[:, :3, 3] = np.where(revolute[:, None], np.cross(points, axes), axes)
        return screws, screws @ screws

    @cached_property
    def constant_axes(self) -> tuple[Axis, ...]:
        """Axes of the joints at the zero configuration, in the order of the chain."""
        parts = ((self.axes[[j]], self.points[[j]], bool(self.revolute[j])) for j in self.order)
        return tuple(Axis(*part) for part in parts)

    @cached_property
    def home_motion(self) -> Motion:
        """Pose of the tip at the zero configuration, as one motion."""
        return Motion(self.rotation[None], self.position[None])

    @cached_property
    def home(self) -> Array:
        """Pose of the tip at the zero configuration. Shape (4, 4)."""
        home = np.eye(4)
        home[:3, :3], home[:3, 3] = self.rotation, self.position
        return home

    def frames(self, joints: Array) -> Array:
        """Return the motions of the joints' axes and of the tip from the zero configuration. Shape (k + 1, K, 4, 4)."""
        order = list(self.order)
        position, turns = joints[:, order].T, self.revolute[order][:, None]
        sine, versine = np.where(turns, np.sin(position), position), np.where(turns, 1 - np.cos(position), 0.0)
        screws, squares = self.screws
        steps = np.eye(4) + sine[:, :, None, None] * screws[:, None] + versine[:, :, None, None] * squares[:, None]
        frames = np.empty((len(order) + 1, len(joints), 4, 4))
        frames[0] = np.eye(4)
        for k in range(len(order)):
            np.matmul(frames[k], steps[k], out=frames[k + 1])
        return frames

    def poses(self, joints: Array) -> tuple[Array, Array]:
        """Return the poses of the tip at joints (K, n). Shapes (K, 3), (K, 3, 3)."""
        tips = self.frames(joints)[-1] @ self.home
        return tips[:, :3, 3], tips[:, :3, :3]

    def linearize(self, joints: Array, free: Sequence[int], goal: Motion) -> tuple[Array, Array]:
        """Return pose errors (K, 6) of joints (K, n) and the Jacobian of the tip in the free joints (K, 6, m).

        The errors are the rotation as the axial vector 2 sin(angle) / 2, or (3, 3, 3) beyond a right angle, and the
        displacement as a share of the size of the arm.
        """
        frames = self.frames(joints)
        tips = frames[-1] @ self.home
        rows, numbers = [self.order.index(j) for j in free], list(free)
        turns = frames[rows, :, :3, :3]
        directions = (turns @ self.axes[numbers][:, None, :, None])[..., 0]
        points = (turns @ self.points[numbers][:, None, :, None])[..., 0] + frames[rows, :, :3, 3]
        revolute = self.revolute[numbers][:, None, None]
        moments = np.where(revolute, cross(directions, tips[:, :3, 3] - points), directions) / self.size
        jacobian = np.concatenate([np.where(revolute, directions, 0.0), moments], axis=2).transpose(1, 2, 0)
        turn = goal.turn @ tips[:, :3, :3].transpose(0, 2, 1)
        rotation = axial(turn) / 2
        rotation[turn[:, 0, 0] + turn[:, 1, 1] + turn[:, 2, 2] < 1] = 3.0
        return np.concatenate([rotation, (goal.shift - tips[:, :3, 3]) / self.size], axis=1), jacobian

    def refine(self, pose: NDArray[np.intp], joints: Array, free: Sequence[int], goal: Motion) -> Solutions:
        """Refine candidates by Newton's method in the free joints; return each solution once.

        Args:
            pose: Pose of each candidate. Shape (K,).
            joints: Candidates. Shape (K, n).
            free: Numbers of the free joints; the others keep their positions.
            goal: Poses of the tip in the world, M of them.
        """
        joints, numbers = joints.copy(), np.array(free, dtype=int)
        error, jacobians = np.full(len(joints), np.inf), np.zeros((len(joints), 6, len(numbers)))
        active = np.arange(len(joints))
        for step in range(NEWTON.steps + 1):
            missed, jacobian = self.linearize(joints[active], free, goal.take(pose[active]))
            worst, previous = np.abs(missed).max(axis=1), error[active]
            error[active], jacobians[active] = worst, jacobian
            # a solution at the limit of rounding no longer improves
            on = (worst > NEWTON.precision) & (worst < (NEWTON.rough if step == 0 else np.inf))
            on &= (worst > NEWTON.exact) | (worst < previous / 2)
            on &= (worst < previous / NEWTON.progress) | (step < NEWTON.trial_steps)
            if step == NEWTON.steps or not on.any():
                break
            active, change = active[on], _damped_steps(jacobian[on], missed[on])
            joints[active[:, None], numbers] += np.clip(change, -NEWTON.largest_step, NEWTON.largest_step)
        good = error <= NEWTON.exact
        return self.distinct(Solutions(pose[good], joints[good], _are_singular(jacobians[good])), free, goal)

    def union(self, first: Solutions, second: Solutions, free: Sequence[int], goal: Motion) -> Solutions:
        """Return the solutions of two sets, each once."""
        if not len(first.pose):
            return second
        parts = (np.concatenate(pair) for pair in zip(first, second, strict=True))
        return self.distinct(Solutions(*parts), free, goal)

    def distinct(self, solutions: Solutions, numbers: Sequence[int], goal: Motion) -> Solutions:
        """Return each solution once, sorted by pose, with angles between -pi and pi.

        Args:
            solutions: The solutions.
            numbers: Numbers of the joints that distinguish solutions.
            goal: Poses of the tip, M of them.
        """
        pose, joints, singular = solutions
        free = np.array(numbers, dtype=int)
        turns = free[self.revolute[free]]
        joints[:, turns] -= TURN * np.round(joints[:, turns] / TURN)
        order = np.argsort(pose, kind="stable")
        pose, joints, singular = pose[order], joints[order], singular[order]
        largest = int(np.bincount(pose, minlength=1).max(initial=0))
        first = np.arange(len(pose))[:, None]
        second = first + np.arange(1, largest)
        same_pose = second < len(pose)
        second = np.minimum(second, len(pose) - 1)
        first, second = (part[same_pose & (pose[first] == pose[second])] for part in np.broadcast_arrays(first, second))
        difference = joints[second] - joints[first]
        difference[:, turns] -= TURN * np.round(difference[:, turns] / TURN)
        distance = np.abs(difference[:, free]).max(axis=1, initial=0.0)
        same = distance < NEWTON.same
        if (close := np.flatnonzero(~same & (distance < NEWTON.near))).size:
            middle = joints[first[close]] + difference[close] / 2
            missed, _ = self.linearize(middle, numbers, goal.take(pose[first[close]]))
            same[close] = np.abs(missed).max(axis=1) <= NEWTON.exact
        kept = np.ones(len(pose), dtype=bool)
        kept[second[same]] = False
        return Solutions(pose[kept], joints[kept], singular[kept])


def _damped_steps(jacobian: Array, missed: Array) -> Array:
    """Return the steps of Newton's method, damped at singularities. Shapes (K, 6, m), (K, 6) to (K, m)."""
    transposed, error = jacobian.transpose(0, 2, 1), missed[:, :, None]
    if jacobian.shape[2] < 6:
        normal = transposed @ jacobian + NEWTON.damping * np.eye(jacobian.shape[2])
        return np.asarray(np.linalg.solve(normal, transposed @ error)[:, :, 0])
    normal = jacobian @ transposed + NEWTON.damping * np.eye(6)
    return np.asarray((transposed @ np.linalg.solve(normal, error))[:, :, 0])


def _are_singular(jacobians: Array) -> NDArray[np.bool_]:
    """Return which Jacobians (K, 6, m) have a singular value below the limit.

    The product of the five others is at most (|J|^2 / 5)^(5 / 2), so that the determinant tells most regular ones.
    """
    singular = np.ones(len(jacobians), dtype=bool)
    if jacobians.shape[2] == 6:
        largest = ((jacobians**2).sum(axis=(1, 2)) / 5) ** 2.5
        singular = np.abs(np.linalg.det(jacobians)) < NEWTON.singular * largest
    if singular.any():
        values = np.linalg.svd(jacobians[singular], compute_uv=False)
        singular[singular] = values[:, -1] < NEWTON.singular
    return singular
