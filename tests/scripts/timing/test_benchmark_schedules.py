"""The benchmark of the schedules runs and says what it measures; how long things take is not tested."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from models import FixedBase
from ocp import joint_path
from ocp.motion.schedule import JointLimits
from scripts import benchmark
from scripts.robots.robots import PANDA
from scripts.timing import schedule_peers, schedules


def test_schedules_are_measured_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedules, "solve_minimum_time", lambda *_, guess, **__: guess)  # which takes some 10 s
    monkeypatch.setattr(schedules, "CASES", dict.fromkeys(schedules.CASES, ((20, 1.0, None),)))
    numbers = {
        "rows": [schedules.row(case, 20, 1) | {"goal_s": 1.0} for case in schedules.CASES],
        "arms": [schedules.arm_row(seed) for seed in range(2)],
        "peers": [],
        "goals": {},
    }
    for row in numbers["rows"]:
        assert row["segments"] == 20
        assert row["seconds"] > 0
        assert row["duration_s"] > 0
    for row in numbers["arms"]:
        assert row["longer"] == 0.0
        assert row["largest_demand"] <= 1.001
    assert "2 random arms" in schedules.report(numbers)
    schedules.plot(tmp_path / "schedules.png", numbers)
    with Image.open(tmp_path / "schedules.png") as picture:
        assert picture.size[0] > 500
    assert "schedules" in benchmark.PARTS


def test_the_waves_have_the_derivatives_that_they_say() -> None:
    _, joints, _ = schedules.random_arm(0)
    s, h = np.linspace(0.1, 0.5, 9), 1e-5
    before, here, after = (joints.at(s + k * h) for k in (-1, 0, 1))
    for low, high in (("position", "first"), ("first", "second"), ("second", "third")):
        slope = (getattr(after, low) - getattr(before, low)) / (2 * h)
        assert slope == pytest.approx(getattr(here, high), rel=1e-5, abs=1e-5)


def test_the_splines_of_the_peers_have_the_derivatives_that_they_state() -> None:
    joints, s, h = schedule_peers.Splines(0), np.linspace(0.1, 0.9, 9), 1e-5
    before, here, after = (joints.at(s + k * h) for k in (-1, 0, 1))
    for low, high in (("position", "first"), ("first", "second"), ("second", "third")):
        slope = (getattr(after, low) - getattr(before, low)) / (2 * h)
        assert slope == pytest.approx(getattr(here, high), rel=1e-5, abs=1e-3)


def test_the_usage_counts_torques_and_is_1_where_one_limit_determines_the_motion() -> None:
    machine, s = FixedBase(PANDA.read()), np.linspace(0.0, 1.0, 201)
    joints = joint_path(machine, (s, schedule_peers.Splines(0).at(s).position), schedule_peers.UNIT)
    torque = np.array([87.0] * 4 + [12.0] * 3)
    for limits in (JointLimits(1.0, 1e3), JointLimits(1e2, 5.0), JointLimits(1e2, 1e3, torque=torque)):
        timing = schedule_peers.plan_with_schedule(joints, limits)
        assert timing is not None
        assert schedules.usage(timing, joints, limits) == pytest.approx(1.0, abs=1e-3)
    doubled = JointLimits(1e2, 1e3, torque=2 * torque)
    assert schedules.usage(timing, joints, doubled) == pytest.approx(0.5, abs=1e-3)


def test_a_motion_of_constant_acceleration_between_points_is_that_of_its_speeds() -> None:
    grid = np.linspace(0.0, 1.0, 11)
    speed = np.sqrt(2 * 3.0 * np.minimum(grid, 1 - grid))
    timing = schedule_peers.timing_of_speeds(grid, speed)
    assert timing.duration == pytest.approx(2 * np.sqrt(1 / 3.0))  # half the way in sqrt(2 s / a)
    motion = timing.at(np.linspace(0.0, timing.duration, 1000))
    assert motion.distance[-1] == pytest.approx(1.0)
    assert motion.speed**2 == pytest.approx(6 * np.minimum(motion.distance, 1 - motion.distance), abs=1e-12)
    assert np.abs(motion.acceleration) == pytest.approx(3.0)


def test_the_rates_between_the_points_of_copp_belong_to_one_motion() -> None:
    grid = schedule_peers.graded(np.linspace(0.0, 1.0, 21))
    assert (np.diff(grid) > 0).all()
    assert grid[[0, -1]].tolist() == [0.0, 1.0]
    first, last = np.diff(grid)[[0, -1]]
    squared = np.sin(np.pi * grid) ** 2
    acceleration = np.gradient(squared, grid) / 2
    # at constant jerk from rest, the acceleration follows from the squared speed at the end of the interval
    acceleration[[0, 1, -2, -1]] = 0.0, 2 / 3 * squared[1] / first, -2 / 3 * squared[-2] / last, 0.0
    h = 1e-7
    s = np.sort(np.concatenate([grid[:-1] + share * np.diff(grid) for share in (0.3, 0.8)]))
    before, (speed, path_acceleration, jerk), after = (
        schedule_peers.rates_between(grid, squared, acceleration, s + k * h) for k in (-1, 0, 1)
    )
    assert (after[0] ** 2 - before[0] ** 2) / (4 * h) == pytest.approx(path_acceleration, rel=1e-4, abs=1e-4)
    assert speed * (after[1] - before[1]) / (2 * h) == pytest.approx(jerk, rel=1e-4, abs=1e-4)
    at = schedule_peers.rates_between(grid, squared, acceleration, grid)
    assert at[0] ** 2 == pytest.approx(squared, abs=1e-12)
    assert at[1] == pytest.approx(acceleration, abs=1e-12)
