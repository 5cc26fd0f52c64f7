"""Read TOML files so that each error names its line; entries are read by name and expected type."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from models.checks import NOT_NUMBERS, floats, real
from models.files import INPUT_LIMITS
from ocp.app.files.safe_files import FileName, checked_depth, line_error, read_lines
from ocp.errors import ProblemError

__all__ = ["TomlTable", "read_toml"]

TABLE = re.compile(r"(\[\[?)([^\[\]#]+)\]\]?\s*(?:#.*)?$")
KEY = re.compile(r"""((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
BETWEEN = re.compile(r"[,=\[\]{}#]")
ERROR_LINE = re.compile(r"\(at line (\d+)")
Place = tuple[Any, ...]


class TomlTable:
    """A table of a TOML file that records which entries were read, so that `done` can reject all others.

    Attributes:
        file: Name of the file.
        place: Keys and indices that lead from the root to the table.
    """

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
        if similar := get_close_matches(name, unknown, n=1, cutoff=0.5):
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
        """Return the entry of this name after checking that it is a non-empty text."""
        return self._read(name, default, expected, lambda value: isinstance(value, str) and value != "")

    def flag(self, name: str, default: bool = False) -> bool:
        """Return the entry of this name after checking that it is true or false."""
        return bool(self._read(name, default, "true or false", lambda value: isinstance(value, bool)))

    def choice(self, name: str, known: Iterable[str], default: Any = None) -> Any:
        """Return the entry of this name after checking that it is one of the known words."""
        words = tuple(known)
        expected = "one of " + ", ".join(f'"{word}"' for word in words)
        return self._read(name, default, expected, lambda value: isinstance(value, str) and value in words)

    def number(
        self, name: str, expected: str, default: Any = None, *, least: float = -np.inf, most: float = np.inf
    ) -> Any:
        """Return the entry of this name after checking that it is a number above `least` and at most `most`."""

        def fits(value: Any) -> bool:
            return bool(np.isfinite(real(value)) and least < real(value) <= most)

        value = self._read(name, default, expected, fits)
        return value if value is None or value is default else float(value)

    def count(self, name: str, expected: str, default: Any = None) -> Any:
        """Return the entry of this name after checking that it is an integer, 0 or more."""

        def fits(value: Any) -> bool:
            return isinstance(value, int) and not isinstance(value, bool) and value >= 0

        return self._read(name, default, expected, fits)

    def vector(self, name: str, size: int | None, expected: str, default: Any = None) -> Any:
        """Return the entry of this name as a vector of `size` numbers, or of any length if `size` is None."""

        def fits(value: Any) -> bool:
            try:
                vector = floats(value)
            except NOT_NUMBERS:
                return False
            return vector.ndim == 1 and bool(np.isfinite(vector).all()) and size in (None, len(vector))

        value = self._read(name, default, expected, lambda value: isinstance(value, list) and fits(value))
        return value if value is None or value is default else np.array(value, dtype=float)

    def numbers_by_name(self, name: str, expected: str) -> dict[str, float]:
        """Return the entry of this name as a dictionary of numbers by name; empty if the entry is missing."""
        table = self.table(name, expected)
        values = {} if table is None else table._values
        for key, value in values.items():
            if table is not None and not np.isfinite(real(value)):
                raise table.error(key, f"{key} must be a number, not {value!r}")
        return {key: float(value) for key, value in values.items()}

    def texts(self, name: str, expected: str) -> tuple[str, ...]:
        """Return the entry of this name as a list of texts; empty if it is missing."""
        texts = self._read(
            name, [], expected, lambda value: isinstance(value, list) and all(isinstance(one, str) for one in value)
        )
        return tuple(texts)

    def pairs(self, name: str, expected: str) -> list[tuple[str, str]]:
        """Return the entry of this name as a list of pairs of texts; empty if it is missing."""

        def fits(value: Any) -> bool:
            return isinstance(value, list) and all(
                isinstance(one, list) and len(one) == 2 and all(isinstance(word, str) for word in one) for one in value
            )

        return [(one, other) for one, other in self._read(name, [], expected, fits)]

    def raw(self, name: str, default: Any = None) -> Any:
        """Return the entry of this name, which may be of any type, without a check."""
        return self._read(name, default, "", lambda value: True)

    def table(self, name: str, expected: str = "a table", default: Any = None) -> TomlTable | None:
        """Return the nested table of this name, or None if it is missing."""
        values = self._read(name, default, expected, lambda value: isinstance(value, dict))
        return None if values is None else self._inner(values, name)

    def _inner(self, values: Any, *place: Any) -> TomlTable:
        """Return a nested table with its place in the file, so that its errors name the line."""
        return TomlTable(self.file, values, place=(*self.place, *place), texts=self._texts, lines=self._lines)

    def tables(self, name: str) -> list[TomlTable]:
        """Return all tables of the array of tables [[name]]."""
        tables = self._read(
            name,
            [],
            f"tables, each headed [[{name}]]",
            lambda value: isinstance(value, list) and all(isinstance(values, dict) for values in value),
        )
        return [self._inner(values, name, k) for k, values in enumerate(tables)]

    def only(self, *names: str) -> None:
        """Raise ProblemError if the table has entries with names other than the given ones, before any entry is read.

        Raises:
            ProblemError: An entry is unknown; names its line and the known entries.
        """
        self._read_names.extend(names)
        self.done()

    def done(self) -> None:
        """Raise ProblemError if the table has an entry that was not read, because such an entry is unknown.

        Raises:
            ProblemError: An entry is unknown; names its line and the known entries.
        """
        for name in self._values:
            if name not in self._read_names:
                similar = get_close_matches(name, self._read_names, n=2)
                known = ", ".join(dict.fromkeys(self._read_names))
                hint = f"did you mean {' or '.join(similar)}?" if similar else f"known entries: {known}"
                raise self.error(name, f"unknown entry {name}; {hint}")


REQUIRED = object()
"""Default value that marks an entry as required."""


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
        raise line_error(file, number, texts[number - 1], f"invalid TOML: {why}; write name = value") from error
    except (RecursionError, ValueError) as error:  # ValueError: also for numbers with more digits than Python accepts
        raise ProblemError(f"{file} is not valid TOML: {error}", name="file", value=str(file)) from error
    return TomlTable(str(file), values, place=(), texts=texts, lines=_places(texts))


def _places(texts: Sequence[str]) -> dict[Place, int]:
    """Return the line number of every table and entry of a file."""
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
