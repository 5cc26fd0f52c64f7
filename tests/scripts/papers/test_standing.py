"""The standing paper's script: its numbers against known ones, its plans between their nodes, and its files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from models import STANDING_STARTS
from models.machines.standing import StandingMotion
from ocp import MultipleShooting, resolve_accelerations, solve
from ocp.motion.builders.standing.problem import motion_cost
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Pinned
from scripts import standing
from scripts.papers.standing import plans
from scripts.papers.standing.cases import HORIZON, LOCAL, fails, machine, table_task
from scripts.papers.standing.checks import ALLOWED, check, failures, region_excess
from scripts.papers.standing.drawing import arm_points
from scripts.papers.standing.plans import FINER, HELD, PLANS, Plan, fine_motion, plan_problem
from scripts.papers.standing.printed import printed_law
from scripts.papers.standing.results import Results
from scripts.papers.standing.tables import CAVEATS, sound
from tests.scripts.papers.script_run import Run, Summary, assert_committed_numbers, assert_whole_picture

PAPER = standing.PAPER
CONVERGING = (("table1", "optimal_range"), ("table2", "optimal_spring"), ("minimum_time", "in_foot"))
SAMPLE = {(plans, "CONVERGING"): CONVERGING}  # one of every task
pytestmark = [pytest.mark.xdist_group("standing"), pytest.mark.long]  # one process, so that the script runs once

PICTURES = (
    "fig04_zmp_index.png",
    "fig05_joint_limits.png",
    "fig06_all_layers.png",
    "fig07_motions.png",
    "fig09_spring.png",
    "fig10_no_zmp.png",
    "fig11_spring.png",
    "optimal_table1.png",
    "optimal_table2.png",
    "minimum_time.png",
    "minimum_time_motion.png",
    "convergence.png",
)
ANIMATIONS = ("motion.gif", "lift.gif")
TABLES = ("comparison.csv", "motions.csv", "checks.csv", "convergence.csv", "layers.csv", "stabiliser.csv")
COSTS = {
    ("table1", "optimal_range"): -0.7078,
    ("table1", "optimal_index_half"): -0.653,
    ("table1", "optimal_index_nine_tenths"): -0.379,
    ("table1", "optimal_pinned"): -0.1104,
    ("table1", "optimal_free"): -1.022,
    ("table2", "optimal_spring"): -2.316,
    ("table2", "optimal_spring_index_nine_tenths"): -2.235,
    ("table2", "optimal_spring_pinned"): -2.000,
}
"""By an implementation of its own, accelerations held over 80 intervals."""


def plans_of(run: Run[Results]) -> Iterator[tuple[str, str, Plan]]:
    for task, group in run.results.plans.items():
        for key, plan in group.items():
            yield task, key, plan


# ---- local laws


def test_the_pseudo_inverse_leaves_the_foot(summary: Summary) -> None:
    result = summary["table1"]["pseudo_inverse"]
    assert result["index_min"] == pytest.approx(-5.3, abs=0.05)
    assert (result["zmp_min_m"], result["zmp_max_m"]) == pytest.approx((-0.066, 0.250), abs=5e-4)
    assert result["reason"] == "tips"
    assert 0 < result["fails_s"] < 6.17  # before it falls in a contact simulation
    assert result["cost"] == pytest.approx(2.49, rel=0.01)


def test_an_index_of_one_is_no_success(summary: Summary) -> None:
    for form in ("augmented", "null_space"):
        result = summary["table1"][form]
        assert result["index_min"] == pytest.approx(1.0, abs=1e-9)
        assert result["reason"] == "lift_off"
        assert result["stopped_s"] == pytest.approx(1.13, abs=5e-3)
        assert result["diverges_s"] == pytest.approx(1.26, abs=5e-3)
        assert result["vertical_force_min_n"] < 0
        assert "lifts off at 1.131 s" in result["verdict"]


def test_the_two_forms_of_the_law_agree(summary: Summary) -> None:
    assert 0 <= max(summary["forms_difference"].values()) < 1e-9


def test_every_layer_over_a_pinned_point_falls(run: Run[Results]) -> None:
    rows = run.table("layers.csv")
    assert len(rows) > 12
    for row in rows:
        assert row["reason"] in ("lift_off", "divergence")
        assert 0 < float(row["time_s"]) < 2
        assert float(row["index_min"]) == pytest.approx(1.0, abs=1e-6)


def test_the_stabilised_law_stands_and_its_error_is_reported(run: Run[Results], summary: Summary) -> None:
    result = summary["table1"]["stabilised"]
    assert result["reason"] == "stands"
    assert result["index_min"] == pytest.approx(1.0, abs=1e-9)
    assert result["peak_joint_velocity_rad_s"] == pytest.approx(0.99, rel=0.05)
    assert result["vertical_force_min_n"] >= 589
    assert result["leaves_joint_limits_s"] == "never"
    rows = {row["quantity"]: row for row in run.table("comparison.csv") if row["motion"] == "stabilised"}
    assert float(rows["cost"]["difference"]) == pytest.approx(result["cost"] - 0.17, abs=1e-6)
    assert CAVEATS["stabilised"] in run.printed
    used = [row for row in run.table("stabiliser.csv") if row["used"] == "yes"]
    assert len(used) == 1
    assert (float(used[0]["poles_1_s"]), float(used[0]["p1_gain_1_s2"])) == (4.0, 0.0)
    assert float(used[0]["cost"]) == pytest.approx(result["cost"], rel=1e-5)


def test_the_stabilised_law_fails_against_the_spring(summary: Summary) -> None:
    assert summary["table2"]["stabilised_spring"]["reason"] == "lift_off"


def test_with_the_sign_as_printed_the_machine_does_not_fall_and_its_index_is_not_one(summary: Summary) -> None:
    result = summary["table1"]["as_printed"]
    assert result["reason"] == "joint_limit"
    assert result["reaches_s"] == pytest.approx(2 * np.pi)
    assert result["index_min"] == pytest.approx(0.84, abs=0.005)
    assert result["tip_error_m"] < 1e-9


def test_the_printed_law_with_the_right_sign_is_the_null_space_law() -> None:
    task, start, horizon = table_task(1), STANDING_STARTS[1], 0.8
    ours, gap = printed_law(machine(), task, start, horizon, sign=1.0)
    other = resolve_accelerations(machine(), task, horizon, start=start, law="null_space").motion
    assert gap < 1e-9
    np.testing.assert_allclose(ours.t, other.t, atol=1e-12)
    np.testing.assert_allclose(ours.joints, other.joints, atol=1e-9)
    np.testing.assert_allclose(ours.joint_accelerations, other.joint_accelerations, atol=1e-8)


def test_motions_are_judged_by_their_first_violation_of_ground_contact(run: Run[Results]) -> None:
    sound = run.results.local["table1"]["stabilised"].motion
    assert fails(sound)[0] == "stands"
    assert fails(sound)[1] == pytest.approx(HORIZON)

    def changed(**changes: tuple[int, float]) -> StandingMotion:
        arrays = {}
        for name, (k, value) in changes.items():
            arrays[name] = np.array(getattr(sound, name))
            arrays[name][k, ...] = value
        return replace(sound, **arrays)

    assert fails(changed(joint_excess=(10, 0.1))) == ("joint_limit", sound.t[10])
    assert fails(changed(joint_excess=(10, 0.1), foot_margin=(20, -0.01))) == ("tips", sound.t[20])
    assert fails(changed(foot_margin=(20, -0.01), ground_force=(30, -1.0))) == ("lift_off", sound.t[30])


# ---- plans


@pytest.mark.parametrize(("task", "key"), COSTS)
def test_optimal_costs_are_the_known_ones(task: str, key: str, summary: Summary) -> None:
    assert HELD[task] == 80
    result = summary[task][key]
    assert result["held"]["cost"] == pytest.approx(COSTS[task, key], rel=1e-3)
    assert result["cost"] == pytest.approx(COSTS[task, key], rel=0.01)
    assert result["cost"] <= result["held"]["cost"]


def test_minimum_times_are_the_known_ones_and_grow_with_the_restriction(summary: Summary) -> None:
    matches = [summary["minimum_time"][f"{key}_s"] for key in ("free", "in_foot", "index_nine_tenths")]
    held = [summary["minimum_time"][key]["held"]["reaches_s"] for key in ("free", "in_foot", "index_nine_tenths")]
    assert held == pytest.approx([0.457, 0.503, 0.539], rel=1e-3)
    assert matches == pytest.approx(held, rel=0.01)
    assert all(np.less(matches, held))
    assert matches == sorted(matches)


def test_a_stricter_rule_costs_more(summary: Summary) -> None:
    order = ("optimal_free", "optimal_range", "optimal_index_half", "optimal_index_nine_tenths", "optimal_pinned")
    costs = [summary["table1"][key]["cost"] for key in order]
    assert costs == sorted(costs)
    names = ("_free", "", "_index_nine_tenths", "_pinned")
    costs = [summary["table2"][f"optimal_spring{name}"]["cost"] for name in names]
    assert costs == sorted(costs)


def test_local_motions_that_get_to_the_end_cost_more_than_the_plan_of_their_rule(summary: Summary) -> None:
    one = summary["table1"]
    for key in ("pseudo_inverse", "damped", "as_printed"):
        assert one[key]["cost"] > one["optimal_free"]["cost"]
    assert one["stabilised"]["cost"] > one["optimal_pinned_points"]["cost"]


def test_the_zero_moment_point_of_the_plan_keeps_inside_the_foot(summary: Summary) -> None:
    result = summary["table1"]["optimal_range"]
    assert -0.081 < result["zmp_min_m"] < result["zmp_max_m"] < 0.181


def test_every_plan_that_is_drawn_holds_between_its_nodes(run: Run[Results], summary: Summary) -> None:
    assert run.status == 0
    rows = [row for row in run.table("checks.csv") if row["drawn"] == "yes"]
    assert len(rows) == 12
    assert {row["holds"] for row in rows} == {"yes"}
    for name, limit in ALLOWED.items():
        assert max(float(row[name]) for row in rows) <= limit
        assert summary["checks"]["worst_of_drawn_plans"][name] <= limit
    assert ALLOWED["zmp_excess_m"] == 1e-3
    assert ALLOWED["tip_error_m"] == 1e-5
    assert max(limit for name, limit in ALLOWED.items() if name not in ("zmp_excess_m", "tip_error_m")) == 1e-6


def test_the_audit_of_every_plan_that_is_drawn_finds_it_feasible_and_no_worse_than_an_optimum(
    run: Run[Results], summary: Summary
) -> None:
    text = (run.folder / "audit.txt").read_text(encoding="utf-8")
    for task, key, plan in plans_of(run):
        assert f"{task}, {key}:" in text
        audit = plan.audit
        if not plan.request.has_figure:
            assert plan.request.transcription == "held"
            assert "zero moment point" in {name for name, _, _ in failures(plan)}  # pinned, and held accelerations
            assert not audit.feasible
            continue
        assert audit.failures == ()
        assert audit.feasible
        assert audit.optimal is True or (audit.optimal is None and audit.undecided), (task, key)
        assert summary[task][key]["undecided"] == audit.undecided
        assert audit["cost lost, relative"].limit == 1e-3


def test_plans_are_checked_on_ten_times_their_grid_with_both_ends_of_every_interval(run: Run[Results]) -> None:
    for _, _, plan in plans_of(run):
        motion, n = plan.motion, plan.request.intervals
        assert motion.t.shape == (11 * n,)
        assert (np.diff(motion.t) > 0).all()
        assert (motion.t[0], motion.t[-1]) == (0.0, pytest.approx(plan.solution.horizon))
        if plan.request.transcription == "held":
            within = np.ptp(motion.joint_accelerations.reshape(n, 11, -1), axis=1)
            assert within.max() < 1e-9  # each interval shows its own control at both ends


def test_the_fine_grid_follows_intervals_that_are_not_equal() -> None:
    request = PLANS["table1"]["optimal_free"]
    method = MultipleShooting(12, control="held").with_nodes_at([0.1, 0.11])
    solution = solve(plan_problem(replace(request, transcription="held")), method)
    motion, at = fine_motion(request, solution)
    n = method.intervals
    times = motion.t.reshape(n, FINER + 1)
    np.testing.assert_allclose(times[:, 0], method.fractions[:-1] * HORIZON, atol=1e-6)
    np.testing.assert_allclose(times[:, -1], method.fractions[1:] * HORIZON, atol=1e-6)
    np.testing.assert_array_equal(at, motion.t)
    assert np.ptp(motion.joint_accelerations.reshape(n, FINER + 1, -1), axis=1).max() < 1e-9


def test_the_cost_of_a_plan_is_that_of_its_fine_motion(run: Run[Results]) -> None:
    for task, _, plan in plans_of(run):
        if task != "minimum_time":
            assert motion_cost(plan.motion) == pytest.approx(plan.solution.cost, abs=2e-4)


def test_checks_and_exit_status_find_a_plan_that_does_not_hold(run: Run[Results]) -> None:
    plan = run.results.plans["table1"]["optimal_range"]
    assert check("", plan)["holds"]
    motion = plan.motion
    bad = {
        "zmp_excess_m": replace(motion, foot_margin=motion.foot_margin - 2e-3),
        "joint_excess_rad": replace(motion, joint_excess=motion.joint_excess + 0.1),
        "velocity_excess_rad_s": replace(motion, joint_velocities=motion.joint_velocities * 7),
        "acceleration_excess_rad_s2": replace(motion, joint_accelerations=motion.joint_accelerations * 20),
        "vertical_force_missing_n": replace(motion, ground_force=motion.ground_force * 0.1),
    }
    for name, wrong in bad.items():
        row = check("", replace(plan, motion=wrong))
        assert row[name] > ALLOWED[name]
        assert not row["holds"]
    row = check("", replace(plan, tip_error=2e-5))
    assert not row["holds"]
    assert not sound(replace(run.results, checks=[{**row, "drawn": True}]))
    failed = replace(plan, audit=run.results.plans["table1"]["optimal_pinned"].audit)
    costlier = [replace(one, value=2e-3) if one.name == "cost lost, relative" else one for one in plan.audit.findings]
    assert sound(run.results)
    for other in (failed, replace(plan, audit=replace(plan.audit, findings=tuple(costlier)))):
        assert not sound(replace(run.results, plans={"table1": {"optimal_range": other}}))


def test_regions_of_the_zero_moment_point(run: Run[Results]) -> None:
    motion = run.results.plans["table1"]["optimal_free"].motion
    least = -float(motion.zero_moment_point[:, 1].min())
    assert region_excess(InFoot(0.02), motion) == pytest.approx(least - 0.08)
    assert region_excess(IndexAtLeast(0.75), motion) == pytest.approx(least - 0.05)
    assert region_excess(Pinned((0.0, -0.1)), motion) == pytest.approx(0.1, abs=0.02)
    assert region_excess(Anywhere(), motion) == 0.0
    with pytest.raises(TypeError, match="no region"):
        region_excess("foot", motion)  # type: ignore[arg-type]


def test_costs_converge_with_the_intervals(run: Run[Results]) -> None:
    rows = run.table("convergence.csv")
    names = {(row["task"], row["plan"]) for row in rows}
    assert names == set(CONVERGING)
    for task, plan in names:
        mine = [row for row in rows if (row["task"], row["plan"]) == (task, plan)]
        held = {int(row["intervals"]): float(row["difference"]) for row in mine if "held" in row["method"]}
        percent = {int(row["intervals"]): float(row["percent"]) for row in mine if "held" in row["method"]}
        if task == "minimum_time":
            linear = {int(row["intervals"]): float(row["difference"]) for row in mine if "linear" in row["method"]}
            assert held[25] > 2 * held[50] > 0
            assert held[50] > held[100] > linear[100] == 0
            assert linear[25] > 2 * linear[50] > 0
            assert all(linear[n] < held[n] for n in (50, 100))
            continue
        assert held[40] > 1.8 * held[80] > 3.2 * held[160] > 0
        assert abs(percent[80]) < 1
        points = {int(row["intervals"]): abs(float(row["percent"])) for row in mine if "points" in row["method"]}
        assert points[20] < 0.1
        assert points[10] > 10 * points[20]


# ---- files


def test_summary_holds_the_numbers_that_matter(summary: Summary) -> None:
    for path in (
        "table1.pseudo_inverse.index_min",
        "table1.augmented.index_min",
        "table1.augmented.stopped_s",
        "table1.stabilised.peak_joint_velocity_rad_s",
        "table1.optimal_range.cost",
        "table1.optimal_range.zmp_min_m",
        "table1.optimal_range.zmp_max_m",
        "table1.optimal_pinned.cost",
        "table2.optimal_spring.cost",
        "minimum_time.free_s",
        "minimum_time.in_foot_s",
    ):
        value: Any = summary
        for name in path.split("."):
            value = value[name]
        assert type(value) is float, path
        assert math.isfinite(value)
    assert summary["table1"]["augmented"]["reason"] == "lift_off"
    assert {task: set(group) for task, group in LOCAL.items()} == {
        task: {key for key in summary[task] if key in LOCAL[task]} for task in LOCAL
    }
    for task, group in PLANS.items():
        assert set(group) <= set(summary[task])


def test_tables_are_written_and_the_differences_are_theirs(run: Run[Results], summary: Summary) -> None:
    for name in TABLES:
        assert run.table(name)
    for row in run.table("comparison.csv"):
        ours, known = float(row["ours"]), float(row["known"])
        assert float(row["difference"]) == pytest.approx(ours - known, abs=1e-6 * abs(ours))
        assert row["source"] in ("paper", "reference", "reference, held")
        if row["quantity"] != "time_s":
            mine = summary[row["task"]][row["motion"]]
            report = (mine["held"] if "held" in row["source"] else mine)[row["quantity"]]
            assert float(row["ours"]) == pytest.approx(report, rel=1e-6, abs=1e-9)
    motions = run.table("motions.csv")
    assert len(motions) == sum(map(len, LOCAL.values())) + sum(map(len, PLANS.values()))


def test_assumptions_are_printed_and_written(run: Run[Results], summary: Summary) -> None:
    for words in summary["assumptions"]:
        assert words in run.printed
    for words in summary["caveats"].values():
        assert words in run.printed
    assert "slender rods" in summary["assumptions"][0]


def test_the_drawn_arm_ends_at_the_tip_and_has_the_lengths_of_its_links(run: Run[Results]) -> None:
    motion = run.results.plans["minimum_time"]["in_foot"].motion
    for k in range(0, len(motion.t), 100):
        arm = arm_points(motion.joints[k])
        assert arm[0] == pytest.approx([0.0, 0.0], abs=1e-12)
        assert arm[-1] == pytest.approx(motion.tip_in_world[k, 1:], abs=1e-12)
        assert np.linalg.norm(np.diff(arm, axis=0), axis=1) == pytest.approx([0.44, 0.44, 0.52, 0.26, 0.18])


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_drawn_to_their_edges_and_not_beyond(run: Run[Results], name: str) -> None:
    assert_whole_picture(run.folder / name)


@pytest.mark.parametrize(("name", "frames", "seconds"), [("motion.gif", 64, 7.4), ("lift.gif", 55, 6.5)])
def test_animations_show_the_whole_motion_and_mark_where_it_fails(
    run: Run[Results], name: str, frames: int, seconds: float
) -> None:
    assert (run.folder / name).stat().st_size < 1.5e6
    with Image.open(run.folder / name) as animation:
        assert getattr(animation, "n_frames", 1) == frames
        lasting, orange = 0.0, []
        for k in range(frames):
            animation.seek(k)
            lasting += animation.info["duration"] / 1000
            pixels = np.asarray(animation.convert("RGB")).astype(int)
            orange.append(int(((pixels[..., 0] > 150) & (pixels[..., 1] < 130) & (pixels[..., 2] < 90)).sum()))
    assert lasting == pytest.approx(seconds, abs=0.3)
    assert orange[-1] > orange[0] + 300  # the arm of a motion that has failed


@pytest.mark.long
def test_the_committed_numbers_are_those_of_the_run(summary: Summary) -> None:
    assert_committed_numbers("standing", summary)
