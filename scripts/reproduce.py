"""Every paper script, one after the other: `python scripts/reproduce.py [--out results] [--only free_floating]`.

A script that fails does not stop the others; the exit status is 1 when any failed. Ends with a summary.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from tqdm import tqdm

from scripts.drawing import text_table

__all__ = ["PAPERS", "Outcome", "main", "present", "reproduce"]

PAPERS: Mapping[str, str] = {
    "free_floating": "scripts.free_floating",
    "standing": "scripts.standing",
    "blend": "scripts.blend",
    "cts": "scripts.cts",
}
"""Name of a paper and its module, whose `main(["--out", folder])` writes folder/name/ and returns 0 if all is well."""


@dataclass(frozen=True)
class Outcome:
    """What came of one script.

    Attributes:
        paper: Its name.
        status: "ok", or what went wrong.
        seconds: Wall time.
        files: How many the paper's folder holds afterwards.
    """

    paper: str
    status: str
    seconds: float
    files: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the scripts; 0 when all went well, 1 otherwise."""
    papers = present()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    parser.add_argument("--only", nargs="+", choices=list(papers), metavar="NAME", help=f"of {', '.join(papers)}")
    options = parser.parse_args(arguments)
    chosen = options.only or list(papers)
    outcomes = []
    bar = tqdm(chosen, disable=None)
    for name in bar:
        bar.set_description(name)
        outcomes.append(reproduce(name, papers[name], options.out))
    print("\n" + text_table([outcome.__dict__ for outcome in outcomes], digits=3))
    failed = [outcome.paper for outcome in outcomes if outcome.status != "ok"]
    print(f"failed: {', '.join(failed)}" if failed else f"all written to {options.out}")
    return 1 if failed else 0


def present() -> dict[str, str]:
    """The papers whose script exists."""
    folder = Path(__file__).resolve().parent
    return {name: module for name, module in PAPERS.items() if (folder / f"{module.split('.')[-1]}.py").exists()}


def reproduce(name: str, module: str, out: Path) -> Outcome:
    """Run one script; whatever it raises is printed and told in the outcome. Ctrl-C goes through."""
    print(f"\n==== {name} ====", flush=True)
    began = time.monotonic()
    try:
        code = importlib.import_module(module).main(["--out", str(out)])
        status = "ok" if not code else f"exit status {code}"
    except SystemExit as stop:
        status = "ok" if not stop.code else f"exit status {stop.code}"
    except Exception as error:
        traceback.print_exc()
        status = f"{type(error).__name__}: {error}".splitlines()[0]
    folder = out / name
    files = sum(path.is_file() for path in folder.iterdir()) if folder.is_dir() else 0
    return Outcome(name, status, time.monotonic() - began, files)


if __name__ == "__main__":
    sys.exit(main())
