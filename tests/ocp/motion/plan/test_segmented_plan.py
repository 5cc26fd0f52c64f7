"""Plans in segments as one plan: its pieces at their times, audited one by one and where they meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ocp import Plan, ProblemError
from ocp.audit.audit import COST_LOST
from ocp.motion.result.segmented_plan import SegmentedPlan
from tests.models.robot.trees import Array
from tests.ocp.motion.plan.test_segments import SECONDS, arm, in_segments, line

pytestmark = pytest.mark.xdist_group("segmented plan")  # one process, so that it is planned once

REACH = 0.45


@cache
def segmented_plan() -> SegmentedPlan:
    """Two segments, and a motion between them."""
    return in_segments(arm(), line(REACH), scene=False)


@cache
def arrays() -> dict[str, Array]:
    return segmented_plan().arrays("line.npz")


def without_motion() -> SegmentedPlan:
    change = replace(segmented_plan().reconfigurations[0], motion=None, failure="the way is barred")
    return replace(segmented_plan(), reconfigurations=(change,), _audits={})


# ---- values ----------------------------------------------------------------------------------------------------------


def test_at_any_time_the_plan_is_the_segment_of_that_time() -> None:
    first, last = segmented_plan().segments
    motion = segmented_plan().reconfigurations[0].motion
    assert motion is not None
    times = np.random.default_rng(0).uniform(0.0, segmented_plan().horizon, 200)
    at, sample = segmented_plan().at(times), segmented_plan().sampled(times)
    begins = np.cumsum([0.0, first.horizon, motion.horizon])
    for begin, segment in zip(begins, (first, motion, last), strict=True):
        own = (times > begin) & (times < begin + segment.horizon)
        assert own.any()
        expected = segment.sampled(times[own] - begin)
        np.testing.assert_allclose(at["joints"][own], expected.joints, atol=1e-12)
        np.testing.assert_allclose(at["rates"][own], expected.rates, atol=1e-12)
        np.testing.assert_allclose(sample.accelerations[own], expected.accelerations, atol=1e-9)
        np.testing.assert_allclose(sample.tip[own], expected.tip, atol=1e-12)
    assert segmented_plan().horizon == first.horizon + motion.horizon + last.horizon
    assert segmented_plan().task_horizon == first.horizon + last.horizon == pytest.approx(SECONDS)
    assert segmented_plan().cost == first.cost + last.cost
    np.testing.assert_array_equal(segmented_plan().at(segmented_plan().t[0])["joints"], segmented_plan()["joints"][0])


def test_joints_are_continuous_and_the_ends_belong_to_it() -> None:
    times = np.linspace(0.0, segmented_plan().horizon, 4001)
    joints = segmented_plan().at(times)["joints"]
    assert np.abs(np.diff(joints, axis=0)).max() <= 3.0 * (times[1] - times[0]) * (1 + 1e-6)
    np.testing.assert_array_equal(joints[-1], segmented_plan().segments[-1]["joints"][-1])
    for wrong in (-1e-3, segmented_plan().horizon + 1e-3, np.nan):
        with pytest.raises(ProblemError):
            segmented_plan().at(wrong)


def test_the_tip_is_where_the_share_of_the_task_says_and_the_task_waits_meanwhile() -> None:
    change = segmented_plan().reconfigurations[0]
    times = np.linspace(0.0, segmented_plan().horizon, 1001)
    share = segmented_plan().task_share(times)
    waiting = (times >= change.time) & (times <= change.time + change.duration)
    np.testing.assert_allclose(share[waiting], change.time / SECONDS, atol=1e-9)
    assert (np.diff(share)[~(waiting[1:] & waiting[:-1])] > 0).all()
    assert (share[0], share[-1]) == (0.0, 1.0)
    tips = segmented_plan().sampled(times).tip[~waiting]
    np.testing.assert_allclose(tips[:, 0], 0.6, atol=1e-6)
    np.testing.assert_allclose(tips[:, 1], REACH * (2 * share[~waiting] - 1), atol=1e-6)
    for target in segmented_plan().targets:
        at = segmented_plan().sampled(np.clip(target.t, 0.0, segmented_plan().horizon - 1e-12))
        np.testing.assert_allclose(target.position[:-1, :2], at.tip[:-1, :2], atol=1e-6)


def test_the_solved_parts_are_those_of_the_segments() -> None:
    times = np.linspace(0.0, segmented_plan().horizon, 101)
    parts = segmented_plan().solved_parts(times)
    assert sum(len(local) for _, _, local in parts) == len(times)
    joints = np.concatenate([solution.at(local)["joints" + suffix] for solution, suffix, local in parts if len(local)])
    np.testing.assert_allclose(joints, segmented_plan().at(times)["joints"], atol=1e-9)


def test_the_gap_is_that_of_the_segments() -> None:
    first, last = segmented_plan().segments
    assert first.bound is not None
    assert last.bound is not None
    assert segmented_plan().bound == first.bound + last.bound
    assert segmented_plan().gap == pytest.approx(1 - (first.bound + last.bound) / segmented_plan().cost)
    assert replace(segmented_plan(), segments=(first, replace(last, bound=None))).gap is None


def test_of_several_segments_there_is_no_one_solution() -> None:
    with pytest.raises(ProblemError, match=r"plan\.pieces\[0\]\.plan\.solution"):
        _ = segmented_plan().solution
    assert len(segmented_plan().candidates) == sum(len(segment.candidates) for segment in segmented_plan().segments)


# ---- audit -----------------------------------------------------------------------------------------------------------


def test_the_audit_is_that_of_all_segments_at_their_times() -> None:
    audit = segmented_plan().audit()
    assert audit.passed
    for number, segment in enumerate(segmented_plan().pieces, 1):
        for finding in segment.plan.audit().findings:
            own = audit[f"motion {number}: {finding.name}"]
            assert (own.value, own.limit, own.unit, own.verdict) == (
                finding.value,
                finding.limit,
                finding.unit,
                finding.verdict,
            )
            assert (own.time is None) == (finding.time is None)
            if finding.time is not None and own.time is not None:
                assert own.time == segment.begin + finding.time
    lost = [
        (audit[f"motion {k}: {COST_LOST}"].value, segment.plan.cost)
        for k, segment in enumerate(segmented_plan().pieces, 1)
    ]
    assert audit[COST_LOST].value == pytest.approx(sum(a * b for a, b in lost) / sum(b for _, b in lost))
    assert "no better motion is near it" in audit.sentence


@pytest.mark.parametrize(
    ("segment", "number"),
    [("segment 0", 1), ("reconfiguration 0", 2), ("segment 1", 3)],
    ids=["first", "motion", "last"],
)
def test_a_changed_segment_fails_by_its_number(segment: str, number: int, tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        name: arrays()[name] + 0.01 for name in (f"{segment}/states/joints", f"{segment}/state_interpolant/values")
    }
    np.savez(tmp_path / "forged.npz", **{**arrays(), **changes})
    forged = Plan.load(tmp_path / "forged.npz").audit()
    assert not forged.feasible
    own = [finding.name for finding in forged.failures if finding.name.startswith("motion")]
    assert own
    assert all(name.startswith(f"motion {number}: ") for name in own)
    assert any(finding.name.startswith("joints between motions") for finding in forged.failures)


def test_discontinuous_segments_fail_by_the_jump() -> None:
    change, first = segmented_plan().reconfigurations[0], segmented_plan().segments[0]
    jumping = replace(segmented_plan(), reconfigurations=(replace(change, motion=first),), _audits={})
    (finding,) = jumping.audit().failures
    jumps = np.abs([first["joints"][0] - change.before, change.after - first["joints"][-1]])
    assert finding.name.startswith("joints between motions")
    assert finding.value == pytest.approx(jumps.max(), abs=1e-6)
    assert segmented_plan().audit()[finding.name.replace("joint1", "joint0")].value < 1e-6


def test_a_reconfiguration_without_a_motion_fails_with_its_reason() -> None:
    audit = without_motion().audit()
    assert audit.failures[0].name == "reconfigurations without a motion"
    assert audit.failures[0].note == "the way is barred"
    assert audit.sentence.startswith("must not be run: reconfigurations without a motion")
    assert without_motion().horizon == segmented_plan().task_horizon
    assert "the way is barred" in str(without_motion())


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plan", [segmented_plan, without_motion], ids=["whole", "without a motion"])
def test_it_is_read_as_it_was_written(plan: Callable[[], SegmentedPlan], tmp_path: Path) -> None:
    plan().save(tmp_path / "line.npz")
    again = Plan.load(tmp_path / "line.npz")
    assert isinstance(again, SegmentedPlan)
    assert str(again) == str(plan())
    assert repr(again) == repr(plan())
    assert len(repr(again)) < 250
    assert str(again.audit()) == str(plan().audit())
    for name in ("cost", "bound", "gap", "horizon", "task_horizon", "start_times", "fewest", "names"):
        assert getattr(again, name) == getattr(plan(), name)
    times = np.linspace(0.0, again.horizon, 101)
    for name in ("joints", "rates"):
        np.testing.assert_array_equal(again.at(times)[name], plan().at(times)[name])
        np.testing.assert_array_equal(again[name], plan()[name])
    again.write_csv(tmp_path / "line.csv", 0.05)
    rows = np.loadtxt(tmp_path / "line.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 1:3], again.at(rows[:, 0])["joints"])


@pytest.mark.parametrize("missing", ["segment 0/", "segment 1/plan", "reconfiguration 0/head", "segments.numbers"])
def test_a_file_without_a_part_is_refused(missing: str) -> None:
    with pytest.raises(ProblemError):
        SegmentedPlan.of_arrays("a.npz", {k: array for k, array in arrays().items() if not k.startswith(missing)})


def test_segments_of_another_order_are_refused() -> None:
    swapped = {"segment 0/": "segment 1/", "segment 1/": "segment 0/"}
    forged = {
        next((swapped[key] + name.removeprefix(key) for key in swapped if name.startswith(key)), name): array
        for name, array in arrays().items()
    }
    with pytest.raises(ProblemError, match="do not fit together"):
        SegmentedPlan.of_arrays("swapped.npz", forged)
