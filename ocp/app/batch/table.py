"""What came of a batch: a result for each task, as a table, and the best of each group."""

from __future__ import annotations

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ocp.app.batch.ledger import Ledger
from ocp.errors import DetailedError, ProblemError, SolveError, checked_each, checked_instance, unknown_name
from ocp.storage import cell, checked_path, write_text, write_whole

__all__ = ["Batch", "BatchError", "Result", "read_batch", "row_of"]

COLUMNS = ("key", "status", "cost", "verdict", "seconds", "error", "message")
Group = str | Callable[[Any], Any]


class BatchError(DetailedError, RuntimeError):
    """Tasks of a batch that failed; all others are done, and all results are kept.

    Attributes:
        batch: The results. value: How many of them failed.
    """

    def __init__(self, message: str = "", batch: Batch | None = None, **details: Any) -> None:
        super().__init__(message, **details)
        self.batch = batch


@dataclass(frozen=True)
class Result:
    """What came of a task.

    Attributes:
        key: Its name in the folder. task: What was asked.
        status: ``done``; ``failed``: the function raised an error, or returned what is no data or nan; ``killed``: it
            ended three workers.
        cost, verdict: As the function says, or the plan that it returned; None where nobody does.
        seconds: Wall time of the call.
        error, message: Name and words of the error; "" of what is done.
        neighbour: Key of the task whose result it began from, or None.
    """

    key: str
    task: Any
    status: str
    cost: float | None
    verdict: Any
    seconds: float
    error: str
    message: str
    neighbour: str | None
    scalars: Mapping[str, Any] = field(repr=False)
    _ledger: Ledger = field(repr=False, compare=False)

    @property
    def value(self) -> Any:
        """What the function returned, read from the folder; arrays and tuples are lists, plans are plans.

        Raises:
            SolveError: The task is not done; says why.
            ProblemError: The record is gone or damaged.
        """
        if self.status != "done":
            words = f"task {self.task!r} {self.status}: {self.error} {self.message}"
            raise SolveError(words, name="task", value=self.task)
        record = self._ledger.read(self.key)
        if record is None:
            words = f"the result {self.key} in {self._ledger.folder} is gone or damaged; run the batch again"
            raise ProblemError(words, name="key", value=self.key)
        return self._ledger.value(record)

    def row(self) -> dict[str, Any]:
        """Itself as a row of a table: ``COLUMNS``, and ``task.NAME`` and ``result.NAME`` of what is a number or a text.

        What is longer, in a task, stands there as JSON.
        """
        told: dict[str, Any] = {name: getattr(self, name) for name in COLUMNS}
        told["verdict"] = scalar(self.verdict)
        parts = self.task if isinstance(self.task, dict) else {"": self.task}
        told |= {f"task.{name}" if name else "task": scalar(value) for name, value in parts.items()}
        return told | {f"result.{name}": value for name, value in self.scalars.items()}


def row_of(record: Mapping[str, Any], ledger: Ledger) -> Result:
    """A result of a record."""
    value = record["value"]
    named = value if isinstance(value, dict) else {}
    scalars = {name: part for name, part in named.items() if isinstance(part, str | int | float)}
    names = ("key", "task", "status", "cost", "verdict", "seconds", "error", "message", "neighbour")
    return Result(**{name: record[name] for name in names}, scalars=scalars, _ledger=ledger)


