"""The command from files to files: exit statuses, what is printed, plans read back, reports that stand alone."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from models import files as kept
from ocp import Plan, ProblemError, SolveError
from ocp.__main__ import main
from ocp.app.files.task_file import read_task
from ocp.console import Progress
from ocp.motion.result.segmented_plan import SegmentedPlan
from tests.ocp.app.motions import SWING, TURNS, smooth, write_robot, write_table

TASK = """# a seam
[robot]
urdf = "robot.urdf"
tip = "finger"

[path]
points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]   # m
speed = 0.1
tool = "free"

[search]
kind = "start"

[[obstacle]]
shape = "box"
size = [0.1, 0.1, 0.1]
position = [0.2, -0.5, 0.3]

[output]
plan = "seam.npz"
csv = "seam.csv"
json = "seam.json"
yaml = "seam.yaml"
mcap = "seam.mcap"
urdf = "seam.urdf"
report = "seam.html"
"""


def run(capsys: Any, *words: Any) -> tuple[int, str, str]:
    """Status, output and error output."""
    capsys.readouterr()  # of what went before
    try:
        status = main([str(word) for word in words])
    except SystemExit as error:
        status = int(error.code or 0)
    result = capsys.readouterr()
    return status, result.out, result.err


@cache
def planned() -> Path:
    """A folder in which a task has been planned."""
    folder = Path(mkdtemp())
    write_robot(folder)
    (folder / "seam.toml").write_text(TASK)
    assert main(["plan", str(folder / "seam.toml"), "--quiet"]) == 0
    return folder


# ---- plan, export, report ------------------------------------------------------------------------------------------


def test_a_task_is_planned_and_all_outputs_equal_the_plan(capsys: Any) -> None:
    folder = planned()
    loaded = Plan.load(folder / "seam.npz")
    assert loaded.audit().passed
    assert loaded.horizon == pytest.approx(2.0 + 0.1 / 1.0 + 0.1)  # the ramps take half of v/a + a/j more at each end
    tips = loaded.sample(0.01).tip[:, :3]
    np.testing.assert_allclose(tips[[0, -1]], [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]], atol=1e-6)
    assert {file.suffix for file in folder.iterdir()} >= {".npz", ".csv", ".json", ".yaml", ".mcap", ".urdf", ".html"}


@pytest.mark.parametrize("kind", ["csv", "json", "yaml", "mcap"])
def test_a_plan_written_and_read_back_is_not_accused(capsys: Any, kind: str) -> None:
    folder = planned()
    status, out, _ = run(capsys, "check", folder / "seam.urdf", folder / f"seam.{kind}", "--json")
    data = json.loads(out)
    assert (status, data["faults"], data["passed"]) == (0, [], True)
    assert data["rule"] == ("cubic" if kind == "mcap" else "quintic")
    status, out, _ = run(capsys, "export", folder / "seam.npz", folder / f"again.{kind}")
    assert status == 0
    assert (folder / f"again.{kind}").read_bytes() == (folder / f"seam.{kind}").read_bytes()


def test_a_plan_follows_the_path_of_its_task(capsys: Any) -> None:
    folder = planned()
    (folder / "path.csv").write_text("x,y,z\n0.75,0.1,0.3\n0.75,0.3,0.3\n")
    words = "check", folder / "seam.urdf", folder / "seam.csv", "--path", folder / "path.csv", "--json"
    status, out, _ = run(capsys, *words)
    rows = {row["name"]: row for row in json.loads(out)["rows"]}
    assert status == 0
    assert rows["distance of the tip from the path"]["value"] < 1e-5
    (folder / "path.csv").write_text("x,y,z\n0.75,0.1,0.3\n0.75,0.3,0.31\n")
    assert run(capsys, *words)[0] == 1


class Page(HTMLParser):
    """What a page asks for, and whether its tags are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.requests: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.requests += [value for name, value in attrs if name in ("src", "href", "action", "srcset") and value]
        if tag in ("table", "figure", "ul", "ol", "div", "svg", "body", "html"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self.open and self.open[-1] == tag:
            self.open.pop()


def test_a_report_stands_alone(capsys: Any) -> None:
    folder = planned()
    status, out, _ = run(capsys, "report", folder / "seam.npz", folder / "a.html", "--title", "Seam <4>", "--json")
    assert (status, json.loads(out)["passed"]) == (0, True)
    text = (folder / "a.html").read_text()
    page = Page()
    page.feed(text)
    assert page.open == []
    assert all(one.startswith(("data:", "#")) for one in page.requests), page.requests
    assert "url(http" not in text
    assert "@import" not in text
    assert "Seam &lt;4&gt;" in text
    assert "may be run; no better motion is near it" in text
    assert "integration error, relative" in text
    assert len(text) < 2_000_000


@pytest.mark.long
def test_a_report_of_a_check_names_the_faults(capsys: Any, tmp_path: Path) -> None:
    t, q, v, a = smooth()
    write_table(tmp_path / "m.csv", t, q, v, a)
    robot, page = write_robot(tmp_path), tmp_path / "m.html"
    words = "check", robot, tmp_path / "m.csv", "--velocity", "elbow=0.5", "--tip", "finger", "--report", page
    assert run(capsys, *words)[0] == 1
    text = page.read_text()
    assert "must not be run" in text
    assert "velocity: elbow:" in text


# ---- task files that are wrong -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "line", "expected"),
    [
        ('urdf = "robot.urdf"', 'urdf = "nobody.urdf"', 3, "there is no file"),
        ('urdf = "robot.urdf"\n', "", 2, "'urdf' is missing: the name of a URDF file"),
        ('urdf = "robot.urdf"', "urdf = 3", 3, "must be the name of a URDF file, not 3"),
        ('tip = "finger"', 'tip = "fingr"', 4, "finger"),
        ('tip = "finger"', 'tipp = "finger"', 4, "did you mean tip"),
        ("speed = 0.1\n", "", 6, "'speed' is missing: a number above 0, m/s"),
        ("speed = 0.1", "speed = -1", 8, "must be a number above 0, m/s"),
        ("speed = 0.1", 'speed = "fast"', 8, "must be a number above 0"),
        ("speed = 0.1", "speed 0.1", 8, "invalid TOML"),
        ("points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]", "points = [[0.75, 0.1, 0.3]]", 7, "lists of three numbers"),
        ("points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]", 'file = "none.csv"', 7, "there is no file"),
        ("points =", 'file = "a.csv"\npoints =', 6, "not both"),
        ('tool = "free"', 'tool = "loose"', 9, 'one of "free roll", "given", "free"'),
        ('kind = "start"', 'kind = "best"', 12, 'one of "configurations", "start", "global"'),
        ('kind = "start"', 'kind = "segments"\ncyclic = true', 13, "remove it"),
        ('kind = "start"', 'horizon = "slow"', 12, 'one of "free"'),
        ('kind = "start"', "start = { elbw = 1 }", 12, "no independent joint 'elbw'"),
        ('kind = "start"', "start = { elbow = 1 }", 12, "start has no shoulder, wrist, slide"),
        ('kind = "start"', 'kind = "start"\nseed = -1', 13, "seed must be a whole number"),
        ('shape = "box"', 'shape = "ball"', 15, 'one of "sphere", "capsule"'),
        ("size = [0.1, 0.1, 0.1]", "size = [0.1, 0.1]", 16, "three lengths, m"),
        ("size = [0.1, 0.1, 0.1]", "size = [0.1, 0.1, -0.1]", 16, "positive"),
        ("[search]", "[serch]", 11, "did you mean search"),
        ("[search]", "[limits]\nvelocity = { elbow = 0 }\n[search]", 12, "velocity"),
        ("[search]", "[limits]\ntorque = { elbow = -4 }\n[search]", 12, "torque"),
        ("[search]", "[limits]\npower = 'much'\n[search]", 12, "W, or { joint = number }"),
        ('plan = "seam.npz"', 'plan = "no/where/seam.npz"', 20, "no folder"),
    ],
)
def test_errors_in_a_task_file_name_the_line(
    tmp_path: Path, capsys: Any, old: str, new: str, line: int, expected: str
) -> None:
    assert old in TASK
    write_robot(tmp_path)
    (tmp_path / "a.csv").write_text("x,y,z\n0,0,0\n1,0,0\n")
    (tmp_path / "seam.toml").write_text(TASK.replace(old, new, 1))
    with pytest.raises(ProblemError) as caught:
        read_task(tmp_path / "seam.toml")
    assert f"seam.toml, line {line}," in str(caught.value)
    assert expected in str(caught.value)
    status, out, err = run(capsys, "plan", tmp_path / "seam.toml", "--json")
    assert status == 2
    assert json.loads(out)["error"] in err


