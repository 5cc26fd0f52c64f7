"""Convex hulls of points, and the closest points of pairs of convex hulls.

`nearest_directions` computes the closest points of many pairs of hulls at once: of segments and boxes in closed form,
of others by the algorithm of Gilbert, Johnson and Keerthi (1988). The gap along any direction (`gap_along`) is a lower
bound of the distance, so a result can be verified without trusting the search.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from threading import Thread

import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import ROUNDING, Array, freeze
from models.errors import ModelError
from models.files import cache_key, load_value, source_version, store_value

GAP_TOLERANCE = 1e-12
"""Relative difference between a distance and its lower bound, the gap, at which the distance search ends."""
DEGENERATE = 1e-14
"""Squared area or volume, relative to squared edge lengths, below which a triangle or tetrahedron is degenerate."""
EDGE_I, EDGE_J = np.triu_indices(3, 1)


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull of points in space: its vertices, triangles and face planes."""

    vertices: Array  # corners of the hull. Shape (m, 3), m.
    faces: NDArray[np.intp]  # triangles of corners, counter-clockwise from outside. Shape (k, 3).
    normals: Array  # distinct outward unit normals of the faces. Shape (f, 3).
    offsets: Array  # the hull is the set of x with normals x <= offsets. Shape (f,), m.


def convex_hull(points: Array) -> Hull:
    """Return the convex hull of points, shape (n, 3), m, computed by qhull (Barber, Dobkin & Huhdanpaa 1996).

    Qhull cannot be interrupted. It runs in its own thread, so that Ctrl-C ends the wait for it at once.

    Raises:
        ModelError: The points are coplanar, collinear or coincident.
    """
    hull: Future[Hull] = Future()

    def compute() -> None:
        try:
            hull.set_result(_convex_hull(points))
        except Exception as error:
            hull.set_exception(error)

    Thread(target=compute, daemon=True).start()
    return hull.result()


def cached_hull(points: Array) -> Hull:
    """Return the convex hull of points, read from the disk cache if it was computed before."""
    key = cache_key(source_version(__name__), "hull", points)
    try:
        vertices, faces, normals, offsets = (np.asarray(part) for part in load_value(key))
        known = Hull(freeze(vertices), faces.astype(np.intp), freeze(normals), freeze(offsets))
        if vertices[faces].shape[1:] == (3, 3) and (vertices @ normals.T <= offsets).all():
            return known
    except (IndexError, TypeError, ValueError):  # no such file, or an invalid one
        pass
    hull = convex_hull(points)
    store_value(key, [part.tolist() for part in (hull.vertices, hull.faces, hull.normals, hull.offsets)])
    return hull


