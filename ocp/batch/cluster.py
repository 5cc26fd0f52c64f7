"""Workers of a Dask cluster. Results come back to the driver, so no folder has to be seen by all machines."""

from __future__ import annotations

import queue
import secrets
import sys
import time
from contextlib import suppress
from typing import Any

from ocp.batch.content import Parcel
from ocp.batch.processes import Job, Outcome
from ocp.batch.worker import Broken, Function, attempt
from ocp.errors import ProblemError, SolveError

__all__ = ["Cluster", "checked_cluster"]

PATIENCE = 10.0
"""s after which a scheduler that does not answer is gone."""
COUNTED = 2.0
"""s between two looks at how many workers there are."""
SCHEMES = ("tcp", "tls", "ucx", "ws", "wss", "inproc")
"""Of a scheduler's address."""


class Cluster:
    """A client of a cluster, and what it is at; a context, at whose end the cluster has nothing of ours to do.

    Args:
        cluster: As :func:`checked_cluster` gives it.
        function: Dask carries it to the workers: by its name, or a script's own by its code.

    Raises:
        ProblemError: Dask is not installed, cluster is none, or a worker cannot load the function.
        SolveError: The scheduler is gone.
        Broken: A worker's disk is full.
    """

    def __init__(self, cluster: Any, function: Function) -> None:
        try:
            import distributed
        except ImportError as error:
            words = "cluster: Dask is not installed; pip install 'selfmotion[cluster]'"
            raise ProblemError(words, name="cluster", value=cluster) from error
        self._dask: Any = distributed
        self._function = function
        self._given = not isinstance(cluster, str)
        self._cluster = cluster
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._futures: dict[str, Any] = {}
        self._name, self._count = secrets.token_hex(4), 0
        self._lost = (distributed.CancelledError, TimeoutError, self._dask.comm.CommClosedError)
        self._threads, self._counted = 0, -COUNTED
        self._heard = time.monotonic()

    def __enter__(self) -> Cluster:
        if self._given:
            self._client = self._cluster
        else:
            try:
                self._client = self._dask.Client(self._cluster, timeout=PATIENCE, set_as_default=False)
            except (OSError, ValueError) as error:
                words = f"cluster: no scheduler answers at {self._cluster}: {error}"
                raise ProblemError(words, name="cluster", value=self._cluster) from error
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # the cluster may be gone, in whatever way
            self._client.cancel(list(self._futures.values()), force=True)
        self._futures = {}
        if not self._given:
            with suppress(Exception):
                self._client.close(timeout=2.0)

    def room(self) -> int:
        """How many jobs can be taken now: one for each thread of the workers.

        No more: of a worker that ends Dask holds everything against the tasks that it had, begun or not.
        """
        if self._client.status != "running":
            return 0
        now = time.monotonic()
        if now - self._counted > COUNTED:
            self._counted = now
            with suppress(*self._lost):
                self._threads = sum(self._client.nthreads().values())
        return max(0, self._threads - len(self._futures))

    def submit(self, job: Job) -> None:
        """Begin a job."""
        self._count += 1
        future = self._client.submit(
            attempt,
            self._function,
            job.task,
            job.near,
            job.guess,
            key=f"{self._function.__name__}-{job.key}-{self._name}-{self._count}",
            pure=False,
        )
        self._futures[job.key] = future
        future.add_done_callback(lambda _, key=job.key: self._ended.put(key))

    def wait(self, seconds: float, wanted: int) -> list[Outcome]:
        """What came to its end within so many seconds, no longer than until something did."""
        self._check_scheduler()
        keys = []
        with suppress(queue.Empty):
            keys.append(self._ended.get(timeout=seconds))
            while True:
                keys.append(self._ended.get_nowait())
        ended = {key: self._futures.pop(key) for key in keys if key in self._futures}
        return [self._outcome(key, future) for key, future in ended.items()]

    def _outcome(self, key: str, future: Any) -> Outcome:
        try:
            parcel = future.result(timeout=PATIENCE)
        except Broken:
            raise
        except self._dask.KilledWorker as error:
            return Outcome(key, None, f"Dask says: {error}".partition("\n")[0], deaths=3)
        except self._lost:  # with its worker or the scheduler
            return Outcome(key, None, "the cluster lost it", deaths=0)
        except Exception as error:  # the function's own errors are in the parcel: it cannot be loaded
            module, why = self._function.__module__, str(error.__cause__ or error).partition("\n")[0]
            words = (
                f"function: a worker of the cluster cannot load it: {type(error).__name__}: {why} (this package and "
            )
            words += f"{module} have to be installed there; Client.upload_file brings a single file)"
            raise ProblemError(words, name="function", value=self._function.__name__) from error
        return Outcome(key, Parcel(*parcel))

    def _check_scheduler(self) -> None:
        now = time.monotonic()
        if self._client.status == "running":
            self._heard = now
        elif now - self._heard > PATIENCE or self._client.status == "closed":
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
