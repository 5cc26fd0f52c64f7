"""Plans written as MCAP, read again by the readers of others."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from models import FixedBase, planar_chain
from ocp import Plan, ProblemError, TipTask, plan
from ocp.files import write_mcap


@cache
def motion() -> Plan:
    machine = FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0, 1.0, 1.0]))
    task = TipTask(rows=(3, 4), velocity=(0.1, -0.05))
    return plan(machine, task, 1.0, start=np.array([0.3, 0.7, 0.5]))


def messages(file: Path) -> list[tuple[str, int, Any]]:
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, note.log_time, told) for _, channel, note, told in reader.iter_decoded_messages()]


def test_joint_states_and_the_tips_path_are_read_as_they_are(tmp_path: Path) -> None:
    write_mcap(motion(), tmp_path / "a.mcap", 0.03, frame="cell")
    found = messages(tmp_path / "a.mcap")
    sample = motion().sample(0.03)
    states = [(time, told) for topic, time, told in found if topic == "/joint_states"]
    assert [time for time, _ in states] == np.round(sample.t * 1e9).astype(int).tolist()
    for number, (time, told) in enumerate(states):
        assert tuple(told.name) == motion().names
        assert told.header.stamp.sec * 10**9 + told.header.stamp.nanosec == time
        np.testing.assert_array_equal(told.position, sample.joints[number])
        np.testing.assert_array_equal(told.velocity, sample.rates[number])
        assert not told.effort
    (path,) = (told for topic, _, told in found if topic == "/tip_path")
    assert path.header.frame_id == "cell"
    assert len(path.poses) == len(sample.t)
    for pose, wanted in zip(path.poses, sample.tip, strict=True):
        place, turn = pose.pose.position, pose.pose.orientation
        np.testing.assert_array_equal([place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z], wanted)


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), "0.1", None])
def test_a_bad_period_leaves_no_file(tmp_path: Path, period: Any) -> None:
    with pytest.raises(ProblemError, match="period"):
        write_mcap(motion(), tmp_path / "a.mcap", period)
    assert not list(tmp_path.iterdir())


def test_something_else_is_no_plan(tmp_path: Path) -> None:
    with pytest.raises(ProblemError) as caught:
        write_mcap("plan", tmp_path / "a.mcap")  # type: ignore[arg-type]
    assert caught.value.name == "plan"
