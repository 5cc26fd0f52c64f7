"""Plans written as MCAP: the bytes of their messages, worked out by the rules of CDR, and what is read again."""

from __future__ import annotations

import struct
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from models import FixedBase, planar_chain
from ocp import Plan, ProblemError, TipTask, plan
from ocp.app.files import read_trajectory, write_mcap


@cache
def motion() -> Plan:
    machine = FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0, 1.0, 1.0]))
    task = TipTask(rows=(3, 4), velocity=(0.1, -0.05))
    return plan(machine, task, 1.0, start=np.array([0.3, 0.7, 0.5]))


def messages(file: Path) -> list[tuple[str, int, Any]]:
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, note.log_time, report) for _, channel, note, report in reader.iter_decoded_messages()]


def test_joint_states_and_the_tips_path_are_read_as_they_are(tmp_path: Path) -> None:
    write_mcap(motion(), tmp_path / "a.mcap", 0.03, frame="cell")
    result = messages(tmp_path / "a.mcap")
    sample = motion().sample(0.03)
    states = [(time, report) for topic, time, report in result if topic == "/joint_states"]
    assert [time for time, _ in states] == np.round(sample.t * 1e9).astype(int).tolist()
    for number, (time, report) in enumerate(states):
        assert tuple(report.name) == motion().names
        assert report.header.stamp.sec * 10**9 + report.header.stamp.nanosec == time
        np.testing.assert_array_equal(report.position, sample.joints[number])
        np.testing.assert_array_equal(report.velocity, sample.rates[number])
        assert not report.effort
    (path,) = (report for topic, _, report in result if topic == "/tip_path")
    assert path.header.frame_id == "cell"
    assert len(path.poses) == len(sample.t)
    for pose, wanted in zip(path.poses, sample.tip, strict=True):
        place, turn = pose.pose.position, pose.pose.orientation
        np.testing.assert_array_equal([place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z], wanted)


def sequence(values: Any) -> bytes:
    return struct.pack("<I", len(values)) + b"".join(struct.pack("<d", value) for value in values)


def test_a_joint_state_has_the_bytes_of_cdr(tmp_path: Path) -> None:
    """OMG, DDS-XTypes 1.3, 7.4.

    Little endian, numbers aligned to their size from behind the first four bytes, texts and sequences with their length
    before them, texts with a zero at their end, which counts.
    """
    write_mcap(motion(), tmp_path / "a.mcap", 0.25)
    with (tmp_path / "a.mcap").open("rb") as stream:
        notes = [note.data for _, channel, note in make_reader(stream).iter_messages(topics=["/joint_states"])]
    sample = motion().sample(0.25)
    head = struct.pack("<iI", 0, 250_000_000) + struct.pack("<I", 1) + b"\0"
    names = struct.pack("<I", 3)
    for name in motion().names:
        names += struct.pack("<I", len(name) + 1) + name.encode() + b"\0"
        names += bytes(-(len(head) + 3 + len(names)) % 4)
    body = head + bytes(3) + names
    body += struct.pack("<I", 3)
    body += bytes(-len(body) % 8) + sequence(sample.joints[1])[4:]
    body += struct.pack("<I", 3)
    body += bytes(-len(body) % 8) + sequence(sample.rates[1])[4:]
    assert notes[1] == b"\0\1\0\0" + body + struct.pack("<I", 0)


def test_messages_are_read_by_their_names_not_by_the_definition_that_a_file_brings(tmp_path: Path) -> None:
    """One that asks for 8e9 numbers is never looked at."""
    write_mcap(motion(), tmp_path / "a.mcap", 0.25)
    with (tmp_path / "a.mcap").open("rb") as stream:
        notes = [(note.log_time, note.data) for _, _, note in make_reader(stream).iter_messages(["/joint_states"])]
    with (tmp_path / "b.mcap").open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start("ros2")
        lie = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"float64[999999999] name\n" * 8)
        channel = writer.register_channel("/joint_states", "cdr", lie)
        for time, data in notes:
            writer.add_message(channel, time, data, time)
        writer.finish()
    result, wanted = (read_trajectory(tmp_path / name) for name in ("b.mcap", "a.mcap"))
    np.testing.assert_array_equal(result.positions, wanted.positions)
    assert result.names == motion().names


@pytest.mark.parametrize("seed", range(3))
def test_mutated_messages_are_read_or_refused_with_an_error_of_the_package(tmp_path: Path, seed: int) -> None:
    write_mcap(motion(), tmp_path / "a.mcap", 0.25)
    with (tmp_path / "a.mcap").open("rb") as stream:
        note = next(note.data for _, _, note in make_reader(stream).iter_messages(["/joint_states"]))
    rng = np.random.default_rng(seed)
    for _ in range(60):
        data = bytearray(note)
        for place in rng.integers(len(data), size=3):
            data[place] = rng.choice([0, 1, 127, 255])
        with (tmp_path / "b.mcap").open("wb") as stream:
            writer: Any = Writer(stream)
            writer.start("ros2")
            channel = writer.register_channel(
                "/joint_states", "cdr", writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
            )
            writer.add_message(channel, 0, bytes(data[: rng.integers(1, len(data) + 1)]), 0)
            writer.finish()
        with suppress(ProblemError):
            read_trajectory(tmp_path / "b.mcap")


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), "0.1", None])
def test_a_bad_period_leaves_no_file(tmp_path: Path, period: Any) -> None:
    with pytest.raises(ProblemError, match="period"):
        write_mcap(motion(), tmp_path / "a.mcap", period)
    assert not list(tmp_path.iterdir())


def test_other_objects_are_no_plans(tmp_path: Path) -> None:
    with pytest.raises(ProblemError) as caught:
        write_mcap("plan", tmp_path / "a.mcap")  # type: ignore[arg-type]
    assert caught.value.name == "plan"
