"""Many tasks done by one function, each once, whatever happens meanwhile."""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import os
import sys
import textwrap
import time
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from functools import cache
from typing import Any, Literal

from tqdm import tqdm

from ocp.batch.claims import Claims
from ocp.batch.cluster import Cluster, checked_cluster
from ocp.batch.content import Parcel, digest_of, key_of, text_of
from ocp.batch.ledger import ENDS, Ledger
from ocp.batch.neighbours import neighbours
from ocp.batch.processes import Job, Processes, Source
from ocp.batch.table import Batch, Result, row_of
from ocp.batch.worker import Function, failed, loading
from ocp.errors import MOST, NOT_NUMBERS, ProblemError, check_entries, checked_choice, checked_count, checked_text

__all__ = ["run_batch"]

MOST_DEATHS = 3
"""Workers that one task may end."""
MOST_WORKERS = 4096
PAUSE = 0.2
"""s between two looks at what another driver is at."""


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
    list of tasks what is new. Several calls on one folder, also from several machines that share it, share the work.

    Args:
        function: ``function(task)``, at the top level of a module or of the script that was started (which then calls
            run_batch under ``if __name__ == "__main__":``). It returns data (numbers, texts, True, False, None, lists
            and dictionaries by name of these; arrays become lists), or plans and solutions, or these among data. Its
            cost is a plan's own, a dictionary's ``"cost"``, or a single number; its verdict a dictionary's
            ``"verdict"``, or whether a plan's audit passes. Whatever it raises is the result of that task, ``failed``,
            and the other tasks go on.
        tasks: Data each: parameters by name, a seed, the text of a task's file. Tasks of the same content are one.
        folder: New, empty, or of an earlier call with this function.
        workers: Processes on this machine; one for each core where it is None.
        cluster: Address of a Dask scheduler, ``"tcp://host:8786"``, or a `distributed.Client`: its workers do the
            tasks, and have to have this package and the function's module. Results come back to this process. Take
            workers of one thread: those of a process take turns.
        near: Names of numbers in the tasks. Then ``function(task, guess)`` is called with the result of a task near by,
            for a warm start, or None (:mod:`ocp.batch.neighbours`): the tasks alone decide of which.
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
        ProblemError: A task is no data, the function cannot be found by a worker, the folder is another function's.
        OSError: The folder cannot be written; what is done is kept.
        SolveError: The scheduler of the cluster is gone; what is done is kept.
        KeyboardInterrupt: Ctrl-C. The workers are gone, what is done is kept.
    """
    source = source_of(function)
    if loading():
        words = "run_batch: its workers read the script that calls it; call it under if __name__ == '__main__':"
        raise ProblemError(words, name="function", value=source.name)
    texts = texts_of(tasks)
    count = workers_of(workers, cluster)
    names = names_of("near", near)
    ends = names_of("again", (again,) if isinstance(again, str) else again)
    for end in ends:
        checked_choice("again", end, ENDS[1:])
    checked_choice("failures", failures, ("raise", "return"))
    told = source_version(function) if version is None else checked_text("version", version)
    ledger = Ledger.of(folder, f"{title(source)}:{source.name}", told, version is not None)
    parents = neighbours(tasks_of(texts), names) if names else dict.fromkeys(texts)
    before = {key: record for key in texts if (record := ledger.read(key)) is not None}
    source_digest, digests = module_version(function), cache(digest_of)

    def counts(record: dict[str, Any]) -> bool:
        """Whether a record is what the task would come to."""
        files = record["inputs"].get("kept")
        same = record["inputs"].get("source") == source_digest and isinstance(files, dict)
        same = same and all(digests(file) == digest for file, digest in files.items())
        return record["status"] == "done" or (same and record["status"] not in ends)

    results = {key: row_of(record, ledger) for key, record in before.items() if counts(record)}
    if len(results) < len(texts):
        try:
            with ExitStack() as opened:
                claims = opened.enter_context(Claims(ledger.folder))
                crew: Processes | Cluster
                if cluster is None:
                    crew = opened.enter_context(Processes(source, count))
                else:
                    crew = opened.enter_context(Cluster(cluster, function))
                Missing(ledger, claims, texts, parents, results, before, bool(names), source_digest).do(crew)
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
        claims: Claims,
        texts: dict[str, str],
        parents: dict[str, str | None],
        results: dict[str, Result],
        before: dict[str, dict[str, Any]],
        near: bool,
        source: str,
    ) -> None:
        self.source, self.failures = source, 0
        self.ledger, self.claims, self.texts, self.parents, self.near = ledger, claims, texts, parents, near
        self.results, self.before = results, {key: before[key] for key in before if key not in results}
        self.after: defaultdict[str, list[str]] = defaultdict(list)  # tasks that wait for a neighbour
        self.ready: deque[str] = deque()
        self.others: deque[str] = deque()  # tasks that another driver is at
        self.deaths: defaultdict[str, list[str]] = defaultdict(list)
        for key, parent in parents.items():
            if key not in results:
                if parent is None or parent in results:
                    self.ready.append(key)
                else:
                    self.after[parent].append(key)

    def do(self, crew: Processes | Cluster) -> None:
        """Do them, until none is missing."""
        looked = time.monotonic()
        told: dict[str, Any] = {"desc": self.ledger.folder.name, "unit": "task", "disable": None, "leave": False}
        with tqdm(total=len(self.texts), initial=len(self.results), file=sys.stderr, **told) as bar:
            while len(self.results) < len(self.texts):
                self._submit(crew)
                pause = PAUSE if self.others else 1.0
                outcomes = crew.wait(pause, len(self.texts) - len(self.results))
                self._submit(crew)  # before anything is written: workers shall not wait
                for outcome in outcomes:
                    if outcome.parcel is not None:
                        self._end(outcome.key, outcome.parcel)
                    elif self._is_deadly(outcome.key, outcome.why, outcome.deaths):
                        words = f"it ended {MOST_DEATHS} workers: {'; '.join(self.deaths[outcome.key])}"
                        self._end(outcome.key, failed("killed", "", words))
                    else:
                        self.ready.appendleft(outcome.key)
                if self.others and time.monotonic() - looked > PAUSE:
                    looked = time.monotonic()
                    self.ready.extend(self.others)
                    self.others.clear()
                self.claims.sign()
                bar.update(len(self.results) - bar.n)
                if self.failures:
                    bar.set_postfix(failed=self.failures, refresh=False)

    def _submit(self, crew: Processes | Cluster) -> None:
        room = crew.room()
        while room and self.ready:
            key = self.ready.popleft()
            if not self._is_ours(key):
                continue
            crew.submit(Job(key, self.texts[key], self.near, self._guess(key)))
            room -= 1

    def _is_ours(self, key: str) -> bool:
        """Whether a task is to be done, and by us."""
        if key in self.deaths:  # it is ours since it was begun
            return True
        if not self.claims.take(key):
            self.others.append(key)
            return False
        record = self.ledger.read(key)  # after the claim: who had it may have done it
        if record is None or record == self.before.get(key):
            return True
        self.claims.release(key)
        self._take_note(record)
        return False

    def _is_deadly(self, key: str, why: str, deaths: int) -> bool:
        self.deaths[key] += [why] * deaths
        return len(self.deaths[key]) >= MOST_DEATHS

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
        """Keep what came of a task, unless another driver that took us for gone has done so."""
        known = self.ledger.read(key)
        if known is None or known == self.before.get(key):
            task = tasks_of({key: self.texts[key]})[key]
            known = {"key": key, "task": task, "neighbour": self._neighbour(key), **parcel.record}
            known["inputs"] = {"source": self.source, **known["inputs"]}
            self.ledger.write(known, parcel.files)
        self.claims.release(key)
        self._take_note(known)

    def _take_note(self, record: dict[str, Any]) -> None:
        key = record["key"]
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
            if i >= MOST:
                raise ProblemError(f"tasks: at most {MOST} at a time", name="tasks", limit=MOST)
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


def source_of(function: Any) -> Source:
    """Where a worker finds a function.

    Raises:
        ProblemError: It does not: it has no name there, as a lambda, a function within another, a method, and what was
            typed at a prompt.
    """
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
        return Source(module, name, None)
    main = sys.modules["__main__"]
    if main.__spec__ is not None:  # python -m
        return Source(main.__spec__.name, name, None)
    file = getattr(main, "__file__", None)
    if file is None:
        words = f"function: {name} was typed at a prompt, where no worker can read it; import it from a file"
        raise ProblemError(words, name="function", value=function)
    return Source(module, name, os.path.abspath(file))


def title(source: Source) -> str:
    """The module's name; a script's is that of its file."""
    return source.module if source.file is None else os.path.splitext(os.path.basename(source.file))[0]


def module_version(function: Function) -> str:
    """Digits that change with the source of the function's module."""
    return source_version(sys.modules[function.__module__])


def source_version(function: Any) -> str:
    """Digits that change with the source of a function or a module, not its comments; "" where there is none."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return ""
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]
