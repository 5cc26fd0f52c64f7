"""Closed forms of postures: forward kinematics undo them, none is missing, and geometry alone says who has one."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import FixedBase, Joint, Mimic, Robot
from models.checks import Array
from ocp import TipTask, inverse_kinematics
from ocp.motion.local.chain import Chain
from ocp.motion.local.closed_forms import ClosedForm
from ocp.motion.local.closed_forms import closed_forms as closed_forms_of
from ocp.motion.local.ik_solver import ik_branches
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.local.arms import arm
from tests.ocp.motion.tasks.space_tasks import panda, ur5
from tests.redundancy_benchmark import problem_of

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
TURN = 2 * np.pi


def chain_of(machine: FixedBase) -> Chain:
    chain = Chain.of(machine)
    assert chain is not None
    return chain


def closed_forms(machine: FixedBase) -> tuple[ClosedForm, ...]:
    return () if Chain.of(machine) is None else closed_forms_of(chain_of(machine))


def random_arm(kind: str, first: int, rng: Any, count: int = 6) -> FixedBase:
    """Axes anywhere, but three of them from the first one on that meet or are parallel."""
    paths = rng.normal(size=(count, 3))
    paths /= np.linalg.norm(paths, axis=1)[:, None]
    places = rng.uniform(-0.5, 0.5, (count, 3))
    three = slice(first, first + 3)
    if kind == "meeting":
        places[three] = places[first] + rng.uniform(-0.3, 0.3, (3, 1)) * paths[three]
    elif kind == "parallel":
        paths[three] = paths[first] * np.array([[1.0], [-1.0], [1.0]])
    return arm(paths, places, rng.uniform(-0.5, 0.5, 3), Rotation.random(random_state=rng).as_matrix())


def poses(machine: FixedBase, joints: Array) -> tuple[Array, Array]:
    q = ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose((), q)
    result = ca.Function("pose", [q], [ca.vertcat(pose.position, ca.vec(pose.rotation))])
    rows = np.array(result.map(len(joints))(joints.T)).T
    return rows[:, :3], rows[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)


def apart(one: Array, others: Array, turns: Any) -> Array:
    """Greatest differences of joints, whole turns not counted."""
    path = one - others
    path[..., turns] -= TURN * np.round(path[..., turns] / TURN)
    return np.asarray(np.abs(path).max(axis=-1))


def counts(machine: FixedBase, form: ClosedForm, rng: Any, count: int) -> Any:
    """How many postures there are at the poses of random ones; they meet the poses, the random ones are among them."""
    joints = rng.uniform(-np.pi, np.pi, (count, machine.joint_size))
    joints[:, ~form.chain.revolute] /= 10
    places, turns = poses(machine, joints)
    (own, result, _), _ = form.solve(places, turns, joints[:, list(form.redundant)])
    again = poses(machine, result)
    assert again[0] == pytest.approx(places[own], abs=1e-9)
    assert again[1] == pytest.approx(turns[own], abs=1e-9)
    assert (result[:, list(form.redundant)] == joints[own][:, list(form.redundant)]).all()
    for k in range(count):
        here = result[own == k]
        assert apart(joints[k], here, form.chain.revolute).min() < 1e-6
        assert not np.any(np.triu([apart(one, here, form.chain.revolute) < 1e-6 for one in here], 1))
    return np.bincount(own, minlength=count)


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("kind", ["meeting", "parallel"])
def test_random_arms_have_an_even_number_of_branches_up_to_eight(kind: str, first: int) -> None:
    rng = np.random.default_rng([first, kind == "meeting"])
    for _ in range(3):
        machine = random_arm(kind, first, rng)
        (form,) = closed_forms(machine)
        assert (form.kind, form.triple, form.redundant) == (kind, (first, first + 1, first + 2), ())
        result = counts(machine, form, rng, 60)
        assert result.max() <= 8
        assert not (result % 2).any()  # solutions come and go in pairs


@pytest.mark.parametrize("kind", ["meeting", "parallel"])
def test_newtons_method_from_many_starts_finds_the_same_branches(kind: str) -> None:
    rng = np.random.default_rng(5)
    machine = random_arm(kind, 3 if kind == "meeting" else 1, rng)
    (form,) = closed_forms(machine)
    places, turns = poses(machine, rng.uniform(-np.pi, np.pi, (3, 6)))
    (own, result, _), _ = form.solve(places, turns, np.zeros((3, 0)))
    for k in range(3):
        task = TipTask(position=places[k], orientation=turns[k])
        others = np.array([one.joints for one in inverse_kinematics(machine, task, starts=200, seed=k)])
        here = result[own == k]
        assert len(here) == len(others)
        assert max(apart(other, here, form.chain.revolute).min() for other in others) < 1e-7


STRAIGHT_ARMS: dict[str, tuple[FixedBase, str]] = {
    "parallel 2 and 3, spherical wrist": (
        arm([Z, Y, Y, X, Y, X], [(0, 0, 0.4), (0.1, 0.05, 0.4), *[(0.1, 0, 0.9)], *[(0.4, 0, 1.0)] * 3], (0.5, 0, 1.0)),
        "meeting",
    ),
    "no offsets": (
        arm([Z, Y, Y, X, Y, X], [(0, 0, 0)] * 2 + [(0, 0, 0.5)] + [(0.4, 0, 0.5)] * 3, (0.5, 0, 0.5)),
        "meeting",
    ),
    "ur5": (ur5(), "parallel"),
}


@pytest.mark.parametrize("name", STRAIGHT_ARMS)
def test_axes_at_right_angles_and_without_offsets_lose_no_branch(name: str) -> None:
    machine, kind = STRAIGHT_ARMS[name]
    (form,) = closed_forms(machine)
    assert form.kind == kind
    assert counts(machine, form, np.random.default_rng(1), 200).max() == 8


def test_of_arms_with_more_joints_some_are_held_and_the_rest_has_a_closed_form() -> None:
    rng = np.random.default_rng(2)
    fetch, lift = problem_of("fetch_arm__s").machine, problem_of("fetch__square").machine
    # three axes meet in the shoulder of the Panda, in the shoulder and in the wrist of the Fetch
    assert {form.redundant for form in closed_forms(panda())} == {(3,), (4,), (5,), (6,)}
    assert {form.redundant for form in closed_forms(fetch)} == {(0,), (1,), (2,), (3,), (5,), (6,)}
    assert all(form.redundant[0] == 0 for form in closed_forms(lift))  # what slides is held
    for machine in (panda(), fetch, lift):
        for form in closed_forms(machine):
            assert counts(machine, form, rng, 20).max() <= 8


def test_a_scara_has_two_elbows_wherever_its_slide_is() -> None:
    rng = np.random.default_rng(3)
    for slide in range(4):
        machine = arm([Z] * 4, [(0, 0, 0), (0.3, 0, 0), (0.5, 0, 0), (0.5, 0.15, 0.1)], (0.6, 0, 0), prismatic=(slide,))
        (form,) = closed_forms(machine)
        assert form.kind == "scara"
        assert (counts(machine, form, rng, 30) == 2).all()
    leaning = arm([Z, Z, Z, Y], [(0, 0, 0), (0.3, 0, 0), (0.5, 0, 0), (0.5, 0, 0.1)], (0.6, 0, 0), prismatic=(3,))
    assert closed_forms(leaning) == ()


def test_other_arms_have_no_closed_form_and_unreachable_poses_no_branch() -> None:
    rng = np.random.default_rng(4)
    assert closed_forms(random_arm("", 0, rng)) == ()
    assert closed_forms(random_arm("", 0, rng, 5)) == ()
    six = ur5().robot
    following = [*six.joints[:-1], six.joints[-1]]
    moving = [k for k, joint in enumerate(following) if joint.moves]
    last = following[moving[-1]]
    following[moving[-1]] = Joint(
        last.name, last.kind, last.parent, last.child, mimic=Mimic(following[moving[0]].name), axis=last.axis
    )
    assert closed_forms(FixedBase(Robot(six.links, tuple(following), tip=six.tip))) == ()
    (form,) = closed_forms(ur5())
    (own, result, _), _ = form.solve(np.array([[5.0, 0.0, 0.0]]), np.eye(3)[None], np.zeros((1, 0)))
    assert own.shape == (0,)
    assert result.shape == (0, 6)


def test_branches_meet_limits_with_all_turns_and_satisfy_the_task() -> None:
    limit = 3.6  # more than half a turn, so that some angles are there twice
    paths, places = [Z, Y, Y, X, Y, X], [(0, 0, 0.4), (0.1, 0, 0.4), (0.1, 0, 0.9), *[(0.4, 0, 1.0)] * 3]
    machine = arm(paths, places, np.array((0.5, 0, 1.0)), limit=limit)
    at, turn = poses(machine, np.array([[3.4, 0.4, 0.9, -3.3, 0.7, 0.3]]))
    for rolls, report in ((1, {"orientation": turn[0]}), (12, {"direction": 2.0 * turn[0, :, 2]})):
        equations = bind(machine, TipTask(position=at[0], **report))
        branches = ik_branches(equations, machine.robot.lower, machine.robot.upper)
        assert branches is not None
        target = np.array(equations.target_function()(0.0)).ravel()
        result = branches.configurations(target, rolls).joints
        assert (np.abs(result) <= limit + 1e-9).all()
        assert max(np.abs(equations.errors(0.0, None, one)).max() for one in result) < 1e-9
        wrapped = np.remainder(result.round(6), round(TURN, 6))
        same = [(apart(one, result, slice(None)) < 1e-5).sum() for one in result]
        twice = 2 ** (np.abs(result) > TURN - limit).sum(axis=1)
        assert same == twice.tolist(), wrapped
        if rolls == 1:
            assert np.abs(result - [3.4, 0.4, 0.9, -3.3, 0.7, 0.3]).max(axis=1).min() < 1e-7


def test_scara_arms_have_branches_of_single_poses_alone() -> None:
    machine = arm(
        [Z] * 4, [(0, 0, 0), (0.3, 0, 0), (0.5, 0, 0), (0.5, 0, 0.1)], np.array((0.6, 0, 0)), prismatic=(3,), limit=3.0
    )
    report = (machine.robot.lower, machine.robot.upper)
    for rows, orientation in (((3, 4, 5), None), ((2, 3, 4, 5), [np.cos(0.3), 0, 0, np.sin(0.3)])):
        task = TipTask(position=(0.35, 0.1, 0.05), orientation=orientation, rows=rows)
        equations = bind(machine, task)
        branches = ik_branches(equations, *report)
        assert branches is not None
        result = branches.configurations(np.array(equations.target_function()(0.0)).ravel(), 16).joints
        assert len(result) == (2 if orientation else len(result))
        assert len(result) >= 2
        assert max(np.abs(equations.errors(0.0, None, one)).max() for one in result) < 1e-9
    place = np.array([0.4, 0.1, 0.3])
    arm_of_six = ur5()
    for other in (TipTask(orientation=np.eye(3)), TipTask(position=place, orientation=np.eye(3), rows=[0, 1, 2, 3, 4])):
        assert ik_branches(bind(arm_of_six, other), arm_of_six.robot.lower, arm_of_six.robot.upper) is None
