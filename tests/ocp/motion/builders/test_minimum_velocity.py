"""The least joint velocity that does a task: the paper's optimum, closed forms, and the minimum principle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import models
from models import FixedBase, FreeFloating, Joint, Link, Machine, Robot, paper_example, planar_chain
from ocp import (
    Collocation,
    Limits,
    Problem,
    ProblemError,
    RateOptions,
    Solution,
    Start,
    TipTask,
    VelocitySetup,
    minimum_velocity_problem,
    resolve,
    solve,
)
from ocp.motion.builders import joint_motion
from ocp.motion.local.rates import LocalSolution
from tests.models.robot.trees import numeric, seven_joint_arm
from tests.ocp.motion.local.test_rates import PAPER_START, PAPER_TASK, REFUSED

PAPER_COST = 1.735114311245  # backward-shooting minimum principle, horizon 5 s
ARM_START = np.array([0.3, 0.6, -0.2, 1.2, 0.4, 0.9, -0.3])
CHAIN_START = np.deg2rad([30.0, 40.0, 50.0])
TASK = TipTask(rows=(3, 4), velocity=(-1.0, -1.0))
LEGENDRE = Collocation(intervals=50, degree=3, scheme="legendre")


def paper_problem() -> Problem:
    return minimum_velocity_problem(paper_example(), TASK, 5.0, start=PAPER_START)


def chain() -> FixedBase:
    return FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))


def resolved(
    machine: Machine, *, start: Any, setup: VelocitySetup | None = None, weights: Any = None, **request: Any
) -> LocalSolution:
    """The local motion under arguments of `minimum_velocity_problem`."""
    begin = Start(start, None if setup is None else setup.start_base)
    return resolve(machine, start=begin, options=RateOptions(weights=weights), **request)


def audited(machine: Machine, method: Collocation, /, **request: Any) -> Solution:
    """The solution of `minimum_velocity_problem`, in which its audit finds no fault."""
    solution = solve(minimum_velocity_problem(machine, **request), method)
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
    rates, base = solution["rates"], places(machine, solution)
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


def test_the_papers_example_reaches_its_reference_optimum() -> None:
    solution = solve(paper_problem(), LEGENDRE)
    assert solution.cost == pytest.approx(PAPER_COST, abs=1e-8)
    assert_does_its_task(paper_example(), solution, lambda _: [-1.0, -1.0], [3, 4])
    peaks = np.rad2deg(np.abs(solution["rates"]).max(axis=0))
    np.testing.assert_allclose(peaks, [46.10, 24.26, 77.95], atol=0.03)


def test_the_papers_optimum_passes_its_audit_and_beats_the_pseudo_inverse() -> None:
    solution = solve(paper_problem(), LEGENDRE)
    audit = solution.audit()
    assert audit.passed, str(audit)
    local = resolve(paper_example(), TipTask(rows=(3, 4), velocity=(-1.0, -1.0)), 5.0, start=PAPER_START)
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


def test_an_arm_on_a_fixed_base_does_better_than_instantly() -> None:
    machine = chain()
    task = TipTask(rows=(3, 4), velocity=lambda t: [-0.3 * ca.cos(t), 0.3 * ca.sin(2 * t)])
    solution = audited(machine, Collocation(intervals=20, degree=3), tasks=task, start=CHAIN_START, horizon=3.0)
    assert list(solution.states) == ["joints"]
    assert_does_its_task(machine, solution, lambda t: [-0.3 * np.cos(t), 0.3 * np.sin(2 * t)], [3, 4])
    assert solution.cost < resolve(machine, task, 3.0, start=CHAIN_START).cost[-1] - 1e-5
    np.testing.assert_allclose(solution.costate("joints")[-1], 0, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize(("rows", "horizon"), [((3, 4, 5), 3.0), ((0, 1, 2, 3, 4, 5), 1.0)])
def test_a_spatial_seven_joint_arm_on_a_floating_base_is_planned(rows: tuple[int, ...], horizon: float) -> None:
    machine = FreeFloating(seven_joint_arm(), "spatial")
    velocity = np.array([0.02, -0.03, 0.04, 0.1, -0.1, 0.05])[list(rows)]
    request: dict[str, Any] = {"start": ARM_START, "horizon": horizon}
    request["tasks"] = TipTask(rows=rows, velocity=velocity)
    solution = audited(machine, replace(LEGENDRE, intervals=12), **request)
    assert_does_its_task(machine, solution, lambda _: velocity, list(rows))
    np.testing.assert_allclose(np.linalg.norm(solution["base"][:, 3:], axis=1), 1.0, atol=1e-9)
    assert solution.cost < resolved(machine, **request).cost[-1]


def test_two_parallel_slides_share_the_displacement() -> None:
    """Closed form: each moves at v / 2; cost = integral of v^2 / 4."""
    problem = minimum_velocity_problem(
        slides(), TipTask(rows=(3,), velocity=lambda t: [ca.sin(t)]), 2.0, start=(0.0, 0.0)
    )
    solution = solve(problem, replace(LEGENDRE, intervals=10))
    at = collocated(solution)
    np.testing.assert_allclose(solution["rates"][at], np.sin(solution.t[at])[:, None] / 2 * [1.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(solution["joints"][-1], (1 - np.cos(2.0)) / 2, atol=1e-8)
    assert solution.cost == pytest.approx((2.0 - np.sin(4.0) / 2) / 8, abs=1e-8)


@pytest.mark.parametrize(("limit", "share"), [({"upper": 0.5}, 0.25), ({"velocity": 0.3}, 0.3)])
def test_limits_of_the_robot_bound_the_plan(limit: dict[str, float], share: float) -> None:
    """v = 1 for 2 s: a slide stopped at 0.5 m moves at 1/4, one held to 0.3 m/s at 0.3; constant shares are optimal."""
    task, none = TipTask(rows=(3,), velocity=(1.0,)), Limits(velocity=np.inf, joints=False)
    problems = [
        minimum_velocity_problem(slides(**limit), task, 2.0, start=(0.0, 0.0), limits=each) for each in (None, none)
    ]
    bound, free = (solve(problem, Collocation(intervals=10, degree=3)) for problem in problems)
    assert bound.cost == pytest.approx(share**2 + (1 - share) ** 2, abs=1e-6)
    assert (bound["joints"][:, 0] <= 2 * share + 1e-6).all()
    assert free.cost == pytest.approx(0.5, abs=1e-8)


def test_a_velocity_from_an_interpolant_is_met() -> None:
    knots = np.linspace(0, 2, 21)
    table = ca.interpolant("table", "bspline", [knots], np.sin(knots))
    problem = minimum_velocity_problem(slides(), TipTask(rows=(3,), velocity=lambda t: table(t)), 2.0, start=(0.0, 0.0))
    solution = solve(problem, Collocation(intervals=10, degree=3))
    assert solution.cost == pytest.approx((2.0 - np.sin(4.0) / 2) / 8, abs=1e-5)


@pytest.mark.long
def test_the_guess_is_the_local_motion_in_steps_of_first_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times as many steps leave a quarter of the difference. It is looked at before the first singular passage."""
    machine, errors = paper_example(), []
    local = resolve(machine, TASK, 5.0, start=PAPER_START)
    for steps in (64, 256, 1024):
        monkeypatch.setattr(joint_motion, "GUESS_STEPS", steps)
        states = minimum_velocity_problem(
            machine, TASK, 5.0, start=PAPER_START, setup=VelocitySetup(guess_damping=1e-4)
        ).declared.states
        apart = [
            np.abs(states[name].guess(time) - local.at(time)[name]).max()
            for time in (0.0, 0.5, 1.0)
            for name in ("base", "joints")
        ]
        errors.append(max(apart))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.2)


