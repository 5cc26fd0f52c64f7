"""The least joint velocity that does a task: the paper's optimum, closed forms, and the minimum principle."""

from __future__ import annotations

import inspect
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import models
from models import FixedBase, FreeFloating, Joint, Link, Machine, Robot, paper_example, planar_chain
from ocp import (
    Collocation,
    Finding,
    MultipleShooting,
    Problem,
    ProblemError,
    Solution,
    SolveError,
    minimum_velocity_problem,
    plan_minimum_velocity,
    resolve,
    solve,
)
from ocp.builders import redundancy
from tests.models.robot.trees import numeric, seven_joint_arm
from tests.ocp.local.test_rates import ASKED, PAPER_START, REFUSED

PAPER_COST = 1.735114311245  # backward-shooting minimum principle, horizon 5 s
ARM_START = np.array([0.3, 0.6, -0.2, 1.2, 0.4, 0.9, -0.3])
CHAIN_START = np.deg2rad([30.0, 40.0, 50.0])
LEGENDRE = Collocation(intervals=50, degree=3, scheme="legendre")
FORMS = pytest.mark.parametrize("formulation", ["rates", "null_space"])


def paper_problem(**changes: Any) -> Problem:
    return minimum_velocity_problem(paper_example(), (-1.0, -1.0), (3, 4), PAPER_START, 5.0, **changes)


def chain() -> FixedBase:
    return FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))


def audited(machine: Machine, method: Collocation, /, **asked: Any) -> Solution:
    """The solution of `minimum_velocity_problem`, in which its audit finds no fault."""
    solution = solve(minimum_velocity_problem(machine, **asked), method)
    audit = solution.audit()
    assert not audit.failures, str(audit)
    return solution


def places(machine: Machine, solution: Solution) -> Any:
    return solution["base"] if machine.base_size else np.zeros((len(solution.t), 0))


def slides(**limits: Any) -> FixedBase:
    """Two slides along x, one on the other: x1' + x2' = v, whose least-velocity split is v / 2 each."""
    first = Joint("first", "prismatic", "rail", "carriage", axis=(1, 0, 0), **limits)
    second = Joint("second", "prismatic", "carriage", "tool", axis=(1, 0, 0))
    return FixedBase(Robot((Link("rail"), Link("carriage"), Link("tool")), (first, second)))


def assert_does_its_task(machine: Machine, solution: Solution, velocity: Any, rows: list[int]) -> None:
    """Twist at every collocation point, and the centre of mass of what floats."""
    rates, base = rates_of(machine, solution, velocity, rows), places(machine, solution)
    for k in collocated(solution):
        twist = numeric(machine.tip_jacobian(base[k], solution["joints"][k])) @ rates[k]
        np.testing.assert_allclose(twist[rows], velocity(solution.t[k]), atol=1e-8)
    if isinstance(machine, FreeFloating):
        frames = [machine.world_from_base(place) for place in base]
        pairs = zip(solution["joints"], frames, strict=True)
        center = np.array([numeric(models.center_of_mass(machine.robot, q, frame)).ravel() for q, frame in pairs])
        np.testing.assert_allclose(center, np.broadcast_to(center[0], center.shape), atol=1e-6)


def collocated(solution: Solution) -> list[int]:
    """Indices of the reported times that are collocation points: at the others the controls are interpolated."""
    count = solution.method["intervals"]
    points = np.array(ca.collocation_points(solution.method["degree"], solution.method["scheme"]))
    times = (np.arange(count)[:, None] + points).ravel() / count * solution.horizon
    return [k for k, time in enumerate(solution.t) if np.abs(times - time).min() < 1e-9]


def rates_of(machine: Machine, solution: Solution, velocity: Any, rows: list[int]) -> Any:
    if "rates" in solution.controls:
        return solution["rates"]
    base, rates = places(machine, solution), []
    for k, time in enumerate(solution.t):
        jacobian = numeric(machine.tip_jacobian(base[k], solution["joints"][k]))[rows]
        inverse, null = np.linalg.pinv(jacobian), solution["null"][k]
        rates.append(null + inverse @ (velocity(time) - jacobian @ null))
    return np.array(rates)


