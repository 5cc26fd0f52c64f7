"""The costates of a plan against their own equation, lambda' = -dH/dx, and against the conditions at the ends.

The costates come from the multipliers of whatever method made the plan; here they are integrated backwards along the
plan, by an integrator that has never seen these multipliers. Bryson, Ho 1975, chapters 2 and 3.

A bound of a state pushes on the costate with a density along an arc. A transcription that holds the bound at nodes only
has an atom there instead: its costate follows the costate equation inside an interval and jumps at the nodes (at a free
end that is at a bound, away from the gradient of the final cost). The reported value at a node is that before the jump.
The value behind it is found from the costate equation, and a jump is accepted only where a bound is active and with the
sign that its multiplier must have (Hartl, Sethi, Vickson 1995).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import quiet
from ocp.curves import integrator, lagrange_expressions
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution, stack

__all__ = ["Adjoint", "active_sides", "adjoint", "costates_at_samples"]

IMMATERIAL = 1e-7  # share of the cost
ACTIVE_WITHIN = 1e-5  # a bound nearer than this, relative to its scale, is active


@dataclass(frozen=True)
class Adjoint:
    """How well the costates of a plan meet their equations.

    Attributes:
        t: Ends of the intervals in which the costates are interpolated, s. Shape (N + 1,).
        integrated: Costates integrated backwards from the plan's own at the end. Shape (N + 1, nx), or None.
        plan: The plan's costates there. Shape (N + 1, nx).
        reason: Why they were not integrated, or "".
        transversality: Largest entry that no multiplier of an end condition explains, in cost per unit of the state; a
            bound that is active at an end explains what has the sign of its multiplier.
        horizon: H(T) + dPhi/dT where the final time is free, in cost per second; 0 where it is given.
        scale: Largest costate, or where all are immaterial the size at which they would not be.
    """

    t: np.ndarray
    integrated: np.ndarray | None
    plan: np.ndarray
    reason: str
    transversality: float
    horizon: float
    scale: float

    @property
    def error(self) -> float:
        """Largest difference of integrated and plan's costates, relative to the largest costate of the plan."""
        if self.integrated is None:
            return 0.0
        return float(np.max(np.abs(self.integrated - self.plan), initial=0.0) / self.scale)


def adjoint(form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds) -> Adjoint:
    """Integrate the costates of a plan backwards and look at their conditions at the ends."""
    breaks = solution.state_interpolant.breaks
    n = len(breaks) - 1
    costates = solution.costate_interpolant
    plan = costates(costates.breaks)
    size = float(np.max(np.abs(costates.values), initial=1.0 if form.indifferent else 0.0))
    scale = max(size, immaterial(solution)) or 1.0
    ends = end_residuals(form, solution, p, bounds)
    reason = obstacle(form, solution, bounds)
    integrated = None
    if not reason:
        pieces = CostatePieces(form, solution, p)
        everywhere = np.full((n + 1, form.nx), np.inf)
        everywhere[-1] = plan[-1]
        for k in reversed(range(n)):
            everywhere[k] = pieces.backwards(everywhere[k + 1], range(k, k + 1))
            if not np.all(np.isfinite(everywhere[k])):
                everywhere[: k + 1] = np.inf
                break
        integrated = everywhere[np.searchsorted(breaks, costates.breaks - 1e-12)]
    return Adjoint(costates.breaks * solution.horizon, integrated, plan, reason, *ends, scale)


def immaterial(solution: Solution) -> float:
    """Size of costates that, times the way of the states, are nothing beside the cost: they may be rounding alone."""
    way = max((float(np.ptp(values, axis=0).max(initial=0.0)) for values in solution.states.values()), default=0.0)
    return IMMATERIAL * abs(solution.cost) / way if way > 0 else 0.0


class CostatePieces:
    """The costate equation along a plan, to be integrated over the pieces of the states' interpolant one by one.

    Attributes:
        count: Number of pieces.
    """

    def __init__(self, form: Formulation, solution: Solution, p: np.ndarray) -> None:
        states, controls = solution.state_interpolant, solution.control_interpolant
        self.count = n = len(states.breaks) - 1
        width = np.diff(states.breaks)
        places = states.breaks[:-1, None] + width[:, None] * controls.nodes
        owner = np.searchsorted(controls.breaks, states.breaks[:-1] + 0.5 * width) - 1
        within = (places - controls.breaks[owner][:, None]) / np.diff(controls.breaks)[owner][:, None]
        u = controls.within(np.repeat(owner, len(controls.nodes)), within.ravel())
        shared = np.tile(np.append(solution.horizon, p), (n, 1))
        columns = (states.values.reshape(n, -1), u.reshape(n, -1), states.breaks[:-1, None], width[:, None], shared)
        self._data = np.hstack(columns).T
        self._integrator = costate_integrator(form, states.nodes, controls.nodes)

    def backwards(self, end: np.ndarray, pieces: range) -> np.ndarray:
        """The costate at the start of some pieces, from that at their end; nan where the integration breaks down."""
        lam = end
        try:
            with quiet():
                for k in reversed(pieces):
                    lam = np.asarray(self._integrator(x0=lam, p=self._data[:, k])["xf"].full()).reshape(-1)
        except RuntimeError:
            return np.full_like(end, np.nan)
        return lam


