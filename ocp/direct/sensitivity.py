"""Sensitivity of a plan to a parameter, from the first-order conditions at the plan.

The conditions hold at every nearby parameter. Their derivative is a linear system for the derivatives of variables and
multipliers, with the active limits held (Fiacco 1976; Buskens, Maurer 2000, doi 10.1016/S0377-0427(00)00308-9): one
factorisation, and one back-substitution for each entry of the parameter.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy

from ocp.direct.active_set import RESOLVED, Conditions, conditions
from ocp.direct.assembly import Program, Transcription, assemble
from ocp.direct.diagnosis import variable_names
from ocp.direct.discretisation import Collocation, MultipleShooting
from ocp.direct.nlp import Outcome
from ocp.direct.scaling import Pattern, compute_scales, sizes_along
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.values import symbols_of
from ocp.solution import Solution
from ocp.solution_data import Sensitivity, entry_named

METHODS = {"Collocation": Collocation, "MultipleShooting": MultipleShooting}
"""Classes of the direct methods by the name of the type that a solution stores."""
SOFTENING = 1e-11
"""Regularisation of dependent constraint rows in the linear system, relative to row size and curvature."""
REFINEMENTS = 4
"""Number of steps of iterative refinement, which correct for the regularisation."""


def sensitivity(solution: Solution, name: str) -> Sensitivity:
    """Return the derivatives of a plan with respect to a parameter; see :meth:`ocp.solution.Solution.sensitivity`.

    Raises:
        ProblemError: An unknown parameter; a plan that is not an optimum of a direct method under the bounds of its
            problem; or active limits that contradict each other when the parameter changes.
    """
    form, transcription, program = program_of(solution)
    place = entry_named("parameter", name, form.parameters)
    columns = list(range(place.start, place.stop))
    v, lam, p = solution.variables, solution.multipliers, form.parameter_vector(solution.parameters)
    bounds = bounds_to_solve(form, p)
    arguments = transcription.arguments(p, bounds)
    pattern = Pattern(form, transcription, program)
    names = {*form.states, *form.controls, "horizon"}
    scales = compute_scales(pattern, sizes_along(pattern, v, names, bounds=bounds, p=p), v, p)
    a, b, c = scales.variables, scales.rows, scales.cost
    rows = np.asarray(program.values(v, p)[1].full()).ravel()
    outcome = Outcome(v, solution.cost, rows, lam, solution.status, solution.message, 0, 0.0)
    at = conditions(program, outcome, arguments, scales)

    slope, change = _by_parameters(transcription, v, p, lam, columns)
    slope, change = slope * a[:, None] / c, change / b[:, None]
    q = ca.MX.sym("p", len(p))
    moves = ca.Function("moves", [q], [ca.jacobian(side, q)[:, columns] for side in form.bounds.function(q)])(p)
    low, high = (np.asarray(move.full()) for move in moves)
    low_x, high_x = (side[transcription.variable_bounds] / a[:, None] for side in (low, high))
    low_g, high_g = (side[transcription.row_bounds] / b[:, None] for side in (low, high))
    at_x = np.where((at.of_bounds > 0)[:, None], high_x, low_x)
    at_g = np.where((at.of_rows > 0)[:, None], high_g, low_g)
    dv, of_rows, of_bounds = _solve_system(at, slope, change, at_x, at_g)

    # distance to the next limit, and of multipliers to zero
    dg = at.jacobian @ dv + change
    values = np.concatenate([v / a, rows / b])
    rates = np.vstack([dv, dg])
    sides = [np.concatenate([arguments[f"{s}x"] / a, arguments[f"{s}g"] / b]) for s in ("lb", "ub")]
    side_rates = [np.vstack([low_x, low_g]), np.vstack([high_x, high_g])]
    held = np.concatenate([at.fixed, at.held])
    force, force_rates = np.concatenate([at.of_bounds, at.of_rows]), np.vstack([of_bounds, of_rows])
    is_equality = sides[0] == sides[1]
    labels = [*variable_names(form, transcription), *transcription.row_labels]
    value = p[place]
    ends = np.tile([[-np.inf], [np.inf]], (1, len(columns)))
    limit_names = [["", ""] for _ in columns]
    with np.errstate(invalid="ignore"):
        distances = [
            (np.where(held, np.inf, values - sides[0]), rates - side_rates[0]),
            (np.where(held, np.inf, sides[1] - values), side_rates[1] - rates),
            (np.where(held & ~is_equality, np.abs(force), np.inf), np.sign(force)[:, None] * force_rates),
        ]
    for distance, rate in distances:
        finite = np.flatnonzero(np.isfinite(distance))
        distances_left = np.where(distance[finite] < RESOLVED, 0.0, distance[finite])
        for k in range(len(columns)):
            for side, sign in ((0, -1.0), (1, 1.0)):
                speed = -sign * rate[finite, k]
                approaching = np.flatnonzero(speed > RESOLVED * np.abs(rate[finite, k]).max(initial=0.0))
                if not approaching.size:
                    continue
                steps = distances_left[approaching] / speed[approaching]
                first = int(np.argmin(steps))
                if steps[first] < abs(ends[side, k]):
                    ends[side, k] = sign * steps[first]
                    limit_names[k][side] = labels[finite[approaching[first]]]

    state_rates = (a[:, None] * dv)[transcription.report_states]
    input_rates = control_rates(transcription, solution, p, a[:, None] * dv)
    index = transcription.horizon
    by_time = high[form.bounds.places["horizon"][0]] if index is None else dv[index] * a[index]
    return Sensitivity(
        name=name,
        value=value,
        t=solution.t,
        states={name: state_rates[:, place] for name, place in form.states.items()},
        controls={name: input_rates[:, place] for name, place in form.controls.items()},
        horizon=np.asarray(by_time, dtype=float),
        cost=solution.cost_gradients[name],
        lower=value + ends[0],
        upper=value + ends[1],
        limits=tuple((below, above) for below, above in limit_names),
    )


def program_of(solution: Solution) -> tuple[Formulation, Transcription, Program]:
    """Return the formulation, the transcription and the nonlinear program of which a given plan is an optimum.

    Raise ProblemError for any other plan.
    """
    plan = f"plan {solution.name!r}"
    settings = dict(solution.method)
    method_name = settings.pop("type")
    if method_name not in METHODS or solution.problem is None:
        text = f"{plan}: sensitivities need a plan of Collocation(...) or MultipleShooting(...) with its problem"
        raise ProblemError(text, name="method", value=method_name)
    if not solution.success or solution.bound_tightening is not None:
        text = f"{plan}: it is not an optimum under the bounds of its problem"
        raise ProblemError(text, name="solution", value=solution.message)
    form = Formulation.of(solution.problem)
    method = METHODS[method_name](**settings)
    for staged in (False, True):
        transcription = method.transcribe(form, staged=staged)
        if (transcription.size, transcription.n_rows) == (len(solution.variables), len(solution.multipliers)):
            break
    else:
        text = f"{plan}: it is not a solution of its problem by its method"
        raise ProblemError(text, name="variables", value=len(solution.variables), limit=transcription.size)
    return form, transcription, assemble(transcription, form.np)


def _by_parameters(
    transcription: Transcription, v: np.ndarray, p: np.ndarray, lam: np.ndarray, columns: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate the gradient of the Lagrangian (n, k) and the constraints (m, k) with respect to k parameters."""
    slope, change = np.zeros((transcription.size, len(columns))), np.zeros((transcription.n_rows, len(columns)))
    for block in transcription.blocks:
        function = block.function
        symbol = symbols_of(function).sym
        inner, d, q = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
        cost, g = function(inner, d, q)
        mu = symbol("mu", g.numel())
        lagrangian = ca.gradient(cost + ca.dot(mu, g), inner)
        outputs = [ca.densify(ca.jacobian(part, q)[:, columns]) for part in (lagrangian, ca.vec(g))]
        count = block.variables.shape[1]
        function_of_all = ca.Function("by_parameters", [inner, d, q, mu], outputs).map(count)
        values = function_of_all(v[block.variables], block.data, np.tile(p[:, None], (1, count)), lam[block.rows])
        for indices, part, total in zip((block.variables, block.rows), values, (slope, change), strict=True):
            np.add.at(total, indices, np.asarray(part.full()).reshape(len(indices), count, len(columns)))
    return slope, change


