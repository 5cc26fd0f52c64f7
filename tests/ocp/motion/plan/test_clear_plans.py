"""Plans that stay clear: found, proven, seen by others; and what cannot be kept clear is refused by name."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path as File
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import (
    Box,
    CollisionScene,
    CollisionShape,
    FixedBase,
    FreeFloating,
    Joint,
    Link,
    MovingObstacle,
    Robot,
    Sphere,
    link_frames,
)
from ocp import (
    ClearanceConstraints,
    Collocation,
    IkOptions,
    Limits,
    Plan,
    ProblemError,
    Scene,
    SolveError,
    TipTask,
    Unreachable,
    VelocitySetup,
    inverse_kinematics,
    minimum_velocity_problem,
    plan,
    solve,
)
from ocp.motion.local.collisions import distances_along
from ocp.motion.plan import planner
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.plan.planner import PlanOptions, checked_request
from ocp.motion.result.candidate import Candidate, Rejection
from tests.models.machines.armoured import armoured_arm
from tests.ocp.motion.plan.motions import DOWN, curved_seam
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.tasks.space_tasks import ur5

pytestmark = pytest.mark.xdist_group("clear plans")  # one process, so that every motion is planned once

ARM = FixedBase(armoured_arm())
START = np.array([0.1, 0.6, 0.1, 1.0, 0.1, 0.8, 0.0])
SECONDS = 2.0
DISPLACEMENT = np.array([0.0, 0.5, 0.0])


def avoiding(scene: CollisionScene) -> VelocitySetup:
    return VelocitySetup(clearance_constraints=ClearanceConstraints(scene))


def tip_at(machine: Any, joints: Any) -> np.ndarray:
    return np.array(ca.DM(machine.tip_pose(machine.base_home(), joints).position)).ravel()


FIRST = tip_at(ARM, START)
POST = Sphere(0.08, FIRST + np.array([0, 0.2, 0.18]))
"""Beside the way of the tip: the last link of the cheapest motion goes through it."""


def smooth_step(time: Any) -> Any:
    s = time / SECONDS
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def line(machine: Any = ARM, first: Any = FIRST, way: Any = DISPLACEMENT, scale: float = 1.0) -> TipTask:
    del machine
    return TipTask(position=lambda t: ca.DM(scale * first) + smooth_step(t) * ca.DM(scale * way), duration=SECONDS)


@cache
def planned(*obstacles: Any, clearance: float | None = 0.0) -> Plan:
    scene: Scene | Literal[False] = False if clearance is None else Scene(obstacles, clearance)
    return plan(ARM, line(), start=START, search="start", scene=scene)


def least_apart(result: Plan, obstacles: Any, samples: int = 4001) -> float:
    at = result.sample(result.horizon / (samples - 1))
    around = CollisionScene(result.machine, obstacles)
    base = np.array([result.at(t)["base"] for t in at.t]) if result.machine.base_size else np.zeros(0)
    return float(distances_along(around, base, at.joints, at.t).min())


def test_inactive_limits_change_no_plan() -> None:
    plain, beside = planned(clearance=None), planned(Sphere(0.05, (0.9, 0.9, 0.9)))
    assert_allclose(beside.cost, plain.cost, rtol=1e-9)
    assert "clearance" not in {finding.name for finding in plain.audit().findings}
    assert beside.audit()["clearance"].passed
    assert not beside.solution.problem.declared.path.get("apart")


@pytest.mark.parametrize("clearance", [0.0, 0.02])
def test_active_clearances_are_met_and_proven(clearance: float) -> None:
    plain, beside = planned(clearance=None), planned(POST, clearance=clearance)
    assert least_apart(plain, [POST]) < 0
    audit = beside.audit()
    assert audit.passed
    proof = audit.clearances["clearance"]
    assert proof.worst is not None
    assert proof.worst.bodies == ("link6", "obstacle 0")
    sampled = least_apart(beside, [POST])
    assert clearance - 1e-6 <= proof.worst.least <= sampled + 1e-9
    assert sampled <= clearance + 1e-3  # and no farther off than it has to be
    assert beside.cost > plain.cost


def test_more_clearance_costs_more() -> None:
    costs = [planned(POST, clearance=each).cost for each in (0.0, 0.02)]
    assert np.all(np.diff([planned(clearance=None).cost, *costs]) > 1e-4)


def test_mirrored_and_larger_it_is_the_same_motion() -> None:
    """A world three times as large: the same joints, the same cost, distances three times as large."""
    large = FixedBase(armoured_arm(scale=3.0))
    post = Sphere(0.24, 3 * POST.position)
    result = plan(large, line(scale=3.0), start=START, search="start", scene=Scene(obstacles=[post]))
    assert_allclose(result.cost, planned(POST).cost, rtol=2e-3)
    assert_allclose(result.at(1.0)["joints"], planned(POST).at(1.0)["joints"], atol=2e-2)


def test_a_moving_obstacle_is_avoided() -> None:
    ball = MovingObstacle(Sphere(0.05, (0, 0, 0)), lambda t: ca.DM(FIRST) + ca.vertcat(0, 0.25, 0.15 + 0.4 * (1.0 - t)))
    plain = planned(clearance=None)
    assert least_apart(plain, [ball]) < 0
    result = plan(ARM, line(), start=START, search="start", scene=Scene(obstacles=[ball], clearance=0.01))
    assert result.audit().passed
    assert least_apart(result, [ball]) >= 0.01 - 1e-6
    still = Sphere(0.05, ball.frame(2.0).position.full().ravel())
    assert least_apart(plain, [still]) > 0  # where it ends it is in nobody's way


@pytest.mark.long
def test_the_search_finds_a_collision_free_configuration() -> None:
    task = TipTask(position=lambda t: ca.DM(FIRST) + smooth_step(t) * ca.DM(DISPLACEMENT), duration=SECONDS)
    result = plan(ARM, task, scene=Scene(obstacles=[POST], clearance=0.02))
    assert result.audit().passed
    assert least_apart(result, [POST]) >= 0.02 - 1e-6
    assert result.cost < planned(POST, clearance=0.02).cost


@pytest.mark.long
def test_joints_without_a_task_are_in_mid_range_or_clear() -> None:
    """A flag beside a planar arm, whose middle is in a ball: the arm moves as it does without the ball."""
    arm = planar(np.array([0.4, 0.3, 0.3])).robot
    pole = CollisionShape("capsule", (0.03, 0.2), translation=(0, 0.15, 0), rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    flag = Joint("flag", "revolute", "base", "pole", (-0.5, 0, 0), axis=(0, 0, 1), lower=-1.0, upper=2.0, velocity=1.0)
    robot = Robot((*arm.links, Link("pole", 0.5, collisions=(pole,))), (*arm.joints, flag), tip="tip")
    ball = Sphere(0.05, (-0.5 - 0.15 * np.sin(0.5), 0.15 * np.cos(0.5), 0))
    task = TipTask(position=lambda t: [0.6 - 0.1 * t, 0.2 + 0.1 * t], rows=[3, 4], duration=1.0)
    free, beside = (plan(FixedBase(robot), task, scene=Scene(obstacles=each)) for each in ((), [ball]))
    place = robot.joint_names.index("flag")
    assert_allclose(free.at(0.0)["joints"][place], 0.5)
    assert abs(beside.at(0.0)["joints"][place] - 0.5) > 0.3
    assert least_apart(beside, [ball]) >= 0
    assert_allclose(beside.cost, free.cost, rtol=1e-6)


def test_joints_without_a_task_start_clear_of_the_motion() -> None:
    """A flag in the way of a planar arm, clear of it at the start alone: turned aside before, it costs nothing."""
    arm = planar(np.array([0.4, 0.3, 0.3])).robot
    pole = CollisionShape("capsule", (0.03, 0.2), translation=(0, 0.15, 0), rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    ball = CollisionShape("sphere", (0.04,))
    links = tuple(link if link.name == "base" else replace(link, collisions=(ball,)) for link in arm.links)
    flag = Joint(
        "flag", "revolute", "base", "pole", (0.35, 0.1, 0), axis=(0, 0, 1), lower=-3.0, upper=3.0, velocity=1.0
    )
    robot = Robot((*links, Link("pole", 0.5, collisions=(pole,))), (*arm.joints, flag), tip="tip")
    task = TipTask(position=lambda t: [0.6 - 0.2 * t, 0.25], rows=[3, 4], duration=1.0)
    bare, clearance_constraints = (
        plan(FixedBase(robot), task, scene=scene) for scene in (False, Scene(clearance=0.01))
    )
    place = robot.joint_names.index("flag")
    assert bare.at(0.0)["joints"][place] == 0
    assert least_apart(bare, ()) < 0
    assert least_apart(clearance_constraints, ()) >= 0.01 - 1e-6
    assert abs(clearance_constraints.at(0.0)["joints"][place]) > 0.2
    assert_allclose(clearance_constraints.cost, bare.cost, rtol=1e-4)


def test_held_apart_the_barrier_begins_worth_no_more_than_the_motion() -> None:
    """As many limits as the program has, each with the barrier that it begins with, cost what the motion costs."""
    around = CollisionScene(ARM, [POST])
    required = checked_request(ARM, line(), None, PlanOptions(start=START, search="start"))
    solver = CandidateSolver(replace(required, clearance_constraints=ClearanceConstraints(around)), START, START)
    pair = around.labels.index(("link6", "obstacle 0"))
    cost = 0.25
    separated = Candidate(START, constraints=ClearanceConstraints(around).with_pairs([pair]))
    prepared = solver.prepared(separated, fine=False, cost=cost)[2]
    bounds = prepared.formulation.bound_values(np.zeros(0))
    places = [getattr(prepared.transcription, f"{take}_bounds") for take in ("variable", "row")]
    free = [np.isfinite(side[at][bounds[0][at] < bounds[1][at]]).sum() for at in places for side in bounds]
    begins = prepared._options["mu_init"]
    assert_allclose(begins * sum(free), cost, rtol=0.05)  # the nodes at which the motion begins aside
    assert "mu_init" not in solver.prepared(Candidate(START), fine=True)[2]._options


def space_arm(panel: bool) -> FreeFloating:
    """An arm on a satellite, with a box on its base in the way."""
    robot = armoured_arm()
    box = CollisionShape("box", (0.1, 0.1, 0.12), translation=FIRST + np.array([-0.05, 0.2, 0.2]))
    base = robot.link("base")
    heavy = replace(base, mass=300.0, inertia=np.eye(3) * 40, collisions=(*base.collisions, *([box] if panel else [])))
    return FreeFloating(replace(robot, links=(heavy, *robot.links[1:])))


@pytest.mark.long
def test_a_space_arm_passes_a_box_on_its_base() -> None:
    machine = space_arm(panel=True)
    free = plan(machine, line(), start=START, search="start", scene=False)
    assert least_apart(free, ()) < 0
    result = plan(machine, line(), start=START, search="start", scene=Scene(clearance=0.0))
    assert result.audit().passed
    assert least_apart(result, ()) >= -1e-6
    proof = result.audit().clearances["clearance"]
    assert proof.worst is not None
    assert "base" in proof.worst.bodies[0]


@pytest.mark.long
def test_a_space_arm_passes_a_box_in_the_world() -> None:
    machine = space_arm(panel=False)
    post = Sphere(0.08, FIRST + np.array([0, 0.2, 0.18]))
    free = plan(machine, line(), start=START, search="start", scene=False)
    result = plan(machine, line(), start=START, search="start", scene=Scene(obstacles=[post]))
    assert result.audit().passed
    assert least_apart(result, [post]) >= -1e-6
    assert result.cost >= free.cost * (1 - 1e-9)


def test_a_plan_that_was_saved_is_proven_again(tmp_path: File) -> None:
    planned(POST).save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz").audit()
    assert again.passed
    assert_allclose(
        again.clearances["clearance"].pairs[0].least, planned(POST).audit().clearances["clearance"].pairs[0].least
    )


def test_tasks_one_after_the_other_are_proven_stretch_by_stretch() -> None:
    first = TipTask(position=lambda t: ca.DM(FIRST) + smooth_step(t) * ca.DM(DISPLACEMENT), duration=SECONDS)
    back = TipTask(
        position=lambda t: ca.DM(FIRST + DISPLACEMENT) - smooth_step(t) * ca.DM(DISPLACEMENT),
        begin=3.0,
        duration=SECONDS,
    )
    ball = MovingObstacle(Sphere(0.05, (0, 0, 0)), lambda t: ca.DM(FIRST) + ca.vertcat(0, 0.25, 0.15 + 0.4 * (4.0 - t)))
    result = plan(ARM, [first, back], start=START, search="start", scene=Scene(obstacles=[ball], clearance=0.01))
    assert result.audit().passed
    assert len(result.audit().clearances) == 3
    assert least_apart(result, [ball], 10001) >= 0.01 - 1e-6


def torch_ur5() -> FixedBase:
    """A UR5 whose torch is a tube with a bent neck, 0.3 m long in all."""
    robot = ur5().robot
    tube = CollisionShape("capsule", (0.03, 0.16), translation=(0.0, 0.0, 0.11))
    neck = CollisionShape("capsule", (0.015, 0.1), translation=(0.03, 0.0, 0.23), rotation=rotation_about_y(0.5))
    carrier = robot.link(robot.tip_link)
    torch = replace(carrier, collisions=(*carrier.collisions, tube, neck))
    links = tuple(torch if link.name == carrier.name else link for link in robot.links)
    return FixedBase(replace(robot, links=links, tip_translation=(0.06, 0.0, 0.3)))


def rotation_about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.long
def test_every_motion_along_a_seam_is_clear_or_names_the_collision() -> None:
    machine = torch_ur5()
    around = CollisionScene(machine)
    assert any("tool0" in pair[1] and "upper_arm" in pair[0] for pair in around.labels)
    result = plan(machine, TipTask.along(curved_seam(), 0.03, steady=True, direction=DOWN))
    assert result.audit().passed
    assert result.audit().clearances["clearance"].settled
    reasons = [one.reason for one in result.candidates if one.reason is not None]
    collisions = [reason for reason in reasons if reason.kind is Rejection.COLLISION]
    assert collisions
    assert all(" overlap by " in str(reason) and " s" in str(reason) for reason in collisions)
    for reason in collisions:
        assert reason.value is not None
        assert reason.limit is not None
        assert reason.time is not None
        assert reason.value < reason.limit
        assert 0 <= reason.time <= result.horizon
    for one in result.candidates:
        if one.solution is not None and (one.reason is None or one.reason.kind is not Rejection.COLLISION):
            at = one.solution.at_fraction(np.linspace(0, 1, 2001))
            assert distances_along(around, np.zeros(0), at["joints"], np.zeros(2001)).min() >= -1e-6
    bare = plan(machine, TipTask.along(curved_seam(), 0.03, steady=True, direction=DOWN), scene=False)
    assert bare.cost <= result.cost * (1 + 1e-6)


# ---- what cannot be kept clear -----------------------------------------------------------------------------------


def test_pairs_clear_within_limits_are_checked_without_limits() -> None:
    robot = armoured_arm()
    narrow = replace(robot, joints=tuple(replace(joint, lower=-0.3, upper=0.3) for joint in robot.joints))
    within, beyond = (CollisionScene(FixedBase(narrow), limits=limits) for limits in (True, False))
    assert within.excluded["link2", "link6"] == "never in collision"
    assert ("link2", "link6") in beyond.labels
    free_of_limits = Limits(joints=False)
    required: dict[str, Any] = {"tasks": line(), "start": START, "horizon": SECONDS, "limits": free_of_limits}
    around = CollisionScene(ARM)
    with pytest.raises(ProblemError, match="limits=False"):
        minimum_velocity_problem(ARM, **required, setup=avoiding(around))
    with pytest.raises(ProblemError, match="limits=False"):
        inverse_kinematics(ARM, TipTask(position=FIRST), scene=around, options=IkOptions(limits=False))
    free = CollisionScene(ARM, limits=False)
    assert minimum_velocity_problem(
        ARM, **required, setup=VelocitySetup(clearance_constraints=ClearanceConstraints(free))
    ).declared.apart
    wide = plan(ARM, line(), start=START, search="start", limits=Limits(joints=False))
    assert wide.audit().passed


def test_a_colliding_start_names_the_pair_and_the_depth() -> None:
    with pytest.raises(ProblemError, match=r"start: link6 and obstacle 0 overlap by 0\.0") as caught:
        plan(ARM, line(), start=START, scene=Scene(obstacles=[Sphere(0.08, FIRST - (0.1, 0, 0))]))
    assert caught.value.name == "link6 and obstacle 0"
    assert caught.value.value < 0
    assert caught.value.time == 0
    assert re.search(r"; \d+ other configurations? (is|are) collision-free then", str(caught.value))


@pytest.mark.long
def test_a_target_inside_an_obstacle_names_the_pair_the_time_and_the_depth() -> None:
    with pytest.raises(SolveError, match=r"link6 and obstacle 0 overlap by 0\.\d+ m at [12]\.?\d* s") as caught:
        plan(
            ARM,
            line(),
            start=START,
            search="start",
            scene=Scene(obstacles=[Sphere(0.1, FIRST + DISPLACEMENT)], clearance=0.01),
        )
    assert caught.value.name == "link6 and obstacle 0"
    assert caught.value.value < caught.value.limit == 0.01
    assert 1 <= caught.value.time <= SECONDS
    last = str(caught.value).split("\n")[-1]
    assert last.startswith("the lowest-cost candidate in collision: link6 and obstacle 0 overlap")
    assert re.search(
        r"; no other configuration is collision-free then: each of the \d+ IK solutions is in collision", last
    )


@pytest.mark.long
def test_without_a_collision_free_configuration_no_alternatives_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    def alternatives(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(planner, "_try_alternatives", alternatives)
    with pytest.raises(SolveError, match="; no other configuration is collision-free then: each of the"):
        plan(ARM, line(), scene=Scene(obstacles=[Sphere(0.1, FIRST + DISPLACEMENT)], clearance=0.01))


def test_colliding_configurations_are_omitted_or_named() -> None:
    at = TipTask(position=FIRST)
    obstacle = Sphere(0.08, FIRST + np.array([-0.25, 0, 0.15]))
    around = CollisionScene(ARM, [obstacle], 0.01)
    every, clearance_constraints = inverse_kinematics(ARM, at), inverse_kinematics(ARM, at, scene=around)
    apart = [
        distances_along(around, np.zeros(0), configuration.joints[None], np.zeros(1)).min() for configuration in every
    ]
    assert len(clearance_constraints) == sum(each >= 0.01 for each in apart) < len(every)
    with pytest.raises(Unreachable, match=r"is in collision.*link6 and obstacle 0 overlap") as caught:
        inverse_kinematics(ARM, at, scene=CollisionScene(ARM, [Sphere(0.2, FIRST)]))
    assert caught.value.name == "link6 and obstacle 0"


@pytest.mark.long
def test_builders_accept_clearance_constraints() -> None:
    around = CollisionScene(ARM, [POST])
    problem = minimum_velocity_problem(ARM, line(), SECONDS, start=START, setup=avoiding(around))
    colliding = solve(problem, Collocation(16, 4)).audit()
    assert not colliding["clearance"].passed
    assert not colliding.feasible


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "clearance below zero": ({"scene": Scene(clearance=-0.01)}, "clearance"),
    "clearance not a number": ({"scene": Scene(clearance="near")}, "clearance"),  # type: ignore[arg-type]
    "clearance nan": ({"scene": Scene(clearance=np.nan)}, "clearance"),
    "an obstacle that is none": ({"scene": Scene(obstacles=[object()])}, "obstacles"),
    "a scene that is none": ({"scene": [POST]}, "scene"),
    "ignored links that do not exist": ({"scene": Scene(ignored=[("link2", "nobody")])}, "nobody"),
    "what becomes of missing meshes": ({"scene": Scene(missing="perhaps")}, "missing"),  # type: ignore[arg-type]
    "an SRDF file that is none": ({"scene": Scene(srdf="/nowhere/at/all.srdf")}, "srdf"),
    "an obstacle that moves while time is free": (
        {"scene": Scene(obstacles=[MovingObstacle(POST, lambda t: (t, 0, 0))]), "horizon": "free"},
        "obstacle",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_arguments_are_refused(case: str) -> None:
    options, word = BAD[case]
    with pytest.raises(ProblemError, match=word):
        plan(ARM, line(), **{"start": START, **options})


def test_an_obstacle_without_a_place() -> None:
    with pytest.raises(Exception, match="position"):
        Box(size=(0.1, 0.1, 0.1), position=None)


def test_a_colliding_configuration_is_cleared_by_self_motion() -> None:
    """From it alone; the tip stays where it is. What is around the tip's own place leaves none."""
    elbow = np.array(ca.DM(link_frames(ARM.robot, START)["link4"].position)).ravel()
    around = CollisionScene(ARM, [Sphere(0.1, elbow)], 0.01)
    assert distances_along(around, np.zeros(0), START[None], np.zeros(1)).min() < -0.05
    solutions = inverse_kinematics(ARM, line(), starts=0, near=START, scene=around)
    assert_allclose(tip_at(ARM, solutions[0].joints), FIRST, atol=1e-9)
    assert distances_along(around, np.zeros(0), solutions[0].joints[None], np.zeros(1)).min() >= 0.01
    buried = CollisionScene(ARM, [Sphere(0.1, FIRST)])
    with pytest.raises(Unreachable, match="in collision"):
        inverse_kinematics(ARM, line(), starts=0, near=START, scene=buried)
