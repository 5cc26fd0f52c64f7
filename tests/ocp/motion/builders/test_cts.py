"""Roll planned over a whole trajectory: limits, reach, clearance, and what planning ahead is worth."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Box, Rig, optimal_inverse, reference_rig, reference_tunnel
from models.cts.clearance import Avoidance, CollisionScene, clearances
from models.cts.rig import HOME, INCH, inverse
from ocp import Collocation, ProblemError, RollSettings, Solution, roll_problem, solve, spline_targets
from ocp.motion.builders.cts import least_cost_roll
from tests.models.cts.cts_oracle import index_by_geometry

RIG, TUNNEL = reference_rig(), reference_tunnel()
HORIZON = 10.0
DENSE = np.linspace(0, HORIZON, 401)
SMOOTH = Collocation(intervals=25, degree=3)
HELD = Collocation(intervals=50, degree=3, control="held")  # its double integrator is exact


def falling(time: Any) -> list[Any]:
    """The paper's sweep, z from -15 to 15 in at 3 in/s."""
    return [100 * INCH, 6 * INCH, (-15 + 3 * time) * INCH, 0.0, 0.0]


def targets_at(t: Any) -> Any:
    return np.array([np.broadcast_to(part, len(t)) for part in falling(np.asarray(t))])


def joints_along(rig: Rig, result: Solution, t: Any) -> Any:
    """Joints of the plan at some times, between the nodes too. Shape (6, samples)."""
    x, phi = ca.SX.sym("x", 5), ca.SX.sym("phi")
    joints = ca.Function("j", [x, phi], [inverse(rig, x, phi, HOME)[0]]).map(len(t))
    return np.array(joints(targets_at(t), np.asarray(result.at(t)["roll"]).reshape(1, -1)))


def least_gaps(around: CollisionScene, joints: Any) -> Any:
    """Distance of the rig from its surroundings for joints of shape (6, samples)."""
    q = ca.SX.sym("q", 6)
    gaps = ca.Function("gaps", [q], [ca.mmin(ca.vertcat(*clearances(RIG, q, around).values()))])
    return np.array(gaps.map(joints.shape[1])(joints))


