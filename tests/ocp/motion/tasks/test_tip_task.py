from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Machine, Path, planar_chain, smooth
from models.machines.machine import with_tip
from ocp import ProblemError, RateOptions, Start, TipTask, resolve
from ocp.motion.tasks.equations import bind, task_errors
from ocp.motion.tasks.tip_task import retime_task
from ocp.motion.tasks.tracks import path_tracks, pose_line
from tests.models.machines.standing_machines import standing_arm
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.tasks.space_tasks import (
    BASE,
    PANDA_START,
    UR5_START,
    floating_panda,
    line_from,
    panda,
    pose,
    turned,
    two_pandas,
    ur5,
)

MOMENTUM = (0.5, -0.3, 0.4, 1.0, -2.0, 1.5)
TWIST = np.array([0.03, -0.02, 0.04, 0.02, -0.04, 0.03])


def test_tasks_that_name_links_need_no_tip() -> None:
    """The first link's frame is the tip of what is planned; a task of the tip itself is refused."""
    arm = planar_chain([1.0, 1.0, 1.0], [1.0] * 3)
    branch = replace(arm.joints[-1], parent="link1")
    fork = FixedBase(replace(arm, joints=(*arm.joints[:-1], branch), tip=None, tip_translation=(0.0, 0.0, 0.0)))
    end = (1.0, 0.0, 0.0)
    task = TipTask(rows=(3, 4), velocity=(0.1, 0.2), link="link3", point=end)
    report, result = (
        resolve(machine, task, 1.0, start=[0.3, 0.5, -0.7]) for machine in (with_tip(fork, "link3", end), fork)
    )
    np.testing.assert_array_equal(result.joints, report.joints)
    np.testing.assert_array_equal(result.tip_in_world, report.tip_in_world)
    with pytest.raises(ProblemError, match=r"no tip.*leaves \['link2', 'link3'\]"):
        bind(fork, TipTask(rows=(3, 4), velocity=(0.1, 0.2)))


def twists_of(machine: Machine, local: Any, link: str) -> Array:
    """Of a link's frame along a motion, by the machine itself. Shape (M, 6)."""
    moved = with_tip(machine, link)
    return np.array(
        [
            numeric(moved.tip_twist(b, q, r)).ravel()
            for b, q, r in zip(local.base, local.joints, local.joint_rates, strict=True)
        ]
    )


@pytest.mark.parametrize("axes", ["world", "base", "tip"])
def test_rows_along_any_axes_are_followed_with_momentum_on_board(axes: Any) -> None:
    """The twist of the tip, turned into those axes, is what was asked, at every sample; rows in any order."""
    machine, rows = floating_panda(MOMENTUM), [4, 0, 5, 3]
    task = TipTask(rows=rows, velocity=TWIST[rows], axes=axes)
    local = resolve(machine, task, 2.0, start=Start(PANDA_START, base=BASE), samples=9)
    assert local.stopped is None
    for base, joints, rates in zip(local.base, local.joints, local.joint_rates, strict=True):
        twist = numeric(machine.tip_twist(base, joints, rates)).ravel()
        turn = {
            "world": np.eye(3),
            "base": numeric(machine.world_from_base(base).rotation),
            "tip": pose(machine, base, joints)[0],
        }[axes]
        result = np.concatenate([turn.T @ twist[:3], turn.T @ twist[3:]])
        np.testing.assert_allclose(result[rows], TWIST[rows], atol=1e-9)


def test_a_pose_line_is_followed_and_the_drift_is_fed_back() -> None:
    machine = floating_panda(MOMENTUM)
    line = line_from(machine, BASE, PANDA_START, (0.1, -0.1, 0.05), (1, 2, 0.5), 0.4, 2.0)
    task = TipTask(position=line.position, orientation=line.orientation)
    local = resolve(machine, task, 2.0, start=Start(PANDA_START, base=BASE), samples=21)
    assert local.stopped is None
    assert np.abs(local.task_error).max() < 1e-8
    rotation, position = pose(machine, local.base[-1], local.joints[-1])
    first = pose(machine, BASE, PANDA_START)
    np.testing.assert_allclose(position, first[1] + first[0] @ [0.1, -0.1, 0.05], atol=1e-8)
    np.testing.assert_allclose(rotation, first[0] @ turned((1, 2, 0.5), 0.4), atol=1e-8)


