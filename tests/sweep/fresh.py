"""Plans of the gallery and of the papers are audited before they are files, and again in another process.

python -m tests.sweep.fresh [--only panda,blend]

The verdicts and all rows must be the same, their numbers to 1e-12. A kind of plan is one line of SUBJECTS.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from models import reference_rig, reference_tunnel
from ocp import Audit, Plan, Solution, solve
from scripts.papers.blend.results import compute
from scripts.papers.cts.plan import METHOD, sweep_problem
from scripts.papers.free_floating.formulations import null_space_problem, problem
from scripts.papers.free_floating.optimality import agreement
from scripts.papers.standing.plans import PLANS, solved

GALLERY = Path(__file__).parents[2] / "results" / "gallery"
SAME = 1e-12
READ = """
import json, sys
from ocp import Plan, Solution
path, kind = sys.argv[1:]
audit = {"Plan": Plan, "Solution": Solution}[kind].load(path).audit()
print(json.dumps([audit.passed, [[f.name, f.value, f.limit] for f in audit.findings]]))
"""
Subject = Callable[[], dict[str, Any]]


def of_gallery(file: Path) -> dict[str, Any]:
    """A committed file; plans hold what they were asked, solutions their problem."""
    with np.load(file) as archive:
        kind = Plan if "plan" in archive.files else Solution
    return {file.stem: kind.load(file)}


def free_floating() -> dict[str, Any]:
    result = agreement(problem(), null_space_problem())
    named = {"rates": result.rates, "null space": result.null_space}
    return {f"{form}, {name}": plan for form, plans in named.items() for name, plan in plans.items()}


SUBJECTS: dict[str, Subject] = {
    **{file.stem: partial(of_gallery, file) for file in sorted(GALLERY.glob("*.npz"))},
    "cts": lambda: {"sweep": solve(sweep_problem(reference_rig(), reference_tunnel()), METHOD)},
    "free_floating": free_floating,
    "standing": lambda: {
        f"{table}, {name}": solved(one) for table, some in PLANS.items() for name, one in some.items()
    },
    "blend": lambda: {name: one.fastest.solution for name, one in compute().plans.items()},
}


def rows_of(audit: Audit) -> list[Any]:
    return [audit.passed, [[f.name, f.value, f.limit] for f in audit.findings]]


def differences(plan: Any, folder: Path) -> Iterator[str]:
    """What differs between the audits before the file and in another process."""
    before = rows_of(plan.audit())
    plan.save(folder / "plan.npz")
    words = [sys.executable, "-W", "ignore", "-c", READ, str(folder / "plan.npz"), type(plan).__name__]
    after = json.loads(subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True).stdout)
    if before[0] != after[0]:
        yield f"the verdict was {before[0]} and is {after[0]}"
    if [row[0] for row in before[1]] != [row[0] for row in after[1]]:
        yield "the rows are others"
        return
    for (name, *one), (_, *other) in zip(before[1], after[1], strict=True):
        a, b = (np.array(values, dtype=float) for values in (one, other))
        if not np.allclose(a, b, rtol=SAME, atol=SAME, equal_nan=True):
            yield f"{name}: {one} and {other}"


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--only", default=",".join(SUBJECTS), help=f"of {', '.join(SUBJECTS)} (default: all)")
    bad = 0
    for name in options.parse_args().only.split(","):
        for what, plan in SUBJECTS[name]().items():
            with TemporaryDirectory() as folder:
                result = list(differences(plan, Path(folder)))
            bad += bool(result)
            print(f"{name}: {what}: {'; '.join(result) or 'the same'}, {len(plan.audit().findings)} rows", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