def _convex_hull(points: Array) -> Hull:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    size = float(np.abs(points - middle).max()) or 1.0
    centred = (points - middle) / size
    sample = centred[:: 1 + len(centred) // 1000]  # enough to estimate the plane that all points may lie in
    flat = 1e-10
    normal = np.linalg.svd(sample - sample.mean(axis=0), full_matrices=False)[2][-1]
    try:
        if len(points) < 4 or np.ptp(centred @ normal) <= flat:
            raise scipy.spatial.QhullError
        qhull = scipy.spatial.ConvexHull(centred, qhull_options="Qt")
    except scipy.spatial.QhullError as error:
        message = "mesh: the vertices are coplanar, so the mesh has no volume; give a thin Box instead"
        raise ModelError(message, name="vertices", value=len(points), limit=flat * size) from error
    corners, faces = np.unique(qhull.simplices, return_inverse=True)
    faces = faces.reshape(qhull.simplices.shape)
    a, b, c = (centred[corners][faces[:, k]] for k in range(3))
    outwards = qhull.equations[:, :3]
    inwards = (np.cross(b - a, c - a) * outwards).sum(axis=1) < 0
    faces[inwards] = faces[inwards][:, [0, 2, 1]]
    # a closed surface is convex if it is convex across each edge (Tietze, Nakajima): test the neighbours' corners
    neighbours = centred[corners][faces[qhull.neighbors].reshape(len(faces), -1)]
    heights = np.einsum("fkj,fj->fk", neighbours, outwards).max(axis=1)
    first, same = _distinct(outwards)
    offsets = np.full(len(first), -np.inf)
    np.maximum.at(offsets, same, heights)
    normals = outwards[first]
    offsets = size * (offsets + 1e-12) + normals @ middle  # by more than qhull leaves points outside
    return Hull(freeze(points[corners]), faces, freeze(normals), freeze(offsets))


def _distinct(normals: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return one index, (f,), from each group of equal unit normals, and the group's number for each normal, (k,)."""
    close_pairs = scipy.spatial.cKDTree(normals).query_pairs(ROUNDING, p=np.inf, output_type="ndarray")
    links = scipy.sparse.coo_array((np.ones(len(close_pairs)), close_pairs.T), shape=(len(normals), len(normals)))
    _, same = scipy.sparse.csgraph.connected_components(links, directed=False)
    first = np.unique(same, return_index=True)[1]
    return np.sort(first), np.argsort(np.argsort(first))[same]


def gap_along(direction: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the gaps, (K,), m, between K pairs of hulls along unit vectors (K, 3) from the first hull to the second.

    The hulls are given by points, shapes (K, m, 3) and (K, l, 3). A gap is a lower bound of the distance.
    """
    column = direction[:, :, None]
    return np.asarray((second @ column).min(axis=(1, 2)) - (first @ column).max(axis=(1, 2)))


def is_box(points: np.ndarray) -> bool:
    """Return whether points, shape (m, 3), are the 8 corners of a box in the order of `Box.core`."""
    if len(points) != 8:
        return False
    edges = points[[4, 2, 1]] - points[0]
    squares = edges @ edges.T
    corners = points[0] + np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)]) @ edges
    size = float(squares.max())
    right = np.abs(squares - np.diag(squares.diagonal())).max() <= GAP_TOLERANCE * size
    fits = np.abs(corners - points).max() <= GAP_TOLERANCE * size**0.5
    return bool(right and (squares.diagonal() > 0).all() and fits)


def nearest_directions(
    first: np.ndarray, second: np.ndarray, boxes: tuple[bool, bool] = (False, False)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the closest points of pairs of hulls and the unit vectors between them.

    Args:
        first, second: Points of the hulls. Shapes (K, m, 3), (K, l, 3).
        boxes: Whether the first and the second hulls are boxes (`is_box`).

    Returns:
        Unit vectors from the first hull to the second, and the closest points on both, (K, 3) each. If two hulls
        overlap, the vector is the direction of least overlap among the candidate axes, which are complete for segments
        and boxes, and the two points coincide inside both hulls.
    """
    first, second = (np.repeat(p, 2, axis=1) if p.shape[1] == 1 else p for p in (first, second))  # points as segments
    if first.shape[1] == second.shape[1] == 2:
        on_first, on_second, difference = _between_segments(first, second)
    elif first.shape[1] == 2 and boxes[1]:
        on_first, on_second, difference = _segment_beside_box(first, second)
    elif second.shape[1] == 2 and boxes[0]:
        on_second, on_first, difference = _segment_beside_box(second, first)
        difference = -difference
    else:
        on_first, on_second, difference = _between_hulls(first, second)
    length = np.linalg.norm(difference, axis=1)
    separated = length > GAP_TOLERANCE * (np.abs(first).max(initial=0.0) + np.abs(second).max(initial=0.0))
    direction = np.where(separated[:, None], difference / np.where(separated, length, 1.0)[:, None], 0.0)
    if not separated.all():
        direction[~separated] = _least_overlap(first[~separated], second[~separated], boxes)
    return direction, on_first, on_second


def _between_segments(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both closest points of K pairs of segments (K, 2, 3) and the vectors between them: three arrays (K, 3).

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.9.
    """
    u, v, w = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], first[:, 0] - second[:, 0]
    a, e, b = (u * u).sum(axis=1), (v * v).sum(axis=1), (u * v).sum(axis=1)
    c, f = (u * w).sum(axis=1), (v * w).sum(axis=1)
    short, single = np.where(a > 0, a, 1.0), np.where(e > 0, e, 1.0)
    normal = a * e - b * b
    sound = normal > DEGENERATE * a * e
    s = np.where(sound, np.clip((b * f - c * e) / np.where(sound, normal, 1.0), 0.0, 1.0), 0.0)
    t = np.where(e > 0, np.clip((b * s + f) / single, 0.0, 1.0), 0.0)
    s = np.where(a > 0, np.clip((b * t - c) / short, 0.0, 1.0), 0.0)
    on_first, on_second = first[:, 0] + s[:, None] * u, second[:, 0] + t[:, None] * v
    return on_first, on_second, on_second - on_first


def _segment_beside_box(rod: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the closest points of K pairs of a segment (K, 2, 3) and a box (K, 8, 3), and the vectors between them.

    Half the derivative of the squared distance in the position s along the segment is increasing and piecewise linear,
    with kinks where the segment enters or leaves a slab of the box. Its root is interpolated between two kinks.
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
    after = np.clip((slopes < 0).sum(axis=1), 1, places.shape[1] - 1)  # first parameter of nonnegative slope
    low, high = slopes[rows, after - 1], slopes[rows, after]
    rise = high - low
    share = np.clip(-low / np.where(rise > 0, rise, 1.0), 0.0, 1.0)
    s = places[rows, after - 1] + share * (places[rows, after] - places[rows, after - 1])
    x = start + s[:, None] * u
    nearest = np.clip(x, -half, half)
    on_first, on_second, difference = ((part[:, None] @ axes)[:, 0] for part in (x, nearest, nearest - x))
    return on_first + centre, on_second + centre, difference


def _between_hulls(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the closest points of K pairs of hulls, and the vectors between these points, by the GJK algorithm."""
    on_first, on_second = first[:, 0].astype(float), second[:, 0].astype(float)
    active = np.arange(len(first))
    a, b = np.repeat(on_first[:, None], 4, axis=1), np.repeat(on_second[:, None], 4, axis=1)
    nearest = on_second - on_first
    v = nearest.copy()
    for _ in range(64):  # a few iterations suffice but for rounding
        if not active.size:
            break
        rows = np.arange(active.size)
        p, q = (first, second) if active.size == len(first) else (first[active], second[active])
        support_first = p[rows, (p @ v[:, :, None])[:, :, 0].argmax(axis=1)]
        support_second = q[rows, (q @ v[:, :, None])[:, :, 0].argmin(axis=1)]
        square = (v * v).sum(axis=1)
        excess = square - (v * (support_second - support_first)).sum(axis=1)
        unconverged = (excess > GAP_TOLERANCE * square) & (square > 0)
        if not unconverged.all():
            active, a, b, v, square = (part[unconverged] for part in (active, a, b, v, square))
            support_first, support_second = support_first[unconverged], support_second[unconverged]
            if not active.size:
                break
        # the last vertex has no weight in any simplex that is not full: replace it by the new one
        a[:, 3], b[:, 3] = support_first, support_second
        weights, new = _weights(b - a)
        order = np.argsort(-weights, axis=1, kind="stable")[:, :, None]
        weights = np.take_along_axis(weights[:, :, None], order, axis=1)
        a, b = np.take_along_axis(a, order, axis=1), np.take_along_axis(b, order, axis=1)
        nearer = (new * new).sum(axis=1) < square
        chosen = active[nearer]
        on_first[chosen], on_second[chosen] = ((weights * part)[nearer].sum(axis=1) for part in (a, b))
        nearest[chosen] = new[nearer]
        a, b = (np.where(weights > 0, part, part[:, :1]) for part in (a, b))
        keep = nearer & (weights[:, 3, 0] == 0)
        active, a, b, v = (part[keep] for part in (active, a, b, new))
    return on_first, on_second, nearest


def _weights(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric weights of the point nearest to the origin in each of K tetrahedra (K, 4, 3), and this point.

    The vertices may coincide. Only faces that contain the last vertex are tried.
    """
    last = w[:, 3]
    edges = w[:, :3] - last[:, None]
    squares = (edges * edges).sum(axis=2)
    shares, valid = np.zeros((len(w), 8, 4)), np.ones((len(w), 8), dtype=bool)
    each = np.arange(3)
    along = -(edges @ last[:, :, None])[:, :, 0] / np.where(squares > 0, squares, 1.0)
    shares[:, 1 + each, each], valid[:, 1:4] = along, (along > 0) & (along < 1)
    u, v = edges[:, EDGE_I], edges[:, EDGE_J]
    normals = _cross(u, v)
    sizes = (normals * normals).sum(axis=2)
    sound = sizes > DEGENERATE * squares[:, EDGE_I] * squares[:, EDGE_J]
    sizes = np.where(sound, sizes, 1.0)
    normal = _cross(normals, last[:, None])  # (v x last) normal = v (last x normal)
    s, t = -(v * normal).sum(axis=2) / sizes, (u * normal).sum(axis=2) / sizes
    shares[:, 4 + each, EDGE_I], shares[:, 4 + each, EDGE_J] = s, t
    valid[:, 4:7] = sound & (s > 0) & (t > 0) & (s + t < 1)
    content = (edges[:, 0] * normals[:, 2]).sum(axis=1)
    full = content**2 > DEGENERATE * squares.prod(axis=1)
    inside = (normals @ last[:, :, None])[:, ::-1, 0] * [-1.0, 1.0, -1.0]
    inside /= np.where(full, content, 1.0)[:, None]  # Cramer: the normals are those of edges 12, 02 and 01
    shares[:, 7, :3], valid[:, 7] = inside, full & (inside > 0).all(axis=1) & (inside.sum(axis=1) < 1)
    shares[:, :, 3] = 1 - shares[:, :, :3].sum(axis=2)
    means = shares @ w
    # against cancellation: the vector to an edge is orthogonal to it, the vector to a triangle parallel to its normal
    parallel = (means[:, 1:4] * edges).sum(axis=2) / np.where(squares > 0, squares, 1.0)
    means[:, 1:4] -= parallel[:, :, None] * edges
    means[:, 4:7] = normals * ((normals * last[:, None]).sum(axis=2) / sizes)[:, :, None]
    lengths = np.where(valid, (means * means).sum(axis=2), np.inf)
    rows, least = np.arange(len(w)), lengths.argmin(axis=1)
    return shares[rows, least], means[rows, least]


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return cross products of vectors along the last array axis, faster than NumPy does."""
    i, j = [1, 2, 0], [2, 0, 1]
    return np.asarray(first[..., i] * second[..., j] - first[..., j] * second[..., i])


def _least_overlap(first: np.ndarray, second: np.ndarray, boxes: tuple[bool, bool]) -> np.ndarray:
    """Return unit vectors, (K, 3), from the first hull to the second along which overlapping hulls overlap least.

    Candidates are the line between the centroids, the edges of both hulls from their first points, the cross products
    of these, and the coordinate axes.
    """
    ends = [[1, 2, 4] if box else [1, 2, 3][: p.shape[1] - 1] for p, box in zip((first, second), boxes, strict=True)]
    edges = np.concatenate([p[:, indices] - p[:, :1] for p, indices in zip((first, second), ends, strict=True)], axis=1)
    i, j = np.triu_indices(edges.shape[1], 1)
    middles = (second.mean(axis=1) - first.mean(axis=1))[:, None]
    axes = np.broadcast_to(np.eye(3), (len(first), 3, 3))
    candidates = np.concatenate([middles, edges, _cross(edges[:, i], edges[:, j]), axes], axis=1)
    lengths = np.linalg.norm(candidates, axis=2, keepdims=True)
    units = np.where(lengths > 0, candidates / np.where(lengths > 0, lengths, 1.0), axes[:, :1])
    units = np.concatenate([units, -units], axis=1)
    on_second, on_first = units @ np.swapaxes(second, 1, 2), units @ np.swapaxes(first, 1, 2)
    return np.asarray(units[np.arange(len(first)), (on_second.min(axis=2) - on_first.max(axis=2)).argmax(axis=1)])
