"""Pages that play motions: every surface and every frame where the model has it, curves that obey their laws."""

from __future__ import annotations

import base64
import gzip
import json
import re
import urllib.error
import urllib.request
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from models import (
    Box,
    CollisionScene,
    CollisionShape,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Joint,
    Link,
    Machine,
    MovingObstacle,
    Robot,
    Sphere,
    Standing,
    VisualShape,
    link_frames,
    lock_joints,
    mass_matrix,
    planar_chain,
    rectangle,
    simplify,
    with_load,
)
from models.checks import Array
from models.robot.kinematics import centers_of_mass
from models.shapes.mesh_files import read_mesh
from ocp import (
    ClearanceConstraints,
    Collocation,
    Plan,
    ProblemError,
    Solution,
    TipTask,
    VelocitySetup,
    minimum_velocity_problem,
    solve,
)
from ocp.__main__ import main
from ocp.app.check.joint_limits import Row, RowVerdict
from ocp.app.files import read_trajectory
from ocp.app.view import appearance, player
from ocp.app.view.animation import (
    PAGE_SETTINGS,
    Curve,
    MotionSamples,
    animate_plan,
    animate_solution,
    animate_trajectory,
    ground_contact,
    machine_curves,
)
from ocp.app.view.appearance import appearance_of, frames_along
from ocp.app.view.player import PageServer, build_page
from ocp.app.view.report import SHOWN_ROWS, report_of_plan
from ocp.motion.local.collisions import distances_along
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.tasks.targets import targets_along
from tests.models.machines.armoured import armoured_arm

MACHINE = """<robot name="arm">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="hull"><inertial><mass value="20"/><inertia ixx="2" iyy="3" izz="4" ixy="0.1" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.1" rpy="0 0 1"/><geometry><box size="1 0.4 0.2"/></geometry></visual></link>
  <link name="upper/arm"><inertial><origin xyz="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://arm_description/upper.obj" scale="2 1 -1"/></geometry>
      <material name="red"/></visual>
    <collision><geometry><cylinder radius="0.04" length="0.5"/></geometry></collision></link>
  <link name="fore"><inertial><origin xyz="0.25 0 0"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.05" length="0.5"/></geometry></visual></link>
  <link name="hand"><inertial><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <link name="finger"/>
  <joint name="shoulder" type="revolute"><parent link="hull"/><child link="upper/arm"/><origin xyz="0.5 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="5" effort="9"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper/arm"/><child link="fore"/>
    <origin xyz="0.6 0 0" rpy="0.3 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="hand"/><origin xyz="0.5 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="5" effort="9"/></joint>
  <joint name="grip" type="prismatic"><parent link="hand"/><child link="finger"/><origin xyz="0.1 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.1" velocity="1" effort="9"/></joint>
</robot>"""
OBJ = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
OPTIONS: dict[str, Any] = {"tip": "finger", "lock": {"grip": 0.05}, "tip_translation": [0.2, 0.0, 0.01]}
TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
START = np.array([0.4, 0.7, -0.6])
GROUPS = {"Cost", "The motion", "Joints", "Joint velocities"}


