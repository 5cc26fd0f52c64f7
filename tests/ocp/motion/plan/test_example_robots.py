"""Public robots with a gripper, a head or a second arm, as their files describe them: a 0.3 m seam with free roll."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import CollisionScene, FixedBase, Robot
from models.machines.machine import hold_joints
from ocp import Scene, TipTask, plan
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.ik_solver import idle_positions
from ocp.motion.tasks.equations import bind
from tests.models.robot.pinocchio_robots import DATA, urdf_file
from tests.models.robot.trees import Array

SPEED, LENGTH = 0.1, 0.3
"""m/s; m."""
ARMS = {  # file, tip, numbers of joints held by a plan and by a global one, seed of the seam
    "z1": ("z1_description/urdf/z1.urdf", "gripperStator", 1, 1, 0),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand", 1, 1, 1),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_link_6", 0, 0, 0),
    "b1-z1": ("b1_description/urdf/b1-z1.urdf", "gripperStator", 13, 13, 0),
    "anymal-kinova": ("anymal_b_simple_description/robots/anymal-kinova.urdf", "j2s6s200_link_6", 12, 12, 0),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_gripper", 10, 10, 0),
    "talos arm": ("talos_data/robots/talos_left_arm.urdf", "gripper_left_base_link", 1, 1, 0),
    "pr2": ("pr2_description/urdf/pr2.urdf", "r_gripper_tool_frame", 12, 13, 0),
    "tiago": ("tiago_description/robots/tiago.urdf", "arm_tool_link", 40, 41, 0),
    "talos": ("talos_data/robots/talos_reduced.urdf", "gripper_left_base_link", 23, 25, 0),
}
QUICK = ("z1", "panda")


@cache
def robot(name: str) -> Robot:
    file, tip, *_ = ARMS[name]
    return Robot.from_urdf(urdf_file(DATA, file), tip=tip, inertia="as_given")


def seam(whole: Robot, seed: int = 0) -> TipTask:
    """Return a straight seam across the tool axis through a random configuration that the arm can follow freely."""
    free = bind(FixedBase(whole), TipTask(position=np.zeros(3), direction=(0.0, 0.0, 1.0))).idle
    places = zip(whole.joint_names, idle_positions(whole.lower, whole.upper).tolist(), free, strict=True)
    machine = hold_joints(FixedBase(whole), {name: place for name, place, idle in places if idle})
    scene, arm, rng = CollisionScene(machine, missing="skip"), machine.robot, np.random.default_rng(seed)
    q = ca.SX.sym("q", arm.dof)
    pose = machine.tip_pose((), q)
    pose_at = ca.Function("pose", [q], [pose.position, pose.rotation, machine.tip_jacobian((), q)])
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    for _ in range(2000):
        middle = low + (high - low) * (0.2 + 0.6 * rng.random(arm.dof))
        place, (x, y, axis) = np.array(pose_at(middle)[0]).ravel(), np.array(pose_at(middle)[1]).T
        for way in (x, y, (x + y) / np.sqrt(2), (x - y) / np.sqrt(2)):
            path = _follow(pose_at, middle, place, way, axis)
            inside = ((path > arm.lower) & (path < arm.upper)).all() and np.abs(np.diff(path, axis=0)).max() < 0.3
            if inside and (distances_along(scene, np.zeros(0), path, np.zeros(len(path))) > 0).all():
                first = place - LENGTH / 2 * way
                return TipTask(
                    position=lambda t, first=first, way=way: ca.DM(first) + SPEED * t * ca.DM(way),
                    direction=axis,
                    duration=LENGTH / SPEED,
                )
    raise AssertionError("no seam")


def _follow(pose_at: Any, middle: Array, place: Array, way: Array, axis: Array) -> Array:
    """Return joints along the seam by Newton steps, nan where they do not converge. Shape (13, n)."""
    across = np.linalg.svd(axis[None])[2][1:]
    ends = []
    for sign in (-1, 1):
        joints, path = middle, list[Array]()
        for share in np.linspace(0, 1, 7)[1:]:
            for _ in range(6):
                position, rotation, jacobian = (np.array(value) for value in pose_at(joints))
                gap = place + sign * share * LENGTH / 2 * way - position.ravel()
                error = np.concatenate([across @ np.cross(rotation[:, 2], axis), gap])
                joints = joints + np.linalg.pinv(np.vstack([across @ jacobian[:3], jacobian[3:]]), 1e-3) @ error
            path.append(joints if np.abs(error).max() < 1e-6 else np.full(len(joints), np.nan))
        ends.append(path)
    return np.array([*ends[0][::-1], middle, *ends[1]])


@pytest.mark.parametrize("search", ["configurations", "global"])
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in ARMS]
)
def test_a_seam_is_planned_with_the_file_as_it_is(name: str, search: Any) -> None:
    whole, task = robot(name), seam(robot(name), ARMS[name][4])
    result = plan(FixedBase(whole), task, search=search, scene=Scene(missing="skip"))
    assert result.audit().passed
    assert result["joints"].shape[1] == whole.dof
    assert len(result.held) == ARMS[name][2 if search == "configurations" else 3]
    still = [whole.joint_names.index(joint) for joint in result.held]
    assert not np.ptp(result["joints"][:, still], axis=0).any()
    assert (result.bound is not None) == (search == "global")
    if result.bound is not None:
        assert 0.5 * result.cost < result.bound <= result.cost
