"""Which pairs of bodies are checked: by laws of the tree, by proof, by request; against a benchmark and coal."""

from __future__ import annotations

import warnings
from itertools import combinations
from pathlib import Path
from typing import Any

import casadi as ca
import coal
import numpy as np
import pytest

from models import CollisionShape, Frame, Joint, Link, Mimic, ModelError, ModelWarning, Robot, add_prefix, link_frames
from models.checks import Array
from models.shapes.bodies import Body, LinkMesh, RigidParts, collision_bodies
from models.shapes.distance import distance
from models.shapes.pairs import (
    ALWAYS,
    ASSUMED,
    COVERED,
    IGNORED,
    NEIGHBOURS,
    NEVER,
    RIGID,
    SRDF,
    Pairs,
    _BodyPair,
    _PlacedBody,
    _random_configurations,
    checked_pairs,
)
from models.shapes.shapes import Box, Capsule, Shape, Sphere
from tests import redundancy_benchmark
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.shapes.shape_oracles import turns

KINDS: tuple[Shape, ...] = (
    Sphere(0.1, (0, 0, 0)),
    Capsule(0.1, (0, 0, 0), (0, 0, 0)),
    Capsule(0.05, (0, 0, -0.3), (0, 0, 0.2)),
    Box((0.2, 0.3, 0.4)),
)
"""Of which the distances are exact."""


def chain(*lengths: float, radius: float = 0.02, limit: float = np.pi) -> tuple[Robot, tuple[Body, ...]]:
    """Links along x at zero, each a capsule that stops short of its ends, on joints about z."""
    links = tuple(Link(f"link{k}") for k in range(len(lengths)))
    joints = []
    for k, length in enumerate(lengths[:-1]):
        ends = f"link{k}", f"link{k + 1}", (length, 0, 0)
        joints.append(Joint(f"joint{k + 1}", "revolute", *ends, axis=(0, 0, 1), lower=-limit, upper=limit))
    short = 2 * radius
    bodies = tuple(
        Body(f"link{k}", Capsule(radius, (short, 0, 0), (length - short, 0, 0))) for k, length in enumerate(lengths)
    )
    return Robot(links, tuple(joints)), bodies


def by_links(bodies: tuple[Body, ...], pairs: Pairs) -> set[frozenset[str]]:
    return {frozenset((bodies[i].link, bodies[j].link)) for i, j in pairs.checked}


def test_neighbours_are_left_and_the_others_checked() -> None:
    robot, bodies = chain(0.3, 0.3, 0.3, 0.3)
    pairs = checked_pairs(robot, bodies)
    assert pairs.checked == ((0, 2), (0, 3), (1, 3))
    assert pairs.excluded == {(f"link{k}", f"link{k + 1}"): NEIGHBOURS for k in range(3)}


def test_limits_prove_that_bodies_never_collide() -> None:
    """Folded by less than needed: with the middle link of 0.3 and joints of at most 60 degrees nothing comes back."""
    robot, bodies = chain(0.3, 0.3, 0.3, limit=np.deg2rad(60))
    assert checked_pairs(robot, bodies).excluded["link0", "link2"] == NEVER
    assert checked_pairs(robot, bodies, limits=(-3.0, 3.0)).checked == ((0, 2),)
    assert checked_pairs(robot, bodies, clearance=0.5).checked == ((0, 2),)


def test_unproven_pairs_are_checked() -> None:
    """Joints that move without limits, so far that no box of postures is finite."""
    links = (Link("a"), Link("b"), Link("c"))
    joints = (Joint("one", "prismatic", "a", "b"), Joint("two", "prismatic", "b", "c", axis=(0, 1, 0)))
    bodies = tuple(Body(name, Sphere(0.1, (0.0, 0.0, z))) for name, z in (("a", 0.0), ("b", 5.0), ("c", 10.0)))
    assert checked_pairs(Robot(links, joints), bodies).checked == ((0, 2),)