def _solve_system(
    at: Conditions, slope: np.ndarray, change: np.ndarray, at_x: np.ndarray, at_g: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the scaled derivatives of the variables and of all multipliers with respect to k parameters.

    Shapes (n, k), (m, k) and (n, k).

    Args:
        slope, change: Derivatives of the gradient of the Lagrangian and of the rows, with fixed variables.
        at_x, at_g: Derivatives of the limits of active variables and rows.
    """
    fixed, free, held = (np.flatnonzero(which) for which in (at.fixed, ~at.fixed, at.held))
    dv = np.zeros_like(slope)
    dv[fixed] = at_x[fixed]
    hessian, rows = at.hessian, at.jacobian[held]
    largest = max(float(np.abs(hessian.data).max(initial=0.0)), 1e-300)
    active_rows = rows[:, free]
    size = np.sqrt(np.asarray(active_rows.multiply(active_rows).sum(axis=1)).ravel())
    weight = largest / np.where(size > 0, size, 1.0)
    active_rows = scipy.sparse.diags_array(weight) @ active_rows
    sides = np.vstack([-(slope + hessian @ dv)[free], weight[:, None] * (at_g - change - at.jacobian @ dv)[held]])
    n, m = len(free), len(held)
    system = hessian[free][:, free]
    if m:
        system = scipy.sparse.block_array([[system, active_rows.T], [active_rows, None]], format="csc")
    softened = system - scipy.sparse.diags_array(np.concatenate([np.zeros(n), np.full(m, SOFTENING * largest)]))
    solve = scipy.sparse.linalg.splu(scipy.sparse.csc_array(softened))
    solution = solve.solve(sides)
    for _ in range(REFINEMENTS):
        solution += solve.solve(sides - system @ solution)
    residual = float(np.abs(sides - system @ solution).max(initial=0.0))
    # a larger residual means that active limits contradict each other
    if not residual <= RESOLVED * max(float(np.abs(sides).max(initial=0.0)), 1e-300):
        text = "the active limits contradict each other, or do not determine the plan, when the parameter changes"
        raise ProblemError(text, name="parameters", value=residual)
    dv[free] = solution[:n]
    of_rows = np.zeros((at.jacobian.shape[0], slope.shape[1]))
    of_rows[held] = weight[:, None] * solution[n:]
    of_bounds = np.zeros_like(dv)
    of_bounds[fixed] = -(slope + hessian @ dv + at.jacobian.T @ of_rows)[fixed]
    return dv, of_rows, of_bounds


def control_rates(transcription: Transcription, solution: Solution, p: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """Return derivatives of the controls at M times with respect to k parameters, from derivatives of all variables.

    Shape (M, nu, k). The controls are linear in the variables, so that differences are exact.
    """
    v, columns = solution.variables, []
    for direction in dv.T:
        step = max(1.0, float(np.abs(v).max())) / max(float(np.abs(direction).max()), 1e-300)
        curves = [
            transcription.interpolants(v + sign * step * direction, p, solution.horizon)[1] for sign in (1.0, -1.0)
        ]
        up, down = (curve.within(*transcription.report) for curve in curves)
        columns.append((up - down) / (2 * step))
    return np.stack(columns, axis=-1)
