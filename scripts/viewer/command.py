"""The command line of the view: which plan, how its URDF is read, what the plan means."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from models.spatial import rotation_from_rpy
from scripts.viewer.plan import Played, play


def parser(about: str | None) -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("plan", type=Path, help="file of Solution.save")
    words.add_argument("urdf", type=Path, nargs="?", help="the robot; not needed for plans of the gallery")
    words.add_argument("--port", type=int, default=8080, help="to listen on, or the next that is free (default: 8080)")
    words.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine only)")
    meshes = "where package://NAME/... is; repeatable"
    words.add_argument("--mesh-dir", type=Path, action="append", default=[], metavar="DIR", help=meshes)
    words.add_argument("--no-meshes", action="store_true", help="show boxes and lines only")
    reading = words.add_argument_group("how the URDF is read")
    reading.add_argument("--tip", help="link that carries the tip")
    reading.add_argument("--root", help="link to hang the robot up at")
    reading.add_argument(
        "--lock", type=_locked, action="append", metavar="NAME=VALUE", help="joint held fixed, rad or m; repeatable"
    )
    mimic = "what to do about joints that follow others"
    reading.add_argument("--mimic", choices=("couple", "lock", "free"), help=mimic)
    reading.add_argument("--as-given", action="store_true", help="do not warn of inertias that no body can have")
    plan = words.add_argument_group("what the plan means")
    plan.add_argument("--joints", metavar="STATE", help="state of the joint positions (default: joints)")
    plan.add_argument("--base", metavar="STATE", help="state of the base, 3 or 7 entries (default: base)")
    plan.add_argument("--joint-names", nargs="+", metavar="NAME", help="of the columns of that state, in its order")
    pose = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")
    plan.add_argument("--mount", nargs=6, type=float, metavar=pose, help="of a fixed base, m and rad")
    return words


def read(options: argparse.Namespace) -> Played:
    """The plan and its robot; see viewer.plan.play for what it raises."""
    reading: dict[str, Any] = {
        name: getattr(options, name) for name in ("tip", "root", "mimic") if getattr(options, name)
    }
    if options.lock:
        reading["lock"] = dict(options.lock)
    if options.as_given:
        reading["inertia"] = "as_given"
    mount: dict[str, Any] = {}
    if options.mount:
        turn = np.array(rotation_from_rpy(*options.mount[3:]), dtype=float)
        mount = {"translation": options.mount[:3], "rotation": turn}
    states = {"joints": options.joints, "base": options.base, "joint_names": options.joint_names}
    return play(options.plan, options.urdf, options=reading, **states, **mount)


def _locked(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not name or not np.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, number
