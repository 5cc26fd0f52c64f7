"""Diagnosis of failed solves: which constraints conflict, where, and by how much.

The residuals of a failed solver's last iterate are spread over constraints and dynamics alike. Therefore an elastic
program is solved: dynamics and fixed ends hold, and each constraint and bound may be violated by an amount that is
constant in time. The plan with the smallest sum of these amounts, each relative to the size of its constraint,
identifies the smallest relaxation that makes the problem feasible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi as ca
import numpy as np
import scipy

from ocp.console import IterationMonitor, stop_requests_polled, time_left
from ocp.direct.assembly import Program, Transcription, sparse
from ocp.direct.nlp import Outcome
from ocp.direct.scaling import SCALING, Scales
from ocp.errors import Interrupted, SolveError, SolverStatus
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.tolerances import IMPLIED_SHARE, MACHINE_SHARE, RESOLVED_SHARE, SOLVER_SHARE

ELASTIC_IPOPT = {"tol": 1e-6, "max_iter": 300, "print_level": 0, "sb": "yes"}
MISSED = 1e-8  # violation of a constraint above which it counts as missed: the tolerance of ipopt
REMEDY = "leave scaling on, give ends, bounds and a guess of the right size, or choose units in which they are near 1"


@dataclass(frozen=True)
class ElasticSettings:
    """Settings of the elastic plan (the plan of least constraint violation) and of the report of conflicts.

    Attributes:
        cost: Weight of the problem's own cost, which makes the plan unique.
        equality: Price of the violation of an equality relative to that of a limit.
        lines: Largest number of lines of one kind in the report.
        inverse_iterations: Steps of the inverse iteration that finds dependent constraints: each amplifies what is
            dependent by the inverse square of its smallest singular value.
    """

    cost: float = 1e-3
    equality: float = 10.0
    lines: int = 6
    inverse_iterations: int = 4


SETTINGS = ElasticSettings()


class Built(Protocol):
    """Interface of a prepared problem with the attributes that its diagnosis uses."""

    problem: Problem
    formulation: Formulation
    transcription: Transcription
    program: Program

    @property
    def scaled(self) -> Program:
        """The nonlinear program in scaled variables."""
        ...


def diagnosis(
    built: Built,
    outcome: Outcome,
    arguments: dict[str, np.ndarray],
    *,
    solution: Any,
    elastic: Elastic | None,
    attempts: Sequence[str],
    badly_scaled: str,
) -> SolveError:
    """Return a SolveError that reports conflicting constraints and the largest residuals of a failed solve.

    Args:
        outcome, arguments, solution: Of the first attempt, or of the one in which the time ran out.
        elastic: The plan with the smallest violation, or None.
        attempts: Result of every start, one line each.
        badly_scaled: Description of bad scaling, or "".
    """
    labels, fractions, value, violation = residuals(built, outcome.variables, arguments)
    horizon = built.transcription.duration(built.formulation, outcome.variables, arguments["p"])
    message = outcome.message
    conflicts = () if elastic is None or badly_scaled else elastic.conflicts
    if badly_scaled:
        message = f"{outcome.status}: badly scaled: {badly_scaled}; {REMEDY}"
    elif not conflicts and (elastic is not None or not np.any(violation > MISSED)):  # constraints are not the reason
        message = str(outcome.status)
    lines = [f"problem {built.problem.name!r}: {outcome.solver} ended with {message}"]
    if conflicts:
        lines.append("not all constraints can hold together near the guess; with the dynamics and the given ends held,")
        lines += [f"  {conflict}" for conflict in conflicts[: SETTINGS.lines]]
    elif elastic is not None and not badly_scaled:
        lines.append(
            "all constraints can hold together at the points of this grid, but for some 1e-5 of their sizes: take "
            "another guess or grid, or raise max_iter"
        )
    if len(attempts) > 1:
        lines += attempts
    lines.append(f"after {outcome.iterations} iterations, cost {outcome.cost:.6g}, horizon {horizon:.6g} s")
    worst: list[dict[str, Any]] = [
        {"name": c.label, "value": c.amount, "limit": c.bound, "time": c.time} for c in conflicts[:1]
    ]
    undefined = np.flatnonzero(~np.isfinite(value))
    for i in undefined[: SETTINGS.lines]:
        lines.append(f"  {labels[i]} is not finite at {fractions[i] * horizon:.4g} s")
        worst.append({"name": labels[i], "value": float(value[i]), "time": float(fractions[i] * horizon)})
    reported: set[str] = set()
    for i in np.argsort(-np.where(np.isfinite(violation), violation, -np.inf)):
        if len(reported) == SETTINGS.lines or not violation[i] > MISSED:
            break
        if labels[i] not in reported:
            reported.add(labels[i])
            lines.append(f"  {labels[i]} is missed by {violation[i]:.3g} at {fractions[i] * horizon:.4g} s")
            time = float(fractions[i] * horizon)
            worst.append({"name": labels[i], "value": float(violation[i]), "limit": 0.0, "time": time})
    lines += at_bounds(built, outcome.variables, arguments, horizon)
    if not reported and not undefined.size:
        dependent = dependent_rows(built, outcome.variables, arguments)
        lines.append("  all constraints are met; the plan is feasible but not optimal")
        if dependent:
            worst.append({"name": dependent[0]})
            lines.append(f"  these constraints depend on each other, drop one of them: {', '.join(dependent)}")
    return SolveError("\n".join(lines), solution, conflicts, **(worst[0] if worst else {}))


def dependent_rows(built: Built, values: np.ndarray, arguments: dict[str, np.ndarray]) -> list[str]:
    """Return labels and times of constraints with linearly dependent gradients, in decreasing order of weight.

    Weights are magnitudes of the entries of a vector y with J^T y = 0, found by inverse iteration with J J^T; J
    is the Jacobian of the equations, with rows of length 1, in the variables that are not fixed.
    """
    form, transcription = built.formulation, built.transcription
    try:
        jacobian = built.program.numbers.first(values, arguments["p"])[1].tocsr()
    except RuntimeError:  # an integrator fails
        return []
    free = np.flatnonzero(arguments["lbx"] < arguments["ubx"])
    equal = np.flatnonzero(arguments["lbg"] == arguments["ubg"])
    matrix = jacobian[equal][:, free]
    lengths = scipy.sparse.linalg.norm(matrix, axis=1)
    if not (np.isfinite(matrix.data).all() and equal.size):
        return []
    matrix = scipy.sparse.diags(1 / np.where(lengths > 0, lengths, 1.0)) @ matrix
    solve = scipy.sparse.linalg.splu((matrix @ matrix.T + MACHINE_SHARE * scipy.sparse.eye(equal.size)).tocsc())
    y = np.random.default_rng(0).normal(size=equal.size)
    for _ in range(SETTINGS.inverse_iterations):
        y = solve.solve(y)
        y /= np.linalg.norm(y)
    if not np.linalg.norm(matrix.T @ y) < SOLVER_SHARE:
        return []
    declared = np.concatenate([form.bounds.places[kind] for kind in ("path", "start", "end")])
    size = np.where(np.isin(transcription.row_bounds[equal], declared), np.abs(y), 0.0)
    order = [i for i in np.argsort(-size, kind="stable") if size[i] > IMPLIED_SHARE * np.abs(y).max()]
    return list(dict.fromkeys(transcription.row_labels[equal[i]] for i in order))[: SETTINGS.lines]


def at_bounds(built: Built, values: np.ndarray, arguments: dict[str, np.ndarray], horizon: float) -> list[str]:
    """Return text lines that state which states and controls are at bounds, when, and for what share of the plan."""
    form, transcription = built.formulation, built.transcription
    lines = []
    for role, labels in (("state", form.state_labels), ("control", form.control_labels)):
        for i, label in enumerate(labels):
            chosen = (transcription.variable_role == role) & (transcription.variable_entry == i)
            chosen &= arguments["lbx"] < arguments["ubx"]  # not fixed variables
            for side, key in (("lower", "lbx"), ("upper", "ubx")):
                bound = arguments[key][chosen]
                with np.errstate(invalid="ignore"):
                    at = np.abs(values[chosen] - bound) <= 1e-6 * np.maximum(1.0, np.abs(bound))
                at &= np.isfinite(bound)
                if np.any(at):
                    fractions = transcription.variable_fraction[chosen][at]
                    lines.append(
                        f"  {role} {label} is at its {side} bound {bound[at][0]:.4g} at {np.mean(at):.0%} of its "
                        f"points, from {fractions.min() * horizon:.4g} to {fractions.max() * horizon:.4g} s"
                    )
    return lines


def residuals(
    built: Built, v: np.ndarray, arguments: dict[str, np.ndarray]
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """Return labels, horizon fractions, values and violations of all constraints, followed by all variables."""
    form, transcription = built.formulation, built.transcription
    try:
        g = np.asarray(built.program.values(v, arguments["p"])[1].full()).reshape(-1)
    except RuntimeError:  # an integrator fails
        g = np.full(transcription.n_rows, np.nan)
    value = np.concatenate([g, v])
    lower, upper = both_bounds(arguments)
    fractions = np.concatenate([transcription.row_fractions, transcription.variable_fraction])
    labels = [*transcription.row_labels, *(f"bound of {name}" for name in variable_names(form, transcription))]
    return labels, fractions, value, np.maximum(lower - value, value - upper)


def both_bounds(arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper bounds of the constraints, followed by those of the variables."""
    low, high = (np.concatenate([arguments[f"{side}g"], arguments[f"{side}x"]]) for side in ("lb", "ub"))
    return low, high


