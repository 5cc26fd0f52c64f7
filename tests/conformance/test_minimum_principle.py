"""The stated optima satisfy the minimum principle of the stated problems: no solver takes part in these tests."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from .case import Array, Case, Extremal
from .cases import CASES
from .principle import Principle, stack

NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
TOLERANCE = 1e-8  # relative; the dense output of the integrated optima is good to about 1e-10

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@cache
def principle(case: Case) -> Principle:
    return Principle(case.build())


def segments(case: Case) -> list[tuple[float, float]]:
    """Intervals free of corners that cover the horizon, at most 1/40 of it each."""
    corners = sorted({0.0, case.horizon, *(s.time for s in case.switches), *case.jumps})
    cuts = np.concatenate(
        [np.linspace(a, b, 1 + int(np.ceil(40 * (b - a) / case.horizon))) for a, b in pairwise(corners)]
    )
    return [(float(a), float(b)) for a, b in pairwise(np.unique(cuts)) if b - a > 1e-12 * case.horizon]


def inner_points(case: Case) -> tuple[Array, Array]:
    """Gauss points of all pieces and their weights. Shapes (K, 12) each."""
    a, b = np.array(segments(case)).T[:, :, None]
    return (a + b) / 2 + (b - a) / 2 * NODES, (b - a) / 2 * WEIGHTS


def change_against_integral(case: Case, costate: bool) -> Array:
    """Change of states (or costates) over each piece less the integral of their rates, relative to their size."""
    p = principle(case)
    t, w = inner_points(case)
    rates = p.along(p.costate_rates if costate else p.rates, t.ravel(), case.horizon, case.optimum(t.ravel()))
    integral = np.einsum("kj,kjn->kn", w, rates.reshape(*t.shape, -1))
    edge = 1e-13 * case.horizon  # stay on the piece's side of a jump
    a, b = np.array(segments(case)).T
    values = []
    for times in (a + edge, b - edge):
        point = case.optimum(times)
        values.append(stack(point.costate if costate else point.state, p.states, times.size))
    return np.asarray((values[1] - values[0] - integral) / max(1.0, np.abs(values[0]).max()))


@every_case
def test_states_follow_the_dynamics(case: Case) -> None:
    assert np.abs(change_against_integral(case, costate=False)).max() < TOLERANCE


@every_case
def test_costates_follow_their_equation(case: Case) -> None:
    assert np.abs(change_against_integral(case, costate=True)).max() < TOLERANCE


@every_case
def test_states_are_continuous_and_costates_jump_only_where_stated(case: Case) -> None:
    p = principle(case)
    for switch in case.switches:
        sides = case.optimum(switch.time + np.array([-1e-11, 1e-11]) * case.horizon)
        assert np.abs(np.diff(stack(sides.state, p.states, 2), axis=0)).max() < TOLERANCE
        assert np.abs(np.diff(stack(sides.costate, p.states, 2), axis=0)).max() < TOLERANCE
    for jump in case.jumps:
        sides = case.optimum(jump + np.array([-1e-11, 1e-11]) * case.horizon)
        change = np.diff(stack(sides.costate, p.states, 2), axis=0)
        assert change.max() < TOLERANCE  # the bound is an upper one: its multiplier is positive
        assert change.min() < -1.0


@every_case
def test_no_admissible_control_has_a_smaller_hamiltonian(case: Case) -> None:
    p = principle(case)
    rng = np.random.default_rng(0)
    t = inner_points(case)[0].ravel()
    point = case.optimum(t)
    best = p.along(p.hamiltonian, t, case.horizon, point)
    u = stack(point.control, p.controls, t.size)
    lower, upper = p.control_bounds()
    spread = np.abs(u).max(axis=0) + 1
    low, high = np.maximum(lower, u.min(axis=0) - spread), np.minimum(upper, u.max(axis=0) + spread)
    assert (u >= lower - TOLERANCE).all()
    assert (u <= upper + TOLERANCE).all()
    sizes = [v.size for v in p.problem.declared.controls.values()]
    for _ in range(50):
        other = rng.uniform(low, high, u.shape)
        other[:, p.algebraic] = u[:, p.algebraic]
        columns = np.split(other, np.cumsum(sizes)[:-1], axis=1)
        tried = Extremal(point.state, dict(zip(p.controls, columns, strict=True)), point.costate)
        assert (p.along(p.hamiltonian, t, case.horizon, tried) - best).min() > -TOLERANCE


@every_case
def test_ends_are_met_and_free_ends_are_transversal(case: Case) -> None:
    p = principle(case)
    t = np.array([0.0, case.horizon])
    point = case.optimum(t)
    x, costate = stack(point.state, p.states, 2), stack(point.costate, p.states, 2)
    initial, terminal = p.ends()
    np.testing.assert_allclose(x[0], initial, atol=TOLERANCE)
    fixed = ~np.isnan(terminal)
    np.testing.assert_allclose(x[1, fixed], terminal[fixed], atol=TOLERANCE)
    gradient = p.along(p.terminal_by_state, t, case.horizon, point)[1]
    np.testing.assert_allclose(costate[1, ~fixed], gradient[~fixed], atol=TOLERANCE)


@every_case
def test_hamiltonian_is_constant_and_balances_a_free_horizon(case: Case) -> None:
    p = principle(case)
    t = inner_points(case)[0].ravel()
    hamiltonian = p.along(p.hamiltonian, t, case.horizon, case.optimum(t)).ravel()
    horizon = p.problem.declared.horizon
    assert horizon is not None
    if p.autonomous:
        assert np.ptp(hamiltonian) < TOLERANCE * max(1.0, np.abs(hamiltonian).max())
    if not horizon.fixed:
        end = np.array([case.horizon])
        by_horizon = p.along(p.terminal_by_horizon, end, case.horizon, case.optimum(end))
        assert abs(hamiltonian[-1] + by_horizon.item()) < TOLERANCE


@every_case
def test_cost_is_the_integral_along_the_optimum(case: Case) -> None:
    p = principle(case)
    t, w = inner_points(case)
    running = p.along(p.running, t.ravel(), case.horizon, case.optimum(t.ravel())).reshape(t.shape)
    end = np.array([case.horizon])
    terminal = p.along(p.terminal_cost, end, case.horizon, case.optimum(end)).item()
    assert abs(np.sum(w * running) + terminal - case.cost) < 1e-9 * max(1.0, abs(case.cost))


@every_case
def test_switching_functions_vanish_at_the_switches(case: Case) -> None:
    p = principle(case)
    for switch in case.switches:
        t = switch.time + np.array([-1e-6, 0.0, 1e-6]) * case.horizon
        point = case.optimum(t)
        if switch.function is not None:
            before, here, after = switch.function(point.state, point.costate)
            assert abs(here) < TOLERANCE
            assert before * after < 0
        else:  # a singular arc begins or ends: the switching function is zero on one side of the switch
            bounds = p.control_bounds()
            middle = Extremal(
                point.state,
                {n: np.full(3, np.mean(b)) for n, b in zip(p.controls, zip(*bounds, strict=True), strict=True)},
                point.costate,
            )
            slope = p.along(p.hamiltonian, t, case.horizon, middle) - p.along(p.hamiltonian, t, case.horizon, point)
            assert abs(slope[1]) < TOLERANCE
