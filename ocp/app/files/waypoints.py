"""Read waypoints of a tool from tables that give positions and optionally orientations, tool axes or times.

The header names the columns in any order. A unit may follow a name, as in `x [mm]`, `y (mm)`, `z_mm` or `rx/deg`:

    x y z          position, m
    qw qx qy qz    tool orientation, quaternion; its sign has no meaning and is made continuous from row to row
    rx ry rz       tool orientation, rotation vector, rad
    ax ay az       or nx ny nz, or i j k: the tool axis, of any length
    t, time        s

Commas, semicolons, tabs or blanks separate the columns. `#` begins a comment; a comment may be the header. A table
without a header has exactly three columns, x, y, z. Name the columns of a pose with `columns`: a file of seven numbers
does not say whether w comes first or last.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import ModelError, Path, SmoothPath
from models.checks import ROUNDING, Array, short_repr, warn_of_degrees, warn_of_millimetres
from models.paths import Line, split_at_reversals
from models.paths.path import Reversal
from models.paths.segments import SHORTEST_SEGMENT, rotation_vector
from models.paths.splines import exponential, product
from ocp.app.files.program import DEFAULT_TOLERANCE_M, checked_reversal, smooth_path
from ocp.app.files.safe_files import FileName, TableRow, line_error, read_rows, table_numbers
from ocp.errors import ProblemError, require

POSITION, QUATERNION, VECTOR = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("rx", "ry", "rz")
AXIS = ("ax", "ay", "az")
KINDS = (POSITION, QUATERNION, VECTOR, AXIS, ("time",))
SIGNS = ("", "_", ".")
OTHER_NAMES = {
    **{f"{word}{sign}{axis}": axis for word in ("p", "pos", "position") for sign in SIGNS for axis in POSITION},
    **{f"{word}{sign}{q[1]}": q for word in ("q", "quat", "orientation") for sign in SIGNS for q in QUATERNION},
    **{f"{word}_{axis}": f"r{axis}" for word in ("r", "rot", "rotvec") for axis in POSITION},
    **dict(zip(("nx", "ny", "nz", "i", "j", "k"), AXIS * 2, strict=True)),
    **{f"{word}_{axis}": f"a{axis}" for word in ("a", "axis", "n", "normal") for axis in POSITION},
    "t": "time",
}
LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "in": 0.0254, "inch": 0.0254}
ANGLES = {"rad": 1.0, "deg": np.pi / 180, "°": np.pi / 180}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
HEAD = re.compile(r"^([\w.]+?)\s*(?:[\[(/ _]\s*(m|mm|cm|um|µm|in|inch|rad|deg|°|s|ms|us|ns)\s*[\])]?)?$")
SKIPPED = ("", "-", "index")


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Waypoints of a tool: positions, and orientations, tool axes or times if the file gives them.

    Attributes:
        positions: Positions of the tool. Shape (M, 3), m.
        orientations: Tool orientations, unit quaternions [w, x, y, z], or None. If the file gives only axes, the z axis
            is the tool axis and the roll about it changes as little as possible from row to row, see `free_roll`. Shape
            (M, 4).
        axes: Unit vectors of the tool axis, or None if the file gives none. Shape (M, 3).
        times: Times, s, increasing, or None. Shape (M,).
        names: Names of the columns that were read.
        ignored: Names of the columns that were not read.
        lines: Line number of each waypoint in the file. Shape (M,).
        file: Name of the file.
    """

    positions: Array
    orientations: Array | None
    axes: Array | None
    times: Array | None
    names: tuple[str, ...]
    ignored: tuple[str, ...]
    lines: NDArray[np.intp]
    file: str

    __repr__ = short_repr

    @property
    def free_roll(self) -> bool:
        """Whether the file gives only the tool axis, so that the rotation of the tool about this axis is arbitrary."""
        return self.axes is not None

    def paths(self, *, reversal: Reversal = "split") -> tuple[Path, ...]:
        """Return straight lines from waypoint to waypoint as paths; a path ends where its direction reverses.

        A waypoint at the position of the previous one is dropped.

        Args:
            reversal: "split", or the width (m) of the bulb in which the path turns round, see models.paths.path.

        Raises:
            ProblemError: The tool turns in place, or by half a turn or more between two waypoints (names the line);
                there are fewer than two distinct positions.
        """
        checked = checked_reversal("waypoints", reversal)
        lines: list[Line] = []
        last = 0
        for i in range(1, len(self.positions)):
            if np.linalg.norm(self.positions[i] - self.positions[last]) <= SHORTEST_SEGMENT:
                self._check_still(last, i)
                continue
            ends = (self.orientations[last], self.orientations[i]) if self.orientations is not None else (None, None)
            try:
                lines.append(Line(self.positions[last], self.positions[i], *ends))
            except ModelError as error:
                why = f"from line {self.lines[last]} to here {error}"
                raise line_error(self.file, int(self.lines[i]), self._description(i), why, limit=error.limit) from error
            last = i
        if not lines:
            message = f"{self.file}: all waypoints are at one place; a path needs two distinct ones"
            raise ProblemError(message, name="positions", value=self.positions[0])
        return tuple(path for path, _ in split_at_reversals(lines, checked))

    def path(self, *, reversal: Reversal | None = None) -> Path:
        """Return the straight lines from waypoint to waypoint as one path.

        Args:
            reversal: Width (m) of the bulb in which the path turns round where its direction reverses. None: a reversal
                is an error.

        Raises:
            ProblemError: As `paths`; the direction reverses.
        """
        paths = self.paths(reversal="split" if reversal is None else reversal)
        if len(paths) > 1:
            i = int(np.linalg.norm(self.positions - np.asarray(paths[0].segments[-1].end), axis=1).argmin())
            why = "the path reverses its direction; use paths(), which splits it there, or path(reversal=width in m)"
            raise line_error(self.file, int(self.lines[i]), self._description(i), why)
        return paths[0]

    def smooth(
        self, tolerance: float = DEFAULT_TOLERANCE_M, *, reversal: Reversal | None = None, **options: Any
    ) -> SmoothPath:
        """Return the path through the waypoints with rounded corners; splines replace runs of short lines.

        Args:
            tolerance: Largest deviation from the path, m; see `models.paths.fit_splines` for the splines.
            reversal: As in `path`.
            options: `kind`, `shape`, `overlap` of models.smooth.

        Raises:
            ProblemError: As `path`; the tolerance is not positive; an option is unknown.
        """
        return smooth_path(self.path(reversal=reversal), require.positive("tolerance", tolerance), options)[0]

    def _check_still(self, last: int, i: int) -> None:
        """Raise ProblemError if the tool turns between two waypoints without a change of position."""
        if self.orientations is None:
            return
        turn = np.pi
        with suppress(ModelError):  # of half a turn, whose rotation vector is not unique
            turn = float(np.linalg.norm(rotation_vector(self.orientations[last], self.orientations[i])))
        if turn > ROUNDING:
            why = f"the tool turns by {np.degrees(turn):.4g} deg in place; turn it along the path, or drop the line"
            raise line_error(self.file, int(self.lines[i]), self._description(i), why, limit=ROUNDING)

    def _description(self, i: int) -> str:
        return f"waypoint {i} at {self.positions[i].tolist()} m"