def unpack_page(text: str) -> tuple[dict[str, Any], dict[int, NDArray[Any]]]:
    """Return the contents of a page: its description, and the arrays by their offsets."""
    mark = '<script id="data" type="text/plain">'
    begin = text.index(mark) + len(mark)
    data_bytes = gzip.decompress(base64.b64decode(text[begin : text.index("</script>", begin)]))
    size = int.from_bytes(data_bytes[:4], "little")
    description, body = json.loads(data_bytes[4 : 4 + size]), data_bytes[4 + size :]
    arrays: dict[int, NDArray[Any]] = {}

    def collect(value: Any) -> None:
        if isinstance(value, dict) and set(value) == {"at", "kind", "shape"}:
            count = int(np.prod(value["shape"]))
            array = np.frombuffer(body, f"<{value['kind']}" if value["kind"] != "i1" else "i1", count, value["at"])
            arrays[value["at"]] = array.reshape(value["shape"])
        elif isinstance(value, dict):
            for part in value.values():
                collect(part)
        elif isinstance(value, list):
            for part in value:
                collect(part)

    collect(description)
    return description, arrays


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """arm.urdf, and its mesh in a package."""
    path = tmp_path_factory.mktemp("arm")
    (path / "arm.urdf").write_text(MACHINE, encoding="utf-8")
    (path / "share" / "arm_description").mkdir(parents=True)
    (path / "share" / "arm_description" / "upper.obj").write_text(OBJ, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def robot(folder: Path) -> Robot:
    return Robot.from_urdf(folder / "arm.urdf", **OPTIONS)


@pytest.fixture(scope="module")
def machines(robot: Robot) -> dict[str, Machine]:
    return {"fixed": FixedBase(robot, (0.1, -0.2, 0.7), TURN), "floating": FreeFloating(robot)}


@pytest.fixture(scope="module")
def plans(machines: dict[str, Machine]) -> dict[str, SolvedPlan]:
    return {kind: planned(machine) for kind, machine in machines.items()}


def planned(machine: Machine, **more: Any) -> SolvedPlan:
    problem = minimum_velocity_problem(machine, TipTask(rows=(3, 4), velocity=(0.1, -0.1)), 1.5, start=START, **more)
    solution = solve(problem, Collocation(intervals=6, degree=3))
    return SolvedPlan(machine, solution, (Part(0.0, 1.5, ""),))


def turned(quaternion: Array) -> Array:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def surfaces(report: Any, arrays: Any, robot: int = 0) -> dict[tuple[str, tuple[float, ...]], Array]:
    """Corners of what is shown, in the frame of the link that moves it, by the link's name and the colour."""
    by_name = {}
    for part in report["robots"][robot]["parts"]:
        corners = np.array(part["low"]) + np.array(part["step"]) * arrays[part["vertices"]["at"]][:, :3]
        by_name[part["link"], tuple(part["color"])] = corners
    return by_name


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_every_frame_and_the_tip_stand_where_the_model_has_them(
    plans: dict[str, Plan], machines: dict[str, Machine], kind: str
) -> None:
    machine, plan = machines[kind], plans[kind]
    report, arrays = unpack_page(build_page([animate_plan(plan)]).text)
    motion, movers = report["motions"][0], report["robots"][0]["movers"]
    t, poses = arrays[motion["t"]["at"]], arrays[motion["poses"]["at"]]
    assert movers == [link.name for link in machine.robot.links]
    for k in (0, len(t) // 3, len(t) - 1):
        at = plan.at(float(t[k]))
        base = at["base"] if machine.base_size else ()
        frames = link_frames(machine.robot, ca.DM(at["joints"]), machine.world_from_base(ca.DM(base)))
        wanted = [
            (np.array(ca.DM(f.position)).ravel(), np.array(ca.DM(f.rotation))) for f in map(frames.get, movers) if f
        ]
        tip = machine.tip_pose(base, at["joints"])  # 0.2 m off its link
        wanted.append((np.array(ca.DM(tip.position)).ravel(), np.array(ca.DM(tip.rotation))))
        for pose, (position, rotation) in zip(poses[k], wanted, strict=True):
            np.testing.assert_allclose(pose[:3], position, atol=2e-6)
            np.testing.assert_allclose(turned(pose[3:].astype(float)), rotation, atol=2e-6)
    steps = (poses[1:, :, 3:] * poses[:-1, :, 3:]).sum(axis=2)
    assert steps.min() > 0.9  # between two times the turn is the short way round


def test_links_are_drawn_by_visuals_or_else_by_collision_shapes(folder: Path, robot: Robot) -> None:
    looks = appearance_of(robot, [folder / "share"])
    assert not looks.missing
    by = {part.link: part for part in looks.parts}
    assert set(by) == {"hull", "upper/arm", "fore", "hand", "finger"}  # of the finger the rod to the tip
    cosine, sine = np.cos(1), np.sin(1)
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.2, 0.2) for z in (-0.1, 0.1)])
    corners = signs @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) + [0, 0, 0.1]
    np.testing.assert_allclose(np.unique(by["hull"].vertices.round(4), axis=0), np.unique(corners.round(4), axis=0))
    np.testing.assert_allclose(np.ptp(by["upper/arm"].vertices, axis=0), [0.2, 0.1, 0.1], atol=1e-9)
    assert by["upper/arm"].vertices[:, 2].min() == pytest.approx(-0.1)  # mirrored
    assert by["upper/arm"].color == (1.0, 0.0, 0.0, 1.0)
    assert by["hand"].color[3] < 0.5  # without a look among others that have one: faint
    np.testing.assert_allclose(np.linalg.norm(by["hand"].vertices, axis=1), 0.05, atol=1e-6)
    bare = appearance_of(robot)
    assert list(bare.missing) == ["package://arm_description/upper.obj"]
    instead = {part.link: part for part in bare.parts}["upper/arm"]  # what it touches with
    np.testing.assert_allclose(np.ptp(instead.vertices, axis=0), [0.08, 0.08, 0.5], atol=1e-6)
    assert instead.color[3] == 1.0
    assert not appearance_of(robot, meshes=False).missing
    nothing = Robot((Link("a", 1.0), Link("b", 1.0), Link("c")), tuple(_chain(("a", "b", "c"))), tip="c")
    assert {part.link for part in appearance_of(nothing).parts} == {"a", "b"}  # rods


