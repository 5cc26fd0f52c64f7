"""Tasks of robot cells, from files to files: a seam, a raster, a rail, two arms; replayed by Pinocchio alone.

Pinocchio reads the robots again from their own files, and the joints from the CSV file that a controller would get.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest
from scipy.spatial import cKDTree

from models import CollisionShape, FixedBase, Link, Robot, attach_tool, merge_robots, mount_on_rail, smooth
from models import Path as Corners
from models.checks import Array
from ocp import Plan, TipTask, plan
from ocp.app.files import read_gcode, read_waypoints
from tests.models.robot.pinocchio_robots import DATA, urdf_file
from tests.ocp.motion.local.arms import IIWA_ROWS, iiwa

pytestmark = pytest.mark.long

UR10 = urdf_file(DATA, "ur_description/urdf/ur10_robot.urdf")
UR5 = urdf_file(DATA, "ur_description/urdf/ur5_robot.urdf")
PERIOD = 0.01  # s
ROUNDING = 1e-9  # m, of places that a task prescribes exactly


@dataclass(frozen=True)
class Replay:
    """Joints of a CSV file at its times (M,), by name, each of shape (M,)."""

    times: Array
    joints: dict[str, Array]

    @classmethod
    def of(cls, plan: Plan, file: Path) -> Replay:
        plan.write_csv(file, PERIOD)
        with file.open(encoding="utf-8") as stream:
            head, *rows = csv.reader(stream)
        columns = dict(zip(head, np.array(rows, dtype=float).T, strict=True))
        return cls(columns["time"], {name: columns[name] for name in plan.names})

    def tips(self, model: Any, frame: str, prefix: str = "", place: Any = (0, 0, 0)) -> tuple[Array, Array]:
        """Positions (M, 3) and rotations (M, 3, 3) of a frame of Pinocchio's model, whose base is at a place."""
        data, k = model.createData(), model.getFrameId(frame)
        positions, rotations = [], []
        for row in np.column_stack([self.joints[prefix + name] for name in list(model.names)[1:]]):
            pinocchio.framesForwardKinematics(model, data, row)
            positions.append(data.oMf[k].translation + place)
            rotations.append(data.oMf[k].rotation.copy())
        return np.array(positions), np.array(rotations)


def ur10_model() -> Any:
    return pinocchio.buildModelFromUrdf(str(UR10))


def ur10() -> Robot:
    return Robot.from_urdf(UR10, tip="tool0")


def angles(axes: Array, others: Array) -> Array:
    """Angles between unit vectors (M, 3), rad."""
    cosines = np.einsum("ij,ij->i", axes, others)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(axes, others), axis=1), cosines))


def deviation(points: Array, corners: Array) -> Array:
    """Distances of points (M, 3) from a polyline (N, 3), m. Shape (M,)."""
    first, along = corners[:-1], np.diff(corners, axis=0)
    share = np.einsum("mnj,nj->mn", points[:, None] - first, along) / np.einsum("nj,nj->n", along, along)
    feet = first + np.clip(share, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(points[:, None] - feet, axis=2).min(axis=1))


def assert_steady(places: Array, speed: float) -> None:
    """Assert a constant speed but for the ramps of the ends, and rest at both ends."""
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / PERIOD
    ramp = round(0.5 / PERIOD)
    np.testing.assert_allclose(speeds[ramp:-ramp], speed, rtol=2e-3)
    assert speeds[[0, -1]].max() < 0.05 * speed


def test_a_ur10_welds_a_seam_on_a_saddle_from_a_file_in_millimetres(tmp_path: Path) -> None:
    """200 poses of a torch normal to the surface z = (x^2 - y^2) / 0.8 about its centre, at 10 mm/s."""
    angle, tolerance, speed = np.linspace(0, 1.2 * np.pi, 200), 5e-4, 0.01
    x, y = 0.15 * np.cos(angle), 0.2 * np.sin(angle)
    points = np.column_stack([0.7 + x, y, 0.3 + (x**2 - y**2) / 0.8])
    normals = np.column_stack([-x / 0.4, y / 0.4, np.ones(200)])
    axes = -normals / np.linalg.norm(normals, axis=1)[:, None]
    table = np.column_stack([1000 * points, axes])
    np.savetxt(tmp_path / "seam.csv", table, "%.6f", ",", header="x [mm],y [mm],z [mm],ax,ay,az", comments="")

    path = read_waypoints(tmp_path / "seam.csv").smooth(tolerance)
    result = plan(FixedBase(ur10()), TipTask.along(path, speed))
    assert result.audit().passed

    replay = Replay.of(result, tmp_path / "plan.csv")
    places, rotations = replay.tips(ur10_model(), "tool0")
    assert deviation(places, points).max() < tolerance
    assert cKDTree(places).query(points)[0].max() < tolerance + speed * PERIOD
    nearest = cKDTree(places).query(points)[1]
    assert np.degrees(angles(rotations[nearest][:, :, 2], axes)).max() < 0.1
    assert_steady(places, speed)