def test_never_is_never() -> None:
    """Trees at random: of the pairs that are called so none touches in any of 500 postures, by the expression."""
    for seed in range(6):
        robot, bodies = random_robot(np.random.default_rng(seed))
        never = {pair for pair, reason in checked_pairs(robot, bodies).excluded.items() if reason == NEVER}
        every = combinations(range(len(bodies)), 2)
        chosen = [(i, j) for i, j in every if (bodies[i].link, bodies[j].link) in never]
        if chosen:
            assert gaps(robot, bodies, chosen, 500).min() > 0


def random_robot(rng: np.random.Generator) -> tuple[Robot, tuple[Body, ...]]:
    """A tree with a fork, revolute and prismatic joints, one of them a follower."""
    links = tuple(Link(f"link{k}") for k in range(7))
    joints = []
    for k in range(1, 7):
        kind: Any = "prismatic" if k == 3 else "revolute"
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        low, high = (-0.1, 0.2) if kind == "prismatic" else np.sort(rng.uniform(-2, 2, 2))
        mimic = Mimic("joint1", 0.5, 0.1) if k == 5 else None
        parent = f"link{k - 1}" if k != 4 else "link1"
        shift = rng.uniform(-0.3, 0.3, 3)
        axis = rng.normal(size=3)
        limits = {"lower": float(low), "upper": float(high)} if mimic is None else {}
        joints.append(Joint(f"joint{k}", kind, parent, f"link{k}", shift, turn, axis, mimic=mimic, **limits))
    bodies = []
    for k in range(7):
        place = rng.uniform(-0.1, 0.1, 3)
        bodies.append(
            Body(f"link{k}", Capsule(0.04, place, place + rng.uniform(-0.2, 0.2, 3)))
            if k % 3
            else Body(f"link{k}", Box(rng.uniform(0.03, 0.2, 3), place))
        )
    return Robot(links, tuple(joints), tip="link6"), tuple(bodies)


def expression(bodies: tuple[Body, ...], frames: Any, i: int, j: int) -> Any:
    """Distance of two bodies, given the frames of the links."""
    return distance(bodies[i].shape, bodies[j].shape, frames[bodies[i].link], frames[bodies[j].link])


def gaps(robot: Robot, bodies: tuple[Body, ...], pairs: list[tuple[int, int]], count: int) -> Array:
    """Distances of pairs in random postures within limits. Shape (pairs, count)."""
    q = ca.SX.sym("q", robot.dof)
    frames = link_frames(robot, q)
    each = ca.vertcat(*[expression(bodies, frames, i, j) for i, j in pairs])
    configurations = np.random.default_rng(1).uniform(robot.lower, robot.upper, (count, robot.dof)).T
    return np.array(ca.Function("gaps", [q], [each])(configurations))


@pytest.mark.parametrize("seed", range(2))
def test_bodies_are_where_the_kinematics_have_them(seed: int) -> None:
    """Of random trees the distances in random postures, slides and followers among the joints."""
    robot, bodies = random_robot(np.random.default_rng(seed))
    parts = RigidParts.of(robot)
    configurations = np.random.default_rng(1).uniform(robot.lower, robot.upper, (10, robot.dof))
    every = [(i, j) for i, j in combinations(range(len(bodies)), 2) if i % 3 or j % 3]  # but boxes beside boxes
    known = gaps(robot, bodies, every, 10)
    for (i, j), row in zip(every, known, strict=True):
        one, other = bodies[i].shape, bodies[j].shape
        placed = _PlacedBody(one), _PlacedBody(other)
        between = _BodyPair(robot, *placed, *parts.path(bodies[i].link, bodies[j].link))
        turn, shift = between._relative(configurations)
        np.testing.assert_allclose(exact_distances(one, other, turn, shift), row, atol=1e-9)
        assert (between.bounds(configurations)[0] <= row + 1e-9).all()


