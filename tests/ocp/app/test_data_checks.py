"""Odd files: what is odd is named, what only looks odd is not; a motion is judged the same however it is written."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest

from models import CollisionScene, FixedBase, FreeFloating, Machine, Robot, Sphere, Standing, mass_matrix, rectangle
from ocp import Plan
from ocp.app import Check, check_trajectory
from ocp.app.check.data_checks import BASES
from ocp.app.check.joint_limits import Motion, PiecewisePolynomial, polynomial_maxima
from ocp.app.check.motion_checks import integrate_base, prove_clearance, torque_expression, with_wide_limits
from ocp.app.files import read_trajectory
from ocp.errors import ProblemError
from ocp.motion.local.collisions import distances_along
from ocp.motion.result.solved_plan import SolvedPlan
from tests.ocp.app.motions import MIDDLE, NAMES, SWING, URDF, check_motion, joint, link, smooth, write_table

GALLERY = Path(__file__).resolve().parents[3] / "results" / "gallery"
SPINNING = (
    '<robot name="gripper"><link name="a"/>'
    + "".join(f'<link name="{name}"/>' for name in "cd")
    + link("b", 0.1, 1.0)
    + joint("spin", "continuous", "a", "b", 0.3, 'velocity="4" effort="100"')
    + joint("left", "prismatic", "b", "c", 0.3, 'lower="0" upper="0.04" velocity="1" effort="9"', "0 1 0")
    + joint(
        "right",
        "prismatic",
        "b",
        "d",
        0.3,
        'lower="0" upper="0.08" velocity="1" effort="9"',
        "0 -1 0",
        '<mimic joint="left" multiplier="2"/>',
    )
    + "</robot>"
)


def checked(
    folder: Path,
    urdf: str,
    names: tuple[str, ...],
    t: Any,
    *values: Any,
    base: Callable[[Robot], Machine] = FixedBase,
    **options: Any,
) -> Check:
    robot = Robot.from_urdf(urdf, tip="finger" if urdf == URDF else None)
    file = write_table(folder / "m.csv", t, *values, names=names)
    return check_motion(base(robot), read_trajectory(file, joints=robot.joint_names), **options)


# ---- enclosures ----------------------------------------------------------------------------------------------------


def test_greatest_values_are_those_of_a_fine_sampling() -> None:
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(300, 6))
    value, place = polynomial_maxima(coefficients)
    s = np.linspace(0.0, 1.0, 2001)
    whole = PiecewisePolynomial(np.arange(301.0), coefficients[:, :, None])
    fine = np.array([whole.within(np.full(2001, k), s)[:, 0].max() for k in range(300)])
    assert (value >= fine).all()
    assert (value <= fine + 1e-4).all()
    np.testing.assert_allclose(whole.within(np.arange(300), place)[:, 0], value, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_a_rule_gives_back_polynomials_of_its_degree(degree: int) -> None:
    rng = np.random.default_rng(degree)
    f = np.polynomial.Polynomial(rng.normal(size=degree + 1))
    t = np.sort(rng.uniform(0.0, 2.0, 7))
    values: list[Any] = [f.deriv(k)(t)[:, None] if k else f(t)[:, None] for k in range((degree + 1) // 2)]
    motion = Motion(t, *values)
    x = np.linspace(t[0], t[-1], 40)
    np.testing.assert_allclose(motion.position.at(x)[:, 0], f(x), atol=1e-9)
    np.testing.assert_allclose(motion.velocity.at(x)[:, 0], f.deriv()(x), atol=1e-9)


def test_divided_differences_are_exact_for_polynomials_of_their_order() -> None:
    f = np.polynomial.Polynomial([0.3, -1.0, 0.7, 0.25])
    t = np.sort(np.random.default_rng(1).uniform(0.0, 2.0, 9))
    result = Motion(t, f(t)[:, None]).quantity("jerk")
    assert result is not None
    assert not result.closed
    np.testing.assert_allclose(result.pieces.coefficients[:, 0, 0], f.deriv(3)(0.0), rtol=1e-6)


@pytest.mark.parametrize("rates", [1, 2, 3])
@pytest.mark.parametrize("count", [20, 500])
def test_proven_distances_lie_below_a_fine_sampling_and_near_it(rates: int, count: int) -> None:
    rng = np.random.default_rng(10 * count + rates)
    t = np.sort(np.concatenate([[0.0, 3.0], rng.uniform(0.0, 3.0, count - 2)]))
    turns, phase = rng.uniform(1.0, 4.0, 4), rng.uniform(0.0, 6.0, 4)
    angle = np.outer(t, turns) + phase
    swing = SWING * [1.5, 1.5, 1.5, 1.0]
    values = [MIDDLE + swing * np.sin(angle), swing * turns * np.cos(angle), -swing * turns**2 * np.sin(angle)]
    motion = Motion(t, *values[:rates])
    arm = FixedBase(Robot.from_urdf(URDF, tip="finger"))
    ball = Sphere(radius=0.1, position=rng.uniform([0.3, -0.2, 0.3], [0.9, 0.6, 0.6]))
    around = CollisionScene(with_wide_limits(arm, motion), [ball], 0.05)
    result = prove_clearance(around, motion)
    assert result.settled
    fine = np.unique(np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 21) for a, b in pairwise(t)]))
    apart = distances_along(around, np.zeros(0), motion.position.at(fine), fine)
    least = dict(zip(around.labels, apart.min(axis=0), strict=True))
    for near in result.pairs:
        assert near.least <= least[near.bodies] + 1e-12
    worst = min(result.pairs, key=lambda near: near.distance)
    nearest = min(least.values())
    assert worst.distance <= nearest + 1e-3
    assert min(near.least for near in result.pairs) >= nearest - max(0.03 * abs(nearest - 0.05), 1e-3)


# ---- what only looks odd -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("digits", [3, 4, 6])
def test_digits_that_a_file_has_not_are_no_fault(tmp_path: Path, digits: int) -> None:
    t, q, *_ = smooth(2001)
    check = checked(tmp_path, URDF, NAMES, t, np.round(q, digits), acceleration=8.0, jerk=60.0)
    assert check.passed, check
    assert "undetermined" in check.sentence
    t, q, v, _ = smooth(2001)
    single = q.astype(np.float32).astype(float), v.astype(np.float32).astype(float)
    assert checked(tmp_path, URDF, NAMES, t, *single, acceleration=8.0, jerk=60.0).passed


def test_noise_is_no_jump(tmp_path: Path) -> None:
    t, q, *_ = smooth(2001)
    noisy = q + 1e-4 * np.random.default_rng(0).normal(size=q.shape)
    assert not [one for one in checked(tmp_path, URDF, NAMES, t, noisy).faults if one.kind == "jump"]


def test_a_joint_without_end_may_turn_on_and_be_wrapped(tmp_path: Path) -> None:
    t = np.linspace(0.0, 20.0, 1001)
    left, still = 0.02 + 0.01 * np.sin(t), 0.01 * np.cos(t)
    wrapped = (2 * t + np.pi) % (2 * np.pi) - np.pi
    for spin, notes in ((2 * t, 0), (wrapped, 1)):
        q, v = np.column_stack([spin, left]), np.column_stack([0 * t + 2, still])
        for values in ([q], [q, v]):
            check = checked(tmp_path, SPINNING, ("spin", "left"), t, *values, scene=False)
            assert check.passed, check
            assert len(check.notes) == notes, check
            row = next(row for row in check.rows if row.name == "velocity of spin")
            assert row.value == pytest.approx(2.0, abs=1e-6)
    fast = checked(tmp_path, SPINNING, ("spin", "left"), t, np.column_stack([np.degrees(2 * t), left]), scene=False)
    assert [one.kind for one in fast.faults] == ["units"]


def test_a_joint_with_limits_that_was_wrapped_jumps(tmp_path: Path) -> None:
    t, q, *_ = smooth()
    q[:, 1] = (2.5 + 0.3 * t + np.pi) % (2 * np.pi) - np.pi
    check = checked(tmp_path, URDF, NAMES, t, q, scene=False)
    fault = next(one for one in check.faults if one.kind == "jump")
    assert fault.name == "elbow"
    assert "a whole turn" in fault.text
    assert fault.time == pytest.approx((np.pi - 2.5) / 0.3, abs=0.02)


@pytest.mark.parametrize("huge", [40.0, 1e9, 1e17, 1e300])
def test_a_jump_of_many_turns_is_not_a_wrapped_angle(tmp_path: Path, huge: float) -> None:
    t, q, *_ = smooth()
    q[50, 1] = huge
    check = checked(tmp_path, URDF, NAMES, t, q, scene=False)
    assert not any("wrapped" in fault.text for fault in check.faults)
    assert any(fault.name == "elbow" and fault.kind == "position" for fault in check.faults), check


def test_followers_follow(tmp_path: Path) -> None:
    t = np.linspace(0.0, 2.0, 101)
    left = 0.02 + 0.01 * np.sin(t)
    names = ("spin", "left", "right")
    sound = np.column_stack([t, left, 2 * left])
    assert checked(tmp_path, SPINNING, names, t, sound, scene=False).passed
    wrong = np.column_stack([t, left, np.where(t > 1.2, left, 2 * left)])
    (fault,) = checked(tmp_path, SPINNING, names, t, wrong, scene=False).faults
    assert (fault.kind, fault.name) == ("follower", "right")
    assert (fault.time or 0.0) > 1.2
    check = checked(tmp_path, SPINNING, ("spin", "right"), t, np.column_stack([t, 2 * left]), scene=False)
    assert "its follower right is given" in check.faults[0].text


def test_times_in_nanoseconds(tmp_path: Path) -> None:
    t, q, *_ = smooth()
    check = checked(tmp_path, URDF, NAMES, np.rint(1e9 * t), q)
    assert [(one.kind, one.name) for one in check.faults] == [("units", "time")]
    assert check.duration == pytest.approx(4.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_samples(tmp_path: Path, count: int) -> None:
    t, q, v, a = smooth(11)
    for values in ([q], [q, v], [q, v, a]):
        check = checked(tmp_path, URDF, NAMES, t[:count], *(one[:count] for one in values), acceleration=50.0)
        assert {one.kind for one in check.faults} <= {"velocity", "acceleration", "torque"}
        assert check.samples == count


@pytest.mark.parametrize("rounding", [0.0, 1.77e-10, 1e-7])
def test_a_single_sample_is_at_rest_whatever_its_velocities_are_rounded_to(tmp_path: Path, rounding: float) -> None:
    t, q, v, _ = smooth(11)
    check = checked(tmp_path, URDF, NAMES, t[:1], q[:1], np.full_like(v[:1], rounding))
    assert check.passed
    assert "at rest" in {row.note for row in check.rows}
    assert "starts at" not in check.sentence


def test_where_a_file_begins_changes_no_verdict(tmp_path: Path) -> None:
    t, q, v, _ = smooth()
    limits = {"elbow": 0.9}
    first = checked(tmp_path, URDF, NAMES, t, q, v, velocity=limits).faults[0]
    for shift in (-100.0, 1e5):
        again = checked(tmp_path, URDF, NAMES, t + shift, q, v, velocity=limits).faults[0]
        assert again.value == pytest.approx(first.value, rel=1e-9)
        assert (again.time or 0.0) - shift == pytest.approx(first.time, abs=1e-4)


# ---- bases ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planar", [False, True])
def test_a_floating_base_that_violates_momentum_is_a_fault(tmp_path: Path, planar: bool) -> None:
    text = URDF if not planar else URDF.replace('axis xyz="0 -1 0"', 'axis xyz="0 0 1"')
    t, q, v, a = smooth()
    kind: Literal["planar", "spatial"] = "planar" if planar else "spatial"
    machine = FreeFloating(Robot.from_urdf(text), kind)
    base, rows = integrate_base(machine, Motion(t, q, v, a))
    assert max(row.value for row in rows) > 0.05
    names = (*NAMES, *BASES[1 if planar else 0])
    assert checked(tmp_path, text, names, t, np.column_stack([q, base]), base=partial(FreeFloating, base=kind)).passed
    base[:, 0] += 0.02 * np.sin(t) ** 2
    check = checked(tmp_path, text, names, t, np.column_stack([q, base]), base=partial(FreeFloating, base=kind))
    assert {one.kind for one in check.faults} == {"momentum"}
    assert checked(tmp_path, text, NAMES, t, q, v, base=partial(FreeFloating, base=kind)).passed


@pytest.mark.parametrize("planar", [False, True])
def test_torques_of_a_floating_arm_are_the_power_that_goes_into_its_motion(planar: bool) -> None:
    """dT/dt = torque . rates, T the kinetic energy of the whole; and where the base is changes nothing."""
    text = URDF if not planar else URDF.replace('axis xyz="0 -1 0"', 'axis xyz="0 0 1"')
    machine = FreeFloating(Robot.from_urdf(text), "planar" if planar else "spatial")
    q, v, a = (ca.SX.sym(name, 4) for name in "qva")
    base = ca.DM(machine.base_home())
    inertia, joints = machine.momentum_matrices(base, q)
    held = mass_matrix(machine.robot, q)
    twist = machine.base_twist(base, q, v)
    energy = (ca.bilin(held, v, v) + ca.bilin(inertia, twist, twist)) / 2 + ca.dot(twist, ca.mtimes(joints, v))
    power = ca.jtimes(energy, ca.vertcat(q, v), ca.vertcat(v, a))
    options = ca.dot(torque_expression(machine, q, v, a), v)
    function = ca.Function("power", [q, v, a], [power, options])
    rng = np.random.default_rng(3)
    for _ in range(5):
        one, other = function(*rng.normal(size=(3, 4)))
        assert float(one) == pytest.approx(float(other), rel=1e-9, abs=1e-9)


def test_a_floating_base_beside_an_obstacle(tmp_path: Path) -> None:
    t, q, v, a = smooth()
    ball = Sphere(radius=0.2, position=(0.9, 0.3, 0.4))
    check = checked(tmp_path, URDF, NAMES, t, q, v, a, base=FreeFloating, obstacles=[ball])
    assert {one.kind for one in check.faults} == {"clearance"}
    far = Sphere(radius=0.2, position=(9.0, 0.0, 0.0))
    assert checked(tmp_path, URDF, NAMES, t, q, v, a, base=FreeFloating, obstacles=[far]).passed


def test_the_zero_moment_point_is_that_of_the_standing_machine(tmp_path: Path) -> None:
    t, q, v, a = smooth()
    robot = Robot.from_urdf(URDF, tip="finger")
    wide = rectangle((-1.0, 2.0), (-1.0, 1.0))
    assert checked(tmp_path, URDF, NAMES, t, q, v, a, base=partial(Standing, support=wide)).passed
    machine = Standing(robot=robot, support=wide)
    symbols = [ca.SX.sym(name, 4) for name in "qva"]
    zmp = ca.Function("zmp", symbols, [machine.zero_moment_point(*symbols)])
    points = np.array(zmp(q.T, v.T, a.T)).T
    narrow = rectangle((-1.0, float(points[:, 0].max()) - 0.01), (-1.0, 1.0))
    check = checked(tmp_path, URDF, NAMES, t, q, v, a, base=partial(Standing, support=narrow))
    (fault,) = check.faults
    assert fault.kind == "zero moment point"
    assert fault.time == pytest.approx(t[points[:, 0].argmax()], abs=0.02)
    assert fault.value == pytest.approx(-0.01, abs=1e-4)


# ---- the package's own plans ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "self_collision"),
    [("ur5", True), ("panda", False), ("space_arm", False), ("mobile_manipulator", False), ("pushing", False)],
)
@pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")
def test_the_plans_of_the_gallery_are_not_accused(tmp_path: Path, name: str, self_collision: bool) -> None:
    loaded = Plan.load(GALLERY / f"{name}.npz")
    assert isinstance(loaded, SolvedPlan)
    machine, robot = loaded.machine, loaded.machine.robot
    sample = loaded.sampled(np.linspace(0.0, loaded.horizon, round(loaded.horizon / 0.01) + 1))
    more = [sample.accelerations] if loaded.rate_name == "velocities" else []
    base = machine if machine.base_size else FixedBase(robot, machine.translation, machine.rotation)  # type: ignore[attr-defined]
    for values in ([sample.joints], [sample.joints, sample.rates], [sample.joints, sample.rates, *more]):
        file = write_table(tmp_path / "m.csv", sample.t, *values, names=loaded.names)
        raw = read_trajectory(file, joints=robot.joint_names)
        check = check_trajectory(base, raw, scene=None if self_collision else False)
        assert check.passed, check


# ---- what is asked ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"velocity": {"nobody": 1.0}}, "nobody"),
        ({"acceleration": -1.0}, "acceleration"),
        ({"jerk": "much"}, "jerk"),
        ({"torque": [1.0, 2.0]}, "torque"),
        ({"rule": "septic"}, "rule"),
        ({"time_unit": "min"}, "time_unit"),
        ({"share": -1.0}, "share"),
        ({"tip_distance": 0.0}, "tip_distance"),
        ({"tip_angle": np.nan}, "tip_angle"),
        ({"friction": 0.0}, "friction"),
    ],
)
def test_invalid_options_are_refused_by_name(tmp_path: Path, options: dict[str, Any], name: str) -> None:
    t, q, *_ = smooth(11)
    with pytest.raises(ProblemError) as caught:
        checked(tmp_path, URDF, NAMES, t, q, **options)
    assert caught.value.name == name
