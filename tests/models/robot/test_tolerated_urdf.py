"""Faulty files that Pinocchio loads are loaded with a warning, named states are read, and xacro only on request."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import ModelError, ModelWarning, Robot, expand_xacro, lock_joints, named_states
from models.files import _parse_bound, parse_xml
from tests.models.robot.trees import numeric_poses, refused

BODY = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
SHAPE = '<geometry><box size="1 1 1"/></geometry>'
LIMIT = '<limit lower="-1" upper="2" effort="0" velocity="0"/>'
URDF = f"""<?xml version="1.0"?>
<robot name="arm">
<link name="base"/><link name="upper">{BODY}<collision>{SHAPE}</collision></link><link name="fore">{BODY}</link>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 1" rpy="0.1 0.2 0.3"/>
<axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="j2" type="prismatic"><parent link="upper"/><child link="fore"/><origin xyz="1 0 0"/>
<axis xyz="0 0 1"/>{LIMIT}</joint>
</robot>"""
XACRO = 'xmlns="http://ros.org/wiki/xacro"'
FAULTS = {
    "box without edges": (SHAPE, SHAPE.replace("1 1 1", "0 0 0"), r"link 'upper': collision box of size \[0.0, 0.0"),
    "flat box": (SHAPE, SHAPE.replace("1 1 1", "1 1 0"), r"collision box of size \[1.0, 1.0, 0.0\]"),
    "point": (SHAPE, SHAPE.replace('box size="1 1 1"', 'sphere radius="0"'), r"collision sphere of size \[0.0\]"),
    "line": (SHAPE, SHAPE.replace('box size="1 1 1"', 'cylinder radius="0" length="1"'), r"cylinder of size \[0.0, 1"),
    "prefix": ("<link", '<gazebo:foo a="1"><link name="x"/></gazebo:foo><link', "gazebo:foo, whose prefix is not decl"),
    "prefix of an attribute": ('<link name="base"', '<link name="base" y:z="1"', "y:z, whose prefix is not declared"),
    "call of a macro": ("<link", f"<v1_sensors {XACRO}/><link", "<xacro:v1_sensors>, a macro that is not defined"),
    "misspelt": ('xyz="1 0 0"', 'xzy="1 0 0"', r"joint 'j2': xzy='1 0 0' of <origin> \(did you mean 'xyz'\?\)"),
    "unknown": ('<origin xyz="1 0 0"', '<origin turn="1 0 0"', "joint 'j2': turn='1 0 0' of <origin>"),
    "misspelt beside all others": (LIMIT, LIMIT.replace("/>", ' uper="1"/>'), r"uper='1' .*did you mean 'upper'"),
    "two shapes": ("</geometry>", '<sphere radius="1"/></geometry>', "'upper': <sphere>, since .* begins with <box>"),
}


@pytest.mark.parametrize(("part", "fault", "message"), FAULTS.values(), ids=list(FAULTS))
def test_a_faulty_file_that_pinocchio_loads_is_loaded_with_equal_kinematics(
    part: str, fault: str, message: str
) -> None:
    assert part in URDF
    text = URDF.replace(part, fault, 1)
    with pytest.warns(ModelWarning, match=message) as caught:
        robot = Robot.from_urdf(text)
    assert (len(caught), caught[0].filename) == (1, __file__)
    reported: Any = caught[0].message
    assert reported.name in str(reported)
    model = pinocchio.buildModelFromXML(text)
    data, q = model.createData(), np.array([0.7, -0.3])
    pinocchio.framesForwardKinematics(model, data, q)
    for name, pose in numeric_poses(robot, q).items():
        place = data.oMf[model.getFrameId(name, pinocchio.FrameType.BODY)]
        np.testing.assert_allclose(np.c_[pose], np.c_[place.rotation, place.translation], atol=1e-14)
    assert len(robot.link("upper").collisions) == (0 if "collision" in message or "cylinder" in message else 1)
    np.testing.assert_array_equal([robot.velocity, robot.effort], np.inf)  # 0 means unknown


def test_many_faults_are_one_short_warning() -> None:
    faults = "".join(f"<x:f{number}/>" for number in range(5000))
    with pytest.warns(ModelWarning, match="and 4988 more") as caught:
        Robot.from_urdf(URDF.replace("<link", faults + "<link", 1))
    assert len(caught) == 1
    assert len(str(caught[0].message)) < 2000


TAGS = st.sampled_from(["a", "p:a", "q:b", "link", "xml:c"])
KEYS = st.sampled_from(["k", "p:k", "q:k", "xmlns", "xmlns:p", "xmlns:q", "xml:lang"])
VALUES = st.sampled_from(["u", "v", "w x"])


@st.composite
def documents(draw: st.DrawFn, depth: int = 0) -> str:
    """Documents with namespaces; most use a prefix that is not declared."""
    tag = draw(TAGS)
    keys = draw(st.dictionaries(KEYS, VALUES, max_size=4))
    inside = "".join(draw(st.lists(documents(depth + 1), max_size=2))) if depth < 4 else ""
    attributes = "".join(f' {key}="{value}"' for key, value in keys.items())
    return f"<{tag}{attributes}>t{inside}</{tag}>{'s' if depth else ''}"


def content(element: ElementTree.Element) -> Any:
    return element.tag, element.attrib, element.text, element.tail, [content(each) for each in element]


@settings(max_examples=50)
@given(documents())
def test_names_are_resolved_as_by_the_standard_library_where_all_prefixes_are_declared(text: str) -> None:
    """A root that declares both prefixes, and one that declares none of them."""
    text = f'<r xmlns:p="up" xmlns:q="uq">{text}</r>'
    try:
        expected = ElementTree.fromstring(text)
    except ElementTree.ParseError:  # two attributes of one name
        return
    unbound: list[str] = []
    assert content(_parse_bound(text, unbound, ElementTree.ParseError())) == content(expected)
    assert not unbound
    bare = text.replace(' xmlns:p="up" xmlns:q="uq"', "")
    left = list(parse_xml(bare, unbound).iter())
    assert len(left) <= len(list(expected.iter()))
    try:
        assert content(ElementTree.fromstring(bare)) == content(parse_xml(bare, []))
        assert not unbound
    except ElementTree.ParseError:
        assert unbound


def test_many_declarations_of_namespaces_take_time_in_proportion() -> None:
    """20000 nested elements that each declare a prefix: copies of all declarations would take minutes."""
    count = 20_000
    text = "<r>" + "".join(f'<a xmlns:p{k}="u">' for k in range(count)) + "<x:y/>" + "</a>" * count + "</r>"
    unbound: list[str] = []
    assert sum(1 for _ in parse_xml(text, unbound).iter()) == count + 1
    assert unbound == ["x:y"]


SRDF = """<robot name="arm"><group name="both"><joint name="j1"/><joint name="j2"/></group>
<group_state name="home" group="both"><joint name="j1" value="0.5"/><joint name="j2" value="-0.25"/></group_state>
<group_state name="up" group="a"><joint name="j1" value="1"/></group_state>
<group_state name="up" group="b"><joint name="j2" value="1"/></group_state></robot>"""


def test_named_states_are_joint_vectors_with_other_joints_at_or_near_zero(tmp_path: Path) -> None:
    robot = Robot.from_urdf(URDF.replace('lower="-1"', 'lower="0.125"', 1))
    (tmp_path / "arm.srdf").write_text(SRDF)
    for source in (SRDF, tmp_path / "arm.srdf"):
        states = {name: positions.tolist() for name, positions in named_states(source, robot).items()}
        assert states == {"home": [0.5, -0.25], "a/up": [1.0, 0.0], "b/up": [0.125, 1.0]}
    assert named_states(SRDF, lock_joints(robot, {"j2": 0.0}))["home"].tolist() == [0.5]
    with pytest.warns(ModelWarning, match="'arm' does not have: 'j3'") as caught:
        assert named_states(SRDF.replace('name="j2" value', 'name="j3" value'), robot)["home"].tolist() == [0.5, 0.0]
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("part", "fault", "message"),
    [
        ('value="0.5"', "", "state 'home': joint 'j1': <joint> has no attribute 'value'"),
        ('value="0.5"', 'value="nan"', "joint 'j1': value='nan' of <joint> is not finite"),
        ('value="0.5"', 'value="1 2"', "has 2 numbers"),
        ('name="home"', "", "SRDF: <group_state> has no attribute 'name'"),
        (' group="a"', "", "state 'up': <group_state> has no attribute 'group'"),
        ("<robot", "<sdf", "not well-formed"),
    ],
)
def test_bad_states_are_refused_by_name(part: str, fault: str, message: str) -> None:
    with refused(message):
        named_states(SRDF.replace(part, fault, 1), Robot.from_urdf(URDF))


MACROS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="part" params="name">
<link name="${name}"/></xacro:macro></robot>"""
SCRIPT = f"""<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="macros.xacro"/>
<xacro:part name="base"/><xacro:part name="tool"/>{URDF[URDF.index("<joint") : URDF.index('<joint name="j2"')]}
</robot>""".replace('"upper"', '"tool"').replace('xyz="0 0 1"', 'xyz="0 0 ${2 * pi}"')


