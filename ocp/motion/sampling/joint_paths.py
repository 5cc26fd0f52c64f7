"""Piecewise straight paths in joint space: proofs of clearance, shortening, and tests of homotopy.

**Proof.** On a straight motion by dq, no two bodies of a pair approach each other by more than levers |dq|
(:class:`models.machines.collision_scene.Levers`). If their distance at the middle of the motion exceeds the clearance
by more than half of that, the whole motion is clear (conservative advancement, Mirtich 1996). Along a fixed direction,
the gap between both bodies falls below the smaller one of its ends by at most turns |dq| levers |dq| / 4
(`ocp.audit.clearance`). This second bound, along the direction of the closest points at the middle, decides motions
along a surface. Otherwise the motion is halved for this pair alone. Many motions are proven at once, level by level, so
that numpy evaluates long arrays.

**Shortening.** `shorten` replaces parts of a path by straight motions that are proven clear and shorter, so that it
never becomes longer. `optimise_length` moves all corners towards a locally shortest path by a sequence of convex
problems. If the lengths of its motions are h now, then the length of a path is at most

    sum over the motions (|scale * dq|^2 / h + h) / 2,

and equal to it now. Each step minimises this bound, so that the length decreases, under linearised clearance
constraints at the ends and the middles of the motions. This least-distance problem is solved by its dual, a nonnegative
least-squares problem (Lawson & Hanson 1974, chapter 23). A motion that a step does not leave provably clear stays where
it was, so that all paths are proven clear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from models import CollisionScene
from models.checks import Array
from ocp.console import check_time
from ocp.motion.local.collisions import Collision, find_collisions, near_pairs, prepared_pairs
from ocp.problem.hulls import Frames, frames_of
from ocp.tolerances import CLEARANCE_TOLERANCE_M

Indices = NDArray[np.intp]
COMPARED_PLACES = 32  # number of fractions of their length at which two paths are compared


@dataclass(frozen=True)
class StraightMotionSettings:
    """Resolution of the collision proofs for straight motions.

    Attributes:
        finest: Approach of two bodies within half an interval below which it is not halved again, m. The motion counts
            as not clear then, though bodies may keep the clearance by about the square of this over their size.
        uneven: Approach within half an interval below which the second bound is evaluated, m.
        first: Largest approach of two bodies within the intervals of the first level, m: at larger ones hardly any pair
            is decided.
        tolerance: Distance by which the clearance may be missed, m: half of what the audit allows, so that motions may
            begin and end at the clearance itself.
        block: Largest number of pairs of bodies, over all configurations, that are evaluated at once.
    """

    finest: float = 1e-3
    uneven: float = 0.05
    first: float = 0.4
    tolerance: float = CLEARANCE_TOLERANCE_M / 2
    block: int = 1_000_000


PROOF = StraightMotionSettings()


class StraightMotions:
    """Collision checker that proves clearances on straight joint motions, for a fixed base and fixed obstacles.

    Attributes:
        scene: Collision scene; None if nothing can collide.
    """

    def __init__(self, scene: CollisionScene | None) -> None:
        self.scene = scene if scene is not None and len(scene.pairs) else None
        if self.scene is not None:
            self._required = self.scene.clearance - PROOF.tolerance
            self._placements, self._bodies = prepared_pairs(self.scene)
            self._levers, self._turns = self.scene.levers.joints, self.scene.levers.joint_turns

    def collisions(self, joints: Array) -> list[Collision]:
        """Return the pairs of bodies closer than the clearance in a configuration (n,), sorted by distance."""
        if self.scene is None:
            return []
        collisions = find_collisions(self.scene, np.zeros(0), joints[None], np.zeros(1))
        return [collision for collision in collisions if collision.distance < self._required]

    def near_pairs(self, joints: Array, reach: float) -> tuple[Indices, Indices, Array, Array]:
        """Return the pairs of bodies whose distance in configurations (M, n) is below the clearance plus `reach`, m.

        Returns:
            Configuration and pair of each, their distance beyond the clearance, m, shape (K,) each, and its gradient,
            shape (K, n).
        """
        if self.scene is None:
            return np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, joints.shape[1]))
        return near_pairs(self.scene, joints, reach)

    def are_clear(self, starts: Array, ends: Array) -> NDArray[np.bool_]:
        """Return which straight motions are proven collision-free. Shape (M,).

        Args:
            starts, ends: Configurations at both ends. Shape (M, n), rad or m.
        """
        clear = np.ones(len(starts), dtype=bool)
        if self.scene is None or not len(starts):
            return clear
        distances = np.abs(ends - starts)
        approach, turning = distances @ self._levers.T, distances @ self._turns.T  # (M, P)
        pieces = np.maximum(np.ceil(approach.max(axis=1) / PROOF.first), 1).astype(int)
        motion = np.repeat(np.arange(len(starts)), pieces)
        number = np.arange(len(motion)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        width, middle = 1 / pieces[motion], (number + 0.5) / pieces[motion]
        order = np.argsort(np.abs(middle - 0.5), kind="stable")  # blocks are then spread over all motions
        blocks = -(-len(order) * len(self._levers) // PROOF.block)
        for part in np.array_split(order, blocks):
            keep = part[clear[motion[part]]]
            self._prove((starts, ends), (approach, turning), clear, (motion[keep], middle[keep], width[keep]))
        return clear

    def _prove(
        self,
        lines: tuple[Array, Array],
        sizes: tuple[Array, Array],
        clear: NDArray[np.bool_],
        intervals: tuple[Indices, Array, Array],
    ) -> None:
        """Prove straight motions collision-free by bisection; set `clear` to False for motions that may collide.

        `lines` are the starts and ends of the motions, `sizes` the approach and turning of each pair of bodies over
        each whole motion, `intervals` the number of the motion, the middle and the width of each interval.
        """
        (approach, turning), (motion, middle, width) = sizes, intervals
        interval = pair = np.zeros(0, dtype=np.intp)  # undecided pairs of the intervals, after the first level
        first = True
        required = self._required
        while len(motion):
            check_time()
            frames = self._frames_on(lines, motion, middle)
            if first:
                first = False
                balls = self._bodies.all_balls(frames)
                interval, pair = np.nonzero(balls < required + approach[motion] * (width / 2)[:, None])
                reach = approach[motion[interval], pair] * (width / 2)[interval]
            else:
                reach = approach[motion[interval], pair] * (width / 2)[interval]
                close = self._bodies.balls(frames, interval, pair) < required + reach
                interval, pair, reach = interval[close], pair[close], reach[close]
            if not len(interval):
                return
            gap = self._bodies.gaps(frames, interval, pair, required + reach)
            clear[motion[interval[gap < required]]] = False
            undecided = (gap < required + reach) & clear[motion[interval]]
            interval, pair, reach = interval[undecided], pair[undecided], reach[undecided]
            uneven = np.flatnonzero(reach < PROOF.uneven)
            if len(uneven):
                bow = reach[uneven] * (turning[motion[interval], pair] * width[interval])[uneven] / 2
                facing, _, _ = self._bodies.nearest(frames, interval[uneven], pair[uneven])
                places = np.concatenate([middle - width / 2, middle + width / 2])
                frames = self._frames_on(lines, np.tile(motion, 2), places)
                chord = self._bodies.chords(facing, frames, (interval[uneven], interval[uneven] + len(motion)))
                open_ = chord - bow < required
                clear[motion[interval[uneven[open_ & (reach[uneven] < PROOF.finest)]]]] = False
                undecided = np.ones(len(interval), dtype=bool)
                undecided[uneven] = open_
                undecided &= clear[motion[interval]]
                interval, pair = interval[undecided], pair[undecided]
            kept, index = np.unique(interval, return_inverse=True)
            pair, interval = np.tile(pair, 2), np.concatenate([index, index + len(kept)])
            shift = width[kept] / 4
            motion, width = np.tile(motion[kept], 2), np.tile(width[kept] / 2, 2)
            middle = np.concatenate([middle[kept] - shift, middle[kept] + shift])

    def _frames_on(self, lines: tuple[Array, Array], motion: Indices, places: Array) -> Frames:
        """Return the frames of all bodies on K straight motions, at a given fraction of the length of each motion."""
        starts, ends = lines[0][motion], lines[1][motion]
        joints = starts + places[:, None] * (ends - starts)
        base = np.broadcast_to(self.scene.machine.base_home(), (len(joints), 0))  # type: ignore[union-attr]
        return frames_of(self._placements(base, joints, np.zeros((len(joints), 1)))[0])


@dataclass(frozen=True)
class ShorteningSettings:
    """Settings of `shorten`, which replaces parts of paths by random shortcuts.

    Attributes:
        batch: Number of random shortcuts that are tried at once.
        least_gain: Relative decrease of the length, over `patience` successive batches, below which it ends.
        patience: Number of these batches.
        most_batches: Largest number of batches.
    """

    batch: int = 24
    least_gain: float = 1e-2
    patience: int = 3
    most_batches: int = 60


SHORTENING = ShorteningSettings()


def path_length(path: Array, scale: Array) -> float:
    """Return the length of a joint path (M, n) in the metric in which a displacement dq has length |scale * dq|."""
    return float(np.linalg.norm(np.diff(path, axis=0) * scale, axis=1).sum())


def points_along(path: Array, scale: Array, shares: Array) -> Array:
    """Return the configurations at fractions (K,) of the length of a joint path (M, n). Shape (K, n)."""
    places = _places(path, scale)
    return np.column_stack([np.interp(shares * places[-1], places, column) for column in path.T])


def shorten(motions: StraightMotions, path: Array, scale: Array, *, random: np.random.Generator) -> Array:
    """Shorten a joint path by random shortcuts; each straight motion of the result is proven collision-free.

    Args:
        motions: Proofs of clearance.
        path: Configurations with clear straight motions between them. Shape (M, n).
        scale: Metric, as of `path_length`. Shape (n,).
        random: Source of the shortcuts that are tried.
    """

    def lengths_of(changes: Array) -> Array:
        return np.asarray(np.linalg.norm(changes * scale, axis=1))

    path = shortest_through_corners(motions, path, lengths_of)
    lengths = [path_length(path, scale)]
    for _ in range(SHORTENING.most_batches):
        if len(path) == 2:
            break
        path = shortest_through_corners(motions, _apply_shortcuts(motions, path, scale, random), lengths_of)
        lengths.append(path_length(path, scale))
        before = lengths[-1 - SHORTENING.patience] if len(lengths) > SHORTENING.patience else np.inf
        if lengths[-1] > (1 - SHORTENING.least_gain) * before:
            break
    return path


def same_class(motions: StraightMotions, first: Array, second: Array, scale: Array) -> bool:
    """Return whether two paths count as homotopic: no straight motion between their points at equal fractions collides.

    Paths of one homotopy class need not pass this test; paths that pass can replace each other as guesses.
    """
    shares = np.linspace(0.0, 1.0, COMPARED_PLACES + 2)[1:-1]
    return bool(motions.are_clear(*(points_along(path, scale, shares) for path in (first, second))).all())


def _places(path: Array, scale: Array) -> Array:
    """Return the arc length from the start at each configuration of a joint path. Shape (M,)."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0) * scale, axis=1)))


