"""Random robots, and derivatives computed without the library's own Jacobians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal, cast

import casadi as ca
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models import (
    Joint,
    Link,
    Mimic,
    ModelError,
    Robot,
    inverse_dynamics,
    link_frames,
    mass_matrix,
    momentum_matrix,
    robot_inertia,
    tip_pose,
)
from models.robot.parts import Kind

Array = NDArray[np.float64]
Base = Literal["planar", "spatial"]

few = settings(max_examples=25)
"""For tests that build expressions anew for every example."""

seeds = st.integers(0, 2**32 - 1)


@contextmanager
def refused(message: str) -> Iterator[None]:
    """A ModelError that says so, and carries as a field the name of what it is about, which stands in what it says."""
    with pytest.raises(ModelError, match=message) as caught:
        yield
    assert caught.value.name
    assert caught.value.name in str(caught.value)


def random_rotation(rng: np.random.Generator) -> Array:
    matrix: Array = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return matrix


def random_inertia(rng: np.random.Generator, mass: float) -> Array:
    """Inertia of eight random point masses about their centre of mass: always possible."""
    points = rng.normal(scale=0.3, size=(8, 3))
    points -= points.mean(axis=0)
    inertia: Array = mass / 8 * np.sum([p @ p * np.eye(3) - np.outer(p, p) for p in points], axis=0)
    return inertia


def random_robot(rng: np.random.Generator, size: int, base: Base = "spatial", followers: bool = False) -> Robot:
    """Tree of 1 + `size` links with branches and all kinds of joints, of which at least one moves.

    With `followers` about half of the moving joints but one follow another, in chains too.

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
    place = rng.normal(scale=0.3, size=3)
    return Robot(tuple(links), tuple(tied(rng, joints) if followers else joints), tip, place, turn)


def tied(rng: np.random.Generator, joints: list[Joint]) -> list[Joint]:
    """The joints, some of which now follow another, that may come after them or follow a third."""
    order = [str(name) for name in rng.permutation([joint.name for joint in joints if joint.moves])]
    ties = {}
    for i, name in enumerate(order[1:]):
        if rng.random() < 0.5:
            ratio = float(rng.choice([-1, 1]) * rng.uniform(0.3, 2.0))
            ties[name] = Mimic(order[int(rng.integers(i + 1))], ratio, float(rng.choice([0.0, rng.normal()])))
    return [replace(joint, mimic=ties.get(joint.name)) for joint in joints]


def joint_positions(robot: Robot, q: Any) -> dict[str, float]:
    """Where all joints that move stand, followers included, by following each tie from joint to joint."""
    known = dict(zip(robot.joint_names, map(float, q), strict=True))
    waiting = [joint for joint in robot.joints if joint.mimic is not None]
    while waiting:
        joint = waiting.pop(0)
        if (tie := joint.mimic) is not None and tie.joint in known:
            known[joint.name] = tie.multiplier * known[tie.joint] + tie.offset
        else:
            waiting.append(joint)
    return known


def ties(robot: Robot) -> tuple[Array, Array]:
    """A and b of q_free = A q + b, by moving one entry of the joint vector at a time; see untied."""
    names = untied(robot).joint_names
    at = [np.array([joint_positions(robot, q)[name] for name in names]) for q in np.eye(robot.dof)]
    b = np.array([joint_positions(robot, np.zeros(robot.dof))[name] for name in names])
    return np.array(at).reshape(robot.dof, len(b)).T - b[:, None], b


def untied(robot: Robot) -> Robot:
    """The same joints, each on its own."""
    return replace(robot, joints=tuple(replace(joint, mimic=None) for joint in robot.joints))


@lru_cache(maxsize=2)
def everything(robot: Robot) -> Any:
    """Frames of the links, all inertia and the torques of a motion, as a function of q, q', q''."""
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    placed = link_frames(robot, q)
    frames = ca.vertcat(*(ca.horzcat(*placed[link.name]) for link in robot.links))
    inertia = [robot_inertia(robot, q), momentum_matrix(robot, q), mass_matrix(robot, q)]
    outputs = [frames, *inertia, inverse_dynamics(robot, q, qd, qdd)]
    return ca.Function("everything", [q, qd, qdd], [ca.densify(output) for output in outputs])


def assert_same_robot(robot: Robot, other: Robot, rng: np.random.Generator) -> None:
    """Same joint vector, same limits, and the same functions to 1e-12 of their greatest entry."""
    assert other.joint_names == robot.joint_names
    for limit in ("lower", "upper", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(other, limit), getattr(robot, limit))
    motion = rng.normal(size=(3, robot.dof))
    pairs = zip(everything(robot)(*motion), everything(other)(*motion), strict=True)
    for expected, result in ((numeric(one), numeric(two)) for one, two in pairs):
        known = result[: len(expected)]  # the frame of a tip's own link may have come after the others
        np.testing.assert_allclose(known, expected, rtol=0, atol=1e-12 * np.abs(expected).max(initial=1e-300))
    if robot.tip is not None:
        tips = [np.c_[tuple(map(numeric, tip_pose(each, motion[0])))] for each in (robot, other)]
        np.testing.assert_allclose(tips[1], tips[0], rtol=0, atol=1e-12 * np.abs(tips[0]).max())


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


def link_twist(robot: Robot, link: str, motion: Sequence[Array], placement: Any, point: Any) -> tuple[Array, Array]:
    """Twist (angular, linear) of a point of a link in world axes, and its rate, from the link's frame alone."""
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    frame = link_frames(robot, q, placement)[link]
    twist = twist_by_differentiation(frame.rotation, frame.point(point), q, qd)
    rate = directional(twist, ca.vertcat(q, qd), ca.vertcat(qd, qdd))
    values = ca.Function("twist", [q, qd, qdd], [twist, rate])(*motion)
    return numeric(values[0]).ravel(), numeric(values[1]).ravel()


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
