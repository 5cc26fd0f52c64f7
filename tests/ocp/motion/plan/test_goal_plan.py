"""Plans to goal configurations: closed forms of a sliding ball, an arm among boxes, and refusals by name."""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio
import pytest
import ruckig

from models import Box, CollisionScene, CollisionShape, FixedBase, Joint, Link, Robot
from models.checks import Array
from models.examples import example_robot
from ocp import Goal, Limits, Plan, ProblemError, Scene, SolveError, console
from ocp import plan as plan_motion
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.local.collisions import distances_along
from ocp.motion.plan import goal_plan
from ocp.motion.plan.goal_motions import GoalRequest, GoalSettings, GoalTask
from ocp.motion.plan.goal_plan import plan_to_goal
from ocp.motion.result.candidate import Candidate, Rejection
from ocp.motion.sampling.joint_paths import StraightMotions
from ocp.motion.sampling.path_search import PathSearchSettings
from ocp.motion.tasks.goals import Cost
from scripts.robots.robots import PANDA
from tests.families import some
from tests.models.shapes.shape_oracles import in_coal
from tests.ocp.motion.sampling.sliders import RADIUS, gap, slider

BOX = Box((0.4, 1.4, 1.0), (0.0, 0.0, 0.0))
START: Array = np.array([-1.0, 0.1])
GOAL: Array = np.array([1.0, 0.1])


def request_of(*boxes: Box, **options: Any) -> GoalRequest:
    machine = slider()
    constraints = ClearanceConstraints(CollisionScene(machine, boxes)) if boxes else None
    return GoalRequest(machine, **{"start": START, "goals": GOAL, "clearance_constraints": constraints, **options})


def sampled(plan: Plan) -> Array:
    joints: Array = plan.at(np.linspace(0.0, plan.horizon, 2001))["joints"]
    return joints


@pytest.mark.parametrize("length", [True, False])
def test_the_shorter_path_around_a_box_is_the_plan_and_the_longer_a_candidate(length: bool) -> None:
    settings = GoalSettings(search=PathSearchSettings(classes=8))
    plan = plan_to_goal(request_of(BOX, cost=Cost(velocity=0.0, length=1.0) if length else Cost(), settings=settings))
    audit = plan.audit()
    assert audit.feasible
    assert audit.clearances["clearance"].settled
    joints = sampled(plan)
    assert gap(joints, [BOX]).min() >= -1e-6
    assert joints[1000, 1] > 0.7  # the goal is nearer to the upper side
    assert [None if c.reason is None else c.reason.kind for c in plan.candidates] == [None, Rejection.COSTLIER]
    total = float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())
    cost = total if length else total**2 / (2 * plan.horizon)
    assert plan.cost == pytest.approx(cost, rel=1e-4)
    assert plan.bound == pytest.approx(2.0 if length else 4.0 / (2 * plan.horizon))
    assert plan.cost < plan.candidates[1].cost


def test_a_clear_straight_motion_has_the_cost_of_its_bound() -> None:
    plan = plan_to_goal(request_of(cost=Cost(velocity=0.0, length=1.0), goals=[[1.5, -1.5], [0.0, 0.5]]))
    assert plan.bound is not None
    assert plan.cost == pytest.approx(plan.bound, rel=1e-12)
    assert plan.cost == pytest.approx(np.hypot(1.0, 0.4))
    assert plan.horizon == pytest.approx(1.0)  # at 1 m/s
    np.testing.assert_allclose(sampled(plan)[[0, -1]], np.array([START, [0.0, 0.5]]), atol=1e-12)


