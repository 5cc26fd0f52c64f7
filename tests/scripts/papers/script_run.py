"""One run of a paper's script, for all tests of what it computed, wrote and printed."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from functools import cached_property
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeAlias, TypeVar
from unittest.mock import patch

import numpy as np
from PIL import Image

from scripts.papers.reproduced import READERS, committed, read_tables
from scripts.papers.run import Paper

__all__ = [
    "Run",
    "Sample",
    "Summary",
    "Table",
    "assert_committed_numbers",
    "assert_whole_picture",
    "column",
    "run_script",
]

Results = TypeVar("Results")
Table: TypeAlias = list[dict[str, str]]
Summary: TypeAlias = Mapping[str, Any]
Sample: TypeAlias = Mapping[tuple[ModuleType, str], Any]
"""Constants of a script that are smaller in the tests, by module and name: a sample of its meshes, guesses, cases."""


@dataclass(frozen=True)
class Run(Generic[Results]):
    """Where the script wrote, what it printed, its exit status and what it computed."""

    folder: Path
    printed: str
    status: int
    results: Results

    def table(self, name: str) -> Table:
        with (self.folder / name).open(newline="", encoding="utf-8") as stream:
            return list(csv.DictReader(stream))

    @cached_property
    def summary(self) -> Summary:
        content: Summary = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        return content

    @property
    def names(self) -> set[str]:
        """Of the files that were written, but for what lies beside each picture: the SVG and the caption."""
        beside = (".svg", ".caption.txt")
        return {path.name for path in self.folder.iterdir() if not path.name.endswith(beside)}


def assert_committed_numbers(paper: str, summary: Summary) -> None:
    """The numbers in the repository's table of a paper are those of this run."""
    results = Path(__file__).resolve().parents[3] / "results"
    assert committed(list(READERS[paper](summary))) == read_tables(results)[paper]


def run_script(paper: Paper[Results], out: Path, sample: Sample) -> Run[Results]:
    """The script, run into a folder."""
    computed: list[Results] = []

    def compute() -> Results:
        computed.append(paper.compute())
        return computed[-1]

    with ExitStack() as stack, redirect_stdout(StringIO()) as printed:
        for (module, name), value in sample.items():
            stack.enter_context(patch.object(module, name, value))
        status = replace(paper, compute=compute).main(["--out", str(out)])
    return Run(out / paper.name, printed.getvalue(), status, computed[0])


def column(table: Table, name: str, **where: str) -> np.ndarray:
    """Numbers of one column, of the rows where other columns have given texts."""
    return np.array([float(row[name]) for row in table if all(row[key] == value for key, value in where.items())])


def assert_whole_picture(path: Path) -> None:
    """Something is drawn, and nothing that touches the edge: that would be clipped."""
    with Image.open(path) as picture:
        ink = np.asarray(picture.convert("L")) < 250
    assert min(ink.shape) > 400
    assert 0.005 < ink.mean() < 0.5
    assert not any(side.any() for side in (ink[0], ink[-1], ink[:, 0], ink[:, -1]))
