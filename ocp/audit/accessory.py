"""The accessory problem: the second variation of the cost along a plan, and what its controls lose.

A linear-quadratic problem in the variations of states, horizon and controls (Bryson, Ho 1975, chapter 6), whose
constraints are those that are active, in units of how far each quantity moves along the plan. It is made discrete by
Gauss collocation of its own, three points or more in each interval whatever the method of the plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.principle import balance
from ocp.curves import quadrature_weights
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution

__all__ = ["FLAT", "AccessoryProblem", "dependent", "end_conditions", "rows_of_length_one", "unseen"]

POINTS = (3, 5)
"""Least and largest number of Gauss points of an interval."""
FLAT = 1e-7
"""Curvature, relative to the largest of the plan, below which the cost counts as not curved."""
RANK = 1e-9
"""Size of a singular value, relative to the largest, from which on constraints count as dependent."""
STILL = 1e-3
"""Least unit of an entry of a state or control, of the greatest of its entries."""
AT_BOUND = 1e-5
"""A value nearer to its bound than this share of its spread or range is held by it."""


class AccessoryProblem:
    """A plan at the Gauss points of its intervals: dynamics, Hamiltonian, active constraints, in scaled variations.

    z = (x, T where free, x0 where the end refers to it); all derivatives are those of dz/ds over the fraction s.

    Attributes:
        width, weight, places: Of the N intervals (N,) and of the Gauss points in one, (q,) each.
        rate: Jacobian of dz/ds in (z, u) at the N q points. Shape (N q, nz, nz + nu).
        hessian: Of T H in (z, u). Shape (N q, nz + nu, nz + nu).
        rows: Active constraints with a control, (r, nz + nu) for every point; held: which states are at a bound,
            (N, q, nz) bool.
        unit: Of (z, u): spread along the plan. Shape (nz + nu,).
        obstacle: Why the second variation is not known, or "".
    """

    def __init__(self, form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds) -> None:
        self.form, self.solution, self.p, self.bounds = form, solution, p, bounds
        mesh = solution.control_interpolant.breaks
        self.width = np.diff(mesh)
        degree = max(len(solution.control_interpolant.nodes), solution.state_interpolant.values.shape[1] - 1)
        q = int(np.clip(degree, *POINTS))
        self.places = np.array(ca.collocation_points(q, "legendre"))
        self.weight = quadrature_weights(self.places)
        n = len(self.width)
        s = (mesh[:-1, None] + self.width[:, None] * self.places).ravel()
        self.t = s * solution.horizon
        self.x = solution.state_interpolant(s)
        self.u = solution.control_interpolant.within(np.repeat(np.arange(n), q), np.tile(self.places, n))
        self.lam = solution.costate_interpolant(s)
        self.nx, self.nu = form.nx, form.nu
        self.free, self.tied = form.horizon_is_free, form.ties_ends
        self.nz = self.nx * (1 + self.tied) + self.free
        self.shape = (n, q)
        self.obstacle = self._obstacle()
        self._evaluate(s)

    def _obstacle(self) -> str:
        form = self.form
        if ca.depends_on(ca.vertcat(form.end.expression, form.terminal), form.u0):
            return "the control at the start enters the conditions at the end"
        if ca.depends_on(ca.vertcat(form.end.expression, form.terminal, form.start.expression), form.u):
            return "a control enters the conditions at an end"
        return ""

    def _spreads(self, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Size of each column: its spread along the plan, else its range, else its own size, else 1."""
        spread = np.ptp(values, axis=0)
        with np.errstate(invalid="ignore"):
            width = np.where(np.isfinite(high - low), high - low, 0.0)
        size = np.abs(values).max(axis=0, initial=0.0)
        size = np.where(size > 0, size, 1.0)
        return np.where(spread > AT_BOUND * size, spread, np.where(width > 0, width, size))

    def _evaluate(self, s: np.ndarray) -> None:
        form, (low, high), places = self.form, self.bounds, self.form.bounds.places
        n, q = self.shape
        nx, nu, m = self.nx, self.nu, n * q
        sym = form.sym
        fraction, lam, mu = sym("s"), sym("lam", nx), sym("mu", len(form.path))
        y = ca.vertcat(form.x, form.T, form.u)
        running, f, path = ca.substitute([form.running, form.f, form.path.expression], [form.t], [fraction * form.T])
        value = running + ca.dot(lam, f)
        first = [ca.gradient(value, form.u), ca.jacobian(form.T * f, y), path, ca.jacobian(path, y)]
        here = (self.x, self.u, self.t, self.solution.horizon, self.p, (fraction, s[:, None]), (lam, self.lam))
        slope, rate, level, level_y = form.sampled(first, *here, (mu, np.zeros((m, len(form.path)))))
        self.slope = slope
        rate = rate.reshape(m, nx + 1 + nu, nx).transpose(0, 2, 1)
        level_y = level_y.reshape(m, nx + 1 + nu, len(form.path)).transpose(0, 2, 1)

        # multipliers of what holds the controls: least squares with the signs of the minimum principle
        at = [places["control"], form.path.bounds]
        self.low, self.high = low[places["control"]], high[places["control"]]
        self.range = _units(self._spreads(self.u, self.low, self.high), form.controls)
        mixed = form.path.uses_control
        reach = np.concatenate([self.range, self._spreads(level, low[at[1]], high[at[1]])])
        values = np.hstack([self.u, level])
        lower, upper = np.concatenate([low[k] for k in at]), np.concatenate([high[k] for k in at])
        equal = np.concatenate([np.zeros(nu, bool), form.path.equality])
        at_lower, at_upper = (values <= lower + AT_BOUND * reach) | equal, (values >= upper - AT_BOUND * reach) | equal
        counts = np.concatenate([np.ones(nu, bool), mixed])
        multipliers = np.zeros((m, nu + len(form.path)))
        for k in np.flatnonzero(((at_lower | at_upper) & counts).any(axis=1)):
            directions = np.vstack([np.eye(nu), level_y[k][:, nx + 1 :]])
            multipliers[k] = balance(slope[k], directions, at_lower[k] & counts, at_upper[k] & counts)
        strong = np.abs(multipliers) > FLAT * (np.abs(multipliers).max(initial=0.0) or 1.0)
        self.fixed = (strong | equal)[:, :nu] & (at_lower | at_upper)[:, :nu]
        states_only = ~mixed & (at_lower | at_upper)[:, nu:].any(axis=0)
        if states_only.any():
            rows = path[np.flatnonzero(states_only).tolist()]
            if not self.obstacle and ca.jacobian(ca.jacobian(rows, form.x), form.x).nnz():
                self.obstacle = "a curved constraint of the states is active, whose multiplier is not known"

        total = form.T * (value + ca.dot(mu, path))
        (hessian,) = form.sampled([ca.hessian(total, y)[0]], *here, (mu, multipliers[:, nu:]))
        hessian = hessian.reshape(m, nx + 1 + nu, nx + 1 + nu)
        self.curved = hessian[:, nx + 1 :, nx + 1 :] / self.solution.horizon  # H_uu

        # from (x, T, u) to (z, u)
        keep = [*range(nx), *([nx] if self.free else [])]
        into = [*keep, *range(nx + 1, nx + 1 + nu)]
        z_of = [*range(len(keep)), *range(self.nz, self.nz + nu)]
        size = self.nz + nu
        self.rate, self.hessian = np.zeros((m, self.nz, size)), np.zeros((m, size, size))
        self.rate[np.ix_(range(m), range(nx), z_of)] = rate[:, :, into]
        self.hessian[np.ix_(range(m), z_of, z_of)] = hessian[np.ix_(range(m), into, into)]
        x_unit = _units(self._spreads(self.x, low[places["state"]], high[places["state"]]), form.states)
        horizon = [self.solution.horizon] if self.free else []
        self.unit = np.concatenate([x_unit, horizon, *([x_unit] if self.tied else []), self.range])
        z_unit = self.unit[: self.nz]
        self.rate *= self.unit / z_unit[:, None]
        self.hessian *= self.unit * self.unit[:, None]

        active_rows = np.zeros((m, len(form.path), size))
        active_rows[np.ix_(range(m), range(len(form.path)), z_of)] = level_y[:, :, into]
        active_rows *= self.unit
        holds = (at_lower | at_upper)[:, nu:] & (strong[:, nu:] | form.path.equality)
        in_state = (at_lower | at_upper)[:, nu:] & ~mixed
        bound = np.zeros((m, size), bool)
        x_low, x_high = low[places["state"]], high[places["state"]]
        bound[:, :nx] = (self.x <= x_low + AT_BOUND * x_unit) | (self.x >= x_high - AT_BOUND * x_unit)
        self.held = (bound.any(axis=1) | (in_state & ~form.path.equality).any(axis=1)).reshape(n, q)
        eye = np.eye(size)
        self.rows = [
            np.vstack(
                [active_rows[k][holds[k] & mixed | in_state[k] & form.path.equality], eye[self.nz :][self.fixed[k]]]
            )
            for k in range(m)
        ]
        self.held_rows = [
            np.vstack([active_rows[k][in_state[k] & ~form.path.equality], eye[bound[k]]]) for k in range(m)
        ]

    def lost(self) -> float:
        """What the controls could win within their bounds, to second order, in units of cost."""
        if not self.nu:
            return 0.0
        weights = (self.width[:, None] * self.weight).ravel() * self.solution.horizon
        won = np.zeros(len(weights))
        for k, (slope, curved) in enumerate(zip(self.slope, self.curved, strict=True)):
            rows = self.rows[k][:, self.nz :] / self.range
            won[k] = _won(slope, curved, self.low - self.u[k], self.high - self.u[k], rows)
        return float(np.dot(weights, won))


