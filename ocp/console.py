"""Handling of Ctrl-C, time limits, progress display and CasADi's output during calls of public functions.

A public call runs in its own thread, for which the main thread waits. So Ctrl-C reaches Python at once, whatever CasADi
is doing, and never CasADi itself, which would turn it into a RuntimeError that looks like a numerical failure.
"""

from __future__ import annotations

import contextvars
import ctypes
import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, ParamSpec, Self, TypeVar

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, SolverStatus

LOG = logging.getLogger("ocp")
P = ParamSpec("P")
T = TypeVar("T")


GRACE_PERIOD_S = 0.8
"""Time after Ctrl-C, s, in which a call may end by itself with its last iterate before the call is stopped."""


# ---- Ctrl-C ------------------------------------------------------------------------------------------------------


class _Call(threading.Thread):
    """Thread that executes a call of a public function, and that the main thread can stop.

    `stop` says that the call has been asked to end, `heard` that a loop in the call has noticed this request, and
    `listeners` how many loops poll the request and end by themselves.
    """

    def __init__(self, work: Callable[[], Any]) -> None:
        # not a daemon: Python must not exit while CasADi is running
        super().__init__(name="ocp", daemon=False)
        self.stop, self.heard, self.listeners = False, False, 0
        self.value: Any = None
        self.error: BaseException | None = None
        self._work, self._context = work, contextvars.copy_context()
        self._leaving = threading.Lock()
        self.left = threading.Event()  # after an interrupted join Python takes a running thread for dead

    def run(self) -> None:
        try:
            try:
                self.value = self._context.run(self._inside)
            except BaseException as error:
                self.error = error
            with self._leaving:
                self.left.set()
        except KeyboardInterrupt:  # interrupted when it was about to end
            self.left.set()

    def _inside(self) -> Any:
        _CALL.set(self)
        return self._work()

    def end(self) -> None:
        """Ask the call in this thread to end, by setting ``stop``; raise KeyboardInterrupt in it if it does not."""
        self.stop = True
        began = time.monotonic()
        try:
            while (self.listeners or self.heard) and time.monotonic() - began < GRACE_PERIOD_S:
                if self.left.wait(0.02):
                    return
        finally:
            with self._leaving:
                if self.ident is not None and not self.left.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(
                        ctypes.c_ulong(self.ident), ctypes.py_object(KeyboardInterrupt)
                    )
        if self.ident is not None:
            self.left.wait(max(0.02, began + GRACE_PERIOD_S - time.monotonic()))


_CALL: contextvars.ContextVar[_Call | None] = contextvars.ContextVar("call", default=None)
_DEADLINES: contextvars.ContextVar[tuple[float, float]] = contextvars.ContextVar("deadlines", default=(np.inf, np.inf))


