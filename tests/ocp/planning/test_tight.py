"""Ways drawn tight: cheaper, still doing their task, and clear of what moves where it is then."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import CollisionShape, FixedBase, Moving, Sphere, Surroundings
from models.arrays import Array
from ocp.local.touching import distances_along
from ocp.planning.charts import Instant
from ocp.planning.steps import Length
from ocp.planning.tight import drawn_tight
from tests.ocp.planning.test_charts import moved, planar, sets_of

START = np.array([0.5, 1.2, -1.4])
CLEARANCE = 0.02


def armed() -> FixedBase:
    """A planar arm of three joints with a ball in the middle of its last link."""
    machine = planar(np.array([0.5, 0.4, 0.3]))
    links = [
        replace(link, collisions=(CollisionShape("sphere", (0.05,), translation=(0.15, 0, 0)),))
        if link.name == "link2"
        else link
        for link in machine.robot.links
    ]
    return FixedBase(replace(machine.robot, links=tuple(links)))


MACHINE = armed()
SETS, TIMES = sets_of(MACHINE, moved(MACHINE, START, "place"))
INSTANTS = [Instant(SETS, k) for k in range(len(TIMES))]


def followed() -> Array:
    """A way that does the task, each posture from the one before."""
    path = [START]
    for k in range(len(TIMES)):
        joints, good = SETS.corrected(np.array([k]), path[-1][None])
        assert good.all()
        path.append(joints[0])
    return np.array(path[1:])


def tight(obstacle: Any = None, later: float = 0.0) -> Array:
    """The way drawn tight, so much later than its task."""
    robot = MACHINE.robot
    around = None if obstacle is None else Surroundings(MACHINE, [obstacle], clearance=CLEARANCE)
    far, bounds = np.full((len(TIMES) - 1, robot.dof), 1.0), (robot.lower, robot.upper)
    cost = Length(np.ones(robot.dof))
    return drawn_tight(followed(), INSTANTS, cost, TIMES + later, far, bounds, around, (0.1, 1e-3))


def length(path: Array) -> float:
    return float(np.abs(np.diff(path, axis=0)).sum())


def middle_of_the_last_link(joints: Array) -> Array:
    angle = np.cumsum(joints)
    return np.asarray(np.array([0.5, 0.4, 0.15]) @ np.column_stack([np.cos(angle), np.sin(angle)]))


def test_it_is_no_longer_and_does_its_task() -> None:
    drawn = tight()
    assert length(drawn) < 0.99 * length(followed())
    error = SETS.linearised(np.arange(len(TIMES)), drawn)[0]
    assert_allclose(error, 0.0, atol=1e-9)


@pytest.mark.parametrize("later", [0.0, 20.0])
def test_what_moves_is_in_the_way_where_it_is_then(later: float) -> None:
    """A ball that is far away while the arm moves, and in its way at other times, before or after 10 s."""
    half = tight()[len(TIMES) // 2]
    beside, away = np.append(middle_of_the_last_link(half), 0.04), np.array([0.0, 0.0, 9.0])
    before, after = (beside, away) if later else (away, beside)
    moving = Moving(Sphere(0.05, (0, 0, 0)), lambda t: ca.if_else(t < 10.0, ca.DM(before), ca.DM(after)))
    drawn = tight(moving, later)
    assert_allclose(drawn, tight(Sphere(0.05, away)), atol=1e-12)
    around = Surroundings(MACHINE, [moving], clearance=CLEARANCE)
    assert distances_along(around, np.zeros(0), drawn, TIMES + later).min() > CLEARANCE
    there = Surroundings(MACHINE, [Sphere(0.05, beside)], clearance=CLEARANCE)
    assert distances_along(there, np.zeros(0), drawn, TIMES).min() < 0.0
    past = tight(Sphere(0.05, beside))
    assert distances_along(there, np.zeros(0), past, TIMES).min() > CLEARANCE
    assert length(past) > length(drawn)
