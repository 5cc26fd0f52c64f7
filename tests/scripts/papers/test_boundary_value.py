"""The costates at the end: (35) as printed is degenerate or worse, lam(t_f) = 0 is what it should say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from scripts.papers.free_floating.costates import costate_rate, hamiltonian, state_rate
from scripts.papers.free_floating.recursion import J, dJ
from tests.models.robot.chains import CLEARLY, TOLERANCE, Case, error, example, spatial_case
from tests.models.robot.trees import Array

LINEAR = [3, 4, 5]
ABOVE_ROUNDING = 1e-3
"""Relative difference that no rounding makes."""


def flow(case: Case, x: Array, lam: Array, times: tuple[float, float], tolerance: float = 1e-10) -> tuple[Array, Array]:
    """x and lam at the end of the extremal (34) from the first time to the second."""
    N = case.chain.N

    def rate(_: float, y: Array) -> Array:
        at = case.chain, y[:N], y[N:], case.v, case.rows
        return np.concatenate([state_rate(*at), costate_rate(*at)])

    end = solve_ivp(rate, times, np.concatenate([x, lam]), method="DOP853", rtol=tolerance, atol=tolerance / 10)
    return end.y[:N, -1], end.y[N:, -1]


def test_the_hamiltonian_is_constant_along_an_extremal() -> None:
    """Time does not enter it."""
    case = example()
    x, lam = flow(case, case.x, 0.3 * case.lam, (0.0, 0.8))
    assert np.abs(x - case.x).max() > 0.3
    start = hamiltonian(case.chain, case.x, 0.3 * case.lam, case.v, case.rows)
    assert hamiltonian(case.chain, x, lam, case.v, case.rows) == pytest.approx(start, rel=1e-9)


def gauge_change(case: Case, rows: list[int], v: Array, mu: Array) -> tuple[Array, Array]:
    """What J^T mu adds to the costate rate, and d/dt (J^T mu) along the motion at constant mu. Shape (N,) both."""
    chain, x, lam = case.chain, case.x, case.lam
    shifted = lam + J(chain, x)[rows].T @ mu
    rate = state_rate(chain, x, lam, v, rows)
    assert error(state_rate(chain, x, shifted, v, rows), rate) < TOLERANCE  # nothing moves otherwise
    gain = hamiltonian(chain, x, shifted, v, rows) - hamiltonian(chain, x, lam, v, rows)
    assert gain == pytest.approx(mu @ v, rel=1e-11)
    change = costate_rate(chain, x, shifted, v, rows) - costate_rate(chain, x, lam, v, rows)
    return change, np.einsum("k,kri,r->i", rate, dJ(chain, x)[:, rows], mu)


@pytest.mark.parametrize("size", [4, 7, 10])
def test_costates_in_the_range_of_the_constraint_jacobian_are_pure_gauge(size: int) -> None:
    """lam + J^T mu satisfies (35) if lam does, moves nothing, and stays of this form with the same mu.

    The velocity of the tip is a gradient, that of its position.
    """
    case, rows = spatial_case(size), LINEAR
    F, mu = J(case.chain, case.x)[rows], np.array([0.5, -0.8, 1.3])
    projector = np.eye(case.chain.N) - np.linalg.pinv(F) @ F
    assert np.abs(projector @ (F.T @ mu)).max() < TOLERANCE * np.abs(F.T @ mu).max()
    assert np.linalg.matrix_rank(projector) == case.chain.N - len(rows)
    change, along = gauge_change(case, rows, np.array([0.7, -1.1, 0.4]), mu)
    assert error(change, along) < 10 * TOLERANCE


@pytest.mark.parametrize("rows", [[0, 1, 2], [0, 1, 2, 3, 4, 5]])
def test_the_angular_part_of_the_gauge_turns_with_the_tip(rows: list[int]) -> None:
    """The angular velocity is no gradient, but mu' = omega x mu makes up for it, and the task prescribes omega."""
    case, rng = spatial_case(8), np.random.default_rng(5)
    v, mu = rng.normal(size=len(rows)), rng.normal(size=len(rows))
    change, along = gauge_change(case, rows, v, mu)
    mu_rate = np.zeros(len(rows))
    mu_rate[:3] = np.cross(v[:3], mu[:3])
    assert error(change, along + J(case.chain, case.x)[rows].T @ mu_rate) < 10 * TOLERANCE
    assert error(change, along) > ABOVE_ROUNDING


