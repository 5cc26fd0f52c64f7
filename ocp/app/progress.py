"""Show progress on a terminal line, or in a log by a line every 30 s."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Self

__all__ = ["Progress"]

LOG_PERIOD_S = 30.0
"""Time between two lines in a log."""
TERMINAL_DELAY_S = 0.5
"""Time before the line appears on a terminal, and between its updates."""


class Progress:
    """Progress line of a command on a terminal; in a log, lines at the start, every 30 s, and at the end."""

    def __init__(self, title: str, quiet: bool = False) -> None:
        self.title, self.stage, self.began = title, "", time.monotonic()
        self.shown, self.quiet, self.terminal = False, quiet, sys.stderr.isatty()
        self._ended = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, stage: str) -> None:
        """Set the name of the next stage."""
        self.stage = stage
        if self.terminal and self.seconds > TERMINAL_DELAY_S:
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
