"""Second order: does the cost curve upwards along every feasible variation of a plan, and what does the plan lose?

A stationary plan may be a maximum, a saddle, or a minimum only until a conjugate point. Here the second variation of
the cost is formed along the plan (the accessory problem of Bryson, Ho 1975, chapter 6): a linear-quadratic problem in
the variations of states, horizon and controls, whose constraints are those that are active. It is made discrete by
Gauss collocation of its own, three points or more in each interval whatever the method of the plan, and swept
backwards, stage by stage. What a stage's own constraints and those carried over from later ones leave free must curve
upwards; where it first does not is the conjugate point, and the eigenvector continued with the optimal feedback is a
variation that lowers the cost. The sweep is linear in the number of intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.principle import balance
from ocp.curves import lagrange, quadrature_weights
from ocp.problem.formulation import Formulation
from ocp.solution import Solution

__all__ = ["Curvature", "curvature"]

POINTS = (3, 5)
"""Least and largest number of Gauss points of an interval."""
FLAT = 1e-7
"""Curvature, relative to the largest of the plan, below which the cost counts as not curved."""
RANK = 1e-9
"""Size of a singular value, relative to the largest, from which on constraints count as dependent."""
STILL = 1e-3
"""Least unit of an entry of a state, of the greatest of its entries."""
SLIP = 1e-6
"""What a variation that lowers the cost may miss its constraints by, relative to its size."""
AT_BOUND = 1e-5
"""A value nearer to its bound than this share of its spread or range is held by it."""


@dataclass(frozen=True)
class Curvature:
    """The second variation of the cost along a plan.

    Attributes:
        least: Smallest curvature of the cost over a stage's feasible variations, the optimal ones after it included,
            with controls in units of their spread, relative to the largest; negative where the plan is no minimum. inf
            where nothing is free to vary.
        time: Where it is found, s: for a negative one the conjugate point. None where nothing is free.
        flat: Why the sweep does not decide, or "".
        lost: What the cost could be less by, to second order: the integral of the least of
            H_u du + du H_uu du / 2 over the controls within their bounds. In units of cost.
        direction: For a negative curvature a variation that lowers the cost: of the controls at the points ``t``
            (M, nu) and of the states at the ends of the intervals (N + 1, nx); else None.
        t: Times of the Gauss points, s. Shape (M,).
    """

    least: float
    time: float | None
    flat: str
    lost: float
    direction: tuple[np.ndarray, np.ndarray] | None
    t: np.ndarray

    @property
    def upwards(self) -> bool | None:
        """Whether the cost curves upwards along all feasible variations; None where that is not decided."""
        if self.flat:
            return None
        return bool(self.least > FLAT)


def curvature(form: Formulation, solution: Solution, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> Curvature:
    """Sweep the second variation of the cost along a plan whose costates are trusted.

    Args:
        form, p, bounds: The problem, its parameters and its bounds at these.
        solution: The plan; its costates make the Hamiltonian.
    """
    along = _Along(form, solution, p, bounds)
    if form.indifferent:
        return Curvature(np.inf, None, "", 0.0, None, along.t)
    if not (np.isfinite(along.rate).all() and np.isfinite(along.hessian).all()):
        return Curvature(np.nan, None, "the Hamiltonian is not finite along the plan", np.nan, None, along.t)
    lost = along.lost()
    if along.obstacle:
        return Curvature(np.nan, None, along.obstacle, lost, None, along.t)
    found = _sweep(along, held=False)
    if found.least <= FLAT and along.held.any():
        # a bound of a state takes directions away; where only it keeps the cost from falling, that is not enough
        inside = _sweep(along, held=True)
        if inside.least > FLAT:
            why = "the cost curves upwards only because a state is held at its bound"
            return Curvature(inside.least, inside.time, why, lost, None, along.t)
        found = inside
    least, time, flat, direction = found
    return Curvature(least, time, flat, lost, direction, along.t)


class _Along:
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

    def __init__(
        self, form: Formulation, solution: Solution, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
    ) -> None:
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
        self.range = self._spreads(self.u, self.low, self.high)
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
        x_unit = self._spreads(self.x, low[places["state"]], high[places["state"]])
        for part in form.states.values():  # an entry that stands still beside its neighbours moves by rounding alone
            x_unit[part] = np.maximum(x_unit[part], STILL * x_unit[part].max())
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


def _won(slope: np.ndarray, curved: np.ndarray, low: np.ndarray, high: np.ndarray, rows: np.ndarray) -> float:
    """- min of slope' d + d' curved d / 2 over low <= d <= high, rows d = 0; inf where it is unbounded."""
    basis = _unseen(rows)
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


def _split(rows: np.ndarray) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Rank of rows (m, n) each of length 1 or less, and their singular vectors and values: left, values, right."""
    left, sizes, right = np.linalg.svd(rows)
    return int(np.sum(sizes > RANK)), left, sizes, right


