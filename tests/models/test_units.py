"""Warnings of angles that look like degrees and lengths that look like millimetres."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from models import (
    CollisionShape,
    FixedBase,
    Joint,
    Link,
    ModelWarning,
    Rig,
    Robot,
    Scara,
    optimal_inverse,
    planar_chain,
    reference_rig,
    reference_tunnel,
    solve_table,
)
from ocp import TipTask, minimum_velocity_problem, resolve

URDF = """<robot name="arm"><link name="base"/><link name="tool"/>
<joint name="turn" type="{kind}"><parent link="base"/><child link="tool"/><origin xyz="{xyz}" rpy="{rpy}"/>{limit}
</joint></robot>"""
LIMIT = '<limit lower="{}" upper="{}" velocity="1" effort="1"/>'
LENGTHS = dict.fromkeys(("yaw_link_1", "yaw_link_2", "yaw_offset", "pitch_link", "sting", "goose_neck"), 0.5)
ARM = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))
FORWARD = TipTask(velocity=[0.1, 0.0], rows=(3, 4))


def read(kind: str = "revolute", xyz: str = "0 0 1", rpy: str = "0 0 0", limit: str = "") -> Robot:
    return Robot.from_urdf(URDF.format(kind=kind, xyz=xyz, rpy=rpy, limit=limit))


def moved(start: Any) -> Any:
    return resolve(ARM, FORWARD, 0.1, start=start, samples=2)


def planned(start: Any) -> Any:
    return minimum_velocity_problem(ARM, tasks=FORWARD, start=start, horizon=0.1)


@pytest.mark.parametrize(
    ("make", "name", "what"),
    [
        (lambda: Joint("turn", "revolute", "a", "b", lower=-170, upper=170), "turn", "degrees"),
        (lambda: Joint("turn", "revolute", "a", "b", upper=90), "turn", "degrees"),
        (lambda: read(limit=LIMIT.format(-170, 170)), "turn", "degrees"),
        (lambda: read(rpy="0 90 0"), "turn", "degrees"),
        (lambda: Scara(0.4, 0.3, lower=(-130, -2, -1, -2), upper=(130, 2, 1, 2)), "shoulder", "degrees"),
        (lambda: Rig(**LENGTHS, lower=(0, -90, -3, -3, -3, -3), upper=(9, 90, 3, 3, 3, 3)), "joint 2", "degrees"),
        (lambda: solve_table(reference_rig(), reference_tunnel(), [(2.54, 0.15, 0, 15, 0)]), "targets", "degrees"),
        (lambda: moved([30, 45, 60]), "joint1", "degrees"),
        (lambda: planned([30, 45, 60]), "joint1", "degrees"),
        (lambda: Joint("turn", "revolute", "a", "b", (0, 0, 700)), "turn", "millimetres"),
        (lambda: read(xyz="0 0 700"), "turn", "millimetres"),
        (lambda: Link("arm", 1.0, (350, 0, 0)), "arm", "millimetres"),
        (lambda: CollisionShape("box", (700, 100, 100)), "size", "millimetres"),
        (lambda: planar_chain([700, 500], [1, 1]), "link1", "millimetres"),
        (lambda: Scara(400, 300), "upper_arm", "millimetres"),
        (lambda: Rig(**{**LENGTHS, "sting": 750.0}), "sting", "millimetres"),
    ],
)
def test_values_in_other_units_are_warned_of_by_name(make: Callable[[], Any], name: str, what: str) -> None:
    with pytest.warns(ModelWarning, match=what) as caught:
        make()
    names = [warning.message.name for warning in caught if isinstance(warning.message, ModelWarning)]
    assert name in names, names


@pytest.mark.parametrize(
    "make",
    [
        lambda: Joint("wheel", "continuous", "a", "b"),
        lambda: Joint("turn", "revolute", "a", "b", lower=-4 * np.pi, upper=4 * np.pi),
        lambda: Joint("turn", "revolute", "a", "b", lower=-1e16, upper=1e16),
        lambda: Joint("slide", "prismatic", "a", "b", lower=-20, upper=20),
        lambda: read(rpy="0 1.57 6.28", xyz="0 0 49"),
        lambda: read(kind="prismatic", limit=LIMIT.format(0, 40)),
        lambda: moved([6.5, -6.5, 12.5]),
        lambda: FixedBase(planar_chain([1.0], [1.0]), translation=(4000.0, 0.0, 0.0)),
        lambda: optimal_inverse(reference_rig(), reference_tunnel()),
        lambda: CollisionShape("mesh", (1000, 1000, 1000), "part.stl"),
    ],
)
def test_plausible_values_cause_no_warning(make: Callable[[], Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make()


def test_the_warning_is_given_once() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default", ModelWarning)
        for _ in range(3):
            Joint("turn once", "revolute", "a", "b", upper=90)
    assert len(caught) == 1