def read_waypoints(file: FileName, *, unit: str | None = None, columns: Sequence[str] | None = None) -> Waypoints:
    """Read waypoints of a tool from a table, whose format the docstring of this module describes.

    Args:
        unit: Unit of positions for which the header gives none: "m", "mm", "cm", "um" or "inch". None: m, with a
            warning if the values look like millimetres.
        columns: Names of the columns, used instead of the header if there is one; "" or "-" for a column to be ignored.

    Raises:
        ProblemError: The file is empty, columns are missing, or a unit is unknown. With the line: a row is too short or
            has a value that is not a finite number, times do not increase, a quaternion is not normalised, or an axis
            is zero.

    Warns:
        ModelWarning: Positions look like millimetres, or angles like degrees.
    """
    if unit is not None:
        require.choice("waypoints: unit", unit, tuple(LENGTHS))
    rows, comment = read_rows(file)
    named = set(POSITION) <= {_name_and_unit(cell)[0] for cell in comment.cells}
    if named and len(comment.cells) == len(rows[0].cells):  # as numpy.savetxt writes a head
        rows.insert(0, comment)
    head, first = _head(file, rows[0], columns)
    rows = rows[first:]
    if not rows:
        raise ProblemError(f"{file}: the file has a header but no waypoint", name="file", value=str(file))
    names, scales, ignored = _columns(file, head, unit)
    table = table_numbers(file, rows, [bool(name) for name in names])
    if (invalid := ~np.isfinite(table).all(axis=1)).any():
        raise _row_error(file, rows, invalid, "a number is not finite; correct it or drop the line")
    parts = {
        kind: np.column_stack([table[:, names.index(name)] * scales[names.index(name)] for name in kind])
        for kind in KINDS
        if all(name in names for name in kind)
    }
    times = parts[("time",)][:, 0] if ("time",) in parts else None
    if times is not None and (late := np.append(False, np.diff(times) <= 0)).any():
        i = int(late.argmax())
        raise _row_error(file, rows, late, f"the time {times[i]:g} s is not after {times[i - 1]:g} s; sort the rows")
    positions = parts[POSITION]
    units = [_name_and_unit(cell)[1] for cell, name in zip(head, names, strict=True) if name in POSITION]
    if unit is None and not any(units):
        warn_of_millimetres(f"{file!s}: an extent of the waypoints of", np.ptp(positions, axis=0).max(), "unit")
    orientations, axes = _orientations(file, parts, rows)
    used_names = tuple(name for name in names if any(name in kind for kind in parts))
    lines = np.array([row.number for row in rows])
    return Waypoints(positions, orientations, axes, times, used_names, ignored, lines, str(file))


