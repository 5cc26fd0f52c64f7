"""Write and read joint motions in MCAP, the log format of ROS 2 and Foxglove, and log plans to Rerun.

MCAP messages are those of ROS 2, written and read by the package `mcap-ros2-support` of the extra `mcap`. They are
decoded with the definitions below, never with those of the file. The caller passes the module `rerun`; nothing here
depends on it.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from typing import IO, Any

import numpy as np

from models.files import INPUT_LIMITS, open_regular
from ocp.app.files.safe_files import missing_package
from ocp.errors import ProblemError, require
from ocp.motion.plan import Plan
from ocp.storage import write_whole

__all__ = ["log_rerun", "read_joint_messages", "write_mcap"]


def _with_parts(fields: str, **parts: str) -> str:
    """Return the ROS 2 definition of a message type: its header, its fields, and the types that the fields use."""
    parts["std_msgs/Header"] = "builtin_interfaces/Time stamp\nstring frame_id\n"
    parts |= {f"builtin_interfaces/{name}": "int32 sec\nuint32 nanosec\n" for name in ("Time", "Duration")}
    bar = "=" * 80
    return f"std_msgs/Header header\n{fields}" + "".join(f"{bar}\nMSG: {name}\n{text}" for name, text in parts.items())


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
    """Write the joint states of a plan to `/joint_states`, and the path of its tip, if any, to `/tip_path`.

    States are sensor_msgs/msg/JointState with velocities every `period` s, the first at 0 s of the log. The path is one
    nav_msgs/msg/Path with poses at the same times.

    Args:
        plan: The plan.
        file: Name of the log file, which is replaced only when the log is complete.
        period: Sampling period, s.
        frame: Name of the world frame in the messages.

    Raises:
        ProblemError: An argument is invalid, or mcap-ros2-support is not installed.
        OSError: The file cannot be written.
    """
    require.instance("plan", plan, Plan)  # type: ignore[type-abstract]
    require.text("frame", frame)
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise missing_package("writing MCAP", "mcap-ros2-support", "mcap") from error
    sample = plan.sample(period)
    stamps = np.round(sample.t * 1e9).astype(np.int64).tolist()

    def write(stream: IO[bytes]) -> None:
        writer: Any = Writer(stream)
        writer.add_metadata("selfmotion", {})  # at the start of the file, where `checked_output` reads it
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
    """Return the header of a ROS 2 message with a time stamp in ns and the name of a frame."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


# ---- reading -----------------------------------------------------------------------------------------------------


def read_joint_messages(file: str | os.PathLike[str], topic: str | None = None) -> tuple[str, list[tuple[int, Any]]]:
    """Read joint states or trajectories from a log; return their topic, and time stamp (ns) and fields of each message.

    A stamp is that of the message's header, or the log time if that is zero.

    Args:
        file: Log as written by ROS 2, in CDR.
        topic: Name of the topic; None: the only one of these kinds, or `/joint_states`.

    Raises:
        ProblemError: The file is missing or no valid log, the topic is unknown, or mcap-ros2-support is not installed.
    """
    try:
        from mcap.records import Channel, Message, Schema
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise missing_package("reading MCAP", "mcap-ros2-support", "mcap") from error
    messages: dict[str, list[tuple[int, int, Any]]] = {}
    decoders, schemas = DecoderFactory(), dict[int, Any]()
    channels: dict[int, tuple[str, Any]] = {}  # topics, and the decoders of their messages
    size = 0
    try:
        with open_regular(file, INPUT_LIMITS.log_bytes) as stream:
            for record in _records(stream):
                if isinstance(record, Schema):
                    if record.name in (STATE, TRAJECTORY):
                        schema = Schema(record.id, DEFINITIONS[record.name].encode(), "ros2msg", record.name)
                        schemas[record.id] = decoders.decoder_for("cdr", schema)
                elif isinstance(record, Channel) and record.message_encoding == "cdr":
                    channels[record.id] = record.topic, schemas.get(record.schema_id)
                elif isinstance(record, Message):
                    name, decode = channels.get(record.channel_id, ("", None))
                    if decode is not None:
                        size += len(record.data)
                        if size > (most := INPUT_LIMITS.log_message_bytes):
                            raise ValueError(f"its joint messages have more than {most} bytes; split it")
                        fields = _fields(decode(record.data))
                        stamp = fields["header"]["stamp"]["sec"] * 10**9 + fields["header"]["stamp"]["nanosec"]
                        stamp = stamp or record.log_time
                        messages.setdefault(name, []).append((record.log_time, stamp, fields))
    except OSError as error:
        raise ProblemError(f"{file}: cannot be read: {error.strerror}", name="file", value=str(file)) from error
    except Exception as error:  # mcap, zstandard and lz4 raise many kinds for broken bytes
        raise ProblemError(f"{file} is not a valid log: {error}", name="file", value=str(file)) from error
    selected = topic
    if topic is None and len(messages) == 1:
        selected = next(iter(messages))
    elif topic is None and "/joint_states" in messages:
        selected = "/joint_states"
    if selected not in messages:
        known = ", ".join(sorted(messages)) or "none"
        words = f"{file}: no topic {topic!r} of joint states or joint trajectories; available: {known}; name the topic"
        raise ProblemError(words, name="topic", value=topic, limit=tuple(messages))
    return selected, [
        (stamp, fields) for _, stamp, fields in sorted(messages[selected], key=lambda message: message[0])
    ]


