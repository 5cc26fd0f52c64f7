"""Real robots, planned, audited and drawn: `python scripts/gallery.py [--out results] [--only NAME ...]`.

Writes OUT/gallery/: for each example a figure, an animation, the plan for `selfmotion view` and its audit, and
summary.json of all. The robots are URDF files of optional packages: pip install "selfmotion[gallery]".
The exit status is 0 when no audit finds fault with a plan; whether one is a minimum it may leave open.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.run import command, text_table
from scripts.robots.examples import EXAMPLES, run
from scripts.robots.robots import missing

COLUMNS = ("dof", "task_rows", "cost_local", "cost_optimal", "tip_error", "joint_return_rad", "audit_passed")
"""Of the summary, printed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the examples; 0 when every plan is there and no audit finds fault with it, 1 otherwise, 130 after Ctrl-C."""
    options = command(__doc__, EXAMPLES).parse_args(arguments)
    names = list(dict.fromkeys(options.only or EXAMPLES))
    if lacking := missing(EXAMPLES[name] for name in names):
        print(
            f"gallery: the robots come from {' and '.join(lacking)}, not installed here: "
            f'pip install "selfmotion[gallery]", or pip install {" ".join(lacking)}',
            file=sys.stderr,
        )
        return 1
    folder = options.out / "gallery"
    try:
        rows, failed = run(names, folder)
    except KeyboardInterrupt:
        print(f"\nstopped; what is in {folder} is whole", file=sys.stderr)
        return 130
    if rows:
        table = {name: {key: "-" if row[key] is None else row[key] for key in COLUMNS} for name, row in rows.items()}
        print("\n" + text_table([{"example": name, **row} for name, row in table.items()], digits=5))
    for name, reason in failed.items():
        print(f"{name}: {reason}", file=sys.stderr)
    shown = [file for name in names if (file := folder / f"{name}.npz").exists()]
    print(f"written to {folder}" + (f"; to look at a plan: selfmotion view {shown[0]}" if shown else ""))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