def test_the_most_important_reason_of_several_is_reported() -> None:
    """Whatever their order: always touching before never touching, and before it what only covers may do."""
    robot, _ = chain(0.1, 0.001, 0.1)
    ball, between = Sphere(0.05, (0.0, 0.0, 0.0)), Body("link1", Sphere(0.05, (0.0, 0.0, 0.0)))
    near, loose = Body("link0", Sphere(0.05, (0.1, 0, 0))), Body("link0", Sphere(0.05, (0.1, 0, 0)), 0.12)
    far = Body("link0", Sphere(0.01, (9.0, 0, 0)))
    for several, reason in (((near, far), ALWAYS), ((loose, far), COVERED), ((near, loose), COVERED), ((far,), NEVER)):
        for own in (several, several[::-1]):
            pairs = checked_pairs(robot, (*own, between, Body("link2", ball)))
            assert pairs.excluded["link0", "link2"] == reason
            assert pairs.checked == ()


def test_checked_pairs_collide_somewhere_or_nearly() -> None:
    """The proof is no blanket: of the checked pairs of random trees half and more do touch in random postures."""
    colliding = total = 0
    for seed in range(4):
        robot, bodies = random_robot(np.random.default_rng(seed))
        checked = list(checked_pairs(robot, bodies).checked)
        if checked:
            least = gaps(robot, bodies, checked, 1000).min(axis=1)
            colliding, total = colliding + int((least < 0.03).sum()), total + len(checked)
    assert colliding > 0.5 * total


def test_bodies_that_always_collide_are_named() -> None:
    robot, _ = chain(0.1, 0.001, 0.1)
    bodies = tuple(Body(f"link{k}", Sphere(0.05, (0.0, 0.0, 0.0))) for k in (1, 2))
    pairs = checked_pairs(robot, (Body("link0", Sphere(0.05, (0.1, 0, 0))), *bodies))
    assert pairs.excluded["link0", "link2"] == ALWAYS
    assert pairs.checked == ()
    for overhang, reason in ((0.01, ALWAYS), (0.06, COVERED)):  # they overlap by 0.05 to 0.1
        loose = Body("link2", Sphere(0.05, (0.0, 0.0, 0.0)), 2 * overhang)
        pairs = checked_pairs(robot, (Body("link0", Sphere(0.05, (0.1, 0, 0))), bodies[0], loose))
        assert pairs.excluded["link0", "link2"] == reason


def test_fixed_links_are_one_rigid_part_and_links_without_bodies_are_passed_over() -> None:
    links = tuple(Link(name) for name in ("base", "flange", "cross", "arm", "hand"))
    joints = (
        Joint("bolt", "fixed", "base", "flange", (0, 0, 0.1)),
        Joint("yaw", "revolute", "flange", "cross", (0, 0, 0.1), lower=-1, upper=1),
        Joint("pitch", "revolute", "cross", "arm", axis=(0, 1, 0), lower=-2, upper=2),
        Joint("glue", "fixed", "arm", "hand", (0, 0, 0.5)),
    )
    ball = Sphere(0.06, (0.0, 0.0, 0.0))
    bodies = tuple(Body(name, ball) for name in ("base", "flange", "arm", "hand"))
    pairs = checked_pairs(Robot(links, joints), bodies)
    assert pairs.excluded["base", "flange"] == pairs.excluded["arm", "hand"] == RIGID
    assert pairs.excluded["flange", "arm"] == pairs.excluded["base", "hand"] == NEIGHBOURS
    with_cross = checked_pairs(Robot(links, joints), (*bodies, Body("cross", Sphere(0.001, (0.0, 0.0, 0.0)))))
    assert with_cross.excluded["base", "cross"] == NEIGHBOURS
    assert with_cross.excluded.get(("base", "hand")) != NEIGHBOURS


SRDF_TEXT = """<robot name="chain"><disable_collisions link1="link2" link2="link0" reason="Never"/>
<disable_collisions link1="link0" link2="ghost"/></robot>"""


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
def test_a_mesh_on_a_link_that_is_fixed_lies_where_it_is_fixed(shift: tuple[float, float, float]) -> None:
    """A cube always within another one, though the spheres that cover them might stand out of both: that they touch."""
    robot, _ = chain(0.1, 0.001, 0.1)
    held = Joint("held", "fixed", "link0", "plate", shift)
    robot = Robot((*robot.links, Link("plate")), (*robot.joints, held))
    corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    middle = np.array([0.1, 0.0, 0.0]) - shift
    plate = Body("plate", Sphere(0.09, middle), 0.04, LinkMesh(0.05 * corners + middle))
    inner = Body("link2", Sphere(0.04, (0.0, 0.0, 0.0)), 0.1, LinkMesh(0.02 * corners))
    between = Body("link1", Sphere(0.01, (0.0, 0.0, 0.0)))
    assert checked_pairs(robot, (plate, between, inner)).excluded["plate", "link2"] == ALWAYS


