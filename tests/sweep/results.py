"""The results of a sweep, a line of JSON each in a file: a case that is there is not done again.

Each says of which version and code it is. What is of other code than this is counted apart, for it is no evidence of
this one, and done again where that is asked for. The table beside the files says what was found, by the code of it.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import ocp

Case = tuple[str, int]
"""Kind and seed."""
Row = dict[str, Any]
TABLE = "sweeps.csv"
ROOT = Path(ocp.__file__).parents[1]
ABOVE = ("ocp/app/", "ocp/app/batch/", "ocp/app/files/")
"""Rooms that no plan is made by."""
MINUTE = 60.0
"""s."""


class Sweep:
    """Cases of some kinds, and a file of what became of them.

    Attributes:
        code: Of what does them, as of `code_of`.
    """

    def __init__(self, file: str, options: argparse.Namespace, counts: Mapping[str, int]) -> None:
        """
        Args:
            file: Of the module that does them.
            options: Of `parser`.
            counts: Cases of each kind.
        """
        self.options, self.counts, self.code = options, counts, code_of(Path(file))

    def rows(self, result: Callable[[str, int, Row | None], Row]) -> Iterator[Row]:
        """Every case, from the file or done now and added to it; the kinds in turn.

        Args:
            result: Of a case, given what the file has of it, None where it has nothing. What is promised and broken is
                its ``wrong``, a list of words.
        """
        options, known, end = self.options, rows_of(self.options.out), time.time() + MINUTE * self.options.minutes
        for kind, seed in self.cases():
            row = known.get((kind, seed))
            old = row is None or (options.again and row["code"] != self.code)
            if old and time.time() < end:
                by_name = {"kind": kind, "seed": seed, "version": ocp.__version__, "code": self.code}
                known[kind, seed] = row = by_name | result(kind, seed, row)
                _write(options.out, known)
                write_table(options.out.parent)
            if row is not None:
                yield row

    def cases(self) -> list[Case]:
        """Kinds and seeds, in the order in which they are done."""
        counts = {kind: count for kind, count in self.counts.items() if kind in (self.options.only or self.counts)}
        matches = [
            (kind, seed)
            for seed in range(max(counts.values()))
            for kind, count in counts.items()
            if seed < count and (self.options.seed is None or seed == self.options.seed)
        ]
        return matches[: self.options.count]

    def summary(self, rows: list[Row]) -> str:
        """How many of some rows are of this code, how many of older, and how many of each are wrong."""
        words = []
        for what, own in (("this code", True), ("older code", False)):
            of = [row for row in rows if (row["code"] == self.code) is own]
            words.append(f"{len(of)} of {what}, {sum(bool(row['wrong']) for row in of)} of them wrong")
        return f"{len(rows)} of {len(self.cases())} cases: {'; '.join(words)}"


def code_of(sweep: Path, root: Path = ROOT) -> str:
    """Twelve hexadecimal digits that change with the sources of a sweep, of `models`, and of `ocp` but for ABOVE."""
    digest = hashlib.sha256(sweep.read_bytes())
    for package in ("models", "ocp"):
        for file in sorted((root / package).rglob("*.py")):
            place = file.relative_to(root).as_posix()
            if not place.startswith(ABOVE):
                digest.update(place.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def parser(description: str | None, kinds: Mapping[str, int]) -> argparse.ArgumentParser:
    """The options that all sweeps share."""
    result = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("--out", type=Path, required=True, help="file of results, a line of JSON each")
    result.add_argument("--only", choices=list(kinds), action="append")
    result.add_argument("--seed", type=int, help="this one of each kind")
    result.add_argument("--count", type=int, help="so many cases, of the kinds in turn")
    result.add_argument("--minutes", type=float, default=60.0, help="after which no further case is begun")
    result.add_argument("--again", action="store_true", help="those whose results are of older code once more")
    return result


def rows_of(file: Path) -> dict[Case, Row]:
    """What a file has of each case."""
    rows = map(json.loads, file.read_text().splitlines() if file.exists() else ())
    return {(row["kind"], row["seed"]): row for row in rows}


def _write(file: Path, rows: Mapping[Case, Row]) -> None:
    """All lines at once: who is stopped meanwhile leaves the file as it was."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    part.write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    part.replace(file)


def write_table(folder: Path) -> None:
    """What the files of a folder say, by sweep, kind and code: cases, how many break what is promised, and seconds.

    And by which words; of a case that is alone of its kind its figures.
    """
    table = list[Row]()
    for file in sorted(folder.glob("*.jsonl")):
        rows = list(rows_of(file).values())
        for kind, version, code in dict.fromkeys((row["kind"], row["version"], row["code"]) for row in rows):
            own = [row for row in rows if (row["kind"], row["version"], row["code"]) == (kind, version, code)]
            seconds, words = [row["seconds"] for row in own], [word for row in own for word in row["wrong"]]
            table.append(
                {
                    "sweep": file.stem,
                    "kind": kind,
                    "version": version,
                    "code": code,
                    "cases": len(own),
                    "wrong": sum(bool(row["wrong"]) for row in own),
                    "cpu_s_median": f"{median(seconds):.3g}",
                    "cpu_s_most": f"{max(seconds):.3g}",
                    "broken": "; ".join(f"{word} {words.count(word)}" for word in dict.fromkeys(words)),
                    "figures": "; ".join(
                        f"{name} {value:.6g}"
                        for name, value in own[0].items()
                        if isinstance(value, float) and name != "seconds" and len(own) == 1
                    ),
                }
            )
    if table:
        with (folder / TABLE).open("w", newline="") as written:
            writer = csv.DictWriter(written, list(table[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)
