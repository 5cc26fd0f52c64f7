"""Second-order conditions: is the second variation of the cost positive along every feasible variation of a plan?

A stationary plan may be a maximum, a saddle point, or a minimum only up to a conjugate point. The second variation of
the cost (:mod:`ocp.audit.accessory`) is swept backwards stage by stage. The cost must curve upwards along all
variations of a stage that its own constraints and those of later stages leave free. The first stage at which it does
not is the conjugate point. The eigenvector there, continued with the optimal feedback, is a variation that lowers the
cost. The sweep is linear in the number of intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ocp.audit.accessory import AccessoryProblem, end_conditions
from ocp.audit.principle import describe_singular_arcs, global_optimum, groups
from ocp.problem.formulation import Formulation
from ocp.tolerances import FLAT_SHARE, ROUNDING_SHARE, SOLVER_SHARE


@dataclass(frozen=True)
class Curvature:
    """Result of the analysis of the second variation of the cost along a plan.

    Attributes:
        least: Smallest curvature of the cost over the feasible variations of a stage, including the optimal response of
            later stages, with controls in units of their spread, relative to the largest curvature. Negative if the
            plan is no minimum; inf if nothing is free to vary.
        time: Time of that stage, s; the conjugate point if ``least`` is negative. None if nothing is free.
        flat: Why the sweep is inconclusive, or "".
        direction: For a negative curvature a variation that lowers the cost: of the controls at the points ``t`` (M,
            nu) and of the states at the ends of the intervals (N + 1, nx). Else None.
        t: Times of the Gauss points, s. Shape (M,).
        starts: Variations of start and horizon as columns, and the curvature of the cost along each with optimal
            controls, 0 for no curvature. Shapes (nz, k), (k,). None if the sweep ends earlier.
        gain: Cost that the controls could save in each interval by the best variation, if active constraints stay
            active and the states respond. Shape (N,).
        start_slope: Remaining gradient of the cost with respect to start and horizon. Shape (nz,).
        proof: Why an extremal is a global optimum whatever the sweep finds, or "".
        dependent: Whether the sweep is inconclusive because constraints are nearly dependent.
    """

    least: float
    time: float | None
    flat: str
    direction: tuple[np.ndarray, np.ndarray] | None
    t: np.ndarray
    starts: tuple[np.ndarray, np.ndarray] | None = None
    gain: np.ndarray | None = None
    start_slope: np.ndarray | None = None
    proof: str = ""
    dependent: bool = False

    @property
    def upwards(self) -> bool | None:
        """Whether the second variation is positive along all feasible variations; None if inconclusive."""
        if self.flat:
            return None
        return bool(self.proof) or bool(self.least > FLAT_SHARE)

    def lost(self, slope: np.ndarray) -> float:
        """Return the cost, to second order, that a change of start and horizon can save.

        ``slope`` is the gradient of the cost with respect to the scaled start and horizon. Shape (nz,). Where the cost
        does not curve, start and horizon change by their scales at most.
        """
        if self.starts is None:
            return 0.0
        variations, curved = self.starts
        slopes = np.abs((slope if self.start_slope is None else slope + self.start_slope) @ variations)
        divisor = np.where(curved > 0, curved, 1.0)
        return float(np.where(curved > 0, slopes**2 / (2 * divisor), slopes).sum())


def curvature(accessory: AccessoryProblem) -> Curvature:
    """Compute, by a backward sweep, the second variation of the cost along a plan with known multipliers."""
    along = accessory.along
    if along.form.indifferent:
        return Curvature(np.inf, None, "", None, along.t)
    if not all(np.isfinite(part).all() for part in (accessory.rate, accessory.hessian, accessory.residual_slope)):
        return Curvature(np.nan, None, "the Hamiltonian is not finite along the plan", None, along.t)
    if accessory.obstacle:
        return Curvature(np.nan, None, accessory.obstacle, None, along.t)
    stages = _Linearised.of(accessory)
    result = _sweep(accessory, stages)
    if result.least <= FLAT_SHARE and accessory.weak.any():
        # an active limit without a multiplier blocks only one side of a direction
        result = _sweep(accessory, stages, weak=True)
        if result.least > FLAT_SHARE:
            reason = "the cost curves upwards only because of active limits without multipliers"
            return replace(result, flat=reason)
    if result.dependent:
        # The controls affect implied conditions only by the error of the plan: pass these on to earlier stages. This
        # frees more variations, so that an upward curvature remains conclusive.
        wider = _sweep(accessory, stages, SOLVER_SHARE)
        if wider.least > FLAT_SHARE and not wider.flat:
            result = wider
    if result.flat and (proof := global_optimum(along, accessory.negligible_cost)):
        return replace(result, flat="", proof=proof)
    if result.flat:
        arcs = describe_singular_arcs(along, accessory.adjoint.costate, accessory.linear_controls, accessory.moved)
        return replace(result, flat=result.flat + arcs)
    return result


def _sweep(
    accessory: AccessoryProblem, sweep: _Linearised, rank: float = ROUNDING_SHARE, weak: bool = False
) -> Curvature:
    """Compute the second variation of the cost along a plan by a backward sweep over all stages (mesh intervals).

    Cost, step and curvature of a stage refer to (z, 1, controls), so that they include the slope of the cost.

    Args:
        rank: Singular value below which gradients of constraints, scaled to length 1, count as linearly dependent.
        weak: Whether active limits without multipliers must stay active too.
    """
    stages = _reduce_stages(accessory, sweep, weak, rank)
    mesh, horizon, t = accessory.along.mesh, accessory.along.solution.horizon, accessory.along.t
    n, nz, nu = accessory.along.shape[0], accessory.nz, accessory.nu
    m, rows, scale = nz + 1, _unit_end_rows(sweep.end_rows), sweep.scale
    cost = np.zeros((m, m))
    cost[:nz, :nz] = sweep.end_cost
    least, time, inconclusive = np.inf, None, ""
    gains: list[np.ndarray] = []  # optimal feedback of each stage, from a state variation to the control variations
    gain = np.zeros(n)
    for k in reversed(range(n)):
        lift, move, stage_cost, remaining = stages[k]
        total = stage_cost + move.T @ (cost @ move)
        if len(rows):
            later_rows = unit_rows(rows @ move[:nz], rank)
            ((_, (inner,), (passed_on,)),) = _eliminate_controls(later_rows[None], m, rank)
            total, lift = inner.T @ total @ inner, lift @ inner
            remaining = np.vstack([remaining, passed_on])
        rows = unit_rows(remaining, rank)[:, :nz] if len(remaining) else remaining[:, :nz]
        stage_hessian, mixed, cost = total[m:, m:], total[m:, :m], total[:m, :m]
        response = mixed
        if len(stage_hessian):
            smallest = float(np.linalg.eigvalsh(stage_hessian)[0])
            if smallest / scale < least:
                least, time = smallest / scale, float(mesh[k] * horizon)
            if smallest > FLAT_SHARE * scale:
                response = np.linalg.solve(stage_hessian, mixed)
            else:
                values, vectors = np.linalg.eigh(stage_hessian)
                worst = lift[m:, m:] @ vectors[:, 0]
                if smallest < -FLAT_SHARE * scale:
                    if reason := _singular(accessory, k, worst):
                        return Curvature(least, time, reason, None, t)
                    return _confirmed_negative(accessory, sweep, gains, (least, time), first=k, controls=worst)
                label = _label(accessory.along.form, worst, nu)
                flat = f"the cost does not curve along control {label!r} at {mesh[k] * horizon:.4g} s"
                inconclusive, curved = inconclusive or flat, values > FLAT_SHARE * scale
                response = (vectors[:, curved] / values[curved]) @ (vectors[:, curved].T @ mixed)
            gain[k] = mixed[:, nz] @ response[:, nz] / 2
            cost = cost - mixed.T @ response
        cost = (cost + cost.T) / 2
        gains.append(lift[m:, :nz] - lift[m:, m:] @ response[:, :nz])
    start_rows = _unit_end_rows(sweep.start_rows)
    _, sizes, right = np.linalg.svd(unit_rows(np.vstack([rows, start_rows]), rank))
    basis = right[int(np.sum(sizes > rank)) :].T
    starts = basis, np.zeros(0)
    if basis.shape[1]:
        values, vectors = np.linalg.eigh(basis.T @ (cost[:nz, :nz] + sweep.start_cost) @ basis)
        if values[0] / scale < least:
            least, time = float(values[0] / scale), 0.0
        if values[0] < -FLAT_SHARE * scale:
            return _confirmed_negative(accessory, sweep, gains, (least, time), start=basis @ vectors[:, 0])
        if values[0] <= FLAT_SHARE * scale:
            inconclusive = inconclusive or "the cost does not curve along a variation of the start"
        starts = basis @ vectors, np.where(values > FLAT_SHARE * scale, values, 0.0)
    return Curvature(least, time, inconclusive, None, t, starts, gain, cost[:nz, nz])


class _Linearised(NamedTuple):
    """Linearised problem of all stages (mesh intervals) as a function of variations of their starts and controls.

    Attributes:
        whole: Variations of (z, u) at the Gauss points. Shape (N, q, nz + nu, nz + q nu).
        step, stage: State at the end and cost, as functions of (z, 1, controls).
            Shapes (N, nz + 1, nz + 1 + q nu), (N, nz + 1 + q nu, nz + 1 + q nu).
        metric: Square root of the quadrature weight of each point. Shape (N, q).
        end_cost, end_rows, start_cost, start_rows: See :func:`ocp.audit.accessory.end_conditions`.
        scale: Largest curvature along the controls of a stage.
    """

    whole: np.ndarray
    step: np.ndarray
    stage: np.ndarray
    metric: np.ndarray
    end_cost: np.ndarray
    end_rows: np.ndarray
    start_cost: np.ndarray
    start_rows: np.ndarray
    scale: float

    @classmethod
    def of(cls, accessory: AccessoryProblem) -> _Linearised:
        """Express the variations at the Gauss points by the variations of the interval starts and of the controls."""
        along, nz, nu = accessory.along, accessory.nz, accessory.nu
        (n, q), h = along.shape, along.width
        # variations at the Gauss points from those at the start of the interval and those of the controls
        rate = accessory.rate.reshape(n, q, nz, nz + nu)
        fed = h[:, None, None, None, None] * along.matrix[:, None, :, None] * rate[:, None].transpose(0, 1, 3, 2, 4)
        system = np.eye(q * nz) - fed[..., :nz].reshape(n, q * nz, q * nz)
        inputs = np.zeros((n, q * nz, nz + q * nu))
        inputs[:, :, :nz] = np.tile(np.eye(nz), (q, 1))
        inputs[:, :, nz:] = fed[..., nz:].reshape(n, q * nz, q * nu)
        # scale controls so that the length of a variation is the L2 norm of a function of time
        metric = np.sqrt(np.outer(h, along.weight))
        whole = np.zeros((n, q, nz + nu, nz + q * nu))
        whole[:, :, :nz] = np.linalg.solve(system, inputs).reshape(n, q, nz, -1)
        for j in range(q):
            whole[:, j, nz:, nz + j * nu : nz + (j + 1) * nu] = np.eye(nu)
        whole[..., nz:] /= np.repeat(metric, nu, axis=1)[:, None, None, :]
        weights, stacked = (metric**2)[:, :, None, None], whole.reshape(n, q * (nz + nu), -1)
        m = nz + 1
        without_one = np.delete(np.arange(m + q * nu), nz)
        step, stage = np.zeros((n, m, m + q * nu)), np.zeros((n, m + q * nu, m + q * nu))
        step[:, :nz, without_one] = (weights * rate).transpose(0, 2, 1, 3).reshape(n, nz, -1) @ stacked
        step[:, :m, :m] += np.eye(m)
        weighted = weights * (accessory.hessian.reshape(n, q, nz + nu, nz + nu) @ whole)
        curved = np.swapaxes(stacked, 1, 2) @ weighted.reshape(stacked.shape)
        for k, i in zip(*np.nonzero(accessory.moved), strict=True):
            area = np.zeros(nz + q * nu)
            area[nz + i :: nu] = h[k] * along.weight / metric[k] * accessory.range[i]
            curved[k] += accessory.switching[k, i] * np.outer(area, area)
        slope = np.zeros((n, q, nz + nu))
        slope[:, :, nz:] = weights[..., 0] * accessory.residual_slope.reshape(n, q, nu)
        stage[:, without_one[:, None], without_one] = curved
        stage[:, nz, without_one] = stage[:, without_one, nz] = (slope.reshape(n, 1, -1) @ stacked)[:, 0]
        ends = end_conditions(accessory)
        largest = np.abs(np.linalg.eigvalsh(stage[:, m:, m:])).max(initial=0.0) if nu else 0.0
        scale = float(max(largest, np.abs(ends[0]).max(initial=0.0) * FLAT_SHARE)) or 1.0
        return cls(whole, step, stage, metric, *ends, scale)


class _Stage(NamedTuple):
    """One stage (mesh interval) of the sweep, reduced to the f control variations that its constraints leave free.

    Attributes:
        lift: (z, 1, controls) as a function of (z, 1) and the free variations. Shape (nz + 1 + q nu, nz + 1 + f).
        move, bend: Step and cost as functions of (z, 1) and the free variations.
        rows: Remaining constraints on (z, 1), passed on to earlier stages. Shape (r, nz + 1).
    """

    lift: np.ndarray
    move: np.ndarray
    bend: np.ndarray
    rows: np.ndarray


def _reduce_stages(accessory: AccessoryProblem, sweep: _Linearised, weak: bool, rank: float) -> list[_Stage]:
    """Eliminate from each stage (mesh interval) the control variations that its own active constraints determine.

    Stages with the same active constraints are treated together.
    """
    n, q = accessory.along.shape
    nz, nu = accessory.nz, accessory.nu
    normals = accessory.normals.reshape(n, q, -1, nz + nu)
    active = (accessory.strong | accessory.weak if weak else accessory.strong).reshape(n, -1)
    parts = [active, accessory.node_strong[:-1], accessory.node_strong[1:], accessory.moved]
    ends = np.cumsum([part.shape[1] for part in parts])[:-1]
    reduced: dict[int, _Stage] = {}
    for pattern, members in groups(np.hstack(parts)):
        if not pattern.any():
            lift, remaining = np.eye(nz + 1 + q * nu), np.zeros((0, nz + 1))
            reduced |= {k: _Stage(lift, sweep.step[k], sweep.stage[k], remaining) for k in members.tolist()}
            continue
        at_points, at_start, at_end, switches = np.split(pattern, ends)
        whole = np.insert(sweep.whole[members], nz, 0.0, axis=3)
        rows = [normals[members, j][:, at] @ whole[:, j] for j, at in enumerate(at_points.reshape(q, -1))]
        rows.append(accessory.node_normals[members][:, at_start] @ np.eye(nz, whole.shape[3]))
        rows.append(accessory.node_normals[members + 1][:, at_end] @ sweep.step[members, :nz])
        for i in np.flatnonzero(switches):  # a shifted switch is a single variation, of the mean
            rows.append(whole[:, 1:, nz + i] - whole[:, :1, nz + i])
        for part, lifts, remaining in _eliminate_controls(np.concatenate(rows, axis=1), nz + 1, rank):
            k = members[part]
            cost = np.swapaxes(lifts, 1, 2) @ sweep.stage[k] @ lifts
            reduced |= zip(k.tolist(), map(_Stage, lifts, sweep.step[k] @ lifts, cost, remaining), strict=True)
    return [reduced[k] for k in range(n)]


def _eliminate_controls(rows: np.ndarray, nz: int, rank: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Eliminate the controls that linear constraints ``rows`` (K, r, nz + m) determine in K stages of m controls.

    Returns:
        For each group of L stages with equal ranks: their indices, (L,); states and controls from the states and the
        free controls, (L, nz + m, nz + f); and the rows (L, r', nz) of the states that contain no control, or less of
        it than the singular value `rank`.
    """
    size = rows.shape[2]
    lengths = np.linalg.norm(rows, axis=2, keepdims=True)
    nonzero = lengths > rank * np.maximum(1.0, lengths.max(axis=1, keepdims=True, initial=0.0))
    rows = np.where(nonzero, rows / np.where(nonzero, lengths, 1.0), 0.0)
    left, sizes, right = np.linalg.svd(rows[:, :, nz:])
    results = []
    for (count,), at in groups((sizes > rank).sum(axis=1, keepdims=True)):
        turned, of_states = np.swapaxes(left[at], 1, 2), rows[at][:, :, :nz]
        lift = np.zeros((len(at), size, size - count))
        lift[:, :nz, :nz] = np.eye(nz)
        solved = turned[:, :count] @ of_states / sizes[at, :count, None]
        lift[:, nz:, :nz] = -np.swapaxes(right[at, :count], 1, 2) @ solved
        lift[:, nz:, nz:] = np.swapaxes(right[at, count:], 1, 2)
        results.append((at, lift, turned[:, count:] @ of_states))
    return results


