"""Collision scenes: the bodies of a machine, static and moving obstacles, and the pairs of bodies that may collide.

Each pair is considered in its reference frame, that of the last link that carries both bodies, or the world: only the
joints between that link and the bodies move them relative to each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.checks import Array, require, set_fields
from models.errors import ModelError
from models.files import INPUT_LIMITS
from models.machines.machine import Machine, base_twists
from models.robot.kinematics import coupling_matrix, frames_and_axes, link_frames
from models.robot.robot import Robot
from models.shapes.bodies import Body, LinkMesh, MissingRule, RigidParts, collision_bodies, lever_arms
from models.shapes.distance import COLUMNS, column, distance, pair_function, pair_wrenches, soft_minima, soft_minimum
from models.shapes.pairs import ASSUMED, COVERED, IGNORED, IMMOBILE, RIGID, SRDF, Pairs, Reason, checked_pairs
from models.shapes.shapes import SHAPE_KINDS, Box, MovingObstacle, Shape, checked_shape
from models.spatial import Expression, Frame, expression

WORLD = -1
"""Frame index that stands for the world."""
MIN_SOFTNESS_M = 1e-6
"""Smallest smoothing width of the soft minimum of several distances, m."""


class PlacedShape(NamedTuple):
    """A shape in a collision scene, with its name and the frame that carries it."""

    name: str  # name of its link, with a number if the link has several shapes, or of an obstacle
    shape: Shape  # shape in the frame that carries it
    frame: int  # index of that frame among those of `CollisionScene.placements`; -1 for the world
    link: str  # name of the link that carries the shape, or of the obstacle


class Levers(NamedTuple):
    """Upper bounds of the relative velocity of the bodies in each of n pairs, per unit rate of each coordinate.

    A coordinate with rate r moves no point faster than its lever times |r|, and rotates the body no faster than its
    turn times |r|.
    """

    base: Array  # of the base configuration. Shape (n, base_size).
    base_turns: Array  # of the base configuration. Shape (n, base_size).
    joints: Array  # of the joints. Shape (n, joint_size).
    joint_turns: Array  # of the joints. Shape (n, joint_size).


@dataclass(frozen=True, eq=False)
class CollisionScene:
    """The bodies of a machine, the obstacles, and the pairs of bodies and obstacles that are checked for collision.

    Attributes:
        machine: Any machine; the <collision> shapes of its robot are its bodies, see `models.shapes.bodies`.
        obstacles: Shapes in world, and moving obstacles.
        clearance: Required distance of all checked pairs, m.
        ignored: Pairs of link names, or of a link and an obstacle ("obstacle 0"), that are not checked. Adjacent links
            and pairs that never or always collide are excluded in any case.
        srdf: SRDF file whose disabled pairs are not checked either, or None.
        folders: Folders in which meshes are searched.
        missing: "raise" an error for a missing mesh, or "skip" it with a warning.
        limits: Assume that the joints keep the robot's position limits, so that pairs that never collide within them
            are excluded.
        covered: Bodies that replace the meshes of links, as in `collision_bodies`; computed from the mesh
            files if None. Holds the bodies in use after construction.
        classified: Pairs of links that are checked or not, as `checked_pairs` returns them for this machine or one
            with more moving joints; computed if None.
        bodies: All shapes of the scene: of links, obstacles and hulls of meshes.
        pairs: Two bodies and the reference frame of each pair, -1 for the world. Shape (n, 3).
        covers: For pairs of hulls, by index, all pairs of bodies that cover the two meshes, shape (m, 2), or none if
            some of them always collide. Hulls are at least as far apart as the nearest of these.
        cover_pairs: The pairs of bodies, by the index of their pair, whose distances stand for it in `distances`.
        excluded: Reason why each pair of names is not checked.

    Raises:
        ModelError: A negative clearance, an invalid obstacle, an unknown name, a missing mesh.
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
    classified: Pairs | None = field(default=None, repr=False)
    bodies: tuple[PlacedShape, ...] = field(init=False, repr=False)
    pairs: Array = field(init=False, repr=False)
    covers: dict[int, Array] = field(init=False, repr=False)
    cover_pairs: dict[int, tuple[tuple[int, int], ...]] = field(init=False, repr=False)
    excluded: dict[tuple[str, str], Reason] = field(init=False, repr=False)
    _parts: RigidParts = field(init=False, repr=False)
    _carriers: tuple[str, ...] = field(init=False, repr=False)

    def __repr__(self) -> str:
        kinds = f"{len(self.bodies)} bodies, {len(self.obstacles)} obstacles"
        return f"<CollisionScene of {self.machine!r}: {kinds}, {len(self.pairs)} pairs, clearance {self.clearance:g} m>"

    def __post_init__(self) -> None:
        single = isinstance(self.obstacles, (*SHAPE_KINDS, MovingObstacle))
        obstacles = _checked_list((self.obstacles,) if single else self.obstacles, "obstacles")
        for number, obstacle in enumerate(obstacles):
            name = f"obstacles[{number}]"
            moves = isinstance(obstacle, MovingObstacle)
            shape = obstacle.shape if moves else checked_shape(f"scene: {name}", obstacle)
            if isinstance(shape, Box) and not np.isfinite(shape.size).all():
                message = f"scene: {name} is an infinite box; give its size, or a HalfSpace"
                raise ModelError(message, name=name, value=shape.size)
        clearance = require.nonnegative("scene: clearance", self.clearance, unit="m")
        set_fields(self, obstacles=obstacles, clearance=clearance)
        robot = getattr(self.machine, "robot", None)
        if not isinstance(robot, Robot):
            message = f"scene: machine must be a FixedBase(robot) or another machine, not {self.machine!r}"
            raise ModelError(message, name="machine", value=self.machine)
        folders = _checked_list(self.folders, "folders")
        own = collision_bodies(robot, folders=folders, missing=self.missing, covered=self.covered)
        set_fields(self, covered=_bodies_by_mesh(robot, own))
        link_pairs, obstacle_pairs = self._ignored_pairs()
        limits = None if require.flag("scene: limits", self.limits) else (-np.inf, np.inf)
        known = self.classified
        if known is None:
            known = checked_pairs(robot, own, ignored=link_pairs, srdf=self.srdf, clearance=clearance, limits=limits)
        set_fields(self, classified=known, _parts=RigidParts.of(robot))
        with_obstacles, excluded = self._pairs_with_obstacles(own, obstacle_pairs)
        parts = [self._parts.of_link[body.link] for body in own]
        checked = [(i, j) for i, j in known.checked if parts[i] != parts[j]]
        rigid = {(own[i].link, own[j].link): RIGID for i, j in known.checked if parts[i] == parts[j]}
        set_fields(self, excluded={**known.excluded, **rigid, **excluded})
        self._place(own, checked, with_obstacles)

    def with_locked(self, machine: Machine) -> CollisionScene:
        """Return the scene of the machine with some joints locked, without pairs whose distance is then constant.

        A newly built scene would treat links that only locked joints connect as adjacent.
        """
        return replace(self, machine=machine)

    def _ignored_pairs(self) -> tuple[list[tuple[str, str]], set[tuple[str, str]]]:
        """Return the pairs that the user excludes from checks: pairs of links, and pairs of a link and an obstacle."""
        names = {f"obstacle {number}" for number in range(len(self.obstacles))}
        ignored = [_pair(each, number) for number, each in enumerate(_checked_list(self.ignored, "ignored"))]
        with_obstacle = {pair for pair in ignored if names & set(pair)}
        for pair in with_obstacle:
            for name in set(pair) - names:
                self.machine.robot.link(name)
        return [pair for pair in ignored if pair not in with_obstacle], with_obstacle

    def _pairs_with_obstacles(
        self, own: Sequence[Body], ignored: set[tuple[str, str]]
    ) -> tuple[list[tuple[int, int]], dict[tuple[str, str], Reason]]:
        """Return the index pairs (body, obstacle) that may collide, and the reasons why other pairs are excluded."""
        pairs, excluded = [], dict[tuple[str, str], Reason]()
        for number, obstacle in enumerate(self.obstacles):
            name = f"obstacle {number}"
            for i, body in enumerate(own):
                if {(body.link, name), (name, body.link)} & ignored:
                    excluded[body.link, name] = IGNORED
                elif not self._moves(body.link) and not isinstance(obstacle, MovingObstacle):
                    excluded[body.link, name] = IMMOBILE
                else:
                    pairs.append((i, number))
        return pairs, excluded

    def _place(
        self, own: Sequence[Body], checked: Sequence[tuple[int, int]], with_obstacles: Sequence[tuple[int, int]]
    ) -> None:
        """Place the shapes of links, obstacles and mesh hulls in the scene's frames, and select the pairs to check."""
        close = self._close_meshes(own, checked)
        covered = {pair for pairs in close.values() for pair in pairs}
        links = [body.link for body in own]
        frames = dict.fromkeys(links + [self._reference_link(own[i], own[j]) for i, j in checked])
        indices = {link: k for k, link in enumerate(frames)}
        bodies = []
        for k, (link, body) in enumerate(zip(links, own, strict=True)):
            name = link if links.count(link) == 1 else f"{link}/{links[:k].count(link) + 1}"
            bodies.append(PlacedShape(name, body.shape, indices[link], link))
        moving_frames = count(len(indices))
        for number, obstacle in enumerate(self.obstacles):
            name, moves = f"obstacle {number}", isinstance(obstacle, MovingObstacle)
            shape = obstacle.shape if isinstance(obstacle, MovingObstacle) else obstacle
            bodies.append(PlacedShape(name, shape, next(moving_frames) if moves else WORLD, name))
        pairs = [(i, j, indices[self._reference_link(own[i], own[j])]) for i, j in checked if (i, j) not in covered]
        cover_pairs: dict[int, tuple[tuple[int, int], ...]] = {}
        covers: dict[int, Array] = {}
        hulls: dict[LinkMesh, int] = {}
        for geometries, replaced_pairs in close.items():
            sides, covering = [], []
            for geometry, k in zip(geometries, replaced_pairs[0], strict=True):
                if isinstance(geometry, LinkMesh) and geometry not in hulls:
                    hulls[geometry] = len(bodies)
                    link = own[k].link
                    bodies.append(PlacedShape(f"{link} hull {len(hulls)}", geometry.hull, indices[link], link))
                sides.append(hulls[geometry] if isinstance(geometry, LinkMesh) else k)
                covering.append([n for n, body in enumerate(own) if geometry in (body, body.mesh)])
            first, second = (own[k] for k in replaced_pairs[0])
            cover_pairs[len(pairs)] = tuple(replaced_pairs)
            if self.excluded.get((first.link, second.link)) not in ASSUMED:
                covers[len(pairs)] = np.array([(i, j) for i in covering[0] for j in covering[1]])
            pairs.append((sides[0], sides[1], indices[self._reference_link(first, second)]))
        pairs += [(i, len(own) + number, WORLD) for i, number in with_obstacles]
        set_fields(self, _carriers=tuple(frames), bodies=tuple(bodies), covers=covers, cover_pairs=cover_pairs)
        set_fields(self, pairs=np.array(pairs, dtype=int).reshape(-1, 3))

    def _reference_link(self, first: Body, second: Body) -> str:
        """Return the common ancestor link of two bodies that is farthest from the root of the kinematic tree."""
        return self._parts.common_part(*(self._parts.of_link[body.link] for body in (first, second)))

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of each pair that is checked for collision."""
        return tuple((self.bodies[i].name, self.bodies[j].name) for i, j, _ in self.pairs)

    def pair_names(self, pair: int) -> tuple[str, str]:
        """Return the names of the two bodies of a checked pair: two links, or a link and an obstacle."""
        first, second, _ = self.pairs[pair]
        return self.bodies[first].link, self.bodies[second].link

    @property
    def disabled(self) -> list[tuple[str, str]]:
        """Pairs of links whose collision check the SRDF file disables."""
        return [pair for pair, reason in self.excluded.items() if reason == SRDF]

    @property
    def assumed(self) -> dict[str, str]:
        """Reasons why pairs of links that seem to collide permanently are not checked, keyed by text "A and B"."""
        checked_by_hull = {frozenset(self.pair_names(pair)) for pair in self.cover_pairs}
        return {
            " and ".join(pair): reason.value
            for pair, reason in self.excluded.items()
            if reason in ASSUMED and frozenset(pair) not in checked_by_hull
        }

    @property
    def has_moving_obstacles(self) -> bool:
        """Whether at least one obstacle moves."""
        return any(isinstance(obstacle, MovingObstacle) for obstacle in self.obstacles)

    def placements(self, base: Expression, q: Expression, time: Expression = 0.0) -> Expression:
        """Return rotation and position of all F frames of links and moving obstacles as one column. Shape (12 F, 1)."""
        columns = [part for frame in self._frames(base, q, time) for part in (ca.vec(frame.rotation), frame.position)]
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
        """Return the signed distances of n pairs of bodies for a configuration of the machine. Shape (n, 1), m.

        They are exact or lower bounds, see `distance`. For two hulls of meshes the distance is that of their covers, a
        lower bound.

        Args:
            base, q: Configuration of the machine.
            time: s.
            pairs: Indices of the pairs; all if None.
            rounding: As in `distance`, m.

        Raises:
            ModelError: An unknown pair, a negative rounding.
        """
        indices, rounding = self._checked_request(pairs, rounding)
        frames = [*self._frames(base, q, time), None]

        @cache
        def column_of(body: int) -> Expression:
            return column(self.bodies[body].shape, frames[self.bodies[body].frame])

        def pair_distance(i: int, j: int) -> Expression:
            a, b = self.bodies[i], self.bodies[j]
            kinds = type(a.shape), type(b.shape)
            if set(kinds) <= COLUMNS.keys():
                return pair_function(*kinds, rounding)(column_of(i), column_of(j))
            return distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding)

        distances = []
        for pair in indices:
            gaps = [pair_distance(*bodies) for bodies in self.cover_pairs.get(pair, (self.pairs[pair, :2].tolist(),))]
            distances.append(gaps[0] if len(gaps) == 1 else soft_minimum(gaps, rounding / 4 + MIN_SOFTNESS_M))
        return ca.vertcat(*distances) if distances else expression(q)[:0]

    def distance_gradients(self, *, pairs: Sequence[int] | None = None, rounding: float = 0.0) -> Any:
        """Return the CasADi Function that computes the signed distances of pairs of bodies, and their gradients.

        (base, q, time) -> distances (n, 1), m, and gradients for base and q, (n, base_size + joint_size), about fifteen
        times faster than `distances` and its Jacobian. For a base with a quaternion, gradients hold along rates that
        keep it a unit quaternion. Arguments and errors are those of `distances`.
        """
        indices, rounding = self._checked_request(pairs, rounding)
        groups = [self.cover_pairs.get(pair, (tuple(self.pairs[pair, :2].tolist()),)) for pair in indices]
        return _distance_gradients(self, groups, rounding)

    def _checked_request(self, pairs: Sequence[int] | None, rounding: float) -> tuple[list[int], float]:
        """Return the indices of the requested pairs (all if None) and the smoothing width, after checking both."""
        indices = np.arange(len(self.pairs))
        if isinstance(pairs, list | tuple) and not pairs:
            indices = indices[:0]
        elif pairs is not None:
            indices = require.indices("scene: pairs", pairs, len(indices)).ravel()
        return indices.tolist(), require.nonnegative("scene: rounding", rounding, unit="m")

    @cached_property
    def levers(self) -> Levers:
        """Bounds of each pair's relative velocity per unit coordinate rate; raises ModelError if one is infinite."""
        n, dof, size = len(self.pairs), self.machine.robot.dof, self.machine.base_size
        joints, turns = np.zeros((n, dof)), np.zeros((n, dof))
        base, base_turns = np.zeros((n, size)), np.zeros((n, size))
        known: dict[tuple[int, int], Levers] = {}
        for row, (first, second, reference) in enumerate(self.pairs.tolist()):
            for pair in [(first, second), *self.covers.get(row, np.zeros((0, 2), dtype=int)).tolist()]:
                for body in pair:
                    if (body, reference) not in known:
                        known[body, reference] = self._levers_of(self.bodies[body], reference)
                levers = [known[body, reference] for body in pair]
                for largest, *values in zip((base, base_turns, joints, turns), *levers, strict=True):
                    largest[row] = np.maximum(largest[row], sum(values))
        return Levers(base, base_turns, joints, turns)

    def check_motions(self, begin: float, end: float) -> None:
        """Raise ModelError if a moving obstacle's pose is invalid at a sampled time between `begin` and `end`, s."""
        for obstacle in self.obstacles:
            if isinstance(obstacle, MovingObstacle):
                obstacle.check(begin, end)

    def _frames(self, base: Expression, q: Expression, time: Expression) -> list[Frame]:
        machine = self.machine
        frames = link_frames(machine.robot, q, machine.world_from_base(base))
        return [*(frames[link] for link in self._carriers), *self._obstacle_frames(time)]

    def _obstacle_frames(self, time: Expression) -> list[Frame]:
        """Return the frames of the moving obstacles in the world at a time (s)."""
        return [obstacle.frame(time) for obstacle in self.obstacles if isinstance(obstacle, MovingObstacle)]

    def _close_meshes(
        self, own: Sequence[Body], checked: Sequence[tuple[int, int]]
    ) -> dict[tuple[LinkMesh | Body, LinkMesh | Body], list[tuple[int, int]]]:
        """Return the pairs of bodies whose checks use hulls of meshes instead of covers, grouped by pair of meshes.

        Such bodies have at most three joints between them and may be closer by design than the covers of their meshes
        allow, or their covers always collide.
        """
        pairs: dict[tuple[LinkMesh | Body, LinkMesh | Body], list[tuple[int, int]]] = {}
        for i, j in checked:
            first, second = own[i], own[j]
            up, down = self._parts.path(*(self._parts.of_link[body.link] for body in (first, second)))
            is_close = len(up) + len(down) <= 3 or self.excluded.get((first.link, second.link)) == COVERED
            if is_close and (first.mesh is not None or second.mesh is not None):
                pairs.setdefault((first.mesh or first, second.mesh or second), []).append((i, j))
        return pairs

    def _moves(self, link: str) -> bool:
        """Return whether a link can move in the world, because the base moves or a moving joint carries the link."""
        return bool(self.machine.base_size) or any(joint.moves for joint in self.machine.robot.path_to(link))

    def _levers_of(self, placed: PlacedShape, reference: int) -> Levers:
        """Return bounds of a body's velocity relative to a link or the world (-1), per unit rate of joints and base."""
        robot, parts, size = self.machine.robot, self._parts, self.machine.base_size
        levers = Levers(np.zeros(size), np.zeros(size), np.zeros(robot.dof), np.zeros(robot.dof))
        if not 0 <= placed.frame < len(self._carriers):
            return levers  # an obstacle
        link, base_link = self._carriers[placed.frame], robot.root if reference == WORLD else self._carriers[reference]
        path = parts.path(parts.of_link[base_link], parts.of_link[link])[1]
        infinite = np.full(robot.dof, np.inf)
        low, high = (robot.lower, robot.upper) if self.limits else (-infinite, infinite)
        shape = placed.shape.placed(*parts.pose[link])
        lengths, reach = lever_arms(robot, [(step, True) for step in path], shape, low=low, high=high)
        for (joint, *_), arm in zip(path, lengths, strict=True):
            column, ratio, _ = robot.couplings[joint.name]
            slides = joint.kind == "prismatic"
            levers.joints[column] += abs(ratio) * (1.0 if slides else arm)
            levers.joint_turns[column] += 0.0 if slides else abs(ratio)
        if not np.isfinite(levers.joints).all() or not np.isfinite(reach):
            name = next(joint.name for joint, *_ in path if joint.kind == "prismatic")
            message = f"scene: joint {name!r} slides without limits; give it position limits"
            raise ModelError(message, name=name, value=np.inf)
        if reference == WORLD and size:
            planar = size == 3
            # a unit quaternion that changes by dq turns by 2 |dq|
            levers.base[:] = (1.0, 1.0, reach) if planar else [1.0] * 3 + [2.0 * reach] * 4
            levers.base_turns[:] = (0.0, 0.0, 1.0) if planar else [0.0] * 3 + [2.0] * 4
        return levers


