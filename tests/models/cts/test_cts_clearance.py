"""Roll of a target among obstacles: clearance as a constraint and in the index, against a dense grid."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Box, ModelError, optimal_inverse, reference_rig, reference_tunnel, solve_table
from models.cts.best_roll import Avoidance, CollisionScene, clearances, collision_free_inverse
from models.cts.rig import HOME, INCH, inverse
from models.cts.roll import ACTIVE, STATUS
from models.shapes.distance import soft_minimum
from tests.models.cts.cts_oracle import Array, index_by_geometry, joints_by_geometry

RIG, TUNNEL = reference_rig(), reference_tunnel()
AROUND = CollisionScene(solids=(Box(INCH * np.array([6.0, 4.0, 6.0]), INCH * np.array([80.0, -9.0, 0.0])),))
TARGETS = np.array([[100 * INCH, 6 * INCH, z * INCH, yaw, 0.1] for z, yaw in ((-12, 0), (-6, 0.1), (0, 0), (7, -0.1))])


def grid_costs(weight: float, width: float, rate_weight: float = 0.0) -> tuple[Array, Array]:
    """Cost (inf out of reach) and least distance on a dense grid of rolls about 0. Shapes (targets, rolls)."""
    x, phi = ca.SX.sym("x", 5), ca.SX.sym("phi")
    gaps = list(clearances(RIG, inverse(RIG, x, phi, HOME)[0], AROUND).values())
    gap = ca.Function("gap", [x, phi], [soft_minimum(gaps, 2e-3)])
    rolls = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    costs, distances = [], []
    for row in TARGETS:
        rows = np.repeat(row[:, None], len(rolls), axis=1)
        inside = joints_by_geometry(RIG, rows, rolls, HOME)[1]
        distance = np.array(gap.map(len(rolls))(rows, rolls[None]))[0]
        cost = index_by_geometry(RIG, TUNNEL, rows, rolls) + weight * np.exp(-distance / width)
        cost += rate_weight / (2 * np.pi) * rolls**2
        costs.append(np.where(inside, cost, np.inf))
        distances.append(distance)
    return np.array(costs), np.array(distances)


@pytest.mark.parametrize(
    ("clearance", "weight", "rate_weight"), [(0.15, 0.0, 0.0), (-np.inf, 0.3, 0.0), (0.1, 0.05, 0.5)]
)
def test_no_roll_of_a_dense_grid_is_clear_and_better(clearance: float, weight: float, rate_weight: float) -> None:
    function = collision_free_inverse(RIG, TUNNEL, Avoidance(AROUND, clearance, weight, 0.1), rate_weight=rate_weight)
    costs, distances = grid_costs(weight, 0.1, rate_weight)
    for row, cost, distance in zip(TARGETS, costs, distances, strict=True):
        joints, result, _, status, gap = function(row, 0.0)
        assert int(status) == 0
        assert float(gap) >= clearance
        assert float(result) <= np.where(distance >= clearance, cost, np.inf).min() + 1e-9
        roll = float(joints[5])
        nearest = np.abs(np.linspace(-np.pi, np.pi, 1440, endpoint=False) - roll).argmin()
        assert float(result) == pytest.approx(cost[nearest], abs=5e-3)


def test_the_best_roll_is_found_where_the_best_clear_roll_of_the_grid_is_elsewhere() -> None:
    """Between two boxes: the best roll is in another basin than the best roll of the grid that is clear."""
    boxes = (Box((0.054, 0.154, 0.19), (2.009, -0.165, 0.153)), Box((0.088, 0.168, 0.084), (1.919, -0.022, -0.091)))
    function = collision_free_inverse(RIG, TUNNEL, Avoidance(CollisionScene(solids=boxes), 0.03))
    for target, known in (
        ((2.598, 0.156, 0.078, 0.167, 0.076), 0.0172392516),
        ((2.585, 0.092, -0.055, 0.147, 0.053), 0.0468053923),
    ):
        _, cost, _, _, gap = function(target, 0.0)
        assert float(cost) <= known + 1e-9
        assert float(gap) >= 0.03


def test_the_constraint_that_holds_the_roll_is_named() -> None:
    table = solve_table(RIG, TUNNEL, TARGETS, avoidance=Avoidance(AROUND, 0.15))
    free = solve_table(RIG, TUNNEL, TARGETS)
    assert table.status == ("ok",) * 4
    assert table.active[2] == "clearance"
    assert (table.cost >= free.cost - 1e-12).all()


def test_far_from_everything_it_is_the_closed_form() -> None:
    far = CollisionScene(solids=(Box((2.0, 2, 2), (80.0, 0, 0)),))
    function, closed = collision_free_inverse(RIG, TUNNEL, Avoidance(far, 0.1)), optimal_inverse(RIG, TUNNEL)
    for row in TARGETS:
        np.testing.assert_allclose(np.array(function(row, 0.3)[0]), np.array(closed(row, 0.3)[0]), atol=1e-7)


def test_a_target_that_is_never_clear_is_marked_and_leaves_the_others_alone() -> None:
    rows = np.vstack([TARGETS, [[np.nan] * 5], [[9.0, 9, 9, 0, 0]]])
    shut = CollisionScene(walls=Box((np.inf, 0.02, 0.02)))
    assert solve_table(RIG, TUNNEL, TARGETS, avoidance=Avoidance(shut, 0.0)).status == ("clearance",) * 4
    table = solve_table(RIG, TUNNEL, rows, avoidance=Avoidance(AROUND, 0.1))
    assert table.status == ("ok",) * 4 + ("not a number", "pitch link out of reach")
    assert np.isnan(table.joints[4:]).all()
    assert STATUS[-1] == ACTIVE[-1] == "clearance"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"weight": -1.0}, "weight"),
        ({"width": 0.0}, "width"),
        ({"clearance": np.nan}, "clearance"),
        ({"radii": 3}, "radii"),
    ],
)
def test_invalid_requests_are_refused_by_name(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        Avoidance(AROUND, **options)
    with pytest.raises(ModelError, match="rate_weight"):
        collision_free_inverse(RIG, TUNNEL, Avoidance(AROUND), rate_weight=np.inf)
    with pytest.raises(ModelError, match="empty"):
        collision_free_inverse(RIG, TUNNEL, Avoidance(CollisionScene()))
