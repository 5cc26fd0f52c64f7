"""Paths with the fewest reconfigurations, and paths on sections of the self-motion manifold with one joint fixed.

Where a motion cannot be continued, the arm has to leave the task and come back to it in any configuration that does the
task: at the next time sample, if the samples are all there is, or at the same one if they stand for a continuous time.
Any part of a segment is feasible as well. Greedily extended segments are therefore the fewest, and greedy
segments from the end give the earliest start of each. Among all divisions, the one of least cost is found best first:
the bounds of the cost-to-go bound the cost of a segment, and segments are searched one by one until no other division
can cost less. Their number is minimised first, then the cost, as in IKLink (Wang et al. 2024).

If a task leaves two degrees of freedom undetermined, the manifold at a time sample is a surface, which takes too many
charts for an arm of eight joints. With one joint fixed it is a curve (a section), with three directions and two joints
as well. The curves for several values of the joints are close enough for steps between them, so that paths on which the
joints move are found too; shortened on the whole manifolds, they leave the curves. This proves nothing and gives no
bound.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from models.checks import Array
from ocp.motion.search.charts import Charts, SelfMotionManifolds, SplitCharts
from ocp.motion.search.joint_space import FULL_TURN, TasksWithFixedJoints
from ocp.motion.search.search import AtlasSearch

Span = tuple[int, int]
"""Indices of the first and the last time sample of a segment."""


MAX_DIVISIONS = 40
"""Largest number of divisions of a path into segments that are evaluated; then the best known one is taken."""
DIVISION_GAP = 0.005
"""Relative cost reduction by another division that must still be possible for the search to continue."""


class Segment(NamedTuple):
    """Path from one time sample to another, without a reconfiguration.

    Attributes:
        first, last: Indices of the samples.
        joints: Configurations at the samples. Shape (last - first + 1, n).
        cost: Cost of the steps.
        bound: Lower bound of the cost of any path between the samples.
    """

    first: int
    last: int
    joints: Array
    cost: float
    bound: float


def fewest_segments(
    search: AtlasSearch, gap: int = 1, barred: Collection[Span] = ()
) -> tuple[list[Segment], float] | None:
    """Cover all time samples by the fewest segments, at minimum cost; return the segments and a lower cost bound.

    Args:
        gap: Samples from the end of a segment to the start of the next one: 1, or 0 if the samples stand for a
            continuous time.
        barred: Spans of samples that are known to be infeasible in one segment, as is any span that contains them.

    Returns:
        None if the motion cannot be continued somewhere. With gap 1, a sample without a configuration is a segment of
        its own.
    """
    ranges = _segment_ranges(search, gap, barred)
    if ranges is None:
        return None
    bounds = _segment_bounds(search, *ranges).items()
    lower_bounds = {span: bound for span, bound in bounds if not _is_barred(span, gap, barred)}
    segments = dict[Span, Segment | None]()

    def best_chain(bounded: bool, bounds: bool = False) -> tuple[list[Span], float]:
        """Return the lowest-cost chain of adjoining segments, by costs or, with `bounds`, by lower bounds of costs.

        Segments not solved yet count with their lower bounds if `bounded`, and are left out otherwise.
        """
        costs = {span: np.inf if s is None else s.bound if bounds else s.cost for span, s in segments.items()}
        return _best_chain(*ranges, gap, (lower_bounds if bounded else {}) | costs)

    for _ in range(MAX_DIVISIONS):
        chain, total = best_chain(True)
        missing = [span for span in chain if span not in segments]
        if not missing or total >= (1 - DIVISION_GAP) * best_chain(False)[1]:
            break
        segments |= {span: _solve_segment(search, *span) for span in missing}
    chain, total = best_chain(False)
    if not np.isfinite(total):
        return None
    return [segment for span in chain if (segment := segments[span]) is not None], best_chain(True, bounds=True)[1]


def _segment_ranges(search: AtlasSearch, gap: int, barred: Collection[Span]) -> tuple[list[range], list[range]] | None:
    """Return the samples where each of the fewest segments may start and end; None if no path was found.

    Segments extended greedily forwards give the latest ends, those extended backwards the earliest starts.
    """
    last = len(search.times) - 1
    ends, starts = segment_ends(search, gap, barred), list[int]()
    if not ends or ends[-1] < last:
        return None
    while not starts or starts[-1] > 0:
        start = _last_reachable(search, starts[-1] - gap if starts else last, barred, back=True)
        if start is None or len(starts) > len(ends):
            return None
        starts.append(start)
    # backwards, fewer segments can only result from a miss of the forward search
    earliest = [0, *starts[::-1][1:]] if len(starts) == len(ends) else [0, *(end + gap for end in ends[:-1])]
    start_ranges = [range(earliest[m], (ends[m - 1] + gap if m else 0) + 1) for m in range(len(ends))]
    end_ranges = [range(start_ranges[m + 1][0] - gap, ends[m] + 1) for m in range(len(ends) - 1)]
    end_ranges.append(range(last, last + 1))
    return start_ranges, end_ranges


def segment_ends(
    search: AtlasSearch, gap: int = 1, barred: Collection[Span] = (), ruled_out: bool = False
) -> list[int]:
    """Return the last time sample of each segment if segments are extended as far as possible one by one.

    The list ends with the last sample of all, or with the one from which the motion cannot be continued.

    Args:
        gap, barred: As in `fewest_segments`.
        ruled_out: Whether a segment ends only where the search proves, under its assumptions, that it cannot be
            extended. The number of segments is then a lower bound. Otherwise it ends where the search finds no
            extension.
    """
    last, ends = len(search.times) - 1, list[int]()
    while not ends or ends[-1] < last:
        start = ends[-1] + gap if ends else 0
        end = _last_reachable(search, start, barred, ruled_out=ruled_out)
        if end is None or (end == start and not gap and last):
            break
        ends.append(end)
    return ends


def _is_barred(span: Span, gap: int, barred: Collection[Span]) -> bool:
    """Return whether no segment can cover a span of samples, because it is empty or contains an infeasible span."""
    return (span[0] == span[1] and not gap) or any(span[0] <= bar[0] and bar[1] <= span[1] for bar in barred)


def _solve_segment(search: AtlasSearch, first: int, last: int) -> Segment | None:
    """Return the lowest-cost segment between two time samples; None if no segment was found."""
    part = search.restrict(first, last)
    joints, bound = part.solve(np.inf)
    return None if joints is None else Segment(first, last, joints, part.path_cost(joints), bound)


def _last_reachable(
    search: AtlasSearch, start: int, barred: Collection[Span], back: bool = False, ruled_out: bool = False
) -> int | None:
    """Return the farthest time sample that a path from `start` reaches, or None; `back` searches backwards in time."""

    def reaches(sample: int) -> bool:
        span = min(start, sample), max(start, sample)
        if _is_barred(span, 1, barred):
            return False
        layers, path = search.restrict(*span).find_path(np.inf)
        return bool(layers) if ruled_out else path is not None

    direction = -1 if back else 1
    max_steps = (start if back else len(search.times) - 1 - start) if len(search.times) > 1 else 0
    # double the distance while a segment reaches it, then bisect
    reachable, unreachable, step = -1, max_steps + 1, 0
    while reachable < max_steps and unreachable > max_steps:
        if reaches(start + direction * step):
            reachable, step = step, min(max(2 * step, 1), max_steps)
        else:
            unreachable = step
    while unreachable - reachable > 1:
        middle = (reachable + unreachable) // 2
        reachable, unreachable = (middle, unreachable) if reaches(start + direction * middle) else (reachable, middle)
    return None if reachable < 0 else start + direction * reachable


def _segment_bounds(search: AtlasSearch, start_ranges: list[range], end_ranges: list[range]) -> dict[Span, float]:
    """Return lower bounds of segment costs by first and last sample; segments without a path may be missing."""
    bounds = dict[Span, float]()
    for starts, ends in zip(start_ranges, end_ranges, strict=True):
        if len(ends) == 1:  # one backward sweep serves all starts
            graph = search.restrict(starts[0], ends[0]).graph()
            values = graph.cost_to_go()
            bounds |= {(k, ends[0]): float(graph.minima(values[k - starts[0]], k - starts[0]).min()) for k in starts}
            continue
        for first in starts:
            graph = search.restrict(first, ends[-1]).graph()
            values = graph.cost_to_come()
            bounds |= {(first, k): float(graph.minima(values[k - first], k - first).min()) for k in ends if k >= first}
    return bounds


def _best_chain(
    start_ranges: list[range], end_ranges: list[range], gap: int, costs: dict[Span, float]
) -> tuple[list[Span], float]:
    """Return the chain of adjoining segments of least total cost, and this cost; [] and inf if there is no chain."""
    best: dict[int, tuple[float, list[Span]]] = {start_ranges[0][0]: (0.0, [])}
    for starts, ends in zip(start_ranges, end_ranges, strict=True):
        after: dict[int, tuple[float, list[Span]]] = {}
        for first in starts:
            for last in ends:
                if first in best and np.isfinite(cost := costs.get((first, last), np.inf)):
                    total = best[first][0] + cost
                    if total < after.get(last + gap, (np.inf,))[0]:
                        after[last + gap] = total, [*best[first][1], (first, last)]
        best = after
    total, chain = min(best.values(), key=lambda entry: entry[0], default=(np.inf, []))
    return chain, total


@dataclass(frozen=True)
class SectionSettings:
    """Settings of the sections of self-motion manifolds: curves on which one joint has a fixed position.

    Attributes:
        radii: Radii of the charts for few and for many samples, rad or m.
        spacing: Largest difference between values of a joint: prismatic, m, and revolute, rad.
        values: Largest number of values of the joint, or of combinations of values of several joints.
        charts: Largest number of charts, over all samples and values.
    """

    radii: tuple[float, float] = (0.07, 0.14)
    spacing: tuple[float, float] = (0.1, 0.6)
    values: int = 64
    charts: int = 80_000


def section_values(
    prismatic: bool, lower: float, upper: float, max_step: float, *, settings: SectionSettings = SectionSettings()
) -> Array:
    """Return evenly spaced joint positions at which a self-motion manifold is cut. Shape (V,), rad or m.

    Args:
        prismatic: Whether the joint is prismatic.
        lower, upper: Its limits.
        max_step: Its largest step between samples, which bounds the spacing.
    """
    low, high = np.clip((lower, upper), -np.pi, np.pi).tolist()
    count = int(np.ceil(min((high - low) / min(settings.spacing[not prismatic], max_step), settings.values - 1.0)))
    if not prismatic and high - low >= FULL_TURN - 1e-6:
        return np.linspace(low, high, max(count, 1), endpoint=False)
    return np.linspace(low, high, count + 1)


class SectionSearch(AtlasSearch):
    """Search for paths on sections of the self-motion manifolds; on each section, some joints have fixed positions."""

    def __init__(
        self, *args: Any, joints: tuple[int, ...], values: Array, radius: float, charts: int, **options: Any
    ) -> None:
        """Build charts, at all time samples, of the sections of the self-motion manifolds with given joints fixed.

        Args:
            args, options: As in `AtlasSearch`; all samples must belong to one `SelfMotionManifolds`, of one dimension
                more than there are joints.
            joints: Indices of the joints.
            values: Values at which they are fixed. Shape (V, joints).
            radius: Largest radius of the charts.
            charts: Largest number of charts.
        """
        self._joints, self._values, self._radius, self._max_charts = joints, values, radius, charts
        super().__init__(*args, **options)

    def _build_atlas(self, seeds: Callable[[int], Array]) -> list[Charts]:
        """Return, for each time sample, charts of the curves that remain of the manifold if given joints are fixed."""
        manifolds, count = self.samples[0].manifolds, len(self.samples)
        indices, value_count = [sample.row for sample in self.samples], len(self._values)
        targets = np.tile(manifolds.targets[indices], (value_count, 1))
        fixed = manifolds.equations.fixed if isinstance(manifolds.equations, TasksWithFixedJoints) else ()
        fixed = (*fixed, *self._joints)
        equations = TasksWithFixedJoints(manifolds.equations.machine, manifolds.equations.bound, fixed)
        targets = np.column_stack([targets, np.repeat(self._values, count, axis=0)])
        self._curves = SelfMotionManifolds(self.space, equations, targets)
        seed_configurations = [seeds(k) for k in range(count)]
        samples = np.repeat(np.arange(count), [len(configurations) for configurations in seed_configurations])
        layer = (samples + count * np.arange(value_count)[:, None]).ravel()
        joints, valid = self._curves.project(layer, np.tile(np.concatenate(seed_configurations), (value_count, 1)))
        valid &= self.space.within(joints)
        charts = self._curves.cover(layer[valid], joints[valid], self._radius, self._max_charts)
        return [charts.select(charts.layer % count == k) for k in range(count)]

    def _split(self, charts: Charts, k: int) -> SplitCharts:
        return self._curves.split(charts)

    def paths(self) -> tuple[list[Array], float]:
        """Return paths across and within sections of the manifolds, by rising cost, and the trivial lower bound 0."""
        count, through_centers = len(self.samples), list[Array]()
        for value in range(len(self._values)):
            restricted = copy(self)
            restricted.layers = [charts.select(charts.layer // count == value) for charts in self.layers]
            if all(len(charts) for charts in restricted.layers):
                path = restricted._path_through_centers(restricted.graph())
                through_centers += [path] if path is not None else []
        best = sorted(through_centers, key=self.path_cost)[: self.settings.max_classes]
        shortened = [self.find_path(np.inf)[1], *(self._shorten(path, self.layers) for path in best)]
        return sorted((path for path in shortened if path is not None), key=self.path_cost), 0.0