def _chain(names: tuple[str, ...]) -> Any:
    for parent, child in pairwise(names):
        yield Joint(f"to_{child}", "revolute", parent, child, (0.3, 0.0, 0.0))


@pytest.mark.parametrize("change", ["simplified", "locked", "with_load"])
def test_a_robot_that_was_changed_looks_the_same(folder: Path, robot: Robot, change: str) -> None:
    changed = {
        "simplified": lambda: simplify(robot),
        "locked": lambda: lock_joints(robot, {"wrist": -0.6}),
        "with_load": lambda: with_load(robot, "hand", 2.0),
    }[change]()
    clouds = []
    for one in (robot, changed):
        q = START[: one.dof]
        frames = frames_along(FixedBase(one), q)
        parts = [
            part for part in appearance_of(one, [folder / "share"]).parts if part.color != appearance.SURFACE_STYLE.rod
        ]
        points = [part.vertices @ frames.rotations[part.link][0].T + frames.positions[part.link][0] for part in parts]
        clouds.append(np.unique(np.vstack(points).round(4), axis=0))
    np.testing.assert_allclose(clouds[0], clouds[1], atol=2e-4)


@pytest.mark.parametrize(
    ("shape", "extent", "normal"),
    [
        (VisualShape("sphere", (0.2,)), (0.4, 0.4, 0.4), lambda p: p / 0.2),
        (VisualShape("capsule", (0.1, 0.6)), (0.2, 0.2, 0.8), lambda p: (p - [0, 0, 1] * p.clip(-0.3, 0.3)) / 0.1),
        (VisualShape("box", (0.2, 0.4, 0.6)), (0.2, 0.4, 0.6), None),
        (VisualShape("cylinder", (0.1, 0.6)), (0.2, 0.2, 0.6), None),
    ],
)
def test_simple_shapes_are_closed_and_their_normals_point_out(shape: VisualShape, extent: Any, normal: Any) -> None:
    (part,) = appearance_of(Robot((Link("a", visuals=(shape,)),))).parts
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), extent, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, atol=1e-9)
    corners = part.vertices[part.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    np.testing.assert_allclose(areas.sum(axis=0), 0, atol=1e-9)  # closed
    volume = np.einsum("fi,fi->", corners[:, 0], areas) / 3
    whole = {"sphere": 4 / 3 * np.pi * 0.008, "capsule": np.pi * 0.01 * (0.6 + 0.4 / 3), "box": 0.048}
    assert volume == pytest.approx(whole.get(shape.kind, np.pi * 0.01 * 0.6), rel=0.03)
    for k in range(3):
        assert (np.einsum("fi,fi->f", part.normals[part.faces[:, k]], areas) > 0).all()
    if normal is not None:
        np.testing.assert_allclose(part.normals, normal(part.vertices), atol=0.05)
    else:  # sharp edges: every normal along z, or across it
        upright = np.abs(part.normals[:, 2])
        assert (np.minimum(upright, 1 - upright) < 1e-9).all()


def test_meshes_of_many_faces_become_coarse_and_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(appearance, "SURFACE_STYLE", replace(appearance.SURFACE_STYLE, sides=200))
    robot = Robot((Link("a", visuals=(VisualShape("sphere", (0.2,)),)),))
    (fine,) = appearance_of(robot).parts
    (coarse,) = appearance_of(robot, most=4000).parts
    assert 500 < len(coarse.faces) <= 4000 < len(fine.faces)
    np.testing.assert_allclose(np.linalg.norm(coarse.vertices, axis=1), 0.2, atol=0.01)


def test_targets_are_given_in_world(robot: Robot, tmp_path: Path) -> None:
    """In the axes of a link that moves, of some coordinates alone, from the beginning of the task to its end."""
    machine = FixedBase(robot, (0.1, -0.2, 0.7), TURN)
    times, joints = np.linspace(0.0, 2.0, 21), START + np.linspace(0.0, 0.3, 21)[:, None]
    tasks = [
        TipTask(position=lambda t: ca.vertcat(t, 0.5, 0.0), direction=(0, 0, -2), begin=0.5, duration=1.0),
        TipTask(position=(0.1, 0.2, 0.3), orientation=(1.0, 0, 0, 0), link="hand", relative_to="upper/arm"),
        TipTask(rows=(3, 4), velocity=(0.1, 0.0)),
    ]
    first, second = targets_along(machine, tasks, times, base=np.zeros((21, 0)), joints=joints)
    inside = (times >= 0.5) & (times <= 1.5)
    assert np.isnan(first.position[~inside]).all()
    np.testing.assert_allclose(
        first.position[inside], np.column_stack([times - 0.5, 0 * times + 0.5, 0 * times])[inside]
    )
    np.testing.assert_allclose(first.rotation[inside][:, :, 2], np.tile([0, 0, -1.0], (inside.sum(), 1)))
    frames = frames_along(machine, joints)
    turn, place = frames.rotations["upper/arm"], frames.positions["upper/arm"]
    np.testing.assert_allclose(second.position, turn @ [0.1, 0.2, 0.3] + place, atol=1e-12)
    np.testing.assert_allclose(second.rotation, turn, atol=1e-12)
    result = planned(machine).with_targets(tasks[:2])
    result.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    for one, other in zip(result.targets, again.targets, strict=True):
        for part, stored in zip(one, other, strict=True):
            np.testing.assert_array_equal(part, stored)
    report, _ = unpack_page(build_page([animate_plan(again)]).text)
    assert len(report["motions"][0]["targets"]) == 2
    looks = [[(s.kind, s.file) for link in m.robot.links for s in link.visuals] for m in (machine, again.machine)]
    assert looks[0] == looks[1] != []


def curves_of(shown: Any) -> dict[tuple[str, str], Curve]:
    return {(curve.group, curve.name): curve for curve in shown.curves}


def test_costs_end_at_that_of_the_plan_and_torques_do_the_work_that_energy_shows(plans: dict[str, Plan]) -> None:
    plan = plans["fixed"]
    shown = animate_plan(plan)
    result = curves_of(shown)
    assert {group for group, _ in result} >= GROUPS | {"Torques"}
    assert result["Cost", "integral of half the squared joint velocities"].values[-1] == pytest.approx(
        plan.cost, rel=1e-4
    )
    assert ("Cost", "the problem's own cost, integrated") not in result  # the same
    assert result["Joints", "shoulder"].upper == 3.0
    assert result["Joints", "elbow"].upper == np.inf
    robot, q = plan.machine.robot, ca.SX.sym("q", 3)
    v = ca.SX.sym("v", 3)
    frame = plan.machine.world_from_base(())
    heights = [
        link.mass * 9.81 * c[2] for link, c in zip(robot.links, centers_of_mass(robot, q, frame).values(), strict=True)
    ]
    energy = ca.Function("energy", [q, v], [ca.mtimes([v.T, mass_matrix(robot, q), v]) / 2 + sum(heights)])
    sample = plan.sampled(shown.t)
    values = np.array([float(energy(*each)) for each in zip(sample.joints, sample.rates, strict=True)])
    torques = np.column_stack([result["Torques", name].values for name in plan.names])
    power = (torques * sample.rates).sum(axis=1)
    work = np.sum(np.diff(shown.t) * (power[1:] + power[:-1]) / 2)
    assert work == pytest.approx(values[-1] - values[0], rel=2e-3)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_manipulability_of_planar_arms_is_that_of_what_they_control(count: int) -> None:
    """Of one link nothing; of two, l1 l2 |sin q2|; of three the same, since the last one turns the tip about itself."""
    lengths, t = [0.5, 0.4, 0.3, 0.2][:count], np.linspace(0.0, 1.0, 21)
    joints = np.column_stack([t - 1.0, 0.4 + t, -0.2 * t, 0.3 + t])[:, :count]
    samples = MotionSamples(t, joints, np.ones_like(joints), None, np.zeros((21, 0)), None)
    shown = {
        curve.name: curve.values for curve in machine_curves(FixedBase(planar_chain(lengths, [1.0] * count)), samples)
    }
    indices = {name: values for name, values in shown.items() if "manipulability" in name}
    assert list(indices) == [[], ["manipulability of the position"], *[["manipulability of the pose"]] * 2][count - 1]
    if count in (2, 3):
        (values,) = indices.values()
        np.testing.assert_allclose(values, 0.2 * np.abs(np.sin(joints[:, 1])), atol=1e-12)
    for values in indices.values():
        assert values.min() > 0.01


def test_the_momentum_of_the_whole_is_that_of_a_floating_plan(plans: dict[str, Plan]) -> None:
    result = curves_of(animate_plan(plans["floating"]))
    whole, own = (result["Momentum", f"momentum, {which}"].values for which in ("total", "of the joints alone"))
    assert own.max() > 0.1
    assert whole.max() < 1e-3 * own.max()


def test_the_nearest_bodies_are_those_of_the_plan_at_every_time(tmp_path: Path) -> None:
    machine = FixedBase(armoured_arm())
    start = np.array([0.1, 0.6, 0.1, 1.0, 0.1, 0.8, 0.0])
    clearance_constraints = ClearanceConstraints(CollisionScene(machine, [Sphere(0.05, (0.9, 0.4, 0.2))]))
    problem = minimum_velocity_problem(
        machine,
        TipTask(rows=(3, 4, 5), velocity=(0.0, 0.1, 0.0)),
        1.0,
        start=start,
        setup=VelocitySetup(clearance_constraints=clearance_constraints),
    )
    plan = SolvedPlan(machine, solve(problem, Collocation(intervals=6, degree=3)), (Part(0.0, 1.0, ""),))
    near = animate_plan(plan).closest
    assert near is not None
    joints = plan.at(near.t)["joints"]
    apart = distances_along(clearance_constraints.scene, np.zeros((len(near.t), 0)), joints, near.t)
    np.testing.assert_allclose(near.distances, apart.min(axis=1), atol=1e-9)
    best = apart.argmin(axis=1)
    labels = clearance_constraints.scene.labels
    assert [tuple(labels[k]) for k in best] == [tuple(pair) for pair in near.bodies]
    report, arrays = unpack_page(build_page([animate_plan(plan)]).text)
    assert len(report["motions"][0]["around"]) == 1  # the ball
    ball = report["motions"][0]["around"][0]
    corners = np.array(ball["low"]) + np.array(ball["step"]) * arrays[ball["vertices"]["at"]][:, :3]
    np.testing.assert_allclose(np.linalg.norm(corners - [0.9, 0.4, 0.2], axis=1), 0.05, atol=1e-4)


def test_obstacles_that_move_are_shown_where_they_are_at_every_time_and_half_spaces_as_planes() -> None:
    machine = FixedBase(armoured_arm())
    start = np.array([0.1, 0.6, 0.1, 1.0, 0.1, 0.8, 0.0])

    def way(time: Any) -> Any:
        return ca.vertcat(0.9 - 0.1 * time, 0.5 + 0.2 * ca.sin(3 * time), 0.3)

    def turn(time: Any) -> Any:
        return ca.blockcat([[ca.cos(time), -ca.sin(time), 0], [ca.sin(time), ca.cos(time), 0], [0, 0, 1]])

    around: list[Any] = [
        MovingObstacle(Box((0.1, 0.2, 0.05), (0.02, 0, 0)), way, turn),
        HalfSpace((0.6, 0.0, 0.8), (0.0, 0.0, -1.5)),
    ]
    clearance_constraints = ClearanceConstraints(CollisionScene(machine, around))
    problem = minimum_velocity_problem(
        machine,
        TipTask(rows=(3, 4, 5), velocity=(0.0, 0.1, 0.0)),
        1.0,
        start=start,
        setup=VelocitySetup(clearance_constraints=clearance_constraints),
    )
    plan = SolvedPlan(machine, solve(problem, Collocation(intervals=6, degree=3)), (Part(0.0, 1.0, ""),))
    shown = animate_plan(plan)
    plane, moved = shown.obstacles
    assert plane.normal is not None
    assert moved.rotations is not None
    assert moved.positions is not None
    np.testing.assert_allclose(moved.positions, [np.array(way(t)).ravel() for t in shown.t], atol=1e-12)
    np.testing.assert_allclose(moved.rotations, [np.array(turn(t)) for t in shown.t], atol=1e-12)
    corners, _ = plane.solid(np.random.default_rng(0).normal(size=(20, 3)))
    np.testing.assert_allclose((corners - [0.0, 0.0, -1.5]) @ [0.6, 0.0, 0.8], 0.0, atol=1e-12)
    report, arrays = unpack_page(build_page([shown]).text)
    motion = report["motions"][0]
    still, box = motion["around"]
    assert still["mover"] is None
    t, poses = arrays[motion["t"]["at"]], arrays[motion["poses"]["at"]]
    np.testing.assert_allclose(poses[:, box["mover"], :3], [np.array(way(float(one))).ravel() for one in t], atol=1e-6)
    np.testing.assert_allclose(poses[:, box["mover"], 3:] @ [0, 1, 1, 0], 0.0, atol=1e-6)  # it turns about z alone
    np.testing.assert_allclose(2 * np.arctan2(poses[:, box["mover"], 6], poses[:, box["mover"], 3]), t, atol=1e-6)
    np.testing.assert_allclose(poses[:, -1, :3], plan.sampled(t.astype(float)).tip[:, :3], atol=1e-6)  # the tip is last


def test_the_zero_moment_point_follows_from_the_rows_of_the_problem(robot: Robot) -> None:
    """Which know of forces from outside, up to a margin; without rows, and at rest, it is below the centre of mass."""
    machine = Standing(robot, support=rectangle((-0.5, 0.9), (-0.4, 0.6)))
    joints, still = np.tile(START, (5, 1)), np.zeros((5, 3))
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 2))
    offsets = (machine.support.normals * machine.support.vertices).sum(axis=1)
    rows = points @ machine.support.normals.T - offsets - 0.02
    inside = [Curve("zero moment point", str(k), "m", row, 0.0) for k, row in enumerate(rows.T)]
    samples = MotionSamples(np.arange(5.0), joints, still, still, np.zeros((5, 0)), None)
    result, (margin,) = ground_contact(machine, samples, inside)
    np.testing.assert_allclose(result.points, points, atol=1e-12)
    np.testing.assert_allclose(margin.values, rows.min(axis=1) + 0.02, atol=1e-12)
    assert result.forces
    rest, _ = ground_contact(machine, samples)
    centers = centers_of_mass(robot, ca.DM(START))
    weighed = np.array([robot.link(name).mass * np.array(ca.DM(c)).ravel() for name, c in centers.items()])
    middle = weighed.sum(axis=0) / robot.total_mass
    np.testing.assert_allclose(rest.points, np.tile(middle[:2], (5, 1)), atol=1e-9)
    assert not rest.forces


