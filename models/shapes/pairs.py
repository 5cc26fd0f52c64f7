"""Which bodies of a robot are checked against each other, and why the others are not."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple
from warnings import warn

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.arrays import (
    Array,
    ArrayInput,
    checked_count,
    checked_each,
    checked_instance,
    checked_nonnegative,
    one_for_each,
)
from models.cache import keep, kept, key_of, version_of
from models.errors import ModelError, ModelWarning
from models.robot.robot import Robot
from models.robot.urdf import parsed, text_of
from models.shapes.bodies import Body
from models.shapes.distance import distance, pair_function
from models.shapes.rigid_parts import RigidParts, Step, arms
from models.shapes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from models.spatial import Frame

NEIGHBOURS, RIGID, ALWAYS, NEVER = "neighbours", "one rigid part", "always touch", "never touch"
COVERED = "always touch, perhaps only in their covers"
"""Where in some posture bodies overlap by no more than their covers stand out of what they cover: this may be apart."""
ASSUMED = (ALWAYS, COVERED)
"""Reasons that no proof stands behind: bodies touch in each of many configurations."""
SRDF, TOLD = "the SRDF file", "told"
LIMITLESS = 1.0
"""m: how far a prismatic joint without limits is moved to see whether bodies always touch."""
SURE = 1e-6
"""m: more than rounding takes away from a proof of distance."""
MOST_NORMALS = 200
"""Of a hull, along which gaps are looked at."""
NO_DIRECTION = 1e-9
"""A vector along which two bodies might be apart and that is no longer, in m or as a sine, is none."""
AT_ONCE = 2**20
"""Numbers of an array that bounds are computed in."""
GRID, FINER, LOWEST = 24, 3, 8
"""Steps of each of two joints between meshes, rounds of finer ones, and places that they are taken around."""
FIRST, BOXES, ROUNDS = 24, 2000, 40
"""Postures tried before a proof is; boxes of joint positions that one may take with up to three joints between the
bodies, and rounds of halving them."""


@dataclass(frozen=True)
class Pairs:
    """Pairs of bodies.

    Attributes:
        checked: Those that are checked, as indices of the bodies, the lower first.
        left: Why pairs of links are not: "one rigid part", "neighbours", "told", "the SRDF file", "always touch",
            "always touch, perhaps only in their covers" or "never touch", by their names in the order of the bodies. A
            pair of links with several bodies may be in both where only some of their bodies always touch, and one of
            meshes where their covers always touch and their convex hulls do not.
    """

    checked: tuple[tuple[int, int], ...]
    left: Mapping[tuple[str, str], str]


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
    low = robot.lower if lower is None else one_for_each(lower, robot.dof, owner, "lower", "joints", finite=False)
    high = robot.upper if upper is None else one_for_each(upper, robot.dof, owner, "upper", "joints", finite=False)
    if (low > high).any():
        k = int(np.flatnonzero(low > high)[0])
        message = f"{owner}: lower {low[k]} of joint {robot.joint_names[k]!r} is above upper {high[k]}"
        raise ModelError(message, name="lower", value=float(low[k]), limit=float(high[k]))
    count = checked_count(samples, owner, "samples")
    near = checked_nonnegative(clearance, owner, "clearance", "m") + SURE
    rng = np.random.default_rng(checked_count(seed, owner, "seed", least=0, most=2**63))
    told = {frozenset(pair): TOLD for pair in _named(robot, ignored)}
    named = ({} if srdf is None else dict.fromkeys(_disabled(robot, srdf), SRDF)) | told

    key = _key(robot, bodies, low, high, named, near, count, seed)
    if (known := _read(kept(key), bodies)) is not None:
        return known
    parts = RigidParts.of(robot)
    close = parts.close({parts.of_link[body.link] for body in bodies})
    placed = [body.shape.placed(*parts.place[body.link]) for body in bodies]
    postures = _postures(robot, low, high, count, rng)
    checked: list[tuple[int, int]] = []
    left: dict[tuple[str, str], str] = {}
    of_hulls: dict[tuple[int, int], str | None] = {}
    for i, j in combinations(range(len(bodies)), 2):
        one, other = bodies[i].link, bodies[j].link
        sides = frozenset((parts.of_link[one], parts.of_link[other]))
        if len(sides) == 1:
            reason: str | None = RIGID
        elif (reason := named.get(frozenset((one, other)))) is None and sides in close:
            reason = NEIGHBOURS
        if reason is None:
            ends = parts.path(*(parts.of_link[link] for link in (one, other)))
            between = _Between(robot, placed[i], placed[j], *ends, _bound(placed[i], placed[j]))
            reason = between.settled(low, high, postures, near, bodies[i].overhang + bodies[j].overhang)
            one_mesh, other_mesh = bodies[i].mesh, bodies[j].mesh
            two_joints = len(between.up) + len(between.down) == 2
            near_by = reason != NEVER if two_joints else reason == COVERED
            if near_by and one_mesh is not None and other_mesh is not None:
                of_meshes = id(one_mesh), id(other_mesh)
                if of_meshes not in of_hulls:
                    one_hull = one_mesh.hull.placed(*parts.place[one])
                    other_hull = other_mesh.hull.placed(*parts.place[other])
                    hulls = _Between(robot, one_hull, other_hull, *ends, _bound(one_hull, other_hull))
                    of_hulls[of_meshes] = hulls.seen(low, high) if two_joints else hulls.together(postures)
                by_hull = reason == COVERED and of_hulls[of_meshes] is None
                reason = of_hulls[of_meshes] or (None if by_hull else reason)
                if by_hull and not two_joints:  # those are looked at by their hulls in any case
                    left[one, other] = COVERED
        if reason is None:
            checked.append((i, j))
        elif left.get((one, other)) not in ASSUMED or reason == COVERED:
            left[one, other] = reason
    open_links = {(bodies[i].link, bodies[j].link) for i, j in checked}
    found = Pairs(
        tuple(checked), {k: why for k, why in left.items() if k[0] != k[1] and (k not in open_links or why in ASSUMED)}
    )
    keep(key, {"checked": found.checked, "left": [[*pair, why] for pair, why in found.left.items()]})
    return found


def _key(
    robot: Robot,
    bodies: Sequence[Body],
    low: Array,
    high: Array,
    named: Mapping[frozenset[str], str],
    near: float,
    count: int,
    seed: int,
) -> str:
    """A name for all that the pairs depend on."""
    parts: list[Any] = [low, high, near, count, seed]
    words = ["pairs", *(f"{sorted(pair)} {why}" for pair, why in named.items())]
    for joint in robot.joints:
        words.append(f"{joint.name} {joint.kind} {joint.parent} {joint.child} {robot.drives.get(joint.name)}")
        parts += [joint.axis, joint.translation, joint.rotation]
    for body in bodies:
        words.append(f"{body.link} {type(body.shape).__name__}")
        parts += [
            body.shape.core,
            body.shape.swelling,
            body.overhang,
            np.zeros(0) if body.mesh is None else body.mesh.points,
        ]
    return key_of(version_of(__name__), "\n".join(words), *parts)


def _read(value: Any, bodies: Sequence[Body]) -> Pairs | None:
    """Pairs as they were kept; None where it is something else."""
    try:
        checked = tuple((int(i), int(j)) for i, j in value["checked"])
        left = {(str(one), str(other)): str(why) for one, other, why in value["left"]}
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
        for each in parsed(source).findall("disable_collisions")
    ]
    if unknown := sorted({name for pair in pairs for name in pair if name not in known}):
        message = f"the SRDF file names links that {robot.name!r} has not: {', '.join(map(repr, unknown))}"
        warn(ModelWarning(message, name="srdf", value=tuple(unknown)), stacklevel=3)
    return [pair for pair in pairs if pair <= known]


def _postures(robot: Robot, low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """Random joint vectors within limits. Shape (count, dof)."""
    slides = np.array([joint.kind == "prismatic" for joint in robot.moving_joints], dtype=bool)
    room = np.where(slides, LIMITLESS, np.pi)
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
class _Between:
    """Two bodies, in the frames of their rigid parts, the joints between them, and a bound of their distances."""

    robot: Robot
    one: Shape
    other: Shape
    up: list[Step]
    down: list[Step]
    below: Callable[[Array, Array], Array]

    def settled(self, low: Array, high: Array, postures: Array, near: float, overhang: float) -> str | None:
        """ALWAYS, COVERED or NEVER, or None for bodies that are to be checked."""
        touching = self.gaps(postures[:FIRST])[0] <= 0
        if touching.all():
            farthest = float(_distances(self.one, self.other, *self._relative(postures)).max())
            if farthest <= 0:
                return ALWAYS if overhang == 0 or farthest < -overhang else COVERED
        return None if touching.any() or not self._apart(low, high, near) else NEVER

    def seen(self, low: Array, high: Array) -> str | None:
        """NEVER for hulls two joints apart that are apart on a grid of both, refined where they are nearest.

        ALWAYS for those of which everywhere on it a corner of one lies in the other, else None: that no gap was seen
        is no evidence that there is none.
        """
        columns = sorted({self.robot.drives[step.joint.name].column for step in (*self.up, *self.down)})
        first = np.where(np.isfinite(low), low, -np.pi)[columns]
        last = np.minimum(np.where(np.isfinite(high), high, np.pi)[columns], first + 2 * np.pi)
        step = (last - first) / GRID
        places = np.stack(np.meshgrid(*(np.arange(GRID + 1) for _ in columns), indexing="ij"), axis=-1)
        tried = first + places.reshape(-1, len(columns)) * step
        for _ in range(FINER):
            q = np.zeros((len(tried), self.robot.dof))
            q[:, columns] = tried
            gaps = self.gaps(q)[0]
            if gaps.min() <= SURE:
                return ALWAYS if gaps.max() <= 0 and self._nested(q) else None
            nearest = tried[np.argsort(gaps)[:LOWEST]]
            around = np.stack(np.meshgrid(*(np.linspace(-1, 1, 9) for _ in columns), indexing="ij"), axis=-1)
            offsets = around.reshape(-1, len(columns)) * step
            tried = np.clip((nearest[:, None] + offsets).reshape(-1, len(columns)), first, last)
            step = step / 4
        return NEVER

    def together(self, postures: Array) -> str | None:
        """ALWAYS for bodies that touch in all postures, else None."""
        return None if (self.gaps(postures)[0] > 0).any() else ALWAYS

    def _nested(self, q: Array) -> bool:
        """Whether at all joint vectors (k, dof) a corner of one of two hulls lies in the other."""
        assert isinstance(self.one, Mesh)
        assert isinstance(self.other, Mesh)
        one, other = self.one, self.other
        for turn, shift in zip(*self._relative(q), strict=True):
            there, here = other.core @ turn.T + shift, (one.core - shift) @ turn
            held = [
                ((points - mesh.position) @ mesh.rotation @ mesh.hull.normals.T <= mesh.hull.offsets).all(axis=1)
                for points, mesh in ((there, one), (here, other))
            ]
            if not any(inside.any() for inside in held):
                return False
        return True

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

    def _relative(self, q: Array) -> tuple[Array, Array]:
        """Frame of the other's rigid part in the one's. Shapes (k, 3, 3) and (k, 3)."""
        turn, shift = self._chain(self.down, q)
        back, away = self._chain(self.up[::-1], q)
        back = back.transpose(0, 2, 1)
        return back @ turn, np.einsum("kij,kj->ki", back, shift - away)

    def _chain(self, steps: Sequence[Step], q: Array) -> tuple[Array, Array]:
        turn, shift = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
        for step in steps:
            column, ratio, offset = self.robot.drives[step.joint.name]
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
        taken, most = 0, BOXES // 4 ** max(0, len(columns) - 3)  # halving many joints seldom leads anywhere
        for _ in range(ROUNDS):
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
            column, ratio, _ = self.robot.drives[step.joint.name]
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


def _distances(one: Shape, other: Shape, turn: Array, shift: Array) -> Array:
    """Distances of two shapes from many frames of the other in the one's, shapes (k, 3, 3) and (k, 3)."""
    rotation, position = ca.SX.sym("turn", 3, 3), ca.SX.sym("shift", 3)
    gap = distance(one, other, None, Frame(rotation, position))
    made = ca.Function("gap", [ca.vertcat(rotation.reshape((9, 1)), position)], [gap])
    columns = np.concatenate([turn.transpose(0, 2, 1).reshape(-1, 9), shift], axis=1).T
    return np.array(made(columns)).ravel()


