"""Waypoints from tables: positions, and what is told of the tool at them, as orientations or as axes.

The head names the columns, in any order; a unit may stand behind a name, as in `x [mm]`, `y (mm)`, `z_mm` or `rx/deg`:

    x y z          position, m
    qw qx qy qz    tool orientation, quaternion; its sign is of no meaning and is aligned from row to row
    rx ry rz       tool orientation, rotation vector, rad
    ax ay az       or nx ny nz, or i j k: the tool's axis, of any length
    t, time        s

Commas, semicolons, tabs or blanks part the columns, `#` begins a comment, which may be the head. Without a head only
three columns are read, as x, y, z: the seven of a pose may have w first or last, and nothing in the file tells; name
`columns`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import ModelError, Path, SmoothPath
from models.arrays import ROUNDING, Array, warn_of_degrees, warn_of_millimetres
from models.paths import Line, split_at_reversals
from models.paths.orientation import product, rotation_vector
from models.paths.path import Reversal
from models.paths.segments import SHORTEST_SEGMENT
from ocp.app.files.lines import FileName, cells_of, is_number, read_lines, wrong_line
from ocp.app.files.program import TOLERANCE, checked_reversal, smoothed
from ocp.errors import ProblemError, checked_choice, checked_each, checked_positive

__all__ = ["Waypoints", "read_waypoints"]

POSITION, QUATERNION, VECTOR = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("rx", "ry", "rz")
AXIS = ("ax", "ay", "az")
KINDS = (POSITION, QUATERNION, VECTOR, AXIS, ("time",))
OTHER_NAMES = {
    **{
        f"{word}{sign}{axis}": axis for word in ("p", "pos", "position") for sign in ("", "_", ".") for axis in POSITION
    },
    **{
        f"{word}{sign}{q[1]}": q for word in ("q", "quat", "orientation") for sign in ("", "_", ".") for q in QUATERNION
    },
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
    """Where a tool is to pass.

    Attributes:
        positions: Shape (M, 3), m.
        orientations: Of the tool, unit quaternions [w, x, y, z], or None. Where only axes are given, their z axis is
            the tool's axis and the roll about it is the least from row to row: see `free_roll`. Shape (M, 4).
        axes: The tool's axis, unit vectors, or None where none are given. Shape (M, 3).
        times: s, increasing, or None. Shape (M,).
        names: Of the columns that were read.
        ignored: Columns that were not.
        lines: Of the file. Shape (M,).
        file: Its name.
    """

    positions: Array
    orientations: Array | None
    axes: Array | None
    times: Array | None
    names: tuple[str, ...]
    ignored: tuple[str, ...]
    lines: NDArray[np.intp]
    file: str

    @property
    def free_roll(self) -> bool:
        """Whether the roll about the tool's axis is made up: the file gives the axis alone."""
        return self.axes is not None

    def paths(self, *, reversal: Reversal = "split") -> tuple[Path, ...]:
        """Straight lines from point to point, as one path or, where they turn back the way they came, several.

        Waypoints at the place of the one before are dropped.

        Args:
            reversal: "split", or the width (m) of the bulb in which the path turns round, see models.paths.chains.

        Raises:
            ProblemError: By line: a tool that turns in one place, or by half a turn and more between two waypoints;
                less than two places.
        """
        turned_round = checked_reversal("waypoints", reversal)
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
                raise wrong_line(self.file, int(self.lines[i]), self._shown(i), why, error.limit) from error
            last = i
        if not lines:
            message = f"{self.file}: all waypoints are at one place; a path needs two"
            raise ProblemError(message, name="positions", value=self.positions[0])
        return tuple(path for path, _ in split_at_reversals(lines, turned_round))

    def path(self, *, reversal: Reversal | None = None) -> Path:
        """The one path of `paths`.

        Args:
            reversal: Width (m) of the bulb in which the path turns round where it goes back the way it came. None
                refuses that.

        Raises:
            ProblemError: As of `paths`; points that turn back.
        """
        found = self.paths(reversal="split" if reversal is None else reversal)
        if len(found) > 1:
            end = np.asarray(found[0].segments[-1].end)
            i = int(np.linalg.norm(self.positions - end, axis=1).argmin())
            why = "the path turns back the way it came; take paths(), which ends there, or path(reversal=width in m)"
            raise wrong_line(self.file, int(self.lines[i]), self._shown(i), why)
        return found[0]

    def smooth(self, tolerance: float = TOLERANCE, *, reversal: Reversal | None = None, **options: Any) -> SmoothPath:
        """The path with its corners rounded.

        Args:
            tolerance: How far (m) it may stray.
            reversal: As of `path`.
            options: `kind`, `shape`, `overlap` of models.smooth.

        Raises:
            ProblemError: As of `path`; a tolerance that is not positive, unknown options.
        """
        return smoothed(self.path(reversal=reversal), checked_positive("tolerance", tolerance), options)

    def _check_still(self, last: int, i: int) -> None:
        if self.orientations is None:
            return
        turn = np.pi
        with suppress(ModelError):  # half a turn
            turn = float(np.linalg.norm(rotation_vector(self.orientations[last], self.orientations[i])))
        if turn > ROUNDING:
            why = f"the tool turns by {np.degrees(turn):.4g} deg in one place; turn it along a way, or drop the line"
            raise wrong_line(self.file, int(self.lines[i]), self._shown(i), why, ROUNDING)

    def _shown(self, i: int) -> str:
        return f"waypoint {i} at {self.positions[i].tolist()} m"


