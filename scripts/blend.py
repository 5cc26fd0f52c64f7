"""Smooth connected paths and their time schedule (Lee, Ryu, Cheong 2006): figures, tables, and what they leave out.

`python scripts/blend.py [--out results]` writes OUT/blend/ and prints paper value, our value and the difference.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.blend.figures import draw
from scripts.papers.blend.results import compute
from scripts.papers.blend.tables import files, report
from scripts.papers.run import Paper

PAPER = Paper("blend", __doc__, compute, files, draw, report)
main = PAPER.main

if __name__ == "__main__":
    sys.exit(main())
