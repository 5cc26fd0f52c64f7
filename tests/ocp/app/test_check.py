"""Planted faults are found by name and time; what has none is not accused; nothing between samples is passed over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Robot, Sphere, inverse_dynamics
from ocp import Plan
from ocp.app import Check, Fault, check_trajectory
from ocp.app.files import read_trajectory, read_waypoints
from ocp.errors import ProblemError
from ocp.motion.result.plan import ENDS
from tests.ocp.app.motions import MIDDLE, NAMES, SWING, TURNS, URDF, check_motion, smooth, write_table

AT = 1.7


def checked(folder: Path, t: Any, q: Any, v: Any = None, a: Any = None, **options: Any) -> Check:
    names = options.pop("names", NAMES)
    file = write_table(folder / "motion.csv", t, q, v, a, names=names)
    robot = Robot.from_urdf(URDF, tip="finger")
    return check_motion(robot, read_trajectory(file, joints=robot.joint_names), **options)


def the(check: Check, kind: str, name: str) -> Fault:
    """The one fault of a kind and a name."""
    matches = [fault for fault in check.faults if fault.kind == kind and fault.name == name]
    assert len(matches) == 1, check
    return matches[0]


def near(fault: Fault, time: float, within: float = 0.02) -> None:
    assert fault.time is not None
    assert abs(fault.time - time) <= within, fault


# ---- twelve planted faults -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_rates", [1, 2, 3])
def test_a_sound_motion_is_not_accused(tmp_path: Path, with_rates: int) -> None:
    t, *values = smooth()
    check = checked(tmp_path, t, *values[:with_rates], acceleration=8.0, jerk=40.0)
    assert check.passed, check
    assert check.rule == ("linear", "cubic", "quintic")[with_rates - 1]
    assert {row.verdict for row in check.rows if row.name != ENDS} == {"ok"}


@pytest.mark.parametrize("with_rates", [1, 2, 3])
@pytest.mark.parametrize(("turns", "text"), [(2.0, "at rest"), (1.5, "at rest"), (1.75, "ends at"), (-1.75, "starts")])
def test_whether_a_motion_starts_and_ends_at_rest_is_a_row_and_part_of_the_verdict(
    tmp_path: Path, with_rates: int, turns: float, text: str
) -> None:
    """A cosine is at rest after whole and half turns; backwards in time its end is its start."""
    t, sign = np.linspace(0.0, 4.0, 401), np.sign(turns)
    rate = 2 * np.pi * abs(turns) / 4
    phase = rate * t[:: int(sign), None]
    swing = 0.5 * SWING
    values = MIDDLE - swing * np.cos(phase), sign * swing * rate * np.sin(phase), swing * rate**2 * np.cos(phase)
    check = checked(tmp_path, t, *values[:with_rates])
    assert check.passed
    row = next(row for row in check.rows if row.name == ENDS)
    assert row.note.startswith(text)
    assert row.verdict == ("ok" if text == "at rest" else "info")
    assert (text in check.sentence) == (text != "at rest")
    assert row.value == pytest.approx(swing.max() * rate if text != "at rest" else 0.0, rel=1e-3)
    if text != "at rest":
        assert row.time == (4.0 if sign > 0 else 0.0)


def test_a_position_limit_passed_between_two_samples(tmp_path: Path) -> None:
    # from 1.95 at 2 rad/s to 1.95 at -2 rad/s in 0.2 s: 2.05 in the middle, where the limit is 2
    t = np.array([0.0, 1.0, 1.2, 2.2])
    q, v = np.zeros((4, 4)), np.zeros((4, 4))
    q[:, 0], v[:, 0] = [0.95, 1.95, 1.95, 0.95], [0.0, 2.0, -2.0, 0.0]
    check = checked(tmp_path, t, q, v)
    fault = the(check, "position", "shoulder")
    assert fault.time == pytest.approx(1.1)
    assert fault.value == pytest.approx(1.95 + 2.0 * 0.2 / 4)
    assert "between two samples" in fault.text


def test_a_jump(tmp_path: Path) -> None:
    t, q, *_ = smooth()
    q[t >= AT, 2] += 0.02
    fault = the(checked(tmp_path, t, q), "jump", "wrist")
    near(fault, AT, 0.011)
    assert fault.value == pytest.approx(0.02, abs=0.01)


def test_one_wrong_sample_is_a_jump_there_and_back(tmp_path: Path) -> None:
    t, q, v, _ = smooth()
    q[170, 1] += 0.3
    fault = the(checked(tmp_path, t, q, v), "jump", "elbow")
    near(fault, t[170], 0.011)
    assert "2 such steps" in fault.text


@pytest.mark.parametrize(("column", "factor", "words"), [(0, 180 / np.pi, "degrees"), (3, 1000.0, "millimetres")])
def test_wrong_units(tmp_path: Path, column: int, factor: float, words: str) -> None:
    t, q, v, a = smooth()
    columns = [0, 1, 2] if column == 0 else [3]
    for values in (q, v, a):
        values[:, columns] *= factor
    check = checked(tmp_path, t, q, v, a)
    fault = next(fault for fault in check.faults)
    assert fault.kind == "units"
    assert words in fault.text
    assert [fault.kind for fault in check.faults] == ["units"], "converted, the motion is sound"
    assert fault.time is not None
    k = int(np.abs(t - fault.time).argmin())
    assert fault.value == pytest.approx(q[k, NAMES.index(fault.name)])


def test_velocities_in_degrees_and_times_in_milliseconds(tmp_path: Path) -> None:
    t, q, v, _ = smooth()
    wrong = v.copy()
    wrong[:, 1] *= 180 / np.pi
    assert "degrees per second" in the(checked(tmp_path, t, q, wrong), "units", "elbow").text
    check = checked(tmp_path, 1000 * t, q, v)
    assert "milliseconds" in the(check, "units", "time").text
    assert len(check.faults) == 1
    assert check.duration == pytest.approx(4.0)


def test_a_value_that_is_no_number(tmp_path: Path) -> None:
    t, q, v, _ = smooth()
    q[170, 1] = np.nan
    v[300, 2] = np.inf
    check = checked(tmp_path, t, q, v)
    near(the(check, "not a number", "elbow"), t[170], 0.0)
    near(the(check, "not a number", "wrist"), t[300], 0.0)
    assert the(check, "not a number", "elbow").line == 172
    assert len(check.faults) == 2
    assert any("2 of 401" in note for note in check.notes)


def test_times_that_go_back_and_times_that_repeat(tmp_path: Path) -> None:
    t, q, *_ = smooth()
    t[[170, 171]] = t[[171, 170]]
    q[[170, 171]] = q[[171, 170]]
    check = checked(tmp_path, t, q)
    (fault,) = check.faults
    assert fault.kind == "times"
    near(fault, 1.7, 1e-9)
    assert fault.line == 173
    t, q, *_ = smooth()
    twice = np.insert(t, 100, t[100]), np.insert(q, 100, q[100], axis=0)
    (fault,) = checked(tmp_path, *twice).faults
    assert "repeated" in fault.text
    near(fault, 1.0, 1e-9)


def test_a_joint_that_is_missing_and_one_that_nobody_has(tmp_path: Path) -> None:
    t, q, *_ = smooth()
    check = checked(tmp_path, t, q, names=("shoulder", "elbow", "wrst", "slide"))
    assert {(fault.kind, fault.name) for fault in check.faults} == {
        ("unknown joint", "wrst"),
        ("missing joint", "wrist"),
    }
    assert "is it wrist?" in the(check, "unknown joint", "wrst").text
    assert any("clearance" in one for one in check.unchecked)


def test_a_collision_between_two_samples(tmp_path: Path) -> None:
    t, q, v, a = smooth(41)  # 0.1 s apart
    robot = Robot.from_urdf(URDF, tip="finger")
    middle = (t[17] + t[18]) / 2
    arm = FixedBase(robot)
    exact = MIDDLE + SWING * np.sin(TURNS * middle)
    tip = np.array(arm.tip_pose((), exact).position, dtype=float).ravel()
    turn = np.array(arm.tip_pose((), exact).rotation, dtype=float)
    ball = Sphere(radius=1e-3, position=tip + turn @ [0.1, 0.0, 0.0] + 0.4e-3 * turn[:, 0])
    check = checked(tmp_path, t, q, v, a, obstacles=[ball])
    fault = the(check, "clearance", "finger and obstacle 0")
    assert t[17] < (fault.time or 0.0) < t[18]
    assert "between two samples" in fault.text
    assert {one.kind for one in check.faults} == {"clearance"}


def test_the_arm_in_itself(tmp_path: Path) -> None:
    t = np.linspace(0.0, 4.0, 201)
    q = np.zeros((201, 4))
    q[:, 1] = 3.09 * np.sin(np.pi * t / 4) ** 2
    check = checked(tmp_path, t, q)
    names = {fault.name for fault in check.faults if fault.kind == "clearance"}
    assert names & {"upper and hand", "upper and finger"}, check
    colliding = next(fault for fault in check.faults if fault.kind == "clearance")
    assert colliding.first is not None
    assert 1.5 < colliding.first < (colliding.time or 0.0) < 2.5
    assert checked(tmp_path, t, q, ignored=[("upper", "hand"), ("upper", "finger")]).passed


def test_collisions_are_checked_beyond_the_joint_limits(tmp_path: Path) -> None:
    t = np.linspace(0.0, 2.0, 101)
    q = np.zeros((101, 4))
    q[:, 3] = 0.6 * t / 2
    wall = Sphere(radius=0.05, position=(1.75, 0.0, 0.0))
    check = checked(tmp_path, t, q, obstacles=[wall])
    assert {fault.kind for fault in check.faults} == {"position", "clearance"}
    fault = the(check, "clearance", "finger and obstacle 0")
    assert fault.first == pytest.approx((1.75 - 0.05 - 1.2) / 0.6 * 2, abs=0.03)
    endless = URDF.replace('lower="0" upper="0.3" velocity="0.5"', 'lower="-inf" upper="inf" velocity="0.5"')
    robot = Robot.from_urdf(endless, tip="finger")
    raw = read_trajectory(tmp_path / "motion.csv", joints=robot.joint_names)
    free = check_motion(robot, raw, obstacles=[wall])
    assert {fault.kind for fault in free.faults} == {"clearance"}


def test_a_tip_off_its_path(tmp_path: Path) -> None:
    t, q, v, a = smooth()
    robot = Robot.from_urdf(URDF, tip="finger")
    arm = FixedBase(robot)
    joints = ca.SX.sym("q", 4)
    tips = np.array(ca.Function("tip", [joints], [arm.tip_pose((), joints).position])(q.T)).T
    file = tmp_path / "path.csv"
    file.write_text("x,y,z\n" + "\n".join(",".join(map(repr, row)) for row in tips.tolist()))
    path = read_waypoints(file)
    sound = checked(tmp_path, t, q, v, a, path=path)
    assert sound.passed, sound
    bump = 0.01 * np.exp(-(((t - AT) / 0.1) ** 2))
    q[:, 3] += bump
    v[:, 3] += bump * -2 * (t - AT) / 0.1**2
    check = checked(tmp_path, t, q, v, path=path)
    fault = the(check, "path", "finger")
    near(fault, AT, 0.06)
    assert 0.003 < (fault.value or 0.0) <= 0.0101
    short = checked(tmp_path, t[:200], q[:200], v[:200], path=path)
    assert any(fault.name.startswith("waypoint") for fault in short.faults)


def test_a_tool_that_leans_from_the_axes_of_its_path(tmp_path: Path) -> None:
    t, q, v, a = smooth()
    arm = FixedBase(Robot.from_urdf(URDF, tip="finger"))
    joints = ca.SX.sym("q", 4)
    pose = arm.tip_pose((), joints)
    function = ca.Function("tip", [joints], [ca.vertcat(pose.position, pose.rotation[:, 2])])
    rows = np.array(function(q.T)).T
    lean = 0.1 * np.exp(-(((t - AT) / 0.2) ** 2))  # of the axis that the file tells, about the level axis across it
    across = np.cross(rows[:, 3:], [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    rows[:, 3:] = np.cos(lean)[:, None] * rows[:, 3:] + np.sin(lean)[:, None] * np.cross(across, rows[:, 3:])
    (tmp_path / "path.csv").write_text(
        "x,y,z,ax,ay,az\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    )
    path = read_waypoints(tmp_path / "path.csv")
    assert checked(tmp_path, t, q, v, a, path=path, tip_angle=0.11).passed
    fault = the(checked(tmp_path, t, q, v, a, path=path, tip_angle=0.05), "path", "finger")
    near(fault, AT)
    assert fault.value == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("with_rates", [1, 2, 3])
@pytest.mark.parametrize(("what", "order"), [("velocity", 1), ("acceleration", 2), ("jerk", 3)])
def test_a_bump_beyond_a_limit(tmp_path: Path, what: str, order: int, with_rates: int) -> None:
    """A Gaussian bump has its greatest derivatives at known places, and the limit lies between it and all else."""
    t, q, v, a = smooth(1601)
    width, height = 0.08, 0.01
    s = (t - AT) / width
    bump = height * np.exp(-(s**2))
    parts = [bump, -2 * s / width * bump, (4 * s**2 - 2) / width**2 * bump, (12 * s - 8 * s**3) / width**3 * bump]
    limit = 0.9 * np.abs(parts[order]).max()
    calm = {name: limit for name in NAMES if name != "elbow"}
    for values, part in zip((q, v, a), parts, strict=False):
        values[:, 1] = 0.8 + part if values is q else part
    check = checked(tmp_path, t, *(q, v, a)[:with_rates], **{what: {"elbow": limit, **dict.fromkeys(calm, np.inf)}})
    fault = the(check, what, "elbow")
    peak = t[np.abs(np.abs(parts[order]) - np.abs(parts[order]).max()) < 2e-2 * limit]
    assert np.abs(peak - (fault.time or 0.0)).min() < 0.01
    assert abs(fault.value or 0.0) == pytest.approx(limit / 0.9, rel=2e-2)
    assert fault.limit == pytest.approx(np.copysign(limit, fault.value or 0.0))
    assert [one.kind for one in check.faults] == [what]


def test_the_interpolation_rule_of_the_controller_counts(tmp_path: Path) -> None:
    """Accelerations that jump in the middle between two samples: a quintic makes 16 % more, the motion has no more."""
    h, most = 0.1, 2.0
    t = h * (np.arange(21) - 0.5)
    q, v, a = np.zeros((21, 4)), np.zeros((21, 4)), np.zeros((21, 4))
    ahead, turn = np.minimum(t, 10 * h), np.maximum(t - 10 * h, 0.0)
    a[:, 1] = np.where(t < 10 * h, most, -most)
    v[:, 1] = most * (ahead - turn)
    q[:, 1] = most * (ahead**2 / 2 + 10 * h * turn - turn**2 / 2)
    s = np.linspace(0.0, 1.0, 10001)
    fault = the(checked(tmp_path, t, q, v, a, acceleration=most, share=1e-2, rule="quintic"), "acceleration", "elbow")
    assert abs(fault.value or 0.0) == pytest.approx(most * ((1 - 2 * s) * (1 + 5 * s * (1 - s))).max(), rel=1e-6)
    near(fault, 10 * h, h / 2)
    assert checked(tmp_path, t, q, v, a, acceleration=most, share=1e-2, rule="linear").passed
    for values in ([q, v], [q, v, a]):
        check = checked(tmp_path, t, *values, acceleration=most)
        assert check.passed, check
        row = next(row for row in check.rows if row.name == "acceleration of elbow")
        assert row.value == pytest.approx(np.copysign(most, row.value), rel=1e-6)
        assert "not every motion through the samples" in row.note
    with pytest.raises(ProblemError, match="needs accelerations"):
        checked(tmp_path, t, q, v, rule="quintic")


def test_values_beyond_a_limit_within_the_tolerance_are_noted(tmp_path: Path) -> None:
    t, q, v, a = smooth()
    peak = float(np.abs(v[:, 1]).max())
    limit = {"elbow": peak / (1 + 5e-4)}
    check = checked(tmp_path, t, q, v, a, velocity=limit)
    assert check.passed
    row = next(row for row in check.rows if row.name == "velocity of elbow")
    assert (row.verdict, row.note) == ("ok", "beyond, by less than the 0.1 % allowed")
    the(checked(tmp_path, t, q, v, a, velocity=limit, share=0.0), "velocity", "elbow")
    assert checked(tmp_path, t, q, v, a, velocity={"elbow": peak * (1 + 1e-9)}, share=0.0).passed


@pytest.mark.parametrize("with_rates", [1, 2, 3])
def test_a_torque(tmp_path: Path, with_rates: int) -> None:
    t, *values = smooth()
    robot = Robot.from_urdf(URDF, tip="finger")
    symbols = [ca.SX.sym(name, 4) for name in "qva"]
    exact = np.array(
        ca.Function("torque", symbols, [inverse_dynamics(robot, *symbols)])(*(part.T for part in values))
    ).T
    limit = 0.95 * np.abs(exact[:, 0]).max()
    check = checked(tmp_path, t, *values[:with_rates], torque={"shoulder": limit})
    fault = the(check, "torque", "shoulder")
    near(fault, t[np.abs(exact[:, 0]).argmax()])
    assert abs(fault.value or 0.0) == pytest.approx(limit / 0.95, rel=1e-3)
    assert [one.kind for one in check.faults] == ["torque"]


# ---- plans of the gallery, exported and read back --------------------------------------------------------------------


GALLERY = Path(__file__).resolve().parents[3] / "results" / "gallery"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(file.stem, marks=pytest.mark.long if file.stem in ("mobile_manipulator", "pushing") else ())
        for file in sorted(GALLERY.glob("*.npz"))
    ],
)
def test_plans_of_the_gallery_are_not_accused(name: str, tmp_path: Path) -> None:
    plan = Plan.load(GALLERY / f"{name}.npz")
    robot, file = plan.machine.robot, tmp_path / "plan.csv"
    plan.write_csv(file)
    check = check_trajectory(plan.machine, read_trajectory(file, joints=robot.joint_names))
    assert check.passed, check
    assert check.faults == ()


@pytest.mark.parametrize("base", [FixedBase, FreeFloating])
def test_the_zero_of_the_clock_does_not_matter(tmp_path: Path, base: Any) -> None:
    t = np.linspace(0.0, 4.0, 41)
    q = MIDDLE + np.outer((t / 4) ** 5, SWING)  # each worst value occurs once
    q[:, 1] = 3.09 * (t / 4) ** 5  # the arm collides with itself
    machine = base(Robot.from_urdf(URDF, tip="finger"))
    here, later = (
        check_motion(machine, read_trajectory(write_table(tmp_path / "motion.csv", t + begin, q)), velocity=0.5)
        for begin in (0.0, 50.0)
    )
    assert {fault.kind for fault in here.faults} >= {"clearance", "velocity"}
    pairs: list[tuple[Any, Any]] = [(here.rows, later.rows), (here.faults, later.faults)]
    for first, second in pairs:
        assert [each.name for each in first] == [each.name for each in second]
        for old, new in zip(first, second, strict=True):
            assert (old.time is None) == (new.time is None)
            if old.time is not None and abs(old.value) > 1e-9:
                assert new.time == pytest.approx(old.time + 50.0, abs=1e-6)
            assert new.value == pytest.approx(old.value, rel=1e-6, abs=1e-9)
