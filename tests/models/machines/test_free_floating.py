from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

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
from models.spatial import solve_spd
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

bases = st.sampled_from(["planar", "spatial"])


def random_machine(rng: np.random.Generator, size: int, base: Base) -> FreeFloating:
    return FreeFloating(random_robot(rng, size, base), base)


class Case(NamedTuple):
    """A random machine, its configuration and its joint rates."""

    rng: np.random.Generator
    machine: FreeFloating
    place: Array
    q: Array
    rates: Array


def case(seed: int, size: int, base: Base) -> Case:
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    return Case(rng, machine, random_base(rng, base), *rng.normal(size=(2, machine.joint_size)))


cases, spatial_cases = (st.builds(case, seeds, st.integers(1, 7), kind) for kind in (bases, st.just("spatial")))


def close(result: Any, expected: Any, tolerance: float) -> None:
    """Vectors are compared as vectors, whether they are columns or not."""
    value, known = numeric(result), np.asarray(expected)
    np.testing.assert_allclose(value.reshape(known.shape) if known.ndim else value, known, atol=tolerance)


class Motion:
    """Smooth joint motion q(t) with its exact rates, and the base that floats along."""

    def __init__(self, machine: FreeFloating, rng: np.random.Generator) -> None:
        count = machine.joint_size
        self.machine = machine
        self.middle, self.phase = rng.normal(size=count), rng.uniform(0, 6, size=count)
        self.amplitude, self.frequency = rng.uniform(0.3, 1.0, size=count), rng.uniform(1.0, 3.0, size=count)
        variables = [ca.SX.sym(name, size) for name, size in (("b", machine.base_size), ("q", count), ("r", count))]
        self._rate = ca.Function("rate", variables, [machine.base_rate(*variables)])

    def joints(self, time: float) -> Array:
        return self.middle + self.amplitude * np.sin(self.frequency * time + self.phase)

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

    def poses(self, place: Array, time: float, step: float) -> list[dict[str, tuple[Array, Array]]]:
        """Link poses at five times about one, the base integrated from its place at that time."""
        near = [(self.base(place, time, time + k * step), self.joints(time + k * step)) for k in range(-2, 3)]
        frames = [tuple(map(numeric, self.machine.world_from_base(base))) for base, _ in near]
        return [numeric_poses(self.machine.robot, q, frame) for (_, q), frame in zip(near, frames, strict=True)]

    def center(self, place: Array, time: float) -> Array:
        frame = self.machine.world_from_base(place)
        return numeric(center_of_mass(self.machine.robot, self.joints(time), frame)).ravel()


@few
@given(cases)
def test_momentum_and_jacobians_are_those_of_differentiated_frames(case: Case) -> None:
    """E1 and E2 against sum(c x m c' + R I R^T omega) and sum(m c'); F1 and F2 against the tip's own derivative."""
    rng, machine = case.rng, case.machine
    x = ca.SX.sym("x", machine.base_size + machine.joint_size)
    dx = ca.SX.sym("dx", x.numel())
    (place, q), (place_rate, q_rate) = (ca.vertsplit(v, [0, machine.base_size, x.numel()]) for v in (x, dx))
    frames = link_frames(machine.robot, q, machine.world_from_base(place))
    momentum = momentum_by_differentiation(machine.robot, frames, x, dx)[machine.twist_rows]
    twist = machine.twist_of_rate(place, place_rate)
    tip = machine.tip_pose(place, q)
    pairs = (
        (machine.momentum_matrices(place, q), momentum),
        (machine.jacobians(place, q), twist_by_differentiation(tip.rotation, tip.position, x, dx)),
    )
    errors = [ca.mtimes(by_base, twist) + ca.mtimes(by_joints, q_rate) - known for (by_base, by_joints), known in pairs]
    errors.append(machine.momentum_residual(place, q, place_rate, q_rate) - momentum)
    point = np.concatenate([case.place, case.q])
    for error in ca.Function("f", [x, dx], errors)(point, rng.normal(size=x.numel())):
        close(error, np.zeros(error.numel()), 1e-10)


