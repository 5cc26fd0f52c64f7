"""Whatever is wrong with a schedule, its limits or its trajectories is refused by name."""

from __future__ import annotations

from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from models import FixedBase, Joint, Link, Path, Robot, Scara, scara_along, smooth
from ocp import joint_path, minimum_time_problem
from ocp.errors import ProblemError
from ocp.motion.builders.timing import solve_minimum_time
from ocp.motion.schedule import (
    JointLimits,
    JointTrajectory,
    LineLimits,
    Schedule,
    SpeedProfile,
    ToolLimits,
    joint_motion,
    joint_trajectory,
    peak_acceleration,
    ramp_distance,
    ramp_time,
    schedule,
)
from tests.bad_values import (
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
    WHOLE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
)


def two_rods() -> Robot:
    links = [Link("base", 1.0), Link("upper", 1.0), Link("fore", 1.0)]
    joints = [
        Joint(f"joint{i}", "revolute", links[i].name, links[i + 1].name, (0.4 * i, 0, 0), axis=(0, 0, 1))
        for i in (0, 1)
    ]
    return Robot(tuple(links), tuple(joints), tip_translation=(0.4, 0, 0))


PATH = smooth(Path.through([(0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.2, 0.0)]), 0.05)
ARM = scara_along(Scara(0.4, 0.35), PATH)
LIMITS = LineLimits(0.1, 0.5, 5.0)
PLAN = schedule(PATH, LIMITS)
JOINTS = joint_trajectory(PLAN, ARM, 0.1)
SAMPLES = np.linspace(0.0, PATH.length, 20)
EACH: Bad = LIMIT | {"table": [[1.0, 2.0]], "one of them zero": [1.0, 0.0]}
TIMES = but(FINITE, "empty") | NOTHING | {"table": [[0.1]], "list of texts": ["1"]}
SAMPLED = {
    "names": ("a", "b"),
    "t": [0.0, 1.0],
    "positions": np.zeros((2, 2)),
    "velocities": np.zeros((2, 2)),
    "accelerations": np.zeros((2, 2)),
}
PROFILE = {"t": [0.0, 1.0], "distance": [0.0, 0.5], "speed": [0.0, 1.0], "acceleration": [1.0, 1.0], "jerk": [0.0]}


def plan() -> Schedule:
    return PLAN


def profile() -> SpeedProfile:
    return PLAN.profile


def write_table(path: Any) -> None:
    with TemporaryDirectory() as folder:
        JOINTS.write_csv(f"{folder}/{path}" if isinstance(path, str) and path == "trajectory.csv" else path)


def read_table(path: Any) -> JointTrajectory:
    with TemporaryDirectory() as folder:
        JOINTS.write_csv(f"{folder}/trajectory.csv")
        return JointTrajectory.read_csv(
            f"{folder}/{path}" if isinstance(path, str) and path == "trajectory.csv" else path
        )


def trajectory() -> JointTrajectory:
    return JOINTS


