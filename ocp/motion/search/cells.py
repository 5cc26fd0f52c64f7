"""The cheapest motions of machines whose base moves by itself: forward search over exact states kept in cells.

What such a machine can reach is no set of postures at each instant: the base's attitude depends on the way. So states
are kept that were reached, each integrated so that it does its tasks, and of those that fall into one cell of joints
and attitude the one that was reached at the least cost. From each a fan of self-motions goes on. Cells are as large as
leaves so many states as are kept. Rates are tried in proportion to what a motion may cost: searches with few states
say how much that is, the last one, with many, looks for all motions within a multiple of it.

Every state at the end has its way; the ways that are cheaper than all that are near to them are the classes of motions,
the first guesses of the whole motion's problem. Nothing is proven by this: a motion through a passage narrower than a
cell may be missed, and no bound comes of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from models import FreeFloating
from models.arrays import Array
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion
from ocp.motion.search.configurations import OUT_OF_REACH, Asked, misfits_of, placed
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.search.reduced import ReducedKinematics, Side, Slopes, check_floating_reach, within

__all__ = ["CellSearch", "follows"]

Indices = NDArray[np.intp]

OFF_SHARE = 0.1
"""Share of the way of a tip that a local motion may miss of it where velocities are asked for."""


@dataclass(frozen=True)
class CellSettings:
    """How closely states are looked at.

    Attributes:
        states: Kept at each instant, of 1 kB each.
        few: Share of these that the searches keep which say what a motion costs.
        searches: At most, with those in which nothing goes on; each of these is followed by one with `far` the cost.
        far: Motions so many times as dear as the best are not looked for.
        steps: Over the motion, at least.
        halvings: Of a step after which no state would be left.
        levels: Rates of a self-motion of one direction; of more directions so many times more are drawn.
        longest: That a joint goes in one step, rad or m.
        wider, narrowest: By which cells are widened or narrowed until the states fit in, and rad or m of a cell.
        corrections: Newton steps from where a motion is to the poses of tasks that begin.
        neighbours: Ways to which a way is compared, for each direction that is free, at so many instants: `seats`.
        classes: Ways that are told, the cheapest first.
    """

    states: int = 2000
    few: float = 0.25
    searches: int = 6
    far: float = 10.0
    steps: int = 40
    halvings: int = 6
    levels: int = 15
    longest: float = 1.0
    wider: float = 1.2
    narrowest: float = 1e-3
    corrections: int = 12
    neighbours: int = 8
    seats: int = 5
    classes: int = 48


def follows(asked: Asked, followed: Sequence[LocalMotion]) -> NDArray[np.bool_]:
    """Which local motions meet their poses, and run most of the way that velocities ask for. Shape (K,)."""
    count = len(followed[0].cost)
    missed, way = np.zeros(count), np.zeros(count)
    for stretch, part in zip(asked.stretches, followed, strict=True):
        kinematics = ReducedKinematics(asked.machine, stretch.equations, asked.weights)
        for k, step in enumerate(np.diff(part.t).tolist()):
            base, joints = ((value[:, k] + value[:, k + 1]) / 2 for value in (part.base, part.joints))
            speeds = kinematics.missed(base, joints, part.rates[:, k], part.t[k] + step / 2)
            missed, way = missed + step * speeds[0], way + step * speeds[1]
    return np.asarray((np.array(misfits_of(list(followed))) <= OUT_OF_REACH) & (missed <= OFF_SHARE * way))


@dataclass(frozen=True, eq=False)
class _Layer:
    """States reached at a time.

    Attributes:
        time: s. base, joints: Shapes (K, b), (K, n). cost: Until then. Shape (K,).
        before: From which state of the layer before each comes. Shape (K,).
    """

    time: float
    base: Array
    joints: Array
    cost: Array
    before: Indices

    def of(self, rows: Any) -> _Layer:
        return _Layer(self.time, self.base[rows], self.joints[rows], self.cost[rows], self.before[rows])


class CellSearch:
    """Motions from some postures through all stretches of what is asked."""

    def __init__(self, asked: Asked, postures: Array, settings: CellSettings = CellSettings()) -> None:
        """
        Args:
            asked: What is asked.
            postures: Joints to start from. Shape (K, n).
            settings: How closely states are looked at.

        Raises:
            Unreachable: From some time on a task is out of reach in any attitude of the base.
            DeadEnd: Nothing goes on from some time on.
        """
        self.asked, self._settings, self._found = asked, settings, list[_Cells]()
        self._kinematics = [ReducedKinematics(asked.machine, each.equations, asked.weights) for each in asked.stretches]
        most, whole = settings.far * self._speed(postures), False
        for number in range(settings.searches):
            last = number == settings.searches - 1
            cells = _Cells(asked, self._kinematics, most, whole or last, asked.seed + number, settings)
            try:
                with np.errstate(all="ignore"):  # states that run away are left out
                    cells.search(postures)
            except DeadEnd as stuck:
                if not number:
                    self._check_reach(stuck)
                if not self._found and last:
                    raise
                if whole:
                    break
                most, whole = (most, True) if self._found else (settings.far * most, False)
                continue
            self._found.append(cells)
            if whole:
                break
            needed = settings.far * min(each.cost for each in self._found)
            most, whole = needed, needed >= most / 2

    def _check_reach(self, stuck: DeadEnd) -> None:
        """Raise Unreachable where that is why nothing goes on."""
        asked, machine, bounds = self.asked, self.asked.machine, self.asked.bounds
        if asked.start is None or not isinstance(machine, FreeFloating):
            return  # where the centre of mass is depends on the start
        told: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "seed": asked.seed}
        try:
            check_floating_reach(machine, asked.tasks, asked.base, asked.start, stuck.time, asked.horizon, **told)
        except Unreachable as error:
            raise placed(asked, error, error.time) from stuck

    def _speed(self, postures: Array) -> float:
        """What the tasks would cost if the machine moved at each instant as well as it can at the start, about."""
        asked, total, count = self.asked, 0.0, self._settings.seats
        base = np.tile(asked.base, (len(postures), 1))
        for stretch, kinematics in zip(asked.stretches, self._kinematics, strict=True):
            for time in np.linspace(stretch.begin, stretch.end, count + 2)[1:-1].tolist():
                least = float(kinematics.speed(base, postures, time).min())
                total += least / 2 * stretch.duration / count
        return total

    def followed(self) -> list[list[LocalMotion]]:
        """Of each search, the largest first, the cheapest motion of each class through all stretches.

        They are what a plan begins from.
        """
        return [cells.followed() for cells in reversed(self._found)]


class _Cells:
    """One search.

    Attributes:
        cost: Of the cheapest way.
        layers: States at each instant.
    """

    def __init__(
        self,
        asked: Asked,
        kinematics: Sequence[ReducedKinematics],
        most: float,
        whole: bool,
        seed: int,
        settings: CellSettings,
    ) -> None:
        """Among motions that cost at most so much, with all states that may be kept or with a few."""
        self.asked, self.kinematics, self.most, self._settings = asked, kinematics, most, settings
        self.states = settings.states if whole else int(settings.few * settings.states)
        self.root, self._rng = np.sqrt(asked.weights), np.random.default_rng(seed)
        self._fastest, self._width = np.sqrt(2 * most / asked.horizon), settings.narrowest
        self._begins = list[int]()
        self.layers = list[_Layer]()
        self.cost = np.inf

    def search(self, postures: Array) -> None:
        """From postures (K, n) to the end.

        Raises:
            DeadEnd: No state gets there.
        """
        asked, layers = self.asked, self.layers
        count = len(postures)
        layers.append(_Layer(0.0, np.tile(asked.base, (count, 1)), postures, np.zeros(count), np.arange(count)))
        for stretch, kinematics in zip(asked.stretches, self.kinematics, strict=True):
            if stretch.begin > 0 and any(stretch.new):
                layers.append(self._begun(layers[-1], kinematics))
            self._begins.append(len(layers) - 1)
            steps = max(int(np.ceil(self._settings.steps * stretch.duration / asked.horizon)), 1)
            ahead = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.breaks)[:0:-1].tolist()
            shortest = stretch.duration / steps / 2**self._settings.halvings
            slopes = kinematics.at(layers[-1].base, layers[-1].joints, stretch.begin)
            while ahead:
                last = layers[-1]
                made, why = self._grown(kinematics, last, slopes, ahead[-1], limited=True)
                if made is not None:
                    layers.append(made)
                    slopes = kinematics.at(made.base, made.joints, ahead.pop())
                elif ahead[-1] - last.time > shortest:
                    ahead.append((ahead[-1] + last.time) / 2)
                else:
                    free, _ = self._grown(kinematics, last, slopes, ahead[-1], limited=False)
                    raise self._stuck(last, why if free is not None else Counter())
        self.cost = float(layers[-1].cost.min())

    def _grown(
        self, kinematics: ReducedKinematics, layer: _Layer, slopes: Slopes, time: float, limited: bool
    ) -> tuple[_Layer | None, Counter[tuple[int, int]]]:
        """The states that are reached from a layer, the best of each cell; None where there are none.

        And how many are stopped by which limit of which joint, where the joints are `limited`.
        """
        asked, step, root = self.asked, time - layer.time, self.root
        fan = self._fan(len(layer.cost), slopes.null.shape[2])
        before = np.repeat(np.arange(len(layer.cost)), fan.shape[1])
        idle = np.asarray(slopes.null @ fan.transpose(0, 2, 1)).transpose(0, 2, 1).reshape(len(before), -1)
        rates, told = slopes.least(slopes.right)[before] + idle, Counter[tuple[int, int]]()
        if limited:
            bounds, joints = asked.bounds, layer.joints[before]
            fast = bounds.velocity * root
            low = np.maximum(-fast, (bounds.lower - joints) / step * root)
            high = np.minimum(fast, (bounds.upper - joints) / step * root)
            rates, why = within(rates, slopes.null[before], low, high, fast)
            told.update(map(tuple, why[why[:, 0] >= 0].tolist()))
            rates[why[:, 0] >= 0] = np.nan
        far = np.abs(rates / root).max(axis=1) * step
        cost = layer.cost[before] + step / 2 * (rates**2).sum(axis=1)
        good = np.flatnonzero((cost <= self.most) & (far <= self._settings.longest))
        if not good.size:
            return None, told
        before, rates, cost = before[good], rates[good], cost[good]
        base = layer.base[before] + step * ((slopes.base[before] @ rates[:, :, None])[:, :, 0] + slopes.drift[before])
        best = self._kept(base, layer.joints[before] + step * rates / root, cost, tight=True)
        before, rates = before[best], rates[best]
        start, first = layer.base[before], layer.joints[before]
        exact = OUT_OF_REACH / 10
        base, joints, off = kinematics.stepped(start, first, slopes.of(before), rates, layer.time, time, exact)
        cost = layer.cost[before] + ((root * (joints - first)) ** 2).sum(axis=1) / (2 * step)
        near = np.isfinite(base).all(axis=1) & (np.abs(joints - first).max(axis=1) <= self._settings.longest)
        made = _Layer(time, base, joints, cost, before)
        made = made.of(np.flatnonzero(near & (cost <= self.most) & (off <= OUT_OF_REACH)))
        made = made.of(np.flatnonzero(self._allowed(kinematics, made)))
        if not len(made.cost):
            return None, told
        return made.of(self._kept(made.base, made.joints, made.cost, tight=False)), told

    def _fan(self, count: int, r: int) -> Array:
        """Self-motions that are tried from each of some states, in their null spaces. Shape (count, C, r)."""
        many = self._settings.levels
        share = np.linspace(-1.0, 1.0, many)
        levels = self._fastest * np.sign(share) * share**2  # finer where most motions are
        if r <= 1:
            return np.tile(levels[None, :, None] if r else np.zeros((1, 1, 0)), (count, 1, 1))
        way = self._rng.normal(size=(count, many * r, r))
        way *= self._rng.choice(np.abs(levels), size=(*way.shape[:2], 1)) / np.linalg.norm(way, axis=2, keepdims=True)
        way[:, 0] = 0.0
        return np.asarray(way)

    def _kept(self, base: Array, joints: Array, cost: Array, tight: bool) -> Indices:
        """The cheapest state of each cell; the cells grow until no more are left than are kept, or shrink, too."""
        turn = base[:, 2:] if base.shape[1] == 3 else 2 * base[:, 3:]
        place = np.hstack([joints * self.root, turn * np.sqrt(np.mean(self.root**2))])
        mixed = np.random.default_rng(0).uniform(1.0, 2.0, size=place.shape[1])
        order = np.argsort(cost, kind="stable")
        place = place[order] - place.min(axis=0)  # the signs of many coordinates would be cells of their own

        def winners(width: float) -> Indices:
            return np.asarray(order[np.unique(np.floor(place / width) @ mixed, return_index=True)[1]])

        found = winners(self._width)
        while len(found) > self.states:
            self._width *= self._settings.wider
            found = winners(self._width)
        while (
            tight
            and self._width > self._settings.narrowest
            and len(finer := winners(self._width / self._settings.wider)) <= self.states
        ):
            self._width, found = self._width / self._settings.wider, finer
        return found

    def _allowed(self, kinematics: ReducedKinematics, layer: _Layer) -> NDArray[np.bool_]:
        """Which states lean no farther than they may, and are clear."""
        good, times = np.isfinite(layer.cost), np.full(len(layer.cost), layer.time)
        if kinematics.equations is not None and len(times):
            over = kinematics.equations.cone_violations(times, layer.base, layer.joints)
            good &= over.max(axis=1, initial=0.0) <= OUT_OF_REACH
        if self.asked.clearance_constraints is not None and good.any():
            around, at = self.asked.clearance_constraints.scene, np.flatnonzero(good)
            apart = distances_along(around, layer.base[at], layer.joints[at], times[at], around.clearance)
            good[at] = (apart >= around.clearance).all(axis=1)
        return np.asarray(good)

    def _begun(self, layer: _Layer, kinematics: ReducedKinematics) -> _Layer:
        """States at the poses that begin at a time, each as near as it comes to where it was."""
        moved = kinematics.corrected(
            layer.base, layer.joints, layer.time, OUT_OF_REACH / 10, most=self._settings.corrections
        )
        base, joints, off = moved
        cost = layer.cost + ((self.root * (joints - layer.joints)) ** 2).sum(axis=1) / (2 * layer.time)
        good = np.flatnonzero(off <= OUT_OF_REACH)
        if not good.size:
            raise self._stuck(layer, Counter())
        return _Layer(layer.time, base, joints, cost, np.arange(len(cost))).of(good)

    def _stuck(self, layer: _Layer, why: Counter[tuple[int, int]]) -> DeadEnd:
        bounds, names = self.asked.bounds, self.asked.machine.robot.joint_names
        details: dict[str, Any] = {"time": layer.time, "name": "task"}
        words = "the tasks would need ever faster joints: they lead past what the machine can do, or by a singularity"
        if why:
            (joint, which), _ = why.most_common(1)[0]
            limit = float((bounds.lower, bounds.upper, -bounds.velocity, bounds.velocity)[which][joint])
            what = "can go no faster than" if which >= Side.SLOW else "can go no farther than"
            words = f"{names[joint]!r} {what} {limit:g}"
            value = float(layer.joints[layer.cost.argmin(), joint])
            details |= {"name": names[joint], "value": value, "limit": limit}
        count = len(layer.cost)
        return DeadEnd(f"nothing goes on after {layer.time:.4g} s: in {count} states reached there, {words}", **details)

    # ---- what was found --------------------------------------------------------------------------------------------

    def followed(self) -> list[LocalMotion]:
        """The cheapest motion of each class through all stretches."""
        layers, asked = self.layers, self.asked
        final, rows = layers[-1], np.arange(len(layers[-1].cost))
        ways = np.empty((len(layers), len(rows)), dtype=np.intp)
        for k in range(len(layers) - 1, -1, -1):
            ways[k] = rows
            rows = layers[k].before[rows]
        cost = final.cost.copy()
        if asked.cyclic:
            back = final.joints - layers[0].joints[ways[0]]
            cost += ((self.root * back) ** 2).sum(axis=1) / (2 * asked.horizon)
        seats = np.unique(np.linspace(0, len(layers) - 1, self._settings.seats + 1).astype(int)).tolist()
        place = np.hstack([layers[k].joints[ways[k]] * self.root for k in seats])
        free = max(asked.machine.joint_size - max(each.rows for each in self.kinematics), 1)
        near = min(self._settings.neighbours * free + 1, len(cost))
        beside = np.reshape(cKDTree(place).query(place, k=near)[1], (len(cost), near))
        least = np.flatnonzero((cost[:, None] <= cost[beside]).all(axis=1))
        chosen = least[np.argsort(cost[least])][: self._settings.classes]
        found, ends = [], [*self._begins[1:], len(layers) - 1]
        for begin, end in zip(self._begins, ends, strict=True):
            # what is met where others begin belongs to these
            last = end - 1 if end < len(layers) - 1 and layers[end].time == layers[end - 1].time else end
            found.append(self._told(layers[begin : last + 1], ways[begin : last + 1, chosen]))
        return found

    def _told(self, layers: Sequence[_Layer], ways: Indices) -> LocalMotion:
        """Ways through some layers."""
        times = np.array([layer.time for layer in layers])
        base = np.stack([layer.base[row] for layer, row in zip(layers, ways, strict=True)], axis=1)
        joints = np.stack([layer.joints[row] for layer, row in zip(layers, ways, strict=True)], axis=1)
        joints = np.clip(joints, self.asked.bounds.lower, self.asked.bounds.upper)
        rates = np.diff(joints, axis=1) / np.diff(times)[:, None]
        cost = np.einsum("kmn,n,m->k", rates**2, self.asked.weights, np.diff(times)) / 2
        none = np.zeros(ways.shape[1])
        rates = np.concatenate([rates, rates[:, -1:]], axis=1)
        return LocalMotion(times, base, joints, rates, np.asarray(cost), none, none)
