"""Speed profiles of constant jerk: profiles through nodes, their inverse, their function and their concatenation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings

from ocp.motion.tasks.speed_profile import SpeedProfile, integrate_jerk, join_profiles, profile_through
from tests.models.paths.task_paths import seeds


def random_profile(seed: int) -> SpeedProfile:
    """Return a profile of two to six segments in which the speed stays positive."""
    rng = np.random.default_rng(seed)
    v, a = rng.uniform(2, 4), rng.normal()
    rows, jerks = [(0.0, 0.0, v, a)], []
    for _ in range(int(rng.integers(2, 7))):
        time, jerk = rng.uniform(0.05, 0.3), rng.normal()
        covered, v, a = integrate_jerk(v, a, jerk, time)
        rows.append((rows[-1][0] + time, rows[-1][1] + covered, v, a))
        jerks.append(jerk)
    t, distance, speed, acceleration = np.array(rows).T
    assume(speed.min() > 0.5)
    return SpeedProfile(t, distance, speed, acceleration, np.array(jerks))


@settings(max_examples=50)
@given(seeds)
def test_two_jerks_lead_through_any_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, first, second = rng.uniform(0.1, 1), *rng.normal(size=2)
    v, a = rng.uniform(2, 4), rng.normal()
    middle = integrate_jerk(v, a, first, t)
    end = integrate_jerk(*middle[1:], second, t)
    assume(min(middle[0], end[0], middle[1], end[1]) > 0)
    states = np.array([[0.0, v, a], [middle[0] + end[0], *end[1:]]]).T
    result = profile_through(*states)
    assert result.jerk == pytest.approx([first, second], rel=1e-6, abs=1e-6)
    assert result.duration == pytest.approx(2 * t, rel=1e-9)


@settings(max_examples=50)
@given(seeds)
def test_a_profile_through_nodes_has_their_speeds_and_accelerations(seed: int) -> None:
    nodes = random_profile(seed)
    result = profile_through(nodes.distance, nodes.speed, nodes.acceleration)
    for places in (result.at(result.t[::2]), result.at_distance(nodes.distance)):
        np.testing.assert_allclose(places.distance, nodes.distance, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(places.speed, nodes.speed, rtol=1e-7)
        np.testing.assert_allclose(places.acceleration, nodes.acceleration, rtol=1e-6, atol=1e-6)


@settings(max_examples=50)
@given(seeds)
def test_time_and_distance_are_inverse_to_each_other(seed: int) -> None:
    profile = random_profile(seed)
    times = np.linspace(0.0, profile.duration, 40)
    motion = profile.at(times)
    np.testing.assert_allclose(profile.at_distance(motion.distance).t, times, atol=1e-9)
    symbolic = np.array(profile.function().map(len(times))(times)[0]).ravel()
    np.testing.assert_allclose(symbolic, motion.distance, atol=1e-12)


@settings(max_examples=20)
@given(seeds)
def test_a_profile_in_two_parts_is_the_whole(seed: int) -> None:
    whole = random_profile(seed)
    cut = len(whole.jerk) // 2
    parts = [
        SpeedProfile(
            whole.t[rows] - whole.t[rows][0],
            whole.distance[rows],
            whole.speed[rows],
            whole.acceleration[rows],
            whole.jerk[jerks],
        )
        for rows, jerks in ((slice(cut + 1), slice(cut)), (slice(cut, None), slice(cut, None)))
    ]
    joined = join_profiles(parts)
    for name in ("t", "distance", "speed", "acceleration", "jerk"):
        np.testing.assert_allclose(getattr(joined, name), getattr(whole, name), atol=1e-12)


@settings(max_examples=50)
@given(seeds)
def test_the_highest_speed_is_among_the_peaks(seed: int) -> None:
    profile = random_profile(seed)
    dense = profile.at(np.linspace(0.0, profile.duration, 2000)).speed
    assert dense.max() <= profile.peaks().speed.max() <= dense.max() + 1e-4
