"""Selection of the pairs of bodies that collision checks must consider, with the reason for every pair left out."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.checks import Array, ArrayInput, require
from models.errors import ModelError, ModelWarning
from models.files import cache_key, load_value, source_version, store_value
from models.robot.robot import Robot
from models.robot.urdf import parse_urdf, text_of
from models.shapes.bodies import Body, JointStep, RigidParts, lever_arms
from models.shapes.hull import gap_along, nearest_directions
from models.shapes.shapes import Box, Shape
from models.spatial import rotation_matrices


class Reason(StrEnum):
    """Reason why a pair of bodies is not checked for collision."""

    NEIGHBOURS = "adjacent links"
    RIGID = "same rigid part"
    ALWAYS = "always in collision"
    COVERED = "always in collision, perhaps only in their covers"
    """Two meshes' covers overlap in all samples, but in some by no more than the covers protrude from the meshes."""
    NEVER = "never in collision"
    SRDF = "the SRDF file"
    IGNORED = "ignored by request"
    IMMOBILE = "neither moves"


NEIGHBOURS, RIGID, ALWAYS, COVERED, NEVER, SRDF, IGNORED, IMMOBILE = Reason
ASSUMED = (ALWAYS, COVERED)
"""Reasons that are assumed without proof, because the bodies collide in each of many random configurations."""
MARGIN_M = 1e-6
"""Distance beyond the clearance that a proof of separation must show, m; it is larger than rounding errors."""


@dataclass(frozen=True)
class ProofSettings:
    """Limits of the computing effort to prove that a pair of bodies need not be checked for collision."""

    configurations: int = 1000  # random configurations: bodies that collide in all of them count as always colliding
    first_configurations: int = 24  # random configurations that are tried before a proof
    boxes: int = 2000  # boxes of joint positions that a proof may use with up to three joints between the bodies
    rounds: int = 40  # bisections of the boxes
    grid: int = 24  # steps of each of two joints between meshes
    refinements: int = 3  # rounds of finer grids
    refined_points: int = 8  # grid points of smallest distance that a finer grid surrounds


SETTINGS = ProofSettings()


@dataclass(frozen=True)
class Pairs:
    """Pairs of bodies that are checked for collision, and pairs of links that are not.

    Attributes:
        checked: Checked pairs as indices of the bodies, the lower first.
        excluded: Reason of every unchecked pair of links, by names in the order of the bodies. A pair of links is in
            both if only some of its bodies always collide, or if the covers of its meshes always collide but their
            convex hulls do not.
    """

    checked: tuple[tuple[int, int], ...]
    excluded: Mapping[tuple[str, str], Reason]


