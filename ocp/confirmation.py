"""The certificate with a second solver of another kind: does it find the same plan?

The interior-point method that solves problems and an active-set method share no step: SLEQP (sequential linear programs
that name the active set, then equality-constrained quadratic ones; Byrd, Gould, Nocedal, Waltz 2004) finds its own
multipliers and its own active set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ocp.audit import certificate as comparison
from ocp.audit.certificate import Certificate
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.direct.shooting import MultipleShooting
from ocp.errors import ProblemError, checked_flag
from ocp.methods import prepare
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tolerances import LIMIT_SHARE

__all__ = ["certificate"]

SECOND = "sleqp"
METHODS = {"Collocation": Collocation, "MultipleShooting": MultipleShooting}


@interruptible
def certificate(
    problem: Problem,
    solutions: Mapping[str, Solution] | Sequence[Solution],
    *,
    tolerance: float = LIMIT_SHARE,
    second_solver: bool = False,
) -> Certificate:
    """Compare solutions of one problem by different methods, and audit each.

    Args:
        problem: The problem that all of them solve.
        solutions: By name, or a sequence named after their methods. The reference is the first indirect one, else the
            first.
        tolerance: Largest relative difference at which they agree.
        second_solver: Solve the program of the first direct one again with another kind of solver, from that plan, and
            compare what it ends with as one more solution, ``NAME, by sleqp``; then one solution is enough.

    Raises:
        ProblemError: Fewer than two solutions, one of another problem, or solved at other parameters; no direct one for
            a second solver.
    """
    if not checked_flag("certificate: second_solver", second_solver):
        return comparison.certificate(problem, solutions, tolerance=tolerance)
    named = comparison.checked_solutions(solutions)
    direct = [name for name, solution in named.items() if solution.method["type"] in METHODS]
    if not direct:
        words = "a second solver confirms plans of Collocation(...) and MultipleShooting(...); none is given"
        raise ProblemError(words, name="solutions", value=[*named])
    plan = named[direct[0]]
    settings = dict(plan.method)
    method = METHODS[settings.pop("type")](**settings)
    other = prepare(problem, method, solver=SECOND).solve(plan.parameters, plan, check=False)
    return comparison.certificate(problem, {**named, f"{direct[0]}, by {SECOND}": other}, tolerance=tolerance)
