"""First derivatives of a problem along a plan, at Gauss points of its intervals, whatever method made the plan.

The search for multipliers (:mod:`ocp.audit.principle`, :mod:`ocp.audit.costates`) and the second variation
(:mod:`ocp.audit.accessory`) use these. The independent variable is the fraction s of the horizon, so that dx/ds = T f
and a variation of the horizon T is a variation of the integrands.
"""

from __future__ import annotations

from copy import copy
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.sizes import fine_grid, nearest_bound, share_sizes, sizes
from ocp.problem.formulation import Formulation
from ocp.problem.values import Sampler
from ocp.solution import Solution
from ocp.solution_data import stack
from ocp.tolerances import NEAR_LIMIT_SHARE, RESOLVED_SHARE, SOLVER_SHARE, TIGHTENED_SHARE

MIN_POINTS, MAX_POINTS, ENOUGH_POINTS = 3, 5, 150
"""Smallest and largest number of Gauss points in an interval, and a sufficient number in the whole plan."""
MAX_DERIVATIVES = 3
"""Largest number of times that a state constraint is differentiated until a control appears in it."""


class Limits:
    """Lower and upper limits of quantities along a plan: the distances to them, and which of them may be active.

    A limit that was slightly tightened when the plan was solved may be active where the plan rests on it. The price of
    its multiplier is the distance to the declared limit. Multiplier times distance is the excess cost of the plan to
    first order, and an upper bound of it for a convex problem (weak duality).

    Attributes:
        below, above: Distance to the declared lower and upper limit, at least 0. Shape (M, m).
        gap: Distance to the nearer limit as it was when the plan was solved. Shape (M, m).
        lower, upper: Whether the limit may be active; both at equalities. Shape (M, m), bool.
        equal: Which limits are equalities. Shape (m,).
    """

    def __init__(
        self,
        value: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        equal: np.ndarray,
        *,
        size: np.ndarray,
        tightened: Any = (0.0, 0.0),
    ) -> None:
        self.equal = equal
        self.below, self.above = (np.where(equal, 0.0, np.maximum(gap, 0.0)) for gap in (value - low, high - value))
        sides = zip((self.below, self.above), tightened, strict=True)
        gaps = [np.maximum(gap - np.where(by <= TIGHTENED_SHARE * size, by, 0.0), 0.0) for gap, by in sides]
        self.gap = np.minimum(*gaps)
        self.lower, self.upper = (equal | (gap <= NEAR_LIMIT_SHARE * size) for gap in gaps)

    def at(self, points: Any) -> Limits:
        """Return the limits at the points of the plan that a slice or an array of indices selects."""
        part = copy(self)
        for name in ("below", "above", "gap", "lower", "upper"):
            setattr(part, name, getattr(self, name)[points])
        return part

    def extend(self, count: int) -> None:
        """Append `count` equality constraints, which the plan satisfies exactly, to these limits."""
        self.equal = np.pad(self.equal, (0, count), constant_values=True)
        for name, value in (("below", 0.0), ("above", 0.0), ("gap", 0.0), ("lower", True), ("upper", True)):
            setattr(self, name, np.pad(getattr(self, name), ((0, 0), (0, count)), constant_values=value))

    @property
    def near(self) -> np.ndarray:
        """Whether the plan is so near the lower or upper limit that the limit may be active. Shape (M, m), bool."""
        return np.asarray(self.lower | self.upper)

    @property
    def sides(self) -> tuple[tuple[np.ndarray, np.ndarray, float], ...]:
        """Mask of potentially active limits, distances, multiplier sign: for upper (or equal), then lower limits."""
        return (self.upper, self.above, 1.0), (self.lower & ~self.equal, self.below, -1.0)

    def charge(self, multipliers: np.ndarray) -> np.ndarray:
        """Return the complementarity products, absolute multipliers times distances to the limits. Shape (M, m)."""
        gap = np.where(multipliers > 0, self.above, self.below)
        return np.asarray(np.where(multipliers != 0, gap, 0.0) * np.abs(multipliers))


