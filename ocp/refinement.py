"""Mesh refinement by the audit's own integration error."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np

from ocp.direct.prepared import DirectMethod, check_meshed
from ocp.errors import ProblemError, RefinementWarning, checked_count
from ocp.methods import solve
from ocp.problem.problem import Problem
from ocp.solution import ByName, Guess, Refinement, Solution

__all__ = ["refine", "split"]

TARGET_SHARE = 0.5  # of the tolerance, which every interval is split for
MOST_PIECES = 4  # that an interval is split into at once
MOST_ROUNDS = 20


def refine(
    problem: Problem,
    method: DirectMethod,
    *,
    tolerance: float = 1e-6,
    max_intervals: int = 400,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
) -> Solution:
    """Solve, and split intervals by their error until the audit's integration error is under ``tolerance``.

    The error of an interval is the distance of the plan from its re-integration over that interval alone. It falls with
    the power of the width that is the method's order, which says into how many pieces the interval is split. Every
    round starts from the plan before.

    Args:
        problem, parameters, solver, options, guess: As for :func:`ocp.methods.solve`.
        method: The mesh to start from.
        tolerance: Largest integration error, relative to the size of each state.
        max_intervals: Cap on the number of intervals.

    Returns:
        The last solution; its ``refinement`` says how the mesh came about and whether the tolerance was reached.

    Raises:
        ProblemError: tolerance not positive, or cap below the first mesh.
        SolveError: A round failed.

    Warns:
        RefinementWarning: The cap (or the least width) stopped it before the tolerance was reached.
    """
    check_meshed("refine", method, tolerance)
    max_intervals = checked_count("refine: max_intervals", max_intervals)
    if max_intervals < method.intervals:
        raise ProblemError(
            f"refine: max_intervals {max_intervals} is below the {method.intervals} intervals given",
            name="max_intervals",
            value=max_intervals,
            limit=method.intervals,
        )
    intervals: list[int] = []
    errors: list[float] = []
    while True:
        solution = solve(problem, method, parameters=parameters, solver=solver, options=options, guess=guess)
        audit = solution.audit()
        intervals.append(method.intervals)
        errors.append(audit.integration_error)
        reached = audit.integration_error <= tolerance
        finer = split(method.fractions, audit.local_errors, TARGET_SHARE * tolerance, method.order, max_intervals)
        if reached or len(finer) == method.intervals + 1 or len(errors) == MOST_ROUNDS:
            break
        method = method.with_mesh(finer)
        guess = solution
    if not reached:
        words = (
            f"refinement of {problem.name!r} stopped at {intervals[-1]} of at most {max_intervals} intervals with an "
            f"integration error of {errors[-1]:.2e}, above the tolerance {tolerance:.2e}; raise max_intervals"
        )
        told = RefinementWarning(words, name="integration error", value=errors[-1], limit=tolerance)
        warnings.warn(told, stacklevel=2)
    return dataclasses.replace(solution, refinement=Refinement(tuple(intervals), tuple(errors), tolerance, reached))


def split(mesh: np.ndarray, errors: np.ndarray, target: float, order: int, most: int) -> np.ndarray:
    """A finer mesh of at most ``most`` intervals, the worst intervals split first. Shape (N' + 1,)."""
    with np.errstate(over="ignore"):
        wanted = np.ceil((np.where(np.isfinite(errors), errors, np.inf) / target) ** (1.0 / order))
    pieces = np.clip(wanted, 1, MOST_PIECES).astype(int)
    if np.all(pieces == 1):  # every interval is good, their sum is not: halve the worse half
        pieces[errors >= np.median(errors)] = 2
    room = most - len(errors)
    for k in np.argsort(errors):  # the least bad give way first
        excess = int(np.sum(pieces - 1)) - room
        if excess <= 0:
            break
        pieces[k] = max(1, pieces[k] - excess)
    cuts = [np.linspace(mesh[k], mesh[k + 1], n + 1)[:-1] for k, n in enumerate(pieces)]
    return np.concatenate([*cuts, mesh[-1:]])
