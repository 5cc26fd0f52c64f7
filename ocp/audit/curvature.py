"""Second order: does the cost curve upwards along every feasible variation of a plan, and what does the plan lose?

A stationary plan may be a maximum, a saddle, or a minimum only until a conjugate point. Here the second variation of
the cost along the plan (:mod:`ocp.audit.accessory`) is swept backwards, stage by stage. What a stage's own constraints
and those carried over from later ones leave free must curve upwards; where it first does not is the conjugate point,
and the eigenvector continued with the optimal feedback is a variation that lowers the cost. The sweep is linear in
the number of intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ocp.audit.accessory import AccessoryProblem, end_conditions
from ocp.audit.principle import groups
from ocp.problem.formulation import Formulation
from ocp.tolerances import FLAT_SHARE, IMPLIED_SHARE, ROUNDING_SHARE, SOLVER_SHARE

__all__ = ["Curvature", "curvature"]


class Tied(NamedTuple):
    """Singular values of constraints, for rows of length 1, by the controls of a stage.

    Attributes:
        size: Below which they count as dependent. seen: Below which what is left is a constraint of the stages before;
            between both it is dropped.
    """

    size: float
    seen: float


INDEPENDENT = Tied(ROUNDING_SHARE, ROUNDING_SHARE)


@dataclass(frozen=True)
class Curvature:
    """The second variation of the cost along a plan.

    Attributes:
        least: Smallest curvature of the cost over a stage's feasible variations, the optimal ones after it included,
            with controls in units of their spread, relative to the largest; negative where the plan is no minimum. inf
            where nothing is free to vary.
        time: Where it is found, s: for a negative one the conjugate point. None where nothing is free.
        flat: Why the sweep does not decide, or "".
        direction: For a negative curvature a variation that lowers the cost: of the controls at the points ``t``
            (M, nu) and of the states at the ends of the intervals (N + 1, nx); else None.
        t: Times of the Gauss points, s. Shape (M,).
        starts: Variations of start and horizon, a column each, and the curvature of the cost along each, 0 where it is
            none, controls following at their best. Shapes (nz, k), (k,). None where the sweep does not come so far.
        won: What the controls could win in each interval, states following: by the best variation, active constraints
            held, in units of cost (N,). pull: Slope of the cost in the start that is left by it. Shape (nz,).
    """

    least: float
    time: float | None
    flat: str
    direction: tuple[np.ndarray, np.ndarray] | None
    t: np.ndarray
    starts: tuple[np.ndarray, np.ndarray] | None = None
    won: np.ndarray | None = None
    pull: np.ndarray | None = None

    @property
    def upwards(self) -> bool | None:
        """Whether the cost curves upwards along all feasible variations; None where that is not decided."""
        if self.flat:
            return None
        return bool(self.least > FLAT_SHARE)

    def lost(self, slope: np.ndarray) -> float:
        """What start and horizon could win, to second order, where the cost has this slope (nz,) in them.

        By their units at most where the cost does not curve.
        """
        if self.starts is None:
            return 0.0
        variations, curved = self.starts
        pull = np.abs((slope if self.pull is None else slope + self.pull) @ variations)
        bent = np.where(curved > 0, curved, 1.0)
        return float(np.where(curved > 0, pull**2 / (2 * bent), pull).sum())


def curvature(accessory: AccessoryProblem) -> Curvature:
    """Sweep the second variation of the cost along a plan whose multipliers are known."""
    along = accessory.along
    if along.form.indifferent:
        return Curvature(np.inf, None, "", None, along.t)
    if not all(np.isfinite(part).all() for part in (accessory.rate, accessory.hessian, accessory.left)):
        return Curvature(np.nan, None, "the Hamiltonian is not finite along the plan", None, along.t)
    if accessory.obstacle:
        return Curvature(np.nan, None, accessory.obstacle, None, along.t)
    stages = _Linearised.of(accessory)
    found = _sweep(accessory, stages, weak=False)
    if found.least <= FLAT_SHARE and accessory.weak.any():
        # a limit that is touched without a push takes away one side of a direction only
        inside = _sweep(accessory, stages, weak=True)
        if inside.least > FLAT_SHARE:
            why = "the cost curves upwards only because of limits that are touched without a push"
            return Curvature(inside.least, inside.time, why, None, along.t, *inside[4:7])
        found = inside
    if found.dependent:
        # conditions that others imply are seen by controls up to the error of the plan alone: they are for the stages
        # before; and without what is left of them there is more to vary: upwards all the more
        for tied in (Tied(SOLVER_SHARE, SOLVER_SHARE), Tied(IMPLIED_SHARE, ROUNDING_SHARE)):
            wider = _sweep(accessory, stages, weak=False, tied=tied)
            if wider.least > FLAT_SHARE and not wider.flat:
                found = wider
                break
    return Curvature(*found[:4], along.t, *found[4:7])


class _Swept(NamedTuple):
    """Least curvature, its time, why it is not decided, a direction that lowers the cost; the rest of `Curvature`.

    ``dependent``: Whether it is not decided because constraints are nearly dependent.
    """

    least: float
    time: float | None
    flat: str
    direction: tuple[np.ndarray, np.ndarray] | None
    starts: tuple[np.ndarray, np.ndarray] | None = None
    won: np.ndarray | None = None
    pull: np.ndarray | None = None
    dependent: bool = False


def _sweep(accessory: AccessoryProblem, along: _Linearised, weak: bool, tied: Tied = INDEPENDENT) -> _Swept:
    """The backward sweep over all stages, by solves where every stage curves upwards, else by eigenvectors.

    Args:
        weak: Whether what is touched without a push is held too.
        tied: Which constraints count as dependent.
    """
    stages = _freed(accessory, along, weak, tied)
    if not accessory.flat.any():
        found = _swept(accessory, along, stages, tied, upwards=True)
        if found is not None:
            return found
    found = _swept(accessory, along, stages, tied, upwards=False)
    assert found is not None
    return found


def _swept(
    accessory: AccessoryProblem, sweep: _Linearised, stages: list[_Stage], tied: Tied, upwards: bool
) -> _Swept | None:
    """The sweep. With ``upwards`` None where some stage does not curve upwards.

    Cost, step and curvature of a stage are those of (z, 1, controls), so that they hold the slope of the cost too.
    """
    mesh, horizon = accessory.along.mesh, accessory.along.solution.horizon
    n, nz, nu = accessory.along.shape[0], accessory.nz, accessory.nu
    m, rows, scale = nz + 1, _told(sweep.end_rows), sweep.scale
    cost = np.zeros((m, m))
    cost[:nz, :nz] = sweep.end_cost
    least, at, flat = np.inf, None, ""
    gains: list[_Gain] = []
    won = np.zeros(n)
    solid: dict[int, list[tuple[int, np.ndarray]]] = {}  # stages and their curvatures, by size
    for k in reversed(range(n)):
        lift, move, bend, above = stages[k]
        joined = bend + move.T @ (cost @ move)
        if len(rows):
            carried = rows_of_length_one(rows @ move[:nz], tied.size)
            ((_, (inner,), (unheld,)),) = _eliminated(carried[None], m, tied)
            joined, lift = inner.T @ joined @ inner, lift @ inner
            above = np.vstack([above, unheld])
        rows = rows_of_length_one(above, tied.size)[:, :nz] if len(above) else above[:, :nz]
        curve, mixed, cost = joined[m:, m:], joined[m:, :m], joined[:m, :m]
        answer = mixed
        if len(curve):
            if upwards:
                solid.setdefault(len(curve), []).append((k, curve))
                try:
                    answer = np.linalg.solve(curve, mixed)
                except np.linalg.LinAlgError:
                    return None
            else:
                values, vectors = np.linalg.eigh(curve)
                if values[0] / scale < least:
                    least, at = float(values[0] / scale), float(mesh[k] * horizon)
                if values[0] < -FLAT_SHARE * scale:
                    worst = lift[m:, m:] @ vectors[:, 0]
                    why = _singular(accessory, k, worst)
                    if why:
                        return _Swept(least, at, why, None)
                    return _confirmed(least, at, _variation(accessory, sweep, k, worst, gains), scale)
                curved = values > FLAT_SHARE * scale
                if not curved.all() and not flat:
                    label = _label(accessory.along.form, lift[m:, m:] @ vectors[:, 0], nu)
                    flat = f"the cost does not curve along control {label!r} at {mesh[k] * horizon:.4g} s"
                answer = (vectors[:, curved] / values[curved]) @ (vectors[:, curved].T @ mixed)
            won[k] = mixed[:, nz] @ answer[:, nz] / 2
            cost = cost - mixed.T @ answer
        cost = (cost + cost.T) / 2
        gains.append(_Gain(lift[m:], answer))
    for curves in solid.values():
        smallest = np.linalg.eigvalsh(np.array([curve for _, curve in curves]))[:, 0] / scale
        i = int(np.argmin(smallest))
        if not smallest[i] > FLAT_SHARE:
            return None
        if smallest[i] < least:
            least, at = float(smallest[i]), float(mesh[curves[i][0]] * horizon)
    begins = _told(sweep.start_rows)
    _, sizes, right = np.linalg.svd(rows_of_length_one(np.vstack([rows, begins]), tied.size))
    basis = right[int(np.sum(sizes > tied.size)) :].T
    starts = basis, np.zeros(0)
    if basis.shape[1]:
        values, vectors = np.linalg.eigh(basis.T @ (cost[:nz, :nz] + sweep.start_cost) @ basis)
        if values[0] / scale < least:
            least, at = float(values[0] / scale), 0.0
        if values[0] < -FLAT_SHARE * scale:
            return _confirmed(least, at, _variation(accessory, sweep, 0, None, gains, basis @ vectors[:, 0]), scale)
        if values[0] <= FLAT_SHARE * scale:
            flat = flat or "the cost does not curve along a variation of the start"
        starts = basis @ vectors, np.where(values > FLAT_SHARE * scale, values, 0.0)
    return _Swept(least, at, flat, None, starts, won, cost[:nz, nz])


class _Linearised(NamedTuple):
    """The accessory problem of all stages: variations at the points from those at the start and of the controls.

    Attributes:
        whole: Variations of (z, u) at the points, (N, q, nz + nu, nz + q nu). step, stage: Those at the end, and the
            cost, from (z, 1, controls): (N, nz + 1, nz + 1 + q nu), (N, nz + 1 + q nu, nz + 1 + q nu).
        metric: Square root of the width that each point stands for. Shape (N, q).
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
        along, nz, nu = accessory.along, accessory.nz, accessory.nu
        (n, q), h = along.shape, along.width
        # variations at the Gauss points from those at the start of the interval and those of the controls
        rate = accessory.rate.reshape(n, q, nz, nz + nu)
        fed = h[:, None, None, None, None] * along.matrix[:, None, :, None] * rate[:, None].transpose(0, 1, 3, 2, 4)
        system = np.eye(q * nz) - fed[..., :nz].reshape(n, q * nz, q * nz)
        driven = np.zeros((n, q * nz, nz + q * nu))
        driven[:, :, :nz] = np.tile(np.eye(nz), (q, 1))
        driven[:, :, nz:] = fed[..., nz:].reshape(n, q * nz, q * nu)
        # controls in the metric of the quadrature: the length of their variation is that of a function of time
        metric = np.sqrt(np.outer(h, along.weight))
        whole = np.zeros((n, q, nz + nu, nz + q * nu))
        whole[:, :, :nz] = np.linalg.solve(system, driven).reshape(n, q, nz, -1)
        for j in range(q):
            whole[:, j, nz:, nz + j * nu : nz + (j + 1) * nu] = np.eye(nu)
        whole[..., nz:] /= np.repeat(metric, nu, axis=1)[:, None, None, :]
        share, together = (metric**2)[:, :, None, None], whole.reshape(n, q * (nz + nu), -1)
        m = nz + 1
        own = np.delete(np.arange(m + q * nu), nz)
        step, stage = np.zeros((n, m, m + q * nu)), np.zeros((n, m + q * nu, m + q * nu))
        step[:, :nz, own] = (share * rate).transpose(0, 2, 1, 3).reshape(n, nz, -1) @ together
        step[:, :m, :m] += np.eye(m)
        weighted = share * (accessory.hessian.reshape(n, q, nz + nu, nz + nu) @ whole)
        curved = np.swapaxes(together, 1, 2) @ weighted.reshape(together.shape)
        for k, i in zip(*np.nonzero(accessory.moved), strict=True):
            area = np.zeros(nz + q * nu)
            area[nz + i :: nu] = h[k] * along.weight / metric[k] * accessory.range[i]
            curved[k] += accessory.switching[k, i] * np.outer(area, area)
        slope = np.zeros((n, q, nz + nu))
        slope[:, :, nz:] = share[..., 0] * accessory.left.reshape(n, q, nu)
        stage[:, own[:, None], own] = curved
        stage[:, nz, own] = stage[:, own, nz] = (slope.reshape(n, 1, -1) @ together)[:, 0]
        ends = end_conditions(accessory)
        bends = np.abs(np.linalg.eigvalsh(stage[:, m:, m:])).max(initial=0.0) if nu else 0.0
        scale = float(max(bends, np.abs(ends[0]).max(initial=0.0) * FLAT_SHARE)) or 1.0
        return cls(whole, step, stage, metric, *ends, scale)


