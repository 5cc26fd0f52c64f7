"""Command line of `selfmotion`, also run by `python -m ocp`: its arguments, its output and its exit status.

The status is 0 if all requirements hold, 1 if a check fails or is undetermined or there is no plan, 2 for bad input,
and 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models.errors import ModelError, ModelWarning
from ocp.app.check.joint_limits import CHECKED_LIMITS
from ocp.app.files.safe_files import SUFFIXES
from ocp.app.subcommands import (
    EXPORT_KINDS,
    run_cache,
    run_check,
    run_completion,
    run_export,
    run_margin,
    run_plan,
    run_report,
    run_view,
)
from ocp.console import Progress
from ocp.errors import AuditError, ProblemError, SolveError, require
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD

ABOUT = """Plan motions of kinematically redundant robot arms, and check joint trajectories from any source."""
PART = re.compile(r"\.[0-9a-f]{8}\.part$")
"""Pattern of the suffix that the name of a file has while the file is being written."""
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
EXAMPLES = """examples:
  selfmotion check robot.urdf motion.csv --acceleration 15 --obstacles cell.toml
  selfmotion plan seam.toml -o seam.npz
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion report seam.npz seam.html

Exit status: 0 all holds, 1 a check fails or is undetermined, or there is no plan, 2 bad input, 130 Ctrl-C.
`selfmotion COMMAND --help` shows more examples."""
CommandFunction: TypeAlias = Callable[[argparse.Namespace, Progress], tuple[int, str, Any]]
"""Function that runs a subcommand: (options, progress) -> (exit status, text to print, contents of the JSON output)."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    whole = argparse.ArgumentParser(
        prog="selfmotion", description=ABOUT, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    whole.add_argument("--version", action="version", version=f"selfmotion {_version()}")
    subcommands(whole)
    return whole


def _version() -> str:
    """Return the version of the installed package, or a note that the package is not installed."""
    try:
        return version("selfmotion")
    except PackageNotFoundError:
        return "(from a tree that is not installed)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `selfmotion` with the given arguments, and return its exit status.

    Raises:
        ProblemError: The arguments are not a list of texts.
    """
    if isinstance(arguments, str):
        raise ProblemError(f"arguments must be a list of texts, not {arguments!r}", name="arguments", value=arguments)
    arguments = None if arguments is None else require.each("arguments", arguments, str)
    options = parser().parse_args(arguments)
    try:
        return _run(options)
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _run(options: argparse.Namespace) -> int:
    """Run a subcommand, print its result or its error, and return the exit status."""
    run: CommandFunction = options.run
    try:
        with warnings.catch_warnings(), Progress(f"selfmotion {options.command}", options.quiet) as progress:
            warnings.simplefilter("default", ModelWarning)
            warnings.showwarning = lambda message, *_, **__: progress.say(_printable(f"warning: {message}"))
            status, text, data = run(options, progress)
        print(json.dumps(_plain(data), indent=1, allow_nan=False) if options.json else _printable(text), flush=True)
        return status
    except KeyboardInterrupt:
        print(f"selfmotion {options.command}: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except (ModelError, ProblemError, AuditError, OSError) as error:
        return _report_error(options, error, 2)
    except SolveError as error:
        return _report_error(options, error, 1)


def _report_error(options: argparse.Namespace, error: Exception, status: int) -> int:
    """Print an error message, also as JSON if the option --json is given, and return the exit status."""
    message = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        message = f"{PART.sub('', str(error.filename))}: {error.strerror}"
    for argument, option in options.called.items():
        message = message.replace(argument, option)
    print(f"selfmotion {options.command}: {_printable(message)}", file=sys.stderr)
    if options.json:
        fields = {name: getattr(error, name, None) for name in ("name", "value", "limit", "time")}
        print(json.dumps(_plain({"error": message, **fields}), indent=1, allow_nan=False), flush=True)
    return status


def _printable(text: str) -> str:
    """Escape control characters, which a terminal would interpret, in a text that may quote files."""
    return CONTROLS.sub(lambda match: repr(match[0])[1:-1], text)


def _plain(value: Any) -> Any:
    """Convert a value to what JSON can represent: null for a number that is not finite, text for any other object."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return str(value)


