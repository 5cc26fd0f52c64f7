"""The least that a motion costs from each posture on: dynamic programming over charts, with values that are bounds.

Between two instants a motion costs at least what the straight step costs: the integral of half the squared rates no
less than |dq|^2 / (2 dt), the length no less than |dq|_1. So the least cost over all sequences of postures, one of each
instant, bounds that of every motion that does the task, and it is found backwards, w_k(q) = min over q' of
d(q, q') + w_{k+1}(q'). A value on a chart is a quadratic function of the place in its box that lies nowhere above:
every step gives one for each corner by its multipliers, all curved nearly alike; less the curvature of the cheapest
they are affine, the least of these is concave, and an affine function below a concave one at the corners of a box is
below it everywhere. What is lost is of third order in the size of the charts for squares, and of second for lengths,
whose values are affine.

A way through sets of postures drawn tight: the cheapest of those beside it, nearer and nearer.

At every instant some postures are taken on either side of the way, and dynamic programming finds the cheapest way
through these; where it does not run along their edge any more, they come nearer to each other. What is not allowed is
dear, so that a way comes out of it where it can. A way that stays is the cheapest of all beside it, whatever kinks
its cost has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import CollisionScene
from models.arrays import Array
from ocp.motion.local.collisions import distances_along
from ocp.motion.search.charts import Charts, TimeSample
from ocp.motion.search.joint_space import MAX_STEP, JointSpace
from ocp.motion.search.steps import CurvedCharts, QuadraticBounds, StepBounds, StepCost
from ocp.tolerances import CLEARANCE_TOLERANCE_M

__all__ = ["PENALTY", "ChartGraph", "GraphSettings", "ShorteningSettings", "shorten_path"]

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class GraphSettings:
    """How closely steps are looked at.

    Attributes:
        onward: Charts that are tried to go on to from a posture.
        pairs: Places near enough for a step between two instants that are looked at together, about, by memory.
        sample: Charts by which it is estimated how many there are.
        nearer, lower: Times that the least of a step in a box is looked at nearer, and places on the way to it each
            time: with fewer the least is told too low, and charts are halved that could be left out.
    """

    onward: int = 8
    pairs: int = 200_000
    sample: int = 64
    nearer: int = 2
    lower: int = 3


class ChartGraph:
    """The charts of all instants, and the steps between them that a motion may take."""

    def __init__(
        self,
        space: JointSpace,
        layers: list[Charts],
        seconds: Array,
        cost: StepCost,
        limits: Array,
        most: Array,
        settings: GraphSettings = GraphSettings(),
    ) -> None:
        """
        Args:
            space: Where the charts lie.
            layers: Charts of each instant.
            seconds: From each instant to the next. Shape (K - 1,).
            cost: Of a step.
            limits: How far the joints may go from each instant to the next. Shape (K - 1, n).
            most: What the step from each instant to the next may cost. Shape (K - 1,).
            settings: How closely steps are looked at.
        """
        self.space, self.layers, self.seconds, self.cost, self.limits = space, layers, seconds, cost, limits
        self.most, self.settings = most, settings

    @cached_property
    def sheets(self) -> list[CurvedCharts]:
        """Charts of each instant, and how the set bends away from them."""
        return [CurvedCharts(charts, *charts.bent()) for charts in self.layers]

    def cost_to_go(self, passed: list[QuadraticBounds] | None = None, most: float = np.inf) -> list[QuadraticBounds]:
        """Bounds of what is to come from each instant, of motions that cost less than `most` with what has `passed`."""
        return self._swept(range(len(self.layers) - 1, -1, -1), -1, passed, most)

    def passed(self, cost_to_go: list[QuadraticBounds] | None = None, most: float = np.inf) -> list[QuadraticBounds]:
        """Bounds of what has been until each instant, of motions that cost less than `most` with what is `cost_to_go`."""
        return self._swept(range(len(self.layers)), 1, cost_to_go, most)

    def alive(self) -> list[NDArray[np.bool_]]:
        """Of the charts of each instant, which lie on a way from the first instant to the last. Shapes (N,)."""
        found = [np.ones(len(charts), dtype=bool) for charts in self.layers]
        last = len(found) - 1
        for order in (range(last), range(last, 0, -1)):
            for k in order:
                other = k + int(np.sign(order.step))
                led = np.zeros(len(found[other]), dtype=bool)
                for i, j in self.steps(k, other):
                    led[j[found[k][i]]] = True
                found[other] &= led
        return found

    def steps(self, k: int, other: int) -> Iterator[tuple[Indices, Indices]]:
        """Charts of an instant and of one beside it between which a motion may go, some at a time."""
        here, there = self.layers[k], self.layers[other]
        if not len(here) or not len(there):
            return
        between, spans = min(k, other), (here.spans, there.spans)
        sizes = [self.space.length(span) for span in spans]
        limit = self.limits[between]
        dearest = max(float(self.most[between]), 0.0)
        way = min(self.cost.farthest(dearest, float(self.seconds[between])), float(self.space.length(limit)))
        way = min(way, MAX_STEP)
        tree = self.space.tree(there.centers)
        some = self.space.tree(here.centers[:: max(len(here) // self.settings.sample, 1)])
        number = some.count_neighbors(tree, min(way + float(sizes[0].max() + sizes[1].max()), MAX_STEP)) / some.n
        share = max(16, int(self.settings.pairs / max(number, 1.0)))
        for first in range(0, len(here), share):
            part = np.arange(first, min(first + share, len(here)))
            own = self.space.tree(here.centers[part])
            found = own.sparse_distance_matrix(
                tree, way + float(sizes[0][part].max() + sizes[1].max()), output_type="ndarray"
            )
            i, j, far = part[found["i"]], found["j"].astype(np.intp), found["v"]
            near = far <= way + sizes[0][i] + sizes[1][j]
            i, j = i[near], j[near]
            delta = np.abs(self.space.difference(there.centers[j], here.centers[i]))
            near = (delta <= limit + spans[0][i] + spans[1][j]).all(axis=1)
            i, j = i[near], j[near]
            order = np.argsort(i, kind="stable")
            yield i[order], j[order]

    def nearest(self, joints: Array, k: int, other: int, after: QuadraticBounds) -> Iterator[tuple[Charts, Array]]:
        """Charts of an instant to go on to from a posture (n,) of another, the cheapest first, and where in them.

        Returns:
            Of each a chart alone, turned as the posture is, and the place in its box, (r,).
        """
        there = self.layers[other]
        between = min(k, other)
        seconds = float(self.seconds[between])
        delta = self.space.difference(there.centers, np.repeat(joints[None], len(there), axis=0))
        reached = (np.abs(delta) <= self.limits[between] + there.spans).all(axis=1) & np.isfinite(after.least)
        chosen = np.flatnonzero(reached)
        if not chosen.size:
            return
        into = there.of(chosen)
        costs, places = self.cost.cheapest(delta[chosen], into, after.of(chosen), seconds)
        for i in np.argsort(costs, kind="stable")[: self.settings.onward].tolist():
            yield replace(into.of([i]), centers=joints + delta[chosen[[i]]]), places[i]

    def _swept(
        self, order: range, direction: int, rest: list[QuadraticBounds] | None, most: float
    ) -> list[QuadraticBounds]:
        layers = self.layers
        found: list[Any] = [None] * len(layers)
        first = order[0]
        count, free = layers[first].low.shape
        found[first] = QuadraticBounds.constant(np.zeros(count), free)
        if rest is not None:
            dear = self.least(rest[first], first) >= most
            found[first] = QuadraticBounds.constant(np.where(dear, np.inf, 0.0), free)
        for k in order[1:]:
            found[k] = self._before(k, k - direction, found[k - direction], None if rest is None else rest[k], most)
        return found

    def _before(
        self, k: int, other: int, after: QuadraticBounds, rest: QuadraticBounds | None, most: float
    ) -> QuadraticBounds:
        """Bounds on the charts of an instant by those of the one that motions go on to.

        With what is known of the `rest` of the motions, those that cost `most` or more are left out.
        """
        here, there = self.layers[k], self.layers[other]
        seconds = float(self.seconds[min(k, other)])
        found = QuadraticBounds.constant(np.full(len(here), np.inf), here.low.shape[1])
        known = np.zeros(len(here)) if rest is None else self.least(rest, k)
        # steps that are nowhere the cheapest from their chart are left out: seen from far, then by their tangents
        here_spans, there_spans = here.spans, there.spans
        place = np.clip(0.0, there.low, there.high)
        lowest, middle = self.least(after, other), after.at(place)
        for i, j in self.steps(k, other):
            alive = np.isfinite(after.least[j]) & (known[i] + lowest[j] < most)
            i, j = i[alive], j[alive]
            if not i.size:
                continue
            delta = self.space.difference(there.centers[j], here.centers[i])
            way, span = np.abs(delta), here_spans[i] + there_spans[j]
            low = self.cost.of(np.maximum(way - span, 0.0), seconds) + lowest[j]
            high = self.cost.of(way + span, seconds) + middle[j]
            floor = np.full(len(here), np.inf)
            np.minimum.at(floor, i, low)
            near = (low <= _least_of_groups(high, i)) & (known[i] + low < most)
            i, j, delta = i[near], j[near], delta[near]
            steps = self.cost.below(delta, self.sheets[k].of(i), self.sheets[other].of(j), after.of(j), seconds)
            if rest is not None:
                cheap = np.flatnonzero(_whole(steps, here.of(i), rest.of(i)) < most)
                i, steps = i[cheap], steps.of(cheap)
            if not i.size:
                continue
            starts = np.flatnonzero(np.diff(i, prepend=-1))
            parts = _below_all(steps, here.of(i), starts, most - known[i[starts]], self.settings)
            parts = self._raised(parts, here.of(i[starts]), floor[i[starts]])
            for whole, part in zip(found, parts, strict=True):
                whole[i[starts]] = part
        return found

    @staticmethod
    def _raised(values: QuadraticBounds, charts: Charts, floor: Array) -> QuadraticBounds:
        """Values, or constants that are bounds, too, where these are higher in the middle and at the least together."""
        least = values.lowest(charts.low, charts.high)[0]
        flat = values.at((charts.low + charts.high) / 2) + least < 2 * floor
        return QuadraticBounds(
            np.where(flat, floor, values.least),
            np.where(flat[:, None], 0.0, values.slope),
            np.where(flat[:, None, None], 0.0, values.curve),
        )

    def least(self, values: QuadraticBounds, k: int) -> Array:
        """The least of values anywhere on the charts of an instant. Shape (N,)."""
        return values.lowest(self.layers[k].low, self.layers[k].high)[0]

    def through(self, passed: list[QuadraticBounds], cost_to_go: list[QuadraticBounds], k: int) -> Array:
        """Bounds of what motions cost that pass through the charts of an instant. Shape (N,)."""
        both = QuadraticBounds(*(one + other for one, other in zip(passed[k], cost_to_go[k], strict=True)))
        return np.where(np.isfinite(both.least), self.least(both, k), np.inf)


def _whole(steps: StepBounds, own: Charts, rest: QuadraticBounds) -> Array:
    """What steps from charts cost at least, with what is known of the rest. Shape (P,)."""
    middle, curve = (own.low + own.high) / 2, steps.curve
    both = _tangents(middle, steps.at(middle), curve, -rest.curve, -rest.slope)
    return rest.least + both.lowest(own.low, own.high)[0]


def _least_of_groups(values: Array, group: Indices) -> Array:
    """Of values whose groups are together, the least of the group, for each. Shape (P,)."""
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    return np.repeat(np.minimum.reduceat(values, starts), np.diff(np.append(starts, len(values))))


def _below_all(
    steps: StepBounds, own: Charts, starts: Indices, most: Array, settings: GraphSettings
) -> QuadraticBounds:
    """A bound for each chart that steps go from, whose steps are together and begin at `starts`.

    Above `most`, of shape (M,), it is of no use.
    """
    r = own.tangents.shape[2]
    count = np.diff(np.append(starts, len(own)))
    group = np.repeat(np.arange(len(starts)), count)
    middle, half = (own.low + own.high) / 2, (own.high - own.low) / 2
    places = [middle, *(middle + side * half * np.eye(r)[axis] for axis in range(r) for side in (-1.0, 1.0))]
    # less the curvature of the cheapest, and what the least of all bends down, they are affine, or nearly so
    touching, curves = [steps.at(place) for place in places], steps.curve
    curve = curves[np.lexsort((touching[0][0], group))[starts]].copy()
    heights = np.minimum.reduceat(np.stack([value for value, _ in touching]), starts, axis=1)
    heights = np.minimum(heights, most)
    curve += _sunk(heights - _pressed_all(curve, places, starts), half[starts], curve)
    common = curve[group]
    values = np.stack([value - _pressed(common, place) for (value, _), place in zip(touching, places, strict=True)])
    slope = _rise([*(heights - _pressed_all(curve, places, starts))], half[starts])
    # how far above the linear functions the steps lie: by tangents at places where they are low
    lean, rows = slope[group], np.arange(len(own))
    seen = values - np.stack([(place * lean).sum(axis=1) for place in places])
    room, at = np.minimum.reduceat(seen.min(axis=0), starts)[group], seen.argmin(axis=0)
    lowest, value, rise = (np.stack(parts)[at, rows] for parts in (places, *zip(*touching, strict=True)))
    best = _tangents(lowest, (value, rise), curves, common, lean)
    least = best.lowest(own.low, own.high)[0]
    for _ in range(settings.nearer):  # those that may be the least of their chart
        kept = np.flatnonzero(least[rows] < room[rows])
        rows, best = rows[kept], best.of(kept)
        part, box, level = steps.of(rows), own.of(rows), common[rows]
        place = best.lowest(box.low, box.high)[1]
        for _ in range(settings.lower):
            place = part.lower(place, lean[rows], level)
        other = _tangents(place, part.at(place), curves[rows], level, lean[rows])
        best, least[rows] = _mixed(best, least[rows], other, box)
    least = np.minimum.reduceat(least, starts)
    return QuadraticBounds(least, slope, curve)


def _mixed(best: QuadraticBounds, most: Array, other: QuadraticBounds, charts: Charts) -> tuple[QuadraticBounds, Array]:
    """The mean with others, as curved, whose least is the largest, of those level along an axis; and that least.

    The least of the first is the `most` that is known. Shape (P,).
    """
    first = best
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.clip(np.nan_to_num(-first.slope / (other.slope - first.slope)), 0.0, 1.0)
    for share in (*shares.T, np.ones(len(most))):
        least = first.least + share * (other.least - first.least)
        mean = first._replace(least=least, slope=first.slope + share[:, None] * (other.slope - first.slope))
        low = mean.lowest(charts.low, charts.high)[0]
        better = low > most
        slope = np.where(better[:, None], mean.slope, best.slope)
        best = best._replace(least=np.where(better, mean.least, best.least), slope=slope)
        most = np.maximum(most, low)
    return best, most


def _pressed(curve: Array, place: Array) -> Array:
    """t . curve . t / 2. Shape (P,)."""
    return np.asarray((place * np.einsum("pab,pb->pa", curve, place)).sum(axis=1) / 2)


def _pressed_all(curve: Array, places: list[Array], starts: Indices) -> Array:
    return np.stack([_pressed(curve, place[starts]) for place in places])


def _tangents(place: Array, values: tuple[Array, Array], curve: Array, common: Array, lean: Array) -> QuadraticBounds:
    """Below functions less lean . t + t . common . t / 2, of such values and slopes at places, which bend by curve."""
    value, slope = values
    at_origin = value - (place * slope).sum(axis=1) + _pressed(curve, place)
    return QuadraticBounds(at_origin, slope - np.einsum("pab,pb->pa", curve, place) - lean, curve - common)


def _sunk(values: Array, half: Array, curve: Array) -> Array:
    """How functions in boxes bend down, (M, r, r), by values in the middle, and at each axis' ends.

    No more than leaves of their curvature none.
    """
    bent = (values[1::2] + values[2::2] - 2 * values[0]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        bent = np.where(half > 0, np.clip(bent / half**2, -np.maximum(np.einsum("paa->pa", curve), 0.0), 0.0), 0.0)
    return bent[:, :, None] * np.eye(half.shape[1])


def _rise(values: list[Array], half: Array) -> Array:
    """Slopes (M, r) of functions in boxes from values in the middle, and at each axis' ends.

    Of one that is bent down, that from end to end; of one that is bent up, the flattest.
    """
    rise = np.zeros(half.shape)
    for axis in range(half.shape[1]):
        low, high = values[1 + 2 * axis], values[2 + 2 * axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            first, last = (values[0] - low) / half[:, axis], (high - values[0]) / half[:, axis]
        flat = np.clip(0.0, first, np.maximum(first, last))
        rise[:, axis] = np.where(half[:, axis] > 0, np.where(first < last, flat, (first + last) / 2), 0.0)
    return rise


PENALTY = 1e6
"""Cost of a rad or m by which a limit is passed: beyond that of any way."""


@dataclass(frozen=True)
class ShorteningSettings:
    """How a way is drawn tight.

    Attributes:
        beside: Postures on either side, by the directions that are free.
        inside: By so much more than is asked bodies are held apart, m.
        moves: At most, before the postures come nearer to each other.
        still: Share of its cost by which a way at the edge has to get cheaper, or the postures come nearer.
    """

    beside: tuple[int, int, int] = (0, 5, 2)
    inside: float = CLEARANCE_TOLERANCE_M
    moves: int = 10
    still: float = 1e-4


def shorten_path(
    path: Array,
    instants: Sequence[TimeSample],
    cost: StepCost,
    times: Array,
    far: Array,
    bounds: tuple[Array, Array],
    around: CollisionScene | None,
    widths: tuple[float, float],
    settings: ShorteningSettings = ShorteningSettings(),
) -> Array:
    """A way beside another one that is cheaper, or keeps limits better. Shape (K, n).

    Args:
        path: Joints at the instants, which do the tasks. Shape (K, n).
        instants: All of one free direction, or all of two; of others the way stays.
        cost: Of steps. times: Of the instants. Shape (K,), s.
        far: Limits of the ways of the joints from instant to instant. Shape (K - 1, n).
        bounds: Of the joints. Shape (n,) each.
        around: What has to be clear.
        widths: Distances from one posture to the next, at first and at last, in the metric of the sets.
    """
    joints, (width, last), least, moves = path, widths, np.inf, 0
    whole = {instant.sets for instant in instants}
    sizes = {sets.size for sets in whole}
    if sizes not in ({1}, {2}):
        return path
    size = sizes.pop()
    own = settings.beside[size]
    count = (2 * own + 1) ** size
    shifts = np.array(list(product(np.arange(-own, own + 1.0), repeat=size)))
    rows = [(sets, np.flatnonzero([instant.sets is sets for instant in instants])) for sets in whole]
    number = np.array([instant.number for instant in instants])
    tangents: dict[int, Array] = {}
    while width > last:
        beside, good = np.empty((len(joints), count, joints.shape[1])), np.empty((len(joints), count), bool)
        for side, (sets, those) in enumerate(rows):
            tangents[side] = sets.tangents_at(number[those], joints[those], tangents.get(side))
            flat = joints[those, None] + width * np.einsum("knr,sr->ksn", tangents[side], shifts)
            on, fine = sets.corrected(np.repeat(number[those], count), flat.reshape(-1, flat.shape[2]))
            good[those] = fine.reshape(len(those), -1)
            beside[those] = np.where(good[those][:, :, None], on.reshape(flat.shape), flat)
        wrong = np.where(good, _passed(beside, times, bounds, around, settings.inside), 1.0)
        value, back = PENALTY * wrong[0], []
        for k in range(1, len(joints)):
            way = beside[k][None] - beside[k - 1][:, None]
            over = np.maximum(np.abs(way) - far[k - 1], 0.0).sum(axis=2)
            steps = value[:, None] + cost.of(way, times[k] - times[k - 1]) + PENALTY * over
            back.append(steps.argmin(axis=0))
            value = steps.min(axis=0) + PENALTY * wrong[k]
        seats = [int(value.argmin())]
        for before in reversed(back):
            seats.append(int(before[seats[-1]]))
        joints = beside[np.arange(len(joints)), seats[::-1]]
        at_edge, now = np.abs(shifts[seats]).max() == own, float(value.min())
        moves += 1
        if not (at_edge and now < least * (1 - settings.still) and moves < settings.moves):
            width, moves = width / 2, 0
        least = min(least, now)
    return joints


def _passed(
    beside: Array, times: Array, bounds: tuple[Array, Array], around: CollisionScene | None, inside: float
) -> Array:
    """By how much postures (K, s, n) about a way pass limits and clearance at times (K,), rad and m. Shape (K, s)."""
    over = np.maximum(np.maximum(beside - bounds[1], bounds[0] - beside), 0.0).sum(axis=2)
    if around is None:
        return np.asarray(over)
    least, middle, none = around.clearance + inside, beside[:, beside.shape[1] // 2], np.zeros(0)
    span = np.abs(beside - middle[:, None]).max(axis=1) @ around.levers.joints.T
    apart = distances_along(around, none, middle, times, least + float(span.max(initial=0.0)))
    close = np.flatnonzero((apart - span < least).any(axis=1))  # beside the others nothing comes near
    each, then = beside[close].reshape(-1, beside.shape[2]), np.repeat(times[close], beside.shape[1])
    apart = distances_along(around, none, each, then, least)
    over[close] += np.maximum(least - apart, 0.0).max(axis=1, initial=0.0).reshape(len(close), beside.shape[1])
    return np.asarray(over)
