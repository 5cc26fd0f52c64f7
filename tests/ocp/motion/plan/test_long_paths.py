"""Paths of thousands of points are planned at the effort of their shape, and the tip passes all points."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from models import FixedBase, example_robot, smooth
from models import Path as CornerPath
from models.checks import Array
from models.paths import fit_splines
from ocp import Limits, Plan, TipTask, plan
from ocp.app.files import read_gcode, read_waypoints
from ocp.motion.result.solved_plan import SolvedPlan

MACHINE = FixedBase(example_robot("six_axis"))
DOWN = (0, 0, -1)
SPEED = 0.02  # m/s
DEVIATION = 2e-5  # m


def rosette(count: int, depth: float) -> Array:
    """Closed curve in reach of the arm, in micrometres. Shape (count, 3), m."""
    angle = np.linspace(0, 2 * np.pi, count)
    radius = 0.09 + depth * np.cos(5 * angle)
    points = np.column_stack([0.45 + radius * np.cos(angle), radius * np.sin(angle), 0.2 + 0 * angle])
    return np.asarray(np.round(points, 6))


def check(result: Plan, points: Array) -> None:
    """Assert that the audit passes, that the tip passes all points, and that its speed is constant."""
    assert result.audit().passed
    sample = result.sample(0.002)
    tip = sample.tip[:, :3]
    assert cKDTree(tip).query(points)[0].max() <= DEVIATION + SPEED * 0.002
    chords = np.linalg.norm(np.diff(tip, axis=0), axis=1) / np.diff(sample.t)
    assert chords == pytest.approx(SPEED, rel=2e-3)  # chords of the sharpest bends are shorter


def test_a_program_of_thousands_of_chords_is_planned(tmp_path: Path) -> None:
    points = rosette(2400, 0.01)
    lines = [f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f}" for x, y, z in 1e3 * points]
    (tmp_path / "flower.nc").write_text("\n".join(["G21 G90 F1200", "G0 X550 Z200", *lines]))
    (path,) = read_gcode(tmp_path / "flower.nc").smooth(DEVIATION)
    check(plan(MACHINE, TipTask.along(path, SPEED, steady=True, direction=DOWN), search="start"), points)


def test_limits_that_a_long_path_leaves_inactive_take_few_iterations() -> None:
    """The motion without limits of accelerations and jerks is the guess of the one within them, and stays it."""
    path = fit_splines(CornerPath.through(rosette(2400, 0.01)[:400]), DEVIATION)
    task = TipTask.along(smooth(path.path, deviation=path.deviation), SPEED, direction=DOWN)
    free = plan(MACHINE, task, search="start")
    result = plan(MACHINE, task, search="start", limits=Limits(acceleration=8.0, jerk=100.0))
    assert result.audit().passed
    assert isinstance(result, SolvedPlan)
    assert result.solution.iterations <= 15
    assert result.cost == pytest.approx(free.cost, rel=1e-3)
    sample = result.sample(0.01)
    assert np.abs(sample.accelerations).max() <= 8.0
    np.testing.assert_allclose(sample.rates[[0, -1]], 0.0, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("count", "seconds"), [(2400, 10.0), (10_000, 40.0)])
def test_ten_thousand_waypoints_are_planned_in_time(tmp_path: Path, count: int, seconds: float) -> None:
    points = rosette(count, 0.02)
    np.savetxt(tmp_path / "flower.csv", points, delimiter=",", header="x,y,z", fmt="%.6f")
    begin = time.process_time()
    path = read_waypoints(tmp_path / "flower.csv", unit="m").smooth(DEVIATION)
    result = plan(MACHINE, TipTask.along(path, SPEED, steady=True, direction=DOWN), search="start")
    assert time.process_time() - begin < seconds
    check(result, points)
