from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models import (
    CollisionShape,
    FreeFloating,
    Joint,
    Link,
    Mimic,
    ModelWarning,
    Robot,
    Standing,
    center_of_mass,
    link_frames,
    momentum_matrix,
    rectangle,
    robot_inertia,
    simplify,
    tip_pose,
)
from models.robot.parts import SHAPES
from tests.models.robot.pinocchio_robots import ROBOTS, Peer, random_state, urdf_file
from tests.models.robot.trees import (
    assert_same_robot,
    few,
    numeric,
    numeric_poses,
    random_robot,
    random_rotation,
    refused,
    seeds,
)

BODY = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
ENDS = '<parent link="a"/><child link="b"/>'


def text(joint: str = f'<joint name="j" type="fixed">{ENDS}</joint>', links: str = "", robot: str = "robot") -> str:
    return f'<{robot} name="r"><link name="a">{BODY}</link><link name="b"/>{links}{joint}</{robot}>'


def moving(inside: str = "", kind: str = "revolute", name: str = "j") -> str:
    return f'<joint name="{name}" type="{kind}">{ENDS}{inside}</joint>'


def chain(kinds: str = "rrr", extra: dict[int, str] | None = None) -> str:
    """Links l0, l1.., joints j1, j2.. of the given kinds."""
    names = {"r": "revolute", "c": "continuous", "p": "prismatic", "f": "fixed", "F": "floating"}
    links = "".join(f'<link name="l{i}">{BODY}</link>' for i in range(len(kinds) + 1))
    joints = "".join(
        f'<joint name="j{i + 1}" type="{names[kind]}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f"{(extra or {}).get(i + 1, '')}</joint>"
        for i, kind in enumerate(kinds)
    )
    return f'<robot name="chain">{links}{joints}</robot>'


