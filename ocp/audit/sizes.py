"""Characteristic sizes of all quantities along a plan, to which the tolerances of the audit are relative.

The size of a state or control is its spread: the largest less the smallest of its values along the plan and at its
fixed ends. It depends neither on the distance from the origin nor on the width of the bounds, so that moving the
origin, changing a unit or declaring a distant bound changes no verdict. A free parameter has no spread; its size is its
value. The size of a constraint follows from the sizes of the quantities it depends on.
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
from ocp.tolerances import HELD_SHARE, LIMIT_SHARE, ROUNDING_SHARE, SOLVER_SHARE, STANDSTILL

GRID_FACTOR = 10  # refinement of the fine grid over the points of the plan
COSTS = ("running", "terminal")
N_SAMPLES = 32  # number of samples at which the dependence of a constraint on its variables is evaluated


@dataclass(frozen=True)
class FineGrid:
    """Samples of a plan on a fine grid, from start to end of every interval, so that interior mesh times occur twice.

    Attributes:
        t: Times, s. Shape (M,).
        states, controls: Interpolated values of the plan, from the side of the interval. Shape (M, nx), (M, nu).
        samples: Number of times in one interval.
        horizon: Duration of the plan, s.
        p: Parameters. Shape (np,).
    """

    t: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    samples: int
    horizon: float
    p: np.ndarray

    def point(self, form: Formulation, at: slice = slice(None)) -> tuple[Any, ...]:
        """Return states, controls, times and further data at samples `at`, the arguments of `Formulation.sampled`."""
        starts = (form.x0, self.states[0]), (form.u0, self.controls[0])
        return self.states[at], self.controls[at], self.t[at], self.horizon, self.p, *starts


def fine_grid(solution: Solution, p: np.ndarray) -> FineGrid:
    """Return the samples of a plan with parameters ``p`` on a grid with ten times as many points as the plan has."""
    curve = solution.state_interpolant
    n = len(solution.control_interpolant.breaks) - 1
    points, segments = max(len(curve.nodes) - 1, 1), max((len(curve.breaks) - 1) // n, 1)
    samples = GRID_FACTOR * points * segments + 1
    states, controls, t = plan_at(solution, np.linspace(0.0, 1.0, samples))
    return FineGrid(t, states, controls, samples, solution.horizon, p)


@np.errstate(invalid="ignore")  # nan is reported later, with its name
def plan_at(solution: Solution, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the states, controls and times of a plan at given positions, 0..1, in every mesh interval.

    Shapes (N m, nx), (N m, nu), (N m,) for m positions. At a break each value comes from the side of its interval.
    """
    curve, control = solution.state_interpolant, solution.control_interpolant
    mesh, width, m = control.breaks, np.diff(control.breaks), len(places)
    n = len(width)
    fractions = mesh[:-1, None] + width[:, None] * places
    controls = (lagrange(control.nodes, places) @ control.values).reshape(n * m, control.values.shape[2])
    segments, d = max((len(curve.breaks) - 1) // n, 1), len(curve.nodes)
    inside = places + np.where(places > 0, -0.1, 0.1) / (GRID_FACTOR * segments * d)
    inner = mesh[:-1, None] + width[:, None] * inside
    segment = np.clip(np.searchsorted(curve.breaks, inner.ravel(), side="right") - 1, 0, len(curve.breaks) - 2)
    start, end = curve.breaks[segment], curve.breaks[segment + 1]
    states = curve.within(segment, np.clip((fractions.ravel() - start) / (end - start), 0.0, 1.0))
    return states, controls, fractions.ravel() * solution.horizon


@dataclass(frozen=True)
class Sizes:
    """Characteristic sizes of all quantities along a plan, each positive and in the unit of its quantity.

    Attributes:
        state, control: Sizes of every entry, since one vector may combine m and rad. Shape (nx,), (nu,).
        path, start, end, watch: Sizes of every constraint row. Shape (rows,).
        cost: Integral of the absolute running cost, at least a millionth of the change of the cost with its variables.
    """

    state: np.ndarray
    control: np.ndarray
    path: np.ndarray
    start: np.ndarray
    end: np.ndarray
    watch: np.ndarray
    cost: float


def sizes(form: Formulation, grid: FineGrid, bounds: Bounds) -> Sizes:
    """Return the characteristic sizes of states, controls, constraints and cost for a plan sampled on its fine grid.

    A quantity that rests at zero but for rounding has no size of its own. Its size is a millionth of its smallest
    declared bound, of the largest size of its kind, or of one SI unit, whichever is least. The size of a constraint is
    its change along the plan, or the sum of its changes when single entries of the states or controls, also of those at
    the start, change by their sizes.
    """
    places = form.bounds.places
    fixed = (_select(bounds, places[kind]) for kind in ("initial", "terminal"))
    ends = [np.where(low == high, low, np.nan) for low, high in fixed]
    declared = _select(bounds, places["state"])
    state, state_moves = _sizes_of(np.vstack([grid.states, *ends]), declared, ends, form.free_parameters)
    declared = _select(bounds, places["control"])
    control, control_moves = _sizes_of(grid.controls, declared, [], np.zeros(form.nu, dtype=bool))
    entries = np.concatenate([state, control]), np.concatenate([state_moves, control_moves])
    outputs = [form.running, form.path.expression, form.watch_reference_rate]
    running, rows, path_lengths = form.sampled(outputs, *grid.point(form), cache_as="along a plan")
    path = _constraint_sizes(form, "path", grid, bounds, entries, rows)
    start, end = (_constraint_sizes(form, kind, grid, bounds, entries) for kind in ("start", "end"))
    absolute = np.where(np.isfinite(running), np.abs(running), 0.0)[:, 0]
    integral_of_cost = float(np.sum(np.diff(grid.t) * (absolute[:-1] + absolute[1:]) / 2))
    by_variables = [
        _change_by_variables(form, kind, grid, at, entries)[0][0]
        for kind, at in zip(COSTS, (evenly_spaced(grid), evenly_spaced(grid)[-1:]), strict=True)
    ]
    watch = _constraint_sizes(form, "watch", grid, bounds, _sizes_by_unit(form, entries))
    watch = _watched_row_sizes(form, watch, grid.horizon, integral(path_lengths, grid.t))
    floor = SOLVER_SHARE * (grid.horizon * by_variables[0] + by_variables[1])
    return Sizes(state, control, path, start, end, watch, max(integral_of_cost, floor))


def evenly_spaced(grid: FineGrid) -> np.ndarray:
    """Return the indices of evenly spaced samples of a grid, including the first and the last."""
    last = len(grid.t) - 1
    return np.linspace(0, last, min(N_SAMPLES, last + 1)).astype(int)


def share_sizes(size: np.ndarray, places: Mapping[str, slice], declared: Mapping[str, Variable], below: float) -> None:
    """Replace, in place, sizes (n,) that are at most a share `below` of the largest size of the same unit by this size.

    `places` and `declared` are the indices and declarations of the states or controls, by name.
    """
    largest: dict[str, float] = {}
    for name, place in places.items():
        unit = declared[name].unit or name
        largest[unit] = max(largest.get(unit, 0.0), float(size[place].max()))
    for name, place in places.items():
        size_of_unit = largest[declared[name].unit or name]
        size[place] = np.where(size[place] <= below * size_of_unit, size_of_unit, size[place])


def _select(bounds: Bounds, index: np.ndarray) -> Bounds:
    """Return the lower and upper bounds of a problem at given indices of its bound table."""
    return bounds[0][index], bounds[1][index]


def _sizes_of(
    values: np.ndarray, declared: Bounds, ends: list[np.ndarray], free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sizes of sampled states or controls, and a mask of those that vary or have a nonzero fixed end.

    Entries that are ``free`` (n,) are constant along a plan: like a horizon they have the size of their value.
    """
    spread, largest = _spread(values)
    spread = np.where(free, largest, spread)
    nonzero = (np.abs(np.nan_to_num(ends)) > STANDSTILL).any(axis=0)
    return _raise_to_floor(
        np.maximum(spread, SOLVER_SHARE * largest), nonzero, np.minimum(1.0, nearest_bound(declared))
    )


def nearest_bound(declared: Bounds) -> np.ndarray:
    """Return the smallest magnitude of finite, nonzero bounds of each quantity; inf if there are none. Shape (n,)."""
    sides = np.abs(np.array(declared))
    return np.asarray(np.where(np.isfinite(sides) & (sides > 0), sides, np.inf).min(axis=0, initial=np.inf))


def _raise_to_floor(
    size: np.ndarray, nonzero: np.ndarray, least: np.ndarray, still: Any = STANDSTILL
) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes, raised to a minimum for quantities that remain at zero, and a mask of all other quantities."""
    moves = nonzero | (size > np.maximum(ROUNDING_SHARE * size.max(initial=0.0), still))
    floor = SOLVER_SHARE * np.minimum(least, size[moves].max() if moves.any() else 1.0)
    return np.where(moves, size, np.maximum(size, floor)), moves


def _spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the range and the largest absolute value of the finite entries of each of n columns. Shape (n,) each."""
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(finite, values, -np.inf).max(axis=0, initial=-np.inf)
    has_values = low <= high
    low, high = np.where(has_values, low, 0.0), np.where(has_values, high, 0.0)
    return high - low, np.maximum(np.abs(low), np.abs(high))


def _constraint_sizes(
    form: Formulation,
    kind: str,
    grid: FineGrid,
    bounds: Bounds,
    entries: tuple[np.ndarray, np.ndarray],
    values: np.ndarray | None = None,
) -> np.ndarray:
    """Return the characteristic sizes of the constraints of one kind, for example "path". Shape (rows,).

    ``values`` (M, rows) are the row values along the grid, if known.
    """
    rows: Rows = getattr(form, kind)
    if len(rows) == 0:
        return np.zeros(0)
    chosen = evenly_spaced(grid)
    samples = chosen[:1] if kind == "start" else chosen[-1:] if kind == "end" else chosen
    change, moves, spread, largest = _change_by_variables(form, kind, grid, samples, entries)
    if values is not None:
        spread, largest = _spread(values)
    change = np.where(moves | (largest <= STANDSTILL), change, 0.0)  # a constant value has a size of its own
    size = np.maximum(np.maximum(spread, change), SOLVER_SHARE * largest)
    nearest = np.minimum(1.0, nearest_bound(_select(bounds, rows.bounds)))
    threshold, is_constant = np.where(moves, 0.0, STANDSTILL), ~moves & (largest > STANDSTILL)
    for name in rows.names:
        own = rows.of(name)
        size[own], _ = _raise_to_floor(*(part[own] for part in (size, is_constant, nearest, threshold)))
    return np.asarray(size)


def _sizes_by_unit(form: Formulation, entries: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sizes of states and controls, with much smaller sizes raised to the largest size of the same unit.

    A watched row is judged by the change that its variables could cause. At a singular configuration the joints that
    move may have no effect on it, and those with an effect stand still: their rounding errors do not measure the row.
    """
    size, declared = entries[0].copy(), form.problem.declared
    share_sizes(size[: form.nx], form.states, declared.states, LIMIT_SHARE)
    share_sizes(size[form.nx :], form.controls, declared.controls, LIMIT_SHARE)
    return size, np.ones_like(entries[1])


def _watched_row_sizes(
    form: Formulation, by_variables: np.ndarray, horizon: float, path_lengths: np.ndarray
) -> np.ndarray:
    """Return the size of each watched row: the length of its reference path, or the change `by_variables` without one.

    Shapes: (rows,) of `by_variables`, and (M, rows) of `path_lengths` along the grid.
    """
    by_variables = np.where(form.watch_integral, horizon, 1.0) * by_variables
    length, size = _spread(path_lengths)[0], by_variables.copy()
    for name in form.watch.names:
        own_rows = form.watch.of(name)
        if form.problem.declared.watch[name].way is not None:
            size[own_rows] = max(length[own_rows].max(), HELD_SHARE * by_variables[own_rows].max())
    return np.asarray(size)


def integral(rates: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Integrate sampled rates from the first time to each sample time by the trapezoidal rule. Shape (M, n)."""
    steps = np.diff(t)[:, None] * (rates[1:] + rates[:-1]) / 2
    return np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)])


def _change_by_variables(
    form: Formulation, kind: str, grid: FineGrid, samples: np.ndarray, entries: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return how strongly the constraints of one kind depend on states and controls, at given samples.

    Returns:
        Of each row, shape (rows,): the sum of its changes when single entries change by their sizes; whether an entry
        that moves along the plan enters it; its spread; its largest absolute value.
    """
    values, change = row_changes(form, kind, grid, samples, moves=entries[0])
    change = change.max(axis=1)
    moves = np.resize(entries[1], len(change))
    by_moving, by_all = change[moves].sum(axis=0), change.sum(axis=0)
    depends = by_moving > ROUNDING_SHARE * by_all
    return np.where(depends, by_moving, by_all), depends, *_spread(values)


def row_changes(
    form: Formulation, kind: str, grid: FineGrid, samples: np.ndarray, *, moves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of one kind of constraint at K samples, and their changes when one state or control changes.

    Args:
        kind: ``path``, ``start``, ``end`` or ``watch``; or ``running`` or ``terminal`` for the cost.
        grid: Plan, sampled on its fine grid.
        samples: Indices of the samples. Shape (K,).
        moves: Change of each state and control, also at the start, applied with both signs. Shape (nx + nu,).

    Returns:
        Shapes (K, rows) and (entries, K, rows): the larger change of both signs. Entries at the start come last.
    """
    x, u, t = grid.states[samples], grid.controls[samples], grid.t[samples]
    size, count = form.nx + form.nu, len(t)
    expression = getattr(form, kind) if kind in COSTS else getattr(form, kind).expression
    uses_start = form.cached((kind, "tied"), lambda: ca.depends_on(expression, ca.vertcat(form.x0, form.u0)))
    used = 2 * size if uses_start else size
    steps = np.vstack([np.zeros(2 * size), *(s * np.diag(np.concatenate([moves, moves]))[:used] for s in (1.0, -1.0))])
    sample = np.tile(np.arange(count), len(steps))
    first = np.broadcast_to(np.concatenate([grid.states[0], grid.controls[0]]), (len(sample), size))
    columns = np.hstack([x[sample], u[sample], first]) + np.repeat(steps, count, axis=0)
    x, u, x0, u0 = np.split(columns, np.cumsum([form.nx, form.nu, form.nx]), axis=1)
    starts = (form.x0, x0), (form.u0, u0)
    point = x, u, t[sample], grid.horizon, grid.p, *starts
    values = form.sampled([expression], *point, cache_as=(kind, "from the start"))[0]
    g = values.reshape(len(steps), count, -1)
    change = np.abs(np.where(np.isfinite(g[1:] - g[0]), g[1:] - g[0], 0.0))
    return g[0], change.reshape(2, used, count, -1).max(axis=0)
