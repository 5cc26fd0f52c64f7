"""Proof that bodies stay apart at every time, between the samples of a plan too.

For a fixed direction n the gap of two hulls is the least of the gaps of their points, each of which bends over time by
no more than the points' acceleration (:mod:`ocp.problem.separation`). Between two times h apart it is hence at least

    min(gap at the one, gap at the other) - h^2 / 8 acceleration,

and the distance is no less than the gap. The direction is that in which the bodies are nearest in the middle. Of a pair
that others cover the same is said of each of them, and the least of it is as good. Where the bound does not settle it,
the time between is halved. The plan's own polynomials say how fast its states change. What moves by time alone is
bounded over the interval itself, kinks and jumps included (:mod:`ocp.problem.enclosures`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import comb
from typing import NamedTuple

import numpy as np

from ocp.console import check_time
from ocp.curves import PiecewisePolynomial
from ocp.problem.enclosures import PrescribedMotion
from ocp.problem.formulation import Formulation
from ocp.problem.hulls import BodyPairs, Frames, frames_of
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.solution import Solution, check_variables_match, match_order

__all__ = [
    "Clearance",
    "Nearest",
    "ProofSettings",
    "Track",
    "clearance",
    "clearance_along",
    "nearest_along",
    "nearest_at",
    "placements_along",
]

SHOWN = 4
"""Pairs left out by assumption that are named in a line; all are in `Clearance.assumed`."""


@dataclass(frozen=True)
class ProofSettings:
    """How far the halving of intervals goes.

    Attributes:
        share: Of what the least distance is more or less than is asked: it is known to so much.
        finest: A distance is known to so much where less is asked, m.
        halvings: Of an interval of the mesh: 1 s becomes 15 ns.
        most_intervals: Of pairs that are bounded, beyond which what is left is not proven.
        first_blocks: Intervals of the whole time that are bounded first, at most: of finer pieces several together.
        first_times: At which the balls about bodies are compared first, at most.
    """

    share: float = 0.02
    finest: float = 1e-6
    halvings: int = 26
    most_intervals: int = 400_000
    first_blocks: int = 128
    first_times: int = 512


@dataclass(frozen=True)
class Nearest:
    """How near two bodies come.

    Attributes:
        bodies: Their names.
        least: A lower bound of their distance at all times, m; negative where they overlap.
        distance: The least found, at a time. m. time: That time, s.
        points: There, in world, the nearest points of what the radii swell. Shape (2, 3), m.
        asked: How far they have to be apart, m.
    """

    bodies: tuple[str, str]
    least: float
    distance: float
    time: float
    points: np.ndarray
    asked: float

    @property
    def missed(self) -> float:
        """By how much more the bodies may come near each other than they are allowed to, m."""
        return max(self.asked - self.least, 0.0)

    def __str__(self) -> str:
        one, other = self.bodies
        how = f"{self.distance:.4g} m apart" if self.distance >= 0 else f"overlap by {-self.distance:.4g} m"
        return f"{one} and {other} {'are ' if self.distance >= 0 else ''}{how} at {self.time:.4g} s"


class Track(NamedTuple):
    """How bodies move.

    Attributes:
        breaks: Where its N pieces begin and end, from 0 to 1, fractions of the horizon. Shape (N + 1,).
        horizon: s.
        rates, seconds: Bounds of the sizes of the first and second derivatives in time of what moves the bodies, in
            every piece. Shape (N, k).
        smooth: Whether the rates do not jump from piece to piece.
        frames: Fractions (M,) to the frames there.
        prescribed: What time alone moves; None where that is nothing.
    """

    breaks: np.ndarray
    horizon: float
    rates: np.ndarray
    seconds: np.ndarray
    smooth: bool
    frames: Callable[[np.ndarray], Frames]
    prescribed: PrescribedMotion | None = None


@dataclass(frozen=True)
class Clearance:
    """What was proven of a separation.

    Attributes:
        name: Of the separation.
        pairs: How near each pair comes: those that miss what is asked, or may, the worst first; then by what was found,
            the nearest to what is allowed first. Of that one the bound is close, of others it says that they are no
            nearer than that one.
        settled: Whether every pair's least distance was told from what is asked, one way or the other.
        looked: Number of intervals of pairs that were looked at.
        reason: Why it is not settled, where a motion that time prescribes jumps or has no bound; else empty.
        assumed: Pairs of bodies that were not looked at, by an assumption of the separation, and why.
    """

    name: str
    pairs: tuple[Nearest, ...]
    settled: bool
    looked: int
    reason: str = ""
    assumed: Mapping[str, str] = field(default_factory=dict)

    @property
    def worst(self) -> Nearest | None:
        """The pair that comes nearest to what it is allowed, or is beyond it; None where there are no pairs."""
        return self.pairs[0] if self.pairs else None

    def __str__(self) -> str:
        if self.worst is None:
            return "; ".join(["no pairs", *self._assumptions])
        verdict = "proven" if not self.worst.missed else "violated" if self.settled else "not proven"
        parts = [verdict, f"least {self.worst}", *([self.reason] if self.reason else []), *self._assumptions]
        return "; ".join(parts)

    @property
    def _assumptions(self) -> list[str]:
        """What was not looked at, in words; nothing where all was."""
        some = [f"{pair} ({why})" for pair, why in list(self.assumed.items())[:SHOWN]]
        more = [f"{len(self.assumed) - SHOWN} more"] if len(self.assumed) > SHOWN else []
        return [f"left out by assumption: {', '.join([*some, *more])}"] if some else []


def clearance(form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> Clearance:
    """How near each pair of bodies comes along a plan, at any time.

    Args:
        form: Of the problem. apart: A separation of it. solution: The plan, its states in the order of the problem.
        p: Parameters. Shape (np,).
    """
    return clearance_along(apart, _track_of(form, apart, solution, p)) if len(apart) else clearance_along(apart, None)


def clearance_along(apart: Separation, track: Track | None, settings: ProofSettings = ProofSettings()) -> Clearance:
    """How near each pair of bodies comes along any track, at any time; no track is needed where there are no pairs."""
    if not len(apart) or track is None:
        return Clearance(apart.name, (), True, 0, assumed=apart.assumed)
    return _Search(apart, track, settings).run()


def nearest_at(problem: Problem, solution: Solution, time: float) -> Nearest | None:
    """The two bodies of a plan that are nearest to each other at a time (s); None where none have to stay apart.

    Raises:
        ProblemError: The plan does not belong to the problem.
    """
    found = nearest_along(problem, solution, [time])
    return found[0] if found else None


def nearest_along(problem: Problem, solution: Solution, times: Iterable[float], suffix: str = "") -> list[Nearest]:
    """As `nearest_at` at several times; nothing where none have to stay apart.

    Args:
        suffix: That the names of the states have which move the bodies: of a plan whose parts stand side by side, one.

    Raises:
        ProblemError: The plan does not belong to the problem.
    """
    searches = [_Search(apart, track) for apart, track in _tracks(problem, solution, suffix)]
    if not searches:
        return []
    return [
        min((near for search in searches for near in search.at(time)), key=lambda near: near.distance) for time in times
    ]


def placements_along(
    problem: Problem, solution: Solution, times: np.ndarray, suffix: str = ""
) -> list[tuple[Separation, Frames]]:
    """Where the frames are at times (K,), s, on which bodies ride that have to stay apart, of each separation.

    Args:
        suffix: As of `nearest_along`.

    Raises:
        ProblemError: The plan does not belong to the problem.
    """
    fractions = times / solution.horizon
    return [(apart, track.frames(fractions)) for apart, track in _tracks(problem, solution, suffix)]


def _tracks(problem: Problem, solution: Solution, suffix: str) -> list[tuple[Separation, Track]]:
    """Of all separations whose movers' names end so, that have pairs."""
    form = Formulation.of(problem)
    check_variables_match(form, solution)
    solution, p = match_order(form, solution), form.parameter_vector(solution.parameters)
    moved = [one for one in problem.declared.apart.values() if all(name.endswith(suffix) for name in one.movers)]
    return [(one, _track_of(form, one, solution, p)) for one in moved if len(one)]


