"""Global search over the self-motion manifolds: the lowest-cost motion, and a lower bound of the cost of any motion.

An atlas of charts covers all configurations that satisfy the tasks at some time samples. Dynamic programming over the
charts yields lower bounds of the cost-to-go and the cost-to-come, and paths of locally least cost, each of which is a
guess for the optimal control problem. Then branch and bound: charts through which no motion can cost less than a share
of the best known cost are discarded, and the others are split, until none is left. No motion then costs
less than that share, since straight steps from sample to sample cost no more than the motion itself.

The bound holds under these assumptions alone. Closed forms at samples of the free parameter, or inverse kinematics from
random starts, found a configuration on every connected component, over all time samples. Within a box, the manifold
deviates from its chart, and from the quadratic form fitted at the rim, no farther than at the rim. The measured
penetration depth of overlapping bodies is correct.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models import CollisionScene
from models.checks import Array
from ocp.console import TimeLimitReached
from ocp.errors import BoundWarning
from ocp.motion.local.collisions import distances_along, largest_changes
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.search.charts import Charts, SplitCharts, TimeSample, concatenate, point_chart
from ocp.motion.search.joint_space import MAX_STEP, TOLERANCE, JointSpace
from ocp.motion.search.shortening import PENALTY, PathProblem, shorten_path
from ocp.motion.search.steps import QuadraticBounds, Steps
from ocp.motion.search.value import ChartGraph
from ocp.tolerances import ROUNDING_SHARE

MAX_FREE_DIRECTIONS = 2
"""Largest dimension of a self-motion manifold that can be searched; an atlas of more dimensions is too large."""


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the global search.

    Attributes:
        radii: Initial radii of the charts, rad or m, by the dimension of the manifold.
        charts: Largest number of charts over all time samples; each takes about 1 kB with its steps.
        charts_without_path: The same while no path is known. In a narrow passage, neither a path nor a proof that there
            is none may then be found.
        finest: Charts of a smaller radius are not split, rad or m.
        least_split: Least share of the charts that an iteration of the branch and bound halves; it ends otherwise.
        gaps: Relative gap between cost and bound at which the search stops, by the dimension of the manifold.
        max_classes: Largest number of paths of locally least cost that are returned.
        max_cost_ratio: Paths that cost more than so many times the best one are not returned.
        same_path: Motions that differ by less everywhere count as one, rad or m.
        seats: Number of time samples at which the lowest-cost motions through each chart are compared.
    """

    radii: tuple[float, float, float] = (0.07, 0.07, 0.2)
    charts: int = 40_000
    charts_without_path: int = 10_000
    finest: float = 1e-6
    least_split: float = 0.25
    gaps: tuple[float, float, float] = (0.01, 0.01, 0.04)
    max_classes: int = 12
    max_cost_ratio: float = 3.0
    same_path: float = 0.1
    seats: int = 5


def checked_bound(bound: float, cost: float) -> float | None:
    """Return a lower cost bound after a check; warn and return None if a known motion costs less than the bound.

    Warns:
        BoundWarning: The cost of a motion lies below the bound.
    """
    if bound <= cost * (1 + ROUNDING_SHARE):
        return bound
    words = f"a motion costs {cost:.9g}, less than its lower bound {bound:.9g}, which is dropped: report this"
    warn(BoundWarning(words, name="bound", value=cost, limit=bound), stacklevel=2)
    return None


