"""Task files: what is to be planned, written down by people who do not program.

They are TOML; names of files are from the folder of the task file.

[robot]
urdf = "ur5_robot.urdf"
tip = "tool0"                       # link that carries the tip
# base = "floating"                 # or "standing"; fixed if it is not told
# position = [0, 0, 0.8]            # of the base in world, m; rpy = [0, 0, 1.57], rad
# lock = { finger_joint = 0.02 }    # joints held still
# load = 1.5                        # kg at the tip
[path]
file = "seam.csv"                   # waypoints; or points = [[0.4, -0.2, 0.3], [0.4, 0.2, 0.3]], m
rounding = 0.002                    # m, that rounded corners may stray
speed = 0.05                        # m/s; with acceleration and jerk it starts and ends at rest
# direction = [0, 0, -1]            # of the tool's z axis, where the file does not tell; its roll is free
# tool = "given"                    # the whole orientation as the file has it; or "free": position alone
[limits]
velocity = 2.0                      # for all joints, rad/s or m/s, or { elbow = 1.5 }
# torque = { elbow = 40 }           # N m or N; acceleration, jerk, power (W) likewise
[cost]
weights = { elbow = 4 }             # of squared joint rates; 1 of all others
[search]
kind = "configurations"                   # or "start", "global"; "pieces": the fewest motions, where one does not do
# start = { elbow = 1.2 }           # joints at the start, all of them; cyclic = true; seed = 1; pace = "free"
[surroundings]
clearance = 0.01                    # m; ignored = [["link1", "link3"]]; srdf = "..."; folders = ["..."]
[[obstacle]]
shape = "box"                       # see ocp.app.files.task_file
size = [0.06, 0.06, 0.3]
position = [0.55, 0.0, 0.45]
[output]
plan = "seam.npz"                   # csv, json, yaml, mcap, urdf, report likewise; period = 0.01

Obstacles from a file: shapes in world, one under each [[obstacle]] of a TOML file.

[[obstacle]]
shape = "box"                       # or sphere, capsule, cylinder, halfspace, mesh
size = [0.06, 0.06, 0.3]            # m
position = [0.55, 0.0, 0.45]        # m
rpy = [0, 0, 0.5]                   # rad, optional: turns about the world's x, then y, then z
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
    locked,
    rectangle,
    smooth,
    with_load,
)
from models import Path as ToolPath
from models.arrays import Array
from models.shapes.shapes import Shape
from models.spatial import rotation_from_rpy
from ocp.app.files.entries import REQUIRED, Entries, read_entries
from ocp.app.files.lines import FileName
from ocp.app.files.outputs import SUFFIXES, checked_output
from ocp.app.files.waypoints import read_waypoints
from ocp.errors import NOT_NUMBERS, ProblemError, floats
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["OUTPUTS", "Task", "obstacles_of", "read_obstacles", "read_task", "turn_of"]

SHAPES = ("box", "sphere", "capsule", "cylinder", "halfspace", "mesh")


def read_obstacles(file: FileName) -> tuple[Shape, ...]:
    """The shapes in a file, in its order.

    Raises:
        ProblemError: By line, what is wrong and what was expected.
    """
    entries = read_entries(file)
    found = obstacles_of(entries, Path(file).parent)
    entries.done()
    if not found:
        raise entries.missing("obstacle", 'tables headed [[obstacle]], each with shape = "box" or another')
    return found


def obstacles_of(entries: Entries, folder: Path) -> tuple[Shape, ...]:
    """The shapes under [[obstacle]]; files of meshes are looked for from a folder."""
    found = []
    for one in entries.tables("obstacle"):
        shape = one.choice("shape", SHAPES, REQUIRED)
        try:
            found.append(_shape(one, shape, folder))
        except ModelError as error:
            name = error.name if error.name is not None and error.name in one else None
            raise one.wrong(name, str(error)) from error
        one.done()
    return tuple(found)


def turn_of(entries: Entries) -> Array:
    """The rotation that `rpy` says, none where it is not there. Shape (3, 3)."""
    told = entries.vector("rpy", 3, "three angles, rad", (0.0, 0.0, 0.0))
    return np.array(rotation_from_rpy(*(float(angle) for angle in told)), dtype=float)


def _shape(one: Entries, shape: str, folder: Path) -> Shape:
    def place(name: str = "position") -> Any:
        return one.vector(name, 3, "three numbers, m", REQUIRED)

    def length(name: str) -> Any:
        return one.number(name, "a number above 0, m", REQUIRED, least=0.0)

    if shape == "box":
        return Box(one.vector("size", 3, "three lengths, m", REQUIRED), place(), turn_of(one))
    if shape == "sphere":
        return Sphere(length("radius"), place())
    if shape == "capsule":
        return Capsule(length("radius"), place("start"), place("end"))
    if shape == "cylinder":
        return Cylinder(length("radius"), length("length"), place(), turn_of(one))
    if shape == "halfspace":
        return HalfSpace(one.vector("normal", 3, "three numbers: out of what is solid", REQUIRED), place("point"))
    name = one.text("file", "the name of an STL, OBJ or DAE file", REQUIRED)
    scale = one.number("scale", "a number above 0: m for each unit of the file", 1.0, least=0.0)
    position = one.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0))
    return Mesh(file=folder / name, position=position, rotation=turn_of(one), scale=scale)


OUTPUTS = tuple(SUFFIXES)
LIMITED = {
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
    "jerk": "rad/s^3 or m/s^3",
    "torque": "N m or N",
    "power": "W",
}
"""What of joints is limited."""


@dataclass(frozen=True, eq=False)
class Task:
    """What a task file asks for.

    Attributes:
        machine: Read from the robot's file. task: Of its tip.
        options: Keywords of `ocp.plan`; of `ocp.plan_in_segments` where it is to be done `in_pieces`.
        outputs: Files to write, by kind of OUTPUTS, all below the `output_folder`. period: Of samples in them, s.
        file, urdf: Names of the task's own file and of the robot's.
    """

    machine: Machine
    task: TipTask
    options: dict[str, Any]
    outputs: dict[str, Path]
    period: float
    file: str
    urdf: Path
    output_folder: Path
    in_pieces: bool = False


def read_task(file: FileName, output_folder: FileName | None = None) -> Task:
    """What a task file asks for; nothing is planned.

    Args:
        output_folder: Where the names of outputs begin, and below which they must lie; None: the task file's folder.

    Raises:
        ProblemError: By line, what is wrong and what was expected.
    """
    root = read_entries(file)
    root.only("robot", "path", "limits", "cost", "search", "surroundings", "obstacle", "output")
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
    options: dict[str, Any] = {"obstacles": obstacles_of(root, folder)}
    names = machine.robot.joint_names
    for name, read in (("limits", _limits), ("cost", _cost), ("search", _search), ("surroundings", _surroundings)):
        if (table := root.table(name, f"a table [{name}]")) is not None:
            options |= read(table, names, folder)
            table.done()
    written = folder if output_folder is None else Path(output_folder)
    outputs, period = _outputs(root.table("output", "a table [output]"), written)
    root.done()
    in_pieces = options.pop("in_pieces", False)
    return Task(machine, task, options, outputs, period, str(file), urdf, written, in_pieces)


@contextmanager
def _about(entries: Entries, name: str | None) -> Iterator[None]:
    """What is refused inside is wrong with an entry."""
    try:
        yield
    except (ModelError, ProblemError) as error:
        told = entries.wrong(name if name is not None and name in entries else None, str(error))
        told.value, told.limit = error.value, error.limit
        raise told from error


def _machine(entries: Entries, urdf: Path) -> Machine:
    tip = entries.text("tip", "the name of the link that carries the tip")
    if not urdf.is_file():
        raise entries.wrong("urdf", f"there is no file {urdf}; name the robot's URDF, from the task file's folder")
    with _about(entries, "urdf"):
        robot = Robot.from_urdf(urdf)
    if tip is not None:
        with _about(entries, "tip"):
            robot = Robot.from_urdf(urdf, tip=tip)
    held = entries.numbers_by_name("lock", "a table of joints and positions: lock = { finger = 0.02 }")
    if held:
        with _about(entries, "lock"):
            robot = locked(robot, held)
    load = entries.number("load", "a number above 0, kg", least=0.0)
    if load is not None:
        with _about(entries, "load"):
            robot = with_load(robot, robot.tip_link, load, robot.tip_translation)
    base = entries.choice("base", ("fixed", "standing", "floating"), "fixed")
    place, turn = entries.vector("position", 3, "three numbers, m", (0.0, 0.0, 0.0)), turn_of(entries)
    foot = entries.vector("foot", 4, "four numbers, m: least and greatest x, least and greatest y")
    with _about(entries, "base"):
        if base == "floating":
            return FreeFloating(robot)
        if base == "fixed":
            return FixedBase(robot, place, turn)
        if foot is not None:
            return Standing(robot=robot, translation=place, rotation=turn, support=rectangle(foot[:2], foot[2:]))
        under = footprint(robot, rotation=turn)
        return Standing(robot=robot, support=under.support, translation=under.translation, rotation=turn)


def _task(entries: Entries, folder: Path) -> TipTask:
    path = _path(entries, folder)
    speed = _pace(entries, "speed", "m/s", REQUIRED)
    acceleration = _pace(entries, "acceleration", "m/s^2")
    jerk, centripetal = _pace(entries, "jerk", "m/s^3", np.inf), _pace(entries, "centripetal", "m/s^2", np.inf)
    pace: Any = speed
    if acceleration is not None:
        with _about(entries, "acceleration"):
            pace = schedule(path, LineLimits(speed, acceleration, jerk, centripetal))
    elif "jerk" in entries or "centripetal" in entries:
        raise entries.missing("acceleration", "a schedule needs it: acceleration = 1.0, in m/s^2")
    tool = entries.choice("tool", ("free roll", "given", "free"), "free roll")
    direction = entries.vector("direction", 3, "three numbers: where the tool's z axis points")
    within = entries.number("within", "an angle, rad, that the tool may lean from its direction", least=0.0)
    link = entries.text("link", "the name of a link")
    gain = entries.number("gain", "a number of 1/s, 0 or more", 1.0, least=-1e-300)
    others: dict[str, Any] = {"gain": gain}
    tolerance = entries.vector("tolerance", 2, "two numbers above 0, m and rad, that the tool may be off")
    if tool == "free" and direction is not None:
        raise entries.wrong("direction", 'tool = "free" has no direction; leave one of the two out')
    if direction is not None:
        others["direction"] = direction
    for name, value in (("within", within), ("link", link), ("tolerance", tolerance)):
        if value is not None:
            others[name] = value
    with _about(entries, "speed"):
        task = TipTask.along(path, pace, roll="given" if tool == "given" else "free", **others)
        return replace(task, rows=(3, 4, 5), direction=None, orientation=None) if tool == "free" else task


def _pace(entries: Entries, name: str, unit: str, default: Any = None) -> Any:
    """What a schedule is asked for; what is beyond is no machine's."""
    return entries.number(name, f"a number above 0, {unit}, of 1e-6 to 1e6", default, least=0.999e-6, most=1e6)


