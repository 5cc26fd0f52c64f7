"""Machines simulated by MuJoCo, an independent library, under the torques of an inner control loop.

The inner loop runs at every step of the simulation. It follows the motion that a controller commands: computed torques
by the dynamics of `models`, with a proportional and derivative correction of position and velocity.
"""

from __future__ import annotations

import casadi as ca
import mujoco
import numpy as np

from models import FixedBase, FreeFloating, Robot
from models.checks import Array
from models.robot.dynamics import inverse_dynamics
from ocp.direct.assembly import ArrayFunction

__all__ = ["Simulation", "mjcf_text", "mujoco_model"]


def mujoco_model(
    robot: Robot, ground: str = "", foot: str = "", options: str = "", *, fixed: bool = False
) -> mujoco.MjModel:
    """Return the robot on a free joint, or `fixed`, with geoms of the world and of the root as MJCF."""
    return mujoco.MjModel.from_xml_string(mjcf_text(robot, ground, foot, options, fixed=fixed))


def mjcf_text(robot: Robot, ground: str = "", foot: str = "", options: str = "", *, fixed: bool = False) -> str:
    """Return the MJCF of :func:`mujoco_model`."""

    def numbers(values: Array) -> str:
        return " ".join(repr(float(value)) for value in np.ravel(values))

    def quaternion(matrix: Array) -> Array:
        result = np.zeros(4)
        mujoco.mju_mat2Quat(result, np.ascontiguousarray(matrix).ravel())
        return result

    def body(name: str, head: str) -> str:
        link = robot.link(name)
        inertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        own = f'<inertial pos="{numbers(link.center_of_mass)}" mass="{link.mass!r}" fullinertia="{numbers(inertia)}"/>'
        below = ""
        for joint in robot.joints:
            if joint.parent == name:
                place = f'pos="{numbers(joint.translation)}" quat="{numbers(quaternion(joint.rotation))}"'
                moving = ""
                if joint.moves:
                    kind = "slide" if joint.kind == "prismatic" else "hinge"
                    moving = f'<joint name="{joint.name}" type="{kind}" axis="{numbers(joint.axis)}"/>'
                below += f'<body name="{joint.child}" {place}>{moving}{body(joint.child, "")}</body>'
        return head + (own if link.mass else "") + below

    root = f'<body name="{robot.root}">{body(robot.root, foot if fixed else "<freejoint/>" + foot)}</body>'
    settings = f'<compiler angle="radian" boundmass="0"/><option {options}/>'
    return f"<mujoco>{settings}<worldbody>{ground}{root}</worldbody></mujoco>"


class Simulation:
    """A simulated robot, fixed to the world or floating freely without gravity, and its inner control loop.

    Args:
        machine: The robot. joints: At the start, at rest. Shape (n,).
        step: Period of the simulation and of the inner loop, s.
        bandwidth: Natural frequency of the critically damped correction, rad/s.

    Attributes:
        excess: Largest amounts so far by which a joint position (rad), velocity (rad/s) and torque (N m) exceeded its
            limit; negative if all kept their limits. Shape (3,).
        violations: Number of steps of the simulation at which one of them exceeded its limit.
    """

    def __init__(
        self, machine: FixedBase | FreeFloating, joints: Array, *, step: float = 0.001, bandwidth: float = 40.0
    ) -> None:
        robot = machine.robot
        self._step, self._bandwidth = step, bandwidth
        self._limits = robot.lower, robot.upper, robot.velocity, robot.effort
        gravity = "0 0 0" if isinstance(machine, FreeFloating) else "0 0 -9.81"
        options = f'timestep="{step}" integrator="RK4" gravity="{gravity}"'
        self._model = mujoco_model(robot, options=options, fixed=isinstance(machine, FixedBase))
        self._data = mujoco.MjData(self._model)
        moving = [self._model.joint(name) for name in robot.joint_names]
        self._places, self._rates = [int(j.qposadr[0]) for j in moving], [int(j.dofadr[0]) for j in moving]
        self._data.qpos[self._places] = joints
        q, v, a = (ca.SX.sym(name, robot.dof) for name in "qva")
        if isinstance(machine, FreeFloating):
            torques = machine.joint_torques(ca.SX.sym("base", machine.base_size), q, v, a)
        else:
            torques = inverse_dynamics(robot, q, v, a)
        self._torques = ArrayFunction(ca.Function("torques", [q, v, a], [torques]))
        self.excess, self.violations = np.full(3, -np.inf), 0

    @property
    def joints(self) -> Array:
        """Joint positions. Shape (n,), rad."""
        return np.array(self._data.qpos[self._places])

    @property
    def rates(self) -> Array:
        """Joint velocities. Shape (n,), rad/s."""
        return np.array(self._data.qvel[self._rates])

    @property
    def base(self) -> Array:
        """Pose of a floating base: position, m, and quaternion (w, x, y, z). Shape (7,)."""
        return np.array(self._data.qpos[:7])

    def run(self, acceleration: Array, period: float) -> None:
        """Simulate a period, s, in which the joints are commanded to move with an acceleration, (n,) in rad/s^2."""
        lower, upper, fastest, strongest = self._limits
        start, speed = self.joints, self.rates
        for k in range(round(period / self._step)):
            t, q, v = k * self._step, self.joints, self.rates
            late = start + speed * t + acceleration * t**2 / 2 - q
            slow = speed + acceleration * t - v
            correction = self._bandwidth**2 * late + 2 * self._bandwidth * slow
            torques = self._torques(q, v, acceleration + correction)[0]
            self._data.qfrc_applied[self._rates] = torques
            mujoco.mj_step(self._model, self._data)
            outside = max(np.max(lower - q), np.max(q - upper))
            each = outside, np.max(np.abs(v) - fastest), np.max(np.abs(torques) - strongest)
            self.excess = np.maximum(self.excess, each)
            self.violations += max(each) > 0
