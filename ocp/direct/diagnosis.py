"""What went wrong where a solver failed: what cannot hold together, where, and by how much.

A solver that fails leaves its last iterate, whose residuals are spread over constraints and dynamics alike. So an
elastic program is solved: the dynamics and the given ends hold, and every constraint and bound may be missed by an
amount of its own, the same at all times. The plan with the least sum of these amounts, each relative to the size of its
constraint, names the least that would have to give way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ocp.console import Progress, stop_requests_polled, time_left
from ocp.direct.assembly import Fragment, Program, sparse
from ocp.direct.nlp import Outcome
from ocp.direct.scaling import SCALING, Scales
from ocp.errors import Interrupted, SolveError
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.status import SolverStatus
from ocp.tolerances import RESOLVED_SHARE, SOLVER_SHARE

__all__ = ["Conflict", "Elastic", "diagnosis", "elastic_plan", "variable_names"]

ELASTIC_IPOPT = {"tol": 1e-6, "max_iter": 300, "print_level": 0, "sb": "yes"}
REMEDY = "leave scaling on, give ends, bounds and a guess of the right size, or choose units in which they are near 1"


@dataclass(frozen=True)
class ElasticSettings:
    """What an elastic plan costs, and how much is said of it.

    Attributes:
        cost: Share of the problem's own cost, which makes the plan unique.
        equality: How much dearer it is to miss an equality, which is what is asked for, than a limit.
        lines: The most of one kind.
    """

    cost: float = 1e-3
    equality: float = 10.0
    lines: int = 6


SETTINGS = ElasticSettings()


class Built(Protocol):
    """What was built of a problem; ``scaled`` is its program as it is solved."""

    problem: Problem
    formulation: Formulation
    fragment: Fragment
    program: Program

    @property
    def scaled(self) -> Program:
        """The program as it is solved."""
        ...


def diagnosis(
    built: Built,
    outcome: Outcome,
    arguments: dict[str, np.ndarray],
    horizon: float,
    solution: Any,
    elastic: Elastic | None,
    attempts: Sequence[str],
    badly_scaled: str,
) -> SolveError:
    """The error that says what cannot hold together, and the worst residuals by constraint, state and time.

    Args:
        outcome, arguments, horizon, solution: Of the first attempt, or of the one in which the time ran out.
        elastic: The plan that misses the constraints least, or None where there is none.
        attempts: What became of every start, one line each. badly_scaled: What is, or "".
    """
    labels, at, value, miss = residuals(built, outcome.variables, arguments)
    message = outcome.message
    found = () if elastic is None or badly_scaled else elastic.conflicts
    if badly_scaled:
        message = f"{outcome.status}: badly scaled: {badly_scaled}; {REMEDY}"
    elif elastic is not None and not found:  # it is not the constraints
        message = str(outcome.status)
    lines = [f"problem {built.problem.name!r}: {outcome.solver} ended with {message}"]
    if found:
        lines.append("not all constraints can hold together near the guess; with the dynamics and the given ends held,")
        lines += [f"  {conflict}" for conflict in found[: SETTINGS.lines]]
    elif elastic is not None and not badly_scaled:
        lines.append(
            "all constraints can hold together at the points of this grid, but for some 1e-5 of their sizes: take "
            "another guess or grid, or raise max_iter"
        )
    if len(attempts) > 1:
        lines += attempts
    lines.append(f"after {outcome.iterations} iterations, cost {outcome.cost:.6g}, horizon {horizon:.6g} s")
    worst: list[dict[str, Any]] = [
        {"name": c.label, "value": c.amount, "limit": c.bound, "time": c.time} for c in found[:1]
    ]
    broken = np.flatnonzero(~np.isfinite(value))
    for i in broken[: SETTINGS.lines]:
        lines.append(f"  {labels[i]} is not finite at {at[i] * horizon:.4g} s")
        worst.append({"name": labels[i], "value": float(value[i]), "time": float(at[i] * horizon)})
    seen: set[str] = set()
    for i in np.argsort(-np.where(np.isfinite(miss), miss, -np.inf)):
        if len(seen) == SETTINGS.lines or not miss[i] > 1e-8:
            break
        if labels[i] not in seen:
            seen.add(labels[i])
            lines.append(f"  {labels[i]} is missed by {miss[i]:.3g} at {at[i] * horizon:.4g} s")
            worst.append({"name": labels[i], "value": float(miss[i]), "limit": 0.0, "time": float(at[i] * horizon)})
    lines += at_bounds(built, outcome.variables, arguments, horizon)
    if not seen and not broken.size:
        lines.append("  all constraints are met; the plan is feasible but not optimal")
    return SolveError("\n".join(lines), solution, found, **(worst[0] if worst else {}))


def at_bounds(built: Built, values: np.ndarray, arguments: dict[str, np.ndarray], horizon: float) -> list[str]:
    """Which states and controls sit at their bounds, and for how much of the plan."""
    form, fragment = built.formulation, built.fragment
    lines = []
    for role, labels in (("state", form.state_labels), ("control", form.control_labels)):
        for i, label in enumerate(labels):
            mine = (fragment.variable_role == role) & (fragment.variable_entry == i)
            mine &= arguments["lbx"] < arguments["ubx"]  # not what is given
            for side, key in (("lower", "lbx"), ("upper", "ubx")):
                bound = arguments[key][mine]
                with np.errstate(invalid="ignore"):
                    at = np.abs(values[mine] - bound) <= 1e-6 * np.maximum(1.0, np.abs(bound))
                at &= np.isfinite(bound)
                if np.any(at):
                    where = fragment.variable_fraction[mine][at]
                    lines.append(
                        f"  {role} {label} is at its {side} bound {bound[at][0]:.4g} at {np.mean(at):.0%} of its "
                        f"points, from {where.min() * horizon:.4g} to {where.max() * horizon:.4g} s"
                    )
    return lines


def residuals(
    built: Built, v: np.ndarray, arguments: dict[str, np.ndarray]
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """Label, fraction, value and miss of every row and of the bounds of every variable, evaluated anew."""
    form, fragment = built.formulation, built.fragment
    try:
        g = np.asarray(built.program.values(v, arguments["p"])[1].full()).reshape(-1)
    except RuntimeError:  # an integrator breaks down
        g = np.full(fragment.n_rows, np.nan)
    value = np.concatenate([g, v])
    lower, upper = both_bounds(arguments)
    at = np.concatenate([fragment.row_fractions, fragment.variable_fraction])
    labels = [*fragment.row_labels, *(f"bound of {name}" for name in variable_names(form, fragment))]
    return labels, at, value, np.maximum(lower - value, value - upper)


def both_bounds(arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of the rows, then of the variables."""
    low, high = (np.concatenate([arguments[f"{side}g"], arguments[f"{side}x"]]) for side in ("lb", "ub"))
    return low, high


