"""First- and second-order optimality of a plan: multipliers, excess cost over the optimum, curvature of the cost.

Where controls rest on their limits, the plan alone does not determine the costates. A plan that switches between limits
where its mesh allows it fits a whole set of costates. A solver reports one of them, whose switching functions need not
vanish where the plan switches. The loss of a plan is therefore the minimum over all multipliers that satisfy the
costate equation and the conditions at the ends (weak duality). It has two parts: multipliers times the gaps to their
limits, and the squared remaining slope of the Hamiltonian over its curvature. The minimum is a convex program, dual to
the linearised problem of the plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.accessory import AccessoryProblem
from ocp.audit.costates import Adjoint, Ends, adjoint, end_limits, interval_end_costates
from ocp.audit.curvature import Curvature, curvature
from ocp.audit.linearisation import Limits, Linearisation
from ocp.audit.principle import Hamiltonian, control_loss, hamiltonian, needle_loss, reduced_slope, switching_loss
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE, RESOLVED_SHARE

PROXIMITY_WEIGHT = 1e-5
"""Weight of the relative mean square distance from the reported costates, which selects among equally good
multipliers."""
SOLVER = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.max_iter": 200,
    "ipopt.mu_strategy": "adaptive",
    "ipopt.perturb_always_cd": "yes",  # multipliers of dependent limits are not unique
    "print_time": False,
    "error_on_fail": False,
}


class Fit(NamedTuple):
    """Multipliers of a plan that minimise its estimated excess cost over the optimum (loss).

    Attributes:
        lost: Loss of the plan in each interval without that at start and end, in units of cost. Shape (N,).
        adjoint: The multipliers. The errors remain those of the reported costates.
        distance: Largest distance of the reported costates from the fitted ones at a mesh node, in units of cost. 0 for
            state equalities, which determine costates only up to multiples of their gradients.
    """

    lost: np.ndarray
    adjoint: Adjoint
    distance: float


def best_multipliers(along: Linearisation, known: Adjoint, curved: np.ndarray, cost: float) -> Fit | None:
    """Return the multipliers that minimise the estimated excess cost of a plan; None if the solver fails.

    `curved` is the Hessian T H_uu, (M, nu, nu), at the multipliers that are `known`; `cost` is the size of the cost.
    """
    dual = _Dual(along, curved, cost)
    x = dual.program.solve()
    return None if x is None else dual.fit(x * cost, known)


class _Program:
    """Sparse convex quadratic program with linear equations and lower bounds, to which parts are added one by one.

    Minimise price . x + weight . x^2 / 2 subject to A x = right and x >= low.
    """

    def __init__(self) -> None:
        self._variables: list[np.ndarray] = []  # low, price and weight of each variable, (3, count)
        self._right: list[np.ndarray] = []
        self._entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def variables(self, count: int, low: Any = -np.inf, price: Any = 0.0, weight: Any = 0.0) -> np.ndarray:
        """Add variables to the quadratic program and return their indices."""
        first = sum(part.shape[1] for part in self._variables)
        self._variables.append(np.array([np.broadcast_to(value, (count,)) for value in (low, price, weight)], float))
        return np.arange(first, first + count)

    def equations(self, right: np.ndarray) -> np.ndarray:
        """Add equations with given right-hand sides to the quadratic program; return their indices."""
        first = sum(part.size for part in self._right)
        self._right.append(right)
        return np.arange(first, first + right.size).reshape(right.shape)

    def add(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to the matrix of the equations; the three arguments are broadcast to one shape."""
        rows, columns, values = np.broadcast_arrays(rows, columns, values)
        keep = values.ravel() != 0
        self._entries.append((rows.ravel()[keep], columns.ravel()[keep], values.ravel()[keep]))

    def solve(self) -> np.ndarray | None:
        """Return the optimal variables of the quadratic program; None if the solver does not converge."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        low, price, weight = np.hstack(self._variables)
        right = np.concatenate([part.ravel() for part in self._right])
        matrix = ca.DM.triplet(rows.tolist(), columns.tolist(), ca.DM(values), len(right), len(low))
        x = ca.MX.sym("x", len(low))
        objective = ca.dot(ca.DM(price), x) + ca.dot(ca.DM(weight), x**2) / 2
        solver = ca.nlpsol("dual", "ipopt", {"x": x, "f": objective, "g": ca.mtimes(matrix, x)}, SOLVER)
        result = solver(x0=np.where(np.isfinite(low), 1e-2, 0.0), lbx=low, ubx=np.inf, lbg=right, ubg=right)
        if not solver.stats()["success"]:
            return None
        return np.asarray(np.maximum(result["x"].full().ravel(), low))


@dataclass
class _Multipliers:
    """Multipliers of limits: nonnegative variables of a quadratic program whose unit costs are the distances to limits.

    Attributes:
        point, limit: Indices of the point and of the limit of each multiplier. Shape (K,).
        sign: 1 for an upper limit, -1 for a lower one. Shape (K,).
        slope: Gradient of the limit, times the sign, over ``reach``. Shape (K, n).
        reach: Effect of a multiplier of one, in units of cost. Shape (K,).
        price: Gap to the limit over ``reach``. Shape (K,).
        index: Index of the multiplier among the variables of the program. Shape (K,).
    """

    point: np.ndarray
    limit: np.ndarray
    sign: np.ndarray
    slope: np.ndarray
    reach: np.ndarray
    price: np.ndarray
    index: np.ndarray

    @classmethod
    def of(cls, program: _Program, limits: Limits, chosen: np.ndarray, slopes: np.ndarray, size: np.ndarray,
           share: Any = 1.0) -> _Multipliers:  # fmt: skip
        """Return the multipliers of limits in the mask ``chosen`` (M, m), added as variables to a quadratic program.

        ``slopes`` (M, m, n) are the derivatives of the limits with respect to variables of the given ``size`` (n,).
        A multiplier per unit of the horizon fraction s costs its gap times the ``share`` (M,) of its point.
        """
        reach = (np.abs(slopes) * size).sum(axis=2)
        sides = []
        for sign, gap in ((1.0, limits.above), (-1.0, limits.below)):
            point, limit = np.nonzero(chosen & np.isfinite(gap) & (reach > 0))
            sides.append((point, limit, np.full(len(point), sign), gap[point, limit]))
        point, limit, signs, gaps = (np.concatenate(part) for part in zip(*sides, strict=True))
        effect = reach[point, limit]
        price = np.broadcast_to(share, len(slopes))[point] * gaps / effect
        slope = slopes[point, limit] * (signs / effect)[:, None]
        return cls(point, limit, signs, slope, effect, price, program.variables(len(point), 0.0, price))

    def table(self, x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return the signed multipliers of all limits, 0 for limits not in the quadratic program. Shape (M, m)."""
        values = np.zeros(shape)
        np.add.at(values, (self.point, self.limit), self.sign * x[self.index] / self.reach)
        return values


