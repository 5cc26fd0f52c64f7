"""Anybody's joint trajectories, read as they are: CSV, JointTrajectory as JSON or YAML, MCAP.

Nothing is put right that may be wrong with the motion: values that are no numbers, times that do not increase and
joints that nobody has are kept, for who checks the motion to name them.

A CSV has a head. `time` or `t` is the time; a column is a joint's position by the joint's name, or one of its
velocities, accelerations or efforts by a word behind or before it: `elbow.velocity`, `elbow_vel`, `velocity/elbow`. A
unit may stand in brackets: `elbow [deg]`, `time [ms]`. Commas, semicolons, tabs or blanks part the columns, `#` begins
a comment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.app.files.mcap import read_joint_messages
from ocp.app.files.text_files import FileName, children_of, is_number, line_error, read_lines, read_tree, split_cells
from ocp.errors import NOT_NUMBERS, ProblemError, checked_choice, checked_each, checked_positive, checked_text
from ocp.storage import table_joints

Indices: TypeAlias = NDArray[np.intp]

__all__ = ["KINDS", "RawTrajectory", "read_trajectory"]

KINDS = ("positions", "velocities", "accelerations", "efforts")
WORDS = {
    **dict.fromkeys(("position", "positions", "pos", "q"), "positions"),
    **dict.fromkeys(("velocity", "velocities", "vel", "rate", "dq", "qd"), "velocities"),
    **dict.fromkeys(("acceleration", "accelerations", "acc", "accel", "ddq", "qdd"), "accelerations"),
    **dict.fromkeys(("effort", "efforts", "torque", "torques", "tau"), "efforts"),
}
TIMES = ("time", "t", "time_from_start", "timestamp", "secs", "seconds")
UNITS = {
    "s": 1.0,
    "sec": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "rad": 1.0,
    "deg": np.pi / 180,
    "°": np.pi / 180,
    "m": 1.0,
    "mm": 1e-3,
    "cm": 1e-2,
    "n m": 1.0,
    "nm": 1.0,
    "n": 1.0,
}
HEAD = re.compile(r"(.*)[\[(]([^\[(\])]*)[\])]")
FORMATS = {".json": "json", ".yaml": "yaml", ".yml": "yaml", ".mcap": "mcap"}


@dataclass(frozen=True, eq=False)
class RawTrajectory:
    """What a file says of joints over time, its faults and all.

    Attributes:
        names: Of the joints. Those of a table may be columns of something else: nothing in it tells.
        t: As they stand, s. Shape (M,).
        positions, velocities, accelerations, efforts: nan where there is none; None where the file has none of the
            kind. Shape (M, n), rad or m, N m or N.
        lines: Of the file, or numbers of points or messages, from 1. Shape (M,).
        names_are_joints: Whether the file says of every name that it is a joint's.
        notes: What was passed over, or converted.
        file: Its name.
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


def read_trajectory(
    file: FileName,
    *,
    columns: Sequence[str] | None = None,
    period: float | None = None,
    topic: str | None = None,
    joints: Sequence[str] = (),
    kind: str | None = None,
) -> RawTrajectory:
    """The trajectory in a file.

    Args:
        file: .csv or any text, .json, .yaml (needs the package `pyyaml`), .mcap (needs `mcap`).
        columns: Names of the columns of a table without a head.
        period: Of the samples, s, where the table has no time.
        topic: Of an MCAP with several.
        joints: Names that are joints even where they look like something else.
        kind: "csv", "json", "yaml" or "mcap"; None: by the end of its name.

    Raises:
        ProblemError: A file that cannot be read, or holds no trajectory; by line where it has lines.
    """
    if not isinstance(file, str | Path):
        raise ProblemError(f"a file name is expected, not {file!r}", name="file", value=file)
    if kind is None:
        kind = FORMATS.get(Path(file).suffix.lower(), "csv")
    checked_choice("kind", kind, ("csv", "json", "yaml", "mcap"))
    if topic is not None:
        checked_text("topic", topic)
    if period is not None:
        checked_positive("period", period)
    if columns is not None:
        columns = checked_each("columns", columns, str)
    known = frozenset(checked_each("joints", joints, str))
    if isinstance(joints, str):
        raise ProblemError(f"joints must be a list of names, not {joints!r}", name="joints", value=joints)
    if kind == "csv":
        return _read_table(file, columns, period, known)
    if kind == "mcap":
        return _from_messages(file, *read_joint_messages(file, topic))
    return _from_points(file, read_tree(file, kind))