def variable_labels(form: Formulation, fragment: Fragment) -> list[str]:
    """Name of the state, control or horizon that each variable is; "" of a copy that a stage carries."""
    names = {"state": form.state_labels, "control": form.control_labels, "horizon": ("horizon",)}
    return [
        names[role][entry] if role else ""
        for role, entry in zip(fragment.variable_role, fragment.variable_entry, strict=True)
    ]


def variable_names(form: Formulation, fragment: Fragment) -> list[str]:
    """The same with what it is before it, "state q[2]"; "a stage variable" of a copy that a stage carries."""
    return [
        f"{'' if role == 'horizon' else role + ' '}{name}" if role else "a stage variable"
        for role, name in zip(fragment.variable_role, variable_labels(form, fragment), strict=True)
    ]


@dataclass(frozen=True)
class Conflict:
    """A constraint that has to give way.

    Attributes:
        label: Of the constraint, or of the state or control whose bound it is.
        amount: By how much, in its own unit. bound: The bound that is missed, and its side, ``lower`` or ``upper``.
        fraction: Of the horizon where it is missed most.
        horizon: Of the plan, s.
    """

    label: str
    amount: float
    bound: float
    side: str
    fraction: float
    horizon: float

    @property
    def time(self) -> float | None:
        """When it is missed most, s; None of the horizon itself."""
        return None if self.label == "horizon" else self.fraction * self.horizon

    def __str__(self) -> str:
        time = "" if self.time is None else f" at {self.time:.4g} s"
        return f"{self.label} would have to go {self.amount:.3g} beyond its {self.side} bound {self.bound:.4g}{time}"


@dataclass(frozen=True)
class Elastic:
    """The plan that misses the constraints least: its variables (n,), and what it misses, the largest share first."""

    plan: np.ndarray
    conflicts: tuple[Conflict, ...]


