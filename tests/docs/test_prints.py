"""Printed objects of the public interface fit on a screen."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Any

import numpy as np

from models import Box, CollisionScene, FixedBase, Path, example_robot, smooth
from ocp import Goal, IkSolver, Limits, Scene, TipTask, Waypoints, inverse_kinematics
from ocp.app.files import read_gcode, read_trajectory, read_waypoints
from ocp.motion.schedule import LineLimits, schedule

MOST_LINES, MOST_CHARACTERS = 15, 1000


def printed(value: Any) -> str:
    text = str(value)
    assert len(text.splitlines()) <= MOST_LINES
    assert len(text) <= MOST_CHARACTERS
    return text


def test_paths_tasks_and_scenes_are_printed_on_a_few_lines() -> None:
    machine = FixedBase(example_robot("six_axis"))
    path = Path.through([(0.4, -0.2 + 0.004 * k, 0.3 + 0.02 * (k % 2)) for k in range(100)])
    rounded = smooth(path, deviation=0.0005)
    assert printed(path) == f"<Path of {path.length:.6g} m: 99 lines>"
    assert "99 segments and 98" in printed(rounded)
    timed = schedule(rounded, LineLimits(0.05, 1.0, 20.0))
    box = Box((0.1, 0.1, 0.1), (1.0, 1.0, 1.0))
    shown = [
        machine,
        TipTask.along(rounded, 0.05, steady=True, direction=(0, 0, -1)),
        timed,
        timed.at(np.linspace(0, 1, 500)),
    ]
    shown += [
        Goal(position=(0.3, 0.5, 0.35)),
        Limits(acceleration=3.0),
        Scene([box] * 50),
        CollisionScene(machine, [box]),
    ]
    shown += [Waypoints(np.zeros((500, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (500, 1)), step=0.01)]
    solver = IkSolver(machine)
    shown += [solver, solver([0.4, 0.1, 0.3], np.diag([1.0, -1.0, -1.0]))]
    shown += inverse_kinematics(machine, TipTask(position=(0.4, 0.1, 0.3)), starts=2)
    for value in shown:
        printed(value)


def test_what_files_hold_is_printed_on_a_few_lines(tmp_path: FilePath) -> None:
    rows = [(0.01 * k, 0.1 * k) for k in range(300)]
    (tmp_path / "motion.csv").write_text("time,elbow\n" + "\n".join(f"{t},{q}" for t, q in rows))
    (tmp_path / "points.csv").write_text("x,y,z\n" + "\n".join(f"{q},0.1,{t}" for t, q in rows))
    (tmp_path / "part.nc").write_text(
        "G21 G90\nG1 X0 Y0 Z0 F1000\n" + "\n".join(f"G1 X{k} Y{k % 7}" for k in range(300))
    )
    program = read_gcode(tmp_path / "part.nc")
    printed(read_trajectory(tmp_path / "motion.csv"))
    printed(read_waypoints(tmp_path / "points.csv"))
    printed(program)
    assert printed(program.schedule(LineLimits(0.1, 1.0, 20.0))).startswith("<TimedProgram of ")
