"""Closed control loops in MuJoCo: no limit is exceeded in 10 000 steps, and the same seed gives the same numbers."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from scripts.robots import catch, follow

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("loops")]


@pytest.mark.parametrize("script", [follow, catch], ids=["follow", "catch"])
def test_no_limit_is_exceeded_in_ten_thousand_steps(script: ModuleType) -> None:
    loop = script.run(10_000)
    assert len(loop.places) == 10_000
    assert loop.violations == 0
    assert np.all(np.isfinite(loop.places))
    assert not any(loop.held)
    if script is catch:
        assert all(loop.captures)
        assert len(loop.captures) > 100
    else:
        assert np.median(loop.distances) < 0.06  # m, behind a target that moves at 0.3 m/s and jumps


@pytest.mark.parametrize("script", [follow, catch], ids=["follow", "catch"])
def test_a_seed_determines_the_loop(script: ModuleType) -> None:
    one, again, other = script.run(150), script.run(150), script.run(150, seed=1)
    np.testing.assert_array_equal(one.joints, again.joints)
    np.testing.assert_array_equal(one.violation, again.violation)
    assert np.abs(np.array(one.joints) - other.joints).max() > 1e-3
