"""Tolerances of all verdicts: by how much a motion may deviate, and below which size a value counts as zero.

Relative tolerances, named `..._SHARE`, refer to a size: of a state or control its range along the plan, of a constraint
the size of its terms (:mod:`ocp.audit.sizes`), of a limit its value.
"""

from __future__ import annotations

import numpy as np

LIMIT_SHARE = 1e-3
"""Relative error allowed of a state, bound, constraint, joint limit and of the cost, and between solutions that agree.
Solvers and integrators err by less than a thousandth of it, and the masses and actuators of an arm are not known more
accurately.
"""
COSTATE_SHARE = 1e-2
"""Relative error allowed of costates. The cost depends on it quadratically: 1e-4, a tenth of `LIMIT_SHARE`."""
UNFIT_COSTATE_SHARE = 0.1
"""Distance allowed of costates from the best fit, relative to the cost, if controls enter linearly and many costates
fit. The quadratic effect on the cost is at most 1e-2.
"""
POSITION_TOLERANCE_M = 1e-4
"""Default position error of a tip, m: the repeatability of a common arm."""
ORIENTATION_TOLERANCE_RAD = 1e-3
"""Default orientation error of a tip, rad: `POSITION_TOLERANCE_M` at a tool of 0.1 m."""
CLEARANCE_TOLERANCE_M = 1e-6
"""Violation allowed of a minimum distance, m: `POSITION_TOLERANCE_M` / 100, so that solver residuals are no collisions.
"""
MOMENTUM_SHARE = 1e-2
"""Change allowed of the total momentum, relative to that of the joints, if a file gives the motion of the base, whose
velocity then comes from finite differences.
"""
HELD_SHARE = 1e-2
"""Smallest reference size of a watched integral, relative to its terms: for a tip that stands still, `LIMIT_SHARE` of
it is `RESOLVED_SHARE`.
"""

NEAR_LIMIT_SHARE = 1e-2
"""Distance from a limit, relative to the limited quantity, below which the limit may be active. The audit charges the
multiplier times the gap, so a larger share changes no verdict and takes longer.
"""
TIGHTENED_SHARE = 0.1
"""Tightening of a limit, relative to the limited quantity, up to which the limit may still be active. Beyond, a
first-order price says little.
"""
IMPLIED_SHARE = 1e-4
"""Singular value, for rows of length 1, below which conditions may be dependent within the error of a plan."""
SOLVER_SHARE = 1e-6
"""Residuals of a solver, relative to the largest value of its kind; 1e-8 of scaled values."""
RESOLVED_SHARE = 10 * SOLVER_SHARE
"""Relative size that a plan resolves reliably. What moves less stands still, and a value whose distance from its limit
is a smaller share of its range is at the limit.
"""
FLAT_SHARE = 1e-7
"""Relative curvature below which the cost counts as flat. Second derivatives along a plan known to `SOLVER_SHARE` keep
about half of the sixteen digits of a number.
"""
ROUNDING_SHARE = 1e-9
"""Relative size below which a value is rounding after many operations."""
MACHINE_SHARE = 50 * float(np.finfo(float).eps)
"""Relative size below which a value is rounding after some tens of operations."""
STANDSTILL = 1e-12
"""Value in SI units below which a quantity stands still: a picometre, far below what any machine resolves."""


def path_tolerance(positions: np.ndarray) -> float:
    """Return the position tolerance of a path: 0.1 mm, or a thousandth of its extent if that is smaller, m.

    Args:
        positions: Points of the path, m. Shape (M, 3). For a single point the tolerance is 0.1 mm.
    """
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    return min(LIMIT_SHARE * extent, POSITION_TOLERANCE_M) if extent > 0 else POSITION_TOLERANCE_M
