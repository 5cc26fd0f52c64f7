"""Problems solved without a method and without a guess: known optima to six digits, saddles, failures."""

from __future__ import annotations

from dataclasses import replace
from typing import Never

import numpy as np
import pytest

import ocp.adaptive
from ocp import AdaptiveCollocation, Collocation, Problem, ProblemError, SolveError, prepare, solve
from tests.conformance.suite import bryson_max_range
from tests.ocp.direct.test_without_guess import reorientation
from tests.ocp.problems import LogarithmicRegulator, double_integrator, plant


def test_a_smooth_optimum_is_known_to_six_digits() -> None:
    regulator = LogarithmicRegulator()
    for accuracy in (1e-4, 1e-6):
        solution = solve(regulator.build(), AdaptiveCollocation(accuracy=accuracy))
        assert solution.refinement is not None
        assert solution.refinement.reached
        assert solution.cost == pytest.approx(regulator.cost, rel=accuracy)


def test_a_minimum_time_plan_is_known_to_six_digits() -> None:
    problem, *_ = double_integrator("race", (0.0, 0.4), (1.0, 0.0), horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0))
    solution = solve(problem)
    assert solution.audit().passed
    assert solution.horizon == pytest.approx(2 * np.sqrt(1.08) - 0.4, rel=1e-6)


def test_a_symmetric_saddle_is_left() -> None:
    """From straight lines the solver ends at a stationary plan of 34.3 s, a turn about one axis; PSOPT: 28.63041 s."""
    problem = reorientation(fourth_is_control=False)
    problem.declared.controls["torque"] = replace(problem.declared.controls["torque"], guess=None)
    assert solve(problem, Collocation(12)).cost > 34.0
    solution = solve(problem)
    assert solution.start == "displaced guess"
    assert solution.cost == pytest.approx(28.63041, rel=1e-6)
    assert solution.audit().passed


def test_the_guess_parameters_and_progress_are_passed_on() -> None:
    problem = Problem("reach")
    goal = problem.parameter("goal")
    x = problem.state("x", initial=0.0, terminal=goal)
    u = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(u**2)
    stages: list[str] = []
    prepared = prepare(problem, AdaptiveCollocation(progress=stages.append))
    for value in (2.0, 3.0):
        solution = prepared.solve({"goal": value}, {"x": lambda t, value=value: value * t})
        assert solution.cost == pytest.approx(value**2, rel=1e-8)
    assert len(stages) >= 6


class UnbuiltCollocation(Collocation):
    """A mesh whose program is not built within the time limit."""

    def prepare(self, problem: Problem, **_: object) -> Never:
        raise SolveError(f"problem {problem.name!r} was still being built")


def test_the_plan_of_a_coarse_mesh_survives_a_finer_one_that_is_not_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ocp.adaptive, "FIRST_MESHES", (Collocation(12), UnbuiltCollocation(20)))
    monkeypatch.setattr(ocp.adaptive, "FIRST_STARTS", ("guess",))
    problem, x, u = plant("near", initial=0.0, terminal=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    solution = solve(problem)
    assert solution.success
    assert solution.cost == pytest.approx(1.0 / solution.horizon, rel=1e-6)


def test_the_error_without_a_plan_names_the_conflict_and_what_has_no_guess() -> None:
    problem, x, u = plant("too far", initial=0.5, terminal=2.0, u={"lower": -0.1, "upper": 0.1})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    with pytest.raises(
        SolveError, match=r"(?s)no plan on any.*bound.*Collocation\(12\) from the guess.*states x"
    ) as error:
        solve(problem)
    assert error.value.conflicts


@pytest.mark.parametrize("arguments", [{"accuracy": 0.0}, {"accuracy": 2.0}, {"max_intervals": 3}])
def test_invalid_settings_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(ProblemError, match="AdaptiveCollocation"):
        AdaptiveCollocation(**arguments)  # type: ignore[arg-type]


def test_the_lowest_of_several_local_minima_is_refined() -> None:
    """On twelve intervals one start fails and the other ends in a poor local minimum; Bryson & Ho: range 1.7123."""
    solution = solve(bryson_max_range.build())
    assert solution.cost == pytest.approx(-1.712314, rel=1e-6)
    assert solution.audit().passed
