from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import STANDING_STARTS, Standing, Support, rectangle
from models.machines.standing import center_of_pressure, standing_motion
from ocp import (
    AccelerationOptions,
    Collocation,
    MultipleShooting,
    Problem,
    ProblemError,
    Solution,
    SolveError,
    TipTask,
    resolve_accelerations,
    solve,
    tighten,
)
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, motion_cost, standing_problem
from ocp.motion.local.accelerations import Stabiliser
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Limits, Pinned
from tests.families import some
from tests.models.machines.standing_machines import planar_machine
from tests.models.robot.trees import numeric
from tests.ocp.motion.builders.standing_replay import assert_stands, assert_tips
from tests.ocp.motion.builders.standing_tasks import (
    ARM_HORIZON,
    ARM_START,
    HORIZON,
    LIFT_LIMITS,
    LIMITS,
    PLANAR_HORIZON,
    ROWS,
    SIX_START,
    arm,
    arm_task,
    led,
    lift_plan,
    machine,
    planar_start,
    planar_task,
    sampled,
    six,
    six_task,
    six_tool,
    spring,
    straight,
    table_plan,
    table_task,
    tip_at,
    tip_error,
    tool,
    with_setup,
)

pytestmark = pytest.mark.xdist_group("standing problems")  # one process, so that every plan is solved once

IN_RANGE = InFoot(0.02)  # -0.08 .. 0.18 m
MILLIMETRE = 1e-3


@cache
def held(problem: Problem, intervals: int = 80) -> Solution:
    return solve(problem, MultipleShooting(intervals, control="held"))


@cache
def points(problem: Problem, intervals: int) -> Solution:
    return solve(problem, Collocation(intervals, degree=3, scheme="legendre"))


@pytest.mark.parametrize(
    ("zmp", "cost", "index", "speed", "push"),
    [
        (IN_RANGE, -0.7078, 0.359, 1.02, 3.4),
        (IndexAtLeast(0.5), -0.653, 0.499, 1.03, 3.4),
        (IndexAtLeast(0.9), -0.379, 0.900, 1.08, 3.5),
        (Pinned(), -0.1104, 0.998, 1.26, 4.2),
        (Anywhere(), -1.022, -2.9, 1.09, 3.6),
    ],
    ids=["in_range", "index_half", "index_nine_tenths", "pinned", "none"],
)
def test_plans_of_table_1_have_the_published_cost(
    zmp: Any, cost: float, index: float, speed: float, push: float
) -> None:
    """Costs, least index on the dense grid and peak rates: reference computed independently, 80 intervals."""
    solution = held(table_plan(1, zmp))
    assert solution.cost == pytest.approx(cost, rel=2e-3)
    motion = sampled(machine(), solution)
    assert motion.index.min() == pytest.approx(index, abs=0.01)
    assert np.abs(solution["velocities"]).max() == pytest.approx(speed, abs=0.01)
    assert np.abs(solution["accelerations"]).max() == pytest.approx(push, abs=0.05)
    assert tip_error(machine(), motion, table_task(1)) < 1e-5
    assert motion.joint_excess.max() < 1e-6
    assert np.abs(motion.joint_velocities).max() <= 6 + 1e-6
    assert motion.ground_force[:, 2].min() > 60
    assert motion.stands == (not isinstance(zmp, Anywhere))
    np.testing.assert_allclose(solution["velocities"][[0, -1]], 0, atol=1e-9)
    if zmp is IN_RANGE:
        point = motion.zero_moment_point[:, 1]
        assert point.min() > -0.08 - MILLIMETRE
        assert point.max() < 0.18 + MILLIMETRE


@pytest.mark.parametrize(
    ("zmp", "cost"), [(IN_RANGE, -2.316), (IndexAtLeast(0.9), -2.235), (Pinned(), -2.000)], ids=str
)
def test_plans_of_table_2_against_the_spring_have_the_published_cost(zmp: Any, cost: float) -> None:
    solution = held(table_plan(2, zmp))
    assert solution.cost == pytest.approx(cost, rel=1e-3)
    motion = sampled(machine(), solution, spring())
    assert motion.stands
    assert tip_error(machine(), motion, table_task(2)) < 1e-5
    stretch = motion.tip_in_world[:, 1] - tip_at(machine(), STANDING_STARTS[2])[1]
    np.testing.assert_allclose(motion.external_force[:, 1], -150 * stretch, atol=1e-9)


