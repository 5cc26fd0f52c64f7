"""Times in another unit and exchanged columns are suspected, no sound file is; wrapped joints are told once."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Robot
from ocp.__main__ import main
from ocp.app import Check
from ocp.app.check.data_checks import exchanged_joints
from ocp.app.check.joint_limits import Motion
from ocp.app.files import RawTrajectory
from ocp.errors import ProblemError
from tests.ocp.app.motions import check_motion, write_table

HOME = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.4])
SWINGS = [6, 5, 6, 4, 5, 6]
"""rad/s of the sines that the joints go."""


def robot(name: str = "ur5_robot.urdf", tip: str = "tool0") -> Robot:
    result = next(file.locate() for file in files("example-robot-data") or () if file.name == name)
    return Robot.from_urdf(Path(str(result)), tip=tip)


@pytest.fixture(scope="module")
def ur5() -> Robot:
    return robot()


def checked(of: Robot, t: Any, *values: Any, **options: Any) -> Check:
    v = values[1] if len(values) > 1 else None
    lines = np.arange(1, len(t) + 1)
    raw = RawTrajectory(of.joint_names, np.asarray(t), values[0], v, None, None, lines, False, (), "motion")
    return check_motion(of, raw, scene=False, **options)


def swings(size: float = 0.8, step: float = 0.02, duration: float = 3.0) -> tuple[Any, Any, Any]:
    """Sines; with 0.8 rad up to 4.8 rad/s, where 3.15 are allowed."""
    t = np.arange(0.0, duration, step)
    return t, HOME + size * np.sin(np.outer(t, SWINGS)), size * np.array(SWINGS) * np.cos(np.outer(t, SWINGS))


# ---- times -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.8, 0.3, 0.02])
@pytest.mark.parametrize(
    ("factor", "unit", "words"),
    [(1e3, "ms", "milliseconds"), (50.0, 0.02, "sample numbers"), (1e6, "us", "microseconds"), (1e9, "ns", "nanosec")],
)
def test_times_in_another_unit_are_not_passed(ur5: Robot, size: float, factor: float, unit: Any, words: str) -> None:
    t, q, _ = swings(size)
    wrong = np.rint(factor * t)
    check = checked(ur5, wrong, q)
    assert not check.passed
    assert words in " ".join(one.text for one in (*check.suspicions, *check.faults) if one.name == "time")
    if check.suspicions:
        assert check.sentence.startswith("is undetermined: times look like")
        assert "--time-unit" in check.sentence
        assert check.to_dict()["passed"] is False
    truth = checked(ur5, t, q)
    report = checked(ur5, wrong, q, time_unit=unit)
    assert report.passed == truth.passed == (size < 0.8)
    assert report.suspicions == ()
    assert [one.kind for one in report.faults] == [one.kind for one in truth.faults]
    assert checked(ur5, wrong, q, time_unit="s").passed


def test_milliseconds_that_are_not_whole_are_suspected(ur5: Robot) -> None:
    t = np.linspace(0.0, 4.237, 301)
    check = checked(ur5, 1e3 * t, HOME + 0.3 * np.sin(np.outer(t, SWINGS)))
    assert ["milliseconds" in one.text for one in check.suspicions] == [True]
    assert check.faults == ()


def test_positions_in_degrees_hide_no_milliseconds(ur5: Robot) -> None:
    """The rest of the check takes them as degrees, and suspects what it suspects of radians."""
    t = np.linspace(0.0, 4.237, 301)
    q = HOME + 0.3 * np.sin(np.outer(t, SWINGS))
    in_radians, in_degrees = checked(ur5, 1e3 * t, q), checked(ur5, 1e3 * t, np.rad2deg(q))
    assert {(fault.kind, fault.name == "time") for fault in in_degrees.faults} == {("units", False)}
    assert [one.text for one in in_degrees.suspicions] == [one.text for one in in_radians.suspicions] != []


def test_a_unit_of_times_that_is_a_fault_is_no_suspicion_as_well(ur5: Robot) -> None:
    """Whole milliseconds, and a second apart as sample numbers are."""
    t = np.arange(100.0)
    check = checked(ur5, 1e3 * t, HOME + 0.8 * np.sin(0.1 * t)[:, None] * np.linspace(0.2, 1.0, 6))
    assert [(fault.kind, fault.name) for fault in check.faults] == [("units", "time")]
    assert check.suspicions == ()


def test_velocities_tell_the_unit_by_themselves(ur5: Robot) -> None:
    t, q, v = swings(0.3)
    check = checked(ur5, np.rint(1e3 * t), q, v)
    assert [(one.kind, one.name) for one in check.faults] == [("units", "time")]
    assert check.suspicions == ()


@pytest.mark.parametrize(
    ("step", "count", "speed"),
    [(1.0, 40, 0.05), (1.0, 400, 0.5), (0.02, 4000, 0.002), (20.0, 12, 0.03), (0.5, 100, 0.004), (10.0, 12, 0.0)],
)
def test_slow_motions_are_not_suspected(ur5: Robot, step: float, count: int, speed: float) -> None:
    t = step * np.arange(count)
    reach = speed * t[-1] / 6  # of sines whose greatest speed is that, rad
    q = HOME + min(reach, 1.0) * np.sin(speed / max(min(reach, 1.0), 1e-9) * t)[:, None] * np.linspace(0.2, 1.0, 6)
    assert checked(ur5, t, q).suspicions == ()


@pytest.mark.parametrize("unit", ["minutes", 0.0, -1.0, np.nan, True])
def test_units_that_are_none_are_refused(ur5: Robot, unit: Any) -> None:
    with pytest.raises(ProblemError) as caught:
        checked(ur5, *swings()[:2], time_unit=unit)
    assert caught.value.name == "time_unit"


def test_the_command_states_the_unit(ur5: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t, q, _ = swings(0.3)
    file = write_table(tmp_path / "motion.csv", np.rint(1e3 * t), q, names=ur5.joint_names)
    urdf = next(one.locate() for one in files("example-robot-data") or () if one.name == "ur5_robot.urdf")
    arguments = ["check", str(urdf), str(file), "--no-clearance", "--quiet"]
    assert main(arguments) == 1
    assert "The trajectory is undetermined: times look like milliseconds" in capsys.readouterr().out
    assert main([*arguments, "--time-unit", "ms"]) == 0
    assert main([*arguments, "--time-unit", "s"]) == 0
    assert main([*arguments, "--time-unit", "0.001"]) == 0
    assert main([*arguments, "--time-unit", "hours"]) == 2


# ---- exchanged joints ------------------------------------------------------------------------------------------------


def straight(of: Robot, start: Any, way: Any, count: int = 101) -> tuple[Any, Any]:
    """Times and joints of a tip that goes a straight line, speeding up and down, in the steps of least joint motion."""
    q = ca.SX.sym("q", of.dof)
    tip = FixedBase(of).tip_pose((), q).position
    both = ca.Function("tip", [q], [tip, ca.jacobian(tip, q)])
    t = np.linspace(0.0, 3.0, count)
    joints, place = [], np.asarray(start, dtype=float)
    begin = np.array(both(place)[0]).ravel()
    for share in (1 - np.cos(np.pi * t / 3)) / 2:
        for _ in range(8):
            at, slope = (np.array(one) for one in both(place))
            place = place + np.linalg.pinv(slope) @ (begin + share * np.asarray(way) - at.ravel())
        joints.append(place)
    return t, np.array(joints)


@pytest.mark.parametrize("path", [(0.2, 0.2, 0.0), (0.0, 0.3, 0.1), (-0.1, 0.1, 0.2)])
def test_exchanged_joints_of_a_straight_line_are_named(ur5: Robot, path: tuple[float, ...]) -> None:
    t, q = straight(ur5, HOME, path)
    assert exchanged_joints(Motion(t, q), ur5, np.arange(6)) == []
    moving = np.flatnonzero(np.ptp(q, axis=0) > 0.05)
    for i, j in [(0, 1), (1, 2), (0, 2), (1, 3)]:
        assert {i, j} <= set(moving)
        wrong = q.copy()
        wrong[:, [i, j]] = q[:, [j, i]]
        check = checked(ur5, t, wrong)
        assert check.faults == ()
        assert not check.passed
        assert "look exchanged" in check.sentence
        assert check.suspicions[0].name == f"{ur5.joint_names[i]} and {ur5.joint_names[j]}"
        assert checked(ur5, t, wrong, names_confirmed=True).passed


def test_exchanged_joints_that_leave_their_limits_are_named() -> None:
    panda = robot("panda.urdf", "panda_hand")
    t = np.linspace(0.0, 3.0, 101)
    middle = (panda.lower + panda.upper) / 2
    q = middle + 0.05 * (panda.upper - panda.lower) * np.sin(t)[:, None]
    names = list(panda.joint_names)
    every = np.arange(panda.dof)
    assert exchanged_joints(Motion(t, q), panda, every) == []
    q[:, 3], q[:, 5] = -2.0 + 0.1 * np.sin(t), 1.9 + 0.1 * np.cos(t)
    q[:, [3, 5]] = q[:, [5, 3]]
    (result,) = exchanged_joints(Motion(t, q), panda, every)
    assert result.name == f"{names[3]} and {names[5]}"


@pytest.mark.parametrize("kind", range(4))
def test_motions_from_joints_to_joints_are_not_suspected(ur5: Robot, kind: int) -> None:
    """Sines, ramps, blends and splines of round amplitudes from round places: simple joint motions of many kinds."""
    rng = np.random.default_rng(kind)
    t = np.linspace(0.0, 3.0, 200)
    homes = [rng.uniform(-2.0, 2.0, 6), np.zeros(6), np.pi / 2 * np.array([0, -1, 1, -1, -1, 0])]
    for case in range(40):
        size = rng.choice([0.0, 0.3, 0.5, 0.8, -0.5], 6)
        shape: Callable[[], Any] = [
            lambda: np.sin(np.outer(t, rng.choice([1.0, 2.0, 3.0], 6))),
            lambda: np.outer(t / 3, np.ones(6)),
            lambda: np.outer((1 - np.cos(np.pi * t / 3)) / 2, np.ones(6)),
            lambda: np.column_stack([np.polyval(rng.normal(size=5), t / 3) for _ in range(6)]),
        ][kind]
        assert exchanged_joints(Motion(t, homes[case % 3] + size * shape()), ur5, np.arange(6)) == []


# ---- wrapped joints --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rates", [1, 2])
@pytest.mark.parametrize("speed", [0.9, -0.9])
def test_a_wrapped_joint_is_reported_once_with_the_option_to_unwrap(ur5: Robot, rates: int, speed: float) -> None:
    t, q, v = swings(0.3)
    q[:, 5], v[:, 5] = 2.5 * np.sign(speed) + speed * t, speed
    sound = checked(ur5, t, *(q, v)[:rates])
    assert sound.passed, sound
    wrong = q.copy()
    wrong[:, 5] = (q[:, 5] + np.pi) % (2 * np.pi) - np.pi
    check = checked(ur5, t, *(wrong, v)[:rates])
    (fault,) = check.faults
    assert (fault.kind, fault.name) == ("jump", ur5.joint_names[5])
    assert "--unwrap" in fault.text
    assert fault.time == pytest.approx((np.pi - 2.5) / 0.9, abs=0.02)
    assert [(row.name, row.verdict) for row in check.rows] == [(row.name, row.verdict) for row in sound.rows]
    again = checked(ur5, t, *(wrong, v)[:rates], unwrap=True)
    assert again.passed, again
    np.testing.assert_allclose(again.cleaned.motion.q, q, atol=1e-12)


def test_a_joint_that_begins_a_turn_away_is_unwrapped_into_its_limits(ur5: Robot) -> None:
    t, q, _ = swings(0.3)
    q[:, 4] = -4.0 + 0.9 * t
    wrong = q.copy()
    wrong[:, 4] = (q[:, 4] + np.pi) % (2 * np.pi) - np.pi
    again = checked(ur5, t, wrong, unwrap=True)
    assert again.passed, again
    np.testing.assert_allclose(np.diff(again.cleaned.motion.q, axis=0), np.diff(q, axis=0), atol=1e-12)


def test_the_command_takes_a_wrapped_joint_as_turning_on(
    ur5: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t, q, v = swings(0.3)
    q[:, 5], v[:, 5] = (2.5 + 0.9 * t + np.pi) % (2 * np.pi) - np.pi, 0.9
    file = write_table(tmp_path / "motion.csv", t, q, v, names=ur5.joint_names)
    urdf = str(next(one.locate() for one in files("example-robot-data") or () if one.name == "ur5_robot.urdf"))
    assert main(["check", urdf, str(file), "--no-clearance", "--quiet"]) == 1
    assert "pass --unwrap if the controller does" in capsys.readouterr().out
    assert main(["check", urdf, str(file), "--no-clearance", "--quiet", "--unwrap"]) == 0
    assert "is wrapped at" in capsys.readouterr().out


def test_large_steps_that_a_joint_can_make_are_no_wraps(ur5: Robot) -> None:
    t = np.arange(0.0, 24.0, 3.0)
    q = np.tile(HOME, (8, 1))
    q[:, 5] = [0.0, 6.0, 0.0, 6.2, 0.1, 6.2, 0.0, 6.0]
    assert checked(ur5, t, q, time_unit="s").passed
