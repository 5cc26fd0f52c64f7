"""Every reference problem by the minimum principle, nearer than a mesh can come; and what it cannot take, by name."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ocp import Audit, Indirect, ProblemError, Solution, SolveError, certificate, solve

from .case import Array, Case
from .cases import CASES
from .principle import Principle, stack
from .test_conformance import known, largest_error

pytestmark = pytest.mark.xdist_group("indirect conformance")  # one process, so that every problem is solved once

# what stands in the way of the others: the error, and the word for it
REFUSED: dict[str, tuple[type[Exception], str]] = {
    "Bryson-Denham": (ProblemError, r"bounds of state 'q'"),
    "Bryson-Denham, ceiling as a path": (ProblemError, r"path inequality 'ceiling'"),
    "pendulum as DAE": (ProblemError, r"bounds of state 'x'"),
    "Goddard": (SolveError, r"control 'F' has a singular arc from 0\.0\d+ to 0\.0\d+ s"),
    "catalyst mixing": (SolveError, r"control 'u' has a singular arc from 0\.1\d+ to 0\.7\d+ s"),
    "Fuller": (SolveError, r"control 'u' .*singular arc"),
}
TAKEN = [case for case in CASES if case.name not in REFUSED]

# Optima without a closed form are integrated themselves: good to about 1e-10, relative, between steps. Between the ten
# points of a segment a plan is a polynomial of degree nine.
COST, STATE, COSTATE, TIME, BETWEEN = 1e-9, 2e-9, 2e-9, 1e-9, 1e-6

every_case = pytest.mark.parametrize("case", TAKEN, ids=lambda case: case.name)


@cache
def solved(case: Case) -> Solution:
    return solve(case.build(), Indirect())


def bang_bang(case: Case) -> bool:
    """Whether the Hamiltonian is linear in the control, so that corners of the control are switches."""
    return case.name in ("consumption", "minimum time", "soft lander")


def scaled(*values: Array | float) -> float:
    return max(1.0, *(float(np.max(np.abs(value))) for value in values))


@every_case
def test_cost_is_the_optimum_from_both_sides(case: Case) -> None:
    assert abs(solved(case).cost - case.cost) < COST * scaled(case.cost)
    assert abs(solved(case).horizon - case.horizon) < TIME


@pytest.mark.parametrize(("kind", "limit"), [("state", STATE), ("costate", COSTATE)])
@every_case
def test_states_and_costates_follow_the_optimum_at_all_reported_times(case: Case, kind: str, limit: float) -> None:
    solution = solved(case)
    everywhere = np.ones(solution.t.shape, dtype=bool)
    for name, expected in getattr(known(case, solution), kind).items():
        assert largest_error(getattr(solution, f"{kind}s")[name], expected, everywhere) < limit * scaled(expected), name


@every_case
def test_controls_follow_the_optimum_but_at_the_switches(case: Case) -> None:
    solution = solved(case)
    where = np.ones(solution.t.shape, dtype=bool)
    if bang_bang(case):
        for switch in case.switches:
            where &= np.abs(solution.t - switch.time) > TIME
    for name, expected in known(case, solution).control.items():
        assert largest_error(solution[name], expected, where) < 1e-7 * scaled(expected), name


@every_case
def test_between_the_reported_times_the_interpolant_is_as_near(case: Case) -> None:
    solution = solved(case)
    t = np.linspace(0, 1, 997) * solution.horizon
    optimum = case.optimum(t * (case.horizon / solution.horizon))
    everywhere = np.ones(t.shape, dtype=bool)
    for name, expected in optimum.state.items():
        assert largest_error(solution.at(t)[name], expected, everywhere) < BETWEEN * scaled(expected), name


@every_case
def test_switching_times_are_the_optimal_ones(case: Case) -> None:
    switches = solved(case).method["switches"]
    if bang_bang(case):
        np.testing.assert_allclose(switches, [switch.time for switch in case.switches], atol=TIME)
    else:  # corners of a saturated control are no switches; they are where its switching function vanishes
        assert switches == []
        solution = solved(case)
        for corner in case.switches:
            assert corner.function is not None
            around = corner.time + 1e-7 * np.array([-1.0, 1.0])
            lam = solution.costate_interpolant(around / solution.horizon)
            costates = dict(zip(solution.states, lam.T, strict=True))
            states = {name: solution.at(around)[name][:, 0] for name in solution.states}
            before, after = corner.function(states, costates)
            assert before * after < 0


@every_case
def test_the_hamiltonian_is_constant_and_balances_a_free_horizon(case: Case) -> None:
    solution, p = solved(case), Principle(case.build())
    names = solution.states
    point = type(known(case, solution))(solution.states, solution.controls, {n: solution.costate(n) for n in names})
    values = p.along(p.hamiltonian, solution.t, solution.horizon, point).ravel()
    if p.autonomous:
        assert np.ptp(values) < 2e-9 * scaled(values, stack(point.costate, p.states, solution.t.size))
    horizon = p.problem.declared.horizon
    assert horizon is not None
    if not horizon.fixed:
        by_horizon = p.along(p.terminal_by_horizon, solution.t, solution.horizon, point)[-1].item()
        assert abs(values[-1] + by_horizon) < 1e-9


@every_case
def test_the_plan_passes_a_strict_audit(case: Case) -> None:
    """On more segments: the audit looks between the ten points of each, where the plan is a polynomial."""
    limits = {"integration": BETWEEN, "constraints": 1e-8, "lost": 1e-9}
    fine = solve(case.build(), Indirect(segments=60))
    audit = fine.audit(**limits, costates=1e-7)
    assert audit.passed, str(audit)
    assert max(_reported(audit, "stationarity"), _reported(audit, "Hamiltonian drift")) < 1e-7


def _reported(audit: Audit, name: str) -> float:
    """The value of a finding that has no limit; 0 if the problem has none."""
    return next((finding.value for finding in audit.findings if finding.name == f"{name}, relative"), 0.0)


@every_case
def test_the_plan_passes_the_audit(case: Case) -> None:
    audit = solved(case).audit(lost=1e-8, costates=1e-5)
    assert audit.passed, str(audit)


@pytest.mark.parametrize("case", [c for c in TAKEN if not bang_bang(c)], ids=lambda case: case.name)
def test_direct_methods_are_certified_by_the_minimum_principle(case: Case) -> None:
    problem = case.build()
    direct = solve(problem, case.runs[0].method)
    result = certificate(problem, [direct, solved(case)], tolerance=1e-2)
    assert result.passed, str(result)
    assert result.reference.startswith("Indirect")


@pytest.mark.parametrize("name", REFUSED)
def test_problems_outside_the_minimum_principle_are_refused_by_name(name: str) -> None:
    error, message = REFUSED[name]
    case = next(case for case in CASES if case.name == name)
    with pytest.raises(error, match=message) as caught:
        solve(case.build(), Indirect())
    assert "direct method" in str(caught.value)
