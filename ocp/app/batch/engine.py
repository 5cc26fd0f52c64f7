"""Run tasks with Dask on a given cluster, or on a cluster that is started on this machine with one process per core.

Results are sent to the driver, the process that runs the batch, so the machines need no common folder. A cluster
started here uses TLS with a certificate of its own: no other user of the machine can send it tasks or read results.
A worker calls the function with one task after another and caches what several tasks share, such as a robot.
"""

from __future__ import annotations

import errno
import json
import logging
import multiprocessing
import os
import queue
import secrets
import sys
import threading
import time
import traceback
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from tqdm import tqdm

from models.errors import DetailedError
from ocp.app.batch.result_store import (
    Payload,
    Result,
    ResultStore,
    canonical_text,
    digest_of,
    pack_result,
    row_of,
    unpack_result,
)
from ocp.errors import ProblemError, SolveError

Function = Callable[..., Any]
CACHE_SIZE = 8
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""Error numbers of a full or read-only disk, which do not depend on the task."""


class WorkerFailure(OSError):
    """Error raised when a worker fails for a reason other than its task, such as a full disk."""


# ---- one task ----------------------------------------------------------------------------------------------------

_LOCK = threading.RLock()
"""Lock that makes the threads of a worker take turns, because CasADi expressions are not thread-safe."""


def attempt(function: Function, task: str, with_guess: bool, guess: Payload | None) -> Payload:
    """Call a function with a task (JSON text) and, if `with_guess`, the result of a similar task as initial guess.
    Return its result, or the exception that it raised, as a `Payload`; raise WorkerFailure if the disk is full.
    """
    with _LOCK:
        began = time.perf_counter()
        _INPUTS.clear()
        try:
            arguments = [json.loads(task)]
            if with_guess:
                arguments.append(None if guess is None else unpack_result(guess))
            try:
                result = pack_result(function(*arguments))
            except BaseException as error:  # of any kind, so that the other tasks continue
                if isinstance(error, OSError) and error.errno in DISK_ERRORS:
                    raise
                result = failure_payload("failed", type(error).__name__, message_of(error))
            else:
                result = Payload({"status": "done", "error": "", "message": "", **result.record}, result.files)
        except OSError as error:
            raise WorkerFailure(error.errno, error.strerror or str(error), error.filename) from error
        timing = {"seconds": time.perf_counter() - began, "inputs": {"kept": dict(_INPUTS)}}
        return Payload({**result.record, **timing}, result.files)


def failure_payload(status: str, error: str, message: str) -> Payload:
    """Return the data to be stored for a task that ended without a result: its status and the error."""
    empty: dict[str, Any] = {"value": None, "files": [], "cost": None, "verdict": None, "seconds": 0.0}
    empty["inputs"] = {"kept": {}}
    return Payload({"status": status, "error": error, "message": message, **empty})


def message_of(error: BaseException) -> str:
    """Return the message of an exception, and the file and line of its origin unless this package raised it."""
    words = str(error).encode("utf-8", "replace").decode()
    if isinstance(error, DetailedError):
        return words
    steps = [step for step in traceback.extract_tb(error.__traceback__) if step.filename != __file__]
    location = f" ({os.path.basename(steps[-1].filename)}, line {steps[-1].lineno})" if steps else ""
    return f"{words}{location}".strip()


# ---- the cache of a worker -----------------------------------------------------------------------------------------

_CACHE: OrderedDict[tuple[Any, str], tuple[Any, dict[str, str | None]]] = OrderedDict()
_INPUTS: dict[str, str | None] = {}
"""Texts from which the `cached` objects of the current task were made, with the digests of the files they name."""


def cached(make: Function, *arguments: Any) -> Any:
    """Return ``make(*arguments)``, for example a robot read from a file; each worker computes the value only once.

    The cache holds eight objects. Arguments are data like tasks, and `make` must return the same for the same
    arguments. If an argument names a file, a failed task is repeated when the batch is started after the file has
    changed.

    Raises:
        ProblemError: `make` is not a function, an argument is not data, or `make` raises an exception that is not one
            of the package.
    """
    if not callable(make):
        raise ProblemError(f"make must be a function, not {make!r}", name="make", value=make)
    code = getattr(make, "__code__", make)  # Dask sends a script's function anew with each task
    identity = make if getattr(make, "__closure__", None) or getattr(make, "__defaults__", None) else code
    key = (getattr(make, "__qualname__", ""), identity), canonical_text(list(arguments), "arguments")
    with _LOCK:
        if key not in _CACHE:
            inputs = {argument: digest_of(argument) for argument in arguments if isinstance(argument, str)}
            _INPUTS.update(inputs)
            try:
                _CACHE[key] = make(*arguments), inputs
            except Exception as error:
                if isinstance(error, DetailedError) or getattr(error, "errno", None) in DISK_ERRORS:
                    raise
                call = f"{key[0][0]}({', '.join(map(repr, arguments))})"
                words = f"cached: {call} raised {type(error).__name__}: {message_of(error)}"
                raise ProblemError(words, name="make", value=key[0][0]) from error
        _CACHE.move_to_end(key)
        while len(_CACHE) > CACHE_SIZE:
            _CACHE.popitem(last=False)
        value, inputs = _CACHE[key]
        _INPUTS.update(inputs)
        return value


INSTALL = 'pip install "selfmotion[cluster]", or from a clone pip install ".[cluster]"'
SCHEMES = ("tcp", "tls", "ucx", "ws", "wss", "inproc")
"""Protocols with which the address of a Dask scheduler may begin."""
WORKER_NAME = "Dask Worker"
"""Prefix of the names of Dask's worker processes."""


