"""Convex hull of points in space: its vertices, its triangles, the planes of its faces."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array, frozen
from models.cache import keep, kept, key_of, version_of
from models.errors import ModelError

FLAT = 1e-10
"""Share of the size of all points: thinner is flat, and what stands out less counts as inside."""
SAME_PLANE = 1e-9
"""Normals of faces that differ by less are one."""
TRIES = 6


@dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of points.

    Attributes:
        vertices: Its corners. Shape (m, 3), m.
        faces: Triangles of corners, counter-clockwise from outside. Shape (k, 3).
        normals: Unit normals of its faces, outwards, each once. Shape (f, 3).
        offsets: The hull are the x with normals x <= offsets. Shape (f,), m.
    """

    vertices: Array
    faces: NDArray[np.intp]
    normals: Array
    offsets: Array


def convex_hull(points: Array) -> Hull:
    """The convex hull of points, by the farthest point of a face first (Barber, Dobkin & Huhdanpaa 1996).

    A point that stands out by less than FLAT of the size of all may be left out. Where rounding spoils the faces of
    points that nearly lie in a plane, the points are shaken by a few times that and all is done again.

    Args:
        points: Shape (n, 3), m.

    Raises:
        ModelError: Points in a plane, on a line, at one place.
    """
    unique = np.unique(points, axis=0)
    middle = (unique.min(axis=0) + unique.max(axis=0)) / 2
    centred = unique - middle
    size = float(np.abs(centred).max())
    rng = np.random.default_rng(0)
    for attempt in range(TRIES):
        tolerance = FLAT * size * 4**attempt
        shaken = centred + (rng.uniform(-tolerance, tolerance, centred.shape) if attempt else 0.0)
        triangles = _triangles(shaken, tolerance)
        corners, faces = np.unique(triangles, return_inverse=True)
        vertices, faces = centred[corners], faces.reshape(triangles.shape)
        normals = _distinct(_normals(vertices, faces))
        offsets = (vertices @ normals.T).max(axis=0)
        if (_normals(shaken[corners], faces) @ shaken.T <= _heights(shaken[corners], faces) + 8 * tolerance).all():
            break
    offsets = (centred @ normals.T).max(axis=0)  # of all points: nothing stands out, whatever rounding did
    return Hull(frozen(vertices + middle), faces, frozen(normals), frozen(offsets + normals @ middle))


def kept_hull(points: Array) -> Hull:
    """The convex hull of points, sought once and kept in a file by their content, see `models.cache`.

    Args, Raises: As `convex_hull`.
    """
    key = key_of(version_of(__name__), "hull", points)
    known = _read(kept(key), points)
    if known is None:
        known = convex_hull(points)
        parts = known.vertices, known.faces, known.normals, known.offsets
        keep(key, [part.tolist() for part in parts])
    return known


def _read(value: Any, points: Array) -> Hull | None:
    """A hull as it was kept; None where it is something else, or does not hold the points."""
    try:
        vertices, faces, normals, offsets = (np.array(part) for part in value)
        found = Hull(frozen(vertices), faces.astype(np.intp), frozen(normals), frozen(offsets))
        slack = SAME_PLANE * float(np.abs(points).max())
        farthest = [(each @ normals.T).max(axis=0) for each in (points, vertices)]
        sound = vertices[faces].shape == (len(faces), 3, 3)
        return found if sound and np.abs(np.array(farthest) - offsets).max() <= slack else None
    except (TypeError, ValueError, IndexError):
        return None


def _normals(vertices: Array, faces: NDArray[np.intp]) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return np.asarray(cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300))


def _heights(vertices: Array, faces: NDArray[np.intp]) -> Array:
    """Of the planes of triangles above the origin, as a column."""
    return np.asarray((_normals(vertices, faces) * vertices[faces[:, 0]]).sum(axis=1)[:, None])


def _distinct(normals: Array) -> Array:
    """Each direction once, as it comes first."""
    kept: list[Array] = []
    for normal in normals:
        if normal.any() and (not kept or (np.abs(np.array(kept) - normal).max(axis=1) > SAME_PLANE).all()):
            kept.append(normal)
    return np.array(kept)


