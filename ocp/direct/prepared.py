"""Direct methods, and problems prepared once for a method and a solver, to be solved many times."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from ocp.console import TimeLimitReached, check_time, interruptible, time_limited
from ocp.direct.active_set import Newton, active_sides
from ocp.direct.assembly import Program, assemble
from ocp.direct.code_generation import block_derivatives, write_problem
from ocp.direct.controller import Controller, ControllerSettings
from ocp.direct.diagnosis import Elastic, diagnosis, elastic_plan
from ocp.direct.guess import STARTS, alternative_starts, displace, guessed_names, initial_point, shifted_indices
from ocp.direct.nlp import SOLVERS, Outcome, broken_down, build_solver, call_solver, iteration_limit, solution_of
from ocp.direct.scaling import (
    Pattern,
    PredeterminedVariables,
    Scales,
    Sizes,
    compute_scales,
    scaled_program,
    scaling_fault,
    sizes_along,
    unit_scales,
)
from ocp.direct.transcription import MeshedMethod
from ocp.errors import Interrupted, ProblemError, SolveError, SolverStatus, checked_time_limit, require
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.problem import Problem
from ocp.solution import ByName, Guess, Solution
from ocp.storage import checked_path


class DirectMethod(MeshedMethod):
    """A direct method, which prepares a problem once, as a nonlinear program, for repeated solves."""

    @interruptible
    def prepare(
        self,
        problem: Problem,
        *,
        solver: str = "ipopt",
        options: ByName = None,
        compiled: bool = False,
        scaling: bool = True,
    ) -> Prepared:
        """Prepare a problem for repeated solves; see :func:`ocp.methods.prepare`.

        Raises:
            SolveError: The time limit of an enclosing call is over.
        """
        try:
            return Prepared(problem, self, solver, options, compiled=compiled, scaling=scaling)
        except TimeLimitReached as error:
            words = f"problem {problem.name!r} was still being built: {SolverStatus.TIME_LIMIT}: raise time_limit"
            raise SolveError(words, name="time_limit") from error


class Prepared:
    """A problem prepared by a direct method for repeated solves; only one thread solves it at a time.

    Attributes:
        problem, method: The problem and the method.
        formulation, transcription, program: The stacked problem, its transcription and its nonlinear program.
        solver_name: Name of the solver.
        seconds: Wall time of the preparation.
    """

    def __init__(
        self,
        problem: Problem,
        method: DirectMethod,
        solver: str,
        options: ByName,
        *,
        compiled: bool = False,
        scaling: bool = True,
    ) -> None:
        began = time.monotonic()
        self.problem, self.method = problem, method
        self.formulation = Formulation.of(problem)
        require.choice("solver", solver, SOLVERS)
        own = require.mapping("options", options)
        self._options, self._scaling = own, scaling
        self.solver_name = solver
        self.transcription = method.transcribe(self.formulation, staged=solver == "fatrop")
        # sleqp uses products with the Hessian, which compiled functions do not provide
        blocks = block_derivatives(self.transcription, compiled and solver != "sleqp")
        self.program = assemble(self.transcription, self.formulation.np, blocks)
        check_time()
        self._solver, self._progress = self._built_solver(own)
        check_time()
        self._pattern = Pattern(self.formulation, self.transcription, self.program)
        self._known = PredeterminedVariables(self.formulation, self.transcription, self.program)
        self._max_iterations = iteration_limit(self.solver_name, own)
        self._arguments, self.compiled = (problem, method, solver, options), compiled
        self._lock = threading.RLock()  # casadi functions are not reentrant
        self.seconds = time.monotonic() - began

    @cached_property
    def scaled(self) -> Program:
        """The nonlinear program in scaled variables; see :func:`ocp.direct.scaling.scaled_program`."""
        return scaled_program(self.program)

    def _built_solver(self, options: dict[str, Any]) -> tuple[Any, Any]:
        """Return the solver with given options, and the callback by which the solver can be stopped."""
        return build_solver(
            self.scaled, self.solver_name, options, stages=self.transcription.stages, title=self.problem.name
        )

    def __reduce__(self) -> Any:
        """Represent the object for pickling and copying by its arguments, from which it is prepared again."""
        return partial(type(self), compiled=self.compiled, scaling=self._scaling), self._arguments

    @interruptible
    def solve(
        self,
        parameters: ByName = None,
        guess: Guess = None,
        check: bool = True,
        *,
        tighter: Mapping[str, np.ndarray] | None = None,
        time_limit: float | None = None,
        shift: int = 0,
        start: str = "guess",
    ) -> Solution:
        """Solve the prepared problem with given parameters from a given guess; see :func:`ocp.methods.solve`.

        If the guess is a plan of this problem, method and mesh, its active limits are equalities at first, and a few
        Newton steps determine the solution (:mod:`ocp.direct.active_set`; ``Solution.solver`` is ``newton``). If they
        do not converge, ipopt starts from the guess as usual. Solves in several threads run one after the other.

        Args:
            parameters, guess: Values by name, and the start.
            check: Try alternative starts if the solver fails from the guess, and raise an error if all fail. Otherwise
                run the solver once and return its last iterate in any case, for loops that check ``success``.
            tighter: Amount by which each inequality bound of the program (lbx, ubx, lbg, ubg) is tightened.
            time_limit: Wall time, s.
            shift: Number of intervals by which a receding horizon has advanced since the guess, a plan on equal
                intervals. Each interval starts from the values, limits and multipliers of the plan so many intervals
                later; the last intervals start from their own values.
            start: ``guess``, or ``displaced guess``: displaced by seeded random shares of the sizes of the variables.

        Raises:
            ProblemError: Wrong arguments.
            SolveError: No plan was found, with the reasons.
        """
        ahead = require.count("solve: shift", shift, least=0, most=self.method.intervals - 1)
        if ahead and not (self.is_own_plan(guess) and self.method.mesh is None):
            words = "solve: shift requires as guess a plan of this problem, method and mesh, with equal intervals"
            raise ProblemError(words, name="shift", value=shift)
        with time_limited(checked_time_limit(time_limit)), self._lock:
            require.choice("solve: start", start, ("guess", "displaced guess"))
            return self._solve(parameters, guess, check, tighter, ahead, start)

    @interruptible
    def to_c(self, folder: str | os.PathLike[str], parameters: ByName = None, guess: Guess = None) -> Path:
        """Write a plan and the functions of the problem as C code, with an example main program that uses them.

        Args:
            folder: Folder that is created and returned; files of the same names are replaced. Its contents are listed
                in :mod:`ocp.direct.code_generation`.
            parameters: Values at which the guess is evaluated.
            guess: As of :meth:`solve`. A solution of this prepared problem is written as it is.

        Raises:
            ProblemError: Wrong arguments, or a part of the problem cannot be written as C code, such as cvodes.
            OSError: The folder cannot be written.
        """
        form, transcription = self.formulation, self.transcription
        place = Path(checked_path(folder))
        bounds = form.bound_values(form.parameter_vector(require.mapping("parameters", parameters)))
        with self._lock:
            point = initial_point(form, transcription, guess, bounds)
            if isinstance(guess, Solution) and guess.method == self.method.settings:
                # on this grid; a staged layout has more variables than a plain one
                point = guess.variables if guess.variables.size == point.size else point
            return write_problem(form, transcription, point, place)

    def controller(
        self,
        plan: Solution,
        *,
        iterations: int = 5,
        qp_iterations: int = 100,
        hessian: str = "gauss-newton",
        tolerance: float = 1e-6,
        shift: int = 1,
    ) -> Controller:
        """Return a model predictive controller, each step of which takes a bounded number of iterations.

        ``controller.step(parameters)`` solves the problem for the measured state and other parameters from the result
        of the last step, and returns the control to apply, the prediction, and what is known of its feasibility.

        Args:
            plan: Solution of this prepared problem, from which the first step starts.
            iterations: Largest number of iterations of sequential quadratic programming in an attempt. A step has one
                attempt, or two if the result of the first one violates dynamics or limits by more than the tolerance.
            qp_iterations: Largest number of changes of the active set in a quadratic program.
            hessian: ``gauss-newton`` (linear convergence, also far from the optimum) or ``exact`` (quadratic
                convergence near an optimum).
            tolerance: Largest violation and residual of a converged step, in the units of the problem.
            shift: Number of mesh intervals by which the horizon advances from step to step. 0 if the period of control
                is not that of the mesh.

        Raises:
            ProblemError: Wrong arguments.
        """
        settings = ControllerSettings(iterations, qp_iterations, hessian, tolerance, shift)
        with self._lock:
            return Controller(self, plan, settings)

    def _solve(
        self,
        parameters: ByName,
        guess: Guess,
        check: bool,
        tighter: Mapping[str, np.ndarray] | None,
        shift: int,
        start: str,
    ) -> Solution:
        """Solve by Newton's method if the guess is a plan; else, or if it fails, by the solver: from the guess, from
        alternative initial points, and last from the plan of least constraint violation.
        """
        form, transcription = self.formulation, self.transcription
        p = form.parameter_vector(require.mapping("parameters", parameters))
        bounds = form.bound_values(p)
        arguments = transcription.arguments(p, bounds_to_solve(form, p))
        if tighter is not None:
            tighten_bounds(arguments, tighter)
        nearby = self._nearby(guess, arguments, bounds, shift)
        if nearby is not None:
            return nearby
        point = initial_point(form, transcription, guess, bounds)
        if shift and isinstance(guess, Solution):
            point = guess.variables[shifted_indices(transcription, shift)[0]]
        names = guessed_names(form, guess)
        if start != "guess":
            point = displace(transcription, point, self._sizes(point, names, bounds, p).of_variables(transcription))
        first = self._attempt(start, point, names, arguments, bounds)
        if first.solution is not None and (first.outcome.success or not check):
            return first.solution
        attempts: list[Attempt] = [first, *(self._alternative_attempts(first, arguments, bounds) if check else ())]
        if attempts[-1].plan is not None:
            return attempts[-1].plan
        elastic = None if attempts[-1].is_final else self._elastic(first)
        remaining = self._max_iterations - sum(attempt.outcome.iterations for attempt in attempts[1:])
        if elastic is not None and check and remaining > 0:
            relaxed = "elastic plan", elastic.plan, self._variable_names
            attempts.append(self._attempt(*relaxed, arguments, bounds, self._short_solver))
            if attempts[-1].plan is not None:
                return attempts[-1].plan
        decisive = attempts[-1] if attempts[-1].is_final else first
        point = decisive.arguments["x0"]
        sizes = self._sizes(point, decisive.names, bounds, p)
        raise diagnosis(
            self,
            decisive.outcome,
            decisive.arguments,
            solution=decisive.solution,
            elastic=elastic,
            attempts=[str(attempt) for attempt in attempts],
            badly_scaled=scaling_fault(self._pattern, point, p, scales=decisive.scales, sizes=sizes),
        ) from decisive.error

    def _alternative_attempts(self, first: Attempt, arguments: dict[str, np.ndarray], bounds: Bounds) -> list[Attempt]:
        """Run the solver from each alternative initial point until a run succeeds or the time limit is reached.

        Together they take at most the iterations of the first attempt. If functions are not finite near the guess nor
        near zeros, no simulation of the dynamics is tried: an integrator can take minutes to fail.
        """
        attempts, remaining, x0 = list[Attempt](), self._max_iterations, first.arguments["x0"]
        if first.is_final:
            return attempts
        limits, p = (arguments["lbx"], arguments["ubx"]), arguments["p"]
        sizes = self._sizes(x0, first.names, bounds, p).of_variables(self.transcription)
        for start, point in alternative_starts(self.formulation, self.transcription, x0, p, bounds=limits, sizes=sizes):
            if remaining <= 0 or np.array_equal(point, x0):
                continue
            attempts.append(self._attempt(start, point, first.names, arguments, bounds, self._short_solver))
            statuses = {attempt.outcome.status for attempt in (first, *attempts)}
            never_finite = len(attempts) > 1 and statuses == {SolverStatus.NOT_FINITE}
            if attempts[-1].is_final or never_finite:
                break
            remaining -= attempts[-1].outcome.iterations
        return attempts

    def _elastic(self, first: Attempt) -> Elastic | None:
        """Return the plan of least constraint violation after the run `first` has failed; None if none is found.

        On Ctrl-C, Interrupted is raised with the plan of that run.
        """
        try:
            return elastic_plan(self, first.outcome, first.arguments, first.scales)
        except Interrupted as error:
            raise Interrupted(str(error), first.solution) from error

    def is_own_plan(self, guess: Guess) -> bool:
        """Return whether a guess is a plan of this nonlinear program: same method, mesh, variables and parameters."""
        if not isinstance(guess, Solution) or guess.method != self.method.settings:
            return False
        sizes = guess.variables.shape, guess.multipliers.shape, set(guess.parameters)
        return sizes == ((self.transcription.size,), (self.transcription.n_rows,), set(self.formulation.parameters))

    def _nearby(self, guess: Guess, arguments: dict[str, np.ndarray], bounds: Bounds, shift: int) -> Solution | None:
        """Shift a given plan by ``shift`` mesh intervals, and return the optimum near it; None if there is none."""
        form = self.formulation
        if not isinstance(guess, Solution) or not self.is_own_plan(guess) or self.solver_name != "ipopt":
            return None
        if guess.regularised or not guess.success:
            return None
        try:
            p = form.parameter_vector(guess.parameters)
            limits_of_guess = self._known.relaxed(self.transcription.arguments(p, bounds_to_solve(form, p)))
            v, lam = guess.variables, guess.multipliers
            scales = self._scales(v, self._variable_names, bounds, arguments["p"])
            cost, rows = self.program.numbers.values(v, p)
            start = Outcome(v, cost, rows, lam, guess.status, "", 0, 0.0)
            sides = active_sides(self.program, start, limits_of_guess, scales)
            if shift:
                index_x, index_g = shifted_indices(self.transcription, shift)
                start = dataclasses.replace(start, variables=v[index_x], multipliers=lam[index_g])
                sides = {"x": sides["x"][index_x], "g": sides["g"][index_g]}
            outcome = self._newton.solve_near(start, sides, self._known.relaxed(arguments), scales)
            if outcome is not None:
                outcome = self._known.checked(outcome, arguments, scales)
            if outcome is None or not outcome.success:
                return None
            return self.solution_from(outcome, arguments["p"], "guess")
        except (ProblemError, RuntimeError):  # parameters that this problem rejects; an integrator that fails
            return None

    @cached_property
    def _newton(self) -> Newton:
        """Newton's method for solves that start from a plan of this nonlinear program."""
        return Newton(self.program, self.transcription)

    @cached_property
    def _short_solver(self) -> tuple[Any, Any]:
        """The solver, and its callback, for alternative initial points, with a reduced iteration limit."""
        return self._built_solver({**self._options, "max_iter": min(STARTS.iterations, self._max_iterations)})

    def _attempt(
        self,
        start: str,
        point: np.ndarray,
        names: set[str],
        limits: dict[str, np.ndarray],
        bounds: Bounds,
        solver: tuple[Any, Any] | None = None,
    ) -> Attempt:
        """Run a solver (by default the main solver) from an initial point, with scales computed at this point."""
        arguments = {**limits, "x0": np.clip(point, limits["lbx"], limits["ubx"])}
        p, x0 = arguments["p"], arguments["x0"]
        scales = self._scales(x0, names, bounds, p)
        relaxed = self._known.relaxed(arguments)
        scaled = scales.scale_arguments(relaxed)
        function, progress = solver or (self._solver, self._progress)
        try:
            outcome = call_solver(function, progress, scaled)
        except RuntimeError as error:
            outcome = broken_down(function, scaled, error)
        outcome = scales.unscale(outcome)
        outcome = self._known.checked(outcome, arguments, scales)
        try:
            solution = self.solution_from(outcome, p, start)
        except RuntimeError as error:  # an integrator fails at the last iterate, which is no plan
            if outcome.status is SolverStatus.INTERRUPTED:
                raise Interrupted(f"problem {self.problem.name!r}: interrupted") from error
            return Attempt(start, arguments, names, scales, outcome, None, error)
        if outcome.status is SolverStatus.INTERRUPTED:
            text = f"problem {self.problem.name!r}: interrupted after {outcome.iterations} iterations"
            raise Interrupted(text, solution)
        return Attempt(start, arguments, names, scales, outcome, solution)

    def _scales(self, point: np.ndarray, names: set[str], bounds: Bounds, p: np.ndarray) -> Scales:
        """Return the scales of the program at an initial point; ``names`` are the variables with a guess."""
        if not self._scaling:
            return unit_scales(self.transcription)
        scales = compute_scales(self._pattern, self._sizes(point, names, bounds, p), point, p)
        if getattr(self.method, "integrator", "") == "cvodes":
            # its tolerances are absolute: do not enlarge the adjoint variables
            return dataclasses.replace(scales, cost=max(scales.cost, 1.0))
        return scales

    def _sizes(self, point: np.ndarray, names: set[str], bounds: Bounds, p: np.ndarray) -> Sizes:
        """Return the magnitudes of the variables at an initial point; ``names`` are the variables with a guess."""
        return sizes_along(self._pattern, point, names, bounds=bounds, p=p)

    @property
    def _variable_names(self) -> set[str]:
        """Names of all states and controls, and "horizon"."""
        return {*self.formulation.states, *self.formulation.controls, "horizon"}

    def solution_from(self, outcome: Outcome, p: np.ndarray, start: str) -> Solution:
        """Convert a solver's result to a solution; ``start`` is the name of the initial point."""
        seconds = {"build": self.seconds, "solve": outcome.seconds}
        fields = {"method": self.method.settings, "seconds": seconds, "start": start}
        return solution_of(self.formulation, self.transcription, self.program, outcome, p=p, **fields)


