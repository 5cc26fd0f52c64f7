"""Where no motion does a task: how far the farthest comes, what stops it there, and how far the task has to give.

Postures are followed from the first instant on, one a chart, each to all charts that a step within the limits reaches;
what is held of each is the widest berth of a way to it. The last instant that is reached is where the task ends, and
what stops motions there is seen by going on all the same. A motion that gives way only in what is told is then looked
for from there on: what it needs is no bound, another one may need less.
"""

from __future__ import annotations

from enum import StrEnum
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.errors import SolveError
from ocp.motion.builders.clearance import LOOKS, MARGIN, ROUNDING
from ocp.motion.local.collisions import distances_along, find_collisions
from ocp.motion.search.charts import Charts
from ocp.motion.search.joint_space import TOLERANCE
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.value import ChartGraph

__all__ = ["DeadEnd", "Obstruction", "Relaxation", "dead_end"]

Indices = NDArray[np.intp]

WORST = 3
"""Postures from which each chart is tried to be reached; and stops that are told in words."""
NEGLIGIBLE = 1e-9
"""m or rad: a motion that gives way by less has not been asked to."""


class ObstructionKind(StrEnum):
    """What stops motions: the position of a joint, how far it can go, bodies, what is out of reach, what is narrow."""

    LIMIT = "limit"
    STEP = "step"
    COLLISION = "collision"
    REACH = "reach"
    NARROW = "narrow"


class RelaxationKind(StrEnum):
    """What gives way: the tip's place, its axes, or the clearance."""

    DEVIATION = "deviation"
    LEAN = "lean"
    CLEARANCE = "clearance"


class Obstruction(NamedTuple):
    """What stops motions where none goes on.

    Attributes:
        kind: A limit of a joint's position; a step, how far it can go until the next instant; bodies that touch; what
            is out of reach; or narrow: what leads on passes no limit, and was not followed.
        name: The joint; two bodies, "one and other"; or "tip".
        value: What it would be: a position, a way, a distance or a miss, rad or m.
        limit: What it may be.
        before, after: Postures, the last one that is reached and where it would have to go. Shape (n,).
    """

    kind: ObstructionKind
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
            ObstructionKind.LIMIT: f"{self.name!r} would pass its limit {self.limit:.4g} by {self.excess:.3g}",
            ObstructionKind.STEP: f"{self.name!r} would have to go {self.value:.3g} in one step, {self.limit:.3g} at most",
            ObstructionKind.COLLISION: f"{self.name} would be {self.value:.3g} m apart, {self.limit:.3g} at least",
            ObstructionKind.NARROW: "what leads on is too narrow to be followed",
            ObstructionKind.REACH: f"the tip stays {self.value:.3g} off from there",
        }[self.kind]


class Relaxation(NamedTuple):
    """A motion that would do the task if it gave way.

    Attributes:
        kind: Deviation of the tip's place, m; lean of its axes, rad; or the clearance, m, which it would have to be.
        amount: How far. times: The instants, s, or numbers of waypoints. Shape (K,). joints: There. Shape (K, n).
    """

    kind: RelaxationKind
    amount: float
    times: Array
    joints: Array

    def __str__(self) -> str:
        return {
            RelaxationKind.DEVIATION: f"the tip may be {self.amount:.3g} m off",
            RelaxationKind.LEAN: f"the tip may be turned by {np.degrees(self.amount):.3g} deg",
            RelaxationKind.CLEARANCE: f"the clearance is {self.amount:.3g} m",
        }[self.kind]


