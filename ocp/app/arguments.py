"""Options of each command, and what is done with them."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models import FixedBase, FreeFloating, Robot, cache, locked, rectangle, with_load
from models.arrays import Array
from models.spatial import rotation_from_rpy
from ocp.app.check.verdict import bounds_of, check_trajectory
from ocp.app.files import read_trajectory, read_waypoints
from ocp.app.files.outputs import SUFFIXES, checked_output
from ocp.app.files.task_file import read_obstacles, read_task
from ocp.app.progress import Progress
from ocp.app.run_task import EXPORT_KINDS, check_period, export_plan, run_task
from ocp.errors import ProblemError
from ocp.motion.plan import Plan
from ocp.storage import write_text
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD

__all__ = ["CommandFunction", "subcommands"]

CommandFunction: TypeAlias = Callable[[argparse.Namespace, Progress], tuple[int, str, Any]]
"""What a command does: options and progress to exit status, text and what JSON shows."""

CHECK = """Check anybody's trajectory for a robot: limits, jumps, units, clearance proven between the samples.

TRAJECTORY is a CSV with a head (time, and the joints by name; NAME.velocity, NAME.acceleration if there are; a unit
may stand in brackets: `elbow [deg]`), a JointTrajectory as JSON or YAML, or an MCAP. Between samples the motion is
what a controller makes of it: straight lines from positions alone, cubics with velocities, quintics with
accelerations. Without --rule, velocities and accelerations between samples count as far as every motion through the
samples has them."""
CHECK_EXAMPLES = """examples:
  selfmotion check panda.urdf motion.csv
  selfmotion check panda.urdf motion.csv --acceleration 15 --jerk 7500 --acceleration panda_joint1=10
  selfmotion check ur5.urdf log.mcap --tip tool0 --path seam.csv --path-tolerance 0.002 --obstacles cell.toml
  selfmotion check tiago.urdf reach.json --lock gripper_finger_joint=0.02 --standing
  selfmotion check motion.urdf motion.csv --json | jq .faults"""


PLAN = """Plan the cheapest motion that a task file asks for, audit it, and write what the file says.

The task file is TOML: [robot] urdf, tip; [path] file or points, speed; and if wanted [limits], [cost], [search],
[scene], [[obstacle]], [output]. What is wrong in it is said with its line and what was expected."""
PLAN_EXAMPLES = """examples:
  selfmotion plan seam.toml -o seam.npz
  selfmotion plan seam.toml --json | jq .cost

seam.toml:
  [robot]
  urdf = "ur5_robot.urdf"
  tip = "tool0"
  [path]
  points = [[0.4, -0.2, 0.3], [0.4, 0.2, 0.3]]    # m; or file = "seam.csv"
  speed = 0.05                                    # m/s
  direction = [0, 0, -1]                          # of the tool's z axis; its roll is free
  [[obstacle]]
  shape = "halfspace"
  normal = [0, 0, 1]
  point = [0, 0, -0.05]
  [output]
  plan = "seam.npz"
  csv = "seam.csv"
  report = "seam.html\""""
EXPORT = """Write a plan in another format, by the end of the file's name: .csv, .json and .yaml (the fields of a ROS 2
JointTrajectory), .mcap (joint states and the tip's path, for ROS 2 and Foxglove), .urdf (the robot as it was planned
with)."""
EXPORT_EXAMPLES = """examples:
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion export seam.npz seam.mcap"""
REPORT = """One HTML file about a plan: the verdict in a sentence, pictures, curves with limits, the audit with units.
It asks nothing from another host."""
REPORT_EXAMPLES = """examples:
  selfmotion report seam.npz seam.html --title "Seam 4, cell 2\""""
VIEW = """Show motions: the robot with its meshes, the path asked for and the one done, frames, ghosts, curves of joints
and torques with their limits, cost, manipulability, momentum or zero moment point, the nearest bodies, and the audit.

The first file is a plan of `selfmotion plan`; others are held against it: plans, or trajectories of the same robot as
`selfmotion check` reads them. A solution of a problem of your own (Solution.save) is shown with --robot. Without --page
the page is served on this machine until Ctrl-C; with it it is one file that plays anywhere, without a server."""
VIEW_EXAMPLES = """examples:
  selfmotion view seam.npz
  selfmotion view seam.npz --page seam.html
  selfmotion view optimum.npz pseudo_inverse.csv --page both.html
  selfmotion view circle.npz --robot panda.urdf --tip panda_hand_tcp --lock panda_finger_joint1=0.02"""
