"""Mesh refinement: it reaches what is asked, says where it does not, and puts its intervals where they are needed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import FixedBase, paper_example, planar_chain
from ocp import (
    Collocation,
    MultipleShooting,
    Problem,
    ProblemError,
    RefinementWarning,
    Solution,
    SolveError,
    TipTask,
    minimum_velocity_problem,
    refine,
    refinement,
    solve,
)
from ocp.refinement import RefinementSettings, split
from tests.conformance import goddard
from tests.ocp.problems import (
    SWING,
    LogarithmicRegulator,
    Method,
    double_integrator,
    energy,
    order,
    plant,
    swing,
    van_der_pol,
)

pytestmark = pytest.mark.xdist_group("refinement")  # one process, so that every plan is solved once

START: dict[str, Method] = {
    "radau": Collocation(3),
    "radau-held": Collocation(3, control="held"),
    "legendre": Collocation(3, 2, "legendre"),
    "rk4-held": MultipleShooting(4),
    "rk4-linear": MultipleShooting(4, control="linear"),
}


def layer(width: float = 0.01) -> Problem:
    """A target that rises within ``width`` at 0.7 s: smooth, but sharp there and nowhere else."""
    problem, x, u = plant("layer", initial=0.0)
    target = 0.5 * (1 + ca.tanh((problem.time - 0.7) / width))
    problem.dynamics(x, u + target / width * ca.exp(-(((problem.time - 0.7) / width) ** 2)))
    problem.minimize(running=(x - target) ** 2 + 0.1 * u**2)
    return problem


@cache
def refined(method: str) -> Solution:
    return refine(van_der_pol(), START[method], tolerance=1e-6)


@pytest.mark.parametrize("method", START)
def test_the_tolerance_is_reached(method: str) -> None:
    solution = refined(method)
    audit = solution.audit()
    assert audit.passed
    assert audit.integration_error <= 1e-6
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.refinement.tolerance == 1e-6
    assert solution.refinement.intervals[0] == START[method].intervals
    assert solution.refinement.intervals[-1] == len(solution.control_interpolant.breaks) - 1
    assert list(solution.refinement.intervals) == sorted(set(solution.refinement.intervals))
    assert len(solution.refinement.intervals) <= 5


@pytest.mark.parametrize("method", START)
def test_refinement_from_an_audited_plan_is_the_same(method: str) -> None:
    """As from its first solve; and the audit that comes with it is that of the plan."""
    first = solve(van_der_pol(), START[method])
    result, audit = refinement.refine_from(first.problem, START[method], (first, first.audit()))
    whole = refined(method)
    assert result.refinement is not None
    assert whole.refinement is not None
    assert result.refinement.intervals == whole.refinement.intervals
    assert result.refinement.reached
    assert result.cost == pytest.approx(whole.cost, rel=1e-9)
    assert str(audit) == str(result.audit())


@pytest.mark.parametrize("check", [True, False])
def test_a_failed_round_is_restarted_only_on_request(check: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One iteration is not enough for a finer mesh."""
    method, request = START["radau"], list[bool]()
    first = solve(van_der_pol(), method)

    def briefly(*report: Any, **more: Any) -> Solution:
        request.append(more["check"])
        return solve(*report, **more)

    monkeypatch.setattr(refinement, "solve", briefly)
    with pytest.raises(SolveError, match="from the guess: " if check else "^refinement of .* failed: ") as failed:
        refinement.refine_from(first.problem, method, (first, first.audit()), options={"max_iter": 1}, check=check)
    assert request == [check]
    assert failed.value.solution is not None
    assert not failed.value.solution.success


@pytest.mark.parametrize("method", START)
def test_every_round_tells_the_errors_of_each_kind_as_shares_of_their_limits(method: str) -> None:
    past, audit = refined(method).refinement, refined(method).audit()
    assert past is not None
    assert set(past.errors) == {"integration", "equalities", "limits", "cost", "other"}
    assert all(len(values) == len(past.intervals) for values in past.errors.values())
    assert max(values[0] for values in past.errors.values()) > 1
    assert max(values[-1] for values in past.errors.values()) <= 1
    assert past.errors["integration"][-1] == pytest.approx(audit.integration_error / 1e-6, rel=1e-6)
    assert max(past.errors["equalities"] + past.errors["limits"]) == 0  # there are none