@pytest.mark.long
def test_held_plans_converge_to_the_one_of_collocation_points() -> None:
    """Two transcriptions and two ways to hold the tip on its path; of first order, for the region binds at nodes."""
    best = points(table_plan(1, IN_RANGE, tip_level="acceleration"), 20).cost
    errors = [held(table_plan(1, IN_RANGE), n).cost - best for n in (20, 40, 80)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] > 0
    assert errors[2] < 2e-3


@pytest.mark.parametrize("zmp", [IN_RANGE, Pinned()], ids=["in_range", "pinned"])
def test_a_plan_at_collocation_points_passes_its_audit(zmp: Any) -> None:
    problem = table_plan(1, zmp, tip_level="acceleration")
    coarse, fine = points(problem, 20), points(problem, 40)
    assert coarse.cost == pytest.approx(fine.cost, rel=1e-3)
    audit = fine.audit(tolerances={"zero moment point": MILLIMETRE, "joints": 1e-6, "velocities": 1e-6, "tip": 0.02})
    assert audit.passed, str(audit)
    assert tip_error(machine(), sampled(machine(), fine), table_task(1)) < 1e-5


@pytest.mark.long
def test_the_audit_of_a_piecewise_constant_plan_reports_its_loss_alone() -> None:
    """80 held accelerations cost 2e-3 more than free ones, which is beyond what an optimum may lose."""
    solution = held(table_plan(1, IN_RANGE))
    audit = solution.audit(tolerances={"zero moment point": MILLIMETRE, "joints": 1e-6, "tip": 1e-5})
    assert audit.feasible, str(audit)
    assert audit.optimal is False
    assert not audit["cost lost, relative"].passed
    excess = solution.cost - points(table_plan(1, IN_RANGE, tip_level="acceleration"), 40).cost
    assert excess == pytest.approx(1.46e-3, rel=0.01)
    assert audit.lost.sum() == pytest.approx(excess, rel=0.2)


def test_collocation_with_held_controls_gives_the_same_plan_as_shooting() -> None:
    problem = table_plan(1, IndexAtLeast(0.5))
    other = solve(problem, Collocation(40, degree=3, scheme="legendre", control="held"))
    assert other.cost == pytest.approx(held(problem, 40).cost, abs=1e-4)


def test_the_reported_cost_is_that_of_the_sampled_motion_and_local_laws_cost_more() -> None:
    """The same cost on local laws, from the reference: pseudo-inverse 2.49, damped 0.57, stabilised 0.17."""
    solution = points(table_plan(1, IN_RANGE, tip_level="acceleration"), 20)
    times = np.linspace(0, HORIZON, 2001)
    values = solution.at_fraction(times / HORIZON)
    motion = standing_motion(
        machine(), times, values["joints"], values["velocities"], joint_accelerations=values["accelerations"], rows=ROWS
    )
    assert motion_cost(motion) == pytest.approx(solution.cost, abs=1e-5)
    costs = {}
    laws: dict[str, dict[str, Any]] = {
        "plain": {},
        "damped": {"options": AccelerationOptions(null_damping=2.0)},
        "stabilised": {
            "law": "stabilised",
            "options": AccelerationOptions(stabiliser=Stabiliser((3.5, 3.5, 3.5), gradient=1.8)),
        },
    }
    for name, law in laws.items():
        result = resolve_accelerations(machine(), table_task(1), HORIZON, start=STANDING_STARTS[1], step=1e-2, **law)
        costs[name] = motion_cost(result.motion)
        assert costs[name] > solution.cost
    assert costs["plain"] == pytest.approx(2.49, rel=0.01)
    assert costs["damped"] == pytest.approx(0.57, rel=0.01)
    assert costs["stabilised"] == pytest.approx(0.17, abs=0.01)


