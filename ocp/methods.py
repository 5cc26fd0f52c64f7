"""``solve(problem, method)``, and ``prepare`` for problems that are solved many times.

The certificate with a second solver of another kind: does it find the same plan?

The interior-point method that solves problems and an active-set method share no step: SLEQP (sequential linear programs
that name the active set, then equality-constrained quadratic ones; Byrd, Gould, Nocedal, Waltz 2004) finds its own
multipliers and its own active set.
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
from ocp.errors import ProblemError, SolveError, checked_flag, checked_time_limit
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem, checked_problem
from ocp.solution import ByName, Guess, Solution
from ocp.status import SolverStatus
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE

__all__ = ["Method", "PreparedProblem", "certificate", "prepare", "solve"]


@dataclass(frozen=True)
class DescentSettings:
    """How a plan that is stationary but no minimum is left.

    Attributes:
        descents: The most, one after the other.
        move: By which share of its spread along the plan, or of its range, or by how much, a plan is moved to start
            beside it.
    """

    descents: int = 3
    move: float = 0.1


SETTINGS = DescentSettings()


class PreparedProblem(Protocol):
    """A problem that a method has made ready to be solved many times."""

    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve with these parameters from this guess; see :func:`solve`."""
        ...


class Method(Protocol):
    """What solves problems: ``Collocation(...)``, ``MultipleShooting(...)``, ``Indirect(...)``."""

    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> PreparedProblem:
        """Build a problem once, to be solved many times; see :func:`prepare`."""
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
    """Build a problem once; the result's ``solve(parameters=, guess=)`` is called many times.

    Args:
        problem: What is asked. method: How it is transcribed.
        solver: ``ipopt``, ``fatrop`` (another interior-point method, whose linear algebra goes from stage to stage;
            slow to build, and takes no coupling of controls at the end) or ``sleqp`` (an active-set method, to confirm
            a plan, started there). For the indirect method, of the direct solution that seeds it.
        options: Passed to the solver, for example ``{"max_iter": 500}``.
        compiled: Whether the functions of the problem and their derivatives go through the machine's C compiler (that
            of the environment's CC, else cc), which makes solves several times faster and changes no number. What was
            compiled is kept for all meshes, processes and runs (``selfmotion cache``); what is not kept is compiled
            first, which takes seconds. Without a compiler functions are interpreted, which is told once; for sleqp
            they always are.
        scaling: Divide states, controls, horizon, constraints and cost by their sizes (:mod:`ocp.direct.scaling`) where
            these are far from 1; all that is reported stays in the units of the problem.

    Raises:
        ProblemError: The problem is not complete, or the method or solver cannot take it.
    """
    checked_problem(problem)
    if not callable(getattr(type(method), "prepare", None)):
        raise ProblemError(
            f"a method such as Collocation(...) is expected, not {method!r}", name="method", value=method
        )
    checked_flag("prepare: compiled", compiled)
    checked_flag("prepare: scaling", scaling)
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

    Where the solver fails from the guess, it starts again from zeros (moved inside the bounds, a free horizon longer),
    from a roll-out of the dynamics with the controls of the guess, and from the plan that misses the constraints least;
    each with at most 200 iterations and ``max_iter`` together. Where it stops at a plan that is stationary but no
    minimum, it starts again beside it, on both sides along the variation that lowers the cost, and the cheaper plan
    counts. ``Solution.start`` says what worked.

    Args:
        problem: What is asked. method: For example ``Collocation(intervals=20, degree=3)``.
        parameters: Value of every parameter by name.
        solver, options, scaling: See :func:`prepare`.
        guess: An earlier solution (of any grid or method), or a dictionary by name of values, functions of time, or
            samples (M, n) over the times ``"t"`` (M,); ``"horizon"`` for a free final time.
        check: Raise where the solver fails, after a second solve that finds what would have to give way; False runs it
            once, from the guess, and returns the unsuccessful solution with its status.
        time_limit: After so many seconds, the build and all starts included, the solver is stopped between two
            iterations, which counts as a failure; where it was not built by then there is no solution to return,
            whatever `check` says. None for no limit.

    Raises:
        ProblemError: The problem, method or arguments cannot be right.
        KeyboardInterrupt: Ctrl-C; the exception's ``solution``, where it has one, is the last iterate.
        SolveError: The solver failed from every start; names the constraints that cannot hold together, by how much and
            when, and the worst residuals by constraint, state and time. Or what it found is no minimum, and beside it
            there is none either.
    """
    checked_flag("solve: check", check)
    with time_limited(checked_time_limit(time_limit)):
        prepared = prepare(problem, method, solver=solver, options=options, scaling=scaling)
        solution = prepared.solve(parameters, guess, check)
        return descend(prepared, solution) if check and solution.regularised else solution


def descend(prepared: PreparedProblem, solution: Solution) -> Solution:
    """The plan, or a cheaper one beside it where its cost can be lowered along a feasible variation.

    Raises:
        SolveError: It can, but from beside it the solver finds no plan: the cost may have no least.
    """
    form = Formulation.of(solution.problem)
    p = form.parameter_vector(solution.parameters)
    bounds = form.bound_values(p)
    for _ in range(SETTINGS.descents):
        if not solution.regularised:
            break
        found = optimality(form, solution, p, bounds, allowed=np.inf).curvature
        if not found.least < -FLAT_SHARE:
            break
        others = [
            prepared.solve(solution.parameters, displaced_guess(form, solution, found, bounds, sign), check=False)
            for sign in (1.0, -1.0)
        ]
        plans = [other for other in others if other.success]
        if not plans and found.upwards is False:
            words = f"no minimum: the cost falls along a variation from {found.time or 0.0:.4g} s on"
            beyond = "; ".join(other.message for other in others)
            raise SolveError(
                f"problem {form.name!r}: the plan found, of cost {solution.cost:.6g}, is stationary but {words}; from "
                f"beside it the solver ended with {beyond}",
                replace(solution, success=False, status=SolverStatus.REJECTED, message=words),
                name="cost",
                value=solution.cost,
                time=found.time,
            )
        best = min([solution, *plans], key=lambda plan: plan.cost)
        if best is solution:
            break
        solution = replace(best, start="downhill")
    return solution


def displaced_guess(
    form: Formulation, solution: Solution, found: Curvature, bounds: Bounds, sign: float
) -> dict[str, Any]:
    """A guess: the plan moved along the variation that lowers its cost, as far as is visible in its own size.

    Where the cost falls but no variation is told, all controls are pushed by seeded random amounts.
    """
    breaks = solution.control_interpolant.breaks * solution.horizon
    times = np.union1d(breaks, found.t)
    here = times / solution.horizon
    plan = np.hstack([solution.state_interpolant(here), solution.control_interpolant(here)])
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control")])
    width = bounds[1][index] - bounds[0][index]
    spread = np.ptp(plan, axis=0)
    size = np.where(spread > 0, spread, np.where(np.isfinite(width) & (width > 0), width, np.inf))
    if found.direction is None:
        push = np.random.default_rng(0).normal(size=form.nu) * np.where(np.isfinite(size), size, 1.0)[form.nx :]
        move = np.hstack([np.zeros((len(times), form.nx)), np.tile(push, (len(times), 1))])
    else:
        controls, states = found.direction
        curves = [*((breaks, column) for column in states.T), *((found.t, column) for column in controls.T)]
        move = np.column_stack([np.interp(times, at, column) for at, column in curves])
    share = float((np.abs(move) / size).max(initial=0.0)) or float(np.abs(move).max(initial=0.0))
    moved = plan + sign * SETTINGS.move / share * move
    places = {**form.states, **{name: slice(s.start + form.nx, s.stop + form.nx) for name, s in form.controls.items()}}
    guess: dict[str, Any] = {name: Samples(times, moved[:, place]) for name, place in places.items()}
    return guess | {"horizon": solution.horizon}


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