@pytest.mark.parametrize("rows", [[0], [0, 4, 5], [0, 1, 3, 4]])
def test_part_of_the_angular_velocity_has_no_gauge(rows: list[int]) -> None:
    """No mu(t) keeps lam + J^T mu of this form."""
    case, rng = spatial_case(8), np.random.default_rng(5)
    change, along = gauge_change(case, rows, rng.normal(size=len(rows)), rng.normal(size=len(rows)))
    F = J(case.chain, case.x)[rows]
    outside = change - along - np.linalg.pinv(F) @ F @ (change - along)
    assert np.abs(outside).max() > ABOVE_ROUNDING * np.abs(change).max()


@pytest.mark.long
def test_with_part_of_the_angular_velocity_fixed_equation_35_allows_other_motions() -> None:
    """Backward from one end, with costates zero and J^T mu there: both satisfy (35), only the first is optimal."""
    case = spatial_case(3)
    moved = {}
    for name, rows in (("linear", [3, 4]), ("partly angular", [0, 4])):
        task = replace(case, rows=rows, v=np.array([0.3, -0.4]))
        gauge = J(case.chain, case.x)[rows].T @ np.array([2.0, 3.0])
        starts = [flow(task, case.x, lam, (0.4, 0.0), 1e-7)[0] for lam in (np.zeros(case.chain.N), gauge)]
        moved[name] = error(starts[1] - case.x, starts[0] - case.x)
    assert moved["linear"] < 1e-5
    assert moved["partly angular"] > ABOVE_ROUNDING


@pytest.mark.long
def test_the_printed_boundary_value_is_degenerate_and_zero_costates_are_not() -> None:
    """Along extremals of the paper's example: 2 of the 6 costates at the start are undetermined by (35)."""
    case = example()
    times, lam = (0.0, 0.5), 0.2 * case.lam

    def condition_35(x: Array, lam: Array) -> Array:
        F = J(case.chain, x)[case.rows]
        residual: Array = lam - np.linalg.pinv(F) @ F @ lam
        return residual

    F = J(case.chain, case.x)[case.rows]
    x_end, lam_end = flow(case, case.x, lam, times)
    residual = condition_35(x_end, lam_end)
    for mu in 0.5 * np.eye(2):
        x_same, lam_other = flow(case, case.x, lam + F.T @ mu, times)
        assert error(x_same, x_end) < 1e-9
        assert error(lam_other - lam_end, J(case.chain, x_end)[case.rows].T @ mu) < 1e-9
        assert error(condition_35(x_same, lam_other), residual) < 1e-9
    step = 1e-4
    columns = [(flow(case, case.x, lam + dlam, times)[1] - lam_end) / step for dlam in step * np.eye(6)]
    sensitivity = np.array(columns).T
    values = np.linalg.svd(sensitivity, compute_uv=False)
    assert values[-1] > 0.01 * values[0]  # lam(t_f) = 0 determines all six


def test_any_end_allowed_by_the_constraint_jacobian_gives_the_motion_of_zero_costates() -> None:
    """(35) and lam(t_f) = 0 are equivalent: backward from the same end, the same motion."""
    case = example()
    end = case.x
    x_zero, lam_zero = flow(case, end, np.zeros(6), (0.3, 0.0))
    mu = np.array([0.6, -0.4])
    x_gauge, lam_gauge = flow(case, end, J(case.chain, end)[case.rows].T @ mu, (0.3, 0.0))
    assert error(x_gauge, x_zero) < 1e-9
    assert error(lam_gauge - lam_zero, J(case.chain, x_zero)[case.rows].T @ mu) < 1e-9
    assert np.abs(lam_gauge - lam_zero).max() > 0.1


def test_the_whole_end_effector_jacobian_in_equation_35_admits_ends_that_are_not_optimal() -> None:
    """J of Algorithm 2 has rows that the task leaves free; costates in their range do change the motion."""
    case = example()
    free = J(case.chain, case.x)[[2]]
    whole = J(case.chain, case.x)[[2, 3, 4]]
    lam = free[0]
    assert np.abs(lam - np.linalg.pinv(whole) @ whole @ lam).max() < TOLERANCE  # the printed condition holds
    rest = state_rate(case.chain, case.x, np.zeros(6), case.v, case.rows)
    moved = state_rate(case.chain, case.x, lam, case.v, case.rows)
    assert error(moved, rest) > CLEARLY
