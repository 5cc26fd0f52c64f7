"""Robots of public URDF files agree with Pinocchio."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pinocchio
import pytest

from models import (
    FreeFloating,
    ModelWarning,
    Robot,
    base_reaction,
    center_of_mass,
    center_of_mass_jacobian,
    frame_jacobian,
    inverse_dynamics,
    link_frames,
    link_jacobians,
    momentum_matrix,
    simplify,
    tip_jacobian,
    tip_pose,
)
from tests.families import some
from tests.models.robot.pinocchio_robots import ROBOTS, Peer, State, collection, random_state, swapped, urdf_file
from tests.models.robot.trees import Array, assert_same_robot, everything, numeric, refused, ties, untied

pytestmark = pytest.mark.xdist_group("real robots")

COUNT = 100
RELATIVE = 1e-10


class Case(NamedTuple):
    robot: Robot
    peer: Peer
    states: list[State]


@pytest.fixture(scope="module", params=ROBOTS)
def case(request: pytest.FixtureRequest) -> Case:
    package, ending, options = ROBOTS[request.param]
    path = urdf_file(package, ending)
    robot = Robot.from_urdf(path, **options)
    rng = np.random.default_rng(sum(map(ord, request.param)))
    return Case(robot, Peer.of(path, robot), [random_state(robot, rng) for _ in range(COUNT)])


def mapped(outputs: list[Any], inputs: list[Any], values: list[list[Any]]) -> list[list[Array]]:
    """The outputs at all states, by one call of a mapped function. One list for each state."""
    function = ca.Function("f", inputs, [ca.densify(each) for each in outputs])
    columns = [ca.DM(np.array(column).reshape(len(values), -1).T) for column in zip(*values, strict=True)]
    matches = [np.array(each) for each in function.map(len(values)).call(columns)]
    split = [np.hsplit(each, len(values)) for each in matches]
    return [list(each) for each in zip(*split, strict=True)]


def assert_close(result: Array, expected: Array) -> None:
    """To 1e-10 of the greatest entry."""
    expected = np.asarray(expected)
    scale = float(np.abs(expected).max(initial=0.0))
    np.testing.assert_allclose(result.reshape(expected.shape), expected, rtol=0, atol=RELATIVE * scale)


REFUSED = {
    "ur3.urdf": "the robot '' has no <link>",
    "alex_psyonic_hands.urdf": "joint 'Left_index_q2': mimicked joint 'index_q1' does not exist",
}
"""Of the collection: an empty file, which Pinocchio refuses too, and one whose followers' leaders have other names."""


def read(path: Path) -> Robot:
    """Without a keyword, whatever is said of it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return Robot.from_urdf(path)


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_describe_no_robot_are_refused_by_name(name: str) -> None:
    (path,) = (path for path in collection() if path.name == name)
    with refused(REFUSED[name]):
        read(path)


COUPLED = ("panda", "panda_collision", "baxter", "pr2", "tiago_pro")
"""Robots whose followers Pinocchio couples; of others it reads the follower first, and refuses it."""
LOADED = [path for path in collection() if path.name not in REFUSED]


def test_all_files_of_the_collection_but_two_are_read() -> None:
    assert (len(collection()), len(LOADED)) == (69, 67)


@pytest.mark.parametrize("path", some(LOADED, 12), ids=lambda path: f"{path.parts[-3]}/{path.name}")
def test_every_robot_of_the_collection_moves_and_weighs_as_pinocchio_says(path: Path) -> None:
    """Frames, inertia of the robot on a free base in the axes of that base, torques on a fixed one; followers coupled.

    Those of Pinocchio are its own where it couples them, else its robot without ties is restricted to them. And a robot
    that is written and read again is the same.
    """
    robot, rng = read(path), np.random.default_rng(len(path.name))
    peers = [(Peer.of(path, untied(robot)), *ties(robot))]
    if path.stem in COUPLED:
        peers.append((Peer.of(path, robot), np.eye(robot.dof), np.zeros(robot.dof)))
    for _ in range(5):
        state = replace(random_state(robot, rng), rotation=np.eye(3), position=np.zeros(3))
        still = replace(state, base_twist=np.zeros(6), base_acceleration=np.zeros(6))
        frames, locked, coupling, mass, torques = map(numeric, everything(robot)(state.q, state.qd, state.qdd))
        for peer, A, b in peers:
            model, data, index = peer.model, peer.data, bodies(peer)
            motion = replace(still, q=A @ state.q + b, qd=A @ state.qd, qdd=A @ state.qdd)
            configuration = peer.configuration(motion)
            pinocchio.framesForwardKinematics(model, data, configuration)
            places = [data.oMf[index[link.name]] for link in robot.links]
            assert_close(frames, np.vstack([np.column_stack([place.rotation, place.translation]) for place in places]))
            inertia = pinocchio.crba(model, data, configuration)
            inertia = np.triu(inertia) + np.triu(inertia, 1).T
            of_ours = np.zeros((model.nv, 6 + robot.dof))
            of_ours[[3, 4, 5, 0, 1, 2], range(6)] = 1.0
            of_ours[peer.columns, 6:] = A
            assert_close(np.block([[locked, coupling], [coupling.T, mass]]), of_ours.T @ inertia @ of_ours)
            efforts = pinocchio.rnea(model, data, configuration, peer.velocity(motion), peer.acceleration(motion))
            assert_close(torques, A.T @ efforts[peer.columns])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        assert_same_robot(robot, Robot.from_urdf(robot.to_urdf()), rng)


def bodies(peer: Peer) -> dict[str, int]:
    """Pinocchio's frames of links, by name."""
    links = {link.name for link in peer.robot.links}
    frames = enumerate(peer.model.frames)
    return {f.name: i for i, f in frames if f.type == pinocchio.FrameType.BODY and f.name in links}


