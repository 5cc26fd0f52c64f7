"""The minimum principle along a plan: is the Hamiltonian stationary in the control, is it constant in time?

Nothing here trusts the multipliers of path constraints: at each sample those that make the Hamiltonian most nearly
stationary are found anew by least squares, with the signs that the minimum principle demands (Bryson, Ho 1975, ch 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ocp.audit.costates import active_sides, costates_at_samples
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution, stack

__all__ = ["Optimality", "balance", "minimum_principle"]


@dataclass(frozen=True)
class Optimality:
    """How well a plan meets the minimum principle.

    Attributes:
        t: Times of the control samples, s. Shape (K,).
        stationarity: Largest entry of the Hamiltonian's reduced gradient at each sample. Shape (K,).
        gradient_scale: What it is judged against: the largest sum of the sizes of its parts, L_u and each
            f_u lambda.
        hamiltonian: At the reported times of the plan. Shape (M,).
        hamiltonian_scale: Largest of |L| + sum |lambda_i f_i|.
    """

    t: np.ndarray
    stationarity: np.ndarray
    gradient_scale: float
    hamiltonian: np.ndarray
    hamiltonian_scale: float

    @property
    def drift(self) -> float:
        """Largest minus smallest Hamiltonian."""
        return float(np.ptp(self.hamiltonian))


def minimum_principle(form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds) -> Optimality:
    """Evaluate the minimum principle along a plan at its own control samples and reported points."""
    horizon = solution.horizon
    pools = (solution.states, solution.controls, solution.costates)
    x, u, costate = (stack(pool, len(solution.t)) for pool in pools)
    lam = form.sym("lam", form.nx)
    parts = [form.running, lam * form.f]
    running, products = form.sampled(parts, x, u, solution.t, horizon, p, (lam, costate))
    hamiltonian = running[:, 0] + products.sum(axis=1)
    least = 1.0 if form.indifferent else 0.0  # without a cost all parts are rounding, and nothing to judge by
    scale = float(np.max(np.abs(running[:, 0]) + np.abs(products).sum(axis=1), initial=least))
    if form.nu == 0:
        return Optimality(np.zeros(0), np.zeros(0), 1.0, hamiltonian, scale or 1.0)

    interpolant = solution.control_interpolant
    widths = np.diff(interpolant.breaks)
    s = (interpolant.breaks[:-1, None] + widths[:, None] * interpolant.nodes).ravel()
    t = s * horizon
    controls = interpolant.values.reshape(len(s), form.nu)
    states = solution.state_interpolant(s)
    sampled, beside = costates_at_samples(form, solution, p, bounds)
    costates = sampled.reshape(len(s), form.nx)
    rows = form.path.select(form.path.uses_control)
    held_by = [rows.expression, ca.jacobian(rows.expression, form.u)]
    slopes = [ca.jacobian(form.running, form.u), ca.jacobian(form.f, form.u)]
    direct, f_u, *here = form.sampled([*slopes, *held_by], states, controls, t, horizon, p)
    around = [here]
    if len(interpolant.nodes) == 1:  # a held control answers for its whole interval: constraints at both ends hold it
        for end in (interpolant.breaks[:-1], interpolant.breaks[1:]):
            x_end = solution.state_interpolant(end)
            around.append(form.sampled(held_by, x_end, controls, end * horizon, horizon, p))
    g, g_u = (np.hstack([place[i] for place in around]) for i in (0, 1))
    products = f_u.reshape(len(t), form.nu, form.nx) * costates[:, None, :]
    gradient = direct + products.sum(axis=2)
    if beside.any() and interpolant.nodes.tolist() == [0.0, 1.0]:
        gradient = over_hats(gradient, widths, beside)

    low, high = bounds
    control, path = form.bounds.places["control"], np.tile(rows.bounds, len(around))
    level = np.hstack([controls, g])
    lower, upper = np.concatenate([low[control], low[path]]), np.concatenate([high[control], high[path]])
    equal = lower == upper  # active everywhere, even where the plan misses it
    at_lower, at_upper = (side | equal for side in active_sides(level, lower, upper))
    reduced = np.abs(gradient).max(axis=1)
    for k in np.flatnonzero((at_lower | at_upper).any(axis=1)):
        normals = g_u[k].reshape(len(around), form.nu, -1).transpose(0, 2, 1).reshape(-1, form.nu)
        directions = np.vstack([np.eye(form.nu), normals])
        left = gradient[k] + directions.T @ balance(gradient[k], directions, at_lower[k], at_upper[k])
        reduced[k] = np.abs(left).max()
    size = float(np.max(np.abs(direct) + np.abs(products).sum(axis=2), initial=least))
    return Optimality(t, reduced, size or 1.0, hamiltonian, scale or 1.0)


def over_hats(gradient: np.ndarray, widths: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Means of the gradient, linear in every interval, over the hats of the node values of a linear control.

    A linear control answers for the hat of each of its node values. Only for nodes of the intervals ``beside`` (N,) a
    jump of the costate; elsewhere the value at the node stands. Shape (2 N, nu), as given.
    """
    sides = gradient.reshape(len(widths), 2, -1)
    first, last = sides[:, 0], sides[:, 1]
    total, weight = np.zeros((len(widths) + 1, gradient.shape[1])), np.zeros((len(widths) + 1, 1))
    total[:-1] += widths[:, None] * (first / 3 + last / 6)
    total[1:] += widths[:, None] * (first / 6 + last / 3)
    weight[:-1] += widths[:, None] / 2
    weight[1:] += widths[:, None] / 2
    mean = total / weight
    at_node = np.append(beside, False) | np.append(False, beside)
    chosen = np.where(at_node[:-1, None], mean[:-1], first), np.where(at_node[1:, None], mean[1:], last)
    return np.stack(chosen, axis=1).reshape(gradient.shape)


def balance(gradient: np.ndarray, directions: np.ndarray, at_lower: np.ndarray, at_upper: np.ndarray) -> np.ndarray:
    """Multipliers (m,) of active constraints that make gradient (n,) + directions (m, n)' multipliers least.

    At least zero at an upper bound, at most zero at a lower one, free at an equality. Wrongly signed ones are dropped
    one by one, the worst first.
    """
    found = np.zeros(len(directions))
    active = list(np.flatnonzero(at_lower | at_upper))
    while active:
        multiplier = np.linalg.lstsq(directions[active].T, -gradient, rcond=None)[0]
        both = (at_lower & at_upper)[active]
        wrong = np.where(both, 0.0, np.where(at_upper[active], -multiplier, multiplier))
        worst = int(np.argmax(wrong))
        if wrong[worst] <= 1e-12 * (1.0 + np.abs(multiplier).max()):
            found[active] = multiplier
            return found
        del active[worst]
    return found
