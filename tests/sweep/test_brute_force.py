"""A sample of the coarse tasks beside all sequences of postures of a fine grid."""

from __future__ import annotations

import pytest

from tests.sweep.brute_force import judged


@pytest.mark.parametrize("seed", [2, 3])
@pytest.mark.parametrize("kind", ["cut", "slow", "turning"])
def test_the_bound_is_above_nothing_that_a_grid_finds_and_the_search_finds_as_much(kind: str, seed: int) -> None:
    assert judged(kind, seed)["wrong"] == []
