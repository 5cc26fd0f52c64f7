"""Read task files, which describe a planning problem in TOML.

The tables are those of `ocp.plan`: the machine [robot], the tasks, and [limits], [cost], [search] and [scene] with the
obstacles [[obstacle]]; [output] names the files to write. The tasks are one of these: [path], or several [[path]] for
tasks at the same time; [goal]; [waypoints]; [walk]; [capture]; or [[task]] for motions one after the other, each with
path = {...}, path = [{...}, {...}] or goal = {...}. Entries have the names and units of the arguments that they stand
for, and joints are called by their names. Names of files are relative to the folder of the task file. The page about
the command, docs/guide/command.md, shows all entries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from warnings import warn

import numpy as np

import models
from models import FreeFloating, Machine, ModelWarning, Robot, SmoothPath, checks
from models.machines.standing import tip_spring
from ocp.app.files import settings
from ocp.app.files.safe_files import SUFFIXES, FileName, checked_output
from ocp.app.files.settings import REQUIRED, Readers, TomlTable, joint_values, located_errors, rotation_of
from ocp.app.files.waypoints import read_waypoints
from ocp.motion.builders.dynamics import JointFriction
from ocp.motion.builders.space.capture import Capture, Cone, Grasp
from ocp.motion.builders.standing.problem import FreeTime, Weights
from ocp.motion.builders.standing.stances import Steps, walk
from ocp.motion.builders.standing.steps import StepWeights
from ocp.motion.result.margin import checked_uncertainty
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.goals import PER_JOINT, TERMS, Cost, Goal, Scene, Start, Waypoints
from ocp.motion.tasks.limits import LIMITED, Anywhere, IndexAtLeast, InFoot, Limits, Pinned
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import ramp_limits


def _duration(entries: TomlTable, name: str, default: Any = None) -> Any:
    """Read a duration, s, or the bounds and the guess of a free duration."""
    if not isinstance(entries.raw(name), dict):
        return entries.positive(name, "s, or { least = 0.2, most = 2.0, guess = 0.5 }", default)
    table = entries.required_table(name)
    times = [table.positive(part, "s", REQUIRED) for part in ("least", "most", "guess")]
    table.done()
    return _located(entries, name, FreeTime, *times)


def _velocity(entries: TomlTable, name: str) -> Any:
    """Read joint velocities (nan for a free velocity), or the word "rest" or "free"."""
    if isinstance(entries.raw(name), str):
        return entries.choice(name, ("rest", "free"))
    return joint_values(entries, name, np.nan)


def _orientation(entries: TomlTable, name: str) -> Any:
    """Read an orientation: a quaternion, or else the rotation matrix from the entry `rpy`."""
    if "rpy" not in entries:
        return entries.vector(name, 4, "four numbers: a quaternion w, x, y, z")
    if name in entries:
        raise entries.error("rpy", f"there is {name} or rpy, not both; remove one")
    return rotation_of(entries)


def _region(entries: TomlTable, name: str) -> Any:
    """Read the box or sphere in which a tip may lie."""
    region = entries.table(name, "a box or a sphere")
    return None if region is None else settings.read_shape(region, kinds=("box", "sphere"))


def _zmp_rule(entries: TomlTable, name: str) -> Any:
    """Read the rule for the zero moment point of a standing machine."""
    if isinstance(entries.raw(name), str):
        return entries.choice(name, ("anywhere",)) and Anywhere()
    if (table := entries.table(name, f'"anywhere", or a table with one of {", ".join(ZMP_RULES)}')) is None:
        return None
    table.only(*ZMP_RULES)
    kind = next(filter(table.__contains__, ZMP_RULES), "margin")
    rule, read, *arguments = ZMP_RULES[kind]
    return _located(entries, name, rule, read(table, kind, *arguments))


def _uncertainties(entries: TomlTable, name: str) -> Any:
    """Read the sizes of the uncertainties, by name, that the plan must tolerate."""
    sizes = entries.numbers_by_name(name, 'a table of sizes: { payload = 0.5, "tool offset" = 1e-3 }')
    return _located(entries, name, checked_uncertainty, sizes) or None


def _speed(entries: TomlTable, name: str, unit: str, default: Any = None) -> Any:
    """Read a limit along the path, such as the speed; raise ProblemError if it is not between 1e-6 and 1e6."""
    return entries.number(name, f"a number above 0, {unit}, of 1e-6 to 1e6", default, least=0.999e-6, most=1e6)


T = TypeVar("T")
BY_JOINT = "or { joint = number }"
WEIGHT = f"a number of 0 or more, {BY_JOINT}"
POINT = (TomlTable.vector, 3, "three numbers, m")
LINK = (TomlTable.text, "the name of a link")
BASE = (TomlTable.vector, None, "numbers: the configuration of a floating base, x, y, angle or x, y, z, qw, qx, qy, qz")
TIP: Readers = {
    "position": POINT,
    "orientation": (_orientation,),
    "direction": (TomlTable.vector, 3, "three numbers: where the tool axis points"),
    "tool_axis": (TomlTable.vector, 3, "three numbers: the tool axis in the frame of the tip"),
    "within": (TomlTable.positive, "rad: the largest angle between tool axis and direction"),
}
GOAL: Readers = TIP | {
    "tip": LINK,
    "region": (_region,),
    "joints": (joint_values, np.nan),
    "velocity": (_velocity,),
    "base": BASE,
    "duration": (_duration,),
    "name": (TomlTable.text,),
}
TASK: Readers = TIP | {
    "link": LINK,
    "relative_to": LINK,
    "point": POINT,
    "gain": (TomlTable.nonnegative, "1/s"),
    "tolerance": (TomlTable.vector, 2, "two numbers above 0, m and rad: largest errors of the tool's pose"),
    "begin": (TomlTable.nonnegative, "s"),
}
PACE: Readers = {"acceleration": (_speed, "m/s^2"), "jerk": (_speed, "m/s^3"), "centripetal": (_speed, "m/s^2")}
WAYPOINTS: Readers = {
    "step": (joint_values, np.inf, (f"a number above 0, rad or m, {BY_JOINT}", 0.0)),
    "reconfigurations": (TomlTable.choice, ("forbidden", "counted")),
}
STEPS: Readers = {
    "balance": (TomlTable.choice, ("dynamic", "static")),
    "margin": (TomlTable.nonnegative, "m"),
    "clearance": (TomlTable.nonnegative, "m"),
}
CONE: Readers = {
    "direction": (TomlTable.vector, 3, "three numbers: from the grasp to the tip, in the grasped frame", REQUIRED),
    "half_angle": (TomlTable.positive, "rad", REQUIRED),
    "length": (TomlTable.positive, "m", REQUIRED),
    "depth": (TomlTable.positive, "m"),
}
FRICTION: Readers = {
    **dict.fromkeys(("viscous", "coulomb"), (joint_values, 0.0, (WEIGHT, -1e-300))),
    "slip": (TomlTable.positive, "rad/s or m/s"),
}
CAPTURE: Readers = {
    "approach": (_duration, REQUIRED),
    "detumble": (_duration, REQUIRED),
    "cone": (TomlTable.nested, Cone, CONE),
    "grasp": (TomlTable.nested, Grasp, {"force": (TomlTable.positive, "N"), "moment": (TomlTable.positive, "N m")}),
    "friction": (TomlTable.nested, JointFriction, FRICTION),
    "end": (joint_values, np.nan),
    "rest": (TomlTable.flag, True),
}
WHEELS: Readers = {
    "axes": (TomlTable.rows, 3, "a list of axes: [[1, 0, 0], [0, 1, 0]]", np.eye(3)),
    "inertia": (TomlTable.positive, "kg m^2", REQUIRED),
    "momentum": (TomlTable.positive, "N m s"),
    "torque": (TomlTable.positive, "N m"),
    "mass": (TomlTable.nonnegative, "kg"),
    "link": LINK,
}
ZMP_RULES: Readers = {
    "margin": (InFoot, TomlTable.nonnegative, "m", REQUIRED),
    "index": (IndexAtLeast, TomlTable.number, "a number below 1", REQUIRED),
    "point": (Pinned, TomlTable.vector, 2, "two numbers: x, y, m", REQUIRED),
}
LIMITS: Readers = {
    "joints": (lambda entries, name: entries.flag("positions", True),),
    **{kind: (joint_values, np.inf, (f"a number above 0, {unit}, {BY_JOINT}", 0.0)) for kind, unit in LIMITED.items()},
    "vertical_force": (TomlTable.positive, "N"),
    "friction": (TomlTable.positive, "the friction coefficient of the ground"),
    "zmp": (_zmp_rule,),
    "robust": (_uncertainties,),
}
COST: Readers = {
    "weights": (joint_values, 1.0, (f"a number above 0, {BY_JOINT}", 0.0)),
    **dict.fromkeys(TERMS, (TomlTable.nonnegative, "a weight")),
    **dict.fromkeys(PER_JOINT, (joint_values, 0.0, (WEIGHT, -1e-300))),
}
SEARCH: Readers = {
    "cyclic": (TomlTable.flag,),
    "seed": (TomlTable.count, "a whole number, 0 or more"),
    "time_limit": (TomlTable.positive, "s"),
}
SPRING: Readers = dict.fromkeys(("stiffness", "rest"), (TomlTable.vector, 3, "three numbers, along x, y, z", REQUIRED))


def _located(entries: TomlTable, name: str, function: Callable[..., T], *arguments: Any) -> T:
    """Call a function and return its result; add the line of an entry of the file to errors that it raises."""
    with located_errors(entries, name):
        return function(*arguments)


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
        output_folder: Folder to which the names of outputs are relative, and which must contain them; None: the folder
            of the task file.

    Raises:
        ProblemError: The file is invalid; names the line and what was expected.
    """
    root, folder = settings.read_toml(file), Path(file).parent
    root.only("robot", *MOTIONS, "task", "limits", "cost", "search", "scene", "obstacle", "output")
    robot = root.required_table("robot", "a table [robot] with urdf and tip")
    machine = _machine(robot, folder)
    root.joints = machine.robot.joint_names
    tasks = _tasks(root, folder, machine)
    walks = isinstance(tasks, Steps)
    if walks:
        for owner, unused in ((robot, ("base", "position", "rpy", "foot")), (root, ("scene", "obstacle"))):
            for name in filter(owner.__contains__, unused):
                raise owner.error(name, f"a walk stands on its footholds and checks no collisions; remove {name}")
        machine = tasks.stances[0]
    robot.done()
    kind = StepWeights if walks else Weights if isinstance(machine, models.Standing) else Cost
    terms = COST if kind is Cost else {term.name: (TomlTable.nonnegative, "a weight") for term in fields(kind)}
    cost = root.nested("cost", kind, terms)
    options: dict[str, Any] = {"cost": cost, "limits": root.nested("limits", Limits, LIMITS)}
    options["scene"] = None if walks else _scene(root, folder, machine)
    if (table := root.table("search", "a table [search]")) is not None:
        options |= _search(table)
    outputs_in = folder if output_folder is None else Path(output_folder)
    outputs, period = _outputs(root.table("output", "a table [output]"), outputs_in)
    root.done()
    if options.get("horizon") == "free" and isinstance(tasks, TipTask) and isinstance(cost, Cost) and not cost.time:
        options["cost"] = replace(cost, time=1.0)
    return Task(machine, tasks, options, outputs, period, str(file), outputs_in)


