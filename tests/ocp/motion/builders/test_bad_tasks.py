"""Whatever is wrong with a task, a start, limits or laws is refused by name, by builders and local laws alike."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    FixedBase,
    Foot,
    Foothold,
    FreeFloating,
    Link,
    Standing,
    planar_chain,
    rectangle,
    reference_rig,
    reference_tunnel,
)
from ocp import (
    AccelerationOptions,
    Collocation,
    Cone,
    Cost,
    DynamicsSetup,
    FreeTime,
    Goal,
    Grasp,
    IkOptions,
    IndexAtLeast,
    Indirect,
    InFoot,
    JointFriction,
    Layer,
    Limits,
    Pinned,
    Problem,
    RateOptions,
    Stabiliser,
    StancePhase,
    Start,
    Steps,
    StepWeights,
    TipTask,
    VelocitySetup,
    Weights,
    capture_problem,
    chained_capture,
    dynamics_phases,
    dynamics_problem,
    inverse_kinematics,
    joint_torques,
    minimum_velocity_problem,
    resolve,
    resolve_accelerations,
    resolve_steps,
    roll_problem,
    solve,
    spline_targets,
    standing_configuration,
    standing_problem,
    steps_motion,
    steps_problem,
    walk,
)
from ocp.motion.builders.dynamics_plan import SolveSettings
from ocp.motion.builders.space.capture import solve_capture
from ocp.motion.builders.standing.plan import solve_standing, solve_steps
from ocp.motion.tasks.goals import TERMS
from ocp.motion.tasks.tracks import path_tracks, pose_line
from tests.bad_values import (
    CALLABLE,
    CHOICE,
    COUNT,
    FINITE,
    FLAG,
    INF,
    INSTANCE,
    LIMIT,
    MAPPING,
    NAN,
    NONNEGATIVE,
    NOTHING,
    POSITIVE,
    SEQUENCE,
    STRANGE,
    TEXT,
    UNKNOWN,
    WHOLE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    panel,
)
from tests.ocp.motion.builders.captures import called, planar_capture
from tests.ocp.motion.builders.standing_tasks import with_setup
from tests.ocp.motion.builders.test_cts import roll_arguments

START = [0.3, 0.6, 0.9]
CHAIN = planar_chain([1.0, 0.8, 0.6], [1.0] * 3, base=Link("foot", 30.0, inertia=np.eye(3)))
ARM = FixedBase(CHAIN)
UPRIGHT = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]
STANDING = Standing(CHAIN, rotation=UPRIGHT, support=rectangle((-0.3, 0.3), (-0.3, 0.3)))
FLOATING = FreeFloating(
    planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0], base=Link("hub", 9.0, (0, 0, 0), np.eye(3))), "planar"
)
CAPTURE = planar_capture() | {"approach": 5.0, "detumble": 5.0}
UP = [1.4, 0.3, 0.3]
REACHED = np.array(ca.DM(ARM.tip_pose((), START).position)).ravel()
FORWARD = TipTask(velocity=[0.1, 0.0], rows=(3, 4))
HELD = TipTask(position=REACHED, rows=(3, 4))
STILL = TipTask(velocity=[0.0, 0.0], rows=(4, 5))
TRACK: Bad = STRANGE | {
    "short": [1.0],
    "nan": [NAN, 0.0],
    "symbol": ca.SX.sym("strange", 2),
    "texts": ["1", "2"],
    "truths": [True, False],
    "function of a word": lambda t: "a",
    "function of one": lambda t: [t],
    "function of nothing": lambda: [0, 0],
    "function of nan": lambda t: [NAN, 0],
    "function that fails": lambda t: 1 / 0,
    "function of none": lambda t: None,
}
PLACE: Bad = TRACK | {"inf": [INF, 0.0, 0.0]}
ROWS: Bad = but(SEQUENCE, "numbers") | {
    "empty": [],
    "twice": [3, 3],
    "high": [6],
    "half": [3.5, 4],
    "digits": ["3", "4"],
    "truths": [True, False],
}
BASE: Bad = array(7)
RATES: Bad = array(3) | {"zero": [0.0, 1.0, 1.0], "negative": [-1.0, 1.0, 1.0]}
SYMBOLS = INSTANCE
HORIZON: Bad = POSITIVE | NOTHING
TASK: Bad = INSTANCE | {
    "none in it": [None],
    "empty": (),
    "unknown link": TipTask(velocity=[0.0], rows=(3,), link="nobody"),
}
REQUEST_VALUES: dict[str, Bad] = {
    "machine": INSTANCE | {"a robot": CHAIN},
    "start": array(3) | NOTHING,
    "horizon": HORIZON,
    "weights": RATES,
    "start_base": but(BASE, "empty"),
}
ARGUMENTS = {"machine": ARM, "tasks": FORWARD, "start": START, "horizon": 1.0}


def with_setup_of(kind: Any, argument: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of a builder, those that are fields of the dataclass `kind` collected in one argument."""
    own = {field.name: options[field.name] for field in fields(kind) if field.name in options}
    rest = {name: value for name, value in options.items() if name not in own}
    return {argument: kind(**own)} | rest


