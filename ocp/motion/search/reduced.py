"""Many states of a machine whose base moves by itself, moved at once: its kinematics in the scaled rates of the joints.

With the scaled rates p = sqrt(W) dq/dt the running cost is |p|^2 / 2. Those that do a task, A p = v, are the least ones
and any in the null space of A, its self-motion; the base moves along as its momentum is conserved.

Whether a machine whose base floats can be where its tasks want its tips, in whatever attitude.

Its momentum lets the centre of mass move on a straight line, whatever the joints do, and the attitude of the base
depends on the way. So a pose is out of reach if no joints and no attitude put the tips there with the centre of mass
where it is then: seen so, the machine is one on a fixed base, with a joint more that turns about the centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, Machine, center_of_mass
from models.arrays import Array
from models.spatial import rotation, rotation_from_quaternion
from ocp.motion.local.inverse_kinematics import (
    Unreachable,
    equivalent_pose,
    gauss_newton,
    start_configurations,
    unreachable_error,
)
from ocp.motion.search.joint_space import TOLERANCE
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.values import Sampler
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["ReducedKinematics", "Side", "Slopes", "check_floating_reach", "within"]


class Side(IntEnum):
    """Limits of a joint: of its position, and of its rate."""

    LOW = 0
    HIGH = 1
    SLOW = 2
    FAST = 3


class Slopes(NamedTuple):
    """Kinematics at K states of n joints, m rows of tasks and a base of size b.

    Attributes:
        right, error: What the rates are to give, and what poses are off. Shape (K, m).
        base, drift: The base's rate is base @ p + drift. Shapes (K, b, n), (K, b).
        ways, lower: A = lower @ ways', the ways orthonormal, lower triangular. Shapes (K, n, m), (K, m, m).
        null: Directions in which nothing is done for the task, orthonormal. Shape (K, n, r).
    """

    right: Array
    error: Array
    base: Array
    drift: Array
    ways: Array
    lower: Array
    null: Array

    def of(self, rows: Any) -> Slopes:
        """Of some states."""
        return Slopes(*(part[rows] for part in self))

    def given(self, rates: Array) -> Array:
        """What scaled rates (K, n) do for the task. Shape (K, m)."""
        done: Array = self.lower @ (self.ways.transpose(0, 2, 1) @ rates[:, :, None])
        return done[:, :, 0]

    def least(self, wanted: Array) -> Array:
        """Least scaled rates (K, n) that give what is wanted (K, m)."""
        if not wanted.shape[1]:
            return np.zeros(self.null.shape[:2])
        found: Array = self.ways @ np.linalg.solve(self.lower, wanted[:, :, None])
        return found[:, :, 0]

    def idle(self, rates: Array) -> Array:
        """The part of scaled rates (K, n) that does nothing for the task."""
        used: Array = self.ways @ (self.ways.transpose(0, 2, 1) @ rates[:, :, None])
        return np.asarray(rates - used[:, :, 0])

    def moved(self, rates: Array) -> Array:
        """Rates of the base (K, b) to those of the joints, but for its drift."""
        return np.asarray((self.base @ rates[:, :, None])[:, :, 0])


class ReducedKinematics:
    """Of a machine that does tasks, or none.

    Attributes:
        rows: Of the tasks. equations: Of these, or None.
        root: Square roots of the weights. Shape (n,).
    """

    def __init__(self, machine: Machine, equations: TaskEquations | None, weights: Array) -> None:
        self.root, self.equations, self.rows = np.sqrt(weights), equations, 0 if equations is None else equations.size
        n = machine.joint_size
        b, q, u = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", n), ca.SX.sym("u", n)
        self._targets = None if equations is None else equations.target_function()
        symbols = [b, q]
        parts = [ca.jacobian(machine.base_rate(b, q, u), u), machine.base_rate(b, q, ca.DM.zeros(n))]
        if equations is not None:
            assert self._targets is not None
            symbols.append(wanted := ca.SX.sym("targets", self._targets.numel_out()))
            parts += [equations.jacobian(b, q), equations.right(b, q, wanted), equations.error(b, q, wanted)]
        self._sampler = Sampler(symbols, parts)

    def at(self, base: Array, joints: Array, time: float) -> Slopes:
        """At states (K, b), (K, n)."""
        count, n = joints.shape
        given = [base, joints]
        if self._targets is not None:
            given.append(np.array(self._targets(time)).ravel())
        turning, drift, *task = self._sampler(*given)
        matrix, right, error = task if task else (np.zeros((count, 0)),) * 3
        turning = turning.reshape(count, n, -1).transpose(0, 2, 1) / self.root
        whole, upper = np.linalg.qr(matrix.reshape(count, n, self.rows) / self.root[:, None], mode="complete")
        lower = upper[:, : self.rows].transpose(0, 2, 1).copy()
        for i in range(self.rows):  # rows that depend on others give what they can
            least = ROUNDING_SHARE * np.abs(lower).max(axis=(1, 2)) + np.finfo(float).tiny
            lower[:, i, i] = np.where(np.abs(lower[:, i, i]) < least, least, lower[:, i, i])
        if self.equations is not None:
            error = np.where(self.equations.pose_rows, error, 0.0)
        return Slopes(right, error, turning, drift, whole[:, :, : self.rows], lower, whole[:, :, self.rows :])

    def speed(self, base: Array, joints: Array, time: float) -> Array:
        """About how large squared scaled rates (K,) the tasks of then need, far from singularities."""
        if self.equations is None:
            return np.zeros(len(joints))
        tasks = [part.task for part in self.equations.bound]
        gains = np.repeat([float(task.gain) for task in tasks], [task.size for task in tasks])
        slopes = self.at(base, joints, time)
        moved = ((slopes.right - gains * slopes.error) ** 2).sum(axis=1)
        return np.asarray(self.rows * moved / (slopes.lower**2).sum(axis=(1, 2)))

    def missed(self, base: Array, joints: Array, rates: Array, time: float) -> tuple[Array, Array]:
        """How fast joint rates (K, n) move tips off what velocities ask for, and how fast these are. Shapes (K,)."""
        none = np.zeros(len(joints))
        if self.equations is None or self.equations.pose_rows.all():
            return none, none
        slopes, rows = self.at(base, joints, time), ~self.equations.pose_rows
        return np.linalg.norm((slopes.given(rates * self.root) - slopes.right)[:, rows], axis=1), np.linalg.norm(
            slopes.right[:, rows], axis=1
        )

    def stepped(
        self, base: Array, joints: Array, slopes: Slopes, rates: Array, begin: float, end: float, exact: float
    ) -> tuple[Array, Array, Array]:
        """States after a step with the self-motion of scaled rates (K, n), by the rule of the middle.

        Returns:
            Base (K, b), joints (K, n), and what is left of the errors of poses (K,), corrected until they are `exact`.
        """
        step, first = end - begin, joints
        half = base + step / 2 * (slopes.moved(rates) + slopes.drift)
        middle = self.at(_sound(half), joints + step / 2 * rates / self.root, begin + step / 2)
        rates = middle.least(middle.right) + middle.idle(slopes.idle(rates))
        base, joints = _sound(base + step * (middle.moved(rates) + middle.drift)), joints + step * rates / self.root
        if self.equations is None or self.equations.pose_rows.all():
            return self.corrected(base, joints, end, exact)

        def missed(there: Slopes, joints: Array) -> Array:
            """Of the ways that velocities ask for in this step, by Simpson's rule."""
            straight = (joints - first) * self.root
            parts = ((1, slopes), (4, middle), (1, there))
            return np.asarray(sum(k / 6 * (step * each.right - each.given(straight)) for k, each in parts))

        return self.corrected(base, joints, end, exact, missed=missed)

    def corrected(
        self,
        base: Array,
        joints: Array,
        time: float,
        exact: float,
        most: int = 3,
        missed: Callable[[Slopes, Array], Array] | None = None,
    ) -> tuple[Array, Array, Array]:
        """States with the errors of their poses taken back; returns and `exact` as of `stepped`.

        Args:
            most: Newton steps.
            missed: Of slopes and joints there what velocities ask for and was not done, in all rows. Shape (K, m).
        """
        off = np.zeros(len(joints))
        if self.equations is None or (missed is None and not self.equations.pose_rows.any()):
            return base, joints, off
        for number in range(most + 1):
            slopes = self.at(base, joints, time)
            error = (
                slopes.error
                if missed is None
                else np.where(self.equations.pose_rows, slopes.error, missed(slopes, joints))
            )
            off = np.abs(error).max(axis=1)
            off = np.where(np.isfinite(off), off, np.inf)
            if number == most or off.max(initial=0.0) <= exact:
                break
            rates = slopes.least(error)
            rates /= np.maximum(np.linalg.norm(rates, axis=1, keepdims=True), 1.0)
            base, joints = _sound(base + slopes.moved(rates)), joints + rates / self.root
        return base, joints, off


