"""A plan in the browser: every frame where the model has it, whatever the plan's file leaves open said or refused."""

from __future__ import annotations

import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
import trimesh

from models import FixedBase, FreeFloating, Machine, ModelError, Robot, Sphere, Surroundings, link_frames
from models.arrays import Array
from models.shapes.mesh_files import find_mesh
from ocp import Clear, Collocation, ProblemError, Solution, minimum_velocity_problem, solve
from ocp.local.touching import distances_along
from scripts import view
from scripts.robots.frames import TIP, frames_along, inertia_box
from scripts.viewer.command import parser, read
from scripts.viewer.meshes import read_shapes
from scripts.viewer.plan import Played, play, read_record, save_plan
from scripts.viewer.scene import View
from tests.models.machines.armoured import armoured_arm

pytestmark = pytest.mark.xdist_group("view")

Factory = Callable[..., View]

MACHINE = """<robot name="arm">
  <material name="red"><color rgba="1 0 0 0.5"/></material>
  <link name="hull"><inertial><mass value="20"/><inertia ixx="2" iyy="3" izz="4" ixy="0.1" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.1" rpy="0 0 1"/><geometry><box size="1 0.4 0.2"/></geometry></visual></link>
  <link name="upper/arm"><inertial><origin xyz="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://arm_description/meshes/upper.stl" scale="2 1 1"/></geometry>
      <material name="red"/></visual></link>
  <link name="fore"><inertial><origin xyz="0.25 0 0"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.05" length="0.5"/></geometry></visual></link>
  <link name="hand"><inertial><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
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
OPTIONS: dict[str, Any] = {"tip": "finger", "lock": {"grip": 0.05}, "tip_translation": [0.02, 0.0, 0.01]}
MOUNT: dict[str, Any] = {
    "translation": [0.1, -0.2, 0.7],
    "rotation": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
}
START = (0.4, 0.7, -0.6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """arm.urdf, fixed.npz, floating.npz of save_plan, bare.npz of Solution.save."""
    path = tmp_path_factory.mktemp("plans")
    (path / "arm.urdf").write_text(MACHINE, encoding="utf-8")
    robot = Robot.from_urdf(path / "arm.urdf", **OPTIONS)
    fixed, floating = (planned(machine) for machine in (FixedBase(robot, **MOUNT), FreeFloating(robot)))
    save_plan(path / "fixed.npz", fixed, robot, OPTIONS, **MOUNT)
    save_plan(path / "floating.npz", floating, robot, OPTIONS, base="base")
    floating.save(path / "bare.npz")
    return path


def planned(machine: Machine) -> Solution:
    problem = minimum_velocity_problem(machine, (0.1, -0.1), (3, 4), START, 1.5)
    return solve(problem, Collocation(intervals=6, degree=3))


@pytest.fixture
def show() -> Iterator[Factory]:
    """Makes views and stops their servers."""
    made: list[View] = []

    def factory(played: Played, **settings: Any) -> View:
        made.append(View(played, **settings))
        return made[-1]

    yield factory
    for each in made:
        each.stop()


def matrix(wxyz: Any) -> Array:
    w, x, y, z = np.asarray(wxyz, dtype=float)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def assert_frames(shown: View, machine: Machine, base: Any, joints: Any) -> None:
    """Of all links and of the tip, against the model."""
    for name, frame in link_frames(machine.robot, ca.DM(joints), machine.world_from_base(ca.DM(base))).items():
        np.testing.assert_allclose(shown.links[name].position, np.array(ca.DM(frame.position)).ravel(), atol=1e-6)
        np.testing.assert_allclose(matrix(shown.links[name].wxyz), np.array(ca.DM(frame.rotation)), atol=1e-6)
    tip = machine.tip_pose(base, joints)
    np.testing.assert_allclose(shown.links[TIP].position, np.array(ca.DM(tip.position)).ravel(), atol=1e-6)
    np.testing.assert_allclose(matrix(shown.links[TIP].wxyz), np.array(ca.DM(tip.rotation)), atol=1e-6)


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_every_frame_stands_where_the_model_has_it_at_every_time(folder: Path, show: Factory, kind: str) -> None:
    played = play(folder / f"{kind}.npz", folder / "arm.urdf")
    machine: Machine = FreeFloating(played.robot) if kind == "floating" else FixedBase(played.robot, **MOUNT)
    shown = show(played)
    for now in (0.0, 0.377, 1.5, 0.9):
        shown.time = now
        at = played.solution.at(now)
        assert shown.time == pytest.approx(now)
        assert_frames(shown, machine, at["base"] if kind == "floating" else (), at["joints"])


def test_the_two_bodies_that_are_nearest_are_joined(tmp_path: Path, show: Factory) -> None:
    robot = armoured_arm()
    machine = FixedBase(robot)
    robot.to_urdf(tmp_path / "arm.urdf")
    start = np.array([0.1, 0.6, 0.1, 1.0, 0.1, 0.8, 0.0])
    clear = Clear(Surroundings(machine, [Sphere(0.05, (0.9, 0.4, 0.2))]))
    problem = minimum_velocity_problem(machine, (0.0, 0.1, 0.0), (3, 4, 5), start, 1.0, clear=clear)
    solution = solve(problem, Collocation(intervals=6, degree=3))
    save_plan(tmp_path / "plan.npz", solution, robot, {"tip": robot.tip_link})
    played = play(tmp_path / "plan.npz", tmp_path / "arm.urdf")
    shown = show(played)
    for now in (0.0, 0.7):
        shown.time = now
        near = played.nearest(now)
        assert near is not None
        apart = distances_along(clear.surroundings, np.zeros(0), solution.at(now)["joints"][None], np.array([now]))
        assert near.distance == pytest.approx(apart.min(), abs=1e-9)
        np.testing.assert_allclose(shown._nearest.points[0], near.points, atol=1e-6)
        assert near.bodies[0] in shown._apart.content


def test_a_plan_that_knows_of_no_bodies_joins_none(folder: Path, show: Factory) -> None:
    assert show(play(folder / "fixed.npz", folder / "arm.urdf"))._nearest is None


def test_the_slider_alone_moves_the_robot(folder: Path, show: Factory) -> None:
    """As a browser's does: through the callback of the slider, on a thread of the server."""
    played = play(folder / "floating.npz", folder / "arm.urdf")
    shown = show(played)
    shown.slider.value = 1.0
    wanted = played.frames(1.0).positions["hand"][0]
    end = time.monotonic() + 20
    while np.abs(shown.links["hand"].position - wanted).max() > 1e-6 and time.monotonic() < end:
        time.sleep(0.01)
    at = played.solution.at(1.0)
    assert_frames(shown, FreeFloating(played.robot), at["base"], at["joints"])


