"""Plans that stand, with every kind of task: orientations held, a level camera, two arms; solved, audited, replayed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import STANDING_STARTS
from models.machines.machine import with_tip
from models.paths import rest_to_rest
from ocp import Collocation, ProblemError, Solution, SolveError, TipTask, resolve_accelerations, solve
from ocp.motion.builders.dynamics_plan import SolveSettings
from ocp.motion.builders.standing.plan import solve_standing
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, standing_problem
from ocp.motion.tasks.equations import task_errors
from ocp.motion.tasks.limits import IndexAtLeast, InFoot, Limits, Pinned, ZmpRule
from ocp.motion.tasks.tip_task import retime_task
from ocp.motion.tasks.tracks import pose_line
from tests.models.machines.standing_machines import planar_machine
from tests.ocp.motion.builders.standing_replay import assert_stands
from tests.ocp.motion.builders.standing_tasks import (
    ARM_START,
    GRIP,
    HORIZON,
    LIFT_LIMITS,
    LIFT_WEIGHTS,
    LIMITS,
    PLANAR_HORIZON,
    TWO_HORIZON,
    TWO_START,
    arm,
    machine,
    moved_task,
    planar_start,
    sampled,
    straight,
    table_task,
    tip_at,
    tip_error,
    tool,
    two,
    two_tasks,
    with_setup,
)
from tests.ocp.motion.tasks.space_tasks import pose, turned

pytestmark = pytest.mark.long

IN_RANGE = InFoot(0.02)
SWING, ASIDE = 1.5, (0.2, 0.15, -0.05)  # s; m, of the arm with a load at its tip


def table_request(*, zmp: ZmpRule = IN_RANGE, limits: Limits = LIMITS, **changes: Any) -> Solution:
    settings = with_setup({"limits": replace(limits, zmp=zmp), **changes})
    return solve_standing(machine(), table_task(1), HORIZON, start=STANDING_STARTS[1], **settings)


@pytest.mark.parametrize(
    ("zmp", "changes", "cost", "method"),
    [
        (IN_RANGE, {}, -0.7092, {"intervals": 20, "control": "points"}),
        (Pinned(), {}, -0.1166, {"intervals": 20, "control": "points"}),
        (IndexAtLeast(0.9), {}, -0.3814, {"intervals": 20, "control": "points"}),  # tightened
        # tightened
        (IN_RANGE, {"limits": replace(LIMITS, velocity=0.7)}, -0.6615, {"intervals": 20, "control": "points"}),
        (IN_RANGE, {"control": "jerk"}, -0.7026, {"intervals": 20, "control": "points"}),
    ],
    ids=["in_range", "pinned", "index", "slow", "jerk"],
)
def test_the_formulation_that_works_is_found(
    zmp: ZmpRule, changes: dict[str, Any], cost: float, method: dict[str, Any]
) -> None:
    """Costs at the limit of fine grids, see the convergence table of the paper's script; the audit's own tolerances."""
    solution = table_request(zmp=zmp, **changes)
    assert solution.audit().passed
    assert solution.cost == pytest.approx(cost, abs=1e-4)
    assert method.items() <= solution.method.items()
    assert tip_error(machine(), sampled(machine(), solution), table_task(1)) < 1e-5


def test_the_fastest_lift_is_planned_with_linear_accelerations() -> None:
    settings: dict[str, Any] = {"limits": replace(LIFT_LIMITS, zmp=IN_RANGE), "weights": LIFT_WEIGHTS}
    settings["setup"] = StandingSetup(along="parameter")
    horizon = FreeTime(0.2, 3.0, 1.0)
    solution = solve_standing(machine(), straight(0.0, 0.8), horizon, start=STANDING_STARTS[1], **settings)
    audit = solution.audit()
    assert audit.feasible
    assert not audit.failures
    assert solution.method["control"] == "linear"
    assert solution.horizon == pytest.approx(0.5003, rel=2e-3)  # the limit of fine meshes, by collocation


def test_a_failure_reports_the_outcome_of_every_attempt() -> None:
    limits, options = replace(LIMITS, velocity=0.2), {"max_iter": 60}
    message = r"(?s)no standing plan .*\ntip acceleration, 8 intervals: .*velocities\[\d\]"
    with pytest.raises(SolveError, match=message) as caught:
        table_request(settings=SolveSettings(Collocation(8, degree=3, scheme="legendre"), options), limits=limits)
    assert caught.value.name == caught.value.conflicts[0].label
    mesh = Collocation(4, degree=1, scheme="legendre", control="held")
    with pytest.raises(
        SolveError, match=r"tip position, 4 intervals: .*fails"
    ) as caught:  # too coarse, and not refined
        table_request(settings=SolveSettings(mesh, tolerances={"tip": 0.0}))
    assert str(caught.value).count("\n") == 3
    assert (caught.value.name or "unnamed") in str(caught.value)
    assert caught.value.solution is not None
    with pytest.raises(ProblemError, match="end_velocity must be 'rest' or 'free'"):
        table_request(end_velocity="middle")


@pytest.mark.parametrize("kind", ["orientation", "direction"])
def test_an_arm_holds_its_hand_level_where_the_local_method_tips(kind: str) -> None:
    """All of the hand's orientation, or the axis of a camera with its roll left free."""
    turn, _ = pose(arm(), (), ARM_START)
    turning = {kind: turn if kind == "orientation" else turn[:, 2]}
    task = moved_task(arm(), ARM_START, ASIDE, SWING, **turning)
    local = resolve_accelerations(arm(), task, SWING, start=ARM_START, step=5e-3, wrenches=tool).motion
    assert not local.stands
    solution = solve_standing(
        arm(), task, SWING, start=ARM_START, limits=Limits(zmp=InFoot(0.005)), setup=StandingSetup(wrenches=tool)
    )
    assert solution.audit().passed
    motion = sampled(arm(), solution, tool)
    assert motion.foot_margin.min() > 0.004
    for joints in motion.joints[:: len(motion.t) // 7]:
        result, _ = pose(arm(), (), joints)
        columns = slice(0, 3) if kind == "orientation" else slice(2, 3)
        np.testing.assert_allclose(result[:, columns], turn[:, columns], atol=1e-5)
    assert_stands(arm(), motion, tool)
    rolled = [pose(arm(), (), joints)[0] @ turn.T for joints in (motion.joints[0], motion.joints[-1])]
    assert (np.abs(rolled[1] - rolled[0]).max() > 1e-3) == (kind == "direction")


def test_two_arms_stand_where_the_local_method_tips() -> None:
    ahead = (0.2, 0.0, 0.1)
    tasks = two_tasks(ahead, ahead)
    local = resolve_accelerations(two(), tasks, TWO_HORIZON, start=TWO_START, step=5e-3)
    assert local.tip_error.max() < 1e-8
    assert not local.motion.stands
    solution = solve_standing(two(), tasks, TWO_HORIZON, start=TWO_START, limits=Limits(zmp=InFoot(0.005)))
    assert solution.audit().passed
    motion = sampled(two(), solution)
    assert motion.foot_margin.min() > 0.004
    assert motion.stays_in_limits
    assert tip_error(two(), motion, tasks) < 1e-5
    for name in ("left_hand", "right_hand"):
        hand = with_tip(two(), name, GRIP)
        first, last = (pose(hand, (), joints)[1] for joints in (TWO_START, solution["joints"][-1]))
        np.testing.assert_allclose(last - first, ahead, atol=1e-5)
    assert_stands(two(), motion)


@pytest.mark.parametrize(
    ("level", "method", "cost", "deviation"),
    [
        ("position", Collocation(40, degree=3, scheme="legendre", control="held"), 2e-3, 3e-3),  # at the nodes alone
        ("acceleration", Collocation(20, degree=3, scheme="legendre"), 1e-8, 1e-4),
    ],
)
def test_a_velocity_says_the_same_as_the_position_it_leads_to(
    level: Any, method: Collocation, cost: float, deviation: float
) -> None:
    tasks = (table_task(1), TipTask(velocity=lambda t: [0.0, 0.4 * ca.sin(t)], rows=(4, 5), gain=0.0))
    settings: dict[str, Any] = {"zmp": IN_RANGE, "limits": LIMITS, "setup": StandingSetup(tip_level=level)}
    problems = [standing_problem(machine(), task, HORIZON, start=STANDING_STARTS[1], **settings) for task in tasks]
    led, driven = (solve(problem, method) for problem in problems)
    assert driven.cost == pytest.approx(led.cost, abs=cost)
    assert tip_error(machine(), sampled(machine(), driven), tasks[0]) < deviation


def test_a_rotating_hand_costs_less_with_a_free_time_law() -> None:
    """A pose in a plane over a path parameter, three rows; timed from rest to rest it is one of the ways to run it."""
    standing, start = planar_machine(6), planar_start(6)
    first, place = pose(standing, (), start)
    goal = turned((1, 0, 0), 0.4) @ first, place + np.array([0, 0.25, -0.3])
    line = pose_line((first, place), goal, 1.0, pace="constant")
    task = TipTask(position=line.position, orientation=line.orientation, rows=(0, 4, 5))
    options = retime_task(task, lambda t: rest_to_rest(t / PLANAR_HORIZON))
    cost = {}
    for along, what in (("time", options), ("parameter", task)):
        setup = StandingSetup(along=along)  # type: ignore[arg-type]
        result = solve_standing(
            standing, what, PLANAR_HORIZON, start=start, limits=Limits(zmp=InFoot(0.01)), setup=setup
        )
        cost[along] = result.cost
        for ours, theirs in zip(pose(standing, (), result["joints"][-1]), goal, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert cost["parameter"] < cost["time"]


def test_a_plan_closes_a_gap_at_its_start_critically_damped() -> None:
    """e'' + 2 g e' + g^2 e = 0 from rest: e = e0 (1 + g t) exp(-g t)."""
    standing, start = planar_machine(5), planar_start(5)
    _, y, z = tip_at(standing, start)
    task = TipTask(position=(y + 0.003, z - 0.004), rows=(4, 5), gain=4.0, start_gap=0.01)
    plan = solve_standing(standing, task, PLANAR_HORIZON, start=start, limits=Limits(zmp=InFoot(0.01)))
    errors = np.linalg.norm(task_errors(standing, task, plan.t, plan["joints"]), axis=1)
    np.testing.assert_allclose(errors, 0.005 * (1 + 4 * plan.t) * np.exp(-4 * plan.t), atol=1e-6)
