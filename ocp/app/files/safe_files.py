"""Read text files, tables, JSON and YAML from untrusted sources safely, and check where outputs may be written.

JSON and YAML are read as trees of bounded size and depth. An alias of YAML counts with all the values that it stands
for, so that a walk through the tree ends in bounded time. An output lies below its folder, has the suffix of its kind
and never replaces a foreign file; the first bytes of a file show whether selfmotion wrote it.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from models.checks import Array
from models.files import INPUT_LIMITS, UnfitFile, open_regular, read_regular
from ocp.errors import ProblemError
from ocp.storage import read_arrays, table_joints

FileName = str | PathLike[str]
BEFORE_UNIT = re.compile(r"(?<!\s)\s+(?=[\[(])")
QUOTED_CHARACTERS = 120
"""Largest number of characters that an error message quotes from a line of a file."""


def read_lines(
    file: FileName, *, longest: int | None = INPUT_LIMITS.line_characters, largest: int = INPUT_LIMITS.text_bytes
) -> list[str]:
    """Return the lines of a text file, decoded as UTF-8 or else Latin-1, without a byte order mark.

    `longest` is the largest number of characters in a line, None for no limit, and `largest` the largest size in bytes.

    Raises:
        ProblemError: The name is invalid; the file cannot be read, is empty, too large, or has a line that is too long
            or zero bytes.
    """
    if not isinstance(file, str | PathLike) or not isinstance(fspath(file), str) or not fspath(file):
        raise ProblemError(f"a file name is expected, not {file!r}", name="file", value=file)
    path = Path(file)
    try:
        raw = read_regular(path, largest)
    except UnfitFile as error:
        why = f"longer than {largest // 2**20} MB; split it" if error.limit else f"cannot be read: {error.strerror}"
        raise ProblemError(f"{path}: {why}", name="file", value=str(path), limit=error.limit) from error
    except (OSError, ValueError) as error:
        raise ProblemError(f"{path}: cannot be read: {error}", name="file", value=str(path)) from error
    if b"\0" in raw:
        raise ProblemError(f"{path}: contains zero bytes and is not a text file", name="file", value=str(path))
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if len(lines) > INPUT_LIMITS.text_lines:
        message = f"{path}: {len(lines)} lines, at most {INPUT_LIMITS.text_lines} are read; split it"
        raise ProblemError(message, name="file", value=len(lines), limit=INPUT_LIMITS.text_lines)
    if longest is not None and max(len(line) for line in lines) > longest:
        i = next(i for i, line in enumerate(lines) if len(line) > longest)
        raise line_error(path, i + 1, lines[i], f"longer than {longest} characters; break it", limit=longest)
    if not text.strip():
        raise ProblemError(f"{path}: the file is empty", name="file", value=str(path))
    return lines


def line_error(file: Any, number: int, text: str, why: str, *, limit: Any = None) -> ProblemError:
    """Return a ProblemError about a line of a file, which states the line's number and text and the reason `why`."""
    quoted = text.strip()
    quoted = quoted if len(quoted) <= QUOTED_CHARACTERS else quoted[:QUOTED_CHARACTERS] + " ..."
    return ProblemError(f"{file}, line {number}, {quoted!r}: {why}", name=f"line {number}", value=quoted, limit=limit)


def missing_package(task: str, package: str, extra: str) -> ProblemError:
    """Return a ProblemError that says that a task needs an optional package, and how to install it."""
    commands = f'pip install "selfmotion[{extra}]", or from a clone pip install ".[{extra}]"'
    return ProblemError(f"{task} needs the package {package}: {commands}", name=extra, value=package)


class TableRow(NamedTuple):
    """A row of a text table: its line number in the file, the line, and its cells."""

    number: int
    text: str
    cells: list[str]

    @property
    def has_names(self) -> bool:
        """Whether a cell of the row is neither empty nor a number, so that the row may name the columns."""
        return any(cell and not is_number(cell) for cell in self.cells)


def read_rows(file: FileName) -> tuple[list[TableRow], TableRow]:
    """Return the rows of a text table, and the last comment before them, which may name the columns, as a row.

    Commas, semicolons, tabs or blanks separate the cells; with a semicolon, a comma is a decimal point. `#` begins a
    comment.
    """
    rows: list[TableRow] = []
    delimiter, comment = "", (0, "", "")
    for number, text in enumerate(read_lines(file), 1):
        line, _, remark = text.partition("#")
        if line.strip():
            delimiter = delimiter or next((sign for sign in ";,\t" if sign in line), " ")
            rows.append(TableRow(number, text, _split_cells(line, delimiter)))
        elif remark.strip() and not rows:
            comment = number, text, remark
    if not rows:
        raise ProblemError(f"{file}: the file has only comments", name="file", value=str(file))
    return rows, TableRow(*comment[:2], _split_cells(comment[2], delimiter))


