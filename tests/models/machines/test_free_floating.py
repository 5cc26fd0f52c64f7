from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from models import (
    FreeFloating,
    Joint,
    Link,
    ModelError,
    Robot,
    center_of_mass,
    link_frames,
    paper_example,
    planar_chain,
)
from models.machines.free_floating import PLANAR_ROWS
from models.machines.machine import with_tip
from models.spatial import Frame, solve_spd
from scripts.papers.free_floating.virtual_chain import VirtualChain
from tests.models.robot.pinocchio_robots import ROBOTS, Peer, random_state, swapped, urdf_file
from tests.models.robot.trees import (
    Array,
    Base,
    few,
    momentum_by_differences,
    momentum_by_differentiation,
    numeric,
    numeric_poses,
    random_base,
    random_robot,
    seeds,
    twist_by_differentiation,
)

sizes = st.integers(1, 7)
bases = st.sampled_from(["planar", "spatial"])


def random_machine(rng: np.random.Generator, size: int, base: Base) -> FreeFloating:
    return FreeFloating(random_robot(rng, size, base), base)


def poses_at(machine: FreeFloating, base: Array, q: Array) -> dict[str, tuple[Array, Array]]:
    return numeric_poses(machine.robot, q, tuple(map(numeric, machine.world_from_base(base))))


class Motion:
    """Smooth joint motion q(t) with its exact rates, and the base that floats along."""

    def __init__(self, machine: FreeFloating, rng: np.random.Generator) -> None:
        count = machine.joint_size
        self.machine = machine
        self.center, self.phase = rng.normal(size=count), rng.uniform(0, 6, size=count)
        self.amplitude, self.frequency = rng.uniform(0.3, 1.0, size=count), rng.uniform(1.0, 3.0, size=count)
        base, q, rates = (
            ca.SX.sym(name, size) for name, size in (("b", machine.base_size), ("q", count), ("r", count))
        )
        self._rate = ca.Function("rate", [base, q, rates], [machine.base_rate(base, q, rates)])

    def joints(self, time: float) -> Array:
        return self.center + self.amplitude * np.sin(self.frequency * time + self.phase)

    def joint_rates(self, time: float) -> Array:
        return self.amplitude * self.frequency * np.cos(self.frequency * time + self.phase)

    def base_rate(self, time: float, base: Array) -> Array:
        return numeric(self._rate(base, self.joints(time), self.joint_rates(time))).ravel()

    def base(self, start: Array, begin: float, end: float) -> Array:
        if begin == end:
            return start
        solution = solve_ivp(self.base_rate, (begin, end), start, method="DOP853", rtol=1e-12, atol=1e-12)
        end_state: Array = solution.y[:, -1]
        return end_state


@few
@given(seeds, sizes, bases)
def test_momentum_is_the_sum_over_the_links_of_differentiated_frames(seed: int, size: int, base: Base) -> None:
    """E1 and E2 against sum(c x m c' + R I R^T omega) and sum(m c'), by differentiated frames."""
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    x = ca.SX.sym("x", machine.base_size + machine.joint_size)
    dx = ca.SX.sym("dx", x.numel())
    place, q = ca.vertsplit(x, [0, machine.base_size, x.numel()])
    place_rate, q_rate = ca.vertsplit(dx, [0, machine.base_size, x.numel()])
    frames = link_frames(machine.robot, q, machine.world_from_base(place))
    expected = momentum_by_differentiation(machine.robot, frames, x, dx)[machine.twist_rows]
    found = machine.momentum_residual(place, q, place_rate, q_rate)
    locked, joints = machine.momentum_matrices(place, q)
    by_matrices = ca.mtimes(locked, machine.twist_of_rate(place, place_rate)) + ca.mtimes(joints, q_rate)
    errors = ca.Function("f", [x, dx], [found - expected, by_matrices - expected])
    point = np.concatenate([random_base(rng, base), rng.normal(size=machine.joint_size)])
    for error in errors(point, rng.normal(size=x.numel())):
        np.testing.assert_allclose(numeric(error), 0, atol=1e-10)