def _units(spreads: np.ndarray, parts: Mapping[str, slice]) -> np.ndarray:
    """Spreads of entries, of each named part none much below its greatest: one that stands still moves by rounding."""
    for part in parts.values():
        spreads[part] = np.maximum(spreads[part], STILL * spreads[part].max())
    return spreads


def _won(slope: np.ndarray, curved: np.ndarray, low: np.ndarray, high: np.ndarray, rows: np.ndarray) -> float:
    """- min of slope' d + d' curved d / 2 over low <= d <= high, rows d = 0; inf where it is unbounded."""
    basis = unseen(rows)
    if not basis.shape[1]:
        return 0.0
    inside = basis.T @ curved @ basis
    values, vectors = np.linalg.eigh((inside + inside.T) / 2)
    pull = vectors.T @ (basis.T @ slope)
    solid = values > FLAT * max(np.abs(values).max(), np.finfo(float).tiny)
    step = np.where(solid, -pull / np.where(solid, values, 1.0), 0.0)
    d = basis @ (vectors @ step)
    if solid.all() and ((low <= d) & (d <= high)).all():
        return float(-(slope @ d + d @ curved @ d / 2))
    # coordinate descent from the plan: exact for one control, a lower estimate of what is lost else
    d = np.zeros(len(slope))
    for _ in range(20):
        for i in range(len(d)):
            g = slope[i] + curved[i] @ d - curved[i, i] * d[i]
            ends = [end for end in (low[i], high[i]) if np.isfinite(end)]
            if curved[i, i] > 0:
                ends = [float(np.clip(-g / curved[i, i], low[i], high[i]))]
            if ends:
                d[i] = min([*ends, d[i]], key=lambda v: g * v + curved[i, i] * v * v / 2)
    return float(max(0.0, -(slope @ d + d @ curved @ d / 2)))


