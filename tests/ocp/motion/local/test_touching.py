"""Distances at samples of a motion: those of the formulas, whatever balls are looked at first, and what touches."""

from __future__ import annotations

from typing import Any

import casadi as ca
import coal
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import (
    Box,
    CollisionScene,
    CollisionShape,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Joint,
    Link,
    Machine,
    MovingObstacle,
    Robot,
    Sphere,
)
from models.checks import Array
from models.shapes.distance import COLUMNS
from models.shapes.mesh_files import find_mesh, read_mesh
from models.spatial import skew
from ocp import ProblemError
from ocp.motion.local.collisions import (
    checked_collision_scene,
    distances_along,
    find_collisions,
    scene_hulls,
    worst_collisions,
)  # fmt: skip
from tests.models.machines.armoured import armoured_arm
from tests.models.machines.test_collision_scene import OBSTACLES, configurations, machines, turned
from tests.ocp.motion.tasks.space_tasks import panda, ur5

MOVING = MovingObstacle(OBSTACLES[1], lambda t: (0.3, 0.2 * t, 0.2), lambda t: turned(t))
TIMES = np.linspace(0.0, 3.0, 30)


def known(around: CollisionScene, base: Array, joints: Array) -> Array:
    """By the expression, one sample after the other. Shape (M, n)."""
    machine = around.machine
    b, q, t = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("t")
    function = ca.Function("distances", [b, q, t], [around.distances(b, q, t)])
    return np.array([np.array(function(*each)).ravel() for each in zip(base, joints, TIMES, strict=True)])


def by_formula(around: CollisionScene) -> Array:
    """Whether a pair is of shapes whose distances are exact. Shape (n,)."""
    return np.array([all(type(around.bodies[k].shape) in COLUMNS for k in pair[:2]) for pair in around.pairs])


@pytest.mark.parametrize("name", machines())
def test_distances_along_a_motion_are_those_of_the_expression(name: str) -> None:
    """Of the kinds with a formula; beside the others, meshes and cylinders, no less than its bound from below."""
    around = CollisionScene(machines()[name], (*OBSTACLES, MOVING))
    base, joints = configurations(around.machine, len(TIMES), 3)
    result, report, exact = (
        distances_along(around, base, joints, TIMES),
        known(around, base, joints),
        by_formula(around),
    )
    assert_allclose(result[:, exact], report[:, exact], atol=1e-9)
    assert (result >= report - 1e-9)[result > 0].all()
    assert exact.sum() > 8


def test_boxes_that_overlap_are_as_deep_as_the_formula_says() -> None:
    """A box that tumbles about its diagonal where another one slides."""
    axis = skew(ca.DM([1, 1, 1]) / np.sqrt(3))

    def tumbling(t: Any) -> Any:
        return ca.DM.eye(3) + ca.sin(t) * axis + (1 - ca.cos(t)) * ca.mtimes(axis, axis)

    around = CollisionScene(
        machines()["slider"], [MovingObstacle(Box((0.3, 0.2, 0.25)), lambda t: (0.1, 0.1, 0.25), tumbling)]
    )
    base, joints = configurations(around.machine, len(TIMES), 7)
    joints[:, 0] = np.linspace(-0.1, 0.3, len(TIMES))
    result, report = distances_along(around, base, joints, TIMES), known(around, base, joints)
    boxes = [all(isinstance(around.bodies[k].shape, Box) for k in pair[:2]) for pair in around.pairs]
    assert (result[:, boxes] < -0.05).sum() > 10
    assert_allclose(result[:, boxes], report[:, boxes], atol=1e-9)


def test_long_boxes_that_cross_edge_by_edge_are_as_deep_as_the_formula_says() -> None:
    """Square to each other, each turned about its length, and far from their middles."""
    ends: dict[str, Any] = {"lower": -1.0, "upper": 1.0}
    angles = [np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]) for a in (0.5, 0.4)]
    across = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    beam = CollisionShape("box", (2.0, 0.2, 0.3), rotation=angles[0])
    slide = Joint("slide", "prismatic", "base", "beam", axis=(1, 0, 0), **ends)
    machine = FixedBase(Robot((Link("base"), Link("beam", collisions=(beam,))), (slide,)))
    around = CollisionScene(machine, [Box((2.0, 0.3, 0.25), (0.1, 0.6, 0.33), across @ angles[1])])
    joints = np.linspace(-0.8, 0.8, len(TIMES))[:, None]
    result = distances_along(around, np.zeros(0), joints, TIMES)
    assert_allclose(result, known(around, np.zeros((len(TIMES), 0)), joints), atol=1e-9)
    assert -0.05 < result.min() < -0.01


