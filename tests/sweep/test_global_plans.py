"""A sample of the random planar arms: the cost of a global plan is near its lower bound."""

from __future__ import annotations

import pytest

from tests.families import some
from tests.sweep.global_plans import RANDOM_KINDS, by_search, random_faults

CASES = [(kind, seed) for seed in range(20) for kind in RANDOM_KINDS]


@pytest.mark.parametrize("case", some(CASES, [*CASES[:8], *CASES[50:54]]))
def test_the_cost_is_near_a_lower_bound_of_all_motions(case: tuple[str, int]) -> None:
    kind, seed = case
    assert random_faults(kind, by_search(kind, seed)) == []
