"""Bodies as convex hulls of points on frames, and how far pairs of them are apart, many at once.

Whatever direction the search of nearest points ends with (:mod:`models.shapes.hull`), the gap along it is a lower
bound of the distance, so that nobody need trust the search.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from models.shapes.hull import gap_along, is_box, nearest_directions
from ocp.errors import ProblemError
from ocp.problem.values import check_finite, table

__all__ = ["BodyPairs", "CoveredPairs", "Frames", "Hull", "HullPairs", "SeparatingDirections", "frames_of", "grouped"]


@dataclass(frozen=True, eq=False)
class Hull:
    """A body: the convex hull of points of a frame, swelled; or all that lies behind a plane.

    Attributes:
        frame: Index of the frame that it rides on; -1: the world.
        core: Points, in that frame. Shape (m, 3), m.
        radius: m.
        normal: Of a half-space, out of it, a unit vector of that frame; its core is one point of its plane. Shape (3,),
            or (0,) of a body.

    Raises:
        ProblemError: Other shapes, what is not finite, a negative radius, a normal that is no unit vector.
    """

    frame: int
    core: np.ndarray
    radius: float = 0.0
    normal: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        core, normal = table("hull: core", self.core), table("hull: normal", self.normal)
        if core.ndim != 2 or core.shape[0] < 1 or core.shape[1] != 3:
            raise ProblemError(f"hull: core has shape {core.shape}, expected (m, 3)", name="core", value=core.shape)
        check_finite("hull: core", core)
        if not (np.isfinite(self.radius) and self.radius >= 0):
            raise ProblemError(f"hull: radius {self.radius!r} m is no radius", name="radius", value=self.radius)
        if normal.size and (normal.shape != (3,) or not abs(np.linalg.norm(normal) - 1) < 1e-9):
            words = f"hull: normal {normal.tolist()} is no unit vector of three entries"
            raise ProblemError(words, name="normal", value=normal.tolist())
        object.__setattr__(self, "frame", int(self.frame))
        object.__setattr__(self, "radius", float(self.radius))
        object.__setattr__(self, "core", core)
        object.__setattr__(self, "normal", normal)

    @cached_property
    def middle(self) -> np.ndarray:
        """Of its points. Shape (3,), m."""
        return np.asarray(self.core.mean(axis=0))

    @cached_property
    def kind(self) -> int:
        """Hulls of one kind are measured side by side: boxes, 0, and others by so many points as there is room for."""
        return 0 if is_box(self.core) else 1 << max(1, (len(self.core) - 1).bit_length())

    @cached_property
    def size(self) -> float:
        """Radius of the ball about the middle of its points that holds them, m."""
        return float(np.linalg.norm(self.core - self.middle, axis=1).max())


class Frames(NamedTuple):
    """Placements in world at M samples, the world itself the last.

    Attributes:
        rotations: Shape (M, F + 1, 3, 3). positions: Shape (M, F + 1, 3), m.
    """

    rotations: np.ndarray
    positions: np.ndarray


class HullPairs:
    """The pairs whose bodies are of two kinds, see `Hull.kind`.

    Attributes:
        has: Whether a pair is of this kind. row: Its place among them. Shape (n,) each.
        radii: Of both together. Shape (K,).
        flat: Whether one is a half-space. Shape (K,). normals: Then, from the first to the other. Shape (K, 3).
    """

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, members: list[int], kinds: tuple[int, int]) -> None:
        chosen = [[hulls[k] for k in pair[:2]] for pair in pairs[members]]
        self.has = np.zeros(len(pairs), dtype=bool)
        self.has[members] = True
        self.row = np.cumsum(self.has) - 1
        self._cores = [
            np.array([_filled(pair[side].core, kind or 8) for pair in chosen]) for side, kind in enumerate(kinds)
        ]
        self._boxes = kinds[0] == 0, kinds[1] == 0
        self._riding = [np.array([pair[side].frame for pair in chosen]) for side in (0, 1)]
        self._seen = pairs[members, 2]
        self.radii = np.array([one.radius + other.radius for one, other in chosen])
        self.flat = np.array([bool(one.normal.size or other.normal.size) for one, other in chosen])
        self.normals = np.array([_normal(*pair) for pair in chosen])

    def points(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> list[np.ndarray]:
        """Points of both bodies, from where they are seen. Shapes (K, m, 3), (K, l, 3)."""
        rotations, positions = frames
        turn, origin = rotations[at, self._seen[row]], positions[at, self._seen[row]]
        found = []
        for core, riding in zip(self._cores, self._riding, strict=True):
            relative = np.swapaxes(rotations[at, riding[row]], 1, 2) @ turn
            shift = (positions[at, riding[row]] - origin)[:, None] @ turn
            found.append(core[row] @ relative + shift)
        return found

    def nearest(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where both bodies are nearest, seen from where they are.

        Returns:
            Unit vectors from the first to the other (K, 3), how far they are apart along these (K,), m, and the nearest
            points of what the radii swell (K, 2, 3), m.
        """
        one, other = self.points(frames, at, row)
        along, here, there = nearest_directions(one, other, self._boxes)
        along = np.where(self.flat[row, None], self.normals[row], along)
        return along, gap_along(along, one, other) - self.radii[row], np.stack([here, there], axis=1)

    def gaps(self, along: np.ndarray, frames: Frames, at: np.ndarray, row: np.ndarray) -> np.ndarray:
        """How far both bodies are apart along unit vectors (K, 3). Shape (K,), m."""
        return np.asarray(gap_along(along, *self.points(frames, at, row)) - self.radii[row])


