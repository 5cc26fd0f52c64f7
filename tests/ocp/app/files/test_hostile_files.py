"""A file from a stranger ends in time and memory: no device is read, no pipe waited for, no bomb unpacked."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from models import ModelError, Robot, named_states, planar_chain
from models.files import INPUT_LIMITS, UnfitFile, open_regular, parse_xml, read_regular
from models.shapes.mesh_files import read_mesh
from models.shapes.pairs import checked_pairs
from ocp import ProblemError, Solution
from ocp.app.files import read_gcode, read_joint_limits, read_trajectory, read_waypoints, safe_files
from ocp.app.files.safe_files import read_tree
from ocp.app.files.settings import read_obstacles
from ocp.app.files.task_file import read_task
from ocp.motion.schedule import JointTrajectory

READERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "URDF": (".urdf", Robot.from_urdf),
    "SRDF": (".srdf", lambda file: checked_pairs(planar_chain([1.0, 1.0], [1.0, 1.0]), [], srdf=file)),
    "states": (".srdf", lambda file: named_states(file, planar_chain([1.0, 1.0], [1.0, 1.0]))),
    "joint limits": (".yaml", lambda file: read_joint_limits(file, planar_chain([1.0, 1.0], [1.0, 1.0]))),
    "STL": (".stl", read_mesh),
    "OBJ": (".obj", read_mesh),
    "DAE": (".dae", read_mesh),
    "G-code": (".ngc", read_gcode),
    "waypoints": (".csv", read_waypoints),
    "trajectory": (".csv", read_trajectory),
    "JSON": (".json", read_trajectory),
    "YAML": (".yaml", read_trajectory),
    "MCAP": (".mcap", read_trajectory),
    "URScript": (".script", read_trajectory),
    "KRL": (".src", read_trajectory),
    "RAPID": (".mod", read_trajectory),
    "task": (".toml", read_task),
    "obstacles": (".toml", read_obstacles),
    "sampled": (".csv", JointTrajectory.read_csv),
    "solution": (".npz", Solution.load),
}


def special(what: str, place: Path) -> None:
    """Something that is no file, at a place."""
    if what == "pipe":
        os.mkfifo(place)
    elif what == "folder":
        place.mkdir()
    elif what == "socket":
        with socket.socket(socket.AF_UNIX) as result:
            os.chdir(place.parent)  # names of sockets are short
            result.bind(place.name)
    else:
        place.symlink_to({"link to a device": "/dev/zero", "link to a terminal": "/dev/tty"}.get(what, "pipe"))
        if what == "link to a pipe":
            os.mkfifo(place.parent / "pipe")


@pytest.mark.parametrize(
    "what", ["pipe", "folder", "socket", "link to a device", "link to a pipe", "link to a terminal"]
)
@pytest.mark.parametrize("reader", READERS)
def test_invalid_files_are_refused_at_once(
    reader: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    suffix, read = READERS[reader]
    special(what, tmp_path / f"file{suffix}")
    with pytest.raises((ModelError, ProblemError), match="no file, but a folder, a pipe or a device"):
        read(tmp_path / f"file{suffix}")


@pytest.mark.parametrize("reader", READERS)
def test_a_file_that_is_too_large_is_not_read(reader: str, tmp_path: Path) -> None:
    """A file of a terabyte, all of it a hole."""
    suffix, read = READERS[reader]
    (tmp_path / f"file{suffix}").touch()
    os.truncate(tmp_path / f"file{suffix}", 2**40)
    with pytest.raises((ModelError, ProblemError), match=r"1099511627776 bytes|longer than \d+ MB"):
        read(tmp_path / f"file{suffix}")


def test_a_file_that_is_exchanged_between_two_looks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, whole = tmp_path / "a", os.stat
    good.write_bytes(b"x")

    def exchanged(path: Any, *more: Any, **others: Any) -> os.stat_result:
        result = whole(path, *more, **others)
        if str(path) == str(good):
            good.unlink()
            os.mkfifo(good)
        return result

    monkeypatch.setattr(os, "stat", exchanged)
    with pytest.raises(UnfitFile, match="no file"):
        open_regular(good, 10)
    monkeypatch.undo()
    with pytest.raises(UnfitFile, match="at most 1000 are read") as caught:  # the system says 0 bytes of it
        read_regular("/proc/kallsyms" if os.path.getsize("/proc/self/maps") else "/proc/self/maps", 1000)
    assert caught.value.limit == 1000


# ---- XML -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("what", ['"x"', 'SYSTEM "file:///etc/passwd"'])
def test_entities_are_not_read_in_any_encoding(encoding: str, what: str, tmp_path: Path) -> None:
    declared = "utf-16" if encoding == "utf-16-le" else encoding
    text = f'<?xml version="1.0" encoding="{declared}"?><!DOCTYPE robot [<!ENTITY a {what}>]><robot name="&a;"/>'
    for suffix, read in (READERS[kind] for kind in ("URDF", "SRDF", "DAE")):
        (tmp_path / f"a{suffix}").write_bytes(text.encode(encoding))
        with pytest.raises(ModelError, match="entities"):
            read(tmp_path / f"a{suffix}")


def test_elements_and_attributes_are_counted_before_they_are_read() -> None:
    for text in (
        "<a>" + "<b/>" * INPUT_LIMITS.xml_elements + "</a>",
        "<a " + " ".join(f"b{k}=''" for k in range(1000)) * 1100 + "/>",
    ):
        with pytest.raises(ValueError, match="elements and attributes"):
            parse_xml(text)
        with pytest.raises(ModelError, match="elements and attributes"):
            Robot.from_urdf(text)
    assert len(parse_xml("<a>" + "<b/>" * 1000 + "</a>")) == 1000


# ---- trees ---------------------------------------------------------------------------------------------------------

LAUGHS = "\n".join(f"{a}: &{a} [{', '.join([f'*{b}'] * 100)}]" for a, b in zip("bcdefg", "abcdef", strict=True))
BOMBS = {
    "aliases": f"a: &a [x]\n{LAUGHS}\n",
    "aliases as names": f"a: &a [x]\n{LAUGHS}\njoint_names: *g\npoints: *g\n",
    "merged mappings": "a: &a {x: 1}\n"
    + "\n".join(f"{b}: &{b}\n  <<: [{', '.join([f'*{a}'] * 50)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "a ring": "a: &a [*a]\njoint_names: *a\npoints: *a\n",
    "a deep list": "[" * 100_000,
    "deep mappings": "\n".join(" " * k + "a:" for k in range(2000)),
    "sixties": "joint_names: [a]\npoints: [{positions: [1" + ":59" * 1_000_000 + "], time_from_start: 0}]",
    "many values": "joint_names: [" + "a," * 10_001 + "]",
    "a tag": "!!python/object/apply:os.system ['touch PWNED']",
    "code": "joint_names: [a]\npoints: !!python/name:os.system\n",
    "an undefined alias": "a: *b",
    "a list as a key": "? [a]\n: 1",
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_tree_of_yaml_is_bounded(bomb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if bomb == "many values":
        monkeypatch.setattr(safe_files, "INPUT_LIMITS", replace(INPUT_LIMITS, tree_values=10_000))
    (tmp_path / "a.yaml").write_text(BOMBS[bomb])
    with pytest.raises(ProblemError):
        read_trajectory(tmp_path / "a.yaml")
    assert [file.name for file in tmp_path.iterdir()] == ["a.yaml"]


def test_a_few_aliases_are_read_and_numbers_are_those_of_yaml(tmp_path: Path) -> None:
    text = """%YAML 1.1
