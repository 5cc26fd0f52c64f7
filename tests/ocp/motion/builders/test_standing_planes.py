"""Machines that move in any vertical plane, and what tips them sideways."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import Standing, Support, rectangle
from models.paths import rest_to_rest
from ocp import AccelerationOptions, Collocation, ProblemError, Solution, TipTask, resolve_accelerations, solve
from ocp.motion.builders.standing.problem import StandingSetup, Weights, standing_problem
from ocp.motion.local.accelerations import Law
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Limits, Pinned, ZmpRule
from tests.models.machines.standing_machines import planar_machine
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.builders.standing_tasks import (
    PLANAR_HORIZON,
    led,
    moved_task,
    planar_start,
    planar_task,
    sampled,
    tip_at,
    with_setup,
)

SIZE = 5
START = planar_start(SIZE)
TASK = planar_task(SIZE, 0.2, -0.3)
WEIGHTS = Weights(manipulability=0.0)  # that of two rows depends on the plane
LAWS: tuple[Law, ...] = ("augmented", "null_space", "stabilised")


def turned(degrees: float) -> tuple[Standing, TipTask]:
    """The planar machine turned about the vertical, somewhere else, and its task in x or y and z."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    machine = planar_machine(SIZE)
    shift = np.array([0.3, -0.2, 0.0])
    corners = machine.support.vertices @ turn[:2, :2].T + shift[:2]
    machine = replace(
        machine,
        translation=shift,
        rotation=turn @ np.asarray(machine.rotation),
        support=Support(corners),
        most_stable_point=None,
        half_widths=None,
    )
    axis = int(np.abs(turn[:2, 1]).argmax())
    tip, ahead = tip_at(machine, START), 0.2 * turn[axis, 1]

    def path(t: Any) -> list[Any]:
        share = rest_to_rest(t / PLANAR_HORIZON)
        return [tip[axis] + ahead * share, tip[2] - 0.3 * share]

    return machine, led(path, (3 + axis, 5))


def resting_point(machine: Standing) -> Array:
    rest = np.zeros(SIZE)
    return numeric(machine.zero_moment_point(START, rest, rest)).ravel()


def planned(machine: Standing, task: TipTask, zmp: ZmpRule, **settings: Any) -> Solution:
    options = with_setup({"zmp": zmp, "weights": WEIGHTS, "tip_level": "acceleration", **settings})
    problem = standing_problem(machine, task, PLANAR_HORIZON, start=START, **options)
    return solve(problem, Collocation(10, degree=3, scheme="legendre"))


