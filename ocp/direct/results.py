"""From what a solver returned to a solution: curves, costates and the derivative of the cost in the parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from ocp.curves import PiecewisePolynomial
from ocp.direct.assembly import Program
from ocp.direct.fragment import Fragment
from ocp.direct.nlp import Outcome
from ocp.problem.formulation import Formulation
from ocp.solution import Solution

__all__ = ["controls_at", "horizon_of", "solution_of"]


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
    return np.asarray(direct - form.bounds.pull(p, push))


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
