"""Manipulator that stands on the ground (Yoo et al. 2004): zero moment point by local laws and by optimal control.

`python scripts/standing.py [--out results]` writes OUT/standing/ and prints known value, our value and the difference.
The paper prints figures and no table of results; what its figures show, and an independent computation, are what is
compared with.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.run import Paper
from scripts.papers.standing.figures import draw
from scripts.papers.standing.results import compute
from scripts.papers.standing.tables import files, report, sound

PAPER = Paper("standing", __doc__, compute, files, draw, report, sound)
main = PAPER.main

if __name__ == "__main__":
    sys.exit(main())
