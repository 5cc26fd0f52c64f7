"""Write joint motions for other systems and read them back: MCAP logs, Rerun, programs of industrial robots.

MCAP is the log format of ROS 2 and Foxglove. Its messages are decoded with the definitions below, never with those of
the file. Programs of industrial robots are URScript (Universal Robots), KRL (KUKA) and RAPID (ABB); comments in them
state which joint each axis moves. `ocp.app.files.trajectory` reads exactly these statements.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import IO, Any, NamedTuple
from urllib.parse import quote

import numpy as np

from models import Robot
from models.checks import Array
from models.files import INPUT_LIMITS, open_regular
from ocp.app.files.safe_files import MARK, SUFFIXES, FileName, missing_package
from ocp.errors import ProblemError, require
from ocp.motion.plan import Plan
from ocp.motion.schedule import JointTrajectory
from ocp.storage import write_text, write_whole


def _with_parts(fields: str, **parts: str) -> str:
    """Return the text that defines a ROS 2 message type: header, fields, and the types that the fields use."""
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
    """Read joint states or trajectories from an MCAP log; return the topic, and stamp (ns) and fields of each message.

    A stamp is that of the message's header, or the log time if the header's is zero. By default, the topic is the only
    one with messages of these types or, if there are several, `/joint_states`.

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
    selected = topic or (next(iter(messages)) if len(messages) == 1 else "/joint_states")
    if selected not in messages:
        known = ", ".join(sorted(messages)) or "none"
        words = f"{file}: no topic {topic!r} of joint states or joint trajectories; available: {known}; name the topic"
        raise ProblemError(words, name="topic", value=topic, limit=tuple(messages))
    ordered = sorted(messages[selected], key=lambda message: message[0])
    return selected, [(stamp, fields) for _, stamp, fields in ordered]


def _records(stream: IO[bytes]) -> Iterator[Any]:
    """Yield the records of an MCAP log in file order, also those in chunks; raise ValueError if one is too large."""
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


# ---- programs of industrial robots -------------------------------------------------------------------------------

LIST, ITEM, NAME = r"([-0-9.,E+]+)", r"[AE][1-6] ?-?[0-9.]+", r"[A-Za-z]\w*"
MOVE_ABS_J = rf"MoveAbsJ\[\[{LIST}\],\[{LIST}\]\]\\NoEOffs,v\d+"
ABSENT_AXIS = "9E+09"
"""Number that RAPID writes for an external axis that does not exist."""
APPROACH_PERCENT = 10
"""Velocity with which a KUKA robot moves to the start, percent of its limits."""
PROGRAM_UNITS = {"rad": 1.0, "deg": np.pi / 180, "mm": 1e-3}
"""Units of joint positions in robot programs, rad or m."""
KRL_WORDS = """ANIN ANOUT AXIS BOOL BRAKE CASE CHANNEL CHAR CIRC CONFIRM CONST CONTINUE DECL DEF DEFAULT DEFDAT DEFFCT
DELAY DIGIN DISTANCE DO ELSE END ENDDAT ENDFCT ENDFOR ENDIF ENDLOOP ENDSWITCH ENDWHILE ENUM EXIT EXT EXTFCT FOR FRAME
GLOBAL GOTO HALT IF IMPORT INT INTERRUPT IS LIN LOOP MAXIMUM MINIMUM POS PRIO PTP PUBLIC PULSE REAL REPEAT RESUME RETURN
SIGNAL STRUC SWITCH THEN TO TRIGGER UNTIL WAIT WHEN WHILE WITH""".split()  # noqa: SIM905


class RobotLanguage(NamedTuple):
    """Syntax of the robot programs of one manufacturer, as far as selfmotion writes it.

    Attributes:
        title, comment: Name of the language, and sign that begins a comment.
        arm, external: Names of the axes of the robot, and of the external axes.
        unit, decimals: Unit of revolute joints, a key of PROGRAM_UNITS (prismatic joints are in mm), and decimals.
        statements: Patterns of the statements in their order, without spaces beside signs. Groups are the positions of
            the axes, and `time` the duration of a step in s. Statement number `repeated` may occur any number of times.
    """

    title: str
    comment: str
    arm: tuple[str, ...]
    external: tuple[str, ...]
    unit: str
    decimals: int
    statements: tuple[str, ...]
    repeated: int


