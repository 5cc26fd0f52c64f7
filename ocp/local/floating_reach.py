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
    starts = np.hstack([starts_of(machine, lower, upper, STARTS, None, seed), attitudes])
    free = np.full(turns, np.inf)
    limits = np.concatenate([lower, -free]), np.concatenate([upper, free])
    known = np.zeros((0, n + turns))  # where the poses of the time before were met

    def missed_at(time: float) -> Unreachable | None:
        """What is out of reach at a time."""
        nonlocal known
        poses = []
        for task in tasks:
            if task.begin <= time <= task.end and (task.is_pose or not task.begin):
                pose = as_pose(machine, task, start, time, base)
                poses += [] if pose is None else [pose]
        if not poses:
            return None
        equations = bind(machine, poses)
        targets = np.array(equations.target_function()(time)).ravel()
        z = ca.SX.sym("z", n + turns)
        misfit = equations.misfit(_placed(machine, base, start, z, time), z[:n], ca.SX(ca.DM(targets)))
        function = ca.Function("misfit", [z], [misfit, ca.densify(ca.jacobian(misfit, z))], {"cse": True})
        found, off = gauss_newton(function, np.vstack([known, starts]), *limits, PLACE_TOLERANCE, 100)
        good = off <= PLACE_TOLERANCE
        if good.any():
            known = found[good][:STARTS]
            return None
        best = int(off.argmin())
        return unreachable(machine, equations, found[best, :n], float(off[best]), lower, upper)

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
