"""Re-integration of the dynamics under the controls of a plan, and the violations of its bounds and constraints.

The re-integration uses nothing of the transcription. A plan that is nearly exact is corrected
(:mod:`ocp.audit.correction`). If the corrections do not converge, every interval is integrated in the steps of the fine
grid, and a step whose error is too large is split. A disturbance between the points of a plan, such as a force pulse of
a millisecond, is thereby met by a stage of some step.

Each constraint is judged by its size along the plan. Where it is violated most, it is judged by its local rate of
change: near zero the square of a distance hardly changes, so that a path through the middle of an obstacle would count
as a small violation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.correction import SETTINGS, IntegratedMotion, corrected_motion
from ocp.audit.linearisation import Linearisation
from ocp.audit.sizes import FineGrid, integral, row_changes
from ocp.console import check_time
from ocp.curves import dormand_prince_step, integrator, newton_coefficients
from ocp.problem.formulation import Formulation
from ocp.problem.values import evaluate_in_blocks
from ocp.solution import Solution
from ocp.tolerances import LIMIT_SHARE, SOLVER_SHARE


@dataclass(frozen=True)
class Reintegration:
    """States on the fine grid of a plan that result from integrating the dynamics under the plan's controls.

    Attributes:
        grid: The plan on its fine grid, with M samples.
        states: Integrated from the start to the end of the plan; nan after a breakdown. Shape (M, nx).
        local: Integrated over each interval from the plan's own state at its start. Shape (M, nx).
        cost: Running cost integrated along ``states``.
        local_cost: Running cost integrated along ``local``.
        errors: Largest difference of ``states`` from the plan, relative to the sizes of the states. Shape (M,).
        local_errors: The same for ``local``. Shape (M,).
        added: Cumulative sum of the defects: differences between the integrated end of each interval and the plan's
            state at the start of the next one. Shape (N,).
        breakdown_time: Time at which the integration fails, s, or None.
    """

    grid: FineGrid
    states: np.ndarray
    local: np.ndarray
    cost: float
    local_cost: float
    errors: np.ndarray
    local_errors: np.ndarray
    added: np.ndarray
    breakdown_time: float | None

    def is_unstable(self, limit: float) -> bool:
        """Return whether unstable dynamics explain why the re-integrated states leave the plan by more than ``limit``.

        This holds if the plan satisfies the dynamics within each interval: the defects, summed without growth, stay
        below a tenth of the limit up to the time at which the difference exceeds it.
        """
        beyond = ~(self.errors <= limit)
        if not beyond.any():
            return False
        k = int(np.argmax(beyond)) // self.grid.samples
        defect = self.local_errors.reshape(-1, self.grid.samples)[k].max()
        return bool(self.added[k] + defect <= limit / SETTINGS.growth)


def reintegrate(along: Linearisation) -> Reintegration:
    """Integrate the dynamics under the controls of a plan, over every interval and over the whole horizon."""
    sizes, grid = along.sizes, along.grid
    starts = grid.states.reshape(-1, grid.samples, along.form.nx)[:, 0]
    local, states, local_cost, cost = corrected_motion(along) or integrated_motion(along)
    defects = np.abs(local[:-1, -1] - starts[1:]) / sizes.state
    local, states = (part.reshape(grid.states.shape) for part in (local, states))
    failed = ~np.isfinite(states).all(axis=1)
    return Reintegration(
        grid,
        states,
        local,
        cost,
        local_cost,
        _worst(np.abs(states - grid.states) / sizes.state),
        _worst(np.abs(local - grid.states) / sizes.state),
        np.concatenate([[0.0], np.cumsum(_worst(defects))]),
        float(grid.t[np.argmax(failed)]) if failed.any() else None,
    )


def integrated_motion(along: Linearisation) -> IntegratedMotion:
    """Return the motion under the controls of a plan, integrated step by step with error control."""
    n, cells, flow = along.shape[0], along.grid.samples - 1, Flow(along)
    plan = along.grid.states.reshape(n, cells + 1, -1)
    starts = plan[:, 0]
    after, steps = flow.integrate(np.repeat(np.arange(n), cells), starts)
    by_interval = after.reshape(n, cells, -1)
    deviation = np.abs(by_interval[:, :, :-1] - plan[:, 1:]) / along.sizes.state
    # steps that fail beside the plan are too long for stiff dynamics; a motion that diverges leaves the plan before
    is_stiff = not np.isfinite(after).all() and not (deviation > 1.0).any()
    if is_stiff and (motion := stiff_motion(along, starts, cells)) is not None:
        return motion
    continuous = flow.integrate(np.zeros(n * cells, dtype=int), starts[:1], steps)[0].reshape(n, cells, -1)
    chained = np.vstack([starts[:1], continuous[:-1, -1, :-1]])
    motions = (starts, by_interval), (chained, continuous)
    local, states = (np.concatenate([start[:, None], values[:, :, :-1]], axis=1) for start, values in motions)
    return IntegratedMotion(local, states, float(by_interval[:, -1, -1].sum()), float(continuous[-1, -1, -1]))


def stiff_motion(along: Linearisation, starts: np.ndarray, cells: int) -> IntegratedMotion | None:
    """Return the motion under the controls of a plan, by implicit integration, which stiff dynamics require.

    Every interval has a number of `cells`, and `starts` (N, nx) are the states of the plan at their starts. The method
    is the backward differentiation formulas of CVODES. Returns None if it breaks down too.
    """
    form, curve, unit = along.form, along.solution.control_interpolant, along.sizes.state
    horizon, sizes = along.solution.horizon, {"z": form.nx, "w": curve.values[0].size, "at": 1, "s": 1, "h": 1}
    z, w, at, s, h = (ca.MX.sym(name, size) for name, size in sizes.items())
    u = _newton_polynomial(ca.reshape(w, form.nu, len(curve.nodes)), curve.nodes, at)
    function = form.function("f", [form.f, form.running], ["f", "running"])
    rate, running = function(unit * z, u, (s + h * at) * horizon, horizon, along.p)
    dae = {"x": z, "t": at, "p": ca.vertcat(w, s, h), "ode": h * horizon * rate / unit, "quad": h * horizon * running}
    places = np.linspace(0.0, 1.0, cells + 1)[1:].tolist()
    integrate = integrator("stiff", dae, places, tolerance=SETTINGS.tolerance, smooth=False)
    data = _control_columns(along.solution)
    motions: list[tuple[np.ndarray, float]] = []
    for chained in (False, True):
        values, cost = np.empty((len(starts), cells + 1, form.nx)), 0.0
        for k, inputs in enumerate(data):
            values[k, 0] = values[k - 1, -1] if chained and k else starts[k]
            try:
                result = integrate(x0=values[k, 0] / unit, p=inputs)
            except RuntimeError:
                return None
            values[k, 1:] = result["xf"].full().T * unit
            cost += float(result["qf"][-1])
        motions.append((values, cost))
    (local, local_cost), (states, cost) = motions
    return IntegratedMotion(local, states, local_cost, cost)


def _worst(values: np.ndarray) -> np.ndarray:
    """Return the largest entry of each row of an array; infinite for a row with nan. Shape (M,)."""
    return np.asarray(np.where(np.isnan(values), np.inf, values).max(axis=1, initial=0.0))


class Steps(NamedTuple):
    """Steps of a numerical integration, in increasing order of time.

    Attributes:
        cell: Grid cell (interval of the fine grid) of each step. Shape (S,).
        place, width: Start and width of each step as fractions of its interval. Shape (S,).
    """

    cell: np.ndarray
    place: np.ndarray
    width: np.ndarray


class Flow:
    """Integrator of the dynamics and the running cost under the controls of a plan, from given states."""

    def __init__(self, along: Linearisation) -> None:
        form, solution, sizes = along.form, along.solution, along.sizes
        curve, self._inputs = solution.control_interpolant, np.append(along.p, solution.horizon)
        self._columns = _control_columns(solution)
        self._tolerance = SETTINGS.tolerance * np.append(sizes.state, sizes.cost)
        name = "steps", curve.nodes.tobytes()
        self._step = form.cached(name, lambda: step_function(form, curve.nodes).mapaccum("steps", SETTINGS.block))
        self._intervals = len(curve.values)

    def integrate(self, chain: np.ndarray, starts: np.ndarray, steps: Steps | None = None) -> tuple[np.ndarray, Steps]:
        """Return the integrated states and cost at the ends of all grid cells; nan after the integration fails.

        Args:
            chain: Number of the chain of successive cells that each cell belongs to, increasing; the cells divide the
                mesh intervals evenly. Shape (cells,).
            starts: State at the start of each chain, where the cost is zero. Shape (chains, nx).
            steps: Initial steps; None for one step per cell.

        Returns:
            Values, shape (cells, nx + 1), and the accepted steps; after a breakdown also the steps tried last.
        """
        cells, each = np.arange(len(chain)), len(chain) // self._intervals
        values = np.full((len(chain), starts.shape[1] + 1), np.nan)
        even = Steps(cells, (cells % each) / each, np.full(len(chain), 1.0 / each))
        cell, place, width = even if steps is None else steps
        current = np.hstack([starts, np.zeros((len(starts), 1))])
        accepted: list[Steps] = []
        for _ in range(SETTINGS.rounds):
            own = chain[cell]
            first, last = np.diff(own, prepend=-1) > 0, np.diff(cell, append=len(chain)) > 0
            after, error = self._run(first, current[own], cell // each, place, width)
            before = np.where(first[:, None], current[own], np.roll(after, 1, axis=0))
            allowed = self._tolerance + SETTINGS.rounding * np.maximum(np.abs(before), np.abs(after))
            accurate = (error <= allowed).all(axis=1)  # False for nan
            failures = np.cumsum(~accurate)
            # no inaccurate step before it in its chain
            valid = failures == (failures - ~accurate)[first][np.cumsum(first) - 1]
            values[cell[valid & last]] = after[valid & last]
            current[own[valid]] = after[valid]  # the last value of each chain remains
            accepted.append(Steps(cell[valid], place[valid], width[valid]))
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = (error / allowed).max(axis=1)
            required = np.ceil(np.where(np.isfinite(ratio), ratio, np.inf) ** (1 / SETTINGS.order))
            started = np.isfinite(before).all(axis=1)  # a step without a finite start is tried later
            parts = np.where(accurate | ~started, 1, np.clip(required, 2, SETTINGS.splits)).astype(int)[~valid]
            cell, place, width = cell[~valid], place[~valid], width[~valid]
            if not parts.size or parts.sum() > SETTINGS.steps:
                break
            cell, place, width = (np.repeat(part, parts) for part in (cell, place, width))
            number = np.arange(len(cell)) - np.repeat(np.cumsum(parts) - parts, parts)
            width = width / np.repeat(parts, parts)
            place = place + number * width
        cell, place, width = (np.concatenate(part) for part in zip(*accepted, (cell, place, width), strict=True))
        order = np.lexsort((place, cell))
        return values, Steps(cell[order], place[order], width[order])

    def _run(
        self, first: np.ndarray, starts: np.ndarray, interval: np.ndarray, place: np.ndarray, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return states and cost after each of several integration steps, with error estimates.

        A step starts where the previous one ends or, where ``first`` is set, at its own start.
        """
        count, size = len(first), starts.shape[1]
        padded = -(-count // SETTINGS.block) * SETTINGS.block
        data = np.zeros((padded, self._step.size1_in(1)))  # the last block is filled with steps of zero width
        data[:, -len(self._inputs) :] = self._inputs
        data[:count, : -len(self._inputs)] = np.column_stack([first, starts, place, width, self._columns[interval]])
        state, after, errors = starts[0].copy(), np.empty((padded, size)), np.empty((padded, size))
        for at in range(0, padded, SETTINGS.blocks * SETTINGS.block):
            check_time()
            part = slice(at, at + SETTINGS.blocks * SETTINGS.block)
            evaluate_in_blocks(self._step, SETTINGS.block, data[part], [after[part], errors[part]], previous=state)
        return after[:count], np.abs(errors[:count])


def step_function(form: Formulation, nodes: np.ndarray) -> Any:
    """Return the CasADi Function of one Dormand-Prince integration step of states and cost, with its error estimate.

    (x, data) -> (x after the step, error), x being states and cost.
    The data are: whether to restart, the start state, place and width of the step in its interval, the divided
    differences of the control at ``nodes`` of the interval, start and width of the interval as fractions of the
    horizon, the parameters and the horizon.
    """
    function = form.function("f", [form.f, form.running], ["f", "running"])
    flat = function.is_a("SXFunction") and function.n_instructions() <= SETTINGS.inline
    sym, size, nw = (ca.SX if flat else ca.MX).sym, form.nx + 1, form.nu * len(nodes)
    x, data = sym("x", size), sym("data", 1 + size + 2 + nw + 2 + form.np + 1)
    restart, start, place, width = data[0], data[1 : 1 + size], data[1 + size], data[2 + size]
    differences = ca.reshape(data[3 + size : 3 + size + nw], form.nu, len(nodes))
    s, h, p, horizon = data[3 + size + nw], data[4 + size + nw], data[5 + size + nw : -1], data[-1]

    def slope(within: float, state: Any) -> Any:
        at = place + within * width
        u = _newton_polynomial(differences, nodes, at)
        return ca.vertcat(*function(state[: form.nx], u, (s + h * at) * horizon, horizon, p))

    after, error = dormand_prince_step(slope, ca.if_else(restart, start, x), h * width * horizon)
    return ca.Function("step", [x, data], [after, error], {"cse": True})


def _control_columns(solution: Solution) -> np.ndarray:
    """Return divided differences of the controls in each interval, with its start and width. Shape (N, nw + 2)."""
    curve = solution.control_interpolant
    differences = newton_coefficients(curve.nodes, curve.values).reshape(len(curve.values), -1)
    return np.column_stack([differences, curve.breaks[:-1], np.diff(curve.breaks)])


def _newton_polynomial(differences: Any, nodes: np.ndarray, at: Any) -> Any:
    """Evaluate, at `at`, the Newton polynomials whose divided differences are the columns of `differences`."""
    value = differences[:, -1]
    for i in range(len(nodes) - 2, -1, -1):
        value = differences[:, i] + (at - nodes[i]) * value
    return value


@dataclass(frozen=True)
class Violation:
    """Violation of one bound or constraint along a plan.

    Attributes:
        label: Description, such as ``end of q``.
        name: Name of the state, control or constraint.
        t: Times, s. Shape (K,).
        excess: Largest violation among the rows of the constraint at each time, infinite for nan. Shape (K,).
        shares: Largest violation relative to the size of its row. Shape (K,).
        sizes: Size of that row. Shape (K,).
    """

    label: str
    name: str
    t: np.ndarray
    excess: np.ndarray
    shares: np.ndarray
    sizes: np.ndarray


def violations(along: Linearisation, motion: Reintegration, states: np.ndarray, share: float) -> list[Violation]:
    """Return the violations of all bounds and constraints along re-integrated states on the fine grid.

    ``states`` have the shape (M, nx). If a constraint declares a tolerance, its size is at most that for which the
    allowed ``share`` equals the tolerance. It is then also judged along the states of the plan itself, which are the
    ones that are executed.
    """
    form, sizes, (lower, upper), places = along.form, along.sizes, along.bounds, along.form.bounds.places
    grid = replace(motion.grid, states=states)
    results: list[Violation] = []
    whole, first, last = slice(None), slice(0, 1), slice(-1, None)
    for kind, pool, values, size, at, description in (
        ("state", form.states, states, sizes.state, whole, "bounds of"),
        ("control", form.controls, grid.controls, sizes.control, whole, "bounds of"),
        ("initial", form.states, states, sizes.state, first, "start of"),
        ("terminal", form.states, states, sizes.state, last, "end of"),
    ):
        for name, place in pool.items():
            index = places[kind][place]
            low, high = lower[index], upper[index]
            bounded = low == high if kind in ("initial", "terminal") else np.isfinite(low) | np.isfinite(high)
            if np.any(bounded):
                excess = excess_over(values[at][:, place][:, bounded], low[bounded], high[bounded])
                results.append(_violation_of(f"{description} {name}", name, grid.t[at], excess, size[place][bounded]))
    entries = LIMIT_SHARE * np.concatenate([sizes.state, sizes.control])
    point = grid.point(form)
    outputs = [form.path.expression, form.watch.expression]
    sampled = dict(zip(("path", "watch"), form.sampled(outputs, *point, cache_as="rows along a plan"), strict=True))
    for kind, at in (("path", whole), ("start", first), ("end", last), ("watch", whole)):
        rows, size = getattr(form, kind), getattr(sizes, kind)
        if len(rows) == 0:
            continue
        t, g = grid.t[at], sampled.get(kind)
        if g is None:
            g = form.sampled([rows.expression], *grid.point(form, at), cache_as=(kind, "from the start"))[0]
        excess = excess_over(_with_integrals(form, kind, g, t), lower[rows.bounds], upper[rows.bounds])
        limited = np.isfinite(rows.tolerance)
        if kind in sampled and limited.any():
            both = form.sampled(outputs, motion.grid.states, *point[1:], cache_as="rows along a plan")
            g_reported = _with_integrals(form, kind, both[kind == "watch"], t)
            reported_excess = excess_over(g_reported, lower[rows.bounds], upper[rows.bounds])
            excess = np.where(limited, np.maximum(excess, reported_excess), excess)
        size = np.tile(size, (len(t), 1))
        at_max = np.argmax(excess, axis=0), np.arange(len(rows))
        # judge a violation by its local rate of change
        if kind != "watch" and np.any(excess[at_max] > SOLVER_SHARE * size[at_max]):
            _, change = row_changes(form, kind, grid, np.arange(len(grid.t))[at][at_max[0]], moves=entries)
            local_size = change.sum(axis=0)[at_max[1], at_max[1]] / LIMIT_SHARE
            size[at_max] = np.clip(local_size, SOLVER_SHARE * size[at_max], size[at_max])
        with np.errstate(divide="ignore"):
            size = np.minimum(size, rows.tolerance / share)
        for name in rows.names:
            own_rows = rows.of(name)
            results.append(_violation_of(name, name, t, excess[:, own_rows], size[:, own_rows]))
    return results


def _with_integrals(form: Formulation, kind: str, g: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return constraint values (K, m), integrated over time where a watched constraint limits an integral."""
    return np.where(form.watch_integral, integral(g, t), g) if kind == "watch" else g


def excess_over(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return how far values (K, m) lie outside their bounds: at least 0, infinite for nan."""
    return np.where(np.isnan(values), np.inf, np.maximum(np.maximum(lower - values, values - upper), 0.0))


def _violation_of(label: str, name: str, t: np.ndarray, excess: np.ndarray, sizes: np.ndarray) -> Violation:
    """Return the `Violation` of a vector constraint, from how far each entry is beyond its bounds.

    For each entry, `excess` is how far it is beyond its bounds, and `sizes` the magnitude that this is compared with.
    """
    shares = excess / sizes
    largest = np.argmax(shares, axis=1)[:, None]
    size = np.take_along_axis(np.broadcast_to(sizes, excess.shape), largest, axis=1)[:, 0]
    return Violation(label, name, t, excess.max(axis=1), shares.max(axis=1), size)
