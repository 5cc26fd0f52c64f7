"""What a machine may touch: its own links, and obstacles around it, at rest or moving; how its joints move the pairs.

A pair of bodies is seen from where both hang: the last link that carries them both, or the world. Only what lies
between the two moves them towards each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import Array, checked_flag, checked_indices, checked_nonnegative
from models.errors import ModelError
from models.input_files import INPUT_LIMITS
from models.machines.machine import Machine
from models.machines.moving_obstacle import MovingObstacle
from models.machines.pair_gradients import WORLD, Placed, distance_gradients
from models.robot.kinematics import link_frames
from models.robot.robot import Robot
from models.shapes.bodies import Body, LinkMesh, MissingRule, RigidParts, collision_bodies, lever_arms
from models.shapes.distance import COLUMNS, column, distance, pair_function, soft_minimum
from models.shapes.pairs import ASSUMED, COVERED, IGNORED, IMMOBILE, SRDF, Reason, checked_pairs
from models.shapes.shapes import KINDS, Box, Shape, checked_shape
from models.spatial import Expression, Frame, expression

FINEST = 1e-6
"""m: of the least of several distances."""


class Levers(NamedTuple):
    """How the configuration moves each of n pairs, one body seen from the other.

    A coordinate of rate r moves no point faster than its lever times |r|, and turns no faster than its turn times |r|.

    Attributes:
        base, base_turns: Of the base's configuration. Shape (n, base_size).
        joints, joint_turns: Of the joints. Shape (n, joint_size).
    """

    base: Array
    base_turns: Array
    joints: Array
    joint_turns: Array


@dataclass(frozen=True, eq=False)
class CollisionScene:
    """The bodies of a machine and the obstacles around it, and which of them are looked at, pair by pair.

    Attributes:
        machine: Any machine; the <collision> shapes of its robot are its bodies, see `models.shapes.bodies`.
        obstacles: Shapes in world, and moving ones.
        clearance: How far bodies and obstacles have to be apart, m.
        ignored: Pairs of names of links that are not looked at, beside neighbours and what never or always touches; or
            of a link and an obstacle, "obstacle 0".
        srdf: File whose pairs are not looked at either, or None.
        folders: Where meshes are looked for.
        missing: "raise" where a mesh is missing; "skip" goes on without it, and warns.
        limits: Whether the joints keep to the robot's position limits, by which pairs are left that never touch.
        covered: Bodies that stand for the meshes of links, as of `models.shapes.bodies.collision_bodies`; from files of
            the meshes if None, and in either case told afterwards.
        bodies: All that is looked at: of the links, obstacles, hulls of meshes.
        pairs: Of each pair the two bodies and the frame that they are seen from, -1 for the world. Shape (n, 3).
        covers: Of pairs of hulls, by their places, all pairs of the bodies that cover the two meshes; hulls are as far
            apart as they are, or as the nearest of these. Shape (m, 2) each. None where some of them always touch.
        left: Pairs of names that are not looked at, and why.

    Raises:
        ModelError: A clearance below zero, an obstacle that is no shape, a name that there is none of, a mesh that is
            missing.
    """

    machine: Machine
    obstacles: Sequence[Shape | MovingObstacle] = ()
    clearance: float = 0.0
    ignored: Sequence[tuple[str, str]] = ()
    srdf: str | Path | None = None
    folders: Sequence[str | Path] = ()
    missing: MissingRule = "raise"
    limits: bool = True
    covered: Mapping[tuple[str, int], tuple[Body, ...]] | None = None
    bodies: tuple[Placed, ...] = field(init=False, repr=False)
    pairs: Array = field(init=False, repr=False)
    covers: dict[int, Array] = field(init=False, repr=False)
    left: dict[tuple[str, str], Reason] = field(init=False, repr=False)
    _parts: RigidParts = field(init=False, repr=False)
    _carriers: tuple[str, ...] = field(init=False, repr=False)
    _held: dict[int, tuple[tuple[int, int], ...]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        given = (self.obstacles,) if isinstance(self.obstacles, (*KINDS, MovingObstacle)) else self.obstacles
        found = _listed(given, "obstacles")
        for number, one in enumerate(found):
            shape = (
                one.shape if isinstance(one, MovingObstacle) else checked_shape(one, "scene", f"obstacles[{number}]")
            )
            if isinstance(shape, Box) and not np.isfinite(shape.size).all():
                message = f"scene: obstacles[{number}] is a box without ends; give a HalfSpace or its size"
                raise ModelError(message, name=f"obstacles[{number}]", value=shape.size)
        object.__setattr__(self, "obstacles", found)
        near = checked_nonnegative(self.clearance, "scene", "clearance", "m")
        object.__setattr__(self, "clearance", near)
        robot = getattr(self.machine, "robot", None)
        if not isinstance(robot, Robot):
            message = f"scene: machine must be a FixedBase(robot) or another machine, not {self.machine!r}"
            raise ModelError(message, name="machine", value=self.machine)
        own = collision_bodies(
            robot, folders=_listed(self.folders, "folders"), missing=self.missing, covered=self.covered
        )
        object.__setattr__(self, "covered", _by_mesh(robot, own))
        links, around = self._told()
        reach: dict[str, Any] = (
            {} if checked_flag(self.limits, "scene", "limits") else {"lower": -np.inf, "upper": np.inf}
        )
        known = checked_pairs(robot, own, ignored=links, srdf=self.srdf, clearance=near, **reach)
        object.__setattr__(self, "_parts", RigidParts.of(robot))
        beside, still = self._beside_obstacles(own, around)
        object.__setattr__(self, "left", {**known.left, **still})
        self._place(own, known.checked, beside)

    def _told(self) -> tuple[list[tuple[str, str]], set[tuple[str, str]]]:
        """Pairs of links that are ignored, and those of a link and an obstacle."""
        names = {f"obstacle {number}" for number in range(len(self.obstacles))}
        ignored = [_pair(each, number) for number, each in enumerate(_listed(self.ignored, "ignored"))]
        around = {pair for pair in ignored if names & set(pair)}
        for pair in around:
            for name in set(pair) - names:
                self.machine.robot.link(name)
        return [pair for pair in ignored if pair not in around], around

    def _beside_obstacles(
        self, own: Sequence[Body], told: set[tuple[str, str]]
    ) -> tuple[list[tuple[int, int]], dict[tuple[str, str], Reason]]:
        """Bodies and obstacles that may touch, by their numbers; and why others are left."""
        pairs, left = [], dict[tuple[str, str], Reason]()
        for number, one in enumerate(self.obstacles):
            name = f"obstacle {number}"
            for i, body in enumerate(own):
                if {(body.link, name), (name, body.link)} & told:
                    left[body.link, name] = IGNORED
                elif not self._moves(body.link) and not isinstance(one, MovingObstacle):
                    left[body.link, name] = IMMOBILE
                else:
                    pairs.append((i, number))
        return pairs, left

    def _place(
        self, own: Sequence[Body], checked: Sequence[tuple[int, int]], beside: Sequence[tuple[int, int]]
    ) -> None:
        """What is looked at: bodies of links, obstacles and hulls of meshes, each on its frame, and their pairs."""
        close = self._close_meshes(own, checked)
        covered = {pair for pairs in close.values() for pair in pairs}
        frames = dict.fromkeys([body.link for body in own] + [self._seen_from(own[i], own[j]) for i, j in checked])
        places = {link: k for k, link in enumerate(frames)}
        bodies = [Placed(name, body.shape, places[body.link]) for name, body in zip(_named(own), own, strict=True)]
        moving = 0
        for number, one in enumerate(self.obstacles):
            if isinstance(one, MovingObstacle):
                bodies.append(Placed(f"obstacle {number}", one.shape, len(places) + moving))
                moving += 1
            else:
                bodies.append(Placed(f"obstacle {number}", one, WORLD))
        pairs = [(i, j, places[self._seen_from(own[i], own[j])]) for i, j in checked if (i, j) not in covered]
        held: dict[int, tuple[tuple[int, int], ...]] = {}
        covers: dict[int, Array] = {}
        hulls: dict[LinkMesh, int] = {}
        for (one_mesh, other_mesh), stand_ins in close.items():
            first, second = (own[k] for k in stand_ins[0])
            for mesh, body in ((one_mesh, first), (other_mesh, second)):
                if mesh not in hulls:
                    hulls[mesh] = len(bodies)
                    bodies.append(Placed(f"{body.link} hull {len(hulls)}", mesh.hull, places[body.link]))
            held[len(pairs)] = tuple(stand_ins)
            if self.left.get((first.link, second.link)) not in ASSUMED:
                of = [[k for k, body in enumerate(own) if body.mesh is mesh] for mesh in (one_mesh, other_mesh)]
                covers[len(pairs)] = np.array([(i, j) for i in of[0] for j in of[1]])
            pairs.append((hulls[one_mesh], hulls[other_mesh], places[self._seen_from(first, second)]))
        pairs += [(i, len(own) + number, WORLD) for i, number in beside]
        object.__setattr__(self, "_carriers", tuple(frames))
        object.__setattr__(self, "bodies", tuple(bodies))
        object.__setattr__(self, "pairs", np.array(pairs, dtype=int).reshape(-1, 3))
        object.__setattr__(self, "covers", covers)
        object.__setattr__(self, "_held", held)

    def _seen_from(self, one: Body, other: Body) -> str:
        """The link that two bodies are seen from: the last rigid part that carries both."""
        return self._parts.common_part(*(self._parts.of_link[body.link] for body in (one, other)))

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of each pair."""
        return tuple((self.bodies[one].name, self.bodies[other].name) for one, other, _ in self.pairs)

    def told_as(self, pair: int) -> tuple[str, str]:
        """How a pair is named in `ignored`: by the links that its bodies belong to, or as an obstacle."""
        placed = [self.bodies[body] for body in self.pairs[pair, :2]]
        own = range(len(self._carriers))
        one, other = (self._carriers[body.frame] if body.frame in own else body.name for body in placed)
        return one, other

    @property
    def disabled(self) -> list[tuple[str, str]]:
        """Pairs of links that the SRDF file names."""
        return [pair for pair, why in self.left.items() if why == SRDF]

    @property
    def assumed(self) -> dict[str, str]:
        """Pairs of links that are left out by assumption, "one and other": no proof says that they always touch."""
        looked_at = {frozenset(self.told_as(pair)) for pair in self._held}  # by their hulls
        return {
            " and ".join(pair): why.value
            for pair, why in self.left.items()
            if why in ASSUMED and frozenset(pair) not in looked_at
        }

    @property
    def moves_by_itself(self) -> bool:
        """Whether an obstacle moves."""
        return any(isinstance(one, MovingObstacle) for one in self.obstacles)

    def placements(self, base: Expression, q: Expression, time: Expression = 0.0) -> Expression:
        """Frames of bodies: rotation column by column, then position, one below the other. Shape (12 F, 1)."""
        frames = self._frames(base, q, time)
        columns = [part for frame in frames for part in (ca.vec(frame.rotation), frame.position)]
        return ca.densify(ca.vertcat(*columns)) if columns else expression(q)[:0]

    def distances(
        self,
        base: Expression,
        q: Expression,
        time: Expression = 0.0,
        *,
        pairs: Sequence[int] | None = None,
        rounding: float = 0.0,
    ) -> Expression:
        """Signed distances of pairs, m, exact or from below; see `models.shapes.distance`. Shape (n, 1).

        Of two hulls of meshes it is that of their covers: they are no nearer.

        Args:
            base, q: Configuration of the machine. time: s.
            pairs: Which; all if None. rounding: As of `distance`, m.

        Raises:
            ModelError: Pairs that there are none of, a rounding below zero.
        """
        chosen, rounding = self._asked(pairs, rounding)
        frames = [*self._frames(base, q, time), None]
        columns: dict[int, Expression] = {}

        def side(body: int) -> Expression:
            if body not in columns:
                placed = self.bodies[body]
                columns[body] = column(placed.shape, frames[placed.frame])
            return columns[body]

        def between(one: int, other: int) -> Expression:
            a, b = self.bodies[one], self.bodies[other]
            kinds = type(a.shape), type(b.shape)
            if set(kinds) <= COLUMNS.keys():
                return pair_function(*kinds, rounding)(side(one), side(other))
            return distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding)

        found = []
        for pair in chosen:
            each = [between(*both) for both in self._held.get(pair, (self.pairs[pair, :2].tolist(),))]
            found.append(each[0] if len(each) == 1 else soft_minimum(each, rounding / 4 + FINEST))
        return ca.vertcat(*found) if found else expression(q)[:0]

    def distance_gradients(self, *, pairs: Sequence[int] | None = None, rounding: float = 0.0) -> Any:
        """Function (base, q, time) -> signed distances of pairs and their gradients; see `distances`.

        Distances have shape (n, 1), m, gradients by base and joints shape (n, base_size + joint_size). It takes all
        pairs of two kinds of shapes at once, and no derivatives but those of frames: a distance of rigid bodies changes
        with the twist of one seen from the other alone, by its wrench. That is some fifteen times faster than
        `distances` and its Jacobian. Of a base with a quaternion, gradients hold along rates that keep it a unit.

        Args, Raises: As of `distances`.
        """
        chosen, rounding = self._asked(pairs, rounding)
        groups = [self._held.get(pair, (tuple(self.pairs[pair, :2].tolist()),)) for pair in chosen]
        softness = rounding / 4 + FINEST
        return distance_gradients(self.machine, self.bodies, self._carriers, self._moving, groups, rounding, softness)

    def _asked(self, pairs: Sequence[int] | None, rounding: float) -> tuple[list[int], float]:
        """Pairs by their places, and a rounding, checked."""
        every, owner = np.arange(len(self.pairs)), "scene"
        given = every if pairs is None else every[:0] if isinstance(pairs, list | tuple) and not pairs else pairs
        chosen = checked_indices(given, len(every), owner, "pairs").ravel().tolist()
        return chosen, checked_nonnegative(rounding, owner, "rounding", "m")

    @cached_property
    def levers(self) -> Levers:
        """How the configuration moves each pair.

        Raises:
            ModelError: A slide without limits.
        """
        n, dof, size = len(self.pairs), self.machine.robot.dof, self.machine.base_size
        joints, turns = np.zeros((n, dof)), np.zeros((n, dof))
        base, base_turns = np.zeros((n, size)), np.zeros((n, size))
        known: dict[tuple[int, int], Levers] = {}
        for row, (one, other, seen) in enumerate(self.pairs.tolist()):
            for pair in [(one, other), *self.covers.get(row, np.zeros((0, 2), dtype=int)).tolist()]:
                for body in pair:
                    if (body, seen) not in known:
                        known[body, seen] = self._levers_of(self.bodies[body], seen)
                both = [known[body, seen] for body in pair]
                for most, *found in zip((base, base_turns, joints, turns), *both, strict=True):
                    most[row] = np.maximum(most[row], sum(found))
        return Levers(base, base_turns, joints, turns)

    def check_motions(self, begin: float, end: float) -> None:
        """Raise ModelError where the motion of an obstacle is not defined at a time between two, s."""
        for one in self.obstacles:
            if isinstance(one, MovingObstacle):
                one.check(begin, end)

    # ---- inside ------------------------------------------------------------------------------------------------

    def _frames(self, base: Expression, q: Expression, time: Expression) -> list[Frame]:
        machine = self.machine
        frames = link_frames(machine.robot, q, machine.world_from_base(base))
        return [*(frames[link] for link in self._carriers), *self._moving(time)]

    def _moving(self, time: Expression) -> list[Frame]:
        """Frames of the obstacles that move."""
        return [one.frame(time) for one in self.obstacles if isinstance(one, MovingObstacle)]

    def _close_meshes(
        self, own: Sequence[Body], checked: Sequence[tuple[int, int]]
    ) -> dict[tuple[LinkMesh, LinkMesh], list[tuple[int, int]]]:
        """Pairs of bodies, by the two meshes that they cover, of links two or three joints apart.

        These may be a few millimetres from each other by design, less than covers stand out: their hulls are looked at,
        and those of meshes whose covers always touch.
        """
        found: dict[tuple[LinkMesh, LinkMesh], list[tuple[int, int]]] = {}
        for i, j in checked:
            one, other = own[i], own[j]
            up, down = self._parts.path(*(self._parts.of_link[body.link] for body in (one, other)))
            # meshes of links with few joints between them are looked at as they are, not as their covers
            near = len(up) + len(down) <= 3 or self.left.get((one.link, other.link)) == COVERED
            if near and one.mesh is not None and other.mesh is not None:
                found.setdefault((one.mesh, other.mesh), []).append((i, j))
        return found

    def _moves(self, link: str) -> bool:
        """Whether a link ever moves in world."""
        return bool(self.machine.base_size) or any(joint.moves for joint in self.machine.robot.path_to(link))

    def _levers_of(self, placed: Placed, seen: int) -> Levers:
        """Of one body from where it is seen: a link's frame that it hangs on, or -1, the world."""
        robot, parts, size = self.machine.robot, self._parts, self.machine.base_size
        joints, turns, base, base_turns = np.zeros(robot.dof), np.zeros(robot.dof), np.zeros(size), np.zeros(size)
        found = Levers(base, base_turns, joints, turns)
        if not 0 <= placed.frame < len(self._carriers):
            return found  # an obstacle
        link, above = self._carriers[placed.frame], robot.root if seen == WORLD else self._carriers[seen]
        way = parts.path(parts.of_link[above], parts.of_link[link])[1]
        endless = np.full(robot.dof, np.inf)
        low, high = (robot.lower, robot.upper) if self.limits else (-endless, endless)
        own, reach = lever_arms(
            robot, [(step, True) for step in way], placed.shape.placed(*parts.pose[link]), low, high
        )
        for (joint, *_), arm in zip(way, own, strict=True):
            column, ratio, _ = robot.drives[joint.name]
            slides = joint.kind == "prismatic"
            joints[column] += abs(ratio) * (1.0 if slides else arm)
            turns[column] += 0.0 if slides else abs(ratio)
        if not np.isfinite(joints).all() or not np.isfinite(reach):
            name = next(joint.name for joint, *_ in way if joint.kind == "prismatic")
            message = f"scene: joint {name!r} slides without limits; give it some"
            raise ModelError(message, name=name, value=np.inf)
        if seen == WORLD and size:
            planar = size == 3
            # a unit quaternion that changes by dq turns by 2 |dq|
            base[:] = (1.0, 1.0, reach) if planar else [1.0] * 3 + [2.0 * reach] * 4
            base_turns[:] = (0.0, 0.0, 1.0) if planar else [0.0] * 3 + [2.0] * 4
        return found


