"""Requests from which the reader of a plan file declares the optimal control problem of a plan again.

A request names a builder and holds its arguments: machine, tasks, limits, weights and clearance constraints. They are
written by the fields of their dataclasses, and read by the constructors, which check them. Functions of time (of a task
or a moving obstacle) are written as elementary operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import (
    CollisionScene,
    CollisionShape,
    FixedBase,
    Foot,
    Foothold,
    FreeFloating,
    Joint,
    Link,
    Machine,
    Mesh,
    Mimic,
    ModelError,
    MovingObstacle,
    Robot,
    Stance,
    Standing,
    Support,
    VisualShape,
)
from models.machines.machine import hold_joints
from models.shapes.bodies import Body, LinkMesh
from models.shapes.shapes import SHAPE_KINDS
from models.spatial import expression
from ocp.errors import ProblemError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import Actuation, DynamicsSetup, JointFriction, dynamics_problem
from ocp.motion.builders.dynamics_plan import dynamics_phases, machines_of
from ocp.motion.builders.joint_motion import joint_motion_problem
from ocp.motion.builders.space.capture import Capture, Cone, Grasp, capture_machines, capture_problem
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.builders.standing.stances import StancePhase, Steps
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.builders.tool_motion import ToolMotion, ToolMotionSetup, stretches_of, tool_motion_problem
from ocp.motion.search.configurations import PlanRequest
from ocp.motion.tasks.goals import Cost, Goal, Start
from ocp.motion.tasks.limits import IndexAtLeast, InFoot, Limits, Pinned
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import TrackWithRate
from ocp.problem.problem import Problem
from ocp.problem.record_reader import RECORD_ERRORS, FunctionReader
from ocp.problem.record_writer import FunctionWriter

PARTS = (Robot, Link, Joint, Mimic, CollisionShape, VisualShape, Support)
STANDING = (Weights, FreeTime, InFoot, Pinned, IndexAtLeast, StandingSetup)
STEPS = (Steps, StancePhase, StepWeights, Foot, Foothold)
DYNAMICS = (Actuation, ClearanceConstraints, JointFriction, DynamicsSetup, Capture, Cone, Grasp)
ARGUMENTS = (TipTask, Goal, Start, Limits, Cost, *DYNAMICS, *STANDING, *STEPS)
MACHINES = (FixedBase, FreeFloating, Standing, Stance)
KINDS = {kind.__name__: kind for kind in (*MACHINES, *PARTS, *SHAPE_KINDS, *ARGUMENTS, MovingObstacle, Body)}
RESERVE = "reserve"
"""Name among the arguments of a request under which robust plans store by how much the problem is stricter than the
plan must be: the "distance" by which obstacles are enlarged, m, and the "torque" limits of the joints, shape (n,)."""
SYMBOLS = {"SX": ca.SX, "MX": ca.MX}
TRACKS = {TipTask: ("velocity", "position", "orientation", "direction"), MovingObstacle: ("position", "rotation")}
"""Fields of tasks and moving obstacles that may be functions of time."""


def _machine_of(arguments: Mapping[str, Any]) -> Machine:
    """Return the machine that a problem builder's arguments contain."""
    if "steps" in arguments:
        steps: Steps = arguments["steps"]
        return steps.stances[0]
    machine: Machine = next(arguments[name] for name in MACHINE_NAMES if name in arguments)
    return machine


@dataclass(frozen=True, eq=False)
class MotionRequest:
    """Name and arguments of the builder function with which an optimal control problem can be declared again.

    Attributes:
        builder: Name of the builder in BUILDERS.
        arguments: Arguments of the builder, by name. All but the tasks are for the machine with the joints in "held"
            locked at these positions. RESERVE is no argument of the builder.
    """

    builder: str
    arguments: Mapping[str, Any]

    @property
    def machine(self) -> Machine:
        """Machine whose motion the problem describes."""
        return _machine_of(self.arguments)

    @property
    def held(self) -> Mapping[str, float]:
        """Positions of the joints that stay at rest and are no variables of the problem, rad or m, by name."""
        held: Mapping[str, float] = self.arguments.get("held", {})
        return held

    @property
    def tasks(self) -> tuple[TipTask, ...]:
        """Tip tasks that the problem contains as constraints."""
        tasks = self.arguments.get("tasks", ())
        return (tasks,) if isinstance(tasks, TipTask) else tuple(tasks)

    @property
    def cost(self) -> Any:
        """Cost function with which the problem is declared; None stands for the default of the builder."""
        return getattr(self.arguments.get("actuation"), "cost", self.arguments.get("cost"))

    def __repr__(self) -> str:
        return f"<MotionRequest of {self.builder!r}: {', '.join(self.arguments)}>"

    def problem(self) -> Problem:
        """Call the builder with its arguments to declare the optimal control problem again.

        Raises:
            ProblemError: As the builder.
        """
        arguments = {name: value for name, value in self.arguments.items() if name != RESERVE}
        problem: Problem = BUILDERS[self.builder](**arguments)
        problem.origin = self
        return problem