class Linearisation:
    """First derivatives of cost, dynamics and constraints along a plan, at Gauss points of the mesh intervals.

    Attributes:
        p, bounds: Parameters, shape (np,), and the bounds of the problem at these.
        grid, sizes: Samples of the plan on its fine grid, and the sizes of all quantities along it.
        width: Widths of the N mesh intervals, as fractions of the horizon. Shape (N,).
        weight, places: Quadrature weights and positions of the Gauss points in an interval. Shape (q,).
        matrix: Runge-Kutta matrix of these points. Shape (q, q).
        shape: (N, q).
        interval_ends: Indices of the mesh nodes at both ends of each interval. Shape (N, 2).
        s, t: Fractions of the horizon and times (s) of the M = N q points. Shape (M,).
        nodal: Whether the plan is reported only at the ends of the intervals.
        x, u, costate: States, controls and costates of the plan at the points, as it reports them. Shape (M, n).
        cost_y, rate_y: Derivatives of T L and T f in y = (x, T, u). Shapes (M, ny), (M, nx, ny).
        row, row_y: Rows of the path constraints and their derivatives. Shapes (M, r), (M, r, ny).
        state_size: Sizes of the states by which costates are judged. Shape (nx,).
        control_size: Sizes of the controls by which distances to their limits are judged. Shape (nu,).
        end_row, end_y: Rows of end, then start constraints, and their derivatives with respect to end state x, start
            state x0 and horizon T. Shapes (m,), (m, 2 nx + 1).
        final_y, final_yy: First and second derivatives of the terminal cost with respect to these.
            Shapes (2 nx + 1,), (2 nx + 1, 2 nx + 1).
        control_limits: Limits of the controls, of path rows with a control (``mixed``) and of arcs along state
            equalities, in this order. Shape (M, nu + r + a).
        control_limits_u: Their derivatives in the controls. Shape (M, nu + r + a, nu).
        state_limits: Limits of the states and of path rows without a control (``still``), in this order.
            Shape (M, nx + r').
        state_limits_x: Their derivatives in (x, T). Shape (M, nx + r', nx + 1).
        node_limits, node_limits_x: The same at the N + 1 ends of the intervals.
        low, high: Bounds of the controls at the points. Shape (M, nu).
        pseudo_inverses: Cache of :func:`ocp.audit.principle.pseudo_inverse_of`.
    """

    def __init__(self, form: Formulation, solution: Solution) -> None:
        self.form, self.solution = form, solution
        self.p = form.parameter_vector(solution.parameters)
        self.bounds, self.grid = form.bound_values(self.p), fine_grid(solution, self.p)
        self.sizes = sizes(form, self.grid, self.bounds)
        mesh = solution.control_interpolant.breaks
        self.mesh, self.width = mesh, np.diff(mesh)
        n = len(self.width)
        segments = (len(solution.state_interpolant.breaks) - 1) / n
        degree = max(len(solution.control_interpolant.nodes), solution.state_interpolant.values.shape[1] - 1)
        q = MAX_POINTS if segments > 1 else int(np.clip(max(degree, ENOUGH_POINTS / n), MIN_POINTS, MAX_POINTS))
        self.shape, self.interval_ends = (n, q), np.add.outer(np.arange(n), [0, 1])
        self.places = np.array(ca.collocation_points(q, "legendre"))
        self.matrix, self.weight = np.split(quadrature(self.places, np.append(self.places, 1.0)), [q])
        self.weight = self.weight[0]
        self.s = (mesh[:-1, None] + self.width[:, None] * self.places).ravel()
        self.t = self.s * solution.horizon
        self.nodal = len(solution.t) == n + 1
        self.x = solution.state_interpolant(self.s)
        self.u = solution.control_interpolant.within(np.repeat(np.arange(n), q), np.tile(self.places, n))
        self.costate = solution.costate_interpolant(self.s)
        self.pseudo_inverses: dict[bytes, np.ndarray] = {}
        self._differentiate()
        self._at_ends()
        self.state_size = self._state_sizes()
        self.control_size = self._control_sizes()
        self._limits()
        self._arcs()

    def _differentiate(self) -> None:
        """Compute the first derivatives of running cost, dynamics and path constraints at the Gauss points."""
        form, m = self.form, len(self.s)
        self.y = ca.vertcat(form.x, form.T, form.u)
        self.fraction, *self.scaled = form.cached("over the fraction of the horizon", lambda: over_fraction(form))

        def outputs() -> list[Any]:
            return [self.scaled[2], *(ca.jacobian(part, self.y) for part in self.scaled)]

        self.row, self.cost_y, rate_y, row_y = form.sampled(outputs, *self.point, cache_as="first derivatives")
        ny = form.nx + 1 + form.nu
        self.rate_y = rate_y.reshape(m, ny, form.nx).transpose(0, 2, 1)
        self.row_y = row_y.reshape(m, ny, len(form.path)).transpose(0, 2, 1)

    @property
    def point(self) -> tuple[Any, ...]:
        """States, controls, times and further data at the Gauss points, as arguments of :meth:`Formulation.sampled`."""
        fraction = (self.fraction, self.s[:, None])
        return self.x, self.u, self.t, self.solution.horizon, self.p, fraction

    @property
    def finite(self) -> bool:
        """Whether the plan and the derivatives along it are finite."""
        parts = self.x, self.u, self.costate, self.cost_y, self.rate_y, self.row, self.row_y, self.node_limits_x
        return all(bool(np.isfinite(part).all()) for part in parts)

    @property
    def may_be_degenerate(self) -> bool:
        """Whether some inequalities may be active, so that the multipliers of the plan need not be unique."""
        sides = (self.control_limits, self.state_limits, self.node_limits)
        return any(bool(limits.near[:, ~limits.equal].any()) for limits in sides)

    @property
    def slope_size(self) -> float:
        """First-order change of the running cost if states and controls change by their characteristic sizes."""
        unit = np.concatenate([self.state_size, [0.0], self.sizes.control])
        return float(self.share @ (np.abs(self.cost_y) @ unit))

    @property
    def share(self) -> np.ndarray:
        """Quadrature weight of every Gauss point in an integral over the fraction of the horizon. Shape (M,)."""
        return np.asarray((self.width[:, None] * self.weight).ravel())

    def _at_ends(self) -> None:
        """Compute the start and end constraints, and the derivatives of the constraints and of the terminal cost."""
        form, solution = self.form, self.solution
        x0, x1 = (solution.state_interpolant(np.array([end]))[0] for end in (0.0, 1.0))
        u0, u1 = stack(solution.controls, 2)[[0, -1]]
        function = form.cached("ends", lambda: ends_of(form))
        ends = [np.asarray(v.full()) for v in function(x1, x0, u1, u0, solution.horizon, self.p)]
        self.end_row, self.end_y, self.final_y, self.final_yy = ends[0][:, 0], ends[1], ends[2][:, 0], ends[3]

    def _state_sizes(self) -> np.ndarray:
        """Return the characteristic sizes of the states, including states that stay constant. Shape (nx,).

        A state that is constant along the plan has no spread. If its value is free, such as a tool length that is
        stored as a state, its size is the smallest change that changes another quantity by its size, or the cost by
        itself to second order.
        """
        form, sizes, nx = self.form, self.sizes, self.form.nx
        low, high = self.bounds
        first, last = form.bounds.places["initial"], form.bounds.places["terminal"]
        is_free = (low[first] < high[first]) & (low[last] < high[last])
        constant = np.flatnonzero(is_free & (np.ptp(self.x, axis=0) < sizes.state / 2))
        if not constant.size:
            return sizes.state
        rows = np.concatenate([sizes.end, sizes.start])[:, None]
        rates = [np.abs(self.rate_y[:, :, constant]).max(axis=0) / sizes.state[:, None]]
        rates.append(np.abs(self.row_y[:, :, constant]).max(axis=0, initial=0.0) / sizes.path[:, None])
        rates += [np.abs(self.end_y[:, k]) / rows for k in (constant, nx + constant)]
        lam = form.sym("lam", nx)
        hessian = ca.hessian(self.scaled[0] + ca.dot(lam, self.scaled[1]), form.x)[0]
        diagonal = ca.densify(ca.diag(hessian)[constant.tolist()])
        curvature = self.share @ form.sampled([diagonal], *self.point, (lam, self.costate))[0]
        curvature = curvature + sum(np.diag(self.final_yy)[k] for k in (constant, nx + constant))
        rates.append(np.sqrt(np.abs(curvature[None]) / 2 / (max(abs(self.solution.cost), sizes.cost) or 1.0)))
        largest_rate = np.vstack(rates).max(axis=0)
        result = sizes.state.copy()
        with np.errstate(divide="ignore"):  # a state without an effect keeps its floor
            result[constant] = np.minimum(1.0 / largest_rate, result[constant] / SOLVER_SHARE)
        return result

    def _control_sizes(self) -> np.ndarray:
        """Return the characteristic sizes of the controls, by which distances to limits are judged. Shape (nu,).

        An unused control rests on a limit but for the solver's tolerance, so that its spread is not a size. It takes
        the size of other controls of its unit; if all of these are unused, the nearest bound, at most one SI unit.
        """
        form, own = self.form, self.sizes.control
        low, high = (side[form.bounds.places["control"]] for side in self.bounds)
        by_unit = own.copy()
        share_sizes(by_unit, form.controls, form.problem.declared.controls, RESOLVED_SHARE)
        bound = np.minimum(1.0, nearest_bound((low, high)))
        full = np.where(by_unit <= RESOLVED_SHARE * bound, bound, by_unit)
        distance = np.minimum(np.abs(self.u - low), np.abs(self.u - high)).max(axis=0, initial=0.0)
        return np.asarray(np.where(distance <= RESOLVED_SHARE * full, full, own))

    def _limits(self) -> None:
        """Set up the limits of controls and states at the Gauss points, and of states at the ends of the intervals."""
        form, sizes, (n, q) = self.form, self.sizes, self.shape
        nx, nu = form.nx, form.nu
        self.mixed = np.flatnonzero(form.path.uses_control)
        self.still = np.flatnonzero(~form.path.uses_control)
        kinds = ("state", "control", "path")
        index = np.concatenate([form.bounds.places[kind] for kind in kinds])
        low, high = (side[index] for side in self.bounds)
        tightening = np.zeros((2, n, len(index)))
        amounts = self.solution.bound_tightening
        if amounts is not None:  # a plan assembled by hand may lack the path rows
            tightening[:, :, : amounts.shape[2]] = amounts[:, :, : len(index)]
        equal = np.concatenate([np.zeros(nx + nu, bool), form.path.equality])
        equal |= low == high
        size = np.concatenate([sizes.state, self.control_size, sizes.path])
        controls = np.concatenate([np.arange(nx, nx + nu), nx + nu + self.mixed])
        states = np.concatenate([np.arange(nx), nx + nu + self.still])
        value = np.hstack([self.x, self.u, self.row])
        by_point = np.repeat(tightening, q, axis=1)
        self.control_limits, self.state_limits = (
            Limits(value[:, k], low[k], high[k], equal[k], size=size[k], tightened=by_point[:, :, k])
            for k in (controls, states)
        )
        self.low, self.high = (np.tile(side[nx : nx + nu], (n * q, 1)) for side in (low, high))
        eye = np.broadcast_to(np.eye(nu), (n * q, nu, nu))
        self.control_limits_u = np.concatenate([eye, self.row_y[:, self.mixed, nx + 1 :]], axis=1)
        own = np.eye(nx, nx + 1)
        self.state_limits_x = np.hstack([np.tile(own, (n * q, 1, 1)), self.row_y[:, self.still, : nx + 1]])

        at = self.mesh

        def still() -> list[Any]:
            rows = self.scaled[2][self.still.tolist()] if self.still.size else self.scaled[2][:0, :]
            return [rows, ca.jacobian(rows, ca.vertcat(form.x, form.T))]

        x, u, horizon = self.solution.state_interpolant(at), np.zeros((n + 1, nu)), self.solution.horizon
        point = x, u, at * horizon, horizon, self.p, (self.fraction, at[:, None])
        row, row_y = form.sampled(still, *point, cache_as="rows of the states")
        before, after = np.maximum(np.arange(n + 1) - 1, 0), np.minimum(np.arange(n + 1), n - 1)
        at_nodes = np.maximum(tightening[:, before], tightening[:, after])[:, :, states]
        self.node_limits = Limits(
            np.hstack([x, row]), low[states], high[states], equal[states], size=size[states], tightened=at_nodes
        )
        rows_x = row_y.reshape(n + 1, nx + 1, len(self.still)).transpose(0, 2, 1)
        self.node_limits_x = np.hstack([np.tile(own, (n + 1, 1, 1)), rows_x])

    def _arcs(self) -> None:
        """Differentiate state equalities in time until controls appear; add these equations to the control limits.

        A transcription that imposes such a row at points determines the costates up to multiples of the gradients of
        the row and of its derivatives (Hartl, Sethi, Vickson 1995, section 4). The slope of the Hamiltonian is then
        determined up to multiples of the gradient of the last derivative.
        """
        form, equal = self.form, np.flatnonzero(self.form.path.equality[self.still])
        arcs = np.zeros((len(self.s), len(equal), form.nu))
        for which, orders, slopes in form.cached("arcs", lambda: arcs_of(form, self.still[equal])):
            rates = [form.signals_at(self.t, order) for order in range(orders + 1)]
            values = slopes(*self.point[:2], self.t[:, None], *self.point[3:5], *rates)[0]
            arcs[:, which] = values.reshape(len(self.s), form.nu, len(which)).transpose(0, 2, 1)
        self.control_limits_u = np.concatenate([self.control_limits_u, arcs], axis=1)
        self.control_limits.extend(len(equal))


