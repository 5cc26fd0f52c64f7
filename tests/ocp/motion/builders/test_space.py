"""Spacecraft planned by what drives them: closed forms of wheels, attitudes, momentum that is kept."""

from __future__ import annotations

from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest

from models import FreeFloating, Joint, Link, Robot, Wrench, find_wheels, mass_matrix, planar_chain, with_wheels
from models.paths.splines import exponential
from ocp import (
    Collocation,
    Cost,
    DynamicsSetup,
    ProblemError,
    Solution,
    SolveError,
    TipTask,
    dynamics_problem,
    joint_torques,
    minimum_velocity_problem,
    solve,
)
from ocp import plan as plan_motion
from ocp.motion.local.rates import tracking_weights
from scripts.robots.simulation import mujoco_model
from tests.models.machines.test_actuators import satellite, state, wheeled
from tests.models.robot.trees import Array
from tests.ocp.motion.tasks.space_tasks import floating_manipulator

nan = np.nan
SHORT = Collocation(6, 4)
MASS, INERTIA, ROTOR = 50.0, 4.0, 0.05


def hub(mass: float = 0.0) -> FreeFloating:
    """A body with one wheel, of some mass, in the plane."""
    body = Link("hub", MASS, (0, 0, 0), np.diag([3.0, 3.0, INERTIA]))
    return FreeFloating(with_wheels(Robot((body,), ()), [[0, 0, 1]], ROTOR, momentum=9.0, mass=mass), "planar")


def body(momentum: Array | None = None) -> FreeFloating:
    """A body with three wheels."""
    link = Link("hub", 80.0, (0, 0, 0), np.diag([9.0, 12.0, 15.0]))
    return FreeFloating(with_wheels(Robot((link,), ()), np.eye(3), 0.02), conserved_momentum=momentum)


# ---- closed forms ------------------------------------------------------------------------------------------------


def test_a_wheel_turns_its_carrier_at_the_least_effort_that_is_known() -> None:
    """The motor turns the carrier alone: 12 J^2 a^2 / T^3, whatever the rotor; the rotor winds on the other way."""
    machine, angle, horizon = hub(), 0.7, 5.0
    problem = dynamics_problem(machine, (), horizon, start=[0.0], setup=DynamicsSetup(end_base=[nan, nan, angle]))
    plan = solve(problem, Collocation(8, 4))
    assert plan.cost == pytest.approx(12 * INERTIA**2 * angle**2 / horizon**3, rel=1e-8)
    assert plan["joints"][-1, 0] == pytest.approx(-angle * (INERTIA + ROTOR) / ROTOR, rel=1e-8)
    assert plan["base"][-1] == pytest.approx([0.0, 0.0, angle], abs=1e-10)
    assert plan.audit().passed


def test_wheels_preserve_the_initial_momentum() -> None:
    """A base that tumbles is stopped by its wheels, which then hold the momentum; nothing else has it."""
    momentum = np.array([1.0, -2.0, 1.5, 0.0, 0.0, 0.0])
    machine = body(momentum)
    horizon = 30.0
    problem = dynamics_problem(
        machine, (), horizon, start=np.zeros(3), setup=DynamicsSetup(start_velocity=np.zeros(3), end_velocity="free")
    )
    states = {name: v.symbol for name, v in problem.declared.states.items()}
    problem.end("spin", machine.base_twist(states["base"], states["joints"], states["velocities"])[:3], 0, 0)
    plan = solve(problem, Collocation(8, 4))
    turn = np.array(ca.DM(machine.world_from_base(plan["base"][-1]).rotation))
    assert turn @ (0.02 * plan["velocities"][-1]) == pytest.approx(momentum[:3], abs=1e-7)
    assert plan.audit().feasible


# ---- laws ----------------------------------------------------------------------------------------------------------


def test_the_work_of_the_actuators_is_kinetic_energy() -> None:
    """Power of motors is the rate of the energy of joints and base together, in any motion, whatever the momentum."""
    carried = np.random.default_rng(9).normal(size=6)
    machine = FreeFloating(wheeled(2), conserved_momentum=carried)
    n = machine.joint_size
    b, q, v, a = (ca.SX.sym("z", size) for size in (7, n, n, n))
    twist = machine.base_twist(b, q, v)
    locked, coupled = machine.momentum_matrices(b, q)
    at_origin = ca.vertcat(twist[:3], twist[3:] - ca.cross(twist[:3], b[:3]))
    energy = ca.dot(v, ca.mtimes(mass_matrix(machine.robot, q), v)) + ca.dot(at_origin, ca.mtimes(locked, twist))
    energy = energy / 2 + ca.dot(at_origin, ca.mtimes(coupled, v))
    rate = ca.jtimes(energy, ca.vertcat(b, q, v), ca.vertcat(machine.base_rate(b, q, v), v, a))
    both = ca.Function("both", [b, q, v, a], [rate, ca.dot(joint_torques(machine, (b, q, v, a)), v)])
    for seed in range(5):
        result, options = (float(value) for value in both(*state(machine, seed)))
        assert result == pytest.approx(options, rel=1e-9, abs=1e-9)


