"""What is dear to compute and depends on nothing but its input, kept in files between runs.

The folder is $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion. Values lie there as KEY.json, shared libraries as
KEY.DIGEST.so, whose digest tells whether they are whole. A file that cannot be read, is broken or cannot be written is
no error: then the work is done again.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any

import numpy as np

MOST_BYTES = 2**20  # of a value: ours have a few hundred
MOST_KEPT = 2**28  # bytes of all libraries: the least recently used are removed
KINDS = (".json", ".so", ".lock", ".part")
UNREADABLE = (OSError, ValueError, RuntimeError, RecursionError)
"""What a file raises that is broken or not there; RuntimeError where there is no home."""
MOMENT = 0.02  # s between two looks at a lock


def key_of(version: str, *contents: Any) -> str:
    """A name for arrays or texts and the version of what is done with them: hexadecimal digits of SHA-256.

    Args:
        version: What is done with them; `version_of` the module that does it.
    """
    digest = hashlib.sha256(version.encode())
    for content in contents:
        plain = np.frombuffer(content.encode(), np.uint8) if isinstance(content, str) else np.ascontiguousarray(content)
        digest.update(f"|{plain.dtype.str}{plain.shape}|".encode())
        digest.update(plain.tobytes())
    return digest.hexdigest()


@functools.cache
def version_of(module: str) -> str:
    """Hexadecimal digits that tell the source of a module, and of what it imports of its package, from any other.

    So that no change of what a value was made by is forgotten. Imports are those written `from PACKAGE... import`.
    """
    sources: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in sources:
            continue
        loader: Any = getattr(find_spec(name), "loader", None)
        sources[name] = loader.get_source(name) or ""
        waiting += re.findall(rf"^\s*from ({module.partition('.')[0]}[\w.]*) import", sources[name], re.MULTILINE)
    return hashlib.sha256(repr(sorted(sources.items())).encode()).hexdigest()


def folder() -> Path:
    """Where the files lie; it need not exist."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    place = Path(given) if given and Path(given).is_absolute() else Path("~/.cache").expanduser()
    return place / "selfmotion"


def files() -> list[Path]:
    """All that is kept, and parts that were left by who was killed."""
    try:
        return sorted(file for file in folder().iterdir() if file.is_file() and file.suffix in KINDS)
    except UNREADABLE:
        return []


# ---- values ------------------------------------------------------------------------------------------------------


def kept(key: str) -> Any:
    """What was kept under a key: lists, dictionaries, texts, numbers; None where there is nothing or nothing whole."""
    try:
        file = folder() / f"{key}.json"
        if file.stat().st_size > MOST_BYTES:
            return None
        return json.loads(file.read_text(encoding="utf-8"))
    except UNREADABLE:
        return None


def keep(key: str, value: Any) -> None:
    """Keep a value of JSON under a key; a file there is replaced as a whole."""
    with suppress(*UNREADABLE):
        _write(f"{key}.json", json.dumps(value).encode())


# ---- libraries ---------------------------------------------------------------------------------------------------


def kept_library(key: str) -> Path | None:
    """The shared library that was kept under a key, now the most recently used; None where there is none.

    One that is damaged, or belongs to somebody else, is none; damaged ones are removed.
    """
    with suppress(*UNREADABLE):
        place = folder()
        for name in os.listdir(place):
            if not (name.startswith(key) and name.endswith(".so")):
                continue
            file = place / name
            with suppress(*UNREADABLE):
                if file.stat().st_uid not in (0, os.geteuid()):
                    continue  # it would be run
                if file.name == _name(key, file.read_bytes()):
                    with suppress(OSError):
                        os.utime(file)
                    return file
                file.unlink()
    return None


def keep_library(key: str, library: bytes) -> Path | None:
    """Keep a shared library under a key and say where it is; None where nothing can be written."""
    with suppress(*UNREADABLE):
        file = _write(_name(key, library), library)
        _make_room(file)
        return file
    return None


@contextmanager
def alone(key: str, ask: Callable[[], Any] = lambda: None) -> Iterator[None]:
    """Inside, no other process or thread is at work on a key; where the folder takes no locks, without.

    While another one is waited for, ``ask`` is called every 20 ms, to raise where there is no time for it.
    """
    lock = None
    with suppress(*UNREADABLE):
        lock = _locked(folder() / f"{key}.lock", ask)
    try:
        yield
    finally:
        if lock is not None:
            with lock, suppress(OSError):
                os.unlink(lock.name)
                fcntl.flock(lock, fcntl.LOCK_UN)  # or it would last as long as a process forked meanwhile


def _locked(file: Path, ask: Callable[[], Any]) -> IO[bytes]:
    """A file that is made, if need be, and locked."""
    file.parent.mkdir(parents=True, exist_ok=True)
    while True:
        stream = open(file, "ab")  # noqa: SIM115
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.stat(file), os.fstat(stream.fileno())):
                return stream
        except (BlockingIOError, FileNotFoundError):  # another's, or removed by who had it
            pass
        except BaseException:
            stream.close()
            raise
        stream.close()
        ask()
        time.sleep(MOMENT)


def _name(key: str, library: bytes) -> str:
    return f"{key}.{hashlib.sha256(library).hexdigest()[:16]}.so"


def _make_room(newest: Path) -> None:
    """Remove the libraries that were not used for longest, until the others and the newest are MOST_KEPT at most.

    And the locks of processes that are no more.
    """
    for lock in newest.parent.glob("*.lock"):
        with suppress(OSError), open(lock, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while somebody has it
            lock.unlink()
    found = []
    for file in newest.parent.glob("*.so"):
        with suppress(OSError):
            status = file.stat()
            found.append((file == newest, status.st_mtime, status.st_size, file))
    total = sum(size for _, _, size, _ in found)
    for is_newest, _, size, file in sorted(found):
        if total <= MOST_KEPT or is_newest:
            break
        with suppress(OSError):
            file.unlink()
            total -= size


def _write(name: str, content: bytes) -> Path:
    """Write a file of the folder whole or not at all."""
    place = folder()
    place.mkdir(parents=True, exist_ok=True)
    part = None
    try:
        with NamedTemporaryFile("wb", dir=place, suffix=".part", delete=False) as file:
            part = Path(file.name)
            file.write(content)
        return part.replace(place / name)
    except BaseException:
        if part is not None:
            part.unlink(missing_ok=True)
        raise