@pytest.mark.parametrize(
    ("zmp", "seconds"), [(Anywhere(), 0.457), (IN_RANGE, 0.503), (IndexAtLeast(0.9), 0.539)], ids=str
)
def test_the_fastest_lift_takes_longer_the_less_the_zero_moment_point_may_move(zmp: Any, seconds: float) -> None:
    solution = held(lift_plan(zmp), 50)
    assert solution.horizon == pytest.approx(seconds, rel=2e-3)
    assert solution["path"][-1, 0] == pytest.approx(1.0)
    motion = sampled(machine(), solution)
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    assert np.abs(motion.tip_in_world[:, 1] - y).max() < 1e-4  # straight up
    end = numeric(machine().tip_pose((), solution["joints"][-1]).position).ravel()
    np.testing.assert_allclose(end, [0, y, z + 0.8], atol=1e-8)
    assert (np.abs(motion.joint_torques).max(axis=0) <= np.array(LIFT_LIMITS.torque) * 1.01).all()
    assert motion.friction.max() < 0.6 * 1.02
    assert np.abs(solution["accelerations"]).max() <= 20 + 1e-6
    assert motion.ground_force[:, 2].min() > 59


def test_the_fastest_lift_does_not_depend_on_the_first_guess() -> None:
    problem = lift_plan(IN_RANGE)
    slow = held(lift_plan(IN_RANGE, horizon=2.0, weights=None), 50)
    assert solve(problem, MultipleShooting(50), guess=slow).horizon == pytest.approx(
        held(problem, 50).horizon, rel=1e-6
    )


def test_the_zero_moment_point_follows_a_reference() -> None:
    def reference(t: Any) -> list[Any]:
        return [0.0, 0.04 * ca.sin(t)]

    solution = points(table_plan(1, Pinned(reference), tip_level="acceleration"), 30)
    motion = sampled(machine(), solution)
    np.testing.assert_allclose(motion.zero_moment_point[:, 1], 0.04 * np.sin(motion.t), atol=MILLIMETRE)


@pytest.mark.parametrize("amplitude", [0.0, 0.04], ids=["pinned", "following"])
def test_held_jerks_keep_the_zero_moment_point_at_its_place_between_the_points(amplitude: float) -> None:
    def reference(t: Any) -> list[Any]:
        return [0.0, amplitude * ca.sin(t)]

    zmp: Any = Pinned(reference) if amplitude else Pinned()
    motion = sampled(machine(), held(table_plan(1, zmp, control="jerk"), 80))
    np.testing.assert_allclose(motion.zero_moment_point[:, 1], amplitude * np.sin(motion.t), atol=MILLIMETRE)
    assert tip_error(machine(), motion, table_task(1)) < 1e-5


def test_jerk_as_control_keeps_the_accelerations_continuous() -> None:
    solution = held(table_plan(1, IN_RANGE, control="jerk"), 60)
    assert solution.cost == pytest.approx(-0.703, abs=5e-3)
    motion = sampled(machine(), solution)
    assert motion.stands
    assert tip_error(machine(), motion, table_task(1)) < 1e-5
    steps = np.abs(np.diff(motion.joint_accelerations, axis=0)).max()
    assert steps < 1.1 * np.abs(solution["jerks"]).max() * HORIZON / 600


@pytest.mark.long
def test_free_ends_cost_less_than_rest_and_a_fixed_end_configuration_more() -> None:
    rest = points(table_plan(1, IN_RANGE, tip_level="acceleration"), 12)
    free = points(table_plan(1, IN_RANGE, tip_level="acceleration", end_velocity="free"), 12)
    loose = points(table_plan(1, IN_RANGE, tip_level="acceleration", start_velocity="free", end_velocity="free"), 12)
    assert loose.cost < free.cost < rest.cost
    configuration = (*(rest["joints"][-1, :2] + [0.05, -0.05]), np.nan, np.nan, np.nan)
    options = held(table_plan(1, IN_RANGE, end=configuration), 30)
    np.testing.assert_allclose(options["joints"][-1, :2], configuration[:2], atol=1e-8)
    assert options.cost > held(table_plan(1, IN_RANGE), 30).cost


def test_mx_symbols_take_an_interpolant_and_give_the_same_plan() -> None:
    knots = np.linspace(-0.1, HORIZON + 0.1, 61)
    rise = ca.interpolant("rise", "bspline", [knots], 0.4 * (1 - np.cos(knots)))
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    task = led(lambda t: ca.vertcat(y, z + rise(t) - float(rise(0.0))))
    settings: dict[str, Any] = {"zmp": IN_RANGE, "limits": LIMITS}
    setup = StandingSetup(symbols=ca.MX, start_velocity="free", end_velocity="free")
    problem = standing_problem(machine(), task, HORIZON, start=STANDING_STARTS[1], **settings, setup=setup)
    exact = table_plan(1, IN_RANGE, start_velocity="free", end_velocity="free")
    assert held(problem, 20).cost == pytest.approx(held(exact, 20).cost, abs=1e-4)


