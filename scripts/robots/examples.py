"""The examples of the gallery one after the other: planned, audited, drawn and saved; Ctrl-C leaves whole files."""

from __future__ import annotations

import importlib
import json
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from models import ModelError
from ocp import ProblemError, SolveError
from scripts.papers.run import write
from scripts.robots.robots import PANDA, SPACE_ARM, TALOS, UR5

EXAMPLES: Mapping[str, str] = {
    "space_arm": SPACE_ARM.package,
    "panda": PANDA.package,
    "ur5": UR5.package,
    "posture_set": UR5.package,
    "reconfiguration": PANDA.package,
    "mobile_manipulator": "example-robot-data",
    "pushing": "example-robot-data",
    "pick_and_place": PANDA.package,
    "capture": SPACE_ARM.package,
    "steps": "selfmotion",
    "talos": TALOS.package,
}
"""Modules of this folder, each with `plan(coarse)`, which gives what its `draw(example, folder, animation=)` draws and
has `summary()` and `audit`; and the distributions that the robots come from; that of `steps` is our own."""


def run(names: Sequence[str], folder: Path, *, coarse: bool = False) -> tuple[dict[str, Any], dict[str, str]]:
    """Plan, audit, draw and save some examples.

    Args:
        names: Of EXAMPLES.
        folder: To write into. The summary keeps the rows of examples that are not run again.
        coarse: Smaller meshes, no animations.

    Returns:
        Rows of the summary, and why examples failed, by name.

    Raises:
        KeyboardInterrupt: Ctrl-C, at the latest when the plan in hand is done.
    """
    rows: dict[str, Any] = {}
    failed: dict[str, str] = {}
    bar = tqdm(total=2 * len(names), disable=None)
    with noticed() as check, bar:
        for name in names:
            module = importlib.import_module(f"scripts.robots.{name}")
            bar.set_description(f"{name}: planning")
            try:
                example = module.plan(coarse)
            except (ModelError, ProblemError, SolveError, FileNotFoundError) as error:
                check()
                failed[name] = str(error)
                bar.update(2)
                continue
            check()
            bar.update()
            bar.set_description(f"{name}: drawing")
            rows[name] = example.summary()
            write(folder / f"{name}.audit.txt", f"{example.audit}\n")
            module.draw(example, folder, animation=not coarse)
            if not example.audit.feasible or example.audit.optimal is False:
                failed[name] = f"the plan fails its audit:\n{example.audit}"
            write(folder / "summary.json", _merged(folder / "summary.json", rows))
            bar.update()
            check()
    return rows, failed


@contextmanager
def noticed() -> Iterator[Callable[[], None]]:
    """Keeps a Ctrl-C that comes while a solver runs: solvers make an end of it, and planners try again.

    Yields:
        A function that raises KeyboardInterrupt when there has been one.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    receiver, sender = socket.socketpair()
    with receiver, sender:
        receiver.setblocking(False)
        sender.setblocking(False)
        before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)

        def check() -> None:
            try:
                signals = receiver.recv(4096)
            except BlockingIOError:
                return
            if signal.SIGINT in signals:
                raise KeyboardInterrupt

        try:
            yield check
        finally:
            signal.set_wakeup_fd(before)


def _merged(path: Path, rows: Mapping[str, Any]) -> dict[str, Any]:
    """The summary on disk with new rows, in the order of EXAMPLES."""
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        old = {}
    known = {**(old if isinstance(old, dict) else {}), **rows}
    return {name: known[name] for name in EXAMPLES if name in known}