def test_where_the_local_motion_breaks_down_the_guess_is_whole() -> None:
    """The tip moves 3 m in x; with 2 m of arm it is out of reach after 1.3 s."""
    machine = FixedBase(planar_chain([1.0, 0.5, 0.5], [1.0] * 3))
    task = TipTask(rows=(3, 4), velocity=(1.0, 0.0))
    declared = minimum_velocity_problem(machine, task, 3.0, start=np.deg2rad([60.0, -100.0, -20.0])).declared
    for variable in (declared.states["joints"], declared.controls["rates"]):
        assert np.isfinite([variable.guess(time) for time in np.linspace(0, 3, 31)]).all()


def test_tasks_may_begin_and_end_during_the_motion() -> None:
    """Nothing is asked from 1 s on: the joints stand still, and the cost is that of the task alone."""
    task = TipTask(rows=(3, 4), velocity=(-0.2, 0.1), duration=1.0)
    costs = [
        solve(minimum_velocity_problem(chain(), task, horizon, start=CHAIN_START), LEGENDRE).cost
        for horizon in (1.0, 2.5)
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


def test_a_singular_start_is_planned() -> None:
    """A stretched arm can swing sideways: v is in the range of G although G has lost rank."""
    machine = FixedBase(planar_chain([1.0, 1.0, 1.0], [1.0] * 3))
    task = TipTask(rows=(3, 4), velocity=lambda t: [-3 * ca.sin(t), 3 * ca.cos(t)])
    assert minimum_velocity_problem(machine, task, 0.2, start=np.zeros(3)).declared.path["task"].size == 2


WRONG_BASE = {"setup": VelocitySetup(start_base=(0.0,) * 7)}, "start_base has shape .7,., expected .3,."


@pytest.mark.parametrize(("changes", "message"), [*REFUSED, WRONG_BASE])
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        minimum_velocity_problem(paper_example(), **{**PAPER_TASK, **changes})
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_a_start_outside_the_limits_is_refused_by_the_joints_name() -> None:
    robot = planar_chain([1.0, 1.0], [1.0, 1.0])
    second = replace(robot.joints[1], lower=-1.0, upper=1.0)
    machine = FixedBase(replace(robot, joints=(robot.joints[0], second)))
    with pytest.raises(ProblemError, match=r"'joint2' starts at 1.5, outside its limits -1 .. 1"):
        minimum_velocity_problem(machine, TipTask(rows=(3,), velocity=(0.1,)), 1.0, start=(0.3, 1.5))
    minimum_velocity_problem(
        machine,
        TipTask(rows=(3,), velocity=(0.1,)),
        1.0,
        start=(0.3, 1.5),
        limits=Limits(velocity=np.inf, joints=False),
    )
