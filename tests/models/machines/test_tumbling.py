"""A floating body without joints and external forces tumbles according to Euler's equations."""

from __future__ import annotations

import casadi as ca
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models import FreeFloating, Link, Robot
from models.spatial import angular_velocity_from_quaternion
from ocp import ProblemError, TipTask, dynamics_problem, inverse_kinematics, minimum_velocity_problem
from scripts.robots.simulation import mujoco_model
from tests.models.robot.trees import Array

INERTIA = np.diag([5.0, 8.0, 6.0])
SPIN = np.array([0.2, 1.0, -0.1])  # near the greatest axis
MASS, CENTER = 60.0, np.array([0.1, -0.05, 0.2])


def body(inertia: Array = INERTIA, spin: Array = SPIN, velocity: Array | None = None) -> FreeFloating:
    """Its attitude is that of the world at the start."""
    link = Link("body", MASS, CENTER, inertia)
    robot = Robot((link,), (), tip="body", tip_translation=(0.5, 0.0, 0.1))
    speed = np.zeros(3) if velocity is None else velocity
    return FreeFloating(robot, conserved_momentum=np.concatenate([inertia @ spin, MASS * speed]))


def motion(machine: FreeFloating, times: Array) -> Array:
    """Configurations (M, 7), integrated to 1e-12."""
    b = ca.SX.sym("b", 7)
    rate = ca.Function("rate", [b], [machine.base_rate(b, ca.DM(0, 1), ca.DM(0, 1))])
    result = solve_ivp(
        lambda _, x: np.array(rate(x)).ravel(), (0.0, times[-1]), machine.base_home(), "DOP853", times, rtol=1e-12,
        atol=1e-13,
    )  # fmt: skip
    return np.asarray(result.y.T)


def test_a_symmetric_body_turns_about_its_momentum_and_its_axis() -> None:
    """R(t) = exp(L t / J) exp(w3 (1 - J3 / J) t e3): both rates are constant."""
    across, along = 4.0, 7.0
    machine = body(np.diag([across, across, along]), np.array([0.3, -0.2, 0.5]))
    momentum = np.asarray(machine.conserved_momentum)[:3]
    times = np.linspace(0, 40.0, 9)
    for t, configuration in zip(times, motion(machine, times), strict=True):
        turn = np.array(ca.DM(machine.world_from_base(configuration).rotation))
        about = [rotation_about(momentum * t / across), rotation_about([0, 0, 0.5 * (1 - along / across) * t])]
        assert turn == pytest.approx(about[0] @ about[1], abs=1e-9)


def rotation_about(vector: Array | list[float]) -> Array:
    result = np.zeros(9)
    quaternion = np.zeros(4)
    angle = float(np.linalg.norm(vector))
    axis = np.asarray(vector, dtype=float) / angle if angle else np.array([1.0, 0.0, 0.0])
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_quat2Mat(result, quaternion)
    return result.reshape(3, 3)


def test_spin_follows_euler_and_keeps_energy_and_momentum() -> None:
    """I w' = (I w) x w in the axes of the body; T = w . I w / 2 and L stay, by construction and by this."""
    machine = body()
    times = np.linspace(0, 30.0, 31)
    euler = solve_ivp(
        lambda _, w: np.linalg.solve(INERTIA, np.cross(INERTIA @ w, w)), (0, 30.0), SPIN, "DOP853", times, rtol=1e-12,
        atol=1e-13,
    )  # fmt: skip
    momentum = np.asarray(machine.conserved_momentum)[:3]
    for configuration, spin in zip(motion(machine, times), euler.y.T, strict=True):
        rate = np.array(ca.DM(machine.base_rate(configuration, (), ()))).ravel()
        turn = np.array(ca.DM(machine.world_from_base(configuration).rotation))
        result = turn.T @ np.array(ca.DM(angular_velocity_from_quaternion(configuration[3:], rate[3:]))).ravel()
        assert result == pytest.approx(spin, abs=1e-9)
        assert turn @ INERTIA @ result == pytest.approx(momentum, abs=1e-9)
        assert result @ INERTIA @ result == pytest.approx(SPIN @ INERTIA @ SPIN, abs=1e-9)


def test_a_body_tumbles_as_in_mujoco() -> None:
    """Pose after 5 s, and the twist of a frame on it, while its centre of mass drifts."""
    machine = body(velocity=np.array([0.1, -0.2, 0.05]))
    model = mujoco_model(machine.robot, options='timestep="0.0005" integrator="RK4"')
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    home = machine.base_home()
    twist = np.array(ca.DM(machine.base_twist(home, (), ()))).ravel()
    data.qpos[:], data.qvel[:3], data.qvel[3:] = home, twist[3:], twist[:3]
    for _ in range(10000):
        mujoco.mj_step(model, data)
    end = motion(machine, np.array([0.0, 5.0]))[-1]
    assert data.qpos == pytest.approx(end, abs=1e-8)
    tip = np.array(ca.DM(machine.tip_twist(end, (), ()))).ravel()
    assert tip[:3] == pytest.approx(data.xmat[1].reshape(3, 3) @ data.qvel[3:], abs=1e-8)


def test_bodies_without_joints_need_no_joint_positions() -> None:
    machine = body()
    task = TipTask(position=(0.5, 0.0, 0.1))
    for ask in (
        lambda: inverse_kinematics(machine, task),
        lambda: minimum_velocity_problem(machine, tasks=task, start=[], horizon=1.0),
        lambda: dynamics_problem(machine, (), 1.0, start=[]),
    ):
        with pytest.raises(ProblemError, match="joint") as caught:
            ask()
        assert caught.value.name