def interruptible(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a public function so that Ctrl-C ends a call of the function within a second.

    KeyboardInterrupt is raised, or whatever another signal handler raises. It carries as ``solution`` the last iterate
    of the call, if any (see :class:`ocp.errors.Interrupted`). Outside the main thread, which alone receives signals,
    the function is called directly.
    """

    @wraps(function)
    def call(*arguments: P.args, **keywords: P.kwargs) -> T:
        if threading.current_thread() is not threading.main_thread():
            return function(*arguments, **keywords)
        work = _Call(partial(function, *arguments, **keywords))
        try:
            work.start()
            while not work.left.wait(1.0):
                pass
        except BaseException as raised:
            work.end()
            solution = getattr(work.error, "solution", None)
            if solution is not None and isinstance(raised, KeyboardInterrupt):
                raise work.error from None  # type: ignore[misc]
            raise
        try:
            if work.error is not None:
                raise work.error
            return work.value  # type: ignore[no-any-return]
        finally:
            del work  # breaks the reference cycle with the traceback

    return call


@contextmanager
def stop_requests_polled() -> Iterator[None]:
    """Declare that the code of a ``with`` block polls :func:`reason_to_stop` regularly and ends by itself."""
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
    """Return the status INTERRUPTED or TIME_LIMIT if the current call should end, else None."""
    call = _CALL.get()
    if call is not None and call.stop:
        call.heard = True
        return SolverStatus.INTERRUPTED
    return SolverStatus.TIME_LIMIT if time_left() <= 0 else None


# ---- time limits -------------------------------------------------------------------------------------------------


@contextmanager
def time_limited(seconds: float | None, *, processor: bool = False) -> Iterator[None]:
    """Limit the total time of the solves in a ``with`` block.

    None keeps the limit of an enclosing block. The limit is on the wall time or, if `processor` is set, on the
    processor time of the program, so that what is found within it does not depend on other programs.
    """
    wall_end, processor_end = _DEADLINES.get()
    if seconds is not None and processor:
        processor_end = min(processor_end, time.process_time() + seconds)
    elif seconds is not None:
        wall_end = min(wall_end, time.monotonic() + seconds)
    token = _DEADLINES.set((wall_end, processor_end))
    try:
        yield
    finally:
        _DEADLINES.reset(token)


def time_left() -> float:
    """Return the time until the time limit, s: infinite without a limit, negative after the limit has passed."""
    wall, processor = _DEADLINES.get()
    return min(wall - time.monotonic(), processor - time.process_time())


class TimeLimitReached(Exception):
    """Error raised when the time limit has passed, which the function that set the limit catches and reports.

    Attributes:
        advice: How the user may reach a result in less time, as the end of a sentence; "" if unknown.
    """

    advice = ""


def check_time() -> None:
    """Raise TimeLimitReached if the time limit has passed."""
    if time_left() <= 0:
        raise TimeLimitReached(str(SolverStatus.TIME_LIMIT))


# ---- CasADi's output --------------------------------------------------------------------------------------------


class _FilteredStream:
    """Replacement for ``sys.stderr`` that discards the output of the threads listed in ``silent``."""

    def __init__(self, real: Any) -> None:
        self.real = real
        self.silent: Counter[int] = Counter()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() in self.silent else int(self.real.write(text))


_FILTER_LOCK = threading.Lock()


@contextmanager
def casadi_silenced() -> Iterator[None]:
    """Suppress CasADi's messages on ``sys.stderr`` from this thread, for evaluations that are expected to fail.

    CasADi would print the function's inputs, and no option of its functions prevents that.
    """
    thread = threading.get_ident()
    with _FILTER_LOCK:
        if not isinstance(sys.stderr, _FilteredStream):
            sys.stderr = _FilteredStream(sys.stderr)
        stream: Any = sys.stderr
        stream.silent[thread] += 1
    try:
        yield
    finally:
        with _FILTER_LOCK:
            stream.silent[thread] -= 1
            stream.silent = +stream.silent
            if not stream.silent and sys.stderr is stream:
                sys.stderr = stream.real


# ---- progress of long calls --------------------------------------------------------------------------------------

LOG_PERIOD_S = 30.0
"""Time between two progress lines in a log, s."""
TERMINAL_DELAY_S = 0.5
"""Time before the progress line of a command appears on a terminal, and between its updates, s."""
SOLVE_DELAY_S = 1.0
"""Time before the progress line of a solver appears, s."""
CALL_DELAY_S = 2.0
"""Time before the progress line of a call of a public function appears, s."""

_LISTENER: ContextVar[Callable[[str], Any] | None] = ContextVar("listener", default=None)


def report(stage: str, *, step: bool = False) -> None:
    """Report the name of the current stage to the function that shows the progress of the call, and to the log.

    If `step` is set, the name belongs to one of many steps of a stage and is not logged.
    """
    if not step:
        LOG.info("%s", stage)
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage)


@contextmanager
def shown_progress(title: str, progress: Any) -> Iterator[None]:
    """Show the progress of a ``with`` block: the names of the stages that its code reports by :func:`report`.

    ``progress`` is a function that is called with the name of each stage; True: a line on the terminal; False: nothing;
    None: a line after two seconds, if there is a terminal or a notebook and nobody else shows the call.
    """
    if progress is None and (_LISTENER.get() is not None or not _is_interactive()):
        yield
        return
    if progress is None or isinstance(progress, bool):
        display: Any = Progress(title, quiet=progress is False, delay=CALL_DELAY_S)
    elif callable(progress):
        display = nullcontext(progress)
    else:
        words = f"progress must be a function of a stage's name, True, False or None, not {progress!r}"
        raise ProblemError(words, name="progress", value=progress)
    with display as listener:
        token = _LISTENER.set(listener)
        try:
            yield
        finally:
            _LISTENER.reset(token)


def _is_interactive() -> bool:
    """Return whether progress can be displayed: standard error is a terminal, or the code runs in a notebook."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules


class Progress:
    """Progress display of a command or call: a line on a terminal or in a notebook, or lines in a log.

    The line appears after `delay` seconds. A log has a line at the start, every 30 s and at the end.
    """

    def __init__(self, title: str, quiet: bool = False, delay: float = TERMINAL_DELAY_S) -> None:
        self.title, self.stage, self.began, self.delay = title, "", time.monotonic(), delay
        self.shown, self.quiet, self.terminal = False, quiet, _is_interactive()
        self._ended = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, stage: str) -> None:
        """Set the name of the current stage, and redraw the progress line."""
        self.stage = stage
        if self.terminal and self.seconds > self.delay:
            self._draw()

    @property
    def seconds(self) -> float:
        """Time since the display was created, s."""
        return time.monotonic() - self.began

    def say(self, text: str) -> None:
        """Print a text on a line of its own, for example a warning."""
        with self._lock:
            self._wipe()
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        if not self.quiet:
            if not self.terminal:
                self.say("started")
            threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        self._ended.set()
        with self._lock:
            self._wipe()
        if not self.quiet and not self.terminal:
            self.say(f"{'done' if kind is None else 'ended'} after {self.seconds:.3g} s")

    def _watch(self) -> None:
        while not self._ended.wait(TERMINAL_DELAY_S if self.terminal else LOG_PERIOD_S):
            if self.terminal:
                if self.seconds > self.delay:
                    self._draw()
            else:
                self.say(f"{self.stage or 'at work'}, {self.seconds:.0f} s")

    def _draw(self) -> None:
        with self._lock:
            if not self.quiet and not self._ended.is_set():
                self.shown = True
                print(f"\r\x1b[K{self.title}: {self.stage} ({self.seconds:.0f} s)", end="", file=sys.stderr, flush=True)

    def _wipe(self) -> None:
        if self.shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
            self.shown = False


