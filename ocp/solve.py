"""One way in: ``solve(problem, method)``, and ``prepare`` for problems that are solved many times."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol

import numpy as np

from ocp.assembly import assemble
from ocp.errors import ProblemError, SolveError
from ocp.formulation import Formulation
from ocp.fragment import Fragment
from ocp.guess import initial_point
from ocp.indirect import Indirect, PreparedIndirect
from ocp.interpolation import PiecewisePolynomial
from ocp.nlp import SOLVERS, Outcome, build_solver, call_solver
from ocp.problem import Problem
from ocp.solution import Solution

__all__ = ["Method", "Prepared", "prepare", "solve"]

WORST = 6


class Method(Protocol):
    """A transcription: turns a formulation into a nonlinear program."""

    def transcribe(self, form: Formulation, *, staged: bool = False) -> Fragment: ...


class Prepared:
    """A problem built once for a method and a solver, to be solved many times.

    Attributes:
        formulation, fragment, program: What was built. seconds: Wall time of the build.
    """

    def __init__(
        self, problem: Problem, method: Method, solver: str, options: Mapping[str, Any], compiled: bool
    ) -> None:
        began = time.monotonic()
        if not isinstance(problem, Problem):
            raise ProblemError(f"a Problem is expected, not {type(problem).__name__}")
        if isinstance(method, type) or not callable(getattr(method, "transcribe", None)):
            raise ProblemError(f"a method such as Collocation(...) is expected, not {method!r}")
        self.problem, self.method, self.solver_name = problem, method, solver
        self.formulation = Formulation(problem)
        self.fragment = method.transcribe(self.formulation, staged=solver == "fatrop")
        self.program = assemble(self.fragment, self.formulation.np, compiler_options() if compiled else None)
        self._solver, self._progress = build_solver(
            self.program, solver, by_name("options", options), self.fragment.stages, problem.name
        )
        self.seconds = time.monotonic() - began

    def solve(
        self,
        parameters: Mapping[str, Any] | None = None,
        guess: Solution | Mapping[str, Any] | None = None,
        check: bool = True,
    ) -> Solution:
        """Solve with these parameters from this guess; see :func:`solve`."""
        form, fragment = self.formulation, self.fragment
        p = form.parameter_vector(by_name("parameters", parameters))
        bounds = form.bound_values(p)
        lower, upper = bounds
        lbx, ubx = lower[fragment.variable_bounds], upper[fragment.variable_bounds]
        point = np.clip(initial_point(form, fragment, guess, bounds), lbx, ubx)
        arguments = {
            "x0": point,
            "p": p,
            "lbx": lbx,
            "ubx": ubx,
            "lbg": lower[fragment.row_bounds],
            "ubg": upper[fragment.row_bounds],
        }
        outcome = call_solver(self._solver, self._progress, arguments)
        try:
            solution = self._solution(outcome, p)
        except RuntimeError as error:  # an integrator breaks down at the last iterate, which is no plan
            raise SolveError(self._diagnosis(outcome, arguments, self._horizon(outcome, p))) from error
        if check and not outcome.success:
            raise SolveError(self._diagnosis(outcome, arguments, solution.horizon), solution)
        return solution

    def _horizon(self, outcome: Outcome, p: np.ndarray) -> float:
        index = self.fragment.horizon
        return float(self.formulation.horizon_at(p) if index is None else outcome.variables[index])

    def _at_bounds(self, values: np.ndarray, arguments: dict[str, np.ndarray], horizon: float) -> list[str]:
        """Which states and controls sit at their bounds, and for how much of the plan."""
        form, fragment = self.formulation, self.fragment
        lines = []
        for role, labels in (("state", form.state_labels), ("control", form.control_labels)):
            for i, label in enumerate(labels):
                mine = (fragment.variable_role == role) & (fragment.variable_entry == i)
                mine &= arguments["lbx"] < arguments["ubx"]  # not what is given
                for side, key in (("lower", "lbx"), ("upper", "ubx")):
                    bound = arguments[key][mine]
                    with np.errstate(invalid="ignore"):
                        at = np.abs(values[mine] - bound) <= 1e-6 * np.maximum(1.0, np.abs(bound))
                    at &= np.isfinite(bound)
                    if np.any(at):
                        where = fragment.variable_fraction[mine][at]
                        lines.append(
                            f"  {role} {label} is at its {side} bound {bound[at][0]:.4g} at {np.mean(at):.0%} of its "
                            f"points, from {where.min() * horizon:.4g} to {where.max() * horizon:.4g} s"
                        )
        return lines

    def _solution(self, outcome: Outcome, p: np.ndarray) -> Solution:
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
        stacked = {
            "states": v[fragment.report_states],
            "controls": controls_at(controls, fragment, piece, place),
        }
        settings = {k: v for k, v in dataclasses.asdict(self.method).items() if v is not None}  # type: ignore[call-overload]
        return Solution(
            name=form.name,
            method={"type": type(self.method).__name__, **settings},
            solver=self.solver_name,
            success=outcome.success,
            status=outcome.status,
            cost=outcome.cost,
            iterations=outcome.iterations,
            horizon=horizon,
            t=at * horizon,
            states={name: stacked["states"][:, s] for name, s in form.states.items()},
            controls={name: stacked["controls"][:, s] for name, s in form.controls.items()},
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
        )

    def _costates(self, outcome: Outcome, p: np.ndarray) -> np.ndarray:
        """Costates at the reported points, from the multipliers.

        At a node: the derivative, with respect to its state, of what the intervals behind it add to the Lagrangian;
        at the end: minus what the intervals before it say.
        """
        fragment = self.fragment
        costates = outcome.multipliers[fragment.costate_rows] * fragment.costate_scale[:, None]
        inner = np.where(fragment.row_stages < 0, 0.0, outcome.multipliers)
        jacobian = self.program.jacobian(outcome.variables, p)[1]
        rows, columns = (np.array(part, dtype=int) for part in jacobian.sparsity().get_triplet())
        terms = np.array(jacobian.nonzeros()) * inner[rows]
        running = np.asarray(self.program.inside(outcome.variables, p).full()).reshape(-1)

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
        direct = np.asarray(self.program.parametric(v, p, lam).full()).reshape(-1)
        gradient = self.program.gradient(v, p)[1] + self.program.jacobian(v, p)[1].T @ lam
        lam_x = -np.asarray(gradient.full()).reshape(-1)
        push = np.zeros((2, sum(len(place) for place in form.bounds.places.values())))
        for index, force in ((fragment.variable_bounds, lam_x), (fragment.row_bounds, lam)):
            np.add.at(push[0], index, np.minimum(force, 0.0))  # at a lower bound
            np.add.at(push[1], index, np.maximum(force, 0.0))
        return np.asarray(direct - form.bounds.pull(p, push))

    def _residuals(
        self, v: np.ndarray, arguments: dict[str, np.ndarray]
    ) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
        """Label, fraction, value and miss of every row and of the bounds of every variable, evaluated anew."""
        form, fragment = self.formulation, self.fragment
        try:
            g = np.asarray(self.program.values(v, arguments["p"])[1].full()).reshape(-1)
        except RuntimeError:  # an integrator breaks down
            g = np.full(fragment.n_rows, np.nan)
        names = {"state": form.state_labels, "control": form.control_labels, "horizon": ("horizon",)}
        bounds = [
            f"{'' if role == 'horizon' else role + ' '}{names[role][entry]}"
            for role, entry in zip(fragment.variable_role, fragment.variable_entry, strict=True)
        ]
        value = np.concatenate([g, v])
        lower, upper = (np.concatenate([arguments[s + "g"], arguments[s + "x"]]) for s in ("lb", "ub"))
        at = np.concatenate([fragment.row_fractions, fragment.variable_fraction])
        labels = [*fragment.row_labels, *(f"bound of {name}" for name in bounds)]
        return labels, at, value, np.maximum(lower - value, value - upper)

    def _diagnosis(self, outcome: Outcome, arguments: dict[str, np.ndarray], horizon: float) -> str:
        """What went wrong: the worst residuals by constraint, state and time."""
        labels, at, value, miss = self._residuals(outcome.variables, arguments)
        lines = [f"problem {self.problem.name!r}: {self.solver_name} ended with {outcome.status}"]
        lines.append(f"after {outcome.iterations} iterations, cost {outcome.cost:.6g}, horizon {horizon:.6g} s")
        broken = np.flatnonzero(~np.isfinite(value))
        for i in broken[:WORST]:
            lines.append(f"  {labels[i]} is not finite at {at[i] * horizon:.4g} s")
        seen: set[str] = set()
        for i in np.argsort(-np.where(np.isfinite(miss), miss, -np.inf)):
            if len(seen) == WORST or not miss[i] > 1e-8:
                break
            if labels[i] not in seen:
                seen.add(labels[i])
                lines.append(f"  {labels[i]} is missed by {miss[i]:.3g} at {at[i] * horizon:.4g} s")
        lines += self._at_bounds(outcome.variables, arguments, horizon)
        if not seen and not broken.size:
            lines.append("  all constraints are met; the plan is feasible but not optimal")
        return "\n".join(lines)


def by_name(what: str, values: Any) -> dict[str, Any]:
    """A dictionary or nothing as a dictionary of its own; ProblemError for anything else."""
    if not isinstance(values, Mapping | None):
        raise ProblemError(f"{what} must be a dictionary by name, not {values!r}")
    return dict(values or {})


def compiler_options() -> dict[str, Any]:
    """Options that make casadi compile a function with the machine's C compiler, its files in the temporary folder."""
    shell = {"flags": ["-O1"], "directory": tempfile.gettempdir() + os.sep}
    return {"jit": True, "compiler": "shell", "jit_name": "selfmotion", "jit_options": shell}


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
        check: Raise where the solver fails; False returns the unsuccessful solution with its status.

    Raises:
        ProblemError: The problem, method or arguments cannot be right.
        SolveError: The solver failed; names the worst residuals by constraint, state and time.
    """
    return prepare(problem, method, solver=solver, options=options).solve(parameters, guess, check)
