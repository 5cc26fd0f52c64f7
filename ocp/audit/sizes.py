"""How large each named thing is along a plan: what every limit of the audit is relative to.

The size of a state or a control is its spread, the largest less the smallest of its values along the plan and of those
declared at its ends: neither its distance from the origin nor the width of its bounds, so that moving the origin,
changing a unit or naming a distant bound changes no verdict. The size of a constraint is that of what it is made of.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.problem.formulation import Bounds, Formulation, Rows
from ocp.solution import Solution

__all__ = ["FLOOR", "FineGrid", "Sizes", "changes", "fine_grid", "integral", "sizes", "sizes_along"]

GRID_FACTOR = 10  # times as fine as the plan's own points is the grid on which a plan is looked at
FLOOR = 1e-6  # of the largest value: what is smaller cannot be told from the solver's own tolerance
ROUNDING = 1e-9  # of the largest of its kind: what moves less stands still
HELD = 1e-2  # of what it is made of: a task that asks for less of a way is judged by this share of it
STILL = 1e-12  # SI units: what moves less, and is not told to move, stands still
PLACES = 32  # of the horizon, at which a constraint is looked at for what it is made of


@dataclass(frozen=True)
class FineGrid:
    """A plan at its fine grid: control intervals from start to end, so that interior mesh times stand twice.

    Attributes:
        t: Times, s. Shape (M,). interval, place: Interval of each time, and its place 0..1 there. Shape (M,).
        states, controls: The plan's interpolated values, from the side of the interval. Shape (M, nx), (M, nu).
        samples: Number of times of one interval.
    """

    t: np.ndarray
    interval: np.ndarray
    place: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    samples: int


def fine_grid(solution: Solution) -> FineGrid:
    """The plan at ten times its own points."""
    curve = solution.state_interpolant
    mesh = solution.control_interpolant.breaks
    n = len(mesh) - 1
    points, pieces = max(len(curve.nodes) - 1, 1), max((len(curve.breaks) - 1) // n, 1)
    steps = GRID_FACTOR * points * pieces
    places = np.linspace(0.0, 1.0, steps + 1)
    interval, place = np.repeat(np.arange(n), steps + 1), np.tile(places, n)
    width = np.diff(mesh)[interval]
    fractions = mesh[interval] + width * place
    inside = fractions + np.where(place > 0, -0.5, 0.5) / steps * width  # a time on a break belongs to this side
    piece = np.clip(np.searchsorted(curve.breaks, inside, side="right") - 1, 0, len(curve.breaks) - 2)
    start, end = curve.breaks[piece], curve.breaks[piece + 1]
    states = curve.within(piece, np.clip((fractions - start) / (end - start), 0.0, 1.0))
    controls = solution.control_interpolant.within(interval, place)
    return FineGrid(fractions * solution.horizon, interval, place, states, controls, steps + 1)


@dataclass(frozen=True)
class Sizes:
    """The size of everything that is judged along a plan, positive, in its own unit.

    Attributes:
        state, control: Of every entry, for one vector may hold metres and rad. Shape (nx,), (nu,).
        path, start, end, watch: Of every constraint row. Shape (rows,).
        cost: The integral of the running cost's absolute value, not below a millionth of what the cost is made of.
    """

    state: np.ndarray
    control: np.ndarray
    path: np.ndarray
    start: np.ndarray
    end: np.ndarray
    watch: np.ndarray
    cost: float


def sizes(form: Formulation, solution: Solution, p: np.ndarray, bounds: Bounds) -> Sizes:
    """The sizes of states, controls and constraints along a plan.

    What stands still at zero but for rounding has none: it is given a millionth of its least declared bound, of what is
    largest of its kind, or of one SI unit, whichever is least. A constraint is as large as it changes along the plan,
    or where one entry alone of its states or controls (of those at the start, too) is moved by that entry's size.
    """
    return sizes_along(form, fine_grid(solution), solution.horizon, p, bounds)


def sizes_along(form: Formulation, grid: FineGrid, horizon: float, p: np.ndarray, bounds: Bounds) -> Sizes:
    """As `sizes`, of a plan at its fine grid."""
    places = form.bounds.places
    ends = [
        np.where(low == high, low, np.nan) for low, high in (_of(bounds, places[k]) for k in ("initial", "terminal"))
    ]
    declared = _of(bounds, places["state"])
    state, moves = _sizes_of(np.vstack([grid.states, *ends]), declared, ends)
    declared = _of(bounds, places["control"])
    control, acts = _sizes_of(grid.controls, declared, [])
    entries = np.concatenate([state, control]), np.concatenate([moves, acts])
    path, start, end = (_rows_of(form, k, grid, horizon, p, bounds, entries) for k in ("path", "start", "end"))
    running = form.sampled([form.running], grid.states, grid.controls, grid.t, horizon, p)[0][:, 0]
    parts = np.where(np.isfinite(running), np.abs(running), 0.0)
    spent = float(np.sum(np.diff(grid.t) * (parts[:-1] + parts[1:]) / 2))
    made_of = [
        _made_of(form, what, grid, at, horizon, p, entries)[0][0]
        for what, at in ((form.running, spaced(grid)), (form.terminal, spaced(grid)[-1:]))
    ]
    watch = _watched(form, grid, horizon, p, bounds, entries)
    return Sizes(state, control, path, start, end, watch, max(spent, FLOOR * (horizon * made_of[0] + made_of[1])))


def spaced(grid: FineGrid) -> np.ndarray:
    """Some of the samples of a grid, from its first to its last."""
    last = len(grid.t) - 1
    return np.linspace(0, last, min(PLACES, last + 1)).astype(int)


def _of(bounds: Bounds, index: np.ndarray) -> Bounds:
    return bounds[0][index], bounds[1][index]


def _sizes_of(values: np.ndarray, declared: Bounds, ends: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of entries (n,) whose values are (M, n), and which of them move, or are told to be anywhere but at zero."""
    spread, largest = _spread(values)
    known = np.zeros(spread.shape, dtype=bool)
    for end in ends:
        known |= np.abs(np.nan_to_num(end)) > STILL
    return _floored(np.maximum(spread, FLOOR * largest), known, np.minimum(1.0, _least(declared)))


