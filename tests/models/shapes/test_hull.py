"""Convex hulls: of the points and of no more, whatever lies within them, wherever they are and however large."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import ModelError
from models import files as cache
from models.shapes import hull as hull_module
from models.shapes.hull import cached_hull, convex_hull

CUBE = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
seeds = st.integers(0, 2**32 - 1)


def cloud(seed: int, count: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


@settings(max_examples=30)
@given(seeds, st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_the_half_spaces_contain_all_points_and_each_supports_three(seed: int, size: float, shift: float) -> None:
    points = size * (cloud(seed) + shift)
    hull = convex_hull(points)
    heights = points @ hull.normals.T - hull.offsets
    slack = 1e-12 * np.abs(points).max()
    assert heights.max() <= slack
    assert (np.sort(heights, axis=0)[-3:] >= -1e-9 * size - 3 * slack).all()
    assert {tuple(vertex) for vertex in hull.vertices} <= {tuple(point) for point in points}
    np.testing.assert_allclose(np.linalg.norm(hull.normals, axis=1), 1, atol=1e-12)


@settings(max_examples=30)
@given(seeds)
def test_faces_close_around_the_points_counter_clockwise(seed: int) -> None:
    """Each edge is run once in each direction, and the volumes over the faces (Gauss) are that of the half-spaces."""
    points = cloud(seed)
    hull = convex_hull(points)
    edges = [(int(a), int(b)) for face in hull.faces for a, b in zip(face, np.roll(face, -1), strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    assert len(hull.vertices) - len(edges) // 2 + len(hull.faces) == 2
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    assert ((np.cross(b - a, c - a) * (a - points.mean(axis=0))).sum(axis=1) > 0).all()


@settings(max_examples=30)
@given(seeds)
def test_interior_points_do_not_change_a_hull(seed: int) -> None:
    rng, points = np.random.default_rng(seed), cloud(seed)
    shares = rng.dirichlet(np.ones(len(points)), 200)
    more = convex_hull(rng.permutation(np.concatenate([points, shares @ points, points])))
    known = convex_hull(points)
    directions = rng.normal(size=(50, 3))
    supports = [(hull.vertices @ directions.T).max(axis=0) for hull in (more, known)]
    np.testing.assert_allclose(supports[0], supports[1], atol=1e-12)


def test_a_cube_has_eight_corners_and_six_normals() -> None:
    inside = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    hull = convex_hull(np.concatenate([CUBE, inside]))
    assert (len(hull.vertices), len(hull.faces), len(hull.normals)) == (8, 12, 6)
    np.testing.assert_allclose(np.sort(np.abs(hull.normals), axis=1)[:, 2], 1.0)
    np.testing.assert_allclose(hull.offsets, 1.0, atol=1e-12)


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_points_without_a_volume_are_refused(rank: int) -> None:
    flat = cloud(1)[:, :rank] @ cloud(2, rank) + 0.3
    with pytest.raises(ModelError, match="coplanar") as caught:
        convex_hull(flat)
    assert (caught.value.name, caught.value.value) == ("vertices", 40)


def test_ctrl_c_ends_the_wait_for_a_hull_that_is_still_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def endless(points: np.ndarray) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        ended.wait()

    monkeypatch.setattr(hull_module, "_convex_hull", endless)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            convex_hull(CUBE)
    finally:
        signal.signal(signal.SIGINT, before)
        ended.set()


@pytest.mark.parametrize("contents", [None, "", "{}", "[[], [], [], []]", "[1, 2, 3, 4]"])
def test_a_cached_hull_is_the_computed_one(
    contents: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    points = np.random.default_rng(0).normal(size=(100, 3))
    expected = convex_hull(points)
    for _ in range(2):
        result = cached_hull(points)
        for name in ("vertices", "faces", "normals", "offsets"):
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
        (file,) = tmp_path.rglob("*.json")
        if contents is not None:
            cache.store_value(file.stem, json.loads(contents or "null"))
    with monkeypatch.context() as patch:
        patch.setattr(hull_module, "convex_hull", None)
        if contents is None:  # the second call computed nothing
            cached_hull(points)
    with pytest.raises(ModelError, match="coplanar"):
        cached_hull(points * [1.0, 1.0, 0.0])
