"""How large each blend of a path is: distances given, computed from a tolerance, and kept from overlapping."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError
from models.parts import Array, ArrayInput
from models.paths.blends import BlendKind, cubic, gamma, polynomial, quintic
from models.paths.chain import Path

__all__ = ["Overlap", "blend_coefficients", "deviations", "remaining_distances"]

Overlap: TypeAlias = Literal["shrink", "refuse"]
SAMPLES = 65
SLACK = 1e-3
"""Share of the tolerance kept back for what lies between the samples of a deviation."""
BISECTIONS = 30


def blend_coefficients(
    path: Path, remaining: Array, kind: BlendKind, shape: Array, vertices: NDArray[np.intp] | None = None
) -> Array:
    """Polynomials of the blends about the vertices 1..n-1 (all, or those of index `vertices`). Shape (V, 6, 3)."""
    before = np.arange(len(path.segments) - 1) if vertices is None else vertices
    p0, n0, k0, _ = path.at(before, path.lengths[before] - remaining)
    p1, n1, k1, _ = path.at(before + 1, remaining)
    rate = (shape * remaining)[:, None]
    if kind == "cubic":
        return cubic(p0, rate * n0, p1, rate * n1)
    return quintic(p0, rate * n0, rate**2 * k0, p1, rate * n1, rate**2 * k1)


def remaining_distances(
    path: Path,
    remaining: ArrayInput | None,
    deviation: ArrayInput | None,
    kind: BlendKind,
    shape: Array,
    overlap: Overlap,
) -> Array:
    """Remaining distance of each vertex, checked. Shape (n - 1,), m. Arguments as of `models.paths.smooth`."""
    if overlap not in get_args(Overlap):
        raise ModelError(f"overlap {overlap!r} is unknown; use one of {list(get_args(Overlap))}")
    if (remaining is None) == (deviation is None):
        raise ModelError("give either the remaining distance or the deviation, not both and not neither")
    if remaining is not None:
        wanted = _per_vertex(path, remaining, "remaining")
        return _without_overlap(path, wanted, overlap)
    tolerance = _per_vertex(path, deviation, "deviation")
    # never longer than a segment, so that every trial is a curve that exists
    longest = np.minimum(path.lengths[:-1], path.lengths[1:])
    return _without_overlap(path, _from_deviation(path, tolerance, kind, shape, longest), overlap)


def _per_vertex(path: Path, value: ArrayInput, what: str) -> Array:
    count = len(path.segments) - 1
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} {value!r} is not numeric") from error
    if array.ndim and array.shape != (count,):
        raise ModelError(f"{what} has shape {array.shape}; give one number, or one for each of the {count} vertices")
    wrong = ~(np.isfinite(array) & (array > 0))
    if wrong.any():
        raise ModelError(f"{what} {float(array[wrong].flat[0]):g} m must be positive and finite")
    return np.broadcast_to(array, (count,)).copy()


def _without_overlap(path: Path, wanted: Array, overlap: Overlap) -> Array:
    if not wanted.size:
        return wanted
    padded = np.concatenate([[0.0], wanted, [0.0]])
    demand = padded[:-1] + padded[1:]  # of each segment
    # rounding, for example of 0.1 + 0.2 against 0.3, is no overlap
    factor = np.where(demand > path.lengths * (1 + 1e-12), path.lengths / demand, 1.0)
    if overlap == "refuse" and factor.min() < 1:
        i = int(factor.argmin())
        raise ModelError(
            f"segment {i}, {path.lengths[i]:g} m long, has no room for the blends at its ends, which take "
            f"{demand[i]:g} m; take a smaller remaining distance or overlap='shrink'"
        )
    return np.asarray(wanted * np.minimum(factor[:-1], factor[1:]))


def _from_deviation(path: Path, tolerance: Array, kind: BlendKind, shape: Array, longest: Array) -> Array:
    found = longest.copy()
    angles = path.corner_angles()
    straight = (path.curvature[:-1] == 0) & (path.curvature[1:] == 0)
    # between two lines the deviation is proportional to the remaining distance: one trial tells the ratio
    lines = np.flatnonzero(straight)
    if lines.size:
        legs = deviations(path, longest[lines], kind, shape[lines], lines)[1] / longest[lines] * (1 + SLACK)
        corner = np.array([gamma(s, a, kind) for s, a in zip(shape[lines], angles[lines], strict=True)])
        ratio = np.maximum(corner, legs)
        with np.errstate(divide="ignore"):
            found[lines] = np.minimum(longest[lines], tolerance[lines] / ratio)
    arcs = np.flatnonzero(~straight)
    if arcs.size:
        found[arcs] = _bisected(path, tolerance[arcs] * (1 - SLACK), kind, shape[arcs], longest[arcs], arcs)
    return found


def _bisected(
    path: Path, tolerance: Array, kind: BlendKind, shape: Array, longest: Array, vertices: NDArray[np.intp]
) -> Array:
    def inside(remaining: Array) -> NDArray[np.bool_]:
        return np.asarray(np.maximum(*deviations(path, remaining, kind, shape, vertices)) <= tolerance)

    # the largest of a geometric ladder that fits with all below it, then refined: the deviation need not be monotone
    low, high = np.zeros_like(longest), longest * 2.0**-16
    for _ in range(16):
        fits = inside(high) & (high > low)
        low = np.where(fits, high, low)
        high = np.where(fits, np.minimum(2 * high, longest), high)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        fits = inside(middle)
        low, high = np.where(fits, middle, low), np.where(fits, high, middle)
    if (low <= 0).any():
        i = int(vertices[int((low <= 0).argmax())])
        raise ModelError(f"vertex {i + 1}: no blend stays within the deviation; take a larger one")
    return low


def deviations(
    path: Path, remaining: Array, kind: BlendKind, shape: Array, vertices: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Distance of the vertex from its blend, and largest distance of the blend from the two segments.

    Between them they bound how far the smooth path strays from the task and the task from the smooth path. Sampled
    at 65 points: the first is never below the truth, the second at most 0.1 % below it.

    Args:
        remaining, shape: Shape (V,).
        vertices: Vertices, 0 being the end of the first segment. Shape (V,).

    Returns:
        Shape (V,) each, m.
    """
    curves = blend_coefficients(path, remaining, kind, shape, vertices)
    u = np.linspace(0, 1, SAMPLES)
    points = polynomial(curves[:, None], u[None, :])
    corner = np.linalg.norm(points - path.start[vertices + 1][:, None], axis=-1).min(axis=1)
    near = np.minimum(
        _distance(path, vertices, points, path.lengths[vertices] - remaining, path.lengths[vertices]),
        _distance(path, vertices + 1, points, np.zeros(len(vertices)), remaining),
    )
    return np.asarray(corner), np.asarray(near.max(axis=1))


def _distance(path: Path, index: NDArray[np.intp], points: Array, first: Array, last: Array) -> Array:
    # of points (V, S, 3) from the stretch first..last of a segment each
    offset = points - path.start[index][:, None]
    along = np.einsum("vsi,vi->vs", offset, path.tangent[index])
    across = np.einsum("vsi,vi->vs", offset, path.normal[index])
    k = path.curvature[index][:, None]
    # angle about the center, from the start; in the branch of the stretch's middle
    middle = (first + last)[:, None] / 2
    angle = np.arctan2(k * along, 1 - k * across)
    angle = k * middle + (angle - k * middle + np.pi) % (2 * np.pi) - np.pi
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(k > 0, angle / k, along)
    s = np.clip(distance, first[:, None], last[:, None])
    shape = points.shape[:2]
    flat = np.repeat(index, shape[1])
    return np.asarray(np.linalg.norm(points - path.at(flat, s.ravel())[0].reshape(points.shape), axis=-1))
