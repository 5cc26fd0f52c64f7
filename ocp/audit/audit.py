"""Audit of a plan: is it feasible, also between its mesh nodes, and is it a local minimum of the cost?

The audit does not rely on the solver. It integrates the controls anew, evaluates every constraint on a grid ten times
as fine as the plan, and checks the minimum principle with newly computed multipliers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ocp.audit.clearance import Clearance, clearance
from ocp.audit.linearisation import Linearisation
from ocp.audit.optimality import Optimality, optimality
from ocp.audit.reintegration import Reintegration, Violation, reintegrate, violations
from ocp.audit.sizes import Sizes
from ocp.console import check_time, interruptible
from ocp.curves import PiecewisePolynomial
from ocp.errors import ProblemError, require
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.solution_data import check_structure, check_variables_match, match_order, stack, unstack
from ocp.tolerances import (
    CLEARANCE_TOLERANCE_M,
    COSTATE_SHARE,
    FLAT_SHARE,
    LIMIT_SHARE,
    SOLVER_SHARE,
    UNFIT_COSTATE_SHARE,
)

COST_LOST = "cost lost, relative"
"""Name of the finding that reports how much more a plan costs than the nearest extremal, relative to the cost."""


@dataclass(frozen=True)
class Finding:
    """Result of one check of an audit: the deviation of the plan and the largest allowed deviation.

    Attributes:
        name: What is checked.
        value: Deviation, in ``unit``, or relative where the name says so.
        limit: Largest allowed value, or None if the value is only reported.
        time: Time of the largest deviation, s, or None.
        note: Explanation of the value.
        verdict: "feasible" or "optimal": the verdict that the check belongs to.
        unit: Unit of value and limit, "" if they are shares or no unit was declared.
    """

    name: str
    value: float
    limit: float | None = None
    time: float | None = None
    note: str = ""
    verdict: str = "feasible"
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value is at most the limit, or there is no limit; nan exceeds every limit."""
        return self.limit is None or bool(self.value <= self.limit)


