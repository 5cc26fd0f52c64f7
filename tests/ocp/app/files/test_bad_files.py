"""Whatever is wrong with a file's name, or with what is asked of what it holds, is refused by name."""

from __future__ import annotations

from functools import cache
from pathlib import Path as File
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from models import Path, planar_chain
from models.paths import split_at_reversals
from ocp import Limits
from ocp.app.files import (
    Program,
    RawTrajectory,
    TimedProgram,
    Waypoints,
    read_gcode,
    read_joint_limits,
    read_trajectory,
    read_waypoints,
)
from ocp.motion.schedule import LineLimits
from tests.bad_values import (
    CHOICE,
    FINITE,
    FLAG,
    INSTANCE,
    NOTHING,
    POSITIVE,
    SEQUENCE,
    Bad,
    Case,
    array,
    assert_refused,
    but,
    good_calls,
    method,
    panel,
)

GCODE = str(File(__file__).parent / "gcode" / "17_rounded_arcs.ngc")
NAME: Bad = {"None": None, "number": 3, "empty": "", "bytes": b"a", "list": ["a"], "object": object()}
FILE: Bad = NAME | {"nobody's": "/nowhere/to/be/found.csv", "folder": "/", "zero byte": "a\0b", "other": __file__}
WIDTH: Bad = POSITIVE | {"row": np.ones(3), "other word": "join"}
QUATERNION: Bad = array(4) | {"long": (2, 0, 0, 0)}
TABLE = "x,y,z,ax,ay,az\n0,0,0,0,0,1\n1,0,0,0,1,1\n1,1,0,0,0,1\n"


@cache
def program() -> Program:
    return read_gcode(GCODE)


@cache
def timed() -> TimedProgram:
    return program().schedule(LineLimits(0.1, 1.0, 10.0))


@cache
def waypoints() -> Waypoints:
    with TemporaryDirectory() as folder:
        (File(folder) / "table.csv").write_text(TABLE)
        return read_waypoints(File(folder) / "table.csv")


def path() -> Path:
    return program().paths[0]


def read_table(**options: Any) -> Waypoints:
    with TemporaryDirectory() as folder:
        (File(folder) / "table.csv").write_text(TABLE)
        return read_waypoints(**{"file": File(folder) / "table.csv", **options})


def read_motion(**options: Any) -> RawTrajectory:
    with TemporaryDirectory() as folder:
        (File(folder) / "motion.csv").write_text("time,a,b\n0,1,2\n1,2,3\n")
        return read_trajectory(**{"file": File(folder) / "motion.csv", **options})


def read_limits(**options: Any) -> Limits:
    with TemporaryDirectory() as folder:
        (File(folder) / "joint_limits.yaml").write_text("joint_limits: {joint1: {max_jerk: 1}}")
        robot = planar_chain([1.0], [1.0])
        return read_joint_limits(**{"file": File(folder) / "joint_limits.yaml", "robot": robot, **options})


CASES = [
    Case("read_joint_limits", read_limits, {}, {"file": FILE, "robot": INSTANCE, "scaling": FLAG}),
    Case(
        "read_gcode",
        read_gcode,
        {"file": GCODE},
        {
            "file": FILE,
            "unit": but(CHOICE, "None"),
            "feed": POSITIVE,
            "start": array(3) | NOTHING,
            "home": array(3),
            "reversal": WIDTH | NOTHING,
            "gap": POSITIVE,
            "block_delete": FLAG,
        },
    ),
    Case(
        "read_waypoints",
        read_table,
        {},
        {
            "file": FILE,
            "unit": but(CHOICE, "None"),
            "columns": SEQUENCE | {"few": ("x", "y", "z"), "other": ("a", "b", "c", "d", "e", "f")},
        },
    ),
    Case(
        "read_trajectory",
        read_motion,
        {},
        {
            "file": FILE,
            "columns": SEQUENCE | {"few": ("time", "a"), "no time": ("a", "b", "c")},
            "period": POSITIVE,
            "topic": but(NAME, "None", "empty"),
            "joints": SEQUENCE,
            "kind": but(CHOICE, "None"),
        },
    ),
    method(path, "placed", {}, position=array(3) | NOTHING, orientation=QUATERNION | NOTHING),
    method(program, "placed", {}, position=array(3) | NOTHING, orientation=QUATERNION | NOTHING),
    method(
        program, "smooth", {}, tolerance=POSITIVE, kind=CHOICE, overlap=CHOICE, shape=POSITIVE, remaining={"one": 0.1}
    ),
    method(
        program,
        "schedule",
        {"limits": LineLimits(0.1, 1.0, 10.0)},
        limits=INSTANCE | {"row": LineLimits([0.1, 0.2], 1.0, 10.0)},
        rapid=POSITIVE,
        tolerance=POSITIVE,
        kind=CHOICE,
    ),
    method(timed, "at", {"time": 0.1}, time=but(FINITE, "empty") | NOTHING | {"before": -1.0, "beyond": 1e9}),
    method(waypoints, "paths", {}, reversal=WIDTH | NOTHING),
    method(waypoints, "path", {}, reversal=WIDTH),
    method(waypoints, "smooth", {}, tolerance=POSITIVE | NOTHING, reversal=WIDTH, kind=CHOICE),
    Case(
        "split_at_reversals",
        split_at_reversals,
        {"segments": path().segments},
        {"segments": SEQUENCE | {"none": ()}, "reversal": WIDTH | NOTHING},
    ),
]


@pytest.mark.parametrize("case", good_calls(CASES))
def test_valid_values_are_accepted(case: Case) -> None:
    case.call(**case.good)


@pytest.mark.parametrize(("case", "argument"), panel(CASES))
@pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")
def test_bad_input_is_refused_by_name(case: Case, argument: str) -> None:
    assert_refused(case, argument)