def roll_arguments(options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of roll_problem, those of its settings and obstacles collected there."""
    options, arguments = dict(options), {}
    for name, kind in (("settings", RollSettings), ("avoidance", Avoidance)):
        names = {field.name for field in fields(kind)} & options.keys()
        values = {each: options.pop(each) for each in names}
        if values:
            arguments[name] = kind(**({"scene": CollisionScene()} if name == "avoidance" else {}) | values)
    return arguments | options


def plan(rig: Rig = RIG, method: Collocation = SMOOTH, **options: Any) -> Solution:
    arguments = roll_arguments({"symbols": ca.SX, **options})
    return solve(roll_problem(rig, TUNNEL, falling, HORIZON, **arguments), method)


def test_without_weights_on_motion_the_plan_is_the_best_roll_of_each_target() -> None:
    result = plan(rate_weight=0.0, acceleration_weight=1e-9)
    inner = (result.t > 1) & (result.t < 9)
    best = np.array(optimal_inverse(RIG, TUNNEL).map(int(inner.sum()))(targets_at(result.t[inner]), 1.0)[0])[5]
    np.testing.assert_allclose(result["roll"][inner, 0], best, atol=2e-3)


def test_rate_and_acceleration_limits_hold_and_bind() -> None:
    result = plan(method=HELD, rate_limit=0.35, acceleration_limit=0.2, rate_weight=0.0)
    assert np.abs(result["rate"]).max() == pytest.approx(0.35, abs=1e-6)
    assert np.abs(result["acceleration"]).max() <= 0.2 + 1e-6
    assert result.audit().integration_error < 1e-6


def test_planning_ahead_beats_the_roll_that_looks_back() -> None:
    """The step-by-step minimum of I2 on the same targets, with the weight that makes both indices one."""
    step, weight = 0.05, 0.05
    rate_weight = weight * 2 * np.pi / step**2  # I2 dt then sums to I1 + weight rate^2
    times = np.arange(0, HORIZON + step / 2, step)
    function, rolls = optimal_inverse(RIG, TUNNEL, rate_weight=rate_weight), []
    roll = float(optimal_inverse(RIG, TUNNEL)(targets_at([0.0]), 0.0)[0][5])
    for k in range(len(times)):
        roll = float(function(targets_at(times[k : k + 1]), roll)[0][5])
        rolls.append(roll)
    index = index_by_geometry(RIG, TUNNEL, targets_at(times), np.array(rolls))
    greedy = float(np.sum(index[1:] + weight * (np.diff(rolls) / step) ** 2) * step)
    result = plan(rate_weight=weight, acceleration_weight=1e-9)
    assert result.cost < 0.95 * greedy


@pytest.mark.long
def test_the_plan_avoids_an_obstacle_by_its_free_roll() -> None:
    around = CollisionScene(solids=(Box(INCH * np.array([6.0, 4.0, 6.0]), INCH * np.array([80.0, -4.0, 0.0])),))
    free = optimal_inverse(RIG, TUNNEL).map(101)(targets_at(np.linspace(0, HORIZON, 101)), np.zeros((1, 101)))[0]
    assert least_gaps(around, free).min() < -0.02  # in its midst
    problem = roll_problem(
        RIG, TUNNEL, falling, HORIZON, settings=RollSettings(symbols=ca.SX), avoidance=Avoidance(around, 0.01)
    )
    solution = solve(problem, SMOOTH)
    assert least_gaps(around, joints_along(RIG, solution, solution.t)).min() >= 0.01 - 1e-6
    assert solution.cost <= solve(problem, SMOOTH, guess={"roll": [-1.0]}).cost * (1 + 1e-6)  # the other way round


def course(cost: Any, t: Any, **options: Any) -> Any:
    limits = options.pop("lower", -np.inf), options.pop("upper", np.inf)
    first = options.pop("first_roll", None)
    settings = RollSettings(**{"rate_weight": 1e-4, "acceleration_weight": 0.0, **options})
    return least_cost_roll(lambda k, roll: cost(t[k], roll), t, limits, first_roll=first, settings=settings)


def test_a_course_winds_as_often_as_it_pays() -> None:
    t = np.linspace(0, 1, 65)
    for turns in (-3, 2):
        rolls = course(lambda at, roll: -np.cos(roll - 2 * np.pi * turns * at), t)  # noqa: B023
        np.testing.assert_allclose(rolls[8:-8], 2 * np.pi * turns * t[8:-8], atol=0.02)  # ends are free to lag


def test_a_course_goes_through_the_gap_that_costs_least_and_starts_where_it_must() -> None:
    t = np.linspace(0, 10, 65)

    def cost(at: Any, roll: Any) -> Any:
        gap = (np.abs(roll - 1.5) < 0.3) | (np.abs(roll + 2.5) < 0.3)
        return 0.1 * roll**2 + np.where((np.abs(at - 5) < 1) & ~gap, 1e3, 0.0)

    rolls = course(cost, t, first_roll=-0.4, rate_limit=2.0, rate_weight=0.01)
    assert rolls[0] == -0.4
    assert (np.abs(rolls[np.abs(t - 5) < 1] - 1.5) < 0.3).all()
    assert np.abs(np.diff(rolls)).max() <= 2.0 * (t[1] - t[0]) + 1e-9
    held = course(cost, t, first_roll=-0.4, rate_weight=0.01, lower=-3.0, upper=1.0)
    assert (np.abs(held[np.abs(t - 5) < 1] + 2.5) < 0.3).all()
    assert course(cost, t, lower=100.0, upper=106.0).min() >= 100.0


@pytest.mark.long
def test_clearance_in_the_index_keeps_away_without_a_constraint() -> None:
    around = CollisionScene(solids=(Box(INCH * np.array([6.0, 4.0, 4.0]), INCH * np.array([80.0, -9.0, 3.0])),))

    def mean(weight: float) -> float:
        result = plan(scene=around, clearance=-np.inf, weight=weight, acceleration_weight=0.02)
        return float(least_gaps(around, joints_along(RIG, result, np.linspace(0, HORIZON, 101))).mean())

    assert mean(0.02) > mean(0.0) + 5e-3


def test_joint_limits_hold_along_the_plan() -> None:
    rig = reference_rig(lower=(-9, -3, -3, -3, -3, -9), upper=(9, 3, 3, 0.175, 3, 9))
    assert joints_along(rig, plan(rig), DENSE)[3].max() == pytest.approx(0.175, abs=1e-4)


def test_a_roll_that_a_joint_limit_forbids_is_avoided() -> None:
    """Joint 3 forbids roll pi / 2 at every target: near the best roll of each by itself there is no way across."""
    rig = reference_rig(lower=(-9, -3, -3, -3, -3, -9), upper=(9, 3, 0.3, 3, 3, 9))
    result = plan(rig)
    assert joints_along(rig, result, DENSE)[2].max() <= 0.3 + 1e-5
    assert result["roll"][-1, 0] < -3.0


def test_a_table_of_targets_is_followed_through_its_spline() -> None:
    times = np.linspace(0, HORIZON, 41)
    problem = roll_problem(RIG, TUNNEL, spline_targets(times, targets_at(times).T), HORIZON)
    table = solve(problem, Collocation(intervals=25, degree=3))
    assert table.cost == pytest.approx(plan().cost, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"targets": lambda time: [9.0, 9.0, 9.0, 0.0, 0.0]}, "no roll reaches the target at 0 s"),
        ({"start_roll": np.nan}, "start_roll nan"),
        ({"horizon": 0.0}, "horizon"),
        ({"rate_limit": -1.0}, "rate_limit"),
        ({"avoidance": 0.1}, "avoidance must be a Avoidance"),
    ],
)
def test_impossible_plans_are_refused_by_name(options: dict[str, Any], message: str) -> None:
    request = {"targets": falling, "horizon": HORIZON, "symbols": ca.SX, **options}
    with pytest.raises(ProblemError, match=message) as caught:
        roll_problem(RIG, TUNNEL, **roll_arguments(request))
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_a_table_that_is_none_is_named() -> None:
    with pytest.raises(ProblemError, match="times"):
        spline_targets([0, 1, 1, 2], np.zeros((4, 5)))
    with pytest.raises(ProblemError, match="row 1"):
        spline_targets([0, 1, 2, 3], [[0] * 5, [np.nan] * 5, [0] * 5, [0] * 5])