@dataclass(frozen=True)
class Audit:
    """Result of the audit of a plan: the findings of all checks, and the quantities computed for the checks.

    Attributes:
        name: Name of the problem.
        findings: Results of the checks, one for every check.
        undecided: Why it is undetermined whether the plan is a local minimum, or "".
        remarks: Facts that a user of the plan should know, although they change no verdict.
        constraints: Largest violation of every bound and constraint on the fine grid by name; 0 if it is satisfied.
        integration_error: Largest difference of the plan's states from the re-integrated ones over the whole horizon,
            relative to the size of each state.
        local_errors: The same within each mesh interval, integrated from the plan's state at its start. Shape (N,).
        t: Times of the re-integrated plan, s. Interior mesh times occur twice, with the controls of both sides. Shape
            (M,).
        states, controls: Values of the re-integrated plan by name. Shape (M, n) each.
        clearances: Proven clearance of each separation by name.
        optimality: Costates, multipliers, curvature, and the cost that the plan loses; None if only the feasibility was
            checked, or for a plan that solves no optimal control problem, whose fields from `constraints` on are empty.
    """

    name: str
    findings: tuple[Finding, ...]
    undecided: str
    constraints: dict[str, float] = field(default_factory=dict)
    integration_error: float = 0.0
    local_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    t: np.ndarray = field(default_factory=lambda: np.zeros(0))
    states: dict[str, np.ndarray] = field(default_factory=dict)
    controls: dict[str, np.ndarray] = field(default_factory=dict)
    clearances: dict[str, Clearance] = field(default_factory=dict)
    optimality: Optimality = field(default=None)  # type: ignore[assignment]
    remarks: tuple[str, ...] = ()

    @property
    def feasible(self) -> bool:
        """Whether the plan satisfies dynamics, bounds, constraints and horizon, and reports its cost correctly."""
        return all(finding.passed for finding in self.findings if finding.verdict == "feasible")

    @property
    def optimal(self) -> bool | None:
        """Whether the plan is a local minimum; None if that is undetermined, see ``undecided``."""
        if not all(finding.passed for finding in self.findings if finding.verdict == "optimal"):
            return False
        return None if self.undecided else True

    @property
    def passed(self) -> bool:
        """Whether the plan is feasible and a local minimum."""
        return self.feasible and self.optimal is True

    @property
    def failures(self) -> tuple[Finding, ...]:
        """Findings of the checks that the plan did not pass."""
        return tuple(finding for finding in self.findings if not finding.passed)

    @property
    def lost(self) -> np.ndarray:
        """Excess cost of each mesh interval over that of the nearest extremal, in units of the cost. Shape (N,)."""
        return np.zeros(0) if self.optimality is None else self.optimality.lost

    def __getitem__(self, name: str) -> Finding:
        """Return a finding by its name."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise require.unknown("finding", name, [finding.name for finding in self.findings])

    @property
    def sentence(self) -> str:
        """Verdict of the audit in words that complete a sentence which begins with "The plan"."""
        return "; ".join([self._verdict, *self.remarks])

    @property
    def _verdict(self) -> str:
        if not self.feasible:
            worst = next(f for f in self.failures if f.verdict == "feasible")
            where = "" if worst.time is None else f" at {worst.time:.4g} s"
            return f"must not be run: {worst.name} is {worst.value:.3g}{where}, {worst.limit:.3g} allowed"
        if self.optimal is None:
            return f"may be run; whether it is a local minimum is not decided: {self.undecided}"
        if not self.optimal:
            worst = next(f for f in self.failures if f.verdict == "optimal")
            return f"may be run, but is no local minimum: {worst.name} is {worst.value:.3g}, {worst.limit:.3g} allowed"
        return "may be run; no better motion is near it (certified to second order)"

    def __repr__(self) -> str:
        return f"<Audit of {self.name!r}: {self._word}; {len(self.findings)} findings, {len(self.failures)} failed>"

    @property
    def _word(self) -> str:
        """Verdict of the audit in one or two words, for example "passed"."""
        return "passed" if self.passed else "not decided" if self.feasible and self.optimal is None else "FAILED"

    def __str__(self) -> str:
        width = max(len(finding.name) for finding in self.findings)
        lines = [f"Audit of {self.name!r}: {self._word}"]
        words = {True: "yes", False: "NO", None: "not decided"}
        for verdict, holds in (("feasible", self.feasible), ("optimal", self.optimal)):
            title = f"{verdict}: {words[holds]}"
            lines.append(f"  {title:<{width}}  {'value':>10}  {'limit':>10}  {'unit':<6}  {'at, s':>8}")
            for f in self.findings:
                if f.verdict == verdict:
                    limit = "" if f.limit is None else f"{f.limit:.2e}"
                    time = "" if f.time is None else f"{f.time:.4f}"
                    ok = "" if f.limit is None else "ok" if f.passed else "FAILED"
                    line = f"  {f.name:<{width}}  {f.value:>10.2e}  {limit:>10}  {f.unit:<6}  {time:>8}"
                    lines.append(f"{line}  {ok:<6}  {f.note}".rstrip())
        return "\n".join([*lines, f"The plan {self.sentence}."])


@interruptible
@np.errstate(invalid="ignore", over="ignore")  # nan fails its check, with its name
def audit(
    problem: Problem,
    solution: Solution,
    *,
    integration: float = LIMIT_SHARE,
    constraints: float = LIMIT_SHARE,
    lost: float = LIMIT_SHARE,
    costates: float | None = None,
    tolerances: Mapping[str, float] | None = None,
    only_feasible: bool = False,
) -> Audit:
    """Check a plan for feasibility and local optimality, independently of the solver that computed it.

    Tolerances are relative to sizes along the plan (:class:`ocp.audit.sizes.Sizes`): the spread of a quantity and, for
    a constraint, its change with the quantities it depends on. Scaling anything by a power of ten, or moving its
    origin, changes no verdict.

    The plan is checked on a grid ten times as fine as its own points. Features of constraints narrower than a grid
    step, such as a wall thinner than the path between two samples, are not seen. The dynamics are evaluated twice as
    finely, and are integrated step by step where they demand it.

    Derived functions are cached with the problem until more is declared, so that further audits take less time.

    Unstable dynamics may carry the re-integrated states away from a plan that satisfies the dynamics in every interval.
    Then the finding for the whole horizon is only reported, and bounds, constraints and cost are judged by interval.

    Args:
        problem: The problem.
        solution: The plan.
        integration: Largest difference from the re-integrated states, relative to the size of each state, and largest
            relative error of the cost.
        constraints: Largest violation of a bound or constraint, as a share of its size. The tolerance that it declares
            itself (:meth:`ocp.problem.problem.Problem.path`) applies if it is smaller.
        lost: Largest excess cost over the nearest extremal, as a share of the cost.
        costates: Largest error of the costate equation over the whole plan, and of the conditions at the ends, as a
            share of the cost. None: 1e-2, or the root of the share that the plan loses if that is larger.
        tolerances: Largest violation by name of a state, control, constraint or separation, in its own unit.
        only_feasible: Whether the optimality is not checked, which may take most of the time.

    Raises:
        ProblemError: The plan does not belong to the problem, a limit is not a number, or a name in ``tolerances`` is
            unknown.
        TimeLimitReached: Only inside :func:`ocp.console.time_limited`, after its limit.
    """
    limits = require.mapping("audit: tolerances", tolerances)
    judged = {"integration": integration, "constraints": constraints, "lost": lost, **limits}
    for name, limit in {**judged, **({} if costates is None else {"costates": costates})}.items():
        if isinstance(limit, bool) or not isinstance(limit, int | float | np.number) or not limit >= 0:
            words = f"audit: tolerance {name!r} must be a number, zero or positive, not {limit!r}"
            raise ProblemError(words, name=name, value=limit)
    form = Formulation.of(problem)
    check_structure(solution)
    check_variables_match(form, solution)
    solution = match_order(form, solution)
    along = Linearisation(form, solution)
    p, grid, size, motion = along.p, along.grid, along.sizes, reintegrate(along)
    check_time()

    findings = []
    is_unstable = motion.is_unstable(integration)
    findings.append(integration_finding(motion, integration, is_unstable))
    findings.append(_worst("integration error of one interval", motion.local_errors, grid.t, integration))
    judged_states, running = (motion.local, motion.local_cost) if is_unstable else (motion.states, motion.cost)
    final = form.terminal_cost(judged_states[-1], judged_states[0], grid.controls[0], horizon=solution.horizon, p=p)
    cost = _cost_finding(solution, running, final, size, integration)
    findings.append(cost)
    findings.append(reported_finding(solution, size, integration))
    findings.append(horizon_finding(form, solution, along.bounds))

    rows = (form.path, form.start, form.end, form.watch)
    names = [*form.states, *form.controls, *form.separations, *[name for kind in rows for name in kind.names]]
    for name in limits:
        if name not in names:
            raise require.unknown("name in tolerances", name, names)
    constraint_values: dict[str, float] = {}
    for check in violations(along, motion, judged_states, constraints):
        finding = violation_finding(check, constraints, limits.get(check.name))
        findings.append(replace(finding, unit=form.units.get(check.name, "")))
        constraint_values[check.name] = max(constraint_values.get(check.name, 0.0), float(np.max(check.excess)))

    clearances = {name: clearance(form, each, solution, p) for name, each in problem.declared.apart.items()}
    findings += [clearance_finding(each, limits.get(name, CLEARANCE_TOLERANCE_M)) for name, each in clearances.items()]
    findings.append(
        _jump("state jump, relative", solution.state_interpolant, solution.horizon, size.state, integration)
    )
    findings.append(_jump("control jump, relative", solution.control_interpolant, solution.horizon, size.control, None))
    is_sound = all(finding.passed for finding in findings)
    optimum: Any = None
    undecided = "the optimality was not checked"
    if not solution.success:
        undecided = f"the solver says {solution.message or solution.status}"
    if not (only_feasible or solution.has_no_multipliers):
        # an infeasible plan does not need the best multipliers
        optimum = optimality(along, lost if is_sound else np.inf)
        excess = cost.value if cost.passed and solution.cost > running + final else 0.0
        findings += optimality_findings(form, optimum, excess, lost, costates=costates)
        undecided = undecided if not solution.success else optimum.curvature.flat
    return Audit(
        form.name,
        tuple(findings),
        undecided,
        constraint_values,
        float(np.max(motion.errors)),
        motion.local_errors.reshape(-1, grid.samples).max(axis=1),
        grid.t,
        unstack(solution.states, motion.states),
        unstack(solution.controls, grid.controls),
        clearances,
        optimum,
    )


def horizon_finding(form: Formulation, solution: Solution, bounds: Bounds) -> Finding:
    """Return the finding on whether a plan's horizon and its last time agree with the declared horizon."""
    low, high = (float(side[form.bounds.places["horizon"][0]]) for side in bounds)
    miss = max(low - solution.horizon, solution.horizon - high, abs(float(solution.t[-1]) - solution.horizon))
    declared = f"{low:.6g} s" if low == high else f"{low:.6g} to {high:.6g} s"
    note = f"{solution.horizon:.6g} s, declared {declared}"
    return Finding("horizon", miss, SOLVER_SHARE * solution.horizon, None, note)