def checked_pairs(
    robot: Robot,
    bodies: Sequence[Body],
    *,
    ignored: Iterable[tuple[str, str]] = (),
    srdf: str | os.PathLike[str] | None = None,
    limits: tuple[ArrayInput, ArrayInput] | None = None,
    clearance: float = 0.0,
) -> Pairs:
    """Return the pairs of a robot's bodies to check for collision: those that can collide but do not always collide.

    Not checked are:

    - bodies without a moving joint between them;
    - adjacent links, with one moving joint or a chain of links without bodies between them;
    - pairs that the user or an SRDF file names;
    - bodies that collide in each of many random configurations (for meshes, whose hulls collide). This is no proof
      (`ASSUMED`);
    - bodies proven to stay farther apart than the clearance. A joint displacement changes the distance by no more than
      twice its lever arm allows, so the joint space is bisected until every box is decided. Undecided pairs are
      checked.

    Args:
        bodies: As `collision_bodies` returns them.
        ignored: Pairs of links that are not checked.
        srdf: SRDF file, as path or text, whose <disable_collisions> pairs are not checked.
        limits: Lower and upper limits of the joint vector, rad or m, each a number or of shape (dof,); the robot's own
            if None.
        clearance: Pairs that may come this close are checked, m.

    Raises:
        ModelError: A link is unknown (names similar ones), a body, limit or number is invalid, or the SRDF file cannot
            be read.

    Warns:
        ModelWarning: The SRDF file names links that the robot does not have.
    """
    owner = "checked_pairs"
    require.instance(f"{owner}: robot", robot, Robot)
    bodies = require.each(f"{owner}: bodies", bodies, Body)
    for body in bodies:
        robot.link(body.link)
    pair = (robot.lower, robot.upper) if limits is None else require.instance(f"{owner}: limits", limits, tuple)
    if len(pair) != 2:
        raise require.invalid(f"{owner}: limits", "a pair (lower, upper)", pair)
    low, high = (
        require.broadcast(f"{owner}: {name}", limit, robot.dof, "joints", entries="numbers")
        for name, limit in zip(("lower", "upper"), pair, strict=True)
    )
    if (low > high).any():
        k = int(np.flatnonzero(low > high)[0])
        message = f"{owner}: lower {low[k]} of joint {robot.joint_names[k]!r} is above upper {high[k]}"
        raise ModelError(message, name="lower", value=float(low[k]), limit=float(high[k]))
    margin = require.nonnegative(f"{owner}: clearance", clearance, unit="m") + MARGIN_M
    named = dict.fromkeys([] if srdf is None else _disabled_pairs(robot, srdf), SRDF)
    named |= dict.fromkeys(_ignored_pairs(robot, ignored), IGNORED)

    key = _key(robot, bodies, named, low, high, margin)
    if (known := _read(load_value(key), bodies)) is not None:
        return known
    parts = RigidParts.of(robot)
    adjacent = parts.adjacent({parts.of_link[body.link] for body in bodies})
    configurations = _random_configurations(robot, low, high, SETTINGS.configurations, np.random.default_rng(0))
    classifier = _PairClassifier(robot, parts, low, high, configurations, margin)
    checked: list[tuple[int, int]] = []
    excluded: dict[tuple[str, str], Reason] = {}
    for i, j in combinations(range(len(bodies)), 2):
        links = bodies[i].link, bodies[j].link
        sides = frozenset(parts.of_link[link] for link in links)
        reason = RIGID if len(sides) == 1 else named.get(frozenset(links), NEIGHBOURS if sides in adjacent else None)
        if reason is None:
            reason, by_hulls = classifier.reason(bodies[i], bodies[j])
            if by_hulls:
                excluded[links] = COVERED
        if reason is None:
            checked.append((i, j))
        elif excluded.get(links) not in ASSUMED or reason == COVERED:
            excluded[links] = reason
    open_links = {(bodies[i].link, bodies[j].link) for i, j in checked}
    excluded = {k: why for k, why in excluded.items() if k[0] != k[1] and (k not in open_links or why in ASSUMED)}
    store_value(key, {"checked": checked, "excluded": [[*pair, why.value] for pair, why in excluded.items()]})
    return Pairs(tuple(checked), excluded)


def _key(robot: Robot, bodies: Sequence[Body], named: Mapping[frozenset[str], Reason], *numbers: Any) -> str:
    """Return the cache key of `checked_pairs`, which depends on everything that determines its result."""
    parts = list(numbers)
    words = ["pairs", *(f"{sorted(pair)} {why}" for pair, why in named.items())]
    for joint in robot.joints:
        words.append(f"{joint.name} {joint.kind} {joint.parent} {joint.child} {robot.couplings.get(joint.name)}")
        parts += [joint.axis, joint.translation, joint.rotation]
    for body in bodies:
        shape, points = body.shape, np.zeros(0) if body.mesh is None else body.mesh.points
        words.append(f"{body.link} {type(shape).__name__}")
        parts += [shape.core, shape.swept_radius, body.overhang, points]
    return cache_key(source_version(__name__), "\n".join(words), *parts)


def _read(value: Any, bodies: Sequence[Body]) -> Pairs | None:
    """Return the checked and unchecked pairs read from a cache entry, or None if the entry is invalid."""
    try:
        checked = tuple((int(i), int(j)) for i, j in value["checked"])
        excluded = {(str(first), str(second)): Reason(why) for first, second, why in value["excluded"]}
    except (TypeError, ValueError, KeyError, AttributeError):
        return None
    return Pairs(checked, excluded) if all(0 <= i < j < len(bodies) for i, j in checked) else None


