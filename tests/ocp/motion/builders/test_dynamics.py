"""Motions by their drives: torques as Pinocchio has them, closed forms of effort and time, energy that adds up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest

from models import FixedBase, FreeFloating, Joint, Link, Robot, Wrench, planar_chain, with_load
from ocp import (
    Collocation,
    Cost,
    DynamicsSetup,
    FreeTime,
    JointFriction,
    Limits,
    Phases,
    Solution,
    TipTask,
    dynamics_problem,
    joint_torques,
    solve,
    tighten,
)
from tests.models.robot.pinocchio_robots import ROBOTS, Peer, random_state, swapped, urdf_file

MASS, DISPLACEMENT = 3.0, 0.8


def slider(mass: float = MASS) -> FixedBase:
    """A mass on a level rail."""
    carriage = Link("carriage", mass, (0, 0, 0), np.eye(3))
    joint = Joint("rail", "prismatic", "base", "carriage", axis=(1, 0, 0), lower=-9.0, upper=9.0)
    return FixedBase(Robot((Link("base"), carriage), (joint,), name="slider"))


def arm(mass: float = 2.0) -> Robot:
    return planar_chain([0.5, 0.4, 0.3], [mass, 1.5, 1.0])


def torques_along(
    machine: Any, plan: Solution | Mapping[str, Any], friction: JointFriction | None = None, **more: Any
) -> Any:
    """Torques of a plan at its reported points, or of samples of one. Shape (M, n)."""
    base, q, qd, qdd = (ca.SX.sym("z", n) for n in (machine.base_size, *[machine.joint_size] * 3))
    torques = ca.Function(
        "t", [base, q, qd, qdd], [joint_torques(machine, (base, q, qd, qdd), friction=friction, **more)]
    )
    at = plan["base"].T if machine.base_size else np.zeros((0, len(plan["joints"])))
    return np.array(torques(at, plan["joints"].T, plan["velocities"].T, plan["accelerations"].T)).T


# ---- torques ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panda", "ur5", "floating manipulator"])
def test_torques_of_a_floating_arm_are_those_of_pinocchio(name: str) -> None:
    """With the base's twist from a momentum of zero, and its acceleration so that nothing acts on it."""
    owner, ending, report = ROBOTS[name]
    path = urdf_file(owner, ending)
    robot = Robot.from_urdf(path, **report)
    machine, peer = FreeFloating(robot), Peer.of(path, robot)
    state = random_state(robot, np.random.default_rng(3))
    model, data, columns = peer.model, peer.data, peer.columns
    at, velocity = peer.configuration(state), np.zeros(peer.model.nv)
    velocity[columns] = state.qd
    centroidal = np.array(pinocchio.computeCentroidalMap(model, data, at))
    velocity[:6] = -np.linalg.solve(centroidal[:, :6], centroidal[:, columns] @ state.qd)
    model.gravity.setZero()
    inertia = pinocchio.crba(model, data, at)
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    bias = pinocchio.nonLinearEffects(model, data, at, velocity)
    second = np.zeros(model.nv)
    second[columns] = state.qdd
    second[:6] = -np.linalg.solve(inertia[:6, :6], inertia[:6, columns] @ state.qdd + bias[:6])
    theirs = (inertia @ second + bias)[columns]
    base, q, qd, qdd = (ca.SX.sym("z", n) for n in (7, *[robot.dof] * 3))
    ours = ca.Function("t", [base, q, qd, qdd], [joint_torques(machine, (base, q, qd, qdd))])
    result = np.array(ours(state.base, state.q, state.qd, state.qdd)).ravel()
    assert result == pytest.approx(theirs, rel=1e-8, abs=1e-8)
    assert swapped(velocity[:6]).any()