def shortest_through_corners(motions: StraightMotions, path: Array, costs_of: Callable[[Array], Array]) -> Array:
    """Return the collision-free path of least cost from start to end through any subset of the corners of a path.

    Args:
        motions: Proofs of clearance.
        path: Configurations with clear straight motions between them. Shape (M, n).
        costs_of: Costs (K,) of straight motions by displacements (K, n).
    """
    count = len(path)
    first, last = np.triu_indices(count, 2)
    clear = np.eye(count, k=1, dtype=bool)
    clear[first, last] = motions.are_clear(path[first], path[last])
    costs = np.full((count, count), np.inf)
    costs[clear] = costs_of((path[None] - path[:, None])[clear])
    best, previous = np.full(count, np.inf), np.zeros(count, dtype=int)
    best[0] = 0.0
    for corner in range(1, count):
        totals = best[:corner] + costs[:corner, corner]
        previous[corner] = int(totals.argmin())
        best[corner] = totals[previous[corner]]
    corners = [count - 1]
    while corners[-1]:
        corners.append(int(previous[corners[-1]]))
    return path[corners[::-1]]


def _apply_shortcuts(motions: StraightMotions, path: Array, scale: Array, random: np.random.Generator) -> Array:
    """Replace parts of a path by straight shortcuts between random points; the best shortcuts are applied first."""
    places = _places(path, scale)
    ends = np.sort(random.random((SHORTENING.batch, 2)) * places[-1], axis=1)
    begins, stops = (points_along(path, scale, ends[:, side] / places[-1]) for side in (0, 1))
    gains = ends[:, 1] - ends[:, 0] - np.linalg.norm((stops - begins) * scale, axis=1)
    tried = np.flatnonzero(gains > 1e-9 * places[-1])
    tried = tried[motions.are_clear(begins[tried], stops[tried])]
    taken: list[int] = []
    for k in tried[np.argsort(-gains[tried], kind="stable")].tolist():
        if all(ends[k, 1] <= ends[other, 0] or ends[k, 0] >= ends[other, 1] for other in taken):
            taken.append(k)
    outside = np.ones(len(path), dtype=bool)
    for k in taken:
        outside &= (places <= ends[k, 0]) | (places >= ends[k, 1])
    positions = np.concatenate([places[outside], ends[taken].ravel()])
    corners = np.concatenate([path[outside], *([begins[k], stops[k]] for k in taken)]) if taken else path
    return np.asarray(corners[np.argsort(positions, kind="stable")]) if taken else path


