from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import (
    STANDING_STARTS,
    Joint,
    Link,
    ModelError,
    Robot,
    Standing,
    Wrench,
    center_of_mass,
    frame_jacobian,
    link_frames,
    planar_chain,
    rectangle,
    standing_example,
)
from models.machines.machine import wrenches_at
from models.machines.standing import center_of_pressure, standing_motion, tip_spring
from tests.models.machines.standing_machines import random_motion, random_standing, standing_arm
from tests.models.robot.oracles import mujoco_dynamics, pinocchio_dynamics, with_masses
from tests.models.robot.trees import Array, few, link_twist, numeric, random_robot, random_rotation, seeds

FOOT = rectangle((-0.1, 0.1), (-0.1, 0.1))
EXAMPLE = standing_example()


def hand(rng: np.random.Generator, machine: Standing) -> Wrench:
    return machine.tip_wrench(rng.normal(scale=5, size=3), rng.normal(size=3))


class Case(NamedTuple):
    """A random machine, a motion of it at one instant, and a wrench at its hand."""

    rng: np.random.Generator
    machine: Standing
    motion: tuple[Array, Array, Array]
    wrench: Wrench


def case(seed: int, size: int) -> Case:
    rng = np.random.default_rng(seed)
    machine = random_standing(rng, size)
    return Case(rng, machine, random_motion(rng, machine), hand(rng, machine))


cases = st.builds(case, seeds, st.integers(1, 6))


def flat(value: Any) -> Array:
    """The entries of an expression without symbols."""
    return numeric(value).ravel()


def close(result: Any, expected: Any, relative: float = 1e-9, absolute: float = 1e-9) -> None:
    np.testing.assert_allclose(flat(result), expected, rtol=relative, atol=absolute)


def pressure_point(reaction: Array) -> Array:
    """Where a ground reaction (moment, force) has no horizontal moment."""
    return np.asarray([-reaction[1], reaction[0]] / reaction[5])


@pytest.mark.parametrize(("table", "ahead"), [(1, 0.0073), (2, 0.0090)])
def test_the_papers_machine_starts_with_its_centre_of_mass_over_the_foot(table: int, ahead: float) -> None:
    q, robot = STANDING_STARTS[table], EXAMPLE.robot
    center = flat(center_of_mass(robot, q, EXAMPLE.world_from_base()))
    assert center[0] == 0
    assert center[1] == pytest.approx(ahead, abs=5e-5)
    assert robot.total_mass == pytest.approx(61.32)
    assert ((robot.lower < q) & (q < robot.upper)).all()
    assert EXAMPLE.moving_axes == (1,)


def test_the_papers_machine_moves_in_its_plane_counter_clockwise_from_y() -> None:
    frames = link_frames(EXAMPLE.robot, STANDING_STARTS[1], EXAMPLE.world_from_base())
    for i, angle in enumerate(np.cumsum(STANDING_STARTS[1])):
        close(frames[f"link{i + 1}"].rotation[:, 0], [0, np.cos(angle), np.sin(angle)], 0, 1e-12)


@given(cases)
@few
def test_a_machine_at_rest_presses_below_its_centre_of_mass(case: Case) -> None:
    machine, q, rest = case.machine, case.motion[0], np.zeros(case.machine.joint_size)
    center = flat(center_of_mass(machine.robot, q, machine.world_from_base()))
    close(machine.zero_moment_point(q, rest, rest), center[:2], 1e-7, 1e-10)
    close(machine.ground_reaction(q, rest, rest)[3:], [0, 0, machine.weight], 1e-7)


@given(cases)
@few
def test_the_zero_moment_point_is_that_of_the_sums_over_links(case: Case) -> None:
    """(2)-(3), with the force of (35)-(36) corrected: it enters as a moment, and the vertical one below the line."""
    _, machine, motion, wrench = case
    place = machine.world_from_base()
    frames = link_frames(machine.robot, motion[0], place)
    numerator, denominator = np.zeros(2), 0.0
    for link in machine.robot.links:
        twist, rate = link_twist(machine.robot, link.name, motion, place, link.center_of_mass)
        spin, turning, acceleration = twist[:3], rate[:3], rate[3:]
        center = flat(frames[link.name].point(link.center_of_mass))
        turn = numeric(frames[link.name].rotation)
        inertia = turn @ link.inertia @ turn.T
        moment = inertia @ turning + np.cross(spin, inertia @ spin)
        push = link.mass * (acceleration[2] + machine.gravity)
        numerator += push * center[:2] - link.mass * acceleration[:2] * center[2] + [-moment[1], moment[0]]
        denominator += push
    (x, y, z), force, moment = map(flat, (machine.tip_pose((), motion[0]).position, wrench.force, wrench.moment))
    numerator += [z * force[0] - x * force[2] + moment[1], z * force[1] - y * force[2] - moment[0]]
    close(machine.zero_moment_point(*motion, [wrench]), numerator / (denominator - force[2]))