def with_start(options: dict[str, Any]) -> dict[str, Any]:
    """Return arguments in which the base and the velocities at the start are part of the start."""
    names = {"start_base": "base", "start_velocities": "velocity"}
    own = {names[name]: value for name, value in options.items() if name in names}
    rest = {name: value for name, value in options.items() if name not in names}
    return {**rest, "start": Start(rest["start"], **own)} if own else rest


BUILT = {"machine": ARM, "tasks": FORWARD, "start": START, "horizon": 1.0}
STOOD = {"machine": STANDING, "tasks": STILL, "start": UP, "horizon": 0.2}
EACH: Bad = LIMIT | {"one of them zero": [1.0, 0.0, 1.0], "table of words": [["a"]]}

TASKS = [
    Case(
        "TipTask",
        TipTask,
        {"velocity": [0.1, 0.0], "rows": (3, 4)},
        {
            "rows": ROWS | NOTHING,
            "position": {"both": REACHED},
            "axes": CHOICE,
            "link": but(UNKNOWN, "None", "unknown"),
            "relative_to": but(UNKNOWN, "None", "unknown"),
            "gain": NONNEGATIVE | NOTHING,
            "start_gap": NONNEGATIVE | NOTHING,
            "tool_axis": array(3) | {"zero": (0, 0, 0)},
            "point": array(3) | {"without a link": (1, 0, 0)},
            "velocity": NOTHING,
        },
    ),
    Case("along", path_tracks, {"path": None, "speed": 0.1}, {"path": INSTANCE, "speed": POSITIVE}),
    Case(
        "pose_line",
        pose_line,
        {"first": (np.eye(3), REACHED), "second": (np.eye(3), REACHED + 1), "duration": 1.0},
        {
            "first": INSTANCE
            | {
                "no turn": (np.zeros((3, 3)), REACHED),
                "one": (np.eye(3),),
                "nan": (np.eye(3), [NAN, 0, 0]),
                "inf": (np.eye(3), [INF, 0, 0]),
                "texts": (np.eye(3), ["1", "2", "3"]),
            },
            "second": {"half a turn": (np.diag([-1, -1, 1]), REACHED)},
            "duration": HORIZON,
            "pace": CHOICE,
        },
    ),
    Case(
        "Limits",
        Limits,
        {},
        {
            "velocity": EACH,
            "acceleration": EACH,
            "jerk": EACH,
            "torque": EACH,
            "power": EACH,
            "joints": FLAG,
            "vertical_force": POSITIVE,
            "friction": LIMIT | NOTHING,
        },
    ),
    Case(
        "Weights",
        Weights,
        {},
        dict.fromkeys(
            ("acceleration", "velocity", "joint_limits", "manipulability", "jerk", "time"), NONNEGATIVE | NOTHING
        ),
    ),
    Case(
        "FreeTime",
        FreeTime,
        {"lower": 0.5, "upper": 2.0, "guess": 1.0},
        {
            "lower": POSITIVE | NOTHING | {"above": 1.5},
            "upper": POSITIVE | NOTHING | {"below": 0.7},
            "guess": POSITIVE | NOTHING,
        },
    ),
    Case("InFoot", InFoot, {}, {"margin": NONNEGATIVE | NOTHING}),
    Case("IndexAtLeast", IndexAtLeast, {"value": 0.5}, {"value": FINITE | NOTHING | {"one": 1.0}}),
    Case(
        "Layer",
        Layer,
        {"index": "joint_limits", "demand": -1.0},
        {"index": CHOICE, "demand": FINITE | NOTHING, "form": CHOICE},
    ),
    Case(
        "Stabiliser",
        Stabiliser,
        {},
        {
            "poles": array(3) | NOTHING | {"zero": (0, 1, 1)},
            "damping": NONNEGATIVE | NOTHING,
            "gradient": NONNEGATIVE | NOTHING,
        },
    ),
]

