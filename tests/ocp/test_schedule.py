"""The line-speed schedule of the example of Lee, Ryu, Cheong 2006."""

from __future__ import annotations

import numpy as np
import pytest

from ocp import ProblemError
from ocp.schedule import Limits, peak_acceleration, schedule
from tests.models.test_paths import example


def test_the_example_takes_the_time_checked_with_mean_acceleration() -> None:
    path = example("cubic")
    limits = Limits(speed=1.0, acceleration=peak_acceleration(5.0, 1.0, 200.0), jerk=200.0)
    plan = schedule(path, limits)
    assert plan.duration == pytest.approx(1.868825, abs=1e-6)
    events = np.cumsum(np.asarray(path.piece_lengths))[:4]
    assert plan.time_at(events) == pytest.approx([0.3500, 0.6203, 0.9722, 1.2419], abs=1e-4)
    assert not plan.dips


def test_centripetal_acceleration_slows_the_blends_only() -> None:
    path = example("quintic")
    plan = schedule(path, Limits(speed=1.0, acceleration=5.0, jerk=200.0, centripetal=5.0))
    motion = plan.sample(1e-3)
    assert np.max(motion.speed**2 * path.curvature(motion.distance)) < 5.0 * 1.001
    assert np.max(motion.speed) == pytest.approx(1.0, abs=1e-6)
    assert plan.dips


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan")])
def test_a_speed_or_jerk_that_is_not_positive_is_a_named_error(bad: float) -> None:
    with pytest.raises(ProblemError, match="speed"):
        Limits(speed=bad, acceleration=5.0, jerk=200.0)
    with pytest.raises(ProblemError, match="jerk"):
        Limits(speed=1.0, acceleration=5.0, jerk=bad)
