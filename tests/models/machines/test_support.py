from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from models import ModelError, Support, rectangle
from tests.models.robot.trees import few, numeric, seeds


@given(seeds, st.integers(3, 12), st.booleans())
@few
def test_distances_and_margin_are_those_of_the_hull_of_the_corners(seed: int, count: int, clockwise: bool) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 2))
    hull = ConvexHull(points)
    corners = points[hull.vertices][::-1] if clockwise else points[hull.vertices]
    support = Support(corners)
    assert support.area == pytest.approx(hull.volume)
    for point in rng.normal(size=(5, 2)):
        expected = -(hull.equations[:, :2] @ point + hull.equations[:, 2])
        np.testing.assert_allclose(np.sort(numeric(support.distances(point)).ravel()), np.sort(expected), atol=1e-12)
        assert float(ca.DM(support.margin(point))) == pytest.approx(expected.min(), abs=1e-12)


def test_a_rectangle_has_its_closed_form() -> None:
    support = rectangle((-0.05, 0.05), (-0.1, 0.2))
    np.testing.assert_allclose(support.center, [0.0, 0.05])
    np.testing.assert_allclose(support.half_widths, [0.05, 0.15])
    np.testing.assert_allclose(numeric(support.distances((0.01, 0.12))).ravel(), [0.22, 0.04, 0.08, 0.06])
    assert float(support.margin((0.0, 0.21))) == pytest.approx(-0.01)


def test_the_inner_radius_has_its_closed_forms() -> None:
    assert rectangle((-0.05, 0.05), (-0.1, 0.2)).inner_radius == pytest.approx(0.05)
    assert Support([(0, 0), (3, 0), (0, 4)]).inner_radius == pytest.approx(1.0)
    angles = np.linspace(0, 2 * np.pi, 8)[:-1] + 0.1
    regular = Support(np.column_stack([np.cos(angles), np.sin(angles)]))
    assert regular.inner_radius == pytest.approx(np.cos(np.pi / 7))


@given(seeds, st.integers(3, 9))
@few
def test_no_point_has_a_margin_above_the_inner_radius(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 2))
    support = Support(points[ConvexHull(points).vertices])
    margins = [float(ca.DM(support.margin(rng.dirichlet(np.ones(count)) @ points))) for _ in range(50)]
    assert max(margins) <= support.inner_radius + 1e-12
    assert 2 * support.inner_radius <= support.half_widths.min() * 2 + 1e-12


def test_corners_on_a_straight_edge_are_dropped() -> None:
    support = Support([(0, 0), (1, 0), (2, 0), (2, 1), (0, 1)])
    assert support.vertices.tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]
    assert support.area == pytest.approx(2.0)


def test_the_margin_is_symbolic_too() -> None:
    support = rectangle((-1, 1), (-1, 1))
    for symbols in (ca.SX, ca.MX):
        point = symbols.sym("point", 2)
        assert float(ca.Function("margin", [point], [support.margin(point)])([0.2, -0.7])) == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([(0, 0), (2, 0), (1, 0.5), (2, 2), (0, 2)], r"is not convex at \[1.0, 0.5\]"),
        ([(0, 0), (1, 1), (2, 2)], "has no area"),
        ([(0, 0), (0, 0), (0, 0)], "has no area"),
        ([(0, 0), (1, 1)], r"expected \(corners, 2\), 3 at least"),
        ([(0, 0, 0), (1, 1, 0), (1, 0, 0)], "has shape"),
        ("square", "vertices 'square' is not numeric"),
        ([(0, 0), (1, 0), (0, 1), "corner"], "vertices .* is not numeric"),
        ([(0, 0), (1, 0), (1, 0), (1, 1)], r"corner \[1.0, 0.0\] occurs twice"),
        ([(0, 0), (1, 0), (np.nan, 1)], "not finite"),
        ([(np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5)) for k in range(5)], "crosses itself"),
    ],
)
def test_a_polygon_that_carries_no_foot_is_refused(vertices: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Support(vertices)


def test_a_rectangle_without_a_side_is_refused() -> None:
    with pytest.raises(ModelError, match=r"rectangle: y from 0.2 to 0.2 m"):
        rectangle((0, 1), (0.2, 0.2))