def read_waypoints(file: FileName, *, unit: str | None = None, columns: Sequence[str] | None = None) -> Waypoints:
    """Read a table of waypoints; the head of this module says which.

    Args:
        file: Its name.
        unit: Of the positions where the head says none: "m", "mm", "cm", "um" or "inch". None takes m, and warns where
            they are that large that they look like millimetres.
        columns: Names of the columns, instead of the head, which is passed over where there is one; "" or "-" for a
            column that is not read.

    Raises:
        ProblemError: An empty file, columns that are missing, unknown units; by line: a row that is too short, what is
            no number, nan, times that do not increase, a quaternion or an axis that is none.

    Warns:
        ModelWarning: Positions that look like millimetres, angles that look like degrees.
    """
    if unit is not None:
        checked_choice("waypoints: unit", unit, tuple(LENGTHS))
    rows = _rows(file)
    head, first = _head(file, rows, columns)
    names, scales, ignored = _columns(file, head, unit)
    table = _table(file, rows[first:], [bool(name) for name in names])
    lines = np.array([number for number, _, _ in rows[first:]])
    parts = {
        kind: np.column_stack([table[:, names.index(name)] * scales[names.index(name)] for name in kind])
        for kind in KINDS
        if all(name in names for name in kind)
    }
    texts = [text for _, text, _ in rows[first:]]
    times = parts[("time",)][:, 0] if ("time",) in parts else None
    if times is not None and (np.diff(times) <= 0).any():
        i = int((np.diff(times) <= 0).argmax()) + 1
        why = f"the time {times[i]:g} s does not come after {times[i - 1]:g} s; sort the rows"
        raise wrong_line(file, int(lines[i]), texts[i], why)
    positions = parts[POSITION]
    if unit is None and not any(_unit(cell) for cell, name in zip(head, names, strict=True) if name in POSITION):
        extent = np.ptp(positions, axis=0).max()
        warn_of_millimetres(extent, str(file), "unit", "an extent of the waypoints of")
    axes = _axes(file, parts[AXIS], lines, texts) if AXIS in parts else None
    orientations = None
    if QUATERNION in parts:
        orientations = _aligned(_quaternions(file, parts[QUATERNION], lines, texts))
    elif VECTOR in parts:
        warn_of_degrees(parts[VECTOR], str(file), "rx, ry, rz", "an angle of the waypoints of")
        orientations = _aligned(_from_vectors(parts[VECTOR]))
    elif axes is not None:
        orientations = _aligned(_least_roll(file, axes, lines, texts))
    if QUATERNION in parts or VECTOR in parts:
        axes = None
    read = tuple(name for name in names if any(name in kind for kind in parts))
    return Waypoints(positions, orientations, axes, times, read, ignored, lines, str(file))


