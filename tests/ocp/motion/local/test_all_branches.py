"""All IK configurations of arms of many builds: none is missing that a dense search finds, and each one is exact."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import FixedBase, lock_joints
from models.checks import Array
from ocp import IkOptions, ProblemError, TipTask, inverse_kinematics
from ocp.motion.local.chain import Chain, Motion
from ocp.motion.local.elimination import Elimination, elimination_of, solve_opening
from ocp.motion.local.ik_solver import IkSolver, Incompleteness, ik_configurations
from ocp.motion.local.inverse_kinematics import inverse_kinematics_at
from ocp.motion.tasks.equations import bind
from tests.families import some
from tests.ocp.motion.local.arms import ARMS, build, calibrated, crx, denavit_hartenberg, on_rail, random_arm
from tests.ocp.motion.tasks.space_tasks import panda, ur5

TURN = 2 * np.pi
RIGHT = np.pi / 2


def tip_poses(machine: FixedBase, joints: Array) -> tuple[Array, Array]:
    """Poses of the tip by the symbolic kinematics, which inverse kinematics does not use."""
    q = ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose((), q)
    function = ca.Function("pose", [q], [ca.vertcat(pose.position, ca.vec(pose.rotation))])
    rows = np.array(function.map(len(joints))(joints.T)).T
    return rows[:, :3], rows[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)


def revolute(machine: FixedBase) -> NDArray[np.bool_]:
    return np.array([joint.kind != "prismatic" for joint in machine.robot.moving_joints])


def distances(joints: Array, others: Array, turns: NDArray[np.bool_]) -> Array:
    """Largest joint differences of configurations, whole turns not counted. Shape (K, M)."""
    difference = joints[:, None] - others[None]
    difference[..., turns] -= TURN * np.round(difference[..., turns] / TURN)
    return np.asarray(np.abs(difference).max(axis=2))


def random_joints(machine: FixedBase, rng: Any, count: int) -> Array:
    return np.asarray(np.where(revolute(machine), np.pi, 0.3) * rng.uniform(-1, 1, (count, machine.joint_size)))


def dense_search(machine: FixedBase, position: Array, rotation: Array, starts: int) -> Array:
    """Configurations that damped Gauss-Newton iterations from many random starts find."""
    equations = bind(machine, TipTask(position=position, orientation=rotation))
    targets = np.concatenate([position, np.zeros(3), rotation.T.ravel(), np.zeros(3)])
    solutions = inverse_kinematics_at(equations, targets, starts=starts, seed=0, options=IkOptions(limits=False))
    return np.array([solution.joints for solution in solutions])


def assert_none_is_missing(name: str, count: int, searches: int, starts: int) -> None:
    machine, rng = build(name), np.random.default_rng(1)
    turns, solver = revolute(machine), IkSolver(machine, limits=False, samples=3)
    joints = random_joints(machine, rng, count)
    positions, rotations = tip_poses(machine, joints)
    result = solver(positions, rotations)
    reached = tip_poses(machine, result.joints)
    np.testing.assert_allclose(reached[0], positions[result.pose], atol=1e-9)
    np.testing.assert_allclose(reached[1], rotations[result.pose], atol=1e-9)
    for k in range(count):
        listed = result.at(k)
        apart = distances(listed, listed, turns) + np.eye(len(listed))
        assert apart.min(initial=1.0) > 1e-6, "a configuration is listed twice"
        if not solver.parameters:
            # completeness is left open near singularities alone
            assert result.complete[k] or least_singular_values(machine, listed).min() < 2e-5
            assert distances(joints[k : k + 1], listed, turns).min() < 1e-6
            assert len(listed) <= 16
    numbers = [machine.robot.joint_names.index(each) for each in solver.parameters]
    for k in range(searches):
        listed = result.at(k)
        assert not solver.parameters or result.reasons[k] & Incompleteness.SAMPLED
        for values in np.unique(listed[:, numbers].round(9), axis=0):
            locked = dict(zip(solver.parameters, values.tolist(), strict=True))
            six = FixedBase(lock_joints(machine.robot, locked)) if locked else machine
            rest = [j for j in range(len(turns)) if j not in numbers]
            outcome = dense_search(six, positions[k], rotations[k], starts)
            here = listed[(np.abs(listed[:, numbers] - values) < 1e-8).all(axis=1)][:, rest]
            assert distances(outcome, here, turns[rest]).min(axis=1).max() < 1e-5


@pytest.mark.parametrize("name", ARMS)
def test_no_configuration_is_missing(name: str) -> None:
    assert_none_is_missing(name, 5, 1, 60)


@pytest.mark.long
@pytest.mark.parametrize("name", ARMS)
def test_at_a_hundred_poses_no_configuration_is_missing(name: str) -> None:
    assert_none_is_missing(name, 100, 20, 600)


@pytest.mark.parametrize("slide", [None, *range(6)])
def test_elimination_is_accurate_before_newtons_method(slide: int | None) -> None:
    """Every opening of the loop finds the configurations, wherever the prismatic joint is."""
    rows = [
        (0.1, RIGHT, 0.3),
        (0.2, 0.5, 0.1),
        (0.15, -RIGHT, 0.1),
        (0.1, 0.7, 0.2),
        (0.05, RIGHT, 0.1),
        (0.1, 0.3, 0.1),
    ]
    machine = denavit_hartenberg(rows, prismatic=() if slide is None else (slide,))
    chain, turns = chain_of(machine), revolute(machine)
    joints = random_joints(machine, np.random.default_rng(8), 8)
    tips = Motion(*chain.poses(joints)[::-1])
    solver = elimination_of(chain, ())
    assert solver is not None
    loop = solver.loop(np.zeros((8, 6)), tips)
    for opening in solver.openings:
        rough = solve_opening(*loop, chain.size, opening)
        for k in range(8):
            assert distances(joints[k : k + 1], rough.free[rough.pose == k], turns).min() < 1e-6


@pytest.mark.parametrize("deviation", some([1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10], 2))
@pytest.mark.parametrize("name", ["UR5", "PUMA"])
def test_an_arm_that_deviates_from_a_closed_form_loses_no_configuration(name: str, deviation: float) -> None:
    """The numbers agree on both sides of the limit at which elimination takes over, up to those near a singularity."""
    exact, moved = build(name), calibrated(build(name), deviation)
    positions, rotations = tip_poses(exact, random_joints(exact, np.random.default_rng(3), 60))
    results = [IkSolver(machine, limits=False)(positions, rotations) for machine in (exact, moved)]
    assert all(result.complete.all() for result in results)
    for k in range(60):
        first, second = (result.at(k) for result in results)
        apart = distances(first, second, revolute(exact))
        near = 100 * deviation + 1e-6
        regular = least_singular_values(exact, first) > 50 * np.sqrt(deviation)
        assert (apart[regular].min(axis=1, initial=np.inf) < near / 0.05).all()
        assert len(first) == len(second) or not regular.all()


@cache
def chain_of(machine: FixedBase) -> Chain:
    chain = Chain.of(machine)
    assert chain is not None
    return chain


def least_singular_values(machine: FixedBase, joints: Array) -> Array:
    chain = chain_of(machine)
    positions, rotations = chain.poses(joints)
    _, jacobian = chain.linearize(joints, Motion(rotations, positions), chain.order)
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, -1])


LENGTHS = st.sampled_from([0.0, 0.0, 0.1, 0.25, 0.4]) | st.floats(-0.5, 0.5)
TWISTS = st.sampled_from([0.0, RIGHT, -RIGHT, np.pi, np.pi / 3]) | st.floats(-np.pi, np.pi)
ANGLES = st.sampled_from([0.0, RIGHT, -RIGHT, np.pi, np.pi / 4]) | st.floats(-np.pi, np.pi)


GEOMETRIES = st.lists(st.tuples(LENGTHS, TWISTS, LENGTHS), min_size=6, max_size=6)
CONFIGURATIONS = st.lists(ANGLES, min_size=6, max_size=6)


def assert_is_recovered(rows: Any, angles: Any) -> None:
    machine, joints = denavit_hartenberg(rows), np.array([angles])
    chain, rng = chain_of(machine), np.random.default_rng(0)
    assume(least_singular_values(machine, rng.uniform(-np.pi, np.pi, (50, 6))).max() > 1e-2)  # six degrees of freedom
    position, rotation = tip_poses(machine, joints)
    solvers = [elimination_of(chain, ()), IkSolver(machine, limits=False).arm.solvers[0]]
    for solver in solvers:
        if solver is None:
            continue
        result, doubtful = solver.solve(position, rotation, np.zeros((1, 0)))
        reached = tip_poses(machine, result.joints)
        np.testing.assert_allclose(reached[0], np.tile(position, (len(result.pose), 1)), atol=1e-9)
        np.testing.assert_allclose(reached[1], np.tile(rotation, (len(result.pose), 1, 1)), atol=1e-9)
        certain = not doubtful[0] and not result.singular.any()
        if least_singular_values(machine, joints)[0] > 1e-3 and certain:
            assert distances(joints, result.joints, revolute(machine)).min(initial=np.inf) < 1e-5


@settings(max_examples=6, deadline=None)
@given(GEOMETRIES, CONFIGURATIONS)
def test_of_any_geometry_a_regular_configuration_is_found_again(rows: Any, angles: Any) -> None:
    assert_is_recovered(rows, angles)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(GEOMETRIES, CONFIGURATIONS)
def test_of_many_geometries_a_regular_configuration_is_found_again(rows: Any, angles: Any) -> None:
    assert_is_recovered(rows, angles)


@pytest.mark.parametrize("name", some(["UR5", "UR5 calibrated", "CRX", "JACO", "PUMA", "random"], 3))
def test_at_singular_poses_a_configuration_is_found_and_completeness_is_not_claimed(name: str) -> None:
    """Configurations between those of opposite signs of the Jacobian's determinant are double roots."""
    machine, rng = build(name), np.random.default_rng(5)
    chain = chain_of(machine)

    def determinant(joints: Array) -> Array:
        positions, rotations = chain.poses(joints)
        return np.asarray(np.linalg.det(chain.linearize(joints, Motion(rotations, positions), chain.order)[1]))

    first, second = rng.uniform(-np.pi, np.pi, (2, 40, 6))
    opposite = determinant(first) * determinant(second) < 0
    first, second = first[opposite], second[opposite]
    for _ in range(60):
        middle = (first + second) / 2
        same = determinant(middle) * determinant(first) > 0
        first[same], second[~same] = middle[same], middle[~same]
    positions, rotations = tip_poses(machine, first)
    result = IkSolver(machine, limits=False)(positions, rotations)
    assert not result.complete.any()
    for k in range(len(first)):
        assert len(result.at(k))
        # a double root is as accurate as the square root of rounding errors, others are members of a family
        assert least_singular_values(machine, result.at(k)).min() < 1e-3
    reached = tip_poses(machine, result.joints)
    np.testing.assert_allclose(reached[0], positions[result.pose], atol=1e-9)


