"""Every reference problem by every method that suits it: cost from both sides, trajectory, costates, switches."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import numpy as np
import pytest

from ocp import Solution, solve

from .case import Array, Case, Extremal, Run
from .cases import CASES

RUNS = [(case, run) for case in CASES for run in case.runs]


def of(pairs: list[tuple[Case, Run]]) -> pytest.MarkDecorator:
    """One process for each, so that it is solved once."""
    named = [(c, r, f"{c.name}: {r}") for c, r in pairs]
    marked = [pytest.param(c, r, id=name, marks=pytest.mark.xdist_group(name)) for c, r, name in named]
    return pytest.mark.parametrize(("case", "run"), marked)


every_run = of(RUNS)
runs_with_comparable_controls = of([(c, r) for c, r in RUNS if r.control is not None])
runs_with_switching_functions = of([(c, r) for c, r in RUNS if any(s.function for s in c.switches)])


@cache
def solved(case: Case, run: Run) -> Solution:
    return solve(case.build(), run.method)


def known(case: Case, solution: Solution) -> Extremal:
    """The optimum at the reported times, which are stretched to the known horizon where it is free."""
    return case.optimum(solution.t * (case.horizon / solution.horizon))


def apart(case: Case, run: Run, solution: Solution, times: Iterable[float]) -> Array:
    """Which reported times stand apart from jumps at `times`. Shape (M,), bool.

    A jump cannot be located better than to the interval that holds it; at a node either of its sides may be reported.
    """
    method = run.method
    mesh = np.linspace(0, 1, method.intervals + 1) if method.mesh is None else np.array(method.mesh)
    fraction = solution.t / solution.horizon
    far = np.ones(fraction.shape, dtype=bool)
    for place in (time / case.horizon for time in times):
        is_node = np.abs(mesh - place).min() < 1e-9
        far &= np.abs(fraction - place) > (1e-9 if is_node else 1.001 * np.diff(mesh).max())
    return far


def largest_error(result: Array, expected: Array, where: Array) -> float:
    assert where.any()
    return float(np.abs(result - np.reshape(expected, result.shape))[where].max())


@every_run
def test_cost_is_the_optimum_from_both_sides(case: Case, run: Run) -> None:
    below, above = run.cost
    assert -below <= solved(case, run).cost - case.cost <= above


@every_run
def test_horizon_is_the_optimal_one(case: Case, run: Run) -> None:
    horizon = solved(case, run).horizon
    assert abs(horizon - case.horizon) <= (1e-12 if run.time is None else run.time)


def assert_follows(case: Case, run: Run, kind: str, limit: float | None, corners: Iterable[float] = ()) -> None:
    """States, controls or costates follow the optimum at the reported times that stand apart from corners."""
    solution = solved(case, run)
    where = apart(case, run, solution, corners)
    assert limit is not None
    for name, expected in getattr(known(case, solution), kind).items():
        assert largest_error(getattr(solution, f"{kind}s")[name], expected, where) < limit, name


@every_run
def test_states_follow_the_optimum(case: Case, run: Run) -> None:
    assert_follows(case, run, "state", run.state)


@every_run
def test_costates_follow_the_optimum(case: Case, run: Run) -> None:
    assert_follows(case, run, "costate", run.costate, case.jumps)


@runs_with_comparable_controls
def test_controls_follow_the_optimum(case: Case, run: Run) -> None:
    assert_follows(case, run, "control", run.control, [switch.time for switch in case.switches])


@runs_with_switching_functions
def test_switching_functions_change_sign_at_the_switches(case: Case, run: Run) -> None:
    solution = solved(case, run)
    states = {name: solution[name][:, 0] for name in solution.states}
    costates = {name: solution.costate(name)[:, 0] for name in solution.states}
    assert run.time is not None
    for switch in case.switches:
        if switch.function is not None:
            value = switch.function(states, costates)
            before = np.flatnonzero(value[:-1] * value[1:] <= 0)
            rise, step = np.diff(value)[before], np.diff(solution.t)[before]
            zeros = solution.t[before] - value[before] * step / np.where(rise == 0, 1.0, rise)
            assert np.abs(zeros - switch.time).min() <= run.time
