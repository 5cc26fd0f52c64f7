"""Calls of solvers for nonlinear programs, and conversion of their results to solutions.

A call handles options, progress, interruption and status. The solution adds curves, costates and cost gradients.
"""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import LOG, FatropMonitor, IterationMonitor, casadi_silenced, stop_requests_polled
from ocp.curves import PiecewisePolynomial
from ocp.direct.assembly import Program, Stages, Transcription
from ocp.errors import ProblemError, SolveError, SolverStatus
from ocp.problem.formulation import Formulation
from ocp.solution import Solution

SOLVER_RESIDUAL = 1e-8
"""Residual of gradients and constraint rows, relative to the largest multiplier and variable, that is accepted where
rounding prevents a smaller residual. In the solver's scaled units it is also the smallest significant multiplier."""
IPOPT = {
    "tol": 1e-10,
    "constr_viol_tol": 1e-9,
    "acceptable_tol": SOLVER_RESIDUAL,
    "acceptable_constr_viol_tol": SOLVER_RESIDUAL,
    "acceptable_iter": 10,
    "max_iter": 1000,
    "bound_relax_factor": 0.0,
    "honor_original_bounds": "yes",
    # the order that MUMPS chooses itself takes up to ten times as long for joined phases
    "mumps_pivot_order": 0,
    # MUMPS' own 1e-6 loses the sign of eigenvalues on spatial machines, for which IPOPT then regularises
    "mumps_pivtol": 1e-3,
    "print_level": 0,
    "sb": "yes",
}
FATROP = {"tol": 1e-10, "print_level": 0, "max_iter": 1000}
SLEQP = {"print_level": 0, "max_iter": 1000}
DEFAULTS: dict[str, dict[str, Any]] = {"ipopt": IPOPT, "fatrop": FATROP, "sleqp": SLEQP}
SOLVERS = tuple(DEFAULTS)
"""Names of the supported solvers."""

FATROP_FLAGS = {0: SolverStatus.SOLVED, 1: SolverStatus.ITERATION_LIMIT, 2: SolverStatus.ACCEPTABLE}
WORDS = {
    "optimal": SolverStatus.SOLVED,
    "unbounded": SolverStatus.DIVERGING,
    "deadpoint": SolverStatus.STEP_FAILED,
    "iteration limit": SolverStatus.ITERATION_LIMIT,
    "Feasible_Point_Found": SolverStatus.ACCEPTABLE,
}
"""Solver statuses by status text: that of SLEQP, and that of IPOPT for as many equations as variables."""
KINDS = {"IpoptInterface": "ipopt", "FatropInterface": "fatrop", "SLEQPInterface": "sleqp"}
"""Names of solvers by their CasADi class."""


@dataclass(frozen=True)
class Outcome:
    """Result of one run of a solver for nonlinear programs.

    Attributes:
        variables, cost, rows: Last iterate, its cost and the values of its constraint rows.
        multipliers: Multipliers of the rows.
        status: How the solver ended.
        message: The status with advice, or the error that ended the solver.
        iterations, seconds: Number of iterations, and wall time.
        regularised: Whether the cost may not curve upwards at the end: the last step used a modified Hessian, or there
            was no step.
        solver: Name of the solver.
    """

    variables: np.ndarray
    cost: float
    rows: np.ndarray
    multipliers: np.ndarray
    status: SolverStatus
    message: str
    iterations: int
    seconds: float
    regularised: bool = False
    solver: str = ""

    @property
    def success(self) -> bool:
        """Whether the solver reports an optimum."""
        return self.status.is_success


