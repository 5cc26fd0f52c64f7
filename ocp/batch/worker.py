"""What a worker does: call the function with one task after the other, and tell what came of each."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from models.errors import ModelError
from ocp.batch.content import Parcel, digest_of, packed, text_of, unpacked
from ocp.errors import Detailed, ProblemError

__all__ = ["Broken", "Function", "attempt", "attempts", "failed", "kept"]

Function = Callable[..., Any]
MOST_KEPT = 8
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""What is wrong with a machine, and says nothing of the task that met it."""


class Broken(OSError):
    """A task came to no end for a reason that is not its own: a disk is full."""


# ---- one task ----------------------------------------------------------------------------------------------------

_ONE = threading.RLock()
"""Threads of one worker, as Dask may have, take turns: casadi's expressions are not made by two at a time."""


def attempts(function: Function, jobs: list[tuple[str, Parcel | None]], near: bool, most: float) -> list[Parcel]:
    """:func:`attempt` of one task after the other, each with its neighbour's result; as many as begin in ``most`` s."""
    began, found = time.perf_counter(), list[Parcel]()
    for task, guess in jobs:
        found.append(attempt(function, task, near, guess))
        if time.perf_counter() - began > most:
            break
    return found


def attempt(function: Function, task: str, near: bool, guess: Parcel | None) -> Parcel:
    """Call the function with a task, by its text, and with its neighbour's result where results are `near`.

    Returns:
        The result, or of whatever the function raises its name and its message.

    Raises:
        Broken: There is no room on the disk.
    """
    with _ONE:
        began = time.perf_counter()
        _INPUTS.clear()
        try:
            given = (json.loads(task), None if guess is None else unpacked(guess)) if near else (json.loads(task),)
            try:
                found = packed(function(*given))
            except BaseException as error:  # of any kind: the others go on
                if isinstance(error, OSError) and error.errno in FULL:
                    raise
                found = failed("failed", type(error).__name__, message_of(error))
            else:
                found = Parcel({"status": "done", "error": "", "message": "", **found.record}, found.files)
        except OSError as error:
            raise Broken(error.errno, error.strerror or str(error), error.filename) from error
        told = {"seconds": time.perf_counter() - began, "inputs": {"kept": dict(_INPUTS)}}
        return Parcel({**found.record, **told}, found.files)


def failed(status: str, error: str, message: str) -> Parcel:
    """The record of a task without a result."""
    empty: dict[str, Any] = {"value": None, "files": [], "cost": None, "verdict": None, "seconds": 0.0}
    empty["inputs"] = {"kept": {}}
    return Parcel({"status": status, "error": error, "message": message, **empty})


def message_of(error: BaseException) -> str:
    """Its message; of what is no error of the package, which may be a mistake in the function, with its place."""
    words = str(error).encode("utf-8", "replace").decode()
    if isinstance(error, Detailed | ModelError):
        return words
    steps = [step for step in traceback.extract_tb(error.__traceback__) if step.filename != __file__]
    place = f" ({os.path.basename(steps[-1].filename)}, line {steps[-1].lineno})" if steps else ""
    return f"{words}{place}".strip()


# ---- what a worker keeps -----------------------------------------------------------------------------------------

_KEPT: OrderedDict[tuple[Any, str], tuple[Any, dict[str, str | None]]] = OrderedDict()
_INPUTS: dict[str, str | None] = {}
"""Of the task that is at hand: what was kept for it is made of, texts that may name files with the files' digests."""


def kept(make: Function, *arguments: Any) -> Any:
    """``make(*arguments)``, made once in each worker and kept: a prepared problem, a robot that is read from a file.

    The last eight are kept. Arguments are data as tasks are, and what is made is the same for the same content. Where
    an argument names a file, a task that fails is tried again when the batch is started with another content of it.

    Raises:
        ProblemError: make is no function, an argument no data, or make raises an error that is none of the package.
    """
    if not callable(make):
        raise ProblemError(f"make must be a function, not {make!r}", name="make", value=make)
    code = getattr(make, "__code__", make)  # Dask brings a script's own function anew with each task
    own = make if getattr(make, "__closure__", None) or getattr(make, "__defaults__", None) else code
    key = (getattr(make, "__qualname__", ""), own), text_of(list(arguments), "arguments")
    with _ONE:
        if key not in _KEPT:
            inputs = {argument: digest_of(argument) for argument in arguments if isinstance(argument, str)}
            _INPUTS.update(inputs)
            try:
                _KEPT[key] = make(*arguments), inputs
            except Exception as error:
                if isinstance(error, Detailed | ModelError) or getattr(error, "errno", None) in FULL:
                    raise
                call = f"{key[0][0]}({', '.join(map(repr, arguments))})"
                words = f"kept: {call} raised {type(error).__name__}: {message_of(error)}"
                raise ProblemError(words, name="make", value=key[0][0]) from error
        _KEPT.move_to_end(key)
        while len(_KEPT) > MOST_KEPT:
            _KEPT.popitem(last=False)
        made, inputs = _KEPT[key]
        _INPUTS.update(inputs)
        return made
