"""Where a motion may begin: postures that inverse kinematics finds, followed through the tasks side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.arrays import Array
from ocp.errors import ProblemError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.tool_motion import Stretch
from ocp.motion.local.collisions import Collision, distances_along
from ocp.motion.local.inverse_kinematics import (
    Unreachable,
    distinct_solutions,
    idle_positions,
    inverse_kinematics,
    start_configurations,
)
from ocp.motion.local.rates import LocalMotion, track_tasks
from ocp.motion.search.settings import PlannerSettings
from ocp.motion.tasks.checks import ignorable_joints
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = [
    "OUT_OF_REACH", "Asked", "SearchKind", "check_clear_start", "clear_postures", "followed_from", "misfits_of",
    "others_told", "placed", "postures_at_the_start", "settled", "touches_at_the_start",
]  # fmt: skip

SETTINGS = PlannerSettings()
SearchKind: TypeAlias = Literal["start", "postures", "global"]
OUT_OF_REACH = 1e-4
"""m or rad: a pose missed by more may be out of reach."""


@dataclass(frozen=True, eq=False)
class Asked:
    """What is asked, checked.

    Attributes:
        machine, tasks, horizon: As of `plan`.
        start: Joints at the start, or None. base: Base there. weights: Of the joint rates.
        limits: Of the joints.
        search: How the start is searched.
        drives: Limits with those of actuators, or None where these are not limited.
        clearance_constraints: What the motion has to stay clear of, or None.
        settings: Of the planner.
    """

    machine: Machine
    tasks: tuple[TipTask, ...]
    horizon: float
    stretches: tuple[Stretch, ...]
    start: Array | None
    base: Array
    weights: Array
    limits: Limits
    cyclic: bool
    seed: int
    time_cost: float | None
    search: SearchKind = "postures"
    drives: Limits | None = None
    clearance_constraints: ClearanceConstraints | None = None
    settings: PlannerSettings = SETTINGS

    @cached_property
    def idle(self) -> NDArray[np.bool_]:
        """Which joints move the frame of no task, at any time. Shape (n,)."""
        return bind(self.machine, self.tasks).idle

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which joints stand still: where all motions are searched, those that move no task's frame. Shape (n,)."""
        return self.idle & (self.search == "global")

    @property
    def ik_options(self) -> dict[str, Any]:
        """Of inverse kinematics."""
        return {"seed": self.seed, "limits": self.limits.joints, "starts": self.settings.ik_starts}

    @cached_property
    def bounds(self) -> JointBounds:
        """Of the joints."""
        return self.limits.bounds(self.machine)


def postures_at_the_start(asked: Asked) -> Array:
    """Joints at the start, those that are clear before those that touch, the best conditioned first. Shape (K, n)."""
    if asked.start is not None:
        return asked.start[None]
    first = [asked.tasks[i] for i in asked.stretches[0].tasks if asked.tasks[i].is_pose]
    if not first:
        words = "start is missing: no task says by a pose where the tip is at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    options: dict[str, Any] = {
        "base": asked.base,
        "seed": asked.seed,
        "limits": asked.limits.joints,
        "starts": asked.settings.ik_starts,
    }
    try:
        found = inverse_kinematics(asked.machine, first, **options)
    except Unreachable as error:
        raise placed(asked, error, 0.0) from error
    resting, slides = idle_positions(asked.bounds.lower, asked.bounds.upper), asked.machine.robot.moving_joints
    found = [replace(posture, joints=np.where(asked.idle, resting, posture.joints)) for posture in found]
    found = distinct_solutions(found, np.array([joint.kind != "prismatic" for joint in slides]))
    joints = np.array([posture.joints for posture in found])
    touching = [touch is not None for touch in touches_at_the_start(asked, joints)]
    return joints[np.argsort(touching, kind="stable")]


def touches_at_the_start(asked: Asked, postures: Array) -> list[Collision | None]:
    """Of each posture (K, n) the pair of bodies that comes nearest, where it comes too near."""
    if asked.clearance_constraints is None:
        return [None] * len(postures)
    around = asked.clearance_constraints.scene
    apart = distances_along(around, asked.base, postures, np.zeros(len(postures)))
    nearest, labels = apart.argmin(axis=1).tolist(), around.labels
    found = [Collision(pair, labels[pair], float(row[pair]), 0.0) for row, pair in zip(apart, nearest, strict=True)]
    return [touch if touch.distance < around.clearance else None for touch in found]


