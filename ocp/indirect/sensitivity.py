"""Derivatives of the optimal cost in the parameters along an extremal, by the envelope theorem.

dJ/dp = integral of dH/dp dt + dPhi/dp, plus the derivative of every bound, end value and horizon that depends on p
times its multiplier. Bryson, Ho 1975, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import quadrature_weights
from ocp.indirect.hamiltonian import Hamiltonian
from ocp.problem.formulation import Bounds

__all__ = ["Extremal", "cost_gradient"]


@dataclass(frozen=True)
class Extremal:
    """Samples of an extremal in segments of its horizon.

    Attributes:
        places: Positions of the samples in each segment, 0..1. Shape (m,). widths: of the segments, s. Shape (K,).
        t: Times, s. Shape (K, m).
        states, costates, controls, multipliers: Shapes (K, m, .); multipliers of the path equalities.
        horizon: s. nu_start, nu_end: Multipliers of the start and end constraints.
    """

    places: np.ndarray
    widths: np.ndarray
    t: np.ndarray
    states: np.ndarray
    costates: np.ndarray
    controls: np.ndarray
    multipliers: np.ndarray
    horizon: float
    nu_start: np.ndarray
    nu_end: np.ndarray

    def sampled(self, ham: Hamiltonian, outputs: list[Any], p: np.ndarray) -> list[np.ndarray]:
        """Return expressions of x, u, lam, mu, t, T, p at all K m samples in order; each output (K m, its size)."""
        count = self.t.size
        x, u, lam, mu = (v.reshape(count, -1) for v in (self.states, self.controls, self.costates, self.multipliers))
        return ham.form.sampled(outputs, x, u, self.t.ravel(), self.horizon, p, (ham.lam, lam), (ham.mu, mu))


def cost_gradient(ham: Hamiltonian, path: Extremal, p: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Return the derivative of the optimal cost in the parameters. Shape (np,)."""
    form = ham.form
    slopes = [ca.gradient(ham.value, s) for s in (form.p, form.T, form.u)]
    by_p, by_horizon, by_control, value = path.sampled(ham, [*slopes, ham.value], p)
    weights = (path.widths[:, None] * quadrature_weights(path.places)).ravel()

    x0, x1 = path.states[0, 0], path.states[-1, -1]
    phi_p, phi_horizon, phi_x0, phi_x1 = end_gradients(ham, path, x0, x1, p)
    places = form.bounds.places
    multipliers = np.zeros((2, len(bounds[0])))  # multipliers of lower and upper bounds, with the sign of f + lam . g
    controls = path.controls.reshape(len(weights), -1)
    low, high = (bound[places["control"]] for bound in bounds)
    middle = 0.5 * (np.where(np.isfinite(low), low, controls) + np.where(np.isfinite(high), high, controls))
    multipliers[0, places["control"]] = -weights @ (by_control * (controls <= middle))
    multipliers[1, places["control"]] = -weights @ (by_control * (controls > middle))
    multipliers[0, form.start.bounds], multipliers[0, form.end.bounds] = path.nu_start, path.nu_end
    multipliers[0, places["initial"]] = -(path.costates[0, 0] + phi_x0)
    multipliers[0, places["terminal"]] = path.costates[-1, -1] - phi_x1
    for end in ("initial", "terminal"):  # free entries have no multiplier
        multipliers[0, places[end]] *= bounds[0][places[end]] == bounds[1][places[end]]
    if not form.horizon_is_free:
        multipliers[0, places["horizon"]] = -(value[-1, 0] + phi_horizon + float(weights @ by_horizon[:, 0]))
    return np.asarray(weights @ by_p + phi_p - form.bounds.pullback(p, multipliers))


def end_gradients(
    ham: Hamiltonian, path: Extremal, x0: np.ndarray, x1: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return gradients of Phi = terminal cost + nu . end constraints in p, T, the first and the last state."""
    form = ham.form
    begin = ca.substitute([form.start.expression], [form.x, form.t], [form.x0, 0])[0]
    end, terminal = ca.substitute([form.end.expression, form.terminal], [form.t], [form.T])
    phi = terminal + ca.dot(ca.DM(path.nu_start), begin) + ca.dot(ca.DM(path.nu_end), end)
    symbols = [form.x0, form.x, form.T, form.p]
    gradients = [ca.densify(ca.gradient(phi, s)) for s in (form.p, form.T, form.x0, form.x)]
    values = [np.asarray(v.full()).reshape(-1) for v in ca.Function("phi", symbols, gradients)(x0, x1, path.horizon, p)]
    return values[0], float(values[1][0]), values[2], values[3]
