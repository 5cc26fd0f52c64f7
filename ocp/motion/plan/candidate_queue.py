"""Best-first search over candidates: each is advanced one stage at a time, the one of least cost first.

A cost on the coarse mesh is an estimate, and separated bodies or limits of actuators can but raise it. So what a
candidate costs is, but for the error of the coarse mesh, a lower bound of what it can become, and none has to be
advanced that costs more than one that passed. Candidates that become one motion are one, and the others wait: where it
is rejected the next one of them goes on in its place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush

import numpy as np

from ocp.errors import SolveError
from ocp.motion.plan.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.plan.motion import Plan
from ocp.motion.search.settings import PlannerSettings
from ocp.solution import Solution

__all__ = ["CandidateQueue", "Solver"]


class Solver:
    """What advances candidates of one request.

    Attributes:
        last: The stage that the plan has to reach.
        error: The last error of a solve.
    """

    last = Stage.AUDITED
    error: SolveError | None = None

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """The candidate one stage further, or rejected; and candidates that stem from it."""
        raise NotImplementedError

    def collision(self, candidate: Candidate) -> Reason | None:
        """That bodies collide in its motion; None if none do."""
        return None

    def same_path(self, one: Solution, other: Solution) -> bool:
        """Whether two motions are one."""
        return False

    def failure(self, candidates: Sequence[Candidate]) -> SolveError:
        """That none passes, with the reasons, the most frequent first, and what the last solve says of them."""
        reasons = Counter(str(one.reason) for one in candidates).most_common()
        listed = "\n".join(f"  {count} of {len(candidates)} postures: {reason}" for reason, count in reasons)
        last = next((one.solution for one in candidates if one.solution is not None), None)
        words, cause = f"no motion passes its audit:\n{listed}", self.error
        if cause is None:
            return SolveError(words, last, name="plan")
        details = {"name": cause.name or "plan", "value": cause.value, "limit": cause.limit, "time": cause.time}
        return SolveError(f"{words}\n{cause}", cause.solution or last, cause.conflicts, **details)

    def plan(self, candidates: Sequence[Candidate]) -> Plan:
        """The plan of which the first one is the motion."""
        raise NotImplementedError


@dataclass
class _Motion:
    """A motion that candidates of a batch were solved to: the first of them, and those that wait."""

    first: Candidate
    waiting: list[Candidate] = field(default_factory=list)


class CandidateQueue:
    """Candidates of one request.

    Attributes:
        candidates: Those that ended: they passed, or were rejected.
    """

    def __init__(self, solver: Solver, settings: PlannerSettings) -> None:
        self.solver, self.settings = solver, settings
        self.candidates: list[Candidate] = []

    @property
    def cost(self) -> float:
        """Of the best that passed; inf if none did."""
        return min((one.cost for one in self.candidates if one.passed), default=np.inf)

    @property
    def passed(self) -> bool:
        """Whether one passed."""
        return bool(np.isfinite(self.cost))

    @property
    def collided(self) -> bool:
        """Whether one was rejected for a collision."""
        return any(one.reason is not None and one.reason.kind is Rejection.COLLISION for one in self.candidates)

    def run(self, seeds: Iterable[Candidate], every: bool = False) -> None:
        """Advance a batch of seeds until none is left that can become cheaper than what passed.

        Args:
            seeds: In the order in which they are solved first.
            every: Whether motions are wanted that are costlier, too, as far as their number and cost are limited.
        """
        self._heap: list[tuple[float, int, int, Candidate]] = []
        self._motions: list[_Motion] = []
        self._pushed = self._failures = self._audits = 0
        self._least, self._coarse_error, self._every = np.inf, 0.0, every
        for seed in seeds:
            self._push(seed)
        while self._heap:
            candidate = heappop(self._heap)[-1]
            if (same := self._same_motion(candidate)) is not None:
                same.waiting.append(candidate)
            elif (reason := self._needless(candidate)) is not None:
                self.candidates.append(candidate.rejected(reason))
            else:
                self._audits += candidate.stage is Stage.REFINED
                for found in self.solver.advance(candidate):
                    self._take(candidate, found)
        duplicate = Reason(Rejection.DUPLICATE)
        self.candidates += [one.rejected(duplicate) for motion in self._motions for one in motion.waiting]

    def plan(self) -> Plan:
        """The plan of the best candidate that passed, with the others and why they are not the plan.

        Raises:
            SolveError: None passed.
        """
        if not self.passed:
            raise self.solver.failure(self.candidates)
        best = min((one for one in self.candidates if one.passed), key=lambda one: one.cost)
        costlier = Reason(Rejection.COSTLIER)
        ended = [replace(one, reason=costlier) if one.passed and one is not best else one for one in self.candidates]
        ended.sort(key=lambda one: (one is not best, np.inf if np.isnan(one.cost) else one.cost))
        return self.solver.plan([one.ended() for one in ended])

    def _push(self, candidate: Candidate) -> None:
        self._pushed += 1
        cost = -np.inf if candidate.stage is Stage.SEED else candidate.cost
        heappush(self._heap, (cost, -candidate.stage, self._pushed, candidate))

    def _same_motion(self, candidate: Candidate) -> _Motion | None:
        """The motion that another candidate has become that this one is, too, after its first solve; else None."""
        if candidate.stage not in (Stage.COARSE, Stage.FINE) or candidate.separations or candidate.solution is None:
            return None
        if any(motion.first.seed is candidate.seed for motion in self._motions):
            return None
        for motion in self._motions:
            assert motion.first.solution is not None
            gain, slack = motion.first.cost - candidate.cost, self.settings.same_cost * motion.first.cost
            if gain <= slack and (gain >= -slack or self.solver.same_path(candidate.solution, motion.first.solution)):
                return motion
        self._motions.append(_Motion(candidate))
        return None

    def _needless(self, candidate: Candidate) -> Reason | None:
        """Why a candidate need not be advanced; None if it has to be."""
        settings, stage, best = self.settings, candidate.stage, self.cost
        if stage is Stage.SEED:
            if not candidate.seed.tracked and np.isfinite(self._least):
                return Reason(Rejection.UNTRACKED)
            far = np.isfinite(candidate.seed.cost) and candidate.seed.cost > settings.max_cost_ratio * self._least
            return Reason(Rejection.COSTLIER, "by far, by its local motion") if far else None
        if self._every and self._audits < settings.max_failures and candidate.cost <= settings.max_cost_ratio * best:
            return Reason(Rejection.DUPLICATE) if stage > Stage.FINE and self._has_passed(candidate.cost) else None
        if stage < Stage.FINE and candidate.cost > best * (1 + self._coarse_error):
            return self.solver.collision(candidate) or Reason(Rejection.COSTLIER, "on a coarse mesh")
        if stage >= Stage.FINE and candidate.cost >= best * (1 - settings.same_cost):
            return Reason(Rejection.COSTLIER)
        if self._failures < settings.max_failures:
            return None
        if stage is Stage.AUDITED:
            return Reason(Rejection.NOT_TRIED, f"{self._failures} before it failed")
        return self.solver.collision(candidate) if stage <= Stage.FINE else None

    def _has_passed(self, cost: float) -> bool:
        """Whether a candidate of that cost passed."""
        same = self.settings.same_cost
        return any(one.passed and abs(cost - one.cost) <= same * one.cost for one in self.candidates)

    def _take(self, before: Candidate, found: Candidate) -> None:
        """Note what an advance came to."""
        if not found.passed:
            self.candidates.append(found)
            self._failures += before.stage is not Stage.SEED
            assert found.reason is not None
            if found.reason.kind is not Rejection.COLLISION and self._failures < self.settings.max_failures:
                self._replace(found)
        elif found.stage >= self.solver.last:
            repeated = self._has_passed(found.cost)
            self.candidates.append(found.rejected(Reason(Rejection.DUPLICATE)) if repeated else found)
        else:
            if before.stage is Stage.SEED:
                self._least = min(self._least, found.cost)
            elif before.stage < Stage.FINE <= found.stage:
                self._learn_error(before, found)
            self._push(found)

    def _replace(self, rejected: Candidate) -> None:
        """Let those that wait for a motion that was rejected go on in its place."""
        for motion in [motion for motion in self._motions if motion.first.seed is rejected.seed]:
            self._motions.remove(motion)
            for candidate in motion.waiting:
                self._push(candidate)

    def _learn_error(self, coarse: Candidate, fine: Candidate) -> None:
        """Note how much the coarse mesh was wrong; what became another motion says nothing of the mesh."""
        assert coarse.solution is not None
        assert fine.solution is not None
        if self.solver.same_path(coarse.solution, fine.solution):
            error = 2 * abs(fine.cost - coarse.cost) / max(fine.cost, np.finfo(float).tiny)
            self._coarse_error = max(self._coarse_error, error)
