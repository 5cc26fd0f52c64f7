"""Tightened bounds, so that plans satisfy their limits between grid points too.

A transcription enforces inequalities at its points; between them a plan may exceed them by a power of the interval
width. :func:`tighten` tightens each bound, interval by interval, by the excess of the plan, until nothing is exceeded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ocp.audit.sizes import plan_at
from ocp.console import interruptible, time_left, time_limited
from ocp.direct.assembly import Transcription
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import check_meshed
from ocp.errors import SolveError, SolverStatus, checked_time_limit, require
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem
from ocp.solution import ByName, Guess, Solution
from ocp.solution_data import NODE_TOLERANCE
from ocp.tolerances import SOLVER_SHARE


@dataclass(frozen=True)
class TighteningSettings:
    """Settings of :func:`tighten`, which solves a problem under tightened limits.

    Attributes:
        places, rounds: Evaluation points per interval and polynomial degree of the plan, and maximum number of rounds.
        followed: Assumed response of the plan to a change of a bound, as a share of the change, until it is observed.
        least_followed: Response below which a plan counts as unaffected by a bound.
    """

    places: int = 10
    rounds: int = 20
    followed: float = 0.8
    least_followed: float = 0.1


SETTINGS = TighteningSettings()


@interruptible
def tighten(
    problem: Problem,
    method: DirectMethod,
    *,
    tolerance: float = SOLVER_SHARE,
    parameters: ByName = None,
    options: ByName = None,
    guess: Guess = None,
    time_limit: float | None = None,
    max_cost: float = np.inf,
) -> Solution:
    """Solve a problem by IPOPT with limits tightened so that every inequality also holds between grid points.

    The plan is the optimum under bounds that are tightened where it would exceed them, so its cost is slightly above
    that of :func:`ocp.methods.solve`, by ``Solution.tightening_cost``; finer grids close the gap. Equalities are not
    tightened: refine for them. The plan is an optimum under the tightened bounds only, which it stores as
    ``Solution.bound_tightening``.

    Args:
        problem, parameters, options, guess: As for :func:`ocp.methods.solve`.
        method: Collocation or MultipleShooting.
        tolerance: Excess allowed of a bound of a state or control or of a path inequality, each in its own unit.
        time_limit: Time in s for the build and all solves, after which the solver stops at the next iteration and
            counts as failed. None for no limit.
        max_cost: Cost above which it gives up, as tightening increases the cost.

    Raises:
        ProblemError: tolerance not positive, another method, an invalid time limit.
        SolveError: A solve failed, or the excess does not fall below the tolerance within the time or cost limit;
            states the remaining excess and where. If there was a plan before the time limit, the error names
            ``time_limit`` and carries the plan of least excess as an unsuccessful one.
    """
    check_meshed("tighten", method, tolerance)
    with time_limited(checked_time_limit(time_limit)):
        prepared = method.prepare(problem, options=options)
        form, transcription = prepared.formulation, prepared.transcription
        p = form.parameter_vector(require.mapping("tighten: parameters", parameters))
        low, high = _limits_of(form, p)
        with np.errstate(invalid="ignore"):
            max_tightening = np.where(np.isfinite(high - low), (high - low) / 2, np.inf)
        places = _places(form, transcription, shared=method.control == "linear")
        tightening = np.zeros((2, len(transcription.mesh) - 1, len(low)))
        move, previous = np.zeros_like(tightening), np.zeros_like(tightening)
        followed = np.full_like(tightening, SETTINGS.followed)
        best: tuple[Solution, str, dict[str, Any]] | None = None  # a plan, and its largest excess
        reference_cost = np.inf  # cost without tightening
        for _ in range(SETTINGS.rounds):
            moves = {}
            for kind, (entry, left, right) in places.items():
                shared = np.maximum(tightening[:, left, entry], tightening[:, right, entry])
                moves[f"lb{kind}"], moves[f"ub{kind}"] = np.where(entry >= 0, shared, 0.0)
            try:
                solution = prepared.solve(parameters, guess, tighter=moves)
            except SolveError as error:
                if best is None or time_left() > 0:
                    raise
                plan, remains, _ = best
                words = f"{SolverStatus.TIME_LIMIT}: raise time_limit"
                plan = replace(plan, success=False, status=SolverStatus.TIME_LIMIT, message=words)
                summary = f"problem {form.name!r}: tightening ended with {words}; {remains}"
                raise SolveError(summary, plan, name="time_limit", value=time_limit) from error
            beyond, times = _excess(form, solution, p, low, high)
            if tightening.any():
                increase = max(solution.cost - reference_cost, 0.0)
                solution = replace(solution, bound_tightening=tightening, tightening_cost=increase)
            else:
                reference_cost = solution.cost
            if beyond.max(initial=0.0) <= tolerance:
                return solution
            remains, details = _worst(form, beyond, times)
            if solution.cost > max_cost:
                summary = f"problem {form.name!r}: tightened bounds cost {solution.cost:.6g} already, and {remains}"
                raise SolveError(summary, solution, name="cost", value=solution.cost, limit=max_cost)
            if best is None or details["value"] < best[2]["value"]:
                best = solution, remains, details
            # secant method for each bound by itself; bounds that were not moved give no information
            share = (previous - beyond) / np.where(move > 0, move, np.inf)
            followed = np.where((beyond > 0) & (share > SETTINGS.least_followed), np.minimum(share, 1.0), followed)
            previous, guess = beyond, solution
            # a bound that no point of an interval reaches is first tightened up to the nearest point
            rows = prepared.program.numbers.values(solution.variables, p)[1]
            slack = _slack({"x": solution.variables, "g": rows}, places, low, high, tightening.shape)
            base = np.clip(np.where(np.isfinite(slack), slack, 0.0), tightening, max_tightening)
            move = np.minimum(np.where(beyond > tolerance / 2, beyond / followed, 0.0), max_tightening - base)
            tightening = np.where(move > 0, base + move, tightening)
        summary = f"problem {form.name!r}: after {SETTINGS.rounds} rounds {remains}; use more intervals"
        raise SolveError(summary, solution, limit=tolerance, **details)


def largest_excess(problem: Problem, solution: Solution) -> float:
    """Return a plan's largest violation of a bound or inequality, in the bound's unit, also between grid points."""
    form = Formulation.of(problem)
    p = form.parameter_vector(solution.parameters)
    return float(_excess(form, solution, p, *_limits_of(form, p))[0].max(initial=0.0))


def _limits_of(form: Formulation, p: np.ndarray) -> Bounds:
    """Return the lower and upper bounds of states, controls and path constraints. Shape (m,) each."""
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
    low, high = form.bound_values(p)
    return low[index], high[index]


def _worst(form: Formulation, beyond: np.ndarray, times: np.ndarray) -> tuple[str, dict[str, Any]]:
    """Return a text that reports the largest excess over a bound, and the fields of the corresponding SolveError."""
    labels = [*form.state_labels, *form.control_labels, *form.path.labels]
    either = beyond.max(axis=0)
    k, i = np.unravel_index(int(np.argmax(either)), either.shape)
    worst = float(either[k, i])
    words = f"{labels[i]} still exceeds its bound by {worst:.3g} between {times[k]:.4g} and {times[k + 1]:.4g} s"
    return words, {"name": labels[i], "value": worst, "time": float(times[k])}


def _places(
    form: Formulation, transcription: Transcription, shared: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return which bounded quantity each variable ("x") and constraint ("g") represents, and in which mesh intervals.

    The quantity is an index among the stacked states, controls and path constraints, or -1. The indices of two
    intervals, left and right, differ at a node between intervals. Unless ``shared``, a control at a node, and rows with
    it, belong to one interval and may jump there.
    """
    entry_of = np.full(max(int(index.max(initial=0)) for index in form.bounds.places.values()) + 1, -1)
    offsets = {"state": 0, "initial": 0, "terminal": 0, "control": form.nx, "path": form.nx + form.nu}
    for kind, offset in offsets.items():
        index = form.bounds.places[kind]
        entry_of[index] = offset + np.arange(len(index))
    unshared = (
        np.concatenate([np.zeros(form.nx, bool), np.ones(form.nu, bool), form.path.uses_control, [False]]) & ~shared
    )
    places, last = {}, len(transcription.mesh) - 2
    for kind, index, at in (
        ("x", transcription.variable_bounds, transcription.variable_fraction),
        ("g", transcription.row_bounds, transcription.row_fractions),
    ):
        left, right = (
            np.clip(np.searchsorted(transcription.mesh, at + shift) - 1, 0, last)
            for shift in (-NODE_TOLERANCE, NODE_TOLERANCE)
        )
        own = left if kind == "x" else np.clip(transcription.row_stages, 0, last)
        entry = entry_of[index]
        places[kind] = entry, np.where(unshared[entry], own, left), np.where(unshared[entry], own, right)
    return places