def _split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line of a table into cells."""
    if delimiter == " ":
        return [cell.strip("\"'") for cell in BEFORE_UNIT.sub("", line).split()]
    cells = [cell.strip().strip("\"'") for cell in line.strip(" ").split(delimiter)]
    return [cell.replace(",", ".") for cell in cells] if delimiter == ";" else cells


def table_numbers(file: FileName, rows: Sequence[TableRow], used: Sequence[bool]) -> Array:
    """Return the numbers in the columns of a table that are used, nan for empty cells, and 0 in all other columns.

    Raises:
        ProblemError: A row has too many or too few cells, or a cell is not a number; names the line.
    """
    width = len(used)
    for row in rows:
        if len(row.cells) < width or any(row.cells[width:]):
            why = f"{len(row.cells)} columns, expected {width}; complete the row"
            raise line_error(file, row.number, row.text, why, limit=width)
    cells = [[(cell or "nan") if use else "0" for cell, use in zip(row.cells, used, strict=False)] for row in rows]
    try:
        return np.array(cells, dtype=float)
    except ValueError as error:
        pairs = ((row, cell) for row, own in zip(rows, cells, strict=True) for cell in own)
        row, cell = next(pair for pair in pairs if not is_number(pair[1]))
        raise line_error(file, row.number, row.text, f"{cell!r} is not a number; correct it") from error


def is_number(cell: str) -> bool:
    """Return whether the text of a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


NUMBER = re.compile(r"[-+]?(?:\d[\d_]*(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
SCALARS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{word: float(word.replace(".", "")) for word in (".inf", "+.inf", "-.inf", ".nan")},
}
"""Values of plain YAML scalars that are neither numbers nor texts."""
TAGS = {None, "!", *(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))}
TOO_DEEP = f"values are nested more than {INPUT_LIMITS.nesting} deep"
_NO_KEY = object()


def read_tree(file: FileName, kind: str) -> Any:
    """Return the contents of a JSON file or of a YAML file's first document; raise ProblemError if they are invalid."""
    text = "\n".join(read_lines(file, longest=None))
    try:
        if kind != "json":
            return _yaml(text)
        _check_count(sum(text.count(sign) for sign in ",[{"))
        return checked_depth(json.loads(text))
    except RecursionError as error:
        words, limit = f"{file} is nested too deeply", INPUT_LIMITS.nesting
        raise ProblemError(words, name="file", value=str(file), limit=limit) from error
    except ValueError as error:
        if isinstance(error, ProblemError):
            raise
        raise ProblemError(f"{file} is not valid {kind.upper()}: {error}", name="file", value=str(file)) from error


def _yaml(text: str) -> Any:
    """Return the contents of the first document in a YAML text; raise ValueError if the text is invalid."""
    try:
        import yaml
    except ImportError as error:
        raise missing_package("reading YAML", "pyyaml", "yaml") from error
    try:
        return _first_document(yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


class _Container:
    """A YAML list or mapping that is still being read, and the number of values that it contains so far."""

    def __init__(self, value: Any, anchor: str | None) -> None:
        self.value, self.anchor, self.count, self.key = value, anchor, 1, _NO_KEY

    def add(self, value: Any, count: int) -> None:
        """Append an item to the list, or a key or value to the mapping; `count` is the number of scalars in `value`."""
        self.count += count
        _check_count(self.count)
        if isinstance(self.value, list):
            self.value.append(value)
        elif self.key is _NO_KEY:
            if isinstance(value, list | dict):
                raise ValueError("a key must be a text or number")
            if value == "<<":
                raise ValueError("merged mappings (<<) are not supported; write out their entries")
            if value in self.value:
                raise ValueError(f"{value!r} is there twice in a mapping; remove one of the two")
            self.key = value
        else:
            self.value[self.key], self.key = value, _NO_KEY


def _first_document(events: Any) -> Any:
    """Return the tree of the first YAML document from the events of a parser, or None if there is no document."""
    anchors: dict[str, tuple[Any, int]] = {}
    root = _Container([], None)
    open_containers = [root]
    for event in events:
        name = type(event).__name__
        if name == "DocumentEndEvent":
            break
        if name in ("SequenceEndEvent", "MappingEndEvent"):
            ended = open_containers.pop()
            value, count, anchor = ended.value, ended.count, ended.anchor
        elif name == "AliasEvent":
            if event.anchor not in anchors:
                raise ValueError(f"the alias *{event.anchor} precedes the end of its anchor")
            (value, count), anchor = anchors[event.anchor], None
        elif name == "ScalarEvent":
            value, count, anchor = _scalar(event), 1, event.anchor
        elif name in ("SequenceStartEvent", "MappingStartEvent"):
            open_containers.append(_Container([] if name[0] == "S" else {}, _checked_tag(event).anchor))
            if len(open_containers) > INPUT_LIMITS.nesting:
                raise ValueError(TOO_DEEP)
            continue
        else:
            continue
        if anchor is not None:
            anchors[anchor] = value, count
        open_containers[-1].add(value, count)
    return root.value[0] if root.value else None


def _scalar(event: Any) -> Any:
    """Return the value of a YAML scalar."""
    text = str(_checked_tag(event).value)
    if not event.implicit[0]:  # quoted, or with a tag
        return text
    if text in SCALARS:
        return SCALARS[text]
    return float(text) if len(text) < 400 and NUMBER.fullmatch(text) else text


def _checked_tag(event: Any) -> Any:
    """Return an event of a YAML parser; raise ValueError if its tag is unknown."""
    if event.tag not in TAGS:
        raise ValueError(f"the tag {event.tag!r} is not supported")
    return event


def _check_count(count: int) -> None:
    """Raise ValueError if a file contains more values than allowed."""
    if count > INPUT_LIMITS.tree_values:
        raise ValueError(f"it contains {count} values; at most {INPUT_LIMITS.tree_values} are allowed")


def checked_depth(tree: Any) -> Any:
    """Return a tree of values; raise ValueError if the tree is nested deeper than INPUT_LIMITS.nesting."""
    level = [tree]
    for _ in range(INPUT_LIMITS.nesting + 1):
        level = [child for node in level for child in children_of(node)]
    if level:
        raise ValueError(TOO_DEEP)
    return tree


def children_of(value: Any) -> list[Any]:
    """Return the values of a mapping or list, and an empty list for anything else."""
    return list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list) else []


