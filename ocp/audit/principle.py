"""The minimum principle along a plan: does an admissible control lower the Hamiltonian, and what cost does that save?

The multipliers of the solver are not used. At each point the multipliers of the limits of the controls are computed by
least squares, with the signs that the minimum principle demands (Bryson, Ho 1975, chapter 3). The remaining slope of
the Hamiltonian is judged by the cost it loses: the minimum of H_u du + du H_uu du / 2 over the controls within their
limits, integrated over the plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.linearisation import Linearisation
from ocp.errors import ProblemError
from ocp.problem.intervals import Interval, check_instructions, evaluate
from ocp.solution_data import stack
from ocp.tolerances import FLAT_SHARE, LIMIT_SHARE, MACHINE_SHARE, ROUNDING_SHARE, SOLVER_SHARE

NEEDLES = 17
"""Number of values of a control between its limits at which the Hamiltonian is compared."""


@dataclass(frozen=True)
class Hamiltonian:
    """Values of the Hamiltonian along a plan, and the scale by which they are judged.

    Attributes:
        values: L + costate . f at the reported times of the plan, in cost per second. Shape (M,).
        scale: Largest value of |L| + sum |costate_i f_i|.
    """

    values: np.ndarray
    scale: float

    @property
    def drift(self) -> float:
        """Largest minus smallest value of the Hamiltonian along the plan, in cost per second."""
        return float(np.ptp(self.values))


def hamiltonian(along: Linearisation) -> Hamiltonian:
    """Return the Hamiltonian at the reported times of a plan."""
    form, solution = along.form, along.solution
    pools = (solution.states, solution.controls, solution.costates)
    x, u, costate = (stack(pool, len(solution.t)) for pool in pools)
    lam = form.sym("lam", form.nx)
    point = x, u, solution.t, solution.horizon, along.p, (lam, costate)
    running, products = form.sampled(lambda: [form.running, lam * form.f], *point, cache_as="Hamiltonian")
    scale = float(np.max(np.abs(running[:, 0]) + np.abs(products).sum(axis=1), initial=0.0))
    return Hamiltonian(running[:, 0] + products.sum(axis=1), scale or 1.0)


def global_optimum(along: Linearisation, negligible: float) -> str:
    """Return why an extremal of the problem is a global optimum, "" if that is unknown.

    ``negligible`` is a cost that counts as zero.
    """
    if along.form.cached("convex", lambda: is_convex(along)):
        return "convex problem: an extremal is a global optimum"
    bound = cost_bound(along)
    if along.solution.cost - bound <= LIMIT_SHARE * max(abs(along.solution.cost), negligible):
        return f"global optimum: no plan within the bounds costs less by more than {along.solution.cost - bound:.2g}"
    return ""


def cost_bound(along: Linearisation) -> float:
    """Return a lower bound of the cost of all plans within the bounds of states, controls and horizon.

    It is the bound of the terminal cost plus the horizon times the bound of the running cost, by interval arithmetic on
    all states and controls at once; -inf for operations without interval rules.
    """
    form, places = along.form, along.form.bounds.places
    symbols = [form.x, form.u, form.T, form.x0, form.u0, form.t, form.p]
    longest = along.bounds[1][places["horizon"]]

    def bound(expression: Any, states: str) -> float:
        function = ca.Function("cost", symbols, [ca.densify(expression)]).expand()
        check_instructions("cost", function)
        kinds = (states, "control", "horizon", "initial", "control")
        sides = [
            np.concatenate([*(side[places[kind]] for kind in kinds), time, along.p])
            for side, time in zip(along.bounds, (np.zeros(1), longest), strict=True)
        ]
        parts = [ca.SX.sym("v", symbol.numel()) for symbol in symbols]
        scalars = ca.Function("cost", ca.vertsplit(ca.vertcat(*parts)), function.call(parts))
        return float(evaluate(scalars, [Interval(*ends) for ends in np.transpose(sides)[:, :, None]])[0].low[0])

    try:
        running, terminal = bound(form.running, "state"), bound(form.terminal, "terminal")
    except (RuntimeError, NotImplementedError, ProblemError):  # signals, tables, operations without rules
        return -np.inf
    return terminal + running * float((along.bounds[0][places["horizon"]] if running >= 0 else longest)[0])


def is_convex(along: Linearisation) -> bool:
    """Return whether the problem is convex, so that every extremal is a global optimum (Mangasarian 1966).

    That is the case for a fixed horizon, dynamics and equalities that are affine in states and controls, convex
    quadratic costs, and inequalities that bound convex quadratic expressions from above or concave ones from below; all
    with coefficients that may depend on time.
    """
    form, (low, high) = along.form, along.bounds
    if form.horizon_is_free:
        return False
    inside, ends = ca.vertcat(form.x, form.u), ca.vertcat(form.x, form.x0)

    def of(kind: str) -> np.ndarray:
        index = form.bounds.places[kind]
        return np.where(low[index] == high[index], 0, np.isfinite(low[index]) * 1 + np.isfinite(high[index]) * 2)

    parts = [(form.running, inside, 2), (form.terminal, ends, 2), *((rate, inside, 0) for rate in ca.vertsplit(form.f))]
    for kind, variables in (("path", inside), ("start", ends), ("end", ends)):
        rows = getattr(form, kind).expression
        parts += [(rows[i], variables, side) for i, side in enumerate(of(kind).tolist())]
    for expression, variables, side in parts:
        hessian = ca.hessian(expression, variables)[0]
        if hessian.nnz() == 0 or form.problem.symbols(hessian).is_zero():
            continue
        if side not in (1, 2) or ca.depends_on(hessian, ca.vertcat(inside, form.x0, form.u0)):
            return False
        n = variables.numel()
        values = form.sampled([hessian], *along.point[:-1])[0].reshape(-1, n, n) * (1.0 if side == 2 else -1.0)
        least = np.linalg.eigvalsh(values)[:, 0]
        if not (least >= -ROUNDING_SHARE * np.abs(values).max(axis=(1, 2))).all():
            return False
    return True


def clebsch(along: Linearisation, costate: np.ndarray, control: int) -> np.ndarray:
    """Return the generalised Legendre-Clebsch term of a control that enters linearly, along a plan. Shape (M,).

    It is -d/du of the second time derivative of H_u along the extremal, for this control u alone. A minimum on a
    singular arc requires that it is not negative (Kelley, Kopp, Moyer 1967).
    """
    form = along.form
    lam = form.sym("lam", form.nx)
    total = form.running + ca.dot(lam, form.f)

    def outputs() -> list[Any]:
        switching = ca.gradient(total, form.u)[control]
        for _ in range(2):
            change = ca.jtimes(switching, form.x, form.f) + ca.jacobian(switching, form.t)
            switching = change - ca.jtimes(switching, lam, ca.gradient(total, form.x))
        return [-ca.jacobian(switching, form.u)[control]]

    return np.asarray(form.sampled(outputs, *along.point[:-1], (lam, costate), cache_as=f"clebsch {control}")[0][:, 0])


def describe_singular_arcs(along: Linearisation, costate: np.ndarray, linear: np.ndarray, moved: np.ndarray) -> str:
    """Return text about the generalised Legendre-Clebsch condition along singular arcs; "" if there are none.

    Args:
        linear: Which controls enter linearly. Shape (nu,). moved: In which intervals they switch. Shape (N, nu).
    """
    clauses, t = "", along.t
    for i in np.flatnonzero(linear):
        arc = ~along.control_limits.near[:, i] & ~np.repeat(moved[:, i], along.shape[1])
        if not arc.any():
            continue
        values = clebsch(along, costate, int(i))[arc]
        size, label = np.abs(values).max(), along.form.control_labels[i]
        clauses += f"; control {label!r} is singular at times from {t[arc][0]:.4g} to {t[arc][-1]:.4g} s; there the "
        clauses += "generalised Legendre-Clebsch condition of order 1 "
        if not values.min() >= -LIMIT_SHARE * size:
            clauses += f"is violated at {t[arc][np.argmin(values)]:.4g} s"
        else:
            clauses += "holds, but is only necessary" if values.min() > LIMIT_SHARE * size else "is degenerate"
    return clauses


def find_control_multipliers(
    along: Linearisation, costate: np.ndarray, curved: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the multipliers of control limits at the Gauss points that best fit given costates.

    They minimise the gradient of T H in the controls, in units of their sizes. A limit that a plan reaches only at
    single points of an interval, as for piecewise constant controls, may be active across a gap elsewhere, where the
    loss due to this gap is less than that due to the gradient.

    Args:
        along: The plan.
        costate: Shape (M, nx).
        curved: T H_uu, shape (M, nu, nu); None if unknown. Limits are then inactive across gaps.

    Returns:
        multipliers: Multipliers per unit of the horizon fraction s. Shape (M, nu + r + a).
        across: Whether a limit is active across a gap. Shape (M,), bool.
    """
    unit, control_limits, mixed = along.control_size, along.control_limits, along.mixed.size
    gradient, directions = slope(along, costate) * unit, along.control_limits_u * unit
    inverse = pseudo_inverse_of(along, control_limits.near)
    multipliers = balance(gradient, directions, control_limits.lower, control_limits.upper, inverse=inverse)
    across = np.zeros(len(multipliers), bool)
    if curved is None or along.form.path.equality[along.mixed].all():
        return multipliers, across
    residual = np.abs(gradient + np.einsum("kmu,km->ku", directions, multipliers)).max(axis=1)
    largest_slope = float(np.abs(gradient).max())
    for k in np.flatnonzero(residual > SOLVER_SHARE * largest_slope):
        hessian = curved[k] * unit * unit[:, None]
        values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
        floor = FLAT_SHARE * (np.abs(gradient[k]).max() + np.abs(values).max())
        root = vectors / np.sqrt(np.maximum(values, floor))
        sides = []
        for i in range(len(multipliers[k])):
            is_equality = control_limits.lower[k, i] and control_limits.upper[k, i]
            if is_equality:
                sides.append((i, 1.0, 0.0, True))
            elif i < len(unit) + mixed:
                sides += [(i, 1.0, control_limits.above[k, i], False), (i, -1.0, control_limits.below[k, i], False)]
        sides = [side for side in sides if np.isfinite(side[2]) and np.abs(directions[k, side[0]]).max() > 0]
        which, sign, gap, free = (np.array(part) for part in zip(*sides, strict=True))
        rows = directions[k, which] * sign[:, None]
        size = np.abs(rows).max(axis=1)
        magnitudes = nnls((rows / size[:, None] @ root).T, -gradient[k] @ root, gap / size, free.astype(bool))
        multipliers[k] = 0.0
        np.add.at(multipliers[k], which, sign * magnitudes / size)
        across[k] = True
    return multipliers, across


