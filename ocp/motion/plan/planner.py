"""Planner of tip tasks: from start configurations to the lowest-cost motion that passes its audit.

If the start is not given, inverse kinematics finds start configurations on every branch and spread over the
self-motion. Resolved-rate control tracks the tasks from each of them. These local motions are the initial guesses
(seeds) of candidates, whose start is free along its self-motion. The queue advances the candidates by rising cost
(`ocp.motion.plan.candidate_queue`), until none is left that may cost less than the best one found.

Seeds come from one configuration, from all that inverse kinematics finds, or from a global search. A more expensive
kind of seeds is used only if the kinds before it led to no plan, or to none that is good enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from models import CollisionScene, Machine
from models.checks import Array
from ocp.console import TimeLimitReached, report
from ocp.errors import ProblemError, SolveError, problem_errors, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import checked_motors
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion, tracking_weights
from ocp.motion.plan.actuators import cost_of_motion, limits_actuators, weights_actuators, without_actuators
from ocp.motion.plan.candidate_queue import CandidateQueue
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Seed, Stage
from ocp.motion.result.path_plan import UNLIMITED_RATE
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.cells import CellSearch, tracks_tasks
from ocp.motion.search.configurations import (
    REACH_TOLERANCE,
    PlanRequest,
    largest_pose_errors,
    local_motions_from,
    start_collisions,
)
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.search.held_joints import (
    fix_ignorable_joints,
    hold_idle_joints,
    move_aside,
    place_held_joints,
    release_obstructing,
    restore_error,
)
from ocp.motion.search.search import MAX_FREE_DIRECTIONS, checked_bound
from ocp.motion.search.task_search import TaskSearch, require_poses, tool_rate_bound
from ocp.motion.tasks.checks import are_at_rest, checked_tasks, clip_to_limits, horizon_of
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.goals import Cost, Scene, Start
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask


def plan_from_configurations(
    request: PlanRequest, configurations: Array, solver: CandidateSolver
) -> tuple[SolvedPlan, float | None]:
    """Return the lowest-cost plan from any of the start configurations, and a lower cost bound (None if unknown).

    The configurations (K, n) are sorted, the best conditioned first. Raises ProblemError and SolveError as `plan`.
    """
    # the lowest cost of the squared rates is not that of another cost
    queue = CandidateQueue(solver, request.settings, include_costlier=request.cost is not None)
    floating, single = request.machine.base_size > 0, len(configurations) == 1
    if request.search == "start" or (request.search == "configurations" and single):
        _try_one_by_one(queue, solver, configurations, thorough=single and not floating)
        if queue.passed or queue.exhausted or (single and not floating):
            return _final_plan(queue, solver), None
    report(f"local motions from {len(configurations)} starts")
    motions = local_motions_from(request, configurations)
    if floating and (request.search == "global" or single):
        _search_cells(queue, solver, motions, configurations)
        return _final_plan(queue, solver), None
    search, unsearched = None, request.search == "global" and request.redundancy > MAX_FREE_DIRECTIONS
    if unsearched:
        require_poses(request)
    elif request.search == "global":
        report("global search")
        search = TaskSearch(request, motions)
        _search_globally(queue, solver, search)
        if queue.passed:
            return _final_plan(queue, solver), search.bound
    seeds = candidates_from(solver, motions)
    queue.run(seeds, include_costlier=unsearched)
    if not queue.passed:
        _search_again(queue, solver, motions, configurations, seeds)
    try:
        result = _final_plan(queue, solver)
    except SolveError as error:
        if search is not None and (dead_end := search.dead_end()) is not None:
            raise dead_end from error
        raise
    if unsearched:
        return result, tool_rate_bound(request) or None
    return result, None if search is None else search.bound


def _final_plan(queue: CandidateQueue, solver: CandidateSolver) -> SolvedPlan:
    """Return the plan of the candidate that costs least in terms of the cost function of the request.

    If this function is not the integral of the squared rates, all motions that passed are solved again for this
    function, in the order of their previous costs. If no motion passed, raise SolveError.
    """
    if (cost := solver.request.cost) is None or not queue.passed:
        return queue.plan()
    passed = [replace(c, cost=cost_of_motion(solver.plan([c]), cost)) for c in queue.candidates if c.passed]
    last_solver = copy(solver)
    last_solver.last = Stage.ACTUATED  # the stage that minimises this cost
    weighted = CandidateQueue(last_solver, queue.settings, include_costlier=True)
    weighted.run(passed)
    weighted.candidates += [replace(c, cost=np.nan) for c in queue.candidates if not c.passed]
    return weighted.plan()


def candidates_from(solver: CandidateSolver, motions: Sequence[LocalMotion], **options: bool) -> list[Candidate]:
    """Return candidates with local (resolved-rate) motions as guesses, by cost; motions that miss the tasks come last.

    The cost includes the cost of the approach from the configuration `near` of the request. `motions` are K local
    motions through each time interval, `options` further fields of `Seed`.
    """
    errors, costs = np.array(largest_pose_errors([*motions])), np.sum([motion.cost for motion in motions], axis=0)
    approaches = _approach_costs(solver.request, motions[0].joints[:, 0])
    tracked = errors <= max(REACH_TOLERANCE, errors.min(initial=np.inf))
    candidates = []
    for index in np.lexsort((costs + approaches, ~tracked)).tolist():
        local = [motion.take(slice(index, index + 1)) for motion in motions]
        guess = solver.motion.guess(local, 0)
        relaxed = solver.is_nearly_singular(local)
        cost, approach = float(costs[index]), float(approaches[index])
        seed = Seed(guess, cost, approach, local, bool(tracked[index]), relaxed=relaxed, **options)
        constraints = solver.request.clearance_constraints
        candidates.append(Candidate(motions[0].joints[index, 0], seed.cost, seed=seed, constraints=constraints))
    return candidates


def _approach_costs(request: PlanRequest, starts: Array) -> Array:
    """Return estimated costs (K,) of straight approaches to start configurations (K, n) at the velocity limits."""
    if request.near is None:
        return np.zeros(len(starts))
    changes, velocity = np.abs(starts - request.near), request.bounds.velocity
    durations = (changes / np.where(np.isfinite(velocity), velocity, UNLIMITED_RATE)).max(axis=1, initial=0.0)
    squares = np.divide(changes**2 @ request.weights, durations, out=np.zeros(len(starts)), where=durations > 0)
    return np.asarray(squares / 2 + (0.0 if request.cost is None else request.cost.time) * durations)


def _search_again(
    queue: CandidateQueue,
    solver: CandidateSolver,
    motions: Sequence[LocalMotion],
    configurations: Array,
    seeds: list[Candidate],
) -> None:
    """Search again after all candidates failed: with separated bodies if some collided, else from other guesses."""
    if queue.collided and not solver.no_clear_configuration:
        _try_alternatives(queue, solver, seeds)
    if queue.passed or queue.collided or queue.exhausted:
        return
    if solver.request.machine.base_size:
        _search_cells(queue, solver, motions, configurations)
    else:
        motions = local_motions_from(solver.request, configurations[:1])
        queue.run(candidates_from(solver, motions, direct=True, thorough=True))


def _try_one_by_one(queue: CandidateQueue, solver: CandidateSolver, configurations: Array, thorough: bool) -> None:
    """Try start configurations one after the other until one leads to a plan; if `thorough`, diagnose failures."""
    request = solver.request
    for joints in configurations[: request.settings.max_failures]:
        motions = local_motions_from(request, joints[None])
        if request.machine.base_size and not tracks_tasks(request, motions)[0]:
            continue  # solving from such a guess is slow and fails
        queue.run(candidates_from(solver, motions, direct=True, thorough=thorough))
        if queue.passed or queue.exhausted:
            return


def _search_globally(queue: CandidateQueue, solver: CandidateSolver, search: TaskSearch) -> None:
    """Solve candidates from the promising motions of a global search; if none passes, from all of its motions.

    A free start and a coarse mesh may lead away from a nearly optimal motion. Motions of the search that promise a
    lower cost than the plan are therefore solved in other ways as well, and then motions of a search at twice as many
    times, until the plan is close to its bound. Classes of motions that were not solved are listed as candidates.
    """
    _check_dead_end(search)
    for finer in (False, True):
        if finer and not (queue.passed and search.refine_samples(everywhere=True)):
            break
        solved = any(_solve_classes(queue, solver, search, costlier) for costlier in (False, True))
        if queue.cost <= search.near_cost or (finer and solved):
            return
    if queue.passed:
        for bound, time, joints in search.unresolved(queue.cost):
            words = f"motions near this configuration at {time:.4g} s may cost {bound:.6g}; the search found no path"
            reason = Reason(Rejection.NOT_TRIED, words, "bound", bound, queue.cost, time)
            queue.candidates.append(Candidate(joints, reason=reason))
    while not queue.passed and search.refine_samples():
        _check_dead_end(search)


def _solve_classes(queue: CandidateQueue, solver: CandidateSolver, search: TaskSearch, include_costlier: bool) -> bool:
    """Solve candidates from a global search; return whether one has passed and no other promises to cost less.

    Where the solver fails, the motion of the search is the guess on the fine mesh, with its start fixed, then with a
    free start and, at last, with relaxed tasks.
    """
    motions, gain = search.local_motions(include_costlier), solver.settings.gain
    if not motions[0].cost.size:
        return False
    queue.run(candidates_from(solver, motions))
    for options in ({"fixed": solver.request.start is None}, {"thorough": True}):
        for seed in candidates_from(solver, motions, direct=True, **options):
            if queue.cost <= search.near_cost or seed.cost >= (1 - gain) * queue.cost:
                return queue.passed
            if queue.passed or "fixed" in options:
                queue.run([seed])
    return False


def _check_dead_end(search: TaskSearch) -> None:
    if not np.isfinite(search.bound) and (dead_end := search.dead_end()) is not None:
        raise dead_end


def _search_cells(
    queue: CandidateQueue, solver: CandidateSolver, motions: Sequence[LocalMotion], configurations: Array
) -> None:
    """Solve candidates of a floating-base machine, from a forward search over grid cells and from local motions.

    If there are none, raise the error of the `CellSearch`.
    """
    request, include_costlier = solver.request, solver.request.search == "global"
    tracked = np.flatnonzero(tracks_tasks(request, motions))
    motions = [motion.take(tracked) for motion in motions]
    local = candidates_from(solver, motions, direct=include_costlier)
    try:
        passes = CellSearch(request, configurations).local_motions()
    except DeadEnd:
        queue.run(local, include_costlier)
        if not queue.passed:
            raise
        return
    batches = [candidates_from(solver, motions, direct=True) for motions in passes]
    if include_costlier:
        lowest_costs = [min((seed.cost for seed in batch), default=np.inf) for batch in batches]
        lower = [batch for batch, cost in zip(batches, lowest_costs, strict=True) if cost < lowest_costs[0]]
        queue.run([*local, *(seed for batch in (*batches[:1], *lower) for seed in batch)], include_costlier=True)
        return
    # give up a motion early while others wait
    settings = request.settings
    solver.settings = replace(settings, max_refinements=2, max_deviation=REACH_TOLERANCE)
    for begin in range(0, settings.max_failures, settings.batch):
        for batch in batches:
            queue.run(batch[begin : begin + settings.batch])
            if queue.passed:
                return
    reason = Reason(Rejection.NOT_TRIED, f"the {settings.max_failures} lowest-cost motions of its search fail")
    rest = [seed for batch in batches for seed in batch[settings.max_failures :]]
    queue.candidates += [seed.with_rejection(reason) for seed in rest]


def _try_alternatives(queue: CandidateQueue, solver: CandidateSolver, seeds: list[Candidate]) -> None:
    """Solve candidates again: with separation constraints on colliding bodies, or from fixed collision-free starts.

    Without obstacles, free starts slide along their self-motion into one motion, whatever their clearance. Their local
    motions belong to different homotopy classes; motions without or with the least collision come first. A free start
    is also displaced by every separation later on the path. A fixed one leads to a motion closer to its guess.
    """
    request, max_tries = solver.request, solver.settings.max_failures
    finished_by_seed = {id(candidate.seed): candidate for candidate in queue.candidates}
    rerouted = []
    local = {id(seed): solver.local_collisions(seed.seed) for seed in seeds}
    distances = {key: min((each.distance for each in pairs), default=np.inf) for key, pairs in local.items()}
    for seed in seeds:
        finished = finished_by_seed[id(seed.seed)]
        colliding = solver.collisions(finished)
        if finished.constraints is not None and (colliding or finished.constraints.margins):
            constraints = finished.constraints.with_collisions([*colliding, *local[id(seed)]])
            rerouted.append((distances[id(seed)], replace(seed, constraints=constraints)))
    alternatives = sorted(rerouted, key=lambda entry: -entry[0])[:max_tries]
    if request.start is None:
        collisions = start_collisions(request, np.array([seed.start for seed in seeds]))
        clear_starts = [seed for seed, collision in zip(seeds, collisions, strict=True) if collision is None]
        tracked = [c for c in clear_starts if max(largest_pose_errors([*c.seed.local])) <= REACH_TOLERANCE]
        tracked.sort(key=lambda candidate: candidate.seed.cost)
        fixed = [(c, replace(c.seed, direct=True, fixed=True)) for c in tracked[:max_tries]]
        alternatives += [(distances[id(c)], replace(c, seed=seed)) for c, seed in fixed]
    for _, seed in sorted(alternatives, key=lambda entry: -entry[0]):
        start = seed.start
        queue.candidates = [c for c in queue.candidates if c.start is not start]  # this candidate finishes again
        queue.run([seed])
        if queue.passed:
            return


def plan_request(request: PlanRequest) -> SolvedPlan:
    """Plan a checked request; after a failure, move or release joints that were held at rest, and try again.

    Raises:
        ProblemError, SolveError: As in `plan`.
    """
    attempt, changes = hold_idle_joints(request), [move_aside, release_obstructing]
    while True:
        try:
            return _plan_attempt(request, attempt)
        except SolveError as error:
            following = None
            while following is None and changes:
                following = changes.pop(0)(request, attempt, error)
            if following is None:
                raise
            attempt = following


def _plan_attempt(whole: PlanRequest, request: PlanRequest) -> SolvedPlan:
    """Plan a request with some joints held at rest; `whole` is the request before these were held."""
    report("inverse kinematics of the start")
    request, configurations = place_held_joints(whole, request)
    start = request.start
    if start is None:
        start, configurations = fix_ignorable_joints(request, configurations)
    solver = CandidateSolver(request, start, configurations[0])
    try:
        result, bound = plan_from_configurations(request, configurations, solver)
    except TimeLimitReached as error:
        error.advice = _wheel_advice(request, configurations[0])
        raise
    except (SolveError, Unreachable) as error:
        if isinstance(error, SolveError):
            error.args = (f"{error}{_wheel_advice(request, configurations[0])}",)
        raise restore_error(error, request) from error.__cause__
    if bound is None or (request.cost is not None and not request.cost.velocity):
        return result
    return replace(result, bound=checked_bound(bound, result.cost))


def _wheel_advice(request: PlanRequest, joints: Array) -> str:
    """Return which weights to lower if reaction wheels are so costly that motions are hard to find, else ""."""
    weights, *light = tracking_weights(request.machine, request.base, joints, request.weights)
    if not light:
        return ""
    names = request.machine.robot.joint_names
    low = ", ".join(f"{light[0][k]:.1e} for {names[k]!r}" for k in np.flatnonzero(light[0] < weights))
    words = "; lower weights of the reaction wheels in Cost(weights=...) make motions easier to find; they cost no more"
    return f"{words} than the arm with {low}"


def clearance_for(
    machine: Machine, limits: Limits | None, scene: Scene | Literal[False] | None, *, why_static: str = ""
) -> ClearanceConstraints | None:
    """Return the clearance constraints of a motion in a scene; None if no pair of bodies needs a check.

    `why_static` is the text of the error about a moving obstacle; "" if obstacles may move.

    Raises:
        ProblemError: A value of the scene is invalid, or does not fit the machine; or an obstacle may not move.
    """
    if scene is False:
        return None
    own = Scene() if scene is None else require.instance("scene", scene, Scene)
    joint_limits = not isinstance(limits, Limits) or limits.joints
    report("collision scene")
    with problem_errors():
        collision_scene = CollisionScene(
            machine, own.obstacles, own.clearance, own.ignored, own.srdf, own.folders, own.missing, joint_limits
        )
    if not len(collision_scene.pairs):
        return None
    if why_static and collision_scene.has_moving_obstacles:
        raise ProblemError(why_static, name="obstacles", value=collision_scene.obstacles)
    return ClearanceConstraints(collision_scene)


@dataclass(frozen=True)
class PlanOptions:
    """Options of `plan` besides machine, tasks, horizon and scene; they are not yet checked against the machine."""

    start: Any = None
    cyclic: Any = False
    cost: Any = None
    limits: Any = None
    search: Any = "configurations"
    seed: Any = 0


def checked_request(machine: Machine, tasks: Any, horizon: Any, options: PlanOptions) -> PlanRequest:
    """Check the arguments of `plan` for tip tasks, except the scene, search, seed and `cyclic`; return the request.

    Raises:
        ProblemError: As in `plan`.
    """
    limits, search = options.limits, options.search
    all_tasks = (tasks,) if isinstance(tasks, TipTask) else require.each("tasks", tasks, TipTask)
    bind(machine, all_tasks)  # checks the tasks against the machine
    checked_limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    free = isinstance(horizon, str)
    if free:
        require.choice("horizon", horizon, ("free",))
        if search == "global":
            words = "search='global' needs a fixed horizon; give it in s, or use search='configurations'"
            raise ProblemError(words, name="search", value="global")
    own_cost = _checked_cost(machine, options.cost, free)
    checked_limits.bounds(machine, ("velocity", "torque") if limits_actuators(checked_limits) else ("velocity",))
    if limits_actuators(checked_limits):
        checked_motors("plan: actuator limits", machine)
    duration = horizon_of(all_tasks, None if free else horizon)
    joints, base = Start.of(options.start, machine)[1:]
    stretches = stretches_of(machine, all_tasks, duration)
    configuration = np.zeros(machine.joint_size) if joints is None else joints
    for stretch in stretches:
        if stretch.equations is not None:
            first = stretch is stretches[0] and joints is not None
            checked_tasks(stretch.equations, base, configuration, duration, check_start=first)
    if joints is not None:
        bounds = checked_limits.bounds(machine)
        joints = clip_to_limits(machine, joints, bounds.lower, bounds.upper, label="start")
    squares = own_cost if own_cost.velocity else replace(own_cost, velocity=1.0)
    request = PlanRequest(
        *(machine, all_tasks, duration, stretches, joints, base, squares.joint_weights(machine.joint_size)),
        *(without_actuators(checked_limits), options.cyclic, int(options.seed), float(own_cost.time) if free else None),
        search=search,
        cost=None if own_cost.velocity and set(own_cost.terms) <= {"velocity", "time"} else own_cost,
        actuator_limits=checked_limits if limits_actuators(checked_limits) else None,
    )
    smooth = limits_actuators(checked_limits) or weights_actuators(own_cost)
    if not smooth:
        return request
    rests = are_at_rest(stretches[0].equations, 0.0), are_at_rest(stretches[-1].equations, duration)
    return replace(request, rests=rests)


def _checked_cost(machine: Machine, cost: Any, free: bool) -> Cost:
    """Return the cost of a motion along tip tasks after checking that its weights fit the machine and the horizon."""
    if cost is None:
        return Cost(time=float(free))
    own = require.instance("cost", cost, Cost)
    if weights_actuators(own):
        checked_motors("plan: cost", machine)
    if own.turning and not machine.base_size:
        words = "cost: turning weights the rotation of a floating base, and this base is fixed; leave it out"
        raise ProblemError(words, name="turning", value=own.turning, limit=0.0)
    if free != bool(own.time):
        words = "cost: a free horizon costs time" if free else "cost: time is fixed by the horizon"
        words += "; give Cost(time=...) above 0" if free else "; give horizon='free', or leave time out"
        raise ProblemError(words, name="time", value=own.time, limit=0.0)
    own.joint_weights(machine.joint_size)
    return own
