"""The audit: does a plan do what it says, between its nodes too, and is it an extremal?

It trusts nothing that the solver says of its plan. The controls are integrated anew, every constraint is looked at on
a grid ten times as fine, and the minimum principle is checked with multipliers found anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ocp.audit.accessory import FLAT
from ocp.audit.costates import Adjoint, adjoint
from ocp.audit.curvature import Curvature, curvature
from ocp.audit.principle import Optimality, minimum_principle
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
        value: How far it is off, in the unit of the thing itself or relative where the name says so.
        limit: What it may be, or None where it is only told.
        time: Where it is worst, s, or None.
        note: What the value means where that is not plain.
    """

    name: str
    value: float
    limit: float | None = None
    time: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        return self.limit is None or bool(self.value <= self.limit)  # nan does not pass


@dataclass(frozen=True)
class Audit:
    """What an independent look at a plan found.

    Attributes:
        name: Of the problem.
        findings: One for every check.
        constraints: Worst violation of every bound and constraint by name, on the fine grid; 0 where it holds.
        integration_error: Largest distance of the plan's states from the re-integrated ones, relative to the size of
            each state, over the whole horizon. local_errors: the same of each interval alone, from its own start. (N,)
        t, states, controls: The re-integrated plan: times, s (M,), and values by name, each (M, n). Interior mesh
            times stand twice, with the controls of both sides.
        optimality: Stationarity and Hamiltonian. adjoint: The costates and their conditions at the ends.
        curvature: The second variation of the cost.
    """

    name: str
    findings: tuple[Finding, ...]
    constraints: dict[str, float]
    integration_error: float
    local_errors: np.ndarray
    t: np.ndarray
    states: dict[str, np.ndarray]
    controls: dict[str, np.ndarray]
    optimality: Optimality
    adjoint: Adjoint
    curvature: Curvature

    @property
    def passed(self) -> bool:
        """Whether every finding is within its limit."""
        return all(finding.passed for finding in self.findings)

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The findings beyond their limits."""
        return tuple(finding for finding in self.findings if not finding.passed)

    def __getitem__(self, name: str) -> Finding:
        """A finding by its name."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise unknown_name("finding", name, [finding.name for finding in self.findings])

    def __str__(self) -> str:
        width = max(len(finding.name) for finding in self.findings)
        lines = [f"Audit of {self.name!r}: {'passed' if self.passed else 'FAILED'}"]
        lines.append(f"  {'check':<{width}}  {'value':>10}  {'limit':>10}  {'at, s':>8}")
        for f in self.findings:
            limit = "" if f.limit is None else f"{f.limit:.2e}"
            time = "" if f.time is None else f"{f.time:.4f}"
            verdict = "" if f.limit is None else "ok" if f.passed else "FAILED"
            line = f"  {f.name:<{width}}  {f.value:>10.2e}  {limit:>10}  {time:>8}  {verdict:<6}  {f.note}"
            lines.append(line.rstrip())
        return "\n".join(lines)


@np.errstate(invalid="ignore", over="ignore")  # what is not a number fails by name
def audit(
    problem: Problem,
    solution: Solution,
    *,
    integration: float = 1e-3,
    constraints: float = 1e-3,
    stationarity: float = 1e-2,
    drift: float = 5e-2,
    costates: float = 1e-2,
    tolerances: Mapping[str, float] | None = None,
) -> Audit:
    """Check a plan independently of the solver that made it.

    Args:
        problem: What was asked. solution: The plan.
        integration: Largest relative distance from the re-integrated states, and relative error of the cost.
        constraints: Largest violation of a bound or constraint, as a share of its scale: the width of its range, else
            the size of its bound, else 1.
        stationarity: Largest reduced gradient of the Hamiltonian, relative to its parts.
        drift: Largest change of the Hamiltonian where time does not enter, relative to its parts.
        costates: Largest error of the costates against their own equation, and of the conditions at the ends, relative.
        tolerances: Largest violation by name of a state, control or constraint, in its own unit.

    Raises:
        ProblemError: The plan does not belong to the problem, a limit is not a number, or a name in ``tolerances`` is
            unknown.
    """
    limits = checked_mapping("audit: tolerances", tolerances)
    named = {"integration": integration, "constraints": constraints, "stationarity": stationarity}
    for name, limit in {**named, "drift": drift, "costates": costates, **limits}.items():
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
    optimality = minimum_principle(form, solution, p, bounds)

    scale = state_scale(form, again.plan)
    errors = np.abs(again.states - again.plan) / scale
    local = np.abs(again.local - again.plan) / scale
    n = int(again.interval[-1]) + 1
    local_errors = local.reshape(n, -1).max(axis=1)
    findings = [Finding("solver", 0.0 if solution.success else np.inf, 0.0, None, solution.status)]
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
    findings += optimality_findings(form, optimality, stationarity, drift)
    costate = adjoint(form, solution, p, bounds)
    findings += costate_findings(costate, optimality, costates)
    second = curvature(form, solution, p, bounds)
    findings += curvature_findings(second, solution)
    return Audit(
        form.name,
        tuple(findings),
        total,
        float(np.max(errors)) if np.all(np.isfinite(errors)) else np.inf,
        np.where(np.isfinite(local_errors), local_errors, np.inf),
        again.t,
        unstack(solution.states, again.states),
        unstack(solution.controls, again.controls),
        optimality,
        costate,
        second,
    )


