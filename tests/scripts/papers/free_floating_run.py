"""One run of the free-floating script, for all tests of what it wrote."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scripts.papers.free_floating.results import Results

__all__ = ["REFERENCE", "Run", "column"]

REFERENCE = 1.735114311245
"""J at 5 s: backward shooting of the minimum principle and Legendre-3 collocation, in an implementation of its own."""

Table = list[dict[str, str]]


@dataclass(frozen=True)
class Run:
    """Where the script wrote, what it printed, its exit status and what it computed."""

    folder: Path
    printed: str
    status: int
    results: Results

    def table(self, name: str) -> Table:
        with (self.folder / name).open(newline="", encoding="utf-8") as stream:
            return list(csv.DictReader(stream))

    @property
    def summary(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        return content


def column(table: Table, name: str, **where: str) -> np.ndarray:
    """Numbers of one column, of the rows where other columns have given texts."""
    return np.array([float(row[name]) for row in table if all(row[key] == value for key, value in where.items())])