def build_solver(
    program: Program, solver: str, options: dict[str, Any], *, stages: Stages | None, title: str
) -> tuple[Any, IterationMonitor | FatropMonitor]:
    """Return the casadi solver of a nonlinear program, and the callback by which the solver can be stopped.

    Raises:
        ProblemError: The solver does not accept an option.
        SolveError: The solver's library cannot be loaded, for example for lack of file handles.
    """
    n, m, n_p = (program.nlp[key].numel() for key in ("x", "g", "p"))
    settings: dict[str, Any] = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
    solver_options = {**DEFAULTS[solver], **options}
    if not solver_options.get("print_level", 0) and "max_iter" in solver_options:
        settings["show_eval_warnings"] = False
    nlp = program.nlp
    progress: IterationMonitor | FatropMonitor
    if solver in ("ipopt", "sleqp"):
        progress = IterationMonitor(n, m, n_p, title=title, show=not solver_options["print_level"])
        settings["iteration_callback"] = progress
    if solver == "ipopt":
        settings["no_nlp_grad"] = True  # compiled functions only have the given derivatives
        settings |= {"jac_g": program.jacobian, "grad_f": program.gradient, "hess_lag": program.hessian}
    elif solver == "sleqp":
        # like fatrop's, its interface looks up given derivatives in its cache
        settings["cache"] = {"nlp_grad_f": program.gradient, "nlp_jac_g": program.jacobian}
        # options of the interface, not of the solver
        settings |= {key: solver_options.pop(key) for key in SLEQP if key in solver_options}
    else:
        assert stages is not None
        nlp = {**nlp, "f": finite(nlp["f"]), "g": finite(nlp["g"])}
        progress = FatropMonitor(n, title)
        # this interface has no options for given derivatives; it looks them up in its cache under these names
        settings |= {
            "cache": fatrop_functions(program, progress),
            "structure_detection": "manual",
            "nx": list(stages.states),
            "nu": list(stages.controls),
            "ng": list(stages.rows),
            "N": len(stages.states) - 1,
        }
    if not ca.has_nlpsol(solver):
        try:
            ca.load_nlpsol(solver)
        except RuntimeError as error:
            reason = str(error).partition("Error code: ")[2].partition("\n")[0] or last_line(error)
            raise SolveError(f"{solver} cannot be loaded: {reason}", name="solver", value=solver) from error
    try:
        return ca.nlpsol("solver", solver, nlp, {**settings, solver: solver_options}), progress
    except RuntimeError as error:
        text = f"{solver} does not take these options {options!r}: {last_line(error)}"
        raise ProblemError(text, name="options", value=options) from error


def iteration_limit(solver: str, options: dict[str, Any]) -> int:
    """Return the iteration limit among the options of a solver; 0 if the given limit is not a number."""
    limit = {"max_iter": IPOPT["max_iter"], **DEFAULTS[solver], **options}["max_iter"]
    return int(limit) if isinstance(limit, int | float | np.number) else 0


def fatrop_functions(program: Program, watch: FatropMonitor) -> dict[str, Any]:
    """Return the derivatives of a nonlinear program with the signatures that casadi's fatrop interface requires.

    The interface raises unless the next state has factor 1 in the rows that close gaps. A zero Jacobian therefore stops
    the solver, which cannot be stopped otherwise.
    """
    n, m, n_p = (program.nlp[key].numel() for key in ("x", "g", "p"))
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", n_p)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    # fatrop loops forever on nan; from huge values it steps back
    gradient, (rows, jacobian) = finite(program.gradient(x, p)[1]), map(finite, program.jacobian(x, p))
    watched = ca.MX(jacobian.sparsity(), jacobian.nz[:] * watch(x))
    lagrangian = sigma * gradient + ca.mtimes(jacobian.T, lam)
    hessian = ca.triu2symm(finite(program.hessian(x, p, sigma, lam)))
    symbols, names = [x, p, sigma, lam], ["x", "p", "lam_f", "lam_g"]
    outputs = ["f", "g", "grad_gamma_x", "grad_gamma_p"]
    values = [*program.values(x, p), lagrangian, ca.MX(n_p, 1)]
    functions = (
        ca.Function("nlp_grad_f", [x, p], [gradient], ["x", "p"], ["grad_f_x"]),
        ca.Function("nlp_jac_g", [x, p], [rows, watched], ["x", "p"], ["g", "jac_g_x"]),
        ca.Function("nlp_hess_l", symbols, [lagrangian, hessian], names, ["grad_gamma_x", "hess_gamma_x_x"]),
        ca.Function("nlp_grad", symbols, values, names, outputs),  # only its gradient in x is used
    )
    return {function.name(): function for function in functions}


