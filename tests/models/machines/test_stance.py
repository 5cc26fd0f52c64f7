"""Stances: motion does not depend on the root link, and the loads of the feet satisfy Newton-Euler."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import Foot, Foothold, ModelError, Stance, Standing, Support, Wrench, inverse_dynamics, rectangle, reroot
from models.robot.dynamics import base_reaction
from scripts.robots.robots import TALOS
from scripts.robots.steps import SIDES, planar_biped, planar_feet
from scripts.robots.talos import HELD, talos_steps
from tests.models.robot.trees import Array, link_twist, numeric, numeric_poses, random_frame, random_robot

few = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 2**32 - 1)


@pytest.mark.long
@given(seeds, st.integers(2, 8))
@few
def test_a_robot_bears_the_same_whatever_link_it_is_rooted_at(seed: int, size: int) -> None:
    """Fastened at one link, and rooted at another that moves as it does: same torques, and nothing to hold there."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    root = robot.links[int(rng.integers(len(robot.links)))].name
    turned = reroot(robot, root)
    order = [robot.joint_names.index(name) for name in turned.joint_names]
    q, qd, qdd = rng.normal(size=(3, robot.dof))
    place = random_frame(rng)
    torques = numeric(inverse_dynamics(robot, q, qd, qdd, world_from_base=place)).ravel()
    held = numeric(base_reaction(robot, q, qd, qdd, world_from_base=place)).ravel()
    base_motion = link_twist(robot, root, (q, qd, qdd), place, np.zeros(3))
    frame = numeric_poses(robot, q, place)[root]
    at_old = Wrench(robot.root, held[3:], held[:3] - np.cross(place[1], held[3:]))
    moving: dict[str, Any] = {"world_from_base": frame, "base_motion": base_motion}
    scale = max(1.0, np.abs(held).max(), np.abs(torques).max())
    again = numeric(inverse_dynamics(turned, q[order], qd[order], qdd[order], wrenches=[at_old], **moving)).ravel()
    np.testing.assert_allclose(again, torques[order], rtol=0, atol=1e-9 * scale)
    left = numeric(base_reaction(turned, q[order], qd[order], qdd[order], wrenches=[at_old], **moving)).ravel()
    np.testing.assert_allclose(left, 0, rtol=0, atol=1e-9 * scale)


def random_loads(rng: np.random.Generator, stance: Stance) -> dict[str, Array]:
    return {
        name: numeric(stance.full_load(name, rng.normal(size=len(stance.load_rows[name]))))
        for name in stance.other_feet
    }


@pytest.mark.parametrize("held", [("left",), ("right",), ("left", "right"), ("right", "left")])
def test_the_feet_bear_the_rate_of_momentum_that_pinocchio_finds(held: tuple[str, ...]) -> None:
    """TALOS from its file, floating, against the robot rooted at a foot: the pelvis moves as the stance moves it."""
    rng = np.random.default_rng(len(held[0]) + len(held))
    steps = talos_steps(1, 1.0, 1.0)
    footholds = {name: Foothold.level(rng.normal(), rng.normal(), rng.normal()) for name in held}
    stance = Stance.on(steps.robot, steps.feet, footholds)
    model = pinocchio.buildModelFromUrdf(str(TALOS.path), pinocchio.JointModelFreeFlyer())
    data = model.createData()
    for _ in range(3):
        q, qd, qdd = rng.normal(size=(3, stance.joint_size))
        loads = stance.loads(q, qd, qdd, random_loads(rng, stance))
        turn, position = numeric_poses(stance.robot, q, stance.world_from_base())[steps.robot.root]
        motion = (q, qd, qdd)
        twist, rate = link_twist(stance.robot, steps.robot.root, motion, stance.world_from_base(), np.zeros(3))
        spin, speed, change, push = twist[:3], turn.T @ twist[3:], rate[:3], rate[3:]
        configuration, v, a = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        configuration[:3] = position
        configuration[3:7] = pinocchio.Quaternion(turn).coeffs()
        v[:6] = np.concatenate([speed, turn.T @ spin])
        a[:6] = np.concatenate([turn.T @ push - np.cross(turn.T @ spin, speed), turn.T @ change])
        whole = {joint.name: joint for joint in steps.robot.joints}
        for name in model.names[2:]:
            index = model.joints[model.getJointId(name)]
            if whole[name].moves:
                at = stance.robot.joint_names.index(name)
                configuration[index.idx_q], v[index.idx_v], a[index.idx_v] = q[at], qd[at], qdd[at]
            else:
                configuration[index.idx_q] = HELD.get(name, 0.0)
        pinocchio.computeCentroidalMomentumTimeVariation(model, data, configuration, v, a)
        center = data.com[0]
        force, moment = np.zeros(3), np.zeros(3)
        for name, load in loads.items():
            twisting, pushing = np.split(numeric(load).ravel(), 2)
            place = numeric(stance.sole_frame(name, q).position).ravel()
            force, moment = force + pushing, moment + twisting + np.cross(place - center, pushing)
        scale = stance.weight + np.abs(np.array(data.dhg.linear)).max()
        np.testing.assert_allclose(force - [0, 0, stance.weight], data.dhg.linear, rtol=0, atol=1e-8 * scale)
        np.testing.assert_allclose(moment, data.dhg.angular, rtol=0, atol=1e-8 * scale)