def test_a_tighter_tolerance_takes_more_intervals_and_brings_the_cost_nearer() -> None:
    exact = solve(van_der_pol(), Collocation(40, 5)).cost
    loose, tight = (
        refine(van_der_pol(), Collocation(2, 2), tolerance=t, settings=RefinementSettings(max_intervals=900))
        for t in (1e-3, 1e-6)
    )
    assert loose.refinement is not None
    assert tight.refinement is not None
    assert tight.refinement.intervals[-1] > loose.refinement.intervals[-1]
    assert abs(tight.cost - exact) < abs(loose.cost - exact)


def test_a_plan_on_the_first_mesh_is_not_solved_again_unless_a_parameter_differs() -> None:
    problem, x, u = plant("parameter", initial=1.0)
    target = problem.parameter("target")
    problem.dynamics(x, u)
    problem.minimize(running=(x - target) ** 2 + u**2)
    mesh = Collocation(12)
    known = solve(problem, mesh, parameters={"target": 0.0})
    same, other = (refine(problem, mesh, guess=known, parameters={"target": value}) for value in (0.0, 0.5))
    assert np.array_equal(same.variables, known.variables)
    assert same.refinement is not None
    assert other.cost == pytest.approx(solve(problem, mesh, parameters={"target": 0.5}).cost, rel=1e-6)
    assert other.cost != pytest.approx(known.cost, rel=1e-2)


def test_nothing_is_refined_that_is_good_already() -> None:
    solution = refine(energy(), Collocation(2, 4), tolerance=1e-8)
    assert solution.refinement is not None
    assert solution.refinement.intervals == (2,)
    assert solution.refinement.reached


# ---- every row of the audit --------------------------------------------------------------------------------------


def chain_in_a_circle() -> Problem:
    """A fixed arm whose joints follow their rates exactly: integration has nothing to say of it."""
    arm = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))
    start = np.deg2rad([30.0, 40.0, 50.0])
    return minimum_velocity_problem(
        arm,
        TipTask(rows=(3, 4), velocity=lambda t: [-0.5 * ca.sin(2 * t), 0.5 * ca.cos(2 * t)]),
        start=start,
        horizon=3.0,
    )


def floating_arm() -> Problem:
    """The example of Kim, Kim 2011."""
    return minimum_velocity_problem(
        paper_example(), TipTask(rows=(3, 4), velocity=(-1.0, -1.0)), 5.0, start=np.radians([45.0, 60.0, -60.0])
    )


@pytest.mark.parametrize("method", [Collocation(5), Collocation(5, scheme="legendre")], ids=str)
@pytest.mark.parametrize("declare", [chain_in_a_circle, floating_arm])
def test_a_least_velocity_plan_keeps_to_its_task_between_the_points(
    declare: Callable[[], Problem], method: Method
) -> None:
    """What breaks its task between the points costs less than the optimum, and no integration shows it."""
    problem = declare()
    assert "task" in [finding.name for finding in solve(problem, method).audit().failures]
    solution = refine(problem, method)
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.refinement.errors["equalities"][0] > 1
    audit = solution.audit()
    assert audit.passed, str(audit)
    assert solution.cost == pytest.approx(solve(problem, Collocation(80, 4)).cost, rel=1e-5)
    assert len(solution.refinement.intervals) <= 4


@pytest.mark.filterwarnings("ignore::ocp.errors.RefinementWarning")
def test_linear_controls_keep_to_the_task_between_the_points_too() -> None:
    problem, method = chain_in_a_circle(), MultipleShooting(10, control="linear")
    best = solve(problem, Collocation(80, 4)).cost
    assert solve(problem, method).cost < 0.95 * best
    solution = refine(problem, method, settings=RefinementSettings(max_intervals=100))
    audit = solution.audit()
    assert audit.feasible
    assert solution.cost == pytest.approx(best, rel=1e-3)
    assert solution.refinement is not None
    assert solution.refinement.reached == audit.passed


HELD_AND_LINEAR: dict[str, Method] = {
    "rk4-held": MultipleShooting(4),
    "rk4-linear": MultipleShooting(3, control="linear"),
    "radau-held": Collocation(4, control="held"),
    "legendre-held": Collocation(4, scheme="legendre", control="held"),
}


