"""Tracks along paths: their rates are their derivatives, at the ends one-sided, and their numbers those of the path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruckig import InputParameter, Result, Ruckig, Trajectory
from scipy.spatial.transform import Rotation

from models import Arc, Line, Path, SmoothPath, smooth
from ocp import ProblemError, TipTask
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.speed_profile import rest_profile
from ocp.motion.tasks.tip_task import retime_task
from ocp.motion.tasks.tracks import PathTracks, path_tracks
from tests.models.robot.trees import Array
from tests.ocp.motion.tasks.space_tasks import panda

AXIS = np.array([0.3, -0.2, 0.9])
STEP = 1e-5


def turning() -> SmoothPath:
    """Lines and an arc, with a tool that turns."""
    q = Rotation.from_rotvec([[0.1, 0, 0], [0.5, 0.3, 0], [0.2, -0.4, 0.9], [0.0, 0.1, 1.2]]).as_quat()
    q = np.roll(q, 1, axis=1)
    center = np.array([0.6, 0.5, 0.0])
    lines = (Line((0, 0, 0), (0.6, 0, 0.0), q[0], q[1]), Line((0.6, 0, 0), (0.6, 0.3, 0.0), q[1], q[2]))
    arc = Arc.about((0.6, 0.3, 0), center, (1, 0, 0), np.pi / 2, start_orientation=q[2], end_orientation=q[3])
    return smooth(Path((*lines, arc)), deviation=0.02)


PATH = turning()
SPEED = 0.3
TIMING = schedule(PATH, LineLimits(speed=0.3, acceleration=0.5, jerk=4.0))
TRACKS: dict[str, tuple[PathTracks, Callable[[Array], Array], Callable[[Array], Array]]] = {
    "constant": (path_tracks(PATH, SPEED), lambda t: SPEED * t, lambda t: np.full_like(t, SPEED)),
    "scheduled": (path_tracks(PATH, TIMING), lambda t: TIMING.at(t).distance, lambda t: TIMING.at(t).speed),
}
every_track = pytest.mark.parametrize("kind", TRACKS)


def rate_of(track: Any) -> Any:
    """The track's rate, a track itself."""
    return track.rate


def numbers(track: Any, times: Any) -> Array:
    """Values of a track at times (M,). Shape (M, entries by columns)."""
    t = ca.MX.sym("t")
    function = ca.Function("track", [t], [ca.densify(ca.vec(track(t)))])
    return np.array([np.array(function(time)).ravel() for time in np.atleast_1d(times)])


def inner(tracks: PathTracks) -> Array:
    """Times well inside the pieces."""
    breaks = tracks.breaks[np.append(np.diff(tracks.breaks) > 20 * STEP, True)]
    return np.concatenate([a + (b - a) * np.array([0.2, 0.5, 0.8]) for a, b in pairwise(breaks)])


@every_track
def test_tracks_equal_their_path(kind: str) -> None:
    tracks, distance, _ = TRACKS[kind]
    times = np.append(inner(tracks), [0.0, tracks.duration])
    s = np.clip(distance(times), 0, PATH.length)
    turn = Rotation.from_quat(np.roll(PATH.turn(s).quaternion, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(numbers(tracks.position, times), PATH.at(s).position, atol=1e-9)
    result = numbers(tracks.orientation, times).reshape(-1, 3, 3).transpose(0, 2, 1)
    np.testing.assert_allclose(result, turn, atol=1e-9)
    np.testing.assert_allclose(numbers(tracks.axis(AXIS), times), turn @ AXIS, atol=1e-9)


@every_track
def test_rates_are_derivatives_inside_and_one_sided_at_the_ends(kind: str) -> None:
    """Central differences inside, differences into the path at its ends, of second order both."""
    tracks, _, _ = TRACKS[kind]
    weights = {0: (-0.5, 0.0, 0.5), 1: (-1.5, 2.0, -0.5), -1: (1.5, -2.0, 0.5)}
    steps = {0: (-1, 0, 1), 1: (0, 1, 2), -1: (0, -1, -2)}
    for side, times in ((0, inner(tracks)), (1, np.array([0.0])), (-1, np.array([tracks.duration]))):

        def slope(track: Any, times: Array = times, side: int = side) -> Array:
            values = [numbers(track, times + k * STEP) for k in steps[side]]
            return np.asarray(sum(w * v for w, v in zip(weights[side], values, strict=True)) / STEP)

        for track in (tracks.position, tracks.axis(AXIS)):
            np.testing.assert_allclose(numbers(rate_of(track), times), slope(track), atol=2e-6)
        turns, change = numbers(tracks.orientation, times), slope(tracks.orientation)
        rate = np.array(
            [c.reshape(3, 3).T @ r.reshape(3, 3) for c, r in zip(change, turns, strict=True)]
        )  # R' R^T, columns being read one after the other
        spin = np.column_stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]])
        np.testing.assert_allclose(numbers(rate_of(tracks.orientation), times), spin, atol=2e-6)


@every_track
def test_the_line_speed_is_the_requested_one_and_breaks_are_at_segment_ends(kind: str) -> None:
    tracks, distance, speed = TRACKS[kind]
    times = inner(tracks)
    rates = numbers(rate_of(tracks.position), times)
    np.testing.assert_allclose(np.linalg.norm(rates, axis=1), speed(times), atol=1e-9)
    ends = distance(np.array([0.0, tracks.duration]))
    np.testing.assert_allclose(ends, [0.0, PATH.length], atol=1e-9)
    reached = distance(np.clip(tracks.breaks, 0, tracks.duration))
    assert all(np.abs(reached - bound).min() < 1e-9 for bound in PATH.bounds)
    assert (np.diff(tracks.breaks) >= 0).all()