def test_the_feedback_closes_a_gap_at_its_rate() -> None:
    rotation, position = pose(panda(), (), PANDA_START)
    task = TipTask(
        position=position + np.array([0.03, 0.0, 0.0]), orientation=rotation @ turned((0, 0, 1), 0.02), gain=3.0
    )
    with pytest.raises(ProblemError, match=r"'panda_hand' is 0\.03 .* start_gap = 1e-06"):
        resolve(panda(), task, 1.0, start=PANDA_START)
    task = replace(task, start_gap=0.1)
    local = resolve(panda(), task, 1.0, start=PANDA_START, samples=11)
    expected = 0.01 * np.exp(-3 * local.t)
    np.testing.assert_allclose(np.linalg.norm(local.task_error[:, 3:], axis=1), 3 * expected, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(local.task_error[:, :3], axis=1), 2 * expected, rtol=1e-3)


def test_a_free_roll_leaves_the_tool_axis_where_it_is_wanted() -> None:
    rotation, position = pose(ur5(), (), UR5_START)

    def tilting(time: Any) -> Any:
        return ca.mtimes(ca.DM(rotation), ca.vertcat(ca.sin(0.2 * time), 0, ca.cos(0.2 * time)))

    task = TipTask(position=position, direction=tilting)
    local = resolve(ur5(), task, 2.0, start=UR5_START, samples=11)
    assert task.size == 5
    assert np.abs(local.task_error).max() < 1e-8
    for time, joints, rates in zip(local.t, local.joints, local.joint_rates, strict=True):
        turn, place = pose(ur5(), (), joints)
        np.testing.assert_allclose(turn[:, 2], numeric(tilting(time)).ravel(), atol=1e-8)
        np.testing.assert_allclose(place, position, atol=1e-8)
        spin = numeric(ur5().tip_twist((), joints, rates)).ravel()[:3]
        change = 0.2 * turned(rotation[:, 1], 0.2 * time) @ rotation[:, 0]  # d/dt of the direction
        np.testing.assert_allclose(np.cross(spin, turn[:, 2]), change, atol=1e-7)
    # of all motions that do it the least: no smaller rates with another roll
    equations = bind(ur5(), task)
    result = np.linalg.pinv(numeric(equations.jacobian(np.zeros(0), local.joints[3])))
    right = equations.right(np.zeros(0), local.joints[3], equations.target_function()(local.t[3]))
    np.testing.assert_allclose(local.joint_rates[3], (result @ numeric(right)).ravel(), atol=1e-9)


def test_the_base_is_held_still_by_a_task_of_the_root_link() -> None:
    machine = floating_panda()
    task = [TipTask(rows=(3,), velocity=(0.02,)), TipTask(rows=(0, 1, 2), velocity=(0.0, 0.0, 0.0), link="satellite")]
    local = resolve(machine, task, 3.0, start=Start(PANDA_START, base=BASE), samples=13)
    assert local.stopped is None
    np.testing.assert_allclose(local.base[:, 3:], np.tile(BASE[3:], (13, 1)), atol=1e-9)
    np.testing.assert_allclose(local.tip_in_world[-1, 0] - local.tip_in_world[0, 0], 0.06, atol=1e-8)
    assert np.abs(local.joints[-1] - PANDA_START).max() > 0.01


