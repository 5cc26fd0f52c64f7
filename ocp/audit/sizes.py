"""How large each named thing is along a plan: what every limit of the audit is relative to.

The size of a state or a control is its spread, the largest less the smallest of its values along the plan and of those
declared at its ends: neither its distance from the origin nor the width of its bounds, so that moving the origin,
changing a unit or naming a distant bound changes no verdict. A free parameter, which has no spread, is as large as its
value. The size of a constraint is that of what it is made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import lagrange
from ocp.problem.declarations import Variable
from ocp.problem.formulation import Bounds, Formulation, Rows
from ocp.solution import Solution
from ocp.tolerances import HELD_SHARE, MACHINE_SHARE, ROUNDING_SHARE, SOLVER_SHARE, STANDSTILL

__all__ = ["FineGrid", "Sizes", "as_others", "changes", "fine_grid", "integral", "plan_at", "sizes", "sizes_along"]

GRID_FACTOR = 10  # times as fine as the plan's own points is the grid on which a plan is looked at
COSTS = ("running", "terminal")
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
    n = len(solution.control_interpolant.breaks) - 1
    points, pieces = max(len(curve.nodes) - 1, 1), max((len(curve.breaks) - 1) // n, 1)
    steps = GRID_FACTOR * points * pieces
    places = np.linspace(0.0, 1.0, steps + 1)
    states, controls, t = plan_at(solution, places)
    return FineGrid(t, np.repeat(np.arange(n), steps + 1), np.tile(places, n), states, controls, steps + 1)


@np.errstate(invalid="ignore")  # what is not a number is found by name
def plan_at(solution: Solution, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, controls and times at the same places (m,), 0..1, of all intervals, each from its side of a break.

    Shapes (N m, nx), (N m, nu), (N m,).
    """
    curve, control = solution.state_interpolant, solution.control_interpolant
    mesh, width, m = control.breaks, np.diff(control.breaks), len(places)
    n = len(width)
    fractions = mesh[:-1, None] + width[:, None] * places
    controls = (lagrange(control.nodes, places) @ control.values).reshape(n * m, control.values.shape[2])
    pieces, d = max((len(curve.breaks) - 1) // n, 1), len(curve.nodes)
    inside = places + np.where(places > 0, -0.1, 0.1) / (GRID_FACTOR * pieces * d)
    even = (mesh[:-1, None] + width[:, None] * (np.arange(pieces) / pieces)).ravel()
    same = len(even) == len(curve.breaks) - 1 and np.abs(even - curve.breaks[:-1]).max() < MACHINE_SHARE
    if same and np.isfinite(curve.values).all():
        piece = np.clip((inside * pieces).astype(int), 0, pieces - 1)
        basis = np.zeros((m, pieces, d))
        basis[np.arange(m), piece] = lagrange(curve.nodes, np.clip(places * pieces - piece, 0.0, 1.0))
        states = basis.reshape(m, -1) @ curve.values.reshape(n, pieces * d, -1)
        return states.reshape(n * m, curve.values.shape[2]), controls, fractions.ravel() * solution.horizon
    inner = mesh[:-1, None] + width[:, None] * inside
    piece = np.clip(np.searchsorted(curve.breaks, inner.ravel(), side="right") - 1, 0, len(curve.breaks) - 2)
    start, end = curve.breaks[piece], curve.breaks[piece + 1]
    states = curve.within(piece, np.clip((fractions.ravel() - start) / (end - start), 0.0, 1.0))
    return states, controls, fractions.ravel() * solution.horizon


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
    state, moves = _sizes_of(np.vstack([grid.states, *ends]), declared, ends, form.free_parameters)
    declared = _of(bounds, places["control"])
    control, acts = _sizes_of(grid.controls, declared, [], np.zeros(form.nu, dtype=bool))
    entries = np.concatenate([state, control]), np.concatenate([moves, acts])
    here = grid.states, grid.controls, grid.t, horizon, p, (form.x0, grid.states[0]), (form.u0, grid.controls[0])
    running, rows, way = form.sampled(
        [form.running, form.path.expression, form.watch_reference_rate], *here, cache_as="along a plan"
    )
    path = _rows_of(form, "path", grid, horizon, p, bounds, entries, rows)
    start, end, watch = (_rows_of(form, k, grid, horizon, p, bounds, entries) for k in ("start", "end", "watch"))
    parts = np.where(np.isfinite(running), np.abs(running), 0.0)[:, 0]
    spent = float(np.sum(np.diff(grid.t) * (parts[:-1] + parts[1:]) / 2))
    made_of = [
        _made_of(form, what, grid, at, horizon, p, entries)[0][0]
        for what, at in zip(COSTS, (spaced(grid), spaced(grid)[-1:]), strict=True)
    ]
    watch = _watched(form, watch, horizon, integral(way, grid.t))
    least = SOLVER_SHARE * (horizon * made_of[0] + made_of[1])
    return Sizes(state, control, path, start, end, watch, max(spent, least))


def spaced(grid: FineGrid) -> np.ndarray:
    """Some of the samples of a grid, from its first to its last."""
    last = len(grid.t) - 1
    return np.linspace(0, last, min(PLACES, last + 1)).astype(int)


def as_others(size: np.ndarray, places: Mapping[str, slice], declared: Mapping[str, Variable], below: float) -> None:
    """Give what hardly moves beside others of its unit their size: it might have moved as they do.

    Args:
        size: Of all states or controls, changed in place. Shape (n,).
        places, declared: Of these, by their names.
        below: Share of the largest of its unit.
    """
    largest: dict[str, float] = {}
    for name, place in places.items():
        unit = declared[name].unit or name
        largest[unit] = max(largest.get(unit, 0.0), float(size[place].max()))
    for name, place in places.items():
        others = largest[declared[name].unit or name]
        size[place] = np.where(size[place] <= below * others, others, size[place])


def _of(bounds: Bounds, index: np.ndarray) -> Bounds:
    return bounds[0][index], bounds[1][index]


def _sizes_of(
    values: np.ndarray, declared: Bounds, ends: list[np.ndarray], free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of entries (n,) whose values are (M, n), and which of them move, or are told to be anywhere but at zero.

    What is ``free`` (n,) cannot move along a plan: it is as large as it is, as a horizon is.
    """
    spread, largest = _spread(values)
    spread = np.where(free, largest, spread)
    known = np.zeros(spread.shape, dtype=bool)
    for end in ends:
        known |= np.abs(np.nan_to_num(end)) > STANDSTILL
    return _floored(np.maximum(spread, SOLVER_SHARE * largest), known, np.minimum(1.0, nearest_bound(declared)))


def nearest_bound(declared: Bounds) -> np.ndarray:
    """Absolute value of the nearer of two bounds that are neither zero nor infinite. Shape (n,)."""
    sides = np.abs(np.array(declared))
    return np.asarray(np.where(np.isfinite(sides) & (sides > 0), sides, np.inf).min(axis=0, initial=np.inf))


def _floored(
    size: np.ndarray, known: np.ndarray, least: np.ndarray, still: Any = STANDSTILL
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes, those of what stands still at zero not below the floor, and which of them do not stand still."""
    moves = known | (size > np.maximum(ROUNDING_SHARE * size.max(initial=0.0), still))
    floor = SOLVER_SHARE * np.minimum(least, size[moves].max() if moves.any() else 1.0)
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
    values: np.ndarray | None = None,
) -> np.ndarray:
    """Sizes of the rows of one kind, whose ``values`` (M, rows) along the grid may be known. Shape (rows,)."""
    rows: Rows = getattr(form, kind)
    if len(rows) == 0:
        return np.zeros(0)
    some = spaced(grid)
    picked = some[:1] if kind == "start" else some[-1:] if kind == "end" else some
    made_of, moved, own, largest = _made_of(form, kind, grid, picked, horizon, p, entries)
    if values is not None:
        own, largest = _spread(values)
    made_of = np.where(moved | (largest <= STANDSTILL), made_of, 0.0)  # what is there though nothing moves has a size
    size = np.maximum(np.maximum(own, made_of), SOLVER_SHARE * largest)
    least = np.minimum(1.0, nearest_bound(_of(bounds, rows.bounds)))
    still, told = np.where(moved, 0.0, STANDSTILL), ~moved & (largest > STANDSTILL)
    for name in rows.names:
        mine = rows.of(name)
        size[mine] = _floored(size[mine], told[mine], least[mine], still[mine])[0]
    return np.asarray(size)


def _watched(form: Formulation, made_of: np.ndarray, horizon: float, ways: np.ndarray) -> np.ndarray:
    """Sizes of the watched rows: the longest way of those of one name, or what they are made of. Shape (rows,).

    Args:
        made_of: Shape (rows,). ways: Along the grid. Shape (M, rows).
    """
    made_of = np.where(form.watch_integral, horizon, 1.0) * made_of
    way, size = _spread(ways)[0], made_of.copy()
    for name in form.watch.names:
        mine = form.watch.of(name)
        if form.problem.declared.watch[name].way is not None:
            size[mine] = max(way[mine].max(), HELD_SHARE * made_of[mine].max())
    return np.asarray(size)


def integral(rates: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Of columns (M, n) over times (M,), from the first to each. Shape (M, n)."""
    steps = np.diff(t)[:, None] * (rates[1:] + rates[:-1]) / 2
    return np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)])


def _made_of(
    form: Formulation,
    kind: str,
    grid: FineGrid,
    picked: np.ndarray,
    horizon: float,
    p: np.ndarray,
    entries: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each row of one kind at some samples: the sum of its changes where one entry alone moves by its size.

    And whether anything that moves is in it, its spread, and its largest absolute value. Shape (rows,) each.
    """
    x, u = grid.states[picked], grid.controls[picked]
    begin = grid.states[0], grid.controls[0]
    here, change = changes(form, kind, (x, u, grid.t[picked]), begin, horizon, p, entries[0])
    change = change.max(axis=1)
    moves = np.resize(entries[1], len(change))
    told, every = change[moves].sum(axis=0), change.sum(axis=0)
    moved = told > ROUNDING_SHARE * every
    return np.where(moved, told, every), moved, *_spread(here)


def changes(
    form: Formulation,
    kind: str,
    samples: tuple[np.ndarray, np.ndarray, np.ndarray],
    begin: tuple[np.ndarray, np.ndarray],
    horizon: float,
    p: np.ndarray,
    moves: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of one kind at K samples, and by how much each changes where one entry alone moves.

    Args:
        kind: ``path``, ``start``, ``end`` or ``watch``; or ``running`` or ``terminal`` for the cost.
        samples: States (K, nx), controls (K, nu) and times (K,), s. begin: States and controls at the start.
        moves: Of each state and control, there or at the start, one way and the other. Shape (nx + nu,).

    Returns:
        Shapes (K, rows) and (entries, K, rows), the larger change of the two ways; entries at the start come last.
    """
    x, u, t = samples
    both, count = form.nx + form.nu, len(t)
    expression = getattr(form, kind) if kind in COSTS else getattr(form, kind).expression
    tied = form.cached((kind, "tied"), lambda: ca.depends_on(expression, ca.vertcat(form.x0, form.u0)))
    used = 2 * both if tied else both
    steps = np.vstack([np.zeros(2 * both), *(s * np.diag(np.concatenate([moves, moves]))[:used] for s in (1.0, -1.0))])
    at = np.tile(np.arange(count), len(steps))
    first = np.broadcast_to(np.concatenate(begin), (len(at), both))
    columns = np.hstack([x[at], u[at], first]) + np.repeat(steps, count, axis=0)
    x, u, x0, u0 = np.split(columns, np.cumsum([form.nx, form.nu, form.nx]), axis=1)
    starts = (form.x0, x0), (form.u0, u0)
    found = form.sampled([expression], x, u, t[at], horizon, p, *starts, cache_as=(kind, "from the start"))[0]
    g = found.reshape(len(steps), count, -1)
    change = np.abs(np.where(np.isfinite(g[1:] - g[0]), g[1:] - g[0], 0.0))
    return g[0], change.reshape(2, used, count, -1).max(axis=0)
