"""Straight motions that are proven clear, beside closed forms and beside coal."""

from __future__ import annotations

import numpy as np
import pytest

from models import Box, Capsule, CollisionScene, Cylinder, FixedBase, HalfSpace, Sphere
from models.checks import Array
from models.examples import example_robot
from models.shapes.shapes import Shape
from ocp.motion.local.collisions import distances_along
from ocp.motion.sampling.joint_paths import StraightMotions
from tests.ocp.motion.sampling.sliders import gap, slider


def ends(random: np.random.Generator, count: int, axes: int) -> tuple[Array, Array]:
    return random.uniform(-2, 2, (count, axes)), random.uniform(-2, 2, (count, axes))


@pytest.mark.parametrize("seed", range(4))
def test_motions_of_a_ball_are_clear_as_the_closed_form_says(seed: int) -> None:
    random = np.random.default_rng(seed)
    boxes = [Box(random.uniform(0.1, 0.8, 3), random.uniform(-1.5, 1.5, 3)) for _ in range(4)]
    starts, stops = ends(random, 150, 3)
    clear = StraightMotions(CollisionScene(slider(3), boxes)).are_clear(starts, stops)
    shares = np.linspace(0.0, 1.0, 4001)[:, None]
    for proven, start, stop in zip(clear, starts, stops, strict=True):
        least = gap(start + shares * (stop - start), boxes).min()
        if abs(least) > 1e-3 * np.linalg.norm(stop - start):
            assert proven == (least > 0)
    assert 10 < clear.sum() < 140


@pytest.mark.parametrize("clearance", [0.0, 0.05])
def test_a_motion_beside_a_wall_is_decided_by_a_micrometre(clearance: float) -> None:
    wall = HalfSpace((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    motions = StraightMotions(CollisionScene(slider(), [wall], clearance))
    for height, is_clear in ((0.1 + clearance + 1e-6, True), (0.1 + clearance - 2e-6, False)):
        motion = np.array([[-2.0, height]]), np.array([[2.0, height]])
        assert motions.are_clear(*motion)[0] == is_clear


def test_no_sample_of_a_proven_motion_of_an_arm_collides_and_motions_far_away_are_proven() -> None:
    machine, random = FixedBase(example_robot("six_axis")), np.random.default_rng(0)
    shapes: list[Shape] = [
        Box((0.3, 0.3, 0.3), (0.4, 0.2, 0.5)), Sphere(0.15, (-0.4, 0.3, 0.6)), Cylinder(0.05, 1.2, (0.3, -0.5, 0.6)),
        Capsule(0.05, (-0.3, -0.5, 0.0), (-0.3, -0.5, 1.0)),
    ]  # fmt: skip
    scene = CollisionScene(machine, shapes)
    robot = machine.robot
    starts = random.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3), (60, robot.dof))
    stops = np.clip(starts + random.normal(size=starts.shape) * 0.3, robot.lower, robot.upper)
    clear = StraightMotions(scene).are_clear(starts, stops)
    assert 3 < clear.sum() < 57
    for proven, start, stop in zip(clear, starts, stops, strict=True):
        joints = start + np.linspace(0.0, 1.0, 301)[:, None] * (stop - start)
        least = distances_along(scene, np.zeros(0), joints, np.zeros(301), cutoff=0.02).min()
        assert least >= -1e-6 if proven else least < 0.01


def test_gradients_of_near_pairs_predict_distances() -> None:
    random = np.random.default_rng(3)
    boxes = [Box((0.5, 0.5, 0.5), (0.0, 0.0, 0.0))]
    motions = StraightMotions(CollisionScene(slider(3), boxes))
    joints = random.uniform(-0.6, 0.6, (50, 3))
    at, _, distance, gradient = motions.near_pairs(joints, 0.2)
    np.testing.assert_allclose(distance, gap(joints[at], boxes), atol=1e-9)
    outside = distance > -0.09
    step = 1e-4 * random.normal(size=3)
    np.testing.assert_allclose((distance + gradient @ step)[outside], gap(joints[at] + step, boxes)[outside], atol=1e-6)


def test_without_a_scene_everything_is_clear() -> None:
    motions = StraightMotions(None)
    assert motions.are_clear(np.zeros((2, 3)), np.ones((2, 3))).all()
    assert motions.collisions(np.zeros(3)) == []
    assert motions.near_pairs(np.zeros((2, 3)), 1.0)[2].size == 0
