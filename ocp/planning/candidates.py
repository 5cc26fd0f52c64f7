"""The motions that postures lead to: compared on a coarse mesh, solved, refined and audited on a fine one."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Any

import numpy as np

from models.arrays import Array
from ocp.audit.audit import Audit, Finding
from ocp.audit.clearance import Nearest
from ocp.builders.clearance import APART, LOOKS, Clear
from ocp.builders.tool_motion import CLOCK, ToolMotion
from ocp.direct.collocation import Collocation
from ocp.direct.prepared import Prepared
from ocp.errors import RefinementWarning, SolveError
from ocp.local.following import Followed
from ocp.local.inverse_kinematics import Unreachable
from ocp.local.touching import Touch
from ocp.methods import solve
from ocp.planning.motion import Candidate, Plan, failed, parts_of
from ocp.planning.postures import (
    LEAST_INTERVALS,
    OUT_OF_REACH,
    Asked,
    clear_postures,
    misfits_of,
    others_told,
    touches_at_the_start,
)
from ocp.planning.request import declared_motion
from ocp.problem.values import constant
from ocp.refinement import refined, split
from ocp.solution import Solution

__all__ = ["TOUCHES", "Maker", "closer_motions", "coarse_motions", "fine_motions"]

COARSE, FINE = 2, 7
"""Degrees of collocation: smooth pieces are met to rounding by one interval of the high one."""
NEAR_ENOUGH = 1e-6
"""m and rad: of a posture that is looked at."""
FAILURES = 8
"""Motions that touch and cannot be kept clear, after which others that touch are left as they are."""
SAME, NEAR = 1e-5, 0.1
"""Share of the cost, and rad or m: of motions nearer to each other than either one is looked at."""
NOTHING = 1e-12
"""(rad/s)^2 or (m/s)^2: rates of rounding, of what stands still."""
TIP = 1e-6
"""m and rad: how far a tip may be from its task anywhere, all rows together."""
LOOKED_AT = 33
"""Places at which motions are compared."""
PLACES = 16
"""Of each interval, at which it is looked for."""
HELD = 24
"""Intervals of a coarse mesh on which bodies are held apart, where its pieces are fewer."""
MESHES, PIECES = 6, 4
"""Meshes, each cut where the tips stray from the one before, into so many pieces of an interval at most."""
BRIEF = 2
"""Meshes, where other motions wait to be tried."""
NEARER = 0.9
"""Of how far tips strayed that are out of reach, for all that is known: on a finer mesh they have to stray less."""
RESERVES = 3
"""Motions like one that does not hold that are tried in its place."""
MOST = 400
"""Intervals of a mesh."""
EVERY = 8
"""Motions that are audited, the cheapest first, where all are asked for: an audit of a large machine takes seconds."""
GAIN = 0.01
"""Share of the cost that a motion has to promise to spare, to be solved as it is."""
FAR = 10.0
"""A local motion so many times as dear as the cheapest plan is not worth a solve."""
SOLVER = {"max_iter": 150}
ROUGH = {"max_iter": 60, "tol": 1e-4, "mu_init": 1e-3}
"""On the coarse mesh, from a guess that does its tasks."""
OWN_BARRIER, LEAST_BARRIER = 0.1, 1e-10
"""With which ipopt begins by itself, and its tolerance, at which it ends."""

TOUCHES = "touches"
"""How the reason begins why a motion is not the plan whose bodies come too near."""
DEARER = "dearer"
ALIKE = "the same as another one, or of the same cost"


def _mesh(motion: ToolMotion, degree: int, least: int) -> Collocation:
    return Collocation(least if len(motion.breaks) < least else 1, degree).with_nodes_at(motion.breaks)


def _mesh_of(mesh: Collocation, solution: Solution) -> Collocation:
    return mesh.with_mesh(solution.state_interpolant.breaks)


def _options(motion: ToolMotion, mesh: Collocation, cost: float, options: dict[str, Any]) -> dict[str, Any]:
    """Options of a solve with bodies held apart from a motion of some cost: no barrier that is worth more than that.

    An interior-point method with a barrier mu goes to where the cost is above the least by mu for each limit (Boyd,
    Vandenberghe 2004, section 11.2.2). Where that is more than the whole cost of the motion that it begins from, the
    barrier alone says where it goes: far away from the bodies, on the other side of others.
    """
    declared = motion.problem.declared
    if not any(name.startswith(APART) for name in declared.path) or not NOTHING * motion.horizon < cost < np.inf:
        return options
    limits = [(each.lower, each.upper) for each in (*declared.states.values(), *declared.controls.values())]
    limits += [(each.lower, each.upper) for each in declared.path.values()]
    sides = 0
    for low, high in ((constant(low), constant(high)) for low, high in limits):
        sides += int(np.isfinite(np.array([low, high])[:, low < high]).sum())
    most = cost / (sides * mesh.intervals * mesh.degree)
    return {**options, "mu_init": max(min(options.get("mu_init", OWN_BARRIER), most), LEAST_BARRIER)}


def _failing(audit: Audit) -> list[Finding]:
    """What a finer mesh may mend: all that fails but bodies that touch."""
    return [finding for finding in audit.failures if finding.name not in audit.clearances]


def coarse_motions(
    maker: Maker, followed: list[Followed], postures: Array, fine: bool = False, others: Sequence[Candidate] = ()
) -> list[Candidate]:
    """The motions that the postures lead to on a coarse mesh, the cheapest first; of those of one cost the first.

    Or on the `fine` one; with `others` that were found on it.

    The start being free, postures of one family lead to one motion. Those that the tasks cannot be followed from are
    tried where they can be followed from none.
    """
    motion, _, prepared = maker.made(maker.asked.clear, fine)
    misfits, costs = np.array(misfits_of(followed)), np.sum([part.cost for part in followed], axis=0)
    follows = misfits <= max(OUT_OF_REACH, misfits.min())
    found = list(others)
    least = np.inf
    for number in np.lexsort((costs, ~follows)).tolist():
        joints = postures[number]
        maker.followed[tuple(joints)] = [part.of(slice(number, number + 1)) for part in followed]
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
            found.append(Candidate(joints, np.nan, f"no motion was found: {solution.status}"))
    found.sort(key=lambda one: np.inf if np.isnan(one.cost) else one.cost)
    return _once(motion, found)


def _once(motion: ToolMotion, found: list[Candidate]) -> list[Candidate]:
    """The same by rising cost; of those of one cost, or that are one motion, all but the first say so."""
    kept: list[tuple[float, Array]] = []
    for number, one in enumerate(found):
        if one.why or one.solution is None:
            continue
        path = _path(motion, one.solution)
        if any(abs(one.cost - cost) <= SAME * cost or _near(path, other) for cost, other in kept):
            found[number] = replace(one, why=ALIKE)
        else:
            kept.append((one.cost, path))
    return found


def _path(motion: ToolMotion, solution: Solution) -> Array:
    """Joints at LOOKED_AT places of a motion. Shape (LOOKED_AT, n)."""
    sample = solution.at_fraction(np.linspace(0.0, 1.0, LOOKED_AT))
    return np.hstack([sample[f"joints{stretch.suffix}"] for stretch in motion.stretches])


def _near(path: Array, other: Array) -> bool:
    """Whether two motions (M, n) are one, but for what a coarse mesh misses and full turns of joints."""
    apart = path - other
    turns = 2 * np.pi * np.round(apart[0] / (2 * np.pi))
    return bool(np.abs(apart - turns).max() <= NEAR)


def fine_motions(maker: Maker, coarse: list[Candidate], first: bool, every: bool = False) -> list[Candidate]:
    """What becomes on the fine mesh of the motions found on a coarse one; of the `first` that passes, or of all.

    With `every` of a number of those, too, that are dearer than one that passes; of those that become one, one is told.

    Of one that touches something, the bodies that touch are held apart on the coarse mesh first: that may cost more
    than another motion does. Where none is left, each posture's own local motion is gone on from, see `_other_sides`.
    """
    told = [one for one in coarse if one.why and one.why != ALIKE]
    alike = [one for one in coarse if one.why == ALIKE]
    least, beyond = np.inf, 0.0  # cost of the best, and how much the coarse mesh was wrong, as a share of it
    queue = [(one, maker.asked.clear) for one in coarse if not one.why]
    failures, audited, barred = 0, 0, ""
    while queue:
        candidate, clear = queue.pop(0)
        held = () if clear is None else clear.margins
        touching = [touch for touch in maker.touches(candidate.solution) if touch.pair not in held]
        every = every and audited < EVERY and candidate.cost <= FAR * least
        if (candidate.cost > least * (1 + beyond) and not every) or (first and np.isfinite(least)):
            dear = replace(candidate, why="dearer on a coarse mesh", solution=None)
            told.append(_touching(candidate, touching[0]) if touching else dear)
            continue
        if touching and clear is not None:
            if failures == FAILURES or (barred := maker.barred(touching[0].time)):
                told.append(_touching(candidate, touching[0], barred))
                continue
            bent, clear = maker.bent(candidate, clear, touching, candidate.solution)
            failures += bool(bent.why)
            if bent.why:
                told.append(bent)
            else:
                place = sum(one.cost <= bent.cost for one, _ in queue)
                queue.insert(place, (bent, clear))
            continue
        # where the first one of its cost does not hold, another one may
        others = (one for one in alike if one.cost >= candidate.cost and not maker.touches(one.solution))
        for one in chain((candidate,), islice(others, RESERVES)):
            solved = maker.solved(one.start, one.solution, clear=clear, most=np.inf if every else least)
            audited += 1
            if every and any(not own.why and abs(own.cost - solved.cost) <= SAME * own.cost for own in told):
                break
            told.append(solved)
            if solved.why == DEARER:
                break
            if not solved.why:
                assert one.solution is not None
                assert solved.solution is not None
                # what became another motion says nothing of the mesh
                if _near(_path(maker.motion, one.solution), _path(maker.motion, solved.solution)):
                    beyond = max(beyond, 2 * abs(solved.cost - one.cost) / max(solved.cost, np.finfo(float).tiny))
                least = min(least, solved.cost)
                break
    if failures and not np.isfinite(least) and not barred:
        told = _once_each(told + _other_sides(maker, coarse))
    named = {tuple(one.start) for one in told}
    return told + [replace(one, solution=None) for one in alike if tuple(one.start) not in named]


def _touching(
    candidate: Candidate, touch: Touch | Nearest, more: str = "", solution: Solution | None = None
) -> Candidate:
    """The same, which is not the plan because two bodies touch, and what more is known of that."""
    return replace(candidate, why=f"{TOUCHES}: {touch}{more and f'; {more}'}", solution=solution, touch=touch)


def _once_each(told: list[Candidate]) -> list[Candidate]:
    """Of what is told of one posture the last."""
    return list({tuple(one.start): one for one in told}.values())


def _other_sides(maker: Maker, coarse: list[Candidate]) -> list[Candidate]:
    """What becomes of postures whose motions touch, each from its own local motion; ends with one that passes.

    Where nothing is in the way postures slide along their self-motion into one motion, however clear they were. Their
    local motions pass on other sides; those that are clear, or nearest to it, are gone on from first.
    """
    told: list[Candidate] = []
    clear = maker.asked.clear
    assert clear is not None
    ways = [(one, maker.local_touches(one.start)) for one in coarse if maker.touches(one.solution)]
    ways.sort(key=lambda way: min((touch.distance for touch in way[1]), default=np.inf), reverse=True)
    for one, local in ways[:FAILURES]:
        pairs = {touch.pair: touch for touch in (*maker.touches(one.solution), *local)}
        guess = maker.motion.guess(maker.followed[tuple(one.start)], 0)
        bent, held = maker.bent(one, clear, list(pairs.values()), guess)
        told.append(bent if bent.why else maker.solved(one.start, bent.solution, clear=held))
        if not told[-1].why:
            return told
    return told + _held_starts(maker, [one.start for one in coarse])


def _held_starts(maker: Maker, starts: Sequence[Array]) -> list[Candidate]:
    """What becomes of postures that begin clear and are held there, the cheapest local motion first; ends with one that
    passes.

    A start that may slide is pushed about by all that is held apart later on the way; held, what it leads to is nearer.
    From what passes the start slides again.
    """
    asked, told = maker.asked, list[Candidate]()
    if asked.start is not None:
        return told
    assert asked.clear is not None
    touching = touches_at_the_start(asked, np.array(starts))
    clear = [one for one, touch in zip(starts, touching, strict=True) if touch is None]
    ways = [(one, maker.followed[tuple(one)]) for one in clear]
    ways = [(one, way) for one, way in ways if max(misfits_of(way)) <= OUT_OF_REACH]
    ways.sort(key=lambda way: sum(part.cost[0] for part in way[1]))
    for start, way in ways[:FAILURES]:
        told.append(_held_start(maker, start, way))
        if not told[-1].why:
            break
    return told


def closer_motions(maker: Maker, followed: list[Followed], told: list[Candidate], enough: float) -> list[Candidate]:
    """What becomes on the fine mesh of motions as they are, their starts held, the cheapest first.

    A start that is free, and a coarse mesh, may lead away from a motion that is nearly the cheapest. Ends with one that
    costs no more than is `enough`; motions that promise to be hardly cheaper than what is `told` are left out.
    """
    more, least = list[Candidate](), min((one.cost for one in told if not one.why), default=np.inf)
    costs = np.sum([part.cost for part in followed], axis=0)
    for number in np.argsort(costs, kind="stable").tolist():
        if least <= enough or costs[number] >= (1 - GAIN) * least:
            break
        way = [part.of(slice(number, number + 1)) for part in followed]
        more.append(_held_start(maker, followed[0].joints[number, 0], way))
        least = least if more[-1].why else min(least, more[-1].cost)
    return more


def _held_start(maker: Maker, start: Array, way: list[Followed]) -> Candidate:
    """What becomes of a local motion from a posture that is held; from what passes the start slides again."""
    held = maker if maker.asked.start is not None else Maker(replace(maker.asked, start=start), start, start)
    found = held.solved(start, held.motion.guess(way, 0))
    if found.why or held is maker:
        return found
    clear = maker.asked.clear
    if clear is not None:
        maker.followed[tuple(start)] = way
        clear = clear.holding([touch.pair for touch in maker.local_touches(start)])
    slid = maker.solved(start, found.solution, clear=clear)
    return slid if not slid.why and slid.cost <= found.cost else found


class Maker:
    """Makes motions, all of one problem, but for the bodies that are held apart in it."""

    def __init__(self, asked: Asked, start: Array, reference: Array) -> None:
        self.asked, self.start, self.reference = asked, start, reference
        self.followed: dict[tuple[float, ...], list[Followed]] = {}  # by postures: their local motions
        self.brief = False  # whether what finer meshes do not bring to its way is given up, for there are others
        self._clear: dict[float, int | Unreachable | None] = {}
        self._made: dict[Any, tuple[ToolMotion, Collocation, Prepared]] = {}
        self.motion = self.declared(start, asked.clear)
        self.why: SolveError | None = None  # what the last solve failed of

    def declared(self, start: Array, clear: Clear | None) -> ToolMotion:
        """The problem from a start, nan where it is free."""
        return declared_motion(self.asked, start=start, reference=self.reference, clear=clear)

    def made(self, clear: Clear | None, fine: bool, cost: float = np.inf) -> tuple[ToolMotion, Collocation, Prepared]:
        """The problem with some bodies held apart, a mesh for it, and both prepared for guesses of about a cost."""
        held = () if clear is None else tuple(sorted(clear.margins.items()))
        if (held, fine) not in self._made:
            motion = self.declared(self._start(clear), clear) if held else self.motion
            mesh = _mesh(motion, FINE if fine else COARSE, HELD if held and not fine else LEAST_INTERVALS)
            prepared = mesh.prepare(motion.problem, options=_options(motion, mesh, cost, SOLVER if fine else ROUGH))
            self._made[held, fine] = motion, mesh, prepared
        return self._made[held, fine]

    def _start(self, clear: Clear | None) -> Array:
        """Joints at the start, nan where they are free: what bodies that are held apart ride on is not ignorable."""
        if clear is None or not clear.margins or self.asked.start is not None:
            return self.start
        moves = clear.surroundings.levers.joints[sorted(clear.margins)].any(axis=0)
        return np.where(moves & ~self.asked.held, np.nan, self.start)

    def local_touches(self, start: Array) -> list[Touch]:
        """The bodies that come too near in the local motion from a posture, the worst first."""
        clear, found = self.asked.clear, list[Touch]()
        if clear is not None:
            for part in self.followed[tuple(start)]:
                found += clear.touches(part.base[0], part.joints[0], part.t)
        return sorted(found, key=lambda touch: touch.distance)

    def touches(self, solution: Solution | None) -> list[Touch]:
        """The bodies that come too near in a motion, at the places where that is looked for."""
        clear = self.asked.clear
        if clear is None or solution is None:
            return []
        at = self._places(solution)
        sample, found = solution.at_fraction(at), []
        for stretch in self.motion.stretches:
            base = sample[f"base{stretch.suffix}"] if self.asked.machine.base_size else np.zeros((len(at), 0))
            times = stretch.begin + at * stretch.duration
            found += clear.touches(base, sample[f"joints{stretch.suffix}"], times)
        worst: dict[int, Touch] = {}
        for touch in sorted(found, key=lambda touch: touch.distance):
            worst.setdefault(touch.pair, touch)
        return list(worst.values())

    def barred(self, time: float) -> str:
        """That no posture which does the tasks at a time is clear; "" where one is, or where that is not known."""
        clear = self._clear_at(time)
        return f"at {time:.4g} s {clear}" if isinstance(clear, Unreachable) else ""

    def _clear_at(self, time: float) -> int | Unreachable | None:
        """How many postures that do the tasks at a time are clear, or why none is; None where that is not known."""
        if time not in self._clear:
            self._clear[time] = clear_postures(self.asked, time)
        return self._clear[time]

    def bent(self, candidate: Candidate, clear: Clear, touching: list[Touch], guess: Any) -> tuple[Candidate, Clear]:
        """A motion on the coarse mesh with what touches held apart, one pair after the other, or why there is none."""
        for _ in range(LOOKS):
            clear = clear.holding([touch.pair for touch in touching])
            solution = self.made(clear, fine=False, cost=candidate.cost)[2].solve(guess=guess, check=False)
            if not solution.success:
                return _touching(candidate, touching[0], "held apart, no motion was found"), clear
            again = [touch for touch in self.touches(solution) if touch.pair not in clear.margins]
            if not again:
                return replace(candidate, cost=solution.cost, why="", solution=solution), clear
            touching, guess = again, solution
        return _touching(candidate, touching[0]), clear

    def solved(
        self, start: Array, guess: Any, thorough: bool = False, clear: Clear | None = None, most: float = np.inf
    ) -> Candidate:
        """A motion from a guess, and what is wrong with it; with `thorough` from other starts, too, and why if none.

        Bodies that come too near are held apart, farther each time, and it is solved again. What does not cost less
        than `most` is not looked at any further.
        """
        touch, near, apart = "", None, clear or self.asked.clear
        for _ in range(LOOKS):
            candidate, farther = self._solved(start, guess, thorough, apart, most)
            if farther is None:
                break
            touch, near, apart, guess = candidate.why, candidate.touch, farther, candidate.solution
        if touch and candidate.why and not candidate.why.startswith(touch):
            candidate = replace(candidate, why=f"{touch}; held apart: {candidate.why}", touch=near)
        return candidate

    def _solved(
        self, start: Array, guess: Any, thorough: bool, clear: Clear | None, most: float
    ) -> tuple[Candidate, Clear | None]:
        """As `solved`, what touches left as it is; then how it is to be held apart, else None.

        Where many starts do equally well, no one of them is decided to be the best; then the motion is judged from the
        start that was found.
        """
        cost = guess.cost if isinstance(guess, Solution) else np.inf
        motion, mesh, prepared = self.made(clear, fine=True, cost=cost)
        try:
            named = clear is not None and bool(clear.margins)  # then what is in the way is named already
            solution = prepared.solve(guess=guess, check=thorough and not named)
            if not solution.success:
                return Candidate(start, np.nan, f"no motion was found: {solution.status}"), None
            if solution.cost >= most * (1 - SAME):
                return Candidate(start, solution.cost, DEARER), None
            touching = [touch for touch in self.touches(solution) if clear and touch.pair not in clear.margins]
            if clear is not None and touching:
                apart = clear.holding([touch.pair for touch in touching])
                return _touching(Candidate(start, solution.cost), touching[0], solution=solution), apart
            solution, audit = self._audited(motion, mesh, solution, check=not named)
            if np.isnan(self._start(clear)).any() and audit.feasible and audit.optimal is None:
                first = solution[f"joints{motion.stretches[0].suffix}"][0]
                held = self.declared(first, clear)
                same = _mesh_of(mesh, solution)
                options = _options(held, same, solution.cost, {})
                again, other = self._audited(held, mesh, solve(held.problem, same, guess=solution, options=options))
                if other.passed and again.cost <= solution.cost * (1 + SAME) + NOTHING * motion.horizon:
                    solution, audit = again, other
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            self.why = error
            return Candidate(start, np.nan, str(error).split("\n")[0], error.solution), None
        missed = [near for proof in audit.clearances.values() for near in proof.pairs if near.missed > 0]
        if clear is not None and missed:
            worst_pair = max(missed, key=lambda near: near.missed)
            candidate = _touching(Candidate(start, solution.cost), worst_pair, solution=solution)
            return candidate, clear.widened(list(audit.clearances.values()))
        if audit.passed:
            return Candidate(start, solution.cost, "", solution), None
        worst = audit.failures[0] if audit.failures else None
        why = f"not decided: {audit.undecided}" if worst is None else f"the audit fails, {worst.name} {worst.value:.2g}"
        return Candidate(start, solution.cost, why, solution), None

    def _audited(
        self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool = True
    ) -> tuple[Solution, Audit]:
        """A motion, on a finer mesh where the way of its tips or its audit asks for it, and its audit.

        With `check` what fails on a finer mesh is tried from other starts, and what would have to give way is found.
        """
        solution = self._on_its_way(motion, mesh, solution, check)
        if self.brief and (stray := self._strays(motion, solution).max()) > OUT_OF_REACH:
            words = f"the tips stray by {stray:.2g} (m or rad) on finer meshes, too"
            raise SolveError(words, solution, name="task", value=float(stray), limit=TIP)
        audit: Audit = solution.audit()
        if _failing(audit):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RefinementWarning)
                same = _mesh_of(mesh, solution)
                options = _options(motion, same, solution.cost, SOLVER)
                solution, audit = refined(motion.problem, same, solution, audit, options, check)
            if not _failing(audit) and (finer := self._on_its_way(motion, mesh, solution, check)) is not solution:
                solution, audit = finer, finer.audit()
        return solution, audit

    def _on_its_way(self, motion: ToolMotion, mesh: Collocation, solution: Solution, check: bool) -> Solution:
        """A motion, on a finer mesh where its tips stray, as long as that may lead them back."""
        strays = self._strays(motion, solution)
        for _ in range(BRIEF if self.brief else MESHES):
            if strays.max() <= TIP:
                break
            # where something binds or lets go it is smooth to the second order
            more = np.ceil(np.sqrt(strays / TIP)).clip(2, PIECES).astype(int)
            pieces = np.where(strays > TIP / len(strays), more, 1)
            cut = split(solution.state_interpolant.breaks, pieces, strays, MOST)
            finer = mesh.with_mesh(cut)
            options = _options(motion, finer, solution.cost, SOLVER)
            found = solve(motion.problem, finer, guess=solution, options=options, check=check)
            if not found.success:
                raise SolveError(f"no motion was found on a finer mesh: {found.status}", found)
            before, strays = strays.max(), self._strays(motion, found)
            if strays.max() > max(OUT_OF_REACH, NEARER * before):
                break
            solution = found
        return solution

    def _strays(self, motion: ToolMotion, solution: Solution) -> Array:
        """How far the tips are from their poses in each interval of the mesh, m and rad. Shape (N,)."""
        at = self._places(solution)
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

    @staticmethod
    def _places(solution: Solution) -> Array:
        """Fractions of the horizon at which a motion is looked at, PLACES in each interval, and the end."""
        nodes = solution.state_interpolant.breaks
        return np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(PLACES) / PLACES).ravel(), 1.0)

    def _failed(self, told: list[Candidate]) -> SolveError:
        """That no motion passes; where bodies touch, it is about the cheapest motion in which they do."""
        error = failed(told, self.why)
        touching = [(np.inf if np.isnan(one.cost) else one.cost, one.touch) for one in told if one.touch is not None]
        if not touching or self.asked.clear is None:
            return error
        touch = min(touching, key=lambda one: one[0])[1]
        words = "; ".join([f"{error}\nthe cheapest that touches: {touch}", *others_told(self._clear_at(touch.time))])
        limit = self.asked.clear.surroundings.clearance
        found: dict[str, Any] = {"value": touch.distance, "limit": limit, "time": touch.time}
        return SolveError(words, error.solution, error.conflicts, name=" and ".join(touch.bodies), **found)

    def plan(self, told: list[Candidate]) -> Plan:
        """The plan of the cheapest motion that passes, with the others and why they are not the plan.

        Raises:
            SolveError: None passes.
        """
        passing = [one for one in told if not one.why]
        if not passing:
            raise self._failed(told)
        best = min(passing, key=lambda one: one.cost)
        ended = [one if one is best or one.why else replace(one, why=DEARER) for one in told]
        ended.sort(key=lambda one: (one is not best, np.inf if np.isnan(one.cost) else one.cost))
        assert best.solution is not None
        parts = parts_of(self.motion.stretches)
        if self.asked.time_cost is not None:
            parts = (parts[0]._replace(end=float(best.solution[CLOCK][-1, 0])),)
        return Plan(self.asked.machine, best.solution, parts, tuple(ended)).with_targets(self.asked.tasks)
