"""Robots from MJCF, compared with MuJoCo itself."""

from __future__ import annotations

import builtins
import os
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import (
    Box,
    CollisionScene,
    FixedBase,
    ModelError,
    ModelWarning,
    Robot,
    excluded_pairs,
    inverse_dynamics,
    link_frames,
    mass_matrix,
    tip_pose,
)
from scripts.robots.simulation import mjcf_text
from tests.models.robot.oracles import with_masses
from tests.models.robot.trees import numeric, random_robot, refused, seeds

GRAVITY = np.array([0.3, -0.2, -9.81])
ARM = """<mujoco model="arm"><compiler angle="degree" meshdir="meshes" autolimits="true"/>
<default><geom density="500"/><joint axis="0 1 0" range="-170 160"/>
  <default class="shown"><geom contype="0" conaffinity="0" rgba="1 0 0 1"/></default></default>
<worldbody><light pos="0 0 3"/><camera name="view" pos="1 0 0"/>
  <body name="base" pos="0.1 0.2 0.3" euler="10 20 30"><geom type="cylinder" size="0.05 0.1"/>
    <body name="upper" pos="0 0 0.2"><joint name="shoulder" axis="0 0 2" pos="0.02 0.01 0" ref="30"/>
      <joint name="lift" actuatorfrcrange="-40 50"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.04"/><geom class="shown" type="box" size="0.1 0.2 0.3"/>
      <frame pos="0.3 0 0.1" quat="0.9 0.1 0.2 0.3">
        <body name="fore"><joint name="elbow" type="hinge" limited="false"/><inertial pos="0.1 0 0.05" mass="1.5"
            fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/><geom type="ellipsoid" size="0.1 0.05 0.05"/>
          <site name="tcp" pos="0.2 0 0" xyaxes="0 1 0 0 0 1"/>
          <body name="left" pos="0.2 0.03 0"><joint name="l" type="slide" range="0 0.04" ref="0.01" pos="0.5 0 0"/>
            <geom size="0.01"/></body>
          <body pos="0.2 -0.03 0"><joint name="r" type="slide" axis="0 -1 0" range="0 0.05"/><geom size="0.01"/></body>
        </body></frame></body></body></worldbody>
<contact><exclude body1="base" body2="fore"/></contact>
<equality><joint joint1="r" joint2="l" polycoef="0.002 0.5 0 0 0"/></equality>
<actuator><motor joint="shoulder" gear="20" ctrlrange="-2 2"/>
  <position joint="elbow" kp="9" forcerange="-8 6" gear="2"/>
  <motor joint="lift" gear="100" ctrlrange="-1 1"/></actuator>
<sensor><jointpos joint="l"/></sensor></mujoco>"""
WRIST = """<mujoco><compiler angle="radian" eulerseq="zyx" inertiafromgeom="true"/><worldbody>
<body name="a" pos="0 0 1"><joint name="x" type="slide" axis="1 2 0"/>
  <joint name="t" axis="1 1 1" pos="0 0.1 0.2" ref="0.4"/>
  <joint name="u" axis="0 1 0" pos="0.3 0 0"/>
  <geom type="box" size="0.1 0.2 0.1" pos="0.1 0 0" euler="0.1 0.2 0.3" mass="2"/>
  <body name="b" pos="0.4 0 0"><inertial pos="9 9 9" mass="99" diaginertia="1 1 1"/><geom size="0.1"/><joint name="v"/>
  </body></body></worldbody></mujoco>"""
CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 0.2) for y in (0, 0.1) for z in (0, 0.3)) + "".join(
    f"f {face}\n" for face in ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
)
MESHED = """<mujoco><compiler meshdir="m"/><asset><mesh name="cube" file="cube.obj" scale="1 2 1"/>
<mesh file="b.obj"/></asset>
<worldbody><geom type="plane" size="1 1 1"/><body name="a" pos="0 0 1" euler="0 20 0"><joint name="j" axis="0 1 0"/>
<geom type="mesh" mesh="cube" pos="0.1 0 0" euler="0 0 30"/><body name="b" pos="1 0 0"><joint name="k"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom type="mesh" mesh="b"/></body></body></worldbody></mujoco>"""


def quietly(source: Any, **options: Any) -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return Robot.from_mjcf(source, **options)


