"""One motion, written as everybody writes it, is read the same; what is no trajectory is refused by line."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import Writer
from mcap_ros2.writer import Writer as RosWriter
from numpy.testing import assert_allclose

from ocp import ProblemError
from ocp.app.files import RawTrajectory, read_trajectory
from ocp.motion.schedule import JointTrajectory

T = np.linspace(0.0, 1.0, 11)
Q = np.column_stack([np.sin(T), 0.1 * T**2, -T])
V = np.column_stack([np.cos(T), 0.2 * T, -np.ones(11)])
A = np.column_stack([-np.sin(T), 0.2 * np.ones(11), np.zeros(11)])
NAMES = ("j1", "j2", "j3")
JOINT_TRAJECTORY = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
================================================================================
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
================================================================================
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
JOINT_STATE = JOINT_TRAJECTORY.replace(
    JOINT_TRAJECTORY[: JOINT_TRAJECTORY.index("=" * 80 + "\nMSG: std_msgs")],
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
)


def table(head: list[str], columns: Any, sign: str = ",", end: str = "\n", comma: str = ".") -> str:
    rows = [sign.join(repr(value).replace(".", comma) for value in row) for row in np.column_stack(columns).tolist()]
    return end.join([sign.join(head), *rows]) + end


def read(folder: Path, text: str | bytes, name: str = "motion.csv", **options: Any) -> RawTrajectory:
    file = folder / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_trajectory(file, **options)


def same(result: RawTrajectory, rates: bool = True, accelerations: bool = False) -> None:
    order = [result.names.index(name) for name in NAMES]
    assert_allclose(result.t, T, atol=1e-9)
    assert_allclose(result.positions[:, order], Q, atol=1e-12)
    if rates:
        assert result.velocities is not None
        assert_allclose(result.velocities[:, order], V, atol=1e-12)
    if accelerations:
        assert result.accelerations is not None
        assert_allclose(result.accelerations[:, order], A, atol=1e-12)


@pytest.mark.parametrize(
    ("sign", "end", "comma", "mark"),
    [(",", "\n", ".", ""), (";", "\r\n", ",", "\ufeff"), ("\t", "\r", ".", ""), (" ", "\n", ".", "")],
)
@pytest.mark.parametrize("words", ["{}.velocity", "{}_vel", "velocity/{}", "{}/velocity", "qd_{}", "{}:vel"])
def test_a_table_of_any_dialect(tmp_path: Path, sign: str, end: str, comma: str, mark: str, words: str) -> None:
    head = ["j2", "time_from_start", "j3", "j1", *(words.format(name) for name in NAMES)]
    text = mark + table(head, [Q[:, 1], T, Q[:, 2], Q[:, 0], *V.T], sign, end, comma)
    same(read(tmp_path, text))


def test_units_in_the_head(tmp_path: Path) -> None:
    head = ["t [ms]", "j1 [deg]", "j2 (mm)", "j3[rad]", "j1_vel [deg/s]", "j2_vel [mm/s]", "j3_vel"]
    columns = [1e3 * T, np.degrees(Q[:, 0]), 1e3 * Q[:, 1], Q[:, 2], np.degrees(V[:, 0]), 1e3 * V[:, 1], V[:, 2]]
    result = read(tmp_path, table(head, columns))
    same(result)
    assert len(result.notes) == 5
    with pytest.raises(ProblemError, match="parsecs"):
        read(tmp_path, table(["t", "j1 [parsecs]"], [T, T]))


def test_tables_of_the_package_are_read(tmp_path: Path) -> None:
    trajectory = JointTrajectory(NAMES, T, Q, V, A)
    trajectory.write_csv(tmp_path / "a.csv")
    same(read_trajectory(tmp_path / "a.csv"), accelerations=True)
    same(read(tmp_path, json.dumps(trajectory.to_ros()), "a.json"), accelerations=True)
    nested = {"goal": {"trajectory": trajectory.to_ros()}}
    same(read(tmp_path, json.dumps(nested), "b.json"), accelerations=True)
    same(read(tmp_path, yaml.safe_dump(trajectory.to_ros()) + "---\n", "a.yaml"), accelerations=True)


def test_logs_that_others_write(tmp_path: Path) -> None:
    points = [
        {"positions": q, "velocities": v, "accelerations": [], "effort": [], "time_from_start": stamp(t)}
        for t, q, v in zip(T, Q.tolist(), V.tolist(), strict=True)
    ]
    with open(tmp_path / "log.mcap", "wb") as stream:
        writer: Any = RosWriter(stream)
        state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        whole = writer.register_msgdef("trajectory_msgs/msg/JointTrajectory", JOINT_TRAJECTORY)
        for k, t in enumerate(T):
            order = [k % 3, (k + 1) % 3, (k + 2) % 3]  # drivers change it
            by_name = {
                "header": {"stamp": stamp(100 + t), "frame_id": "cell"},
                "name": [NAMES[i] for i in order],
                "position": Q[k, order].tolist(),
                "velocity": V[k, order].tolist(),
                "effort": [],
            }
            writer.write_message("/joint_states", state, by_name, log_time=k)
        gripper = {"header": {"stamp": stamp(100), "frame_id": ""}, "name": ["g"], "position": [1.0]}
        writer.write_message("/joint_states", state, gripper | {"velocity": [0.0], "effort": []})
        header = {"stamp": stamp(0), "frame_id": ""}
        writer.write_message("/plan", whole, {"header": header, "joint_names": list(NAMES), "points": points})
        writer.finish()
    trajectory = read_trajectory(tmp_path / "log.mcap")
    same(trajectory)
    assert any("1 of 12 messages" in note for note in trajectory.notes)
    same(read_trajectory(tmp_path / "log.mcap", topic="/plan"))
    with pytest.raises(ProblemError, match="/joint_states, /plan"):
        read_trajectory(tmp_path / "log.mcap", topic="/nothing")


def stamp(t: float) -> dict[str, int]:
    nanoseconds = round(t * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


@pytest.mark.parametrize("data", [b"", b"\x00\x01\x00\x00", struct.pack("<4BiIII", 0, 1, 0, 0, 1, 1, 0, 2**31)])
def test_a_message_that_ends_too_early(tmp_path: Path, data: bytes) -> None:
    with open(tmp_path / "log.mcap", "wb") as stream:
        writer: Any = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        channel = writer.register_channel("/joint_states", "cdr", schema)
        writer.add_message(channel, 0, data, 0)
        writer.finish()
    with pytest.raises(ProblemError, match="not a valid log"):
        read_trajectory(tmp_path / "log.mcap")


def test_faults_are_kept_with_their_lines(tmp_path: Path) -> None:
    result = read(tmp_path, "# a comment\ntime,j1\n2,nan\n\n1,\n1,inf,\n")
    assert result.t.tolist() == [2.0, 1.0, 1.0]
    assert np.isnan(result.positions[:2, 0]).all()
    assert np.isinf(result.positions[2, 0])
    assert result.lines.tolist() == [3, 5, 6]


def test_a_joint_whose_name_looks_like_another_quantity(tmp_path: Path) -> None:
    text = "time,t,arm_vel,a\n0,1,2,3\n"
    assert read(tmp_path, text, joints=("t", "arm_vel")).names == ("t", "arm_vel", "a")
    with pytest.raises(ProblemError, match="two columns are the time"):
        read(tmp_path, text)
    assert read(tmp_path, "time,/robot/arm/position\n0,1\n", joints=("arm",)).names == ("arm",)


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("time,a\n0,1\n1,2,3\n", "a.csv", "line 3.*3 columns"),
        ("time,a\n0,1\n1,x\n", "a.csv", "line 3.*'x' is not a number"),
        ("0,1\n1,2\n", "a.csv", "line 1.*no head"),
        ("a,b\n0,1\n", "a.csv", "no column is the time"),
        ("time,a,a\n0,1,2\n", "a.csv", "two columns are named"),
        ("time,a.velocity\n0,1\n", "a.csv", "no column is a position"),
        ("time,a\n", "a.csv", "no sample"),
        ("{", "a.json", "is not valid JSON"),
        ("[[]]", "a.json", "joint_names and points"),
        ('{"joint_names": ["a"], "points": []}', "a.json", "at least one point"),
        ('{"joint_names": ["a"], "points": [{"positions": [1]}]}', "a.json", "point 1: time_from_start"),
        ('{"joint_names": ["a"], "points": [{"time_from_start": 0}]}', "a.json", "point 1 has no positions"),
        ('{"joint_names": ["a", "a"], "points": [{}]}', "a.json", "distinct names"),
        ('{"joint_names": ["a"], "points": [{"positions": ["x"], "time_from_start": 0}]}', "a.json", "not numbers"),
        ("a: [", "a.yaml", "is not valid YAML"),
        ("no log", "a.mcap", "not a valid log"),
    ],
)
def test_invalid_trajectories_are_refused(tmp_path: Path, text: str, name: str, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        read(tmp_path, text, name)
    assert caught.value.name