@pytest.mark.parametrize(
    ("standing", "task", "start", "wrenches", "index"),
    [
        pytest.param(arm(), arm_task(), ARM_START, tool, -0.3, marks=pytest.mark.long, id="seven joints"),
        pytest.param(six(), six_task(), SIX_START, six_tool, -0.01, id="six joints"),
    ],
)
def test_a_spatial_arm_stands_where_the_local_method_tips(
    standing: Standing, task: TipTask, start: Any, wrenches: Any, index: float
) -> None:
    horizon = ARM_HORIZON if standing is arm() else 1.0
    local = resolve_accelerations(standing, task, horizon, start=start, wrenches=wrenches, step=2e-3).motion
    assert not local.stands
    assert local.index.min() < index
    limits = Limits(friction=0.7, acceleration=100.0)
    settings: dict[str, Any] = {"zmp": InFoot(0.005), "limits": limits}
    problem = standing_problem(
        standing,
        task,
        horizon,
        start=start,
        **settings,
        setup=StandingSetup(tip_level="acceleration", wrenches=wrenches),
    )
    assert problem.declared.path["zero moment point"].size == 4  # both coordinates
    motion = sampled(standing, points(problem, 12), wrenches, (3, 4, 5))
    assert motion.stands
    assert motion.index.min() >= 0
    assert motion.stays_in_limits
    assert motion.friction.max() <= 0.7
    assert np.abs(motion.joint_torques).max() <= 300
    assert tip_error(standing, motion, task) < 1e-5
    if standing is arm():
        assert_stands(standing, motion, wrenches)
        assert_tips(standing, local, 0.05, wrenches)


def excess(standing: Standing, solution: Solution, limits: Limits, wrenches: Any = ()) -> dict[str, float]:
    """By how much what is limited is exceeded on ten times the grid, the ends of the intervals included."""
    count = solution.method["intervals"]
    inside = np.clip(np.linspace(0.0, 1.0, 11), 1e-9, 1 - 1e-9)  # from within: controls jump at the ends
    at = ((np.arange(count)[:, None] + inside) / count).ravel()
    values = solution.at_fraction(at)
    q, qd, qdd = (values[name] for name in ("joints", "velocities", "accelerations"))
    motion = standing_motion(standing, at * solution.horizon, q, qd, joint_accelerations=qdd, wrenches=wrenches)
    bounds = limits.bounds(standing)
    sizes = (motion.joint_velocities, motion.joint_accelerations, motion.joint_torques)
    most = {"velocity": bounds.velocity, "acceleration": bounds.acceleration, "torque": bounds.torque}
    by_name = {what: float((np.abs(size) - most[what]).max()) for what, size in zip(most, sizes, strict=True)}
    least = 0.1 * standing.weight if limits.vertical_force is None else limits.vertical_force
    by_name["vertical force"] = float(least - motion.ground_force[:, 2].min())
    by_name["friction"] = float((motion.friction - limits.friction).max())
    by_name["joints"] = float(motion.joint_excess.max()) if limits.joints else -np.inf
    by_name["foot"] = -float(motion.foot_margin.min())
    return by_name


@pytest.mark.parametrize("size", some([4, 6], [4]))
def test_other_machines_hold_tip_and_zero_moment_point_between_the_points(size: int) -> None:
    standing, task = planar_machine(size), planar_task(size)
    for method, level in ((MultipleShooting(80), "position"), (Collocation(30, scheme="legendre"), "acceleration")):
        settings = with_setup({"zmp": InFoot(0.01), "tip_level": level})
        problem = standing_problem(standing, task, PLANAR_HORIZON, start=planar_start(size), **settings)
        solution = solve(problem, method)
        result = excess(standing, solution, Limits())
        assert result.pop("foot") < -0.01 + MILLIMETRE
        assert max(result.values()) < 1e-6, result
        assert tip_error(standing, sampled(standing, solution), task) < 1e-5