def check_clear_start(asked: Asked, postures: Array) -> None:
    """Raise ProblemError where bodies come too near at the start that is given."""
    if (touch := touches_at_the_start(asked, postures)[0]) is not None:
        assert asked.clearance_constraints is not None
        around, name = asked.clearance_constraints.scene, " and ".join(touch.bodies)
        ignored = [around.told_as(touch.pair)]
        words = f"start: {touch}; start clear of everything, or name what may touch: {ignored=}"
        words = "; ".join([words, *others_told(clear_postures(asked, touch.time))])
        raise ProblemError(words, name=name, value=touch.distance, limit=around.clearance, time=touch.time)


def clear_postures(asked: Asked, time: float) -> int | Unreachable | None:
    """How many postures that do the tasks at a time (s) are clear, or why none is.

    None where that says nothing: no pose is asked for then, or the base may come from elsewhere.
    """
    tasks = [task for task in asked.tasks if task.is_pose and task.begin <= time <= task.end]
    if asked.clearance_constraints is None or not tasks or asked.machine.base_size:
        return None
    around: dict[str, Any] = {"scene": asked.clearance_constraints.scene, "limits": asked.limits.joints}
    try:
        return len(inverse_kinematics(asked.machine, tasks, time=time, seed=asked.seed, **around))
    except Unreachable as error:
        return error


def others_told(others: int | Unreachable | None) -> list[str]:
    """Whether another posture is clear, in words; nothing where that is not known."""
    if others is None:
        return []
    if isinstance(others, Unreachable):
        return [f"no other posture is clear then: {others}"]
    return [f"clear then, and not on a motion that was found: {others} other posture{'s' if others > 1 else ''}"]


def settled(asked: Asked, postures: Array) -> tuple[Array, Array]:
    """Joints at the start, nan where they are free, and the postures moved to those that are told.

    An ignorable coordinate, by whose value nothing that is asked changes but the joint itself (the last joint of an arm
    whose roll is free turns about the tool's axis), has the middle of its range: with it free, every motion would be
    one of a family of the same cost. So has a joint that moves no tip, a gripper's finger. Where every posture touches
    something with that, they have the values of a posture, or random ones, with which the most are clear.
    """
    bounds = asked.bounds
    start = np.full(asked.machine.joint_size, np.nan)
    ignorable = np.ones(asked.machine.joint_size, dtype=bool)
    for stretch in asked.stretches:
        if stretch.equations is not None:
            ignorable &= ignorable_joints(stretch.equations, asked.base)
    ended = np.isfinite(bounds.upper - bounds.lower)
    start[ignorable] = np.where(ended, idle_positions(bounds.lower, bounds.upper), postures[0])[ignorable]

    def collision_count(values: Array) -> int:
        return touches_at_the_start(asked, np.where(ignorable, values, postures)).count(None)

    if ignorable.any() and not collision_count(start):
        others = start_configurations(
            asked.machine, bounds.lower, bounds.upper, asked.settings.ik_starts, None, asked.seed
        )
        start[ignorable] = max((start, *postures, *others), key=collision_count)[ignorable]
    return start, np.where(ignorable, start, postures)


