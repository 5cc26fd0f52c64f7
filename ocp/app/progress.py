"""That something is at work: a line on a terminal, and where there is none one of the log now and then."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Self

__all__ = ["Progress"]

EVERY = 30.0
"""s between two lines of a log."""
AFTER = 0.5
"""s before a line appears on a terminal."""


class Progress:
    """On a terminal one line that is overwritten; else a line at the start, every 30 s, and at the end."""

    def __init__(self, title: str, quiet: bool = False) -> None:
        self.title, self.stage, self.began = title, "", time.monotonic()
        self.shown, self.quiet, self.terminal = False, quiet, sys.stderr.isatty()
        self._ended = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, stage: str) -> None:
        """What comes next."""
        self.stage = stage
        if self.terminal and self.seconds > AFTER:
            self._draw()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    def say(self, text: str) -> None:
        """A line of its own, warnings say."""
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
        while not self._ended.wait(AFTER if self.terminal else EVERY):
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
