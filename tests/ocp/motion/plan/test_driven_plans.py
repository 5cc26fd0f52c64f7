"""Plans within the limits of drives: torques that hold at all times, costs that are no less, and what is in the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Link, Machine, planar_chain
from models.checks import Array
from ocp import Limits, Plan, SolveError, TipTask, plan
from ocp.__main__ import main
from ocp.motion.plan.actuators import largest_demand
from ocp.motion.result.solved_plan import SolvedPlan
from tests.ocp.app.motions import write_robot
from tests.ocp.app.test_command import TASK
from tests.ocp.motion.builders.test_dynamics import torques_along

LENGTHS, MASSES = [0.5, 0.4, 0.3], [2.0, 1.5, 1.0]
START = np.array([0.4, 0.9, -0.6])
SECONDS = 1.5
FIXED = FixedBase(planar_chain(LENGTHS, MASSES))
FLOATING = FreeFloating(planar_chain(LENGTHS, MASSES, base=Link("base", 8.0, (0, 0, 0), 0.5 * np.eye(3))), "planar")


def smooth_task(machine: Machine) -> TipTask:
    """From rest to rest."""
    first = ca.DM(machine.tip_pose(machine.base_home(), START).position)

    def where(time: Any) -> Any:
        s = time / SECONDS
        return first + (10 * s**3 - 15 * s**4 + 6 * s**5) * ca.DM([-0.3, 0.2, 0.0])

    return TipTask(position=where, rows=(3, 4), duration=SECONDS)


def torques_of(result: Plan, times: int = 3001) -> Array:
    """By the plan's own polynomials. Shape (times, n)."""
    sample = result.sampled(np.linspace(0, result.horizon, times))
    here = {"joints": sample.joints, "velocities": sample.rates, "accelerations": sample.accelerations}
    if result.machine.base_size:
        here["base"] = result.at(sample.t)["base"]
    return np.asarray(torques_along(result.machine, here))


@pytest.mark.parametrize("machine", [FIXED, pytest.param(FLOATING, marks=pytest.mark.long)], ids=["fixed", "floating"])
def test_active_torque_limits_hold_and_increase_the_cost(machine: Machine, tmp_path: Path) -> None:
    """Loose ones leave the optimum as it is."""
    task = smooth_task(machine)
    free = plan(machine, task, start=START)
    loose = plan(machine, task, start=START, limits=Limits(torque=100.0))
    assert loose.cost == pytest.approx(free.cost, rel=1e-4)
    assert np.abs(loose.at(0.7)["joints"] - free.at(0.7)["joints"]).max() < 1e-3
    most = np.abs(torques_of(loose)).max(axis=0) * [0.85, 2.0, 2.0]
    result = plan(machine, task, start=START, limits=Limits(torque=most))
    assert result.audit().passed
    assert "torques" in {finding.name for finding in result.audit().findings}
    assert free.cost * (1 + 1e-5) < result.cost < 1.2 * free.cost
    assert (np.abs(torques_of(result)).max(axis=0) <= most + 1e-5).all()
    assert np.abs(torques_of(result))[:, 0].max() == pytest.approx(most[0], rel=1e-4)
    result.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again.audit()["torques"].value == result.audit()["torques"].value
    assert again.at(0.3)["rates"] == pytest.approx(result.at(0.3)["rates"])


def test_accelerations_are_within_their_limits_or_reported() -> None:
    task = smooth_task(FIXED)
    free = plan(FIXED, task, start=START)
    most = np.array([0.85, 9.0, 9.0])
    assert isinstance(free, SolvedPlan)
    demand = largest_demand(free, Limits(acceleration=most))
    assert demand is not None
    assert (demand.name, demand.limit) == ("joint1", 0.85)
    assert demand.detail.startswith("acceleration of 'joint1' is ")
    assert " rad/s^2 at " in demand.detail
    result = plan(FIXED, task, start=START, limits=Limits(acceleration=most))
    assert (np.abs(result.sample(0.001).accelerations).max(axis=0) <= most + 1e-5).all()
    assert result.cost > free.cost


@pytest.mark.long
def test_infeasible_tasks_are_named_with_their_requirement() -> None:
    with pytest.raises(SolveError, match=r"torque of 'joint1' is [\d.]+ N m at [\d.]+ s, 0.05 allowed") as caught:
        plan(FIXED, smooth_task(FIXED), start=START, limits=Limits(torque=0.05))
    assert (caught.value.name, caught.value.limit) == ("joint1", 0.05)
    assert caught.value.value > 1.0
    assert 0 < caught.value.time < SECONDS


def test_a_task_file_limits_torques_and_the_check_agrees(tmp_path: Path, capsys: Any) -> None:
    write_robot(tmp_path)
    words = (
        TASK.partition("[[obstacle]]")[0]
        + '[limits]\ntorque = { elbow = 30.0 }\n[output]\ncsv = "a.csv"\nperiod = 0.02\n'
    )
    (tmp_path / "a.toml").write_text(words)
    assert main(["plan", str(tmp_path / "a.toml"), "--quiet"]) == 0
    check = ["check", str(tmp_path / "robot.urdf"), str(tmp_path / "a.csv"), "--quiet"]
    assert main([*check, "--torque", "elbow=30.0"]) == 0
    assert main([*check, "--torque", "elbow=0.001"]) == 1