def _rows(file: FileName) -> list[tuple[int, str, list[str]]]:
    """Number, text and cells of each line with something in it, and of a comment before them that names columns."""
    rows: list[tuple[int, str, list[str]]] = []
    delimiter: str | None = None
    remark = (0, "")
    for number, text in enumerate(read_lines(file), 1):
        line, _, comment = text.partition("#")
        if not line.strip():
            remark = (number, comment) if comment.strip() and not rows else remark
            continue
        if delimiter is None:
            delimiter = next((sign for sign in ";,\t" if sign in line), " ")
        rows.append((number, text, cells_of(line.strip(" "), delimiter)))
    if not rows or delimiter is None:
        raise ProblemError(f"{file}: the file is empty but for comments", name="file", value=str(file))
    named = cells_of(remark[1].strip(" "), delimiter)  # as numpy.savetxt writes a head
    if len(named) == len(rows[0][2]) and set(POSITION) <= {_name(cell) for cell in named}:
        rows.insert(0, (*remark, named))
    return rows


def _name(cell: str) -> str:
    """Of a column, as it is called here; "" where it has none."""
    found = HEAD.match(" ".join(cell.lower().split()))
    name = found[1].removeprefix("pose.") if found else ""
    return OTHER_NAMES.get(name, name)


def _head(
    file: FileName, rows: list[tuple[int, str, list[str]]], columns: Sequence[str] | None
) -> tuple[list[str], int]:
    """Names of the columns as they stand, and the first row that is none of them."""
    cells = rows[0][2]
    told = any(cell and not is_number(cell) for cell in cells)
    if columns is not None:
        known = [] if isinstance(columns, str) else list(checked_each("columns", columns, str))
        if len(known) != len(cells):
            message = f"{file}: {len(known)} columns are named, the first row has {len(cells)}; name every column"
            raise ProblemError(message, name="columns", value=columns, limit=len(cells))
        numbers = [cell for cell in cells if cell]
        counted = len(numbers) > 1 and numbers == [str(i) for i in range(len(numbers))]
        return known, 1 if told or counted or len(numbers) < len(cells) else 0
    if told:
        return cells, 1
    if len(cells) != 3:
        why = (
            f"no head names the {len(cells)} columns; name them in the file, or read with columns=('x', 'y', 'z', ...)"
        )
        raise wrong_line(file, rows[0][0], rows[0][1], why)
    return list(POSITION), 0


def _unit(cell: str) -> str | None:
    found = HEAD.match(" ".join(cell.lower().split()))
    return found[2] if found else None


def _columns(file: FileName, head: Sequence[str], unit: str | None) -> tuple[list[str], list[float], tuple[str, ...]]:
    """The name that each column has here ("" where it is not read), its unit, and those that are not read."""
    names: list[str] = []
    scales: list[float] = []
    ignored: list[str] = []
    for cell in head:
        name, told = _name(cell), _unit(cell)
        kind = next((kind for kind in KINDS if name in kind), None)
        scale = 1.0
        if kind is None:
            ignored += [cell] if cell.strip() not in SKIPPED else []
            name = ""
        elif name in names:
            raise ProblemError(f"{file}: {name} heads two columns; leave one", name=name, value=tuple(head))
        else:
            known = {POSITION: LENGTHS, VECTOR: ANGLES, ("time",): TIMES}.get(kind, {})
            if told is not None and told not in known:
                message = f"{file}: the column {cell!r} cannot be in {told}; known: {', '.join(known) or 'no unit'}"
                raise ProblemError(message, name=name, value=told, limit=tuple(known))
            if kind == POSITION:
                if told is not None and unit is not None and LENGTHS[told] != LENGTHS[unit]:
                    message = f"{file}: the head says {cell!r}, the caller unit={unit!r}; leave unit out"
                    raise ProblemError(message, name="unit", value=unit, limit=told)
                scale = LENGTHS[told or unit or "m"]
            elif told is not None:
                scale = known[told]
        names.append(name)
        scales.append(scale)
    for kind in KINDS:
        missing = [name for name in kind if name not in names]
        if missing and (kind == POSITION or len(missing) < len(kind)):
            message = f"{file}: no column {', '.join(missing)} among {', '.join(repr(cell) for cell in head)}"
            raise ProblemError(f"{message}; name it in the head or by columns=", name=missing[0], value=tuple(head))
    return names, scales, tuple(ignored)


