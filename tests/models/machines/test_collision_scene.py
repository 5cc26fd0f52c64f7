"""Collision scenes: distances against an independent method, and bounds of the relative motion of pairs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import (
    Box,
    Capsule,
    CollisionScene,
    CollisionShape,
    Cylinder,
    FixedBase,
    FreeFloating,
    HalfSpace,
    Joint,
    Link,
    Mesh,
    Mimic,
    ModelError,
    MovingObstacle,
    Robot,
    Sphere,
    link_frames,
)
from models.shapes.distance import distance
from models.shapes.hull import convex_hull, gap_along, nearest_directions
from ocp.motion.local.collisions import distances_along, find_collisions
from tests.models.machines.armoured import armoured_arm

OBSTACLES = (
    Sphere(0.1, (0.5, 0.1, 0.5)),
    Box((0.2, 0.3, 0.1), (-0.5, 0.2, 0.4)),
    Capsule(0.05, (0.3, -0.4, 0.1), (0.3, -0.4, 0.9)),
    HalfSpace((0, 0, 1), (0, 0, -0.4)),
)


def slider() -> Robot:
    """A slide, an arm on it, and a gripper whose fingers move together."""
    tube = CollisionShape("capsule", (0.05, 0.3), translation=(0, 0, 0.2))
    block = CollisionShape("box", (0.1, 0.2, 0.1))
    links = [Link(name, 1.0, inertia=np.eye(3) * 0.01, collisions=(shape,)) for name, shape in
             (("base", block), ("sled", block), ("arm", tube), ("left", tube), ("right", tube))]  # fmt: skip
    joints = [
        Joint("rail", "prismatic", "base", "sled", axis=(1, 0, 0), translation=(0, 0, 0.3), lower=-0.5, upper=0.7),
        Joint("shoulder", "revolute", "sled", "arm", axis=(0, 1, 0), translation=(0, 0, 0.2), lower=-2, upper=2),
        Joint("finger", "revolute", "arm", "left", axis=(1, 0, 0), translation=(0, 0.1, 0.5), lower=-1, upper=1),
        Joint("other", "revolute", "arm", "right", axis=(1, 0, 0), translation=(0, -0.1, 0.5), lower=-2, upper=2,
              mimic=Mimic("finger", -1.5, 0.1)),
    ]  # fmt: skip
    return Robot(tuple(links), tuple(joints), tip="left")


def machines() -> dict[str, Any]:
    return {
        "arm": FixedBase(armoured_arm(), translation=(0.1, 0, 0)),
        "slider": FixedBase(slider()),
        "space": FreeFloating(armoured_arm(4)),
    }


def configurations(machine: Any, count: int, seed: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    low, high = np.clip(machine.robot.lower, -3, 3), np.clip(machine.robot.upper, -3, 3)
    base = rng.normal(size=(count, machine.base_size))
    if machine.base_size == 7:
        base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1)[:, None]
    return base, rng.uniform(low, high, size=(count, machine.joint_size))


def points_of(scene: CollisionScene, machine: Any) -> Any:
    """Return a CasADi Function (base, q, time) -> points of each pair in its reference frame."""
    base, q, t = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("t")
    frames = ca.reshape(scene.placements(base, q, t), 12, -1)
    results = []
    for one, other, seen in scene.pairs:
        turn, origin = (ca.SX.eye(3), ca.SX(3, 1))
        if seen >= 0:
            turn, origin = ca.reshape(frames[:9, seen], 3, 3), frames[9:, seen]
        sides = []
        for body in (scene.bodies[one], scene.bodies[other]):
            core = ca.DM(body.shape.core.T)
            if body.frame >= 0:
                own = ca.reshape(frames[:9, body.frame], 3, 3)
                core = ca.mtimes(own, core) + ca.repmat(frames[9:, body.frame], 1, core.shape[1])
            sides.append(ca.mtimes(turn.T, core - ca.repmat(origin, 1, core.shape[1])))
        results.append([ca.densify(side) for side in sides])
    return ca.Function("points", [base, q, t], [part for pair in results for part in pair])


@pytest.mark.parametrize("name", machines())
def test_distances_are_those_of_the_hulls(name: str) -> None:
    machine = machines()[name]
    scene = CollisionScene(machine, OBSTACLES)
    assert len(scene.pairs) >= 8
    base, q, t = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("t")
    exact = ca.Function("exact", [base, q, t], [scene.distances(base, q, t)])
    rounded = ca.Function("rounded", [base, q, t], [scene.distances(base, q, t, rounding=1e-3)])
    points = points_of(scene, machine)
    for b, j in zip(*configurations(machine, 40, 1), strict=True):
        report, below = np.array(exact(b, j, 0.0)).ravel(), np.array(rounded(b, j, 0.0)).ravel()
        assert np.all(below <= report + 1e-9)
        sides = [np.array(part).T for part in points(b, j, 0.0)]
        for i, (one, other, _) in enumerate(scene.pairs):
            a, c = sides[2 * i][None], sides[2 * i + 1][None]
            shapes = scene.bodies[one].shape, scene.bodies[other].shape
            radii = shapes[0].swept_radius + shapes[1].swept_radius
            path = -shapes[1].normal[None] if isinstance(shapes[1], HalfSpace) else nearest_directions(a, c)[0]
            gap = gap_along(path, a, c)[0]
            if any(isinstance(shape, Cylinder) for shape in shapes):  # of which the distance is a bound from below
                assert report[i] <= gap - radii + 1e-7
            elif gap > 1e-6 or isinstance(shapes[1], HalfSpace):
                assert_allclose(report[i], gap - radii, atol=1e-7)
            else:
                assert report[i] <= 1e-6 - radii


@pytest.mark.parametrize("name", machines())
def test_no_point_moves_or_bends_by_more_than_its_levers_say(name: str) -> None:
    machine = machines()[name]
    scene = CollisionScene(machine, OBSTACLES[:2])
    levers = scene.levers
    lever = np.hstack([levers.base, levers.joints])
    turn = np.hstack([levers.base_turns, levers.joint_turns])
    x = ca.SX.sym("x", machine.base_size + machine.joint_size)
    r, s = ca.SX.sym("r", x.numel()), ca.SX.sym("s", x.numel())
    parts = points_of(scene, machine)(x[: machine.base_size], x[machine.base_size :], 0.0)
    first = [ca.jtimes(ca.vec(part), x, r) for part in parts]
    second = [ca.jtimes(part, x, r) + ca.jtimes(part, r, s) for part in first]
    moved = ca.Function("moved", [x, r, s], [ca.reshape(part, 3, -1) for part in (*first, *second)])
    rng = np.random.default_rng(5)
    base, q = configurations(machine, 60, 2)
    tight = 0.0
    for at in np.hstack([base, q]):
        rate, push = rng.normal(size=(2, len(at))) * rng.choice([0.0, 1.0], size=len(at))
        if machine.base_size:  # a unit quaternion stays one
            unit = at[3:7]
            rate[3:7] -= unit * (unit @ rate[3:7])
            push[3:7] -= unit * (unit @ push[3:7] + rate[3:7] @ rate[3:7])
        matches = [np.linalg.norm(np.array(part), axis=0).max() for part in moved(at, rate, push)]
        speeds, bends = np.array(matches[: len(parts)]), np.array(matches[len(parts) :])
        slow = lever @ np.abs(rate)
        most = lever @ np.abs(push) + 2 * (turn @ np.abs(rate)) * slow
        # of a swelling nothing is seen here; the core's points move less than it says
        assert np.all(speeds.reshape(-1, 2).sum(axis=1) <= slow + 1e-9)
        assert np.all(bends.reshape(-1, 2).sum(axis=1) <= most + 1e-9)
        moving = slow > 0
        tight = max([tight, *(speeds.reshape(-1, 2).sum(axis=1)[moving] / slow[moving])])
    assert tight > 0.5  # and the bounds are no idle ones


def test_each_obstacle_that_moves_is_where_it_is_then() -> None:
    """Two of them, others between: beside each link as if it stood where it is at that time."""
    machine = machines()["arm"]
    paths: list[Any] = [lambda t: (0.5, 0.3 * t, 0.5), lambda t: (-0.4 * t, 0.2, 0.3 + t**2)]
    moving = [MovingObstacle(OBSTACLES[1], paths[0], turned), MovingObstacle(OBSTACLES[2], paths[1])]
    scene = CollisionScene(machine, (OBSTACLES[0], moving[0], OBSTACLES[3], moving[1]))
    q, t = ca.SX.sym("q", machine.joint_size), ca.SX.sym("t")
    result = ca.Function("found", [q, t], [scene.distances((), q, t)])
    for j, at in zip(configurations(machine, 5, 3)[1], (0.0, 0.3, 0.7, 1.0, 2.0), strict=True):
        placed = []
        for one, path, turn in zip(moving, paths, (np.array(ca.DM(turned(at))), np.eye(3)), strict=True):
            placed.append(one.shape.placed(turn, np.array(path(at))))
        still = CollisionScene(machine, (OBSTACLES[0], placed[0], OBSTACLES[3], placed[1]))
        known = dict(zip(still.labels, np.array(ca.DM(still.distances((), ca.DM(j)))).ravel(), strict=True))
        report = dict(zip(scene.labels, np.array(result(j, at)).ravel(), strict=True))
        assert {one for label in report for one in label if one.startswith("obstacle")} == {
            f"obstacle {k}" for k in range(4)
        }
        for label, value in known.items():
            assert report[label] == pytest.approx(value, abs=1e-9)


def test_scaled_machines_have_scaled_distances_and_levers() -> None:
    plain, large = (CollisionScene(FixedBase(armoured_arm(scale=k))) for k in (1.0, 3.0))
    q = np.linspace(-1, 1, 7)
    assert plain.labels == large.labels
    assert_allclose(np.array(large.distances((), q)), 3 * np.array(plain.distances((), q)), rtol=1e-9)
    assert_allclose(large.levers.joints, 3 * plain.levers.joints, rtol=1e-12)
    assert_allclose(large.levers.joint_turns, plain.levers.joint_turns)


def test_which_pairs_are_left() -> None:
    machine = FixedBase(armoured_arm())
    scene = CollisionScene(machine, OBSTACLES, ignored=[("link6", "obstacle 1"), ("link2", "link4")])
    assert scene.excluded["base", "obstacle 0"] == "neither moves"
    assert scene.excluded["link6", "obstacle 1"] == "ignored by request"
    assert not {("link6", "obstacle 1"), ("link2", "link4"), ("base", "obstacle 3")} & set(scene.labels)
    assert ("link6", "obstacle 0") in scene.labels
    moving = CollisionScene(machine, [MovingObstacle(OBSTACLES[0], lambda t: (t, 0, 0))])
    assert ("base", "obstacle 0") in moving.labels


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "an obstacle that is none": ({"obstacles": [1.0]}, "obstacles"),
    "an unknown link": ({"ignored": [("link2", "hand")]}, "hand"),
    "a pair of one": ({"ignored": ["link2"]}, "ignored"),
    "an unknown obstacle": ({"ignored": [("link2", "obstacle 7")]}, "obstacle 7"),
    "obstacles in a word": ({"obstacles": "box"}, "obstacles"),
    "a box without ends": ({"obstacles": [Box((np.inf, 1, 1), (5, 5, 5))]}, r"obstacles\[0\] is an infinite box"),
}


def test_a_pair_is_ignored_by_its_names() -> None:
    machine = FixedBase(armoured_arm())
    scene = CollisionScene(
        machine, [Sphere(0.1, (0.3, 0, 0.3)), MovingObstacle(Sphere(0.1, (0, 0, 0)), lambda t: (t, 0, 0.3))]
    )
    for pair in range(len(scene.pairs)):
        without = CollisionScene(machine, scene.obstacles, ignored=[scene.pair_names(pair)])
        assert set(without.labels) < set(scene.labels)
        assert scene.labels[pair] not in without.labels


@pytest.mark.parametrize("case", BAD)
def test_invalid_arguments_are_refused(case: str) -> None:
    options, word = BAD[case]
    with pytest.raises(ModelError, match=word):
        CollisionScene(FixedBase(armoured_arm()), **options)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"shape": HalfSpace((0, 0, 1), (0, 0, 0))}, "half-space"),
        ({"shape": 3}, "shape"),
        ({"position": (0, 0, 1)}, "position"),
        ({"position": lambda t: (t, 0)}, "position"),
        ({"position": lambda t: ca.vertcat(t, ca.SX.sym("y"), 0)}, "position"),
        ({"rotation": lambda t: ca.SX.eye(2)}, "rotation"),
        ({"position": lambda t: 1 / 0}, "position"),
        ({"position": lambda t: (np.nan, 0, 0)}, "position .* is not finite"),
        ({"rotation": lambda t: 2 * ca.SX.eye(3)}, "rotation .* is not a rotation matrix"),
    ],
)
def test_parts_that_do_not_move(options: dict[str, Any], word: str) -> None:
    good: dict[str, Any] = {"shape": Sphere(0.1, (0, 0, 0)), "position": lambda t: (t, 0, 0)}
    with pytest.raises(ModelError, match=word):
        MovingObstacle(**{**good, **options})


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"rotation": lambda t: (1 + t) * ca.SX.eye(3)}, r"rotation .* at 0\.00195312 s"),
        ({"position": lambda t: (ca.sqrt(0.5 - t), 0, 0)}, r"position .* is not finite, at 0\.501953 s"),
        ({"position": lambda t: (1 / t, 0, 0)}, r"position .* is not finite, at 0 s"),
    ],
)
def test_an_undefined_motion_is_reported_with_its_time(options: dict[str, Any], word: str) -> None:
    moving = MovingObstacle(**{"shape": Sphere(0.1, (0, 0, 0)), "position": lambda t: (t, 0, 0), **options})
    scene = CollisionScene(FixedBase(armoured_arm()), [moving])
    with pytest.raises(ModelError, match=word) as caught:
        scene.check_motions(0.0, 1.0)
    assert caught.value.time is not None


def test_a_slide_without_limits() -> None:
    robot = slider()
    free = [
        replace(joint, lower=-np.inf, upper=np.inf) if joint.kind == "prismatic" else joint for joint in robot.joints
    ]
    turned = [Joint("foot", "revolute", "ground", "base", axis=(0, 0, 1)), *free]
    long = Robot((Link("ground", 1.0), *robot.links), tuple(turned), tip="left")
    with pytest.raises(ModelError, match="rail"):
        _ = CollisionScene(FixedBase(long), OBSTACLES[:1]).levers


@pytest.mark.parametrize("wrong", [{}, (), None, "arm", 1.0, FixedBase, Robot((Link("alone"),))], ids=repr)
def test_only_machines_have_a_collision_scene(wrong: Any) -> None:
    with pytest.raises(ModelError, match="scene: machine must be a FixedBase") as caught:
        CollisionScene(wrong)
    assert caught.value.name == "machine"


@pytest.mark.parametrize(("name", "rounding"), [("arm", 0.0), ("arm", 0.01), ("slider", 0.01), ("space", 0.01)])
def test_gradients_of_distances_are_their_derivatives(name: str, rounding: float) -> None:
    """By joints, slides, followers, a base that floats, beside what stands and what turns; pairs in any order."""
    machine = machines()[name]
    tumbling = MovingObstacle(Box((0.2, 0.3, 0.4)), lambda t: (0.5, 0.3 * t, 0.5), lambda t: turned(t))
    scene = CollisionScene(machine, (*OBSTACLES, tumbling))
    order = np.random.default_rng(6).permutation(len(scene.pairs)).tolist()
    function = scene.distance_gradients(pairs=order, rounding=rounding)
    base, q, t = ca.SX.sym("base", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("t")
    report = scene.distances(base, q, t, pairs=order, rounding=rounding)
    known = ca.Function("known", [base, q, t], [report, ca.jacobian(report, ca.vertcat(base, q))])
    for b, j, at in zip(*configurations(machine, 15, 7), np.linspace(0.0, 2.0, 15), strict=True):
        values, slopes = (np.array(part) for part in function(b, j, at))
        expected, derived = (np.array(part) for part in known(b, j, at))
        assert slopes.shape == (len(order), machine.base_size + machine.joint_size)
        assert_allclose(values, expected, atol=1e-12)
        if machine.base_size:  # a unit quaternion stays one
            along = np.r_[np.zeros(3), b[3:], np.zeros(machine.joint_size)]
            slopes, derived = (part - np.outer(part @ along, along) for part in (slopes, derived))
        assert_allclose(slopes, derived, atol=1e-9)


def turned(t: Any) -> Any:
    c, s = ca.cos(t), ca.sin(t)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def test_gradients_of_no_pairs_have_no_rows() -> None:
    machine = machines()["arm"]
    values, slopes = CollisionScene(machine, OBSTACLES).distance_gradients(pairs=[])(
        (), np.zeros(machine.joint_size), 0.0
    )
    assert values.shape == (0, 1)
    assert slopes.shape == (0, machine.joint_size)


@pytest.fixture
def hooked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FixedBase:
    """Five links one above the other, of one mesh: a hook that two capsules cover."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # fitted once
    corners = np.array(np.meshgrid(*[(0.0, 1.0)] * 3)).reshape(3, -1).T
    hook = [convex_hull(low + corners * size) for low, size in
            (((-0.05, -0.05, 0.0), (0.1, 0.1, 0.4)), ((-0.05, -0.05, 0.3), (0.35, 0.1, 0.1)))]  # fmt: skip
    lines = [f"v {x} {y} {z}" for each in hook for x, y, z in each.vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for k, each in enumerate(hook) for a, b, c in each.faces + 8 * k]
    (tmp_path / "hook.obj").write_text("\n".join(lines), encoding="utf-8")
    shape = CollisionShape("mesh", (1.0, 1.0, 1.0), file="hook.obj")
    links = tuple(Link(f"link{k}", collisions=(shape,)) for k in range(5))
    limits: dict[str, Any] = {"axis": (0, 1, 0), "translation": (0, 0, 0.45), "lower": -2.5, "upper": 2.5}
    joints = tuple(Joint(f"joint{k}", "revolute", f"link{k - 1}", f"link{k}", **limits) for k in range(1, 5))
    return FixedBase(Robot(links, joints, tip="link4"))