CACHE = """What is dear to compute and depends on nothing but its input (covers of meshes, pairs that never touch, the
functions of problems as the C compiler made them) is kept in $XDG_CACHE_HOME/selfmotion, else ~/.cache/selfmotion.
Cleared, it is computed again. Compiled functions take 256 MB at most: those not used for longest make room."""
CACHE_EXAMPLES = """examples:
  selfmotion cache
  selfmotion cache clear"""
COMPLETION = """Print a script that completes commands, options and file names.

It is made once, so that no tab starts Python:

  selfmotion completion bash > ~/.local/share/bash-completion/completions/selfmotion
  selfmotion completion zsh  > ~/.zsh/functions/_selfmotion        # a folder of $fpath"""


def subcommands(parser: argparse.ArgumentParser) -> None:
    """Add all commands to a parser."""
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    check = _command(commands, "check", "check anybody's trajectory", CHECK, CHECK_EXAMPLES, run_check)
    _file(check, "robot", "URDF file of the robot")
    _file(check, "trajectory", "CSV, JointTrajectory as JSON or YAML, or MCAP")
    check.set_defaults(
        called={
            "folders=[FOLDER]": "--folder FOLDER",
            "missing='skip'": "--no-meshes",
            "models.rectangle(...)": "--foot",
        }
    )
    robot_options(check)
    check_options(check)
    _file(check, "--report", "write one HTML file, too: pictures, curves with limits, every row")
    _force(check)
    plan = _command(commands, "plan", "plan what a task file asks for", PLAN, PLAN_EXAMPLES, run_plan)
    plan.set_defaults(called={"missing='skip'": '[scene] meshes = "skip"', "folders=[": "[scene] folders = ["})
    _file(plan, "task", "TOML file")
    _file(plan, "--output", "the plan (.npz), whatever the task file says", short="-o")
    _file(plan, "--output-folder", "where the task's outputs lie, or below (default: the task file's folder)")
    _force(plan)
    other = _command(commands, "export", "write a plan in another format", EXPORT, EXPORT_EXAMPLES, run_export)
    _file(other, "plan", "file of a plan (.npz)")
    _file(other, "file", f"to write: {', '.join(SUFFIXES[kind][0] for kind in EXPORT_KINDS)}")
    _force(other)
    other.add_argument("--period", type=float, default=0.01, metavar="S", help="of samples, s (default: 0.01)")
    report = _command(commands, "report", "one HTML file about a plan", REPORT, REPORT_EXAMPLES, run_report)
    _file(report, "plan", "file of a plan (.npz)")
    _file(report, "file", "HTML file to write")
    _force(report)
    report.add_argument("--period", type=float, default=0.01, metavar="S", help="of samples, s (default: 0.01)")
    report.add_argument("--title", help="of the report; the plan's file if not told")
    view = _command(commands, "view", "play motions in a browser", VIEW, VIEW_EXAMPLES, run_view)
    _file(view, "plan", "file of a plan, or of a solution with --robot (.npz)")
    _file(view, "beside", "plans, or trajectories of the same robot, to hold against it", nargs="*", default=[])
    _file(view, "--page", "write one HTML file, and serve nothing")
    _force(view)
    view.add_argument("--title", help="of the page; the plan's file if not told")
    view.add_argument("--name", action="append", default=[], help="of a motion; repeatable, in the order of the files")
    view.add_argument("--port", type=int, default=8080, help="to serve on, or the next that is free (default: 8080)")
    view.add_argument("--open", action="store_true", help="open it in this machine's browser")
    view.add_argument(
        "--tolerance",
        type=_tolerance,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="of the audit; repeatable",
    )
    _file(view, "--robot", "URDF file of the robot that a solution moves")
    robot_options(view)
    view.add_argument("--floating", action="store_true", help="its base floats: the state 'base' of the solution")
    view.add_argument("--joints", default="joints", metavar="STATE", help="of the solution (default: joints)")
    view.add_argument("--base", default="base", metavar="STATE", help="of the solution (default: base)")
    view.set_defaults(called={"folders=[FOLDER]": "--folder FOLDER"})
    kept = _command(commands, "cache", "show or clear what is kept between runs", CACHE, CACHE_EXAMPLES, run_cache)
    kept.add_argument("action", nargs="?", choices=("show", "clear"), default="show", help="(default: show)")
    shell = _command(commands, "completion", "print a script of shell completion", COMPLETION, "", run_completion)
    shell.add_argument("shell", choices=("bash", "zsh"))
    shell.set_defaults(whole=parser, quiet=True)