CHECK = """Check a joint trajectory from any source: limits, jumps, units, and clearance proven between the samples.

TRAJECTORY is a CSV with a header (time, and the joints by name; optionally NAME.velocity, NAME.acceleration; a unit
may follow in brackets: `elbow [deg]`), a JointTrajectory as JSON or YAML, an MCAP, or a robot program as `export`
writes it. Between samples the motion is interpolated as controllers do: linearly from positions alone, by cubics with
velocities, by quintics with accelerations. Without --rule, a velocity or acceleration between samples counts only as
far as every motion through the samples needs it."""
CHECK_EXAMPLES = """examples:
  selfmotion check panda.urdf motion.csv
  selfmotion check panda.urdf motion.csv --acceleration 15 --jerk 7500 --acceleration panda_joint1=10
  selfmotion check ur5.urdf log.mcap --tip tool0 --path seam.csv --path-tolerance 0.002 --obstacles cell.toml
  selfmotion check tiago.urdf reach.json --lock gripper_finger_joint=0.02 --standing
  selfmotion check motion.urdf motion.csv --json | jq .faults"""
PLAN = """Plan the lowest-cost motion of a task file, audit it, and write the outputs that the file names.

The task file is TOML: [robot] urdf, tip; [path] file or points, speed; optionally [limits], [cost], [search],
[scene], [[obstacle]], [output]. An error names its line and what was expected."""
PLAN_EXAMPLES = """examples:
  selfmotion plan seam.toml -o seam.npz
  selfmotion plan seam.toml --json | jq .cost

seam.toml:
  [robot]
  urdf = "ur5_robot.urdf"
  tip = "tool0"
  [path]
  points = [[0.4, -0.2, 0.3], [0.4, 0.2, 0.3]]    # m; or file = "seam.csv"
  speed = 0.05                                    # m/s; starts and ends at rest
  direction = [0, 0, -1]                          # of the tool's z axis; its roll is free
  [[obstacle]]
  shape = "halfspace"
  normal = [0, 0, 1]
  point = [0, 0, -0.05]
  [output]
  plan = "seam.npz"
  csv = "seam.csv"
  report = "seam.html"

A motion to a goal has in place of [path]:
  [goal]
  position = [0.5, 0.1, 0.3]                      # m; or joints = { elbow_joint = 1.2, ... }
  direction = [0, 0, -1]
  [search]
  start = { shoulder_pan_joint = 0.0, ... }       # all joints, rad or m"""
EXPORT = """Write a plan in the format of the file's suffix: .csv, .json and .yaml (the fields of a ROS 2
JointTrajectory), .mcap (joint states and the tip's path, for ROS 2 and Foxglove), .script, .src and .mod (programs in
URScript of Universal Robots, KRL of KUKA and RAPID of ABB), .urdf (the robot of the plan).

A robot program moves revolute joints as axes of the robot and prismatic joints as external axes. URScript and RAPID
keep the time of each sample; KRL has no times, only velocities in percent. Try it at low speed first."""
EXPORT_EXAMPLES = """examples:
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion export seam.npz seam.mcap
  selfmotion export seam.npz seam.src --joints rail,a1,a2,a3,a4,a5,a6"""
REPORT = """Write one HTML file about a plan: the verdict in a sentence, pictures, curves with limits, the audit with
units. The file loads nothing from another host."""
REPORT_EXAMPLES = """examples:
  selfmotion report seam.npz seam.html --title "Seam 4, cell 2\""""
MARGIN = """Print how far payload, friction and placements may differ from the model of a plan until it violates a limit
of torque, power, ground reaction, clearance or deviation of the tip: each alone, and all together.

The exit status is 0 if the plan covers all sizes given by --size at once. Names: payload (kg), friction (share of the
torque limits), base-position, obstacle-position and tool-offset (m, in any direction)."""
MARGIN_EXAMPLES = """examples:
  selfmotion margin seam.npz
  selfmotion margin seam.npz --size payload=1.5 --size base-position=0.004 --tolerance 0.005"""