def narrow() -> Standing:
    """The machine of the paper with joints 3 and 4 held closer than they would like."""
    joints = list(machine().robot.joints)
    joints[2] = replace(joints[2], upper=np.deg2rad(303.0))
    joints[3] = replace(joints[3], upper=np.deg2rad(261.0))
    return replace(machine(), robot=replace(machine().robot, joints=tuple(joints)))


FREELY = Weights(joint_limits=0.0)  # nothing but the limits keeps the joints from their ends


@pytest.mark.parametrize("level", some(["position", "acceleration"], ["position"]))
@pytest.mark.parametrize(
    ("standing", "limits", "weights"),
    [
        (narrow(), LIMITS, FREELY),
        (machine(), replace(LIMITS, velocity=0.7), None),
        (machine(), replace(LIMITS, torque=(45.0, 200.0, 108.0, 9.9, 2.9)), None),
        (machine(), replace(LIMITS, acceleration=2.0), None),
    ],
    ids=["joints", "velocities", "torques", "accelerations"],
)
def test_a_tightened_plan_holds_its_limits_between_the_points(
    standing: Standing, limits: Limits, weights: Any, level: Any
) -> None:
    settings: dict[str, Any] = {
        "zmp": IN_RANGE,
        "limits": limits,
        "weights": weights,
        "setup": StandingSetup(tip_level=level),
    }
    problem = standing_problem(standing, table_task(1), HORIZON, start=STANDING_STARTS[1], **settings)
    method = MultipleShooting(40) if level == "position" else Collocation(20, scheme="legendre")
    solution = tighten(problem, method)
    result = excess(standing, solution, limits)
    assert result.pop("foot") < -IN_RANGE.margin + 1e-6
    assert max(result.values()) < 1e-6, result
    assert 0 <= solution.cost - solve(problem, method).cost < 0.02


def test_the_fastest_lift_holds_its_limits_between_the_points() -> None:
    solution = tighten(lift_plan(IN_RANGE), MultipleShooting(50))
    result = excess(machine(), solution, LIFT_LIMITS)
    assert result.pop("foot") < -IN_RANGE.margin + 1e-6
    assert max(result.values()) < 1e-6, result
    assert solution.horizon == pytest.approx(0.503, rel=2e-3)
    values = solution.at_fraction((np.arange(500) + 0.5) / 500)
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    tips = np.array([tip_at(machine(), joints) for joints in values["joints"]])
    wanted = np.column_stack([np.full(500, y), z + 0.8 * values["path"][:, 0]])
    assert np.abs(tips[:, 1:] - wanted).max() < 1e-5


def test_the_plan_stands_in_a_contact_simulation_and_the_pseudo_inverse_falls() -> None:
    plan = sampled(machine(), held(table_plan(1, IN_RANGE)))
    assert_stands(machine(), plan)
    local = resolve_accelerations(machine(), table_task(1), HORIZON, start=STANDING_STARTS[1], step=5e-3).motion
    assert assert_tips(machine(), local, 0.3) == pytest.approx(6.17, abs=0.05)


def test_another_machine_stands_by_plan_and_tips_by_pseudo_inverse_in_a_contact_simulation() -> None:
    standing, task = planar_machine(5), planar_task(5, 0.75, -0.2)
    start, zmp = planar_start(5), InFoot(0.02)
    plan = sampled(standing, held(standing_problem(standing, task, PLANAR_HORIZON, start=start, zmp=zmp), 60))
    assert_stands(standing, plan)
    local = resolve_accelerations(standing, task, PLANAR_HORIZON, start=start, step=5e-3).motion
    assert not local.stands
    assert_tips(standing, local, 0.15)


def misses(problem: Any, method: Any) -> list[tuple[str, float, float]]:
    """(constraint, by how much, when) as the error of a plan that cannot be says, the worst first."""
    with pytest.raises(SolveError) as caught:
        solve(problem, method, options={"max_iter": 60})
    pattern = r"^  (.+) would have to go ([\d.e-]+) beyond its \w+ bound [\d.e-]+(?: at ([\d.e-]+) s)?$"
    result = re.findall(pattern, str(caught.value), re.MULTILINE)
    return [(name, float(amount), float(at) if at else np.nan) for name, amount, at in result]