def bound(one: Shape, other: Shape, turn: Array, shift: Array) -> Array:
    """Distances as the proof has them."""
    return _BodyPair(chain(0.1)[0], _PlacedBody(one), _PlacedBody(other), [], []).distance_bounds(turn, shift)


def exact_distances(one: Shape, other: Shape, turn: Array, shift: Array) -> Array:
    """Distances by the formulas, from many frames of the other in the one's, shapes (k, 3, 3) and (k, 3)."""
    rotation, position = ca.SX.sym("turn", 3, 3), ca.SX.sym("shift", 3)
    gap = distance(one, other, None, Frame(rotation, position))
    function = ca.Function("gap", [ca.vertcat(rotation.reshape((9, 1)), position)], [gap])
    columns = np.concatenate([turn.transpose(0, 2, 1).reshape(-1, 9), shift], axis=1).T
    return np.array(function(columns)).ravel()


@pytest.mark.parametrize("slope", [-2.0, 0.0, 0.5])
def test_the_bound_is_exact_where_a_capsule_crosses_an_edge(slope: float) -> None:
    """Square across from the edge at x = y = 0.1 of a box, which lies along z; from each of the two shapes."""
    box, out = Box((0.2, 0.2, 0.6)), np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    across = np.array([1.0, -1.0, slope])
    middle = np.array([0.1, 0.1, 0.05]) + 0.07 * out
    capsule = Capsule(0.02, middle - 0.1 * across, middle + 0.05 * across)
    turn, shift = np.eye(3)[None], np.zeros((1, 3))
    assert bound(box, capsule, turn, shift) == pytest.approx([0.05], abs=1e-12)
    assert bound(capsule, box, turn, shift) == pytest.approx([0.05], abs=1e-12)


@pytest.mark.parametrize("one", KINDS, ids=lambda shape: type(shape).__name__)
@pytest.mark.parametrize("other", KINDS, ids=lambda shape: type(shape).__name__)
def test_the_bound_is_no_more_than_the_distance(one: Shape, other: Shape) -> None:
    """In frames at random and aligned, where middles coincide and edges are parallel, apart and deep inside."""
    rng = np.random.default_rng(8)
    turn = np.concatenate([np.tile(np.eye(3), (4, 1, 1)), turns(rng, 60)])
    shift = np.concatenate(
        [np.array([(0, 0, 0), (0, 0, 0.1), (0.3, 0, 0), (0.3, 0.3, 0)]), rng.normal(size=(60, 3)) / 3]
    )
    result, exact = bound(one, other, turn, shift), exact_distances(one, other, turn, shift)
    assert (result <= exact + 1e-9).all()
    assert (result > -1).all()


def test_the_bound_of_spheres_is_exact_and_that_of_boxes_beside_a_face() -> None:
    turn, shift = np.eye(3)[None], np.array([[0.0, 3.0, 4.0]])
    assert bound(Sphere(0.5, (1, 0, 0)), Sphere(0.25, (1, 0, 0)), turn, shift) == pytest.approx([4.25], abs=1e-11)
    assert bound(Box((2, 2, 2)), Box((1, 9, 1)), turn, shift) == pytest.approx([2.5], abs=1e-12)


