"""Redundancy resolved over the whole motion, solved and audited: a plan that holds, or a reason why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from models import Machine
from ocp.builders.redundancy import minimum_velocity
from ocp.collocation import Collocation
from ocp.errors import ProblemError, SolveError
from ocp.local import resolve
from ocp.solution import Solution
from ocp.solve import solve

__all__ = ["plan_minimum_velocity"]

OPTIONS = {"max_iter": 150, "mumps_pivtol": 1e-3}
"""Of IPOPT. MUMPS' own pivots lose the sign of eigenvalues on spatial machines, for which IPOPT then regularises."""
LOCAL = ("tip_velocity", "rows", "task", "start_joints", "horizon", "start_base", "weights")
WORSE = 1e-6
GAP = 1e-6
"""Largest way, m and rad, that a cyclic task may give so that the joints close."""


def plan_minimum_velocity(
    machine: Machine,
    *,
    method: Collocation | None = None,
    dampings: Sequence[float] = (0.005, 0.05, 0.3),
    options: Mapping[str, Any] | None = None,
    **asked: Any,
) -> Solution:
    """Solve `minimum_velocity` and audit the plan; from other guesses and on finer meshes where it does not hold.

    The first plan that passes its audit and costs no more than the pseudo-inverse is returned; else the cheapest that
    passes.

    Args:
        machine: As for minimum_velocity.
        method: Collocation; 50 Radau intervals of degree 4 if None.
        dampings: Of the guesses, in the order in which they are tried.
        options: Of IPOPT, besides those above.
        asked: The other arguments of minimum_velocity: tip_velocity and rows, or task, start_joints, horizon and so on.

    Raises:
        SolveError: No guess leads to a plan that passes; says what became of each.
        ProblemError: As minimum_velocity.
    """
    if not len(dampings):
        raise ProblemError("dampings are empty: there is no guess to start from")
    if "guess_damping" in asked:
        raise ProblemError("give dampings=(...,) instead of guess_damping")
    how = method or Collocation(intervals=50, degree=4)
    settings = {**OPTIONS, **(options or {})}
    local = _local_cost(machine, asked)
    passed: list[Solution] = []
    reasons: list[str] = []
    last: Solution | None = None
    for damping in dampings:
        problem, guess, mesh = minimum_velocity(machine, guess_damping=damping, **asked), None, how
        for _ in range(2):
            name = f"damping {damping:g}, {mesh.intervals} intervals"
            try:
                solution = solve(problem, mesh, options=settings, guess=guess)
            except SolveError as error:
                last = error.solution or last
                reasons.append(f"{name}: {str(error).splitlines()[0]}")
                break
            audit = solution.audit()
            gap = float(np.abs(solution["closure"]).max()) * solution.horizon if "closure" in solution.states else 0.0
            if audit.passed and gap <= GAP:
                passed.append(solution)
                break
            worst = audit.failures[0] if audit.failures else None
            why = f"the audit fails, {worst.name} {worst.value:.2g}" if worst else f"the task gives way by {gap:.2g}"
            reasons.append(f"{name}: {why}")
            last, guess, mesh = solution, solution, replace(mesh, intervals=2 * mesh.intervals, mesh=None)
        if passed and passed[-1].cost <= local * (1 + WORSE):
            return passed[-1]
    if not passed:
        raise SolveError("no plan of minimum velocity passes its audit:\n" + "\n".join(reasons), last)
    return min(passed, key=lambda solution: solution.cost)


def _local_cost(machine: Machine, asked: Mapping[str, Any]) -> float:
    """Cost of the pseudo-inverse from the same start; infinite where it stops early, or the start is singular."""
    if asked.get("free_start") or asked.get("cyclic"):
        return np.inf  # it answers another question
    try:
        local = resolve(machine, **{name: asked[name] for name in LOCAL if name in asked}, samples=2)
    except ProblemError:
        return np.inf
    return np.inf if local.stopped else float(local.cost[-1])
