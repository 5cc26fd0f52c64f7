"""The blend script: its numbers against the reference ones, laws that its tables must keep, and its files."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from models import Path as TaskPath
from models import Scara, smooth
from ocp.motion.schedule import JointTrajectory, LineLimits, joint_motion, schedule
from scripts import blend
from scripts.papers.blend.example import (
    ARM,
    ELBOW,
    JERK,
    MM,
    PAPER_GAMMA,
    PAPER_TIMES,
    REMAINING,
    SPEED,
    corner,
    example,
)
from scripts.papers.blend.results import Results
from tests.scripts.papers.script_run import Run, Summary, assert_committed_numbers, assert_whole_picture

PAPER = blend.PAPER
pytestmark = pytest.mark.xdist_group("blend")

PICTURES = (
    "fig03_06_shapes.png",
    "fig04_07_similarity.png",
    "fig08_09_differences.png",
    "fig13_path.png",
    "fig14_position.png",
    "fig15_velocity.png",
    "fig16_joint_angles.png",
    "fig17_joint_rates.png",
    "fig18_line_speed.png",
    "mapping_errors.png",
    "curvature.png",
    "limits.png",
)


@pytest.mark.long
def test_gamma_is_that_of_the_page(summary: Summary) -> None:
    expected = [
        (30, 0.530, 0.530, 0.693),
        (25, 0.495, 0.530, 0.693),
        (20, 0.4419, 0.530, 0.693),
        (15, 0.354, 0.530, 0.693),
    ]
    np.testing.assert_allclose(summary["gamma_table"], expected, rtol=0, atol=5e-4)
    assert summary["gamma_table"][2][1] == pytest.approx(abs(1 - 1.5 / 4) * np.cos(np.pi / 4), abs=1e-12)


@pytest.mark.long
def test_gamma_measured_on_the_curve_is_the_closed_form(run: Run[Results]) -> None:
    for row in run.table("table2_gamma.csv"):
        for name in ("constant_30_90deg", "shape_1_90deg", "shape_1_45deg"):
            assert float(row[f"{name}_measured"]) == pytest.approx(float(row[name]), abs=1e-9)
            printed = PAPER_GAMMA[int(row["remaining_mm"])]
            assert float(row[f"{name}_paper"]) in printed


@pytest.mark.long
def test_lengths(summary: Summary) -> None:
    expected = [250, 270.32146, 351.92024, 269.65284, 526.93047]
    np.testing.assert_allclose(summary["lengths_mm"], expected, rtol=0, atol=1e-5)
    assert summary["total_length_mm"] == pytest.approx(1668.82501, abs=1e-5)
    assert sum(summary["lengths_mm"]) == pytest.approx(summary["total_length_mm"], abs=1e-9)


@pytest.mark.long
def test_times_in_both_readings(run: Run[Results], summary: Summary) -> None:
    assert summary["duration_s"] == pytest.approx(1.868825, abs=1e-6)
    np.testing.assert_allclose(summary["blend_times_s"], [0.3500, 0.6203, 0.9722, 1.2419], rtol=0, atol=5e-5)
    assert summary["duration_peak_reading_s"] == pytest.approx(1.893825, abs=1e-6)
    np.testing.assert_allclose(
        summary["blend_times_peak_reading_s"], [0.3625, 0.6328, 0.9847, 1.2544], rtol=0, atol=5e-5
    )
    rows = run.table("events.csv")
    assert [float(row["paper_s"]) for row in rows[:4]] == list(PAPER_TIMES)
    for row in rows:
        for reading in ("mean", "peak"):
            difference = float(row[f"{reading}_s"]) - float(row["paper_s"])
            assert float(row[f"{reading}_difference_s"]) == pytest.approx(difference, abs=1e-9)
    for row in rows[4:]:
        assert abs(float(row["mean_difference_s"])) < 2.5e-3


@pytest.mark.long
def test_ramps_of_the_mean_reading_have_the_mean_acceleration(run: Run[Results]) -> None:
    profile = run.results.mean.profile
    cruise = np.flatnonzero(np.isclose(profile.speed, SPEED, rtol=1e-12))
    assert profile.speed[cruise[0]] / profile.t[cruise[0]] == pytest.approx(5.0, rel=1e-12)
    assert np.abs(profile.jerk).max() == pytest.approx(JERK, rel=1e-12)
    inner = run.results.mean.at(np.linspace(profile.t[cruise[0]], profile.t[cruise[-1]], 1001)).speed
    np.testing.assert_allclose(inner, SPEED, rtol=1e-12)


@pytest.mark.long
def test_speed_errors_of_both_mappings(summary: Summary) -> None:
    error = summary["speed_error_mm_s"]
    assert error["predictor_corrector_2ms"] == pytest.approx(-0.4207, abs=2e-4)
    assert error["predictor_corrector_2ms_true"] == pytest.approx(-0.316, abs=1e-3)
    assert error["predictor_corrector_2ms"] - error["predictor_corrector_2ms_true"] == pytest.approx(-0.105, abs=1e-3)
    assert abs(error["gauss_2ms"]) < 1e-6
    assert abs(error["gauss_2ms_line_arc"]) < 1e-6
    # the drift of 14.9 um at the blend's end, made good within 2 ms
    np.testing.assert_allclose(error["predictor_corrector_2ms_blend_ends"], [7.45, 7.6], rtol=0, atol=0.1)


@pytest.mark.long
def test_drift_and_speed_error_by_period(run: Run[Results]) -> None:
    expected = {1: (-3.73, -0.079, -0.105), 2: (-14.9, -0.316, -0.421), 4: (-59.5, -1.25, -1.67)}
    keys = ("drift_um", "true_speed_error_mm_s", "chord_speed_error_mm_s")
    for row in run.table("mapping_example.csv"):
        if row["blend"] == "line-line" and row["mapping"] == "predictor_corrector":
            assert [float(row[key]) for key in keys] == pytest.approx(expected[int(float(row["period_ms"]))], rel=5e-3)


@pytest.mark.long
def test_drift_of_small_blends(run: Run[Results], summary: Summary) -> None:
    drift = summary["drift_mm"]
    assert abs(drift["gauss_1ms_150mm"]) < 1e-9
    assert abs(drift["gauss_1ms_5mm"]) < 1e-4
    assert drift["predictor_corrector_1ms_10mm"] == pytest.approx(-0.055, abs=1e-3)
    assert drift["predictor_corrector_1ms_5mm"] == pytest.approx(-0.105, abs=1e-3)
    table = run.table("mapping_small_blends.csv")
    cases = {(r["blend"], float(r["remaining_mm"]), float(r["period_ms"]), r["mapping"]) for r in table}
    assert len(cases) == len(table) == 2 * 6 * 3 * 2
    worst = {float(r["remaining_mm"]): float(r["true_speed_error_mm_s"]) for r in table if is_paper_at_1ms(r)}
    assert worst[10] == pytest.approx(-14.7, abs=0.1)
    assert worst[5] == pytest.approx(-53, abs=0.5)


def is_paper_at_1ms(row: dict[str, str]) -> bool:
    return (row["blend"], row["mapping"], float(row["period_ms"])) == ("cubic", "predictor_corrector", 1)


@pytest.mark.long
def test_the_default_mapping_is_the_better_one_everywhere(run: Run[Results]) -> None:
    by_name: dict[tuple[str, str, str], dict[str, float]] = {}
    for row in run.table("mapping_small_blends.csv"):
        case = (row["blend"], row["remaining_mm"], row["period_ms"])
        by_name.setdefault(case, {})[row["mapping"]] = abs(float(row["drift_um"]))
    for case, drifts in by_name.items():
        assert drifts["gauss_newton"] < drifts["predictor_corrector"], case


@pytest.mark.long
def test_curvature_jumps(run: Run[Results], summary: Summary) -> None:
    np.testing.assert_allclose(summary["curvature_jumps_cubic_per_mm"], [0, 0, 1.62e-4, 3.25e-4], rtol=0, atol=1e-6)
    assert summary["max_curvature_jump_cubic"] == max(summary["curvature_jumps_cubic_per_mm"])
    peak = run.results.quintic.curvature(run.results.quintic.sample_distances()).max() * MM
    assert summary["max_curvature_jump_quintic"] < 1e-9 * peak


@pytest.mark.long
def test_centripetal_acceleration_that_the_example_asks(summary: Summary) -> None:
    line_line, line_arc = summary["asked_centripetal_mm_s2"]
    assert line_line == pytest.approx(25142, abs=1)
    assert line_arc > line_line
    speeds = summary["speed_for_centripetal_limit_mm_s"]["speeds"]
    assert speeds[0] == pytest.approx(446, abs=0.5)
    np.testing.assert_allclose(np.square(speeds) * np.array([line_line, line_arc]) / SPEED**2 * MM**2, 5000, rtol=1e-9)


@pytest.mark.long
def test_requested_limits_hold(run: Run[Results], summary: Summary) -> None:
    rows = {row["case"]: row for row in summary["limited"]}
    assert list(rows) == list(run.results.plans)
    for name, row in rows.items():
        # the optimal control problem holds its jerk in intervals, which the schedule need not
        assert row["minimum_s"] <= row["duration_s"] * (1 + 5e-3), name
        assert row["minimum_demand"] < 1.001, name
        if name.endswith("line speed"):
            # one jerk-limited motion is the time optimum
            assert row["minimum_s"] == pytest.approx(row["duration_s"], rel=1e-6)
            assert row["dips"] == 0
            assert row["centripetal_over_limit"] > 1.5
        else:
            assert row["dips"] > 0
            assert row["centripetal_over_limit"] < 1.001
            assert len(summary["dips"][name]) == row["dips"]
    for kind in ("velocity", "acceleration", "jerk"):
        assert rows["quintic, + joints"][f"joint_{kind}_over_limit"] < 1.001
    assert rows["cubic, + centripetal"]["joint_jerk_over_limit"] == "unbounded"


@pytest.mark.long
def test_more_limits_never_make_it_faster(run: Run[Results], summary: Summary) -> None:
    for kind in ("cubic", "quintic"):
        rows = [row for row in summary["limited"] if row["case"].startswith(kind)]
        for key in ("duration_s", "minimum_s"):
            values = [row[key] for row in rows]
            assert values == sorted(values)


@pytest.mark.long
def test_the_trajectory_draws_the_path(run: Run[Results]) -> None:
    trajectory = JointTrajectory.read_csv(run.folder / "trajectory.csv")
    assert trajectory.t[-1] == pytest.approx(1.868825, abs=1e-6)
    np.testing.assert_allclose(np.diff(trajectory.t)[:-1], 2e-3, rtol=0, atol=1e-12)
    tips = np.array([np.array(ARM.forward(q).position).ravel() for q in trajectory.positions])
    path = run.results.cubic
    motion = run.results.mean.at(trajectory.t)
    np.testing.assert_allclose(tips, path.at(motion.distance).position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(tips[[0, -1]], MM * np.array([(700, 0, 50), (-372, 650, 50)]), rtol=0, atol=1e-12)
    # tool yaw held
    np.testing.assert_allclose(trajectory.positions[:, [0, 1, 3]].sum(axis=1), 0, rtol=0, atol=1e-12)
    for rest in (trajectory.velocities[[0, -1]], trajectory.accelerations[[0, -1]]):
        np.testing.assert_allclose(rest, 0, rtol=0, atol=1e-6)


@pytest.mark.long
def test_velocities_of_the_trajectory_are_those_of_its_positions(run: Run[Results]) -> None:
    plan, joints = run.results.mean, run.results.joints
    middle = np.linspace(0.01, plan.duration - 0.01, 301)
    step = 1e-5
    before, after = (joint_motion(joints, plan.at(middle + shift)) for shift in (-step, step))
    _, velocity, acceleration, _ = joint_motion(joints, plan.at(middle))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), velocity, rtol=0, atol=1e-4)
    # but where the cubic's curvature jumps at the arc
    away = np.abs(middle[:, None] - plan.time_at(run.results.cubic.bounds[1:-1])).min(axis=1) > 2 * step
    np.testing.assert_allclose(
        ((after[1] - before[1]) / (2 * step))[away], acceleration[away], rtol=0, atol=1e-3 * np.abs(acceleration).max()
    )


def test_the_example_fits_the_arm() -> None:
    assert ARM.outer == pytest.approx(0.8)
    assert isinstance(ARM, Scara)
    assert ELBOW in ("left", "right")
    task = example()
    assert task.lengths[:2] / MM == pytest.approx([400, np.hypot(650, 50)], abs=1e-9)


def test_a_corner_has_its_requested_angle() -> None:
    for degrees in (5, 45, 90, 179):
        path = corner(degrees, 20 * MM, 3.0)
        assert np.degrees(path.blend(0).angle) == pytest.approx(degrees, abs=1e-9)
        assert path.remaining[0] == pytest.approx(20 * MM)


@pytest.mark.long
def test_files_are_whole_and_the_script_succeeds(run: Run[Results]) -> None:
    assert run.status == 0
    for name in PICTURES:
        assert_whole_picture(run.folder / name)
    with Image.open(run.folder / "motion.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 40
    assert (run.folder / "motion.gif").stat().st_size < 1.5e6
    assert run.names == {
        *PICTURES,
        "motion.gif",
        "summary.json",
        "trajectory.csv",
        "table2_gamma.csv",
        "events.csv",
        "mapping_example.csv",
        "mapping_small_blends.csv",
        "limits.csv",
    }


@pytest.mark.long
def test_the_tables_agree_with_the_summary(run: Run[Results], summary: Summary) -> None:
    gamma = run.table("table2_gamma.csv")
    names = ("remaining_mm", "constant_30_90deg", "shape_1_90deg", "shape_1_45deg")
    np.testing.assert_allclose(
        [[float(row[name]) for name in names] for row in gamma], summary["gamma_table"], rtol=1e-9
    )
    events = run.table("events.csv")
    np.testing.assert_allclose([float(row["mean_s"]) for row in events[:4]], summary["blend_times_s"], rtol=1e-9)
    for row, report in zip(run.table("limits.csv"), summary["limited"], strict=True):
        assert row["case"] == report["case"]
        assert float(row["duration_s"]) == pytest.approx(report["duration_s"], rel=1e-9)


@pytest.mark.long
def test_paper_value_ours_and_difference_are_printed(run: Run[Results]) -> None:
    for word in ("paper", "ours", "difference", "misprint", "1668.82501", "1.868825", "1.893825", "25142", "-0.4207"):
        assert word in run.printed
    assert "nan" not in run.printed


def test_the_examples_time_depends_on_its_length_alone() -> None:
    straight = smooth(TaskPath.through([(0, 0, 0), (1.6688250069032047, 0, 0)]), REMAINING)
    acceleration = 5.857864376269049  # 200 (0.2 - sqrt(0.2^2 - 4/200)) / 2: ramp of 0.2 s at 200 m/s^3 to 1 m/s
    assert schedule(straight, LineLimits(SPEED, acceleration, JERK)).duration == pytest.approx(1.868825, abs=1e-6)


@pytest.mark.long
def test_the_committed_numbers_are_those_of_the_run(summary: Summary) -> None:
    assert_committed_numbers("blend", summary)