def finite(expression: Any) -> Any:
    """Return an expression in which infinite entries are huge numbers of the same sign, and nan is a huge number."""
    return ca.MX(expression.sparsity(), ca.fmax(ca.fmin(expression.nz[:], 1e20), -1e20))


def call_solver(solver: Any, progress: IterationMonitor | FatropMonitor, arguments: dict[str, np.ndarray]) -> Outcome:
    """Run a solver and return its result: the last iterate if Ctrl-C or a time limit stops the solver."""
    began = time.monotonic()
    name = KINDS[solver.class_name()]
    progress.open(arguments["lbg"], arguments["ubg"])
    progress.iterate = np.asarray(arguments["x0"])
    log_line(f"solving {progress.title!r}: {arguments['lbx'].size} variables, {arguments['lbg'].size} rows")
    try:
        # SLEQP prints each subproblem that it gives up
        with stop_requests_polled(), casadi_silenced() if name == "sleqp" else nullcontext():
            result = solver(**(tighten_for_fatrop(arguments) if name == "fatrop" else arguments))
    except RuntimeError as error:
        text = str(error).lower()
        if progress.stopped or name == "sleqp":  # SLEQP's interface raises wherever it fails
            return interrupted_iterate(solver, progress, arguments, began)
        if "option not supported" in text or "type mismatch" in text:  # fatrop checks its options only now
            raise ProblemError(f"fatrop does not take this option: {last_line(error)}", name="options") from error
        raise
    finally:
        progress.close()
    stats = solver.stats()
    word = str(stats.get("return_status", ""))
    status = WORDS.get(word) or SolverStatus.of_word(word)
    if "fatrop" in stats:
        status = FATROP_FLAGS.get(int(stats["fatrop"]["return_flag"]), SolverStatus.STEP_FAILED)
    if status is SolverStatus.SMALL_STEP and as_good_as_rounding_allows(stats, result):
        status = SolverStatus.ACCEPTABLE
    status = progress.stopped or status
    values = {key: np.asarray(result[key], dtype=float).reshape(-1) for key in ("x", "f", "g", "lam_g")}
    if status.is_success and not all(np.all(np.isfinite(v)) for v in values.values()):
        status = SolverStatus.NOT_FINITE
    if status is SolverStatus.ACCEPTABLE and largest_violation(values, arguments) > SOLVER_RESIDUAL:
        status = SolverStatus.STEP_FAILED
    iterations, seconds = int(stats.get("iter_count", 0)), time.monotonic() - began
    cost, message = float(values["f"][0]), word if status is SolverStatus.FAILED else status.message
    log_line(f"solved {progress.title!r}: {status}, cost {cost:.6g}, {iterations} iterations, {seconds:.3g} s")
    result_values = values["x"], cost, values["g"], values["lam_g"]
    return Outcome(*result_values, status, message, iterations, seconds, has_regularised_hessian(stats), name)


def interrupted_iterate(
    solver: Any, progress: IterationMonitor | FatropMonitor, arguments: dict[str, np.ndarray], began: float
) -> Outcome:
    """Return the last iterate of a solver that was stopped or failed, with nan for the unknown multipliers."""
    cost, rows = (np.asarray(v.full()).reshape(-1) for v in solver.oracle()(progress.iterate, arguments["p"]))
    unknown, seconds = np.full(rows.shape, np.nan), time.monotonic() - began
    status = progress.stopped or SolverStatus.STEP_FAILED
    log_line(f"stopped {progress.title!r}: {status}, {progress.iterations} iterations, {seconds:.3g} s")
    name = KINDS[solver.class_name()]
    values = progress.iterate, float(cost[0]), rows, unknown
    return Outcome(*values, status, status.message, progress.iterations, seconds, False, name)


