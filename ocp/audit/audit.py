"""The audit: does a plan do what it says, between its nodes too, and is it an extremal?

It trusts nothing that the solver says of its plan. The controls are integrated anew, every constraint is looked at on
a grid ten times as fine, and the minimum principle is checked with multipliers found anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ocp.audit.optimality import Optimality, optimality
from ocp.audit.principle import FLAT
from ocp.audit.reintegration import Reintegration, reintegrate, violations
from ocp.curves import PiecewisePolynomial
from ocp.errors import ProblemError, checked_mapping, unknown_name
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.problem import Problem
from ocp.solution import Solution, check_belongs, check_structure, in_order_of, stack, unstack

__all__ = ["Audit", "Finding", "audit"]

GRID_FACTOR = 10  # times as fine as the plan's own points is the grid on which constraints are looked at
HORIZON_SLACK = 1e-6  # of the horizon, which solvers keep to their tolerance


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
        share = float(self.lost.sum()) / self.optimality.cost_size
        return f"may be run; a local minimum; at most {share:.2g} of its cost dearer than the extremal beside it"

    def __str__(self) -> str:
        width = max(len(finding.name) for finding in self.findings)
        lines = [f"Audit of {self.name!r}: {'passed' if self.passed else 'FAILED'}"]
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


@np.errstate(invalid="ignore", over="ignore")  # what is not a number fails by name
def audit(
    problem: Problem,
    solution: Solution,
    *,
    integration: float = 1e-3,
    constraints: float = 1e-3,
    lost: float = 1e-3,
    costates: float = 1e-2,
    stationarity: float | None = None,
    drift: float | None = None,
    tolerances: Mapping[str, float] | None = None,
) -> Audit:
    """Check a plan independently of the solver that made it.

    Args:
        problem: What was asked. solution: The plan.
        integration: Largest relative distance from the re-integrated states, and relative error of the cost.
        constraints: Largest violation of a bound or constraint, as a share of its scale: the width of its range, else
            the size of its bound, else 1.
        lost: What of its cost the plan may lose to the extremal beside it, as a share.
        costates: Largest error of the costates against their own equation, summed over the plan, and of the conditions
            at the ends, as a share of the cost.
        stationarity: Largest reduced gradient of the Hamiltonian, relative to its parts; None: it is told, and judged
            by the cost that it loses.
        drift: Largest change of the Hamiltonian where time does not enter, relative to its parts; None: it is told.
        tolerances: Largest violation by name of a state, control or constraint, in its own unit.

    Raises:
        ProblemError: The plan does not belong to the problem, a limit is not a number, or a name in ``tolerances`` is
            unknown.
    """
    limits = checked_mapping("audit: tolerances", tolerances)
    named = {"integration": integration, "constraints": constraints, "lost": lost, "costates": costates, **limits}
    told = {"stationarity": stationarity, "drift": drift}
    for name, limit in {**named, **{k: v for k, v in told.items() if v is not None}}.items():
        if isinstance(limit, bool) or not isinstance(limit, int | float | np.number) or not limit >= 0:
            words = f"audit: tolerance {name!r} must be a number, zero or positive, not {limit!r}"
            raise ProblemError(words, name=name, value=limit)
    form = Formulation(problem)
    check_structure(solution)
    check_belongs(form, solution)
    solution = in_order_of(form, solution)
    p = form.parameter_vector(solution.parameters)
    bounds = form.bound_values(p)
    points = max(solution.state_interpolant.values.shape[1] - 1, 1)
    pieces = (len(solution.state_interpolant.breaks) - 1) // (len(solution.control_interpolant.breaks) - 1)
    again = reintegrate(form, solution, p, GRID_FACTOR * points * max(pieces, 1))
    found = optimality(form, solution, p, bounds)

    scale = state_scale(form, again.plan)
    errors = np.abs(again.states - again.plan) / scale
    local = np.abs(again.local - again.plan) / scale
    n = int(again.interval[-1]) + 1
    local_errors = local.reshape(n, -1).max(axis=1)
    findings = []
    note = "" if again.broke_down is None else f"the integration broke down at {again.broke_down:.6g} s"
    findings.append(worst("integration error, relative", errors.max(axis=1), again.t, integration, note))
    findings.append(worst("integration error of one interval", local.max(axis=1), again.t, integration))
    findings.append(cost_finding(form, solution, again, p, integration))
    findings.append(reported_finding(solution, integration))
    findings.append(horizon_finding(form, solution, bounds))

    names = [*form.states, *form.controls, *[c for kind in (form.path, form.start, form.end) for c in kind.names]]
    for name in limits:
        if name not in names:
            raise unknown_name("name in tolerances", name, names)
    checks = violations(form, again, bounds, p, solution.horizon)
    total: dict[str, float] = {}
    for label, name, misses, times, size in checks:
        limit = limits.get(name, constraints * size)
        finding = worst(label, misses, times, limit)
        findings.append(finding)
        total[name] = max(total.get(name, 0.0), finding.value)

    findings.append(jump("state jump, relative", solution.state_interpolant, solution.horizon, integration))
    findings.append(jump("control jump, relative", solution.control_interpolant, solution.horizon, None))
    findings += optimality_findings(form, found, lost, costates, stationarity, drift)
    undecided = found.curvature.flat
    if not solution.success:
        undecided = f"the solver says {solution.status}"
    return Audit(
        form.name,
        tuple(findings),
        undecided,
        total,
        float(np.max(errors)) if np.all(np.isfinite(errors)) else np.inf,
        np.where(np.isfinite(local_errors), local_errors, np.inf),
        again.t,
        unstack(solution.states, again.states),
        unstack(solution.controls, again.controls),
        found,
    )


def horizon_finding(form: Formulation, solution: Solution, bounds: Bounds) -> Finding:
    """The plan's horizon and its last time against the horizon that is asked, to a solver's tolerance."""
    low, high = (float(side[form.bounds.places["horizon"][0]]) for side in bounds)
    miss = max(low - solution.horizon, solution.horizon - high, abs(float(solution.t[-1]) - solution.horizon))
    asked = f"{low:.6g} s" if low == high else f"{low:.6g} to {high:.6g} s"
    return Finding("horizon", miss, HORIZON_SLACK * solution.horizon, None, f"{solution.horizon:.6g} s, asked {asked}")


def optimality_findings(
    form: Formulation, found: Optimality, lost: float, costates: float, stationarity: float | None, drift: float | None
) -> list[Finding]:
    """First and second order."""
    cost, errors = found.cost_size, found.error_size
    share = float(found.lost.sum()) / cost
    rows = [
        Finding("cost lost, relative", share, lost, None, f"{found.lost.sum():.3g} of the cost"),
        Finding("costate equation, relative", float(found.adjoint.error.sum()) / errors, costates),
        worst("costates between the nodes, relative", found.adjoint.between / errors, found.adjoint.t[:-1], costates),
        Finding("transversality, relative", found.adjoint.ends.transversality / errors, costates),
    ]
    if form.horizon_is_free:
        rows.append(Finding("condition of the free horizon, relative", found.adjoint.ends.horizon / errors, costates))
    second = found.curvature
    note = f"not decided: {second.flat}" if second.upwards is None else f"least {second.least:.3g} of the largest"
    downwards = 0.0 if second.upwards is not False else max(-second.least, FLAT)
    limit = None if second.upwards is None else 0.0
    rows.append(Finding("curvature downwards, relative", downwards, limit, second.time, note))
    if form.nu:
        rows.append(worst("stationarity, relative", found.stationarity, found.t, stationarity))
    change, limit = found.hamiltonian.drift, drift if form.autonomous else None
    name = "Hamiltonian drift, relative" if form.autonomous else "Hamiltonian change, relative"
    note = f"{change:.2e} in cost per second" + ("" if form.autonomous else "; time enters the problem")
    rows.append(Finding(name, change / found.hamiltonian.scale, limit, None, note))
    return [replace(row, verdict="optimal") for row in rows]


def state_scale(form: Formulation, plan: np.ndarray) -> np.ndarray:
    """Size of each state: the largest entry of the named state it belongs to; 1 where it is all zero. Shape (nx,)."""
    scale = np.ones(form.nx)
    for place in form.states.values():
        size = np.max(np.abs(plan[:, place]))
        scale[place] = size if size > 0 else 1.0
    return scale


def worst(name: str, values: np.ndarray, times: np.ndarray, limit: float | None, note: str = "") -> Finding:
    """A finding of the largest of some values; one that is not a number is the worst."""
    if values.size == 0:
        return Finding(name, 0.0, limit, None, note)
    clean = np.where(np.isnan(values), np.inf, values)
    k = int(np.argmax(clean))
    return Finding(name, float(clean[k]), limit, float(times[k]) if clean[k] > 0 else None, note)


def cost_finding(form: Formulation, solution: Solution, again: Reintegration, p: np.ndarray, limit: float) -> Finding:
    """The cost of the re-integrated plan against the one the solver reports."""
    end = form.terminal_cost(again.states[-1], again.states[0], again.controls[0], solution.horizon, p)
    cost = again.cost + end
    # parts of the running cost may cancel: judge by their size
    running = form.sampled([form.running], again.plan, again.controls, again.t, solution.horizon, p)[0]
    parts = np.abs(running).ravel()
    spent = float(np.sum(np.diff(again.t) * (parts[:-1] + parts[1:]) / 2))
    size = max(abs(cost), abs(again.cost), abs(end), abs(solution.cost), spent)
    off = abs(cost - solution.cost) / size if size > 0 else abs(cost - solution.cost)
    return Finding("cost, relative", off, limit, None, f"reported {solution.cost:.8g}, integrated {cost:.8g}")


def reported_finding(solution: Solution, limit: float) -> Finding:
    """The reported arrays against the interpolants, relative; at a break the value of either side will do."""
    off = np.zeros(len(solution.t))
    for pool, curve in (
        (solution.states, solution.state_interpolant),
        (solution.controls, solution.control_interpolant),
        (solution.costates, solution.costate_interpolant),
    ):
        values = stack(pool, len(off))
        sides = [curve(solution.t / solution.horizon + shift) - values for shift in (-1e-12, 1e-12)]
        size = np.max(np.abs(curve.values), initial=0.0) or 1.0
        off = np.maximum(off, np.min([np.abs(side).max(axis=1, initial=0.0) for side in sides], axis=0) / size)
    return worst("reported values, relative", off, solution.t, limit)


def jump(name: str, interpolant: PiecewisePolynomial, horizon: float, limit: float | None) -> Finding:
    """Largest jump between two pieces, relative to the size of what jumps."""
    n = len(interpolant.breaks) - 1
    pieces = np.arange(n)
    left = interpolant.within(pieces[:-1], np.ones(n - 1))
    right = interpolant.within(pieces[1:], np.zeros(n - 1))
    size = np.max(np.abs(interpolant.values), initial=0.0)
    gaps = np.abs(right - left).max(axis=1, initial=0.0) / (size if size > 0 else 1.0)
    note = f"{np.max(gaps, initial=0.0) * size:.3g} in its own unit"
    return worst(name, gaps, interpolant.breaks[1:-1] * horizon, limit, note)
