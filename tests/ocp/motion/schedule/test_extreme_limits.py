"""Limits and periods of which nothing can be computed are refused by name; large and small ones are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models import Path, Scara, scara_along, smooth
from ocp import ProblemError
from ocp.motion.schedule import JointLimits, LineLimits, joint_trajectory, schedule

ALONG = scara_along(Scara(0.8, 0.8), smooth(Path.through([(0.3, 0.3, 0), (0.9, 0.3, 0), (0.9, 0.6, 0)]), 0.05))
JOINTS: list[Any] = [3.0, 15.0, 100.0]


@pytest.mark.parametrize("value", [1e-308, 1e-100, 1e100, 1e308])
@pytest.mark.parametrize("which", range(3))
def test_limits_of_no_size_to_compute_with_are_refused_by_name(which: int, value: float) -> None:
    of_joints, of_line = [*JOINTS], [0.5, 1.0, 10.0]
    of_joints[which] = of_line[which] = value
    for kind, values in ((JointLimits, of_joints), (LineLimits, of_line)):
        with pytest.raises(ProblemError, match="check its unit") as caught:
            kind(*values)
        assert caught.value.value == value


@pytest.mark.parametrize("value", [1e-3, 1e9])
@pytest.mark.parametrize("which", range(3))
def test_a_limit_of_another_size_is_computed_with(which: int, value: float) -> None:
    of_joints = [*JOINTS]
    of_joints[which] *= value
    timed = schedule(ALONG.path, LineLimits(0.5, 1.0, 10.0, 1.0, JointLimits(*of_joints)), joints=ALONG)
    assert np.isfinite(timed.duration)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_far_from_one_are_computed_with(unit: float) -> None:
    known = schedule(ALONG.path, LineLimits(0.5, 1.0, 10.0)).duration
    slow = schedule(ALONG.path, LineLimits(0.5 * unit, unit**2, 10.0 * unit**3)).duration
    assert slow == pytest.approx(known / unit, rel=1e-6)


@pytest.mark.parametrize("period", [1e-308, 1e-12])
def test_a_period_of_more_samples_than_fit_is_refused(period: float) -> None:
    plan = schedule(ALONG.path, LineLimits(0.5, 1.0, 10.0))
    for call in (lambda: plan.sample(period), lambda: joint_trajectory(plan, ALONG, period)):
        with pytest.raises(ProblemError, match="samples") as caught:
            call()
        assert caught.value.name == "period"