def turned(plan: Solution) -> float:
    """Largest angle by which the base turns, between the nodes too, rad."""
    fine = plan.at_fraction(np.linspace(0, 1, 2001))["base"][:, 3:]
    return float((2 * np.linalg.norm(fine[:, 1:], axis=1) / np.linalg.norm(fine, axis=1)).max())


def along(start: Array, shift: Any) -> Any:
    """A line from rest to rest in 20 s."""

    def where(t: Any) -> Any:
        s = t / 20.0
        return ca.DM(start) + (10 * s**3 - 15 * s**4 + 6 * s**5) * ca.DM(shift)

    return where


def null_space(machine: FreeFloating, start: Array, shift: Any, method: Collocation) -> None:
    """The tip runs along a line, and the base does not turn."""
    at = np.array(ca.DM(machine.tip_pose(machine.base_home(), start).position)).ravel()
    reach = TipTask(position=along(at[: len(shift)], shift), rows=(3, 4, 5)[: len(shift)])
    still = TipTask(link=machine.robot.root, rows=(0, 1, 2), velocity=np.zeros(3))
    held = solve(minimum_velocity_problem(machine, tasks=[reach, still], start=start, horizon=20.0), method)
    assert turned(held) < 1e-9
    end = np.array(ca.DM(machine.tip_pose(held["base"][-1], held["joints"][-1]).position)).ravel()
    assert end[: len(shift)] == pytest.approx(at[: len(shift)] + shift, abs=1e-4)
    assert held.audit().feasible


def test_two_arms_work_and_the_base_does_not_turn() -> None:
    """Reaction null space, 20 s: two rows of the tip and the attitude of the base, for six joints."""
    null_space(
        FreeFloating(satellite(2)), np.array([0.4, -0.5, 0.9, -0.3, 0.6, -0.8]), [-0.05, 0.1], Collocation(12, 6)
    )


def turned_in_mujoco(machine: FreeFloating, plan: Any, name: str = "velocities", wheels: float = 1.0) -> float:
    """Return the angle, rad, by which MuJoCo's angular momentum turns the base while the joints move as planned.

    Args:
        name: Of the joint rates. wheels: Share of the planned rates at which the wheels turn.
    """
    model = mujoco_model(machine.robot)
    data, times = mujoco.MjData(model), np.linspace(0.0, plan.horizon, 1001)
    joints = [model.joint(joint) for joint in machine.robot.joint_names]
    shares = [wheels if joint in find_wheels(machine.robot) else 1.0 for joint in machine.robot.joint_names]

    def momentum(velocity: Array) -> Array:
        data.qvel[:] = velocity
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        return np.array(data.subtree_angmom[1])

    rates = []
    for positions, velocities in zip(plan.at(times)["joints"], shares * plan.at(times)[name], strict=True):
        moving = np.zeros(model.nv)
        for joint, position, velocity in zip(joints, positions, velocities, strict=True):
            data.qpos[joint.qposadr[0]], moving[joint.dofadr[0]] = position, velocity
        inertia = np.column_stack([momentum(np.eye(model.nv)[k]) for k in (3, 4, 5)])
        rates.append(np.linalg.norm(np.linalg.solve(inertia, momentum(moving))))
    return float(np.trapezoid(rates, times))


@pytest.mark.long
def test_wheels_hold_the_attitude_while_the_arm_works() -> None:
    """The attitude as a task of the base, by torques, through 20 s."""
    machine = FreeFloating(wheeled(1))
    start, goal = [0.2, -0.4, 0.9, *[0.0] * 4], [0.9, 0.3, 0.1, *[nan] * 4]
    attitude = TipTask(link="hub", orientation=(1.0, 0.0, 0.0, 0.0))
    request: dict[str, Any] = {"end": goal, "setup": DynamicsSetup(end_velocity=[0.0] * 3 + [nan] * 4)}
    held = solve(dynamics_problem(machine, attitude, 20.0, start=start, **request), Collocation(20, 5))
    assert turned(held) < 1e-9
    assert turned_in_mujoco(machine, held) < 1e-6
    assert held.audit().feasible


def held_arm(inertia: float) -> tuple[FreeFloating, Array, list[TipTask], Array]:
    """The published arm with wheels of an inertia, kg m^2: start, tip task of 20 s with a fixed attitude, and goal."""
    options: dict[str, Any] = {"momentum": 800 * inertia, "torque": 1.0, "mass": 2.0}
    robot = with_wheels(floating_manipulator().robot, np.eye(3), inertia, **options)
    machine, start = FreeFloating(robot), np.array([0.3, -0.5, 0.4, 0.9, 0.2, 0.7, 0.1, *[0.0] * 3])
    shift = np.array([-0.15, 0.2, 0.1])
    place = np.array(ca.DM(machine.tip_pose(machine.base_home(), start).position)).ravel()
    tool = TipTask(position=along(place, shift), duration=20.0)
    hold = TipTask(link=robot.root, orientation=np.eye(3), duration=20.0)
    return machine, start, [tool, hold], place + shift


