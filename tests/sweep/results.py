"""The results of a sweep, a line of JSON each in a file: a case that is there is not done again."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Case = tuple[str, int]
"""Kind and seed."""
Row = dict[str, Any]


def parser(description: str | None, kinds: list[str], count: int) -> argparse.ArgumentParser:
    """The options that all sweeps share."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, required=True, help="file of results, a line of JSON each")
    made.add_argument("--only", choices=kinds, action="append")
    made.add_argument("--count", type=int, default=count, help="cases, of the kinds in turn")
    made.add_argument("--minutes", type=float, default=60.0, help="after which no further case is begun")
    return made


def results(
    given: argparse.Namespace, kinds: list[str], result: Callable[[str, int, Row | None], Row]
) -> Iterator[Row]:
    """Every case of a sweep, from the file or done now and added to it.

    Args:
        given: Of `parser`.
        kinds: All there are.
        result: Of a case, given what the file has of it, None where it has nothing. A case of the file is done again
            where `given.again` says so.
    """
    rows, end, again = dict[Case, Row](), time.time() + 60 * given.minutes, getattr(given, "again", False)
    kinds = given.only or kinds
    if given.out.exists():
        rows = {(row["kind"], row["seed"]): row for row in map(json.loads, given.out.read_text().splitlines())}
    for number in range(given.count):
        kind, seed = kinds[number % len(kinds)], number // len(kinds)
        known = rows.get((kind, seed))
        if known is None or again:
            if time.time() > end:
                return
            known = {"kind": kind, "seed": seed, **result(kind, seed, known)}
            given.out.parent.mkdir(parents=True, exist_ok=True)
            with given.out.open("a") as file:
                file.write(json.dumps(known) + "\n")
        yield known
