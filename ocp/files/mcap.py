"""Plans as MCAP, the log format that ROS 2 and Foxglove read and play: joint states over time, and the tip's path.

Messages are those of ROS 2, written as CDR (OMG, DDS-XTypes 1.3, 7.4: little endian, each number aligned to its size,
lengths before strings and sequences). The package `mcap`, of the extra of that name, writes the file around them.
"""

from __future__ import annotations

import os
import struct
from typing import IO, Any

import numpy as np

from models.arrays import Array
from ocp.errors import ProblemError, checked_instance, checked_text
from ocp.planning import Plan
from ocp.storage import write_whole

__all__ = ["write_mcap"]

HEADER = "std_msgs/Header header\n"
BAR = "=" * 80 + "\n"
HEADER_PARTS = (
    f"{BAR}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{BAR}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
SCHEMAS = {
    "sensor_msgs/msg/JointState": HEADER
    + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + HEADER_PARTS,
    "nav_msgs/msg/Path": HEADER
    + "geometry_msgs/PoseStamped[] poses\n"
    + f"{BAR}MSG: geometry_msgs/PoseStamped\n{HEADER}geometry_msgs/Pose pose\n"
    + f"{BAR}MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    + f"{BAR}MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    + f"{BAR}MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    + HEADER_PARTS,
}


def write_mcap(plan: Plan, file: str | os.PathLike[str], period: float = 0.01, *, frame: str = "world") -> None:
    """Write the joints every `period` s as sensor_msgs/msg/JointState on `/joint_states`, with velocities, and the
    tip's poses at the same times as one nav_msgs/msg/Path on `/tip_path`, where the robot has a tip.

    The first is at 0 s of the log's time.

    Args:
        plan: To be written. file: Whole or as it was before. period: s.
        frame: The name of the world in the messages.

    Raises:
        ProblemError: No plan, a period that is not positive, or the package `mcap` is not installed.
        OSError: The file cannot be written.
    """
    checked_instance("plan", plan, Plan)
    checked_text("frame", frame)
    try:
        from mcap.writer import Writer
    except ImportError as error:
        words = "MCAP is written by the package mcap: pip install 'selfmotion[mcap]'"
        raise ProblemError(words, name="mcap") from error
    sample = plan.sample(period)
    stamps = np.round(sample.t * 1e9).astype(np.int64).tolist()

    def write(stream: IO[bytes]) -> None:
        writer: Any = Writer(stream)
        writer.start(profile="ros2", library="selfmotion")
        channels = {}
        for topic, name in (("/joint_states", "sensor_msgs/msg/JointState"), ("/tip_path", "nav_msgs/msg/Path")):
            schema = writer.register_schema(name=name, encoding="ros2msg", data=SCHEMAS[name].encode())
            channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
        if np.isfinite(sample.tip).all():
            data = _path(stamps, sample.tip, frame)
            writer.add_message(channel_id=channels["/tip_path"], log_time=0, publish_time=0, data=data)
        for number, (stamp, joints, rates) in enumerate(zip(stamps, sample.joints, sample.rates, strict=True)):
            writer.add_message(
                channel_id=channels["/joint_states"],
                log_time=stamp,
                publish_time=stamp,
                data=_joint_state(stamp, plan.names, joints, rates),
                sequence=number,
            )
        writer.finish()

    write_whole(file, write)


class _Message:
    """A message as CDR."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")  # little endian, no options

    def numbers(self, kind: str, *values: float) -> None:
        """Numbers of one kind of `struct`, aligned to their size from behind the first four bytes."""
        size = struct.calcsize(kind)
        self.data += bytes(-(len(self.data) - 4) % size)
        self.data += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        written = text.encode() + b"\x00"
        self.numbers("I", len(written))
        self.data += written

    def header(self, stamp: int, frame: str) -> None:
        seconds, nanoseconds = divmod(stamp, 10**9)
        self.numbers("i", seconds)
        self.numbers("I", nanoseconds)
        self.text(frame)

    def sequence(self, values: Array) -> None:
        self.numbers("I", len(values))
        if len(values):
            self.numbers("d", *values.tolist())


def _joint_state(stamp: int, names: tuple[str, ...], joints: Array, rates: Array) -> bytes:
    message = _Message()
    message.header(stamp, "")
    message.numbers("I", len(names))
    for name in names:
        message.text(name)
    for values in (joints, rates, np.zeros(0)):
        message.sequence(values)
    return bytes(message.data)


def _path(stamps: list[int], poses: Array, frame: str) -> bytes:
    message = _Message()
    message.header(0, frame)
    message.numbers("I", len(stamps))
    for stamp, (x, y, z, w, i, j, k) in zip(stamps, poses.tolist(), strict=True):
        message.header(stamp, frame)
        message.numbers("d", x, y, z, i, j, k, w)
    return bytes(message.data)
