"""The accessory problem: the second variation of the cost along a plan.

A linear-quadratic problem in the variations of states, horizon and controls (Bryson, Ho 1975, chapter 6), whose
constraints are those that are active, in units of how far each quantity moves along the plan. It stands on the Gauss
points of :mod:`ocp.audit.linearisation`, with the multipliers that :mod:`ocp.audit.costates` found.

Where a control enters linearly and switches from one of its limits to the other, moving the switch is the only
variation there is; it costs the slope of the switching function times the square of the area that it moves, over the
step of the control (Maurer, Osmolovskii 2003).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.costates import Adjoint
from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import slope
from ocp.audit.sizes import as_others
from ocp.problem.formulation import Formulation
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE, MACHINE_SHARE, RESOLVED_SHARE, SOLVER_SHARE

__all__ = ["AccessoryProblem", "end_conditions"]


class AccessoryProblem:
    """A plan at the Gauss points of its intervals: dynamics, Hamiltonian, active constraints, in scaled variations.

    z = (x, T where free, x0 where the end refers to it); all derivatives are those of dz/ds over the fraction s.

    Attributes:
        along: The plan.
        rate: Jacobian of dz/ds in (z, u) at the M points. Shape (M, nz, nz + nu).
        hessian: Of T H in (z, u). Shape (M, nz + nu, nz + nu).
        curved: Of T H in u alone, in their own units. Shape (M, nu, nu).
        normals: Of everything that limits the variations at the points. Shape (M, l, nz + nu). strong: Which of them
            hold: equalities, and those that push. weak: Which are active and do not push. Both (M, l), bool.
        node_normals, node_strong: Those of the states at the ends of the intervals, (N + 1, l', nz), (N + 1, l').
        moved: Controls that switch in an interval, (N, nu) bool. switching: What moving costs there, per squared
            area, in their own units. Shape (N, nu).
        unit: Of (z, u), in which the sweep is well conditioned. Shape (nz + nu,).
        obstacle: Why the second variation is not known, or "".
    """

    def __init__(self, along: Linearisation, adjoint: Adjoint) -> None:
        self.along, self.adjoint = along, adjoint
        form = along.form
        self.nx, self.nu = form.nx, form.nu
        self.free, self.tied = form.horizon_is_free, form.ties_ends
        self.nz = self.nx * (1 + self.tied) + self.free
        self.obstacle = self._obstacle()
        self._second_order()
        self._hold()
        self._switch()

    def _obstacle(self) -> str:
        return str(self.along.form.cached("obstacle", lambda: obstacle(self.along.form)))

    def _units(self) -> None:
        """Units in which a sweep is well conditioned: they judge nothing.

        Horizon and states by their sizes, those that hardly move by that of the others of their unit. Controls so that
        the Hamiltonian curves alike along each, however little it moves; by their sizes where it does not curve, which
        for one that never moves is its value.
        """
        sizes, horizon = self.along.sizes, [self.along.solution.horizon] if self.free else []
        bend = np.abs(np.einsum("kii->ki", self.curved)).mean(axis=0)
        least, most = self.along.u.min(axis=0, initial=np.inf), self.along.u.max(axis=0, initial=-np.inf)
        value = np.maximum(np.abs(least), np.abs(most))
        size = np.where(most - least <= SOLVER_SHARE * value, np.maximum(value, sizes.control), sizes.control)
        weight = bend * size**2
        largest = float(weight.max(initial=0.0))
        still = size <= RESOLVED_SHARE * size.max(initial=0.0)  # whose size says nothing
        curves = (weight > MACHINE_SHARE * largest) | (still & (bend > MACHINE_SHARE * bend.max(initial=0.0)))
        self.range = np.where(curves, np.sqrt(largest / np.where(curves, bend, 1.0)), sizes.control)
        state = self.along.state_size.copy()
        as_others(state, self.along.form.states, self.along.form.problem.declared.states, LIMIT_SHARE)
        self.unit = np.concatenate([state, horizon, *([state] if self.tied else []), self.range])

    def _into_z(self) -> tuple[list[int], list[int]]:
        """Entries of y = (x, T, u), and where each stands in (z, u)."""
        nx = self.nx
        keep = [*range(nx), *([nx] if self.free else [])]
        inputs = range(nx + 1, nx + 1 + self.nu)
        return [*keep, *inputs], [*range(len(keep)), *range(self.nz, self.nz + self.nu)]

    def _second_order(self) -> None:
        along, form, m = self.along, self.along.form, len(self.along.s)
        lam, mu = form.sym("lam", form.nx), form.sym("mu", len(form.path))
        multipliers = np.zeros((m, len(form.path)))
        multipliers[:, along.mixed] = self.adjoint.holding[:, self.nu : self.nu + along.mixed.size]
        multipliers[:, along.still] = self.adjoint.standing[:, self.nx :]

        def outputs() -> list[Any]:
            cost, rate, path = along.scaled
            total = cost + ca.dot(lam, rate) + ca.dot(mu, path)
            return [ca.hessian(total, along.y)[0], ca.diag(ca.hessian(cost, form.x)[0])]

        more = (lam, self.adjoint.costate), (mu, multipliers)
        hessian, self._cost_curves = form.sampled(outputs, *along.here, *more, cache_as="second derivatives")
        ny = self.nx + 1 + self.nu
        hessian = hessian.reshape(m, ny, ny)
        self.curved = hessian[:, self.nx + 1 :, self.nx + 1 :]
        self._curves = np.einsum("kii->ki", hessian)
        self._units()
        into, z_of = self._into_z()
        size, z_unit = self.nz + self.nu, self.unit[: self.nz]
        self.rate, self.hessian = np.zeros((m, self.nz, size)), np.zeros((m, size, size))
        self.rate[np.ix_(range(m), range(self.nx), z_of)] = along.rate_y[:, :, into]
        self.hessian[np.ix_(range(m), z_of, z_of)] = hessian[np.ix_(range(m), into, into)]
        self.rate *= self.unit / z_unit[:, None]
        self.hessian *= self.unit * self.unit[:, None]

    @cached_property
    def flat(self) -> np.ndarray:
        """Controls along which the Hamiltonian does not curve. Shape (nu,), bool."""
        bends = np.abs(self.curved * self.range * self.range[:, None]).max(axis=(0, 2), initial=0.0)
        pull = np.abs(slope(self.along, self.adjoint.costate) * self.range).max(initial=0.0)
        return np.asarray(bends <= FLAT_SHARE * max(float(bends.max(initial=0.0)), float(pull)))

    @cached_property
    def left(self) -> np.ndarray:
        """Slope of T H along the controls that curve it, which nothing holds, in scaled controls. Shape (M, nu)."""
        along = self.along
        found = slope(along, self.adjoint.costate) + np.einsum("kmu,km->ku", along.hold_u, self.adjoint.holding)
        return np.asarray(np.where(self.flat, 0.0, found * self.range))

    @property
    def start_slope(self) -> np.ndarray:
        """Slope of the cost in start and horizon, in scaled z. Shape (nz,)."""
        into, nx = self.adjoint.ends.slope, self.nx
        slope = np.concatenate([into[:nx], into[nx:] if self.free else [], np.zeros(nx * self.tied)])
        return np.asarray(slope * self.unit[: self.nz])

    @property
    def spread(self) -> float:
        """What the Hamiltonian curves by over the sizes of states and controls, in units of cost."""
        unit = np.concatenate([self.along.sizes.state, [0.0], self.along.sizes.control])
        return float(self.along.share @ (np.abs(self._curves) @ unit**2)) / 2

    @property
    def price(self) -> float:
        """The same, of the states by the running cost alone: multipliers are no part of a size of the cost."""
        sizes, bends = self.along.sizes, np.abs(self._curves[:, self.nx + 1 :])
        found = self.along.share @ (np.abs(self._cost_curves) @ sizes.state**2 + bends @ sizes.control**2)
        return float(found) / 2

    @property
    def magnitude(self) -> float:
        """What the cost curves by over the whole controls, in units of cost."""
        return float(self.along.share @ np.sum(np.abs(self._curves[:, self.nx + 1 :]) * self.along.u**2, axis=1)) / 2

    def _hold(self) -> None:
        """Which limits take directions away: those that push, and those that are only touched."""
        along, m = self.along, len(self.along.s)
        into, z_of = self._into_z()
        size = self.nz + self.nu
        nu, nh = self.nu, self.nu + along.mixed.size
        normals = np.zeros((m, nh + len(along.stand.equal), size))
        normals[:, :nu, self.nz :] = np.eye(nu)
        normals[np.ix_(range(m), range(nu, nh), z_of)] = along.row_y[:, along.mixed][:, :, into]
        normals[:, nh : nh + self.nx, : self.nx] = np.eye(self.nx)
        normals[np.ix_(range(m), range(nh + self.nx, normals.shape[1]), z_of)] = along.row_y[:, along.still][:, :, into]
        normals *= self.unit
        reach = np.abs(normals).max(axis=2)

        # a control that rests on its limit all along is near it by its own size, where none of its unit has another
        largest = np.abs(along.u).max(axis=0, initial=0.0)
        held = np.append(np.maximum(along.control_size, largest), along.sizes.path[along.mixed])
        rests = np.append(along.sizes.state, along.sizes.path[along.still])

        def pushing(limits: Limits, multipliers: np.ndarray, first: int, size: np.ndarray) -> list[np.ndarray]:
            count = multipliers.shape[1]
            force = np.abs(multipliers) * reach[:, first : first + count]
            touched = (limits.gap[:, :count] <= RESOLVED_SHARE * size) | limits.equal[:count]
            return [force > FLAT_SHARE * (force.max(initial=0.0) or 1.0), touched]

        strong, touched = pushing(along.hold, self.adjoint.holding[:, :nh], 0, held)
        self.fixed = strong[:, :nu] & touched[:, :nu]
        pushed, resting = pushing(along.stand, self.adjoint.standing, nh, rests)
        strong = np.hstack([strong & touched | along.hold.equal[:nh], pushed | along.stand.equal])
        touched = np.hstack([touched, resting])
        n, q = along.shape
        self.normals, self.strong, self.weak = normals, strong, touched & ~strong
        # on an arc the points alone leave the ends of the intervals free to go to and fro
        standing = (pushed | along.stand.equal).reshape(n, q, -1)
        arc = np.concatenate([standing[:1, 0], standing[:-1, -1] & standing[1:, 0], standing[-1:, -1]])
        node = np.zeros((n + 1, len(along.stand.equal), self.nz))
        node[:, :, : self.nx] = along.node_stand_x[:, :, :-1]
        if self.free:
            node[:, :, self.nx] = along.node_stand_x[:, :, -1]
        self.node_normals, self.node_strong = node * self.unit[: self.nz], arc & along.node_stand.near

    def _switch(self) -> None:
        """Controls that go from one limit to the other within an interval, and what moving the switch costs."""
        along, nu = self.along, self.nu
        n, q = along.shape
        self.moved, self.switching = np.zeros((n, nu), bool), np.zeros((n, nu))
        pull = slope(along, self.adjoint.costate).reshape(n, q, nu)
        fixed, u = self.fixed.reshape(n, q, nu), along.u.reshape(n, q, nu)
        at = along.s.reshape(n, q)
        for i in np.flatnonzero(self.flat):
            step = along.high[0, i] - along.low[0, i]
            whole = fixed[:, :, i].all(axis=1)
            for k in np.flatnonzero(~whole):
                before, after = max(int(k) - 1, 0), min(int(k) + 1, n - 1)
                rise = u[after, -1, i] - u[before, 0, i]
                if not (np.isfinite(step) and abs(rise) > 0.5 * step):
                    continue
                near = slice(before, after + 1)
                steep = np.polynomial.polynomial.polyfit(at[near].ravel(), pull[near, :, i].ravel(), 1)[1]
                if steep * rise < 0:
                    self.moved[k, i], self.switching[k, i] = True, abs(steep) / abs(rise)


def obstacle(form: Formulation) -> str:
    """Why the second variation of the plans of a problem is not known, or ""."""
    last = ca.vertcat(form.end.expression, form.terminal)
    if ca.depends_on(last, form.u0):
        return "the control at the start enters the conditions at the end"
    if ca.depends_on(ca.vertcat(last, form.start.expression), form.u):
        return "a control enters the conditions at an end"
    return ""


def curved_ends(form: Formulation) -> Any:
    """Second derivatives of the end and of the start rows, each times its multiplier, in (x, T, x0).

    A Function (x, x0, T, p, multipliers of the end rows, of the start rows).
    """
    nu_end, nu_start = (form.sym(name, len(r)) for name, r in (("nu", form.end), ("nu0", form.start)))
    last = ca.substitute([form.end.expression], [form.t], [form.T])[0]
    begin = ca.substitute([form.start.expression], [form.x, form.t], [form.x0, 0])[0]
    both = ca.vertcat(form.x, form.T, form.x0)
    outputs = [ca.hessian(ca.dot(nu, rows), both)[0] for nu, rows in ((nu_end, last), (nu_start, begin))]
    symbols = [form.x, form.x0, form.T, form.p, nu_end, nu_start]
    return ca.Function("ends", symbols, [ca.densify(output) for output in outputs])


def end_conditions(accessory: AccessoryProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Second variation and active rows in scaled z: (hessian, rows) at the end, (hessian, rows) at the start.

    Inequalities are active where their multipliers push, bounds of the states where the plan rests on them.
    """
    along, ends = accessory.along, accessory.adjoint.ends
    form, solution, (low, high) = along.form, along.solution, along.bounds
    places, nx = form.bounds.places, accessory.nx
    x0, x1 = (solution.state_interpolant(np.array([end]))[0] for end in (0.0, 1.0))
    second = form.cached("curvature of the ends", lambda: curved_ends(form))
    found = second(x1, x0, solution.horizon, along.p, ends.end, ends.start)
    end_curved, start_curved = (np.asarray(v.full()) for v in found)
    order = [*range(nx), 2 * nx, *range(nx, 2 * nx)]  # of (x, T, x0) in (x, x0, T)
    end_curved = end_curved + along.final_yy[np.ix_(order, order)]
    psi_y, psi0_y = np.split(along.end_y[:, order], [len(form.end)])
    force = max(np.abs(ends.end).max(initial=0.0), np.abs(ends.start).max(initial=0.0)) or 1.0
    at_end = (np.abs(ends.end) > FLAT_SHARE * force) | form.end.equality
    at_start = (np.abs(ends.start) > FLAT_SHARE * force) | form.start.equality
    fixed = {k: low[places[k]] == high[places[k]] for k in ("terminal", "initial")}
    slack = RESOLVED_SHARE * along.sizes.state
    for k, x in (("terminal", x1), ("initial", x0)):
        fixed[k] = fixed[k] | (x <= low[places[k]] + slack) | (x >= high[places[k]] - slack)

    # rows and columns of (x, T, x0) that z has; at the start x is the x0 of the conditions
    z = [*range(nx), *([nx] if accessory.free else []), *(range(nx + 1, 2 * nx + 1) if accessory.tied else [])]
    z_unit = accessory.unit[: accessory.nz]
    eye = np.eye(accessory.nz)
    end_hessian, end_rows = end_curved[np.ix_(z, z)], np.vstack([psi_y[at_end][:, z], eye[:nx][fixed["terminal"]]])
    begin_of = [*range(nx + 1, 2 * nx + 1), *([nx] if accessory.free else [])]
    start_hessian, start_rows = np.zeros((accessory.nz, accessory.nz)), np.zeros((int(at_start.sum()), accessory.nz))
    start_hessian[: len(begin_of), : len(begin_of)] = start_curved[np.ix_(begin_of, begin_of)]
    start_rows[:, : len(begin_of)] = psi0_y[at_start][:, begin_of]
    extra = [eye[:nx][fixed["initial"]]]
    if accessory.tied:
        extra.append(eye[:nx] - eye[accessory.nz - nx :])
    if accessory.free:
        least, most = (float(side[places["horizon"][0]]) for side in (low, high))
        if not least * (1 + RESOLVED_SHARE) < solution.horizon < most * (1 - RESOLVED_SHARE):
            extra.append(eye[nx : nx + 1])
    scale = z_unit * z_unit[:, None]
    return end_hessian * scale, end_rows * z_unit, start_hessian * scale, np.vstack([start_rows * z_unit, *extra])
