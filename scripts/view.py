"""Play a saved plan in the browser: `python scripts/view.py plan.npz [robot.urdf] [--port N] [--mesh-dir DIR]`.

Plans of `Solution.save` need the URDF file and what it takes to read it as the plan's robot (--lock, --as-given, ...);
the plans in results/gallery bring both along. Ctrl-C ends it. Needs viser and yourdfpy: pip install "selfmotion[view]".
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, sleep

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from models import ModelError
from ocp import ProblemError
from scripts.viewer.command import parser, read

NEEDED = ("viser", "yourdfpy")
FRAME = 1 / 30  # s between two pictures


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C; 0, or 1 with a message when there is nothing to show."""
    options = parser(__doc__).parse_args(arguments)
    if lacking := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        print(f'view: {", ".join(lacking)} missing; pip install "selfmotion[view]"', file=sys.stderr)
        return 1
    from scripts.viewer.scene import View

    try:
        played = read(options)
        place = {"host": options.host, "port": options.port}
        view = View(played, **place, mesh_dirs=options.mesh_dir, meshes=not options.no_meshes)
    except (ModelError, ProblemError, OSError) as error:
        print(f"view: {error}", file=sys.stderr)
        return 1
    for name, reason in view.missing.items():
        print(f"not shown: {name}: {reason}", file=sys.stderr)
    print(f"{played.solution.name}, {played.horizon:g} s, on {view.address}; Ctrl-C ends it", flush=True)
    view.play.value = True
    last = monotonic()
    try:
        while True:
            sleep(FRAME)
            now = monotonic()
            view.advance(now - last)
            last = now
    except KeyboardInterrupt:
        return 0
    finally:
        view.stop()


if __name__ == "__main__":
    sys.exit(main())