def _first_four(points: Array, tolerance: float) -> list[int]:
    """Corners of a tetrahedron of points that are far from each other."""
    low, high = (int(k) for k in _farthest_pair(points))
    along = (points[high] - points[low]) / max(float(np.linalg.norm(points[high] - points[low])), 1e-300)
    across = points - points[low]
    across = across - np.outer(across @ along, along)
    side = int(np.linalg.norm(across, axis=1).argmax())
    normal = np.cross(along, across[side])
    width = float(np.linalg.norm(normal))
    heights = (points - points[low]) @ normal / max(width, 1e-300)
    top = int(np.abs(heights).argmax())
    if width <= tolerance or abs(heights[top]) <= tolerance:
        message = "mesh: its vertices lie in a plane; it has no volume. Give a Box as thick as it is"
        raise ModelError(message, name="vertices", value=len(points), limit=tolerance)
    return [low, high, side, top] if heights[top] < 0 else [high, low, side, top]


def _farthest_pair(points: Array) -> tuple[int, int]:
    axis = int(np.ptp(points, axis=0).argmax())
    return int(points[:, axis].argmin()), int(points[:, axis].argmax())


def _triangles(points: Array, tolerance: float) -> NDArray[np.intp]:
    """Triangles of the hull of points as indices. Shape (k, 3)."""
    a, b, c, d = _first_four(points, tolerance)
    growing = _Growing(points, tolerance)
    everything = np.arange(len(points))
    growing.close([(a, b, c), (a, d, b), (b, d, c), (c, d, a)], everything)
    while growing.waiting:
        growing.take(next(iter(growing.waiting)))
    return np.array(list(growing.corners.values()), dtype=np.intp)


class _Growing:
    """A hull as it grows: triangles by number, who lies across each edge, the points outside of each triangle."""

    def __init__(self, points: Array, tolerance: float) -> None:
        self.points, self.tolerance, self.numbers = points, tolerance, count()
        self.corners: dict[int, tuple[int, int, int]] = {}
        self.planes: dict[int, tuple[Array, float]] = {}
        self.owner: dict[tuple[int, int], int] = {}
        self.waiting: dict[int, NDArray[np.intp]] = {}

    def close(self, triangles: list[tuple[int, int, int]], loose: NDArray[np.intp]) -> None:
        """Add triangles; each of the loose points waits at the one that it is highest above."""
        corners = np.array(triangles)
        origin = self.points[corners[:, 0]]
        normals = np.cross(self.points[corners[:, 1]] - origin, self.points[corners[:, 2]] - origin)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        levels = (normals * origin).sum(axis=1)
        above = self.points[loose] @ normals.T - levels
        best = above.argmax(axis=1)
        outside = above.max(axis=1) > self.tolerance
        for k, (a, b, c) in enumerate(triangles):
            number = next(self.numbers)
            self.corners[number], self.planes[number] = (a, b, c), (normals[k], float(levels[k]))
            self.owner |= {(a, b): number, (b, c): number, (c, a): number}
            mine = loose[outside & (best == k)]
            if len(mine):
                self.waiting[number] = mine

    def take(self, start: int) -> None:
        """Put the farthest point above a triangle on the hull, in place of all triangles that it sees."""
        mine = self.waiting[start]
        normal, level = self.planes[start]
        apex = int(mine[(self.points[mine] @ normal).argmax()])
        seen, edges, stack = {start}, [], [start]
        while stack:
            a, b, c = self.corners[stack.pop()]
            for edge in ((a, b), (b, c), (c, a)):
                other = self.owner.get((edge[1], edge[0]), start)
                if other in seen:
                    continue
                normal, level = self.planes[other]
                if self.points[apex] @ normal - level > -self.tolerance:  # one in its plane is merged
                    seen.add(other)
                    stack.append(other)
        for number in seen:
            a, b, c = self.corners[number]
            edges += [e for e in ((a, b), (b, c), (c, a)) if self.owner.get((e[1], e[0]), start) not in seen]
        loose = [self.waiting.pop(number) for number in seen if number in self.waiting]
        for number in seen:
            a, b, c = self.corners.pop(number)
            del self.planes[number]
            for edge in ((a, b), (b, c), (c, a)):
                self.owner.pop(edge, None)
        left = np.concatenate(loose)
        self.close([(*edge, apex) for edge in edges], left[left != apex])
