"""Costates beside the bounds of states, where those of a discrete plan jump.

A bound of a state pushes on the costate with a density along an arc. A transcription that holds the bound at nodes only
has an atom there instead: its costate follows the costate equation inside an interval and jumps at the nodes (at a free
end that is at a bound, away from the gradient of the final cost). The reported value at a node is that before the jump.
Here the value behind it is found from the costate equation, and a jump is accepted only where a bound is active and
with the sign that its multiplier must have (Hartl, Sethi, Vickson 1995).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp.adjoint import near, over_intervals, path_obstacle
from ocp.formulation import Formulation
from ocp.solution import Solution

__all__ = ["costates_at_samples"]


def costates_at_samples(
    form: Formulation, solution: Solution, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Costates at the samples of the controls, (N, samples, nx), and which intervals are beside a jump, (N,) bool."""
    interpolant = solution.control_interpolant
    mesh, places = interpolant.breaks, interpolant.nodes
    n = len(mesh) - 1
    reported = np.hstack(list(solution.costates.values()))
    at = (mesh[:-1, None] + np.diff(mesh)[:, None] * places) * solution.horizon
    costates = np.stack([np.interp(at, solution.t, column) for column in reported.T], axis=-1)
    jumps = np.zeros(n, dtype=bool)
    index = form.bounds.places["state"]
    low, high = bounds[0][index], bounds[1][index]
    if not near(np.hstack(list(solution.states.values())), low, high).any():
        return costates, jumps
    if len(solution.t) == n + 1:
        if not path_obstacle(form, solution, bounds):
            return _between_nodes(form, solution, p, (low, high), costates)
    elif places[-1] == 1.0:
        costates[-1, -1] = _end(form, solution, p, bounds, reported, (low, high))
    return costates, jumps


def _signs(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a state may be pushed up by its lower bound, and down by its upper one."""
    nothing = np.full_like(low, np.inf)
    return near(x, low, nothing), near(x, -nothing, high)


def _between_nodes(
    form: Formulation, solution: Solution, p: np.ndarray, sides: tuple[np.ndarray, np.ndarray], costates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    before = np.hstack(list(solution.costates.values()))
    behind = over_intervals(form, solution, p, before[1:])
    x = np.hstack(list(solution.states.values()))
    at_low, at_high = (side[:-1] for side in _signs(x, *sides))
    jump = behind - before[:-1]
    # an upper bound takes from the costate, a lower one adds to it
    allowed = np.isfinite(jump) & ((at_high & (jump < 0)) | (at_low & (jump > 0)))
    after = np.where(allowed, behind, before[:-1])
    jumps = allowed.any(axis=1)
    places = solution.control_interpolant.nodes[None, :, None]
    inside = (1 - places) * after[:, None] + places * before[1:, None]
    beside = jumps | np.append(jumps[1:], False)
    return np.where(beside[:, None, None], inside, costates), beside


def _end(
    form: Formulation,
    solution: Solution,
    p: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    reported: np.ndarray,
    sides: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Costates just before a free end: those that hold a bound there are continued from the points before it.

    They stay between the reported value and the gradient of the final cost, for the rest is the atom of the bound.
    """
    x = np.hstack([solution.states[name] for name in form.states])
    free = form.bounds.places["terminal"]
    open_end = bounds[0][free] < bounds[1][free]
    at_low, at_high = (side[0] & open_end for side in _signs(x[-1:], *sides))
    last = reported[-1]
    if not (at_low | at_high).any():
        return np.asarray(last)
    final = ca.substitute([form.terminal], [form.t], [form.T])[0]
    slope = ca.Function("slope", [form.x, form.x0, form.u0, form.T, form.p], [ca.densify(ca.gradient(final, form.x))])
    first = np.hstack([value[0] for value in solution.controls.values()])
    own = np.asarray(slope(x[-1], x[0], first, solution.horizon, p).full()).ravel()
    t = solution.t[-3:]
    continued = reported[-2] + (reported[-2] - reported[-3]) * (t[2] - t[1]) / (t[1] - t[0])
    atom = last - own
    allowed = (at_high & (atom > 0)) | (at_low & (atom < 0))
    between = np.clip(continued, np.minimum(last, own), np.maximum(last, own))
    return np.asarray(np.where(allowed, between, last))
