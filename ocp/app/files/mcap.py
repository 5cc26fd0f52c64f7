"""MCAP, the log format that ROS 2 and Foxglove read and play: joint states over time, and the tip's path.

Messages are those of ROS 2, written and read by the package `mcap-ros2-support`, of the extra `mcap`. They are read by
the definitions below, never by those that a file brings.

Plans in Rerun's viewer, by the module `rerun` that the caller gives: nothing here asks for that package.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from typing import IO, Any

import numpy as np

from models.input_files import INPUT_LIMITS, open_regular
from ocp.errors import ProblemError, checked_instance, checked_text
from ocp.motion.plan import Plan
from ocp.storage import write_whole

__all__ = ["log_rerun", "read_joint_messages", "write_mcap"]


def _with_parts(fields: str, **parts: str) -> str:
    """The definition of a message: its header, its fields, and those of the types in them."""
    parts["std_msgs/Header"] = "builtin_interfaces/Time stamp\nstring frame_id\n"
    parts |= {f"builtin_interfaces/{name}": "int32 sec\nuint32 nanosec\n" for name in ("Time", "Duration")}
    bar = "=" * 80
    return f"std_msgs/Header header\n{fields}" + "".join(f"{bar}\nMSG: {name}\n{own}" for name, own in parts.items())


STATE, PATH = "sensor_msgs/msg/JointState", "nav_msgs/msg/Path"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
POSE_PARTS = {
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Point": VECTOR,
    "geometry_msgs/Quaternion": f"{VECTOR}float64 w\n",
}
POINT = "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n"
POINT_PARTS = {"trajectory_msgs/JointTrajectoryPoint": f"{POINT}builtin_interfaces/Duration time_from_start\n"}
DEFINITIONS = {
    STATE: _with_parts("string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"),
    PATH: _with_parts("geometry_msgs/PoseStamped[] poses\n", **POSE_PARTS),
    TRAJECTORY: _with_parts("string[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points\n", **POINT_PARTS),
}


def write_mcap(plan: Plan, file: str | os.PathLike[str], period: float = 0.01, *, frame: str = "world") -> None:
    """Write the joints every `period` s as sensor_msgs/msg/JointState on `/joint_states`, with velocities, and the
    tip's poses at the same times as one nav_msgs/msg/Path on `/tip_path`, where the robot has a tip.

    The first is at 0 s of the log's time.

    Args:
        plan: To be written. file: Whole or as it was before. period: s.
        frame: The name of the world in the messages.

    Raises:
        ProblemError: No plan, a period that is not positive, or mcap-ros2-support is not installed.
        OSError: The file cannot be written.
    """
    checked_instance("plan", plan, Plan)
    checked_text("frame", frame)
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        words = "MCAP is written by the package mcap-ros2-support: pip install 'selfmotion[mcap]'"
        raise ProblemError(words, name="mcap") from error
    sample = plan.sample(period)
    stamps = np.round(sample.t * 1e9).astype(np.int64).tolist()

    def write(stream: IO[bytes]) -> None:
        writer: Any = Writer(stream)
        writer.add_metadata("selfmotion", {})  # at the head of the file: who wrote it
        if np.isfinite(sample.tip).all():
            poses = [
                {
                    "header": _header(stamp, frame),
                    "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": i, "y": j, "z": k, "w": w}},
                }
                for stamp, (x, y, z, w, i, j, k) in zip(stamps, sample.tip.tolist(), strict=True)
            ]
            schema = writer.register_msgdef(PATH, DEFINITIONS[PATH])
            writer.write_message("/tip_path", schema, {"header": _header(0, frame), "poses": poses}, 0)
        schema = writer.register_msgdef(STATE, DEFINITIONS[STATE])
        states = zip(stamps, sample.joints.tolist(), sample.rates.tolist(), strict=True)
        for number, (stamp, joints, rates) in enumerate(states):
            state = {"header": _header(stamp, ""), "name": list(plan.names), "position": joints, "velocity": rates}
            writer.write_message("/joint_states", schema, {**state, "effort": []}, stamp, sequence=number)
        writer.finish()

    write_whole(file, write)


def _header(stamp: int, frame: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


# ---- reading -----------------------------------------------------------------------------------------------------


def read_joint_messages(file: str | os.PathLike[str], topic: str | None = None) -> tuple[str, list[tuple[int, Any]]]:
    """The joint states, or joint trajectories, of one topic of a log: the topic; stamps, ns, and messages by fields.

    A stamp is that of the message's header, or where that is zero the log's own.

    Args:
        file: As ROS 2 writes it, in CDR.
        topic: Its name; None: the only one of these kinds, or `/joint_states`.

    Raises:
        ProblemError: No such file, no log, no such topic, or mcap-ros2-support is not installed.
    """
    try:
        from mcap.records import Channel, Message, Schema
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        words = "MCAP is read by the package mcap-ros2-support: pip install 'selfmotion[mcap]'"
        raise ProblemError(words, name="mcap") from error
    found: dict[str, list[tuple[int, int, Any]]] = {}
    decoders, schemas = DecoderFactory(), dict[int, Any]()
    channels: dict[int, tuple[str, Any]] = {}  # topics, and how their messages are read
    size = 0
    try:
        with open_regular(file, INPUT_LIMITS.log_bytes) as stream:
            for record in _records(stream):
                if isinstance(record, Schema):
                    if record.name in (STATE, TRAJECTORY):
                        own = Schema(record.id, DEFINITIONS[record.name].encode(), "ros2msg", record.name)
                        schemas[record.id] = decoders.decoder_for("cdr", own)
                elif isinstance(record, Channel) and record.message_encoding == "cdr":
                    channels[record.id] = record.topic, schemas.get(record.schema_id)
                elif isinstance(record, Message):
                    name, read = channels.get(record.channel_id, ("", None))
                    if read is not None:
                        size += len(record.data)
                        if size > (most := INPUT_LIMITS.log_message_bytes):
                            raise ValueError(f"its messages of joints have more than {most} bytes; split it")
                        told = _fields(read(record.data))
                        stamp = told["header"]["stamp"]["sec"] * 10**9 + told["header"]["stamp"]["nanosec"]
                        stamp = stamp or record.log_time
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

    room, largest = INPUT_LIMITS.log_bytes, INPUT_LIMITS.log_record_bytes
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=largest).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        room -= record.uncompressed_size
        if record.uncompressed_size > largest or room < 0:
            raise ValueError(f"it unpacks to more than {INPUT_LIMITS.log_bytes} bytes, or a part of it to {largest}")
        with suppress(EndOfFile):
            yield from StreamReader(io.BytesIO(_unpacked(record)), skip_magic=True).records


def _unpacked(chunk: Any) -> bytes:
    """The contents of a chunk, never more than it says that it has."""
    data, size = chunk.data, chunk.uncompressed_size
    if chunk.compression == "zstd":
        zstd = import_module("zstandard").ZstdDecompressor(max_window_size=INPUT_LIMITS.log_record_bytes)
        data = zstd.stream_reader(data).read(size + 1)
    elif chunk.compression == "lz4":
        data = import_module("lz4.frame").LZ4FrameDecompressor().decompress(data, size + 1)
    if len(data) != size:
        raise ValueError("a chunk does not unpack to the size that it says")
    return bytes(data)


def _fields(message: Any) -> Any:
    """A message, or a list of them, as names and values."""
    if isinstance(message, list):
        return [_fields(each) for each in message] if message and hasattr(message[0], "__slots__") else message
    if not hasattr(message, "__slots__"):
        return message
    return {name: _fields(getattr(message, name)) for name in message.__slots__}


NEEDED = ("LineStrips3D", "Points3D", "Scalars", "TimeColumn", "log", "send_columns")
"""What is called of the module (0.23 or later)."""


def log_rerun(plan: Plan, rerun: Any, period: float = 0.01, *, entity: str = "plan", timeline: str = "time") -> None:
    """Log joints, velocities and accelerations every `period` s as scalars, and the tip as a point on its way.

    They stand under `ENTITY/position/JOINT`, `ENTITY/velocity/JOINT`, `ENTITY/acceleration/JOINT`, `ENTITY/tip` and
    `ENTITY/tip_path`, in rad or m, per s and s^2, and m in the world. What is recorded and where to is the caller's:
    `import rerun; rerun.init("seam", spawn=True); log_rerun(plan, rerun)`.

    Args:
        plan: To be shown. period: s.
        rerun: The module `rerun`, or what has its `log`, `send_columns` and archetypes.
        entity: What the paths of the entities begin with. timeline: The name of the time, from 0 s.

    Raises:
        ProblemError: No plan, a period that is not positive, or something without what is called of the module.
    """
    checked_instance("plan", plan, Plan)
    checked_text("entity", entity)
    checked_text("timeline", timeline)
    missing = [name for name in NEEDED if not callable(getattr(rerun, name, None))]
    if missing:
        words = f"the module rerun is expected (0.23 or later), not {rerun!r}, which has no {', '.join(missing)}"
        raise ProblemError(words, name="rerun", value=rerun, limit=NEEDED)
    sample = plan.sample(period)
    times = [rerun.TimeColumn(timeline, duration=sample.t)]
    kinds = {"position": sample.joints, "velocity": sample.rates, "acceleration": sample.accelerations}
    for kind, values in kinds.items():
        for name, column in zip(plan.names, values.T, strict=True):
            columns = rerun.Scalars.columns(scalars=np.ascontiguousarray(column))
            rerun.send_columns(f"{entity}/{kind}/{name}", indexes=times, columns=columns)
    if np.isfinite(sample.tip).all():
        places = np.ascontiguousarray(sample.tip[:, :3])
        rerun.log(f"{entity}/tip_path", rerun.LineStrips3D([places]), static=True)
        rerun.send_columns(f"{entity}/tip", indexes=times, columns=rerun.Points3D.columns(positions=places))