SIX = range(1, 7)
ROBOT_LANGUAGES = {
    "urscript": RobotLanguage(
        *("URScript", "#", tuple(f"q[{k - 1}]" for k in SIX), (), "rad", 9),
        (
            rf"def {NAME}\(\):",
            rf"movej\(\[{LIST}\],a=[\d.]+,v=[\d.]+\)",
            rf"servoj\(\[{LIST}\],0,0,(?P<time>[\d.]+),[\d.]+,[\d.]+\)",
            "end",
        ),
        2,
    ),
    "krl": RobotLanguage(
        *("KRL", ";", tuple(f"A{k}" for k in SIX), tuple(f"E{k}" for k in SIX), "deg", 7),
        (
            "(?i)&ACCESS RVP",
            rf"(?i)DEF {NAME}\(\)",
            r"(?i)\$APO\.CPTP=\d+",
            rf"(?i)\$VEL_(?:AXIS|EXTAX)\[[1-6]\]=\d+|PTP\{{E6AXIS:({ITEM}(?:,{ITEM})*)\}}(?:C_PTP)?",
            "(?i)END",
        ),
        3,
    ),
    "rapid": RobotLanguage(
        *("RAPID", "!", tuple(f"rax_{k}" for k in SIX), tuple(f"eax_{k}" for k in "abcdef"), "deg", 7),
        (
            f"(?i)MODULE {NAME}",
            r"(?i)PROC main\(\)",
            rf"(?i){MOVE_ABS_J},fine,tool0;",
            rf"(?i){MOVE_ABS_J}\\T:=(?P<time>[\d.]+),(?:z\d+|fine),tool0;",
            "(?i)ENDPROC",
            "(?i)ENDMODULE",
        ),
        3,
    ),
}
"""Languages of robot programs by the kind of their files, see `safe_files.SUFFIXES`."""


def write_robot_program(
    motion: Any,
    file: FileName,
    *,
    period: float = 0.01,
    joints: Sequence[str] | None = None,
    robot: Robot | None = None,
) -> None:
    """Write a motion as a program of an industrial robot: URScript (.script), KRL (.src) or RAPID (.mod).

    Revolute joints become the axes of the robot in the given order (from the seventh on external axes), prismatic
    joints external axes. Positions are written in rad (9 decimals), or in degrees and mm (7 decimals). Signs and zero
    positions are those of the robot model. Each program first moves to the start; whether this approach is free of
    collisions is not known.

    What the controller keeps of the timing:

    - URScript: `servoj` with the duration of each step, in whole ns. The arm lags behind by its lookahead time.
    - RAPID: `MoveAbsJ` with the duration of each step (`T`), in whole ns. The arm flies by all points but the last.
    - KRL: No times. `PTP` with the velocity that the fastest joint has on average in the step, in whole percent of the
      velocity limit in the robot model, rounded down, at least 1. The controller adds its acceleration and rounds the
      points (`C_PTP`), so that the motion usually takes longer. KUKA requires that the file be named like the program:
      a letter, then letters, digits and _, 24 characters at most, and no word of KRL.

    Args:
        motion: A plan, or a trajectory with `names`, `t` and `positions`, such as `read_trajectory` returns.
        file: Name of the file to write; its suffix selects the language.
        period: Sampling period of a plan, s.
        joints: Names of the joints in the order of the controller; None: the order of the motion. Other joints are not
            in the program.
        robot: Robot of a trajectory, whose kinds of joints and velocity limits are used. A plan has its own.

    Raises:
        ProblemError: An argument is invalid, the controller has too few axes, times are less than 1 ns apart, or, for
            KRL, a joint has no velocity limit.
    """
    path, kind = _path_and_kind(file)
    if isinstance(motion, Plan):
        robot, motion = motion.machine.robot, motion.trajectory(period)
    elif not all(hasattr(motion, name) for name in ("names", "t", "positions")):
        raise ProblemError(f"motion must be a plan or a trajectory, not {motion!r}", name="motion", value=motion)
    robot = require.instance("robot", robot, Robot)
    names = motion.names if joints is None else require.each("joints", joints, str)
    for name in names:
        for known in (motion.names, robot.joint_names):
            if name not in known:
                raise require.unknown("joints: joint", name, known)
    positions = np.asarray(motion.positions)[:, [motion.names.index(name) for name in names]]
    trajectory = JointTrajectory(names, motion.t, positions, 0 * positions, 0 * positions)  # checks the values
    stamps = [point["time_from_start"] for point in trajectory.to_ros()["points"]]  # checks the times
    durations = np.diff([stamp["sec"] * 10**9 + stamp["nanosec"] for stamp in stamps]) / 1e9
    language, columns = ROBOT_LANGUAGES[kind], [robot.joint_names.index(name) for name in names]
    linear = [robot.moving_joints[column].kind == "prismatic" for column in columns]
    axes, units = _axes(language, names, linear), ["mm" if each else language.unit for each in linear]
    digits = language.decimals
    values = np.round(trajectory.positions / [PROGRAM_UNITS[unit] for unit in units], digits) + 0.0
    points = [{axis: f"{value:.{digits}f}" for axis, value in zip(axes, row, strict=True)} for row in values.tolist()]
    remarks = [f"  {language.comment} {MARK}"] + [
        f"  {language.comment} {axis} = {quote(name, safe='/:')} [{unit}]"
        for axis, name, unit in zip(axes, names, units, strict=True)
    ]
    title = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    if kind == "krl":
        velocities = np.abs(np.diff(trajectory.positions, axis=0)) / durations[:, None]
        lines = _krl(title, remarks, points, _percents(velocities, names, robot.velocity[columns]))
    else:
        seconds = [f"{duration:.9f}" for duration in durations.tolist()]
        lines = (_urscript if kind == "urscript" else _rapid)(f"motion_{title}"[:32], remarks, points, seconds)
    write_text(file, "\n".join(lines) + "\n")