@pytest.mark.parametrize("method", HELD_AND_LINEAR)
def test_the_cost_that_held_and_linear_controls_lose_is_brought_under_a_thousandth(method: str) -> None:
    regulator = LogarithmicRegulator(horizon=4.0, z0=2.0)
    assert solve(regulator.build(), HELD_AND_LINEAR[method]).cost > 1.05 * regulator.cost
    solution = refine(regulator.build(), HELD_AND_LINEAR[method], tolerance=1e-4)
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert regulator.cost * (1 - 1e-5) <= solution.cost <= 1.001 * regulator.cost
    assert len(solution.refinement.intervals) <= 5


@pytest.mark.parametrize("lost", [1e-3, 1e-5])
def test_the_cost_is_within_the_requested_tolerance_of_the_optimum(lost: float) -> None:
    regulator = LogarithmicRegulator(horizon=3.0, z0=1.5)
    for method in (MultipleShooting(6, control="linear"), Collocation(6, control="held")):
        solution = refine(regulator.build(), method, tolerance=1e-6, settings=RefinementSettings(limits={"lost": lost}))
        assert solution.refinement is not None
        assert solution.refinement.reached
        assert abs(solution.cost / regulator.cost - 1) <= 1.1 * lost


def test_limits_of_the_audit_can_be_requested() -> None:
    problem = chain_in_a_circle()
    solution = refine(problem, Collocation(5), settings=RefinementSettings(limits={"constraints": 1e-6}))
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.audit().constraints["task"] <= 1e-6
    usual = refine(problem, Collocation(5))
    assert usual.refinement is not None
    assert solution.refinement.intervals[-1] > usual.refinement.intervals[-1]


def test_a_ceiling_that_is_exceeded_between_the_points_is_refined_for() -> None:
    """The double integrator under a ceiling of 1/9 (Bryson, Denham): cost 4."""
    for method in (Collocation(7), MultipleShooting(8), MultipleShooting(8, control="linear")):
        problem, _, _, u = double_integrator("walled", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
        problem.minimize(running=u**2 / 2)
        solution = refine(problem, method)
        assert solution.refinement is not None
        assert solution.refinement.errors["limits"][0] > 1
        assert solution.refinement.reached
        assert solution.at_fraction(np.linspace(0, 1, 3001))["q"].max() <= 1 / 9 + 1e-3 / 9
        assert solution.cost == pytest.approx(4.0, rel=1e-3)


# ---- switching ---------------------------------------------------------------------------------------------------


def hurried() -> tuple[Problem, float, float]:
    """The least time of the double integrator from (0, 0.4) to (1, 0), |u| <= 1; the time, the fraction at the switch.

    Backwards from the end q = 1 - v^2 / 2, forwards q = (v^2 - 0.16) / 2: they meet at v^2 = 1.08.
    """
    problem, *_ = double_integrator("hurried", (0.0, 0.4), (1.0, 0.0), horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0, guess=3.0))
    peak = float(np.sqrt(1.08))
    return problem, 2 * peak - 0.4, (peak - 0.4) / (2 * peak - 0.4)


@pytest.mark.parametrize(
    "method", [Collocation(7, control="held"), MultipleShooting(7), MultipleShooting(7, control="linear")], ids=str
)
@pytest.mark.filterwarnings("ignore:.*undetermined:ocp.errors.RefinementWarning")
def test_the_mesh_clusters_at_a_switch(method: Method) -> None:
    problem, horizon, switch = hurried()
    solution = refine(problem, method)
    assert solution.refinement is not None
    assert max(values[-1] for values in solution.refinement.errors.values()) <= 1
    assert solution.horizon == pytest.approx(horizon, rel=1e-3)
    mesh = solution.control_interpolant.breaks
    widths = np.diff(mesh)
    at_switch = int(np.searchsorted(mesh, switch)) - 1
    assert widths[at_switch] < widths.max() / 3
    assert np.abs(mesh[:-1][widths < widths.max() / 3] - switch).max() < 1.5 * widths.max()


