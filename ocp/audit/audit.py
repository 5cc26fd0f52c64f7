"""The audit: does a plan do what it says, between its nodes too, and is it an extremal?

It trusts nothing that the solver says of its plan. The controls are integrated anew, every constraint is looked at on
a grid ten times as fine, and the minimum principle is checked with multipliers found anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ocp.audit.clearance import Clearance, clearance
from ocp.audit.linearisation import Linearisation
from ocp.audit.optimality import Optimality, optimality
from ocp.audit.reintegration import Reintegration, Violation, reintegrate, violations
from ocp.audit.sizes import Sizes, fine_grid, sizes_along
from ocp.console import check_time, interruptible
from ocp.curves import PiecewisePolynomial
from ocp.errors import ProblemError, checked_mapping, unknown_name
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem
from ocp.solution import Solution, check_structure, check_variables_match, match_order, stack, unstack
from ocp.tolerances import (
    CLEARANCE_TOLERANCE_M,
    COSTATE_SHARE,
    FLAT_SHARE,
    LIMIT_SHARE,
    SOLVER_SHARE,
    UNFIT_COSTATE_SHARE,
)

__all__ = ["Audit", "Finding", "audit"]


@dataclass(frozen=True)
class Finding:
    """One line of the table.

    Attributes:
        name: What was looked at.
        value: How far it is off, in ``unit`` or relative where the name says so.
        limit: What it may be, or None where it is only told.
        time: Where it is worst, s, or None.
        note: What the value means where that is not plain.
        verdict: "feasible" or "optimal", to which of the two it belongs.
        unit: Of value and limit, "" where they are shares or no unit was declared.
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
        return self.limit is None or bool(self.value <= self.limit)  # nan does not pass


@dataclass(frozen=True)
class Audit:
    """What an independent look at a plan found.

    Attributes:
        name: Of the problem.
        findings: One for every check.
        undecided: Why it is not decided whether the plan is a local minimum, or "".
        constraints: Worst violation of every bound and constraint by name, on the fine grid; 0 where it holds.
        integration_error: Largest distance of the plan's states from the re-integrated ones, relative to the size of
            each state, over the whole horizon. local_errors: the same of each interval alone, from its own start. (N,)
        t, states, controls: The re-integrated plan: times, s (M,), and values by name, each (M, n). Interior mesh
            times stand twice, with the controls of both sides.
        clearances: How near bodies that have to stay apart come, proven between the samples, by separation.
        optimality: Costates, multipliers, curvature, and what the plan loses. lost: of the cost in each interval. (N,)
    """

    name: str
    findings: tuple[Finding, ...]
    undecided: str
    constraints: dict[str, float]
    integration_error: float
    local_errors: np.ndarray
    t: np.ndarray
    states: dict[str, np.ndarray]
    controls: dict[str, np.ndarray]
    clearances: dict[str, Clearance]
    optimality: Optimality

    @property
    def feasible(self) -> bool:
        """Whether the motion does what is asked: dynamics, bounds, constraints, ends, horizon, the cost reported."""
        return all(finding.passed for finding in self.findings if finding.verdict == "feasible")

    @property
    def optimal(self) -> bool | None:
        """Whether the plan is a local minimum; None where that is not decided, see ``undecided``."""
        if not all(finding.passed for finding in self.findings if finding.verdict == "optimal"):
            return False
        return None if self.undecided else True

    @property
    def passed(self) -> bool:
        """Whether the plan is feasible, and a local minimum."""
        return self.feasible and self.optimal is True

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The findings beyond their limits."""
        return tuple(finding for finding in self.findings if not finding.passed)

    @property
    def lost(self) -> np.ndarray:
        """What of the cost each interval loses to the extremal beside the plan, in units of cost. Shape (N,)."""
        return self.optimality.lost

    def __getitem__(self, name: str) -> Finding:
        """A finding by its name."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise unknown_name("finding", name, [finding.name for finding in self.findings])

    @property
    def sentence(self) -> str:
        """What follows from the findings, in one sentence."""
        if not self.feasible:
            worst = next(f for f in self.failures if f.verdict == "feasible")
            where = "" if worst.time is None else f" at {worst.time:.4g} s"
            return f"must not be run: {worst.name} is {worst.value:.3g}{where}, {worst.limit:.3g} allowed"
        if self.optimal is None:
            return f"may be run; whether it is a local minimum is not decided: {self.undecided}"
        if not self.optimal:
            worst = next(f for f in self.failures if f.verdict == "optimal")
            return f"may be run, but is no local minimum: {worst.name} is {worst.value:.3g}, {worst.limit:.3g} allowed"
        share = self["cost lost, relative"].value
        return f"may be run; a local minimum; at most {share:.2g} of its cost dearer than the extremal beside it"

    def __repr__(self) -> str:
        return f"<Audit of {self.name!r}: {self._word}; {len(self.findings)} findings, {len(self.failures)} failed>"

    @property
    def _word(self) -> str:
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
                    line = (
                        f"  {f.name:<{width}}  {f.value:>10.2e}  {limit:>10}  {f.unit:<6}  {time:>8}  {ok:<6}  {f.note}"
                    )
                    lines.append(line.rstrip())
        return "\n".join([*lines, f"The plan {self.sentence}."])


