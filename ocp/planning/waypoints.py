"""The cheapest way of an arm through poses: all joints at many waypoints, and a bound of its cost.

The cost is the weighted sum of the ways of all joints, or of the largest of them, which may be a time; between two
waypoints no joint moves more than a step. Some of the waypoints are searched whole (see `ocp.planning.search`); since a
way through all of them is no shorter than through some, what bounds these bounds all. The best ways found are then
drawn tight through all waypoints: dynamic programming over the postures beside the way, nearer and nearer, in which
what is not allowed is dear, so that a way may come out of it as well. Where no way goes through all, one in the fewest
pieces may be asked for (see `ocp.planning.reconfigurations`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from models import FixedBase, Surroundings
from models.arrays import Array
from ocp.audit.clearance import Clearance
from ocp.builders.clearance import clearance_of
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, SolveError, checked_choice, checked_count, checked_instance, floats
from ocp.local.inverse_kinematics import LARGEST_SEED, Unreachable, at_rest, postures_of
from ocp.local.touching import Touch, distances_along, touches
from ocp.planning.charts import TURN, Held, Instant, JointSpace, SelfMotions
from ocp.planning.dead_end import KINDS, dead_end
from ocp.planning.planner import clear_of
from ocp.planning.reconfigurations import fewest_pieces
from ocp.planning.search import FREE, Search, checked_bound
from ocp.planning.sections import RADII, Sections, values_of
from ocp.planning.steps import Homogeneous, Largest, Length
from ocp.planning.tight import drawn_tight
from ocp.tasks.checks import checked_numbers
from ocp.tasks.equations import bind
from ocp.tasks.limits import Limits
from ocp.tasks.tip_task import TipTask

__all__ = ["Reconfigurations", "WayCost", "WaypointPlan", "plan_waypoints"]

WayCost: TypeAlias = Literal["length", "largest", "time"]
Reconfigurations: TypeAlias = Literal["forbidden", "counted"]

EVERY = 5
"""Of so many waypoints one is searched whole; more where none of the ways found goes through all."""
WAYPOINT = "waypoint {:g}"
POSTURES = "postures"
"""What an error is about where there are more than memory is for."""
NONE_FOUND = "no way through the waypoints keeps all limits"
STARTS = 16
"""Random starts of inverse kinematics at each of these."""
SPARSE = (10, 5)
"""Likewise where two directions are free; the second where no way found by the first goes through all."""
FEW = 6
"""Steps from one waypoint that is searched to the next, where short ways are looked for."""
INSTANTS = 20
"""Waypoints that are searched then, about, where there are so many, and more where there are many."""
SPACED = 4 * RADII[1]
"""rad or m: how far each joint may go from one of these to the next, at least."""
DRAWN = 2
"""Ways that are drawn tight then, the cheapest first."""
WIDTH, TIGHT = 0.06, 1e-6
"""rad or m, between postures beside a way that is drawn tight, at first and at last."""
MISSED = 1e-6
"""m and rad: poses are met up to this."""
WHOLE = 1e-9
"""rad or m: limits are kept up to this."""


Searched = TypeVar("Searched", bound=Search)


@dataclass(frozen=True, eq=False)
class WaypointPlan:
    """A way through waypoints.

    Attributes:
        machine: What moves.
        joints: At the waypoints. Shape (N, n), rad or m.
        cost: Of the way, without what lies in reconfigurations.
        bound: Of the cost of any way through the waypoints, in no more pieces; 0 where none is known.
        ways: Costs of all ways that were found, and why they are not the plan.
        between: How near bodies come on straight lines of the joints from waypoint to waypoint, proven; its times are
            numbers of waypoints. None where nothing was to be looked at. Reconfigurations are left out.
        reconfigurations: Numbers of the waypoints from which the arm comes to the next one in another posture, by a way
            that is not planned.
    """

    machine: FixedBase
    joints: Array
    cost: float
    bound: float
    ways: tuple[tuple[float, str], ...] = ()
    between: Clearance | None = None
    reconfigurations: tuple[int, ...] = ()

    @property
    def steps(self) -> Array:
        """Largest way of each joint from one waypoint to the next, but for reconfigurations. Shape (n,), rad or m."""
        ways = np.delete(np.abs(np.diff(self.joints, axis=0)), list(self.reconfigurations), axis=0)
        return np.asarray(ways.max(axis=0, initial=0.0))

    def __repr__(self) -> str:
        return (
            f"<WaypointPlan through {len(self.joints)} waypoints: cost {self.cost:.6g}, at least {self.bound:.6g} any>"
        )

    def __str__(self) -> str:
        lines = [
            f"way through {len(self.joints)} waypoints of {', '.join(self.machine.robot.joint_names)}: "
            f"cost {self.cost:.6g}, at least {self.bound:.6g} any"
        ]
        if self.reconfigurations:
            places = ", ".join(map(str, self.reconfigurations))
            count = f"{len(self.reconfigurations)} time{'s' if len(self.reconfigurations) > 1 else ''}"
            lines.append(f"  the arm reconfigures {count}, after waypoint {places}")
        if self.between is not None and self.between.worst is not None:
            near = self.between.worst
            how = "too near" if near.missed else "proven clear, the nearest"
            apart = f"{near.distance:.4g} m apart, {near.asked:g} m asked, at waypoint {near.time:.4g}"
            lines.append(f"  straight between waypoints {how}: {' and '.join(near.bodies)}, {apart}")
        return "\n".join(lines + [f"  {cost:10.6g}  {why or 'the plan'}" for cost, why in self.ways])


@interruptible
def plan_waypoints(
    machine: FixedBase,
    positions: ArrayLike,
    quaternions: ArrayLike,
    *,
    cost: WayCost = "length",
    step: Any = np.inf,
    weights: Any = None,
    limits: Limits | None = None,
    obstacles: Any = (),
    clearance: float | None = 0.0,
    ignored: Any = (),
    srdf: Any = None,
    folders: Any = (),
    missing: str = "raise",
    reconfigurations: Reconfigurations = "forbidden",
    seed: int = 0,
) -> WaypointPlan:
    """The cheapest way through poses of the tip that keeps limits and is clear at every waypoint.

    Args:
        machine: On a fixed base, with as many joints as a pose has rows, or one or two more. With two more the ways are
            looked for beside postures in which the joint nearest to the base has one of some values (see
            `ocp.planning.sections`), and no bound is known.
        positions: Of the tip in the world. Shape (N, 3), m.
        quaternions: Of the tip there, [w, x, y, z], of any length. Shape (N, 4).
        cost: "length": the sum of the ways of all joints; "largest": the way of the joint that goes farthest, from
            waypoint to waypoint; "time": s, no joint being faster than its velocity limit.
        step: How far each joint may move from one waypoint to the next, rad or m; one number or one for each.
        weights: Of the joints' ways in the cost, 0 for what does not count. Shape (n,); all 1 if None. Not for a time.
        limits: Of the joints' positions, and of their velocities for the time; the robot's own if None.
        obstacles, clearance, ignored, srdf, folders, missing: As of `plan`.
        reconfigurations: "counted": where no way goes through all waypoints, one with the fewest reconfigurations, and
            of these the cheapest. In a reconfiguration the arm leaves the way at a waypoint and comes back to the next
            one in any posture; this costs nothing and is not planned. With one free direction at most.
        seed: Of inverse kinematics.

    Raises:
        ProblemError: What is asked does not fit the machine; Unreachable, which is one, names the waypoint as time.
        DeadEnd: No way goes through all waypoints, in one piece where reconfigurations are forbidden: from which on
            none does, what stops it, and how far the poses or the clearance would have to give way.
        SolveError: None was found, though some go through a part of them.
    """
    checked_instance("machine", machine, FixedBase)
    checked_count("seed", seed, 0, LARGEST_SEED)
    places, turns = _poses(positions, quaternions)
    n = machine.joint_size
    told = Limits() if limits is None else checked_instance("limits", limits, Limits)
    heavy = np.ones(n) if weights is None else checked_numbers(weights, n, "weights", "one for each joint")
    if not ((heavy >= 0).all() and heavy.any()):
        raise ProblemError(f"weights {heavy.tolist()} must be positive, or 0", name="weights", value=heavy, limit=0.0)
    checked_choice("cost", cost, get_args(WayCost))
    checked_choice("reconfigurations", reconfigurations, get_args(Reconfigurations))
    for what in ("velocity", "acceleration", "jerk", "torque", "power"):
        if getattr(told, what) is not None and not (what == "velocity" and cost == "time"):
            words = f"limits: a way through waypoints has no time, so no {what}; leave it out, or give a step"
            raise ProblemError(words, name=what, value=getattr(told, what))
    if cost == "time":
        if weights is not None:
            raise ProblemError("the time has no weights; leave them out", name="weights", value=weights)
        heavy = 1 / told.bounds(machine, ("velocity",)).velocity
        if not heavy.any():
            raise ProblemError("no joint has a velocity limit, by which the time is told", name="velocity")
    most = _step(step, n)
    clear = clear_of(machine, obstacles, clearance, ignored, srdf, folders, missing, told)
    around = None if clear is None else clear.surroundings
    way = _Ways(machine, places, turns, most, (Length if cost == "length" else Largest)(heavy), told, around, int(seed))
    return way.plan(reconfigurations == "counted")


class _Ways:
    """The ways through waypoints, arguments as of `plan_waypoints`, checked."""

    def __init__(
        self,
        machine: FixedBase,
        places: Array,
        turns: Array,
        step: Array,
        cost: Homogeneous,
        limits: Limits,
        around: Surroundings | None,
        seed: int,
    ) -> None:
        self.machine, self.places, self.turns, self.step, self.around = machine, places, turns, step, around
        self.seed, self.kept, self.cost = seed, limits.joints, cost
        bounds = limits.bounds(machine)
        self.lower, self.upper = bounds.lower, bounds.upper
        self.space = JointSpace(machine, bounds.lower, bounds.upper, np.ones(machine.joint_size))
        free = bind(machine, self._task(0))
        equations = Held(machine, free.bound, tuple(np.flatnonzero(free.idle).tolist()))
        at = at_rest(self.lower, self.upper)
        targets = np.zeros((len(places), 18))
        targets[:, :3] = places
        targets[:, 6:15] = turns.transpose(0, 2, 1).reshape(-1, 9)
        targets = np.column_stack([targets, np.tile(at[free.idle], (len(places), 1))])
        self.sets = SelfMotions(self.space, equations, targets)
        self._known = dict[int, Array]()
        if not 0 <= self.sets.size <= FREE:
            words = f"{machine.robot.name}: {int((~free.idle).sum())} joints for the {free.size} rows of a pose"
            words += f"; hold joints until at most {FREE} are left over"
            raise ProblemError(words, name="machine", value=self.sets.size, limit=FREE)

    def plan(self, in_pieces: bool) -> WaypointPlan:
        if in_pieces and self.sets.size > 1:
            words = f"reconfigurations are counted with one free direction at most, not with {self.sets.size}"
            raise ProblemError(words, name="reconfigurations", value=self.sets.size, limit=1)
        if self.sets.size > 1:
            return self._made(self._by_sections(), 0.0)
        every, bound, ways = EVERY, 0.0, list[tuple[float, str, Array]]()
        search, chosen = self._begun(self._search, every)
        while True:
            best, least = search.best(np.inf)
            if not np.isfinite(least):
                if in_pieces:
                    return self._in_pieces(search, chosen)
                raise self._ended(search, chosen)
            bound = max(bound, least)
            if best is not None:
                ways.append(self._drawn(chosen, best))
            if any(not why for _, why, _ in ways) or len(chosen) == len(self.places):
                break
            # what is cheapest through some waypoints does not go through all: those where it is wrong are searched, too
            more = chosen if best is None else np.union1d(chosen, self._wrong(ways[-1][2])[1])
            if len(more) == len(chosen):
                every = max(every // 2, 1)
                more = np.union1d(chosen, self._every(every))
            try:
                search, chosen = self._search(more), more
            except ProblemError as error:
                if error.name != POSTURES:
                    raise
                break
        if in_pieces and all(why for _, why, _ in ways):
            return self._in_pieces(search, chosen)
        if not ways:
            raise dead_end(search, WAYPOINT, proven=False) or SolveError(NONE_FOUND, name="waypoints")
        return self._made(ways, bound)

    def _made(self, ways: list[tuple[float, str, Array]], bound: float) -> WaypointPlan:
        """The plan of the cheapest way that keeps all limits.

        Raises:
            SolveError: None does.
        """
        ways.sort(key=lambda one: (bool(one[1]), one[0]))
        length, why, joints = ways[0]
        if why:
            reasons = "; ".join(dict.fromkeys(why for _, why, _ in ways))
            raise SolveError(f"{NONE_FOUND}: {reasons}", name="waypoints")
        listed = tuple((cost, why or ("" if k == 0 else "dearer")) for k, (cost, why, _) in enumerate(ways))
        least = checked_bound(bound, length) or 0.0
        return WaypointPlan(self.machine, joints, length, least, listed, self._between(joints))

    def _begun(self, make: Callable[[NDArray[np.intp]], Searched], every: int) -> tuple[Searched, NDArray[np.intp]]:
        """A search of one of so many waypoints, of fewer where that were more postures than memory is for."""
        while True:
            chosen = self._every(every)
            try:
                return make(chosen), chosen
            except ProblemError as error:
                if error.name != POSTURES or len(chosen) == 2:
                    raise
            every *= 2

    def _in_pieces(self, search: Search, chosen: NDArray[np.intp]) -> WaypointPlan:
        """The cheapest way with the fewest reconfigurations, seen from waypoints that are searched already."""
        while True:
            found = fewest_pieces(search)
            if found is None:
                raise self._ended(search, chosen)
            pieces, bound = found
            breaks = [(int(chosen[piece.last]), int(chosen[piece.last + 1])) for piece in pieces[:-1]]
            # a reconfiguration lies between two waypoints, and what is drawn between others has to be right
            more = np.union1d(chosen, np.concatenate([chosen, *(np.arange(*pair) for pair in breaks)]))
            if len(more) == len(chosen):
                parts = [self._drawn(chosen[piece.first : piece.last + 1], piece.joints)[2] for piece in pieces]
                joints, after = np.concatenate(parts), tuple(one for one, _ in breaks)
                why, wrong = self._wrong(joints, after)
                more = np.union1d(chosen, wrong)
                if not why:
                    length = self._length(joints, after)
                    ways, between = ((length, ""),), self._between(joints, after)
                    least = checked_bound(bound, length) or 0.0
                    return WaypointPlan(self.machine, joints, length, least, ways, between, after)
                if len(more) == len(chosen):
                    raise SolveError(f"no way in {len(pieces)} pieces keeps all limits: {why}", name="waypoints")
            chosen = more
            search = self._search(chosen)

    def _between(self, joints: Array, breaks: tuple[int, ...] = ()) -> Clearance | None:
        """What is proven of straight lines from waypoint to waypoint, one of each a second, but for breaks."""
        if self.around is None:
            return None
        numbers, last = np.arange(len(joints), dtype=float), len(joints) - 1.0
        rates = np.abs(np.diff(joints, axis=0))
        rates[list(breaks)] = 0.0

        def along(at: Array) -> Array:
            place = at * last
            held = np.isin(np.floor(place), breaks)  # until the next waypoint, where the arm is back
            place = np.where(held, np.floor(place), place)
            return np.stack([np.interp(place, numbers, column) for column in joints.T], axis=1)

        return clearance_of(self.around, along, numbers / last, last, rates, np.zeros_like(rates), False)

    def _every(self, every: int) -> NDArray[np.intp]:
        """One of so many waypoints, the first and the last as well."""
        count = len(self.places)
        return np.unique(np.linspace(0, count - 1, -(-(count - 1) // every) + 1).round().astype(int))

    def _by_sections(self) -> list[tuple[float, str, Array]]:
        """Ways beside the cheapest found by sections, in which the joint nearest to the base, that moves all others, is
        held.

        Raises:
            SolveError: None leads through the waypoints that were searched.
        """
        robot, found = self.machine.robot, list[tuple[float, str, Array]]()
        names = [joint.name for joint in robot.path_to(robot.tip_link) if joint.name in robot.joint_names]
        held = robot.joint_names.index(names[0])
        low, high = self.lower[held], self.upper[held]
        slides = robot.moving_joints[held].kind == "prismatic"

        def sections(chosen: NDArray[np.intp], radius: float = RADII[1]) -> Sections:
            space, instants, times, cost, far = self._searched(chosen)
            values = values_of(slides, low, high, float(far[:, held].min()))
            told = self._told(chosen)
            return Sections(space, instants, times, cost, far, joint=held, values=values, radius=radius, **told)

        # ways with short steps are seen in finer charts, at few waypoints
        search, chosen = self._begun(lambda some: sections(some, RADII[0]), -(-len(self.places) // FEW))
        found += [self._drawn(chosen, path) for path in search.ways()[:1]]
        # steps from one curve to the next are no shorter than between charts
        least = int(np.ceil(min(SPACED / np.delete(self.step, held).min(), len(self.places))))
        for every in SPARSE:
            search, chosen = self._begun(sections, max(min(every, len(self.places) // INSTANTS), least, 1))
            paths, end = search.ways(), None
            if not paths and any(not why for _, why, _ in found):
                break
            if not paths and (empty := [k for k, charts in enumerate(search.covered) if not len(charts)]):
                at, name = float(chosen[empty[0]]), robot.joint_names[held]
                words = f"{NONE_FOUND}: none was found at waypoint {at:g} with {name!r} where it was held"
                end = SolveError(words, name=name, time=at)
            elif not paths:
                end = dead_end(search, WAYPOINT, proven=False)
                gives = () if end is None else end.gives
                paths = [one.joints for one in gives if one.kind in KINDS and one.amount <= MISSED]
            found += [self._drawn(chosen, path) for path in paths[:DRAWN]]
            if any(not why for _, why, _ in found):
                break
            if not paths:
                raise end or SolveError(NONE_FOUND, name="waypoints")
        return found

    def _search(self, chosen: NDArray[np.intp]) -> Search:
        """Of the postures at some waypoints."""
        return Search(*self._searched(chosen), **self._told(chosen))

    def _searched(self, chosen: NDArray[np.intp]) -> tuple[Any, ...]:
        """What a search of some waypoints takes."""
        sets = SelfMotions(self.space, self.sets.equations, self.sets.targets[chosen])
        instants = [Instant(sets, k) for k in range(len(chosen))]
        return self.space, instants, chosen.astype(float), self.cost, np.diff(chosen)[:, None] * self.step

    def _told(self, chosen: NDArray[np.intp]) -> dict[str, Any]:
        return {"seeds": lambda k: self._seeds(int(chosen[k])), "surroundings": self.around}

    def _ended(self, search: Search, chosen: NDArray[np.intp]) -> SolveError:
        """Where no way goes on, at first seen from the waypoints that were searched, then from each of those there."""
        end = dead_end(search, WAYPOINT)
        if end is None:
            return SolveError("no way goes through the waypoints", name="waypoints")
        assert end.time is not None
        closer = np.union1d(chosen, np.arange(int(end.time), int(end.until) + 1))
        return (None if len(closer) == len(chosen) else dead_end(self._search(closer), WAYPOINT)) or end

    def _drawn(self, chosen: NDArray[np.intp], path: Array) -> tuple[float, str, Array]:
        """A way through all waypoints beside one through some of them, from the first of these to the last.

        Returns:
            Its length, what is wrong with it where it goes through all there are, and its joints.
        """
        times = np.arange(chosen[0], chosen[-1] + 1.0)
        numbers = [Instant(self.sets, k) for k in range(int(chosen[0]), int(chosen[-1]) + 1)]
        far, bounds = np.repeat(self.step[None], len(numbers) - 1, axis=0), (self.lower, self.upper)
        start = self._through(chosen, path)
        joints = drawn_tight(start, numbers, self.cost, times, far, bounds, self.around, (WIDTH, TIGHT))
        whole = len(joints) == len(self.places)
        return self._length(joints), self._wrong(joints)[0] if whole else "", joints

    def _task(self, number: int) -> TipTask:
        return TipTask(position=self.places[number], orientation=self.turns[number])

    def _seeds(self, number: int) -> Array:
        """Postures at a waypoint, looked for once."""
        if number not in self._known:
            self._known[number] = self._sought(number)
        return self._known[number]

    def _sought(self, number: int) -> Array:
        listed = self.sets.listed(number)
        try:
            told: dict[str, Any] = {"seed": self.seed + number, "limits": self.kept, "starts": STARTS}
            found = postures_of(self.sets.equations, self.sets.targets[number], **told)
        except Unreachable as error:
            if len(listed):
                return listed
            words = f"waypoint {number} at {self.places[number].round(6).tolist()} m: {error}"
            raise Unreachable(words, **{**vars(error), "time": float(number)}) from error
        return np.vstack([listed, [one.joints for one in found]])

    def _through(self, chosen: NDArray[np.intp], path: Array) -> Array:
        """Joints at all waypoints, (N, n), from the first of some to the last, turned within the limits."""
        numbers = np.arange(chosen[0], chosen[-1] + 1)
        joints = np.column_stack([np.interp(numbers, chosen, column) for column in path.T])
        on, good = self.sets.corrected(numbers, joints)
        joints[good] = on[good]
        for j in np.flatnonzero(self.space.periodic & np.isfinite(self.lower) & np.isfinite(self.upper)).tolist():
            middle = (self.lower[j] + self.upper[j] - joints[:, j].min() - joints[:, j].max()) / 2
            joints[:, j] += TURN * np.round(middle / TURN)
        return joints

    def _length(self, joints: Array, breaks: tuple[int, ...] = ()) -> float:
        return float(np.delete(self.cost.of(np.diff(joints, axis=0), 1.0), list(breaks)).sum())

    def _wrong(self, joints: Array, breaks: tuple[int, ...] = ()) -> tuple[str, NDArray[np.intp]]:
        """What limit a way does not keep, "" if none, and the waypoints where it keeps one not, or is off."""
        names, numbers = self.machine.robot.joint_names, np.arange(len(joints))
        error = np.abs(self.sets.linearised(numbers, joints)[0]).max(axis=1)
        over = np.maximum(joints - self.upper, self.lower - joints)
        steps = np.abs(np.diff(joints, axis=0)) - self.step
        steps[list(breaks)] = -self.step
        far = (steps > WHOLE).any(axis=1)
        wrong = (error > MISSED) | (over > WHOLE).any(axis=1)
        wrong[:-1] |= far
        wrong[1:] |= far
        near: NDArray[np.bool_] = np.zeros(len(joints), dtype=bool)
        if self.around is not None:
            times, clearance = numbers.astype(float), self.around.clearance
            near = np.asarray(
                (distances_along(self.around, np.zeros(0), joints, times, clearance) < clearance).any(axis=1)
            )
        words = ""
        if error.max() > MISSED:
            words = f"waypoint {int(error.argmax())} is missed by {error.max():.2g} m or rad"
        elif over.max() > WHOLE:
            k, j = np.unravel_index(int(over.argmax()), over.shape)
            words = f"joint {names[j]!r} passes its limit by {over.max():.2g} at waypoint {k}"
        elif far.any():
            k, j = np.unravel_index(int(steps.argmax()), steps.shape)
            words = f"joint {names[j]!r} moves {steps.max() + self.step[j]:.3g} from waypoint {k} to the next"
        elif self.around is not None and near.any():
            worst: Touch = touches(self.around, np.zeros(0), joints, numbers.astype(float))[0]
            words = f"touches: {worst.bodies[0]} and {worst.bodies[1]} at waypoint {worst.time:g}"
        return words, np.flatnonzero(wrong | near)


def _step(step: Any, size: int) -> Array:
    """How far each joint may move, (n,)."""
    try:
        given = floats(step)
        if given.shape in ((), (1,), (size,)) and (given > 0).all():
            return np.array(np.broadcast_to(given, (size,)))
    except NOT_NUMBERS:
        pass
    words = f"step must be positive, one number or one for each of {size} joints, not {step!r}"
    raise ProblemError(words, name="step", value=step, limit=0.0)


def _poses(positions: ArrayLike, quaternions: ArrayLike) -> tuple[Array, Array]:
    """Places (N, 3) and rotations (N, 3, 3)."""
    found = []
    for what, values, size in (("positions", positions, 3), ("quaternions", quaternions, 4)):
        words = f"{what} must be finite numbers of shape (N, {size}) with N > 1"
        try:
            array = floats(values)
        except NOT_NUMBERS as error:
            raise ProblemError(words, name=what, value=values, limit=size) from error
        if array.ndim != 2 or array.shape[1] != size or len(array) < 2 or not np.isfinite(array).all():
            raise ProblemError(f"{words}, not {array.shape}", name=what, value=array.shape, limit=size)
        found.append(array)
    places, turns = found
    if len(places) != len(turns):
        words = f"there are {len(places)} positions and {len(turns)} quaternions"
        raise ProblemError(words, name="quaternions", value=len(turns), limit=len(places))
    sizes = np.linalg.norm(turns, axis=1)
    if not (sizes > 0).all():
        raise ProblemError(f"quaternion {int(sizes.argmin())} is zero", name="quaternions", value=0.0)
    return places, np.asarray(Rotation.from_quat(turns[:, [1, 2, 3, 0]]).as_matrix())