@pytest.mark.parametrize("scheme", ["radau", "legendre"])
def test_a_switch_gets_a_node_so_that_the_plan_passes(scheme: str) -> None:
    problem, horizon, switch = hurried()
    solution = refine(problem, Collocation(7, scheme=scheme))
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.bound_tightening is None
    assert np.abs(solution.control_interpolant.breaks - switch).min() < 1e-4
    assert solution.horizon == pytest.approx(horizon, rel=1e-6)


def test_an_overshoot_that_nothing_reduces_is_reported_after_few_rounds() -> None:
    """Control polynomials through points on both sides of a switch overshoot by the same share in any interval."""
    problem, *_ = hurried()
    settings = RefinementSettings(max_intervals=7)
    with pytest.warns(RefinementWarning, match=r"at .* of its limit; raise max_intervals") as report:
        solution = refine(problem, MultipleShooting(7, control="linear"), tolerance=1.0, settings=settings)
    assert solution.refinement is not None
    assert not solution.refinement.reached
    warning: Any = report[0].message
    assert warning.value > warning.limit


def fishing() -> Problem:
    """Fish so that predator and prey come to their equilibrium: idle, full effort, then a singular arc (Sager 2005).

    The optimum is 1.34408 (mintOC.de, "Lotka Volterra fishing problem", relaxed).
    """
    problem = Problem("fishing")
    fish = problem.state("fish", 2, initial=(0.5, 0.7), lower=0.0, upper=2.0)
    effort = problem.control("effort", lower=0.0, upper=1.0)
    problem.horizon(12.0)
    prey, predator = fish[0], fish[1]
    problem.dynamics(fish, ca.vertcat(prey - prey * predator - 0.4 * prey * effort,
                                      prey * predator - predator - 0.2 * predator * effort))  # fmt: skip
    problem.minimize(running=ca.sumsqr(fish - 1))
    return problem


@pytest.mark.parametrize("method", [Collocation(30), Collocation(20, 4, "legendre")], ids=str)
@pytest.mark.filterwarnings("ignore:.*undetermined:ocp.errors.RefinementWarning")
def test_a_plan_with_a_singular_arc_is_feasible_and_no_cost_is_lost(method: Method) -> None:
    solution = refine(fishing(), method)
    assert solution.audit().feasible
    assert solution.audit().optimal is not False
    assert solution.cost == pytest.approx(1.34408, abs=1e-5)
    assert np.abs(solution.control_interpolant.breaks * 12.0 - 2.4348).min() < 2e-3  # the first switch, from 0 to 1


@pytest.mark.filterwarnings("ignore:.*undetermined:ocp.errors.RefinementWarning")
def test_controls_that_oscillate_on_every_mesh_are_held() -> None:
    """Goddard's rocket: polynomials of a singular thrust exceed its limits by the same share however fine the mesh."""
    solution = refine(goddard.build(), Collocation(12), settings=RefinementSettings(limits={"lost": 1e-6}))
    assert solution.method["control"] == "held"
    assert solution.audit().feasible
    assert solution.cost == pytest.approx(goddard.CASE.cost, rel=1e-6)


def test_a_boundary_layer_narrower_than_every_first_interval_is_resolved() -> None:
    """x' = (1 - x) / e from 0: the error of the first interval stays of size 1 until the interval is as narrow as e."""
    layer = 1e-6
    problem = Problem("layer")
    x = problem.state("x", initial=0.0)
    problem.horizon(1.0)
    problem.dynamics(x, (1 - x) / layer)
    problem.minimize()
    solution = refine(problem, Collocation(6))
    assert solution.refinement is not None
    assert solution.refinement.reached
    at = layer * np.array([0.3, 1.0, 3.0])
    assert solution.at(at)["x"][:, 0] == pytest.approx(1 - np.exp(-at / layer), abs=1e-5)


@pytest.mark.parametrize("ceiling", [0.08, 0.125])
def test_a_plan_on_a_limit_of_a_state_passes_its_audit(ceiling: float) -> None:
    """Bryson, Denham (1962): from 0 at speed 1 back to 0 at speed -1 below a ceiling l; 4 / (9 l) where l <= 1 / 6."""
    problem = Problem("ceiling")
    place = problem.state("place", initial=0.0, terminal=0.0, upper=ceiling)
    speed = problem.state("speed", initial=1.0, terminal=-1.0)
    force = problem.control("force")
    problem.horizon(1.0)
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.minimize(running=force**2 / 2)
    solution = refine(problem, Collocation(13))
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.cost == pytest.approx(4 / (9 * ceiling), rel=1e-6)


