"""Functions that run the subcommands of `selfmotion`; each function returns exit status, text and JSON contents."""

from __future__ import annotations

import argparse
import json
import sys
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from models import FixedBase, FreeFloating, Machine, Robot, Standing, footprint, lock_joints, rectangle, with_load
from models.checks import Array
from models.files import cache_files, cache_folder
from models.shapes.mesh_files import read_mesh
from models.spatial import rotation_from_rpy
from ocp.app.check.data_checks import PLANAR_BASE, clean_trajectory
from ocp.app.check.joint_limits import CHECKED_LIMITS, limits_by_name
from ocp.app.check.verdict import CheckTolerances, Interpretation, check_trajectory
from ocp.app.files import RawTrajectory, read_trajectory, read_waypoints, write_mcap, write_robot_program
from ocp.app.files.exchange import ROBOT_LANGUAGES
from ocp.app.files.safe_files import MARK, SUFFIXES, checked_output, missing_package
from ocp.app.files.settings import read_obstacles
from ocp.app.files.task_file import read_task
from ocp.app.view.animation import animate_plan, animate_solution, animate_trajectory
from ocp.app.view.player import PageServer, build_page
from ocp.app.view.report import report_of_check, report_of_plan
from ocp.console import Progress
from ocp.errors import ProblemError, sample_times
from ocp.motion.plan import Plan, plan
from ocp.motion.result.segmented_plan import SegmentedPlan
from ocp.motion.tasks.goals import Scene
from ocp.motion.tasks.limits import Limits
from ocp.solution import Solution
from ocp.storage import write_text