def assert_same_mechanics(robot: Robot, model: mujoco.MjModel, seed: int) -> None:
    """Frames of bodies and sites, mass matrix and gravity torques, within 1e-9, at positions given by joint name."""
    rng = np.random.default_rng(seed)
    model.opt.gravity[:] = GRAVITY
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    couplings = {name: couplings for name, couplings in robot.couplings.items() if name in jacobian_names(model)}
    q = rng.uniform(-1, 1, robot.dof)
    project = np.zeros((model.nv, robot.dof))
    for name, (column, ratio, offset) in couplings.items():
        data.qpos[model.joint(name).qposadr[0]] = ratio * q[column] + offset
        project[model.joint(name).dofadr[0], column] = ratio
    mujoco.mj_forward(model, data)
    for name, frame in link_frames(robot, q).items():
        for kind in ("body", "site"):
            index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
            if index >= 0:
                place = getattr(data, "xpos" if kind == "body" else "site_xpos")[index]
                turn = getattr(data, "xmat" if kind == "body" else "site_xmat")[index].reshape(3, 3)
                np.testing.assert_allclose(numeric(frame.position).ravel(), place, rtol=0, atol=1e-9)
                np.testing.assert_allclose(numeric(frame.rotation), turn, rtol=0, atol=1e-9)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(numeric(mass_matrix(robot, q)), project.T @ full @ project, rtol=0, atol=1e-9)
    rest = np.zeros(robot.dof)
    torques = numeric(inverse_dynamics(robot, q, rest, rest, gravity=GRAVITY)).ravel()
    np.testing.assert_allclose(torques, project.T @ data.qfrc_bias, rtol=0, atol=1e-9)


def jacobian_names(model: mujoco.MjModel) -> set[str]:
    return {model.joint(j).name for j in range(model.njnt)}


@pytest.mark.parametrize("text", [ARM, WRIST], ids=["arm", "wrist"])
@given(seed=seeds)
@settings(max_examples=8)
def test_frames_mass_matrix_and_gravity_torques_are_those_of_mujoco(text: str, seed: int) -> None:
    assert_same_mechanics(quietly(text), mujoco.MjModel.from_xml_string(text), seed)


@given(seeds)
@settings(max_examples=10)
def test_a_random_robot_is_that_of_mujoco(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = with_masses(random_robot(rng, 6), rng)
    text = mjcf_text(robot, fixed=True)
    result = Robot.from_mjcf(text, tip=robot.tip)
    assert result.joint_names == robot.joint_names
    assert_same_mechanics(result, mujoco.MjModel.from_xml_string(text), seed)
    assert_same_mechanics(robot, mujoco.MjModel.from_xml_string(text), seed)


def test_limits_couplings_and_shapes_are_those_of_the_file() -> None:
    with pytest.warns(
        ModelWarning, match="the given text.*body 'fore': geom, an ellipsoid, for which the box around it is taken"
    ) as caught:
        robot = Robot.from_mjcf(ARM, tip="tcp", lock={"lift": 0.1})
    assert caught[0].filename == __file__
    assert robot.joint_names == ("shoulder", "elbow", "l")
    np.testing.assert_allclose(np.rad2deg([robot.lower[0], robot.upper[0]]), [-170, 160])
    assert robot.joint("elbow").kind == "continuous"
    np.testing.assert_allclose(robot.effort, [40, 12, np.inf])
    assert quietly(ARM).effort[1] == 40  # the force range of the joint, below that of its motor
    assert np.isinf(robot.velocity).all()
    np.testing.assert_allclose([robot.lower[2], robot.upper[2]], [0.006, 0.04])  # r = .002 + (l - .01) / 2 is positive
    kinds = [shape.kind for link in robot.links for shape in link.collisions]
    assert kinds == ["cylinder", "capsule", "box", "sphere", "sphere"]
    (shown,) = robot.link("upper").visuals
    assert (shown.kind, shown.color.tolist(), shown.size.tolist()) == ("box", [1, 0, 0, 1], [0.2, 0.4, 0.6])
    scene = CollisionScene(FixedBase(robot), [Box((0.1, 0.1, 0.1), (2, 0, 0))], ignored=excluded_pairs(ARM))
    assert ("base", "fore") in scene.excluded
    again = Robot.from_urdf(robot.to_urdf())
    q = np.array([0.3, -0.5, 0.02])
    np.testing.assert_allclose(numeric(tip_pose(again, q).position), numeric(tip_pose(robot, q).position), atol=1e-12)


def test_meshes_weigh_and_collide_in_the_frame_of_their_file(tmp_path: Path) -> None:
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "cube.obj").write_text(CUBE)
    file = tmp_path / "arm.xml"
    file.write_text(MESHED)
    with pytest.warns(ModelWarning, match="body 'world': geom, since a plane is no body"):
        robot = Robot.from_mjcf(file)  # b.obj determines no mass and is not opened
    (tmp_path / "m" / "b.obj").write_text(CUBE)
    assert_same_mechanics(robot, mujoco.MjModel.from_xml_path(str(file)), 0)
    body = next(body for body in CollisionScene(FixedBase(robot)).bodies if body.name.startswith("a"))
    corners = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.2) for z in (0, 0.3)])
    turn = np.array([[np.cos(np.pi / 6), -0.5, 0], [0.5, np.cos(np.pi / 6), 0], [0, 0, 1]])
    points = corners @ turn.T + [0.1, 0, 0]
    middle = np.asarray(body.shape.core).mean(axis=0)
    np.testing.assert_allclose(middle, points.mean(axis=0), atol=1e-3)
    (tmp_path / "m" / "cube.obj").unlink()
    with refused("arm.xml' cannot be read by MuJoCo.*cube.obj"):
        Robot.from_mjcf(file)