# ---- solver iterations -------------------------------------------------------------------------------------------


class IterationMonitor(ca.Callback):  # type: ignore[misc]
    """Solver callback that stores the current iterate, and stops the solver on Ctrl-C or at the time limit.

    It shows a progress line on a terminal, unless the call has its own display. :meth:`open` and :meth:`close` enclose
    a solve; ``lower`` and ``upper`` are the bounds of the constraints of the program.
    """

    def __init__(self, n: int, m: int, np_: int, *, title: str, show: bool) -> None:
        ca.Callback.__init__(self)
        self.sizes = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": np_}
        self.title, self.iterate, self.iterations = title, np.zeros(n), 0
        self.stopped: SolverStatus | None = None
        self.show, self.line = show, Progress(title, quiet=True)
        self.construct("progress", {})

    def open(self, lower: np.ndarray, upper: np.ndarray) -> None:
        self.lower, self.upper = lower, upper
        self.stopped, self.iterations = None, 0
        quiet = not self.show or not _is_interactive() or _LISTENER.get() is not None
        self.line = Progress(self.title, quiet=quiet, delay=SOLVE_DELAY_S)
        self.line.__enter__()

    def close(self) -> None:
        self.line.__exit__(None)

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: list[Any]) -> list[float]:
        if not self.line.quiet:
            g = np.asarray(arguments[2].full()).reshape(-1)
            worst = float(np.max(np.maximum(self.lower - g, g - self.upper), initial=0.0))
            cost = f"cost {float(arguments[1]):.6g}, infeasibility {worst:.1e}"
            self.line.stage = f"{self.iterations + 1} iterations, {cost}"
        try:
            self.stopped = self.stopped or reason_to_stop()
        except KeyboardInterrupt:  # CasADi would turn it into another error
            self.stopped = SolverStatus.INTERRUPTED
        self.iterations, self.iterate = self.iterations + 1, np.asarray(arguments[0].full()).reshape(-1)
        return [float(bool(self.stopped))]


class FatropMonitor(IterationMonitor):
    """Callback that the solver fatrop evaluates at each iterate; it returns 1 to continue or 0 to stop."""

    def __init__(self, n: int, title: str) -> None:
        super().__init__(n, 0, 0, title=title, show=False)

    def get_n_in(self) -> int:
        return 1

    def eval(self, arguments: list[Any]) -> list[float]:
        return [1.0 - super().eval(arguments)[0]]