def test_xacro_is_expanded_on_request_only(tmp_path: Path) -> None:
    (tmp_path / "arm.xacro").write_text(SCRIPT)
    (tmp_path / "macros.xacro").write_text(MACROS)
    with refused("expand_xacro.*extra xacro"):
        Robot.from_urdf(tmp_path / "arm.xacro")
    robot = Robot.from_urdf(expand_xacro(tmp_path / "arm.xacro"))
    assert (robot.root, robot.tip, robot.joint_names) == ("base", "tool", ("j1",))
    assert robot.joint("j1").translation.tolist() == [0.0, 0.0, 2 * np.pi]
    (tmp_path / "macros.xacro").unlink()
    with refused("cannot be expanded by xacro"):
        expand_xacro(tmp_path / "arm.xacro")


PIECES = st.sampled_from(
    ["", "0", "nan", "-1", "1e400", "<", "/>", '"', "x:", "<x:y>", "</x:y>", " xmlns:x='u'", "<xacro:a/>", "link", "&",
     "<box/>", "<sphere radius='0'/>", "\0", "\udc80", "é", " xyz='1'", "${a}", "<joint/>", "<limit uper='1'/>"]
)  # fmt: skip


@settings(max_examples=150)
@given(st.sampled_from([URDF, SRDF]), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 25), PIECES), max_size=4))
def test_a_mutated_file_is_read_or_refused_with_an_error_of_the_package(
    text: str, changes: list[tuple[float, int, str]]
) -> None:
    for share, removed, piece in changes:
        place = int(share * len(text))
        text = text[:place] + piece + text[place + removed :]
    arm = Robot.from_urdf(URDF)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        for read in (Robot.from_urdf, lambda source: named_states(source, arm)):
            try:
                read(text)
            except ModelError as error:
                assert error.name is not None  # noqa: PT017
