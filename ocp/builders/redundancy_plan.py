"""Redundancy resolved over the whole motion, solved and audited: a plan that holds, or a reason why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from models import Machine
from ocp.audit.audit import Audit
from ocp.builders.redundancy import minimum_velocity
from ocp.direct.collocation import Collocation
from ocp.errors import ProblemError, SolveError
from ocp.local.rates import LocalSolution, resolve
from ocp.local.reach import check_reach, leaves_limits
from ocp.methods import solve
from ocp.solution import Solution
from ocp.tasks.equations import bind
from ocp.tasks.tip_task import one_of

__all__ = ["plan_minimum_velocity"]

OPTIONS = {"max_iter": 150}
"""Of IPOPT."""
LOCAL = ("tip_velocity", "rows", "task", "start_joints", "horizon", "start_base", "weights")
LOOKS = 51
WORSE = 1e-6
GAP = 1e-6
"""Largest way, m and rad, that a cyclic task may give so that the joints close."""
STRAY = 1e-6
"""Way, m and rad, that the re-integrated tip may stray from its task before a finer mesh is tried."""
MESHES = 3
"""Of each guess, each twice as fine as the one before."""


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
    passes. A plan that passes but whose re-integrated tip strays from its task by more than 1e-6 (m, rad) is solved
    again from itself on up to two meshes, each twice as fine; the last of them that passes stands for it. One that
    fails is solved again on a mesh twice as fine, and once more where that halved the failure.

    Args:
        machine: As for minimum_velocity.
        method: Collocation; 50 Radau intervals of degree 4 if None.
        dampings: Of the guesses, in the order in which they are tried.
        options: Of IPOPT, besides those above.
        asked: The other arguments of minimum_velocity: tip_velocity and rows, or task, start_joints, horizon and so on.

    Raises:
        SolveError: No guess leads to a plan that passes; says what became of each.
        ProblemError: As minimum_velocity; Unreachable, which is one, where a machine on a fixed base cannot reach what
            its tasks ask (see ocp.local.reach).
    """
    if not len(dampings):
        raise ProblemError("dampings are empty: there is no guess to start from")
    if "guess_damping" in asked:
        raise ProblemError("give dampings=(...,) instead of guess_damping")
    how = method or Collocation(intervals=50, degree=4)
    settings = {**OPTIONS, **(options or {})}
    local = _local_motion(machine, asked)
    _check_reach(machine, asked, local)
    target = _comparable_cost(asked, local)
    passed: list[Solution] = []
    reasons: list[str] = []
    last: Solution | None = None
    for damping in dampings:
        problem, guess, mesh = minimum_velocity(machine, guess_damping=damping, **asked), None, how
        found: Solution | None = None
        before = np.inf
        for attempt in range(MESHES):
            name = f"damping {damping:g}, {mesh.intervals} intervals"
            # what conflicts is looked for once: it takes long
            final = damping == dampings[-1] and not passed and found is None
            try:
                solution = solve(problem, mesh, options=settings, guess=guess, check=final)
            except SolveError as error:
                last = error.solution or last
                reasons.append(f"{name}: {error}")
                break
            if not solution.success:
                if "User_Requested_Stop" in solution.status:
                    raise SolveError(f"interrupted in the solve with {name}", solution)
                last = solution
                reasons.append(f"{name}: ipopt ended with {solution.status.split(':')[0]}")
                break
            audit = solution.audit()
            gap = float(np.abs(solution["closure"]).max()) * solution.horizon if "closure" in solution.states else 0.0
            if audit.passed and gap <= GAP:
                found, guess, mesh = solution, solution, replace(mesh, intervals=2 * mesh.intervals, mesh=None)
                if _stray(machine, asked, audit) <= STRAY:
                    break
                continue
            worst = audit.failures[0] if audit.failures else None
            why = f"the audit fails, {worst.name} {worst.value:.2g}" if worst else f"the task gives way by {gap:.2g}"
            reasons.append(f"{name}: {why}")
            last, guess, mesh = solution, solution, replace(mesh, intervals=2 * mesh.intervals, mesh=None)
            excess = worst.value / worst.limit if worst and worst.limit else np.inf
            if attempt and not excess < before / 2:
                break  # a finer mesh does not help
            before = excess
        if found is None:
            continue
        passed.append(found)
        if passed[-1].cost <= target * (1 + WORSE):
            return passed[-1]
    if not passed:
        raise SolveError("no plan of minimum velocity passes its audit:\n" + "\n".join(reasons), last)
    return min(passed, key=lambda solution: solution.cost)


def _stray(machine: Machine, asked: Mapping[str, Any], audit: Audit) -> float:
    """Largest time integral of the task's residual along the re-integrated plan, m and rad.

    Of a velocity it is how far the tip ends off its path. The null-space form does its task by itself: 0.
    """
    if "rates" not in audit.controls:
        return 0.0
    equations = bind(machine, one_of(asked.get("tip_velocity"), asked.get("rows"), asked.get("task")))
    sizes = (machine.base_size, machine.joint_size, machine.joint_size)
    base, joints, rates, time = [ca.MX.sym("v", size) for size in (*sizes, 1)]
    targets = equations.target_function()(time)
    residual = ca.Function("r", [base, joints, rates, time], [equations.residual(base, joints, rates, targets)])
    places = audit.states["base"] if machine.base_size else np.zeros((len(audit.t), 0))
    inputs = (places.T, audit.states["joints"].T, audit.controls["rates"].T, audit.t[None])
    off = np.array(residual.map(len(audit.t))(*inputs)).T
    steps = np.diff(audit.t)[:, None] * (off[1:] + off[:-1]) / 2
    return float(np.abs(np.cumsum(steps, axis=0)).max())


def _local_motion(machine: Machine, asked: Mapping[str, Any]) -> LocalSolution | None:
    """The pseudo-inverse from the same start; None where the start is singular or not given."""
    try:
        return resolve(machine, **{name: asked[name] for name in LOCAL if name in asked}, samples=LOOKS)
    except ProblemError:
        return None


def _comparable_cost(asked: Mapping[str, Any], local: LocalSolution | None) -> float:
    """Cost of the pseudo-inverse where it answers the same question and reaches the end; else infinite."""
    if local is None or local.stopped or asked.get("free_start") or asked.get("cyclic"):
        return np.inf
    return float(local.cost[-1])


def _check_reach(machine: Machine, asked: Mapping[str, Any], local: LocalSolution | None) -> None:
    """Raise Unreachable where the task is out of reach; looked for only where the local motion hints at it."""
    limits = asked.get("limits", True)
    if local is None or (local.stopped is None and not (limits and leaves_limits(machine, local))):
        return
    tasks = one_of(asked.get("tip_velocity"), asked.get("rows"), asked.get("task"))
    check_reach(machine, tasks, local.joints[0], float(asked["horizon"]), limits, local.joints[:: LOOKS // 5])
