"""Words for what went wrong where a solver failed."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ocp.assembly import Program
from ocp.elastic import conflicts
from ocp.fragment import Fragment
from ocp.nlp import Outcome
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem

__all__ = ["diagnosis"]

WORST = 6  # lines of one kind
MISSED = 1e-6  # residual from which a plan counts as not feasible


class Built(Protocol):
    """What was built of a problem."""

    problem: Problem
    solver_name: str
    formulation: Formulation
    fragment: Fragment
    program: Program


def diagnosis(built: Built, outcome: Outcome, arguments: dict[str, np.ndarray], horizon: float) -> str:
    """What went wrong: what cannot hold together, and the worst residuals by constraint, state and time."""
    labels, at, value, miss = residuals(built, outcome.variables, arguments)
    lines = [f"problem {built.problem.name!r}: {built.solver_name} ended with {outcome.status}"]
    lines += conflict_lines(built, outcome, arguments, horizon)
    lines.append(f"after {outcome.iterations} iterations, cost {outcome.cost:.6g}, horizon {horizon:.6g} s")
    broken = np.flatnonzero(~np.isfinite(value))
    for i in broken[:WORST]:
        lines.append(f"  {labels[i]} is not finite at {at[i] * horizon:.4g} s")
    seen: set[str] = set()
    for i in np.argsort(-np.where(np.isfinite(miss), miss, -np.inf)):
        if len(seen) == WORST or not miss[i] > 1e-8:
            break
        if labels[i] not in seen:
            seen.add(labels[i])
            lines.append(f"  {labels[i]} is missed by {miss[i]:.3g} at {at[i] * horizon:.4g} s")
    lines += at_bounds(built, outcome.variables, arguments, horizon)
    if not seen and not broken.size:
        lines.append("  all constraints are met; the plan is feasible but not optimal")
    return "\n".join(lines)


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
    names = {"state": form.state_labels, "control": form.control_labels, "horizon": ("horizon",)}
    bounds = [
        f"{'' if role == 'horizon' else role + ' '}{names[role][entry]}" if role else "a stage variable"
        for role, entry in zip(fragment.variable_role, fragment.variable_entry, strict=True)
    ]
    value = np.concatenate([g, v])
    lower, upper = (np.concatenate([arguments[s + "g"], arguments[s + "x"]]) for s in ("lb", "ub"))
    at = np.concatenate([fragment.row_fractions, fragment.variable_fraction])
    labels = [*fragment.row_labels, *(f"bound of {name}" for name in bounds)]
    return labels, at, value, np.maximum(lower - value, value - upper)


def conflict_lines(built: Built, outcome: Outcome, arguments: dict[str, np.ndarray], horizon: float) -> list[str]:
    """What would have to give way for a plan to exist, where the solver came to no feasible one."""
    value, miss = residuals(built, outcome.variables, arguments)[2:]
    if "User_Requested_Stop" in outcome.status or not np.all(np.isfinite(value)) or not np.any(miss > MISSED):
        return []
    found = conflicts(built.formulation, built.fragment, built.program, arguments, horizon)
    if found is None:
        return []
    if not found:
        return [
            "all constraints can hold together at the points of this grid, but for some 1e-5 of their sizes: take "
            "another guess or grid, or raise max_iter"
        ]
    return ["not all constraints can hold together near the guess; with the dynamics and the given ends held,"] + [
        f"  {conflict}" for conflict in found[:WORST]
    ]
