"""Optimal motions of a ball among boxes, and of an arm within torque limits, beside bounds, ruckig and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ruckig import InputParameter, Result, Ruckig, Trajectory

from models import Box, CollisionScene, FixedBase
from models.checks import Array
from models.examples import example_robot
from ocp import Cost, Limits, SolveError
from ocp.motion.builders.constant_jerk import (
    TorqueLimits,
    least_durations,
    least_squared_velocities,
    stopping_motion,
)  # fmt: skip
from ocp.motion.sampling.joint_paths import StraightMotions
from ocp.motion.sampling.spline_motion import (
    MotionLimits,
    SplineMotionSettings,
    has_spline_cost,
    optimal_motion_near,
    square_weights,
)
from tests.ocp.motion.sampling.sliders import gap, slider

REST = np.zeros(2)
TIME = Cost(velocity=0.0, time=1.0)
BOX = Box((0.4, 1.4, 1.0), (0.0, 0.0, 0.0))
AROUND = np.array([[-1.0, 0.1], [-0.3, 0.801], [0.3, 0.801], [1.0, 0.1]])
"""Path around the box with corners near it."""


def limits_of(*boxes: Box, ends: tuple[Array, Array] = (REST, REST), **limits: Any) -> MotionLimits:
    machine = slider()
    bounds = Limits(**{"torque": np.inf, **limits}).bounds(machine)
    scene = CollisionScene(machine, boxes) if boxes else None
    return MotionLimits(StraightMotions(scene), bounds, TorqueLimits(machine, bounds), *ends)


def kept(limits: MotionLimits, motion: Any) -> Array:
    """Return dense samples of the joints after a check of all limits."""
    joints, rates, accelerations = motion.sampled(np.linspace(0.0, 1.0, 33))
    bounds = limits.bounds
    for values, largest in (
        (rates, bounds.velocity),
        (accelerations, bounds.acceleration),
        (motion.jerks, bounds.jerk),
    ):
        assert (np.abs(values) <= largest * (1 + 2e-6)).all()
    np.testing.assert_allclose(joints[1:, 0], joints[:-1, -1], atol=1e-9)
    np.testing.assert_allclose(rates[1:, 0], rates[:-1, -1], atol=1e-9)
    samples: Array = joints.reshape(-1, joints.shape[-1])
    return samples


@pytest.mark.parametrize("jerk", [np.inf, 40.0])
def test_without_obstacles_the_time_is_that_of_the_slowest_joint(jerk: float) -> None:
    random = np.random.default_rng(1)
    for _ in range(4):
        path = random.uniform(-2, 2, (2, 2))
        limits = limits_of(acceleration=[4.0, 2.0], jerk=jerk)
        least = least_durations(np.abs(path[1] - path[0]), limits.bounds).max()
        for gain, tolerance in ((SplineMotionSettings.gains[-1], 2e-3), (1e-8, 1e-6)):
            motion = optimal_motion_near(limits, path, TIME, settings=SplineMotionSettings(gains=(1e-2, gain)))
            assert motion.duration == pytest.approx(least, rel=tolerance)
        np.testing.assert_allclose(kept(limits, motion)[[0, -1]], path, atol=1e-9)


def test_the_zeros_of_the_joints_do_not_matter() -> None:
    limits = limits_of(acceleration=[4.0, 2.0], jerk=400.0)
    path, away = np.array([[-0.9, 0.4], [0.3, 0.1]]), np.array([1.2, 0.3])
    here, there = (optimal_motion_near(limits, path + offset, TIME) for offset in (0.0, away))
    np.testing.assert_allclose(there.durations, here.durations, rtol=1e-6, atol=1e-9)


def ruckig_duration(path: Array, ends: tuple[Array, Array], bounds: Any) -> float:
    request = InputParameter(2)
    request.current_position, request.target_position = path.tolist()
    request.current_velocity, request.target_velocity = (end.tolist() for end in ends)
    request.max_velocity, request.max_acceleration, request.max_jerk = (
        each.tolist() for each in (bounds.velocity, bounds.acceleration, bounds.jerk)
    )
    trajectory = Trajectory(2)
    assert Ruckig(2).calculate(request, trajectory) == Result.Working
    return float(trajectory.duration)


def test_moving_ends_are_reached_in_the_time_of_ruckig() -> None:
    random = np.random.default_rng(2)
    for _ in range(5):
        path, ends = random.uniform(-1, 1, (2, 2)), (random.uniform(-0.4, 0.4, 2), random.uniform(-0.4, 0.4, 2))
        limits = limits_of(acceleration=[4.0, 2.0], jerk=[40.0, 60.0], ends=ends)
        motion = optimal_motion_near(limits, path, TIME)
        expected = ruckig_duration(path, ends, limits.bounds)
        assert expected * (1 - 1e-5) <= motion.duration <= 1.02 * expected
        kept(limits, motion)
        _, rates, accelerations = motion.sampled(np.array([0.0, 1.0]))
        np.testing.assert_allclose(rates[[0, -1], [0, -1]], ends, atol=1e-9)
        np.testing.assert_allclose(accelerations[[0, -1], [0, -1]], 0.0, atol=1e-6)


@pytest.mark.parametrize("jerk", [np.inf, 40.0])
def test_around_a_box_it_neither_stops_nor_comes_nearer_than_the_clearance(jerk: float) -> None:
    limits = limits_of(BOX, acceleration=4.0, jerk=jerk)
    motion = optimal_motion_near(limits, AROUND, TIME)
    stopping = stopping_motion(AROUND, limits.bounds, limits.torques)
    least = least_durations(np.array([2.0, 0.0]), limits.bounds).max()
    assert least <= motion.duration < 1.01 * least < 0.85 * stopping.duration
    assert gap(kept(limits, motion), [BOX]).min() >= 0
    speeds = np.linalg.norm(motion.rates[np.abs(motion.joints[:, 0]) < 0.5], axis=1)
    assert speeds.min() > 0.5


def test_a_finer_spline_is_hardly_faster() -> None:
    limits = limits_of(BOX, acceleration=4.0, jerk=40.0)
    coarse, fine = (
        optimal_motion_near(limits, AROUND, TIME, settings=SplineMotionSettings(intervals=count)).duration
        for count in (40, 120)
    )
    assert 0.98 * coarse < fine < 1.002 * coarse


def test_torques_of_an_arm_are_at_their_limits_and_not_beyond() -> None:
    machine = FixedBase(example_robot("six_axis"))
    path = np.array([[0.0, 0.9, 0.5, 0.0, 0.3, 0.0], [0.8, 0.3, 1.1, 0.5, 0.0, 0.4]])
    bounds = Limits(velocity=3.0, acceleration=60.0, jerk=3000.0, torque=[55.0] * 3 + [28.0] * 3).bounds(machine)
    torques, rest = TorqueLimits(machine, bounds), np.zeros(6)
    limits = MotionLimits(StraightMotions(None), bounds, torques, rest, rest)
    motion = optimal_motion_near(limits, path, TIME)
    straight = torques.slow_down(stopping_motion(path, bounds, torques))
    assert motion.duration < 0.95 * straight.duration
    samples = (each.reshape(-1, 6) for each in motion.sampled(np.linspace(0.0, 1.0, 33)))
    usage = np.abs(torques.torques(*samples)) / torques.largest
    assert 0.97 < usage.max() <= 1.0
    kept(limits, motion)


def test_a_path_through_a_wall_is_refused() -> None:
    wall = Box((0.2, 5.0, 1.0), (0.0, 0.0, 0.0))
    with pytest.raises(SolveError, match="no motion within the limits") as caught:
        optimal_motion_near(limits_of(wall, acceleration=4.0, jerk=40.0), np.array([[-1.0, 0.0], [1.0, 0.0]]), TIME)
    assert caught.value.name == "limits"


def integrals(motion: Any, order: int) -> Array:
    """Integral of the squared derivative of each joint, by Simpson's rule, which is exact for it up to rounding."""
    values = (*motion.sampled(np.linspace(0.0, 1.0, 5))[1:], np.repeat(motion.jerks[:, None], 5, axis=1))[order - 1]
    weights = np.array([7, 32, 12, 32, 7]) / 90  # Boole's: exact for the fourth power
    total: Array = np.einsum("k,ksn,s->n", motion.durations, values**2, weights)
    return total


