"""Public robot descriptions in Pinocchio, evaluated in the order of this library's joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
from scipy.spatial.transform import Rotation

from models import Robot
from tests.models.robot.trees import Array

DATA = "example-robot-data"
ROBOTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "panda": (DATA, "panda_description/urdf/panda.urdf", {"tip": "panda_hand_tcp", "mimic": "free"}),
    "ur5": (DATA, "ur_description/urdf/ur5_robot.urdf", {"tip": "tool0"}),
    "tiago": (DATA, "tiago_description/robots/tiago.urdf", {"tip": "wrist_ft_tool_link", "inertia": "as_given"}),
    "talos": (DATA, "talos_data/robots/talos_reduced.urdf", {"tip": "gripper_left_base_link"}),
    "anymal-kinova": (
        DATA,
        "anymal_b_simple_description/robots/anymal-kinova.urdf",
        {"tip": "j2s6s200_end_effector", "inertia": "as_given"},
    ),
    "b1-z1": (DATA, "b1_description/urdf/b1-z1.urdf", {"tip": "gripperMover", "inertia": "as_given"}),
    "floating manipulator": ("spartpy", "SPARTpy/urdf/floating_7dof_manipulator.urdf", {}),
}
"""Distribution, end of the file's path, and what Robot.from_urdf needs to be told."""


def collection() -> list[Path]:
    """Every URDF file of the distribution."""
    files = distribution(DATA).files or []
    return sorted(Path(str(file.locate())) for file in files if file.suffix == ".urdf")


def urdf_file(package: str, ending: str) -> Path:
    """A file of an installed distribution."""
    owner = distribution(package)
    (result,) = (file for file in owner.files or [] if file.as_posix().endswith("/" + ending) or str(file) == ending)
    return Path(str(owner.locate_file(result)))


@dataclass(frozen=True)
class State:
    """Of a robot whose base moves: pose, velocity and acceleration of base and joints, world axes."""

    rotation: Array
    position: Array
    q: Array
    base_twist: Array
    qd: Array
    base_acceleration: Array
    qdd: Array

    @property
    def base(self) -> Array:
        """Position and quaternion [w, x, y, z]."""
        return np.concatenate([self.position, np.roll(Rotation.from_matrix(self.rotation).as_quat(), 1)])

    @property
    def base_twist_at_origin(self) -> Array:
        """The base's twist with the velocity of its point at the world's origin."""
        turning, moving = self.base_twist[:3], self.base_twist[3:]
        return np.concatenate([turning, moving - np.cross(turning, self.position)])


def random_state(robot: Robot, rng: np.random.Generator) -> State:
    slides = np.array([joint.kind == "prismatic" for joint in robot.moving_joints])
    q = np.where(slides, rng.uniform(-0.5, 0.5, robot.dof), rng.uniform(-np.pi, np.pi, robot.dof))
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    rates = rng.normal(size=robot.dof), rng.normal(size=robot.dof)
    return State(turn, rng.normal(size=3), q, rng.normal(size=6), rates[0], rng.normal(size=6), rates[1])


def swapped(matrix: Array) -> Array:
    """Pinocchio's (linear, angular) rows as (angular, linear)."""
    return np.concatenate([matrix[3:], matrix[:3]])


@dataclass(frozen=True)
class Peer:
    """A robot of Pinocchio on a free joint, read from the same file."""

    model: Any
    robot: Robot

    @classmethod
    def of(cls, path: Path, robot: Robot) -> Peer:
        """Without limits Pinocchio takes no revolute joint: such joints are continuous to it.

        A follower that it reads before the joint that is followed it does not take either.
        """
        text = path.read_text(encoding="utf-8")
        if "<limit" not in text:
            text = text.replace('"revolute"', '"continuous"')
        mimic = any(joint.mimic is not None for joint in robot.joints)
        return cls(pinocchio.buildModelFromXML(text, pinocchio.JointModelFreeFlyer(), mimic), robot)

    @cached_property
    def data(self) -> Any:
        return self.model.createData()

    @cached_property
    def _joints(self) -> list[Any]:
        return [self.model.joints[self.model.getJointId(name)] for name in self.robot.joint_names]

    @cached_property
    def columns(self) -> list[int]:
        """Of Pinocchio's velocity vector: those of our joints."""
        return [joint.idx_v for joint in self._joints]

    def configuration(self, state: State) -> Array:
        result = np.zeros(self.model.nq)
        result[:7] = np.concatenate([state.position, Rotation.from_matrix(state.rotation).as_quat()])
        for joint, value in zip(self._joints, state.q, strict=True):
            result[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        return result

    def base_columns(self, state: State) -> Array:
        """Base twist, ours, to the first six of Pinocchio's velocities, which are in the axes of the base."""
        turn, zero = state.rotation.T, np.zeros((3, 3))
        return np.block([[zero, turn], [turn, zero]])

    def velocity(self, state: State) -> Array:
        result = np.zeros(self.model.nv)
        result[:6] = self.base_columns(state) @ state.base_twist
        result[self.columns] = state.qd
        return result

    def acceleration(self, state: State) -> Array:
        """That of Pinocchio is spatial: the derivative of the velocity of the point that passes the origin."""
        turning, moving = state.base_acceleration[:3], state.base_acceleration[3:]
        passing = moving - np.cross(state.base_twist[:3], state.base_twist[3:])
        result = np.zeros(self.model.nv)
        result[:6] = self.base_columns(state) @ np.concatenate([turning, passing])
        result[self.columns] = state.qdd
        return result

    def in_our_columns(self, matrix: Array, state: State) -> tuple[Array, Array]:
        """(per base twist, per joint rate) of a matrix that Pinocchio has per its own velocities."""
        return matrix[:, :6] @ self.base_columns(state), matrix[:, self.columns]
