"""TOML files whose errors name the line: tables of entries, each asked for by name and by what it must be."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from models.arrays import Array
from models.input_files import INPUT_LIMITS
from ocp.app.files.text_files import FileName, checked_depth, line_error, read_lines
from ocp.errors import NOT_NUMBERS, ProblemError, floats, real

__all__ = ["TomlTable", "read_toml"]

TABLE = re.compile(r"(\[\[?)([^\[\]#]+)\]\]?\s*(?:#.*)?$")
KEY = re.compile(r"""((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
BETWEEN = re.compile(r"[,=\[\]{}#]")
AT_LINE = re.compile(r"\(at line (\d+)")
Place = tuple[Any, ...]


class TomlTable:
    """A table of a file: what was asked for is known, and `done` refuses what was not.

    Attributes:
        file: Its name. place: Of the table, names and numbers from the root.
    """

    def __init__(self, file: str, texts: Sequence[str], lines: dict[Place, int], place: Place, values: Any) -> None:
        self.file, self.place = file, place
        self._texts, self._lines, self._values = texts, lines, values
        self._asked: list[str] = []

    def __contains__(self, name: str) -> bool:
        self._asked.append(name)
        return name in self._values

    def wrong(self, name: str | None, why: str) -> ProblemError:
        """The error of an entry, or of the table: it names the line, what stands there and what was expected."""
        place = self.place if name is None else (*self.place, name)
        number = next((self._lines[place[:k]] for k in range(len(place), 0, -1) if place[:k] in self._lines), 1)
        text = self._texts[number - 1] if number <= len(self._texts) else ""
        error = line_error(self.file, number, text, why)
        error.name = name or ".".join(str(part) for part in place) or "file"
        return error

    def missing(self, name: str, expected: str) -> ProblemError:
        """The error of an entry that is not there; of one that nobody asks for, where its name is nearly this one."""
        strange = [one for one in self._values if one not in self._asked]
        if near := get_close_matches(name, strange, n=1, cutoff=0.5):
            return self.wrong(near[0], f"{near[0]} means nothing here; did you mean {name}? It is {expected}")
        table = ".".join(str(part) for part in self.place if isinstance(part, str))
        where = f"in [{table}]" if table else "at the top"
        return (
            self.wrong(None, f"{where} {name!r} is missing: {expected}")
            if self.place
            else ProblemError(f"{self.file}: {where} {name!r} is missing: {expected}", name=name)
        )

    def _taken(self, name: str, default: Any, expected: str, fits: Callable[[Any], bool]) -> Any:
        self._asked.append(name)
        if name not in self._values:
            if default is REQUIRED:
                raise self.missing(name, expected)
            return default
        value = self._values[name]
        if not fits(value):
            raise self.wrong(name, f"{name} must be {expected}, not {value!r}")
        return value

    def text(self, name: str, expected: str = "a text", default: Any = None) -> Any:
        """A text."""
        return self._taken(name, default, expected, lambda value: isinstance(value, str) and value != "")

    def flag(self, name: str, default: bool = False) -> bool:
        """true or false."""
        return bool(self._taken(name, default, "true or false", lambda value: isinstance(value, bool)))

    def choice(self, name: str, known: Iterable[str], default: Any = None) -> Any:
        """One of some words."""
        words = tuple(known)
        expected = "one of " + ", ".join(f'"{word}"' for word in words)
        return self._taken(name, default, expected, lambda value: isinstance(value, str) and value in words)

    def number(
        self, name: str, expected: str, default: Any = None, *, least: float = -np.inf, most: float = np.inf
    ) -> Any:
        """A number above `least`, at most `most`."""

        def fits(value: Any) -> bool:
            return bool(np.isfinite(real(value)) and least < real(value) <= most)

        found = self._taken(name, default, expected, fits)
        return found if found is None or found is default else float(found)

    def count(self, name: str, expected: str, default: Any = None) -> Any:
        """A whole number, 0 or more."""

        def fits(value: Any) -> bool:
            return isinstance(value, int) and not isinstance(value, bool) and value >= 0

        return self._taken(name, default, expected, fits)

    def vector(self, name: str, size: int | None, expected: str, default: Any = None) -> Any:
        """As many numbers, or any number of them where size is None."""

        def fits(value: Any) -> bool:
            try:
                found = floats(value)
            except NOT_NUMBERS:
                return False
            return found.ndim == 1 and bool(np.isfinite(found).all()) and size in (None, len(found))

        found = self._taken(name, default, expected, lambda value: isinstance(value, list) and fits(value))
        return found if found is None or found is default else _array(found)

    def numbers_by_name(self, name: str, expected: str) -> dict[str, float]:
        """A table of numbers by name; empty where it is not there."""
        found = self._taken(name, {}, expected, lambda value: isinstance(value, dict))
        for key, value in found.items():
            if not np.isfinite(real(value)):
                raise TomlTable(self.file, self._texts, self._lines, (*self.place, name), found).wrong(
                    key, f"{key} must be a number, not {value!r}"
                )
        return {key: float(value) for key, value in found.items()}

    def texts(self, name: str, expected: str) -> tuple[str, ...]:
        """A list of texts; empty where it is not there."""
        found = self._taken(
            name, [], expected, lambda value: isinstance(value, list) and all(isinstance(one, str) for one in value)
        )
        return tuple(found)

    def pairs(self, name: str, expected: str) -> list[tuple[str, str]]:
        """A list of pairs of texts; empty where it is not there."""

        def fits(value: Any) -> bool:
            return isinstance(value, list) and all(
                isinstance(one, list) and len(one) == 2 and all(isinstance(word, str) for word in one) for one in value
            )

        return [(one, other) for one, other in self._taken(name, [], expected, fits)]

    def raw(self, name: str, default: Any = None) -> Any:
        """Whatever stands there."""
        return self._taken(name, default, "", lambda value: True)

    def table(self, name: str, expected: str = "a table", default: Any = None) -> TomlTable | None:
        """A table in this one; None where it is not there."""
        found = self._taken(name, default, expected, lambda value: isinstance(value, dict))
        return None if found is None else TomlTable(self.file, self._texts, self._lines, (*self.place, name), found)

    def tables(self, name: str) -> list[TomlTable]:
        """The tables that stand under [[name]]."""
        found = self._taken(
            name,
            [],
            f"tables, each headed [[{name}]]",
            lambda value: isinstance(value, list) and all(isinstance(one, dict) for one in value),
        )
        return [
            TomlTable(self.file, self._texts, self._lines, (*self.place, name, k), one) for k, one in enumerate(found)
        ]

    def only(self, *names: str) -> None:
        """Refuse entries of other names than these, before any is read.

        Raises:
            ProblemError: By line, with what may stand there.
        """
        self._asked.extend(names)
        self.done()

    def done(self) -> None:
        """Refuse entries that nobody asked for.

        Raises:
            ProblemError: By line, with what may stand there.
        """
        for name in self._values:
            if name not in self._asked:
                near = get_close_matches(name, self._asked, n=2)
                known = ", ".join(dict.fromkeys(self._asked))
                hint = f"did you mean {' or '.join(near)}?" if near else f"here may stand: {known}"
                raise self.wrong(name, f"{name} means nothing here; {hint}")


REQUIRED = object()


def _array(value: Any) -> Array:
    return np.array(value, dtype=float)


def read_toml(file: FileName) -> TomlTable:
    """The root table of a TOML file.

    Raises:
        ProblemError: A file that cannot be read, or is no TOML, by line.
    """
    texts = read_lines(file, largest=INPUT_LIMITS.task_bytes)
    for number, text in enumerate(texts, 1):
        if any(
            part.count(".") > INPUT_LIMITS.nesting for part in BETWEEN.split(text)
        ):  # the parser's time grows by the square
            raise line_error(
                file, number, text, f"a name has more than {INPUT_LIMITS.nesting} parts", INPUT_LIMITS.nesting
            )
    try:
        values = checked_depth(tomllib.loads("\n".join(texts)))
    except tomllib.TOMLDecodeError as error:
        told = AT_LINE.search(str(error))
        number = min(int(told[1]), len(texts)) if told else len(texts)
        why = AT_LINE.split(str(error))[0].strip() or str(error)
        raise line_error(file, number, texts[number - 1], f"no TOML: {why}; write name = value") from error
    except (RecursionError, ValueError) as error:  # ValueError: also of numbers of more digits than Python reads
        raise ProblemError(f"{file} is no TOML that is read: {error}", name="file", value=str(file)) from error
    return TomlTable(str(file), texts, _places(texts), (), values)


def _places(texts: Sequence[str]) -> dict[Place, int]:
    """The line of every table and entry, by its place."""
    found: dict[Place, int] = {}
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
            found.setdefault(table, number)
        elif told := KEY.match(line):
            place = table
            for part in told[1].split("."):
                place = (*place, part.strip().strip("\"'"))
                found.setdefault(place, number)
    return found
