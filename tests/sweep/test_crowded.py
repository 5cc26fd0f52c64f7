"""A sample of the random tasks among boxes: what is planned is clear by an engine of others."""

from __future__ import annotations

import pytest

from ocp import Plan
from tests.sweep.crowded import CLEARANCE, crowd, least_by_coal, planned

pytestmark = pytest.mark.long


@pytest.mark.parametrize(("robot", "seed"), [("ur5", 15), ("panda", 1), ("panda", 2), ("two arms", 31)])
def test_plans_among_boxes_are_collision_free_by_coal(robot: str, seed: int) -> None:
    options = crowd(robot, seed)
    result = planned(options)
    assert isinstance(result, Plan), result
    assert result.audit().passed
    assert least_by_coal(result, options.boxes) >= CLEARANCE - 1e-6