@pytest.mark.long
def test_two_arms_move_one_thing_relative_to_each_other() -> None:
    """The left hand on a line, the right one fixed in the left one's frame."""
    machine = two_pandas(MOMENTUM)
    start = np.concatenate([PANDA_START * [-1, 1, -1, 1, -1, 1, 1], PANDA_START])
    home = machine.base_home()
    left, right = (with_tip(machine, f"{side}_panda_hand") for side in ("left", "right"))
    line = line_from(left, home, start, (0.05, 0.0, 0.05), (1, 0, 0), 0.2, 3.0)
    (turn, place), (other, there) = pose(left, home, start), pose(right, home, start)
    relative = turn.T @ (there - place), turn.T @ other
    task = [
        TipTask(position=line.position, orientation=line.orientation, link="left_panda_hand"),
        TipTask(position=relative[0], orientation=relative[1], link="right_panda_hand", relative_to="left_panda_hand"),
    ]
    local = resolve(machine, task, 3.0, start=start, samples=7)
    assert local.stopped is None
    assert local.task_error.shape == (7, 12)
    for base, joints in zip(local.base, local.joints, strict=True):
        (turn, place), (other, there) = pose(left, base, joints), pose(right, base, joints)
        np.testing.assert_allclose(turn.T @ (there - place), relative[0], atol=1e-8)
        np.testing.assert_allclose(turn.T @ other, relative[1], atol=1e-8)


def test_a_velocity_relative_to_a_link_is_that_of_the_relative_position() -> None:
    machine = floating_panda(MOMENTUM)
    task = TipTask(rows=(3, 4, 5), velocity=(0.02, -0.03, 0.01), axes="reference", relative_to="satellite")
    local = resolve(machine, task, 2.0, start=Start(PANDA_START, base=BASE), samples=5)
    moved = []
    for base, joints in zip(local.base, local.joints, strict=True):
        frame = machine.world_from_base(base)
        moved.append(numeric(frame.rotation).T @ (pose(machine, base, joints)[1] - numeric(frame.position).ravel()))
    np.testing.assert_allclose(moved - moved[0], np.outer(local.t, [0.02, -0.03, 0.01]), atol=1e-8)
    assert np.abs(twists_of(machine, local, "satellite")).max() > 1e-3


def test_weights_make_a_joint_move_less() -> None:
    task = TipTask(rows=(3, 4, 5), velocity=(0.05, 0.0, 0.02))
    weights = np.array([1.0, 100.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    local = resolve(panda(), task, 0.1, start=PANDA_START, samples=2, options=RateOptions(weights=weights))
    jacobian = numeric(panda().tip_jacobian((), PANDA_START))[3:]
    root = np.sqrt(weights)
    expected = np.linalg.pinv(jacobian / root) @ [0.05, 0.0, 0.02] / root
    np.testing.assert_allclose(local.joint_rates[0], expected, atol=1e-10)


def test_a_path_is_followed_at_constant_speed() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    corners = position + np.array([[0, 0, 0], [0.0, 0.1, 0], [0.04, 0.1, 0], [0.04, 0, 0]])
    path = smooth(Path.through(corners), deviation=0.004)
    task = TipTask(position=path_tracks(path, 0.1).position, direction=rotation[:, 2])
    local = resolve(ur5(), task, path.length / 0.1, start=UR5_START, samples=41)
    assert np.abs(local.task_error).max() < 1e-6
    motion = zip(local.joints, local.joint_rates, strict=True)
    speeds = np.linalg.norm([numeric(ur5().tip_twist((), q, rates)).ravel()[3:] for q, rates in motion], axis=1)
    np.testing.assert_allclose(speeds, 0.1, rtol=1e-5)


def test_a_pose_line_is_a_slerp_at_constant_pace_and_rests_at_its_ends() -> None:
    axis, first = np.array([1.0, -2.0, 2.0]) / 3, turned((0, 1, 0), 0.7)
    shares: dict[Any, Any] = {"constant": lambda s: s, "rest": lambda s: s**3 * (10 - 15 * s + 6 * s**2)}
    for pace, share in shares.items():
        line = pose_line((first, (1, 2, 3)), (first @ turned(axis, 2.5), (2, 2, 1)), 4.0, pace=pace)
        for time in (0.0, 1.3, 4.0):
            part = share(time / 4)
            np.testing.assert_allclose(numeric(line.position(time)).ravel(), [1 + part, 2, 3 - 2 * part], atol=1e-12)
            np.testing.assert_allclose(numeric(line.orientation(time)), first @ turned(axis, 2.5 * part), atol=1e-12)
    quaternion = np.array([np.cos(0.35), 0.0, np.sin(0.35), 0.0])
    same = pose_line((quaternion, (1, 2, 3)), (first, (1, 2, 3)), 1.0)
    np.testing.assert_allclose(numeric(same.orientation(0.5)), first, atol=1e-12)
    with pytest.raises(ProblemError, match="180 deg apart"):
        pose_line((np.eye(3), (0, 0, 0)), (np.diag([-1.0, -1.0, 1.0]), (0, 0, 0)), 1.0)
    with pytest.raises(ProblemError, match="not a rotation"):
        pose_line((np.eye(3), (0, 0, 0)), (np.ones((3, 3)), (0, 0, 0)), 1.0)


def test_quaternion_and_matrix_tracks_say_the_same() -> None:
    def quaternion(time: Any) -> Any:
        return ca.vertcat(ca.cos(0.2 * time), 0, 0, ca.sin(0.2 * time)) * 3  # any length

    def matrix(time: Any) -> Any:
        c, s = ca.cos(0.4 * time), ca.sin(0.4 * time)
        return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))

    targets = [
        numeric(bind(panda(), TipTask(orientation=track)).target_function()(0.8)) for track in (quaternion, matrix)
    ]
    np.testing.assert_allclose(targets[0], targets[1], atol=1e-12)
    np.testing.assert_allclose(targets[0][9:].ravel(), [0, 0, 0.4], atol=1e-12)


