"""How a plan moves with a parameter, from the conditions of first order at the plan.

They hold at every parameter nearby, so their derivative is a linear system in the derivatives of variables and
multipliers, with the limits that push held (Fiacco 1976; Buskens, Maurer 2000, doi 10.1016/S0377-0427(00)00308-9):
one factorization of it, and one back-substitution for each entry of the parameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from ocp.direct.active_set import RESOLVED, Conditions, conditions
from ocp.direct.assembly import Fragment, Program, assemble
from ocp.direct.collocation import Collocation
from ocp.direct.diagnosis import variable_names
from ocp.direct.nlp import Outcome, controls_at
from ocp.direct.scaling import Pattern, fitting_scales, sizes_along
from ocp.direct.shooting import MultipleShooting
from ocp.errors import ProblemError, unknown_name
from ocp.problem.formulation import Formulation
from ocp.problem.invariants import bounds_to_solve
from ocp.problem.values import symbols_of
from ocp.solution import Sensitivity, Solution

__all__ = ["sensitivity"]

METHODS = {"Collocation": Collocation, "MultipleShooting": MultipleShooting}


@dataclass(frozen=True)
class SystemSettings:
    """How the linear system is solved.

    Attributes:
        softening: By which rows that others imply may be missed, relative to their own size and to the curvature.
        refinements: Passes that make up for it.
    """

    softening: float = 1e-11
    refinements: int = 4


@dataclass(frozen=True)
class Built:
    """The program that a plan is a solution of, and what is known there."""

    form: Formulation
    fragment: Fragment
    program: Program
    v: np.ndarray
    p: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def sensitivity(solution: Solution, name: str) -> Sensitivity:
    """How a plan of a direct method moves with the parameter ``name``; see :meth:`ocp.solution.Solution.sensitivity`.

    Raises:
        ProblemError: An unknown parameter; a plan that is none of a direct method under the bounds of its problem, or
            no optimum; or limits that contradict each other when the parameter moves.
    """
    built = program_of(solution)
    form, fragment, p = built.form, built.fragment, built.p
    if not isinstance(name, str) or name not in form.parameters:
        raise unknown_name("parameter", name, form.parameters)
    place = form.parameters[name]
    columns = list(range(place.start, place.stop))
    v, lam = built.v, solution.multipliers
    bounds = built.lower, built.upper
    arguments = fragment.arguments(p, bounds)
    pattern = Pattern(form, fragment, built.program)
    told = {*form.states, *form.controls, "horizon"}
    scales = fitting_scales(pattern, sizes_along(pattern, v, told, bounds, p), v, p)
    a, b, c = scales.variables, scales.rows, scales.cost
    rows = np.asarray(built.program.values(v, p)[1].full()).ravel()
    outcome = Outcome(v, solution.cost, rows, lam, solution.status, solution.message, 0, 0.0)
    at = conditions(built.program, outcome, arguments, scales)

    slope, change = by_parameters(fragment, v, p, lam, columns)
    slope, change = slope * a[:, None] / c, change / b[:, None]
    q = ca.MX.sym("p", len(p))
    moves = ca.Function("moves", [q], [ca.jacobian(side, q)[:, columns] for side in form.bounds.function(q)])(p)
    low, high = (np.asarray(move.full()) for move in moves)
    low_x, high_x = (side[fragment.variable_bounds] / a[:, None] for side in (low, high))
    low_g, high_g = (side[fragment.row_bounds] / b[:, None] for side in (low, high))
    at_x = np.where((at.of_bounds > 0)[:, None], high_x, low_x)
    at_g = np.where((at.of_rows > 0)[:, None], high_g, low_g)
    dv, of_rows, of_bounds = moved(at, slope, change, at_x, at_g)

    # what is at no limit comes to one; what pushes no more
    dg = at.jacobian @ dv + change
    values = np.concatenate([v / a, rows / b])
    rates = np.vstack([dv, dg])
    sides = [np.concatenate([arguments[f"{s}x"] / a, arguments[f"{s}g"] / b]) for s in ("lb", "ub")]
    side_rates = [np.vstack([low_x, low_g]), np.vstack([high_x, high_g])]
    held = np.concatenate([at.fixed, at.held])
    push, push_rates = np.concatenate([at.of_bounds, at.of_rows]), np.vstack([of_bounds, of_rows])
    given = sides[0] == sides[1]
    names = [*variable_names(form, fragment), *fragment.row_labels]
    now = p[place]
    ends = np.tile([[-np.inf], [np.inf]], (1, len(columns)))
    words = [["", ""] for _ in columns]
    with np.errstate(invalid="ignore"):
        loose = [
            (np.where(held, np.inf, values - sides[0]), rates - side_rates[0]),
            (np.where(held, np.inf, sides[1] - values), side_rates[1] - rates),
            (np.where(held & ~given, np.abs(push), np.inf), np.sign(push)[:, None] * push_rates),
        ]
    for room, rate in loose:
        some = np.flatnonzero(np.isfinite(room))
        size = np.where(room[some] < RESOLVED, 0.0, room[some])
        for k in range(len(columns)):
            for side, sign in ((0, -1.0), (1, 1.0)):
                toward = -sign * rate[some, k]
                nearer = np.flatnonzero(toward > RESOLVED * np.abs(rate[some, k]).max(initial=0.0))
                if not nearer.size:
                    continue
                reach = size[nearer] / toward[nearer]
                first = int(np.argmin(reach))
                if reach[first] < abs(ends[side, k]):
                    ends[side, k] = sign * reach[first]
                    words[k][side] = names[some[nearer[first]]]

    index = fragment.horizon
    by_time = high[form.bounds.places["horizon"][0]] if index is None else dv[index] * a[index]
    return Sensitivity(
        name=name,
        value=now,
        t=solution.t,
        states=split(form.states, (a[:, None] * dv)[fragment.report_states]),
        controls=split(form.controls, control_rates(built, solution, a[:, None] * dv)),
        horizon=np.asarray(by_time, dtype=float),
        cost=solution.cost_gradients[name],
        lower=now + ends[0],
        upper=now + ends[1],
        limits=tuple((below, above) for below, above in words),
    )


def program_of(solution: Solution) -> Built:
    """The program that a plan is a solution of."""
    what = f"plan {solution.name!r}"
    settings = dict(solution.method)
    kind = settings.pop("type")
    if kind not in METHODS or solution.problem is None:
        words = (
            f"{what}: only plans of Collocation(...) and MultipleShooting(...), with their problem, tell how they move"
        )
        raise ProblemError(words, name="method", value=kind)
    if not solution.success or solution.bound_tightening is not None:
        words = f"{what}: it is no optimum under the bounds of its problem"
        raise ProblemError(words, name="solution", value=solution.message)
    form = Formulation.of(solution.problem)
    method = METHODS[kind](**settings)
    for staged in (False, True):
        fragment = method.transcribe(form, staged=staged)
        if (fragment.size, fragment.n_rows) == (len(solution.variables), len(solution.multipliers)):
            break
    else:
        words = f"{what}: it is no solution of its problem by its method"
        raise ProblemError(words, name="variables", value=len(solution.variables), limit=fragment.size)
    p = form.parameter_vector(solution.parameters)
    program = assemble(fragment, form.np)
    return Built(form, fragment, program, solution.variables, p, *bounds_to_solve(form, p))


def by_parameters(
    fragment: Fragment, v: np.ndarray, p: np.ndarray, lam: np.ndarray, columns: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives in some parameters of the slope of the Lagrangian (n, k) and of the rows (m, k)."""
    slope, change = np.zeros((fragment.size, len(columns))), np.zeros((fragment.n_rows, len(columns)))
    for block in fragment.blocks:
        function = block.function
        symbol = symbols_of(function).sym
        inner, d, q = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
        cost, g = function(inner, d, q)
        mu = symbol("mu", g.numel())
        lagrangian = ca.gradient(cost + ca.dot(mu, g), inner)
        outputs = [ca.densify(ca.jacobian(part, q)[:, columns]) for part in (lagrangian, ca.vec(g))]
        count = block.variables.shape[1]
        many = ca.Function("by_parameters", [inner, d, q, mu], outputs).map(count)
        found = many(v[block.variables], block.data, np.tile(p[:, None], (1, count)), lam[block.rows])
        for where, part, total in zip((block.variables, block.rows), found, (slope, change), strict=True):
            np.add.at(total, where, np.asarray(part.full()).reshape(len(where), count, len(columns)))
    return slope, change


