"""Convex hull of points in space: its vertices, its triangles, the planes of its faces.

Nearest points of convex hulls of a few points, many pairs at once: the numeric measure of distance.

Two segments, and a segment and a box, have closed forms; for other hulls the one point of the hull of all
differences that is nearest to the origin is looked for in simplices of at most four of them, each step adding the one
that lies farthest towards the origin (Gilbert, Johnson, Keerthi 1988). Whatever direction a pair ends with, the gap
along it (`gap_along`) is a lower bound of the distance, so that nobody need trust the search.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from threading import Thread

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from models.arrays import ROUNDING, Array, frozen
from models.errors import ModelError

__all__ = ["gap_along", "is_box", "nearest_directions"]


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
    """Return the convex hull of points, by qhull (Barber, Dobkin & Huhdanpaa 1996).

    Qhull takes seconds for some hundred thousand corners and hears nothing meanwhile. It works in a thread of its own,
    so that Ctrl-C ends the wait for it at once.

    Args:
        points: Shape (n, 3), m.

    Raises:
        ModelError: Points in a plane, on a line, at one place.
    """
    hull: Future[Hull] = Future()

    def compute() -> None:
        try:
            hull.set_result(_convex_hull(points))
        except Exception as error:
            hull.set_exception(error)

    Thread(target=compute, daemon=True).start()
    return hull.result()


def _convex_hull(points: Array) -> Hull:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    size = float(np.abs(points - middle).max()) or 1.0
    centred = (points - middle) / size
    few = centred[:: 1 + len(centred) // 1000]  # they tell the plane that all may lie in
    flat = 1e-10
    across = np.linalg.svd(few - few.mean(axis=0), full_matrices=False)[2][-1]
    try:
        if len(points) < 4 or np.ptp(centred @ across) <= flat:
            raise QhullError
        found = ConvexHull(centred, qhull_options="Qt")
    except QhullError as error:
        message = "mesh: its vertices lie in a plane; it has no volume. Give a Box as thick as it is"
        raise ModelError(message, name="vertices", value=len(points), limit=flat * size) from error
    corners, faces = np.unique(found.simplices, return_inverse=True)
    faces = faces.reshape(found.simplices.shape)
    a, b, c = (centred[corners][faces[:, k]] for k in range(3))
    outwards = found.equations[:, :3]
    inwards = (np.cross(b - a, c - a) * outwards).sum(axis=1) < 0
    faces[inwards] = faces[inwards][:, [0, 2, 1]]
    # a closed surface is convex where it is so across each edge (Tietze, Nakajima): its neighbours' corners decide
    around = centred[corners][faces[found.neighbors].reshape(len(faces), -1)]
    heights = np.einsum("fkj,fj->fk", around, outwards).max(axis=1)
    first, same = _distinct(outwards)
    offsets = np.full(len(first), -np.inf)
    np.maximum.at(offsets, same, heights)
    normals = outwards[first]
    offsets = size * (offsets + 1e-12) + normals @ middle  # out by more than qhull leaves points outside
    return Hull(frozen(points[corners]), faces, frozen(normals), frozen(offsets))


def _distinct(normals: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Each direction once, by where it comes first, and which of these each of them is. Shapes (f,), (k,)."""
    near = cKDTree(normals).query_pairs(ROUNDING, p=np.inf, output_type="ndarray")
    links = coo_array((np.ones(len(near)), near.T), shape=(len(normals), len(normals)))
    _, same = connected_components(links, directed=False)
    first = np.unique(same, return_index=True)[1]
    order = np.argsort(np.argsort(first))
    return np.sort(first), order[same]


CLOSE = 1e-12
"""Relative: the distance is found when the gap along its direction is no less by more."""
FLAT = 1e-14
"""Of the squares of the edges: a triangle or tetrahedron of less content is none."""
FIRSTS, SECONDS = np.triu_indices(3, 1)
"""Of three edges the pairs."""


