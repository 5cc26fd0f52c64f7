"""The captive trajectory script: its numbers against the reference ones, its files, and the exported C."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from models import ModelError, reference_rig, reference_tunnel
from models.cts.table import export, rig_functions
from scripts import cts
from scripts.papers.cts.results import Results
from tests.models.cts.cts_oracle import random_targets
from tests.scripts.papers.script_run import Run, Summary, assert_committed_numbers, assert_whole_picture

PAPER = cts.PAPER
pytestmark = pytest.mark.xdist_group("cts")  # one process, so that the script runs once
EXAMPLE = Path(__file__).resolve().parents[3] / "scripts" / "c_export"
PICTURES = (
    "fig06_rig.png",
    "fig07_joints_i1.png",
    "fig08_iterations.png",
    "fig09_joints_i2.png",
    "release.png",
    "plan.png",
)
TABLES = ("table6_time.csv", "iterations.csv", "reference_rolls.csv", "sweep.csv")


@pytest.mark.long
def test_reference_rolls(summary: Summary) -> None:
    assert summary["phi_reference"] == pytest.approx([0.331364, 0.682290, math.pi / 2, 2.459303, 2.810229], abs=1e-6)


@pytest.mark.long
def test_iterations_are_those_of_the_reference(summary: Summary) -> None:
    assert summary["i1"]["combined"]["iterations_mean"] == pytest.approx(3.0, abs=0.05)
    assert summary["i1"]["jacobian"]["iterations_mean"] == pytest.approx(11.9, abs=1.0)
    assert summary["i1"]["jacobian_gain_1"]["iterations_mean"] == pytest.approx(98.7, abs=1.0)
    assert summary["i2"]["combined"]["iterations_mean"] == pytest.approx(2.74, abs=0.02)
    assert summary["i2"]["jacobian"]["converged"] == 0


@pytest.mark.long
def test_divergence_is_predicted_by_the_stability_bound(summary: Summary) -> None:
    for index, method, stable in (
        ("i1", "jacobian", True),
        ("i1", "jacobian_gain_1", True),
        ("i2", "jacobian", False),
        ("i2", "jacobian_gain_1", True),
    ):
        assert (summary[index][method]["gain_n6_squared_bend_max"] < 2) == stable


@pytest.mark.long
def test_no_global_minimum_is_missed_and_newton_often_ends_in_a_maximum(summary: Summary) -> None:
    assert summary["global_missed"] == 0
    assert 0.5 < summary["newton_maximum_share"] < 0.7


@pytest.mark.long
def test_the_null_space_method_takes_more_iterations(summary: Summary) -> None:
    combined = summary["i1"]["combined"]["iterations_mean"]
    assert summary["i1"]["jacobian"]["iterations_mean"] > 2 * combined
    assert summary["i1"]["jacobian_gain_1"]["iterations_mean"] > 10 * combined
    assert summary["compiled_ns_per_target"] > 0


@pytest.mark.long
def test_the_release_is_tracked_and_keeps_clear(summary: Summary) -> None:
    release = summary["release"]
    assert release["tracking_m"] < 1e-12
    assert release["tracking_rad"] < 1e-12
    assert release["least_clearance_m"] > 0.05


@pytest.mark.long
def test_the_plan_keeps_its_limits_where_single_targets_do_not(summary: Summary) -> None:
    result = summary["plan"]
    plan, single = result["plan"], result["each_target_by_itself"]
    assert result["audit_passed"]
    assert plan["rate_max_rad_s"] <= result["rate_limit_rad_s"] * 1.001 < single["rate_max_rad_s"]
    assert plan["least_clearance_m"] >= result["clearance_m"] - 1e-5 > single["least_clearance_m"]
    assert plan["index_integral_s"] > single["index_integral_s"]


@pytest.mark.long
def test_all_files_are_written_and_the_script_succeeds(run: Run[Results]) -> None:
    assert run.status == 0
    assert run.names == {*PICTURES, *TABLES, "release.gif", "summary.json"}
    for name in PICTURES:
        assert_whole_picture(run.folder / name)
    with Image.open(run.folder / "release.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 20
    for name in TABLES:
        assert run.table(name)


@pytest.fixture(scope="module")
def functions() -> dict[str, Any]:
    return rig_functions(reference_rig(), reference_tunnel())


@pytest.mark.long
def test_generated_c_called_from_c_gives_the_joints_of_python(tmp_path: Path, functions: dict[str, Any]) -> None:
    example = tmp_path / "example"
    shutil.copytree(EXAMPLE, example, ignore=shutil.ignore_patterns("build"))
    export(functions, example / "build" / "cts_inverse.c")
    subprocess.run(
        ["make", "CC=cc", f"PYTHON={sys.executable}"], cwd=example, check=True, capture_output=True, text=True
    )
    targets = random_targets(np.random.default_rng(9), 500)
    targets[:, 7] = np.nan
    previous = np.random.default_rng(10).uniform(-3, 3, 500)
    lines = [" ".join(f"{value:.17g}" for value in (*row, roll)) for row, roll in zip(targets.T, previous, strict=True)]
    command = [str(example / "build" / "cts")]
    report = subprocess.run(command, input="\n".join(lines) + "\n", check=True, capture_output=True, text=True).stdout
    values = np.array([[float(word) for word in line.split()] for line in report.splitlines()])
    joints, _, active, status = functions["optimal_inverse_i1"].map(500)(targets, previous[None])
    np.testing.assert_array_equal(values[:, 0], np.array(status)[0])
    np.testing.assert_array_equal(values[:, 1], np.array(active)[0])
    np.testing.assert_allclose(values[:, 2:], np.array(joints).T, rtol=0, atol=1e-12, equal_nan=True)
    assert {0, 1, 2, 3} <= set(values[:, 0].astype(int))


def test_export_refuses_names_that_are_no_c_files(tmp_path: Path, functions: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match=r"must end in \.c"):
        export(functions, tmp_path / "rig.cpp")
    with pytest.raises(ModelError, match="no function"):
        export([], tmp_path / "rig.c")


@pytest.mark.long
def test_the_committed_numbers_are_those_of_the_run(summary: Summary) -> None:
    assert_committed_numbers("cts", summary)
