"""The gallery's plans: audited, on their paths by another library's kinematics, cheaper than the pseudo-inverse."""

from __future__ import annotations

import json
import signal
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest
from PIL import Image

from models import FixedBase, FreeFloating, with_wheels
from models.checks import Array
from models.paths import rest_to_rest
from ocp import AccelerationOptions, Plan, Solution, SolveError, resolve_accelerations
from ocp.app.files import read_trajectory
from ocp.app.view.appearance import TIP_FRAME, Frames, frames_along
from scripts import gallery
from scripts.robots import (
    capture,
    capture_family,
    panda,
    pick_and_place,
    posture_set,
    pushing,
    reconfiguration,
    robots,
    steps,
    talos,
    ur5,
)
from scripts.robots.drawing import Scene, animate
from scripts.robots.examples import run
from scripts.robots.results import turning_angle
from tests.ocp.motion.builders.captures import replayed_momentum
from tests.ocp.motion.builders.test_capture import gaps

pytestmark = [pytest.mark.xdist_group("gallery"), pytest.mark.long]

NAMES = ["space_arm", "panda", "ur5", "posture_set", "mobile_manipulator", "pushing"]
LOCAL = ["space_arm", "panda", "ur5", "posture_set"]
"""Those that are compared with the pseudo-inverse by cost."""


@dataclass(frozen=True)
class Gallery:
    """What a run of coarse meshes wrote."""

    folder: Path
    rows: dict[str, Any]
    failed: dict[str, str]

    def plan(self, name: str) -> Solution:
        return Solution.load(self.folder / f"{name}.npz")


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Gallery:
    folder = tmp_path_factory.mktemp("gallery")
    rows, failed = run(NAMES, folder, coarse=True)
    return Gallery(folder, rows, failed)


@pytest.mark.parametrize("name", NAMES)
def test_every_plan_passes_its_audit(coarse: Gallery, name: str) -> None:
    assert not coarse.failed
    assert coarse.rows[name]["audit_passed"]
    assert "passed" in (coarse.folder / f"{name}.audit.txt").read_text(encoding="utf-8").splitlines()[0]


@pytest.mark.parametrize("name", LOCAL)
def test_every_plan_keeps_its_tip_on_the_path_and_beats_the_pseudo_inverse(coarse: Gallery, name: str) -> None:
    row = coarse.rows[name]
    assert row["tip_error"] <= 1e-6
    assert row["cost_optimal"] < row["cost_local"]


def test_the_momentum_of_the_space_arm_stays_zero_and_its_base_turns_less(coarse: Gallery) -> None:
    row = coarse.rows["space_arm"]
    assert row["momentum_drift_relative"] <= 1e-9
    assert 0 < row["base_turn_optimal_deg"] < row["base_turn_local_deg"]


def test_the_cyclic_plan_returns_within_the_limits_where_the_pseudo_inverse_drifts(coarse: Gallery) -> None:
    row, plan = coarse.rows["panda"], coarse.plan("panda")
    robot = robots.PANDA.read()
    assert np.abs(plan["joints"][-1] - plan["joints"][0]).max() <= 1e-8
    assert row["joint_return_rad"] <= 1e-8
    assert ((plan["joints"] >= robot.lower) & (plan["joints"] <= robot.upper)).all()
    drift = np.array(row["drift_by_lap_local_rad"])
    assert (np.diff(drift) > 0.1).all()


def test_a_motion_from_the_best_conditioned_start_costs_more_than_the_plan(coarse: Gallery) -> None:
    row = coarse.rows["posture_set"]
    assert 0.98 * row["cost_optimal"] <= row["bound"] <= row["cost_optimal"]
    assert row["cost_optimal"] < 0.9 * row["cost_from_the_best_conditioned_start"]
    machine, task = FixedBase(robots.UR5.read()), posture_set.seam()
    charts, through, family = posture_set.landscape(machine, task, 9, row["cost_optimal"])
    assert through.min() <= row["cost_optimal"]  # on any instants
    plan = coarse.plan("posture_set")
    times = np.linspace(0.0, plan.horizon, 9)
    homes = []
    for k, joints in enumerate(plan.at(times)["joints"]):
        own = np.flatnonzero(charts.layer == k)
        far = np.abs(np.angle(np.exp(1j * (charts.centers[own] - joints)))).max(axis=1)
        assert far.min() < 0.05  # it runs through the postures that were found
        homes.append(family[own[far.argmin()]])
    assert len(set(homes)) == 1