def test_growing_errors_of_unstable_dynamics_do_not_use_up_the_mesh() -> None:
    """x' = 2 x + u from 1 to 1 in 20 s at the least integral of x^2 + u^2: two layers and a long rest at zero."""
    problem, x, u = plant("layers", initial=1.0, terminal=1.0, horizon=20.0)
    problem.dynamics(x, 2 * x + u)
    problem.minimize(running=x**2 + u**2)
    solution = refine(problem, Collocation(10), tolerance=1e-4)
    audit = solution.audit()
    assert audit.passed
    assert solution.refinement is not None
    assert solution.refinement.intervals[-1] < 100
    # the regulator: S of 4 S - S^2 + 1 = 0 from both ends, which do not see each other over 20 s
    assert solution.cost == pytest.approx((2 + np.sqrt(5)) + (np.sqrt(5) - 2), rel=1e-4)


# ---- it never says reached where the audit fails -----------------------------------------------------------------


def beyond_the_conjugate_point() -> Problem:
    """Least int u^2 - x^2 with zero ends in 4 s, which has no minimum; the plan at rest is stationary."""
    problem, x, u = plant("beyond the conjugate point", initial=0.0, terminal=0.0, horizon=4.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 - x**2)
    return problem


@pytest.mark.parametrize("method", [Collocation(10), MultipleShooting(10)])
def test_a_problem_without_a_minimum_is_called_so(method: Method) -> None:
    with pytest.raises(SolveError, match=r"stationary but no minimum.*may be unbounded below") as caught:
        refine(beyond_the_conjugate_point(), method)
    assert caught.value.solution is not None
    assert caught.value.solution.audit().optimal is False


def test_errors_independent_of_the_mesh_are_named_as_not_reached() -> None:
    """An integration error below rounding."""
    with pytest.warns(RefinementWarning, match="integration error") as report:
        solution = refine(van_der_pol(), Collocation(4, 5), tolerance=1e-15)
    assert solution.refinement is not None
    assert not solution.refinement.reached
    assert len(solution.refinement.intervals) <= 5
    warning: Any = report[0].message
    assert "integration error" in warning.name


def test_undetermined_audits_are_not_reached_though_every_row_holds() -> None:
    """Where a control enters the conditions at the end, the second order is not known."""
    problem = swing(control_ties=True)
    with pytest.warns(RefinementWarning, match="undetermined: the control") as report:
        solution = refine(problem, Collocation(10), tolerance=1e-4, parameters=SWING)
    assert solution.refinement is not None
    assert not solution.refinement.reached
    assert max(values[-1] for values in solution.refinement.errors.values()) <= 1
    warning: Any = report[0].message
    assert warning.name == "undecided"


@pytest.mark.parametrize("method", START)
def test_reached_means_that_the_audit_passes(method: str) -> None:
    for declare in (swing, layer, van_der_pol):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RefinementWarning)
            options = SWING if declare is swing else None
            solution = refine(
                declare(),
                START[method],
                tolerance=1e-4,
                settings=RefinementSettings(max_intervals=60),
                parameters=options,
            )
        assert solution.refinement is not None
        audit = solution.audit()
        if solution.refinement.reached:
            assert audit.passed, declare
        if audit.passed and audit.integration_error <= 1e-4:
            assert solution.refinement.reached, declare


# ---- breaks ------------------------------------------------------------------------------------------------------


def kinked(place: float = 0.37) -> Problem:
    """A load that turns round sharply at a known time."""
    problem, x, u = plant("kinked", initial=0.0)
    problem.dynamics(x, u + 20 * ca.fabs(problem.time - place))
    problem.minimize(running=(x - 1) ** 2 + 0.05 * u**2)
    return problem


def test_a_break_becomes_a_node_and_saves_intervals() -> None:
    plain, broken = refine(kinked(), Collocation(4)), refine(kinked(), Collocation(4).with_nodes_at([0.37]))
    assert plain.refinement is not None
    assert broken.refinement is not None
    assert broken.refinement.reached
    assert np.abs(broken.control_interpolant.breaks - 0.37).min() < 1e-15
    assert broken.refinement.intervals[-1] < plain.refinement.intervals[-1]
    assert len(broken.refinement.intervals) < len(plain.refinement.intervals)
    assert broken.cost == pytest.approx(solve(kinked(), Collocation(100, 4)).cost, rel=1e-3)


