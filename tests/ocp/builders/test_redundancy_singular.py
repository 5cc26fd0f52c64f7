"""Paths in reach whose pseudo-inverse motion runs close to a singularity: plans that finer meshes confirm."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Machine, planar_chain
from ocp import Collocation, solve
from ocp.builders.redundancy import minimum_velocity_problem, plan_minimum_velocity
from ocp.local.rates import resolve
from ocp.tasks.equations import task_errors
from ocp.tasks.tip_task import TipTask
from tests.models.robot.trees import numeric, seven_joint_arm

HORIZON = 4.0


def grazing(size: int, seed: int) -> tuple[FixedBase, dict[str, Any]]:
    """An arm, and a line that passes the hole around its base, which it cannot reach into, at 0.03 %.

    The line stays between the hole and the stretched arm: all of it is in reach.
    """
    rng = np.random.default_rng([seed, size])
    while True:
        lengths = np.concatenate([[1.0], rng.uniform(0.3, 0.7, size - 1) / (size - 1)])
        machine = FixedBase(planar_chain(lengths, np.ones(size)))
        near = (2.0 - lengths.sum()) * 1.0003
        start = rng.uniform(0.4, 1.2, size) * rng.choice([-1, 1], size)
        first = numeric(machine.tip_pose((), start).position).ravel()
        distance = np.linalg.norm(first)
        if 1.1 * near < distance < 0.95 * lengths.sum():
            break
    angle = np.arctan2(first[1], first[0]) + np.arccos(near / distance)
    foot = near * np.array([np.cos(angle), np.sin(angle), 0.0])
    last = foot + 0.7 * (foot - first)
    task = TipTask(position=lambda t: ca.DM(first) + t / HORIZON * ca.DM(last - first), rows=(3, 4))
    return machine, {"task": task, "start_joints": start, "horizon": HORIZON}


def floating() -> tuple[FreeFloating, dict[str, Any]]:
    """A space arm along a line on which the pseudo-inverse passes a manipulability of 0.004."""
    machine = FreeFloating(seven_joint_arm())
    start = np.array([0.087, 1.049, -0.898, -0.204, 0.404, 0.923, 1.2])
    first = numeric(machine.tip_pose(machine.base_home(), start).position).ravel()
    velocity = ca.DM([-0.4068, -0.0055, -0.0092])
    task = TipTask(position=lambda t: ca.DM(first) + t * velocity)
    return machine, {"task": task, "start_joints": start, "horizon": 5.0}


def check(machine: Machine, asked: dict[str, Any], intervals: int) -> None:
    local = resolve(machine, **asked, samples=401)
    assert local.stopped is not None or local.manipulability.min() < 0.03 * local.manipulability[0]
    plan = plan_minimum_velocity(machine, method=Collocation(intervals=intervals, degree=4), **asked)
    audit = plan.audit()
    assert audit.passed, str(audit)
    base = audit.states["base"] if machine.base_size else None
    stray = task_errors(machine, asked["task"], audit.t, base, audit.states["joints"])
    assert np.abs(stray).max() < 1e-6
    assert local.stopped is not None or plan.cost < local.cost[-1]
    again = solve(
        minimum_velocity_problem(machine, **asked),
        Collocation(intervals=4 * plan.method["intervals"], degree=4),
        guess=plan,
    )
    assert plan.cost == pytest.approx(again.cost, rel=1e-4)
    joints = plan.at(np.linspace(0, plan.horizon, 2001))["joints"]  # no jump
    assert np.abs(np.diff(joints, axis=0)).max() < 2 * np.abs(plan["rates"]).max() * plan.horizon / 2000


@pytest.mark.parametrize(("size", "seed"), [(3, 0), (3, 2), (4, 0), (4, 2)])
def test_a_line_past_a_singularity_is_planned_and_a_finer_mesh_agrees(size: int, seed: int) -> None:
    machine, asked = grazing(size, seed)
    check(machine, asked, 50)


def test_a_floating_arm_plans_around_the_singular_passage_and_a_finer_mesh_agrees() -> None:
    check(*floating(), intervals=25)
