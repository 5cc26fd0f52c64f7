"""Where candidates come from: one posture, all that inverse kinematics finds, or a search over all motions.

Each kind of seeds that takes more work is tried where none before it led to a plan, or to one that is good enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.arrays import Array
from ocp.errors import SolveError
from ocp.local.following import Followed
from ocp.planning.candidate import Candidate, Reason, Rejection, Seed
from ocp.planning.candidate_queue import CandidateQueue
from ocp.planning.candidate_solver import CandidateSolver
from ocp.planning.cells import CellSearch, follows
from ocp.planning.dead_end import DeadEnd
from ocp.planning.motion import Plan
from ocp.planning.postures import OUT_OF_REACH, Asked, followed_from, misfits_of, touches_at_the_start
from ocp.planning.task_search import TaskSearch

__all__ = ["plan_from_seeds", "seeds_of"]


def plan_from_seeds(request: Asked, postures: Array, solver: CandidateSolver) -> tuple[Plan, float | None]:
    """The plan that postures lead to, and a lower bound of its cost; None if none was looked for.

    Args:
        request: What is asked.
        postures: Joints at the start, the best conditioned first. Shape (K, n).
        solver: Of the candidates.

    Raises:
        ProblemError, SolveError: As `ocp.planning.plan`.
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


def seeds_of(solver: CandidateSolver, followed: Sequence[Followed], postures: Array, **kind: bool) -> list[Candidate]:
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
        local = [part.of(slice(number, number + 1)) for part in followed]
        guess = solver.motion.guess(local, 0)
        seed = Seed(guess, float(costs[number]), local, bool(tracked[number]), **kind)
        seeds.append(Candidate(postures[number], seed.cost, seed=seed, clear=solver.request.clear))
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
    queue: CandidateQueue, solver: CandidateSolver, followed: Sequence[Followed], postures: Array
) -> None:
    """The motions of a floating machine that a search over exact states leads to, with those that local ones do.

    Raises:
        Unreachable, DeadEnd: As of `CellSearch`, where no local motion leads on either.
    """
    request, every = solver.request, solver.request.search == "global"
    sound = np.flatnonzero(follows(request, followed))
    local = seeds_of(solver, [part.of(sound) for part in followed], postures[sound], direct=every)
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
        if end.clear is not None and (colliding or end.clear.margins):
            local = solver.local_collisions(seed.seed)
            clear = end.clear.holding([touch.pair for touch in (*colliding, *local)])
            ways.append((min((touch.distance for touch in local), default=np.inf), replace(seed, clear=clear)))
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