@dataclass(frozen=True)
class LengthSettings:
    """Settings of `optimise_length`, which minimises the length of a path locally.

    Attributes:
        motion: Length of the straight motions, in the metric of the path.
        fewest, most: Bounds of the number of these motions.
        reach: Distance beyond the clearance within which pairs of bodies are constrained, m.
        margin: Distance beyond the clearance that is required where it is constrained, m, since straight motions come
            closer between these places.
        inertia, most_inertia: First and largest weight of the squared step, relative to that of the squared motions.
        braking: Factor of the inertia after a step that had to be shortened; its inverse after others.
        least_share: Mean share of a step below which it counts as shortened.
        smallest_share: Share of a step below which a configuration stays where it is.
        shortest: Least length of a motion that the bound assumes, relative to the mean.
        least_gain, patience: It ends after more than `patience` successive steps that decrease the length by less,
            relative to it.
        most_steps: Largest number of steps.
    """

    motion: float = 0.15
    fewest: int = 12
    most: int = 64
    reach: float = 0.05
    margin: float = 1e-3
    inertia: float = 0.02
    most_inertia: float = 10.0
    braking: float = 4.0
    least_share: float = 0.75
    smallest_share: float = 0.1
    shortest: float = 0.05
    least_gain: float = 2e-4
    patience: int = 2
    most_steps: int = 20


