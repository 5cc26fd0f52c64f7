"""One call from a machine and its tasks to the cheapest motion that passes its audit, or the reasons why there is none.

Where the start is not given it is searched: inverse kinematics finds postures at the start, in every branch and spread
over the self-motion. Each is followed through the tasks by its local motion, which is the guess of a solve on a coarse
mesh, the start free along its self-motion. Those that lead to the same motion are one; the others are solved on a mesh
with nodes where the tasks' pieces meet, the cheapest first, until none is left that may be cheaper than what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from models import Machine, ModelError, Standing, Surroundings
from models.arrays import Array
from ocp.builders.clearance import Clear
from ocp.builders.drives import checked_motors
from ocp.builders.tool_motion import stretches_of
from ocp.console import interruptible
from ocp.errors import (
    ProblemError,
    SolveError,
    checked_choice,
    checked_count,
    checked_each,
    checked_flag,
    checked_instance,
    checked_positive,
)
from ocp.local.following import Followed
from ocp.local.inverse_kinematics import LARGEST_SEED
from ocp.planning.candidates import TOUCHES, Maker, closer_motions, coarse_motions, fine_motions
from ocp.planning.cells import CellSearch, follows
from ocp.planning.dead_end import DeadEnd
from ocp.planning.driven import driven_plan, limits_drives, without_drives
from ocp.planning.motion import Candidate, Plan
from ocp.planning.postures import (
    Asked,
    clear_postures,
    followed_from,
    others_told,
    postures_at_the_start,
    settled,
    touches_at_the_start,
)
from ocp.planning.search import checked_bound
from ocp.planning.standing import plan_to_stand
from ocp.planning.task_search import TaskSearch
from ocp.tasks.checks import checked_configuration, checked_horizon, checked_tasks, checked_weights, inside_limits
from ocp.tasks.equations import bind
from ocp.tasks.limits import Limits
from ocp.tasks.tip_task import TipTask

__all__ = ["SearchKind", "checked_asked", "clear_of", "plan", "planned"]

SearchKind: TypeAlias = Literal["start", "postures", "global"]

ENOUGH = 1.05
"""Of a plan that costs so many times the bound, the search's own motions are solved as they are, beside it."""
TRIED = 8
"""Postures that are taken one after the other, the best conditioned first, before all of them are compared; and ways of
each search through cells, the cheapest first. There are hundreds of these, and each takes seconds."""
AT_ONCE = 4
"""Ways through cells that are solved before the best of them is audited, where one that passes is enough."""


@interruptible
def plan(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | Literal["free"] | None = None,
    *,
    start: Any = None,
    start_base: Any = None,
    cyclic: bool = False,
    weights: Any = None,
    limits: Limits | None = None,
    search: SearchKind = "postures",
    seed: int = 0,
    time_cost: float = 1.0,
    obstacles: Any = (),
    clearance: float | None = 0.0,
    ignored: Any = (),
    srdf: Any = None,
    folders: Any = (),
    missing: str = "raise",
) -> Plan:
    """Plan the cheapest motion that does the tasks: the least integral of half the squared joint rates.

    Args:
        machine: On a fixed or a floating base; or standing, see `plan_to_stand`, whose cost is that of `plan_standing`.
        tasks: What its tips do; each from its `begin` on for its `duration`.
        horizon: s; None: until the last task ends. "free": the tasks may be done slower than they say, never faster;
            pace and self-motion are found at once, for the least of `time_cost` and joint rates together.
        start: Joints at the start, rad or m, shape (n,); None: wherever the first tasks can begin, which is searched.
        start_base: Base at the start, shape (base_size,); the machine's base_home() if None.
        cyclic: Whether the joints end where they start.
        weights: Of the squared joint rates, shape (n,); all 1 if None.
        limits: Of the joints' positions and rates; the robot's own if None. Where accelerations, jerks, torques or
            power are given, they hold at all times, and the robot's own torques with them, at the same cost (see
            `ocp.planning.driven`). Rates are then continuous, but as free at both ends as without: a machine that is to
            start from rest is asked to by its tasks, and what these leave free may move there.
        search: "start": from the given start, or from the one that is best conditioned of those that inverse kinematics
            finds; "postures": from all of these, and the cheapest motion is the plan. Each may slide along its
            self-motion. "global": the cheapest of all motions in the tasks' own time. On a fixed base with a `bound`
            that none falls below, for poses that leave at most two directions free, see `ocp.planning.search`. Joints
            that move no task's frame, as a gripper's, stand still then, as in `start` or in the middle of their limits.
            On a floating one of all that a search over exact states finds, without a bound, see `ocp.planning.cells`,
            which also goes on where local motions come to a singularity.
        seed: Of inverse kinematics.
        obstacles: Shapes in world, or `Moving` ones, that the machine's bodies stay clear of.
        clearance: Least distance to obstacles and between the links, m; None: nothing is looked at.
        ignored, srdf, folders, missing: As of `models.Surroundings`: pairs that are not looked at, and what becomes of
            meshes that are not found.
        time_cost: Of each second where the horizon is free, in units of the cost, (rad/s)^2; the larger, the nearer the
            motion is to that of least time.

    Returns:
        The plan, audited, with every other motion that was found, its cost and why it is not the plan.

    Raises:
        ProblemError: What is asked does not fit the machine, or cannot be asked at once; Unreachable, which is one,
            names the time and the place that is out of reach.
        SolveError: No motion passes its audit; says what became of each posture. DeadEnd, which is one: the search over
            all motions says from where on none goes on, what stops it, and how far the tasks would have to give way, or
            in how few pieces they may be done (`plan_in_pieces`).
    """
    if isinstance(machine, Standing):
        return plan_to_stand(
            machine,
            tasks,
            horizon,
            start=start,
            cyclic=cyclic,
            weights=weights,
            limits=limits,
            search=search,
            seed=seed,
            clear=clear_of(machine, obstacles, clearance, ignored, srdf, folders, missing, limits),
        )
    asked = checked_asked(machine, tasks, horizon, start, start_base, cyclic, weights, limits, search, seed, time_cost)
    asked = replace(asked, clear=clear_of(machine, obstacles, clearance, ignored, srdf, folders, missing, limits))
    return planned(asked, search, limits)