VIEW = """Show motions: the robot with its meshes, the required and the actual path, frames, ghosts, curves of joints
and torques with their limits, cost, manipulability, momentum or zero moment point, the closest bodies, and the audit.

The first file is a plan of `selfmotion plan`; other files are compared with it: plans, or trajectories of the same
robot as `selfmotion check` reads them. A solution of your own problem (Solution.save) is shown with --robot. Without
--page the page is served on this machine until Ctrl-C; with it it is one file that plays anywhere, without a server."""
VIEW_EXAMPLES = """examples:
  selfmotion view seam.npz
  selfmotion view seam.npz --page seam.html --workpiece part.stl
  selfmotion view optimum.npz pseudo_inverse.csv --page both.html
  selfmotion view circle.npz --robot panda.urdf --tip panda_hand_tcp --lock panda_finger_joint1=0.02"""
CACHE = """Results that are costly to compute and depend only on their input (covers of meshes, pairs that never
collide, compiled functions of problems) are cached in $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion. After
`clear` they are computed again. Compiled functions take at most 256 MB; the least recently used are removed first."""
CACHE_EXAMPLES = """examples:
  selfmotion cache
  selfmotion cache clear"""
COMPLETION = """Print a script that completes commands, options and file names.

Write it to a file once, so that completion does not start Python:

  selfmotion completion bash > ~/.local/share/bash-completion/completions/selfmotion
  selfmotion completion zsh  > ~/.zsh/functions/_selfmotion        # a folder of $fpath"""


def subcommands(parser: argparse.ArgumentParser) -> None:
    """Add all subcommands to a parser."""
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    check = _command(commands, "check", "check a joint trajectory", CHECK, CHECK_EXAMPLES, run_check)
    _file(check, "robot", "URDF file of the robot")
    _file(check, "trajectory", "CSV, JointTrajectory as JSON or YAML, MCAP, or robot program")
    folder = {"folders=[FOLDER]": "--folder FOLDER"}
    check.set_defaults(called={**folder, "missing='skip'": "--no-meshes", "models.rectangle(...)": "--foot"})
    robot_options(check)
    check_options(check)
    _file(check, "--report", "also write one HTML file: pictures, curves with limits, every row")
    _force(check)
    plan = _command(commands, "plan", "plan the motion of a task file", PLAN, PLAN_EXAMPLES, run_plan)
    plan.set_defaults(
        called={
            "missing='skip'": '[scene] meshes = "skip"',
            "folders=[": "[scene] folders = [",
            "search='segments'": '[search] kind = "segments"',
            "horizon='free'": '[search] horizon = "free"',
        }
    )
    _file(plan, "task", "TOML file")
    _file(plan, "--output", "file of the plan (.npz), instead of that in the task file", short="-o")
    _file(plan, "--output-folder", "folder that contains the task's outputs (default: the task file's folder)")
    _force(plan)
    exporter = _command(commands, "export", "write a plan in another format", EXPORT, EXPORT_EXAMPLES, run_export)
    _file(exporter, "plan", "file of a plan (.npz)")
    _file(exporter, "file", f"file to write: {', '.join(SUFFIXES[kind][0] for kind in EXPORT_KINDS)}")
    _force(exporter)
    exporter.add_argument("--period", type=float, default=0.01, metavar="S", help="sampling period, s (default: 0.01)")
    exporter.add_argument("--joints", metavar="NAMES", help="joints of a robot program, in the order of its controller")
    exporter.set_defaults(called={"joints=": "--joints"})
    report = _command(commands, "report", "one HTML file about a plan", REPORT, REPORT_EXAMPLES, run_report)
    _file(report, "plan", "file of a plan (.npz)")
    _file(report, "file", "HTML file to write")
    _force(report)
    report.add_argument("--period", type=float, default=0.01, metavar="S", help="sampling period, s (default: 0.01)")
    report.add_argument("--title", help="title of the report (default: the robot and the plan's file)")
    margin = _command(commands, "margin", "how far the model may be wrong", MARGIN, MARGIN_EXAMPLES, run_margin)
    _file(margin, "plan", "file of a plan (.npz)")
    named: dict[str, Any] = {"type": _named_number, "action": "append", "default": [], "metavar": "NAME=VALUE"}
    margin.add_argument("--size", **named, help="size that the plan shall cover; repeatable")
    margin.add_argument("--tolerance", type=float, metavar="M", help="allowed deviation of the tip, m (default: any)")
    margin.set_defaults(called={"tolerance=...": "--tolerance M"})
    view = _command(commands, "view", "play motions in a browser", VIEW, VIEW_EXAMPLES, run_view)
    _file(view, "plan", "file of a plan, or of a solution with --robot (.npz)")
    _file(view, "beside", "plans, or trajectories of the same robot, to compare with it", nargs="*", default=[])
    _file(view, "--page", "write one HTML file instead of serving the page")
    _force(view)
    view.add_argument("--title", help="title of the page (default: the robot and the plan's file)")
    _file(view, "--workpiece", "mesh (STL or OBJ; in world, m) that is shown as well")
    view.add_argument("--name", action="append", default=[], help="name of a motion; repeatable, in order of the files")
    view.add_argument("--port", type=int, default=8080, help="port, or the next free one (default: 8080)")
    view.add_argument("--open", action="store_true", help="open the page in this machine's browser")
    view.add_argument("--tolerance", **named, help="tolerance of the audit; repeatable")
    _file(view, "--robot", "URDF file of the robot that a solution moves")
    robot_options(view)
    view.add_argument("--floating", action="store_true", help="the base floats: the state 'base' of the solution")
    view.add_argument("--joints", default="joints", metavar="STATE", help="state of the joints (default: joints)")
    view.add_argument("--base", default="base", metavar="STATE", help="state of the base (default: base)")
    view.set_defaults(called=folder)
    stored = _command(commands, "cache", "show or clear the cache between runs", CACHE, CACHE_EXAMPLES, run_cache)
    stored.add_argument("action", nargs="?", choices=("show", "clear"), default="show", help="(default: show)")
    shell = _command(commands, "completion", "print a script of shell completion", COMPLETION, "", run_completion)
    shell.add_argument("shell", choices=("bash", "zsh"))
    shell.set_defaults(whole=parser, quiet=True)