OPTIMISATION = LengthSettings()


def optimise_length(motions: StraightMotions, path: Array, scale: Array, *, limits: tuple[Array, Array]) -> Array:
    """Minimise the length of a path locally; all straight motions of the resulting path are proven collision-free.

    Args:
        motions: Proofs of clearance.
        path: Configurations with clear straight motions between them. Shape (M, n).
        scale: The length of a displacement is |scale * dq|. Shape (n,).
        limits: Lower and upper limits of the joints. Shape (n,) each.
    """
    if len(path) == 2:
        return path
    length = path_length(path, scale)
    count = int(np.clip(np.ceil(length / OPTIMISATION.motion), OPTIMISATION.fewest, OPTIMISATION.most))
    chain = _resample(motions, path, scale, count)
    best, best_length, inertia, idle = path, length, OPTIMISATION.inertia, 0
    for _ in range(OPTIMISATION.most_steps):
        check_time()
        step = _length_step(motions, chain, scale, limits, inertia)
        moved, shares = _clear_step(motions, chain, chain + step)
        length = path_length(moved, scale)
        gain = 1 - length / best_length
        if gain > 0:
            best, best_length = moved, length
        shortened = shares.mean() < OPTIMISATION.least_share
        inertia *= OPTIMISATION.braking if shortened else 1 / OPTIMISATION.braking
        idle = idle + 1 if gain < OPTIMISATION.least_gain else 0
        if idle > OPTIMISATION.patience or inertia > OPTIMISATION.most_inertia:
            break
        chain = _resample(motions, best, scale, count)
    return best


def _resample(motions: StraightMotions, path: Array, scale: Array, count: int) -> Array:
    """Divide a path into collision-free straight motions of similar length; keep old corners where a shortcut fails.

    The result is the old path if the motions cannot be proven, since halves of a proven motion need not be.
    """
    shares = np.linspace(0.0, 1.0, count + 1)
    chain = points_along(path, scale, shares)
    blocked = np.flatnonzero(~motions.are_clear(chain[:-1], chain[1:]))
    if not len(blocked):
        return chain
    places = _places(path, scale)
    places /= places[-1]
    inside = ((places > shares[blocked, None]) & (places < shares[blocked + 1, None])).any(axis=0)
    order = np.argsort(np.concatenate([shares, places[inside]]), kind="stable")
    chain = np.concatenate([chain, path[inside]])[order]
    return chain if motions.are_clear(chain[:-1], chain[1:]).all() else path


