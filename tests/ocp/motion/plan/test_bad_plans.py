"""What cannot be planned is refused by name: bad values, tasks that do not fit, and where a path leaves the reach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    CollisionScene,
    FixedBase,
    FreeFloating,
    Path,
    SmoothPath,
    Sphere,
    example_robot,
    planar_chain,
    smooth,
)
from ocp import (
    ClearanceConstraints,
    Cost,
    Goal,
    IkSolver,
    Limits,
    ProblemError,
    Scene,
    SolveError,
    Start,
    TipTask,
    Unreachable,
    Waypoints,
    ik_configurations,
    inverse_kinematics,
    plan_problem,
)
from ocp.app.files import log_rerun, write_mcap, write_robot_program
from ocp.motion.builders.standing.problem import Weights
from ocp.motion.plan import Plan, plan
from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.tasks.tracks import path_tracks
from tests.bad_values import (
    CHOICE,
    COUNT,
    FINITE,
    FLAG,
    INSTANCE,
    MAPPING,
    NAN,
    NONNEGATIVE,
    NOTHING,
    NUMBER,
    POSITIVE,
    SEQUENCE,
    TEXT,
    UNKNOWN,
    WHOLE,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
    rotation,
)
from tests.models.machines.armoured import armoured_arm
from tests.models.robot.trees import Array, numeric
from tests.ocp.app.files.recorder import recorder
from tests.ocp.motion.plan.motions import DOWN, angled_ur5
from tests.ocp.motion.tasks.space_tasks import panda, ur5

CHAIN = planar_chain([1.0, 0.8, 0.6], [1.0] * 3)
ARM = FixedBase(CHAIN)
START = [0.3, 0.6, 0.9]
REACHED = numeric(ARM.tip_pose((), START).position).ravel()
LINE = smooth(Path.through([REACHED, REACHED + np.array([0.1, -0.2, 0.0])]), deviation=0.01)
GOOD = TipTask.along(LINE, 0.2, steady=True, rows=(3, 4))
assert GOOD.duration is not None
PLANNED: dict[str, Any] = {"machine": ARM, "tasks": GOOD, "start": START, "search": "start"}
AROUND = CollisionScene(FixedBase(armoured_arm()))
SIX = FixedBase(example_robot("six_axis"))
POSES = ([[0.4, 0.0, 0.5], [0.4, 0.02, 0.5], [0.4, 0.04, 0.5]], [[0.0, 1.0, 0.0, 0.0]] * 3)
ENDLESS = replace(GOOD, duration=None, breaks=())


@cache
def valid_plan() -> Plan:
    return plan(**PLANNED)


def logged(**options: Any) -> None:
    with TemporaryDirectory() as folder:
        write_mcap(**{"plan": valid_plan(), "file": f"{folder}/a.mcap", **options})


def programmed(**options: Any) -> None:
    with TemporaryDirectory() as folder:
        write_robot_program(**{"motion": valid_plan(), "file": f"{folder}/a.mod", **options})


PLANE = TipTask(rows=(3, 4), velocity=(0.0, 0.0))
SCENE = {
    "obstacles": SEQUENCE | {"array": np.ones(3)},
    "clearance": NONNEGATIVE | NOTHING,
    "ignored": SEQUENCE | {"unknown": [("link_1", "nobody")]},
    "srdf": {"number": 3, "list": ["a"], "object": object(), "nowhere": "/nowhere/at/all.srdf"},
    "folders": {"number": 3, "numbers": [1, 2], "object": object()},
    "missing": CHOICE,
}
TASKS_AND_TIMES = {
    "machine": INSTANCE | {"class": FixedBase, "robot": CHAIN},
    "tasks": INSTANCE | SEQUENCE | {"class": TipTask, "function": lambda t: t},
    "start": array(3) | {"matrix": np.zeros((2, 3)), "elsewhere": [0.0, 0.0, 0.0]},
    "limits": but(INSTANCE, "None")
    | {"class": Limits, "torque of two": Limits(torque=[1.0, 2.0]), "too many": Limits(velocity=[1.0, 2.0])},
    "cost": but(INSTANCE, "None")
    | {
        "class": Cost,
        "of two": Cost(weights=[1.0, 2.0]),
        "time of a fixed horizon": Cost(time=1.0),
        "of a standing machine": Weights(),
    },
    "scene": but(INSTANCE, "None") | {"class": Scene, "true": True, "zero": 0, "collisions": AROUND},
    "seed": WHOLE,
}
CASES = [
    Case(
        "plan",
        plan,
        PLANNED,
        {
            **TASKS_AND_TIMES,
            "horizon": but(POSITIVE, "word") | {"word": "a", "free in words": "Free", "too short": 0.1},
            "cyclic": FLAG | {"though it ends elsewhere": True},
            "search": CHOICE,
        },
    ),
    Case(
        "plan in segments",
        partial(plan, search="segments"),
        {"machine": ARM, "tasks": GOOD, "start": START, "scene": False},
        {
            **TASKS_AND_TIMES,
            "horizon": but(POSITIVE, "word") | {"word": "a", "free": "free", "too short": 0.1},
            "cyclic": {"true": True},
        },
    ),
    Case(
        "plan through waypoints",
        plan,
        {"machine": panda(), "tasks": Waypoints(*POSES), "scene": False},
        {
            "machine": INSTANCE | {"class": FixedBase, "robot": CHAIN, "floating": FreeFloating(CHAIN)},
            "horizon": {"number": 1.0, "free": "free"},
            "start": {"joints": [0.0] * 7, "start": Start()},
            "cyclic": {"true": True},
            "cost": but(INSTANCE, "None")
            | {
                "class": Cost,
                "velocity": Cost(),
                "both": Cost(velocity=0, length=1, time=1),
                "weighted time": Cost(velocity=0, time=1, weights=[1.0] * 7),
            },
            "limits": but(INSTANCE, "None") | {"class": Limits, "velocity": Limits(velocity=1.0)},
            "scene": but(INSTANCE, "None") | {"class": Scene, "true": True, "zero": 0},
            "search": CHOICE,
            "seed": WHOLE,
        },
    ),
    Case(
        "Waypoints",
        lambda **waypoints: plan(panda(), Waypoints(**waypoints), scene=False),
        {"positions": POSES[0], "quaternions": POSES[1]},
        {
            "positions": array(3, 3) | {"one": POSES[0][:1], "fewer": POSES[0][:2]},
            "quaternions": array(3, 4) | {"zero": np.zeros((3, 4)), "fewer": POSES[1][:2]},
            "reconfigurations": CHOICE,
            "step": but(array(7), "inf") | {"zero": 0.0, "negative": -1.0, "one zero": [1.0] * 6 + [0.0]},
        },
    ),
    Case("Scene", lambda **scene: plan(**PLANNED, scene=Scene(**scene)), {}, SCENE),
    Case("Scene of waypoints", lambda **scene: plan(panda(), Waypoints(*POSES), scene=Scene(**scene)), {}, SCENE),
    Case(
        "Start",
        lambda **start: plan(ARM, GOOD, start=Start(**start), search="start"),
        {"joints": START},
        {
            "joints": array(3) | {"matrix": np.zeros((2, 3)), "elsewhere": [0.0, 0.0, 0.0]},
            "base": but(array(7), "empty") | {"of a floating base": [0, 0, 0, 1, 0, 0, 0]},
        },
    ),
    Case(
        "Start of a floating base",
        lambda **start: plan(FreeFloating(CHAIN, "planar"), PLANE, 1.0, start=Start(**start), search="start"),
        {"joints": START, "base": [0.0, 0.0, 0.0]},
        {"joints": array(3), "base": array(3) | {"spatial": [0, 0, 0, 1, 0, 0, 0]}},
    ),
    Case(
        "Cost of tip tasks",
        lambda **cost: plan(**PLANNED, cost=Cost(**cost)),
        {"weights": [1.0, 2.0, 1.0]},
        {"velocity": POSITIVE, "weights": array(3) | {"zero": [1.0, 0.0, 1.0], "negative": [1.0, -1.0, 1.0]}},
    ),
    Case(
        "Cost of a free horizon",
        lambda **cost: plan(**PLANNED, horizon="free", cost=Cost(**cost)),
        {"time": 1.0},
        {"time": POSITIVE},
    ),
    Case(
        "Cost of waypoints",
        lambda **cost: plan(panda(), Waypoints(*POSES), scene=False, cost=Cost(velocity=0, **cost)),
        {"length": 1.0},
        {"length": POSITIVE, "weights": array(7) | {"zero": np.zeros(7), "negative": [1.0] * 6 + [-1.0]}},
    ),
    Case(
        "Goal",
        Goal,
        {"position": [0.4, 0.0, 0.5], "direction": [0.0, 0.0, -1.0]},
        {
            "joints": {"beside a pose": [0.0, 0.0]},
            "orientation": {"beside a direction": [1.0, 0.0, 0.0, 0.0]},
            "within": but(POSITIVE, "None") | {"half a turn": np.pi},
            "tool_axis": array(3) | {"zero": [0.0, 0.0, 0.0]},
            "region": but(INSTANCE, "None") | {"beside a position": Sphere(0.1, (0.4, 0.0, 0.5))},
            "velocity": {"unknown": "slow", "empty": ""},
            "name": TEXT,
        },
    ),
    Case(
        "Goal of plan",
        lambda **goal: plan(ARM, Goal(**goal), start=START, scene=False),
        {"position": REACHED + np.array([0.1, -0.1, 0.0]), "orientation": None, "duration": 1.0},
        {
            "position": array(3) | {"too far": [3.0, 0.0, 0.0]},
            "orientation": rotation() | {"quaternion of zero": np.zeros(4)},
            "duration": POSITIVE,
            "tip": but(UNKNOWN, "None"),
            "tasks": but(INSTANCE, "list", "dictionary"),
        },
    ),
    Case(
        "plan to a goal",
        plan,
        {"machine": ARM, "tasks": Goal(joints=[0.4, 0.5, 0.8], duration=1.0), "start": START, "scene": False},
        {
            "machine": INSTANCE | {"class": FixedBase, "robot": CHAIN},
            "horizon": {"negative": -1.0, "text": "soon"},
            "start": array(3) | {"matrix": np.zeros((2, 3))},
            "cyclic": {"true": True},
            "cost": but(INSTANCE, "None") | {"class": Cost, "length and time": Cost(velocity=0, length=1, time=1)},
            "limits": but(INSTANCE, "None") | {"class": Limits, "too many": Limits(velocity=[1.0, 2.0])},
            "scene": but(INSTANCE, "None") | {"class": Scene, "true": True, "zero": 0},
            "search": CHOICE,
            "seed": WHOLE,
        },
    ),
    Case(
        "ClearanceConstraints",
        ClearanceConstraints,
        {"scene": AROUND, "margins": {0: 0.01}},
        {"scene": INSTANCE, "margins": MAPPING | {"unknown": {99: 0.01}, "nan": {0: NAN}, "word": {"a": 0.1}}},
    ),
    Case(
        "plan_problem",
        plan_problem,
        {"machine": ARM, "tasks": Goal(joints=[0.4, 0.5, 0.8]), "horizon": 1.0, "start": START, "scene": False},
        {
            "machine": INSTANCE,
            "tasks": {
                "a pose": Goal(position=(0.5, 0.2, 0.6)),
                "waypoints": Waypoints(np.zeros((2, 3)), np.ones((2, 4))),
            },
            "horizon": {"negative": -1.0, "text": "soon"},
            "start": array(3),
            "limits": but(INSTANCE, "None"),
            "scene": but(INSTANCE, "None"),
        },
    ),
    Case(
        "ik_configurations",
        ik_configurations,
        {"machine": SIX, "task": TipTask(position=(0.4, 0.1, 0.3), direction=(0, 0, -1)), "time": 0.0, "limits": True},
        {"task": INSTANCE, "time": NUMBER, "samples": COUNT, "limits": FLAG},
    ),
    Case("IkSolver", IkSolver, {"machine": SIX}, {"machine": INSTANCE, "samples": COUNT, "limits": FLAG}),
    Case(
        "inverse_kinematics around",
        inverse_kinematics,
        {"machine": AROUND.machine, "task": TipTask(position=(0.5, 0.2, 0.6)), "scene": AROUND},
        {"scene": but(INSTANCE, "None") | {"another's": CollisionScene(FixedBase(armoured_arm()))}},
    ),
    Case(
        "TipTask.along",
        TipTask.along,
        {"path": LINE, "speed": 0.2, "direction": (1.0, 0.0, 0.0), "within": 0.2, "rows": (3, 4)},
        {
            "path": INSTANCE | {"class": SmoothPath, "not smooth": LINE.path, "points": [[0, 0, 0], [1, 0, 0]]},
            "speed": POSITIVE,
            "roll": CHOICE,
            "tool_axis": array(3) | {"zero": [0.0, 0.0, 0.0]},
            "within": but(POSITIVE, "None") | {"half a turn": np.pi, "200 degrees": np.radians(200.0)},
            "begin": NONNEGATIVE,
            "duration": POSITIVE,
            "breaks": {"after the end": [99.0], "negative": [-1.0], "nan": [NAN], "word": "a", "matrix": [[0.1, 0.2]]},
        },
    ),
    Case("along", path_tracks, {"path": LINE, "speed": 0.2}, {"path": INSTANCE, "speed": POSITIVE}),
    method(
        valid_plan,
        "at",
        {"time": 0.1},
        time=but(FINITE, "empty") | {"before": -1.0, "after": 99.0, "some after": [0.1, 99.0]},
    ),
    Case("write_mcap", logged, {"period": 0.1}, {"plan": INSTANCE, "period": POSITIVE, "frame": TEXT}),
    Case(
        "write_robot_program",
        programmed,
        {"period": 0.1},
        {"motion": INSTANCE, "period": POSITIVE, "joints": but(SEQUENCE, "None")},
    ),
    Case(
        "log_rerun",
        lambda **options: log_rerun(**{"plan": valid_plan(), **options}),
        {"rerun": recorder(), "period": 0.1},
        {"plan": INSTANCE, "rerun": INSTANCE, "period": POSITIVE, "entity": TEXT, "timeline": TEXT},
    ),
    method(valid_plan, "sample", {"period": 0.1}, period=POSITIVE),
    method(valid_plan, "table", {"period": 0.1}, period=POSITIVE),
    method(valid_plan, "plot", {}, against=but(INSTANCE, "None"), figure=but(INSTANCE, "None")),
    method(valid_plan, "to_ros", {"period": 0.1}, period=POSITIVE),
]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_good_calls_pass(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_values_are_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)


# ---- what does not fit -----------------------------------------------------------------------------------------------

TASKS: dict[str, tuple[Callable[[], Any], str]] = {
    "no horizon": (lambda: {"tasks": ENDLESS}, "horizon"),
    "no tasks": (lambda: {"tasks": []}, "task"),
    "begins after the end": (lambda: {"tasks": replace(GOOD, begin=5.0), "horizon": 2.0}, "task 0"),
    "ends after the end": (lambda: {"tasks": [GOOD, replace(GOOD, begin=1.0)], "horizon": 1.5}, "task 1"),
    "of an unknown link": (lambda: {"tasks": replace(GOOD, link="nobody")}, "nobody"),
    "relative to an unknown link": (lambda: {"tasks": replace(GOOD, relative_to="nobody")}, "nobody"),
    "more rows than joints": (lambda: {"tasks": [GOOD, TipTask(velocity=[0.0, 0.0], rows=(2, 3))]}, "rows"),
    "twice the same": (lambda: {"tasks": [TipTask(velocity=[0.1], rows=[3]), GOOD]}, "rows"),
    "rows no joint moves": (lambda: {"tasks": replace(GOOD, rows=None)}, "rows"),
    "nan on the way": (
        lambda: {"tasks": TipTask(position=lambda t: ca.vertcat(REACHED[0], ca.sqrt(0.5 - t)), rows=(3, 4))},
        "task",
    ),
    "another's start": (lambda: {"start": [0.4, 0.6, 0.9]}, "link3"),
    "a start outside the limits": (lambda: {"machine": limited(0.5)}, CHAIN.joints[1].name),
    "velocity alone from nowhere": (
        lambda: {"tasks": TipTask(velocity=[0.1, 0.0], rows=(3, 4)), "horizon": 1.0, "start": None},
        "start",
    ),
    "a jump between tasks": (lambda: {"tasks": [GOOD, replace(GOOD, begin=GOOD.end)], "start": None}, ""),
}


def limited(most: float) -> FixedBase:
    """The arm with its second joint between -most and most."""
    first, second, *others = CHAIN.joints
    return FixedBase(replace(CHAIN, joints=(first, replace(second, lower=-most, upper=most), *others)))


@pytest.mark.parametrize("what", TASKS)
def test_tasks_that_do_not_fit_are_refused_by_name(what: str) -> None:
    changes, name = TASKS[what]
    options = {**PLANNED, "horizon": None, **changes()}
    if what == "nan on the way":
        options["horizon"] = 1.0
    with pytest.raises((ProblemError, SolveError)) as caught:
        plan(**options)
    assert caught.value.name
    if name:
        assert caught.value.name == name


def test_a_schedule_of_another_path_is_refused() -> None:
    other = smooth(Path.through([(0, 0, 0), (1, 0, 0)]), deviation=0.01)
    timing = schedule(other, LineLimits(speed=0.1, acceleration=0.2, jerk=2.0))
    with pytest.raises(ProblemError, match="path of 1 m") as caught:
        TipTask.along(LINE, timing)
    assert (caught.value.name, caught.value.value) == ("speed", 1.0)


def test_a_cone_needs_an_axis() -> None:
    with pytest.raises(ProblemError, match="direction") as caught:
        TipTask.along(LINE, 0.2, steady=True, within=0.1)
    assert caught.value.name == "within"


# ---- out of reach ----------------------------------------------------------------------------------------------------


def leads_to(points: Any, speed: float = 0.5, **options: Any) -> TipTask:
    return TipTask.along(smooth(Path.through(points), deviation=0.01), speed, steady=True, **options)


def test_a_start_that_is_too_far_says_by_how_much() -> None:
    """Three links of 2.4 m in all; 3 m are asked."""
    with pytest.raises(Unreachable, match="at 0 s") as caught:
        plan(ARM, leads_to([(3.0, 0, 0), (2.0, 0, 0)], rows=(3, 4)))
    assert caught.value.pose_error == pytest.approx(0.6, abs=1e-6)
    assert caught.value.time == 0.0
    np.testing.assert_allclose(np.sin(caught.value.joints[1:]), 0.0, atol=1e-3)


LEAVING = smooth(Path.through([(1.0, -1.5, 0.0), (2.6, 0.0, 0.0), (1.0, 1.5, 0.0)]), deviation=0.01)


@pytest.mark.parametrize("search", ["start", "configurations"])
def test_a_path_out_of_reach_is_reported_with_time_and_place(search: Any) -> None:
    """Out by 0.2 m in the middle of its 4 m, at 4 of 8 s, inside again at the end."""
    task = TipTask.along(LEAVING, 0.5, steady=True, rows=(3, 4))
    with pytest.raises(Unreachable) as caught:
        plan(ARM, task, search=search)
    result = caught.value
    assert result.time is not None
    place = LEAVING.at(0.5 * result.time).position[0]
    assert np.linalg.norm(place) == pytest.approx(2.4, abs=1e-5)
    assert result.distance > 1e-3
    assert result.angle == 0.0
    assert str(np.round(place, 6).tolist()) in str(result)


def test_a_path_beyond_the_joint_limits_says_so() -> None:
    """The arm is long enough, and its second joint may not bend so far."""
    near = leads_to([(1.6, 0.3, 0.0), (0.25, 0.3, 0.0)], rows=(3, 4))
    assert plan(ARM, near).audit().feasible
    first, second, third = CHAIN.joints
    stiff = tuple(replace(joint, lower=-0.6, upper=0.6) for joint in (second, third))
    with pytest.raises(Unreachable) as caught:
        plan(FixedBase(replace(CHAIN, joints=(first, *stiff))), near)
    assert caught.value.pose_error > 0.1
    assert caught.value.time is not None


def test_a_later_task_out_of_reach_is_named_with_its_time() -> None:
    first = leads_to([(1.5, 0.0, 0.0), (1.5, 0.5, 0.0)], rows=(3, 4))
    second = leads_to([(2.9, 0.0, 0.0), (2.9, 0.5, 0.0)], rows=(3, 4), begin=3.0)
    with pytest.raises(Unreachable, match="task 1") as caught:
        plan(ARM, [first, second])
    assert caught.value.time == pytest.approx(3.0)
    assert caught.value.pose_error == pytest.approx(0.5, abs=1e-6)


def test_an_orientation_out_of_reach_says_so() -> None:
    """A tool that has to look away from an arm stretched to its end."""
    places: Array = np.array([(0.9, 0.0, 0.2), (0.9, 0.1, 0.2)])
    task = TipTask.along(smooth(Path.through(places), deviation=0.01), 0.1, steady=True, direction=(-1, 0, 0))
    for machine in (ur5(), angled_ur5()):
        with pytest.raises(Unreachable) as caught:
            plan(machine, task)
        assert caught.value.pose_error > 0.01
    assert DOWN[2] == -1