def planned(asked: Asked, search: SearchKind, limits: Limits | None) -> Plan:
    """As `plan`, of what is asked, under the `limits` that it was given.

    Raises:
        ProblemError, SolveError: As `plan`.
    """
    maker, made = _planned(asked, search)
    if limits is not None and limits_drives(limits):
        made = driven_plan(asked, maker.start, maker.reference, made, limits)
    return made if made.bound is None else replace(made, bound=checked_bound(made.bound, made.cost))


def _planned(asked: Asked, search: SearchKind) -> tuple[Maker, Plan]:
    """The plan under limits of positions and rates, and what made it.

    Raises:
        ProblemError, SolveError: As `plan`.
    """
    machine = asked.machine
    postures = postures_at_the_start(asked)
    if asked.start is not None and (touch := touches_at_the_start(asked, postures)[0]) is not None:
        assert asked.clear is not None
        around, name = asked.clear.surroundings, " and ".join(touch.bodies)
        ignored = [around.told_as(touch.pair)]
        words = f"start: {touch}; start clear of everything, or name what may touch: {ignored=}"
        words = "; ".join([words, *others_told(clear_postures(asked, touch.time))])
        raise ProblemError(words, name=name, value=touch.distance, limit=around.clearance, time=touch.time)
    given = asked.start
    if given is None:
        given, postures = settled(asked, postures)
    maker = Maker(asked, given, postures[0])
    told: list[Candidate] = []
    floats = machine.base_size > 0
    if search == "start" or (search == "postures" and len(postures) == 1):
        for joints in postures[:TRIED]:
            followed = followed_from(asked, joints[None])
            if floats and not follows(asked, followed)[0]:
                continue  # what such a guess leads to takes long, and fails
            alone = len(postures) == 1 and not floats
            told.append(maker.solved(joints, maker.motion.guess(followed, 0), thorough=alone))
            if not told[-1].why or alone:
                return maker, maker.plan(told)
    followed = followed_from(asked, postures)
    if floats and (search == "global" or len(postures) == 1):
        return maker, maker.plan(told + _through_cells(maker, followed, postures, every=search == "global"))
    searched = TaskSearch(asked, followed) if search == "global" else None
    if searched is not None:
        if not np.isfinite(searched.bound) and (end := searched.dead_end()) is not None:
            raise end
        for every in (False, True):
            found = searched.followed(every)
            if found[0].cost.size:
                told += fine_motions(maker, coarse_motions(maker, found, found[0].joints[:, 0]), first=False)
                told += closer_motions(maker, found, told, ENOUGH * searched.bound)
            if any(not one.why for one in told):
                return maker, replace(maker.plan(told), bound=searched.bound)
        while searched.looked_closer():
            if not np.isfinite(searched.bound) and (end := searched.dead_end()) is not None:
                raise end
    told += fine_motions(maker, coarse_motions(maker, followed, postures), first=search == "start")
    if all(one.why and not one.why.startswith(TOUCHES) for one in told):  # whatever helps a solver, and what conflicts
        if floats:
            return maker, maker.plan(told + _through_cells(maker, followed, postures, every=False))
        told.append(maker.solved(postures[0], maker.motion.guess(followed, 0), thorough=True))
    try:
        made = maker.plan(told)
    except SolveError as error:
        if searched is not None and (end := searched.dead_end()) is not None:
            raise end from error
        raise
    return maker, made if searched is None else replace(made, bound=searched.bound)


