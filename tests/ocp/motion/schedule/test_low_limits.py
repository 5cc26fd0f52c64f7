"""A slow enough motion keeps any limits of velocity, acceleration and jerk: low ones take time, and are not refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp.motion.schedule import JointLimits, JointPath, LineLimits, PathLike, Schedule, schedule
from scripts.timing.schedules import JOINTS, panda_path, random_arm
from tests.models.paths.task_paths import seeds
from tests.ocp.motion.schedule.check import largest

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
KINDS = ("velocity", "acceleration", "jerk")
"""Derivatives by the time, in order."""


def times(limits: JointLimits, slower: dict[str, float]) -> JointLimits:
    """Limits of which each kind named is that of a motion that many times as slow."""
    return replace(
        limits,
        **{kind: np.asarray(getattr(limits, kind)) * slower[kind] ** -(KINDS.index(kind) + 1) for kind in slower},
    )


def planned(path: PathLike, limits: LineLimits, joints: JointPath) -> Schedule:
    """A schedule that keeps its limits."""
    plan = schedule(path, limits, joints=joints)
    demand = largest(plan, joints)
    assert demand.max() <= 1.001
    assert demand.max() >= 0.99
    return plan


@settings(max_examples=6)
@given(seeds, st.floats(-3, 3))
def test_a_motion_a_thousand_times_slower_or_faster_has_the_limits_that_it_would_have(seed: int, x: float) -> None:
    slower = 10.0**x
    path, joints, limits = random_arm(seed)
    assert limits.joints is not None
    plan = planned(path, limits, joints)
    other = LineLimits(
        np.asarray(limits.speed) / slower,
        limits.acceleration / slower**2,
        limits.jerk / slower**3,
        joints=times(limits.joints, dict.fromkeys(KINDS, slower)),
    )
    assert planned(path, other, joints).duration == pytest.approx(slower * plan.duration, rel=1e-4)


@pytest.mark.long
@settings(max_examples=12)
@given(seeds, st.sets(st.sampled_from(KINDS), min_size=1), st.floats(0, 3))
def test_low_limits_of_some_kinds_take_no_longer_than_low_limits_of_all(seed: int, kinds: set[str], x: float) -> None:
    slower = 10.0**x
    path, joints, limits = random_arm(seed)
    assert limits.joints is not None
    plan = planned(path, limits, joints)
    some = planned(path, replace(limits, joints=times(limits.joints, dict.fromkeys(kinds, slower))), joints)
    assert plan.duration * (1 - 3e-3) <= some.duration <= slower * plan.duration * (1 + 3e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_panda_is_as_slow_as_a_thousandth_of_one_kind_of_limits_makes_it(kind: str) -> None:
    """Where one kind binds alone, its hundredth takes ten times as long for acceleration, and so on."""
    path, joints = panda_path(10)
    base = replace(JOINTS, torque=np.inf)
    order = KINDS.index(kind) + 1
    durations = [
        planned(path, LineLimits(0.5, 5.0, 200.0, joints=times(base, {kind: share ** (1 / order)})), joints).duration
        for share in (1e2, 1e3)
    ]
    assert durations[1] / durations[0] == pytest.approx(10 ** (1 / order), rel=0.02)
