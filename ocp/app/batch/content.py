"""Represent tasks and results as data with a canonical text and a key, and choose each task's neighbour.

Data are numbers, texts, True, False, None, and lists and dictionaries by name of these. Plans and solutions in a result
are stored in files of their own, in the formats of the library. Nothing is pickled.

The tasks alone determine from whose result a task starts. They are ordered by their keys, which looks random, and
divided into generations of 1, 1, 2, 4, 8, ... The neighbour of a task is the nearest task of all earlier generations.
Neighbours thus come closer as the tasks get denser, the tasks of one generation can run in parallel, no chain is longer
than log2 of the number of tasks, and the neighbours do not depend on who runs the tasks in which order.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from models.checks import NOT_NUMBERS, Array, floats
from models.files import INPUT_LIMITS
from ocp.errors import ProblemError
from ocp.motion.plan import Plan
from ocp.solution import Solution
from ocp.storage import open_unlinked

__all__ = ["Payload", "as_data", "canonical_text", "digest_of", "key_of", "neighbours", "pack_result", "unpack_result"]

MAX_DEPTH = 64
"""Largest depth of nested data."""
KINDS: dict[str, type[Plan] | type[Solution]] = {"Plan": Plan, "Solution": Solution}
"""Types stored in files of their own, by the name in a result's text."""
DATA = "numbers, texts, True, False, None, and lists and dictionaries by name of these"


class Payload(NamedTuple):
    """A result as transferred: the record and the bytes of its files."""

    record: dict[str, Any]
    files: tuple[bytes, ...] = ()


def as_data(value: Any, where: str, extract: Callable[[Any, tuple[Any, ...]], bool] = lambda value, at: False) -> Any:
    """Return a value as data: arrays and tuples as lists, numbers of numpy as Python's.

    Args:
        value: The value.
        where: Name of the value in messages: ``task``, then ``task['x'][2]``.
        extract: Whether a value inside, at a place (names and indices), is extracted; it is replaced by None.

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
    """Return the canonical text of data: names sorted, 1 and 1.0 distinct, floats with all digits.

    Raises:
        ProblemError: As :func:`as_data`.
    """
    try:
        return json.dumps(as_data(value, where), sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ProblemError:
        raise
    except ValueError as error:  # an integer with more digits than Python writes
        raise ProblemError(f"{where} cannot be written: {error}", name=where) from error


def key_of(text: str) -> str:
    """Return the key of a task's text: 32 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def pack_result(value: Any) -> Payload:
    """Return the payload of a function's result, with its cost and its verdict.

    The cost is that of a plan or solution, the ``"cost"`` of a dictionary or that of the only plan in it, or the number
    itself. The verdict is the ``"verdict"`` of a dictionary, or whether the audit of the only plan passes; otherwise
    None.

    Raises:
        ProblemError: The result is not data, or contains nan.
        OSError: There is no space for temporary files.
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
    """Return the result of a payload of :func:`pack_result`; tuples and arrays are lists.

    Raises:
        ProblemError: A file is damaged.
        OSError: There is no space for temporary files.
    """
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
    """Return the digest of a file's contents, or None if it cannot be read."""
    try:
        with open_unlinked(os.path.realpath(path)) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError):
        return None


def file_of(value: Plan | Solution) -> bytes:
    """Return the bytes of the file that `save` writes."""
    with tempfile.TemporaryDirectory() as folder:
        value.save(Path(folder) / "result.npz")
        return (Path(folder) / "result.npz").read_bytes()


def neighbours(tasks: Mapping[str, Any], names: Sequence[str]) -> dict[str, str | None]:
    """Return the key of each key's neighbour, in an order in which neighbours come first; None for the first key.

    Args:
        tasks: Tasks by key.
        names: Names of the numbers (or lists of numbers) in the tasks that span the space of the distance; each is
            divided by its range.

    Raises:
        ProblemError: A task lacks these numbers, or has not as many as the others; names the task.
    """
    order = sorted(tasks)
    rows = [coordinates_of(tasks[key], names) for key in order]
    for key, row in zip(order, rows, strict=True):
        if len(row) != len(rows[0]):
            words = f"near: {len(row)} numbers in the task {tasks[key]!r}, {len(rows[0])} in another"
            raise ProblemError(words, name="near", value=len(row), limit=len(rows[0]))
    points = np.array(rows)
    ranges = np.ptp(points, axis=0) if order else np.ones(0)
    points = points / np.where(ranges > 0, ranges, 1.0)
    parents: dict[str, str | None] = {}
    begin, end = 0, 1
    while begin < len(order):
        keys = order[begin:end]
        if begin:
            nearest = cKDTree(points[:begin]).query(points[begin:end])[1]
            parents |= {key: order[int(i)] for key, i in zip(keys, nearest, strict=True)}
        else:
            parents |= dict.fromkeys(keys)
        begin, end = end, 2 * end
    return parents


def coordinates_of(task: Any, names: Sequence[str]) -> Array:
    """Return the numbers of a task from which its distance to others is computed. Shape (n,)."""
    parts = []
    for name in names:
        value = task.get(name) if isinstance(task, Mapping) else None
        try:
            part = floats(value).ravel()
        except NOT_NUMBERS as error:
            words = f"near: {name!r} is not a number or list of numbers in the task {task!r}"
            raise ProblemError(words, name=name, value=value) from error
        parts.append(part)
    return np.concatenate(parts) if parts else np.zeros(0)
