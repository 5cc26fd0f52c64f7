"""Files that outlive what befalls their writer, and files that are not what they should be."""

from __future__ import annotations

import io
import os
import signal
import stat
import struct
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ocp import ProblemError, Solution
from ocp.storage import MAX_FILE_BYTES, read_arrays, write_arrays
from tests.ocp.test_faults import ROOT, run

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b/c": np.array([1, 2, 3])}


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def archive(path: Path, members: dict[str, bytes], pack_record: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", pack_record, compresslevel=1) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def refused(path: Path, message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        Solution.load(path)
    assert path.name in str(caught.value)


# ---- writing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f8", ">f8", "f4", "i8", "u1"])
def test_arrays_come_back(kind: str, order: str, tmp_path: Path) -> None:
    values = np.asarray(np.arange(24).reshape(2, 3, 4), dtype=kind, order=order)  # type: ignore[call-overload]
    write_arrays(tmp_path / "a.npz", {"values": values, "none": np.zeros((0, 3)), "one": np.array(2.0)})
    result = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(result["values"], values)
    assert result["values"].dtype == values.dtype.newbyteorder("=")
    assert result["none"].shape == (0, 3)
    assert result["one"].shape == ()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_the_mode_of_a_file_is_kept(mode: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(b"old")
    path.chmod(mode)
    write_arrays(path, ARRAYS)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_followed(there: bool, tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    if there:
        (tmp_path / "far" / "real.npz").write_bytes(b"old")
    (tmp_path / "link.npz").symlink_to(Path("far") / "real.npz")
    write_arrays(tmp_path / "link.npz", ARRAYS)
    assert (tmp_path / "link.npz").is_symlink()
    assert not (tmp_path / "far" / "real.npz").is_symlink()
    assert set(read_arrays(tmp_path / "far" / "real.npz")) == set(ARRAYS)


def test_a_file_and_its_folder_are_on_the_disk_before_a_save_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def synced(file: int) -> None:
        done.append("folder" if stat.S_ISDIR(os.fstat(file).st_mode) else "file")
        fsync(file)

    def replaced(old: str, new: str) -> None:
        done.append("replace")
        replace(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    write_arrays(tmp_path / "a.npz", ARRAYS)
    assert done == ["file", "replace", "folder"]


WRITER = """
import os, sys
import numpy as np
from ocp.storage import write_arrays
def wait(*ignored):
    print("writing", flush=True)
    sys.stdin.read()
os.replace = wait
write_arrays(sys.argv[1], {"a": np.ones(100)})
"""


@pytest.mark.long
def test_remains_of_a_killed_save_are_removed_and_those_of_a_running_one_are_not(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    writers = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        for _ in range(2)
    ]
    for writer in writers:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"writing\n"
    (tmp_path / "a.npz.mine.part").write_bytes(b"of somebody else")
    (tmp_path / "b.npz.01234567.part").write_bytes(b"of another file")
    others = {"a.npz.mine.part", "b.npz.01234567.part"}
    assert len(list(tmp_path.iterdir())) == 4
    writers[0].send_signal(signal.SIGKILL)
    writers[0].wait()
    write_arrays(path, ARRAYS)
    left = {file.name for file in tmp_path.iterdir()} - others - {"a.npz"}
    assert len(left) == 1, "the living writer's file"
    writers[1].kill()
    writers[1].wait()
    write_arrays(path, ARRAYS)
    assert {file.name for file in tmp_path.iterdir()} == others | {"a.npz"}
    for writer in writers:
        for stream in (writer.stdin, writer.stdout):
            assert stream is not None
            stream.close()


def test_many_saves_of_one_file_at_once_leave_one_whole_file(tmp_path: Path) -> None:
    path, errors = tmp_path / "a.npz", list[BaseException]()

    def save(value: float) -> None:
        try:
            for _ in range(20):
                write_arrays(path, {"a": np.full(1000, value)})
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=save, args=(float(k),)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert np.ptp(read_arrays(path)["a"]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_devices_are_not_replaced_by_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "folder.npz").mkdir()
    for name in ("pipe.npz", "folder.npz"):
        with pytest.raises(ProblemError, match="is not a file, but a folder, a pipe or a device"):
            write_arrays(tmp_path / name, ARRAYS)
    with pytest.raises(ProblemError, match="/dev/null is not a file"):
        write_arrays("/dev/null", ARRAYS)
    assert {file.name for file in tmp_path.iterdir()} == {"pipe.npz", "folder.npz"}


def test_unreadable_solutions_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match="bytes of arrays"):
        write_arrays(tmp_path / "a.npz", {"a": np.broadcast_to(np.float64(0), (MAX_FILE_BYTES,))})
    assert list(tmp_path.iterdir()) == []


# ---- reading -----------------------------------------------------------------------------------------------------


def test_pipes_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "folder.npz").mkdir()
    for path in (tmp_path / "pipe.npz", tmp_path / "folder.npz", Path("/dev/zero"), Path("/dev/null")):
        refused(path, "file, but a folder, a pipe or a device")
    with pytest.raises(FileNotFoundError):
        Solution.load(tmp_path / "absent.npz")
    for wrong in (None, 3, "a\0b", ["a"]):
        with pytest.raises(ProblemError):
            Solution.load(wrong)  # type: ignore[arg-type]


def lying(data: bytes, report: int) -> bytes:
    """An archive of one member that says of itself how large it is unpacked, in both places."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr("head.npy", data)
    whole = bytearray(stream.getvalue())
    struct.pack_into("<I", whole, 22, report)
    struct.pack_into("<I", whole, whole.index(b"PK\x01\x02") + 24, report)
    return bytes(whole)


def header(shape: str, kind: str = "<f8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


BROKEN: dict[str, Callable[[Path], object]] = {
    "bomb": lambda p: archive(p, {f"{k}.npy": header("(1,)") + bytes(2**24) for k in range(17)}),
    "lying bomb": lambda p: p.write_bytes(lying(bytes(2**27), 100)),
    "shape beyond all memory": lambda p: archive(p, {"head.npy": header("(1000000000000,)") + bytes(64)}),
    "shape that overflows": lambda p: archive(p, {"head.npy": header("(4294967296, 4294967296)")}),
    "negative shape": lambda p: archive(p, {"head.npy": header("(-1, -1)") + bytes(8)}),
    "objects": lambda p: archive(p, {"head.npy": header("(1,)", "|O") + bytes(8)}),
    "text": lambda p: archive(p, {"head.npy": header("(1,)", "<U2") + bytes(8)}),
    "complex": lambda p: archive(p, {"head.npy": header("(1,)", "<c16") + bytes(16)}),
    "code": lambda p: archive(p, {"head.npy": header("__import__('os').abort()")}),
    "no arrays": lambda p: archive(p, {"head": b"{}"}),
    "lzma": lambda p: archive(p, {"head.npy": npy(np.zeros(3))}, zipfile.ZIP_LZMA),
    "many names": lambda p: archive(p, {f"{k:06}.npy": b"" for k in range(30000)}),
    "deep JSON": lambda p: archive(p, {"head.npy": npy(np.frombuffer(b"[" * 10**6, dtype=np.uint8))}),
    "a long file": lambda p: os.truncate(archive(p, {"a.npy": b""}), MAX_FILE_BYTES + 1),
}


@pytest.mark.parametrize("what", BROKEN)
def test_broken_archives_are_refused(what: str, tmp_path: Path) -> None:
    BROKEN[what](tmp_path / "broken.npz")
    refused(tmp_path / "broken.npz", "is not a saved solution")


def test_a_name_that_stands_twice_is_refused(tmp_path: Path) -> None:
    archive(tmp_path / "twice.npz", {"head.npy": npy(np.zeros(3)), "tail.npy": npy(np.ones(3))})
    data = (tmp_path / "twice.npz").read_bytes()
    (tmp_path / "twice.npz").write_bytes(data.replace(b"tail.npy", b"head.npy"))
    refused(tmp_path / "twice.npz", "a name occurs twice")


def test_reading_bombs_takes_less_than_a_gigabyte(tmp_path: Path) -> None:
    for what in ("bomb", "lying bomb"):
        BROKEN[what](tmp_path / f"{what}.npz")
    done = run(f"""
        import resource
        resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
        from pathlib import Path
        from ocp.errors import ProblemError
        from ocp.storage import read_arrays
        for path in sorted(Path({str(tmp_path)!r}).iterdir()):
            try:
                read_arrays(path)
            except ProblemError as error:
                print(type(error.__cause__).__name__)
    """)
    assert done.stdout.split() == ["NoneType", "BadZipFile"], done.stderr


def test_exhausted_file_handles_are_reported_as_such(tmp_path: Path) -> None:
    write_arrays(tmp_path / "plan.npz", ARRAYS)
    done = run(f"""
        import os, resource
        from ocp import Collocation, Solution, solve
        from tests.ocp.problems import energy
        resource.setrlimit(resource.RLIMIT_NOFILE, (60, 60))
        held = []
        try:
            while True:
                held.append(os.open("/dev/null", os.O_RDONLY))
        except OSError:
            pass
        for call in (lambda: Solution.load({str(tmp_path / "plan.npz")!r}), lambda: solve(energy(), Collocation(3))):
            try:
                call()
            except Exception as error:
                print(type(error).__name__, error)
    """)
    load, solve = done.stdout.splitlines()
    assert load.startswith("ProblemError")
    assert load.endswith("cannot be read: Too many open files")
    assert solve.startswith("SolveError")
    assert "ipopt cannot be loaded" in solve
    assert "Too many open files" in solve