# ---- tables ------------------------------------------------------------------------------------------------------


def _read_table(
    file: FileName, columns: Sequence[str] | None, period: float | None, joints: frozenset[str]
) -> RawTrajectory:
    numbers, texts = [], []
    for number, text in enumerate(read_lines(file), 1):
        line = text.partition("#")[0]
        if line.strip(" "):
            numbers.append(number)
            texts.append(line.strip(" "))
    if not texts:
        raise ProblemError(f"{file}: the file is empty but for comments", name="file", value=str(file))
    delimiter = next((sign for sign in ";,\t" if sign in texts[0]), " ")
    first = split_cells(texts[0], delimiter)
    if columns is None:
        if all(is_number(cell or "nan") for cell in first):
            why = "no head names the columns; name them: --columns time,NAME,... (columns=), in their order"
            raise line_error(file, numbers[0], texts[0], why)
        head, rows, numbers = first, texts[1:], numbers[1:]
    else:
        told = not all(is_number(cell or "nan") for cell in first)
        head, rows, numbers = list(columns), texts[told:], numbers[told:]
    while head and not head[-1].strip():  # a delimiter at the end of every line
        head = head[:-1]
    if not rows:
        raise ProblemError(f"{file}: there is a head and no sample", name="file", value=str(file))
    table = _numbers(file, rows, numbers, delimiter, len(head))
    time, found, notes = _meanings(file, head, joints)
    if time is None and period is None:
        words = f"{file}: no column is the time among {', '.join(map(repr, head))}; name one `time`, or tell the period"
        raise ProblemError(words, name="time", value=tuple(head))
    t = np.asarray(np.arange(len(rows)) * (period or 0.0) if time is None else table[:, time[0]] * time[1], dtype=float)
    names = tuple(dict.fromkeys(name for name, _ in found))
    values: dict[str, Array] = {}
    for (name, what), (column, scale) in found.items():
        array = values.setdefault(what, np.full((len(rows), len(names)), np.nan))
        array[:, names.index(name)] = table[:, column] * scale
    if "positions" not in values:
        words = f"{file}: no column is a position among {', '.join(map(repr, head))}; name columns as the joints"
        raise ProblemError(words, name="positions", value=tuple(head))
    v, a, efforts = (values.get(what) for what in KINDS[1:])
    lines = np.array(numbers)
    return RawTrajectory(names, t, values["positions"], v, a, efforts, lines, False, tuple(notes), str(file))


def _numbers(file: FileName, rows: list[str], numbers: list[int], delimiter: str, width: int) -> Array:
    """The table; nan where a cell is empty. Shape (M, width)."""
    split = [split_cells(row, delimiter) for row in rows]
    for row, number, cells in zip(rows, numbers, split, strict=True):
        if len(cells) != width:
            while len(cells) > width and not cells[-1]:
                cells.pop()
            if len(cells) != width:
                why = f"{len(cells)} columns, the head has {width}; complete the row"
                raise line_error(file, number, row, why, width)
    try:
        return np.array(split, dtype=float)
    except ValueError:
        pass
    for row, number, cells in zip(rows, numbers, split, strict=True):
        for k, cell in enumerate(cells):
            if not is_number(cell or "nan"):
                raise line_error(file, number, row, f"{cell!r} is no number; correct it")
            cells[k] = cell or "nan"
    return np.array(split, dtype=float)


