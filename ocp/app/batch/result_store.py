"""Store the results of a batch in a folder: one record for each finished task.

    batch.json              the function, its version, the format
    results/ab/KEY.json     a record: task, status, value, cost, verdict, seconds, message
    results/ab/KEY.0.npz    plans and solutions of its value
    lock                    held by the active driver; the system releases it when the driver ends for any reason

Files are complete or absent. They are not synchronised to the disk: after a loss of power the last ones may be empty or
truncated, which is detected and counts as missing.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from math import isfinite
from pathlib import Path
from typing import Any

from ocp.app.batch.content import Payload, canonical_text, key_of, unpack_result
from ocp.console import LOG
from ocp.errors import ProblemError
from ocp.storage import END_RECORD, checked_path, open_unlinked, write_whole

__all__ = ["STATUSES", "ResultStore"]

FORMAT = 2
HEAD = "batch.json"
LOCK = "lock"
OWN_NAMES = {HEAD, "results", LOCK}
STATUSES = ("done", "failed", "killed")
RECORD_FIELDS = {
    "key": str,
    "task": object,
    "status": str,
    "value": object,
    "files": list,
    "cost": int | float | None,
    "verdict": object,
    "seconds": int | float,
    "error": str,
    "message": str,
    "neighbour": str | None,
    "inputs": dict,
}
"""Fields of a record, with their types."""


class ResultStore:
    """The records in a folder.

    Attributes:
        folder: The folder.
        function, version: Function that computed the results, and its version.
    """

    def __init__(self, folder: Path, function: str, version: str) -> None:
        self.folder, self.function, self.version = folder, function, version

    @classmethod
    def at(cls, folder: Any) -> ResultStore:
        """Return the existing store in a folder.

        Raises:
            ProblemError: The folder is invalid, has no store, or has one of another format.
        """
        path = checked_folder(folder)
        for link in (path / name for name in sorted(OWN_NAMES) if (path / name).is_symlink()):
            words = f"{link} is a link and may lead out of the folder; link the whole folder instead"
            raise ProblemError(words, name="folder", value=str(link))
        try:
            head = loaded(path / HEAD)
            store = cls(path, str(head["function"]), str(head["version"]))
            if head["format"] != FORMAT:
                words = f"{path} has batch format {head['format']}, not {FORMAT}; use another folder"
                raise ProblemError(words, name="folder", value=str(path), limit=FORMAT)
        except (FileNotFoundError, NotADirectoryError):
            words = f"{path} is not the folder of a batch: it has no {HEAD}"
            raise ProblemError(words, name="folder", value=str(path)) from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, ProblemError):
                raise
            words = f"{path / HEAD} is damaged: {error!r}; use another folder"
            raise ProblemError(words, name="folder", value=str(path)) from error
        return store

    @classmethod
    def of(cls, folder: Any, function: str, version: str, chosen: bool) -> ResultStore:
        """Return the store of a function in a folder; create it if the folder is new or empty.

        Args:
            folder: The folder.
            function: Name of the function.
            version: Its version.
            chosen: Whether the user chose the version; else it is that of the source.

        Raises:
            ProblemError: The folder belongs to another function, has results of another version, or has other files.
            OSError: The folder cannot be created.
        """
        path = checked_folder(folder)
        if not os.path.lexists(path / HEAD):
            path.mkdir(parents=True, exist_ok=True)
            others = sorted(set(os.listdir(path)) - OWN_NAMES)
            if others:
                words = f"{path} contains {others[0]!r} and is not the folder of a batch; use a new or empty one"
                raise ProblemError(words, name="folder", value=str(path))
            new = cls(path, function, version)
            with new.locked():
                if not os.path.lexists(path / HEAD):
                    new._begin()
            (path / "results").mkdir(exist_ok=True)
        store = cls.at(path)
        if store.function != function:
            words = f"{path} contains results of {store.function}, not of {function}; use another folder"
            raise ProblemError(words, name="folder", value=function, limit=store.function)
        if store.version != version and not store._has_result():
            with store.locked():  # a driver that held the lock may have written one
                if not store._has_result():
                    store = cls(path, function, version)
                    store._begin()
        if store.version != version:
            words = f"{path} contains results of version {store.version!r} of {function}, not of {version!r}; "
            words += "use another folder" if chosen else "the source has changed: use another folder, or, if the "
            words += "" if chosen else f"results would be the same, pass version={store.version!r}"
            raise ProblemError(words, name="version", value=version, limit=store.version)
        return store

    def _begin(self) -> None:
        """Write the head of the store."""
        text = json.dumps({"format": FORMAT, "function": self.function, "version": self.version}, indent=1).encode()
        write_whole(self.folder / HEAD, lambda stream: stream.write(text))

    def _has_result(self) -> bool:
        """Return whether the store has a result."""
        records = (self.read(key) for key in self.recorded())
        return any(record and record["status"] == "done" for record in records)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock of the folder; wait if another driver holds it.

        Raises:
            ProblemError: The file system of the folder has no locks.
            OSError: The folder cannot be written.
        """
        file = os.open(self.folder / LOCK, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o644)
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                LOG.warning("another driver is active in %s: waiting for its end", self.folder)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise
                words = f"the file system of {self.folder} has no locks, which separate two drivers; use another one"
                raise ProblemError(words, name="folder", value=str(self.folder)) from error
            yield
        finally:
            os.close(file)

    # ---- records -----------------------------------------------------------------------------------------------

    def read(self, key: str) -> dict[str, Any] | None:
        """Return the record of a key, or None if it is missing or incomplete; links are not followed."""
        try:
            path = self._place(key)
            record: Any = None if path.parent.is_symlink() else loaded(path)
            is_valid = record.keys() == RECORD_FIELDS.keys() and record["key"] == key == key_of(
                canonical_text(record["task"], "task")
            )
            is_valid = is_valid and all(isinstance(record[name], kind) for name, kind in RECORD_FIELDS.items())
            if not is_valid or record["status"] not in STATUSES:
                return None
            for i, file in enumerate(record["files"]):
                with open_unlinked(file_at(path, i)) as stream:
                    if stream.seek(0, os.SEEK_END) != file["bytes"]:
                        return None
                    stream.seek(-22, os.SEEK_END)  # the end record of a zip archive
                    if stream.read(4) != END_RECORD:
                        return None
        except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError, KeyError, TypeError, RecursionError):
            return None
        return dict(record)

    def write(self, record: dict[str, Any], files: Sequence[bytes]) -> None:
        """Write a record after its files, replacing links.

        Raises:
            OSError: A file cannot be written; no file is then incomplete.
        """
        path = self._place(record["key"])
        for link in (path.parent, path, *(file_at(path, i) for i in range(len(files)))):
            if os.path.islink(link):
                link.unlink()
        if not os.path.isdir(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
        for i, file in enumerate(files):
            write_whole(file_at(path, i), lambda stream, file=file: stream.write(file), synced=False)  # type: ignore[misc]
        text = json.dumps(record, allow_nan=False).encode()
        write_whole(path, lambda stream: stream.write(text), synced=False)

    def payload(self, record: dict[str, Any]) -> Payload:
        """Return a record with its files.

        Raises:
            OSError: A file is missing.
            ProblemError: A file is a link, or too large.
        """
        files = []
        for i in range(len(record["files"])):
            with open_unlinked(file_at(self._place(record["key"]), i)) as stream:
                files.append(stream.read())
        return Payload(record, tuple(files))

    def value(self, record: dict[str, Any]) -> Any:
        """Return the value of a record."""
        return unpack_result(self.payload(record))

    def recorded(self) -> Iterator[str]:
        """Yield the keys of all records in order."""
        shards: list[str] = []
        with suppress(FileNotFoundError):
            shards = sorted(os.listdir(self.folder / "results"))
        for shard in shards:
            with suppress(FileNotFoundError, NotADirectoryError):
                for name in sorted(os.listdir(self.folder / "results" / shard)):
                    if name.endswith(".json"):
                        yield name.removesuffix(".json")

    def _place(self, key: str) -> Path:
        return Path(f"{self.folder}/results/{key[:2]}/{key}.json")


def loaded(path: Path) -> Any:
    """Return the data of a JSON file; raise ValueError if a number is not finite."""
    with open_unlinked(path) as stream:
        return json.loads(stream.read(), parse_float=finite, parse_constant=finite)


def finite(text: str) -> float:
    """Return a finite number."""
    if not isfinite(value := float(text)):
        raise ValueError(f"{text} is not a finite number")
    return value


def file_at(place: Path, number: int) -> Path:
    """Return the path of a record's numbered file."""
    return place.with_suffix(f".{number}.npz")


def checked_folder(folder: Any) -> Path:
    """Return the absolute path of a folder, which need not exist.

    Raises:
        ProblemError: The path is invalid, is that of a file, or of a remote store.
    """
    path = Path(checked_path(folder))
    text = os.fspath(folder)
    if not isinstance(text, str) or not text or "\0" in text:
        raise ProblemError(f"folder: {folder!r} is not a path", name="folder", value=folder)
    if "://" in text:
        words = f"folder: {text} is not a folder of this machine; results are sent to the driver"
        raise ProblemError(words, name="folder", value=text)
    if any(place.is_file() for place in (path, *path.parents)):
        raise ProblemError(f"folder: {path} is not a folder", name="folder", value=str(path))
    return path.absolute()