def _table(file: FileName, rows: list[tuple[int, str, list[str]]], read: Sequence[bool]) -> Array:
    """The numbers of the columns that are read, zero in others. Shape (M, columns)."""
    if not rows:
        raise ProblemError(f"{file}: there is a head and no waypoint", name="file", value=str(file))
    width = len(read)
    table = np.zeros((len(rows), width))
    for i, (number, text, cells) in enumerate(rows):
        if len(cells) < width or any(cells[width:]):
            raise wrong_line(file, number, text, f"{len(cells)} columns, expected {width}; complete the row", width)
        for k in range(width):
            if read[k]:
                try:
                    table[i, k] = float(cells[k])
                except ValueError:
                    raise wrong_line(file, number, text, f"{cells[k]!r} is no number; correct it") from None
    wrong = ~np.isfinite(table).all(axis=1)
    if wrong.any():
        number, text, _ = rows[int(wrong.argmax())]
        raise wrong_line(file, number, text, "a number is not finite; correct it or drop the line")
    return table


def _quaternions(file: FileName, values: Array, lines: NDArray[np.intp], texts: Sequence[str]) -> Array:
    norm = np.linalg.norm(values, axis=1)
    most = 1e-2  # more is not put down to the digits written
    wrong = np.abs(norm - 1) > most
    if wrong.any():
        i = int(wrong.argmax())
        why = f"the quaternion has the norm {norm[i]:.6g}; give a unit quaternion"
        raise wrong_line(file, int(lines[i]), texts[i], why, most)
    return np.asarray(values / norm[:, None])


def _axes(file: FileName, values: Array, lines: NDArray[np.intp], texts: Sequence[str]) -> Array:
    norm = np.linalg.norm(values, axis=1)
    if not (norm > 0).all():
        i = int((norm > 0).argmin())
        raise wrong_line(file, int(lines[i]), texts[i], "the tool's axis is zero; give a direction")
    return np.asarray(values / norm[:, None])


def _from_vectors(vectors: Array) -> Array:
    angle = np.linalg.norm(vectors, axis=1)[:, None]
    return np.concatenate([np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * vectors], axis=1)


def _aligned(quaternions: Array) -> Array:
    """Of two signs that say the same the one nearer to the row before."""
    turns = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(quaternions * np.cumprod(np.concatenate([[1.0], turns]))[:, None])


def _least_roll(file: FileName, axes: Array, lines: NDArray[np.intp], texts: Sequence[str]) -> Array:
    """Orientations whose z axis is the tool's: from row to row the least turn, which is parallel transport."""
    before = np.vstack([[0.0, 0.0, 1.0], axes[:-1]])
    steps = np.column_stack([1 + (before * axes).sum(axis=1), np.cross(before, axes)])
    opposite = steps[:, 0] < 1e-7  # 1 + cosine: half the digits of a number
    if opposite[0]:
        steps[0], opposite[0] = (0.0, 1.0, 0.0, 0.0), False  # upside down: about x
    if opposite.any():
        i = int(opposite.argmax())
        why = f"the tool's axis turns round against line {lines[i - 1]}, and nothing says which way; put one between"
        raise wrong_line(file, int(lines[i]), texts[i], why)
    steps = steps / np.linalg.norm(steps, axis=1)[:, None]
    found = np.empty_like(steps)
    current = np.array([1.0, 0.0, 0.0, 0.0])
    for i, step in enumerate(steps):
        current = product(step, current)
        found[i] = current
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])
