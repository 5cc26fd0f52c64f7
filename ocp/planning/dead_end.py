"""Where no motion does a task: how far the farthest comes, what stops it there, and how far the task has to give.

Postures are followed from the first instant on, one a chart, each to all charts that a step within the limits reaches;
what is held of each is the widest berth of a way to it. The last instant that is reached is where the task ends, and
what stops motions there is seen by going on all the same. A motion that gives way only in what is told is then looked
for from there on: what it needs is no bound, another one may need less.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.builders.clearance import LOOKS, MARGIN, ROUNDING
from ocp.errors import SolveError
from ocp.local.touching import distances_along, touches
from ocp.planning.charts import Charts
from ocp.planning.search import MOST, Search

__all__ = ["DeadEnd", "Give", "Stop", "dead_end"]

Indices = NDArray[np.intp]

TRIED = 3
"""Postures from which each chart is tried to be reached; and stops that are told in words."""
WHOLE = 1e-9
"""rad or m: limits are kept up to this."""
KINDS = {"deviation": "the tip may be {0:.3g} m off", "lean": "the tip may be turned by {1:.3g} deg"}
SMOOTH = 1e-4
"""m or rad: what the whole roughness of a motion that gives way counts beside how far it does."""
NOTHING = 1e-9
"""m or rad, and (rad/s)^2 s: what counts as none."""
SOLVER = {"print_level": 0, "sb": "yes", "max_iter": 100, "bound_relax_factor": 0.0}


class Stop(NamedTuple):
    """What stops motions where none goes on.

    Attributes:
        kind: "limit" of a joint's position; "step": how far it can go until the next instant; "touch"; "reach"; or
            "narrow": what leads on passes no limit, and was not followed.
        name: The joint; two bodies, "one and other"; or "tip".
        value: What it would be: a position, a way, a distance or a miss, rad or m.
        limit: What it may be.
        before, after: Postures, the last one that is reached and where it would have to go. Shape (n,).
    """

    kind: str
    name: str
    value: float
    limit: float
    before: Array
    after: Array

    @property
    def excess(self) -> float:
        """By how much the limit is passed, rad or m."""
        return abs(self.value - self.limit)

    def __str__(self) -> str:
        return {
            "limit": f"{self.name!r} would pass its limit {self.limit:.4g} by {self.excess:.3g}",
            "step": f"{self.name!r} would have to go {self.value:.3g} in one step, {self.limit:.3g} at most",
            "touch": f"{self.name} would be {self.value:.3g} m apart, {self.limit:.3g} at least",
            "narrow": "what leads on is too narrow to be followed",
            "reach": f"the tip stays {self.value:.3g} off from there",
        }[self.kind]


class Give(NamedTuple):
    """A motion that would do the task if it gave way.

    Attributes:
        kind: "deviation" of the tip's place, m; "lean" of its axes, rad; or "clearance", m, which it would have to be.
        amount: How far. times: The instants, s, or numbers of waypoints. Shape (K,). joints: There. Shape (K, n).
    """

    kind: str
    amount: float
    times: Array
    joints: Array

    def __str__(self) -> str:
        if self.kind == "clearance":
            return f"the clearance is {self.amount:.3g} m"
        return KINDS[self.kind].format(self.amount, np.degrees(self.amount))


class DeadEnd(SolveError):
    """No motion does the tasks, or none was found by a search over all.

    Attributes:
        time: s (the number of a waypoint), from which on none goes on; `until`: the first one that is not reached, nan
            where that is not known.
        name, value, limit: Of the least of the stops; of a machine whose base moves by itself, which may have been
            there in any attitude, of the joint whose limit stops most, where it is, and that limit, else "task".
        stops: What stops motions there, each where it does so by the least, the least first.
        gives: Motions that would do if the task gave way, the least that was found of each kind.
        pieces: In how few pieces it may be done, see `plan_in_pieces`; None where that is not known.
    """

    until: float
    stops: tuple[Stop, ...]
    gives: tuple[Give, ...]
    pieces: int | None

    def __init__(
        self,
        words: str,
        until: float = np.nan,
        stops: tuple[Stop, ...] = (),
        gives: tuple[Give, ...] = (),
        pieces: int | None = None,
        **details: Any,
    ) -> None:
        super().__init__(words, **details)
        self.until, self.stops, self.gives, self.pieces = until, stops, gives, pieces

    def __reduce__(self) -> Any:
        """Pickled with what it is made from, and with its fields."""
        return type(self), (*self.args, self.until, self.stops, self.gives, self.pieces), self.__dict__


def dead_end(search: Search, unit: str = "{:.4g} s", proven: bool = True, pieces: int | None = None) -> DeadEnd | None:
    """Where the motions of a search end; None where one comes through.

    Args:
        unit: How its times are told.
        proven: Whether the search shows that there is none, under its assumptions.
        pieces: As of `DeadEnd`.
    """
    front = _Walk(search)
    last = front.last
    if last == len(search.times) - 1:
        return None
    stops = _stops(search, front)
    worst, gives = stops[0], list[Give]()
    if any(stop.kind == "touch" for stop in stops) and np.isfinite(front.width[-1].max(initial=-np.inf)):
        best = int(front.width[-1].argmax())
        joints = front.way(len(search.times) - 1, best)
        gives.append(Give("clearance", float(front.width[-1][best]), search.times, joints))
    back = _Walk(search, back=True)
    for turning, kind in ((False, "deviation"), (True, "lean")):
        if (give := _given(search, _joined(front, back, stops[0]), turning, kind)) is not None:
            gives.append(give)
    there = unit.format(search.times[last + 1])
    where = (
        f"from {unit.format(search.times[last])} on none goes on to {there}" if last >= 0 else f"none begins at {there}"
    )
    first = "no motion does the tasks" if proven else "no motion was found, though the search does not rule one out"
    words = f"{first}: {where}; {'; '.join(map(str, stops[:TRIED]))}"
    if gives:
        words += f"; one does if {', or '.join(map(str, gives))}"
    if pieces is not None:
        many = "a reconfiguration" if pieces == 2 else f"{pieces - 1} reconfigurations"
        words += f"; with {many} on the way one may: plan_in_pieces"
    told = {"name": worst.name, "value": worst.value, "limit": worst.limit, "time": float(search.times[max(last, 0)])}
    return DeadEnd(words, float(search.times[last + 1]), tuple(stops), tuple(gives), pieces, **told)


class _Walk:
    """Postures that are reached step by step, one a chart.

    Attributes:
        layers: Charts of each instant, no wider than steps, those on which everything touches, too.
        at: Postures. Shapes (N, n). width: How far apart bodies stay on the way to them, at most what is asked,
            m; infinite where nothing is looked at, -inf where none is reached. Shapes (N,).
        parent: Charts that they are reached from. Shapes (N,).
    """

    def __init__(self, search: Search, back: bool = False) -> None:
        self.search = search
        self.order = list(range(len(search.times)))[:: -1 if back else 1]
        self.asked = np.inf if search.surroundings is None else search.surroundings.clearance
        self.layers = _narrow(search)
        count, n = len(self.order), len(search.space.scale)
        self.at = [np.full((len(charts), n), np.nan) for charts in self.layers]
        self.width = [np.full(len(charts), -np.inf) for charts in self.layers]
        self.parent = [np.zeros(len(charts), dtype=np.intp) for charts in self.layers]
        first = self.order[0]
        charts = self.layers[first]
        middle = np.clip(0.0, charts.low, charts.high)
        own = np.arange(len(charts))
        self._reached(first, own, charts.centers + np.einsum("knr,kr->kn", charts.tangents, middle), own, None)
        graph = search.graph(self.layers, np.full(count - 1, np.inf))
        for k, other in zip(self.order[:-1], self.order[1:], strict=True):
            self._gone_on(graph, k, other)

    @property
    def last(self) -> int:
        """The last instant that is reached by what is wide enough, -1 if none."""
        wide = [k for k in self.order if (self.width[k] >= self.asked).any()]
        return wide[-1] if wide else -1

    def way(self, k: int, chart: int) -> Array:
        """Joints from the first instant of the walk to a posture. Shape (K', n)."""
        found = []
        for instant in reversed(self.order[: self.order.index(k) + 1]):
            found.append(self.at[instant][chart])
            chart = int(self.parent[instant][chart])
        return np.array(found[::-1])

    def _gone_on(self, graph: Any, k: int, other: int) -> None:
        """From all postures of an instant to the charts of one beside it, the nearest of the widest first."""
        space, limit = self.search.space, self.search.limits[min(k, other)]
        parts = [(i[np.isfinite(self.at[k][i, 0])], j[np.isfinite(self.at[k][i, 0])]) for i, j in graph.steps(k, other)]
        if not parts:
            return
        i, j = (np.concatenate(part) for part in zip(*parts, strict=True))
        into = self.layers[other].of(j)
        delta = space.difference(into.centers, self.at[k][i])
        place = -np.einsum("pnr,pn->pr", into.tangents, space.scale**2 * delta)
        way = delta + np.einsum("pnr,pr->pn", into.tangents, np.clip(place, into.low, into.high))
        near = (np.abs(way) <= limit + into.most_stray + WHOLE).all(axis=1)
        i, j, way = i[near], j[near], way[near]
        order = np.lexsort((space.length(way), -self.width[k][i], j))
        i, j, way = i[order], j[order], way[order]
        nth = np.arange(len(j)) - np.searchsorted(j, j)
        for trial in range(TRIED):
            chosen = nth == trial
            self._reached(other, j[chosen], self.at[k][i[chosen]] + way[chosen], i[chosen], k)

    def _reached(self, k: int, charts: Indices, joints: Array, parents: Indices, before: int | None) -> None:
        """Hold what does the task and keeps limits, where it is wider than what was held before."""
        search = self.search
        instant, clearance = search.instants[k], self.asked
        if k == 0 and search.start is not None:
            joints, good = np.repeat(search.start[None], len(charts), axis=0), np.ones(len(charts), dtype=bool)
        else:
            joints, good = instant.sets.corrected(np.full(len(charts), instant.number), joints)
            good &= search.space.within(joints)
        width = np.full(len(charts), np.inf)
        if before is not None:
            width = self.width[before][parents]
            way = np.abs(joints - self.at[before][parents])
            good &= (way <= search.limits[min(k, before)] + WHOLE).all(axis=1)
        if search.surroundings is not None:
            wide = width > self.width[k][charts]
            good &= wide
            at = np.flatnonzero(good)
            times = np.full(len(at), search.times[k])
            apart = distances_along(search.surroundings, np.zeros(0), joints[at], times, clearance).min(axis=1)
            width[at] = np.minimum(np.minimum(width[at], apart), clearance)
        good &= width > self.width[k][charts]
        own = charts[good]
        self.at[k][own], self.width[k][own], self.parent[k][own] = joints[good], width[good], parents[good]


def _narrow(search: Search) -> list[Charts]:
    """Charts of all postures, halved until steps cross them or there are as many as memory is for."""
    layers = search.covered
    steps = search.limits.max(axis=1) / 2
    far = np.minimum(np.append(steps, np.inf), np.append(np.inf, steps))
    while True:
        wide = [k for k, charts in enumerate(layers) if len(charts) and (charts.radii > far[k]).any()]
        more = sum((2 ** layers[k].tangents.shape[2] - 1) * len(layers[k]) for k in wide)
        if not more or sum(map(len, layers)) + more > MOST:
            return layers
        layers = [search.halved(charts, k) if k in wide else charts for k, charts in enumerate(layers)]


def _stops(search: Search, front: _Walk) -> list[Stop]:
    """What stops motions at the last instant that is reached, the least first; of each kind and name the least."""
    space, around, last = search.space, search.surroundings, front.last
    names, n = search.instants[0].sets.equations.machine.robot.joint_names, len(space.scale)
    there = last + 1
    wide = front.width[max(last, 0)] >= front.asked if last >= 0 else np.ones(len(front.at[0]), dtype=bool)
    before = front.at[max(last, 0)][wide]
    if last < 0:
        before = front.layers[0].centers
    if not len(before):
        before = front.layers[max(last, 0)].centers
    instant = search.instants[there]
    nearest, on = instant.sets.corrected(np.full(len(before), instant.number), before)
    found = [(before, nearest, on)]
    # postures at the next instant that keep all limits but are too far
    known = front.width[there] >= front.asked
    charts = front.layers[there].of(~known) if last >= 0 else front.layers[there].of(slice(0, 0))
    if len(charts):
        middle = np.clip(0.0, charts.low, charts.high)
        flat = charts.centers + np.einsum("knr,kr->kn", charts.tangents, middle)
        ways, good = instant.sets.corrected(np.full(len(flat), instant.number), flat)
        tree = space.tree(before)
        _, near = tree.query(space.placed(ways))
        own = before[near]
        found.append((own, own + space.difference(ways, own), good))
    before, after, on = (np.concatenate(part) for part in zip(*found, strict=True))
    miss = np.where(on, 0.0, np.abs(instant.sets.linearised(np.full(len(after), instant.number), after)[0]).max(axis=1))
    limit = search.limits[last] if last >= 0 else np.full(n, np.inf)
    over, under, far = after - space.upper, space.lower - after, np.abs(after - before) - limit
    apart = np.full((len(after), 1), np.inf)
    clearance = 0.0
    if around is not None:
        clearance = around.clearance
        apart = distances_along(around, np.zeros(0), after, np.full(len(after), search.times[there]), clearance)
    excess = np.column_stack([miss, over, under, far, clearance - apart])
    excess[~on, 1:] = 0.0
    worst = excess.argmax(axis=1)
    best: dict[tuple[str, str], Stop] = {}
    for row in np.argsort(excess[np.arange(len(worst)), worst], kind="stable").tolist():
        what, column = divmod(int(worst[row]) - 1, n)
        here, next_ = before[row], after[row]
        if excess[row, worst[row]] <= WHOLE:
            continue
        if worst[row] == 0:
            stop = Stop("reach", "tip", float(miss[row]), 0.0, here, next_)
        elif what < 2:
            bound = float((space.upper, space.lower)[what][column])
            stop = Stop("limit", names[column], float(next_[column]), bound, here, next_)
        elif what == 2:
            way = float(abs(next_[column] - here[column]))
            stop = Stop("step", names[column], way, float(limit[column]), here, next_)
        else:
            assert around is not None
            pair = int(worst[row]) - 1 - 3 * n
            stop = Stop("touch", " and ".join(around.labels[pair]), float(apart[row, pair]), clearance, here, next_)
        best.setdefault((stop.kind, stop.name), stop)
    if not best:  # postures go on, but none that was followed
        own = front.layers[there].centers[0] if len(front.layers[there]) else before[0]
        return [Stop("narrow", "tip", 0.0, 0.0, before[0], own)]
    return list(best.values())


# ---- what gives way ----------------------------------------------------------------------------------------------


def _joined(front: _Walk, back: _Walk, stop: Stop) -> Array:
    """Joints at all instants, (K, n): as far as is reached, and from where the end is reached, straight between."""
    space, count, last = front.search.space, len(front.order), max(front.last, 0)
    apart = np.nan_to_num(space.length(front.at[last] - stop.before), nan=np.inf)
    first = front.way(last, int(apart.argmin())) if np.isfinite(apart).any() else stop.before[None]
    known = [k for k in range(count) if (back.width[k] >= back.asked).any()]
    later = min((k for k in known if k >= len(first)), default=count)
    path = np.full((count, len(stop.before)), np.nan)
    path[: len(first)] = first
    if later < count:
        ways = back.at[later].copy()
        ways[back.width[later] < back.asked] = np.nan
        far = np.nan_to_num(space.length(space.difference(ways, first[-1])), nan=np.inf)
        end = back.way(later, int(far.argmin()))[::-1]
        path[later:] = first[-1] + space.difference(end[0], first[-1]) + (end - end[0])
        numbers = np.arange(count)
        blank = np.isnan(path[:, 0])
        for column in path.T:
            column[blank] = np.interp(numbers[blank], numbers[~blank], column[~blank])
    else:
        path[len(first) :] = first[-1]
    return path


def _given(search: Search, path: Array, turning: bool, kind: str) -> Give | None:
    """A motion like one of joints (K, n) whose tips are off in places, or turned, by as little as is found; else None.

    All else is done, at the instants, limits are kept and everything is clear.
    """
    if not any((sets.equations.turning == turning).any() for sets in {instant.sets for instant in search.instants}):
        return None
    around, pairs = search.surroundings, list[int]()
    for _ in range(LOOKS):
        program = _Giving(search, turning, pairs)
        rough = program.solved(path, None)  # row by row, which is smooth where nothing gives way
        if rough is None:
            return None
        made = program.solved(rough, max(program.amount(rough), NOTHING))
        path = rough if made is None else made
        missing = [] if around is None else [touch.pair for touch in touches(around, np.zeros(0), path, search.times)]
        if not missing:
            return Give(kind, program.amount(path), search.times, path)
        if set(missing) <= set(pairs):
            return None
        pairs = sorted({*pairs, *missing})
    return None


class _Giving:
    """The motion through all instants whose tips are off in places, or turned, by the least, some pairs held apart."""

    def __init__(self, search: Search, turning: bool, pairs: list[int]) -> None:
        self.search, self.turning = search, turning
        count, n = len(search.times), len(search.space.scale)
        self.shape = count, n
        self.joints = ca.MX.sym("joints", n, count)
        rest, rows, sizes = list[ca.MX](), list[ca.MX](), list[ca.MX]()
        if search.start is not None:
            rest.append(self.joints[:, 0] - search.start)
        for sets in dict.fromkeys(instant.sets for instant in search.instants):
            own = [k for k, instant in enumerate(search.instants) if instant.sets is sets]
            own = own[int(search.start is not None and own[0] == 0) :]
            if not own:
                continue
            q, wanted = ca.SX.sym("q", n), ca.SX.sym("wanted", sets.targets.shape[1])
            error, rows_turn = sets.equations.error(ca.SX(0, 1), q, wanted), sets.equations.turning
            gives = np.append(rows_turn == turning, np.zeros(sets.equations.size - len(rows_turn), dtype=bool))
            ends = np.cumsum([0, *(part.task.size for part in sets.equations.bound)]).tolist()
            parts = [a + np.flatnonzero(gives[a:b]) for a, b in pairwise(ends)]
            each = ca.vertcat(*(ca.sumsqr(error[part.tolist()]) for part in parts if part.size))
            wholes = [error[np.flatnonzero(chosen).tolist()] for chosen in (~gives, gives)]
            errors = ca.Function("errors", [q, wanted], [*wholes, each]).map(len(own))
            targets = sets.targets[[search.instants[k].number for k in own]].T
            for found, part in zip((rest, rows, sizes), errors(self.joints[:, own], targets), strict=True):
                found.append(ca.vec(part))
        self._rest, self._rows, self._sizes = (ca.vertcat(ca.MX(0, 1), *part) for part in (rest, rows, sizes))
        self._size = ca.Function("size", [self.joints], [ca.mmax(self._sizes)])
        self._apart = ca.MX(0, 1)
        if search.surroundings is not None and pairs:
            q, time = ca.SX.sym("q", n), ca.SX.sym("time")
            apart = search.surroundings.distances(ca.SX(0, 1), q, time, pairs=pairs, rounding=ROUNDING)
            apart = ca.Function("apart", [q, time], [apart]).map(count)(self.joints, search.times[None, :])
            self._apart = ca.vec(apart) - search.surroundings.clearance - MARGIN

    def amount(self, path: Array) -> float:
        """How far the tips of a motion (K, n) are off, m, or turned, rad."""
        most = float(np.sqrt(float(self._size(path.T))))
        return float(np.arcsin(min(most, 1.0))) if self.turning else most

    def solved(self, path: Array, scale: float | None) -> Array | None:
        """Joints (K, n) of the best one near a guess, row by row if no scale is given; None where none is found."""
        search, slack = self.search, ca.MX.sym("slack")
        if scale is None:
            over, first = ca.vertcat(self._rows - slack, -self._rows - slack), 0.1
        else:
            over, first = self._sizes / scale**2 - slack**2, 1.0
        steps = self.joints[:, 1:] - self.joints[:, :-1]
        seconds = np.diff(search.times)
        rough = ca.sum2(ca.sum1(steps**2) / seconds[None, :])
        size = max(float((np.diff(path, axis=0) ** 2 / seconds[:, None]).sum()), NOTHING)
        program = {
            "x": ca.vertcat(ca.vec(self.joints), slack),
            "f": slack + SMOOTH * rough / size,
            "g": ca.vertcat(self._rest, over, self._apart, ca.vec(steps)),
        }
        solver = ca.nlpsol("give", "ipopt", program, {"print_time": False, "ipopt": SOLVER, "error_on_fail": False})
        sizes = [part.numel() for part in (self._rest, over, self._apart)]
        far, space, count = search.limits.ravel(), search.space, self.shape[0]
        found = solver(
            x0=np.append(np.clip(path, space.lower, space.upper).ravel(), first),
            lbx=np.append(np.tile(space.lower, count), 0.0),
            ubx=np.append(np.tile(space.upper, count), np.inf),
            lbg=np.concatenate([np.zeros(sizes[0]), np.full(sizes[1], -np.inf), np.zeros(sizes[2]), -far]),
            ubg=np.concatenate([np.zeros(sizes[0]), np.zeros(sizes[1]), np.full(sizes[2], np.inf), far]),
        )
        if not solver.stats()["success"]:
            return None
        return np.array(found["x"][:-1]).reshape(self.shape)
