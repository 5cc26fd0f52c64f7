"""The conditions of first order at an optimum as a linear system: which limits push.

Nocedal, Wright 2006, Numerical Optimization, chapters 12 and 16.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from ocp.direct.assembly import Program
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.direct.scaling import Scales

__all__ = ["RESOLVED", "Conditions", "Sides", "conditions", "corrected", "held_by", "scaled"]

Sides: TypeAlias = dict[str, np.ndarray]
"""On which side each variable (x) and row (g) is held: -1 below, 1 above, 0 at none."""
RESOLVED = 10 * SOLVER_RESIDUAL
"""In units of the solver: the largest slope along what no limit holds, a plan costs the square of it too much; the
distance to a limit at which it is touched though it does not push; and what a linear system may be missed by."""


@dataclass(frozen=True)
class Conditions:
    """First and second derivatives of a program at a plan, in units of the solver.

    Attributes:
        hessian: Of the Lagrangian, both halves. Shape (n, n). jacobian: Of the rows. Shape (m, n).
        of_bounds: Multipliers of the bounds of the variables (n,). of_rows: Of the rows (m,).
        held, fixed: Which rows and which variables stand at a limit that pushes, or are given.
    """

    hessian: sp.csc_array
    jacobian: sp.csr_array
    of_bounds: np.ndarray
    of_rows: np.ndarray
    held: np.ndarray
    fixed: np.ndarray


def conditions(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Conditions:
    """The conditions at what a solver found under these arguments (p and bounds)."""
    v, lam, p = outcome.variables, outcome.multipliers, arguments["p"]
    a, b, c = scales.variables, scales.rows, scales.cost
    slope, jacobian = program.numbers.first(v, p)
    slope, jacobian = slope * a / c, scaled(jacobian, 1 / b, a)
    half = scaled(program.numbers.second(v, p, 1.0, lam), a / c, a)
    hessian = half + sp.triu(half, 1).T
    of_rows = lam * b / c
    of_bounds = -(slope + jacobian.T @ of_rows)
    held = at_limit(outcome.rows / b, arguments["lbg"] / b, arguments["ubg"] / b, of_rows)
    fixed = at_limit(v / a, arguments["lbx"] / a, arguments["ubx"] / a, of_bounds)
    return Conditions(sp.csc_array(hessian), sp.csr_array(jacobian), of_bounds, of_rows, held, fixed)


def pushes(program: Program, outcome: Outcome, p: np.ndarray, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the bounds of the variables (n,) and of the rows (m,), in units of the solver."""
    v, lam = outcome.variables, outcome.multipliers
    slope, jacobian = program.numbers.first(v, p)
    return -(slope + jacobian.T @ lam) * scales.variables / scales.cost, lam * scales.rows / scales.cost


def held_by(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Sides:
    """On which side each variable (x) and row (g) stands at a limit that pushes: -1 below, 1 above, 0 at none."""
    push = dict(zip("xg", pushes(program, outcome, arguments["p"], scales), strict=True))
    values, units = {"x": outcome.variables, "g": outcome.rows}, {"x": scales.variables, "g": scales.rows}
    sides = {}
    for kind, unit in units.items():
        low, high = arguments[f"lb{kind}"] / unit, arguments[f"ub{kind}"] / unit
        held = at_limit(values[kind] / unit, low, high, push[kind])
        sides[kind] = np.where(held & (low < high), np.sign(push[kind]), 0.0)
    return sides


def corrected(
    program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales, sides: Sides, tolerance: float
) -> Sides | None:
    """Which limits to hold next, after some were held and the others let go: those that push, and those missed.

    Where these are the same as before, what was found is right. None where the cost still falls along what is free,
    as where rounding ended the solve too early. Hintermueller, Ito, Kunisch 2002, The primal-dual
    active set strategy as a semismooth Newton method.
    """
    push = dict(zip("xg", pushes(program, outcome, arguments["p"], scales), strict=True))
    values, units = {"x": outcome.variables, "g": outcome.rows}, {"x": scales.variables, "g": scales.rows}
    free = (sides["x"] == 0) & (arguments["lbx"] < arguments["ubx"])
    if not np.all(np.abs(push["x"][free]) <= RESOLVED):  # nor where it is no number
        return None
    found = {}
    for kind, unit in units.items():
        value, side = values[kind] / unit, sides[kind]
        low, high = arguments[f"lb{kind}"] / unit, arguments[f"ub{kind}"] / unit
        room = tolerance * np.maximum(1.0, np.abs(value))
        kept = np.where(push[kind] * side > SOLVER_RESIDUAL, side, 0.0)  # the others pull, or more do their work
        missed = np.where(low < high, 1.0 * (value > high + room) - (value < low - room), 0.0)
        found[kind] = np.where(missed != 0, missed, kept)
    return found


def at_limit(value: np.ndarray, lower: np.ndarray, upper: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Which values are given, or held by a limit that pushes more than it is away."""
    with np.errstate(invalid="ignore"):
        below = (push < -SOLVER_RESIDUAL) & (value - lower < -push)
        above = (push > SOLVER_RESIDUAL) & (upper - value < push)
    return np.asarray((lower == upper) | below | above)


def scaled(matrix: sp.csc_array, rows: np.ndarray, columns: np.ndarray) -> sp.csc_array:
    """A matrix with its rows and its columns times factors."""
    by = rows[matrix.indices] * np.repeat(columns, np.diff(matrix.indptr))
    return sp.csc_array((matrix.data * by, matrix.indices, matrix.indptr), shape=matrix.shape)