def _machine(entries: TomlTable, folder: Path, base: str = "fixed") -> Machine:
    """Read the table of a robot or of a captured body; return the machine, whose type of base is `base` by default."""
    urdf = folder / entries.text("urdf", "the name of a URDF file", REQUIRED)
    if not urdf.is_file():
        raise entries.error("urdf", f"there is no file {urdf}; name the robot's URDF, from the task file's folder")
    robot = _located(entries, "urdf", Robot.from_urdf, urdf)
    if (tip := entries.text("tip", "the name of the link that carries the tip")) is not None:
        place = entries.vector("tip_position", 3, "three numbers, m: the tip in the frame of its link", np.zeros(3))
        frame = {"tip_translation": place, "tip_rotation": rotation_of(entries, entry="tip_rpy")}
        robot = _located(entries, "tip", partial(Robot.from_urdf, tip=tip, **frame), urdf)
    if locked := entries.numbers_by_name("lock", "a table of joints and positions: lock = { finger = 0.02 }"):
        robot = _located(entries, "lock", models.lock_joints, robot, locked)
    robot = _loaded(entries, robot)
    robot = entries.nested("wheels", partial(models.with_wheels, robot), WHEELS) or robot
    base = entries.choice("base", ("fixed", "standing", "floating", "planar"), base)
    if base in ("floating", "planar"):
        momentum = entries.vector("momentum", None, "numbers, N m s and N s: the total momentum, which is conserved")
        kind, name = "planar" if base == "planar" else "spatial", "base" if momentum is None else "momentum"
        return _located(entries, name, FreeFloating, robot, kind, momentum)
    position, rotation = entries.vector("position", 3, "three numbers, m", np.zeros(3)), rotation_of(entries)
    foot = entries.vector("foot", 4, "four numbers, m: least and greatest x, least and greatest y")
    with located_errors(entries, "base"):
        if base == "fixed":
            return models.FixedBase(robot, position, rotation)
        support = None if foot is None else models.rectangle(foot[:2], foot[2:])
        if support is None:
            contact = models.footprint(robot, rotation=rotation)
            support, position = contact.support, contact.translation
        return models.Standing(robot=robot, translation=position, rotation=rotation, support=support)


