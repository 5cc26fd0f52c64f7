"""The skeleton of every script: parse, compute, write, report; and files that are written whole or not at all."""

from __future__ import annotations

import argparse
import csv
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from tqdm import tqdm

Item = TypeVar("Item")
Results = TypeVar("Results")
Row: TypeAlias = Mapping[str, Any]


class Table(NamedTuple):
    """Rows, the columns being the keys of the first one, and the significant digits that they are written with."""

    rows: Sequence[Row]
    digits: int = 10


Content: TypeAlias = str | Table | Mapping[str, Any] | Callable[[Path], object]
"""What a file holds: text, a table (CSV), nested numbers (JSON), or what writes it."""


@dataclass(frozen=True)
class Paper(Generic[Results]):
    """The script of a paper.

    Attributes:
        name: Of the script and of the folder that it writes.
        about: For its command line.
        compute: Everything that is shown.
        files: Tables, texts and the summary, by file name.
        draw: Writes the figures into a folder.
        report: What is printed: paper value, our value and the difference.
        sound: Whether the results are what they have to be.
    """

    name: str
    about: str | None
    compute: Callable[[], Results]
    files: Callable[[Results], Mapping[str, Content]]
    draw: Callable[[Results, Path], None]
    report: Callable[[Results], str]
    sound: Callable[[Results], bool] = lambda _: True

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Parse, compute, write and report; the exit status is 0 when the results are sound, else 1."""
        folder = command(self.about).parse_args(arguments).out / self.name
        results = self.compute()
        for name, content in self.files(results).items():
            write(folder / name, content)
        self.draw(results, folder)
        print(f"{self.report(results)}\n\nwritten to {folder}")
        return 0 if self.sound(results) else 1


def command(about: str | None, only: Iterable[str] = ()) -> argparse.ArgumentParser:
    """The command line that the scripts share: --out, and --only for those that have parts."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    if names := list(only):
        parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}")
    return parser


def progress(items: Iterable[Item], title: str, total: int | None = None) -> Iterable[Item]:
    """The items, with a bar on the terminal while they are worked through."""
    bar: Iterable[Item] = tqdm(items, title, total, leave=False, disable=None)
    return bar


def compared(known: Any, ours: Any, unit: str = "", source: str = "paper") -> dict[str, Any]:
    """A known value, ours and the difference, as entries of a row."""
    end = f"_{unit}" if unit else ""
    return {f"{source}{end}": known, f"ours{end}": ours, f"difference{end}": ours - known}


# ---- files


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it takes the name `path` when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)  # mkstemp's files are the user's alone
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write(path: Path, content: Content) -> None:
    """Write a file; in tables floats have the table's digits, in JSON a number that is not finite is an error."""
    with written(path) as temporary:
        if isinstance(content, Table):
            with temporary.open("w", newline="", encoding="utf-8") as stream:
                table = csv.DictWriter(stream, list(content.rows[0]), lineterminator="\n")
                table.writeheader()
                for row in content.rows:
                    table.writerow({name: _cell(value, content.digits) for name, value in row.items()})
        elif isinstance(content, Mapping):
            text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
            temporary.write_text(f"{text}\n", encoding="utf-8")
        elif isinstance(content, str):
            temporary.write_text(content, encoding="utf-8")
        else:
            content(temporary)


def text_table(rows: Sequence[Row], digits: int = 6) -> str:
    """Rows as aligned text with a head; numbers to the right, `digits` significant digits."""
    names = list(rows[0])
    cells = [[_cell(row[name], digits) for name in names] for row in rows]
    widths = [max(len(line[i]) for line in [names, *cells]) for i in range(len(names))]
    right = [all(isinstance(row[name], int | float | np.number) for row in rows) for name in names]

    def line(texts: Sequence[str]) -> str:
        parts = [t.rjust(w) if r else t.ljust(w) for t, w, r in zip(texts, widths, right, strict=True)]
        return "  ".join(parts).rstrip()

    return "\n".join([line(names), line(["-" * width for width in widths]), *map(line, cells)])


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.{digits}g}"
    return str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
