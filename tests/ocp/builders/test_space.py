"""Spacecraft planned by what drives them: closed forms of wheels and thrusters, attitudes, momentum that changes."""

from __future__ import annotations

from typing import Any, Literal

import casadi as ca
import mujoco
import numpy as np
import pytest

from models import FreeFloating, Link, Robot, Thruster, Wrench, gyros_of, mass_matrix, planar_chain, with_wheels
from models.machines.machine import with_tip
from models.robot.dynamics import external_wrench
from models.spatial import quaternion_about
from ocp import (
    Collocation,
    Effort,
    FreeTime,
    Leg,
    ProblemError,
    Solution,
    TipTask,
    dynamics_phases,
    dynamics_problem,
    joint_torques,
    minimum_velocity_problem,
    plan_dynamics,
    solve,
)
from ocp.problem.values import constant
from tests.models.machines.test_actuators import SPINNING, moving, pyramid, satellite, state, wheeled
from tests.models.robot.oracles import mujoco_model
from tests.models.robot.trees import Array

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
    problem = dynamics_problem(machine, [0.0], horizon, end_base=[nan, nan, angle])
    plan = solve(problem, Collocation(8, 4))
    assert plan.cost == pytest.approx(12 * INERTIA**2 * angle**2 / horizon**3, rel=1e-8)
    assert plan["joints"][-1, 0] == pytest.approx(-angle * (INERTIA + ROTOR) / ROTOR, rel=1e-8)
    assert plan["base"][-1] == pytest.approx([0.0, 0.0, angle], abs=1e-10)
    assert plan.audit().passed


def test_thrusters_burn_coast_and_brake() -> None:
    """From rest to rest over d in T: both burns take t, (F / m) t (T - t) = d; least fuel is 2 F t, full on and off."""
    machine, force, way, horizon = hub(), 5.0, 2.775, 20.0
    thrusters = [Thruster("hub", (1, 0, 0), force), Thruster("hub", (-1, 0, 0), force)]
    problem = dynamics_problem(
        machine, [0.0], horizon, end_base=[way, 0.0, 0.0], end_momentum=np.zeros(3), thrusters=thrusters,
        effort=Effort(torque=1e-3, fuel=1.0),
    )  # fmt: skip
    plan = solve(problem, Collocation(40, 2))
    burn = (horizon - np.sqrt(horizon**2 - 4 * way * MASS / force)) / 2
    least = 2 * force * burn
    assert burn == pytest.approx(1.5)  # three intervals
    assert plan.cost == pytest.approx(least, rel=1e-5)
    assert plan["momentum"][:, 1].max() == pytest.approx(force * burn, rel=1e-4)
    assert np.abs(plan["momentum"][:, [0, 2]]).max() < 1e-6
    assert plan["thrust"].max() <= force * (1 + 1e-6)


def switched(*firing: list[Thruster]) -> list[Leg]:
    """Legs on which thrusters are full on, or off, the wheel at rest between them."""
    return [Leg(None, FreeTime(0.01, 40.0, 5.0), firing=each) for each in firing]


def test_thrusters_that_are_on_or_off_switch_when_it_is_best() -> None:
    """Rest to rest over d: in a fixed time T, (F / m) t (T - t) = d; in a free one that costs w a second,

    t = sqrt(w m d / F / (2 F + w)) for least 2 F t + w T, from T = t + m d / (F t).
    """
    machine, force, way, horizon, worth = hub(), 5.0, 2.775, 20.0, 0.5
    on, back = (Thruster("hub", (side, 0, 0), force) for side in (1, -1))
    asked: dict[str, Any] = {
        "method": Collocation(2, 3, scheme="legendre"), "end_base": [way, 0.0, 0.0], "end_momentum": np.zeros(3)
    }  # fmt: skip
    legs = switched([on], [], [back])
    for total, weight in ((horizon, 0.0), (None, worth)):
        effort = Effort(torque=1e-3, fuel=1.0, time=weight)
        plan = plan_dynamics(machine, [0.0], legs, total=total, effort=effort, **asked)
        burn = (horizon - np.sqrt(horizon**2 - 4 * way * MASS / force)) / 2
        burn = burn if total else np.sqrt(worth * way * MASS / force / (2 * force + worth))
        whole = burn + way * MASS / (force * burn)
        times = [plan.phase(f"leg {k}").horizon for k in (1, 2, 3)]
        assert times == pytest.approx([burn, whole - 2 * burn, burn], rel=1e-6)
        assert plan.cost == pytest.approx(2 * force * burn + weight * whole, rel=1e-8)
        assert plan.audit().passed
    with pytest.raises(ProblemError, match="switch") as caught:
        dynamics_phases(machine, [0.0], [*legs, Leg(None, 1.0)])
    assert caught.value.name == "firing"