def run_check(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion check`: check a trajectory and write a report of it if requested."""
    if options.report is not None:
        checked_output("report", options.report, force=options.force)
    progress("reading the robot")
    robot = read_robot(options)
    by_name = {kind: dict(getattr(options, kind)) for kind in CHECKED_LIMITS}
    limits = replace(limits_by_name(robot, {kind: of for kind, of in by_name.items() if of}), friction=options.friction)
    obstacles = read_obstacles(options.obstacles) if options.obstacles else ()
    ignored, folders = tuple(options.ignore), tuple(options.folder)
    missing: Any = "skip" if options.no_meshes else "raise"
    scene = Scene(obstacles, options.clearance, ignored, options.srdf, folders, missing)
    progress("reading the trajectory")
    names, columns = [joint.name for joint in robot.joints if joint.moves], _names(options.columns)
    raw = read_trajectory(options.trajectory, columns=columns, period=options.period, topic=options.topic, joints=names)
    machine, notes = machine_of(options, robot, raw)
    check = check_trajectory(
        machine,
        raw,
        limits=limits,
        scene=False if options.no_clearance else scene,
        path=read_waypoints(options.path) if options.path else None,
        interpretation=Interpretation(options.rule, options.time_unit, options.unwrap, options.names_confirmed),
        tolerances=CheckTolerances(options.share, options.path_tolerance, options.path_angle),
        progress=progress,
    )
    check = replace(check, notes=(*check.notes, *notes))
    if options.report is not None:
        progress("report")
        report = report_of_check(check, machine, limits, scene)
        write_text(checked_output("report", options.report, force=options.force), report.html())
    return (0 if check.passed else 1), str(check), check.to_dict()


def machine_of(options: argparse.Namespace, robot: Robot, raw: RawTrajectory) -> tuple[Machine, list[str]]:
    """Return the machine (robot and base) that the options specify, and notes about links assumed to be feet."""
    if options.floating:
        return FreeFloating(robot, "planar" if set(PLANAR_BASE) <= set(raw.names) else "spatial"), []
    translation, rotation = base_pose(options)
    if not options.standing:
        return FixedBase(robot, translation, rotation), []
    if options.foot:
        foot = rectangle(options.foot[:2], options.foot[2:])
        return Standing(robot=robot, translation=translation, rotation=rotation, support=foot), []
    cleaned = clean_trajectory(raw, robot, Limits().bounds(FixedBase(robot)))
    start = np.zeros(robot.dof)
    start[cleaned.joints] = cleaned.motion.q[0]
    contact = footprint(robot, q=start, rotation=rotation)
    machine = Standing(robot=robot, translation=contact.translation, rotation=rotation, support=contact.support)
    return machine, [f"it stands on {', '.join(contact.links)}"]


def run_plan(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion plan`: plan and audit the motion of a task file, and write its outputs."""
    progress("reading the task")
    task = read_task(options.task, options.output_folder)
    outputs = task.outputs if options.output is None else task.outputs | {"plan": options.output}

    def checked(kind: str, file: Path) -> Path:
        anywhere = kind == "plan" and options.output is not None
        return checked_output(kind, file, None if anywhere else task.output_folder, options.force)

    for kind, file in outputs.items():  # check the outputs before the user waits for the plan
        checked(kind, file)
    progress("planning")
    result = plan(task.machine, task.tasks, **task.options, progress=progress)
    sample_times("period", task.period, result.horizon)
    progress("audit")
    audit = result.audit()
    for kind, path in {kind: checked(kind, file) for kind, file in outputs.items()}.items():
        progress(f"writing {path.name}")
        WRITERS[kind](result, path, task.period, task.file)
    hint = "no file is written: give -o FILE.npz, or [output] in the task file"
    written = [f"written: {file}" for file in outputs.values()] or [hint]
    margin = result.margin().sentence if audit.passed else ""
    lines = [str(result), f"The plan {audit.sentence}.", *([f"It {margin}."] if margin else []), *written]
    data = {
        "passed": audit.passed,
        "verdict": audit.sentence,
        "margin": margin,
        "cost": result.cost,
        "bound": result.bound,
        "duration": result.horizon,
        "joints": result.names,
        "start": result.at(0.0)["joints"],
        "candidates": [
            {"cost": candidate.cost, "reason": None if candidate.reason is None else str(candidate.reason)}
            for candidate in result.candidates
        ],
        "audit": [{name: getattr(finding, name) for name in FINDING_FIELDS} for finding in audit.findings],
        "written": {kind: str(file) for kind, file in outputs.items()},
    }
    if isinstance(result, SegmentedPlan):
        names = ("time", "before", "after", "duration", "failure")
        data["fewest"] = result.fewest
        data["segments"] = [
            {"begin": begin, "duration": segment.horizon, "cost": segment.cost, "bound": segment.bound}
            for begin, segment in zip(result.start_times, result.segments, strict=True)
        ]
        data["reconfigurations"] = [{name: getattr(each, name) for name in names} for each in result.reconfigurations]
    return (0 if audit.feasible else 1), "\n".join(lines), data


def run_export(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion export`: write a plan in the format that the suffix of the file names."""
    progress("writing")
    file, known = options.file, tuple(SUFFIXES[kind][0] for kind in EXPORT_KINDS)
    kind = next((kind for kind in EXPORT_KINDS if file.suffix.lower() in SUFFIXES[kind]), None)
    if kind is None:
        words = f"{file}: a plan can be exported as {', '.join(known)}; end the name with one of these"
        raise ProblemError(words, name="file", value=str(file), limit=known)
    plan, path = Plan.load(options.plan), checked_output(kind, file, force=options.force)
    if options.joints is None:
        WRITERS[kind](plan, path, options.period, "")
    elif kind in ROBOT_LANGUAGES:
        write_robot_program(plan, path, period=options.period, joints=_names(options.joints))
    else:
        words = f"{file}: joints can be selected only for robot programs; export it without --joints"
        raise ProblemError(words, name="joints", value=options.joints, limit=tuple(ROBOT_LANGUAGES))
    return 0, f"written: {file}", {"written": str(file)}


def _names(text: str | None) -> list[str] | None:
    """Return the names in a comma-separated list; None if there is no list."""
    return None if text is None else [name.strip() for name in text.split(",")]


def run_report(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion report`: audit a plan and write an HTML report of it."""
    file = checked_output("report", options.file, force=options.force)
    plan = Plan.load(options.plan)
    sample_times("period", options.period, plan.horizon)
    progress("audit")
    title = options.title or ": ".join(dict.fromkeys((plan.machine.robot.name, options.plan.stem)))
    report = report_of_plan(plan, options.period, title)
    write_text(file, report.html())
    data = {"written": str(options.file), "passed": report.passed, "verdict": report.verdict}
    return (0 if report.passed else 1), f"{report.verdict}\nwritten: {options.file}", data


def run_margin(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion margin`: print how far payload, friction and placements may differ from the model of a plan."""
    plan = Plan.load(options.plan)
    progress("margin")
    margin = plan.margin({name.replace("-", " "): size for name, size in options.size}, options.tolerance)
    alone = {name: each._asdict() for name, each in margin.alone.items()}
    data = {"covers": margin.covers_stated, "sentence": margin.sentence, "together": margin.together, "alone": alone}
    return (0 if margin.covers_stated else 1), str(margin), data


def run_view(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion view`: write or serve an HTML page that shows motions."""
    if options.page is not None:
        checked_output("report", options.page, force=options.force)
    progress("reading the motions")
    motions = motions_of(options)
    progress("drawing")
    html, missing = build_page(
        motions,
        title=options.title or f"{motions[0].machine.robot.name}: {options.plan.stem}",
        folders=options.folder,
        meshes=not options.no_meshes,
        workpiece=None if options.workpiece is None else read_mesh(options.workpiece),
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
    """Read the motions in the files given to `selfmotion view`; the motion of the plan comes first."""
    files = [options.plan, *options.beside]
    base_names = [file.name for file in files]
    names = [file.name if base_names.count(file.name) == 1 else str(file) for file in files]
    names[: len(options.name)] = options.name[: len(files)]
    tolerances: dict[str, Any] = {"tolerances": dict(options.tolerance)} if options.tolerance else {}
    machine: Any = None
    if options.robot is not None:
        robot = read_robot(options)
        machine = FreeFloating(robot) if options.floating else FixedBase(robot, *base_pose(options))
    motions: list[Any] = []
    for file, name in zip(files, names, strict=True):
        if motions and file.suffix.lower() != ".npz":
            joint_names = [joint.name for joint in machine.robot.joints if joint.moves]
            motions.append(animate_trajectory(read_trajectory(file, joints=joint_names), machine, name))
        elif options.robot is not None:
            states = {"joints": options.joints, "base": options.base}
            motions.append(animate_solution(Solution.load(file), machine, name, **states, **tolerances))
        else:
            motions.append(animate_plan(Plan.load(file), name, **tolerances))
            machine = motions[0].machine
    return motions


def run_cache(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion cache`: show the size of the cache, or clear it."""
    files = cache_files()
    size = sum(file.stat().st_size for file in files)
    if options.action == "clear":
        for file in files:
            file.unlink(missing_ok=True)
    state = "cleared" if options.action == "clear" else "in use"
    data = {
        "folder": str(cache_folder()),
        "files": len(files),
        "libraries": sum(file.suffix == ".so" for file in files),
        "bytes": size,
        "cleared": options.action == "clear",
    }
    summary = f"{len(files)} files, {data['libraries']} of them compiled functions, {size / 1e6:.3g} MB {state}"
    return 0, f"{cache_folder()}: {summary}", data


def run_completion(options: argparse.Namespace, progress: Progress) -> tuple[int, str, Any]:
    """Run `selfmotion completion`: return the script that completes commands in a shell."""
    try:
        import shtab
    except ImportError as error:
        raise missing_package("shell completion", "shtab", "completion") from error
    script = shtab.complete(options.whole, options.shell)
    return 0, script, {"shell": options.shell, "script": script}


def read_robot(options: argparse.Namespace) -> Robot:
    """Read the robot that the options name, lock its joints and attach its load as the options specify."""
    robot = Robot.from_urdf(options.robot, tip=options.tip)
    if options.lock:
        robot = lock_joints(robot, dict(options.lock))
    if options.load is not None:
        robot = with_load(robot, robot.tip_link, options.load, robot.tip_translation)
    return robot


def base_pose(options: argparse.Namespace) -> tuple[Array, Array]:
    """Return the base's pose in the world from the option --mount: translation (3,), m, and rotation matrix (3, 3)."""
    numbers = options.mount or [0.0] * 6
    return np.array(numbers[:3]), np.array(rotation_from_rpy(*numbers[3:]), dtype=float)


FINDING_FIELDS = ("name", "value", "limit", "unit", "time", "passed", "verdict", "note")
"""Fields of an audit finding that the JSON output contains."""


def _yaml(plan: Plan, file: Path, period: float) -> None:
    try:
        import yaml
    except ImportError as error:
        raise missing_package("writing YAML", "pyyaml", "yaml") from error
    write_text(file, f"# {MARK}\n{yaml.safe_dump(plan.to_ros(period), sort_keys=False)}")


WRITERS: dict[str, Callable[[Plan, Path, float, str], Any]] = {
    "plan": lambda plan, file, period, title: plan.save(file),
    "csv": lambda plan, file, period, title: plan.write_csv(file, period),
    "json": lambda plan, file, period, title: write_text(file, json.dumps(plan.to_ros(period)) + "\n"),
    "yaml": lambda plan, file, period, title: _yaml(plan, file, period),
    "mcap": lambda plan, file, period, title: write_mcap(plan, file, period),
    **dict.fromkeys(ROBOT_LANGUAGES, lambda plan, file, period, title: write_robot_program(plan, file, period=period)),
    "urdf": lambda plan, file, period, title: write_text(file, plan.machine.robot.to_urdf()),
    "report": lambda plan, file, period, title: write_text(file, report_of_plan(plan, period, title).html()),
}
"""Functions that write each kind of output; arguments are the plan, the file, the sampling period in s, and a title."""
EXPORT_KINDS = ("csv", "json", "yaml", "mcap", *ROBOT_LANGUAGES, "urdf")
