"""Joint limits in schedules, through the inverse kinematics of random arms, and the exchange of trajectories."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as File
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import Arc, Line, Path, Scara, SmoothPath, scara_along, smooth
from models.machines.scara_path import ScaraPath
from ocp import ProblemError
from ocp.schedule import (
    JointLimits,
    JointTrajectory,
    LineLimits,
    Schedule,
    SpeedProfile,
    joint_motion,
    joint_trajectory,
    ramp_distance,
    ramp_time,
    schedule,
)
from ocp.schedule.grid import Grid, make_grid
from ocp.schedule.joints import Attempt, Broken, broken_ramps, ease_ramps, relax_ramps, slow_down
from ocp.schedule.limits import cause_names, line_demands
from ocp.schedule.ramps import plan as planned
from tests.models.paths.task_paths import random_arm_path, seeds
from tests.models.paths.test_paths import example
from tests.ocp.problems import Array

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
ARM = Scara(0.4, 0.4)
SLOW = JointLimits([3.0, 3.0, 1.0, 6.0], [15.0, 15.0, 5.0, 30.0], [300.0, 300.0, 200.0, 800.0])
FREE = LineLimits(1.0, 5.0, 200.0)


def example_arm(kind: str = "quintic") -> ScaraPath:
    return scara_along(ARM, example(kind), "right")


def largest(plan: Schedule, arm: ScaraPath, times: int = 20001) -> NDArray[np.float64]:
    """Joint velocity, acceleration and jerk over their limits, about the profile's steps as well."""
    steps = np.clip(np.repeat(plan.profile.t, 2) + np.tile([-1e-9, 1e-9], len(plan.profile.t)), 0, plan.duration)
    motion = plan.at(np.sort(np.concatenate([np.linspace(0, plan.duration, times), steps])))
    rates = joint_motion(arm, motion)[1:]
    return np.array([np.abs(v / b).max() for v, b in zip(rates, plan.limits.of_joints(4), strict=True)])


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
    asked = replace(FREE, joints=limits)
    plan = schedule(arm.path, asked, joints=arm)
    assert plan.duration > free.duration
    used = largest(plan, arm).max()
    assert 0.9 < used <= 1.001  # no slower than need be
    assert any(kind in dip.cause for dip in plan.dips)
    with pytest.raises(ProblemError, match="breaks limits"):
        schedule(arm.path, asked, joints=arm, strict=True)


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


def test_what_cannot_be_scheduled_is_a_named_error() -> None:
    arm = example_arm()
    limits = replace(FREE, joints=SLOW)
    with pytest.raises(ProblemError, match="joint limits need the joints"):
        schedule(arm.path, limits)
    with pytest.raises(ProblemError, match="the arm has 4 joints"):
        schedule(arm.path, replace(FREE, joints=JointLimits([1.0, 2.0])), joints=arm)
    bent = Path((Line((0.3, 0, 0), (0.5, 0, 0)), Arc.through((0.5, 0, 0), (0.5, 0.2, 0), (0.3, 0.4, 0))))
    cubic = scara_along(ARM, smooth(bent, 0.05, kind="cubic"))
    with pytest.raises(ProblemError, match=r"curvature jumps.*quintic"):
        schedule(cubic.path, limits, joints=cubic)