def obstacle(form: Formulation, solution: Solution, bounds: Bounds) -> str:
    """Why the costate equation alone does not say what the costates are, or ""."""
    x = stack(solution.states)
    index = form.bounds.places["state"]
    if np.any(near(x[1:-1], bounds[0][index], bounds[1][index])):
        return "a state is at its bound"
    return path_obstacle(form, solution, bounds)


def path_obstacle(form: Formulation, solution: Solution, bounds: Bounds) -> str:
    """Why the multipliers of path constraints are not known, or ""."""
    if len(form.path) and not np.all(form.path.equality & form.path.uses_control):
        return "there are path constraints beyond equalities with a control"
    if len(form.path):
        u = stack(solution.controls)
        index = form.bounds.places["control"]
        if np.any(near(u, bounds[0][index], bounds[1][index])):
            return "a control is at its bound where path equalities hold"
    return ""


def active_sides(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where values (M, n) are at their lower, and at their upper bound. Each (M, n), bool."""
    with np.errstate(invalid="ignore"):
        size = np.maximum(1.0, np.where(np.isfinite(upper - lower), upper - lower, 1.0))
    return np.asarray(values <= lower + ACTIVE_WITHIN * size), np.asarray(values >= upper - ACTIVE_WITHIN * size)


def near(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Where values (M, n) are at a bound."""
    at_lower, at_upper = active_sides(values, lower, upper)
    return np.asarray(at_lower | at_upper)


def costate_integrator(form: Formulation, nodes: np.ndarray, samples: np.ndarray) -> Any:
    """Integrator of the costates over one interval backwards; p = [x values, u values, s, h, T, parameters].

    Multipliers of path equalities are those that make H stationary: mu = -(A A')^-1 A (L_u + f_u' lambda), A = h_u.
    """
    sym = form.sym
    nx, nu = form.nx, form.nu
    lam, back = sym("lam", nx), sym("back")
    cuts = np.cumsum([0, nx * len(nodes), nu * len(samples), 1, 1, 1, form.np])
    q = sym("q", int(cuts[-1]))
    xs, us, s, h, horizon, p = (q[int(a) : int(b)] for a, b in pairwise(cuts))
    place = 1 - back
    x = ca.mtimes(ca.reshape(xs, nx, len(nodes)), lagrange_expressions(nodes, place))
    u = ca.mtimes(ca.reshape(us, nu, len(samples)), lagrange_expressions(samples, place))
    value = form.running + ca.dot(lam, form.f)
    if len(form.path):
        gradient = ca.gradient(value, form.u)
        rows = ca.jacobian(form.path.expression, form.u)
        mu = -ca.solve(ca.mtimes(rows, rows.T), ca.mtimes(rows, gradient))
        held = sym("mu", len(form.path))
        rate = ca.gradient(value + ca.dot(held, form.path.expression), form.x)
        rate = ca.substitute([rate], [held], [mu])[0]
    else:
        rate = ca.gradient(value, form.x)
    function = ca.Function("rate", [form.x, form.u, form.t, form.T, form.p, lam], [ca.densify(rate)], {"cse": True})
    ode = h * horizon * function(x, u, (s + h * place) * horizon, horizon, p, lam)
    dae = {"x": lam, "t": back, "p": q, "ode": ode}
    return integrator("costates", dae)


def end_residuals(form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds) -> tuple[float, float]:
    """What of the transversality conditions no multiplier explains: (of the states, of the horizon)."""
    low, high = bounds
    nx = form.nx
    x0, x1, lam0, lam1 = (stack(pool)[k] for pool in (solution.states, solution.costates) for k in (0, -1))
    controls = stack(solution.controls, 2)[[0, -1]]
    begin = ca.substitute([form.start.expression], [form.x, form.u, form.t], [form.x0, form.u0, 0])[0]
    end = ca.substitute([form.end.expression, form.terminal], [form.t], [form.T])
    symbols = [form.x, form.x0, form.u, form.u0, form.T, form.p]
    # a path constraint of the states alone that is active at an end holds them there as an end condition does
    path = form.path.select(~form.path.uses_control)
    first = ca.substitute([path.expression], [form.x, form.t], [form.x0, 0])[0]
    rows = ca.vertcat(begin, end[0], ca.substitute([path.expression], [form.t], [form.T])[0], first)
    both = ca.vertcat(form.x, form.x0, form.T)
    function = ca.Function("ends", symbols, [rows, ca.densify(ca.jacobian(rows, both)), ca.gradient(end[1], both)])
    found = function(x1, x0, controls[1], controls[0], solution.horizon, p)
    values, slopes, gradient = (np.asarray(v.full()) for v in found)
    index = np.concatenate([form.start.bounds, form.end.bounds, path.bounds, path.bounds])
    active = near(values.T, low[index], high[index])[0]
    places = form.bounds.places
    free = np.concatenate(
        [~near(x[None], low[places[k]], high[places[k]])[0] for x, k in ((x1, "terminal"), (x0, "initial"))]
    )
    # gradient of the cost at the ends + multipliers . slopes = (lambda(T), -lambda(0))
    left = np.concatenate([lam1, -lam0]) - gradient[: 2 * nx, 0]
    columns = slopes[active].T
    horizon_free = (
        form.horizon_is_free
        and not near(np.array([[solution.horizon]]), low[places["horizon"]], high[places["horizon"]]).any()
    )
    explicit = ca.depends_on(ca.vertcat(form.f, form.running, form.path.expression), form.T)
    target, matrix = left[free], columns[: 2 * nx][free]
    if horizon_free and not explicit:
        last = x1[None], controls[1][None], solution.horizon, solution.horizon, p
        running, rate = form.sampled([form.running, form.f], *last)
        final = float(running[0, 0]) + float(np.dot(rate[0], lam1))
        target = np.append(target, -final - gradient[2 * nx, 0])
        matrix = np.vstack([matrix, columns[2 * nx]])
    multipliers = np.linalg.lstsq(matrix, target, rcond=None)[0] if matrix.size else np.zeros(matrix.shape[1])
    residual = target - matrix @ multipliers
    # a bound that holds an end free otherwise pushes one way only
    x, index = np.concatenate([x1, x0]), np.concatenate([places["terminal"], places["initial"]])
    below, above = (side[0] for side in _pushing(x[None], low[index], high[index]))
    push = left - columns[: 2 * nx] @ multipliers
    wrong = np.where(above & ~below, np.maximum(-push, 0), 0) + np.where(below & ~above, np.maximum(push, 0), 0)
    residual = np.concatenate([wrong, residual])
    if horizon_free and not explicit:
        return float(np.max(np.abs(residual[:-1]), initial=0.0)), float(abs(residual[-1]))
    return float(np.max(np.abs(residual), initial=0.0)), 0.0


def costates_at_samples(
    form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Costates at the samples of the controls, (N, samples, nx), and which intervals are beside a jump, (N,) bool."""
    interpolant = solution.control_interpolant
    mesh, places = interpolant.breaks, interpolant.nodes
    n = len(mesh) - 1
    reported = stack(solution.costates)
    at = (mesh[:-1, None] + np.diff(mesh)[:, None] * places) * solution.horizon
    costates = np.stack([np.interp(at, solution.t, column) for column in reported.T], axis=-1)
    jumps = np.zeros(n, dtype=bool)
    index = form.bounds.places["state"]
    low, high = bounds[0][index], bounds[1][index]
    if not near(stack(solution.states), low, high).any():
        return costates, jumps
    if len(solution.t) == n + 1:
        if not path_obstacle(form, solution, bounds):
            return _between_nodes(form, solution, p, (low, high), costates)
    elif places[-1] == 1.0:
        costates[-1, -1] = _end(form, solution, p, bounds, reported, (low, high))
    return costates, jumps


def _pushing(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a state may be pushed up by its lower bound, and down by its upper one; each judged by itself."""
    nothing = np.full_like(low, np.inf)
    return active_sides(x, low, nothing)[0], active_sides(x, -nothing, high)[1]


def _between_nodes(
    form: Formulation, solution: Solution, p: np.ndarray, sides: Bounds, costates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Costates that jump at the nodes only, and which intervals are beside a jump."""
    before, pieces = stack(solution.costates), CostatePieces(form, solution, p)
    each = pieces.count // (len(before) - 1)
    behind = [pieces.backwards(lam, range(k * each, (k + 1) * each)) for k, lam in enumerate(before[1:])]
    at_low, at_high = (side[:-1] for side in _pushing(stack(solution.states), *sides))
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
    form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds, reported: np.ndarray, sides: Bounds
) -> np.ndarray:
    """Costates just before a free end: those that hold a bound there are continued from the points before it.

    They stay between the reported value and the gradient of the final cost, for the rest is the atom of the bound.
    """
    x = stack(solution.states)
    free = form.bounds.places["terminal"]
    open_end = bounds[0][free] < bounds[1][free]
    at_low, at_high = (side[0] & open_end for side in _pushing(x[-1:], *sides))
    last = reported[-1]
    if not (at_low | at_high).any():
        return np.asarray(last)
    final = ca.substitute([form.terminal], [form.t], [form.T])[0]
    slope = ca.Function("slope", [form.x, form.x0, form.u0, form.T, form.p], [ca.densify(ca.gradient(final, form.x))])
    own = np.asarray(slope(x[-1], x[0], stack(solution.controls, 1)[0], solution.horizon, p).full()).ravel()
    t = solution.t[-3:]
    continued = reported[-2] + (reported[-2] - reported[-3]) * (t[2] - t[1]) / (t[1] - t[0])
    atom = last - own
    allowed = (at_high & (atom > 0)) | (at_low & (atom < 0))
    between = np.clip(continued, np.minimum(last, own), np.maximum(last, own))
    return np.asarray(np.where(allowed, between, last))
