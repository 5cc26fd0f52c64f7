"""What is written stays where the user pointed: below a folder, by its suffix, over no file of others; and says nothing
to a shell, a spreadsheet or a browser."""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import Joint, Link, ModelError, Robot
from ocp import Plan, ProblemError
from ocp.__main__ import main
from ocp.app.files import read_trajectory
from ocp.app.files.safe_files import SUFFIXES, checked_output
from ocp.app.view.player import PageServer
from ocp.app.view.report import POLICY
from ocp.motion.schedule import JointTrajectory
from ocp.storage import column_name, joint_name, table_head, table_joints
from tests.ocp.app.motions import smooth, write_robot, write_table
from tests.ocp.app.test_command import TASK, planned, run

KINDS = [*SUFFIXES]


def task(folder: Path, output: str) -> Path:
    write_robot(folder)
    file = folder / "seam.toml"
    file.write_text(TASK[: TASK.index("[output]")] + f"[output]\n{output}\n")
    return file


def victim(place: Path, text: str = "export PATH=/mine\n") -> Path:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
    return place


# ---- where ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["absolute", "above", "linked folder", "linked file", "by a folder and back"])
def test_a_task_writes_nothing_outside_of_its_folder(kind: str, how: str, tmp_path: Path, capsys: Any) -> None:
    suffix, home = SUFFIXES[kind][0], tmp_path / "home"
    victim(home / f"a{suffix}")
    folder = tmp_path / "task"
    folder.mkdir()
    (folder / "inside").mkdir()
    (folder / "linked").symlink_to(home)
    (folder / f"link{suffix}").symlink_to(home / f"a{suffix}")
    name = {
        "absolute": f"{home}/a{suffix}",
        "above": f"../home/a{suffix}",
        "linked folder": f"linked/a{suffix}",
        "linked file": f"link{suffix}",
        "by a folder and back": f"inside/../../home/new{suffix}",
    }[how]
    status, out, err = run(capsys, "plan", task(folder, f'{kind} = "{name}"'), "--force", "--quiet")
    assert (status, out) == (2, "")
    assert "is outside of" in err
    assert "--output-folder" in err
    assert re.search(r"seam\.toml, line \d+, ", err)
    assert sorted(file.name for file in home.iterdir()) == [f"a{suffix}"]
    assert (home / f"a{suffix}").read_text() == "export PATH=/mine\n"


@pytest.mark.parametrize(
    "name", [".bashrc", "seam", "seam.sh", "seam.csv.sh", "seam.npz", "script.csv", "se\\u0000am.csv", "a\\nb.csv"]
)
def test_an_output_has_the_suffix_of_its_kind(name: str, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "run.sh").write_text("mine")
    (tmp_path / "script.csv").symlink_to(tmp_path / "run.sh")
    status, _, err = run(capsys, "plan", task(tmp_path, f'csv = "{name}"'), "--force", "--quiet")
    assert status == 2
    assert "end it with .csv" in err or "printable" in err
    assert (tmp_path / "run.sh").read_text() == "mine"


def test_outputs_go_to_the_folder_that_the_user_names(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "out").mkdir()
    folder = tmp_path / "task"
    folder.mkdir()
    file = task(folder, 'csv = "seam.csv"')
    assert run(capsys, "plan", file, "--output-folder", tmp_path / "out", "--quiet")[0] == 0
    assert [one.name for one in (tmp_path / "out").iterdir()] == ["seam.csv"]
    assert not (folder / "seam.csv").exists()
    file = task(folder, f'csv = "{tmp_path}/task/seam.csv"')
    assert run(capsys, "plan", file, "--output-folder", tmp_path / "out", "--quiet")[0] == 2
    assert run(capsys, "plan", file, "-o", tmp_path / "out" / "seam.npz", "--quiet")[0] == 0  # the user's own pointing


@pytest.mark.long
def test_a_task_in_segments_writes_one_file_and_no_other(tmp_path: Path, capsys: Any) -> None:
    """A link may lie in wait under a number."""
    own = victim(tmp_path / "home" / "a.csv")
    folder = tmp_path / "task"
    folder.mkdir()
    (folder / "seam-2.csv").symlink_to(own)
    file = task(folder, 'csv = "seam.csv"')
    file.write_text(file.read_text().replace('kind = "start"', 'kind = "segments"'))
    assert run(capsys, "plan", file, "--quiet")[0] == 0
    assert own.read_text() == "export PATH=/mine\n"
    assert (folder / "seam.csv").read_text().startswith("time,")


# ---- over what -----------------------------------------------------------------------------------------------------

FOREIGN = {
    "plan": b"PK\x05\x06" + bytes(18),
    "csv": b"time,shoulder,elbow\n0,1,2\n",
    "json": b'{"joint_names": ["a"], "points": []}',
    "yaml": b"joint_names: [a]\n",
    "mcap": b"\x89MCAP0\r\n",
    "urscript": b"def program():\n  # mine\nend\n",
    "krl": b"&ACCESS RVP\nDEF seam()\nEND\n",
    "rapid": b"MODULE seam\n  PROC main()\n",
    "urdf": b'<?xml version="1.0"?>\n<robot name="mine"/>',
    "report": b"<!doctype html>\n<html><head><title>mine</title></head></html>",
}


