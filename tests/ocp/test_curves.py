"""Piecewise polynomials kept as values at nodes."""

from __future__ import annotations

from functools import partial

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from ocp.curves import PiecewisePolynomial, differentiation_matrix, integrator, lagrange, rk4_step
from tests.ocp.problems import Array, order

DEGREES = range(1, 11)


def nodes_of(count: int, scheme: str) -> Array:
    """Nodes as transcriptions use them: collocation points, with or without the start of the interval."""
    points = np.array(ca.collocation_points(min(count, 9), scheme))
    return np.concatenate([[0.0], points]) if count > 1 else points


@pytest.mark.parametrize("scheme", ["radau", "legendre"])
@pytest.mark.parametrize("count", DEGREES)
@given(data=st.data())
@settings(max_examples=25)
def test_polynomials_up_to_the_degree_are_reproduced(count: int, scheme: str, data: st.DataObject) -> None:
    nodes = nodes_of(count, scheme)
    coefficients = data.draw(st.lists(st.floats(-3.0, 3.0), min_size=len(nodes), max_size=len(nodes)))
    at = np.array(data.draw(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8)))
    curve = Polynomial(coefficients)
    np.testing.assert_allclose(lagrange(nodes, at) @ curve(nodes), curve(at), atol=1e-10)
    np.testing.assert_allclose(differentiation_matrix(nodes) @ curve(nodes), curve.deriv()(nodes), atol=1e-8)


@pytest.mark.parametrize("count", DEGREES)
def test_basis_is_one_at_its_node_and_sums_to_one(count: int) -> None:
    nodes = nodes_of(count, "radau")
    np.testing.assert_array_equal(lagrange(nodes, nodes), np.eye(len(nodes)))
    at = np.concatenate([np.linspace(0.0, 1.0, 23), nodes + 1e-16, nodes - 1e-16])
    np.testing.assert_allclose(lagrange(nodes, at).sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(differentiation_matrix(nodes).sum(axis=1), 0.0, atol=1e-9)


@given(gap=st.floats(1e-300, 1e-9), node=st.integers(0, 3), values=st.lists(st.floats(-5, 5), min_size=4, max_size=4))
def test_values_next_to_a_node_are_those_of_the_node(gap: float, node: int, values: list[float]) -> None:
    nodes = nodes_of(3, "radau")
    near = np.clip(nodes[node] + np.array([gap, -gap]), 0.0, 1.0)
    expected = np.full(2, values[node])
    np.testing.assert_allclose(lagrange(nodes, near) @ np.array(values), expected, atol=1e-6)


def stairs() -> PiecewisePolynomial:
    """Two pieces with a jump: 1 + s on the first, 5 - s on the second."""
    return PiecewisePolynomial(
        np.array([0.0, 0.25, 1.0]), np.array([0.0, 1.0]), np.array([[[1.0], [2.0]], [[5.0], [4.0]]])
    )


def test_breaks_belong_to_the_right_and_ends_are_held() -> None:
    at = np.array([-1.0, 0.0, 0.125, 0.25, 0.625, 1.0, 2.0])
    np.testing.assert_allclose(stairs()(at)[:, 0], [1.0, 1.0, 1.5, 5.0, 4.5, 4.0, 4.0])


def test_both_sides_of_a_break_can_be_evaluated() -> None:
    np.testing.assert_allclose(stairs().within(np.array([0, 1]), np.array([1.0, 0.0]))[:, 0], [2.0, 5.0])


def test_one_node_makes_a_piecewise_constant() -> None:
    held = PiecewisePolynomial(np.array([0.0, 0.5, 1.0]), np.array([0.5]), np.array([[[1.0, 2.0]], [[3.0, 4.0]]]))
    np.testing.assert_array_equal(held(np.array([0.0, 0.49, 0.5, 1.0])), [[1, 2], [1, 2], [3, 4], [3, 4]])
    assert held(np.zeros(0)).shape == (0, 2)


def test_no_entries_are_interpolated_too() -> None:
    nothing = PiecewisePolynomial(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.zeros((1, 2, 0)))
    assert nothing(np.linspace(0, 1, 5)).shape == (5, 0)


def swung(t: float, x: Array) -> Array:
    """x0' = x1, x1' = -x0 + cos 2t; from (1, 0): x0 = (4 cos t - cos 2t) / 3."""
    return np.array([x[1], -x[0] + np.cos(2 * t)])


def from_place(begin: float, h: float, place: float, x: Array) -> Array:
    return swung(begin + place * h, x)


def test_runge_kutta_steps_are_of_the_fourth_order() -> None:
    widths, errors = np.array([0.2, 0.1, 0.05]), []
    for h in widths:
        x = np.array([1.0, 0.0])
        for begin in h * np.arange(round(1.0 / h)):
            x = rk4_step(partial(from_place, begin, h), x, h)
        errors.append(abs(x[0] - (4 * np.cos(1.0) - np.cos(2.0)) / 3))
    assert order(widths, np.array(errors)) == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("smooth", [True, False])
def test_integrators_keep_their_tolerance(smooth: bool) -> None:
    x, t = ca.SX.sym("x", 2), ca.SX.sym("t")
    dae = {"x": x, "t": t, "ode": ca.vertcat(x[1], -x[0] + ca.cos(2 * t)), "quad": x[0]}
    places = np.array([0.5, 1.0, 2.0])
    result = integrator("swung", dae, places.tolist(), smooth=smooth)(x0=[1.0, 0.0])
    np.testing.assert_allclose(result["xf"].full()[0], (4 * np.cos(places) - np.cos(2 * places)) / 3, atol=1e-9)
    np.testing.assert_allclose(result["qf"].full()[0], (4 * np.sin(places) - np.sin(2 * places) / 2) / 3, atol=1e-9)
