"""What the batches of the benchmark do: plans for a part that stands in many places, and nothing."""

from __future__ import annotations

from typing import Any

from models import FixedBase, Path, Robot, smooth
from ocp import Plan, TipTask, plan
from ocp.app.batch import cached
from scripts.robots.robots import UR5


def arm(robot: str) -> FixedBase:
    """The robot that stands there."""
    read: Robot = {"ur5": UR5}[robot].read()
    return FixedBase(read)


def placed(task: Any) -> Plan:
    """A seam of 0.2 m that begins at x, y (m), with the tool pointing down and its roll free."""
    corners = [(task["x"], task["y"], 0.3), (task["x"], task["y"] + 0.2, 0.3)]
    path = smooth(Path.through(corners), deviation=0.002)
    return plan(cached(arm, "ur5"), TipTask.along(path, 0.05, steady=True, direction=(0.0, 0.0, -1.0)), search="start")


def nothing(task: Any) -> float:
    """As short as a task can be."""
    return float(task["x"])
