"""How large each named thing is along a plan: what every limit of the audit is relative to.

The size of a state or a control is its spread, the largest less the smallest of its values along the plan and of those
declared at its ends: neither its distance from the origin nor the width of its bounds, so that moving the origin,
changing a unit or naming a distant bound changes no verdict. The size of a constraint is that of what it is made of.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ocp.problem.formulation import Bounds, Formulation, Rows
from ocp.solution import Solution

__all__ = ["FineGrid", "Sizes", "fine_grid", "sizes"]

GRID_FACTOR = 10  # times as fine as the plan's own points is the grid on which a plan is looked at
FLOOR = 1e-6  # of the largest value: what is smaller cannot be told from the solver's own tolerance
ROUNDING = 1e-9  # of the largest of its kind: what moves less stands still
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
        state, control: Of every entry; the entries of one named vector share the largest. Shape (nx,), (nu,).
        path, start, end: Of every constraint row. Shape (rows,).
    """

    state: np.ndarray
    control: np.ndarray
    path: np.ndarray
    start: np.ndarray
    end: np.ndarray


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
    state, moves = _sizes_of(form.states.values(), np.vstack([grid.states, *ends]), declared, ends)
    declared = _of(bounds, places["control"])
    control, acts = _sizes_of(form.controls.values(), grid.controls, declared, [])
    entries = np.concatenate([state, control]), np.concatenate([moves, acts])
    rows = [_rows_of(form, kind, grid, horizon, p, bounds, entries) for kind in ("path", "start", "end")]
    return Sizes(state, control, *rows)


def _of(bounds: Bounds, index: np.ndarray) -> Bounds:
    return bounds[0][index], bounds[1][index]


def _sizes_of(
    groups: Iterable[slice], values: np.ndarray, declared: Bounds, ends: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of entries (n,) whose values are (M, n), and which of them move, or are told to be anywhere but at zero."""
    spread, largest = _spread(values)
    known = np.any([np.nan_to_num(end) != 0 for end in ends], axis=0) if ends else np.zeros(spread.shape, dtype=bool)
    sides = np.abs(np.array(declared))
    bound = np.where(np.isfinite(sides) & (sides > 0), sides, np.inf).min(axis=0, initial=np.inf)
    least = np.ones_like(spread)
    for group in groups:
        spread[group], largest[group] = spread[group].max(initial=0.0), largest[group].max(initial=0.0)
        known[group], least[group] = known[group].any(), min(1.0, bound[group].min(initial=np.inf))
    return _floored(np.maximum(spread, FLOOR * largest), known, least)


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
    last = len(grid.t) - 1
    spaced = np.linspace(0, last, min(PLACES, last + 1)).astype(int)
    picked = {"path": spaced, "start": spaced[:1], "end": spaced[-1:]}[kind]

    entry, moves = (
        np.concatenate([part, part]) for part in entries
    )  # of the states and controls there, and of those at the start
    both = form.nx + form.nu
    used = 2 * both if kind == "end" and form.ties_ends else both
    steps = np.vstack([np.zeros(2 * both), *(s * np.diag(entry)[:used] for s in (1.0, -1.0))])
    at = np.tile(picked, len(steps))
    x, u = grid.states[at], grid.controls[at]
    first = np.broadcast_to(np.concatenate([grid.states[0], grid.controls[0]]), (len(at), both))
    columns = np.hstack([x, u, first]) + np.repeat(steps, len(picked), axis=0)
    x, u, x0, u0 = np.split(columns, np.cumsum([form.nx, form.nu, form.nx]), axis=1)
    more = (form.x0, x0), (form.u0, u0)
    g = form.sampled([rows.expression], x, u, grid.t[at], horizon, p, *more)[0].reshape(len(steps), len(picked), -1)
    change = np.abs(np.where(np.isfinite(g[1:] - g[0]), g[1:] - g[0], 0.0)).max(axis=1).reshape(2, used, -1).max(axis=0)
    own, largest = _spread(g[0])
    if kind == "path":
        own, largest = _spread(form.sampled([rows.expression], grid.states, grid.controls, grid.t, horizon, p)[0])
    told, every = change[moves[:used]].sum(axis=0), change.sum(axis=0)
    moved = told > ROUNDING * every
    made_of = np.where(moved, told, every)
    size = np.maximum(np.maximum(own, made_of), FLOOR * largest)
    sides = np.abs(np.array(_of(bounds, rows.bounds)))
    bound = np.where(np.isfinite(sides) & (sides > 0), sides, np.inf).min(axis=0)
    unknown, still = np.zeros(len(rows), dtype=bool), np.where(moved, 0.0, STILL)
    for name in rows.names:
        mine = rows.of(name)
        size[mine] = _floored(size[mine], unknown[mine], np.minimum(1.0, bound[mine]), still[mine])[0]
    return np.asarray(size)
