"""How far a tip may be from the path that it is to follow, where nobody says."""

from __future__ import annotations

import numpy as np

from models.arrays import Array

POSITION_TOLERANCE_M, ORIENTATION_TOLERANCE_RAD = 1e-4, 1e-3


def path_tolerance(positions: Array) -> float:
    """The smaller of 0.1 mm and a thousandth of a path's extent, m; 0.1 mm where it is a point. Positions (M, 3), m."""
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    return min(1e-3 * extent, POSITION_TOLERANCE_M) if extent > 0 else POSITION_TOLERANCE_M