class DeadEnd(SolveError):
    """No motion does the tasks, or none was found by a search over all.

    Attributes:
        time: s (the number of a waypoint), from which on none goes on; `until`: the first one that is not reached, nan
            where that is not known.
        name, value, limit: Of the least of the stops; of a machine whose base moves by itself, which may have been
            there in any attitude, of the joint whose limit stops most, where it is, and that limit, else "task".
        stops: What stops motions there, each where it does so by the least, the least first.
        relaxations: Motions that would do if the task gave way, the least that was found of each kind.
        segments: In how few segments it may be done, see `plan_in_segments`; None where that is not known.
    """

    until: float
    obstructions: tuple[Obstruction, ...]
    relaxations: tuple[Relaxation, ...]
    segments: int | None

    def __init__(
        self,
        words: str,
        until: float = np.nan,
        obstructions: tuple[Obstruction, ...] = (),
        relaxations: tuple[Relaxation, ...] = (),
        segments: int | None = None,
        **details: Any,
    ) -> None:
        super().__init__(words, **details)
        self.until, self.obstructions, self.relaxations, self.segments = until, obstructions, relaxations, segments

    def __reduce__(self) -> Any:
        """Pickled with what it is made from, and with its fields."""
        return type(self), (*self.args, self.until, self.obstructions, self.relaxations, self.segments), self.__dict__


def dead_end(
    search: AtlasSearch, unit: str = "{:.4g} s", proven: bool = True, segments: int | None = None
) -> DeadEnd | None:
    """Where the motions of a search end; None where one comes through.

    Args:
        unit: How its times are told.
        proven: Whether the search shows that there is none, under its assumptions.
        segments: As of `DeadEnd`.
    """
    front = _Walk(search)
    last = front.last
    if last == len(search.times) - 1:
        return None
    stops = _stops(search, front)
    worst, relaxations = stops[0], list[Relaxation]()
    if any(stop.kind is ObstructionKind.COLLISION for stop in stops) and np.isfinite(
        front.width[-1].max(initial=-np.inf)
    ):
        best = int(front.width[-1].argmax())
        joints = front.way(len(search.times) - 1, best)
        relaxations.append(Relaxation(RelaxationKind.CLEARANCE, float(front.width[-1][best]), search.times, joints))
    path = _carried_on(search, front, stops[0].before)
    for turning, kind in ((False, RelaxationKind.DEVIATION), (True, RelaxationKind.LEAN)):
        if (give := _given(search, path, turning, kind)) is not None:
            relaxations.append(give)
    there = unit.format(search.times[last + 1])
    where = (
        f"from {unit.format(search.times[last])} on none goes on to {there}" if last >= 0 else f"none begins at {there}"
    )
    first = "no motion does the tasks" if proven else "no motion was found, though the search does not rule one out"
    words = f"{first}: {where}; {'; '.join(map(str, stops[:WORST]))}"
    if relaxations:
        words += f"; one does if {', or '.join(map(str, relaxations))}"
    if segments is not None:
        many = "a reconfiguration" if segments == 2 else f"{segments - 1} reconfigurations"
        words += f"; with {many} on the way one may: plan_in_pieces"
    told = {"name": worst.name, "value": worst.value, "limit": worst.limit, "time": float(search.times[max(last, 0)])}
    return DeadEnd(words, float(search.times[last + 1]), tuple(stops), tuple(relaxations), segments, **told)


