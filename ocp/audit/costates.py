"""The costates of a plan against their own equation, lambda' = -dH/dx, and against the conditions at the ends.

The costates that a plan reports come from the multipliers of whatever method made it. Here each interval is integrated
backwards from the reported costate at its end, by Gauss collocation, with multipliers of the active limits found anew.
Limits of the states push on the costate with a density along an arc, and with an atom where a transcription holds them
at single points, or where an arc begins (Hartl, Sethi, Vickson 1995): both are looked for, with the signs that they
must have, and what they win over the gap to their limit counts as cost that is lost. What of the costates no such push
explains is their error. It is stated in units of cost, each costate times the size of its state, and summed over the
intervals, so that an error in every interval does not hide what all of them make together (Bryson, Ho 1975, chapters 2
and 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import holders, inverse_of, nonnegative
from ocp.curves import lagrange
from ocp.solution import stack
from ocp.tolerances import COSTATE_SHARE, ROUNDING_SHARE

__all__ = ["Adjoint", "EndLimits", "Ends", "adjoint", "end_limits", "ends_of_intervals"]


class Ends(NamedTuple):
    """The conditions at the ends of a plan.

    Attributes:
        transversality: What of the costates at the ends no multiplier of an end condition explains, in units of cost.
        horizon: What of the derivative in a free horizon none explains, times the horizon, in units of cost.
        slope: What none explains of the derivative of the cost in the start and the horizon. Shape (nx + 1,).
        charge: What the multipliers win over the gaps to their limits, in units of cost.
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
    """How well the costates of a plan meet their equations. Errors are in units of cost.

    Attributes:
        t: Ends of the intervals, s. Shape (N + 1,).
        costate: At the Gauss points, integrated backwards in every interval from the plan's own at its end. (N q, nx).
        holding: Multipliers of the limits of the controls at the Gauss points, per unit of s. Shape (N q, nu + r + a).
        standing: Multipliers of the limits of the states at the Gauss points, per unit of s, those at the ends of the
            intervals spread over their neighbours. Shape (N q, nx + r').
        error: Of the costates over each interval, from end to end. Shape (N,).
        total: Of all of them: their sum, or where errors cancel the largest distance from the costates that are
            integrated from the end of the plan to its start, whichever is less.
        between: Of what is reported between the ends of an interval. Shape (N,).
        charge: What the multipliers of the states' limits win over the gaps to them, in each interval. Shape (N,).
        lumps: What of the costates reported at the ends of the intervals stands for pushes before these: a limit that a
            transcription holds there alone pushes there at once for both its sides. Shape (N + 1, nx).
        ends: The conditions at the ends.
    """

    t: np.ndarray
    costate: np.ndarray
    holding: np.ndarray
    standing: np.ndarray
    error: np.ndarray
    total: float
    between: np.ndarray
    charge: np.ndarray
    lumps: np.ndarray
    ends: Ends