def test_links_joints_masses_and_limits_are_those_of_pinocchio(case: Case) -> None:
    robot, model = case.robot, case.peer.model
    assert bodies(case.peer).keys() == {link.name for link in robot.links}
    assert sorted(robot.joint_names) == sorted(list(model.names)[2:])
    assert_close(np.array(robot.total_mass), pinocchio.computeTotalMass(model))
    for joint in robot.moving_joints:
        theirs = model.joints[model.getJointId(joint.name)]
        if np.isfinite(joint.lower) or np.isfinite(joint.upper):
            assert model.lowerPositionLimit[theirs.idx_q] == joint.lower
            assert model.upperPositionLimit[theirs.idx_q] == joint.upper
        if np.isfinite(joint.velocity):
            assert model.velocityLimit[theirs.idx_v] == joint.velocity
            assert model.effortLimit[theirs.idx_v] == joint.effort


def test_frames_and_jacobians_of_all_links_and_of_the_tip(case: Case) -> None:
    robot, peer = case.robot, case.peer
    q, position, turn = ca.SX.sym("q", robot.dof), ca.SX.sym("p", 3), ca.SX.sym("R", 3, 3)
    frames, jacobians = link_frames(robot, q, (turn, position)), link_jacobians(robot, q, (turn, position))
    pose = tip_pose(robot, q, (turn, position))
    outputs = [ca.vertcat(*(ca.horzcat(*frame) for frame in frames.values())), ca.vertcat(*jacobians.values())]
    outputs += [tip_jacobian(robot, q, (turn, position)), ca.horzcat(*pose)]
    values = [[s.q, s.position, s.rotation.T] for s in case.states]  # the matrix is given column by column
    index = bodies(peer)
    for state, (places, motions, tip, tip_place) in zip(
        case.states, mapped(outputs, [q, position, ca.vec(turn)], values), strict=True
    ):
        pinocchio.computeJointJacobians(peer.model, peer.data, peer.configuration(state))
        pinocchio.updateFramePlacements(peer.model, peer.data)
        expected_places, expected_motions = [], {}
        for name in frames:
            place = peer.data.oMf[index[name]]
            expected_places.append(np.column_stack([place.rotation, place.translation]))
            local = pinocchio.getFrameJacobian(
                peer.model, peer.data, index[name], pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )
            expected_motions[name] = swapped(local)[:, peer.columns]
        assert_close(places, np.vstack(expected_places))
        assert_close(motions, np.vstack(list(expected_motions.values())))
        assert_close(tip, expected_motions[robot.tip_link])
        assert_close(tip_place, expected_places[list(frames).index(robot.tip_link)])


