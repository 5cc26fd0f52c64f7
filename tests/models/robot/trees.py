"""Random robots, and derivatives computed without the library's own Jacobians."""

from __future__ import annotations

from typing import Any, Literal, cast

import casadi as ca
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models import Joint, Link, Robot, link_frames
from models.robot.parts import Kind

Array = NDArray[np.float64]
Base = Literal["planar", "spatial"]

few = settings(max_examples=25)
"""For tests that build expressions anew for every example."""

seeds = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator) -> Array:
    matrix: Array = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return matrix


def random_inertia(rng: np.random.Generator, mass: float) -> Array:
    """Inertia of eight random point masses about their centre of mass: always possible."""
    points = rng.normal(scale=0.3, size=(8, 3))
    points -= points.mean(axis=0)
    inertia: Array = mass / 8 * np.sum([p @ p * np.eye(3) - np.outer(p, p) for p in points], axis=0)
    return inertia


def random_robot(rng: np.random.Generator, size: int, base: Base = "spatial") -> Robot:
    """Tree of 1 + `size` links with branches and all kinds of joints, of which at least one moves.

    With a planar base all axes are along z of the base, up to sign, and all slides are in its plane; the
    joint frames may be turned about z or upside down and shifted along z.
    """
    links = [Link("base", 5.0, rng.normal(scale=0.2, size=3), random_inertia(rng, 20.0))]
    joints: list[Joint] = []
    flips = np.diag([1.0, -1.0, -1.0])
    for i in range(size):
        mass = float(rng.uniform(0.5, 2.0)) if rng.random() < 0.85 else 0.0
        links.append(Link(f"link{i}", mass, rng.normal(scale=0.3, size=3), random_inertia(rng, mass)))
        kinds = ["revolute", "continuous", "prismatic"] + (["fixed"] if i else [])
        kind = cast(Kind, str(rng.choice(kinds)))
        turn = random_rotation(rng) if rng.random() < 0.7 else np.eye(3)
        axis = rng.normal(size=3) if rng.random() < 0.6 else np.eye(3)[rng.integers(3)]
        if base == "planar":
            turn = Rotation.from_euler("z", rng.uniform(-3, 3)).as_matrix()
            if rng.random() < 0.3:
                turn = turn @ flips
            axis = (
                np.array([*rng.normal(size=2), 0.0]) if kind == "prismatic" else np.array([0, 0, rng.choice([-1, 1])])
            )
        # Mostly chains, sometimes a branch.
        parent = links[i if rng.random() < 0.7 else int(rng.integers(i + 1))].name
        joints.append(Joint(f"joint{i}", kind, parent, f"link{i}", rng.normal(scale=0.5, size=3), turn, axis))
    tip = links[int(rng.integers(1, size + 1))].name
    turn = Rotation.from_euler("z", 0.4).as_matrix() if base == "planar" else random_rotation(rng)
    return Robot(tuple(links), tuple(joints), tip, rng.normal(scale=0.3, size=3), turn)


def seven_joint_arm() -> Robot:
    """Arm of seven joints about z and y in turn, some 2 m long, on a base of 100 kg."""
    links, joints = [Link("base", 100.0, inertia=np.diag([30.0, 40.0, 50.0]))], []
    for i, axis in enumerate([(0, 0, 1), (0, 1, 0)] * 3 + [(0, 0, 1)]):
        links.append(Link(f"link{i}", 3.0, (0.0, 0.02, 0.15), np.diag([0.1, 0.1, 0.05])))
        joints.append(Joint(f"joint{i}", "revolute", links[i].name, links[i + 1].name, (0, 0, 0.3), axis=axis))
    return Robot(tuple(links), tuple(joints), tip_translation=(0, 0, 0.2))


def random_base(rng: np.random.Generator, base: Base) -> Array:
    """Configuration of a free-floating base."""
    quaternion = rng.normal(size=4)
    if base == "planar":
        return rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), quaternion / np.linalg.norm(quaternion)])


def random_frame(rng: np.random.Generator) -> tuple[Array, Array]:
    return random_rotation(rng), rng.normal(size=3)


def numeric(value: Any) -> Array:
    return np.array(ca.DM(value))


def vee(matrix: Any) -> Any:
    """Axial vector of the antisymmetric part of a matrix."""
    return ca.vertcat(matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]) / 2


def directional(value: Any, variables: Any, rates: Any) -> Any:
    """Derivative of an expression along the rates of its variables, by automatic differentiation."""
    value = ca.densify(value)
    return ca.reshape(ca.jtimes(ca.vec(value), variables, rates), value.shape)


def twist_by_differentiation(rotation: Any, position: Any, variables: Any, rates: Any) -> Any:
    """(vee(R' R^T), p') of a frame."""
    turning = ca.mtimes(directional(rotation, variables, rates), rotation.T)
    return ca.vertcat(vee(turning), directional(position, variables, rates))


def momentum_by_differentiation(robot: Robot, frames: Any, variables: Any, rates: Any) -> Any:
    """(L about the world's origin, P): sums over links of c x m c' + R I R^T omega and m c', frames alone."""
    angular, linear = ca.SX(3, 1), ca.SX(3, 1)
    for link in robot.links:
        turn, position = frames[link.name]
        center = position + ca.mtimes(turn, ca.DM(link.center_of_mass))
        twist = twist_by_differentiation(turn, center, variables, rates)
        push = link.mass * twist[3:6]
        angular += ca.cross(center, push) + ca.mtimes([turn, ca.DM(link.inertia), turn.T, twist[0:3]])
        linear += push
    return ca.vertcat(angular, linear)


def momentum_by_differences(robot: Robot, poses: list[dict[str, tuple[Array, Array]]], step: float) -> Array:
    """(L, P) by fourth-order differences of link poses at -2, -1, 0, 1, 2 steps. Shape (6,)."""
    weights = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12 * step)
    total = np.zeros(6)
    for link in robot.links:
        turns = np.array([pose[link.name][0] for pose in poses])
        centers = np.array([pose[link.name][1] + pose[link.name][0] @ link.center_of_mass for pose in poses])
        turn_rate = np.tensordot(weights, turns, axes=1) @ turns[2].T
        omega = np.array([turn_rate[2, 1], turn_rate[0, 2], turn_rate[1, 0]])
        push = link.mass * (weights @ centers)
        total[0:3] += np.cross(centers[2], push) + turns[2] @ link.inertia @ turns[2].T @ omega
        total[3:6] += push
    return total


def numeric_poses(robot: Robot, q: Any, world_from_base: Any = None) -> dict[str, tuple[Array, Array]]:
    frames = link_frames(robot, q, world_from_base)
    return {name: (numeric(frame.rotation), numeric(frame.position).ravel()) for name, frame in frames.items()}