def variable_labels(form: Formulation, transcription: Transcription) -> list[str]:
    """Return the name of the state, control or horizon that each variable represents; "" for auxiliary variables."""
    names = {"state": form.state_labels, "control": form.control_labels, "horizon": ("horizon",)}
    return [
        names[role][entry] if role else ""
        for role, entry in zip(transcription.variable_role, transcription.variable_entry, strict=True)
    ]


def variable_names(form: Formulation, transcription: Transcription) -> list[str]:
    """Return a description of each variable: for example "state q[2]", or "a stage variable" if it is auxiliary."""
    return [
        f"{'' if role == 'horizon' else role + ' '}{name}" if role else "a stage variable"
        for role, name in zip(transcription.variable_role, variable_labels(form, transcription), strict=True)
    ]


@dataclass(frozen=True)
class Conflict:
    """A constraint or bound that must be relaxed to make a problem feasible.

    Attributes:
        label: Name of the constraint, or of the state or control with the bound.
        amount: Required relaxation, in its own unit.
        bound, side: The violated bound, and its side, ``lower`` or ``upper``.
        fraction: Fraction of the horizon with the largest violation.
        horizon: Duration of the plan, s.
    """

    label: str
    amount: float
    bound: float
    side: str
    fraction: float
    horizon: float

    @property
    def time(self) -> float | None:
        """Time of the largest violation, s; None if the horizon itself is in conflict."""
        return None if self.label == "horizon" else self.fraction * self.horizon

    def __str__(self) -> str:
        time = "" if self.time is None else f" at {self.time:.4g} s"
        return f"{self.label} would have to go {self.amount:.3g} beyond its {self.side} bound {self.bound:.4g}{time}"


