"""Steps replayed in MuJoCo: a robot that nothing holds, its soles on a floor with friction, joints on stiff servos."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from models import Robot, Support, simplify
from ocp.motion.builders.standing.steps import StepsMotion
from tests.models.robot.trees import Array

SERVO = 2000.0  # N m/rad
THICKNESS = 5e-3  # half of a sole's, m
STEP = 2.5e-4  # s
FALLEN = 0.2  # rad, of the root link away from the plan
CONTACT = 'solref="0.01 1" solimp="0.9 0.95 0.001" condim="4"'


@dataclass(frozen=True)
class Replay:
    """What became of a motion in the simulation.

    Attributes:
        t: Times, up to the end or to the fall. Shape (K,), s.
        lean: Angle between the root link and the plan. Shape (K,), rad.
        off: Distance of the root link from the plan. Shape (K,), m.
        slip: Greatest way of a sole along the ground while it is held, from where it was when it bore load first, m.
        lifted: Greatest height of a corner of a sole that is held, m.
        fell: Whether it fell.
    """

    t: Array
    lean: Array
    off: Array
    slip: float
    lifted: float
    fell: bool


def replay(motion: StepsMotion, friction: float, planar: bool = False) -> Replay:
    """The joints get the torques of the motion and are held to it by servos; the root link is free.

    Args:
        planar: The root link moves in the plane y = 0 alone.
    """
    feet = motion.steps.feet
    robot = simplify(motion.steps.robot, {foot.link for foot in feet.values()})
    soles = {foot.link: name for name, foot in feet.items()}
    model = mujoco.MjModel.from_xml_string(_model(robot, motion, soles, friction, planar))
    names = robot.joint_names
    velocity = np.array([model.joint(name).dofadr[0] for name in names])
    position = np.array([model.joint(name).qposadr[0] for name in names])
    model.dof_damping[velocity] = SERVO / 20  # integrated implicitly, unlike a force of our own
    data = mujoco.MjData(model)
    if planar:
        turn = motion.root_rotation[0]
        data.qpos[:3] = [motion.root_position[0, 0], motion.root_position[0, 2], np.arctan2(turn[0, 2], turn[0, 0])]
    else:
        data.qpos[:3] = motion.root_position[0]
        mujoco.mju_mat2Quat(data.qpos[3:7], motion.root_rotation[0].ravel())
    data.qpos[position] = motion.joints[0]
    mujoco.mj_forward(model, data)
    times: Array = np.arange(int(motion.t[-1] / STEP), dtype=float) * STEP
    planned = [_at(times, motion.t, part) for part in (motion.joints, motion.joint_velocities, motion.joint_torques)]
    root = _at(times, motion.t, motion.root_position)
    turns = _at(times, motion.t, motion.root_rotation.reshape(-1, 9)).reshape(-1, 3, 3)
    phase = motion.phase[np.clip(np.searchsorted(motion.t, times, side="right") - 1, 0, None)].astype(int)
    body, geoms = model.body(robot.root).id, {name: model.geom(f"{name} sole").id for name in feet}
    lean, off = np.zeros(len(times)), np.zeros(len(times))
    slip, lifted, began = 0.0, 0.0, dict[str, tuple[int, Array]]()
    for k in range(len(times)):
        joints, rates, torques = (values[k] for values in planned)
        data.qfrc_applied[velocity] = torques + SERVO * (joints - data.qpos[position]) + SERVO / 20 * rates
        mujoco.mj_step(model, data)
        result = data.xmat[body].reshape(3, 3)
        lean[k] = np.arccos(np.clip((np.trace(result.T @ turns[k]) - 1) / 2, -1.0, 1.0))
        off[k] = np.linalg.norm(data.xpos[body] - root[k])
        held = motion.steps.phases[phase[k]].footholds
        for name, geom in geoms.items():
            if name not in held:
                began.pop(name, None)
                continue
            size = model.geom_size[geom]
            box = np.array([[x, y, -1] for x in (-1, 1) for y in (-1, 1)]) * size
            corners = data.geom_xpos[geom] + box @ data.geom_xmat[geom].reshape(3, 3).T
            since, first = began.setdefault(name, (k, corners))
            slip = max(slip, float(np.linalg.norm((corners - first)[:, :2], axis=1).max()))
            if times[k] - times[since] > 0.05:
                lifted = max(lifted, float(corners[:, 2].max()))
        if lean[k] > FALLEN:
            return Replay(times[: k + 1], lean[: k + 1], off[: k + 1], slip, lifted, True)
    return Replay(times, lean, off, slip, lifted, False)


def _at(times: Array, t: Array, values: Array) -> Array:
    return np.column_stack([np.interp(times, t, column) for column in values.T])


def _model(robot: Robot, motion: StepsMotion, soles: dict[str, str], friction: float, planar: bool) -> str:
    """The robot as MJCF, a box as wide as each sole, and a floor."""

    def body(name: str, head: str) -> str:
        link = robot.link(name)
        inertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        own = ""
        if link.mass:
            own = f'<inertial pos="{_text(link.center_of_mass)}" mass="{link.mass!r}" fullinertia="{_text(inertia)}"/>'
        if name in soles:
            foot = motion.steps.feet[soles[name]]
            assert isinstance(foot.sole, Support)
            turn = np.asarray(foot.rotation)
            center = foot.translation + turn @ [*foot.sole.center, THICKNESS]
            size = [*foot.sole.half_widths, THICKNESS]
            own += f'<geom name="{soles[name]} sole" type="box" size="{_text(size)}" pos="{_text(center)}" '
            own += f'quat="{_text(_quaternion(turn))}" friction="{friction} 0.02 0.001" {CONTACT} contype="1" '
            own += 'conaffinity="2"/>'
        for joint in robot.joints:
            if joint.parent == name:
                place = f'pos="{_text(joint.translation)}" quat="{_text(_quaternion(np.asarray(joint.rotation)))}"'
                kind = "slide" if joint.kind == "prismatic" else "hinge"
                moving = f'<joint name="{joint.name}" type="{kind}" axis="{_text(joint.axis)}"/>' if joint.moves else ""
                own += f'<body name="{joint.child}" {place}>{moving}{body(joint.child, "")}</body>'
        return head + own

    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>'
    root = body(robot.root, slides if planar else "<freejoint/>")
    floor = f'<geom type="plane" size="5 5 1" friction="{friction} 0.02 0.001" {CONTACT} contype="2" conaffinity="1"/>'
    return (
        f'<mujoco><compiler angle="radian" boundmass="0"/><option timestep="{STEP}" integrator="implicitfast" '
        f'cone="elliptic" impratio="50" noslip_iterations="5" gravity="0 0 {-motion.steps.gravity}"/><worldbody>{floor}'
        f'<body name="{robot.root}">{root}</body></worldbody></mujoco>'
    )


def _quaternion(matrix: Array) -> Array:
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(matrix).ravel())
    return result


def _text(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))
