from __future__ import annotations

import dataclasses
from typing import Any

import casadi as ca
import numpy as np
import pytest

import models
from models import FixedBase, FreeFloating, Joint, Link, Machine, Robot, paper_example, planar_chain
from ocp import Collocation, MultipleShooting, Problem, Solution, solve
from ocp.builders.redundancy import minimum_velocity_problem
from ocp.errors import ProblemError
from ocp.local.rates import resolve
from tests.models.robot.trees import numeric, seven_joint_arm

PAPER_START = np.deg2rad([45.0, 60.0, -60.0])
PAPER_COST = 1.735114311245  # backward-shooting minimum principle, horizon 5 s
ARM_START = np.array([0.3, 0.6, -0.2, 1.2, 0.4, 0.9, -0.3])


def paper_problem(**changes: Any) -> Problem:
    return minimum_velocity_problem(paper_example(), (-1.0, -1.0), (3, 4), PAPER_START, 5.0, **changes)


def slides(**limits: Any) -> FixedBase:
    """Two slides along x, one on the other: x1' + x2' = v, whose least-velocity split is v / 2 each."""
    first = Joint("first", "prismatic", "rail", "carriage", axis=(1, 0, 0), **limits)
    second = Joint("second", "prismatic", "carriage", "tool", axis=(1, 0, 0))
    return FixedBase(Robot((Link("rail"), Link("carriage"), Link("tool")), (first, second)))


def assert_does_its_task(machine: Machine, solution: Solution, velocity: Any, rows: list[int]) -> None:
    """Twist at every collocation point, and the centre of mass of what floats."""
    rates = rates_of(machine, solution, velocity, rows)
    base = solution["base"] if machine.base_size else np.zeros((len(solution.t), 0))
    for k in collocated(solution):
        twist = numeric(machine.tip_jacobian(base[k], solution["joints"][k])) @ rates[k]
        np.testing.assert_allclose(twist[rows], velocity(solution.t[k]), atol=1e-8)
    if isinstance(machine, FreeFloating):
        center = [center_of_mass(machine, base[k], solution["joints"][k]) for k in range(len(solution.t))]
        np.testing.assert_allclose(center, np.broadcast_to(center[0], (len(center), 3)), atol=1e-6)


def collocated(solution: Solution) -> list[int]:
    """Indices of the reported times that are collocation points:

    At the others the controls are interpolated.
    """
    count = solution.method["intervals"]
    points = np.array(ca.collocation_points(solution.method["degree"], solution.method["scheme"]))
    times = (np.arange(count)[:, None] + points).ravel() / count * solution.horizon
    return [k for k, time in enumerate(solution.t) if np.abs(times - time).min() < 1e-9]


def rates_of(machine: Machine, solution: Solution, velocity: Any, rows: list[int]) -> Any:
    if "rates" in solution.controls:
        return solution["rates"]
    base = solution["base"] if machine.base_size else np.zeros((len(solution.t), 0))
    rates = []
    for k, time in enumerate(solution.t):
        jacobian = numeric(machine.tip_jacobian(base[k], solution["joints"][k]))[rows]
        inverse, null = np.linalg.pinv(jacobian), solution["null"][k]
        rates.append(null + inverse @ (velocity(time) - jacobian @ null))
    return np.array(rates)


def center_of_mass(machine: FreeFloating, base: Any, joints: Any) -> Any:
    return numeric(models.center_of_mass(machine.robot, joints, machine.world_from_base(base))).ravel()


@pytest.mark.parametrize("formulation", ["rates", "null_space"])
def test_the_papers_example_reaches_its_reference_optimum(formulation: Any) -> None:
    solution = solve(paper_problem(formulation=formulation), Collocation(intervals=50, degree=3, scheme="legendre"))
    assert solution.cost == pytest.approx(PAPER_COST, abs=1e-8)
    assert_does_its_task(paper_example(), solution, lambda _: [-1.0, -1.0], [3, 4])
    peaks = np.rad2deg(np.abs(rates_of(paper_example(), solution, lambda _: [-1, -1], [3, 4])).max(axis=0))
    np.testing.assert_allclose(peaks, [46.10, 24.26, 77.95], atol=0.03)


def test_the_papers_optimum_passes_its_audit_and_beats_the_pseudo_inverse() -> None:
    solution = solve(paper_problem(), Collocation(intervals=50, degree=3, scheme="legendre"))
    audit = solution.audit()
    assert audit.passed, str(audit)
    local = resolve(paper_example(), (-1.0, -1.0), (3, 4), PAPER_START, 5.0)
    assert solution.cost < 0.6 * local.cost[-1]