@given(seeds, st.integers(1, 8))
@few
def test_pinocchio_reads_a_written_robot_with_equal_kinematics(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = with_limits_and_shapes(random_robot(rng, size), rng)
    model = pinocchio.buildModelFromXML(robot.to_urdf(), pinocchio.JointModelFreeFlyer())
    peer = Peer(model, robot)
    largest = np.finfo(float).max
    for joint in (joint for joint in robot.joints if joint.moves):
        index = model.joints[model.getJointId(joint.name)].idx_v
        for own, theirs in ((joint.velocity, model.upperVelocityLimit), (joint.effort, model.upperEffortLimit)):
            assert min(theirs[index], largest) == min(own, largest)
    state = random_state(robot, rng)
    configuration, place = peer.configuration(state), (state.rotation, state.position)
    pinocchio.framesForwardKinematics(model, peer.data, configuration)
    for name, pose in numeric_poses(robot, state.q, place).items():
        theirs = peer.data.oMf[model.getFrameId(name, pinocchio.FrameType.BODY)]
        np.testing.assert_allclose(np.c_[pose], np.c_[theirs.rotation, theirs.translation], atol=1e-13)
    about = pinocchio.computeCentroidalMomentum(model, peer.data, configuration, peer.velocity(state))
    whole = numeric(robot_inertia(robot, state.q, place)) @ state.base_twist_at_origin
    whole += numeric(momentum_matrix(robot, state.q, place)) @ state.qd
    middle = numeric(center_of_mass(robot, state.q, place)).ravel()
    expected = np.concatenate([about.angular + np.cross(middle, about.linear), about.linear])
    np.testing.assert_allclose(whole, expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.long
@given(seeds, st.integers(1, 8))
@few
def test_a_robot_that_is_written_is_read_again_with_the_same_functions(seed: int, size: int) -> None:
    """To 1e-12: frames, inertia, torques, limits, tip, shapes; and what is read is written as the same text."""
    rng = np.random.default_rng(seed)
    robot = with_limits_and_shapes(random_robot(rng, size, followers=True), rng)
    text = robot.to_urdf()
    again = Robot.from_urdf(text)
    assert_same_robot(robot, again, rng)
    for joint in robot.joints:
        read = again.joint(joint.name)
        parts = ("parent", "child", "lower", "upper", "velocity", "effort", "mimic")
        endless = joint.kind == "revolute" and not np.isfinite([joint.lower, joint.upper]).any()
        assert read.kind == ("continuous" if endless else joint.kind)
        assert [getattr(joint, part) for part in parts] == [getattr(read, part) for part in parts]
    for link in robot.links:
        assert again.link(link.name).mass == link.mass
        for shape, result in zip(link.collisions, again.link(link.name).collisions, strict=True):
            assert (shape.kind, shape.file) == (result.kind, result.file)
            for part in ("size", "translation", "rotation"):
                np.testing.assert_allclose(getattr(result, part), getattr(shape, part), rtol=0, atol=1e-15)


def with_limits_and_shapes(robot: Robot, rng: np.random.Generator) -> Robot:
    """Of every joint some limits, or only one of them, or none; of every link up to three shapes."""

    def some(value: float, none: float) -> float:
        return value if rng.random() < 0.7 else none

    joints = []
    for joint in robot.joints:
        if joint.moves:
            joint = replace(joint, velocity=some(rng.uniform(1, 2), np.inf), effort=some(rng.uniform(1, 2), np.inf))
        if joint.moves and joint.kind != "continuous" and joint.mimic is None:
            joint = replace(joint, lower=some(-rng.uniform(), -np.inf), upper=some(rng.uniform(), np.inf))
        joints.append(joint)
    links = []
    for link in robot.links:
        kinds = rng.choice(list(SHAPES), size=int(rng.integers(4)))
        shapes = [
            CollisionShape(
                kind, rng.uniform(0.1, 1, SHAPES[kind]), "a/b.stl" * (kind == "mesh"), rng.normal(size=3), turn
            )
            for kind, turn in ((kind, random_rotation(rng)) for kind in kinds)
        ]
        links.append(replace(link, collisions=tuple(shapes)))
    return replace(robot, joints=tuple(joints), links=tuple(links))


@given(st.tuples(*[st.floats(-4, 4)] * 3), st.sampled_from([0.0, 1e-300, 1e-17, 1e-9, 1e-4]), st.sampled_from([-1, 1]))
def test_a_rotation_is_written_exactly_to_rounding_at_the_gimbal_lock_too(
    angles: tuple[float, float, float], off: float, sign: int
) -> None:
    for pitch in (angles[1], sign * (np.pi / 2 - off)):
        turn = Rotation.from_euler("xyz", [angles[0], pitch, angles[2]]).as_matrix()
        joint = Joint("j", "fixed", "a", "b", rotation=turn)
        again = Robot.from_urdf(Robot((Link("a"), Link("b")), (joint,)).to_urdf()).joints[0]
        np.testing.assert_allclose(again.rotation, joint.rotation, rtol=0, atol=1e-15)


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("limits", [{}, {"effort": 3.0}, {"velocity": 2.0}, {"effort": 0.0, "velocity": 2.0}])
@pytest.mark.parametrize("ends", [{}, {"lower": -1.0}, {"upper": 2.0}, {"lower": -1.0, "upper": 2.0}])
def test_pinocchio_and_mujoco_read_joints_with_any_of_the_limits(
    kind: Any, limits: dict[str, Any], ends: dict[str, Any]
) -> None:
    ends = {} if kind == "continuous" else ends
    body: dict[str, Any] = {"mass": 1.0, "inertia": np.eye(3)}
    robot = Robot((Link("a", **body), Link("b", **body)), (Joint("j", kind, "a", "b", **limits, **ends),), "b")
    text = robot.to_urdf()
    peer = pinocchio.buildModelFromXML(text)
    largest = np.finfo(float).max
    assert [min(values[0], largest) for values in (peer.upperEffortLimit, peer.upperVelocityLimit)] == [
        limits.get(name, largest) for name in ("effort", "velocity")
    ]
    if peer.nq == 1:  # a joint without position limits has a cosine and a sine
        read = [peer.lowerPositionLimit[0], peer.upperPositionLimit[0]]
        assert read == [ends.get("lower", -largest), ends.get("upper", largest)]
    else:
        assert not ends
    assert mujoco.MjModel.from_xml_string(text).jnt_limited[0] == (kind == "prismatic" or bool(ends))
    again = Robot.from_urdf(text).joints[0]
    assert [getattr(again, name) for name in ("lower", "upper", "velocity", "effort")] == [
        {**ends, **limits}.get(name, -np.inf if name == "lower" else np.inf)
        for name in ("lower", "upper", "velocity", "effort")
    ]


def test_a_robot_is_written_to_a_file_as_a_whole_and_read_by_other_readers(tmp_path: Path) -> None:
    robot = simplify(Robot.from_urdf(urdf_file(*ROBOTS["panda"][:2]), tip="panda_hand_tcp"))
    file = tmp_path / "arm.urdf"
    file.write_text("an older one", encoding="utf-8")
    assert robot.to_urdf(file) == file.read_text(encoding="utf-8")
    assert [each.name for each in tmp_path.iterdir()] == ["arm.urdf"]
    peer = pinocchio.buildModelFromUrdf(str(file), mimic=True)
    assert list(peer.lowerPositionLimit) == list(robot.lower)
    end = peer.getFrameId("panda_link7_tip")
    q = np.linspace(-1, 1, robot.dof)
    data = peer.createData()
    pinocchio.framesForwardKinematics(peer, data, q)
    np.testing.assert_allclose(
        data.oMf[end].homogeneous[:3, 3], numeric(tip_pose(robot, q).position).ravel(), atol=1e-14
    )
    again = Robot.from_urdf(file)
    assert (again.tip, again.tip_translation.any()) == ("panda_link7_tip", False)
    assert Robot.from_urdf(again.to_urdf()).to_urdf() == again.to_urdf()


def test_names_of_any_kind_are_written_and_the_tip_link_takes_a_name_that_is_free() -> None:
    odd = "<a> & \"b\" 'c' \u00e9"
    robot = Robot(
        (Link(odd), Link(f"{odd}_tip")), (Joint(f"{odd}_tip1", "fixed", odd, f"{odd}_tip"),), odd, (1.0, 0, 0)
    )
    again = Robot.from_urdf(robot.to_urdf())
    assert [link.name for link in again.links] == [odd, f"{odd}_tip", f"{odd}_tip2"]
    assert again.tip == f"{odd}_tip2"


def test_visuals_of_links_are_read_and_written_and_never_refuse_a_robot() -> None:
    seen = [
        '<visual><origin xyz="1 2 3" rpy="0 0 1"/><geometry><mesh filename="a.dae" scale="2 2 -2"/></geometry>'
        '<material name="red"/></visual>',
        '<visual><geometry><box size="300 300 0.1"/></geometry><material name=""><color rgba="0 1 0 0.5"/></material>'
        "</visual>",
        "<visual><geometry/></visual><visual/><visual><geometry><teapot/></geometry></visual>",
        '<visual><geometry><sphere radius="0.1"/></geometry><material name="none"><color rgba="no"/></material>'
        "</visual>",
    ]
    materials = '<material name="red"><color rgba="2 0 0 1"/></material><material name="none"/>'
    robot = Robot.from_urdf(f'<robot name="r">{materials}<link name="a">{"".join(seen)}</link></robot>')
    for each in (robot, Robot.from_urdf(robot.to_urdf())):
        mesh, box, ball = each.link("a").visuals
        assert (mesh.kind, mesh.file, box.kind, ball.kind) == ("mesh", "a.dae", "box", "sphere")
        np.testing.assert_allclose(mesh.size, [2, 2, -2])
        np.testing.assert_allclose(mesh.translation, [1, 2, 3])
        np.testing.assert_allclose(mesh.rotation[:, 0], [np.cos(1), np.sin(1), 0], atol=1e-15)
        colors = np.array([mesh.color, box.color], dtype=float)
        np.testing.assert_allclose(colors, np.array([[1, 0, 0, 1], [0, 1, 0, 0.5]]))
        assert ball.color is None
        assert not each.link("a").collisions


def test_collision_shapes_are_read_with_their_places() -> None:
    shapes = {
        '<box size="1 2 3"/>': ("box", [1, 2, 3], ""),
        '<sphere radius="0.5"/>': ("sphere", [0.5], ""),
        '<cylinder length="2" radius="0.5"/>': ("cylinder", [0.5, 2], ""),
        '<capsule length="2" radius="0.5"/>': ("capsule", [0.5, 2], ""),
        '<mesh filename="package://a/b.stl"/>': ("mesh", [1, 1, 1], "package://a/b.stl"),
        '<mesh filename="c.dae" scale="1 -1 0.001"/>': ("mesh", [1, -1, 0.001], "c.dae"),
    }
    place = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
    body = "".join(f"<collision>{place}<geometry>{shape}</geometry></collision>" for shape in shapes)
    result = Robot.from_urdf(f'<robot name="r"><link name="a">{body}</link></robot>').link("a").collisions
    assert [(each.kind, list(each.size), each.file) for each in result] == list(shapes.values())
    for each in result:
        np.testing.assert_array_equal(each.translation, [1, 2, 3])
        np.testing.assert_allclose(each.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert Robot.from_urdf(text()).link("a").collisions == ()


def test_a_text_a_string_path_and_a_path_give_the_same_robot(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text('<?xml version="1.0" encoding="utf-8"?>\n' + chain(), encoding="utf-8")
    content = file.read_text(encoding="utf-8")
    distinct = {str(Robot.from_urdf(source)) for source in (content, "\ufeff\n  " + content, file, str(file))}
    assert len(distinct) == 1
    assert distinct.pop().startswith("chain of 4 links, 3 degrees of freedom, 8 kg, tip on l3")


def test_omitted_entries_have_the_default_of_the_format() -> None:
    robot = Robot.from_urdf(text(moving()))
    joint = robot.joints[0]
    np.testing.assert_array_equal(joint.axis, [1, 0, 0])
    np.testing.assert_array_equal(joint.translation, np.zeros(3))
    np.testing.assert_array_equal(joint.rotation, np.eye(3))
    assert (joint.lower, joint.upper, joint.velocity, joint.effort) == (-np.inf, np.inf, np.inf, np.inf)
    assert (robot.link("b").mass, robot.link("b").inertia.any()) == (0.0, False)
    np.testing.assert_array_equal(robot.link("a").center_of_mass, np.zeros(3))


@pytest.mark.parametrize(
    ("inside", "kind", "limits"),
    [
        ('<limit lower="-1" upper="2" velocity="3" effort="4"/>', "revolute", (-1, 2, 3, 4)),
        ('<limit upper="2" velocity="3" effort="4"/>', "prismatic", (0, 2, 3, 4)),
        ('<limit lower="-2"/>', "revolute", (-2, 0, np.inf, np.inf)),
        ('<limit velocity="3" effort="4"/>', "revolute", (-np.inf, np.inf, 3, 4)),
        ('<limit lower="-1" upper="1" velocity="3" effort="4"/>', "continuous", (-np.inf, np.inf, 3, 4)),
        ('<safety_controller soft_lower_limit="-0.5" k_velocity="1"/>', "revolute", (-np.inf, np.inf, np.inf, np.inf)),
    ],
)
def test_limits(inside: str, kind: str, limits: tuple[float, ...]) -> None:
    joint = Robot.from_urdf(text(moving(inside, kind))).joints[0]
    assert (joint.lower, joint.upper, joint.velocity, joint.effort) == limits


def test_an_inertia_is_turned_with_its_origin() -> None:
    inertial = (
        '<inertial><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><mass value="2"/>'
        '<inertia ixx="1" ixy="0.1" ixz="0" iyy="2" iyz="0" izz="2.5"/></inertial>'
    )
    link = Robot.from_urdf(f'<robot name="r"><link name="a">{inertial}</link></robot>').link("a")
    np.testing.assert_allclose(link.inertia, [[2, -0.1, 0], [-0.1, 1, 0], [0, 0, 2.5]], atol=1e-15)
    np.testing.assert_array_equal(link.center_of_mass, [1, 2, 3])


def test_elements_that_say_nothing_of_motion_are_passed_over() -> None:
    others = (
        '<gazebo reference="a"><link name="c"/></gazebo><material name="grey"/><joint_like name="x"/>'
        '<transmission name="t"><joint name="nowhere"><hardwareInterface>E</hardwareInterface></joint></transmission>'
    )
    joint = moving('<axis xyz="0 0 0"/><dynamics damping="1"/><calibration rising="0"/>', "fixed")
    robot = Robot.from_urdf(text(joint, others))
    assert [link.name for link in robot.links] == ["a", "b"]
    namespaced = text().replace("<robot ", '<robot xmlns="http://www.ros.org" xmlns:xacro="http://ros.org/wiki/xacro" ')
    assert Robot.from_urdf(namespaced).tip == "b"


def test_a_floating_joint_below_a_massless_root_says_that_the_robot_floats() -> None:
    source = chain("Frr").replace(f'<link name="l0">{BODY}</link>', '<link name="l0"/>')
    robot = Robot.from_urdf(source)
    assert (robot.root, robot.joint_names) == ("l1", ("j2", "j3"))
    table = '<link name="l0"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
    with pytest.warns(ModelWarning, match="'l0'.*give them as obstacles"):
        Robot.from_urdf(source.replace('<link name="l0"/>', table))
    for elsewhere in (chain("Frr"), chain("rFr")):
        assert Robot.from_urdf(elsewhere).dof == 8


def test_followers_are_coupled_held_or_free() -> None:
    source = chain("rpp", {2: '<mimic joint="j1" multiplier="2" offset="0.5"/>', 3: '<mimic joint="j2" offset="1"/>'})
    robot = Robot.from_urdf(source)
    assert robot.joint_names == ("j1",)
    assert [robot.joint(name).mimic for name in ("j2", "j3")] == [Mimic("j1", 2, 0.5), Mimic("j2", 1, 1)]
    assert [robot.couplings[name] for name in ("j2", "j3")] == [(0, 2, 0.5), (0, 2, 1.5)]
    assert Robot.from_urdf(source, mimic="free").joint_names == ("j1", "j2", "j3")
    assert Robot.from_urdf(source, mimic="free", lock={"j1": 0.25}).joint_names == ("j2", "j3")
    at_rest = Robot.from_urdf(source, mimic="lock")
    with_leader, by_hand = Robot.from_urdf(source, lock={"j1": 0.25}), Robot.from_urdf(source, lock={"j2": 3.0})
    assert [each.joint_names for each in (at_rest, with_leader, by_hand)] == [("j1",), (), ("j1",)]
    for each, places in ((at_rest, (0.5, 1.5)), (with_leader, (1.0, 2.0)), (by_hand, (3.0, 4.0))):
        np.testing.assert_allclose([each.joint(name).translation[0] for name in ("j2", "j3")], places)
    fixed = Robot.from_urdf(chain("fpf", {2: '<mimic joint="j1" offset="0.5"/>', 3: '<mimic joint="nowhere"/>'}))
    np.testing.assert_allclose(fixed.joint("j2").translation, [0.5, 0, 0])
    assert fixed.dof == 0


@pytest.mark.parametrize("root", ["l0", "l1", "l3"])
def test_another_root_and_tip_are_chosen_by_name(root: str) -> None:
    robot = Robot.from_urdf(
        chain("rpc"), root=root, tip="l0", tip_translation=(0, 0, 1), tip_rotation=np.diag([1, -1, -1])
    )
    assert (robot.root, robot.tip, robot.name) == (root, "l0", "chain")
    assert sorted(robot.joint_names) == ["j1", "j2", "j3"]
    np.testing.assert_array_equal(robot.tip_translation, [0, 0, 1])
    np.testing.assert_array_equal(robot.tip_rotation, np.diag([1, -1, -1]))


def test_the_tree_is_printed_with_masses_and_limits() -> None:
    path = urdf_file("example-robot-data", "panda_description/urdf/panda.urdf")
    lines = str(Robot.from_urdf(path, tip="panda_hand_tcp", lock={"panda_finger_joint1": 0.02})).splitlines()
    assert lines[0] == "panda of 13 links, 7 degrees of freedom, 17.4519 kg, tip on panda_hand_tcp"
    assert lines[2] == (
        "└─ panda_joint1 (revolute, -2.8973 .. 2.8973 rad, 2.175 rad/s, 87 N m) -> panda_link1  4.97068 kg"
    )
    assert len(lines) == 14


def test_a_chain_of_a_thousand_links_is_read_and_printed() -> None:
    robot = Robot.from_urdf(chain("c" * 1100))
    assert robot.dof == 1100
    assert len(str(robot).splitlines()) == 1102


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "<robot name='r'>\n<link name='a'>\n</robot>",
            "the given text is not well-formed XML: mismatched tag, line 3",
        ),
        ("\n\n<robot name='r'>\n<link name='a'>\n</robot>", "mismatched tag, line 5"),
        (
            "<robot><xacro:property name='m' value='1'/></robot>",
            "element <xacro:property>: this is xacro.*expand it first.*expand_xacro.*extra xacro",
        ),
        (
            "<robot xmlns:xacro='http://ros.org/wiki/xacro'>\n<xacro:include filename='x'/></robot>",
            "element <xacro:include>: this is xacro",
        ),
        (
            text().replace('value="2"', 'value="${m}"'),
            r"link 'a': value='\$\{m\}' of <mass> is not numeric: this is xacro",
        ),
        ("<sdf/>", "not URDF: its root element is <sdf>"),
        ("<robot name='r'/>", "'r' has no <link>"),
        ("no/such.urdf", "file 'no/such.urdf' cannot be read: No such file.*begins with '<'"),
        ("", "cannot be read"),
        ("x" * 5000, "cannot be read"),
        ("a\0b", "cannot be read"),
        (3, "a URDF source is a text or a path, not int"),
        (b"<robot/>", "not bytes"),
        (text().replace('name="b"', ""), "a <link> of children .* has no attribute 'name'"),
        (
            text(f'<joint type="fixed">{ENDS}</joint>'),
            "a <joint> of children .*'parent', 'child'.* no attribute 'name'",
        ),
        (text(f'<joint name="j">{ENDS}</joint>'), "joint 'j': <joint> has no attribute 'type'"),
        (text('<joint name="j" type="fixed"><parent link="a"/></joint>'), "joint 'j': <joint> has no <child>"),
        (text(moving().replace('<child link="b"/>', "<child/>")), "joint 'j': <child> has no attribute 'link'"),
        (text().replace('<mass value="2"/>', ""), "link 'a': <inertial> has no <mass>"),
        (text().replace('<mass value="2"/>', "<mass/>"), "link 'a': <mass> has no attribute 'value'"),
        (text().replace('ixz="0" ', ""), "link 'a': <inertia> has no attribute 'ixz'"),
        (text().replace('value="2"', 'value="two"'), "link 'a': value='two' of <mass> is not numeric"),
        (text().replace('value="2"', 'value="2_0"'), "value='2_0' of <mass> is not numeric"),
        (text().replace('value="2"', 'value="1 2"'), "has 2 numbers, not 1"),
        (text().replace('value="2"', 'value="nan"'), "link 'a': mass must be .*, not nan"),
        (text().replace('value="2"', 'value="-2"'), "link 'a': mass must be .*, not -2.0"),
        (text().replace(BODY, 2 * BODY), "link 'a' has 2 <inertial> elements"),
        (text(moving('<origin xyz="1 2"/>')), "joint 'j': xyz='1 2' of <origin> has 2 numbers, not 3"),
        (text(moving('<origin rpy="0,0,0"/>')), "rpy='0,0,0' of <origin> is not numeric"),
        (text(moving('<axis xyz="0 0 0"/>')), "joint 'j': axis .* has no direction"),
        (text(moving('<origin rpy="0 nan 0"/>')), "joint 'j': rpy='0 nan 0' of <origin> is not finite"),
        (text(moving("<axis/>")), "joint 'j': <axis> has no attribute 'xyz'"),
        (text(moving('<limit lower="1" upper="-1"/>')), "joint 'j': lower limit 1.0 is above upper limit -1.0"),
        (text(moving('<limit velocity="-1"/>')), "joint 'j': velocity limit -1.0 is negative"),
        (text().replace("<mass value", "<mass valu"), "link 'a': <mass> has no attribute 'value', but 'valu': is it"),
        (text().replace("ixx", "ixX"), "link 'a': <inertia> has no attribute 'ixx', but 'ixX': is it"),
        (text(moving(2 * '<limit effort="1"/>')), "joint 'j' has 2 <limit> elements in <joint>; it takes one at most"),
        (text(moving(2 * '<axis xyz="1 0 0"/>')), "joint 'j' has 2 <axis> elements"),
        (text(moving(2 * '<origin xyz="1 0 0"/>')), "joint 'j' has 2 <origin> elements"),
        (text(moving(2 * '<mimic joint="j"/>')), "joint 'j' has 2 <mimic> elements"),
        (text(moving('<parent link="b"/>')), "joint 'j' has 2 <parent> elements"),
        (text().replace('<mass value="2"/>', 2 * '<mass value="2"/>'), "link 'a' has 2 <mass> elements in <inertial>"),
        (text('<tip link="B"/>' + moving()), "tip link 'B' does not exist; did you mean 'b'"),
        (text(moving(kind="ball")), "joint 'j' is of the type 'ball', which is not supported; use one of fixed"),
        (text(moving(kind="Revolute")), "joint 'j' is of the type 'Revolute'"),
        (text(moving().replace('child link="b"', 'child link="B"')), "child link 'B' does not exist; did you mean 'b'"),
        (text(moving() + moving(name="k")), "link 'b' is the child of joints 'j' and 'k': a loop"),
        (text(moving().replace('"a"', '"c"').replace('"b"', '"a"').replace('"c"', '"b"') + moving(name="k")), "loop"),
        (text(links='<link name="c"/>'), r"links \['a', 'c'\] have no parent joint"),
        (text(links='<link name="a"/>'), "link name 'a' is used more than once"),
        (chain("rr").replace('"j2"', '"j1"'), "joint name 'j1' is used more than once"),
        (chain("rr", {2: '<mimic joint="k1"/>'}), "joint 'j2': mimicked joint 'k1' does not exist; did you mean 'j1'"),
        (chain("rr", {2: "<mimic/>"}), "joint 'j2': <mimic> has no attribute 'joint'"),
        (
            chain("rr", {1: '<mimic joint="j2"/>', 2: '<mimic joint="j1"/>'}),
            r"\['j1', 'j2'\] mimic each other in a ring",
        ),
        (
            chain("rr", {2: '<mimic joint="j1" multiplier="x"/>'}),
            "joint 'j2': multiplier='x' of <mimic> is not numeric",
        ),
    ],
)
def test_invalid_robots_are_refused(source: Any, message: str) -> None:
    with refused(message):
        Robot.from_urdf(source)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tip": "l33"}, "tip link 'l33' does not exist; did you mean 'l3'"),
        ({"tip": "elbow"}, r"tip link 'elbow' does not exist; known: l0, l1, l2, l3"),
        ({"lock": {"J1": 0.0}}, "joint 'J1' does not exist; did you mean 'j1'"),
        ({"lock": {"j3": 0.0}}, "joint 'j3' is fixed; only a joint that moves can be locked"),
        ({"lock": {"j1": np.nan}}, "joint 'j1': locked position must be a finite number, not nan"),
        ({"mimic": "both"}, r"mimic must be 'couple' or 'lock' or 'free', not 'both'"),
        ({"inertia": "fix"}, r"inertia must be 'warn' or 'as_given', not 'fix'"),
        ({"tip_translation": (1, 2)}, "tip_translation has shape"),
        ({"tip_rotation": np.ones((3, 3))}, "tip_rotation .* not a rotation"),
        ({"root": "L2"}, "root link 'L2' does not exist; did you mean 'l2'"),
    ],
)
def test_arguments_that_do_not_fit_the_robot_are_refused(options: dict[str, Any], message: str) -> None:
    with refused(message):
        Robot.from_urdf(chain("rrf"), **options)