class _Walk:
    """Postures that are reached step by step, one a chart.

    Attributes:
        layers: Charts of each instant, no wider than steps, those on which everything touches, too.
        at: Postures. Shapes (N, n). width: How far apart bodies stay on the way to them, at most what is asked,
            m; infinite where nothing is looked at, -inf where none is reached. Shapes (N,).
        parent: Charts that they are reached from. Shapes (N,).
    """

    def __init__(self, search: AtlasSearch) -> None:
        self.search = search
        self.asked = np.inf if search.scene is None else search.scene.clearance
        self.layers = _narrow(search)
        count, n = len(search.times), len(search.space.scale)
        self.at = [np.full((len(charts), n), np.nan) for charts in self.layers]
        self.width = [np.full(len(charts), -np.inf) for charts in self.layers]
        self.parent = [np.zeros(len(charts), dtype=np.intp) for charts in self.layers]
        charts = self.layers[0]
        middle = np.clip(0.0, charts.low, charts.high)
        own = np.arange(len(charts))
        self._reached(0, own, charts.centers + np.einsum("knr,kr->kn", charts.tangents, middle), own)
        graph = search.graph(self.layers, np.full(count - 1, np.inf))
        for k in range(count - 1):
            self._gone_on(graph, k)

    @property
    def last(self) -> int:
        """The last instant that is reached by what is wide enough, -1 if none."""
        return max((k for k, width in enumerate(self.width) if (width >= self.asked).any()), default=-1)

    def way(self, k: int, chart: int) -> Array:
        """Joints from the first instant of the walk to a posture. Shape (K', n)."""
        found = []
        for instant in range(k, -1, -1):
            found.append(self.at[instant][chart])
            chart = int(self.parent[instant][chart])
        return np.array(found[::-1])

    def _gone_on(self, graph: ChartGraph, k: int) -> None:
        """From all postures of an instant to the charts of the next one, the nearest of the widest first."""
        space, limit, other = self.search.space, self.search.limits[k], k + 1
        parts = [(i[np.isfinite(self.at[k][i, 0])], j[np.isfinite(self.at[k][i, 0])]) for i, j in graph.steps(k, other)]
        if not parts:
            return
        i, j = (np.concatenate(part) for part in zip(*parts, strict=True))
        into = self.layers[other].of(j)
        delta = space.difference(into.centers, self.at[k][i])
        place = -np.einsum("pnr,pn->pr", into.tangents, space.scale**2 * delta)
        way = delta + np.einsum("pnr,pr->pn", into.tangents, np.clip(place, into.low, into.high))
        near = (np.abs(way) <= limit + into.most_stray + TOLERANCE).all(axis=1)
        i, j, way = i[near], j[near], way[near]
        order = np.lexsort((space.length(way), -self.width[k][i], j))
        i, j, way = i[order], j[order], way[order]
        nth = np.arange(len(j)) - np.searchsorted(j, j)
        for trial in range(WORST):
            chosen = nth == trial
            self._reached(other, j[chosen], self.at[k][i[chosen]] + way[chosen], i[chosen])

    def _reached(self, k: int, charts: Indices, joints: Array, parents: Indices) -> None:
        """Hold what does the task and keeps limits, where it is wider than what was held before."""
        search = self.search
        instant, clearance = search.instants[k], self.asked
        if k == 0 and search.start is not None:
            joints, good = np.repeat(search.start[None], len(charts), axis=0), np.ones(len(charts), dtype=bool)
        else:
            joints, good = instant.sets.corrected(np.full(len(charts), instant.number), joints)
            good &= search.space.within(joints)
        width = np.full(len(charts), np.inf)
        if k:
            width = self.width[k - 1][parents]
            way = np.abs(joints - self.at[k - 1][parents])
            good &= (way <= search.limits[k - 1] + TOLERANCE).all(axis=1)
        if search.scene is not None:
            wide = width > self.width[k][charts]
            good &= wide
            at = np.flatnonzero(good)
            times = np.full(len(at), search.times[k])
            apart = distances_along(search.scene, np.zeros(0), joints[at], times, clearance).min(axis=1)
            width[at] = np.minimum(np.minimum(width[at], apart), clearance)
        good &= width > self.width[k][charts]
        own = charts[good]
        self.at[k][own], self.width[k][own], self.parent[k][own] = joints[good], width[good], parents[good]


def _narrow(search: AtlasSearch) -> list[Charts]:
    """Charts of all postures, halved until steps cross them or there are as many as memory is for."""
    layers = search.covered
    steps = search.limits.max(axis=1) / 2
    far = np.minimum(np.append(steps, np.inf), np.append(np.inf, steps))
    while True:
        wide = [k for k, charts in enumerate(layers) if len(charts) and (charts.radii > far[k]).any()]
        more = sum((2 ** layers[k].tangents.shape[2] - 1) * len(layers[k]) for k in wide)
        if not more or sum(map(len, layers)) + more > search.settings.charts:
            return layers
        layers = [search.halved(charts, k) if k in wide else charts for k, charts in enumerate(layers)]