def test_random_configurations_fill_the_limits_or_a_turn_or_a_metre_in_both_directions() -> None:
    """Of a turn and a slide, each with both limits, the lower one, the upper one, none."""
    ends = [(-0.3, 0.4), (1.0, np.inf), (-np.inf, 1.0), (-np.inf, np.inf)]
    links, joints = [Link("link0")], []
    for k in range(8):
        kind: Any = "prismatic" if k >= 4 else "revolute"
        joints.append(Joint(f"joint{k}", kind, f"link{k}", f"link{k + 1}"))
        links.append(Link(f"link{k + 1}"))
    low, high = np.tile(np.array(ends).T, 2)
    result = _random_configurations(Robot(tuple(links), tuple(joints)), low, high, 4000, np.random.default_rng(1))
    for first, room in ((0, np.pi), (4, 1.0)):
        spans = [(-0.3, 0.4), (1.0, 1.0 + 2 * room), (1.0 - 2 * room, 1.0), (-room, room)]
        for k, (least, most) in enumerate(spans):
            values = result[:, first + k]
            assert least <= values.min() < least + 0.01 * (most - least)
            assert most >= values.max() > most - 0.01 * (most - least)


def test_a_clearance_larger_than_that_of_bounding_balls_is_proven_by_the_bodies() -> None:
    """Plates one above the other, 0.98 m apart; the balls around them are 0.2 m apart and less."""
    links, limit = tuple(Link(f"link{k}") for k in range(3)), 0.1
    turn: dict[str, Any] = {"axis": (0, 0, 1), "lower": -limit, "upper": limit}
    joints = tuple(Joint(f"joint{k}", "revolute", f"link{k - 1}", f"link{k}", (0, 0, 0.5), **turn) for k in (1, 2))
    plate = Box((0.56, 0.56, 0.02))
    bodies = (Body("link0", plate), Body("link1", Sphere(0.01, (9, 9, 0))), Body("link2", plate))
    for clearance, reason in ((0.97, NEVER), (0.99, None)):
        pairs = checked_pairs(Robot(links, joints), bodies, clearance=clearance)
        assert pairs.excluded.get(("link0", "link2")) == reason


@pytest.mark.parametrize(("short", "reason"), [(0.5e-6, None), (2e-6, NEVER)])
def test_a_proof_leaves_room_for_rounding(short: float, reason: str | None) -> None:
    """Balls on a common axis, always 0.8 m apart, that have to be apart by a little less."""
    links = tuple(Link(f"link{k}") for k in range(3))
    turn: dict[str, Any] = {"axis": (0, 0, 1), "lower": -1e-9, "upper": 1e-9}
    joints = tuple(Joint(f"joint{k}", "revolute", f"link{k - 1}", f"link{k}", (0, 0, 0.5), **turn) for k in (1, 2))
    bodies = tuple(Body(f"link{k}", Sphere(0.1, (0, 0, 0))) for k in range(3))
    pairs = checked_pairs(Robot(links, joints), bodies, clearance=0.8 - short)
    assert pairs.excluded.get(("link0", "link2")) == reason


@pytest.mark.parametrize(
    ("place", "reason"),
    [((1.0, 1.0), None), ((-1.0, 1.0), None), ((0.313, -0.477), None), ((0.0, 0.0), None), ((1.1, 0.2), NEVER)],
    ids=["corner", "other corner", "between", "middle", "beyond a limit"],
)
def test_hulls_that_meet_in_few_configurations_are_checked(place: tuple[float, float], reason: str | None) -> None:
    """Cubes of 0.016 m on slides of -1 to 1 m, of which one passes by this place alone; their covers always touch."""
    links = tuple(Link(f"link{k}") for k in range(3))
    slide: dict[str, Any] = {"lower": -1.0, "upper": 1.0}
    joints = (
        Joint("x", "prismatic", "link0", "link1", axis=(1, 0, 0), **slide),
        Joint("y", "prismatic", "link1", "link2", axis=(0, 1, 0), **slide),
    )
    corners = 0.008 * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    ball = Sphere(4.0, (0, 0, 0))
    bodies = (
        Body("link0", ball, 4.0, LinkMesh(corners + np.array([*place, 0.0]))),
        Body("link1", Sphere(0.01, (9, 9, 9))),
        Body("link2", ball, 4.0, LinkMesh(corners)),
    )
    assert checked_pairs(Robot(links, joints), bodies).excluded.get(("link0", "link2")) == reason