def _unseen(rows: np.ndarray) -> np.ndarray:
    """Orthonormal directions (n, k) that rows (m, n) do not see."""
    rank, _, _, right = _split(_level(rows))
    return np.asarray(right[rank:].T)


def _ends(along: _Along) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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


class _Swept(NamedTuple):
    """Least curvature, its time, why it is not decided, and a direction that lowers the cost."""

    least: float
    time: float | None
    flat: str
    direction: tuple[np.ndarray, np.ndarray] | None


def _sweep(along: _Along, held: bool) -> _Swept:
    """The backward sweep over all stages.

    Args:
        held: Whether states at their bounds stay there.
    """
    n, q = along.shape
    nz, nu = along.nz, along.nu
    form, mesh = along.form, along.solution.control_interpolant.breaks
    a, b = gauss(along.places)
    h = along.width
    # variations at the Gauss points from those at the start of the interval and those of the controls
    rate = along.rate.reshape(n, q, nz, nz + nu)
    rate_z, rate_u = rate[..., :nz], rate[..., nz:]
    system = np.eye(q * nz) - np.einsum("k,ij,kjab->kiajb", h, a, rate_z).reshape(n, q * nz, q * nz)
    driven = np.zeros((n, q, nz, nz + q * nu))
    driven[..., :nz] = np.eye(nz)
    driven[..., nz:] = np.einsum("k,ij,kjau->kiaju", h, a, rate_u).reshape(n, q, nz, q * nu)
    inside = np.linalg.solve(system, driven.reshape(n, q * nz, -1)).reshape(n, q, nz, -1)
    # controls in the metric of the quadrature: the length of their variation is that of a function of time
    metric = np.sqrt(np.outer(h, along.weight))
    whole = np.zeros((n, q, nz + nu, nz + q * nu))
    whole[..., :nz, :] = inside
    for j in range(q):
        whole[:, j, nz:, nz + j * nu : nz + (j + 1) * nu] = np.eye(nu)
    whole[..., nz:] /= np.repeat(metric, nu, axis=1)[:, None, None, :]
    step = np.einsum("k,j,kjab,kjbc->kac", h, b, rate, whole)
    step[:, :, :nz] += np.eye(nz)
    stage = np.einsum("k,j,kjac,kjab,kjbd->kcd", h, b, whole, along.hessian.reshape(n, q, nz + nu, nz + nu), whole)

    cost, rows, start_cost, start_rows = _ends(along)
    sweep = _Linearised(whole, step, stage, metric, cost, rows, start_cost)
    bends = np.linalg.norm(stage[:, nz:, nz:], ord=2, axis=(1, 2)) if nu else np.zeros(n)
    scale = float(max(bends.max(initial=0.0), np.abs(cost).max(initial=0.0) * FLAT)) or 1.0
    least, at, flat = np.inf, None, ""
    gains: list[np.ndarray] = []
    for k in reversed(range(n)):
        joined = stage[k] + step[k].T @ cost @ step[k]
        own = [along.rows[k * q + j] @ whole[k, j] for j in range(q)]
        if held:
            own += [along.held_rows[k * q + j] @ whole[k, j] for j in range(q)]
        stacked = _level(np.vstack([*own, rows @ step[k]]))
        rank, left, sizes, right = _split(stacked[:, nz:])
        basis = right[rank:].T
        follow = -(right[:rank].T / sizes[:rank]) @ left[:, :rank].T @ stacked[:, :nz]
        rows = _level(left[:, rank:].T @ stacked[:, :nz])
        lift = np.vstack([np.eye(nz), follow])
        free = basis.T @ joined[nz:, nz:] @ basis
        mixed = basis.T @ joined[nz:] @ lift
        cost = lift.T @ joined @ lift
        gain = follow
        if basis.shape[1]:
            values, vectors = np.linalg.eigh((free + free.T) / 2)
            if values[0] / scale < least:
                least, at = float(values[0] / scale), float(mesh[k] * along.solution.horizon)
            if values[0] < -FLAT * scale:
                worst = basis @ vectors[:, 0]
                why = _singular(along, k, worst)
                if why:
                    return _Swept(least, at, why, None)
                return _confirmed(least, at, _variation(along, sweep, k, worst, gains), scale)
            curved = values > FLAT * scale
            if not curved.all():
                label = _label(form, basis @ vectors[:, 0], nu)
                flat = (
                    flat
                    or f"the cost does not curve along control {label!r} at {mesh[k] * along.solution.horizon:.4g} s"
                )
            inverse = (vectors[:, curved] / values[curved]) @ vectors[:, curved].T
            gain = follow - basis @ inverse @ mixed
            cost = cost - mixed.T @ inverse @ mixed
        cost = (cost + cost.T) / 2
        gains.append(gain)
    basis = _unseen(np.vstack([rows, start_rows]))
    if basis.shape[1]:
        values, vectors = np.linalg.eigh(basis.T @ (cost + start_cost) @ basis)
        if values[0] / scale < least:
            least, at = float(values[0] / scale), 0.0
        if values[0] < -FLAT * scale:
            return _confirmed(least, at, _variation(along, sweep, 0, None, gains, basis @ vectors[:, 0]), scale)
        if values[0] <= FLAT * scale:
            flat = flat or "the cost does not curve along a variation of the start"
    return _Swept(least, at, flat, None)


