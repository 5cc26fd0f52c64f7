"""What the controls of a plan really do: integrated anew, knowing nothing of the transcription.

A plan that is nearly right is corrected (:mod:`ocp.audit.correction`). Where that leads nowhere, every interval is
integrated in the steps of the fine grid, which are halved where the error of a step says so: what happens between the
points of a plan, a push of a millisecond say, is met by a stage of some step.

How far every bound and constraint of a problem is missed along a plan, between its points too.

A constraint is judged by its size along the plan, and where it is missed most by how it changes right there: the square
of a distance hardly changes near zero, and a plan that goes through the middle of a thing misses little of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ocp.audit.correction import SETTINGS, Corrected, corrected
from ocp.audit.linearisation import Linearisation
from ocp.audit.sizes import FineGrid, Sizes, changes, integral
from ocp.console import check_time
from ocp.curves import dormand_prince_step, newton_coefficients
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.values import evaluate_in_blocks
from ocp.tolerances import LIMIT_SHARE, SOLVER_SHARE

__all__ = ["Reintegration", "Violation", "integrated", "reintegrate", "violations"]


@dataclass(frozen=True)
class Reintegration:
    """What the controls of a plan really do, on its fine grid.

    Attributes:
        t: Times, s; every interval from its start to its end, so that interior mesh times stand twice. Shape (M,).
        interval: Interval of each time. Shape (M,).
        states: Integrated from the start to the end. Shape (M, nx). Nan behind a breakdown.
        controls: Of the plan, from the side of the interval. Shape (M, nu).
        local: Integrated over each interval from the plan's own state at its start. Shape (M, nx).
        plan: The plan's interpolated states. Shape (M, nx).
        cost: Running cost integrated along ``states``. local_cost: along ``local``.
        errors: Distance of ``states`` from the plan, relative to the sizes, the largest of all states. Shape (M,).
        local_errors: The same of ``local``. Shape (M,).
        added: Sum of what the intervals up to each one leave between their end and the plan's next start. Shape (N,).
        broke_down: Time at which the integration could not go on, s, or None.
    """

    t: np.ndarray
    interval: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    local: np.ndarray
    plan: np.ndarray
    cost: float
    local_cost: float
    errors: np.ndarray
    local_errors: np.ndarray
    added: np.ndarray
    broke_down: float | None

    def carried_off(self, limit: float) -> bool:
        """Whether it is the growth of unstable dynamics that takes ``states`` further from the plan than ``limit``.

        Then they lose a plan that each interval keeps: what is left at the ends of the intervals, added up without
        growing, is less than a tenth of the distance where that exceeds the limit.
        """
        beyond = ~(self.errors <= limit)
        if not beyond.any():
            return False
        first = int(np.argmax(beyond))
        k = int(self.interval[first])
        here = self.local_errors[self.interval == k].max()
        return bool(self.added[k] + here <= limit / SETTINGS.grown)


def reintegrate(along: Linearisation, grid: FineGrid) -> Reintegration:
    """What the controls of a plan do over every interval and over the whole horizon."""
    sizes, starts = along.sizes, grid.states.reshape(-1, grid.samples, along.form.nx)[:, 0]
    local, states, local_cost, cost = corrected(along, grid) or integrated(along, grid)
    left = np.abs(local[:-1, -1] - starts[1:]) / sizes.state
    local, states = (part.reshape(grid.states.shape) for part in (local, states))
    lost = ~np.isfinite(states).all(axis=1)
    return Reintegration(
        grid.t,
        grid.interval,
        states,
        grid.controls,
        local,
        grid.states,
        cost,
        local_cost,
        _relative(states - grid.states, sizes.state),
        _relative(local - grid.states, sizes.state),
        np.concatenate([[0.0], np.cumsum(_worst(left))]),
        float(grid.t[np.argmax(lost)]) if lost.any() else None,
    )


def integrated(along: Linearisation, grid: FineGrid) -> Corrected:
    """The same as :func:`ocp.audit.correction.corrected`, step by step, whatever the plan says between its starts."""
    n, cells = int(grid.interval[-1]) + 1, grid.samples - 1
    flow = Flow(along)
    starts = grid.states.reshape(n, cells + 1, -1)[:, 0]
    after, steps = flow.integrate(np.repeat(np.arange(n), cells), starts)
    each = after.reshape(n, cells, -1)
    whole = flow.integrate(np.zeros(n * cells, dtype=int), starts[:1], steps)[0].reshape(n, cells, -1)
    chained = np.vstack([starts[:1], whole[:-1, -1, :-1]])
    both = (starts, each), (chained, whole)
    local, states = (np.concatenate([start[:, None], found[:, :, :-1]], axis=1) for start, found in both)
    return Corrected(local, states, float(each[:, -1, -1].sum()), float(whole[-1, -1, -1]))


def _relative(difference: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return _worst(np.abs(difference) / sizes)


def _worst(values: np.ndarray) -> np.ndarray:
    """Largest of each row, infinite where one is not a number. Shape (M,)."""
    return np.asarray(np.where(np.isnan(values), np.inf, values).max(axis=1, initial=0.0))


class Steps(NamedTuple):
    """Steps of an integration in their order: the cell of each, its place and its width in the interval. (S,) each."""

    cell: np.ndarray
    place: np.ndarray
    width: np.ndarray

    @classmethod
    def even(cls, cells: int, each: int) -> Steps:
        """One step a cell, of which an interval has ``each``."""
        cell = np.arange(cells)
        return cls(cell, (cell % each) / each, np.full(cells, 1.0 / each))

    @classmethod
    def together(cls, parts: list[Steps]) -> Steps:
        """The steps of several parts in order."""
        cell, place, width = (np.concatenate(values) for values in zip(*parts, strict=True))
        order = np.lexsort((place, cell))
        return cls(cell[order], place[order], width[order])


class Flow:
    """The dynamics and the running cost under the controls of a plan, to be integrated from any states."""

    def __init__(self, along: Linearisation) -> None:
        form, solution, sizes = along.form, along.solution, along.sizes
        curve, self._given = solution.control_interpolant, np.append(along.p, solution.horizon)
        differences = newton_coefficients(curve.nodes, curve.values).reshape(len(curve.values), -1)
        self._columns = np.column_stack([differences, curve.breaks[:-1], np.diff(curve.breaks)])
        self._tolerance = SETTINGS.tolerance * np.append(sizes.state, sizes.cost)
        name = "steps", curve.nodes.tobytes()
        self._step = form.cached(name, lambda: step_function(form, curve.nodes).mapaccum("steps", SETTINGS.block))
        self._intervals = len(curve.values)

    def integrate(self, chain: np.ndarray, starts: np.ndarray, steps: Steps | None = None) -> tuple[np.ndarray, Steps]:
        """States and cost at the ends of all cells, which divide the intervals evenly; nan where it breaks down.

        Args:
            chain: Which cells follow each other, increasing. Shape (cells,). starts: State of each chain at its start,
                where its cost is zero. Shape (chains, nx). steps: To begin with; None: one a cell.

        Returns:
            Shape (cells, nx + 1), and the steps that it took; where it breaks down, those that it tried last.
        """
        each = len(chain) // self._intervals
        found = np.full((len(chain), starts.shape[1] + 1), np.nan)
        cell, place, width = Steps.even(len(chain), each) if steps is None else steps
        now = np.hstack([starts, np.zeros((len(starts), 1))])
        taken: list[Steps] = []
        for _ in range(SETTINGS.rounds):
            own = chain[cell]
            first, last = np.diff(own, prepend=-1) > 0, np.diff(cell, append=len(chain)) > 0
            after, error = self._run(first, now[own], cell // each, place, width)
            before = np.where(first[:, None], now[own], np.roll(after, 1, axis=0))
            allowed = self._tolerance + SETTINGS.rounding * np.maximum(np.abs(before), np.abs(after))
            good = (error <= allowed).all(axis=1)  # what is not a number is not
            count = np.cumsum(~good)
            kept = count == (count - ~good)[first][np.cumsum(first) - 1]  # nothing before it in its chain is bad
            found[cell[kept & last]] = after[kept & last]
            now[own[kept]] = after[kept]  # the last of each chain stays
            taken.append(Steps(cell[kept], place[kept], width[kept]))
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = (error / allowed).max(axis=1)
            wanted = np.ceil(np.where(np.isfinite(ratio), ratio, np.inf) ** (1 / SETTINGS.order))
            known = np.isfinite(before).all(axis=1)  # what begins nowhere waits
            pieces = np.where(good | ~known, 1, np.clip(wanted, 2, SETTINGS.pieces)).astype(int)[~kept]
            cell, place, width = cell[~kept], place[~kept], width[~kept]
            if not pieces.size or pieces.sum() > SETTINGS.steps:
                break
            cell, place, width = (np.repeat(part, pieces) for part in (cell, place, width))
            number = np.arange(len(cell)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
            width = width / np.repeat(pieces, pieces)
            place = place + number * width
        return found, Steps.together([*taken, Steps(cell, place, width)])

    def _run(
        self, first: np.ndarray, starts: np.ndarray, interval: np.ndarray, place: np.ndarray, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and cost behind each step, each from those before it or, where it is a first one, from its start."""
        count, size = len(first), starts.shape[1]
        whole = -(-count // SETTINGS.block) * SETTINGS.block
        data = np.zeros((whole, self._step.size1_in(1)))  # what is left of the last block are steps of no width
        data[:, -len(self._given) :] = self._given
        data[:count, : -len(self._given)] = np.column_stack([first, starts, place, width, self._columns[interval]])
        now, after, errors = starts[0].copy(), np.empty((whole, size)), np.empty((whole, size))
        for at in range(0, whole, SETTINGS.blocks * SETTINGS.block):
            check_time()
            part = slice(at, at + SETTINGS.blocks * SETTINGS.block)
            evaluate_in_blocks(self._step, SETTINGS.block, data[part], [after[part], errors[part]], now)
        return after[:count], np.abs(errors[:count])


def step_function(form: Formulation, nodes: np.ndarray) -> Any:
    """One step (x, data) -> (x behind it, its error); x with the cost below it.

    Data are: whether to start anew, from where, place and width of the step in its interval, the divided differences
    of the control at ``nodes`` of the interval, start and width of the interval in fractions of the horizon, the
    parameters and the horizon.
    """
    function = form.function("f", [form.f, form.running], ["f", "running"])
    flat = function.is_a("SXFunction") and function.n_instructions() <= SETTINGS.inline
    sym, size, nw = (ca.SX if flat else ca.MX).sym, form.nx + 1, form.nu * len(nodes)
    x, data = sym("x", size), sym("data", 1 + size + 2 + nw + 2 + form.np + 1)
    new, start, place, width = data[0], data[1 : 1 + size], data[1 + size], data[2 + size]
    differences = ca.reshape(data[3 + size : 3 + size + nw], form.nu, len(nodes))
    s, h, p, horizon = data[3 + size + nw], data[4 + size + nw], data[5 + size + nw : -1], data[-1]

    def slope(within: float, state: Any) -> Any:
        at = place + within * width
        u = differences[:, -1]
        for i in range(len(nodes) - 2, -1, -1):
            u = differences[:, i] + (at - nodes[i]) * u
        return ca.vertcat(*function(state[: form.nx], u, (s + h * at) * horizon, horizon, p))

    after, error = dormand_prince_step(slope, ca.if_else(new, start, x), h * width * horizon)
    return ca.Function("step", [x, data], [after, error], {"cse": True})


@dataclass(frozen=True)
class Violation:
    """How far one bound or constraint is missed.

    Attributes:
        label: What it is, ``end of q``. name: Of the state, control or constraint.
        t: Times, s. Shape (K,).
        missed: Largest violation of its rows at each time, infinite for what is not a number. Shape (K,).
        shares: Largest violation relative to the size of the row. sizes: Of that row. Shape (K,) each.
    """

    label: str
    name: str
    t: np.ndarray
    missed: np.ndarray
    shares: np.ndarray
    sizes: np.ndarray


def violations(
    form: Formulation,
    again: Reintegration,
    states: np.ndarray,
    sizes: Sizes,
    bounds: Bounds,
    p: np.ndarray,
    horizon: float,
    share: float,
    reported: np.ndarray,
) -> list[Violation]:
    """How far every bound and constraint is missed, along some states (M, nx) on the fine grid.

    A constraint that declares a tolerance counts as no larger than that this is the ``share`` of its size that is let
    pass, and is judged along the ``reported`` states (M, nx) too, which are what is run.
    """
    lower, upper = bounds
    places = form.bounds.places
    found: list[Violation] = []
    first, last = slice(0, 1), slice(-1, None)
    for kind, pool, values, size, at, what in (
        ("state", form.states, states, sizes.state, slice(None), "bounds of"),
        ("control", form.controls, again.controls, sizes.control, slice(None), "bounds of"),
        ("initial", form.states, states, sizes.state, first, "start of"),
        ("terminal", form.states, states, sizes.state, last, "end of"),
    ):
        for name, place in pool.items():
            index = places[kind][place]
            low, high = lower[index], upper[index]
            given = np.isfinite(low) | np.isfinite(high)
            if kind in ("initial", "terminal"):
                given = low == high
            if np.any(given):
                over = beyond(values[at][:, place][:, given], low[given], high[given])
                found.append(judged(f"{what} {name}", name, again.t[at], over, size[place][given]))
    begin = states[0], again.controls[0]
    entries = LIMIT_SHARE * np.concatenate([sizes.state, sizes.control])
    whole = slice(None)
    here = states, again.controls, again.t, horizon, p, (form.x0, begin[0]), (form.u0, begin[1])
    outputs = [form.path.expression, form.watch.expression]
    along = dict(zip(("path", "watch"), form.sampled(outputs, *here, cache_as="rows along a plan"), strict=True))
    for kind, at in (("path", whole), ("start", first), ("end", last), ("watch", whole)):
        rows, size = getattr(form, kind), getattr(sizes, kind)
        if len(rows) == 0:
            continue
        x, u, t = states[at], again.controls[at], again.t[at]
        if kind in along:
            g = along[kind]
        else:
            starts = (form.x0, begin[0]), (form.u0, begin[1])
            g = form.sampled([rows.expression], x, u, t, horizon, p, *starts, cache_as=(kind, "from the start"))[0]
        over = beyond(_integrated(form, kind, g, t), lower[rows.bounds], upper[rows.bounds])
        limited = np.isfinite(rows.tolerance)
        if kind in along and limited.any():
            told = form.sampled(outputs, reported, *here[1:], cache_as="rows along a plan")[kind == "watch"]
            missed = beyond(_integrated(form, kind, told, t), lower[rows.bounds], upper[rows.bounds])
            over = np.where(limited, np.maximum(over, missed), over)
        size = np.tile(size, (len(t), 1))
        worst = np.argmax(over, axis=0), np.arange(len(rows))
        if kind != "watch" and np.any(over[worst] > SOLVER_SHARE * size[worst]):  # judged by how it changes there
            change = changes(form, kind, (x[worst[0]], u[worst[0]], t[worst[0]]), begin, horizon, p, entries)[1]
            by = change.sum(axis=0)[worst[1], worst[1]] / LIMIT_SHARE
            size[worst] = np.clip(by, SOLVER_SHARE * size[worst], size[worst])
        with np.errstate(divide="ignore"):
            size = np.minimum(size, rows.tolerance / share)
        for name in rows.names:
            mine = rows.of(name)
            found.append(judged(name, name, t, over[:, mine], size[:, mine]))
    return found


def _integrated(form: Formulation, kind: str, g: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Values of rows (K, m), of those that are watched as integrals their integrals over time."""
    return np.where(form.watch_integral, integral(g, t), g) if kind == "watch" else g


def beyond(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far values (K, m) are beyond their bounds, at least 0; infinite where they are not a number."""
    return np.where(np.isnan(values), np.inf, np.maximum(np.maximum(lower - values, values - upper), 0.0))


def judged(label: str, name: str, t: np.ndarray, over: np.ndarray, sizes: np.ndarray) -> Violation:
    """What is missed (K, m), and as shares of sizes (m,) or (K, m), by most at each time."""
    shares = over / sizes
    most = np.argmax(shares, axis=1)[:, None]
    size = np.take_along_axis(np.broadcast_to(sizes, over.shape), most, axis=1)[:, 0]
    return Violation(label, name, t, over.max(axis=1), shares.max(axis=1), size)
