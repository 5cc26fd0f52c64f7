"""The cheapest motion of all, and a bound that none falls below: search over all postures that do a task.

All postures at a number of instants are covered by charts; dynamic programming over these finds the classes of motions
that are cheapest, each of which becomes a guess for the whole motion's problem. Charts through which no motion can pass
that is cheaper than a share of the best one found are left out, the others are halved, and again, until none is left:
then none is cheaper than that share. Straight steps from instant to instant cost no more than the motion itself.

The bound is a proof under these assumptions, and no others: closed forms, where the arm has one, at samples of what is
free, or inverse kinematics from random starts found a posture of every part of the set of postures that is connected,
over all instants; within a box the set strays from its chart, and from the quadratic
form that its rim tells, no farther than at the rim; where something has to be clear, bodies that overlap do so as deep
as it is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models import CollisionScene
from models.arrays import Array
from ocp.errors import BoundWarning
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.search.charts import Charts, Parts, TimeSample, point
from ocp.motion.search.joint_space import MAX_STEP, TOLERANCE, JointSpace
from ocp.motion.search.steps import QuadraticBounds, StepCost
from ocp.motion.search.value import PENALTY, ChartGraph, shorten_path
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["MAX_FREE_DIRECTIONS", "AtlasSearch", "SearchSettings", "checked_bound"]

MAX_FREE_DIRECTIONS = 2
"""Directions that a task may leave free: of more there are too many postures."""


@dataclass(frozen=True)
class SearchSettings:
    """How far a search goes.

    Attributes:
        radii: Of the charts that the search begins with, rad or m, by the number of directions that are free.
        charts: Of all instants together at most, of 1 kB each with what is known of their steps.
        first: Of these, before there is any motion: where one has hardly room, neither it nor that there is none may be
            found.
        finest: Smaller charts are not halved, rad or m.
        gaps: Share of what a plan's steps cost that the bound may stay below, by the directions that are free.
        motions: Classes of motions that are followed up, the cheapest first.
        far: Share of the least cost beyond which they are not.
        same: Motions nearer to each other than this everywhere are one, rad or m.
        seats: Instants at which the cheapest motions through all charts are compared.
    """

    radii: tuple[float, float, float] = (0.07, 0.07, 0.2)
    charts: int = 40_000
    first: int = 10_000
    finest: float = 1e-6
    gaps: tuple[float, float, float] = (0.01, 0.01, 0.04)
    motions: int = 12
    far: float = 3.0
    same: float = 0.1
    seats: int = 5


def checked_bound(bound: float, cost: float) -> float | None:
    """The bound of the cost of all motions; None where one costs less, which a bound excludes.

    Warns:
        BoundWarning: That it does.
    """
    if bound <= cost * (1 + ROUNDING_SHARE):
        return bound
    words = f"a motion costs {cost:.9g}, less than the bound {bound:.9g} of all motions, which is left out: report this"
    warn(BoundWarning(words, name="bound", value=cost, limit=bound), stacklevel=2)
    return None


class AtlasSearch:
    """All postures at some instants, and the motions through them.

    Attributes:
        covered: Charts of each instant. layers: But for those on which every posture touches something.
    """

    def __init__(
        self,
        space: JointSpace,
        instants: Sequence[TimeSample],
        times: Array,
        cost: StepCost,
        limits: Array,
        *,
        seeds: Callable[[int], Array],
        start: Array | None = None,
        scene: CollisionScene | None = None,
        settings: SearchSettings = SearchSettings(),
    ) -> None:
        """
        Args:
            space: Where the postures lie.
            instants: By rising time.
            times: s. Shape (K,).
            cost: Of a step between two of them.
            limits: How far the joints may go from each to the next. Shape (K - 1, n).
            seeds: Postures at an instant, of as many parts of the set as are found, shape (M, n); raises Unreachable.
            start: The posture of the first instant, where it is given. Shape (n,).
            scene: What has to be clear.
            settings: How far it goes.

        Raises:
            Unreachable: An instant at which no posture does the tasks within limits, and clear.
            ProblemError: More postures than memory is for.
        """
        self.space, self.instants, self.times, self.cost, self.limits = space, instants, times, cost, limits
        self.start, self.scene, self.settings = start, scene, settings
        self._known: tuple[ChartGraph, list[QuadraticBounds], list[QuadraticBounds] | None] | None = None
        self.covered = self._cover(seeds)
        self.layers = [self.allowed(charts, k) for k, charts in enumerate(self.covered)]

    def _cover(self, seeds: Callable[[int], Array]) -> list[Charts]:
        """Charts of all postures of each instant.

        Raises:
            Unreachable, ProblemError: As the search itself.
        """
        covered = list[Charts]()
        for sets in dict.fromkeys(instant.sets for instant in self.instants):
            own = [k for k, instant in enumerate(self.instants) if instant.sets is sets]
            found: list[tuple[int, Array]] = []
            for k in own:
                try:
                    found += [(self.instants[k].number, joints) for joints in seeds(k)]
                except Unreachable:
                    if not found:
                        raise
            layer, joints = (np.array(part) for part in zip(*found, strict=True))
            charts = sets.cover(layer, joints, self.settings.radii[sets.size], self.settings.charts)
            covered += [charts.of(charts.layer == self.instants[k].number) for k in own]
        if self.start is not None:
            covered[0] = point(self.start)
        for k, charts in enumerate(covered):
            if not len(charts):
                seeds(k)  # says what is out of reach
                words = f"at {self.times[k]:.4g} s no posture that does the tasks is within limits"
                time = float(self.times[k])
                raise Unreachable(words, np.full(len(self.space.scale), np.nan), np.nan, time=time)
        return covered

    def allowed(self, charts: Charts, k: int) -> Charts:
        """But for charts on which every posture touches something."""
        return charts.of(self._allowed(charts, k))

    def _allowed(self, charts: Charts, k: int) -> NDArray[np.bool_]:
        around = self.scene
        if around is None or not len(charts):
            return np.ones(len(charts), dtype=bool)
        times, none = np.full(len(charts), self.times[k]), np.zeros(0)
        apart = distances_along(around, none, charts.centers, times, around.clearance)
        return np.asarray((apart + charts.spans @ around.levers.joints.T >= around.clearance).all(axis=1))

    def graph(self, layers: list[Charts], most: Array) -> ChartGraph:
        """The steps between charts, which cost at most so much each. Shape (K - 1,)."""
        return ChartGraph(self.space, layers, np.diff(self.times), self.cost, self.limits, most)

    def whole_graph(self) -> ChartGraph:
        """All steps between the charts that the search begins with."""
        return self.graph(self.layers, np.full(len(self.times) - 1, np.inf))

    def part(self, first: int, last: int) -> AtlasSearch:
        """The search from one of its instants to another one, both of them included."""
        own, rows = copy(self), slice(first, last + 1)
        own.instants, own.times, own.limits = self.instants[rows], self.times[rows], self.limits[first:last]
        own.covered, own.layers, own._known = self.covered[rows], self.layers[rows], None
        own.start = self.start if first == 0 else None
        return own

    def ways(self) -> tuple[list[Array], float]:
        """Joints at the instants, (K, n), of motions by rising cost of their steps, and what none costs less than."""
        path, bound = self.best(np.inf)
        return [] if path is None else [path], bound

    def steps(self, path: Array) -> float:
        """What straight steps through joints (K, n) at the instants cost."""
        return float(self.cost.of(np.diff(path, axis=0), np.diff(self.times)[:, None]).sum())

    # ---- motions -------------------------------------------------------------------------------------------------

    def motions(self, most: float, every: bool = False) -> list[Array]:
        """Joints at the instants, (K, n), of the cheapest motion of each class, by rising cost of their steps.

        After `best` of those that may be the cheapest, for what the bound leaves open.

        Args:
            most: What one step may cost: that of a motion that is known, or inf.
            every: Also of classes that are dearer.
        """
        if self._known is None or every:
            graph = self.graph(self.layers, np.full(len(self.times) - 1, most))
            self._known = graph, graph.cost_to_go(), None
        graph, cost_to_go, passed = self._known
        passed = passed or graph.passed()
        seats = []
        for k in np.unique(np.linspace(0, len(graph.layers) - 1, self.settings.seats).astype(int)).tolist():
            charts = graph.layers[k]
            total = graph.through(passed, cost_to_go, k)
            lowest = np.isfinite(total)
            pairs = self.space.tree(charts.centers).query_pairs(3 * float(charts.radii.max()), output_type="ndarray")
            for one, other in (pairs.T, pairs.T[::-1]):
                lowest[one[total[one] > total[other]]] = False
            seats += [(float(total[i]), k, i) for i in np.flatnonzero(lowest).tolist()]
        found: list[tuple[float, Array]] = []
        for bound, k, chart in sorted(seats):
            if len(found) == self.settings.motions or (found and bound > self.settings.far * found[0][0]):
                break
            path = self._path(graph, k, chart, passed, cost_to_go)
            same = (np.abs(self.space.difference(path, other)).max() for _, other in found if path is not None)
            if path is None or any(apart < self.settings.same for apart in same):
                continue
            found.append((self.steps(path), path))
        return [path for _, path in sorted(found, key=lambda one: one[0])]

    def _path(
        self, graph: ChartGraph, k: int, chart: int, passed: list[QuadraticBounds], cost_to_go: list[QuadraticBounds]
    ) -> Array | None:
        """The cheapest way through a chart; None where it ends."""
        slope, box = cost_to_go[k].slope[chart] + (passed[k].slope[chart] if k else 0.0), graph.layers[k].of([chart])
        at = np.where(slope > 0, box.low[0], np.where(slope < 0, box.high[0], 0.0))
        first = self.allowed_in(k, box, at)
        if first is None:
            return None
        path, last = {k: first}, len(self.layers) - 1
        for values, order in ((cost_to_go, range(k + 1, last + 1)), (passed, range(k - 1, -1, -1))):
            here = first
            for other in order:
                ways = graph.nearest(here, other - int(np.sign(order.step)), other, values[other])
                there = next((good for way in ways if (good := self.allowed_in(other, *way)) is not None), None)
                if there is None:
                    return None
                here = here + self.space.difference(there, here)
                path[other] = here
        return np.array([path[number] for number in range(last + 1)])

    def allowed_in(self, k: int, box: Charts, place: Array) -> Array | None:
        """The posture at a place (r,) in the box of a chart, or nearer to its middle; None where none is allowed.

        Boxes end beyond the limits, by how far the set strays from them.
        """
        middle = (box.low[0] + box.high[0]) / 2
        inwards = (0.0, 0.25, 0.5, 1.0)
        ways = (box.centers[0] + box.tangents[0] @ (place + share * (middle - place)) for share in inwards)
        return next((good for way in ways if (good := self._on(k, way)) is not None), None)

    def _on(self, k: int, joints: Array) -> Array | None:
        """The posture of an instant next to joints, None where it leaves the limits or touches something."""
        if k == 0 and self.start is not None:
            return self.start
        found, good = self.instants[k].sets.corrected(np.array([self.instants[k].number]), joints[None])
        return np.asarray(found[0]) if good[0] and self._clear(found, k)[0] else None

    # ---- the best of all -------------------------------------------------------------------------------------------

    def best(self, most: float) -> tuple[Array | None, float]:
        """Joints at the instants, (K, n), whose steps cost nearly least, and what no motion's steps cost less than.

        Args:
            most: What one step may cost at first: that of a motion that is known, or inf. Where nothing so cheap is
                found it is raised: motions with a dearer step are dearer than what is found.

        Returns:
            None and inf where no motion goes through all instants; a bound that is lower than it might be where more
            charts would be needed than memory is for.
        """
        seconds = np.diff(self.times)[:, None]
        dearest = float(self.cost.of(np.minimum(self.limits, MAX_STEP), seconds).max(initial=0.0))
        while True:
            path, bound = self._best(most)
            if most >= dearest:
                return path, bound
            # a motion with a step that was left out costs more than `most`
            cost, bound = np.inf if path is None else self.steps(path), min(bound, most)
            if path is not None and (cost <= most or bound >= self._share * cost):
                return path, bound
            most = dearest if path is None else cost

    @property
    def _share(self) -> float:
        """Of what a motion's steps cost, which the bound has to reach."""
        return 1 - self.settings.gaps[max(0, *(instant.sets.size for instant in self.instants))]

    def _best(self, most: float) -> tuple[Array | None, float]:
        """As `best`, of motions all of whose steps cost at most so much."""
        share = self._share
        layers, best = self.first(most)
        if not layers:
            return None, np.inf
        if best is None:
            graph = self.graph(layers, np.full(len(self.times) - 1, most))
            return None, max(float(graph.least(graph.cost_to_go()[0], 0).min()), 0.0)
        least = self.steps(best)
        coarse, others = True, np.zeros(len(self.times) - 1)  # what a motion costs at least before and after each step
        rest: list[QuadraticBounds] | None = None  # what has passed until each chart, at least
        while True:
            graph = self.graph(layers, min(most, least) - others)
            # beyond that nothing is looked for: a class at first, whose motion steps miss some of, then bounds
            far = least / share if coarse else share * least
            cost_to_go = graph.cost_to_go(rest, far)
            if coarse:
                self._known = graph, cost_to_go, None
            low = float(graph.least(cost_to_go[0], 0).min(initial=np.inf))
            path = self._led(graph, cost_to_go) if np.isfinite(low) else None
            if path is not None and (cost := self.steps(path)) < least:
                best, least = path, cost
            if low >= share * least:
                return best, share * least
            passed = graph.passed(cost_to_go, far)
            if coarse:
                self._known, coarse = (graph, cost_to_go, passed), False
            through = [graph.through(passed, cost_to_go, k) for k in range(len(layers))]
            before, after = (
                [float(graph.least(each, k).min()) for k, each in enumerate(v)] for v in (passed, cost_to_go)
            )
            others = np.maximum(others, np.array(before[:-1]) + np.array(after[1:]))
            cheap = [total < share * least for total in through]
            kept = [charts.of(own) for charts, own in zip(layers, cheap, strict=True)]
            if not all(len(charts) for charts in kept):
                return best, share * least
            if not self._may_be_halved(kept, self.settings.charts):
                return best, max(low, 0.0)
            finer = [self._finer(kept[k], k, passed[k].of(own)) for k, own in enumerate(cheap)]
            layers, rest = [charts for charts, _ in finer], [values for _, values in finer]

    def first(self, most: float) -> tuple[list[Charts], Array | None]:
        """Charts through which motions may pass all of whose steps cost at most so much, and one motion.

        No charts where there is none; no motion where memory is for no more charts.
        """
        layers, coarse = self.layers, True
        while True:
            graph = self.graph(layers, np.full(len(self.times) - 1, most))
            path = self._tight(self._through_centers(graph), layers)
            if path is not None:
                return layers, path
            alive = graph.alive()
            if not all(own.any() for own in alive):
                return [], None
            layers = [charts.of(own) for charts, own in zip(layers, alive, strict=True)]
            if coarse:
                graph = self.graph(layers, graph.most)
                path = self._led(graph, graph.cost_to_go())
            if path is not None or not self._may_be_halved(layers, self.settings.first):
                return layers, path
            coarse = False
            layers = [self.allowed(self.halved(charts, k), k) for k, charts in enumerate(layers)]

    def _led(self, graph: ChartGraph, cost_to_go: list[QuadraticBounds]) -> Array | None:
        """A motion as cheap as values say; None where it comes to no end, or is too fast."""
        chart = int(graph.least(cost_to_go[0], 0).argmin())
        return self._tight(self._path(graph, 0, chart, cost_to_go, cost_to_go), graph.layers)

    def _may_be_halved(self, layers: list[Charts], most: int) -> bool:
        """Whether charts of half the radius are no more than so many, and not too small."""
        finer = sum(2 ** charts.tangents.shape[2] * len(charts) for charts in layers)
        return finer <= most and max(float(charts.radii.max()) for charts in layers) >= self.settings.finest

    def _through_centers(self, graph: ChartGraph) -> Array | None:
        """The cheapest way from centre to centre of charts, too far steps being dear; None if there is none."""
        layers = graph.layers
        cost, back = np.where(self._clear(layers[-1].centers, len(layers) - 1), 0.0, np.inf), list[Array]()
        for k in range(len(layers) - 2, -1, -1):
            here, there = layers[k], layers[k + 1]
            least, onward = np.full(len(here), np.inf), np.zeros(len(here))
            for i, j in graph.steps(k, k + 1):
                way = self.space.difference(there.centers[j], here.centers[i])
                total = cost[j] + self.cost.of(way, self.times[k + 1] - self.times[k])
                total += PENALTY * np.maximum(np.abs(way) - self.limits[k], 0.0).sum(axis=1)
                order = np.lexsort((total, i))
                i, j, total = i[order], j[order], total[order]
                first = np.flatnonzero(np.diff(i, prepend=-1))
                least[i[first]], onward[i[first]] = total[first], j[first]
            cost = np.where(self._clear(here.centers, k), least, np.inf)
            back.append(onward)
        if not np.isfinite(cost).any():
            return None
        chart = int(cost.argmin())
        path = [layers[0].centers[chart]]
        for k, onward in enumerate(reversed(back)):
            chart = int(onward[chart])
            path.append(path[-1] + self.space.difference(layers[k + 1].centers[chart], path[-1]))
        return np.array(path)

    def _clear(self, joints: Array, k: int) -> NDArray[np.bool_]:
        """Whether postures (N, n) of an instant keep limits and clearance. Shape (N,)."""
        good, around = self.space.within(joints), self.scene
        if around is not None:
            at = np.flatnonzero(good)
            times = np.full(len(at), self.times[k])
            apart = distances_along(around, np.zeros(0), joints[at], times, around.clearance)
            good[at] = (apart >= around.clearance).all(axis=1)
        return good

    def _tight(self, path: Array | None, layers: list[Charts]) -> Array | None:
        """A way drawn tight within charts; as it was where that touches; None if it is too fast."""
        bounds = self.space.lower, self.space.upper
        steps = self.cost, self.times, self.limits
        if path is None:
            return None
        if self.start is None:
            width = max(float(charts.radii.max()) for charts in layers)
            made = shorten_path(path, self.instants, *steps, bounds, self.scene, (width / 2, width / 64))
            path = made if all(self._on(k, joints) is not None for k, joints in enumerate(made)) else path
        return path if (np.abs(np.diff(path, axis=0)) <= self.limits + TOLERANCE).all() else None

    def halved(self, charts: Charts, k: int) -> Charts:
        """Charts of an instant of half the radius in their place."""
        return self._parts(charts, k).charts

    def _parts(self, charts: Charts, k: int) -> Parts:
        if not charts.tangents.shape[2]:
            return Parts(charts, np.arange(len(charts)), charts.low, charts.high)
        own = replace(charts, layer=np.full(len(charts), self.instants[k].number))
        return self.instants[k].sets.parts(own)

    def _finer(self, charts: Charts, k: int, values: QuadraticBounds) -> tuple[Charts, QuadraticBounds]:
        """Charts of half the radius but for those on which every posture touches something, and values on these."""
        parts = self._parts(charts, k)
        good = self._allowed(parts.charts, k)
        values, low, high = values.of(parts.owners[good]), parts.low[good], parts.high[good]
        return parts.charts.of(good), QuadraticBounds.constant(values.lowest(low, high)[0], low.shape[1])
