"""Ways with the fewest reconfigurations: in how few pieces motions come through all instants, and which are cheapest.

Where no motion goes on the arm has to leave the way, and to come back to the next instant in any posture that does the
task there. What can be done in one piece can be done from a later instant on, too, and until an earlier one; so pieces
that each go as far as they can are the fewest, and those followed back from the end tell how early each may begin. Of
all places between, the cheapest are found best first: pieces cost at least what values on charts say, and are searched
one by one until none that is left can be cheaper. Fewest first, then cheapest, as of IKLink (Wang and others 2024).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from models.arrays import Array
from ocp.planning.search import Search

__all__ = ["Piece", "fewest_pieces"]

SEARCHED = 40
"""Pieces at most: beyond that the best that is known is taken, and the bound stays what it is."""
NEAR = 0.005
"""Share of the cost by which what is left would have to be cheaper."""


class Piece(NamedTuple):
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


def fewest_pieces(search: Search) -> tuple[list[Piece], float] | None:
    """The cheapest of the fewest pieces through all instants, one after the other, and what none cost less than.

    Returns:
        None where some instant has no posture that is found, in a piece of its own.
    """
    last = len(search.times) - 1
    ends, starts = list[int](), list[int]()
    while not ends or ends[-1] < last:
        end = _farthest(search, ends[-1] + 1 if ends else 0)
        if end is None:
            return None
        ends.append(end)
    while not starts or starts[-1] > 0:
        start = _farthest(search, starts[-1] - 1 if starts else last, back=True)
        if start is None or len(starts) > len(ends):
            return None
        starts.append(start)
    # where each piece may begin and end; the other way round fewer could only have been missed
    first = [0, *starts[::-1][1:]] if len(starts) == len(ends) else [0, *(end + 1 for end in ends[:-1])]
    begins = [range(first[m], (ends[m - 1] + 1 if m else 0) + 1) for m in range(len(ends))]
    stops = [range(begins[m + 1][0] - 1, ends[m] + 1) for m in range(len(ends) - 1)] + [range(last, last + 1)]
    least = _bounds(search, begins, stops)
    known = dict[tuple[int, int], Piece | None]()
    for _ in range(SEARCHED):
        chain, total = _cheapest(begins, stops, {**least, **{key: _cost(one) for key, one in known.items()}})
        found = _cheapest(begins, stops, {key: _cost(one) for key, one in known.items()})[1]
        missing = [key for key in chain if key not in known]
        if not missing or total >= (1 - NEAR) * found:
            break
        for key in missing:
            known[key] = _piece(search, *key)
    chain, total = _cheapest(begins, stops, {key: _cost(one) for key, one in known.items()})
    if not np.isfinite(total):
        return None
    told = {key: (np.inf if one is None else one.bound) for key, one in known.items()}
    return [one for key in chain if (one := known[key]) is not None], _cheapest(begins, stops, {**least, **told})[1]


def _cost(piece: Piece | None) -> float:
    return np.inf if piece is None else piece.cost


def _piece(search: Search, first: int, last: int) -> Piece | None:
    """The cheapest motion from one instant to another; None where none was found."""
    part = search.part(first, last)
    joints, bound = part.best(np.inf)
    return None if joints is None else Piece(first, last, joints, part.steps(joints), bound)


def _farthest(search: Search, start: int, back: bool = False) -> int | None:
    """The last instant, or the first one, that motions from one lead to; None where not even that one is kept."""

    def leads(other: int) -> bool:
        return search.part(min(start, other), max(start, other)).first(np.inf)[1] is not None

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


def _bounds(search: Search, begins: list[range], stops: list[range]) -> dict[tuple[int, int], float]:
    """What pieces cost at least, by their first and last instants; those that cannot be left out."""
    found = dict[tuple[int, int], float]()
    for own, ends in zip(begins, stops, strict=True):
        if len(ends) == 1:  # from the end
            graph = search.part(own[0], ends[0]).whole_graph()
            values = graph.to_come()
            found |= {(k, ends[0]): float(graph.least(values[k - own[0]], k - own[0]).min()) for k in own}
            continue
        for first in own:
            graph = search.part(first, ends[-1]).whole_graph()
            values = graph.passed()
            found |= {(first, k): float(graph.least(values[k - first], k - first).min()) for k in ends if k >= first}
    return found


def _cheapest(
    begins: list[range], stops: list[range], costs: dict[tuple[int, int], float]
) -> tuple[list[tuple[int, int]], float]:
    """The chain of pieces of least cost, and that cost; none and inf where there is no chain."""
    best: dict[int, tuple[float, list[tuple[int, int]]]] = {begins[0][0]: (0.0, [])}
    for own, ends in zip(begins, stops, strict=True):
        after: dict[int, tuple[float, list[tuple[int, int]]]] = {}
        for first in own:
            for last in ends:
                if first in best and np.isfinite(cost := costs.get((first, last), np.inf)):
                    total = best[first][0] + cost
                    if total < after.get(last + 1, (np.inf,))[0]:
                        after[last + 1] = total, [*best[first][1], (first, last)]
        best = after
    total, chain = min(best.values(), key=lambda one: one[0], default=(np.inf, []))
    return chain, total
