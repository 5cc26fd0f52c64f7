"""Paths of thousands of random short segments: what they take in memory grows as their number."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from models import Arc, Line, Path, SmoothPath, smooth
from models.paths import Segment
from ocp.motion.schedule import LineLimits, Schedule, schedule

DEVIATION = 5e-4
LIMITS = LineLimits(0.25, 5.0, 200.0, centripetal=5.0)


def segments(count: int) -> list[Segment]:
    """A random walk of lines and arcs, about 35 mm each."""
    rng = np.random.default_rng(7)
    chain: list[Segment] = []
    end = np.zeros(3)
    for _ in range(count):
        step, bulge = rng.normal(size=(2, 3)) * 0.02
        line = rng.random() < 0.8
        chain.append(Line(end, end + step) if line else Arc.through(end, end + step / 2 + bulge / 2, end + step))
        end = np.asarray(chain[-1].end)
    return chain


def planned(count: int) -> tuple[SmoothPath, Schedule]:
    path = smooth(Path(tuple(segments(count))), deviation=DEVIATION)
    return path, schedule(path, LIMITS)


def peak_memory(count: int) -> float:
    """Of blending, scheduling and sampling every millisecond, over the number of segments."""
    tracemalloc.start()
    try:
        path, plan = planned(count)
        path.at(plan.sample(1e-3).distance)
        return tracemalloc.get_traced_memory()[1] / count
    finally:
        tracemalloc.stop()


@pytest.mark.long
def test_memory_grows_as_the_number_of_segments() -> None:
    small, large = peak_memory(500), peak_memory(4000)
    assert large < 1.25 * small


@pytest.mark.long
def test_ten_thousand_segments_are_blended_and_scheduled_within_all_limits() -> None:
    path, plan = planned(10_000)
    assert len(path.remaining) == 9999
    motion = plan.sample(1e-3)
    assert motion.t[-1] == plan.duration
    place = path.at(motion.distance)
    used = motion.speed**2 * np.linalg.norm(place.curvature, axis=1) / LIMITS.centripetal
    assert used.max() <= 1.001
    assert motion.speed.max() <= 0.25 * (1 + 1e-9)
    assert np.abs(motion.acceleration).max() <= 5 * (1 + 1e-9)
    # samples a millisecond apart are as far apart as the speed says
    steps = np.linalg.norm(np.diff(place.position, axis=0), axis=1)
    assert (steps <= 0.25e-3 * (1 + 1e-9)).all()
    assert path.curvature_jumps().max() <= 1e-9 * np.linalg.norm(place.curvature, axis=1).max()