@pytest.mark.parametrize(
    ("inertia", "weight"),
    [
        pytest.param(0.05, 1e-7, marks=pytest.mark.long),  # a wheel turns by hundreds of rad
        pytest.param(0.05, 1e-4, marks=pytest.mark.long),  # such wheels cost more than the arm, which avoids them
        (0.2, 1e-4),
    ],
)
def test_wheels_hold_the_attitude_of_a_published_space_arm_while_its_tip_moves(inertia: float, weight: float) -> None:
    """A start and the tip's path are given; of the ten joints four are redundant."""
    machine, start, tasks, goal = held_arm(inertia)
    result = plan_motion(machine, tasks, start=start, cost=Cost(weights=[1.0] * 7 + [weight] * 3))
    assert result.audit().passed
    assert turned_in_mujoco(machine, result, "rates") < 1e-6
    assert turned_in_mujoco(machine, result, "rates", wheels=0.99) > 1e-6  # the check notices one per cent
    end = machine.tip_pose(result.at(20.0)["base"], result.at(20.0)["joints"])
    np.testing.assert_allclose(np.array(ca.DM(end.position)).ravel(), goal, atol=1e-6)


def test_too_costly_wheels_are_named_with_weights_at_which_they_cost_as_much_as_the_arm() -> None:
    """A wheel of inertia J at 1 rad/s turns a machine of inertia I by J / I about its axis: momentum is conserved."""
    rod = Link("rod", 1e-9, (0, 0, 0), 1e-9 * np.eye(3))
    links = Link("hub", 60.0, (0, 0, 0), np.diag([10.0, 12.0, 16.0])), rod
    body = Robot(links, (Joint("shoulder", "revolute", "hub", "rod"),))
    machine = FreeFloating(with_wheels(body, np.eye(3), 0.02))
    requested = np.array([2.0, 1.0, 1.0, 1e-9])
    weights, light = tracking_weights(machine, machine.base_home(), np.zeros(4), requested)
    np.testing.assert_array_equal(weights, requested)
    inertias = np.array([10.0, 12.0]) + 0.02 + 2 * 0.6 * 0.02  # a disc: 0.6 of its axial inertia
    np.testing.assert_allclose(light, [2.0, *2.0 * (0.02 / inertias) ** 2, 1e-9], rtol=1e-6)
    costly, start, tasks, _ = held_arm(0.01)
    with pytest.raises(SolveError, match=r"time limit.*lower weights of the reaction wheels.*'wheel3'"):
        plan_motion(costly, tasks, start=start, time_limit=1.0)


def test_turning_that_costs_is_less() -> None:
    chain = planar_chain([0.8, 0.6], [4.0, 3.0], base=Link("hub", 40.0, (0, 0, 0), 4.0 * np.eye(3)))
    machine = FreeFloating(with_wheels(chain, [[0, 0, 1]], 0.02), "planar")
    request: dict[str, Any] = {"end": [1.2, 0.3, nan], "setup": DynamicsSetup(end_velocity=[0.0, 0.0, nan])}

    def most(effort: Cost | None) -> float:
        held = solve(dynamics_problem(machine, (), 10.0, start=[0.2, -0.9, 0.0], cost=effort, **request), SHORT)
        return float(np.abs(held["base"][:, 2]).max())

    assert most(Cost(velocity=0.0, effort=1.0, turning=1e4)) < 0.1 * most(None)


def test_an_attitude_is_held_at_the_end_whatever_the_sign_of_its_quaternion() -> None:
    machine = body()
    goal = exponential(0.4 * np.array([0.6, 0.0, 0.8]))
    plans = []
    for sign in (1.0, -1.0):
        problem = dynamics_problem(
            machine, (), 20.0, start=np.zeros(3), setup=DynamicsSetup(end_base=[nan, nan, nan, *(sign * goal)])
        )
        plans.append(solve(problem, SHORT))
    for plan in plans:
        assert plan["base"][-1, 3:] == pytest.approx(goal, abs=1e-8)
    assert plans[0].cost == pytest.approx(plans[1].cost, rel=1e-8)


def test_arguments_that_do_not_fit_a_spacecraft_are_refused_by_name() -> None:
    machine = hub()
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"end_base": [0.0, 0.0]}, "end_base"),
        ({"wrenches": [Wrench("hub", (1, 0, 0))]}, "wrenches"),
        ({"start_velocity": [0.0, 1.0]}, "start_velocity"),
    ]
    for report, name in wrong:
        with pytest.raises(ProblemError) as caught:
            dynamics_problem(machine, (), 5.0, start=[0.0], setup=DynamicsSetup(**report))
        assert caught.value.name == name