def optimality_findings(
    form: Formulation, optimum: Optimality, excess: float, lost: float, *, costates: float | None
) -> list[Finding]:
    """Return the findings about the first- and second-order optimality conditions of a plan.

    The cost is quadratic in errors of the costates: a transcription that loses a share of the cost determines its
    costates to the root of this share. The curvature is judged only at an extremal. ``excess`` is the share of the cost
    that the plan over-reports.
    """
    cost, errors = optimum.cost_size, optimum.error_size
    between = optimum.adjoint.between / errors
    share = float(optimum.lost.sum()) / cost + excess
    if costates is None:
        costates = max(COSTATE_SHARE, optimum.costate_accuracy)
    best_costates = UNFIT_COSTATE_SHARE if optimum.has_linear_control else costates
    rows = [
        Finding(COST_LOST, share, lost, None, f"{optimum.lost.sum():.3g} of the cost"),
        Finding("costate equation, relative", optimum.adjoint.total / errors, costates),
        Finding("costates beside the best, relative", optimum.costate_error, best_costates),
        _worst("costates between the nodes, relative", between, optimum.adjoint.t[:-1], costates),
        Finding("transversality, relative", optimum.adjoint.ends.transversality / errors, costates),
    ]
    if form.horizon_is_free:
        rows.append(Finding("condition of the free horizon, relative", optimum.adjoint.ends.horizon / errors, costates))
    second = optimum.curvature
    note = f"not decided: {second.flat}" if second.upwards is None else f"least {second.least:.3g} of the largest"
    note = second.proof or note
    downwards = 0.0 if second.upwards is not False else max(-second.least, FLAT_SHARE)
    limit = None if second.upwards is None or not share <= lost else 0.0
    rows.append(Finding("curvature downwards, relative", downwards, limit, second.time, note))
    if form.nu:
        rows.append(_worst("stationarity, relative", optimum.stationarity, optimum.t, None))
    change = optimum.hamiltonian.drift
    name = "Hamiltonian drift, relative" if form.autonomous else "Hamiltonian change, relative"
    note = f"{change:.2e} in cost per second" + ("" if form.autonomous else "; time enters the problem")
    rows.append(Finding(name, change / optimum.hamiltonian.scale, None, None, note))
    return [replace(row, verdict="optimal") for row in rows]


