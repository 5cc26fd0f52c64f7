"""``solve(problem, method)``, and ``prepare`` for problems that are solved many times."""

from __future__ import annotations

from typing import Protocol

from ocp.errors import ProblemError, checked_flag
from ocp.problem.problem import Problem, checked_problem
from ocp.solution import ByName, Guess, Solution

__all__ = ["Method", "PreparedProblem", "prepare", "solve"]


class PreparedProblem(Protocol):
    """A problem that a method has made ready to be solved many times."""

    def solve(self, parameters: ByName = None, guess: Guess = None, check: bool = True) -> Solution:
        """Solve with these parameters from this guess; see :func:`solve`."""
        ...


class Method(Protocol):
    """What solves problems: ``Collocation(...)``, ``MultipleShooting(...)``, ``Indirect(...)``."""

    def prepare(
        self, problem: Problem, *, solver: str = "ipopt", options: ByName = None, compiled: bool = False
    ) -> PreparedProblem:
        """Build a problem once, to be solved many times; see :func:`prepare`."""
        ...


def prepare(
    problem: Problem, method: Method, *, solver: str = "ipopt", options: ByName = None, compiled: bool = False
) -> PreparedProblem:
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
    checked_problem(problem)
    if not callable(getattr(type(method), "prepare", None)):
        raise ProblemError(
            f"a method such as Collocation(...) is expected, not {method!r}", name="method", value=method
        )
    checked_flag("prepare: compiled", compiled)
    return method.prepare(problem, solver=solver, options=options, compiled=compiled)


def solve(
    problem: Problem,
    method: Method,
    *,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
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
    checked_flag("solve: check", check)
    return prepare(problem, method, solver=solver, options=options).solve(parameters, guess, check)
