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
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    places = rng.uniform(-0.5, 0.5, (count, 3))
    three = slice(first, first + 3)
    if kind == "meeting":
        places[three] = places[first] + rng.uniform(-0.3, 0.3, (3, 1)) * ways[three]
    elif kind == "parallel":
        ways[three] = ways[first] * np.array([[1.0], [-1.0], [1.0]])
    return arm(ways, places, rng.uniform(-0.5, 0.5, 3), Rotation.random(random_state=rng).as_matrix())


def poses(machine: FixedBase, joints: Array) -> tuple[Array, Array]:
    q = ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose((), q)
    found = ca.Function("pose", [q], [ca.vertcat(pose.position, ca.vec(pose.rotation))])
    rows = np.array(found.map(len(joints))(joints.T)).T
    return rows[:, :3], rows[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)


def apart(one: Array, others: Array, turns: Any) -> Array:
    """Greatest differences of joints, whole turns not counted."""
    way = one - others
    way[..., turns] -= TURN * np.round(way[..., turns] / TURN)
    return np.asarray(np.abs(way).max(axis=-1))


def counts(machine: FixedBase, form: ClosedForm, rng: Any, count: int) -> Any:
    """How many postures there are at the poses of random ones; they meet the poses, the random ones are among them."""
    joints = rng.uniform(-np.pi, np.pi, (count, machine.joint_size))
    joints[:, ~form.chain.revolute] /= 10
    places, turns = poses(machine, joints)
    own, found = form.solutions(places, turns, joints[:, list(form.redundant)])
    again = poses(machine, found)
    assert again[0] == pytest.approx(places[own], abs=1e-9)
    assert again[1] == pytest.approx(turns[own], abs=1e-9)
    assert (found[:, list(form.redundant)] == joints[own][:, list(form.redundant)]).all()
    for k in range(count):
        here = found[own == k]
        assert apart(joints[k], here, form.chain.revolute).min() < 1e-6
        assert not np.any(np.triu([apart(one, here, form.chain.revolute) < 1e-6 for one in here], 1))
    return np.bincount(own, minlength=count)


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("kind", ["meeting", "parallel"])
def test_of_random_arms_postures_come_in_pairs_at_most_eight_and_lead_to_the_pose(kind: str, first: int) -> None:
    rng = np.random.default_rng([first, kind == "meeting"])
    for _ in range(3):
        machine = random_arm(kind, first, rng)
        (form,) = closed_forms(machine)
        assert (form.kind, form.triple, form.redundant) == (kind, (first, first + 1, first + 2), ())
        found = counts(machine, form, rng, 60)
        assert found.max() <= 8
        assert not (found % 2).any()  # solutions come and go in pairs


@pytest.mark.parametrize("kind", ["meeting", "parallel"])
def test_newtons_method_from_many_starts_finds_the_same_postures(kind: str) -> None:
    rng = np.random.default_rng(5)
    machine = random_arm(kind, 3 if kind == "meeting" else 1, rng)
    (form,) = closed_forms(machine)
    places, turns = poses(machine, rng.uniform(-np.pi, np.pi, (3, 6)))
    own, found = form.solutions(places, turns, np.zeros((3, 0)))
    for k in range(3):
        task = TipTask(position=places[k], orientation=turns[k])
        others = np.array([one.joints for one in inverse_kinematics(machine, task, starts=200, seed=k)])
        here = found[own == k]
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
def test_axes_at_right_angles_and_without_offsets_lose_no_posture(name: str) -> None:
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


def test_other_arms_have_none_and_poses_out_of_reach_no_posture() -> None:
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
    own, found = form.solutions(np.array([[5.0, 0.0, 0.0]]), np.eye(3)[None], np.zeros((1, 0)))
    assert own.shape == (0,)
    assert found.shape == (0, 6)


def test_branches_keep_limits_are_turned_in_all_ways_and_do_the_task() -> None:
    limit = 3.6  # more than half a turn, so that some angles are there twice
    ways, places = [Z, Y, Y, X, Y, X], [(0, 0, 0.4), (0.1, 0, 0.4), (0.1, 0, 0.9), *[(0.4, 0, 1.0)] * 3]
    machine = arm(ways, places, np.array((0.5, 0, 1.0)), limit=limit)
    at, turn = poses(machine, np.array([[3.4, 0.4, 0.9, -3.3, 0.7, 0.3]]))
    for rolls, told in ((1, {"orientation": turn[0]}), (12, {"direction": 2.0 * turn[0, :, 2]})):
        equations = bind(machine, TipTask(position=at[0], **told))
        branches = ik_branches(equations, machine.robot.lower, machine.robot.upper)
        assert branches is not None
        target = np.array(equations.target_function()(0.0)).ravel()
        found = branches.configurations(target, rolls).joints
        assert (np.abs(found) <= limit + 1e-9).all()
        assert max(np.abs(equations.errors(0.0, None, one)).max() for one in found) < 1e-9
        wrapped = np.remainder(found.round(6), round(TURN, 6))
        same = [(apart(one, found, slice(None)) < 1e-5).sum() for one in found]
        twice = 2 ** (np.abs(found) > TURN - limit).sum(axis=1)
        assert same == twice.tolist(), wrapped
        if rolls == 1:
            assert np.abs(found - [3.4, 0.4, 0.9, -3.3, 0.7, 0.3]).max(axis=1).min() < 1e-7


def test_branches_of_a_scara_and_none_of_what_is_not_one_pose() -> None:
    machine = arm(
        [Z] * 4, [(0, 0, 0), (0.3, 0, 0), (0.5, 0, 0), (0.5, 0, 0.1)], np.array((0.6, 0, 0)), prismatic=(3,), limit=3.0
    )
    told = (machine.robot.lower, machine.robot.upper)
    for rows, orientation in (((3, 4, 5), None), ((2, 3, 4, 5), [np.cos(0.3), 0, 0, np.sin(0.3)])):
        task = TipTask(position=(0.35, 0.1, 0.05), orientation=orientation, rows=rows)
        equations = bind(machine, task)
        branches = ik_branches(equations, *told)
        assert branches is not None
        found = branches.configurations(np.array(equations.target_function()(0.0)).ravel(), 16).joints
        assert len(found) == (2 if orientation else len(found))
        assert len(found) >= 2
        assert max(np.abs(equations.errors(0.0, None, one)).max() for one in found) < 1e-9
    place = np.array([0.4, 0.1, 0.3])
    arm_of_six = ur5()
    for other in (TipTask(orientation=np.eye(3)), TipTask(position=place, orientation=np.eye(3), rows=[0, 1, 2, 3, 4])):
        assert ik_branches(bind(arm_of_six, other), arm_of_six.robot.lower, arm_of_six.robot.upper) is None
