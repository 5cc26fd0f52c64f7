"""Whatever is killed, full or shared, nothing is lost, done twice or broken. `make faults` does the same with 500."""

from __future__ import annotations

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import ocp.storage
from ocp import ProblemError
from ocp.app.batch import run_batch
from ocp.app.batch.result_store import ResultStore
from tests.ocp.app.batch import functions
from tests.ocp.app.batch.drivers import check_disturbed, count, driver, kill, stored, until


@pytest.mark.long
def test_workers_and_drivers_are_killed_and_nothing_is_lost_or_done_twice(tmp_path: Path) -> None:
    check_disturbed(tmp_path / "b", 60, 10)


@pytest.mark.long
def test_a_driver_waits_for_another_and_completes_its_tasks(tmp_path: Path) -> None:
    log, gate = tmp_path / "log", tmp_path / "gate"
    tasks = [{"x": i, "log": str(log), **({"gate": str(gate)} if i > 3 else {})} for i in range(12)]
    one = driver(tmp_path / "b", tasks, 1)
    until(lambda: count(tmp_path / "b") > 0)
    two = driver(tmp_path / "b", tasks, 1)
    assert two.stdout is not None
    assert "another driver is active" in two.stdout.readline()
    kill(one.pid)
    one.communicate()
    gate.touch()
    message, _ = two.communicate()
    assert "12 done" in message
    ends = [int(line) for line in log.read_text().split()]
    assert set(ends) == set(range(12))
    assert len(ends) <= 14  # what the first was at


def test_one_driver_at_a_time_is_at_work_in_a_folder(tmp_path: Path) -> None:
    crowd = [ResultStore.of(tmp_path, "f", "1", True) for _ in range(8)]
    inside: list[int] = []

    def work(store: ResultStore) -> None:
        for _ in range(20):
            with store.locked():
                inside.append(1)
                assert len(inside) == 1
                inside.pop()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, crowd))


def test_a_file_system_without_locks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("ocp.app.batch.result_store.fcntl.flock", none)
    with pytest.raises(ProblemError, match="has no locks") as caught:
        run_batch(functions.square, [{"x": 1}], tmp_path / "b")
    assert caught.value.name == "folder"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_full_or_read_only_disk_stops_with_one_error_and_breaks_nothing(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: Any
) -> None:
    tasks = [{"x": i} for i in range(20)]
    written = ocp.storage.write_whole
    times = [0]

    def full(path: Any, write: Any, synced: bool = True) -> None:
        times[0] += 1
        if times[0] > 8:

            def some(stream: Any) -> None:
                stream.write(b"{")
                raise OSError(number, os.strerror(number))

            return written(path, some, synced)
        return written(path, write, synced)

    monkeypatch.setattr("ocp.app.batch.result_store.write_whole", full)
    with pytest.raises(OSError, match="7 of 20 results are stored") as caught:
        run_batch(functions.square, tasks, tmp_path / "b", cluster=here)
    assert caught.value.errno == number
    assert caught.value.filename == str(tmp_path / "b")
    assert times[0] == 9
    assert not list((tmp_path / "b").rglob("*.part"))
    monkeypatch.undo()
    before = stored(tmp_path / "b")
    assert len(before) == 7
    if number == errno.EROFS:
        return
    assert run_batch(functions.square, tasks, tmp_path / "b", cluster=here).counts == {"done": 20}
    after = stored(tmp_path / "b")
    assert {name: after[name] for name in before} == before
    check_read_only(tasks, tmp_path / "b", monkeypatch)


def check_read_only(tasks: list[Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is all done is read without writing."""

    def refused(*_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    opened = os.open

    def only_read(path: Any, flags: int, *others: Any, **options: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            refused()
        return opened(path, flags, *others, **options)

    for name in ("mkdir", "symlink", "replace", "unlink", "utime"):
        monkeypatch.setattr(os, name, refused)
    monkeypatch.setattr(os, "open", only_read)
    assert len(run_batch(functions.square, tasks, folder)) == len(tasks)
    monkeypatch.undo()


def test_a_worker_without_room_stops_the_batch_and_is_no_failure_of_its_task(tmp_path: Path, here: Any) -> None:
    room = tmp_path / "full"
    room.touch()
    with pytest.raises(OSError, match="0 of 1 results are stored") as caught:
        run_batch(functions.without_room, [{"until": str(room)}], tmp_path / "b", cluster=here)
    assert caught.value.errno == errno.ENOSPC
    room.unlink()
    assert run_batch(functions.without_room, [{"until": str(room)}], tmp_path / "b", cluster=here).counts == {"done": 1}