def log_line(words: str) -> None:
    """Write one line to the log, unless a terminal shows the progress."""
    if not sys.stderr.isatty():
        LOG.info(words)


def has_regularised_hessian(stats: dict[str, Any]) -> bool:
    """Return whether ipopt modified the Hessian in its last step or made no step; False for other solvers."""
    sizes = stats.get("iterations", {}).get("regularization_size", ())
    return len(sizes) > 0 and (len(sizes) == 1 or sizes[-1] > 0)


def broken_down(solver: Any, arguments: dict[str, np.ndarray], error: RuntimeError) -> Outcome:
    """Return an unsuccessful result at the initial point, for a solver run that an evaluation error ended."""
    rows = np.full(arguments["lbg"].shape, np.nan)
    status = SolverStatus.NOT_FINITE
    values = arguments["x0"], np.nan, rows, rows
    return Outcome(*values, status, f"{status}: {last_line(error)}", 0, 0.0, False, KINDS[solver.class_name()])


def as_good_as_rounding_allows(stats: dict[str, Any], result: dict[str, Any]) -> bool:
    """Return whether ipopt stalls at a solution only because rounding errors exceed its absolute tolerances."""
    history = stats["iterations"]
    states, forces = (max(1.0, float(ca.norm_inf(result[key]))) for key in ("x", "lam_g"))
    return bool(history["inf_pr"][-1] <= SOLVER_RESIDUAL * states and history["inf_du"][-1] <= SOLVER_RESIDUAL * forces)


def largest_violation(values: dict[str, np.ndarray], arguments: dict[str, np.ndarray]) -> float:
    """Return the largest violation of a bound or constraint, relative to the largest variable (at least 1)."""
    gaps = [(arguments[f"lb{k}"] - values[k], values[k] - arguments[f"ub{k}"]) for k in ("x", "g")]
    worst = max(float(np.max(gap, initial=0.0)) for pair in gaps for gap in pair)
    return worst / max(1.0, float(np.max(np.abs(values["x"]), initial=0.0)))