def _path_and_kind(file: FileName) -> tuple[Path, str]:
    """Return the path of a robot program, and the name of the language that its suffix selects."""
    if not isinstance(file, str | os.PathLike):
        raise ProblemError(f"a file name is expected, not {file!r}", name="file", value=file)
    path = Path(os.fsdecode(file))
    for kind in ROBOT_LANGUAGES:
        if path.suffix.lower() in SUFFIXES[kind]:
            return path, kind
    known = tuple(SUFFIXES[kind][0] for kind in ROBOT_LANGUAGES)
    words = f"{file}: a robot program is written as {', '.join(known)}; end the name with one of these"
    raise ProblemError(words, name="file", value=str(file), limit=known)


def _axes(language: RobotLanguage, names: Sequence[str], linear: Sequence[bool]) -> list[str]:
    """Return the controller's axis for each joint; raise ProblemError if the joints and the axes do not match."""
    arm, external, axes = iter(language.arm), iter(language.external), list[str]()
    for name, is_linear in zip(names, linear, strict=True):
        axis = next(external if is_linear else chain(arm, external), None)
        if axis is None:
            counts = f"{len(language.arm)} axes of the robot and {len(language.external)} external axes"
            words = f"{language.title} has {counts}, and none is left for the joint {name!r}; select others: joints="
            raise ProblemError(words, name="joints", value=name, limit=(len(language.arm), len(language.external)))
        axes.append(axis)
    if not language.external and len(axes) < len(language.arm):
        words = f"{language.title} moves {len(language.arm)} joints, not {len(axes)}; write KRL or RAPID instead"
        raise ProblemError(words, name="joints", value=tuple(names), limit=len(language.arm))
    return axes


def _percents(velocities: Array, names: Sequence[str], limits: Array) -> list[int]:
    """Return the joint velocity closest to its limit in each step, in percent of the limit, from rates (M - 1, n)."""
    for name, limit in zip(names, limits.tolist(), strict=True):
        if not 0 < limit < np.inf:
            words = f"KRL states velocities in percent of their limits; the joint {name!r} has none; set it in the URDF"
            raise ProblemError(words, name=name, value=limit)
    shares = (velocities / limits).max(axis=1)
    return [int(percent) for percent in np.clip(np.floor(100 * shares + 1e-6), 1, 100)]


def _urscript(name: str, remarks: list[str], points: list[dict[str, str]], seconds: list[str]) -> Iterator[str]:
    """Yield the lines of a URScript program (Universal Robots, *Script Manual*, `movej` and `servoj`)."""
    start, *others = (f"[{', '.join(point.values())}]" for point in points)
    yield from (f"def {name}():", *remarks, f"  movej({start}, a=0.5, v=0.25)")
    for point, duration in zip(others, seconds, strict=True):
        yield f"  servoj({point}, 0, 0, {duration}, 0.1, 300)"
    yield "end"


def _krl(title: str, remarks: list[str], points: list[dict[str, str]], percents: list[int]) -> Iterator[str]:
    """Yield the lines of a KRL program (KUKA, *Operating and Programming Instructions for System Integrators*)."""
    name = title if title[:1].isalpha() and title.upper() not in KRL_WORDS else f"p{title}"
    yield from ("&ACCESS RVP", f"DEF {name[:24]}()", *remarks, "  $APO.CPTP=50")
    previous, last = 0, len(points) - 1
    for number, (point, percent) in enumerate(zip(points, [APPROACH_PERCENT, *percents], strict=True)):
        if percent != previous:
            yield from (f"  $VEL_{'AXIS' if axis[0] == 'A' else 'EXTAX'}[{axis[1]}]={percent}" for axis in point)
        previous = percent
        items = ", ".join(f"{axis} {value}" for axis, value in point.items())
        yield f"  PTP {{E6AXIS: {items}}}" + (" C_PTP" if 0 < number < last else "")
    yield "END"


def _rapid(name: str, remarks: list[str], points: list[dict[str, str]], seconds: list[str]) -> Iterator[str]:
    """Yield the lines of a RAPID module (ABB, *RAPID Instructions, Functions and Data types*, `MoveAbsJ`)."""
    language, last = ROBOT_LANGUAGES["rapid"], len(points) - 1
    yield from (f"MODULE {name}", *remarks, "  PROC main()")
    for number, point in enumerate(points):
        arm = ", ".join(point.get(axis, "0") for axis in language.arm)
        external = ", ".join(point.get(axis, ABSENT_AXIS) for axis in language.external)
        speed = f"v1000\\T:={seconds[number - 1]}" if number else "v100"
        zone = "z0" if 0 < number < last else "fine"
        yield f"    MoveAbsJ [[{arm}], [{external}]]\\NoEOffs, {speed}, {zone}, tool0;"
    yield from ("  ENDPROC", "ENDMODULE")