@few
@given(seeds, sizes, bases)
def test_jacobians_are_the_derivative_of_the_tip_by_base_and_joints(seed: int, size: int, base: Base) -> None:
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    x = ca.SX.sym("x", machine.base_size + machine.joint_size)
    dx = ca.SX.sym("dx", x.numel())
    place, q = ca.vertsplit(x, [0, machine.base_size, x.numel()])
    place_rate, q_rate = ca.vertsplit(dx, [0, machine.base_size, x.numel()])
    tip = machine.tip_pose(place, q)
    by_base, by_joints = machine.jacobians(place, q)
    found = ca.mtimes(by_base, machine.twist_of_rate(place, place_rate)) + ca.mtimes(by_joints, q_rate)
    error = ca.Function("f", [x, dx], [found - twist_by_differentiation(tip.rotation, tip.position, x, dx)])
    point = np.concatenate([random_base(rng, base), rng.normal(size=machine.joint_size)])
    np.testing.assert_allclose(numeric(error(point, rng.normal(size=x.numel()))), 0, atol=1e-11)


@few
@given(seeds, sizes, bases)
def test_generalized_jacobian_is_the_papers_formula(seed: int, size: int, base: Base) -> None:
    """The elimination about the centre of mass against (24) and (25) as printed, solved by numpy."""
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    place, q = random_base(rng, base), rng.normal(size=machine.joint_size)
    e1, e2 = map(numeric, machine.momentum_matrices(place, q))
    f1, f2 = map(numeric, machine.jacobians(place, q))
    reaction = -np.linalg.solve(e1, e2)
    rates = rng.normal(size=machine.joint_size)
    np.testing.assert_allclose(numeric(machine.tip_jacobian(place, q)), f2 + f1 @ reaction, atol=1e-9)
    np.testing.assert_allclose(
        numeric(machine.tip_twist(place, q, rates)).ravel(), (f2 + f1 @ reaction) @ rates, atol=1e-9
    )
    np.testing.assert_allclose(numeric(machine.base_twist(place, q, rates)).ravel(), reaction @ rates, atol=1e-9)


@few
@given(seeds, sizes, bases)
def test_the_base_reacts_so_that_the_momentum_is_zero(seed: int, size: int, base: Base) -> None:
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    place, q, rates = random_base(rng, base), *rng.normal(size=(2, machine.joint_size))
    rate = machine.base_rate(place, q, rates)
    np.testing.assert_allclose(numeric(machine.momentum_residual(place, q, rate, rates)), 0, atol=1e-11)
    np.testing.assert_allclose(
        numeric(machine.momentum(place, q, machine.base_twist(place, q, rates), rates)), 0, atol=1e-11
    )
    if base == "spatial":
        assert abs(float(ca.dot(rate[3:7], place[3:7]))) < 1e-13 * (1 + np.abs(numeric(rate)).max())


@settings(max_examples=12)
@given(seeds, st.integers(2, 6), bases)
def test_momentum_is_conserved_along_an_integrated_motion(seed: int, size: int, base: Base) -> None:
    """Centre of mass, momentum by finite differences of the link poses, quaternion norm, over 2 s."""
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    motion, start, step = Motion(machine, rng), random_base(rng, base), 2e-3
    robot, place, time = machine.robot, start, 0.0
    center = numeric(center_of_mass(robot, motion.joints(0.0), machine.world_from_base(start)))
    for end in (0.7, 1.3, 2.0):
        place, time = motion.base(place, time, end), end
        world_from_base = machine.world_from_base(place)
        moved = numeric(center_of_mass(robot, motion.joints(time), world_from_base))
        np.testing.assert_allclose(moved, center, atol=1e-9)
        near = [
            poses_at(machine, motion.base(place, time, time + k * step), motion.joints(time + k * step))
            for k in range(-2, 3)
        ]
        momentum = momentum_by_differences(robot, near, step)
        np.testing.assert_allclose(momentum[machine.twist_rows], 0, atol=1e-7)
        if base == "spatial":
            assert np.linalg.norm(place[3:]) == pytest.approx(1.0, abs=1e-10)


