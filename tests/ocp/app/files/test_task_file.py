"""Task files state what `plan` takes: goals, waypoints and sequences of motions, with errors that name the line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import Box, Foothold, FreeFloating, Link, ModelWarning, MovingObstacle, Sphere, planar_chain, rectangle
from ocp import (
    Anywhere,
    Capture,
    Cone,
    FreeTime,
    Goal,
    Grasp,
    IndexAtLeast,
    InFoot,
    JointFriction,
    Pinned,
    Plan,
    ProblemError,
    Start,
    Steps,
    StepWeights,
    TipTask,
    Waypoints,
    Weights,
    plan,
    plan_problem,
)
from ocp.__main__ import main
from ocp.app.files.task_file import Task, read_task
from ocp.motion.tasks.goals import TERMS
from scripts.robots.steps import planar_biped
from tests.ocp.app.motions import NAMES, write_robot
from tests.ocp.motion.builders.captures import PLANAR_START, planar_capture, planar_chaser, planar_target

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


@pytest.mark.parametrize("term", TERMS)
def test_a_task_file_weights_every_term_of_the_cost(tmp_path: Path, term: str) -> None:
    cost = read(tmp_path, f"[path]\n{PATH}[cost]\n{term} = 1.0\n").options["cost"]
    assert np.all(np.asarray(getattr(cost, term)) == 1.0)
    assert set(cost.terms) <= {"velocity", term}


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
        read(tmp_path, "[path]\npoints = [[400, -200, 300], [400, 100, 300]]\nspeed = 50\nsteady = true\n")


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


CAPTURE = """base = "planar"
[robot.wheels]
axes = [[0, 0, 1]]
inertia = 0.02
momentum = 6.0
torque = 1.0
mass = 0.2
[capture]
approach = 5.0
detumble = { least = 4.0, most = 9.0, guess = 5.0 }
cone = { direction = [-1, 0, 0], half_angle = 0.4, length = 0.25 }
grasp = { force = 20.0, moment = 10.0 }
friction = { viscous = 0.1, coulomb = { joint1 = 0.2 } }
end = { joint2 = -1.5 }
[capture.target]
urdf = "target.urdf"
tip = "target"
tip_position = [-0.4, 0, 0]
momentum = [0.45, 0, 0]
pose = [1.9, 0.3, 0.0]
[search]
start = { joint1 = 1.2, joint2 = -2.0, joint3 = 0.6, wheel1 = 0.0 }
[cost]
velocity = 0
effort = 1.0
acceleration = { joint1 = 1.0, joint2 = 1.0, joint3 = 1.0 }
time = 0.05
[scene]
look = false
"""


def read_capture(folder: Path, text: str) -> Task:
    chain = planar_chain([0.8, 0.7, 0.3], [4.0, 3.0, 1.0], base=Link("hub", 60.0, (0, 0, 0), 6.0 * np.eye(3)))
    chain.to_urdf(folder / "chaser.urdf")
    planar_target().robot.to_urdf(folder / "target.urdf")
    tip = f'tip = "{chain.tip_link}"\ntip_position = {np.asarray(chain.tip_translation).tolist()}'
    (folder / "capture.toml").write_text(f'[robot]\nurdf = "chaser.urdf"\n{tip}\n{text}')
    return read_task(folder / "capture.toml")


def test_a_capture_has_the_bodies_the_phases_and_the_limits_of_its_tables(tmp_path: Path) -> None:
    task = read_capture(tmp_path, CAPTURE)
    capture, chaser = task.tasks, task.machine
    assert isinstance(capture, Capture)
    for machine, expected in ((chaser, planar_chaser()), (capture.target, planar_target())):
        assert isinstance(machine, FreeFloating)
        assert machine.base == "planar"
        assert machine.robot.total_mass == pytest.approx(expected.robot.total_mass)
        assert machine.robot.dof == expected.robot.dof
        assert list(np.asarray(machine.conserved_momentum)) == pytest.approx(np.asarray(expected.conserved_momentum))
    np.testing.assert_allclose(chaser.robot.velocity[-1], planar_chaser().robot.velocity[-1])
    tips = [machine.tip_pose(np.array([0.1, 0.2, 0.3]), PLANAR_START).position for machine in (chaser, planar_chaser())]
    np.testing.assert_allclose(np.array(tips[0]), np.array(tips[1]), atol=1e-12)
    np.testing.assert_allclose(capture.target.robot.tip_translation, [-0.4, 0, 0])
    assert (capture.approach, capture.detumble, capture.rest) == (5.0, FreeTime(4.0, 9.0, 5.0), True)
    np.testing.assert_allclose(capture.target_base, [1.9, 0.3, 0.0])
    assert isinstance(capture.cone, Cone)
    assert (capture.cone.half_angle, capture.cone.length, capture.cone.depth) == (0.4, 0.25, Cone.depth)
    assert capture.grasp == Grasp(20.0, 10.0)
    assert isinstance(capture.friction, JointFriction)
    np.testing.assert_allclose(np.asarray(capture.friction.coulomb, dtype=float), [0.2, 0, 0, 0])
    np.testing.assert_allclose(np.asarray(capture.end, dtype=float), [np.nan, -1.5, np.nan, np.nan])
    np.testing.assert_allclose(task.options["start"], PLANAR_START)
    assert task.options["scene"] is False


@pytest.mark.long
def test_a_capture_in_a_file_costs_what_the_same_capture_costs_in_python(tmp_path: Path, capsys: Any) -> None:
    text = CAPTURE.replace("{ least = 4.0, most = 9.0, guess = 5.0 }", "5.0")
    text = text.replace("friction = { viscous = 0.1, coulomb = { joint1 = 0.2 } }\nend = { joint2 = -1.5 }\n", "")
    read_capture(tmp_path, text)
    request = planar_capture()
    names = ("target", "target_base", "cone", "grasp")
    capture = Capture(approach=5.0, detumble=5.0, **{name: request[name] for name in names})
    expected = plan(request["chaser"], capture, start=request["start"], cost=request["cost"], scene=False)
    file = tmp_path / "capture.npz"
    assert main(["plan", str(tmp_path / "capture.toml"), "-o", str(file), "--quiet"]) == 0
    assert Plan.load(file).cost == pytest.approx(expected.cost, rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "line", "expected"),
    [
        ('base = "planar"', 'base = "fixed"', 12, 'base = "floating" or "planar"'),
        ("approach = 5.0", "approach = -5", 13, "must be a number above 0, s"),
        ("approach = 5.0\n", "", 12, "'approach' is missing"),
        ("half_angle = 0.4, ", "", 15, "'half_angle' is missing"),
        ("force = 20.0", "force = 0", 16, "must be a number above 0, N"),
        ("[-1, 0, 0], half", "[0, 0, 0], half", 15, "direction must not be zero"),
        ("viscous = 0.1", "viscus = 0.1", 17, "did you mean viscous"),
        ("end = { joint2", "end = { joint5", 18, "no independent joint 'joint5'"),
        ("pose = [1.9, 0.3, 0.0]", "pose = [1.9, 0.3]", 24, "3 numbers"),
        ("momentum = [0.45, 0, 0]", "momentum = [0.45]", 23, "conserved_momentum"),
        ("inertia = 0.02\n", "", 6, "'inertia' is missing"),
        ('urdf = "target.urdf"', 'urdf = "ball.urdf"', 20, "there is no file"),
    ],
)
def test_a_mistake_in_a_capture_is_reported_with_its_line(
    tmp_path: Path, old: str, new: str, line: int, expected: str
) -> None:
    assert CAPTURE.count(old) == 1
    with pytest.raises(ProblemError) as caught:
        read_capture(tmp_path, CAPTURE.replace(old, new))
    assert f"capture.toml, line {line}," in str(caught.value), str(caught.value)
    assert expected in str(caught.value)


def test_several_paths_are_tasks_at_the_same_time_and_a_pose_may_be_constant(tmp_path: Path) -> None:
    text = f'[[path]]\n{PATH}tool = "free"\nbegin = 0.5\n'
    text += '[[path]]\nlink = "fore"\nrelative_to = "upper"\npoint = [0.1, 0, 0]\n'
    text += "direction = [0, 0, 1]\ntool_axis = [1, 0, 0]\n"
    moving, held = read(tmp_path, text).tasks
    assert (moving.begin, moving.rows) == (0.5, (3, 4, 5))
    assert (held.link, held.relative_to, held.duration) == ("fore", "upper", None)
    np.testing.assert_allclose(held.tool_axis, [1, 0, 0])
    np.testing.assert_allclose(held.point, [0.1, 0, 0])
    parts = read(tmp_path, "[[task]]\npath = [{ position = [0.7, 0, 0.3], duration = 2.0 }]\n").tasks
    assert [len(part) for part in parts] == [1]
    assert parts[0][0].duration == 2.0


def test_a_goal_may_carry_a_load_and_tasks_on_the_way(tmp_path: Path) -> None:
    text = (
        '[goal]\njoints = { elbow = 1.2 }\nduration = { least = 1, most = 3, guess = 2 }\nname = "lift"\nload = 1.5\n'
    )
    text += "path = { direction = [0, 0, 1] }\n[search]\nvelocity = { elbow = 0.1 }\n" + START
    task = read(tmp_path, text)
    goal, start = task.tasks, task.options["start"]
    assert (goal.name, goal.duration) == ("lift", FreeTime(1, 3, 2))
    assert goal.machine.robot.total_mass == pytest.approx(task.machine.robot.total_mass + 1.5)
    assert goal.tasks.tilts
    assert isinstance(start, Start)
    np.testing.assert_allclose(np.asarray(start.velocity, dtype=float), [np.nan, 0.1, np.nan, np.nan])


def test_limits_may_be_robust_and_obstacles_may_move(tmp_path: Path) -> None:
    text = f'[path]\n{PATH}[limits]\nrobust = {{ payload = 0.5, "tool offset" = 1e-3 }}\n'
    text += '[[obstacle]]\nshape = "sphere"\nradius = 0.1\nposition = [1, 1, 1]\nvelocity = [0.1, 0, -0.2]\n'
    options = read(tmp_path, text).options
    assert options["limits"].robust == {"payload": 0.5, "tool offset": 1e-3}
    (obstacle,) = options["scene"].obstacles
    assert isinstance(obstacle, MovingObstacle)
    np.testing.assert_allclose(np.array(obstacle.position(3.0)).ravel(), [0.3, 0, -0.6])


def test_a_standing_robot_has_its_own_cost_rule_and_spring(tmp_path: Path) -> None:
    rules = {
        '"anywhere"': Anywhere(), "{ margin = 0.01 }": InFoot(0.01), "{ index = 0.3 }": IndexAtLeast(0.3),
    }  # fmt: skip
    stand = 'base = "standing"\nfoot = [-0.2, 0.2, -0.1, 0.1]\n'
    for text, rule in rules.items():
        limits = f"[limits]\nzmp = {text}\nvertical_force = 20\n[cost]\nmanipulability = 0.1\n"
        options = read(tmp_path, f"{stand}[path]\n{PATH}{limits}").options
        assert (options["limits"].zmp, options["limits"].vertical_force) == (rule, 20.0)
        assert options["cost"] == Weights(manipulability=0.1)
    pinned = read(tmp_path, f"{stand}[path]\n{PATH}[limits]\nzmp = {{ point = [0.1, 0.0] }}\n").options["limits"].zmp
    assert isinstance(pinned, Pinned)
    np.testing.assert_allclose(pinned.point, [0.1, 0.0])
    spring = "[scene]\nspring = { stiffness = [100, 0, 0], rest = [0.5, 0, 0] }\n"
    (wrench,) = read(tmp_path, f"{stand}[path]\n{PATH}{spring}").options["scene"].wrenches(0.0, [0.7, 0.0, 0.0])
    np.testing.assert_allclose(np.array(wrench.force, dtype=float).ravel(), [-20, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("robust = { load = 0.5 }", 8, "payload"),
        ("robust = { payload = -1 }", 8, "payload"),
        ("zmp = { margin = -1 }", 8, "0 or more, m"),
        ("zmp = { edge = 1 }", 8, "margin, index, point"),
        ('zmp = "nowhere"', 8, '"anywhere"'),
        ("vertical_force = 0", 8, "above 0, N"),
    ],
)
def test_a_mistake_in_the_limits_is_reported_with_its_line(tmp_path: Path, text: str, line: int, expected: str) -> None:
    with pytest.raises(ProblemError) as caught:
        read(tmp_path, f"[path]\n{PATH}[limits]\n{text}\n")
    assert f"task.toml, line {line}," in str(caught.value), str(caught.value)
    assert expected in str(caught.value)