@pytest.mark.parametrize("degrees", [0.0, 35.0, 90.0, 210.0])
def test_motion_moves_the_zero_moment_point_along_the_plane_alone(degrees: float) -> None:
    machine = turned(degrees)[0]
    along = np.array([-np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))])
    assert machine.moving_directions.shape == (1, 2)
    assert abs(machine.moving_directions[0] @ along) == pytest.approx(1.0, abs=1e-12)
    for point in (machine.nearest_reachable((0.0, 0.0)), machine.nearest_reachable((2.0, -1.0))):
        assert np.cross([*along, 0.0], [*(point - [0.3, -0.2]), 0.0])[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.long
def test_plans_and_laws_are_the_same_in_every_vertical_plane() -> None:
    costs, pushes = [], []
    for degrees in (0.0, 35.0, 210.0):
        machine, task = turned(degrees)
        point = resting_point(machine)
        costs.append([planned(machine, task, zmp).cost for zmp in (InFoot(0.01), Pinned(point))])
        matches = [
            resolve_accelerations(
                machine, task, 0.2, start=START, law=law, step=0.01, options=AccelerationOptions(zmp=point)
            )
            for law in LAWS
        ]
        assert all(one.succeeded for one in matches)
        pushes.append([one.motion.joint_accelerations for one in matches])
        for one in matches:
            np.testing.assert_allclose(one.motion.zero_moment_point, np.broadcast_to(point, (21, 2)), atol=1e-9)
    for other in (1, 2):
        np.testing.assert_allclose(costs[other], costs[0], rtol=1e-5)
        np.testing.assert_allclose(pushes[other], pushes[0], atol=1e-8)


@pytest.mark.parametrize("zmp", [InFoot(0.0), IndexAtLeast(0.2), Pinned((0.0, 0.0))], ids=["foot", "index", "pinned"])
def test_lateral_forces_on_a_planar_machine_count(zmp: ZmpRule) -> None:
    """The zero moment point is z F / Fz aside, which only a lower tip makes less."""
    machine = planar_machine(SIZE)

    def push(force: float) -> Any:
        return lambda time, tip: [machine.tip_wrench((force, 0, 0))]

    point = resting_point(machine)
    rule = Pinned(point) if isinstance(zmp, Pinned) else zmp
    limits = Limits(acceleration=8.0)
    solution = planned(machine, TASK, rule, wrenches=push(20.0), limits=limits)
    motion = sampled(machine, solution, push(20.0))
    aside = 20.0 * motion.tip_in_world[:, 2] / motion.ground_force[:, 2]
    np.testing.assert_allclose(motion.zero_moment_point[:, 0], aside, atol=1e-12)
    assert motion.foot_margin.min() > -1e-3
    with pytest.raises(ProblemError, match="zero moment point"):
        planned(machine, TASK, rule, wrenches=push(60.0), limits=limits)
    standing_problem(
        machine,
        TASK,
        PLANAR_HORIZON,
        start=START,
        zmp=Anywhere(),
        limits=limits,
        setup=StandingSetup(wrenches=push(60.0)),
    )


@pytest.mark.parametrize("start", ["rest", "free"])
@pytest.mark.parametrize("zmp", [InFoot(0.0), IndexAtLeast(0.2)], ids=["foot", "index"])
def test_a_foot_beside_the_machine_is_refused(start: Any, zmp: ZmpRule) -> None:
    beside = replace(
        planar_machine(SIZE), support=rectangle((0.05, 0.2), (-0.12, 0.2)), most_stable_point=None, half_widths=None
    )
    with pytest.raises(ProblemError, match="zero moment point"):
        planned(beside, TASK, zmp, start_velocity=start)


@pytest.mark.parametrize(
    ("zmp", "message"),
    [
        (Pinned((0.0, 0.3)), r"Pinned: \[0.0, 0.3\] m at 0 s is 0.1 m outside the support"),
        (Pinned(lambda t: [0.0, -0.02 * t * t]), None),
        (Pinned(lambda t: [0.0, 0.15 * t]), r"Pinned: .* at 1.34 s is 0.001 m outside the support"),
        (Pinned(lambda t: [0.0, np.nan]), "Pinned: point must be two numbers"),
        (Pinned(lambda t: [0.0, (t - 1) ** 0.5]), "Pinned: point must be two numbers"),
    ],
)
def test_a_reference_that_leaves_the_foot_is_refused(zmp: ZmpRule, message: str | None) -> None:
    arguments = (planar_machine(SIZE), TASK, PLANAR_HORIZON)
    setup = StandingSetup(tip_level="acceleration")
    if message is None:
        assert standing_problem(*arguments, start=START, zmp=zmp, setup=setup).name == "standing plan"
        return
    with pytest.raises(ProblemError, match=message) as caught:
        standing_problem(*arguments, start=START, zmp=zmp)
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_joints_used_by_tip_and_zero_moment_point_cannot_rest() -> None:
    machine, start = planar_machine(3), planar_start(3)
    task, setup = planar_task(3, 0.02, -0.02), StandingSetup(tip_level="acceleration")
    with pytest.raises(ProblemError, match=r"2 rows and 1 of the zero moment point leave the 3 joints no freedom"):
        standing_problem(machine, task, PLANAR_HORIZON, start=start, zmp=Pinned(), setup=setup)
    two, begin = planar_machine(2), planar_start(3)[:2]
    ahead = moved_task(two, begin, (0.1, -0.1), PLANAR_HORIZON)
    with pytest.raises(ProblemError, match=r"2 rows leave the 2 joints no freedom .* tip_level='acceleration'"):
        standing_problem(two, ahead, PLANAR_HORIZON, start=begin, zmp=Anywhere())
    plan = standing_problem(two, ahead, PLANAR_HORIZON, start=begin, zmp=Anywhere(), setup=setup)
    solution = solve(plan, Collocation(10, degree=3, scheme="legendre"))
    np.testing.assert_allclose(solution["velocities"][-1], 0, atol=1e-5)


def test_a_singular_start_is_named_where_the_cost_needs_a_slope() -> None:
    machine = planar_machine(SIZE)
    straight = np.zeros(SIZE)
    task = moved_task(machine, straight, (-0.1, 0.1), PLANAR_HORIZON)
    with pytest.raises(ProblemError, match=r"start \[0.0, .* singular there"):
        standing_problem(machine, task, PLANAR_HORIZON, start=straight)