def adjoint(along: Linearisation, curved: np.ndarray | None, cost: float, taken: np.ndarray | None = None) -> Adjoint:
    """Integrate the costates of a plan backwards, find what pushes them, and look at the ends.

    Args:
        along: The plan.
        curved: T H_uu at the points, (M, nu, nu), or None where no path inequality has a control.
        cost: A size of the cost, which errors are weighed by.
        taken: Lumps of an earlier look, taken from the costates reported at the ends, so that their pushes spread.
    """
    (n, q), m = along.shape, along.stand.lower.shape[1]
    first, last = ends_of_intervals(along)
    # what jumps between two intervals is for the pushes at the start of the second to explain
    first = np.vstack([first[:1], last[:-1]])
    if taken is not None:
        first, last = first - taken[:-1], last - taken[1:]
    costate, inside, atoms = along.costate, np.zeros((n, q, m)), np.zeros((n, 2, m))
    near, at_node = (
        np.asarray(part.any(axis=1)) for part in (along.stand.near.reshape(n, q * m), along.node_stand.near)
    )
    limited = np.flatnonzero(near | at_node[:-1] | at_node[1:])
    holding, across = holders(along, costate, curved)
    for _ in range(3):  # of the multipliers that hold the controls and those that hold the states, one with the other
        before = holding != 0
        back = Backwards(along, holding, across)
        for k in limited.tolist():
            inside[k], atoms[k] = _pushes(back, k, first[k], last[k], cost)
        costate, start = back.integrate(last, inside, atoms)
        holding, across = holders(along, costate, curved)
        if not (limited.size or along.mixed.size) or (before == (holding != 0)).all():
            break
    size = along.state_size
    places, stand = along.share.reshape(n, q, 1), along.stand.charge(inside.reshape(n * q, m)).reshape(n, q, m)
    node = along.node_stand
    single = [node.at(k).charge(atoms[:, e]).sum(axis=1) for e, k in ((0, slice(0, n)), (1, slice(1, n + 1)))]
    standing = inside / places
    standing[:, 0] += atoms[:, 0] / places[:, 0]
    standing[:, -1] += atoms[:, 1] / places[:, -1]
    force = np.abs(np.einsum("kjm,kjmi->kji", inside, along.stand_x[..., :-1].reshape(n, q, m, -1))) @ size
    for e, nodes in ((0, slice(0, n)), (1, slice(1, n + 1))):
        force[:, 0] += np.abs(np.einsum("km,kmi->ki", atoms[:, e], along.node_stand_x[nodes, :, :-1])) @ size
    off = back.chained(first - start)
    total = min(float(np.abs(first - start).sum(axis=0) @ size), float((np.abs(off) @ size).max()))
    return Adjoint(
        along.mesh * along.solution.horizon,
        costate,
        holding,
        standing.reshape(n * q, m),
        np.abs(first - start) @ size,
        total,
        np.maximum(_between(along, costate, last) - force.sum(axis=1), 0.0),
        stand.sum(axis=(1, 2)) + single[0] + single[1],
        _lumps(along, holding, inside, atoms if taken is None else None),
        _ends(along, costate, holding, inside, atoms, cost, last[-1]),
    )


def _lumps(along: Linearisation, holding: np.ndarray, inside: np.ndarray, atoms: np.ndarray | None) -> np.ndarray:
    """See `Adjoint`: the share of a node's hat that lies before it, of all that pushes there.

    Of ``atoms`` at the starts of the intervals, where they are not spread yet, that is half.
    """
    (n, q), nx, nu = along.shape, along.form.nx, along.form.nu
    found = np.zeros((n + 1, nx))
    if not along.nodal:
        return found
    if atoms is not None:
        found[:-1] += np.einsum("km,kmi->ki", atoms[:, 0], along.node_stand_x[:-1, :, :nx]) / 2
    slopes = along.stand_x[:, :, :nx].reshape(n, q, inside.shape[2], nx)
    found[1:] += np.einsum("j,kjm,kjmi->ki", along.places, inside, slopes)
    pushes = holding[:, nu : nu + along.mixed.size]
    rising = (along.share.reshape(n, q) * along.places).ravel()
    force = np.einsum("k,km,kmi->ki", rising, pushes, along.row_y[:, along.mixed, :nx])
    found[1:] += force.reshape(n, q, nx).sum(axis=1)
    return found