def _through_cells(maker: Maker, followed: list[Followed], postures: Array, every: bool) -> list[Candidate]:
    """The motions of a floating machine that a search over exact states leads to, with those that local ones do.

    Raises:
        Unreachable, DeadEnd: As of `CellSearch`, where no local motion leads on either.
    """
    sound = np.flatnonzero(follows(maker.asked, followed))
    local, found = list[Candidate](), list[list[Followed]]()
    stuck: DeadEnd | None = None
    try:
        found = CellSearch(maker.asked, postures).followed()
    except DeadEnd as error:
        stuck = error
    if sound.size and (every or stuck):
        local = coarse_motions(maker, [part.of(sound) for part in followed], postures[sound], fine=every)
    if stuck:
        if all(one.why for one in local):
            raise stuck
        return fine_motions(maker, local, first=False, every=every)
    if every:
        least = [float(np.sum([part.cost for part in ways], axis=0).min()) for ways in found]
        for ways, cost in zip(found, least, strict=True):
            if ways is found[0] or cost < least[0]:
                local = coarse_motions(maker, ways, ways[0].joints[:, 0], True, local)
        return fine_motions(maker, local, first=False, every=True)
    told, maker.brief = list[Candidate](), True
    for begin in range(0, TRIED, AT_ONCE):
        for some in ([part.of(slice(begin, begin + AT_ONCE)) for part in ways] for ways in found):
            if some[0].cost.size:
                told += fine_motions(maker, coarse_motions(maker, some, some[0].joints[:, 0], True), first=True)
            if any(not one.why for one in told):
                return told
    why = f"not tried, for the {TRIED} cheapest of its search fail"
    return told + [Candidate(one, np.nan, why) for ways in found for one in ways[0].joints[TRIED:, 0]]


def clear_of(
    machine: Machine,
    obstacles: Any,
    clearance: Any,
    ignored: Any,
    srdf: Any,
    folders: Any,
    missing: Any,
    limits: Limits | None,
) -> Clear | None:
    """What a motion has to stay clear of; None where there is nothing.

    Raises:
        ProblemError: What is given is not what `plan` takes, or given where nothing is looked at.
    """
    if clearance is None:
        for what, value in (("obstacles", obstacles), ("ignored", ignored), ("srdf", srdf)):
            if not _empty(value):
                words = f"{what} are of no use where nothing is looked at; give a clearance in m, 0 to touch nothing"
                raise ProblemError(words, name=what, value=value)
        return None
    try:
        kept = not isinstance(limits, Limits) or limits.joints
        around = Surroundings(machine, obstacles, clearance, ignored, srdf, folders, missing, kept)
    except ModelError as error:
        raise ProblemError(str(error), **vars(error)) from error
    return Clear(around) if len(around.pairs) else None


def _empty(value: Any) -> bool:
    return value is None or (isinstance(value, tuple | list) and not len(value))


def checked_asked(
    machine: Machine,
    tasks: Any,
    horizon: Any,
    start: Any,
    start_base: Any,
    cyclic: Any,
    weights: Any,
    limits: Any,
    search: Any,
    seed: Any,
    time_cost: Any,
) -> Asked:
    """What `plan` is asked, but for what has to be clear.

    Raises:
        ProblemError: As `plan`.
    """
    checked_choice("search", search, get_args(SearchKind))
    checked_flag("cyclic", cyclic)
    checked_count("seed", seed, 0, LARGEST_SEED)
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    equations = bind(machine, given)
    told = Limits() if limits is None else checked_instance("limits", limits, Limits)
    free = isinstance(horizon, str)
    if free:
        checked_choice("horizon", horizon, ("free",))
        if search == "global":
            words = "search='global' keeps the tasks' own time; give a horizon in s, or search='postures'"
            raise ProblemError(words, name="search", value="global")
    checked_positive("time_cost", time_cost)
    told.bounds(machine, ("velocity", "torque") if limits_drives(told) else ("velocity",))
    if limits_drives(told):
        checked_motors("plan: limits of drives", machine)
        if free:
            words = "a free horizon knows no limits of drives; give it in s, or limit the rates alone"
            raise ProblemError(words, name="horizon", value=horizon)
    if horizon is None or free:
        ends = [task.end for task in given if task.duration is not None]
        if not ends:
            words = "horizon is missing: no task says how long it lasts; give plan(..., horizon=...) in s"
            raise ProblemError(words, name="horizon")
        horizon = max(ends)
    duration = checked_horizon(horizon)
    place = checked_configuration(machine, np.zeros(machine.joint_size), start_base)[1]
    joints = None if start is None else checked_configuration(machine, start, start_base)[0]
    stretches = stretches_of(machine, given, duration)
    middle = np.zeros(machine.joint_size) if joints is None else joints
    for stretch in stretches:
        if stretch.equations is not None:
            first = stretch is stretches[0] and joints is not None
            checked_tasks(stretch.equations, place, middle, duration, start=first)
    del equations
    if joints is not None:
        bounds = told.bounds(machine)
        names, hint = machine.robot.joint_names, "start inside them"
        joints = inside_limits("start", names, joints, bounds.lower, bounds.upper, hint)
    heavy = checked_weights(weights, machine.joint_size)
    return Asked(
        machine,
        given,
        duration,
        stretches,
        joints,
        place,
        heavy,
        without_drives(told),
        cyclic,
        int(seed),
        float(time_cost) if free else None,
        holds_idle=search == "global",
    )
