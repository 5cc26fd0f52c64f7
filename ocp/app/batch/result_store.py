"""Store the results of a batch as data in a folder: one record for each finished task.

    batch.json              the function, its version, the format
    results/ab/KEY.json     a record: task, status, value, cost, verdict, seconds, message
    results/ab/KEY.0.npz    plans and solutions of its value
    lock                    held by the driver, the process that runs the batch, until it ends for any reason

Data are numbers, texts, True, False, None, and lists and dictionaries of these, with names as keys. The canonical text
of a task gives its key. Nothing is pickled. Files are complete or absent, but not synchronised to the disk: a loss of
power may truncate the last ones, which is detected and counts as missing.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from models.files import INPUT_LIMITS
from ocp.console import LOG
from ocp.errors import ProblemError, SolveError
from ocp.motion.plan import Plan
from ocp.solution import Solution
from ocp.storage import END_RECORD, checked_path, open_unlinked, write_whole

MAX_DEPTH = 64
"""Largest permitted nesting depth of the lists and dictionaries in tasks and results."""
KINDS: dict[str, type[Plan] | type[Solution]] = {"Plan": Plan, "Solution": Solution}
"""Types of objects that are stored in files of their own, keyed by the name of the type in a record."""
DATA = "numbers, texts, True, False, None, and lists and dictionaries by name of these"


class Payload(NamedTuple):
    """Result of a task in the form in which workers send it: a record of plain data, and the contents of its files."""

    record: dict[str, Any]
    files: tuple[bytes, ...] = ()


def as_data(value: Any, where: str, extract: Callable[[Any, tuple[Any, ...]], bool] = lambda value, at: False) -> Any:
    """Convert a value to plain data: arrays and tuples become lists, NumPy numbers become Python numbers.

    `where` names the value in messages: ``task``, then ``task['x'][2]``. `extract` says of a nested value and its place
    (names and indices) whether to replace it by None.

    Raises:
        ProblemError: The value contains something that is not data, or a number that is not finite; names the place.
    """

    def walk(value: Any, at: tuple[Any, ...]) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            if value.size > INPUT_LIMITS.array_entries:
                raise refusal(at, value, f"has {value.size} numbers; at most {INPUT_LIMITS.array_entries} are allowed")
            value = value.tolist()
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, int):
            return int(value)
        if isinstance(value, float):
            if not isfinite(value):
                raise refusal(at, value, f"is {value}, not a finite number; omit it, or give None")
            return float(value)
        if isinstance(value, str):
            try:
                value.encode()
            except UnicodeEncodeError as error:
                raise refusal(at, value, "has half of a surrogate pair, which no file can contain") from error
            return str(value)
        if extract(value, at):
            return None
        if len(at) >= MAX_DEPTH:
            raise refusal(at[:2], value, f"is nested more than {MAX_DEPTH} deep, or contains itself")
        if isinstance(value, list | tuple):
            return [walk(part, (*at, i)) for i, part in enumerate(value)]
        if isinstance(value, Mapping):
            for name in value:
                if not isinstance(name, str):
                    raise refusal(at, value, f"has the name {name!r}; names must be texts")
            return {str(walk(name, at)): walk(part, (*at, name)) for name, part in value.items()}
        raise refusal(at, value, f"is a {type(value).__name__}, which is not data; data are {DATA}")

    def refusal(at: tuple[Any, ...], value: Any, problem: str) -> ProblemError:
        name = where + "".join(f"[{part!r}]" for part in at)
        return ProblemError(f"{name} {problem}", name=name, value=value)

    return walk(value, ())


def canonical_text(value: Any, where: str) -> str:
    """Return the same JSON text for equal data: names are sorted, floats have all digits, and 1 differs from 1.0."""
    data = as_data(value, where)
    try:
        return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:  # an integer with more digits than Python writes
        raise ProblemError(f"{where} cannot be written: {error}", name=where) from error


def key_of(text: str) -> str:
    """Return the key of a task: the first 32 hexadecimal digits of the SHA-256 hash of the task's JSON text."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def pack_result(value: Any) -> Payload:
    """Convert the value that a function returned for a task to a `Payload`, with the cost and verdict of the value.

    The cost is that of a plan or solution, the ``"cost"`` of a dictionary or that of the only plan in it, or the number
    itself. The verdict is the ``"verdict"`` of a dictionary, or whether the audit of the only plan passes; otherwise
    None. A result that is not data, or contains nan, raises ProblemError.
    """
    objects: list[tuple[Any, list[Any]]] = []

    def extract(part: Any, at: tuple[Any, ...]) -> bool:
        is_object = isinstance(part, Plan | Solution)
        if is_object:
            objects.append((part, list(at)))
        return is_object

    data = as_data(value, "the result", extract)
    entries = data if isinstance(data, dict) else {}
    only_object = objects[0][0] if len(objects) == 1 else None
    cost = entries.get("cost", data if only_object is None else only_object.cost)
    if isinstance(cost, bool) or not isinstance(cost, int | float):
        cost = None
    verdict = entries.get("verdict")
    if verdict is None and isinstance(only_object, Plan):
        verdict = bool(only_object.audit().passed)
    files = tuple(file_of(part) for part, _ in objects)
    kinds = [
        {"kind": "Plan" if isinstance(part, Plan) else "Solution", "at": at, "bytes": len(file)}
        for (part, at), file in zip(objects, files, strict=True)
    ]
    summary = {"cost": None if cost is None else as_data(float(cost), "the result's cost"), "verdict": verdict}
    return Payload({**summary, "value": data, "files": kinds}, files)


