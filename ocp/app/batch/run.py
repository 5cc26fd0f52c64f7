"""Run many tasks with one function, store each result so that an interrupted batch can be continued, and list all
results.
"""

from __future__ import annotations

import ast
import csv
import hashlib
import inspect
import io
import json
import os
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
import scipy

from models.checks import NOT_NUMBERS, Array, check_entries, floats
from models.errors import DetailedError
from models.files import INPUT_LIMITS
from ocp.app.batch.engine import Engine, Function, PendingTasks, checked_cluster
from ocp.app.batch.result_store import COLUMNS, STATUSES, Result, ResultStore, canonical_text, digest_of, key_of, row_of
from ocp.errors import ProblemError, require
from ocp.storage import cell, checked_path, write_text, write_whole

MAX_WORKERS = 4096
Group = str | Callable[[Any], Any]


def run_batch(
    function: Function,
    tasks: Iterable[Any],
    folder: str | os.PathLike[str],
    *,
    cluster: Any = None,
    near: Sequence[str] = (),
    again: str | Collection[str] = (),
    failures: Literal["raise", "return"] = "raise",
    version: str | None = None,
) -> Batch:
    """Call a function with each of many tasks, and store each result in a folder as soon as it is available.

    Results in the folder are not computed again: the same call after an interruption computes the missing ones, and a
    longer list of tasks the new ones. A call waits while another one is active in its folder, and then computes what is
    missing.

    Args:
        function: ``function(task)``, at the top level of a module or of the started script (which then calls run_batch
            under ``if __name__ == "__main__":``). It returns data (numbers, texts, True, False, None, lists and
            dictionaries of these; arrays become lists), or plans and solutions, or these among data. Its cost
            is that of a plan, the ``"cost"`` of a dictionary, or a single number; its verdict the ``"verdict"`` of a
            dictionary, or whether the audit of a plan passes. An exception makes the result of its task ``failed``, and
            the other tasks continue.
        tasks: Data: parameters by name, a seed, the text of a task file. Equal tasks count once.
        folder: New, empty, or that of an earlier call with this function.
        cluster: Number of processes of a Dask cluster that is started on this machine and ended here; None: one for
            each core. Or the address of a Dask scheduler, ``"tcp://host:8786"``, or a `distributed.Client`. Its workers
            run the tasks and need this package and the function's module; results are sent to this process. Use workers
            with one thread: the threads of a process take turns.
        near: Names of numbers in the tasks. If given, ``function(task, guess)`` is called with the result of a similar
            task for a warm start, or None. The tasks alone determine which one (:func:`neighbours`).
        again: Status of the results to compute again in any case: ``"failed"``, ``"killed"``, or both. Otherwise a
            failed task is repeated if the source of the function's module has changed, or a file that an argument of
            :func:`cached` names.
        failures: ``"raise"``: raise BatchError if tasks failed, so that a script ends with a status other than 0.
            ``"return"``: return the results.
        version: Version of the function, a text; results of another version are not mixed in, failures are ignored.
            None: a digest of the function's own source without comments, excluding the functions that it calls.

    Returns:
        A result for each task. A terminal shows how many are done, how many failed, and the remaining time.

    Raises:
        BatchError: Tasks failed; gives their number and the reason of the first, and carries the results.
        ProblemError: A task is not data, a worker cannot find the function, the folder belongs to another function, or
            Dask is not installed.
        OSError: The folder cannot be written; finished results are stored.
        SolveError: The scheduler of the cluster is lost; finished results are stored.
        KeyboardInterrupt: Ctrl-C. The workers are ended; finished results are stored.
    """
    name = name_of(function)
    texts = texts_of(tasks)
    if cluster is None:
        cluster = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    elif isinstance(cluster, int):
        require.count("cluster", cluster, 1, MAX_WORKERS)
    else:
        checked_cluster(cluster)
    names = names_of("near", near)
    statuses = names_of("again", (again,) if isinstance(again, str) else again)
    for status in statuses:
        require.choice("again", status, STATUSES[1:])
    require.choice("failures", failures, ("raise", "return"))
    function_version = source_version(function) if version is None else require.text("version", version)
    store = ResultStore.of(folder, name, function_version, version is not None)
    parents: dict[str, str | None] = dict.fromkeys(texts)
    if names:
        parents = neighbours({key: json.loads(text) for key, text in texts.items()}, names)
    source, digests = source_version(sys.modules[function.__module__]), cache(digest_of)

    def is_current(record: dict[str, Any]) -> bool:
        """Return whether a stored record is still valid, so that its task need not run again."""
        files = record["inputs"].get("kept")
        unchanged = record["inputs"].get("source") == source and isinstance(files, dict)
        unchanged = unchanged and all(digests(file) == digest for file, digest in files.items())
        return record["status"] == "done" or (unchanged and record["status"] not in statuses)

    def recorded(keys: Iterable[str]) -> dict[str, Result]:
        recorded_keys = set(store.stored_keys())
        candidates = (store.read(key) for key in keys if key in recorded_keys)
        records = [record for record in candidates if record and is_current(record)]
        return {record["key"]: row_of(record, store) for record in records}

    results = recorded(texts)
    if len(results) < len(texts):
        try:
            with store.locked():
                results |= recorded([key for key in texts if key not in results])  # by the driver that held the lock
                pending = PendingTasks(store, texts, parents, results=results, source=source)
                if len(results) < len(texts):
                    if isinstance(cluster, int):
                        cluster = min(cluster, len(texts) - len(results))
                    with Engine(function, near=bool(names), cluster=cluster) as engine:
                        pending.run(engine)
        except OSError as error:
            if isinstance(error, ConnectionError):
                raise
            rest = f"{len(results)} of {len(texts)} results are stored, run again for the rest"
            raise OSError(error.errno, f"{error.strerror or error}; {rest}", str(store.folder)) from error
    batch = Batch(store, tuple(results[key] for key in texts))
    if failures == "raise":
        batch.check()
    return batch