@pytest.mark.parametrize("library", [pinocchio_dynamics, mujoco_dynamics])
@given(seeds, st.integers(2, 8), st.sampled_from(["planar", "spatial"]))
@few
def test_zmp_ground_force_and_torque_equal_an_independent_library(
    library: Any, seed: int, size: int, base: Any
) -> None:
    """On a foot that stands anywhere and tilted, with a wrench at the hand and a force at a point of another link."""
    rng = np.random.default_rng(seed)
    robot = with_masses(random_robot(rng, size, base), rng)
    turn, place = random_rotation(rng), rng.normal(size=3)
    machine = Standing(robot, translation=place, rotation=turn, support=FOOT)
    q, qd, qdd = rng.normal(size=machine.joint_size), *rng.normal(scale=0.5, size=(2, machine.joint_size))
    other = robot.links[int(rng.integers(size + 1))].name
    wrenches = [hand(rng, machine), Wrench(other, rng.normal(scale=5, size=3), point=rng.normal(size=3))]
    # the library's root is at its origin: everything in the axes of the foot
    rotated = [Wrench(w.link, turn.T @ numeric(w.force), turn.T @ numeric(w.moment), w.point) for w in wrenches]
    torques, own = library(robot, q, qd, qdd, rotated, turn.T @ machine.gravity_in_world)
    force = turn @ own[3:]
    reaction = np.concatenate([turn @ own[:3] + np.cross(place, force), force])
    close(machine.zero_moment_point(q, qd, qdd, wrenches), pressure_point(reaction))
    close(machine.ground_reaction(q, qd, qdd, wrenches), reaction, 0)
    close(machine.joint_torques(q, qd, qdd, wrenches), torques, 0)


@pytest.mark.parametrize("library", [pinocchio_dynamics, mujoco_dynamics])
def test_slides_are_weighed_as_an_independent_library_does(library: Any) -> None:
    """A column that rises and a boom that slides out, which turns: every kind of motion bears on the ground."""
    rng = np.random.default_rng(7)
    links = [Link("foot", 4.0, (0, 0, 0.05), np.eye(3))]
    links += [Link(name, mass, rng.normal(scale=0.2, size=3), np.eye(3) * mass / 50) for name, mass in (
        ("column", 9.0), ("turret", 6.0), ("boom", 3.0), ("hook", 1.0))]  # fmt: skip
    kinds = (("prismatic", (0, 0, 1)), ("revolute", (0, 0, 1)), ("prismatic", (1, 0, 0)), ("revolute", (0, 1, 0)))
    joints = [
        Joint(f"joint{i}", kind, links[i].name, links[i + 1].name, (0.1, 0, 0.3), axis=axis)  # type: ignore[arg-type]
        for i, (kind, axis) in enumerate(kinds)
    ]
    machine = Standing(Robot(tuple(links), tuple(joints)), support=FOOT)
    for _ in range(5):
        q, qd, qdd = rng.normal(size=(3, 4))
        wrenches = [hand(rng, machine)]
        torques, reaction = library(machine.robot, q, qd, qdd, wrenches, machine.gravity_in_world)
        close(machine.ground_reaction(q, qd, qdd, wrenches), reaction, 0)
        close(machine.joint_torques(q, qd, qdd, wrenches), torques, 1e-7)
        close(machine.zero_moment_point(q, qd, qdd, wrenches), pressure_point(reaction))


@given(cases)
@few
def test_the_reaction_has_no_horizontal_moment_about_the_zero_moment_point(case: Case) -> None:
    _, machine, motion, wrench = case
    reaction = flat(machine.ground_reaction(*motion, [wrench]))
    point = np.append(flat(machine.zero_moment_point(*motion, [wrench])), 0.0)
    moment = reaction[:3] - np.cross(point, reaction[3:])
    np.testing.assert_allclose(moment[:2], 0, atol=1e-9 * np.abs(reaction).max())