def elastic_plan(
    built: Built, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales, horizon: float
) -> Elastic | None:
    """The plan with the dynamics and the given ends held that misses the constraints least.

    None where the last iterate misses nothing or is not finite, so that it is not the constraints that are in the way,
    and where no plan is found in the time that is left.

    Args:
        outcome: Of the solver that failed.
        arguments: Of the solver: x0, p and the bounds lbx, ubx, lbg, ubg. scales: What the program is scaled by.
        horizon: The fixed final time, s; not used where it is free.

    Raises:
        Interrupted: Ctrl-C.
    """
    _, _, value, miss = residuals(built, outcome.variables, arguments)
    if time_left() <= 0 or not (np.all(np.isfinite(value)) and np.any(miss > SOLVER_SHARE)):
        return None
    form, fragment, program = built.formulation, built.fragment, built.scaled
    own = scales.inside(arguments)
    soft = _Soft(form, fragment, own)
    n, m, k = fragment.size, fragment.n_rows, len(soft.labels)
    x, p = ca.MX.sym("x", n + k), program.nlp["p"]
    v, slack = x[:n], x[n:]
    rows, columns = soft.picks(n, m, k)
    with np.errstate(all="ignore"):
        size = float(program.values(own["x0"], own["p"])[0])
    share = SETTINGS.cost / max(1.0 if scales.cost <= 1 else SCALING.usual, abs(size)) if np.isfinite(size) else 0.0
    lam, sigma = ca.MX.sym("lam", rows.shape[0]), ca.MX.sym("sigma")
    cost, slope = program.gradient(v, p)
    values, jacobian = program.jacobian(v, p)
    f = share * cost + ca.dot(ca.DM(soft.prices), slack)
    g = ca.mtimes(rows, values) + ca.mtimes(columns, x)
    jac = ca.horzcat(ca.mtimes(rows, jacobian), ca.DM(rows.shape[0], k)) + columns
    curved = program.hessian(v, p, share * sigma, ca.mtimes(rows.T, lam))
    title = f"what is in conflict in {built.problem.name}"
    progress = Progress(n + k, rows.shape[0], p.numel(), title, show=True)
    options = {
        "grad_f": ca.Function("g", [x, p], [f, ca.vertcat(share * slope, soft.prices)], ["x", "p"], ["f", "g"]),
        "jac_g": ca.Function("j", [x, p], [g, jac], ["x", "p"], ["g", "j"]),
        "hess_lag": ca.Function("h", [x, p, sigma, lam], [ca.diagcat(curved, ca.DM(k, k))]),
        "no_nlp_grad": True,  # compiled functions have no derivatives but those that are ready
        "calc_lam_p": False,
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": ELASTIC_IPOPT,
        "iteration_callback": progress,
    }
    lower, upper = soft.limits(own)
    progress.open(lower, upper)
    try:
        solver = ca.nlpsol("elastic", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)
        with stop_requests_polled():
            result = solver(
                x0=np.concatenate([own["x0"], np.zeros(k)]),
                p=own["p"],
                lbx=np.concatenate([soft.low, np.zeros(k)]),
                ubx=np.concatenate([soft.high, np.full(k, np.inf)]),
                lbg=lower,
                ubg=upper,
            )
    except RuntimeError:  # an integrator breaks down
        return None
    finally:
        progress.close()
    if progress.stopped is SolverStatus.INTERRUPTED:
        raise Interrupted(f"problem {built.problem.name!r}: interrupted while looking for what is in conflict")
    if not solver.stats()["success"]:
        return None
    plan = np.asarray(result["x"].full()).ravel()[:n]
    found = np.asarray(program.values(plan, own["p"])[1].full()).ravel()
    plan_of_problem = plan * scales.variables
    end = horizon if fragment.horizon is None else float(plan_of_problem[fragment.horizon])
    units = np.concatenate([scales.rows, scales.variables])
    return Elastic(plan_of_problem, tuple(soft.read(np.concatenate([found, plan]), own, end, units)))