def test_where_the_curvature_jumps_the_slower_side_is_permitted_and_names_the_cause() -> None:
    bent = Path((Arc.through((0.3, 0.4, 0), (0.5, 0.2, 0), (0.5, 0, 0)), Line((0.5, 0, 0), (0.5, -0.4, 0))))
    arm = scara_along(ARM, smooth(bent, 0.02, kind="cubic"))
    limits = LineLimits(9.0, 5.0, 200.0, 2.0, JointLimits(2.0))

    def steady(distance: NDArray[np.float64]) -> tuple[Any, Any]:
        demand, power = line_demands(limits, arm.path.curvature(distance), arm.at(distance))
        speeds = (1 / np.maximum(demand, 1e-99)) ** (1 / power[:, None])
        return speeds.min(axis=0), speeds.argmin(axis=0)

    grid, bounds = make_grid(arm.path, limits, arm), arm.path.bounds[1:-1]
    at = np.searchsorted(grid.distance, bounds)
    (before, why), (after, because) = steady(grid.before), steady(bounds)
    assert (before < 0.99 * after)[why != because].any()
    assert grid.permitted[at] == pytest.approx(np.minimum(before, after), rel=1e-3)
    assert (grid.cause[at] == np.where(before < after, why, because)).all()
    inside = np.setdiff1d(np.arange(len(grid.distance)), at)
    assert (grid.cause[inside] == steady(grid.distance[inside])[1]).all()
    assert len(np.unique(grid.cause)) > 1


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
    assert plan.dips[0].start == 0
    assert plan.dips[0].end < 0.1
    assert min(plan.dips[0].jerk / 200, plan.dips[0].acceleration / 5) < 0.99
    assert "binds on a ramp" in str(plan.dips[0])
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
    made = JointTrajectory(tuple(f'joint, "{i}"\n' for i in range(joints)), t, *values)
    assert equal(JointTrajectory.from_ros(json.loads(json.dumps(made.to_ros()))), made)


def test_names_with_commas_come_back_from_csv(tmp_path: File) -> None:
    made = JointTrajectory(
        ('a, "b"', "c.positions"), np.array([0.0, 1 / 3]), *np.random.default_rng(1).normal(size=(3, 2, 2))
    )
    made.write_csv(tmp_path / "t.csv")
    assert equal(JointTrajectory.read_csv(tmp_path / "t.csv"), made)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"names": ("a", "a")}, "differ"),
        ({"t": np.array([0.0, 0.0])}, "increasing"),
        ({"t": np.array([0.0, np.nan])}, "finite"),
        ({"positions": np.zeros((2, 2))}, "shape"),
        ({"velocities": np.full((2, 1), np.nan)}, "not all finite"),
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


# ---- ramps made gentler, and given back ----------------------------------------------------------------------------

Curve = Callable[[int, Array], Array]
"""(n, distances) -> n-th derivative of a joint by the distance."""
LENGTH, LINE = 2.0, LineLimits(1.0, 5.0, 200.0)


class Drawn:
    """Joints that are given functions of the distance."""

    def __init__(self, **curves: Curve) -> None:
        self.names, self.curves, self.asked = tuple(curves), tuple(curves.values()), 0

    def at(self, distance: Any) -> Any:
        s = np.asarray(distance, dtype=float)
        self.asked += s.size
        kinds = ("position", "first", "second", "third")
        return SimpleNamespace(
            **{kind: np.stack([curve(n, s) for curve in self.curves], axis=1) for n, kind in enumerate(kinds)}
        )


def power(order: int, size: float = 1.0) -> Curve:
    """The derivative of this order is `size` all along, those below it vanish at the start."""
    curve = np.polynomial.Polynomial([0.0] * order + [size / math.factorial(order)])
    return lambda n, s: np.asarray(curve.deriv(n)(s) if n else curve(s))


def fading(size: float, reach: float, origin: float = 0.0) -> Curve:
    """The first derivative is `size` at the origin and fades with the distance from it, over a reach of either sign."""
    return lambda n, s: size * -reach * (-1 / reach) ** n * np.exp((origin - s) / reach)


def wave(size: float, rate: float, phase: float) -> Curve:
    return lambda n, s: size * rate**n * np.sin(rate * s + phase + n * np.pi / 2)


def straight(length: float = LENGTH) -> SmoothPath:
    return smooth(Path.through([(0, 0, 0), (length, 0, 0)]), 0.1)


def uneased(grid: Grid, limits: LineLimits, gentler: float = 1.0) -> Attempt:
    """What is asked, with ramps that know nothing of the joints."""
    ones = np.ones(len(grid.asked))
    acceleration, jerk = limits.acceleration / gentler**2 * ones, limits.jerk / gentler**3 * ones
    return Attempt(grid, grid.asked.copy(), acceleration, jerk, np.full(len(ones), -1, dtype=np.intp))