def test_a_place_out_of_reach_is_bad_input_and_no_motion_is_a_failure(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_robot(tmp_path)
    (tmp_path / "far.toml").write_text(TASK.partition("[output]")[0].replace("0.75", "7.5"))
    status, _, err = run(capsys, "plan", tmp_path / "far.toml")
    assert status == 2
    assert "Traceback" not in err

    def nothing(*_: Any, **__: Any) -> None:
        raise SolveError("no motion passes its audit", name="plan")

    (tmp_path / "seam.toml").write_text(TASK)
    monkeypatch.setattr("ocp.app.subcommands.plan", nothing)
    status, out, err = run(capsys, "plan", tmp_path / "seam.toml", "--json")
    assert status == 1
    assert json.loads(out)["error"] == "no motion passes its audit"
    assert not (tmp_path / "seam.npz").exists()


LIFTED = """<robot name="lifted"><link name="ground"/><link name="column"/><link name="upper"/><link name="lower"/>
<link name="tip"/>
<joint name="lift" type="prismatic"><parent link="ground"/><child link="column"/><axis xyz="0 0 1"/>
 <limit lower="-0.1" upper="0.1" velocity="3" effort="9"/></joint>
<joint name="shoulder" type="revolute"><parent link="column"/><child link="upper"/><axis xyz="0 0 1"/>
 <limit lower="-0.9" upper="0.9" velocity="3" effort="9"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 0 1"/>
 <origin xyz="0.5 0 0"/><limit lower="-1.8" upper="1.8" velocity="3" effort="9"/></joint>
<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.4 0 0"/></joint></robot>"""
"""The shoulder limited: on either side of a line across the elbow has to be on the other one."""


@pytest.mark.long
def test_segmented_plans_are_written_with_reconfigurations_and_fail_where_one_is_missing(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robot.urdf").write_text(LIFTED)
    (tmp_path / "line.toml").write_text(
        "[robot]\nurdf = 'robot.urdf'\ntip = 'tip'\n"
        "[path]\npoints = [[0.6, -0.45, 0], [0.6, 0.45, 0]]\nspeed = 0.45\ntool = 'free'\n"
        "[search]\nkind = 'segments'\n[scene]\nlook = false\n[output]\ncsv = 'line.csv'\nperiod = 0.004\n"
    )
    status, out, err = run(capsys, "plan", tmp_path / "line.toml", "-o", tmp_path / "line.npz", "--json")
    assert status == 0, err
    data = json.loads(out)
    assert len(data["reconfigurations"]) == data["fewest"] == 1
    assert data["written"] == {"csv": str(tmp_path / "line.csv"), "plan": str(tmp_path / "line.npz")}
    loaded = Plan.load(tmp_path / "line.npz")
    assert isinstance(loaded, SegmentedPlan)
    first, last = loaded.segments
    (change,) = loaded.reconfigurations
    assert data["duration"] == pytest.approx(first.horizon + change.duration + last.horizon)
    assert loaded.task_horizon == first.horizon + last.horizon == pytest.approx(2.0)
    assert data["cost"] == pytest.approx(first.cost + last.cost)
    assert first.at(0.0)["joints"][2] * last.at(last.horizon)["joints"][2] < 0  # the elbow has changed its side
    rows = np.loadtxt(tmp_path / "line.csv", delimiter=",", skiprows=1)
    assert rows[-1, 0] == data["duration"]
    assert np.abs(np.diff(rows[:, 1:4], axis=0)).max() < 3.0 * 0.004 * 1.01  # it goes on where each piece ends
    barred = [replace(change, motion=None, failure="the way is barred")]
    monkeypatch.setattr("ocp.app.subcommands.plan", lambda *_, **__: replace(loaded, reconfigurations=tuple(barred)))
    status, out, _ = run(capsys, "plan", tmp_path / "line.toml", "--json", "--force")
    assert status == 1  # the pieces are there, and pass
    data = json.loads(out)
    assert (data["passed"], data["duration"]) == (False, pytest.approx(2.0))
    assert data["reconfigurations"][0]["failure"] == "the way is barred"
    assert data["verdict"].startswith("must not be run: reconfigurations without a motion")


def test_a_dead_end_names_the_key_of_the_task_file_that_may_help(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "robot.urdf").write_text(LIFTED)
    (tmp_path / "line.toml").write_text(
        "[robot]\nurdf = 'robot.urdf'\ntip = 'tip'\n"
        "[path]\npoints = [[0.6, -0.45, 0], [0.6, 0.45, 0]]\nspeed = 0.45\ntool = 'free'\n"
        "[search]\nkind = 'global'\n[scene]\nlook = false\n"
    )
    status, _, err = run(capsys, "plan", tmp_path / "line.toml")
    assert status == 1
    assert '[search] kind = "segments"' in err


# ---- what is printed -----------------------------------------------------------------------------------------------


def test_statuses_and_streams(tmp_path: Path, capsys: Any) -> None:
    t, q, *_ = smooth()
    robot, file = write_robot(tmp_path), write_table(tmp_path / "m.csv", t, q)
    status, out, err = run(capsys, "check", robot, file)
    assert status == 0
    speed = (SWING * TURNS).max()  # of the sine of the elbow
    assert f"The trajectory meets all checked requirements; it starts at {speed:.3g} rad/s" in out
    assert err.startswith("selfmotion check: started\n")
    assert "done after" in err
    status, out, err = run(capsys, "check", robot, file, "--velocity", "0.1", "--quiet")
    assert (status, err) == (1, "")
    assert "velocity: shoulder:" in out
    status, out, err = run(capsys, "check", robot, tmp_path / "nobody.csv", "--json")
    assert status == 2
    assert "nobody.csv" in json.loads(out)["error"]
    assert run(capsys, "check")[0] == 2
    assert run(capsys, "sing")[0] == 2
    assert run(capsys, "check", robot, file, "--velocity", "fast")[0] == 2
    assert run(capsys, "export", planned() / "seam.npz", tmp_path / "a.doc")[0] == 2
    assert run(capsys, "export", file, tmp_path / "a.csv")[0] == 2
    assert run(capsys, "export", planned() / "seam.npz", tmp_path / "a.csv", "--period", "0")[0] == 2
    assert run(capsys, "export", planned() / "seam.npz", tmp_path / "a.csv", "--period", "1e-9")[0] == 2
    assert not (tmp_path / "a.csv").exists()
    status, _, err = run(capsys, "export", planned() / "seam.npz", tmp_path / "none" / "a.csv", "--quiet")
    assert (status, err) == (2, f"selfmotion export: {tmp_path}/none/a.csv: No such file or directory\n")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("terminal", [True, False])
def test_long_work_says_that_it_goes_on(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    stream = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("ocp.console.LOG_PERIOD_S", 0.05)
    monkeypatch.setattr("ocp.console.TERMINAL_DELAY_S", 0.05)
    with Progress("work") as progress:
        progress("half of it")
        while "half of it" not in stream.getvalue():
            time.sleep(0.01)
        progress.say("warning: so")
    text = stream.getvalue()
    assert "half of it" in text
    assert "work: warning: so\n" in text
    if terminal:
        assert text.endswith("\n") or text.endswith("\r\x1b[K")
    else:
        assert text.startswith("work: started\n")
        assert text.splitlines()[-1].startswith("work: done after")
        assert "\r" not in text


@pytest.mark.parametrize("command", ["check", "plan", "export", "report", "cache", "completion"])
def test_help_has_examples(capsys: Any, command: str) -> None:
    status, out, _ = run(capsys, command, "--help")
    assert status == 0
    assert f"selfmotion {command}" in out


def test_the_cache_is_shown_and_cleared(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "selfmotion").mkdir()
    (tmp_path / "selfmotion" / "mine.txt").write_text("not of the cache")
    kept.store_value("a" * 64, {"a": 1})
    kept.store_library("b" * 64, b"compiled")
    data = json.loads(run(capsys, "cache", "--json")[1])
    assert (data["folder"], data["files"], data["cleared"]) == (str(tmp_path / "selfmotion"), 2, False)
    assert (data["libraries"], data["bytes"]) == (1, 64 + len('\n{"a": 1}') + len(b"compiled"))
    assert kept.load_value("a" * 64) == {"a": 1}
    assert run(capsys, "cache", "clear")[0] == 0
    assert kept.load_value("a" * 64) is None
    assert kept.load_library("b" * 64) is None
    assert [file.name for file in (tmp_path / "selfmotion").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_scripts_of_shell_completion(capsys: Any, shell: str) -> None:
    status, out, err = run(capsys, "completion", shell)
    assert (status, err) == (0, "")
    assert "--path-tolerance" in out
    if shell == "bash":
        words = "source /dev/stdin; COMP_WORDS=(selfmotion ex); COMP_CWORD=1; _shtab_selfmotion; echo ${COMPREPLY[@]}"
        done = subprocess.run(["bash", "-c", words], input=out, capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["export"]


def test_control_c_ends_with_its_status(tmp_path: Path) -> None:
    write_robot(tmp_path)
    task = TASK.partition("[output]")[0].replace('kind = "start"', 'kind = "global"')
    (tmp_path / "long.toml").write_text(task)
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored by some shells
    code += "from ocp.__main__ import main; sys.exit(main())"
    words = [sys.executable, "-c", code, "plan", str(tmp_path / "long.toml")]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {})
    assert process.stderr is not None
    assert process.stderr.readline() == "selfmotion plan: started\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 130, (out, err)
    assert "stopped" in err
    assert "Traceback" not in err
