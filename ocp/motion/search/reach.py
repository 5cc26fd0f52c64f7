"""End of the reach along pose tasks: the first time without an IK solution, by bisection, and what ends the reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from models import Machine
from models.checks import Array
from ocp.motion.local.inverse_kinematics import Unreachable, describe_miss, inverse_kinematics_at
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["end_of_reach"]


@dataclass(frozen=True)
class ReachSettings:
    """Settings of the search for the end of the reach.

    Attributes:
        intervals: Intervals of the stretch of time, at whose ends the reach is evaluated before the bisection. They do
            not depend on where a planner failed, so that every search names the same end.
        bisections: Number of bisections of one interval.
        tolerance: Pose error up to which a pose is within reach, m or rad. The distance that it adds to the reach is
            below the repeatability of an arm.
        continued: Number of solutions from which the next time is tried before random starts.
    """

    intervals: int = 32
    bisections: int = 24
    tolerance: float = 1e-6
    continued: int = 16


REACH = ReachSettings()


@dataclass
class _Reach:
    """IK solutions of tasks over time, each continued from those of the time before."""

    equations: TaskEquations
    options: dict[str, Any]
    solutions: Array

    def __post_init__(self) -> None:
        self._targets = self.equations.target_function()

    def unreachable_at(self, time: float, limits: bool) -> Unreachable | None:
        """Return the error at a time, or None and keep the solutions."""
        targets = np.array(self._targets(time)).ravel()
        options = {**self.options, "limits": limits, "tolerance": REACH.tolerance}
        for starts in (0, self.options["starts"]):
            if not starts and not len(self.solutions):
                continue
            try:
                options["starts"] = starts
                solved = inverse_kinematics_at(self.equations, targets, near=self.solutions, **options)
            except Unreachable as error:
                unreachable = error
            else:
                self.solutions = np.array([solution.joints for solution in solved[: REACH.continued]])
                return None
        return unreachable


def end_of_reach(
    machine: Machine,
    tasks: Sequence[TipTask],
    interval: tuple[float, float],
    failed: float,
    *,
    limits: bool,
    starts: int,
    seed: int,
) -> Unreachable | None:
    """Return an error that names the end of the reach of a machine on a fixed base, and what ends it.

    The end is the first time at which no joint positions within the limits do the tasks. A joint ends the reach if it
    is at its limit there, and the pose would be within reach without limits. Otherwise the pose is too far or too near,
    or turned in a way that the arm cannot follow: the Jacobian of the tasks is singular at the end.

    Args:
        machine: The machine.
        tasks: Its pose tasks during the interval.
        interval: Begin and end of the stretch of time, s.
        failed: Time at which no solution was found, s.
        limits, starts, seed: As in `inverse_kinematics`.

    Returns:
        The error with the fields time (the end), name (the joint, or the frame), value, limit, distance and angle (the
        nearest miss at the next of the evaluated times). None if the pose at `failed` is within reach after all.
    """
    begin, end = interval
    reach = _Reach(bind(machine, tasks), {"starts": starts, "seed": seed}, np.zeros((0, machine.joint_size)))
    grid = np.linspace(begin, end, REACH.intervals + 1)
    within, miss = begin, None
    for beyond in (*grid[grid < failed].tolist(), failed, *grid[grid > failed].tolist()):
        if (miss := reach.unreachable_at(beyond, limits)) is not None:
            break
        if beyond >= failed:
            return None
        within = beyond
    assert miss is not None
    first, nearest = beyond, miss
    for _ in range(REACH.bisections if beyond > within else 0):
        middle = (within + beyond) / 2
        if (error := reach.unreachable_at(middle, limits)) is None:
            within = middle
        else:
            beyond, nearest = middle, error
    for time in grid[grid > within][:1].tolist():
        if (error := reach.unreachable_at(time, limits)) is not None:
            first, miss = time, error
    details: dict[str, Any] = {"name": miss.name, "value": miss.pose_error}
    cause = f"no joint limit ends it, the arm is singular there with joints {np.round(nearest.joints, 6).tolist()}"
    free = _Reach(reach.equations, reach.options, np.vstack([reach.solutions, nearest.joints]))
    if limits and free.unreachable_at(within + (first - within) / REACH.intervals, limits=False) is None:
        cause, joint = _joint_at_limit(machine, nearest.joints)
        details |= joint
    words = (
        f"the reach ends, {cause}; at {first:.4g} s the nearest miss is {describe_miss(miss.distance, miss.angle)}; "
        "ask for poses within reach or leave a row free"
    )
    details |= {"distance": miss.distance, "angle": miss.angle, "time": within}
    return Unreachable(words, nearest.joints, miss.pose_error, **details)


def _joint_at_limit(machine: Machine, joints: Array) -> tuple[str, dict[str, Any]]:
    """Return the words and fields about the joint that is nearest to its limit, if the limits end the reach."""
    moving = machine.robot.moving_joints
    limits = [
        min((joint.lower, joint.upper), key=lambda x: abs(x - q)) for joint, q in zip(moving, joints, strict=True)
    ]
    nearest = int(np.abs(joints - limits).argmin())
    joint, unit = moving[nearest], "m" if moving[nearest].kind == "prismatic" else "rad"
    fields = {"name": joint.name, "value": float(joints[nearest]), "limit": float(limits[nearest])}
    return f"{joint.name!r} is at its limit {limits[nearest]:.5g} {unit}", fields
