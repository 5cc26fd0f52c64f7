"""Ways drawn tight: cheaper, still doing their task, and clear of what moves where it is then."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import CollisionScene, CollisionShape, FixedBase, MovingObstacle, Sphere
from models.checks import Array
from ocp.motion.local.collisions import distances_along
from ocp.motion.search.charts import TimeSample
from ocp.motion.search.lengths import PathLength
from ocp.motion.search.shortening import PathProblem, shorten_path
from ocp.motion.search.steps import SquaredRates, Steps
from tests.ocp.motion.search.test_charts import moved, planar, sets_of

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
TIME_SAMPLES = [TimeSample(SETS, k) for k in range(len(TIMES))]


def slid(way: float) -> Array:
    """The start moved along its self-motion, so far in the metric of the sets."""
    joints, tangents = START, None
    for _ in range(20):
        tangents = SETS.tangents_at(np.array([0]), joints[None], tangents)
        joints = SETS.project(np.array([0]), (joints + way / 20 * tangents[0, :, 0])[None])[0][0]
    return joints


def followed(start: Array = START) -> Array:
    """A way that does the task, each posture from the one before."""
    path = [start]
    for k in range(len(TIMES)):
        joints, good = SETS.project(np.array([k]), path[-1][None])
        assert good.all()
        path.append(joints[0])
    return np.array(path[1:])


def tight(obstacle: Any = None, later: float = 0.0) -> Array:
    """The way drawn tight, so much later than its task."""
    robot = MACHINE.robot
    around = None if obstacle is None else CollisionScene(MACHINE, [obstacle], clearance=CLEARANCE)
    steps = Steps(TIMES + later, PathLength(np.ones(robot.dof)), np.full((len(TIMES) - 1, robot.dof), 1.0))
    return shorten_path(followed(), PathProblem(TIME_SAMPLES, steps, robot.lower, robot.upper, around), (0.1, 1e-3))


def random_problem(
    start: Array = START, cost: Any = None, far: Any = 1.0, lower: Any = -9.0, upper: Any = 9.0, times: Any = TIMES
) -> Array:
    """The way from a start drawn tight, whatever is around."""
    robot = MACHINE.robot
    steps = np.full((len(TIMES) - 1, robot.dof), far)
    bounds = np.maximum(robot.lower, lower), np.minimum(robot.upper, upper)
    cost = cost or PathLength(np.ones(robot.dof))
    problem = PathProblem(TIME_SAMPLES, Steps(times, cost, steps), *bounds, None)
    return shorten_path(followed(start), problem, (0.1, 1e-3))


def length(path: Array) -> float:
    return float(np.abs(np.diff(path, axis=0)).sum())


def middle_of_the_last_link(joints: Array) -> Array:
    angle = np.cumsum(joints)
    return np.asarray(np.array([0.5, 0.4, 0.15]) @ np.column_stack([np.cos(angle), np.sin(angle)]))


def test_it_is_no_longer_and_does_its_task() -> None:
    result = tight()
    assert length(result) < 0.99 * length(followed())
    error = SETS.linearize(np.arange(len(TIMES)), result)[0]
    assert_allclose(error, 0.0, atol=1e-9)


def test_from_all_along_a_valley_it_leads_to_its_bottom() -> None:
    """Ways up to 2 rad from the cheapest one, which is farther than the postures beside them reach at once."""
    least = length(random_problem())
    for path in (-0.5, -1.0, -1.5):
        assert length(random_problem(slid(path))) == pytest.approx(least, rel=3e-3)


@pytest.mark.parametrize("weight", [1e-4, 1e4])
def test_the_unit_of_the_cost_does_not_matter(weight: float) -> None:
    assert_allclose(random_problem(cost=PathLength(np.full(3, weight))), random_problem(), atol=1e-12)


def test_when_a_motion_begins_does_not_matter_nor_how_long_it_takes() -> None:
    """With the squares of the rates for cost, which is larger in less time, by the same factor everywhere."""
    result = random_problem(cost=SquaredRates(np.ones(3)))
    energies = [float((np.diff(path, axis=0) ** 2).sum()) for path in (result, random_problem(), followed())]
    assert energies[0] < min(energies[1:])
    for times in (TIMES + 1e3, 2.0 * TIMES):
        assert_allclose(random_problem(cost=SquaredRates(np.ones(3)), times=times), result, atol=1e-9)


def test_limits_of_joints_and_of_their_steps_hold_and_are_reached() -> None:
    free = random_problem()
    assert free[:, 1].min() < -1e-3
    assert free[:, 0].max() > 1.1
    for low, high in (((-9.0, 0.2, -9.0), 9.0), (-9.0, (0.9, 9.0, 9.0))):
        kept = random_problem(lower=low, upper=high)
        assert (kept >= np.array(low)).all()
        assert (kept <= np.array(high)).all()
        assert length(free) < length(kept) < length(followed())
        assert min(np.abs(kept - low).min(), np.abs(kept - high).min()) < 0.02
    steps = np.abs(np.diff(free, axis=0)).max(axis=0)
    short = random_problem(far=(1.0, 1.0, 0.9 * steps[2]))
    assert np.abs(np.diff(short, axis=0)).max(axis=0)[2] <= 0.9 * steps[2] + 1e-9
    assert length(free) < length(short) < length(followed())


@pytest.mark.parametrize("later", [0.0, 20.0])
def test_moving_obstacles_collide_at_their_time(later: float) -> None:
    """A ball that is far away while the arm moves, and in its way at other times, before or after 10 s."""
    half = tight()[len(TIMES) // 2]
    beside, away = np.append(middle_of_the_last_link(half), 0.04), np.array([0.0, 0.0, 9.0])
    before, after = (beside, away) if later else (away, beside)
    moving = MovingObstacle(Sphere(0.05, (0, 0, 0)), lambda t: ca.if_else(t < 10.0, ca.DM(before), ca.DM(after)))
    passed = tight(moving, later)
    assert_allclose(passed, tight(Sphere(0.05, away)), atol=1e-12)
    around = CollisionScene(MACHINE, [moving], clearance=CLEARANCE)
    assert distances_along(around, np.zeros(0), passed, TIMES + later).min() > CLEARANCE
    there = CollisionScene(MACHINE, [Sphere(0.05, beside)], clearance=CLEARANCE)
    assert distances_along(there, np.zeros(0), passed, TIMES).min() < 0.0
    past = tight(Sphere(0.05, beside))
    assert distances_along(there, np.zeros(0), past, TIMES).min() > CLEARANCE
    assert length(past) > length(passed)