@FORMS
def test_the_papers_example_reaches_its_reference_optimum(formulation: Any) -> None:
    solution = solve(paper_problem(formulation=formulation), LEGENDRE)
    assert solution.cost == pytest.approx(PAPER_COST, abs=1e-8)
    assert_does_its_task(paper_example(), solution, lambda _: [-1.0, -1.0], [3, 4])
    peaks = np.rad2deg(np.abs(rates_of(paper_example(), solution, lambda _: [-1, -1], [3, 4])).max(axis=0))
    np.testing.assert_allclose(peaks, [46.10, 24.26, 77.95], atol=0.03)


def test_the_papers_optimum_passes_its_audit_and_beats_the_pseudo_inverse() -> None:
    solution = solve(paper_problem(), LEGENDRE)
    audit = solution.audit()
    assert audit.passed, str(audit)
    local = resolve(paper_example(), (-1.0, -1.0), (3, 4), PAPER_START, 5.0)
    assert solution.cost < 0.6 * local.cost[-1]


@pytest.mark.long
def test_the_papers_optimum_satisfies_the_minimum_principle() -> None:
    """(31), (35): the free end has no costate, H is constant, and u minimises H in the null space of G."""
    machine = paper_example()
    solution = solve(paper_problem(), replace(LEGENDRE, intervals=100))
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


@FORMS
def test_an_arm_on_a_fixed_base_does_better_than_instantly(formulation: Any) -> None:
    machine = chain()
    asked: dict[str, Any] = {"tip_velocity": lambda t: [-0.3 * ca.cos(t), 0.3 * ca.sin(2 * t)], "rows": (3, 4)}
    asked |= {"start_joints": CHAIN_START, "horizon": 3.0}
    solution = audited(machine, Collocation(intervals=20, degree=3), **asked, formulation=formulation)
    assert list(solution.states) == ["joints"]
    assert_does_its_task(machine, solution, lambda t: [-0.3 * np.cos(t), 0.3 * np.sin(2 * t)], [3, 4])
    assert solution.cost < resolve(machine, **asked).cost[-1] - 1e-5
    np.testing.assert_allclose(solution.costate("joints")[-1], 0, atol=1e-4)


def test_both_formulations_have_one_optimum_on_a_fixed_base() -> None:
    asked: dict[str, Any] = {"tip_velocity": (-0.2, 0.1), "rows": (3, 4), "start_joints": CHAIN_START, "horizon": 3.0}
    method, forms = replace(LEGENDRE, intervals=20), ("rates", "null_space")
    costs = [solve(minimum_velocity_problem(chain(), **asked, formulation=f), method).cost for f in forms]  # type: ignore[arg-type]
    assert costs[0] == pytest.approx(costs[1], abs=1e-10)


@pytest.mark.parametrize(("rows", "horizon"), [((3, 4, 5), 3.0), ((0, 1, 2, 3, 4, 5), 1.0)])
def test_a_spatial_seven_joint_arm_on_a_floating_base_is_planned(rows: tuple[int, ...], horizon: float) -> None:
    machine = FreeFloating(seven_joint_arm(), "spatial")
    velocity = np.array([0.02, -0.03, 0.04, 0.1, -0.1, 0.05])[list(rows)]
    asked: dict[str, Any] = {"tip_velocity": velocity, "rows": rows, "start_joints": ARM_START, "horizon": horizon}
    solution = audited(machine, replace(LEGENDRE, intervals=12), **asked)
    assert_does_its_task(machine, solution, lambda _: velocity, list(rows))
    np.testing.assert_allclose(np.linalg.norm(solution["base"][:, 3:], axis=1), 1.0, atol=1e-9)
    assert solution.cost < resolve(machine, **asked).cost[-1]