def test_a_mesh_near_a_primitive_is_checked_by_its_hull(hooked: FixedBase, tmp_path: Path) -> None:
    """Its distance is at least that of the covers, and more where they fill the notch less than the hull."""
    links = [replace(link, collisions=(CollisionShape("sphere", (0.05,), translation=(0, 0, 0.4)),)) if k == 2 else link
             for k, link in enumerate(hooked.robot.links)]  # fmt: skip
    machine = FixedBase(Robot(tuple(links), hooked.robot.joints, tip="link4"))
    scene = CollisionScene(machine, folders=[tmp_path])
    pair = next(k for k, label in enumerate(scene.labels) if label[0].startswith("link0") and label[1] == "link2")
    assert isinstance(scene.bodies[scene.pairs[pair, 0]].shape, Mesh)
    assert [scene.bodies[j].name for _, j in scene.cover_pairs[pair]] == ["link2", "link2"]
    samples = np.random.default_rng(4).uniform(-2.5, 2.5, (40, 4))
    q = ca.SX.sym("q", 4)
    covers = ca.Function("covers", [q], [scene.distances((), q, pairs=[pair])])
    by_covers = np.array(covers.map(40)(samples.T)).ravel()
    distances = distances_along(scene, np.zeros(0), samples, np.zeros(40))
    assert (distances[:, pair] >= by_covers - 1e-5).all()
    only = distances_along(scene, np.zeros(0), samples, np.zeros(40), pairs=[pair])
    assert_allclose(only[:, pair], distances[:, pair], atol=1e-12)
    assert np.isinf(np.delete(only, pair, axis=1)).all()
    for configuration, expected in zip(samples, distances[:, pair], strict=True):
        for collision in find_collisions(scene, np.zeros(0), configuration[None], np.zeros(1)):
            if collision.pair == pair:
                least = float(covers(configuration))
                assert collision.protrusion == pytest.approx(expected - least, abs=1e-5)