def texts_of(tasks: Any) -> dict[str, str]:
    """Return the JSON texts of the distinct tasks by key; raise ProblemError unless `tasks` is a list of plain data."""
    if isinstance(tasks, str | bytes | dict):
        raise ProblemError(f"tasks must be a list of tasks, not one: {tasks!r}", name="tasks", value=tasks)
    texts: dict[str, str] = {}
    try:
        check_entries(tasks)
        for i, task in enumerate(tasks):
            if i >= INPUT_LIMITS.count:
                words = f"tasks: at most {INPUT_LIMITS.count} at a time"
                raise ProblemError(words, name="tasks", limit=INPUT_LIMITS.count)
            text = canonical_text(task, f"tasks[{i}]")
            texts[key_of(text)] = text
    except ProblemError:
        raise
    except NOT_NUMBERS as error:
        raise ProblemError(f"tasks must be a list of tasks, not {tasks!r}", name="tasks", value=tasks) from error
    return texts


def names_of(argument: str, names: Any) -> tuple[str, ...]:
    """Return a list of names as a tuple; raise ProblemError if the argument is not a list of names."""
    if isinstance(names, str) or not isinstance(names, Collection):
        raise ProblemError(f"{argument} must be a list of names, not {names!r}", name=argument, value=names)
    return tuple(require.text(argument, name) for name in names)


def name_of(function: Any) -> str:
    """Return the name under which a function's results are stored, ``module:name``; a script is named after its file.

    Raises:
        ProblemError: A worker cannot find the function by name, as for a lambda, a nested function or a method; or this
            process is itself a worker that reads the script of its driver.
    """
    if sys.modules.get("__mp_main__") not in (None, sys.modules["__main__"]):  # a worker's import
        words = "run_batch: workers import the script that calls it; call it under if __name__ == '__main__':"
        raise ProblemError(words, name="function", value=function)
    name, module = getattr(function, "__qualname__", None), getattr(function, "__module__", None)
    if not callable(function) or not isinstance(name, str) or not isinstance(module, str):
        words = f"function must be a function with a name, not {function!r}; put its other arguments into the tasks"
        raise ProblemError(words, name="function", value=function)
    resolved: Any = sys.modules.get(module)
    for attribute in name.split("."):
        resolved = getattr(resolved, attribute, None)
    if resolved is not function:
        words = f"function: a worker cannot find {name} of {module} by its name; put it at the top level of a module"
        raise ProblemError(words, name="function", value=function)
    if module != "__main__":
        return f"{module}:{name}"
    main = sys.modules["__main__"]
    if main.__spec__ is not None:  # python -m
        return f"{main.__spec__.name}:{name}"
    file = getattr(main, "__file__", None)
    if file is None:
        words = f"function: {name} was typed at a prompt, which no worker can import; import it from a file"
        raise ProblemError(words, name="function", value=function)
    return f"{os.path.splitext(os.path.basename(file))[0]}:{name}"


