"""Convex hull of points in space: its vertices, its triangles, the planes of its faces."""

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