def _orientations(
    file: FileName, parts: Mapping[Any, Array], rows: Sequence[TableRow]
) -> tuple[Array | None, Array | None]:
    """Return the quaternions of waypoints and, if the file gives only tool axes, the axes; each None if unknown."""
    axes = _axes(file, parts[AXIS], rows) if AXIS in parts else None
    if QUATERNION in parts:
        return align_signs(_quaternions(file, parts[QUATERNION], rows)), None
    if VECTOR in parts:
        warn_of_degrees(f"{file!s}: an angle of the waypoints of", parts[VECTOR], "rx, ry, rz")
        return align_signs(exponential(parts[VECTOR])), None
    return (None if axes is None else align_signs(_least_roll(file, axes, rows))), axes


def _row_error(file: FileName, rows: Sequence[TableRow], invalid: Any, why: str, limit: Any = None) -> ProblemError:
    """Return the error about the first invalid row of a table."""
    row = rows[int(np.argmax(invalid))]
    return line_error(file, row.number, row.text, why, limit=limit)


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    """Return the standard name of a column, "" if it is invalid, and the unit that its header cell states, or None."""
    match = HEAD.match(" ".join(cell.lower().split()))
    name = match[1].removeprefix("pose.") if match else ""
    return OTHER_NAMES.get(name, name), match[2] if match else None


def _head(file: FileName, first: TableRow, columns: Sequence[str] | None) -> tuple[list[str], int]:
    """Return the names of the columns, from the header or the caller, and the index of the first row of data."""
    cells = first.cells
    if columns is not None:
        names = [] if isinstance(columns, str) else list(require.each("columns", columns, str))
        if len(names) != len(cells):
            message = f"{file}: {len(names)} columns are named, the first row has {len(cells)}; name every column"
            raise ProblemError(message, name="columns", value=columns, limit=len(cells))
        labels = [cell for cell in cells if cell]
        is_enumeration = len(labels) > 1 and labels == [str(i) for i in range(len(labels))]
        return names, 1 if first.has_names or is_enumeration or len(labels) < len(cells) else 0
    if first.has_names:
        return cells, 1
    if len(cells) != 3:
        why = f"no header names the {len(cells)} columns; name them there, or with columns=('x', 'y', 'z', ...)"
        raise line_error(file, first.number, first.text, why)
    return list(POSITION), 0


