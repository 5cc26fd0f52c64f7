"""Motions of constant jerk beside ruckig and closed forms: least durations, synchronised joints, stops at corners."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from ruckig import InputParameter, Result, Ruckig, Trajectory

from models import FixedBase
from models.checks import Array
from models.examples import example_robot
from ocp import Limits
from ocp.motion.builders.constant_jerk import (
    TorqueLimits,
    least_durations,
    least_squared_velocities,
    segment_durations,
    stopping_motion,
    synchronised_motion,
)  # fmt: skip
from ocp.motion.builders.dynamics import DynamicsSetup, dynamics_problem
from ocp.motion.builders.joint_motion import joint_motion_problem, motion_along
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds

INF = np.inf
QUIET = {"print_iter": False, "print_header": False}


def ruckig_duration(distance: float, velocity: float, acceleration: float, jerk: float) -> float:
    request = InputParameter(1)
    request.current_position, request.target_position = [0.0], [distance]
    request.max_velocity, request.max_acceleration, request.max_jerk = [velocity], [acceleration], [jerk]
    trajectory = Trajectory(1)
    assert Ruckig(1).calculate(request, trajectory) == Result.Working
    return float(trajectory.duration)


def arm() -> FixedBase:
    return FixedBase(example_robot("six_axis"))


@pytest.mark.parametrize("kinds", ["vaj", "va", "vj", "aj", "a", "j", "v"])
def test_least_durations_are_those_of_ruckig(kinds: str) -> None:
    random = np.random.default_rng(0)
    machine = arm()
    for _ in range(30):
        distances = 10 ** random.uniform(-3, 1, 6)
        values = {kind: 10 ** random.uniform(*span, 6) if kind in kinds else np.full(6, INF)
                  for kind, span in (("v", (-1, 1)), ("a", (-1, 2)), ("j", (0, 3)))}  # fmt: skip
        bounds = Limits(velocity=values["v"], acceleration=values["a"], jerk=values["j"]).bounds(machine)
        expected = [
            ruckig_duration(distance, *(float(values[kind][k]) if kind in kinds else 1e15 for kind in "vaj"))
            if kinds != "v" else distance / values["v"][k]
            for k, distance in enumerate(distances)
        ]  # fmt: skip
        np.testing.assert_allclose(least_durations(distances, bounds), expected, rtol=2e-6)
    assert (least_durations(np.zeros(6), bounds) == 0).all()


def double_s_duration(distance: float, velocity: float, acceleration: float, jerk: float) -> float:
    """Return the least time of a rest-to-rest motion (Biagiotti & Melchiorri 2008, section 3.4.1)."""
    if velocity * jerk >= acceleration**2:
        ramp = acceleration / jerk + velocity / acceleration
    else:
        ramp = 2 * np.sqrt(velocity / jerk)
    cruise = distance / velocity - ramp
    if cruise < 0:
        cruise = 0.0
        if distance >= 2 * acceleration**3 / jerk**2:
            build_up = acceleration / jerk
            ramp = build_up / 2 + np.sqrt((build_up / 2) ** 2 + distance / acceleration)
        else:
            ramp = 2 * np.cbrt(distance / (2 * jerk))
    return float(2 * ramp + cruise)


@pytest.mark.parametrize("kinds", ["vaj", "va"])
def test_synchronised_joints_take_the_time_of_the_slowest_one_and_are_straight_where_that_allows_it(kinds: str) -> None:
    random, straight = np.random.default_rng(4), 0
    for number in range(300):
        n = int(random.integers(1, 8))
        unlimited = np.full(n, INF)
        velocity, acceleration, jerk = (10 ** random.uniform(-1, 1.5, n) * size for size in (1.0, 3.0, 30.0))
        change = random.uniform(-3, 3, n) * (random.random(n) > 0.1)
        change[0] += 3.5
        if number % 3 == 0:  # the limits are in proportion: each joint has the profile of the others
            velocity, acceleration, jerk = (np.abs(change + 1e-9) * size[0] for size in (velocity, acceleration, jerk))
        jerk = jerk if "j" in kinds else unlimited
        bounds = JointBounds(-unlimited, unlimited, velocity, acceleration, jerk, unlimited, unlimited)
        start = random.uniform(-1, 1, n)
        motion = synchronised_motion(start, start + change, bounds)
        own = [
            double_s_duration(abs(change[k]), velocity[k], acceleration[k], min(jerk[k], 1e15)) if change[k] else 0.0
            for k in range(n)
        ]
        assert motion.duration == pytest.approx(max(own), rel=1e-6)
        joints, rates, accelerations = motion.sampled(np.linspace(0.0, 1.0, 9))
        np.testing.assert_allclose(joints[0, 0], start)
        np.testing.assert_allclose(joints[-1, -1], start + change, atol=1e-9)
        np.testing.assert_allclose(rates[[0, -1], [0, -1]], 0.0, atol=1e-9 * velocity.max())
        np.testing.assert_allclose(joints[1:, 0], joints[:-1, -1], atol=1e-12)
        np.testing.assert_allclose(rates[1:, 0], rates[:-1, -1], atol=1e-12 * velocity.max())
        if "j" in kinds:
            np.testing.assert_allclose(accelerations[1:, 0], accelerations[:-1, -1], atol=1e-9 * acceleration.max())
        for values, largest in ((rates, velocity), (accelerations, acceleration), (motion.jerks, jerk)):
            assert (np.abs(values) <= largest * (1 + 1e-9)).all()
        shares = (joints.reshape(-1, n) - start)[:, :1] / change[0]
        is_straight = np.abs(joints.reshape(-1, n) - start - shares * change).max() < 1e-9
        straight += is_straight
        assert is_straight or number % 3
    assert 100 <= straight < 250


def test_joints_that_stay_are_still_for_a_moment() -> None:
    motion = synchronised_motion(np.ones(6), np.ones(6), Limits(acceleration=1.0, jerk=1.0).bounds(arm()))
    assert 0 < motion.duration < 0.01
    np.testing.assert_array_equal(motion.sampled(np.array([0.0, 1.0]))[0], np.ones((1, 2, 6)))


@pytest.mark.parametrize("jerk", [INF, 100.0])
def test_a_straight_motion_of_equal_joints_takes_the_time_of_one(jerk: float) -> None:
    bounds = Limits(velocity=1.0, acceleration=5.0, jerk=jerk, torque=INF).bounds(arm())
    change = np.array([0.7, -0.7, 0.7, 0.7, 0.7, -0.7])
    expected = ruckig_duration(0.7, 1.0, 5.0, min(jerk, 1e12))
    assert segment_durations(change[None], bounds)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("jerk", "factor"), [(INF, 1.0), (300.0, 1.0), (300.0, 1.7)])
@pytest.mark.parametrize("torque", [60.0, INF])
def test_a_motion_through_corners_passes_as_a_solution_within_all_limits(
    jerk: float, factor: float, torque: float
) -> None:
    machine = arm()
    limits = Limits(acceleration=20.0, jerk=jerk, torque=[torque, torque, torque, 28.0, 28.0, 28.0])
    path = np.array([[0.0, 0.9, 0.5, 0.0, 0.3, 0.0], [0.5, 1.2, 0.2, 0.1, 0.0, 0.4], [0.2, 1.3, 0.4, 0.6, 0.2, 1.0]])
    bounds = limits.bounds(machine)
    motion = stopping_motion(path, bounds, TorqueLimits(machine, bounds)).slower(factor)
    control = "jerk" if np.isfinite(jerk) else "acceleration"
    problem = dynamics_problem(
        machine, (), motion.duration, start=path[0], end=path[-1], limits=limits,
        cost=Cost(velocity=1.0, effort=1e-4, time=1.0, weights=[1.0, 2.0, 3.0, 1.0, 1.0, 1.0]),
        setup=DynamicsSetup(control=control),  # type: ignore[arg-type]
    )  # fmt: skip
    audit = motion.solution(problem, "stops at corners").audit()
    assert audit.feasible, audit
    assert audit["cost, relative"].value < 1e-6
    durations = segment_durations(np.diff(path, axis=0), limits.bounds(machine))
    assert motion.duration >= factor * durations.sum() * (1 - 1e-12)
    if not np.isfinite(torque):
        assert motion.duration == pytest.approx(factor * durations.sum())


def test_a_motion_slowed_down_by_torque_limits_uses_the_torque_of_a_joint_up() -> None:
    random, machine, slowed = np.random.default_rng(6), arm(), 0
    limits = Limits(acceleration=100.0, torque=[80.0, 80.0, 80.0, 28.0, 28.0, 28.0])
    bounds = limits.bounds(machine)
    free, torques = TorqueLimits(machine, Limits(torque=INF).bounds(machine)), TorqueLimits(machine, bounds)
    for _ in range(10):
        path = random.uniform(-0.5, 0.5, (2, 6)) + np.array([0.0, 0.9, 0.5, 0.0, 0.0, 0.0])
        fastest, motion = (stopping_motion(path, bounds, each) for each in (free, torques))
        samples = (each.reshape(-1, 6) for each in motion.sampled(np.linspace(0.0, 1.0, 101)))
        used = (np.abs(torques.torques(*samples)) / torques.largest).max()
        assert used <= 1
        if motion.duration > fastest.duration * (1 + 1e-9):
            assert used > 0.99
            slowed += 1
    assert slowed >= 5


def corners(random: np.random.Generator) -> Array:
    return random.uniform(-1.0, 1.0, (5, 6))


@pytest.mark.parametrize("length", [True, False])
def test_a_motion_along_a_path_has_the_length_or_squared_rates_of_the_closed_form(length: bool) -> None:
    machine, path = arm(), corners(np.random.default_rng(1))
    path = np.insert(path, 2, path[2], axis=0)  # a corner that is there twice
    weights = np.array([1.0, 4.0, 1.0, 1.0, 0.25, 1.0])
    scale, horizon = np.sqrt(weights), 20.0
    problem = joint_motion_problem(machine, horizon, start=path[0], end=path[-1], weights=weights, length=length)
    solution = motion_along(problem, path, scale, horizon, length=length)
    total = np.linalg.norm(np.diff(path, axis=0) * scale, axis=1).sum()
    assert solution.cost == pytest.approx(total if length else total**2 / 40.0)
    audit = solution.audit()
    assert audit.feasible, audit
    assert audit["cost, relative"].value < 1e-9


def test_the_least_squared_velocity_is_that_of_a_quadratic_program_from_above() -> None:
    """Velocities at N + 1 equidistant times, within acceleration limits: the integral is a convex quadratic form."""
    count, duration = 400, 2.0
    step = duration / count
    for distance, acceleration in ((1.0, 1.2), (1.0, 2.0), (0.4, 1.2), (0.0, 1.0), (1.0, np.inf)):
        velocity = ca.SX.sym("v", count - 1)
        inner = ca.vertcat(0.0, velocity, 0.0)
        first, last = inner[:-1], inner[1:]
        integral = step / 3 * ca.sum1(first**2 + first * last + last**2)
        changes = ca.vertcat((last - first) / step, step * ca.sum1(velocity))
        solver = ca.qpsol("s", "ipqp", {"x": velocity, "f": integral, "g": changes}, QUIET)
        largest = np.append(np.full(count, acceleration), distance)
        lower = np.append(np.full(count, -acceleration), distance)
        best = float(solver(lbg=lower, ubg=largest)["f"])
        least = least_squared_velocities(np.array([distance]), duration, np.array([acceleration]))[0]
        assert least * (1 - 1e-9) - 1e-12 <= best <= least * 1.008 + 1e-9
    too_far = least_squared_velocities(np.array([1.0, 1.001]), 2.0, np.ones(2))
    np.testing.assert_allclose(too_far, [2 / 3, np.inf])
    assert least_squared_velocities(np.zeros(1), 0.0, np.ones(1))[0] == 0


@pytest.mark.parametrize("power", [5.0, 40.0])
def test_a_motion_within_power_limits_uses_them_and_braking_is_free(power: float) -> None:
    machine, start = arm(), np.array([0.0, -0.6, 1.2, 0.0, 0.9, 0.0])
    bounds = Limits(acceleration=10.0, jerk=400.0, torque=INF, power=power).bounds(machine)
    limits = TorqueLimits(machine, bounds)
    largest, braking = [], []
    for end in ([0.9, -0.4, 1.0, 0.3, 0.8, 0.5], [-0.5, 0.2, 0.4, 0.0, 0.2, 0.1], [0.0, -1.2, 1.5, 0.0, 0.9, 0.0]):
        motion = limits.slow_down(synchronised_motion(start, np.array(end), bounds))
        joints, rates, accelerations = (each.reshape(-1, 6) for each in motion.sampled(np.linspace(0.0, 1.0, 41)))
        powers = limits.torques(joints, rates, accelerations) * rates
        largest.append(powers.max())
        braking.append(powers.min())
    assert max(largest) == pytest.approx(power, rel=0.01)
    assert max(largest) <= power
    assert min(braking) < -power


def test_limited_torques_and_powers_are_linearised_in_their_order() -> None:
    machine, rng = arm(), np.random.default_rng(0)
    torque, power = [100.0, INF, 80.0, INF, 10.0, INF], [INF, INF, 50.0, 40.0, INF, INF]
    limits = TorqueLimits(machine, Limits(torque=torque, power=power).bounds(machine))
    assert limits.largest.tolist() == [100.0, 80.0, 10.0, 50.0, 40.0]
    assert limits.two_sided.tolist() == [True, True, True, False, False]
    state = rng.normal(size=(3, 1, 6))
    values, slopes = limits.linearise(*state)
    everything = TorqueLimits(machine, Limits(torque=1.0).bounds(machine)).torques(*state)[0]
    np.testing.assert_allclose(values[0], [*everything[[0, 2, 4]], *(everything * state[1, 0])[[2, 3]]])
    for order in range(3):
        for joint in range(6):
            step = np.zeros((3, 1, 6))
            step[order, 0, joint] = 1e-6
            difference = (limits.linearise(*(state + step))[0] - limits.linearise(*(state - step))[0]) / 2e-6
            np.testing.assert_allclose(slopes[order][0, :, joint], difference[0], rtol=1e-5, atol=1e-6)
