"""The cheapest way of an arm through poses: all joints at many waypoints, and a bound of its cost.

The cost is the weighted sum of the ways of all joints, or of the largest of them, which may be a time; between two
waypoints no joint moves more than a step. Some of the waypoints are searched whole (see `search.search`); since a
way through all of them is no shorter than through some, what bounds these bounds all. The best ways found are then
drawn tight through all waypoints: dynamic programming over the postures beside the way, nearer and nearer, in which
what is not allowed is dear, so that a way may come out of it as well. Where no way goes through all, one in the fewest
pieces may be asked for (see `ocp.motion.search.reconfigurations`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from models import CollisionScene, FixedBase
from models.arrays import Array
from ocp.audit.clearance import Clearance
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, SolveError, checked_choice, checked_count, checked_instance, floats
from ocp.motion.builders.clearance import clearance_of
from ocp.motion.local.collisions import Collision, distances_along, find_collisions
from ocp.motion.local.inverse_kinematics import LARGEST_SEED, Unreachable, idle_positions
from ocp.motion.plan.planner import clear_of
from ocp.motion.plan.waypoint_plan import WaypointPlan
from ocp.motion.search.charts import Instant, SelfMotions
from ocp.motion.search.dead_end import GiveKind, dead_end
from ocp.motion.search.joint_space import TOLERANCE, Held, JointSpace
from ocp.motion.search.reconfigurations import Piece, Sections, SectionSettings, fewest_pieces, values_of
from ocp.motion.search.search import FREE, Search, SearchSettings, checked_bound
from ocp.motion.search.steps import Homogeneous, Largest, Length
from ocp.motion.search.value import drawn_tight
from ocp.motion.tasks.checks import checked_numbers
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["Reconfigurations", "WayCost", "WaypointPlan", "plan_waypoints"]

WayCost: TypeAlias = Literal["length", "largest", "time"]
Reconfigurations: TypeAlias = Literal["forbidden", "counted"]

WAYPOINT = "waypoint {:g}"
POSTURES = "postures"
"""What an error is about where there are more than memory is for."""
NONE_FOUND = "no way through the waypoints keeps all limits"


@dataclass(frozen=True)
class WaypointSettings:
    """Which waypoints are searched, and how ways through all are drawn beside those that are found.

    Attributes:
        stride: With at most one free direction one of so many waypoints is searched, then one of half as many, where
            none of the ways found goes through all.
        few: Steps between the waypoints that are searched first with two free directions, where short ways are seen.
        steps: Steps between those that are searched next, about, where there are so many ...
        strides: ... but one of so many at least, and one of so many where no way goes through all.
        drawn: Ways of a search that are drawn tight, the cheapest first.
        search, sections: Of the searches with at most one free direction, and with two.
        widths: Between postures beside a way that is drawn tight, at first and at last, rad or m.
        missed: By which poses may be, m and rad: what the last width leaves.
    """

    stride: int = 5
    few: int = 6
    steps: int = 20
    strides: tuple[int, int] = (10, 5)
    drawn: int = 2
    widths: tuple[float, float] = (0.06, 1e-6)
    missed: float = 1e-6
    search: SearchSettings = field(default_factory=SearchSettings)
    sections: SectionSettings = field(default_factory=SectionSettings)


class _Way(NamedTuple):
    """Joints (N, n) through all waypoints beside what a search found, what is wrong with them, and where.

    Attributes:
        after: The waypoints after which the arm reconfigures.
    """

    cost: float
    why: str
    wrong: NDArray[np.intp]
    joints: Array
    after: tuple[int, ...] = ()


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
            `ocp.motion.search.reconfigurations`), and no bound is known.
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
    clearance_constraints = clear_of(machine, obstacles, clearance, ignored, srdf, folders, missing, told)
    around = None if clearance_constraints is None else clearance_constraints.scene
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
        around: CollisionScene | None,
        seed: int,
        settings: WaypointSettings = WaypointSettings(),
    ) -> None:
        self.settings = settings
        self.machine, self.places, self.turns, self.step, self.around = machine, places, turns, step, around
        self.seed, self.kept, self.cost = seed, limits.joints, cost
        bounds = limits.bounds(machine)
        self.lower, self.upper = bounds.lower, bounds.upper
        self.space = JointSpace(machine, bounds.lower, bounds.upper, np.ones(machine.joint_size))
        free = bind(machine, self._task(0))
        equations = Held(machine, free.bound, tuple(np.flatnonzero(free.idle).tolist()))
        at = idle_positions(self.lower, self.upper)
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
        # with two free directions it is held that is nearest to the base: it moves all others
        robot = machine.robot
        names = [joint.name for joint in robot.path_to(robot.tip_link) if joint.name in robot.joint_names]
        self._held = robot.joint_names.index(names[0]) if self.sets.size > 1 else None

    def plan(self, counted: bool) -> WaypointPlan:
        """The cheapest way that goes on through all waypoints; in the fewest pieces where that is asked for.

        Some waypoints are searched, what is found is drawn tight through all, and more are searched where that goes
        wrong: those where it does, and closer ones.
        """
        if counted and self.sets.size > 1:
            words = f"reconfigurations are counted with one free direction at most, not with {self.sets.size}"
            raise ProblemError(words, name="reconfigurations", value=self.sets.size, limit=1)
        strides, looks = self._strides()
        search = self._begun(strides.pop(0))
        assert search is not None
        ways, bound, cut = list[_Way](), 0.0, False
        while True:
            chains, least = self._chains(search, cut)
            if np.isfinite(least):
                bound = least if cut else max(bound, least)
                drawn = [self._drawn(search, chain) for chain in chains[: self.settings.drawn]]
                ways = drawn if cut else ways + drawn
                looks -= 1
                if any(not way.why for way in ways) and (looks <= 0 or not strides):
                    return self._made(ways, bound)
                closer = self._closer(search, ways[-1]) if chains else None
                while closer is None and strides and not cut:
                    closer = self._begun(strides.pop(0), search)
                if closer is not None:
                    search = closer
                    continue
            if cut or not counted:
                break
            cut = True
        if not np.isfinite(least):
            raise self._ended(search)
        if not chains and all(way.why for way in ways):
            ways += self._rescued(search)
        return self._made(ways, bound)

    def _chains(self, search: Search, cut: bool) -> tuple[list[list[Piece]], float]:
        """Motions through the waypoints that are searched, each in its pieces, and what none costs less than."""
        if cut:
            found = fewest_pieces(search)
            return ([], np.inf) if found is None else ([found[0]], found[1])
        paths, bound = search.ways()
        return [[Piece(0, len(path) - 1, path, search.steps(path), bound)] for path in paths], bound

    def _made(self, ways: list[_Way], bound: float) -> WaypointPlan:
        """The plan of the cheapest way that keeps all limits.

        Raises:
            SolveError: None does.
        """
        ways = sorted(ways, key=lambda way: (bool(way.why), way.cost))
        if not ways or ways[0].why:
            reasons = "; ".join(dict.fromkeys(way.why for way in ways))
            raise SolveError(f"{NONE_FOUND}{reasons and ': '}{reasons}", name="waypoints")
        best = ways[0]
        listed = tuple((way.cost, way.why or ("" if way is best else "dearer")) for way in ways)
        least, between = checked_bound(bound, best.cost) or 0.0, self._between(best.joints, best.after)
        return WaypointPlan(self.machine, best.joints, best.cost, least, listed, between, best.after)

    def _between(self, joints: Array, breaks: tuple[int, ...]) -> Clearance | None:
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

    # ---- which waypoints are searched ----------------------------------------------------------------------------

    def _strides(self) -> tuple[list[int], int]:
        """One of how many waypoints is searched, one after the other, and how many of these searches always."""
        settings, count = self.settings, len(self.places)
        if self._held is None:
            halves = int(np.log2(settings.stride)) + 1
            return [settings.stride // 2**k for k in range(halves)], 1
        # steps from one curve to the next are no shorter than between charts
        least = min(4 * settings.sections.radii[1] / np.delete(self.step, self._held).min(), count)
        some = (max(min(each, count // settings.steps), int(np.ceil(least)), 1) for each in settings.strides)
        return [-(-count // settings.few), *some], 2

    def _begun(self, stride: int, known: Search | None = None) -> Search | None:
        """A search of one of so many waypoints, of fewer where that were more postures than memory is for.

        None where these are no more than those of a search that is known.
        """
        last, before = len(self.places) - 1, 1 if known is None else len(known.times)
        while True:
            chosen = np.unique(np.linspace(0, last, -(-last // stride) + 1).round().astype(int))
            if known is not None and self._held is None:
                chosen = np.union1d(chosen, known.times.astype(int))
            if len(chosen) <= before:
                return None
            try:
                return self._search(chosen, known is not None)
            except ProblemError as error:
                if error.name != POSTURES or len(chosen) == 2:
                    raise
            stride *= 2

    def _closer(self, search: Search, way: _Way | None) -> Search | None:
        """A search of the waypoints where a way is wrong as well; None where that are no more, or too many."""
        chosen = search.times.astype(int)
        if way is None or self._held is not None or np.isin(way.wrong, chosen).all():
            return None
        try:
            return self._search(np.union1d(chosen, way.wrong))
        except ProblemError as error:
            if error.name != POSTURES:
                raise
            return None

    def _search(self, chosen: NDArray[np.intp], coarse: bool = False) -> Search:
        """Of all postures at some waypoints; with two free directions of those on some curves."""
        sets, far = SelfMotions(self.space, self.sets.equations, self.sets.targets[chosen]), np.diff(chosen)[:, None]
        told: dict[str, Any] = {"seeds": lambda k: self._seeds(int(chosen[k])), "scene": self.around}
        instants = [Instant(sets, k) for k in range(len(chosen))]
        held = self._held
        given = self.space, instants, chosen.astype(float), self.cost, far * self.step
        if held is None:
            return Search(*given, **told, settings=self.settings.search)
        slides = self.machine.robot.moving_joints[held].kind == "prismatic"
        own, limit = self.settings.sections, float((far * self.step)[:, held].min())
        curves: dict[str, Any] = {"radius": own.radii[coarse], "charts": own.charts}
        curves["values"] = values_of(slides, self.lower[held], self.upper[held], limit, own)
        return Sections(*given, **told, **curves, joint=held)

    def _ended(self, search: Search) -> SolveError:
        """Where no way goes on, at first seen from the waypoints that were searched, then from each of those there."""
        end, chosen = dead_end(search, WAYPOINT), search.times.astype(int)
        if end is None:
            return SolveError("no way goes through the waypoints", name="waypoints")
        assert end.time is not None
        closer = np.union1d(chosen, np.arange(int(end.time), int(end.until) + 1))
        return (None if len(closer) == len(chosen) else dead_end(self._search(closer), WAYPOINT)) or end

    def _rescued(self, search: Search) -> list[_Way]:
        """What comes through though no way was found: a motion that gives way, by nothing that counts.

        Raises:
            SolveError: None does.
        """
        empty = [float(time) for time, charts in zip(search.times, search.covered, strict=True) if not len(charts)]
        if empty and self._held is not None:
            name = self.machine.robot.joint_names[self._held]
            words = f"{NONE_FOUND}: none was found at waypoint {empty[0]:g} with {name!r} where it was held"
            raise SolveError(words, name=name, time=empty[0])
        end = dead_end(search, WAYPOINT, proven=False)
        if end is None:
            return []
        of_pose = [give for give in end.gives if give.kind is not GiveKind.CLEARANCE]
        paths = [give.joints for give in of_pose if give.amount <= self.settings.missed]
        if not paths:
            raise end
        return [self._drawn(search, [Piece(0, len(path) - 1, path, search.steps(path), 0.0)]) for path in paths]

    # ---- ways through all waypoints ------------------------------------------------------------------------------

    def _drawn(self, search: Search, chain: list[Piece]) -> _Way:
        """A way through all waypoints beside pieces through some of them.

        It is wrong where it reconfigures between two that are no neighbours, whatever comes of the rest.
        """
        chosen = search.times.astype(int)
        breaks = [(int(chosen[piece.last]), int(chosen[piece.last + 1])) for piece in chain[:-1]]
        joints, after = self._through(chosen, chain), tuple(one for one, _ in breaks)
        if wide := [np.arange(*pair) for pair in breaks if pair[1] > pair[0] + 1]:
            return _Way(np.inf, "it reconfigures between waypoints", np.concatenate(wide), joints, after)
        parts = []
        for piece in chain:
            rows = slice(int(chosen[piece.first]), int(chosen[piece.last]) + 1)
            instants = [Instant(self.sets, k) for k in range(len(self.places))[rows]]
            far, bounds = np.repeat(self.step[None], len(instants) - 1, axis=0), (self.lower, self.upper)
            times = np.arange(len(self.places), dtype=float)[rows]
            told = self.cost, times, far, bounds, self.around, self.settings.widths
            parts.append(drawn_tight(joints[rows], instants, *told))
        joints = np.concatenate(parts)
        steps = np.delete(self.cost.of(np.diff(joints, axis=0), 1.0), list(after))
        return _Way(float(steps.sum()), *self._wrong(joints, after), joints, after)

    def _task(self, number: int) -> TipTask:
        return TipTask(position=self.places[number], orientation=self.turns[number])

    def _seeds(self, number: int) -> Array:
        """Postures at a waypoint, looked for once."""
        if number not in self._known:
            self._known[number] = self._sought(number)
        return self._known[number]

    def _sought(self, number: int) -> Array:
        try:
            return self.sets.seeds(number, self.kept, self.seed + number)
        except Unreachable as error:
            words = f"waypoint {number} at {self.places[number].round(6).tolist()} m: {error}"
            raise Unreachable(words, **{**vars(error), "time": float(number)}) from error

    def _through(self, chosen: NDArray[np.intp], chain: list[Piece]) -> Array:
        """Joints at all waypoints, (N, n), beside pieces through some of them, each turned within the limits."""
        numbers = np.arange(len(self.places))
        path = np.concatenate([piece.joints for piece in chain])
        joints = np.column_stack([np.interp(numbers, chosen, column) for column in path.T])
        on, good = self.sets.corrected(numbers, joints)
        joints[good] = on[good]
        for piece in chain:
            rows = slice(int(chosen[piece.first]), int(chosen[piece.last]) + 1)
            joints[rows] = self.space.turned(joints[rows], self.lower, self.upper)
        return joints

    def _wrong(self, joints: Array, breaks: tuple[int, ...]) -> tuple[str, NDArray[np.intp]]:
        """What limit a way does not keep, "" if none, and the waypoints where it keeps one not, or is off."""
        names, numbers = self.machine.robot.joint_names, np.arange(len(joints))
        error = np.abs(self.sets.linearised(numbers, joints)[0]).max(axis=1)
        over = np.maximum(joints - self.upper, self.lower - joints)
        steps = np.abs(np.diff(joints, axis=0)) - self.step
        steps[list(breaks)] = -self.step
        far = (steps > TOLERANCE).any(axis=1)
        wrong = (error > self.settings.missed) | (over > TOLERANCE).any(axis=1)
        wrong[:-1] |= far
        wrong[1:] |= far
        near: NDArray[np.bool_] = np.zeros(len(joints), dtype=bool)
        if self.around is not None:
            times, clearance = numbers.astype(float), self.around.clearance
            near = np.asarray(
                (distances_along(self.around, np.zeros(0), joints, times, clearance) < clearance).any(axis=1)
            )
        words = ""
        if error.max() > self.settings.missed:
            words = f"waypoint {int(error.argmax())} is missed by {error.max():.2g} m or rad"
        elif over.max() > TOLERANCE:
            k, j = np.unravel_index(int(over.argmax()), over.shape)
            words = f"joint {names[j]!r} passes its limit by {over.max():.2g} at waypoint {k}"
        elif far.any():
            k, j = np.unravel_index(int(steps.argmax()), steps.shape)
            words = f"joint {names[j]!r} moves {steps.max() + self.step[j]:.3g} from waypoint {k} to the next"
        elif self.around is not None and near.any():
            worst: Collision = find_collisions(self.around, np.zeros(0), joints, numbers.astype(float))[0]
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