VELOCITIES = [
    Case(
        "inverse_kinematics",
        lambda **options: inverse_kinematics(**with_setup_of(IkOptions, "options", options)),
        {"machine": ARM, "task": HELD, "starts": 4, "near": START},
        {
            "machine": REQUEST_VALUES["machine"],
            "task": TASK | {"velocity": FORWARD},
            "time": FINITE | NOTHING,
            "base": but(BASE, "empty"),
            "starts": WHOLE | NOTHING,
            "near": array(3),
            "seed": WHOLE | NOTHING,
            "limits": FLAG,
            "tolerance": POSITIVE | NOTHING,
            "apart": POSITIVE | NOTHING,
            "iterations": COUNT | NOTHING,
        },
    ),
    Case(
        "resolve",
        lambda **options: resolve(**with_start(with_setup_of(RateOptions, "options", options))),
        {**ARGUMENTS, "samples": 5},
        {
            **REQUEST_VALUES,
            "tasks": TASK,
            "damping": NONNEGATIVE | NOTHING,
            "tolerance": POSITIVE | NOTHING,
            "samples": COUNT
            | NOTHING
            | {"falling": [0, 0.5, 0.4, 1.0], "one": [0.0], "texts": ["0", "1"], "nan": [0, NAN, 1]},
        },
    ),
    Case(
        "resolve by rows",
        resolve,
        {
            "machine": ARM,
            "tasks": TipTask(rows=(3, 4), velocity=[0.1, 0.0]),
            "start": START,
            "horizon": 1.0,
            "samples": 5,
        },
        {"tasks": TASK, "start": array(3), "horizon": HORIZON},
    ),
    Case(
        "resolve a pose",
        lambda position: resolve(ARM, TipTask(position=position, rows=(3, 4)), 1.0, start=START, samples=3),
        {"position": REACHED},
        {"position": PLACE | {"elsewhere": [9.0, 9.0]}},
    ),
    Case(
        "minimum_velocity_problem",
        lambda **options: minimum_velocity_problem(**with_setup_of(VelocitySetup, "setup", options)),
        BUILT,
        {
            **REQUEST_VALUES,
            "tasks": TASK,
            "cyclic": FLAG,
            "limits": but(INSTANCE, "None"),
            "setup": but(INSTANCE, "None"),
            "guess_damping": POSITIVE | NOTHING,
            "clearance_constraints": but(INSTANCE, "None"),
        },
    ),
]

