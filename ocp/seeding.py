"""Where Newton's method starts: unknowns and data of the boundary value problem, read from a seed."""

from __future__ import annotations

import numpy as np

from ocp.hamiltonian import Hamiltonian
from ocp.problem.formulation import Formulation
from ocp.solution import Solution
from ocp.switching import Arcs

__all__ = ["read_unknowns"]

NEAR = 1e-5  # a control of the seed nearer to its bound is at it

Bounds = tuple[np.ndarray, np.ndarray]


def read_unknowns(
    ham: Hamiltonian, seed: Solution, arcs: Arcs, p: np.ndarray, bounds: Bounds, *, backward: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns and data, laid out as :class:`ocp.boundary.BoundaryProblem` has them, from a seed.

    The unknowns are states and costates at all nodes, switch times, the horizon where it is free, multipliers of start
    and end constraints (zero); or of backward shooting the end state. A seed of another horizon is stretched.
    """
    form = ham.form
    horizon = seed.horizon if form.horizon_is_free else float(form.horizon_at(p))
    times = arcs.times(horizon)
    fractions = times / horizon
    x, lam, _ = sampled(form, seed, fractions)
    places = form.bounds.places
    given = [bounds[0][places[k]] == bounds[1][places[k]] for k in ("initial", "terminal")]
    values = [
        np.where(fixed, bounds[0][places[k]], 0.0) for fixed, k in zip(given, ("initial", "terminal"), strict=True)
    ]
    ends = np.concatenate([given[0], values[0], given[1], values[1]])
    guess = control_guess(ham, seed, 0.5 * (fractions[:-1] + fractions[1:]), horizon, p, bounds)
    data = np.concatenate([[horizon], p, ends, arcs.bang.ravel(), guess.ravel()])
    if backward:
        return x[-1], data
    free = [horizon] if form.horizon_is_free else []
    multipliers = np.zeros(len(form.start) + len(form.end))
    return np.concatenate([np.hstack([x, lam]).ravel(), arcs.switches * horizon, free, multipliers]), data


def sampled(form: Formulation, seed: Solution, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (K, nx), costates (K, nx) and controls (K, nu) of a seed at fractions of its horizon."""
    sample = seed.at_fraction(fractions)
    reported = np.hstack([seed.costates[name] for name in form.states])
    lam = np.column_stack([np.interp(fractions * seed.horizon, seed.t, column) for column in reported.T])
    controls = [np.zeros((len(fractions), 0)), *[sample[name] for name in form.controls]]
    return np.hstack([sample[name] for name in form.states]), lam, np.hstack(controls)


def control_guess(
    ham: Hamiltonian, seed: Solution, fractions: np.ndarray, horizon: float, p: np.ndarray, bounds: Bounds
) -> np.ndarray:
    """Smooth controls and multipliers of the path equalities at fractions of the horizon. Shape (K, n + m).

    Where controls have bounds too, their equations cannot be solved from multipliers far off: nothing would be free.
    """
    form, count = ham.form, len(fractions)
    x, lam, control = sampled(form, seed, fractions)
    mu = np.zeros((count, len(form.path)))
    if len(form.path):
        low, high = (bound[form.bounds.places["control"]] for bound in bounds)
        free = (control > low + NEAR) & (control < high - NEAR)
        ones = np.ones((1, count))
        mu = ham.multipliers(control, free, x.T, lam.T, fractions[None, :] * horizon, horizon * ones, p[:, None] * ones)
    return np.hstack([control[:, list(ham.smooth)], mu])