def _stops(search: AtlasSearch, front: _Walk) -> list[Obstruction]:
    """What stops motions at the last instant that is reached, the least first; of each kind and name the least."""
    space, around, last = search.space, search.scene, front.last
    names, n, there = search.instants[0].sets.equations.machine.robot.joint_names, len(space.scale), last + 1
    before, after, on = _onward(search, front)
    instant, clearance = search.instants[there], 0.0 if around is None else around.clearance
    miss = np.where(on, 0.0, np.abs(instant.sets.linearised(np.full(len(after), instant.number), after)[0]).max(axis=1))
    limit = search.limits[last] if last >= 0 else np.full(n, np.inf)
    apart = np.full((len(after), 1), np.inf)
    if around is not None:
        apart = distances_along(around, np.zeros(0), after, np.full(len(after), search.times[there]), clearance)
    ways = np.abs(after - before)
    excess = np.column_stack([miss, after - space.upper, space.lower - after, ways - limit, clearance - apart])
    excess[~on, 1:] = 0.0
    worst = excess.argmax(axis=1)
    most = excess[np.arange(len(worst)), worst]

    def stop(row: int) -> Obstruction:
        """What stops the motion of a row, by its column."""
        kind, joint = divmod(int(worst[row]) - 1, n)
        here, next_ = before[row], after[row]
        if worst[row] == 0:
            return Obstruction(ObstructionKind.REACH, "tip", float(miss[row]), 0.0, here, next_)
        if kind < 2:
            bound = float((space.upper, space.lower)[kind][joint])
            return Obstruction(ObstructionKind.LIMIT, names[joint], float(next_[joint]), bound, here, next_)
        if kind == 2:
            return Obstruction(
                ObstructionKind.STEP, names[joint], float(ways[row, joint]), float(limit[joint]), here, next_
            )
        assert around is not None
        pair = int(worst[row]) - 1 - 3 * n
        bodies = " and ".join(around.labels[pair])
        return Obstruction(ObstructionKind.COLLISION, bodies, float(apart[row, pair]), clearance, here, next_)

    best: dict[tuple[ObstructionKind, str], Obstruction] = {}
    for row in np.argsort(most, kind="stable").tolist():
        if most[row] > TOLERANCE:
            own = stop(row)
            best.setdefault((own.kind, own.name), own)
    if not best:  # postures go on, but none that was followed
        charts = front.layers[there].centers
        return [
            Obstruction(ObstructionKind.NARROW, "tip", 0.0, 0.0, before[0], charts[0] if len(charts) else before[0])
        ]
    return list(best.values())