def test_errors_are_reported_for_any_motion() -> None:
    rotation, position = pose(panda(), (), PANDA_START)
    task = TipTask(position=position, orientation=rotation, rows=(2, 3))
    errors = task_errors(panda(), task, [0.0, 1.0], [PANDA_START, PANDA_START])
    np.testing.assert_allclose(errors, np.zeros((2, 2)), atol=1e-14)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "needs a velocity or a pose"),
        ({"velocity": (0.0,), "position": (0.0, 0.0, 0.0)}, "and not both"),
        ({"velocity": (0.0,)}, "rows are missing"),
        ({"velocity": (0.0,), "rows": 3}, "rows must be a list of the twist rows 0..5, not 3"),
        ({"velocity": (0.0,), "rows": (3.5,)}, r"rows must be a list .* not \(3\.5,\)"),
        ({"position": (0.0, 0.0, 0.0), "rows": "xyz"}, "rows must be a list .* not 'xyz'"),
        ({"orientation": np.eye(3), "direction": (0, 0, 1)}, "not both"),
        ({"position": (0.0, 0.0, 0.0), "rows": (2, 3)}, r"rows \[2\]: rows 0..2 need an orientation"),
        ({"position": (0.0, 0.0, 0.0), "rows": ()}, "rows is empty"),
        ({"position": (0.0, 0.0, 0.0), "axes": "tool"}, "axes must be .* not 'tool'"),
        ({"position": (0.0, 0.0, 0.0), "gain": -1.0}, "gain must be"),
        ({"position": (0.0, 0.0, 0.0), "point": (0.0, 0.0, 1.0)}, "name the link"),
        ({"direction": (0, 0, 1), "tool_axis": (0, 0, 0)}, "tool_axis .* has no direction"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction .* has no length"),
    ],
)
def test_tasks_that_are_none_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        TipTask(**fields)
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (TipTask(rows=(3, 4), velocity=(0.0,)), r"velocity has shape \(1, 1\)"),
        (TipTask(position=lambda t: [t, ca.SX.sym("wind"), 0]), r"position depends on \['wind'\]"),
        (TipTask(orientation=lambda t: 2 * ca.DM.eye(3)), "orientation is not a rotation"),
        ([TipTask(rows=(3, 4), velocity=(0, 0))] * 2, "linearly dependent in every configuration"),
        ([TipTask(rows=range(6), velocity=np.zeros(6)), TipTask(rows=(0, 1), velocity=(0, 0))], "fixes 8 rows"),
        (TipTask(rows=(3,), velocity=(0.0,), link="base_link"), "no joint moves the tip"),
        (TipTask(rows=(3,), velocity=(0.0,), relative_to="moon"), "moon"),
    ],
)
def test_tasks_that_do_not_fit_the_machine_are_refused(task: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        resolve(ur5(), task, 1.0, start=UR5_START)
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_an_opposite_tool_axis_is_no_start() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    with pytest.raises(ProblemError, match=r"'tool0' is .* away from where its task begins"):
        resolve(ur5(), TipTask(position=position, direction=-rotation[:, 2]), 1.0, start=UR5_START)


def test_a_planar_arm_takes_poses_in_its_plane() -> None:
    machine = FixedBase(planar_chain([1.0, 0.8, 0.6, 0.4], [1.0] * 4))
    start = np.deg2rad([30.0, 40.0, 50.0, -20.0])
    rotation, position = pose(machine, (), start)
    goal = rotation @ turned((0, 0, 1), 0.5), position + np.array([-0.3, 0.2, 0.0])
    line = pose_line((rotation, position), goal, 2.0)
    task = TipTask(position=line.position, orientation=line.orientation, rows=(2, 3, 4))
    local = resolve(machine, task, 2.0, start=start, samples=5)
    np.testing.assert_allclose(pose(machine, (), local.joints[-1])[1], position + np.array([-0.3, 0.2, 0.0]), atol=1e-8)


def motion_of(symbols: Any, size: int, seed: int) -> Any:
    """A smooth motion of `size` coordinates: time -> (value, rate, second derivative)."""
    rng, t = np.random.default_rng(seed), symbols.sym("t")
    value = ca.DM(rng.normal(size=size)) + ca.DM(rng.normal(size=size)) * ca.sin(t + ca.DM(rng.uniform(0, 6, size)))
    rate = ca.jacobian(value, t)
    return ca.Function("motion", [t], [value, rate, ca.jacobian(rate, t)])


def tilting(time: Any) -> Any:
    return ca.vertcat(ca.sin(0.3 * time), 0.2, ca.cos(0.3 * time))


def drift(time: Any) -> Any:
    return [0.3 + 0.1 * ca.sin(time), 0.2, 0.5 - 0.1 * time**2]


TASKS = {
    "pose": TipTask(position=drift, orientation=(0.9, 0.1, -0.3, 0.2), gain=1.5),
    "axis": TipTask(position=drift, direction=tilting, rows=(5, 3), axes="tip", gain=0.0),
    "velocity": TipTask(rows=(1, 5, 3), velocity=lambda t: [t, ca.sin(t), 0.1], axes="base", gain=2.0),
    "relative": TipTask(position=drift, relative_to="link3", axes="reference", rows=(4,)),
}


@pytest.mark.parametrize("name", TASKS)
def test_equations_of_accelerations_are_those_of_velocities_differentiated(name: str) -> None:
    """Along any motion whatever, d/dt (J u - b) + gain (J u - b) by finite differences; and J is its slope in u'."""
    machine, task = standing_arm(), TASKS[name]
    equations, n = bind(machine, task), machine.joint_size
    q, u, second, time = (ca.SX.sym(what, size) for what, size in (("q", n), ("u", n), ("s", n), ("t", 1)))
    residual = equations.residual(ca.DM(0, 1), q, u, equations.targets(time))
    twist_level = ca.Function("twist", [q, u, time], [residual])
    level = equations.acceleration(ca.DM(0, 1), q, u, second, progress=(time,))
    slope = ca.Function("slope", [q, u, time], [ca.jacobian(level, second) - equations.jacobian(ca.DM(0, 1), q)])
    acceleration_level = ca.Function("acceleration", [q, u, second, time], [level])
    motion, h = motion_of(ca.SX, n, 3), 1e-5
    for at in (0.2, 1.1, 2.7):
        before, here, after = (numeric(twist_level(*motion(t)[:2], t)) for t in (at - h, at, at + h))
        expected = (after - before) / (2 * h) + task.gain * here
        np.testing.assert_allclose(numeric(acceleration_level(*motion(at), at)), expected, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(numeric(slope(*motion(at)[:2], at)), 0, atol=1e-12)


@pytest.mark.parametrize("name", [*TASKS, "path"])
def test_a_task_of_a_path_parameter_run_by_a_clock_is_the_timed_task(name: str) -> None:
    """The chain rule at both levels: pace of the parameter and its change on one side, `retime_task` on the other."""
    machine, symbols = standing_arm(), ca.MX if name == "path" else ca.SX
    path = smooth(Path.through([(0.0, 0, 0), (0.5, 0.0, 0), (0.5, 0.6, 0)]), deviation=0.02)
    task = TASKS[name] if name != "path" else TipTask(position=path_tracks(path, 0.4).position)
    equations, n = bind(machine, task), machine.joint_size
    both = bind(machine, retime_task(task, lambda t: 0.3 * t + 0.2 * t**2))
    q, u, second, time, pace, change = (
        symbols.sym(what, size) for what, size in zip(("q", "u", "s", "t", "p", "c"), (n, n, n, 1, 1, 1), strict=True)
    )
    none = ca.DM(0, 1)
    over_parameter = ca.Function("over", [q, u, second, time, pace, change], [
        equations.residual(none, q, u, equations.targets(time, pace)),
        equations.acceleration(none, q, u, second, progress=(time, pace, change)),
    ])  # fmt: skip
    over_time = ca.Function("time", [q, u, second, time], [
        both.residual(none, q, u, both.targets(time)), both.acceleration(none, q, u, second, progress=(time,))
    ])  # fmt: skip
    rng = np.random.default_rng(4)
    for at in (0.4, 1.3):
        state = rng.normal(size=(3, n))
        expected = over_parameter(*state, 0.3 * at + 0.2 * at**2, 0.3 + 0.4 * at, 0.4)
        for ours, theirs in zip(over_time(*state, at), expected, strict=True):
            np.testing.assert_allclose(numeric(ours), numeric(theirs), rtol=1e-10, atol=1e-10)


def test_a_position_may_name_its_rows_alone() -> None:
    machine = standing_arm()
    targets = [
        bind(machine, TipTask(position=track, rows=(5, 3))).target_function()(0.4)
        for track in (lambda t: [ca.sin(t), 2 * t], lambda t: [2 * t, 0, ca.sin(t)])
    ]
    np.testing.assert_allclose(numeric(targets[0]), numeric(targets[1]), atol=0)
    along_tip = TipTask(position=(1.0, 2.0), rows=(5, 3), axes="tip")
    with pytest.raises(ProblemError, match=r"position has shape \(2, 1\), expected \(3, 1\)"):
        bind(machine, along_tip).target_function()


@pytest.mark.parametrize("rows", [(3, 4, 5), range(6)], ids=["six rows", "twelve rows"])
def test_the_manipulability_of_two_arms_is_the_product_of_their_singular_values(rows: Any) -> None:
    machine, rng = FixedBase(two_pandas().robot), np.random.default_rng(8)
    hands = ("left_panda_hand", "right_panda_hand")
    equations = bind(machine, [TipTask(velocity=np.zeros(len(rows)), rows=rows, link=hand) for hand in hands])
    for joints in rng.uniform(-2, 2, size=(3, 14)):
        values = np.linalg.svd(numeric(equations.jacobian(ca.DM(0, 1), joints)), compute_uv=False)
        result = equations.manipulability(ca.DM(0, 1), ca.DM(joints))
        np.testing.assert_allclose(float(result), values.prod(), rtol=1e-9)