@settings(max_examples=20)
@given(seeds, sizes, bases)
def test_generalized_jacobian_agrees_with_finite_differences_of_the_tip(seed: int, size: int, base: Base) -> None:
    """The tip is moved by integrating base and joints together; its own displacement gives its velocity."""
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    motion, place, time, step = Motion(machine, rng), random_base(rng, base), 0.4, 1e-3
    tips: list[Frame] = []
    for k in (-2, -1, 1, 2):
        moved = motion.base(place, time, time + k * step)
        tips.append(machine.tip_pose(moved, motion.joints(time + k * step)))
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12 * step)
    speed = sum(w * numeric(tip.position).ravel() for w, tip in zip(weights, tips, strict=True))
    turning = sum(w * numeric(tip.rotation) for w, tip in zip(weights, tips, strict=True))
    here = machine.tip_pose(place, motion.joints(time))
    turning = turning @ numeric(here.rotation).T
    found = numeric(machine.tip_jacobian(place, motion.joints(time))) @ motion.joint_rates(time)
    np.testing.assert_allclose(found, [turning[2, 1], turning[0, 2], turning[1, 0], *speed], atol=1e-8)


@few
@given(seeds, sizes)
def test_a_planar_machine_is_a_spatial_one_with_parallel_axes(seed: int, size: int) -> None:
    """Where the inertia does not couple the plane with the rest, both give the same motion."""
    rng = np.random.default_rng(seed)
    planar = random_machine(rng, size, "planar")
    flat = Robot(
        tuple(
            Link(k.name, k.mass, (*k.center_of_mass[:2], 0.0), np.diag(np.full(3, k.inertia[2, 2])))
            for k in planar.robot.links
        ),
        tuple(
            Joint(j.name, j.kind, j.parent, j.child, (*j.translation[:2], 0.0), j.rotation, j.axis)
            for j in planar.robot.joints
        ),
        planar.robot.tip,
        (*planar.robot.tip_translation[:2], 0.0),
        planar.robot.tip_rotation,
    )
    place, q, rates = rng.normal(size=3), *rng.normal(size=(2, planar.joint_size))
    pose = np.array([place[0], place[1], 0.0, np.cos(place[2] / 2), 0.0, 0.0, np.sin(place[2] / 2)])
    in_plane = FreeFloating(flat, "planar").tip_twist(place, q, rates)
    in_space = FreeFloating(flat, "spatial").tip_twist(pose, q, rates)
    np.testing.assert_allclose(numeric(in_space), numeric(in_plane), atol=1e-10)
    # Neither heights nor the other moments of inertia matter to the planar machine.
    np.testing.assert_allclose(numeric(planar.tip_twist(place, q, rates)), numeric(in_plane), atol=1e-10)


def test_two_bodies_on_a_pivot_share_the_rotation_as_their_inertias_say() -> None:
    """Closed form:

    Base pivoted at its centre of mass; omega0 = -(I1 + mu d^2) / (I0 + I1 + mu d^2) q', mu reduced mass.
    """
    m0, i0, m1, i1, length = 7.0, 3.0, 2.0, 0.4, 1.2
    base = Link("base", m0, inertia=np.diag([i0 / 2, i0 / 2, i0]))
    machine = FreeFloating(planar_chain([length], [m1], [i1], base=base), "planar")
    swung = i1 + m0 * m1 / (m0 + m1) * (length / 2) ** 2
    rate = numeric(machine.base_rate([0.3, -0.2, 0.9], [0.5], [1.7])).ravel()
    assert rate[2] == pytest.approx(-swung / (i0 + swung) * 1.7, rel=1e-13)
    # The pivot moves against the link: (m0 + m1) v0 = -m1 (omega0 + q') x d.
    along = np.array([-np.sin(1.4), np.cos(1.4)]) * length / 2 * (rate[2] + 1.7)
    np.testing.assert_allclose(rate[:2], -m1 / (m0 + m1) * along, rtol=1e-13)


def test_an_infinitely_heavy_base_stands_still() -> None:
    base = Link("base", 1e12, inertia=1e12 * np.eye(3))
    machine = FreeFloating(planar_chain([1.0, 1.0], [1.0, 1.0], base=base), "planar")
    place, q = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.5])
    np.testing.assert_allclose(
        numeric(machine.tip_jacobian(place, q)), numeric(machine.jacobians(place, q)[1]), atol=1e-10
    )


