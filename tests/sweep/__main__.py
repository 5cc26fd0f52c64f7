"""The sweep from the command line: all families in processes of their own, a table at the end."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from tests.sweep.judging import COUNTS, METHODS, Verdict, judged, table

ALLOWED = {"false fail": 0.01, "undecided": 0.01}


def one(task: tuple[str, int], methods: Sequence[str] | None = None, until: float = float("inf")) -> list[Verdict]:
    """Verdicts on one problem, or none after a time of the clock."""
    return judged(*task, methods) if time.time() < until else []


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.sweep", description=__doc__)
    parser.add_argument("--only", choices=list(COUNTS), help="one family")
    parser.add_argument("--seed", type=int, help="one problem of it, with the tables of its audits")
    parser.add_argument("--method", choices=["drawn", *METHODS], action="append", help="one method")
    parser.add_argument("--share", type=float, default=1.0, help="of the problems of each family")
    parser.add_argument("--minutes", type=float, default=20.0, help="after which no further problem is begun")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder for sweep/sweep.txt")
    options = parser.parse_args(arguments)
    families = [options.only] if options.only else list(COUNTS)
    if options.seed is not None:
        for family in families:
            judged(family, options.seed, options.method, show=True)
        return 0
    # families in turn, so that a run that is cut short has seen all of them
    counts = {family: max(1, round(COUNTS[family] * options.share)) for family in families}
    tasks = sorted(
        ((family, seed) for family in families for seed in range(counts[family])),
        key=lambda task: task[1] / counts[task[0]],
    )
    began = time.time()
    work = partial(one, methods=options.method, until=began + 60 * options.minutes)
    if options.workers > 1:
        with ProcessPoolExecutor(options.workers) as pool:
            verdicts = [v for result in pool.map(work, tasks, chunksize=4) for v in result]
    else:
        verdicts = [v for task in tasks for v in work(task)]
    text = f"{table(verdicts)}\n\n{len(verdicts)} plans in {time.time() - began:.0f} s"
    print(text)
    if options.out:
        folder = options.out / "sweep"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "sweep.txt").write_text(text + "\n")
    return int(any(v.outcome == "false pass" for v in verdicts))


if __name__ == "__main__":
    raise SystemExit(main())
