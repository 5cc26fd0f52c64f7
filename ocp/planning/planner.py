"""One call from a machine and its tasks to the cheapest motion that passes its audit, or the reasons why there is none.

Where the start is not given it is searched: inverse kinematics finds postures at the start, in every branch and spread
over the self-motion. Each is followed through the tasks by its local motion, which is the seed of a candidate, the
start free along its self-motion (`ocp.planning.seeds`). Candidates are advanced from stage to stage, the cheapest first
(`ocp.planning.candidate_queue`), until none is left that may be cheaper than what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from models import Machine, ModelError, Standing, Surroundings
from ocp.builders.clearance import Clear
from ocp.builders.drives import checked_motors
from ocp.builders.tool_motion import stretches_of
from ocp.console import interruptible
from ocp.errors import (
    ProblemError,
    checked_choice,
    checked_count,
    checked_each,
    checked_flag,
    checked_instance,
    checked_positive,
)
from ocp.local.inverse_kinematics import LARGEST_SEED
from ocp.planning.actuators import limits_actuators, without_actuators
from ocp.planning.candidate_solver import CandidateSolver
from ocp.planning.motion import Plan
from ocp.planning.postures import Asked, SearchKind, check_clear_start, postures_at_the_start, settled
from ocp.planning.search import checked_bound
from ocp.planning.seeds import plan_from_seeds
from ocp.planning.standing import plan_to_stand
from ocp.tasks.checks import checked_configuration, checked_tasks, checked_weights, horizon_of, inside_limits
from ocp.tasks.equations import bind
from ocp.tasks.limits import Limits
from ocp.tasks.tip_task import TipTask

__all__ = ["checked_asked", "clear_of", "plan", "planned"]


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
            `ocp.planning.actuators`). Rates are then continuous, but as free at both ends as without: a machine that is
            to start from rest is asked to by its tasks, and what these leave free may move there.
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
    around = (machine, obstacles, clearance, ignored, srdf, folders, missing, limits)
    if isinstance(machine, Standing):
        given = {"start": start, "cyclic": cyclic, "weights": weights, "limits": limits, "search": search, "seed": seed}
        return plan_to_stand(machine, tasks, horizon, clear=clear_of(*around), **given)
    asked = checked_asked(machine, tasks, horizon, start, start_base, cyclic, weights, limits, search, seed, time_cost)
    return planned(replace(asked, clear=clear_of(*around)))


def planned(asked: Asked) -> Plan:
    """As `plan`, of what is asked.

    Raises:
        ProblemError, SolveError: As `plan`.
    """
    postures = postures_at_the_start(asked)
    start = asked.start
    if start is None:
        start, postures = settled(asked, postures)
    else:
        check_clear_start(asked, postures)
    made, bound = plan_from_seeds(asked, postures, CandidateSolver(asked, start, postures[0]))
    return made if bound is None else replace(made, bound=checked_bound(bound, made.cost))


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
    told.bounds(machine, ("velocity", "torque") if limits_actuators(told) else ("velocity",))
    if limits_actuators(told):
        checked_motors("plan: limits of drives", machine)
        if free:
            words = "a free horizon knows no limits of drives; give it in s, or limit the rates alone"
            raise ProblemError(words, name="horizon", value=horizon)
    duration = horizon_of(given, None if free else horizon)
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
        without_actuators(told),
        cyclic,
        int(seed),
        float(time_cost) if free else None,
        search=search,
        drives=told if limits_actuators(told) else None,
    )
