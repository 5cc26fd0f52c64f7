"""Tasks and results as data: one text for one content, and the key that is made of it.

Data are numbers, texts, True, False, None, and lists and dictionaries by name of these. Plans and solutions that stand
in a result are files of their own beside its text, in the formats of the library. Nothing is pickled.

Which task begins from whose result: a tree of neighbours that the tasks alone decide.

Tasks are put into an order that looks random, that of their keys, and parted in generations of 1, 1, 2, 4, 8 ...; a
task's neighbour is the nearest of all generations before its own. So neighbours come nearer as the tasks get denser,
a generation may be done side by side, no chain is longer than log2 of the number of tasks, and the same tasks have the
same neighbours whoever does them in whatever order.
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

from models.arrays import Array
from models.input_files import INPUT_LIMITS
from ocp.errors import NOT_NUMBERS, ProblemError, floats
from ocp.motion.plan import Plan
from ocp.solution import Solution
from ocp.storage import open_unlinked

__all__ = ["Payload", "as_data", "canonical_text", "digest_of", "key_of", "neighbours", "pack_result", "unpack_result"]

DEEPEST = 64
"""Of data within data."""
KINDS: dict[str, type[Plan] | type[Solution]] = {"Plan": Plan, "Solution": Solution}
"""What is kept as a file of its own, by the name that a result's text tells."""
DATA = "numbers, texts, True, False, None, and lists and dictionaries by name of these"


class Payload(NamedTuple):
    """A result on its way: what its text says, and the bytes of its files."""

    record: dict[str, Any]
    files: tuple[bytes, ...] = ()


def as_data(value: Any, where: str, keep: Callable[[Any, tuple[Any, ...]], bool] = lambda value, at: False) -> Any:
    """A value as data of its own: arrays and tuples as lists, numbers of numpy as Python's.

    Args:
        where: How it is called, for messages: ``task``, then ``task['x'][2]``.
        keep: Whether a value inside, at a place (names and indices), is taken out; None stands in its stead.

    Raises:
        ProblemError: Something in it is no data, or no finite number; names where.
    """

    def walk(value: Any, at: tuple[Any, ...]) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            if value.size > INPUT_LIMITS.array_entries:
                raise wrong(at, value, f"has {value.size} numbers, at most {INPUT_LIMITS.array_entries} are read")
            value = value.tolist()
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, int):
            return int(value)
        if isinstance(value, float):
            if not isfinite(value):
                raise wrong(at, value, f"is {value}, no finite number; leave it out, or give None")
            return float(value)
        if isinstance(value, str):
            try:
                value.encode()
            except UnicodeEncodeError as error:
                raise wrong(at, value, "has half a character, which no file can hold") from error
            return str(value)
        if keep(value, at):
            return None
        if len(at) >= DEEPEST:
            raise wrong(at[:2], value, f"is deeper than {DEEPEST}, or holds itself")
        if isinstance(value, list | tuple):
            return [walk(part, (*at, i)) for i, part in enumerate(value)]
        if isinstance(value, Mapping):
            for name in value:
                if not isinstance(name, str):
                    raise wrong(at, value, f"has the name {name!r}, no text; names are texts")
            return {str(walk(name, at)): walk(part, (*at, name)) for name, part in value.items()}
        raise wrong(at, value, f"is a {type(value).__name__}, no data; data are {DATA}")

    def wrong(at: tuple[Any, ...], value: Any, words: str) -> ProblemError:
        name = where + "".join(f"[{part!r}]" for part in at)
        return ProblemError(f"{name} {words}", name=name, value=value)

    return walk(value, ())


