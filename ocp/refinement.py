"""Mesh refinement driven by the audit: intervals are split until every error in the audit is within its limit."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from inspect import Parameter, signature
from typing import Any, NamedTuple

import numpy as np

from ocp.audit.audit import Audit, Finding
from ocp.audit.audit import audit as judge
from ocp.audit.correction import SETTINGS as CORRECTION
from ocp.console import TimeLimitReached, time_left, time_limited
from ocp.direct.discretisation import Collocation
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import check_meshed
from ocp.errors import ProblemError, RefinementWarning, SolveError, SolverStatus, checked_time_limit, require
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import ByName, Guess, Solution
from ocp.solution_data import Refinement, stack
from ocp.switching import locate_switches, nodes_at_switches
from ocp.tolerances import RESOLVED_SHARE, ROUNDING_SHARE, SOLVER_SHARE

LIMITS = [name for name, entry in signature(judge).parameters.items() if entry.kind is Parameter.KEYWORD_ONLY]
INTEGRATION = "integration error, relative"


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of the mesh refinement.

    Attributes:
        limits: Limits of the rows of the audit other than the integration error, as keywords of
            :func:`ocp.audit.audit.audit`: ``{"constraints": 1e-6}``. By default the audit's own.
        max_intervals: Maximum number of intervals.
        solver: As for :func:`ocp.methods.prepare`.
        target: Value of a row, relative to its limit, at which splitting aims: half, as the order of an error is
            uncertain.
        max_parts: Maximum number of parts into which an interval is split at once.
        least_width: Smallest width of an interval, relative to the horizon: less is rounding.
        rounds: Maximum number of rounds. patience: Rounds without progress of any row before it stops.
        nearer: Largest ratio of a row's unresolved part to its best earlier value that counts as progress.
        same_switch: Distance of a switch from a node, relative to the horizon, below which the node is at the switch.

    Raises:
        ProblemError: An unknown limit of the audit, or max_intervals is no positive integer.
    """

    limits: Mapping[str, Any] = field(default_factory=dict)
    max_intervals: int = 400
    solver: str = "ipopt"
    target: float = 0.5
    max_parts: int = 4
    least_width: float = ROUNDING_SHARE
    rounds: int = 12
    patience: int = 2
    nearer: float = 0.8
    same_switch: float = 1e-6

    def __post_init__(self) -> None:
        for name in require.mapping("RefinementSettings: limits", self.limits):
            if name not in LIMITS:
                raise require.unknown("limit of the audit", name, LIMITS)
        require.count("RefinementSettings: max_intervals", self.max_intervals)


def refine(
    problem: Problem,
    method: DirectMethod,
    *,
    tolerance: float = SOLVER_SHARE,
    parameters: ByName = None,
    options: ByName = None,
    guess: Guess = None,
    settings: RefinementSettings = RefinementSettings(),
    time_limit: float | None = None,
) -> Solution:
    """Solve a problem, and refine its mesh until every error that the audit reports is within its limit.

    In every interval it evaluates the deviation of the plan from its re-integration, the violations of path equalities,
    bounds and inequalities between the points, and the cost that the controls lose. Each falls with a power of the
    width that the method determines, from which follows the number of parts of an interval. An error that cannot be
    attributed to intervals (end conditions) is reduced by splitting those with the largest other errors. Nodes are
    kept. Every round starts from the previous plan.

    Collocation with controls at the points gets a node at each switch: where a control jumps from limit to limit,
    enters or leaves a singular arc, or where a state reaches or leaves its limit. Where controls exceed their limits
    between the points on every mesh, as the polynomials of a singular arc do, they are held over each interval.

    Args:
        problem, parameters, options, guess: As for :func:`ocp.methods.solve`; a plan of the problem on the initial mesh
            is the first plan.
        method: The method with the initial mesh. Where the problem has a jump or kink in time, give it a node:
            ``method.with_nodes_at(fractions)``.
        tolerance: Largest integration error, relative to the size of each state: over the whole horizon, or summed over
            the intervals if the motion is unstable and the error over the horizon is meaningless.
        settings: Limits of the other rows, the maximum number of intervals, the solver, constants of the algorithm.
        time_limit: Time in s for all rounds and their audits, after which it stops: a solve at the next iteration, an
            audit after the current part. None for no limit.

    Returns:
        The last solution, or at the time limit the last audited one; its ``refinement`` records the rounds, and whether
        the audit passes in the end.

    Raises:
        ProblemError: tolerance not positive, max_intervals below the initial mesh, an invalid time limit.
        SolveError: A round failed, or the time limit was reached before there was an audited plan; then it names
            ``time_limit`` and carries the plan as an unsuccessful one.

    Warns:
        RefinementWarning: It stopped with a row beyond its limit, at max_intervals, at the time limit or because finer
            intervals do not help; names the worst row. Or all rows are within their limits but optimality is
            undetermined.
    """
    check_meshed("refine", method, tolerance)
    checked_time_limit(time_limit)
    require.instance("refine: settings", settings, RefinementSettings)
    if settings.max_intervals < method.intervals:
        raise ProblemError(
            f"refine: max_intervals {settings.max_intervals} is below the {method.intervals} intervals given",
            name="max_intervals",
            value=settings.max_intervals,
            limit=method.intervals,
        )
    arguments = {"parameters": parameters, "options": options, "solver": settings.solver}
    with time_limited(time_limit):
        first = _first(problem, method, {**arguments, "guess": guess}, settings, time_limit)
        return _refine_mesh(problem, method, first, tolerance, arguments, settings)[0]