def unpack_result(payload: Payload) -> Any:
    """Convert a `Payload` back to the value from which it was packed; raise ProblemError if a file is damaged."""
    value = json.loads(json.dumps(payload.record["value"]))
    try:
        for entry, file in zip(payload.record["files"], payload.files, strict=True):
            kind, at = KINDS[entry["kind"]], entry["at"]
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "result.npz"
                path.write_bytes(file)
                loaded = kind.load(path)
            if not at:
                return loaded
            container = value
            for key in at[:-1]:
                container = container[key]
            container[at[-1]] = loaded
    except (KeyError, IndexError, TypeError) as error:
        words = f"the result {payload.record.get('key')} is damaged: its files do not fit its text: {error!r}"
        raise ProblemError(words, name="files", value=payload.record["files"]) from error
    return value


def digest_of(path: str) -> str | None:
    """Return the SHA-256 digest of a file's contents, or None if the file cannot be read."""
    try:
        with open_unlinked(os.path.realpath(path)) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError):
        return None


def file_of(value: Plan | Solution) -> bytes:
    """Save a plan or solution to a temporary file and return the contents of the file."""
    with tempfile.TemporaryDirectory() as folder:
        value.save(Path(folder) / "result.npz")
        return (Path(folder) / "result.npz").read_bytes()


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
"""Names and types of the fields in the record of a task's result."""


class ResultStore:
    """Folder that stores the results of one version of one function, one record for each task."""

    def __init__(self, folder: Path, function: str, version: str) -> None:
        self.folder, self.function, self.version = folder, function, version

    @classmethod
    def at(cls, folder: Any) -> ResultStore:
        """Return the existing store of results in a folder; raise ProblemError if it has no store of this format."""
        path = checked_folder(folder)
        for link in (path / name for name in sorted(OWN_NAMES) if (path / name).is_symlink()):
            words = f"{link} is a link and may lead out of the folder; link the whole folder instead"
            raise ProblemError(words, name="folder", value=str(link))
        try:
            head = load_json(path / HEAD)
            store, batch_format = cls(path, str(head["function"]), str(head["version"])), head["format"]
        except (FileNotFoundError, NotADirectoryError):
            words = f"{path} is not the folder of a batch: it has no {HEAD}"
            raise ProblemError(words, name="folder", value=str(path)) from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            words = f"{path / HEAD} is damaged: {error!r}; use another folder"
            raise ProblemError(words, name="folder", value=str(path)) from error
        if batch_format != FORMAT:
            words = f"{path} has batch format {batch_format}, not {FORMAT}; use another folder"
            raise ProblemError(words, name="folder", value=str(path), limit=FORMAT)
        return store

    @classmethod
    def of(cls, folder: Any, function: str, version: str, chosen: bool) -> ResultStore:
        """Return the store for the results of a function in a folder; create the store if the folder is new or empty.

        `chosen` says whether the user chose the version; else it is that of the source.

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
        """Write the header file of the store, which names the function and its version."""
        text = json.dumps({"format": FORMAT, "function": self.function, "version": self.version}, indent=1).encode()
        write_whole(self.folder / HEAD, lambda stream: stream.write(text))

    def _has_result(self) -> bool:
        """Return whether the store has the result of at least one task that succeeded."""
        return any(record and record["status"] == "done" for record in (self.read(key) for key in self.stored_keys()))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder during a `with` block; if another process holds the lock, wait until it is released."""
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
        """Return the stored record with a key; None if it is missing, incomplete or reached by a symbolic link."""
        try:
            path = self._place(key)
            record: Any = None if path.parent.is_symlink() else load_json(path)
            own_key = key_of(canonical_text(record["task"], "task"))
            is_valid = record.keys() == RECORD_FIELDS.keys() and record["key"] == key == own_key
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
        """Write the files of a record and then the record; replace symbolic links that are at their paths."""
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
        """Return all data of one result: its record and the contents of the files that belong to it."""
        files = []
        for i in range(len(record["files"])):
            with open_unlinked(file_at(self._place(record["key"]), i)) as stream:
                files.append(stream.read())
        return Payload(record, tuple(files))

    def value(self, record: dict[str, Any]) -> Any:
        """Return the result of a task, given its record, with the plans and solutions that are stored in its files."""
        return unpack_result(self.payload(record))

    def stored_keys(self) -> Iterator[str]:
        """Yield the keys of all stored records in sorted order."""
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


