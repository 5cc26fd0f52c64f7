"""What happens at the console while something is at work: Ctrl-C, time limits, progress, and CasADi's own words.

A public call is done in a thread of its own, for which the main thread waits: so Ctrl-C reaches Python at once,
whatever CasADi is at, and never CasADi itself, which would make a RuntimeError of it, to be caught as a breakdown.
"""

from __future__ import annotations

import contextvars
import ctypes
import io
import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import casadi as ca
import numpy as np
from tqdm import tqdm

from ocp.status import SolverStatus

__all__ = [
    "LOG",
    "FatropMonitor",
    "Progress",
    "TimeLimitReached",
    "casadi_silenced",
    "check_time",
    "interruptible",
    "reason_to_stop",
    "stop_requests_polled",
    "time_left",
    "time_limited",
]

LOG = logging.getLogger("ocp")
P = ParamSpec("P")
T = TypeVar("T")


GRACE = 0.8
"""s after Ctrl-C in which a call may end by itself, with what it has found; the caller has control within a second."""


# ---- Ctrl-C ------------------------------------------------------------------------------------------------------


class _Call(threading.Thread):
    """A public call under way.

    Attributes:
        stop: Whether it is asked to end.
        listeners: How many loops inside it look at ``stop`` and end by themselves. heard: Whether one has seen it.
    """

    def __init__(self, work: Callable[[], Any]) -> None:
        # no daemon: what CasADi is at when Python ends must come to its end before
        super().__init__(name="ocp", daemon=False)
        self.stop, self.heard, self.listeners = False, False, 0
        self.value: Any = None
        self.error: BaseException | None = None
        self._work, self._context = work, contextvars.copy_context()
        self._leaving = threading.Lock()
        self.left = threading.Event()  # a join that Ctrl-C interrupts takes a thread for dead that is not

    def run(self) -> None:
        try:
            try:
                self.value = self._context.run(self._inside)
            except BaseException as error:
                self.error = error
            with self._leaving:
                self.left.set()
        except KeyboardInterrupt:  # it was told to end when it was about to
            self.left.set()

    def _inside(self) -> Any:
        _CALL.set(self)
        return self._work()

    def end(self) -> None:
        """Ask it to end; if nothing listens, raise KeyboardInterrupt in it, at the next step that is Python's."""
        self.stop = True
        began = time.monotonic()
        try:
            while (self.listeners or self.heard) and time.monotonic() - began < GRACE:
                if self.left.wait(0.02):
                    return
        finally:
            with self._leaving:
                if self.ident is not None and not self.left.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(
                        ctypes.c_ulong(self.ident), ctypes.py_object(KeyboardInterrupt)
                    )
        if self.ident is not None:
            self.left.wait(max(0.02, began + GRACE - time.monotonic()))


_CALL: contextvars.ContextVar[_Call | None] = contextvars.ContextVar("call", default=None)
_DEADLINE: contextvars.ContextVar[float] = contextvars.ContextVar("deadline", default=np.inf)


def interruptible(function: Callable[P, T]) -> Callable[P, T]:
    """A public function that Ctrl-C ends within a second.

    KeyboardInterrupt is raised, or what else a handler of signals raises; it carries as ``solution`` what the call had
    found, where it had (see :class:`ocp.errors.Interrupted`). Outside the main thread, where no signal arrives, the
    function is called as it is.
    """

    @wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> T:
        if threading.current_thread() is not threading.main_thread():
            return function(*arguments, **named)
        work = _Call(partial(function, *arguments, **named))
        try:
            work.start()
            while not work.left.wait(1.0):
                pass
        except BaseException as raised:
            work.end()
            found = getattr(work.error, "solution", None)
            if found is not None and isinstance(raised, KeyboardInterrupt):
                raise work.error from None  # type: ignore[misc]
            raise
        try:
            if work.error is not None:
                raise work.error
            return work.value  # type: ignore[no-any-return]
        finally:
            del work  # or the traceback would hold what holds it

    return call


@contextmanager
def stop_requests_polled() -> Iterator[None]:
    """Inside, the loop at work asks :func:`reason_to_stop` again and again, and ends by itself."""
    call = _CALL.get()
    if call is None:
        yield
        return
    call.listeners += 1
    try:
        yield
    finally:
        call.listeners -= 1


def reason_to_stop() -> SolverStatus | None:
    """Why the work at hand should end, INTERRUPTED or TIME_LIMIT; None where it need not."""
    call = _CALL.get()
    if call is not None and call.stop:
        call.heard = True
        return SolverStatus.INTERRUPTED
    return SolverStatus.TIME_LIMIT if time_left() <= 0 else None


# ---- time limits -------------------------------------------------------------------------------------------------


