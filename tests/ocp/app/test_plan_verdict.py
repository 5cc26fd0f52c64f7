"""The verdict on plans whose rates jump: judged between the jumps, by the limits of their machine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models import FixedBase
from ocp.app.check.verdict import verdict_of
from ocp.app.view.animation import animate_plan
from ocp.app.view.report import report_of_plan
from ocp.motion.result.segmented_plan import SegmentedPlan
from tests.ocp.motion.plan.test_path_plan import path
from tests.ocp.motion.plan.test_segmented_plan import segmented_plan

pytestmark = pytest.mark.xdist_group("segmented plan")

PERIODS = (0.003, 0.01, 0.07)


def limited(machine: Any, **limits: float) -> FixedBase:
    """The machine with other limits of all its joints."""
    joints = tuple(replace(joint, **limits) if joint.moves else joint for joint in machine.robot.joints)
    return FixedBase(replace(machine.robot, joints=joints), machine.translation, machine.rotation)


def with_machine(plan: SegmentedPlan, machine: FixedBase) -> SegmentedPlan:
    """The same motions of another machine."""
    (change,) = plan.reconfigurations
    assert change.motion is not None
    changes = (replace(change, motion=replace(change.motion, machine=machine)),)
    segments = tuple(replace(segment, machine=machine) for segment in plan.segments)
    return replace(plan, machine=machine, segments=segments, reconfigurations=changes)


@pytest.mark.parametrize("period", PERIODS)
def test_rates_that_jump_at_their_limit_between_motions_are_no_fault(period: float) -> None:
    rates = segmented_plan().at(segmented_plan().segments[0].horizon + np.array([-1e-6, 1e-6]))["rates"]
    assert np.abs(np.diff(rates, axis=0)).max() > 1.0
    verdict = verdict_of(segmented_plan(), segmented_plan().sample(period), "line")
    assert verdict.passed, verdict.sentence
    assert verdict.sentence == segmented_plan().audit().sentence
    fastest = next(row for row in verdict.check.rows if row.name == "velocity of joint1")
    assert abs(fastest.value) == pytest.approx(3.0, rel=1e-3)
    assert verdict.check.duration == pytest.approx(segmented_plan().horizon)


def test_each_motion_is_held_against_the_limits_of_its_machine() -> None:
    slow = verdict_of(
        with_machine(segmented_plan(), limited(segmented_plan().machine, velocity=2.5)),
        segmented_plan().sample(0.01),
        "line",
    )
    assert not slow.passed
    change = segmented_plan().reconfigurations[0]
    assert {fault.kind for fault in slow.check.faults} == {"velocity"}
    times = [fault.time for fault in slow.check.faults if fault.time is not None]
    assert times
    assert all(change.time <= time <= change.time + change.duration for time in times)
    narrow = verdict_of(
        with_machine(segmented_plan(), limited(segmented_plan().machine, upper=1.6)),
        segmented_plan().sample(0.01),
        "line",
    )
    assert {fault.kind for fault in narrow.check.faults} == {"position"}
    assert min(fault.time or 0.0 for fault in narrow.check.faults) > change.time


@pytest.mark.parametrize("period", PERIODS)
def test_a_path_passes_at_its_velocity_limits_and_not_beyond(period: float) -> None:
    result = path()
    verdict = verdict_of(result, result.sample(period), "path")
    assert verdict.check.passed, verdict.sentence
    assert verdict.sentence == result.audit().sentence
    slow = replace(result, machine=limited(result.machine, velocity=1.0), constraints=None)
    timed = replace(slow, limits=replace(slow.limits, velocity=3.0))
    assert {fault.kind for fault in verdict_of(timed, timed.sample(period), "path").check.faults} == {"velocity"}
    assert verdict_of(slow, slow.sample(period), "path").check.passed


@pytest.mark.long
@pytest.mark.parametrize("plan", [segmented_plan, path], ids=["segments", "path"])
def test_it_is_reported_and_shown_with_that_verdict(plan: Any) -> None:
    report, shown = report_of_plan(plan(), 0.01, "a motion"), animate_plan(plan())
    for verdict in (report.verdict, shown.verdict):
        assert verdict == f"The plan {plan().audit().sentence}."
    assert report.passed == shown.passed == plan().audit().passed
    np.testing.assert_allclose(shown.joints, plan().at(shown.t)["joints"], atol=1e-12)