def followed_from(asked: Asked, postures: Array) -> list[LocalMotion]:
    """The local motions from all postures through all stretches, with the least damping that lets one of them follow.

    Raises:
        Unreachable: A place on the way that no posture reaches.
    """
    bounds, settings = asked.bounds, asked.settings
    best: list[LocalMotion] = []
    for damping in settings.dampings:
        found: list[LocalMotion] = []
        base, joints = np.tile(asked.base, (len(postures), 1)), postures
        for stretch in asked.stretches:
            if stretch.begin > 0:
                joints = _begun(asked, stretch, base, joints)
                if asked.stretches[len(found) - 1].equations is None:
                    found[-1] = _straight(found[-1], joints)
            share = int(np.ceil(settings.local_steps * stretch.duration / asked.horizon))
            share = max(share, settings.min_intervals)
            times = np.union1d(np.linspace(stretch.begin, stretch.end, share + 1), stretch.breaks)
            equations = stretch.equations
            if equations is None:
                found.append(LocalMotion.stationary(times, base, joints))
            else:
                soft: dict[str, Any] = {"weights": asked.weights, "damping": damping}
                found.append(
                    track_tasks(equations, joints, base, times, lower=bounds.lower, upper=bounds.upper, **soft)
                )
            base, joints = found[-1].base[:, -1], found[-1].joints[:, -1]
        best = best or found
        if min(misfits_of(found)) <= OUT_OF_REACH:
            return found
    _check_reach(asked, best)
    return best


def _begun(asked: Asked, stretch: Stretch, base: Array, joints: Array) -> Array:
    """Joints (K, n) at which the poses that begin in a stretch are met, each the nearest to where it comes from.

    There they still do what was asked until then.
    """
    before = asked.stretches[asked.stretches.index(stretch) - 1]
    begins = [asked.tasks[i].is_pose and new for i, new in zip(stretch.tasks, stretch.new, strict=True)]
    if not any(begins):
        return joints
    tasks = [asked.tasks[i] for i in sorted({*before.tasks, *stretch.tasks})]
    options: dict[str, Any] = {
        "near": joints,
        "seed": asked.seed,
        "limits": asked.limits.joints,
        "starts": asked.settings.ik_starts,
    }
    try:
        found = inverse_kinematics(asked.machine, tasks, time=stretch.begin, base=base[0], **options)
    except Unreachable as error:
        if asked.machine.base_size:  # which may come nearer
            return joints
        raise placed(asked, error, stretch.begin) from error
    ways = np.array([posture.joints for posture in found])
    far = (asked.weights * (joints[:, None] - ways) ** 2).sum(axis=2)
    return np.asarray(ways[far.argmin(axis=1)])


def _straight(part: LocalMotion, joints: Array) -> LocalMotion:
    """A motion without a task that leads straight to joints (K, n)."""
    share = ((part.t - part.t[0]) / (part.t[-1] - part.t[0]))[:, None]
    way = (joints - part.joints[:, 0])[:, None]
    rates = np.repeat(way / (part.t[-1] - part.t[0]), len(part.t), axis=1)
    return replace(part, joints=part.joints[:, :1] + share * way, rates=rates)


def misfits_of(followed: list[LocalMotion]) -> list[float]:
    """Of each posture the largest pose error on its way."""
    return np.max([part.pose_error for part in followed], axis=0).tolist()  # type: ignore[no-any-return]


def _check_reach(asked: Asked, followed: list[LocalMotion]) -> None:
    """Raise where no posture follows the tasks and no joints reach them, seen from a fixed base."""
    if asked.machine.base_size:
        return
    for stretch, part in zip(asked.stretches, followed, strict=True):
        poses = [
            asked.tasks[i] for i in stretch.tasks if asked.tasks[i].is_pose and asked.tasks[i].start_gap <= OUT_OF_REACH
        ]
        if not poses:
            continue
        lost = np.unique(part.worst_time[part.pose_error > OUT_OF_REACH])
        for time in lost.tolist():
            near = part.joints[:, int(np.searchsorted(part.t, time))]
            try:
                inverse_kinematics(
                    asked.machine, poses, time=time, near=near, limits=asked.limits.joints, tolerance=OUT_OF_REACH
                )
            except Unreachable as error:
                raise placed(asked, error, time) from error


def placed(asked: Asked, error: Unreachable, time: float) -> Unreachable:
    """The same with its time and the places that are asked for there."""
    places = []
    for number, task in enumerate(asked.tasks):
        if task.position is not None and task.begin <= time <= task.end:
            targets = np.array(bind(asked.machine, task).target_function()(time)).ravel()
            places.append(f"task {number} is at {np.round(targets[:3], 6).tolist()} m")
    where = f" ({', '.join(places)})" if places else ""
    return Unreachable(f"at {time:.4g} s{where}: {error}", **{**vars(error), "time": time})