def test_a_heavy_base_stands_still() -> None:
    """A floating arm whose base weighs a million tonnes takes the torques of one that is fixed, without gravity."""
    fixed = FixedBase(arm())
    heavy = planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0], base=Link("base", 1e9, (0, 0, 0), 1e9 * np.eye(3)))
    base, q, qd, qdd = (ca.SX.sym("z", n) for n in (3, 3, 3, 3))
    one = joint_torques(FreeFloating(heavy, "planar"), (base, q, qd, qdd))
    other = joint_torques(fixed, ((), q, qd, qdd), gravity=(0, 0, 0))
    both = ca.Function("both", [base, q, qd, qdd], [one, other])
    rng = np.random.default_rng(1)
    left, right = (np.array(v).ravel() for v in both(np.zeros(3), *rng.normal(size=(3, 3))))
    assert left == pytest.approx(right, rel=1e-6)


def test_friction_is_against_the_motion() -> None:
    friction = JointFriction([1.0, 2.0, 3.0], 0.5, slip=0.01)
    rates = np.array([1.0, -0.5, 0.0])
    result = np.array(ca.DM(friction.torques(ca.DM(rates)))).ravel()
    assert result == pytest.approx([1.5, -1.5, 0.0])
    near = np.array(ca.DM(friction.torques(ca.DM([0.01, 0, 0])))).ravel()
    assert near[0] == pytest.approx(0.01 + 0.5 * np.tanh(1.0))


# ---- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [1.0, 2.0])
def test_the_least_effort_of_a_mass_is_known(horizon: float) -> None:
    """12 m^2 d^2 / T^3 from rest to rest, with a force that is linear in time."""
    problem = dynamics_problem(slider(), (), horizon, start=[0.0], end=[DISPLACEMENT])
    plan = solve(problem, Collocation(10, 3))
    assert plan.cost == pytest.approx(12 * MASS**2 * DISPLACEMENT**2 / horizon**3, rel=1e-8)
    assert plan.audit().passed


def test_the_least_time_of_a_mass_is_known() -> None:
    """2 sqrt(m d / F), full on and then full off."""
    limits = Limits(torque=5.0)
    problem = dynamics_problem(
        slider(),
        (),
        FreeTime(0.1, 9.0, 2.0),
        start=[0.0],
        end=[DISPLACEMENT],
        limits=limits,
        cost=Cost(velocity=0.0, time=1.0),
    )
    plan = solve(problem, Collocation(20, 3, control="held"))
    assert plan.horizon == pytest.approx(2 * np.sqrt(MASS * DISPLACEMENT / 5.0), rel=1e-6)
    assert np.abs(MASS * plan["accelerations"]).max() == pytest.approx(5.0, rel=1e-6)
    assert plan.audit().passed


def test_power_is_limited_and_braking_is_free() -> None:
    """With a power P alone a mass is at d no sooner than (3 d / 2)^(2/3) (m / 2 P)^(1/3)."""
    power = 4.0
    problem = dynamics_problem(
        slider(),
        (),
        FreeTime(0.1, 9.0, 1.5),
        start=[0.0],
        end=[DISPLACEMENT],
        limits=Limits(torque=200.0, power=power),
        cost=Cost(velocity=0.0, effort=1e-7, time=1.0),
        setup=DynamicsSetup(end_velocity="free"),
    )
    plan = solve(problem, Collocation(40, 3))
    least = (1.5 * DISPLACEMENT) ** (2 / 3) * (MASS / (2 * power)) ** (1 / 3)
    assert least < plan.horizon < 1.01 * least
    options = MASS * plan["accelerations"] * plan["velocities"]
    assert options.max() <= power * (1 + 1e-6)
    assert options.max() == pytest.approx(power, rel=1e-4)


def test_jerks_that_are_limited_make_a_mass_start_softly() -> None:
    problem = dynamics_problem(
        slider(), (), 2.0, start=[0.0], end=[DISPLACEMENT], limits=Limits(jerk=8.0), setup=DynamicsSetup(control="jerk")
    )
    plan = solve(problem, Collocation(20, 3))
    assert plan["accelerations"][[0, -1]] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(plan["jerks"]).max() <= 8.0 * (1 + 1e-6)
    assert plan.cost > 12 * MASS**2 * DISPLACEMENT**2 / 8.0


