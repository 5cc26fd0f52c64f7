"""Distances and their gradients: those of all samples of a motion, and of finite differences, in threads, too."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    Box,
    Capsule,
    CollisionScene,
    CollisionShape,
    Cylinder,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Machine,
    Mesh,
    MovingObstacle,
    Sphere,
)
from ocp.motion.local.collisions import distances_along, largest_changes
from tests.models.robot.trees import random_robot
from tests.ocp.motion.tasks.space_tasks import panda
from tests.redundancy_benchmark import problem_of

SIZES = {"sphere": (0.08,), "capsule": (0.05, 0.3), "box": (0.1, 0.2, 0.3), "cylinder": (0.06, 0.3)}


def crowd(seed: int, floating: bool = False) -> CollisionScene:
    """A random tree of joints, slides and followers with bodies of all kinds, among obstacles of all kinds."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 5, followers=True)
    kinds = [*SIZES, *rng.permutation(list(SIZES))]
    links = [
        replace(link, collisions=(CollisionShape(kinds[k % 8], SIZES[kinds[k % 8]], translation=rng.normal(size=3)),))
        for k, link in enumerate(robot.links)
    ]
    robot = replace(robot, links=tuple(links))
    machine: Machine = FreeFloating(robot) if floating else FixedBase(robot)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    obstacles: list[Any] = [
        Sphere(0.2, rng.normal(size=3)),
        Capsule(0.1, rng.normal(size=3), rng.normal(size=3)),
        Box((0.4, 0.3, 0.6), rng.normal(size=3), turn * np.linalg.det(turn)),
        Cylinder(0.2, 0.5, rng.normal(size=3)),
        HalfSpace((0, 0.6, 0.8), (0, 0, -1.0)),
        MovingObstacle(Box((0.2, 0.3, 0.4)), lambda t: (ca.sin(t), 0.3 * t, 0.5)),
    ]
    return CollisionScene(machine, obstacles, limits=False)


def configurations(around: CollisionScene, count: int, seed: int) -> Iterator[tuple[Any, Any, float]]:
    rng, machine = np.random.default_rng(seed), around.machine
    for _ in range(count):
        base = rng.normal(size=machine.base_size)
        if machine.base_size:
            base[3:] /= np.linalg.norm(base[3:])
        yield base, rng.uniform(-1.5, 1.5, machine.joint_size), float(rng.uniform(0, 2))


@pytest.fixture(scope="module")
def few() -> tuple[CollisionScene, list[int], Any]:
    """Some surroundings, pairs of them, and their distances with gradients."""
    around = crowd(3)
    simple = (Sphere, Capsule, Box, HalfSpace)
    pairs = [
        k for k, both in enumerate(around.pairs) if all(isinstance(around.bodies[b].shape, simple) for b in both[:2])
    ]
    return around, pairs, around.distance_gradients(pairs=pairs, rounding=0.02)


def test_gradients_are_finite_differences_of_distances(few: tuple[CollisionScene, list[int], Any]) -> None:
    """Along random rates, but for kinks, which are rare: there the differences of two steps do not agree."""
    around, _, function = few
    rng, kept = np.random.default_rng(4), 0
    for base, q, time in configurations(around, 10, 4):
        rates = rng.normal(size=len(q))

        def apart(step: float, *, base: Any = base, q: Any = q, time: float = time, rates: Any = rates) -> Any:
            return np.array(function(base, q + step * rates, time)[0]).ravel()

        rough, fine = ((apart(h) - apart(-h)) / (2 * h) for h in (2e-5, 1e-5))
        sure = np.abs(rough - fine) < 1e-7
        kept += sure.sum()
        slopes = np.array(function(base, q, time)[1]) @ rates
        np.testing.assert_allclose(slopes[sure], fine[sure], atol=1e-6)
    assert kept > 8 * len(rough)


def test_distances_along_a_motion_are_those_of_its_samples(few: tuple[CollisionScene, list[int], Any]) -> None:
    """However many there are: they are measured side by side, and what is left over one by one."""
    around, pairs, _ = few
    known = around.distance_gradients(pairs=pairs)
    for count in (3, 64, 150):
        samples = list(configurations(around, count, count))
        base, joints, times = (np.array(part) for part in zip(*samples, strict=True))
        result = distances_along(around, base, joints, times)
        np.testing.assert_allclose(
            result[:, pairs].T, np.hstack([np.array(known(*one)[0]) for one in samples]), atol=1e-9
        )


def limited_crowd(seed: int) -> CollisionScene:
    """The same among fixed obstacles, with slides that move by at most five metres from zero."""
    around = crowd(seed)
    robot = around.machine.robot
    limited = [replace(joint, lower=-5.0, upper=5.0) if joint.kind == "prismatic" else joint for joint in robot.joints]
    return CollisionScene(FixedBase(replace(robot, joints=tuple(limited))), around.obstacles[:-1])