class AtlasSearch:
    """Search for the lowest-cost path over an atlas of the self-motion manifolds at time samples.

    Attributes:
        atlas: Charts of each time sample.
        layers: The same without charts on which every configuration is in collision.
        unresolved: Lower bound, time sample and a configuration of classes without a path in `class_representatives`.
    """

    def __init__(
        self,
        space: JointSpace,
        samples: Sequence[TimeSample],
        steps: Steps,
        *,
        seeds: Callable[[int], Array],
        start: Array | None = None,
        scene: CollisionScene | None = None,
        settings: SearchSettings = SearchSettings(),
    ) -> None:
        """Build the atlas of the self-motion manifolds at all time samples.

        Args:
            space: Joint space.
            samples: Manifolds of the time samples, by rising time.
            steps: Steps between the samples.
            seeds: Function that returns configurations (M, n) at a sample, on as many manifold components as possible,
                or raises Unreachable.
            start: Configuration at the first sample, if given. Shape (n,).
            scene: Collision scene, or None.
            settings: Settings of the search.

        Raises:
            Unreachable: At some sample no configuration within limits satisfies the tasks.
            ProblemError: The atlas needs too many charts.
        """
        self.space, self.samples = space, samples
        self._steps, self.times, self.cost, self.limits = steps, steps.times, steps.cost, steps.limits
        self.start, self.scene, self.settings = start, scene, settings
        self.unresolved = list[tuple[float, int, Array]]()
        self._cost_bounds: tuple[ChartGraph, list[QuadraticBounds], list[QuadraticBounds] | None] | None = None
        self.atlas = self._build_atlas(seeds)
        self.layers = [self.without_collisions(charts, k) for k, charts in enumerate(self.atlas)]

    def _build_atlas(self, seeds: Callable[[int], Array]) -> list[Charts]:
        """Return for each time sample the charts that cover all configurations in which the tasks are satisfied.

        Raises:
            Unreachable, ProblemError: As in the constructor.
        """
        atlas = list[Charts]()
        for sets in dict.fromkeys(sample.manifolds for sample in self.samples):
            rows = [k for k, sample in enumerate(self.samples) if sample.manifolds is sets]
            configurations: list[tuple[int, Array]] = []
            for k in rows:
                try:
                    configurations += [(self.samples[k].row, joints) for joints in seeds(k)]
                except Unreachable:
                    if not configurations:
                        raise
            layer, joints = (np.array(part) for part in zip(*configurations, strict=True))
            charts = sets.cover(layer, joints, self.settings.radii[sets.size], self.settings.charts)
            atlas += [charts.select(charts.layer == self.samples[k].row) for k in rows]
        atlas = atlas if self.start is None else [point_chart(self.start), *atlas[1:]]
        for k, charts in enumerate(atlas):
            if not len(charts):
                seeds(k)  # raises an error that names the pose
                words = f"at {self.times[k]:.4g} s no configuration that does the tasks is within limits"
                raise Unreachable(words, np.full(len(self.space.scale), np.nan), np.nan, time=float(self.times[k]))
        return atlas

    def without_collisions(self, charts: Charts, k: int) -> Charts:
        """Return the manifold charts of a time sample without those on which every configuration is in collision."""
        return charts.select(self._collision_free(charts, k))

    def _collision_free(self, charts: Charts, k: int) -> NDArray[np.bool_]:
        """Return which charts of a time sample may contain a configuration without collision. Shape (N,)."""
        scene, free = self.scene, np.ones(len(charts), dtype=bool)
        if scene is None:
            return free
        distances = distances_along(scene, np.zeros(0), charts.centers, self.times[k], cutoff=scene.clearance)
        at, pair = np.nonzero(distances < scene.clearance)
        box = charts.tangents, np.maximum(np.abs(charts.low), np.abs(charts.high)), charts.max_deviation
        largest = distances[at, pair] + largest_changes(scene, charts.centers, at, pair, box=box)
        free[at[largest < scene.clearance]] = False
        return free

    def graph(self, layers: list[Charts] | None = None, max_costs: Any = np.inf) -> ChartGraph:
        """Return the graph whose nodes are manifold charts and whose edges are steps of limited cost between charts.

        Each step costs at most `max_costs`: one value for all steps, or shape (K - 1,). The default is all charts.
        """
        max_costs = np.broadcast_to(max_costs, len(self.times) - 1)
        return ChartGraph(self.space, self.layers if layers is None else layers, self._steps, max_costs)

    def restrict(self, first: int, last: int) -> AtlasSearch:
        """Return the search restricted to the time samples from `first` to `last`, both included."""
        part, rows = copy(self), slice(first, last + 1)
        part.samples, part.times, part.limits = self.samples[rows], self.times[rows], self.limits[first:last]
        part._steps = Steps(part.times, part.cost, part.limits)
        part.atlas, part.layers, part._cost_bounds = self.atlas[rows], self.layers[rows], None
        part.start = self.start if first == 0 else None
        return part

    def paths(self) -> tuple[list[Array], float]:
        """Return paths (K, n) sorted by the cost of their steps, and a lower bound of the cost of any path."""
        path, bound = self.solve(np.inf)
        return [] if path is None else [path], bound

    def path_cost(self, path: Array) -> float:
        """Return the cost of the straight steps along a path (K, n)."""
        return float(self.cost.evaluate(np.diff(path, axis=0), np.diff(self.times)[:, None]).sum())

    # ---- paths of locally least cost ---------------------------------------------------------------------------------

    def class_representatives(self, max_cost: float, include_costlier: bool = False) -> list[Array]:
        """Return a path (K, n) of locally least cost for each class of neighbouring paths, sorted by cost.

        Such a path leads through a chart through which motions cost less than through the neighbouring charts. After
        `solve`, only paths are returned that its bound does not exclude.

        Args:
            max_cost: Largest cost of one step, such as the cost of a known motion; or inf.
            include_costlier: Whether excluded paths are returned as well.
        """
        if self._cost_bounds is None or include_costlier:
            graph = self.graph(self.layers, max_cost)
            self._cost_bounds = graph, graph.cost_to_go(), None
        graph, cost_to_go, cost_to_come = self._cost_bounds
        cost_to_come = cost_to_come or graph.cost_to_come()
        minima, settings = [], self.settings
        for k in np.unique(np.linspace(0, len(graph.layers) - 1, settings.seats).astype(int)).tolist():
            charts = graph.layers[k]
            costs = graph.cost_through(cost_to_come, cost_to_go, k)
            is_minimum = np.isfinite(costs)
            pairs = self.space.tree(charts.centers).query_pairs(3 * float(charts.radii.max()), output_type="ndarray")
            for first, second in (pairs.T, pairs.T[::-1]):
                is_minimum[first[costs[first] > costs[second]]] = False
            minima += [(float(costs[i]), k, i) for i in np.flatnonzero(is_minimum).tolist()]
        paths: list[tuple[float, Array]] = []
        self.unresolved = []
        for lower_bound, k, chart in sorted(minima):
            if paths and lower_bound > settings.max_cost_ratio * paths[0][0]:
                break
            full = len(paths) == settings.max_classes
            path = None if full else self._path_through(graph, k, chart, cost_to_come, cost_to_go)
            if path is None:
                self.unresolved.append((lower_bound, k, graph.layers[k].centers[chart]))
            elif all(np.abs(self.space.difference(path, known)).max() >= settings.same_path for _, known in paths):
                paths.append((self.path_cost(path), path))
        return [path for _, path in sorted(paths, key=lambda entry: entry[0])]

    def _path_through(
        self,
        graph: ChartGraph,
        k: int,
        chart: int,
        cost_to_come: list[QuadraticBounds],
        cost_to_go: list[QuadraticBounds],
    ) -> Array | None:
        """Return the lowest-cost path through one chart; None if it cannot be continued to both ends."""
        slope = cost_to_go[k].slope[chart] + (cost_to_come[k].slope[chart] if k else 0.0)
        start_chart = graph.layers[k].select([chart])
        place = np.where(slope > 0, start_chart.low[0], np.where(slope < 0, start_chart.high[0], 0.0))
        start = self.project_in_box(k, start_chart, place)
        if start is None:
            return None
        path, last = {k: start}, len(self.layers) - 1
        for values, order in ((cost_to_go, range(k + 1, last + 1)), (cost_to_come, range(k - 1, -1, -1))):
            current = start
            for neighbour in order:
                previous = neighbour - int(np.sign(order.step))
                candidates = graph.successors(current, previous, neighbour, values[neighbour])
                projected = (self.project_in_box(neighbour, *candidate) for candidate in candidates)
                successor = next((each for each in projected if each is not None), None)
                if successor is None:
                    return None
                current = current + self.space.difference(successor, current)
                path[neighbour] = current
        return np.array([path[number] for number in range(last + 1)])

    def project_in_box(self, k: int, box: Charts, place: Array) -> Array | None:
        """Project a point of a chart, with coordinates (r,), onto the manifold; return None if the result is invalid.

        A valid configuration is within the joint limits and collision-free. If the result is not valid, points nearer
        to the middle of the chart are tried: a box reaches beyond the limits by the deviation of the manifold.
        """
        middle = (box.low[0] + box.high[0]) / 2
        shares = (0.0, 0.25, 0.5, 1.0)
        candidates = (box.centers[0] + box.tangents[0] @ (place + share * (middle - place)) for share in shares)
        projected = (self._project(k, candidate) for candidate in candidates)
        return next((configuration for configuration in projected if configuration is not None), None)

    def _project(self, k: int, joints: Array) -> Array | None:
        """Project a configuration onto the manifold of a time sample; None if this violates limits or clearance."""
        if k == 0 and self.start is not None:
            return self.start
        projected, converged = self.samples[k].manifolds.project(np.array([self.samples[k].row]), joints[None])
        return np.asarray(projected[0]) if converged[0] and self._is_clear(projected, k)[0] else None

    # ---- branch and bound --------------------------------------------------------------------------------------------

    def solve(self, max_cost: float) -> tuple[Array | None, float]:
        """Return a path (K, n) of nearly least cost, and a lower bound of the cost of any path.

        Args:
            max_cost: Initial limit of the cost of one step, such as the cost of a known motion; or inf. It is raised if
                no path costs so little, since a path with a costlier step costs more.

        Returns:
            None and inf if no path exists. The bound is looser if the atlas would need too many charts.
        """
        seconds = np.diff(self.times)[:, None]
        largest_step_cost = float(self.cost.evaluate(np.minimum(self.limits, MAX_STEP), seconds).max(initial=0.0))
        while True:
            layers, path = self.find_path(max_cost)
            bound = np.inf
            if path is not None:
                path, bound = self._branch_and_bound(layers, max_cost, self.path_cost(path), path)
            elif layers:
                graph = self.graph(layers, max_cost)
                bound = max(float(graph.minima(graph.cost_to_go()[0], 0).min()), 0.0)
            if max_cost >= largest_step_cost:
                return path, bound
            # a motion with an excluded step costs more than `max_cost`
            cost, bound = np.inf if path is None else self.path_cost(path), min(bound, max_cost)
            if path is not None and (cost <= max_cost or bound >= (1 - self.gap) * cost):
                return path, bound
            max_cost = largest_step_cost if path is None else cost

    @property
    def gap(self) -> float:
        """Relative gap between the cost of the path and the lower bound at which the search stops."""
        return self.settings.gaps[max(0, *(sample.manifolds.size for sample in self.samples))]

    def lower_bound(self, known_cost: float) -> float:
        """Return a lower bound of the cost of any path, at most (1 - `gap`) times `known_cost`.

        No path is searched. The bound is what time limit and memory allow. `known_cost` is that of a known motion.
        """
        return self._branch_and_bound(self.layers, known_cost, known_cost, None)[1]

    def _branch_and_bound(
        self, layers: list[Charts], max_cost: float, best_cost: float, best_path: Array | None
    ) -> tuple[Array | None, float]:
        """Improve the given path, if any, and return it with a lower bound of the cost of any path."""
        target, bound = 1 - self.gap, 0.0
        coarse = best_path is not None
        remaining = np.zeros(len(self.times) - 1)  # least cost before and after each step
        known_bounds: list[QuadraticBounds] | None = None  # lower bounds of the cost-to-come
        while True:
            graph = self.graph(layers, min(max_cost, best_cost) - remaining)
            # bounds beyond the cutoff are not needed; at first it leaves a margin for other local minima
            cutoff = best_cost / target if coarse else target * best_cost
            try:
                cost_to_go = graph.cost_to_go(known_bounds, cutoff)
                if coarse:
                    self._cost_bounds = graph, cost_to_go, None
                bound = max(bound, float(graph.minima(cost_to_go[0], 0).min(initial=np.inf)))
                path = self._follow_bounds(graph, cost_to_go) if best_path is not None and np.isfinite(bound) else None
                if path is not None and (cost := self.path_cost(path)) < best_cost:
                    best_path, best_cost = path, cost
                if bound >= target * best_cost:
                    return best_path, target * best_cost
                cost_to_come = graph.cost_to_come(cost_to_go, cutoff)
            except TimeLimitReached:
                return best_path, bound
            if coarse:
                self._cost_bounds, coarse = (graph, cost_to_go, cost_to_come), False
            through = [graph.cost_through(cost_to_come, cost_to_go, k) for k in range(len(layers))]
            before = np.array([graph.minima(values, k).min() for k, values in enumerate(cost_to_come)])
            after = np.array([graph.minima(values, k).min() for k, values in enumerate(cost_to_go)])
            remaining = np.maximum(remaining, before[:-1] + after[1:])
            promising = [np.flatnonzero(total < target * best_cost) for total in through]
            if not all(len(rows) for rows in promising):
                return best_path, target * best_cost
            layers = [charts.select(rows) for charts, rows in zip(layers, promising, strict=True)]
            come = [values.select(rows) for values, rows in zip(cost_to_come, promising, strict=True)]
            through = [total[rows] for total, rows in zip(through, promising, strict=True)]
            limit = self._splitting_limit(layers, through)
            if limit <= bound:
                return best_path, bound
            refined = [self._refine(charts, k, come[k], through[k] <= limit) for k, charts in enumerate(layers)]
            layers, known_bounds = [charts for charts, _ in refined], [values for _, values in refined]

    def _splitting_limit(self, layers: list[Charts], through: list[Array]) -> float:
        """Return the cost bound below which charts are halved, as memory permits; -inf if halving must stop."""
        costs, growth = np.sort(np.concatenate(through)), 2 ** layers[-1].tangents.shape[2] - 1
        if max(float(charts.radii.max()) for charts in layers) < self.settings.finest:
            return -np.inf
        count = (self.settings.charts - len(costs)) // max(growth, 1)
        if count < self.settings.least_split * len(costs):
            return -np.inf
        return np.inf if count >= len(costs) else float(costs[count])

    def find_path(self, max_cost: float) -> tuple[list[Charts], Array | None]:
        """Find a path with steps of cost at most `max_cost`; return the charts that the path may use, and the path.

        The list of charts is empty if no path exists. The path is None if the atlas would need too many charts.
        """
        layers, coarse = self.layers, True
        while True:
            graph = self.graph(layers, max_cost)
            path = self._shorten(self._path_through_centers(graph), layers)
            if path is not None:
                return layers, path
            alive = graph.reachable()
            if not all(mask.any() for mask in alive):
                return [], None
            layers = [charts.select(mask) for charts, mask in zip(layers, alive, strict=True)]
            if coarse:
                graph = self.graph(layers, graph.max_costs)
                path = self._follow_bounds(graph, graph.cost_to_go())
            if path is not None or not self._can_split(layers, self.settings.charts_without_path):
                return layers, path
            coarse = False
            layers = [self.without_collisions(self.split_charts(charts, k), k) for k, charts in enumerate(layers)]

    def _follow_bounds(self, graph: ChartGraph, cost_to_go: list[QuadraticBounds]) -> Array | None:
        """Return a shortened path along charts of least cost-to-go bound; None if it breaks off or is invalid."""
        chart = int(graph.minima(cost_to_go[0], 0).argmin())
        return self._shorten(self._path_through(graph, 0, chart, cost_to_go, cost_to_go), graph.layers)

    def _can_split(self, layers: list[Charts], max_charts: int) -> bool:
        """Return whether the manifold charts may be halved without exceeding `max_charts` or becoming too small."""
        count = sum(2 ** charts.tangents.shape[2] * len(charts) for charts in layers)
        return count <= max_charts and max(float(charts.radii.max()) for charts in layers) >= self.settings.finest

    def _path_through_centers(self, graph: ChartGraph) -> Array | None:
        """Return the lowest-cost path through the centres of manifold charts; steps that are too long are penalised."""
        layers = graph.layers
        cost, back_pointers = np.where(self._is_clear(layers[-1].centers, len(layers) - 1), 0.0, np.inf), list[Array]()
        for k in range(len(layers) - 2, -1, -1):
            charts, successors = layers[k], layers[k + 1]
            least_cost, next_chart = np.full(len(charts), np.inf), np.zeros(len(charts))
            for i, j in graph.edges(k, k + 1):
                displacement = self.space.difference(successors.centers[j], charts.centers[i])
                total = cost[j] + self.cost.evaluate(displacement, self.times[k + 1] - self.times[k])
                total += PENALTY * np.maximum(np.abs(displacement) - self.limits[k], 0.0).sum(axis=1)
                order = np.lexsort((total, i))
                i, j, total = i[order], j[order], total[order]
                first = np.flatnonzero(np.diff(i, prepend=-1))
                least_cost[i[first]], next_chart[i[first]] = total[first], j[first]
            cost = np.where(self._is_clear(charts.centers, k), least_cost, np.inf)
            back_pointers.append(next_chart)
        if not np.isfinite(cost).any():
            return None
        chart = int(cost.argmin())
        path = [layers[0].centers[chart]]
        for k, next_chart in enumerate(reversed(back_pointers)):
            chart = int(next_chart[chart])
            path.append(path[-1] + self.space.difference(layers[k + 1].centers[chart], path[-1]))
        return np.array(path)

    def _is_clear(self, joints: Array, k: int) -> NDArray[np.bool_]:
        """Return which configurations (N, n) of a time sample satisfy joint limits and clearance. Shape (N,)."""
        valid, scene = self.space.within(joints), self.scene
        if scene is not None:
            distances = distances_along(scene, np.zeros(0), joints[valid], self.times[k], cutoff=scene.clearance)
            valid[valid] = (distances >= scene.clearance).all(axis=1)
        return valid

    def _shorten(self, path: Array | None, layers: list[Charts]) -> Array | None:
        """Shorten a path on the manifolds unless that makes it invalid; return None if it still exceeds step limits."""
        if path is None:
            return None
        if self.start is None:
            radius = max(float(charts.radii.max()) for charts in layers)
            problem = PathProblem(self.samples, self._steps, self.space.lower, self.space.upper, self.scene)
            shortened = shorten_path(path, problem, (radius / 2, radius / 64))
            valid = all(self._project(k, joints) is not None for k, joints in enumerate(shortened))
            path = shortened if valid else path
        return path if (np.abs(np.diff(path, axis=0)) <= self.limits + TOLERANCE).all() else None

    def split_charts(self, charts: Charts, k: int) -> Charts:
        """Return manifold charts of half the radius that replace the given charts of a time sample."""
        return self._split(charts, k).charts

    def _split(self, charts: Charts, k: int) -> SplitCharts:
        if not charts.tangents.shape[2]:
            return SplitCharts(charts, np.arange(len(charts)), charts.low, charts.high)
        numbered = replace(charts, layer=np.full(len(charts), self.samples[k].row))
        return self.samples[k].manifolds.split(numbered)

    def _refine(
        self, charts: Charts, k: int, values: QuadraticBounds, chosen: NDArray[np.bool_]
    ) -> tuple[Charts, QuadraticBounds]:
        """Halve chosen charts; return all charts not entirely in collision, and lower bounds of the cost on them."""
        rows = np.flatnonzero(chosen)
        halves = self._split(charts.select(rows), k)
        free = self._collision_free(halves.charts, k)
        part, low, high = values.select(rows[halves.owners[free]]), halves.low[free], halves.high[free]
        part = QuadraticBounds.constant(part.minimum(low, high)[0], low.shape[1])
        kept, others = charts.select(~chosen), values.select(~chosen)
        together = QuadraticBounds(*(np.concatenate(pair) for pair in zip(part, others, strict=True)))
        return concatenate([halves.charts.select(free), kept]), together