def test_solutions_and_files_are_shown_as_plans_are(
    plans: dict[str, Plan], machines: dict[str, Machine], tmp_path: Path
) -> None:
    for kind, plan in plans.items():
        machine = machines[kind]
        wanted = animate_plan(plan)
        plan.solution.save(tmp_path / "solution.npz")
        plan.write_csv(tmp_path / "motion.csv", 0.01)
        raw = read_trajectory(tmp_path / "motion.csv", joints=plan.names)
        shown = [animate_solution(Solution.load(tmp_path / "solution.npz"), machine), animate_trajectory(raw, machine)]
        for one in shown:
            np.testing.assert_allclose(one.t, wanted.t, atol=1e-12)
            np.testing.assert_allclose(one.joints, wanted.joints, atol=1e-4)
            np.testing.assert_allclose(one.base, wanted.base, atol=1e-4)
        assert wanted.verdict.startswith(shown[0].verdict.rstrip("."))
        assert shown[0].passed is wanted.passed is True
        assert shown[1].passed is None
        report, _ = unpack_page(build_page([wanted, *shown], title="three").text)
        assert len(report["robots"]) == 1  # the same robot is held once
        assert [motion["robot"] for motion in report["motions"]] == [0, 0, 0]
    with pytest.raises(ProblemError, match="elbows"):
        animate_solution(plans["fixed"].solution, machines["fixed"], joints="elbows")
    with pytest.raises(ProblemError, match="base"):
        animate_solution(plans["fixed"].solution, machines["floating"])


