"""A sample of the random edits, and what decides whether they matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.sweep.frauds import PLANS, edited, measured, subject, tried

pytestmark = pytest.mark.xdist_group("random frauds")  # one process, so that every plan is solved once


@pytest.mark.parametrize("seed", [100, 101, 102])
@pytest.mark.parametrize("kind", list(PLANS))
def test_no_edit_that_matters_passes(kind: str, seed: int) -> None:
    assert not (result := tried(kind, seed))["wrong"], result


@pytest.mark.parametrize("kind", [kind for kind, (_, _, others) in PLANS.items() if others and kind != "cart-pole"])
@pytest.mark.parametrize("seed", range(4))
def test_no_plan_of_narrower_bounds_passes_as_one_of_wider_ones(kind: str, seed: int) -> None:
    """With their tightening told or not, and with their multipliers or none."""
    options = subject(kind)
    plan = edited(options, "tightened", np.random.default_rng(seed), 0.1)
    assert measured(options, plan) > 1.0
    assert not plan.audit().passed
    assert not replace(plan, bound_tightening=None).audit().passed


@pytest.mark.parametrize("kind", list(PLANS))
def test_the_measure_distinguishes_edited_from_original_text(kind: str) -> None:
    """Much less than a thousandth of the plan itself, and what larger edits are off by."""
    options, rng = subject(kind), np.random.default_rng(0)
    assert measured(options, options.plan) < 0.2
    assert measured(options, edited(options, "cost", rng, 0.01)) == pytest.approx(10, rel=0.2)
    assert measured(options, edited(options, "bulged", rng, 0.05)) > 1.0
    assert measured(options, edited(options, "horizon", rng, 0.01)) > 1.0