# ---- laws ------------------------------------------------------------------------------------------------------------


def test_the_least_effort_against_a_force_that_varies_is_a_line_in_time() -> None:
    """m q'' = u + F(t) with the least integral of u^2: u = a + b t, by the two ends at rest. A constant is a list."""
    horizon, size = 2.0, 5.0
    t, weights = np.polynomial.legendre.leggauss(20)
    t, weights = horizon * (t + 1) / 2, horizon * weights / 2

    def wave(time: Any) -> Any:
        return size * ca.sin(3 * time)

    def varying(time: Any, tip: Any) -> list[Wrench]:
        return [Wrench("carriage", (wave(time), 0.0, 0.0))]

    for wrenches, force in ((varying, np.array(wave(ca.DM(t))).ravel()), ([Wrench("carriage", (size, 0, 0))], size)):
        setup = DynamicsSetup(wrenches=wrenches)
        effort = Cost(velocity=0.0, effort=1.0)
        problem = dynamics_problem(slider(), (), horizon, start=[0.0], end=[DISPLACEMENT], cost=effort, setup=setup)
        result = solve(problem, Collocation(12, 4))
        rows = np.array([[weights.sum(), weights @ t], [weights @ (horizon - t), weights @ ((horizon - t) * t)]])
        right = [-weights @ (force * np.ones(20)), MASS * DISPLACEMENT - weights @ ((horizon - t) * force)]
        line = np.linalg.solve(rows, right)
        assert result.cost == pytest.approx(weights @ (line[0] + line[1] * t) ** 2, rel=1e-6)
        assert result.audit().passed


def test_energy_of_actuators_is_kinetic_or_lost_in_friction() -> None:
    """Work of the drives = kinetic + potential energy gained + what friction takes, over a plan that ends moving."""
    friction = JointFriction(0.4)
    machine = FixedBase(arm())
    still = [0.3, -0.4, 0.5]
    problem = dynamics_problem(
        machine, (), 1.0, start=still, end=[1.0, 0.2, -0.3], setup=DynamicsSetup(end_velocity="free", friction=friction)
    )
    plan = solve(problem, Collocation(30, 4))
    assert plan.audit().feasible
    q, qd, qdd = (ca.SX.sym("z", 3) for _ in range(3))
    drive = joint_torques(machine, ((), q, qd, qdd), friction=friction)
    options = ca.dot(drive, qd) - 0.4 * ca.sumsqr(qd)
    inertial = joint_torques(machine, ((), q, ca.DM.zeros(3), qd), gravity=(0, 0, 0))
    kinetic = ca.dot(inertial, qd) / 2
    power, energy = ca.Function("p", [q, qd, qdd], [options]), ca.Function("e", [q, qd], [kinetic])
    points, weights = np.polynomial.legendre.leggauss(8)
    nodes = plan.control_interpolant.breaks
    at = (nodes[:-1, None] + np.diff(nodes)[:, None] * (points + 1) / 2).ravel()
    here = plan.at_fraction(at)
    powers = np.array(power(here["joints"].T, here["velocities"].T, here["accelerations"].T)).reshape(-1, 8)
    work = float(powers @ weights @ np.diff(nodes)) / 2 * plan.horizon
    end = plan.at_fraction(1.0)
    assert work == pytest.approx(float(energy(end["joints"], end["velocities"])), rel=1e-5)  # the plane is level


def test_the_energy_cost_counts_positive_power_alone() -> None:
    """A mass that is pushed to v, coasts and is braked, which gives nothing back: m v^2 / 2, d = v T - v^2 m / F."""
    push, horizon = 40.0, 2.0
    problem = dynamics_problem(
        slider(),
        (),
        horizon,
        start=[0.0],
        end=[DISPLACEMENT],
        limits=Limits(torque=push),
        cost=Cost(velocity=0.0, energy=1.0),
    )
    plan = solve(problem, Collocation(80, 2))
    a = push / MASS
    fastest = a * (horizon - np.sqrt(horizon**2 - 4 * DISPLACEMENT / a)) / 2
    assert plan.cost == pytest.approx(MASS * fastest**2 / 2, rel=0.02)  # pushes are shorter than the mesh resolves