FREE = """<mujoco><worldbody>{world}<body name="hull"><freejoint name="float"/><geom size="0.3"/>
<body name="arm" pos="1 0 0"><joint name="j"/><geom size="0.1"/></body></body>{more}</worldbody></mujoco>"""


def test_a_free_joint_lets_the_robot_float_or_becomes_a_chain() -> None:
    robot = Robot.from_mjcf(FREE.format(world="", more=""))
    assert (robot.root, robot.joint_names) == ("hull", ("j",))
    robot = Robot.from_mjcf(FREE.format(world="", more='<body name="wall"><geom size="1"/></body>'), tip="arm")
    assert robot.joint_names == (*(f"float_{axis}" for axis in ("x", "y", "z", "yaw", "pitch", "roll")), "j")


def test_two_joints_may_be_locked_or_coupled_by_constraints() -> None:
    def with_equality(constraint: str) -> str:
        return WRIST.replace("</mujoco>", f"<equality>{constraint}</equality></mujoco>")

    locked = Robot.from_mjcf(with_equality('<joint joint1="t" polycoef="0.3 0 0 0 0"/>'))
    assert locked.joint_names == ("x", "u", "v")
    other = Robot.from_mjcf(WRIST, lock={"t": 0.7})
    for name, frame in link_frames(locked, [0.1, 0.2, 0.3]).items():
        np.testing.assert_allclose(numeric(frame.position), numeric(link_frames(other, [0.1, 0.2, 0.3])[name].position))
    assert Robot.from_mjcf(with_equality('<joint joint1="t" joint2="u" active="false"/>')).dof == 4
    with pytest.warns(ModelWarning, match="nonlinear equality constraint of joint 't'"):
        assert Robot.from_mjcf(with_equality('<joint joint1="t" joint2="u" polycoef="0 1 2 0 0"/>')).dof == 4
    with pytest.warns(ModelWarning, match="the equality constraint <weld> 'w'"):
        assert Robot.from_mjcf(with_equality('<weld name="w" body1="a" body2="b"/>')).dof == 4


def test_included_files_are_read_from_the_folder_alone(tmp_path: Path) -> None:
    inner = tmp_path / "robot"
    inner.mkdir()
    (inner / "part.xml").write_text(
        "<mujocoinclude><body name='p'><joint name='j'/><geom size='1'/></body></mujocoinclude>"
    )
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    (inner / "link.xml").symlink_to(tmp_path / "secret.xml")
    (inner / "again.xml").write_text('<mujoco><include file="again.xml"/></mujoco>')

    def including(name: str) -> Robot:
        (inner / "arm.xml").write_text(f'<mujoco><worldbody><include file="{name}"/></worldbody></mujoco>')
        return Robot.from_mjcf(inner / "arm.xml")

    assert including("part.xml").joint_names == ("j",)
    for name in ("../secret.xml", str(tmp_path / "secret.xml"), "link.xml"):
        with refused("includes the file .* from outside its folder"):
            including(name)
    for name in ("arm.xml", "again.xml"):
        with refused("includes the file .* a second time"):
            including(name)
    for k in range(100):
        (inner / f"{k}.xml").write_text(f'<mujoco><include file="{k + 1}.xml"/></mujoco>')
    with refused("after 64 others"):
        including("0.xml")
    (inner / "ring.xml").symlink_to(inner / "ring.xml")
    with refused("ring.xml' cannot be read"):
        including("ring.xml")
    with refused("without a folder"):
        Robot.from_mjcf('<mujoco><worldbody><include file="part.xml"/></worldbody></mujoco>')


