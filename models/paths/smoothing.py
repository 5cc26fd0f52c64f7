"""Rounding every corner of a path."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.arrays import ArrayInput
from models.errors import ModelError
from models.paths.arc_length import cells
from models.paths.blends import BlendKind, checked_kind, checked_shape
from models.paths.chain import Path
from models.paths.corners import Overlap, blend_coefficients, remaining_distances
from models.paths.smooth import SmoothPath

__all__ = ["smooth"]

SHORTEST_PIECE = 1e-12
"""Rests of a segment between two blends shorter than this, over the segment, are dropped."""


def smooth(
    path: Path,
    remaining: ArrayInput | None = None,
    *,
    deviation: ArrayInput | None = None,
    kind: BlendKind = "quintic",
    shape: Any = None,
    overlap: Overlap = "shrink",
) -> SmoothPath:
    """Round every corner of a path.

    Args:
        path: The task.
        remaining: Distance (m) from a vertex at which its blend leaves the segments, measured along them: one for all
            vertices, or one for each.
        deviation: Instead of `remaining`: how far (m) the smooth path may stray from the task and the task from the
            smooth path; the blends are as large as that and the segments allow.
        kind: "quintic", whose curvature is continuous everywhere, or the paper's "cubic", whose curvature is continuous
            between lines only, and only at shape 3.
        shape: End tangents over the remaining distance, lambda of eq. (9), one for all or one for each vertex; 3
            (cubic) or 1.5 (quintic) if None.
        overlap: What happens to blends that would overlap on a segment: "shrink" makes both smaller, "refuse" raises.

    Raises:
        ModelError: A distance, deviation or shape that is not positive; blends that overlap, if refused; a cusp.
    """
    checked_kind(kind)
    factors, count = checked_shape(shape, kind), len(path.segments) - 1
    if factors.ndim and factors.shape != (count,):
        raise ModelError(f"shape has shape {factors.shape}; give one number, or one for each of the {count} vertices")
    factors = np.broadcast_to(factors, (count,))
    distances = remaining_distances(path, remaining, deviation, kind, factors, overlap)
    coefficients = blend_coefficients(path, distances, kind, factors)
    curve_cells = cells(coefficients)
    blend_lengths = np.bincount(curve_cells.curve, curve_cells.length, minlength=len(distances))
    padded = np.concatenate([[0.0], distances, [0.0]])
    rests = path.lengths - padded[:-1] - padded[1:]
    count = len(path.segments)
    lengths, segment, blend = np.empty(2 * count - 1), np.full(2 * count - 1, -1), np.full(2 * count - 1, -1)
    lengths[::2], lengths[1::2] = rests, blend_lengths
    segment[::2], blend[1::2] = np.arange(count), np.arange(count - 1)
    kept = np.ones(2 * count - 1, dtype=bool)
    kept[::2] = rests > SHORTEST_PIECE * path.lengths
    bounds = np.concatenate([[0.0], np.cumsum(lengths[kept])])
    smoothed = SmoothPath(path, kind, distances, factors, coefficients, bounds, segment[kept], blend[kept], curve_cells)
    if path.turns:
        _check_turns(smoothed)
    return smoothed


def _check_turns(smoothed: SmoothPath) -> None:
    theta = smoothed.charts[1]
    largest = np.linalg.norm(theta, axis=2).sum(axis=1)  # bounds |theta| over the whole piece
    if largest.max() > 2 * np.pi:
        bounds = smoothed.bounds[:-1][largest > 2 * np.pi]
        u = np.linspace(0, 1, 33)[:, None] ** np.arange(6)
        angle = np.linalg.norm(np.einsum("uk,pkc->puc", u, theta[largest > 2 * np.pi]), axis=2).max(axis=1)
        if angle.max() > 2 * np.pi:
            raise ModelError(
                f"the tool turns by {np.degrees(angle.max()):.4g} deg in the blend at "
                f"{bounds[int(angle.argmax())]:g} m; turn less or take a smaller remaining distance"
            )