def _sound(base: Array) -> Array:
    """Configurations of bases (K, b), their quaternions of length one."""
    if base.shape[1] == 7:
        base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1, keepdims=True)
    return base


def within(rates: Array, null: Array, low: Array, high: Array, fast: Array) -> tuple[Array, NDArray[np.intp]]:
    """Rates (K, n) bent along self-motions so that each keeps its limits.

    Args:
        null: Directions of the self-motions. Shape (K, n, r).
        low, high: Limits. Shape (K, n).
        fast: Limits of the rates alone. Shape (n,).

    Returns:
        The rates, and of each the joint that cannot keep a limit and which `Side`, or -1. (K, 2).
    """
    rates, why = rates.copy(), np.full((len(rates), 2), -1, dtype=np.intp)
    busy = np.arange(len(rates))
    for _ in range(2 * rates.shape[1] + 1):  # of each joint both limits
        over = np.maximum(rates[busy] - high[busy], low[busy] - rates[busy])
        worst = over.argmax(axis=1)
        beyond = over[np.arange(len(busy)), worst] > TOLERANCE
        why[busy[~beyond]] = -1
        busy, worst = busy[beyond], worst[beyond]
        if not busy.size:
            break
        below = rates[busy, worst] < low[busy, worst]
        limit = np.where(below, low[busy, worst], high[busy, worst])
        of_rate = np.abs(limit) >= fast[worst]
        why[busy, 0], why[busy, 1] = (
            worst,
            np.where(below, Side.LOW, Side.HIGH) + np.where(of_rate, Side.SLOW, Side.LOW),
        )
        turn = null[busy, worst]
        lever = (turn**2).sum(axis=1)
        share = np.where(lever > ROUNDING_SHARE, (limit - rates[busy, worst]) / np.maximum(lever, ROUNDING_SHARE), 0.0)
        rates[busy] += share[:, None] * (null[busy] @ turn[:, :, None])[:, :, 0]
    return rates, why