STANDINGS = [
    Case(
        "resolve_accelerations",
        lambda **options: resolve_accelerations(**with_start(with_setup_of(AccelerationOptions, "options", options))),
        {**STOOD, "step": 0.05},
        {
            "machine": REQUEST_VALUES["machine"] | {"bolted": ARM},
            "tasks": TASK,
            "start": array(3) | NOTHING,
            "horizon": HORIZON,
            "law": CHOICE,
            "start_velocities": array(3),
            "wrenches": CALLABLE,
            "layers": SEQUENCE,
            "stabiliser": but(INSTANCE, "None"),
            "null_damping": NONNEGATIVE | NOTHING,
            "step": POSITIVE | NOTHING,
            "stop_at_lift_off": FLAG,
            "speed_limit": POSITIVE | NOTHING,
        },
    ),
    Case(
        "standing_problem",
        lambda **options: standing_problem(**with_setup(options)),
        {"machine": STANDING, "tasks": STILL, "start": UP, "horizon": 0.2},
        {
            "machine": REQUEST_VALUES["machine"] | {"bolted": ARM},
            "tasks": TASK,
            "start": array(3) | NOTHING,
            "horizon": HORIZON,
            "zmp": but(INSTANCE, "None")
            | {
                "wide": InFoot(9.0),
                "far": Pinned((9.0, 9.0)),
                "of words": Pinned("a"),
                "no pair": Pinned(3),
                "function of one": Pinned(lambda t: [t]),
                "function of nan": Pinned(lambda t: [NAN, 0]),
            },
            "wrenches": CALLABLE,
            "weights": but(INSTANCE, "None"),
            "limits": but(INSTANCE, "None") | {"of two": Limits(velocity=[1.0, 2.0])},
            "control": CHOICE,
            "along": CHOICE,
            "tip_level": CHOICE,
            "start_velocity": CHOICE,
            "end_velocity": CHOICE,
            "end": but(array(3), "nan"),
            "symbols": SYMBOLS,
        },
    ),
    Case(
        "solve_standing",
        lambda **options: solve_standing(**with_setup_of(SolveSettings, "settings", options)),
        {"machine": STANDING, "tasks": STILL, "start": UP, "horizon": 0.2},
        {
            "machine": REQUEST_VALUES["machine"] | {"bolted": ARM},
            "tasks": TASK,
            "setup": but(INSTANCE, "None"),
            "settings": but(INSTANCE, "None"),
            "start": array(3) | NOTHING,
            "horizon": HORIZON,
            "method": but(INSTANCE, "None") | {"indirect": Indirect()},
            "options": MAPPING,
            "tolerances": MAPPING | {"unknown": {"nothing": 1.0}},
        },
    ),
]

RIG, TUNNEL = reference_rig(), reference_tunnel()


def falling(time: Any) -> list[Any]:
    return [2.54, 0.1524, -0.381 + 0.0762 * time, 0.0, 0.0]


ROLLS = [
    Case(
        "spline_targets",
        spline_targets,
        {"times": [0.0, 1.0, 2.0, 3.0], "targets": np.ones((4, 5))},
        {"times": array(4) | NOTHING | {"falling": [0.0, 2.0, 1.0, 3.0]}, "targets": array(4, 5) | NOTHING},
    ),
    Case(
        "roll_problem",
        lambda **options: roll_problem(**roll_arguments(options)),
        {"rig": RIG, "tunnel": TUNNEL, "targets": falling, "horizon": 10.0},
        {
            "rig": INSTANCE,
            "tunnel": INSTANCE,
            "targets": TRACK | NOTHING | {"unreachable": lambda t: [9.0, 9, 9, 0, 0]},
            "horizon": HORIZON,
            "branch": INSTANCE,
            "rate_weight": NONNEGATIVE | NOTHING,
            "acceleration_weight": NONNEGATIVE | NOTHING,
            "rate_limit": but(LIMIT, "zero") | NOTHING,
            "acceleration_limit": but(LIMIT, "zero") | NOTHING,
            "start_roll": FINITE,
            "start_rate": FINITE,
            "avoidance": but(INSTANCE, "None"),
            "symbols": SYMBOLS,
        },
    ),
]
MOVED: dict[str, Any] = {"machine": ARM, "tasks": (), "start": [0.1, 0.2, 0.3], "horizon": 1.0}


def moved(**options: Any) -> Problem:
    """`dynamics_problem` with the fields of its setup beside its arguments."""
    names = {field.name for field in fields(DynamicsSetup)}
    own = {name: options.pop(name) for name in names & options.keys()}
    return dynamics_problem(**({"setup": DynamicsSetup(**own)} | options))


