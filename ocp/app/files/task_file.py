"""Read task files, which describe a planning problem in TOML.

Names of files are relative to the folder of the task file.

[robot]
urdf = "ur5_robot.urdf"
tip = "tool0"                       # link that carries the tip
# base = "floating"                 # or "standing"; default: fixed
# position = [0, 0, 0.8]            # of the base in world, m; rpy = [0, 0, 1.57], rad
# lock = { finger_joint = 0.02 }    # locked joints, rad or m
# load = 1.5                        # kg at the tip
[path]
file = "seam.csv"                   # waypoints; or points = [[0.4, -0.2, 0.3], [0.4, 0.2, 0.3]], m
rounding = 0.002                    # largest deviation of rounded corners, m
speed = 0.05                        # m/s; the tool starts and ends at rest
# acceleration = 1.0                # m/s^2; jerk = 10, m/s^3; centripetal = 0.5, m/s^2: slower in tight curves
# steady = true                     # the speed is constant from the beginning to the end, without rest
# direction = [0, 0, -1]            # of the tool's z axis, if the file gives none; its roll is free
# tool = "given"                    # the whole orientation of the file; or "free": position only
[limits]
velocity = 2.0                      # for all joints, rad/s or m/s, or { elbow = 1.5 }
# torque = { elbow = 40 }           # N m or N; acceleration, jerk, power (W) likewise; friction of the ground
[cost]
weights = { elbow = 4 }             # of squared joint rates; 1 of all others
# time = 1.0                        # cost of a second; velocity, effort, length, energy, acceleration, jerk, turning
[search]
kind = "configurations"             # or "start", "global"; "segments": the fewest motions, if one is not enough
# start = { elbow = 1.2 }           # joints at the start, all of them
# horizon = "free"                  # the duration is planned; or a duration, s
# cyclic = true                     # the motion ends where it starts; seed = 1; time_limit = 60, s
[scene]
clearance = 0.01                    # m; ignored = [["link1", "link3"]]; srdf = "..."; folders = ["..."]
[[obstacle]]
shape = "box"                       # see ocp.app.files.task_file
size = [0.06, 0.06, 0.3]
position = [0.55, 0.0, 0.45]
[output]
plan = "seam.npz"                   # csv, json, yaml, mcap, urdf, report likewise; period = 0.01

In place of [path], a file has one of these tables, or several motions one after the other, [[task]], each with
path = {...} or goal = {...}:

[goal]                              # needs the start; see ocp.Goal
joints = { elbow = 1.2 }            # the others are free; or a pose:
# position = [0.5, 0.1, 0.3]        # m; or region = { shape = "box", size = [...], position = [...] }, or "sphere"
# orientation = [1, 0, 0, 0]        # quaternion w x y z; or rpy = [0, 3.14, 0], rad; or a direction of the tool's axis:
# direction = [0, 0, -1]            # within = 0.2, rad, makes it a cone; tool_axis = [0, 0, 1] in the frame of the tip
# tip = "left_hand"                 # link whose pose is meant
# velocity = "free"                 # or { elbow = 0.5 }, rad/s or m/s; at rest if left out
# duration = 2.0                    # s, of this motion
[waypoints]
file = "poses.csv"                  # with orientations; step = 0.2: largest joint displacement between two, rad or m
# reconfigurations = "counted"

[walk]                              # of a robot with feet, which needs the start; see ocp.Steps and ocp.walk
shift = 0.5                         # s with all feet on the ground; or { least = 0.2, most = 2.0, guess = 0.5 }: free
swing = 0.6                         # s with one foot in the air, likewise
margin = 0.01                       # m; clearance = 0.02, m; balance = "static"
[walk.feet.left]                    # likewise of each foot
link = "left_foot"
position = [0, 0, -0.08]            # of the sole's frame in the frame of the link, m; rpy, rad
sole = [-0.08, 0.14, -0.05, 0.05]   # least and greatest x, least and greatest y, m; without it the foot is a grip
at = [0.0, 0.1, 0.0, 0.0]           # foothold at the start: x, y (m), heading (rad), height (m)
[[walk.step]]
foot = "left"
at = [0.25, 0.1, 0.0, 0.0]          # where it lands
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from models import (
    FixedBase,
    Foot,
    Foothold,
    FreeFloating,
    Machine,
    Robot,
    SmoothPath,
    Standing,
    footprint,
    lock_joints,
    rectangle,
    smooth,
    with_load,
)  # fmt: skip
from models import Path as ToolPath
from models.checks import NOT_NUMBERS, floats, warn_of_millimetres
from models.shapes.shapes import Shape
from ocp.app.files.safe_files import SUFFIXES, FileName, checked_output
from ocp.app.files.settings import (
    REQUIRED,
    TomlTable,
    joint_values,
    located_errors,
    obstacles_of,
    read_shape,
    read_toml,
    rotation_of,
)  # fmt: skip
from ocp.app.files.waypoints import read_waypoints
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.builders.standing.stances import Steps, walk
from ocp.motion.builders.standing.steps import StepWeights
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.goals import Cost, Goal, Scene, Waypoints
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import ramp_limits

LIMIT_UNITS = {
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
    "jerk": "rad/s^3 or m/s^3",
    "torque": "N m or N",
    "power": "W",
}
"""Quantities for which a task file can limit the joints, and their units."""
BY_JOINT = "a table of joints and numbers: { elbow = 1.2 }"
MOTIONS = ("path", "goal", "waypoints", "walk")
"""Names of the tables that describe a motion."""


@dataclass(frozen=True, eq=False)
class Task:
    """Contents of a task file: a machine, its tasks, the options of the planner, and the files to write.

    Attributes:
        machine: Robot on its base.
        tasks: What `ocp.plan` takes as its tasks.
        options: Keyword arguments of `ocp.plan`.
        outputs: Files to write, by kind of `safe_files.SUFFIXES`, all in or below `output_folder`.
        period: Sampling period of the outputs, s.
        file: Name of the task file.
        output_folder: Folder of the outputs.
    """

    machine: Machine
    tasks: Any
    options: dict[str, Any]
    outputs: dict[str, Path]
    period: float
    file: str
    output_folder: Path


def read_task(file: FileName, output_folder: FileName | None = None) -> Task:
    """Read a task file without planning its motion.

    Args:
        file: Name of the file.
        output_folder: Folder to which the names of outputs are relative, and which must contain them; None: the folder
            of the task file.

    Raises:
        ProblemError: The file is invalid; names the line and what was expected.
    """
    root = read_toml(file)
    root.only("robot", *MOTIONS, "task", "limits", "cost", "search", "scene", "obstacle", "output")
    folder = Path(file).parent
    robot = root.required_table("robot", "a table [robot] with urdf and tip")
    urdf = folder / robot.text("urdf", "the name of a URDF file", REQUIRED)
    machine = _machine(robot, urdf)
    tasks = _tasks(root, folder, machine.robot)
    if isinstance(tasks, Steps):
        for owner, unused in ((robot, ("base", "position", "rpy", "foot")), (root, ("scene", "obstacle"))):
            for name in filter(owner.__contains__, unused):
                raise owner.error(name, f"a walk stands on its footholds and checks no collisions; remove {name}")
        machine = tasks.stances[0]
    robot.done()
    options: dict[str, Any] = {}
    obstacles = obstacles_of(root, folder)
    names = machine.robot.joint_names
    read_cost = _step_weights if isinstance(tasks, Steps) else _cost
    for name, read in (("limits", _limits), ("cost", read_cost), ("search", _read_search)):
        if (table := root.table(name, f"a table [{name}]")) is not None:
            options |= read(table, names)
            table.done()
    if (table := root.table("scene", "a table [scene]")) is not None:
        options["scene"] = _read_scene(table, folder, obstacles)
        table.done()
    outputs_in = folder if output_folder is None else Path(output_folder)
    outputs, period = _outputs(root.table("output", "a table [output]"), outputs_in)
    root.done()
    options.setdefault("scene", None if isinstance(tasks, Steps) else Scene(obstacles=obstacles))
    cost = options.get("cost")
    if options.get("horizon") == "free" and isinstance(tasks, TipTask) and cost is not None and not cost.time:
        options["cost"] = replace(cost, time=1.0)
    return Task(machine, tasks, options, outputs, period, str(file), outputs_in)


def _machine(entries: TomlTable, urdf: Path) -> Machine:
    """Read the table [robot] of a task file and return the robot on its base."""
    tip = entries.text("tip", "the name of the link that carries the tip")
    if not urdf.is_file():
        raise entries.error("urdf", f"there is no file {urdf}; name the robot's URDF, from the task file's folder")
    with located_errors(entries, "urdf"):
        robot = Robot.from_urdf(urdf)
    if tip is not None:
        with located_errors(entries, "tip"):
            robot = Robot.from_urdf(urdf, tip=tip)
    locked_positions = entries.numbers_by_name("lock", "a table of joints and positions: lock = { finger = 0.02 }")
    if locked_positions:
        with located_errors(entries, "lock"):
            robot = lock_joints(robot, locked_positions)
    load = entries.number("load", "a number above 0, kg", least=0.0)
    if load is not None:
        with located_errors(entries, "load"):
            robot = with_load(robot, robot.tip_link, load, robot.tip_translation)
    base = entries.choice("base", ("fixed", "standing", "floating"), "fixed")
    position, rotation = entries.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0)), rotation_of(entries)
    foot = entries.vector("foot", 4, "four numbers, m: least and greatest x, least and greatest y")
    with located_errors(entries, "base"):
        if base == "floating":
            return FreeFloating(robot)
        if base == "fixed":
            return FixedBase(robot, position, rotation)
        if foot is not None:
            return Standing(robot=robot, translation=position, rotation=rotation, support=rectangle(foot[:2], foot[2:]))
        contact = footprint(robot, rotation=rotation)
        return Standing(robot=robot, support=contact.support, translation=contact.translation, rotation=rotation)


def _tasks(root: TomlTable, folder: Path, robot: Robot) -> Any:
    """Read the motions of a task file, and return the tasks, goals, waypoints or steps of the planner."""
    named = [kind for kind in (*MOTIONS, "task") if kind in root]
    if len(named) != 1:
        why = "has no motion" if not named else f"has {' and '.join(named)}, which are different motions"
        words = f"the file {why}: give one table [path], [goal], [waypoints] or [walk], or a list of [[task]]"
        raise root.error(named[1] if named else None, words) if named else root.missing("path", words)
    if named == ["task"]:
        parts = []
        for table in root.tables("task"):
            table.only("path", "goal")
            if ("path" in table) == ("goal" in table):
                raise table.error(None, "a [[task]] has either path = {...} or goal = {...}")
            parts.append(_motion(table, "path" if "path" in table else "goal", folder, robot))
        return parts
    return _motion(root, named[0], folder, robot)


def _motion(root: TomlTable, kind: str, folder: Path, robot: Robot) -> Any:
    """Read the table of one motion, whose name `kind` is one of MOTIONS, and return what the planner takes."""
    entries = root.required_table(kind, f"a table [{kind}]")
    if kind == "path":
        motion: Any = _task(entries, folder)
    elif kind == "walk":
        motion = _walk(entries, robot)
    elif kind == "goal":
        motion = _goal(entries, robot.joint_names)
    else:
        motion = _waypoints(entries, folder, robot.joint_names)
    entries.done()
    return motion


def _goal(entries: TomlTable, names: tuple[str, ...]) -> Goal:
    """Read the table [goal] of a task file and return the goal."""
    values: dict[str, Any] = {
        "position": entries.vector("position", 3, "three numbers, m"),
        "orientation": entries.vector("orientation", 4, "four numbers: a quaternion w, x, y, z"),
        "direction": entries.vector("direction", 3, "three numbers: where the tool axis points"),
        "tool_axis": entries.vector("tool_axis", 3, "three numbers: the tool axis in the frame of the tip"),
        "within": entries.number("within", "largest angle between tool axis and direction, rad", least=0.0),
        "tip": entries.text("tip", "the name of a link"),
        "duration": entries.number("duration", "a number above 0, s", least=0.0),
        "joints": joint_values(entries, "joints", names, default=np.nan, expected=BY_JOINT),
    }
    if "rpy" in entries:
        if values["orientation"] is not None:
            raise entries.error("rpy", "a goal has orientation or rpy, not both; remove one")
        values["orientation"] = rotation_of(entries)
    if isinstance(entries.raw("velocity"), str):
        values["velocity"] = entries.choice("velocity", ("rest", "free"))
    else:
        values["velocity"] = joint_values(entries, "velocity", names, default=np.nan, expected=BY_JOINT)
    if (region := entries.table("region", "a box or a sphere")) is not None:
        values["region"] = read_shape(region, region.choice("shape", ("box", "sphere"), REQUIRED))
        region.done()
    with located_errors(entries):
        return Goal(**{name: value for name, value in values.items() if value is not None})


def _walk(entries: TomlTable, robot: Robot) -> Steps:
    """Read the table [walk] of a task file and return the steps of a robot: its feet and the phases of its walk."""
    feet, start, steps = {}, {}, []

    def foothold(table: TomlTable) -> Foothold:
        return Foothold.level(*table.vector("at", 4, "four numbers: x, y (m), heading (rad), height (m)", REQUIRED))

    for name, table in entries.tables_by_name("feet").items():
        sole = table.vector("sole", 4, "four numbers, m: least and greatest x, least and greatest y")
        link = table.text("link", "the name of the link that carries the foot", REQUIRED)
        position = table.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0))
        with located_errors(table):
            contact = None if sole is None else rectangle(sole[:2], sole[2:])
            feet[name], start[name] = Foot(link, contact, position, rotation_of(table)), foothold(table)
        table.done()
    for table in entries.tables("step"):
        steps.append((table.choice("foot", feet, REQUIRED), foothold(table)))
        table.done()
    balance = entries.choice("balance", ("dynamic", "static"), Steps.balance)
    margin = entries.number("margin", "a distance of 0 or more, m", Steps.margin, least=-1e-300)
    clearance = entries.number("clearance", "a distance of 0 or more, m", Steps.clearance, least=-1e-300)
    durations = {name: _duration(entries, name) for name in ("shift", "swing")}
    with located_errors(entries):
        phases = walk(start, steps, **durations)
        return Steps(robot, feet, phases, balance=balance, margin=margin, clearance=clearance)


def _duration(entries: TomlTable, name: str) -> Any:
    """Read the required duration of a phase of a walk, s, or the bounds and the guess of a free duration."""
    expected = "a number above 0, s, or { least = 0.2, most = 2.0, guess = 0.5 }"
    if not isinstance(entries.raw(name), dict):
        return entries.number(name, expected, REQUIRED, least=0.0)
    table = entries.required_table(name)
    times = [table.number(part, "a number above 0, s", REQUIRED, least=0.0) for part in ("least", "most", "guess")]
    table.done()
    with located_errors(entries, name):
        return FreeTime(*times)


def _waypoints(entries: TomlTable, folder: Path, names: tuple[str, ...]) -> Waypoints:
    """Read the table [waypoints] of a task file and return the waypoints of the planner."""
    poses = _read_waypoints(entries, folder)
    if poses.orientations is None or poses.free_roll:
        words = "waypoints without a path need whole orientations: quaternions in columns qw, qx, qy, qz"
        raise entries.error("file", words)
    rule = entries.choice("reconfigurations", ("forbidden", "counted"), "forbidden")
    expected = "a number above 0, rad or m, or { joint = number }"
    step = joint_values(entries, "step", names, default=np.inf, expected=expected, least=0.0)
    return Waypoints(poses.positions, poses.orientations, np.inf if step is None else step, rule)


def _read_waypoints(entries: TomlTable, folder: Path) -> Any:
    """Read the file of waypoints that the entry `file` of a table names."""
    name = entries.text("file", "the name of a file of waypoints", REQUIRED)
    if not (folder / name).is_file():
        raise entries.error("file", f"there is no file {folder / name}; name it from the task file's folder")
    with located_errors(entries, "file"):
        return read_waypoints(folder / name)


def _task(entries: TomlTable, folder: Path) -> TipTask:
    """Read the table [path] of a task file and return the task of the tip."""
    path = _read_path(entries, folder)
    speed = _path_limit(entries, "speed", "m/s", REQUIRED)
    timing, pace = _pace(entries, path, speed)
    tool = entries.choice("tool", ("free roll", "given", "free"), "free roll")
    direction = entries.vector("direction", 3, "three numbers: where the tool's z axis points")
    within = entries.number("within", "largest angle between the tool's z axis and its direction, rad", least=0.0)
    link = entries.text("link", "the name of a link")
    gain = entries.number("gain", "a number of 1/s, 0 or more", 1.0, least=-1e-300)
    tolerance = entries.vector("tolerance", 2, "two numbers above 0, m and rad: largest errors of the tool's pose")
    if tool == "free" and direction is not None:
        raise entries.error("direction", 'tool = "free" has no direction; remove one of the two')
    options = {"gain": gain, "direction": direction, "within": within, "link": link, "tolerance": tolerance}
    options = {name: value for name, value in options.items() if value is not None}
    with located_errors(entries):
        task = TipTask.along(path, timing, roll="given" if tool == "given" else "free", **pace, **options)
        return replace(task, rows=(3, 4, 5), direction=None, orientation=None) if tool == "free" else task


def _pace(entries: TomlTable, path: SmoothPath, speed: float) -> tuple[Any, dict[str, Any]]:
    """Read how the speed along the path changes; return the speed or a schedule, and arguments of `TipTask.along`."""
    limits = {name: _path_limit(entries, name, unit) for name, unit in (("acceleration", "m/s^2"), ("jerk", "m/s^3"))}
    centripetal = _path_limit(entries, "centripetal", "m/s^2")
    if entries.flag("steady", False):
        for name, value in {**limits, "centripetal": centripetal}.items():
            if value is not None:
                raise entries.error(name, f"steady = true has constant speed, without ramps: remove {name} or steady")
        return speed, {"steady": True}
    if centripetal is None:
        return speed, limits
    acceleration, jerk = ramp_limits(**limits)
    with located_errors(entries, "centripetal"):
        return schedule(path, LineLimits(speed, acceleration, jerk, centripetal)), {}


def _path_limit(entries: TomlTable, name: str, unit: str, default: Any = None) -> Any:
    """Read a limit along the path, such as the speed; raise ProblemError if it is not between 1e-6 and 1e6."""
    return entries.number(name, f"a number above 0, {unit}, of 1e-6 to 1e6", default, least=0.999e-6, most=1e6)


def _read_path(entries: TomlTable, folder: Path) -> SmoothPath:
    """Read the path of a task file and return it with rounded corners."""
    deviation = entries.number("rounding", "a number above 0, m: largest deviation of rounded corners", 1e-3, least=0.0)
    points = entries.raw("points")
    if ("file" in entries) == (points is not None):
        raise entries.missing("file", 'give waypoints, file = "seam.csv", or points = [[x, y, z], ...] in m, not both')
    if points is None:
        poses = _read_waypoints(entries, folder)
        with located_errors(entries, "file"):
            return poses.smooth(deviation)  # type: ignore[no-any-return]
    try:
        corners = floats(points)
    except NOT_NUMBERS:
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 2 or not np.isfinite(corners).all():
        raise entries.error("points", "points must be two or more lists of three numbers, m: [[x, y, z], [x, y, z]]")
    warn_of_millimetres(f"{entries.file}: an extent of the points of", np.ptp(corners, axis=0), "points")
    with located_errors(entries, "points"):
        return smooth(ToolPath.through(corners), deviation=deviation)


def _limits(entries: TomlTable, names: tuple[str, ...]) -> dict[str, Any]:
    """Read the table [limits] of a task file and return the limits as an option of the planner."""
    limits: dict[str, Any] = {}
    for quantity, unit in LIMIT_UNITS.items():
        expected = f"a number above 0, {unit}, or {{ joint = number }}"
        with located_errors(entries, quantity):
            limits[quantity] = joint_values(entries, quantity, names, default=np.inf, expected=expected, least=0.0)
            Limits(**{quantity: limits[quantity]})
    friction = entries.number("friction", "a number above 0: the friction coefficient of the ground", np.inf, least=0.0)
    return {"limits": Limits(**limits, joints=entries.flag("positions", True), friction=friction)}


def _cost(entries: TomlTable, names: tuple[str, ...]) -> dict[str, Any]:
    """Read the table [cost] of a task file and return the cost as an option of the planner."""
    expected = "a number of 0 or more, or { joint = number }"
    weights = joint_values(
        entries, "weights", names, default=1.0, expected="numbers above 0 by joint: { elbow = 4 }", least=0.0
    )
    values: dict[str, Any] = {"weights": weights}
    for name in ("effort", "acceleration"):
        values[name] = joint_values(entries, name, names, default=0.0, expected=expected, least=-1e-300)
    for name in ("velocity", "time", "length", "energy", "jerk", "turning"):
        values[name] = entries.number(name, "a number of 0 or more: the weight of this term", least=-1e-300)
    with located_errors(entries):
        return {"cost": Cost(**{name: value for name, value in values.items() if value is not None})}


def _step_weights(entries: TomlTable, names: tuple[str, ...]) -> dict[str, Any]:
    """Read the table [cost] of the task file of a walk and return its weights as an option of the planner."""
    expected = "a number of 0 or more: the weight of this term"
    terms = {term.name: term.default for term in fields(StepWeights)}
    values = {name: entries.number(name, expected, weight, least=-1e-300) for name, weight in terms.items()}
    return {"cost": StepWeights(**values)}


def _read_search(entries: TomlTable, names: tuple[str, ...]) -> dict[str, Any]:
    """Read the search settings of a task file and return them as options of the planner."""
    kind = entries.choice("kind", ("configurations", "start", "global", "segments"), "configurations")
    if isinstance(entries.raw("horizon"), str):
        horizon = entries.choice("horizon", ("free",))
    else:
        horizon = entries.number("horizon", 'a number above 0, s, or "free"', least=0.0)
    options: dict[str, Any] = {"search": kind, "cyclic": entries.flag("cyclic"), "horizon": horizon}
    if kind == "segments" and options["cyclic"]:
        raise entries.error("cyclic", 'kind = "segments" does not support cyclic; remove it')
    options["seed"] = entries.count("seed", "a whole number, 0 or more", 0)
    options["time_limit"] = entries.number("time_limit", "a number above 0, s", least=0.0)
    start = joint_values(entries, "start", names, default=np.nan, expected=BY_JOINT)
    if start is not None:
        if missing := [joint for joint, position in zip(names, start, strict=True) if np.isnan(position)]:
            raise entries.error("start", f"start has no {', '.join(missing)}; give every joint, rad or m")
        options["start"] = start
    return options


def _read_scene(entries: TomlTable, folder: Path, obstacles: tuple[Shape, ...]) -> Any:
    """Read the collision scene of a task file, which may be switched off."""
    checked = entries.flag("look", True)
    clearance = entries.number("clearance", "a distance of 0 or more, m", 0.0, least=-1e-300)
    srdf = entries.text("srdf", "the name of an SRDF file")
    folders = entries.texts("folders", "a list of names of folders")
    if not checked:
        if obstacles:
            raise entries.error("look", "look = false checks no collisions, but there are obstacles; remove one")
        return False
    return Scene(
        obstacles,
        clearance,
        tuple(entries.pairs("ignored", 'pairs of links: [["link1", "link3"]]')),
        None if srdf is None else folder / srdf,
        tuple(folder / name for name in folders),
        entries.choice("meshes", ("raise", "skip"), "raise"),
    )


def _outputs(entries: TomlTable | None, folder: Path) -> tuple[dict[str, Path], float]:
    """Return the paths of the output files by kind, and the sampling period, s, from the table [output]."""
    if entries is None:
        return {}, 0.01
    outputs = {}
    for kind in SUFFIXES:
        if (name := entries.text(kind, "the name of a file to write")) is not None:
            outputs[kind] = folder / name
            if not outputs[kind].parent.is_dir():
                raise entries.error(kind, f"there is no folder {outputs[kind].parent}; create it, or name another")
            with located_errors(entries, kind):
                checked_output(kind, outputs[kind], folder, force=True)
    period = entries.number("period", "a number above 0, s", 0.01, least=0.0)
    entries.done()
    return outputs, period