def canonical_text(value: Any, where: str) -> str:
    """The one text of data: the order of names does not count, 1 and 1.0 are two, every digit of a float does.

    Raises:
        ProblemError: As :func:`as_data`.
    """
    try:
        return json.dumps(as_data(value, where), sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ProblemError:
        raise
    except ValueError as error:  # an integer of more digits than Python writes
        raise ProblemError(f"{where} cannot be written: {error}", name=where) from error


def key_of(text: str) -> str:
    """The name under which the result of a task of this text is kept: 32 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def pack_result(value: Any) -> Payload:
    """What a function returned, with its cost and its verdict.

    Cost: of a plan or a solution its own, of a dictionary its ``"cost"`` or that of the only plan in it, and a single
    number. Verdict: of a dictionary its ``"verdict"``, of a plan whether its audit passes; None where nobody says.

    Raises:
        ProblemError: It is no data, or holds nan.
        OSError: There is no room for temporary files.
    """
    found: list[tuple[Any, list[Any]]] = []

    def keep(part: Any, at: tuple[Any, ...]) -> bool:
        cached = isinstance(part, Plan | Solution)
        if cached:
            found.append((part, list(at)))
        return cached

    data = as_data(value, "the result", keep)
    named = data if isinstance(data, dict) else {}
    only = found[0][0] if len(found) == 1 else None
    cost = named.get("cost", data if only is None else only.cost)
    if isinstance(cost, bool) or not isinstance(cost, int | float):
        cost = None
    verdict = named.get("verdict")
    if verdict is None and isinstance(only, Plan):
        verdict = bool(only.audit().passed)
    files = tuple(file_of(part) for part, _ in found)
    kinds = [
        {"kind": "Plan" if isinstance(part, Plan) else "Solution", "at": at, "bytes": len(file)}
        for (part, at), file in zip(found, files, strict=True)
    ]
    told = {"cost": None if cost is None else as_data(float(cost), "the result's cost"), "verdict": verdict}
    return Payload({**told, "value": data, "files": kinds}, files)


def unpack_result(parcel: Payload) -> Any:
    """What the function had returned, of what :func:`pack_result` made; tuples and arrays are lists.

    Raises:
        ProblemError: A file is damaged.
        OSError: There is no room for temporary files.
    """
    value = json.loads(json.dumps(parcel.record["value"]))
    try:
        for told, file in zip(parcel.record["files"], parcel.files, strict=True):
            kind, at = KINDS[told["kind"]], told["at"]
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "result.npz"
                path.write_bytes(file)
                made = kind.load(path)
            if not at:
                return made
            place = value
            for part in at[:-1]:
                place = place[part]
            place[at[-1]] = made
    except (KeyError, IndexError, TypeError) as error:
        words = f"the result {parcel.record.get('key')} is damaged: its files have no place in it: {error!r}"
        raise ProblemError(words, name="files", value=parcel.record["files"]) from error
    return value


def digest_of(path: str) -> str | None:
    """The digest of what a file holds; None where there is no file of that name that can be read."""
    try:
        with open_unlinked(os.path.realpath(path)) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError):
        return None


def file_of(value: Plan | Solution) -> bytes:
    """The bytes of the file that `save` writes."""
    with tempfile.TemporaryDirectory() as folder:
        value.save(Path(folder) / "result.npz")
        return (Path(folder) / "result.npz").read_bytes()


def neighbours(tasks: Mapping[str, Any], names: Sequence[str]) -> dict[str, str | None]:
    """The neighbour's key of every key, in an order in which neighbours come first; None of the first.

    Args:
        tasks: By key.
        names: Of the numbers (or lists of numbers) in the tasks by which they are near. Each is divided by its range.

    Raises:
        ProblemError: A task has no such numbers, or not as many as the others; names it.
    """
    order = sorted(tasks)
    each = [coordinates_of(tasks[key], names) for key in order]
    for key, place in zip(order, each, strict=True):
        if len(place) != len(each[0]):
            words = f"near: {len(place)} numbers in the task {tasks[key]!r}, {len(each[0])} in another"
            raise ProblemError(words, name="near", value=len(place), limit=len(each[0]))
    places = np.array(each)
    spread = np.ptp(places, axis=0) if order else np.ones(0)
    places = places / np.where(spread > 0, spread, 1.0)
    found: dict[str, str | None] = {}
    begin, end = 0, 1
    while begin < len(order):
        keys = order[begin:end]
        if begin:
            nearest = cKDTree(places[:begin]).query(places[begin:end])[1]
            found |= {key: order[int(i)] for key, i in zip(keys, nearest, strict=True)}
        else:
            found |= dict.fromkeys(keys)
        begin, end = end, 2 * end
    return found


def coordinates_of(task: Any, names: Sequence[str]) -> Array:
    """The numbers of a task by which it is near to others. Shape (n,)."""
    parts = []
    for name in names:
        value = task.get(name) if isinstance(task, Mapping) else None
        try:
            part = floats(value).ravel()
        except NOT_NUMBERS as error:
            words = f"near: {name!r} is no number and no list of numbers in the task {task!r}"
            raise ProblemError(words, name=name, value=value) from error
        parts.append(part)
    return np.concatenate(parts) if parts else np.zeros(0)
