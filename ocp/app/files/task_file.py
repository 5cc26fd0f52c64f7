"""Read task files, which describe a planning problem in TOML, and files of obstacles.

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
speed = 0.05                        # m/s; with acceleration and jerk it starts and ends at rest
# direction = [0, 0, -1]            # of the tool's z axis, if the file gives none; its roll is free
# tool = "given"                    # the whole orientation of the file; or "free": position only
[limits]
velocity = 2.0                      # for all joints, rad/s or m/s, or { elbow = 1.5 }
# torque = { elbow = 40 }           # N m or N; acceleration, jerk, power (W) likewise
[cost]
weights = { elbow = 4 }             # of squared joint rates; 1 of all others; time = 1.0 costs a second of a free pace
[search]
kind = "configurations"             # or "start", "global"; "segments": the fewest motions, if one is not enough
# start = { elbow = 1.2 }           # joints at the start, all of them; cyclic = true; seed = 1; pace = "free"
[scene]
clearance = 0.01                    # m; ignored = [["link1", "link3"]]; srdf = "..."; folders = ["..."]
[[obstacle]]
shape = "box"                       # see ocp.app.files.task_file
size = [0.06, 0.06, 0.3]
position = [0.55, 0.0, 0.45]
[output]
plan = "seam.npz"                   # csv, json, yaml, mcap, urdf, report likewise; period = 0.01

A file of obstacles has the shapes in world, each under [[obstacle]]:

[[obstacle]]
shape = "box"                       # or sphere, capsule, cylinder, halfspace, mesh
size = [0.06, 0.06, 0.3]            # m
position = [0.55, 0.0, 0.45]        # m
rpy = [0, 0, 0.5]                   # rad, optional: rotations about the world's x, then y, then z axis
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from models import (
    Box,
    Capsule,
    Cylinder,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Machine,
    Mesh,
    ModelError,
    Robot,
    SmoothPath,
    Sphere,
    Standing,
    footprint,
    lock_joints,
    rectangle,
    smooth,
    with_load,
)
from models import Path as ToolPath
from models.checks import NOT_NUMBERS, Array, floats
from models.shapes.shapes import Shape
from models.spatial import rotation_from_rpy
from ocp.app.files.safe_files import SUFFIXES, FileName, checked_output
from ocp.app.files.settings import REQUIRED, TomlTable, read_toml
from ocp.app.files.waypoints import read_waypoints
from ocp.errors import ProblemError
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.goals import Cost, Scene
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["OUTPUTS", "Task", "obstacles_of", "read_obstacles", "read_task", "rotation_of"]

SHAPES = ("box", "sphere", "capsule", "cylinder", "halfspace", "mesh")


def read_obstacles(file: FileName) -> tuple[Shape, ...]:
    """Read a file of obstacles and return their shapes in the order of the file.

    Raises:
        ProblemError: The file is invalid; names the line and what was expected.
    """
    entries = read_toml(file)
    shapes = obstacles_of(entries, Path(file).parent)
    entries.done()
    if not shapes:
        raise entries.missing("obstacle", 'tables headed [[obstacle]], each with shape = "box" or another')
    return shapes


def obstacles_of(entries: TomlTable, folder: Path) -> tuple[Shape, ...]:
    """Return the shapes of the [[obstacle]] entries; paths of mesh files are relative to `folder`."""
    shapes = []
    for table in entries.tables("obstacle"):
        shape = table.choice("shape", SHAPES, REQUIRED)
        try:
            shapes.append(_shape(table, shape, folder))
        except ModelError as error:
            name = error.name if error.name is not None and error.name in table else None
            raise table.error(name, str(error)) from error
        table.done()
    return tuple(shapes)


def rotation_of(entries: TomlTable) -> Array:
    """Return the rotation matrix of the entry `rpy` (roll, pitch, yaw); the identity if it is missing. Shape (3, 3)."""
    angles = entries.vector("rpy", 3, "three angles, rad", (0.0, 0.0, 0.0))
    return np.array(rotation_from_rpy(*(float(angle) for angle in angles)), dtype=float)


def _shape(table: TomlTable, shape: str, folder: Path) -> Shape:
    """Read the shape of an [[obstacle]] table."""

    def place(name: str = "position") -> Any:
        return table.vector(name, 3, "three numbers, m", REQUIRED)

    def length(name: str) -> Any:
        return table.number(name, "a number above 0, m", REQUIRED, least=0.0)

    if shape == "box":
        return Box(table.vector("size", 3, "three lengths, m", REQUIRED), place(), rotation_of(table))
    if shape == "sphere":
        return Sphere(length("radius"), place())
    if shape == "capsule":
        return Capsule(length("radius"), place("start"), place("end"))
    if shape == "cylinder":
        return Cylinder(length("radius"), length("length"), place(), rotation_of(table))
    if shape == "halfspace":
        return HalfSpace(table.vector("normal", 3, "three numbers: out of what is solid", REQUIRED), place("point"))
    name = table.text("file", "the name of an STL, OBJ or DAE file", REQUIRED)
    scale = table.number("scale", "a number above 0: m for each unit of the file", 1.0, least=0.0)
    position = table.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0))
    return Mesh(file=folder / name, position=position, rotation=rotation_of(table), scale=scale)


OUTPUTS = tuple(SUFFIXES)
LIMIT_UNITS = {
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
    "jerk": "rad/s^3 or m/s^3",
    "torque": "N m or N",
    "power": "W",
}
"""Quantities for which a task file can limit the joints, and their units."""


@dataclass(frozen=True, eq=False)
class Task:
    """Contents of a task file.

    Attributes:
        machine: Robot on its base.
        task: Task of the robot's tip.
        options: Keyword arguments of `ocp.plan`.
        outputs: Files to write, by kind of OUTPUTS, all in or below `output_folder`.
        period: Sampling period of the outputs, s.
        file, urdf: Names of the task file and of the robot's file.
    """

    machine: Machine
    task: TipTask
    options: dict[str, Any]
    outputs: dict[str, Path]
    period: float
    file: str
    urdf: Path
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
    root.only("robot", "path", "limits", "cost", "search", "scene", "obstacle", "output")
    folder = Path(file).parent
    robot = root.table("robot", "a table [robot] with urdf and tip", REQUIRED)
    assert robot is not None
    urdf = folder / robot.text("urdf", "the name of a URDF file", REQUIRED)
    machine = _machine(robot, urdf)
    robot.done()
    path = root.table("path", "a table [path] with file or points, and speed", REQUIRED)
    assert path is not None
    task = _task(path, folder)
    path.done()
    options: dict[str, Any] = {}
    obstacles = obstacles_of(root, folder)
    names = machine.robot.joint_names
    for name, read in (
        ("limits", _limits),
        ("cost", _cost),
        ("search", _read_search),
        ("scene", partial(_read_scene, obstacles)),
    ):
        if (table := root.table(name, f"a table [{name}]")) is not None:
            options |= read(table, names, folder)
            table.done()
    outputs_in = folder if output_folder is None else Path(output_folder)
    outputs, period = _outputs(root.table("output", "a table [output]"), outputs_in)
    root.done()
    options.setdefault("scene", Scene(obstacles=obstacles))
    cost = options.get("cost")
    if options.get("horizon") == "free" and cost is not None and not cost.time:
        options["cost"] = replace(cost, time=1.0)
    return Task(machine, task, options, outputs, period, str(file), urdf, outputs_in)


@contextmanager
def _located_errors(entries: TomlTable, name: str | None) -> Iterator[None]:
    """Add the file and the entry of a task file to errors raised inside the block."""
    try:
        yield
    except (ModelError, ProblemError) as error:
        located = entries.error(name if name is not None and name in entries else None, str(error))
        located.value, located.limit = error.value, error.limit
        raise located from error


def _machine(entries: TomlTable, urdf: Path) -> Machine:
    """Read the table [robot] and return the robot on its base."""
    tip = entries.text("tip", "the name of the link that carries the tip")
    if not urdf.is_file():
        raise entries.error("urdf", f"there is no file {urdf}; name the robot's URDF, from the task file's folder")
    with _located_errors(entries, "urdf"):
        robot = Robot.from_urdf(urdf)
    if tip is not None:
        with _located_errors(entries, "tip"):
            robot = Robot.from_urdf(urdf, tip=tip)
    locked_positions = entries.numbers_by_name("lock", "a table of joints and positions: lock = { finger = 0.02 }")
    if locked_positions:
        with _located_errors(entries, "lock"):
            robot = lock_joints(robot, locked_positions)
    load = entries.number("load", "a number above 0, kg", least=0.0)
    if load is not None:
        with _located_errors(entries, "load"):
            robot = with_load(robot, robot.tip_link, load, robot.tip_translation)
    base = entries.choice("base", ("fixed", "standing", "floating"), "fixed")
    position, rotation = entries.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0)), rotation_of(entries)
    foot = entries.vector("foot", 4, "four numbers, m: least and greatest x, least and greatest y")
    with _located_errors(entries, "base"):
        if base == "floating":
            return FreeFloating(robot)
        if base == "fixed":
            return FixedBase(robot, position, rotation)
        if foot is not None:
            return Standing(robot=robot, translation=position, rotation=rotation, support=rectangle(foot[:2], foot[2:]))
        contact = footprint(robot, rotation=rotation)
        return Standing(robot=robot, support=contact.support, translation=contact.translation, rotation=rotation)


def _task(entries: TomlTable, folder: Path) -> TipTask:
    """Read the table [path] and return the task of the tip."""
    path = _read_path(entries, folder)
    speed = _path_limit(entries, "speed", "m/s", REQUIRED)
    acceleration = _path_limit(entries, "acceleration", "m/s^2")
    jerk, centripetal = (
        _path_limit(entries, "jerk", "m/s^3", np.inf),
        _path_limit(entries, "centripetal", "m/s^2", np.inf),
    )
    timing: Any = speed
    if acceleration is not None:
        with _located_errors(entries, "acceleration"):
            timing = schedule(path, LineLimits(speed, acceleration, jerk, centripetal))
    elif "jerk" in entries or "centripetal" in entries:
        raise entries.missing("acceleration", "a schedule needs it: acceleration = 1.0, in m/s^2")
    tool = entries.choice("tool", ("free roll", "given", "free"), "free roll")
    direction = entries.vector("direction", 3, "three numbers: where the tool's z axis points")
    within = entries.number("within", "largest angle between the tool's z axis and its direction, rad", least=0.0)
    link = entries.text("link", "the name of a link")
    gain = entries.number("gain", "a number of 1/s, 0 or more", 1.0, least=-1e-300)
    options: dict[str, Any] = {"gain": gain}
    tolerance = entries.vector("tolerance", 2, "two numbers above 0, m and rad: largest errors of the tool's pose")
    if tool == "free" and direction is not None:
        raise entries.error("direction", 'tool = "free" has no direction; remove one of the two')
    if direction is not None:
        options["direction"] = direction
    for name, value in (("within", within), ("link", link), ("tolerance", tolerance)):
        if value is not None:
            options[name] = value
    with _located_errors(entries, "speed"):
        task = TipTask.along(path, timing, roll="given" if tool == "given" else "free", **options)
        return replace(task, rows=(3, 4, 5), direction=None, orientation=None) if tool == "free" else task


def _path_limit(entries: TomlTable, name: str, unit: str, default: Any = None) -> Any:
    """Read a limit along the path, such as the speed; raise ProblemError if it is not between 1e-6 and 1e6."""
    return entries.number(name, f"a number above 0, {unit}, of 1e-6 to 1e6", default, least=0.999e-6, most=1e6)


def _read_path(entries: TomlTable, folder: Path) -> SmoothPath:
    """Read the path of a task file and return it with rounded corners."""
    deviation = entries.number("rounding", "a number above 0, m: largest deviation of rounded corners", 1e-3, least=0.0)
    name = entries.text("file", "the name of a file of waypoints")
    points = entries.raw("points")
    if (name is None) == (points is None):
        raise entries.missing("file", 'give waypoints, file = "seam.csv", or points = [[x, y, z], ...] in m, not both')
    if name is not None:
        if not (folder / name).is_file():
            raise entries.error("file", f"there is no file {folder / name}; name it from the task file's folder")
        with _located_errors(entries, "file"):
            return read_waypoints(folder / name).smooth(deviation)
    try:
        corners = floats(points)
    except NOT_NUMBERS:
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 2 or not np.isfinite(corners).all():
        raise entries.error("points", "points must be two or more triples of numbers, m: [[x, y, z], [x, y, z]]")
    with _located_errors(entries, "points"):
        return smooth(ToolPath.through(corners), deviation=deviation)


def _limits(entries: TomlTable, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Read the joint limits and return them as an option of the planner."""
    limits: dict[str, Any] = {}
    for quantity, unit in LIMIT_UNITS.items():
        expected = f"a number above 0, {unit}, or {{ joint = number }}"
        with _located_errors(entries, quantity):
            limits[quantity] = _each(entries, quantity, names, np.inf, expected)
            Limits(**{quantity: limits[quantity]})
    return {"limits": Limits(**limits, joints=entries.flag("positions", True))}


