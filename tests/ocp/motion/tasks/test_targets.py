"""Laws of the nodes that a mesh needs to follow the targets of tasks along paths of many segments."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from models import FixedBase, SmoothPath, planar_chain, smooth
from models.checks import Array
from models.paths import Arc, Helix, Line, Path
from ocp import TipTask, plan
from ocp.curves import lagrange
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.tasks.equations import TaskEquations, bind, task_errors
from ocp.motion.tasks.targets import NODES, required_nodes, resolving_times

SPEED = 0.1  # m/s
MACHINE = FixedBase(planar_chain([0.5, 0.4, 0.3], [1.0, 1.0, 1.0]))


def circle(count: int) -> SmoothPath:
    """Three quarters of a circle about (0.6, 0.2, 0) m in the plane of the arm, in equal arcs."""
    sweep, center = 1.5 * np.pi / count, np.array([0.6, 0.2, 0.0])
    starts = [center + 0.15 * np.array([np.cos(a), np.sin(a), 0.0]) for a in sweep * np.arange(count)]
    return smooth(Path(tuple(Arc(start, center, [0.0, 0.0, 1.0], sweep) for start in starts)), deviation=1e-5)


def along(path: SmoothPath) -> tuple[TipTask, TaskEquations, Array]:
    """A task along a path in the plane of the arm, its equations, and the times where segments meet."""
    task = TipTask.along(path, SPEED, steady=True, rows=(3, 4))
    return task, bind(MACHINE, task), np.asarray(task.breaks)


def test_nodes_depend_on_the_shape_of_a_path_and_not_on_its_segments() -> None:
    counts = {}
    for count in (20, 100, 500):
        _, equations, breaks = along(circle(count))
        counts[count] = len(required_nodes(equations, breaks))
    assert counts[500] <= counts[100] <= counts[20] < 12
    assert counts[500] > 3


def test_between_nodes_interpolants_follow_the_targets_at_every_place() -> None:
    _, equations, breaks = along(circle(200))
    nodes, points = required_nodes(equations, breaks), np.array([*np.polynomial.legendre.leggauss(7)[0]]) / 2 + 0.5
    targets = equations.target_function()
    for first, last in pairwise(nodes):
        share = np.random.default_rng(0).uniform(size=400)
        fit, exact = (np.array(targets.map(len(x))((first + (last - first) * x)[None])).T for x in (points, share))
        error = np.abs(lagrange(points, share) @ fit - exact)
        assert error[:, :3].max() < 2 * NODES.pose_error
        assert error[:, 3:].max() < 2 * NODES.rate_error * SPEED


def test_a_corner_has_nodes_where_it_begins_and_ends() -> None:
    corners = np.array([[0.5, 0.1, 0.0], [0.7, 0.1, 0.0], [0.7, 0.3, 0.0], [0.5, 0.3, 0.0], [0.5, 0.4, 0.0]])
    lines = [Line(a + (b - a) * k / 20, a + (b - a) * (k + 1) / 20) for a, b in pairwise(corners) for k in range(20)]
    path = smooth(Path(tuple(lines)), deviation=1e-3)
    _, equations, breaks = along(path)
    nodes = required_nodes(equations, breaks)
    turns = np.abs(path.curvature(path.bounds[:-1] + path.piece_lengths / 2)) > 1.0
    ends = np.concatenate([breaks[:-1][turns], breaks[1:][turns]])
    assert turns.sum() == 3
    assert np.isin(ends, nodes).all()
    assert len(nodes) <= len(breaks) / 3


def test_tasks_of_a_velocity_and_few_segments_keep_all_breaks() -> None:
    breaks = np.linspace(0.0, 1.0, 31)
    task = TipTask(rows=(3, 4), velocity=(0.1, 0.0), duration=1.0, breaks=breaks)
    np.testing.assert_array_equal(required_nodes(bind(MACHINE, task), breaks), breaks)
    few, _, ends = along(circle(4))
    (stretch,) = stretches_of(MACHINE, [few], float(few.duration or 0.0))
    np.testing.assert_array_equal(stretch.nodes, ends[1:-1])


def test_targets_are_nearly_linear_between_the_steps_of_a_local_motion() -> None:
    helix = smooth(Path((Helix((0.7, 0.2, 0), (0.6, 0.2, 0), (0, 0, 1), 40.0, 0.0),)), deviation=1e-5)
    _, equations, breaks = along(helix)
    times = resolving_times(equations, np.linspace(0.0, breaks[-1], 9))
    targets = equations.target_function()
    ends, inside = (np.array(targets.map(len(t))(t[None]))[:3].T for t in (times, (times[:-1] + times[1:]) / 2))
    chords = np.linalg.norm(inside - (ends[:-1] + ends[1:]) / 2, axis=1)
    assert chords.max() <= NODES.chord_error * np.sqrt(2)
    assert chords.max() > NODES.chord_error / 8  # not finer than necessary
    still = TipTask(rows=(3, 4), velocity=(0.1, 0.0), duration=1.0)
    np.testing.assert_array_equal(resolving_times(bind(MACHINE, still), breaks), breaks)


@pytest.mark.long
def test_a_path_of_a_thousand_segments_is_planned_as_one_of_ten() -> None:
    costs = []
    for count in (10, 1000):
        task, _, breaks = along(circle(count))
        motion = plan(MACHINE, task, scene=False)
        assert motion.audit().passed
        times = np.union1d(breaks, np.linspace(0.0, breaks[-1], 5001))
        errors = task_errors(MACHINE, task, times, motion.at(times)["joints"])
        assert np.abs(errors).max() < 1e-5
        costs.append(motion.cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-4)