def _loaded(entries: TomlTable, robot: Robot) -> Robot:
    """Return the robot with the payload of mass `load` (kg) that a table attaches to the tip, if it states one."""
    load, place = entries.positive("load", "kg"), (robot.tip_link, robot.tip_translation)
    return robot if load is None else _located(entries, "load", models.with_load, robot, place[0], load, place[1])


def _tasks(root: TomlTable, folder: Path, machine: Machine) -> Any:
    """Read the motions of a task file and return the tasks for the planner."""
    named = [kind for kind in (*MOTIONS, "task") if kind in root]
    if len(named) != 1:
        why = "has no motion" if not named else f"has {' and '.join(named)}, which are different motions"
        words = f"the file {why}: give one of the tables [{'], ['.join(MOTIONS)}], or a list of [[task]]"
        raise root.error(named[1] if named else None, words) if named else root.missing("path", words)
    if named != ["task"]:
        return _motion(root, named[0], folder, machine)
    parts = []
    for table in root.tables("task"):
        table.only("path", "goal")
        if ("path" in table) == ("goal" in table):
            raise table.error(None, "a [[task]] is either path = {...} or goal = {...}")
        parts.append(_motion(table, "path" if "path" in table else "goal", folder, machine))
    return parts


def _motion(root: TomlTable, kind: str, folder: Path, machine: Machine) -> Any:
    """Read the table of one motion, or a list of simultaneous paths, and return the tasks for the planner."""
    if kind == "path" and isinstance(root.raw("path"), list):
        return [_task(entries, folder, machine) for entries in root.tables("path")]
    return MOTIONS[kind](root.required_table(kind, f"a table [{kind}]"), folder, machine)


