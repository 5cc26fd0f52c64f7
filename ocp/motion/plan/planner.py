"""One call from a machine and its tasks to the cheapest motion that passes its audit, or the reasons why there is none.

Where the start is not given it is searched: inverse kinematics finds postures at the start, in every branch and spread
over the self-motion. Each is followed through the tasks by its local motion, which is the seed of a candidate, the
start free along its self-motion (`plan.planner`). Candidates are advanced from stage to stage, the cheapest first
(`ocp.motion.plan.candidate_queue`), until none is left that may be cheaper than what was found.

Where candidates come from: one posture, all that inverse kinematics finds, or a search over all motions.

Each kind of seeds that takes more work is tried where none before it led to a plan, or to one that is good enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from models import CollisionScene, Machine, ModelError, Standing
from models.arrays import Array
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
from ocp.motion.builders.actuator_limits import checked_motors
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.inverse_kinematics import LARGEST_SEED
from ocp.motion.local.rates import LocalMotion
from ocp.motion.plan.actuators import limits_actuators, without_actuators
from ocp.motion.plan.candidate import Candidate, Reason, Rejection, Seed
from ocp.motion.plan.candidate_queue import CandidateQueue
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.plan.motion import Plan
from ocp.motion.plan.standing import plan_to_stand
from ocp.motion.search.cells import CellSearch, follows
from ocp.motion.search.configurations import (
    OUT_OF_REACH,
    Asked,
    SearchKind,
    check_clear_start,
    followed_from,
    misfits_of,
    postures_at_the_start,
    settled,
    touches_at_the_start,
)
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.search.search import checked_bound
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.checks import checked_configuration, checked_tasks, checked_weights, clip_to_limits, horizon_of
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["checked_asked", "clear_of", "plan", "plan_from_seeds", "planned", "seeds_of"]


def plan_from_seeds(request: Asked, postures: Array, solver: CandidateSolver) -> tuple[Plan, float | None]:
    """The plan that postures lead to, and a lower bound of its cost; None if none was looked for.

    Args:
        request: What is asked.
        postures: Joints at the start, the best conditioned first. Shape (K, n).
        solver: Of the candidates.

    Raises:
        ProblemError, SolveError: As `ocp.motion.plan.plan`.
    """
    queue = CandidateQueue(solver, request.settings)
    floats, alone = request.machine.base_size > 0, len(postures) == 1
    if request.search == "start" or (request.search == "postures" and alone):
        _one_by_one(queue, solver, postures, last=alone and not floats)
        if queue.passed or (alone and not floats):
            return queue.plan(), None
    followed = followed_from(request, postures)
    if floats and (request.search == "global" or alone):
        _through_cells(queue, solver, followed, postures)
        return queue.plan(), None
    searched = TaskSearch(request, followed) if request.search == "global" else None
    if searched is not None:
        _all_motions(queue, solver, searched)
        if queue.passed:
            return queue.plan(), searched.bound
    seeds = seeds_of(solver, followed, postures)
    queue.run(seeds)
    if not queue.passed and queue.collided and not solver.barred:
        _alternatives(queue, solver, seeds)
    if not queue.passed and not queue.collided:  # whatever helps a solver, and what conflicts
        if floats:
            _through_cells(queue, solver, followed, postures)
        else:
            seed = seeds_of(solver, followed_from(request, postures[:1]), postures[:1], direct=True, thorough=True)
            queue.run(seed)
    try:
        return queue.plan(), None if searched is None else searched.bound
    except SolveError as error:
        if searched is not None and (end := searched.dead_end()) is not None:
            raise end from error
        raise


def seeds_of(
    solver: CandidateSolver, followed: Sequence[LocalMotion], postures: Array, **kind: bool
) -> list[Candidate]:
    """Candidates of local motions, those that do their tasks before others, then the cheapest first.

    Args:
        followed: The motions, through each stretch of time.
        postures: They begin with. Shape (K, n).
        kind: What else the seeds say, as of `Seed`.
    """
    misfits, costs = np.array(misfits_of([*followed])), np.sum([part.cost for part in followed], axis=0)
    tracked = misfits <= max(OUT_OF_REACH, misfits.min(initial=np.inf))
    seeds = []
    for number in np.lexsort((costs, ~tracked)).tolist():
        local = [part.take(slice(number, number + 1)) for part in followed]
        guess = solver.motion.guess(local, 0)
        seed = Seed(guess, float(costs[number]), local, bool(tracked[number]), **kind)
        seeds.append(
            Candidate(
                postures[number], seed.cost, seed=seed, clearance_constraints=solver.request.clearance_constraints
            )
        )
    return seeds


def _one_by_one(queue: CandidateQueue, solver: CandidateSolver, postures: Array, last: bool) -> None:
    """Postures one after the other, the best conditioned first, until one leads to a plan.

    Args:
        last: Whether nothing else is tried where none does.
    """
    request = solver.request
    for joints in postures[: request.settings.max_failures]:
        followed = followed_from(request, joints[None])
        if request.machine.base_size and not follows(request, followed)[0]:
            continue  # what such a guess leads to takes long, and fails
        queue.run(seeds_of(solver, followed, joints[None], direct=True, thorough=last))
        if queue.passed:
            return


def _all_motions(queue: CandidateQueue, solver: CandidateSolver, searched: TaskSearch) -> None:
    """The classes of motions that may be the cheapest; where none of these passes one of every class.

    A free start and a coarse mesh may lead away from a motion that is nearly the cheapest. So motions of the search
    that promise to be cheaper than what passed are solved as they are, their starts fixed, until the plan is near its
    bound.

    Raises:
        DeadEnd: Motions end somewhere.
    """
    settings = solver.settings
    _check_dead_end(searched)
    for every in (False, True):
        found = searched.followed(every)
        if found[0].cost.size:
            starts = found[0].joints[:, 0]
            queue.run(seeds_of(solver, found, starts))
            fixed = solver.request.start is None
            for seed in seeds_of(solver, found, starts, direct=True, fixed=fixed):
                near = queue.cost <= settings.near_bound * searched.bound
                if near or seed.cost >= (1 - settings.gain) * queue.cost:
                    break
                queue.run([seed])
        if queue.passed:
            return
    while searched.looked_closer():
        _check_dead_end(searched)


def _check_dead_end(searched: TaskSearch) -> None:
    if not np.isfinite(searched.bound) and (end := searched.dead_end()) is not None:
        raise end


def _through_cells(
    queue: CandidateQueue, solver: CandidateSolver, followed: Sequence[LocalMotion], postures: Array
) -> None:
    """The motions of a floating machine that a search over exact states leads to, with those that local ones do.

    Raises:
        Unreachable, DeadEnd: As of `CellSearch`, where no local motion leads on either.
    """
    request, every = solver.request, solver.request.search == "global"
    sound = np.flatnonzero(follows(request, followed))
    local = seeds_of(solver, [part.take(sound) for part in followed], postures[sound], direct=every)
    try:
        found = CellSearch(request, postures).followed()
    except DeadEnd:
        queue.run(local, every)
        if not queue.passed:
            raise
        return
    batches = [seeds_of(solver, ways, ways[0].joints[:, 0], direct=True) for ways in found]
    if every:
        least = [min((seed.cost for seed in batch), default=np.inf) for batch in batches]
        cheaper = [batch for batch, cost in zip(batches, least, strict=True) if batch is batches[0] or cost < least[0]]
        queue.run([*local, *(seed for batch in cheaper for seed in batch)], every=True)
        return
    # where others wait a motion is given up early
    settings = request.settings
    solver.settings = replace(settings, max_refinements=2, max_deviation=OUT_OF_REACH)
    for begin in range(0, settings.max_failures, settings.batch):
        for batch in batches:
            queue.run(batch[begin : begin + settings.batch])
            if queue.passed:
                return
    reason = Reason(Rejection.NOT_TRIED, f"the {settings.max_failures} cheapest of its search fail")
    rest = [seed for batch in batches for seed in batch[settings.max_failures :]]
    queue.candidates += [seed.rejected(reason) for seed in rest]


def _alternatives(queue: CandidateQueue, solver: CandidateSolver, seeds: list[Candidate]) -> None:
    """Run candidates whose motions collide, each from its own local motion; then with starts that are clear and fixed.

    Where nothing is in the way postures slide along their self-motion into one motion, however clear they were. Their
    local motions pass on other sides; those that are clear, or nearest to it, come first. And a start that may slide is
    pushed about by all that is separated later on the way; fixed, what it leads to is nearer.
    """
    request, most = solver.request, solver.settings.max_failures
    ended = {id(one.seed): one for one in queue.candidates}
    ways = []
    for seed in seeds:
        end = ended[id(seed.seed)]
        colliding = solver.collisions(end)
        if end.clearance_constraints is not None and (colliding or end.clearance_constraints.margins):
            local = solver.local_collisions(seed.seed)
            clearance_constraints = end.clearance_constraints.holding([touch.pair for touch in (*colliding, *local)])
            ways.append(
                (
                    min((touch.distance for touch in local), default=np.inf),
                    replace(seed, clearance_constraints=clearance_constraints),
                )
            )
    others = [seed for _, seed in sorted(ways, key=lambda way: -way[0])[:most]]
    if request.start is None:
        touching_starts = touches_at_the_start(request, np.array([seed.start for seed in seeds]))
        clear_starts = [seed for seed, touch in zip(seeds, touching_starts, strict=True) if touch is None]
        tracked = [one for one in clear_starts if max(misfits_of([*one.seed.local])) <= OUT_OF_REACH]
        tracked.sort(key=lambda one: one.seed.cost)
        others += [replace(one, seed=replace(one.seed, direct=True, fixed=True)) for one in tracked[:most]]
    for seed in others:
        start = seed.start
        queue.candidates = [one for one in queue.candidates if one.start is not start]  # which ends anew
        queue.run([seed])
        if queue.passed:
            return


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
            `plan.actuators`). Rates are then continuous, but as free at both ends as without: a machine that is
            to start from rest is asked to by its tasks, and what these leave free may move there.
        search: "start": from the given start, or from the one that is best conditioned of those that inverse kinematics
            finds; "postures": from all of these, and the cheapest motion is the plan. Each may slide along its
            self-motion. "global": the cheapest of all motions in the tasks' own time. On a fixed base with a `bound`
            that none falls below, for poses that leave at most two directions free, see `search.search`. Joints
            that move no task's frame, as a gripper's, stand still then, as in `start` or in the middle of their limits.
            On a floating one of all that a search over exact states finds, without a bound, see `search.cells`,
            which also goes on where local motions come to a singularity.
        seed: Of inverse kinematics.
        obstacles: Shapes in world, or `MovingObstacle` ones, that the machine's bodies stay clear of.
        clearance: Least distance to obstacles and between the links, m; None: nothing is looked at.
        ignored, srdf, folders, missing: As of `models.CollisionScene`: pairs that are not checked, and what becomes of
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
            in how few pieces they may be done (`plan_in_segments`).
    """
    around = (machine, obstacles, clearance, ignored, srdf, folders, missing, limits)
    if isinstance(machine, Standing):
        given = {"start": start, "cyclic": cyclic, "weights": weights, "limits": limits, "search": search, "seed": seed}
        return plan_to_stand(machine, tasks, horizon, clearance_constraints=clear_of(*around), **given)
    asked = checked_asked(machine, tasks, horizon, start, start_base, cyclic, weights, limits, search, seed, time_cost)
    return planned(replace(asked, clearance_constraints=clear_of(*around)))


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
) -> ClearanceConstraints | None:
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
        around = CollisionScene(machine, obstacles, clearance, ignored, srdf, folders, missing, kept)
    except ModelError as error:
        raise ProblemError(str(error), **vars(error)) from error
    return ClearanceConstraints(around) if len(around.pairs) else None


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
        joints = clip_to_limits("start", names, joints, bounds.lower, bounds.upper, hint)
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