def _path(entries: Entries, folder: Path) -> SmoothPath:
    stray = entries.number("rounding", "a number above 0, m: how far rounded corners may stray", 1e-3, least=0.0)
    name = entries.text("file", "the name of a file of waypoints")
    points = entries.raw("points")
    if (name is None) == (points is None):
        raise entries.missing("file", 'give waypoints, file = "seam.csv", or points = [[x, y, z], ...] in m, not both')
    if name is not None:
        if not (folder / name).is_file():
            raise entries.wrong("file", f"there is no file {folder / name}; name it from the task file's folder")
        with _about(entries, "file"):
            return read_waypoints(folder / name).smooth(stray)
    try:
        corners = floats(points)
    except NOT_NUMBERS:
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 2 or not np.isfinite(corners).all():
        raise entries.wrong("points", "points must be two or more of three numbers, m: [[x, y, z], [x, y, z]]")
    with _about(entries, "points"):
        return smooth(ToolPath.through(corners), deviation=stray)


def _limits(entries: Entries, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    given: dict[str, Any] = {}
    for what, unit in LIMITED.items():
        expected = f"a number above 0, {unit}, or {{ joint = number }}"
        with _about(entries, what):
            given[what] = _each(entries, what, names, np.inf, expected)
            Limits(**{what: given[what]})
    return {"limits": Limits(**given, joints=entries.flag("positions", True))}


def _cost(entries: Entries, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    return {"weights": _each(entries, "weights", names, 1.0, "numbers above 0 by joint: { elbow = 4 }")}


def _each(entries: Entries, name: str, names: tuple[str, ...], other: float, expected: str) -> Any:
    """One number for all joints, or one for each; None where nothing is told."""
    if name not in entries:
        return None
    if not isinstance(entries.raw(name), dict):
        return entries.number(name, expected, least=0.0)
    told = entries.numbers_by_name(name, expected)
    _check_joints(entries, name, told, names)
    return np.array([told.get(joint, other) for joint in names])


def _check_joints(entries: Entries, name: str, told: dict[str, float], names: tuple[str, ...]) -> None:
    for joint in told:
        if joint not in names:
            table = entries.table(name)
            assert table is not None
            raise table.wrong(
                joint, f"the robot has no joint {joint!r} that moves by itself; it has {', '.join(names)}"
            )


def _search(entries: Entries, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    kind = entries.choice("kind", ("configurations", "start", "global", "pieces"), "configurations")
    cyclic, pace = entries.flag("cyclic"), entries.choice("pace", ("given", "free"), "given")
    found: dict[str, Any] = {"seed": entries.count("seed", "a whole number, 0 or more", 0)}
    if kind == "pieces":
        for name, told in (("cyclic", cyclic), ("pace", pace == "free")):
            if told:
                raise entries.wrong(name, 'kind = "pieces" keeps the path\'s own pace and closes nothing; leave it out')
        found["in_pieces"] = True
    else:
        found |= {"search": kind, "cyclic": cyclic}
    if pace == "free":
        found["horizon"] = "free"
    if "start" in entries:
        told = entries.numbers_by_name("start", "a table of joints and positions: start = { elbow = 1.2 }")
        _check_joints(entries, "start", told, names)
        if missing := [joint for joint in names if joint not in told]:
            raise entries.wrong("start", f"start lacks {', '.join(missing)}; give every joint, rad or m")
        found["start"] = np.array([told[joint] for joint in names])
    return found


def _surroundings(entries: Entries, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    look = entries.flag("look", True)
    clearance = entries.number("clearance", "a distance of 0 or more, m", 0.0, least=-1e-300)
    srdf = entries.text("srdf", "the name of an SRDF file")
    folders = entries.texts("folders", "a list of names of folders")
    found: dict[str, Any] = {"clearance": clearance if look else None}
    if look:
        found["ignored"] = tuple(entries.pairs("ignored", 'pairs of links: [["link1", "link3"]]'))
        found["srdf"] = None if srdf is None else folder / srdf
        found["folders"] = tuple(folder / name for name in folders)
        found["missing"] = entries.choice("meshes", ("raise", "skip"), "raise")
    return found


def _outputs(entries: Entries | None, folder: Path) -> tuple[dict[str, Path], float]:
    if entries is None:
        return {}, 0.01
    found = {}
    for kind in OUTPUTS:
        if (name := entries.text(kind, "the name of a file to write")) is not None:
            found[kind] = folder / name
            if not found[kind].parent.is_dir():
                raise entries.wrong(kind, f"there is no folder {found[kind].parent}; make it, or name another")
            with _about(entries, kind):
                checked_output(kind, found[kind], folder, force=True)
    period = entries.number("period", "a number above 0, s", 0.01, least=0.0)
    entries.done()
    return found, period