def test_a_task_is_done_within_the_torques() -> None:
    machine = FixedBase(arm())
    start = np.array([0.4, 0.9, -0.6])
    first = np.array(ca.DM(machine.tip_pose((), start).position)).ravel()

    def where(t: Any) -> Any:
        s = t / 1.5
        return ca.DM(first) + (10 * s**3 - 15 * s**4 + 6 * s**5) * ca.DM([-0.3, 0.2, 0.0])

    task = TipTask(position=where, rows=(3, 4))
    free = solve(dynamics_problem(machine, task, 1.5, start=start), Collocation(15, 4))
    most = 0.8 * np.abs(torques_along(machine, free)).max(axis=0)
    most[1:] = np.inf
    problem = dynamics_problem(machine, task, 1.5, start=start, limits=Limits(torque=most))
    plan = tighten(problem, Collocation(15, 4))
    audit = plan.audit()
    assert audit.feasible
    assert plan.cost > free.cost
    assert np.abs(torques_along(machine, plan)[:, 0]).max() <= most[0] * (1 + 1e-6)
    for t in np.linspace(0, 1.5, 5):
        tip = np.array(ca.DM(machine.tip_pose((), plan.at(t)["joints"]).position)).ravel()
        assert tip[:2] == pytest.approx(np.array(ca.DM(where(t))).ravel()[:2], abs=1e-5)


def test_a_floating_arm_costs_less_than_a_fixed_one_and_keeps_its_momentum() -> None:
    robot = planar_chain([0.5, 0.4], [2.0, 1.5], base=Link("base", 8.0, (0, 0, 0), 0.5 * np.eye(3)))
    machine = FreeFloating(robot, "planar")
    start, end = [0.2, 0.5], [1.2, -0.4]
    plan = solve(dynamics_problem(machine, (), 1.0, start=start, end=end), Collocation(15, 4))
    held = solve(
        dynamics_problem(FixedBase(robot), (), 1.0, start=start, end=end, setup=DynamicsSetup(gravity=(0, 0, 0))),
        Collocation(15, 4),
    )
    assert plan.audit().passed
    assert plan.cost < held.cost
    for t in (0.2, 0.5, 0.9):
        here = plan.at(t)
        rate = machine.base_rate(here["base"], here["joints"], here["velocities"])
        left = np.array(ca.DM(machine.momentum_residual(here["base"], here["joints"], rate, here["velocities"])))
        assert np.abs(left).max() < 1e-9


def test_a_load_is_picked_up_and_put_down() -> None:
    """The arm goes to the part, carries it and comes back: the loaded leg takes longer, the whole passes its audit."""
    robot = arm(1.0)
    loaded = FixedBase(with_load(robot, robot.tip_link, 2.0, (0.3, 0, 0)))
    places = [0.0, 0.4, 0.3], [1.0, -0.3, 0.6]
    effort, limits = Cost(velocity=0.0, effort=0.02, acceleration=2e-3, time=1.0), Limits(torque=6.0)
    free = FreeTime(0.1, 8.0, 2.0)
    reach = dynamics_problem(FixedBase(robot), (), free, start=places[0], end=places[1], cost=effort, limits=limits)
    carry = dynamics_problem(loaded, (), free, start=None, end=places[0], cost=effort, limits=limits)
    phases = Phases("pick and place", {"reach": reach, "carry": carry})
    phases.join("reach", "carry", {"velocities": None})  # both rest there
    plan = solve(phases, Collocation(20, 4))
    out, back = plan.phase("reach"), plan.phase("carry")
    assert back.horizon > out.horizon
    assert back["joints"][0] == pytest.approx(places[1], abs=1e-9)
    assert np.abs(torques_along(loaded, back)).max() <= 6.0 * (1 + 1e-6)
    assert plan.audit().passed
