"""Paths in reach whose pseudo-inverse motion runs close to a singularity: plans that finer meshes confirm."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Machine, planar_chain
from ocp import Collocation, Solution, TipTask, minimum_velocity_problem, refine, resolve, solve
from ocp.motion.local.rates import LocalSolution
from tests.models.robot.trees import Array, numeric, seven_joint_arm

HORIZON = 4.0
FINE = (1e-6, 1e-6)  # m and rad, that a tip may be off its line


def grazing(size: int, seed: int) -> tuple[FixedBase, dict[str, Any], Array]:
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
    speed = 1.7 * (foot - first) / HORIZON
    task = TipTask(position=lambda t: ca.DM(first) + t * ca.DM(speed), rows=(3, 4), tolerance=FINE)
    return machine, {"tasks": task, "start": start, "horizon": HORIZON}, speed


def floating(pose: bool) -> tuple[FreeFloating, dict[str, Any], Array]:
    """A space arm along a line on which the pseudo-inverse passes a manipulability of 0.004, at 6.6 rad/s."""
    machine = FreeFloating(seven_joint_arm())
    start, speed = np.array([0.087, 1.049, -0.898, -0.204, 0.404, 0.923, 1.2]), np.array([-0.4068, -0.0055, -0.0092])
    first = numeric(machine.tip_pose(machine.base_home(), start).position).ravel()
    line = TipTask(position=lambda t: ca.DM(first) + t * ca.DM(speed), tolerance=FINE)
    task = line if pose else TipTask(rows=(3, 4, 5), velocity=speed, tolerance=FINE)
    return machine, {"tasks": task, "start": start, "horizon": 5.0}, speed


def check(machine: Machine, request: dict[str, Any], speed: Array, intervals: int) -> tuple[Solution, LocalSolution]:
    """The plan passes its audit, stays on its line and has no jump, and one on a finer mesh costs the same."""
    local = resolve(machine, request["tasks"], request["horizon"], start=request["start"], samples=401)
    assert local.stopped is not None or local.manipulability.min() < 0.03 * local.manipulability[0]
    problem = minimum_velocity_problem(machine, **request)
    plan = refine(problem, Collocation(intervals=intervals, degree=4))
    audit = plan.audit()
    assert audit.passed, str(audit)
    base, joints = ca.SX.sym("base", machine.base_size), ca.SX.sym("joints", machine.joint_size)
    tip = ca.Function("tip", [base, joints], [machine.tip_pose(base, joints).position]).map(len(audit.t))
    places = audit.states["base"].T if machine.base_size else np.zeros((0, len(audit.t)))
    tips = numeric(tip(places, audit.states["joints"].T)).T
    assert np.abs(tips - tips[0] - audit.t[:, None] * speed).max() < FINE[0]
    assert local.stopped is not None or plan.cost < local.cost[-1]
    finer = Collocation(intervals=2 * plan.method["intervals"], degree=4)
    again = solve(problem, finer, guess=plan)
    assert plan.cost == pytest.approx(again.cost, rel=1e-4)
    fine = plan.at(np.linspace(0, plan.horizon, 2001))["joints"]
    assert np.abs(np.diff(fine, axis=0)).max() < 2 * np.abs(plan["rates"]).max() * plan.horizon / 2000
    return plan, local


@pytest.mark.parametrize(("size", "seed"), [(3, 0), (3, 2), (4, 0), (4, 2)])
def test_a_line_past_a_singularity_is_planned_and_a_finer_mesh_agrees(size: int, seed: int) -> None:
    check(*grazing(size, seed), intervals=50)


@pytest.mark.long
@pytest.mark.parametrize("pose", [pytest.param(True, marks=pytest.mark.long), False])
def test_a_floating_arm_plans_around_the_singular_passage_and_a_finer_mesh_agrees(pose: bool) -> None:
    plan, local = check(*floating(pose), intervals=25)
    assert plan.cost < 0.6 * local.cost[-1]
