"""Mesh refinement by the audit: intervals are split where its rows are beyond their limits, until none is."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from inspect import Parameter, signature
from typing import Any, NamedTuple

import numpy as np

from ocp.audit.audit import Audit, Finding
from ocp.audit.audit import audit as judge
from ocp.console import TimeLimitReached, time_left, time_limited
from ocp.direct.mesh import check_meshed
from ocp.direct.prepared import DirectMethod
from ocp.errors import (
    ProblemError,
    RefinementWarning,
    SolveError,
    checked_count,
    checked_mapping,
    checked_time_limit,
    error_names,
    unknown_name,
)
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.problem.values import numeric
from ocp.solution import ByName, Guess, Refinement, Solution, stack
from ocp.status import SolverStatus
from ocp.tolerances import ROUNDING_SHARE, SOLVER_SHARE

__all__ = ["refine", "refine_from", "split"]

LIMITS = [name for name, given in signature(judge).parameters.items() if given.kind is Parameter.KEYWORD_ONLY]
KINDS = ("integration", "equalities", "limits", "cost", "other")


@dataclasses.dataclass(frozen=True)
class RefinementSettings:
    """How meshes are refined.

    Attributes:
        target: Share of its limit to which a row is brought by splitting: half, as the order of an error is not known.
        pieces: That an interval is split into at once, at most.
        least_width: Of an interval, as a share of the horizon: what is narrower is rounding.
        rounds: At most. patience: Rounds that may pass without any row coming nearer to its limit.
        nearer: Share of what it was to which a row must fall to count as falling.
    """

    target: float = 0.5
    pieces: int = 4
    least_width: float = ROUNDING_SHARE
    rounds: int = 12
    patience: int = 2
    nearer: float = 0.8


SETTINGS = RefinementSettings()


def refine(
    problem: Problem,
    method: DirectMethod,
    *,
    tolerance: float = SOLVER_SHARE,
    limits: ByName = None,
    breaks: Sequence[float] = (),
    max_intervals: int = 400,
    parameters: ByName = None,
    solver: str = "ipopt",
    options: ByName = None,
    guess: Guess = None,
    time_limit: float | None = None,
) -> Solution:
    """Solve, and split intervals until no row of the audit is beyond its limit.

    Looked at in every interval are the distance of the plan from its re-integration, what path equalities, bounds and
    inequalities are missed by between the points, and the cost that the controls lose. Each falls with a power of the
    width that the method sets, which says into how many pieces an interval is split. A row that no interval answers for
    (the conditions at the ends) is met by splitting those that are worst in the others. Nodes stay nodes. Every round
    starts from the plan before.

    Args:
        problem, parameters, solver, options, guess: As for :func:`ocp.methods.solve`.
        method: The mesh to start from.
        tolerance: Largest integration error, relative to the size of each state: over the whole horizon, or summed over
            the intervals where the motion is unstable and that over the horizon means nothing.
        limits: Of the audit's other rows, as of :func:`ocp.audit.audit.audit`: ``{"constraints": 1e-6}``. Its own
            limits where none is given.
        breaks: Times at which there have to be nodes, because something jumps or bends there, s. Of a fixed horizon
            only; for a free one give ``method.with_nodes_at(fractions)``.
        max_intervals: Cap on the number of intervals.
        time_limit: After so many seconds, all rounds and their audits included, it stops: a solve between two
            iterations, an audit between two of its parts. None for no limit.

    Returns:
        The last solution, or at the time limit the last that was audited; its ``refinement`` says how the mesh came
        about, and whether the audit passes in the end.

    Raises:
        ProblemError: tolerance not positive, a limit that the audit does not have, breaks outside the horizon or of a
            free one, cap below the first mesh, a time limit that is none.
        SolveError: A round failed, or the time limit was reached in the first, before there was an audited plan; then
            it names ``time_limit`` and carries the plan as an unsuccessful one.

    Warns:
        RefinementWarning: It stopped with a row beyond its limit, at the cap, at the time limit or where finer
            intervals do not help, and names the worst; or with all rows within theirs where the audit does not decide
            whether it is an optimum.
    """
    check_meshed("refine", method, tolerance)
    checked_time_limit(time_limit)
    settings = checked_mapping("refine: limits", limits)
    for name in settings:
        if name not in LIMITS:
            raise unknown_name("limit of the audit", name, LIMITS)
    max_intervals = checked_count("refine: max_intervals", max_intervals)
    form = Formulation.of(problem)
    p = form.parameter_vector(checked_mapping("parameters", parameters))
    method = method.with_nodes_at(_fractions(form, p, breaks))
    if max_intervals < method.intervals:
        raise ProblemError(
            f"refine: max_intervals {max_intervals} is below the {method.intervals} intervals given",
            name="max_intervals",
            value=max_intervals,
            limit=method.intervals,
        )
    given = {"parameters": parameters, "solver": solver, "options": options}
    with time_limited(time_limit):
        first = _first(problem, method, {**given, "guess": guess}, settings, time_limit)
        return _refined(problem, method, first, tolerance, given, settings, max_intervals)[0]


def refine_from(
    problem: Problem, method: DirectMethod, solution: Solution, audit: Audit, options: ByName = None, check: bool = True
) -> tuple[Solution, Audit]:
    """As `refine`, from a plan that was solved on the method's mesh and audited already; with the last one's audit.

    Without `check` a round that fails from the plan before it is not begun elsewhere, and what conflicts not looked
    for: see :func:`ocp.methods.solve`.
    """
    given = {"options": options, "check": check}
    return _refined(problem, method, (solution, audit), SOLVER_SHARE, given, {}, 400)


def _refined(
    problem: Problem,
    method: DirectMethod,
    first: tuple[Solution, Audit],
    tolerance: float,
    given: dict[str, Any],
    settings: dict[str, Any],
    max_intervals: int,
) -> tuple[Solution, Audit]:
    """The last of the plans, and its audit; RefinementWarning as `refine` says."""
    solution, audit = first
    form = Formulation.of(problem)
    p = form.parameter_vector(solution.parameters)
    intervals: list[int] = []
    errors: dict[str, list[float]] = {kind: [] for kind in KINDS}
    best: dict[str, float] = {}
    idle, late = 0, False
    while True:
        rows = _rows(form, p, solution, audit, tolerance, method)
        beyond = [row for row in rows if not row.value <= 1.0]
        intervals.append(method.intervals)
        for kind, values in errors.items():
            values.append(max((row.value for row in rows if row.kind == kind), default=0.0))
        nearer = [row for row in beyond if row.value < SETTINGS.nearer * best.get(row.name, np.inf)]
        best |= {row.name: min(row.value, best.get(row.name, np.inf)) for row in rows}
        idle = 0 if nearer else idle + 1
        finer = split(method.fractions, *_pieces(beyond, rows, method.fractions), max_intervals)
        spent = idle == SETTINGS.patience or len(intervals) == SETTINGS.rounds
        if not beyond or spent or len(finer) == method.intervals + 1:
            break
        method = method.with_mesh(finer)
        found = _next(problem, method, {**given, "guess": solution}, settings)
        if found is None:
            late = True
            break
        solution, audit = found
    stopped = f"refinement of {problem.name!r} stopped at {intervals[-1]} of at most {max_intervals} intervals"
    idles = idle == SETTINGS.patience and not late
    if (warning := _shortfall(stopped, late, idles, beyond, audit, form)) is not None:
        warnings.warn(warning, stacklevel=2)
    told = {kind: tuple(values) for kind, values in errors.items()}
    refinement = Refinement(tuple(intervals), told, tolerance, audit.passed and not beyond)
    return dataclasses.replace(solution, refinement=refinement), audit


def _shortfall(
    stopped: str, late: bool, idles: bool, beyond: list[_Row], audit: Audit, form: Formulation
) -> RefinementWarning | None:
    """What refinement leaves, in the order in which it matters; None where the last plan passes its audit."""
    if beyond:
        worst = max(beyond, key=lambda row: row.value)
        hint = "the time limit is reached: raise time_limit" if late else "raise max_intervals"
        if idles:
            hint = "finer intervals do not lower it" + ("; draw it in (tighten)" if worst.kind == "limits" else "")
        words = f"{stopped} with {worst.name!r} at {worst.value:.2e} of its limit; {hint}"
        return RefinementWarning(words, name=worst.name, value=worst.value, limit=1.0)
    if touching := [each for each in audit.failures if each.name in form.separations]:
        words = f"{stopped}; finer intervals keep no bodies apart, add constraints that do: {touching[0].note}"
        return RefinementWarning(words, name=touching[0].name, value=touching[0].value, limit=1.0)
    if not audit.passed:
        words = f"{stopped} with every row of the audit within its limit, but not decided: {audit.undecided}"
        return RefinementWarning(words, name="undecided", value=audit.undecided)
    return None


def _first(
    problem: Problem, method: DirectMethod, given: dict[str, Any], settings: dict[str, Any], time_limit: float | None
) -> tuple[Solution, Audit]:
    """The plan on the first mesh, and its audit.

    Raises:
        SolveError: The solve failed, or the time limit is reached.
    """
    solution = solve(problem, method, **given)
    try:
        return solution, judge(problem, solution, **settings)
    except TimeLimitReached as error:
        words = f"{SolverStatus.TIME_LIMIT}: raise time_limit"
        raise SolveError(
            f"refinement of {problem.name!r} ended in the audit of its first plan with {words}",
            dataclasses.replace(solution, success=False, status=SolverStatus.TIME_LIMIT, message=words),
            name="time_limit",
            value=time_limit,
        ) from error


def _next(
    problem: Problem, method: DirectMethod, given: dict[str, Any], settings: dict[str, Any]
) -> tuple[Solution, Audit] | None:
    """The plan on a finer mesh, and its audit; None where the time limit is reached before there are both.

    Raises:
        SolveError: The solve failed while there was time.
    """
    if time_left() <= 0:
        return None  # nothing is built
    try:
        solution = solve(problem, method, **given)
        if not solution.success:
            raise SolveError(f"refinement of {problem.name!r} failed: {solution.status}", solution)
        return solution, judge(problem, solution, **settings)
    except (SolveError, TimeLimitReached) as error:
        if isinstance(error, SolveError) and time_left() > 0:
            raise
        return None


class _Row(NamedTuple):
    """A row of the audit: its value, and what each interval adds to it (N,), both as shares of its limit.

    ``order`` is the power of the width with which it falls; ``errors`` is None where no interval answers for it.
    """

    name: str
    kind: str
    value: float
    errors: np.ndarray | None = None
    order: int = 1


class _Parts(NamedTuple):
    """What each interval adds to a row (N,), in any unit; the row is their sum, or the largest of them."""

    kind: str
    values: np.ndarray
    order: int
    summed: bool = False

    def shares(self, total: float) -> np.ndarray:
        """Of a row that is so large, where an interval may have the same part of a sum as any other. Shape (N,)."""
        values = self.values if np.isfinite(self.values).all() else np.where(np.isfinite(self.values), 0.0, 1.0)
        whole = values.mean() if self.summed else values.max()
        found = np.zeros(len(values))
        found[values > 0] = total * (values[values > 0] / (whole or 1.0))
        return found


def _rows(
    form: Formulation, p: np.ndarray, solution: Solution, audit: Audit, tolerance: float, method: DirectMethod
) -> list[_Row]:
    """What an audit says of a plan, row by row, and which intervals answer for it."""
    # over the whole horizon an unstable motion runs away; what feedback would have to mend is the sum
    slip = min(audit.integration_error, float(audit.local_errors.sum()))
    asked = Finding(f"integration error, {tolerance:.0e} asked", slip, tolerance)
    order = method.control_order
    parts = {
        name: _Parts("integration", audit.local_errors, method.order)
        for name in (asked.name, "integration error, relative", "integration error of one interval")
    }
    parts["cost lost, relative"] = _Parts("cost", audit.lost, 2 * order, summed=True)
    costates = audit.optimality.adjoint
    parts["costate equation, relative"] = _Parts("other", costates.error, order, summed=True)
    parts["costates between the nodes, relative"] = _Parts("other", costates.between, order)
    for name, (equal, misses) in _missed(form, p, solution, audit).items():
        parts[name] = _Parts("equalities" if equal else "limits", misses, order)
    rows = []
    for finding in (asked, *audit.findings):
        if finding.limit is None or finding.name in form.separations:  # no finer interval keeps bodies apart
            continue
        value = 0.0 if finding.value == 0 else finding.value / finding.limit if finding.limit > 0 else np.inf
        value = np.inf if np.isnan(value) else float(value)
        part = parts.get(finding.name)
        if part is None or not part.values.any():
            rows.append(_Row(finding.name, "other", value))
        else:
            rows.append(_Row(finding.name, part.kind, value, part.shares(value), part.order))
    return rows


def _missed(form: Formulation, p: np.ndarray, solution: Solution, audit: Audit) -> dict[str, tuple[bool, np.ndarray]]:
    """Of each bounded state, control and path constraint by the name of its row in the audit: whether it is an
    equality, and by how much it is missed most in every interval (N,)."""
    n = len(audit.local_errors)
    x, u = stack(audit.states), stack(audit.controls, len(audit.t))
    g = form.sampled([form.path.expression], x, u, audit.t, solution.horizon, p)[0]
    lower, upper = form.bound_values(p)
    found = {}
    for kind, pool, values in (
        ("state", {f"bounds of {name}": place for name, place in form.states.items()}, x),
        ("control", {f"bounds of {name}": place for name, place in form.controls.items()}, u),
        ("path", {name: form.path.of(name) for name in form.path.names}, g),
    ):
        for name, place in pool.items():
            index = form.bounds.places[kind][place]
            miss = np.maximum(lower[index] - values[:, place], values[:, place] - upper[index]).clip(min=0.0)
            miss = np.where(np.isnan(miss), np.inf, miss).max(axis=1)
            found[name] = bool((lower[index] == upper[index]).all()), miss.reshape(n, -1).max(axis=1)
    return found


def _pieces(beyond: list[_Row], rows: list[_Row], mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Into how many pieces each interval is split for the rows beyond their limits, and how bad it is. Both (N,)."""
    n = len(mesh) - 1
    pieces, bad = np.ones(n, int), np.zeros(n)
    for row in beyond:
        if row.errors is not None:
            with np.errstate(over="ignore"):
                wanted = np.ceil((row.errors / SETTINGS.target) ** (1.0 / row.order))
            pieces = np.maximum(pieces, np.clip(wanted, 1, SETTINGS.pieces).astype(int))
            bad = np.maximum(bad, row.errors)
    if np.all(pieces == 1):  # no interval answers for what is beyond its limit
        for row in rows:
            bad = bad if row.errors is None else np.maximum(bad, row.errors)
        far = max((row.value for row in beyond), default=0.0) > 2.0
        pieces[far | (bad >= np.median(bad))] = 2
    pieces[np.diff(mesh) < 2 * SETTINGS.least_width] = 1
    return pieces, bad


