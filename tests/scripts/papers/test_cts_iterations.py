"""The paper's Newton and null-space iterations: what they reach, where they fail, and why."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import ModelError, optimal_inverse, reference_rig, reference_tunnel
from models.cts.rig import HOME, INCH, forward, inverse
from scripts.papers.cts.iterations import Run, combined, newton_step, null_space, null_space_step
from scripts.papers.cts.results import sweep_targets
from tests.models.cts.cts_oracle import Array, random_targets

RIG, TUNNEL = reference_rig(), reference_tunnel()


def start() -> Array:
    first = [100 * INCH, 6 * INCH, -15 * INCH, 0, 0]
    return np.array(inverse(RIG, ca.DM(first), ca.DM(0), HOME)[0]).ravel()


def jacobian_run(rate_weight: float, gain: float) -> Run:
    return null_space(RIG, TUNNEL, sweep_targets(), start(), rate_weight=rate_weight, gain=gain)


def test_newton_takes_three_iterations_on_the_sweep_and_agrees_with_the_global_optimum() -> None:
    run = combined(RIG, TUNNEL, sweep_targets())
    assert run.converged.all()
    assert run.iterations.mean() == pytest.approx(3.0, abs=0.05)
    assert run.iterations.max() == 4
    best = np.array(optimal_inverse(RIG, TUNNEL).map(200)(sweep_targets().T, np.zeros((1, 200)))[0]).T
    np.testing.assert_allclose(run.joints, best, atol=1e-6)


def test_null_space_with_gain_1_hardly_converges_on_i1() -> None:
    run = jacobian_run(0.0, 1.0)
    assert run.iterations.mean() == pytest.approx(98.7, abs=1.0)
    assert run.converged.sum() < 30


def test_null_space_with_gain_20_converges_on_i1_in_about_twelve() -> None:
    run = jacobian_run(0.0, 20.0)
    assert run.converged.all()
    assert run.iterations.mean() == pytest.approx(11.9, abs=1.0)
    np.testing.assert_allclose(run.joints, combined(RIG, TUNNEL, sweep_targets()).joints, atol=1e-5)


def test_null_space_with_gain_20_diverges_on_i2_and_newton_is_smooth() -> None:
    run = jacobian_run(5.0, 20.0)
    assert run.converged.sum() == 0
    assert jacobian_run(5.0, 1.0).converged.all()
    smooth = combined(RIG, TUNNEL, sweep_targets(), rate_weight=5.0)
    assert smooth.converged.all()
    assert smooth.iterations.mean() == pytest.approx(2.74, abs=0.02)
    assert np.abs(np.diff(smooth.joints[:, 5])).max() < 0.05


@cache
def step_of(rate_weight: float, gain: float) -> Any:
    return null_space_step(RIG, TUNNEL, rate_weight, gain=gain)


@cache
def derivative_of_step(rate_weight: float, gain: float) -> Any:
    return step_of(rate_weight, gain).jacobian()


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 5.0]))
def test_null_space_is_stable_up_to_its_bound_and_not_beyond(seed: int, rate_weight: float) -> None:
    """gain n6^2 I'' < 2: just below, a small disturbance of the optimum shrinks; just above, it grows."""
    rng = np.random.default_rng(seed)
    target = np.array([2.54, rng.uniform(-0.1, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), 0.1])
    joints, _, active, status = optimal_inverse(RIG, TUNNEL)(target, 0.0)
    if int(status) or int(active):
        return
    q = np.array(joints).ravel()
    stiffness = float(step_of(rate_weight, 1)(target, q, q[5])[1])
    at_1, at_2 = (np.array(derivative_of_step(rate_weight, g)(target, q, q[5], ca.DM(6, 1), 0)[1]) for g in (1, 2))
    for factor, grows in ((0.9, False), (1.1, True)):
        derivative = at_1 + (factor * 2 / stiffness - 1) * (at_2 - at_1)  # the step is affine in the gain
        assert (np.abs(np.linalg.eigvals(derivative)).max() > 1) == grows


def test_newton_often_ends_in_a_maximum() -> None:
    rng = np.random.default_rng(43)
    count = 4000
    targets = random_targets(rng, count)
    step = newton_step(RIG, TUNNEL).map(count)
    roll = np.zeros((1, count))
    for _ in range(100):
        roll = np.array(step(targets, roll, roll)[0])
    _, slope, bend = (np.array(part)[0] for part in step(targets, roll, roll))
    settled = np.abs(slope) < 1e-9
    assert settled.mean() > 0.99
    assert 0.5 < np.mean(bend[settled] < 0) < 0.7


def test_newton_never_leaves_the_symmetric_start() -> None:
    targets = sweep_targets()
    targets[:, 1] = 0.0  # P_C's y: psi = theta = 0 make roll 0 stationary
    run = combined(RIG, TUNNEL, targets)
    assert (run.iterations == 1).all()
    np.testing.assert_allclose(run.joints[:, 5], 0.0, atol=1e-12)
    best = np.array(optimal_inverse(RIG, TUNNEL).map(200)(targets.T, np.zeros((1, 200)))[0])[5]
    assert np.abs(best).max() > 1


def test_tables_3_and_4_as_printed_stop_before_they_converge() -> None:
    """They loop while the step is small; one pass from roll 0 is far from the optimum."""
    target = sweep_targets()[100]
    first = float(newton_step(RIG, TUNNEL)(target, 0.0, 0.0)[0])
    last = float(optimal_inverse(RIG, TUNNEL)(target, 0.0)[0][5])
    assert abs(first) > 1e-6  # so the printed condition is false at once
    assert abs(first - last) > 0.1


def test_null_space_uses_the_least_joint_motion_and_reaches_the_target() -> None:
    target, q = sweep_targets()[3], start()
    step = null_space_step(RIG, TUNNEL, gain=20.0)
    for _ in range(60):
        q = np.array(step(target, q, 0.0)[0]).ravel()
    np.testing.assert_allclose(np.array(forward(RIG, ca.DM(q))).ravel()[:5], target, atol=1e-9)


@pytest.mark.parametrize("bad", [{"gain": 0.0}, {"gain": np.nan}, {"unit": -1.0}, {"rate_weight": np.inf}])
def test_a_bad_option_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(ModelError, match=next(iter(bad))):
        null_space_step(RIG, TUNNEL, **bad)


def test_bad_targets_are_named_by_row() -> None:
    rows = sweep_targets()
    rows[7, 1] = np.nan
    with pytest.raises(ModelError, match="row 7"):
        combined(RIG, TUNNEL, rows)
    with pytest.raises(ModelError, match=r"\(samples, 5\), 1 at least"):
        null_space(RIG, TUNNEL, [], start())
