"""Whatever is killed, full or shared, nothing is lost, done twice or broken. `make faults` does the same with 500."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import ocp.storage
from ocp.batch import read_batch, run_batch
from ocp.batch.claims import Claims
from tests.ocp.batch import functions
from tests.ocp.batch.drivers import check_disturbed, count, driver, kill, stored, until


@pytest.mark.long
def test_workers_and_drivers_are_killed_and_nothing_is_lost_or_done_twice(tmp_path: Path) -> None:
    check_disturbed(tmp_path / "b", 60, 0.05, 1.0)


def test_two_drivers_share_the_work_and_one_takes_over_what_the_other_leaves(tmp_path: Path) -> None:
    log, gate, claims = tmp_path / "log", tmp_path / "gate", tmp_path / "b" / "claims"
    tasks = [{"x": i, "wait": 0.02, "log": str(log), "gate": str(gate)} for i in range(80)]
    one, two = (driver(tmp_path / "b", tasks, 1) for _ in range(2))
    until(lambda: claims.exists() and len(list(claims.iterdir())) == 2)
    gate.touch()
    until(lambda: count(tmp_path / "b") > 20)
    assert one.poll() is None
    kill(one.pid)
    one.communicate()
    said, _ = two.communicate(timeout=60)
    assert "80 done" in said
    batch = read_batch(tmp_path / "b")
    processes = {result.value["process"] for result in batch}
    assert len(processes) == 2
    ends = [int(line) for line in log.read_text().split()]
    assert set(ends) == set(range(80))
    assert len(ends) <= 81


def test_a_claim_is_one_drivers_until_it_is_released_or_its_owner_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Claims(tmp_path) as one, Claims(tmp_path) as two:
        assert one.take("a")
        assert not two.take("a")
        one.release("a")
        assert two.take("a")
        assert not one.take("a")
    assert not list((tmp_path / "claims").iterdir())
    gone = Claims(tmp_path)
    assert gone.take("b")
    os.close(gone._file)  # as the end of its process does
    with Claims(tmp_path) as three:
        assert three.take("b")
    (tmp_path / "claims" / "c").symlink_to("nobody")
    with Claims(tmp_path) as four:
        assert four.take("c")
    clock = [0.0]
    monkeypatch.setattr("ocp.batch.claims.time.monotonic", lambda: clock[0])
    far = tmp_path / "owners" / "elsewhere.1"
    far.touch()
    (tmp_path / "claims" / "d").symlink_to(far.name)
    with Claims(tmp_path) as five:
        for clock[0], sign in ((0.0, 0), (50.0, 0), (55.0, -1000), (100.0, -1000), (110.0, 7_000_000_000)):
            os.utime(far, ns=(0, sign + 10**15))  # a clock that goes back, and far ahead, is a sign of life
            assert not five.take("d")
        clock[0] = 171.0
        assert five.take("d")


def test_without_locks_signs_of_life_alone_decide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]

    def none(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("ocp.batch.claims.fcntl.flock", none)
    monkeypatch.setattr("ocp.batch.claims.time.monotonic", lambda: clock[0])
    with Claims(tmp_path) as one, Claims(tmp_path) as two:
        assert one.take("a")
        for clock[0] in (0.0, 40.0, 80.0, 120.0):
            time.sleep(0.01)  # a file system's clock has steps
            one.sign()
            assert not two.take("a")
        clock[0] = 181.0
        assert two.take("a")


def test_many_drivers_take_each_claim_once(tmp_path: Path) -> None:
    for i in range(200):
        (tmp_path / "claims").mkdir(exist_ok=True)
        (tmp_path / "claims" / str(i)).symlink_to("gone")
    taken: list[str] = []
    crowd = [Claims(tmp_path) for _ in range(8)]

    def take_all(claims: Claims) -> None:
        taken.extend(str(i) for i in range(200) if claims.take(str(i)))

    threads = [threading.Thread(target=take_all, args=(claims,)) for claims in crowd]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken, key=int) == [str(i) for i in range(200)]
    for claims in crowd:
        claims.__exit__()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_full_or_read_only_disk_stops_with_one_error_and_breaks_nothing(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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

    monkeypatch.setattr("ocp.batch.ledger.write_whole", full)
    with pytest.raises(OSError, match="7 of 20 results are kept") as caught:
        run_batch(functions.square, tasks, tmp_path / "b", workers=1)
    assert caught.value.errno == number
    assert caught.value.filename == str(tmp_path / "b")
    assert times[0] == 9
    assert not list((tmp_path / "b").rglob("*.part"))
    assert not list((tmp_path / "b" / "claims").iterdir())
    monkeypatch.undo()
    before = stored(tmp_path / "b")
    assert len(before) == 7
    if number == errno.EROFS:
        return
    assert run_batch(functions.square, tasks, tmp_path / "b", workers=1).counts == {"done": 20}
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


def test_a_worker_without_room_stops_the_batch_and_is_no_failure_of_its_task(tmp_path: Path) -> None:
    room = tmp_path / "full"
    room.touch()
    with pytest.raises(OSError, match="0 of 1 results are kept") as caught:
        run_batch(functions.without_room, [{"until": str(room)}], tmp_path / "b", workers=1)
    assert caught.value.errno == errno.ENOSPC
    room.unlink()
    assert run_batch(functions.without_room, [{"until": str(room)}], tmp_path / "b", workers=1).counts == {"done": 1}