def again(state: Attempt) -> SpeedProfile:
    """The plan for the state's limits."""
    state.profile = planned(state.zones(), state.memory)
    while slow_down(state):
        state.profile = planned(state.zones(), state.memory)
    return state.profile


def attempt(limits: LineLimits, joints: Drawn, gentler: float = 1.0, length: float = LENGTH) -> Attempt:
    """The plan along a straight line whose ramps know nothing of the joints."""
    state = uneased(make_grid(straight(length), limits, joints), limits, gentler)
    again(state)
    return state


def demand(profile: SpeedProfile, limits: LineLimits, joints: Drawn, per_phase: int = 400) -> Array:
    """Largest demand of joint acceleration and jerk over the limit in each phase. Shape (K,)."""
    inside = np.linspace(1e-9, 1 - 1e-9, per_phase)
    motion = profile.at((profile.t[:-1, None] + np.diff(profile.t)[:, None] * inside).ravel())
    rates = joints.at(motion.distance)
    v, a, j = (value[:, None] for value in motion[2:])
    _, most, jerks = limits.of_joints(len(joints.names))
    second = np.abs(rates.second * v**2 + rates.first * a) / most
    third = np.abs(rates.third * v**3 + 3 * rates.second * v * a + rates.first * j) / jerks
    return np.asarray(np.maximum(second, third).max(axis=1).reshape(-1, per_phase).max(axis=1))


def bounded(number: int = 1, line: LineLimits = LINE, /, **kinds: Any) -> LineLimits:
    return replace(line, joints=JointLimits(**{kind: np.broadcast_to(v, number) for kind, v in kinds.items()}))


def hand_made(line: LineLimits, cuts: Array) -> Attempt:
    """The plan along a line whose grid is what is given: nothing is permitted or forbidden there."""
    at = np.zeros(len(cuts), dtype=np.intp)
    state = uneased(
        Grid(cuts, np.full(len(cuts), np.inf), at, np.full(len(cuts) - 1, line.speed), cuts[1:-1] - 1e-9), line
    )
    again(state)
    return state


def causes(state: Attempt, joints: Drawn, where: Any = slice(None)) -> set[str]:
    """What is named for ramps made gentler."""
    names = (*cause_names(joints.names), "nothing")
    return {names[i] for i in state.ramp_cause[where]}


def on_ramps(profile: SpeedProfile) -> Array:
    return np.where((profile.jerk == 0) & (profile.acceleration[:-1] == 0), 0.0, 1.0)


