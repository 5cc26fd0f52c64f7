"""Verified clearance: lower bounds of the distances between bodies at all times of a motion, also between samples.

For a fixed direction n the gap between two convex hulls is the smallest gap between their points, and the curvature of
each point's gap over time is bounded by the acceleration of the point (:mod:`ocp.problem.hulls`). On an interval
of length h the gap is therefore at least

    min(gap at the start, gap at the end) - h^2 / 8 acceleration,

and the distance is at least the gap. The direction n is that of the closest points at the middle of the interval. A
mesh that several hulls cover is treated pair by pair, and the smallest distance counts. An interval that the bound
leaves undetermined is halved. The polynomials of the plan bound the rates of its states. Motion prescribed as a
function of time is bounded over each whole interval, kinks and jumps included (:mod:`ocp.problem.enclosures`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import comb
from typing import NamedTuple

import numpy as np

from ocp.console import check_time
from ocp.curves import PiecewisePolynomial
from ocp.problem.enclosures import PrescribedMotion
from ocp.problem.formulation import Formulation
from ocp.problem.hulls import BodyPairs, Frames, Separation, frames_of
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.solution_data import check_variables_match, match_order

MAX_PRINTED = 4
"""Largest number of pairs that a text lists as left out of the proof by assumption; `Clearance.assumed` has all."""


@dataclass(frozen=True)
class ProofSettings:
    """Settings of the bisection of time intervals that bounds the distances between bodies.

    Attributes:
        share: Relative accuracy of the difference between the smallest and the required distance.
        finest: Absolute accuracy of a distance, m, where that difference is smaller.
        halvings: Largest number of halvings of a mesh interval: 1 s becomes 15 ns.
        most_intervals: Largest number of intervals, of all pairs, that are bounded. The remaining ones are not proven.
        first_blocks: Largest number of intervals in the first pass. Finer meshes are combined in blocks.
        first_times: Largest number of times at which bounding balls are compared in the first pass.
    """

    share: float = 0.02
    finest: float = 1e-6
    halvings: int = 26
    most_intervals: int = 400_000
    first_blocks: int = 128
    first_times: int = 512


@dataclass(frozen=True)
class ClosestPair:
    """The closest approach of two bodies during a motion.

    Attributes:
        bodies: Names of the two bodies.
        least: Lower bound of their distance at all times, m; negative if they overlap.
        distance: Smallest distance computed at a time, m.
        time: That time, s.
        points: Closest points of the two hull cores (hulls without their radius) then, in world. Shape (2, 3), m.
        required: Required distance, m.
    """

    bodies: tuple[str, str]
    least: float
    distance: float
    time: float
    points: np.ndarray
    required: float

    @property
    def missed(self) -> float:
        """Largest possible shortfall of the distance below the required distance, m."""
        return max(self.required - self.least, 0.0)

    def __str__(self) -> str:
        first, second = self.bodies
        distance = f"{self.distance:.4g} m apart" if self.distance >= 0 else f"overlap by {-self.distance:.4g} m"
        return f"{first} and {second} {'are ' if self.distance >= 0 else ''}{distance} at {self.time:.4g} s"


class Track(NamedTuple):
    """Motion of the frames that carry the bodies, and bounds of the rates of the states that move the frames.

    Attributes:
        breaks: Ends of the N polynomial segments, as fractions of the horizon from 0 to 1. Shape (N + 1,).
        horizon: Duration, s.
        rates, seconds: Bounds of the absolute first and second time derivatives of the states that move the bodies, for
            each segment. Shape (N, k).
        smooth: Whether the rates are continuous from segment to segment.
        frames: Function from fractions (M,) to the frames there.
        prescribed: Motion that depends on time alone, or None.
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
    """Result of a proof of clearance: bounds of the distances between the bodies of each pair along a motion.

    Attributes:
        name: Name of the separation.
        pairs: Closest approach of each pair. Pairs that violate the required distance, or may, come first, the worst
            one first. The others follow by their margin. The bound of the first pair is tight; those of the others only
            show that they are no closer to their required distance.
        settled: Whether the proof is conclusive for every pair.
        n_intervals: Number of intervals of pairs that were checked.
        reason: Why the proof is inconclusive, if a prescribed motion jumps or has no bound; else empty.
        assumed: Pairs of bodies that the separation leaves out by assumption, with the reason.
    """

    name: str
    pairs: tuple[ClosestPair, ...]
    settled: bool
    n_intervals: int
    reason: str = ""
    assumed: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Clearance of {len(self.pairs)} pairs of bodies: {self}>"

    @property
    def worst(self) -> ClosestPair | None:
        """Pair whose distance has the smallest margin over the required distance; None if there are no pairs."""
        return self.pairs[0] if self.pairs else None

    def __str__(self) -> str:
        if self.worst is None:
            return "; ".join(["no pairs", *self._assumptions])
        verdict = "proven" if not self.worst.missed else "violated" if self.settled else "not proven"
        parts = [verdict, f"least {self.worst}", *([self.reason] if self.reason else []), *self._assumptions]
        return "; ".join(parts)

    @property
    def _assumptions(self) -> list[str]:
        """List with one text about pairs of bodies that are left out by assumption; empty without such pairs."""
        first = [f"{pair} ({why})" for pair, why in list(self.assumed.items())[:MAX_PRINTED]]
        more = [f"{len(self.assumed) - MAX_PRINTED} more"] if len(self.assumed) > MAX_PRINTED else []
        return [f"left out by assumption: {', '.join([*first, *more])}"] if first else []


