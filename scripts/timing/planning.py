"""How long `plan` takes on ordinary tool paths, and what the best of all postures costs beside the first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import models
from models import FixedBase, Machine, Robot, smooth
from models.checks import Array
from ocp import Plan, TipTask, plan
from ocp.motion.search.configurations import SearchKind
from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.robots.robots import PANDA, SPACE_ARM, UR5
from scripts.timing.measure import timed

SPEED = 0.05  # m/s
GOALS = {"raster of 10 waypoints": (1.0, 4.0), "serpentine of 5 lanes": (3.0, 6.0), "pose sequence": (2.0, 6.0)}
"""s, on two cores: from the first posture that leads to a plan, and from all of them."""


def raster(lanes: int, length: float, width: float) -> Array:
    """Corners of lanes along y, shape (2 lanes, 3), m."""
    across = 0.45 + np.linspace(0.0, width, lanes)
    return np.array([(x, y * (-1) ** i, 0.2) for i, x in enumerate(across) for y in (-length / 2, length / 2)])


def lanes(count: int, length: float, width: float, **options: Any) -> TipTask:
    """Lanes with corners rounded to 2 mm, the tool pointing down."""
    path = smooth(models.Path.through(raster(count, length, width)), deviation=0.002)
    return TipTask.along(path, SPEED, steady=True, direction=(0.0, 0.0, -1.0), **options)


def poses() -> TipTask:
    """Four poses, turned from one to the next, all six rows given."""
    points = [(0.4, -0.2, 0.4), (0.5, 0.0, 0.5), (0.4, 0.25, 0.4), (0.55, 0.2, 0.3)]
    cosine, sine = np.cos(0.2), np.sin(0.2)
    down, tilted, rolled = (0.0, 1.0, 0.0, 0.0), (-sine, cosine, 0.0, 0.0), (0.0, cosine, sine, 0.0)
    path = smooth(models.Path.through(points, [down, rolled, tilted, down]), deviation=0.005)
    return TipTask.along(path, 0.1, steady=True, roll="given")


def in_space(robot: Robot) -> tuple[Machine, TipTask, Array]:
    """A bent line before a floating arm."""
    machine = models.FreeFloating(robot)
    start = np.array([0.3, -0.5, 0.4, 0.9, 0.2, 0.7, 0.1])
    at = np.array(models.tip_pose(robot, start).position, dtype=float).ravel()
    corners = at + np.array([(0, 0, 0), (0, 0.1, 0.02), (0.06, 0.12, 0.05)])
    path = smooth(models.Path.through(corners), deviation=0.003)
    return machine, TipTask.along(path, 0.01, steady=True), start


CASES: dict[str, Callable[[], tuple[Machine, TipTask, Array | None]]] = {
    "raster of 10 waypoints": lambda: (FixedBase(UR5.read()), lanes(5, 0.3, 0.16), None),
    "serpentine of 5 lanes": lambda: (FixedBase(PANDA.read()), lanes(5, 0.4, 0.2), None),
    "cone of 15 degrees": lambda: (FixedBase(UR5.read()), lanes(3, 0.3, 0.16, within=np.radians(15.0)), None),
    "pose sequence": lambda: (FixedBase(PANDA.read()), poses(), None),
    "bent line in space": lambda: in_space(SPACE_ARM.read()),
}


def run(repeats: int = 5) -> dict[str, Any]:
    """Times and costs of every case, from the first posture and from all."""
    return {"rows": [row(case, search, repeats) for case, search in progress(pairs(), "planning")]}


def pairs() -> list[tuple[str, SearchKind]]:
    """Cases and how their start is searched; given starts are not."""
    searches: tuple[SearchKind, ...] = ("start", "configurations")
    return [(case, search) for case in CASES for search in searches if search == "start" or "space" not in case]


def row(case: str, search: SearchKind, repeats: int) -> dict[str, Any]:
    """One row: the least time of some runs, as a user would call it."""
    machine, task, start = CASES[case]()
    runs = [timed(lambda: plan(machine, task, start=start, search=search)) for _ in range(max(1, min(repeats, 3)))]
    result: Plan = runs[-1][0]
    goals = GOALS.get(case)
    return {
        "case": case,
        "robot": machine.robot.name,
        "search": search,
        "postures": len(result.candidates),
        "intervals": len(result.solution.state_interpolant.breaks) - 1,
        "cost": result.cost,
        "plan_s": min(seconds for _, seconds in runs),
        "goal_s": None if goals is None else goals[search == "configurations"],
    }


def report(numbers: dict[str, Any]) -> str:
    """The times in words."""
    rows = numbers["rows"]
    firsts = {row["case"]: row["plan_s"] for row in rows if row["search"] == "start"}
    ratios = [
        f"{row['case']}: {row['postures']} postures take {row['plan_s'] / firsts[row['case']]:.1f} times the first"
        for row in rows
        if row["search"] == "configurations"
    ]
    return "\n".join([text_table(rows, 4), *ratios])


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Times of every case, with the goals."""
    note = (
        "plan(...) with its checks of reach, search, solves and audits; black ticks: the goals. Least of three runs on "
        "one machine; the robots are read before."
    )
    met = sum(1 for row in numbers["rows"] if row["goal_s"] and row["plan_s"] <= row["goal_s"])
    request = sum(1 for row in numbers["rows"] if row["goal_s"])
    title = f"From a task to an audited plan in seconds; {met} of {request} goals are met"
    with drawing.sheet(path, (1, 1), (7.6, 3.6), note, title=title) as (_, axes):
        axis = np.ravel(axes)[0]
        names = list(CASES)
        for shift, search, color in ((-0.2, "start", "blue"), (0.2, "configurations", "green")):
            rows = [row for row in numbers["rows"] if row["search"] == search]
            places = [names.index(row["case"]) + shift for row in rows]
            message = {"start": "from the first posture that leads to a plan", "configurations": "from all postures"}[
                search
            ]
            axis.barh(places, [row["plan_s"] for row in rows], 0.35, color=drawing.COLORS[color], label=message)
            for place, row in zip(places, rows, strict=True):
                if row["goal_s"]:
                    axis.plot([row["goal_s"]] * 2, [place - 0.2, place + 0.2], color="black", lw=1)
        axis.set(yticks=range(len(names)), yticklabels=names, xlabel="time, s")
        axis.invert_yaxis()
        axis.legend(loc="lower right")