def _ignored_pairs(robot: Robot, pairs: Any) -> list[frozenset[str]]:
    names = []
    for pair in [pairs] if isinstance(pairs, str) else require.each("checked_pairs: ignored", pairs, tuple):
        if not isinstance(pair, tuple) or len(pair) != 2:
            message = f"checked_pairs: ignored must be pairs of links, not {pair!r}"
            raise ModelError(message, name="ignored", value=pair, limit=2)
        names.append(frozenset(robot.link(name).name for name in pair))
    return names


def _disabled_pairs(robot: Robot, source: str | os.PathLike[str]) -> list[frozenset[str]]:
    """Return the pairs of links whose collision check an SRDF file disables, except pairs with unknown links."""
    known = {link.name for link in robot.links}
    root = parse_urdf(source)
    if root.find("joint") is not None:
        message = f"the SRDF file of {robot.name!r} has a <joint>: it is a URDF; give the file of <disable_collisions>"
        raise ModelError(message, name="srdf", value="joint")
    elements = root.findall("disable_collisions")
    pairs = [frozenset(text_of(each, key, "SRDF") for key in ("link1", "link2")) for each in elements]
    if unknown := sorted({name for pair in pairs for name in pair if name not in known}):
        message = f"the SRDF file names links that {robot.name!r} does not have: {', '.join(map(repr, unknown))}"
        warn(ModelWarning(message, name="srdf", value=tuple(unknown)), stacklevel=3)
    return [pair for pair in pairs if pair <= known]


def _random_configurations(robot: Robot, low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """Return random joint vectors within the given joint limits. Shape (count, dof)."""
    slides = np.array([joint.kind == "prismatic" for joint in robot.moving_joints], dtype=bool)
    half = np.where(slides, 1.0, np.pi)  # m or rad: half of the range of joints without limits
    start = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2 * half, -half))
    end = np.where(np.isfinite(high), high, start + 2 * half)
    return np.asarray(start + (end - start) * rng.random((count, robot.dof)))  # rng.uniform refuses 0.0 to -0.0


Poses: TypeAlias = tuple[Array, Array]
"""Rotations and positions of a rigid part at k configurations. Shapes (k, 3, 3) and (k, 3), m."""


class _Lever(NamedTuple):
    """A moving joint between two bodies: its entry in the joint vector, and the lever arm of one of the bodies."""

    column: int  # index in the joint vector
    ratio: float  # velocity of the joint over that of the entry
    arm: float  # largest distance of the points of one of the bodies from the joint axis, m; 0 for a prismatic joint

    def distance_change(self, half: Array) -> Array:
        """Return the largest change of two bodies' distance if the joint moves by up to `half`, rad or m."""
        turned = np.minimum(abs(self.ratio) * half, np.pi)
        return np.asarray(2 * self.arm * np.sin(turned / 2) if self.arm else abs(self.ratio) * half)


@dataclass(frozen=True)
class _PairClassifier:
    """Classifier that decides, by random configurations and then by proofs, which pairs of bodies need no check."""

    robot: Robot
    parts: RigidParts
    low: Array
    high: Array
    configurations: Array
    margin: float
    _by_hulls: dict[tuple[int, int], Reason | None] = field(default_factory=dict)

    def reason(self, first: Body, second: Body) -> tuple[Reason | None, bool]:
        """Return why two bodies need no check (None if they need one), and whether hulls replace covers in the check.

        Covers of meshes protrude. Pairs with a mesh that are two joints apart, or whose covers always collide, are
        therefore classified by the convex hulls of meshes.
        """
        links = first.link, second.link
        pair = self._pair(links, (first.shape, second.shape))
        reason = pair.classify(self.low, self.high, self.configurations, self.margin, first.overhang + second.overhang)
        two_joints = len(pair.up) + len(pair.down) == 2
        if not (first.mesh or second.mesh) or not (reason != NEVER if two_joints else reason == COVERED):
            return reason, False
        key = id(first.mesh or first), id(second.mesh or second)
        if key not in self._by_hulls:
            shapes = [each.mesh.hull if each.mesh else each.shape for each in (first, second)]
            hulls = self._pair(links, shapes)
            if two_joints:
                self._by_hulls[key] = hulls.check_on_grid(self.low, self.high)
            else:
                self._by_hulls[key] = ALWAYS if (hulls.bounds(self.configurations)[0] <= 0).all() else None
        if (hull_reason := self._by_hulls[key]) is not None:
            return hull_reason, False
        return (None, not two_joints) if reason == COVERED else (reason, False)

    def _pair(self, links: tuple[str, str], shapes: Sequence[Shape]) -> _BodyPair:
        parts = self.parts
        bodies = [_PlacedBody(body.placed(*parts.pose[link])) for link, body in zip(links, shapes, strict=True)]
        up, down = parts.path(*(parts.of_link[link] for link in links))
        return _BodyPair(self.robot, bodies[0], bodies[1], up, down)


