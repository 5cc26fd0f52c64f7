"""What a motion has to stay clear of: what is declared of it, what is held apart, and how it is held farther apart."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
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
    FixedBase,
    HalfSpace,
    Joint,
    Link,
    Mimic,
    MovingObstacle,
    Robot,
    Sphere,
)
from ocp import ClearanceConstraints, Collocation, Problem, ProblemError, SolveError, solve
from ocp.audit.audit import Finding
from ocp.audit.clearance import Clearance, ClosestPair
from ocp.motion.builders.clearance import (
    MARGIN,
    MAX_SOLVES,
    ROUNDING,
    clearance_of,
    collision_error,
    solve_with_clearance,
)
from ocp.motion.local.collisions import Collision, distances_along
from ocp.problem.values import constant
from tests.models.machines.armoured import armoured_arm

ARM = FixedBase(armoured_arm(4))
BALL = MovingObstacle(Sphere(0.1, (0, 0, 0)), lambda t: (0.5, 0.3 * t, 0.5 - 0.2 * t**2))


def crane() -> FixedBase:
    """A ball of 0.1 m, 1 m from an axis along z."""
    ball = CollisionShape("sphere", (0.1,), translation=(1.0, 0, 0))
    turn = Joint("turn", "revolute", "foot", "boom", axis=(0, 0, 1), lower=-3, upper=3)
    return FixedBase(Robot((Link("foot"), Link("boom", collisions=(ball,))), (turn,)))


def nearest(around: CollisionScene, pair: int, least: float, request: float = 0.02) -> ClosestPair:
    return ClosestPair(around.labels[pair], least, least, 0.5, np.zeros((2, 3)), request)


def test_covers_gain_what_hulls_lack() -> None:
    """Covers that protrude by 0.3 m keep the distance at which the hulls that overlap by 1 mm are apart."""
    scene = CollisionScene(ARM, [Sphere(0.1, (0.5, 0, 0.5))])
    collisions = [Collision(0, scene.labels[0], -1e-3, 0.2, 0.3), Collision(1, scene.labels[1], -2e-3, 0.7)]
    margins = ClearanceConstraints(scene, {2: 0.1}).with_collisions(collisions).margins
    assert margins == {0: MARGIN - 0.3, 1: MARGIN, 2: 0.1}
    assert (
        ClearanceConstraints(scene, margins).with_collisions([Collision(0, scene.labels[0], -1e-3, 0.2)]).margins
        == margins
    )


def test_colliding_pairs_get_constraints_enlarged_by_their_deficit() -> None:
    around = CollisionScene(ARM, [Sphere(0.1, (0.5, 0, 0.5)), Sphere(0.1, (0, 0.5, 0.5))], clearance=0.02)
    assert 0 < MARGIN < 1e-4  # m: what is held apart is not visibly farther than it has to be
    clearance_constraints = ClearanceConstraints(around).with_pairs([0, 1])
    assert clearance_constraints.margins == {0: MARGIN, 1: MARGIN}
    assert ClearanceConstraints(around, {0: 0.5}).with_pairs([0, 1]).margins == {0: 0.5, 1: MARGIN}
    near = [nearest(around, pair, least) for pair, least in ((0, 0.012), (1, 0.02), (2, 0.019), (3, 0.5))]
    wider = clearance_constraints.widened([Clearance("clearance", tuple(near), True, 4)])
    assert wider.margins == pytest.approx({0: MARGIN + 1.5 * 0.008 + MARGIN, 1: MARGIN, 2: MARGIN})
    assert clearance_constraints.margins == {0: MARGIN, 1: MARGIN}


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_declared_distances_are_rounded_distances_at_the_time_of_the_scene(symbols: Any) -> None:
    around = CollisionScene(ARM, [BALL], clearance=0.02)
    pairs = [2, 0]
    clearance_constraints = ClearanceConstraints(around, {2: 0.1, 0: 0.3})
    problem = Problem("still", symbols=symbols)
    q = problem.state("joints", 4, lower=ARM.robot.lower, upper=ARM.robot.upper)
    problem.dynamics(q, problem.control("u", 4))
    problem.horizon(2.0)
    clearance_constraints.declare(problem, ARM.base_home(), begin=3.0, pace=0.5, horizon=2.0, suffix=" b")
    held, apart = problem.declared.path["apart b"], problem.declared.apart["clearance b"]
    assert_allclose(constant(held.lower), [0.02 + 0.3, 0.02 + 0.1])
    function = ca.Function("held", [q, problem.time], [held.expression, apart.placements])
    b, x, t = ca.SX.sym("b", 0), ca.SX.sym("q", 4), ca.SX.sym("t")
    exact = ca.Function("exact", [x, t], [around.distances(b, x, t), around.placements(b, x, t)])
    rng = np.random.default_rng(1)
    for configuration, time in zip(rng.uniform(-2, 2, (20, 4)), rng.uniform(0, 2, 20), strict=True):
        value, placed = (np.array(part).ravel() for part in function(configuration, time))
        known, frames = (np.array(part).ravel() for part in exact(configuration, 3.0 + 0.5 * time))
        below = known[sorted(pairs)] - value
        assert (below >= -1e-12).all()
        assert (below <= min(3 * ROUNDING, 0.01)).all()
        assert_allclose(placed, frames, atol=1e-12)
    assert_allclose(apart.least, 0.02)
    assert_allclose(
        np.hstack([apart.levers, apart.turns]), np.hstack([around.levers.joints, around.levers.joint_turns])
    )


def test_moving_obstacles_need_a_horizon_and_joints_their_limits() -> None:
    around = CollisionScene(ARM, [BALL])
    for limit, horizon, name in ((2.9, None, "obstacles"), (3.0, 1.0, "joint1")):
        problem = Problem("free")
        problem.state("joints", 4, lower=-limit, upper=limit)
        with pytest.raises(ProblemError) as caught:
            ClearanceConstraints(around).declare(problem, ARM.base_home(), horizon=horizon)
        assert caught.value.name == name


def swung(at: Any, end: float) -> Any:
    """From -1 rad to an end at an even pace."""
    return (-1.0 + (end + 1.0) * at)[:, None]


def test_a_ball_that_swings_past_a_post_is_as_near_as_a_chord() -> None:
    """The post stands in the way at an angle of 0.4 rad; the swing ends before, at 0.3: 2 sin(0.05) between centres."""
    around = CollisionScene(crane(), [Sphere(0.005, (np.cos(0.4), np.sin(0.4), 0.0))])
    breaks = np.linspace(0, 1, 5)
    rates, seconds = np.full((4, 1), 1.3 / 2.0), np.zeros((4, 1))
    for end, least in ((0.3, 2 * np.sin(0.05) - 0.105), (0.7, -0.105)):
        swing = partial(swung, end=end)
        result = clearance_of(around, swing, breaks, 2.0, rates=rates * (end + 1.0) / 1.3, seconds=seconds, smooth=True)
        assert result.settled
        assert result.worst is not None
        assert result.worst.distance == pytest.approx(least, abs=2e-3)
        assert result.worst.least <= least + 1e-9
        assert (result.worst.missed > 0) == (least < 0)
        assert result.worst.time == pytest.approx(2.0 if end < 0.4 else 2.0 * 1.4 / 1.7, abs=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_no_proof_claims_more_than_a_fine_sampling_shows(seed: int) -> None:
    """Random machines of 0.1 mm to 100 m, of thin boxes and needles, slides and followers, in 10 ms to 100 s."""
    rng = np.random.default_rng(seed)
    size, horizon, segments = 10.0 ** rng.uniform(-4, 1.5), 10.0 ** rng.uniform(-2, 2), int(rng.choice([1, 3, 17]))
    robot = random_robot(rng, size)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    obstacles: list[Any] = [
        Sphere(0.1 * size, rng.normal(size=3) * size),
        Box(size * 10.0 ** rng.uniform(-5, 0, 3), rng.normal(size=3) * size, turn * np.linalg.det(turn)),
        HalfSpace(7 * rng.normal(size=3), 2 * size * rng.normal(size=3)),
        Capsule(1e-4 * size, rng.normal(size=3) * size, rng.normal(size=3) * size),
    ]
    around = CollisionScene(FixedBase(robot), obstacles)
    factors = rng.normal(size=(4, robot.dof)) * (robot.upper - robot.lower) / 8

    def joints(at: Any, order: int = 0) -> Any:
        powers = [np.polyval(np.polyder(np.eye(4)[3 - k], order), at) for k in range(4)]
        return np.stack(powers, axis=-1) @ factors

    breaks = np.linspace(0, 1, segments + 1)
    within = breaks[:-1, None] + np.linspace(0, 1, 400) / segments
    rates, seconds = (np.abs(joints(within, k)).max(axis=1) * 1.001 / horizon**k for k in (1, 2))
    result = clearance_of(around, joints, breaks, horizon, rates=rates, seconds=seconds, smooth=True)
    assert result.settled
    times = np.linspace(0, 1, 2001)
    sampled = distances_along(around, np.zeros(0), joints(times), times * horizon).min(axis=0)
    known = dict(zip(around.labels, sampled, strict=True))
    assert len(result.pairs) == len(known) > 4
    for near in result.pairs:
        least = known[near.bodies]
        assert near.least <= max(least, 0.0) + 1e-9 * size
        assert (near.distance > 0) >= (least > 0)


def random_robot(rng: np.random.Generator, size: float) -> Robot:
    """Four links one after the other, each with a box, a capsule or a ball, on turns and slides, one that follows."""
    links, joints = [Link("link0", collisions=(CollisionShape("box", size * rng.uniform(0.05, 0.3, 3)),))], []
    for k in range(1, 5):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        kind: Any = ("box", "capsule", "sphere")[rng.integers(3)]
        sizes = {
            "box": size * rng.uniform(1e-3, 0.3, 3),
            "capsule": (size * 10.0 ** rng.uniform(-4, -1), size * rng.uniform(0.1, 0.5)),
            "sphere": (size * rng.uniform(0.01, 0.1),),
        }
        shape = CollisionShape(kind, sizes[kind], translation=0.1 * size * rng.normal(size=3), rotation=turn)
        links.append(Link(f"link{k}", collisions=(shape,)))
        slides = k > 1 and rng.random() < 0.4
        most = 0.4 * size if slides else 2.0
        more: dict[str, Any] = {"lower": -most, "upper": most}
        if k == 3:
            more = {"mimic": Mimic("joint1", float(rng.uniform(-1, 1)) * (size if slides else 1.0), 0.1 * most)}
        place: dict[str, Any] = {"translation": 0.3 * size * rng.normal(size=3), "rotation": turn}
        joint_kind: Any = "prismatic" if slides else "revolute"
        axis = rng.normal(size=3)
        joints.append(Joint(f"joint{k}", joint_kind, f"link{k - 1}", f"link{k}", axis=axis, **place, **more))
    return Robot(tuple(links), tuple(joints))


def refused_pair(around: CollisionScene, pair: int = 0, least: float = 0.0, name: str = "clearance") -> SolveError:
    """As of a solution that is sound but for the clearance of a pair."""
    proof = Clearance(name, (nearest(around, pair, least),), True, 1)
    audit = SimpleNamespace(clearances={name: proof}, failures=[Finding(name, 0.02 - least, 0.0, 0.5)])
    solution: Any = SimpleNamespace(audit=lambda: audit)
    result = collision_error(solution.audit(), solution)
    assert result is not None
    return result


def test_it_is_planned_anew_until_it_is_clear() -> None:
    around = CollisionScene(ARM, [Sphere(0.1, (0.5, 0, 0.5))], clearance=0.02)
    seen: list[dict[int, float]] = []

    def run(clearance_constraints: ClearanceConstraints | None) -> Any:
        assert clearance_constraints is not None
        seen.append(dict(clearance_constraints.margins))
        if len(seen) < MAX_SOLVES:
            raise refused_pair(around, pair=0, least=0.01)
        return "clear"

    result: Any = solve_with_clearance(ClearanceConstraints(around), run)
    assert result == "clear"
    margins = [MARGIN + k * (1.5 * 0.01 + MARGIN) for k in range(MAX_SOLVES - 1)]
    assert seen == [{}, *({0: pytest.approx(margin)} for margin in margins)]


def test_unavoidable_collisions_name_the_first_pair() -> None:
    around = CollisionScene(ARM, [Sphere(0.1, (0.5, 0, 0.5))], clearance=0.02)
    looks: list[int] = []

    def never(clearance_constraints: ClearanceConstraints | None) -> Any:
        looks.append(1)
        raise refused_pair(around, least=-0.01)

    with pytest.raises(SolveError, match=r"overlap by 0\.01 m at 0\.5 s") as caught:
        solve_with_clearance(ClearanceConstraints(around), never)
    assert len(looks) == MAX_SOLVES
    assert (caught.value.name, caught.value.value, caught.value.limit, caught.value.time) == (
        "clearance",
        0.03,
        0.0,
        0.5,
    )

    def stuck(clearance_constraints: ClearanceConstraints | None) -> Any:
        if clearance_constraints is not None and clearance_constraints.margins:
            raise SolveError("no way", name="solver")
        raise refused_pair(around, least=-0.01)

    with pytest.raises(SolveError, match=r"bodies collide.*separated, no motion was found: no way") as caught:
        solve_with_clearance(ClearanceConstraints(around), stuck)
    assert (caught.value.name, caught.value.time) == ("clearance", 0.5)

    def other(clearance_constraints: ClearanceConstraints | None) -> Any:
        raise SolveError("no way", name="solver")

    for clearance_constraints in (None, ClearanceConstraints(around)):
        with pytest.raises(SolveError, match=r"^no way$"):
            solve_with_clearance(clearance_constraints, other)

    def loose(clearance_constraints: ClearanceConstraints | None) -> Any:
        raise refused_pair(around)

    with pytest.raises(SolveError, match="bodies collide"):
        solve_with_clearance(None, loose)


def test_collisions_are_reported_where_all_else_holds() -> None:
    around = CollisionScene(ARM, [Sphere(0.1, (0.5, 0, 0.5))], clearance=0.02)
    result = refused_pair(around, least=0.01, name="clearance b")
    assert (result.name, result.value, result.limit, result.time) == ("clearance b", 0.01, 0.0, 0.5)
    sound: Any = SimpleNamespace(clearances={}, failures=[])
    assert collision_error(sound, sound) is None
    also: Any = SimpleNamespace(
        clearances={"clearance": Clearance("clearance", (), True, 0)},
        failures=[Finding("clearance", 1.0), Finding("dynamics", 1.0)],
    )
    assert collision_error(also, also) is None


def test_a_held_pair_of_a_solved_motion_keeps_its_margin_at_its_points() -> None:
    """A ball on a boom that has to pass a post in its way, above which it may not: it stops short by the margin."""
    crane_ = crane()
    around = CollisionScene(crane_, [Sphere(0.05, (np.cos(0.5), np.sin(0.5), 0.0))], clearance=0.01)
    problem = Problem("swing")
    q = problem.state("joints", 1, initial=-0.5, lower=-3.0, upper=3.0)
    u = problem.control("u", 1)
    problem.dynamics(q, u)
    problem.horizon(1.0)
    problem.minimize(u**2 / 100, -(q**1))
    ClearanceConstraints(around, {0: 2e-3}).declare(problem, crane_.base_home(), horizon=1.0)
    solution = solve(problem, Collocation(6, 2))
    apart = 2 * np.sin((0.5 - float(solution.at(1.0)["joints"][0])) / 2) - 0.15
    assert apart == pytest.approx(0.012, abs=1e-6)
    assert solution.audit()["clearance"].passed
