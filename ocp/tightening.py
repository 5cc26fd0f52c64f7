"""Limits that hold between the points of a grid too.

A transcription holds inequalities at its points; between them a plan may go beyond by a power of the width. Here each
bound is drawn in, interval by interval, by what the plan exceeded it there, until nothing is exceeded any more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ocp.console import interruptible, time_left, time_limited
from ocp.direct.assembly import Fragment
from ocp.direct.mesh import check_meshed
from ocp.direct.prepared import DirectMethod
from ocp.errors import SolveError, checked_mapping, checked_time_limit
from ocp.problem.formulation import Formulation
from ocp.solution import NODE_TOLERANCE, ByName, Guess, Solution
from ocp.status import SolverStatus
from ocp.tolerances import SOLVER_SHARE

__all__ = ["largest_excess", "tighten"]


@dataclass(frozen=True)
class TighteningSettings:
    """How bounds are drawn in.

    Attributes:
        places: Looked at for each degree of the plan's polynomials in an interval.
        rounds: At most.
        followed: Share of a bound's move that the plan is taken to follow, until it is seen.
        least_followed: A plan that follows a bound's move by a smaller share is not moved by it.
    """

    places: int = 10
    rounds: int = 20
    followed: float = 0.8
    least_followed: float = 0.1


SETTINGS = TighteningSettings()


@interruptible
def tighten(
    problem: Any,
    method: DirectMethod,
    *,
    tolerance: float = SOLVER_SHARE,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
    time_limit: float | None = None,
    max_cost: float = np.inf,
) -> Solution:
    """Solve so that every inequality holds between the points of the grid as well.

    The plan is the optimum under bounds that are drawn in where it would have exceeded them, so it costs a little more
    than that of :func:`ocp.methods.solve`, by ``Solution.tightening_cost``; finer grids close the gap. Equalities are
    not touched: refine for them. The plan keeps the bounds that it was solved under, ``Solution.bound_tightening``: it is
    an optimum under those alone.

    Args:
        problem, parameters, solver, options, guess: As for :func:`ocp.methods.solve`.
        method: Collocation or MultipleShooting.
        tolerance: By how much a bound of a state or control or a path inequality may be exceeded, each in its own unit.
        time_limit: After so many seconds, the build and all solves included, the solver is stopped between two
            iterations, which counts as a failure. None for no limit.
        max_cost: Cost above which it gives up: what is drawn in adds to it.

    Raises:
        ProblemError: tolerance not positive, another method, a time limit that is none.
        SolveError: A solve failed, or the excess does not fall under the tolerance, not in time or not at the cost that
            it may have; says what remains and where. Where there was a plan before the time limit, it names
            ``time_limit`` and carries, as an unsuccessful one, the plan that exceeds its bounds least.
    """
    check_meshed("tighten", method, tolerance)
    with time_limited(checked_time_limit(time_limit)):
        return _tightened(problem, method, tolerance, parameters, solver, options, guess, time_limit, max_cost)


def _tightened(
    problem: Any,
    method: DirectMethod,
    tolerance: float,
    parameters: ByName,
    solver: str,
    options: ByName,
    guess: Guess,
    time_limit: float | None,
    max_cost: float,
) -> Solution:
    """:func:`tighten` inside its time limit."""
    prepared = method.prepare(problem, solver=solver, options=options)
    form, fragment = prepared.formulation, prepared.fragment
    p = form.parameter_vector(checked_mapping("tighten: parameters", parameters))
    bounds = form.bound_values(p)
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
    low, high = bounds[0][index], bounds[1][index]
    with np.errstate(invalid="ignore"):
        most = np.where(np.isfinite(high - low), (high - low) / 2, np.inf)
    places = _places(form, fragment, shared=method.control == "linear")
    drawn = np.zeros((2, len(fragment.mesh) - 1, len(index)))
    move, before, followed = np.zeros_like(drawn), np.zeros_like(drawn), np.full_like(drawn, SETTINGS.followed)
    best: tuple[Solution, str, dict[str, Any]] | None = None  # a plan, and what it exceeds most
    relaxed = np.inf  # cost of the plan that keeps the bounds at the points alone
    for _ in range(SETTINGS.rounds):
        moves = {}
        for kind, (entry, left, right) in places.items():
            both = np.maximum(drawn[:, left, entry], drawn[:, right, entry])
            moves[f"lb{kind}"], moves[f"ub{kind}"] = np.where(entry >= 0, both, 0.0)
        try:
            solution = prepared.solve(parameters, guess, tighter=moves)
        except SolveError as error:
            if best is None or time_left() > 0:
                raise
            plan, remains, _ = best
            words = f"{SolverStatus.TIME_LIMIT}: raise time_limit"
            plan = replace(plan, success=False, status=SolverStatus.TIME_LIMIT, message=words)
            told = f"problem {form.name!r}: tightening ended with {words}; {remains}"
            raise SolveError(told, plan, name="time_limit", value=time_limit) from error
        beyond, times = _excess(form, solution, p, low, high)
        if drawn.any():
            solution = replace(solution, bound_tightening=drawn, tightening_cost=max(solution.cost - relaxed, 0.0))
        else:
            relaxed = solution.cost
        if beyond.max(initial=0.0) <= tolerance:
            return solution
        remains, details = _worst(form, beyond, times)
        if solution.cost > max_cost:
            told = f"problem {form.name!r}: bounds drawn in cost {solution.cost:.6g} already, and {remains}"
            raise SolveError(told, solution, name="cost", value=solution.cost, limit=max_cost)
        if best is None or details["value"] < best[2]["value"]:
            best = solution, remains, details
        # as in the secant method, each bound by itself; one that its neighbours moved says nothing
        share = (before - beyond) / np.where(move > 0, move, np.inf)
        followed = np.where((beyond > 0) & (share > SETTINGS.least_followed), np.minimum(share, 1.0), followed)
        before, guess = beyond, solution
        # a bound that no point of an interval stands at is first drawn in as far as they are away from it
        rows = prepared.program.numbers.values(solution.variables, p)[1]
        room = _room({"x": solution.variables, "g": rows}, places, low, high, drawn.shape)
        stands = np.clip(np.where(np.isfinite(room), room, 0.0), drawn, most)
        move = np.minimum(np.where(beyond > tolerance / 2, beyond / followed, 0.0), most - stands)
        drawn = np.where(move > 0, stands + move, drawn)
    told = f"problem {form.name!r}: after {SETTINGS.rounds} rounds {remains}; take more intervals"
    raise SolveError(told, solution, limit=tolerance, **details)


def largest_excess(problem: Any, solution: Solution) -> float:
    """By how much a plan goes beyond a bound or inequality between the points of its grid, in the unit of that one."""
    form = Formulation.of(problem)
    p = form.parameter_vector(solution.parameters)
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
    low, high = (bound[index] for bound in form.bound_values(p))
    return float(_excess(form, solution, p, low, high)[0].max(initial=0.0))


def _worst(form: Formulation, beyond: np.ndarray, times: np.ndarray) -> tuple[str, dict[str, Any]]:
    """What goes furthest beyond its bound, in words and as the details of an error; see :func:`_excess`."""
    labels = [*form.state_labels, *form.control_labels, *form.path.labels]
    either = beyond.max(axis=0)
    k, i = np.unravel_index(int(np.argmax(either)), either.shape)
    worst = float(either[k, i])
    words = f"{labels[i]} still goes {worst:.3g} beyond its bound between {times[k]:.4g} and {times[k + 1]:.4g} s"
    return words, {"name": labels[i], "value": worst, "time": float(times[k])}


def _places(
    form: Formulation, fragment: Fragment, shared: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of variables ("x") and rows ("g"): which state, control or path row, else -1, and the intervals it stands in.

    Args:
        shared: Whether a control at a node belongs to both intervals; else it, and what contains it, may jump there.
    """
    entry_of = np.full(max(int(index.max(initial=0)) for index in form.bounds.places.values()) + 1, -1)
    offsets = {"state": 0, "initial": 0, "terminal": 0, "control": form.nx, "path": form.nx + form.nu}
    for kind, offset in offsets.items():
        index = form.bounds.places[kind]
        entry_of[index] = offset + np.arange(len(index))
    alone = np.concatenate([np.zeros(form.nx, bool), np.ones(form.nu, bool), form.path.uses_control, [False]]) & ~shared
    found, last = {}, len(fragment.mesh) - 2
    for kind, index, at in (
        ("x", fragment.variable_bounds, fragment.variable_fraction),
        ("g", fragment.row_bounds, fragment.row_fractions),
    ):
        left, right = (
            np.clip(np.searchsorted(fragment.mesh, at + slip) - 1, 0, last)
            for slip in (-NODE_TOLERANCE, NODE_TOLERANCE)
        )
        own = left if kind == "x" else np.clip(fragment.row_stages, 0, last)
        entry = entry_of[index]
        found[kind] = entry, np.where(alone[entry], own, left), np.where(alone[entry], own, right)
    return found


