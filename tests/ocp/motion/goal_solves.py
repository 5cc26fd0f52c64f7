"""Solver of the problems of goals under actuator limits, as `plan` solves them, with every option of their builders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from models import FixedBase, FreeFloating
from ocp import DynamicsSetup, Goal, Limits, Problem, Solution, dynamics_phases, dynamics_problem
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics_plan import SolveSettings, machines_of, phase_names, within_limits


def solve_goals(
    machine: FixedBase | FreeFloating,
    goals: Goal | Sequence[Goal],
    horizon: Any = None,
    *,
    start: Any,
    limits: Limits | None = None,
    cost: Any = None,
    setup: DynamicsSetup | None = None,
    settings: SolveSettings | None = None,
) -> Solution:
    own = DynamicsSetup() if setup is None else setup
    shared: dict[str, Any] = {"start": start, "limits": limits, "cost": cost}

    def declare(clearance: ClearanceConstraints | None) -> Problem:
        options = replace(own, clearance_constraints=clearance)
        if isinstance(goals, Goal):
            options = replace(options, end_velocity=goals.velocity)
            return dynamics_problem(machine, goals.tasks, horizon, end=goals.joints, setup=options, **shared)
        return dynamics_phases(machine, goals, total=horizon, setup=options, **shared)

    if isinstance(goals, Goal):
        machines = {"": (machine, limits)}
    else:
        machines = {n: (m, limits) for n, m in zip(phase_names(goals), machines_of(machine, goals), strict=True)}
    return within_limits(declare, own.clearance_constraints, machines, settings=settings)