class Batch:
    """Results, in the order of their tasks, each content once.

    Attributes:
        folder: Where they are kept. results: All of them.
    """

    def __init__(self, ledger: Ledger, results: Sequence[Result]) -> None:
        self.folder = checked_instance("Batch: ledger", ledger, Ledger).folder
        self.results = checked_each("Batch: results", results, Result)

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[Result]:
        return iter(self.results)

    def __getitem__(self, index: int) -> Result:
        return self.results[index]

    @property
    def counts(self) -> dict[str, int]:
        """How many results have which status."""
        return dict(Counter(result.status for result in self.results))

    def __str__(self) -> str:
        told = ", ".join(f"{count} {status}" for status, count in self.counts.items()) or "no tasks"
        lines = [f"{self.folder}: {told}"]
        reasons = Counter(f"{r.status}: {r.error} {r.message}" for r in self.results if r.status != "done")
        lines += [f"  {count} x {reason}" for reason, count in reasons.most_common(5)]
        return "\n".join(lines)

    @property
    def summary(self) -> str:
        """How many tasks are done and failed, why the first one did, and how to try again; one line."""
        done = self.counts.get("done", 0)
        told = f"{self.folder.name}: {len(self)} tasks: {done} done, {len(self) - done} failed"
        first = next((result for result in self.results if result.status != "done"), None)
        if first is None:
            return told
        message = first.message.partition("\n")[0]
        return f'{told}, first: {first.error or first.status}: {message}; run again with again="failed"'

    def check(self) -> None:
        """Raise BatchError, with the summary, where a task failed or ended its workers."""
        if count := len(self) - self.counts.get("done", 0):
            raise BatchError(self.summary, self, name=self.folder.name, value=count, limit=0)

    def best(self, by: Group) -> dict[Any, Result]:
        """The result of least cost in each group, of those that are done and of no bad verdict.

        Args:
            by: Name of an entry of the tasks, or a function of a task; what it is, in the group, is one text or number.

        Raises:
            ProblemError: A task has no such entry, or a group is no text or number.
        """
        if not isinstance(by, str) and not callable(by):
            words = f"best: by must be a name in the tasks or a function of a task, not {by!r}"
            raise ProblemError(words, name="by", value=by)
        found: dict[Any, Result] = {}
        for result in self.results:
            group = by(result.task) if callable(by) else entry(result.task, by)
            if group is not None and not isinstance(group, str | int | float):
                words = f"best: a group must be a text or a number, not {group!r}"
                raise ProblemError(words, name="by", value=group)
            if result.status != "done" or result.cost is None or result.verdict is False:
                continue
            if group not in found or result.cost < found[group].cost:  # type: ignore[operator]
                found[group] = result
        return found

    # ---- tables ------------------------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """All results as rows of the same columns; None where a result has nothing of that name."""
        rows = [result.row() for result in self.results]
        columns = dict.fromkeys(COLUMNS) | dict.fromkeys(name for row in rows for name in row)
        return [{name: row.get(name) for name in columns} for row in rows]

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as a table, in full precision; empty where there is nothing.

        A text that a spreadsheet would take for a formula, which begins with = + - @ or a tab, begins with the %XX of
        that sign; so does one that begins with %.

        Raises:
            ProblemError: path is no path of a file.
            OSError: It cannot be written.
        """
        checked_path(path)
        rows = self.rows()
        stream = io.StringIO()
        writer = csv.DictWriter(stream, rows[0] if rows else COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: cell(value) for name, value in row.items()} for row in rows)
        write_text(path, stream.getvalue())

    def write_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as Parquet; a column of numbers and texts as texts.

        Raises:
            ProblemError: path is no path of a file, or pyarrow is not installed.
            OSError: It cannot be written.
        """
        checked_path(path)
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError as error:
            words = "write_parquet: pyarrow is not installed; pip install pyarrow, or take write_csv"
            raise ProblemError(words, name="path", value=str(path)) from error
        rows = self.rows()
        columns = {name: alike([row[name] for row in rows]) for name in (rows[0] if rows else COLUMNS)}
        table = pyarrow.table(columns)
        write_whole(path, lambda stream: parquet.write_table(table, stream))


def read_batch(folder: str | os.PathLike[str]) -> Batch:
    """All results that a folder holds, in the order of their keys; nothing is done.

    Raises:
        ProblemError: It is no folder of a batch.
    """
    ledger = Ledger.at(folder)
    records = (ledger.read(key) for key in ledger.recorded())
    return Batch(ledger, tuple(row_of(record, ledger) for record in records if record is not None))


def entry(task: Any, name: str) -> Any:
    if not isinstance(task, dict) or name not in task:
        raise unknown_name("entry of a task", name, task if isinstance(task, dict) else ())
    return task[name]


def scalar(value: Any) -> Any:
    """A value that fits into a cell."""
    return value if value is None or isinstance(value, str | int | float) else json.dumps(value, ensure_ascii=False)


def alike(values: list[Any]) -> list[Any]:
    """Values of one kind: truths, numbers, or all as texts."""
    given = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in given):
        return values
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in given)
    if numbers and all(abs(value) < 2**53 for value in given if isinstance(value, int)):
        whole = all(isinstance(value, int) for value in given)
        return values if whole else [None if value is None else float(value) for value in values]
    return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