@dataclass(frozen=True)
class EngineSettings:
    """Settings of the Dask workers.

    Attributes:
        deaths: Number of ended workers after which a task is given up.
        patience: Time after which a scheduler that does not answer is considered lost, s.
        recount, closing: Time between two counts of the workers, and to wait for ended workers at the end, s.
    """

    deaths: int = 3
    patience: float = 10.0
    recount: float = 2.0
    closing: float = 0.7


class Job(NamedTuple):
    """Task to run: key, JSON text, and the result of a similar task as initial guess (None if there is none)."""

    key: str
    task: str
    guess: Payload | None


class Outcome(NamedTuple):
    """Outcome of a job: key of its task, result (None: send the task again), and number of workers that it ended."""

    key: str
    payload: Payload | None
    deaths: int = 0


class Engine:
    """Context manager that runs jobs on the workers of a Dask cluster; on exit it cancels the jobs or ends the workers.

    Args:
        function: Function that Dask sends to the workers: by name, or by code if it is defined in the script.
        near: Whether the function also takes the result of a similar task.
        cluster: Number of processes to start, or a cluster as returned by :func:`checked_cluster`.
        settings: Settings of the workers.

    Raises:
        ProblemError: Dask is not installed, no worker starts, or a worker cannot load the function.
        SolveError: The scheduler is lost.
        WorkerFailure: The disk of a worker is full.
    """

    def __init__(
        self, function: Function, *, near: bool, cluster: Any, settings: EngineSettings = EngineSettings()
    ) -> None:
        try:
            import distributed
        except ImportError as error:
            raise ProblemError(f"run_batch: Dask is not installed; {INSTALL}", name="cluster", value=cluster) from error
        self._dask: Any = distributed
        self._function, self._near, self._cluster = function, near, cluster
        self.settings = settings
        self._lost = (distributed.CancelledError, TimeoutError, self._dask.comm.CommClosedError)
        self._local_cluster: Any = None
        self._client: Any = None
        self._foreign_processes = set(multiprocessing.active_children())
        self._configuration = ExitStack()
        self._finished: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._running: dict[int, tuple[Any, Job]] = {}
        self._name, self._count = secrets.token_hex(4), 0
        self._threads, self._counted, self._heard = 0, -settings.recount, time.monotonic()

    def __enter__(self) -> Engine:
        if not isinstance(self._cluster, int | str):
            self._client = self._cluster
            return self
        try:
            address = self._begin() if isinstance(self._cluster, int) else self._cluster
            self._client = self._dask.Client(address, timeout=self.settings.patience, set_as_default=False)
        except (OSError, ValueError) as error:
            words = f"cluster: no scheduler answers at {self._cluster}: {error}"
            raise ProblemError(words, name="cluster", value=self._cluster) from error
        return self

    def _begin(self) -> Any:
        """Start workers on this machine and return their cluster."""
        import dask

        configuration: dict[str, Any] = {
            "distributed.scheduler.allowed-failures": 0,
            "distributed.scheduler.worker-ttl": None,  # a long call of CasADi silences a worker
            "distributed.deploy.lost-worker-timeout": "1000 days",  # an ended worker restarts at any time
            "distributed.scheduler.http.routes": [],  # HTTP pages have no authentication
            "distributed.worker.http.routes": [],
        }
        try:
            security = self._dask.security.Security.temporary()
            self._configuration.enter_context(dask.config.set(configuration))
            self._local_cluster = self._dask.LocalCluster(
                n_workers=0,  # scaled below: an interrupt here would leave workers behind
                threads_per_worker=1,
                host="127.0.0.1",
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                security=security,
            )
            self._local_cluster.scale(self._cluster)
            self._local_cluster.sync(lambda: self._local_cluster)  # waits for the cluster and its workers
            if any(nanny.status != self._dask.Status.running for nanny in self._local_cluster.workers.values()):
                raise RuntimeError("they ended immediately")
        except ImportError as error:
            words = f"run_batch: {error}; {INSTALL}"
            raise ProblemError(words, name="cluster", value=self._cluster) from error
        except RuntimeError as error:
            self.__exit__()
            words = f"workers: none can be started: {error}; see their output"
            raise ProblemError(words, name="cluster", value=self._cluster) from error
        except BaseException:  # Ctrl-C
            self.__exit__()
            raise
        return self._local_cluster

    def __exit__(self, *_: object) -> None:
        end = time.monotonic() + self.settings.closing
        if self._local_cluster is not None:
            self._kill_workers()
        elif self._client is not None:
            with suppress(Exception):  # the scheduler may be lost
                self._client.cancel([future for future, _ in self._running.values()], force=True)
        self._running = {}
        for each in (self._client if self._client is not self._cluster else None, self._local_cluster):
            if each is not None:
                with suppress(Exception):  # a late answer is ignored
                    each.close(timeout=max(0.0, end - time.monotonic()))
        if self._local_cluster is not None and self._local_cluster.status != self._dask.Status.closed:
            self._local_cluster.loop.add_callback(self._local_cluster.loop.stop)
            self._local_cluster.status = self._dask.Status.closed  # otherwise Dask waits again at the exit of Python
            self._kill_workers()  # those that were starting
        self._configuration.close()

    def _kill_workers(self) -> None:
        """Kill the workers that this engine started."""
        for nanny in self._local_cluster.workers.values():
            nanny.auto_restart = False
        for process in set(multiprocessing.active_children()) - self._foreign_processes:
            if process.name.startswith(WORKER_NAME):  # others may have been started by the caller
                process.kill()

    @property
    def is_idle(self) -> bool:
        """Whether no worker is running a job of the batch."""
        return not self._running

    def free_slots(self) -> int:
        """Return the number of idle threads of all workers, which is the number of jobs that can be sent now.

        No more are sent, because a worker that ends loses all its jobs, running or not.
        """
        if self._client.status != "running":
            return 0
        now = time.monotonic()
        if now - self._counted > self.settings.recount:
            self._counted = now
            with suppress(*self._lost):
                self._threads = sum(self._client.nthreads().values())
        return max(0, self._threads - len(self._running))

    def submit(self, job: Job) -> None:
        """Send a job to a worker."""
        self._count += 1
        number, key = self._count, f"{self._function.__name__}-{job.key}-{self._name}-{self._count}"
        future = self._client.submit(attempt, self._function, job.task, self._near, job.guess, key=key, pure=False)
        self._running[number] = future, job
        future.add_done_callback(lambda _: self._finished.put(number))

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait until a job finishes, at most ``seconds``, and return the outcomes of all jobs that have finished."""
        self._check_scheduler()
        numbers = []
        with suppress(queue.Empty):
            numbers.append(self._finished.get(timeout=seconds))
            while True:
                numbers.append(self._finished.get_nowait())
        return [self._outcome(*self._running.pop(number)) for number in numbers if number in self._running]

    def _outcome(self, future: Any, job: Job) -> Outcome:
        """Return the outcome of a job that has finished."""
        try:
            return Outcome(job.key, Payload(*future.result(timeout=self.settings.patience)))
        except WorkerFailure:
            raise
        except self._dask.KilledWorker as error:
            return Outcome(job.key, None, error.allowed_failures + 1)
        except self._lost:  # the result was lost with its worker or with the scheduler
            return Outcome(job.key, None)
        except Exception as error:  # the function's exceptions are in the payload, so it cannot be loaded
            module, reason = self._function.__module__, str(error.__cause__ or error).partition("\n")[0]
            words = (
                f"function: a worker cannot load it: {type(error).__name__}: {reason} (this package and {module} must "
                "be installed there; Client.upload_file sends a single file)"
            )
            raise ProblemError(words, name="function", value=self._function.__name__) from error

    def _check_scheduler(self) -> None:
        """Raise SolveError if the scheduler is lost."""
        now = time.monotonic()
        if self._client.status == "running":
            self._heard = now
        elif now - self._heard > self.settings.patience or self._client.status == "closed":
            words = "cluster: the scheduler is lost; finished results are stored, run again with a cluster that answers"
            raise SolveError(words, name="cluster", value=str(self._cluster))


def checked_cluster(cluster: Any) -> Any:
    """Return `cluster` if it is the address of a Dask scheduler or a `distributed.Client`; else raise ProblemError."""
    dask = sys.modules.get("distributed")
    if dask is not None and isinstance(cluster, dask.Client):
        return cluster
    if isinstance(cluster, str) and cluster.partition("://")[0] in SCHEMES and cluster.partition("://")[2]:
        return cluster
    words = "cluster must be a number of processes, the address of a scheduler such as tcp://host:8786, or a Client, "
    raise ProblemError(f"{words}not {cluster!r}", name="cluster", value=cluster)


# ---- the tasks of a batch ------------------------------------------------------------------------------------------


class PendingTasks:
    """The tasks of a batch that have no result yet."""

    def __init__(
        self,
        store: ResultStore,
        texts: dict[str, str],
        parents: dict[str, str | None],
        *,
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
        """Queue a task whose worker ended, to run it alone; store it as killed if it has ended too many workers."""
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
                engine.submit(self._job(self.isolated))
                return
        for _ in range(min(engine.free_slots(), len(self.ready))):
            engine.submit(self._job(self.ready.popleft()))

    def _job(self, key: str) -> Job:
        """Return the job of a task, with the result of a similar task as its initial guess if there is one."""
        parent = self._neighbour(key)
        record = None if parent is None else self.store.read(parent)
        return Job(key, self.texts[key], None if record is None else self.store.payload(record))

    def _neighbour(self, key: str) -> str | None:
        """Return the key of the nearest predecessor, in a task's chain of similar tasks, that succeeded, or None."""
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