def horizon_finding(form: Formulation, solution: Solution, bounds: Bounds) -> Finding:
    """The plan's horizon and its last time against the horizon that is asked, to a solver's tolerance."""
    low, high = (float(side[form.bounds.places["horizon"][0]]) for side in bounds)
    miss = max(low - solution.horizon, solution.horizon - high, abs(float(solution.t[-1]) - solution.horizon))
    asked = f"{low:.6g} s" if low == high else f"{low:.6g} to {high:.6g} s"
    return Finding("horizon", miss, HORIZON_SLACK * solution.horizon, None, f"{solution.horizon:.6g} s, asked {asked}")


def optimality_findings(form: Formulation, found: Optimality, stationarity: float, drift: float) -> list[Finding]:
    """Stationarity and constancy of the Hamiltonian."""
    findings = []
    if form.nu:
        note = f"{np.max(found.stationarity, initial=0.0):.2e} in cost per unit of control and second"
        gradient = found.stationarity / found.gradient_scale
        findings.append(worst("stationarity, relative", gradient, found.t, stationarity, note))
    name, limit, note = "Hamiltonian drift, relative", drift, f"{found.drift:.2e} in cost per second"
    if not form.autonomous:
        name, note = "Hamiltonian change, relative", f"{note}; time enters the problem"
    findings.append(
        Finding(name, found.drift / found.hamiltonian_scale, limit if form.autonomous else None, None, note)
    )
    return findings


def costate_findings(found: Adjoint, optimality: Optimality, limit: float) -> list[Finding]:
    """The costate equation and the conditions at the ends."""
    findings = []
    if found.integrated is None:
        findings.append(Finding("costate equation, relative", 0.0, None, None, f"not integrated: {found.reason}"))
    else:
        errors = np.abs(found.integrated - found.plan).max(axis=1) / found.scale
        findings.append(worst("costate equation, relative", errors, found.t, limit))
    note = f"{found.transversality:.2e} in cost per unit of state"
    findings.append(Finding("transversality, relative", found.transversality / found.scale, limit, None, note))
    if found.horizon:
        note = f"{found.horizon:.2e} in cost per second"
        relative = found.horizon / optimality.hamiltonian_scale
        findings.append(Finding("condition of the free horizon, relative", relative, limit, None, note))
    return findings


def curvature_findings(found: Curvature, solution: Solution) -> list[Finding]:
    """Second order: a negative curvature fails; where it is not decided, and what the controls lose, is only told."""
    note = f"not decided: {found.flat}" if found.upwards is None else f"least {found.least:.3g} of the largest"
    limit = None if found.upwards is None else 0.0
    size = max(abs(solution.cost), np.finfo(float).tiny)
    downwards = 0.0 if found.upwards is not False else max(-found.least, FLAT)
    return [
        Finding("curvature downwards, relative", downwards, limit, found.time, note),
        Finding("cost lost by the controls, relative", found.lost / size, None, None, f"{found.lost:.3g} of the cost"),
    ]


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