def test_centre_of_mass_and_centroidal_momentum(case: Case) -> None:
    """Of the floating robot: matrices of (18) and (24), moved to the centre of mass."""
    robot, peer = case.robot, case.peer
    machine = FreeFloating(robot)
    base, q = ca.SX.sym("base", 7), ca.SX.sym("q", robot.dof)
    frame = machine.world_from_base(base)
    center = center_of_mass(robot, q, frame)
    locked, joints = machine.momentum_matrices(base, q)
    outputs = [locked, joints, center, center_of_mass_jacobian(robot, q, frame), momentum_matrix(robot, q, frame)]
    values = [[s.base, s.q] for s in case.states]
    for state, result in zip(case.states, mapped(outputs, [base, q], values), strict=True):
        configuration = peer.configuration(state)
        about = swapped(pinocchio.computeCentroidalMap(peer.model, peer.data, configuration))
        middle = pinocchio.centerOfMass(peer.model, peer.data, configuration)
        motion = pinocchio.jacobianCenterOfMass(peer.model, peer.data, configuration)
        assert_close(result[2], middle)
        assert_close(result[3], motion[:, peer.columns])
        assert_close(result[4], result[1])
        to_center = np.eye(6)
        to_center[:3, 3:] = np.cross(np.eye(3), middle).T  # L_c = L - c x P
        for ours, theirs in zip(result[:2], peer.in_our_columns(about, state), strict=True):
            assert_close(to_center @ ours, theirs)
        momentum = pinocchio.computeCentroidalMomentum(peer.model, peer.data, configuration, peer.velocity(state))
        assert_close(to_center @ (result[0] @ state.base_twist + result[1] @ state.qd), swapped(momentum.vector))


@pytest.mark.parametrize("fewer", [False, True], ids=["as given", "simplified"])
def test_generalized_jacobian_from_the_joint_space_inertia(case: Case, fewer: bool) -> None:
    """G = J_q - J_b M_bb^-1 M_bq, and the base's twist -M_bb^-1 M_bq q'."""
    robot, peer = case.robot, case.peer
    machine = FreeFloating(simplify(robot) if fewer else robot)
    base, q, rates = ca.SX.sym("base", 7), ca.SX.sym("q", robot.dof), ca.SX.sym("rates", robot.dof)
    outputs = [machine.tip_jacobian(base, q), machine.base_twist(base, q, rates), machine.tip_twist(base, q, rates)]
    values = [[s.base, s.q, s.qd] for s in case.states]
    tip = bodies(peer)[robot.tip_link]
    for state, result in zip(case.states, mapped(outputs, [base, q, rates], values), strict=True):
        configuration = peer.configuration(state)
        inertia = pinocchio.crba(peer.model, peer.data, configuration)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        pinocchio.computeJointJacobians(peer.model, peer.data, configuration)
        pinocchio.updateFramePlacements(peer.model, peer.data)
        world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = swapped(pinocchio.getFrameJacobian(peer.model, peer.data, tip, world))
        reaction = -np.linalg.solve(inertia[:6, :6], inertia[:6, peer.columns])
        expected = jacobian[:, peer.columns] + jacobian[:, :6] @ reaction
        turning = np.linalg.inv(peer.base_columns(state)) @ reaction @ state.qd
        assert_close(result[0], expected)
        assert_close(result[1], turning)
        assert_close(result[2], expected @ state.qd)


def test_inverse_dynamics_on_a_fixed_and_on_a_moving_base(case: Case) -> None:
    robot, peer = case.robot, case.peer
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    position, turn = ca.SX.sym("p", 3), ca.SX.sym("R", 3, 3)
    twist, push = ca.SX.sym("twist", 6), ca.SX.sym("push", 6)
    place, moving = (turn, position), {"base_twist": twist, "base_acceleration": push}
    outputs = [
        inverse_dynamics(robot, q, qd, qdd, world_from_base=place),
        inverse_dynamics(robot, q, qd, qdd, world_from_base=place, **moving),
        base_reaction(robot, q, qd, qdd, world_from_base=place, **moving),
    ]
    inputs = [q, qd, qdd, position, ca.vec(turn), twist, push]
    values = [[s.q, s.qd, s.qdd, s.position, s.rotation.T, s.base_twist, s.base_acceleration] for s in case.states]
    peer.model.gravity.linear = np.array([0.0, 0.0, -9.81])
    for state, result in zip(case.states, mapped(outputs, inputs, values), strict=True):
        configuration, velocity = peer.configuration(state), peer.velocity(state)
        acceleration = peer.acceleration(state)
        efforts = pinocchio.rnea(peer.model, peer.data, configuration, velocity, acceleration).copy()
        drive = peer.base_columns(state).T @ efforts[:6]  # about the root frame's origin
        drive[:3] += np.cross(state.position, drive[3:])
        assert_close(result[1], efforts[peer.columns])
        assert_close(result[2], drive)
        velocity[:6] = acceleration[:6] = 0.0
        efforts = pinocchio.rnea(peer.model, peer.data, configuration, velocity, acceleration)
        assert_close(result[0], efforts[peer.columns])


def test_single_frames_and_numbers_do_as_well_as_all_of_them(case: Case) -> None:
    robot, state = case.robot, case.states[0]
    all_of_them = link_jacobians(robot, state.q)
    for link in (robot.root, robot.tip_link, robot.links[-1].name):
        assert_close(numeric(frame_jacobian(robot, state.q, link)), numeric(all_of_them[link]))
