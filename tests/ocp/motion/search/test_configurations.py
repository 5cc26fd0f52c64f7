"""Local motions from start configurations: tracked with the least damping that is enough."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ocp import TipTask
from ocp.motion.plan.planner import PlanOptions, checked_request
from ocp.motion.search.configurations import local_motions_from
from tests.ocp.motion.search.test_charts import planar

START = np.array([0.5, 1.2, -1.4])
SHIFT = np.array([-0.3, 0.2, 0.0])


@pytest.mark.parametrize(
    ("dampings", "best"), [((0.01, 1.0), 0.01), ((100.0, 10.0, 0.01), 0.01), ((0.1, 0.01), 0.1), ((10.0, 100.0), 10.0)]
)
def test_local_motions_are_those_of_the_first_damping_that_tracks_or_of_the_least(
    dampings: tuple[float, ...], best: float
) -> None:
    """Damped by 10 or more, relative to the singular values, the tip stays far behind its line."""
    machine = planar(np.array([0.5, 0.4, 0.3]))
    first = np.array(ca.DM(machine.tip_pose((), START).position)).ravel()
    task = TipTask(position=lambda t: ca.DM(first) + t * ca.DM(SHIFT), rows=[3, 4], duration=1.0)
    request = checked_request(machine, task, None, PlanOptions(start=START))
    (motion,), (expected,) = (
        local_motions_from(replace(request, settings=replace(request.settings, dampings=each)), START[None])
        for each in (dampings, (best,))
    )
    np.testing.assert_array_equal(motion.joints, expected.joints)
    last = np.array(ca.DM(machine.tip_pose((), motion.joints[0, -1]).position)).ravel()
    assert (np.linalg.norm(last - first - SHIFT) < 1e-4) == (best < 10)
