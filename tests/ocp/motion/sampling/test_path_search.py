"""Paths of a ball among boxes, whose lengths and classes closed forms tell."""

from __future__ import annotations

import numpy as np
import pytest

from models import Box, CollisionScene
from models.checks import Array
from ocp.console import TimeLimitReached, time_limited
from ocp.motion.sampling.joint_paths import (
    StraightMotions,
    optimise_length,
    path_length,
    points_along,
    same_class,
    shorten,
)
from ocp.motion.sampling.path_search import JointPath, PathSearchSettings, TreeSearch, connect, find_paths
from tests.ocp.motion.sampling.sliders import RADIUS, dense, gap, slider

ONES = np.ones(2)
LIMITS = np.full(2, -2.0), np.full(2, 2.0)
HALF = 0.2
"""Half of the thickness of the walls, m."""


def search_of(boxes: list[Box], start: Array = ONES, goals: Array = ONES) -> TreeSearch:
    return TreeSearch(StraightMotions(CollisionScene(slider(), boxes)), start, np.atleast_2d(goals), *LIMITS, ONES)


def paths_among(boxes: list[Box], start: Array, goal: Array, seed: int = 0, classes: int = 8) -> list[JointPath]:
    settings = PathSearchSettings(classes=classes)
    return find_paths(search_of(boxes, start, goal), limits=LIMITS, seed=seed, settings=settings)


def window(centre: float, width: float) -> list[Box]:
    """Return a wall at x = 0 with a window of a width, m."""
    low, high = centre - width / 2, centre + width / 2
    return [
        Box((2 * HALF, low + 3.0, 1.0), (0.0, (low - 3.0) / 2, 0.0)),
        Box((2 * HALF, 3.0 - high, 1.0), (0.0, (3.0 + high) / 2, 0.0)),
    ]


def shortest_over(half_height: float, distance: float) -> float:
    """Return the length of the shortest way of the ball's centre over a box, from -distance to distance at height 0."""
    run = distance - HALF
    hypotenuse = np.hypot(run, half_height)
    slope = np.arctan2(half_height, run) + np.arcsin(RADIUS / hypotenuse)
    return float(2 * (np.sqrt(hypotenuse**2 - RADIUS**2) + RADIUS * slope + HALF))


@pytest.mark.parametrize("seed", range(3))
def test_both_sides_of_a_box_are_classes_of_the_length_that_the_closed_form_says(seed: int) -> None:
    boxes = [Box((2 * HALF, 1.4, 1.0), (0.0, 0.0, 0.0))]
    paths = paths_among(boxes, np.array([-1.0, 0.0]), np.array([1.0, 0.0]), seed)
    assert len(paths) == 2
    heights = [float(points_along(path.joints, ONES, np.array([0.5]))[0, 1]) for path in paths]
    assert min(heights) < -0.7 < 0.7 < max(heights)
    least = shortest_over(0.7, 1.0)
    for path in paths:
        assert gap(dense(path.joints), boxes).min() >= -1e-6
        assert least - 1e-6 <= path.length <= 1.005 * least
        assert path.length == pytest.approx(path_length(path.joints, ONES))


@pytest.mark.parametrize("seed", range(3))
def test_a_window_a_fifth_wider_than_the_ball_is_found_and_a_narrower_one_is_not(seed: int) -> None:
    start, goal = np.array([-1.0, -0.5]), np.array([1.0, 0.8])
    boxes = window(0.4, 2.4 * RADIUS)
    path = paths_among(boxes, start, goal, seed, classes=0)[0]
    assert gap(dense(path.joints), boxes).min() >= -1e-6
    np.testing.assert_array_equal(path.joints[[0, -1]], [start, goal])
    settings = PathSearchSettings(classes=0, attempts=2)
    closed = search_of(window(0.4, 1.9 * RADIUS), start, goal)
    assert not find_paths(closed, limits=LIMITS, seed=seed, settings=settings)
    with time_limited(0.2), pytest.raises(TimeLimitReached):
        find_paths(closed, limits=LIMITS, seed=seed, settings=PathSearchSettings(attempts=100))


def test_a_clear_straight_motion_to_the_nearest_goal_is_the_path() -> None:
    goals = np.array([[1.5, 1.5], [0.5, 1.0], [-1.0, -1.8]])
    boxes = [Box((0.2, 0.2, 1.0), (1.0, -1.0, 0.0))]
    paths = find_paths(search_of(boxes, np.zeros(2), goals), limits=LIMITS, seed=0)
    assert [path.goal for path in paths] == [1, 2, 0]
    for path in paths:
        np.testing.assert_array_equal(path.joints, [np.zeros(2), goals[path.goal]])
        assert path.length == pytest.approx(np.linalg.norm(goals[path.goal]))


def test_the_same_seed_gives_the_same_paths() -> None:
    boxes = window(-0.6, 0.5)
    start, goal = np.array([-1.0, 1.0]), np.array([1.2, 1.0])
    first, again = (paths_among(boxes, start, goal, 5, classes=2) for _ in range(2))
    assert len(first) == len(again)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.joints, other.joints)


@pytest.mark.parametrize("seed", range(4))
def test_shortening_and_optimisation_never_lengthen_and_keep_ends_and_clearance(seed: int) -> None:
    random = np.random.default_rng(seed)
    boxes = [Box((*random.uniform(0.2, 0.7, 2), 1.0), (*random.uniform(-1.2, 1.2, 2), 0.0)) for _ in range(7)]
    free = random.uniform(-2, 2, (200, 2))
    free = free[gap(free, boxes) > 0.02]
    scale = np.array([1.0, 2.0])
    search = search_of(boxes, free[0], free[1])
    path = connect(search, random=random, most_samples=4000)
    assert path is not None
    lengths = [path_length(path, scale)]
    for step in ("shorten", "optimise"):
        path = (
            shorten(search.motions, path, scale, random=random)
            if step == "shorten"
            else optimise_length(search.motions, path, scale, limits=LIMITS)
        )
        lengths.append(path_length(path, scale))
        np.testing.assert_array_equal(path[[0, -1]], free[:2])
        assert gap(dense(path), boxes).min() >= -1e-6
        assert (np.abs(path) <= 2.0 + 1e-9).all()
    assert lengths[0] >= lengths[1] >= lengths[2] >= np.linalg.norm((free[1] - free[0]) * scale) - 1e-12


def test_paths_on_one_side_are_one_class_and_on_two_sides_are_two() -> None:
    motions = search_of([Box((0.4, 0.4, 1.0), (0.0, 0.0, 0.0))]).motions
    over, higher, under = (np.array([[-1.0, 0.0], [0.0, y], [1.0, 0.0]]) for y in (0.8, 1.5, -0.8))
    assert same_class(motions, over, higher, ONES)
    assert not same_class(motions, over, under, ONES)


def test_points_along_a_path_are_at_shares_of_its_length() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]])
    np.testing.assert_allclose(
        points_along(path, ONES, np.array([0.0, 0.25, 0.5, 1.0])), [[0, 0], [1, 0], [1, 1], [1, 3]]
    )
