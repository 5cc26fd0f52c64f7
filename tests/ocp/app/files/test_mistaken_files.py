"""Mistakes that users make in files end in one line that names the cause and the remedy; nothing is written then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from models import ModelError, ModelWarning, Robot, smooth
from models import Path as Corners
from ocp import ProblemError, TipTask
from ocp.__main__ import main
from ocp.app.files import read_joint_limits, read_trajectory, read_waypoints
from tests.ocp.app.motions import URDF

TASK = """[robot]
urdf = "robot.urdf"
tip = "finger"
[path]
points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]
speed = 0.1
[search]
kind = "start"
[output]
plan = "plan.npz"
csv = "plan.csv"
"""
CSV = "time,shoulder,elbow,wrist,slide\n0,0.3,0.8,-0.5,0.15\n1,0.3,0.8,-0.5,0.15\n"
SRDF = '<robot name="bars"><disable_collisions link1="upper" link2="hand" reason="Never"/></robot>'


def ends(folder: Path, capsys: Any, arguments: list[str]) -> str:
    """The only error of a command that ends with status 2 and leaves the files of the folder as they are."""
    before = {file: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    words = [str(folder / word) if "." in word else word for word in arguments]
    assert main([*words, "--quiet"]) == 2
    assert {file: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before
    printed = capsys.readouterr()
    assert printed.out == ""
    errors = [line for line in printed.err.splitlines() if "warning:" not in line]
    assert len(errors) == 1
    assert len(errors[0]) < 700
    return str(errors[0])


@pytest.mark.parametrize(
    ("good", "bad", "expected"),
    [
        ("speed = 0.1", "speed = 0.1\nspeed = 0.2", ("line 7", "speed = 0.2", "once for each name")),
        ("[output]", "[path]\n[output]", ("line 9", "[path]", "once for each name")),
        ("speed = 0.1", "speed = 0.1\naccel = 1", ("line 7", "did you mean acceleration?")),
        ("[search]", "[limits]\nvel = 1\n[search]", ("line 8", "did you mean velocity?")),
        ("[search]", "[Search]", ("line 7", "did you mean search?")),
        ("0.3, 0.3]]", "true, 0.3]]", ("line 5", "three numbers", "True")),
        ("0.3, 0.3]]", "nan, 0.3]]", ("line 5", "three numbers", "nan")),
        ("speed = 0.1", "speed = 5e400", ("line 6", "of 1e-6 to 1e6, not inf")),
        ("speed = 0.1", "speed = 2027-01-31", ("line 6", "a number above 0, m/s")),
        ("speed = 0.1", "speed = { value = 0.1 }", ("line 6", "a number above 0, m/s")),
        ("speed = 0.1", "speed = 0.1\nwithin = 15", ("line 7", "within")),
        ('kind = "start"', 'kind = ["start"]', ("line 8", "one of", '"start"')),
        ('kind = "start"', 'kind = "start"\nseed = 1.5', ("line 9", "a whole number")),
        ('csv = "plan.csv"', 'csv = "/tmp/plan.csv"', ("line 11", "is outside of")),
        ('csv = "plan.csv"', 'csv = "plan.npz"', ("line 11", "end it with .csv")),
        ("[output]", '[obstacle]\nshape = "box"\n[output]', ("line 9", "each headed [[obstacle]]")),
        ('"robot.urdf"', '"task.toml"', ("line 2", "not well-formed XML")),
        (TASK, '{"robot": {"urdf": "robot.urdf"}}', ("line 1", "write name = value")),
        (TASK, "robot:\n  urdf: robot.urdf\n", ("line 1", "write name = value")),
        (TASK, "robot = 'a'\0", ("zero bytes",)),
        (TASK, "a = " + "[" * 500 + "]" * 500, ("nest",)),
    ],
)
def test_mistakes_in_a_task_file_are_named_with_their_line(
    good: str, bad: str, expected: tuple[str, ...], tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    assert TASK.count(good) == 1
    (tmp_path / "task.toml").write_text(TASK.replace(good, bad))
    error = ends(tmp_path, capsys, ["plan", "task.toml"])
    assert [word for word in expected if word not in error] == [], error


@pytest.mark.parametrize(
    ("good", "bad", "expected"),
    [
        ('xyz="0.4 0 0"', 'xyz="0.4, 0, 0"', ("wrist", "blanks between numbers")),
        ('velocity="2"', 'velocity="2,5"', ("shoulder", "write decimal points")),
        ('velocity="2"', 'velocity="nan"', ("shoulder", "velocity", "nan")),
        ('lower="-2"', 'lower="9"', ("shoulder", "lower limit 9.0 is above upper limit 2.0")),
        ('axis xyz="1 0 0"', 'axis xyz="0 0 0"', ("slide", "no direction")),
        ('joint name="elbow"', 'joint name="shoulder"', ("shoulder", "more than once")),
        ('child link="hand"', 'child link="hnad"', ("wrist", "did you mean 'hand'?")),
        ('child link="hand"', 'child link="upper"', ("upper",)),
        ('mass value="2.0"', 'mass value="1e999"', ("fore", "mass", "inf")),
        ('<robot name="bars">', '<!DOCTYPE a [<!ENTITY b "c">]><robot name="bars">', ("entities",)),
        ("</robot>", "</robot><robot/>", ("not well-formed XML", "line 25")),
    ],
)
def test_mistakes_in_a_urdf_name_the_part(
    good: str, bad: str, expected: tuple[str, ...], tmp_path: Path, capsys: Any
) -> None:
    assert good in URDF
    (tmp_path / "robot.urdf").write_text(URDF.replace(good, bad, 1))
    (tmp_path / "move.csv").write_text(CSV)
    error = ends(tmp_path, capsys, ["check", "robot.urdf", "move.csv"])
    assert [word for word in expected if word not in error] == [], error


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("move.csv", CSV.replace("elbow", "shoulder"), ("two columns are named 'shoulder'",)),
        ("move.csv", CSV.replace("0,0.3,0.8", "0,0.8", 1), ("line 2", "complete the row")),
        ("move.csv", CSV.replace("-0.5", "half", 1), ("line 2", "'half' is not a number")),
        ("move.csv", CSV.split("\n")[0] + "\n", ("no sample",)),
        ("move.csv", "PK\x03\x04\0", ("zero bytes",)),
        ("move.json", '{"joint_names": ["a", "a"], "points": []}', ("distinct names",)),
        ("move.json", "[" * 10_000, ("nest",)),
        ("names.srdf", SRDF.replace(' link2="hand"', ""), ("disable_collisions", "link2")),
        ("names.srdf", URDF, ("it is a URDF",)),
        ("names.srdf", SRDF[:-5], ("not well-formed XML",)),
    ],
)
def test_mistakes_in_a_trajectory_or_srdf_are_named(
    name: str, text: str, expected: tuple[str, ...], tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    (tmp_path / "move.csv").write_text(CSV)
    (tmp_path / name).write_text(text)
    motion = "move.csv" if name.endswith(".srdf") else name
    more = ["--srdf", name] if name.endswith(".srdf") else []
    error = ends(tmp_path, capsys, ["check", "robot.urdf", motion, *more])
    assert [word for word in expected if word not in error] == [], error


def test_a_joint_that_has_limits_twice_is_refused(tmp_path: Path) -> None:
    limits = "  elbow:\n    has_velocity_limits: true\n    max_velocity: 2\n"
    (tmp_path / "joint_limits.yaml").write_text("joint_limits:\n" + limits + limits)
    with pytest.raises(ProblemError, match="'elbow' is there twice in a mapping; remove one of the two"):
        read_joint_limits(tmp_path / "joint_limits.yaml", Robot.from_urdf(URDF))


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\r\n", "\r", "\n"])
def test_marks_and_line_ends_of_other_systems_change_nothing(mark: str, end: str, tmp_path: Path, capsys: Any) -> None:
    for name, text in (("robot.urdf", URDF), ("move.csv", CSV), ("task.toml", TASK)):
        (tmp_path / name).write_bytes((mark + text.replace("\n", end)).encode())
    assert read_trajectory(tmp_path / "move.csv").positions.tolist() == [[0.3, 0.8, -0.5, 0.15]] * 2
    assert main(["check", str(tmp_path / "robot.urdf"), str(tmp_path / "move.csv"), "--quiet"]) == 0
    (tmp_path / "task.toml").write_bytes((mark + TASK.replace("0.1\n", "-1\n").replace("\n", end)).encode())
    assert main(["plan", str(tmp_path / "task.toml"), "--quiet"]) == 2
    assert "task.toml, line 6, 'speed = -1'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("rpy = [180, 0, 90]\n", "rpy 180 rad is more than two turns; angles are in rad, is it in degrees"),
        ("[[obstacle]]\nshape = 'sphere'\nradius = 80\nposition = [0, 0, -900]\n", "is it in millimetres"),
        ("[[obstacle]]\nshape = 'box'\nsize = [100, 1, 1]\nposition = [0, 0, -9]\n", "is it in millimetres"),
    ],
)
def test_degrees_and_millimetres_are_suspected(more: str, words: str, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    (tmp_path / "task.toml").write_text(TASK.replace("speed = 0.1\n", "speed = 0.1\n" + more).replace("0.1", "-0.1", 1))
    main(["plan", str(tmp_path / "task.toml"), "--output-folder", str(tmp_path), "--quiet"])
    assert words in capsys.readouterr().err


def test_g_code_in_place_of_waypoints_is_recognised(tmp_path: Path) -> None:
    (tmp_path / "part.nc").write_text("G21 G90\nG1 X400 Y-200 Z300 F3000\nG1 Y100\n")
    with pytest.raises(ProblemError, match="is it G-code") as caught:
        read_waypoints(tmp_path / "part.nc")
    assert caught.value.name == "x"


def test_columns_that_mean_nothing_are_named(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    (tmp_path / "seam.csv").write_text("x,y,z,roll\n0.75,0.1,0.3,180\n0.75,0.3,0.3,180\n")
    points = "points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]"
    (tmp_path / "task.toml").write_text(TASK.replace(points, 'file = "seam.csv"'))
    main(["plan", str(tmp_path / "task.toml"), "--quiet"])
    assert "seam.csv: unknown columns roll are ignored" in capsys.readouterr().err


def test_a_speed_that_a_short_path_never_reaches_is_warned_of() -> None:
    """From rest to rest over L the tip reaches sqrt(a L) at most, less with a limited jerk."""
    path = smooth(Corners.through([(0, 0, 0), (0.3, 0, 0)]), deviation=0.001)
    with pytest.warns(ModelWarning, match=r"too short for 5 m/s .*1 m/s\^2 the tip reaches 0\.5 m/s") as caught:
        task = TipTask.along(path, 5.0)
    warning: Any = caught[0].message
    assert (warning.name, warning.value) == ("speed", 5.0)
    assert warning.limit < 0.3**0.5
    assert task.duration > 2 * 0.3**0.5
    TipTask.along(path, 0.99 * warning.limit)
    with pytest.raises((ModelError, ProblemError), match="speed"):
        TipTask.along(path, -5.0)