class _Soft:
    """Which rows and bounds may be missed: all but the dynamics, the given ends and the least horizon.

    Rows are numbered before variables. Those of one label share a slack.
    """

    def __init__(self, form: Formulation, fragment: Fragment, arguments: dict[str, np.ndarray]) -> None:
        places = form.bounds.places
        owner = np.array([*fragment.row_labels, *variable_labels(form, fragment)])
        low, high = both_bounds(arguments)
        declared = np.concatenate([places[kind] for kind in ("path", "start", "end")])
        is_soft = np.concatenate([np.isin(fragment.row_bounds, declared), arguments["lbx"] < arguments["ubx"]])
        self.lower = np.flatnonzero(is_soft & np.isfinite(low) & (owner != "horizon"))
        self.upper = np.flatnonzero(is_soft & np.isfinite(high))
        self.hard = np.flatnonzero(~is_soft[: fragment.n_rows])
        self.labels, index = np.unique(owner[np.concatenate([self.lower, self.upper])], return_inverse=True)
        self.slack_of_lower, self.slack_of_upper = index[: len(self.lower)], index[len(self.lower) :]
        with np.errstate(invalid="ignore"):
            width = high - low
        bound = np.maximum(np.where(np.isfinite(low), np.abs(low), 0), np.where(np.isfinite(high), np.abs(high), 0))
        size = np.where(np.isfinite(width) & (width > 0), width, np.where(bound > 0, bound, 1.0))
        self.sizes = np.full(len(self.labels), np.inf)
        np.minimum.at(self.sizes, index, size[np.concatenate([self.lower, self.upper])])
        self.prices = 1 / self.sizes
        self.prices[index[(low == high)[np.concatenate([self.lower, self.upper])]]] *= SETTINGS.equality
        relaxed = is_soft[fragment.n_rows :]
        horizon = fragment.variable_role == "horizon"
        self.low = np.where(relaxed & ~horizon, -np.inf, arguments["lbx"])
        self.high = np.where(relaxed, np.inf, arguments["ubx"])
        self.fractions = np.concatenate([fragment.row_fractions, fragment.variable_fraction])

    def picks(self, n: int, m: int, k: int) -> tuple[Any, Any]:
        """Constant matrices R, C: the elastic rows are R g(v) + C (v, slack)."""
        chosen = np.concatenate([self.hard, self.lower, self.upper])
        number = np.arange(len(chosen))
        of_rows = chosen < m
        rows = sparse(number[of_rows], chosen[of_rows], np.ones(of_rows.sum()), (len(chosen), m))
        first, second = len(self.hard), len(self.hard) + len(self.lower)
        at = np.concatenate([number[~of_rows], number[first:second], number[second:]])
        columns = np.concatenate([chosen[~of_rows] - m, n + self.slack_of_lower, n + self.slack_of_upper])
        signs = np.concatenate([np.ones((~of_rows).sum()), np.ones(len(self.lower)), -np.ones(len(self.upper))])
        return rows, sparse(at, columns, signs, (len(chosen), n + k))

    def limits(self, arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the elastic rows."""
        low, high = both_bounds(arguments)
        free = np.full(max(len(self.lower), len(self.upper)), np.inf)
        lower = np.concatenate([low[self.hard], low[self.lower], -free[: len(self.upper)]])
        return lower, np.concatenate([high[self.hard], free[: len(self.lower)], high[self.upper]])

    def read(
        self, values: np.ndarray, arguments: dict[str, np.ndarray], horizon: float, units: np.ndarray
    ) -> list[Conflict]:
        """What is missed, the largest share first, in ``units`` of rows and variables."""
        low, high = both_bounds(arguments)
        found: dict[int, Conflict] = {}
        by: dict[int, float] = {}
        for side, index, slack in (
            ("lower", self.lower, self.slack_of_lower),
            ("upper", self.upper, self.slack_of_upper),
        ):
            bound = (low if side == "lower" else high)[index]
            miss = bound - values[index] if side == "lower" else values[index] - bound
            for i in np.argsort(-miss):
                j = int(slack[i])
                if miss[i] <= RESOLVED_SHARE * self.sizes[j]:
                    break
                if j not in found or miss[i] > found[j].amount:
                    at, by[j] = float(self.fractions[index[i]]), float(units[index[i]])
                    found[j] = Conflict(str(self.labels[j]), float(miss[i]), float(bound[i]), side, at, horizon)
        order = sorted(found, key=lambda j: -found[j].amount / self.sizes[j])
        return [replace(found[j], amount=found[j].amount * by[j], bound=found[j].bound * by[j]) for j in order]
