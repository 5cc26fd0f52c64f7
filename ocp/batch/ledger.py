"""The folder of a batch: what it is of, and one record for each task that has come to its end.

    batch.json              the function, its version, the format
    results/ab/KEY.json     a record: task, status, value, cost, verdict, seconds, message
    results/ab/KEY.0.npz    plans and solutions of its value
    claims/, owners/, lock  who is at what (`ocp.batch.claims`)

Files are there whole or not at all. They are not waited for to reach the disk: after a loss of power the last of them
may be empty or cut short, which is seen, and counts as missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from ocp.batch.claims import locked
from ocp.batch.content import Parcel, key_of, text_of, unpacked
from ocp.errors import ProblemError
from ocp.storage import END, checked_path, write_whole

__all__ = ["Ledger"]

FORMAT = 1
HEAD = "batch.json"
OWN = {HEAD, "results", "claims", "owners", "lock"}
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
        try:
            head = json.loads((path / HEAD).read_text(encoding="utf-8"))
            found = cls(path, str(head["function"]), str(head["version"]))
            if head["format"] != FORMAT:
                words = f"{path} was written in format {head['format']} of batches, not {FORMAT}; take another folder"
                raise ProblemError(words, name="folder", value=str(path), limit=FORMAT)
        except (FileNotFoundError, NotADirectoryError):
            words = f"{path} is no folder of a batch: there is no {HEAD} in it"
            raise ProblemError(words, name="folder", value=str(path)) from None
        except (ValueError, KeyError, TypeError) as error:
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
            ProblemError: The folder is another function's, another version's, or nobody's and not empty.
            OSError: It cannot be made.
        """
        path = checked_folder(folder)
        if not (path / HEAD).exists():
            path.mkdir(parents=True, exist_ok=True)
            strange = sorted(set(os.listdir(path)) - OWN)
            if strange:
                words = f"{path} holds {strange[0]!r} and is no folder of a batch; take a new or an empty one"
                raise ProblemError(words, name="folder", value=str(path))
            with locked(path / "lock"):
                if not (path / HEAD).exists():
                    head = {"format": FORMAT, "function": function, "version": version}
                    text = json.dumps(head, indent=1).encode()
                    write_whole(path / HEAD, lambda stream: stream.write(text))
            (path / "results").mkdir(exist_ok=True)
        found = cls.at(path)
        if found.function != function:
            words = f"{path} holds results of {found.function}, not of {function}; take another folder"
            raise ProblemError(words, name="folder", value=function, limit=found.function)
        if found.version != version:
            words = f"{path} holds results of version {found.version!r} of {function}, this is {version!r}; "
            words += "take another folder" if chosen else "its source has changed: take another folder, or, where the "
            words += "" if chosen else f"results would be the same, say version={found.version!r}"
            raise ProblemError(words, name="version", value=version, limit=found.version)
        return found

    # ---- records -----------------------------------------------------------------------------------------------

    def read(self, key: str) -> dict[str, Any] | None:
        """The record of a key; None where there is none, or none that is whole."""
        place = self._place(key)
        try:
            record = json.loads(place.read_bytes())
            sound = record.keys() == PARTS.keys() and record["key"] == key == key_of(text_of(record["task"], "task"))
            if not sound or not all(isinstance(record[name], kind) for name, kind in PARTS.items()):
                return None
            for i, told in enumerate(record["files"]):
                with open(file_at(place, i), "rb") as stream:
                    if stream.seek(0, os.SEEK_END) != told["bytes"]:
                        return None
                    stream.seek(-22, os.SEEK_END)  # of a zip archive; it was not written to its end without
                    if stream.read(4) != END:
                        return None
        except (FileNotFoundError, ValueError, AttributeError, KeyError, TypeError):
            return None
        return dict(record)

    def write(self, record: dict[str, Any], files: Iterable[bytes]) -> None:
        """Keep a record, its files first.

        Raises:
            OSError: They cannot be written; none of them is there then in part.
        """
        place = self._place(record["key"])
        place.parent.mkdir(parents=True, exist_ok=True)
        for i, file in enumerate(files):
            write_whole(file_at(place, i), lambda stream, file=file: stream.write(file), synced=False)  # type: ignore[misc]
        text = json.dumps(record, allow_nan=False).encode()
        write_whole(place, lambda stream: stream.write(text), synced=False)

    def parcel(self, record: dict[str, Any]) -> Parcel:
        """A record with its files."""
        place = self._place(record["key"])
        return Parcel(record, tuple(file_at(place, i).read_bytes() for i in range(len(record["files"]))))

    def value(self, record: dict[str, Any]) -> Any:
        """What the function had returned."""
        return unpacked(self.parcel(record))

    def recorded(self) -> Iterator[str]:
        """Keys of all records, in order."""
        with suppress(FileNotFoundError):
            for shard in sorted(os.listdir(self.folder / "results")):
                for name in sorted(os.listdir(self.folder / "results" / shard)):
                    if name.endswith(".json"):
                        yield name.removesuffix(".json")

    def _place(self, key: str) -> Path:
        return self.folder / "results" / key[:2] / f"{key}.json"


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