def test_a_page_is_whole_small_the_same_again_and_asks_nobody(plans: dict[str, Plan], folder: Path) -> None:
    shown = [animate_plan(plans["fixed"], "<b>one</b> & 'two'"), animate_plan(plans["floating"])]
    text = build_page(shown, folders=[folder / "share"]).text
    assert text == build_page(shown, folders=[folder / "share"]).text
    assert len(text.encode()) < 300_000
    assert "default-src 'none'" in text
    assert set(re.findall(r"https?://[^\s\"'<)]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert not re.findall(r"\b(?:src|href)=(?!\"data:)", text)
    assert "<title>&lt;b&gt;one" in text
    assert "<b>one</b>" not in text
    report, arrays = unpack_page(text)
    assert report["motions"][0]["name"] == "<b>one</b> & 'two'"
    assert all(np.isfinite(values).all() for values in arrays.values() if values.dtype.kind == "f")
    assert {name for name, _ in surfaces(report, arrays)} == {"hull", "upper/arm", "fore", "hand", "finger"}
    rows = report["motions"][0]["rows"]
    assert {row[5] for row in rows} <= {"ok", "info"}


def test_a_workpiece_stands_where_its_file_has_it(plans: dict[str, Plan], tmp_path: Path) -> None:
    file = tmp_path / "part.obj"
    file.write_text("v 0.1 0 0\nv 0.5 0 0.2\nv 0.5 0.3 0.2\nf 1 2 3\n")
    shown = [animate_plan(plans["fixed"], "one"), animate_plan(plans["fixed"], "two")]
    report, arrays = unpack_page(build_page(shown, workpiece=read_mesh(file)).text)
    for motion in report["motions"]:
        (part,) = motion["around"]
        corners = part["low"] + arrays[part["vertices"]["at"]][:, :3] * np.array(part["step"])
        assert part["mover"] is None
        np.testing.assert_allclose(np.unique(corners, axis=0), [[0.1, 0, 0], [0.5, 0, 0.2], [0.5, 0.3, 0.2]], atol=1e-5)


def test_rows_near_their_limits_come_first_and_the_others_are_folded(plans: dict[str, Plan]) -> None:
    values = {"far": 0.1, "near": 0.95, "failed": 1.4, **{f"row {k}": 0.2 for k in range(8)}}
    rows = [Row(name, v, 1.0, "m", None, RowVerdict.of(v > 1)) for name, v in values.items()]
    rows.append(Row("clearance", 0.011, 0.01, "m", None, RowVerdict.OK))  # a least value, ten per cent above its limit
    rows.append(Row("unknown", 0.0, 1.0, "m", None, RowVerdict.UNDECIDED))
    report = report_of_plan(plans["fixed"], 0.1, "a plan")
    text = replace(report, tables=(("Values", tuple(rows)),)).html()
    names = re.findall(r"<tr><td>([\w ]+)</td>", text)
    assert set(names) == {row.name for row in rows}
    assert names[:4] == ["failed", "unknown", "near", "clearance"]
    assert names[-1] == "far"
    assert len(re.findall(r"<tr><td>", text.partition("<details>")[0])) == SHOWN_ROWS
    urgencies = [row.urgency for row in animate_plan(plans["fixed"], "played").rows]
    assert urgencies == sorted(urgencies, reverse=True)
    assert len(urgencies) > 5


def test_a_page_that_is_too_large_is_not_written(plans: dict[str, Plan], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ocp.app.view.player.PAGE_SETTINGS", replace(PAGE_SETTINGS, most_bytes=10_000))
    with pytest.raises(ProblemError, match="MB"):
        build_page([animate_plan(plans["fixed"])])
    with pytest.raises(ProblemError, match="at least one"):
        build_page([])


def test_a_page_is_served_on_this_machine_as_long_as_it_lasts() -> None:
    with PageServer("<p>ä</p>") as served, PageServer("b", int(served.address.rpartition(":")[2])) as other:
        assert served.address.startswith("http://127.0.0.1:")
        assert served.address != other.address  # the next port that is free
        with urllib.request.urlopen(served.address, timeout=20) as answer:
            assert answer.read().decode() == "<p>ä</p>"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{served.address}/favicon.ico", timeout=20)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(served.address, timeout=20)
    with pytest.raises(ProblemError, match="65535"):
        PageServer("", 70000)


def test_the_command_writes_a_page_or_serves_it(
    plans: dict[str, Plan], folder: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans["fixed"].save(tmp_path / "plan.npz")
    plans["fixed"].write_csv(tmp_path / "same.csv", 0.01)
    plans["fixed"].solution.save(tmp_path / "bare.npz")
    words = [str(tmp_path / name) for name in ("plan.npz", "same.csv")]
    target = tmp_path / "out.html"
    more = ["--page", str(target), "--name", "optimum", "--folder", str(folder / "share"), "--json"]
    assert main(["view", *words, *more]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["passed"] is True
    assert data["bytes"] == target.stat().st_size
    assert [one["name"] for one in unpack_page(target.read_text(encoding="utf-8"))[0]["motions"]] == [
        "optimum",
        "same.csv",
    ]
    again = ["view", str(tmp_path / "bare.npz"), "--robot", str(folder / "arm.urdf"), "--tip", "finger"]
    assert main([*again, "--lock", "grip=0.05", "--page", str(target), "--quiet", "--no-meshes"]) == 0
    assert "no better motion is near it" in capsys.readouterr().out
    assert main(["view", str(tmp_path / "bare.npz"), "--page", str(target)]) == 2
    assert "no plan" in capsys.readouterr().err
    assert main([*again, "--page", str(target), "--quiet"]) == 2  # the plan does not move the grip
    assert "grip" in capsys.readouterr().err
    loose = ["--tolerance", "rates=1e-30"]
    assert main(["view", words[0], "--page", str(target), "--quiet", *loose]) in (0, 1)
    monkeypatch.setattr(
        player.PageServer, "wait", lambda self: urllib.request.urlopen(self.address, timeout=20).close()
    )
    assert main(["view", words[0], "--port", "0"]) == 0
    shown = capsys.readouterr()
    assert "http://127.0.0.1:" in shown.err
    assert "package://arm_description/upper.obj is not shown: " in shown.err


def test_shapes_that_are_no_look_are_refused() -> None:
    crate = CollisionShape("box", (1, 1, 1))
    with pytest.raises(Exception, match="visuals"):
        Link("a", visuals=(crate,))  # type: ignore[arg-type]