def refine_from(
    problem: Problem, method: DirectMethod, plan: tuple[Solution, Audit], *, options: ByName = None, check: bool = True
) -> tuple[Solution, Audit]:
    """Refine the mesh of a solved and audited plan; return the last plan with its audit.

    Without `check`, a round that fails from the previous plan is neither restarted nor diagnosed: see
    :func:`ocp.methods.solve`.
    """
    arguments = {"options": options, "check": check}
    return _refine_mesh(problem, method, plan, SOLVER_SHARE, arguments, RefinementSettings())


def _refine_mesh(
    problem: Problem,
    method: DirectMethod,
    first: tuple[Solution, Audit],
    tolerance: float,
    arguments: dict[str, Any],
    settings: RefinementSettings,
) -> tuple[Solution, Audit]:
    """Refine the mesh until the plan is accurate, or warn if no mesh suffices; return the last plan and its audit."""
    solution, audit = first
    form = Formulation.of(problem)
    p = form.parameter_vector(solution.parameters)
    intervals: list[int] = []
    errors: dict[str, list[float]] = {kind: [] for kind in ("integration", "equalities", "limits", "cost", "other")}
    progress, late, placed = _Progress(settings.nearer), False, np.zeros(0)
    moving = isinstance(method, Collocation) and method.control == "points"
    driven = _limits_of_controls(form, solution)

    while True:
        rows = _rows(form, p, solution, audit, tolerance, method)
        beyond = [row for row in rows if not row.value <= 1.0]
        intervals.append(method.intervals)
        for kind, values in errors.items():
            values.append(_largest_error(rows, kind))
        progress.record({row.name: row.unresolved(np.diff(method.fractions)) for row in beyond})
        idle = min(progress.vain.values(), default=0)
        at_switches = _mesh_at_switches(problem, method, solution, (beyond, rows), placed, settings) if moving else None
        if at_switches is not None and idle >= settings.patience:  # nodes at switches do not help
            moving, at_switches, idle = False, None, 0
        following = method
        if at_switches is not None:
            finer, placed = at_switches
            following = method.with_mesh(finer)
        elif idle < settings.patience:
            parts = _parts_per_interval(beyond, rows, method.fractions, settings)
            following = method.with_mesh(split(method.fractions, *parts, settings.max_intervals))
        unchanged = np.array_equal(following.fractions, method.fractions)
        vainly = progress.is_vain(driven, settings.patience, unchanged)
        if isinstance(method, Collocation) and method.control == "points" and vainly:
            # held over each interval, controls that oscillate on every mesh have no values but those of the solver
            following, moving, unchanged = replace(method, control="held"), False, False
            progress = _Progress(settings.nearer)
        if not beyond or unchanged or len(intervals) == settings.rounds:
            break
        method = following
        result = _next(problem, method, {**arguments, "guess": solution}, settings)
        if result is None:
            late = True
            break
        solution, audit = result
    stopped = f"refinement of {problem.name!r} stopped at {intervals[-1]} of at most {settings.max_intervals} intervals"
    idles = idle == settings.patience and not late
    if (warning := _shortfall(stopped, late, idles, beyond, audit, form)) is not None:
        warnings.warn(warning, stacklevel=2)
    history = {kind: tuple(values) for kind, values in errors.items()}
    refinement = Refinement(tuple(intervals), history, tolerance, audit.passed and not beyond)
    return replace(solution, refinement=refinement), audit


