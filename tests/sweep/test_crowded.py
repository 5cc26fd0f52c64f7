"""A sample of the random tasks among boxes: what is planned is clear by an engine of others."""

from __future__ import annotations

import pytest

from ocp import Plan
from tests.sweep.crowded import CLEARANCE, crowd, least_by_coal, planned

pytestmark = pytest.mark.long


@pytest.mark.parametrize(("robot", "seed"), [("ur5", 15), ("panda", 1), ("panda", 2), ("two arms", 31)])
def test_what_is_planned_among_boxes_is_clear_by_coal(robot: str, seed: int) -> None:
    given = crowd(robot, seed)
    result = planned(given)
    assert isinstance(result, Plan), result
    assert result.audit().passed
    assert least_by_coal(result, given.boxes) >= CLEARANCE - 1e-6
