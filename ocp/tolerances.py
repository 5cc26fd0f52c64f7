"""Tolerances of all checks: by how much a motion may deviate, and below which size a value counts as zero.

Relative tolerances, named `..._SHARE`, refer to a size: of a state or control its range along the plan, of a constraint
the size of its terms (:mod:`ocp.audit.sizes`), of a limit its value.
"""

from __future__ import annotations

import numpy as np

LIMIT_SHARE = 1e-3
"""Allowed relative error of states, bounds, constraints, joint limits and cost, and allowed difference of solutions
that agree. Solvers and integrators err by less than a thousandth of this, and the masses and actuators of an arm are
not known more accurately."""
COSTATE_SHARE = 1e-2
"""Allowed relative error of costates. Its effect on the cost is quadratic: 1e-4, a tenth of `LIMIT_SHARE`."""
UNFIT_COSTATE_SHARE = 0.1
"""Allowed distance of costates from their best fit, relative to the cost, if controls enter linearly and the best fit
is not unique. The quadratic effect on the cost is at most 1e-2."""
POSITION_TOLERANCE_M = 1e-4
"""Default tolerance of the position of a tip, m: the repeatability of a common robot arm."""
ORIENTATION_TOLERANCE_RAD = 1e-3
"""Default tolerance of the orientation of a tip, rad: `POSITION_TOLERANCE_M` at the end of a tool of 0.1 m."""
CLEARANCE_TOLERANCE_M = 1e-6
"""Allowed violation of a minimum distance, m: `POSITION_TOLERANCE_M` / 100, so that solver residuals do not count as
collisions.
"""
MOMENTUM_SHARE = 1e-2
"""Allowed change of the total momentum, relative to the momentum of the joint motion, if a file states the motion of
the base. The velocity of the base then comes from finite differences."""
HELD_SHARE = 1e-2
"""Smallest path length, relative to the terms of a path's error, by which the audit divides this error. For a tip that
stands still, whose path has no length, `LIMIT_SHARE` times this value is `RESOLVED_SHARE`."""

NEAR_LIMIT_SHARE = 1e-2
"""Distance of a quantity from a limit, relative to the size of the quantity, below which the limit may be active. The
audit counts the multiplier times the distance as lost cost, so a larger share changes no result and takes longer."""
TIGHTENED_SHARE = 0.1
"""Largest tightening of a limit, relative to the limited quantity, at which the limit may be active. Beyond that, the
multiplier says little about the cost of the tightening."""
IMPLIED_SHARE = 1e-4
"""Factor of a constraint in a linear dependence of constraints, relative to the largest factor, below which this
constraint takes no part in the dependence."""
SOLVER_SHARE = 1e-6
"""Residuals to expect from a solver (1e-8 in its scaled variables), relative to the largest value of their kind."""
RESOLVED_SHARE = 10 * SOLVER_SHARE
"""Smallest relative change that a plan resolves reliably. What moves less stands still, and a value whose distance from
its limit is a smaller share of its range is at the limit."""
FLAT_SHARE = 1e-7
"""Relative curvature below which the cost counts as flat. Second derivatives along a plan known to `SOLVER_SHARE` keep
about half of the sixteen digits of a number.
"""
ROUNDING_SHARE = 1e-9
"""Relative size below which a value counts as the rounding error of many operations."""
MACHINE_SHARE = 50 * float(np.finfo(float).eps)
"""Relative size below which a value counts as the rounding error of some tens of operations."""
STANDSTILL = 1e-12
"""Value in SI units below which a quantity counts as zero: a picometre, far below what any machine resolves."""


def path_tolerance(positions: np.ndarray) -> float:
    """Return the position tolerance of a path, m: 0.1 mm or a thousandth of the path's extent, whichever is smaller.

    Args:
        positions: Points of the path, m. Shape (M, 3). For a single point the tolerance is 0.1 mm.
    """
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    return min(LIMIT_SHARE * extent, POSITION_TOLERANCE_M) if extent > 0 else POSITION_TOLERANCE_M