DEEP = "<body><joint/><geom size='1'/>"
BAD = {
    "plugin": ('<extension><plugin plugin="any"/></extension>', "which could run code"),
    "repetition": ('<worldbody><replicate count="1000000000"><geom/></replicate></worldbody>', "without a bound"),
    "ball": (
        '<worldbody><body><joint name="b" type="ball"/><geom size="1"/></body></worldbody>',
        "'b' is a ball joint",
    ),
    "deep": (f"<worldbody>{DEEP * 80}{'</body>' * 80}</worldbody>", "more than 64 deep"),
    "many": (f"<worldbody>{'<geom/>' * 5000}</worldbody>", "more than 4096 bodies"),
    "unknown mesh": ('<worldbody><geom type="mesh"/></worldbody>', "cannot be read by MuJoCo"),
    "no mass": ('<worldbody><body name="a"><joint/></body></worldbody>', "mass and inertia of moving bodies"),
    "device": (
        '<asset><mesh file="/dev/zero"/></asset><worldbody><body><geom type="mesh" mesh="zero"/></body></worldbody>',
        "cannot be read.*no file, but a folder, a pipe or a device",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_dangerous_or_wrong_is_refused_by_name(name: str) -> None:
    text, message = BAD[name]
    with refused(message):
        Robot.from_mjcf(f"<mujoco>{text}</mujoco>")


def test_memory_textures_and_simulation_that_a_file_asks_for_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = """<mujoco><size memory="100T"/><option timestep="1e9"/><statistic/><keyframe><key/></keyframe><asset>
    <texture name="t" type="2d" builtin="checker" width="1000000" height="1000000"/><material name="m" texture="t"/>
    <hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/><mesh name="s" builtin="sphere" params="20"/></asset>
    <worldbody><geom type="hfield" hfield="h"/><body name="a"><joint name="j"/><geom size="1" material="m"/></body>
    </worldbody><actuator><muscle joint="j"/></actuator></mujoco>"""
    with pytest.warns(ModelWarning, match="body 'world': geom, since it is no mesh as its file has it"):
        assert Robot.from_mjcf(text).joint_names == ("j",)
    with refused("body_pos|translation"):  # of which MuJoCo would write a warning into a file
        Robot.from_mjcf('<mujoco><worldbody><body name="a" pos="nan 0 0"><geom size="1"/></body></worldbody></mujoco>')
    assert os.listdir(tmp_path) == []


def test_the_formats_refer_to_each_other_and_a_missing_package_to_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in (ARM, "<sdf/>"):
        with refused("is not URDF.*Robot.from_mjcf"):
            Robot.from_urdf(text)
    with refused("is not MJCF.*Robot.from_urdf"):
        Robot.from_mjcf("<robot/>")
    import_module = builtins.__import__

    def without_mujoco(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "mujoco":
            raise ImportError
        return import_module(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_mujoco)
    with refused(r'pip install "selfmotion\[mujoco\]", or from a clone pip install "\.\[mujoco\]"'):
        Robot.from_mjcf(ARM)


PIECES = st.sampled_from(
    ["", "0", "nan", "-1", "1e400", "<", "/>", '"', "x:", "</body>", "<joint/>", "<geom/>", "&", "\0", "\udc80", "é",
     " size='0'", "<body>", "<frame/>", " limited='true'", "base", "<default/>", "<site/>", " quat='0 0 0 0'"]
)  # fmt: skip


@settings(max_examples=100)
@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 25), PIECES), max_size=4))
def test_a_mutated_file_is_read_or_refused_with_an_error_of_the_package(changes: list[tuple[float, int, str]]) -> None:
    text = ARM
    for share, removed, piece in changes:
        place = int(share * len(text))
        text = text[:place] + piece + text[place + removed :]
    try:
        quietly(text)
        excluded_pairs(text)
    except ModelError as error:
        assert error.name is not None  # noqa: PT017
