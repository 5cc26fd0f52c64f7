"""``solve(problem, method)``, ``prepare`` for repeated solves, and ``certificate`` for the comparison of methods.

A second solver of another kind confirms a plan. The interior-point method that solves problems and the active-set
method SLEQP have no step in common: SLEQP (sequential linear programs that determine the active set, then
equality-constrained quadratic programs; Byrd, Gould, Nocedal, Waltz 2004) finds its own multipliers and its own active
set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ocp.audit import certificate as comparison
from ocp.audit.certificate import Certificate
from ocp.audit.curvature import Curvature
from ocp.audit.optimality import optimality
from ocp.console import interruptible, time_limited
from ocp.direct.collocation import Collocation
from ocp.direct.guess import Samples
from ocp.direct.shooting import MultipleShooting
from ocp.errors import ProblemError, SolveError, checked_time_limit, require
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem, checked_problem
from ocp.solution import ByName, Guess, Solution
from ocp.status import SolverStatus
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE

__all__ = ["Method", "PreparedProblem", "certificate", "prepare", "solve"]


@dataclass(frozen=True)
class DescentSettings:
    """Settings of the descent from a stationary plan that is not a minimum.

    Attributes:
        descents: Maximum number of consecutive descents.
        move: Displacement of the new guess, relative to the range of the plan or of its bounds, or absolute without
            either.
    """

    descents: int = 3
    move: float = 0.1


SETTINGS = DescentSettings()


class PreparedProblem(Protocol):
    """A problem that a method has prepared for repeated solves."""

    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve with these parameters from this guess; see :func:`solve`."""
        ...


class Method(Protocol):
    """A method of solution: ``Collocation(...)``, ``MultipleShooting(...)``, ``Indirect(...)``."""

    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> PreparedProblem:
        """Build a problem once for repeated solves; see :func:`prepare`."""
        ...


@interruptible
def prepare(
    problem: Problem,
    method: Method,
    *,
    solver: str = "ipopt",
    options: ByName = None,
    compiled: bool = False,
    scaling: bool = True,
) -> PreparedProblem:
    """Build a problem once; call the result's ``solve(parameters=, guess=)`` repeatedly.

    Args:
        problem: The problem. method: How it is transcribed.
        solver: ``ipopt``, ``fatrop`` (another interior-point method, whose linear algebra exploits the stage structure;
            slow to build, and without terms that couple controls at the end) or ``sleqp`` (an active-set method, to
            confirm a plan from which it starts). For the indirect method, the solver of the direct solution that seeds
            it.
        options: Options of the solver, for example ``{"max_iter": 500}``.
        compiled: Whether the functions of the problem and their derivatives are compiled by the machine's C compiler
            (that of the environment's CC, else cc), which makes solves several times faster and changes no number.
            Compiled functions are cached for all meshes, processes and runs (``selfmotion cache``); the first
            compilation takes seconds. Without a compiler functions are interpreted, with one warning; for sleqp they
            always are.
        scaling: Divide states, controls, horizon, constraints and cost by their sizes (:mod:`ocp.direct.scaling`) if
            these are far from 1; all results stay in the units of the problem.

    Raises:
        ProblemError: The problem is incomplete, or not supported by the method or solver.
    """
    checked_problem(problem)
    if not callable(getattr(type(method), "prepare", None)):
        raise ProblemError(
            f"a method such as Collocation(...) is expected, not {method!r}", name="method", value=method
        )
    require.flag("prepare: compiled", compiled)
    require.flag("prepare: scaling", scaling)
    return method.prepare(problem, solver=solver, options=options, compiled=compiled, scaling=scaling)


@interruptible
def solve(
    problem: Problem,
    method: Method,
    *,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
    check: bool = True,
    scaling: bool = True,
    time_limit: float | None = None,
) -> Solution:
    """Solve a problem by a method.

    If the solver fails from the guess, it starts again from zeros (moved inside the bounds, a free horizon longer),
    from a roll-out of the dynamics with the controls of the guess, and from the plan of least constraint violation;
    each with at most 200 iterations and ``max_iter`` together. If it stops at a stationary plan that is not a minimum,
    it starts again on both sides of it, along the variation that lowers the cost, and the plan of lower cost counts.
    ``Solution.start`` names the successful start.

    Args:
        problem: The problem. method: For example ``Collocation(intervals=20, degree=3)``.
        parameters: Value of every parameter by name.
        solver, options, scaling: See :func:`prepare`.
        guess: An earlier solution (of any grid or method), or a dictionary by name of values, functions of time, or
            samples (M, n) over the times ``"t"`` (M,); ``"horizon"`` for a free final time.
        check: Raise SolveError after a failure, with a second solve that finds the conflicting constraints. False runs
            the solver once, from the guess, and returns an unsuccessful solution with its status.
        time_limit: Time in s for the build and all starts, after which the solver stops at the next iteration and
            counts as failed. If the build is not finished by then, SolveError is raised regardless of `check`. None for
            no limit.

    Raises:
        ProblemError: The problem, method or arguments are invalid.
        KeyboardInterrupt: Ctrl-C; the exception's ``solution``, if any, is the last iterate.
        SolveError: The solver failed from every start; names the conflicting constraints, by how much and when, and the
            worst residuals by constraint, state and time. Or the plan is not a minimum, and no minimum was found near
            it.
    """
    require.flag("solve: check", check)
    with time_limited(checked_time_limit(time_limit)):
        prepared = prepare(problem, method, solver=solver, options=options, scaling=scaling)
        solution = prepared.solve(parameters, guess, check)
        return descend(prepared, solution) if check and solution.regularised else solution


