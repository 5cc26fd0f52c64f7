"""Bodies as convex hulls of points, and their distances, many pairs at once (Gilbert, Johnson, Keerthi 1988).

Of the hull of all differences of their points the one nearest to the origin is looked for in simplices of at most four
of them; each step adds the one that lies farthest towards the origin. Whatever direction it ends with, the gap along it
is a lower bound of the distance, so that nobody need trust the search.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ocp.errors import ProblemError
from ocp.problem.values import check_finite, table

__all__ = [
    "Covered", "Facing", "Frames", "Hull", "HullPairs", "PairsOfBodies", "frames_of", "gap_along", "grouped",
    "nearest_directions",
]  # fmt: skip

STEPS = 64
CLOSE = 1e-12
"""Relative: the distance is found when the gap along its direction is no less by more."""
FLAT = 1e-14
"""Of the squares of the edges: a triangle or tetrahedron of less content is none."""
FIRSTS, SECONDS = np.array([0, 0, 1]), np.array([1, 2, 2])
"""Of three edges the pairs."""
NEXT, LAST = [1, 2, 0], [2, 0, 1]
SIGNS = np.array([-1.0, 1.0, -1.0])
"""With the normals of pairs (1, 2), (0, 2), (0, 1): of a place among three edges (Cramer)."""


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
    """The pairs whose bodies have about so many points each.

    Attributes:
        has: Whether a pair is of this kind. row: Its place among them. Shape (n,) each.
        radii: Of both together. sizes: Of the balls about the middles of both, together. Shape (K,) each.
        flat: Whether one is a half-space. Shape (K,). normals: Then, from the first to the other. Shape (K, 3).
    """

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, members: list[int], counts: tuple[int, int]) -> None:
        chosen = [[hulls[k] for k in pair[:2]] for pair in pairs[members]]
        self.has = np.zeros(len(pairs), dtype=bool)
        self.has[members] = True
        self.row = np.cumsum(self.has) - 1
        self._cores = [
            np.array([_filled(pair[side].core, count) for pair in chosen]) for side, count in enumerate(counts)
        ]
        self._middles = [np.array([pair[side].middle for pair in chosen]) for side in (0, 1)]
        self._riding = [np.array([pair[side].frame for pair in chosen]) for side in (0, 1)]
        self._seen = pairs[members, 2]
        self.radii = np.array([one.radius + other.radius for one, other in chosen])
        self.sizes = np.array([one.size + other.size for one, other in chosen])
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

    def balls(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> np.ndarray:
        """How far balls about the middles of both bodies, which hold them, are apart. Shape (K,), m."""
        rotations, positions = frames
        one, other = (
            (rotations[at, riding[row]] @ middle[row][:, :, None])[:, :, 0] + positions[at, riding[row]]
            for middle, riding in zip(self._middles, self._riding, strict=True)
        )
        way = other - one
        apart = np.where(self.flat[row], (way * self.normals[row]).sum(axis=1), np.linalg.norm(way, axis=1))
        return np.asarray(apart - self.sizes[row] - self.radii[row])

    def nearest(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where both bodies are nearest, seen from where they are.

        Returns:
            Unit vectors from the first to the other (K, 3), how far they are apart along these (K,), m, and the nearest
            points of what the radii swell (K, 2, 3), m.
        """
        sides = self.points(frames, at, row)
        along, here, there = nearest_directions(*sides)
        along = np.where(self.flat[row, None], self.normals[row], along)
        return along, gap_along(along, *sides) - self.radii[row], np.stack([here, there], axis=1)

    def gaps(self, along: np.ndarray, frames: Frames, at: np.ndarray, row: np.ndarray) -> np.ndarray:
        """How far both bodies are apart along unit vectors (K, 3). Shape (K,), m."""
        return np.asarray(gap_along(along, *self.points(frames, at, row)) - self.radii[row])


class Covered:
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


class Facing(NamedTuple):
    """Along what the rows of K pairs of bodies are nearest, see `Covered.of`.

    Attributes:
        place, row: Shape (R,). along: Unit vectors from the first body to the other, seen from where they are. (R, 3).
    """

    place: np.ndarray
    row: np.ndarray
    along: np.ndarray

    def of(self, some: np.ndarray) -> Facing:
        """Of some pairs alone. Shape (K,), whether."""
        kept = some[self.place]
        return Facing((np.cumsum(some) - 1)[self.place[kept]], self.row[kept], self.along[kept])