def end_conditions(along: AccessoryProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Second variation and active rows in scaled z: (hessian, rows) at the end, (hessian, rows) at the start.

    The multipliers of the conditions are those that explain the costates: lambda(T) = d(Phi + nu psi)/dx, and
    -lambda(0) = d(Phi + nu psi)/dx0 + nu_0 dpsi_0/dx.
    """
    form, solution, (low, high) = along.form, along.solution, along.bounds
    places, nx = form.bounds.places, along.nx
    x0, x1 = (solution.state_interpolant(np.array([end]))[0] for end in (0.0, 1.0))
    lam0, lam1 = (solution.costate_interpolant(np.array([end]))[0] for end in (0.0, 1.0))
    nu_end, nu_start = (form.sym(name, len(r)) for name, r in (("nu", form.end), ("nu0", form.start)))
    last = ca.substitute([form.end.expression, form.terminal], [form.t], [form.T])
    begin = ca.substitute([form.start.expression], [form.x, form.t], [form.x0, 0])[0]
    both = ca.vertcat(form.x, form.T, form.x0)
    total = [last[1] + ca.dot(nu_end, last[0]), ca.dot(nu_start, begin)]
    symbols = [form.x, form.x0, form.T, form.p]
    arguments = (x1, x0, solution.horizon, along.p)
    values = ca.Function("ends", symbols, [last[0], ca.jacobian(last[0], both), begin, ca.jacobian(begin, both)])
    psi, psi_y, psi0, psi0_y = (np.asarray(v.full()) for v in values(*arguments))
    slope = np.asarray(ca.Function("slope", symbols, [ca.densify(ca.gradient(last[1], both))])(*arguments).full())[:, 0]

    def active(rows: Any, level: np.ndarray) -> np.ndarray:
        a, b = low[rows.bounds], high[rows.bounds]
        with np.errstate(invalid="ignore"):
            size = np.where(np.isfinite(b - a) & (b > a), b - a, np.maximum(1.0, np.abs(level)))
        return np.asarray((level <= a + AT_BOUND * size) | (level >= b - AT_BOUND * size) | rows.equality)

    at_end, at_start = active(form.end, psi[:, 0]), active(form.start, psi0[:, 0])
    fixed = {k: low[places[k]] == high[places[k]] for k in ("terminal", "initial")}
    unit = along.unit[:nx]
    for k, x in (("terminal", x1), ("initial", x0)):  # a bound that the end of a free state rests on
        rests = (x <= low[places[k]] + AT_BOUND * unit) | (x >= high[places[k]] - AT_BOUND * unit)
        fixed[k] = fixed[k] | rests
    free = np.concatenate([~fixed["terminal"], ~fixed["initial"]])
    target = np.concatenate([lam1, -lam0]) - slope[[*range(nx), *range(nx + 1, 2 * nx + 1)]]
    columns = np.vstack([psi_y[at_end], psi0_y[at_start]])[:, [*range(nx), *range(nx + 1, 2 * nx + 1)]].T
    found = (
        np.linalg.lstsq(columns[free], target[free], rcond=None)[0]
        if columns[free].size
        else np.zeros(columns.shape[1])
    )
    multipliers = np.zeros(len(form.end) + len(form.start))
    multipliers[np.concatenate([at_end, at_start])] = found
    curved = ca.Function("curved", [*symbols, nu_end, nu_start], [ca.densify(ca.hessian(v, both)[0]) for v in total])
    at_ends = curved(*arguments, multipliers[: len(form.end)], multipliers[len(form.end) :])
    end_curved, start_curved = (np.asarray(v.full()) for v in at_ends)

    # rows and columns of (x, T, x0) that z has; at the start x is the x0 of the conditions
    z = [*range(nx), *([nx] if along.free else []), *(range(nx + 1, 2 * nx + 1) if along.tied else [])]
    z_unit = along.unit[: along.nz]
    eye = np.eye(along.nz)
    end_hessian, end_rows = end_curved[np.ix_(z, z)], np.vstack([psi_y[at_end][:, z], eye[:nx][fixed["terminal"]]])
    begin_of = [*range(nx + 1, 2 * nx + 1), *([nx] if along.free else [])]
    start_hessian, start_rows = np.zeros((along.nz, along.nz)), np.zeros((int(at_start.sum()), along.nz))
    start_hessian[: len(begin_of), : len(begin_of)] = start_curved[np.ix_(begin_of, begin_of)]
    start_rows[:, : len(begin_of)] = psi0_y[at_start][:, begin_of]
    extra = [eye[:nx][fixed["initial"]]]
    if along.tied:
        extra.append(eye[:nx] - eye[along.nz - nx :])
    if along.free:
        at = places["horizon"]
        if solution.horizon <= low[at][0] * (1 + AT_BOUND) or solution.horizon >= high[at][0] * (1 - AT_BOUND):
            extra.append(eye[nx : nx + 1])
    scale = z_unit * z_unit[:, None]
    return end_hessian * scale, end_rows * z_unit, start_hessian * scale, np.vstack([start_rows * z_unit, *extra])


def dependent(rows: np.ndarray) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Rank of rows (m, n) each of length 1 or less, and their singular vectors and values: left, values, right."""
    left, sizes, right = np.linalg.svd(rows)
    return int(np.sum(sizes > RANK)), left, sizes, right


def unseen(rows: np.ndarray) -> np.ndarray:
    """Orthonormal directions (n, k) that rows (m, n) do not see."""
    rank, _, _, right = dependent(rows_of_length_one(rows))
    return np.asarray(right[rank:].T)


def rows_of_length_one(rows: np.ndarray) -> np.ndarray:
    """The same rows, each of length 1, without those that say nothing."""
    sizes = np.linalg.norm(rows, axis=1)
    keep = sizes > RANK * max(1.0, float(sizes.max(initial=0.0)))
    return np.asarray(rows[keep] / sizes[keep, None])