def test_no_configuration_of_the_ring_connects_its_start_and_end(tmp_path: Path) -> None:
    example = reconfiguration.plan(coarse=True)
    result, reached = example.segmented, example.reached
    assert all(audit.feasible for audit in example.audits)
    assert all(segment.audit().passed for segment in result.segments)
    assert (len(result.reconfigurations), result.fewest) == (1, 1)
    assert not (reached.from_the_beginning & reached.to_the_end).any()
    (change,) = result.reconfigurations
    for own, apart in ((reached.from_the_beginning, result.segments[0]), (reached.to_the_end, result.segments[1])):
        begin = 0.0 if apart is result.segments[0] else change.time
        for k in np.flatnonzero((reached.times >= begin) & (reached.times <= begin + apart.horizon)):
            charts = reached.charts.centers[own & (reached.charts.layer == k)]
            far = np.abs(charts - apart.at(reached.times[k] - begin)["joints"]).max(axis=1)
            assert far.min() < 0.07  # each piece runs through its own postures
    machine, joints = example.machine, np.concatenate([segment["joints"] for segment in result.segments])
    times = np.concatenate(
        [begin + segment.t for begin, segment in zip(result.start_times, result.segments, strict=True)]
    )
    rotations, places = placed(robots.PANDA, joints, machine.robot.tip_link)
    angle = np.pi * (2 * rest_to_rest(times / reconfiguration.DURATION) - 1)
    radius = reconfiguration.RADIUS
    path = np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(len(times), reconfiguration.HEIGHT)]
    )
    np.testing.assert_allclose(places, path, atol=1e-6)
    np.testing.assert_allclose(rotations, np.broadcast_to(reconfiguration.DOWN, rotations.shape), atol=1e-6)
    reconfiguration.draw(example, tmp_path, animation=False)
    assert (tmp_path / "reconfiguration.png").stat().st_size > 1e4


def test_the_standing_robot_stands_where_instantaneous_resolution_tips_it(coarse: Gallery) -> None:
    row = coarse.rows["mobile_manipulator"]
    assert row["zmp_margin_local_m"] < 0 < row["zmp_margin_optimal_m"]
    assert row["tip_error"] < 1e-3  # the hand's path is a constraint on accelerations there


def test_the_pushing_robot_stands_where_instantaneous_resolution_tips_it(coarse: Gallery) -> None:
    row = coarse.rows["pushing"]
    assert row["zmp_margin_local_m"] < 0
    assert row["zmp_margin_optimal_m"] > 0.99 * pushing.MARGIN
    assert row["tip_error"] < 1e-5
    assert not row["audit_tolerances"]


def test_the_load_on_the_pushing_hand_is_the_reaction_of_its_force() -> None:
    machine, _ = pushing.anymal()
    (wrench,) = pushing.reaction(machine)(ca.DM(0.0), ca.DM.zeros(3))
    np.testing.assert_array_equal(np.array(ca.DM(wrench.force)).ravel() + pushing.PUSH, 0.0)
    # by hand: pushing to its right presses its left feet
    task, options = pushing.task(machine), AccelerationOptions(stop_at_lift_off=False)
    pressed, free = (
        resolve_accelerations(
            machine, task, pushing.SECONDS, start=pushing.START, wrenches=wrenches, step=1e-2, options=options
        ).motion
        for wrenches in (pushing.reaction(machine), ())
    )
    aside = pressed.zero_moment_point[0, 1] - free.zero_moment_point[0, 1]
    lever = -pushing.PUSH[1] * pressed.tip_in_world[0, 2]
    assert aside == pytest.approx(lever / machine.weight)