class _Dual:
    """Linear or quadratic program whose solution is the multipliers of a plan, in units of the cost."""

    def __init__(self, along: Linearisation, curved: np.ndarray, cost: float) -> None:
        self.along, self.cost, self.program = along, cost, _Program()
        (n, q), nx, nu = along.shape, along.form.nx, along.form.nu
        self.interval = np.arange(n * q) // q
        self.costate = self.program.variables(n * q * nx).reshape(n * q, nx)
        first, last = interval_end_costates(along)
        self.reported = np.vstack([first, last[-1:]]) * along.state_size
        weight = PROXIMITY_WEIGHT / (n + 1) / max(1.0, float(np.abs(self.reported).max()) / cost)
        price = -weight * self.reported.ravel() / cost
        self.nodes = self.program.variables(self.reported.size, price=price, weight=weight).reshape(n + 1, nx)

        # with a step of the full range between limits, their gaps alone determine the price
        width = (along.high - along.low).max(axis=0, initial=0.0)
        self.step = np.where(np.isfinite(width), np.maximum(width, along.sizes.control), along.sizes.control)
        reachable = np.einsum("k,kij,j->i", along.share, np.abs(along.rate_y[:, :, nx + 1 :]), self.step)
        self.residual_price = max(1.0, float((reachable / along.state_size).max(initial=0.0)))
        # arcs of the states are among the state limits
        controls, states, slopes = along.control_limits, along.state_limits, along.control_limits_u
        chosen = controls.near & (np.arange(slopes.shape[1]) < nu + len(along.mixed))
        chosen[:, :nu] = True
        self.control_limits = _Multipliers.of(self.program, controls, chosen, slopes, self.step, along.share)
        scales = np.append(along.state_size, 0.0)
        self.state_limits = _Multipliers.of(self.program, states, states.near, along.state_limits_x, scales)
        interior = along.node_limits.near & (along.nodal | ~along.node_limits.equal)
        interior[[0, -1]] = False  # the conditions at the ends are separate
        self.node = _Multipliers.of(self.program, along.node_limits, interior, along.node_limits_x, scales)
        self.path_slope = np.zeros((len(self.control_limits.point), nx + 1))  # gradients of path rows in (x, T)
        path = self.control_limits.limit >= nu
        row = along.mixed[self.control_limits.limit[path] - nu]
        self.path_slope[path] = along.row_y[self.control_limits.point[path], row, : nx + 1]
        self.path_slope *= (self.control_limits.sign / self.control_limits.reach)[:, None]
        self._costate_equation()
        self._stationarity(curved)
        self._ends()

    def _costate_equation(self) -> None:
        """Add the costate equation of every mesh interval, integrated backwards, to the quadratic program."""
        along, program, node = self.along, self.program, self.node
        controls, states = self.control_limits, self.state_limits
        (n, q), nx, size = along.shape, along.form.nx, along.state_size
        feedback = (along.rate_y[:, :, :nx] * size / size[:, None]).transpose(0, 2, 1)
        source = (along.cost_y[:, :nx] * size / self.cost).reshape(n, q, nx)
        previous = node.point - 1  # the multiplier of a node also acts on the interval before it
        steps = [(self.costate.reshape(n, q, nx)[:, i], along.weight - along.matrix[i]) for i in range(q)]
        for start, weight in [*steps, (self.nodes[:-1], along.weight)]:
            rows = program.equations(along.width[:, None] * np.einsum("j,kja->ka", weight, source))
            program.add(rows, start, 1.0)
            program.add(rows, self.nodes[1:], -1.0)
            program.add(rows[previous], node.index[:, None], -node.slope[:, :nx] * size)
            densities, atoms = np.outer(along.width, weight).ravel(), np.tile(weight / along.weight, n)
            rows_of_point = rows[self.interval]
            program.add(rows_of_point[:, :, None], self.costate[:, None, :], -densities[:, None, None] * feedback)
            force = densities[controls.point, None] * self.path_slope[:, :nx] * size
            program.add(rows_of_point[controls.point], controls.index[:, None], -force)
            force = atoms[states.point, None] * states.slope[:, :nx] * size
            program.add(rows_of_point[states.point], states.index[:, None], -force)

    def _stationarity(self, curved: np.ndarray) -> None:
        """Add the stationarity condition of the Hamiltonian, with a penalised residual, to the quadratic program.

        The penalty is quadratic where H is curved in the controls, else linear. Its step is the size of the control
        along the plan or, if the control has limits, the range between them.
        """
        along, program, controls = self.along, self.program, self.control_limits
        nx, unit, share = along.form.nx, self.step, along.share[:, None]
        rows = program.equations(-along.cost_y[:, nx + 1 :] * unit / self.cost)
        rate = along.rate_y[:, :, nx + 1 :] * unit / along.state_size[:, None]
        program.add(rows[:, :, None], self.costate[:, None, :], rate.transpose(0, 2, 1))
        program.add(rows[controls.point], controls.index[:, None], controls.slope * unit)
        eigenvalues, vectors = np.linalg.eigh(curved * unit * unit[:, None] / self.cost)
        is_curved = eigenvalues > FLAT_SHARE * float(np.abs(eigenvalues).max(initial=0.0))
        self.price = np.where(is_curved, 0.0, share)
        self.weight = np.where(is_curved, share / np.where(is_curved, eigenvalues, 1.0), 0.0)
        self.residual = []
        for sign in (-1.0, 1.0):
            part = program.variables(rows.size, 0.0, self.price.ravel(), self.weight.ravel()).reshape(rows.shape)
            program.add(rows[:, :, None], part[:, None, :], sign * vectors)
            self.residual.append(part)

    def _ends(self) -> None:
        """Add the transversality conditions, with penalised residuals, to the quadratic program.

        The price of a residual is how far the controls could move the states.
        """
        along, program, nx, share = self.along, self.program, self.along.form.nx, self.along.share
        ends, horizon = end_limits(along), along.solution.horizon
        self.ends, free = ends, ends.free
        self.end_price = ends.gap / ends.reach
        self.end_index = program.variables(len(ends.gap), np.where(ends.equal, -np.inf, 0.0), self.end_price)
        right = along.final_y * ends.unit / self.cost
        right[-1] += horizon / self.cost * float(share @ along.cost_y[:, nx])
        rows = np.full(2 * nx + 1, -1)
        rows[free] = program.equations(right[free])
        states = np.flatnonzero(free[:-1])
        at_ends = np.concatenate([self.nodes[-1], self.nodes[0]])
        program.add(rows[states], at_ends[states], np.where(states < nx, 1.0, -1.0))
        program.add(rows[free], self.end_index[:, None], -ends.scaled_slope[:, free])
        if free[-1]:
            program.add(rows[-1], self.costate, -horizon * share[:, None] * along.rate_y[:, :, nx] / along.state_size)
            force = horizon * share[self.control_limits.point] * self.path_slope[:, nx]
            program.add(rows[-1], self.control_limits.index, -force)
            for limits in (self.state_limits, self.node):
                program.add(rows[-1], limits.index, -horizon * limits.slope[:, nx])
        self.end_residual = []
        for sign in (-1.0, 1.0):
            self.end_residual.append(program.variables(int(free.sum()), 0.0, self.residual_price))
            program.add(rows[free], self.end_residual[-1], sign)

    def fit(self, x: np.ndarray, known: Adjoint) -> Fit:
        """Return the best-fitting multipliers of the plan, and its excess cost, from the solution of the program."""
        along, (n, q), nx, size = self.along, self.along.shape, self.along.form.nx, self.along.state_size
        lost = np.zeros(n)
        for part in self.residual:
            paid = self.price * x[part] + self.weight * x[part] ** 2 / (2 * self.cost)
            np.add.at(lost, self.interval, paid.sum(axis=1))
        for limits in (self.control_limits, self.state_limits):
            np.add.at(lost, self.interval[limits.point], limits.price * x[limits.index])
        np.add.at(lost, self.node.point - 1, self.node.price * x[self.node.index])
        state_multipliers = self.state_limits.table(x, along.state_limits.lower.shape) / along.share[:, None]
        at_nodes = self.node.table(x, along.node_limits.lower.shape)
        state_multipliers.reshape(n, q, -1)[:, -1] += at_nodes[1:] / along.share.reshape(n, q)[:, -1:]
        slope = np.zeros(2 * nx + 1)
        ends = self.ends
        slope[ends.free] = (x[self.end_residual[1]] - x[self.end_residual[0]]) / ends.unit[ends.free]
        end, start = ends.table(x[self.end_index] / ends.reach)
        charge = float(self.end_price @ x[self.end_index])
        after = x[self.nodes]
        before = after.copy()
        np.add.at(before, self.node.point, self.node.slope[:, :nx] * size * x[self.node.index, None])
        distances = np.minimum(np.abs(self.reported - after), np.abs(self.reported - before))[:-1].sum(axis=1)
        return Fit(
            lost,
            replace(
                known,
                costate=x[self.costate] / size,
                control_multipliers=self.control_limits.table(x, along.control_limits.lower.shape),
                state_multipliers=state_multipliers,
                ends=known.ends._replace(slope=slope[nx:], charge=charge, end=end, start=start),
            ),
            0.0 if along.state_limits.equal.any() else float(distances.max()),
        )


