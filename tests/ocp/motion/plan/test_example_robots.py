"""Public robots with a gripper, a head or a second arm, as their files describe them: a 0.3 m seam with free roll."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import CollisionScene, FixedBase, ModelWarning, Robot
from models.machines.machine import hold_joints
from ocp import Limits, ProblemError, Scene, TipTask, plan
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.ik_solver import idle_positions
from ocp.motion.tasks.equations import bind
from tests.models.robot.pinocchio_robots import DATA, urdf_file
from tests.models.robot.trees import Array
from tests.ocp.motion.local.arms import on_rail
from tests.ocp.motion.tasks.space_tasks import ur5

SPEED, LENGTH, CUTOFF, BATCH = 0.1, 0.3, 0.01, 100
"""m/s; m; m; configurations that are tried at once."""
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
QUICK = [("z1", "global"), ("panda", "configurations")]
CASES = [(name, search) for name in ARMS for search in ("configurations", "global")]


@cache
def robot(name: str) -> Robot:
    file, tip, *_ = ARMS[name]
    with warnings.catch_warnings():
        # limits of mimic joints leave two fingers of the PR2 no room, which its file is right to be warned of
        warnings.filterwarnings("ignore", "joints .* cannot move", ModelWarning)
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
    for tool in 20 * [2, 1, 0]:  # the axis of the tip frame that counts as the tool's
        middles = np.tile(low + (high - low) * (0.1 + 0.8 * rng.random((BATCH, arm.dof))), (4, 1))
        place, rotation, _ = _poses(pose_at, middles)
        axis, x, y = (rotation[:, :, (tool + k) % 3] for k in range(3))
        angles = np.repeat(np.arange(4) * np.pi / 4, BATCH)[:, None]
        path = np.cos(angles) * x + np.sin(angles) * y
        paths = _follow(pose_at, middles, (place, path, axis), tool)
        inside = ((paths > arm.lower) & (paths < arm.upper)).all(axis=(1, 2))
        chosen = np.flatnonzero(inside & (np.abs(np.diff(paths, axis=1)).max(axis=(1, 2)) < 0.3))
        for samples in ([4], [0, 8], [*range(9)]):  # most paths collide at one of few samples
            rows = paths[chosen][:, samples]
            flat = rows.reshape(-1, arm.dof)
            if len(flat):
                distances = distances_along(scene, np.zeros(0), flat, np.zeros(len(flat)), cutoff=CUTOFF)
                clear = np.all(distances > 0, axis=1).reshape(rows.shape[:2])
                chosen = chosen[clear.all(axis=1)]
        for k in chosen.tolist():
            first, along = place[k] - LENGTH / 2 * path[k], SPEED * path[k]
            return TipTask(
                position=lambda t, first=first, along=along: ca.DM(first) + t * ca.DM(along),
                direction=axis[k],
                tool_axis=np.eye(3)[tool],
                duration=LENGTH / SPEED,
            )
    raise AssertionError("no seam")


def _poses(pose_at: Any, joints: Array) -> tuple[Array, Array, Array]:
    """Return positions (K, 3), rotations (K, 3, 3) and Jacobians (K, 6, n) of the tip."""
    count, n = joints.shape
    position, rotation, jacobian = (np.array(value) for value in pose_at.map(count)(joints.T))
    return (
        position.T,
        rotation.reshape(3, count, 3).transpose(1, 0, 2),
        jacobian.reshape(6, count, n).transpose(1, 0, 2),
    )


def _follow(pose_at: Any, middles: Array, seams: tuple[Array, Array, Array], tool: int) -> Array:
    """Return joints along K seams by Newton steps, nan where they do not converge. Shape (K, 9, n)."""
    place, motion, axis = seams
    across = np.linalg.svd(axis[:, None])[2][:, 1:]
    ends = []
    for sign in (-1, 1):
        joints, path = middles, list[Array]()
        for share in np.linspace(0, 1, 5)[1:]:
            for _ in range(6):
                position, rotation, jacobian = _poses(pose_at, joints)
                gap = place + sign * share * LENGTH / 2 * motion - position
                tilt = np.einsum("kij,kj->ki", across, np.cross(rotation[:, :, tool], axis))
                rows = np.concatenate([across @ jacobian[:, :3], jacobian[:, 3:]], axis=1)
                error = np.concatenate([tilt, gap], axis=1)
                joints = joints + np.clip(np.einsum("kij,kj->ki", np.linalg.pinv(rows, 1e-3), error), -0.5, 0.5)
            path.append(np.where(np.abs(error).max(axis=1)[:, None] < 1e-6, joints, np.nan))
        ends.append(path)
    return np.array([*ends[0][::-1], middles, *ends[1]]).transpose(1, 0, 2)


@pytest.mark.parametrize(
    ("name", "search"), [case if case in QUICK else pytest.param(*case, marks=pytest.mark.long) for case in CASES]
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


@pytest.mark.long
def test_an_arm_on_a_gantry_plans_and_the_error_about_freedom_names_its_slides() -> None:
    """Three slides and six joints leave four directions free, one more than the slides: the roll of the tool."""
    machine = on_rail(ur5(), 3)
    pose = machine.tip_pose((), np.array([0.1, -0.1, 0.05, 0.3, -1.2, 1.4, -1.7, -1.5, 0.0]))
    first, axis = np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))[:, 2]
    task = TipTask(position=lambda t: ca.DM(first) + t * ca.DM([0, SPEED, 0]), direction=axis, duration=LENGTH / SPEED)
    options: dict[str, Any] = {"limits": Limits(velocity=2.0), "scene": False}
    result = plan(machine, task, **options)
    assert result.audit().passed
    assert result.cost <= 1.001 * SPEED**2 * LENGTH / SPEED / 2  # what the slides alone need
    with pytest.raises(ProblemError, match="slide0, slide1, slide2, shoulder_pan_joint") as caught:
        plan(machine, task, search="global", **options)
    assert caught.value.value == 4