@interruptible
@np.errstate(invalid="ignore", over="ignore")  # what is not a number fails by name
def audit(
    problem: Problem,
    solution: Solution,
    *,
    integration: float = LIMIT_SHARE,
    constraints: float = LIMIT_SHARE,
    lost: float = LIMIT_SHARE,
    costates: float | None = None,
    stationarity: float | None = None,
    drift: float | None = None,
    tolerances: Mapping[str, float] | None = None,
) -> Audit:
    """Check a plan independently of the solver that made it.

    Sizes are those of each named thing along the plan (:class:`ocp.audit.sizes.Sizes`): its spread, and for a
    constraint the spread of what it is made of. Multiplying anything by a power of ten, or moving its origin, changes
    no verdict.

    The plan is looked at on a grid ten times as fine as its own points. What is narrower than a step of it and is no
    part of the dynamics, a wall thinner than the way between two samples say, is not seen. The dynamics are looked at
    twice as often, and where they push there the plan is integrated step by step.

    What the audit derives of a problem is kept with it until more is declared, so that further audits take less time.

    Where unstable dynamics carry the re-integrated states away from a plan that every interval keeps, the row of the
    whole horizon is only told, and bounds, constraints and cost are judged interval by interval.

    Args:
        problem: What was asked. solution: The plan.
        integration: Largest distance from the re-integrated states, relative to the size of each state, and relative
            error of the cost.
        constraints: Largest violation of a bound or constraint, as a share of its size; the tolerance that it declares
            itself (:meth:`ocp.problem.problem.Problem.path`) where that is less.
        lost: What of its cost the plan may lose to the extremal beside it, as a share.
        costates: Largest error of the costates against their own equation, over the whole plan, and of the conditions
            at the ends, as a share of the cost. None: 1e-2, or the root of the share that the plan loses.
        stationarity: Largest reduced gradient of the Hamiltonian, relative to its parts; None: it is told, and judged
            by the cost that it loses.
        drift: Largest change of the Hamiltonian where time does not enter, relative to its parts; None: it is told.
        tolerances: Largest violation by name of a state, control, constraint or separation, in its own unit.

    Raises:
        ProblemError: The plan does not belong to the problem, a limit is not a number, or a name in ``tolerances`` is
            unknown.
        TimeLimitReached: Inside :func:`ocp.console.limited` alone, behind its limit.
    """
    limits = checked_mapping("audit: tolerances", tolerances)
    named = {"integration": integration, "constraints": constraints, "lost": lost, **limits}
    told = {"costates": costates, "stationarity": stationarity, "drift": drift}
    for name, limit in {**named, **{k: v for k, v in told.items() if v is not None}}.items():
        if isinstance(limit, bool) or not isinstance(limit, int | float | np.number) or not limit >= 0:
            words = f"audit: tolerance {name!r} must be a number, zero or positive, not {limit!r}"
            raise ProblemError(words, name=name, value=limit)
    form = Formulation.of(problem)
    check_structure(solution)
    check_variables_match(form, solution)
    solution = match_order(form, solution)
    p = form.parameter_vector(solution.parameters)
    bounds = form.bound_values(p)
    grid = fine_grid(solution)
    size = sizes_along(form, grid, solution.horizon, p, bounds)
    along = Linearisation(form, solution, p, bounds, size)
    again = reintegrate(along, grid)
    check_time()

    findings = []
    off = again.carried_off(integration)
    findings.append(integration_finding(again, integration, off))
    findings.append(worst("integration error of one interval", again.local_errors, again.t, integration))
    motion, running = (again.local, again.local_cost) if off else (again.states, again.cost)
    final = form.terminal_cost(motion[-1], motion[0], again.controls[0], solution.horizon, p)
    cost = cost_finding(solution, running, final, size, integration)
    findings.append(cost)
    findings.append(reported_finding(solution, size, integration))
    findings.append(horizon_finding(form, solution, bounds))

    rows = (form.path, form.start, form.end, form.watch)
    names = [*form.states, *form.controls, *form.separations, *[name for kind in rows for name in kind.names]]
    for name in limits:
        if name not in names:
            raise unknown_name("name in tolerances", name, names)
    total: dict[str, float] = {}
    for check in violations(form, again, motion, size, bounds, p, solution.horizon, constraints, grid.states):
        finding = violation_finding(check, constraints, limits.get(check.name))
        findings.append(replace(finding, unit=form.units.get(check.name, "")))
        total[check.name] = max(total.get(check.name, 0.0), float(np.max(check.missed)))

    clearances = {name: clearance(form, each, solution, p) for name, each in problem.declared.apart.items()}
    findings += [clearance_finding(each, limits.get(name, CLEARANCE_TOLERANCE_M)) for name, each in clearances.items()]
    findings.append(jump("state jump, relative", solution.state_interpolant, solution.horizon, size.state, integration))
    findings.append(jump("control jump, relative", solution.control_interpolant, solution.horizon, size.control, None))
    sound = all(finding.passed for finding in findings)
    # the best multipliers of a plan that must not be run anyway are nobody's concern
    found = optimality(form, solution, p, bounds, along, lost if sound else np.inf)
    over = cost.value if cost.passed and solution.cost > running + final else 0.0
    findings += optimality_findings(form, found, over, lost, costates, stationarity, drift)
    undecided = found.curvature.flat
    if not solution.success:
        undecided = f"the solver says {solution.message or solution.status}"
    return Audit(
        form.name,
        tuple(findings),
        undecided,
        total,
        float(np.max(again.errors)),
        again.local_errors.reshape(-1, grid.samples).max(axis=1),
        again.t,
        unstack(solution.states, again.states),
        unstack(solution.controls, again.controls),
        clearances,
        found,
    )


