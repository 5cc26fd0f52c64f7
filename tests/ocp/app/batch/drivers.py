"""Drivers and workers as processes, and what disturbs them."""

from __future__ import annotations

import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ocp import SolveError
from ocp.app.batch import run_batch
from tests.ocp.app.batch import functions

ROOT = Path(__file__).resolve().parents[4]


def driver(folder: Path, tasks: list[Any], workers: int = 2, **options: Any) -> subprocess.Popen[str]:
    """A process that runs a batch of `square`."""
    request = json.dumps({"folder": str(folder), "tasks": tasks, "workers": workers})
    return subprocess.Popen(
        [sys.executable, "-m", "tests.ocp.app.batch.functions", request],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def children_of(process: int) -> list[int]:
    """Processes that a process has started and that run."""
    completed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True, check=False
    )
    return [int(word) for word in completed.stdout.split()]


def workers_of(process: int) -> list[int]:
    """The workers of a driver: Python processes that multiprocessing has begun."""
    request = ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(process)]
    completed = subprocess.run(request, capture_output=True, text=True, check=False)
    return [int(line.split()[0]) for line in completed.stdout.splitlines() if "multiprocessing-fork" in line]


def runs(process: int) -> bool:
    """Whether a process is there and no zombie."""
    completed = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True, check=False)
    return completed.stdout.strip()[:1] not in ("", "Z")


def kill(process: int) -> None:
    """End a process at once, if it is there."""
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return