@pytest.mark.parametrize("jerk", [np.inf, 400.0])
def test_squared_velocities_within_acceleration_limits_are_those_of_the_closed_form(jerk: float) -> None:
    limits = limits_of(velocity=np.inf, acceleration=[4.0, 2.0], jerk=jerk)
    cost = Cost(weights=[1.0, 3.0])
    random = np.random.default_rng(3)
    for _ in range(3):
        path = random.uniform(-1, 1, (2, 2))
        distances, duration = np.abs(path[1] - path[0]), 2.2
        motion = optimal_motion_near(limits, path, cost, duration)
        assert motion.duration == pytest.approx(duration)
        np.testing.assert_allclose(kept(limits, motion)[[0, -1]], path, atol=1e-6)
        least = least_squared_velocities(distances, duration, limits.bounds.acceleration) @ [1.0, 3.0]
        assert least * (1 - 1e-6) <= integrals(motion, 1) @ [1.0, 3.0] <= 1.02 * least


@pytest.mark.parametrize(("order", "factor"), [(2, 12.0), (3, 720.0)])
def test_squared_accelerations_and_jerks_are_those_of_polynomials(order: int, factor: float) -> None:
    """The cubic and, with accelerations of zero at the ends, the quintic polynomial."""
    limits = limits_of(velocity=np.inf)
    cost = Cost(velocity=0.0, **{("acceleration", "jerk")[order - 2]: 1.0})
    path, duration = np.array([[-1.0, 0.2], [0.7, 0.5]]), 1.7
    motion = optimal_motion_near(limits, path, cost, duration)
    least = factor * (np.diff(path, axis=0)[0] ** 2).sum() / duration ** (2 * order - 1)
    assert least * (1 - 1e-6) <= integrals(motion, order).sum() <= 1.02 * least