@pytest.mark.parametrize("method", [Collocation(4, 4), Collocation(4, 4, "legendre")], ids=str)
def test_a_break_where_nothing_breaks_changes_nothing(method: Method) -> None:
    """The optimum of least energy is a cubic, which the polynomials hold whatever their nodes are."""
    plain, broken = refine(energy(), method), refine(energy(), method.with_nodes_at([0.31, 0.62]))
    t = np.linspace(0, 1, 101)
    assert broken.cost == pytest.approx(plain.cost, rel=1e-12)
    for name in ("q", "v", "u"):
        np.testing.assert_allclose(broken.at(t)[name], plain.at(t)[name], atol=1e-9)


def test_given_nodes_are_kept() -> None:
    solution = refine(van_der_pol(horizon=2.0), Collocation(4).with_nodes_at([0.3, 0.85]), tolerance=1e-3)
    for time in (0.6, 1.7):
        assert np.abs(solution.t - time).min() < 1e-12


@pytest.mark.parametrize("method", [Collocation(10), MultipleShooting(10, control="linear")], ids=str)
def test_nodes_are_laid_evenly_between_fractions_and_none_is_wider_than_before(method: Method) -> None:
    result = method.with_nodes_at([0.25, 0.999, 0.5])
    assert {0.0, 0.25, 0.5, 0.999, 1.0} <= set(result.fractions)
    widths = np.diff(result.fractions)
    assert widths.max() <= 0.1 + 1e-15
    for left, right in ((0.0, 0.25), (0.25, 0.5), (0.5, 0.999)):
        inside = widths[(result.fractions[:-1] >= left) & (result.fractions[:-1] < right)]
        np.testing.assert_allclose(inside, inside[0], rtol=1e-12)
    assert result.intervals == 3 + 3 + 5 + 1
    assert type(result) is type(method)
    assert result.control == method.control


def test_an_initial_mesh_keeps_its_nodes_and_gains_requested_ones() -> None:
    method = Collocation(3, mesh=(0.0, 0.1, 0.55, 1.0))
    assert method.with_nodes_at([0.3, 0.1, 1e-12, 0.3 + 1e-12]).mesh == (0.0, 0.1, 0.3, 0.55, 1.0)
    assert method.with_nodes_at([]) == method
    assert Collocation(4).with_nodes_at([0.5]).fractions.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize("fractions", [[1.5], [-0.1], [np.nan], "half", None, [[0.1], [0.2, 0.3]]])
def test_fractions_that_are_none_are_refused(fractions: Any) -> None:
    with pytest.raises(ProblemError, match="fractions") as caught:
        Collocation(4).with_nodes_at(fractions)
    assert caught.value.name == "fractions"


# ---- laws --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["radau", "rk4-linear"])
def test_the_integration_error_falls_with_its_order_from_round_to_round(method: str) -> None:
    past = refined(method).refinement
    assert past is not None
    assert order(1 / np.array(past.intervals), np.array(past.errors["integration"])) > 3.0


@pytest.mark.parametrize(("method", "least"), [("radau-held", 1.9), ("rk4-held", 1.9), ("rk4-linear", 3.5)])
def test_the_cost_that_is_lost_falls_with_twice_the_order_of_the_controls(method: str, least: float) -> None:
    """In the first round every interval is split; later rounds split for the integration alone.

    Linear controls lose what falls with the fourth order, on so few intervals a little less.
    """
    past = refined(method).refinement
    assert past is not None
    assert past.intervals[1] == RefinementSettings().max_parts * past.intervals[0]
    assert order(1 / np.array(past.intervals[:2]), np.array(past.errors["cost"][:2])) > least


def reached_out(backwards: bool) -> Problem:
    """Follow a step at 0.7 s, or its mirror image."""
    problem, x, u = plant("step", lower=-5.0)
    problem.dynamics(x, -u if backwards else u)
    time = 1 - problem.time if backwards else problem.time
    target = 0.5 * (1 + ca.tanh((time - 0.7) / 0.03))
    problem.minimize(running=(x - target) ** 2 + 0.01 * u**2)
    return problem