@dataclass(frozen=True)
class Optimality:
    """Result of evaluating the first- and second-order optimality conditions along a plan.

    Attributes:
        lost: Cost that the plan could save in each interval, to second order; what start and end could save is counted
            in the first. Shape (N,).
        cost_size: Reference of the loss, in units of cost: the cost or, if it is negligible, the cost of the smallest
            control changes that are resolved.
        error_size: Reference of the costate errors, in units of cost. The cost is quadratic in these errors.
        t: Times of the Gauss points, s. Shape (N q,).
        stationarity: Largest remaining slope of the Hamiltonian in a control at these times, relative to the sizes of
            its parts. Shape (N q,).
        adjoint: Costates and multipliers.
        hamiltonian: The Hamiltonian along the plan.
        curvature: The second variation.
        costate_accuracy: Relative accuracy of the costates of a transcription whose controls lose as much cost.
        costate_error: Error of the reported costates as a share of the cost, if other costates fit the plan better:
            their distance from these, or the root of the additional loss.
        has_linear_control: Whether the Hamiltonian is linear in some control.
    """

    lost: np.ndarray
    cost_size: float
    error_size: float
    t: np.ndarray
    stationarity: np.ndarray
    adjoint: Adjoint
    hamiltonian: Hamiltonian
    curvature: Curvature
    costate_accuracy: float
    costate_error: float
    has_linear_control: bool


