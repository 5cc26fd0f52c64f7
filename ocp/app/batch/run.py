"""Many tasks done by one function, each once, whatever happens meanwhile."""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import os
import sys
import textwrap
from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from typing import Any, Literal

from tqdm import tqdm

from ocp.app.batch.content import Parcel, digest_of, key_of, neighbours, text_of
from ocp.app.batch.engine import Engine, Function, Job, checked_cluster, failed
from ocp.app.batch.ledger import ENDS, Ledger
from ocp.app.batch.table import Batch, Result, row_of
from ocp.errors import MAX_COUNT, NOT_NUMBERS, ProblemError, check_entries, checked_choice, checked_count, checked_text

__all__ = ["run_batch"]

MOST_WORKERS = 4096


def run_batch(
    function: Function,
    tasks: Iterable[Any],
    folder: str | os.PathLike[str],
    *,
    workers: int | None = None,
    cluster: Any = None,
    near: Sequence[str] = (),
    again: str | Collection[str] = (),
    failures: Literal["raise", "return"] = "raise",
    version: str | None = None,
) -> Batch:
    """Call a function with each of many tasks, and keep each result in a folder as soon as it is there.

    What the folder holds is not done again: after whatever ended it the same call does what is missing, and a longer
    list of tasks what is new. A call that finds another one at work in its folder waits for its end, and then does what
    is missing.

    Args:
        function: ``function(task)``, at the top level of a module or of the script that was started (which then calls
            run_batch under ``if __name__ == "__main__":``). It returns data (numbers, texts, True, False, None, lists
            and dictionaries by name of these; arrays become lists), or plans and solutions, or these among data. Its
            cost is a plan's own, a dictionary's ``"cost"``, or a single number; its verdict a dictionary's
            ``"verdict"``, or whether a plan's audit passes. Whatever it raises is the result of that task, ``failed``,
            and the other tasks go on.
        tasks: Data each: parameters by name, a seed, the text of a task's file. Tasks of the same content are one.
        folder: New, empty, or of an earlier call with this function.
        workers: Processes on this machine, a Dask cluster that is begun and ended here; one for each core where it is
            None.
        cluster: Address of a Dask scheduler, ``"tcp://host:8786"``, or a `distributed.Client`: its workers do the
            tasks, and have to have this package and the function's module. Results come back to this process. Take
            workers of one thread: those of a process take turns.
        near: Names of numbers in the tasks. Then ``function(task, guess)`` is called with the result of a task near by,
            for a warm start, or None (:mod:`ocp.app.batch.content`): the tasks alone decide of which.
        again: Ends that are tried again whatever has changed: ``"failed"``, ``"killed"``, or both. Without it a task
            that failed is tried again when the source of the function's module has changed, or a file that an argument
            of :func:`kept` names.
        failures: What becomes of a batch in which tasks failed: ``"raise"`` a BatchError, so that a script ends with a
            status other than 0, or ``"return"`` the results, for failures that are answers.
        version: Of the function, a text; another version's results are not mixed in, failures are no results. None: the
            function's own source, without comments; what it calls is not looked at.

    Returns:
        A result for each task. On a terminal a line says how many are done, how many failed, and how long the rest will
        take.

    Raises:
        BatchError: Tasks failed; says how many and why the first did, and carries the results.
        ProblemError: A task is no data, the function cannot be found by a worker, the folder is another function's, or
            Dask is not installed.
        OSError: The folder cannot be written; what is done is kept.
        SolveError: The scheduler of the cluster is gone; what is done is kept.
        KeyboardInterrupt: Ctrl-C. The workers are gone, what is done is kept.
    """
    name = name_of(function)
    texts = texts_of(tasks)
    count = workers_of(workers, cluster)
    names = names_of("near", near)
    ends = names_of("again", (again,) if isinstance(again, str) else again)
    for end in ends:
        checked_choice("again", end, ENDS[1:])
    checked_choice("failures", failures, ("raise", "return"))
    told = source_version(function) if version is None else checked_text("version", version)
    ledger = Ledger.of(folder, name, told, version is not None)
    parents = neighbours(tasks_of(texts), names) if names else dict.fromkeys(texts)
    source, digests = source_version(sys.modules[function.__module__]), cache(digest_of)

    def counts(record: dict[str, Any]) -> bool:
        """Whether a record is what the task would come to."""
        files = record["inputs"].get("kept")
        same = record["inputs"].get("source") == source and isinstance(files, dict)
        same = same and all(digests(file) == digest for file, digest in files.items())
        return record["status"] == "done" or (same and record["status"] not in ends)

    def recorded(keys: Iterable[str]) -> dict[str, Result]:
        there = set(ledger.recorded())
        records = [record for key in keys if key in there and (record := ledger.read(key)) and counts(record)]
        return {record["key"]: row_of(record, ledger) for record in records}

    results = recorded(texts)
    if len(results) < len(texts):
        try:
            with ledger.alone():
                results |= recorded([key for key in texts if key not in results])  # of a driver that was waited for
                missing = Missing(ledger, texts, parents, results, source)
                if len(results) < len(texts):
                    with Engine(function, bool(names), min(count, len(texts) - len(results)), cluster) as engine:
                        missing.do(engine)
        except OSError as error:
            if isinstance(error, ConnectionError):
                raise
            words = (
                f"{error.strerror or error}; {len(results)} of {len(texts)} results are kept, run again for the rest"
            )
            raise OSError(error.errno, words, str(ledger.folder)) from error
    batch = Batch(ledger, tuple(results[key] for key in texts))
    if failures == "raise":
        batch.check()
    return batch