def arcs_of(form: Formulation, rows: np.ndarray) -> list[tuple[np.ndarray, int, Sampler]]:
    """Group path constraints by their order, which is the number of time derivatives until a control appears.

    Returns:
        For each order the indices of its rows, a sampler of the derivatives of these with respect to the controls, and
        before it the highest order of the time derivatives of signals that the sampler takes as arguments.
    """
    at, remaining = form.path.expression[rows.tolist()], np.arange(len(rows))
    arcs = list[tuple[np.ndarray, int, Sampler]]()
    rates = [form.sym("w_rate", form.w.numel()) for _ in range(MAX_DERIVATIVES)] if form.signals else []
    for _ in range(MAX_DERIVATIVES):
        if not remaining.size or not form.nu:
            break
        by_signals = [ca.mtimes(ca.jacobian(at, w), rate) for w, rate in pairwise([form.w, *rates])]
        at = ca.mtimes(ca.jacobian(at, form.x), form.f) + ca.jacobian(at, form.t) + sum(by_signals)
        in_control = ca.jacobian(at, form.u)
        seen = np.array(ca.DM(in_control.sparsity(), 1).full().any(axis=1), bool)
        if seen.any():
            slopes = in_control[np.flatnonzero(seen).tolist(), :]
            orders = max((k + 1 for k, rate in enumerate(rates) if ca.depends_on(slopes, rate)), default=0)
            arcs.append((remaining[seen], orders, form.sampler([slopes], *rates[:orders])))
            at, remaining = at[np.flatnonzero(~seen).tolist()], remaining[~seen]
    return arcs