def test_a_turn_by_thrusters_that_switch_is_that_of_mujoco() -> None:
    """Couples burn and brake, a wheel helps: MuJoCo, told when they switch and the wheel's torque, ends there, too."""
    machine, force, arm, angle = hub(0.1), 0.4, 0.5, 0.8
    turns, stops = (
        [Thruster("hub", (0, way * side, 0), force, (way * arm, 0, 0)) for way in (1, -1)] for side in (1, -1)
    )
    push = Thruster("hub", (1, 0, 0), 0.1)
    fired = [*turns, push], [push], stops
    plan = plan_dynamics(
        machine, [0.0], switched(*fired), total=6.0, end_base=[nan, nan, angle], end_momentum=[0.0, nan, nan],
        effort=Effort(torque=100.0, fuel=1.0), method=Collocation(4, 4, scheme="legendre"),
    )  # fmt: skip
    assert plan.audit().feasible
    model = mujoco_model(machine.robot)
    model.opt.gravity[:] = 0.0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data, carrier, wheel = mujoco.MjData(model), model.body("hub").id, model.joint("wheel1").dofadr[0]
    count = 200
    for k, burning in enumerate(fired):
        leg = plan.phase(f"leg {k + 1}")
        assert leg.horizon > 0.1
        model.opt.timestep = leg.horizon / count
        for torque in wheel_torques(machine, leg, burning, count):
            mujoco.mj_kinematics(model, data)
            turn = data.xmat[carrier].reshape(3, 3)
            forces = [turn @ each.direction * each.force for each in burning]
            moments = [np.cross(turn @ each.point, push) for each, push in zip(burning, forces, strict=True)]
            data.xfrc_applied[carrier] = np.concatenate([np.sum(forces, axis=0), np.sum(moments, axis=0)])
            data.qfrc_applied[wheel] = torque
            mujoco.mj_step(model, data)
    last = plan.phase("leg 3").at_fraction(1.0)
    assert data.qpos[:2] == pytest.approx(last["base"][:2], abs=1e-4)
    assert 2 * np.arctan2(data.qpos[6], data.qpos[3]) == pytest.approx(angle, abs=1e-5)
    assert machine.robot.total_mass * data.qvel[:2] == pytest.approx(last["momentum"][1:], abs=1e-3)
    assert data.qvel[wheel] == pytest.approx(0.0, abs=1e-4)


def wheel_torques(machine: FreeFloating, leg: Solution, burning: list[Thruster], count: int) -> Array:
    """Of a wheel in the middle of so many steps. Shape (count,)."""
    base, joints, rates, second = (ca.SX.sym("z", size) for size in (6, 1, 1, 1))
    frames = {"hub": machine.world_from_base(base)}
    wrenches = [each.wrench(frames, each.force) for each in burning]
    torque = ca.Function(
        "torque",
        [base, joints, rates, second],
        [joint_torques(machine, base, joints, rates, second, wrenches=wrenches)],
    )
    at = leg.at_fraction((np.arange(count) + 0.5) / count)
    poses = np.hstack([at["base"], at["momentum"]])
    return np.array(torque(poses.T, at["joints"].T, at["velocities"].T, at["accelerations"].T)).ravel()


def test_momentum_that_is_given_is_kept_by_wheels() -> None:
    """A base that tumbles is stopped by its wheels, which then hold the momentum; nothing else has it."""
    momentum = np.array([1.0, -2.0, 1.5, 0.0, 0.0, 0.0])
    machine = body(momentum)
    horizon = 30.0
    problem = dynamics_problem(machine, np.zeros(3), horizon, start=np.zeros(3), end="free")
    states = {name: v.symbol for name, v in problem.declared.states.items()}
    problem.end("spin", machine.base_twist(states["base"], states["joints"], states["velocities"])[:3], 0, 0)
    plan = solve(problem, Collocation(8, 4))
    turn = np.array(ca.DM(machine.world_from_base(plan["base"][-1]).rotation))
    assert turn @ (0.02 * plan["velocities"][-1]) == pytest.approx(momentum[:3], abs=1e-7)
    assert plan.audit().feasible