def test_the_papers_optimum_satisfies_the_minimum_principle() -> None:
    """(31), (35): the free end has no costate, H is constant, and u minimises H in the null space of G."""
    machine = paper_example()
    solution = solve(paper_problem(), Collocation(intervals=100, degree=3, scheme="legendre"))
    base, joints = solution.costate("base"), solution.costate("joints")
    np.testing.assert_allclose(base[-1], 0, atol=1e-5)
    np.testing.assert_allclose(joints[-1], 0, atol=1e-5)
    hamiltonian = []
    for k in collocated(solution):
        place, q, rates = solution["base"][k], solution["joints"][k], solution["rates"][k]
        b, r = ca.SX.sym("b", 3), ca.SX.sym("r", 3)
        reaction = numeric(ca.Function("f", [b], [ca.jacobian(machine.base_rate(b, ca.DM(q), r), r)])(place))
        hamiltonian.append(rates @ rates / 2 + base[k] @ reaction @ rates + joints[k] @ rates)
        jacobian = numeric(machine.tip_jacobian(place, q))[3:5]
        null = np.eye(3) - np.linalg.pinv(jacobian) @ jacobian
        stationarity = null @ (rates + reaction.T @ base[k] + joints[k])
        np.testing.assert_allclose(stationarity, 0, atol=2e-5)
    np.testing.assert_allclose(hamiltonian, hamiltonian[0], atol=2e-5)


@pytest.mark.parametrize(("control", "order"), [("held", 2), ("linear", 4)])
def test_shooting_reaches_the_papers_optimum_from_above_at_its_order(control: Any, order: int) -> None:
    problem = paper_problem(formulation="null_space")
    errors = [
        solve(problem, MultipleShooting(intervals=n, integrator="rk4", control=control)).cost - PAPER_COST
        for n in (50, 100)
    ]
    assert 0 < errors[1] < errors[0] < 2e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("formulation", ["rates", "null_space"])
def test_an_arm_on_a_fixed_base_does_better_than_instantly(formulation: Any) -> None:
    machine = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0, 1.0, 1.0]))

    def velocity(time: Any) -> list[Any]:
        return [-0.3 * ca.cos(time), 0.3 * ca.sin(2 * time)]

    start = np.deg2rad([30.0, 40.0, 50.0])
    problem = minimum_velocity_problem(machine, velocity, (3, 4), start, 3.0, formulation=formulation)
    solution = solve(problem, Collocation(intervals=20, degree=3))
    assert list(solution.states) == ["joints"]
    audit = solution.audit()
    assert audit.passed, str(audit)
    assert_does_its_task(machine, solution, lambda t: [-0.3 * np.cos(t), 0.3 * np.sin(2 * t)], [3, 4])
    local = resolve(machine, velocity, (3, 4), start, 3.0)
    assert solution.cost < local.cost[-1] - 1e-5
    np.testing.assert_allclose(solution.costate("joints")[-1], 0, atol=1e-4)


def test_both_formulations_have_one_optimum_on_a_fixed_base() -> None:
    machine = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0, 1.0, 1.0]))
    start = np.deg2rad([30.0, 40.0, 50.0])
    costs = [
        solve(
            minimum_velocity_problem(machine, (-0.2, 0.1), (3, 4), start, 3.0, formulation=formulation),
            Collocation(intervals=20, degree=3, scheme="legendre"),
        ).cost
        for formulation in ("rates", "null_space")
    ]
    assert costs[0] == pytest.approx(costs[1], abs=1e-10)


@pytest.mark.parametrize(("rows", "horizon"), [((3, 4, 5), 3.0), ((0, 1, 2, 3, 4, 5), 1.0)])
def test_a_spatial_seven_joint_arm_on_a_floating_base_is_planned(rows: tuple[int, ...], horizon: float) -> None:
    machine = FreeFloating(seven_joint_arm(), "spatial")
    velocity = np.array([0.02, -0.03, 0.04, 0.1, -0.1, 0.05])[list(rows)]
    problem = minimum_velocity_problem(machine, velocity, rows, ARM_START, horizon)
    solution = solve(problem, Collocation(intervals=12, degree=3, scheme="legendre"))
    audit = solution.audit()
    assert audit.passed, str(audit)
    assert_does_its_task(machine, solution, lambda _: velocity, list(rows))
    np.testing.assert_allclose(np.linalg.norm(solution["base"][:, 3:], axis=1), 1.0, atol=1e-9)
    assert solution.cost < resolve(machine, velocity, rows, ARM_START, horizon).cost[-1]


