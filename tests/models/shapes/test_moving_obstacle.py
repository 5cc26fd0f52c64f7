"""Moving obstacles: look-up tables agree with CasADi's, and other functions are refused by name."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import ModelError, MovingObstacle, Sphere
from models.spatial import expand_tables

BALL = Sphere(0.1, (0, 0, 0))


@pytest.mark.parametrize("kind", ["linear", "bspline"])
@pytest.mark.parametrize("count", [4, 7, 60])
@pytest.mark.parametrize("entries", [1, 3])
def test_a_table_that_is_written_out_is_the_table(kind: str, count: int, entries: int) -> None:
    """Inside, at its knots, and beyond its ends, where casadi goes on straight or falls to zero."""
    rng = np.random.default_rng([count, entries])
    knots = np.sort(rng.uniform(-3, 3, count))
    table = ca.interpolant("table", kind, [knots.tolist()], rng.normal(size=count * entries).tolist())
    t = ca.SX.sym("t")
    result = ca.Function("found", [t], [expand_tables(table(2 * t + 1))])
    assert ca.OP_CALL not in {result.instruction_id(k) for k in range(result.n_instructions())}
    times = np.concatenate([(knots[1:-1] - 1) / 2, rng.uniform(-2.5, 1.5, 500)])[None]
    known = np.array(table(2 * times + 1))
    np.testing.assert_allclose(np.array(result(times)), known, rtol=0, atol=1e-9 * np.abs(known).max())


def test_a_table_inside_a_function_of_either_kind_of_symbols_is_found() -> None:
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 0.0])
    t = ca.MX.sym("t")
    path = ca.Function("way", [t], [ca.vertcat(table(t), 2 * table(t + 1), 0)])
    moving = MovingObstacle(BALL, lambda time: path(time))
    np.testing.assert_allclose(np.array(moving.frame(0.5).position).ravel(), [0.5, 1.0, 0.0])


def test_tables_of_several_arguments_are_refused_by_name() -> None:
    plane: Any = ca.interpolant("plane", "linear", [[0.0, 1.0], [0.0, 1.0]], [0.0, 1.0, 2.0, 3.0])
    with pytest.raises(ModelError, match=r"'plane'.* is no table of one argument"):
        MovingObstacle(BALL, lambda t: (plane(ca.vertcat(t, t)), 0, 0))