def horizon_finding(form: Formulation, solution: Solution, bounds: Bounds) -> Finding:
    """The plan's horizon and its last time against the horizon that is asked, to a solver's tolerance."""
    low, high = (float(side[form.bounds.places["horizon"][0]]) for side in bounds)
    miss = max(low - solution.horizon, solution.horizon - high, abs(float(solution.t[-1]) - solution.horizon))
    asked = f"{low:.6g} s" if low == high else f"{low:.6g} to {high:.6g} s"
    return Finding("horizon", miss, SOLVER_SHARE * solution.horizon, None, f"{solution.horizon:.6g} s, asked {asked}")


def optimality_findings(
    form: Formulation,
    found: Optimality,
    over: float,
    lost: float,
    costates: float | None,
    stationarity: float | None,
    drift: float | None,
) -> list[Finding]:
    """First and second order.

    Errors of the costates cost by their square: a transcription that loses a share of the cost knows its costates to
    the root of it, which is no fault of its own. Curvature says something at an extremal alone. ``over`` is the
    share of the cost that the plan reports too much.
    """
    cost, errors = found.cost_size, found.error_size
    share = float(found.lost.sum()) / cost + over
    if costates is None:
        costates = max(COSTATE_SHARE, found.known_to)
    rows = [
        Finding("cost lost, relative", share, lost, None, f"{found.lost.sum():.3g} of the cost"),
        Finding("costate equation, relative", found.adjoint.total / errors, costates),
        Finding("costates beside the best, relative", found.unfit, UNFIT_COSTATE_SHARE if found.flat else costates),
        worst("costates between the nodes, relative", found.adjoint.between / errors, found.adjoint.t[:-1], costates),
        Finding("transversality, relative", found.adjoint.ends.transversality / errors, costates),
    ]
    if form.horizon_is_free:
        rows.append(Finding("condition of the free horizon, relative", found.adjoint.ends.horizon / errors, costates))
    second = found.curvature
    note = f"not decided: {second.flat}" if second.upwards is None else f"least {second.least:.3g} of the largest"
    downwards = 0.0 if second.upwards is not False else max(-second.least, FLAT_SHARE)
    limit = None if second.upwards is None or not share <= lost else 0.0
    rows.append(Finding("curvature downwards, relative", downwards, limit, second.time, note))
    if form.nu:
        rows.append(worst("stationarity, relative", found.stationarity, found.t, stationarity))
    change, limit = found.hamiltonian.drift, drift if form.autonomous else None
    name = "Hamiltonian drift, relative" if form.autonomous else "Hamiltonian change, relative"
    note = f"{change:.2e} in cost per second" + ("" if form.autonomous else "; time enters the problem")
    rows.append(Finding(name, change / found.hamiltonian.scale, limit, None, note))
    return [replace(row, verdict="optimal") for row in rows]