def _command(
    commands: Any, name: str, short: str, about: str, examples: str, run: CommandFunction
) -> argparse.ArgumentParser:
    """Add a subcommand to the command line, and return the parser of the subcommand."""
    subcommand: argparse.ArgumentParser = commands.add_parser(
        name, help=short, description=about, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    subcommand.add_argument("--json", action="store_true", help="print JSON")
    subcommand.add_argument("--quiet", action="store_true", help="print no progress")
    subcommand.set_defaults(run=run, called={})
    return subcommand


def _file(parser: Any, name: str, description: str, short: str = "", **more: Any) -> None:
    """Add an argument to a parser. The value of the argument is the path of a file."""
    if name.startswith("-"):
        more.setdefault("metavar", "FILE")
    action = parser.add_argument(*([short] if short else []), name, type=Path, help=description, **more)
    action.complete = {"bash": "_shtab_compgen_files", "zsh": "_files"}  # for shtab


def _force(parser: argparse.ArgumentParser) -> None:
    """Add to a parser the option --force, which allows existing files to be overwritten."""
    parser.add_argument("--force", action="store_true", help="also overwrite files that selfmotion did not write")


def robot_options(parser: argparse.ArgumentParser) -> None:
    """Add to a parser the options that describe the robot: tip, locked joints, load, pose of the base, meshes."""
    group = parser.add_argument_group("the robot")
    group.add_argument("--tip", metavar="LINK", help="link that carries the tip")
    group.add_argument(
        "--lock", type=_named_number, action="append", default=[], metavar="JOINT=VALUE", help="locked joint, rad or m"
    )
    group.add_argument("--load", type=float, metavar="KG", help="mass at the origin of the tip, kg")
    pose = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")
    group.add_argument("--mount", nargs=6, type=float, metavar=pose, help="pose of the base in world, m and rad")
    _file(group, "--folder", "folder of package://NAME/... and of meshes; repeatable", action="append", default=[])
    group.add_argument("--no-meshes", action="store_true", help="ignore meshes that are not found")


def check_options(parser: argparse.ArgumentParser) -> None:
    """Add to a parser the options of the subcommand `check`."""
    file = parser.add_argument_group("the file")
    file.add_argument("--columns", metavar="NAMES", help="of a table without a header: time,joint1,...")
    file.add_argument("--period", type=float, metavar="S", help="sampling period of a table or KRL without times, s")
    rules = ("linear", "cubic", "quintic")
    file.add_argument("--rule", choices=rules, help="interpolation of the controller (default: by the contents)")
    file.add_argument("--topic", help="topic of an MCAP with several")
    unit_help = "of the times: s, ms, us, ns, or the seconds from one sample number to the next (default: s)"
    file.add_argument("--time-unit", type=lambda text: float(text) if text[:1].isdigit() else text, help=unit_help)
    file.add_argument("--unwrap", action="store_true", help="unwrap whole turns of joints, as the controller does")
    file.add_argument("--names-confirmed", action="store_true", help="do not check for exchanged columns")
    limits = parser.add_argument_group("limits, besides those of the robot; rad, m, s, N; repeatable for each joint")
    each: dict[str, Any] = {"type": _limit, "action": "append", "default": [], "metavar": "[JOINT=]MAX"}
    for name in CHECKED_LIMITS:
        limits.add_argument(f"--{name}", help=f"largest {name}", **each)
    limits.add_argument(
        "--share", type=float, default=LIMIT_SHARE, metavar="S", help="tolerance relative to a limit (default: 0.001)"
    )
    standing = parser.add_argument_group("the base")
    base = standing.add_mutually_exclusive_group()
    base.add_argument("--standing", action="store_true", help="on the ground: check the zero moment point")
    base.add_argument("--floating", action="store_true", help="in space: check the momentum")
    corners = ("X0", "X1", "Y0", "Y1")
    standing.add_argument("--foot", nargs=4, type=float, metavar=corners, help="contact area, m (default: from shapes)")
    standing.add_argument("--friction", type=float, default=np.inf, help="coefficient of friction (default: no limit)")
    scene = parser.add_argument_group("the scene")
    _file(scene, "--obstacles", "TOML of [[obstacle]] tables: shape, size, position, ...")
    scene.add_argument("--clearance", type=float, default=0.0, metavar="M", help="required distance, m (default: 0)")
    scene.add_argument("--no-clearance", action="store_true", help="do not check distances")
    scene.add_argument(
        "--ignore", type=_pair, action="append", default=[], metavar="LINK,LINK", help="ignored pair; repeatable"
    )
    _file(scene, "--srdf", "SRDF file whose disabled pairs are ignored")
    path = parser.add_argument_group("the tip's path")
    _file(path, "--path", "waypoints (CSV: x, y, z) that the tip must follow on straight lines")
    distance_help = "largest distance from the path, m (default: 1e-4, at most 0.001 of the path's extent)"
    path.add_argument("--path-tolerance", type=float, metavar="M", help=distance_help)
    angle_help = f"largest angle of its z axis from the file's, rad (default: {ORIENTATION_TOLERANCE_RAD})"
    path.add_argument("--path-angle", type=float, default=ORIENTATION_TOLERANCE_RAD, metavar="RAD", help=angle_help)


def _limit(text: str) -> tuple[str, float]:
    """Parse "JOINT=NUMBER" or "NUMBER". Return the name of the joint, "" if there is none, and the number."""
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor JOINT=NUMBER") from None


def _named_number(text: str) -> tuple[str, float]:
    """Parse "NAME=VALUE", and return the name and the number."""
    name, value = _limit(text)
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


def _pair(text: str) -> tuple[str, str]:
    """Parse "LINK,LINK", and return the names of the two links."""
    first, comma, second = text.partition(",")
    if not comma or not first.strip() or not second.strip():
        raise argparse.ArgumentTypeError(f"{text!r} is not two names, LINK,LINK")
    return first.strip(), second.strip()


if __name__ == "__main__":
    sys.exit(main())