def split(mesh: np.ndarray, pieces: np.ndarray, bad: np.ndarray, most: int) -> np.ndarray:
    """The mesh (N + 1,) with each interval cut into its number of pieces; shape (N' + 1,), at most ``most`` intervals.

    Where there is no room for all, intervals that are less ``bad`` (N,) give way.
    """
    pieces = pieces.copy()
    room = most - len(pieces)
    for k in np.argsort(bad, kind="stable"):
        excess = int(np.sum(pieces - 1)) - room
        if excess <= 0:
            break
        pieces[k] = max(1, pieces[k] - excess)
    cuts = [np.linspace(mesh[k], mesh[k + 1], n + 1)[:-1] for k, n in enumerate(pieces)]
    return np.concatenate([*cuts, mesh[-1:]])


def _fractions(form: Formulation, p: np.ndarray, breaks: Sequence[float]) -> np.ndarray:
    """Times of a fixed horizon as fractions of it."""
    with error_names("breaks"):
        times = numeric("refine: breaks", breaks)
    if not times.size:
        return times
    if form.horizon_is_free:
        words = "refine: breaks in s have no place on a free horizon; give method.with_nodes_at(fractions)"
        raise ProblemError(words, name="breaks", value=times.tolist())
    horizon = float(form.horizon_at(p))
    if not np.all((times >= 0) & (times <= horizon)):
        words = f"refine: breaks must lie within the horizon, 0 to {horizon:g} s, not {times.tolist()}"
        raise ProblemError(words, name="breaks", value=times.tolist(), limit=(0.0, horizon))
    return np.asarray(times / horizon)