@few
@given(cases)
def test_generalized_jacobian_is_the_papers_formula(case: Case) -> None:
    """The elimination about the centre of mass against (24) and (25) as printed, solved by numpy."""
    _, machine, place, q, rates = case
    (e1, e2), (f1, f2) = (map(numeric, pair(place, q)) for pair in (machine.momentum_matrices, machine.jacobians))
    reaction = -np.linalg.solve(e1, e2)
    close(machine.tip_jacobian(place, q), f2 + f1 @ reaction, 1e-9)
    close(machine.tip_twist(place, q, rates), (f2 + f1 @ reaction) @ rates, 1e-9)
    close(machine.base_twist(place, q, rates), reaction @ rates, 1e-9)


@few
@given(cases)
def test_the_base_reacts_so_that_the_momentum_is_zero(case: Case) -> None:
    _, machine, place, q, rates = case
    rate, none = machine.base_rate(place, q, rates), np.zeros(len(machine.twist_rows))
    close(machine.momentum_residual(place, q, rate, rates), none, 1e-11)
    close(machine.momentum(place, q, machine.base_twist(place, q, rates), rates), none, 1e-11)
    if machine.base == "spatial":
        assert abs(float(ca.dot(rate[3:7], place[3:7]))) < 1e-13 * (1 + np.abs(numeric(rate)).max())


@settings(max_examples=12)
@given(seeds, st.integers(2, 6), bases, st.booleans())
def test_momentum_is_conserved_along_an_integrated_motion(seed: int, size: int, base: Base, carried: bool) -> None:
    """None or a given one, by finite differences of the link poses; the centre of mass moves at P / m, over 2 s."""
    rng = np.random.default_rng(seed)
    machine = random_machine(rng, size, base)
    full, rows = np.zeros(6), machine.twist_rows
    if carried:
        full[rows] = rng.normal(size=len(rows))
        machine = replace(machine, conserved_momentum=full[rows])
    motion, place, time = Motion(machine, rng), random_base(rng, base), 0.0
    center = motion.center(place, 0.0)
    for end in (0.7, 1.3, 2.0):
        place, time = motion.base(place, time, end), end
        moved = motion.center(place, time)
        np.testing.assert_allclose(moved, center + full[3:] / machine.robot.total_mass * time, atol=1e-8)
        about_origin = np.concatenate([full[:3] + np.cross(moved, full[3:]), full[3:]])
        result = momentum_by_differences(machine.robot, motion.poses(place, time, 2e-3), 2e-3)
        np.testing.assert_allclose(result[rows], about_origin[rows], atol=1e-6 if carried else 1e-7)
        if base == "spatial":
            assert np.linalg.norm(place[3:]) == pytest.approx(1.0, abs=1e-10)


@settings(max_examples=20)
@given(cases)
def test_generalized_jacobian_agrees_with_finite_differences_of_the_tip(case: Case) -> None:
    """The tip is moved by integrating base and joints together; its own displacement gives its velocity."""
    machine, place, time, step = case.machine, case.place, 0.4, 1e-3
    motion = Motion(machine, case.rng)
    times = [time + k * step for k in (-2, -1, 1, 2)]
    tips = [machine.tip_pose(motion.base(place, time, at), motion.joints(at)) for at in times]
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12 * step)
    speed = sum(w * numeric(tip.position).ravel() for w, tip in zip(weights, tips, strict=True))
    turning = sum(w * numeric(tip.rotation) for w, tip in zip(weights, tips, strict=True))
    here = machine.tip_pose(place, motion.joints(time))
    turning = turning @ numeric(here.rotation).T
    result = numeric(machine.tip_jacobian(place, motion.joints(time))) @ motion.joint_rates(time)
    np.testing.assert_allclose(result, [turning[2, 1], turning[0, 2], turning[1, 0], *speed], atol=1e-8)


@few
@given(seeds, st.integers(1, 7))
def test_a_planar_machine_is_a_spatial_one_with_parallel_axes(seed: int, size: int) -> None:
    """Where the inertia does not couple the plane with the rest, both give the same motion."""
    rng = np.random.default_rng(seed)
    planar = random_machine(rng, size, "planar")
    robot, level = planar.robot, np.array([1.0, 1.0, 0.0])
    links = [
        replace(link, center_of_mass=link.center_of_mass * level, inertia=np.eye(3) * link.inertia[2, 2])
        for link in robot.links
    ]
    joints = [replace(joint, translation=joint.translation * level) for joint in robot.joints]
    flat = replace(robot, links=tuple(links), joints=tuple(joints), tip_translation=robot.tip_translation * level)
    place, q, rates = rng.normal(size=3), *rng.normal(size=(2, planar.joint_size))
    pose = np.array([place[0], place[1], 0.0, np.cos(place[2] / 2), 0.0, 0.0, np.sin(place[2] / 2)])
    in_plane = numeric(FreeFloating(flat, "planar").tip_twist(place, q, rates))
    close(FreeFloating(flat, "spatial").tip_twist(pose, q, rates), in_plane, 1e-10)
    # Neither heights nor the other moments of inertia matter to the planar machine.
    close(planar.tip_twist(place, q, rates), in_plane, 1e-10)


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
    close(machine.tip_jacobian(place, q), numeric(machine.jacobians(place, q)[1]), 1e-10)


