"""Show progress on a line of a terminal or a notebook, or in a log by a line every 30 s.

Long computations report their stages with `report`; whoever listens to the current call shows them.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any, Self

from ocp.errors import ProblemError

__all__ = ["Progress", "report", "shown_progress"]

LOG_PERIOD_S = 30.0
"""Time between two lines in a log."""
TERMINAL_DELAY_S = 0.5
"""Time before the line of a command appears on a terminal, and between its updates."""
CALL_DELAY_S = 2.0
"""Time before the line of a call appears."""

_LISTENER: ContextVar[Callable[[str], Any] | None] = ContextVar("listener", default=None)


def report(stage: str) -> None:
    """Tell the listener of the current call, if there is one, what is being done."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage)


@contextmanager
def shown_progress(title: str, progress: Any) -> Iterator[None]:
    """Show the stages that are reported inside.

    Args:
        title: Name of the call.
        progress: Function that is called with the name of each stage; True: a line on the terminal; False: nothing.
            None: a line after two seconds, if there is a terminal or a notebook and nobody else shows the call.

    Raises:
        ProblemError: `progress` is something else.
    """
    if progress is None and (_LISTENER.get() is not None or not _is_interactive()):
        yield
        return
    if progress is None or isinstance(progress, bool):
        line = Progress(title, quiet=progress is False, delay=CALL_DELAY_S)
    elif callable(progress):
        line = None
    else:
        words = f"progress must be a function of a stage's name, True, False or None, not {progress!r}"
        raise ProblemError(words, name="progress", value=progress)
    token = _LISTENER.set(progress if line is None else line)
    try:
        if line is None:
            yield
        else:
            with line:
                yield
    finally:
        _LISTENER.reset(token)


def _is_interactive() -> bool:
    """Return whether standard error is a terminal or the output of a notebook."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules


class Progress:
    """Progress line of a command or call; in a log, lines at the start, every 30 s, and at the end.

    The line appears on a terminal or in a notebook after `delay` seconds.
    """

    def __init__(self, title: str, quiet: bool = False, delay: float = TERMINAL_DELAY_S) -> None:
        self.title, self.stage, self.began, self.delay = title, "", time.monotonic(), delay
        self.shown, self.quiet, self.terminal = False, quiet, _is_interactive()
        self._ended = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, stage: str) -> None:
        """Set the name of the next stage."""
        self.stage = stage
        if self.terminal and self.seconds > self.delay:
            self._draw()

    @property
    def seconds(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self.began

    def say(self, text: str) -> None:
        """Print a line of its own, for example a warning."""
        with self._lock:
            self._wipe()
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        if not self.quiet:
            if not self.terminal:
                self.say("started")
            threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
