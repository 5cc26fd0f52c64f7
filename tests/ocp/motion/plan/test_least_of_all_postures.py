"""What is found from every posture is the least that full solves from postures of another draw find."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ocp import Collocation, inverse_kinematics, minimum_velocity_problem, solve
from ocp.motion.plan import Plan
from tests.models.robot.trees import Array
from tests.ocp.motion.plan.motions import PLAN_CASES, plan_bare, planned

pytestmark = pytest.mark.xdist_group("plan seam_ur5")  # one process, so that it is planned once

APART = 0.3
"""rad: postures nearer to each other, but for full turns, slide to the same motion."""


@cache
def lowest_cost_plan() -> Plan:
    what = PLAN_CASES["seam_ur5"]()
    return plan_bare(what.machine, what.tasks, search="configurations")


def other_configurations() -> list[Array]:
    what = PLAN_CASES["seam_ur5"]()
    kept: list[Array] = []
    for configuration in inverse_kinematics(what.machine, what.tasks, starts=10, seed=5):
        apart = [np.abs((configuration.joints - other + np.pi) % (2 * np.pi) - np.pi).max() for other in kept]
        if not apart or min(apart) > APART:
            kept.append(configuration.joints)
    return kept


@pytest.mark.long
def test_no_configuration_leads_to_a_less_costly_seam() -> None:
    """By `minimum_velocity_problem`, the start free along its self-motion, on a mesh of its own."""
    what, result = PLAN_CASES["seam_ur5"](), lowest_cost_plan()
    assert result.audit().passed
    task = what.tasks
    mesh = Collocation(8, 7).with_nodes_at(task.breaks / task.duration)
    costs = []
    for joints in other_configurations():
        problem = minimum_velocity_problem(what.machine, task, near=joints)
        motion = solve(problem, mesh, options={"max_iter": 60}, check=False)
        if motion.success:  # or the posture is lost on its way
            costs.append(motion.cost)
    assert len(costs) > 5
    assert np.ptp(costs) > 0.1 * result.cost
    assert min(costs) > result.cost * (1 - 1e-6)
    assert min(costs) == pytest.approx(result.cost, rel=1e-6)


@pytest.mark.long
def test_every_candidate_is_reported_with_cost_and_reason() -> None:
    result, one = lowest_cost_plan(), planned("seam_ur5")
    first, *others = result.candidates
    assert (first.reason, first.cost, first.solution) == (None, result.cost, result.solution)
    assert len(others) > 10
    assert all(other.reason is not None for other in others)
    assert all(np.isnan(other.cost) or other.cost > result.cost * (1 - 1e-5) for other in others)
    assert result.cost <= one.cost * (1 + 1e-6)
    assert [c.reason for c in one.candidates].count(None) == 1