@few
@given(spatial_cases, st.floats(0.2, 5.0))
def test_a_quaternion_off_the_unit_sphere_moves_the_same_machine(case: Case, norm: float) -> None:
    _, machine, place, q, rates = case
    scaled = np.concatenate([place[:3], norm * place[3:]])
    close(machine.tip_jacobian(scaled, q), numeric(machine.tip_jacobian(place, q)), 1e-11)
    rate = numeric(machine.base_rate(place, q, rates)).ravel()
    close(machine.base_rate(scaled, q, rates)[3:], norm * rate[3:], 1e-10)


def test_elimination_about_the_center_of_mass_takes_fewer_operations() -> None:
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
    close(machine.tip_pose(place, q).position, tip, 1e-14)


def test_planar_rows_are_those_of_a_planar_motion() -> None:
    machine = paper_example()
    others = [row for row in range(6) if row not in (*PLANAR_ROWS, 5)]
    jacobian = numeric(machine.tip_jacobian(np.array([1.0, 2.0, 0.3]), np.array([0.1, 0.2, 0.3])))
    np.testing.assert_array_equal(jacobian[[*others, 5]], 0.0)
    np.testing.assert_array_equal(np.abs(jacobian[PLANAR_ROWS]).max(axis=1) > 0.1, True)


def free_base(**fields: Any) -> Link:
    return Link("base", 10.0, inertia=np.diag([1.0, 1.0, 1.0]), **fields)


def pair(kind: Any = "revolute", axis: Any = (0, 0, 1), base: Link | None = None) -> Robot:
    """Two links and a joint between them."""
    return Robot((base or free_base(), Link("arm", 1.0)), (Joint("j", kind, "base", "arm", axis=axis),))