def _bodies_by_mesh(robot: Robot, bodies: Sequence[Body]) -> dict[tuple[str, int], tuple[Body, ...]]:
    """Return the bodies that cover each mesh, keyed by link and index of the mesh among the link's collision shapes."""
    covers: dict[tuple[str, int], tuple[Body, ...]] = {
        (link.name, number): ()
        for link in robot.links
        for number, shape in enumerate(link.collisions)
        if shape.kind == "mesh"
    }
    for body in bodies:
        if body.mesh is not None:
            covers[body.link, body.mesh.number] += (body,)
    return covers


def _checked_list(values: Any, argument: str) -> tuple[Any, ...]:
    if not isinstance(values, list | tuple) or len(values) > INPUT_LIMITS.count:
        message = f"scene: {argument} must be a list of at most {INPUT_LIMITS.count}, not {repr(values)[:80]}"
        raise ModelError(message, name=argument, value=values, limit=INPUT_LIMITS.count)
    return tuple(values)


def _pair(value: Any, number: int) -> tuple[str, str]:
    if isinstance(value, tuple | list) and len(value) == 2 and all(isinstance(name, str) for name in value):
        return value[0], value[1]
    raise ModelError(f"scene: ignored[{number}] must be two names, not {value!r}", name="ignored", value=value)