class CoveredPairs:
    """Pairs of bodies, and those that cover some of them.

    What covers a pair holds its two bodies between them: both say from below how far it is apart, so that it is as far
    apart as the pair itself says, or as the nearest of what covers it, whichever is farther. A hull fills what is
    hollow; covers of its parts do not, and stand out.

    Attributes:
        rows: The n pairs, below them what covers them, each seen from where its pair is. Shape (n + m, 3).
    """

    def __init__(self, pairs: np.ndarray, covers: Mapping[int, np.ndarray]) -> None:
        below = [np.column_stack([both, np.full(len(both), pairs[pair, 2])]) for pair, both in covers.items()]
        self.rows = np.concatenate([pairs, *below]).astype(int)
        self._counts, self._first = np.zeros(len(pairs), dtype=int), np.zeros(len(pairs), dtype=int)
        for pair, both in covers.items():
            self._first[pair] = len(pairs) + self._counts.sum()
            self._counts[pair] = len(both)

    def of(self, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The rows of pairs (K,), these first, and to which of the K each belongs: places, rows. Shape (R,) each."""
        many = self._counts[pair]
        place = np.repeat(np.arange(len(pair)), many)
        own = np.arange(len(place)) - (np.cumsum(many) - many)[place]
        return np.concatenate([np.arange(len(pair)), place]), np.concatenate([pair, self._first[pair][place] + own])

    @staticmethod
    def decisive(place: np.ndarray, gap: np.ndarray, count: int) -> np.ndarray:
        """Which of R rows says how far each of K pairs is apart. Shape (K,).

        Args:
            place: As of `of`. gap: How far each row is apart. Shape (R,), m. count: K.
        """
        found = np.arange(count)
        order = count + np.lexsort((gap[count:], place[count:]))
        nearest = order[np.unique(place[order], return_index=True)[1]]
        farther = nearest[gap[nearest] > gap[place[nearest]]]
        found[place[farther]] = farther
        return found


class SeparatingDirections(NamedTuple):
    """Along what the rows of K pairs of bodies are nearest, see `CoveredPairs.of`.

    Attributes:
        place, row: Shape (R,). along: Unit vectors from the first body to the other, seen from where they are. (R, 3).
    """

    place: np.ndarray
    row: np.ndarray
    along: np.ndarray

    def of(self, some: np.ndarray) -> SeparatingDirections:
        """Of some pairs alone. Shape (K,), whether."""
        kept = some[self.place]
        return SeparatingDirections((np.cumsum(some) - 1)[self.place[kept]], self.row[kept], self.along[kept])


class BodyPairs:
    """Pairs of bodies, what covers them, and how far they are apart; see `CoveredPairs`."""

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, covers: Mapping[int, np.ndarray]) -> None:
        self._covered = CoveredPairs(pairs, covers)
        self._kinds = grouped(hulls, self._covered.rows)
        self._one, self._other = pairs[:, 0], pairs[:, 1]
        self._riding = np.array([hull.frame for hull in hulls], dtype=int)
        self._middles = np.array([hull.middle for hull in hulls]).reshape(-1, 3)
        sizes = np.array([hull.size + hull.radius for hull in hulls])
        self._reach = sizes[self._one] + sizes[self._other]
        both = [(hulls[one], hulls[other]) for one, other in pairs[:, :2]]
        self._flat = np.array([bool(one.normal.size or other.normal.size) for one, other in both], dtype=bool)
        self._normals = np.array([_normal(*pair) for pair in both]).reshape(-1, 3)

    def balls(self, frames: Frames, at: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """How far balls that hold the bodies of pairs are apart at samples. Shape (K,) each, m."""
        one, other = (self._placed(frames, at, self._middles[k], self._riding[k]) for k in self._both(pair))
        return self._apart(other - one, pair)

    def distances(self, frames: Frames, near: float = np.inf) -> np.ndarray:
        """Distances of all pairs at all samples, shape (M, n), m; of those that are no nearer than `near` some number
        that is no less, and no more than they are."""
        at, pair = np.arange(len(frames.positions))[:, None], np.arange(len(self._one))
        middles = self._placed(frames, at, self._middles, self._riding)
        apart = self._apart(middles[:, self._other] - middles[:, self._one], pair)
        at, pair = np.nonzero(~(apart >= near))
        place, row = self._covered.of(pair)
        gap, count = np.full(len(row), -np.inf), len(pair)

        def measure(some: np.ndarray) -> None:
            for kind, chosen, own in self._by_kind(row[some]):
                gap[some[chosen]] = kind.nearest(frames, at[place[some[chosen]]], own)[1]

        measure(np.arange(count, len(row)))
        covered = gap[self._covered.decisive(place, gap, count)]
        measure(np.flatnonzero(~(covered >= near)))  # hulls are costly, and need not be measured where covers are apart
        apart[at, pair] = gap[self._covered.decisive(place, gap, count)]
        return np.where(np.isfinite(apart), apart, -np.inf)

    def nearest(
        self, frames: Frames, at: np.ndarray, pair: np.ndarray
    ) -> tuple[SeparatingDirections, np.ndarray, np.ndarray]:
        """Along what the bodies of pairs are nearest at samples, shape (K,) each, how far they are apart (K,), m, and
        the nearest points of what the radii swell (K, 2, 3), m, seen from where they are."""
        place, rows = self._covered.of(pair)
        along, gap, points = np.empty((len(rows), 3)), np.empty(len(rows)), np.empty((len(rows), 2, 3))
        for kind, chosen, row in self._by_kind(rows):
            along[chosen], gap[chosen], points[chosen] = kind.nearest(frames, at[place[chosen]], row)
        told = self._covered.decisive(place, gap, len(pair))
        return SeparatingDirections(place, rows, along), gap[told], points[told]

    def chords(self, facing: SeparatingDirections, frames: Frames, ends: Sequence[np.ndarray]) -> np.ndarray:
        """How far the bodies of pairs are apart along what others told, the less of both ends of a time. Shape (K,), m.

        What says so is one and the same at both: that a pair is apart at one and what covers it at the other says
        nothing of the time between.
        """
        gap = np.empty(len(facing.row))
        for kind, chosen, row in self._by_kind(facing.row):
            along, place = facing.along[chosen], facing.place[chosen]
            gap[chosen] = np.minimum(*(kind.gaps(along, frames, at[place], row) for at in ends))
        return np.asarray(gap[self._covered.decisive(facing.place, gap, len(ends[0]))])

    def _both(self, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._one[pair], self._other[pair]

    @staticmethod
    def _placed(frames: Frames, at: np.ndarray, points: np.ndarray, riding: np.ndarray) -> np.ndarray:
        """Points that ride on frames, at samples, in world."""
        return np.asarray((frames.rotations[at, riding] @ points[..., None])[..., 0] + frames.positions[at, riding])

    def _apart(self, way: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """How far balls are apart whose middles are so far from each other."""
        apart = np.where(self._flat[pair], (way * self._normals[pair]).sum(axis=-1), np.linalg.norm(way, axis=-1))
        return np.asarray(apart - self._reach[pair])

    def _by_kind(self, rows: np.ndarray) -> Iterator[tuple[HullPairs, np.ndarray, np.ndarray]]:
        """Of each kind which of the rows are of it, and their places among its own."""
        for kind in self._kinds:
            chosen = np.flatnonzero(kind.has[rows])
            if chosen.size:
                yield kind, chosen, kind.row[rows[chosen]]


def grouped(hulls: Sequence[Hull], pairs: np.ndarray) -> list[HullPairs]:
    """Pairs of hulls and the frame that they are seen from, (n, 3), -1 for the world, by their numbers of points."""
    kinds: dict[tuple[int, int], list[int]] = {}
    for i, (one, other, _) in enumerate(pairs):
        kinds.setdefault((hulls[one].kind, hulls[other].kind), []).append(i)
    return [HullPairs(hulls, pairs, members, both) for both, members in kinds.items()]


def _filled(core: np.ndarray, count: int) -> np.ndarray:
    """Points, the last of them again and again until they are so many."""
    return np.concatenate([core, np.repeat(core[-1:], count - len(core), axis=0)])


def frames_of(placements: np.ndarray) -> Frames:
    """Frames whose rotations, column by column, and positions stand side by side, (M, 12 F); the world comes last."""
    count = len(placements)
    world = np.broadcast_to(np.vstack([np.eye(3), np.zeros(3)]), (count, 1, 4, 3))
    values = np.concatenate([placements.reshape(count, placements.shape[1] // 12, 4, 3), world], axis=1)
    return Frames(np.swapaxes(values[:, :, :3], 2, 3), values[:, :, 3])


def _normal(one: Hull, other: Hull) -> np.ndarray:
    """From a half-space out of it, or into it, whichever leads from the first body to the other."""
    return one.normal if one.normal.size else -other.normal if other.normal.size else np.zeros(3)