def iiwa_model() -> Any:
    """Return the arm of the rows in Pinocchio."""
    model, joint, place = pinocchio.Model(), 0, pinocchio.SE3.Identity()
    for k, (a, alpha, d) in enumerate(IIWA_ROWS):
        joint = model.addJoint(joint, pinocchio.JointModelRZ(), place, f"joint{k}")
        turn = pinocchio.utils.rotate("x", alpha)
        place = pinocchio.SE3(np.eye(3), np.array([0, 0, d])) * pinocchio.SE3(turn, np.array([a, 0, 0]))
    model.addFrame(pinocchio.Frame("tip", joint, place, pinocchio.FrameType.OP_FRAME))
    return model


def test_an_iiwa_sands_a_curved_panel_in_five_lanes_within_a_cone(tmp_path: Path) -> None:
    """A cylinder about the y axis with the radius 0.8 m; the tool may lean by 10 degrees, its roll is free."""
    radius, tolerance, speed, cone = 0.8, 1e-3, 0.1, np.radians(10)
    across = np.linspace(-0.15, 0.15, 13)
    lanes = [np.column_stack([across[:: (-1) ** k], np.full(13, y)]) for k, y in enumerate(np.linspace(-0.1, 0.1, 5))]
    x, y = np.vstack(lanes).T
    height = np.sqrt(radius**2 - x**2)
    points = np.column_stack([0.65 + x, y, 0.2 - radius + height])
    axes = -np.column_stack([x, 0 * x, height]) / radius
    table = np.column_stack([1000 * points, axes])
    np.savetxt(tmp_path / "lanes.csv", table, "%.6f", ",", header="x [mm],y [mm],z [mm],ax,ay,az", comments="")

    path = read_waypoints(tmp_path / "lanes.csv").smooth(tolerance)
    result = plan(iiwa(), TipTask.along(path, speed, within=cone), search="start")
    assert result.audit().passed

    places, rotations = Replay.of(result, tmp_path / "plan.csv").tips(iiwa_model(), "tip")
    assert deviation(places, points).max() < tolerance
    ahead = places - [0.65, 0, 0.2 - radius]
    normals = np.column_stack([ahead[:, 0], 0 * ahead[:, 0], ahead[:, 2]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    lean = angles(rotations[:, :, 2], -normals)
    assert np.degrees(lean.max()) < 10.1
    assert lean.max() > 0.9 * cone  # the freedom is used


def test_a_ur10_on_a_rail_follows_a_line_of_four_metres(tmp_path: Path) -> None:
    """The rail has the length of the line, which is not beside it but in front of it and at a slant."""
    first, last, speed = np.array([0.6, -2.0, 0.4]), np.array([0.8, 2.0, 0.5]), 0.25
    robot = mount_on_rail(ur10(), (0, 1, 0), -2.0, 2.0, velocity=1.0)
    line = smooth(Corners.through([first, last]), deviation=0.001)
    result = plan(FixedBase(robot), TipTask.along(line, speed, direction=(0, 0, -1)))
    assert result.audit().passed

    replay = Replay.of(result, tmp_path / "plan.csv")
    rail = replay.joints["rail_joint"]
    assert np.abs(rail).max() <= 2.0 + ROUNDING
    places, rotations = replay.tips(ur10_model(), "tool0")
    places[:, 1] += rail
    assert deviation(places, np.array([first, last])).max() < 1e-6
    np.testing.assert_allclose(places[[0, -1]], [first, last], atol=1e-6)
    assert angles(rotations[:, :, 2], np.tile([0.0, 0, -1], (len(rail), 1))).max() < 1e-6
    assert_steady(places, speed)


def test_one_ur10_turns_a_part_and_another_welds_on_it(tmp_path: Path) -> None:
    """The part turns by 60 degrees about the vertical while the torch follows a line on its upper side."""
    places = {"left_": (0.0, 0.7, 0.0), "right_": (0.0, -0.7, 0.0)}
    block = CollisionShape("box", (0.2, 0.2, 0.04), translation=(0, 0, 0.05))
    holder = attach_tool(ur10(), Link("part", 2.0, collisions=(block,)))
    cell = merge_robots(Link("floor"), {"left_": holder, "right_": ur10()}, translations=places)
    first, last, centre = np.array([-0.05, 0.06, 0.12]), np.array([0.05, 0.06, 0.12]), np.array([0.6, 0.1, 0.4])
    seam = smooth(Corners.through([first, last]), deviation=0.001)
    weld: Any = TipTask.along(seam, 0.02, link="right_tool0", relative_to="left_part", direction=(0, 0, -1))

    def turn(t: Any) -> Any:
        share = t / weld.duration
        half = np.radians(30) * share**2 * (3 - 2 * share)
        return ca.vertcat(ca.cos(half), 0, 0, ca.sin(half))

    hold = TipTask(position=centre, orientation=turn, link="left_part", duration=weld.duration)
    result = plan(FixedBase(cell), [hold, weld])
    assert result.audit().passed

    replay = Replay.of(result, tmp_path / "plan.csv")
    part, axes = replay.tips(ur10_model(), "tool0", "left_", places["left_"])
    tool, tool_axes = replay.tips(ur10_model(), "tool0", "right_", places["right_"])
    assert np.abs(part - centre).max() < 1e-6
    share = replay.times / weld.duration
    angle = np.radians(60) * share**2 * (3 - 2 * share)
    expected = np.array([pinocchio.utils.rotate("z", float(a)) for a in angle])
    np.testing.assert_allclose(axes, expected, atol=1e-6)
    inside = np.einsum("mji,mj->mi", axes, tool - part)
    assert deviation(inside, np.array([first, last])).max() < 1e-6
    np.testing.assert_allclose(inside[[0, -1]], [first, last], atol=1e-6)
    assert (
        angles(np.einsum("mji,mj->mi", axes, tool_axes[:, :, 2]), np.tile([0.0, 0, -1], (len(share), 1))).max() < 1e-6
    )


def test_a_ur5_follows_a_program_of_2400_chords_at_constant_speed(tmp_path: Path) -> None:
    """A rosette of 0.9 m at 50 mm/s, within 0.02 mm, from file to file."""
    angle, tolerance, speed = np.linspace(0, 2 * np.pi, 2401), 2e-5, 0.05
    radius = 0.1 + 0.015 * np.cos(5 * angle)
    flat: Any = np.column_stack([0.45 + radius * np.cos(angle), radius * np.sin(angle), np.full(2401, 0.2)])
    points: Any = np.round(flat, 6)
    moves = [f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f}" for x, y, z in 1000 * points]
    (tmp_path / "rosette.nc").write_text("\n".join(["G21 G90 F3000", "G0 X565 Y0 Z200", *moves]))

    (path,) = read_gcode(tmp_path / "rosette.nc").smooth(tolerance)
    task = TipTask.along(path, speed, steady=True, direction=(0, 0, -1))
    result = plan(FixedBase(Robot.from_urdf(UR5, tip="tool0")), task, search="start")
    passed, replay = result.audit().passed, Replay.of(result, tmp_path / "plan.csv")
    assert passed

    places, rotations = replay.tips(pinocchio.buildModelFromUrdf(str(UR5)), "tool0")
    assert deviation(places, points).max() < tolerance + 1e-6  # a micrometre of the rounded numbers
    assert cKDTree(places).query(points)[0].max() < tolerance + speed * PERIOD
    assert angles(rotations[:, :, 2], np.tile([0.0, 0, -1], (len(places), 1))).max() < 1e-6
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1) / PERIOD
    np.testing.assert_allclose(chords[:-1], speed, rtol=2e-3)