@dataclass(frozen=True)
class Elastic:
    """The plan of least constraint violation: values of all variables, and the violated constraints, worst first."""

    plan: np.ndarray
    conflicts: tuple[Conflict, ...]


def elastic_plan(built: Built, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Elastic | None:
    """Return the plan that meets dynamics and fixed ends, and violates the other constraints as little as possible.

    Return None if the last iterate satisfies all constraints or is not finite, so that the constraints are not the
    reason for the failure, or if no plan is found in the remaining time.

    Args:
        outcome: Result of the failed solver.
        arguments: Arguments of the solver: x0, p and the bounds lbx, ubx, lbg, ubg.
        scales: Scales of the program.

    Raises:
        Interrupted: Ctrl-C.
    """
    _, _, value, violation = residuals(built, outcome.variables, arguments)
    if time_left() <= 0 or not (np.all(np.isfinite(value)) and np.any(violation > SOLVER_SHARE)):
        return None
    form, transcription, program = built.formulation, built.transcription, built.scaled
    scaled = scales.scale_arguments(arguments)
    soft = _Soft(form, transcription, scaled)
    n, m, k = transcription.size, transcription.n_rows, len(soft.labels)
    x, p = ca.MX.sym("x", n + k), program.nlp["p"]
    v, slack = x[:n], x[n:]
    rows, columns = soft.matrices(n, m, k)
    with np.errstate(all="ignore"):
        size = float(program.values(scaled["x0"], scaled["p"])[0])
    weight = SETTINGS.cost / max(1.0 if scales.cost <= 1 else SCALING.usual, abs(size)) if np.isfinite(size) else 0.0
    lam, sigma = ca.MX.sym("lam", rows.shape[0]), ca.MX.sym("sigma")
    cost, slope = program.gradient(v, p)
    values, jacobian = program.jacobian(v, p)
    f = weight * cost + ca.dot(ca.DM(soft.prices), slack)
    g = ca.mtimes(rows, values) + ca.mtimes(columns, x)
    jac = ca.horzcat(ca.mtimes(rows, jacobian), ca.DM(rows.shape[0], k)) + columns
    hessian = program.hessian(v, p, weight * sigma, ca.mtimes(rows.T, lam))
    title = f"conflicts in {built.problem.name}"
    progress = IterationMonitor(n + k, rows.shape[0], p.numel(), title=title, show=True)
    options = {
        "grad_f": ca.Function("g", [x, p], [f, ca.vertcat(weight * slope, soft.prices)], ["x", "p"], ["f", "g"]),
        "jac_g": ca.Function("j", [x, p], [g, jac], ["x", "p"], ["g", "j"]),
        "hess_lag": ca.Function("h", [x, p, sigma, lam], [ca.diagcat(hessian, ca.DM(k, k))]),
        "no_nlp_grad": True,  # compiled functions only have the given derivatives
        "calc_lam_p": False,
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": ELASTIC_IPOPT,
        "iteration_callback": progress,
    }
    lower, upper = soft.limits()
    progress.open(lower, upper)
    try:
        solver = ca.nlpsol("elastic", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)
        with stop_requests_polled():
            result = solver(
                x0=np.concatenate([scaled["x0"], np.zeros(k)]),
                p=scaled["p"],
                lbx=np.concatenate([soft.low, np.zeros(k)]),
                ubx=np.concatenate([soft.high, np.full(k, np.inf)]),
                lbg=lower,
                ubg=upper,
            )
    except RuntimeError:  # an integrator fails
        return None
    finally:
        progress.close()
    if progress.stopped is SolverStatus.INTERRUPTED:
        raise Interrupted(f"problem {built.problem.name!r}: interrupted during the search for conflicts")
    if not solver.stats()["success"]:
        return None
    plan = np.asarray(result["x"].full()).ravel()[:n]
    rows_of_plan = np.asarray(program.values(plan, scaled["p"])[1].full()).ravel()
    plan_of_problem = plan * scales.variables
    duration = transcription.duration(form, plan_of_problem, arguments["p"])
    units = np.concatenate([scales.rows, scales.variables])
    return Elastic(plan_of_problem, tuple(soft.conflicts(np.concatenate([rows_of_plan, plan]), duration, units)))


class _Soft:
    """Limits that the plan of least violation may violate: all but dynamics, fixed ends and the least horizon.

    Constraints are numbered before variables. Limits with the same label share a slack variable.
    """

    def __init__(self, form: Formulation, transcription: Transcription, arguments: dict[str, np.ndarray]) -> None:
        places = form.bounds.places
        owner = np.array([*transcription.row_labels, *variable_labels(form, transcription)])
        self.bounds = low, high = both_bounds(arguments)
        declared = np.concatenate([places[kind] for kind in ("path", "start", "end")])
        is_soft = np.concatenate([np.isin(transcription.row_bounds, declared), arguments["lbx"] < arguments["ubx"]])
        self.lower = np.flatnonzero(is_soft & np.isfinite(low) & (owner != "horizon"))
        self.upper = np.flatnonzero(is_soft & np.isfinite(high))
        self.hard = np.flatnonzero(~is_soft[: transcription.n_rows])
        both = np.concatenate([self.lower, self.upper])
        self.labels, index = np.unique(owner[both], return_inverse=True)
        self.slack_of_lower, self.slack_of_upper = index[: len(self.lower)], index[len(self.lower) :]
        with np.errstate(invalid="ignore"):
            width = high - low
        bound = np.maximum(np.where(np.isfinite(low), np.abs(low), 0), np.where(np.isfinite(high), np.abs(high), 0))
        size = np.where(np.isfinite(width) & (width > 0), width, np.where(bound > 0, bound, 1.0))
        self.sizes = np.full(len(self.labels), np.inf)
        np.minimum.at(self.sizes, index, size[both])
        self.prices = 1 / self.sizes
        self.prices[index[(low == high)[both]]] *= SETTINGS.equality
        relaxed = is_soft[transcription.n_rows :]
        horizon = transcription.variable_role == "horizon"
        self.low = np.where(relaxed & ~horizon, -np.inf, arguments["lbx"])
        self.high = np.where(relaxed, np.inf, arguments["ubx"])
        self.fractions = np.concatenate([transcription.row_fractions, transcription.variable_fraction])

    def matrices(self, n: int, m: int, k: int) -> tuple[Any, Any]:
        """Return the matrices that combine constraints, variables and slacks in the constraints of the elastic program.

        The constraints are R g(v) + C (v, slack), with n variables v, m constraints g of the problem, and k slacks.
        """
        chosen = np.concatenate([self.hard, self.lower, self.upper])
        number = np.arange(len(chosen))
        of_rows = chosen < m
        rows = sparse(number[of_rows], chosen[of_rows], np.ones(of_rows.sum()), (len(chosen), m))
        first, second = len(self.hard), len(self.hard) + len(self.lower)
        at = np.concatenate([number[~of_rows], number[first:second], number[second:]])
        columns = np.concatenate([chosen[~of_rows] - m, n + self.slack_of_lower, n + self.slack_of_upper])
        signs = np.concatenate([np.ones((~of_rows).sum()), np.ones(len(self.lower)), -np.ones(len(self.upper))])
        return rows, sparse(at, columns, signs, (len(chosen), n + k))

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds of the constraints of the elastic program."""
        low, high = self.bounds
        free = np.full(max(len(self.lower), len(self.upper)), np.inf)
        lower = np.concatenate([low[self.hard], low[self.lower], -free[: len(self.upper)]])
        return lower, np.concatenate([high[self.hard], free[: len(self.lower)], high[self.upper]])

    def conflicts(self, values: np.ndarray, horizon: float, units: np.ndarray) -> list[Conflict]:
        """Return the violated constraints as a list of conflicts, sorted by decreasing relative violation."""
        low, high = self.bounds
        by_slack: dict[int, Conflict] = {}
        unit_of: dict[int, float] = {}
        for side, sign, bounds, index, slack in (
            ("lower", -1.0, low, self.lower, self.slack_of_lower),
            ("upper", 1.0, high, self.upper, self.slack_of_upper),
        ):
            bound = bounds[index]
            violation = sign * (values[index] - bound)
            for i in np.argsort(-violation):
                j = int(slack[i])
                if violation[i] <= RESOLVED_SHARE * self.sizes[j]:
                    break
                if j not in by_slack or violation[i] > by_slack[j].amount:
                    fraction, unit_of[j] = float(self.fractions[index[i]]), float(units[index[i]])
                    by_slack[j] = Conflict(
                        str(self.labels[j]), float(violation[i]), float(bound[i]), side, fraction, horizon
                    )
        order = sorted(by_slack, key=lambda j: -by_slack[j].amount / self.sizes[j])
        conflicts = [(by_slack[j], unit_of[j]) for j in order]
        return [replace(each, amount=each.amount * unit, bound=each.bound * unit) for each, unit in conflicts]