def _task(entries: TomlTable, folder: Path, machine: Machine) -> TipTask:
    """Read a table [path] of a task file and return the task of a tip: to follow a path, or to keep a constant pose."""
    has = entries.__contains__
    if not any(map(has, ("file", "points", "speed"))) and any(map(has, (*TIP, "rpy"))):
        return entries.build(TipTask, TASK | {"duration": (TomlTable.positive, "s")})
    path = _read_path(entries, folder)
    timing, pace = _pace(entries, path, _speed(entries, "speed", "m/s", REQUIRED))
    tool = entries.choice("tool", ("free roll", "given", "free"), "free roll")
    if has("position"):
        raise entries.error("position", "a path has points or a file, and no position; remove one of them")
    options = entries.values(TASK)
    if tool == "free" and "direction" in options:
        raise entries.error("direction", 'tool = "free" has no direction; remove one of the two')
    entries.done()
    with located_errors(entries):
        task = TipTask.along(path, timing, roll="given" if tool == "given" else "free", **pace, **options)
        return replace(task, rows=(3, 4, 5), direction=None, orientation=None) if tool == "free" else task


def _pace(entries: TomlTable, path: SmoothPath, speed: float) -> tuple[Any, dict[str, Any]]:
    """Read how the speed along a path changes: return a speed or a schedule, and arguments of `TipTask.along`."""
    limits = entries.values(PACE)
    if entries.flag("steady"):
        for name in limits:
            raise entries.error(name, f"steady = true has constant speed, without ramps: remove {name} or steady")
        return speed, {"steady": True}
    if "centripetal" not in limits:
        return speed, limits
    acceleration, jerk = ramp_limits(limits.get("acceleration"), limits.get("jerk"))
    line = LineLimits(speed, acceleration, jerk, limits["centripetal"])
    return _located(entries, "centripetal", schedule, path, line), {}