def clearance(form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> Clearance:
    """Compute a lower bound, valid at all times, of the distance between the bodies of each pair along a plan.

    The states of the plan are in the order of the problem, and `p` (np,) are its parameters.
    """
    return clearance_along(apart, _track_of(form, apart, solution, p) if len(apart) else None)


def clearance_of_pairs(problem: Problem, solution: Solution, name: str, pairs: Sequence[int]) -> Clearance:
    """Return the `clearance` of body pairs, given by their indices in the separation constraint `name` of a problem.

    The bound of the closest pair is tight. Raises ProblemError if the plan does not belong to the problem.
    """
    form = Formulation.of(problem)
    check_variables_match(form, solution)
    p = form.parameter_vector(solution.parameters)
    return clearance(form, problem.declared.apart[name].of(pairs), match_order(form, solution), p)


def clearance_along(apart: Separation, track: Track | None, settings: ProofSettings = ProofSettings()) -> Clearance:
    """Compute a lower bound, valid at all times, of the distance between the bodies of each pair on moving frames.

    ``track`` may be None if there are no pairs.
    """
    if not len(apart) or track is None:
        return Clearance(apart.name, (), True, 0, assumed=apart.assumed)
    return _Search(apart, track, settings).run()


def closest_pairs_along(
    problem: Problem, solution: Solution, times: Iterable[float], suffix: str = ""
) -> list[ClosestPair]:
    """Return the closest pair of bodies at each time (s) of a plan; empty if the problem has no separation constraints.

    Args:
        suffix: Suffix of the names of the states that move the bodies: selects one part of a plan whose parts are
            stacked as separate states.

    Raises:
        ProblemError: The plan does not belong to the problem.
    """
    searches = [_Search(apart, track) for apart, track in _tracks(problem, solution, suffix)]
    if not searches:
        return []
    return [
        min((pair for search in searches for pair in search.at(time)), key=lambda pair: pair.distance) for time in times
    ]


def separation_frames(
    problem: Problem, solution: Solution, times: np.ndarray, suffix: str = ""
) -> list[tuple[Separation, Frames]]:
    """Return each separation constraint of a problem with the poses of its body frames at K times, s.

    See `closest_pairs_along` for `suffix` and the error that is raised.
    """
    fractions = times / solution.horizon
    return [(apart, track.frames(fractions)) for apart, track in _tracks(problem, solution, suffix)]


def _tracks(problem: Problem, solution: Solution, suffix: str) -> list[tuple[Separation, Track]]:
    """Return the separation constraints of one part of a plan, each with the motion of its bodies.

    The states of the part have names that end with `suffix`. Constraints without pairs of bodies are left out.
    """
    form = Formulation.of(problem)
    check_variables_match(form, solution)
    solution, p = match_order(form, solution), form.parameter_vector(solution.parameters)
    moving = [each for each in problem.declared.apart.values() if all(name.endswith(suffix) for name in each.movers)]
    return [(each, _track_of(form, each, solution, p)) for each in moving if len(each)]


def _track_of(form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> Track:
    """Return the motion of the bodies of a separation constraint along a plan."""
    columns = [k for name in apart.movers for k in range(*form.states[name].indices(form.nx))]
    curve, horizon = solution.state_interpolant, solution.horizon
    outputs, kept = [form.separations[apart.name]], ("placements", apart.name)

    def frames(at: np.ndarray) -> Frames:
        controls = np.zeros((len(at), form.nu))
        return frames_of(form.sampled(outputs, curve(at), controls, at * horizon, horizon, p, cache_as=kept)[0])

    prescribed = PrescribedMotion(apart, form.separations[apart.name], form.t, parameters=[form.p], values=[p])
    return Track(curve.breaks, horizon, *_rate_bounds(curve, columns, horizon), False, frames, prescribed)


class _Search:
    """Bisection of time intervals until the distance of every pair of bodies is bounded accurately enough.

    At level l >= 0 an interval is a block of 2^l segments; at level l < 0 it is the share 2^l of one segment. The
    interval ``index`` begins at segment index 2^l and ends at (index + 1) 2^l.
    """

    def __init__(self, apart: Separation, track: Track, settings: ProofSettings = ProofSettings()) -> None:
        self.settings = settings
        self.apart, self.track = apart, track
        self.breaks, self.pieces = track.breaks, len(track.breaks) - 1
        self.top = max(0, int(np.ceil(np.log2(self.pieces / self.settings.first_blocks))))
        self.fastest = [(track.rates, track.seconds)]
        for level in range(self.top):
            pairs = np.arange(0, len(self.fastest[level][0]), 2)
            rates, seconds = (np.maximum.reduceat(values, pairs) for values in self.fastest[level])
            self.fastest.append((rates, seconds if track.smooth else np.full_like(seconds, np.inf)))
        self.bodies = BodyPairs(apart.bodies, apart.pairs, apart.covers)
        n = len(apart)
        self.best, self.when, self.points = np.full(n, np.inf), np.zeros(n), np.zeros((n, 2, 3))

    def run(self) -> Clearance:
        """Halve time intervals until the distance bounds of all pairs suffice, or a limit of the search is reached."""
        n, level = len(self.apart), self.top
        self._evaluate_at_closest_balls()
        blocks = np.arange(-(-self.pieces >> level) if level else self.pieces)
        pair, block = (part.ravel() for part in np.meshgrid(np.arange(n), blocks, indexing="ij"))
        lower, checked, settled = self.best.copy(), n, True
        while True:
            check_time()
            checked += len(pair)
            bound, sufficient = self._bounds(pair, block, level)
            undecided = ~(bound >= sufficient[pair])
            last = level == -self.settings.halvings or checked + 2 * undecided.sum() > self.settings.most_intervals
            final = np.ones_like(undecided) if last else ~undecided
            np.minimum.at(lower, pair[final], bound[final])
            settled = not undecided.any()
            if settled or last:
                break
            level -= 1
            pair, block = np.tile(pair[undecided], 2), np.concatenate([2 * block[undecided], 2 * block[undecided] + 1])
            if level >= 0:
                inside = block << level < self.pieces
                pair, block = pair[inside], block[inside]
        closest = self._closest(np.minimum(lower, self.best))
        closest.sort(key=lambda pair: (-pair.missed, pair.distance - pair.required))
        reason = "" if settled else self._reason(pair[undecided], block[undecided], level)
        return Clearance(self.apart.name, tuple(closest), settled, checked, reason, self.apart.assumed)

    def _reason(self, pair: np.ndarray, block: np.ndarray, level: int) -> str:
        """Return why a jump of a prescribed motion prevents a proof of clearance; "" if no jump is too large."""
        if self.track.prescribed is None:
            return ""
        begin, end = (self._fraction(block + k, level) * self.track.horizon for k in (0, 1))
        jump, _ = self.track.prescribed.bounds(pair, begin, end)
        k = int(jump.argmax())
        if not jump[k] > self.settings.finest:
            return ""
        names = " and ".join(self.apart.labels[pair[k]])
        cause = f"jumps by up to {jump[k]:.3g} m" if np.isfinite(jump[k]) else "has no bound"
        return f"the prescribed motion between {names} {cause} at {begin[k]:.6g} s"

    def at(self, time: float) -> list[ClosestPair]:
        """Return the distance and the closest points of every pair of bodies at one time of a plan, s."""
        self.best[:] = np.inf
        self._evaluate(np.full(len(self.apart), np.clip(time / self.track.horizon, 0.0, 1.0)))
        return self._closest(self.best)

    def _closest(self, bounds: np.ndarray) -> list[ClosestPair]:
        """Return the closest approach of each pair found so far, with given lower bounds (n,) of the distances, m."""
        rotations, positions = self.track.frames(self.when)
        each, frame = np.arange(len(self.apart)), self.apart.pairs[:, 2]
        points = np.einsum("nij,nkj->nki", rotations[each, frame], self.points) + positions[each, frame][:, None]
        numbers = (part.tolist() for part in (bounds, self.best, self.when * self.track.horizon))
        rows = zip(self.apart.labels, *numbers, points, self.apart.least.tolist(), strict=True)
        return [ClosestPair(*row) for row in rows]

    def _evaluate_at_closest_balls(self) -> None:
        """Compute the distance of each pair at the node or interval midpoint where its bounding balls are closest."""
        times = np.union1d(self.breaks, (self.breaks[:-1] + self.breaks[1:]) / 2)
        times = times[:: -(-len(times) // self.settings.first_times)]
        n, frames = len(self.apart), self.track.frames(times)
        pair, at = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(len(times)), indexing="ij"))
        self._evaluate(times[self.bodies.balls(frames, at, pair).reshape(n, -1).argmin(axis=1)])

    def _evaluate(self, when: np.ndarray) -> None:
        """Compute the distance of each pair at its own time, which ``when`` (n,) gives as a fraction of the horizon."""
        pair = np.arange(len(self.apart))
        _, gap, points = self.bodies.nearest(self.track.frames(when), pair, pair)
        self._store_smallest(pair, gap, when, points)

    def _sufficient_bounds(self) -> np.ndarray:
        """Return for each pair the lower distance bound that suffices to stop halving its intervals. Shape (n,), m.

        The pair with the smallest margin is resolved to a relative accuracy. For all other pairs it suffices that their
        margins are at least as large.
        """
        margin = self.best - self.apart.least
        smallest = max(float(margin.min()), 0.0)
        share, finest = self.settings.share, self.settings.finest
        reduced = self.best - np.maximum(share * np.abs(margin), finest)
        return np.where(margin >= 0, self.apart.least + max(smallest - max(share * smallest, finest), 0.0), reduced)

    def _bounds(self, pair: np.ndarray, block: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Return lower distance bounds, m, in K time intervals, and the bound at which each pair's bisection ends.

        Pairs that the bounding balls leave undecided are evaluated at the middle of the interval. The smallest
        distances are stored.
        """
        begin, end = self._fraction(block, level), self._fraction(block + 1, level)
        width = (end - begin) * self.track.horizon
        times, index = np.unique(np.concatenate([begin, (begin + end) / 2, end]), return_inverse=True)
        first, middle, last = np.split(index, 3)
        frames = self.track.frames(times)
        sway, bow = self._largest_falls(pair, block, level, width)
        if self.track.prescribed is not None:
            more = self.track.prescribed.bounds(pair, begin * self.track.horizon, end * self.track.horizon)
            sway, bow = sway + more[0], bow + more[1]
        sufficient = self._sufficient_bounds()[pair]
        bound = self.bodies.balls(frames, middle, pair) - sway
        close = np.flatnonzero(bound < sufficient)
        if not close.size:
            return bound, self._sufficient_bounds()
        facing, gap, points = self.bodies.nearest(frames, middle[close], pair[close])
        self._store_smallest(pair[close], gap, times[middle[close]], points)
        bound[close] = np.maximum(bound[close], gap - sway[close])
        candidate = (bound[close] < sufficient[close]) & np.isfinite(bow[close])
        close, facing = close[candidate], facing.of(candidate)
        if close.size:
            chord = self.bodies.chords(facing, frames, (first[close], last[close]))
            bound[close] = np.maximum(bound[close], chord - bow[close])
        return bound, self._sufficient_bounds()

    def _fraction(self, place: np.ndarray, level: int) -> np.ndarray:
        """Convert index and bisection level of time intervals to their start times as fractions of the horizon."""
        if level >= 0:
            return np.asarray(self.breaks[np.minimum(place << level, self.pieces)])
        segment = place >> -level
        share = (place - (segment << -level)) * 2.0**level
        left, right = self.breaks[segment], self.breaks[np.minimum(segment + 1, self.pieces)]
        return np.asarray(left + share * (right - left))

    def _largest_falls(
        self, pair: np.ndarray, block: np.ndarray, level: int, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the distances of pairs can fall below their values in the middle of time intervals, m.

        Also return how far they can fall below the chord between their values at both ends. Shape (K,) each.
        """
        apart = self.apart
        rates, seconds = self.fastest[max(level, 0)]
        segment = block >> max(-level, 0)
        levers = apart.levers[pair]
        moves = (rates[segment] * levers).sum(axis=1)
        turns = (rates[segment] * apart.turns[pair]).sum(axis=1)
        with np.errstate(invalid="ignore"):  # 0 times inf: a state that does not move the pair, without a bound
            bends = np.where(levers > 0, seconds[segment] * levers, 0.0).sum(axis=1)
        return moves * width / 2, (bends + 2 * turns * moves) * width**2 / 8

    def _store_smallest(self, pair: np.ndarray, distance: np.ndarray, at: np.ndarray, points: np.ndarray) -> None:
        """Store the smallest distance found so far for each pair, with its time and closest points."""
        order = np.lexsort((distance, pair))
        first = order[np.unique(pair[order], return_index=True)[1]]
        first = first[distance[first] < self.best[pair[first]]]
        i = pair[first]
        self.best[i], self.when[i], self.points[i] = distance[first], at[first], points[first]


def _rate_bounds(curve: PiecewisePolynomial, columns: list[int], horizon: float) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of the absolute first and second time derivatives of states on each curve segment. Shapes (N, k).

    The Bernstein coefficients of a polynomial bound it on its interval.
    """
    first = curve.derivative()
    bounds = []
    for rate in (first, first.derivative()):
        degree = len(rate.nodes) - 1
        s, indices = rate.nodes, range(degree + 1)
        basis = np.array([comb(degree, i) * s**i * (1 - s) ** (degree - i) for i in indices])
        coefficients = np.einsum("ij,kjn->kin", np.linalg.inv(basis.T), rate.values[:, :, columns])
        bounds.append(np.abs(coefficients).max(axis=1))
    return bounds[0] / horizon, bounds[1] / horizon**2
