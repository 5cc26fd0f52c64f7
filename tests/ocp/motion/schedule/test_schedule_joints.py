"""Joint limits in schedules, through the inverse kinematics of random arms, and the exchange of trajectories."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path as File
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from models import Arc, Line, Path, Scara, scara_along, smooth
from models.machines.scara import ScaraPath
from ocp import ProblemError
from ocp.motion.schedule import (
    JointLimits,
    JointTrajectory,
    LineLimits,
    Schedule,
    joint_motion,
    joint_trajectory,
    schedule,
)
from ocp.motion.schedule.grid import make_grid
from ocp.motion.schedule.limits import limit_names, limit_rows
from tests.models.paths.task_paths import random_arm_path, seeds
from tests.models.paths.test_paths import example
from tests.ocp.motion.schedule.check import largest

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
ARM = Scara(0.4, 0.4)
SLOW = JointLimits([3.0, 3.0, 1.0, 6.0], [15.0, 15.0, 5.0, 30.0], [300.0, 300.0, 200.0, 800.0])
FREE = LineLimits(1.0, 5.0, 200.0)


def example_arm(kind: str = "quintic") -> ScaraPath:
    return scara_along(ARM, example(kind), "right")


@pytest.mark.long
@settings(max_examples=12)
@given(seeds, st.booleans(), st.booleans())
def test_random_arms_keep_all_limits_between_samples(seed: int, jerks: bool, centripetal: bool) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm_path(rng)
    assume(arm is not None)
    assert arm is not None
    jerk = 10 ** rng.uniform(2, 3.5, 4) if jerks else np.inf
    joints = JointLimits(10 ** rng.uniform(-0.3, 1, 4), 10 ** rng.uniform(0.5, 1.7, 4), jerk)
    bend = 10 ** rng.uniform(-1, 1.5) if centripetal else np.inf
    speed = 10 ** rng.uniform(-1, 0.5)
    limits = LineLimits(speed, 10 ** rng.uniform(0, 1.3), 10 ** rng.uniform(1, 3), bend, joints)
    plan = schedule(arm.path, limits, joints=arm)
    assert (largest(plan, arm) <= 1.001).all()
    motion = plan.at(np.linspace(0, plan.duration, 20001))
    assert motion.speed.max() <= speed * (1 + 1e-9)
    assert (motion.speed**2 * arm.path.curvature(motion.distance)).max() <= bend * 1.001
    # the free schedule, slowed as a whole until it keeps the joint limits, is the least that may be expected
    free = schedule(arm.path, replace(plan.limits, joints=None))
    ratios = largest(Schedule(arm.path, plan.limits, free.profile, ()), arm)
    assert plan.duration <= 1.1 * free.duration * max(1.0, ratios[0], ratios[1] ** 0.5, ratios[2] ** (1 / 3))
    # continuous acceleration: what is left after a step of eps shrinks with eps
    t = plan.profile.t[1:-1]
    jumps = [joint_motion(arm, plan.at(t + sign * 1e-8 * plan.duration))[2] for sign in (-1, 1)]
    scale = np.abs(joint_motion(arm, motion)[3]).max()
    assert np.abs(jumps[1] - jumps[0]).max() <= 4e-8 * plan.duration * scale + 1e-7 * (1 + np.abs(jumps[0]).max())


def test_joint_motion_has_the_derivatives_of_the_joints_by_time() -> None:
    arm = example_arm()
    plan = schedule(arm.path, replace(FREE, joints=SLOW), joints=arm)
    steps = np.concatenate([plan.profile.t, plan.time_at(arm.path.bounds)])
    t = np.linspace(0.01, plan.duration - 0.01, 400)
    t = t[np.abs(t[:, None] - steps).min(axis=1) > 1e-4]
    h = 1e-5
    before, here, after = (joint_motion(arm, plan.at(t + k * h)) for k in (-1, 0, 1))
    for order in range(3):
        scale = np.abs(here[order + 1]).max()
        assert (after[order] - before[order]) / (2 * h) == pytest.approx(here[order + 1], abs=1e-4 * scale)


@pytest.mark.parametrize(
    ("limits", "kind"),
    [
        (JointLimits([1.0, 9.0, 9.0, 9.0]), "'shoulder' velocity"),
        (JointLimits(acceleration=[99.0, 4.0, 99.0, 99.0]), "'elbow' acceleration"),
        (JointLimits(jerk=[1e6, 1e6, 1e6, 60.0]), "'wrist' jerk"),
    ],
)
def test_a_joint_limit_slows_and_is_named_as_the_cause(limits: JointLimits, kind: str) -> None:
    arm = example_arm()
    free = schedule(arm.path, FREE)
    request = replace(FREE, joints=limits)
    plan = schedule(arm.path, request, joints=arm)
    assert plan.duration > free.duration
    used = largest(plan, arm).max()
    assert 0.9 < used <= 1.001  # no slower than need be
    assert any(kind in dip.cause for dip in plan.dips)
    with pytest.raises(ProblemError, match="violates limits"):
        schedule(arm.path, request, joints=arm, strict=True)


def test_the_curvature_of_the_joints_counts_at_a_steady_speed_too() -> None:
    """q'' v^2 alone, where the line acceleration is zero."""
    arm = example_arm()
    plan = schedule(arm.path, FREE, joints=arm)
    s = np.linspace(0.3, 1.3, 2001) * arm.path.length / 1.7
    steady = np.abs(arm.at(s).second).max(axis=0)
    limits = JointLimits(acceleration=0.5 * steady)
    slowed = schedule(arm.path, replace(FREE, joints=limits), joints=arm)
    assert slowed.duration > plan.duration
    assert largest(slowed, arm)[1] <= 1.001


def test_limits_that_do_not_bind_change_nothing() -> None:
    arm = example_arm()
    loose = schedule(arm.path, LineLimits(1.0, 5.0, 200.0, 1e3, JointLimits(1e3, 1e4, 1e6)), joints=arm, strict=True)
    assert loose.duration == schedule(arm.path, FREE).duration


def test_infeasible_schedules_are_named_errors() -> None:
    arm = example_arm()
    limits = replace(FREE, joints=SLOW)
    with pytest.raises(ProblemError, match="joint limits need the joints"):
        schedule(arm.path, limits)
    with pytest.raises(ProblemError, match="the arm has 4 joints"):
        schedule(arm.path, replace(FREE, joints=JointLimits([1.0, 2.0])), joints=arm)
    perturbed = Path((Line((0.3, 0, 0), (0.5, 0, 0)), Arc.through((0.5, 0, 0), (0.5, 0.2, 0), (0.3, 0.4, 0))))
    cubic = scara_along(ARM, smooth(perturbed, 0.05, kind="cubic"))
    with pytest.raises(ProblemError, match=r"curvature jumps.*quintic"):
        schedule(cubic.path, limits, joints=cubic)


def test_limits_hold_on_both_sides_of_a_curvature_jump() -> None:
    perturbed = Path((Arc.through((0.3, 0.4, 0), (0.5, 0.2, 0), (0.5, 0, 0)), Line((0.5, 0, 0), (0.5, -0.4, 0))))
    arm = scara_along(ARM, smooth(perturbed, 0.02, kind="cubic"))
    limits = LineLimits(9.0, 5.0, 200.0, 2.0, JointLimits(2.0))
    grid, bounds = make_grid(arm.path, limits, arm), arm.path.bounds[1:-1]
    assert grid.distance[grid.jumps] == pytest.approx(bounds, abs=1e-15)
    left, right = grid.ends(0, len(grid.requested))
    step = 1e-10 * arm.path.length
    for rows, sides in ((left.take(grid.jumps), bounds + step), (right.take(grid.jumps - 1), bounds - step)):
        expected = limit_rows(arm.path, limits, arm, sides)
        for kind, value in zip(rows, expected, strict=True):
            assert kind == pytest.approx(value, rel=1e-5, abs=1e-6)
    assert (np.abs(left.take(grid.jumps).speed - right.take(grid.jumps - 1).speed).max(axis=0) > 0.01).any()
    plan = schedule(arm.path, limits, joints=arm)
    assert largest(plan, arm).max() <= 1.001
    assert {dip.cause for dip in plan.dips} <= set(limit_names(limits, arm))


class BrokenJoints:
    """Two joints that turn evenly, but for one wrong thing."""

    names = ("a", "b")

    def __init__(self, kind: str, value: Any) -> None:
        self.kind, self.value = kind, value

    def at(self, distance: Any) -> Any:
        rates = {kind: np.full((len(distance), 2), 0.1) for kind in ("position", "first", "second", "third")}
        if np.isscalar(self.value):
            rates[self.kind][distance > 0.5, 1] = self.value
        else:
            rates[self.kind] = self.value
        return SimpleNamespace(**rates)


@pytest.mark.parametrize("kind", ["position", "first", "second", "third"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, "joint 'b' is nan, not finite, at 0.5"),
        (-np.inf, "joint 'b' is -inf, not finite, at 0.5"),
        (np.zeros(3), "shape"),
        ([["x", "y"]], "not numeric"),
    ],
)
def test_joints_that_are_no_numbers_are_a_named_error(kind: str, value: Any, message: str) -> None:
    path, joints = example("quintic"), BrokenJoints(kind, value)
    plan = schedule(path, FREE)
    limited = replace(FREE, joints=JointLimits(1.0))
    for call in (lambda: schedule(path, limited, joints=joints), lambda: joint_trajectory(plan, joints, 1e-3)):
        with pytest.raises(ProblemError, match=message) as caught:
            call()
        assert caught.value.name == ("b" if "'b'" in message else kind)


@pytest.mark.parametrize(
    ("joints", "cause"),
    [
        (JointLimits(jerk=[1e6, 1e6, 1e6, 300.0]), "joint 'wrist' jerk"),
        (JointLimits(acceleration=[99.0, 99.0, 99.0, 12.0]), "joint 'wrist' acceleration"),
    ],
)
def test_ramps_are_gentler_only_where_a_joint_binds(joints: JointLimits, cause: str) -> None:
    """The wrist makes up for a fast shoulder at the start: the rest is as without joint limits."""
    end = [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]
    lines = (Line((0.5, -0.4, 0), (0.5, 0.4, 0)), Line((0.5, 0.4, 0), (0.1, 0.4, 0), None, end))
    arm = scara_along(ARM, smooth(Path(lines), 0.05))
    limits = LineLimits(0.5, 5.0, 200.0)
    free, plan = schedule(arm.path, limits), schedule(arm.path, replace(limits, joints=joints), joints=arm)
    assert [dip.cause for dip in plan.dips] == [cause]
    assert plan.dips[0].start < 1e-3
    assert plan.dips[0].end < 0.1
    assert min(plan.dips[0].jerk / 200, plan.dips[0].acceleration / 5) < 0.99
    assert "is active on a ramp" in str(plan.dips[0])
    assert 0.9 < largest(plan, arm).max() <= 1.001
    before_end = np.linspace(0, plan.duration - plan.time_at(0.1)[0], 1000)
    mine, other = plan.at(plan.duration - before_end), free.at(free.duration - before_end)
    for kind in ("distance", "speed", "acceleration"):
        assert getattr(mine, kind) == pytest.approx(getattr(other, kind), abs=1e-9)


@pytest.fixture(scope="module")
def sampled() -> JointTrajectory:
    arm = example_arm()
    return joint_trajectory(schedule(arm.path, replace(FREE, joints=SLOW), joints=arm), arm, 1e-3)


def equal(first: JointTrajectory, second: JointTrajectory) -> bool:
    names = ("t", "positions", "velocities", "accelerations")
    same = [np.array_equal(getattr(first, name), getattr(second, name)) for name in names]
    return first.names == second.names and all(same)


def test_a_trajectory_starts_and_ends_at_rest(sampled: JointTrajectory) -> None:
    assert np.abs(sampled.velocities[[0, -1]]).max() == 0
    assert np.abs(sampled.accelerations[[0, -1]]).max() < 1e-9
    assert np.diff(sampled.t)[:-1] == pytest.approx(1e-3, abs=2e-9)


def test_a_trajectory_is_as_long_as_its_schedule_to_a_nanosecond(sampled: JointTrajectory) -> None:
    arm = example_arm()
    plan = schedule(arm.path, replace(FREE, joints=SLOW), joints=arm)
    assert 0 <= sampled.t[-1] - plan.duration < 1.001e-9
    assert np.abs(sampled.t * 1e9 - np.round(sampled.t * 1e9)).max() < 1e-3
    expected, *_ = joint_motion(arm, plan.at(np.minimum(sampled.t, plan.duration)))
    np.testing.assert_allclose(sampled.positions, expected, atol=1e-14)


def test_csv_and_message_give_back_every_bit(sampled: JointTrajectory, tmp_path: File) -> None:
    file = tmp_path / "trajectory.csv"
    sampled.write_csv(file)
    assert equal(JointTrajectory.read_csv(file), sampled)
    message = json.loads(json.dumps(sampled.to_ros()))  # plain numbers, lists and text only
    assert equal(JointTrajectory.from_ros(message), sampled)
    assert JointTrajectory.from_ros(message).to_ros() == message
    point = message["points"][-1]
    assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
    stamp = point["time_from_start"]
    assert isinstance(stamp["sec"], int)
    assert 0 <= stamp["nanosec"] < 10**9
    assert stamp["sec"] + stamp["nanosec"] / 1e9 == pytest.approx(sampled.t[-1], abs=1e-9)


@given(seeds, st.integers(1, 6), st.integers(1, 30))
def test_any_trajectory_comes_back_from_csv_and_message(seed: int, joints: int, samples: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.integers(1, 10**10, samples)) / 1e9
    values = rng.normal(size=(3, samples, joints)) * 10 ** rng.uniform(-300, 300, (3, samples, joints))
    result = JointTrajectory(tuple(f'joint, "{i}"\n' for i in range(joints)), t, *values)
    assert equal(JointTrajectory.from_ros(json.loads(json.dumps(result.to_ros()))), result)


def test_names_with_commas_come_back_from_csv(tmp_path: File) -> None:
    result = JointTrajectory(
        ('a, "b"', "c.positions"), np.array([0.0, 1 / 3]), *np.random.default_rng(1).normal(size=(3, 2, 2))
    )
    result.write_csv(tmp_path / "t.csv")
    assert equal(JointTrajectory.read_csv(tmp_path / "t.csv"), result)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"names": ("a", "a")}, "distinct"),
        ({"t": np.array([0.0, 0.0])}, "increasing"),
        ({"t": np.array([0.0, np.nan])}, "finite"),
        ({"positions": np.zeros((2, 2))}, "shape"),
        ({"velocities": np.full((2, 1), np.nan)}, "not finite"),
        ({"t": np.array([0.0, 1e-10])}, "same nanosecond"),  # which numbers may be, but no message
    ],
)
def test_a_trajectory_that_is_none_is_a_named_error(wrong: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {kind: np.zeros((2, 1)) for kind in ("positions", "velocities", "accelerations")}
    good |= {"names": ("a",), "t": np.array([0.0, 1.0])}
    JointTrajectory(**good).to_ros()
    with pytest.raises(ProblemError, match=message) as caught:
        JointTrajectory(**{**good, **wrong}).to_ros()
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_a_file_or_message_that_is_no_trajectory_is_a_named_error(sampled: JointTrajectory, tmp_path: File) -> None:
    broken = copy.deepcopy(sampled.to_ros())
    del broken["points"][3]["velocities"]
    with pytest.raises(ProblemError, match="velocities"):
        JointTrajectory.from_ros(broken)
    file = tmp_path / "t.csv"
    sampled.write_csv(file)
    for text, message in (("a,b\n1,2\n", "head"), ("", "head"), (file.read_text() + "1,2\n", "not complete")):
        file.write_text(text)
        with pytest.raises(ProblemError, match=message):
            JointTrajectory.read_csv(file)
