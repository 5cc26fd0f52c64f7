"""What a plan was asked, as data: from it the problem of the plan is declared again by whoever reads its file.

A request names a builder and holds its arguments: the machine, tasks, limits, weights, and what to stay clear of. These
are written by the fields of their dataclasses, and read by the constructors of these, which check them. Functions of
time (where a task leads its tip, how an obstacle moves) are written as elementary operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import (
    Box,
    Capsule,
    CollisionScene,
    CollisionShape,
    Cylinder,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Joint,
    Link,
    Machine,
    Mesh,
    Mimic,
    ModelError,
    MovingObstacle,
    Robot,
    Sphere,
    Standing,
    Support,
    VisualShape,
)
from models.shapes.bodies import Body, LinkMesh
from models.spatial import expression
from ocp.errors import ProblemError
from ocp.motion.builders.actuator_limits import Effort, JointFriction
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import dynamics_problem
from ocp.motion.builders.standing.problem import FreeTime, Weights, standing_problem
from ocp.motion.builders.tool_motion import ToolMotion, stretches_of, tool_motion_problem
from ocp.motion.search.configurations import Asked
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import TrackWithRate
from ocp.motion.tasks.zmp_rules import IndexAtLeast, InFoot, Pinned
from ocp.problem.function_reader import FunctionReader
from ocp.problem.function_writer import FunctionWriter
from ocp.problem.problem import Problem
from ocp.problem.stored import RECORD_ERRORS

__all__ = ["MotionRequest", "declared_motion", "request_of", "restored_request", "stored_request"]

SHAPES = (Box, Capsule, Cylinder, HalfSpace, Mesh, Sphere)
PARTS = (Robot, Link, Joint, Mimic, CollisionShape, VisualShape, Support)
ASKED = (TipTask, Limits, ClearanceConstraints, Effort, JointFriction, Weights, FreeTime, InFoot, Pinned, IndexAtLeast)
MACHINES = (FixedBase, FreeFloating, Standing)
KINDS = {kind.__name__: kind for kind in (*MACHINES, *PARTS, *SHAPES, *ASKED, MovingObstacle, Body)}
SYMBOLS = {"SX": ca.SX, "MX": ca.MX}
TRACKS = {TipTask: ("velocity", "position", "orientation", "direction"), MovingObstacle: ("position", "rotation")}
"""Fields that may be functions of time."""


@dataclass(frozen=True, eq=False)
class MotionRequest:
    """What a problem was declared from.

    Attributes:
        builder: Its name among BUILDERS.
        arguments: Of the builder, by name.
    """

    builder: str
    arguments: Mapping[str, Any]

    @property
    def machine(self) -> Machine:
        """What moves."""
        machine: Machine = self.arguments["machine"]
        return machine

    @property
    def tasks(self) -> tuple[TipTask, ...]:
        """What its tips do."""
        tasks = self.arguments.get("tasks", ())
        return (tasks,) if isinstance(tasks, TipTask) else tuple(tasks)

    def __repr__(self) -> str:
        return f"<MotionRequest of {self.builder!r}: {', '.join(self.arguments)}>"

    def problem(self) -> Problem:
        """Declare the problem.

        Raises:
            ProblemError: As the builder.
        """
        problem: Problem = BUILDERS[self.builder](**self.arguments)
        problem.origin = self
        return problem


def declared_motion(
    asked: Asked,
    *,
    start: Any,
    reference: Any,
    clearance_constraints: ClearanceConstraints | None,
    limits: Limits | None = None,
) -> ToolMotion:
    """Declare the problem of a motion, which remembers what it was declared from.

    Args:
        asked: What is asked. start, reference, clear: As of `tool_motion_problem`.
        limits: With those of the drives, where these are limited; else None.
    """
    own: dict[str, Any] = {
        "base": asked.base,
        "start": start,
        "reference": reference,
        "cyclic": asked.cyclic,
        "weights": asked.weights,
        "time_cost": asked.time_cost,
        "driven": limits is not None,
        "held": asked.held if limits is None else None,
        "clearance_constraints": clearance_constraints,
    }
    bounds = (limits or asked.limits).bounds(asked.machine)
    motion = tool_motion_problem(asked.machine, asked.stretches, bounds=bounds, **own)
    given = {"machine": asked.machine, "tasks": asked.tasks, "horizon": asked.horizon}
    arguments = {**given, "limits": limits or asked.limits, **own}
    motion.problem.origin = MotionRequest("tool motion", arguments)
    return motion


def _tool_motion(machine: Machine, tasks: Any, horizon: float, *, limits: Limits, **own: Any) -> Problem:
    stretches = stretches_of(machine, tasks, horizon)
    return tool_motion_problem(machine, stretches, bounds=limits.bounds(machine), **own).problem


BUILDERS: dict[str, Callable[..., Problem]] = {
    "tool motion": _tool_motion,
    "standing": standing_problem,
    "dynamics": dynamics_problem,
}


def request_of(problem: Problem | None) -> MotionRequest | None:
    """Return what a problem was declared from; None where that is not known."""
    origin = None if problem is None else problem.origin
    if isinstance(origin, tuple):  # a builder below this module, and its arguments
        origin = MotionRequest(*origin)
    return origin if isinstance(origin, MotionRequest) else None


# ---- writing -------------------------------------------------------------------------------------------------------


def stored_request(builder: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record of names, numbers and arrays.

    Raises:
        ProblemError: An argument is no data, such as a machine of another kind or a callback of Python's.
    """
    writer = FunctionWriter()
    owner: Machine | None = arguments.get("machine")

    def put(value: Any) -> Any:
        if value is None or isinstance(value, str | bool | int | float):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, ca.DM | np.ndarray):
            return np.array(value.full() if isinstance(value, ca.DM) else value, dtype=float)
        if isinstance(value, Mapping):
            return {"pool": [[put(key), put(part)] for key, part in value.items()]}
        if isinstance(value, tuple | list):
            return [put(part) for part in value]
        if isinstance(value, Mesh):  # its file stays where it is: the hull is what counts
            placed = {"vertices": value.hull.vertices, "position": value.position, "rotation": value.rotation}
            return {"kind": "Mesh", "fields": {name: put(part) for name, part in placed.items()}}
        if isinstance(value, CollisionScene) and value.machine is owner:
            return {"kind": "CollisionScene", "fields": {name: put(part) for name, part in _around(value).items()}}
        if is_dataclass(value) and KINDS.get(type(value).__name__) is type(value):
            parts = {one.name: getattr(value, one.name) for one in fields(value) if one.init}
            tracks = TRACKS.get(type(value), ())
            if isinstance(value, MovingObstacle):  # as it takes them: its tables are polynomials already
                parts |= {"position": lambda time: value.frame(time).position}
                parts |= {"rotation": lambda time: value.frame(time).rotation}
            return {
                "kind": type(value).__name__,
                "fields": {
                    name: _put_track(name, part, writer) if name in tracks and callable(part) else put(part)
                    for name, part in parts.items()
                },
            }
        kind = next((name for name, symbols in SYMBOLS.items() if value is symbols), None)
        if kind is not None:
            return {"symbols": kind}
        words = f"a {type(value).__name__} is no data that a file can hold"
        raise ProblemError(words, name=type(value).__name__, value=repr(value)[:80])

    pool = []
    for name, value in arguments.items():
        try:
            pool.append([name, put(value)])
        except ProblemError as error:
            raise ProblemError(f"{name}: {error}", name=name, value=error.value) from error
    return {"builder": builder, "arguments": {"pool": pool}, "functions": writer.records}


