"""Proofs that straight motions in joint space keep the clearance of a collision scene.

On a straight motion by dq, no two bodies of a pair approach each other by more than levers |dq|
(:class:`models.machines.collision_scene.Levers`). If their distance at the middle of the motion exceeds the clearance
by more than half of that, the whole motion is clear (conservative advancement, Mirtich 1996). Along a fixed direction,
the gap between both bodies falls below the smaller one of its ends by at most turns |dq| levers |dq| / 4
(`ocp.audit.clearance`). This second bound, along the direction of the closest points at the middle, decides motions
along a surface. Otherwise the motion is halved for this pair alone. Many motions are proven at once, level by level, so
that numpy evaluates long arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models import CollisionScene
from models.checks import Array
from ocp.console import check_time
from ocp.motion.local.collisions import Collision, find_collisions, prepared_pairs
from ocp.problem.hulls import Frames, frames_of
from ocp.tolerances import CLEARANCE_TOLERANCE_M

Indices = NDArray[np.intp]

__all__ = ["StraightMotionSettings", "StraightMotions"]


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
        difference: Step of finite differences, rad or m: the root of the rounding error of distances, 1e-10 m.
        block: Largest number of pairs of bodies, over all configurations, that are evaluated at once.
    """

    finest: float = 1e-3
    uneven: float = 0.05
    first: float = 0.4
    tolerance: float = CLEARANCE_TOLERANCE_M / 2
    difference: float = 1e-5
    block: int = 1_000_000


class StraightMotions:
    """Collision proofs for straight joint motions of a machine on a fixed base among fixed obstacles.

    Attributes:
        scene: Collision scene; None if nothing can collide.
    """

    def __init__(self, scene: CollisionScene | None, settings: StraightMotionSettings = StraightMotionSettings()):
        self.scene = scene if scene is not None and len(scene.pairs) else None
        self.settings = settings
        if self.scene is not None:
            self._required = self.scene.clearance - settings.tolerance
            self._placements, self._bodies = prepared_pairs(self.scene)
            self._levers, self._turns = self.scene.levers.joints, self.scene.levers.joint_turns

    def collisions(self, joints: Array) -> list[Collision]:
        """Return the pairs closer than the clearance in a configuration (n,), in order of severity."""
        if self.scene is None:
            return []
        collisions = find_collisions(self.scene, np.zeros(0), joints[None], np.zeros(1))
        return [collision for collision in collisions if collision.distance < self._required]

    def near_pairs(self, joints: Array, reach: float) -> tuple[Indices, Indices, Array, Array]:
        """Return the pairs closer than clearance plus `reach`, m, in configurations (M, n).

        Returns:
            Configuration and pair of each, their distance beyond the clearance, m, shape (K,) each, and its gradient,
            shape (K, n).
        """
        n = joints.shape[1]
        if self.scene is None:
            return np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, n))
        near, step = self.scene.clearance + reach, self.settings.difference
        frames = self._frames(joints)
        at, pair = np.nonzero(self._bodies.all_balls(frames) < near)
        gap = self._bodies.gaps(frames, at, pair, near)
        at, pair, gap = at[gap < near], pair[gap < near], gap[gap < near]
        moved = self._frames((joints[:, None] + step * np.eye(n)).reshape(-1, n))
        places = (n * at[:, None] + np.arange(n)).ravel()
        gradient = (self._bodies.gaps(moved, places, np.repeat(pair, n)).reshape(-1, n) - gap[:, None]) / step
        return at, pair, gap - self.scene.clearance, gradient

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
        pieces = np.maximum(np.ceil(approach.max(axis=1) / self.settings.first), 1).astype(int)
        motion = np.repeat(np.arange(len(starts)), pieces)
        number = np.arange(len(motion)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        width, middle = 1 / pieces[motion], (number + 0.5) / pieces[motion]
        order = np.argsort(np.abs(middle - 0.5), kind="stable")  # blocks are then spread over all motions
        blocks = -(-len(order) * len(self._levers) // self.settings.block)
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
        """Bound distances on ever shorter intervals, and unset `clear` for motions that may collide.

        Args:
            lines: Starts and ends of the motions.
            sizes: Approach and turning of each pair over each whole motion.
            clear: Marks of the motions, which are changed.
            intervals: Motion, middle and width of each.
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
            uneven = np.flatnonzero(reach < self.settings.uneven)
            if len(uneven):
                bow = reach[uneven] * (turning[motion[interval], pair] * width[interval])[uneven] / 2
                facing, _, _ = self._bodies.nearest(frames, interval[uneven], pair[uneven])
                places = np.concatenate([middle - width / 2, middle + width / 2])
                frames = self._frames_on(lines, np.tile(motion, 2), places)
                chord = self._bodies.chords(facing, frames, (interval[uneven], interval[uneven] + len(motion)))
                open_ = chord - bow < required
                clear[motion[interval[uneven[open_ & (reach[uneven] < self.settings.finest)]]]] = False
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
        """Return the frames of the bodies on K straight motions, each at a fraction of its length."""
        starts, ends = lines[0][motion], lines[1][motion]
        return self._frames(starts + places[:, None] * (ends - starts))

    def _frames(self, joints: Array) -> Frames:
        """Return the frames of the bodies in configurations (M, n)."""
        base = np.broadcast_to(self.scene.machine.base_home(), (len(joints), 0))  # type: ignore[union-attr]
        return frames_of(self._placements(base, joints, np.zeros((len(joints), 1)))[0])