def _read_path(entries: TomlTable, folder: Path) -> SmoothPath:
    """Read the path of a task file and return it with rounded corners."""
    deviation = entries.positive("rounding", "m: largest deviation of rounded corners", 1e-3)
    words = "two or more lists of three numbers, m: [[x, y, z], [x, y, z]]"
    corners = entries.rows("points", 3, words)
    if ("file" in entries) == (corners is not None):
        raise entries.missing("file", 'give waypoints, file = "seam.csv", or points = [[x, y, z], ...] in m, not both')
    if corners is None:
        poses = _read_waypoints(entries, folder)
        return _located(entries, "file", poses.smooth, deviation)  # type: ignore[no-any-return]
    if len(corners) < 2:
        raise entries.error("points", f"points must be {words}")
    checks.warn_of_millimetres(f"{entries.file}: an extent of the points of", np.ptp(corners, axis=0), "points")
    return _located(entries, "points", partial(models.smooth, deviation=deviation), models.Path.through(corners))


def _read_waypoints(entries: TomlTable, folder: Path) -> Any:
    """Read the file of waypoints that the entry `file` of a table names."""
    name = entries.text("file", "the name of a file of waypoints", REQUIRED)
    if not (folder / name).is_file():
        raise entries.error("file", f"there is no file {folder / name}; name it from the task file's folder")
    poses = _located(entries, "file", read_waypoints, folder / name)
    if poses.ignored:
        words = f"{folder / name}: unknown columns {', '.join(poses.ignored)} are ignored"
        warn(ModelWarning(words, name=name), stacklevel=2)
    return poses


def _goal(entries: TomlTable, folder: Path, machine: Machine) -> Goal:
    """Read the table [goal] of a task file and return the goal."""
    arguments: dict[str, Any] = {"tasks": _motion(entries, "path", folder, machine)} if "path" in entries else {}
    if "load" in entries:
        arguments["machine"] = replace(machine, robot=_loaded(entries, machine.robot))  # type: ignore[type-var]
    return entries.build(Goal, GOAL, **arguments)


def _waypoints(entries: TomlTable, folder: Path, machine: Machine) -> Waypoints:
    """Read the table [waypoints] of a task file and return the waypoints of the planner."""
    poses = _read_waypoints(entries, folder)
    if poses.orientations is None or poses.free_roll:
        raise entries.error("file", "[waypoints] need whole orientations: quaternions in columns qw, qx, qy, qz")
    return entries.build(partial(Waypoints, poses.positions, poses.orientations), WAYPOINTS)