def ends_of_intervals(along: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """The reported costates at the start and at the end of every interval, (N, nx) each, each from its own side."""
    curve, mesh = along.solution.costate_interpolant, along.mesh
    if len(curve.breaks) == len(mesh) and np.array_equal(curve.breaks, mesh):
        pieces = np.arange(len(mesh) - 1)
        return curve.within(pieces, np.zeros(len(pieces))), curve.within(pieces, np.ones(len(pieces)))
    values = curve(mesh)
    return values[:-1], values[1:]


class Backwards:
    """The costate equation over every interval backwards, what holds the controls answering to the costates."""

    def __init__(self, along: Linearisation, holding: np.ndarray, across: np.ndarray) -> None:
        self.along = along
        n, q = along.shape
        nx, nu = along.form.nx, along.form.nu
        rate_x, rate_u = along.rate_y[:, :, :nx], along.rate_y[:, :, nx + 1 :]
        feed, given = rate_x.transpose(0, 2, 1).copy(), along.cost_y[:, :nx].copy()
        unit, mixed = along.control_size, slice(nu, nu + along.mixed.size)
        pushing = holding != 0
        self.projector = np.broadcast_to(np.eye(nu), (n * q, nu, nu)).copy()
        held = np.flatnonzero(pushing.any(axis=1))
        if held.size:
            rows = np.where(pushing[held, :, None], along.hold_u[held] * unit, 0.0)
            inverse = inverse_of(along, pushing)[held].transpose(0, 2, 1)
            self.projector[held] -= rows.transpose(0, 2, 1) @ inverse
            if along.mixed.size:
                given += np.einsum("km,kmi->ki", holding[:, mixed] * across[:, None], along.row_y[:, along.mixed, :nx])
                held, inverse = held[~across[held]], inverse[~across[held]]
                # multipliers = - inverse (unit slope): the costate equation has them as a feedback of the costate
                slopes = along.row_y[held][:, along.mixed, :nx]
                answer = np.einsum("kmi,kmu->kiu", slopes, inverse[:, mixed]) * unit
                feed[held] -= answer @ rate_u[held].transpose(0, 2, 1)
                given[held] -= np.einsum("kiu,ku->ki", answer, along.cost_y[held, nx + 1 :])
        ahead = along.weight - along.matrix  # of the integral from a point to the end
        self.ahead = ahead
        h = along.width
        self.feed, self.given = feed.reshape(n, q, nx, nx), given.reshape(n, q, nx)
        system = np.eye(q * nx) - np.einsum("k,ij,kjab->kiajb", h, ahead, self.feed).reshape(n, q * nx, q * nx)
        self.inverse = np.linalg.inv(system)
        self.drive = np.einsum("k,ij,kja->kia", h, ahead, self.given)

    def integrate(self, last: np.ndarray, inside: np.ndarray, atoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Costates at the points (N q, nx) and before the start of every interval (N, nx).

        Args:
            last: Costates at the ends. Shape (N, nx).
            inside, atoms: Pushes of the limits of the states at the points, (N, q, m), and at both ends, (N, 2, m).
        """
        along = self.along
        (n, q), nx = along.shape, along.form.nx
        slopes, node = along.stand_x[:, :, :nx].reshape(n, q, -1, nx), along.node_stand_x[:, :, :nx]
        force = np.einsum("kjm,kjmi->kji", inside, slopes)
        end = last + np.einsum("km,kmi->ki", atoms[:, 1], node[1:])
        known = end[:, None] + self.drive + np.einsum("ij,kja->kia", self.ahead / along.weight, force)
        points = np.einsum("kab,kb->ka", self.inverse, known.reshape(n, q * nx)).reshape(n, q, nx)
        flow = np.einsum("kjab,kjb->kja", self.feed, points) + self.given
        start = end + np.einsum("k,j,kja->ka", along.width, along.weight, flow) + force.sum(axis=1)
        return points.reshape(n * q, nx), start + np.einsum("km,kmi->ki", atoms[:, 0], node[:-1])

    def chained(self, errors: np.ndarray) -> np.ndarray:
        """What errors (N, nx) at the start of each interval make together at its start, carried on backwards."""
        (n, q), nx = self.along.shape, self.along.form.nx
        points = (self.inverse @ np.tile(np.eye(nx), (q, 1))).reshape(n, q, nx, nx)
        weight = self.along.weight[:, None, None]
        flow = np.eye(nx) + self.along.width[:, None, None] * (weight * (self.feed @ points)).sum(axis=1)
        off, found = np.zeros(nx), np.zeros((n, nx))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in reversed(range(n)):
                off = errors[k] + flow[k] @ off
                found[k] = off
        return np.where(np.isfinite(found), found, np.inf)


def _pushes(back: Backwards, k: int, first: np.ndarray, last: np.ndarray, cost: float) -> tuple[np.ndarray, np.ndarray]:
    """Pushes of the limits of the states in interval k that explain its costates best: (q, m), (2, m)."""
    along = back.along
    q, nx, m = along.shape[1], along.form.nx, along.stand.lower.shape[1]
    mine = slice(k * q, (k + 1) * q)
    size, unit = along.state_size, along.control_size
    limits = [along.stand.at(mine), along.node_stand.at(slice(k, k + 2))]
    slopes = [along.stand_x[mine, :, :nx], along.node_stand_x[k : k + 2, :, :nx]]
    columns, charges, owners, free = [], [], [], []
    for kind, (limit, slope_x) in enumerate(zip(limits, slopes, strict=True)):
        for side, gap, sign in ((limit.upper, limit.above, 1.0), (limit.lower & ~limit.equal, limit.below, -1.0)):
            for j, i in zip(*np.nonzero(side), strict=True):
                reach = float(np.abs(slope_x[j, i]) @ size)
                # an equality pushes where a transcription holds it: one unknown for each of its own
                elsewhere = limit.equal[i] and (kind, j) != (1, 0) if along.nodal else limit.equal[i] and kind == 1
                if reach > 0 and not elsewhere:
                    columns.append((kind, j, sign * slope_x[j, i] / reach))
                    charges.append(gap[j, i] / reach)
                    owners.append((kind, j, i, sign / reach))
                    free.append(bool(limit.equal[i]))
    inside, atoms = np.zeros((q, m)), np.zeros((2, m))
    if not columns:
        return inside, atoms
    # answers of the costates at the points and at the start to each push
    answer, start = np.zeros((len(columns), q, nx)), np.zeros((len(columns), nx))
    for c, (kind, j, push) in enumerate(columns):
        if kind == 0:
            answer[c] = back.ahead[:, j, None] / along.weight[j] * push
            start[c] = push
        elif j == 1:
            answer[c], start[c] = push, push
        else:
            start[c] = push
    answer = (answer.reshape(len(columns), -1) @ back.inverse[k].T).reshape(-1, q, nx)
    flow = np.einsum("jab,cjb->cja", back.feed[k], answer)
    start += along.width[k] * np.einsum("j,cja->ca", along.weight, flow)
    known = last + back.drive[k]
    base = (back.inverse[k] @ known.ravel()).reshape(q, nx)
    flow0 = np.einsum("jab,jb->ja", back.feed[k], base) + back.given[k]
    start0 = last + along.width[k] * along.weight @ flow0
    weight = along.width[k] * along.weight
    rate_u = along.rate_y[mine, :, nx + 1 :]
    gradient = along.cost_y[mine, nx + 1 :] + np.einsum("jiu,ji->ju", rate_u, base)
    held = back.projector[mine]
    slope0 = np.einsum("j,juv,jv->ju", weight, held, unit * gradient)
    slopes_c = np.einsum("j,juv,cjv->cju", weight, held, unit * np.einsum("jiu,cji->cju", rate_u, answer))
    target = np.concatenate([(first - start0) * size, -slope0.ravel()]) / cost
    matrix = np.hstack([start * size, slopes_c.reshape(len(columns), q * len(unit))]).T
    found = nonnegative(matrix, target, COSTATE_SHARE * np.array(charges), np.array(free, bool)) * cost
    for (kind, j, i, scale), value in zip(owners, found, strict=True):
        (inside if kind == 0 else atoms)[j, i] += scale * value
    return inside, atoms


def _between(along: Linearisation, costate: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Distance of the costates that a plan reports between the ends of its intervals, in units of cost. Shape (N,)."""
    (n, q), nx = along.shape, along.form.nx
    at = along.solution.t / along.solution.horizon
    k = np.clip(np.searchsorted(along.mesh, at, side="right") - 1, 0, n - 1)
    place = (at - along.mesh[k]) / along.width[k]
    inner = (place > ROUNDING_SHARE) & (place < 1 - ROUNDING_SHARE)
    nodes, values = np.append(along.places, 1.0), np.concatenate([costate.reshape(n, q, nx), last[:, None]], axis=1)
    found = np.einsum("md,mdn->mn", lagrange(nodes, place[inner]), values[k[inner]])
    off = np.abs(stack(along.solution.costates)[inner] - found) @ along.state_size
    worst = np.zeros(n)
    np.maximum.at(worst, k[inner], off)
    return worst


def _ends(
    along: Linearisation,
    costate: np.ndarray,
    holding: np.ndarray,
    inside: np.ndarray,
    atoms: np.ndarray,
    cost: float,
    lam1: np.ndarray,
) -> Ends:
    """The conditions at the ends with the multipliers, of the right signs, that explain them best."""
    form, solution, nx = along.form, along.solution, along.form.nx
    low, high = along.bounds
    places = form.bounds.places
    lam0 = ends_of_intervals(along)[0][0]
    gradient = along.final_y
    # dT H/dT along the plan, what pushes included
    by_horizon = along.cost_y[:, nx] + np.einsum("ki,ki->k", along.rate_y[:, :, nx], costate)
    by_horizon += np.einsum(
        "km,km->k", along.row_y[:, along.mixed, nx], holding[:, form.nu : form.nu + along.mixed.size]
    )
    lasting = float(along.share @ by_horizon)
    n, q = along.shape
    lasting += float(np.sum(inside.reshape(n * q, -1) * along.stand_x[:, :, nx]))
    for e, nodes in ((0, slice(0, n)), (1, slice(1, n + 1))):
        lasting += float(np.sum(atoms[:, e] * along.node_stand_x[nodes, :, nx]))
    target = np.concatenate([lam1 - gradient[:nx], -lam0 - gradient[nx : 2 * nx], [-lasting - gradient[-1]]])
    unit = np.concatenate([along.state_size, along.state_size, [solution.horizon]])

    limits = end_limits(along)
    reach = np.abs(limits.slope) @ unit
    free = np.ones(2 * nx + 1, bool)
    free[:nx] = low[places["terminal"]] < high[places["terminal"]]
    free[nx : 2 * nx] = low[places["initial"]] < high[places["initial"]]
    free[-1] = form.horizon_is_free
    matrix = (limits.slope * (limits.sign / reach)[:, None] * unit).T[free]
    prices = COSTATE_SHARE * limits.gap / reach
    found = nonnegative(matrix, (target * unit)[free] / cost, prices, limits.equal) * cost
    left = np.zeros(2 * nx + 1)
    left[free] = (target * unit)[free] - matrix @ found
    charge = float(limits.gap / reach @ found)
    multipliers = limits.table(found / reach)
    off = np.abs(left)
    slope = left[nx:] / unit[nx:]
    return Ends(float(off[:-1].sum()), float(off[-1]), slope, charge, *multipliers)


@dataclass(frozen=True)
class EndLimits:
    """What may push at the ends of a plan: end and start rows, bounds of the horizon, limits of the states there.

    Attributes:
        slope: Derivatives in (x, x0, T), one of each side that may push. Shape (K, 2 nx + 1).
        sign: 1 of an upper limit, -1 of a lower one. gap: Distance to it. equal: Whether it is an equality, which
            stands here once. row: Of the end and start rows, in this order, or -1. Shape (K,) each.
        rows: Numbers of end and start rows.
    """

    slope: np.ndarray
    sign: np.ndarray
    gap: np.ndarray
    equal: np.ndarray
    row: np.ndarray
    rows: tuple[int, int]

    def table(self, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multipliers of the end and the start rows with their signs."""
        found = np.zeros(sum(self.rows))
        own = self.row >= 0
        np.add.at(found, self.row[own], (self.sign * multipliers)[own])
        return found[: self.rows[0]], found[self.rows[0] :]


def end_limits(along: Linearisation) -> EndLimits:
    """What is near enough to push at the ends of a plan."""
    form, sizes, nx, (low, high) = along.form, along.sizes, along.form.nx, along.bounds
    index = np.concatenate([form.end.bounds, form.start.bounds])
    equal = np.concatenate([form.end.equality, form.start.equality]) | (low[index] == high[index])
    size = np.concatenate([sizes.end, sizes.start])
    horizon, place = along.solution.horizon, form.bounds.places["horizon"]
    lasts = Limits(np.array([[horizon]]), low[place], high[place], low[place] == high[place], np.array([horizon]))
    parts = [(Limits(along.end_row[None], low[index], high[index], equal, size), along.end_y, np.arange(len(index)))]
    parts.append((lasts, np.eye(2 * nx + 1)[-1:], np.array([-1])))
    for k, into in ((-1, [*range(nx), 2 * nx]), (0, [*range(nx, 2 * nx), 2 * nx])):
        slope = np.zeros((along.node_stand_x.shape[1], 2 * nx + 1))
        slope[:, into] = along.node_stand_x[k]
        at = k % len(along.node_stand_x)
        parts.append((along.node_stand.at(slice(at, at + 1)), slope, np.full(len(slope), -1)))
    found: list[tuple[np.ndarray, ...]] = []
    for limits, slope, row in parts:
        says = np.abs(slope).max(axis=1, initial=0.0) > 0
        for near, gap, sign in (
            (limits.upper[0], limits.above[0], 1.0),
            (limits.lower[0] & ~limits.equal, limits.below[0], -1.0),
        ):
            own = near & says
            found.append((slope[own], np.full(int(own.sum()), sign), gap[own], limits.equal[own], row[own]))
    slopes, signs, gaps, equals, rows = (np.concatenate(part) for part in zip(*found, strict=True))
    return EndLimits(slopes, signs, gaps, equals, rows, (len(form.end), len(form.start)))
