"""Least Hamiltonians of hand-made extremals, whose controls are known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ocp import Problem
from ocp.indirect.hamiltonian import Extremal, Hamiltonian
from ocp.indirect.method import hamiltonian_defect
from ocp.problem.formulation import Formulation


def verdict(
    controls: Any,
    costate: float = 1.0,
    curvatures: tuple[float, float] = (1.0, 1.0),
    lower: Any = None,
    upper: Any = None,
    total: float | None = None,
    cost: float = 1.0,
    unit: float = 1.0,
) -> str:
    """What is wrong with constant controls u of q' = u1 + u2 at a costate, with cost sum of curvature u^2 / 2.

    Without bounds H is least at u = -costate / curvature. With `total`, u1 + u2 is given as a path equality. The cost
    is told in another unit, and so are the controls.
    """
    problem = Problem("two")
    q = problem.state("q", initial=0.0)
    u = problem.control("u", 2, lower=None if lower is None else np.multiply(lower, unit),
                        upper=None if upper is None else np.multiply(upper, unit))  # fmt: skip
    problem.dynamics(q, (u[0] + u[1]) / unit)
    if total is not None:
        problem.path("total", u[0] + u[1], lower=total * unit, upper=total * unit)
    problem.horizon(1.0)
    problem.minimize(running=cost * (curvatures[0] * u[0] ** 2 + curvatures[1] * u[1] ** 2) / 2 / unit**2)
    form = Formulation(problem)
    m = len(form.path)
    symbols = form.problem.symbols
    lam, mu = symbols.sym("lam", 1), symbols.sym("mu", m)
    rows = form.path.expression - (total or 0.0) * unit if m else form.path.expression
    value = form.running + lam * form.f + (mu.T @ rows if m else 0.0)
    ham = Hamiltonian(form, lam, mu, rows, value, (0, 1), (), None, "quadratic")
    shape = (1, 3)
    used = np.asarray(controls, dtype=float)
    # the multiplier that holds the sum leaves nothing of the first control's slope
    multiplier = -cost * (curvatures[0] * used[0] + costate) / unit
    path = Extremal(
        np.array([0.0, 0.5, 1.0]),
        np.ones(1),
        np.array([[0.0, 0.5, 1.0]]),
        np.zeros((*shape, 1)),
        np.full((*shape, 1), cost * costate),
        np.tile(used * unit, (*shape, 1)),
        np.full((*shape, m), multiplier),
        1.0,
        np.zeros(0),
        np.zeros(0),
    )
    p = form.parameter_vector({})
    return hamiltonian_defect(ham, path, p, form.bound_values(p))


units = pytest.mark.parametrize(("cost", "unit"), [(1.0, 1.0), (1e8, 1.0), (1e-8, 1.0), (1.0, 1e5), (1.0, 1e-5)])


@units
def test_the_closed_form_is_the_minimum_in_any_unit(cost: float, unit: float) -> None:
    for costate in (0.5, -2.0):
        least = np.array([-costate / 1.0, -costate / 4.0])
        by_name: dict[str, Any] = {"costate": costate, "curvatures": (1.0, 4.0), "cost": cost, "unit": unit}
        assert verdict(least, **by_name) == ""
        assert verdict(least * (1 + 1e-8), **by_name) == ""
        assert "not minimal in control 'u[1]'" in verdict(least * [1, 1 + 1e-4], **by_name)


@units
def test_a_control_at_its_bound_must_push_outwards(cost: float, unit: float) -> None:
    by_name: dict[str, Any] = {"lower": [-3.0, -3.0], "upper": [5.0, 5.0], "cost": cost, "unit": unit}
    for costate, bound in ((7.0, -3.0), (-7.0, 5.0)):  # H is least beyond it
        assert verdict([bound, bound], costate, **by_name) == ""
        assert "not minimal" in verdict([bound, bound + 1e-3 * np.sign(costate)], costate, **by_name)
        assert "not minimal" in verdict([bound, 2 - bound], costate, **by_name)  # the other bound
        assert "not minimal" in verdict([bound, bound], -costate, **by_name)
    # a stationary control on its bound need not push
    assert verdict([-3.0, -3.0], 3.0, **by_name) == verdict([5.0, 5.0], -5.0, **by_name) == ""


@pytest.mark.parametrize("width", [1e3, 2.0, 1e-3])
@pytest.mark.parametrize("middle", [0.0, 0.4])
def test_bounds_fix_variables_within_a_billionth_of_their_range(width: float, middle: float) -> None:
    low, high = middle - width / 2, middle + width / 2
    by_name: dict[str, Any] = {"lower": [low, low], "upper": [high, high]}
    for costate, bound, inwards in ((2 * width + 1, low, 1.0), (-2 * width - 1, high, -1.0)):
        assert verdict([bound, bound + inwards * 0.5e-9 * width], costate, **by_name) == ""
        assert "not minimal" in verdict([bound, bound + inwards * 3e-9 * width], costate, **by_name)


def test_between_equal_bounds_any_slope_is_held() -> None:
    assert verdict([0.3, -1.0], 1.0, lower=[0.3, -np.inf], upper=[0.3, np.inf]) == ""
    assert verdict([0.3, -1.0], 1.0, lower=[0.2, -np.inf], upper=[0.3, np.inf]) != ""  # it would rather leave


@units
def test_negative_curvature_is_stationary_but_no_minimum_unless_fixed(cost: float, unit: float) -> None:
    by_name: dict[str, Any] = {"cost": cost, "unit": unit}
    assert "stationary but not minimal" in verdict([-1.0, 2.0], 1.0, (1.0, -0.5), **by_name)
    assert "stationary but not minimal" in verdict([-1.0, 1e3], 1.0, (1.0, -1e-3), **by_name)
    # along u1 + u2 = const the curvature is the sum of both
    assert verdict([-1.0, 2.0], 1.0, (1.0, -0.5), total=1.0, **by_name) == ""
    assert "stationary but not minimal" in verdict([-1.0, 2.0], 1.0, (-1.0, 0.5), total=1.0, **by_name)
    # at a bound that it is pushed to the curvature does not count
    bounds: dict[str, Any] = {"lower": [-9.0, -9.0], "upper": [9.0, 3.0]}
    assert verdict([-1.0, 3.0], 1.0, (1.0, -0.5), **bounds, **by_name) == ""


def test_a_violated_sum_is_reported() -> None:
    for size in (1.0, 1e3):
        share = np.array([0.5, 0.5]) * size
        assert verdict(share, total=size) == ""
        assert verdict(share * (1 + 1e-8), total=size) == ""
        assert verdict(share * (1 + 1e-5), total=size) == "the path equalities are not met"
