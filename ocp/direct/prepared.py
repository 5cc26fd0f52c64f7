"""Direct methods, and a problem built once for such a method and a solver, to be solved many times."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from ocp.console import OutOfTime, check_time, interruptible, limited
from ocp.curves import PiecewisePolynomial
from ocp.direct.active_set import Newton
from ocp.direct.assembly import Program, assemble
from ocp.direct.compiled import block_derivatives
from ocp.direct.controller import write_controller
from ocp.direct.diagnosis import diagnosis, elastic_plan
from ocp.direct.fragment import Fragment
from ocp.direct.guess import initial_point, later, names_told
from ocp.direct.kkt import held_by
from ocp.direct.known import Known
from ocp.direct.nlp import SOLVERS, Outcome, broken_down, build_solver, call_solver, largest_number_of_iterations
from ocp.direct.scaling import Pattern, Scales, badness, fitting_scales, scaled_program, sizes_along, unscaled
from ocp.direct.starts import ELASTIC, GUESS, other_starts
from ocp.errors import (
    NOT_NUMBERS,
    Interrupted,
    ProblemError,
    SolveError,
    about,
    checked_choice,
    checked_count,
    checked_mapping,
    checked_positive,
    checked_time_limit,
    floats,
)
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.problem import Problem
from ocp.problem.values import numeric
from ocp.solution import ByName, Guess, Solution
from ocp.status import SolverStatus
from ocp.storage import checked_path

__all__ = ["DirectMethod", "Prepared", "check_meshed"]

SAME_NODE = 1e-9  # of the horizon: nodes nearer to each other are one
MOST_ELSEWHERE = 200  # iterations from each other start


class DirectMethod(ABC):
    """A direct method: turns a problem into a nonlinear program on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        control: How the controls move inside an interval.
        mesh: Fractions 0..1 where intervals begin and end, N + 1 of them; None for equal intervals.
    """

    intervals: int
    control: str
    mesh: tuple[float, ...] | None

    @property
    @abstractmethod
    def order(self) -> int:
        """Power of the width with which the integration error of one interval falls."""

    @property
    @abstractmethod
    def control_order(self) -> int:
        """Power of the width with which a smooth control is missed between its points."""

    @abstractmethod
    def transcribe(self, form: Formulation, *, staged: bool = False) -> Fragment:
        """The nonlinear program of a problem. ``staged`` lays it out for a structure-exploiting solver."""

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
        except OutOfTime as error:
            words = f"problem {problem.name!r} was still being built: {SolverStatus.TIME_LIMIT}: raise time_limit"
            raise SolveError(words, name="time_limit") from error

    @property
    def fractions(self) -> np.ndarray:
        """Where intervals begin and end, as fractions of the horizon. Shape (N + 1,)."""
        return np.linspace(0.0, 1.0, self.intervals + 1) if self.mesh is None else np.asarray(self.mesh, dtype=float)

    def with_mesh(self, mesh: np.ndarray) -> Self:
        """The same method on another mesh (N + 1,)."""
        return dataclasses.replace(self, intervals=len(mesh) - 1, mesh=tuple(mesh.tolist()))  # type: ignore[type-var]

    def halved(self) -> Self:
        """The same method with every interval cut in two."""
        if self.mesh is None:
            return dataclasses.replace(self, intervals=2 * self.intervals)  # type: ignore[type-var]
        nodes = self.fractions
        return self.with_mesh(np.union1d(nodes, (nodes[1:] + nodes[:-1]) / 2))

    def with_nodes_at(self, fractions: Any) -> Self:
        """The same method with nodes at some fractions 0..1 of the horizon too, where something jumps or bends.

        A mesh that was given keeps its nodes. Without one the intervals between the fractions are equal, as many as
        make none wider than it was.

        Raises:
            ProblemError: Fractions that are no numbers from 0 to 1.
        """
        told: dict[str, Any] = {"name": "fractions", "value": fractions}
        with about("fractions"):
            asked = numeric("with_nodes_at: fractions", fractions)
        if not np.all((asked >= 0.0) & (asked <= 1.0)):
            raise ProblemError(f"with_nodes_at: fractions must be numbers from 0 to 1, not {fractions!r}", **told)
        if not asked.size:
            return self
        nodes = np.array([0.0, 1.0]) if self.mesh is None else self.fractions
        own = np.abs(asked[:, None] - nodes).min(axis=1) < SAME_NODE
        asked = np.unique(asked[~own])
        nodes = np.union1d(nodes, asked[np.diff(asked, prepend=-1.0) >= SAME_NODE])
        if self.mesh is None:
            counts = np.maximum(np.ceil(np.diff(nodes) * self.intervals - SAME_NODE), 1).astype(int)
            pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], counts, strict=True)]
            nodes = np.concatenate([*pieces, [1.0]])
        return self.with_mesh(nodes)

    def _settle(self, count: str, most: int | None = None) -> None:
        """Check the mesh and the whole number by the name ``count``; turn them into plain Python, as is saved.

        Raises:
            ProblemError: No positive integers, or a mesh that does not increase from 0 to 1 in so many intervals.
        """
        kind = type(self).__name__
        for name, limit in (("intervals", None), (count, most)):
            object.__setattr__(self, name, checked_count(f"{kind}: {name}", getattr(self, name), most=limit))
        if self.mesh is None:
            return
        told: dict[str, Any] = {"name": "mesh", "value": self.mesh}
        try:
            at = floats(self.mesh)
        except NOT_NUMBERS as error:
            words = f"{kind}: mesh must be fractions from 0 to 1, not {self.mesh!r}"
            raise ProblemError(words, **told) from error
        if at.shape != (self.intervals + 1,):
            words = f"{kind}: mesh has {at.size} entries, {self.intervals + 1} expected (fractions 0 to 1)"
            raise ProblemError(words, **told)
        if not (at[0] == 0.0 and at[-1] == 1.0 and np.all(np.diff(at) > 0)):
            raise ProblemError(f"{kind}: mesh must increase from 0 to 1, not {at.tolist()}", **told)
        object.__setattr__(self, "mesh", tuple(at.tolist()))


def check_meshed(caller: str, method: Any, tolerance: Any) -> None:
    """Raise ProblemError unless a method has a mesh of intervals, and a tolerance is positive and finite."""
    if not isinstance(method, DirectMethod):
        words = f"{caller}: Collocation(...) or MultipleShooting(...) is expected, not {method!r}"
        raise ProblemError(words, name="method", value=method)
    checked_positive(f"{caller}: tolerance", tolerance)


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
        with limited(checked_time_limit(time_limit)), self._lock:
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
            if isinstance(guess, Solution) and guess.method == self._told_method:
                # of this very grid; a layout in stages has more variables than one without
                point = guess.variables if guess.variables.size == point.size else point
            return write_controller(form, fragment, point, place)

    def _solve(
        self, parameters: ByName, guess: Guess, check: bool, tighter: Mapping[str, np.ndarray] | None, ahead: int = 0
    ) -> Solution:
        form, fragment = self.formulation, self.fragment
        p = form.parameter_vector(checked_mapping("parameters", parameters))
        bounds = form.bound_values(p)
        arguments = self._arguments(p, bounds_to_solve(form, p))
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
        attempts, left = [first], self._most
        if check and not first.is_final:
            solver = self._solver_of_other_starts()
            limits = arguments["lbx"], arguments["ubx"]
            for start, other in other_starts(form, fragment, first.arguments["x0"], p, limits):
                if left <= 0 or np.array_equal(other, first.arguments["x0"]):
                    continue
                attempts.append(self._attempt(start, other, told, arguments, bounds, solver))
                if attempts[-1].is_final or all(attempt.is_broken for attempt in attempts):
                    break  # found, stopped, or not a matter of the start
                left -= attempts[-1].outcome.iterations
            if attempts[-1].found is not None:
                return attempts[-1].found
        found = None
        if not attempts[-1].is_final:
            try:
                horizon = self._horizon(first.outcome, p)
                found = elastic_plan(self, first.outcome, first.arguments, first.scales, horizon)
            except Interrupted as error:
                raise Interrupted(str(error), first.solution) from error
        if found is not None and check and left > 0:
            names = {*form.states, *form.controls, "horizon"}
            attempts.append(self._attempt(ELASTIC, found.plan, names, arguments, bounds, solver))
            if attempts[-1].found is not None:
                return attempts[-1].found
        told_of = attempts[-1] if attempts[-1].is_final else first
        raise diagnosis(
            self,
            told_of.outcome,
            told_of.arguments,
            self._horizon(told_of.outcome, p),
            told_of.solution,
            found,
            [str(attempt) for attempt in attempts],
            self._badness(told_of, bounds),
        ) from told_of.error

    def _arguments(self, p: np.ndarray, bounds: Bounds) -> dict[str, np.ndarray]:
        """Parameters, and the bounds of variables and rows, of the program."""
        (lower, upper), fragment = bounds, self.fragment
        return {
            "p": p,
            "lbx": lower[fragment.variable_bounds],
            "ubx": upper[fragment.variable_bounds],
            "lbg": lower[fragment.row_bounds],
            "ubg": upper[fragment.row_bounds],
        }

    def _fits(self, guess: Guess) -> bool:
        """Whether a guess is a plan of this very program, by its method, mesh, sizes and parameters."""
        if not isinstance(guess, Solution) or guess.method != self._told_method:
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
            before = self._known.relaxed(self._arguments(p, bounds_to_solve(form, p)))
            v, lam = guess.variables, guess.multipliers
            scales = self._scales(v, {*form.states, *form.controls, "horizon"}, bounds, arguments["p"])
            cost, rows = self.program.numbers.values(v, p)
            start = Outcome(v, cost, rows, lam, guess.status, "", 0, 0.0)
            sides = held_by(self.program, start, before, scales)
            if ahead:
                of_x, of_g = later(self.fragment, ahead)
                start = dataclasses.replace(start, variables=v[of_x], multipliers=lam[of_g])
                sides = {"x": sides["x"][of_x], "g": sides["g"][of_g]}
            outcome = self._newton.beside(start, sides, self._known.relaxed(arguments), scales)
            if outcome is not None:
                outcome = self._known.checked(outcome, arguments, {"x": scales.variables, "g": scales.rows})
            if outcome is None or not outcome.success:
                return None
            return self._solution(outcome, arguments["p"], GUESS)
        except (ProblemError, RuntimeError):  # parameters that this problem refuses; an integrator that breaks down
            return None

    @cached_property
    def _newton(self) -> Newton:
        """What solves beside a plan."""
        return Newton(self.program, self.fragment)

    def _solver_of_other_starts(self) -> tuple[Any, Any]:
        """The solver with fewer iterations, for what is tried where it failed already; and its progress."""
        return self._built_solver({**self._own_options, "max_iter": min(MOST_ELSEWHERE, self._most)})

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
        outcome = self._known.checked(outcome, arguments, {"x": scales.variables, "g": scales.rows})
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
    def _told_method(self) -> dict[str, Any]:
        settings = {k: v for k, v in dataclasses.asdict(self.method).items() if v is not None}  # type: ignore[call-overload]
        return {"type": type(self.method).__name__, **settings}

    def _horizon(self, outcome: Outcome, p: np.ndarray) -> float:
        index = self.fragment.horizon
        return float(self.formulation.horizon_at(p) if index is None else outcome.variables[index])

    def _solution(self, outcome: Outcome, p: np.ndarray, start: str) -> Solution:
        form, fragment = self.formulation, self.fragment
        v = outcome.variables
        horizon = self._horizon(outcome, p)
        states, controls = fragment.interpolants(v, p, horizon)
        piece, place = fragment.report
        mesh = fragment.mesh
        at = mesh[piece] + np.diff(mesh)[piece] * place
        at[-1] = 1.0
        costates = self._costates(outcome, p)
        by_parameter = self._cost_gradient(outcome, p) if form.np else np.zeros(0)
        x, u = v[fragment.report_states], controls_at(controls, fragment, piece, place)
        return Solution(
            name=form.name,
            method=self._told_method,
            solver=outcome.solver,
            success=outcome.success,
            status=outcome.status,
            message=outcome.message,
            cost=outcome.cost,
            iterations=outcome.iterations,
            horizon=horizon,
            t=at * horizon,
            states={name: x[:, s] for name, s in form.states.items()},
            controls={name: u[:, s] for name, s in form.controls.items()},
            costates={name: costates[:, s] for name, s in form.states.items()},
            parameters={name: p[s] for name, s in form.parameters.items()},
            cost_gradients={name: by_parameter[s] for name, s in form.parameters.items()},
            state_interpolant=states,
            control_interpolant=controls,
            costate_interpolant=costate_interpolant(fragment, costates),
            variables=v,
            multipliers=outcome.multipliers,
            seconds={"build": self.seconds, "solve": outcome.seconds},
            problem=self.problem,
            start=start,
            regularised=outcome.regularised,
        )

    def _costates(self, outcome: Outcome, p: np.ndarray) -> np.ndarray:
        """Costates at the reported points, from the multipliers.

        At a node: the derivative, with respect to its state, of what the intervals behind it add to the Lagrangian;
        at the end: minus what the intervals before it say.
        """
        fragment = self.fragment
        costates = outcome.multipliers[fragment.costate_rows] * fragment.costate_scale[:, None]
        inner = np.where(fragment.row_stages < 0, 0.0, outcome.multipliers)
        numbers = self.program.numbers
        _, jacobian = numbers.first(outcome.variables, p)
        rows, columns = jacobian.indices, np.repeat(np.arange(fragment.size), np.diff(jacobian.indptr))
        with np.errstate(invalid="ignore"):  # the iterate of a solver that failed may be anywhere
            terms = jacobian.data * inner[rows]
        running = numbers.inside(outcome.variables, p)

        node_of = np.full(fragment.size, -2)
        node_of[fragment.nodes] = np.arange(len(fragment.mesh))
        own = fragment.row_stages[rows] == node_of[columns]
        behind = np.bincount(columns[own], weights=terms[own], minlength=fragment.size)
        behind[fragment.start] += running[fragment.start]
        before = np.bincount(columns, weights=terms, minlength=fragment.size) + running
        behind[fragment.end] = -before[fragment.end]
        at_node = fragment.costate_rows < 0
        costates[at_node] = behind[fragment.nodes.T[fragment.costate_nodes]][at_node]
        return np.asarray(costates)

    def _cost_gradient(self, outcome: Outcome, p: np.ndarray) -> np.ndarray:
        """Derivative of the optimal cost in the parameters: of the Lagrangian, and through every active bound."""
        form, fragment = self.formulation, self.fragment
        v, lam = outcome.variables, outcome.multipliers
        direct = self.program.numbers.parametric(v, p, lam)
        slope, jacobian = self.program.numbers.first(v, p)
        lam_x = -(slope + jacobian.T @ lam)
        push = np.zeros((2, sum(len(place) for place in form.bounds.places.values())))
        for index, force in ((fragment.variable_bounds, lam_x), (fragment.row_bounds, lam)):
            np.add.at(push[0], index, np.minimum(force, 0.0))  # at a lower bound
            np.add.at(push[1], index, np.maximum(force, 0.0))
        return np.asarray(direct - form.bounds.pull(p, push))


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


def costate_interpolant(fragment: Fragment, costates: np.ndarray) -> PiecewisePolynomial:
    """The polynomials through the reported costates of every interval, both its ends included."""
    piece, place = fragment.report
    n = len(fragment.mesh) - 1
    starts = np.searchsorted(piece + (place == 1.0), np.arange(n))
    width = starts[1] - starts[0] if n > 1 else len(piece) - 1
    index = starts[:, None] + np.arange(width + 1)
    nodes = np.append(place[(piece + (place == 1.0)) == 0], 1.0)
    return PiecewisePolynomial(fragment.mesh, nodes, costates[index])


def controls_at(controls: Any, fragment: Fragment, piece: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Controls at reported points, from the side of the interval that reports them."""
    if len(controls.breaks) == len(fragment.mesh):
        return np.asarray(controls.within(piece, place))
    mesh = fragment.mesh
    return np.asarray(controls(mesh[piece] + np.diff(mesh)[piece] * place))
