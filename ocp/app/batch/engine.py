"""Dask does the tasks: a cluster of this machine's cores, begun and ended here, or one that is given.

Results come back to the driver, so no folder has to be seen by all machines. The cluster that is begun here speaks TLS
with a certificate that is made for it alone: no other user of the machine can send it work or read results.

What a worker does: call the function with one task after the other, and tell what came of each.
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
from collections import OrderedDict
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from models.errors import ModelError
from ocp.app.batch.content import Parcel, digest_of, packed, text_of, unpacked
from ocp.errors import DetailedError, ProblemError, SolveError

__all__ = [
    "Broken",
    "Engine",
    "EngineSettings",
    "Function",
    "Job",
    "Outcome",
    "attempt",
    "attempts",
    "checked_cluster",
    "failed",
    "kept",
]

Function = Callable[..., Any]
MOST_KEPT = 8
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""What is wrong with a machine, and says nothing of the task that met it."""


class Broken(OSError):
    """A task came to no end for a reason that is not its own: a disk is full."""


# ---- one task ----------------------------------------------------------------------------------------------------

_ONE = threading.RLock()
"""Threads of one worker, as Dask may have, take turns: casadi's expressions are not made by two at a time."""


def attempts(function: Function, jobs: list[tuple[str, Parcel | None]], near: bool, most: float) -> list[Parcel]:
    """:func:`attempt` of one task after the other, each with its neighbour's result; as many as begin in ``most`` s."""
    began, found = time.perf_counter(), list[Parcel]()
    for task, guess in jobs:
        found.append(attempt(function, task, near, guess))
        if time.perf_counter() - began > most:
            break
    return found


def attempt(function: Function, task: str, near: bool, guess: Parcel | None) -> Parcel:
    """Call the function with a task, by its text, and with its neighbour's result where results are `near`.

    Returns:
        The result, or of whatever the function raises its name and its message.

    Raises:
        Broken: There is no room on the disk.
    """
    with _ONE:
        began = time.perf_counter()
        _INPUTS.clear()
        try:
            given = (json.loads(task), None if guess is None else unpacked(guess)) if near else (json.loads(task),)
            try:
                found = packed(function(*given))
            except BaseException as error:  # of any kind: the others go on
                if isinstance(error, OSError) and error.errno in FULL:
                    raise
                found = failed("failed", type(error).__name__, message_of(error))
            else:
                found = Parcel({"status": "done", "error": "", "message": "", **found.record}, found.files)
        except OSError as error:
            raise Broken(error.errno, error.strerror or str(error), error.filename) from error
        told = {"seconds": time.perf_counter() - began, "inputs": {"kept": dict(_INPUTS)}}
        return Parcel({**found.record, **told}, found.files)


def failed(status: str, error: str, message: str) -> Parcel:
    """The record of a task without a result."""
    empty: dict[str, Any] = {"value": None, "files": [], "cost": None, "verdict": None, "seconds": 0.0}
    empty["inputs"] = {"kept": {}}
    return Parcel({"status": status, "error": error, "message": message, **empty})


def message_of(error: BaseException) -> str:
    """Its message; of what is no error of the package, which may be a mistake in the function, with its place."""
    words = str(error).encode("utf-8", "replace").decode()
    if isinstance(error, DetailedError | ModelError):
        return words
    steps = [step for step in traceback.extract_tb(error.__traceback__) if step.filename != __file__]
    place = f" ({os.path.basename(steps[-1].filename)}, line {steps[-1].lineno})" if steps else ""
    return f"{words}{place}".strip()


# ---- what a worker keeps -----------------------------------------------------------------------------------------

_KEPT: OrderedDict[tuple[Any, str], tuple[Any, dict[str, str | None]]] = OrderedDict()
_INPUTS: dict[str, str | None] = {}
"""Of the task that is at hand: what was kept for it is made of, texts that may name files with the files' digests."""