def _onward(search: AtlasSearch, front: _Walk) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Postures that are reached last, where each would have to go on to, and which of these do the task.

    That is to the posture nearest to each, and to those of the next instant that keep all limits but are too far.
    """
    space, last = search.space, front.last
    instant, seat = search.instants[last + 1], max(last, 0)
    before = front.at[last][front.width[last] >= front.asked] if last >= 0 else front.layers[0].centers
    if not len(before):
        before = front.layers[seat].centers
    nearest, on = instant.sets.corrected(np.full(len(before), instant.number), before)
    charts = front.layers[last + 1].of(front.width[last + 1] < front.asked)
    if last < 0 or not len(charts):
        return before, nearest, on
    middle = np.clip(0.0, charts.low, charts.high)
    flat = charts.centers + np.einsum("knr,kr->kn", charts.tangents, middle)
    ways, good = instant.sets.corrected(np.full(len(flat), instant.number), flat)
    own = before[space.tree(before).query(space.placed(ways))[1]]
    there = own + space.difference(ways, own)
    return np.concatenate([before, own]), np.concatenate([nearest, there]), np.concatenate([on, good])


# ---- what gives way ----------------------------------------------------------------------------------------------


def _carried_on(search: AtlasSearch, front: _Walk, stopped: Array) -> Array:
    """Joints at all instants, (K, n): as far as is reached, then straight to the nearest chart of the last instant."""
    space, last, count = search.space, max(front.last, 0), len(search.times)
    apart = np.nan_to_num(space.length(front.at[last] - stopped), nan=np.inf)
    first = front.way(last, int(apart.argmin())) if np.isfinite(apart).any() else stopped[None]
    ways = space.difference(front.layers[-1].centers, np.repeat(first[-1:], len(front.layers[-1]), axis=0))
    onward = ways[space.length(ways).argmin()] if len(ways) else np.zeros(len(stopped))
    share = np.arange(1, count - len(first) + 1)[:, None] / max(count - len(first), 1)
    return np.vstack([first, first[-1] + share * onward])


def _given(search: AtlasSearch, path: Array, turning: bool, kind: RelaxationKind) -> Relaxation | None:
    """A motion like one of joints (K, n) whose tips are off in places, or turned, by as little as is found; else None.

    All else is done, at the instants, limits are kept and everything is clear.
    """
    if not any((sets.equations.turning == turning).any() for sets in {instant.sets for instant in search.instants}):
        return None
    around, pairs = search.scene, list[int]()
    for _ in range(LOOKS):
        program = _Giving(search, turning, pairs)
        rough = program.solved(path, None)  # row by row, which is smooth where nothing gives way
        if rough is None:
            return None
        made = program.solved(rough, max(program.amount(rough), NEGLIGIBLE))
        path = rough if made is None else made
        missing = (
            [] if around is None else [touch.pair for touch in find_collisions(around, np.zeros(0), path, search.times)]
        )
        if not missing:
            return Relaxation(kind, program.amount(path), search.times, path)
        if set(missing) <= set(pairs):
            return None
        pairs = sorted({*pairs, *missing})
    return None


class _Giving:
    """The motion through all instants whose tips are off in places, or turned, by the least, some pairs held apart."""

    def __init__(self, search: AtlasSearch, turning: bool, pairs: list[int]) -> None:
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
            relaxations = np.append(rows_turn == turning, np.zeros(sets.equations.size - len(rows_turn), dtype=bool))
            ends = np.cumsum([0, *(part.task.size for part in sets.equations.bound)]).tolist()
            parts = [a + np.flatnonzero(relaxations[a:b]) for a, b in pairwise(ends)]
            each = ca.vertcat(*(ca.sumsqr(error[part.tolist()]) for part in parts if part.size))
            wholes = [error[np.flatnonzero(chosen).tolist()] for chosen in (~relaxations, relaxations)]
            errors = ca.Function("errors", [q, wanted], [*wholes, each]).map(len(own))
            targets = sets.targets[[search.instants[k].number for k in own]].T
            for found, part in zip((rest, rows, sizes), errors(self.joints[:, own], targets), strict=True):
                found.append(ca.vec(part))
        self._rest, self._rows, self._sizes = (ca.vertcat(ca.MX(0, 1), *part) for part in (rest, rows, sizes))
        self._size = ca.Function("size", [self.joints], [ca.mmax(self._sizes)])
        self._apart = ca.MX(0, 1)
        if search.scene is not None and pairs:
            q, time = ca.SX.sym("q", n), ca.SX.sym("time")
            apart = search.scene.distances(ca.SX(0, 1), q, time, pairs=pairs, rounding=ROUNDING)
            apart = ca.Function("apart", [q, time], [apart]).map(count)(self.joints, search.times[None, :])
            self._apart = ca.vec(apart) - search.scene.clearance - MARGIN

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
        # a motion that gives way is the smoother of those that do by as little, as good as
        size = max(float((np.diff(path, axis=0) ** 2 / seconds[:, None]).sum()), NEGLIGIBLE)
        program = {
            "x": ca.vertcat(ca.vec(self.joints), slack),
            "f": slack + 1e-4 * rough / size,
            "g": ca.vertcat(self._rest, over, self._apart, ca.vec(steps)),
        }
        options = {"print_level": 0, "sb": "yes", "max_iter": 100, "bound_relax_factor": 0.0}
        told = {"print_time": False, "ipopt": options, "error_on_fail": False}
        solver = ca.nlpsol("give", "ipopt", program, told)
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