def _named(bodies: Sequence[Body]) -> list[str]:
    """Names of bodies: of their links, with a number where a link has several."""
    links = [body.link for body in bodies]
    return [link if links.count(link) == 1 else f"{link}/{links[:k].count(link) + 1}" for k, link in enumerate(links)]


def _by_mesh(robot: Robot, bodies: Sequence[Body]) -> dict[tuple[str, int], tuple[Body, ...]]:
    """The bodies that cover each mesh, by its link and its place among the collision shapes of the link."""
    found: dict[tuple[str, int], tuple[Body, ...]] = {
        (link.name, number): ()
        for link in robot.links
        for number, shape in enumerate(link.collisions)
        if shape.kind == "mesh"
    }
    for body in bodies:
        if body.mesh is not None:
            found[body.link, body.mesh.number] += (body,)
    return found


def _listed(values: Any, what: str) -> tuple[Any, ...]:
    if not isinstance(values, list | tuple) or len(values) > INPUT_LIMITS.count:
        message = f"scene: {what} must be a list of at most {INPUT_LIMITS.count}, not {repr(values)[:80]}"
        raise ModelError(message, name=what, value=values, limit=INPUT_LIMITS.count)
    return tuple(values)


def _pair(value: Any, number: int) -> tuple[str, str]:
    if isinstance(value, tuple | list) and len(value) == 2 and all(isinstance(name, str) for name in value):
        return value[0], value[1]
    message = f"scene: ignored[{number}] must be two names, not {value!r}"
    raise ModelError(message, name="ignored", value=value)
