"""How near the bodies of a machine come to each other and to obstacles at samples of a motion.

Between the samples nothing is said: a plan's audit proves what holds there (:mod:`ocp.audit.clearance`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models import HalfSpace, Machine, Surroundings
from models.arrays import Array
from models.shapes.distance import COLUMNS, VECTORS, column, pair_columns, pair_function
from ocp.errors import ProblemError, checked_instance
from ocp.problem.formulation import Sampler
from ocp.problem.hulls import Covered, Frames, Hull, frames_of, grouped

__all__ = ["Touch", "checked_surroundings", "distances_along", "hulls_of", "touches"]

SIDE = 64
"""Pairs that are measured side by side: five times faster than one by one."""
Measure: TypeAlias = Callable[[Frames, Array, Array], Array]
"""(frames, samples (K,), places (K,) of pairs among those of a lot) -> their distances there (K,), m."""


class Touch(NamedTuple):
    """Two bodies that come too near.

    Attributes:
        pair: Its place in `Surroundings.pairs`. bodies: Their names.
        distance: m, negative where they overlap. time: s.
    """

    pair: int
    bodies: tuple[str, str]
    distance: float
    time: float

    def __str__(self) -> str:
        how = f"overlap by {-self.distance:.3g} m" if self.distance < 0 else f"are {self.distance:.3g} m apart"
        return f"{self.bodies[0]} and {self.bodies[1]} {how} at {self.time:.4g} s"


def hulls_of(surroundings: Surroundings) -> dict[str, Hull]:
    """The bodies and obstacles, by name."""
    return {
        body.name: Hull(body.frame, body.shape.core, body.shape.swelling, getattr(body.shape, "normal", np.zeros(0)))
        for body in surroundings.bodies
    }


def distances_along(
    surroundings: Surroundings, base: Array, joints: Array, times: Array, near: float = np.inf
) -> Array:
    """Distances of all pairs at samples of a motion; how deep those with a mesh or a cylinder overlap is told about.

    Shape (M, n), m.

    Args:
        surroundings: Of the machine that moves.
        base: Its base, shape (M, base_size) or (base_size,). joints: Shape (M, joint_size). times: s. Shape (M,).
        near: Of pairs that are no nearer than this, m, some number is told that is no less, and no more than they are.
    """
    return _measured(surroundings, base, joints, times, near)


def touches(surroundings: Surroundings, base: Array, joints: Array, times: Array) -> list[Touch]:
    """The pairs that come nearer than the clearance at some samples, each where it is nearest, the worst first.

    Args: As of `distances_along`.
    """
    apart = _measured(surroundings, base, joints, times, surroundings.clearance)
    if not apart.size:
        return []
    where, labels = apart.argmin(axis=0), surroundings.labels
    found = [
        Touch(pair, labels[pair], float(apart[where[pair], pair]), float(np.ravel(times)[where[pair]]))
        for pair in np.flatnonzero(apart.min(axis=0) < surroundings.clearance).tolist()
    ]
    return sorted(found, key=lambda touch: touch.distance)


def _measured(surroundings: Surroundings, base: Array, joints: Array, times: Array, near: float) -> Array:
    """Distances of all pairs (M, n), of those that are no nearer than `near` some number that is no less."""
    count, n = len(joints), len(surroundings.pairs)
    if not n:
        return np.zeros((count, 0))
    pairs = _prepared(surroundings)
    places = np.broadcast_to(base, (count, surroundings.machine.base_size))
    frames = frames_of(pairs.placements(places, joints, np.reshape(times, (-1, 1)))[0])
    apart = pairs.balls(frames)
    sample, pair = np.nonzero(~(apart >= near))
    place, row = pairs.covered.of(pair)
    gap, count = np.full(len(row), -np.inf), len(pair)

    def measure(some: np.ndarray) -> None:
        for lot in pairs.lots:
            chosen = some[lot.has[row[some]]]
            if chosen.size:
                gap[chosen] = lot.measure(frames, sample[place[chosen]], np.cumsum(lot.has)[row[chosen]] - 1)

    measure(np.arange(count, len(row)))
    covered = gap[pairs.covered.decisive(place, gap, count)]
    measure(np.flatnonzero(~(covered >= near)))  # hulls are dear, and need not be looked at where covers are apart
    apart[sample, pair] = gap[pairs.covered.decisive(place, gap, count)]
    return np.where(np.isfinite(apart), apart, -np.inf)


class _Lot(NamedTuple):
    """Rows of pairs that are measured alike: whether a row is one of them, shape (n + m,), and how."""

    has: Array
    measure: Measure


class _Pairs:
    """All pairs of surroundings.

    Attributes:
        placements: Function (base, joints, time) -> placements. covered: The pairs and what covers them.
        lots: Its rows by kind.
    """

    def __init__(self, surroundings: Surroundings) -> None:
        machine, pairs, bodies = surroundings.machine, surroundings.pairs, surroundings.bodies
        base, joints = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)
        time = ca.SX.sym("time")
        self.placements = Sampler([base, joints, time], [ca.SX(surroundings.placements(base, joints, time))])
        hulls = tuple(hulls_of(surroundings).values())
        self.covered = Covered(pairs, surroundings.covers)
        self._one, self._other = pairs[:, 0], pairs[:, 1]
        self._riding = np.array([hull.frame for hull in hulls])
        self._middles = np.array([hull.middle for hull in hulls])
        self._reach = np.array([hull.size + hull.radius for hull in hulls])
        self._grounds = [k for k, body in enumerate(bodies) if isinstance(body.shape, HalfSpace)]
        self._normals = {k: hulls[k].normal for k in self._grounds}
        rows = self.covered.rows
        kinds = [tuple(type(bodies[k].shape) for k in row[:2]) for row in rows]
        simple = np.array([set(both) <= COLUMNS.keys() for both in kinds])
        self.lots = []
        for both in dict.fromkeys(both for both, known in zip(kinds, simple, strict=True) if known):
            has = np.array([one == both for one in kinds])
            self.lots.append(_Lot(has, _by_formula(surroundings, rows[has], both)))
        others = np.flatnonzero(~simple)
        for group in grouped(hulls, rows[others]):
            has = np.zeros(len(rows), dtype=bool)
            has[others[group.has]] = True
            self.lots.append(_Lot(has, lambda *given, group=group: group.nearest(*given)[1]))

    def balls(self, frames: Frames) -> Array:
        """How far balls about the middles of both bodies, which hold them, are apart. Shape (M, n), m."""
        rotations, positions = frames
        middles = np.einsum("mbij,bj->mbi", rotations[:, self._riding], self._middles) + positions[:, self._riding]
        apart = np.linalg.norm(middles[:, self._other] - middles[:, self._one], axis=2)
        for k in self._grounds:
            beside = self._other == k  # obstacles come second
            apart[:, beside] = (middles[:, self._one[beside]] - middles[:, k, None]) @ self._normals[k]
        return np.asarray(apart - self._reach[self._one] - self._reach[self._other])


def _by_formula(surroundings: Surroundings, rows: np.ndarray, kinds: tuple[Any, ...]) -> Measure:
    """Distances of pairs of two kinds of shapes that have columns, see `models.shapes.distance`."""
    distance, beside = pair_function(*kinds), pair_columns(kinds[0], kinds[1], 0.0, SIDE)
    columns, riding = [], []
    for side in (0, 1):
        some, which = np.unique(rows[:, side], return_inverse=True)
        placed = [surroundings.bodies[k] for k in some]
        columns.append(np.array([np.array(column(body.shape)).ravel() for body in placed])[which])
        riding.append(np.array([body.frame for body in placed])[which])

    def measured(frames: Frames, at: Array, row: Array) -> Array:
        sides = []
        for kind, own, frame in zip(kinds, columns, riding, strict=True):
            turn, shift = (part[at, frame[row]] for part in frames)
            moved = own[row]
            points, directions = VECTORS[kind]
            width = 3 * (points + directions)
            vectors = moved[:, :width].reshape(len(row), -1, 3) @ np.swapaxes(turn, 1, 2)
            vectors[:, :points] += shift[:, None]
            moved[:, :width] = vectors.reshape(len(row), width)
            sides.append(moved)
        lots, found = len(row) // SIDE, np.empty(len(row))
        if lots:
            given = (side[: lots * SIDE].reshape(lots, SIDE, -1).swapaxes(0, 1).reshape(SIDE, -1) for side in sides)
            found[: lots * SIDE] = np.array(beside.map(lots)(*given)).T.ravel()
        if lots * SIDE < len(row):
            found[lots * SIDE :] = np.array(distance(*(side[lots * SIDE :].T for side in sides))).ravel()
        return found

    return measured


def _prepared(surroundings: Surroundings) -> _Pairs:
    """The pairs, kept with the surroundings."""
    kept: _Pairs | None = surroundings.__dict__.get("_prepared")
    if kept is None:
        kept = surroundings.__dict__["_prepared"] = _Pairs(surroundings)
    return kept


def checked_surroundings(value: Any, machine: Machine, limits: bool = True) -> Surroundings:
    """Surroundings of a machine whose joints keep their limits, or do not, or ProblemError unless they are."""
    if checked_instance("surroundings", value, Surroundings).machine is not machine:
        words = "surroundings are those of another machine; make them of this one: Surroundings(machine, ...)"
        raise ProblemError(words, name="surroundings", value=value)
    if value.limits and not limits:
        words = "surroundings keep the joints within their limits; make them without: Surroundings(..., limits=False)"
        raise ProblemError(words, name="surroundings", value=value)
    found: Surroundings = value
    return found