class PairsOfBodies:
    """Pairs of bodies, what covers them, and how far they are apart; see `Covered`."""

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, covers: Mapping[int, np.ndarray]) -> None:
        self._covered = Covered(pairs, covers)
        self._kinds = grouped(hulls, self._covered.rows)

    def balls(self, frames: Frames, at: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """How far balls that hold the bodies of pairs are apart at samples. Shape (K,) each, m."""
        found = np.empty(len(pair))
        for kind, chosen, row in self._by_kind(pair):
            found[chosen] = kind.balls(frames, at[chosen], row)
        return found

    def nearest(self, frames: Frames, at: np.ndarray, pair: np.ndarray) -> tuple[Facing, np.ndarray, np.ndarray]:
        """Along what the bodies of pairs are nearest at samples, shape (K,) each, how far they are apart (K,), m, and
        the nearest points of what the radii swell (K, 2, 3), m, seen from where they are."""
        place, rows = self._covered.of(pair)
        along, gap, points = np.empty((len(rows), 3)), np.empty(len(rows)), np.empty((len(rows), 2, 3))
        for kind, chosen, row in self._by_kind(rows):
            along[chosen], gap[chosen], points[chosen] = kind.nearest(frames, at[place[chosen]], row)
        told = self._covered.decisive(place, gap, len(pair))
        return Facing(place, rows, along), gap[told], points[told]

    def chords(self, facing: Facing, frames: Frames, ends: Sequence[np.ndarray]) -> np.ndarray:
        """How far the bodies of pairs are apart along what others told, the less of both ends of a time. Shape (K,), m.

        What says so is one and the same at both: that a pair is apart at one and what covers it at the other says
        nothing of the time between.
        """
        gap = np.empty(len(facing.row))
        for kind, chosen, row in self._by_kind(facing.row):
            along, place = facing.along[chosen], facing.place[chosen]
            gap[chosen] = np.minimum(*(kind.gaps(along, frames, at[place], row) for at in ends))
        return np.asarray(gap[self._covered.decisive(facing.place, gap, len(ends[0]))])

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
        kinds.setdefault((_places(hulls[one]), _places(hulls[other])), []).append(i)
    return [HullPairs(hulls, pairs, members, counts) for counts, members in kinds.items()]


def _places(hull: Hull) -> int:
    """For so many points there is room where hulls of about as many are looked at together."""
    return 1 << max(1, (len(hull.core) - 1).bit_length())


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


def gap_along(direction: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far hulls of points (K, m, 3) and (K, l, 3) are apart along unit vectors (K, 3) from one to other. (K,)."""
    column = direction[:, :, None]
    return np.asarray((other @ column).min(axis=(1, 2)) - (one @ column).max(axis=(1, 2)))


def nearest_directions(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where hulls of points are nearest.

    Args:
        one, other: Their points. Shapes (K, m, 3), (K, l, 3).

    Returns:
        Unit vectors from a nearest point of one to one of the other (K, 3), and these points, (K, 3) each. Of hulls
        that overlap, as far as the search can tell, the vector is that along which they overlap least of the axes
        that were tried, and the points are one inside both.
    """
    lines = one.shape[1] == other.shape[1] == 2
    here, there, found = _between_segments(one, other) if lines else _between_hulls(one, other)
    long = np.linalg.norm(found, axis=1)
    size = np.abs(one).max(initial=0.0) + np.abs(other).max(initial=0.0)
    apart = long > CLOSE * size
    direction = np.where(apart[:, None], found / np.where(apart, long, 1.0)[:, None], 0.0)
    if not apart.all():
        direction[~apart] = _least_overlap(one[~apart], other[~apart])
    return direction, here, there


def _between_segments(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest points of segments (K, 2, 3), and the way from the first to the other (K, 3) each.

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.9.
    """
    u, v, w = one[:, 1] - one[:, 0], other[:, 1] - other[:, 0], one[:, 0] - other[:, 0]
    a, e, b = (u * u).sum(axis=1), (v * v).sum(axis=1), (u * v).sum(axis=1)
    c, f = (u * w).sum(axis=1), (v * w).sum(axis=1)
    short, single = np.where(a > 0, a, 1.0), np.where(e > 0, e, 1.0)
    across = a * e - b * b
    sound = across > FLAT * a * e
    s = np.where(sound, np.clip((b * f - c * e) / np.where(sound, across, 1.0), 0.0, 1.0), 0.0)
    t = np.where(e > 0, np.clip((b * s + f) / single, 0.0, 1.0), 0.0)
    s = np.where(a > 0, np.clip((b * t - c) / short, 0.0, 1.0), 0.0)
    here, there = one[:, 0] + s[:, None] * u, other[:, 0] + t[:, None] * v
    return here, there, there - here


def _between_hulls(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_between_segments` of hulls of points (K, m, 3), (K, l, 3), by the algorithm of Gilbert, Johnson, Keerthi."""
    here, there = one[:, 0].astype(float), other[:, 0].astype(float)
    active = np.arange(len(one))
    a, b = np.repeat(here[:, None], 4, axis=1), np.repeat(there[:, None], 4, axis=1)
    found = there - here
    towards = found.copy()
    for _ in range(STEPS):
        if not active.size:
            break
        rows = np.arange(active.size)
        p, q = one[active], other[active]
        far = p[rows, (p @ towards[:, :, None])[:, :, 0].argmax(axis=1)]
        near = q[rows, (q @ towards[:, :, None])[:, :, 0].argmin(axis=1)]
        square = (towards * towards).sum(axis=1)
        left = (square - (towards * (near - far)).sum(axis=1) > CLOSE * square) & (square > 0)
        if not left.all():
            active, a, b, towards, square = (part[left] for part in (active, a, b, towards, square))
            far, near = far[left], near[left]
            if not active.size:
                break
        # the place of a point without weight, which there is in every simplex but a full one, takes the new one
        a[:, 3], b[:, 3] = far, near
        weights, new = _weights(b - a)
        order = np.argsort(-weights, axis=1, kind="stable")[:, :, None]
        weights = np.take_along_axis(weights[:, :, None], order, axis=1)
        a, b = np.take_along_axis(a, order, axis=1), np.take_along_axis(b, order, axis=1)
        nearer = (new * new).sum(axis=1) < square
        chosen = active[nearer]
        here[chosen], there[chosen] = ((weights * part)[nearer].sum(axis=1) for part in (a, b))
        found[chosen] = new[nearer]
        a, b = (np.where(weights > 0, part, part[:, :1]) for part in (a, b))
        keep = nearer & (weights[:, 3, 0] == 0)
        active, a, b, towards = (part[keep] for part in (active, a, b, new))
    return here, there, found


def _weights(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of four points, which may coincide, the weights whose mean is nearest to the origin, and that mean.

    Shape (K, 4, 3) to (K, 4) and (K, 3). Only simplices with the last point, which was added, are looked at.
    """
    last = w[:, 3]
    edges = w[:, :3] - last[:, None]
    squares = (edges * edges).sum(axis=2)
    shares, valid = np.zeros((len(w), 8, 4)), np.ones((len(w), 8), dtype=bool)
    each = np.arange(3)
    along = -(edges @ last[:, :, None])[:, :, 0] / np.where(squares > 0, squares, 1.0)
    shares[:, 1 + each, each], valid[:, 1:4] = along, (along > 0) & (along < 1)
    u, v = edges[:, FIRSTS], edges[:, SECONDS]
    normals = _cross(u, v)
    sizes = (normals * normals).sum(axis=2)
    sound = sizes > FLAT * squares[:, FIRSTS] * squares[:, SECONDS]
    sizes = np.where(sound, sizes, 1.0)
    across = _cross(normals, last[:, None])  # (v x last) normal = v (last x normal)
    s, t = -(v * across).sum(axis=2) / sizes, (u * across).sum(axis=2) / sizes
    shares[:, 4 + each, FIRSTS], shares[:, 4 + each, SECONDS] = s, t
    valid[:, 4:7] = sound & (s > 0) & (t > 0) & (s + t < 1)
    content = (edges[:, 0] * normals[:, 2]).sum(axis=1)
    full = content**2 > FLAT * squares.prod(axis=1)
    inside = (normals @ last[:, :, None])[:, ::-1, 0] * SIGNS / np.where(full, content, 1.0)[:, None]
    shares[:, 7, :3], valid[:, 7] = inside, full & (inside > 0).all(axis=1) & (inside.sum(axis=1) < 1)
    shares[:, :, 3] = 1 - shares[:, :, :3].sum(axis=2)
    means = shares @ w
    # however near they are, the way to an edge is across it, and that to a triangle its normal
    astray = (means[:, 1:4] * edges).sum(axis=2) / np.where(squares > 0, squares, 1.0)
    means[:, 1:4] -= astray[:, :, None] * edges
    means[:, 4:7] = normals * ((normals * last[:, None]).sum(axis=2) / sizes)[:, :, None]
    lengths = np.where(valid, (means * means).sum(axis=2), np.inf)
    rows, least = np.arange(len(w)), lengths.argmin(axis=1)
    return shares[rows, least], means[rows, least]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Of vectors, their entries last; with less ado than numpy's own."""
    return np.asarray(one[..., NEXT] * other[..., LAST] - one[..., LAST] * other[..., NEXT])


def _least_overlap(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Unit vectors (K, 3) from one to other along which hulls that overlap do so least, of some that are tried.

    The line of the middles, and the normals of edges of both and of their pairs, edges being those from a first point.
    """
    edges = np.concatenate([one[:, 1:4] - one[:, :1], other[:, 1:4] - other[:, :1]], axis=1)
    i, j = np.triu_indices(edges.shape[1], 1)
    middles = (other.mean(axis=1) - one.mean(axis=1))[:, None]
    axes = np.broadcast_to(np.eye(3), (len(one), 3, 3))
    tried = np.concatenate([middles, edges, _cross(edges[:, i], edges[:, j]), axes], axis=1)
    lengths = np.linalg.norm(tried, axis=2, keepdims=True)
    units = np.where(lengths > 0, tried / np.where(lengths > 0, lengths, 1.0), axes[:, :1])
    units = np.concatenate([units, -units], axis=1)
    there, here = units @ np.swapaxes(other, 1, 2), units @ np.swapaxes(one, 1, 2)
    return np.asarray(units[np.arange(len(one)), (there.min(axis=2) - here.max(axis=2)).argmax(axis=1)])