MARK = "written by selfmotion"
SUFFIXES = {
    "plan": (".npz",),
    "csv": (".csv",),
    "json": (".json",),
    "yaml": (".yaml", ".yml"),
    "mcap": (".mcap",),
    "urscript": (".script",),
    "krl": (".src",),
    "rapid": (".mod",),
    "urdf": (".urdf",),
    "report": (".html", ".htm"),
}
SIGNATURES = {
    "json": re.compile(rb'\{"header": \{"stamp": \{"sec": 0, "nanosec": 0\}, "frame_id": ""\}, "joint_names": \['),
    "yaml": re.compile(rf"# {MARK}\n".encode()),
    "mcap": re.compile(rb"\x89MCAP0\r\n\x01.{8}\x04\0\0\0ros2.{4}[ -~]{1,99}\x0c.{8}\x0a\0\0\0selfmotion", re.DOTALL),
    "urscript": re.compile(rf"def \w+\(\):\n  # {MARK}\n".encode()),
    "krl": re.compile(rf"&ACCESS RVP\nDEF \w+\(\)\n  ; {MARK}\n".encode()),
    "rapid": re.compile(rf"MODULE \w+\n  ! {MARK}\n".encode()),
    "urdf": re.compile(rf"<\?xml [^>]*>\n<!-- {MARK} -->\n".encode()),
    "report": re.compile(rb'<!doctype html>\n<html[^>]*>\s*<head>\s*<meta name="generator" content="selfmotion">'),
}
"""Patterns of the first bytes of files that selfmotion writes, by kind of file."""


def checked_output(kind: str, file: str | os.PathLike[str], folder: Path | None = None, force: bool = False) -> Path:
    """Check whether an output file may be written; return its path after resolving symbolic links.

    `kind` is a key of SUFFIXES. The output must be in or below `folder`, unless that is None. Only if `force` is set, a
    file may be overwritten that selfmotion did not write.

    Raises:
        ProblemError: The name has a wrong suffix or unprintable characters, is outside of the folder, or belongs to a
            foreign file.
    """
    if not str(file).isprintable():
        raise ProblemError(f"{str(file)!r} is not a valid file name; use printable characters", name=kind, value=file)
    path = Path(os.path.realpath(file))
    if path.suffix.lower() not in SUFFIXES[kind]:
        link = "" if path.name == Path(file).name else f" (a link to {path})"
        message = f"{file}{link} does not have the suffix of a {kind}; end it with {' or '.join(SUFFIXES[kind])}"
        raise ProblemError(message, name=kind, value=str(file), limit=SUFFIXES[kind])
    if folder is not None and not path.is_relative_to(os.path.realpath(folder)):
        message = f"{file} is outside of {folder}; name a file below it, or choose another folder with --output-folder"
        raise ProblemError(message, name=kind, value=str(file), limit=str(folder))
    if not force and os.path.lexists(path) and not _is_own(kind, path):
        message = f"{file} exists and was not written by selfmotion; name another file, or overwrite it with --force"
        raise ProblemError(message, name=kind, value=str(file))
    return path


def _is_own(kind: str, path: Path) -> bool:
    """Return whether an existing file was written by selfmotion and may therefore be overwritten."""
    try:
        if kind == "plan":
            return "head" in read_arrays(path)
        with open_regular(path, sys.maxsize) as stream:
            start = stream.read(2**20)  # enough for the header of a table with some thousand joints
    except (OSError, ProblemError):
        return False
    if kind == "csv":
        return bool(table_joints(start.partition(b"\n")[0].decode(errors="replace").split(",")))
    return SIGNATURES[kind].match(start) is not None
