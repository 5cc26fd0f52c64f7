"""Proof that bodies stay apart at every time, between the samples of a plan too.

For a fixed direction n the gap of two hulls is the least of the gaps of their points, each of which bends over time by
no more than the points' acceleration (:mod:`ocp.problem.separation`). Between two times h apart it is hence at least

    min(gap at the one, gap at the other) - h^2 / 8 acceleration,

and the distance is no less than the gap. The direction is that in which the bodies are nearest in the middle. Where the
bound does not settle it, the time between is halved. The plan's own polynomials say how fast its states change.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from ocp.console import check_time
from ocp.curves import PiecewisePolynomial
from ocp.problem.formulation import Formulation
from ocp.problem.hulls import Frames, frames_of, gap_along, grouped, nearest_directions
from ocp.problem.problem import Problem
from ocp.problem.separation import Separation
from ocp.solution import Solution, check_belongs, in_order_of

__all__ = ["Clearance", "Nearest", "clearance", "nearest_at"]

SETTLED = 0.02
"""Of the least distance: it is known to so much where that is more than is asked."""
SHORT = 1e-6
"""m: a distance is known to so much where less is asked."""
HALVINGS = 26
"""Of an interval of the mesh."""
MOST = 400_000
"""Intervals of pairs looked at, beyond which what is left is not proven."""


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


@dataclass(frozen=True)
class Clearance:
    """What was proven of a separation.

    Attributes:
        name: Of the separation.
        pairs: How near each pair comes, the nearest to what is allowed first.
        settled: Whether every pair's least distance was told from what is asked, one way or the other.
        looked: Number of intervals of pairs that were looked at.
    """

    name: str
    pairs: tuple[Nearest, ...]
    settled: bool
    looked: int

    @property
    def worst(self) -> Nearest | None:
        """The pair that comes nearest to what it is allowed, or is beyond it; None where there are no pairs."""
        return self.pairs[0] if self.pairs else None

    def __str__(self) -> str:
        if self.worst is None:
            return "no pairs"
        verdict = "proven" if not self.worst.missed else "violated" if self.settled else "not proven"
        return f"{verdict}; least {self.worst}"


def clearance(form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> Clearance:
    """How near each pair of bodies comes along a plan, at any time.

    Args:
        form: Of the problem. apart: A separation of it. solution: The plan, its states in the order of the problem.
        p: Parameters. Shape (np,).
    """
    if not len(apart):
        return Clearance(apart.name, (), True, 0)
    return _Search(form, apart, solution, p).run()


def nearest_at(problem: Problem, solution: Solution, time: float) -> Nearest | None:
    """The two bodies of a plan that are nearest to each other at a time (s); None where none have to stay apart.

    Raises:
        ProblemError: The plan does not belong to the problem.
    """
    form = Formulation.of(problem)
    check_belongs(form, solution)
    solution, p = in_order_of(form, solution), form.parameter_vector(solution.parameters)
    found = [near for apart in problem.declared.apart.values() for near in _Search(form, apart, solution, p).at(time)]
    return min(found, key=lambda near: near.distance, default=None)


class _Search:
    """The halving of intervals of pairs until each is settled."""

    def __init__(self, form: Formulation, apart: Separation, solution: Solution, p: np.ndarray) -> None:
        self.form, self.apart, self.solution, self.p = form, apart, solution, p
        self.breaks = solution.state_interpolant.breaks
        columns = [k for name in apart.movers for k in range(*form.states[name].indices(form.nx))]
        rates, seconds = _fastest(solution.state_interpolant, columns, solution.horizon)
        moves = rates @ apart.levers.T
        self.speeds = moves + apart.speed
        bends = seconds @ apart.levers.T + 2 * (rates @ apart.turns.T) * moves
        self.accelerations = bends + apart.acceleration
        self.kinds = grouped(tuple(apart.hulls.values()), apart.pairs)
        n = len(apart)
        self.best, self.when, self.points = np.full(n, np.inf), np.zeros(n), np.zeros((n, 2, 3))
        self.lower, self.ball, self.ball_at = np.full(n, np.inf), np.full(n, np.inf), np.zeros(n)

    def run(self) -> Clearance:
        n, nodes = len(self.apart), len(self.breaks)
        pair, node = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(nodes), indexing="ij"))
        self._bounds(pair, np.minimum(node, nodes - 2), self.breaks[node], self.breaks[node])
        looked, settled = len(pair), True
        pair, piece = (part.ravel() for part in np.meshgrid(np.arange(n), np.arange(nodes - 1), indexing="ij"))
        begin, end = self.breaks[piece], self.breaks[piece + 1]
        for halvings in range(HALVINGS + 1):
            check_time()
            looked += len(pair)
            bound, far = self._bounds(pair, piece, begin, end)
            asked, known = self.apart.least, np.maximum(SETTLED * np.abs(self.best - self.apart.least), SHORT)
            enough = np.where(self.best >= asked, np.maximum(asked, self.best - known), self.best - known)
            left = (bound < enough[pair]) & ~far
            last = halvings == HALVINGS or looked + 2 * left.sum() > MOST
            told = np.ones_like(left) if last else ~left
            np.minimum.at(self.lower, pair[told], bound[told])
            settled = not left.any()
            if settled or last:
                break
            pair, piece, begin, end = (part[left] for part in (pair, piece, begin, end))
            middle = (begin + end) / 2
            pair, piece = np.tile(pair, 2), np.tile(piece, 2)
            begin, end = np.concatenate([begin, middle]), np.concatenate([middle, end])
        return Clearance(
            self.apart.name, tuple(sorted(self._found(), key=lambda one: one.least - one.asked)), settled, looked
        )

    def at(self, time: float) -> list[Nearest]:
        """Each pair at one time, s."""
        pair = np.arange(len(self.apart))
        now = np.full(len(pair), np.clip(time / self.solution.horizon, 0.0, 1.0))
        self._bounds(pair, np.zeros(len(pair), dtype=int), now, now)
        return self._found()

    def _found(self) -> list[Nearest]:
        """What was found of each pair."""
        self._look_at_the_far()
        rotations, positions = self._frames(self.when)
        each, seen = np.arange(len(self.apart)), self.apart.pairs[:, 2]
        points = np.einsum("nij,nkj->nki", rotations[each, seen], self.points) + positions[each, seen][:, None]
        return [
            Nearest(
                bodies,
                float(min(self.lower[i], self.best[i])),
                float(self.best[i]),
                float(self.when[i] * self.solution.horizon),
                points[i],
                float(self.apart.least[i]),
            )
            for i, bodies in enumerate(self.apart.labels)
        ]

    def _bounds(
        self, pair: np.ndarray, piece: np.ndarray, begin: np.ndarray, end: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds of the distances of pairs between two times, and whether they are far. Shape (K,) each.

        Bodies that are farther apart than they are large are far enough to be told by their balls. Of others the least
        distances found are kept.
        """
        width = (end - begin) * self.solution.horizon
        times, where = np.unique(np.concatenate([begin, (begin + end) / 2, end]), return_inverse=True)
        first, middle, last = np.split(where, 3)
        frames = self._frames(times)
        sway, bow = self.speeds[piece, pair] * width / 2, self.accelerations[piece, pair] * width**2 / 8
        bound, is_far = np.full(len(pair), -np.inf), np.zeros(len(pair), dtype=bool)
        for kind in self.kinds:
            chosen = np.flatnonzero(kind.has[pair])
            row = kind.row[pair[chosen]]
            sides = kind.points(frames, middle[chosen], row)
            centres = [part.mean(axis=1) for part in sides]
            apart = np.linalg.norm(centres[1] - centres[0], axis=1)
            sizes = kind.sizes[row]
            ball = apart - sizes - kind.radii[row]
            bound[chosen] = np.where(kind.flat[row], -np.inf, ball - sway[chosen])
            is_far[chosen] = far = bound[chosen] > self.apart.least[pair[chosen]] + sizes + kind.radii[row]
            nearer = far & (ball < self.ball[pair[chosen]])
            self.ball[pair[chosen[nearer]]] = ball[nearer]
            self.ball_at[pair[chosen[nearer]]] = times[middle[chosen[nearer]]]
            chosen, row, sides = chosen[~far], row[~far], [part[~far] for part in sides]
            if not chosen.size:
                continue
            along, here, there = nearest_directions(*sides)
            along = np.where(kind.flat[row, None], kind.normals[row], along)
            gap = gap_along(along, *sides) - kind.radii[row]
            chord = np.minimum(
                *(gap_along(along, *kind.points(frames, at[chosen], row)) - kind.radii[row] for at in (first, last))
            )
            bound[chosen] = np.maximum(bound[chosen], np.maximum(chord - bow[chosen], gap - sway[chosen]))
            self._keep(pair[chosen], gap, times[middle[chosen]], np.stack([here, there], axis=1))
        return bound, is_far

    def _look_at_the_far(self) -> None:
        """What is never near is looked at once, where its balls are nearest."""
        pair = np.flatnonzero(np.isinf(self.best))
        if not pair.size:
            return
        frames = self._frames(self.ball_at[pair])
        for kind in self.kinds:
            place = np.flatnonzero(kind.has[pair])
            row = kind.row[pair[place]]
            sides = kind.points(frames, place, row)
            along, here, there = nearest_directions(*sides)
            gap = gap_along(along, *sides) - kind.radii[row]
            self._keep(pair[place], gap, self.ball_at[pair[place]], np.stack([here, there], axis=1))

    def _keep(self, pair: np.ndarray, distance: np.ndarray, at: np.ndarray, points: np.ndarray) -> None:
        """Keep what is nearer than what was found before."""
        order = np.lexsort((distance, pair))
        first = order[np.unique(pair[order], return_index=True)[1]]
        first = first[distance[first] < self.best[pair[first]]]
        i = pair[first]
        self.best[i], self.when[i], self.points[i] = distance[first], at[first], points[first]

    def _frames(self, at: np.ndarray) -> Frames:
        """At fractions (M,) of the horizon."""
        form, horizon = self.form, self.solution.horizon
        states, controls = self.solution.state_interpolant(at), np.zeros((len(at), form.nu))
        outputs, kept = [form.apart[self.apart.name]], ("placements", self.apart.name)
        return frames_of(form.sampled(outputs, states, controls, at * horizon, horizon, self.p, kept=kept)[0])


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
