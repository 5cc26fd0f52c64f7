"""Workers that are processes of this machine; one that ends is replaced."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from ocp.batch.content import Parcel
from ocp.batch.worker import REQUEST, UNKNOWN, Broken, receive, send
from ocp.errors import ProblemError

__all__ = ["Job", "Outcome", "Processes", "Source"]

START = """import json, sys
control, life, path, *source = json.loads(sys.argv[1])
sys.path[:] = path
from ocp.batch.worker import serve
serve(control, life, *source)
"""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""One each, unless the environment says another number: workers fill the machine, and last digits stay the same."""
FALSE_STARTS = 10
"""In a row, after which no worker is started any more."""


class Source(NamedTuple):
    """Where a function is: a module and a name in it, and the file, if the module is a script that was started."""

    module: str
    name: str
    file: str | None


class Job(NamedTuple):
    """A task to be done.

    Attributes:
        key: Of the task. task: Its text. near: Whether the function takes a neighbour's result. guess: That.
    """

    key: str
    task: str
    near: bool
    guess: Parcel | None


class Outcome(NamedTuple):
    """What came of a task: a parcel, or None where its worker ended, and why it did.

    Attributes:
        deaths: Of workers that this says.
    """

    key: str
    parcel: Parcel | None
    why: str = ""
    deaths: int = 1


class Gone(Exception):
    """The process that forks workers has ended."""


class ForkServer:
    """A process that has the function loaded, and forks workers: they are there at once, and share what is loaded.

    Raises:
        ProblemError: It cannot load the function. Gone: It has ended.
    """

    def __init__(self, source: Source, life: int) -> None:
        self._control, theirs = socket.socketpair()
        with theirs:
            told = json.dumps([theirs.fileno(), life, sys.path, *source])
            self.process = subprocess.Popen(
                [sys.executable, "-c", START, told],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), life),
                env={**dict.fromkeys(THREADS, "1"), **os.environ},
                start_new_session=True,  # Ctrl-C is the driver's
            )
        self._answers = self._control.makefile("rb")
        self._source, self._loaded = source, False

    def worker(self) -> Worker:
        """A new worker."""
        if not self._loaded:
            wrong = self._answer()
            if wrong:
                words = f"function: a worker cannot load {self._source.module}.{self._source.name}: {wrong}"
                raise ProblemError(words, name="function", value=self._source.name)
            self._loaded = True
        ours, theirs = Pipe()
        with theirs:
            return Worker(ours, int(self._ask(b"w", 0, [theirs.fileno()])))

    def status(self, worker: int) -> int:
        """How a worker ended that was killed: its status, minus the signal, or UNKNOWN."""
        try:
            return int(self._ask(b"s", worker, []))
        except Gone:
            return UNKNOWN

    def end(self) -> str:
        """End it at once; how it ended."""
        self.process.kill()
        status = self.process.wait()
        self._answers.close()
        self._control.close()
        return ending(status)

    def _ask(self, kind: bytes, worker: int, pipes: list[int]) -> Any:
        try:
            socket.send_fds(self._control, [REQUEST.pack(kind, worker)], pipes)
        except OSError as error:
            raise Gone from error
        return self._answer()

    def _answer(self) -> Any:
        try:
            line = self._answers.readline()
        except OSError as error:
            raise Gone from error
        if not line:
            raise Gone
        return json.loads(line)


@dataclass
class Worker:
    """A process at the other end of a pipe, its number, and what it is at."""

    connection: Connection
    process: int
    job: Job | None = None


class Processes:
    """A number of workers; a context, at whose end there are none.

    Raises:
        ProblemError: No worker can be started, or find the function.
        Broken: A worker's disk is full.
    """

    def __init__(self, source: Source, count: int) -> None:
        self.source, self.count = source, count
        self._ours, self._life = -1, -1
        self._server: ForkServer | None = None
        self._workers: list[Worker] = []
        self._false_starts = 0

    def __enter__(self) -> Processes:
        self._life, self._ours = os.pipe()
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._ours)  # a worker that nobody knows of ends by this
        for worker in self._workers:
            with suppress(OSError):
                self._end(worker)
        self._workers = []
        if self._server is not None:
            self._server.end()
        os.close(self._life)

    def room(self) -> int:
        """How many jobs can be taken now."""
        return sum(worker.job is None for worker in self._workers)

    def submit(self, job: Job) -> None:
        """Begin a job, where there is room."""
        worker = next(worker for worker in self._workers if worker.job is None)
        worker.job = job
        told = {"task": job.task, "near": job.near, "guess": None if job.guess is None else job.guess.record}
        with suppress(BrokenPipeError, ConnectionResetError):  # it is seen to be gone when it is waited for
            send(worker.connection, told, () if job.guess is None else job.guess.files)

    def wait(self, seconds: float, wanted: int) -> list[Outcome]:
        """What came to its end within so many seconds, no longer than until something did.

        Args:
            wanted: How many tasks are left, and so how many workers are of use.
        """
        while len(self._workers) < min(self.count, wanted):
            self._begin()
        heard = wait([worker.connection for worker in self._workers], seconds)
        return [
            outcome for worker in list(self._workers) if worker.connection in heard for outcome in self._hear(worker)
        ]

    def _begin(self) -> None:
        """Begin one more worker."""
        try:
            if self._server is None:
                self._server = ForkServer(self.source, self._life)
            self._workers.append(self._server.worker())
            self._false_starts = 0
        except Gone as error:
            why = "" if self._server is None else self._server.end()
            self._server = None
            self._false_starts += 1
            if self._false_starts >= FALSE_STARTS:
                words = f"{FALSE_STARTS} workers ended before they could begin: {why}; what they wrote says more"
                raise ProblemError(words, name="workers", value=self.count) from error

    def _hear(self, worker: Worker) -> list[Outcome]:
        try:
            parcel = receive(worker.connection)
        except (EOFError, OSError, ValueError):
            why = self._end(worker)
            self._workers.remove(worker)
            return [] if worker.job is None else [Outcome(worker.job.key, None, why)]
        if "broken" in parcel.record:
            raise Broken(*parcel.record["broken"])
        job, worker.job = worker.job, None
        return [] if job is None else [Outcome(job.key, parcel)]

    def _end(self, worker: Worker) -> str:
        """End a worker and what it has started, at once; how it ended."""
        for end, number in ((os.killpg, worker.process), (os.kill, worker.process)):
            with suppress(ProcessLookupError, PermissionError):
                end(number, signal.SIGKILL)
        worker.connection.close()
        return ending(UNKNOWN if self._server is None else self._server.status(worker.process))


def ending(status: int) -> str:
    """How a process ended, in words."""
    if status == UNKNOWN:
        return "it ended"
    if status >= 0:
        return f"it ended with status {status}"
    with suppress(ValueError):
        return f"it was ended by {signal.Signals(-status).name}"
    return f"it was ended by signal {-status}"
