"""Text files line by line, and the error that names a line of one.

JSON and YAML as trees of mappings, lists, texts and numbers, of bounded size and depth.

An alias of YAML counts for all that it stands for, so that whoever walks a tree ends in time.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from models.input_files import INPUT_LIMITS, UnfitFile, read_regular
from ocp.errors import ProblemError

__all__ = [
    "FileName",
    "checked_depth",
    "children_of",
    "is_number",
    "line_error",
    "read_lines",
    "read_tree",
    "split_cells",
]

FileName = str | PathLike[str]
BEFORE_UNIT = re.compile(r"(?<!\s)\s+(?=[\[(])")
LONGEST_SHOWN = 120  # characters of a line in a message


def read_lines(
    file: FileName, *, longest: int | None = INPUT_LIMITS.line_characters, largest: int = INPUT_LIMITS.text_bytes
) -> list[str]:
    """The lines of a text file, of any line ends, without a byte order mark; what is no UTF-8 is read as Latin-1.

    None may have more than `longest` characters, and the file at most `largest` bytes.

    Raises:
        ProblemError: No file name, a file that cannot be read, an empty one, one or a line that is too long, bytes.
    """
    if not isinstance(file, str | PathLike) or not isinstance(fspath(file), str) or not fspath(file):
        raise ProblemError(f"a file name is expected, not {file!r}", name="file", value=file)
    path = Path(file)
    try:
        raw = read_regular(path, largest)
    except UnfitFile as error:
        words = f"longer than {largest // 2**20} MB; split it" if error.limit else f"cannot be read: {error.strerror}"
        raise ProblemError(f"{path}: {words}", name="file", value=str(path), limit=error.limit) from error
    except (OSError, ValueError) as error:
        raise ProblemError(f"{path}: cannot be read: {error}", name="file", value=str(path)) from error
    if b"\0" in raw:
        raise ProblemError(f"{path}: holds zero bytes, it is no text of UTF-8", name="file", value=str(path))
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
        raise line_error(path, i + 1, lines[i], f"longer than {longest} characters; break it", longest)
    if not text.strip():
        raise ProblemError(f"{path}: the file is empty", name="file", value=str(path))
    return lines


def line_error(file: Any, number: int, text: str, why: str, limit: Any = None) -> ProblemError:
    """The error of a line, which is counted from 1: what it says, what is wrong and what to do."""
    shown = text.strip()
    shown = shown if len(shown) <= LONGEST_SHOWN else shown[:LONGEST_SHOWN] + " ..."
    return ProblemError(f"{file}, line {number}, {shown!r}: {why}", name=f"line {number}", value=shown, limit=limit)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line of a table, without quotes; where semicolons divide them a comma is decimal."""
    if delimiter == " ":
        return [cell.strip("\"'") for cell in BEFORE_UNIT.sub("", line).split()]
    cells = [cell.strip().strip("\"'") for cell in line.split(delimiter)]
    return [cell.replace(",", ".") for cell in cells] if delimiter == ";" else cells