def test_an_elimination_is_taken_only_where_no_closed_form_is() -> None:
    kinds = {name: IkSolver(build(name), limits=False).arm.solvers[0] for name in ("UR5", "CRX", "Panda")}
    assert {name: isinstance(solver, Elimination) for name, solver in kinds.items()} == {
        "UR5": False,
        "CRX": True,
        "Panda": False,
    }


def test_slides_are_sampled_rather_than_six_joints_left_without_closed_form() -> None:
    assert IkSolver(on_rail(ur5())).parameters == ("slide0",)
    assert len(IkSolver(on_rail(crx(3.0), 2)).parameters) == 2
    assert IkSolver(ur5()).parameters == ()
    assert len(IkSolver(panda()).parameters) == 1
    position, rotation = tip_poses(ur5(), np.full((1, 6), 0.3))
    assert ik_configurations(ur5(), TipTask(position=position[0], direction=rotation[0, :, 2])).parameters == ("roll",)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7])
def test_a_position_alone_is_reached_by_arms_of_three_joints_and_more(count: int) -> None:
    machine, rng = random_arm(np.random.default_rng(count), count), np.random.default_rng(11)
    joints = rng.uniform(-np.pi, np.pi, (5, count))
    positions, _ = tip_poses(machine, joints)
    for k in range(5):
        result = ik_configurations(machine, TipTask(position=positions[k]), samples=20)
        assert len(result.parameters) == count - 3
        np.testing.assert_allclose(tip_poses(machine, result.joints)[0] - positions[k], 0, atol=1e-9)
        if count == 3:
            assert distances(joints[k : k + 1], result.joints, revolute(machine)).min() < 1e-6
        assert count > 6 or len(result)