def test_impossible_inertias_are_named_in_one_warning_and_can_be_accepted() -> None:
    path = urdf_file(*ROBOTS["tiago"][:2])
    with pytest.warns(
        ModelWarning, match=r"base_antenna_left_link.*negative.*base_antenna_right_link.*as_given"
    ) as message:
        robot = Robot.from_urdf(path)
    assert (len(message), message[0].filename) == (1, __file__)
    doubtful = [link.name for link in robot.links if link.any_inertia]
    assert doubtful == ["base_antenna_left_link", "base_antenna_right_link"]
    assert str(Robot.from_urdf(path, inertia="as_given")) == str(robot)


def test_an_attribute_that_may_stand_for_one_that_is_lacking_is_named_and_an_extension_is_not() -> None:
    strange = moving('<origin xyz="1 2 3" turn="0 0 1"/>')
    with pytest.warns(ModelWarning, match=r"joint 'j': turn='0 0 1' of <origin>") as message:
        Robot.from_urdf(text(strange))
    assert (len(message), message[0].filename) == (1, __file__)
    whole = '<limit lower="-1" upper="1" effort="2" velocity="3" current="4" x:uper="5" xmlns:x="y"/>'
    assert Robot.from_urdf(text(moving(whole))).upper == 1.0


def test_a_joint_whose_followers_leave_it_one_position_is_named() -> None:
    limit = '<limit lower="0" upper="1" effort="1" velocity="1"/>'
    source = chain("rr", {1: limit, 2: limit + '<mimic joint="j1" multiplier="-1"/>'})
    with pytest.warns(ModelWarning, match=r"joints \['j1'\] cannot move") as message:
        assert Robot.from_urdf(source).upper == 0.0
    assert message[0].filename == __file__