def _walk(entries: TomlTable, folder: Path, machine: Machine) -> Steps:
    """Read the table [walk] of a task file and return the steps of a robot: its feet and the phases of its walk."""
    feet, start, steps = {}, {}, []

    def foothold(table: TomlTable) -> models.Foothold:
        return models.Foothold.level(*table.vector("at", 4, "four numbers: x, y, heading, height; m, rad", REQUIRED))

    for name, table in entries.tables_by_name("feet").items():
        sole = table.vector("sole", 4, "four numbers, m: least and greatest x, least and greatest y")
        link = table.text("link", "the name of the link that carries the foot", REQUIRED)
        position = table.vector("position", 3, "three numbers, m", np.zeros(3))
        with located_errors(table):
            contact = None if sole is None else models.rectangle(sole[:2], sole[2:])
            feet[name], start[name] = models.Foot(link, contact, position, rotation_of(table)), foothold(table)
        table.done()
    for table in entries.tables("step"):
        steps.append((table.choice("foot", feet, REQUIRED), foothold(table)))
        table.done()
    with located_errors(entries):
        phases = walk(start, steps, **{name: _duration(entries, name, REQUIRED) for name in ("shift", "swing")})
    return entries.build(partial(Steps, machine.robot, feet, phases), STEPS)


def _capture(entries: TomlTable, folder: Path, machine: Machine) -> Capture:
    """Read the table [capture] of a task file and return the capture of a body by a free-floating robot."""
    if not isinstance(machine, FreeFloating):
        raise entries.error(None, 'a capture needs a free-floating robot: base = "floating" or "planar" in [robot]')
    body = entries.required_table("target", "a table [capture.target] of the body: urdf, tip, momentum, pose")
    target = _machine(body, folder, "planar" if machine.base == "planar" else "floating")
    pose = body.vector("pose", target.base_size, f"{target.base_size} numbers: the pose of the body at the start")
    body.done()
    target = replace(target, robot=models.simplify(target.robot))  # type: ignore[type-var]
    return entries.build(Capture, CAPTURE, target=target, target_base=pose)


MOTIONS: dict[str, Callable[[TomlTable, Path, Machine], Any]] = {
    "path": _task,
    "goal": _goal,
    "waypoints": _waypoints,
    "walk": _walk,
    "capture": _capture,
}
"""Functions that read the table of a motion, by its name."""


def _search(entries: TomlTable) -> dict[str, Any]:
    """Read the table [search] of a task file and return its entries as options of the planner."""
    kind = entries.choice("kind", ("configurations", "start", "global", "segments"), "configurations")
    is_free = isinstance(entries.raw("horizon"), str)
    horizon = entries.choice("horizon", ("free",)) if is_free else entries.positive("horizon", 's, or "free"')
    options: dict[str, Any] = {"search": kind, "horizon": horizon, **entries.values(SEARCH)}
    if kind == "segments" and options.get("cyclic"):
        raise entries.error("cyclic", 'kind = "segments" does not support cyclic; remove it')
    start = joint_values(entries, "start", np.nan)
    if start is not None and np.isnan(start).any():
        missing = ", ".join(np.array(entries.joints)[np.isnan(start)])
        raise entries.error("start", f"start has no {missing}; give every joint, rad or m")
    state = entries.values({"base": BASE, "velocity": (_velocity,)})
    entries.done()
    if start is not None or state:
        options["start"] = Start(start, **state) if state else start
    return options


def _scene(root: TomlTable, folder: Path, machine: Machine) -> Any:
    """Read the collision scene of a task file: [[obstacle]] and the table [scene], which may switch it off."""
    obstacles = settings.obstacles_of(root, folder, moving=True)
    if (entries := root.table("scene", "a table [scene]")) is None:
        return Scene(obstacles)
    checked, srdf = entries.flag("look", True), entries.text("srdf", "the name of an SRDF file")
    scene = Scene(
        obstacles,
        entries.nonnegative("clearance", "m", 0.0),
        tuple(entries.pairs("ignored", 'pairs of links: [["link1", "link3"]]')),
        None if srdf is None else folder / srdf,
        tuple(folder / name for name in entries.texts("folders", "a list of names of folders")),
        entries.choice("meshes", ("raise", "skip"), "raise"),
        entries.nested("spring", partial(tip_spring, machine), SPRING),  # type: ignore[arg-type]
    )
    entries.done()
    if not checked and obstacles:
        raise entries.error("look", "look = false checks no collisions, but there are obstacles; remove one")
    return scene if checked else False


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
            _located(entries, kind, partial(checked_output, force=True), kind, outputs[kind], folder)
    period = entries.positive("period", "s", 0.01)
    entries.done()
    return outputs, period