FRICTION = {"negative": -1.0, "nan": NAN, "inf": INF, "text": "much", "empty": []}
DYNAMICS = [
    Case("JointFriction", JointFriction, {}, {"viscous": FRICTION, "coulomb": FRICTION, "slip": POSITIVE}),
    Case("Cost", Cost, {"time": 1.0}, {**dict.fromkeys(TERMS, NONNEGATIVE), "effort": FRICTION}),
    Case(
        "dynamics_problem",
        moved,
        {**MOVED, "end": [0.3, 0.2, 0.1]},
        {
            "machine": INSTANCE | {"standing": STANDING},
            "start": but(array(3), "nan"),
            "horizon": HORIZON,
            "setup": but(INSTANCE, "None"),
            "end": but(array(3), "nan"),
            "limits": but(INSTANCE, "None") | {"of two": Limits(torque=[1.0, 2.0]), "jerk": Limits(jerk=1.0)},
            "cost": but(INSTANCE, "None")
            | {"of two": Cost(velocity=0.0, effort=[1.0, 2.0]), "jerk": Cost(velocity=0.0, effort=1.0, jerk=1.0)},
            "friction": but(INSTANCE, "None") | {"of two": JointFriction([1.0, 2.0])},
            "control": CHOICE,
            "start_velocity": CHOICE,
            "end_velocity": CHOICE,
            "clearance_constraints": but(INSTANCE, "None"),
            "symbols": SYMBOLS,
        },
    ),
    Case(
        "dynamics_problem of a floating machine",
        moved,
        {**MOVED, "machine": FLOATING},
        dict.fromkeys(("start_velocity", "end_velocity", "end_base"), but(array(3), "nan")),
    ),
    Case(
        "dynamics_phases",
        dynamics_phases,
        {"machine": ARM, "start": [0.1, 0.2, 0.3], "goals": [Goal(joints=[0.3, 0.2, 0.1], duration=1.0)]},
        {
            "machine": INSTANCE | {"standing": STANDING},
            "goals": SEQUENCE | {"empty": [], "duration": [Goal(joints=[0.3, 0.2, 0.1], duration=-1.0)]},
            "total": but(HORIZON, "None"),
            "setup": but(INSTANCE, "None"),
        },
    ),
    Case(
        "Goal of dynamics_phases",
        lambda **goal: dynamics_phases(ARM, [Goal(**goal)], start=[0.1, 0.2, 0.3]),
        {"joints": [0.3, 0.2, 0.1], "duration": 1.0},
        {
            "joints": but(array(3), "nan"),
            "duration": POSITIVE,
            "velocity": CHOICE,
            "machine": but(INSTANCE, "None"),
            "tasks": but(INSTANCE, "list", "dictionary"),
            "name": TEXT | {"with a dot": "leg.1"},
        },
    ),
    Case(
        "Cone",
        Cone,
        {"direction": (-1.0, 0.0, 0.0), "half_angle": 0.4, "length": 0.3},
        {
            "direction": array(3) | {"zero": np.zeros(3)},
            "half_angle": POSITIVE | {"right": np.pi / 2},
            "length": POSITIVE,
            "depth": POSITIVE,
        },
    ),
    Case("Grasp", Grasp, {}, {"force": but(POSITIVE, "inf"), "moment": but(POSITIVE, "inf")}),
    Case(
        "capture_problem",
        partial(called, capture_problem),
        CAPTURE,
        {"chaser": INSTANCE | {"fixed": ARM}, "start": array(4)},
    ),
    Case(
        "Capture",
        partial(called, capture_problem),
        CAPTURE,
        {
            "target": INSTANCE | {"with joints": FLOATING},
            "approach": HORIZON,
            "detumble": HORIZON,
            "target_base": but(array(3), "None"),
            "cone": but(INSTANCE, "None"),
            "grasp": but(INSTANCE, "None"),
            "friction": but(INSTANCE, "None"),
            "end": but(array(4), "nan"),
            "rest": FLAG,
        },
    ),
    *(
        Case(
            name,
            partial(called, function),
            CAPTURE | {"method": Collocation(5, 4, scheme="legendre")},
            {"chaser": INSTANCE, "detumble": HORIZON, "method": but(INSTANCE, "None")},
        )
        for name, function in (("solve_capture", solve_capture), ("chained_capture", chained_capture))
    ),
    Case(
        "joint_torques",
        lambda machine: joint_torques(machine, ((), ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.sym("a", 3))),
        {"machine": ARM},
        {"machine": INSTANCE | {"standing": STANDING}},
    ),
]
FEET = {"base": Foot("base", rectangle((-1.0, 1.0), (-1.0, 1.0)))}
HERE = {"base": Foothold((0.0, 0.0, 0.0))}
ARM_ON_FOOT = planar_chain([0.4, 0.4, 0.3], [2.0, 1.5, 1.0])
STEPPING = Steps(ARM_ON_FOOT, FEET, [StancePhase(HERE, 1.0)])
STEPPED: dict[str, Any] = {"steps": STEPPING, "start": [0.3, 0.4, 0.5]}
STEP_OPTIONS: dict[str, Bad] = {
    "steps": INSTANCE,
    "start": array(3) | NOTHING,
    "cost": but(INSTANCE, "None"),
    "limits": but(INSTANCE, "None") | {"jerk": Limits(jerk=1.0), "of two": Limits(velocity=[1.0, 2.0])},
}
STEPS = [
    Case(
        "StepWeights",
        StepWeights,
        {},
        dict.fromkeys(("acceleration", "velocity", "torque", "joint_limits", "load", "time"), NONNEGATIVE | NOTHING),
    ),
    Case(
        "StancePhase",
        StancePhase,
        {"footholds": HERE, "duration": 1.0},
        {"footholds": MAPPING | NOTHING | {"none": {}, "of words": {"base": "here"}}, "duration": HORIZON},
    ),
    Case(
        "Steps",
        Steps,
        {"robot": ARM_ON_FOOT, "feet": FEET, "phases": [StancePhase(HERE, 1.0)]},
        {
            "robot": INSTANCE,
            "feet": MAPPING | NOTHING | {"none": {}, "of words": {"base": "base"}, "lost": {"base": Foot("nobody")}},
            "phases": SEQUENCE | NOTHING | {"none": []},
            "gravity": POSITIVE | NOTHING,
            "balance": CHOICE,
            "margin": NONNEGATIVE | NOTHING,
            "clearance": NONNEGATIVE | NOTHING,
        },
    ),
    Case(
        "walk",
        walk,
        {"footholds": {**HERE, "hand": HERE["base"]}, "steps": [("hand", HERE["base"])], "shift": 1.0, "swing": 1.0},
        {
            "footholds": MAPPING | {"none": {}, "of words": {"base": "here"}},
            "steps": SEQUENCE | NOTHING | {"unknown": [("foot", HERE["base"])], "of words": [("base", "here")]},
            "shift": HORIZON,
            "swing": HORIZON,
        },
    ),
    Case("steps_problem", steps_problem, STEPPED, STEP_OPTIONS),
    Case(
        "solve_steps",
        lambda **options: solve_steps(**with_setup_of(SolveSettings, "settings", options)),
        STEPPED,
        {
            **STEP_OPTIONS,
            "settings": but(INSTANCE, "None"),
            "method": but(INSTANCE, "None") | {"indirect": Indirect()},
            "options": MAPPING,
            "tolerances": MAPPING | {"unknown": {"nothing": 1.0}},
        },
    ),
    Case(
        "standing_configuration",
        standing_configuration,
        {"stance": STEPPING.stances[0], "near": [0.3, 0.4, 0.5]},
        {"stance": INSTANCE, "near": array(3) | NOTHING, "over": array(2)},
    ),
    Case(
        "resolve_steps",
        resolve_steps,
        {"steps": STEPPING, "start": STEPPED["start"], "samples": 5},
        {"steps": INSTANCE, "start": array(3) | NOTHING, "samples": COUNT | NOTHING | {"one": 1}},
    ),
    Case(
        "steps_motion",
        steps_motion,
        {"steps": STEPPING, "solution": solve(steps_problem(**STEPPED), Collocation(2)), "samples": 5},
        {"steps": INSTANCE, "solution": INSTANCE, "samples": COUNT | NOTHING | {"one": 1}},
    ),
]
CASES = [*TASKS, *VELOCITIES, *STANDINGS, *ROLLS, *DYNAMICS, *STEPS]
LONG = ("along", "solve_standing", "solve_steps")


@pytest.mark.parametrize("case", good_calls(case for case in CASES if case.what not in LONG))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