def gyro_slew(rate: float, horizon: float) -> dict[str, Any]:
    """Half a radian about an axis between, from rest to rest."""
    goal = np.array(ca.DM(quaternion_about((0.6, 0.0, 0.8), 0.5))).ravel()
    robot = pyramid(rate=rate, torque=8.0)
    return {
        "machine": FreeFloating(robot), "start_joints": np.zeros(8), "horizon": horizon, "start": SPINNING,
        "end_base": [nan, nan, nan, *goal], "steady": [gyro.rotor for gyro in gyros_of(robot)],
        "effort": Effort(torque=[1.0, 0.0] * 4, acceleration=[1.0, 0.0] * 4),
        "method": Collocation(8, degree=4, scheme="legendre"),
    }  # fmt: skip


def test_a_pyramid_of_gyros_turns_a_body_within_the_rates_of_its_gimbals() -> None:
    """The rotors' speed stays, and the momentum of all in MuJoCo is zero wherever one looks."""
    asked = gyro_slew(0.55, 6.0)
    plan, machine = plan_dynamics(**asked), asked["machine"]
    audit = plan.audit()
    assert audit.passed, audit
    assert plan["base"][-1] == pytest.approx([*plan["base"][-1, :3], *asked["end_base"][3:]], abs=1e-8)
    fine = plan.at_fraction(np.linspace(0, 1, 31))
    assert fine["velocities"][:, 1::2] == pytest.approx(100.0, abs=1e-9)
    assert 0.54 < np.abs(fine["velocities"][:, ::2]).max() < 0.55 + 1e-5
    for base, joints, rates in zip(fine["base"], fine["joints"], fine["velocities"], strict=True):
        model, data = moving(machine, base, joints, rates)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        assert np.abs(data.subtree_angmom[1]).max() < 1e-8


@pytest.mark.parametrize("end", ["rest", "free"])
def test_rotors_of_gyros_keep_their_speed_through_all_legs(end: Literal["rest", "free"]) -> None:
    """Two legs, with a stop between them or none: nothing is asked for that stops a rotor, nor twice."""
    robot = pyramid(rate=0.8, torque=8.0)
    asked: dict[str, Any] = {"start": SPINNING, "steady": [gyro.rotor for gyro in gyros_of(robot)]}
    legs = [Leg(None, 3.0, end=end), Leg(None, 3.0)]
    problem = dynamics_phases(FreeFloating(robot), np.zeros(8), legs, **asked)
    begins = problem.of("leg 2")["velocities"].initial
    rotors = slice(1, None, 2)
    if end == "rest":
        assert constant(begins) == pytest.approx(SPINNING)
        assert "leg 1 to leg 2: velocities" not in problem.declared.end
    else:
        assert begins is None or np.isnan(constant(begins)).all()
        joined = problem.declared.end["leg 1 to leg 2: velocities"].expression
        before, after = (problem[f"leg {k}"] for k in (1, 2))
        gaps = ca.Function("gaps", [after.at_start("velocities"), before.at_end("velocities")], [joined])
        told = np.array(gaps(SPINNING, np.zeros(8))).ravel()
        assert told[rotors] == pytest.approx(np.zeros(4))
        assert np.array(gaps(np.zeros(8), np.ones(8))).ravel()[::2] == pytest.approx(-1.0)
    with pytest.raises(ProblemError, match="keep their speed") as caught:
        dynamics_phases(FreeFloating(robot), np.zeros(8), legs, **(asked | {"start": "free"}))
    assert caught.value.name == "steady"


# ---- laws ----------------------------------------------------------------------------------------------------------