def is_number(cell: str) -> bool:
    """Whether a cell is read by `float`."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


NUMBER = re.compile(r"[-+]?(?:\d[\d_]*(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **{
        word: value for value, text in ((True, "true"), (False, "false")) for word in (text, text.title(), text.upper())
    },
    **{word: float(word.replace(".", "")) for word in (".inf", "+.inf", "-.inf", ".nan")},
}
"""What plain scalars of YAML stand for that are no numbers and no texts."""
TAGS = {None, "!", *(f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map"))}
TOO_DEEP = f"containers stand in each other more than {INPUT_LIMITS.nesting} deep"
_NO_KEY = object()


def read_tree(file: FileName, kind: str) -> Any:
    """Return what a JSON file, or the first document of a YAML file, holds.

    Raises:
        ProblemError: It cannot be read, is not of its kind, has too many values or too many containers within each
            other, or for YAML, the package pyyaml is not installed.
    """
    text = "\n".join(read_lines(file, longest=None))
    try:
        return _json(text) if kind == "json" else _yaml(text)
    except RecursionError as error:
        raise ProblemError(
            f"{file} is nested too deep", name="file", value=str(file), limit=INPUT_LIMITS.nesting
        ) from error
    except ValueError as error:
        if isinstance(error, ProblemError):
            raise
        raise ProblemError(f"{file} is no {kind.upper()}: {error}", name="file", value=str(file)) from error


def _json(text: str) -> Any:
    _check_count(sum(text.count(sign) for sign in ",[{"))
    return checked_depth(json.loads(text))


def _yaml(text: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        words = "YAML is read by the package pyyaml: pip install 'selfmotion[yaml]'"
        raise ProblemError(words, name="yaml") from error
    try:
        return _first_document(yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


class _Container:
    """A list or mapping of which the end has not been read, and the number of values in it."""

    def __init__(self, value: Any, anchor: str | None) -> None:
        self.value, self.anchor, self.count, self.key = value, anchor, 1, _NO_KEY

    def add(self, value: Any, count: int) -> None:
        self.count += count
        _check_count(self.count)
        if isinstance(self.value, list):
            self.value.append(value)
        elif self.key is _NO_KEY:
            if isinstance(value, list | dict):
                raise ValueError("a key must be a text or a number")
            if value == "<<":
                raise ValueError("merged mappings (<<) are not read; write their entries")
            self.key = value
        else:
            self.value[self.key], self.key = value, _NO_KEY


def _first_document(events: Any) -> Any:
    """Build the tree of the first document from the events of a parser; None where there is none."""
    known: dict[str, tuple[Any, int]] = {}
    root = _Container([], None)
    waiting = [root]
    for event in events:
        name = type(event).__name__
        if name == "DocumentEndEvent":
            break
        if name in ("SequenceEndEvent", "MappingEndEvent"):
            ended = waiting.pop()
            value, count, anchor = ended.value, ended.count, ended.anchor
        elif name == "AliasEvent":
            if event.anchor not in known:
                raise ValueError(f"the alias *{event.anchor} stands before the end of what it stands for")
            (value, count), anchor = known[event.anchor], None
        elif name == "ScalarEvent":
            value, count, anchor = _scalar(event), 1, event.anchor
        elif name in ("SequenceStartEvent", "MappingStartEvent"):
            waiting.append(_Container([] if name[0] == "S" else {}, _checked_tag(event).anchor))
            if len(waiting) > INPUT_LIMITS.nesting:
                raise ValueError(TOO_DEEP)
            continue
        else:
            continue
        if anchor is not None:
            known[anchor] = value, count
        waiting[-1].add(value, count)
    return root.value[0] if root.value else None


def _scalar(event: Any) -> Any:
    text = str(_checked_tag(event).value)
    if not event.implicit[0]:  # in quotes, or with a tag
        return text
    if text in WORDS:
        return WORDS[text]
    return float(text) if len(text) < 400 and NUMBER.fullmatch(text) else text


def _checked_tag(event: Any) -> Any:
    if event.tag not in TAGS:
        raise ValueError(f"the tag {event.tag!r} is not read")
    return event


def _check_count(count: int) -> None:
    if count > INPUT_LIMITS.tree_values:
        raise ValueError(f"it holds {count} values, at most {INPUT_LIMITS.tree_values} are read")


def checked_depth(tree: Any) -> Any:
    """Return a tree; raise ValueError where its containers stand in each other more than INPUT_LIMITS.nesting deep."""
    level = [tree]
    for _ in range(INPUT_LIMITS.nesting + 1):
        level = [part for one in level for part in children_of(one)]
    if level:
        raise ValueError(TOO_DEEP)
    return tree


def children_of(value: Any) -> list[Any]:
    """Return the values of a mapping or list; of anything else none."""
    return list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list) else []