def slope(along: Linearisation, costate: np.ndarray) -> np.ndarray:
    """Return the gradient of the Hamiltonian, times the horizon, with respect to the controls. Shape (M, nu)."""
    first = along.form.nx + 1
    return np.asarray(along.cost_y[:, first:] + np.einsum("kiu,ki->ku", along.rate_y[:, :, first:], costate))


def pseudo_inverse_of(along: Linearisation, active: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of the derivatives of active limits with respect to the scaled controls.

    ``active`` (M, m) is boolean. Shape (M, nu, m). It is cached with the plan: it does not depend on the costates.
    """
    key = np.packbits(active).tobytes()
    if key not in along.pseudo_inverses:
        rows = along.control_limits_u * along.control_size
        inverses = along.pseudo_inverses[key] = np.zeros(rows.transpose(0, 2, 1).shape)
        k = np.flatnonzero(active.any(axis=1))
        inverse = np.linalg.pinv(np.where(active[k, :, None], rows[k], 0.0), rcond=ROUNDING_SHARE)
        inverses[k] = np.where(active[k, None], inverse, 0.0)  # without rounding errors for other limits
    return along.pseudo_inverses[key]


def balance(
    gradient: np.ndarray, directions: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, inverse: np.ndarray
) -> np.ndarray:
    """Return multipliers of admissible sign that best balance a gradient, by least squares, at each point of a plan.

    Shape (M, m). They minimise |gradient + directions' multipliers|, and are at least zero for ``upper`` limits (M, m),
    at most zero for ``lower`` limits and free for both. ``inverse`` (M, n, m) is the pseudo-inverse of the directions
    of these limits.
    """
    multipliers = -np.einsum("knm,kn->km", inverse, gradient)
    sign, free, active = np.where(upper, 1.0, -1.0), lower & upper, lower | upper
    wrong_sign = (sign * multipliers < 0) & active & ~free
    for k in np.flatnonzero(wrong_sign.any(axis=1)):  # solve again with the sign constraints
        index = np.flatnonzero(active[k])
        columns = (directions[k, index] * sign[k, index, None]).T
        multipliers[k, index] = sign[k, index] * nnls(columns, -gradient[k], np.zeros(len(index)), free[k, index])
    return np.asarray(multipliers)


def reduced_slope(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Return the largest relative residual of the stationarity of the Hamiltonian at each point. Shape (M,)."""
    form = along.form
    if not form.nu:
        return np.zeros(len(along.s))
    unit, first = along.control_size, form.nx + 1
    residual = (slope(along, costate) + np.einsum("kmu,km->ku", along.control_limits_u, multipliers)) * unit
    rates = np.abs(along.rate_y[:, :, first:])
    parts = np.abs(along.cost_y[:, first:]) + np.einsum("kiu,ki->ku", rates, np.abs(costate))
    size = float((parts * unit).max(initial=0.0)) or 1.0
    return np.asarray(np.abs(residual).max(axis=1, initial=0.0) / size)


def nnls(matrix: np.ndarray, target: np.ndarray, price: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Solve a nonnegative least-squares problem with a linear cost; its ``free`` variables may have any sign.

    Minimise |matrix y - target|^2 / 2 + price . y by an active-set method (Lawson, Hanson 1974, chapter 23). Free
    entries have minimal norm.
    """
    y = np.zeros(matrix.shape[1])
    bound = ~free
    if free.any():
        inverse = np.linalg.pinv(matrix[:, free], rcond=ROUNDING_SHARE)
        rest = matrix[:, bound] - matrix[:, free] @ (inverse @ matrix[:, bound])
        rest_of_target = target - matrix[:, free] @ (inverse @ target)
        y[bound] = nnls(rest, rest_of_target, price[bound], np.zeros(int(bound.sum()), bool))
        y[free] = inverse @ (target - matrix[:, bound] @ y[bound])
        return y
    normal, right = matrix.T @ matrix, matrix.T @ target - price
    passive = np.zeros(len(y), bool)
    tolerance = 1e-13 * max(float(np.abs(right).max(initial=0.0)), float(np.finfo(float).tiny))
    for _ in range(3 * len(y)):
        gradient = np.where(passive, -np.inf, right - normal @ y)
        if gradient.max() <= tolerance:
            break
        passive[np.argmax(gradient)] = True
        while True:
            index = np.flatnonzero(passive)
            best = np.linalg.lstsq(normal[np.ix_(index, index)], right[index], rcond=1e-12)[0]
            negative = best <= 0
            if not negative.any():
                y[index] = best
                break
            ratio = y[index][negative] / np.maximum(y[index][negative] - best[negative], np.finfo(float).tiny)
            y[index] += float(np.clip(ratio.min(), 0.0, 1.0)) * (best - y[index])
            drop = index[negative & (y[index] <= 1e-15 * np.abs(y).max())]
            drop = drop if drop.size else index[negative][:1]
            y[drop], passive[drop] = 0.0, False
    return y


def groups(rows: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the distinct rows of an array (M, m), each with the indices of all rows that equal it."""
    members: dict[bytes, list[int]] = {}
    for k, row in enumerate(rows):
        members.setdefault(row.tobytes(), []).append(k)
    return [(rows[equal[0]], np.array(equal)) for equal in members.values()]


def control_loss(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """Return the cost reduction, to second order, that admissible control changes allow in each interval. Shape (N,).

    A control changes within its limits, and at most by its size if the Hamiltonian does not curve along it. Limits
    with multipliers stay active.

    Args:
        along: The plan.
        costate: Shape (M, nx).
        multipliers: Of the limits of the controls; their products with the gaps count. Shape (M, nu + r + a).
        curved: T H_uu. Shape (M, nu, nu).
    """
    nu, n = along.form.nu, along.shape[0]
    if not nu:
        return np.zeros(n)
    unit = along.control_size
    by_gaps = along.control_limits.charge(multipliers).sum(axis=1)
    gradient = slope(along, costate) + np.einsum("kmu,km->ku", along.control_limits_u, multipliers)
    gradient, curved_u, curved = gradient * unit, curved, curved * (unit * unit[:, None])
    low, high = (np.clip((side - along.u) / unit, -1e3, 1e3) for side in (along.low, along.high))
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    scale = float(np.abs(curved).max(initial=0.0)) or 1.0
    size = np.abs(along.control_limits_u * unit).max(axis=2)
    force = np.abs(multipliers) * size
    active = (force > FLAT_SHARE * np.abs(multipliers * size).max(initial=0.0)) | along.control_limits.equal
    active = active | (along.control_limits.lower & along.control_limits.upper & (size > 0))
    gain = np.zeros(len(by_gaps))
    while True:  # fix controls at limits that the step would violate: at most nu rounds
        blocked, inverse = active.copy(), pseudo_inverse_of(along, active)
        for pattern, members in groups(active):
            rows = along.control_limits_u[members][:, pattern] * unit
            projector = np.eye(nu) - inverse[members][:, :, pattern] @ rows
            step = _step(gradient[members], curved[members], projector, scale)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(step > 0, high[members] / step, np.where(step < 0, low[members] / step, np.inf))
            step = np.clip(ratio.min(axis=1, initial=1.0), 0.0, 1.0)[:, None] * step
            change = np.einsum("ku,ku->k", gradient[members], step)
            change += np.einsum("ku,kuv,kv->k", step, curved[members], step) / 2
            gain[members] = np.maximum(gain[members], -change)
            blocked[members, :nu] |= ratio <= ROUNDING_SHARE
        if (blocked == active).all():
            break
        active = blocked
    by_interval = ((by_gaps + gain) * along.share).reshape(n, -1).sum(axis=1)
    return np.asarray(by_interval + switching_loss(along, costate, curved_u))


def needle_loss(along: Linearisation, costate: np.ndarray) -> np.ndarray:
    """Return the cost, to first order, that needle variations of the controls save in each interval. Shape (N,).

    It is the integral of H(u) - H(v), Weierstrass's excess, over the best v of a grid of admissible values of each
    control. A plan may be a minimum among plans with similar controls and still cost more than a needle variation. The
    loss is zero without a grid if the Hamiltonian is at most quadratic in the controls, where its curvature decides.
    """
    form, (n, q), mixed = along.form, along.shape, along.mixed
    lam = form.sym("lam", form.nx)
    total = along.scaled[0] + ca.dot(lam, along.scaled[1])
    is_local = form.cached("local minimum", lambda: not ca.depends_on(ca.hessian(total, form.u)[0], form.u))
    if is_local or along.control_limits_u.shape[1] > form.nu + mixed.size:  # arcs of the states restrict the controls
        return np.zeros(n)
    low = np.where(np.isfinite(along.low), along.low, along.u.min(axis=0) - along.control_size)
    high = np.where(np.isfinite(along.high), along.high, along.u.max(axis=0) + along.control_size)
    count = form.nu * NEEDLES
    controls = np.tile(along.u, (count + 1, 1, 1))
    for i, place in np.ndindex(form.nu, NEEDLES):
        controls[1 + i * NEEDLES + place, :, i] = low[:, i] + (high - low)[:, i] * place / (NEEDLES - 1)
    x, _, t, horizon, p, (fraction, s) = along.point
    more = (fraction, np.tile(s, (count + 1, 1))), (lam, np.tile(costate, (count + 1, 1)))
    point = np.tile(x, (count + 1, 1)), controls.reshape(-1, form.nu), np.tile(t, count + 1), horizon, p
    values, rows = form.sampled(lambda: [total, along.scaled[2]], *point, *more, cache_as="excess")
    values, rows = values.reshape(count + 1, n * q), rows.reshape(count + 1, n * q, -1)[:, :, mixed]
    lower, upper = (side[form.bounds.places["path"][mixed]] for side in along.bounds)
    allowed = LIMIT_SHARE * along.sizes.path[mixed]
    admissible = ((rows >= lower - allowed) & (rows <= upper + allowed)).all(axis=2)
    excess = np.where(admissible & np.isfinite(values), values[0] - values, 0.0).max(axis=0)
    return np.asarray((excess * along.share).reshape(n, q).sum(axis=1))


def switching_loss(along: Linearisation, costate: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """Return the excess cost that the quadrature misses where a switching function changes sign. Shape (N,).

    A switching function is dH/du of a control in which H is linear. The integrand is max(slope, 0) and max(-slope, 0)
    times the distances to both limits. Args as in `control_loss`.
    """
    (n, q), unit = along.shape, along.control_size
    gradient, hessian = slope(along, costate) * unit, curved * (unit * unit[:, None])
    largest = max(float(np.abs(hessian).max(initial=0.0)), float(np.abs(gradient).max(initial=0.0)))
    linear = np.abs(hessian).max(axis=(0, 2), initial=0.0) <= FLAT_SHARE * largest
    if along.mixed.size or not linear.any():
        return np.zeros(n)
    m, gradient = int(linear.sum()), gradient[:, linear].reshape(n, q, -1)
    down, up = (
        np.maximum(sign * (side - along.u) / unit, 0.0)[:, linear] for sign, side in ((-1, along.low), (1, along.high))
    )
    changes_sign = (gradient.min(axis=1) < 0) & (gradient.max(axis=1) > 0)
    centred = along.places - along.weight @ along.places
    rate = np.einsum("j,kjm->km", along.weight * centred, gradient) / (along.weight @ centred**2)
    mean = np.einsum("j,kjm->km", along.weight, gradient)
    line = mean[:, None] + rate[:, None] * centred[:, None]
    first, last = mean + rate * (0.0 - along.weight @ along.places), mean + rate * (1.0 - along.weight @ along.places)
    missed = np.zeros((n, m))
    with np.errstate(divide="ignore", invalid="ignore"):
        for sign, distance in ((1.0, down), (-1.0, up)):
            a, b = np.maximum(sign * first, 0.0), np.maximum(sign * last, 0.0)
            exact = (b**2 - a**2) / (2 * sign * (last - first))
            quadrature = np.einsum("j,kjm->km", along.weight, np.maximum(sign * line, 0.0))
            width = np.minimum(distance.reshape(n, q, m).mean(axis=1), 1.0)
            missed += np.where(changes_sign, width * (exact - quadrature), 0.0)
    return np.asarray(along.width * missed.sum(axis=1))


def _step(gradient: np.ndarray, curved: np.ndarray, projector: np.ndarray, scale: float) -> np.ndarray:
    """Return the step of the controls that minimises a quadratic model of the Hamiltonian at each point.

    Along eigenvectors without curvature the step has length 1 before projection. Shapes of the arguments (k, nu),
    (k, nu, nu), (k, nu, nu). ``scale`` is the largest curvature.
    """
    nu = gradient.shape[1]
    projected = np.einsum("kuv,kv->ku", projector, gradient)
    # fixed directions get the largest curvature, so that rounding does not move along them
    reduced = projector @ curved @ projector + scale * (np.eye(nu) - projector)
    values, vectors = np.linalg.eigh((reduced + reduced.transpose(0, 2, 1)) / 2)
    component = np.einsum("kuv,ku->kv", vectors, projected)
    is_curved = values > FLAT_SHARE * scale
    step = np.where(is_curved, -component / np.where(is_curved, values, 1.0), -np.sign(component))
    step = np.where(np.abs(component) > MACHINE_SHARE * np.abs(gradient).max(axis=1, keepdims=True), step, 0.0)
    return np.asarray(projector @ np.einsum("kuv,kv->ku", vectors, step)[..., None])[..., 0]
