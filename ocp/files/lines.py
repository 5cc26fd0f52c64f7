"""Text files line by line, and the error that names a line of one."""

from __future__ import annotations

import re
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from models.input_files import INPUT_LIMITS, UnfitFile, read_regular
from ocp.errors import ProblemError

__all__ = ["FileName", "cells_of", "is_number", "read_lines", "wrong_line"]

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
        raise wrong_line(path, i + 1, lines[i], f"longer than {longest} characters; break it", longest)
    if not text.strip():
        raise ProblemError(f"{path}: the file is empty", name="file", value=str(path))
    return lines


def wrong_line(file: Any, number: int, text: str, why: str, limit: Any = None) -> ProblemError:
    """The error of a line, which is counted from 1: what it says, what is wrong and what to do."""
    shown = text.strip()
    shown = shown if len(shown) <= LONGEST_SHOWN else shown[:LONGEST_SHOWN] + " ..."
    return ProblemError(f"{file}, line {number}, {shown!r}: {why}", name=f"line {number}", value=shown, limit=limit)


def cells_of(line: str, delimiter: str) -> list[str]:
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