def _columns(file: FileName, head: Sequence[str], unit: str | None) -> tuple[list[str], list[float], tuple[str, ...]]:
    """Return standard name ("" if ignored) and factor to SI units of each column, and the names of ignored columns."""
    names: list[str] = []
    scales: list[float] = []
    ignored: list[str] = []
    for cell in head:
        name, unit_name = _name_and_unit(cell)
        kind = next((kind for kind in KINDS if name in kind), None)
        scale = 1.0
        if kind is None:
            ignored += [cell] if cell.strip() not in SKIPPED else []
            name = ""
        elif name in names:
            raise ProblemError(f"{file}: two columns are named {name}; remove one", name=name, value=tuple(head))
        else:
            units = {POSITION: LENGTHS, VECTOR: ANGLES, ("time",): TIMES}.get(kind, {})
            if unit_name is not None and unit_name not in units:
                known = ", ".join(units) or "no unit"
                message = f"{file}: the column {cell!r} cannot be in {unit_name}; known: {known}"
                raise ProblemError(message, name=name, value=unit_name, limit=tuple(units))
            if kind == POSITION:
                if unit_name is not None and unit is not None and LENGTHS[unit_name] != LENGTHS[unit]:
                    message = f"{file}: the header says {cell!r}, the caller unit={unit!r}; omit unit"
                    raise ProblemError(message, name="unit", value=unit, limit=unit_name)
                scale = LENGTHS[unit_name or unit or "m"]
            elif unit_name is not None:
                scale = units[unit_name]
        names.append(name)
        scales.append(scale)
    _check_complete(file, head, names)
    return names, scales, tuple(ignored)


def _check_complete(file: FileName, head: Sequence[str], names: Sequence[str]) -> None:
    """Raise ProblemError unless the columns include the position, and all components of every other quantity."""
    for kind in KINDS:
        missing = [name for name in kind if name not in names]
        if missing and (kind == POSITION or len(missing) < len(kind)):
            message = f"{file}: no column {', '.join(missing)} among {', '.join(repr(cell) for cell in head)}"
            remedy = "name it in the header or with columns="
            if head and re.fullmatch(r"[GMNO]\d+.*", head[0]):
                remedy = "is it G-code? Read it in Python: ocp.app.files.read_gcode"
            raise ProblemError(f"{message}; {remedy}", name=missing[0], value=tuple(head))


def _quaternions(file: FileName, values: Array, rows: Sequence[TableRow]) -> Array:
    """Normalise quaternions; raise ProblemError if the norm of a quaternion differs from 1 by more than 0.01."""
    norm = np.linalg.norm(values, axis=1)
    norm_tolerance = 1e-2  # a larger deviation is not explained by rounding in the file
    if (invalid := np.abs(norm - 1) > norm_tolerance).any():
        why = f"the quaternion has the norm {norm[invalid.argmax()]:.6g}; give a unit quaternion"
        raise _row_error(file, rows, invalid, why, norm_tolerance)
    return np.asarray(values / norm[:, None])


def _axes(file: FileName, values: Array, rows: Sequence[TableRow]) -> Array:
    """Return the tool axes (M, 3) of a table as unit vectors; raise ProblemError, with the line, if one is zero."""
    norm = np.linalg.norm(values, axis=1)
    if not (norm > 0).all():
        raise _row_error(file, rows, ~(norm > 0), "the tool's axis is zero; give a direction")
    return np.asarray(values / norm[:, None])


def align_signs(quaternions: Array) -> Array:
    """Choose the sign of each quaternion so that the quaternion is as close as possible to the previous one."""
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(quaternions * np.cumprod(np.concatenate([[1.0], signs]))[:, None])


def _least_roll(file: FileName, axes: Array, rows: Sequence[TableRow]) -> Array:
    """Return orientations with the given tool axes as z axes and with least rotation about these axes."""
    previous = np.vstack([[0.0, 0.0, 1.0], axes[:-1]])
    steps = np.column_stack([1 + (previous * axes).sum(axis=1), np.cross(previous, axes)])
    opposite = steps[:, 0] < 1e-7  # 1 + cosine; half of the digits of double precision
    if opposite[0]:
        steps[0], opposite[0] = (0.0, 1.0, 0.0, 0.0), False  # upside down: about x
    if opposite.any():
        i = int(opposite.argmax())
        why = f"the tool axis is opposite to that of line {rows[i - 1].number}, so the direction of the turn is "
        raise _row_error(file, rows, opposite, f"{why}ambiguous; insert a waypoint between them")
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    orientations = np.empty_like(steps)
    current = np.array([1.0, 0.0, 0.0, 0.0])
    for i, step in enumerate(steps):
        current = product(step, current)
        orientations[i] = current
    return np.asarray(orientations / np.linalg.norm(orientations, axis=1)[:, None])
