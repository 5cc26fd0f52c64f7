"""Results of a batch of tasks as a table, and the best result of each group of tasks."""

from __future__ import annotations

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from models.errors import DetailedError
from ocp.app.batch.result_store import ResultStore
from ocp.errors import ProblemError, SolveError, require
from ocp.storage import cell, checked_path, write_text, write_whole

COLUMNS = ("key", "status", "cost", "verdict", "seconds", "error", "message")
Group = str | Callable[[Any], Any]


class BatchError(DetailedError, RuntimeError):
    """Error raised when tasks of a batch failed, after all other tasks are done and all results are stored.

    Attributes:
        batch: The results.
        value: Number of failed tasks.
    """

    def __init__(self, message: str = "", batch: Batch | None = None, **details: Any) -> None:
        super().__init__(message, **details)
        self.batch = batch


@dataclass(frozen=True)
class Result:
    """Result of one task of a batch.

    Attributes:
        key: Name of the result in the folder.
        task: The task.
        status: ``done``; ``failed``: the function raised an exception, or returned nan or something that is not data;
            ``killed``: the task ended at least three workers.
        cost, verdict: Values that the function returned, or those of the plan that it returned; otherwise None.
        seconds: Wall time of the call.
        error, message: Name and text of the exception; "" if done.
        neighbour: Key of the task whose result was the guess, or None.
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
    _store: ResultStore = field(repr=False, compare=False)

    @property
    def value(self) -> Any:
        """Value that the function returned, read from the folder; arrays and tuples are lists, plans are `Plan`
        objects.

        Raises:
            SolveError: The task is not done; gives the reason.
            ProblemError: The record is missing or damaged.
        """
        if self.status != "done":
            words = f"task {self.task!r} {self.status}: {self.error} {self.message}"
            raise SolveError(words, name="task", value=self.task)
        record = self._store.read(self.key)
        if record is None:
            words = f"the result {self.key} in {self._store.folder} is missing or damaged; run the batch again"
            raise ProblemError(words, name="key", value=self.key)
        return self._store.value(record)

    def row(self) -> dict[str, Any]:
        """Return the result as a table row.

        It contains ``COLUMNS``, the entries of the task as ``task.NAME``, and those of its value as ``result.NAME``.

        Longer entries of a task are given as JSON.
        """
        row: dict[str, Any] = {name: getattr(self, name) for name in COLUMNS}
        row["verdict"] = scalar(self.verdict)
        parts = self.task if isinstance(self.task, dict) else {"": self.task}
        row |= {f"task.{name}" if name else "task": scalar(value) for name, value in parts.items()}
        return row | {f"result.{name}": value for name, value in self.scalars.items()}


def row_of(record: Mapping[str, Any], store: ResultStore) -> Result:
    """Return the Result that a stored record describes."""
    value = record["value"]
    entries = value if isinstance(value, dict) else {}
    scalars = {name: entry for name, entry in entries.items() if isinstance(entry, str | int | float)}
    names = ("key", "task", "status", "cost", "verdict", "seconds", "error", "message", "neighbour")
    return Result(**{name: record[name] for name in names}, scalars=scalars, _store=store)


class Batch:
    """Results of a batch in the order of its tasks; equal tasks share one result.

    Attributes:
        folder: Folder of the results.
        results: All results.
    """

    def __init__(self, store: ResultStore, results: Sequence[Result]) -> None:
        self.folder = require.instance("Batch: store", store, ResultStore).folder
        self.results = require.each("Batch: results", results, Result)

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[Result]:
        return iter(self.results)

    def __getitem__(self, index: int) -> Result:
        return self.results[index]

    @property
    def counts(self) -> dict[str, int]:
        """Number of results of each status, keyed by status."""
        return dict(Counter(result.status for result in self.results))

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items()) or "no tasks"
        lines = [f"{self.folder}: {counts}"]
        reasons = Counter(f"{r.status}: {r.error} {r.message}" for r in self.results if r.status != "done")
        lines += [f"  {count} x {reason}" for reason, count in reasons.most_common(5)]
        return "\n".join(lines)

    @property
    def summary(self) -> str:
        """One line with the numbers of finished and failed tasks, the first error, and how to repeat failed tasks."""
        done = self.counts.get("done", 0)
        counts = f"{self.folder.name}: {len(self)} tasks: {done} done, {len(self) - done} failed"
        first = next((result for result in self.results if result.status != "done"), None)
        if first is None:
            return counts
        message = first.message.partition("\n")[0]
        return f'{counts}, first: {first.error or first.status}: {message}; run again with again="failed"'

    def check(self) -> None:
        """Raise BatchError with a summary of the batch if a task failed, or crashed the processes that ran it."""
        if count := len(self) - self.counts.get("done", 0):
            raise BatchError(self.summary, self, name=self.folder.name, value=count, limit=0)

    def best(self, by: Group) -> dict[Any, Result]:
        """Return the lowest-cost result of each group of tasks, among finished results whose verdict is not False.

        Args:
            by: Name of an entry of the tasks, or a function of a task; its value, a text or number, is the group.

        Raises:
            ProblemError: A task has no such entry, or a group is not a text or number.
        """
        if not isinstance(by, str) and not callable(by):
            words = f"best: by must be a name in the tasks or a function of a task, not {by!r}"
            raise ProblemError(words, name="by", value=by)
        best: dict[Any, Result] = {}
        for result in self.results:
            group = by(result.task) if callable(by) else entry(result.task, by)
            if group is not None and not isinstance(group, str | int | float):
                words = f"best: a group must be a text or a number, not {group!r}"
                raise ProblemError(words, name="by", value=group)
            if result.status != "done" or result.cost is None or result.verdict is False:
                continue
            if group not in best or result.cost < best[group].cost:  # type: ignore[operator]
                best[group] = result
        return best

    # ---- tables ------------------------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """Return all results as table rows with the same columns; a missing value is None."""
        rows = [result.row() for result in self.results]
        columns = dict.fromkeys(COLUMNS) | dict.fromkeys(name for row in rows for name in row)
        return [{name: row.get(name) for name in columns} for row in rows]

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as CSV in full precision; cells without a value are empty.

        A text that a spreadsheet would take for a formula (it begins with = + - @ or a tab) begins with the %XX of that
        character; so does a text that begins with %.

        Raises:
            ProblemError: The path is invalid.
            OSError: The file cannot be written.
        """
        checked_path(path)
        rows = self.rows()
        stream = io.StringIO()
        writer = csv.DictWriter(stream, rows[0] if rows else COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: cell(value) for name, value in row.items()} for row in rows)
        write_text(path, stream.getvalue())

    def write_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as a Parquet file; a column that contains both numbers and texts is written as texts.

        Raises:
            ProblemError: The path is invalid, or pyarrow is not installed.
            OSError: The file cannot be written.
        """
        checked_path(path)
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError as error:
            words = "write_parquet: pyarrow is not installed; pip install pyarrow, or use write_csv"
            raise ProblemError(words, name="path", value=str(path)) from error
        rows = self.rows()
        columns = {name: uniform([row[name] for row in rows]) for name in (rows[0] if rows else COLUMNS)}
        table = pyarrow.table(columns)
        write_whole(path, lambda stream: parquet.write_table(table, stream))


def read_batch(folder: str | os.PathLike[str]) -> Batch:
    """Return all results that are stored in a folder, ordered by their keys, without computing any.

    Raises:
        ProblemError: The folder is not that of a batch.
    """
    store = ResultStore.at(folder)
    records = (store.read(key) for key in store.stored_keys())
    return Batch(store, tuple(row_of(record, store) for record in records if record is not None))


def entry(task: Any, name: str) -> Any:
    """Return a named entry of a task; raise ProblemError if the task has no such entry."""
    if not isinstance(task, dict) or name not in task:
        raise require.unknown("entry of a task", name, task if isinstance(task, dict) else ())
    return task[name]


def scalar(value: Any) -> Any:
    """Return a value as the content of a table cell: texts and numbers unchanged, other data as JSON."""
    return value if value is None or isinstance(value, str | int | float) else json.dumps(value, ensure_ascii=False)


def uniform(values: list[Any]) -> list[Any]:
    """Convert the values of a column to one type: booleans, numbers, or texts."""
    present = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in present):
        return values
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in present)
    if numbers and all(abs(value) < 2**53 for value in present if isinstance(value, int)):
        whole = all(isinstance(value, int) for value in present)
        return values if whole else [None if value is None else float(value) for value in values]
    return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