class _Linearised(NamedTuple):
    """The accessory problem of all stages: variations at the points, the step, the cost; metric; the ends."""

    whole: np.ndarray
    step: np.ndarray
    stage: np.ndarray
    metric: np.ndarray
    end_cost: np.ndarray
    end_rows: np.ndarray
    start_cost: np.ndarray


class _Variation(NamedTuple):
    """A variation, twice its second variation per squared length of its controls, and how far it slips off its rows."""

    controls: np.ndarray
    states: np.ndarray
    curvature: float
    slip: float


def _variation(
    along: _Along,
    sweep: _Linearised,
    first: int,
    controls: np.ndarray | None,
    gains: list[np.ndarray],
    start: np.ndarray | None = None,
) -> _Variation:
    """A variation that begins at an interval with these controls, or at the start, then follows the best feedback."""
    (n, q), nz, nu = along.shape, along.nz, along.nu
    z = np.zeros(nz) if start is None else start
    states, values = np.zeros((n + 1, nz)), np.zeros((n, q * nu))
    cost, slips = float(z @ sweep.start_cost @ z), [0.0]
    for k in range(first, n):
        states[k] = z
        values[k] = controls if controls is not None and k == first else gains[n - 1 - k] @ z
        both = np.concatenate([z, values[k]])
        cost += float(both @ sweep.stage[k] @ both)
        slips += [np.abs(along.rows[k * q + j] @ sweep.whole[k, j] @ both).max(initial=0.0) for j in range(q)]
        z = sweep.step[k] @ both
    states[n] = z
    cost += float(z @ sweep.end_cost @ z)
    slips.append(np.abs(sweep.end_rows @ z).max(initial=0.0))
    size = max(float(np.abs(states).max()), float(np.abs(values).max()))
    length = float(np.sum(values**2) + (0.0 if start is None else start @ start))
    values /= np.repeat(sweep.metric, nu, axis=1)
    shown = values.reshape(n * q, nu) * along.range, states[:, : along.nx] * along.unit[: along.nx]
    return _Variation(*shown, cost / length, max(slips) / size)


def _confirmed(least: float, at: float | None, found: _Variation, scale: float) -> _Swept:
    """A negative curvature is believed where the variation itself shows it: its cost falls and its constraints hold.

    Conditions at the ends that path constraints imply already are dependent up to the error of the plan, and what is
    left over of them then is no freedom.
    """
    if found.curvature < -FLAT * scale and found.slip < SLIP:
        return _Swept(least, at, "", (found.controls, found.states))
    return _Swept(least, at, f"constraints are nearly dependent at {at or 0.0:.4g} s", None)


def _singular(along: _Along, k: int, controls: np.ndarray) -> str:
    """Why the curvature along a stage's controls does not decide: the Hamiltonian itself does not curve along them.

    Where a control enters linearly, what is left is of the order of the interval's width, and the generalized condition
    of Legendre and Clebsch, not this one, tells a singular arc's minimum.
    """
    q, nz, nu = along.shape[1], along.nz, along.nu
    own = along.hessian[k * q : (k + 1) * q, nz:, nz:]
    parts = controls.reshape(q, nu)
    curved = float(np.einsum("ju,juv,jv->", parts, own, parts))
    size = float(np.abs(along.hessian[:, nz:, nz:]).max(initial=0.0))
    if abs(curved) > FLAT * size:
        return ""
    label, time = _label(along.form, controls, nu), along.t[k * q]
    return f"singular in control {label!r} at {time:.4g} s: the Hamiltonian does not curve along it"


def _label(form: Formulation, direction: np.ndarray, nu: int) -> str:
    """The control that a direction of a stage is made of most."""
    return form.control_labels[int(np.argmax(np.abs(direction).reshape(-1, nu).max(axis=0)))]


def _level(rows: np.ndarray) -> np.ndarray:
    """The same rows, each of length 1, without those that say nothing."""
    sizes = np.linalg.norm(rows, axis=1)
    keep = sizes > RANK * max(1.0, float(sizes.max(initial=0.0)))
    return np.asarray(rows[keep] / sizes[keep, None])


def gauss(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Runge-Kutta matrix (q, q) and weights (q,) of collocation at ``places``."""
    at, weight = np.polynomial.legendre.leggauss(len(places))
    matrix = [c / 2 * weight @ lagrange(places, c * (at + 1) / 2) for c in places]
    return np.array(matrix), quadrature_weights(places)
