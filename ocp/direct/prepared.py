"""Direct methods, and a problem built once for such a method and a solver, to be solved many times."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ocp.console import TimeLimitReached, check_time, interruptible, time_limited
from ocp.direct.active_set import Newton, held_by
from ocp.direct.assembly import Program, assemble
from ocp.direct.controller import block_derivatives, write_controller
from ocp.direct.diagnosis import Elastic, diagnosis, elastic_plan
from ocp.direct.guess import ELASTIC, GUESS, STARTS, initial_point, later, names_told, other_starts
from ocp.direct.mesh import MeshedMethod
from ocp.direct.nlp import (
    SOLVERS,
    Outcome,
    broken_down,
    build_solver,
    call_solver,
    horizon_of,
    largest_number_of_iterations,
    solution_of,
)
from ocp.direct.scaling import Known, Pattern, Scales, badness, fitting_scales, scaled_program, sizes_along, unscaled
from ocp.errors import (
    Interrupted,
    ProblemError,
    SolveError,
    checked_choice,
    checked_count,
    checked_mapping,
    checked_time_limit,
)
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.problem import Problem
from ocp.solution import ByName, Guess, Solution
from ocp.status import SolverStatus
from ocp.storage import checked_path

__all__ = ["DirectMethod", "Prepared"]


class DirectMethod(MeshedMethod):
    """A direct method: a problem is prepared for it once, to be solved many times."""

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
        """Build a problem once, to be solved many times; see :func:`ocp.methods.prepare`.

        Raises:
            SolveError: The time limit of a call that this is part of is over.
        """
        try:
            return Prepared(problem, self, solver, options, compiled, scaling)
        except TimeLimitReached as error:
            words = f"problem {problem.name!r} was still being built: {SolverStatus.TIME_LIMIT}: raise time_limit"
            raise SolveError(words, name="time_limit") from error


class Prepared:
    """A problem built once for a method and a solver, to be solved many times, by one thread at a time.

    Attributes:
        formulation, fragment, program: What was built.
        solver_name: The solver.
        seconds: Wall time of the build.
    """

    def __init__(
        self,
        problem: Problem,
        method: DirectMethod,
        solver: str,
        options: ByName,
        compiled: bool = False,
        scaling: bool = True,
    ) -> None:
        began = time.monotonic()
        self.problem, self.method = problem, method
        self.formulation = Formulation.of(problem)
        checked_choice("solver", solver, SOLVERS)
        own = checked_mapping("options", options)
        self._own_options, self._scaling = own, scaling
        self.solver_name = solver
        self.fragment = method.transcribe(self.formulation, staged=solver == "fatrop")
        # sleqp asks for products with the Hessian, which compiled functions do not have
        blocks = block_derivatives(self.fragment, compiled and solver != "sleqp")
        self.program = assemble(self.fragment, self.formulation.np, blocks)
        check_time()
        self._solver, self._progress = self._built_solver(own)
        check_time()
        self._pattern = Pattern(self.formulation, self.fragment, self.program)
        self._known = Known(self.formulation, self.fragment, self.program)
        self._most = largest_number_of_iterations(self.solver_name, own)
        self._made_of = problem, method, solver, options, compiled, scaling
        self._lock = threading.RLock()  # casadi's functions take one caller at a time
        self.seconds = time.monotonic() - began

    @cached_property
    def scaled(self) -> Program:
        """The program as it is solved, see :func:`ocp.direct.scaling.scaled_program`."""
        return scaled_program(self.program)

    def _built_solver(self, options: dict[str, Any]) -> tuple[Any, Any]:
        """The solver with some options, and what ends it where it must end."""
        return build_solver(self.scaled, self.solver_name, options, self.fragment.stages, self.problem.name)

    def __reduce__(self) -> Any:
        """Pickled and copied as what it was prepared of, to be prepared again."""
        return type(self), self._made_of

    @interruptible
    def solve(
        self,
        parameters: ByName = None,
        guess: Guess = None,
        check: bool = True,
        tighter: Mapping[str, np.ndarray] | None = None,
        time_limit: float | None = None,
        *,
        shift: int = 0,
    ) -> Solution:
        """Solve with these parameters from this guess; see :func:`ocp.methods.solve`. Another thread's solve is
        waited for.

        With ``check`` other starts are tried where the guess fails. Without it the solver runs once, from the guess,
        and its last iterate is returned whatever it is: for loops that solve often and look at ``success``.
        From a plan of this problem, method and mesh, the limits that push there are held first, and the others let go,
        which takes a few steps of Newton's; then those that come out of it (:mod:`ocp.direct.active_set`;
        ``Solution.solver`` is ``newton``). Where that ends nowhere, ipopt begins from the guess as ever.
        ``tighter`` says how far each bound of the program (lbx, ubx, lbg, ubg) that is no equality is drawn in.
        ``shift`` is by how many intervals a receding horizon has moved on since such a plan: each interval then begins
        from what the plan has so many intervals later, its limits and multipliers too, and the last ones from their
        own. The mesh must be of equal intervals.

        Raises:
            ProblemError: Wrong arguments. SolveError: There is no plan, and why.
        """
        ahead = checked_count("solve: shift", shift, least=0, most=self.method.intervals - 1)
        if ahead and not (self._fits(guess) and self.method.mesh is None):
            words = "solve: shift asks for a plan of this very problem, method and mesh, of equal intervals, as guess"
            raise ProblemError(words, name="shift", value=shift)
        with time_limited(checked_time_limit(time_limit)), self._lock:
            return self._solve(parameters, guess, check, tighter, ahead)

    @interruptible
    def to_c(self, folder: str | os.PathLike[str], parameters: ByName = None, guess: Guess = None) -> Path:
        """Write the problem's functions as C, with a plan and a program of it; see :mod:`ocp.direct.controller`.

        Args:
            folder: Is made, and returned; files of the same names are replaced.
            parameters: Values at which the guess is evaluated.
            guess: As of :meth:`solve`; a solution of this problem prepared, to have its very plan in the C.

        Raises:
            ProblemError: Wrong arguments, or something of the problem has no C, such as cvodes.
            OSError: The folder cannot be written.
        """
        form, fragment = self.formulation, self.fragment
        place = Path(checked_path(folder))
        bounds = form.bound_values(form.parameter_vector(checked_mapping("parameters", parameters)))
        with self._lock:
            point = initial_point(form, fragment, guess, bounds)
            if isinstance(guess, Solution) and guess.method == self.method.settings:
                # of this very grid; a layout in stages has more variables than one without
                point = guess.variables if guess.variables.size == point.size else point
            return write_controller(form, fragment, point, place)

    def _solve(
        self, parameters: ByName, guess: Guess, check: bool, tighter: Mapping[str, np.ndarray] | None, ahead: int
    ) -> Solution:
        form, fragment = self.formulation, self.fragment
        p = form.parameter_vector(checked_mapping("parameters", parameters))
        bounds = form.bound_values(p)
        arguments = fragment.arguments(p, bounds_to_solve(form, p))
        if tighter is not None:
            draw_in(arguments, tighter)
        again = self._again(guess, arguments, bounds, ahead)
        if again is not None:
            return again
        point = initial_point(form, fragment, guess, bounds)
        if ahead and isinstance(guess, Solution):
            point = guess.variables[later(fragment, ahead)[0]]
        told = names_told(form, guess)
        first = self._attempt(GUESS, point, told, arguments, bounds)
        if first.solution is not None and (first.outcome.success or not check):
            return first.solution
        attempts: list[Attempt] = [first, *(self._attempts_elsewhere(first, arguments, bounds) if check else ())]
        if attempts[-1].found is not None:
            return attempts[-1].found
        elastic = None if attempts[-1].is_final else self._elastic(first)
        left = self._most - sum(attempt.outcome.iterations for attempt in attempts[1:])
        if elastic is not None and check and left > 0:
            solver = self._solver_of_other_starts
            attempts.append(self._attempt(ELASTIC, elastic.plan, self._all_names, arguments, bounds, solver))
            if attempts[-1].found is not None:
                return attempts[-1].found
        told_of = attempts[-1] if attempts[-1].is_final else first
        raise diagnosis(
            self,
            told_of.outcome,
            told_of.arguments,
            horizon_of(form, fragment, told_of.outcome, p),
            told_of.solution,
            elastic,
            [str(attempt) for attempt in attempts],
            self._badness(told_of, bounds),
        ) from told_of.error

    def _attempts_elsewhere(self, first: Attempt, arguments: dict[str, np.ndarray], bounds: Bounds) -> list[Attempt]:
        """What became of the starts beside the guess, one after the other until one succeeds or the time is over.

        They take as many iterations together as the first attempt may. Where no function is ever finite it is not a
        matter of the start.
        """
        attempts, left, x0 = list[Attempt](), self._most, first.arguments["x0"]
        if first.is_final:
            return attempts
        starts = other_starts(self.formulation, self.fragment, x0, arguments["p"], (arguments["lbx"], arguments["ubx"]))
        for start, point in starts:
            if left <= 0 or np.array_equal(point, x0):
                continue
            solver = self._solver_of_other_starts
            attempts.append(self._attempt(start, point, first.told, arguments, bounds, solver))
            if attempts[-1].is_final or all(attempt.is_broken for attempt in (first, *attempts)):
                break
            left -= attempts[-1].outcome.iterations
        return attempts

    def _elastic(self, first: Attempt) -> Elastic | None:
        """The plan that misses the constraints least; Ctrl-C carries the last iterate of the first attempt."""
        horizon = horizon_of(self.formulation, self.fragment, first.outcome, first.arguments["p"])
        try:
            return elastic_plan(self, first.outcome, first.arguments, first.scales, horizon)
        except Interrupted as error:
            raise Interrupted(str(error), first.solution) from error

    def _fits(self, guess: Guess) -> bool:
        """Whether a guess is a plan of this very program, by its method, mesh, sizes and parameters."""
        if not isinstance(guess, Solution) or guess.method != self.method.settings:
            return False
        sizes = guess.variables.shape, guess.multipliers.shape, set(guess.parameters)
        return sizes == ((self.fragment.size,), (self.fragment.n_rows,), set(self.formulation.parameters))

    def _again(self, guess: Guess, arguments: dict[str, np.ndarray], bounds: Bounds, ahead: int) -> Solution | None:
        """The plan beside the guess, moved on by ``ahead`` intervals; None where it is not found near it."""
        form = self.formulation
        if not isinstance(guess, Solution) or not self._fits(guess) or self.solver_name != "ipopt":
            return None
        if guess.regularised or not guess.success:
            return None
        try:
            p = form.parameter_vector(guess.parameters)
            before = self._known.relaxed(self.fragment.arguments(p, bounds_to_solve(form, p)))
            v, lam = guess.variables, guess.multipliers
            scales = self._scales(v, self._all_names, bounds, arguments["p"])
            cost, rows = self.program.numbers.values(v, p)
            start = Outcome(v, cost, rows, lam, guess.status, "", 0, 0.0)
            sides = held_by(self.program, start, before, scales)
            if ahead:
                of_x, of_g = later(self.fragment, ahead)
                start = dataclasses.replace(start, variables=v[of_x], multipliers=lam[of_g])
                sides = {"x": sides["x"][of_x], "g": sides["g"][of_g]}
            outcome = self._newton.beside(start, sides, self._known.relaxed(arguments), scales)
            if outcome is not None:
                outcome = self._known.checked(outcome, arguments, scales)
            if outcome is None or not outcome.success:
                return None
            return self._solution(outcome, arguments["p"], GUESS)
        except (ProblemError, RuntimeError):  # parameters that this problem refuses; an integrator that breaks down
            return None

    @cached_property
    def _newton(self) -> Newton:
        """What solves beside a plan."""
        return Newton(self.program, self.fragment)

    @cached_property
    def _solver_of_other_starts(self) -> tuple[Any, Any]:
        """The solver with fewer iterations, for what is tried where it failed already; and its progress."""
        return self._built_solver({**self._own_options, "max_iter": min(STARTS.iterations, self._most)})

    def _attempt(
        self,
        start: str,
        point: np.ndarray,
        told: set[str],
        limits: dict[str, np.ndarray],
        bounds: Bounds,
        solver: tuple[Any, Any] | None = None,
    ) -> Attempt:
        """Run a solver, its own for None, once from a start, scaled by the sizes along it.

        See :func:`sizes_along` for ``told``.
        """
        arguments = {**limits, "x0": np.clip(point, limits["lbx"], limits["ubx"])}
        p, x0 = arguments["p"], arguments["x0"]
        scales = self._scales(x0, told, bounds, p)
        relaxed = self._known.relaxed(arguments)
        own = scales.inside(relaxed)
        run, progress = solver or (self._solver, self._progress)
        try:
            outcome = call_solver(run, progress, own)
        except RuntimeError as error:
            outcome = broken_down(run, own, error)
        outcome = scales.outside(outcome)
        outcome = self._known.checked(outcome, arguments, scales)
        try:
            solution = self._solution(outcome, p, start)
        except RuntimeError as error:  # an integrator breaks down at the last iterate, which is no plan
            if outcome.status is SolverStatus.INTERRUPTED:
                raise Interrupted(f"problem {self.problem.name!r}: interrupted") from error
            return Attempt(start, arguments, told, scales, outcome, None, error)
        if outcome.status is SolverStatus.INTERRUPTED:
            words = f"problem {self.problem.name!r}: interrupted after {outcome.iterations} iterations"
            raise Interrupted(words, solution)
        return Attempt(start, arguments, told, scales, outcome, solution)

    def _scales(self, point: np.ndarray, told: set[str], bounds: Bounds, p: np.ndarray) -> Scales:
        """What fits the sizes along a start; see :func:`sizes_along` for ``told``."""
        if not self._scaling:
            return unscaled(self.fragment)
        scales = fitting_scales(self._pattern, sizes_along(self._pattern, point, told, bounds, p), point, p)
        if getattr(self.method, "integrator", "") == "cvodes":
            # its tolerances are absolute: what it integrates backwards is not made larger
            return dataclasses.replace(scales, cost=max(scales.cost, 1.0))
        return scales

    def _badness(self, attempt: Attempt, bounds: Bounds) -> str:
        """What was badly scaled to the solver, in words; "" where nothing was."""
        x0, p = attempt.arguments["x0"], attempt.arguments["p"]
        sizes = sizes_along(self._pattern, x0, attempt.told, bounds, p)
        return badness(self._pattern, x0, p, attempt.scales, sizes)

    @property
    def _all_names(self) -> set[str]:
        """Names of all that a plan says the values of, see :func:`sizes_along`."""
        return {*self.formulation.states, *self.formulation.controls, "horizon"}

    def _solution(self, outcome: Outcome, p: np.ndarray, start: str) -> Solution:
        seconds = {"build": self.seconds, "solve": outcome.seconds}
        return solution_of(
            self.formulation,
            self.fragment,
            self.program,
            outcome,
            p,
            method=self.method.settings,
            seconds=seconds,
            start=start,
        )


@dataclass(frozen=True)
class Attempt:
    """One run of the solver.

    Attributes:
        start: Where it started from. arguments: x0, p and the bounds. told: What the start says something of.
        scales: What it was scaled by. outcome: What the solver returned.
        solution: The same as a plan; None where it is none, because of ``error``.
    """

    start: str
    arguments: dict[str, np.ndarray]
    told: set[str]
    scales: Scales
    outcome: Outcome
    solution: Solution | None
    error: RuntimeError | None = None

    @property
    def found(self) -> Solution | None:
        """The plan, where the solver succeeded."""
        return self.solution if self.outcome.success else None

    @property
    def is_final(self) -> bool:
        """Whether no other start is to be tried: it succeeded, or there is no time left."""
        return self.found is not None or self.outcome.status is SolverStatus.TIME_LIMIT

    @property
    def is_broken(self) -> bool:
        """Whether a function was not finite, or an integrator broke down."""
        return self.outcome.status is SolverStatus.NOT_FINITE

    def __str__(self) -> str:
        return f"from the {self.start}: {self.outcome.status} after {self.outcome.iterations} iterations"


def draw_in(arguments: dict[str, np.ndarray], by: Mapping[str, np.ndarray]) -> None:
    """Move lower bounds up and upper ones down, to their middle at most; leave equalities."""
    for kind in ("x", "g"):
        low, high = arguments[f"lb{kind}"], arguments[f"ub{kind}"]
        room = low < high
        with np.errstate(invalid="ignore"):
            middle = np.where(room & np.isfinite(high - low), (low + high) / 2, np.nan)
        arguments[f"lb{kind}"] = np.where(room, np.fmin(low + by[f"lb{kind}"], middle), low)
        arguments[f"ub{kind}"] = np.where(room, np.fmax(high - by[f"ub{kind}"], middle), high)