def _meanings(
    file: FileName, head: list[str], joints: frozenset[str]
) -> tuple[tuple[int, float] | None, dict[tuple[str, str], tuple[int, float]], list[str]]:
    """Column and unit of the time; those of each joint's values by name and kind; notes."""
    if own := table_joints(head):  # whatever their names seem to mean
        columns = [(name, kind) for kind in KINDS[:3] for name in own]
        return (0, 1.0), {key: (column, 1.0) for column, key in enumerate(columns, 1)}, []
    time: tuple[int, float] | None = None
    found: dict[tuple[str, str], tuple[int, float]] = {}
    notes = []
    for column, cell in enumerate(head):
        name, unit = cell.strip(), ""
        if name not in joints and (told := HEAD.fullmatch(name)):
            name, unit = told[1].strip(), told[2].strip().lower()
            for ending in ("/s^2", "/s2", "/s²", "/s"):
                unit = unit.removesuffix(ending) or unit
            if unit and unit not in UNITS:
                words = f"{file}: the column {cell!r} is in an unknown unit; known: {', '.join(UNITS)}"
                raise ProblemError(words, name=name, value=unit, limit=tuple(UNITS))
        scale = UNITS.get(unit, 1.0)
        if scale != 1.0:
            notes.append(f"{name} is converted from {unit}")
        if name.lower() in TIMES and name not in joints:
            if time is not None:
                raise ProblemError(f"{file}: two columns are the time; leave one", name="time", value=tuple(head))
            time = column, scale
            continue
        if not name:
            notes.append(f"column {column + 1} has no name and is not read")
            continue
        key = (name, "positions") if name in joints else _kind(name)
        if key[0] not in joints and (last := key[0].rpartition("/")[2]) in joints:  # with the name of a topic before it
            key = last, key[1]
        if key in found:
            raise ProblemError(f"{file}: {cell!r} heads two columns; leave one", name=name, value=tuple(head))
        found[key] = column, scale
    return time, found, notes


def _kind(name: str) -> tuple[str, str]:
    """The joint and the kind of value that a column's name says."""
    for sign in "./:_ ":
        before, _, last = name.rpartition(sign)
        if before and last.lower() in WORDS:
            return before, WORDS[last.lower()]
        first, _, behind = name.partition(sign)
        if behind and first.lower() in WORDS:
            return behind, WORDS[first.lower()]
    return name, "positions"


# ---- trees of names: JSON, YAML ----------------------------------------------------------------------------------


def _trajectory_in(tree: Any, depth: int = 6) -> Mapping[str, Any] | None:
    """The outermost mapping in it that has joint names and points; each value is looked at once."""
    level, seen = [tree], set[int]()
    for _ in range(depth + 1):
        below: list[Any] = []
        for one in level:
            if isinstance(one, Mapping) and "joint_names" in one and "points" in one:
                return one
            for part in children_of(one)[:100]:
                if id(part) not in seen:
                    seen.add(id(part))
                    below.append(part)
        level = below
    return None


