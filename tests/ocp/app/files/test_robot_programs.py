"""Programs of industrial robots: what is written is read back to its digits; anything else is refused by its line."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import Joint, Link, Robot
from ocp import ProblemError
from ocp.app.files import RawTrajectory, read_trajectory, write_robot_program
from ocp.app.files.exchange import ROBOT_LANGUAGES
from ocp.app.files.safe_files import SUFFIXES
from ocp.motion.schedule import JointTrajectory
from tests.ocp.app.test_command import planned, run
from tests.ocp.app.test_outputs import EVIL, NAMES

SUFFIX = {kind: SUFFIXES[kind][0] for kind in ROBOT_LANGUAGES}
HALF_DIGIT = {
    "urscript": (0.5e-9, 0.5e-9),
    "krl": (np.deg2rad(0.5e-7), 0.5e-10),
    "rapid": (np.deg2rad(0.5e-7), 0.5e-10),
}
"""rad and m."""


def robot(names: list[str], kinds: list[Any]) -> Robot:
    """A chain whose joints k = 1, 2, ... reach the velocity k."""
    links = tuple(Link(f"link {k}") for k in range(len(names) + 1))
    joints = tuple(
        Joint(name, kind, links[k].name, links[k + 1].name, axis=(0, 0, 1), lower=-9, upper=9, velocity=k + 1.0)
        for k, (name, kind) in enumerate(zip(names, kinds, strict=True))
    )
    return Robot(links, joints)


def sampled(names: list[str], times: Any, positions: Any) -> RawTrajectory:
    lines = np.arange(1, len(times) + 1)
    return RawTrajectory(tuple(names), np.asarray(times), np.asarray(positions), None, None, None, lines, True, (), "a")


ARM = ["revolute"] * 6
SIX = [f"j{k}" for k in range(1, 7)]
T = np.linspace(0.0, 0.5, 26)
Q = np.sin(np.outer(T, np.arange(1.0, 7.0))) - 0.3


def written(folder: Path, kind: str, motion: Any = None, **options: Any) -> Path:
    file = folder / f"seam{SUFFIX[kind]}"
    options = {"robot": robot(SIX, ARM)} | options
    write_robot_program(sampled(SIX, T, Q) if motion is None else motion, file, **options)
    return file


@st.composite
def motions(draw: st.DrawFn) -> tuple[str, list[str], list[str], Any, Any]:
    """A language, and joints that its controller has, with names of any kind; times at least 1 ns apart."""
    kind = draw(st.sampled_from(sorted(ROBOT_LANGUAGES)))
    count = 6 if kind == "urscript" else draw(st.integers(1, 12))
    unique = st.lists(NAMES.filter(str.isprintable), min_size=count, max_size=count, unique=True)
    linear = st.integers(0, 0 if kind == "urscript" else min(count, 6))
    kinds = ["prismatic"] * draw(linear)
    kinds = draw(st.permutations(kinds + ["revolute"] * (count - len(kinds))))
    steps = draw(st.lists(st.integers(1, 10**10), max_size=4))
    rows = st.lists(st.floats(-7, 7), min_size=count, max_size=count)
    positions = draw(st.lists(rows, min_size=len(steps) + 1, max_size=len(steps) + 1))
    return kind, draw(unique), kinds, np.cumsum([0, *steps]) / 1e9, np.array(positions)


@settings(max_examples=20)
@given(motions())
def test_times_and_joints_are_read_back_to_the_digits_written(
    tmp_path_factory: pytest.TempPathFactory, values: tuple[str, list[str], list[str], Any, Any]
) -> None:
    kind, names, kinds, t, q = values
    folder = tmp_path_factory.getbasetemp()
    file = written(folder, kind, sampled(names, t, q), robot=robot(names, kinds))
    result = read_trajectory(file, period=0.01)
    assert (result.names, result.names_are_joints) == (tuple(names), True)
    np.testing.assert_array_equal(result.t, 0.01 * np.arange(len(t)) if kind == "krl" else t)
    half = np.where(np.array(kinds) == "prismatic", HALF_DIGIT[kind][1], HALF_DIGIT[kind][0])
    assert (np.abs(result.positions - q) <= half * (1 + 1e-4)).all()
    again = folder / f"again{SUFFIX[kind]}"
    write_robot_program(result, again, robot=robot(names, kinds))
    repeated = read_trajectory(again, period=0.01)
    np.testing.assert_array_equal(repeated.positions, result.positions)
    if kind != "krl":  # whose percentages depend on the times
        assert again.read_text().replace("motion_again", "motion_seam") == file.read_text()


# ---- what the controllers read, by other parsers -------------------------------------------------------------------


def test_urscript_is_read_by_the_parser_of_python(tmp_path: Path) -> None:
    """Calls of URScript are those of Python, but for `end`."""
    text = written(tmp_path, "urscript").read_text().removesuffix("end\n")
    (function,) = ast.parse(text).body
    assert isinstance(function, ast.FunctionDef)
    calls = [statement.value for statement in function.body if isinstance(statement, ast.Expr)]
    values = [[ast.literal_eval(each) for each in call.args] for call in calls if isinstance(call, ast.Call)]
    np.testing.assert_allclose([row[0] for row in values], Q, rtol=0, atol=0.6e-9)
    assert {tuple(row[1:3] + row[4:]) for row in values[1:]} == {(0, 0, 0.1, 300)}
    np.testing.assert_allclose(np.cumsum([row[3] for row in values[1:]]), T[1:], rtol=0, atol=1e-12)


def test_rapid_has_joint_targets_in_degrees_and_external_axes_in_mm(tmp_path: Path) -> None:
    """A target is an array of JSON; the rail comes first in the robot and last in the target."""
    names, kinds = ["rail", *SIX[:4]], ["prismatic", *ARM[:4]]
    file = written(tmp_path, "rapid", sampled(names, T, Q[:, :5]), robot=robot(names, kinds))
    moves = re.findall(r"MoveAbsJ (\[.*\])\\NoEOffs, (\S+), (\w+), tool0;", file.read_text())
    targets = [json.loads(target.replace("E+09", "e9")) for target, _, _ in moves]
    np.testing.assert_allclose([arm[:4] for arm, _ in targets], np.rad2deg(Q[:, 1:5]), rtol=0, atol=0.6e-7)
    assert {tuple(arm[4:]) for arm, _ in targets} == {(0, 0)}
    np.testing.assert_allclose([external[0] for _, external in targets], 1e3 * Q[:, 0], rtol=0, atol=0.6e-7)
    assert {tuple(external[1:]) for _, external in targets} == {(9e9,) * 5}
    assert [float(speed.partition(":=")[2] or 0) for _, speed, _ in moves] == pytest.approx([0, *np.diff(T)], abs=1e-9)
    assert [zone for *_, zone in moves] == ["fine", *["z0"] * (len(T) - 2), "fine"]


def test_krl_is_no_faster_than_the_plan_and_slower_by_less_than_a_percent_of_the_limit(tmp_path: Path) -> None:
    names, kinds = [*SIX, "rail"], [*ARM, "prismatic"]
    q = np.column_stack([Q, 4 * Q[:, 0]])
    file = written(tmp_path, "krl", sampled(names, T, q), robot=robot(names, kinds))
    percents, points, order = dict[str, int](), [], []
    for line in file.read_text().splitlines():
        if match := re.fullmatch(r"  \$VEL_(AXIS|EXTAX)\[(\d)\]=(\d+)", line):
            percents["AE"[match[1] == "EXTAX"] + match[2]] = int(match[3])
        elif match := re.fullmatch(r"  PTP \{E6AXIS: (.*)\}( C_PTP)?", line):
            points.append([float(item.split()[1]) for item in match[1].split(", ")])
            order.append(dict(percents))
    np.testing.assert_allclose(points, np.column_stack([np.rad2deg(q[:, :6]), 1e3 * q[:, 6]]), rtol=0, atol=0.6e-7)
    limits = np.arange(1.0, 8.0)
    for before, after, step, percent in zip(q[:-1], q[1:], np.diff(T), order[1:], strict=True):
        assert list(percent) == ["A1", "A2", "A3", "A4", "A5", "A6", "E1"]
        (share,) = {value / 100 for value in percent.values()}
        needed = (np.abs(after - before) / limits).max() / step
        assert share <= needed * (1 + 1e-6) < share + 0.01


def test_joints_are_written_in_the_order_of_the_controller(tmp_path: Path) -> None:
    order = SIX[::-1]
    for kind in ROBOT_LANGUAGES:
        result = read_trajectory(written(tmp_path, kind, joints=order), period=0.02)
        assert result.names == tuple(order)
        np.testing.assert_allclose(result.positions, Q[:, ::-1], rtol=0, atol=1e-8)
    zeros = np.zeros((26, 8))
    more = JointTrajectory(("x", *SIX, "y"), T, np.column_stack([T, Q, T]), zeros, zeros)
    machine = robot(["x", *SIX, "y"], ["prismatic", *ARM, "prismatic"])
    file = written(tmp_path, "urscript", more, robot=machine, joints=SIX)
    np.testing.assert_allclose(read_trajectory(file).positions, Q, rtol=0, atol=1e-9)


@pytest.mark.parametrize("stem", ["0 seam", "end", "Ünter", "a" * 40, "$(x)", "x\\n!"])
@pytest.mark.parametrize("kind", ROBOT_LANGUAGES)
def test_names_of_files_and_joints_add_no_statement(kind: str, stem: str, tmp_path: Path) -> None:
    names = [*EVIL, "] [deg]\\"]
    file = tmp_path / f"{stem}{SUFFIX[kind]}"
    write_robot_program(sampled(names, T, Q), file, robot=robot(names, ARM))
    assert read_trajectory(file, period=0.1).names == tuple(names)
    title = re.search(r"(?:def|DEF|MODULE) (\w+)", file.read_text())
    assert title is not None
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", title[1])
    assert len(title[1]) <= (24 if kind == "krl" else 32)
    assert title[1].upper() != "END"


# ---- reading -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ROBOT_LANGUAGES)
def test_spaces_and_comments_are_free(kind: str, tmp_path: Path) -> None:
    file = written(tmp_path, kind)
    before, comment = read_trajectory(file, period=0.02), ROBOT_LANGUAGES[kind].comment
    lines = file.read_text().splitlines()
    for k, line in enumerate(lines):
        if not line.strip().startswith(comment):
            lines[k] = re.sub(r"([\[\](){},=])", r" \1\t", line) + f"  {comment} a [b] = {comment}"
    text = f"\n{comment} first\r\n\n" + "\n\n".join(lines) + f"\n{comment}"
    file.write_text(text if kind == "urscript" else text.replace("MoveAbsJ", "moveabsj").replace("PTP {", "ptp {"))
    after = read_trajectory(file, period=0.02)
    assert after.names == before.names
    np.testing.assert_array_equal(after.t, before.t)
    np.testing.assert_array_equal(after.positions, before.positions)


MOVES = re.compile("movej|servoj|PTP|MoveAbsJ")
CHANGES: list[tuple[Any, str]] = [
    (lambda lines: [*lines[:12], "popup(1)", *lines[12:]], r"line 13, 'popup\(1\)': selfmotion writes no such"),
    (lambda lines: [*lines, lines[-1]], "no such statement"),
    (lambda lines: lines[1:], r"line \d+, .*no such statement"),
    (lambda lines: lines[:-1], "ends before its last statement"),
    (lambda lines: [line for line in lines if "j3 [" not in line], "line [0-9]+, .*comments name the joints of"),
    (lambda lines: [line.replace("j3 [", "j2 [") for line in lines], "name each axis and joint once"),
    (lambda lines: [line.replace("j3 [", "%ff [") for line in lines], "codec can't decode"),
    (lambda lines: [re.sub(r"(\.\d{7})", r"\g<1>" + "1" * 40, line) for line in lines], "at most 32 characters"),
    (lambda lines: [re.sub(r"-\d+\.(\d+)", "1.2.3", line) for line in lines], "is not a decimal number"),
    (lambda lines: [line for line in lines if not MOVES.search(line)], "no point|no such"),
]


@pytest.mark.parametrize("kind", ROBOT_LANGUAGES)
def test_other_contents_are_refused_by_their_line(kind: str, tmp_path: Path) -> None:
    file = written(tmp_path, kind)
    lines = file.read_text().splitlines()
    for change, words in CHANGES:
        file.write_text("\n".join(change(lines)) + "\n")
        with pytest.raises(ProblemError, match=words):
            read_trajectory(file, period=0.02)


@settings(max_examples=40)
@given(st.sampled_from(sorted(ROBOT_LANGUAGES)), st.data())
def test_changed_programs_are_refused_or_are_trajectories(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    file = written(tmp_path_factory.getbasetemp(), kind)
    text = file.read_text()[:700]
    at, length = data.draw(st.integers(0, len(text))), data.draw(st.integers(0, 3))
    inserted = data.draw(st.text(max_size=3) | st.sampled_from(["[", "]", "\\", "-", "E+", "\n", "(?i)", "9" * 40]))
    ending = file.read_text()[-700:]
    file.write_text(text[:at] + inserted + text[at + length :] + ending[ending.index("\n") :], encoding="utf-8")
    try:
        result = read_trajectory(file, period=0.02)
    except ProblemError:
        return
    assert result.positions.shape == (len(result.t), len(result.names))
    assert np.isfinite(result.positions).all()


def test_long_runs_of_signs_end_in_time(tmp_path: Path) -> None:
    """Lines of the greatest length; a pattern that searched twice would take minutes."""
    for kind in ROBOT_LANGUAGES:
        head = written(tmp_path, kind).read_text().splitlines()[:12]
        for sign in (" ", "[", "1,", "A1 1.0,", "- ", "="):
            for begin in ("", "servoj([", "PTP {E6AXIS:"):
                file = tmp_path / f"long{SUFFIX[kind]}"
                file.write_text("\n".join([*head, (begin + sign * 10_000)[:10_000], "x"]))
                with pytest.raises(ProblemError, match=r"line 1[34]"):
                    read_trajectory(file, period=0.02)


# ---- what cannot be written ----------------------------------------------------------------------------------------


def test_motions_without_a_program_are_refused_by_name(tmp_path: Path) -> None:
    eight = [*SIX, "a", "b"]
    for kind, names, kinds, words in [
        ("urscript", SIX, [*ARM[:5], "prismatic"], "none is left for the joint 'j6'"),
        ("urscript", SIX[:5], ARM[:5], "URScript moves 6 joints, not 5"),
        ("krl", eight, ["prismatic"] * 8, "KRL has 6 axes of the robot and 6 external axes.*'a'"),
    ]:
        with pytest.raises(ProblemError, match=words):
            written(tmp_path, kind, sampled(names, T, np.zeros((26, len(names)))), robot=robot(names, kinds))
    with pytest.raises(ProblemError, match=r"'nobody' does not exist"):
        written(tmp_path, "rapid", joints=["nobody"])
    with pytest.raises(ProblemError, match="distinct"):
        written(tmp_path, "rapid", joints=["j1", "j1"])
    with pytest.raises(ProblemError, match="increasing"):
        written(tmp_path, "rapid", sampled(SIX, T[::-1], Q))
    with pytest.raises(ProblemError, match="same nanosecond"):
        written(tmp_path, "rapid", sampled(SIX, 1e-10 * T, Q))
    with pytest.raises(ProblemError, match="finite"):
        written(tmp_path, "rapid", sampled(SIX, T, np.where(Q > 0.1, np.nan, Q)))
    with pytest.raises(ProblemError, match="robot"):
        write_robot_program(sampled(SIX, T, Q), tmp_path / "a.mod")
    with pytest.raises(ProblemError, match=r"end the name with"):
        write_robot_program(sampled(SIX, T, Q), tmp_path / "a.csv", robot=robot(SIX, ARM))
    free = Joint("free", "continuous", "a", "b", axis=(0, 0, 1))
    with pytest.raises(ProblemError, match=r"'free' has none"):
        written(tmp_path, "krl", sampled(["free"], T, Q[:, :1]), robot=Robot((Link("a"), Link("b")), (free,)))
    with pytest.raises(ProblemError, match="no times; give the sampling period"):
        read_trajectory(written(tmp_path, "krl"))
    assert not list(tmp_path.glob("a.*"))


# ---- the command ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [pytest.param("krl", marks=pytest.mark.long), "rapid"])
def test_an_exported_program_passes_the_check(kind: str, tmp_path: Path, capsys: Any) -> None:
    folder, file = planned(), tmp_path / f"seam{SUFFIX[kind]}"
    status, _, err = run(capsys, "export", folder / "seam.npz", file, "--period", 0.02)
    assert status == 0, err
    period = ("--period", 0.02) if kind == "krl" else ()
    status, out, _ = run(capsys, "check", folder / "seam.urdf", file, *period, "--json")
    data = json.loads(out)
    assert (status, data["faults"], data["rule"]) == (0, [], "linear")
    assert data["duration"] == pytest.approx(
        2.0 + 0.1 / 1.0 + 0.1
    )  # length / speed, and half of v/a + a/j for each ramp
    assert run(capsys, "export", folder / "seam.npz", file, "--joints", "wrist, elbow")[0] == 0  # over its own file
    assert read_trajectory(file, period=0.01).names == ("wrist", "elbow")
    file.write_text(file.read_text().replace("written by selfmotion", "mine"))
    assert run(capsys, "export", folder / "seam.npz", file)[0] == 2


def test_joints_are_selected_for_programs_alone(tmp_path: Path, capsys: Any) -> None:
    folder = planned()
    status, _, err = run(capsys, "export", folder / "seam.npz", tmp_path / "seam.csv", "--joints", "elbow")
    assert (status, "without --joints" in err) == (2, True)
    status, _, err = run(capsys, "export", folder / "seam.npz", tmp_path / "seam.script")
    assert (status, "select others: --joints" in err) == (2, True)
