"""Functions ``solve(problem, method)``, ``prepare`` for repeated solves, and ``certificate`` to compare methods.

The interior-point method that solves problems and SLEQP, the second solver that confirms a plan, have no step in
common: SLEQP (sequential linear programs that determine the active set, then equality-constrained quadratic programs;
Byrd, Gould, Nocedal, Waltz 2004) finds its own multipliers and its own active set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import casadi as ca
import numpy as np

from ocp.audit.audit import Audit, audit
from ocp.audit.curvature import Curvature
from ocp.audit.linearisation import Linearisation
from ocp.audit.optimality import optimality
from ocp.console import interruptible, time_limited
from ocp.direct.guess import Samples
from ocp.direct.sensitivity import METHODS
from ocp.errors import ProblemError, SolveError, SolverStatus, checked_time_limit, require
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem, checked_problem
from ocp.solution import ByName, Guess, Solution
from ocp.solution_data import call_registered, check_variables_match
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE


@dataclass(frozen=True)
class DescentSettings:
    """Settings of the descent from a stationary plan that is not a minimum.

    ``descents`` is the maximum number of descents. ``move`` is the displacement of the guess, relative to the range of
    the plan or of its bounds (absolute if there is no such range).
    """

    descents: int = 3
    move: float = 0.1


SETTINGS = DescentSettings()


class PreparedProblem(Protocol):
    """Interface of a problem that a method has prepared for repeated solves."""

    def solve(
        self, parameters: ByName = None, guess: Guess = None, check: bool = True, *, time_limit: float | None = None
    ) -> Solution:
        """Solve the prepared problem with given parameters from a given guess; see :func:`ocp.methods.solve`."""
        ...


P = TypeVar("P", bound=PreparedProblem)
P_co = TypeVar("P_co", bound=PreparedProblem, covariant=True)


class Method(Protocol[P_co]):
    """Interface of a method that solves problems, such as ``Collocation``, ``MultipleShooting`` or ``Indirect``."""

    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> P_co:
        """Prepare a problem for repeated solves by this method; the function :func:`ocp.methods.prepare` calls it."""
        ...


@interruptible
def prepare(
    problem: Problem,
    method: Method[P],
    *,
    solver: str = "ipopt",
    options: ByName = None,
    compiled: bool = False,
    scaling: bool = True,
) -> P:
    """Prepare a problem once, and return an object whose method ``solve`` can be called repeatedly.

    Args:
        problem: The problem. method: How it is transcribed.
        solver: ``ipopt``, ``fatrop`` (another interior-point method, whose linear algebra exploits the stage structure;
            slow to build, and without conditions on controls at the end) or ``sleqp`` (an active-set method, to
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
    method: Method[PreparedProblem] | None = None,
    *,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
    check: bool = True,
    time_limit: float | None = None,
) -> Solution:
    """Solve an optimal control problem by a given method, by default by collocation with mesh refinement.

    Without a method the cost is accurate to six digits (:class:`ocp.adaptive.AdaptiveCollocation`), and
    ``Solution.refinement`` states whether the audit passes. A solve by a given method proceeds as follows.

    If the solver fails from the guess, it starts again from the guess displaced by seeded random amounts, from zeros
    (moved inside the bounds, a free horizon longer), from a roll-out of the dynamics with the controls of the guess,
    and from the plan of least constraint violation; each with at most 200 iterations and ``max_iter`` together. If it
    stops at a stationary plan that is not a minimum, it starts again on both sides of it, along the variation that
    lowers the cost, and the plan of lower cost counts.
    ``Solution.start`` names the successful start.

    Args:
        problem: The problem.
        method: For example ``Collocation(intervals=20, degree=3)``; None for ``AdaptiveCollocation()``.
        parameters: Value of every parameter by name.
        solver, options: See :func:`prepare`.
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
        chosen = call_registered("default_method") if method is None else method
        prepared = prepare(problem, chosen, solver=solver, options=options)
        solution = prepared.solve(parameters, guess, check)
        return descend(prepared, solution) if check else solution


def descend(prepared: PreparedProblem, solution: Solution) -> Solution:
    """Return the given solution, or a nearby solution of lower cost if a feasible variation lowers the cost.

    Raises:
        SolveError: There is such a variation, but the solver finds no plan along it: the cost may be unbounded below.
    """
    form = Formulation.of(solution.problem)
    for _ in range(SETTINGS.descents):
        if not solution.regularised:
            break
        along = Linearisation(form, solution)
        curvature = optimality(along, np.inf).curvature
        if not curvature.least < -FLAT_SHARE:
            break
        attempts = [
            prepared.solve(solution.parameters, _displaced_guess(along, curvature, sign), check=False)
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


def _displaced_guess(along: Linearisation, curvature: Curvature, sign: float) -> dict[str, Any]:
    """Return an initial guess: the plan plus or minus (``sign``) a variation of the plan that lowers the cost.

    If the variation is unknown, all controls are displaced by seeded random amounts.
    """
    form, solution, bounds = along.form, along.solution, along.bounds
    breaks = along.mesh * solution.horizon
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


# ---- certificate -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """Differences between a solution and the reference solution, relative to the size of the reference.

    The reference size of the Hamiltonian is that of its terms, and the size of the cost is at least that of the running
    cost, since both values may vanish.

    Attributes:
        name, passed: Name of the solution, and whether its audit passed.
        cost, horizon: Cost and final time (s) of the solution.
        cost_difference, horizon_difference: Relative differences.
        state, costate: Largest difference over time.
        control, hamiltonian: Mean difference over time: at a jump, solutions with slightly different switching times
            differ by the full jump.
    """

    name: str
    passed: bool
    cost: float
    horizon: float
    cost_difference: float
    horizon_difference: float
    state: float
    control: float
    costate: float
    hamiltonian: float

    @property
    def worst(self) -> float:
        """The largest difference of any kind between the solution and the reference."""
        differences = (self.cost_difference, self.horizon_difference, self.state, self.control, self.costate)
        return max(*differences, self.hamiltonian)


@dataclass(frozen=True)
class Certificate:
    """Comparison of the solutions of one problem by several methods, including the audit of each solution.

    Attributes:
        problem: Name of the problem.
        reference: Name of the solution that the others are compared with.
        comparisons: Comparison of each solution with the reference; the reference itself comes first.
        tolerance: Largest relative difference at which solutions agree.
        audits: The audit of each solution by name.
    """

    problem: str
    reference: str
    comparisons: tuple[Comparison, ...]
    tolerance: float
    audits: dict[str, Audit]

    @property
    def passed(self) -> bool:
        """Whether all solutions agree and every audit passed."""
        return all(c.passed and c.worst <= self.tolerance for c in self.comparisons)

    @property
    def verdict(self) -> str:
        """The result of the comparison in one sentence."""
        if self.passed:
            return f"{len(self.comparisons)} solutions agree to {self.tolerance:g}, and each passed its audit"
        different = ", ".join(c.name for c in self.comparisons if not c.worst <= self.tolerance)
        failed = ", ".join(c.name for c in self.comparisons if not c.passed)
        parts = [f"{different} differ from {self.reference} by more than {self.tolerance:g}"] if different else []
        return "; ".join([*parts, *([f"the audit of {failed} failed"] if failed else [])])

    def __repr__(self) -> str:
        return f"<Certificate of {self.problem!r}: {self.verdict}>"

    def __str__(self) -> str:
        width = max(len(c.name) for c in self.comparisons)
        head = ("cost", "d cost", "d state", "d control", "d costate", "d H")
        lines = [f"Certificate of {self.problem!r}: {'passed' if self.passed else 'FAILED'}"]
        lines.append(f"  {'solution':<{width}}  {head[0]:>15}" + "".join(f"  {h:>9}" for h in head[1:]) + "  audit")
        for c in self.comparisons:
            values = (c.cost_difference, c.state, c.control, c.costate, c.hamiltonian)
            row = "".join(f"  {v:>9.1e}" for v in values)
            lines.append(f"  {c.name:<{width}}  {c.cost:>15.12g}{row}  {'passed' if c.passed else 'FAILED'}")
        lines.append(f"  differences are relative to {self.reference}; {self.verdict}")
        return "\n".join(lines)


SECOND_SOLVER = "sleqp"


@interruptible
def certificate(
    problem: Problem,
    solutions: Mapping[str, Solution] | Sequence[Solution],
    *,
    tolerance: float = LIMIT_SHARE,
    second_solver: bool = False,
) -> Certificate:
    """Compare solutions of one problem that different methods found, and audit each solution.

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
    require.positive("certificate: tolerance", tolerance)
    named = checked_solutions(solutions)
    if require.flag("certificate: second_solver", second_solver):
        direct = [name for name, solution in named.items() if solution.method["type"] in METHODS]
        if not direct:
            words = "a second solver confirms plans of Collocation(...) and MultipleShooting(...); there is none"
            raise ProblemError(words, name="solutions", value=[*named])
        plan = named[direct[0]]
        settings = dict(plan.method)
        method = METHODS[settings.pop("type")](**settings)
        confirmation = prepare(problem, method, solver=SECOND_SOLVER).solve(plan.parameters, plan, check=False)
        named[f"{direct[0]}, by {SECOND_SOLVER}"] = confirmation
    if len(named) < 2:
        words = f"a certificate compares at least two solutions, not {len(named)}"
        raise ProblemError(words, name="solutions", value=len(named), limit=2)
    form = Formulation.of(problem)
    for solution in named.values():
        check_variables_match(form, solution)
    order = sorted(named, key=lambda name: named[name].method["type"] != "Indirect")  # stable: indirect first
    reference = order[0]
    p = form.parameter_vector(named[reference].parameters)
    for name, solution in named.items():
        if not np.array_equal(form.parameter_vector(solution.parameters), p):
            raise ProblemError(f"plans {reference!r} and {name!r} were solved at different parameters", name=name)
    audits = {name: audit(problem, named[name]) for name in order}
    first = named[reference]
    fractions = (np.arange(400) + 0.5) / 400
    comparisons = []
    for name in order:
        solution = named[name]
        reported = solution.t[:-1] / solution.horizon  # costates are best where they are reported
        values, _, _ = _sample(form, solution, p, fractions, reported)
        expected, hamiltonian_size, running_size = _sample(form, first, p, fractions, reported)
        differences = [difference(a, b) for a, b in zip(values[:3], expected[:3], strict=True)]
        differences.append(np.abs(values[3] - expected[3]) / (hamiltonian_size or 1.0))
        size = max(abs(first.cost), running_size * first.horizon) or 1.0
        comparisons.append(
            Comparison(
                name,
                audits[name].passed,
                solution.cost,
                solution.horizon,
                abs(solution.cost - first.cost) / size,
                abs(solution.horizon - first.horizon) / first.horizon,
                float(np.max(differences[0], initial=0.0)),
                float(np.max(np.mean(differences[1], axis=0), initial=0.0)),
                float(np.max(differences[2], initial=0.0)),
                float(np.mean(differences[3])),
            )
        )
    return Certificate(problem.name, reference, tuple(comparisons), tolerance, audits)


