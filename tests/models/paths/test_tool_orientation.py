"""Tool orientation along smooth paths: unit quaternions, rates against differences, smooth through blends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import Line, ModelError, Path, smooth
from models.paths.segments import rotation_vector
from tests.models.paths.task_paths import product, random_path, seeds, turned

few = settings(max_examples=40)

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap


def between(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vector in world that leads from one quaternion to the other, rows."""
    inverse = first * [1, -1, -1, -1]
    turns = np.array([product(b, a) for a, b in zip(inverse, second, strict=True)])
    turns *= np.sign(turns[:, :1])
    return np.asarray(2 * turns[:, 1:])  # small


@few
@given(seeds, st.integers(1, 6))
def test_rates_are_those_of_the_quaternion(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    path = smooth(random_path(rng, count, turns=True, helices=0.2), 0.08)
    s = path.bounds[:-1] + rng.uniform(0.05, 0.95, len(path.piece_lengths)) * path.piece_lengths
    h = 1e-5 * path.piece_lengths
    before, here, after = (path.turn(s + k * h) for k in (-1, 0, 1))
    assert np.linalg.norm(here.quaternion, axis=1) == pytest.approx(1, abs=1e-13)
    # of each piece to its own scale, pieces differ by orders of magnitude
    length = path.piece_lengths[:, None]
    rate = between(before.quaternion, after.quaternion) / (2 * h[:, None])
    assert rate * length == pytest.approx(here.rate * length, abs=1e-5)
    for order, power in ((1, 2), (2, 3)):
        difference = (after[order] - before[order]) / (2 * h[:, None])
        assert difference * length**power == pytest.approx(here[order + 1] * length**power, abs=1e-5)


@few
@given(seeds, st.integers(2, 6))
def test_orientation_rate_and_acceleration_are_continuous_through_blends(seed: int, count: int) -> None:
    path = smooth(random_path(np.random.default_rng(seed), count, turns=True, helices=0.2), 0.08)
    at, step = path.bounds[1:-1], 1e-10 * path.length
    before, after = path.turn(at - step), path.turn(at + step)
    for order in range(3):
        change = np.abs(after[order] - before[order]).max(axis=1)
        slope = np.maximum(np.abs(before[order + 1]).max(axis=1), np.abs(after[order + 1]).max(axis=1))
        assert (change <= 4 * step * slope + 1e-11 * (1 + np.abs(before[order]).max())).all()


@given(seeds)
def test_a_segment_rotates_the_tool_uniformly_by_the_smaller_angle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, vector = turned(rng.normal(size=3)), rng.normal(size=3)
    vector *= rng.uniform(0, 3) / np.linalg.norm(vector)
    last = product(first, turned(vector)) * rng.choice([-1, 1])  # the sign of a quaternion says nothing
    path = smooth(Path((Line((0, 0, 0), (0, 0, 2), first, last),)), 0.1)
    shares = np.linspace(0, 1, 7)
    turn = path.turn(2 * shares)
    for share, quaternion in zip(shares, turn.quaternion, strict=True):
        assert abs(quaternion @ product(first, turned(share * vector))) == pytest.approx(1, abs=1e-14)
    assert np.linalg.norm(turn.rate, axis=1) == pytest.approx(np.linalg.norm(vector) / 2, abs=1e-12)
    assert rotation_vector(first, last) == pytest.approx(vector, abs=1e-12)


def test_a_tool_without_rotation_keeps_its_orientation() -> None:
    tool = turned((0.3, -0.2, 0.9))
    path = smooth(Path((Line((0, 0, 0), (1, 0, 0), tool), Line((1, 0, 0), (1, 1, 0)))), 0.1)
    turn = path.turn(np.linspace(0, path.length, 9))
    assert turn.quaternion == pytest.approx(np.tile(tool, (9, 1)), abs=1e-15)
    assert not turn.rate.any()


def test_a_blend_that_would_turn_the_tool_more_than_a_turn_is_a_named_error() -> None:
    # even rates of nearly half a turn on both sides, all of it inside the blend
    points, tools = [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [turned((0, 0, 0)), turned((3, 0, 0)), turned((0, 0, 0))]
    smooth(Path.through(points, tools), 0.3)
    with pytest.raises(ModelError, match="shape"):
        Path.through(points, tools[:2])