def test_the_server_answers_on_this_machine_only(folder: Path, show: Factory) -> None:
    shown = show(play(folder / "fixed.npz", folder / "arm.urdf"))
    assert shown.server.get_host() == "127.0.0.1"
    with urllib.request.urlopen(shown.address, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()


def test_playing_goes_on_at_its_speed_and_repeats_or_stops_at_the_end(folder: Path, show: Factory) -> None:
    shown = show(play(folder / "fixed.npz", folder / "arm.urdf"))
    shown.advance(0.3)
    assert shown.time == 0.0  # not playing
    shown.play.value, shown.speed.value = True, "2"
    shown.advance(0.3)
    assert shown.time == pytest.approx(0.6)
    shown.advance(10.0)
    assert shown.time == pytest.approx(1.5)
    assert shown.play.value
    shown.advance(0.1)
    assert shown.time == 0.0
    shown.repeat.value = False
    shown.advance(10.0)
    assert shown.time == pytest.approx(1.5)
    assert not shown.play.value


def test_joints_are_matched_by_name_whatever_their_order_in_the_plan(folder: Path, tmp_path: Path) -> None:
    solution = Solution.load(folder / "floating.npz")
    order = [2, 0, 1]
    curve = solution.state_interpolant
    shuffled = replace(
        solution,
        states={"base": solution["base"], "joints": solution["joints"][:, order]},
        state_interpolant=replace(curve, values=curve.values[:, :, [*range(7), *(7 + i for i in order)]]),
    )
    shuffled.save(tmp_path / "plan.npz")
    names = ["wrist", "shoulder", "elbow"]
    found = play(tmp_path / "plan.npz", folder / "arm.urdf", options=OPTIONS, joint_names=names).frames([0.2, 1.1])
    wanted = play(folder / "floating.npz", folder / "arm.urdf").frames([0.2, 1.1])
    for name, positions in wanted.positions.items():
        np.testing.assert_allclose(found.positions[name], positions, atol=1e-12)


def test_a_saved_plan_with_its_robot_is_still_a_solution(folder: Path) -> None:
    solution = Solution.load(folder / "fixed.npz")
    robot = Robot.from_urdf(folder / "arm.urdf", **OPTIONS)
    problem = minimum_velocity_problem(FixedBase(robot, **MOUNT), (0.1, -0.1), (3, 4), START, 1.5)
    assert solution.audit(problem)["integration error, relative"].passed
    assert read_record(folder / "fixed.npz")["joint_names"] == ["shoulder", "elbow", "wrist"]
    assert read_record(folder / "bare.npz") == {}


def test_a_bare_plan_plays_when_told_how_to_read_the_robot(folder: Path) -> None:
    words = [str(folder / "bare.npz"), str(folder / "arm.urdf"), "--tip", "finger", "--lock", "grip=0.05"]
    found = read(parser(None).parse_args(words))
    wanted = play(folder / "floating.npz", folder / "arm.urdf")
    assert found.base == "base"
    np.testing.assert_allclose(
        found.frames(0.7).positions["finger"], wanted.frames(0.7).positions["finger"], atol=1e-12
    )


def test_a_mount_given_stands_in_for_the_one_recorded(folder: Path) -> None:
    words = [str(folder / "fixed.npz"), str(folder / "arm.urdf"), "--mount", "1", "2", "3", "0", "0", "0.5"]
    hull = read(parser(None).parse_args(words)).frames(0.0)
    np.testing.assert_allclose(hull.positions["hull"][0], [1, 2, 3])
    np.testing.assert_allclose(hull.rotations["hull"][0][0], [np.cos(0.5), -np.sin(0.5), 0], atol=1e-12)


@pytest.mark.parametrize(
    ("plan", "settings", "words"),
    [
        ("bare", {}, "--lock"),
        ("bare", {"options": {"lock": {"gripp": 0.0}}}, "grip"),
        ("bare", {"options": OPTIONS, "joint_names": ["wrist", "shoulder"]}, "elbow"),
        ("bare", {"options": OPTIONS, "joint_names": ["wrist", "shoulder", "elbo", "elbow"]}, "elbo"),
        ("bare", {"options": OPTIONS, "joint_names": ["wrist", "wrist", "elbow"]}, "repeat"),
        ("bare", {"options": OPTIONS, "joints": "q"}, "base"),
        ("bare", {"options": OPTIONS, "base": "joints"}, "both"),
        ("bare", {"options": {"colour": 1}}, "colour"),
        ("fixed", {"options": {"lock": {"wrist": 0.0}}}, "wrist"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(folder: Path, plan: str, settings: Any, words: str) -> None:
    with pytest.raises((ProblemError, ModelError), match=words):
        play(folder / f"{plan}.npz", folder / "arm.urdf", **settings)


def test_a_plan_of_an_unnamed_robot_asks_for_its_file(folder: Path) -> None:
    with pytest.raises(ProblemError, match="URDF"):
        play(folder / "bare.npz")


def test_meshes_are_found_in_the_folders_given_and_missing_ones_leave_boxes_and_lines(
    folder: Path, tmp_path: Path, show: Factory
) -> None:
    urdf = folder / "arm.urdf"
    name = "package://arm_description/meshes/upper.stl"
    assert find_mesh(name, folder) is None
    bare = read_shapes(urdf)
    assert list(bare.missing) == [name]
    assert set(bare.by_link) == {"hull", "fore"}
    file = tmp_path / "share" / "arm_description" / "meshes" / "upper.stl"
    file.parent.mkdir(parents=True)
    trimesh.creation.box(extents=(0.2, 0.1, 0.1)).export(file)
    assert find_mesh(name, folder, [tmp_path / "share"]) == file
    assert find_mesh(name, folder, [tmp_path / "share" / "arm_description"]) == file
    assert find_mesh(file.as_uri(), folder) == file
    assert find_mesh("meshes/upper.stl", file.parents[1]) == file
    assert find_mesh(name, file.parents[1] / "urdf") == file  # beside the package's own URDF
    found = read_shapes(urdf, [tmp_path / "share"])
    assert not found.missing
    np.testing.assert_allclose(found.by_link["upper/arm"][0].mesh.extents, [0.4, 0.1, 0.1])  # scaled
    assert found.by_link["upper/arm"][0].color == (1.0, 0.0, 0.0, 0.5)
    np.testing.assert_allclose(found.by_link["hull"][0].mesh.center_mass, [0, 0, 0.1], atol=1e-12)
    for settings in ({}, {"mesh_dirs": [tmp_path / "share"]}, {"meshes": False}):
        shown = show(play(folder / "fixed.npz", urdf), **settings)
        assert (len(shown.missing) == 1) == (not settings)


def test_a_file_that_yourdfpy_cannot_read_is_shown_in_lines(tmp_path: Path) -> None:
    (tmp_path / "broken.urdf").write_text("<robot", encoding="utf-8")
    assert list(read_shapes(tmp_path / "broken.urdf").missing) == [str(tmp_path / "broken.urdf")]


def test_the_box_of_a_link_has_its_inertia(folder: Path) -> None:
    robot = Robot.from_urdf(folder / "arm.urdf", **OPTIONS)
    found = inertia_box(robot, "hull")
    assert found is not None
    size, axes, _ = found
    moments = 20 / 12 * (np.sum(size**2) - size**2)
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, robot.link("hull").inertia, atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert inertia_box(robot, "finger") is None


def test_a_planar_base_turns_about_z(folder: Path) -> None:
    robot = Robot.from_urdf(folder / "arm.urdf", **OPTIONS)
    found = frames_along(robot, [START], [[1.0, 2.0, 0.3]])
    flat = FixedBase(robot, (1.0, 2.0, 0.0), [[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    np.testing.assert_allclose(found.tip[0], np.array(ca.DM(flat.tip_pose((), START).position)).ravel(), atol=1e-12)
    with pytest.raises(ModelError, match="4"):
        frames_along(robot, [START], [[1.0, 2.0, 0.3, 0.0]])


def test_the_command_serves_until_it_is_interrupted(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = iter([0.0, 0.0])

    def sleep(_: float) -> None:
        if next(pictures, None) is None:
            raise KeyboardInterrupt

    monkeypatch.setattr("scripts.view.sleep", sleep)
    assert view.main([str(folder / "fixed.npz"), str(folder / "arm.urdf"), "--port", "0"]) == 0
    shown = capsys.readouterr()
    assert "http://127.0.0.1:" in shown.out
    assert "upper.stl" in shown.err


def test_the_command_says_what_is_wrong(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "no.npz").write_bytes(b"no plan")
    for words in (
        [str(tmp_path / "none.npz"), str(folder / "arm.urdf")],
        [str(tmp_path / "no.npz"), str(folder / "arm.urdf")],
        [str(folder / "fixed.npz"), str(tmp_path / "none.urdf")],
    ):
        assert view.main(words) == 1
        assert capsys.readouterr().err.startswith("view: ")
    with pytest.raises(SystemExit):
        view.main([str(folder / "fixed.npz"), str(folder / "arm.urdf"), "--lock", "grip"])
    assert "NAME=VALUE" in capsys.readouterr().err
    monkeypatch.setattr(view, "NEEDED", ("viser", "no_such_module"))
    assert view.main([str(folder / "fixed.npz")]) == 1
    assert "selfmotion[view]" in capsys.readouterr().err