@contextmanager
def time_limited(seconds: float | None) -> Iterator[None]:
    """Solves inside end after so many seconds in all, or after what an outer limit leaves; None for no limit."""
    before = _DEADLINE.get()
    token = _DEADLINE.set(before if seconds is None else min(before, time.monotonic() + seconds))
    try:
        yield
    finally:
        _DEADLINE.reset(token)


def time_left() -> float:
    """Seconds until the time limit, infinite without one; negative behind it."""
    return _DEADLINE.get() - time.monotonic()


class TimeLimitReached(Exception):
    """What has no word of its own for it is behind its time limit; who set the limit says what was found."""


def check_time() -> None:
    """Raise OutOfTime behind the time limit."""
    if time_left() <= 0:
        raise TimeLimitReached(str(SolverStatus.TIME_LIMIT))


# ---- progress ----------------------------------------------------------------------------------------------------


class Progress(ca.Callback):  # type: ignore[misc]
    """One line on the terminal for each iteration, and a way to stop between two; keeps the iterate."""

    def __init__(self, n: int, m: int, np_: int, title: str, show: bool) -> None:
        ca.Callback.__init__(self)
        self.sizes = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": np_}
        self.title, self.show = title, show
        self.stopped: SolverStatus | None = None
        self.iterate, self.iterations = np.zeros(n), 0
        self.bar: Any = None
        self.construct("progress", {})

    def open(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Begin a solve with these bounds of the rows. The line appears after a second, on a terminal only."""
        self.lower, self.upper = lower, upper
        self.stopped, self.iterations = None, 0
        disable = None if self.show else True
        form = "{desc}: {n_fmt} iterations, {elapsed}{postfix}"
        self.bar = tqdm(desc=self.title, bar_format=form, disable=disable, delay=1.0, leave=False, file=sys.stderr)

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: list[Any]) -> list[int]:
        try:
            if self.bar is not None and not self.bar.disable:
                g = np.asarray(arguments[2].full()).reshape(-1)
                worst = float(np.max(np.maximum(self.lower - g, g - self.upper), initial=0.0))
                words = f"cost {float(arguments[1]):.6g}, infeasibility {worst:.1e}"
                self.bar.set_postfix_str(words, refresh=False)
                self.bar.update()
            self.stopped = reason_to_stop()
        except KeyboardInterrupt:  # CasADi would make another error of it
            self.stopped = SolverStatus.INTERRUPTED
        self.iterations, self.iterate = self.iterations + 1, np.asarray(arguments[0].full()).reshape(-1)
        return [int(bool(self.stopped))]

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


class FatropMonitor(ca.Callback):  # type: ignore[misc]
    """The function of an iterate that is 1 while a solver may go on and 0 when it must end; keeps the iterate.

    For fatrop's plugin, which has no iteration callback.
    """

    def __init__(self, n: int, title: str) -> None:
        ca.Callback.__init__(self)
        self.n, self.title = n, title
        self.stopped: SolverStatus | None = None
        self.iterate, self.iterations = np.zeros(n), 0
        self.construct("watch", {})

    def open(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Begin a solve."""
        self.stopped, self.iterations = None, 0

    def close(self) -> None:
        """The solve has ended."""

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.n, 1)

    def eval(self, arguments: list[Any]) -> list[float]:
        try:
            self.stopped = self.stopped or reason_to_stop()
        except KeyboardInterrupt:
            self.stopped = SolverStatus.INTERRUPTED
        self.iterations, self.iterate = self.iterations + 1, np.asarray(arguments[0].full()).reshape(-1)
        return [float(not self.stopped)]


# ---- CasADi's own words ------------------------------------------------------------------------------------------


class _Hushed(io.TextIOBase):
    """``sys.stderr`` without what some threads write."""

    def __init__(self, real: Any) -> None:
        self.real = real
        self.silent: Counter[int] = Counter()

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() in self.silent else int(self.real.write(text))

    def flush(self) -> None:
        self.real.flush()

    def isatty(self) -> bool:
        return bool(self.real.isatty())

    def fileno(self) -> int:
        return int(self.real.fileno())


_HUSHING = threading.Lock()


@contextmanager
def casadi_silenced() -> Iterator[None]:
    """Swallow what CasADi writes to ``sys.stderr`` from this thread where a function breaks down and that is expected.

    It would print the function's inputs; no option of its functions keeps it from that.
    """
    me = threading.get_ident()
    with _HUSHING:
        if not isinstance(sys.stderr, _Hushed):
            sys.stderr = _Hushed(sys.stderr)
        hushed = sys.stderr
        hushed.silent[me] += 1
    try:
        yield
    finally:
        with _HUSHING:
            hushed.silent[me] -= 1
            hushed.silent = +hushed.silent
            if not hushed.silent and sys.stderr is hushed:
                sys.stderr = hushed.real