def optimality(along: Linearisation, allowed: float = LIMIT_SHARE) -> Optimality:
    """Compute the multipliers of a plan, its excess cost over the optimum, and the curvature of the cost.

    If the loss exceeds the share ``allowed`` of the cost, better multipliers than the reported costates are searched.
    """
    plan_cost = abs(along.solution.cost)
    if not (along.finite and np.isfinite(plan_cost)):
        return undefined_result(along)
    cost = plan_cost or along.slope_size or 1.0
    curved = _control_curvature(along)
    first = adjoint(along, curved, cost)
    if first.node_shifts.any():
        loss = _loss_of_fit(along, first, curved)
        for _ in range(4):  # each pass resolves atoms at single nodes better by the width of an interval
            candidate = adjoint(along, curved, cost, first.node_shifts)
            if (new_loss := _loss_of_fit(along, candidate, curved)) >= loss:
                break
            first, loss = candidate, new_loss
    accessory = AccessoryProblem(along, first)
    spread = accessory.hamiltonian_scale
    cost = max(plan_cost, accessory.negligible_cost) or 1.0
    total, best = _loss_by_interval(along, first, accessory.curved), first
    loss, costate_error = _total_loss(total, first), 0.0
    is_degenerate = along.may_be_degenerate or bool(accessory.linear_controls.any())
    if loss > allowed * cost and is_degenerate:
        fit = best_multipliers(along, first, accessory.curved, cost)
        if fit is not None and _total_loss(fit.lost, fit.adjoint) < loss:
            best = fit.adjoint
            total = np.maximum(fit.lost + switching_loss(along, best.costate, accessory.curved), 0.0)
            costate_error = min(fit.distance / cost, float(np.sqrt((loss - _total_loss(total, best)) / cost)))
            accessory = AccessoryProblem(along, best)
    total[0] += best.ends.charge
    total_loss = float(total.sum()) if costate_error else loss
    costate_accuracy = float(np.sqrt(total_loss / cost)) if np.isfinite(total_loss) else 0.0
    second_order = curvature(accessory)
    if second_order.upwards and second_order.gain is not None:  # near a conjugate point moving states add to the loss
        additional = float(second_order.gain.sum() - total.sum())
        total += max(additional, 0.0) * second_order.gain / (float(second_order.gain.sum()) or 1.0)
    total[0] += second_order.lost(accessory.start_slope)
    total = np.maximum(total, needle_loss(along, best.costate))
    return Optimality(
        total,
        cost,
        max(float(np.sqrt(cost * max(cost, spread))), RESOLVED_SHARE**2 * accessory.control_scale),
        along.t,
        reduced_slope(along, best.costate, best.control_multipliers),
        best,
        hamiltonian(along),
        second_order,
        costate_accuracy,
        costate_error,
        bool(accessory.linear_controls.any()),
    )


