"""Paths at a local optimum: closed forms of the cost, no cheaper path nearby, and conditions that fail elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import CollisionScene, FixedBase, Joint, Link, Robot, Sphere
from models.checks import Array
from ocp import TipTask
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.search.lengths import Homogeneous, LargestMotion, PathLength
from ocp.motion.search.shortening import PathProblem, optimality_of, optimise_path, shorten_path
from ocp.motion.search.steps import Steps
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.search.test_tight import (
    CLEARANCE,
    MACHINE,
    TIME_SAMPLES,
    TIMES,
    followed,
    middle_of_the_last_link,
)

COUNT = 30


def slider(kind: Any) -> FixedBase:
    """A slider along x that carries another slider along x, or a link of 1 m that turns about z."""
    links = tuple(Link(name, 1.0) for name in ("base", "carriage", "link", "tip"))
    span: dict[str, Any] = {"lower": -9.0, "upper": 9.0, "velocity": 1.0}
    axis = (1, 0, 0) if kind == "prismatic" else (0, 0, 1)
    joints = (
        Joint("rail", kind="prismatic", parent="base", child="carriage", axis=(1, 0, 0), **span),
        Joint("second", kind=kind, parent="carriage", child="link", axis=axis, **span),
        Joint("flange", kind="fixed", parent="link", child="tip", translation=(1, 0, 0)),
    )
    return FixedBase(Robot(links, joints, tip="tip"))


def along_x(machine: FixedBase, way: float, cost: Homogeneous, upper: Array | None = None) -> PathProblem:
    """The tip moves so far along x from x = 1 m; nothing else is asked."""
    equations = bind(machine, TipTask(position=[1.0], rows=[3]))
    robot, targets = machine.robot, np.zeros((COUNT, 18))
    targets[:, 0] = 1.0 + np.linspace(0.0, way, COUNT)
    space = JointSpace(machine, robot.lower, robot.upper, np.ones(2))
    sets = SelfMotionManifolds(space, equations, targets[:, : equations.target_function().numel_out()])
    samples = [TimeSample(sets, k) for k in range(COUNT)]
    steps = Steps(np.arange(float(COUNT)), cost, np.full((COUNT - 1, 2), 1.0))
    return PathProblem(samples, steps, robot.lower, robot.upper if upper is None else upper, None)


def test_of_two_parallel_sliders_the_lighter_moves_up_to_its_limit() -> None:
    problem = along_x(slider("prismatic"), 1.0, PathLength(np.array([1.0, 3.0])), upper=np.array([0.6, 9.0]))
    share = np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.5, 0.5])
    path = optimise_path(share, replace(problem, lower=np.array([0.0, -9.0])))
    assert problem.cost(path) == pytest.approx(0.6 + 3 * 0.4, rel=1e-9)
    saved, decreases = optimality_of(path, replace(problem, lower=np.array([0.0, -9.0])))
    assert saved <= 1e-9
    assert not decreases
    assert optimality_of(share, problem)[0] > 1e-4


def test_the_largest_motion_of_two_parallel_sliders_is_half_the_distance() -> None:
    problem = along_x(slider("prismatic"), 1.0, LargestMotion(np.ones(2)))
    path = optimise_path(np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.9, 0.1]), problem)
    assert problem.cost(path) == pytest.approx(0.5, rel=1e-9)
    assert optimality_of(path, problem)[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("weight", [0.3, 0.5, 0.8])
def test_a_link_turns_where_that_costs_less_than_its_slider(weight: float) -> None:
    """The tip at p + cos(a): turning by da moves it by sin(a) da at the cost w da, so that it turns where sin(a) > w.

    The cost is w (pi - 2 asin w) for the distance 2 cos(asin w), and 1 for each metre beyond. The optimum is smooth:
    no limit and no kink determines the angles at both ends.
    """
    way, edge = 2.5, np.arcsin(weight)
    problem = along_x(slider("revolute"), way, PathLength(np.array([1.0, weight])))
    angle = np.linspace(2.0, 1.0, COUNT)
    first = np.column_stack([1.0 + np.linspace(0.0, way, COUNT) - np.cos(angle), angle])
    path = optimise_path(first, problem)
    least = weight * (np.pi - 2 * edge) + way - 2 * np.cos(edge)
    assert problem.cost(path) == pytest.approx(least, rel=1e-8)
    assert_allclose([path[0, 1], path[-1, 1]], [np.pi - edge, edge], atol=1e-4)
    saved, decreases = optimality_of(path, problem)
    assert saved <= 1e-7
    assert not decreases
    assert optimality_of(first, problem)[0] > 1e-5


def test_a_link_that_hardly_moves_the_tip_stays_at_rest() -> None:
    problem = along_x(slider("revolute"), 0.5, PathLength(np.array([1.0, 0.5])))
    for angle, optimal in ((0.2, True), (0.5, True), (0.7, False)):
        path = np.column_stack([1.0 + np.linspace(0.0, 0.5, COUNT) - np.cos(angle), np.full(COUNT, angle)])
        assert (optimality_of(path, problem)[0] <= 1e-12) is optimal
        assert (problem.cost(optimise_path(path, problem)) >= 0.5 - 1e-12) is optimal


def test_a_stationary_path_that_is_no_minimum_decreases_to_second_order() -> None:
    """One full turn backwards from where sin(a) = w: to first order neither end saves cost, but the first is a maximum.

    The slider always moves on, so that the cost is w (a_0 - a_N) + way - cos(a_N) + cos(a_0).
    """
    weight, way = 0.5, 8.0
    problem = along_x(slider("revolute"), way, PathLength(np.array([1.0, weight])))
    angle = np.arcsin(weight) + np.linspace(2 * np.pi, 0.0, COUNT)
    path = np.column_stack([1.0 + np.linspace(0.0, way, COUNT) - np.cos(angle), angle])
    saved, decreases = optimality_of(path, problem)
    assert saved <= 1e-9
    assert decreases


@pytest.mark.parametrize("blocked", [False, True])
@pytest.mark.parametrize("cost", [PathLength, LargestMotion])
def test_no_path_near_an_optimised_one_costs_less(cost: Any, blocked: bool) -> None:
    robot, rng = MACHINE.robot, np.random.default_rng(1)
    steps = Steps(TIMES, cost(np.array([1.0, 0.7, 1.3])), np.full((len(TIMES) - 1, 3), 1.0))
    problem = PathProblem(TIME_SAMPLES, steps, robot.lower, robot.upper, None)
    free = optimise_path(shorten_path(followed(), problem, (0.1, 0.01)), problem)
    if blocked:
        beside = np.append(middle_of_the_last_link(free[len(TIMES) // 2]), 0.04)
        scene = CollisionScene(MACHINE, [Sphere(0.05, beside)], clearance=CLEARANCE)
        problem = replace(problem, scene=scene)
    path = optimise_path(shorten_path(followed(), problem, (0.1, 0.01)), problem)
    assert problem.violation(path) <= 1e-9
    assert problem.cost(path) >= problem.cost(free) - 1e-9
    assert optimality_of(path, problem)[0] <= 1e-6 * problem.cost(path)
    tangents = problem.tangents(path, None)
    for size in (1e-3, 1e-4):
        for _ in range(50):
            moved = path + np.einsum("knr,kr->kn", tangents, rng.uniform(-size, size, tangents.shape[::2]))
            moved = problem.project(moved[:, None])[0][:, 0]
            if problem.violation(moved) <= 1e-9:
                assert problem.cost(moved) >= problem.cost(path) * (1 - 1e-7)