def _around(around: CollisionScene) -> dict[str, Any]:
    """What its machine keeps clear of, by the bodies that cover meshes in place of the files of these."""
    return {
        "obstacles": around.obstacles,
        "clearance": around.clearance,
        "ignored": [*around.ignored, *around.disabled],
        "limits": around.limits,
        "covered": {
            f"{link}/{number}": [
                bodies[0].mesh.hull.core if bodies and bodies[0].mesh is not None else (),
                [[body.shape, body.overhang] for body in bodies],
            ]
            for (link, number), bodies in (around.covered or {}).items()
        },
    }


def _put_track(name: str, track: Callable[[Any], Any], writer: FunctionWriter) -> dict[str, Any]:
    """A function of time, and its rate where it has one."""
    parts = {"track": track, "rate": getattr(track, "rate", None)}
    return {what: writer.write(_traced(name, part)) for what, part in parts.items() if part is not None}


def _traced(name: str, track: Callable[[Any], Any]) -> Any:
    """A function of time as a casadi Function."""
    for symbols in (ca.SX, ca.MX):
        time = symbols.sym("time")
        try:
            return ca.Function("track", [time], [ca.densify(symbols(expression(track(time))))])
        except (RuntimeError, NotImplementedError, TypeError, ModelError) as error:
            why = str(error).strip().splitlines()[-1]
    raise ProblemError(f"{name} is no function of casadi's time alone: {why}", name=name)