def _least(declared: Bounds) -> np.ndarray:
    """Absolute value of the nearer of two bounds that are neither zero nor infinite. Shape (n,)."""
    sides = np.abs(np.array(declared))
    return np.asarray(np.where(np.isfinite(sides) & (sides > 0), sides, np.inf).min(axis=0, initial=np.inf))


def _floored(
    size: np.ndarray, known: np.ndarray, least: np.ndarray, still: Any = STILL
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes, those of what stands still at zero not below the floor, and which of them do not stand still."""
    moves = known | (size > np.maximum(ROUNDING * size.max(initial=0.0), still))
    floor = FLOOR * np.minimum(least, size[moves].max() if moves.any() else 1.0)
    return np.where(moves, size, np.maximum(size, floor)), moves


def _spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest less smallest, and largest absolute value of each column (M, n), of what is finite. Shape (n,) each."""
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(finite, values, -np.inf).max(axis=0, initial=-np.inf)
    seen = low <= high
    low, high = np.where(seen, low, 0.0), np.where(seen, high, 0.0)
    return high - low, np.maximum(np.abs(low), np.abs(high))


def _rows_of(
    form: Formulation,
    kind: str,
    grid: FineGrid,
    horizon: float,
    p: np.ndarray,
    bounds: Bounds,
    entries: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Sizes of the rows of one kind. Shape (rows,)."""
    rows: Rows = getattr(form, kind)
    if len(rows) == 0:
        return np.zeros(0)
    some = spaced(grid)
    picked = some[:1] if kind == "start" else some[-1:] if kind == "end" else some
    made_of, moved, own, largest = _made_of(form, rows.expression, grid, picked, horizon, p, entries)
    if kind == "path":
        own, largest = _spread(form.sampled([rows.expression], grid.states, grid.controls, grid.t, horizon, p)[0])
    made_of = np.where(moved | (largest <= STILL), made_of, 0.0)  # what is there though nothing moves has a size
    size = np.maximum(np.maximum(own, made_of), FLOOR * largest)
    least = np.minimum(1.0, _least(_of(bounds, rows.bounds)))
    still, told = np.where(moved, 0.0, STILL), ~moved & (largest > STILL)
    for name in rows.names:
        mine = rows.of(name)
        size[mine] = _floored(size[mine], told[mine], least[mine], still[mine])[0]
    return np.asarray(size)


def _watched(
    form: Formulation,
    grid: FineGrid,
    horizon: float,
    p: np.ndarray,
    bounds: Bounds,
    entries: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Sizes of the watched rows: the longest way of those of one name, or what they are made of. Shape (rows,)."""
    rows = form.watch
    if len(rows) == 0:
        return np.zeros(0)
    made_of = _rows_of(form, "watch", grid, horizon, p, bounds, entries)
    made_of = np.where(form.watch_integral, horizon, 1.0) * made_of
    starts = (form.x0, grid.states[0]), (form.u0, grid.controls[0])
    rate = form.sampled([form.watch_way], grid.states, grid.controls, grid.t, horizon, p, *starts)[0]
    way = _spread(integral(rate, grid.t))[0]
    size = made_of.copy()
    for name in rows.names:
        mine = rows.of(name)
        if form.problem.declared.watch[name].way is not None:
            size[mine] = max(way[mine].max(), HELD * made_of[mine].max())
    return np.asarray(size)


def integral(rates: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Of columns (M, n) over times (M,), from the first to each. Shape (M, n)."""
    steps = np.diff(t)[:, None] * (rates[1:] + rates[:-1]) / 2
    return np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)])


def _made_of(
    form: Formulation,
    expression: Any,
    grid: FineGrid,
    picked: np.ndarray,
    horizon: float,
    p: np.ndarray,
    entries: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each row of an expression at some samples: the sum of its changes where one entry alone moves by its size.

    And whether anything that moves is in it, its spread, and its largest absolute value. Shape (rows,) each.
    """
    x, u = grid.states[picked], grid.controls[picked]
    begin = grid.states[0], grid.controls[0]
    here, change = changes(form, expression, (x, u, grid.t[picked]), begin, horizon, p, entries[0])
    change = change.max(axis=1)
    moves = np.resize(entries[1], len(change))
    told, every = change[moves].sum(axis=0), change.sum(axis=0)
    moved = told > ROUNDING * every
    return np.where(moved, told, every), moved, *_spread(here)


def changes(
    form: Formulation,
    expression: Any,
    samples: tuple[np.ndarray, np.ndarray, np.ndarray],
    begin: tuple[np.ndarray, np.ndarray],
    horizon: float,
    p: np.ndarray,
    moves: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of an expression at K samples, and by how much each changes where one entry alone moves.

    Args:
        samples: States (K, nx), controls (K, nu) and times (K,), s. begin: States and controls at the start.
        moves: Of each state and control, there or at the start, one way and the other. Shape (nx + nu,).

    Returns:
        Shapes (K, rows) and (entries, K, rows), the larger change of the two ways; entries at the start come last.
    """
    x, u, t = samples
    both, count = form.nx + form.nu, len(t)
    used = 2 * both if ca.depends_on(expression, ca.vertcat(form.x0, form.u0)) else both
    steps = np.vstack([np.zeros(2 * both), *(s * np.diag(np.concatenate([moves, moves]))[:used] for s in (1.0, -1.0))])
    at = np.tile(np.arange(count), len(steps))
    first = np.broadcast_to(np.concatenate(begin), (len(at), both))
    columns = np.hstack([x[at], u[at], first]) + np.repeat(steps, count, axis=0)
    x, u, x0, u0 = np.split(columns, np.cumsum([form.nx, form.nu, form.nx]), axis=1)
    found = form.sampled([expression], x, u, t[at], horizon, p, (form.x0, x0), (form.u0, u0))[0]
    g = found.reshape(len(steps), count, -1)
    change = np.abs(np.where(np.isfinite(g[1:] - g[0]), g[1:] - g[0], 0.0))
    return g[0], change.reshape(2, used, count, -1).max(axis=0)