@pytest.mark.parametrize("near", [-0.2, 0.0, 0.1, 0.5])
def test_distances_that_are_not_small_are_bounded_from_both_sides(near: float) -> None:
    """From the least that is asked for up to the distance; what is nearer is exact."""
    around = CollisionScene(machines()["slider"], (*OBSTACLES, MOVING, HalfSpace((3, 0, 4), (0.2, 0.1, 0.3))))
    base, joints = configurations(around.machine, len(TIMES), 4)
    exact = distances_along(around, base, joints, TIMES)
    result = distances_along(around, base, joints, TIMES, cutoff=near)
    below = exact < near
    assert_allclose(result[below], exact[below], atol=1e-12)
    assert (result[~below] >= near).all()
    assert (result <= exact + 1e-12).all()
    assert near <= 0 or below.any()
    assert (result < exact - 1e-3).any()  # and not all of them were worked out


def test_colliding_pairs_are_named_at_their_deepest_points_in_order() -> None:
    around = CollisionScene(machines()["arm"], (*OBSTACLES, MOVING), clearance=0.05)
    base, joints = configurations(around.machine, len(TIMES), 5)
    apart = distances_along(around, base, joints, TIMES)
    result = find_collisions(around, base, joints, TIMES)
    assert [contact.pair for contact in result] == np.argsort(apart.min(axis=0))[: len(result)].tolist()
    assert len(result) == (apart.min(axis=0) < 0.05).sum() > 2
    for contact in result:
        assert contact.bodies == around.labels[contact.pair]
        assert contact.distance == pytest.approx(apart[:, contact.pair].min(), abs=1e-12)
        assert contact.time == TIMES[apart[:, contact.pair].argmin()]
        assert ("overlap by" if contact.distance < 0 else "apart") in str(contact)
        assert f"{abs(contact.distance):.3g} m" in str(contact)


@pytest.mark.parametrize("name", machines())
def test_the_worst_collision_of_each_sample_is_the_one_found_alone(name: str) -> None:
    around = CollisionScene(machines()[name], (*OBSTACLES, MOVING), clearance=0.05)
    base, joints = configurations(around.machine, len(TIMES), 5)
    worst = worst_collisions(around, base, joints, TIMES)
    assert any(worst)
    for k, collision in enumerate(worst):
        alone = find_collisions(around, base[k : k + 1], joints[k : k + 1], TIMES[k : k + 1])
        assert (collision is None) == (not alone)
        if collision is not None:
            assert (collision.pair, collision.bodies, collision.time) == (alone[0].pair, alone[0].bodies, TIMES[k])
            assert_allclose(
                [collision.distance, collision.protrusion], [alone[0].distance, alone[0].protrusion], atol=1e-12
            )
    assert worst_collisions(around, base[:0], joints[:0], TIMES[:0]) == []


def test_one_base_or_time_for_all_samples_is_that_base_or_time_at_each() -> None:
    around = CollisionScene(FreeFloating(armoured_arm(4)), (*OBSTACLES, MOVING))
    base, joints = configurations(around.machine, len(TIMES), 6)
    same = np.tile(base[0], (len(TIMES), 1))
    each = distances_along(around, same, joints, TIMES)
    assert_allclose(distances_along(around, base[0], joints, TIMES), each)
    assert np.ptp(each, axis=0).max() > 0.1
    shared = distances_along(around, base, joints, TIMES[2])
    assert_allclose(shared, distances_along(around, base, joints, np.full(len(TIMES), TIMES[2])))
    assert np.abs(shared - distances_along(around, base, joints, TIMES)).max() > 0.01


def test_without_pairs_there_are_no_distances_and_nan_counts_as_collision() -> None:
    bare = CollisionScene(FixedBase(armoured_arm(2)))
    assert distances_along(bare, np.zeros(0), np.zeros((3, 2)), np.zeros(3)).shape == (3, 0)
    assert find_collisions(bare, np.zeros(0), np.zeros((3, 2)), np.zeros(3)) == []
    arm = FixedBase(armoured_arm())
    lost = CollisionScene(arm, [Sphere(0.1, (0.5, 0, 0))])
    assert find_collisions(lost, np.zeros(0), np.full((1, 7), np.nan), np.zeros(1))[0].distance == -np.inf


