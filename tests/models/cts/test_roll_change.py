"""The index with the change of roll: its minima are stationary and none of a grid is lower; turns are the nearest."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import ModelError, reference_rig, reference_tunnel
from models.cts.roll import checked_gain, convex_minima, minimize_convex, roll_window, unwrap_roll
from models.cts.trigonometric import Harmonics
from tests.models.cts.cts_oracle import index_by_geometry, random_targets

TUNNEL = reference_tunnel()
LIMITED = reference_rig(lower=(0.2, -3.0, -2.0, -1.2, 0.3, -4.0), upper=(1.6, -0.2, 2.2, 1.1, 2.6, 4.5))
RIGS = {"free": reference_rig(), "limited": LIMITED}
every_rig = pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)


@every_rig
@pytest.mark.parametrize("weight", [1e-3, 0.1, 10.0])
def test_no_roll_of_a_grid_is_better_than_the_best_of_the_minima(rig: Any, weight: float) -> None:
    rng, gain = np.random.default_rng(4), checked_gain(weight)
    targets, previous = random_targets(rng, 12), rng.uniform(-3, 3, 12)
    values = np.array(convex_minima(rig, TUNNEL, gain).map(12)(targets, previous[None]))
    for target, before, rolls in zip(targets.T, previous, values.T, strict=True):
        low, high = (float(ca.DM(end)) for end in roll_window(rig, before))
        grid = np.linspace(low, high, 2000)

        def cost(roll: Any, target: Any = target, before: float = before) -> Any:
            return (
                index_by_geometry(rig, TUNNEL, np.tile(target[:, None], len(roll)), roll) + gain * (roll - before) ** 2
            )

        assert (rolls >= low - 1e-12).all()
        assert (rolls <= high + 1e-12).all()
        assert cost(rolls).min() <= cost(grid).min() + 1e-12


@given(st.floats(-9, 9), st.floats(-np.pi, np.pi))
def test_the_roll_is_in_the_turn_nearest_to_the_previous_roll(previous: float, roll: float) -> None:
    result = float(ca.DM(unwrap_roll(RIGS["free"], ca.DM(np.cos(roll)), ca.DM(np.sin(roll)), ca.DM(previous))))
    assert abs(result - previous) <= np.pi + 1e-12
    assert np.sin((result - roll) / 2) == pytest.approx(0, abs=1e-12)


@given(st.floats(-9, 9))
def test_the_window_is_a_turn_within_the_limits(previous: float) -> None:
    low, high = (float(ca.DM(end)) for end in roll_window(RIGS["free"], ca.DM(previous)))
    assert [low, high] == pytest.approx([previous - np.pi, previous + np.pi])
    low, high = (float(ca.DM(end)) for end in roll_window(LIMITED, ca.DM(previous)))
    assert high - low == pytest.approx(2 * np.pi)
    assert -4.0 <= low < high <= 4.5
    if -4.0 <= previous - np.pi <= 4.5 - 2 * np.pi:
        assert low == pytest.approx(previous - np.pi)


@pytest.mark.parametrize("gain", [0.6, 3.0])
def test_descent_ends_where_the_slope_vanishes(gain: float) -> None:
    """Of cos(x) + gain (x - 1)^2, convex for gain > 1 / 2."""
    f = Harmonics(0.0, 1.0, 0.0, 0.0, 0.0)
    x = float(ca.DM(minimize_convex(f, gain, ca.DM(1.0), (ca.DM(-3.0), ca.DM(5.0)), start=ca.DM(1.0), steps=20)))
    assert -np.sin(x) + 2 * gain * (x - 1) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_weight_that_is_none_is_refused(weight: float) -> None:
    with pytest.raises(ModelError, match="rate_weight"):
        checked_gain(weight)
