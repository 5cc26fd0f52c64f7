"""What the examples of the gallery have in common: a plan that has been audited, and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FreeFloating, Machine
from models.checks import Array
from ocp import Audit, Solution, TipTask
from ocp.curves import differentiation_matrix
from ocp.motion.local.rates import LocalSolution
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.tasks.equations import task_errors
from ocp.storage import write_text
from scripts.robots.robots import RobotFile

FINE = 1001
"""Times at which a plan is looked at, between its nodes too."""
KEPT = 250
"""Steps of a motion that a plan is compared with, in its file."""


@dataclass(frozen=True, eq=False)
class Example:
    """A motion by the pseudo-inverse and the optimal plan for the same task.

    Attributes:
        file: Where the robot comes from.
        machine: The robot on its base.
        task: What the tip does.
        local: By the pseudo-inverse.
        plan: Optimal. audit: Of it.
        facts: More for the summary, by name.
        more: Arrays and plans that only the example's own pictures use.
    """

    file: RobotFile
    machine: Machine
    task: TipTask
    local: LocalSolution
    plan: Solution
    audit: Audit
    facts: dict[str, Any] = field(default_factory=dict)
    more: dict[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Both motions: the plan, and beside it the one by the pseudo-inverse as NAME.local.csv."""
        save_plan(path, self.machine, self.plan, [self.task])
        names, local = self.machine.robot.joint_names, self.local
        save_motion(path.with_suffix(".local.csv"), names, local.t, local.joints, local.joint_rates)

    def summary(self) -> dict[str, Any]:
        """A row of the summary."""
        machine = self.machine
        drift = momentum_drift(machine, self.plan) if isinstance(machine, FreeFloating) else None
        return {
            "robot": self.file.name,
            "dof": machine.joint_size,
            "task_rows": self.task.size,
            "duration_s": self.plan.horizon,
            "cost_local": float(self.local.cost[-1]),
            "cost_optimal": float(self.plan.cost),
            "tip_error": tip_error(machine, self.task, self.plan),
            "momentum_drift_relative": drift,
            "joint_return_rad": joint_return(self.plan),
            "audit_passed": self.audit.passed,
            **self.facts,
        }


def save_plan(path: Path, machine: Machine, solution: Solution, tasks: Sequence[TipTask]) -> None:
    """A solution as a plan, with its machine and what its tips are asked to do."""
    SolvedPlan(machine, solution, (Part(0.0, solution.horizon, ""),)).with_targets(tasks).save(path)


def save_motion(path: Path, names: Sequence[str], t: Array, joints: Array, rates: Array) -> None:
    """A motion as CSV, about KEPT samples of it: times (M,), s, joints and rates (M, n)."""
    step = max(1, (len(t) - 1) // KEPT)
    rows = np.append(np.arange(0, len(t) - 1, step), len(t) - 1)
    head = ",".join(["time", *names, *(f"{name}.velocity" for name in names)])
    lines = (",".join(f"{value:.9g}" for value in row) for row in np.column_stack([t, joints, rates])[rows])
    write_text(path, "\n".join([head, *lines]) + "\n")


def tip_error(machine: Machine, task: TipTask, plan: Solution) -> float:
    """Largest pose error of a plan, between its nodes too, m and rad."""
    times = np.linspace(0.0, plan.horizon, FINE)
    at = plan.at(times)
    base = at["base"] if machine.base_size else None
    return float(np.abs(task_errors(machine, task, times, base, at["joints"])).max())


def joint_return(plan: Solution) -> float:
    """How far the joint that comes back least ends from where it started, rad."""
    return float(np.abs(plan["joints"][-1] - plan["joints"][0]).max())


def momentum_drift(machine: FreeFloating, plan: Solution) -> float:
    """Momentum of the planned motion less the conserved one, relative to the joints' share of it.

    At the collocation points, the velocities being the derivatives of the plan's own curves: neither the solver's
    controls nor the machine's reaction enter. The greater of the angular and of the linear part.
    """
    curve = plan.state_interpolant
    nodes, breaks = curve.nodes, np.asarray(curve.breaks) * plan.horizon
    slopes = np.einsum("ij,kjn->kin", differentiation_matrix(nodes), curve.values) / np.diff(breaks)[:, None, None]
    inner = slice(1, None)  # the dynamics hold at the points, not at the start of an interval
    columns = _columns(plan)
    base, joints = (curve.values[:, inner, columns[name]].reshape(-1, size) for name, size in _sizes(machine))
    base_rate, rates = (slopes[:, inner, columns[name]].reshape(-1, size) for name, size in _sizes(machine))
    b, q, db, dq = (ca.SX.sym(name, size) for name, size in (("b", machine.base_size), ("q", machine.joint_size)) * 2)
    share = ca.mtimes(machine.momentum_matrices(b, q)[1], dq)
    function = ca.Function("momentum", [b, q, db, dq], [machine.momentum_residual(b, q, db, dq), share], {"cse": True})
    residual, whole = (np.array(part) for part in function.map(len(base))(base.T, joints.T, base_rate.T, rates.T))
    parts = [slice(0, 3), slice(3, 6)] if len(residual) == 6 else [slice(0, 1), slice(1, 3)]
    return max(float(np.abs(residual[part]).max() / np.abs(whole[part]).max()) for part in parts)


def _sizes(machine: Machine) -> tuple[tuple[str, int], tuple[str, int]]:
    return ("base", machine.base_size), ("joints", machine.joint_size)


def _columns(plan: Solution) -> dict[str, slice]:
    """Where the states are in the stacked state."""
    places, at = {}, 0
    for name, values in plan.states.items():
        places[name] = slice(at, at + values.shape[1])
        at += values.shape[1]
    return places


def turning_angle(base: Any) -> Array:
    """Angle by which a spatial base is turned from the world's axes. Shape (M, 7) to (M,), rad."""
    quaternion = np.atleast_2d(base)[:, 3:7]
    return np.asarray(2 * np.arctan2(np.linalg.norm(quaternion[:, 1:], axis=1), np.abs(quaternion[:, 0])))