def _largest_error(rows: list[_Row], kind: str) -> float:
    """Return the largest error of one kind relative to its limit, 0 if there is none."""
    return max((row.value for row in rows if row.kind == kind), default=0.0)


@dataclass
class _Progress:
    """Progress of the errors that exceed their limits, from mesh to mesh.

    Attributes:
        nearer: Ratio of an error to its smallest value so far below which a mesh counts as an improvement.
        best: Smallest value so far of each error, by the name of the row.
        vain: Number of meshes without an improvement, one after the other, by the name of the row.
    """

    nearer: float
    best: dict[str, float] = field(default_factory=dict)
    vain: dict[str, int] = field(default_factory=dict)

    def record(self, errors: dict[str, float]) -> None:
        """Take in the errors of the plan on the next mesh, by the name of the row."""
        improved = {name: error < self.nearer * self.best.get(name, np.inf) for name, error in errors.items()}
        self.best |= {name: min(error, self.best.get(name, np.inf)) for name, error in errors.items()}
        self.vain = {name: 0 if improved[name] else self.vain.get(name, 0) + 1 for name in errors}

    def is_vain(self, names: set[str], patience: int, unchanged: bool) -> bool:
        """Return whether an error of a named row has not improved on `patience` meshes, or no mesh is finer."""
        return any(unchanged or count >= patience for name, count in self.vain.items() if name in names)


def _limits_of_controls(form: Formulation, solution: Solution) -> set[str]:
    """Return the names of the rows that limit controls; none if an equality contains controls."""
    if (form.path.equality & form.path.uses_control).any():  # held controls cannot follow the states
        return set()
    owners = {owner for owner, controlled in zip(form.path.owners, form.path.uses_control, strict=True) if controlled}
    return owners | {f"bounds of {name}" for name in solution.controls}


def _shortfall(
    stopped: str, late: bool, idles: bool, beyond: list[_Row], audit: Audit, form: Formulation
) -> RefinementWarning | None:
    """Return the warning that explains why the last plan does not pass its audit; None if the plan passes."""
    if beyond:
        worst = max(beyond, key=lambda row: row.value)
        hint = "the time limit is reached: raise time_limit" if late else "raise max_intervals"
        if idles:
            hint = "finer intervals do not lower it" + (
                "; tighten the limits (tighten)" if worst.kind == "limits" else ""
            )
        words = f"{stopped} with {worst.name!r} at {worst.value:.2e} of its limit; {hint}"
        return RefinementWarning(words, name=worst.name, value=worst.value, limit=1.0)
    if collisions := [finding for finding in audit.failures if finding.name in form.separations]:
        words = f"{stopped}; finer intervals do not separate bodies, add clearance constraints: {collisions[0].note}"
        return RefinementWarning(words, name=collisions[0].name, value=collisions[0].value, limit=1.0)
    if not audit.passed:
        words = f"{stopped} with every row of the audit within its limit, but undetermined: {audit.undecided}"
        return RefinementWarning(words, name="undecided", value=audit.undecided)
    return None


def _first(
    problem: Problem,
    method: DirectMethod,
    arguments: dict[str, Any],
    settings: RefinementSettings,
    time_limit: float | None,
) -> tuple[Solution, Audit]:
    """Solve the problem on the first mesh and audit the plan; raise SolveError on failure or at the time limit.

    A guess that is a plan of this problem on this mesh, for the same parameters, is the first plan.
    """
    vector, solution = Formulation.of(problem).parameter_vector, arguments["guess"]
    known = isinstance(solution, Solution) and solution.success and solution.problem is problem
    known = known and solution.method == method.settings
    if not (known and np.array_equal(vector(arguments["parameters"]), vector(solution.parameters))):
        solution = solve(problem, method, **arguments)
    try:
        return solution, judge(problem, solution, **settings.limits)
    except TimeLimitReached as error:
        words = f"{SolverStatus.TIME_LIMIT}: raise time_limit"
        raise SolveError(
            f"refinement of {problem.name!r} ended in the audit of its first plan with {words}",
            replace(solution, success=False, status=SolverStatus.TIME_LIMIT, message=words),
            name="time_limit",
            value=time_limit,
        ) from error