def _cost(entries: TomlTable, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Read the weights of the cost and return them as an option of the planner."""
    weights = _each(entries, "weights", names, 1.0, "numbers above 0 by joint: { elbow = 4 }")
    time = entries.number("time", "a number above 0, 1/s: cost of a second with a free pace", least=0.0)
    return {"cost": Cost(time=time or 0.0, weights=weights)}


def _each(entries: TomlTable, name: str, names: tuple[str, ...], default: float, expected: str) -> Any:
    """Return an entry as one number for all joints or an array with a number for each joint; None if it is missing."""
    if name not in entries:
        return None
    if not isinstance(entries.raw(name), dict):
        return entries.number(name, expected, least=0.0)
    by_joint = entries.numbers_by_name(name, expected)
    _check_joints(entries, name, by_joint, names)
    return np.array([by_joint.get(joint, default) for joint in names])


def _check_joints(entries: TomlTable, name: str, by_joint: dict[str, float], names: tuple[str, ...]) -> None:
    """Raise ProblemError if a key of an entry is not the name of an independent joint of the robot."""
    for joint in by_joint:
        if joint not in names:
            table = entries.table(name)
            assert table is not None
            raise table.error(joint, f"the robot has no independent joint {joint!r}; it has {', '.join(names)}")


def _read_search(entries: TomlTable, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Read the search settings of a task file and return them as options of the planner."""
    kind = entries.choice("kind", ("configurations", "start", "global", "segments"), "configurations")
    cyclic, pace = entries.flag("cyclic"), entries.choice("pace", ("given", "free"), "given")
    options: dict[str, Any] = {"seed": entries.count("seed", "a whole number, 0 or more", 0)}
    if kind == "segments":
        for name, is_set in (("cyclic", cyclic), ("pace", pace == "free")):
            if is_set:
                raise entries.error(name, f'kind = "segments" does not support {name}; remove it')
    options |= {"search": kind, "cyclic": cyclic}
    if pace == "free":
        options["horizon"] = "free"
    if "start" in entries:
        positions = entries.numbers_by_name("start", "a table of joints and positions: start = { elbow = 1.2 }")
        _check_joints(entries, "start", positions, names)
        if missing := [joint for joint in names if joint not in positions]:
            raise entries.error("start", f"start has no {', '.join(missing)}; give every joint, rad or m")
        options["start"] = np.array([positions[joint] for joint in names])
    return options


def _read_scene(
    obstacles: tuple[Shape, ...], entries: TomlTable, names: tuple[str, ...], folder: Path
) -> dict[str, Any]:
    """Read the collision scene of a task file and return it as an option of the planner."""
    checked = entries.flag("look", True)
    clearance = entries.number("clearance", "a distance of 0 or more, m", 0.0, least=-1e-300)
    srdf = entries.text("srdf", "the name of an SRDF file")
    folders = entries.texts("folders", "a list of names of folders")
    if not checked:
        if obstacles:
            raise entries.error("look", "look = false checks no collisions, but there are obstacles; remove one")
        return {"scene": False}
    scene = Scene(
        obstacles,
        clearance,
        tuple(entries.pairs("ignored", 'pairs of links: [["link1", "link3"]]')),
        None if srdf is None else folder / srdf,
        tuple(folder / name for name in folders),
        entries.choice("meshes", ("raise", "skip"), "raise"),
    )
    return {"scene": scene}


def _outputs(entries: TomlTable | None, folder: Path) -> tuple[dict[str, Path], float]:
    """Read the names of the output files by kind, and the sampling period."""
    if entries is None:
        return {}, 0.01
    outputs = {}
    for kind in OUTPUTS:
        if (name := entries.text(kind, "the name of a file to write")) is not None:
            outputs[kind] = folder / name
            if not outputs[kind].parent.is_dir():
                raise entries.error(kind, f"there is no folder {outputs[kind].parent}; create it, or name another")
            with _located_errors(entries, kind):
                checked_output(kind, outputs[kind], folder, force=True)
    period = entries.number("period", "a number above 0, s", 0.01, least=0.0)
    entries.done()
    return outputs, period