@pytest.mark.parametrize("count", [4, 5, 6, 7])
def test_a_direction_is_reached_with_the_roll_free(count: int) -> None:
    machine, rng = random_arm(np.random.default_rng(count), count), np.random.default_rng(12)
    joints = rng.uniform(-np.pi, np.pi, (5, count))
    positions, rotations = tip_poses(machine, joints)
    for k in range(5):
        result = ik_configurations(machine, TipTask(position=positions[k], direction=rotations[k, :, 2]), samples=12)
        reached = tip_poses(machine, result.joints)
        np.testing.assert_allclose(reached[0], np.tile(positions[k], (len(result), 1)), atol=1e-9)
        np.testing.assert_allclose(reached[1][:, :, 2], np.tile(rotations[k, :, 2], (len(result), 1)), atol=1e-9)
        assert bool(result.parameters) == (count > 5)
        if count <= 5:
            assert distances(joints[k : k + 1], result.joints, revolute(machine)).min() < 1e-6


@pytest.mark.parametrize("name", ["UR5", "CRX", "Panda"])
def test_the_tool_axis_stays_in_its_cone_and_fills_it(name: str) -> None:
    machine, axis = build(name), np.array([0.6, 0.0, 0.8])
    joints = np.linspace(0.3, 1.1, machine.joint_size)[None] * np.where(np.arange(machine.joint_size) % 2, -1, 1)
    position, rotation = tip_poses(machine, joints)
    task = TipTask(position=position[0], direction=3 * rotation[0] @ axis, tool_axis=axis, within=0.4)
    result = ik_configurations(machine, task, limits=False, samples=200)
    reached = tip_poses(machine, result.joints)
    np.testing.assert_allclose(reached[0], np.tile(position[0], (len(result), 1)), atol=1e-9)
    angles = np.arccos(np.clip(reached[1] @ axis @ (rotation[0] @ axis), -1, 1))
    assert angles.max() <= 0.4 + 1e-9
    assert angles.max() > 0.35
    assert angles.min() < 0.1
    assert result.parameters[-3:] == ("roll", "azimuth", "tilt")