STARTS = 64
"""Random joints and attitudes to search from at each time."""
PLACE_TOLERANCE = 1e-4
"""m or rad: of a pose that is met."""


def check_floating_reach(
    machine: FreeFloating,
    tasks: Sequence[TipTask],
    base: Array,
    start: Array,
    begin: float,
    end: float,
    *,
    lower: Array,
    upper: Array,
    seed: int = 0,
    looks: int = 17,
) -> None:
    """Raise where poses of the tasks are out of reach in any attitude, by multi-start inverse kinematics.

    Velocities in the world's axes are summed up to positions, orientations from velocities are left out.

    Args:
        machine: Whose momentum is conserved.
        tasks: All that are done, each in its own time.
        base, start: Base and joints at 0 s. Shapes (base_size,), (n,).
        begin, end: s, between which it is looked.
        lower, upper: Limits of the joints. Shape (n,).
        seed: Of the random starts.
        looks: Times at which poses are looked at, and 2**10 times closer where one is out of reach.

    Raises:
        Unreachable: Names the time from which on a pose is out of reach, and the nearest miss.
    """
    n, turns = machine.joint_size, 1 if machine.base_size == 3 else 4
    rng = np.random.default_rng(seed)
    attitudes = rng.normal(size=(STARTS, 4)) if turns == 4 else rng.uniform(-np.pi, np.pi, (STARTS, 1))
    starts = np.hstack([start_configurations(machine, lower, upper, STARTS, None, seed), attitudes])
    free = np.full(turns, np.inf)
    limits = np.concatenate([lower, -free]), np.concatenate([upper, free])
    known = np.zeros((0, n + turns))  # where the poses of the time before were met

    def missed_at(time: float) -> Unreachable | None:
        """What is out of reach at a time."""
        nonlocal known
        poses = []
        for task in tasks:
            if task.begin <= time <= task.end and (task.is_pose or not task.begin):
                pose = equivalent_pose(machine, task, start, time, base)
                poses += [] if pose is None else [pose]
        if not poses:
            return None
        equations = bind(machine, poses)
        targets = np.array(equations.target_function()(time)).ravel()
        z = ca.SX.sym("z", n + turns)
        misfit = equations.pose_residual(_placed(machine, base, start, z, time), z[:n], ca.SX(ca.DM(targets)))
        function = ca.Function("misfit", [z], [misfit, ca.densify(ca.jacobian(misfit, z))], {"cse": True})
        found, off = gauss_newton(function, np.vstack([known, starts]), *limits, PLACE_TOLERANCE, 100)
        good = off <= PLACE_TOLERANCE
        if good.any():
            known = found[good][:STARTS]
            return None
        best = int(off.argmin())
        return unreachable_error(equations, found[best, :n], float(off[best]), lower, upper)

    reached = begin
    for time in np.linspace(begin, end, looks).tolist():
        if (error := missed_at(time)) is None:
            reached = time
            continue
        while time - reached > (end - begin) / (looks - 1) / 2**10:
            middle = (reached + time) / 2
            if (missed := missed_at(middle)) is None:
                reached = middle
            else:
                time, error = middle, missed
        error.time = time
        raise error


def _placed(machine: FreeFloating, base: Array, start: Array, z: Any, time: float) -> Any:
    """The base at a time where joints and its attitude, both in z, have the centre of mass where it is then."""
    robot, frame, n = machine.robot, machine.world_from_base(ca.DM(base)), machine.joint_size
    joints, turn = z[:n], z[n:]
    momentum = np.zeros(6)
    momentum[machine.twist_rows] = np.asarray(machine.conserved_momentum)
    center = center_of_mass(robot, ca.DM(start), frame) + time * ca.DM(momentum[3:]) / robot.total_mass
    if turn.numel() == 1:
        place = center - ca.mtimes(rotation((0, 0, 1), turn), center_of_mass(robot, joints))
        return ca.vertcat(place[:2], turn)
    return ca.vertcat(center - ca.mtimes(rotation_from_quaternion(turn), center_of_mass(robot, joints)), turn)
