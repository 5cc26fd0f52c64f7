"""Problems of a public benchmark: collisions agree with coal at random configurations and along the paths."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import casadi as ca
import coal
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import CollisionScene, link_frames
from models.checks import Array
from models.shapes.bodies import collision_bodies
from models.shapes.pairs import ALWAYS, NEIGHBOURS, NEVER, RIGID
from ocp import TipTask, inverse_kinematics
from ocp.motion.local.collisions import distances_along
from tests.families import some
from tests.models.shapes.shape_oracles import in_coal
from tests.redundancy_benchmark import PROBLEMS, Benchmark, problem_of

RANDOM, WAYPOINTS, EACH = 150, 6, 8
"""Postures anywhere, and waypoints with so many postures each."""


def configurations(problem: Benchmark) -> Array:
    """Anywhere within limits, and those that put the tip on some waypoints. Shape (M, n)."""
    robot = problem.machine.robot
    rng = np.random.default_rng(0)
    results = [*rng.uniform(np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi), (RANDOM, robot.dof))]
    for k in np.linspace(0, len(problem.positions) - 1, WAYPOINTS).astype(int):
        pose = TipTask(position=problem.positions[k], orientation=problem.quaternions[k])
        results += [each.joints for each in inverse_kinematics(problem.machine, pose, starts=2 * EACH)[:EACH]]
    return np.array(results)


def by_coal(problem: Benchmark, joints: Array) -> dict[frozenset[str], Array]:
    """Distances (M,) of all capsules to each other and to the boxes, by their names; of none that is ignored."""
    robot = problem.machine.robot
    bodies = {body.link: body.shape for body in collision_bodies(robot)}
    boxes = {f"obstacle {k}": box for k, box in enumerate(problem.boxes)}
    listed = {frozenset(pair) for pair in problem.ignored}
    q = ca.SX.sym("q", robot.dof)
    frames = link_frames(robot, q)
    placed = ca.Function("placed", [q], [ca.horzcat(frames[name].rotation, frames[name].position) for name in bodies])
    known = {name: in_coal(shape) for name, shape in (bodies | boxes).items()}
    pairs = [*combinations(bodies, 2), *((name, box) for name in bodies for box in boxes)]
    by_name: dict[frozenset[str], Any] = {frozenset(pair): [] for pair in pairs if frozenset(pair) not in listed}
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    request.gjk_tolerance = 1e-9
    for joint in joints:
        places = {name: place for name, (_, place) in known.items()}
        for name, frame in zip(bodies, map(np.array, placed(joint)), strict=True):
            own, turn = places[name], frame[:, :3]
            places[name] = coal.Transform3s(turn @ own.getRotation(), turn @ own.getTranslation() + frame[:, 3])
        for pair, values in by_name.items():
            one, other = pair
            result.clear()
            values.append(coal.distance(known[one][0], places[one], known[other][0], places[other], request, result))
    return {pair: np.array(values) for pair, values in by_name.items()}


@pytest.mark.parametrize("name", some(PROBLEMS, 2))
def test_collisions_equal_those_of_coal(name: str) -> None:
    problem = problem_of(name)
    around = CollisionScene(problem.machine, problem.boxes, ignored=problem.ignored)
    joints = configurations(problem)
    expected = by_coal(problem, joints)
    base, q = ca.SX(0, 1), ca.SX.sym("q", problem.machine.joint_size)
    exact = np.array(ca.Function("exact", [q], [around.distances(base, q)]).map(len(joints))(joints.T)).T
    seen = distances_along(around, np.zeros(0), joints, np.zeros(len(joints)))
    checked = {frozenset(label) for label in around.labels}
    assert checked <= expected.keys()
    for k, label in enumerate(around.labels):
        by_others = expected[frozenset(label)]
        assert_allclose(exact[:, k], by_others, atol=1e-6)
        apart = by_others > 1e-6
        assert_allclose(seen[apart, k], by_others[apart], atol=1e-6)
        assert np.all(seen[by_others < -1e-6, k] < 0)
    some = {frozenset(pair): why for pair, why in around.excluded.items()}
    for pair in expected.keys() - checked:
        assert some[pair] in (NEIGHBOURS, RIGID, ALWAYS, NEVER, "neither moves")
        assert some[pair] != NEVER or expected[pair].min() > 0
        assert some[pair] != ALWAYS or expected[pair].max() <= 0
    colliding = np.min([expected[pair] for pair in checked], axis=0) < 0
    assert colliding.any()
    assert not colliding.all()