def test_a_configuration_of_a_wrong_length_names_the_joints() -> None:
    with refused(r"q has shape \(2, 1\), expected \(3, 1\).*'j1', 'j2', 'j3'"):
        link_frames(Robot.from_urdf(chain()), [0.0, 0.0])


def test_a_robot_without_inertials_does_not_float() -> None:
    robot = Robot.from_urdf(chain().replace(BODY, ""))
    assert robot.total_mass == 0
    message = "no mass.*in URDF none has an <inertial>"
    with refused(message):
        FreeFloating(robot)
    with refused(message):
        center_of_mass(robot, np.zeros(3))
    with refused(message):
        Standing(robot, support=rectangle((-1.0, 1.0), (-1.0, 1.0)))


def test_a_robot_of_point_masses_does_not_float_and_the_bare_links_are_named() -> None:
    point = '<inertial><mass value="2"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
    joint = f'<joint name="j" type="continuous">{ENDS}</joint>'
    with refused(r"links \['b'\] have no mass: in URDF, no <inertial>"):
        FreeFloating(Robot.from_urdf(text(joint).replace(BODY, point)))


@pytest.mark.filterwarnings("ignore:.*in millimetres:models.errors.ModelWarning")
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e5])
def test_whether_a_robot_floats_does_not_depend_on_its_size(size: float) -> None:
    """Similar robots of one mass move alike: the same turning, all ways in proportion."""
    rates = np.array([0.3, -0.5, 0.4])
    turning = []
    for scale in (1.0, size):
        links = tuple(Link(f"l{i}", 1.0, (0.4 * scale, 0, 0), np.diag([1, 2, 2.5]) * scale**2) for i in range(4))
        joints = tuple(
            Joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}", (scale, 0, 0), axis=axis)
            for i, axis in enumerate(((0, 0, 1), (0, 1, 0), (1, 0, 1)))
        )
        machine = FreeFloating(Robot(links, joints))
        turning.append(numeric(machine.base_twist(machine.base_home(), (0.2, 0.3, 0.4), rates))[:3])
    np.testing.assert_allclose(turning[1], turning[0], rtol=1e-9)


def test_a_configuration_of_words_is_refused() -> None:
    with refused(r"q 'home' is not numeric; \(3, 1\) expected"):
        link_frames(Robot.from_urdf(chain()), "home")
