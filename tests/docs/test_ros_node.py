"""The ROS 2 node of the documentation, run without ROS: with the message definitions of ROS 2, as rosbags has them."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from models import FixedBase, example_robot, tip_pose

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "guide"
STORE = get_typestore(Stores.ROS2_JAZZY)


def message_class(name: str) -> Any:
    """Class with the fields of a message definition and the constructor of rclpy's messages: keywords, all optional."""

    def construct(**values: Any) -> Any:
        fields = dict(STORE.fielddefs[name][1])
        assert values.keys() <= fields.keys(), f"{name} has no {values.keys() - fields.keys()}"
        entries = {field: values.get(field, default(kind)) for field, kind in fields.items()}
        for field, (kind, about) in fields.items():
            if kind is Nodetype.SEQUENCE and about[0][0] is Nodetype.BASE and about[0][1][0] != "string":
                entries[field] = np.array(entries[field], dtype=about[0][1][0])
        return STORE.types[name](**entries)

    return construct


def default(definition: Any) -> Any:
    kind, about = definition
    if kind is Nodetype.NAME:
        return message_class(about)()
    if kind is Nodetype.BASE:
        return "" if about[0] == "string" else 0
    return []


class Node:
    """Stand-in of a node of rclpy that serialises what it publishes, as a middleware does."""

    def __init__(self) -> None:
        self.published, self.receive, self.services = list[bytes](), dict[str, Any](), dict[str, Any]()

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        assert topic == "joint_trajectory"
        name = "trajectory_msgs/msg/JointTrajectory"
        return SimpleNamespace(publish=lambda message: self.published.append(bytes(STORE.serialize_cdr(message, name))))

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        self.receive[topic] = callback

    def create_service(self, kind: Any, name: str, callback: Any) -> None:
        self.services[name] = callback


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> tuple[Node, FixedBase]:
    packages = {
        "builtin_interfaces": ["Duration"],
        "geometry_msgs": ["PoseStamped"],
        "sensor_msgs": ["JointState"],
        "trajectory_msgs": ["JointTrajectory", "JointTrajectoryPoint"],
    }
    modules = {f"{package}.msg": {name: message_class(f"{package}/msg/{name}") for name in names}
               for package, names in packages.items()}  # fmt: skip
    modules |= {"std_srvs.srv": {"Trigger": object}, "rclpy": {}}
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name.partition(".")[0], ModuleType(name.partition(".")[0]))
        monkeypatch.setitem(sys.modules, name, module)
    own, machine = Node(), FixedBase(example_robot("six_axis"))
    runpy.run_path(str(GUIDE / "plan_node.py"))["serve"](own, machine)
    return own, machine


def call(node: Node) -> Any:
    return node.services["plan"](SimpleNamespace(), SimpleNamespace(success=None, message=None))


def test_a_goal_is_answered_by_a_trajectory_from_the_measured_joints_to_the_pose(node: tuple[Node, FixedBase]) -> None:
    own, machine = node
    here = np.array([0.0, -0.8, 1.6, 0.0, 0.8, 0.0])
    target = tip_pose(machine.robot, here + 0.2)
    own.receive["joint_states"](state(machine, here))
    own.receive["goal_pose"](pose(machine.robot.root, target))
    answer = call(own)
    assert answer.success
    assert "may be run" in answer.message
    (sent,) = own.published
    message: Any = STORE.deserialize_cdr(sent, "trajectory_msgs/msg/JointTrajectory")
    times = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points]
    positions, velocities = (np.array([getattr(point, kind) for point in message.points])
                             for kind in ("positions", "velocities"))  # fmt: skip
    assert tuple(message.joint_names) == machine.robot.joint_names
    assert times[0] == 0.0
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(positions[0], here, atol=1e-9)
    np.testing.assert_allclose(velocities[[0, -1]], 0.0, atol=1e-9)
    reached = tip_pose(machine.robot, positions[-1])
    np.testing.assert_allclose(np.array(reached.position), np.array(target.position), atol=1e-6)
    np.testing.assert_allclose(np.array(reached.rotation), np.array(target.rotation), atol=1e-6)


def test_what_is_missing_or_wrong_is_answered_by_its_name(node: tuple[Node, FixedBase]) -> None:
    own, machine = node
    refused = [call(own)]
    own.receive["joint_states"](state(machine, np.zeros(6)))
    own.receive["goal_pose"](pose("camera", tip_pose(machine.robot, np.zeros(6))))
    refused.append(call(own))
    own.receive["joint_states"](message_class("sensor_msgs/msg/JointState")(name=["joint_1"], position=[0.0]))
    own.receive["goal_pose"](pose(machine.robot.root, tip_pose(machine.robot, np.zeros(6))))
    refused.append(call(own))
    for answer, word in zip(refused, ("joint_states", "frame base", "joint_2"), strict=True):
        assert answer.success is False
        assert word in answer.message
    assert not own.published


def state(machine: FixedBase, joints: Any) -> Any:
    return message_class("sensor_msgs/msg/JointState")(name=list(machine.robot.joint_names), position=joints)


def pose(frame: str, target: Any) -> Any:
    """Pose of a goal as a message, its quaternion from SciPy."""
    x, y, z, w = Rotation.from_matrix(np.array(target.rotation)).as_quat()
    point = dict(zip("xyz", np.array(target.position).ravel().tolist(), strict=True))
    return message_class("geometry_msgs/msg/PoseStamped")(
        header=message_class("std_msgs/msg/Header")(frame_id=frame),
        pose=message_class("geometry_msgs/msg/Pose")(
            position=message_class("geometry_msgs/msg/Point")(**point),
            orientation=message_class("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w),
        ),
    )
