"""Expressions at many samples are what they are one by one, whatever of them is zero."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp.problem.values import Sampler


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("count", [1, 31, 32, 700])
def test_samples_are_those_of_the_expressions_with_their_zeros(symbols: Any, count: int) -> None:
    rng = np.random.default_rng(count)
    x, y = symbols.sym("x", 2), symbols.sym("y")
    mixed = ca.vertcat(symbols(1, 1), x[1] * y, symbols(0.0), ca.sin(x[0]))
    outputs = [symbols(1, 1), mixed, symbols(0, 1), symbols(2, 2), ca.jacobian(x[0] ** 2 + y, x), symbols(3.0)]
    _ = [np.full(5000, 1e300) for _ in range(20)]  # what memory may hold
    sampler = Sampler([x, y], outputs)
    values = rng.normal(size=(count, 2)), rng.normal(size=(count, 1))
    result = sampler(*values)
    expected = [
        np.zeros((count, 1)),
        np.column_stack([0 * values[1], values[0][:, 1:] * values[1], 0 * values[1], np.sin(values[0][:, :1])]),
        np.zeros((count, 0)),
        np.zeros((count, 4)),
        np.column_stack([2 * values[0][:, 0], np.zeros(count)]),
        np.full((count, 1), 3.0),
    ]
    for own, wanted in zip(result, expected, strict=True):
        np.testing.assert_allclose(own, wanted, atol=1e-15)
