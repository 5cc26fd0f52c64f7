"""Free-floating manipulator (Kim, Kim 2011): pseudo-inverse and optimum, every figure and table.

`python scripts/free_floating.py [--out results]` writes OUT/free_floating/ and prints paper value, our value and the
difference. What the paper does not print, and what cannot be reproduced, stands beside every number it touches.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.free_floating.figures import draw
from scripts.papers.free_floating.results import Results, compute
from scripts.papers.free_floating.tables import files, report
from scripts.papers.run import Paper


def sound(results: Results) -> bool:
    """Whether the plan passes its audit and the methods agree."""
    return results.audit.passed and all(one.passed for one in results.agreement.certificates.values())


PAPER = Paper("free_floating", __doc__, compute, files, draw, report, sound)
main = PAPER.main

if __name__ == "__main__":
    sys.exit(main())
