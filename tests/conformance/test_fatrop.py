"""The structure-exploiting solver reaches the optimum that IPOPT reaches on the same transcription."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ocp import Collocation, Solution, solve

from .case import Case, Run
from .cases import CASES
from .principle import number


def is_supported(case: Case, run: Run) -> bool:
    """Whether fatrop reaches its tolerance.

    Along the ceiling of Bryson-Denham the bound does not push (its multiplier is zero) and, with the contact on nodes,
    leaves no freedom: there fatrop keeps regularising and ends some 2e-8 short.
    """
    return not (
        case.name.startswith("Bryson-Denham") and isinstance(run.method, Collocation) and run.method.intervals == 12
    )


RUNS = [(c, r, f"{c.name}: {r}") for c in CASES for r in c.runs if is_supported(c, r)]


def first(case: Case) -> Run:
    """The run of a case that is solved in every run of the tests."""
    return next(run for known, run, _ in RUNS if known is case)


every_run = pytest.mark.parametrize(
    ("case", "run"),
    [
        pytest.param(
            *(c, r),
            id=name,
            marks=[pytest.mark.xdist_group(f"fatrop {name}"), *([] if r is first(c) else [pytest.mark.long])],
        )
        for c, r, name in RUNS
    ],
)


@cache
def solved(case: Case, run: Run) -> tuple[Solution, Solution]:
    """By IPOPT, by fatrop."""
    problem = case.build()
    by = ("ipopt", "fatrop")
    a, b = (solve(problem, run.method, solver=solver) for solver in by)
    return a, b


@every_run
def test_fatrop_reaches_the_optimum_of_ipopt(case: Case, run: Run) -> None:
    ipopt, fatrop = solved(case, run)
    assert abs(fatrop.cost - ipopt.cost) < 1e-8 * max(1.0, abs(ipopt.cost))
    assert abs(fatrop.horizon - ipopt.horizon) < 1e-8 * max(1.0, ipopt.horizon)


@every_run
def test_fatrop_keeps_the_bounds(case: Case, run: Run) -> None:
    fatrop = solved(case, run)[1]
    declared = case.build().declared
    # controls at collocation points are extrapolated to the ends of the horizon: there they are no variables
    controls = {} if run.method.control == "points" else declared.controls
    for name, variable in (*declared.states.items(), *controls.items()):
        assert np.all(fatrop[name] >= number(variable.lower) - 1e-9), name
        assert np.all(fatrop[name] <= number(variable.upper) + 1e-9), name