def lean(horizon: Any, forward: float = 0.9, up: float = 0.5, **changes: Any) -> Any:
    """The tip led straight forward and up."""
    settings = with_setup({"zmp": IN_RANGE, "limits": LIMITS, "along": "parameter", **changes})
    return standing_problem(machine(), straight(forward, up), horizon, start=STANDING_STARTS[1], **settings)


@pytest.mark.parametrize("horizon", [3.0, FreeTime(0.5, 3.0, 2.0)], ids=["fixed", "free"])
def test_an_unreachable_target_names_the_violated_limit_its_time_and_size(horizon: Any) -> None:
    """Held 0.9 m ahead at rest the machine leans out of the foot: no way of moving there changes where it ends."""
    name, amount, time = misses(lean(horizon), MultipleShooting(20))[0]
    assert name == "zero moment point[1]"  # the front edge
    assert 0.1 < amount < 0.2
    assert 2.0 < time <= 3.0


def test_the_foot_that_the_error_asks_for_is_enough() -> None:
    problem = lean(3.0)
    _, amount, _ = misses(problem, MultipleShooting(20))[0]
    longer = replace(machine(), support=rectangle((-0.05, 0.05), (-0.1, 0.2 + amount + 0.02)))
    settings: dict[str, Any] = {"zmp": IN_RANGE, "limits": LIMITS, "setup": StandingSetup(along="parameter")}
    problem = standing_problem(longer, straight(0.9, 0.5), 3.0, start=STANDING_STARTS[1], **settings)
    assert held(problem, 20).success


def test_slow_joints_are_named_at_a_fixed_time_and_the_time_is_found_when_free() -> None:
    result = misses(table_plan(1, IN_RANGE, limits=replace(LIMITS, velocity=0.2)), MultipleShooting(20))
    assert result[0][0].startswith("velocities[")
    assert 0.2 < result[0][1] < 0.5
    assert 0 < result[0][2] < HORIZON
    slow = replace(LIMITS, velocity=0.8)
    result = misses(lean(FreeTime(0.2, 0.6, 0.5), 0.0, 0.8, limits=slow), MultipleShooting(20))
    assert result[0][0] == "horizon"
    assert 0.1 < result[0][1] < 0.6


def test_joints_that_are_too_weak_are_named() -> None:
    """Little more than what they take at the start; joint limits are lifted, or a posture beyond them would do."""
    weak = replace(LIMITS, joints=False, torque=(5.0, 205.0, 13.0, 6.0, 2.1))
    result = misses(table_plan(1, IN_RANGE, limits=weak), MultipleShooting(20))
    assert result[0][0] == "torques[2]"
    assert 0.5 < result[0][1] < 10
    assert 0 <= result[0][2] <= HORIZON


@pytest.mark.long
def test_a_tip_that_cannot_come_to_its_path_is_named() -> None:
    """Within the arm's length, but the joints cannot fold so far: they, or the tip, have to give way."""
    result = misses(lean(3.0, -0.6, -1.2, zmp=Anywhere()), MultipleShooting(20))
    assert {name.partition("[")[0] for name, *_ in result} <= {"joints", "tip"}
    assert result[0][1] > 0.05