def placed(file: robots.RobotFile, joints: Array, frame: str) -> tuple[Array, Array]:
    """Rotations and positions of a frame by Pinocchio; joints that the plan does not move stand at zero."""
    model = pinocchio.buildModelFromUrdf(str(file.path))
    data, robot = model.createData(), file.read()
    results = []
    for row in joints:
        q = pinocchio.neutral(model)
        for name, value in zip(robot.joint_names, row, strict=True):
            q[model.joints[model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, q)
        pose = data.oMf[model.getFrameId(frame)]
        results.append((pose.rotation.copy(), pose.translation.copy()))
    return np.array([turn for turn, _ in results]), np.array([place for _, place in results])


def test_the_panda_goes_round_its_circle_by_another_librarys_kinematics(coarse: Gallery) -> None:
    plan = coarse.plan("panda")
    t = np.linspace(0.0, plan.horizon, 61)
    turn, place = placed(robots.PANDA, plan.at(t)["joints"], "panda_hand_tcp")
    angle = 2 * np.pi * t / panda.LAP
    x, y, z = panda.CENTER
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    np.testing.assert_allclose(place, [x, y, z] + panda.RADIUS * ring, atol=1e-6)
    lean = (panda.TILT * ring - [0, 0, 1]) / np.hypot(1, panda.TILT)
    np.testing.assert_allclose(turn[:, :, 2], lean, atol=1e-6)


def test_the_tool_of_the_ur5_stands_on_the_panel_by_another_librarys_kinematics(coarse: Gallery) -> None:
    plan = coarse.plan("ur5")
    turn, place = placed(robots.UR5, plan.at(np.linspace(0.0, plan.horizon, 61))["joints"], "tool0")
    options = robots.UR5.options
    tip = place + turn @ np.array(options["tip_translation"])
    axis = turn @ np.array(options["tip_rotation"])[:, 2]
    center = np.stack([tip[:, 0], 0 * tip[:, 1], 0 * tip[:, 2] + ur5.CENTER[1] - ur5.CURVE], axis=1)
    out = tip - center
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), ur5.CURVE, atol=1e-6)
    np.testing.assert_allclose(axis, -out / ur5.CURVE, atol=1e-6)
    # the whole field: every lane from edge to edge
    half = ur5.LENGTH / 2
    np.testing.assert_allclose([tip[:, 1].min(), tip[:, 1].max()], [-half, half], atol=0.02)
    np.testing.assert_allclose(tip[-1, 0] - tip[0, 0], ur5.WIDTH, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_every_plan_can_be_played_from_its_file_alone(coarse: Gallery, name: str) -> None:
    loaded = Plan.load(coarse.folder / f"{name}.npz")
    at = loaded.at(np.linspace(0.0, loaded.horizon, 5))
    frames = frames_along(loaded.machine, at["joints"], at.get("base"))
    assert np.isfinite(frames.tip).all()
    assert len(frames.positions) == len(loaded.machine.robot.links) + 1
    for target in loaded.targets:
        done = loaded.sampled(target.t).tip[:, :3]
        np.testing.assert_allclose(done, np.where(np.isnan(target.position), done, target.position), atol=2e-3)
    local = read_trajectory(coarse.folder / f"{name}.local.csv", joints=loaded.names)
    assert local.names == loaded.names
    assert (coarse.folder / f"{name}.npz").stat().st_size < 400_000
    with Image.open(coarse.folder / f"{name}.png") as picture:
        assert min(picture.size) > 500


def test_the_biped_walks_in_balance_and_faster_without(tmp_path: Path) -> None:
    rows, failed = run(["steps"], tmp_path, coarse=True)
    row = rows["steps"]
    assert not failed
    assert row["audit_passed"]
    assert row["com_margin_optimal_m"] < 0 < row["com_margin_static_m"]
    assert row["zmp_margin_optimal_m"] > 0.99 * steps.MARGIN
    with Image.open(tmp_path / "steps.png") as picture:
        assert min(picture.size) > 500


def test_talos_walks_in_balance_and_faster_without(tmp_path: Path) -> None:
    rows, failed = run(["talos"], tmp_path, coarse=True)
    row = rows["talos"]
    assert not failed
    assert row["audit_feasible"]
    assert row["duration_s"] < row["duration_static_s"] / 2
    assert row["com_margin_optimal_m"] < 0 < row["com_margin_static_m"]
    assert row["zmp_margin_optimal_m"] > 0.99 * talos.KINDS["dynamic walk"]["margin"]
    assert row["peak_torque_share"] <= 1 + 1e-6
    with Image.open(tmp_path / "talos.png") as picture:
        assert min(picture.size) > 500


def test_the_load_that_is_known_stays_within_the_torques_of_another_library(tmp_path: Path) -> None:
    """Pinocchio's torques, the load added to the hand where it is carried; more than there is where it is not known."""
    example = pick_and_place.plan()
    assert all(audit.passed for audit in example.audits.values())
    model = pinocchio.buildModelFromUrdf(str(robots.PANDA.path))
    hand = model.frames[model.getFrameId("panda_hand_tcp")]
    x, y, z = pick_and_place.SIZE
    block = pinocchio.Inertia.FromBox(pick_and_place.LOAD, x, y, z)
    full = model.copy()
    full.inertias[hand.parentJoint] += hand.placement.act(block)
    for name, motion in example.motions.items():
        result = np.zeros_like(motion.torques)
        for k in range(len(motion.t)):
            q = pinocchio.neutral(model)
            q[7:] = 0.02
            q[:7] = motion.joints[k]
            rates, second = (
                np.concatenate([part[k], [0.0, 0.0]]) for part in (motion.velocities, motion.accelerations)
            )
            one = full if motion.in_hand[k] else model
            result[k] = pinocchio.rnea(one, one.createData(), q, rates, second)[:7]
        np.testing.assert_allclose(motion.torques, result, atol=1e-8)
        most = (np.abs(result) / robots.PANDA.read().effort).max()
        assert most < 1 + 1e-6 if name == "planned with the load" else most > 1.01
    pick_and_place.draw(example, tmp_path, animation=False)
    with Image.open(tmp_path / "pick_and_place.png") as picture:
        assert min(picture.size) > 500


def test_a_tumbling_body_is_caught_and_its_momentum_stays_in_another_simulation() -> None:
    """MuJoCo's momentum of both, before and after the grasp; its wheels have a mass, of 1e-9 kg."""
    example = capture.plan(coarse=True)
    assert example.audit.passed
    bodies = {"chaser": example.chaser, "target": example.capture.target}
    assert max(gaps(bodies, example.plan)) < 1e-6
    rotors: dict[str, Any] = {"momentum": capture.MOMENTUM, "torque": capture.TORQUE, "mass": 1e-9}
    weighed = FreeFloating(with_wheels(robots.SPACE_ARM.read(), np.eye(3), capture.WHEEL, **rotors))
    before, after = replayed_momentum(bodies | {"chaser": weighed}, example.plan)
    assert np.abs(np.vstack([before, after]) - before[0]).max() < 1e-9
    assert np.linalg.norm(before[0, :3]) == pytest.approx(example.summary()["target_momentum_Nms"], rel=1e-9)
    assert np.abs(example.plan.phase("detumble")["velocities"][-1, :7]).max() < 1e-9
    assert np.abs(example.wheels("detumble")).max() <= capture.MOMENTUM * (1 + 1e-6)


def test_a_chain_of_two_plans_costs_more_where_a_wheel_takes_the_momentum() -> None:
    result = capture_family.planned(0.1, "wheel")
    assert result.passed
    assert result.chain == pytest.approx(result.approach + result.detumble)
    assert result.together < 0.95 * result.chain


def test_the_summary_holds_every_example(coarse: Gallery) -> None:
    summary = json.loads((coarse.folder / "summary.json").read_text(encoding="utf-8"))
    assert list(summary) == NAMES
    assert not any("seconds" in key and key != "duration_s" for row in summary.values() for key in row)
    assert not list(coarse.folder.glob(".*"))


def test_roll_is_the_angle_about_the_tools_own_axis() -> None:
    robot = robots.UR5.read()
    pose = frames_along(FixedBase(robot), np.tile([0.3, -1.4, 1.6, -1.5, -1.2, 0.4], (2, 1)))
    angle = 0.7
    cosine, sine = np.cos(angle), np.sin(angle)
    about_z = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    turned = pose.rotations[TIP_FRAME].copy()
    turned[1] = turned[1] @ about_z
    result = ur5.roll(Frames({TIP_FRAME: turned}, {}))
    assert result[1] - result[0] == pytest.approx(angle)


def test_the_turn_of_a_base_is_its_angle_whatever_the_sign_of_its_quaternion() -> None:
    half = np.deg2rad(25.0)
    quaternion = np.array([np.cos(half), 0.0, np.sin(half), 0.0])
    poses = np.concatenate([np.zeros((2, 3)), [quaternion, -quaternion]], axis=1)
    np.testing.assert_allclose(np.degrees(turning_angle(poses)), 50.0)


def test_an_animation_moves_from_its_first_picture_to_its_last(tmp_path: Path) -> None:
    robot = robots.SPACE_ARM.read()
    joints = np.linspace(0.0, 1.0, 11)[:, None] * np.ones(7)
    base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (11, 1))
    scene = Scene("turn", robot, frames_along(FreeFloating(robot), joints, base), np.linspace(0, 1, 11), "blue")
    animate(tmp_path / "turn.gif", [scene], frames=4, seconds=0.1, note="note")
    with Image.open(tmp_path / "turn.gif") as film:
        assert film.n_frames == 4  # type: ignore[attr-defined]
        first = np.asarray(film.convert("RGB")).copy()
        film.seek(3)
        assert np.any(np.asarray(film.convert("RGB")) != first)


