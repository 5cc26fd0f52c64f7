"""Redundancy of real arms resolved over the whole motion: floating with momentum, cyclic, with a free tool axis."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FreeFloating, Path, center_of_mass, paper_example, smooth
from models.machines.machine import with_tip
from ocp import Collocation, ProblemError, TipTask, VelocitySetup, minimum_velocity_problem, solve
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.tracks import path_tracks
from tests.models.robot.trees import numeric
from tests.ocp.motion.builders.test_minimum_velocity import audited, chain, resolved
from tests.ocp.motion.local.test_rates import PAPER_START
from tests.ocp.motion.tasks.space_tasks import (
    BASE,
    PANDA_START,
    UR5_START,
    circle,
    floating_manipulator,
    floating_panda,
    largest_error,
    largest_momentum_error,
    line_from,
    panda,
    pose,
    two_pandas,
    ur5,
)

pytestmark = pytest.mark.long

AT_BASE = VelocitySetup(start_base=BASE)

MANIPULATOR_START = np.array([0.3, -0.6, 0.4, 1.0, -0.4, 0.8, 0.2])
FINE = Collocation(intervals=50, degree=4)


@pytest.mark.parametrize("momentum", [None, (0.5, -0.3, 0.4, 1.0, -2.0, 1.5)])
def test_a_space_manipulator_follows_a_pose_line_optimally(momentum: Any) -> None:
    """14 states, 50 intervals: audited, on the line, the momentum conserved, cheaper than the pseudo-inverse."""
    machine = FreeFloating(floating_manipulator().robot, conserved_momentum=momentum)
    line = line_from(machine, BASE, MANIPULATOR_START, (0.1, -0.1, 0.05), (1, 2, 0.5), 0.3, 10.0)
    task = TipTask(position=line.position, orientation=line.orientation)
    request: dict[str, Any] = {"tasks": task, "start": MANIPULATOR_START, "horizon": 10.0, "setup": AT_BASE}
    solution = audited(machine, FINE, **request)
    assert sum(values.shape[1] for values in solution.states.values()) == 14
    assert largest_error(machine, task, solution) < 1e-6
    scale = np.linalg.norm(momentum) if momentum else machine.robot.total_mass * np.abs(solution["rates"]).max()
    assert largest_momentum_error(machine, solution) < 1e-9 * scale
    np.testing.assert_allclose(np.linalg.norm(solution["base"][:, 3:], axis=1), 1.0, atol=1e-9)
    assert solution.cost < resolved(machine, **request).cost[-1]


def test_a_light_satellite_gains_by_planning_ahead() -> None:
    machine = floating_panda((0.05, -0.03, 0.04, 0.1, -0.2, 0.15))
    line = line_from(machine, BASE, PANDA_START, (0.1, -0.15, 0.1), (1, 2, 0.5), 0.5, 10.0)
    task = TipTask(position=line.position, direction=lambda time: line.orientation(time)[:, 2])
    start: dict[str, Any] = {"start": PANDA_START, "horizon": 10.0, "setup": AT_BASE}
    solution = audited(machine, Collocation(intervals=30, degree=4), tasks=task, **start)
    assert largest_error(machine, task, solution) < 1e-6
    local = resolved(machine, tasks=task, **start)
    assert local.stopped is None
    assert solution.cost < 0.95 * local.cost[-1]


@pytest.mark.parametrize("kind", ["position", "direction", "orientation"])
def test_a_cyclic_plan_closes_the_joints_of_an_arm(kind: str) -> None:
    rotation, position = pose(panda(), (), PANDA_START)
    aims: dict[str, Any] = {"direction": {"direction": rotation[:, 2]}, "orientation": {"orientation": rotation}}
    task = TipTask(position=circle(position, 0.1, 6.0), **aims.get(kind, {}))
    start: dict[str, Any] = {"tasks": task, "start": PANDA_START, "horizon": 6.0}
    solution = audited(panda(), FINE, cyclic=True, **start)
    assert np.abs(solution["joints"][-1] - solution["joints"][0]).max() <= 1e-8
    assert largest_error(panda(), task, solution) < 1e-6
    assert np.abs(solution["closure"]).max() < 1e-8  # what the task gave way
    local = resolved(panda(), **start)
    assert np.abs(local.joints[-1] - PANDA_START).max() > 0.05


def test_a_cyclic_plan_may_choose_where_to_start() -> None:
    _, position = pose(panda(), (), PANDA_START)
    task = TipTask(position=circle(position, 0.1, 6.0))
    start: dict[str, Any] = {"tasks": task, "start": PANDA_START, "horizon": 6.0, "cyclic": True}
    method = Collocation(intervals=30, degree=4)
    fixed = solve(minimum_velocity_problem(panda(), **start), method)
    free = audited(panda(), method, **(start | {"start": None, "setup": VelocitySetup(near=PANDA_START)}))
    assert free.cost < fixed.cost - 1e-4
    np.testing.assert_allclose(pose(panda(), (), free["joints"][0])[1], position, atol=1e-9)
    assert np.abs(free["joints"][-1] - free["joints"][0]).max() <= 1e-8


def test_a_free_start_is_found_by_inverse_kinematics_and_a_velocity_holds_its_pose() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    task = TipTask(
        position=lambda t: ca.vertcat(position[0], position[1] + 0.05 * t, position[2]), direction=rotation[:, 2]
    )
    solution = audited(ur5(), Collocation(intervals=15, degree=4), tasks=task, horizon=2.0)
    assert largest_error(ur5(), task, solution) < 1e-6
    machine, start = chain(), np.deg2rad([30.0, 40.0, 50.0])
    request: dict[str, Any] = {"tasks": TipTask(rows=(3, 4), velocity=(-0.2, 0.1)), "horizon": 3.0}
    costs = []
    for begin in ({"start": start}, {"setup": VelocitySetup(near=start)}):
        plan = audited(machine, Collocation(intervals=15), **begin, **request)
        np.testing.assert_allclose(pose(machine, (), plan["joints"][0])[1], pose(machine, (), start)[1], atol=1e-8)
        costs.append(plan.cost)
    assert costs[1] < costs[0]


def test_constraints_satisfied_by_a_floating_base_are_counted() -> None:
    """Of the pose 3 combinations do not depend on the base's, of a position its distance from the centre of mass.

    On a fixed base all; of rows along the turning tip none.
    """
    place = (np.zeros(0), BASE)
    floating, fixed = floating_panda(), panda()
    rotation, position = pose(floating, BASE, PANDA_START)
    whole, point = TipTask(position=position, orientation=rotation), TipTask(position=position)
    assert bind(fixed, whole).cyclic_rows(place[0], PANDA_START).shape == (6, 6)
    assert bind(floating, whole).cyclic_rows(place[1], PANDA_START).shape == (6, 3)
    directions = bind(floating, point).cyclic_rows(place[1], PANDA_START)
    assert directions.shape == (3, 1)
    arm = position - numeric(center_of_mass(floating.robot, PANDA_START, floating.world_from_base(BASE))).ravel()
    np.testing.assert_allclose(np.cross(directions[:, 0], arm), 0, atol=1e-9)
    beside = TipTask(position=position, relative_to="satellite")
    assert bind(floating, beside).cyclic_rows(BASE, PANDA_START).shape == (3, 3)
    planar = TipTask(position=lambda time: ca.DM.zeros(3), rows=(3, 4))
    assert bind(paper_example(), planar).cyclic_rows(np.zeros(3), PAPER_START).shape == (2, 1)
    moving = TipTask(rows=range(6), velocity=np.zeros(6), axes="tip")
    assert bind(fixed, moving).cyclic_rows(place[0], PANDA_START).shape == (6, 0)


def test_a_floating_arm_returns_to_its_start_on_a_closed_path() -> None:
    machine = floating_panda()
    _, position = pose(machine, BASE, PANDA_START)
    task = TipTask(position=circle(position, 0.05, 6.0))
    start: dict[str, Any] = {"tasks": task, "start": PANDA_START, "horizon": 6.0, "setup": AT_BASE}
    solution = audited(machine, Collocation(intervals=20, degree=4), cyclic=True, **start)
    assert np.abs(solution["joints"][-1] - PANDA_START).max() <= 1e-8
    assert largest_error(machine, task, solution) < 1e-6


def test_a_drifting_machine_cannot_return_in_the_world_but_relative_to_its_base() -> None:
    machine = floating_panda((0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    _, position = pose(machine, BASE, PANDA_START)
    request: dict[str, Any] = {"start": PANDA_START, "horizon": 4.0, "setup": AT_BASE, "cyclic": True}
    with pytest.raises(ProblemError, match="the linear momentum keeps moving the centre of mass"):
        minimum_velocity_problem(machine, tasks=TipTask(position=circle(position, 0.05, 4.0)), **request)
    frame = machine.world_from_base(BASE)
    beside = numeric(frame.rotation).T @ (position - numeric(frame.position).ravel())
    task = TipTask(position=circle(beside, 0.05, 4.0), relative_to="satellite")
    solution = audited(machine, Collocation(intervals=20, degree=4), tasks=task, **request)
    assert largest_error(machine, task, solution) < 1e-6
    assert np.abs(solution["joints"][-1] - PANDA_START).max() <= 1e-8


def test_cyclic_tasks_that_are_open_are_refused() -> None:
    rotation, position = pose(panda(), (), PANDA_START)
    request: dict[str, Any] = {"start": PANDA_START, "horizon": 2.0, "cyclic": True}
    open_path = TipTask(position=lambda time: ca.vertcat(position[0], position[1], position[2] + 0.01 * time))
    straight, turned = TipTask(velocity=(0.1,), rows=(4,)), TipTask(velocity=(0, 0, 0.3), rows=(0, 1, 2))
    for task, gap in ((open_path, r"0\.02"), (straight, r"0\.2"), (turned, r"0\.6")):
        with pytest.raises(ProblemError, match=f"not closed: it ends {gap} "):
            minimum_velocity_problem(panda(), tasks=task, **request)
    turning = TipTask(orientation=rotation, position=position, rows=(0, 1, 2))
    minimum_velocity_problem(panda(), tasks=turning, **request)


def test_two_arms_carry_one_thing_while_the_base_stands() -> None:
    machine = two_pandas()
    start = np.concatenate([PANDA_START * [-1, 1, -1, 1, -1, 1, 1], PANDA_START])
    home = machine.base_home()
    left, right = (with_tip(machine, f"{side}_panda_hand") for side in ("left", "right"))
    (turn, place), (_, there) = pose(left, home, start), pose(right, home, start)
    task = [
        TipTask(position=lambda time: ca.DM(place) - 0.03 * time * ca.DM([0, 0, 1]), link="left_panda_hand"),
        TipTask(position=turn.T @ (there - place), link="right_panda_hand", relative_to="left_panda_hand"),
        TipTask(rows=(0, 1, 2), velocity=(0, 0, 0), link="satellite"),
    ]
    request: dict[str, Any] = {"tasks": task, "start": start, "horizon": 3.0}
    solution = audited(machine, Collocation(intervals=10, degree=4), **request)
    assert largest_error(machine, task, solution) < 1e-6
    np.testing.assert_allclose(solution["base"][:, 3:], np.tile(home[3:], (len(solution.t), 1)), atol=1e-8)
    assert solution.cost < resolved(machine, **request).cost[-1] + 1e-9


def test_the_free_roll_of_a_tool_is_planned_along_a_raster_without_a_jump() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    corners = position + np.array([[0, 0, 0], [0.0, 0.15, 0], [0.04, 0.15, 0], [0.04, 0, 0]])
    path = smooth(Path.through(corners), deviation=0.008)
    task = TipTask(position=path_tracks(path, 0.1).position, direction=rotation[:, 2])
    horizon = path.length / 0.1
    request: dict[str, Any] = {"tasks": task, "start": UR5_START, "horizon": horizon}
    local = resolved(ur5(), **request)
    assert list(minimum_velocity_problem(ur5(), **request).declared.signals) == ["targets"]
    edges = np.asarray(path.bounds) / path.length
    segments = [np.linspace(a, b, 7)[:-1] for a, b in pairwise(edges)]
    mesh = (*np.concatenate(segments).tolist(), 1.0)
    method = Collocation(intervals=len(mesh) - 1, degree=4, mesh=mesh)
    solution = audited(ur5(), method, **request)
    assert largest_error(ur5(), task, solution) < 1e-6
    assert solution.cost <= local.cost[-1] * (1 + 1e-7)
    fine = solution.at(np.linspace(0, horizon, 1001))["joints"]
    assert np.abs(np.diff(fine, axis=0)).max() < 2 * np.abs(solution["rates"]).max() * horizon / 1000


def test_weights_and_momentum_cost_less_than_instantly() -> None:
    machine = FreeFloating(paper_example().robot, "planar", conserved_momentum=(5.0, -4.0, 2.0))
    request: dict[str, Any] = {"tasks": TipTask(rows=(3, 4), velocity=(-0.4, -0.3)), "start": PAPER_START}
    request |= {"horizon": 2.0, "weights": (1.0, 3.0, 0.5)}
    solution = audited(machine, Collocation(intervals=20, degree=4), **request)
    assert solution.cost < resolved(machine, **request).cost[-1]
    with pytest.raises(ProblemError, match="is not positive"):
        minimum_velocity_problem(machine, **{**request, "weights": (1.0, 0.0, 1.0)})