def crowded_panda() -> CollisionScene:
    """A Panda, whose links have meshes that smaller shapes cover, among boxes."""
    return CollisionScene(panda(), [Box((0.2, 0.3, 0.4), (0.4, 0.3, 0.5)), Box((0.3, 0.2, 0.2), (-0.2, 0.1, 0.9))])


@pytest.mark.parametrize("seed", [*range(12), None])
@pytest.mark.parametrize("size", [1, 2])
def test_distances_change_no_more_than_bounded(seed: int | None, size: int) -> None:
    """From the middle of boxes of displacements to random points and corners of them, of all pairs, near and far.

    The depths of overlapping cylinders and meshes are estimates, of which nothing follows.
    """
    around, rng = crowded_panda() if seed is None else limited_crowd(seed), np.random.default_rng(seed)
    robot, hulls = around.machine.robot, [type(body.shape) for body in around.bodies]
    estimated = np.array([bool({hulls[k] for k in pair[:2]} & {Cylinder, Mesh}) for pair in around.pairs])
    n, count = robot.dof, 8
    middle = rng.uniform(np.maximum(robot.lower, -2.0) + 0.5, np.minimum(robot.upper, 2.0) - 0.5, (count, n))
    tangents = np.linalg.qr(rng.normal(size=(count, n, min(size, n))))[0]
    reach, rest = 10 ** rng.uniform(-3, -0.5, tangents.shape[::2]), 10 ** rng.uniform(-5, -2, (count, n))
    at, pair = (index.ravel() for index in np.indices((count, len(around.pairs))))
    bounds = largest_changes(around, middle, at, pair, box=(tangents, reach, rest)).reshape(count, -1)
    first = distances_along(around, np.zeros(0), middle, np.zeros(count))
    for k in range(20):
        shares = rng.uniform(-1, 1, (2, count, n)) if k % 2 else rng.choice([-1.0, 1.0], (2, count, n))
        moved = middle + np.einsum("kna,ka->kn", tangents, reach * shares[0][:, : tangents.shape[2]])
        last = distances_along(around, np.zeros(0), moved + rest * shares[1], np.zeros(count))
        exact = np.where(estimated, np.minimum(first, last) >= 0, True)
        assert (np.abs(last - first) <= bounds + 1e-9)[exact].all()


def test_a_self_motion_that_leaves_the_hand_in_place_changes_its_distances_to_second_order() -> None:
    """Of a Panda whose links are capsules. Levers would add the speeds of all joints up."""
    problem = problem_of("panda__flappy_bird")
    around = CollisionScene(problem.machine, problem.boxes, ignored=problem.ignored)
    q, symbols = np.array([[0.3, -0.5, 0.2, -2.0, 0.4, 1.8, 0.5]]), ca.SX.sym("q", 7)
    pose = problem.machine.tip_pose((), symbols)
    columns = ca.vertcat(pose.position, ca.vec(pose.rotation))
    tangent = np.linalg.svd(np.array(ca.Function("rates", [symbols], [ca.jacobian(columns, symbols)])(q[0])))[2][-1]
    pair = np.array([around.labels.index(("panda_hand", "obstacle 0"))])
    for reach, share in ((1e-3, 0.01), (0.1, 1.0)):
        box = tangent[None, :, None], np.full((1, 1), reach), np.zeros((1, 7))
        bound = largest_changes(around, q, np.zeros(1, dtype=int), pair, box=box)[0]
        ends = q + np.outer((0.0, -reach, reach), tangent)
        distances = distances_along(around, np.zeros(0), ends, np.zeros(3))[:, pair[0]]
        assert 0 < np.abs(distances - distances[0]).max() <= bound
        assert bound < share * reach * float(around.levers.joints[pair[0]] @ np.abs(tangent))


def test_values_that_are_no_numbers_stay_undefined(few: tuple[CollisionScene, list[int], Any]) -> None:
    around, pairs, function = few
    q = np.zeros(around.machine.joint_size)
    q[0] = np.nan
    joints = ca.SX.sym("q", len(q))
    distances = ca.Function("distances", [joints], [around.distances(ca.DM(0, 1), joints, pairs=pairs, rounding=0.02)])
    values, slopes = (np.array(part) for part in function((), q, 0.0))
    lost = np.isnan(np.array(distances(q))).ravel()
    assert lost.any()
    assert np.isnan(values.ravel()[lost]).all()
    assert np.isnan(slopes[lost]).any(axis=1).all()


def test_threads_may_call_it_at_once(few: tuple[CollisionScene, list[int], Any]) -> None:
    around, _, function = few
    mapped = function.map(100)
    lots = [list(configurations(around, 100, seed)) for seed in range(4)]
    options = [[np.array(part).T.reshape(-1, 100) for part in zip(*lot, strict=True)] for lot in lots]
    known = [mapped.call(each) for each in options]
    with ThreadPoolExecutor(4) as pool:
        for result, one in zip(pool.map(mapped.call, options * 5), known * 5, strict=True):
            for part, other in zip(result, one, strict=True):
                np.testing.assert_array_equal(np.array(part), np.array(other))
