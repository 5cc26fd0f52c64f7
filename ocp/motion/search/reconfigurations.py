"""Ways with the fewest reconfigurations: in how few pieces motions come through all instants, and which are cheapest.

Where no motion goes on the arm has to leave the way, and to come back to it in any posture that does the task there: to
the next instant, where the instants are all there is, or to that which it left, where they stand for a time that runs
on. What can be done in one piece can be done from a later instant on, too, and until an earlier one; so pieces that
each go as far as they can are the fewest, and those followed back from the end tell how early each may begin. Of all
places between, the cheapest are found best first: pieces cost at least what values on charts say, and are searched one
by one until none that is left can be cheaper. Fewest first, then cheapest, as of IKLink (Wang and others 2024).

Ways where two directions are free, beside postures in which one joint has one of some values.

The postures at an instant form surfaces, which are too many charts for an arm of eight joints. Where one joint is held
they are curves. Such curves at several values of it lie close enough together for steps to lead from one to another, so
that ways on which the joint moves are found as well; drawn tight through the surfaces they leave the curves. Nothing is
proven by this, and no bound comes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from models.arrays import Array
from ocp.motion.search.charts import Charts, Parts, SelfMotionManifolds
from ocp.motion.search.joint_space import FULL_TURN, TasksWithFixedJoints
from ocp.motion.search.search import AtlasSearch

__all__ = ["SectionSearch", "SectionSettings", "Segment", "Span", "farthest", "fewest_segments", "section_values"]

Span = tuple[int, int]
"""First and last instant of a piece."""


@dataclass(frozen=True)
class SegmentSettings:
    """How long it is looked for the cheapest of the fewest pieces.

    Attributes:
        searched: Chains at most: beyond that the best that is known is taken, and the bound stays what it is.
        gap: Share of the cost by which what is left would have to be cheaper.
    """

    searched: int = 40
    gap: float = 0.005


class Segment(NamedTuple):
    """A motion from one instant to another.

    Attributes:
        first, last: Numbers of its instants. joints: There. Shape (last - first + 1, n).
        cost: Of its steps. bound: What no motion's steps cost less than.
    """

    first: int
    last: int
    joints: Array
    cost: float
    bound: float


def fewest_segments(
    search: AtlasSearch, gap: int = 1, barred: Collection[Span] = (), settings: SegmentSettings = SegmentSettings()
) -> tuple[list[Segment], float] | None:
    """The cheapest of the fewest pieces through all instants, one after the other, and what none cost less than.

    Args:
        gap: From the last instant of a piece to the first of the next: 1; or 0, of instants of a time that runs on.
        barred: What is known not to be done in one piece, nor is what it is a part of.
        settings: How long it is looked for the cheapest.

    Returns:
        None where nothing goes on somewhere: with a gap where an instant has no posture that is found, in a piece of
        its own.
    """
    ranges = _ranges(search, gap, barred)
    if ranges is None:
        return None
    least = {span: cost for span, cost in _bounds(search, *ranges).items() if not _without(span, gap, barred)}
    known = dict[Span, Segment | None]()

    def cheapest(bounded: bool, bounds: bool = False) -> tuple[list[Span], float]:
        """The cheapest chain of what is known, by its costs or bounds; with the bounds of all else, or without."""
        own = {key: np.inf if one is None else one.bound if bounds else one.cost for key, one in known.items()}
        return _cheapest(*ranges, gap, (least if bounded else {}) | own)

    for _ in range(settings.searched):
        chain, total = cheapest(True)
        missing = [key for key in chain if key not in known]
        if not missing or total >= (1 - settings.gap) * cheapest(False)[1]:
            break
        known |= {key: _piece(search, *key) for key in missing}
    chain, total = cheapest(False)
    if not np.isfinite(total):
        return None
    return [one for key in chain if (one := known[key]) is not None], cheapest(True, bounds=True)[1]


def _ranges(search: AtlasSearch, gap: int, barred: Collection[Span]) -> tuple[list[range], list[range]] | None:
    """Where each of the fewest pieces may begin and end; None where nothing goes on somewhere.

    Pieces that each go as far as they can tell how late each may end, those followed back how early it may begin.
    """
    last = len(search.times) - 1
    ends, starts = farthest(search, gap, barred), list[int]()
    if not ends or ends[-1] < last:
        return None
    while not starts or starts[-1] > 0:
        start = _farthest(search, starts[-1] - gap if starts else last, barred, back=True)
        if start is None or len(starts) > len(ends):
            return None
        starts.append(start)
    # the other way round fewer could only have been missed
    first = [0, *starts[::-1][1:]] if len(starts) == len(ends) else [0, *(end + gap for end in ends[:-1])]
    begins = [range(first[m], (ends[m - 1] + gap if m else 0) + 1) for m in range(len(ends))]
    stops = [range(begins[m + 1][0] - gap, ends[m] + 1) for m in range(len(ends) - 1)] + [range(last, last + 1)]
    return begins, stops


def farthest(search: AtlasSearch, gap: int = 1, barred: Collection[Span] = (), ruled_out: bool = False) -> list[int]:
    """The last instants of pieces that each go as far as they can: the last of all, or where nothing goes on.

    Args:
        gap, barred: As of `fewest_segments`.
        ruled_out: Whether a piece ends only where the search shows that no motion goes on, under its assumptions;
            else where it finds none. So none are fewer.
    """
    last, ends = len(search.times) - 1, list[int]()
    while not ends or ends[-1] < last:
        start = ends[-1] + gap if ends else 0
        end = _farthest(search, start, barred, ruled_out=ruled_out)
        if end is None or (end == start and not gap and last):
            break
        ends.append(end)
    return ends


def _without(span: Span, gap: int, barred: Collection[Span]) -> bool:
    """Whether there is no such piece: it goes nowhere, or a part of it is barred."""
    return (span[0] == span[1] and not gap) or any(span[0] <= one[0] and one[1] <= span[1] for one in barred)


def _piece(search: AtlasSearch, first: int, last: int) -> Segment | None:
    """The cheapest motion from one instant to another; None where none was found."""
    part = search.part(first, last)
    joints, bound = part.best(np.inf)
    return None if joints is None else Segment(first, last, joints, part.steps(joints), bound)


def _farthest(
    search: AtlasSearch, start: int, barred: Collection[Span], back: bool = False, ruled_out: bool = False
) -> int | None:
    """The last instant, or the first one, that motions from one lead to; None where not even that one is kept."""

    def leads(other: int) -> bool:
        span = min(start, other), max(start, other)
        if _without(span, 1, barred):
            return False
        layers, path = search.part(*span).first(np.inf)
        return bool(layers) if ruled_out else path is not None

    way = -1 if back else 1
    most = (start if back else len(search.times) - 1 - start) if len(search.times) > 1 else 0
    # as far as charts say it cannot be farther; twice as far each time, then in halves
    good, bad, step = -1, most + 1, 0
    while good < most and bad > most:
        if leads(start + way * step):
            good, step = step, min(max(2 * step, 1), most)
        else:
            bad = step
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if leads(start + way * middle) else (good, middle)
    return None if good < 0 else start + way * good


def _bounds(search: AtlasSearch, begins: list[range], stops: list[range]) -> dict[Span, float]:
    """What pieces cost at least, by their first and last instants; those that cannot be left out."""
    found = dict[Span, float]()
    for own, ends in zip(begins, stops, strict=True):
        if len(ends) == 1:  # from the end
            graph = search.part(own[0], ends[0]).whole_graph()
            values = graph.cost_to_go()
            found |= {(k, ends[0]): float(graph.least(values[k - own[0]], k - own[0]).min()) for k in own}
            continue
        for first in own:
            graph = search.part(first, ends[-1]).whole_graph()
            values = graph.passed()
            found |= {(first, k): float(graph.least(values[k - first], k - first).min()) for k in ends if k >= first}
    return found


def _cheapest(begins: list[range], stops: list[range], gap: int, costs: dict[Span, float]) -> tuple[list[Span], float]:
    """The chain of pieces of least cost, and that cost; none and inf where there is no chain."""
    best: dict[int, tuple[float, list[Span]]] = {begins[0][0]: (0.0, [])}
    for own, ends in zip(begins, stops, strict=True):
        after: dict[int, tuple[float, list[Span]]] = {}
        for first in own:
            for last in ends:
                if first in best and np.isfinite(cost := costs.get((first, last), np.inf)):
                    total = best[first][0] + cost
                    if total < after.get(last + gap, (np.inf,))[0]:
                        after[last + gap] = total, [*best[first][1], (first, last)]
        best = after
    total, chain = min(best.values(), key=lambda one: one[0], default=(np.inf, []))
    return chain, total


@dataclass(frozen=True)
class SectionSettings:
    """Which curves are covered.

    Attributes:
        radii: Of the charts at few instants, and at many, rad or m.
        apart: From one value of the joint to the next, at most: of one that slides, m, and of one that turns, rad.
        values: Of the joint, at most.
        charts: Of all instants and values together, of which no steps are kept.
    """

    radii: tuple[float, float] = (0.07, 0.14)
    apart: tuple[float, float] = (0.1, 0.6)
    values: int = 64
    charts: int = 80_000


def section_values(
    slides: bool, lower: float, upper: float, far: float, settings: SectionSettings = SectionSettings()
) -> Array:
    """At which a joint is held: its limits and between, or all round. Shape (V,), rad or m.

    Args:
        slides: Whether it does. far: How far it may go from one instant to the next: values are no farther apart.
    """
    low, high = np.clip((lower, upper), -np.pi, np.pi).tolist()
    count = int(np.ceil(min((high - low) / min(settings.apart[not slides], far), settings.values - 1.0)))
    if not slides and high - low >= FULL_TURN - 1e-6:
        return np.linspace(low, high, max(count, 1), endpoint=False)
    return np.linspace(low, high, count + 1)


class SectionSearch(AtlasSearch):
    """The search for ways beside postures in which one joint has one of some values."""

    def __init__(self, *told: Any, joint: int, values: Array, radius: float, charts: int, **more: Any) -> None:
        """
        Args:
            told, more: As of `AtlasSearch`; the instants all of one set of postures with two directions free.
            joint: The number of the joint. values: At which it is held. Shape (V,).
            radius: Of the charts, at most. charts: Their number, at most.
        """
        self._joint, self._values, self._radius, self._most = joint, values, radius, charts
        super().__init__(*told, **more)

    def _cover(self, seeds: Callable[[int], Array]) -> list[Charts]:
        """Charts of the curves of each instant, none where no seed leads to one; numbered by values, then instants."""
        whole, count = self.instants[0].sets, len(self.instants)
        numbers, each = [instant.number for instant in self.instants], len(self._values)
        targets = np.tile(whole.targets[numbers], (each, 1))
        others = whole.equations.held if isinstance(whole.equations, TasksWithFixedJoints) else ()
        held = TasksWithFixedJoints(whole.equations.machine, whole.equations.bound, (*others, self._joint))
        self._curves = SelfMotionManifolds(self.space, held, np.column_stack([targets, np.repeat(self._values, count)]))
        found = [seeds(k) for k in range(count)]
        own = np.repeat(np.arange(count), [len(some) for some in found])
        layer = (own + count * np.arange(each)[:, None]).ravel()
        joints, good = self._curves.corrected(layer, np.tile(np.concatenate(found), (each, 1)))
        good &= self.space.within(joints)
        charts = self._curves.cover(layer[good], joints[good], self._radius, self._most)
        return [charts.of(charts.layer % count == k) for k in range(count)]

    def _parts(self, charts: Charts, k: int) -> Parts:
        return self._curves.parts(charts)

    def ways(self) -> tuple[list[Array], float]:
        """Of the cheapest way that is found, and of the cheapest on which the joint keeps each of its values."""
        count = len(self.instants)
        found = [path for path in (self.first(np.inf)[1],) if path is not None]
        for value in range(len(self._values)):
            own = copy(self)
            own.layers = [charts.of(charts.layer // count == value) for charts in self.layers]
            if all(len(charts) for charts in own.layers):
                path = own._tight(own._through_centers(own.whole_graph()), own.layers)
                found += [path] if path is not None else []
        return sorted(found, key=self.steps), 0.0
