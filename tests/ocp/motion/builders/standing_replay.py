"""A motion of a standing machine replayed in MuJoCo: a loose foot on a floor, joints on stiff servos."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from models import Standing
from models.machines.machine import Wrenches
from models.machines.standing import StandingMotion
from scripts.robots.simulation import mujoco_model
from tests.models.robot.trees import Array

FOOT_MASS = 1.0  # kg; the simulator takes no body without mass
SERVO = 1e4  # N m/rad at the ankle
THICKNESS = 1e-3  # half of it, m
STEP = 2.5e-4  # s
CONTACT = 'friction="2 0.01 0.001" solref="0.004 1" solimp="0.99 0.999 0.0001" condim="4"'


def replay(
    machine: Standing, motion: StandingMotion, fallen: float = 0.3, wrenches: Wrenches = ()
) -> tuple[Array, Array]:
    """Times (K,) and tilts of the foot (K,), rad, until the end or until the foot is tilted by `fallen`.

    The foot is a plate of the size of the support, a rectangle; 0.6 m wide for a machine that moves in the y-z plane.
    The joints get the torques of the motion and are held to it by servos, softer towards the tip. Wrenches from outside
    act as they do along the motion.
    """
    robot = machine.robot
    plate = replace(robot.link(robot.root), mass=FOOT_MASS, inertia=0.02 * FOOT_MASS * np.eye(3))
    bare = robot.link(robot.root).mass == 0
    links = [plate if bare and link.name == robot.root else link for link in robot.links]
    turn = np.asarray(machine.rotation)
    spatial = machine.moving_axes == (0, 1)
    middle, half = machine.support.center, machine.support.half_widths
    size = (half[0] if spatial else 0.3, half[1], THICKNESS)
    center = turn.T @ [middle[0] if spatial else 0.0, middle[1], -THICKNESS]
    model = mujoco_model(
        replace(robot, links=tuple(links)),
        ground=f'<geom type="plane" size="5 5 1" pos="0 0 {-2 * THICKNESS}" {CONTACT}/>',
        foot=f'<geom type="box" size="{_text(np.array(size))}" '
        f'pos="{_text(center)}" quat="{_text(_quaternion(turn.T))}" {CONTACT}/>',
        options=f'timestep="{STEP}" integrator="implicitfast"',
    )
    stiffness = SERVO * np.geomspace(1.0, 0.05, machine.joint_size)
    model.dof_damping[6:] = stiffness / 20  # integrated implicitly, unlike a force of our own
    data = mujoco.MjData(model)
    data.qpos[3:7] = _quaternion(turn)
    data.qpos[7:], data.qvel[6:] = motion.joints[0], motion.joint_velocities[0]
    times: Array = np.arange(int(motion.t[-1] / STEP), dtype=float) * STEP
    tips = np.column_stack([np.interp(times, motion.t, column) for column in motion.tip_in_world.T])
    planned = [
        np.column_stack([np.interp(times, motion.t, column) for column in values.T])
        for values in (motion.joints, motion.joint_velocities, motion.joint_torques)
    ]
    tilts: Array = np.zeros(len(times))
    result = np.zeros(9)
    for k in range(len(times)):
        joints, velocities, torques = (values[k] for values in planned)
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[6:] = torques + stiffness * (joints - data.qpos[7:]) + stiffness / 20 * velocities
        for wrench in wrenches(times[k], tips[k]) if callable(wrenches) else wrenches:
            body = model.body(wrench.link).id
            mujoco.mj_kinematics(model, data)
            point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(wrench.point).ravel()
            force, moment = np.array(wrench.force).ravel(), np.array(wrench.moment).ravel()
            mujoco.mj_applyFT(model, data, force, moment, point, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
        mujoco.mju_quat2Mat(result, data.qpos[3:7])
        upright = result.reshape(3, 3)[2] @ turn.T[:, 2]
        tilts[k] = np.arccos(np.clip(upright, -1.0, 1.0))
        if tilts[k] > fallen:
            return times[: k + 1], tilts[: k + 1]
    return times, tilts


def assert_stands(machine: Standing, motion: StandingMotion, wrenches: Wrenches = ()) -> None:
    """The foot stays flat on the floor to the end."""
    times, tilts = replay(machine, motion, wrenches=wrenches)
    assert times[-1] > 0.985 * motion.t[-1]
    assert tilts.max() < 1e-3


def assert_tips(machine: Standing, motion: StandingMotion, tilt: float, wrenches: Wrenches = ()) -> float:
    """The foot tips by more than `tilt`, still falling, but not before the zero moment point leaves it; how long."""
    times, tilts = replay(machine, motion, wrenches=wrenches)
    assert tilts[-1] == tilts.max() > tilt
    assert tilts[times < motion.t[motion.foot_margin < 0][0]].max() < 2e-3
    return float(times[-1])


def _quaternion(matrix: Array) -> Array:
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(matrix).ravel())
    return result


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
