"""Task files state what `plan` takes: goals, waypoints and sequences of motions, with errors that name the line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import Box, Foothold, ModelWarning, Sphere, rectangle
from ocp import FreeTime, Goal, Plan, ProblemError, Steps, StepWeights, TipTask, Waypoints, plan_problem
from ocp.__main__ import main
from ocp.app.files.task_file import Task, read_task
from scripts.robots.steps import planar_biped
from tests.ocp.app.motions import NAMES, write_robot

START = "start = { shoulder = 0.3, elbow = 0.8, wrist = -0.5, slide = 0.15 }"
ROBOT = '[robot]\nurdf = "robot.urdf"\ntip = "finger"\n'
PATH = "points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]]\nspeed = 0.1\n"


def read(folder: Path, text: str) -> Task:
    write_robot(folder)
    (folder / "poses.csv").write_text("x,y,z,qw,qx,qy,qz\n0.7,0,0.3,1,0,0,0\n0.7,0.1,0.3,1,0,0,0\n")
    (folder / "axes.csv").write_text("x,y,z,ax,ay,az\n0.7,0,0.3,0,0,1\n0.7,0.1,0.3,0,0,1\n")
    (folder / "task.toml").write_text(ROBOT + text)
    return read_task(folder / "task.toml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("joints = { elbow = 1.2, slide = 0.1 }", {"joints": [np.nan, 1.2, np.nan, 0.1]}),
        (
            "position = [0.7, 0, 0.3]\ndirection = [0, 0, -1]\nwithin = 0.2\nduration = 2.0",
            {"position": [0.7, 0, 0.3], "direction": [0, 0, -1], "within": 0.2, "duration": 2.0},
        ),
        (
            'position = [0.7, 0, 0.3]\norientation = [0, 1, 0, 0]\ntip = "hand"\nvelocity = "free"',
            {"position": [0.7, 0, 0.3], "orientation": [0, 1, 0, 0], "tip": "hand", "velocity": "free"},
        ),
        (
            "position = [0.7, 0, 0.3]\nrpy = [0, 0, 1.5707963267948966]\nvelocity = { elbow = 0.5 }",
            {"orientation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "velocity": [np.nan, 0.5, np.nan, np.nan]},
        ),
    ],
)
def test_a_goal_has_the_values_of_its_table(tmp_path: Path, text: str, expected: dict[str, Any]) -> None:
    goal = read(tmp_path, f"[goal]\n{text}\n[search]\n{START}\n").tasks
    assert isinstance(goal, Goal)
    for name, value in expected.items():
        if isinstance(value, str):
            assert getattr(goal, name) == value
        else:
            np.testing.assert_allclose(np.asarray(getattr(goal, name), dtype=float), value, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "kind", "size"),
    [('"box", size = [0.1, 0.2, 0.3]', Box, [0.1, 0.2, 0.3]), ('"sphere", radius = 0.2', Sphere, 0.2)],
)
def test_a_goal_may_be_a_region(tmp_path: Path, text: str, kind: Any, size: Any) -> None:
    goal: Any = read(tmp_path, f"[goal]\nregion = {{ shape = {text}, position = [0.7, 0, 0.3] }}\n").tasks
    assert isinstance(goal.region, kind)
    np.testing.assert_allclose(goal.region.size if kind is Box else goal.region.radius, size)
    np.testing.assert_allclose(goal.region.position, [0.7, 0, 0.3])


def test_waypoints_sequences_costs_and_horizons_are_those_of_plan(tmp_path: Path) -> None:
    waypoints = read(tmp_path, '[waypoints]\nfile = "poses.csv"\nstep = { elbow = 0.2 }\n').tasks
    assert isinstance(waypoints, Waypoints)
    np.testing.assert_allclose(waypoints.positions, [[0.7, 0, 0.3], [0.7, 0.1, 0.3]])
    np.testing.assert_allclose(waypoints.step, [np.inf, 0.2, np.inf, np.inf])
    task = read(
        tmp_path,
        f"[[task]]\npath = {{ points = [[0.75, 0.1, 0.3], [0.75, 0.3, 0.3]], speed = 0.1 }}\n"
        f"[[task]]\ngoal = {{ joints = {{ elbow = 1.2 }} }}\n"
        f'[search]\n{START}\nhorizon = "free"\ntime_limit = 60\n'
        "[cost]\neffort = { elbow = 2e-3 }\nvelocity = 0.5\nlength = 0.25\n[limits]\nfriction = 0.6\n",
    )
    seam, goal = task.tasks
    assert isinstance(seam, TipTask)
    assert isinstance(goal, Goal)
    assert (task.options["horizon"], task.options["time_limit"]) == ("free", 60.0)
    cost = task.options["cost"]
    assert (cost.velocity, cost.length, cost.time) == (0.5, 0.25, 0.0)
    np.testing.assert_allclose(cost.effort, [0, 2e-3, 0, 0])
    assert task.options["limits"].friction == 0.6
    assert read(tmp_path, "[goal]\njoints = { elbow = 1.2 }\n[search]\nhorizon = 3\n").options["horizon"] == 3.0


def test_a_tool_on_a_path_starts_and_ends_at_rest_unless_the_file_says_steady(tmp_path: Path) -> None:
    """A steady pass takes length / speed, ramps take half of v/a + a/j more at each end."""
    durations = [
        read(tmp_path, f"[path]\n{PATH}{more}").tasks.duration
        for more in ("steady = true", "", "acceleration = 0.5", "acceleration = 0.5\njerk = 2.0")
    ]
    np.testing.assert_allclose(durations, [2.0, 2.0 + 0.1 / 1.0 + 0.1, 2.0 + 0.1 / 0.5 + 0.1, 2.0 + 2 * np.sqrt(0.05)])


def test_a_centripetal_limit_slows_the_tool_only_in_bends(tmp_path: Path) -> None:
    """The default ramps hold with it as well, so that a straight path takes the same time."""
    corner = "points = [[0.7, 0.1, 0.3], [0.7, 0.3, 0.3], [0.5, 0.3, 0.3]]\nspeed = 0.1\n"
    limit = "centripetal = 0.1\n"
    straight, slowed, free = (
        read(tmp_path, f"[path]\n{text}").tasks.duration for text in (PATH + limit, corner + limit, corner)
    )
    assert straight == pytest.approx(2.0 + 0.1 / 1.0 + 0.1, rel=1e-3)
    assert slowed > 1.02 * free


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        (f"[path]\n{PATH}[goal]\njoints = {{ elbow = 1 }}\n", 7, "path and goal"),
        ("[goal]\njoints = { elbov = 1.2 }\n", 5, "elbov"),
        ("[goal]\njoints = { elbow = 1.2 }\nposition = [0, 0, 1]\n", 5, "not both"),
        ("[goal]\nposition = [0, 0]\n", 5, "three numbers"),
        ("[goal]\nposition = [0, 0, 1]\nrpy = [0, 0, 0]\norientation = [1, 0, 0, 0]\n", 6, "remove one"),
        ('[goal]\nregion = { shape = "cone" }\n', 5, '"box", "sphere"'),
        ('[goal]\nposition = [0, 0, 1]\nvelocity = "slow"\n', 6, '"rest", "free"'),
        ("[goal]\nposition = [0, 0, 1]\nspeed = 2\n", 6, "unknown entry speed"),
        ('[waypoints]\nfile = "axes.csv"\n', 5, "quaternions"),
        ('[waypoints]\nfile = "none.csv"\n', 5, "there is no file"),
        ("[[task]]\npath = { speed = 1 }\ngoal = { tip = 1 }\n", 4, "either path"),
        ("[[task]]\nwaypoints = {}\n", 5, "unknown entry waypoints"),
        (f"[path]\n{PATH}direction = [0, 0, 0]\n", 7, "has no length"),
        (f"[path]\n{PATH}steady = true\njerk = 1\n", 8, "steady"),
        (f"[path]\n{PATH}[search]\nhorizon = -1\n", 8, "above 0"),
        (f"[path]\n{PATH}[cost]\nvelocity = 0\n", 7, "at least one weight"),
        (f"[path]\n{PATH}[cost]\neffort = {{ knee = 1 }}\n", 8, "knee"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, line: int, expected: str) -> None:
    with pytest.raises(ProblemError) as caught:
        read(tmp_path, text)
    assert f"task.toml, line {line}," in str(caught.value), str(caught.value)
    assert expected in str(caught.value)


def test_points_in_millimetres_are_suspected(tmp_path: Path) -> None:
    with pytest.warns(ModelWarning, match="is it in millimetres"):
        read(tmp_path, "[path]\npoints = [[400, -200, 300], [400, 100, 300]]\nspeed = 50\n")


def test_a_file_without_a_motion_says_which_tables_describe_one(tmp_path: Path) -> None:
    with pytest.raises(
        ProblemError, match=r"give one of the tables \[path\], \[goal\], \[waypoints\], \[walk\], \[capture\]"
    ) as caught:
        read(tmp_path, "[search]\nseed = 1\n")
    assert caught.value.name == "path"


def test_a_goal_is_planned_by_the_command(tmp_path: Path, capsys: Any) -> None:
    text = f'[goal]\njoints = {{ elbow = 1.2 }}\n[search]\n{START}\n[output]\nplan = "goal.npz"\n'
    read(tmp_path, text)
    assert main(["plan", str(tmp_path / "task.toml"), "--quiet"]) == 0
    plan = Plan.load(tmp_path / "goal.npz")
    ends = plan.at(np.array([0.0, plan.horizon]))["joints"]
    np.testing.assert_allclose(ends[0], [0.3, 0.8, -0.5, 0.15], atol=1e-9)
    assert ends[1, NAMES.index("elbow")] == pytest.approx(1.2)
    assert plan.audit().feasible


WALK = """[walk]
shift = 0.5
swing = { least = 0.3, most = 2.0, guess = 0.6 }
margin = 0.01
[walk.feet.left]
link = "left_foot"
position = [0, 0, -0.08]
sole = [-0.08, 0.14, -0.05, 0.05]
at = [0.0, 0.0, 0.0, 0.0]
[walk.feet.right]
link = "right_foot"
position = [0, 0, -0.08]
sole = [-0.08, 0.14, -0.05, 0.05]
at = [0.0, 0.0, 0.0, 0.0]
[[walk.step]]
foot = "right"
at = [0.25, 0.0, 0.0, 0.0]
[[walk.step]]
foot = "left"
at = [0.5, 0.0, 0.1, 0.02]
[search]
start = { left_hip = -0.4, left_knee = 0.8, left_ankle = -0.4, right_hip = -0.4, right_knee = 0.8, right_ankle = -0.4 }
[cost]
torque = 1e-4
[limits]
friction = 0.6
"""


CROUCHED_LEG = {"hip": -0.4, "knee": 0.8, "ankle": -0.4}


def read_walk(folder: Path, text: str) -> Task:
    planar_biped().to_urdf(folder / "biped.urdf")
    (folder / "walk.toml").write_text(f'[robot]\nurdf = "biped.urdf"\n{text}')
    return read_task(folder / "walk.toml")


def test_a_walk_has_the_feet_the_footholds_and_the_durations_of_its_table(tmp_path: Path) -> None:
    task = read_walk(tmp_path, WALK)
    steps = task.tasks
    assert isinstance(steps, Steps)
    assert [set(phase.footholds) for phase in steps.phases] == [
        {"left", "right"}, {"left"}, {"left", "right"}, {"right"}, {"left", "right"}
    ]  # fmt: skip
    assert [phase.duration for phase in steps.phases] == [0.5, FreeTime(0.3, 2.0, 0.6)] * 2 + [0.5]
    assert (steps.margin, steps.clearance, steps.balance) == (0.01, Steps.clearance, "dynamic")
    last, expected = steps.phases[-1].footholds["left"], Foothold.level(0.5, 0.0, 0.1, 0.02)
    np.testing.assert_allclose(last.position, expected.position)
    np.testing.assert_allclose(last.rotation, expected.rotation)
    for side in ("left", "right"):
        sole = steps.feet[side].sole
        assert sole is not None
        np.testing.assert_allclose(sole.vertices, rectangle((-0.08, 0.14), (-0.05, 0.05)).vertices)
    start = dict(zip(task.machine.robot.joint_names, task.options["start"], strict=True))
    assert start == {f"{side}_{name}": q for side in ("left", "right") for name, q in CROUCHED_LEG.items()}
    assert task.options["cost"] == StepWeights(torque=1e-4)
    assert task.options["limits"].friction == 0.6
    problem = plan_problem(task.machine, steps, start=task.options["start"], cost=task.options["cost"])
    assert len(problem.declared.phases) == 5


@pytest.mark.parametrize(
    ("old", "new", "line", "expected"),
    [
        ("shift = 0.5", "shift = -0.5", 4, "must be a number above 0, s"),
        ("shift = 0.5\n", "", 3, "'shift' is missing"),
        ("most = 2.0", "most = 0.5", 5, "lower <= guess <= upper"),
        ('link = "right_foot"', 'link = "foot"', 3, "foot"),
        (
            "sole = [-0.08, 0.14, -0.05, 0.05]\nat = [0.0, 0.0, 0.0, 0.0]\n[walk.f",
            "at = [0, 0, 0]\n[walk.f",
            10,
            "four",
        ),
        ('foot = "right"', 'foot = "third"', 18, 'must be one of "left", "right"'),
        ("margin = 0.01", 'balance = "some"', 6, "must be one of"),
        ("[walk]", 'base = "floating"\n[walk]', 3, "remove base"),
        ("[limits]", "[scene]\nclearance = 0.1\n[limits]", 27, "remove scene"),
        ("torque = 1e-4", "effort = 1", 26, "unknown entry effort"),
        ("left_hip = -0.4, ", "", 24, "start has no left_hip"),
    ],
)
def test_a_mistake_in_a_walk_is_reported_with_its_line(
    tmp_path: Path, old: str, new: str, line: int, expected: str
) -> None:
    assert WALK.count(old) >= 1
    with pytest.raises(ProblemError) as caught:
        read_walk(tmp_path, WALK.replace(old, new, 1))
    assert f"line {line}," in str(caught.value)
    assert expected in str(caught.value)


@pytest.mark.long
def test_the_command_plans_a_walk(tmp_path: Path, capsys: Any) -> None:
    read_walk(tmp_path, WALK.replace("at = [0.5, 0.0, 0.1, 0.02]", "at = [0.5, 0.0, 0.0, 0.0]"))
    file = tmp_path / "walk.npz"
    assert main(["plan", str(tmp_path / "walk.toml"), "-o", str(file), "--quiet"]) == 0
    assert Plan.load(file).horizon > 1.5 + 2 * 0.3