@pytest.mark.parametrize(
    ("options", "name", "words"),
    [
        ({"start": [-0.2, 0.0]}, "ball and obstacle 0", "start: ball and obstacle 0 overlap by 0.1 m"),
        ({"goals": [0.25, 0.0]}, "ball and obstacle 0", "goal: ball and obstacle 0 overlap by 0.05 m"),
        ({"goals": [2.5, 0.0]}, "x", "end: 'x' ends at 2.5"),
        ({"start": [-2.5, 0.0]}, "x", "start: 'x' starts at -2.5"),
        ({"goals": np.zeros((0, 2))}, "goals", "at least one"),
        ({"time_limit": -1.0}, "time_limit", "time_limit"),
        ({"cost": Cost(weights=[1.0, 0.0])}, "weights", "positive"),
    ],
)
def test_a_request_that_cannot_be_met_is_refused_by_name(options: dict[str, Any], name: str, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        plan_to_goal(request_of(BOX, **options))
    assert caught.value.name == name


def test_of_goals_in_collision_and_clear_ones_the_clear_ones_are_planned() -> None:
    plan = plan_to_goal(request_of(BOX, goals=[[0.0, 0.0], [-1.0, 1.5]], cost=Cost(velocity=0.0, length=1.0)))
    np.testing.assert_allclose(sampled(plan)[-1], [-1.0, 1.5], atol=1e-12)


def test_a_closed_wall_is_refused_in_time_with_the_obstacle_named() -> None:
    wall = Box((0.2, 5.0, 1.0), (0.0, 0.0, 0.0))
    with pytest.raises(SolveError, match="does not prove that there is none") as caught:
        plan_to_goal(request_of(wall, time_limit=1.5))
    assert caught.value.name == "time_limit"
    assert "ball and obstacle 0 overlap by up to 0.2 m" in str(caught.value)


def test_an_unlimited_joint_avoids_an_obstacle_by_the_larger_angle() -> None:
    arm = Link("arm", 1.0, collisions=(CollisionShape("sphere", (RADIUS,), translation=(1.0, 0.0, 0.0)),))
    joint = Joint("turn", kind="continuous", parent="base", child="arm", axis=(0, 0, 1), velocity=1.0)
    machine = FixedBase(Robot((Link("base"), arm), (joint,), tip="arm"))
    constraints = ClearanceConstraints(CollisionScene(machine, [Box((0.1, 0.1, 0.5), (0.0, 1.0, 0.0))]))
    plan = plan_to_goal(
        GoalRequest(
            machine, [0.0], [np.pi - 0.5], cost=Cost(velocity=0.0, length=1.0), clearance_constraints=constraints
        )
    )
    assert plan.cost == pytest.approx(np.pi + 0.5)
    plan = plan_to_goal(GoalRequest(machine, [0.0], [np.pi - 0.5 + 2 * np.pi], cost=Cost(velocity=0.0, length=1.0)))
    assert plan.cost == pytest.approx(np.pi - 0.5)


def test_a_plan_is_read_from_its_file_and_audited_again(tmp_path: Path) -> None:
    plan = plan_to_goal(request_of(BOX, cost=Cost(velocity=0.0, length=1.0)))
    plan.save(tmp_path / "plan.npz")
    read = Plan.load(tmp_path / "plan.npz")
    assert read.audit().feasible
    assert read.cost == plan.cost
    np.testing.assert_array_equal(sampled(read), sampled(plan))


def test_the_same_seed_gives_the_same_plan_and_stages_are_reported() -> None:
    results: list[str] = []
    with console.shown_progress("goal", results.append):
        first, again = (plan_to_goal(request_of(BOX, seed=3)) for _ in range(2))
    np.testing.assert_array_equal(sampled(first), sampled(again))
    assert len(results) >= 4


@pytest.mark.parametrize("horizon", some([None, 6.0], [None]))
def test_squared_rates_within_accelerations_are_planned_in_a_fixed_time(horizon: float | None) -> None:
    limits = Limits(acceleration=[3.0, 2.0], torque=np.inf)
    plan = plan_to_goal(request_of(BOX, limits=limits, horizon=horizon, time_limit=8.0))
    assert plan.audit().feasible
    assert horizon is None or plan.horizon == pytest.approx(horizon)
    assert plan.bound is not None
    assert plan.bound <= plan.cost
    sample = plan.sampled(np.linspace(0.0, plan.horizon, 2001))
    squares = np.trapezoid((sample.rates**2).sum(axis=1), sample.t) / 2
    assert plan.cost == pytest.approx(squares, rel=1e-3)
    assert gap(sample.joints, [BOX]).min() >= -1e-6
    assert (np.abs(sample.accelerations) <= [3.003, 2.002]).all()


@pytest.mark.parametrize("limits", [Limits(), Limits(acceleration=1.0, torque=np.inf)])
def test_a_goal_at_the_start_is_reached_by_rest(limits: Limits) -> None:
    plan = plan_to_goal(request_of(BOX, goals=START, limits=limits))
    assert plan.audit().feasible
    assert plan.cost == 0
    np.testing.assert_allclose(sampled(plan), np.tile(START, (2001, 1)), atol=1e-12)


LEAST_TIME = Cost(velocity=0.0, time=1.0)


@pytest.mark.parametrize("jerk", [np.inf, 30.0])
def test_without_obstacles_the_least_time_is_the_bound_of_the_slowest_joint(jerk: float) -> None:
    limits = Limits(velocity=[1.0, 0.3], acceleration=[2.0, 4.0], jerk=jerk, torque=np.inf)
    plan = plan_motion(slider(), Goal(joints=GOAL), start=[-1.0, 0.4], cost=LEAST_TIME, limits=limits, scene=False)
    build_up = 2.0 / jerk
    expected = 2.0 / 1.0 + 1.0 / 2.0 + build_up  # 2 m at 1 m/s and 2 m/s^2; the other joint has time to spare
    assert plan.cost == plan.horizon == pytest.approx(expected, rel=1e-9)
    assert plan.bound == pytest.approx(plan.cost, rel=1e-9)
    assert plan.audit().feasible


@pytest.mark.parametrize("checks", [1, 4, 16, 64, 256])
@pytest.mark.parametrize("cost", [LEAST_TIME, Cost(velocity=0.0, length=1.0), Cost()])
def test_wherever_the_time_limit_passes_a_motion_is_returned_or_refused(
    checks: int, cost: Cost, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that runs out at a certain check of the time: no other exception than SolveError leaves the planner."""
    clock = count()
    monkeypatch.setattr(console, "time_left", lambda: float(checks - next(clock)))
    limits = Limits() if cost.length else Limits(acceleration=4.0, torque=np.inf)
    try:
        feasible, reason = plan_to_goal(request_of(BOX, cost=cost, limits=limits)).audit().feasible, ""
    except SolveError as error:
        feasible, reason = False, str(error)
    assert feasible or "time" in reason


def test_the_synchronised_motion_leaves_time_for_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fastest motion that ignores obstacles may take all the time that it is given, and no more."""
    limits, seen = Limits(acceleration=4.0, jerk=40.0, torque=np.inf), list[float]()
    goals = np.array([[1.0, y] for y in np.linspace(-0.3, 0.3, 50)])

    def endless(task: GoalTask) -> list[Candidate]:
        seen.append(console.time_left())
        raise console.TimeLimitReached

    monkeypatch.setattr(goal_plan, "synchronised_candidates", endless)
    plan = plan_to_goal(request_of(BOX, goals=goals, cost=LEAST_TIME, limits=limits, time_limit=60.0))
    assert plan.audit().feasible
    assert seen[0] < 30.0


def test_around_a_box_the_least_time_needs_no_stop() -> None:
    limits = Limits(acceleration=4.0, jerk=40.0, torque=np.inf)
    plan = plan_to_goal(request_of(BOX, cost=LEAST_TIME, limits=limits))
    assert plan.audit().feasible
    assert plan.bound is not None
    assert plan.bound == pytest.approx(2.0 + 0.25 + 0.1)
    assert plan.bound <= plan.cost < 1.01 * plan.bound
    sample = plan.sampled(np.linspace(0.0, plan.horizon, 2001))
    assert gap(sample.joints, [BOX]).min() >= -1e-6
    assert np.linalg.norm(sample.rates, axis=1)[200:-200].min() > 0.3
    assert (np.abs(sample.accelerations) <= 4.001).all()


def test_a_moving_end_is_reached_at_its_velocity_in_less_time_than_rest() -> None:
    limits = Limits(acceleration=2.0, jerk=40.0, torque=np.inf)
    plan = plan_to_goal(request_of(cost=LEAST_TIME, limits=limits, end_velocity=[1.0, 0.0]))
    assert plan.audit().feasible
    expected = 2.0 + (1.0 / 2.0 + 0.05) / 2  # one ramp instead of two: half of its time is lost
    assert expected * (1 - 1e-6) <= plan.cost <= 1.01 * expected
    sample = plan.sampled(np.linspace(0.0, plan.horizon, 101))
    np.testing.assert_allclose(sample.rates[[0, -1]], [[0.0, 0.0], [1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(sample.joints[-1], GOAL, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("jerk", [None, 400.0])
def test_least_time_of_an_arm_among_boxes_keeps_all_limits_and_its_clearance(jerk: float | None) -> None:
    machine = FixedBase(example_robot("six_axis"))
    scene = CollisionScene(machine, [Box((0.1, 0.1, 2.0), (0.5, 0.0, 0.0))])
    starts = np.array([[-0.8, 0.6, 0.6, 0.0, 0.5, 0.0]])
    assert not StraightMotions(scene).are_clear(starts, starts * [-1.0, 1.0, 1.0, 1.0, 1.0, 1.0])[0]
    start, goal = np.array([-0.8, 0.6, 0.6, 0.0, 0.5, 0.0]), np.array([0.8, 0.6, 0.6, 0.0, 0.5, 0.0])
    limits = Limits(acceleration=10.0, jerk=jerk, torque=[150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
    plan = plan_to_goal(
        GoalRequest(
            machine, start, goal, limits=limits, cost=Cost(velocity=0.0, time=1.0), time_limit=15.0,
            clearance_constraints=ClearanceConstraints(scene),
        )
    )  # fmt: skip
    assert plan.audit().feasible
    assert plan.bound is not None
    assert plan.bound <= plan.cost == pytest.approx(plan.horizon)
    assert plan.cost < 1.1 * plan.bound
    sample = plan.sampled(np.linspace(0.0, plan.horizon, 2001))
    assert distances_along(scene, np.zeros(0), sample.joints, sample.t).min() >= -1e-6
    assert (np.abs(sample.rates) <= machine.robot.velocity * 1.001).all()
    assert np.abs(sample.accelerations).max() <= 10.01
    np.testing.assert_allclose(sample.rates[[0, -1]], 0.0, atol=1e-6)


PANDA_START = np.array([-0.8, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785])
PANDA_LIMITS = Limits(
    acceleration=[15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
    jerk=[7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
)
"""Of the data sheet; limits of rates and torques are those of the robot description."""
WALL, LOW_BOX, TABLE = (
    Box((0.5, 0.04, 0.45), (0.6, 0.0, 0.225)),
    Box((0.2, 0.2, 0.2), (0.45, 0.45, 0.1)),
    Box((1.6, 1.6, 0.05), (0.0, 0.0, -0.06)),
)
CLEARANCE = 0.01


def panda_plan(goal: Goal) -> Plan:
    folder = str(PANDA.path.parents[3])
    scene = Scene([WALL, LOW_BOX, TABLE], clearance=CLEARANCE, folders=[folder])
    machine, cost = FixedBase(PANDA.read()), Cost(velocity=0.0, time=1.0)
    return plan_motion(machine, goal, start=PANDA_START, limits=PANDA_LIMITS, cost=cost, scene=scene)


def assert_the_panda_keeps_its_limits(plan: Plan) -> Any:
    """Check rest, limits and distances at samples by Pinocchio and coal, with the meshes of the robot description.

    Return the pose of the hand at the end.
    """
    model = pinocchio.buildModelFromUrdf(str(PANDA.path))
    geometry = pinocchio.buildGeomFromUrdf(
        model, str(PANDA.path), pinocchio.GeometryType.COLLISION, package_dirs=[str(PANDA.path.parents[4])]
    )
    data, places = model.createData(), geometry.createData()
    sample = plan.sampled(np.linspace(0.0, plan.horizon, 401))
    np.testing.assert_allclose(sample.joints[0], PANDA_START, atol=1e-9)
    np.testing.assert_allclose(sample.rates[[0, -1]], 0.0, atol=1e-6)
    assert (np.abs(sample.rates) <= model.velocityLimit[:7] * 1.001).all()
    assert (np.abs(sample.accelerations) <= np.array(PANDA_LIMITS.acceleration) * 1.001).all()
    jerks = np.diff(sample.accelerations, axis=0) / np.diff(sample.t)[:, None]
    assert (np.abs(jerks) <= np.array(PANDA_LIMITS.jerk) * 1.001).all()
    least, boxes = np.inf, [in_coal(box) for box in (WALL, LOW_BOX, TABLE)]
    for values in zip(sample.joints, sample.rates, sample.accelerations, strict=True):
        q, v, a = (np.append(value, [finger] * 2) for value, finger in zip(values, (0.02, 0.0, 0.0), strict=True))
        torques = pinocchio.rnea(model, data, q, v, a)[:7]
        assert (np.abs(torques) <= model.effortLimit[:7] * 1.001).all()
        pinocchio.updateGeometryPlacements(model, data, geometry, places, q)
        for body, at in zip(geometry.geometryObjects, places.oMg, strict=True):
            if body.parentJoint:  # the base stands in the table
                here = coal.Transform3s(at.rotation, at.translation)
                for box, there in boxes:
                    shape = (body.geometry, here, box, there, coal.DistanceRequest(), coal.DistanceResult())
                    least = min(least, coal.distance(*shape))
    assert least >= CLEARANCE - 1e-6
    pinocchio.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(plan.machine.robot.tip_link)]


@pytest.mark.long
def test_the_panda_moves_among_a_wall_a_box_and_a_table_in_the_least_time_of_its_slowest_joint() -> None:
    """The time of one joint alone, by Ruckig, is a lower bound; the straight motion collides with the wall."""
    goal = PANDA_START * [-1.0, *[1.0] * 6]
    machine, folder = FixedBase(PANDA.read()), str(PANDA.path.parents[3])
    collisions = StraightMotions(CollisionScene(machine, [WALL, LOW_BOX, TABLE], folders=[folder]))
    assert not collisions.are_clear(PANDA_START[None], goal[None])[0]
    plan = panda_plan(Goal(joints=goal))
    assert plan.audit().feasible
    assert_the_panda_keeps_its_limits(plan)

    alone, profile = ruckig.InputParameter(1), ruckig.Trajectory(1)
    alone.current_position, alone.target_position = PANDA_START[:1].tolist(), goal[:1].tolist()
    alone.max_velocity, alone.max_acceleration, alone.max_jerk = [2.175], [15.0], [7500.0]
    ruckig.Ruckig(1).calculate(alone, profile)
    assert profile.duration * (1 - 1e-6) <= plan.horizon <= 1.001 * profile.duration
    assert plan.bound == pytest.approx(profile.duration, rel=1e-6)


@pytest.mark.long
def test_the_panda_moves_to_a_pose_of_its_hand_behind_the_wall() -> None:
    place, down = np.array([0.45, 0.35, 0.45]), np.array([0.0, 1.0, 0.0, 0.0])
    plan = panda_plan(Goal(position=place, orientation=down))
    assert plan.audit().feasible
    assert plan.bound is not None
    assert plan.bound <= plan.cost <= 1.03 * plan.bound
    hand = assert_the_panda_keeps_its_limits(plan)
    np.testing.assert_allclose(hand.translation, place, atol=1e-6)
    np.testing.assert_allclose(hand.rotation, np.diag([1.0, -1.0, -1.0]), atol=1e-6)


def test_of_many_goals_the_nearest_and_the_most_distant_ones_are_kept() -> None:
    changes = np.random.default_rng(0).normal(size=(500, 3))
    goals = changes + 1.0
    kept = goal_plan._nearest_and_spread(goals, changes, 20)
    assert kept.shape == np.unique(kept, axis=0).shape == (20, 3)
    sizes = np.linalg.norm(kept - 1.0, axis=1)
    np.testing.assert_allclose(sizes[:10], np.sort(np.linalg.norm(changes, axis=1))[:10])
    others = kept[10:]
    between = np.linalg.norm(others[:, None] - others, axis=2) + 9 * np.eye(10)
    assert between.min() > 2.0
    np.testing.assert_array_equal(goal_plan._nearest_and_spread(goals, changes, 500), goals)


def test_a_goal_among_many_that_collide_is_reached() -> None:
    """All but one of 300 goals are behind a wall; the one in front of it is neither among the nearest nor the last."""
    wall, rng = Box((0.4, 6.0, 1.0), (0.0, 0.0, 0.0)), np.random.default_rng(2)
    behind = np.column_stack([rng.uniform(0.5, 1.0, 299), rng.uniform(-0.4, 0.4, 299)])
    goals = np.vstack([behind, [[-1.0, 2.0]]])
    plan = plan_to_goal(request_of(wall, goals=goals, cost=Cost(velocity=0.0, length=1.0)))
    np.testing.assert_allclose(sampled(plan)[-1], goals[-1], atol=1e-9)


@pytest.mark.parametrize("beyond", [-1e-6, -1e-9, -1e-12, 0.0, 1e-12, 1e-9, 1e-6])
def test_a_goal_at_the_required_clearance_is_reached_or_refused_by_name(beyond: float) -> None:
    """No proof of clearance succeeds where bodies touch; the measured distance decides."""
    goal, plan, name = np.array([0.0, 0.7 + RADIUS + beyond]), None, None
    try:
        plan = plan_to_goal(request_of(BOX, goals=goal, cost=Cost(velocity=0.0, length=1.0), time_limit=4.0))
    except (ProblemError, SolveError) as error:
        name = error.name
    assert name is not None if plan is None else beyond > -1e-6
    if plan is not None:
        np.testing.assert_allclose(sampled(plan)[-1], goal, atol=1e-9)