def test_two_slides_share_the_way() -> None:
    """Closed form: each moves at v / 2; cost = integral of v^2 / 4."""
    problem = minimum_velocity_problem(slides(), lambda t: [ca.sin(t)], (3,), (0.0, 0.0), 2.0)
    solution = solve(problem, Collocation(intervals=10, degree=3, scheme="legendre"))
    at = collocated(solution)
    np.testing.assert_allclose(solution["rates"][at], np.sin(solution.t[at])[:, None] / 2 * [1.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(solution["joints"][-1], (1 - np.cos(2.0)) / 2, atol=1e-8)
    assert solution.cost == pytest.approx((2.0 - np.sin(4.0) / 2) / 8, abs=1e-8)


def test_limits_of_the_robot_bound_the_plan() -> None:
    """v = 1 for 2 s.

    A slide stopped at 0.5 m moves at 1/4; one held to 0.3 m/s at 0.3: constant shares are optimal.
    """
    method = Collocation(intervals=10, degree=3)
    for machine, share in ((slides(upper=0.5), 0.25), (slides(velocity=0.3), 0.3)):
        for formulation in ("rates", "null_space"):
            problem = minimum_velocity_problem(machine, (1.0,), (3,), (0.0, 0.0), 2.0, formulation=formulation)
            solution = solve(problem, method)
            assert solution.cost == pytest.approx(share**2 + (1 - share) ** 2, abs=1e-6)
            assert (solution["joints"][:, 0] <= 2 * share + 1e-6).all()
        free = solve(minimum_velocity_problem(machine, (1.0,), (3,), (0.0, 0.0), 2.0, limits=False), method)
        assert free.cost == pytest.approx(0.5, abs=1e-8)


def test_a_velocity_from_an_interpolant_needs_mx_symbols_and_is_met() -> None:
    knots = np.linspace(0, 2, 21)
    table = ca.interpolant("table", "bspline", [knots], np.sin(knots))
    problem = minimum_velocity_problem(slides(), lambda t: table(t), (3,), (0.0, 0.0), 2.0, symbols=ca.MX)
    solution = solve(problem, Collocation(intervals=10, degree=3))
    assert solution.cost == pytest.approx((2.0 - np.sin(4.0) / 2) / 8, abs=1e-5)


def test_mx_and_sx_symbols_give_the_same_plan() -> None:
    method = Collocation(intervals=20, degree=3)
    costs = [solve(paper_problem(symbols=symbols), method).cost for symbols in (ca.SX, ca.MX)]
    assert costs[0] == pytest.approx(costs[1], abs=1e-9)


def test_the_guess_is_the_damped_local_motion() -> None:
    machine = paper_example()
    problem = paper_problem(guess_damping=0.02)
    jacobian = numeric(machine.tip_jacobian(machine.base_home(), PAPER_START))[3:5]
    damping = 0.02 * np.linalg.norm(jacobian) / np.sqrt(2)
    local = resolve(machine, (-1, -1), (3, 4), PAPER_START, 5.0, damping=damping)
    states, controls = problem.declared.states, problem.declared.controls
    for time in (0.0, 1.234, 5.0):
        np.testing.assert_allclose(states["base"].guess(time), local.at(time)["base"], atol=1e-5)
        np.testing.assert_allclose(states["joints"].guess(time), local.at(time)["joints"], atol=1e-5)
        np.testing.assert_allclose(controls["rates"].guess(time), local.at(time)["joint_rates"], atol=1e-4)


def test_a_singular_start_is_planned_with_rates_and_refused_in_the_null_space_form() -> None:
    """A stretched arm can swing sideways: v is in the range of G although G has lost rank."""
    machine = FixedBase(planar_chain([1.0, 1.0, 1.0], [1.0] * 3))
    problem = minimum_velocity_problem(machine, lambda t: [-3 * ca.sin(t), 3 * ca.cos(t)], (3, 4), np.zeros(3), 0.2)
    assert problem.declared.path["task"].size == 2
    with pytest.raises(ProblemError, match="singular at the start joints"):
        minimum_velocity_problem(machine, (0.0, 1.0), (3, 4), np.zeros(3), 0.2, formulation="null_space")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": ()}, "rows is empty"),
        ({"rows": (3, 3)}, "more than once"),
        ({"rows": (4, 6)}, "twist rows 0..5"),
        ({"rows": (1, 3)}, r"no joint moves the tip in rows \[1\]"),
        ({"rows": (2, 3, 4, 5)}, "fixes 4 rows .* only 3 joints"),
        ({"tip_velocity": (1.0, 2.0, 3.0)}, r"tip_velocity has shape \(3, 1\), expected \(2, 1\)"),
        ({"start_joints": (0.0,)}, "start_joints has 1 entries, expected 3"),
        ({"start_base": (0.0,)}, "start_base has 1 entries, expected 3"),
        ({"horizon": -1.0}, "horizon must be a positive number"),
        ({"formulation": "dynamics"}, "unknown formulation 'dynamics'"),
        ({"guess_damping": 0.0}, "guess_damping must be positive"),
    ],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        "tip_velocity": (-1.0, -1.0),
        "rows": (3, 4),
        "start_joints": PAPER_START,
        "horizon": 1.0,
        **changes,
    }
    with pytest.raises(ProblemError, match=message):
        minimum_velocity_problem(paper_example(), **arguments)


def test_a_start_outside_the_limits_is_refused_by_the_joints_name() -> None:
    robot = planar_chain([1.0, 1.0], [1.0, 1.0])
    second = dataclasses.replace(robot.joints[1], lower=-1.0, upper=1.0)
    machine = FixedBase(dataclasses.replace(robot, joints=(robot.joints[0], second)))
    with pytest.raises(ProblemError, match=r"'joint2' starts at 1.5, outside its limits -1 .. 1"):
        minimum_velocity_problem(machine, (0.1,), (3,), (0.3, 1.5), 1.0)
    minimum_velocity_problem(machine, (0.1,), (3,), (0.3, 1.5), 1.0, limits=False)