def clearance_finding(clearance: Clearance, limit: float) -> Finding:
    """Return the finding about the largest possible shortfall below a required clearance."""
    pair = clearance.worst
    missed, time = (0.0, None) if pair is None else (pair.missed, pair.time)
    return Finding(clearance.name, missed, limit, time, str(clearance), unit="m")


def integration_finding(motion: Reintegration, limit: float, is_unstable: bool) -> Finding:
    """Return the finding about the deviation of a plan's states from states re-integrated under its controls."""
    notes = [] if motion.breakdown_time is None else [f"the integration broke down at {motion.breakdown_time:.6g} s"]
    if is_unstable:
        notes.append(f"unstable dynamics amplify {motion.added[-1]:.2g}, the sum of the defects of the intervals")
    effective_limit = None if is_unstable else limit
    return _worst("integration error, relative", motion.errors, motion.grid.t, effective_limit, "; ".join(notes))


def violation_finding(violation: Violation, constraints: float, tolerance: float | None) -> Finding:
    """Return a finding: a constraint's largest violation, compared with `tolerance` or a share of the values' size."""
    if tolerance is not None:
        return _worst(violation.label, violation.excess, violation.t, tolerance)
    k = int(np.argmax(violation.shares))
    size, share = float(violation.sizes[k]), float(violation.shares[k])
    return Finding(violation.label, share * size, constraints * size, float(violation.t[k]) if share > 0 else None)