def test_an_srdf_file_and_the_user_leave_pairs_out(tmp_path: Path) -> None:
    robot, bodies = chain(0.3, 0.3, 0.3, 0.3)
    file = tmp_path / "chain.srdf"
    file.write_text(SRDF_TEXT, encoding="utf-8")
    for source in (SRDF_TEXT, file, str(file)):
        with pytest.warns(ModelWarning, match="'ghost'"):
            pairs = checked_pairs(robot, bodies, srdf=source, ignored=[("link3", "link0")])
        assert pairs.checked == ((1, 3),)
        assert pairs.excluded["link0", "link2"] == SRDF
        assert pairs.excluded["link0", "link3"] == IGNORED


def test_names_and_the_order_of_declaration_do_not_matter() -> None:
    for seed in range(4):
        robot, bodies = random_robot(np.random.default_rng(seed))
        pairs = checked_pairs(robot, bodies)
        wanted = by_links(bodies, pairs)
        turned = Robot(robot.links[::-1], robot.joints[::-1], tip=robot.tip)
        assert by_links(bodies[::-1], checked_pairs(turned, bodies[::-1])) == wanted
        other = add_prefix(robot, "other ")
        moved = tuple(Body(f"other {body.link}", body.shape) for body in bodies)
        assert checked_pairs(other, moved).checked == pairs.checked


def test_a_follower_counts_as_it_moves() -> None:
    """Two fingers on one drive, always 0.1 apart and more, which as joints of their own could meet."""
    links = tuple(Link(name) for name in ("palm", "left", "right"))
    left = Joint("left_slide", "prismatic", "palm", "left", axis=(1, 0, 0), lower=-0.2, upper=0.2)
    ball = Sphere(0.02, (0.0, 0.0, 0.0))
    bodies = (Body("left", ball), Body("right", ball))
    for mimic, reason in ((Mimic("left_slide", 1.0, 0.1), NEVER), (None, None)):
        limits = {} if mimic else {"lower": -0.2, "upper": 0.2}
        right = Joint("right_slide", "prismatic", "palm", "right", axis=(1, 0, 0), mimic=mimic, **limits)
        palm = Body("palm", Sphere(0.001, (0.0, 1.0, 0.0)))
        pairs = checked_pairs(Robot(links, (left, right), tip="left"), (palm, *bodies))
        assert pairs.excluded.get(("left", "right")) == reason


@pytest.mark.parametrize("name", redundancy_benchmark.ROBOTS)
def test_the_benchmark_of_redundant_arms(name: str) -> None:
    """Capsules and pairs as given: distances at random postures as an own formula and coal have them."""
    robot, ignored = redundancy_benchmark.robot_of(name), redundancy_benchmark.ignored_pairs(name)
    bodies = collision_bodies(robot)
    pairs = checked_pairs(robot, bodies, ignored=ignored)
    for pair in ignored:
        assert frozenset(pair) not in by_links(bodies, pairs)
    listed = {frozenset(pair) for pair in ignored}
    links = [body.link for body in bodies]
    every = [(i, j) for i, j in combinations(range(len(links)), 2) if frozenset((links[i], links[j])) not in listed]
    reasons = {frozenset(key): why for key, why in pairs.excluded.items()}
    for i, j in set(every) - set(pairs.checked):
        assert reasons[frozenset((bodies[i].link, bodies[j].link))] in (NEIGHBOURS, NEVER, ALWAYS, RIGID)
    q = ca.SX.sym("q", robot.dof)
    frames = link_frames(robot, q)
    ours = [expression(bodies, frames, i, j) for i, j in every]
    poses = [ca.horzcat(frames[link].rotation, frames[link].position) for link in links]
    both = ca.Function("both", [q], [ca.vertcat(*ours), ca.horzcat(*poses)])
    rng = np.random.default_rng(0)
    low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    for _ in range(100):
        result, placed = map(np.array, both(rng.uniform(low, high)))
        for gap, (i, j) in zip(result.ravel(), every, strict=True):
            sides = [(placed[:, 4 * k : 4 * k + 3], placed[:, 4 * k + 3]) for k in (i, j)]
            ends = [bodies[k].shape.core @ turn.T + shift for k, (turn, shift) in zip((i, j), sides, strict=True)]
            assert gap == pytest.approx(segments_apart(*ends) - radius(bodies[i]) - radius(bodies[j]), abs=1e-9)
            assert gap == pytest.approx(by_coal(bodies[i], bodies[j], ends), abs=1e-6)