def checked_solutions(solutions: Any) -> dict[str, Solution]:
    """Return solutions by name, named after their methods (``Collocation legendre-3, 50``) if they have no names."""
    if isinstance(solutions, Mapping):
        require.each("certificate: solutions", solutions.values(), Solution)
        return require.mapping("certificate: solutions", solutions)
    named: dict[str, Solution] = {}
    for solution in require.each("certificate: solutions", solutions, Solution):
        method = solution.method
        detail = {
            "Collocation": f" {method.get('scheme')}-{method.get('degree')}, {method.get('intervals')}",
            "MultipleShooting": f" {method.get('integrator')} {method.get('control')}, {method.get('intervals')}",
            "Indirect": f" {method.get('shooting')}, {method.get('segments')}",
        }.get(method["type"], "")
        name = base = method["type"] + detail
        while name in named:
            name = f"{base} ({2 + sum(other.startswith(f'{base} (') for other in named)})"
        named[name] = solution
    return named


def _sample(
    form: Formulation, solution: Solution, p: np.ndarray, fractions: np.ndarray, reported: np.ndarray
) -> tuple[list[np.ndarray], float, float]:
    """Return a solution's states and controls at ``fractions`` of the horizon, its costates and Hamiltonian at
    ``reported`` fractions, and the magnitudes of its Hamiltonian and of its running cost.

    The magnitudes are the largest sum of the absolute terms of the Hamiltonian, which itself vanishes for a free
    horizon, and the mean absolute running cost.
    """
    lam = solution.costate_interpolant(reported)
    symbol = form.sym("lam", form.nx)
    x, u = solution.state_interpolant(reported), solution.control_interpolant(reported)
    expressions = [ca.vertcat(form.running, symbol * form.f)]
    values = form.sampled(expressions, x, u, reported * solution.horizon, solution.horizon, p, (symbol, lam))[0]
    hamiltonian, size = values.sum(axis=1), float(np.max(np.abs(values).sum(axis=1), initial=0.0))
    x, u = solution.state_interpolant(fractions), solution.control_interpolant(fractions)
    running = form.sampled([form.running], x, u, fractions * solution.horizon, solution.horizon, p)[0]
    return [x, u, lam, hamiltonian], size, float(np.mean(np.abs(running)))


def difference(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the absolute differences of values from a reference, relative to the reference's largest magnitude."""
    size = float(np.max(np.abs(reference), initial=0.0))
    return np.asarray(np.abs(values - reference) / (size if size > 0 else 1.0))
