"""Tightened bounds and mesh nodes at control switches, so that plans satisfy their limits between grid points too.

A transcription enforces inequalities at its points; between them a plan may exceed them by a power of the interval
width. :func:`tighten` tightens each bound, interval by interval, by the excess of the plan, until nothing is exceeded.

Minimum-time plans jump from limit to limit. A polynomial over an interval with such a jump oscillates beyond the limits
on any mesh, and its cost is too high; with a node at the jump it is exact. :func:`switches` locates the jump from the
plan itself: the integral of the control over the interval equals that of the arcs before and after it, each continued
to the jump.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ocp.console import interruptible, time_left, time_limited
from ocp.curves import differentiation_matrix, lagrange, quadrature_weights
from ocp.direct.assembly import Transcription
from ocp.direct.discretisation import Collocation
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import check_meshed
from ocp.errors import SolveError, SolverStatus, checked_time_limit, require
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import NODE_TOLERANCE, ByName, Guess, Solution
from ocp.tolerances import LIMIT_SHARE, RESOLVED_SHARE, SOLVER_SHARE

__all__ = ["WARM_START_OPTIONS", "largest_excess", "solve_at_switches", "switches", "tighten"]


@dataclass(frozen=True)
class TighteningSettings:
    """Settings of :func:`tighten`, which tightens the limits of a plan.

    Attributes:
        places: Evaluation points per interval and polynomial degree of the plan.
        rounds: Maximum number of rounds.
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
    """Solve with IPOPT, with limits tightened so that every inequality also holds between grid points.

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
        bounds = form.bound_values(p)
        index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
        low, high = bounds[0][index], bounds[1][index]
        with np.errstate(invalid="ignore"):
            max_tightening = np.where(np.isfinite(high - low), (high - low) / 2, np.inf)
        places = _places(form, transcription, shared=method.control == "linear")
        tightening = np.zeros((2, len(transcription.mesh) - 1, len(index)))
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
    """Return a plan's largest violation of a bound or inequality, also between grid points, in the bound's unit."""
    form = Formulation.of(problem)
    p = form.parameter_vector(solution.parameters)
    index = np.concatenate([form.bounds.places[kind] for kind in ("state", "control", "path")])
    low, high = (bound[index] for bound in form.bound_values(p))
    return float(_excess(form, solution, p, low, high)[0].max(initial=0.0))


def _worst(form: Formulation, beyond: np.ndarray, times: np.ndarray) -> tuple[str, dict[str, Any]]:
    """Return a text about the largest excess over a bound (see :func:`_excess`), and the fields of its error."""
    labels = [*form.state_labels, *form.control_labels, *form.path.labels]
    either = beyond.max(axis=0)
    k, i = np.unravel_index(int(np.argmax(either)), either.shape)
    worst = float(either[k, i])
    words = f"{labels[i]} still exceeds its bound by {worst:.3g} between {times[k]:.4g} and {times[k + 1]:.4g} s"
    return words, {"name": labels[i], "value": worst, "time": float(times[k])}


def _places(
    form: Formulation, transcription: Transcription, shared: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the bounded quantity that each variable ("x") and constraint ("g") represents, and its mesh intervals.

    The quantity is an index among the stacked states, controls and path constraints, or -1. The indices of two
    intervals, left and right, differ at a node between intervals.

    Args:
        shared: Whether a control at a node belongs to both intervals; otherwise it, and rows with it, may jump there.
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
    """Return the smallest distance of values from their lower and upper bounds in each mesh interval. Shape (2, N, m).

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
    """Return the largest violation of the lower and upper bounds in each mesh interval, and the interval ends, s.

    Shapes (2, N, m) and (N + 1,).
    """
    breaks = solution.control_interpolant.breaks
    n = len(breaks) - 1
    per_interval = (len(solution.state_interpolant.breaks) - 1) // n
    count = SETTINGS.places * (len(solution.state_interpolant.nodes) - 1) * per_interval
    place = np.linspace(0.0, 1.0, count + 1)
    owner = np.repeat(np.arange(n), len(place))
    s = breaks[owner] + np.diff(breaks)[owner] * np.tile(place, n)
    x = solution.state_interpolant(s)
    u = solution.control_interpolant.within(owner, np.tile(place, n))
    horizon = solution.horizon
    g = form.sampled([form.path.expression], x, u, horizon * s, horizon, p)[0]
    inequality = np.where(low < high, 1.0, np.nan)  # equalities are ignored
    values = np.hstack([x, u, g]) * inequality
    beyond = [
        _peaks(np.where(np.isfinite(part), part, -np.inf).reshape(n, len(place), -1)).clip(min=0.0)
        for part in (low - values, values - high)
    ]
    return np.stack(beyond), breaks * horizon