def test_without_the_robots_the_package_to_install_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(name: str) -> Any:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(robots, "distribution", absent)
    assert gallery.main(["--out", str(tmp_path), "--only", "space_arm", "panda"]) == 1
    assert "pip install spartpy example-robot-data" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_interruption_ends_it_with_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(coarse: bool = False) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(panda, "plan", interrupted)
    assert gallery.main(["--out", str(tmp_path), "--only", "panda"]) == 130
    assert "stopped" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.*"))


def test_an_interruption_that_a_solver_keeps_to_itself_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def keeps(coarse: bool = False) -> Any:
        before = signal.signal(signal.SIGINT, lambda *_: None)  # as ocp does while IPOPT runs
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.signal(signal.SIGINT, before)
        raise SolveError("interrupted")

    monkeypatch.setattr(panda, "plan", keeps)
    assert gallery.main(["--out", str(tmp_path), "--only", "panda", "ur5"]) == 130
    assert "stopped" in capsys.readouterr().err


def test_failures_are_reported_and_do_not_stop_the_rest(
    coarse: Gallery, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(coarse: bool = False) -> Any:
        raise SolveError("no way round")

    monkeypatch.setattr(panda, "plan", fails)
    monkeypatch.setattr(ur5, "plan", fails)
    folder = tmp_path / "gallery"
    folder.mkdir()
    (folder / "summary.json").write_text(json.dumps({"space_arm": {"dof": 7}, "gone": {}}), encoding="utf-8")
    assert gallery.main(["--out", str(tmp_path), "--only", "panda", "ur5"]) == 1
    shown = capsys.readouterr().err
    assert "panda: no way round" in shown
    assert "ur5: no way round" in shown


def test_the_raster_starts_and_ends_at_rest() -> None:
    time = ca.SX.sym("time")
    track = ur5.raster().position
    assert track is not None
    position = track(time)
    speed = ca.Function("speed", [time], [ca.jacobian(position, time)])
    for end in (0.0, ur5.DURATION):
        np.testing.assert_allclose(np.array(speed(end)), 0.0, atol=1e-12)
