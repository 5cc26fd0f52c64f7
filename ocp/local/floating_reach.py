"""Whether a machine whose base floats can be where its tasks want its tips, in whatever attitude.

Its momentum lets the centre of mass move on a straight line, whatever the joints do, and the attitude of the base
depends on the way. So a pose is out of reach if no joints and no attitude put the tips there with the centre of mass
where it is then: seen so, the machine is one on a fixed base, with a joint more that turns about the centre of mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, center_of_mass
from models.arrays import Array
from models.spatial import rotation, rotation_from_quaternion
from ocp.local.inverse_kinematics import Unreachable, as_pose, gauss_newton, starts_of, unreachable
from ocp.tasks.equations import bind
from ocp.tasks.tip_task import TipTask

__all__ = ["check_floating_reach"]

TIMES = 17
"""At which poses are looked at."""
STARTS = 64
"""Random joints and attitudes to search from at each of them."""
ITERATIONS = 100
TOLERANCE = 1e-4
"""m or rad: of a pose that is met."""
HALVINGS = 10
"""Of the time between one that is in reach and one that is not."""


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

    Raises:
        Unreachable: Names the time from which on a pose is out of reach, and the nearest miss.
    """
    look = _Looks(machine, tasks, base, start, lower, upper, seed)
    reached = begin
    for time in np.linspace(begin, end, TIMES).tolist():
        error = look.at(time)
        if error is None:
            reached = time
            continue
        last = time
        for _ in range(HALVINGS if last > reached else 0):
            middle = (reached + last) / 2
            missed = look.at(middle)
            if missed is None:
                reached = middle
            else:
                last, error = middle, missed
        error.time = last
        raise error


class _Looks:
    """Looks at poses at one time after the other, each from where those before were met, too."""

    def __init__(
        self,
        machine: FreeFloating,
        tasks: Sequence[TipTask],
        base: Array,
        start: Array,
        lower: Array,
        upper: Array,
        seed: int,
    ) -> None:
        self.machine, self.tasks, self.base, self.start = machine, tasks, base, start
        n, self._turns = machine.joint_size, 1 if machine.base_size == 3 else 4
        rng = np.random.default_rng(seed)
        joints = starts_of(machine, lower, upper, STARTS, None, seed)
        turns = rng.normal(size=(STARTS, 4)) if self._turns == 4 else rng.uniform(-np.pi, np.pi, (STARTS, 1))
        self._known = np.zeros((0, n + self._turns))
        self._random = np.hstack([joints, turns])
        free = np.full(self._turns, np.inf)
        self.lower, self.upper = np.concatenate([lower, -free]), np.concatenate([upper, free])

    def at(self, time: float) -> Unreachable | None:
        """What is out of reach at a time, or None."""
        poses = []
        for task in self.tasks:
            if task.begin <= time <= task.end and (task.is_pose or not task.begin):
                pose = as_pose(self.machine, task, self.start, time, self.base)
                poses += [] if pose is None else [pose]
        if not poses:
            return None
        equations, n = bind(self.machine, poses), self.machine.joint_size
        targets = np.array(equations.target_function()(time)).ravel()
        z = ca.SX.sym("z", n + self._turns)
        misfit = equations.misfit(self._placed(z[:n], z[n:], time), z[:n], ca.SX(ca.DM(targets)))
        function = ca.Function("misfit", [z], [misfit, ca.densify(ca.jacobian(misfit, z))], {"cse": True})
        first = np.vstack([self._known, self._random])
        found, off = gauss_newton(function, first, self.lower, self.upper, TOLERANCE, ITERATIONS)
        good = off <= TOLERANCE
        if good.any():
            self._known = found[good][:STARTS]
            return None
        best = int(off.argmin())
        limits = self.lower[:n], self.upper[:n]
        return unreachable(self.machine, equations, found[best, :n], float(off[best]), *limits)

    def _placed(self, joints: Any, turn: Any, time: float) -> Any:
        """The base with such an attitude and the centre of mass where it is at a time."""
        machine = self.machine
        robot, frame = machine.robot, machine.world_from_base(ca.DM(self.base))
        center = center_of_mass(robot, ca.DM(self.start), frame)
        momentum = np.zeros(6)
        momentum[machine.twist_rows] = np.asarray(machine.conserved_momentum)
        center += time * ca.DM(momentum[3:]) / robot.total_mass
        if self._turns == 1:
            place = center - ca.mtimes(rotation((0, 0, 1), turn), center_of_mass(robot, joints))
            return ca.vertcat(place[:2], turn)
        return ca.vertcat(center - ca.mtimes(rotation_from_quaternion(turn), center_of_mass(robot, joints)), turn)