def test_one_foot_is_a_standing_machine() -> None:
    """On one sole: same zero moment point, torques and margin as a Standing machine of the same robot and sole."""
    rng = np.random.default_rng(0)
    robot, feet = planar_biped(), planar_feet()
    stance = Stance.on(robot, feet, {"left": Foothold.level(0.3, 0.0)})
    assert isinstance(feet["left"].sole, Support)
    sole = rectangle((0.22, 0.44), (-0.05, 0.05))
    standing = Standing(stance.robot, support=sole, translation=stance.translation, rotation=stance.rotation)
    q, qd, qdd = rng.normal(size=(3, 6))
    loads = stance.loads(q, qd, qdd, {})
    np.testing.assert_allclose(
        numeric(stance.zero_moment_point(loads)), numeric(standing.zero_moment_point(q, qd, qdd)), atol=1e-10
    )
    torques = numeric(standing.joint_torques(q, qd, qdd))
    np.testing.assert_allclose(numeric(stance.joint_torques(q, qd, qdd, {})), torques, atol=1e-9)
    pressed = float(stance.pressure("left", loads["left"]))
    rows = numeric(stance.edge_moments("left", loads["left"])).ravel() / pressed
    assert len(rows) == 2  # no motion brings it nearer to the sides
    distances = numeric(sole.distances(standing.zero_moment_point(q, qd, qdd))).ravel()
    np.testing.assert_allclose(sorted(rows), sorted(distances[np.abs(sole.normals[:, 0]) > 0.5]), atol=1e-9)


def test_at_rest_the_center_of_pressure_is_under_the_center_of_mass() -> None:
    rng = np.random.default_rng(1)
    steps = talos_steps(1, 1.0, 1.0)
    rest = np.zeros(12)
    for name in SIDES:
        stance = Stance.on(steps.robot, steps.feet, {name: Foothold.level(0.4, -0.2, heading=0.7, height=0.1)})
        for _ in range(2):
            q = rng.normal(size=12)
            loads = stance.loads(q, rest, rest, {})
            under = numeric(stance.center_of_mass(q)).ravel()[:2]
            np.testing.assert_allclose(numeric(stance.zero_moment_point(loads)).ravel(), under, rtol=0, atol=1e-9)
            assert stance.support is not None
            inside = numeric(stance.edge_moments(name, loads[name])).ravel() / stance.weight
            np.testing.assert_allclose(inside.min(), float(stance.support.margin(under)), atol=1e-9)
            assert float(stance.friction_margin(name, loads[name], 0.5)) == pytest.approx((0.5 * stance.weight) ** 2)


def test_loads_of_a_sole_do_not_depend_on_its_pose() -> None:
    """A foothold and its load moved and turned together: same pressure, same rooms at the edges and in friction."""
    rng = np.random.default_rng(2)
    steps = talos_steps(1, 1.0, 1.0)
    moment, force = rng.normal(size=3), rng.normal(size=3) + np.array([0.0, 0.0, 5.0])
    results = []
    for turn, place in ((np.eye(3), np.zeros(3)), random_frame(rng)):
        stance = Stance.on(steps.robot, steps.feet, {"left": Foothold(place, turn)})
        load = ca.DM(np.concatenate([turn @ moment, turn @ force]))
        parts = (
            stance.pressure("left", load),
            stance.edge_moments("left", load, 0.01),
            stance.friction_margin("left", load, 0.7),
        )
        results.append(np.concatenate([numeric(part).ravel() for part in parts]))
    np.testing.assert_allclose(results[1], results[0], rtol=0, atol=1e-9)
    assert len(results[0]) == 6  # a rectangle has four edges


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_a_sole_slips_at_friction_times_load_and_turns_at_two_thirds_of_the_radius_of_its_circle(
    friction: float,
) -> None:
    """The circle's middle is that of the sole, which is not its origin; both together take shares as of an ellipse."""
    sole = rectangle((-0.1, 0.3), (-0.05, 0.15))  # middle at (0.1, 0.05), radius 0.1
    feet = {name: Foot(f"{name}_foot", sole, (0, 0, -0.08)) for name in SIDES}
    stance = Stance.on(planar_biped(), feet, {"left": Foothold.level(0.0, 0.0, heading=0.4)})
    turn = np.asarray(stance.footholds["left"].rotation)
    pressed, most = 500.0, friction * 500.0
    middle, heaviest = np.array([0.1, 0.05, 0.0]), 2 / 3 * 0.1 * most
    for share, along in ((0.0, 0.3), (0.6, -1.2), (1.0, 2.0)):
        force = np.array([share * most * np.cos(along), share * most * np.sin(along), pressed])
        twist = np.array([0.0, 0.0, np.sqrt(1 - share**2) * heaviest])
        for factor, sign in ((1 - 1e-6, 1), (1 + 1e-6, -1)):
            side = force * [factor, factor, 1]
            load = np.concatenate([turn @ (factor * twist + np.cross(middle, side)), turn @ side])
            assert sign * float(stance.friction_margin("left", ca.DM(load), friction)) > 0