def _next(
    problem: Problem, method: DirectMethod, arguments: dict[str, Any], settings: RefinementSettings
) -> tuple[Solution, Audit] | None:
    """Solve the problem on a finer mesh and audit the plan; return None if the time limit is reached first."""
    if time_left() <= 0:
        return None
    try:
        solution = solve(problem, method, **arguments)
        if not solution.success:
            raise SolveError(f"refinement of {problem.name!r} failed: {solution.status}", solution)
        return solution, judge(problem, solution, **settings.limits)
    except (SolveError, TimeLimitReached) as error:
        if isinstance(error, SolveError) and time_left() > 0:
            raise
        return None


class _Row(NamedTuple):
    """An error that the audit reports, relative to its limit: the value, and the contribution of each interval.

    ``errors`` (N,) are the contributions, None if it cannot be attributed to intervals; ``order`` is the power of the
    interval width with which it falls. ``grows`` tells that unstable dynamics amplify the errors of the intervals.
    """

    name: str
    kind: str
    value: float
    errors: np.ndarray | None = None
    order: int = 1
    grows: bool = False

    def unresolved(self, widths: np.ndarray) -> float:
        """Return the integral of the error over those intervals in which it exceeds its limit.

        ``widths`` (N,) are the interval widths. Splitting the intervals around a boundary layer or a jump lowers the
        integral from the first round on, but the largest error only once the intervals are narrow enough.
        """
        if self.errors is None:
            return self.value
        beyond = self.errors > 1.0
        return float(widths[beyond] @ self.errors[beyond])


def _shares(values: np.ndarray, total: float, summed: bool) -> np.ndarray:
    """Scale contributions (N,) so that their maximum, or mean if they are ``summed``, equals the error ``total``."""
    values = values if np.isfinite(values).all() else np.where(np.isfinite(values), 0.0, 1.0)
    reference = values.mean() if summed else values.max()
    result = np.zeros(len(values))
    result[values > 0] = total * (values[values > 0] / (reference or 1.0))
    return result


def _rows(
    form: Formulation, p: np.ndarray, solution: Solution, audit: Audit, tolerance: float, method: DirectMethod
) -> list[_Row]:
    """Return the errors that the audit of a plan reports, each split into contributions of the mesh intervals."""
    # over the whole horizon an unstable motion diverges; the sum is what feedback would have to correct
    deviation = min(audit.integration_error, float(audit.local_errors.sum()))
    requested = Finding(f"integration error, {tolerance:.0e} requested", deviation, tolerance)
    order, costates = method.control_order, audit.optimality.adjoint
    grows = audit.integration_error > CORRECTION.growth * float(audit.local_errors.sum())
    # kind of each error, contributions of the intervals in any unit, order, and whether the contributions add up
    parts: dict[str, tuple[str, np.ndarray, int, bool]] = {
        requested.name: ("integration", audit.local_errors, method.order, False),
        INTEGRATION: ("integration", audit.local_errors, method.order, grows),
        "integration error of one interval": ("integration", audit.local_errors, method.order, False),
        "cost lost, relative": ("cost", audit.lost, 2 * order, True),
        "costate equation, relative": ("other", costates.error, order, True),
        "costates between the nodes, relative": ("other", costates.between, order, False),
    }
    for name, (equal, misses) in _violations(form, p, solution, audit).items():
        parts[name] = ("equalities" if equal else "limits", misses, order, False)
    rows = []
    for finding in (requested, *audit.findings):
        if finding.limit is None or finding.name in form.separations:  # refinement does not separate bodies
            continue
        value = 0.0 if finding.value == 0 else finding.value / finding.limit if finding.limit > 0 else np.inf
        if finding.name == INTEGRATION and finding.limit > 0 and grows:
            # no mesh reduces the growth: the audit requires that the sum of the defects is below a share of the limit
            value = CORRECTION.growth * float(audit.local_errors.sum()) / finding.limit
        value = np.inf if np.isnan(value) else float(value)
        kind, errors, power, summed = parts.get(finding.name, ("other", np.zeros(0), 1, False))
        if errors.any():
            rows.append(_Row(finding.name, kind, value, _shares(errors, value, summed), power, grows))
        else:
            rows.append(_Row(finding.name, "other", value))
    return rows