def _bound(one: Shape, other: Shape) -> Callable[[Array, Array], Array]:
    """What bounds the distances of two shapes in such frames from below: of capsules they are exact."""
    if isinstance(one, Sphere | Capsule) and isinstance(other, Sphere | Capsule):
        return lambda turn, shift: _capsules(one, other, turn, shift)
    core, second, swelling = one.core, other.core, one.swelling + other.swelling
    (normals, edges), (other_normals, other_edges) = _directions(one), _directions(other)
    each = len(core) * (len(normals) + len(other_normals) + len(edges) * len(other_edges) + 1)

    def measured(turn: Array, shift: Array) -> Array:
        """The largest gap along directions that may separate the two."""
        pieces = np.array_split(np.arange(len(turn)), min(1 + len(turn) * each // AT_ONCE, max(len(turn), 1)))
        return np.concatenate([gaps(turn[piece], shift[piece]) for piece in pieces])

    def gaps(turn: Array, shift: Array) -> Array:
        points = second @ turn.transpose(0, 2, 1) + shift[:, None]  # (k, points, 3)
        crossed = np.cross(edges[:, None], (other_edges @ turn.transpose(0, 2, 1))[:, None]).reshape(len(turn), -1, 3)
        apart = (points.mean(axis=1) - core.mean(axis=0))[:, None]
        own = np.broadcast_to(normals, (len(turn), *normals.shape))
        tried = np.concatenate([own, other_normals @ turn.transpose(0, 2, 1), crossed, apart], axis=1)
        long = np.linalg.norm(tried, axis=2)
        tried = tried / np.maximum(long, NO_DIRECTION)[:, :, None]
        here, there = tried @ core.T, tried @ points.transpose(0, 2, 1)
        ahead, behind = there.min(axis=2) - here.max(axis=2), here.min(axis=2) - there.max(axis=2)
        found = np.where(long > NO_DIRECTION, np.maximum(ahead, behind), -np.inf)
        return np.asarray(found.max(axis=1) - swelling)

    return measured


def _directions(shape: Shape) -> tuple[Array, Array]:
    """Normals of a core's faces and directions of its edges, each once. Shapes (n, 3) and (e, 3)."""
    if isinstance(shape, Box):
        return np.asarray(shape.rotation.T), np.asarray(shape.rotation.T)
    if isinstance(shape, Cylinder | Mesh):
        some = shape.hull.normals[:: 1 + len(shape.hull.normals) // MOST_NORMALS]  # each gap is a bound by itself
        return np.asarray(some @ shape.rotation.T), np.zeros((0, 3))
    along = shape.core[-1:] - shape.core[:1]
    length = float(np.linalg.norm(along))
    return np.zeros((0, 3)), along / length if length > 0 else np.zeros((0, 3))


def _capsules(one: Sphere | Capsule, other: Sphere | Capsule, turn: Array, shift: Array) -> Array:
    """Distances of two spheres or capsules."""
    points = other.core @ turn.transpose(0, 2, 1) + shift[:, None]
    moved = np.column_stack([points.reshape(len(turn), -1), np.full(len(turn), other.radius)])
    still = np.tile(np.append(one.core, one.radius)[:, None], len(turn))
    return np.array(pair_function(type(one), type(other))(still, moved.T)).ravel()