def _command(
    commands: Any, name: str, short: str, about: str, examples: str, run: CommandFunction
) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = commands.add_parser(
        name, help=short, description=about, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--json", action="store_true", help="print JSON")
    made.add_argument("--quiet", action="store_true", help="say nothing of progress")
    made.set_defaults(run=run, called={})
    return made


def _file(parser: Any, name: str, words: str, short: str = "", **more: Any) -> None:
    if name.startswith("-"):
        more.setdefault("metavar", "FILE")
    action = parser.add_argument(*([short] if short else []), name, type=Path, help=words, **more)
    action.complete = {"bash": "_shtab_compgen_files", "zsh": "_files"}  # for shtab


def _force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--force", action="store_true", help="overwrite files that selfmotion did not write, too")


def robot_options(parser: argparse.ArgumentParser) -> None:
    """How a URDF is read."""
    group = parser.add_argument_group("the robot")
    group.add_argument("--tip", metavar="LINK", help="link that carries the tip")
    group.add_argument(
        "--lock", type=_named_number, action="append", default=[], metavar="JOINT=VALUE", help="joint held at rad or m"
    )
    group.add_argument("--load", type=float, metavar="KG", help="mass that the tip carries at its origin")
    pose = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")
    group.add_argument("--mount", nargs=6, type=float, metavar=pose, help="of the base in world, m and rad")
    _file(group, "--folder", "where package://NAME/... and meshes are; repeatable", action="append", default=[])
    group.add_argument("--no-meshes", action="store_true", help="go on without meshes that are not found")


def check_options(parser: argparse.ArgumentParser) -> None:
    """What is looked at."""
    file = parser.add_argument_group("the file")
    file.add_argument("--columns", metavar="NAMES", help="of a table without a head: time,joint1,...")
    file.add_argument("--period", type=float, metavar="S", help="of the samples, where there is no time")
    rules = ("linear", "cubic", "quintic")
    file.add_argument("--rule", choices=rules, help="how the controller joins samples (default: by what the file has)")
    file.add_argument("--topic", help="of an MCAP with several")
    words = "of the times: s, ms, us, ns, or the seconds from one sample number to the next (default: s)"
    file.add_argument("--time-unit", type=lambda text: float(text) if text[:1].isdigit() else text, help=words)
    file.add_argument(
        "--unwrap", action="store_true", help="joints wrapped by whole turns turn on, as the controller does"
    )
    file.add_argument("--names-confirmed", action="store_true", help="do not suspect columns to be exchanged")
    limits = parser.add_argument_group(
        "limits, beside those of the robot; rad, m, s, N; repeatable, one joint at a time"
    )
    for what in ("velocity", "acceleration", "jerk", "torque"):
        limits.add_argument(
            f"--{what}", type=_limit, action="append", default=[], metavar="[JOINT=]MOST", help=f"greatest {what}"
        )
    limits.add_argument(
        "--share", type=float, default=LIMIT_SHARE, metavar="S", help="of a limit that may be passed (default: 0.001)"
    )
    stands = parser.add_argument_group("the base")
    base = stands.add_mutually_exclusive_group()
    base.add_argument("--standing", action="store_true", help="it stands unfastened: look at its zero moment point")
    base.add_argument("--floating", action="store_true", help="it floats in space: look at its momentum")
    corners = ("X0", "X1", "Y0", "Y1")
    stands.add_argument("--foot", nargs=4, type=float, metavar=corners, help="what it stands on, m; else its shapes")
    stands.add_argument("--friction", type=float, default=np.inf, help="of the ground (default: no limit)")
    around = parser.add_argument_group("scene")
    _file(around, "--obstacles", "TOML of [[obstacle]] tables: shape, size, position, ...")
    around.add_argument("--clearance", type=float, default=0.0, metavar="M", help="least distance, m (default: 0)")
    around.add_argument("--no-clearance", action="store_true", help="do not look at distances")
    around.add_argument(
        "--ignore", type=_pair, action="append", default=[], metavar="LINK,LINK", help="pair that may touch; repeatable"
    )
    _file(around, "--srdf", "SRDF file whose disabled pairs may touch")
    path = parser.add_argument_group("the tip's path")
    _file(path, "--path", "waypoints (CSV: x, y, z) that the tip is to pass on straight lines")
    words = "that it may be off, m (default: 1e-4, at most 0.001 of the path's extent)"
    path.add_argument("--path-tolerance", type=float, metavar="M", help=words)
    words = f"that its z axis may lean from the file's, rad (default: {ORIENTATION_TOLERANCE_RAD})"
    path.add_argument("--path-angle", type=float, default=ORIENTATION_TOLERANCE_RAD, metavar="RAD", help=words)


def run_check(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `check`."""
    if options.report is not None:
        checked_output("report", options.report, force=options.force)
    progress("reading the robot")
    robot = read_robot(options)
    place, turn = base_pose(options)
    progress("reading the trajectory")
    moving = [joint.name for joint in robot.joints if joint.moves]
    columns = None if options.columns is None else [name.strip() for name in options.columns.split(",")]
    raw = read_trajectory(
        options.trajectory, columns=columns, period=options.period, topic=options.topic, joints=moving
    )
    foot = rectangle(options.foot[:2], options.foot[2:]) if options.foot else None
    limits: dict[str, Any] = {
        what: dict(getattr(options, what)) or None for what in ("velocity", "acceleration", "jerk", "torque")
    }
    obstacles = read_obstacles(options.obstacles) if options.obstacles else ()
    found = check_trajectory(
        robot,
        raw,
        **limits,
        base="standing" if options.standing else "floating" if options.floating else "fixed",
        translation=place,
        rotation=turn,
        foot=foot,
        friction=options.friction,
        obstacles=obstacles,
        clearance=None if options.no_clearance else options.clearance,
        ignored=tuple(options.ignore),
        srdf=options.srdf,
        folders=tuple(options.folder),
        missing="skip" if options.no_meshes else "raise",
        path=read_waypoints(options.path) if options.path else None,
        path_tolerance=options.path_tolerance,
        path_angle=options.path_angle,
        share=options.share,
        rule=options.rule,
        time_unit=options.time_unit,
        unwrap=options.unwrap,
        names_confirmed=options.names_confirmed,
        progress=progress,
    )
    if options.report is not None:
        progress("report")
        from ocp.app.view.pictures import obstacles_of_shapes
        from ocp.app.view.report import report_of_check  # draws, which takes a while to import

        machine = FreeFloating(robot) if options.floating else FixedBase(robot, place, turn)
        report = report_of_check(
            found, machine, bounds_of(robot, **limits), obstacles_of_shapes(obstacles), tuple(options.folder)
        )
        write_text(checked_output("report", options.report, force=options.force), report.html())
    return (0 if found.passed else 1), str(found), found.to_dict()


def run_plan(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `plan`."""
    progress("reading the task")
    task = read_task(options.task, options.output_folder)
    progress("planning")
    return run_task(task, options.output, progress, options.force)


def run_export(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `export_plan`."""
    made = Plan.load(options.plan)
    progress("writing")
    export_plan(made, options.file, options.period, options.force)
    return 0, f"written: {options.file}", {"written": str(options.file)}


def run_report(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `report`."""
    from ocp.app.view.report import report_of_plan

    file = checked_output("report", options.file, force=options.force)
    made = Plan.load(options.plan)
    check_period(made, options.period)
    progress("audit")
    report = report_of_plan(made, options.period, options.title or str(options.plan))
    write_text(file, report.html())
    told = {"written": str(options.file), "passed": report.passed, "verdict": report.verdict}
    return (0 if report.passed else 1), f"{report.verdict}\nwritten: {options.file}", told


def run_view(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `view`."""
    from ocp.app.view.player import PageServer, build_page

    if options.page is not None:
        checked_output("report", options.page, force=options.force)
    progress("reading the motions")
    shown = motions_of(options)
    progress("drawing")
    text, missing = build_page(
        shown, title=options.title or options.plan.name, folders=options.folder, meshes=not options.no_meshes
    )
    for name, reason in missing.items():
        progress.say(f"not shown: {name}: {reason}")
    first = shown[0]
    told = {"passed": first.passed, "verdict": first.verdict, "duration": float(first.t[-1]), "missing": missing}
    status = 1 if first.passed is False else 0
    if options.page is not None:
        write_text(checked_output("report", options.page, force=options.force), text)
        told |= {"written": str(options.page), "bytes": len(text.encode())}
        return status, f"{first.verdict}\nwritten: {options.page}".strip(), told
    with PageServer(text, options.port) as served:
        print(f"{options.plan.name} on {served.address}; Ctrl-C ends it", file=sys.stderr, flush=True)
        if options.open:
            webbrowser.open(served.address)
        served.wait()
    return status, first.verdict, {**told, "address": served.address}


def motions_of(options: argparse.Namespace) -> list[Any]:
    """What the files of `view` hold, the plan first."""
    from ocp.app.view.animation import animate_plan, animate_solution, animate_trajectory
    from ocp.solution import Solution

    files = [options.plan, *options.beside]
    names = [file.name if [one.name for one in files].count(file.name) == 1 else str(file) for file in files]
    names[: len(options.name)] = options.name[: len(files)]

    machine: Any = None
    allowed: dict[str, Any] = {"tolerances": dict(options.tolerance)} if options.tolerance else {}
    if options.robot is not None:
        robot = read_robot(options)
        machine = FreeFloating(robot) if options.floating else FixedBase(robot, *base_pose(options))
        states = {"joints": options.joints, "base": options.base}
        found = [animate_solution(Solution.load(options.plan), machine, names[0], **states, **allowed)]
    else:
        made = Plan.load(options.plan)
        machine, found = made.machine, [animate_plan(made, names[0], **allowed)]
    for file, name in zip(options.beside, names[1:], strict=True):
        if file.suffix.lower() != ".npz":
            moving = [joint.name for joint in machine.robot.joints if joint.moves]
            found.append(animate_trajectory(read_trajectory(file, joints=moving), machine, name))
        elif options.robot is not None:
            found.append(animate_solution(Solution.load(file), machine, name, **states, **allowed))
        else:
            found.append(animate_plan(Plan.load(file), name, **allowed))
    return found


def run_cache(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `cache`."""
    files = cache.files()
    size = sum(file.stat().st_size for file in files)
    if options.action == "clear":
        for file in files:
            file.unlink(missing_ok=True)
    word = "cleared" if options.action == "clear" else "kept"
    told = {
        "folder": str(cache.folder()),
        "files": len(files),
        "libraries": sum(file.suffix == ".so" for file in files),
        "bytes": size,
        "cleared": options.action == "clear",
    }
    words = f"{len(files)} files, {told['libraries']} of them compiled functions, {size / 1e6:.3g} MB {word}"
    return 0, f"{cache.folder()}: {words}", told


def run_completion(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """The command `completion`."""
    try:
        import shtab
    except ImportError as error:
        words = "scripts of shell completion are made by the package shtab: pip install 'selfmotion[completion]'"
        raise ProblemError(words, name="shtab") from error
    script = shtab.complete(options.whole, options.shell)
    return 0, script, {"shell": options.shell, "script": script}


def read_robot(options: argparse.Namespace) -> Robot:
    """The robot as the options read it."""
    robot = Robot.from_urdf(options.robot, tip=options.tip)
    if options.lock:
        robot = locked(robot, dict(options.lock))
    if options.load is not None:
        robot = with_load(robot, robot.tip_link, options.load, robot.tip_translation)
    return robot


def base_pose(options: argparse.Namespace) -> tuple[Array, Array]:
    """Translation (3,), m, and rotation (3, 3) of the base in world."""
    numbers = options.mount or [0.0] * 6
    return np.array(numbers[:3]), np.array(rotation_from_rpy(*numbers[3:]), dtype=float)


def _limit(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, nor JOINT=NUMBER") from None


def _named_number(text: str) -> tuple[str, float]:
    name, value = _limit(text)
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not JOINT=VALUE")
    return name, value


def _tolerance(text: str) -> tuple[str, float]:
    name, value = _limit(text)
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, NAME of a state, control or constraint")
    return name, value


def _pair(text: str) -> tuple[str, str]:
    one, comma, other = text.partition(",")
    if not comma or not one.strip() or not other.strip():
        raise argparse.ArgumentTypeError(f"{text!r} is not two names, LINK,LINK")
    return one.strip(), other.strip()
