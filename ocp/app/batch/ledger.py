"""The folder of a batch: what it is of, and one record for each task that has come to its end.

    batch.json              the function, its version, the format
    results/ab/KEY.json     a record: task, status, value, cost, verdict, seconds, message
    results/ab/KEY.0.npz    plans and solutions of its value
    lock                    which the driver at work holds; when it ends, whatever ends it, the system lets go

Files are there whole or not at all. They are not waited for to reach the disk: after a loss of power the last of them
may be empty or cut short, which is seen, and counts as missing.
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

from ocp.app.batch.content import Parcel, key_of, text_of, unpacked
from ocp.console import LOG
from ocp.errors import ProblemError
from ocp.storage import END_RECORD, checked_path, open_unlinked, write_whole

__all__ = ["ENDS", "Ledger"]

FORMAT = 2
HEAD = "batch.json"
LOCK = "lock"
OWN = {HEAD, "results", LOCK}
ENDS = ("done", "failed", "killed")
PARTS = {
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
"""Of a record, with their kinds."""


class Ledger:
    """The records of a folder.

    Attributes:
        folder: Where they are. function, version: What made them.
    """

    def __init__(self, folder: Path, function: str, version: str) -> None:
        self.folder, self.function, self.version = folder, function, version

    @classmethod
    def at(cls, folder: Any) -> Ledger:
        """The ledger that is there.

        Raises:
            ProblemError: There is none, or of another format, or folder is no path.
        """
        path = checked_folder(folder)
        for link in (path / name for name in sorted(OWN) if (path / name).is_symlink()):
            words = f"{link} is a link, which may lead out of the folder; link the whole folder instead"
            raise ProblemError(words, name="folder", value=str(link))
        try:
            head = loaded(path / HEAD)
            found = cls(path, str(head["function"]), str(head["version"]))
            if head["format"] != FORMAT:
                words = f"{path} was written in format {head['format']} of batches, not {FORMAT}; take another folder"
                raise ProblemError(words, name="folder", value=str(path), limit=FORMAT)
        except (FileNotFoundError, NotADirectoryError):
            words = f"{path} is no folder of a batch: there is no {HEAD} in it"
            raise ProblemError(words, name="folder", value=str(path)) from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, ProblemError):
                raise
            words = f"{path / HEAD} is damaged: {error!r}; take another folder"
            raise ProblemError(words, name="folder", value=str(path)) from error
        return found

    @classmethod
    def of(cls, folder: Any, function: str, version: str, chosen: bool) -> Ledger:
        """The ledger of a function in a folder, begun where the folder is new or empty.

        Args:
            chosen: Whether the version is a user's word, and not that of the source.

        Raises:
            ProblemError: The folder is another function's, or holds results of another version, or is nobody's and not
                empty.
            OSError: It cannot be made.
        """
        path = checked_folder(folder)
        if not os.path.lexists(path / HEAD):
            path.mkdir(parents=True, exist_ok=True)
            strange = sorted(set(os.listdir(path)) - OWN)
            if strange:
                words = f"{path} holds {strange[0]!r} and is no folder of a batch; take a new or an empty one"
                raise ProblemError(words, name="folder", value=str(path))
            begun = cls(path, function, version)
            with begun.alone():
                if not os.path.lexists(path / HEAD):
                    begun._begin()
            (path / "results").mkdir(exist_ok=True)
        found = cls.at(path)
        if found.function != function:
            words = f"{path} holds results of {found.function}, not of {function}; take another folder"
            raise ProblemError(words, name="folder", value=function, limit=found.function)
        if found.version != version and not found._keeps():
            with found.alone():  # a driver that is waited for may have written one
                if not found._keeps():
                    found = cls(path, function, version)
                    found._begin()
        if found.version != version:
            words = f"{path} holds results of version {found.version!r} of {function}, this is {version!r}; "
            words += "take another folder" if chosen else "its source has changed: take another folder, or, where the "
            words += "" if chosen else f"results would be the same, say version={found.version!r}"
            raise ProblemError(words, name="version", value=version, limit=found.version)
        return found

    def _begin(self) -> None:
        text = json.dumps({"format": FORMAT, "function": self.function, "version": self.version}, indent=1).encode()
        write_whole(self.folder / HEAD, lambda stream: stream.write(text))

    def _keeps(self) -> bool:
        """Whether a result is there."""
        records = (self.read(key) for key in self.recorded())
        return any(record and record["status"] == "done" for record in records)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Inside, no other driver is at work in this folder; one that is so is waited for.

        Raises:
            ProblemError: The folder's file system has no locks.
            OSError: The folder cannot be written.
        """
        file = os.open(self.folder / LOCK, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o644)
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                LOG.warning("another driver is at work in %s: waiting for its end", self.folder)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise
                words = f"the file system of {self.folder} has no locks, which keep two drivers apart; take another"
                raise ProblemError(words, name="folder", value=str(self.folder)) from error
            yield
        finally:
            os.close(file)

    # ---- records -----------------------------------------------------------------------------------------------

    def read(self, key: str) -> dict[str, Any] | None:
        """The record of a key; None where there is none, or none that is whole; links are not followed."""
        try:
            place = self._place(key)
            record: Any = None if place.parent.is_symlink() else loaded(place)
            sound = record.keys() == PARTS.keys() and record["key"] == key == key_of(text_of(record["task"], "task"))
            sound = sound and all(isinstance(record[name], kind) for name, kind in PARTS.items())
            if not sound or record["status"] not in ENDS:
                return None
            for i, told in enumerate(record["files"]):
                with open_unlinked(file_at(place, i)) as stream:
                    if stream.seek(0, os.SEEK_END) != told["bytes"]:
                        return None
                    stream.seek(-22, os.SEEK_END)  # of a zip archive; it was not written to its end without
                    if stream.read(4) != END_RECORD:
                        return None
        except (FileNotFoundError, NotADirectoryError, ValueError, AttributeError, KeyError, TypeError, RecursionError):
            return None
        return dict(record)

    def write(self, record: dict[str, Any], files: Sequence[bytes]) -> None:
        """Keep a record, its files first, in the place of any link that is there.

        Raises:
            OSError: They cannot be written; none of them is there then in part.
        """
        place = self._place(record["key"])
        for link in (place.parent, place, *(file_at(place, i) for i in range(len(files)))):
            if os.path.islink(link):
                link.unlink()
        if not os.path.isdir(place.parent):
            place.parent.mkdir(parents=True, exist_ok=True)
        for i, file in enumerate(files):
            write_whole(file_at(place, i), lambda stream, file=file: stream.write(file), synced=False)  # type: ignore[misc]
        text = json.dumps(record, allow_nan=False).encode()
        write_whole(place, lambda stream: stream.write(text), synced=False)

    def parcel(self, record: dict[str, Any]) -> Parcel:
        """A record with its files.

        Raises:
            OSError: A file is gone. ProblemError: It is a link or larger than what is read.
        """
        files = []
        for i in range(len(record["files"])):
            with open_unlinked(file_at(self._place(record["key"]), i)) as stream:
                files.append(stream.read())
        return Parcel(record, tuple(files))

    def value(self, record: dict[str, Any]) -> Any:
        """What the function had returned."""
        return unpacked(self.parcel(record))

    def recorded(self) -> Iterator[str]:
        """Keys of all records, in order."""
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
    """The data of a file of JSON, whose numbers are finite."""
    with open_unlinked(path) as stream:
        return json.loads(stream.read(), parse_float=finite, parse_constant=finite)


def finite(text: str) -> float:
    if not isfinite(value := float(text)):
        raise ValueError(f"{text} is no finite number")
    return value


def file_at(place: Path, number: int) -> Path:
    return place.with_suffix(f".{number}.npz")


def checked_folder(folder: Any) -> Path:
    """A folder's whole path; it need not be there.

    Raises:
        ProblemError: It is no path, or that of a file or of a store that is no folder.
    """
    path = Path(checked_path(folder))
    text = os.fspath(folder)
    if not isinstance(text, str) or not text or "\0" in text:
        raise ProblemError(f"folder: {folder!r} is no path", name="folder", value=folder)
    if "://" in text:
        words = f"folder: {text} is no folder of this machine; results come to the driver, no store has to be shared"
        raise ProblemError(words, name="folder", value=text)
    if any(place.is_file() for place in (path, *path.parents)):
        raise ProblemError(f"folder: {path} is no folder", name="folder", value=str(path))
    return path.absolute()
