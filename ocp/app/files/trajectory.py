"""Read joint trajectories from tables, JointTrajectory messages in JSON or YAML, MCAP logs, and robot programs.

Faults of the motion are kept for the check that reports them: values that are not numbers, times that do not increase,
and joints that the robot does not have.

A CSV has a header. `time` or `t` is the time. A column with the name of a joint is its position; a word before or after
the name makes it a velocity, acceleration or effort: `elbow.velocity`, `elbow_vel`, `velocity/elbow`. A unit may follow
in brackets: `elbow [deg]`, `time [ms]`. Commas, semicolons, tabs or blanks separate the columns; `#` begins a comment.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.checks import NOT_NUMBERS, Array, short_repr
from models.files import INPUT_LIMITS
from ocp.app.files.exchange import ABSENT_AXIS, PROGRAM_UNITS, ROBOT_LANGUAGES, RobotLanguage, read_joint_messages
from ocp.app.files.safe_files import (
    SUFFIXES,
    FileName,
    children_of,
    line_error,
    read_lines,
    read_rows,
    read_tree,
    table_numbers,
)
from ocp.errors import ProblemError, require
from ocp.storage import joint_name, table_joints

Indices: TypeAlias = NDArray[np.intp]

KINDS = ("positions", "velocities", "accelerations", "efforts")
WORDS = {
    **dict.fromkeys(("position", "positions", "pos", "q"), "positions"),
    **dict.fromkeys(("velocity", "velocities", "vel", "rate", "dq", "qd"), "velocities"),
    **dict.fromkeys(("acceleration", "accelerations", "acc", "accel", "ddq", "qdd"), "accelerations"),
    **dict.fromkeys(("effort", "efforts", "torque", "torques", "tau"), "efforts"),
}
TIMES = ("time", "t", "time_from_start", "timestamp", "secs", "seconds")
UNITS = {
    **dict.fromkeys(("s", "sec", "rad", "m", "n m", "nm", "n"), 1.0),
    **{"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "mm": 1e-3, "cm": 1e-2},
    **dict.fromkeys(("deg", "°"), np.pi / 180),
}
HEADER_WITH_UNIT = re.compile(r"(.*)[\[(]([^\[(\])]*)[\])]")
FORMATS = {suffix: kind for kind in ("json", "yaml", "mcap", *ROBOT_LANGUAGES) for suffix in SUFFIXES[kind]}
AXIS_REMARK = re.compile(r"(\S+) = (\S+) \[(rad|deg|mm)\]")
SPACED_SIGN = re.compile(r" ?([^\w. ]) ?")
PROGRAM_NUMBER = re.compile(r"-?\d+(?:\.\d+)?", re.ASCII)


@dataclass(frozen=True, eq=False)
class RawTrajectory:
    """Joint trajectory as it is written in a file, faults included.

    Attributes:
        names: Names of the joints; some may be columns of other quantities whose names a table does not explain.
        t: Times as written, s. Shape (M,).
        positions, velocities, accelerations, efforts: Shape (M, n), rad or m, per s, per s^2, N m or N. nan if a value
            is missing, None if all are.
        lines: Line numbers in the file, or numbers of points or messages, from 1. Shape (M,).
        names_are_joints: Whether the format guarantees that every name is a joint.
        notes: Remarks on data that were ignored or converted.
        file: Name of the file.
    """

    names: tuple[str, ...]
    t: Array
    positions: Array
    velocities: Array | None
    accelerations: Array | None
    efforts: Array | None
    lines: Indices
    names_are_joints: bool
    notes: tuple[str, ...]
    file: str

    __repr__ = short_repr


def read_trajectory(
    file: FileName,
    *,
    columns: Sequence[str] | None = None,
    period: float | None = None,
    topic: str | None = None,
    joints: Sequence[str] = (),
    kind: str | None = None,
) -> RawTrajectory:
    """Read a joint trajectory from a CSV, JSON, YAML or MCAP file, or from a robot program of `write_robot_program`.

    Args:
        file: .csv or any text, .json, .yaml (needs the package `pyyaml`), .mcap (needs `mcap-ros2-support`), .script,
            .src, .mod.
        columns: Names of the columns of a table without a header.
        period: Sampling period, s, of a table without times, or of a KRL program, which has none.
        topic: Topic of an MCAP with several.
        joints: Names of columns that are joints even if the names look like other quantities.
        kind: "csv", "json", "yaml", "mcap", "urscript", "krl" or "rapid"; None: by the suffix of the name.

    Raises:
        ProblemError: The file cannot be read or contains no trajectory; names the line where there is one.
    """
    if not isinstance(file, str | Path):
        raise ProblemError(f"a file name is expected, not {file!r}", name="file", value=file)
    if kind is None:
        kind = FORMATS.get(Path(file).suffix.lower(), "csv")
    require.choice("kind", kind, ("csv", *FORMATS.values()))
    if topic is not None:
        require.text("topic", topic)
    if period is not None:
        require.positive("period", period)
    if columns is not None:
        columns = require.each("columns", columns, str)
    known = frozenset(require.each("joints", joints, str))
    if isinstance(joints, str):
        raise ProblemError(f"joints must be a list of names, not {joints!r}", name="joints", value=joints)
    if kind == "csv":
        return _read_table(file, columns, period, known)
    if kind == "mcap":
        return _from_messages(file, *read_joint_messages(file, topic))
    if kind in ROBOT_LANGUAGES:
        return _read_program(file, ROBOT_LANGUAGES[kind], period)
    return _from_points(file, read_tree(file, kind))


# ---- tables ------------------------------------------------------------------------------------------------------


def _read_table(
    file: FileName, columns: Sequence[str] | None, period: float | None, joints: frozenset[str]
) -> RawTrajectory:
    """Read a joint trajectory from a text table, such as a CSV."""
    rows, _ = read_rows(file)
    first, has_header = rows[0], rows[0].has_names
    if columns is None and not has_header:
        why = "no header names the columns; name them in order: --columns time,NAME,... (columns=)"
        raise line_error(file, first.number, first.text, why)
    head, rows = first.cells if columns is None else list(columns), rows[has_header:]
    while head and not head[-1].strip():  # a delimiter at the end of every line
        head = head[:-1]
    if not rows:
        raise ProblemError(f"{file}: the file has a header but no sample", name="file", value=str(file))
    table = table_numbers(file, rows, [True] * len(head))
    time, columns_of_values, notes = _meanings(file, head, joints)
    if time is None and period is None:
        words = f"{file}: no column is the time among {', '.join(map(repr, head))}; name one `time`, or give the period"
        raise ProblemError(words, name="time", value=tuple(head))
    t = np.asarray(np.arange(len(rows)) * (period or 0.0) if time is None else table[:, time[0]] * time[1], dtype=float)
    names = tuple(dict.fromkeys(name for name, _ in columns_of_values))
    values: dict[str, Any] = dict.fromkeys(KINDS)
    for (name, quantity), (column, scale) in columns_of_values.items():
        if values[quantity] is None:
            values[quantity] = np.full((len(rows), len(names)), np.nan)
        values[quantity][:, names.index(name)] = table[:, column] * scale
    if values["positions"] is None:
        words = f"{file}: no column is a position among {', '.join(map(repr, head))}; name the columns like the joints"
        raise ProblemError(words, name="positions", value=tuple(head))
    places: dict[str, Any] = {"lines": np.array([row.number for row in rows]), "notes": tuple(notes), "file": str(file)}
    return RawTrajectory(names, t, **values, names_are_joints=False, **places)


def _meanings(
    file: FileName, head: list[str], joints: frozenset[str]
) -> tuple[tuple[int, float] | None, dict[tuple[str, str], tuple[int, float]], list[str]]:
    """Identify the columns of time and joints in a table; return them with factors to SI units, and notes."""
    if joint_names := table_joints(head):  # our own table: the names of its joints are not interpreted
        columns = [(name, kind) for kind in KINDS[:3] for name in joint_names]
        return (0, 1.0), {key: (column, 1.0) for column, key in enumerate(columns, 1)}, []
    time: tuple[int, float] | None = None
    columns_of_values: dict[tuple[str, str], tuple[int, float]] = {}
    notes = []
    for column, cell in enumerate(head):
        name, unit = cell.strip(), ""
        if name not in joints and (match := HEADER_WITH_UNIT.fullmatch(name)):
            name, unit = match[1].strip(), match[2].strip().lower()
            for ending in ("/s^2", "/s2", "/s²", "/s"):
                unit = unit.removesuffix(ending) or unit
            if unit and unit not in UNITS:
                words = f"{file}: the column {cell!r} has an unknown unit; known: {', '.join(UNITS)}"
                raise ProblemError(words, name=name, value=unit, limit=tuple(UNITS))
        scale = UNITS.get(unit, 1.0)
        if scale != 1.0:
            notes.append(f"{name} is converted from {unit}")
        if name.lower() in TIMES and name not in joints:
            if time is not None:
                raise ProblemError(f"{file}: two columns are the time; remove one", name="time", value=tuple(head))
            time = column, scale
            continue
        if not name:
            notes.append(f"column {column + 1} has no name and is ignored")
            continue
        key = (name, "positions") if name in joints else _kind(name)
        if key[0] not in joints and (last := key[0].rpartition("/")[2]) in joints:  # prefixed with the name of a topic
            key = last, key[1]
        if key in columns_of_values:
            raise ProblemError(f"{file}: two columns are named {cell!r}; remove one", name=name, value=tuple(head))
        columns_of_values[key] = column, scale
    return time, columns_of_values, notes


def _kind(name: str) -> tuple[str, str]:
    """Return the joint, and the kind of value such as "velocities", that the name of a table column denotes."""
    for sign in "./:_ ":
        prefix, _, last = name.rpartition(sign)
        if prefix and last.lower() in WORDS:
            return prefix, WORDS[last.lower()]
        first, _, suffix = name.partition(sign)
        if suffix and first.lower() in WORDS:
            return suffix, WORDS[first.lower()]
    return name, "positions"


# ---- trees of names: JSON, YAML ----------------------------------------------------------------------------------


def _trajectory_in(tree: Any, depth: int = 6) -> Mapping[str, Any] | None:
    """Find the outermost mapping with joint names and points in the contents of a JSON or YAML file."""
    level, visited = [tree], set[int]()
    for _ in range(depth + 1):
        next_level: list[Any] = []
        for node in level:
            if isinstance(node, Mapping) and "joint_names" in node and "points" in node:
                return node
            for child in children_of(node)[:100]:
                if id(child) not in visited:
                    visited.add(id(child))
                    next_level.append(child)
        level = next_level
    return None


def _from_points(file: FileName, tree: Any) -> RawTrajectory:
    """Convert the contents of a file, or a message, with joint names and trajectory points to a trajectory."""
    message = _trajectory_in(tree)
    if message is None:
        words = f"{file} contains no joint trajectory; joint_names and points are expected"
        raise ProblemError(words, name="joint_names", value=str(file))
    names, points = message["joint_names"], message["points"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or len(set(names)) != len(names):
        words = f"{file}: joint_names must be distinct names, not {str(names)[:80]}"
        raise ProblemError(words, name="joint_names", value=names)
    if not isinstance(points, list) or not points or not all(isinstance(point, Mapping) for point in points):
        words = f"{file}: points must be a list of at least one point"
        raise ProblemError(words, name="points", value=repr(points)[:80])
    t = np.array([_seconds(file, number, point) for number, point in enumerate(points, 1)])
    notes: list[str] = []
    values: dict[str, Any] = dict.fromkeys(KINDS)
    for kind in KINDS:
        word = "effort" if kind == "efforts" else kind
        rows = [point.get(word) or [] for point in points]
        missing = [number for number, row in enumerate(rows, 1) if not row]
        if len(missing) == len(rows) and kind != "positions":
            continue
        if missing and kind == "positions":
            raise ProblemError(f"{file}: point {missing[0]} has no positions", name=f"point {missing[0]}")
        if missing:
            count = f"{len(missing)} of {len(rows)} points"
            notes.append(f"{count} have no {kind}, first point {missing[0]}: all are ignored")
        else:
            values[kind] = _rows(file, word, rows, len(names))
    places: dict[str, Any] = {"lines": np.arange(1, len(points) + 1), "notes": tuple(notes), "file": str(file)}
    return RawTrajectory(tuple(names), t, **values, names_are_joints=True, **places)


def _rows(file: FileName, word: str, points: list[Any], width: int) -> Array:
    """Return one kind of values, such as the velocities, of all trajectory points. Shape (M, width)."""
    rows = np.full((len(points), width), np.nan)
    for number, point in enumerate(points, 1):
        if not isinstance(point, list) or len(point) != width:
            count = len(point) if isinstance(point, list) else repr(point)[:80]
            words = f"{file}: point {number}: {word} has {count} entries, there are {width} joints"
            raise ProblemError(words, name=f"point {number}", value=count, limit=width)
        try:
            rows[number - 1] = [np.nan if value is None else float(value) for value in point]
        except NOT_NUMBERS as error:
            words = f"{file}: point {number}: {word} are not numbers: {str(point)[:80]}"
            raise ProblemError(words, name=f"point {number}", value=point) from error
    return rows


def _seconds(file: FileName, number: int, point: Mapping[str, Any]) -> float:
    """Return the time of a trajectory point, s, from a duration as in ROS 2 or ROS 1, or from a number."""
    duration = point.get("time_from_start")
    try:
        if isinstance(duration, Mapping):
            whole = duration["sec"] if "sec" in duration else duration["secs"]
            fraction = duration.get("nanosec", duration.get("nsecs", duration.get("nsec", 0)))
            return float(whole) + float(fraction) / 1e9
        if duration is None or isinstance(duration, bool):
            raise TypeError("missing")
        return float(duration)
    except (*NOT_NUMBERS, KeyError) as error:
        words = f"{file}: point {number}: time_from_start must be sec and nanosec, not {duration!r}"
        raise ProblemError(words, name=f"point {number}", value=duration) from error


# ---- logs --------------------------------------------------------------------------------------------------------


def _from_messages(file: FileName, topic: str, messages: list[tuple[int, Any]]) -> RawTrajectory:
    """Convert all joint-state messages of a topic, or the first joint-trajectory message, to a trajectory."""
    notes = []
    first = messages[0][1]
    if "points" in first:
        if len(messages) > 1:
            notes.append(f"{topic} has {len(messages)} trajectories; only the first is read")
        trajectory = _from_points(file, first)
        return replace(trajectory, notes=(*trajectory.notes, *notes))
    joint_sets = [frozenset(state["name"]) for _, state in messages]
    ((most, _),) = Counter(joint_sets).most_common(1)
    states = [message for message, joints in zip(messages, joint_sets, strict=True) if joints == most]
    if (ignored := len(messages) - len(states)) > 0:
        notes.append(f"{ignored} of {len(messages)} messages on {topic} are of other joints and are ignored")
    names = tuple(states[0][1]["name"])
    if len(set(names)) != len(names) or not names:
        raise ProblemError(f"{file}: the joints {names} on {topic} must be distinct names", name="name", value=names)
    orders = [[state["name"].index(name) for name in names] for _, state in states]
    values: dict[str, Any] = dict.fromkeys(KINDS)
    for kind, word in zip(KINDS, ("position", "velocity", "", "effort"), strict=True):
        rows = [state.get(word, ()) for _, state in states]
        if any(len(joints) != len(names) for joints in rows):
            if kind == "positions":
                raise ProblemError(f"{file}: a joint state on {topic} has no positions", name="position")
            continue
        values[kind] = np.array([[joints[k] for k in order] for joints, order in zip(rows, orders, strict=True)])
    stamps = np.array([stamp for stamp, _ in states])
    places: dict[str, Any] = {"lines": np.arange(1, len(states) + 1), "notes": tuple(notes), "file": str(file)}
    return RawTrajectory(names, (stamps - stamps[0]) / 1e9, **values, names_are_joints=True, **places)


# ---- programs of industrial robots -------------------------------------------------------------------------------


def _read_program(file: FileName, language: RobotLanguage, period: float | None) -> RawTrajectory:
    """Read a robot program that `write_robot_program` wrote; spaces, empty lines and added comments are ignored."""
    patterns = [re.compile(statement, re.ASCII) for statement in language.statements]
    joints: dict[str, tuple[str, float]] = {}
    rows, steps, lines, stage = list[list[float]](), list[float](), list[int](), 0
    for number, text in enumerate(read_lines(file), 1):
        code, _, remark = text.partition(language.comment)
        statement = SPACED_SIGN.sub(r"\1", " ".join(code.split()))
        try:
            if match := AXIS_REMARK.fullmatch(" ".join(remark.split())):
                _name_axis(language, joints, match, bool(rows))
            if not statement:
                continue
            if stage == language.repeated and not patterns[stage].fullmatch(statement):
                stage += 1
            match = patterns[stage].fullmatch(statement) if stage < len(patterns) else None
            if match is None:
                raise ValueError(f"selfmotion writes no such statement here in {language.title}; remove it")
            stage += stage != language.repeated
            if match.lastindex:
                duration = match.groupdict().get("time")
                steps.append(0.0 if duration is None else _program_number(duration))
                positions = match.groups()[: match.lastindex - (duration is not None)]
                rows.append(_axis_positions(language, ",".join(positions), joints))
                lines.append(number)
        except ValueError as error:
            raise line_error(file, number, text, str(error)) from error
    if stage < len(patterns) or not rows:
        words = f"{file}: the {language.title} program has no point, or ends before its last statement; complete it"
        raise ProblemError(words, name="file", value=str(file))
    t, notes = np.cumsum(np.rint(np.array(steps) * 1e9)) / 1e9, tuple[str, ...]()
    if language is ROBOT_LANGUAGES["krl"]:
        if period is None:
            words = f"{file}: a KRL program has no times; give the sampling period that it was written with (--period)"
            raise ProblemError(words, name="period", value=None)
        t = np.arange(float(len(rows))) * period
        notes = (f"KRL has no times; they are multiples of the period of {period:g} s",)
    names = tuple(name for name, _ in joints.values())
    return RawTrajectory(names, t, np.array(rows), None, None, None, np.array(lines), True, notes, str(file))


def _name_axis(language: RobotLanguage, joints: dict[str, tuple[str, float]], match: re.Match[str], late: bool) -> None:
    """Store the joint and unit that a program comment assigns to a robot axis; raise ValueError if they are invalid."""
    axis, column, unit = match.groups()
    if axis not in (*language.arm, *language.external):
        return  # any other comment
    name = joint_name(column)
    if len(name) > INPUT_LIMITS.name_characters or not name.isprintable():
        raise ValueError(f"{column[:80]!r} is not the name of a joint; correct it")
    if late or axis in joints or name in [other for other, _ in joints.values()]:
        raise ValueError("comments must name each axis and joint once, before the first point; remove this one")
    joints[axis] = name, PROGRAM_UNITS[unit]


def _axis_positions(language: RobotLanguage, text: str, joints: dict[str, tuple[str, float]]) -> list[float]:
    """Return the joint positions, rad or m, in a statement of a robot program; raise ValueError if they are invalid."""
    items = text.split(",")
    if language is ROBOT_LANGUAGES["krl"]:
        pairs = [(item[:2].upper(), item[2:].strip()) for item in items]
    elif len(items) != (count := len(language.arm) + len(language.external)):
        raise ValueError(f"{len(items)} positions, there must be {count}; complete them")
    else:
        pairs = list(zip((*language.arm, *language.external), items, strict=True))
        pairs = [(axis, item) for axis, item in pairs if axis in joints or item not in ("0", ABSENT_AXIS)]
    values = dict(pairs)
    if len(pairs) != len(joints) or values.keys() != joints.keys():
        named = f"but comments name the joints of {', '.join(joints)}"
        raise ValueError(f"positions of the axes {', '.join(values)}, {named}")
    return [_program_number(values[axis]) * unit for axis, (_, unit) in joints.items()]


def _program_number(text: str) -> float:
    """Convert the text of a decimal number to a float; raise ValueError if the text is invalid or too long."""
    most = INPUT_LIMITS.number_characters
    if len(text) > most or not PROGRAM_NUMBER.fullmatch(text):
        raise ValueError(f"{text[:80]!r} is not a decimal number of at most {most} characters")
    return float(text)
