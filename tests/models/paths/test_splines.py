"""Splines in place of runs of short segments: near in both directions, few and smooth; corners and turns are kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from models import Arc, Line, Path, SmoothPath, smooth
from models.paths import Spline, fit_splines, path_function, turn_function

Array = NDArray[np.float64]
DEVIATION = 5e-5


def rounded(points: Array) -> Array:
    """Points in micrometres, as CAM programs write them, without repetitions."""
    values = np.round(points, 6)
    return np.asarray(values[np.append(True, np.linalg.norm(np.diff(values, axis=0), axis=1) > 0)])


def rosette(count: int) -> Array:
    angle = np.linspace(0, 2 * np.pi, count)
    radius = 0.09 + 0.01 * np.cos(6 * angle)
    return rounded(np.column_stack([0.45 + radius * np.cos(angle), radius * np.sin(angle), 0.01 * np.sin(angle)]))


def spiral(count: int) -> Array:
    angle = np.linspace(0, 12 * np.pi, count)
    radius = 0.02 + 0.09 * angle / angle[-1]
    return rounded(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle]))


def noisy(count: int) -> Array:
    return rosette(count) + np.random.default_rng(0).uniform(-1e-5, 1e-5, (len(rosette(count)), 3))


def drop(count: int) -> Array:
    """Two arcs of a circle that meet in a corner of 60 degrees, at the point in the middle."""
    angle = np.linspace(-1.2, 1.2, count // 2)
    first = np.column_stack([0.1 * np.sin(angle), 0.1 * np.cos(angle), 0 * angle])
    second = (first[:-1] - first[-1]) @ Rotation.from_euler("z", 120, degrees=True).as_matrix().T + first[-1]
    return rounded(np.concatenate([first, second[::-1]]))


def raster(count: int, noise: float = 0.0) -> Array:
    """Ten lines of 0.1 and 0.01 m in turn, as many short chords."""
    corners = np.array([(0.1 * ((i + 1) // 2 % 2), 0.01 * (i // 2), 0.0) for i in range(11)])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    places = np.union1d(np.linspace(0, length[-1], count), length)
    points = np.column_stack([np.interp(places, length, column) for column in corners.T])
    return rounded(points + np.random.default_rng(0).uniform(-noise, noise, points.shape))


def arcs(count: int) -> Path:
    points = spiral(2 * count + 1)
    return Path(tuple(Arc.through(*points[2 * i : 2 * i + 3]) for i in range(count)))


PATHS = {
    "rosette": Path.through(rosette(2400)),
    "spiral": Path.through(spiral(2400)),
    "noise": Path.through(noisy(2400)),
    "corner": Path.through(drop(2400)),
    "raster": Path.through(raster(2400)),
    "noisy raster": Path.through(raster(2400, 2e-6)),
    "arcs": arcs(500),
    "doubled points": Path.through(np.repeat(rosette(600), 2, axis=0) + np.tile([[0.0] * 3, [1e-6] * 3], (600, 1))),
}


def fitted(path: Path, deviation: float = DEVIATION) -> SmoothPath:
    result = fit_splines(path, deviation)
    return smooth(result.path, deviation=result.deviation)


def tilted(points: Array) -> Path:
    """A path through points, along which the tool tilts and rolls."""
    share = np.linspace(0, 1, len(points))[:, None]
    turns = Rotation.from_rotvec(share * [0.5, -0.8, 2.9] + 0.2 * np.sin(6 * share) * [1.0, 0, 0])
    return Path.through(points, turns.as_quat(scalar_first=True))


def distances(points: Array, line: Array) -> Array:
    """Distances of points from a polyline, by the chords beside its closest points."""
    near = cKDTree(line).query(points, k=8)[1]
    start = np.concatenate([near, near - 1], axis=1).clip(0, len(line) - 2)
    chord, offset = line[start + 1] - line[start], points[:, None] - line[start]
    square = np.maximum((chord**2).sum(axis=2), 1e-30)
    share = np.clip((offset * chord).sum(axis=2) / square, 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * chord, axis=2).min(axis=1))


def dense(path: Path, step: float) -> Array:
    """Points of a path, at most a step apart."""
    counts = np.ceil(path.lengths / step).astype(int)
    index = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[index]
    return np.vstack([path.at(index, share * path.lengths[index])[0], np.asarray(path.segments[-1].end)])


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("deviation", [2e-5, 5e-5])
def test_every_chord_is_within_the_deviation_of_the_smooth_path_and_vice_versa(name: str, deviation: float) -> None:
    path = PATHS[name]
    if "noise" in name:
        deviation = max(deviation, 4e-5)
    result = fitted(path, deviation)
    s = np.union1d(np.linspace(0, result.length, 40_001), result.sample_distances(32))
    points, task = result.at(s).position, dense(path, 5e-5)
    assert distances(points, task).max() <= deviation * (1 + 1e-3)
    assert distances(task, points).max() <= deviation * (1 + 1e-3)
    assert len(result.piece_lengths) < len(path.segments) / 4
    ends = result.at([0.0, result.length]).position
    assert ends == pytest.approx(np.array([path.segments[0].start, path.segments[-1].end]), abs=1e-12)


@pytest.mark.parametrize(("points", "least", "most"), [(rosette, 40, 90), (spiral, 20, 60)])
def test_the_number_of_pieces_follows_the_shape_and_not_the_number_of_points(
    points: Any, least: int, most: int
) -> None:
    counts = [len(fitted(Path.through(points(count))).piece_lengths) for count in (2400, 10_000)]
    assert counts[1] == pytest.approx(counts[0], rel=0.1)
    assert all(least <= count <= most for count in counts)


@pytest.mark.parametrize("name", PATHS)
def test_speed_is_constant_and_curvature_continuous(name: str) -> None:
    path = fitted(PATHS[name])
    s, h = np.linspace(1e-4, path.length - 1e-4, 5001), 1e-6
    for offset in (-2e-5, 0.0, 2e-5):
        s = s[path.curvature(s + offset) < 1e3]  # rounded corners are too sharp for differences
    before, here, after = (path.at(s + k * h) for k in (-1, 0, 1))
    assert np.linalg.norm(here.tangent, axis=1) == pytest.approx(1, abs=1e-12)
    assert (after.position - before.position) / (2 * h) == pytest.approx(here.tangent, abs=1e-6)
    largest = path.curvature(path.sample_distances()).max()
    assert (after.tangent - before.tangent) / (2 * h) == pytest.approx(here.curvature, abs=1e-3)
    assert path.curvature_jumps().max(initial=0.0) <= 1e-9 * (1 + largest)


def test_equal_distances_are_equal_lengths_of_the_curve() -> None:
    path = fitted(PATHS["rosette"])
    ends = np.linspace(0, path.length, 101)
    coarse, fine = (
        np.linalg.norm(np.diff(path.at(np.linspace(0, path.length, 100 * count + 1)).position, axis=0), axis=1)
        .reshape(100, count)
        .sum(axis=1)
        for count in (100, 200)
    )
    steps = (4 * fine - coarse) / 3  # Richardson
    assert steps == pytest.approx(np.diff(ends), rel=1e-9)


def test_corners_remain_and_are_rounded() -> None:
    points = drop(2400)
    result = fit_splines(Path.through(points), DEVIATION)
    assert [type(each) for each in result.path.segments] == [Spline, Spline]
    assert distances(result.path.start[1:], points)[0] < 1e-12
    assert np.degrees(result.path.corner_angles()) == pytest.approx(
        np.degrees(Path.through(drop(100)).corner_angles().min()), abs=4
    )
    path = smooth(result.path, deviation=result.deviation)
    assert int((path.piece_blend >= 0).sum()) == 1


@pytest.mark.parametrize("noise", [0.0, 2e-6])
def test_collinear_chords_become_one_line_and_long_lines_stay_exact(noise: float) -> None:
    result = fit_splines(Path.through(raster(2400, noise)), DEVIATION)
    assert [type(each) for each in result.path.segments] == [Line] * 10
    assert result.path.lengths == pytest.approx([0.1, 0.01] * 5, abs=3 * noise + 1e-9)


def test_few_segments_and_coarse_chords_are_left_alone() -> None:
    for path in (
        Path.through(rosette(40)),
        Path.through([(0, 0, 0), (1, 0, 0), (1, 1, 0)]),
        Path(arcs(40).segments[20:24]),
    ):
        result = fit_splines(path, 1e-5)
        assert result.path.segments == path.segments
        assert (result.deviation == 1e-5).all()
        assert result.first.tolist() == list(range(len(path.segments)))


def test_given_corners_remain() -> None:
    path = PATHS["rosette"]
    result = fit_splines(path, DEVIATION, corners=[700, 1500])
    assert result.first.tolist() == [0, 700, 1500]
    assert result.path.start == pytest.approx(path.start[[0, 700, 1500]], abs=1e-12)


@pytest.mark.parametrize("points", [rosette(2400)[:-1], drop(1200)])
def test_the_tool_turns_as_along_the_given_path(points: Array) -> None:
    task = tilted(points)
    assert any(isinstance(each, Spline) for each in fit_splines(task, DEVIATION).path.segments)
    path = fitted(task)
    s = np.linspace(0, path.length, 4001)
    nearest = cKDTree(points).query(path.at(s).position, k=1)[1]
    expected = Rotation.from_quat(np.vstack([task.orientation, path.turn([path.length]).quaternion]), scalar_first=True)
    actual = Rotation.from_quat(path.turn(s).quaternion, scalar_first=True)
    per_point = (expected[:-1].inv() * expected[1:]).magnitude().max()
    assert (expected[nearest].inv() * actual).magnitude().max() <= 1e-3 + 2 * per_point
    inner, h = s[1:-1], 1e-6
    before, here, after = (path.turn(inner + k * h) for k in (-1, 0, 1))
    rate = Rotation.from_quat(after.quaternion, scalar_first=True)
    rate *= Rotation.from_quat(before.quaternion, scalar_first=True).inv()
    assert rate.as_rotvec() / (2 * h) == pytest.approx(here.rate, abs=1e-5 * np.abs(here.rate).max())
    at, step = path.bounds[1:-1], 1e-10 * path.length
    left, right = path.turn(at - step), path.turn(at + step)
    for order in range(3):
        slope = max(np.abs(left[order + 1]).max(), np.abs(right[order + 1]).max())
        size = 1 + np.abs(left[order]).max()
        assert np.abs(right[order] - left[order]).max() <= 4 * step * slope + 1e-9 * size


def test_orientation_tolerance_is_kept_at_every_point() -> None:
    points = rosette(1200)
    task = tilted(points)
    spline = fit_splines(task, DEVIATION, angle=1e-4).path
    path = smooth(spline, deviation=DEVIATION)
    share = np.concatenate([[0.0], np.cumsum(task.lengths)]) / task.length
    turns = np.vstack([task.orientation, path.turn([path.length]).quaternion])
    expected = Slerp(share, Rotation.from_quat(turns, scalar_first=True))
    s = np.linspace(0, 1, 2001)
    actual = Rotation.from_quat(path.turn(s * path.length).quaternion, scalar_first=True)
    # shares of the two lengths differ slightly, by which the tool turns at most 20 rad/m
    assert (expected(s).inv() * actual).magnitude().max() <= 1e-4 + 20 * DEVIATION


def test_functions_of_casadi_are_those_of_numpy() -> None:
    path = fitted(tilted(drop(1200)))
    s = np.union1d(np.linspace(0, path.length, 301), path.bounds)
    for function, values in ((path_function(path), path.at(s)), (turn_function(path), path.turn(s))):
        for column, value in zip(function.map(len(s))(s), values, strict=True):
            scale = 1 + np.abs(value).max()
            np.testing.assert_allclose(np.array(column).T, value, rtol=0, atol=1e-9 * scale)


def test_a_fitted_path_that_is_placed_is_the_same_elsewhere() -> None:
    path = fit_splines(tilted(drop(1200)), DEVIATION).path
    turn, shift = Rotation.from_rotvec([0.3, -0.5, 0.9]), np.array([0.1, -2.0, 0.4])
    there = path.placed(shift, turn.as_quat(scalar_first=True))
    index, distance = np.zeros(50, dtype=int), np.linspace(0, path.lengths[0], 50)
    assert there.at(index, distance)[0] == pytest.approx(turn.apply(path.at(index, distance)[0]) + shift, abs=1e-12)
    own, moved = path.turn_at(index, distance)[0], there.turn_at(index, distance)[0]
    expected = turn * Rotation.from_quat(own, scalar_first=True)
    assert (expected.inv() * Rotation.from_quat(moved, scalar_first=True)).magnitude().max() < 1e-12
