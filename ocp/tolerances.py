"""The tolerances that decide verdicts: how far a motion may be off, and what counts as nothing.

Shares are relative to a size: of a state or control its spread along the plan, of a constraint that of what it is made
of (:mod:`ocp.audit.sizes`), of a limit its value.
"""

from __future__ import annotations

import numpy as np

LIMIT_SHARE = 1e-3
"""Share of its size by which a state, a bound, a constraint or a joint limit may be missed, of the cost that may be
lost, and by which solutions may differ that agree. Solvers and integrators leave less than a thousandth of that, and
masses and drives of an arm are known no better."""
COSTATE_SHARE = 1e-2
"""Share of the cost that errors of costates may be: they cost by their square, 1e-4, a tenth of `LIMIT_SHARE`."""
UNFIT_COSTATE_SHARE = 0.1
"""Share of the cost that costates may be from those that fit best where controls enter linearly: many fit such a plan,
and what it loses is judged with the best. By their square they cost 1e-2 at most."""
POSITION_TOLERANCE_M = 1e-4
"""Of a tip from its path, m, where nobody says: the repeatability of a common arm."""
ORIENTATION_TOLERANCE_RAD = 1e-3
"""Of a tip from its orientation, rad, where nobody says: `POSITION_TOLERANCE_M` at a tool of 0.1 m."""
CLEARANCE_TOLERANCE_M = 1e-6
"""By which bodies may be nearer than they are asked to stay, m: a hundredth of `POSITION_TOLERANCE_M`, so that what a
solver leaves of a distance that it holds is no collision."""
MOMENTUM_SHARE = 1e-2
"""Share of the momentum that the joints carry by which that of the whole may change, where a file tells the base: its
velocity comes of differences of its samples, which err by the square of their step."""
HELD_SHARE = 1e-2
"""Share of what it is made of that a watched way counts for at least. One that asks for next to no way, a tip that
stands say, is missed by `LIMIT_SHARE` of this: 1e-5 of the ways of the joints, `RESOLVED_SHARE`."""

NEAR_LIMIT_SHARE = 1e-2
"""A limit nearer than this share of the size of what it limits may push; what it pushes over the gap is charged to the
plan, so that a larger share changes no verdict and takes longer."""
TIGHTENED_SHARE = 0.1
"""Share of the size of what is limited by which a limit may have been tightened, to push where the plan rests on it: a
first-order price says little of a limit that is farther away, beyond a maximum of the cost say."""
IMPLIED_SHARE = 1e-4
"""Singular value, for rows of length 1, below which conditions may be implied by others but for the error of a plan:
a tenth of `LIMIT_SHARE`."""
SOLVER_SHARE = 1e-6
"""Share of the largest of its kind that cannot be told from what a solver leaves, 1e-8 of scaled values."""
RESOLVED_SHARE = 10 * SOLVER_SHARE
"""Share of the largest of its kind that a plan surely resolves: what moves less stands still, and a value nearer to its
limit than this share of its spread is held by it."""
FLAT_SHARE = 1e-7
"""Curvature, relative to the largest of the plan, below which the cost counts as not curved: second derivatives along a
plan that is known to `SOLVER_SHARE` keep about half of the sixteen digits of a number."""
ROUNDING_SHARE = 1e-9
"""Share of the largest of its kind below which a value is rounding, after many operations: a limit is kept, an entry
stands still, and a singular value is none up to this."""
MACHINE_SHARE = 50 * float(np.finfo(float).eps)
"""Share of the largest of its kind below which a value is rounding after some tens of operations."""
STANDSTILL = 1e-12
"""SI units below which what is not told to move stands still: a picometre, far below what any machine resolves."""


def path_tolerance(positions: np.ndarray) -> float:
    """The smaller of 0.1 mm and a thousandth of a path's extent, m; 0.1 mm where it is a point. Positions (M, 3), m."""
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    return min(LIMIT_SHARE * extent, POSITION_TOLERANCE_M) if extent > 0 else POSITION_TOLERANCE_M