class Missing:
    """The tasks of a batch that have no result yet."""

    def __init__(
        self,
        ledger: Ledger,
        texts: dict[str, str],
        parents: dict[str, str | None],
        results: dict[str, Result],
        source: str,
    ) -> None:
        self.ledger, self.texts, self.parents, self.results, self.source = ledger, texts, parents, results, source
        self.failures = 0
        self.after: defaultdict[str, list[str]] = defaultdict(list)  # tasks that wait for a neighbour
        self.ready: deque[str] = deque()
        self.suspects: deque[str] = deque()  # tasks that were sent when a worker ended
        self.alone = ""  # of them the one that is sent by itself
        self.deaths: Counter[str] = Counter()
        for key, parent in parents.items():
            if key not in results:
                if parent is None or parent in results:
                    self.ready.append(key)
                else:
                    self.after[parent].append(key)

    def do(self, engine: Engine) -> None:
        """Do them, until none is missing."""
        told: dict[str, Any] = {"desc": self.ledger.folder.name, "unit": "task", "disable": None, "leave": False}
        with tqdm(total=len(self.texts), initial=len(self.results), file=sys.stderr, **told) as bar:
            while len(self.results) < len(self.texts):
                self._submit(engine)
                outcomes = engine.wait(1.0)
                for lost in (outcome for outcome in outcomes if outcome.parcel is None):
                    if lost.deaths:
                        self._suspect(lost.key, lost.deaths, engine.settings.deaths)
                    else:
                        self.ready.appendleft(lost.key)
                self._submit(engine)  # before anything is written: workers shall not wait
                for outcome in outcomes:
                    if outcome.parcel is not None:
                        self._end(outcome.key, outcome.parcel)
                bar.update(len(self.results) - bar.n)
                if self.failures:
                    bar.set_postfix(failed=self.failures, refresh=False)

    def _suspect(self, key: str, deaths: int, most: int) -> None:
        """Try again by itself what was sent when a worker ended, or set it aside where it has been so."""
        self.deaths[key] += deaths
        if key == self.alone and self.deaths[key] >= most:
            self._end(key, failed("killed", "", f"it ended {self.deaths[key]} workers"))
        else:
            self.suspects.append(key)

    def _submit(self, engine: Engine) -> None:
        if self.suspects or self.alone:
            if not engine.is_idle or not engine.room():
                return
            self.alone = self.suspects.popleft() if self.suspects else ""
            if self.alone:
                engine.submit([Job(self.alone, self.texts[self.alone], self._guess(self.alone))])
                return
        for _ in range(engine.room()):
            keys = [self.ready.popleft() for _ in range(min(engine.share(len(self.ready)), len(self.ready)))]
            if not keys:
                break
            engine.submit([Job(key, self.texts[key], self._guess(key)) for key in keys])

    def _guess(self, key: str) -> Parcel | None:
        """The result of the nearest neighbour that has one."""
        parent = self._neighbour(key)
        record = None if parent is None else self.ledger.read(parent)
        return None if record is None else self.ledger.parcel(record)

    def _neighbour(self, key: str) -> str | None:
        parent = self.parents[key]
        while parent is not None and self.results[parent].status != "done":
            parent = self.parents[parent]
        return parent

    def _end(self, key: str, parcel: Parcel) -> None:
        """Keep what came of a task."""
        record = {"key": key, "task": json.loads(self.texts[key]), "neighbour": self._neighbour(key), **parcel.record}
        record["inputs"] = {"source": self.source, **record["inputs"]}
        self.ledger.write(record, parcel.files)
        self.results[key] = row_of(record, self.ledger)
        self.failures += record["status"] != "done"
        self.ready.extend(self.after.pop(key, ()))


