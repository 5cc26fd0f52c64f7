"""Plans within the limits of drives: torques that hold at all times, costs that are no less, and what is in the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    FixedBase,
    FreeFloating,
    Link,
    Machine,
    example_robot,
    inverse_dynamics,
    mount_on_rail,
    planar_chain,
    smooth,
    with_load,
)
from models import Path as CornerPath
from models.checks import Array
from ocp import Limits, Plan, SolveError, TipTask, plan
from ocp.__main__ import main
from ocp.app.files import read_waypoints
from ocp.motion.builders.dynamics import Actuation
from ocp.motion.builders.dynamics_plan import POINTS
from ocp.motion.plan.actuators import largest_demand
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.tolerances import LIMIT_SHARE
from tests.ocp.app.motions import write_robot
from tests.ocp.app.test_command import TASK
from tests.ocp.motion.builders.test_dynamics import torques_along

LENGTHS, MASSES = [0.5, 0.4, 0.3], [2.0, 1.5, 1.0]
START = np.array([0.4, 0.9, -0.6])
SECONDS = 1.5
FIXED = FixedBase(planar_chain(LENGTHS, MASSES))
SIX_AXIS = FixedBase(example_robot("six_axis"))
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


@pytest.mark.parametrize(
    ("machine", "below"),
    [(FIXED, 1e-4), pytest.param(FLOATING, 1e-2, marks=pytest.mark.long)],
    ids=["fixed", "floating"],  # largest within the duration of smoothing, where limits are tightened between nodes
)
def test_active_torque_limits_hold_and_increase_the_cost(machine: Machine, below: float, tmp_path: Path) -> None:
    """Loose ones leave the optimum as it is, but for the price of smooth accelerations, known in closed form.

    The least of the integral of (v - w)^2 / 2 + d^2 v'^2 / 2 from v = 0 is d w^2 / 2, for a duration d of smoothing:
    the self-motion w at the ends of the free plan must start from rest.
    """
    task = smooth_task(machine)
    free = plan(machine, task, start=START)
    loose = plan(machine, task, start=START, limits=Limits(torque=100.0))
    sample, smoothing = free.sampled(np.linspace(0.0, free.horizon, 3001)), Actuation.smoothing * free.horizon
    squares = np.trapezoid((sample.accelerations**2).sum(axis=1), sample.t)
    price = smoothing / 2 * (sample.rates[[0, -1]] ** 2).sum() + smoothing**2 / 2 * squares
    assert loose.cost - free.cost == pytest.approx(price, rel=1e-2)
    assert loose.cost == pytest.approx(free.cost, rel=LIMIT_SHARE)
    assert np.abs(loose.at(0.7)["joints"] - free.at(0.7)["joints"]).max() < 1e-3
    most = np.abs(torques_of(loose)).max(axis=0) * [0.85, 2.0, 2.0]
    result = plan(machine, task, start=START, limits=Limits(torque=most))
    assert result.audit().passed
    assert "torques" in {finding.name for finding in result.audit().findings}
    assert free.cost * (1 + 1e-5) < result.cost < 1.2 * free.cost
    assert (np.abs(torques_of(result)).max(axis=0) <= most + 1e-5).all()
    assert np.abs(torques_of(result, 30_001))[:, 0].max() == pytest.approx(most[0], rel=below)
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


def limited(quantity: str, most: Any) -> Limits:
    return replace(Limits(), **{quantity: most})


def line_task(acceleration: float = 0.5, jerk: float = 4.0) -> TipTask:
    """Along y with a free roll about the last axis of the arm, so that the task determines all other joints."""
    path = smooth(CornerPath.through([(0.4, -0.1, 0.3), (0.4, 0.1, 0.3)]), 0.002)
    return TipTask.along(path, 0.1, acceleration=acceleration, jerk=jerk, direction=(0, 0, -1))


@pytest.mark.long
def test_slow_tools_with_short_ramps_cost_what_they_cost_without_limits_that_are_inactive() -> None:
    """The ramps last a thousandth of the motion: less than the time in which jerks would else be smoothed."""
    path = smooth(CornerPath.through([(0.4, -0.1, 0.3), (0.4, 0.1, 0.3), (0.45, 0.12, 0.3)]), 0.002)
    task = TipTask.along(path, 0.004, direction=(0, 0, -1))
    free = plan(SIX_AXIS, task, search="start")
    result = plan(SIX_AXIS, task, search="start", limits=Limits(acceleration=8.0, jerk=100.0))
    assert result.audit().feasible
    assert free.cost <= result.cost <= (1 + 2 * LIMIT_SHARE) * free.cost
    np.testing.assert_allclose(result.sampled(np.array([0.0, result.horizon])).rates, 0.0, atol=1e-6)


@pytest.mark.parametrize("quantity", ["acceleration", pytest.param("jerk", marks=pytest.mark.long)])
def test_limits_below_what_a_task_determines_are_refused_with_its_demand(quantity: str) -> None:
    """At the limit of the demand itself the motion is planned, and it is the motion without limits."""
    task = line_task()
    free = plan(SIX_AXIS, task, search="start")
    sample, start = free.sample(5e-4), free.at(0.0)["joints"]
    values = sample.accelerations
    if quantity == "jerk":
        values = np.gradient(values, sample.t, axis=0)
    joint = int(np.abs(values).max(axis=0).argmax())
    most = float(np.abs(values[:, joint]).max())
    with pytest.raises(SolveError, match="the tasks determine the motion of this joint: lower the speed") as caught:
        plan(SIX_AXIS, task, start=start, limits=limited(quantity, 0.9 * most))
    error = caught.value
    assert (error.name, error.limit) == (free.names[joint], pytest.approx(0.9 * most))
    assert error.value == pytest.approx(most, rel=0.01)
    assert np.abs(values[np.abs(sample.t - error.time) < 0.02, joint]).max() > 0.9 * most
    result = plan(SIX_AXIS, task, start=start, limits=limited(quantity, 1.02 * most))
    assert result.audit().passed
    assert result.cost == pytest.approx(free.cost, rel=1e-4)
    with pytest.raises(SolveError, match="the tasks determine"):
        plan(SIX_AXIS, task, start=start, limits=limited(quantity, np.where(np.arange(6) == joint, 0.5, 1e3)))


def test_a_payload_that_the_arm_cannot_hold_at_rest_is_refused_with_the_torque_there() -> None:
    """Its weight times its lever about the second axis of the arm, beside the weight of the arm itself."""
    arm = example_robot("six_axis")
    loaded = with_load(arm, arm.tip_link, 40.0, arm.tip_translation)
    start = plan(SIX_AXIS, line_task(), search="start").at(0.0)["joints"]
    with pytest.raises(SolveError, match="the arm must hold itself at rest there: reduce its load") as caught:
        plan(FixedBase(loaded), line_task(), start=start, limits=Limits(torque=arm.effort))
    error, zeros = caught.value, np.zeros(6)
    ends = [inverse_dynamics(loaded, q, zeros, zeros) for q in (start, plan_end(start))]
    static = np.abs([np.array(ca.DM(torques)).ravel() for torques in ends])
    joint = arm.joint_names.index(str(error.name))
    assert (static / arm.effort).max() == pytest.approx(error.value / error.limit)
    assert static[:, joint].max() == pytest.approx(error.value)
    assert error.time in (0.0, line_task().duration)


def plan_end(start: Array) -> Array:
    """Last configuration of the motion along the line from a start."""
    result = plan(SIX_AXIS, line_task(), start=start)
    return np.asarray(result.at(result.horizon)["joints"])


@pytest.mark.parametrize("most", [200.0, pytest.param(120.0, marks=pytest.mark.long)])
def test_joints_at_rest_have_no_acceleration_if_their_jerk_is_limited(most: float) -> None:
    """An acceleration that jumps at the start or at the end is an unlimited jerk there.

    The fastest ramp from rest to the self-motion takes a hundredth of the horizon: the first mesh resolves it.
    """
    free = plan(FIXED, smooth_task(FIXED), start=START)
    result = plan(FIXED, smooth_task(FIXED), start=START, limits=Limits(jerk=most))
    assert result.audit().passed
    for name in ("velocities", "accelerations"):
        np.testing.assert_allclose(result.solution[name][[0, -1]], 0.0, atol=1e-4)
    assert np.abs(result.solution["jerks"]).max() <= most * (1 + 1e-6)
    assert free.cost <= result.cost < 1.1 * free.cost
    assert len(result.solution.control_interpolant.breaks) <= 1.5 * POINTS.intervals


def assert_within_shares_of_peaks(machine: Machine, task: TipTask, share: float, start: Any = None) -> Plan:
    """Plan within a share of the peaks of the motion without limits; check the limits by samples, and the cost."""
    options: dict[str, Any] = {"search": "start", "scene": False, "start": start}
    sample = plan(machine, task, **options).sample(5e-4)
    jerks = np.abs(np.gradient(sample.accelerations, sample.t, axis=0))
    joint = int(np.abs(sample.accelerations).max(axis=0).argmax())
    largest = share * np.abs(sample.accelerations[:, joint]).max(), share * jerks[:, joint].max()
    others = np.arange(machine.joint_size) != joint
    acceleration, jerk = (np.where(others, 10.0 * each, each) for each in largest)
    result = plan(machine, task, limits=Limits(acceleration=acceleration, jerk=jerk), **options)
    assert result.audit().feasible
    limited = result.sample(5e-4)
    assert (np.abs(limited.accelerations).max(axis=0) <= acceleration + 1e-5).all()
    assert (np.abs(np.diff(limited.accelerations, axis=0)) / 5e-4 <= jerk * (1 + LIMIT_SHARE)).all()
    assert np.abs(limited.accelerations[:, joint]).max() == pytest.approx(largest[0], rel=0.01)
    assert np.abs(limited.rates[[0, -1]]).max() <= LIMIT_SHARE * np.abs(limited.rates).max()
    return result


def scaled_line(size: float) -> tuple[Machine, TipTask]:
    """Return an arm of three links and a line from its start configuration; all lengths have the same factor."""
    machine = FixedBase(planar_chain([size * length for length in LENGTHS], [size**3 * mass for mass in MASSES]))
    first = np.array(machine.tip_pose(machine.base_home(), START).position).ravel().astype(float)
    path = smooth(CornerPath.through([first, first + size * np.array([-0.4, 0.25, 0.0])]), 0.002 * size)
    return machine, TipTask.along(path, 0.3 * size, rows=(3, 4), acceleration=size, jerk=10.0 * size)


@pytest.mark.long
def test_joints_within_shares_of_their_free_peaks_move_alike_on_machines_of_all_sizes() -> None:
    """A machine and a tool path that are fifty times smaller leave angles and times as they are."""
    large, small = (assert_within_shares_of_peaks(*scaled_line(size), 0.95, START) for size in (1.0, 0.02))
    assert small.cost == pytest.approx(large.cost, rel=LIMIT_SHARE)
    times = np.linspace(0.0, large.horizon, 50)
    np.testing.assert_allclose(small.at(times)["joints"], large.at(times)["joints"], atol=LIMIT_SHARE)


@pytest.mark.long
def test_a_rail_within_shares_of_its_free_peaks_leaves_the_rest_of_a_ramp_to_the_arm() -> None:
    robot = mount_on_rail(planar_chain([0.5, 0.4], [1.0, 1.0]), (1, 0, 0), -3.0, 3.0, velocity=2.0)
    path = smooth(CornerPath.through([(-1.0, 0.6, 0.0), (1.0, 0.5, 0.0)]), 0.002)
    result = assert_within_shares_of_peaks(FixedBase(robot), TipTask.along(path, 0.3, rows=(3, 4)), 0.7)
    assert result.audit().passed


def test_joints_that_end_without_a_task_rest_at_fixed_values() -> None:
    """Equations of the end would say the same as values that are fixed there."""
    result = plan(FIXED, smooth_task(FIXED), start=START, horizon=SECONDS + 1.0, limits=Limits(acceleration=9.0))
    assert result.audit().passed
    names = {finding.name for finding in result.audit().findings}
    assert "end of velocities 2" in names
    assert not any(name.startswith("rest") for name in names)
    np.testing.assert_allclose(result.sampled(np.array([result.horizon])).rates, 0.0, atol=1e-9)


@pytest.mark.long
def test_a_seam_of_many_poses_is_planned_within_accelerations_and_jerks(tmp_path: Path) -> None:
    """On a pipe that stands on a wider one, given by 200 poses in millimetres, from rest to rest."""
    angle = np.linspace(-0.8 * np.pi, 0.8 * np.pi, 200)
    x, y = 500 + 60 * np.cos(angle), 60 * np.sin(angle)
    axes = np.column_stack([-0.5 * np.cos(angle), -0.5 * np.sin(angle), -0.85 + 0 * angle])
    axes /= np.linalg.norm(axes[0])
    seam = np.column_stack([x, y, 150 + np.sqrt(120**2 - y**2) - 120, axes])
    np.savetxt(tmp_path / "seam.csv", seam, delimiter=",", header="x [mm],y [mm],z [mm],ax,ay,az", comments="")
    task = TipTask.along(read_waypoints(tmp_path / "seam.csv").smooth(0.0005), 0.01)
    result = plan(SIX_AXIS, task, limits=Limits(acceleration=8.0, jerk=100.0))
    assert result.audit().passed
    sample = result.sample(0.001)
    assert np.abs(sample.accelerations).max() <= 8.0
    assert (np.abs(np.diff(sample.accelerations, axis=0)) / 0.001).max() <= 100.0 * (1 + 1e-3)
    np.testing.assert_allclose(sample.rates[[0, -1]], 0.0, atol=1e-6)
    np.testing.assert_allclose(sample.accelerations[[0, -1]], 0.0, atol=1e-4)


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