def test_in_free_time_the_duration_balances_its_own_weight_against_velocities() -> None:
    limits, weight = limits_of(velocity=np.inf, acceleration=20.0), 2.0
    cost = Cost(velocity=1.0, time=weight)
    path = np.array([[-1.0, 0.0], [0.5, 0.0]])
    motion = optimal_motion_near(limits, path, cost)
    times = np.linspace(0.6, 3.0, 2401)
    totals = [weight * t + least_squared_velocities(np.array([1.5]), t, np.array([20.0]))[0] / 2 for t in times]
    total = weight * motion.duration + integrals(motion, 1).sum() / 2
    assert min(totals) * (1 - 1e-6) <= total <= 1.01 * min(totals)
    assert motion.duration == pytest.approx(times[np.argmin(totals)], rel=0.05)


@pytest.mark.parametrize("jerk", [np.inf, 40.0])
def test_around_a_box_squared_velocities_are_less_than_with_stops(jerk: float) -> None:
    limits, cost = limits_of(BOX, velocity=np.inf, acceleration=4.0, jerk=jerk), Cost()
    stopping = stopping_motion(AROUND, limits.bounds, limits.torques)
    motion = optimal_motion_near(limits, AROUND, cost, 2 * stopping.duration)
    length = float(np.linalg.norm(np.diff(AROUND, axis=0), axis=1).sum())
    total = integrals(motion, 1).sum()
    assert total < 0.8 * integrals(stopping.slower(2.0), 1).sum()
    assert total >= 0.97 * length**2 / motion.duration  # the path is nearly the shortest one around the box
    assert gap(kept(limits, motion), [BOX]).min() >= 0


def test_a_horizon_that_is_too_short_is_refused() -> None:
    cost = Cost()
    path = np.array([[-1.0, 0.0], [1.0, 0.0]])
    for horizon in (1.0, 1.4):  # 2 sqrt(2 / 4) s are needed
        with pytest.raises(SolveError, match="no motion within the limits"):
            optimal_motion_near(limits_of(velocity=np.inf, acceleration=4.0), path, cost, horizon)
    optimal_motion_near(limits_of(velocity=np.inf, acceleration=4.0), path, cost, 1.5)


def test_other_terms_have_no_spline_cost() -> None:
    assert not has_spline_cost(Cost(effort=1.0))
    assert not has_spline_cost(Cost(velocity=0.0, length=1.0))
    cost = Cost(velocity=2.0, time=3.0, acceleration=[1.0, 4.0], jerk=5.0, weights=[1.0, 0.5])
    assert has_spline_cost(cost)
    np.testing.assert_allclose(square_weights(cost, 2), [[1.0, 0.5], [1.0, 4.0], [5.0, 5.0]])


def test_powers_of_an_arm_are_at_their_limits_and_not_beyond() -> None:
    machine, power = FixedBase(example_robot("six_axis")), 20.0
    path = np.array([[0.0, -0.6, 1.2, 0.0, 0.9, 0.0], [0.9, -0.4, 1.0, 0.3, 0.8, 0.5]])
    bounds = Limits(acceleration=30.0, jerk=1000.0, power=power).bounds(machine)
    torques, rest = TorqueLimits(machine, bounds), np.zeros(6)
    motion = optimal_motion_near(MotionLimits(StraightMotions(None), bounds, torques, rest, rest), path, TIME)
    straight = torques.slow_down(stopping_motion(path, bounds, torques))
    assert motion.duration < 0.97 * straight.duration
    joints, rates, accelerations = (each.reshape(-1, 6) for each in motion.sampled(np.linspace(0.0, 1.0, 33)))
    powers = torques.torques(joints, rates, accelerations) * rates
    assert 0.97 * power < powers.max() <= power
