"""Neighbours are near in whatever units the numbers of the tasks are told."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ocp.app.batch.content import neighbours


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 1e4))
def test_neighbours_do_not_depend_on_units(seed: int, unit: float) -> None:
    places = np.random.default_rng(seed).random((40, 2))
    one: dict[str, Any] = {f"{k:02}": {"x": x, "y": y} for k, (x, y) in enumerate(places)}
    other = {key: {"x": unit * task["x"], "y": task["y"]} for key, task in one.items()}
    assert neighbours(one, ["x", "y"]) == neighbours(other, ["x", "y"])