class _Stage(NamedTuple):
    """What its own constraints leave free of a stage: f variations of its controls, beside (z, 1).

    Attributes:
        lift: (z, 1, controls) from (z, 1) and from what is free. Shape (nz + 1 + q nu, nz + 1 + f).
        move, bend: Step and cost in these. rows: Of (z, 1), what is left for the stages before. Shape (r, nz + 1).
    """

    lift: np.ndarray
    move: np.ndarray
    bend: np.ndarray
    rows: np.ndarray


def _freed(accessory: AccessoryProblem, sweep: _Linearised, weak: bool, tied: Tied) -> list[_Stage]:
    """What its own constraints leave free of each stage: those with the same constraints all at once."""
    n, q = accessory.along.shape
    nz, nu = accessory.nz, accessory.nu
    normals = accessory.normals.reshape(n, q, -1, nz + nu)
    held = (accessory.strong | accessory.weak if weak else accessory.strong).reshape(n, -1)
    parts = [held, accessory.node_strong[:-1], accessory.node_strong[1:], accessory.moved]
    ends = np.cumsum([part.shape[1] for part in parts])[:-1]
    found: dict[int, _Stage] = {}
    for pattern, members in groups(np.hstack(parts)):
        if not pattern.any():
            lift, above = np.eye(nz + 1 + q * nu), np.zeros((0, nz + 1))
            found |= {k: _Stage(lift, sweep.step[k], sweep.stage[k], above) for k in members.tolist()}
            continue
        inside, first, last, moved = np.split(pattern, ends)
        whole = np.insert(sweep.whole[members], nz, 0.0, axis=3)
        own = [normals[members, j][:, at] @ whole[:, j] for j, at in enumerate(inside.reshape(q, -1))]
        own.append(accessory.node_normals[members][:, first] @ np.eye(nz, whole.shape[3]))
        own.append(accessory.node_normals[members + 1][:, last] @ sweep.step[members, :nz])
        for i in np.flatnonzero(moved):  # a switch moves: one variation, of the mean
            own.append(whole[:, 1:, nz + i] - whole[:, :1, nz + i])
        for part, lifts, above in _eliminated(np.concatenate(own, axis=1), nz + 1, tied):
            k = members[part]
            bend = np.swapaxes(lifts, 1, 2) @ sweep.stage[k] @ lifts
            found |= zip(k.tolist(), map(_Stage, lifts, sweep.step[k] @ lifts, bend, above), strict=True)
    return [found[k] for k in range(n)]


