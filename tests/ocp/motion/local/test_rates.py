from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from models import FixedBase, FreeFloating, Machine, paper_example, planar_chain
from ocp import ProblemError, RateOptions, Start, TipTask, resolve
from ocp.motion.local.rates import LocalSolution, least_rates
from tests.models.robot.trees import Array, numeric, random_base, random_robot, seeds, seven_joint_arm

PAPER_START = np.deg2rad([45.0, 60.0, -60.0])


def assert_identical_law(
    machine: Machine, local: LocalSolution, rows: list[int], velocity: Any, damping: float
) -> None:
    """The rates are those of numpy's (damped) pseudo-inverse, at every sample."""
    for k, time in enumerate(local.t):
        jacobian = numeric(machine.tip_jacobian(local.base[k], local.joints[k]))[rows]
        square = jacobian @ jacobian.T + damping**2 * np.eye(len(rows))
        expected = jacobian.T @ np.linalg.solve(square, velocity(time))
        np.testing.assert_allclose(local.joint_rates[k], expected, rtol=1e-8, atol=1e-10)


def test_the_papers_pseudo_inverse_peaks_are_reproduced() -> None:
    """Peaks refined on a grid of 0.1 ms; reference: an independent simulation by RK4, 1 ms."""
    dense = np.concatenate([[0.0], np.linspace(2.9, 3.2, 3001), [3.5]])
    local = resolve(paper_example(), TipTask(rows=(3, 4), velocity=(-1.0, -1.0)), 3.5, start=PAPER_START, samples=dense)
    assert local.stopped is None
    degrees = np.rad2deg(local.joint_rates)
    for joint, (peak, at) in enumerate([(153.73, 3.044), (66.97, 2.996), (-109.08, 3.043)]):
        k = int(np.abs(degrees[:, joint]).argmax())
        assert degrees[k, joint] == pytest.approx(peak, abs=0.05)
        assert local.t[k] == pytest.approx(at, abs=1.1e-3)
    least = int(local.manipulability.argmin())
    assert local.manipulability[least] == pytest.approx(0.476, abs=5e-4)
    assert local.t[least] == pytest.approx(3.045, abs=1.1e-3)


def test_the_tip_follows_its_velocity_and_the_momentum_stays_zero() -> None:
    machine = paper_example()
    local = resolve(
        machine, TipTask(rows=(3, 4), velocity=lambda t: [-ca.cos(t), -1 + 0.2 * t]), 2.0, start=PAPER_START, samples=41
    )
    t = local.t
    moved = local.tip_in_world - local.tip_in_world[0]
    np.testing.assert_allclose(moved[:, 0], -np.sin(t), atol=1e-8)
    np.testing.assert_allclose(moved[:, 1], -t + 0.1 * t**2, atol=1e-8)
    for k in range(len(t)):
        residual = machine.momentum_residual(local.base[k], local.joints[k], local.base_rates[k], local.joint_rates[k])
        np.testing.assert_allclose(numeric(residual), 0, atol=1e-10)


def test_all_six_rows_of_a_spatial_machine_on_a_floating_base_are_followed() -> None:
    machine = FreeFloating(seven_joint_arm(), "spatial")
    start = np.array([0.3, 0.6, -0.2, 1.2, 0.4, 0.9, -0.3])
    velocity = np.array([0.05, -0.02, 0.04, 0.05, -0.05, 0.03])
    rows = list(range(6))
    local = resolve(machine, TipTask(rows=rows, velocity=velocity), 1.0, start=start, samples=11)
    assert local.stopped is None
    assert_identical_law(machine, local, rows, lambda _: velocity, 0.0)
    np.testing.assert_allclose(local.tip_in_world[-1] - local.tip_in_world[0], velocity[3:], atol=1e-8)
    # A constant angular velocity turns the tip by exp(omega t).
    angle = float(np.linalg.norm(velocity[:3]))
    k = numeric(ca.skew(ca.DM(velocity[:3]))) / angle
    turned = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    before, after = (numeric(machine.tip_pose(local.base[i], local.joints[i]).rotation) for i in (0, -1))
    np.testing.assert_allclose(after, turned @ before, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(local.base[:, 3:], axis=1), 1.0, atol=1e-9)