def _track_of(form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> Track:
    """Of a plan."""
    columns = [k for name in apart.movers for k in range(*form.states[name].indices(form.nx))]
    curve, horizon = solution.state_interpolant, solution.horizon
    outputs, kept = [form.separations[apart.name]], ("placements", apart.name)

    def frames(at: np.ndarray) -> Frames:
        controls = np.zeros((len(at), form.nu))
        return frames_of(form.sampled(outputs, curve(at), controls, at * horizon, horizon, p, cache_as=kept)[0])

    prescribed = PrescribedMotion(apart, form.separations[apart.name], form.t, [form.p], [p])
    return Track(curve.breaks, horizon, *_fastest(curve, columns, horizon), False, frames, prescribed)


class _Search:
    """The halving of intervals of pairs until each is settled.

    At a level l >= 0 an interval is a block of 2^l pieces, below it a share 2^l of one: begin and end are numbers of
    pieces, index 2^l and (index + 1) 2^l.
    """

    def __init__(self, apart: Separation, track: Track, settings: ProofSettings = ProofSettings()) -> None:
        self.settings = settings
        self.apart, self.track = apart, track
        self.breaks, self.pieces = track.breaks, len(track.breaks) - 1
        self.top = max(0, int(np.ceil(np.log2(self.pieces / self.settings.first_blocks))))
        self.fastest = [(track.rates, track.seconds)]
        for level in range(self.top):
            rates, seconds = (_of_two(values) for values in self.fastest[level])
            self.fastest.append((rates, seconds if track.smooth else np.full_like(seconds, np.inf)))
        self.bodies = BodyPairs(tuple(apart.hulls.values()), apart.pairs, apart.covers)
        n = len(apart)
        self.best, self.when, self.points = np.full(n, np.inf), np.zeros(n), np.zeros((n, 2, 3))

    def run(self) -> Clearance:
        n, level = len(self.apart), self.top
        self._look_where_balls_are_nearest()
        blocks = np.arange(-(-self.pieces >> level) if level else self.pieces)
        pair, block = (part.ravel() for part in np.meshgrid(np.arange(n), blocks, indexing="ij"))
        lower, looked, settled = self.best.copy(), n, True
        while True:
            check_time()
            looked += len(pair)
            bound, enough = self._bounds(pair, block, level)
            left = ~(bound >= enough[pair])
            last = level == -self.settings.halvings or looked + 2 * left.sum() > self.settings.most_intervals
            told = np.ones_like(left) if last else ~left
            np.minimum.at(lower, pair[told], bound[told])
            settled = not left.any()
            if settled or last:
                break
            level -= 1
            pair, block = np.tile(pair[left], 2), np.concatenate([2 * block[left], 2 * block[left] + 1])
            if level >= 0:
                inside = block << level < self.pieces
                pair, block = pair[inside], block[inside]
        found = self._found(np.minimum(lower, self.best))
        found.sort(key=lambda one: (-one.missed, one.distance - one.asked))
        reason = "" if settled else self._reason(pair[left], block[left], level)
        return Clearance(self.apart.name, tuple(found), settled, looked, reason, self.apart.assumed)

    def _reason(self, pair: np.ndarray, block: np.ndarray, level: int) -> str:
        """What is told of intervals that are left, where a motion that time prescribes is why."""
        begin, end = (self._fraction(block + k, level) * self.track.horizon for k in (0, 1))
        if self.track.prescribed is None:
            return ""
        stray, _ = self.track.prescribed.bounds(pair, begin, end)
        k = int(stray.argmax())
        if not stray[k] > self.settings.finest:
            return ""
        names = " and ".join(self.apart.labels[pair[k]])
        how = f"jumps by up to {stray[k]:.3g} m" if np.isfinite(stray[k]) else "has no bound"
        return f"the prescribed motion between {names} {how} at {begin[k]:.6g} s"

    def at(self, time: float) -> list[Nearest]:
        """Each pair at one time, s."""
        self.best[:] = np.inf
        self._look(np.full(len(self.apart), np.clip(time / self.track.horizon, 0.0, 1.0)))
        return self._found(self.best)

    def _found(self, least: np.ndarray) -> list[Nearest]:
        """What was found of each pair, with lower bounds of the distances."""
        rotations, positions = self.track.frames(self.when)
        each, seen = np.arange(len(self.apart)), self.apart.pairs[:, 2]
        points = np.einsum("nij,nkj->nki", rotations[each, seen], self.points) + positions[each, seen][:, None]
        return [
            Nearest(
                bodies,
                float(least[i]),
                float(self.best[i]),
                float(self.when[i] * self.track.horizon),
                points[i],
                float(self.apart.least[i]),
            )
            for i, bodies in enumerate(self.apart.labels)
        ]

    def _look_where_balls_are_nearest(self) -> None:
        """At each pair at the node, or middle of an interval, where the balls about its bodies are nearest."""
        times = np.union1d(self.breaks, (self.breaks[:-1] + self.breaks[1:]) / 2)
        times = times[:: -(-len(times) // self.settings.first_times)]
        n, frames = len(self.apart), self.track.frames(times)
        pair, at = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(len(times)), indexing="ij"))
        self._look(times[self.bodies.balls(frames, at, pair).reshape(n, -1).argmin(axis=1)])

    def _look(self, when: np.ndarray) -> None:
        """At each pair at one time (n,), a fraction of the horizon."""
        pair = np.arange(len(self.apart))
        _, gap, points = self.bodies.nearest(self.track.frames(when), pair, pair)
        self._keep(pair, gap, when, points)

    def _enough(self) -> np.ndarray:
        """Lower bounds of each pair's distance with which it is settled. Shape (n,), m.

        The least is known to a share of itself of the pair that is nearest to what is asked, or nearer; of others it is
        known that they are no nearer than that pair.
        """
        spare = self.best - self.apart.least
        least = max(float(spare.min()), 0.0)
        share, finest = self.settings.share, self.settings.finest
        missing = self.best - np.maximum(share * np.abs(spare), finest)
        return np.where(spare >= 0, self.apart.least + max(least - max(share * least, finest), 0.0), missing)

    def _bounds(self, pair: np.ndarray, block: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds of the distances of pairs in intervals of a level (K,), and what is enough of each pair's (n,).

        What the balls about two bodies do not settle is looked at in the middle. The least distances found are kept.
        """
        begin, end = self._fraction(block, level), self._fraction(block + 1, level)
        width = (end - begin) * self.track.horizon
        times, where = np.unique(np.concatenate([begin, (begin + end) / 2, end]), return_inverse=True)
        first, middle, last = np.split(where, 3)
        frames = self.track.frames(times)
        sway, bow = self._moves(pair, block, level, width)
        if self.track.prescribed is not None:
            more = self.track.prescribed.bounds(pair, begin * self.track.horizon, end * self.track.horizon)
            sway, bow = sway + more[0], bow + more[1]
        enough = self._enough()[pair]
        bound = self.bodies.balls(frames, middle, pair) - sway
        chosen = np.flatnonzero(bound < enough)
        if not chosen.size:
            return bound, self._enough()
        facing, gap, points = self.bodies.nearest(frames, middle[chosen], pair[chosen])
        self._keep(pair[chosen], gap, times[middle[chosen]], points)
        bound[chosen] = np.maximum(bound[chosen], gap - sway[chosen])
        near = (bound[chosen] < enough[chosen]) & np.isfinite(bow[chosen])
        chosen, facing = chosen[near], facing.of(near)
        if chosen.size:
            chord = self.bodies.chords(facing, frames, (first[chosen], last[chosen]))
            bound[chosen] = np.maximum(bound[chosen], chord - bow[chosen])
        return bound, self._enough()

    def _fraction(self, place: np.ndarray, level: int) -> np.ndarray:
        """Fractions of the horizon where the intervals of a level begin, by their numbers (K,)."""
        if level >= 0:
            return np.asarray(self.breaks[np.minimum(place << level, self.pieces)])
        piece = place >> -level
        share = (place - (piece << -level)) * 2.0**level
        left, right = self.breaks[piece], self.breaks[np.minimum(piece + 1, self.pieces)]
        return np.asarray(left + share * (right - left))

    def _moves(
        self, pair: np.ndarray, block: np.ndarray, level: int, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """By how much pairs may come nearer than in the middle of intervals (s wide), and than a chord. (K,), m."""
        apart = self.apart
        rates, seconds = self.fastest[max(level, 0)]
        piece = block >> max(-level, 0)
        levers = apart.levers[pair]
        moves = (rates[piece] * levers).sum(axis=1)
        turns = (rates[piece] * apart.turns[pair]).sum(axis=1)
        with np.errstate(invalid="ignore"):  # nothing that moves a pair, times no bound
            bends = np.where(levers > 0, seconds[piece] * levers, 0.0).sum(axis=1)
        return moves * width / 2, (bends + 2 * turns * moves) * width**2 / 8

    def _keep(self, pair: np.ndarray, distance: np.ndarray, at: np.ndarray, points: np.ndarray) -> None:
        """Keep what is nearer than what was found before."""
        order = np.lexsort((distance, pair))
        first = order[np.unique(pair[order], return_index=True)[1]]
        first = first[distance[first] < self.best[pair[first]]]
        i = pair[first]
        self.best[i], self.when[i], self.points[i] = distance[first], at[first], points[first]


def _of_two(values: np.ndarray) -> np.ndarray:
    """The larger of each two rows, the last by itself where they are odd. (N, k) to (ceil(N / 2), k)."""
    even = np.concatenate([values, values[-1:]]) if len(values) % 2 else values
    return np.asarray(np.maximum(even[::2], even[1::2]))


def _fastest(curve: PiecewisePolynomial, columns: list[int], horizon: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the first and the second derivatives in time of states in every piece of a curve. Shapes (N, k).

    Of a polynomial on an interval its Bernstein coefficients are bounds.
    """
    first = curve.derivative()
    found = []
    for one in (first, first.derivative()):
        degree = len(one.nodes) - 1
        basis = np.array([comb(degree, i) * one.nodes**i * (1 - one.nodes) ** (degree - i) for i in range(degree + 1)])
        coefficients = np.einsum("ij,kjn->kin", np.linalg.inv(basis.T), one.values[:, :, columns])
        found.append(np.abs(coefficients).max(axis=1))
    return found[0] / horizon, found[1] / horizon**2