def unit_rows(rows: np.ndarray, rank: float) -> np.ndarray:
    """Return the rows of a matrix scaled to length 1, without rows that are zero up to a tolerance."""
    sizes = np.linalg.norm(rows, axis=1)
    nonzero = sizes > rank * max(1.0, float(sizes.max(initial=0.0)))
    return np.asarray(rows[nonzero] / sizes[nonzero, None])


def _unit_end_rows(rows: np.ndarray) -> np.ndarray:
    """Scale the gradients of end conditions to length 1, so that conditions on almost constant states count as well."""
    return unit_rows(rows / (np.linalg.norm(rows, axis=1).max(initial=0.0) or 1.0), ROUNDING_SHARE)


def _confirmed_negative(
    accessory: AccessoryProblem,
    sweep: _Linearised,
    gains: list[np.ndarray],
    curvature: tuple[float, float | None],
    *,
    first: int = 0,
    controls: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Curvature:
    """Return the result for negative curvature, undetermined if no admissible variation of the plan has this curvature.

    End conditions that path constraints imply are linearly dependent up to the error of the plan. A direction along
    which only this error is left does not count as free.

    Args:
        gains: Optimal feedback of the stages from the last one on; the variation follows it.
        curvature: Smallest curvature, and its time.
        first: Stage in which the variation begins.
        controls: Variation of the controls of this stage; None if the variation begins with a variation ``start``.
    """
    along, nz, nu, least, time = accessory.along, accessory.nz, accessory.nu, *curvature
    n, q = along.shape
    without_one = np.delete(np.arange(nz + 1 + q * nu), nz)
    step, stage = sweep.step[:, :nz, without_one], sweep.stage[:, without_one][:, :, without_one]
    z = np.zeros(nz) if start is None else start
    states, values = np.zeros((n + 1, nz)), np.zeros((n, q * nu))
    cost, violations = float(z @ sweep.start_cost @ z), [0.0]
    for k in range(first, n):
        states[k] = z
        values[k] = controls if controls is not None and k == first else gains[n - 1 - k] @ z
        inputs = np.concatenate([z, values[k]])
        cost += float(inputs @ stage[k] @ inputs)
        for j in range(k * q, (k + 1) * q):
            violation = accessory.normals[j][accessory.strong[j]] @ sweep.whole[k, j - k * q] @ inputs
            violations.append(np.abs(violation).max(initial=0.0))
        z = step[k] @ inputs
    states[n] = z
    cost += float(z @ sweep.end_cost @ z)
    violations.append(np.abs(sweep.end_rows @ z).max(initial=0.0))
    size = max(float(np.abs(states).max()), float(np.abs(values).max(initial=0.0)))
    length = float(np.sum(values**2) + (0.0 if start is None else start @ start))
    if not (cost < -FLAT_SHARE * sweep.scale * length and max(violations) < SOLVER_SHARE * size):
        reason = f"constraints are nearly dependent at {time or 0.0:.4g} s"
        return Curvature(least, time, reason, None, along.t, dependent=True)
    values = (values / np.repeat(sweep.metric, nu, axis=1)).reshape(n * q, nu) * accessory.range
    return Curvature(least, time, "", (values, states[:, : accessory.nx] * accessory.unit[: accessory.nx]), along.t)


def _singular(accessory: AccessoryProblem, k: int, controls: np.ndarray) -> str:
    """Return why a stage is inconclusive if the Hamiltonian is linear in one of the controls, else "".

    For a control that enters linearly the remaining curvature is of the order of the interval's width. A minimum on a
    singular arc is decided by the generalised Legendre-Clebsch condition, which is not checked here.
    """
    along, nz, nu = accessory.along, accessory.nz, accessory.nu
    q = along.shape[1]
    if accessory.moved[k].any():
        return ""
    hessian = accessory.hessian[k * q : (k + 1) * q, nz:, nz:]
    directions = controls.reshape(q, nu)
    curved = float(np.einsum("ju,juv,jv->", directions, hessian, directions))
    size = float(np.abs(accessory.hessian[:, nz:, nz:]).max(initial=0.0))
    if abs(curved) > FLAT_SHARE * size:
        return ""
    label, time = _label(along.form, controls, nu), along.t[k * q]
    return f"singular in control {label!r} at {time:.4g} s: the Hamiltonian does not curve along it"


def _label(form: Formulation, direction: np.ndarray, nu: int) -> str:
    """Return the name of the control that varies most in a given variation of the controls of a stage."""
    return form.control_labels[int(np.argmax(np.abs(direction).reshape(-1, nu).max(axis=0)))]