# ---- what is asked -----------------------------------------------------------------------------------------------


def texts_of(tasks: Any) -> dict[str, str]:
    """The text of each task by its key, each content once.

    Raises:
        ProblemError: tasks is no list, or one of them no data.
    """
    if isinstance(tasks, str | bytes | dict):
        raise ProblemError(f"tasks must be a list of tasks, not one: {tasks!r}", name="tasks", value=tasks)
    found: dict[str, str] = {}
    try:
        check_entries(tasks)
        for i, task in enumerate(tasks):
            if i >= MAX_COUNT:
                raise ProblemError(f"tasks: at most {MAX_COUNT} at a time", name="tasks", limit=MAX_COUNT)
            text = text_of(task, f"tasks[{i}]")
            found[key_of(text)] = text
    except ProblemError:
        raise
    except NOT_NUMBERS as error:
        raise ProblemError(f"tasks must be a list of tasks, not {tasks!r}", name="tasks", value=tasks) from error
    return found


def tasks_of(texts: dict[str, str]) -> dict[str, Any]:
    """The tasks of texts."""
    return {key: json.loads(text) for key, text in texts.items()}


def workers_of(workers: Any, cluster: Any) -> int:
    if workers is None:
        if cluster is not None:
            checked_cluster(cluster)
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cluster is not None:
        words = "workers are the cluster's own; leave one of the two out"
        raise ProblemError(words, name="workers", value=workers)
    checked_count("workers", workers, 1, MOST_WORKERS)
    return int(workers)


def names_of(what: str, names: Any) -> tuple[str, ...]:
    if isinstance(names, str) or not isinstance(names, Collection):
        raise ProblemError(f"{what} must be a list of names, not {names!r}", name=what, value=names)
    return tuple(checked_text(what, name) for name in names)


def name_of(function: Any) -> str:
    """The name of a function for its folder: ``module:name``; of a script, that of its file for the module.

    Raises:
        ProblemError: A worker does not find it by a name, as a lambda, a function within another, a method, and what
            was typed at a prompt; or this process is itself a worker, which reads the script that calls run_batch.
    """
    if sys.modules.get("__mp_main__") not in (None, sys.modules["__main__"]):  # a worker reads its driver's script
        words = "run_batch: its workers read the script that calls it; call it under if __name__ == '__main__':"
        raise ProblemError(words, name="function", value=function)
    name, module = getattr(function, "__qualname__", None), getattr(function, "__module__", None)
    if not callable(function) or not isinstance(name, str) or not isinstance(module, str):
        words = f"function must be a function with a name, not {function!r}; what it needs besides goes into the tasks"
        raise ProblemError(words, name="function", value=function)
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not function:
        words = f"function: a worker cannot find {name} of {module} by its name; put it at the top level of a module"
        raise ProblemError(words, name="function", value=function)
    if module != "__main__":
        return f"{module}:{name}"
    main = sys.modules["__main__"]
    if main.__spec__ is not None:  # python -m
        return f"{main.__spec__.name}:{name}"
    file = getattr(main, "__file__", None)
    if file is None:
        words = f"function: {name} was typed at a prompt, where no worker can read it; import it from a file"
        raise ProblemError(words, name="function", value=function)
    return f"{os.path.splitext(os.path.basename(file))[0]}:{name}"


def source_version(function: Any) -> str:
    """Digits that change with the source of a function or a module, not its comments; "" where there is none."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return ""
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]
