"""Search over all motions that do tip tasks in their own time: which instants are looked at, and plans with a bound."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.errors import ProblemError
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion
from ocp.motion.search.charts import Instant, SelfMotions
from ocp.motion.search.configurations import OUT_OF_REACH, Asked, misfits_of, placed
from ocp.motion.search.dead_end import DeadEnd, dead_end
from ocp.motion.search.joint_space import Held, JointSpace
from ocp.motion.search.reconfigurations import farthest, fewest_pieces
from ocp.motion.search.search import FREE, Search
from ocp.motion.search.steps import Squares
from ocp.motion.tasks.equations import TaskEquations

__all__ = ["TaskSearch"]


@dataclass(frozen=True)
class InstantSettings:
    """At which times the postures of tasks are searched.

    Attributes:
        lost: Share of the cost that straight steps between the instants may lose, by the directions that are free. With
            two each instant is dear: with a third as much lost a plan took half as long again.
        steps: Over the motion, at least.
        closest: Share of the horizon: instants do not come closer.
        tight: Share of its greatest speed at which a joint has hardly any room, so that instants are put beside.
        at_limit: Likewise from the limit of its position, rad or m.
        parts: Of a step between two instants where pieces of a motion end that might have to be fewer.
        told: Times of the motions that are told, beside the breaks of the tasks.
    """

    lost: tuple[float, float, float] = (0.0033, 0.0033, 0.045)
    steps: int = 4
    closest: float = 1e-3
    tight: float = 0.9
    at_limit: float = 1e-3
    parts: int = 4
    told: int = 64


class TaskSearch:
    """Search over the postures of all tasks.

    Attributes:
        bound: Of the cost of any motion that does them; inf where there is none.

    Raises:
        ProblemError: A machine or a task that cannot be searched: a base that moves, velocities, too much freedom.
        Unreachable: An instant at which no posture does the tasks.
    """

    def __init__(
        self, asked: Asked, followed: list[LocalMotion], settings: InstantSettings = InstantSettings()
    ) -> None:
        """
        Args:
            asked: What is asked.
            followed: Local motions through its stretches, of which the cheapest says where instants are needed.
            settings: How many are taken.
        """
        self.asked, self._settings = asked, settings
        machine, bounds = asked.machine, asked.bounds
        if machine.base_size:
            words = "search='global' is for machines on a fixed base; search='postures' for those that move"
            raise ProblemError(words, name="search", value="global")
        cost = np.sum([part.cost for part in followed], axis=0)
        follows = np.array(misfits_of(followed)) <= OUT_OF_REACH
        self._known = float(cost[follows].min()) if follows.any() else np.inf
        best = int(np.where(follows | ~follows.any(), cost, np.inf).argmin())
        self.space = JointSpace(machine, bounds.lower, bounds.upper, asked.weights)
        self.bound = 0.0
        self._held = tuple(np.flatnonzero(asked.idle).tolist())
        self._at = followed[0].joints[best, 0, list(self._held)]
        times = list[Array]()
        for stretch, part in zip(asked.stretches, followed, strict=True):
            if (equations := stretch.equations) is None:
                continue
            if not equations.pose_rows.all():
                words = "search='global' needs poses, and a task gives velocities; say where its tip is: position=..."
                raise ProblemError(words, name="search", value="global", time=stretch.begin)
            size = machine.joint_size - equations.size - len(self._held)
            if size > FREE:
                words = (
                    f"search='global': the tasks leave {size} directions free from {stretch.begin:g} s on, "
                    f"at most {FREE} can be searched; fix more, or search='postures'"
                )
                raise ProblemError(words, name="search", value=size, limit=FREE, time=stretch.begin)
            steps = int(np.ceil(settings.steps * stretch.duration / asked.horizon))
            own = instants_of(part.t, part.joints[best], asked.weights, settings.lost[max(size, 0)], steps)
            times.append(own[1:] if times and own[0] <= times[-1][-1] else own)  # what went before leads there
        if not times:
            words = f"the tasks have no part of {asked.horizon:g} s: the horizon is that much longer"
            raise ProblemError(words, name="horizon", value=asked.horizon)
        self._look(times)

    def _look(self, times: list[Array]) -> None:
        """Search the postures at the times of each stretch that has tasks."""
        self._place(times)
        self._best, bound = self._search.best(self._known)
        self.bound = max(self.bound, bound)  # of fewer instants it holds as well
        if self._best is not None:
            self._known = max(self._known, self._search.steps(self._best))

    def _place(self, times: list[Array]) -> None:
        """Cover the postures at the times of each stretch that has tasks."""
        asked, instants = self.asked, list[Instant]()
        for equations, own in zip(self._equations, times, strict=True):
            sets = self._sets(equations, own)
            instants += [Instant(sets, number) for number in range(len(own))]
        self._instants, self._parts, self.times = instants, times, np.concatenate(times)
        clearance_constraints = None if asked.clearance_constraints is None else asked.clearance_constraints.scene
        limits = asked.bounds.velocity * np.diff(self.times)[:, None]
        told: dict[str, Any] = {"seeds": self._seeds, "start": asked.start, "scene": clearance_constraints}
        self._search = Search(self.space, instants, self.times, Squares(asked.weights), limits, **told)

    def _sets(self, equations: TaskEquations, times: Array) -> SelfMotions:
        """The postures at some times; joints that move no tip stay where they are at the start."""
        targets = np.array(equations.target_function().map(len(times))(times[None, :])).T
        held = Held(equations.machine, equations.bound, self._held)
        return SelfMotions(self.space, held, np.column_stack([targets, np.tile(self._at, (len(times), 1))]))

    @property
    def _equations(self) -> list[TaskEquations]:
        return [stretch.equations for stretch in self.asked.stretches if stretch.equations is not None]

    def dead_end(self) -> DeadEnd | None:
        """Where motions end, and why; None where one does not."""
        if self._best is not None:
            return None
        ends = farthest(self._search, 0)
        through = len(ends) > 1 and ends[-1] == len(self.times) - 1
        return dead_end(self._search, proven=not np.isfinite(self.bound), pieces=len(ends) if through else None)

    def pieces(self, barred: Collection[tuple[float, float]] = ()) -> tuple[list[tuple[float, float]], int] | None:
        """Begin and end of pieces in which motions do the tasks, the cheapest of the fewest, and how few any are.

        Args:
            barred: What is known not to be done in one piece, from and until which of the instants, s.

        Returns:
            None where nothing goes on somewhere, however the tasks are cut.
        """
        while True:
            spans = [(int(first), int(last)) for first, last in np.searchsorted(self.times, [*barred]).tolist()]
            ends, last = farthest(self._search, 0, spans), len(self.times) - 1
            through = bool(ends) and ends[-1] == last
            # a piece of any motion ends between two instants, and the next one begins there
            least = len(farthest(self._search, ruled_out=True))
            if not through or len(ends) > least:
                wide = [end for end in ends if end < last and self._wide[end]]
                if wide:
                    inside = (np.arange(1, self._settings.parts) / self._settings.parts)[:, None]
                    closer = self.times[wide] + inside * np.diff(self.times)[wide]
                    self._place(self._closer(closer.ravel()))
                    continue
            found = fewest_pieces(self._search, 0, spans) if through else None
            if found is None:
                return None
            times = self.times.tolist()
            return [(times[piece.first], times[piece.last]) for piece in found[0]], least

    @property
    def _wide(self) -> NDArray[np.bool_]:
        """Between which instants others can be put."""
        return np.asarray(np.diff(self.times) > self._settings.closest * self.asked.horizon)

    def _closer(self, times: Array) -> list[Array]:
        """The instants of each stretch with others between them."""
        return [np.union1d(own, times[(times > own[0]) & (times < own[-1])]) for own in self._parts]

    def looked_closer(self) -> bool:
        """Search again with instants between those at which the best motion has hardly any room; False where it has."""
        if self._best is None:
            return False
        bounds, steps = self.asked.bounds, np.abs(np.diff(self._best, axis=0))
        at_limit = (
            np.minimum(self._best - bounds.lower, bounds.upper - self._best).min(axis=1) < self._settings.at_limit
        )
        tight = (steps >= self._settings.tight * self._search.limits).any(axis=1) | at_limit[1:] | at_limit[:-1]
        tight &= self._wide
        if not tight.any():
            return False
        self._look(self._closer((self.times[:-1] + self.times[1:])[tight] / 2))
        return True

    def _seeds(self, k: int) -> Array:
        """Postures at an instant, by closed forms and by inverse kinematics from random starts."""
        sets, number = self._instants[k]
        try:
            return sets.seeds(number, self.asked.limits.joints, self.asked.seed + k)
        except Unreachable as error:
            raise placed(self.asked, error, float(self.times[k])) from error

    def followed(self, every: bool = False) -> list[LocalMotion]:
        """The cheapest motion of each class through all stretches, as what a plan begins from.

        Of the classes that may be the cheapest; of `every` one where these do not pass.
        """
        asked, found = self.asked, list[LocalMotion]()
        ways = self._search.motions(self._known, every)
        if self._best is not None:
            ways.insert(0, self._best)
        if asked.start is None:  # by whole turns, so that joints keep their limits
            ways = [self.space.turned(path, asked.bounds.lower, asked.bounds.upper) for path in ways]
        count, n = len(ways), asked.machine.joint_size
        for stretch in asked.stretches:
            share = max(int(np.ceil(self._settings.told * stretch.duration / asked.horizon)), self._settings.steps)
            times = np.union1d(np.linspace(stretch.begin, stretch.end, share + 1), stretch.breaks)
            rows = np.array([[np.interp(times, self.times, path[:, j]) for j in range(n)] for path in ways])
            rows = rows.reshape(count, n, len(times)).transpose(0, 2, 1)
            if stretch.equations is not None:
                on = self._sets(stretch.equations, times)
                rows = on.corrected(np.tile(np.arange(len(times)), count), rows.reshape(-1, n))[0].reshape(rows.shape)
            rows = np.clip(rows, asked.bounds.lower, asked.bounds.upper)
            rates = np.diff(rows, axis=1) / np.diff(times)[:, None]
            cost = np.einsum("kmn,n,m->k", rates**2, asked.weights, np.diff(times)) / 2
            base, none = np.zeros((count, len(times), 0)), np.zeros(count)
            rates = np.concatenate([rates, rates[:, -1:]], axis=1)
            found.append(LocalMotion(times, base, rows, rates, np.asarray(cost), none, none))
        return found


def instants_of(t: Array, joints: Array, weights: Array, share: float, least: int) -> Array:
    """Of the times of a motion (M,) as few as leave all but a share of its cost to the straight steps between them.

    At each turn that time is left out that adds least to what the steps miss; at least so many steps are left.
    """
    kept = list(range(len(t)))

    def cost(a: int, b: int) -> float:
        return float((weights * (joints[b] - joints[a]) ** 2).sum() / (2 * (t[b] - t[a])))

    def missing(i: int) -> float:
        a, b, c = kept[i - 1 : i + 2]
        return cost(a, b) + cost(b, c) - cost(a, c)

    room = share * sum(cost(a, b) for a, b in pairwise(kept))
    missed = [np.inf, *(missing(i) for i in range(1, len(kept) - 1)), np.inf]
    while len(kept) > least + 1:
        i = int(np.argmin(missed))
        room -= missed[i]
        if room < 0:
            break
        del kept[i], missed[i]
        for k in (i - 1, i):
            if 0 < k < len(kept) - 1:
                missed[k] = missing(k)
    return np.asarray(t[kept])
