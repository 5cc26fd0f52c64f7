"""Distances of convex hulls: closed forms, a convex program, and what must not change them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from models.shapes.hull import gap_along, is_box, nearest_directions
from ocp.problem.hulls import BodyPairs, Frames, Hull, frames_of, group_pairs

CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2.0


def turns(rng: np.random.Generator, count: int) -> np.ndarray:
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return np.asarray(q * np.sign(np.linalg.det(q))[:, None, None])


def separation(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances, after it is shown that nothing nearer nor farther is possible."""
    n, here, there = nearest_directions(one, other)
    assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-12)
    gap = gap_along(n, one, other)
    apart = gap > 0
    # a lower bound that is met by two points: the distance
    assert_allclose(np.linalg.norm(there - here, axis=1)[apart], gap[apart], atol=1e-10)
    return gap


@pytest.mark.parametrize(("m", "k"), [(1, 1), (1, 2), (2, 2), (2, 8), (8, 8), (5, 30), (40, 3)])
def test_the_gap_is_met_by_two_points(m: int, k: int) -> None:
    rng = np.random.default_rng(m * 100 + k)
    one, other = rng.normal(size=(400, m, 3)), rng.normal(size=(400, k, 3)) + 3 * rng.normal(size=(400, 1, 3))
    gap = separation(one, other)
    assert (gap > 0).sum() > 200
    n, here, there = nearest_directions(one, other)
    back, there_again, here_again = nearest_directions(other, one)
    assert_allclose(gap_along(back, other, one)[gap > 0], gap[gap > 0], atol=1e-9)
    # both points are of the hulls: no direction leads past them
    for points, hull in ((here, one), (there, other)):
        for d in rng.normal(size=(20, 3)):
            assert np.all(points @ d <= (hull @ d).max(axis=1) + 1e-9)
    del n, there_again, here_again


def test_a_segment_beside_a_box_is_as_near_as_beside_the_hull_of_its_corners() -> None:
    """Turned boxes of all sizes, segments that are short, long, along an edge, across, or points."""
    rng = np.random.default_rng(11)
    sizes = 10.0 ** rng.uniform(-2, 1, (500, 1, 3))
    boxes = CORNERS * sizes @ turns(rng, 500) + rng.normal(size=(500, 1, 3))
    rods = rng.normal(size=(500, 2, 3)) * 10.0 ** rng.uniform(-1, 1, (500, 1, 1))
    rods[:50, 1] = rods[:50, 0]
    rods[50:100, 1] = rods[50:100, 0] + 2 * (boxes[50:100, 1] - boxes[50:100, 0])
    assert is_box(boxes[0])
    assert not is_box(boxes[0][::-1][[1, 0, *range(2, 8)]])
    known = separation(rods, boxes)
    path, here, there = nearest_directions(rods, boxes, (False, True))
    gap = gap_along(path, rods, boxes)
    assert ((known > 0) == (gap > 0)).all()
    assert_allclose(gap[known > 0], known[known > 0], atol=1e-9)
    back, there_again, here_again = nearest_directions(boxes, rods, (True, False))
    for one, other in ((back, -path), (here_again, here), (there_again, there)):
        assert_allclose(one[known > 0], other[known > 0], atol=1e-12)


def test_boxes_that_are_placed_side_by_side() -> None:
    shifts = np.array([[3.0, 0, 0], [0, 1.5, 0.2], [2, 2, 0.3], [2, 2, 2], [0.1, 0.1, 1.0 + 1e-6]])
    exact = np.linalg.norm(np.maximum(np.abs(shifts) - 1, 0), axis=1)
    one = np.tile(CORNERS, (5, 1, 1))
    assert_allclose(separation(one, one + shifts[:, None]), exact, atol=1e-9)


def test_boxes_that_overlap_do_so_by_the_least_shift() -> None:
    shifts = np.array([[0.9, 0, 0], [0.2, 0.7, 0.1], [0.0, 0.0, 0.0]])
    one = np.tile(CORNERS, (3, 1, 1))
    assert_allclose(separation(one, one + shifts[:, None]), [-0.1, -0.3, -1.0], atol=1e-12)


def test_a_corner_within_a_face_overlaps_along_its_normal() -> None:
    """By 0.1, whichever of the two is named first; the face is wide, and its middle beside the corner."""
    normal = np.ones(3) / np.sqrt(3)
    turn = np.linalg.qr(np.column_stack([normal, [1.0, 0, 0], [0, 1.0, 0]]))[0]
    turn[:, 0] = normal
    place = normal * (0.5 * np.sqrt(3) - 0.1 + 2.0) + 0.7 * turn[:, 1]
    block = place + (4 * CORNERS) @ turn.T
    for one, other in ((CORNERS, block), (block, CORNERS)):
        assert_allclose(separation(one[None], other[None]), [-0.1], atol=1e-12)


@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
@settings(max_examples=30, deadline=None)
def test_moved_and_scaled_together(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    one, other = rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 6, 3)) + 4 * rng.normal(size=(5, 1, 3))
    gap = separation(one, other)
    turn, shift = turns(rng, 1)[0], rng.normal(size=3)
    moved = [scale * (part @ turn.T + shift) for part in (one, other)]
    far = gap > 1e-3
    assert_allclose(separation(*moved)[far], scale * gap[far], rtol=1e-7)


