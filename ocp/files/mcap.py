"""MCAP, the log format that ROS 2 and Foxglove read and play: joint states over time, and the tip's path.

Messages are those of ROS 2, written as CDR (OMG, DDS-XTypes 1.3, 7.4: little endian, each number aligned to its size,
lengths before strings and sequences). The package `mcap`, of the extra of that name, knows the file around them.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from typing import IO, Any

import numpy as np

from models.arrays import Array
from models.input_files import open_regular
from ocp.errors import ProblemError, checked_instance, checked_text
from ocp.planning import Plan
from ocp.storage import write_whole

__all__ = ["read_joint_messages", "write_mcap"]

LARGEST_LOG, MOST_UNPACKED, LARGEST_RECORD = 2**30, 2**30, 2**26
"""Bytes: of a log's file, of all that it unpacks to, and of one record or chunk, unpacked."""
MOST_OF_JOINTS = 2**26
"""Bytes of all messages that are kept: they take five times as much memory."""
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


# ---- reading -----------------------------------------------------------------------------------------------------


def read_joint_messages(file: str | os.PathLike[str], topic: str | None = None) -> tuple[str, list[tuple[int, Any]]]:
    """The joint states, or joint trajectories, of one topic of a log: the topic; stamps, ns, and messages by fields.

    A stamp is that of the message's header, or where that is zero the log's own.

    Args:
        file: As ROS 2 writes it, in CDR.
        topic: Its name; None: the only one of these kinds, or `/joint_states`.

    Raises:
        ProblemError: No such file, no log, no such topic, or the package `mcap` is not installed.
    """
    try:
        from mcap.records import Channel, Message, Schema
    except ImportError as error:
        words = "MCAP is read by the package mcap: pip install 'selfmotion[mcap]'"
        raise ProblemError(words, name="mcap") from error
    found: dict[str, list[tuple[int, int, Any]]] = {}
    schemas: dict[int, Any] = {}
    channels: dict[int, tuple[str, Any]] = {}  # topics, and how their messages are read
    size = 0
    try:
        with open_regular(file, LARGEST_LOG) as stream:
            for record in _records(stream):
                if isinstance(record, Schema):
                    schemas[record.id] = READERS.get(record.name)
                elif isinstance(record, Channel) and record.message_encoding == "cdr":
                    channels[record.id] = record.topic, schemas.get(record.schema_id)
                elif isinstance(record, Message):
                    name, read = channels.get(record.channel_id, ("", None))
                    if read is not None:
                        size += len(record.data)
                        if size > MOST_OF_JOINTS:
                            raise ValueError(f"its messages of joints have more than {MOST_OF_JOINTS} bytes; split it")
                        told = read(_Cursor(record.data))
                        stamp = told.pop("stamp") or record.log_time
                        found.setdefault(name, []).append((record.log_time, stamp, told))
    except OSError as error:
        raise ProblemError(f"{file}: cannot be read: {error.strerror}", name="file", value=str(file)) from error
    except Exception as error:  # what mcap, zstandard and lz4 say of broken bytes is of many kinds
        raise ProblemError(f"{file} is no log that can be read: {error}", name="file", value=str(file)) from error
    chosen = topic
    if topic is None and len(found) == 1:
        chosen = next(iter(found))
    elif topic is None and "/joint_states" in found:
        chosen = "/joint_states"
    if chosen not in found:
        known = ", ".join(sorted(found)) or "none"
        words = f"{file}: no topic {topic!r} of joint states or joint trajectories; there are: {known}; tell the topic"
        raise ProblemError(words, name="topic", value=topic, limit=tuple(found))
    return chosen, [(stamp, told) for _, stamp, told in sorted(found[chosen], key=lambda one: one[0])]


def _records(stream: IO[bytes]) -> Iterator[Any]:
    """The records of a log in the order of its file, those in its chunks too.

    Raises:
        ValueError: A record is too large, or all that it unpacks to.
    """
    from mcap.exceptions import EndOfFile
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    room = MOST_UNPACKED
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST_RECORD).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        room -= record.uncompressed_size
        if record.uncompressed_size > LARGEST_RECORD or room < 0:
            raise ValueError(f"it unpacks to more than {MOST_UNPACKED} bytes, or a part of it to {LARGEST_RECORD}")
        with suppress(EndOfFile):
            yield from StreamReader(io.BytesIO(_unpacked(record)), skip_magic=True).records


def _unpacked(chunk: Any) -> bytes:
    """The contents of a chunk, never more than it says that it has."""
    data, size = chunk.data, chunk.uncompressed_size
    if chunk.compression == "zstd":
        zstd = import_module("zstandard").ZstdDecompressor(max_window_size=LARGEST_RECORD)
        data = zstd.stream_reader(data).read(size + 1)
    elif chunk.compression == "lz4":
        data = import_module("lz4.frame").LZ4FrameDecompressor().decompress(data, size + 1)
    if len(data) != size:
        raise ValueError("a chunk does not unpack to the size that it says")
    return bytes(data)


class _Cursor:
    """A place in a message of CDR."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[1] not in (0, 1):
            raise ValueError("a message is no plain CDR")
        self.order = "<" if data[1] else ">"
        self.data, self.place = memoryview(data)[4:], 0

    def numbers(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        size = struct.calcsize(kind)
        self.place += -self.place % size
        if count < 0 or self.place + count * size > len(self.data):
            raise ValueError("a message ends too early")
        values = struct.unpack_from(f"{self.order}{count}{kind}", self.data, self.place)
        self.place += count * size
        return values

    def text(self) -> str:
        (count,) = self.numbers("I")
        return bytes(self.numbers("B", count)).rstrip(b"\0").decode()

    def texts(self) -> list[str]:
        (count,) = self.numbers("I")
        if count > len(self.data):
            raise ValueError("a message ends too early")
        return [self.text() for _ in range(count)]

    def sequence(self) -> list[float]:
        (count,) = self.numbers("I")
        return list(self.numbers("d", count)) if count else []

    def stamp(self) -> int:
        (seconds,), (nanoseconds,) = self.numbers("i"), self.numbers("I")
        self.text()
        return int(seconds * 10**9 + nanoseconds)


def _read_state(cursor: _Cursor) -> dict[str, Any]:
    told: dict[str, Any] = {"stamp": cursor.stamp(), "name": cursor.texts()}
    for word in ("position", "velocity", "effort"):
        told[word] = cursor.sequence()
    return told


def _read_trajectory(cursor: _Cursor) -> dict[str, Any]:
    told: dict[str, Any] = {"stamp": cursor.stamp(), "joint_names": cursor.texts(), "points": []}
    (count,) = cursor.numbers("I")
    for _ in range(count):
        point: dict[str, Any] = {
            word: cursor.sequence() for word in ("positions", "velocities", "accelerations", "effort")
        }
        (seconds,), (nanoseconds,) = cursor.numbers("i"), cursor.numbers("I")
        point["time_from_start"] = {"sec": seconds, "nanosec": nanoseconds}
        told["points"].append(point)
    return told


READERS = {"sensor_msgs/msg/JointState": _read_state, "trajectory_msgs/msg/JointTrajectory": _read_trajectory}
