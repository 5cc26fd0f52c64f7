"""Captive trajectory rig (Lee, Lee 2017): roll by the paper's two iterations and by the global optimum, store release.

`python scripts/cts.py [--out results]` writes OUT/cts/ and prints paper value, our value and the difference.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.cts.figures import draw
from scripts.papers.cts.results import Results, compute
from scripts.papers.cts.tables import files, report
from scripts.papers.run import Paper


def sound(results: Results) -> bool:
    """Whether no minimum is missed, all poses of the release are tracked and the plan passes its audit."""
    return not results.random["global_missed"] and bool(results.release.table.ok.all()) and results.plan.passed


PAPER = Paper("cts", __doc__, compute, files, draw, report, sound)
main = PAPER.main

if __name__ == "__main__":
    sys.exit(main())