# ---- reading -------------------------------------------------------------------------------------------------------


def restored_request(record: Any) -> MotionRequest:
    """Return the request of which `stored_request` returned the record. Nothing in it is trusted.

    Raises:
        ProblemError: The record is damaged.
    """
    try:
        functions = FunctionReader(record["functions"]).functions
        own = dict(record["arguments"]["pool"])
        machine = _read(own["machine"], functions, None)
        if not isinstance(machine, MACHINES):
            raise TypeError(f"what was written is no machine but {type(machine).__name__}")
        arguments = {
            name: machine if name == "machine" else _read(value, functions, machine) for name, value in own.items()
        }
        if record["builder"] not in BUILDERS and record["builder"] != "":
            raise ValueError(f"builder {record['builder']!r} is not known")
        return MotionRequest(record["builder"], arguments)
    except (*RECORD_ERRORS, ProblemError) as error:
        raise ProblemError(f"the request that was written is damaged: {error}", name="request") from error


def _read(value: Any, functions: list[Any], machine: Machine | None) -> Any:
    def read(part: Any) -> Any:
        return _read(part, functions, machine)

    if isinstance(value, list):
        return tuple(read(part) for part in value)
    if not isinstance(value, dict):
        return value
    if "pool" in value:
        return {read(key): read(part) for key, part in value["pool"]}
    if "symbols" in value:
        return SYMBOLS[value["symbols"]]
    if "track" in value:
        at = _of_time(functions[value["track"]])
        return at if "rate" not in value else TrackWithRate(at, _of_time(functions[value["rate"]]))
    own = {name: read(part) for name, part in value["fields"].items()}
    if value["kind"] == "CollisionScene":
        around = {name: own[name] for name in ("obstacles", "clearance", "ignored", "limits")}
        return CollisionScene(machine, **around, covered=_covered(own["covered"]))  # type: ignore[arg-type]
    if own.get("file") is not None and value["kind"] == "Mesh":
        raise ValueError("a mesh names a file, which is not opened")
    return KINDS[value["kind"]](**own)


def _of_time(function: Any) -> Any:
    if function.n_in() != 1 or function.size_in(0) != (1, 1) or function.n_out() != 1:
        raise ValueError("a track is no function of one number")
    return function


def _covered(written: Mapping[str, Any]) -> dict[tuple[str, int], tuple[Body, ...]]:
    """The bodies that cover each mesh, by the link and the place of the mesh among its collision shapes."""
    found = {}
    for place, (points, shapes) in written.items():
        link, _, number = place.rpartition("/")
        mesh = LinkMesh(np.asarray(points, dtype=float).reshape(-1, 3), int(number))
        found[link, int(number)] = tuple(Body(link, shape, overhang, mesh) for shape, overhang in shapes)
    return found
