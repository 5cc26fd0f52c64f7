"""Real robots, planned, audited and drawn: `python scripts/gallery.py [--out results] [--only NAME ...]`.

Writes OUT/gallery/: for each example a figure, an animation, the plan for scripts/view.py and its audit, and
summary.json of all. The robots are URDF files of optional packages: pip install "selfmotion[gallery]".
The exit status is 0 when every plan passes its audit.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from tqdm import tqdm

from models import ModelError
from ocp import ProblemError, SolveError
from scripts.drawing import text_table, write_json, written
from scripts.robots.robots import missing

__all__ = ["EXAMPLES", "NAME", "Entry", "main", "noticed", "run"]

NAME = "gallery"


@dataclass(frozen=True)
class Entry:
    """An example of the gallery.

    Attributes:
        module: Its `plan(coarse)` gives what `draw(example, folder)` draws; that has `summary()` and `audit`.
        package: The distribution that its robot comes from.
    """

    module: str
    package: str


EXAMPLES: Mapping[str, Entry] = {
    "space_arm": Entry("scripts.robots.space_arm", "spartpy"),
    "panda": Entry("scripts.robots.panda", "example-robot-data"),
    "ur5": Entry("scripts.robots.ur5", "example-robot-data"),
    "mobile_manipulator": Entry("scripts.robots.mobile_manipulator", "example-robot-data"),
    "pushing": Entry("scripts.robots.pushing", "example-robot-data"),
}
COLUMNS = ("dof", "task_rows", "cost_local", "cost_optimal", "tip_error", "joint_return_rad", "audit_passed")
"""Of the summary, printed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the examples; 0 when every plan is there and passes its audit, 1 otherwise, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    parser.add_argument("--only", nargs="+", choices=list(EXAMPLES), metavar="NAME", help=f"of {', '.join(EXAMPLES)}")
    options = parser.parse_args(arguments)
    names = list(dict.fromkeys(options.only or EXAMPLES))
    if lacking := missing(EXAMPLES[name].package for name in names):
        print(
            f"gallery: the robots come from {' and '.join(lacking)}, not installed here: "
            f'pip install "selfmotion[gallery]", or pip install {" ".join(lacking)}',
            file=sys.stderr,
        )
        return 1
    folder = options.out / NAME
    try:
        rows, failed = run(names, folder)
    except KeyboardInterrupt:
        print(f"\nstopped; what is in {folder} is whole", file=sys.stderr)
        return 130
    shown = [{"example": name, **{key: _shown(row[key]) for key in COLUMNS}} for name, row in rows.items()]
    if shown:
        print("\n" + text_table(shown, digits=5))
    for name, reason in failed.items():
        print(f"{name}: {reason}", file=sys.stderr)
    print(f"written to {folder}; to look at a plan: python scripts/view.py {folder / (names[0] + '.npz')}")
    return 1 if failed else 0


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
            module = importlib.import_module(EXAMPLES[name].module)
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
            with written(folder / f"{name}.audit.txt") as temporary:
                temporary.write_text(f"{example.audit}\n", encoding="utf-8")
            module.draw(example, folder, animation=not coarse)
            if not example.audit.passed:
                failed[name] = f"the plan fails its audit:\n{example.audit}"
            write_json(folder / "summary.json", _merged(folder / "summary.json", rows))
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


def _shown(value: Any) -> Any:
    return "-" if value is None else value


if __name__ == "__main__":
    sys.exit(main())