def test_inverse_kinematics_lists_all_solutions_of_the_solver() -> None:
    for machine in (build("CRX"), build("UR5 calibrated"), ur5()):
        positions, rotations = tip_poses(machine, random_joints(machine, np.random.default_rng(2), 4))
        expected = IkSolver(machine, limits=False)(positions, rotations)
        for k in range(4):
            task = TipTask(position=positions[k], orientation=rotations[k])
            joints = np.array(
                [each.joints for each in inverse_kinematics(machine, task, options=IkOptions(limits=False))]
            )
            apart = distances(expected.at(k), joints, revolute(machine))
            assert apart.shape[0] == apart.shape[1]
            assert apart.min(axis=1).max() < 1e-7


def test_all_whole_turns_within_the_limits_are_listed() -> None:
    machine = ur5()
    lower, upper = machine.robot.lower, machine.robot.upper
    position, rotation = tip_poses(machine, np.array([[0.3, -1.2, 1.5, -1.9, -1.55, 0.2]]))
    listed = IkSolver(machine)(position, rotation).joints
    assert ((listed >= lower) & (listed <= upper)).all()
    base = IkSolver(machine, limits=False)(position, rotation).joints
    paths = [np.floor((upper - one) / TURN) + np.floor((one - lower) / TURN) + 1 for one in base]
    assert len(listed) == sum(np.prod(each) for each in paths)
    assert len(np.unique(listed.round(6), axis=0)) == len(listed)


def test_poses_that_are_none_are_refused() -> None:
    solver = IkSolver(ur5())
    for positions, rotations in (
        (np.zeros(2), np.eye(3)),
        (np.zeros((2, 3)), np.eye(3)[None]),
        (np.full(3, np.nan), np.eye(3)),
        (np.zeros(3), 2 * np.eye(3)),
        (np.zeros(3), np.diag([1.0, 1.0, -1.0])),
    ):
        with pytest.raises(ProblemError):
            solver(positions, rotations)
    options: list[dict[str, Any]] = [{"samples": 0}, {"limits": 1}]
    for option in options:
        with pytest.raises(ProblemError):
            IkSolver(ur5(), **option)
    with pytest.raises(ProblemError):
        ik_configurations(ur5(), TipTask(orientation=np.eye(3)))
