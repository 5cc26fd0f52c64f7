"""Play a saved plan in the browser: `python scripts/view.py plan.npz [robot.urdf] [--port N] [--mesh-dir DIR]`.

Plans of `Solution.save` need the URDF file and what it takes to read it as the plan's robot (--lock, --as-given, ...);
the plans in results/gallery bring both along. Ctrl-C ends it. Needs viser and yourdfpy: pip install "selfmotion[view]".
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

import numpy as np

from models import ModelError
from models.spatial import rotation_from_rpy
from ocp import ProblemError
from scripts.viewer.plan import Played, play

__all__ = ["main", "options_of", "parser", "read"]

NEEDED = ("viser", "yourdfpy")
FRAME = 1 / 30  # s between two pictures


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C; 0, or 1 with a message when there is nothing to show."""
    options = parser().parse_args(arguments)
    if lacking := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        print(f'view: {", ".join(lacking)} missing; pip install "selfmotion[view]"', file=sys.stderr)
        return 1
    from scripts.viewer.scene import View

    try:
        played = read(options)
        view = View(
            played, host=options.host, port=options.port, mesh_dirs=options.mesh_dir, meshes=not options.no_meshes
        )
    except (ModelError, ProblemError, OSError) as error:
        print(f"view: {error}", file=sys.stderr)
        return 1
    for name, reason in view.missing.items():
        print(f"not shown: {name}: {reason}", file=sys.stderr)
    print(f"{played.solution.name}, {played.horizon:g} s, on {view.address}; Ctrl-C ends it", flush=True)
    view.playing = True
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


def parser() -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("plan", type=Path, help="file of Solution.save")
    words.add_argument("urdf", type=Path, nargs="?", help="the robot; not needed for plans of the gallery")
    words.add_argument("--port", type=int, default=8080, help="to listen on, or the next that is free (default: 8080)")
    words.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine only)")
    words.add_argument(
        "--mesh-dir",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="where package://NAME/... is; repeatable",
    )
    words.add_argument("--no-meshes", action="store_true", help="show boxes and lines only")
    reading = words.add_argument_group("how the URDF is read")
    reading.add_argument("--tip", help="link that carries the tip")
    reading.add_argument("--root", help="link to hang the robot up at")
    reading.add_argument(
        "--lock", type=_locked, action="append", metavar="NAME=VALUE", help="joint held fixed, rad or m; repeatable"
    )
    reading.add_argument(
        "--mimic", choices=("couple", "lock", "free"), help="what to do about joints that follow others"
    )
    reading.add_argument("--as-given", action="store_true", help="do not warn of inertias that no body can have")
    plan = words.add_argument_group("what the plan means")
    plan.add_argument("--joints", metavar="STATE", help="state of the joint positions (default: joints)")
    plan.add_argument("--base", metavar="STATE", help="state of the base, 3 or 7 entries (default: base)")
    plan.add_argument("--joint-names", nargs="+", metavar="NAME", help="of the columns of that state, in its order")
    plan.add_argument(
        "--mount",
        nargs=6,
        type=float,
        metavar=("X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="of a fixed base, m and rad",
    )
    return words


def options_of(options: argparse.Namespace) -> dict[str, Any]:
    """Arguments of Robot.from_urdf that the command line gives."""
    given: dict[str, Any] = {
        name: getattr(options, name) for name in ("tip", "root", "mimic") if getattr(options, name)
    }
    if options.lock:
        given["lock"] = dict(options.lock)
    if options.as_given:
        given["inertia"] = "as_given"
    return given


def read(options: argparse.Namespace) -> Played:
    """The plan and its robot; see view_plan.play for what it raises."""
    translation = rotation = None
    if options.mount:
        translation = options.mount[:3]
        rotation = np.array(rotation_from_rpy(*options.mount[3:]), dtype=float)
    return play(
        options.plan,
        options.urdf,
        options=options_of(options),
        joints=options.joints,
        base=options.base,
        joint_names=options.joint_names,
        translation=translation,
        rotation=rotation,
    )


def _locked(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not name or not np.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, number


if __name__ == "__main__":
    sys.exit(main())
