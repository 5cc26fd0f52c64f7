"""Every paper script, one after the other: `python scripts/reproduce.py [--out results] [--only free_floating]`.

A script that fails does not stop the others; the exit status is 1 when any failed. Ends with every number that the
papers print of their results, ours, and why those differ that do; of each paper they are also OUT/PAPER/numbers.csv.
"""

from __future__ import annotations

import importlib
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers import reproduced
from scripts.papers.run import command, progress, text_table

PAPERS: Mapping[str, str] = {name: f"scripts.{name}" for name in ("free_floating", "standing", "blend", "cts")}
"""Name of a paper and its module, whose `main(["--out", folder])` writes folder/name/ and returns 0 if all is well."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the scripts; 0 when all went well, 1 otherwise."""
    options = command(__doc__, PAPERS).parse_args(arguments)
    outcomes = [reproduce(name, PAPERS[name], options.out) for name in progress(options.only or PAPERS, "papers")]
    print("\n" + text_table(outcomes, digits=3))
    result, missing = reproduced.read(options.out, options.only or [*PAPERS])
    reproduced.write_tables(options.out, result)
    if result or missing:
        print("\n" + reproduced.text(result, missing) + "\n")
    failed = [outcome["paper"] for outcome in outcomes if outcome["status"] != "ok"]
    print(f"failed: {', '.join(failed)}" if failed else f"all written to {options.out}")
    return 1 if failed else 0


def reproduce(name: str, module: str, out: Path) -> dict[str, Any]:
    """Run one script; whatever it raises is printed and told in the outcome. Ctrl-C goes through.

    Returns:
        "paper": its name. "status": "ok", or what went wrong. "seconds": of wall time. "files": how many its folder
        holds afterwards.
    """
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
    files = sum(path.is_file() for path in (out / name).glob("*"))
    return {"paper": name, "status": status, "seconds": time.monotonic() - began, "files": files}


if __name__ == "__main__":
    sys.exit(main())
