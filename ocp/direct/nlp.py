"""The solver call: options, progress, interruption, and words for what went wrong.

From what a solver returned to a solution: curves, costates and the derivative of the cost in the parameters.
"""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import LOG, FatropMonitor, Progress, casadi_silenced, stop_requests_polled
from ocp.curves import PiecewisePolynomial
from ocp.direct.assembly import Fragment, Program, Stages
from ocp.errors import ProblemError, SolveError
from ocp.problem.formulation import Formulation
from ocp.solution import Solution
from ocp.status import SolverStatus

__all__ = [
    "DEFAULTS",
    "SOLVERS",
    "SOLVER_RESIDUAL",
    "Outcome",
    "broken_down",
    "build_solver",
    "call_solver",
    "controls_at",
    "horizon_of",
    "largest_number_of_iterations",
    "solution_of",
]

SOLVER_RESIDUAL = 1e-8
"""What a solver may leave of slopes and rows, relative to multipliers and variables, where rounding lets it no farther;
in units of the solver the least multiplier that says anything."""
IPOPT = {
    "tol": 1e-10,
    "constr_viol_tol": 1e-9,
    "acceptable_tol": SOLVER_RESIDUAL,
    "acceptable_constr_viol_tol": SOLVER_RESIDUAL,
    "acceptable_iter": 10,
    "max_iter": 1000,
    "bound_relax_factor": 0.0,
    "honor_original_bounds": "yes",
    # the order that MUMPS chooses itself takes up to ten times as long where phases are joined
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
"""What may be asked for."""

FATROP_FLAGS = {0: SolverStatus.SOLVED, 1: SolverStatus.ITERATION_LIMIT, 2: SolverStatus.ACCEPTABLE}
WORDS = {
    "optimal": SolverStatus.SOLVED,
    "unbounded": SolverStatus.DIVERGING,
    "deadpoint": SolverStatus.STEP_FAILED,
    "iteration limit": SolverStatus.ITERATION_LIMIT,
    "Feasible_Point_Found": SolverStatus.ACCEPTABLE,
}
"""What SLEQP says, and IPOPT of as many equations as variables."""
KINDS = {"IpoptInterface": "ipopt", "FatropInterface": "fatrop", "SLEQPInterface": "sleqp"}
"""Names of solvers by the class that calls them."""


@dataclass(frozen=True)
class Outcome:
    """What a solver returned: variables, cost, constraint values, multipliers of the rows, and how it ended.

    ``message``: the status with what to try, or with the error that ended the solver.

    ``regularised``: whether the cost did not curve upwards where it ended, as far as the solver saw: its last step was
    made with a Hessian that it had changed, or it made none. ``solver``: Its name.
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
    program: Program, solver: str, options: dict[str, Any], stages: Stages | None, title: str
) -> tuple[Any, Progress | FatropMonitor]:
    """The casadi solver of a program, and what ends it where it must end.

    Raises:
        ProblemError: An option that it does not take.
        SolveError: The solver's library cannot be loaded, for want of file handles, say.
    """
    n, m, n_p = (program.nlp[key].numel() for key in ("x", "g", "p"))
    settings: dict[str, Any] = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
    own = {**DEFAULTS[solver], **options}
    if not own.get("print_level", 0) and "max_iter" in own:
        settings["show_eval_warnings"] = False
    nlp = program.nlp
    progress: Progress | FatropMonitor
    if solver in ("ipopt", "sleqp"):
        progress = Progress(n, m, n_p, title, not own["print_level"])
        settings["iteration_callback"] = progress
    if solver == "ipopt":
        settings["no_nlp_grad"] = True  # compiled functions have no derivatives but those that are ready
        settings |= {"jac_g": program.jacobian, "grad_f": program.gradient, "hess_lag": program.hessian}
    elif solver == "sleqp":
        # like fatrop's, its interface looks for ready-made derivatives in its cache
        settings["cache"] = {"nlp_grad_f": program.gradient, "nlp_jac_g": program.jacobian}
        settings |= {key: own.pop(key) for key in SLEQP if key in own}  # its interface asks for these outside
    else:
        assert stages is not None
        nlp = {**nlp, "f": finite(nlp["f"]), "g": finite(nlp["g"])}
        progress = FatropMonitor(n, title)
        # this interface has no options for ready-made derivatives; it looks for them in its cache under these names
        settings |= {
            "cache": fatrop_functions(program, progress),
            "structure_detection": "manual",
            "nx": list(stages.states),
            "nu": list(stages.controls),
            "ng": list(stages.rows),
            "N": len(stages.states) - 1,
        }
    check_loaded(solver)
    try:
        return ca.nlpsol("solver", solver, nlp, {**settings, solver: own}), progress
    except RuntimeError as error:
        words = f"{solver} does not take these options {options!r}: {last_line(error)}"
        raise ProblemError(words, name="options", value=options) from error


def largest_number_of_iterations(solver: str, options: dict[str, Any]) -> int:
    """After how many iterations a solver gives up, by its options; 0 where these make no sense."""
    most = {"max_iter": IPOPT["max_iter"], **DEFAULTS[solver], **options}["max_iter"]
    return int(most) if isinstance(most, int | float | np.number) else 0


def check_loaded(solver: str) -> None:
    """Raise SolveError, with the system's reason, where the library of a solver cannot be loaded."""
    if ca.has_nlpsol(solver):
        return
    try:
        ca.load_nlpsol(solver)
    except RuntimeError as error:
        why = str(error).partition("Error code: ")[2].partition("\n")[0] or last_line(error)
        raise SolveError(f"{solver} cannot be loaded: {why}", name="solver", value=solver) from error


def fatrop_functions(program: Program, watch: FatropMonitor) -> dict[str, Any]:
    """The derivatives of a program with the signatures that casadi's fatrop interface uses.

    The interface raises where the next state does not stand with factor 1 in the rows that close gaps: so a Jacobian of
    zeros ends the solver, which has no other way to be stopped.
    """
    n, m, n_p = (program.nlp[key].numel() for key in ("x", "g", "p"))
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", n_p)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    # fatrop loops for ever on what is not a number; from what is huge it steps back
    gradient, (rows, jacobian) = finite(program.gradient(x, p)[1]), map(finite, program.jacobian(x, p))
    watched = ca.MX(jacobian.sparsity(), jacobian.nz[:] * watch(x))
    lagrangian = sigma * gradient + ca.mtimes(jacobian.T, lam)
    hessian = ca.triu2symm(finite(program.hessian(x, p, sigma, lam)))
    functions = (
        ca.Function("nlp_grad_f", [x, p], [gradient], ["x", "p"], ["grad_f_x"]),
        ca.Function("nlp_jac_g", [x, p], [rows, watched], ["x", "p"], ["g", "jac_g_x"]),
        ca.Function(
            "nlp_hess_l",
            [x, p, sigma, lam],
            [lagrangian, hessian],
            ["x", "p", "lam_f", "lam_g"],
            ["grad_gamma_x", "hess_gamma_x_x"],
        ),
        ca.Function(
            "nlp_grad",  # of which the gradient in x is asked alone
            [x, p, sigma, lam],
            [*program.values(x, p), lagrangian, ca.MX(n_p, 1)],
            ["x", "p", "lam_f", "lam_g"],
            ["f", "g", "grad_gamma_x", "grad_gamma_p"],
        ),
    )
    return {function.name(): function for function in functions}


def finite(expression: Any) -> Any:
    """The same with a huge number for every entry that is infinite, of its sign, or is not a number."""
    return ca.MX(expression.sparsity(), ca.fmax(ca.fmin(expression.nz[:], 1e20), -1e20))


def call_solver(solver: Any, progress: Progress | FatropMonitor, arguments: dict[str, np.ndarray]) -> Outcome:
    """Run a solver; Ctrl-C and a time limit stop it between two iterations, at its last iterate."""
    began = time.monotonic()
    kind = KINDS[solver.class_name()]
    progress.open(arguments["lbg"], arguments["ubg"])
    progress.iterate = np.asarray(arguments["x0"])
    tell(f"solving {progress.title!r}: {arguments['lbx'].size} variables, {arguments['lbg'].size} rows")
    try:
        # SLEQP tells of each subproblem that it gives up
        with stop_requests_polled(), casadi_silenced() if kind == "sleqp" else nullcontext():
            result = solver(**(tightened(arguments) if kind == "fatrop" else arguments))
    except RuntimeError as error:
        words = str(error).lower()
        if progress.stopped or kind == "sleqp":  # SLEQP's interface raises wherever it fails
            return stopped(solver, progress, arguments, began)
        if "option not supported" in words or "type mismatch" in words:  # fatrop looks at its options only now
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
    if status is SolverStatus.ACCEPTABLE and missed(values, arguments) > SOLVER_RESIDUAL:
        status = SolverStatus.STEP_FAILED
    iterations, seconds = int(stats.get("iter_count", 0)), time.monotonic() - began
    cost, message = float(values["f"][0]), word if status is SolverStatus.FAILED else status.message
    tell(f"solved {progress.title!r}: {status}, cost {cost:.6g}, {iterations} iterations, {seconds:.3g} s")
    found = values["x"], cost, values["g"], values["lam_g"]
    return Outcome(*found, status, message, iterations, seconds, regularised(stats), kind)


def stopped(solver: Any, at: Progress | FatropMonitor, arguments: dict[str, np.ndarray], began: float) -> Outcome:
    """The iterate at which a solver stopped, or was stopped, that returned nothing; its multipliers are not known."""
    cost, rows = (np.asarray(v.full()).reshape(-1) for v in solver.oracle()(at.iterate, arguments["p"]))
    unknown, seconds = np.full(rows.shape, np.nan), time.monotonic() - began
    status = at.stopped or SolverStatus.STEP_FAILED
    tell(f"stopped {at.title!r}: {status}, {at.iterations} iterations, {seconds:.3g} s")
    kind = KINDS[solver.class_name()]
    found = at.iterate, float(cost[0]), rows, unknown
    return Outcome(*found, status, status.message, at.iterations, seconds, False, kind)


def tell(words: str) -> None:
    """One line for a log, where there is no terminal that shows progress."""
    if not sys.stderr.isatty():
        LOG.info(words)


def regularised(stats: dict[str, Any]) -> bool:
    """Whether ipopt changed the Hessian in its last step, or made no step; fatrop does not tell."""
    sizes = stats.get("iterations", {}).get("regularization_size", ())
    return len(sizes) > 0 and (len(sizes) == 1 or sizes[-1] > 0)


def broken_down(solver: Any, arguments: dict[str, np.ndarray], error: RuntimeError) -> Outcome:
    """The outcome of a solver that a function of the program threw out, as an integrator does: its start."""
    rows = np.full(arguments["lbg"].shape, np.nan)
    status = SolverStatus.NOT_FINITE
    found = arguments["x0"], np.nan, rows, rows
    return Outcome(*found, status, f"{status}: {last_line(error)}", 0, 0.0, False, KINDS[solver.class_name()])


def as_good_as_rounding_allows(stats: dict[str, Any], result: dict[str, Any]) -> bool:
    """Whether ipopt stands still at a solution: its tolerances are absolute, and large states round above them."""
    history = stats["iterations"]
    states, forces = (max(1.0, float(ca.norm_inf(result[key]))) for key in ("x", "lam_g"))
    return bool(history["inf_pr"][-1] <= SOLVER_RESIDUAL * states and history["inf_du"][-1] <= SOLVER_RESIDUAL * forces)


def missed(values: dict[str, np.ndarray], arguments: dict[str, np.ndarray]) -> float:
    """Largest violation of the bounds of variables and rows, relative to the largest variable (at least 1)."""
    gaps = [(arguments[f"lb{k}"] - values[k], values[k] - arguments[f"ub{k}"]) for k in ("x", "g")]
    worst = max(float(np.max(gap, initial=0.0)) for pair in gaps for gap in pair)
    return worst / max(1.0, float(np.max(np.abs(values["x"]), initial=0.0)))


def tightened(arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Bounds drawn in by as much as fatrop widens them, so that plans keep the bounds that were asked."""
    relaxation, own = 1e-8, dict(arguments)  # fatrop's own; its casadi interface has no option for it
    for low, high in (("lbx", "ubx"), ("lbg", "ubg")):
        lower, upper = arguments[low], arguments[high]
        room = lower < upper
        for key, bound, sign in ((low, lower, 1.0), (high, upper, -1.0)):
            move = room & np.isfinite(bound)
            size = np.maximum(1.0, np.abs(np.where(move, bound, 0.0)))
            own[key] = np.where(move, bound + sign * relaxation * size, bound)
    return own


def last_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[-1]


def horizon_of(form: Formulation, fragment: Fragment, outcome: Outcome, p: np.ndarray) -> float:
    """The final time of an outcome, s."""
    return float(form.horizon_at(p) if fragment.horizon is None else outcome.variables[fragment.horizon])


def solution_of(
    form: Formulation, fragment: Fragment, program: Program, outcome: Outcome, p: np.ndarray, **told: Any
) -> Solution:
    """The solution that an outcome is.

    Args:
        told: What else a solution says of itself: method, start, seconds.
    """
    v = outcome.variables
    horizon = horizon_of(form, fragment, outcome, p)
    states, controls = fragment.interpolants(v, p, horizon)
    piece, place = fragment.report
    mesh = fragment.mesh
    at = mesh[piece] + np.diff(mesh)[piece] * place
    at[-1] = 1.0
    costates = costates_of(program, fragment, outcome, p)
    by_parameter = cost_gradient(form, program, fragment, outcome, p) if form.np else np.zeros(0)
    x, u = v[fragment.report_states], controls_at(controls, fragment, piece, place)
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
        cost_gradients={name: by_parameter[s] for name, s in form.parameters.items()},
        state_interpolant=states,
        control_interpolant=controls,
        costate_interpolant=costate_interpolant(fragment, costates),
        variables=v,
        multipliers=outcome.multipliers,
        problem=form.problem,
        regularised=outcome.regularised,
        **told,
    )


def costates_of(program: Program, fragment: Fragment, outcome: Outcome, p: np.ndarray) -> np.ndarray:
    """Costates at the reported points, from the multipliers.

    At a node: the derivative, with respect to its state, of what the intervals behind it add to the Lagrangian;
    at the end: minus what the intervals before it say.
    """
    costates = outcome.multipliers[fragment.costate_rows] * fragment.costate_scale[:, None]
    inner = np.where(fragment.row_stages < 0, 0.0, outcome.multipliers)
    numbers = program.numbers
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


def cost_gradient(
    form: Formulation, program: Program, fragment: Fragment, outcome: Outcome, p: np.ndarray
) -> np.ndarray:
    """Derivative of the optimal cost in the parameters: of the Lagrangian, and through every active bound."""
    v, lam = outcome.variables, outcome.multipliers
    direct = program.numbers.parametric(v, p, lam)
    slope, jacobian = program.numbers.first(v, p)
    lam_x = -(slope + jacobian.T @ lam)
    push = np.zeros((2, sum(len(place) for place in form.bounds.places.values())))
    for index, force in ((fragment.variable_bounds, lam_x), (fragment.row_bounds, lam)):
        np.add.at(push[0], index, np.minimum(force, 0.0))  # at a lower bound
        np.add.at(push[1], index, np.maximum(force, 0.0))
    return np.asarray(direct - form.bounds.pullback(p, push))


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