def test_time_reversed_the_mesh_is_mirrored() -> None:
    method = Collocation(5, scheme="legendre", control="held")
    forth, back = (refine(reached_out(b), method, tolerance=1e-3) for b in (False, True))
    assert forth.refinement is not None
    assert len(forth.refinement.intervals) > 2
    assert back.cost == pytest.approx(forth.cost, rel=1e-9)
    np.testing.assert_allclose(back.control_interpolant.breaks, 1 - forth.control_interpolant.breaks[::-1], atol=1e-12)


def in_other_units(length: float, time: float, force: float, cost: float) -> Problem:
    """Van der Pol's oscillator with everything counted in units of so much."""
    problem = Problem("van der Pol in other units")
    x = problem.state("x", 2, initial=[1.0 / length, 0.0])
    u = problem.control("u")
    a, b, w = x[0] * length, x[1] * length, u * force
    problem.dynamics(x, ca.vertcat(b, (1 - a**2) * b - a + w) * time / length)
    problem.horizon(2.0 / time)
    problem.minimize(running=(a**2 + b**2 + w**2) / 2 * time / cost)
    return problem


@pytest.mark.parametrize("method", START)
def test_the_mesh_does_not_know_the_units(method: str) -> None:
    other = refine(in_other_units(1e-3, 0.1, 20.0, 5.0), START[method], tolerance=1e-6)
    own = refined(method)
    assert other.refinement is not None
    assert own.refinement is not None
    assert other.refinement.intervals == own.refinement.intervals
    np.testing.assert_allclose(other.control_interpolant.breaks, own.control_interpolant.breaks, rtol=1e-12)
    assert other.cost * 5.0 == pytest.approx(own.cost, rel=1e-6)


# ---- where the solution is sharp ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [Collocation(6), Collocation(6, scheme="legendre"), MultipleShooting(8)], ids=str)
def test_intervals_gather_where_the_solution_is_sharp(method: Method) -> None:
    solution = refine(layer(), method, tolerance=1e-5)
    assert solution.refinement is not None
    assert solution.refinement.reached
    mesh = solution.control_interpolant.breaks
    widths = np.diff(mesh)
    middle = mesh[:-1] + widths / 2
    inside, outside = widths[np.abs(middle - 0.7) < 0.03], widths[np.abs(middle - 0.7) > 0.15]
    assert np.median(inside) < np.median(outside) / 4
    assert mesh[0] == 0.0
    assert mesh[-1] == 1.0
    even = solve(layer(), type(method)(solution.refinement.intervals[-1]))
    assert even.audit().integration_error > 3 * solution.audit().integration_error


def test_intervals_gather_where_the_costates_are_wrong() -> None:
    """x' = u, x^2 + (width u)^2: states and costates fall as exp(-t / width), and lie still after."""
    width, request = 0.02, 1e-6
    problem, x, u = plant("falls", initial=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=(x**2 + width**2 * u**2) / 2)
    solution = refine(
        problem, Collocation(6, 3), tolerance=1.0, settings=RefinementSettings(limits={"costates": request})
    )
    assert solution.refinement is not None
    assert solution.refinement.reached
    count, mesh = solution.refinement.intervals[-1], solution.control_interpolant.breaks
    assert np.sum(mesh < 10 * width) > 0.8 * count
    row = "costates between the nodes, relative"
    even = solve(problem, Collocation(count, 3)).audit()[row].value
    assert solution.audit()[row].value <= request < even / 30
    t = np.linspace(0.0, 0.2, 101)
    np.testing.assert_allclose(solution.costate_interpolant(t)[:, 0], width * np.exp(-t / width), atol=1e-3 * width)


def test_a_stop_at_the_node_limit_is_reported_with_a_warning() -> None:
    with pytest.warns(RefinementWarning, match=r"'layer' stopped at \d+ of at most 12 intervals .*raise max_intervals"):
        solution = refine(layer(), Collocation(4), tolerance=1e-10, settings=RefinementSettings(max_intervals=12))
    assert solution.refinement is not None
    assert not solution.refinement.reached
    assert solution.refinement.intervals[-1] <= 12
    assert solution.refinement.errors["integration"][-1] > 1
    assert solution.success