def tighten_for_fatrop(arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return solver arguments whose bounds are tightened by as much as fatrop relaxes them."""
    relaxation, result = 1e-8, dict(arguments)  # fatrop's own; its casadi interface has no option for it
    for low, high in (("lbx", "ubx"), ("lbg", "ubg")):
        lower, upper = arguments[low], arguments[high]
        is_range = lower < upper
        for key, bound, sign in ((low, lower, 1.0), (high, upper, -1.0)):
            shift = is_range & np.isfinite(bound)
            size = np.maximum(1.0, np.abs(np.where(shift, bound, 0.0)))
            result[key] = np.where(shift, bound + sign * relaxation * size, bound)
    return result


def last_line(error: BaseException) -> str:
    """Return the last line of an error message."""
    return str(error).strip().splitlines()[-1]


def solution_of(
    form: Formulation, transcription: Transcription, program: Program, outcome: Outcome, *, p: np.ndarray, **fields: Any
) -> Solution:
    """Convert a solver's result to a solution with interpolants, costates and cost gradients.

    Args:
        fields: Further fields of the solution: method, start, seconds.
    """
    v = outcome.variables
    horizon = transcription.duration(form, v, p)
    states, controls = transcription.interpolants(v, p, horizon)
    interval, place = transcription.report
    mesh = transcription.mesh
    at = mesh[interval] + np.diff(mesh)[interval] * place
    at[-1] = 1.0
    costates = costates_of(program, transcription, outcome, p)
    gradient = _cost_gradient(form, program, transcription, outcome, p) if form.np else np.zeros(0)
    x, u = v[transcription.report_states], controls.within(interval, place)
    return Solution(
        name=form.name,
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
        cost_gradients={name: gradient[s] for name, s in form.parameters.items()},
        state_interpolant=states,
        control_interpolant=controls,
        costate_interpolant=costate_interpolant(transcription, costates),
        variables=v,
        multipliers=outcome.multipliers,
        problem=form.problem,
        regularised=outcome.regularised,
        **fields,
    )


def costates_of(program: Program, transcription: Transcription, outcome: Outcome, p: np.ndarray) -> np.ndarray:
    """Return the costates at the reported points, computed from the multipliers of the nonlinear program.

    At a node the costate is the derivative, with respect to the state there, of the contribution of later intervals to
    the Lagrangian. At the end it is minus the derivative of the contribution of earlier intervals.
    """
    costates = outcome.multipliers[transcription.costate_rows] * transcription.costate_scale[:, None]
    inner = np.where(transcription.row_stages < 0, 0.0, outcome.multipliers)
    numbers = program.numbers
    _, jacobian = numbers.first(outcome.variables, p)
    rows, columns = jacobian.indices, np.repeat(np.arange(transcription.size), np.diff(jacobian.indptr))
    with np.errstate(invalid="ignore"):  # the iterate of a failed solver may be infinite
        terms = jacobian.data * inner[rows]
    running = numbers.running_gradient(outcome.variables, p)

    node_of = np.full(transcription.size, -2)
    node_of[transcription.nodes] = np.arange(len(transcription.mesh))
    of_next = transcription.row_stages[rows] == node_of[columns]
    after = np.bincount(columns[of_next], weights=terms[of_next], minlength=transcription.size)
    after[transcription.start] += running[transcription.start]
    before = np.bincount(columns, weights=terms, minlength=transcription.size) + running
    after[transcription.end] = -before[transcription.end]
    at_node = transcription.costate_rows < 0
    costates[at_node] = after[transcription.nodes.T[report_nodes(transcription)]][at_node]
    return np.asarray(costates)


def report_nodes(transcription: Transcription) -> np.ndarray:
    """Return the index of the last mesh node at or before each reported point of a plan. Shape (M,)."""
    interval, place = transcription.report
    return np.asarray(interval + (place == 1.0))


def _cost_gradient(
    form: Formulation, program: Program, transcription: Transcription, outcome: Outcome, p: np.ndarray
) -> np.ndarray:
    """Return the derivative of the optimal cost with respect to parameters, on which bounds may also depend."""
    v, lam = outcome.variables, outcome.multipliers
    direct = program.numbers.parametric(v, p, lam)
    slope, jacobian = program.numbers.first(v, p)
    lam_x = -(slope + jacobian.T @ lam)
    forces = np.zeros((2, sum(len(place) for place in form.bounds.places.values())))
    for index, multiplier in ((transcription.variable_bounds, lam_x), (transcription.row_bounds, lam)):
        np.add.at(forces[0], index, np.minimum(multiplier, 0.0))  # at a lower bound
        np.add.at(forces[1], index, np.maximum(multiplier, 0.0))
    return np.asarray(direct - form.bounds.pullback(p, forces))


def costate_interpolant(transcription: Transcription, costates: np.ndarray) -> PiecewisePolynomial:
    """Return the piecewise polynomial through the reported costates; its nodes include both ends of each interval."""
    n, node_of = len(transcription.mesh) - 1, report_nodes(transcription)
    starts = np.searchsorted(node_of, np.arange(n))
    width = starts[1] - starts[0] if n > 1 else len(node_of) - 1
    index = starts[:, None] + np.arange(width + 1)
    nodes = np.append(transcription.report[1][node_of == 0], 1.0)
    return PiecewisePolynomial(transcription.mesh, nodes, costates[index])
