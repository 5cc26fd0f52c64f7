"""The accessory problem: the second variation of the cost along a plan.

It is a linear-quadratic problem in the variations of states, horizon and controls (Bryson, Ho 1975, chapter 6). Its
constraints are the active ones, in units of the sizes along the plan. It is stated at the Gauss points of
:mod:`ocp.audit.linearisation`, with the multipliers of :mod:`ocp.audit.costates`.

Where a control enters linearly and switches between its limits, the only variation is a shift of the switching time.
Its second variation is the slope of the switching function times the square of the shifted area, divided by the step of
the control (Maurer, Osmolovskii 2003).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.costates import Adjoint
from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import slope
from ocp.audit.sizes import share_sizes
from ocp.problem.formulation import Formulation
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE, MACHINE_SHARE, RESOLVED_SHARE, SOLVER_SHARE


class AccessoryProblem:
    """Linear-quadratic (accessory) problem of the second variation of the cost along a plan.

    It is stated at the Gauss points. z = (state x, horizon T if free, start x0 if the end conditions contain it); the
    independent variable is the fraction s of the horizon.

    Attributes:
        along: The plan.
        rate: Jacobian of dz/ds in (z, u) at the M points. Shape (M, nz, nz + nu).
        hessian: Hessian of T H in (z, u). Shape (M, nz + nu, nz + nu).
        curved: Hessian of T H in u, unscaled. Shape (M, nu, nu).
        normals: Gradients of all limits at the points. Shape (M, l, nz + nu).
        strong: Which of them are equalities or have a multiplier. Shape (M, l), bool.
        weak: Which of them are active without a multiplier. Shape (M, l), bool.
        node_normals, node_strong: Gradients, and which are strong, of the state limits at the ends of the intervals.
            Shapes (N + 1, l', nz), (N + 1, l').
        moved: Whether a control switches in an interval. Shape (N, nu), bool.
        switching: Second variation of the cost for shifting that switch, per squared area, unscaled. Shape (N, nu).
        unit: Scales of (z, u) with which the sweep is well conditioned. Shape (nz + nu,).
        obstacle: Why the second variation is unknown, or "".
    """

    def __init__(self, along: Linearisation, adjoint: Adjoint) -> None:
        self.along, self.adjoint = along, adjoint
        form = along.form
        self.nx, self.nu = form.nx, form.nu
        self.free, self.with_start = form.horizon_is_free, form.ties_ends
        self.nz = self.nx * (1 + self.with_start) + self.free
        self.obstacle = str(form.cached("obstacle", lambda: obstacle(form)))
        # indices of states, free horizon T and controls in the stacked vectors (x, T, u) and (z, u)
        states = [*range(self.nx), *([self.nx] if self.free else [])]
        self._used = [*states, *range(self.nx + 1, self.nx + 1 + self.nu)]
        self._z_of = [*range(len(states)), *range(self.nz, self.nz + self.nu)]
        self._second_order()
        self._constraints()
        self._switches()

    def _units(self) -> None:
        """Choose scales of the variables that make the backward sweep well conditioned and do not affect the results.

        Horizon and states are scaled by their sizes; states that hardly move, by the sizes of other states of the same
        unit. Controls are scaled to equal curvature of the Hamiltonian, however little they move. Controls without
        curvature are scaled by their sizes, or their values if they never move.
        """
        sizes, horizon = self.along.sizes, [self.along.solution.horizon] if self.free else []
        curvature = np.abs(np.einsum("kii->ki", self.curved)).mean(axis=0)
        lowest, highest = self.along.u.min(axis=0, initial=np.inf), self.along.u.max(axis=0, initial=-np.inf)
        value = np.maximum(np.abs(lowest), np.abs(highest))
        size = np.where(highest - lowest <= SOLVER_SHARE * value, np.maximum(value, sizes.control), sizes.control)
        weight = curvature * size**2
        largest = float(weight.max(initial=0.0))
        negligible = size <= RESOLVED_SHARE * size.max(initial=0.0)  # controls whose size is not meaningful
        is_curved = curvature > MACHINE_SHARE * curvature.max(initial=0.0)
        curves = (weight > MACHINE_SHARE * largest) | (negligible & is_curved)
        self.range = np.where(curves, np.sqrt(largest / np.where(curves, curvature, 1.0)), sizes.control)
        state = self.along.state_size.copy()
        share_sizes(state, self.along.form.states, self.along.form.problem.declared.states, LIMIT_SHARE)
        self.unit = np.concatenate([state, horizon, *([state] if self.with_start else []), self.range])

    def _second_order(self) -> None:
        """Compute first and second derivatives of dynamics and Hamiltonian with respect to scaled variations."""
        along, form, m = self.along, self.along.form, len(self.along.s)
        lam, mu = form.sym("lam", form.nx), form.sym("mu", len(form.path))
        multipliers = np.zeros((m, len(form.path)))
        multipliers[:, along.mixed] = self.adjoint.control_multipliers[:, self.nu : self.nu + along.mixed.size]
        multipliers[:, along.still] = self.adjoint.state_multipliers[:, self.nx :]

        def outputs() -> list[Any]:
            cost, rate, path = along.scaled
            total = cost + ca.dot(lam, rate) + ca.dot(mu, path)
            return [ca.hessian(total, along.y)[0], ca.diag(ca.hessian(cost, form.x)[0])]

        values = (lam, self.adjoint.costate), (mu, multipliers)
        hessian, self._cost_curves = form.sampled(outputs, *along.point, *values, cache_as="second derivatives")
        ny = self.nx + 1 + self.nu
        hessian = hessian.reshape(m, ny, ny)
        self.curved = hessian[:, self.nx + 1 :, self.nx + 1 :]
        self._curves = np.einsum("kii->ki", hessian)
        self._units()
        used, z_of = self._used, self._z_of
        size, z_unit = self.nz + self.nu, self.unit[: self.nz]
        self.rate, self.hessian = np.zeros((m, self.nz, size)), np.zeros((m, size, size))
        self.rate[np.ix_(range(m), range(self.nx), z_of)] = along.rate_y[:, :, used]
        self.hessian[np.ix_(range(m), z_of, z_of)] = hessian[np.ix_(range(m), used, used)]
        self.rate *= self.unit / z_unit[:, None]
        self.hessian *= self.unit * self.unit[:, None]

    @cached_property
    def linear_controls(self) -> np.ndarray:
        """Mask of the controls in which the Hamiltonian is linear. Shape (nu,)."""
        curvature = np.abs(self.curved * self.range * self.range[:, None]).max(axis=(0, 2), initial=0.0)
        gradient = np.abs(slope(self.along, self.adjoint.costate) * self.range).max(initial=0.0)
        return np.asarray(curvature <= FLAT_SHARE * max(float(curvature.max(initial=0.0)), float(gradient)))

    @cached_property
    def residual_slope(self) -> np.ndarray:
        """Gradient of horizon times augmented Hamiltonian in scaled controls; 0 for linear controls. Shape (M, nu)."""
        along = self.along
        multipliers = self.adjoint.control_multipliers
        gradient = slope(along, self.adjoint.costate) + np.einsum("kmu,km->ku", along.control_limits_u, multipliers)
        return np.asarray(np.where(self.linear_controls, 0.0, gradient * self.range))

    @property
    def start_slope(self) -> np.ndarray:
        """Gradient of the cost with respect to the scaled start state and horizon. Shape (nz,)."""
        gradient, nx = self.adjoint.ends.slope, self.nx
        slope = np.concatenate([gradient[:nx], gradient[nx:] if self.free else [], np.zeros(nx * self.with_start)])
        return np.asarray(slope * self.unit[: self.nz])

    @property
    def hamiltonian_scale(self) -> float:
        """Integrated second-order change of the Hamiltonian if states and controls change by characteristic sizes."""
        unit = np.concatenate([self.along.sizes.state, [0.0], self.along.sizes.control])
        return float(self.along.share @ (np.abs(self._curves) @ unit**2)) / 2

    @property
    def negligible_cost(self) -> float:
        """Largest cost that counts as zero, because a plan does not resolve cost changes of this size reliably.

        It is a share of the change of the cost, to second order, if states and controls change by their characteristic
        sizes. Changes of states change the running and the terminal cost; changes of controls, the Hamiltonian.
        """
        sizes, curvature = self.along.sizes, np.abs(self._curves[:, self.nx + 1 :])
        total = self.along.share @ (np.abs(self._cost_curves) @ sizes.state**2 + curvature @ sizes.control**2)
        total += np.abs(np.diag(self.along.final_yy)[:-1]) @ np.tile(sizes.state, 2) ** 2
        return max(LIMIT_SHARE * float(total) / 2, LIMIT_SHARE**2 * self.along.slope_size)

    @property
    def control_scale(self) -> float:
        """Second-order change of the cost for variations of the controls that equal the controls themselves."""
        return float(self.along.share @ np.sum(np.abs(self._curves[:, self.nx + 1 :]) * self.along.u**2, axis=1)) / 2

    def _constraints(self) -> None:
        """Find the strongly active limits, which have multipliers, and the weakly active limits, which have none."""
        along, m = self.along, len(self.along.s)
        used, z_of = self._used, self._z_of
        size = self.nz + self.nu
        nu, nh = self.nu, self.nu + along.mixed.size
        normals = np.zeros((m, nh + len(along.state_limits.equal), size))
        normals[:, :nu, self.nz :] = np.eye(nu)
        normals[np.ix_(range(m), range(nu, nh), z_of)] = along.row_y[:, along.mixed][:, :, used]
        normals[:, nh : nh + self.nx, : self.nx] = np.eye(self.nx)
        normals[np.ix_(range(m), range(nh + self.nx, normals.shape[1]), z_of)] = along.row_y[:, along.still][:, :, used]
        normals *= self.unit
        reach = np.abs(normals).max(axis=2)

        # a control that always rests on its limit is judged by its own value if no control of its unit has a size
        largest = np.abs(along.u).max(axis=0, initial=0.0)
        control_sizes = np.append(np.maximum(along.control_size, largest), along.sizes.path[along.mixed])
        state_sizes = np.append(along.sizes.state, along.sizes.path[along.still])

        def classify(limits: Limits, multipliers: np.ndarray, first: int, size: np.ndarray) -> list[np.ndarray]:
            count = multipliers.shape[1]
            multiplier_effect = np.abs(multipliers) * reach[:, first : first + count]
            near = (limits.gap[:, :count] <= RESOLVED_SHARE * size) | limits.equal[:count]
            return [multiplier_effect > FLAT_SHARE * (multiplier_effect.max(initial=0.0) or 1.0), near]

        strong, near = classify(along.control_limits, self.adjoint.control_multipliers[:, :nh], 0, control_sizes)
        # a solver leaves a gap to a limit with a small multiplier, across which the Hamiltonian has one slope
        gap = np.where(strong, along.control_limits.gap[:, :nh], 0.0)[:, :nu]
        change = np.abs(np.einsum("kii->ki", self.curved)) * gap
        near[:, :nu] |= strong[:, :nu] & (np.abs(self.adjoint.control_multipliers[:, :nu]) > change)
        self.fixed = strong[:, :nu] & near[:, :nu]
        pushed, state_active = classify(along.state_limits, self.adjoint.state_multipliers, nh, state_sizes)
        strong = np.hstack([strong & near | along.control_limits.equal[:nh], pushed | along.state_limits.equal])
        near = np.hstack([near, state_active])
        n, q = along.shape
        self.normals, self.strong, self.weak = normals, strong, near & ~strong
        # on an arc the constraints at the points alone would let the ends of the intervals oscillate
        at_limit = (pushed | along.state_limits.equal).reshape(n, q, -1)
        on_arc = np.concatenate([at_limit[:1, 0], at_limit[:-1, -1] & at_limit[1:, 0], at_limit[-1:, -1]])
        node = np.zeros((n + 1, len(along.state_limits.equal), self.nz))
        node[:, :, : self.nx] = along.node_limits_x[:, :, :-1]
        if self.free:
            node[:, :, self.nx] = along.node_limits_x[:, :, -1]
        self.node_normals, self.node_strong = node * self.unit[: self.nz], on_arc & along.node_limits.near

    def _switches(self) -> None:
        """Find controls that switch between limits in an interval, and curvatures of the cost in the switch times."""
        along, nu = self.along, self.nu
        n, q = along.shape
        self.moved, self.switching = np.zeros((n, nu), bool), np.zeros((n, nu))
        gradient = slope(along, self.adjoint.costate).reshape(n, q, nu)
        fixed, u = self.fixed.reshape(n, q, nu), along.u.reshape(n, q, nu)
        at = along.s.reshape(n, q)
        for i in np.flatnonzero(self.linear_controls):
            step = along.high[0, i] - along.low[0, i]
            held = fixed[:, :, i].all(axis=1)
            for k in np.flatnonzero(~held):
                previous, following = max(int(k) - 1, 0), min(int(k) + 1, n - 1)
                rise = u[following, -1, i] - u[previous, 0, i]
                if not (np.isfinite(step) and abs(rise) > 0.5 * step):
                    continue
                window = slice(previous, following + 1)
                rate = np.polynomial.polynomial.polyfit(at[window].ravel(), gradient[window, :, i].ravel(), 1)[1]
                if rate * rise < 0:
                    self.moved[k, i], self.switching[k, i] = True, abs(rate) / abs(rise)


def obstacle(form: Formulation) -> str:
    """Return why the second variation along plans of a problem cannot be computed; "" if there is no such reason."""
    last = ca.vertcat(form.end.expression, form.terminal)
    if ca.depends_on(last, form.u0):
        return "the control at the start enters the conditions at the end"
    if ca.depends_on(ca.vertcat(last, form.start.expression), form.u):
        return "a control enters the conditions at an end"
    return ""


def curved_ends(form: Formulation) -> Any:
    """Return the CasADi Function of the Hessians of end and start constraints, weighted by the multipliers.

    Its arguments are (x, x0, T, p, multipliers of the end rows, multipliers of the start rows); the Hessians are with
    respect to (x, T, x0).
    """
    nu_end, nu_start = (form.sym(name, len(r)) for name, r in (("nu", form.end), ("nu0", form.start)))
    last = ca.substitute([form.end.expression], [form.t], [form.T])[0]
    begin = ca.substitute([form.start.expression], [form.x, form.t], [form.x0, 0])[0]
    variables = ca.vertcat(form.x, form.T, form.x0)
    outputs = [ca.hessian(ca.dot(nu, rows), variables)[0] for nu, rows in ((nu_end, last), (nu_start, begin))]
    symbols = [form.x, form.x0, form.T, form.p, nu_end, nu_start]
    return ca.Function("ends", symbols, [ca.densify(output) for output in outputs])


def end_conditions(accessory: AccessoryProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the Hessian of the Lagrangian and the gradients of active constraints at a plan's end, then at its start.

    The Lagrangian is the terminal cost plus multipliers times constraints. Derivatives are with respect to the scaled
    variations z. Inequalities with multipliers are active, and so are state bounds on which the plan rests.
    """
    along, ends = accessory.along, accessory.adjoint.ends
    form, solution, (low, high) = along.form, along.solution, along.bounds
    places, nx = form.bounds.places, accessory.nx
    x0, x1 = (solution.state_interpolant(np.array([end]))[0] for end in (0.0, 1.0))
    second = form.cached("curvature of the ends", lambda: curved_ends(form))
    hessians = second(x1, x0, solution.horizon, along.p, ends.end, ends.start)
    end_curved, start_curved = (np.asarray(v.full()) for v in hessians)
    order = [*range(nx), 2 * nx, *range(nx, 2 * nx)]  # of (x, T, x0) in (x, x0, T)
    end_curved = end_curved + along.final_yy[np.ix_(order, order)]
    psi_y, psi0_y = np.split(along.end_y[:, order], [len(form.end)])
    largest = max(np.abs(ends.end).max(initial=0.0), np.abs(ends.start).max(initial=0.0)) or 1.0
    at_end = (np.abs(ends.end) > FLAT_SHARE * largest) | form.end.equality
    at_start = (np.abs(ends.start) > FLAT_SHARE * largest) | form.start.equality
    held = {k: low[places[k]] == high[places[k]] for k in ("terminal", "initial")}
    slack = RESOLVED_SHARE * along.sizes.state
    for k, x in (("terminal", x1), ("initial", x0)):
        held[k] = held[k] | (x <= low[places[k]] + slack) | (x >= high[places[k]] - slack)

    # select the entries of (x, T, x0) in z; at the start, x0 of the conditions is x
    z = [*range(nx), *([nx] if accessory.free else []), *(range(nx + 1, 2 * nx + 1) if accessory.with_start else [])]
    z_unit = accessory.unit[: accessory.nz]
    eye = np.eye(accessory.nz)
    end_hessian, end_rows = end_curved[np.ix_(z, z)], np.vstack([psi_y[at_end][:, z], eye[:nx][held["terminal"]]])
    begin_of = [*range(nx + 1, 2 * nx + 1), *([nx] if accessory.free else [])]
    start_hessian, start_rows = np.zeros((accessory.nz, accessory.nz)), np.zeros((int(at_start.sum()), accessory.nz))
    start_hessian[: len(begin_of), : len(begin_of)] = start_curved[np.ix_(begin_of, begin_of)]
    start_rows[:, : len(begin_of)] = psi0_y[at_start][:, begin_of]
    extra = [eye[:nx][held["initial"]]]
    if accessory.with_start:
        extra.append(eye[:nx] - eye[accessory.nz - nx :])
    if accessory.free:
        least, most = (float(side[places["horizon"][0]]) for side in (low, high))
        if not least * (1 + RESOLVED_SHARE) < solution.horizon < most * (1 - RESOLVED_SHARE):
            extra.append(eye[nx : nx + 1])
    scale = z_unit * z_unit[:, None]
    return end_hessian * scale, end_rows * z_unit, start_hessian * scale, np.vstack([start_rows * z_unit, *extra])
