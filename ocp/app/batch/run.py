"""Run many tasks with one function and store each result, so that an interrupted batch can be continued."""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import os
import sys
import textwrap
from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
import scipy
from tqdm import tqdm

from models.checks import NOT_NUMBERS, Array, check_entries, floats
from models.files import INPUT_LIMITS
from ocp.app.batch.engine import Engine, Function, Job, checked_cluster, failure_payload
from ocp.app.batch.result_store import STATUSES, Payload, ResultStore, canonical_text, digest_of, key_of
from ocp.app.batch.table import Batch, Result, row_of
from ocp.errors import ProblemError, require

MAX_WORKERS = 4096


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
    is_count = cluster is None or isinstance(cluster, int)
    count = worker_count(cluster) if is_count else MAX_WORKERS
    if not is_count:
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
                pending = _PendingTasks(store, texts, parents, results, source)
                if len(results) < len(texts):
                    count = min(count, len(texts) - len(results))
                    with Engine(function, near=bool(names), cluster=count if is_count else cluster) as engine:
                        pending.run(engine)
        except OSError as error:
            if isinstance(error, ConnectionError):
                raise
            words = (
                f"{error.strerror or error}; {len(results)} of {len(texts)} results are stored, run again for the rest"
            )
            raise OSError(error.errno, words, str(store.folder)) from error
    batch = Batch(store, tuple(results[key] for key in texts))
    if failures == "raise":
        batch.check()
    return batch


class _PendingTasks:
    """The tasks of a batch that have no result yet."""

    def __init__(
        self,
        store: ResultStore,
        texts: dict[str, str],
        parents: dict[str, str | None],
        results: dict[str, Result],
        source: str,
    ) -> None:
        self.store, self.texts, self.parents, self.results, self.source = store, texts, parents, results, source
        self.failures = 0
        self.after: defaultdict[str, list[str]] = defaultdict(list)  # tasks that wait for their neighbour
        self.ready: deque[str] = deque()
        self.suspects: deque[str] = deque()  # tasks that were sent when a worker ended
        self.isolated = ""  # the suspect that is sent alone
        self.deaths: Counter[str] = Counter()
        for key, parent in parents.items():
            if key not in results:
                if parent is None or parent in results:
                    self.ready.append(key)
                else:
                    self.after[parent].append(key)

    def run(self, engine: Engine) -> None:
        """Run the tasks until none is pending."""
        options: dict[str, Any] = {"desc": self.store.folder.name, "unit": "task", "disable": None, "leave": False}
        with tqdm(total=len(self.texts), initial=len(self.results), file=sys.stderr, **options) as bar:
            while len(self.results) < len(self.texts):
                self._submit(engine)
                outcomes = engine.wait(1.0)
                for lost in (outcome for outcome in outcomes if outcome.payload is None):
                    if lost.deaths:
                        self._suspect(lost.key, lost.deaths, engine.settings.deaths)
                    else:
                        self.ready.appendleft(lost.key)
                self._submit(engine)  # before writing, so that the workers do not wait
                for outcome in outcomes:
                    if outcome.payload is not None:
                        self._end(outcome.key, outcome.payload)
                bar.update(len(self.results) - bar.n)
                if self.failures:
                    bar.set_postfix(failed=self.failures, refresh=False)

    def _suspect(self, key: str, deaths: int, max_deaths: int) -> None:
        """Queue a task to run alone, because its worker ended; record the task as killed if too many workers ended."""
        self.deaths[key] += deaths
        if key == self.isolated and self.deaths[key] >= max_deaths:
            self._end(key, failure_payload("killed", "", f"it ended {self.deaths[key]} workers"))
        else:
            self.suspects.append(key)

    def _submit(self, engine: Engine) -> None:
        """Send as many tasks as the workers can take; a task that may have killed a worker runs alone."""
        if self.suspects or self.isolated:
            if not engine.is_idle or not engine.free_slots():
                return
            self.isolated = self.suspects.popleft() if self.suspects else ""
            if self.isolated:
                engine.submit([Job(self.isolated, self.texts[self.isolated], self._guess(self.isolated))])
                return
        for _ in range(engine.free_slots()):
            keys = [self.ready.popleft() for _ in range(min(engine.share(len(self.ready)), len(self.ready)))]
            if not keys:
                break
            engine.submit([Job(key, self.texts[key], self._guess(key)) for key in keys])

    def _guess(self, key: str) -> Payload | None:
        """Return the stored result of a similar task as initial guess for a task; None if there is no such result."""
        parent = self._neighbour(key)
        record = None if parent is None else self.store.read(parent)
        return None if record is None else self.store.payload(record)

    def _neighbour(self, key: str) -> str | None:
        """Follow the chain of similar tasks from a task; return the key of the first that succeeded, or None."""
        parent = self.parents[key]
        while parent is not None and self.results[parent].status != "done":
            parent = self.parents[parent]
        return parent

    def _end(self, key: str, payload: Payload) -> None:
        """Store the result of a finished task, and queue the tasks that waited for this result."""
        record = {"key": key, "task": json.loads(self.texts[key]), "neighbour": self._neighbour(key), **payload.record}
        record["inputs"] = {"source": self.source, **record["inputs"]}
        self.store.write(record, payload.files)
        self.results[key] = row_of(record, self.store)
        self.failures += record["status"] != "done"
        self.ready.extend(self.after.pop(key, ()))


def texts_of(tasks: Any) -> dict[str, str]:
    """Return the canonical text of each distinct task, keyed by the key of the task.

    Raises:
        ProblemError: `tasks` is not a list, or one of them is not data.
    """
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


def worker_count(count: int | None) -> int:
    """Return the number of processes to start; by default one for each core that this process may use."""
    if count is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    require.count("cluster", count, 1, MAX_WORKERS)
    return count


def names_of(argument: str, names: Any) -> tuple[str, ...]:
    """Return a list of names as a tuple; raise ProblemError if the argument is not a list of names."""
    if isinstance(names, str) or not isinstance(names, Collection):
        raise ProblemError(f"{argument} must be a list of names, not {names!r}", name=argument, value=names)
    return tuple(require.text(argument, name) for name in names)


def name_of(function: Any) -> str:
    """Return the name under which a function's results are stored, ``module:name``; a script is named after its file.

    Raises:
        ProblemError: A worker cannot find the function by name, as for a lambda, a nested function, a method, or a
            function typed at a prompt; or this process is itself a worker that reads the script of its driver.
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

    The first task has None; neighbours come first in the order of the dictionary. The tasks alone determine the
    neighbours. Ordered by their keys, which looks random, they form generations of 1, 1, 2, 4, 8, ... tasks, and the
    neighbour of a task is the nearest task of all earlier generations. Neighbours thus come closer as the tasks get
    denser, the tasks of one generation can run in parallel, and no chain is longer than log2 of the number of tasks.

    Args:
        tasks: Tasks by key.
        names: Names of the numbers (or lists of numbers) in the tasks that span the space of the distance; each is
            divided by its range.

    Raises:
        ProblemError: A task lacks these numbers, or has not as many as the others; names the task.
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
    """Return the named numbers of a task as a point, to compute distances between tasks. Shape (n,)."""
    parts = []
    for name in names:
        value = task.get(name) if isinstance(task, Mapping) else None
        try:
            part = floats(value).ravel()
        except NOT_NUMBERS as error:
            words = f"near: {name!r} is not a number or list of numbers in the task {task!r}"
            raise ProblemError(words, name=name, value=value) from error
        parts.append(part)
    return np.concatenate(parts) if parts else np.zeros(0)