@pytest.mark.parametrize("kind", KINDS)
def test_no_file_of_others_is_overwritten(kind: str, tmp_path: Path) -> None:
    place = tmp_path / f"seam{SUFFIXES[kind][0]}"
    for data in (FOREIGN[kind], b"", b"mine", bytes(100)):
        place.write_bytes(data)
        with pytest.raises(ProblemError, match=r"was not written by selfmotion.*--force"):
            checked_output(kind, place)
        assert checked_output(kind, place, force=True) == place
    place.unlink()
    os.mkfifo(place)
    with pytest.raises(ProblemError, match="was not written by selfmotion"):
        checked_output(kind, place)
    place.unlink()
    place.symlink_to(tmp_path / f"there{place.suffix}")
    assert checked_output(kind, place).name == f"there{place.suffix}"


def test_each_command_asks_before_it_overwrites(tmp_path: Path, capsys: Any) -> None:
    robot, table, plan = write_robot(tmp_path), write_table(tmp_path / "m.csv", *smooth()[:2]), planned() / "seam.npz"
    names = {name: victim(tmp_path / name) for name in ("a.npz", "a.csv", "a.html", "seam.json")}
    calls: list[tuple[Any, ...]] = [
        ("plan", task(tmp_path, 'json = "seam.json"')),
        ("plan", task(tmp_path, 'json = "seam.json"'), "-o", names["a.npz"]),
        ("export", plan, names["a.csv"]),
        ("report", plan, names["a.html"]),
        ("view", plan, "--page", names["a.html"]),
        ("check", robot, table, "--report", names["a.html"]),
    ]
    for call in calls:
        status, _, err = run(capsys, *call, "--quiet")
        assert (status, "was not written by selfmotion" in err, "--force" in err) == (2, True, True), call
        assert {file.read_text() for file in names.values()} == {"export PATH=/mine\n"}
    assert run(capsys, *calls[2], "--quiet", "--force")[0] == 0
    assert read_trajectory(names["a.csv"]).names_are_joints is False
    assert run(capsys, *calls[2], "--quiet")[0] == 0  # now it is our own


@pytest.mark.long
def test_a_task_runs_again_over_its_own_outputs(tmp_path: Path, capsys: Any) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(planned(), folder)
    before = {file.name: file.stat().st_ino for file in folder.iterdir() if file.name.startswith("seam.")}
    assert run(capsys, "plan", folder / "seam.toml", "--quiet")[0] == 0
    after = {file.name: file.stat().st_ino for file in folder.iterdir() if file.name in before}
    assert {name for name in before if before[name] != after[name]} == set(before) - {"seam.toml"}
    for kind in KINDS:
        checked_output(kind, folder / f"seam{SUFFIXES[kind][0]}")
    assert run(capsys, "view", folder / "seam.npz", "--page", folder / "seam.html", "--quiet")[0] == 0
    assert run(capsys, "report", folder / "seam.npz", folder / "seam.html", "--quiet")[0] == 0


# ---- names ---------------------------------------------------------------------------------------------------------

NAMES = st.text(min_size=1, max_size=12) | st.sampled_from(
    ["$(touch PWNED5)", "`id`", "=1+1", "+a", "-b", "@SUM(A1)", "time", "t", "a.velocity", "pos/x", "a,b", 'a"b', "%41",
     "a [deg]", " a ", "#", "a;b", "a\tb", "é", "name", "elbow_pos", "1e5"]
)  # fmt: skip
UNIQUE = st.lists(NAMES, min_size=1, max_size=4, unique=True)


@given(UNIQUE)
def test_names_in_a_head_are_read_back(names: list[str]) -> None:
    assert [joint_name(column_name(name)) for name in names] == names
    assert table_joints(table_head(names)) == tuple(names)


@given(UNIQUE)
def test_names_in_a_head_mean_nothing_to_spreadsheets_and_shells(names: list[str]) -> None:
    for cell in table_head(names):
        assert re.fullmatch(r"[\w%][\w%./: -]*", cell)  # no = + - @ first, none of $`"';|&<>(){}*?!#~\\ and no new line
    text = ",".join(table_head(names))
    assert next(csv.reader([text])) == table_head(names)


