"""The motions that postures lead to: compared on a coarse mesh, solved, refined and audited on a fine one."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from models.arrays import Array
from ocp.audit.audit import Audit
from ocp.builders.tool_motion import CLOCK, ToolMotion, tool_motion_problem
from ocp.direct.collocation import Collocation
from ocp.direct.prepared import Prepared
from ocp.errors import RefinementWarning, SolveError
from ocp.local.following import Followed
from ocp.methods import solve
from ocp.planning.motion import Candidate, Plan, failed, parts_of
from ocp.planning.postures import LEAST_INTERVALS, OUT_OF_REACH, Asked, misfits_of
from ocp.refinement import refine
from ocp.solution import Solution

__all__ = ["Maker", "coarse_motions", "fine_motions"]

COARSE, FINE = 2, 7
"""Degrees of collocation: smooth pieces are met to rounding by one interval of the high one."""
SAME, NEAR = 1e-5, 0.1
"""Share of the cost, and rad or m: of motions nearer to each other than either one is looked at."""
NOTHING = 1e-12
"""(rad/s)^2 or (m/s)^2: rates of rounding, of what stands still."""
TIP = 1e-6
"""m and rad: how far a tip may be from its task anywhere, all rows together."""
PLACES = 16
"""Of each interval, at which it is looked for."""
MESHES = 4
"""One cut where the tips stray from the one before."""
RESERVES = 3
"""Motions like one that does not hold that are tried in its place."""
FAR = 10.0
"""A local motion so many times as dear as the cheapest plan is not worth a solve."""
SOLVER = {"max_iter": 150}
ROUGH = {"max_iter": 60, "tol": 1e-4, "mu_init": 1e-3}
"""On the coarse mesh, from a guess that does its tasks."""

ALIKE = "the same as another one, or of the same cost"


def _mesh(motion: ToolMotion, degree: int) -> Collocation:
    return Collocation(LEAST_INTERVALS if len(motion.breaks) < LEAST_INTERVALS else 1, degree).with_nodes_at(
        motion.breaks
    )


def coarse_motions(motion: ToolMotion, followed: list[Followed], postures: Array) -> list[Candidate]:
    """The motions that the postures lead to on a coarse mesh, the cheapest first; of those of one cost the first.

    The start being free, postures of one family lead to one motion. Those that the tasks cannot be followed from are
    tried where they can be followed from none.
    """
    prepared = _mesh(motion, COARSE).prepare(motion.problem, options=ROUGH)
    misfits, costs = np.array(misfits_of(followed)), np.sum([part.cost for part in followed], axis=0)
    follows = misfits <= max(OUT_OF_REACH, misfits.min())
    found: list[Candidate] = []
    least = np.inf
    for number in np.lexsort((costs, ~follows)).tolist():
        joints = postures[number]
        if not follows[number] and np.isfinite(least):
            found.append(Candidate(joints, np.nan, "the tasks cannot be followed from there"))
            continue
        if costs[number] > FAR * least:
            found.append(Candidate(joints, float(costs[number]), "far dearer by its local motion"))
            continue
        solution = prepared.solve(guess=motion.guess(followed, number), check=False)
        if solution.success:
            least = min(least, solution.cost)
            found.append(Candidate(joints, solution.cost, "", solution))
        else:
            found.append(Candidate(joints, np.nan, f"no motion was found: {solution.status.split(':')[0]}"))
    found.sort(key=lambda one: np.inf if np.isnan(one.cost) else one.cost)
    return _once(motion, found)


def _once(motion: ToolMotion, found: list[Candidate]) -> list[Candidate]:
    """The same by rising cost; of those of one cost, or that are one motion, all but the first say so."""
    places = np.linspace(0.0, 1.0, 33)
    kept: list[tuple[float, Array]] = []
    for number, one in enumerate(found):
        if one.why or one.solution is None:
            continue
        sample = one.solution.at_fraction(places)
        path = np.hstack([sample[f"joints{stretch.suffix}"] for stretch in motion.stretches])
        if any(abs(one.cost - cost) <= SAME * cost or _near(path, other) for cost, other in kept):
            found[number] = replace(one, why=ALIKE)
        else:
            kept.append((one.cost, path))
    return found


def _near(path: Array, other: Array) -> bool:
    """Whether two motions (M, n) are one, but for what a coarse mesh misses and full turns of joints."""
    apart = path - other
    turns = 2 * np.pi * np.round(apart[0] / (2 * np.pi))
    return bool(np.abs(apart - turns).max() <= NEAR)


def fine_motions(maker: Maker, coarse: list[Candidate], first: bool) -> list[Candidate]:
    """What becomes on the fine mesh of the motions found on a coarse one; of the `first` that passes, or of all."""
    told = [one for one in coarse if one.why and one.why != ALIKE]
    alike = [one for one in coarse if one.why == ALIKE]
    least, beyond = np.inf, 0.0  # cost of the best, and how much the coarse mesh was wrong, as a share of it
    for candidate in (one for one in coarse if not one.why):
        if candidate.cost > least * (1 + beyond) or (first and np.isfinite(least)):
            told.append(replace(candidate, why="dearer on a coarse mesh", solution=None))
            continue
        # where the first one of its cost does not hold, another one may
        others = [one for one in alike if one.cost >= candidate.cost][:RESERVES]
        for one in (candidate, *others):
            solved = maker.solved(one.start, one.solution)
            told.append(solved)
            if not solved.why:
                beyond = max(beyond, 2 * abs(solved.cost - one.cost) / max(solved.cost, np.finfo(float).tiny))
                least = min(least, solved.cost)
                break
    named = {tuple(one.start) for one in told}
    return told + [replace(one, solution=None) for one in alike if tuple(one.start) not in named]


class Maker:
    """Makes motions on the fine mesh, all of one prepared problem."""

    def __init__(self, asked: Asked, start: Array, reference: Array) -> None:
        self.asked, self.reference = asked, reference
        self.free = bool(np.isnan(start).any())
        self.motion = self._declared(start)
        self.mesh = _mesh(self.motion, FINE)
        self._prepared: Prepared | None = None
        self.why: SolveError | None = None  # what the last solve failed of

    def _declared(self, start: Array) -> ToolMotion:
        asked = self.asked
        return tool_motion_problem(
            asked.machine,
            asked.stretches,
            base=asked.base,
            start=start,
            reference=self.reference,
            cyclic=asked.cyclic,
            weights=asked.weights,
            bounds=asked.bounds,
            time_cost=asked.time_cost,
        )

    def solved(self, start: Array, guess: Any, thorough: bool = False) -> Candidate:
        """A motion from a guess, and what is wrong with it; with `thorough` from other starts, too, and why if none.

        Where many starts do equally well, no one of them is decided to be the best; then the motion is judged from the
        start that was found.
        """
        if self._prepared is None:
            self._prepared = self.mesh.prepare(self.motion.problem, options=SOLVER)
        try:
            solution = self._prepared.solve(guess=guess, check=thorough)
            if not solution.success:
                return Candidate(start, np.nan, f"no motion was found: {solution.status.split(':')[0]}")
            solution, audit = self._audited(self.motion, solution)
            if self.free and audit.feasible and audit.optimal is None:
                first = solution[f"joints{self.motion.stretches[0].suffix}"][0]
                held = self._declared(first)
                again, other = self._audited(held, solve(held.problem, self._mesh_of(solution), guess=solution))
                if other.passed and again.cost <= solution.cost * (1 + SAME) + NOTHING * self.motion.horizon:
                    solution, audit = again, other
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            self.why = error
            return Candidate(start, np.nan, str(error).split("\n")[0], error.solution)
        if audit.passed:
            return Candidate(start, solution.cost, "", solution)
        worst = audit.failures[0] if audit.failures else None
        why = f"not decided: {audit.undecided}" if worst is None else f"the audit fails, {worst.name} {worst.value:.2g}"
        return Candidate(start, solution.cost, why, solution)

    def _audited(self, motion: ToolMotion, solution: Solution) -> tuple[Solution, Audit]:
        """A motion, refined where its audit or the way of its tips asks for it, and its audit."""
        audit: Audit = solution.audit()
        for _ in range(MESHES):
            if audit.failures:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RefinementWarning)
                    solution = refine(motion.problem, self._mesh_of(solution), guess=solution, options=SOLVER)
                audit = solution.audit()
                if audit.failures:
                    break
            strays = self._strays(motion, solution)
            if strays.max() <= TIP:
                break
            nodes = solution.state_interpolant.breaks
            cut = np.flatnonzero(strays > TIP / len(strays))
            nodes = np.union1d(nodes, (nodes[cut] + nodes[cut + 1]) / 2)
            solution = solve(motion.problem, self.mesh.with_mesh(nodes), guess=solution, options=SOLVER)
            audit = solution.audit()
        return solution, audit

    def _strays(self, motion: ToolMotion, solution: Solution) -> Array:
        """How far the tips are from their poses in each interval of the mesh, m and rad. Shape (N,)."""
        nodes = solution.state_interpolant.breaks
        at = np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(PLACES) / PLACES).ravel(), 1.0)
        sample, worst = solution.at_fraction(at), np.zeros(len(at))
        for stretch in motion.stretches:
            if stretch.equations is not None:
                base = sample[f"base{stretch.suffix}"] if self.asked.machine.base_size else None
                times, joints = stretch.begin + at * stretch.duration, sample[f"joints{stretch.suffix}"]
                sizes = np.cumsum([part.task.size for part in stretch.equations.bound])[:-1]
                errors = np.split(stretch.equations.errors(times, base, joints), sizes, axis=1)
                for part, own in zip(stretch.equations.bound, errors, strict=True):
                    if part.task.start_gap <= TIP:  # the feedback closes a larger one on the way
                        worst = np.maximum(worst, np.linalg.norm(own, axis=1))
                worst = np.maximum(worst, stretch.equations.overhangs(times, base, joints).max(axis=1, initial=0))
        return np.asarray(np.maximum(worst[:-1], worst[1:]).reshape(-1, PLACES).max(axis=1))

    def _mesh_of(self, solution: Solution) -> Collocation:
        return self.mesh.with_mesh(solution.state_interpolant.breaks)

    def plan(self, told: list[Candidate]) -> Plan:
        """The plan of the cheapest motion that passes, with the others and why they are not the plan.

        Raises:
            SolveError: None passes.
        """
        passing = [one for one in told if not one.why]
        if not passing:
            raise failed(told, self.why)
        best = min(passing, key=lambda one: one.cost)
        ended = [one if one is best or one.why else replace(one, why="dearer") for one in told]
        ended.sort(key=lambda one: (one is not best, np.inf if np.isnan(one.cost) else one.cost))
        assert best.solution is not None
        parts = parts_of(self.motion.stretches)
        if self.asked.time_cost is not None:
            parts = (parts[0]._replace(end=float(best.solution[CLOCK][-1, 0])),)
        return Plan(self.asked.machine, best.solution, parts, tuple(ended))