def test_a_task_run_by_a_clock_moves_at_the_clocks_pace() -> None:
    """The chain rule for tracks that know their rates: position, axis and orientation."""
    task = TipTask.along(PATH, SPEED, steady=True, roll="given")
    free = TipTask.along(PATH, SPEED, steady=True, tool_axis=AXIS)
    for one in (task, free):
        ran = retime_task(one, lambda t: t**2)
        times = np.array([0.3, 0.7, 0.9])
        slow, fast = bind(panda(), one).target_function(), bind(panda(), ran).target_function()
        for time in times:
            at, then = np.array(slow(time**2)).ravel(), np.array(fast(time)).ravel()
            rates = [3, 4, 5, *range(len(at) - 3, len(at))]
            np.testing.assert_allclose(then[rates], 2 * time * at[rates], atol=1e-12)
            np.testing.assert_allclose(np.delete(then, rates), np.delete(at, rates), atol=1e-12)


def test_a_task_that_begins_later_is_the_same_later() -> None:
    task = TipTask.along(PATH, SPEED, steady=True)
    later = replace(task, begin=1.5)
    now, then = (bind(panda(), one).target_function() for one in (task, later))
    for time in (0.0, 0.4, 1.1):
        np.testing.assert_allclose(np.array(then(1.5 + time)), np.array(now(time)), atol=1e-12)
    assert later.end == pytest.approx(1.5 + PATH.length / SPEED)


def test_the_task_of_a_path_has_its_tool_orientation() -> None:
    plain = smooth(Path.through([(0, 0, 0), (1, 0, 0)]), deviation=0.01)
    bare, held = TipTask.along(plain, 0.1, steady=True), TipTask.along(plain, 0.1, steady=True, direction=(0, 0, -1))
    free, options = TipTask.along(PATH, 0.1, steady=True), TipTask.along(PATH, 0.1, steady=True, roll="given")
    lean = TipTask.along(PATH, 0.1, steady=True, within=0.2)
    assert [task.size for task in (bare, held, free, options, lean)] == [3, 5, 5, 6, 3]
    assert (bare.direction, bare.orientation) == (None, None)
    assert free.orientation is None
    assert options.direction is None


sizes = st.floats(-3, 2).map(lambda power: 10**power)


@given(sizes, sizes, sizes, sizes)
def test_a_motion_from_rest_to_rest_takes_the_least_time_within_its_limits(
    length: float, speed: float, acceleration: float, jerk: float
) -> None:
    """Against ruckig's time, and against the limits at every instant at which a quantity has its maximum."""
    profile = rest_profile(length, speed, acceleration, jerk)
    request = InputParameter(1)
    request.target_position, request.max_velocity = [1.0], [speed / length]
    request.max_acceleration, request.max_jerk = [acceleration / length], [jerk / length]
    trajectory = Trajectory(1)
    assert Ruckig(1).calculate(request, trajectory) == Result.Working
    assert profile.duration == pytest.approx(trajectory.duration, rel=1e-6)
    peaks = profile.peaks()
    for values, limit in ((peaks.speed, speed), (peaks.acceleration, acceleration), (profile.jerk, jerk)):
        assert np.abs(values).max() <= limit * (1 + 1e-9)
    ends = profile.at([0.0, profile.duration])
    np.testing.assert_allclose(ends.distance, [0.0, length], rtol=1e-9)
    assert not ends.speed.any()
    np.testing.assert_allclose(profile.acceleration[[0, -1]], 0.0, atol=1e-9 * acceleration)


def test_a_task_along_a_path_starts_and_ends_at_rest_unless_it_is_steady() -> None:
    task, steady = TipTask.along(PATH, SPEED), TipTask.along(PATH, SPEED, steady=True)
    middle = 0.5 * float(task.duration or 0.0)
    speeds = [float(np.linalg.norm(numbers(rate_of(task.position), t))) for t in (0.0, middle, task.duration)]
    np.testing.assert_allclose(speeds, [0.0, SPEED, 0.0], atol=1e-9)
    assert float(np.linalg.norm(numbers(rate_of(steady.position), 0.0))) == pytest.approx(SPEED)
    # each ramp takes v/a + a/j, and half of it is lost
    assert float(task.duration or 0) - float(steady.duration or 0) == pytest.approx(SPEED / 1.0 + 0.1, rel=1e-9)
    slow = TipTask.along(PATH, SPEED, acceleration=0.5, jerk=4.0)
    assert slow.duration == pytest.approx(TIMING.duration, rel=1e-9)
    np.testing.assert_allclose(
        numbers(slow.position, [0.2, 1.0, 2.0]),
        numbers(TipTask.along(PATH, TIMING).position, [0.2, 1.0, 2.0]),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"speed": TIMING, "steady": True}, "steady"),
        ({"speed": TIMING, "acceleration": 1.0}, "acceleration"),
        ({"speed": SPEED, "steady": True, "jerk": 1.0}, "jerk"),
        ({"speed": SPEED, "acceleration": 0.0}, "acceleration"),
        ({"speed": SPEED, "jerk": -1.0}, "jerk"),
        ({"speed": 0.0}, "speed"),
    ],
)
def test_arguments_about_the_speed_that_have_no_effect_or_no_meaning_are_refused(
    arguments: dict[str, Any], name: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        TipTask.along(PATH, **arguments)
    assert caught.value.name == name