def source_version(function: Any) -> str:
    """Return a hash of the source code of a function or module, ignoring comments; "" if there is no source."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return ""
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]


def neighbours(tasks: Mapping[str, Any], names: Sequence[str]) -> dict[str, str | None]:
    """Return for each task the key of its neighbour, the similar task whose result is its initial guess.

    The first task has no neighbour (None); each neighbour precedes its tasks in the dictionary. In the order of their
    keys (hashes), tasks form generations of 1, 1, 2, 4, 8, ... The neighbour of a task is the nearest task of all
    earlier generations, in the space of the numbers `names` of a task, each divided by its range. Neighbours thus come
    closer as the tasks get denser, and no chain is longer than log2 of the number of tasks.

    Raises:
        ProblemError: A task lacks these numbers, or has more or fewer than the others; the message shows the task.
    """
    order = sorted(tasks)
    rows = [coordinates_of(tasks[key], names) for key in order]
    for key, row in zip(order, rows, strict=True):
        if len(row) != len(rows[0]):
            words = f"near: {len(row)} numbers in the task {tasks[key]!r}, {len(rows[0])} in another"
            raise ProblemError(words, name="near", value=len(row), limit=len(rows[0]))
    points = np.array(rows)
    ranges = np.ptp(points, axis=0) if order else np.ones(0)
    points = points / np.where(ranges > 0, ranges, 1.0)
    parents: dict[str, str | None] = {}
    begin, end = 0, 1
    while begin < len(order):
        keys = order[begin:end]
        if begin:
            nearest = scipy.spatial.cKDTree(points[:begin]).query(points[begin:end])[1]
            parents |= {key: order[int(i)] for key, i in zip(keys, nearest, strict=True)}
        else:
            parents |= dict.fromkeys(keys)
        begin, end = end, 2 * end
    return parents


def coordinates_of(task: Any, names: Sequence[str]) -> Array:
    """Return the numbers that a task has under given names as a point, to compare tasks by distance. Shape (n,)."""
    parts = []
    for name in names:
        value = task.get(name) if isinstance(task, Mapping) else None
        try:
            parts.append(floats(value).ravel())
        except NOT_NUMBERS as error:
            words = f"near: {name!r} is not a number or list of numbers in the task {task!r}"
            raise ProblemError(words, name=name, value=value) from error
    return np.concatenate(parts) if parts else np.zeros(0)


# ---- results -----------------------------------------------------------------------------------------------------


class BatchError(DetailedError, RuntimeError):
    """Error raised when tasks of a batch failed, after all other tasks are done and all results are stored.

    Attributes:
        batch: The results.
        value: Number of failed tasks.
    """

    def __init__(self, message: str = "", batch: Batch | None = None, **details: Any) -> None:
        super().__init__(message, **details)
        self.batch = batch


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
        """Raise BatchError with a summary of the batch if a task failed or ended the processes that ran it."""
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


def uniform(values: list[Any]) -> list[Any]:
    """Convert the values of a table column to one type: booleans, numbers, or texts."""
    present = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in present):
        return values
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in present)
    if numbers and all(abs(value) < 2**53 for value in present if isinstance(value, int)):
        whole = all(isinstance(value, int) for value in present)
        return values if whole else [None if value is None else float(value) for value in values]
    return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