def gap_along(direction: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far hulls of points (K, m, 3) and (K, l, 3) are apart along unit vectors (K, 3) from one to other. (K,)."""
    column = direction[:, :, None]
    return np.asarray((other @ column).min(axis=(1, 2)) - (one @ column).max(axis=(1, 2)))


def is_box(points: np.ndarray) -> bool:
    """Whether points (m, 3) are the 8 corners of a box, the third edge from one to the next, then the second."""
    if len(points) != 8:
        return False
    edges = points[[4, 2, 1]] - points[0]
    squares = edges @ edges.T
    corners = points[0] + np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)]) @ edges
    size = float(squares.max())
    right = np.abs(squares - np.diag(squares.diagonal())).max() <= CLOSE * size
    return bool(right and (squares.diagonal() > 0).all() and np.abs(corners - points).max() <= CLOSE * size**0.5)


def nearest_directions(
    one: np.ndarray, other: np.ndarray, boxes: tuple[bool, bool] = (False, False)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where hulls of points are nearest.

    Args:
        one, other: Their points. Shapes (K, m, 3), (K, l, 3).
        boxes: Whether each is known to be a box (`is_box`).

    Returns:
        Unit vectors from a nearest point of one to one of the other (K, 3), and these points, (K, 3) each. Of hulls
        that overlap, as far as the search can tell, the vector is that along which they overlap least of the axes
        that were tried, which are enough for segments and boxes, and the points are one inside both.
    """
    if one.shape[1] == other.shape[1] == 2:
        here, there, way = _between_segments(one, other)
    elif one.shape[1] == 2 and boxes[1]:
        here, there, way = _segment_beside_box(one, other)
    elif other.shape[1] == 2 and boxes[0]:
        there, here, way = _segment_beside_box(other, one)
        way = -way
    else:
        here, there, way = _between_hulls(one, other)
    long = np.linalg.norm(way, axis=1)
    size = np.abs(one).max(initial=0.0) + np.abs(other).max(initial=0.0)
    apart = long > CLOSE * size
    direction = np.where(apart[:, None], way / np.where(apart, long, 1.0)[:, None], 0.0)
    if not apart.all():
        direction[~apart] = _least_overlap(one[~apart], other[~apart], boxes)
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


def _segment_beside_box(rod: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_between_segments` of a segment (K, 2, 3) and the corners of a box (K, 8, 3).

    Half the slope of the squared distance at a place s along the segment rises with s, straight between the places
    where the segment enters or leaves the slabs of the box. It is worked out at these, and its root lies between two.
    """
    centre = (box[:, 0] + box[:, 7]) / 2
    axes = box[:, [4, 2, 1]] - box[:, :1]
    lengths = np.linalg.norm(axes, axis=2)
    axes, half = axes / lengths[:, :, None], lengths / 2
    ends = (rod - centre[:, None]) @ np.swapaxes(axes, 1, 2)
    start, u = ends[:, 0], ends[:, 1] - ends[:, 0]
    moves = np.where(u == 0, 1.0, u)
    enters, leaves = np.clip((-half - start) / moves, 0.0, 1.0), np.clip((half - start) / moves, 0.0, 1.0)
    places = np.sort(np.concatenate([enters, leaves, np.zeros((len(u), 1)), np.ones((len(u), 1))], axis=1), axis=1)
    x = start[:, None] + places[:, :, None] * u[:, None]
    slopes = ((x - np.clip(x, -half[:, None], half[:, None])) * u[:, None]).sum(axis=2)
    rows = np.arange(len(u))
    after = np.clip((slopes < 0).sum(axis=1), 1, places.shape[1] - 1)  # the first place where the slope is not negative
    low, high = slopes[rows, after - 1], slopes[rows, after]
    rise = high - low
    share = np.clip(-low / np.where(rise > 0, rise, 1.0), 0.0, 1.0)
    s = places[rows, after - 1] + share * (places[rows, after] - places[rows, after - 1])
    x = start + s[:, None] * u
    nearest = np.clip(x, -half, half)
    here, there, way = ((part[:, None] @ axes)[:, 0] for part in (x, nearest, nearest - x))
    return here + centre, there + centre, way


def _between_hulls(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `_between_segments` of hulls of points (K, m, 3), (K, l, 3), by the algorithm of Gilbert, Johnson, Keerthi."""
    here, there = one[:, 0].astype(float), other[:, 0].astype(float)
    active = np.arange(len(one))
    a, b = np.repeat(here[:, None], 4, axis=1), np.repeat(there[:, None], 4, axis=1)
    found = there - here
    towards = found.copy()
    for _ in range(64):  # a few are enough, but for rounding
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
    inside = (normals @ last[:, :, None])[:, ::-1, 0] * [-1.0, 1.0, -1.0]
    inside /= np.where(full, content, 1.0)[:, None]  # Cramer: the normals are those of edges 12, 02 and 01
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
    i, j = [1, 2, 0], [2, 0, 1]
    return np.asarray(one[..., i] * other[..., j] - one[..., j] * other[..., i])


def _least_overlap(one: np.ndarray, other: np.ndarray, boxes: tuple[bool, bool]) -> np.ndarray:
    """Unit vectors (K, 3) from one to other along which hulls that overlap do so least, of some that are tried.

    The line of the middles, and the normals of edges of both and of their pairs, edges being those from a first point
    to the next three; of a box its own.
    """
    ends = [[1, 2, 4] if box else [1, 2, 3][: p.shape[1] - 1] for p, box in zip((one, other), boxes, strict=True)]
    edges = np.concatenate([p[:, few] - p[:, :1] for p, few in zip((one, other), ends, strict=True)], axis=1)
    i, j = np.triu_indices(edges.shape[1], 1)
    middles = (other.mean(axis=1) - one.mean(axis=1))[:, None]
    axes = np.broadcast_to(np.eye(3), (len(one), 3, 3))
    tried = np.concatenate([middles, edges, _cross(edges[:, i], edges[:, j]), axes], axis=1)
    lengths = np.linalg.norm(tried, axis=2, keepdims=True)
    units = np.where(lengths > 0, tried / np.where(lengths > 0, lengths, 1.0), axes[:, :1])
    units = np.concatenate([units, -units], axis=1)
    there, here = units @ np.swapaxes(other, 1, 2), units @ np.swapaxes(one, 1, 2)
    return np.asarray(units[np.arange(len(one)), (there.min(axis=2) - here.max(axis=2)).argmax(axis=1)])