def test_what_the_drives_give_is_kinetic_energy() -> None:
    """Power of motors and of what pushes is the rate of the energy of joints and base together, in any motion."""
    machine = FreeFloating(wheeled(2))
    n = machine.joint_size
    push = Wrench("arm1_link1", (0.5, 2.0, -1.0), (0.3, 0.1, -0.4), (0.4, 0.0, 0.1))
    b, q, v, a = (ca.SX.sym("z", size) for size in (13, n, n, n))
    twist = machine.base_twist(b, q, v)
    locked, coupled = machine.momentum_matrices(b, q)
    at_origin = ca.vertcat(twist[:3], twist[3:] - ca.cross(twist[:3], b[:3]))
    energy = ca.dot(v, ca.mtimes(mass_matrix(machine.robot, q), v)) + ca.dot(at_origin, ca.mtimes(locked, twist))
    energy = energy / 2 + ca.dot(at_origin, ca.mtimes(coupled, v))
    outside = external_wrench(machine.robot, q, [push], machine.world_from_base(b))
    moving = ca.vertcat(machine.base_rate(b, q, v), machine.momentum_rate(b, q, outside), v, a)
    rate = ca.jtimes(energy, ca.vertcat(b, q, v), moving)
    carrier = with_tip(machine, push.link, np.array(push.point).ravel())
    power = ca.dot(joint_torques(machine, b, q, v, a, wrenches=[push]), v)
    power += ca.dot(ca.vertcat(push.moment, push.force), carrier.tip_twist(b, q, v))
    both = ca.Function("both", [b, q, v, a], [rate, power])
    for seed in range(5):
        pose, joints, rates, accelerations = state(machine, seed)
        momentum = np.random.default_rng(seed).normal(size=6)
        found, given = (float(value) for value in both(np.concatenate([pose, momentum]), joints, rates, accelerations))
        assert found == pytest.approx(given, rel=1e-9, abs=1e-9)


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
    held = solve(minimum_velocity_problem(machine, task=[reach, still], start_joints=start, horizon=20.0), method)
    assert turned(held) < 1e-9
    end = np.array(ca.DM(machine.tip_pose(held["base"][-1], held["joints"][-1]).position)).ravel()
    assert end[: len(shift)] == pytest.approx(at[: len(shift)] + shift, abs=1e-4)
    assert held.audit().feasible


def test_two_arms_work_and_the_base_does_not_turn() -> None:
    """Reaction null space, 20 s: two rows of the tip and the attitude of the base, for six joints."""
    null_space(
        FreeFloating(satellite(2)), np.array([0.4, -0.5, 0.9, -0.3, 0.6, -0.8]), [-0.05, 0.1], Collocation(12, 6)
    )


@pytest.mark.long
def test_wheels_hold_the_attitude_while_the_arm_works() -> None:
    """The attitude as a task of the base, by torques, through 20 s."""
    machine = FreeFloating(wheeled(1))
    start, goal = [0.2, -0.4, 0.9, *[0.0] * 4], [0.9, 0.3, 0.1, *[nan] * 4]
    attitude = TipTask(link="hub", orientation=(1.0, 0.0, 0.0, 0.0))
    asked: dict[str, Any] = {"end_joints": goal, "end": [0.0] * 3 + [nan] * 4}
    held = solve(dynamics_problem(machine, start, 20.0, tasks=attitude, **asked), Collocation(20, 5))
    assert turned(held) < 1e-9
    assert held.audit().feasible


def test_turning_that_costs_is_less() -> None:
    chain = planar_chain([0.8, 0.6], [4.0, 3.0], base=Link("hub", 40.0, (0, 0, 0), 4.0 * np.eye(3)))
    machine = FreeFloating(with_wheels(chain, [[0, 0, 1]], 0.02), "planar")
    asked: dict[str, Any] = {"end_joints": [1.2, 0.3, nan], "end": [0.0, 0.0, nan]}

    def most(effort: Effort | None) -> float:
        plan = solve(dynamics_problem(machine, [0.2, -0.9, 0.0], 10.0, effort=effort, **asked), SHORT)
        return float(np.abs(plan["base"][:, 2]).max())

    assert most(Effort(turning=1e4)) < 0.1 * most(None)


def test_an_attitude_is_held_at_the_end_whatever_the_sign_of_its_quaternion() -> None:
    machine = body()
    goal = np.array(ca.DM(quaternion_about((0.6, 0.0, 0.8), 0.4))).ravel()
    plans = []
    for sign in (1.0, -1.0):
        problem = dynamics_problem(machine, np.zeros(3), 20.0, end_base=[nan, nan, nan, *(sign * goal)])
        plans.append(solve(problem, SHORT))
    for plan in plans:
        assert plan["base"][-1, 3:] == pytest.approx(goal, abs=1e-8)
    assert plans[0].cost == pytest.approx(plans[1].cost, rel=1e-8)


def test_what_does_not_fit_a_spacecraft_is_refused_by_name() -> None:
    machine = hub()
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"end_momentum": np.zeros(3)}, "end_momentum"),
        ({"end_base": [0.0, 0.0]}, "end_base"),
        ({"thrusters": [Thruster("bus", (1, 0, 0), 1.0)]}, "thrusters"),
        ({"start": [0.0, 1.0]}, "start"),
        ({"steady": "wheel1"}, "steady"),
        ({"steady": ["wheel2"]}, "wheel2"),
        ({"firing": [Thruster("bus", (1, 0, 0), 1.0)]}, "thrusters"),
    ]
    for told, name in wrong:
        with pytest.raises(ProblemError) as caught:
            dynamics_problem(machine, [0.0], 5.0, **told)
        assert caught.value.name == name