def moved(
    at: Conditions,
    slope: np.ndarray,
    change: np.ndarray,
    at_x: np.ndarray,
    at_g: np.ndarray,
    settings: SystemSettings = SystemSettings(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the variables (n, k) and of the multipliers of rows (m, k) and bounds (n, k), scaled.

    Args:
        slope, change: Of the slope of the Lagrangian and of the rows, the variables held.
        at_x, at_g: Of the limits at which variables and rows stand.
    """
    fixed, free, held = (np.flatnonzero(which) for which in (at.fixed, ~at.fixed, at.held))
    dv = np.zeros_like(slope)
    dv[fixed] = at_x[fixed]
    hessian, rows = at.hessian, at.jacobian[held]
    largest = max(float(np.abs(hessian.data).max(initial=0.0)), 1e-300)
    own = rows[:, free]
    size = np.sqrt(np.asarray(own.multiply(own).sum(axis=1)).ravel())
    weight = largest / np.where(size > 0, size, 1.0)
    own = sp.diags_array(weight) @ own
    right = np.vstack([-(slope + hessian @ dv)[free], weight[:, None] * (at_g - change - at.jacobian @ dv)[held]])
    n, m = len(free), len(held)
    system = (
        sp.block_array([[hessian[free][:, free], own.T], [own, None]], format="csc") if m else hessian[free][:, free]
    )
    softened = system - sp.diags_array(np.concatenate([np.zeros(n), np.full(m, settings.softening * largest)]))
    solve = sla.splu(sp.csc_array(softened))
    found = solve.solve(right)
    for _ in range(settings.refinements):
        found += solve.solve(right - system @ found)
    missed = float(np.abs(right - system @ found).max(initial=0.0))
    # more, and the limits that push contradict each other
    if not missed <= RESOLVED * max(float(np.abs(right).max(initial=0.0)), 1e-300):
        words = "the limits at which the plan stands contradict each other, or leave it open, when the parameter moves"
        raise ProblemError(words, name="parameters", value=missed)
    dv[free] = found[:n]
    of_rows = np.zeros((at.jacobian.shape[0], slope.shape[1]))
    of_rows[held] = weight[:, None] * found[n:]
    of_bounds = np.zeros_like(dv)
    of_bounds[fixed] = -(slope + hessian @ dv + at.jacobian.T @ of_rows)[fixed]
    return dv, of_rows, of_bounds


def control_rates(built: Built, solution: Solution, dv: np.ndarray) -> np.ndarray:
    """Derivatives of the controls at the reported times (M, nu, k): controls are linear in their variables."""
    piece, place = built.fragment.report
    columns = []
    for direction in dv.T:
        step = max(1.0, float(np.abs(built.v).max())) / max(float(np.abs(direction).max()), 1e-300)
        curves = [
            built.fragment.interpolants(built.v + sign * step * direction, built.p, solution.horizon)[1]
            for sign in (1.0, -1.0)
        ]
        up, down = (controls_at(curve, built.fragment, piece, place) for curve in curves)
        columns.append((up - down) / (2 * step))
    return np.stack(columns, axis=-1)


def split(places: dict[str, slice], values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[:, place] for name, place in places.items()}