def test_two_slides_share_the_way() -> None:
    """Closed form: each moves at v / 2; cost = integral of v^2 / 4."""
    problem = minimum_velocity_problem(slides(), lambda t: [ca.sin(t)], (3,), (0.0, 0.0), 2.0)
    solution = solve(problem, replace(LEGENDRE, intervals=10))
    at = collocated(solution)
    np.testing.assert_allclose(solution["rates"][at], np.sin(solution.t[at])[:, None] / 2 * [1.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(solution["joints"][-1], (1 - np.cos(2.0)) / 2, atol=1e-8)
    assert solution.cost == pytest.approx((2.0 - np.sin(4.0) / 2) / 8, abs=1e-8)


@FORMS
@pytest.mark.parametrize(("limit", "share"), [({"upper": 0.5}, 0.25), ({"velocity": 0.3}, 0.3)])
def test_limits_of_the_robot_bound_the_plan(limit: dict[str, float], share: float, formulation: Any) -> None:
    """v = 1 for 2 s: a slide stopped at 0.5 m moves at 1/4, one held to 0.3 m/s at 0.3; constant shares are optimal."""
    asked: dict[str, Any] = {"tip_velocity": (1.0,), "rows": (3,), "start_joints": (0.0, 0.0), "horizon": 2.0}
    problems = [
        minimum_velocity_problem(slides(**limit), **asked, formulation=formulation, limits=limits)
        for limits in (True, False)
    ]
    bound, free = (solve(problem, Collocation(intervals=10, degree=3)) for problem in problems)
    assert bound.cost == pytest.approx(share**2 + (1 - share) ** 2, abs=1e-6)
    assert (bound["joints"][:, 0] <= 2 * share + 1e-6).all()
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
        wanted = local.at(time)
        np.testing.assert_allclose(states["base"].guess(time), wanted["base"], atol=1e-5)
        np.testing.assert_allclose(states["joints"].guess(time), wanted["joints"], atol=1e-5)
        np.testing.assert_allclose(controls["rates"].guess(time), wanted["joint_rates"], atol=1e-4)


def test_where_the_local_motion_stops_the_guess_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """v = sqrt(1 - t) is no number from 1 s on; until then each slide has moved (1 - (1 - t)^1.5) / 3."""
    asked: dict[str, Any] = {"tip_velocity": lambda t: [ca.sqrt(1 - t)], "rows": (3,), "start_joints": (0.0, 0.0)}
    monkeypatch.setattr("ocp.builders.redundancy.LARGEST_DAMPING", 1e-9)  # more would stop there too
    declared = minimum_velocity_problem(slides(), **asked, horizon=2.0, guess_damping=1e-9).declared
    joints, rates = declared.states["joints"].guess, declared.controls["rates"].guess
    for time in (0.5, 1.5, 2.0):
        left = max(1 - time, 0.0)
        np.testing.assert_allclose(joints(time), (1 - left**1.5) / 3, atol=1e-2)
        np.testing.assert_allclose(rates(time), np.sqrt(left) / 2, atol=1e-2)


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
        *REFUSED,
        ({"formulation": "dynamics"}, "formulation must be 'rates' or 'null_space', not 'dynamics'"),
        ({"guess_damping": 0.0}, "guess_damping must be positive"),
    ],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        minimum_velocity_problem(paper_example(), **{**ASKED, **changes})
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_what_is_planned_takes_what_is_declared() -> None:
    """All but the damping of one guess, of which a plan tries several."""
    declared, planned = (
        inspect.signature(function).parameters for function in (minimum_velocity_problem, plan_minimum_velocity)
    )
    assert set(planned) - set(declared) == {"method", "dampings", "options"}
    for name in set(declared) - {"guess_damping"}:
        assert planned[name] == declared[name]


CHEAP, DEAR = 0.0, 1e3
"""Less and more than the pseudo-inverse costs."""
PLAYED: list[tuple[list[tuple[float, float]], dict[str, Any], list[int], int | None]] = [
    ([(0, CHEAP)], {}, [10], 0),
    ([(0, DEAR), (0, CHEAP)], {}, [10, 10], 1),
    ([(0, DEAR), (0, DEAR + 1), (0, DEAR - 1)], {}, [10, 10, 10], 2),
    ([(8, CHEAP), (3.9, CHEAP), (0, CHEAP)], {}, [10, 20, 40], 2),
    ([(8, CHEAP), (4, CHEAP), (0, CHEAP)], {}, [10, 20, 10], 2),
    ([(8, CHEAP), (3, CHEAP), (1.2, CHEAP), (0, CHEAP)], {}, [10, 20, 40, 10], 3),
    ([(8, CHEAP), (3, CHEAP), (1.6, CHEAP), (0, DEAR), (np.inf, DEAR)], {}, [10, 20, 40, 10, 10], 3),
    ([(np.inf, DEAR), (0, DEAR)], {"free_start": True}, [10, 10], 1),
    ([(np.inf, DEAR), (0, DEAR)], {"cyclic": True, "tip_velocity": (0.0, 0.0)}, [10, 10], 1),
    ([(np.inf, DEAR)] * 3, {}, [10, 10, 10], None),
]
"""What becomes of each attempt (worst finding of the audit, infinite where the solver fails, and cost); the request;
the intervals of each attempt; which one is the plan."""


@pytest.mark.parametrize("undecided", ["a singular arc from 1 to 2 s", "the solver says Solved_To_Acceptable_Level"])
def test_a_plan_of_which_it_is_not_decided_whether_it_is_a_minimum_stands(
    undecided: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No fault is found in it, and its audit says what is not decided."""
    audit = SimpleNamespace(passed=False, failures=(), undecided=undecided, controls={}, clearances={})
    plan = SimpleNamespace(success=True, states={}, cost=CHEAP, audit=lambda: audit)
    monkeypatch.setattr(redundancy, "solve", lambda *_, **__: plan)
    found: Any = plan_minimum_velocity(paper_example(), method=Collocation(intervals=10), **ASKED)
    assert found is plan


@pytest.mark.parametrize(("script", "changes", "meshes", "best"), PLAYED)
def test_meshes_are_refined_while_the_audit_mends_and_guesses_tried_until_one_is_no_dearer_than_the_pseudo_inverse(
    script: list[tuple[float, float]],
    changes: dict[str, Any],
    meshes: list[int],
    best: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plans: list[Any] = []
    calls: list[tuple[int, Any, bool]] = []

    def play(problem: Problem, mesh: Collocation, *, guess: Any, check: bool, options: Any) -> Any:
        (worst, cost), number = script[len(calls)], len(calls)
        calls.append((mesh.intervals, guess, check))
        found = Finding("task", worst, 1.0)
        audit = SimpleNamespace(passed=found.passed, failures=[found], controls={}, clearances={})
        plans.append(SimpleNamespace(success=True, states={}, cost=cost, number=number, audit=lambda: audit))
        if np.isinf(worst):
            raise SolveError(f"attempt {number} fails", name=f"attempt {number}")
        return plans[-1]

    monkeypatch.setattr(redundancy, "solve", play)
    method, asked = Collocation(intervals=10), {**ASKED, **changes}
    if best is None:
        with pytest.raises(
            SolveError, match=r"0\.005, .*: attempt 0 .*\n.*0\.05, .*: attempt 1 .*\n.*0\.3, .*attempt 2"
        ) as caught:
            plan_minimum_velocity(paper_example(), method=method, **asked)
        assert caught.value.name == f"attempt {len(script) - 1}"
    else:
        plan: Any = plan_minimum_velocity(paper_example(), method=method, **asked)
        assert plan.number == best
    assert [intervals for intervals, _, _ in calls] == meshes
    for number, (intervals, guess, check) in enumerate(calls):
        assert guess is (plans[number - 1] if intervals > 10 else None)
        last_guess = meshes[: number + 1].count(10) == 3
        assert check == (last_guess and all(worst > 1 for worst, _ in script[:number]))


def test_a_start_outside_the_limits_is_refused_by_the_joints_name() -> None:
    robot = planar_chain([1.0, 1.0], [1.0, 1.0])
    second = replace(robot.joints[1], lower=-1.0, upper=1.0)
    machine = FixedBase(replace(robot, joints=(robot.joints[0], second)))
    with pytest.raises(ProblemError, match=r"'joint2' starts at 1.5, outside its limits -1 .. 1"):
        minimum_velocity_problem(machine, (0.1,), (3,), (0.3, 1.5), 1.0)
    minimum_velocity_problem(machine, (0.1,), (3,), (0.3, 1.5), 1.0, limits=False)