def hand_form(machine: Standing, q: Array, qd: Array, point: Array) -> tuple[Array, Array, Array]:
    """J_m, H_m, C of (18), summed over links as printed and corrected, from derivatives of positions alone."""
    robot, n = machine.robot, machine.joint_size
    at = ca.SX.sym("q", n)
    frames = link_frames(robot, at, machine.world_from_base())
    J_m, H_m, C = np.zeros((2, n)), np.zeros((2, n, n)), np.zeros(2)
    for link in robot.links:
        center = frames[link.name].point(link.center_of_mass)
        J = ca.jacobian(center, at)
        spin = frame_jacobian(robot, at, link.name, world_from_base=machine.world_from_base())[0:3, :]
        turn = frames[link.name].rotation
        inertia = ca.mtimes([turn, ca.DM(link.inertia), turn.T])
        # tau = I (A q'' + q'^T dA q') + (A q') x (I A q'): its rows I[k] and planes P[k]
        rows = ca.mtimes(inertia, spin)
        rates = ca.SX.sym("rates", n)
        omega = ca.mtimes(spin, rates)
        twisting = ca.mtimes(inertia, ca.jtimes(omega, at, rates)) + ca.cross(omega, ca.mtimes(inertia, omega))
        P = [ca.hessian(twisting[k], rates)[0] / 2 for k in range(3)]
        H = [ca.hessian(center[k], at)[0] for k in range(3)]
        outputs = [ca.densify(part) for part in (center, J, rows, *H, *P)]
        values = [numeric(value) for value in ca.Function("link", [at, rates], outputs)(q, qd)]
        (x, y, z), J, spun, H, P = values[0].ravel(), values[1], values[2], values[3:6], values[6:9]
        m = link.mass
        J_m[0] += m * (x - point[0]) * J[2] - m * z * J[0] - spun[1]
        J_m[1] += m * (y - point[1]) * J[2] - m * z * J[1] + spun[0]
        H_m[0] += m * (x - point[0]) * H[2] - m * z * H[0] - P[1]
        H_m[1] += m * (y - point[1]) * H[2] - m * z * H[1] + P[0]
        C -= machine.gravity * m * (np.array([x, y]) - point)
    return J_m, H_m, C


@given(seeds, st.integers(1, 4))
@few
def test_the_rows_of_the_zmp_equation_equal_the_hand_form(seed: int, size: int) -> None:
    rng, machine, (q, qd, _), _ = case(seed, size)
    point = rng.normal(size=2)
    J_m, H_m, C = hand_form(machine, q, qd, point)
    rows = machine.zmp_rows(q, qd, point)
    close(rows.jacobian, J_m.ravel(), 1e-7)
    close(rows.right, C, 1e-7)
    for result, plane in zip(rows.hessians, H_m, strict=True):
        close(result, ((plane + plane.T) / 2).ravel(), 1e-7)


@given(cases)
@few
def test_accelerations_that_meet_the_rows_put_the_zero_moment_point_there(case: Case) -> None:
    """J_m q'' - (C - q' H_m q') = F_z (zmp - point), for any acceleration and wrench."""
    rng, machine, (q, qd, qdd), wrench = case
    point = rng.normal(size=2)
    rows = machine.zmp_rows(q, qd, point, [wrench])
    vertical = flat(machine.ground_reaction(q, qd, qdd, [wrench]))[5]
    off = flat(machine.zero_moment_point(q, qd, qdd, [wrench])) - point
    close(ca.mtimes(rows.jacobian, qdd) - rows.needed(qd), vertical * off, 1e-8, 1e-8)


def test_the_index_is_1_at_the_most_stable_point_and_0_at_the_half_widths() -> None:
    for point, index in (((0, 0), (1, 1)), ((0.05, -0.1), (0, 0)), ((0, 0.05), (1, 0.75)), ((0, 0.2), (1, -3))):
        close(EXAMPLE.stability_index(point), index, 1e-7, 1e-12)
    # by default that of the bounding box: positive exactly inside a rectangle
    close(standing_arm().stability_index((0.15, -0.2)), 0, 0, 1e-12)


def test_a_spring_pulls_back_to_its_rest() -> None:
    (wrench,) = tip_spring(EXAMPLE, (0, 150, 0), (0, 0.3, 1.0))(0.0, ca.DM([0.1, 0.5, 0.9]))
    np.testing.assert_allclose(flat(wrench.force), [0, -30, 0])
    assert wrench.link == EXAMPLE.robot.tip


@pytest.mark.long
@given(cases)
@few
def test_a_sampled_motion_is_evaluated_point_by_point(case: Case) -> None:
    rng, machine, _, _ = case
    q, qd, qdd = rng.normal(size=(3, 4, machine.joint_size))
    t, pull = np.array([0.0, 0.1, 0.3, 0.7]), rng.normal(size=3)

    def wrenches(time: Any, tip: Any) -> list[Wrench]:
        return [machine.tip_wrench(time * ca.DM(pull) - 2 * tip)]

    result = standing_motion(machine, t, q, qd, joint_accelerations=qdd, wrenches=wrenches)
    for k in range(4):
        push = t[k] * pull - 2 * flat(machine.tip_pose((), q[k]).position)
        motion = q[k], qd[k], qdd[k], [machine.tip_wrench(push)]
        reaction = flat(machine.ground_reaction(*motion))
        point = flat(center_of_pressure(reaction))
        close(result.ground_force[k], reaction[3:], 1e-7)
        close(result.zero_moment_point[k], point)
        close(machine.stability_index(point), result.index[k], 1e-9, 0)
        close(machine.joint_torques(*motion), result.joint_torques[k], 1e-7)
        close(result.external_force[k], push, 1e-7, 1e-12)
        inside = bool((point > 0).all() and point.sum() < 1)
        assert (result.foot_margin[k] > 0) == inside
    lifted = result.ground_force[:, 2] <= 0
    assert result.stays_on_ground == (not lifted.any())
    assert np.isinf(result.friction[lifted]).all()
    level = np.linalg.norm(result.ground_force[~lifted, :2], axis=1)
    np.testing.assert_allclose(result.friction[~lifted] * result.ground_force[~lifted, 2], level, rtol=1e-12)
    assert result.summary()["stands"] == result.stands