def _room(
    values: dict[str, np.ndarray],
    places: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    low: np.ndarray,
    high: np.ndarray,
    shape: tuple[int, ...],
) -> np.ndarray:
    """How near the points of every interval come to the bounds below and above, (2, N, m); inf without a point."""
    found = np.full(shape, np.inf)
    for kind, (entry, left, right) in places.items():
        given = entry >= 0
        at, value = entry[given], values[kind][given]
        for side, away in enumerate((value - low[at], high[at] - value)):
            for interval in (left, right):
                np.minimum.at(found[side], (interval[given], at), away)
    return found


def _excess(
    form: Formulation, solution: Solution, p: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Largest excess below and above the bounds (m,) in every interval, (2, N, m); ends of intervals, s."""
    breaks = solution.control_interpolant.breaks
    n = len(breaks) - 1
    pieces = (len(solution.state_interpolant.breaks) - 1) // n
    count = SETTINGS.places * (len(solution.state_interpolant.nodes) - 1) * pieces
    place = np.linspace(0.0, 1.0, count + 1)
    owner = np.repeat(np.arange(n), len(place))
    s = breaks[owner] + np.diff(breaks)[owner] * np.tile(place, n)
    x = solution.state_interpolant(s)
    u = solution.control_interpolant.within(owner, np.tile(place, n))
    horizon = solution.horizon
    g = form.sampled([form.path.expression], x, u, horizon * s, horizon, p)[0]
    given = np.where(low < high, 1.0, np.nan)  # equalities are not looked at
    values = np.hstack([x, u, g]) * given
    beyond = [
        _peaks(np.where(np.isfinite(part), part, -np.inf).reshape(n, len(place), -1)).clip(min=0.0)
        for part in (low - values, values - high)
    ]
    return np.stack(beyond), breaks * horizon


def _peaks(values: np.ndarray) -> np.ndarray:
    """Largest values of sampled curves (N, K, m), between the samples too, by parabolas. Shape (N, m)."""
    before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (after - before) ** 2 / (8 * (2 * here - before - after))
    top = np.isfinite(rise) & (here >= before) & (here >= after)
    between = np.where(top, here + np.where(top, rise, 0.0), -np.inf).max(axis=1, initial=-np.inf)
    return np.asarray(np.maximum(values.max(axis=1), between))