def _from_points(file: FileName, tree: Any) -> RawTrajectory:
    message = _trajectory_in(tree)
    if message is None:
        words = f"{file} holds no joint trajectory: joint_names and points are expected"
        raise ProblemError(words, name="joint_names", value=str(file))
    names, points = message["joint_names"], message["points"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or len(set(names)) != len(names):
        words = f"{file}: joint_names must be names that differ, not {str(names)[:80]}"
        raise ProblemError(words, name="joint_names", value=names)
    if not isinstance(points, list) or not points or not all(isinstance(point, Mapping) for point in points):
        raise ProblemError(
            f"{file}: points must be a list of at least one point", name="points", value=repr(points)[:80]
        )
    t = np.array([_seconds(file, number, point) for number, point in enumerate(points, 1)])
    notes: list[str] = []
    values: dict[str, Array | None] = {}
    for kind in KINDS:
        word = "effort" if kind == "efforts" else kind
        given = [point.get(word) or [] for point in points]
        lacking = [number for number, one in enumerate(given, 1) if not one]
        if len(lacking) == len(given) and kind != "positions":
            values[kind] = None
            continue
        if lacking and kind == "positions":
            raise ProblemError(f"{file}: point {lacking[0]} has no positions", name=f"point {lacking[0]}")
        if lacking:
            notes.append(
                f"{len(lacking)} of {len(given)} points have no {kind}, point {lacking[0]} first: none are used"
            )
            values[kind] = None
            continue
        values[kind] = _rows(file, word, given, len(names))
    position = values["positions"]
    assert position is not None
    lines = np.arange(1, len(points) + 1)
    v, a, efforts = (values[kind] for kind in KINDS[1:])
    return RawTrajectory(tuple(names), t, position, v, a, efforts, lines, True, tuple(notes), str(file))


def _rows(file: FileName, word: str, given: list[Any], width: int) -> Array:
    rows = np.full((len(given), width), np.nan)
    for number, one in enumerate(given, 1):
        if not isinstance(one, list) or len(one) != width:
            count = len(one) if isinstance(one, list) else repr(one)[:80]
            words = f"{file}: point {number}: {word} has {count} entries, there are {width} joints"
            raise ProblemError(words, name=f"point {number}", value=count, limit=width)
        try:
            rows[number - 1] = [np.nan if value is None else float(value) for value in one]
        except NOT_NUMBERS as error:
            words = f"{file}: point {number}: {word} are no numbers: {str(one)[:80]}"
            raise ProblemError(words, name=f"point {number}", value=one) from error
    return rows


def _seconds(file: FileName, number: int, point: Mapping[str, Any]) -> float:
    """Of a duration, as ROS 2 or ROS 1 writes it, or a number of seconds."""
    told = point.get("time_from_start")
    try:
        if isinstance(told, Mapping):
            whole = told["sec"] if "sec" in told else told["secs"]
            part = told.get("nanosec", told.get("nsecs", told.get("nsec", 0)))
            return float(whole) + float(part) / 1e9
        if told is None or isinstance(told, bool):
            raise TypeError("missing")
        return float(told)
    except (*NOT_NUMBERS, KeyError) as error:
        words = f"{file}: point {number}: time_from_start must be sec and nanosec, not {told!r}"
        raise ProblemError(words, name=f"point {number}", value=told) from error


# ---- logs --------------------------------------------------------------------------------------------------------


def _from_messages(file: FileName, topic: str, messages: list[tuple[int, Any]]) -> RawTrajectory:
    """Joint states, one a message; or the first joint trajectory, whose points are the samples."""
    notes = []
    first = messages[0][1]
    if "points" in first:
        if len(messages) > 1:
            notes.append(f"{topic} holds {len(messages)} trajectories, of which the first is read")
        found = _from_points(file, first)
        return RawTrajectory(**{**vars(found), "notes": (*found.notes, *notes)})
    sets: dict[frozenset[str], int] = {}
    for _, state in messages:
        sets[frozenset(state["name"])] = sets.get(frozenset(state["name"]), 0) + 1
    chosen = max(sets, key=lambda one: sets[one])
    kept = [(stamp, state) for stamp, state in messages if frozenset(state["name"]) == chosen]
    if len(kept) < len(messages):
        notes.append(
            f"{len(messages) - len(kept)} of {len(messages)} messages on {topic} are of other joints, not read"
        )
    names = tuple(kept[0][1]["name"])
    if len(set(names)) != len(names) or not names:
        raise ProblemError(f"{file}: the joints {names} on {topic} are none, or repeat", name="name", value=names)
    orders = [[state["name"].index(name) for name in names] for _, state in kept]
    values: dict[str, Array | None] = {}
    for kind, word in zip(KINDS, ("position", "velocity", "", "effort"), strict=True):
        given = [state.get(word, ()) for _, state in kept]
        if any(len(one) != len(names) for one in given):
            if kind == "positions":
                raise ProblemError(f"{file}: a joint state on {topic} lacks positions", name="position")
            values[kind] = None
            continue
        values[kind] = np.array([[one[k] for k in order] for one, order in zip(given, orders, strict=True)])
    stamps = np.array([stamp for stamp, _ in kept])
    position = values["positions"]
    assert position is not None
    t = (stamps - stamps[0]) / 1e9
    v, a, efforts = (values[kind] for kind in KINDS[1:])
    lines = np.arange(1, len(kept) + 1)
    return RawTrajectory(names, t, position, v, a, efforts, lines, True, tuple(notes), str(file))