def _length_step(
    motions: StraightMotions, chain: Array, scale: Array, limits: tuple[Array, Array], inertia: float
) -> Array:
    """Return displacements of a path's corners that minimise an upper bound of the length under linear constraints.

    The clearance constraints are linearised. Shape (m + 1, n).
    """
    inner, n = len(chain) - 2, chain.shape[1]
    places = np.empty((2 * len(chain) - 1, n))
    places[::2], places[1::2] = chain, (chain[:-1] + chain[1:]) / 2
    at, _, distance, gradient = motions.near_pairs(places[1:-1], OPTIMISATION.reach)
    weights = np.zeros((len(at), len(chain)))  # of the chain's configurations at the place of each row
    weights[np.arange(len(at)), (at + 1) // 2] += 0.5
    weights[np.arange(len(at)), (at + 2) // 2] += 0.5
    rows = (weights[:, 1:-1, None] * (gradient / scale)[:, None]).reshape(len(at), inner * n)
    least = OPTIMISATION.margin - distance
    flat = np.tile(scale, inner)
    for sign, limit in zip((1.0, -1.0), limits, strict=True):
        room = (sign * (chain[1:-1] - limit)).ravel()
        close = np.flatnonzero(room < 0.5)
        rows = np.vstack([rows, sign * np.eye(inner * n)[close] / flat])
        least = np.append(least, -room[close])
    # for the scaled step y of the inner configurations: y' H y / 2 + slope' y, with H the same for all joints
    changes = np.diff(chain * scale, axis=0)
    lengths = np.linalg.norm(changes, axis=1)
    stiffness = 1 / np.maximum(lengths / lengths.mean(), OPTIMISATION.shortest)
    hessian = np.diag(stiffness[:-1] + stiffness[1:] + inertia)
    hessian -= np.diag(stiffness[1:-1], 1) + np.diag(stiffness[1:-1], -1)
    factor = np.linalg.cholesky(hessian)
    slope = -np.diff(stiffness[:, None] * changes, axis=0)
    target = -np.linalg.solve(factor, slope)  # in z = factor' y the energy is |z - target|^2
    turned = np.asarray(np.linalg.solve(factor, rows.reshape(len(rows), inner, n)), dtype=float)
    z = _nearest_point(target.ravel(), turned.reshape(len(rows), -1), np.minimum(least, 0.0))
    return np.vstack([np.zeros(n), np.linalg.solve(factor.T, z.reshape(inner, n)) / scale, np.zeros(n)])


def _nearest_point(target: Array, rows: Array, least: Array) -> Array:
    """Return the point nearest to a target in the polyhedron `rows` z >= `least`, which contains the origin."""
    needed = least - rows @ target
    if needed.max(initial=0.0) <= 0:
        return target
    size = float(np.abs(needed).max())
    matrix = np.vstack([rows.T, needed[None] / size])
    right = np.append(np.zeros(len(target)), 1.0)
    multipliers, _ = scipy.optimize.nnls(matrix, right, maxiter=10 * matrix.shape[1])
    residual = matrix @ multipliers - right
    if residual[-1] >= 0:
        return np.zeros_like(target)
    return np.asarray(target - residual[:-1] / residual[-1] * size)


def _clear_step(motions: StraightMotions, chain: Array, moved: Array) -> tuple[Array, Array]:
    """Shorten the displacements of a path's corners until the moved path is collision-free.

    Return the moved path, and the fractions of the displacements by which its corners are moved.
    """
    shares = np.ones(len(chain))
    while True:
        trial = chain + shares[:, None] * (moved - chain)
        blocked = ~motions.are_clear(trial[:-1], trial[1:])
        if not blocked.any():
            return trial, shares
        ends = np.append(blocked, False) | np.append(False, blocked)
        shares = np.where(ends, np.where(shares > OPTIMISATION.smallest_share, shares / 2, 0.0), shares)
