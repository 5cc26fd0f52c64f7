"""Which bodies of a robot are checked against each other, and why the others are not."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.arrays import (
    Array,
    ArrayInput,
    checked_broadcast,
    checked_count,
    checked_each,
    checked_instance,
    checked_nonnegative,
)
from models.cache import cache_key, load_value, source_version, store_value
from models.errors import ModelError, ModelWarning
from models.robot.robot import Robot
from models.robot.urdf import parse_urdf, text_of
from models.shapes.bodies import Body, RigidParts, Step, arms
from models.shapes.hull import gap_along, nearest_directions
from models.shapes.shapes import Box, Shape


class Reason(StrEnum):
    """Why a pair of bodies is not checked."""

    NEIGHBOURS = "neighbours"
    RIGID = "one rigid part"
    ALWAYS = "always touch"
    COVERED = "always touch, perhaps only in their covers"
    """In some posture bodies overlap by no more than their covers stand out of what they cover: this may be apart."""
    NEVER = "never touch"
    SRDF = "the SRDF file"
    TOLD = "told"
    STILL = "neither moves"


NEIGHBOURS, RIGID, ALWAYS, COVERED, NEVER, SRDF, TOLD, STILL = Reason
ASSUMED = (ALWAYS, COVERED)
"""Reasons that no proof stands behind: bodies touch in each of many configurations."""
SURE = 1e-6
"""m: more than rounding takes away from a proof of distance."""


@dataclass(frozen=True)
class ProofSettings:
    """How much is tried for a pair before it is checked in any case.

    Attributes:
        first_postures: That are tried before a proof is.
        boxes: Of joint positions that a proof may take with up to three joints between the bodies.
        rounds: Of halving the boxes.
        grid: Steps of each of two joints between meshes. finer_grids: Rounds of finer ones. lowest: Places that these
            are taken around.
    """

    first_postures: int = 24
    boxes: int = 2000
    rounds: int = 40
    grid: int = 24
    finer_grids: int = 3
    lowest: int = 8


@dataclass(frozen=True)
class Pairs:
    """Pairs of bodies.

    Attributes:
        checked: Those that are checked, as indices of the bodies, the lower first.
        left: Why pairs of links are not, by their names in the order of the bodies. A pair of links with several bodies
            may be in both where only some of their bodies always touch, and one of meshes where their covers always
            touch and their convex hulls do not.
    """

    checked: tuple[tuple[int, int], ...]
    left: Mapping[tuple[str, str], Reason]


def checked_pairs(
    robot: Robot,
    bodies: Sequence[Body],
    *,
    ignored: Iterable[tuple[str, str]] = (),
    srdf: str | os.PathLike[str] | None = None,
    lower: ArrayInput = None,
    upper: ArrayInput = None,
    clearance: float = 0.0,
    seed: int = 0,
    samples: int = 1000,
) -> Pairs:
    """The pairs of a robot's bodies that may touch in some posture and not in another.

    Not checked are bodies with no moving joint between them; neighbours, with one moving joint between or with none but
    links without bodies in between; pairs that the user or an SRDF file names; bodies that touch in each of many random
    postures, and of meshes their hulls as well, which is no proof (`ASSUMED`); bodies that never touch, nor come as
    near as a clearance. The last is proven: the distance changes no faster than the joints between the two times their
    lever arms, so that the space of postures is halved until each part is settled. Where that takes too long the pair
    is checked.

    Args:
        bodies: As `bodies_of` makes them.
        ignored: Pairs of links that are not checked.
        srdf: An SRDF file, as path or text, whose <disable_collisions> are not checked.
        lower, upper: Limits of the joint vector, rad or m; a number or shape (dof,); the robot's own if None.
        clearance: m; pairs that may come as near are checked.
        seed: Of the random postures.
        samples: How many.

    Raises:
        ModelError: Unknown links (with names that come near), bodies, limits or numbers that are none, an SRDF file
            that cannot be read.

    Warns:
        ModelWarning: Links of the SRDF file that the robot has not.
    """
    owner = "checked_pairs"
    checked_instance(robot, Robot, owner, "robot")
    bodies = checked_each(bodies, Body, owner, "bodies")
    for body in bodies:
        robot.link(body.link)
    low = robot.lower if lower is None else checked_broadcast(lower, robot.dof, owner, "lower", "joints", finite=False)
    high = robot.upper if upper is None else checked_broadcast(upper, robot.dof, owner, "upper", "joints", finite=False)
    if (low > high).any():
        k = int(np.flatnonzero(low > high)[0])
        message = f"{owner}: lower {low[k]} of joint {robot.joint_names[k]!r} is above upper {high[k]}"
        raise ModelError(message, name="lower", value=float(low[k]), limit=float(high[k]))
    count = checked_count(samples, owner, "samples")
    near = checked_nonnegative(clearance, owner, "clearance", "m") + SURE
    rng = np.random.default_rng(checked_count(seed, owner, "seed", least=0, most=2**63))
    named = dict.fromkeys([] if srdf is None else _disabled(robot, srdf), SRDF)
    named |= dict.fromkeys(map(frozenset, _named(robot, ignored)), TOLD)

    key = _key(robot, bodies, low, high, named, near, count, seed)
    if (known := _read(load_value(key), bodies)) is not None:
        return known
    parts = RigidParts.of(robot)
    close = parts.close({parts.of_link[body.link] for body in bodies})
    motions = _Motions(robot, parts, low, high, _postures(robot, low, high, count, rng), near)
    checked: list[tuple[int, int]] = []
    left: dict[tuple[str, str], Reason] = {}
    for i, j in combinations(range(len(bodies)), 2):
        links = bodies[i].link, bodies[j].link
        sides = frozenset(parts.of_link[link] for link in links)
        reason = RIGID if len(sides) == 1 else named.get(frozenset(links), NEIGHBOURS if sides in close else None)
        if reason is None:
            reason, by_hulls = motions.reason(bodies[i], bodies[j])
            if by_hulls:
                left[links] = COVERED
        if reason is None:
            checked.append((i, j))
        elif left.get(links) not in ASSUMED or reason == COVERED:
            left[links] = reason
    open_links = {(bodies[i].link, bodies[j].link) for i, j in checked}
    found = Pairs(
        tuple(checked), {k: why for k, why in left.items() if k[0] != k[1] and (k not in open_links or why in ASSUMED)}
    )
    store_value(key, {"checked": found.checked, "left": [[*pair, why.value] for pair, why in found.left.items()]})
    return found


def _key(
    robot: Robot,
    bodies: Sequence[Body],
    low: Array,
    high: Array,
    named: Mapping[frozenset[str], Reason],
    near: float,
    count: int,
    seed: int,
) -> str:
    """A name for all that the pairs depend on."""
    parts: list[Any] = [low, high, near, count, seed]
    words = ["pairs", *(f"{sorted(pair)} {why}" for pair, why in named.items())]
    for joint in robot.joints:
        words.append(f"{joint.name} {joint.kind} {joint.parent} {joint.child} {robot.couplings.get(joint.name)}")
        parts += [joint.axis, joint.translation, joint.rotation]
    for body in bodies:
        words.append(f"{body.link} {type(body.shape).__name__}")
        parts += [
            body.shape.core,
            body.shape.swelling,
            body.overhang,
            np.zeros(0) if body.mesh is None else body.mesh.points,
        ]
    return cache_key(source_version(__name__), "\n".join(words), *parts)


def _read(value: Any, bodies: Sequence[Body]) -> Pairs | None:
    """Pairs as they were kept; None where it is something else."""
    try:
        checked = tuple((int(i), int(j)) for i, j in value["checked"])
        left = {(str(one), str(other)): Reason(why) for one, other, why in value["left"]}
    except (TypeError, ValueError, KeyError, AttributeError):
        return None
    sound = all(0 <= i < j < len(bodies) for i, j in checked)
    return Pairs(checked, left) if sound else None


def _named(robot: Robot, pairs: Any) -> list[tuple[str, str]]:
    found = []
    for pair in checked_each(pairs, tuple, "checked_pairs", "ignored") if not isinstance(pairs, str) else [pairs]:
        if not isinstance(pair, tuple) or len(pair) != 2:
            message = f"checked_pairs: ignored must be pairs of links, not {pair!r}"
            raise ModelError(message, name="ignored", value=pair, limit=2)
        found.append((robot.link(pair[0]).name, robot.link(pair[1]).name))
    return found


def _disabled(robot: Robot, source: str | os.PathLike[str]) -> list[frozenset[str]]:
    """Pairs of links of <disable_collisions>; those that name a link which is not there are passed over."""
    known = {link.name for link in robot.links}
    pairs = [
        frozenset(text_of(each, key, "SRDF") for key in ("link1", "link2"))
        for each in parse_urdf(source).findall("disable_collisions")
    ]
    if unknown := sorted({name for pair in pairs for name in pair if name not in known}):
        message = f"the SRDF file names links that {robot.name!r} has not: {', '.join(map(repr, unknown))}"
        warn(ModelWarning(message, name="srdf", value=tuple(unknown)), stacklevel=3)
    return [pair for pair in pairs if pair <= known]


def _postures(robot: Robot, low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """Random joint vectors within limits. Shape (count, dof)."""
    slides = np.array([joint.kind == "prismatic" for joint in robot.moving_joints], dtype=bool)
    room = np.where(slides, 1.0, np.pi)  # m, rad: how far joints without limits are moved
    first = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2 * room, -room))
    last = np.where(np.isfinite(high), high, first + 2 * room)
    return np.asarray(first + (last - first) * rng.random((count, robot.dof)))  # uniform refuses 0.0 to -0.0


# ------------------------------------------------------------------------------------------------- one pair of bodies


class _Lever(NamedTuple):
    """A moving joint between two bodies.

    Attributes:
        column: Of the joint vector. ratio: Its speed per that entry's.
        arm: m, how far the points of one of the bodies are from its axis at most; 0 for a prismatic joint.
    """

    column: int
    ratio: float
    arm: float

    def moved(self, half: Array) -> Array:
        """How far the distance may change when the entry changes by up to `half`, rad or m."""
        turned = np.minimum(abs(self.ratio) * half, np.pi)
        return np.asarray(2 * self.arm * np.sin(turned / 2) if self.arm else abs(self.ratio) * half)


@dataclass(frozen=True)
class _Motions:
    """How the bodies of a robot may move: within limits, and postures at random that are tried before a proof is."""

    robot: Robot
    parts: RigidParts
    low: Array
    high: Array
    postures: Array
    near: float
    _of_hulls: dict[tuple[int, int], Reason | None] = field(default_factory=dict)

    def reason(self, one: Body, other: Body) -> tuple[Reason | None, bool]:
        """Why a pair need not be checked, or None; and whether its covers always touch and it is checked by hulls.

        Covers of meshes stand out: those whose links are two joints apart, or whose covers always touch, are judged by
        their hulls.
        """
        between = self._between(one.link, one.shape, other.link, other.shape)
        reason = between.settled(self.low, self.high, self.postures, self.near, one.overhang + other.overhang)
        two_joints = len(between.up) + len(between.down) == 2
        if one.mesh is None or other.mesh is None or not (reason != NEVER if two_joints else reason == COVERED):
            return reason, False
        key = id(one.mesh), id(other.mesh)
        if key not in self._of_hulls:
            hulls = self._between(one.link, one.mesh.hull, other.link, other.mesh.hull)
            seen = hulls.seen(self.low, self.high) if two_joints else hulls.together(self.postures)
            self._of_hulls[key] = seen
        if (of_hulls := self._of_hulls[key]) is not None:
            return of_hulls, False
        by_hulls = reason == COVERED
        return None if by_hulls else reason, by_hulls and not two_joints

    def _between(self, link: str, shape: Shape, other_link: str, other: Shape) -> _Between:
        parts = self.parts
        up, down = parts.path(parts.of_link[link], parts.of_link[other_link])
        return _Between(self.robot, shape.placed(*parts.place[link]), other.placed(*parts.place[other_link]), up, down)


@dataclass(frozen=True)
class _Between:
    """Two bodies, in the frames of their rigid parts, and the joints between them."""

    robot: Robot
    one: Shape
    other: Shape
    up: list[Step]
    down: list[Step]
    settings: ProofSettings = ProofSettings()

    def settled(self, low: Array, high: Array, postures: Array, near: float, overhang: float) -> Reason | None:
        """ALWAYS, COVERED or NEVER, or None for bodies that are to be checked."""
        touching = self.gaps(postures[: self.settings.first_postures])[0] <= 0
        if touching.all():
            farthest = float(self.below(*self._relative(postures)).max())
            if farthest <= 0:
                return ALWAYS if overhang == 0 or farthest < -overhang else COVERED
        return None if touching.any() or not self._apart(low, high, near) else NEVER

    def seen(self, low: Array, high: Array) -> Reason | None:
        """NEVER for hulls two joints apart that are apart on a grid of both, refined where they are nearest.

        ALWAYS for those that overlap everywhere on it, else None.
        """
        columns = sorted({self.robot.couplings[step.joint.name].column for step in (*self.up, *self.down)})
        first = np.where(np.isfinite(low), low, -np.pi)[columns]
        last = np.minimum(np.where(np.isfinite(high), high, np.pi)[columns], first + 2 * np.pi)
        step = (last - first) / self.settings.grid
        places = np.stack(np.meshgrid(*(np.arange(self.settings.grid + 1) for _ in columns), indexing="ij"), axis=-1)
        tried = first + places.reshape(-1, len(columns)) * step
        for _ in range(self.settings.finer_grids):
            q = np.zeros((len(tried), self.robot.dof))
            q[:, columns] = tried
            gaps = self.gaps(q)[0]
            if gaps.min() <= SURE:
                return ALWAYS if gaps.max() <= 0 else None
            nearest = tried[np.argsort(gaps)[: self.settings.lowest]]
            around = np.stack(np.meshgrid(*(np.linspace(-1, 1, 9) for _ in columns), indexing="ij"), axis=-1)
            offsets = around.reshape(-1, len(columns)) * step
            tried = np.clip((nearest[:, None] + offsets).reshape(-1, len(columns)), first, last)
            step = step / 4
        return NEVER

    def together(self, postures: Array) -> Reason | None:
        """ALWAYS for bodies that touch in all postures, else None."""
        return None if (self.gaps(postures)[0] > 0).any() else ALWAYS

    def gaps(self, q: Array, above: float | Array = 0.0) -> tuple[Array, NDArray[np.bool_]]:
        """Bounds of the distance from below at joint vectors, shape (k, dof).

        Of balls around the bodies, where that is enough to say that they are apart by `above`; the second array says
        where it was not.
        """
        turn, shift = self._relative(q)
        (a, p), (b, r) = _ball(self.one), _ball(self.other)
        gaps = np.linalg.norm(shift + turn @ b - a, axis=1) - p - r
        close: NDArray[np.bool_] = np.asarray(gaps <= above + SURE)
        if close.any():
            gaps[close] = np.maximum(gaps[close], self.below(turn[close], shift[close]))
        return gaps, close

    def below(self, turn: Array, shift: Array) -> Array:
        """Distances from below, exact where a direction was found that parts them, in frames of the other."""
        core, points = (np.repeat(p, 2, axis=0) if len(p) == 1 else p for p in (self.one.core, self.other.core))
        here, there = np.broadcast_to(core, (len(turn), *core.shape)), points @ turn.transpose(0, 2, 1) + shift[:, None]
        along = nearest_directions(here, there, (isinstance(self.one, Box), isinstance(self.other, Box)))[0]
        return gap_along(along, here, there) - (self.one.swelling + self.other.swelling)

    def _relative(self, q: Array) -> tuple[Array, Array]:
        """Frame of the other's rigid part in the one's. Shapes (k, 3, 3) and (k, 3)."""
        turn, shift = self._chain(self.down, q)
        back, away = self._chain(self.up[::-1], q)
        back = back.transpose(0, 2, 1)
        return back @ turn, np.einsum("kij,kj->ki", back, shift - away)

    def _chain(self, steps: Sequence[Step], q: Array) -> tuple[Array, Array]:
        turn, shift = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
        for step in steps:
            column, ratio, offset = self.robot.couplings[step.joint.name]
            at = ratio * q[:, column] + offset
            shift = shift + turn @ step.shift
            turn = turn @ step.turn
            if step.joint.kind == "prismatic":
                shift = shift + at[:, None] * (turn @ step.joint.axis)
            else:
                turn = turn @ _turns(np.asarray(step.joint.axis), at)
        return turn, shift

    def _apart(self, low: Array, high: Array, near: float) -> bool:
        """Whether it is proven that the bodies never come as near as that, m."""
        levers = self._levers(low, high)
        columns = sorted({lever.column for lever in levers})
        first, last = low.copy(), high.copy()
        for column in columns:
            mine = [lever for lever in levers if lever.column == column]
            if not last[column] - first[column] < 2 * np.pi and all(abs(each.ratio) == 1 and each.arm for each in mine):
                first[column], last[column] = -np.pi, np.pi  # a whole turn is all there is
            if not np.isfinite([first[column], last[column]]).all():
                return False
        centre, half = np.zeros((1, len(low))), np.zeros((1, len(low)))
        centre[0, columns] = (first[columns] + last[columns]) / 2
        half[0, columns] = (last[columns] - first[columns]) / 2
        most = self.settings.boxes // 4 ** max(0, len(columns) - 3)  # halving many joints seldom leads anywhere
        taken = 0
        for _ in range(self.settings.rounds):
            slack = np.array([lever.moved(half[:, lever.column]) for lever in levers])  # (levers, boxes)
            need = slack.sum(axis=0)
            gaps, close = self.gaps(centre, need + near)
            if (close & (gaps <= near)).any():
                return False
            open_boxes = gaps <= need + near
            if not open_boxes.any():
                return True
            taken += len(centre)
            centre, half, slack = centre[open_boxes], half[open_boxes], slack[:, open_boxes]
            if taken + 2 * len(centre) > most:
                return False
            of_column = np.array([[lever.column == column for lever in levers] for column in columns], dtype=float)
            split = np.array(columns)[(of_column @ slack).argmax(axis=0)]
            rows = np.arange(len(centre))
            half = half.copy()
            half[rows, split] /= 2
            step = np.zeros_like(centre)
            step[rows, split] = half[rows, split]
            centre, half = np.concatenate([centre - step, centre + step]), np.concatenate([half, half])
        return False

    def _levers(self, low: Array, high: Array) -> list[_Lever]:
        """Of the joints between the bodies, in order, each the shorter of the arms of the two sides."""
        chain = [*((step, False) for step in self.up), *((step, True) for step in self.down)]
        ahead, _ = arms(self.robot, chain, self.other, low, high)
        back = [(step, not down) for step, down in chain[::-1]]
        behind = arms(self.robot, back, self.one, low, high)[0][::-1]
        found = []
        for (step, _), one, other in zip(chain, ahead, behind, strict=True):
            column, ratio, _ = self.robot.couplings[step.joint.name]
            found.append(_Lever(column, ratio, 0.0 if step.joint.kind == "prismatic" else max(min(one, other), 1e-300)))
        return found


def _turns(axis: Array, angle: Array) -> Array:
    """Rotations about a unit axis. Shape (k, 3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, rest = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + rest * (cross @ cross))


def _ball(shape: Shape) -> tuple[Array, float]:
    """Centre and radius of a ball around a shape."""
    core = shape.core
    centre = (core.min(axis=0) + core.max(axis=0)) / 2
    return centre, shape.reach(centre)
