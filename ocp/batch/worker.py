"""What a worker does: find the function, call it with one task after the other, send back what came of each."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import json
import os
import random
import socket
import struct
import sys
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np

from models.errors import ModelError
from ocp.batch.content import Parcel, digest_of, packed, text_of, unpacked
from ocp.errors import Detailed, ProblemError

__all__ = [
    "REQUEST",
    "UNKNOWN",
    "Broken",
    "Function",
    "attempt",
    "failed",
    "function_at",
    "kept",
    "loading",
    "receive",
    "send",
    "serve",
]

Function = Callable[..., Any]
MAIN = "__batch_main__"
"""The name under which a worker has the script that its driver was started with."""
MOST_KEPT = 8
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""What is wrong with a machine, and says nothing of the task that met it."""


class Broken(OSError):
    """A task came to no end for a reason that is not its own: a disk is full."""


# ---- one task ----------------------------------------------------------------------------------------------------

_ONE = threading.RLock()
"""Threads of one worker, as Dask may have, take turns: casadi's expressions are not made by two at a time."""


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


# ---- a process of its own ----------------------------------------------------------------------------------------

_LOADING = threading.Event()


def loading() -> bool:
    """Whether this process is a worker that looks for its function: a script that begins a batch then has no guard."""
    return _LOADING.is_set()


def function_at(module: str, name: str, file: str | None) -> Function:
    """The function of a module by its name, the module by its name or, a script, by its file."""
    _LOADING.set()
    try:
        if file is None:
            found: Any = importlib.import_module(module)
        else:
            spec = importlib.util.spec_from_file_location(MAIN, file)
            if spec is None or spec.loader is None:
                raise ImportError(f"{file} is no Python source")
            found = sys.modules[MAIN] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(found)
        for part in name.split("."):
            found = getattr(found, part)
    finally:
        _LOADING.clear()
    return found  # type: ignore[no-any-return]


def send(connection: Connection, told: dict[str, Any], files: tuple[bytes, ...] = ()) -> None:
    """A text and files through a pipe."""
    connection.send_bytes(json.dumps([told, len(files)]).encode())
    for file in files:
        connection.send_bytes(file)


def receive(connection: Connection) -> Parcel:
    """What :func:`send` sent; EOFError where the other is gone."""
    told, count = json.loads(connection.recv_bytes())
    return Parcel(told, tuple(connection.recv_bytes() for _ in range(count)))


REQUEST = struct.Struct("=cq")
"""To the process that forks workers: ``w`` with a pipe begins one, ``s`` asks how the one of a number ended."""
UNKNOWN = 1000
"""Status of a worker that was begun by another process."""


def serve(control: int, life: int, module: str, name: str, file: str | None) -> None:
    """Load the function once, and fork a worker for each pipe that the driver sends, until the driver is gone.

    Nothing runs here but this, no thread either: what is forked is as if it had just been loaded.

    Args:
        control: File descriptor of a socket; a line of JSON goes back for each request, and one to begin with.
        life: One of a pipe that ends with the driver. module, name, file: Where the function is.
    """
    for descriptor in (control, life):
        os.set_inheritable(descriptor, False)
    with socket.socket(fileno=control) as line:

        def answer(told: Any) -> None:
            line.sendall(json.dumps(told).encode() + b"\n")

        try:
            function = function_at(module, name, file)
        except BaseException as error:  # of any kind: it is the driver that says it
            answer(f"{type(error).__name__}: {error}")
            return
        answer("")
        while True:
            request, pipes, _, _ = socket.recv_fds(line, REQUEST.size, 1)
            if len(request) < REQUEST.size:
                return
            kind, number = REQUEST.unpack(request)
            if kind == b"s":
                try:
                    answer(os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]))
                except ChildProcessError:
                    answer(UNKNOWN)
                continue
            process = os.fork()
            if not process:
                line.close()
                work(pipes[0], life, function)
            for pipe in pipes:
                os.close(pipe)
            answer(process)


def work(pipe: int, life: int, function: Function) -> NoReturn:
    """Do the driver's tasks, until it closes the pipe or is gone."""
    os.setsid()  # what a task starts ends with it
    os.set_inheritable(pipe, False)
    random.seed()  # or all workers would draw the same
    np.random.seed()  # noqa: NPY002
    threading.Thread(target=end_with, args=(life,), daemon=True).start()
    with Connection(pipe) as connection:
        os.register_at_fork(after_in_child=connection.close)  # or what a task forks would hide that this has ended
        while True:
            try:
                asked = receive(connection)
                guess = None if asked.record["guess"] is None else Parcel(asked.record["guess"], asked.files)
                try:
                    found = attempt(function, asked.record["task"], asked.record["near"], guess)
                except Broken as error:
                    found = Parcel({"broken": [error.errno, error.strerror]})
                with suppress(Exception):
                    sys.stdout.flush()
                    sys.stderr.flush()
                send(connection, found.record, found.files)
            except (EOFError, OSError):
                os._exit(0)


def end_with(life: int) -> None:
    """End this process when the other end of a pipe is closed, whatever it is at."""
    os.read(life, 1)
    os._exit(1)