def _distance_gradients(scene: CollisionScene, groups: Sequence[Sequence[tuple[int, int]]], rounding: float) -> Any:
    """Return the CasADi Function that computes the least distance in each group of body pairs, and its gradient."""
    machine, bodies = scene.machine, scene.bodies
    base, q, time = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("time")
    world_from_base = machine.world_from_base(base)
    links, axes = frames_and_axes(machine.robot, q, world_from_base)
    frames = [*(links[link] for link in scene._carriers), *scene._obstacle_frames(time), None]
    screws = ca.horzcat(base_twists(world_from_base, base), *(ca.vertcat(*axis) for axis in axes.values()))
    pairs = np.array([both for group in groups for both in group], dtype=int).reshape(-1, 2)
    batches: dict[Any, list[int]] = {}
    for number, both in enumerate(pairs.tolist()):
        kinds = tuple(type(bodies[body].shape) for body in both)
        batches.setdefault(kinds if set(kinds) <= COLUMNS.keys() else None, []).append(number)
    general = batches.pop(None, [])
    general_pairs = [[bodies[body] for body in pairs[number]] for number in general]
    gaps = [distance(a.shape, b.shape, frames[a.frame], frames[b.frame], rounding=rounding) for a, b in general_pairs]
    general_gaps = ca.vertcat(ca.SX(0, 1), *gaps)
    sides = [
        [ca.vertcat(*(column(bodies[k].shape, frames[bodies[k].frame]).T for k in side)) for side in pairs[members].T]
        for members in batches.values()
    ]
    general_gradients = ca.jacobian(general_gaps, ca.vertcat(base, q))
    parts = ca.cse([ca.SX(screws), general_gaps, general_gradients, *(side for both in sides for side in both)])
    geometry = ca.Function("posed", [base, q, time], list(map(ca.densify, parts)))

    names = ["base", "q", "time"]
    arguments = [ca.MX.sym(name, symbol.numel()) for name, symbol in zip(names, (base, q, time), strict=True)]
    twist_columns, value, gradient, *columns = geometry.call(arguments)
    signs = _motion_signs(scene, pairs, list(axes))
    reduction = ca.diagcat(ca.DM.eye(machine.base_size), coupling_matrix(machine.robot))
    values, rows, order = [value], [gradient], list(general)
    for k, (kinds, members) in enumerate(batches.items()):
        gap, wrench = pair_wrenches(kinds[0], kinds[1], rounding, len(members))(*columns[2 * k : 2 * k + 2])
        joint_gradient = ca.mtimes(wrench, twist_columns) * signs[members]
        values.append(gap)
        rows.append(ca.mtimes(joint_gradient, reduction))
        order += members
    result = ca.vertcat(*values), ca.vertcat(*rows)
    if order:
        positions, counts = np.argsort(order, kind="stable").tolist(), list(map(len, groups))
        result = soft_minima(*result, positions, counts, softness=rounding / 4 + MIN_SOFTNESS_M)
    return ca.Function("distances", arguments, result, names, ["distances", "gradients"])


def _motion_signs(scene: CollisionScene, pairs: Array, joints: Sequence[str]) -> Array:
    """Return, for n pairs and k coordinates, 1 where only the first body moves, -1 where only the second, else 0."""
    size, carriers = scene.machine.base_size, scene._carriers
    carried = np.zeros((len(scene.bodies), size + len(joints)))
    for k, body in enumerate(scene.bodies):
        if 0 <= body.frame < len(carriers):
            above = {joint.name for joint in scene.machine.robot.path_to(carriers[body.frame])}
            carried[k] = [1.0] * size + [float(name in above) for name in joints]
    return np.asarray(carried[pairs[:, 0]] - carried[pairs[:, 1]])