def test_the_joint_limit_index_and_excess_have_their_closed_forms() -> None:
    lower, upper = EXAMPLE.robot.lower, EXAMPLE.robot.upper
    beyond = upper + np.array([0, 0, 0.2, 0, 0])
    q = np.array([lower, upper, (lower + upper) / 2, beyond])
    outcome = standing_motion(EXAMPLE, np.arange(4.0), q, 0 * q, joint_accelerations=0 * q)
    np.testing.assert_allclose(outcome.joint_limit_index[:3], [5 / 4, 5 / 4, 0], atol=1e-12)
    np.testing.assert_allclose(outcome.joint_excess[[0, 1, 3]], [0, 0, 0.2], atol=1e-12)
    assert outcome.joint_excess[2] < 0
    assert not outcome.stays_in_limits
    assert standing_motion(EXAMPLE, np.arange(3.0), q[:3], 0 * q[:3], joint_accelerations=0 * q[:3]).stays_in_limits


def test_a_joint_without_limits_adds_nothing_to_the_index() -> None:
    free = Standing(planar_chain([1.0, 1.0], [1.0, 1.0]), support=FOOT)
    outcome = standing_motion(free, [0.0], [[5.0, -9.0]], [[0.0, 0.0]], joint_accelerations=[[0.0, 0.0]])
    assert outcome.joint_limit_index.tolist() == [0.0]
    assert outcome.joint_excess.tolist() == [-np.inf]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gravity": 0.0}, "gravity must be positive and finite .*, not 0.0"),
        ({"half_widths": (0.1, 0.0)}, "half_widths .* not positive"),
        ({"most_stable_point": (0.1,)}, "most_stable_point has shape"),
        ({"robot": planar_chain([1.0], [0.0])}, "has no mass"),
        ({"robot": Robot((Link("stone", 1.0),))}, "no moving joint"),
        ({"support": "wide"}, r"support must be a Support, .* not 'wide'"),
        ({"gravity": -9.81}, "gravity must be positive and finite .*, not -9.81"),
        ({"gravity": np.nan}, "gravity must be .*, not nan"),
    ],
)
def test_machines_that_cannot_stand_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        replace(EXAMPLE, **changes)


def test_a_motion_of_a_wrong_shape_is_refused() -> None:
    with pytest.raises(ModelError, match=r"joint_velocities has shape \(2, 4\), expected \(2, 5\)"):
        standing_motion(EXAMPLE, [0, 1], np.zeros((2, 5)), np.zeros((2, 4)), joint_accelerations=np.zeros((2, 5)))


def test_a_negative_mass_is_refused_by_the_name_of_its_link() -> None:
    with pytest.raises(ModelError, match=r"link 'link2'.* mass.*-14"):
        planar_chain((0.44, 0.44), (6.02, -14.0))
    with pytest.raises(ModelError, match=r"'counterweight'.*-1"):
        Link("counterweight", -1.0)


def test_wrenches_that_are_no_list_are_refused() -> None:
    rest, alone = np.zeros(5), EXAMPLE.tip_wrench((0, 0, 1))
    for name in ("zero_moment_point", "joint_torques", "ground_reaction"):
        call: Any = getattr(EXAMPLE, name)
        with pytest.raises(ModelError, match="wrenches must be a list"):
            call(rest, rest, rest, alone)


def test_a_function_of_wrenches_with_wrong_arguments_is_refused_by_name() -> None:
    functions: tuple[Any, ...] = (lambda: [], lambda time: [], lambda time, tip, more: [])
    for function in functions:
        with pytest.raises(ModelError, match=r"wrenches: the function fails: TypeError.*argument") as refusal:
            wrenches_at(function, EXAMPLE, (), np.zeros(5), time=0.0)
        assert refusal.value.value is function


@pytest.mark.parametrize("times", [[], ["soon"], [np.nan]])
def test_a_motion_of_no_times_is_refused(times: Any) -> None:
    rest = np.zeros((len(times), 5))
    with pytest.raises(ModelError, match="motion: "):
        standing_motion(EXAMPLE, times, rest, rest, joint_accelerations=rest)
