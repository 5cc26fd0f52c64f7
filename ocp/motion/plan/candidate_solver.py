"""One stage of a candidate: solved on the coarse mesh, separated, solved on the fine mesh, refined, audited, limited.

All candidates of a request have one problem, but for the bodies that constraints separate in it and for starts that are
fixed. It is declared and prepared once for each of these.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from models.arrays import Array
from ocp.audit.audit import Audit, Finding
from ocp.audit.clearance import ClosestPair
from ocp.direct.collocation import Collocation
from ocp.direct.prepared import Prepared
from ocp.errors import RefinementWarning, SolveError
from ocp.methods import solve
from ocp.motion.builders.clearance import APART
from ocp.motion.builders.tool_motion import CLOCK, ToolMotion
from ocp.motion.local.collisions import Collision
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.actuators import within_actuator_limits
from ocp.motion.plan.candidate import Candidate, Reason, Rejection, Seed, Stage, collision
from ocp.motion.plan.candidate_queue import Solver
from ocp.motion.plan.motion import Plan, parts_of
from ocp.motion.plan.request import declared_motion
from ocp.motion.search.configurations import OUT_OF_REACH, Asked, clear_postures, others_told
from ocp.problem.values import constant
from ocp.refinement import refine_from, split
from ocp.solution import Solution

__all__ = ["CandidateSolver"]


class CandidateSolver(Solver):
    """Advances candidates of machines whose base is fixed or floats.

    Attributes:
        request: What is asked. settings: Of the planner. start: Joints at the start, nan where they are free.
        motion: Its problem, without bodies that are separated.
    """

    def __init__(self, request: Asked, start: Array, reference: Array) -> None:
        """
        Args:
            request: What is asked.
            start, reference: As of `tool_motion_problem`.
        """
        self.request, self.settings, self.start, self.reference = request, request.settings, start, reference
        self.motion = declared_motion(
            request, start=start, reference=reference, clearance_constraints=request.clearance_constraints
        )
        self.last = Stage.AUDITED if request.drives is None else Stage.ACTUATED
        self._clear: dict[float, int | Unreachable | None] = {}
        self._prepared: dict[Any, tuple[ToolMotion, Collocation, Prepared]] = {}
        self._collisions: tuple[Solution | None, list[Collision]] = None, []

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """The candidate one stage further, or rejected; and candidates that stem from it."""
        steps = {
            Stage.SEED: self._begin,
            Stage.COARSE: self._separate,
            Stage.SEPARATED: self._separate,
            Stage.FINE: self._refine,
            Stage.REFINED: self._audit,
            Stage.AUDITED: self._limit,
        }
        try:
            found = steps[candidate.stage](candidate)
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            self.error = error
            kind = Rejection.ACTUATORS if candidate.stage is Stage.AUDITED else Rejection.INFEASIBLE
            failed = replace(candidate, cost=np.nan, solution=error.solution, stage=max(candidate.stage, Stage.FINE))
            return [failed.rejected(Reason.of_error(kind, error))]
        return [found, *self._freed(found)]

    # ---- stages ----------------------------------------------------------------------------------------------------

    def _begin(self, candidate: Candidate) -> Candidate:
        seed, apart = candidate.seed, _is_separated(candidate)
        if seed.direct:
            return self._solved(candidate, Stage.FINE, seed.guess, check=seed.thorough and not apart)
        return self._solved(candidate, Stage.SEPARATED if apart else Stage.COARSE, seed.guess)

    def _separate(self, candidate: Candidate) -> Candidate:
        """Separate the bodies that collide on the coarse mesh; where none do go on to the fine mesh."""
        touching = self.collisions(candidate)
        if not touching:
            return self._solved(candidate, Stage.FINE, candidate.solution)
        if isinstance(unreachable := self._clear_at(touching[0].time), Unreachable):
            return candidate.rejected(self._collision(touching[0], f"at {touching[0].time:.4g} s {unreachable}"))
        return self._apart(candidate, Stage.SEPARATED, touching)

    def _refine(self, candidate: Candidate) -> Candidate:
        """Separate the bodies that collide on the fine mesh; where none do refine it for the tips."""
        if touching := self.collisions(candidate):
            return self._apart(candidate, Stage.FINE, touching)
        motion, mesh, _ = self.prepared(candidate, fine=True)
        assert candidate.solution is not None
        solution = self._on_task(motion, mesh, candidate.solution, check=not _is_separated(candidate))
        if (deviation := self._deviations(motion, solution).max()) > self.settings.max_deviation:
            words = f"the tips deviate by {deviation:.2g} (m or rad) on finer meshes, too"
            limit = self.settings.tip_tolerance
            return candidate.rejected(Reason(Rejection.UNTRACKED, words, "task", float(deviation), limit))
        return replace(candidate, stage=Stage.REFINED, cost=solution.cost, solution=solution)

    def _audit(self, candidate: Candidate) -> Candidate:
        """Audit a candidate, on finer meshes where that may mend what fails; separate farther what comes too near.

        Where many starts are equally good no one of them is decided to be the best. The motion is then audited with its
        start fixed.
        """
        motion, mesh, _ = self.prepared(candidate, fine=True)
        clearance_constraints, first = candidate.clearance_constraints, f"joints{motion.stretches[0].suffix}"
        assert candidate.solution is not None
        solution, audit = self._audited(motion, mesh, candidate.solution, check=not _is_separated(candidate))
        if np.isnan(self._start(candidate)).any() and audit.feasible and audit.optimal is None:
            fixed = declared_motion(
                self.request,
                start=solution[first][0],
                reference=self.reference,
                clearance_constraints=clearance_constraints,
            )
            same = _mesh_of(mesh, solution)
            again = solve(fixed.problem, same, guess=solution, options=self._options(fixed, same, solution.cost, {}))
            again = self._on_task(fixed, mesh, again, check=True)
            again, other = self._audited(fixed, mesh, again, check=True)
            slack = self.settings.negligible_rate * motion.horizon
            if other.passed and again.cost <= solution.cost * (1 + self.settings.same_cost) + slack:
                solution, audit = again, other
        candidate = replace(candidate, cost=solution.cost, solution=solution)
        proofs = list(audit.clearances.values())
        near = max((pair for proof in proofs for pair in proof.pairs), key=attrgetter("missed"), default=None)
        if clearance_constraints is not None and near is not None and near.missed > 0:
            wider = replace(candidate, clearance_constraints=clearance_constraints.widened(proofs))
            return self._again(wider, Stage.FINE, self._collision(near))
        if audit.passed:
            return replace(candidate, stage=Stage.AUDITED)
        if not audit.failures:
            return candidate.rejected(Reason(Rejection.UNDETERMINED, audit.undecided))
        worst = audit.failures[0]
        words = f"{worst.name} {worst.value:.2g}"
        return candidate.rejected(Reason(Rejection.AUDIT, words, worst.name, worst.value, worst.limit, worst.time))

    def _limit(self, candidate: Candidate) -> Candidate:
        """Solve a candidate again within the limits of actuators."""
        solution = within_actuator_limits(self.request, self.start, self.reference, self.plan([candidate]))
        return replace(candidate, stage=Stage.ACTUATED, cost=solution.cost, solution=solution)

    def _freed(self, found: Candidate) -> list[Candidate]:
        """What passed with a fixed start, to be solved again with its start free."""
        if not (found.seed.fixed and found.passed and found.stage is Stage.AUDITED):
            return []
        clearance_constraints = self.request.clearance_constraints
        if clearance_constraints is not None:
            clearance_constraints = clearance_constraints.holding(
                [touch.pair for touch in self.local_collisions(found.seed)]
            )
        return [
            Candidate(
                found.start,
                seed=Seed(found.solution, local=found.seed.local, direct=True),
                clearance_constraints=clearance_constraints,
            )
        ]

    # ---- solves ----------------------------------------------------------------------------------------------------

    def _solved(self, candidate: Candidate, stage: Stage, guess: Any, check: bool = False) -> Candidate:
        cost = guess.cost if isinstance(guess, Solution) else np.inf
        solution = self.prepared(candidate, stage >= Stage.FINE, cost)[2].solve(guess=guess, check=check)
        if solution.success:
            return replace(candidate, stage=stage, cost=solution.cost, solution=solution)
        reason = Reason(Rejection.INFEASIBLE, str(solution.status))
        return replace(candidate, cost=np.nan, solution=None).rejected(reason)

    def _apart(self, candidate: Candidate, stage: Stage, touching: list[Collision]) -> Candidate:
        """Solve a candidate again with more bodies separated."""
        assert candidate.clearance_constraints is not None
        clearance_constraints = candidate.clearance_constraints.holding([touch.pair for touch in touching])
        return self._again(
            replace(candidate, clearance_constraints=clearance_constraints), stage, self._collision(touching[0])
        )

    def _again(self, candidate: Candidate, stage: Stage, reason: Reason) -> Candidate:
        count = candidate.separations + 1
        if count > self.settings.max_separations:
            return replace(candidate, separated=None).rejected(reason)
        return self._solved(replace(candidate, separations=count, separated=reason), stage, candidate.solution)

    def prepared(
        self, candidate: Candidate, fine: bool, cost: float = np.inf
    ) -> tuple[ToolMotion, Collocation, Prepared]:
        """The problem of a candidate, the first mesh for it, and both prepared for guesses of about a cost."""
        settings, apart = self.settings, _is_separated(candidate)
        held = (
            tuple(sorted(candidate.clearance_constraints.margins.items()))
            if candidate.clearance_constraints is not None and apart
            else ()
        )
        key = held, fine, tuple(candidate.start) if candidate.seed.fixed else ()
        if key not in self._prepared:
            start, motion = self._start(candidate), self.motion
            if held or candidate.seed.fixed:
                reference = candidate.start if candidate.seed.fixed else self.reference
                motion = declared_motion(
                    self.request,
                    start=start,
                    reference=reference,
                    clearance_constraints=candidate.clearance_constraints,
                )
            least = settings.separated_intervals if held and not fine else settings.min_intervals
            degree = settings.fine_degree if fine else settings.coarse_degree
            mesh = Collocation(least if len(motion.breaks) < least else 1, degree).with_nodes_at(motion.breaks)
            given = settings.fine_options if fine else settings.coarse_options
            options = self._options(motion, mesh, cost, given)
            self._prepared[key] = motion, mesh, mesh.prepare(motion.problem, options=options)
        return self._prepared[key]

    def _start(self, candidate: Candidate) -> Array:
        """Joints at the start, nan where they are free: what bodies that are separated ride on is not ignorable."""
        if candidate.seed.fixed:
            return candidate.start
        clearance_constraints = candidate.clearance_constraints
        if clearance_constraints is None or not clearance_constraints.margins or self.request.start is not None:
            return self.start
        moves = clearance_constraints.scene.levers.joints[sorted(clearance_constraints.margins)].any(axis=0)
        return np.where(moves & ~self.request.held, np.nan, self.start)

    def _options(self, motion: ToolMotion, mesh: Collocation, cost: float, given: Mapping[str, Any]) -> dict[str, Any]:
        """Options of a solve with bodies separated, from a motion of some cost: no barrier that is worth more.

        An interior-point method with a barrier mu goes to where the cost is above the least by mu for each limit (Boyd,
        Vandenberghe 2004, section 11.2.2). Where that is more than the whole cost of the motion that it begins from,
        the barrier alone says where it goes: far away from the bodies, on the other side of others.
        """
        declared = motion.problem.declared
        least = self.settings.negligible_rate * motion.horizon
        if not any(name.startswith(APART) for name in declared.path) or not least < cost < np.inf:
            return dict(given)
        limits = [(each.lower, each.upper) for each in (*declared.states.values(), *declared.controls.values())]
        limits += [(each.lower, each.upper) for each in declared.path.values()]
        sides = 0
        for low, high in ((constant(low), constant(high)) for low, high in limits):
            sides += int(np.isfinite(np.array([low, high])[:, low < high]).sum())
        most = cost / (sides * mesh.intervals * mesh.degree)
        own, least = self.settings.barriers
        return {**given, "mu_init": max(min(given.get("mu_init", own), most), least)}

    # ---- meshes ----------------------------------------------------------------------------------------------------

    def _audited(
        self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool
    ) -> tuple[Solution, Audit]:
        """A motion and its audit, on finer meshes where its audit asks for them.

        With `check` what fails on a finer mesh is tried from other guesses, and what conflicts is found.
        """
        audit: Audit = solution.audit()
        if _mendable(audit):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RefinementWarning)
                same = _mesh_of(mesh, solution)
                options = self._options(motion, same, solution.cost, self.settings.fine_options)
                solution, audit = refine_from(motion.problem, same, solution, audit, options, check)
            if not _mendable(audit) and (finer := self._on_task(motion, mesh, solution, check)) is not solution:
                solution, audit = finer, finer.audit()
        return solution, audit

    def _on_task(self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool) -> Solution:
        """A motion, on a finer mesh where its tips deviate, as long as that may lead them back."""
        settings, deviations = self.settings, self._deviations(motion, solution)
        for _ in range(settings.max_refinements):
            if deviations.max() <= settings.tip_tolerance:
                break
            # where a limit becomes active or inactive it is smooth to the second order
            more = np.ceil(np.sqrt(deviations / settings.tip_tolerance)).clip(2, settings.max_pieces).astype(int)
            pieces = np.where(deviations > settings.tip_tolerance / len(deviations), more, 1)
            nodes = split(solution.state_interpolant.breaks, pieces, deviations, settings.max_intervals)
            finer = mesh.with_mesh(nodes)
            options = self._options(motion, finer, solution.cost, settings.fine_options)
            found = solve(motion.problem, finer, guess=solution, options=options, check=check)
            if not found.success:
                raise SolveError(f"on a finer mesh: {found.status}", found)
            before, deviations = deviations.max(), self._deviations(motion, found)
            if deviations.max() > max(OUT_OF_REACH, settings.least_progress * before):
                break
            solution = found
        return solution

    def _deviations(self, motion: ToolMotion, solution: Solution) -> Array:
        """How far the tips are from their poses in each interval of the mesh, m and rad. Shape (N,)."""
        at, count = self._samples(solution), self.settings.samples_per_interval
        sample, worst = solution.at_fraction(at), np.zeros(len(at))
        for stretch in motion.stretches:
            if stretch.equations is not None:
                base = sample[f"base{stretch.suffix}"] if self.request.machine.base_size else None
                times, joints = stretch.begin + at * stretch.duration, sample[f"joints{stretch.suffix}"]
                sizes = np.cumsum([part.task.size for part in stretch.equations.bound])[:-1]
                errors = np.split(stretch.equations.errors(times, base, joints), sizes, axis=1)
                for part, own in zip(stretch.equations.bound, errors, strict=True):
                    if part.task.start_gap <= self.settings.tip_tolerance:  # the feedback closes a larger one
                        worst = np.maximum(worst, np.linalg.norm(own, axis=1))
                worst = np.maximum(worst, stretch.equations.cone_violations(times, base, joints).max(axis=1, initial=0))
        return np.asarray(np.maximum(worst[:-1], worst[1:]).reshape(-1, count).max(axis=1))

    def _samples(self, solution: Solution) -> Array:
        """Fractions of the horizon, some in each interval of the mesh, and the end."""
        nodes, count = solution.state_interpolant.breaks, self.settings.samples_per_interval
        return np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(count) / count).ravel(), 1.0)

    def same_path(self, one: Solution, other: Solution) -> bool:
        """Whether two motions are one, but for what a coarse mesh misses and full turns of joints."""
        places = np.linspace(0.0, 1.0, self.settings.compared_samples)
        names = [f"joints{stretch.suffix}" for stretch in self.motion.stretches]
        paths = [np.hstack([each.at_fraction(places)[name] for name in names]) for each in (one, other)]
        apart = paths[0] - paths[1]
        turns = 2 * np.pi * np.round(apart[0] / (2 * np.pi))
        return bool(np.abs(apart - turns).max() <= self.settings.same_path)

    # ---- collisions ------------------------------------------------------------------------------------------------

    def collisions(self, candidate: Candidate) -> list[Collision]:
        """The bodies that come too near in a candidate's motion and are not separated, the worst first."""
        clearance_constraints, solution = candidate.clearance_constraints, candidate.solution
        if clearance_constraints is None or solution is None:
            return []
        if self._collisions[0] is not solution:
            at = self._samples(solution)
            sample, found = solution.at_fraction(at), []
            for stretch in self.motion.stretches:
                base = sample[f"base{stretch.suffix}"] if self.request.machine.base_size else np.zeros((len(at), 0))
                times = stretch.begin + at * stretch.duration
                found += clearance_constraints.find_collisions(base, sample[f"joints{stretch.suffix}"], times)
            worst: dict[int, Collision] = {}
            for touch in sorted(found, key=lambda touch: touch.distance):
                worst.setdefault(touch.pair, touch)
            self._collisions = solution, list(worst.values())
        return [touch for touch in self._collisions[1] if touch.pair not in clearance_constraints.margins]

    def collision(self, candidate: Candidate) -> Reason | None:
        """That bodies collide in its motion, the worst pair; None if none do."""
        touching = self.collisions(candidate)
        return self._collision(touching[0]) if touching else None

    def local_collisions(self, seed: Seed) -> list[Collision]:
        """The bodies that come too near in a local motion, the worst first."""
        clearance_constraints, found = self.request.clearance_constraints, list[Collision]()
        for part in seed.local if clearance_constraints is not None else ():
            assert clearance_constraints is not None
            found += clearance_constraints.find_collisions(part.base[0], part.joints[0], part.t)
        return sorted(found, key=lambda touch: touch.distance)

    @property
    def barred(self) -> bool:
        """Whether there was a time at which no posture that does the tasks is clear."""
        return any(isinstance(value, Unreachable) for value in self._clear.values())

    def _clear_at(self, time: float) -> int | Unreachable | None:
        """How many postures that do the tasks at a time are clear, or why none is; None where that is not known."""
        if time not in self._clear:
            self._clear[time] = clear_postures(self.request, time)
        return self._clear[time]

    def _collision(self, near: Collision | ClosestPair, then: str = "") -> Reason:
        assert self.request.clearance_constraints is not None
        return collision(near, self.request.clearance_constraints.scene.clearance, then)

    # ---- what comes of them ------------------------------------------------------------------------------------------

    def failure(self, candidates: Sequence[Candidate]) -> SolveError:
        """That none passes; where bodies collide, it is about the cheapest candidate in which they do."""
        error = super().failure(candidates)
        touching = [one for one in candidates if one.reason is not None and one.reason.kind is Rejection.COLLISION]
        if not touching:
            return error
        worst = min(touching, key=lambda one: np.inf if np.isnan(one.cost) else one.cost).reason
        assert worst is not None
        assert worst.time is not None
        others = others_told(self._clear_at(worst.time))
        words = "; ".join([f"{error}\nthe cheapest that touches: {worst.detail}", *others])
        details = {"name": worst.name, "value": worst.value, "limit": worst.limit, "time": worst.time}
        return SolveError(words, error.solution, error.conflicts, **details)

    def plan(self, candidates: Sequence[Candidate]) -> Plan:
        """The plan of which the first one is the motion."""
        best = candidates[0]
        assert best.solution is not None
        parts = parts_of(self.motion.stretches)
        if self.request.time_cost is not None:
            parts = (parts[0]._replace(end=float(best.solution[CLOCK][-1, 0])),)
        return Plan(self.request.machine, best.solution, parts, tuple(candidates)).with_targets(self.request.tasks)


def _is_separated(candidate: Candidate) -> bool:
    return candidate.clearance_constraints is not None and bool(candidate.clearance_constraints.margins)


def _mesh_of(mesh: Collocation, solution: Solution) -> Collocation:
    return mesh.with_mesh(solution.state_interpolant.breaks)


def _mendable(audit: Audit) -> list[Finding]:
    """What a finer mesh may mend: all that fails but bodies that come too near."""
    return [finding for finding in audit.failures if finding.name not in audit.clearances]