def descend(prepared: PreparedProblem, solution: Solution) -> Solution:
    """Return the plan, or one of lower cost if a feasible variation lowers its cost.

    Raises:
        SolveError: There is such a variation, but the solver finds no plan along it: the cost may be unbounded below.
    """
    form = Formulation.of(solution.problem)
    p = form.parameter_vector(solution.parameters)
    bounds = form.bound_values(p)
    for _ in range(SETTINGS.descents):
        if not solution.regularised:
            break
        curvature = optimality(form, solution, p, bounds, allowed=np.inf).curvature
        if not curvature.least < -FLAT_SHARE:
            break
        attempts = [
            prepared.solve(solution.parameters, displaced_guess(form, solution, curvature, bounds, sign), check=False)
            for sign in (1.0, -1.0)
        ]
        plans = [attempt for attempt in attempts if attempt.success]
        if not plans and curvature.upwards is False:
            words = f"no minimum: the cost falls along a variation from {curvature.time or 0.0:.4g} s on"
            ends = "; ".join(attempt.message for attempt in attempts)
            raise SolveError(
                f"problem {form.name!r}: the plan, of cost {solution.cost:.6g}, is stationary but {words}; solves from "
                f"guesses on both sides of it ended with {ends}",
                replace(solution, success=False, status=SolverStatus.REJECTED, message=words),
                name="cost",
                value=solution.cost,
                time=curvature.time,
            )
        best = min([solution, *plans], key=lambda plan: plan.cost)
        if best is solution:
            break
        solution = replace(best, start="downhill")
    return solution


def displaced_guess(
    form: Formulation, solution: Solution, curvature: Curvature, bounds: Bounds, sign: float
) -> dict[str, Any]:
    """Return the plan displaced along the variation that lowers its cost, by a visible share of its size.

    If the variation is unknown, all controls are displaced by seeded random amounts.
    """
    breaks = solution.control_interpolant.breaks * solution.horizon
    times = np.union1d(breaks, curvature.t)
    fractions = times / solution.horizon
    plan = np.hstack([solution.state_interpolant(fractions), solution.control_interpolant(fractions)])
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control")])
    width = bounds[1][index] - bounds[0][index]
    spread = np.ptp(plan, axis=0)
    size = np.where(spread > 0, spread, np.where(np.isfinite(width) & (width > 0), width, np.inf))
    if curvature.direction is None:
        pulse = np.random.default_rng(0).normal(size=form.nu) * np.where(np.isfinite(size), size, 1.0)[form.nx :]
        variation = np.hstack([np.zeros((len(times), form.nx)), np.tile(pulse, (len(times), 1))])
    else:
        controls, states = curvature.direction
        curves = [*((breaks, column) for column in states.T), *((curvature.t, column) for column in controls.T)]
        variation = np.column_stack([np.interp(times, at, column) for at, column in curves])
    share = float((np.abs(variation) / size).max(initial=0.0)) or float(np.abs(variation).max(initial=0.0))
    displaced = plan + sign * SETTINGS.move / share * variation
    places = {**form.states, **{name: slice(s.start + form.nx, s.stop + form.nx) for name, s in form.controls.items()}}
    guess: dict[str, Any] = {name: Samples(times, displaced[:, place]) for name, place in places.items()}
    return guess | {"horizon": solution.horizon}


SECOND_SOLVER = "sleqp"
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
        problem: The common problem.
        solutions: By name, or a sequence named after their methods. The reference is the first indirect one, else the
            first.
        tolerance: Largest relative difference of solutions that agree.
        second_solver: Solve the program of the first direct solution again by another kind of solver, started at that
            plan, and compare the result as one more solution, ``NAME, by sleqp``; then one solution is enough.

    Raises:
        ProblemError: Fewer than two solutions, solutions of other problems or other parameters; no direct one for a
            second solver.
    """
    if not require.flag("certificate: second_solver", second_solver):
        return comparison.certificate(problem, solutions, tolerance=tolerance)
    by_name = comparison.checked_solutions(solutions)
    direct = [name for name, solution in by_name.items() if solution.method["type"] in METHODS]
    if not direct:
        words = "a second solver confirms plans of Collocation(...) and MultipleShooting(...); there is none"
        raise ProblemError(words, name="solutions", value=[*by_name])
    plan = by_name[direct[0]]
    settings = dict(plan.method)
    method = METHODS[settings.pop("type")](**settings)
    confirmation = prepare(problem, method, solver=SECOND_SOLVER).solve(plan.parameters, plan, check=False)
    return comparison.certificate(
        problem, {**by_name, f"{direct[0]}, by {SECOND_SOLVER}": confirmation}, tolerance=tolerance
    )