def over_fraction(form: Formulation) -> list[Any]:
    """Return a symbol s for the fraction of the horizon, and cost, dynamics and path constraints in terms of s.

    The expressions are T L and T f, with horizon T, running cost L and dynamics f, and the rows of the path.
    """
    fraction = form.sym("s")
    parts = [form.T * form.running, form.T * form.f, form.path.expression]
    return [fraction, *ca.substitute(parts, [form.t], [fraction * form.T])]


def ends_of(form: Formulation) -> Any:
    """Return the CasADi Function of end and start constraints, their derivatives, and derivatives of the terminal cost.

    Its arguments are (x, x0, u, u0, T, p). Its outputs are the rows, their derivatives, and the gradient and Hessian
    of the terminal cost.
    """
    begin = ca.substitute([form.start.expression], [form.x, form.u, form.t], [form.x0, form.u0, 0])[0]
    end, final = ca.substitute([form.end.expression, form.terminal], [form.t], [form.T])
    rows, y = ca.vertcat(end, begin), ca.vertcat(form.x, form.x0, form.T)
    curved, slope = ca.hessian(final, y)
    outputs = [rows, ca.jacobian(rows, y), slope, curved]
    symbols = [form.x, form.x0, form.u, form.u0, form.T, form.p]
    return ca.Function("ends", symbols, [ca.densify(output) for output in outputs])


def quadrature(places: np.ndarray, ends: np.ndarray, degree: int | None = None) -> np.ndarray:
    """Return quadrature weights at q positions, ``places``, for integrals from 0 to each of m ``ends``. Shape (m, q).

    The integrand is the least-squares polynomial of the given degree; by default the interpolating one.
    """
    degree = len(places) - 1 if degree is None else degree
    legendre = np.polynomial.legendre.legvander
    values = legendre(2 * ends - 1, degree + 1)
    rising = (values[:, 2:] - values[:, :-2]) / (2 * np.arange(1, degree + 1) + 1)  # integrals of P_k
    return np.asarray(np.column_stack([2 * ends, rising]) @ np.linalg.pinv(legendre(2 * places - 1, degree)) / 2)