def clearance_finding(found: Clearance, limit: float) -> Finding:
    """How much nearer than they are asked to stay bodies may come, by what is proven."""
    worst = found.worst
    missed, time = (0.0, None) if worst is None else (worst.missed, worst.time)
    return Finding(found.name, missed, limit, time, str(found), unit="m")


def integration_finding(again: Reintegration, limit: float, carried_off: bool) -> Finding:
    """The distance from the plan over the whole horizon, which is only told where unstable dynamics explain it."""
    notes = [] if again.broke_down is None else [f"the integration broke down at {again.broke_down:.6g} s"]
    if carried_off:
        notes.append(f"unstable: the intervals add {again.added[-1]:.2g}, which the dynamics let grow")
    judged = None if carried_off else limit
    return worst("integration error, relative", again.errors, again.t, judged, "; ".join(notes))


def violation_finding(found: Violation, constraints: float, tolerance: float | None) -> Finding:
    """A bound or constraint where it is missed most: for its size, or in its own unit where a tolerance is given."""
    if tolerance is not None:
        return worst(found.label, found.missed, found.t, tolerance)
    k = int(np.argmax(found.shares))
    size, share = float(found.sizes[k]), float(found.shares[k])
    return Finding(found.label, share * size, constraints * size, float(found.t[k]) if share > 0 else None)


def worst(name: str, values: np.ndarray, times: np.ndarray, limit: float | None, note: str = "") -> Finding:
    """A finding of the largest of some values; one that is not a number is the worst."""
    if values.size == 0:
        return Finding(name, 0.0, limit, None, note)
    clean = np.where(np.isnan(values), np.inf, values)
    k = int(np.argmax(clean))
    return Finding(name, float(clean[k]), limit, float(times[k]) if clean[k] > 0 else None, note)


def cost_finding(solution: Solution, running: float, final: float, sizes: Sizes, limit: float) -> Finding:
    """The cost of the re-integrated plan, along it and at its end, against the one the solver reports."""
    cost = running + final
    size = max(abs(cost), abs(final), abs(solution.cost), sizes.cost)  # parts of the cost may cancel
    off = abs(cost - solution.cost) / size if size > 0 else abs(cost - solution.cost)
    return Finding("cost, relative", off, limit, None, f"reported {solution.cost:.8g}, integrated {cost:.8g}")


def reported_finding(solution: Solution, sizes: Sizes, limit: float) -> Finding:
    """The reported arrays against the interpolants, relative; at a break the value of either side will do."""
    off = np.zeros(len(solution.t))
    costates = float(np.max(np.abs(solution.costate_interpolant.values), initial=0.0)) or 1.0
    at = np.add.outer([-1e-12, 1e-12], solution.t / solution.horizon).ravel()
    for pool, curve, size in (
        (solution.states, solution.state_interpolant, sizes.state),
        (solution.controls, solution.control_interpolant, sizes.control),
        (solution.costates, solution.costate_interpolant, costates),
    ):
        values = stack(pool, len(off))
        sides = np.abs(curve(at).reshape(2, len(off), -1 if values.size else 0) - values) / size
        off = np.maximum(off, sides.max(axis=2, initial=0.0).min(axis=0))
    return worst("reported values, relative", off, solution.t, limit)


def jump(
    name: str, interpolant: PiecewisePolynomial, horizon: float, sizes: np.ndarray, limit: float | None
) -> Finding:
    """Largest jump between two pieces, relative to the size of what jumps."""
    n = len(interpolant.breaks) - 1
    pieces = np.arange(n)
    left = interpolant.within(pieces[:-1], np.ones(n - 1))
    right = interpolant.within(pieces[1:], np.zeros(n - 1))
    gaps = np.abs(right - left)
    note = f"{np.max(gaps, initial=0.0):.3g} in its own unit"
    return worst(name, (gaps / sizes).max(axis=1, initial=0.0), interpolant.breaks[1:-1] * horizon, limit, note)
