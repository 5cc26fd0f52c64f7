"""Solution stages of a candidate: coarse mesh, separation of bodies, fine mesh, refinement, audit, actuator limits.

All candidates of a request share one problem, except for separated pairs and fixed starts. Each variant is declared and
prepared once.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from models.checks import Array
from ocp.audit.audit import Audit, Finding
from ocp.audit.clearance import ClosestPair
from ocp.direct.discretisation import Collocation
from ocp.direct.prepared import Prepared
from ocp.errors import RefinementWarning, SolveError
from ocp.methods import solve
from ocp.motion.builders.clearance import APART
from ocp.motion.builders.dynamics_plan import barrier_options
from ocp.motion.builders.tool_motion import CLOCK, SLOPES, ToolMotion
from ocp.motion.local.collisions import Collision, find_collisions
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion
from ocp.motion.plan.actuators import solve_with_accelerations
from ocp.motion.plan.candidate_queue import Solver
from ocp.motion.result.candidate import (
    Candidate,
    MotionSample,
    Reason,
    Rejection,
    Seed,
    Stage,
    shortfall_reason,
)  # fmt: skip
from ocp.motion.result.plan import audit_key
from ocp.motion.result.request import declared_motion
from ocp.motion.result.solved_plan import Part, SolvedPlan, deviation_cost
from ocp.motion.search.configurations import (
    REACH_TOLERANCE,
    PlanRequest,
    count_clear_configurations,
    describe_alternatives,
)
from ocp.motion.search.held_joints import all_joints
from ocp.refinement import refine_from, split
from ocp.solution import Solution


class CandidateSolver(Solver):
    """Solver of the candidate motions of a machine on a fixed or floating base.

    Attributes:
        request: The request.
        settings: Settings of the planner.
        start: Joint positions at the start, nan where they are free.
        motion: Problem without separation constraints.
    """

    def __init__(self, request: PlanRequest, start: Array, reference: Array) -> None:
        """Prepare the solver for the candidates of a request; start and reference are those of `ToolMotionSetup`."""
        self.request, self.settings, self.start, self.reference = request, request.settings, start, reference
        self.turning = request.turning_joints
        constraints = request.clearance_constraints
        self.motion = declared_motion(request, start=start, reference=reference, constraints=constraints)
        actuated = request.cost is None and (request.actuator_limits is not None or any(request.rests))
        self.last = Stage.ACTUATED if actuated else Stage.AUDITED
        self._clear_counts: dict[float, int | Unreachable | None] = {}
        self._prepared: dict[Any, tuple[ToolMotion, Collocation, Prepared]] = {}
        self._collisions: tuple[Solution | None, list[Collision]] = None, []

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """Advance a candidate by one solution stage or reject it; return this candidate and any derived from it."""
        steps = {
            Stage.SEED: self._solve_seed,
            Stage.COARSE: self._separate,
            Stage.SEPARATED: self._separate,
            Stage.FINE: self._refine,
            Stage.REFINED: self._audit,
            Stage.AUDITED: self._limit_actuators,
        }
        try:
            advanced = steps[candidate.stage](candidate)
        except SolveError as error:
            failed = replace(candidate, cost=np.nan, solution=error.solution, stage=max(candidate.stage, Stage.FINE))
            if candidate.stage is Stage.AUDITED:
                self.error = error
                return [failed.with_rejection(Reason.of_error(Rejection.ACTUATORS, error))]
            advanced = failed.with_rejection(self._failure_reason(failed, str(error)))
        if self._may_relax(advanced):
            return [Candidate(candidate.start, candidate.seed.cost, seed=replace(candidate.seed, relaxed=True))]
        if not advanced.passed and candidate.seed.relaxed and np.isnan(self._start(candidate)).any():
            # IPOPT may stall at a free start whose conditions are dependent: fix it, at a higher cost
            seed = replace(candidate.seed, fixed=True)
            return [advanced, Candidate(candidate.start, seed.cost, seed=seed)]
        return [advanced, *self._free_start(advanced)]

    def is_nearly_singular(self, local: Sequence[LocalMotion]) -> bool:
        """Return whether the tasks must be relaxed, because their Jacobian is nearly singular on a local motion."""
        samples = map(MotionSample.of_local, self.motion.stretches, local)
        return self.request.time_cost is None and any(sample.is_nearly_singular for sample in samples)

    def _may_relax(self, candidate: Candidate) -> bool:
        """Return whether relaxed tasks may save a rejected candidate; they cannot resolve collisions."""
        seed, reason = candidate.seed, candidate.reason
        if reason is None or reason.kind in (Rejection.COLLISION, Rejection.ACTUATORS) or _is_separated(candidate):
            return False
        return self.request.time_cost is None and seed.thorough and not seed.relaxed

    def _failure_reason(self, candidate: Candidate, words: str) -> Reason:
        """Return why a candidate failed: violations by its guess or, if tasks are relaxed, by its last iterate."""
        if not candidate.seed.local:
            return Reason(Rejection.INFEASIBLE, words.split("\n")[0])
        if candidate.solution is not None and candidate.seed.relaxed:
            return shortfall_reason(self.request, self._motion_samples(candidate.solution))
        samples = map(MotionSample.of_local, self.motion.stretches, candidate.seed.local)
        return shortfall_reason(self.request, list(samples))

    def _turned_tool_reason(self, solution: Solution) -> Reason | None:
        """Return a rejection reason if the tool at a free start is turned by more than 90 degrees from its target."""
        if self.request.start is not None:
            return None
        for sample in self._motion_samples(solution):
            equations = sample.stretch.equations
            if equations is not None and equations.pose_rows.any():
                targets = np.array(equations.target_function()(sample.t[0])).ravel()
                angle = equations.misses(sample.base[0], sample.joints[0], targets)[1]
                if angle > np.pi / 2:
                    words = f"at {sample.t[0]:.4g} s the tool is turned by {angle:.3g} rad from its target"
                    return Reason(Rejection.UNTRACKED, words, "task", angle, np.pi / 2, float(sample.t[0]))
        return None

    def _motion_samples(self, solution: Solution) -> list[MotionSample]:
        fractions = self._samples(solution)
        samples, values = list[MotionSample](), solution.at_fraction(fractions)
        for stretch in self.motion.stretches:
            base = values[f"base{stretch.suffix}"] if self.request.machine.base_size else np.zeros((len(fractions), 0))
            rates = values[SLOPES if self.request.time_cost is not None else f"rates{stretch.suffix}"]
            times = stretch.begin + fractions * stretch.duration
            samples.append(MotionSample(stretch, times, base, values[f"joints{stretch.suffix}"], rates))
        return samples

    # ---- stages ------------------------------------------------------------------------------------------------------

    def _solve_seed(self, candidate: Candidate) -> Candidate:
        seed, separated = candidate.seed, _is_separated(candidate)
        if seed.direct:
            return self._solve(candidate, Stage.FINE, seed.guess)
        return self._solve(candidate, Stage.SEPARATED if separated else Stage.COARSE, seed.guess)

    def _separate(self, candidate: Candidate) -> Candidate:
        """Solve a candidate again, with colliding bodies separated or, if no bodies collide, on the fine mesh."""
        collisions = self.collisions(candidate)
        if not collisions:
            return self._solve(candidate, Stage.FINE, candidate.solution)
        if isinstance(unreachable := self._count_clear_at(collisions[0].time), Unreachable):
            remedy = f"at {collisions[0].time:.4g} s {unreachable}"
            return candidate.with_rejection(self._collision_reason(collisions[0], remedy))
        return self._separate_pairs(candidate, Stage.SEPARATED, collisions)

    def _refine(self, candidate: Candidate) -> Candidate:
        """Solve a candidate again with separation constraints if bodies collide; otherwise refine its mesh."""
        if collisions := self.collisions(candidate):
            return self._separate_pairs(candidate, Stage.FINE, collisions)
        motion, mesh, _ = self.prepared(candidate, fine=True)
        assert candidate.solution is not None
        if (reason := self._turned_tool_reason(candidate.solution)) is not None:
            return candidate.with_rejection(reason)
        solution = self._refine_for_tasks(motion, mesh, candidate.solution, check=not _is_separated(candidate))
        if (deviation := self._deviations(solution).max()) > self.settings.max_deviation:
            words = (
                f"tips deviate, or joints exceed their limits, by {deviation:.2g} (m or rad) on finer meshes as well"
            )
            limit = self.settings.tip_tolerance
            return candidate.with_rejection(Reason(Rejection.UNTRACKED, words, "task", float(deviation), limit))
        return replace(candidate, stage=Stage.REFINED, cost=solution.cost, solution=solution)

    def _audit(self, candidate: Candidate) -> Candidate:
        """Audit a candidate; if the audit fails, refine the mesh or increase separation margins where that may help.

        If many starts are equally good, the optimality of one of them is undetermined. The motion is then solved and
        audited with its start fixed.
        """
        motion, mesh, _ = self.prepared(candidate, fine=True)
        constraints, joints_name = candidate.constraints, f"joints{motion.stretches[0].suffix}"
        assert candidate.solution is not None
        solution, audit = self._audit_and_refine(motion, mesh, candidate.solution, check=not _is_separated(candidate))
        if np.isnan(self._start(candidate)).any() and audit.feasible and audit.optimal is None:
            start = solution[joints_name][0]
            fixed = self._declare(candidate, start, self.reference)
            current_mesh = mesh.with_mesh(solution.state_interpolant.breaks)
            options = self._options(fixed, current_mesh, solution.cost, {})
            fixed_solution = solve(fixed.problem, current_mesh, guess=solution, options=options)
            fixed_solution = self._refine_for_tasks(fixed, mesh, fixed_solution, check=True)
            fixed_solution, fixed_audit = self._audit_and_refine(fixed, mesh, fixed_solution, check=True)
            slack = self.settings.negligible_rate * motion.horizon
            if fixed_audit.passed and fixed_solution.cost <= solution.cost * (1 + self.settings.same_cost) + slack:
                solution, audit = fixed_solution, fixed_audit
        candidate = replace(candidate, cost=solution.cost, solution=solution)
        proofs = list(audit.clearances.values())
        closest = max((pair for proof in proofs for pair in proof.pairs), key=attrgetter("missed"), default=None)
        if constraints is not None and closest is not None and closest.missed > 0:
            widened = replace(candidate, constraints=constraints.widened(proofs))
            return self._solve_again(widened, Stage.FINE, self._collision_reason(closest))
        if audit.passed:
            return replace(candidate, stage=Stage.AUDITED, audit=audit)
        if not audit.failures:
            return candidate.with_rejection(Reason(Rejection.UNDETERMINED, audit.undecided))
        worst = audit.failures[0]
        if candidate.seed.relaxed and not audit.feasible:
            samples = self._motion_samples(solution)
            reason = shortfall_reason(self.request, samples)
            return candidate.with_rejection(replace(reason, kind=Rejection.AUDIT))
        words = f"{worst.name} {worst.value:.2g}"
        return candidate.with_rejection(
            Reason(Rejection.AUDIT, words, worst.name, worst.value, worst.limit, worst.time)
        )

    def _limit_actuators(self, candidate: Candidate) -> Candidate:
        """Solve a candidate again within the actuator limits."""
        solution = solve_with_accelerations(self.request, self.start, self.reference, self.plan([candidate]))
        return replace(candidate, stage=Stage.ACTUATED, cost=solution.cost, solution=solution, audit=None)

    def _free_start(self, candidate: Candidate) -> list[Candidate]:
        """Return a list of one candidate with free start if the given one passed with a fixed start; else []."""
        if not (candidate.seed.fixed and candidate.passed and candidate.stage is Stage.AUDITED):
            return []
        constraints = self.request.clearance_constraints
        if constraints is not None:
            constraints = constraints.with_collisions(self.local_collisions(candidate.seed))
        seed = Seed(candidate.solution, approach=candidate.seed.approach, local=candidate.seed.local, direct=True)
        return [Candidate(candidate.start, seed=seed, constraints=constraints)]

    # ---- solves ------------------------------------------------------------------------------------------------------

    def _solve(self, candidate: Candidate, stage: Stage, guess: Any) -> Candidate:
        cost = guess.cost if isinstance(guess, Solution) else np.inf
        solution = self.prepared(candidate, stage >= Stage.FINE, cost)[2].solve(guess=guess, check=False)
        solved = replace(candidate, stage=stage, cost=solution.cost, solution=solution)
        if solution.success:
            return solved
        reason = self._failure_reason(solved, str(solution.status))
        return replace(candidate, cost=np.nan, solution=None).with_rejection(reason)

    def _separate_pairs(self, candidate: Candidate, stage: Stage, collisions: list[Collision]) -> Candidate:
        """Solve a candidate again, with separation constraints for the body pairs that collide."""
        assert candidate.constraints is not None
        separated = replace(candidate, constraints=candidate.constraints.with_collisions(collisions))
        return self._solve_again(separated, stage, self._collision_reason(collisions[0]))

    def _solve_again(self, candidate: Candidate, stage: Stage, reason: Reason) -> Candidate:
        count = candidate.separations + 1
        if count > self.settings.max_separations:
            return replace(candidate, separated=None).with_rejection(reason)
        return self._solve(replace(candidate, separations=count, separated=reason), stage, candidate.solution)

    def prepared(
        self, candidate: Candidate, fine: bool, cost: float = np.inf
    ) -> tuple[ToolMotion, Collocation, Prepared]:
        """Return the problem of a candidate, its first mesh, and a solver for guesses with a cost of about `cost`."""
        settings, separated = self.settings, _is_separated(candidate)
        margins: tuple[Any, ...] = ()
        if candidate.constraints is not None and separated:
            margins = tuple(sorted(candidate.constraints.margins.items()))
        key = margins, fine, candidate.seed.relaxed, tuple(candidate.start) if candidate.seed.fixed else ()
        if key not in self._prepared:
            start, motion = self._start(candidate), self.motion
            if margins or candidate.seed.fixed or candidate.seed.relaxed:
                reference = candidate.start if candidate.seed.fixed else self.reference
                motion = self._declare(candidate, start, reference)
            min_intervals = settings.separated_intervals if margins and not fine else settings.min_intervals
            degree = settings.fine_degree if fine else settings.coarse_degree
            count = min_intervals if len(motion.breaks) < min_intervals else 1
            mesh = Collocation(count, degree).with_nodes_at(motion.breaks)
            base_options = settings.fine_options if fine else settings.coarse_options
            options = self._options(motion, mesh, cost, base_options)
            self._prepared[key] = motion, mesh, mesh.prepare(motion.problem, options=options)
        return self._prepared[key]

    def _declare(self, candidate: Candidate, start: Array, reference: Array) -> ToolMotion:
        options: dict[str, Any] = {"start": start, "reference": reference, "constraints": candidate.constraints}
        return declared_motion(self.request, **options, relaxed=candidate.seed.relaxed)

    def _start(self, candidate: Candidate) -> Array:
        """Return the start configuration, with nan for joints that are free or move a separated pair of bodies."""
        if candidate.seed.fixed:
            return candidate.start
        constraints = candidate.constraints
        if constraints is None or not constraints.margins or self.request.start is not None:
            return self.start
        return np.where(constraints.scene.levers.joints[sorted(constraints.margins)].any(axis=0), np.nan, self.start)

    def _options(
        self, motion: ToolMotion, mesh: Collocation, cost: float, options: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return solver options; with separation constraints, they keep the homotopy class of the guess."""
        declared, least = motion.problem.declared, self.settings.negligible_rate * motion.horizon
        if not any(name.startswith(APART) for name in declared.path) or not least < cost < np.inf:
            return dict(options)
        return barrier_options(motion.problem, mesh, cost, options)

    # ---- meshes ------------------------------------------------------------------------------------------------------

    def _audit_and_refine(
        self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool
    ) -> tuple[Solution, Audit]:
        """Audit a solution and, if the audit requires it, solve on finer meshes; return the last solution and audit.

        With `check`, a solve that fails on a finer mesh is repeated from other guesses and diagnosed.
        """
        audit: Audit = solution.audit()
        if _refinable_failures(audit):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RefinementWarning)
                current, plan = mesh.with_mesh(solution.state_interpolant.breaks), (solution, audit)
                options = self._options(motion, current, solution.cost, self.settings.fine_options)
                solution, audit = refine_from(motion.problem, current, plan, options=options, check=check)
            if not _refinable_failures(audit):
                refined_solution = self._refine_for_tasks(motion, mesh, solution, check)
                if refined_solution is not solution:
                    solution, audit = refined_solution, refined_solution.audit()
        return solution, audit

    def _refine_for_tasks(self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool) -> Solution:
        """Refine the mesh where tips deviate or joints exceed limits, as long as that reduces the errors enough."""
        settings, deviations = self.settings, self._deviations(solution)
        for _ in range(settings.max_refinements):
            if deviations.max() <= settings.tip_tolerance:
                break
            # where a limit becomes active or inactive, the error is of second order in the interval
            splits = np.ceil(np.sqrt(deviations / settings.tip_tolerance)).clip(2, settings.max_splits).astype(int)
            parts = np.where(deviations > settings.tip_tolerance / len(deviations), splits, 1)
            nodes = split(solution.state_interpolant.breaks, parts, deviations, settings.max_intervals)
            finer = mesh.with_mesh(nodes)
            options = self._options(motion, finer, solution.cost, settings.fine_options)
            refined_solution = solve(motion.problem, finer, guess=solution, options=options, check=check)
            if not refined_solution.success:
                raise SolveError(f"on a finer mesh: {refined_solution.status}", refined_solution)
            previous, deviations = deviations.max(), self._deviations(refined_solution)
            if deviations.max() > max(REACH_TOLERANCE, settings.least_progress * previous):
                break
            solution = refined_solution
        return solution

    def _deviations(self, solution: Solution) -> Array:
        """Return the largest pose error or excess over a joint limit in each mesh interval (N,), m and rad."""
        robot, count = self.request.machine.robot, self.settings.samples_per_interval
        worst = np.zeros(len(self._samples(solution)))
        for sample in self._motion_samples(solution):
            joints, equations = sample.joints, sample.stretch.equations
            excess = np.maximum(robot.lower - joints, joints - robot.upper)
            worst = np.maximum(worst, excess.max(axis=1, initial=0.0))
            if equations is not None:
                at = sample.t, sample.base, joints
                sizes = np.cumsum([part.task.size for part in equations.bound])[:-1]
                errors = np.split(equations.errors(*at), sizes, axis=1)
                for part, error in zip(equations.bound, errors, strict=True):
                    if part.task.start_gap <= self.settings.tip_tolerance:  # feedback closes a larger initial gap
                        worst = np.maximum(worst, np.linalg.norm(error, axis=1))
                worst = np.maximum(worst, equations.cone_violations(*at).max(axis=1, initial=0))
        return np.asarray(np.maximum(worst[:-1], worst[1:]).reshape(-1, count).max(axis=1))

    def _samples(self, solution: Solution) -> Array:
        """Return sample times as fractions of the horizon: several in each mesh interval, and the end."""
        nodes, count = solution.state_interpolant.breaks, self.settings.samples_per_interval
        return np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(count) / count).ravel(), 1.0)

    def same_path(self, solution: Solution, reference: Solution) -> bool:
        """Return whether two motions have the same path, apart from mesh errors and full turns of joints."""
        difference = np.subtract(self._joints_along(solution), self._joints_along(reference))
        turns = 2 * np.pi * np.round(difference[0, 0] / (2 * np.pi))
        return bool(np.abs(difference - turns).max() <= self.settings.same_path)

    def reaches_limits(self, solution: Solution) -> bool:
        """Return whether joints of a solution come close to their limits."""
        joints, bounds = self._joints_along(solution), self.request.bounds
        return bool(np.minimum(joints - bounds.lower, bounds.upper - joints).min() <= self.settings.same_path)

    def _joints_along(self, solution: Solution) -> Array:
        """Return joint positions at M equally spaced times in each of S time intervals. Shape (S, M, n)."""
        values = solution.at_fraction(np.linspace(0.0, 1.0, self.settings.compared_samples))
        return np.array([values[f"joints{stretch.suffix}"] for stretch in self.motion.stretches])

    # ---- collisions --------------------------------------------------------------------------------------------------

    def collisions(self, candidate: Candidate) -> list[Collision]:
        """Return the collisions of a candidate between bodies without a separation constraint, in order of severity."""
        constraints, solution = candidate.constraints, candidate.solution
        if constraints is None or solution is None:
            return []
        if self._collisions[0] is not solution:
            collisions = list[Collision]()
            for sample in self._motion_samples(solution):
                collisions += find_collisions(constraints.scene, sample.base, sample.joints, sample.t)
            worst: dict[int, Collision] = {}
            for collision in sorted(collisions, key=lambda collision: collision.distance):
                worst.setdefault(collision.pair, collision)
            self._collisions = solution, list(worst.values())
        return [collision for collision in self._collisions[1] if collision.pair not in constraints.margins]

    def collision(self, candidate: Candidate) -> Reason | None:
        """Return the rejection reason for the worst collision of a candidate; None if no bodies collide."""
        collisions = self.collisions(candidate)
        return self._collision_reason(collisions[0]) if collisions else None

    def local_collisions(self, seed: Seed) -> list[Collision]:
        """Return the collisions along the local (resolved-rate) motion of an initial guess, in order of severity."""
        if (constraints := self.request.clearance_constraints) is None:
            return []
        of_motions = (find_collisions(constraints.scene, each.base[0], each.joints[0], each.t) for each in seed.local)
        return sorted(chain.from_iterable(of_motions), key=attrgetter("distance"))

    @property
    def no_clear_configuration(self) -> bool:
        """Whether there is a checked time at which all configurations that satisfy the tasks are in collision."""
        return any(isinstance(value, Unreachable) for value in self._clear_counts.values())

    def _count_clear_at(self, time: float) -> int | Unreachable | None:
        """Return the number of collision-free configurations at a time, or an error if there are none; cached."""
        if time not in self._clear_counts:
            self._clear_counts[time] = count_clear_configurations(self.request, time)
        return self._clear_counts[time]

    def _collision_reason(self, pair: Collision | ClosestPair, remedy: str = "") -> Reason:
        """Return the rejection reason for two bodies that are closer to each other than the clearance."""
        assert self.request.clearance_constraints is not None
        limit, names = self.request.clearance_constraints.scene.clearance, " and ".join(pair.bodies)
        return Reason(Rejection.COLLISION, str(pair), names, pair.distance, limit, pair.time, remedy)

    # ---- results -----------------------------------------------------------------------------------------------------

    def failure(self, candidates: Sequence[Candidate]) -> SolveError:
        """Return the error to raise if no candidate passes, with details of the lowest-cost candidate that collides."""
        error = super().failure(candidates)
        colliding = [c for c in candidates if c.reason is not None and c.reason.kind is Rejection.COLLISION]
        if not colliding:
            return error
        worst = min(colliding, key=lambda candidate: np.inf if np.isnan(candidate.cost) else candidate.cost).reason
        assert worst is not None
        alternatives = () if worst.time is None else describe_alternatives(self._count_clear_at(worst.time))
        error.args = ("; ".join([f"{error}\nthe lowest-cost candidate in collision: {worst.detail}", *alternatives]),)
        vars(error).update(worst.fault)
        return error

    def plan(self, candidates: Sequence[Candidate]) -> SolvedPlan:
        """Return the first candidate as a plan, which also lists the other candidates."""
        best = candidates[0]
        parts = tuple(Part(stretch.begin, stretch.end, stretch.suffix) for stretch in self.motion.stretches)
        assert best.solution is not None
        if self.request.time_cost is not None:
            parts = (parts[0]._replace(end=float(best.solution[CLOCK][-1, 0])),)
        request, whole = self.request, self.request.whole or self.request.machine
        extended = [replace(c, start=all_joints(whole.robot, request.held, c.start)) for c in candidates]
        extended[0] = replace(extended[0], cost=extended[0].cost - deviation_cost(best.solution, parts))
        audits = {} if best.audit is None else {audit_key(): best.audit}
        plan = SolvedPlan(whole, best.solution, parts, tuple(extended), held=request.held, _audits=audits)
        return plan.with_targets(request.tasks)


def _is_separated(candidate: Candidate) -> bool:
    return candidate.constraints is not None and bool(candidate.constraints.margins)


def _refinable_failures(audit: Audit) -> list[Finding]:
    """Return the failures of an audit that a finer mesh may correct: all but violated clearances."""
    return [finding for finding in audit.failures if finding.name not in audit.clearances]