def _violations(
    form: Formulation, p: np.ndarray, solution: Solution, audit: Audit
) -> dict[str, tuple[bool, np.ndarray]]:
    """Return, for each bound and path constraint, whether it is an equality, and the violation per interval (N,)."""
    n = len(audit.local_errors)
    x, u = stack(audit.states), stack(audit.controls, len(audit.t))
    g = form.sampled([form.path.expression], x, u, audit.t, solution.horizon, p)[0]
    lower, upper = form.bound_values(p)
    violations = {}
    for kind, pool, values in (
        ("state", {f"bounds of {name}": place for name, place in form.states.items()}, x),
        ("control", {f"bounds of {name}": place for name, place in form.controls.items()}, u),
        ("path", {name: form.path.of(name) for name in form.path.names}, g),
    ):
        for name, place in pool.items():
            index = form.bounds.places[kind][place]
            violation = np.maximum(lower[index] - values[:, place], values[:, place] - upper[index]).clip(min=0.0)
            violation = np.where(np.isnan(violation), np.inf, violation).max(axis=1)
            violations[name] = bool((lower[index] == upper[index]).all()), violation.reshape(n, -1).max(axis=1)
    return violations


def _mesh_at_switches(
    problem: Problem,
    method: DirectMethod,
    solution: Solution,
    errors: tuple[list[_Row], list[_Row]],
    placed: np.ndarray,
    settings: RefinementSettings,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the next mesh with nodes at the switches of a plan, and these nodes; None if every switch has a node.

    Splitting does not reduce the errors of an interval with a switch, which vanish with a node there.

    Args:
        errors: The rows beyond their limits, and all rows.
        placed: Nodes that were put at switches before, and move with them.
    """
    mesh, (beyond, rows) = method.fractions, errors
    at, smeared = locate_switches(problem, solution)
    if not beyond or not (np.abs(at[:, None] - mesh).min(axis=1, initial=np.inf) > settings.same_switch).any():
        return None
    # a node beside a wide interval did not cure it; in a narrow one the switch may still be, as the cost is stationary
    # in its time: a cost known to a share locates it to the root of this share
    tried = np.isin(mesh[:-1], placed) | np.isin(mesh[1:], placed)
    smeared &= ~tried | (np.diff(mesh) <= RESOLVED_SHARE**0.5)
    finer = mesh
    if any(row.errors is not None and (row.errors[~smeared] > 1.0).any() for row in beyond):
        parts, error = _parts_per_interval(beyond, rows, mesh, settings)
        parts[smeared] = 1
        finer = split(mesh, parts, error, settings.max_intervals)
    own = np.clip(np.searchsorted(mesh, placed), 1, method.intervals - 1)
    replaced = ((mesh[own - 1, None] <= at) & (at <= mesh[own + 1, None])).any(axis=1)
    finer = nodes_at_switches(finer[~np.isin(finer, placed[replaced])], at)
    return finer, np.union1d(at, placed[~replaced])


def _parts_per_interval(
    beyond: list[_Row], rows: list[_Row], mesh: np.ndarray, settings: RefinementSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of parts to split each interval into, and each interval's largest error. Shape (N,) each."""
    n = len(mesh) - 1
    parts, error = np.ones(n, int), np.zeros(n)
    if growing := [row for row in beyond if row.name == INTEGRATION and row.grows]:
        beyond = [row for row in beyond if row.kind == "integration"] or growing  # other rows judge diverged states
    for row in beyond:
        if row.errors is not None:
            with np.errstate(over="ignore"):
                count = np.ceil((row.errors / settings.target) ** (1.0 / row.order))
            parts = np.maximum(parts, np.clip(count, 1, settings.max_parts).astype(int))
            error = np.maximum(error, row.errors)
    if np.all(parts == 1):  # the rows beyond their limits cannot be attributed to intervals
        for row in rows:
            error = error if row.errors is None else np.maximum(error, row.errors)
        severe = max((row.value for row in beyond), default=0.0) > 2.0
        parts[severe | (error >= np.median(error))] = 2
    parts[np.diff(mesh) < 2 * settings.least_width] = 1
    return parts, error


def split(mesh: np.ndarray, parts: np.ndarray, error: np.ndarray, max_intervals: int) -> np.ndarray:
    """Return a mesh in which each interval is split into equal parts, with at most ``max_intervals`` intervals in all.

    If these are too few, the intervals of least ``error`` (N,) are split less. ``mesh`` (N + 1,) are the interval ends.
    """
    parts = parts.copy()
    available = max_intervals - len(parts)
    for k in np.argsort(error, kind="stable"):
        excess = int(np.sum(parts - 1)) - available
        if excess <= 0:
            break
        parts[k] = max(1, parts[k] - excess)
    nodes = [np.linspace(mesh[k], mesh[k + 1], n + 1)[:-1] for k, n in enumerate(parts)]
    return np.concatenate([*nodes, mesh[-1:]])
