"""Bodies as convex hulls of points, and their distances, many pairs at once (Gilbert, Johnson, Keerthi 1988).

Of the hull of all differences of their points the one nearest to the origin is looked for in simplices of at most four
of them; each step adds the one that lies farthest towards the origin. Whatever direction it ends with, the gap along it
is a lower bound of the distance, so that nobody need trust the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ocp.errors import ProblemError
from ocp.problem.values import check_finite, table

__all__ = ["Frames", "Hull", "HullPairs", "frames_of", "gap_along", "grouped", "nearest_directions"]

STEPS = 64
CLOSE = 1e-12
"""Relative: the distance is found when the gap along its direction is no less by more."""
FLAT = 1e-14
"""Of the squares of the edges: a triangle or tetrahedron of less content is none."""
EDGES = tuple(combinations(range(4), 2))
FACES = tuple(combinations(range(4), 3))


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


class Frames(NamedTuple):
    """Placements in world at M samples, the world itself the last.

    Attributes:
        rotations: Shape (M, F + 1, 3, 3). positions: Shape (M, F + 1, 3), m.
    """

    rotations: np.ndarray
    positions: np.ndarray


class HullPairs:
    """The pairs whose bodies have so many points each.

    Attributes:
        has: Whether a pair is of this kind. row: Its place among them. Shape (n,) each.
        radii: Of both together. sizes: Of the balls about the middles of both, together. Shape (K,) each.
        flat: Whether one is a half-space. Shape (K,). normals: Then, from the first to the other. Shape (K, 3).
    """

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, members: list[int]) -> None:
        chosen = [[hulls[k] for k in pair[:2]] for pair in pairs[members]]
        self.has = np.zeros(len(pairs), dtype=bool)
        self.has[members] = True
        self.row = np.cumsum(self.has) - 1
        self.cores = [np.array([pair[side].core for pair in chosen]) for side in (0, 1)]
        self.riding = [np.array([pair[side].frame for pair in chosen]) for side in (0, 1)]
        self.seen = pairs[members, 2]
        self.radii = np.array([one.radius + other.radius for one, other in chosen])
        self.sizes = np.array([_size(one) + _size(other) for one, other in chosen])
        self.flat = np.array([bool(one.normal.size or other.normal.size) for one, other in chosen])
        self.normals = np.array([_normal(*pair) for pair in chosen])

    def points(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> list[np.ndarray]:
        """Points of both bodies, from where they are seen. Shapes (K, m, 3), (K, l, 3)."""
        rotations, positions = frames
        turn, origin = rotations[at, self.seen[row]], positions[at, self.seen[row]]
        found = []
        for core, riding in zip(self.cores, self.riding, strict=True):
            shift = positions[at, riding[row]] - origin
            world = np.einsum("kij,kmj->kmi", rotations[at, riding[row]], core[row]) + shift[:, None]
            found.append(np.einsum("kji,kmj->kmi", turn, world))
        return found


def grouped(hulls: Sequence[Hull], pairs: np.ndarray) -> list[HullPairs]:
    """Pairs of hulls and the frame that they are seen from, (n, 3), -1 for the world, by their numbers of points."""
    sizes: dict[tuple[int, ...], list[int]] = {}
    for i, pair in enumerate(pairs):
        sizes.setdefault(tuple(len(hulls[k].core) for k in pair[:2]), []).append(i)
    return [HullPairs(hulls, pairs, members) for members in sizes.values()]


def frames_of(placements: np.ndarray) -> Frames:
    """Frames whose rotations, column by column, and positions stand side by side, (M, 12 F); the world comes last."""
    count = len(placements)
    world = np.broadcast_to(np.vstack([np.eye(3), np.zeros(3)]), (count, 1, 4, 3))
    values = np.concatenate([placements.reshape(count, placements.shape[1] // 12, 4, 3), world], axis=1)
    return Frames(np.swapaxes(values[:, :, :3], 2, 3), values[:, :, 3])


def _size(hull: Hull) -> float:
    """Radius of the ball about the middle of its points that holds them."""
    return float(np.linalg.norm(hull.core - hull.core.mean(axis=0), axis=1).max())


def _normal(one: Hull, other: Hull) -> np.ndarray:
    """From a half-space out of it, or into it, whichever leads from the first body to the other."""
    return one.normal if one.normal.size else -other.normal if other.normal.size else np.zeros(3)


def gap_along(direction: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far hulls of points (K, m, 3) and (K, l, 3) are apart along unit vectors (K, 3) from one to other. (K,)."""
    near = np.einsum("kx,klx->kl", direction, other).min(axis=1)
    return np.asarray(near - np.einsum("kx,kmx->km", direction, one).max(axis=1))