@few
@given(seeds, st.floats(0.2, 5.0))
def test_a_quaternion_off_the_unit_sphere_moves_the_same_machine(seed: int, norm: float) -> None:
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, 4, "spatial")
    place, q, rates = random_base(rng, "spatial"), *rng.normal(size=(2, machine.joint_size))
    scaled = np.concatenate([place[:3], norm * place[3:]])
    np.testing.assert_allclose(
        numeric(machine.tip_jacobian(scaled, q)), numeric(machine.tip_jacobian(place, q)), atol=1e-11
    )
    rate, scaled_rate = (numeric(machine.base_rate(x, q, rates)).ravel() for x in (place, scaled))
    np.testing.assert_allclose(scaled_rate[3:], norm * rate[3:], atol=1e-10)


def test_elimination_about_the_center_of_mass_is_the_cheaper_one() -> None:
    def count(machine: FreeFloating, matrix: Callable[[Any, Any], Any]) -> int:
        variables = [ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size)]
        return int(ca.Function("f", variables, [matrix(*variables)]).n_instructions())

    def direct(machine: FreeFloating, base: Any, q: Any) -> Any:
        (e1, e2), (f1, f2) = machine.momentum_matrices(base, q), machine.jacobians(base, q)
        return f2 - ca.mtimes(f1, solve_spd(e1, e2))

    for machine in (paper_example(), random_machine(np.random.default_rng(0), 7, "spatial")):
        assert count(machine, machine.tip_jacobian) < 0.6 * count(machine, partial(direct, machine))


def test_the_papers_example_is_as_printed() -> None:
    machine = paper_example()
    robot = machine.robot
    assert machine.base == "planar"
    assert (robot.links[0].mass, robot.links[0].inertia[2, 2]) == (100.0, 66.67)
    assert [(link.mass, link.inertia[2, 2]) for link in robot.links[1:]] == [(2.0, 0.7083)] * 3
    place, q = machine.base_home(), np.deg2rad([45.0, 60.0, -60.0])
    angles = np.cumsum(q)
    tip = [1 + 2 * np.cos(angles).sum(), 2 * np.sin(angles).sum(), 0.0]
    np.testing.assert_allclose(numeric(machine.tip_pose(place, q).position).ravel(), tip, atol=1e-14)


def test_planar_rows_are_those_of_a_planar_motion() -> None:
    machine = paper_example()
    others = [row for row in range(6) if row not in (*PLANAR_ROWS, 5)]
    jacobian = numeric(machine.tip_jacobian(np.array([1.0, 2.0, 0.3]), np.array([0.1, 0.2, 0.3])))
    np.testing.assert_array_equal(jacobian[[*others, 5]], 0.0)
    np.testing.assert_array_equal(np.abs(jacobian[PLANAR_ROWS]).max(axis=1) > 0.1, True)


def free_base(**fields: Any) -> Link:
    return Link("base", 10.0, inertia=np.diag([1.0, 1.0, 1.0]), **fields)


def test_machines_that_cannot_float_are_refused() -> None:
    arm = Link("arm", 1.0)
    tilted = Robot((free_base(), arm), (Joint("shoulder", "revolute", "base", "arm", axis=(0, 1, 1)),))
    lift = Robot((free_base(), arm), (Joint("lift", "prismatic", "base", "arm", axis=(0, 0, 1)),))
    with pytest.raises(ModelError, match=r"joint 'shoulder' turns about .* not about z"):
        FreeFloating(tilted, "planar")
    with pytest.raises(ModelError, match=r"joint 'lift' moves along .* out of the plane"):
        FreeFloating(lift, "planar")
    with pytest.raises(ModelError, match="unknown kind of base 'orbital'"):
        FreeFloating(tilted, "orbital")  # type: ignore[arg-type]
    massless = Robot((Link("a"), Link("b")), (Joint("j", "revolute", "a", "b"),))
    with pytest.raises(ModelError, match="no mass"):
        FreeFloating(massless)
    # One point mass on the axis: nothing resists turning about it.
    point = Robot((Link("a", 1.0), Link("b")), (Joint("j", "revolute", "a", "b"),))
    for base in ("planar", "spatial"):
        with pytest.raises(ModelError, match="no rotational inertia"):
            FreeFloating(point, base)