def _slack(
    values: dict[str, np.ndarray],
    places: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    low: np.ndarray,
    high: np.ndarray,
    shape: tuple[int, ...],
) -> np.ndarray:
    """Return the smallest distances of values from their lower and upper bounds in each mesh interval. Shape (2, N, m).

    It is infinite for a bound without grid values in the interval.
    """
    slack = np.full(shape, np.inf)
    for kind, (entry, left, right) in places.items():
        bounded = entry >= 0
        at, value = entry[bounded], values[kind][bounded]
        for side, distance in enumerate((value - low[at], high[at] - value)):
            for interval in (left, right):
                np.minimum.at(slack[side], (interval[bounded], at), distance)
    return slack


def _excess(
    form: Formulation, solution: Solution, p: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest violation of the lower and of the upper bounds in each mesh interval (2, N, m), and the ends
    (N + 1,) of the intervals, s.
    """
    breaks = solution.control_interpolant.breaks
    n = len(breaks) - 1
    per_interval = (len(solution.state_interpolant.breaks) - 1) // n
    count = SETTINGS.places * (len(solution.state_interpolant.nodes) - 1) * per_interval
    x, u, t = plan_at(solution, np.linspace(0.0, 1.0, count + 1))
    g = form.sampled([form.path.expression], x, u, t, solution.horizon, p)[0]
    inequality = np.where(low < high, 1.0, np.nan)  # equalities are ignored
    values = np.hstack([x, u, g]) * inequality
    beyond = [
        _peaks(np.where(np.isfinite(part), part, -np.inf).reshape(n, count + 1, -1)).clip(min=0.0)
        for part in (low - values, values - high)
    ]
    return np.stack(beyond), breaks * solution.horizon


def _peaks(values: np.ndarray) -> np.ndarray:
    """Return the maxima of sampled curves (N, K, m), estimated by parabolas through three samples. Shape (N, m)."""
    left, middle, right = values[:, :-2], values[:, 1:-1], values[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (right - left) ** 2 / (8 * (2 * middle - left - right))
    is_peak = np.isfinite(rise) & (middle >= left) & (middle >= right)
    between = np.where(is_peak, middle + np.where(is_peak, rise, 0.0), -np.inf).max(axis=1, initial=-np.inf)
    return np.asarray(np.maximum(values.max(axis=1), between))
