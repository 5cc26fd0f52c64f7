"""Line-speed schedules: the example of Lee, Ryu, Cheong 2006, closed forms, and limits on random paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import ModelError, Path, SmoothPath, smooth
from ocp import ProblemError
from ocp.motion.schedule import (
    JointLimits,
    LineLimits,
    Schedule,
    SpeedProfile,
    peak_acceleration,
    planner,
    ramp_distance,
    ramp_time,
    ramps,
    schedule,
)
from ocp.motion.schedule.planner import SETTINGS
from ocp.motion.tasks.speed_profile import reachable_speed
from tests.models.paths.task_paths import random_path, seeds
from tests.models.paths.test_paths import example

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
NAN = float("nan")
LIMITS = LineLimits(1.0, 5.0, 200.0)


def line(length: float) -> SmoothPath:
    return smooth(Path.through([(0, 0, 0), (length, 0, 0)]), 0.1)


def ladder(count: int = 4) -> SmoothPath:
    """Lines of 1 m, one after the other, that hardly turn."""
    return smooth(Path.through([(float(i), 1e-4 * (i % 2), 0) for i in range(count + 1)]), 0.05)


@pytest.mark.parametrize(
    ("acceleration", "duration", "events"),
    [
        (peak_acceleration(5.0, 1.0, 200.0), 1.868825, [0.3500, 0.6203, 0.9722, 1.2419]),  # 5 m/s^2 in the mean
        (5.0, 1.893825, [0.3625, 0.6328, 0.9847, 1.2544]),
    ],
)
def test_the_example_takes_the_time_checked_and_keeps_its_speed_between_the_ramps(
    acceleration: float, duration: float, events: list[float]
) -> None:
    path = example("cubic")
    plan = schedule(path, replace(LIMITS, acceleration=acceleration))
    assert plan.duration == pytest.approx(duration, abs=1e-6)
    assert plan.time_at(path.bounds[1:5]) == pytest.approx(events, abs=5e-5)
    inside = (plan.time_at(path.bounds[1])[0], plan.time_at(path.bounds[4])[0])
    assert plan.at(np.linspace(*inside, 999)).speed == pytest.approx(1.0, abs=1e-14)
    assert not plan.dips


@pytest.mark.parametrize("length", [1e-6, 1e-3, 0.05, 0.2, 1.0, 1e3])
def test_rest_to_rest_over_a_line_takes_the_seven_phase_time(length: float) -> None:
    speed, acceleration, jerk = 1.0, 5.0, 200.0
    plan = schedule(line(length), LineLimits(speed, acceleration, jerk))
    # the top speed for which two ramps fill the line, by bisection on the closed form
    low, high = 0.0, speed
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if 2 * ramp_distance(0, middle, acceleration, jerk) <= length else (low, middle)
    rest = max(length - 2 * ramp_distance(0, low, acceleration, jerk), 0.0)
    expected = 2 * ramp_time(low, acceleration, jerk) + rest / low
    assert plan.duration == pytest.approx(expected, rel=1e-9)
    assert plan.profile.distance[-1] == length


@given(st.floats(0.1, 20), st.floats(0.05, 5), st.floats(1, 1000))
def test_the_peak_acceleration_has_the_requested_mean(mean: float, speed: float, jerk: float) -> None:
    if 4 * mean**2 / speed >= jerk:
        with pytest.raises(ProblemError, match="needs a jerk"):
            peak_acceleration(mean, speed, 0.99 * jerk)
        return
    peak = peak_acceleration(mean, speed, jerk)
    assert speed / ramp_time(speed, peak, jerk) == pytest.approx(mean, rel=1e-9)


def after(state: tuple[Any, ...], jerk: Any, time: Any) -> tuple[Any, ...]:
    """Distance, speed and acceleration after a time of constant jerk."""
    s, v, a = state
    return s + time * v + time**2 * a / 2 + time**3 * jerk / 6, v + time * a + time**2 * jerk / 2, a + time * jerk


changes = st.tuples(*[st.floats(0, 1)] * 2, st.floats(0.05, 2), *[st.floats(-1, 1)] * 2)
"""First and last speed over the top one, distance over that of the ramps by the top speed; 10^x of the limits."""


def change(sample: tuple[float, ...]) -> tuple[float, ...]:
    """Distance, first, last, top speed, acceleration and jerk: a distance that is enough, if barely."""
    first, last, share, x, y = sample
    acceleration, jerk = 10**x, 10 ** (x + y)
    least = ramp_distance(first, last, acceleration, jerk)
    most = ramp_distance(first, 1, acceleration, jerk) + ramp_distance(1, last, acceleration, jerk)
    return max(least * (1 + 1e-9), share * most, 1e-3), first, last, 1.0, acceleration, jerk


@given(changes)
def test_the_fastest_motion_ends_where_it_must_whether_ruckig_finds_it_or_two_ramps_make_it(sample: Any) -> None:
    distance, first, last, *limits = change(sample)
    top, acceleration, jerk = limits
    result = ramps.fastest_motion(distance, first, last, (top, acceleration, jerk))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ramps, "Ruckig", lambda _: SimpleNamespace(calculate=lambda *_: None))
        by_ramps = ramps.fastest_motion(distance, first, last, (top, acceleration, jerk))
    for phases in (result, by_ramps):
        s, v, a = 0.0, first, 0.0
        for t, j in phases:
            assert t > 0
            assert abs(j) <= jerk * (1 + 1e-9)
            s, v, a = after((s, v, a), j, t)
            assert abs(a) <= acceleration * (1 + 1e-9)
            assert min(first, last) - 1e-9 <= v <= top + 1e-9
        assert (s, v, a) == pytest.approx((distance, last, 0.0), abs=1e-8 * (1 + acceleration + distance))
    assert sum(t for t, _ in by_ramps) == pytest.approx(sum(t for t, _ in result), rel=1e-6)


@given(st.floats(0, 5), st.floats(1e-3, 5), st.floats(-1, 2), st.floats(-1, 3))
def test_the_speed_within_reach_is_the_inverse_of_the_ramps_distance(
    speed: float, gain: float, x: float, y: float
) -> None:
    distance = ramp_distance(speed, speed + gain, 10**x, 10**y)
    assert reachable_speed(speed, distance, 10**x, 10**y) == pytest.approx(speed + gain, rel=1e-9)


@given(seeds, st.integers(1, 6))
def test_segments_of_constant_jerk_have_extreme_speeds_at_the_peaks_and_invertible_times(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    t, jerk = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1, count))]), rng.normal(size=count)
    states = [(0.0, 20.0, rng.normal())]
    for step, j in zip(np.diff(t), jerk, strict=True):
        states.append(after(states[-1], j, step))
    s, v, a = np.array(states).T
    profile = SpeedProfile(t, s, v, a, jerk)
    times = np.sort(np.append(rng.uniform(0, t[-1], 40), t))
    motion, peaks = profile.at(times), profile.peaks()
    fine = profile.at(np.linspace(0, t[-1], 4001)).speed
    assert peaks.speed.max() == pytest.approx(fine.max(), abs=1e-6)
    assert peaks.speed.min() == pytest.approx(fine.min(), abs=1e-6)
    assert profile.at_distance(motion.distance).t == pytest.approx(times, abs=1e-12 * (1 + t[-1]))
    for value, expected in zip(profile.function().map(len(times))(times[None]), motion[1:4], strict=False):
        assert np.array(value).ravel() == pytest.approx(expected, rel=1e-12, abs=1e-12)


def check_profile(plan: Schedule, request: NDArray[np.float64], times: int = 20001) -> None:
    """Rest to rest, continuous to the acceleration, within the limits of the line: ten times finer than 1 ms."""
    profile, limits = plan.profile, plan.limits
    step = np.diff(profile.t)
    assert (step > 0).all()
    ends = (profile.distance, profile.speed, profile.acceleration)
    reached = after(tuple(end[:-1] for end in ends), profile.jerk, step)
    for end, there, scale in zip(ends, reached, (plan.path.length, request.max(), limits.acceleration), strict=True):
        assert end[1:] == pytest.approx(there, abs=1e-9 * scale)
    motion = plan.at(np.linspace(0, plan.duration, times))
    assert [motion.speed[0], motion.speed[-1]] == [0, 0]
    assert motion.distance[-1] == pytest.approx(plan.path.length, rel=1e-12)
    assert (np.diff(motion.distance) >= -1e-12 * plan.path.length).all()
    # on a bound between two pieces the faster one counts
    sides = motion.distance + np.array([[-1e-9], [1e-9]]) * plan.path.length
    segment = np.clip(np.searchsorted(plan.path.bounds, sides, side="right") - 1, 0, len(request) - 1)
    assert (motion.speed <= request[segment].max(axis=0) * (1 + 1e-9)).all()
    assert np.abs(motion.acceleration).max() <= limits.acceleration * (1 + 1e-9)
    assert np.abs(motion.jerk).max() <= limits.jerk * (1 + 1e-9)
    if np.isfinite(limits.centripetal):
        assert (motion.speed**2 * plan.path.curvature(motion.distance)).max() <= limits.centripetal * 1.001


@settings(max_examples=40)
@given(seeds, st.integers(1, 9), st.sampled_from(["cubic", "quintic"]), st.booleans())
@hypothesis.example(280, 6, "cubic", True)  # a near-cusp that the last ramp to rest reaches
def test_random_paths_never_exceed_requested_speed_or_limits(seed: int, count: int, kind: Any, each: bool) -> None:
    rng = np.random.default_rng(seed)
    path = smooth(random_path(rng, count), 10 ** rng.uniform(-3, -0.5), kind=kind)
    speed = 10 ** rng.uniform(-1.5, 0.5, count if each else ())
    centripetal = 10 ** rng.uniform(-1, 1.5) if rng.random() < 0.7 else np.inf
    limits = LineLimits(speed, 10 ** rng.uniform(-0.5, 1.5), 10 ** rng.uniform(0.5, 3), centripetal)
    plan = schedule(path, limits)
    check_profile(plan, path.by_piece(speed))
    # time and distance are inverse
    s = rng.uniform(0, path.length, 40)
    assert plan.at(plan.time_at(s)).distance == pytest.approx(s, abs=1e-12 * path.length)
    function = plan.function()
    t = rng.uniform(0, plan.duration, 20)
    for value, expected in zip(function.map(20)(t[None]), plan.at(t)[1:], strict=True):
        assert np.array(value).ravel() == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_speed_that_bulges_between_two_points_of_the_grid_is_seen() -> None:
    """Found once: slow at both ends of an interval on an arc, 12 % over the limit inside it."""
    rng = np.random.default_rng(12)
    path = smooth(random_path(rng, int(rng.integers(1, 9))), 10 ** rng.uniform(-3, -0.5))
    speed = 10 ** rng.uniform(-1.5, 0.5)
    limits = LineLimits(speed, 10 ** rng.uniform(-0.5, 1.5), 10 ** rng.uniform(0.5, 3), 10 ** rng.uniform(-1, 1.5))
    check_profile(schedule(path, limits), path.by_piece(speed), 100001)


def test_any_sequence_of_speeds_is_reached_between_its_ramps() -> None:
    path, speeds = ladder(5), [0.2, 1.0, 0.5, 0.05, 0.8]
    plan = schedule(path, LineLimits(speeds, 5.0, 200.0))
    middles = (path.bounds[:-1] + path.bounds[1:])[path.piece_segment >= 0] / 2
    assert plan.profile.at_distance(middles).speed == pytest.approx(speeds, rel=1e-9)
    check_profile(plan, path.by_piece(speeds))
    assert not plan.dips  # each stretch gets what was asked of it


def test_centripetal_acceleration_slows_the_blends_only() -> None:
    path = example("quintic")
    plan = schedule(path, replace(LIMITS, centripetal=5.0))
    motion = plan.sample(1e-3)
    assert np.max(motion.speed**2 * path.curvature(motion.distance)) < 5.0 * 1.001
    assert np.max(motion.speed) == pytest.approx(1.0, abs=1e-6)
    assert len(plan.dips) == 2
    for vertex, dip in enumerate(plan.dips):
        blend = path.blend(vertex)
        assert dip.cause == "centripetal acceleration"
        assert blend.start <= dip.start < dip.end <= blend.end
        most = path.curvature(np.linspace(blend.start, blend.end, 4001)).max()
        assert dip.permitted == pytest.approx(np.sqrt(5.0 / most), rel=2e-3)
        assert dip.permitted <= dip.speed * 1.001
        assert dip.requested == 1.0
        assert "centripetal acceleration permits" in str(dip)
    # away from the dips and the ramps to them the asked speed is kept
    away = ramp_distance(1.0, min(dip.permitted for dip in plan.dips), 5.0, 200.0) * 1.01
    free = (motion.distance > ramp_distance(0, 1, 5.0, 200.0)) & (motion.distance < plan.dips[0].start - away)
    assert motion.speed[free] == pytest.approx(1.0, abs=1e-9)


def test_a_slower_requested_speed_needs_no_dip() -> None:
    path = example("quintic")
    peak = path.curvature(path.sample_distances(200)).max()
    plan = schedule(path, LineLimits(0.999 * np.sqrt(5.0 / peak), 5.0, 200.0, centripetal=5.0), strict=True)
    assert not plan.dips


def test_strict_refuses_and_says_where() -> None:
    with pytest.raises(ProblemError, match=r"2 place\(s\).*\n.* m: centripetal acceleration permits") as caught:
        schedule(example("quintic"), replace(LIMITS, centripetal=5.0), strict=True)
    error = caught.value
    assert f"{error.time:.6g} to " in str(error)
    assert f"{error.name} permits {error.limit:.4g} of {error.value:.4g} m/s" in str(error)


def test_the_last_sample_is_the_end() -> None:
    plan = schedule(line(1.0), LIMITS)
    t = plan.sample(2e-3).t
    assert t[-1] == plan.duration
    assert np.diff(t)[:-1] == pytest.approx(2e-3, rel=1e-9)
    assert 0 < np.diff(t)[-1] <= 2e-3 * (1 + 1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, NAN])
def test_a_speed_or_jerk_that_is_not_positive_is_a_named_error(bad: float) -> None:
    for name in ("speed", "acceleration", "jerk", "centripetal"):
        with pytest.raises(ProblemError, match=f"{name} limit") as caught:
            replace(LIMITS, **{name: bad})  # type: ignore[arg-type]
        assert caught.value.name == name
    for name, values in (("mean", (bad, 1.0, 200.0)), ("speed", (5.0, bad, 200.0)), ("jerk", (5.0, 1.0, bad))):
        with pytest.raises(ProblemError, match=f"{name} must be positive") as caught:
            peak_acceleration(*values)
        assert caught.value.name == name
    for name in ("velocity", "acceleration", "jerk", "torque"):
        if bad == 0.0 and name != "torque":  # of a joint that does not move
            continue
        with pytest.raises(ProblemError, match=f"joint {name} limit") as caught:
            LineLimits(1.0, 5.0, 200.0, joints=JointLimits(**{name: [1.0, bad]}))
        assert caught.value.name == f"joint {name}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": []}, "speed"),
        ({"speed": "fast"}, "not numeric"),
        ({"speed": [1.0, 0.0]}, "speed limit 0"),
        ({"speed": [[1.0]]}, "shape"),
        ({"speed": np.inf}, "finite"),
        ({"jerk": [1.0, 2.0]}, "one number"),
        ({"joints": 3.0}, "JointLimits"),
    ],
)
def test_limits_that_are_none_are_named_errors(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        replace(LIMITS, **options)
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_times_distances_and_periods_out_of_range_are_named_errors() -> None:
    plan = schedule(line(1.0), LIMITS)
    for wrong in (-0.1, 9.0, NAN):
        with pytest.raises(ProblemError, match="outside the schedule"):
            plan.at(wrong)
        with pytest.raises(ProblemError, match="off the path"):
            plan.time_at(wrong)
    for period in (0.0, -1e-3, NAN, np.inf):
        with pytest.raises(ProblemError, match="sample period"):
            plan.sample(period)
    with pytest.raises(ValueError, match="2 segments"):
        schedule(smooth(Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0)]), 0.1), LineLimits([1, 2, 3], 5.0, 200.0))


@pytest.mark.parametrize("wrong", ["x", None, {}, 1j, [[0.1, 0.2]]])
def test_arguments_that_are_no_numbers_are_named_errors(wrong: Any) -> None:
    path = smooth(Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0)]), 0.1)
    plan = schedule(path, LIMITS)
    calls: list[tuple[Callable[[Any], Any], type[Exception], str]] = [
        (plan.sample, ProblemError, "sample period"),
        (lambda value: schedule(path, value), ProblemError, "must be a LineLimits"),
        (lambda value: schedule(value, LIMITS), ProblemError, "has no length"),
        (lambda value: peak_acceleration(value, 1.0, 200.0), ProblemError, "must be positive"),
    ]
    if wrong is not None:  # numpy reads it as nan, refused elsewhere
        calls += [(call, ProblemError, r"not numeric|shape") for call in (plan.at, plan.time_at)]
        calls += [(path.at, ModelError, "distance"), (path.blend, ModelError, "vertex")]
    for call, error, message in calls:
        with pytest.raises(error, match=message) as caught:
            call(wrong)
        assert vars(caught.value)["name"] in str(caught.value)


@given(seeds, st.integers(2, 60))
def test_about_the_slowest_place_of_each_run_a_stretch_gets_its_speed(seed: int, count: int) -> None:
    """As far as the run goes on and no more than a spread is permitted, looked at place by place."""
    rng = np.random.default_rng(seed)
    s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, count))])
    permitted, speed = np.exp(rng.uniform(-1, 1, count + 1)), rng.uniform(0.5, 3.0, count)
    most, steady = np.minimum(permitted[:-1], permitted[1:]), 1.5
    even = SpeedProfile(np.array([0.0, s[-1] / steady]), s[[0, -1]], np.full(2, steady), np.zeros(2), np.zeros(1))
    fast, expected = np.minimum(steady, speed) > most * (1 + 1e-9), speed.copy()
    for k in np.flatnonzero(fast):
        first = last = k
        while first > 0 and fast[first - 1]:
            first -= 1
        while last < count - 1 and fast[last + 1]:
            last += 1
        if k == first + most[first : last + 1].argmin():
            for path in (range(k, first - 1, -1), range(k, last + 1)):
                for at in path:
                    if most[at] > SETTINGS.spread * most[k]:
                        break
                    expected[at] = min(speed[at], most[k])
    assert planner._lower_speeds(s, permitted, speed, even, False) == fast.any()
    assert speed == pytest.approx(expected)