def radius(body: Body) -> float:
    assert isinstance(body.shape, Capsule)
    return body.shape.radius


def segments_apart(one: Array, other: Array) -> float:
    """Least distance of two segments: of the ends from the other segment, and of the lines where they meet inside."""

    def to_segment(point: Array, ends: Array) -> float:
        along = ends[1] - ends[0]
        share = np.clip((point - ends[0]) @ along / max(float(along @ along), 1e-300), 0, 1)
        return float(np.linalg.norm(point - ends[0] - share * along))

    matches = [to_segment(point, b) for a, b in ((one, other), (other, one)) for point in a]
    u, v = one[1] - one[0], other[1] - other[0]
    matrix = np.column_stack([u, -v])
    if np.linalg.matrix_rank(matrix, 1e-9) == 2:
        s, t = np.linalg.lstsq(matrix, other[0] - one[0], rcond=None)[0]
        if 0 <= s <= 1 and 0 <= t <= 1:
            matches.append(float(np.linalg.norm(one[0] + s * u - other[0] - t * v)))
    return min(matches)


def by_coal(one: Body, other: Body, ends: list[Array]) -> float:
    shapes, places = [], []
    for body, (start, end) in zip((one, other), ends, strict=True):
        along = end - start
        length = float(np.linalg.norm(along))
        z = along / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
        x = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
        x /= np.linalg.norm(x)
        shapes.append(coal.Capsule(radius(body), length))
        places.append(coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), (start + end) / 2))
    result = coal.DistanceResult()
    return float(coal.distance(shapes[0], places[0], shapes[1], places[1], coal.DistanceRequest(), result))


FINGERS = {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02}  # closed they do touch
HOME = {
    "panda": {"panda_joint2": -0.785, "panda_joint4": -2.356, "panda_joint6": 1.571, "panda_joint7": 0.785, **FINGERS},
    "ur5": {"shoulder_lift_joint": -1.2, "elbow_joint": 1.6, "wrist_1_joint": -1.2, "wrist_2_joint": -1.57},
}


@pytest.mark.parametrize("name", HOME)
def test_arms_are_free_at_home(name: str) -> None:
    package, ending, options = ROBOTS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        robot = Robot.from_urdf(urdf_file(package, ending), **options)
    bodies = collision_bodies(robot)
    pairs = checked_pairs(robot, bodies)
    assert not {ALWAYS, COVERED} & set(pairs.excluded.values())
    frames = link_frames(robot, [HOME[name].get(joint, 0.0) for joint in robot.joint_names])
    for i, j in pairs.checked:
        one, other = bodies[i], bodies[j]
        assert float(distance(one.shape, other.shape, frames[one.link], frames[other.link])) > 0, (one.link, other.link)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"robot": None}, "robot"),
    ({"bodies": [3]}, "bodies"),
    ({"bodies": None}, "bodies"),
    ({"bodies": [Body("link9", Sphere(1.0, (0, 0, 0)))]}, "link9"),
    ({"ignored": [("link0", "link9")]}, "link9"),
    ({"ignored": ["link0"]}, "ignored"),
    ({"ignored": "link0"}, "ignored"),
    ({"ignored": [("link0", "link1", "link2")]}, "ignored"),
    ({"ignored": 3}, "ignored"),
    ({"srdf": "<srdf/>"}, "the given text"),
    ({"srdf": "absent.srdf"}, "file 'absent.srdf'"),
    ({"srdf": "<robot><disable_collisions link1='link0'/></robot>"}, "link2"),
    ({"limits": ([0.0], 1.0)}, "lower"),
    ({"limits": (np.nan, 1.0)}, "lower"),
    ({"limits": (1.0,)}, "limits"),
    ({"limits": 1.0}, "limits"),
    ({"limits": (2.0, 1.0)}, "lower"),
    ({"clearance": -0.1}, "clearance"),
]