CASES = [
    Case(
        "LineLimits",
        LineLimits,
        {"speed": 0.1, "acceleration": 0.5, "jerk": 5.0},
        {
            "speed": POSITIVE | NOTHING | {"table": [[1.0]], "texts": ["1"]},
            "acceleration": POSITIVE | NOTHING,
            "jerk": LIMIT | NOTHING,
            "centripetal": LIMIT | NOTHING,
            "joints": but(INSTANCE, "None"),
            "tool": but(INSTANCE, "None"),
        },
    ),
    Case(
        "ToolLimits",
        ToolLimits,
        {},
        dict.fromkeys(("acceleration", "jerk"), EACH | NOTHING) | {"turn_rate": LIMIT | NOTHING},
    ),
    Case(
        "JointLimits",
        JointLimits,
        {},
        dict.fromkeys(("velocity", "acceleration", "jerk"), but(EACH, "zero", "one of them zero") | NOTHING)
        | {"torque": EACH | NOTHING},
    ),
    Case(
        "schedule",
        schedule,
        {"path": PATH, "limits": LIMITS},
        {"path": INSTANCE, "limits": INSTANCE, "joints": but(INSTANCE, "None"), "strict": FLAG},
    ),
    method(plan, "at", {"time": 0.1}, time=TIMES),
    method(plan, "time_at", {"distance": 0.1}, distance=TIMES | {"beyond": 9.0, "before": -1.0}),
    method(plan, "sample", {"period": 0.1}, period=POSITIVE | NOTHING),
    method(profile, "at", {"time": 0.1}, time=TIMES),
    method(profile, "at_distance", {"distance": 0.1}, distance=TIMES),
    Case(
        "SpeedProfile",
        SpeedProfile,
        PROFILE,
        {
            "t": array(2) | NOTHING | {"falling": [1.0, 0.0]},
            "distance": array(2) | NOTHING,
            "speed": array(2) | NOTHING,
            "acceleration": array(2) | NOTHING,
            "jerk": array(1) | NOTHING,
        },
    ),
    Case(
        "joint_motion",
        joint_motion,
        {"joints": ARM, "motion": PLAN.sample(0.1)},
        {"joints": INSTANCE, "motion": INSTANCE},
    ),
    Case(
        "joint_trajectory",
        joint_trajectory,
        {"schedule": PLAN, "joints": ARM, "period": 0.1},
        {"schedule": INSTANCE, "joints": INSTANCE, "period": POSITIVE | NOTHING},
    ),
    Case(
        "peak_acceleration",
        peak_acceleration,
        {"mean": 0.5, "speed": 0.1, "jerk": 50.0},
        dict.fromkeys(("mean", "speed", "jerk"), POSITIVE | NOTHING),
    ),
    Case(
        "ramp_distance",
        ramp_distance,
        {"first": 0.0, "last": 0.1, "acceleration": 0.5, "jerk": 5.0},
        {
            "first": NONNEGATIVE | NOTHING,
            "last": NONNEGATIVE | NOTHING,
            "acceleration": POSITIVE | NOTHING,
            "jerk": POSITIVE | NOTHING,
        },
    ),
    Case(
        "ramp_time",
        ramp_time,
        {"change": 0.1, "acceleration": 0.5, "jerk": 5.0},
        {"change": NONNEGATIVE | NOTHING, "acceleration": POSITIVE | NOTHING, "jerk": POSITIVE | NOTHING},
    ),
    Case(
        "JointTrajectory",
        JointTrajectory,
        SAMPLED,
        {
            "names": {"None": None, "number": 3, "one": ("a",), "twice": ("a", "a"), "empty": (), "numbers": (1, 2)},
            "t": array(2) | NOTHING | {"falling": [1.0, 0.0]},
            **dict.fromkeys(("positions", "velocities", "accelerations"), array(2, 2) | NOTHING),
        },
    ),
    Case(
        "JointTrajectory.write_csv",
        write_table,
        {"path": "trajectory.csv"},
        {"path": {"None": None, "number": -3, "list": [], "device": "/dev/null", "folder": "/"}},
    ),
    Case(
        "JointTrajectory.read_csv",
        read_table,
        {"path": "trajectory.csv"},
        {
            "path": NOTHING
            | {"nan": NAN, "number": 3, "list": [], "device": "/dev/zero", "folder": "/", "absent": "/no/file.csv"}
            | {"zero byte": "a\0b", "other": __file__}
        },
    ),
    Case(
        "JointTrajectory.from_ros",
        JointTrajectory.from_ros,
        {"message": JOINTS.to_ros()},
        {
            "message": INSTANCE
            | {
                "no points": {"joint_names": ["a"]},
                "points are none": {"joint_names": ["a"], "points": [None]},
                "texts": {**JOINTS.to_ros(), "joint_names": [1, 2, 3, 4]},
            }
        },
    ),
    Case(
        "joint_path",
        joint_path,
        {"machine": FixedBase(two_rods()), "plan": (SAMPLES, np.zeros((20, 2))), "path": PATH},
        {
            "machine": INSTANCE,
            "plan": INSTANCE | {"one of them": (SAMPLES, None), "texts": (["a"], ["b"])},
            "path": INSTANCE,
        },
    ),
    Case(
        "solve_minimum_time",
        solve_minimum_time,
        {"path": PATH, "limits": LIMITS, "intervals": 10, "rounds": 0},
        {
            "path": INSTANCE,
            "limits": INSTANCE,
            "joints": but(INSTANCE, "None"),
            "guess": but(INSTANCE, "None"),
            "intervals": COUNT | NOTHING | {"few": 9},
            "rounds": WHOLE | NOTHING,
            "options": MAPPING | {"unknown": {"no_such": 1}},
        },
    ),
    Case(
        "minimum_time_problem",
        minimum_time_problem,
        {"path": PATH, "limits": LIMITS, "intervals": 10},
        {
            "path": INSTANCE,
            "limits": INSTANCE | {"joints without joints": LineLimits(0.1, 0.5, 5.0, INF, JointLimits(1.0))},
            "joints": but(INSTANCE, "None"),
            "guess": but(INSTANCE, "None"),
            "intervals": COUNT | NOTHING | {"few": 9},
        },
    ),
]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)


@pytest.mark.parametrize("text", ["", "t", "a,b,c,d\n", "t,a.positions,a.velocities,a.accelerations\n0,x,0,0\n"])
def test_a_file_that_is_no_trajectory_is_refused_by_name(text: str, tmp_path: Any) -> None:
    file = tmp_path / "joints.csv"
    file.write_text(text)
    assert_refused(Case("read_csv", JointTrajectory.read_csv, {}, {"path": {"text": file}}), "path")


@pytest.mark.parametrize("name", ["velocity", "acceleration", "jerk"])
def test_a_limit_of_zero_stops_no_joint_that_stands_still_and_names_the_one_that_moves(name: str) -> None:
    """The height of the path is constant: one joint of the arm stands still."""
    slopes = np.abs(ARM.at(np.linspace(0.0, PATH.length, 101)).first).max(axis=0)
    assert (slopes < 1e-12).any()
    for joint, slope in enumerate(slopes):
        values = np.full(len(slopes), 50.0)
        free = schedule(PATH, LineLimits(0.5, 2.0, 50.0, joints=JointLimits(**{name: values})), joints=ARM)
        values[joint] = 0.0
        limits = LineLimits(0.5, 2.0, 50.0, joints=JointLimits(**{name: values}))
        if slope < 1e-12:
            assert schedule(PATH, limits, joints=ARM).duration == pytest.approx(free.duration, rel=1e-9)
        else:
            with pytest.raises(ProblemError, match=f"'{ARM.names[joint]}' moves along the path") as caught:
                schedule(PATH, limits, joints=ARM)
            assert (caught.value.name, caught.value.limit) == (ARM.names[joint], 0.0)