def _loss_by_interval(along: Linearisation, multipliers: Adjoint, curved: np.ndarray) -> np.ndarray:
    """Return the excess cost of a plan in each interval for given multipliers, to second order. Shape (N,)."""
    loss = control_loss(along, multipliers.costate, multipliers.control_multipliers, curved)
    return np.asarray(np.maximum(loss, 0.0) + multipliers.charge)


def _total_loss(by_interval: np.ndarray, multipliers: Adjoint) -> float:
    """Return a plan's estimated excess cost: that of all intervals, plus end multipliers times distances to limits."""
    return float(by_interval.sum() + multipliers.ends.charge)


def _loss_of_fit(along: Linearisation, multipliers: Adjoint, curved: np.ndarray | None) -> float:
    """Return the sum of a plan's estimated excess cost and the residuals of its costate conditions, in cost units."""
    assert curved is not None
    loss = _total_loss(_loss_by_interval(along, multipliers, curved), multipliers)
    return loss + multipliers.total + multipliers.ends.transversality


def _control_curvature(along: Linearisation) -> np.ndarray | None:
    """Return the Hessian of the Hamiltonian in the controls at the Gauss points; None if the Hessian is not needed.

    It is T H_uu without path constraints, (M, nu, nu), needed for path inequalities and limits at single points.
    """
    form = along.form
    near = along.state_limits.near.any() or along.node_limits.near.any()
    single = along.nodal and (along.mixed.size > 0 or near)
    if form.path.equality[along.mixed].all() and not single:
        return None
    lam = form.sym("lam", form.nx)

    def outputs() -> list[Any]:
        return [ca.hessian(along.scaled[0] + ca.dot(lam, along.scaled[1]), form.u)[0]]

    (curved,) = form.sampled(outputs, *along.point, (lam, along.costate), cache_as="curvature in the controls")
    return np.asarray(curved.reshape(-1, form.nu, form.nu))


def undefined_result(along: Linearisation) -> Optimality:
    """Return the result, in which all checks fail, for a plan along which values of the problem are not finite."""
    (n, _), m, form = along.shape, len(along.s), along.form
    infinite, t = np.full(n, np.inf), along.mesh * along.solution.horizon
    rows = np.zeros(len(form.end)), np.zeros(len(form.start))
    ends = Ends(np.inf, np.inf, np.full(form.nx + 1, np.nan), np.inf, *rows)
    counts = form.nx, along.control_limits_u.shape[1], along.state_limits_x.shape[1]
    costate, of_controls, of_states = (np.full((m, count), np.nan) for count in counts)
    shifts = np.zeros((n + 1, form.nx))
    known = Adjoint(t, costate, of_controls, of_states, infinite, np.inf, infinite, infinite, shifts, ends)
    curved = Curvature(np.nan, None, "the problem is not a number along the plan", None, along.t)
    slopes, values = np.full(m, np.inf), hamiltonian(along)
    return Optimality(infinite, 1.0, 1.0, along.t, slopes, known, values, curved, 0.0, 0.0, False)