@dataclass(frozen=True)
class Attempt:
    """Record of one run of the solver from one initial point, the start.

    Attributes:
        start: Name of the start.
        arguments: x0, p and the bounds.
        names: Names of the variables with intended values in the start.
        scales: Scales of the program.
        outcome: Result of the solver.
        solution: The outcome as a solution; None if it cannot be evaluated, because of ``error``.
    """

    start: str
    arguments: dict[str, np.ndarray]
    names: set[str]
    scales: Scales
    outcome: Outcome
    solution: Solution | None
    error: RuntimeError | None = None

    @property
    def plan(self) -> Solution | None:
        """The plan, if the solver succeeded; else None."""
        return self.solution if self.outcome.success else None

    @property
    def is_final(self) -> bool:
        """Whether no other start will be tried: the solver has succeeded, or the time limit is reached."""
        return self.plan is not None or self.outcome.status is SolverStatus.TIME_LIMIT

    def __str__(self) -> str:
        return f"from the {self.start}: {self.outcome.status} after {self.outcome.iterations} iterations"


def tighten_bounds(arguments: dict[str, np.ndarray], amounts: Mapping[str, np.ndarray]) -> None:
    """Tighten bounds in place by given amounts, at most to the middle of both bounds; equalities stay unchanged."""
    for kind in ("x", "g"):
        low, high = arguments[f"lb{kind}"], arguments[f"ub{kind}"]
        is_range = low < high
        with np.errstate(invalid="ignore"):
            middle = np.where(is_range & np.isfinite(high - low), (low + high) / 2, np.nan)
        arguments[f"lb{kind}"] = np.where(is_range, np.fmin(low + amounts[f"lb{kind}"], middle), low)
        arguments[f"ub{kind}"] = np.where(is_range, np.fmax(high - amounts[f"ub{kind}"], middle), high)
