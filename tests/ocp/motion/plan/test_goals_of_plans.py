"""Motions from here to there through `plan`: costs, poses, velocities at the ends, what stays, files and bad input."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Box, FixedBase, HalfSpace, Sphere, example_robot
from models.checks import Array
from ocp import (
    Collocation,
    Cost,
    Goal,
    Limits,
    Phases,
    Plan,
    ProblemError,
    Scene,
    Start,
    TipTask,
    plan,
    plan_problem,
    solve,
)

START = np.array([0.0, -0.6, 1.2, 0.0, 0.9, 0.0])
END = START + np.array([0.8, 0.3, -0.4, 0.2, 0.1, 0.5])
LENGTH, TIME = Cost(velocity=0.0, length=1.0), Cost(velocity=0.0, time=1.0)


@cache
def arm() -> FixedBase:
    return FixedBase(example_robot("six_axis"))


def tip(joints: Array) -> tuple[Array, Array]:
    pose = arm().tip_pose((), joints)
    return np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))


def last(motion: Plan) -> Array:
    return np.asarray(motion.at(motion.horizon)["joints"])


def test_without_obstacles_the_shortest_motion_is_straight_and_meets_its_bound() -> None:
    motion = plan(arm(), Goal(joints=END), start=START, cost=LENGTH, scene=False)
    assert motion.cost == pytest.approx(np.linalg.norm(END - START), rel=1e-9)
    assert motion.gap == pytest.approx(0.0, abs=1e-9)
    middle = motion.at(motion.horizon / 2)["joints"]
    assert middle == pytest.approx((START + END) / 2, abs=1e-9)


def test_weights_stretch_joint_space() -> None:
    weights = np.array([4.0, 1.0, 1.0, 1.0, 1.0, 9.0])
    motion = plan(
        arm(), Goal(joints=END), start=START, cost=Cost(velocity=0.0, length=2.0, weights=weights), scene=False
    )
    assert motion.cost == pytest.approx(2.0 * np.linalg.norm(np.sqrt(weights) * (END - START)), rel=1e-9)


def test_half_the_squared_rates_of_a_straight_motion_follow_from_its_duration() -> None:
    motion = plan(arm(), Goal(joints=END), 2.0, start=START, scene=False)
    assert motion.cost == pytest.approx(((END - START) ** 2).sum() / (2 * 2.0), rel=1e-9)
    assert motion.audit().passed


def test_the_fastest_motion_takes_the_time_of_the_joint_that_needs_longest() -> None:
    """Rest to rest within velocity and acceleration limits: a trapezoid of the largest displacement."""
    far, most, grow = 0.8, 1.0, 4.0
    motion = plan(
        arm(), Goal(joints=END), start=START, cost=TIME, limits=Limits(velocity=most, acceleration=grow), scene=False
    )
    assert motion.horizon == pytest.approx(far / most + most / grow, rel=1e-3)
    assert motion.bound == pytest.approx(motion.horizon, rel=1e-3)
    rates = np.abs(motion.at(np.linspace(0.0, motion.horizon, 400))["rates"])
    assert rates.max() <= most * (1 + 1e-6)
    assert motion.at([0.0, motion.horizon])["rates"] == pytest.approx(0.0, abs=1e-9)
    audit = motion.audit()  # no multipliers show whether it is optimal, but the bound says how near it is
    assert (audit.feasible, audit.optimal) == (True, None)
    assert not [finding for finding in audit.findings if finding.verdict == "optimal"]
    assert "its cost exceeds a lower bound by at most" in audit.sentence
    assert "not at rest" not in audit.sentence


@pytest.mark.parametrize("cost", [Cost(), LENGTH, TIME])
def test_to_stay_where_it_is_takes_no_time_and_no_search(cost: Cost) -> None:
    limits = Limits(acceleration=5.0) if cost.time else None
    motion = plan(arm(), Goal(joints=START), start=START, cost=cost, limits=limits, scene=False, time_limit=60.0)
    assert motion.audit().feasible
    assert motion.cost <= 1e-3 * (1 + 1e-9)
    joints = motion.at(np.linspace(0.0, motion.horizon, 5))["joints"]
    assert joints == pytest.approx(np.tile(START, (5, 1)), abs=1e-15)


def test_a_moving_start_and_end_are_met() -> None:
    rates = 0.2 * (END - START)
    motion = plan(
        arm(),
        Goal(joints=END, velocity=rates),
        1.5,
        start=Start(START, velocity=-rates),
        cost=Cost(velocity=1.0, acceleration=0.1),
        limits=Limits(acceleration=8.0),
        scene=False,
    )
    assert motion.audit().feasible
    assert motion.at(0.0)["rates"] == pytest.approx(-rates, abs=1e-6)
    assert motion.at(1.5)["rates"] == pytest.approx(rates, abs=1e-6)
    assert last(motion) == pytest.approx(END, abs=1e-9)


def test_a_tool_axis_a_cone_and_a_region_are_reached() -> None:
    position, rotation = tip(END)
    free = plan(arm(), Goal(position=position, direction=rotation[:, 2]), start=START, cost=LENGTH, scene=False)
    place, turn = tip(last(free))
    assert place == pytest.approx(position, abs=1e-7)
    assert turn[:, 2] == pytest.approx(rotation[:, 2], abs=1e-7)
    whole = plan(arm(), Goal(position=position, orientation=rotation), start=START, cost=LENGTH, scene=False)
    assert tip(last(whole))[1] == pytest.approx(rotation, abs=1e-7)
    assert free.cost <= whole.cost * (1 + 1e-9)
    ball = Goal(region=Sphere(0.05, position), direction=rotation[:, 2], within=0.3)
    near = plan(arm(), ball, start=START, cost=LENGTH, scene=False)
    place, turn = tip(last(near))
    assert np.linalg.norm(place - position) <= 0.05 + 1e-7
    assert np.arccos(np.clip(turn[:, 2] @ rotation[:, 2], -1.0, 1.0)) <= 0.3 + 1e-6


@pytest.mark.long
def test_obstacles_are_avoided_at_a_cost_and_proven() -> None:
    """A wall between start and goal: longer than the straight motion, clear between the samples."""
    there = START + np.array([1.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    places = np.array([tip(START + share * (there - START))[0] for share in np.linspace(0.0, 1.0, 21)])
    post = Box((0.06, 0.06, 0.6), tuple(places[10]))
    scene = Scene([post], clearance=0.005)
    motion = plan(arm(), Goal(joints=there), start=START, cost=LENGTH, scene=scene)
    assert motion.cost > 1.6 * (1 + 1e-3)
    assert motion.bound == pytest.approx(1.6, rel=1e-9)
    audit = motion.audit()
    assert audit.feasible
    assert audit.clearances["clearance"].settled
    smooth = plan(arm(), Goal(joints=there), start=START, cost=TIME, limits=Limits(acceleration=6.0), scene=scene)
    assert smooth.audit().feasible
    assert smooth.cost >= smooth.bound  # type: ignore[operator]


def test_the_problem_of_a_motion_has_its_cost() -> None:
    """What `plan` solves can be declared, changed and solved by oneself."""
    straight = solve(plan_problem(arm(), Goal(joints=END), 2.0, start=START, scene=False), Collocation(8, degree=3))
    assert straight.cost == pytest.approx(((END - START) ** 2).sum() / 4, rel=1e-6)
    limits, cost = Limits(acceleration=6.0), Cost(velocity=1.0, acceleration=0.1)
    problem = plan_problem(arm(), Goal(joints=END), 2.0, start=START, limits=limits, cost=cost, scene=False)
    motion = plan(arm(), Goal(joints=END), 2.0, start=START, limits=limits, cost=cost, scene=False)
    assert solve(problem, Collocation(20, degree=5)).cost == pytest.approx(motion.cost, rel=1e-3)
    task = TipTask(
        position=lambda t: tip(START)[0] + 0.05 * t * np.array([0.0, 1.0, 0.0]), duration=1.0, rows=(3, 4, 5)
    )
    problem = plan_problem(arm(), task, start=START, scene=False)
    own = solve(problem, Collocation(12, degree=4))
    assert own.cost == pytest.approx(plan(arm(), task, start=START, scene=False).cost, rel=1e-4)
    with pytest.raises(ProblemError, match=r"Cost\(velocity=1.0, effort=1.0\)") as refused:
        plan_problem(arm(), task, start=START, cost=Cost(effort=1.0), scene=False)
    assert refused.value.name == "cost"
    several = plan_problem(
        arm(), [Goal(joints=END, duration=1.0), Goal(joints=START, duration=1.0)], start=START, scene=False
    )
    assert isinstance(several, Phases)


def test_the_same_seed_gives_the_same_motion_and_files_keep_it(tmp_path: Path) -> None:
    there = START + np.array([1.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    middle = tip(START + 0.5 * (there - START))[0]
    options: dict[str, Any] = {"start": START, "cost": LENGTH, "scene": Scene([Sphere(0.05, middle)]), "seed": 3}
    first, again = (plan(arm(), Goal(joints=there), **options) for _ in range(2))
    times = np.linspace(0.0, first.horizon, 31)
    np.testing.assert_array_equal(first.at(times)["joints"], again.at(times)["joints"])
    first.save(tmp_path / "goal.npz")
    read = Plan.load(tmp_path / "goal.npz")
    np.testing.assert_array_equal(first.at(times)["joints"], read.at(times)["joints"])
    assert read.audit().feasible == first.audit().feasible
    assert read.bound == first.bound


FLOOR = HalfSpace((0.0, 0.0, 1.0), (0.0, 0.0, 3.0))


@pytest.mark.parametrize(
    ("goal", "options", "name", "words"),
    [
        (Goal(joints=END), {"start": None}, "start", "start is missing"),
        (Goal(joints=END + 9.0), {}, "joint_1", "outside its limits"),
        (Goal(joints=END[:3]), {}, "goal", "6|entries"),
        (Goal(position=(3.0, 0.0, 0.0)), {}, None, "nearest miss|reach"),
        (Goal(position=(0.5, 0.1, 0.2), tip="gripper"), {}, "gripper", "gripper"),
        (Goal(joints=END), {"scene": Scene([FLOOR])}, None, "start: .* overlap"),
        (Goal(joints=END), {"cost": Cost(velocity=1.0, length=1.0)}, "length", "length"),
        (Goal(joints=END), {"horizon": -1.0}, "horizon", "horizon"),
        (Goal(joints=END), {"cyclic": True}, "cyclic", "cyclic"),
    ],
)
def test_bad_requests_are_refused_by_name(goal: Goal, options: dict[str, Any], name: str | None, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        plan(arm(), goal, **{"start": START, "scene": False, **options})
    assert name is None or caught.value.name == name


def test_a_goal_in_collision_names_the_bodies() -> None:
    block = Box((0.1, 0.1, 0.1), tuple(tip(END)[0]))
    with pytest.raises(ProblemError, match="overlap") as caught:
        plan(arm(), Goal(joints=END), start=START, scene=Scene([block]))
    assert "obstacle 0" in str(caught.value.name)


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"joints": END, "position": (0.5, 0.0, 0.2)}, "joints"),
        ({"position": (0.5, 0.0, 0.2), "region": Sphere(0.1, (0.5, 0.0, 0.2))}, "region"),
        ({"region": "here"}, "region"),
        ({"joints": END, "tip": "tool"}, "tip"),
        ({"position": (0.5, 0.0, 0.2), "direction": (0, 0, 1), "within": 4.0}, "within"),
        ({"position": (0.5, 0.0, 0.2), "orientation": np.eye(3), "direction": (0, 0, 1)}, "direction"),
    ],
)
def test_contradictory_goals_are_refused_at_construction(fields: dict[str, Any], name: str) -> None:
    with pytest.raises(ProblemError) as caught:
        Goal(**fields)
    assert caught.value.name == name


@pytest.mark.long
def test_power_limits_slow_the_fastest_motion_down_and_are_kept() -> None:
    """Large powers make no difference; the smaller they are, the longer the motion lasts."""
    goal, times = Goal(joints=END), list[float]()
    for power in (2.0, 4.0, 1e6, np.inf):
        limits = Limits(acceleration=10.0, jerk=200.0, power=power)
        motion = plan(arm(), goal, start=START, cost=Cost(velocity=0.0, time=1.0), limits=limits, scene=False)
        assert motion.audit().feasible
        times.append(motion.horizon)
    assert times[2] == pytest.approx(times[3], rel=1e-6)
    assert times[0] > times[1] > times[2]