@pytest.mark.parametrize(("options", "name"), BAD, ids=range(len(BAD)))
def test_bad_requests_are_named(options: dict[str, Any], name: str) -> None:
    robot, bodies = chain(0.3, 0.3, 0.3)
    arguments: dict[str, Any] = {"robot": robot, "bodies": bodies} | options
    with pytest.raises(ModelError) as caught:
        checked_pairs(arguments.pop("robot"), arguments.pop("bodies"), **arguments)
    assert caught.value.name == name


def test_collision_shapes_become_checked_bodies() -> None:
    """From shapes to pairs in one go, with three links of the description's own kinds."""
    sizes: list[tuple[Any, Any]] = [("box", (0.1, 0.1, 0.1)), ("sphere", (0.05,)), ("cylinder", (0.02, 0.3))]
    shapes = [CollisionShape(kind, size) for kind, size in sizes]
    links = tuple(Link(f"link{k}", collisions=(shape,)) for k, shape in enumerate(shapes))
    joints = tuple(
        Joint(f"joint{k}", "revolute", f"link{k - 1}", f"link{k}", (0.12, 0, 0), lower=-3, upper=3) for k in (1, 2)
    )
    robot = Robot(links, joints)
    assert checked_pairs(robot, collision_bodies(robot)).checked == ((0, 2),)


def far_meshes(gap: float) -> tuple[Robot, tuple[Body, ...]]:
    """Three joints about z between meshes on the axis, cubes of 0.1 m a gap apart; their covers always touch."""
    links = tuple(Link(f"link{k}") for k in range(4))
    joints = tuple(Joint(f"j{k}", "revolute", f"link{k}", f"link{k + 1}", axis=(0, 0, 1)) for k in range(3))
    corners = 0.05 * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    above = corners + np.array([0.0, 0.0, 0.1 + gap])
    small = [Body(f"link{k}", Sphere(0.01, (9.0, 9.0 * k, 0))) for k in (1, 2)]
    return Robot(links, joints), (
        Body("link0", Sphere(1.0, (0, 0, 0)), 0.95, LinkMesh(corners)),
        *small,
        Body("link3", Sphere(1.0, (0, 0, 0.1 + gap)), 0.95, LinkMesh(above)),
    )


def test_meshes_are_checked_where_their_covers_always_overlap_and_their_hulls_do_not() -> None:
    robot, bodies = far_meshes(0.02)
    assert (0, 3) in checked_pairs(robot, bodies).checked
    beside = Body("link3", Sphere(0.05, (0.0, 0.0, 0.12)))  # beside a mesh, 0.02 m from its hull
    assert (0, 3) in checked_pairs(robot, (*bodies[:3], beside)).checked
    robot, bodies = far_meshes(-0.02)
    result = checked_pairs(robot, bodies)
    assert (0, 3) not in result.checked
    assert result.excluded["link0", "link3"] in ASSUMED


def test_a_joint_whose_limits_are_equal_but_for_the_sign_of_zero_is_no_error() -> None:
    robot, bodies = chain(0.3, 0.3, 0.3, 0.3)
    low, high = np.full(robot.dof, -3.0), np.full(robot.dof, 3.0)
    low[0], high[0] = 0.0, -0.0
    assert checked_pairs(robot, bodies, limits=(low, high)).checked == ((0, 3), (1, 3))


def test_the_bound_is_exact_where_a_ball_lies_off_a_corner() -> None:
    """On the diagonal of a cube of 0.2 m, 0.4 m from its middle; neither is at the origin of its frame."""
    diagonal, middle = np.ones(3) / np.sqrt(3), np.array([0.3, -0.2, 0.5])
    box, ball = Box((0.2, 0.2, 0.2), middle), Sphere(0.05, (0.0, 0.7, 0.0))
    turn, shift = np.eye(3)[None], (middle + 0.4 * diagonal - [0.0, 0.7, 0.0])[None]
    assert bound(box, ball, turn, shift) == pytest.approx([0.4 - 0.1 * np.sqrt(3) - 0.05], abs=1e-12)
