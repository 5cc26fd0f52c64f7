"""What is dear to compute and depends on nothing but its input, kept in files between runs.

The folder is $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion. Values lie there as KEY.json, behind a digest of the
key, which names the code that made them, and of themselves; shared libraries as KEY.DIGEST.so. A file that cannot be
read, is broken or cannot be written is no error: then the work is done again.

A digest says that a file is whole, not who wrote it. So nothing is kept in a folder, nor taken from a file, that
somebody else owns or may write. What has been checked in such a folder cannot be changed before it is used.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import hashlib
import json
import logging
import os
import re
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any

import numpy as np

from models.input_files import read_regular

MOST_BYTES = 2**20  # of a value: ours have a few hundred
MOST_KEPT = 2**28  # bytes of all libraries: the least recently used are removed
KINDS = (".json", ".so", ".lock", ".part")
UNREADABLE = (OSError, ValueError, RuntimeError, RecursionError)
"""What a file raises that is broken or not there; RuntimeError where there is no home."""


def cache_key(version: str, *contents: Any) -> str:
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
def source_version(module: str) -> str:
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


def cache_folder() -> Path:
    """Where the files lie; it need not exist."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    place = Path(given) if given and Path(given).is_absolute() else Path("~/.cache").expanduser()
    return place / "selfmotion"


def private_folder(make: bool = False) -> Path:
    """Return the folder; `make` it for this user alone where there is none.

    Raises:
        OSError: There is none, or others than this user and the system's owner may change what lies in it: the folder
            belongs to somebody else, is a link or may be written by others, or a folder above may be.
        RuntimeError: There is no home.
    """
    place = cache_folder()
    if make:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
    why = _unsafe(place)
    if why:
        _notice(f"nothing is kept between runs in {place}: {why}")
        raise PermissionError(errno.EPERM, why, str(place))
    return place


def _unsafe(place: Path) -> str:
    """Why files in a folder may be changed by others; "" where they may not."""
    status, me = place.lstat(), os.geteuid()
    if not stat.S_ISDIR(status.st_mode):
        return "it is a link or no folder; name another one, XDG_CACHE_HOME"
    if status.st_uid != me:
        return f"it belongs to the user {status.st_uid}; name a folder of your own, XDG_CACHE_HOME"
    if status.st_mode & 0o022:
        return f"others may write it; empty it, then chmod 700 {place}"
    for above in {*place.parents, *place.resolve().parents}:
        status = above.lstat()
        writable = status.st_mode & (stat.S_ISVTX | 0o002) == 0o002 and not stat.S_ISLNK(status.st_mode)
        if writable or status.st_uid not in (me, 0, os.stat("/").st_uid):
            return f"others may change {above}; name a folder elsewhere, XDG_CACHE_HOME"
    return ""


@functools.cache
def _notice(words: str) -> None:
    logging.getLogger("models").warning(words)


def files() -> list[Path]:
    """All that is kept, and parts that were left by who was killed."""
    try:
        return sorted(file for file in private_folder().iterdir() if file.is_file() and file.suffix in KINDS)
    except UNREADABLE:
        return []


# ---- values ------------------------------------------------------------------------------------------------------


def load_value(key: str) -> Any:
    """What was kept under a key: lists, dictionaries, texts, numbers; None where there is nothing or nothing whole."""
    try:
        digest, _, content = read_regular(private_folder() / f"{key}.json", MOST_BYTES, own=True).partition(b"\n")
        return json.loads(content) if digest == _digest(key, content) else None
    except UNREADABLE:
        return None


def store_value(key: str, value: Any) -> None:
    """Keep a value of JSON under a key; a file there is replaced as a whole."""
    with suppress(*UNREADABLE):
        content = json.dumps(value).encode()
        _write(f"{key}.json", _digest(key, content) + b"\n" + content)


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\n" + content).hexdigest().encode()


# ---- libraries ---------------------------------------------------------------------------------------------------


def load_library(key: str) -> Path | None:
    """The shared library that was kept under a key, now the most recently used; None where there is none.

    One that is damaged, or that somebody else owns or may write, is none; damaged ones are removed.
    """
    with suppress(*UNREADABLE):
        place = private_folder()
        for name in os.listdir(place):
            if not (name.startswith(key) and name.endswith(".so")):
                continue
            file = place / name
            with suppress(*UNREADABLE):
                if file.name == _name(key, read_regular(file, MOST_KEPT, own=True)):
                    with suppress(OSError):
                        os.utime(file)
                    return file
                file.unlink()
    return None


def store_library(key: str, library: bytes) -> Path | None:
    """Keep a shared library under a key and say where it is; None where nothing can be written."""
    with suppress(*UNREADABLE):
        file = _write(_name(key, library), library)
        _make_room(file)
        return file
    return None


@contextmanager
def exclusive(key: str, ask: Callable[[], Any] = lambda: None) -> Iterator[None]:
    """Inside, no other process or thread is at work on a key; where the folder takes no locks, without.

    While another one is waited for, ``ask`` is called every 20 ms, to raise where there is no time for it.
    """
    lock = None
    with suppress(*UNREADABLE):
        lock = _locked(private_folder(make=True) / f"{key}.lock", ask)
    try:
        yield
    finally:
        if lock is not None:
            with lock, suppress(OSError):
                os.unlink(lock.name)
                fcntl.flock(lock, fcntl.LOCK_UN)  # or it would last as long as a process forked meanwhile


def _locked(file: Path, ask: Callable[[], Any]) -> IO[bytes]:
    """A file that is made, if need be, and locked."""
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
        time.sleep(0.02)


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
    place = private_folder(make=True)
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