def _records(stream: IO[bytes]) -> Iterator[Any]:
    """Yield the records of an MCAP log in file order, including the records inside chunks.

    Raises:
        ValueError: A record, or the unpacked log, is too large.
    """
    from mcap.exceptions import EndOfFile
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    remaining, largest = INPUT_LIMITS.log_bytes, INPUT_LIMITS.log_record_bytes
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=largest).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        remaining -= record.uncompressed_size
        if record.uncompressed_size > largest or remaining < 0:
            raise ValueError(f"it unpacks to more than {INPUT_LIMITS.log_bytes} bytes, or a record to {largest}")
        with suppress(EndOfFile):
            yield from StreamReader(io.BytesIO(_decompress(record)), skip_magic=True).records


def _decompress(chunk: Any) -> bytes:
    """Return the decompressed contents of an MCAP chunk; raise ValueError if their size is not the declared one."""
    data, size = chunk.data, chunk.uncompressed_size
    if chunk.compression == "zstd":
        zstd = import_module("zstandard").ZstdDecompressor(max_window_size=INPUT_LIMITS.log_record_bytes)
        data = zstd.stream_reader(data).read(size + 1)
    elif chunk.compression == "lz4":
        data = import_module("lz4.frame").LZ4FrameDecompressor().decompress(data, size + 1)
    if len(data) != size:
        raise ValueError("a chunk does not unpack to its declared size")
    return bytes(data)


def _fields(message: Any) -> Any:
    """Convert a decoded ROS 2 message, or a list of messages, to dictionaries."""
    if isinstance(message, list):
        return [_fields(each) for each in message] if message and hasattr(message[0], "__slots__") else message
    if not hasattr(message, "__slots__"):
        return message
    return {name: _fields(getattr(message, name)) for name in message.__slots__}


REQUIRED_NAMES = ("LineStrips3D", "Points3D", "Scalars", "TimeColumn", "log", "send_columns")
"""Names that the module rerun (0.23 or later) must provide."""


def log_rerun(plan: Plan, rerun: Any, period: float = 0.01, *, entity: str = "plan", timeline: str = "time") -> None:
    """Log a plan to Rerun: joint positions, velocities and accelerations as scalars, the tip as a point on its path.

    The entities are `ENTITY/position/JOINT`, `ENTITY/velocity/JOINT`, `ENTITY/acceleration/JOINT`, `ENTITY/tip` and
    `ENTITY/tip_path`, in rad or m, per s and s^2, and in m in world. The caller starts the recording: `import rerun;
    rerun.init("seam", spawn=True); log_rerun(plan, rerun)`.

    Args:
        plan: The plan.
        rerun: The module `rerun`, or an object with its `log`, `send_columns` and archetypes.
        period: Sampling period, s.
        entity: Prefix of the entity paths.
        timeline: Name of the time, which starts at 0 s.

    Raises:
        ProblemError: The plan or the period is invalid, or `rerun` lacks a required name.
    """
    require.instance("plan", plan, Plan)  # type: ignore[type-abstract]
    require.text("entity", entity)
    require.text("timeline", timeline)
    missing = [name for name in REQUIRED_NAMES if not callable(getattr(rerun, name, None))]
    if missing:
        words = f"the module rerun (0.23 or later) is expected, not {rerun!r}, which has no {', '.join(missing)}"
        raise ProblemError(words, name="rerun", value=rerun, limit=REQUIRED_NAMES)
    sample = plan.sample(period)
    times = [rerun.TimeColumn(timeline, duration=sample.t)]
    kinds = {"position": sample.joints, "velocity": sample.rates, "acceleration": sample.accelerations}
    for kind, values in kinds.items():
        for name, column in zip(plan.names, values.T, strict=True):
            columns = rerun.Scalars.columns(scalars=np.ascontiguousarray(column))
            rerun.send_columns(f"{entity}/{kind}/{name}", indexes=times, columns=columns)
    if np.isfinite(sample.tip).all():
        positions = np.ascontiguousarray(sample.tip[:, :3])
        rerun.log(f"{entity}/tip_path", rerun.LineStrips3D([positions]), static=True)
        rerun.send_columns(f"{entity}/tip", indexes=times, columns=rerun.Points3D.columns(positions=positions))
