"""Read the entries of TOML files by name and type, with errors that name the line; obstacles; MoveIt's joint limits.

A file of obstacles has the shapes in world, each under [[obstacle]], as docs/guide/command.md shows them.
`joint_limits.yaml` is the file in which MoveIt keeps the limits that a URDF cannot state.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar
from warnings import warn

import casadi as ca
import numpy as np

from models import Mesh, ModelError, ModelWarning, MovingObstacle, Robot, checks
from models.checks import MAX_LISTED, NOT_NUMBERS, Array, floats, real
from models.files import INPUT_LIMITS
from models.shapes.shapes import SHAPE_KINDS, Shape
from models.spatial import rotation_from_rpy
from ocp.app.files.safe_files import FileName, checked_depth, line_error, read_lines, read_tree
from ocp.errors import ProblemError, require
from ocp.motion.tasks.limits import Limits

TABLE = re.compile(r"(\[\[?)([^\[\]#]+)\]\]?\s*(?:#.*)?$")
KEY = re.compile(r"""((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
BETWEEN = re.compile(r"[,=\[\]{}#]")
ERROR_LINE = re.compile(r"\(at line (\d+)")
Place: TypeAlias = tuple[Any, ...]
T = TypeVar("T")
Readers: TypeAlias = dict[str, tuple[Any, ...]]
"""Functions that read the entries of a table, by name, each with its arguments besides the table and the name."""
REQUIRED = object()
"""Default value that marks an entry as required."""
BY_JOINT = "a table of joints and numbers: { elbow = 1.2 }"


class TomlTable:
    """A table of a TOML file that records which entries were read, so that `done` can reject all others.

    Attributes:
        file: Name of the file.
        place: Keys and indices that lead from the root to the table.
        joints: Names of the joints for which entries may give numbers by name.
    """

    joints: tuple[str, ...] = ()

    def __init__(self, file: str, values: Any, *, place: Place, texts: Sequence[str], lines: dict[Place, int]) -> None:
        self.file, self.place = file, place
        self._texts, self._lines, self._values = texts, lines, values
        self._read_names: list[str] = []

    def __contains__(self, name: str) -> bool:
        self._read_names.append(name)
        return name in self._values

    def error(self, name: str | None, why: str) -> ProblemError:
        """Return a ProblemError about an entry, or about the table itself, with the line, its text, and the reason."""
        place = self.place if name is None else (*self.place, name)
        number = next((self._lines[place[:k]] for k in range(len(place), 0, -1) if place[:k] in self._lines), 1)
        text = self._texts[number - 1] if number <= len(self._texts) else ""
        error = line_error(self.file, number, text, why)
        error.name = name or ".".join(str(part) for part in place) or "file"
        return error

    def missing(self, name: str, expected: str) -> ProblemError:
        """Return the error about a missing entry, or about an unknown entry with a similar spelling if there is one."""
        unknown = [key for key in self._values if key not in self._read_names]
        if similar := checks.similar_names(name, unknown, 1):
            return self.error(similar[0], f"unknown entry {similar[0]}; did you mean {name}? It is {expected}")
        table = ".".join(str(part) for part in self.place if isinstance(part, str))
        where = f"in [{table}]" if table else "at the top"
        why = f"{where} {name!r} is missing: {expected}"
        return self.error(None, why) if self.place else ProblemError(f"{self.file}: {why}", name=name)

    def _read(self, name: str, default: Any, expected: str, is_valid: Callable[[Any], bool]) -> Any:
        """Return the value of an entry or its default; raise ProblemError if it is invalid, or missing but required."""
        self._read_names.append(name)
        if name not in self._values:
            if default is REQUIRED:
                raise self.missing(name, expected)
            return default
        value = self._values[name]
        if not is_valid(value):
            raise self.error(name, f"{name} must be {expected}, not {value!r}")
        return value

    def text(self, name: str, expected: str = "a text", default: Any = None) -> Any:
        """Return the entry `name` after checking that it is a non-empty text."""
        return self._read(name, default, expected, lambda value: isinstance(value, str) and value != "")

    def flag(self, name: str, default: bool = False) -> bool:
        """Return the entry `name` after checking that it is true or false."""
        return bool(self._read(name, default, "true or false", lambda value: isinstance(value, bool)))

    def choice(self, name: str, known: Iterable[str], default: Any = None) -> Any:
        """Return the entry `name` after checking that it is one of the known words."""
        words = tuple(known)
        expected = "one of " + ", ".join(f'"{word}"' for word in words)
        return self._read(name, default, expected, lambda value: isinstance(value, str) and value in words)

    def number(
        self, name: str, expected: str, default: Any = None, *, least: float = -np.inf, most: float = np.inf
    ) -> Any:
        """Return the entry `name` after checking that it is a number above `least` and at most `most`."""
        value = self._read(name, default, expected, lambda value: least < real(value) <= most and real(value) < np.inf)
        return value if value is None or value is default else float(value)

    def positive(self, name: str, unit: str, default: Any = None) -> Any:
        """Return the entry `name` after checking that it is a number above 0."""
        return self.number(name, f"a number above 0, {unit}", default, least=0.0)

    def nonnegative(self, name: str, unit: str, default: Any = None) -> Any:
        """Return the entry `name` after checking that it is a number, 0 or more."""
        return self.number(name, f"a number of 0 or more, {unit}", default, least=-1e-300)

    def count(self, name: str, expected: str, default: Any = None) -> Any:
        """Return the entry `name` after checking that it is an integer, 0 or more."""
        return self._read(name, default, expected, lambda value: type(value) is int and value >= 0)

    def vector(self, name: str, size: int | None, expected: str, default: Any = None) -> Any:
        """Return the entry `name` as a vector of `size` numbers, or of any length if `size` is None."""
        return self._array(name, default, expected, lambda shape: len(shape) == 1 and size in (None, shape[0]))

    def rows(self, name: str, size: int, expected: str, default: Any = None) -> Any:
        """Return the entry `name` as a matrix of rows of `size` numbers."""
        return self._array(name, default, expected, lambda shape: len(shape) == 2 and shape[1] == size)

    def _array(self, name: str, default: Any, expected: str, has_shape: Callable[[tuple[int, ...]], bool]) -> Any:
        """Return the entry `name` as an array after checking its shape and that its numbers are finite."""

        def fits(value: Any) -> bool:
            try:
                array = floats(value)
            except NOT_NUMBERS:
                return False
            flags = any(isinstance(entry, bool) for entry in np.array(value, dtype=object).flat)
            return isinstance(value, list) and has_shape(array.shape) and bool(np.isfinite(array).all()) and not flags

        value = self._read(name, default, expected, fits)
        return value if value is None or value is default else np.array(value, dtype=float)

    def numbers_by_name(self, name: str, expected: str, *, least: float = -np.inf) -> dict[str, float]:
        """Return the entry `name`, a table of numbers above `least`, as a dictionary; empty if it is missing."""
        table = self.table(name, expected)
        if table is None:
            return {}
        for key, value in table._values.items():
            if not np.inf > real(value) > least:
                raise table.error(key, f"{key} must be {expected if least > -np.inf else 'a number'}, not {value!r}")
        return {key: float(value) for key, value in table._values.items()}

    def values(self, readers: Readers) -> dict[str, Any]:
        """Read the entries that have a function in `readers`, and return the values of existing entries by name."""
        values = {name: read(self, name, *arguments) for name, (read, *arguments) in readers.items()}
        return {name: value for name, value in values.items() if value is not None}

    def build(self, kind: Callable[..., T], readers: Readers, **arguments: Any) -> T:
        """Call class or function `kind` with table entries and arguments; return its result. Errors state the line."""
        values = self.values(readers) | arguments
        self.done()
        with located_errors(self):
            return kind(**values)

    def nested(self, name: str, kind: Callable[..., T], readers: Readers) -> T | None:
        """Return the result of `build` for the nested table `name`; None if the table is missing."""
        table = self.table(name, f"a table of {', '.join(readers)}")
        return None if table is None else table.build(kind, readers)

    def texts(self, name: str, expected: str) -> tuple[str, ...]:
        """Return the entry `name` as a list of texts; empty if it is missing."""
        return tuple(self._read(name, [], expected, lambda value: _is_list_of(str, value)))

    def pairs(self, name: str, expected: str) -> tuple[tuple[str, str], ...]:
        """Return the entry `name` as a list of pairs of texts; empty if it is missing."""

        def fits(value: Any) -> bool:
            return _is_list_of(list, value) and all(len(pair) == 2 and _is_list_of(str, pair) for pair in value)

        return tuple((first, second) for first, second in self._read(name, [], expected, fits))

    def raw(self, name: str, default: Any = None) -> Any:
        """Return the entry `name`, which may be of any type, without a check."""
        return self._read(name, default, "", lambda value: True)

    def table(self, name: str, expected: str = "a table") -> TomlTable | None:
        """Return the nested table `name`, or None if it is missing."""
        return self.required_table(name, expected) if name in self else None

    def required_table(self, name: str, expected: str = "a table") -> TomlTable:
        """Return the nested table `name`; raise ProblemError if it is missing."""
        return self._inner(self._read(name, REQUIRED, expected, lambda value: isinstance(value, dict)), name)

    def tables_by_name(self, name: str) -> dict[str, TomlTable]:
        """Return all tables [name.KEY] that are nested in the required table `name`, by KEY."""
        outer = self.required_table(name, f"tables, each headed [{'.'.join([*map(str, self.place), name])}.NAME]")
        return {key: outer.required_table(key) for key in outer._values}

    def _inner(self, values: Any, *place: Any) -> TomlTable:
        """Return a table that is nested in this one, with its place in the file for error messages."""
        table = TomlTable(self.file, values, place=(*self.place, *place), texts=self._texts, lines=self._lines)
        table.joints = self.joints
        return table

    def tables(self, name: str) -> list[TomlTable]:
        """Return all tables of the array of tables [[name]]."""
        tables = self._read(name, [], f"tables, each headed [[{name}]]", lambda value: _is_list_of(dict, value))
        return [self._inner(values, name, k) for k, values in enumerate(tables)]

    def only(self, *names: str) -> None:
        """Raise ProblemError if the table has entries other than those with the given names."""
        self._read_names.extend(names)
        self.done()

    def done(self) -> None:
        """Raise ProblemError if the table has an unread entry; the error names its line and all known entries."""
        for name in self._values:
            if name not in self._read_names:
                similar, known = checks.similar_names(name, self._read_names), dict.fromkeys(self._read_names)
                hint = f"did you mean {' or '.join(similar)}?" if similar else f"known entries: {', '.join(known)}"
                raise self.error(name, f"unknown entry {name}; {hint}")


def _is_list_of(kind: type, value: Any) -> bool:
    """Return whether a value is a list with entries of one type only."""
    return isinstance(value, list) and all(isinstance(each, kind) for each in value)


def read_toml(file: FileName) -> TomlTable:
    """Return the root table of a TOML file.

    Raises:
        ProblemError: The file cannot be read, or is not valid TOML (names the line).
    """
    texts = read_lines(file, largest=INPUT_LIMITS.task_bytes)
    for number, text in enumerate(texts, 1):
        # the time of the parser grows quadratically with the parts of a name
        if any(part.count(".") > INPUT_LIMITS.nesting for part in BETWEEN.split(text)):
            why = f"a name has more than {INPUT_LIMITS.nesting} parts"
            raise line_error(file, number, text, why, limit=INPUT_LIMITS.nesting)
    try:
        values = checked_depth(tomllib.loads("\n".join(texts)))
    except tomllib.TOMLDecodeError as error:
        match = ERROR_LINE.search(str(error))
        number = min(int(match[1]), len(texts)) if match else len(texts)
        why = ERROR_LINE.split(str(error))[0].strip() or str(error)
        words = f"invalid TOML: {why}; write name = value, once for each name"
        raise line_error(file, number, texts[number - 1], words) from error
    except (RecursionError, ValueError) as error:  # ValueError: also for numbers with more digits than Python accepts
        raise ProblemError(f"{file} is no TOML or nested too deeply: {error}", name="file", value=str(file)) from error
    return TomlTable(str(file), values, place=(), texts=texts, lines=_places(texts))


def _places(texts: Sequence[str]) -> dict[Place, int]:
    """Return the line number of every table and entry of a TOML file, keyed by the names that lead to it."""
    lines: dict[Place, int] = {}
    counts: dict[Place, int] = {}
    table: Place = ()
    for number, text in enumerate(texts, 1):
        line = text.strip()
        if (head := TABLE.match(line)) and "=" not in head[2]:
            names = tuple(part.strip().strip("\"'") for part in head[2].split("."))
            table = ()
            for k, name in enumerate(names):
                table = (*table, name)
                if head[1] == "[[" and k == len(names) - 1:
                    counts[table] = counts.get(table, -1) + 1
                    table = (*table, counts[table])
                elif table in counts:
                    table = (*table, counts[table])
            lines.setdefault(table, number)
        elif key := KEY.match(line):
            place = table
            for part in key[1].split("."):
                place = (*place, part.strip().strip("\"'"))
                lines.setdefault(place, number)
    return lines


@contextmanager
def located_errors(entries: TomlTable, name: str | None = None) -> Iterator[None]:
    """Add file, line and entry to errors raised in a `with` block: the given entry, or the one that the error names."""
    try:
        yield
    except (ModelError, ProblemError) as error:
        entry = error.name if name is None else name
        located = entries.error(entry if entry is not None and entry in entries else None, str(error))
        located.value, located.limit = error.value, error.limit
        raise located from error


def joint_values(
    entries: TomlTable, name: str, default: float, allowed: tuple[str, float | None] = (BY_JOINT, None)
) -> Any:
    """Return an entry with one number for each joint name, as an array (n,), or None if the entry is missing.

    Joints without a number get `default`. `allowed` are the expected values in words, and the number that all are
    above. If there is such a number, the entry may also be one number for all joints, which is returned as it is.
    """
    expected, least = allowed
    if name not in entries:
        return None
    if least is not None and not isinstance(entries.raw(name), dict):
        return entries.number(name, expected, least=least)
    by_joint = entries.numbers_by_name(name, expected, least=-np.inf if least is None else least)
    for joint in by_joint:
        if joint not in entries.joints:
            table, names = entries.required_table(name), ", ".join(entries.joints)
            raise table.error(joint, f"the robot has no independent joint {joint!r}; it has {names}")
    return np.array([by_joint.get(joint, default) for joint in entries.joints])


# ---- joint limits ----------------------------------------------------------------------------------------------

LIMIT_KINDS = {"velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk", "effort": "torque"}
"""Names of the limits in joint_limits.yaml and in `Limits`."""
LIMIT_KEYS = [key for kind in LIMIT_KINDS for key in (f"has_{kind}_limits", f"max_{kind}")]
UNUSED_KEYS = {"max_position": "position", "min_position": "position", "max_deceleration": "deceleration"}
"""Known keys that `Limits` has no field for, and the kind of limit that they belong to."""
OTHER_KEYS = {"has_position_limits", "has_deceleration_limits", "angle_wraparound", "has_soft_limits", *UNUSED_KEYS}


def read_obstacles(file: FileName) -> tuple[Shape, ...]:
    """Read a file of obstacles and return their shapes in the order of the file.

    Raises:
        ProblemError: The file is invalid; names the line and what was expected.
    """
    entries = read_toml(file)
    shapes = obstacles_of(entries, Path(file).parent)
    entries.done()
    if not shapes:
        raise entries.missing("obstacle", 'tables headed [[obstacle]], each with shape = "box" or another')
    return shapes


def obstacles_of(entries: TomlTable, folder: Path, *, moving: bool = False) -> tuple[Any, ...]:
    """Return the obstacles that the [[obstacle]] tables of a TOML file describe; mesh files are relative to `folder`.

    If `moving` is true, an obstacle may have a constant `velocity`, m/s, and is then a MovingObstacle.
    """
    obstacles = list[Any]()
    for table in entries.tables("obstacle"):
        velocity = table.vector("velocity", 3, "three numbers, m/s") if moving else None
        obstacle = read_shape(table, folder)
        lengths = np.hstack([getattr(obstacle, entry, ()) for entry in ("position", "size", "radius")])
        checks.warn_of_millimetres(f"{entries.file}: a length of an obstacle,", lengths, "obstacle")
        with located_errors(table, "velocity"):
            move = None if velocity is None else partial(ca.mtimes, ca.DM(velocity))
            obstacles.append(obstacle if move is None else MovingObstacle(obstacle, move))
    return tuple(obstacles)


def rotation_of(entries: TomlTable, _: str = "", entry: str = "rpy") -> Array:
    """Return the rotation matrix (3, 3) of an entry with roll, pitch and yaw, rad; the identity if it is missing."""
    angles = entries.vector(entry, 3, "three angles, rad", (0.0, 0.0, 0.0))
    checks.warn_of_degrees(f"{entries.file}: {entry}", angles)
    return np.array(rotation_from_rpy(*(float(angle) for angle in angles)), dtype=float)


POSITION, SIZE = ((TomlTable.vector, 3, f"three {things}", REQUIRED) for things in ("numbers, m", "lengths, m"))
SHAPE_ENTRIES: Readers = {  # by the name of a field, the same for all shapes that have this field
    **dict.fromkeys(("position", "start", "end", "point"), POSITION),
    **dict.fromkeys(("radius", "length"), (TomlTable.positive, "m", REQUIRED)),
    "size": SIZE,
    "normal": (TomlTable.vector, 3, "three numbers: out of what is solid", REQUIRED),
    "rotation": (rotation_of, "rpy"),
    "scale": (TomlTable.positive, "m for each unit"),
}
SHAPES = {kind.__name__.lower(): kind for kind in SHAPE_KINDS}


def read_shape(table: TomlTable, folder: Path = Path(), kinds: Iterable[str] = SHAPES) -> Any:
    """Return the shape that a table describes; names of mesh files are relative to `folder`."""
    kind = SHAPES[table.choice("shape", kinds, REQUIRED)]
    readers = {each.name: SHAPE_ENTRIES[each.name] for each in fields(kind) if each.name in SHAPE_ENTRIES}
    if kind is not Mesh:
        return table.build(kind, readers)
    file = folder / table.text("file", "an STL, OBJ or DAE file", REQUIRED)
    return table.build(kind, readers | {"position": POSITION[:3]}, file=file)


def read_joint_limits(file: FileName, robot: Robot, *, scaling: bool = True) -> Limits:
    """Read the limits of a robot's joints from MoveIt's file joint_limits.yaml.

    The velocity, acceleration, jerk and effort limits of the file replace those of the robot description;
    ``has_velocity_limits: false`` stands for no limit. Joints without an entry keep the limits of the description.
    A joint also observes the limits of the joints that mimic it. Position limits remain those of the description.

    Args:
        file: YAML file with the mapping `joint_limits`, also below `robot_description_planning` or `ros__parameters`.
        scaling: Whether velocities and accelerations are multiplied by the file's default_velocity_scaling_factor and
            default_acceleration_scaling_factor, as MoveIt does by default.

    Raises:
        ProblemError: The file cannot be read or has no `joint_limits`, or a limit is missing or not positive; names the
            joint. The package `pyyaml` is not installed.

    Warns:
        ModelWarning: Joints that the robot does not have, and entries that are not used.
    """
    robot = require.instance("read_joint_limits: robot", robot, Robot)
    require.flag("read_joint_limits: scaling", scaling)
    tree = read_tree(file, "yaml")
    for key in ("/**", "ros__parameters", "robot_description_planning"):
        if isinstance(tree, Mapping) and "joint_limits" not in tree:
            tree = tree.get(key, tree)
    entries = tree.get("joint_limits") if isinstance(tree, Mapping) else None
    if not isinstance(entries, Mapping):
        raise _invalid(file, "joint_limits", "must be a mapping of joint names to limits", entries)
    names, unused = {joint.name for joint in robot.joints}, []
    limits: dict[str, dict[str, float]] = {kind: {} for kind in LIMIT_KINDS}
    for name, entry in entries.items():
        if name not in names:
            unused.append(f"joint {repr(name)[:80]}, which {robot.name!r} does not have")
            continue
        if not isinstance(entry, Mapping):
            raise _invalid(file, name, "must be a mapping of limits", entry)
        unused += [f"{note} of joint {name!r}" for note in _unused_keys(entry)]
        for kind in LIMIT_KINDS:
            if (value := _limit(file, name, entry, kind)) is not None:
                limits[kind][name] = value
    if unused:
        more = f"; and {len(unused) - MAX_LISTED} more" if len(unused) > MAX_LISTED else ""
        words = f"{file}: not used are {'; '.join(unused[:MAX_LISTED])}{more}"
        warn(ModelWarning(words, name=unused[0], value=tuple(unused)), stacklevel=2)
    factors = {kind: _factor(file, tree, kind) if scaling else 1.0 for kind in ("velocity", "acceleration")}
    values: dict[str, Any] = {}
    for kind, attribute in LIMIT_KINDS.items():
        factor = factors.get(kind, 1.0)
        if limits[kind] or (kind == "velocity" and factor < 1):
            vector = factor * _joint_vector(robot, kind, limits[kind])
            if kind in ("velocity", "effort") or np.isfinite(vector).any():  # else None says the same
                values[attribute] = vector
    return Limits(**values)


def _joint_vector(robot: Robot, kind: str, limits: Mapping[str, float]) -> Array:
    """Return the limits (dof,) of one kind for the independent joints, from a file or else the robot description."""
    vector = np.full(robot.dof, np.inf)
    for name, (column, multiplier, _) in robot.couplings.items():
        joint = robot.joint(name)
        if kind != "effort" or joint.mimic is None:  # mimic joints are driven by the joint that they mimic
            own = limits.get(name, getattr(joint, kind, 0.0) or np.inf)  # a limit of 0 in a description is unknown
            vector[column] = min(vector[column], own / abs(multiplier))
    return vector


def _limit(file: FileName, joint: str, entry: Mapping[Any, Any], kind: str) -> float | None:
    """Return a limit of a joint: inf if joint_limits.yaml switches it off, None if the file does not state it."""
    has, value = entry.get(f"has_{kind}_limits"), entry.get(f"max_{kind}")
    if has is not None and not isinstance(has, bool):
        raise _invalid(file, joint, f"has_{kind}_limits must be true or false", has, limit=(True, False))
    if has is False:
        return float(np.inf)
    if value is None and has is None:
        return None
    if not real(value) > 0:
        words = f"max_{kind} must be a positive number (has_{kind}_limits: false for no limit)"
        raise _invalid(file, joint, words, value, limit=0.0)
    return real(value)


def _factor(file: FileName, tree: Mapping[Any, Any], kind: str) -> float:
    """Return the default scaling factor of velocities or accelerations from joint_limits.yaml, by default 1."""
    key = f"default_{kind}_scaling_factor"
    if not 0 < real(tree.get(key, 1.0)) <= 1:
        raise _invalid(file, key, "must be a number above 0, at most 1", tree[key], limit=(0.0, 1.0))
    return float(tree.get(key, 1.0))


def _invalid(file: FileName, name: str, expected: str, value: Any, *, limit: Any = None) -> ProblemError:
    """Return the error about an invalid entry of joint_limits.yaml."""
    shown = repr(value)[:80]
    return ProblemError(f"{file}: {name}: {expected}, not {shown}", name=name, value=shown, limit=limit)


def _unused_keys(entry: Mapping[Any, Any]) -> list[str]:
    """Return the unused keys in a joint's entry of joint_limits.yaml, with a suggestion for each misspelt key."""
    used = [key for key, kind in UNUSED_KEYS.items() if key in entry and entry.get(f"has_{kind}_limits") is not False]
    unknown = [str(key) for key in entry if key not in LIMIT_KEYS and key not in OTHER_KEYS]
    similar = {key: get_close_matches(key[:80], LIMIT_KEYS, 1, 0.8) for key in unknown}
    return used + [f"{key[:80]}" + (f" (did you mean {similar[key][0]}?)" if similar[key] else "") for key in unknown]
