"""Keep CasADi from printing the inputs of a function that breaks down where that is expected and caught."""

from __future__ import annotations

import io
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from tqdm import tqdm

__all__ = ["Interrupt", "Progress", "interruptible", "quiet"]


@contextmanager
def quiet() -> Iterator[None]:
    """Swallow what CasADi writes to ``sys.stderr``; no option of its functions does."""
    with redirect_stderr(io.StringIO()):
        yield


class Progress(ca.Callback):  # type: ignore[misc]
    """One line on the terminal for each iteration, and a way to stop between two."""

    def __init__(self, n: int, m: int, np_: int, title: str, show: bool) -> None:
        ca.Callback.__init__(self)
        self.sizes = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": np_}
        self.title, self.show = title, show
        self.stop = False
        self.bar: Any = None
        self.construct("progress", {})

    def open(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Begin a solve with these bounds of the rows. The line appears after a second, on a terminal only."""
        self.lower, self.upper, self.stop = lower, upper, False
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
        if self.bar is not None and not self.bar.disable:
            g = np.asarray(arguments[2].full()).reshape(-1)
            worst = float(np.max(np.maximum(self.lower - g, g - self.upper), initial=0.0))
            cost = float(arguments[1])
            self.bar.set_postfix_str(f"cost {cost:.6g}, infeasibility {worst:.1e}", refresh=False)
            self.bar.update()
        return [int(self.stop)]

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


@dataclass
class Interrupt:
    """A request to stop between two iterations."""

    stop: bool = False


@contextmanager
def interruptible(progress: Progress | Interrupt | None) -> Iterator[None]:
    """Turn Ctrl-C into a request to stop, in the main thread; without anything to ask, leave it alone."""
    if progress is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    def request(number: int, frame: Any) -> None:
        progress.stop = True

    before: Callable[..., Any] | int | None = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, request)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