class _PlacedBody:
    """A body in the frame of its rigid part, with centre and radius of a bounding ball."""

    def __init__(self, shape: Shape) -> None:
        self.shape, core = shape, shape.core
        self.centre = (core.min(axis=0) + core.max(axis=0)) / 2
        self.radius = shape.reach(self.centre)


@dataclass(frozen=True)
class _BodyPair:
    """Two bodies, the joints from the first one's rigid part up the tree, and those down to the second one's part."""

    robot: Robot
    first: _PlacedBody
    second: _PlacedBody
    up: list[JointStep]
    down: list[JointStep]

    def classify(self, low: Array, high: Array, configurations: Array, margin: float, overhang: float) -> Reason | None:
        """Return why two bodies need no collision check (they collide always or never), or None if they need one."""
        colliding = self.bounds(configurations[: SETTINGS.first_configurations])[0] <= 0
        if colliding.all():
            largest = float(self.distance_bounds(*self._relative(configurations)).max())
            if largest <= 0:
                return ALWAYS if overhang == 0 or largest < -overhang else COVERED
        return None if colliding.any() or not self._proves_separation(low, high, margin) else NEVER

    def check_on_grid(self, low: Array, high: Array) -> Reason | None:
        """Return NEVER if two hulls are disjoint on ever finer joint grids, ALWAYS if they overlap on a whole grid."""
        columns = sorted({self.robot.couplings[step.joint.name].column for step in (*self.up, *self.down)})
        start = np.where(np.isfinite(low), low, -np.pi)[columns]
        end = np.minimum(np.where(np.isfinite(high), high, np.pi)[columns], start + 2 * np.pi)
        step = (end - start) / SETTINGS.grid
        points = start + _grid(np.arange(SETTINGS.grid + 1.0), len(columns)) * step
        for _ in range(SETTINGS.refinements):
            q = np.zeros((len(points), self.robot.dof))
            q[:, columns] = points
            bounds = self.bounds(q)[0]
            if bounds.min() <= MARGIN_M:
                return ALWAYS if bounds.max() <= 0 else None
            nearest = points[np.argsort(bounds)[: SETTINGS.refined_points]]
            offsets = _grid(np.linspace(-1, 1, 9), len(columns)) * step
            points = np.clip((nearest[:, None] + offsets).reshape(-1, len(columns)), start, end)
            step = step / 4
        return NEVER

    def bounds(self, q: Array, above: float | Array = 0.0) -> tuple[Array, NDArray[np.bool_]]:
        """Return lower bounds, m, of the distance at joint vectors (k, dof), and whether the bounding balls are close.

        Balls are close if they do not prove a distance greater than `above`, m; then the shapes give the bound.
        """
        (turn, shift), first, second = self._relative(q), self.first, self.second
        bounds = np.linalg.norm(shift + turn @ second.centre - first.centre, axis=1) - first.radius - second.radius
        close: NDArray[np.bool_] = np.asarray(bounds <= above + MARGIN_M)
        if close.any():
            bounds[close] = np.maximum(bounds[close], self.distance_bounds(turn[close], shift[close]))
        return bounds, close

    def distance_bounds(self, turn: Array, shift: Array) -> Array:
        """Return lower bounds, m, of the distance at given poses of the second body, exact if the search converges."""
        shapes = self.first.shape, self.second.shape
        first = np.broadcast_to(shapes[0].core, (len(turn), *shapes[0].core.shape))
        second = shapes[1].core @ turn.transpose(0, 2, 1) + shift[:, None]
        direction = nearest_directions(first, second, (isinstance(shapes[0], Box), isinstance(shapes[1], Box)))[0]
        return gap_along(direction, first, second) - (shapes[0].swept_radius + shapes[1].swept_radius)

    def _relative(self, q: Array) -> Poses:
        """Return the poses of the second body's part relative to the first body's part at joint vectors (k, dof)."""
        first = second = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
        for step in self.up[::-1]:
            first = _poses_below(self.robot, first, step, q)
        for step in self.down:
            second = _poses_below(self.robot, second, step, q)
        back = first[0].transpose(0, 2, 1)
        return back @ second[0], (back @ (second[1] - first[1])[:, :, None])[:, :, 0]

    def _proves_separation(self, low: Array, high: Array, margin: float) -> bool:
        """Return whether bisection of the joint space proves that two bodies stay farther apart than `margin`, m."""
        columns = sorted({self.robot.couplings[step.joint.name].column for step in (*self.up, *self.down)})
        budget = SETTINGS.boxes // 4 ** max(0, len(columns) - 3)  # bisection of many joints rarely succeeds
        if not budget:
            return False
        levers = self._levers(low, high)
        start, end = low.copy(), high.copy()
        for column in columns:
            own = [lever for lever in levers if lever.column == column]
            if not end[column] - start[column] < 2 * np.pi and all(abs(each.ratio) == 1 and each.arm for each in own):
                start[column], end[column] = -np.pi, np.pi  # a full turn covers all positions
            if not np.isfinite([start[column], end[column]]).all():
                return False
        centre, half = np.zeros((1, len(low))), np.zeros((1, len(low)))
        centre[0, columns] = (start[columns] + end[columns]) / 2
        half[0, columns] = (end[columns] - start[columns]) / 2
        for _ in range(SETTINGS.rounds):
            slack = np.array([lever.distance_change(half[:, lever.column]) for lever in levers])  # (levers, boxes)
            need = slack.sum(axis=0)
            bounds, close = self.bounds(centre, need + margin)
            if (close & (bounds <= margin)).any():
                return False
            open_boxes = bounds <= need + margin
            if not open_boxes.any():
                return True
            budget -= len(centre)
            centre, half, slack = centre[open_boxes], half[open_boxes], slack[:, open_boxes]
            if 2 * len(centre) > budget:
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
        """Return the joints between two bodies, each with the shorter of its lever arms to the two bodies."""
        chain = [*((step, False) for step in self.up), *((step, True) for step in self.down)]
        reverse = [(step, not down) for step, down in chain[::-1]]
        arms_second, _ = lever_arms(self.robot, chain, self.second.shape, low=low, high=high)
        arms_first = lever_arms(self.robot, reverse, self.first.shape, low=low, high=high)[0][::-1]
        levers = []
        for (step, _), *arms in zip(chain, arms_second, arms_first, strict=True):
            column, ratio, _ = self.robot.couplings[step.joint.name]
            levers.append(_Lever(column, ratio, 0.0 if step.joint.kind == "prismatic" else max(min(arms), 1e-300)))
        return levers


def _grid(values: Array, dimension: int) -> Array:
    """Return the points of a regular grid with the given values along each axis. Shape (k, dimension)."""
    return np.stack(np.meshgrid(*[values] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)


def _poses_below(robot: Robot, above: Poses, step: JointStep, q: Array) -> Poses:
    """Return the poses of the rigid part below a joint, given the poses of the part above it, at joint vectors q."""
    (turn, shift), (column, ratio, offset) = above, robot.couplings[step.joint.name]
    position = ratio * q[:, column] + offset
    shift = shift + turn @ step.translation
    turn = turn @ step.rotation
    if step.joint.kind == "prismatic":
        return turn, shift + position[:, None] * (turn @ step.joint.axis)
    return turn @ rotation_matrices(position[:, None] * step.joint.axis), shift