def nearest_directions(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where hulls of points are nearest.

    Args:
        one, other: Their points. Shapes (K, m, 3), (K, l, 3).

    Returns:
        Unit vectors from a nearest point of one to one of the other (K, 3), and these points, (K, 3) each. Of hulls
        that overlap, as far as the search can tell, the vector is that along which they overlap least of the axes
        that were tried, and the points are one inside both.
    """
    count = len(one)
    here, there = one[:, 0].astype(float), other[:, 0].astype(float)
    active = np.arange(count)
    a = np.repeat(one[:, :1], 4, axis=1)
    b = np.repeat(other[:, :1], 4, axis=1)
    towards = b[:, 0] - a[:, 0]
    for _ in range(STEPS):
        if not active.size:
            break
        rows = np.arange(active.size)
        p, q = one[active], other[active]
        far = p[rows, np.einsum("kx,kmx->km", towards, p).argmax(axis=1)]
        near = q[rows, np.einsum("kx,klx->kl", towards, q).argmin(axis=1)]
        square = np.einsum("kx,kx->k", towards, towards)
        ended = (square - np.einsum("kx,kx->k", towards, near - far) <= CLOSE * square) | (square == 0)
        if ended.any():
            keep = ~ended
            active, p, q, far, near, a, b, towards = (part[keep] for part in (active, p, q, far, near, a, b, towards))
            if not active.size:
                break
        # the place of a point without weight, which there is in every simplex but a full one, takes the new one
        a[:, 3], b[:, 3] = far, near
        weights = _weights(b - a)
        order = np.argsort(-weights, axis=1, kind="stable")
        weights = np.take_along_axis(weights, order, axis=1)
        a, b = (np.take_along_axis(part, order[:, :, None], axis=1) for part in (a, b))
        unused = weights <= 0
        a, b = (np.where(unused[:, :, None], part[:, :1], part) for part in (a, b))
        new = np.einsum("kj,kjx->kx", weights, b - a)
        nearer = np.einsum("kx,kx->k", new, new) < np.einsum("kx,kx->k", towards, towards)
        here[active], there[active] = (np.einsum("kj,kjx->kx", weights, part) for part in (a, b))
        keep = nearer & (weights[:, 3] == 0)
        active, a, b, towards = (part[keep] for part in (active, a, b, new))
    found = there - here
    long = np.linalg.norm(found, axis=1)
    size = np.abs(one).max(initial=0.0) + np.abs(other).max(initial=0.0)
    apart = long > CLOSE * size
    direction = np.where(apart[:, None], found / np.where(apart, long, 1.0)[:, None], 0.0)
    if not apart.all():
        direction[~apart] = _least_overlap(one[~apart], other[~apart])
    return direction, here, there


def _weights(w: np.ndarray) -> np.ndarray:
    """Of four points (K, 4, 3), which may coincide, the weights whose mean is nearest to the origin. Shape (K, 4)."""
    count = len(w)
    rows = np.arange(count)
    square = np.einsum("kjx,kjx->kj", w, w)
    best = square.argmin(axis=1)
    least, weights = square[rows, best], np.zeros((count, 4))
    weights[rows, best] = 1.0

    def offer(columns: tuple[int, ...], shares: np.ndarray, valid: np.ndarray) -> None:
        point = np.einsum("kj,kjx->kx", shares, w[:, columns])
        length = np.einsum("kx,kx->k", point, point)
        better = valid & (length < least)
        least[better] = length[better]
        weights[better] = 0.0
        weights[np.ix_(better, columns)] = shares[better]

    for i, j in EDGES:
        edge = w[:, j] - w[:, i]
        size = np.einsum("kx,kx->k", edge, edge)
        s = -np.einsum("kx,kx->k", w[:, i], edge) / np.where(size > 0, size, 1.0)
        offer((i, j), np.stack([1 - s, s], axis=1), (size > 0) & (s > 0) & (s < 1))
    for i, j, k in FACES:
        u, v = w[:, j] - w[:, i], w[:, k] - w[:, i]
        normal = np.cross(u, v)
        size = np.einsum("kx,kx->k", normal, normal)
        sound = size > FLAT * np.einsum("kx,kx->k", u, u) * np.einsum("kx,kx->k", v, v)
        size = np.where(sound, size, 1.0)
        s = np.einsum("kx,kx->k", np.cross(v, w[:, i]), normal) / size
        t = np.einsum("kx,kx->k", np.cross(w[:, i], u), normal) / size
        offer((i, j, k), np.stack([1 - s - t, s, t], axis=1), sound & (s > 0) & (t > 0) & (s + t < 1))
    edges = w[:, 1:] - w[:, :1]
    content = np.linalg.det(edges)
    sound = content**2 > FLAT * np.einsum("kjx,kjx->kj", edges, edges).prod(axis=1)
    if sound.any():
        solved = np.zeros((count, 3))
        solved[sound] = np.linalg.solve(np.swapaxes(edges[sound], 1, 2), -w[sound, 0][:, :, None])[:, :, 0]
        shares = np.concatenate([1 - solved.sum(axis=1, keepdims=True), solved], axis=1)
        offer((0, 1, 2, 3), shares, sound & (shares > 0).all(axis=1))
    return weights


def _least_overlap(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Unit vectors (K, 3) from one to other along which hulls that overlap do so least, of some that are tried.

    The line of the middles, and the normals of edges of both and of their pairs, edges being those from a first point.
    """
    found = []
    for p, q in zip(one, other, strict=True):
        edges = [*(p[1:4] - p[0]), *(q[1:4] - q[0])]
        tried = [
            q.mean(axis=0) - p.mean(axis=0),
            *edges,
            *(np.cross(u, v) for u, v in combinations(edges, 2)),
            *np.eye(3),
        ]
        units = np.array([v / n for v in tried if (n := np.linalg.norm(v)) > 0])
        units = np.concatenate([units, -units])
        gaps = (q @ units.T).min(axis=0) - (p @ units.T).max(axis=0)
        found.append(units[gaps.argmax()])
    return np.array(found)