def kept(make: Function, *arguments: Any) -> Any:
    """``make(*arguments)``, made once in each worker and kept: a prepared problem, a robot that is read from a file.

    The last eight are kept. Arguments are data as tasks are, and what is made is the same for the same content. Where
    an argument names a file, a task that fails is tried again when the batch is started with another content of it.

    Raises:
        ProblemError: make is no function, an argument no data, or make raises an error that is none of the package.
    """
    if not callable(make):
        raise ProblemError(f"make must be a function, not {make!r}", name="make", value=make)
    code = getattr(make, "__code__", make)  # Dask brings a script's own function anew with each task
    own = make if getattr(make, "__closure__", None) or getattr(make, "__defaults__", None) else code
    key = (getattr(make, "__qualname__", ""), own), text_of(list(arguments), "arguments")
    with _ONE:
        if key not in _KEPT:
            inputs = {argument: digest_of(argument) for argument in arguments if isinstance(argument, str)}
            _INPUTS.update(inputs)
            try:
                _KEPT[key] = make(*arguments), inputs
            except Exception as error:
                if isinstance(error, DetailedError | ModelError) or getattr(error, "errno", None) in FULL:
                    raise
                call = f"{key[0][0]}({', '.join(map(repr, arguments))})"
                words = f"kept: {call} raised {type(error).__name__}: {message_of(error)}"
                raise ProblemError(words, name="make", value=key[0][0]) from error
        _KEPT.move_to_end(key)
        while len(_KEPT) > MOST_KEPT:
            _KEPT.popitem(last=False)
        made, inputs = _KEPT[key]
        _INPUTS.update(inputs)
        return made


INSTALL = 'pip install "selfmotion[cluster]", or from a clone pip install ".[cluster]"'
SCHEMES = ("tcp", "tls", "ucx", "ws", "wss", "inproc")
"""Of a scheduler's address."""
WORKER_NAME = "Dask Worker"
"""With which Dask begins the names of the processes of its workers."""


@dataclass(frozen=True)
class EngineSettings:
    """How Dask is used.

    Attributes:
        deaths: Workers that one task may end before it is set aside.
        chunk: Work that is sent at a time, s: Dask takes some ms for what it sends, so short tasks go together.
        patience: After so many s a scheduler that does not answer is gone.
        recount: s between two counts of the workers.
        closing: At the end of a batch, s to wait at most for what was killed to be gone.
    """

    deaths: int = 3
    chunk: float = 0.05
    patience: float = 10.0
    recount: float = 2.0
    closing: float = 0.7


class Job(NamedTuple):
    """A task to be done: its key, its text, and a neighbour's result."""

    key: str
    task: str
    guess: Parcel | None


class Outcome(NamedTuple):
    """What came of a task: a parcel, or None where it has to be sent again.

    ``deaths``: How many workers ended that had it, because of it or of another task.
    """

    key: str
    parcel: Parcel | None
    deaths: int = 0