def _worst(name: str, values: np.ndarray, times: np.ndarray, limit: float | None, note: str = "") -> Finding:
    """Return a finding about the largest of several values over time; nan counts as infinite."""
    if values.size == 0:
        return Finding(name, 0.0, limit, None, note)
    clean = np.where(np.isnan(values), np.inf, values)
    k = int(np.argmax(clean))
    return Finding(name, float(clean[k]), limit, float(times[k]) if clean[k] > 0 else None, note)


def _cost_finding(solution: Solution, running: float, final: float, sizes: Sizes, limit: float) -> Finding:
    """Return the finding about the difference between the reported cost of a plan and the re-integrated cost."""
    cost = running + final
    size = max(abs(cost), abs(final), abs(solution.cost), sizes.cost)  # parts of the cost may cancel
    error = abs(cost - solution.cost) / size if size > 0 else abs(cost - solution.cost)
    return Finding("cost, relative", error, limit, None, f"reported {solution.cost:.8g}, integrated {cost:.8g}")


def reported_finding(solution: Solution, sizes: Sizes, limit: float) -> Finding:
    """Return the finding about the largest difference between the samples that a plan reports and its interpolants.

    It is relative to the sizes. At a break of an interpolant the values of either side count.
    """
    errors = np.zeros(len(solution.t))
    costates = float(np.max(np.abs(solution.costate_interpolant.values), initial=0.0)) or 1.0
    at = np.add.outer([-1e-12, 1e-12], solution.t / solution.horizon).ravel()
    for pool, curve, size in (
        (solution.states, solution.state_interpolant, sizes.state),
        (solution.controls, solution.control_interpolant, sizes.control),
        (solution.costates, solution.costate_interpolant, costates),
    ):
        values = stack(pool, len(errors))
        sides = np.abs(curve(at).reshape(2, len(errors), -1 if values.size else 0) - values) / size
        errors = np.maximum(errors, sides.max(axis=2, initial=0.0).min(axis=0))
    return _worst("reported values, relative", errors, solution.t, limit)


def _jump(
    name: str, interpolant: PiecewisePolynomial, horizon: float, sizes: np.ndarray, limit: float | None
) -> Finding:
    """Return the finding about the largest jump of a piecewise polynomial at its breaks, relative to given sizes."""
    n = len(interpolant.breaks) - 1
    segments = np.arange(n)
    left = interpolant.within(segments[:-1], np.ones(n - 1))
    right = interpolant.within(segments[1:], np.zeros(n - 1))
    jumps = np.abs(right - left)
    note = f"{np.max(jumps, initial=0.0):.3g} in its own unit"
    return _worst(name, (jumps / sizes).max(axis=1, initial=0.0), interpolant.breaks[1:-1] * horizon, limit, note)