@pytest.mark.parametrize("power", [-30, -10, 10])
def test_the_unit_of_length_does_not_matter(power: int) -> None:
    """Of hulls apart and within each other: the same directions, gaps by the same factor."""
    rng = np.random.default_rng(4)
    one, other = rng.normal(size=(60, 6, 3)), rng.normal(size=(60, 7, 3)) + rng.normal(size=(60, 1, 3))
    scale = 2.0**power
    gap = separation(one, other)
    assert min((gap < 0).sum(), (gap > 0).sum()) > 15
    assert_allclose(separation(scale * one, scale * other) / scale, gap, atol=1e-14)


def test_the_penetration_direction_has_the_least_overlap() -> None:
    rng = np.random.default_rng(5)
    one, other = rng.normal(size=(80, 20, 3)), rng.normal(size=(80, 30, 3)) + 0.3 * rng.normal(size=(80, 1, 3))
    gap, middles = separation(one, other), other.mean(axis=1) - one.mean(axis=1)
    assert (gap < 0).all()
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    assert (gap >= np.maximum(gap_along(middles, one, other), gap_along(-middles, one, other)) - 1e-12).all()


def test_against_a_convex_program() -> None:
    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(12, 5, 3)), rng.normal(size=(12, 7, 3)) + 3
    gaps = separation(one, other)
    for a, b, gap in zip(one, other, gaps, strict=True):
        if gap <= 0:
            continue

        def square(w: np.ndarray, a: np.ndarray = a, b: np.ndarray = b) -> float:
            return float(((w[:5] @ a - w[5:] @ b) ** 2).sum())

        rows = [{"type": "eq", "fun": lambda w: w[:5].sum() - 1}, {"type": "eq", "fun": lambda w: w[5:].sum() - 1}]
        start = np.r_[np.full(5, 0.2), np.full(7, 1 / 7)]
        best = minimize(square, start, bounds=[(0, 1)] * 12, constraints=rows, options={"ftol": 1e-14})
        assert_allclose(np.sqrt(best.fun), gap, rtol=1e-5)


def test_points_that_coincide_and_lines_that_are_parallel() -> None:
    one = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [1, 0, 0]]], dtype=float)
    other = np.array([[[0, 2, 0], [1, 2, 0]], [[0, 0, 3], [0, 0, 3]], [[3, 0, 0], [5, 0, 0]]], dtype=float)
    assert_allclose(separation(one, other), [2, 3, 2], atol=1e-12)


def test_balls_about_bodies_are_no_farther_apart_than_the_bodies() -> None:
    """Bodies on frames at random, their points far from the origins of these, seen from world and from each other."""
    rng = np.random.default_rng(6)
    hulls = [
        Hull(k - 1, rng.normal(size=(m, 3)) * 0.3 + rng.normal(size=3), 0.1 * k) for k, m in enumerate((1, 2, 5, 8))
    ]
    ground = Hull(-1, np.array([[0.3, 0.1, -2.0]]), 0.0, np.array([0.0, 0.6, 0.8]))
    pairs = np.array([[0, 1, -1], [1, 2, -1], [3, 2, 1], [0, 3, 0], [1, 3, 2], [4, 2, -1], [3, 4, -1]])
    places = np.concatenate([np.swapaxes(turns(rng, 150), 1, 2).reshape(-1, 9), rng.normal(size=(150, 3))], axis=1)
    frames = frames_of(places.reshape(50, 36))
    bodies = BodyPairs([*hulls, ground], pairs, {})
    together = [bodies.balls(frames, np.arange(50), np.full(50, pair)) for pair in range(len(pairs))]
    assert_allclose(bodies.all_balls(frames), np.transpose(together), atol=1e-12)
    for kind in group_pairs([*hulls, ground], pairs):
        for pair in np.flatnonzero(kind.has):
            one, other = ([*hulls, ground][k] for k in pairs[pair, :2])
            at, row = np.arange(50), np.full(50, kind.row[pair])
            path, gap, points = kind.nearest(frames, at, row)
            apart = bodies.balls(frames, at, np.full(50, pair))
            widths = sum(np.linalg.norm(hull.core[:, None] - hull.core, axis=2).max() for hull in (one, other))
            assert (apart <= gap + 1e-9).all()
            assert kind.flat[row[0]] or (apart >= np.maximum(gap, -one.radius - other.radius) - widths - 1e-9).all()
            assert_allclose(kind.gaps(path, frames, at, row), gap, atol=1e-12)
            sides = placed(frames, one), placed(frames, other)
            if not (one.normal.size or other.normal.size):
                known = gap_along(nearest_directions(*sides)[0], *sides) - one.radius - other.radius
                assert_allclose(gap[known > 0], known[known > 0], atol=1e-9)
            else:
                body = sides[1] if one.normal.size else sides[0]
                known = ((body - ground.core[0]) @ ground.normal).min(axis=1) - one.radius - other.radius
                assert_allclose(gap, known, atol=1e-9)
            assert points.shape == (50, 2, 3)


def placed(frames: Frames, hull: Hull) -> np.ndarray:
    """Points of a body in world. Shape (M, m, 3)."""
    turned = hull.core @ np.swapaxes(frames.rotations[:, hull.frame], 1, 2)
    return np.asarray(turned + frames.positions[:, hull.frame][:, None])