def declared_motion(
    request: PlanRequest,
    *,
    start: Any,
    reference: Any,
    constraints: ClearanceConstraints | None,
    actuation: Actuation | None = None,
    relaxed: bool = False,
) -> ToolMotion:
    """Declare the problem of a request, and store the request in the problem, so that files can rebuild the problem.

    The other arguments are fields of `ToolMotionSetup`.
    """
    options: dict[str, Any] = {
        "base": request.base,
        "start": start,
        "reference": reference,
        "cyclic": request.cyclic,
        "weights": request.weights,
        "time_cost": request.time_cost,
        "actuation": actuation,
        "relaxed": relaxed,
        "clearance_constraints": constraints,
    }
    limits = request.limits if actuation is None else request.actuator_limits or request.limits
    bounds = limits.bounds(request.machine)
    motion = tool_motion_problem(request.machine, request.stretches, ToolMotionSetup(bounds=bounds, **options))
    arguments = {"machine": request.whole or request.machine, "tasks": request.tasks, "horizon": request.horizon}
    arguments |= {"held": dict(request.held), "limits": limits, **options}
    motion.problem.origin = MotionRequest("tool motion", arguments)
    return motion


def _tool_motion(
    machine: Machine, tasks: Any, horizon: float, *, held: Mapping[str, float], limits: Limits, **options: Any
) -> Problem:
    machine = hold_joints(machine, held) if held else machine
    stretches = stretches_of(machine, tasks, horizon)
    setup = ToolMotionSetup(bounds=limits.bounds(machine), **options)
    return tool_motion_problem(machine, stretches, setup).problem


BUILDERS: dict[str, Callable[..., Problem]] = {
    "tool motion": _tool_motion,
    "standing": standing_problem,
    "dynamics": dynamics_problem,
    "dynamics phases": dynamics_phases,
    "steps": steps_problem,
    "capture": capture_problem,
    "joint motion": joint_motion_problem,
}
MACHINE_NAMES = ("machine", "chaser")  # names of the builder arguments that hold the machine


def machines_of_phases(request: MotionRequest | None) -> tuple[Machine, ...]:
    """Return the machine of each phase of a problem; empty if the problem has no phases or its request is unknown."""
    if request is None:
        return ()
    arguments = request.arguments
    if request.builder == "steps":
        steps: Steps = arguments["steps"]
        return steps.stances
    if request.builder == "capture":
        return capture_machines(arguments["chaser"], arguments["capture"].target)
    return machines_of(arguments["machine"], arguments["goals"]) if request.builder == "dynamics phases" else ()


def request_of(problem: Problem | None) -> MotionRequest | None:
    """Return the builder and arguments from which a problem was declared; None if they are unknown."""
    origin = None if problem is None else problem.origin
    if isinstance(origin, tuple):  # name and arguments of a builder that does not import this module
        origin = MotionRequest(*origin)
    return origin if isinstance(origin, MotionRequest) else None


# ---- writing ---------------------------------------------------------------------------------------------------------