---
joint_names: &names [a, "2", yes, nan]
same: *names
points:
  - {positions: &p [1, -2.5, 1_000, .5e-3], velocities: [.inf, -.inf, .nan, ~], time_from_start: {secs: 0, nsecs: 0}}
  - {positions: *p, velocities: [1., 2, 3, 4], time_from_start: 1.5}
"""
    (tmp_path / "a.yaml").write_text(text)
    tree, whole = read_tree(tmp_path / "a.yaml", "yaml"), yaml.safe_load(text)
    assert tree["joint_names"] == ["a", "2", "yes", "nan"] == tree["same"]
    for one, other in zip(tree["points"], whole["points"], strict=True):
        assert one["positions"] == [1.0, -2.5, 1000.0, 0.0005] == other["positions"]
        assert str(one["velocities"]) == str([v if v is None else float(v) for v in other["velocities"]])
    trajectory = read_trajectory(tmp_path / "a.yaml")
    assert (trajectory.names, trajectory.t.tolist()) == (("a", "2", "yes", "nan"), [0.0, 1.5])


@pytest.mark.parametrize(
    "text",
    [
        "[" * 10**6,
        "[" * (INPUT_LIMITS.nesting + 2) + "]" * (INPUT_LIMITS.nesting + 2),
        "[" + "0," * INPUT_LIMITS.tree_values + "0]",
        "9" * 5000,
        '{"a": 1e999, "joint_names": [' + "[" * 60 + "]" * 60 + '], "points": []}',
    ],
    ids=range(5),
)
def test_a_tree_of_json_is_bounded(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ProblemError):
        read_trajectory(tmp_path / "a.json")


@pytest.mark.parametrize(
    "text",
    [
        "x = '''\n[" + " " * 9900 + "\n'''",
        "x = '''\na" + " " * 9900 + "\n'''",
        "x = " + "[" * 5000,
        "x = " + "[" * 90 + "]" * 90,
        "\n".join(f"{'.'.join(['a'] * 4000)}.b{k} = 1" for k in range(40)),
        "x = " + "9" * 9000,
        "[" + ".".join(["a"] * 4000) + "]",
    ],
    ids=range(7),
)
def test_a_table_of_toml_is_bounded(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ProblemError):
        read_obstacles(tmp_path / "a.toml")


@pytest.mark.parametrize(
    "line", ["(" + " " * 9900, "time," + "( " * 4900, "x" + " " * 9900 + "?", "a,b" + " " * 9000 + "[x]"], ids=range(4)
)
def test_heads_of_tables_are_read_in_time(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text((line + "\n") * 20)
    for read in (read_trajectory, read_waypoints):
        with pytest.raises(ProblemError):
            read(tmp_path / "a.csv")


# ---- logs ----------------------------------------------------------------------------------------------------------


def packed(path: Path, size: int, message: int) -> None:
    """A log with a chunk of zeros, packed by zstd, that says to have another size."""
    builder: Any = RecordBuilder()
    compressor = zstandard.ZstdCompressor().compressobj()
    data = b"".join(compressor.compress(bytes(2**24)) for _ in range(size >> 24)) + compressor.flush()
    Chunk("zstd", data, 0, 0, 0, message).write(builder)
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())


def test_a_log_that_unpacks_to_gigabytes_takes_no_memory(tmp_path: Path) -> None:
    """46 kB that were 3 GB."""
    packed(tmp_path / "true.mcap", 3 * 2**29, 3 * 2**29)
    packed(tmp_path / "lying.mcap", 3 * 2**29, 1000)
    assert (tmp_path / "true.mcap").stat().st_size < 100_000
    done = run(f"""
        import resource
        from ocp import ProblemError
        from ocp.app.files import read_trajectory
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for name in ("true", "lying"):
            try:
                read_trajectory({str(tmp_path)!r} + f"/{{name}}.mcap")
            except ProblemError as error:
                print("refused")
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000)
    """)
    assert done.split() == ["refused", "refused", "True"]


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=100)
    assert not done.returncode, done.stderr
    return done.stdout


# ---- what is written -----------------------------------------------------------------------------------------------


def test_writers_do_not_wait_for_a_pipe(tmp_path: Path) -> None:
    """Leftovers of killed writers are looked at, and a stranger's folder may hold a pipe of such a name."""
    os.mkfifo(tmp_path / "a.csv.01234567.part")
    JointTrajectory(("a",), [0.0], [[1.0]], [[0.0]], [[0.0]]).write_csv(tmp_path / "a.csv")  # type: ignore[arg-type]
    assert (tmp_path / "a.csv").exists()


def test_the_urdf_is_not_written_through_a_link(tmp_path: Path) -> None:
    """Not by the name that a file bears until it is whole."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "a.urdf.part").symlink_to(victim)
    planar_chain([1.0, 1.0], [1.0, 1.0]).to_urdf(tmp_path / "a.urdf")
    assert victim.read_text() == "mine"
    assert Robot.from_urdf(tmp_path / "a.urdf").dof == 2
