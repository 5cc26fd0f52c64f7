"""A sample of the random obstacles that move: no proven distance is above the one that coal finds."""

from __future__ import annotations

import pytest

from tests.families import some
from tests.sweep.moving_obstacles import MOTIONS, ROBOTS, result


@pytest.mark.parametrize("seed", some(range(len(MOTIONS)), 5))
def test_no_proof_is_above_the_truth(seed: int) -> None:
    row = result(sorted(ROBOTS)[seed % len(ROBOTS)], seed)
    assert not row["wrong"], row
    assert (row["said"] == "refused") == (row["motion"] == "has no bounds"), row