@pytest.mark.long
@given(names=UNIQUE)
def test_tables_are_read_back_with_their_names(names: list[str], tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.getbasetemp() / "named.csv"
    values = np.arange(2.0 * len(names)).reshape(2, -1)
    result = JointTrajectory(tuple(names), np.array([0.0, 1.0]), values, values, values)
    result.write_csv(file)
    assert JointTrajectory.read_csv(file).names == tuple(names)
    rows = np.column_stack([result.t, values, values, values])
    file.write_text("\n".join([",".join(table_head(names)), *(",".join(map(repr, row)) for row in rows.tolist())]))
    trajectory = read_trajectory(file)
    assert trajectory.names == tuple(names)
    np.testing.assert_array_equal(trajectory.positions, values)
    assert trajectory.accelerations is not None


EVIL = ["$(touch PWNED)", "`touch PWNED`", "=cmd|'/C calc'!A0", "$\\frac{$", "</title><script>alert(1)</script>"]


def test_a_stranger_s_names_do_nothing(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the CSV that a shell runs or a spreadsheet opens, the URDF, the page and the report."""
    monkeypatch.chdir(tmp_path)
    write_robot(tmp_path)
    text = (tmp_path / "robot.urdf").read_text()
    names = re.findall(r'<joint name="([^"]*)" type="(?:revolute|prismatic|continuous)', text)
    for old, new in zip(names, EVIL, strict=False):
        quoted = new.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
        text = text.replace(f'"{old}"', f'"{quoted}"')
    (tmp_path / "robot.urdf").write_text(text)
    (tmp_path / "seam.toml").write_text(TASK)
    status, _, err = run(capsys, "plan", tmp_path / "seam.toml", "--quiet")
    assert status == 0, err
    assert run(capsys, "view", tmp_path / "seam.npz", "--page", tmp_path / "page.html", "--quiet")[0] == 0
    loaded = Plan.load(tmp_path / "seam.npz")
    assert set(EVIL[: len(loaded.names)]) == set(loaded.names)
    subprocess.run(["sh", "./seam.csv"], capture_output=True, check=False)
    assert not (tmp_path / "PWNED").exists()
    assert not re.search(r"[$`=;'\"]", (tmp_path / "seam.csv").read_text())
    for ending in ("csv", "json", "yaml", "mcap"):
        assert read_trajectory(tmp_path / f"seam.{ending}").names == loaded.names
    assert Robot.from_urdf(tmp_path / "seam.urdf").joint_names == loaded.names
    assert "<script>alert" not in (tmp_path / "seam.html").read_text() + (tmp_path / "page.html").read_text()


@pytest.mark.parametrize(
    "name", ["a\nb", "a\rb", "a\tb", "\x1b[2J", "a\0", "a\x7f", "a\u2028b", "\u202ea", "a\ud800", "a" * 501]
)
def test_names_that_are_not_printed_are_refused(name: str) -> None:
    for result in (lambda: Link(name), lambda: Joint(name, "fixed", "a", "b"), lambda: Robot((Link("a"),), name=name)):
        with pytest.raises(ModelError, match="printable"):
            result()


def test_control_characters_of_files_do_not_reach_the_terminal(tmp_path: Path, capsys: Any) -> None:
    t, q, *_ = smooth()
    robot, file = write_robot(tmp_path), write_table(tmp_path / "m.csv", t, q)
    head, _, rows = file.read_text().partition("\n")
    file.write_text(f"{head},\x1b[31mowned\x07\n" + "\n".join(f"{row},0" for row in rows.split("\n") if row))
    _, out, err = run(capsys, "check", robot, file, "--quiet")
    assert not set(out + err) & {"\x1b", "\x07"}
    assert "owned" in out + err


# ---- pages ---------------------------------------------------------------------------------------------------------


def test_reports_and_pages_ask_nobody_and_run_nothing_of_others(tmp_path: Path, capsys: Any) -> None:
    assert run(capsys, "view", planned() / "seam.npz", "--page", tmp_path / "page.html", "--quiet")[0] == 0
    for file in (planned() / "seam.html", tmp_path / "page.html"):
        text = file.read_text()
        (report,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
        assert text.index("Content-Security-Policy") < text.index("<title>")
        allowed = dict(part.strip().split(" ", 1) for part in report.split(";"))
        assert allowed.pop("default-src") == "'none'"
        assert set(allowed.items()) <= {
            ("script-src", "'unsafe-inline'"),
            ("style-src", "'unsafe-inline'"),
            ("img-src", "data:"),
        }
    assert "script-src" not in POLICY


def test_a_page_is_served_to_who_names_this_machine_alone() -> None:
    """A name of somebody else that leads to this machine gets nothing."""
    with PageServer("secret") as served:
        host, port = served.address.removeprefix("http://").split(":")
        assert host == "127.0.0.1"
        for name, status in [
            (f"127.0.0.1:{port}", 200),
            (f"localhost:{port}", 200),
            ("localhost:9", 200),  # through a tunnel
            (f"evil.example:{port}", 421),
            ("evil.example", 421),
            (f"127.0.0.1.evil.example:{port}", 421),
            ("", 421),
        ]:
            connection = HTTPConnection(host, int(port), timeout=20)
            connection.request("GET", "/", headers={"Host": name})
            answer = connection.getresponse()
            assert (answer.status, answer.read() == b"secret") == (status, status == 200), name
            connection.close()


# ---- calls ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments", [1.0, "plan", b"plan", [1], ["plan", None], {"plan": 1}.values(), object(), float("nan")]
)
def test_the_command_takes_a_list_of_texts(arguments: Any) -> None:
    with pytest.raises(ProblemError) as caught:
        main(arguments)
    assert caught.value.name == "arguments"
