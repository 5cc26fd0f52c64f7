"""One way in: ``solve(problem, method)``, and ``prepare`` for problems that are solved many times."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from ocp.direct.nlp import SOLVERS
from ocp.direct.prepared import Method, Prepared, by_name
from ocp.errors import ProblemError
from ocp.indirect.method import Indirect, PreparedIndirect
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["prepare", "solve"]


def prepare(
    problem: Problem,
    method: Method | Indirect,
    *,
    solver: str = "ipopt",
    options: Mapping[str, Any] | None = None,
    compiled: bool = False,
) -> Prepared | PreparedIndirect:
    """Build a problem once; the result's ``solve(parameters=, guess=)`` is called many times.

    Args:
        problem: What is asked. method: How it is transcribed.
        solver: ``ipopt`` or ``fatrop`` (faster on long horizons; takes no coupling of controls at the end). For the
            indirect method, of the direct solution that seeds it.
        options: Passed to the solver, for example ``{"max_iter": 500}``.
        compiled: Compile the block functions with the machine's C compiler: seconds to build, faster solves.

    Raises:
        ProblemError: The problem is not complete, or the method or solver cannot take it.
    """
    if isinstance(method, Indirect):
        if solver not in SOLVERS:
            raise ProblemError(f"unknown solver {solver!r}; known: {', '.join(SOLVERS)}")
        seeder = partial(_seed, solver=solver, options=by_name("options", options), compiled=compiled)
        return PreparedIndirect(problem, method, seeder)
    return Prepared(problem, method, solver, options or {}, compiled)


def _seed(problem: Problem, method: Method, parameters: Any, guess: Any, **how: Any) -> Solution:
    return prepare(problem, method, **how).solve(parameters, guess)


def solve(
    problem: Problem,
    method: Method | Indirect,
    *,
    parameters: Mapping[str, Any] | None = None,
    solver: str = "ipopt",
    options: Mapping[str, Any] | None = None,
    guess: Solution | Mapping[str, Any] | None = None,
    check: bool = True,
) -> Solution:
    """Solve a problem by a method.

    Args:
        problem: What is asked. method: For example ``Collocation(intervals=20, degree=3)``.
        parameters: Value of every parameter by name.
        solver, options: See :func:`prepare`.
        guess: An earlier solution (of any grid or method), or a dictionary by name of values, functions of time, or
            samples (M, n) over the times ``"t"`` (M,); ``"horizon"`` for a free final time.
        check: Raise where the solver fails, after a second solve that finds what would have to give way; False returns
            the unsuccessful solution with its status.

    Raises:
        ProblemError: The problem, method or arguments cannot be right.
        SolveError: The solver failed; names the constraints that cannot hold together, by how much and when, and the
            worst residuals by constraint, state and time.
    """
    return prepare(problem, method, solver=solver, options=options).solve(parameters, guess, check)