class Engine:
    """Workers of a Dask cluster; a context, at whose end they have nothing of ours to do, or are gone.

    Args:
        function: Dask carries it to the workers: by its name, or a script's own by its code.
        near: Whether it takes a neighbour's result.
        workers: How many processes are begun on this machine, where no cluster is given.
        cluster: As :func:`checked_cluster` gives it, or None.

    Raises:
        ProblemError: Dask is not installed, no worker begins, or a worker cannot load the function.
        SolveError: The scheduler is gone.
        Broken: A worker's disk is full.
    """

    def __init__(
        self, function: Function, near: bool, workers: int, cluster: Any, settings: EngineSettings = EngineSettings()
    ) -> None:
        try:
            import distributed
        except ImportError as error:
            words = f"run_batch: Dask is not installed; {INSTALL}"
            raise ProblemError(words, name="cluster", value=cluster) from error
        self._dask: Any = distributed
        self._function, self._near, self._workers, self._cluster = function, near, workers, cluster
        self.settings = settings
        self._lost = (distributed.CancelledError, TimeoutError, self._dask.comm.CommClosedError)
        self._own: Any = None
        self._client: Any = None
        self._others = set(multiprocessing.active_children())
        self._rules = ExitStack()
        self._ended: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._sent: dict[int, tuple[Any, list[Job]]] = {}
        self._name, self._count = secrets.token_hex(4), 0
        self._threads, self._counted, self._heard = 0, -settings.recount, time.monotonic()
        self._pace = settings.chunk  # s that a task takes
        self._most = 1  # tasks sent at a time

    def __enter__(self) -> Engine:
        if self._cluster is not None and not isinstance(self._cluster, str):
            self._client = self._cluster
            return self
        try:
            address = self._begin() if self._cluster is None else self._cluster
            patience = self.settings.patience
            self._client = self._dask.Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:
            words = f"cluster: no scheduler answers at {self._cluster}: {error}"
            raise ProblemError(words, name="cluster", value=self._cluster) from error
        return self

    def _begin(self) -> Any:
        """Begin workers on this machine."""
        import dask

        rules: dict[str, Any] = {
            "distributed.scheduler.allowed-failures": 0,
            "distributed.scheduler.worker-ttl": None,  # one call of CasADi may keep a worker silent for long
            "distributed.deploy.lost-worker-timeout": "1000 days",  # a worker that ended begins again, however late
            "distributed.scheduler.http.routes": [],  # pages over HTTP ask nobody who he is
            "distributed.worker.http.routes": [],
        }
        try:
            security = self._dask.security.Security.temporary()
            self._rules.enter_context(dask.config.set(rules))
            self._own = self._dask.LocalCluster(
                n_workers=0,  # those that an interrupt finds half begun would be out of reach
                threads_per_worker=1,
                host="127.0.0.1",
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                security=security,
            )
            self._own.scale(self._workers)
            self._own.sync(lambda: self._own)  # awaits it, with its workers
            if any(nanny.status != self._dask.Status.running for nanny in self._own.workers.values()):
                raise RuntimeError("they ended at once")
        except ImportError as error:
            words = f"run_batch: {error}; {INSTALL}"
            raise ProblemError(words, name="workers", value=self._workers) from error
        except RuntimeError as error:
            self.__exit__()
            words = f"workers: none can be started: {error}; what they wrote says more"
            raise ProblemError(words, name="workers", value=self._workers) from error
        except BaseException:  # Ctrl-C
            self.__exit__()
            raise
        return self._own

    def __exit__(self, *_: object) -> None:
        end = time.monotonic() + self.settings.closing
        if self._own is not None:
            self._kill_workers()
        elif self._client is not None:
            with suppress(Exception):  # the scheduler may be gone, in whatever way
                self._client.cancel([future for future, _ in self._sent.values()], force=True)
        self._sent = {}
        for each in (self._client if self._client is not self._cluster else None, self._own):
            if each is not None:
                with suppress(Exception):  # what is late is left behind
                    each.close(timeout=max(0.0, end - time.monotonic()))
        if self._own is not None and self._own.status != self._dask.Status.closed:
            self._own.loop.add_callback(self._own.loop.stop)
            self._own.status = self._dask.Status.closed  # else Dask waits once more when Python ends
            self._kill_workers()  # that were about to begin
        self._rules.close()

    def _kill_workers(self) -> None:
        """End the workers begun here at once, whatever they are at."""
        for nanny in self._own.workers.values():
            nanny.auto_restart = False
        for process in set(multiprocessing.active_children()) - self._others:
            if process.name.startswith(WORKER_NAME):  # what else the caller has begun meanwhile is not ours
                process.kill()

    @property
    def is_idle(self) -> bool:
        """Whether nothing is sent that has not come to its end."""
        return not self._sent

    def room(self) -> int:
        """How many chunks of jobs may be sent now: one for each thread of the workers that has none.

        No more: a worker that ends takes with it what it had, begun or not.
        """
        if self._client.status != "running":
            return 0
        now = time.monotonic()
        if now - self._counted > self.settings.recount:
            self._counted = now
            with suppress(*self._lost):
                self._threads = sum(self._client.nthreads().values())
        return max(0, self._threads - len(self._sent))

    def share(self, ready: int) -> int:
        """How many of the jobs that are ready are sent together, so that each thread gets several times some."""
        return max(1, min(self._most, ready // (4 * max(1, self._threads))))

    def submit(self, jobs: list[Job]) -> None:
        """Begin jobs, one after the other on one worker."""
        self._count += 1
        number = self._count
        future = self._client.submit(
            attempts,
            self._function,
            [(job.task, job.guess) for job in jobs],
            self._near,
            self.settings.chunk,
            key=f"{self._function.__name__}-{jobs[0].key}-{self._name}-{number}",
            pure=False,
        )
        self._sent[number] = future, jobs
        future.add_done_callback(lambda _: self._ended.put(number))

    def wait(self, seconds: float) -> list[Outcome]:
        """What came to its end within so many seconds, no longer than until something did."""
        self._check_scheduler()
        numbers = []
        with suppress(queue.Empty):
            numbers.append(self._ended.get(timeout=seconds))
            while True:
                numbers.append(self._ended.get_nowait())
        ended = [self._sent.pop(number) for number in numbers if number in self._sent]
        return [outcome for future, jobs in ended for outcome in self._outcomes(future, jobs)]

    def _outcomes(self, future: Any, jobs: list[Job]) -> list[Outcome]:
        try:
            parcels = [Parcel(*each) for each in future.result(timeout=self.settings.patience)]
        except Broken:
            raise
        except self._dask.KilledWorker as error:
            self._most = 1
            return [Outcome(job.key, None, error.allowed_failures + 1) for job in jobs]
        except self._lost:  # with its worker or the scheduler
            return [Outcome(job.key, None) for job in jobs]
        except Exception as error:  # the function's own errors are in the parcel: it cannot be loaded
            module, why = self._function.__module__, str(error.__cause__ or error).partition("\n")[0]
            words = (
                f"function: a worker cannot load it: {type(error).__name__}: {why} (this package and {module} have to "
                "be installed there; Client.upload_file brings a single file)"
            )
            raise ProblemError(words, name="function", value=self._function.__name__) from error
        seconds = sum(parcel.record["seconds"] for parcel in parcels) / len(parcels)
        self._pace += (seconds - self._pace) / 4
        self._most = max(1, min(2 * self._most, int(self.settings.chunk / max(self._pace, 1e-6))))
        done = [Outcome(job.key, parcel) for job, parcel in zip(jobs, parcels, strict=False)]
        return done + [Outcome(job.key, None) for job in jobs[len(parcels) :]]  # there was no time for them

    def _check_scheduler(self) -> None:
        now = time.monotonic()
        if self._client.status == "running":
            self._heard = now
        elif now - self._heard > self.settings.patience or self._client.status == "closed":
            words = "cluster: the scheduler is gone; what is done is kept, run again with a cluster that answers"
            raise SolveError(words, name="cluster", value=str(self._cluster))


def checked_cluster(cluster: Any) -> Any:
    """The address of a scheduler, or a `distributed.Client`, which stays open when we are done.

    Raises:
        ProblemError: It is neither.
    """
    dask = sys.modules.get("distributed")
    if dask is not None and isinstance(cluster, dask.Client):
        return cluster
    if isinstance(cluster, str) and cluster.partition("://")[0] in SCHEMES and cluster.partition("://")[2]:
        return cluster
    words = f"cluster must be the address of a scheduler such as tcp://host:8786, or a Client, not {cluster!r}"
    raise ProblemError(words, name="cluster", value=cluster)