def load_json(path: Path) -> Any:
    """Read a JSON file; raise ValueError if a number is not finite."""
    with open_unlinked(path) as stream:
        return json.loads(stream.read(), parse_float=finite, parse_constant=finite)


def finite(text: str) -> float:
    """Convert the text of a number to a float; raise ValueError unless the float is finite."""
    if not isfinite(value := float(text)):
        raise ValueError(f"{text} is not a finite number")
    return value


def file_at(place: Path, number: int) -> Path:
    """Return the path of a stored plan or solution, from the path of the record and the file's index in it."""
    return place.with_suffix(f".{number}.npz")


def checked_folder(folder: Any) -> Path:
    """Return a folder's absolute path, which need not exist; raise ProblemError if it is a file or a remote store."""
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


# ---- results -----------------------------------------------------------------------------------------------------

COLUMNS = ("key", "status", "cost", "verdict", "seconds", "error", "message")


@dataclass(frozen=True)
class Result:
    """Result of one task of a batch.

    Attributes:
        key: Name of the result in the folder.
        task: The task.
        status: ``done``; ``failed``: the function raised an exception, or returned nan or something that is not data;
            ``killed``: the task ended at least three workers.
        cost, verdict: Values that the function returned, or those of the plan that it returned; otherwise None.
        seconds: Wall time of the call.
        error, message: Name and text of the exception; "" if done.
        neighbour: Key of the task whose result was the guess, or None.
    """

    key: str
    task: Any
    status: str
    cost: float | None
    verdict: Any
    seconds: float
    error: str
    message: str
    neighbour: str | None
    scalars: Mapping[str, Any] = field(repr=False)
    _store: ResultStore = field(repr=False, compare=False)

    @property
    def value(self) -> Any:
        """Value that the function returned, read from the folder; arrays and tuples are lists, plans are `Plan`
        objects.

        Raises:
            SolveError: The task is not done; gives the reason.
            ProblemError: The record is missing or damaged.
        """
        if self.status != "done":
            words = f"task {self.task!r} {self.status}: {self.error} {self.message}"
            raise SolveError(words, name="task", value=self.task)
        record = self._store.read(self.key)
        if record is None:
            words = f"the result {self.key} in {self._store.folder} is missing or damaged; run the batch again"
            raise ProblemError(words, name="key", value=self.key)
        return self._store.value(record)

    def row(self) -> dict[str, Any]:
        """Return the result as a table row with the columns ``COLUMNS``, ``task.NAME`` for the entries of the task, and
        ``result.NAME`` for the entries of the value.

        Longer entries of a task are given as JSON.
        """
        row: dict[str, Any] = {name: getattr(self, name) for name in COLUMNS}
        row["verdict"] = scalar(self.verdict)
        parts = self.task if isinstance(self.task, dict) else {"": self.task}
        row |= {f"task.{name}" if name else "task": scalar(value) for name, value in parts.items()}
        return row | {f"result.{name}": value for name, value in self.scalars.items()}


def row_of(record: Mapping[str, Any], store: ResultStore) -> Result:
    """Return the Result that a stored record describes."""
    value = record["value"]
    entries = value if isinstance(value, dict) else {}
    scalars = {name: entry for name, entry in entries.items() if isinstance(entry, str | int | float)}
    names = ("key", "task", "status", "cost", "verdict", "seconds", "error", "message", "neighbour")
    return Result(**{name: record[name] for name in names}, scalars=scalars, _store=store)


def scalar(value: Any) -> Any:
    """Return a value as the content of a table cell: texts and numbers unchanged, other data as JSON."""
    return value if value is None or isinstance(value, str | int | float) else json.dumps(value, ensure_ascii=False)