@settings(max_examples=60)
@given(seeds, st.sampled_from(["acceleration", "jerk"]))
def test_a_demand_a_hair_over_its_limit_is_found_wherever_in_a_ramp_it_is(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    line = LineLimits(10 ** rng.uniform(-0.3, 0.3), 10 ** rng.uniform(0.3, 1), 10 ** rng.uniform(1.5, 2.5))
    joints = Drawn(**{name: wave(1.0, 10 ** rng.uniform(0, 1.3), rng.uniform(0, 6.28)) for name in "ab"})
    cuts = np.concatenate([[0.0], np.sort(rng.uniform(0.1, LENGTH - 0.1, 2)), [LENGTH]])
    state = hand_made(line, cuts)
    whole = demand(state.profile, bounded(2, line, **{kind: 1.0}), joints) * on_ramps(state.profile)
    kept, missed = (bounded(2, line, **{kind: whole.max() / share}) for share in (0.998, 1.002))
    joints.asked = 0
    assert broken_ramps(state, kept, joints) is None
    assert joints.asked > 0
    joints.asked = 0
    assert broken_ramps(state, kept, joints) is None
    assert joints.asked == 0  # what keeps the limits is known by then
    state = hand_made(line, cuts)
    for _ in range(2):  # and what breaks them stays so
        broken = broken_ramps(state, missed, joints)
        assert broken is not None
        assert set(broken.phase) >= set(np.flatnonzero(1.002 * whole > 1.001 * whole.max()))
        assert set(broken.phase) <= set(np.flatnonzero(1.002 * whole > 0.9999 * whole.max()))
        assert 1 < broken.demand.max() <= 1.0021


@pytest.mark.parametrize("kind", ["acceleration", "jerk"])
def test_a_joint_limit_that_is_just_the_line_s_own_changes_nothing(kind: str) -> None:
    state, joints = attempt(LINE, Drawn(a=power(1))), Drawn(a=power(1))
    limits = bounded(1, **{kind: getattr(LINE, kind)})
    assert broken_ramps(state, limits, joints) is None
    before = joints.asked
    assert before > 0
    assert not ease_ramps(state, limits, joints)
    assert joints.asked == before
    assert (state.acceleration == LINE.acceleration).all()


def eased(limits: LineLimits, joints: Drawn, state: Attempt) -> Broken:
    """What the state is eased for, in one round."""
    broken = broken_ramps(state, limits, joints)
    assert broken is not None
    assert ease_ramps(state, limits, joints)
    return broken


@pytest.mark.parametrize("share", [0.5, 0.8])
@pytest.mark.parametrize("kinds", [("acceleration",), ("jerk",), ("acceleration", "jerk")], ids=" ".join)
def test_one_round_gives_an_even_joint_just_what_it_needs_along_the_gentler_ramps(
    kinds: tuple[str, ...], share: float
) -> None:
    """A joint that moves with the line: its limits are limits of the line, at both ramps, and nowhere else."""
    limits, joints = bounded(1, **{kind: share * getattr(LINE, kind) for kind in kinds}), Drawn(a=power(1))
    state = attempt(limits, joints)
    profile = state.profile
    broken = eased(limits, joints, state)
    assert broken.ramp.tolist() == [0, 0, 0, 1, 2, 2, 2]
    binding = np.abs(profile.jerk) > 0 if kinds == ("jerk",) else on_ramps(profile) > 0
    assert np.unique(broken.phase).tolist() == np.flatnonzero(binding).tolist()
    assert broken.demand.max() == pytest.approx(1 / share)
    assert (broken.steady == 0).all()
    gentle = state.acceleration < LINE.acceleration
    assert state.acceleration[gentle] == pytest.approx(0.99 * share * LINE.acceleration)
    assert (state.acceleration[~gentle] == LINE.acceleration).all()
    assert state.jerk == pytest.approx(np.where(gentle, 0.99 * share, 1.0) * LINE.jerk)
    assert (state.speed == 1.0).all()
    s = state.grid.distance
    old = ramp_distance(0, 1, LINE.acceleration, LINE.jerk)
    new = ramp_distance(0, 1, 0.99 * share * LINE.acceleration, 0.99 * share * LINE.jerk)
    from_end = np.minimum(s[:-1], LENGTH - s[1:])
    assert gentle[from_end < new].all()
    assert not gentle[from_end > old / (0.99 * share)].any()
    after = again(state)
    assert demand(after, limits, joints).max() == pytest.approx(0.99, abs=1e-6)
    assert after.speed.max() == 1.0


@pytest.mark.parametrize("at_start", [True, False])
def test_only_the_ramp_that_breaks_a_limit_is_eased_and_the_joint_named(at_start: bool) -> None:
    curve = fading(1.0, 0.5) if at_start else fading(1.0, -0.5, LENGTH)
    joints = Drawn(idle=power(1, 1e-3), busy=curve)
    limits = bounded(2, acceleration=0.8 * LINE.acceleration)
    state = attempt(limits, joints)
    early = state.interval(0.05 if at_start else LENGTH - 0.05)
    state.acceleration[early], state.ramp_cause[early] = 0.1, 7  # for another reason, and more than enough
    broken = eased(limits, joints, state)
    assert set(broken.ramp[broken.phase]) == {0 if at_start else 2}
    mine = state.grid.distance[:-1] < LENGTH / 2
    mine = mine if at_start else ~mine
    assert (state.acceleration[~mine] == LINE.acceleration).all()
    assert (state.jerk[~mine] == LINE.jerk).all()
    assert (state.ramp_cause[~mine] == -1).all()
    assert (state.acceleration[early], state.ramp_cause[early]) == (0.1, 7)
    lowered = mine & (state.acceleration < LINE.acceleration)
    lowered[early] = False
    assert causes(state, joints, lowered) == {"joint 'busy' acceleration"}
    state.acceleration[early] = state.acceleration[lowered][0]
    assert 0.97 < demand(again(state), limits, joints).max() <= 1


def test_ramps_that_meet_do_not_lower_each_other_twice() -> None:
    limits, joints = bounded(1, acceleration=0.8 * LINE.acceleration), Drawn(a=power(1))
    state = attempt(limits, joints, length=0.2)
    eased(limits, joints, state)
    assert state.acceleration == pytest.approx(0.99 * 0.8 * LINE.acceleration)
    assert state.jerk == pytest.approx(0.99 * 0.8 * LINE.jerk)


@settings(max_examples=30)
@given(seeds, st.sampled_from(["acceleration", "jerk"]))
def test_the_gentler_ramp_keeps_the_limit_just_where_it_was_broken_at_the_same_speed(seed: int, kind: str) -> None:
    """A part of the demand, q'' v^2, is that of a steady speed, which no gentler ramp makes less."""
    rng = np.random.default_rng(seed)
    bend = power(2, rng.uniform(0.5, 3))
    joints = Drawn(a=power(1, 0.1), b=lambda n, s: power(1)(n, s) + bend(n, s))
    state = hand_made(LINE, np.linspace(0, LENGTH, 200))
    rising = slice(0, int(np.flatnonzero(on_ramps(state.profile) == 0)[0]))
    most = demand(state.profile, bounded(2, **{kind: 1.0}), joints)[rising].max() / rng.uniform(1.05, 1.4)
    broken = eased(bounded(2, **{kind: most}), joints, state)
    mine = broken.ramp[broken.phase] == 0
    j, motion = state.profile.jerk[broken.phase[mine]], state.profile.at_distance(broken.distance[mine])
    rates = joints.at(motion.distance)
    assert motion.speed == pytest.approx(broken.speed[mine])
    factor = state.acceleration[0] / LINE.acceleration
    assert 0.3 < factor < 0.98
    assert state.jerk[0] == pytest.approx(factor * LINE.jerk)
    first, second, v, a = rates.first[:, 1], rates.second[:, 1], motion.speed, motion.acceleration
    before, after = (
        second * v**2 + first * f * a if kind == "acceleration" else 3 * second * v * f * a + first * f * j
        for f in (1.0, factor)
    )
    assert np.abs(before) / most == pytest.approx(broken.demand[mine], rel=1e-6)
    assert 0.98 < np.abs(after).max() / most <= 1


@pytest.mark.parametrize(("kind", "order"), [("acceleration", 2), ("jerk", 3)])
def test_where_a_steady_speed_takes_most_of_a_limit_it_is_lowered_until_it_takes_four_fifths(
    kind: str, order: int
) -> None:
    """With the second or third derivative the same all along, a steady speed v demands v^2 or v^3."""
    joints = Drawn(idle=power(1, 1e-6), busy=power(order))
    limits = bounded(2, **{kind: 1.1})
    state = attempt(limits, joints)
    broken = eased(limits, joints, state)
    hot = broken.steady > 0.8
    assert hot.any()
    assert state.speed.min() ** order == pytest.approx(0.8 * 1.1)
    for ramp in np.unique(broken.ramp[broken.phase[hot]]):
        at = [state.interval(float(s)) for s in broken.distance[hot & (broken.ramp[broken.phase] == ramp)]]
        assert state.speed[max(min(at) - 1, 0) : max(at) + 2] == pytest.approx(state.speed.min())
    lowered = np.flatnonzero(state.speed < 1)
    places = np.array([state.interval(float(s)) for s in broken.distance[hot]])
    assert np.abs(lowered[:, None] - places).min(axis=1).max() <= 1


def free_time(line: LineLimits, length: float = LENGTH) -> float:
    """From rest to rest where the top speed is reached."""
    v, a, j = float(np.asarray(line.speed)), line.acceleration, line.jerk
    return 2 * ramp_time(v, a, j) + (length - 2 * ramp_distance(0, v, a, j)) / v


@pytest.mark.parametrize("gentler", [1.01, 1.5, 4.0])
def test_a_plan_whose_joints_could_follow_full_ramps_gets_them_back(gentler: float) -> None:
    joints, limits = Drawn(a=power(1)), bounded(1, acceleration=LINE.acceleration, jerk=LINE.jerk)
    given = attempt(limits, joints, gentler)
    relaxed = relax_ramps(given, limits, joints)
    assert given.profile.duration > free_time(LINE)
    assert relaxed.profile.duration == pytest.approx(free_time(LINE), rel=1e-9)
    assert relaxed.acceleration == pytest.approx(LINE.acceleration)
    assert relaxed.jerk == pytest.approx(LINE.jerk)
    assert (relaxed.ramp_cause == -1).all()
    assert relax_ramps(relaxed, limits, joints) is relaxed


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("kind", ["acceleration", "jerk"])
def test_a_joint_that_moves_with_the_line_is_scheduled_nearly_as_fast_as_the_line_with_its_limit(
    kind: str, share: float
) -> None:
    """The optimum is known: the line's, with the joint's limit for its own."""
    most = share * getattr(LINE, kind)
    best = free_time(replace(LINE, **{kind: most}))
    limits, joints = bounded(1, **{kind: most}), Drawn(a=power(1))
    given = attempt(limits, joints, 2.0)
    relaxed, searched = relax_ramps(given, limits, joints), schedule(straight(), limits, joints=joints)
    for found, most in ((relaxed.profile, 1.06), (searched.profile, 1.01)):
        assert best <= found.duration * (1 + 1e-9)
        assert found.duration < most * best
        assert found.duration < given.profile.duration
        assert demand(found, limits, joints).max() <= 1 + 1e-6


@settings(max_examples=15)
@given(seeds)
def test_relaxing_never_slows_nor_breaks_a_limit_nor_leaves_the_range_from_what_was_given_to_full(seed: int) -> None:
    rng = np.random.default_rng(seed)
    curves = {name: wave(1.0, 10 ** rng.uniform(0, 1), rng.uniform(0, 6.28)) for name in "ab"}
    limits, joints, gentler = bounded(2, acceleration=1e9), Drawn(**curves), rng.uniform(1.5, 4)
    kept = demand(attempt(limits, joints, gentler).profile, bounded(2, acceleration=1.0), joints).max()
    limits = bounded(2, acceleration=rng.uniform(1.01, 3) * kept)
    given = attempt(limits, joints, gentler)
    relaxed = relax_ramps(given, limits, joints)
    assert relaxed.profile.duration <= given.profile.duration
    assert demand(relaxed.profile, limits, joints).max() <= 1.001
    for name in ("acceleration", "jerk"):
        least, found, full = getattr(given, name), getattr(relaxed, name), getattr(limits, name)
        assert (found >= least * (1 - 1e-9)).all()
        assert (found <= full * (1 + 1e-9)).all()


@pytest.mark.parametrize("at_start", [True, False])
def test_ramps_are_given_back_but_where_a_joint_binds_and_that_is_named(at_start: bool) -> None:
    curve = fading(1.0, 0.1) if at_start else fading(1.0, -0.1, LENGTH)
    joints = Drawn(idle=power(1, 1e-3), busy=curve)
    limits = bounded(2, acceleration=0.3 * LINE.acceleration)
    given = attempt(limits, joints, 3.0)
    relaxed = relax_ramps(given, limits, joints)
    assert relaxed.profile.duration < given.profile.duration
    assert demand(relaxed.profile, limits, joints).max() <= 1.001
    far = relaxed.grid.distance[:-1] > LENGTH / 2
    far = far if at_start else ~far
    assert relaxed.acceleration[far] == pytest.approx(LINE.acceleration)
    assert relaxed.jerk[far] == pytest.approx(LINE.jerk)
    assert (relaxed.ramp_cause[far] == -1).all()
    gentle = (relaxed.acceleration < 0.999 * LINE.acceleration) | (relaxed.jerk < 0.999 * LINE.jerk)
    assert gentle.any()
    assert causes(relaxed, joints, gentle) == {"joint 'busy' acceleration"}


def bump(size: float, place: float, width: float) -> Curve:
    """The first derivative is `size` at a place and fades on both sides of it."""

    def at(n: int, s: Array) -> Array:
        t = np.tanh((s - place) / width)
        u = 1 - t**2
        return np.asarray(size * (width * t, u, -2 * t * u / width, (4 * t**2 * u - 2 * u**2) / width**2)[n])

    return at


RUNGS = (0.6, 1.0, 0.6, 1.0, 0.6)


def ladder(limits: LineLimits, joints: Drawn, gentler: float) -> Attempt:
    """A plan as of attempt, along lines of 1 m with speeds of their own: its ramps are at every whole metre."""
    path = smooth(Path.through([(float(i), 1e-4 * (i % 2), 0) for i in range(len(RUNGS) + 1)]), 0.05)
    grid = make_grid(path, replace(limits, speed=RUNGS), joints)
    state = uneased(grid, limits, gentler)
    again(state)
    return state


@pytest.mark.parametrize("place", range(len(RUNGS) + 1))
def test_a_joint_that_binds_at_one_ramp_costs_no_other_ramp_anything(place: int) -> None:
    joints = Drawn(idle=power(1, 1e-3), busy=bump(1.0, place, 0.3))
    limits = bounded(2, acceleration=3.5)
    given, full = ladder(limits, joints, 1.6), ladder(limits, joints, 1.0)
    assert demand(given.profile, limits, joints).max() < 1 < demand(full.profile, limits, joints).max()
    relaxed = relax_ramps(given, limits, joints)
    assert demand(relaxed.profile, limits, joints).max() <= 1.001
    begin, end = relaxed.grid.distance[:-1], relaxed.grid.distance[1:]
    gentle = (relaxed.acceleration < 0.999 * LINE.acceleration) | (relaxed.jerk < 0.999 * LINE.jerk)
    assert gentle.any()
    assert place - 1.1 < begin[gentle].min() < end[gentle].max() < place + 1.1
    assert causes(relaxed, joints, gentle) == {"joint 'busy' acceleration"}
    assert (relaxed.ramp_cause[np.abs(begin - place) > 1.1] == -1).all()
    lost, saved = (relaxed.profile.duration - full.profile.duration, given.profile.duration - relaxed.profile.duration)
    assert 0 < lost < 0.2 * saved


@settings(max_examples=12)
@given(seeds)
def test_joints_with_room_for_more_everywhere_make_a_plan_faster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    joints = Drawn(**{name: wave(1.0, 10 ** rng.uniform(0, 0.7), rng.uniform(0, 6.28)) for name in "ab"})
    gentler = rng.uniform(1.3, 2)
    used = demand(ladder(bounded(2), joints, gentler).profile, bounded(2, acceleration=1.0), joints).max()
    limits = bounded(2, acceleration=gentler**0.5 * 1.02 * used)  # room for a quarter of what is lost, by logarithm
    given = ladder(limits, joints, gentler)
    relaxed = relax_ramps(given, limits, joints)
    assert relaxed.profile.duration < given.profile.duration - 1e-3
    assert demand(relaxed.profile, limits, joints).max() <= 1.001


@pytest.mark.parametrize("length", [LENGTH, 0.05])
@pytest.mark.parametrize("kind", ["acceleration", "jerk"])
def test_ramps_that_can_be_given_nothing_stay_and_name_their_joint(kind: str, length: float) -> None:
    limits, joints = bounded(2, **{kind: 0.25 * getattr(LINE, kind)}), Drawn(idle=power(1, 1e-3), busy=power(1))
    given = attempt(limits, joints, length=length)
    getattr(given, kind)[:] *= 0.25
    again(given)
    relaxed = relax_ramps(given, limits, joints)
    assert relaxed.profile.duration == given.profile.duration
    assert (relaxed.acceleration == given.acceleration).all()
    assert (relaxed.jerk == given.jerk).all()
    assert causes(relaxed, joints) == {f"joint 'busy' {kind}"}