def _eliminated(rows: np.ndarray, nz: int, tied: Tied) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What rows (K, r, nz + m) of nz states and m controls leave free at K stages.

    Returns:
        Of the stages that are alike, L of them: which they are, (L,); states and controls from the states and from what
        is free of the controls, (L, nz + m, nz + f); and the rows (L, r', nz) of the states that no control sees. What
        controls see by less than counts is dropped, or counts as not seen.
    """
    both = rows.shape[2]
    lengths = np.linalg.norm(rows, axis=2, keepdims=True)
    keep = lengths > tied.size * np.maximum(1.0, lengths.max(axis=1, keepdims=True, initial=0.0))
    rows = np.where(keep, rows / np.where(keep, lengths, 1.0), 0.0)
    left, sizes, right = np.linalg.svd(rows[:, :, nz:])
    ranks, seen = (sizes > tied.size).sum(axis=1), (sizes > tied.seen).sum(axis=1)
    alike: dict[tuple[int, int], list[int]] = {}
    for k, kind in enumerate(zip(ranks.tolist(), seen.tolist(), strict=True)):
        alike.setdefault(kind, []).append(k)
    found = []
    for (rank, visible), members in alike.items():
        at = np.array(members)
        own, of_states = np.swapaxes(left[at], 1, 2), rows[at][:, :, :nz]
        lift = np.zeros((len(at), both, both - rank))
        lift[:, :nz, :nz] = np.eye(nz)
        lift[:, nz:, :nz] = -np.swapaxes(right[at, :rank], 1, 2) @ (own[:, :rank] @ of_states / sizes[at, :rank, None])
        lift[:, nz:, nz:] = np.swapaxes(right[at, rank:], 1, 2)
        found.append((at, lift, own[:, max(rank, visible) :] @ of_states))
    return found


class _Gain(NamedTuple):
    """How a stage's controls follow (z, 1): from these and what is free of them, and minus how that does."""

    lift: np.ndarray
    answer: np.ndarray

    def of(self, z: np.ndarray) -> np.ndarray:
        """The controls for a variation of the state."""
        both = np.append(z, 0.0)
        return np.asarray(self.lift @ np.concatenate([both, -self.answer @ both]))


def rows_of_length_one(rows: np.ndarray, rank: float) -> np.ndarray:
    """The same rows, each of length 1, without those that say nothing."""
    sizes = np.linalg.norm(rows, axis=1)
    keep = sizes > rank * max(1.0, float(sizes.max(initial=0.0)))
    return np.asarray(rows[keep] / sizes[keep, None])


def _told(rows: np.ndarray) -> np.ndarray:
    """Conditions at an end as rows of length 1: what they see of states that hardly move is small, and counts."""
    return rows_of_length_one(rows / (np.linalg.norm(rows, axis=1).max(initial=0.0) or 1.0), ROUNDING_SHARE)


class _Variation(NamedTuple):
    """A variation, twice its second variation per squared length of its controls, and how far it slips off its rows."""

    controls: np.ndarray
    states: np.ndarray
    curvature: float
    slip: float


def _variation(
    accessory: AccessoryProblem,
    sweep: _Linearised,
    first: int,
    controls: np.ndarray | None,
    gains: list[_Gain],
    start: np.ndarray | None = None,
) -> _Variation:
    """A variation that begins at an interval with these controls, or at the start, then follows the best feedback."""
    along, nz, nu = accessory.along, accessory.nz, accessory.nu
    n, q = along.shape
    own = np.delete(np.arange(nz + 1 + q * nu), nz)
    step, stage = sweep.step[:, :nz, own], sweep.stage[:, own][:, :, own]
    z = np.zeros(nz) if start is None else start
    states, values = np.zeros((n + 1, nz)), np.zeros((n, q * nu))
    cost, slips = float(z @ sweep.start_cost @ z), [0.0]
    for k in range(first, n):
        states[k] = z
        values[k] = controls if controls is not None and k == first else gains[n - 1 - k].of(z)
        both = np.concatenate([z, values[k]])
        cost += float(both @ stage[k] @ both)
        for j in range(k * q, (k + 1) * q):
            held = accessory.normals[j][accessory.strong[j]] @ sweep.whole[k, j - k * q] @ both
            slips.append(np.abs(held).max(initial=0.0))
        z = step[k] @ both
    states[n] = z
    cost += float(z @ sweep.end_cost @ z)
    slips.append(np.abs(sweep.end_rows @ z).max(initial=0.0))
    size = max(float(np.abs(states).max()), float(np.abs(values).max()))
    length = float(np.sum(values**2) + (0.0 if start is None else start @ start))
    values /= np.repeat(sweep.metric, nu, axis=1)
    shown = values.reshape(n * q, nu) * accessory.range, states[:, : accessory.nx] * accessory.unit[: accessory.nx]
    return _Variation(*shown, cost / length, max(slips) / size)


def _confirmed(least: float, at: float | None, found: _Variation, scale: float) -> _Swept:
    """A negative curvature is believed where the variation itself shows it: its cost falls and its constraints hold.

    Conditions at the ends that path constraints imply already are dependent up to the error of the plan, and what is
    left over of them then is no freedom.
    """
    if found.curvature < -FLAT_SHARE * scale and found.slip < SOLVER_SHARE:
        return _Swept(least, at, "", (found.controls, found.states))
    return _Swept(least, at, f"constraints are nearly dependent at {at or 0.0:.4g} s", None, dependent=True)


def _singular(accessory: AccessoryProblem, k: int, controls: np.ndarray) -> str:
    """Why the curvature along a stage's controls does not decide: the Hamiltonian itself does not curve along them.

    Where a control enters linearly, what is left is of the order of the interval's width, and the generalized condition
    of Legendre and Clebsch, not this one, tells a singular arc's minimum.
    """
    along, nz, nu = accessory.along, accessory.nz, accessory.nu
    q = along.shape[1]
    if accessory.moved[k].any():
        return ""
    own = accessory.hessian[k * q : (k + 1) * q, nz:, nz:]
    parts = controls.reshape(q, nu)
    curved = float(np.einsum("ju,juv,jv->", parts, own, parts))
    size = float(np.abs(accessory.hessian[:, nz:, nz:]).max(initial=0.0))
    if abs(curved) > FLAT_SHARE * size:
        return ""
    label, time = _label(along.form, controls, nu), along.t[k * q]
    return f"singular in control {label!r} at {time:.4g} s: the Hamiltonian does not curve along it"


def _label(form: Formulation, direction: np.ndarray, nu: int) -> str:
    """The control that a direction of a stage is made of most."""
    return form.control_labels[int(np.argmax(np.abs(direction).reshape(-1, nu).max(axis=0)))]