def stored_request(builder: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return a request as a record of names, numbers and arrays for a file.

    Raises:
        ProblemError: An argument is not data, such as a machine of another kind or a Python callback.
    """
    writer = FunctionWriter()
    owner: Machine | None = _machine_of(arguments)

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
        if isinstance(value, Mesh):  # only the hull of the file is stored
            parts_in_world = {"vertices": value.hull.vertices, "position": value.position, "rotation": value.rotation}
            return {"kind": "Mesh", "fields": {name: put(part) for name, part in parts_in_world.items()}}
        if isinstance(value, CollisionScene) and (value.machine is owner or arguments.get("held")):
            scene_fields = {name: put(part) for name, part in _scene_fields(value).items()}
            return {"kind": "CollisionScene", "fields": scene_fields}
        if is_dataclass(value) and KINDS.get(type(value).__name__) is type(value):
            parts = {each.name: getattr(value, each.name) for each in fields(value) if each.init}
            tracks = TRACKS.get(type(value), ())
            if isinstance(value, MovingObstacle):  # as its arguments: tables are stored as polynomials
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
        words = f"a {type(value).__name__} cannot be stored in a file"
        raise ProblemError(words, name=type(value).__name__, value=repr(value)[:80])

    pool = []
    for name, value in arguments.items():
        try:
            pool.append([name, put(value)])
        except ProblemError as error:
            raise ProblemError(f"{name}: {error}", name=name, value=error.value) from error
    return {"builder": builder, "arguments": {"pool": pool}, "functions": writer.records}


def _scene_fields(scene: CollisionScene) -> dict[str, Any]:
    """Return the constructor arguments of a collision scene; bodies that enclose meshes replace the mesh files."""
    return {
        "obstacles": scene.obstacles,
        "clearance": scene.clearance,
        "ignored": [*scene.ignored, *scene.disabled],
        "limits": scene.limits,
        "covered": {
            f"{link}/{number}": [
                bodies[0].mesh.hull.core if bodies and bodies[0].mesh is not None else (),
                [[body.shape, body.overhang] for body in bodies],
            ]
            for (link, number), bodies in (scene.covered or {}).items()
        },
    }


def _put_track(name: str, track: Callable[[Any], Any], writer: FunctionWriter) -> dict[str, Any]:
    """Return the file record of a function of time and, if it has a method `rate`, of its time derivative."""
    parts = {"track": track, "rate": getattr(track, "rate", None)}
    return {role: writer.write(_trace(name, part)) for role, part in parts.items() if part is not None}


def _trace(name: str, track: Callable[[Any], Any]) -> Any:
    """Convert a Python function of time to a CasADi function by calling the function with a symbol."""
    for symbols in (ca.SX, ca.MX):
        time = symbols.sym("time")
        try:
            return ca.Function("track", [time], [ca.densify(symbols(expression(track(time))))])
        except (RuntimeError, NotImplementedError, TypeError, ModelError) as error:
            reason = str(error).strip().splitlines()[-1]
    raise ProblemError(f"{name} is not a CasADi function of time alone: {reason}", name=name)


# ---- reading ---------------------------------------------------------------------------------------------------------


def restored_request(record: Any) -> MotionRequest:
    """Rebuild a request from a record of `stored_request`, which is checked because files are not trusted.

    Raises:
        ProblemError: The record is damaged.
    """
    try:
        functions = FunctionReader(record["functions"]).functions
        pool = dict(record["arguments"]["pool"])
        first = next((name for name in ("steps", *MACHINE_NAMES) if name in pool), "machine")
        own = _read(pool[first], functions, None)
        machine = _machine_of({first: own})
        if not isinstance(machine, MACHINES):
            raise TypeError(f"the machine is of type {type(machine).__name__}")
        positions = _read(pool.get("held", {"pool": []}), [], None)
        held = {str(name): float(position) for name, position in positions.items()}
        owner = hold_joints(machine, held) if held else machine
        others = {name: _read(value, functions, (machine, owner)) for name, value in pool.items() if name != first}
        arguments = {first: own, **others}
        if record["builder"] not in BUILDERS and record["builder"] != "":
            raise ValueError(f"builder {record['builder']!r} is not known")
        return MotionRequest(record["builder"], arguments)
    except (*RECORD_ERRORS, ProblemError) as error:
        raise ProblemError(f"the stored request is damaged: {error}", name="request") from error


def _read(value: Any, functions: list[Any], machines: tuple[Machine, Machine] | None) -> Any:
    """Rebuild an argument of a request from its record; `machines` are the machine without and with locked joints."""

    def read(part: Any) -> Any:
        return _read(part, functions, machines)

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
    fields = {name: read(part) for name, part in value["fields"].items()}
    if value["kind"] == "CollisionScene" and machines is not None:
        whole, own = machines
        options = {name: fields[name] for name in ("obstacles", "clearance", "ignored", "limits")}
        scene = CollisionScene(whole, **options, covered=_mesh_covers(fields["covered"]))
        return scene if own is whole else scene.with_locked(own)
    if fields.get("file") is not None and value["kind"] == "Mesh":
        raise ValueError("a mesh names a file, which is not read")
    return KINDS[value["kind"]](**fields)


def _of_time(function: Any) -> Any:
    if function.n_in() != 1 or function.size_in(0) != (1, 1) or function.n_out() != 1:
        raise ValueError("a track is not a function of one number")
    return function


def _mesh_covers(written: Mapping[str, Any]) -> dict[tuple[str, int], tuple[Body, ...]]:
    """Return the bodies that enclose each mesh, by link and index of the mesh among the link's collision shapes."""
    bodies = {}
    for place, (points, shapes) in written.items():
        link, _, number = place.rpartition("/")
        mesh = LinkMesh(np.asarray(points, dtype=float).reshape(-1, 3), int(number))
        bodies[link, int(number)] = tuple(Body(link, shape, overhang, mesh) for shape, overhang in shapes)
    return bodies