@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_a_sole_tips_about_the_edge_that_the_center_of_pressure_leaves(margin: float) -> None:
    """Room at an edge is its distance from the center of pressure, less the margin, times the pressure."""
    steps = talos_steps(1, 1.0, 1.0)
    stance = Stance.on(steps.robot, steps.feet, {"right": Foothold.level(0.2, 0.1, heading=0.3)})
    sole = steps.feet["right"].sole
    assert sole is not None
    turn = np.asarray(stance.footholds["right"].rotation)
    (left, low), (right, high) = (np.asarray(sole.vertices).min(axis=0), np.asarray(sole.vertices).max(axis=0))
    for x, y in ((0.02, -0.01), (right + 0.01, low), (left, high - 0.03)):
        force = np.array([30.0, -20.0, 400.0])
        load = np.concatenate([turn @ np.cross([x, y, 0.0], force), turn @ force])
        rooms = np.sort(numeric(stance.edge_moments("right", ca.DM(load), margin)).ravel())
        expected = 400.0 * (np.array([x - left, right - x, y - low, high - y]) - margin)
        np.testing.assert_allclose(rooms, np.sort(expected), atol=1e-9)


def test_the_hull_of_the_soles_contains_exactly_the_shared_pressure_centers() -> None:
    """A vertical load anywhere in the hull is shared by points of the soles; outside of it by none."""
    feet = planar_feet()
    footholds = {"left": Foothold.level(0.0, 0.0), "right": Foothold.level(0.5, 0.0)}
    stance = Stance.on(planar_biped(), feet, footholds)
    assert stance.support is not None
    np.testing.assert_allclose(np.asarray(stance.support.vertices).min(axis=0), [-0.08, -0.05])
    np.testing.assert_allclose(np.asarray(stance.support.vertices).max(axis=0), [0.64, 0.05])
    for at, expected in ((-0.09, False), (-0.07, True), (0.3, True), (0.63, True), (0.65, False)):
        shares = ca.SX.sym("shares", 2)  # load of the right foot: moment about y and force
        right = stance.full_load("right", ca.vertcat(shares[0], 0, shares[1]))
        left = ca.vertcat(0, -at, 0, 0, 0, 1) - ca.vertcat(0, shares[0] - 0.5 * shares[1], 0, 0, 0, shares[1])
        rows = [
            part for name, load in (("left", left), ("right", right)) for part in (stance.edge_moments(name, load),)
        ]
        values = ca.vertcat(*rows, left[5], right[5])
        problem = {"h": ca.Sparsity(2, 2), "a": ca.jacobian(values, shares).sparsity()}
        solver = ca.conic("share", "highs", problem, {"error_on_fail": False, "highs": {"output_flag": False}})
        constant = ca.Function("at", [shares], [values])([0, 0])
        solver(a=ca.evalf(ca.jacobian(values, shares)), lba=-constant, lbx=-10, ubx=10)
        assert solver.stats()["success"] is expected


def test_supports_without_area_are_refused_by_name() -> None:
    robot, feet = planar_biped(), planar_feet()
    with pytest.raises(ModelError, match="no footholds"):
        Stance.on(robot, feet, {})
    with pytest.raises(ModelError, match="'lefd' does not exist; did you mean 'left'"):
        Stance.on(robot, feet, {"lefd": Foothold.level(0, 0)})
    with pytest.raises(ModelError, match="is two feet"):
        Stance.on(robot, {**feet, "again": feet["left"]}, {"left": Foothold.level(0, 0)})
    both = Stance.on(robot, feet, {name: Foothold.level(0, 0) for name in SIDES})
    with pytest.raises(ModelError, match=r"loads of the feet \['right'\] are needed"):
        both.loads(np.zeros(6), np.zeros(6), np.zeros(6), {})
    aside = {name: Foot(f"{name}_foot", rectangle((-0.1, 0.1), (0.1, 0.2)), (0, 0, -0.08)) for name in SIDES}
    stance = Stance.on(robot, aside, {"left": Foothold.level(0, 0)})
    with pytest.raises(ModelError, match="beyond an edge of the sole") as refusal:
        stance.edge_moments("left", ca.DM([0, 0, 0, 0, 0, 1]), 0.03)
    assert refusal.value.value == pytest.approx(0.13)  # the edge is 0.1 m aside
    askew = Stance.on(robot, feet, {name: Foothold.level(0, 0, heading=0.5) for name in SIDES})
    with pytest.raises(ModelError, match="not along axes of the world"):
        _ = askew.load_rows