def test_point_masses_on_a_bent_arm_have_inertia_enough() -> None:
    links = tuple(Link(name, 1.0, (0.5, 0, 0)) for name in "abc")
    joints = (Joint("j", "revolute", "a", "b", (1, 0, 0)), Joint("k", "revolute", "b", "c", (1, 0, 0)))
    machine = FreeFloating(Robot(links, joints), "spatial")
    place, q, rates = machine.base_home(), np.array([0.5, 0.7]), np.array([1.0, -2.0])
    rate = machine.base_rate(place, q, rates)
    np.testing.assert_allclose(numeric(machine.momentum_residual(place, q, rate, rates)), 0, atol=1e-14)


@settings(max_examples=10)
@given(seeds, st.integers(2, 6), bases)
def test_a_momentum_that_is_given_is_conserved_along_an_integrated_motion(seed: int, size: int, base: Base) -> None:
    """Momentum by finite differences of the link poses; the centre of mass moves at P / m."""
    rng = np.random.default_rng(seed)
    plain = random_machine(rng, size, base)
    given = rng.normal(size=len(plain.twist_rows))
    machine = replace(plain, conserved_momentum=given)
    full = np.zeros(6)
    full[machine.twist_rows] = given
    motion, start, step = Motion(machine, rng), random_base(rng, base), 2e-3
    robot, place, time = machine.robot, start, 0.0
    center = numeric(center_of_mass(robot, motion.joints(0.0), machine.world_from_base(start))).ravel()
    for end in (0.6, 1.5):
        place, time = motion.base(place, time, end), end
        moved = numeric(center_of_mass(robot, motion.joints(time), machine.world_from_base(place))).ravel()
        np.testing.assert_allclose(moved, center + full[3:] / robot.total_mass * time, atol=1e-8)
        near = [
            poses_at(machine, motion.base(place, time, time + k * step), motion.joints(time + k * step))
            for k in range(-2, 3)
        ]
        about_origin = np.concatenate([full[:3] + np.cross(moved, full[3:]), full[3:]])
        found = momentum_by_differences(robot, near, step)
        np.testing.assert_allclose(found[machine.twist_rows], about_origin[machine.twist_rows], atol=1e-6)


@few
@given(seeds, sizes, bases)
def test_momentum_makes_base_and_tip_move_affinely_with_the_generalized_jacobian_unchanged(
    seed: int, size: int, base: Base
) -> None:
    rng = np.random.default_rng(seed)
    plain = random_machine(rng, size, base)
    machine = replace(plain, conserved_momentum=rng.normal(size=len(plain.twist_rows)))
    place, q = random_base(rng, base), rng.normal(size=machine.joint_size)
    rates = rng.normal(size=machine.joint_size)
    drift = numeric(machine.tip_twist(place, q, np.zeros(machine.joint_size)))
    jacobian = numeric(machine.tip_jacobian(place, q))
    np.testing.assert_array_equal(jacobian, numeric(plain.tip_jacobian(place, q)))
    np.testing.assert_allclose(
        numeric(machine.tip_twist(place, q, rates)).ravel(), jacobian @ rates + drift.ravel(), atol=1e-10
    )
    by_base, by_joints = map(numeric, machine.jacobians(place, q))
    twist = numeric(machine.base_twist(place, q, rates)).ravel()
    np.testing.assert_allclose(
        numeric(machine.tip_twist(place, q, rates)).ravel(), by_base @ twist + by_joints @ rates, atol=1e-10
    )
    rate = machine.base_rate(place, q, rates)
    np.testing.assert_allclose(numeric(machine.twist_of_rate(place, rate)).ravel(), twist, atol=1e-10)
    np.testing.assert_allclose(numeric(machine.momentum_residual(place, q, rate, rates)), 0, atol=1e-10)


