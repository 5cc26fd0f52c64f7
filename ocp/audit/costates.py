"""Checks of the costates of a plan: the costate equation, lambda' = -dH/dx, and the conditions at start and end.

The reported costates come from the multipliers of whatever method made the plan. Here each interval is integrated
backwards from the reported costate at its end by Gauss collocation, with newly computed multipliers of the active
limits. State limits act on the costate with a density along an arc, and with an atom where a transcription imposes them
at single points or where an arc begins (Hartl, Sethi, Vickson 1995). Both are computed with the signs that they must
have, and their products with the gaps to the limits count as lost cost. The part of the costates that these multipliers
do not explain is their error. It is stated in units of cost, each costate times the size of its state, and summed over
the intervals, so that small errors in all intervals cannot hide a large total (Bryson, Ho 1975, chapters 2 and 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import find_control_multipliers, nnls, pseudo_inverse_of
from ocp.curves import lagrange
from ocp.solution_data import stack
from ocp.tolerances import COSTATE_SHARE, ROUNDING_SHARE


class Ends(NamedTuple):
    """Residuals and multipliers of the optimality conditions at start and end of a plan.

    Attributes:
        transversality: Residual of the costates at start and end that no multiplier explains, in units of cost.
        horizon: Residual of the derivative with respect to a free horizon, times the horizon, in units of cost.
        slope: Residual derivative of the cost with respect to the start state and the horizon. Shape (nx + 1,).
        charge: Sum of the multipliers times the gaps to their limits, in units of cost.
        end, start: Multipliers of the end and start conditions. Shapes (m,).
    """

    transversality: float
    horizon: float
    slope: np.ndarray
    charge: float
    end: np.ndarray
    start: np.ndarray


@dataclass(frozen=True)
class Adjoint:
    """Costates and multipliers of a plan, with the errors of their equations in units of the cost.

    Attributes:
        t: Ends of the intervals, s. Shape (N + 1,).
        costate: Costates at the Gauss points, integrated backwards in every interval from the costate that the plan
            reports at its end. Shape (N q, nx).
        control_multipliers: Multipliers of the control limits at the Gauss points, per unit of the horizon fraction s.
            Shape (N q, nu + r + a).
        state_multipliers: Multipliers of the state limits at the Gauss points, per unit of s. Atoms (impulses) at the
            ends of the intervals are distributed to the adjacent points. Shape (N q, nx + r').
        error: Error of the costates over each interval, from end to end. Shape (N,).
        total: Sum of the errors; where they cancel, the largest deviation from the costates integrated from the end of
            the plan to its start. The smaller of both.
        between: Error of the costates reported between the ends of an interval. Shape (N,).
        charge: Multipliers of the state limits times the gaps to these, summed in each interval. Shape (N,).
        node_shifts: Part of the costates reported at the ends of the intervals that belongs to atoms before them: a
            limit that a transcription imposes only at a node acts there at once for both adjacent intervals.
            Shape (N + 1, nx).
        ends: The conditions at start and end.
    """

    t: np.ndarray
    costate: np.ndarray
    control_multipliers: np.ndarray
    state_multipliers: np.ndarray
    error: np.ndarray
    total: float
    between: np.ndarray
    charge: np.ndarray
    node_shifts: np.ndarray
    ends: Ends


def adjoint(along: Linearisation, curved: np.ndarray | None, cost: float, shifts: np.ndarray | None = None) -> Adjoint:
    """Integrate the costates of a plan backwards, compute the multipliers, and check the start and end conditions.

    Args:
        along: Linearisation of the plan.
        curved: T H_uu at the Gauss points, (M, nu, nu), or None if no path inequality has a control.
        cost: Size of the cost, by which errors are weighted.
        shifts: Node shifts of an earlier call. They are subtracted from the reported costates at the nodes, so that the
            atoms are distributed.
    """
    (n, q), m = along.shape, along.state_limits.lower.shape[1]
    first, last = interval_end_costates(along)
    # atoms at the start of the second interval explain a jump between two intervals
    first = np.vstack([first[:1], last[:-1]])
    if shifts is not None:
        first, last = first - shifts[:-1], last - shifts[1:]
    costate, inside, atoms = along.costate, np.zeros((n, q, m)), np.zeros((n, 2, m))
    near, at_node = (
        np.asarray(part.any(axis=1)) for part in (along.state_limits.near.reshape(n, q * m), along.node_limits.near)
    )
    limited = np.flatnonzero(near | at_node[:-1] | at_node[1:])
    control_multipliers, across = find_control_multipliers(along, costate, curved)
    for _ in range(3):  # alternate between the multipliers of the controls and of the states
        before = control_multipliers != 0
        back = BackwardIntegration(along, control_multipliers, across)
        for k in limited.tolist():
            inside[k], atoms[k] = _state_limit_multipliers(back, k, first[k], last[k], cost)
        costate, start = back.integrate(last, inside, atoms)
        control_multipliers, across = find_control_multipliers(along, costate, curved)
        if not (limited.size or along.mixed.size) or (before == (control_multipliers != 0)).all():
            break
    size, share = along.state_size, along.share.reshape(n, q, 1)
    charge = along.state_limits.charge(inside.reshape(n * q, m)).reshape(n, -1).sum(axis=1)
    charge += along.node_limits.at(along.interval_ends).charge(atoms).sum(axis=(1, 2))
    state_multipliers = inside / share
    state_multipliers[:, [0, -1]] += atoms / share[:, [0, -1]]
    force = np.einsum("kjm,kjmi->kji", inside, along.state_limits_x[..., :-1].reshape(n, q, m, -1))
    atom_force = np.einsum("kjm,kjmi->kji", atoms, along.node_limits_x[along.interval_ends, :, :-1])
    explained = (np.abs(np.concatenate([force, atom_force], axis=1)) @ size).sum(axis=1)
    propagated = back.accumulate(first - start)
    total = min(float(np.abs(first - start).sum(axis=0) @ size), float((np.abs(propagated) @ size).max()))
    return Adjoint(
        along.mesh * along.solution.horizon,
        costate,
        control_multipliers,
        state_multipliers.reshape(n * q, m),
        np.abs(first - start) @ size,
        total,
        np.maximum(_inside_errors(along, costate, last) - explained, 0.0),
        charge,
        _node_shifts(along, control_multipliers, inside, atoms if shifts is None else None),
        _ends(along, costate, control_multipliers, inside, atoms, cost, last[-1]),
    )


def _node_shifts(along: Linearisation, holding: np.ndarray, inside: np.ndarray, atoms: np.ndarray | None) -> np.ndarray:
    """Return the part of each node's reported costate that is due to multipliers in the mesh interval before the node.

    Multipliers count by the hat function of the node, and ``atoms`` by half if they are not distributed yet.
    """
    (n, q), nx, nu = along.shape, along.form.nx, along.form.nu
    shifts = np.zeros((n + 1, nx))
    if not along.nodal:
        return shifts
    if atoms is not None:
        shifts[:-1] += np.einsum("km,kmi->ki", atoms[:, 0], along.node_limits_x[:-1, :, :nx]) / 2
    slopes = along.state_limits_x[:, :, :nx].reshape(n, q, inside.shape[2], nx)
    shifts[1:] += np.einsum("j,kjm,kjmi->ki", along.places, inside, slopes)
    multipliers = holding[:, nu : nu + along.mixed.size]
    rising = (along.share.reshape(n, q) * along.places).ravel()
    force = np.einsum("k,km,kmi->ki", rising, multipliers, along.row_y[:, along.mixed, :nx])
    shifts[1:] += force.reshape(n, q, nx).sum(axis=1)
    return shifts


def interval_end_costates(along: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """Return the one-sided limits of the reported costates at both ends of every interval. Shape (N, nx) each."""
    curve, mesh = along.solution.costate_interpolant, along.mesh
    if len(curve.breaks) == len(mesh) and np.array_equal(curve.breaks, mesh):
        intervals = np.arange(len(mesh) - 1)
        return curve.within(intervals, np.zeros(len(intervals))), curve.within(intervals, np.ones(len(intervals)))
    values = curve(mesh)
    return values[:-1], values[1:]


class BackwardIntegration:
    """Backward integration of the costate equation over every mesh interval, for given active limits of the controls.

    The multipliers of active path constraints are linear functions of the costate, or constant across a gap.
    """

    def __init__(self, along: Linearisation, multipliers: np.ndarray, across: np.ndarray) -> None:
        self.along = along
        n, q = along.shape
        nx, nu = along.form.nx, along.form.nu
        rate_x, rate_u = along.rate_y[:, :, :nx], along.rate_y[:, :, nx + 1 :]
        feed, source = rate_x.transpose(0, 2, 1).copy(), along.cost_y[:, :nx].copy()
        unit, mixed = along.control_size, slice(nu, nu + along.mixed.size)
        is_active = multipliers != 0
        self.projector = np.broadcast_to(np.eye(nu), (n * q, nu, nu)).copy()
        active = np.flatnonzero(is_active.any(axis=1))
        if active.size:
            rows = np.where(is_active[active, :, None], along.control_limits_u[active] * unit, 0.0)
            inverse = pseudo_inverse_of(along, is_active)[active].transpose(0, 2, 1)
            self.projector[active] -= rows.transpose(0, 2, 1) @ inverse
            if along.mixed.size:
                across_gaps = multipliers[:, mixed] * across[:, None]
                source += np.einsum("km,kmi->ki", across_gaps, along.row_y[:, along.mixed, :nx])
                active, inverse = active[~across[active]], inverse[~across[active]]
                # multipliers = - inverse (unit slope): a linear feedback of the costate
                slopes = along.row_y[active][:, along.mixed, :nx]
                feedback = np.einsum("kmi,kmu->kiu", slopes, inverse[:, mixed]) * unit
                feed[active] -= feedback @ rate_u[active].transpose(0, 2, 1)
                source[active] -= np.einsum("kiu,ku->ki", feedback, along.cost_y[active, nx + 1 :])
        ahead = along.weight - along.matrix  # weights of the integral from a point to the end
        self.ahead = ahead
        h = along.width
        self.feed, self.source = feed.reshape(n, q, nx, nx), source.reshape(n, q, nx)
        system = np.eye(q * nx) - np.einsum("k,ij,kjab->kiajb", h, ahead, self.feed).reshape(n, q * nx, q * nx)
        self.inverse = np.linalg.inv(system)
        self.drive = np.einsum("k,ij,kja->kia", h, ahead, self.source)

    def integrate(self, last: np.ndarray, inside: np.ndarray, atoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the costates at the Gauss points and just before each interval's start. Shapes (N q, nx) and (N, nx).

        Args:
            last: Costates at the ends of the intervals. Shape (N, nx).
            inside: Multipliers of the state limits at the Gauss points, times quadrature weights. Shape (N, q, m).
            atoms: Impulses of the state limits at both ends of the intervals. Shape (N, 2, m).
        """
        along = self.along
        (n, q), nx = along.shape, along.form.nx
        slopes, node = along.state_limits_x[:, :, :nx].reshape(n, q, -1, nx), along.node_limits_x[:, :, :nx]
        force = np.einsum("kjm,kjmi->kji", inside, slopes)
        end = last + np.einsum("km,kmi->ki", atoms[:, 1], node[1:])
        known = end[:, None] + self.drive + np.einsum("ij,kja->kia", self.ahead / along.weight, force)
        points = np.einsum("kab,kb->ka", self.inverse, known.reshape(n, q * nx)).reshape(n, q, nx)
        flow = np.einsum("kjab,kjb->kja", self.feed, points) + self.source
        start = end + np.einsum("k,j,kja->ka", along.width, along.weight, flow) + force.sum(axis=1)
        return points.reshape(n * q, nx), start + np.einsum("km,kmi->ki", atoms[:, 0], node[:-1])

    def accumulate(self, errors: np.ndarray) -> np.ndarray:
        """Propagate costate errors of intervals backwards; return their sums at the interval starts. Shape (N, nx)."""
        (n, q), nx = self.along.shape, self.along.form.nx
        points = (self.inverse @ np.tile(np.eye(nx), (q, 1))).reshape(n, q, nx, nx)
        weight = self.along.weight[:, None, None]
        flow = np.eye(nx) + self.along.width[:, None, None] * (weight * (self.feed @ points)).sum(axis=1)
        error, total = np.zeros(nx), np.zeros((n, nx))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in reversed(range(n)):
                error = errors[k] + flow[k] @ error
                total[k] = error
        return np.where(np.isfinite(total), total, np.inf)


def _state_limit_multipliers(
    back: BackwardIntegration, k: int, first: np.ndarray, last: np.ndarray, cost: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best multipliers of state limits in interval ``k``, as in `BackwardIntegration.integrate`."""
    along, (q, nx) = back.along, (back.along.shape[1], back.along.form.nx)
    points, size, unit, weight = slice(k * q, (k + 1) * q), along.state_size, along.control_size, along.weight
    inside, atoms = np.zeros((q, len(along.state_limits.equal))), np.zeros((2, len(along.state_limits.equal)))
    kinds = (
        (inside, along.state_limits.at(points), along.state_limits_x[points, :, :nx]),
        (atoms, along.node_limits.at(slice(k, k + 2)), along.node_limits_x[k : k + 2, :, :nx]),
    )
    # density of each multiplier: that at a Gauss point, at the end, or at the start of the interval
    densities = back.ahead.T / weight[:, None], np.array([np.zeros(q), np.ones(q)])
    unknowns = []
    for (values, limit, slope_x), density in zip(kinds, densities, strict=True):
        is_atom = values is atoms
        for active, gap, sign in limit.sides:
            for j, i in np.argwhere(active).tolist():
                effect = float(np.abs(slope_x[j, i]) @ size)
                # one unknown per equality, where the transcription imposes it
                redundant = limit.equal[i] and (is_atom, j) != (True, 0) if along.nodal else limit.equal[i] and is_atom
                if effect > 0 and not redundant:
                    place = values, j, i, sign / effect
                    price = gap[j, i] / effect
                    unknowns.append((place, sign * slope_x[j, i] / effect, density[j], price, bool(limit.equal[i])))
    if not unknowns:
        return inside, atoms
    places, directions, shares, prices, free = zip(*unknowns, strict=True)
    # costates at the Gauss points and at the start without multipliers, and their response to each multiplier
    ends = np.vstack([last, directions])
    known = np.concatenate([(last + back.drive[k])[None], np.array(shares)[:, :, None] * ends[1:, None]])
    costates = (known.reshape(len(ends), -1) @ back.inverse[k].T).reshape(known.shape)
    flow = np.einsum("jab,cjb->cja", back.feed[k], costates)
    flow[0] += back.source[k]
    starts = ends + along.width[k] * np.einsum("j,cja->ca", weight, flow)
    gradients = np.einsum("jiu,cji->cju", along.rate_y[points, :, nx + 1 :], costates)
    gradients[0] += along.cost_y[points, nx + 1 :]
    projectors = (along.width[k] * weight)[:, None, None] * back.projector[points]
    slopes = np.einsum("juv,cjv->cju", projectors, unit * gradients)
    errors = np.hstack([starts * size, slopes.reshape(len(ends), -1)])
    errors[0, :nx] -= first * size
    charges = COSTATE_SHARE * np.array(prices)
    multipliers = nnls(errors[1:].T, -errors[0] / cost, charges, np.array(free, bool)) * cost
    for (values, j, i, scale), multiplier in zip(places, multipliers, strict=True):
        values[j, i] += scale * multiplier
    return inside, atoms


def _inside_errors(along: Linearisation, costate: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the largest error of the reported costates inside each interval, in units of cost. Shape (N,)."""
    (n, q), nx = along.shape, along.form.nx
    fractions = along.solution.t / along.solution.horizon
    k = np.clip(np.searchsorted(along.mesh, fractions, side="right") - 1, 0, n - 1)
    place = (fractions - along.mesh[k]) / along.width[k]
    inside = (place > ROUNDING_SHARE) & (place < 1 - ROUNDING_SHARE)
    nodes, values = np.append(along.places, 1.0), np.concatenate([costate.reshape(n, q, nx), last[:, None]], axis=1)
    integrated = np.einsum("md,mdn->mn", lagrange(nodes, place[inside]), values[k[inside]])
    errors = np.abs(stack(along.solution.costates)[inside] - integrated) @ along.state_size
    worst = np.zeros(n)
    np.maximum.at(worst, k[inside], errors)
    return worst


def _ends(
    along: Linearisation,
    costate: np.ndarray,
    control_multipliers: np.ndarray,
    inside: np.ndarray,
    atoms: np.ndarray,
    cost: float,
    lam1: np.ndarray,
) -> Ends:
    """Return the residuals of the optimality conditions at both ends of a plan, with multipliers of admissible sign."""
    form, nx = along.form, along.form.nx
    lam0 = interval_end_costates(along)[0][0]
    gradient = along.final_y
    # dT H/dT along the plan, with the state limits
    by_horizon = along.cost_y[:, nx] + np.einsum("ki,ki->k", along.rate_y[:, :, nx], costate)
    by_horizon += np.einsum(
        "km,km->k", along.row_y[:, along.mixed, nx], control_multipliers[:, form.nu : form.nu + along.mixed.size]
    )
    horizon_slope = float(along.share @ by_horizon)
    horizon_slope += float(np.sum(inside.reshape(len(along.s), -1) * along.state_limits_x[:, :, nx]))
    horizon_slope += float(np.sum(atoms * along.node_limits_x[along.interval_ends, :, nx]))
    target = np.concatenate([lam1 - gradient[:nx], -lam0 - gradient[nx : 2 * nx], [-horizon_slope - gradient[-1]]])
    limits = end_limits(along)
    free, price = limits.free, limits.gap / limits.reach
    target = (target * limits.unit)[free]
    matrix = limits.scaled_slope.T[free]
    values = nnls(matrix, target / cost, COSTATE_SHARE * price, limits.equal) * cost
    residual = np.zeros(2 * nx + 1)
    residual[free] = target - matrix @ values
    errors, slope = np.abs(residual), residual[nx:] / limits.unit[nx:]
    table = limits.table(values / limits.reach)
    return Ends(float(errors[:-1].sum()), float(errors[-1]), slope, float(price @ values), *table)


@dataclass(frozen=True)
class EndLimits:
    """Limits that may be active at start or end of a plan: start and end constraints, bounds of horizon and states.

    Attributes:
        slope: Derivatives of each limit with respect to end state x, start state x0 and horizon T.
            Shape (K, 2 nx + 1).
        sign: 1 for an upper limit, -1 for a lower one. Shape (K,).
        gap: Distance to the limit. Shape (K,).
        equal: Whether it is an equality; these are listed once. Shape (K,).
        row: Index among the rows of end and start constraints, in this order, or -1. Shape (K,).
        rows: Numbers of rows of end and start constraints.
        free: Which entries of x, x0 and T are not fixed by their bounds. Shape (2 nx + 1,), bool.
        unit: Sizes of x, x0 and T. Shape (2 nx + 1,).
    """

    slope: np.ndarray
    sign: np.ndarray
    gap: np.ndarray
    equal: np.ndarray
    row: np.ndarray
    rows: tuple[int, int]
    free: np.ndarray
    unit: np.ndarray

    @property
    def reach(self) -> np.ndarray:
        """Change of each limited quantity if states and horizon change by their typical sizes. Shape (K,)."""
        return np.asarray(np.abs(self.slope) @ self.unit)

    @property
    def scaled_slope(self) -> np.ndarray:
        """Gradients of limits in scaled states and horizon, towards violation, of 1-norm 1. Shape (K, 2 nx + 1)."""
        return np.asarray(self.slope * (self.sign / self.reach)[:, None] * self.unit)

    def table(self, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the signed multipliers of end and of start constraints, from the multipliers of all K limits."""
        values = np.zeros(sum(self.rows))
        is_row = self.row >= 0
        np.add.at(values, self.row[is_row], (self.sign * multipliers)[is_row])
        return values[: self.rows[0]], values[self.rows[0] :]


def end_limits(along: Linearisation) -> EndLimits:
    """Return the limits that may be active at start or end of a plan."""
    form, sizes, nx, (low, high) = along.form, along.sizes, along.form.nx, along.bounds
    index = np.concatenate([form.end.bounds, form.start.bounds])
    equal = np.concatenate([form.end.equality, form.start.equality]) | (low[index] == high[index])
    size = np.concatenate([sizes.end, sizes.start])
    horizon, place = along.solution.horizon, form.bounds.places["horizon"]
    own, value = (low[place], high[place], low[place] == high[place]), np.array([horizon])
    parts = [
        (Limits(along.end_row[None], low[index], high[index], equal, size=size), along.end_y, np.arange(len(index))),
        (Limits(value[None], *own, size=value), np.eye(2 * nx + 1)[-1:], np.array([-1])),
    ]
    for k, entries in ((-1, [*range(nx), 2 * nx]), (0, [*range(nx, 2 * nx), 2 * nx])):
        slope = np.zeros((along.node_limits_x.shape[1], 2 * nx + 1))
        slope[:, entries] = along.node_limits_x[k]
        at = k % len(along.node_limits_x)
        parts.append((along.node_limits.at(slice(at, at + 1)), slope, np.full(len(slope), -1)))
    sides: list[tuple[np.ndarray, ...]] = []
    for limits, slope, row in parts:
        has_slope = np.abs(slope).max(axis=1, initial=0.0) > 0
        for active, gap, sign in limits.sides:
            near = active[0] & has_slope
            sides.append((slope[near], np.full(int(near.sum()), sign), gap[0, near], limits.equal[near], row[near]))
    slopes, signs, gaps, equals, rows = (np.concatenate(part) for part in zip(*sides, strict=True))
    places = form.bounds.places
    fixed = [low[places[kind]] == high[places[kind]] for kind in ("terminal", "initial")]
    free = ~np.concatenate([*fixed, [not form.horizon_is_free]])
    unit = np.concatenate([along.state_size, along.state_size, [horizon]])
    return EndLimits(slopes, signs, gaps, equals, rows, (len(form.end), len(form.start)), free, unit)