def test_the_hulls_are_the_bodies() -> None:
    around = CollisionScene(FixedBase(armoured_arm()), OBSTACLES)
    hulls = scene_hulls(around)
    assert list(hulls) == [body.name for body in around.bodies]
    for hull, body in zip(hulls.values(), around.bodies, strict=True):
        assert (hull.frame, hull.radius) == (body.frame, body.shape.swept_radius)
        assert_allclose(hull.core, body.shape.core)
        assert hull.normal.size == (3 if isinstance(body.shape, HalfSpace) else 0)


def test_the_scene_contains_the_machine_with_its_limits() -> None:
    machine: Machine = FixedBase(armoured_arm())
    kept, free = CollisionScene(machine, limits=True), CollisionScene(machine, limits=False)
    assert checked_collision_scene(kept, machine) is kept
    assert checked_collision_scene(free, machine, limits=False) is free
    bad: list[Any] = [(kept, FixedBase(armoured_arm()), True), (kept, machine, False)]
    for around, owner, limits in bad:
        with pytest.raises(ProblemError) as caught:
            checked_collision_scene(around, owner, limits)
        assert caught.value.name == "scene"


def triangles(machine: FixedBase, link: str) -> Any:
    """The meshes of a link by coal, in its frame."""
    model = coal.BVHModelOBBRSS()
    model.beginModel(0, 0)
    for shape in machine.robot.link(link).collisions:
        if shape.kind != "mesh":
            continue
        path = find_mesh(shape.file, shape.folder or None, [])
        assert path is not None
        vertices, faces = read_mesh(path)
        for corners in (vertices * shape.size @ np.array(shape.rotation).T + shape.translation)[faces]:
            model.addTriangle(*corners)
    model.endModel()
    return model


@pytest.mark.long
def test_meshes_are_no_nearer_than_their_hulls_and_covers_say() -> None:
    """Beside their triangles by coal: both are bounds from below, the larger is told, and what is held is told."""
    seen, hollow = np.sum([beside_triangles(machine) for machine in (ur5(), panda())], axis=0)
    assert seen > 60
    assert hollow > 5  # where covers are farther apart than hulls


def beside_triangles(machine: FixedBase) -> tuple[int, int]:
    """How many pairs of hulls in random postures are looked at, and how many of them are held as far as is told."""
    around = CollisionScene(machine)
    assert around.covers
    rng = np.random.default_rng(3)
    low, high = np.maximum(machine.robot.lower, -np.pi), np.minimum(machine.robot.upper, np.pi)
    joints = rng.uniform(low, high, (1000, machine.joint_size))
    pairs = [pair for pair in around.covers if all(" hull " in label for label in around.labels[pair])]
    report = distances_along(around, np.zeros(0), joints, np.zeros(len(joints)))[:, pairs]
    near = np.flatnonzero(((report > 0) & (report < 0.03)).any(axis=1))[:40]
    joints, report = joints[near], report[near]
    q = ca.SX.sym("q", machine.joint_size)
    places = ca.Function("places", [q], [around.placements((), q)])
    held = ca.Function("held", [q], [around.distances((), q, pairs=pairs)])
    meshes = {name: triangles(machine, name.split(" hull ")[0]) for pair in pairs for name in around.labels[pair]}
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    seen, hollow = 0, 0
    for at, apart in zip(joints, report, strict=True):
        frames = np.array(places(at)).reshape(-1, 4, 3)
        least = np.array(held(at)).ravel()
        assert (np.minimum(least, 0.0) <= apart + 1e-9).all()  # what is held apart is apart
        for k, pair in enumerate(pairs):
            if not 0 < apart[k] < 0.03:
                continue
            sides: list[Any] = []
            for body in around.pairs[pair, :2]:
                turn, shift = frames[around.bodies[body].frame, :3].T, frames[around.bodies[body].frame, 3]
                sides += [meshes[around.bodies[body].name], coal.Transform3s(turn, shift)]
            result.clear()
            true = coal.distance(*sides, request, result)
            assert apart[k] <= true + 1e-7
            seen += 1
            hollow += bool(least[k] > apart[k] - 1e-9)
    return seen, hollow