def test_a_rigid_body_with_locked_joints_turns_about_its_axis_and_drifts() -> None:
    """Symmetric body: omega = L / I, v = P / m, the centre of mass at the base's origin."""
    body = Link("body", 10.0, inertia=np.diag([2.0, 2.0, 2.0]))
    pin = Joint("pin", "revolute", "body", "pointer", axis=(1, 0, 0))
    machine = FreeFloating(Robot((body, Link("pointer")), (pin,)), conserved_momentum=(0.2, 0.4, -0.6, 1.0, 2.0, 3.0))
    twist = numeric(machine.base_twist([1.0, 2.0, 3.0, 0.0, 0.6, 0.8, 0.0], [0.3], [0.0])).ravel()
    np.testing.assert_allclose(twist, [0.1, 0.2, -0.3, 0.1, 0.2, 0.3], atol=1e-14)


@pytest.mark.parametrize("name", ["floating manipulator", "panda", "talos"])
def test_the_momentum_that_is_given_is_that_of_pinocchio(name: str) -> None:
    package, ending, told = ROBOTS[name]
    path = urdf_file(package, ending)
    robot = Robot.from_urdf(path, **told)
    peer, rng = Peer.of(path, robot), np.random.default_rng(7)
    given = rng.normal(size=6)
    machine = FreeFloating(robot, conserved_momentum=given)
    b, q, rates = (ca.SX.sym(n, k) for n, k in (("b", 7), ("q", robot.dof), ("r", robot.dof)))
    moved = ca.Function("f", [b, q, rates], [machine.base_twist(b, q, rates), machine.tip_twist(b, q, rates)])
    frame = peer.model.getFrameId(str(robot.tip))
    for _ in range(10):
        state = random_state(robot, rng)
        twist, tip = (numeric(part).ravel() for part in moved(state.base, state.q, state.qd))
        state = replace(state, base_twist=twist)
        configuration, velocity = peer.configuration(state), peer.velocity(state)
        momentum = pinocchio.computeCentroidalMomentum(peer.model, peer.data, configuration, velocity)
        np.testing.assert_allclose(swapped(np.array(momentum.vector)), given, atol=1e-9)
        pinocchio.forwardKinematics(peer.model, peer.data, configuration, velocity)
        world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        found = pinocchio.getFrameVelocity(peer.model, peer.data, frame, world).vector
        np.testing.assert_allclose(tip, swapped(np.array(found)), atol=1e-9)


@pytest.mark.parametrize("momentum", [(1.0, 2.0, 3.0), (np.nan,) * 6, "fast"])
def test_a_momentum_of_the_wrong_size_is_refused(momentum: Any) -> None:
    with pytest.raises(ModelError, match="spatial free-floating base: conserved_momentum"):
        FreeFloating(planar_chain([1.0], [1.0], base=free_base()), conserved_momentum=momentum)


def test_the_virtual_chain_refuses_momentum() -> None:
    with pytest.raises(ModelError, match="zero momentum only"):
        VirtualChain.from_machine(replace(paper_example(), conserved_momentum=(1.0, 0.0, 0.0)))


def test_with_tip_moves_the_frame_of_interest_and_nothing_else() -> None:
    machine = paper_example()
    q, base = np.array([0.3, 0.4, -0.5]), np.array([0.1, 0.2, 0.3])
    elbow = with_tip(machine, "link2", (0.5, 0.0, 0.0))
    expected = numeric(link_frames(machine.robot, q, machine.world_from_base(base))["link2"].point([0.5, 0.0, 0.0]))
    np.testing.assert_allclose(numeric(elbow.tip_pose(base, q).position), expected, atol=1e-14)
    rates = np.array([0.3, -0.2, 0.1])
    same = [numeric(some.base_rate(base, q, rates)) for some in (machine, elbow)]
    np.testing.assert_allclose(same[0], same[1], atol=1e-14)
    root = with_tip(machine, "base")
    spin = numeric(machine.base_twist(base, q, rates))[0]
    np.testing.assert_allclose(numeric(root.tip_twist(base, q, rates)).ravel()[2], spin, atol=1e-14)
    with pytest.raises(ModelError, match="elbow"):
        with_tip(machine, "elbow")