def until(holds: Callable[[], Any], seconds: float = 600.0) -> None:
    """Wait until something holds; after minutes it never will."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.02)


def count(folder: Path) -> int:
    """Records in a folder."""
    return sum(1 for _ in (folder / "results").glob("*/*.json")) if folder.exists() else 0


def stored(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Every record by its name: the number of its file, which no other has while it is there, and its text."""
    return {path.name: (path.stat().st_ino, path.read_bytes()) for path in (folder / "results").glob("*/*.json")}


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, dict[str, list[int]]]]:
    """The address of a Dask cluster of processes, and their numbers: of the scheduler, and of workers and nannies."""
    own = {**os.environ, "PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__ADMIN__LOG_FORMAT": "", "OMP_NUM_THREADS": "1"}
    begun: list[subprocess.Popen[bytes]] = []

    def start(*words: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
            cwd=ROOT,
            env=own,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        begun.append(process)
        return process

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        try:
            options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show")
            scheduler = start("dask_scheduler", *options, "--scheduler-file", str(file))
            until(file.exists)
            until(lambda: file.read_text().strip().endswith("}"))
            address = json.loads(file.read_text())["address"]
            alone = ("--nthreads", "1", "--no-dashboard", "--local-directory", folder)
            nannies = [start("dask_worker", address, *alone) for _ in range(workers)]
            until(lambda: all(children_of(nanny.pid) for nanny in nannies))
            matches = [children_of(nanny.pid)[-1] for nanny in nannies]
            yield address, {"scheduler": [scheduler.pid], "workers": matches}
        finally:
            for process in begun:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()


# ---- laws that hold whatever is disturbed ----------------------------------------------------------------------


def grown(folder: Path, before: int, most: int) -> bool:
    return count(folder) > before or count(folder) == most


def none_runs(processes: list[int]) -> bool:
    return not any(runs(process) for process in processes)


def disturbed(folder: Path, tasks: list[Any], every: int, drivers: tuple[int, ...]) -> tuple[int, int]:
    """Run a batch while after so many records each a worker is killed, and the driver when so many records are there.

    Returns:
        Workers and drivers that were killed.
    """
    chance = random.Random(1)
    killed = ended = last = 0
    process = driver(folder, tasks)
    while process.poll() is None:
        time.sleep(0.02)
        if ended < len(drivers) and count(folder) >= drivers[ended]:
            workers = workers_of(process.pid)
            kill(process.pid)
            process.communicate()
            ended += 1
            until(partial(none_runs, workers))
            before = stored(folder)
            process = driver(folder, tasks)
            until(partial(grown, folder, len(before), len(tasks)))
            now = stored(folder)
            assert {name: now[name] for name in before} == before
        elif count(folder) >= last + every:
            last = count(folder)
            workers = workers_of(process.pid)
            if workers:
                kill(chance.choice(workers))
                killed += 1
    message, _ = process.communicate()
    assert process.returncode == 0, message
    return killed, ended


def check_disturbed(folder: Path, number: int, every: int) -> int:
    """Nothing is lost, nothing done twice, and all is as if nobody had disturbed; how many workers were killed."""
    log = folder.parent / "log"
    tasks = [{"x": i, "wait": 0.05, "log": str(log)} for i in range(number)]
    killed, ended = disturbed(folder, tasks, every, (number // 4, number // 2))
    assert ended == 2
    assert killed >= number // every // 2
    before = stored(folder)
    batch = run_batch(functions.square, tasks, folder, cluster=1)
    assert stored(folder) == before
    assert len(before) == len(batch) == number
    assert batch.counts == {"done": number}
    assert [result.cost for result in batch] == [math.sin(i) ** 2 for i in range(number)]
    ends = [int(line) for line in log.read_text().split()]
    assert set(ends) == set(range(number))
    assert len(ends) <= number + killed + 4 * ended  # calls that had ended when what was killed had not told of it
    assert not list(folder.rglob("*.part"))
    return killed


def check_killed_cluster(folder: Path, number: int, wait: float, address: str, processes: dict[str, list[int]]) -> None:
    """Kill a worker at a quarter and the scheduler at the half, and do the rest without the cluster."""
    log = folder.parent / "log"
    tasks = [{"x": i, "wait": wait, "log": str(log)} for i in range(number)]

    def kill_some() -> None:
        until(lambda: count(folder) >= number // 4)
        kill(processes["workers"][0])
        until(lambda: count(folder) >= number // 2)
        kill(processes["scheduler"][0])

    killer = threading.Thread(target=kill_some)
    killer.start()
    with pytest.raises(SolveError, match="scheduler is lost; finished results are stored") as caught:
        run_batch(functions.square, tasks, folder, cluster=address)
    killer.join()
    assert caught.value.name == "cluster"
    before = stored(folder)
    assert number // 2 <= len(before) < number
    batch = run_batch(functions.square, tasks, folder, cluster=2)
    after = stored(folder)
    assert {name: after[name] for name in before} == before
    assert [result.cost for result in batch] == [math.sin(i) ** 2 for i in range(number)]
    ends = [int(line) for line in log.read_text().split()]
    assert set(ends) == set(range(number))
    assert len(ends) <= number + 6  # calls that had ended when what was killed had not told of it


def check_full_disk(folder: Path) -> str:
    """Fill a disk of 400 kB of its own, and make room: one error, nothing broken; what was found, in words."""
    disk = folder / "disk"
    disk.mkdir()
    request = {"folder": str(disk / "b"), "tasks": [{"x": i} for i in range(60)], "workers": 2}
    run = f"{sys.executable} -m tests.ocp.app.batch.functions '{json.dumps(request)}'"
    script = f"""mount -t tmpfs -o size=400k none {disk} || exit 77
dd if=/dev/zero of={disk}/filler bs=1k count=300 2>/dev/null
{run}
echo "status $?"; ls {disk}/b/results/*/ | grep -c json$; find {disk} -name '*.part' | wc -l; rm {disk}/filler
{run}
"""
    completed = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if completed.returncode == 77 or "unshare" in completed.stderr:
        return "no disk of its own can be made here: a full one is not tried"
    assert completed.returncode == 0, completed
    assert completed.stderr.count("No space left on device; ") == 1, completed.stderr
    status, kept, parts, done = completed.stdout.split("\n")[:4]
    assert (status, parts.strip()) == ("status 1", "0"), completed
    assert 0 < int(kept) < 60
    assert "60 done" in done
    return f"a disk was full after {kept} of 60 results: one error, nothing broken, and all done when there was room"