def test_meshes_up_to_three_joints_apart_are_checked_as_hulls(hooked: FixedBase, tmp_path: Path) -> None:
    """Their distances are those of their covers, from below; gradients by the soft minimum; others are covers alone."""
    scene = CollisionScene(hooked, folders=[tmp_path])
    hulls = [isinstance(scene.bodies[one].shape, Mesh) for one, _, _ in scene.pairs]
    links = [tuple(int(name[4]) for name in label) for label in scene.labels]
    assert {(i, j) for (i, j), hull in zip(links, hulls, strict=True) if hull} == {
        (i, j) for i in range(5) for j in range(i + 2, 5) if j - i <= 3
    }
    assert [pair for pair, hull in zip(links, hulls, strict=True) if not hull] == 4 * [(0, 4)]
    points = np.array([-0.05, -0.05, 0.0]), np.array([0.3, 0.05, 0.4])
    for body in scene.bodies:
        if isinstance(body.shape, Mesh):
            assert_allclose([body.shape.core.min(axis=0), body.shape.core.max(axis=0)], points, atol=1e-12)
    q = ca.SX.sym("q", 4)
    covers = [body for body in scene.bodies if not isinstance(body.shape, Mesh)]
    frames = link_frames(hooked.robot, q)
    for rounding in (0.0, 3e-3):
        report = scene.distances((), q, rounding=rounding)
        function = ca.Function("known", [q], [report, ca.jacobian(report, q)])
        gradients = scene.distance_gradients(rounding=rounding)
        each = {
            (i, j): [
                distance(a.shape, b.shape, frames[f"link{i}"], frames[f"link{j}"], rounding=rounding)
                for a in covers if a.name.startswith(f"link{i}/")
                for b in covers if b.name.startswith(f"link{j}/")
            ]
            for (i, j), hull in zip(links, hulls, strict=True) if hull
        }  # fmt: skip
        least = ca.Function("least", [q], [ca.vertcat(*(ca.mmin(ca.vertcat(*of)) for of in each.values()))])
        for configuration in np.random.default_rng(9).uniform(-2, 2, (8, 4)):
            values, slopes = (np.array(part) for part in function(configuration))
            result, derived = (np.array(part) for part in gradients((), configuration, 0.0))
            assert_allclose(result, values, atol=1e-12)
            assert_allclose(derived, slopes, atol=1e-8)
            short = np.array(least(configuration)).ravel() - values.ravel()[hulls]
            assert (short >= -1e-12).all()
            assert (short <= (rounding / 4 + 1e-6) * np.log(4) + 1e-12).all()