def _peaks(values: np.ndarray) -> np.ndarray:
    """Return the maxima of sampled curves (N, K, m) from parabolas through neighbouring samples. Shape (N, m)."""
    left, middle, right = values[:, :-2], values[:, 1:-1], values[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (right - left) ** 2 / (8 * (2 * middle - left - right))
    is_peak = np.isfinite(rise) & (middle >= left) & (middle >= right)
    between = np.where(is_peak, middle + np.where(is_peak, rise, 0.0), -np.inf).max(axis=1, initial=-np.inf)
    return np.asarray(np.maximum(values.max(axis=1), between))


# ---- nodes at switches -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SwitchingSettings:
    """Settings for locating the switches of a plan: times at which a control or constraint reaches or leaves a limit.

    Attributes:
        at_limit: Distance from a limit, relative to the range of both limits, below which a value is at the limit: the
            audit's tolerance.
        jump: Smallest jump of a value at a switch, relative to that range.
        longest: Maximum number of intervals over which a jump may be smeared.
        too_near: Distance from a switch, relative to its interval, below which other nodes are removed.
        same: Distance, relative to the horizon, below which two switches count as one.
        rounds: Maximum number of rounds.
        worth: Relative cost reduction below which moving the nodes again is not worthwhile.
        other: Relative cost increase above which the plan has changed into another one.
    """

    at_limit: float = LIMIT_SHARE
    jump: float = 0.05
    longest: int = 4
    too_near: float = 0.15
    same: float = 1e-7
    rounds: int = 3
    worth: float = RESOLVED_SHARE
    other: float = LIMIT_SHARE


SWITCHING = SwitchingSettings()
WARM_START_OPTIONS = {"mu_init": 1e-4}
"""IPOPT options that keep the iterates close to an initial guess that is nearly optimal."""


def switches(problem: Problem, solution: Solution) -> np.ndarray:
    """Return the fractions of the horizon at which a control or path constraint reaches or leaves a limit. Shape (k,).

    Args:
        problem: The problem that was solved, by collocation with controls at the points.
        solution: Its plan.
    """
    form = Formulation.of(problem)
    breaks, nodes = solution.control_interpolant.breaks, solution.control_interpolant.nodes
    n, width = len(breaks) - 1, np.diff(breaks)
    at = (breaks[:-1, None] + width[:, None] * nodes).ravel()
    owner, place = np.repeat(np.arange(n), len(nodes)), np.tile(nodes, n)
    values, low, high = _limited_values(form, solution, at, owner, place)
    span = np.where(np.isfinite(high - low), high - low, np.ptp(values, axis=0))
    margin = SWITCHING.at_limit * span
    state = np.where(values >= high - margin, 1, np.where(values <= low + margin, -1, 0))
    values, state = (part.reshape(n, len(nodes), -1) for part in (values, state))
    uniform = (state == state[:, :1]).all(axis=1)
    slope = np.einsum("ij,kjr->kir", differentiation_matrix(nodes), values) / width[:, None, None]
    first, last = (lagrange(nodes, np.array([side]))[0] for side in (0.0, 1.0))
    area = np.einsum("q,kqr->kr", quadrature_weights(nodes), values) * width[:, None]
    fractions = []
    for row in range(values.shape[2]):
        arcs = np.flatnonzero(uniform[:, row])
        for i, j in pairwise(arcs.tolist()):
            if state[i, 0, row] == state[j, 0, row] or j - i > SWITCHING.longest:
                continue
            a, b = breaks[i + 1], breaks[j]
            before, after = last @ values[i, :, row], first @ values[j, :, row]
            rise, fall = last @ slope[i, :, row], first @ slope[j, :, row]
            with np.errstate(divide="ignore", invalid="ignore"):  # intersection of both arcs
                crossing = (before - rise * a - after + fall * b) / (fall - rise)
            if not breaks[i] <= crossing <= breaks[j + 1]:
                if not abs(after - before) > SWITCHING.jump * span[row]:
                    continue
                # otherwise the point at which both arcs enclose the same area as the plan
                crossing = np.clip(a + (area[i + 1 : j, row].sum() - after * (b - a)) / (before - after), a, b)
            fractions.append(float(crossing))
    return np.unique(fractions)


def _limited_values(
    form: Formulation, solution: Solution, at: np.ndarray, owner: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values and limits of limited controls, and of limited path constraints that contain controls.

    The values (M, m) are those at fractions ``at`` (M,) of the horizon, the lower and upper limits have shape (m,).
    """
    p = form.parameter_vector(solution.parameters)
    lower, upper = form.bound_values(p)
    x, u = solution.state_interpolant(at), solution.control_interpolant.within(owner, place)
    g = form.sampled([form.path.expression], x, u, at * solution.horizon, solution.horizon, p)[0]
    index = np.concatenate([form.bounds.places[kind] for kind in ("control", "path")])
    low, high = lower[index], upper[index]
    limited = np.concatenate([np.ones(form.nu, bool), form.path.uses_control])
    limited &= (np.isfinite(low) | np.isfinite(high)) & (low < high)
    return np.hstack([u, g])[:, limited], low[limited], high[limited]


@interruptible
def solve_at_switches(
    problem: Problem, method: Collocation, plan: Solution, *, parameters: ByName = None, options: ByName = None
) -> Solution:
    """Solve a problem again with mesh nodes at the switches of its plan; each round locates them more accurately.

    Args:
        problem, parameters, options: As for :func:`ocp.methods.solve`.
        method: The method of the plan, with controls at the points; its nodes stay, except those close to a switch.
        plan: The plan to start from.

    Returns:
        The last plan whose cost is not higher; ``plan`` itself without switches, or if another solve fails.
    """
    previous = np.zeros(0)
    for iteration in range(SWITCHING.rounds):
        located = _distinct(switches(problem, plan))
        if len(located) == len(previous) and np.abs(located - previous).max(initial=0.0) < SWITCHING.same:
            break
        mesh = method.with_mesh(_mesh(method.fractions, located))
        arguments: dict[str, Any] = {"parameters": parameters, "options": {**WARM_START_OPTIONS, **(options or {})}}
        candidate = solve(problem, mesh, guess=plan, check=False, **arguments)
        gain = (plan.cost - candidate.cost) / max(abs(plan.cost), abs(candidate.cost), np.finfo(float).tiny)
        if not candidate.success or gain < -SWITCHING.other:
            break
        settled, previous, plan = len(located) == len(previous), located, candidate
        if iteration and gain < SWITCHING.worth and not settled:
            break
    return plan


def _distinct(fractions: np.ndarray) -> np.ndarray:
    """Return the horizon fractions of switches inside the horizon; of several close switches, only the first."""
    inside = fractions[(fractions > SWITCHING.same) & (fractions < 1 - SWITCHING.same)]
    return np.asarray(inside[np.diff(inside, prepend=-1.0) > SWITCHING.same])


def _mesh(mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return a mesh with nodes at the fractions of switches, and without old nodes that are close to a switch."""
    inner, width = mesh[1:-1], np.diff(mesh)
    interval = np.clip(np.searchsorted(mesh, at, side="right") - 1, 0, len(width) - 1)
    close = (np.abs(inner[:, None] - at) < SWITCHING.too_near * width[interval]).any(axis=1)
    return np.unique(np.concatenate([mesh[[0, -1]], inner[~close], at]))
