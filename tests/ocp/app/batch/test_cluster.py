"""A Dask cluster does what processes do, and when its workers or its scheduler are killed nothing is lost."""

from __future__ import annotations

import multiprocessing
import signal
import socket
import ssl
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from distributed.security import Security

from ocp import ProblemError
from ocp.app.batch import run_batch
from ocp.app.batch.engine import Engine, EngineSettings
from tests.ocp.app.batch import functions
from tests.ocp.app.batch.drivers import check_killed_cluster, cluster


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # of Dask's own, at its end
def test_a_cluster_equals_processes_and_loses_no_result_when_it_is_killed(
    tmp_path: Path, here: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Engine.__init__, "__defaults__", (EngineSettings(patience=2.0),))
    tasks = [{"mass": float(mass)} for mass in range(1, 7)]
    own = run_batch(functions.warm, tasks, tmp_path / "own", cluster=here, near=["mass"])
    with cluster(2) as (address, processes):
        far = run_batch(functions.warm, tasks, tmp_path / "far", cluster=address, near=["mass"])
        with Client(address, set_as_default=False) as client:
            shown: Any = {"cluster": client, "failures": "return"}
            ends = run_batch(functions.endings, ["problem", "nan", "good"], tmp_path / "ends", **shown)
            assert client.status == "running"
            log = tmp_path / "deadly"
            killed = [{"x": i, "kill": i == 1, "log": str(log)} for i in range(3)]
            dead = run_batch(functions.deadly, killed, tmp_path / "dead", **shown)
        check_killed_cluster(tmp_path / "b", 30, 0.1, address, processes)
    for one, two in zip(own, far, strict=True):
        assert (one.key, one.cost, one.neighbour) == (two.key, two.cost, two.neighbour)
        assert two.value["plan"].cost == one.cost
    assert [(result.status, result.error) for result in ends] == [("failed", "ProblemError")] * 2 + [("done", "")]
    assert [result.status for result in dead] == ["done", "killed", "done"]
    assert dead[1].message in ("it ended 4 workers", "it ended 8 workers")  # alone, or among others and then alone
    assert len(log.read_text().split()) == 4
    with pytest.raises(ProblemError, match="no scheduler answers") as caught:
        run_batch(functions.square, [{"x": 1.0}], tmp_path / "b", cluster=address)
    assert caught.value.name == "cluster"


def reply_to(stranger: ssl.SSLContext | None, address: str) -> bytes:
    """What a server says first: one of Dask's greets whom it accepts."""
    host, port = address.rpartition("/")[2].split(":")
    with socket.create_connection((host, int(port))) as as_data:
        try:
            if stranger is not None:
                with stranger.wrap_socket(as_data) as wrapped:
                    return wrapped.recv(1)
            as_data.sendall(bytes(64))
            return as_data.recv(1)
        except OSError:
            return b""


def test_no_other_user_of_the_machine_reaches_the_workers_of_a_batch() -> None:
    """They have no certificate of this batch's, one of their own does not help, and no page answers without one."""
    with Engine(functions.square, near=False, cluster=1) as engine:
        own = engine._local_cluster
        (nanny,) = own.workers.values()
        nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        foreign: Any = Security.temporary().get_connection_args("client")["ssl_context"]
        friend: Any = own.security.get_connection_args("client")["ssl_context"]
        for context in (nobody, foreign):
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        for address in (own.scheduler_address, nanny.address, nanny.worker_address):
            assert address.startswith("tls://127.0.0.1:")
            assert reply_to(friend, address) != b""
            assert [reply_to(stranger, address) for stranger in (None, nobody, foreign)] == [b""] * 3
        for page in ("json/index.html", "info/main/workers.html", "health", "metrics"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://127.0.0.1:{own.scheduler.http_server.port}/{page}")
        assert engine._client.submit(pow, 3, 2).result(timeout=60) == 9


def test_processes_that_the_caller_began_meanwhile_outlive_the_workers() -> None:
    before = set(multiprocessing.active_children())
    with Engine(functions.square, near=False, cluster=1):
        mine = multiprocessing.get_context("spawn").Process(target=signal.pause)
        mine.start()
        workers = set(multiprocessing.active_children()) - before - {mine}
        assert workers
    try:
        for worker in workers:
            worker.join()
        assert mine.is_alive()
    finally:
        mine.kill()
        mine.join()