@settings(max_examples=10)
@given(seeds, st.sampled_from([0.0, 0.05, 0.5]), st.sampled_from(["fixed", "planar", "spatial"]))
def test_the_rates_are_those_of_the_damped_pseudo_inverse(seed: int, damping: float, kind: str) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 6, "planar" if kind == "planar" else "spatial")
    machine: Any = FixedBase(robot) if kind == "fixed" else FreeFloating(robot, kind)  # type: ignore[arg-type]
    base = None if kind == "fixed" else random_base(rng, machine.base)
    start, speed = rng.normal(size=machine.joint_size), float(rng.normal())
    jacobian = numeric(machine.tip_jacobian(np.zeros(0) if base is None else base, start))
    assume(np.abs(jacobian[3]).max() > 1e-6)  # some random arms do not move their tip along x
    local = resolve(
        machine,
        TipTask(rows=(3,), velocity=lambda t: speed * ca.cos(t)),
        0.2,
        start=Start(start, base=base),
        samples=4,
        options=RateOptions(damping=damping),
    )
    assert_identical_law(machine, local, [3], lambda t: np.array([speed * np.cos(t)]), damping)
    np.testing.assert_allclose(local.joints[0], start)


@pytest.mark.long
def test_the_motion_agrees_with_another_integrator_and_improves_with_the_tolerance() -> None:
    machine = paper_example()

    def rate(_: float, state: Array) -> Array:
        jacobian = numeric(machine.tip_jacobian(state[:3], state[3:]))[3:5]
        rates = np.linalg.pinv(jacobian) @ [-1.0, -1.0]
        return np.concatenate([numeric(machine.base_rate(state[:3], state[3:], rates)).ravel(), rates])

    start = np.concatenate([np.zeros(3), PAPER_START])
    reference = solve_ivp(rate, (0, 1.5), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    errors = []
    for tolerance in (1e-4, 1e-7, 1e-10):
        local = resolve(
            machine,
            TipTask(rows=(3, 4), velocity=(-1, -1)),
            1.5,
            start=PAPER_START,
            options=RateOptions(tolerance=tolerance),
        )
        errors.append(np.abs(np.concatenate([local.base[-1], local.joints[-1]]) - reference).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-8


def test_the_cost_is_half_the_squared_rates_integrated() -> None:
    local = resolve(paper_example(), TipTask(rows=(3, 4), velocity=(-1, -1)), 2.0, start=PAPER_START, samples=2001)
    running = (local.joint_rates**2).sum(axis=1) / 2
    steps = (running[1:] + running[:-1]) / 2 * np.diff(local.t)
    np.testing.assert_allclose(local.cost, np.concatenate([[0], np.cumsum(steps)]), atol=1e-6)


def test_interpolation_is_exact_at_the_samples_and_of_fourth_order_between() -> None:
    machine = paper_example()
    fine = resolve(
        machine, TipTask(rows=(3, 4), velocity=(-1, -1)), 2.0, start=PAPER_START, samples=np.linspace(0, 2, 161)
    )
    errors = []
    for count in (11, 21):
        coarse = resolve(machine, TipTask(rows=(3, 4), velocity=(-1, -1)), 2.0, start=PAPER_START, samples=count)
        np.testing.assert_allclose(coarse.at(coarse.t[3])["joints"], coarse.joints[3], atol=1e-15)
        np.testing.assert_allclose(coarse.at(coarse.t[3])["joint_rates"], coarse.joint_rates[3], atol=1e-15)
        values = np.array([np.concatenate([coarse.at(t)["base"], coarse.at(t)["joints"]]) for t in fine.t])
        errors.append(np.abs(values - np.hstack([fine.base, fine.joints])).max())
    assert 3.3 < np.log2(errors[0] / errors[1]) < 4.7
    np.testing.assert_allclose(fine.at(9.0)["joints"], fine.joints[-1])
    np.testing.assert_allclose(fine.at(-1.0)["joints"], fine.joints[0])


def test_an_arm_that_runs_out_of_reach_stops_there_and_says_why() -> None:
    """Two links of 1 m from x = 1 m outwards at 1 m/s: stretched, and singular, after 1 s."""
    machine = FixedBase(planar_chain([1.0, 1.0], [1.0, 1.0]))
    start = np.deg2rad([60.0, -120.0])
    local = resolve(machine, TipTask(rows=(3, 4), velocity=(1.0, 0.0)), 5.0, start=start)
    assert local.stopped is not None
    assert "singular" in local.stopped
    assert 0.97 <= local.t[-1] < 1.0
    np.testing.assert_allclose(local.tip_in_world[:, 0], 1 + local.t, atol=1e-6)
    for values in (local.joints, local.joint_rates, local.manipulability, local.cost):
        assert len(values) == len(local.t)
        assert np.isfinite(values).all()
    damped = resolve(
        machine, TipTask(rows=(3, 4), velocity=(1.0, 0.0)), 5.0, start=start, options=RateOptions(damping=0.1)
    )
    assert damped.stopped is None
    assert damped.t[-1] == 5.0
    assert np.linalg.norm(damped.tip_in_world[-1]) <= 2.0


def test_a_velocity_from_an_interpolant_is_taken() -> None:
    knots = np.linspace(0, 2, 9)
    table = ca.interpolant("table", "bspline", [knots], np.sin(knots))
    local = resolve(
        paper_example(), TipTask(rows=(3, 4), velocity=lambda t: ca.vertcat(table(t), -0.3)), 2.0, start=PAPER_START
    )
    travelled = np.trapezoid(np.array(table(local.t)).ravel(), local.t)
    assert local.tip_in_world[-1, 0] - local.tip_in_world[0, 0] == pytest.approx(travelled, abs=1e-5)


class ByHand(ca.Callback):  # type: ignore[misc]
    """-0.3 t, known to casadi only as an external function: cannot be called with SX."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("by_hand", {"enable_fd": True})

    def eval(self, arguments: list[Any]) -> list[Any]:
        return [-0.3 * arguments[0]]


def test_a_velocity_from_an_external_function_is_taken() -> None:
    external = ByHand()
    local = resolve(
        paper_example(),
        TipTask(rows=(3, 4), velocity=lambda t: ca.vertcat(external(t), 0)),
        1.0,
        start=PAPER_START,
        samples=5,
    )
    moved = local.tip_in_world - local.tip_in_world[0]
    np.testing.assert_allclose(moved[:, 0], -0.15 * local.t**2, atol=1e-8)


@given(seeds, st.integers(1, 6))
@settings(max_examples=25)
def test_least_rates_do_the_task_and_have_no_part_in_the_null_space(seed: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    jacobian, velocity = rng.normal(size=(rows, 7)), rng.normal(size=rows)
    rates = numeric(least_rates(ca.DM(jacobian), ca.DM(velocity))).ravel()
    np.testing.assert_allclose(rates, np.linalg.pinv(jacobian) @ velocity, rtol=1e-7, atol=1e-9)
    damped = numeric(least_rates(ca.DM(jacobian), ca.DM(velocity), 0.5)).ravel()
    assert np.linalg.norm(damped) < np.linalg.norm(rates)


def velocity_task(velocity: Any, rows: tuple[int, ...] = (3, 4)) -> dict[str, Any]:
    return {"tasks": TipTask(rows=rows, velocity=velocity)}


PAPER_TASK: dict[str, Any] = {**velocity_task((-1.0, -1.0)), "start": PAPER_START, "horizon": 1.0}
REFUSED: list[tuple[dict[str, Any], str]] = [
    (velocity_task((0.0,) * 4, (0, 1, 3, 4)), "fixes 4 rows .* only 3 joints"),
    (velocity_task((0.0, 0.0), (0, 3)), r"rows \[0, 3\]: no joint moves the tip in rows \[0\]"),
    (velocity_task((1.0,)), r"velocity has shape \(1, 1\), expected \(2, 1\)"),
    (velocity_task((1.0, np.nan)), "velocity .* not finite"),
    (velocity_task(lambda t: [t, ca.SX.sym("stranger")]), r"depends on \['stranger'\]"),
    (velocity_task(lambda t: "fast"), "velocity gives 'fast'"),
    ({"start": (0.0, 1.0)}, "start has shape .2,., expected .3,."),
    ({"start": (0.0, 1.0, np.inf)}, "start .* not finite"),
    ({"start": "home"}, "start 'home' is not numeric"),
    ({"horizon": 0.0}, "horizon must be positive and finite"),
    ({"horizon": np.inf}, "horizon must be positive and finite"),
]
"""What is wrong with a request of any motion of the paper's machine, and what the error says."""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *REFUSED,
        ({"start": (0.0, 0.0, 0.0)}, r"rows \[3, 4\] is singular at the start"),
        ({"start": Start(PAPER_START, base=(0.0,) * 7)}, "start_base has shape .7,., expected .3,."),
        ({"start": None}, "start is missing"),
        ({"options": {"damping": 0.1}}, "options must be"),
        ({"samples": 1}, "at least 2 points"),
        ({"samples": (0.0, 0.5, 0.5, 1.0)}, "increasing"),
        ({"samples": (0.1, 1.0)}, "from 0 to the horizon"),
    ],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        resolve(paper_example(), **{**PAPER_TASK, **changes})
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"damping": -1.0}, "damping must be a finite number"), ({"tolerance": 0.0}, "tolerance must be positive")],
)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        RateOptions(**options)


def test_a_quaternion_that_is_none_is_refused() -> None:
    machine = FreeFloating(random_robot(np.random.default_rng(3), 9), "spatial")
    base = np.array([0.0, 0, 0, 1, 1, 0, 0])
    with pytest.raises(ProblemError, match="not of unit length"):
        resolve(machine, TipTask(rows=(3,), velocity=(1.0,)), 1.0, start=Start(np.zeros(machine.joint_size), base=base))