def test_the_first_mesh_may_be_the_last() -> None:
    with pytest.warns(RefinementWarning):
        solution = refine(layer(), Collocation(4), tolerance=1e-10, settings=RefinementSettings(max_intervals=4))
    assert solution.refinement is not None
    assert solution.refinement.intervals == (4,)


def test_everything_is_passed_on_to_the_solves() -> None:
    reference = solve(swing(), Collocation(40), parameters=SWING)
    solution = refine(
        swing(),
        Collocation(8),
        tolerance=1e-4,
        parameters=SWING,
        options={"max_iter": 200},
        guess=reference,
        settings=RefinementSettings(solver="fatrop"),
    )
    assert solution.solver == "fatrop"
    assert solution.cost == pytest.approx(reference.cost, rel=1e-4)


def test_an_uneven_first_mesh_is_kept_and_split() -> None:
    mesh = (0.0, 0.1, 0.55, 1.0)
    solution = refine(van_der_pol(), Collocation(3, 2, mesh=mesh), tolerance=1e-4)
    for node in mesh:
        assert np.min(np.abs(solution.control_interpolant.breaks - node)) < 1e-14


def test_a_failed_round_raises_the_error_of_solving() -> None:
    with pytest.raises(SolveError):
        refine(van_der_pol(), Collocation(3), options={"max_iter": 1})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "tolerance must be positive and finite, not 0"),
        ({"tolerance": -1e-6}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"tolerance": np.inf}, "tolerance"),
        ({"tolerance": None}, "tolerance"),
        ({"tolerance": "tight"}, "tolerance"),
        ({"settings": {"max_intervals": 2}}, "max_intervals 2 is below the 3 intervals given"),
        ({"settings": {"max_intervals": "many"}}, "max_intervals"),
        ({"settings": {"max_intervals": np.nan}}, "max_intervals"),
        ({"settings": {"limits": {"constraint": 1e-6}}}, "limit of the audit 'constraint' does not exist"),
        ({"settings": {"limits": {"constraints": -1.0}}}, "'constraints' must be a number"),
        ({"settings": {"limits": [1e-6]}}, "limits must be a dictionary"),
        ({"settings": {"limits": {"tolerances": {"y": 1.0}}}}, "name in tolerances 'y' does not exist"),
        ({"method": None}, "refine: .* expected, not None"),
        ({"method": Collocation}, "refine: .* expected"),
        ({"settings": {"solver": "snopt"}}, "solver must be"),
        ({"parameters": {"p": 1.0}}, "parameter .p. does not exist"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    options = {"method": Collocation(3), **arguments}
    with pytest.raises(ProblemError, match=message):
        refine(van_der_pol(), **{**options, "settings": RefinementSettings(**options.get("settings", {}))})


# ---- splitting ---------------------------------------------------------------------------------------------------


@given(
    wanted=st.lists(st.tuples(st.integers(1, 4), st.one_of(st.floats(0.0, 1e3), st.just(float("inf")))), min_size=1),
    room=st.integers(0, 60),
)
def test_split_meshes_are_finer_ordered_and_never_beyond_the_cap(wanted: list[tuple[int, float]], room: int) -> None:
    n = len(wanted)
    segments, bad = np.array([number for number, _ in wanted]), np.array([value for _, value in wanted])
    mesh = np.linspace(0.0, 1.0, n + 1)
    finer = split(mesh, segments, bad, n + room)
    assert finer[0] == 0.0
    assert finer[-1] == 1.0
    assert np.all(np.diff(finer) > 0)
    assert len(finer) - 1 == min(n + room, segments.sum())
    assert set(mesh) <= set(finer)


def test_the_worst_interval_is_split_first() -> None:
    finer = split(np.linspace(0.0, 1.0, 5), np.array([1, 4, 4, 1]), np.array([1e-9, 1.0, 1e-3, 1e-9]), 6)
    assert len(finer) == 7
    assert np.sum((finer > 0.25) & (finer < 0.5)) == 2


def test_a_sharp_start_does_not_hide_a_smooth_rest() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RefinementWarning)
        solution = refine(layer(0.003), Collocation(4, 4), tolerance=1e-6)
    assert solution.audit().passed
