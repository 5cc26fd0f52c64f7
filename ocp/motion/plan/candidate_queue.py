"""Best-first search over candidate motions: the candidate of least cost is advanced by one stage at a time.

The cost on the coarse mesh is an estimate, and separation constraints or actuator limits can only increase it. Apart
from the error of the coarse mesh, the cost of a candidate is therefore a lower bound of its final cost, and candidates
that cost more than one that passed need not be advanced. Candidates that converge to one motion are merged. The others
wait, and if the first is rejected, the next one continues in its place.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from heapq import heappop, heappush
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.console import TimeLimitReached, report, time_left
from ocp.errors import SolveError
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage, ranked
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.configurations import PlannerSettings
from ocp.solution import Solution


class Solver:
    """Base class of the solvers that advance the candidate motions of one request from stage to stage.

    Attributes:
        last: Stage that a plan must reach.
        turning: Indices of the joints whose full turns move no body.
        error: Last error of a solve.
    """

    last = Stage.AUDITED
    turning: Sequence[int] | NDArray[np.intp] = ()
    error: SolveError | None = None

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """Advance a candidate by one solution stage or reject it; return this candidate and any derived from it."""
        raise NotImplementedError

    def collision(self, candidate: Candidate) -> Reason | None:
        """Return the rejection reason if bodies collide during the motion of a candidate; else None."""
        return None

    def same_path(self, solution: Solution, reference: Solution) -> bool:
        """Return whether two solutions have the same path and so are the same motion."""
        return False

    def reaches_limits(self, solution: Solution) -> bool:
        """Return whether joints of a solution reach their limits, so that full turns of joints may reduce the cost."""
        return True

    def failure(self, candidates: Sequence[Candidate]) -> SolveError:
        """Return the error to raise if no candidate passes its audit, with reasons, the most frequent first."""
        reasons = Counter(str(candidate.reason) for candidate in candidates).most_common()
        listed = "\n".join(f"  {count} of {len(candidates)} candidates: {reason}" for reason, count in reasons)
        last = next((candidate.solution for candidate in candidates if candidate.solution is not None), None)
        words, cause = f"no motion passes its audit:\n{listed}", self.error
        located = (c.reason for c in candidates if c.reason is not None and c.reason.time is not None)
        fault = cause or next(located, None)
        details: dict[str, Any] = {key: getattr(fault, key, None) for key in ("name", "value", "limit", "time")}
        details["name"] = details["name"] or "plan"
        if cause is None:
            return SolveError(words, last, candidates=candidates, **details)
        return SolveError(f"{words}\n{cause}", cause.solution or last, cause.conflicts, candidates, **details)

    def plan(self, candidates: Sequence[Candidate]) -> SolvedPlan:
        """Return the first candidate as a plan, which also lists the other candidates."""
        raise NotImplementedError


class CandidateQueue:
    """Priority queue of the candidate motions of one request, the lowest cost first.

    Attributes:
        candidates: Finished candidates, which passed or were rejected.
    """

    def __init__(self, solver: Solver, settings: PlannerSettings, *, include_costlier: bool = False) -> None:
        """Create an empty queue of candidates for the solver that advances them.

        With `include_costlier` all batches include costlier motions, see `run`, and motions of the same cost, since
        they will be ranked by another cost.
        """
        self.solver, self.settings, self._began = solver, settings, time.thread_time()
        self._always_costlier = include_costlier
        self.candidates: list[Candidate] = []

    @property
    def cost(self) -> float:
        """Cost of the best candidate that passed its audit; inf if none did."""
        return min((candidate.total for candidate in self.candidates if candidate.passed), default=np.inf)

    @property
    def passed(self) -> bool:
        """Whether a candidate passed its audit."""
        return bool(np.isfinite(self.cost))

    @property
    def collided(self) -> bool:
        """Whether a candidate was rejected because of a collision."""
        return any(c.reason is not None and c.reason.kind is Rejection.COLLISION for c in self.candidates)

    @property
    def exhausted(self) -> bool:
        """Whether failed candidates have used up the allowed time while no candidate has passed or collided.

        An explicit time limit of the caller takes the place of the allowed time.
        """
        if np.isfinite(time_left()):
            return False
        seconds = time.thread_time() - self._began
        return seconds > self.settings.refusal_time and bool(self.candidates) and not (self.passed or self.collided)

    def run(self, seeds: Iterable[Candidate], include_costlier: bool = False) -> None:
        """Advance the candidates of a batch until none of them can cost less than the best candidate that passed.

        Initial guesses that differ by full turns of joints lead to motions that differ by the same turns, unless joint
        limits intervene: then only the first of these motions is solved.

        Args:
            seeds: Candidates in the order in which they are solved from their initial guesses.
            include_costlier: Whether costlier motions are completed as well, as far as their number and cost are
                limited.
        """
        self._heap: list[tuple[float, int, int, Candidate]] = []
        self._motions: list[list[Candidate]] = []  # candidates of one motion: all but the first wait for its result
        self._pushed = self._failures = self._audits = 0
        self._least, self._coarse_error, self._include_costlier = np.inf, 0.0, include_costlier or self._always_costlier
        self._turned: dict[int, list[Candidate]] = {}
        leaders = list[Candidate]()
        for seed in seeds:
            leader = next((each for each in leaders if each.seed.is_turned(seed.seed, self.solver.turning)), None)
            if leader is None:
                leaders.append(seed)
                self._push(seed)
            else:
                self._turned.setdefault(id(leader.seed), []).append(seed)
        while self._heap:
            candidate = heappop(self._heap)[-1]
            report(self._state, step=True)
            if time_left() <= 0:
                late = Reason(Rejection.NOT_TRIED, "the time limit passed before it", "time_limit")
                self.candidates.append(candidate.with_rejection(late))
            elif self.exhausted:
                words = f"{len(self.candidates)} candidates failed in {self.settings.refusal_time:g} s before it"
                self.candidates.append(candidate.with_rejection(Reason(Rejection.NOT_TRIED, words)))
            elif (motion := self._find_motion(candidate)) is not None:
                motion.append(candidate)
            elif (reason := self._prune(candidate)) is not None:
                self.candidates.append(candidate.with_rejection(reason))
            else:
                self._audits += candidate.stage is Stage.REFINED
                for advanced in self.solver.advance(candidate):
                    self._store_or_push(candidate, advanced)
        waiting = [*(motion[1:] for motion in self._motions), *self._turned.values()]
        self.candidates += [each.with_rejection(Reason(Rejection.DUPLICATE)) for batch in waiting for each in batch]

    def plan(self) -> SolvedPlan:
        """Return the best candidate that passed as a plan, which also lists the other candidates with their reasons.

        Raises:
            SolveError: No candidate passed.
            TimeLimitReached: No candidate passed before the time limit of the caller; its cause is this SolveError.
        """
        if not self.passed:
            failure = self.solver.failure(self.candidates)
            if time_left() <= 0:
                raise TimeLimitReached from failure
            raise failure
        return self.solver.plan(ranked(self.candidates))

    @property
    def _state(self) -> str:
        best = f", lowest cost {self.cost:.6g}" if self.passed else ""
        return f"{len(self.candidates)} of {len(self.candidates) + len(self._heap) + 1} motions done{best}"

    def _push(self, candidate: Candidate) -> None:
        self._pushed += 1
        cost = -np.inf if candidate.stage is Stage.SEED else candidate.total
        heappush(self._heap, (cost, -candidate.stage, self._pushed, candidate))

    def _find_motion(self, candidate: Candidate) -> list[Candidate] | None:
        """Return the group of earlier candidates that were solved to the same motion; None if the motion is new."""
        if candidate.stage not in (Stage.COARSE, Stage.FINE) or candidate.separations or candidate.solution is None:
            return None
        if any(first.seed is candidate.seed for first, *_ in self._motions):
            return None
        for motion in self._motions:
            first = motion[0]
            assert first.solution is not None
            gain, slack = first.total - candidate.total, self.settings.same_cost * first.total
            is_same = gain >= -slack and not self._always_costlier
            if gain <= slack and (is_same or self.solver.same_path(candidate.solution, first.solution)):
                return motion
        self._motions.append([candidate])
        return None

    def _prune(self, candidate: Candidate) -> Reason | None:
        """Return the reason not to solve a candidate any further; None if it must be solved further."""
        settings, stage, best = self.settings, candidate.stage, self.cost
        if stage is Stage.SEED:
            if not candidate.seed.tracked and np.isfinite(self._least):
                return Reason(Rejection.UNTRACKED)
            cost = candidate.seed.cost + candidate.seed.approach
            too_costly = np.isfinite(cost) and cost > settings.max_cost_ratio * self._least
            return Reason(Rejection.COSTLIER, "by far, judged by its local motion") if too_costly else None
        audited = self._include_costlier and self._audits < settings.max_failures
        if audited and candidate.total <= settings.max_cost_ratio * best:
            return Reason(Rejection.DUPLICATE) if stage > Stage.FINE and self._has_passed(candidate) else None
        if stage < Stage.FINE and candidate.total > best * (1 + self._coarse_error):
            return self.solver.collision(candidate) or Reason(Rejection.COSTLIER, "on a coarse mesh")
        if stage >= Stage.FINE and candidate.total >= best * (1 - settings.same_cost):
            return Reason(Rejection.COSTLIER)
        if self._failures < settings.max_failures:
            return None
        if stage is Stage.AUDITED:
            return Reason(Rejection.NOT_TRIED, f"{self._failures} candidates before it failed")
        return self.solver.collision(candidate) if stage <= Stage.FINE else None

    def _has_passed(self, candidate: Candidate) -> bool:
        """Return whether a candidate of equal cost (and equal path, if costlier motions are included) passed before."""
        passed = [c for c in self.candidates if c.passed]
        same = [c for c in passed if abs(candidate.total - c.total) <= self.settings.same_cost * c.total]
        if not self._always_costlier or candidate.solution is None:
            return bool(same)
        return any(c.solution is not None and self.solver.same_path(candidate.solution, c.solution) for c in same)

    def _store_or_push(self, previous: Candidate, advanced: Candidate) -> None:
        """Store a candidate after one more stage if it is finished or rejected; else put it back into the queue."""
        if not advanced.passed:
            self.candidates.append(advanced)
            self._failures += previous.stage is not Stage.SEED
            assert advanced.reason is not None
            if advanced.reason.kind is not Rejection.COLLISION and self._failures < self.settings.max_failures:
                self._resume_duplicates(advanced)
        elif advanced.stage >= self.solver.last:
            repeated = self._has_passed(advanced)
            self.candidates.append(advanced.with_rejection(Reason(Rejection.DUPLICATE)) if repeated else advanced)
        else:
            if previous.stage is Stage.SEED:
                self._least = min(self._least, advanced.total)
                if advanced.solution is None or self.solver.reaches_limits(advanced.solution):
                    self._push_turned(previous)
            elif previous.stage < Stage.FINE <= advanced.stage:
                self._update_coarse_error(previous, advanced)
            self._push(advanced)

    def _resume_duplicates(self, rejected: Candidate) -> None:
        """Queue again the candidates that were duplicates of a candidate which has now been rejected."""
        self._push_turned(rejected)
        same = [motion for motion in self._motions if motion[0].seed is rejected.seed]
        self._motions = [motion for motion in self._motions if motion[0].seed is not rejected.seed]
        for candidate in (waiting for motion in same for waiting in motion[1:]):
            self._push(candidate)

    def _push_turned(self, candidate: Candidate) -> None:
        """Queue the candidates whose initial guesses differ from that of a candidate by full turns of joints."""
        for turned in self._turned.pop(id(candidate.seed), []):
            self._push(turned)

    def _update_coarse_error(self, coarse: Candidate, fine: Candidate) -> None:
        """Update the estimated cost error of coarse meshes from a candidate's solutions on a coarse and a fine mesh."""
        assert coarse.solution is not None
        assert fine.solution is not None
        if self.solver.same_path(coarse.solution, fine.solution):
            error = 2 * abs(fine.cost - coarse.cost) / max(fine.cost, np.finfo(float).tiny)
            self._coarse_error = max(self._coarse_error, error)
