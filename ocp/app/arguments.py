"""Define the subcommands of `selfmotion` with their options, and run them."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models import FixedBase, FreeFloating, Robot, lock_joints, rectangle, with_load
from models import files as cache
from models.checks import Array
from models.spatial import rotation_from_rpy
from ocp.app.check.verdict import bounds_of, check_trajectory
from ocp.app.files import read_trajectory, read_waypoints
from ocp.app.files.outputs import SUFFIXES, checked_output
from ocp.app.files.task_file import read_obstacles, read_task
from ocp.app.files.text_files import missing_package
from ocp.app.run_task import EXPORT_KINDS, check_period, export_plan, run_task
from ocp.motion.plan import Plan
from ocp.progress import Progress
from ocp.storage import write_text
from ocp.tolerances import LIMIT_SHARE, ORIENTATION_TOLERANCE_RAD

__all__ = ["CommandFunction", "subcommands"]

CommandFunction: TypeAlias = Callable[[argparse.Namespace, Progress], tuple[int, str, Any]]
"""Function of a subcommand: options and progress to exit status, text and contents of JSON."""

CHECK = """Check a joint trajectory from any source: limits, jumps, units, and clearance proven between the samples.

TRAJECTORY is a CSV with a header (time, and the joints by name; optionally NAME.velocity, NAME.acceleration; a unit
may follow in brackets: `elbow [deg]`), a JointTrajectory as JSON or YAML, or an MCAP. Between samples the motion is
interpolated as controllers do: linearly from positions alone, by cubics with velocities, by quintics with
accelerations. Without --rule, a velocity or acceleration between samples counts only as far as every motion through
the samples needs it."""
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
EXPORT = """Write a plan in the format of the file's suffix: .csv, .json and .yaml (the fields of a ROS 2
JointTrajectory), .mcap (joint states and the tip's path, for ROS 2 and Foxglove), .urdf (the robot of the plan)."""
EXPORT_EXAMPLES = """examples:
  selfmotion export seam.npz seam.csv --period 0.004
  selfmotion export seam.npz seam.mcap"""
REPORT = """Write one HTML file about a plan: the verdict in a sentence, pictures, curves with limits, the audit with
units. The file loads nothing from another host."""
REPORT_EXAMPLES = """examples:
  selfmotion report seam.npz seam.html --title "Seam 4, cell 2\""""
VIEW = """Show motions: the robot with its meshes, the required and the actual path, frames, ghosts, curves of joints
and torques with their limits, cost, manipulability, momentum or zero moment point, the closest bodies, and the audit.

The first file is a plan of `selfmotion plan`; other files are compared with it: plans, or trajectories of the same
robot as `selfmotion check` reads them. A solution of your own problem (Solution.save) is shown with --robot. Without
--page the page is served on this machine until Ctrl-C; with it it is one file that plays anywhere, without a server."""
VIEW_EXAMPLES = """examples:
  selfmotion view seam.npz
  selfmotion view seam.npz --page seam.html
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
    _file(check, "--report", "also write one HTML file: pictures, curves with limits, every row")
    _force(check)
    plan = _command(commands, "plan", "plan the motion of a task file", PLAN, PLAN_EXAMPLES, run_plan)
    plan.set_defaults(
        called={
            "missing='skip'": '[scene] meshes = "skip"',
            "folders=[": "[scene] folders = [",
            "search='segments'": '[search] kind = "segments"',
            "horizon='free'": '[search] pace = "free"',
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
    report = _command(commands, "report", "one HTML file about a plan", REPORT, REPORT_EXAMPLES, run_report)
    _file(report, "plan", "file of a plan (.npz)")
    _file(report, "file", "HTML file to write")
    _force(report)
    report.add_argument("--period", type=float, default=0.01, metavar="S", help="sampling period, s (default: 0.01)")
    report.add_argument("--title", help="title of the report (default: the plan's file)")
    view = _command(commands, "view", "play motions in a browser", VIEW, VIEW_EXAMPLES, run_view)
    _file(view, "plan", "file of a plan, or of a solution with --robot (.npz)")
    _file(view, "beside", "plans, or trajectories of the same robot, to compare with it", nargs="*", default=[])
    _file(view, "--page", "write one HTML file instead of serving the page")
    _force(view)
    view.add_argument("--title", help="title of the page (default: the plan's file)")
    view.add_argument("--name", action="append", default=[], help="name of a motion; repeatable, in order of the files")
    view.add_argument("--port", type=int, default=8080, help="port, or the next free one (default: 8080)")
    view.add_argument("--open", action="store_true", help="open the page in this machine's browser")
    view.add_argument(
        "--tolerance",
        type=_named_number,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="tolerance of the audit; repeatable",
    )
    _file(view, "--robot", "URDF file of the robot that a solution moves")
    robot_options(view)
    view.add_argument("--floating", action="store_true", help="the base floats: the state 'base' of the solution")
    view.add_argument("--joints", default="joints", metavar="STATE", help="state of the joints (default: joints)")
    view.add_argument("--base", default="base", metavar="STATE", help="state of the base (default: base)")
    view.set_defaults(called={"folders=[FOLDER]": "--folder FOLDER"})
    stored = _command(commands, "cache", "show or clear the cache between runs", CACHE, CACHE_EXAMPLES, run_cache)
    stored.add_argument("action", nargs="?", choices=("show", "clear"), default="show", help="(default: show)")
    shell = _command(commands, "completion", "print a script of shell completion", COMPLETION, "", run_completion)
    shell.add_argument("shell", choices=("bash", "zsh"))
    shell.set_defaults(whole=parser, quiet=True)


def _command(
    commands: Any, name: str, short: str, about: str, examples: str, run: CommandFunction
) -> argparse.ArgumentParser:
    """Add a subcommand."""
    subcommand: argparse.ArgumentParser = commands.add_parser(
        name, help=short, description=about, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    subcommand.add_argument("--json", action="store_true", help="print JSON")
    subcommand.add_argument("--quiet", action="store_true", help="print no progress")
    subcommand.set_defaults(run=run, called={})
    return subcommand


def _file(parser: Any, name: str, description: str, short: str = "", **more: Any) -> None:
    """Add an argument that names a file."""
    if name.startswith("-"):
        more.setdefault("metavar", "FILE")
    action = parser.add_argument(*([short] if short else []), name, type=Path, help=description, **more)
    action.complete = {"bash": "_shtab_compgen_files", "zsh": "_files"}  # for shtab


def _force(parser: argparse.ArgumentParser) -> None:
    """Add --force."""
    parser.add_argument("--force", action="store_true", help="also overwrite files that selfmotion did not write")


def robot_options(parser: argparse.ArgumentParser) -> None:
    """Add the options with which a URDF is read."""
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
    """Add the options of `check`."""
    file = parser.add_argument_group("the file")
    file.add_argument("--columns", metavar="NAMES", help="of a table without a header: time,joint1,...")
    file.add_argument("--period", type=float, metavar="S", help="sampling period of a table without times, s")
    rules = ("linear", "cubic", "quintic")
    file.add_argument("--rule", choices=rules, help="interpolation of the controller (default: by the contents)")
    file.add_argument("--topic", help="topic of an MCAP with several")
    unit_help = "of the times: s, ms, us, ns, or the seconds from one sample number to the next (default: s)"
    file.add_argument("--time-unit", type=lambda text: float(text) if text[:1].isdigit() else text, help=unit_help)
    file.add_argument("--unwrap", action="store_true", help="unwrap whole turns of joints, as the controller does")
    file.add_argument("--names-confirmed", action="store_true", help="do not check for exchanged columns")
    limits = parser.add_argument_group("limits, besides those of the robot; rad, m, s, N; repeatable for each joint")
    for quantity in ("velocity", "acceleration", "jerk", "torque"):
        limits.add_argument(
            f"--{quantity}", type=_limit, action="append", default=[], metavar="[JOINT=]MAX", help=f"largest {quantity}"
        )
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


def run_check(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion check`."""
    if options.report is not None:
        checked_output("report", options.report, force=options.force)
    progress("reading the robot")
    robot = read_robot(options)
    translation, rotation = base_pose(options)
    progress("reading the trajectory")
    joint_names = [joint.name for joint in robot.joints if joint.moves]
    columns = None if options.columns is None else [name.strip() for name in options.columns.split(",")]
    raw = read_trajectory(
        options.trajectory, columns=columns, period=options.period, topic=options.topic, joints=joint_names
    )
    foot = rectangle(options.foot[:2], options.foot[2:]) if options.foot else None
    limits: dict[str, Any] = {
        kind: dict(getattr(options, kind)) or None for kind in ("velocity", "acceleration", "jerk", "torque")
    }
    obstacles = read_obstacles(options.obstacles) if options.obstacles else ()
    direct = ("friction", "srdf", "path_tolerance", "path_angle", "share", "rule", "time_unit", "unwrap")
    check = check_trajectory(
        robot,
        raw,
        **limits,
        **{name: getattr(options, name) for name in (*direct, "names_confirmed")},
        base="standing" if options.standing else "floating" if options.floating else "fixed",
        translation=translation,
        rotation=rotation,
        foot=foot,
        obstacles=obstacles,
        clearance=None if options.no_clearance else options.clearance,
        ignored=tuple(options.ignore),
        folders=tuple(options.folder),
        missing="skip" if options.no_meshes else "raise",
        path=read_waypoints(options.path) if options.path else None,
        progress=progress,
    )
    if options.report is not None:
        progress("report")
        from ocp.app.view.pictures import obstacles_of_shapes
        from ocp.app.view.report import report_of_check  # imports matplotlib, which is slow

        machine = FreeFloating(robot) if options.floating else FixedBase(robot, translation, rotation)
        report = report_of_check(
            check, machine, bounds_of(robot, **limits), obstacles_of_shapes(obstacles), tuple(options.folder)
        )
        write_text(checked_output("report", options.report, force=options.force), report.html())
    return (0 if check.passed else 1), str(check), check.to_dict()


def run_plan(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion plan`."""
    progress("reading the task")
    task = read_task(options.task, options.output_folder)
    progress("planning")
    return run_task(task, options.output, progress, options.force)


def run_export(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion export`."""
    progress("writing")
    export_plan(Plan.load(options.plan), options.file, options.period, options.force)
    return 0, f"written: {options.file}", {"written": str(options.file)}


def run_report(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion report`."""
    from ocp.app.view.report import report_of_plan

    file = checked_output("report", options.file, force=options.force)
    plan = Plan.load(options.plan)
    check_period(plan, options.period)
    progress("audit")
    report = report_of_plan(plan, options.period, options.title or str(options.plan))
    write_text(file, report.html())
    data = {"written": str(options.file), "passed": report.passed, "verdict": report.verdict}
    return (0 if report.passed else 1), f"{report.verdict}\nwritten: {options.file}", data


def run_view(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion view`."""
    from ocp.app.view.player import PageServer, build_page

    if options.page is not None:
        checked_output("report", options.page, force=options.force)
    progress("reading the motions")
    motions = motions_of(options)
    progress("drawing")
    html, missing = build_page(
        motions, title=options.title or options.plan.name, folders=options.folder, meshes=not options.no_meshes
    )
    for name, reason in missing.items():
        progress.say(f"{name} is not shown: {reason}")
    main = motions[0]
    data = {"passed": main.passed, "verdict": main.verdict, "duration": float(main.t[-1]), "missing": missing}
    status = 1 if main.passed is False else 0
    if options.page is not None:
        write_text(checked_output("report", options.page, force=options.force), html)
        data |= {"written": str(options.page), "bytes": len(html.encode())}
        return status, f"{main.verdict}\nwritten: {options.page}".strip(), data
    with PageServer(html, options.port) as served:
        print(f"{options.plan.name} on {served.address}; Ctrl-C ends it", file=sys.stderr, flush=True)
        if options.open:
            webbrowser.open(served.address)
        served.wait()
    return status, main.verdict, {**data, "address": served.address}


def motions_of(options: argparse.Namespace) -> list[Any]:
    """Return the motions in the files of `view`, the plan first."""
    from ocp.app.view.animation import animate_plan, animate_solution, animate_trajectory
    from ocp.solution import Solution

    files = [options.plan, *options.beside]
    base_names = [file.name for file in files]
    names = [file.name if base_names.count(file.name) == 1 else str(file) for file in files]
    names[: len(options.name)] = options.name[: len(files)]

    machine: Any = None
    tolerances: dict[str, Any] = {"tolerances": dict(options.tolerance)} if options.tolerance else {}
    if options.robot is not None:
        robot = read_robot(options)
        machine = FreeFloating(robot) if options.floating else FixedBase(robot, *base_pose(options))
        states = {"joints": options.joints, "base": options.base}
        motions = [animate_solution(Solution.load(options.plan), machine, names[0], **states, **tolerances)]
    else:
        plan = Plan.load(options.plan)
        machine, motions = plan.machine, [animate_plan(plan, names[0], **tolerances)]
    for file, name in zip(options.beside, names[1:], strict=True):
        if file.suffix.lower() != ".npz":
            joint_names = [joint.name for joint in machine.robot.joints if joint.moves]
            motions.append(animate_trajectory(read_trajectory(file, joints=joint_names), machine, name))
        elif options.robot is not None:
            motions.append(animate_solution(Solution.load(file), machine, name, **states, **tolerances))
        else:
            motions.append(animate_plan(Plan.load(file), name, **tolerances))
    return motions


def run_cache(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion cache`."""
    files = cache.cache_files()
    size = sum(file.stat().st_size for file in files)
    if options.action == "clear":
        for file in files:
            file.unlink(missing_ok=True)
    state = "cleared" if options.action == "clear" else "in use"
    data = {
        "folder": str(cache.cache_folder()),
        "files": len(files),
        "libraries": sum(file.suffix == ".so" for file in files),
        "bytes": size,
        "cleared": options.action == "clear",
    }
    summary = f"{len(files)} files, {data['libraries']} of them compiled functions, {size / 1e6:.3g} MB {state}"
    return 0, f"{cache.cache_folder()}: {summary}", data


def run_completion(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion completion`."""
    try:
        import shtab
    except ImportError as error:
        raise missing_package("shell completion", "shtab", "completion") from error
    script = shtab.complete(options.whole, options.shell)
    return 0, script, {"shell": options.shell, "script": script}


def read_robot(options: argparse.Namespace) -> Robot:
    """Return the robot of the options, with locked joints and load."""
    robot = Robot.from_urdf(options.robot, tip=options.tip)
    if options.lock:
        robot = lock_joints(robot, dict(options.lock))
    if options.load is not None:
        robot = with_load(robot, robot.tip_link, options.load, robot.tip_translation)
    return robot


def base_pose(options: argparse.Namespace) -> tuple[Array, Array]:
    """Return translation (3,), m, and rotation (3, 3) of the base in world."""
    numbers = options.mount or [0.0] * 6
    return np.array(numbers[:3]), np.array(rotation_from_rpy(*numbers[3:]), dtype=float)


def _limit(text: str) -> tuple[str, float]:
    """Return the joint, or "", and the number of JOINT=NUMBER or NUMBER."""
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor JOINT=NUMBER") from None


def _named_number(text: str) -> tuple[str, float]:
    """Return the name and the number of NAME=VALUE."""
    name, value = _limit(text)
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


def _pair(text: str) -> tuple[str, str]:
    """Return the two names of LINK,LINK."""
    first, comma, second = text.partition(",")
    if not comma or not first.strip() or not second.strip():
        raise argparse.ArgumentTypeError(f"{text!r} is not two names, LINK,LINK")
    return first.strip(), second.strip()
