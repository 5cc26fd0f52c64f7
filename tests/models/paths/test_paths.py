"""Smooth paths against the closed forms and the example of Lee, Ryu, Cheong 2006, checked numbers."""

from __future__ import annotations

import numpy as np
import pytest

from models import Arc, Line, ModelError, Path, SmoothPath, smooth
from models.paths import gamma
from models.paths.blends import curvature
from tests.models.paths.task_paths import peak_curvature

MM = 1e-3


def example(kind: str) -> SmoothPath:
    """The paper's SCARA path: line, line, arc; remaining distance 150 mm."""
    first = Line(np.array([700.0, 0.0, 50.0]) * MM, np.array([300.0, 0.0, 50.0]) * MM)
    second = Line(np.array([300.0, 0.0, 50.0]) * MM, np.array([300.0, 650.0, 0.0]) * MM)
    points = np.array([[300.0, 650.0, 0.0], [0.0, 650.0, 50.0], [-372.0, 650.0, 50.0]]) * MM
    return smooth(Path((first, second, Arc.through(*points))), 150 * MM, kind=kind)  # type: ignore[arg-type]


def test_the_lengths_of_the_example_are_those_checked() -> None:
    expected = np.array([250.0, 270.32146, 351.92024, 269.65284, 526.93047])
    path = example("cubic")
    assert np.asarray(path.piece_lengths) / MM == pytest.approx(expected, abs=1e-5)
    assert path.length / MM == pytest.approx(1668.82501, abs=1e-5)


@pytest.mark.parametrize(("shape", "angle", "value"), [(1.0, 90, 0.530), (1.0, 45, 0.693), (1.5, 90, 0.4419)])
def test_the_distance_of_a_blend_from_its_corner(shape: float, angle: float, value: float) -> None:
    assert gamma(shape, np.radians(angle)) == pytest.approx(value, abs=5e-4)


def test_curvatures_at_shape_three() -> None:
    corner = Path.through([(-1, 0, 0), (0, 0, 0), (-np.cos(np.radians(70.0)), np.sin(np.radians(70.0)), 0)])
    curve = smooth(corner, 0.5, kind="cubic", shape=3.0).coefficients[0]
    assert curvature(curve, np.array([0.0, 1.0])) == pytest.approx(0.0, abs=1e-13)
    assert peak_curvature(3.0, np.radians(90.0), 1.0) == pytest.approx(3.771, abs=1e-3)
    assert peak_curvature(3.0, np.radians(45.0), 1.0) == pytest.approx(16.82, abs=1e-2)


def test_the_quintic_blend_keeps_the_curvature_continuous_where_the_cubic_does_not() -> None:
    cubic = np.asarray(example("cubic").curvature_jumps()) * MM
    quintic = np.asarray(example("quintic").curvature_jumps()) * MM
    assert np.max(cubic) == pytest.approx(3.25e-4, rel=0.01)
    assert np.max(quintic) < 1e-12


def test_a_path_with_a_gap_is_a_named_error() -> None:
    with pytest.raises(ModelError, match=r"gap|begins|meet|end"):
        Path((Line((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), Line((1.1, 0.0, 0.0), (1.1, 1.0, 0.0))))


def test_a_doubled_last_point_counts_once() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]])
    assert Path.through(points[[0, 1, 2, 2]]).lengths == pytest.approx([1.0, 1.0])
    with pytest.raises(ModelError, match="length 0"):
        Path.through(points[[2, 2]])


@pytest.mark.parametrize("twice", [0, 1])
def test_a_repeated_point_is_named_by_its_number(twice: int) -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]])
    with pytest.raises(ModelError, match=rf"points\[{twice}\] to points\[{twice + 1}\]: .*length 0") as caught:
        Path.through(np.insert(points, twice, points[twice], axis=0))
    assert caught.value.name == f"points[{twice + 1}]"