def test_a_standing_machine_yields_to_a_time_dependent_force() -> None:
    def push(t: Any, tip: Any) -> Any:
        return [machine().tip_wrench((0, 30 * ca.sin(t), -20))]

    solution = held(table_plan(1, IN_RANGE, wrenches=push), 40)
    motion = sampled(machine(), solution, push)
    np.testing.assert_allclose(motion.external_force[:, 1], 30 * np.sin(motion.t), atol=1e-9)
    assert motion.stands
    k = 123
    reaction = machine().ground_reaction(
        motion.joints[k],
        motion.joint_velocities[k],
        motion.joint_accelerations[k],
        push(float(motion.t[k]), ca.DM(motion.tip_in_world[k])),
    )
    np.testing.assert_allclose(numeric(center_of_pressure(reaction)).ravel(), motion.zero_moment_point[k], atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": led(lambda t: [0.0, 0.5])}, "the frame of 'link5' is .* away from where its task begins"),
        ({"start": np.deg2rad([20.0, 160, 240, 200, 50])}, "'joint1' starts at 0.349.*outside its limits"),
        ({"tasks": TipTask(velocity=(0.0, 0.0), rows=(1, 4))}, r"no joint moves the tip in rows \[1\]"),
        ({"tasks": TipTask(velocity=(0.1,), rows=(4,))}, "'link5' moves at .* 0 s, where the joints are to be at rest"),
        ({"horizon": -1.0}, "horizon must be positive and finite"),
        ({"control": "force"}, "control must be 'acceleration' or 'jerk'"),
        ({"along": "arc"}, "along must be 'time' or 'parameter'"),
        ({"end_velocity": "soft"}, "end_velocity must be 'rest' or 'free'"),
        ({"control": "jerk", "tip_level": "acceleration"}, "goes with control 'acceleration'"),
        ({"zmp": "foot"}, "zmp must be InFoot, .* not 'foot'"),
        ({"zmp": InFoot(0.15)}, "margin 0.15 m is too large"),
        ({"limits": 3}, "limits must be a Limits, not "),
        ({"zmp": Pinned(lambda t: t)}, "Pinned: point must be two numbers"),
        ({"zmp": Pinned("here")}, "Pinned: point must be two numbers"),
        ({"end": np.deg2rad([140.0, 90, 240, 200, 50])}, "joints.*terminal.*2.44.*outside"),
        ({"zmp": Pinned((0.0,))}, "Pinned: point must be two numbers"),
        ({"zmp": Pinned(lambda t: [t])}, "Pinned: point must be two numbers"),
        ({"limits": Limits(velocity=(1.0, 2.0))}, "velocity has shape .* one for each of the 5 joints"),
        ({"horizon": 1.0}, "the task of .* moves at .* 1 s, where the joints are to be at rest"),
    ],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"tasks": table_task(1), "start": STANDING_STARTS[1], "horizon": HORIZON, **changes}
    with pytest.raises(ProblemError, match=message) as caught:
        standing_problem(machine(), **with_setup(arguments))
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_a_margin_wider_than_a_triangular_foot_is_refused() -> None:
    """Inscribed circle of 0.0828 m, though the bounding box is 0.3 m wide."""
    triangle = replace(arm(), support=Support([(-0.1, -0.1), (0.2, -0.1), (-0.1, 0.1828427)]))
    settings: dict[str, Any] = {"zmp": InFoot(0.09)}
    with pytest.raises(ProblemError, match=r"margin 0.09 m is too large .* 0.08\d"):
        standing_problem(triangle, arm_task(), ARM_HORIZON, start=ARM_START, **settings)


def test_a_path_longer_than_the_arm_is_refused() -> None:
    message = r"leads .* m away from the first joint .* at most 1.84 m long"
    with pytest.raises(ProblemError, match=message):
        standing_problem(
            machine(),
            straight(2.0, 0.0),
            3.0,
            start=STANDING_STARTS[1],
            limits=LIMITS,
            setup=StandingSetup(along="parameter"),
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: IndexAtLeast(1.0), "value must be below 1"),
        (lambda: Weights(velocity=-1.0), "weights: velocity"),
        (lambda: Weights(time="long"), "weights: time"),  # type: ignore[arg-type]
        (lambda: InFoot(np.nan), "InFoot: margin"),
        (lambda: InFoot(-0.3), "InFoot: margin"),
        (lambda: IndexAtLeast(None), "value must be below 1"),  # type: ignore[arg-type]
        (lambda: FreeTime(np.nan, 1.0, 1.0), "lower <= guess <= upper"),
        (lambda: Limits(velocity="fast"), "velocity 'fast' is not numeric"),
        (lambda: Limits(jerk=(1.0, 0.0)), "jerk .* is not positive"),
        (lambda: Limits(friction="ice"), "friction must be positive"),  # type: ignore[arg-type]
        (lambda: Limits(vertical_force=0.0), "vertical_force must be positive"),
        (lambda: Limits(friction=0.0), "friction must be positive"),
        (lambda: FreeTime(1.0, 0.5, 0.7), "lower <= guess <= upper"),
    ],
)
def test_options_that_cannot_be_right_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        make()
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_limits_that_are_lifted_do_not_hold_the_plan() -> None:
    loose = points(table_plan(1, Anywhere(), limits=replace(LIMITS, joints=False), tip_level="acceleration"), 12)
    assert loose.cost <= points(table_plan(1, Anywhere(), tip_level="acceleration"), 12).cost + 1e-9