@pytest.mark.parametrize(
    ("robot", "base", "message"),
    [
        (pair(axis=(0, 1, 1)), "planar", r"joint 'j' turns about .* not about z"),
        (pair("prismatic"), "planar", r"joint 'j' moves along .* out of the plane"),
        (pair(), "orbital", r"base must be 'planar' or 'spatial', not 'orbital'"),
        (Robot((Link("a"), Link("b")), (Joint("j", "revolute", "a", "b"),)), "spatial", "no mass"),
        # point masses on the axis: nothing resists turning about it
        (pair(base=Link("base", 1.0)), "planar", "no rotational inertia"),
        (pair(base=Link("base", 1.0)), "spatial", "no rotational inertia"),
    ],
)
def test_machines_that_cannot_float_are_refused(robot: Robot, base: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        FreeFloating(robot, base)


def test_point_masses_on_a_folded_arm_have_enough_inertia() -> None:
    links = tuple(Link(name, 1.0, (0.5, 0, 0)) for name in "abc")
    joints = (Joint("j", "revolute", "a", "b", (1, 0, 0)), Joint("k", "revolute", "b", "c", (1, 0, 0)))
    machine = FreeFloating(Robot(links, joints), "spatial")
    place, q, rates = machine.base_home(), np.array([0.5, 0.7]), np.array([1.0, -2.0])
    rate = machine.base_rate(place, q, rates)
    close(machine.momentum_residual(place, q, rate, rates), np.zeros(6), 1e-14)


@pytest.mark.long
@few
@given(cases)
def test_momentum_makes_base_and_tip_move_affinely_with_the_generalized_jacobian_unchanged(case: Case) -> None:
    rng, plain, place, q, rates = case
    machine = replace(plain, conserved_momentum=rng.normal(size=len(plain.twist_rows)))
    drift = numeric(machine.tip_twist(place, q, np.zeros(machine.joint_size))).ravel()
    jacobian = numeric(machine.tip_jacobian(place, q))
    np.testing.assert_array_equal(jacobian, numeric(plain.tip_jacobian(place, q)))
    close(machine.tip_twist(place, q, rates), jacobian @ rates + drift, 1e-10)
    by_base, by_joints = map(numeric, machine.jacobians(place, q))
    twist = numeric(machine.base_twist(place, q, rates)).ravel()
    close(machine.tip_twist(place, q, rates), by_base @ twist + by_joints @ rates, 1e-10)
    rate = machine.base_rate(place, q, rates)
    close(machine.twist_of_rate(place, rate), twist, 1e-10)
    close(machine.momentum_residual(place, q, rate, rates), np.zeros(len(twist)), 1e-10)


def test_a_rigid_body_with_locked_joints_turns_about_its_axis_and_drifts() -> None:
    """Symmetric body: omega = L / I, v = P / m, the centre of mass at the base's origin."""
    body = Link("body", 10.0, inertia=np.diag([2.0, 2.0, 2.0]))
    pin = Joint("pin", "revolute", "body", "pointer", axis=(1, 0, 0))
    machine = FreeFloating(Robot((body, Link("pointer")), (pin,)), conserved_momentum=(0.2, 0.4, -0.6, 1.0, 2.0, 3.0))
    twist = machine.base_twist([1.0, 2.0, 3.0, 0.0, 0.6, 0.8, 0.0], [0.3], [0.0])
    close(twist, [0.1, 0.2, -0.3, 0.1, 0.2, 0.3], 1e-14)


@pytest.mark.parametrize("name", ["floating manipulator", "panda", "talos"])
def test_the_momentum_equals_that_of_pinocchio(name: str) -> None:
    package, ending, report = ROBOTS[name]
    path = urdf_file(package, ending)
    robot = Robot.from_urdf(path, **report)
    peer, rng = Peer.of(path, robot), np.random.default_rng(7)
    options = rng.normal(size=6)
    machine = FreeFloating(robot, conserved_momentum=options)
    b, q, rates = (ca.SX.sym(n, k) for n, k in (("b", 7), ("q", robot.dof), ("r", robot.dof)))
    moved = ca.Function("f", [b, q, rates], [machine.base_twist(b, q, rates), machine.tip_twist(b, q, rates)])
    frame = peer.model.getFrameId(robot.tip_link)
    for _ in range(10):
        state = random_state(robot, rng)
        twist, tip = (numeric(part).ravel() for part in moved(state.base, state.q, state.qd))
        state = replace(state, base_twist=twist)
        configuration, velocity = peer.configuration(state), peer.velocity(state)
        momentum = pinocchio.computeCentroidalMomentum(peer.model, peer.data, configuration, velocity)
        np.testing.assert_allclose(swapped(np.array(momentum.vector)), options, atol=1e-9)
        pinocchio.forwardKinematics(peer.model, peer.data, configuration, velocity)
        world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        result = pinocchio.getFrameVelocity(peer.model, peer.data, frame, world).vector
        np.testing.assert_allclose(tip, swapped(np.array(result)), atol=1e-9)


@pytest.mark.parametrize("momentum", [(1.0, 2.0, 3.0), (np.nan,) * 6, "fast"])
def test_a_momentum_of_the_wrong_size_is_refused(momentum: Any) -> None:
    with pytest.raises(ModelError, match="spatial free-floating base: conserved_momentum"):
        FreeFloating(planar_chain([1.0], [1.0], base=free_base()), conserved_momentum=momentum)


def test_the_virtual_chain_refuses_momentum() -> None:
    with pytest.raises(ModelError, match="zero momentum only"):
        VirtualChain.from_machine(replace(paper_example(), conserved_momentum=(1.0, 0.0, 0.0)))


def test_with_tip_moves_the_frame_of_interest_and_nothing_else() -> None:
    machine, q, base, rates = paper_example(), [0.3, 0.4, -0.5], [0.1, 0.2, 0.3], [0.3, -0.2, 0.1]
    elbow, root = with_tip(machine, "link2", (0.5, 0.0, 0.0)), with_tip(machine, "base")
    expected = link_frames(machine.robot, q, machine.world_from_base(base))["link2"].point([0.5, 0.0, 0.0])
    close(elbow.tip_pose(base, q).position, numeric(expected), 1e-14)
    close(elbow.base_rate(base, q, rates), numeric(machine.base_rate(base, q, rates)), 1e-14)
    close(root.tip_twist(base, q, rates)[2], machine.base_twist(base, q, rates)[0], 1e-14)
    with pytest.raises(ModelError, match="elbow"):
        with_tip(machine, "elbow")
