"""Clearance proofs against closed forms, fine sampling and thin walls, and their invariances."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from models.shapes.hull import gap_along, nearest_directions
from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, solve
from ocp.audit.clearance import Clearance, ProofSettings, Track, clearance_along, closest_pairs_along
from ocp.problem.hulls import Frames, Hull, Separation, frames_of

EYE = np.eye(3).ravel()


def flight(
    start: Any, end: Any, hulls: dict[str, Hull], pairs: Any, least: Any, horizon: float = 1.0, **more: Any
) -> Problem:
    """A frame that flies from one place to another in a smooth rest-to-rest motion."""
    problem = Problem("flight")
    q = problem.state("q", initial=start, terminal=end)
    v = problem.state("v", 3, initial=0, terminal=0)
    u = problem.control("u", 3)
    problem.horizon(horizon)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.minimize(ca.sumsqr(u) / 2)
    count = len(pairs)
    problem.separate(
        "clearance",
        ca.vertcat(EYE, q),
        hulls,
        pairs,
        least=least,
        levers={"q": np.ones((count, 3))},
        turns={"q": np.zeros((count, 3))},
        **more,
    )
    return problem


def proof(problem: Problem, intervals: int = 6) -> Clearance:
    result: Clearance = solve(problem, Collocation(intervals, 3)).audit().clearances["clearance"]
    return result


BALL = Hull(0, np.zeros((1, 3)), 0.1)


def test_a_ball_that_flies_past_a_ball() -> None:
    hulls = {"ball": BALL, "post": Hull(-1, np.array([[0.5, 0.3, 0.0]]), 0.05)}
    problem = flight([0, 0, 0], [1, 0, 0], hulls, [[0, 1, -1]], 0.1)
    result = proof(problem)
    assert result.settled
    assert result.worst is not None
    assert result.worst.bodies == ("ball", "post")
    assert 0.15 - 0.02 * 0.05 - 1e-6 <= result.worst.least <= 0.15 <= result.worst.distance + 1e-12
    assert result.worst.distance <= 0.15 / 0.98
    assert_allclose(result.worst.time, 0.5, atol=0.05)
    assert result.worst.missed == 0
    solution = solve(problem, Collocation(6, 3))
    assert solution.audit()["clearance"].passed
    assert "proven; least ball and post" in str(solution.audit())


def test_the_nearest_two_at_a_time() -> None:
    posts = {f"post {k}": Hull(-1, np.array([[x, 0.3, 0.0]]), 0.05) for k, x in enumerate((0.2, 0.8))}
    problem = flight([0, 0, 0], [1, 0, 0], {"ball": BALL, **posts}, [[0, 1, -1], [2, 0, 0]], 0.1)
    solution = solve(problem, Collocation(6, 3))  # the second pair is seen from the ball
    for time in (0.0, 0.3, 0.7, 1.0):
        (result,), x = closest_pairs_along(problem, solution, [time]), float(solution.at(time)["q"][0])
        assert result is not None
        assert set(result.bodies) == {"ball", "post 0" if time < 0.5 else "post 1"}
        assert_allclose(result.distance, np.hypot(x - (0.2 if time < 0.5 else 0.8), 0.3) - 0.15, atol=1e-9)
        ends = [[x, 0, 0], [0.2 if time < 0.5 else 0.8, 0.3, 0]]
        assert_allclose(result.points, ends if result.bodies[0] == "ball" else ends[::-1], atol=1e-9)
    free = Problem("free")
    q = free.state("q", initial=0.0)
    free.dynamics(q, free.control("u"))
    free.horizon(1.0)
    free.minimize(q**2)
    assert closest_pairs_along(free, solve(free, Collocation(3, 2)), [0.5]) == []


def test_the_worst_pair_has_the_largest_deficit_of_clearance() -> None:
    """One is nearer, and may be; the other one is farther off, and not far enough."""
    posts = {f"post {k}": Hull(-1, np.array([[0.5, y, 0.0]]), 0.0) for k, y in enumerate((0.3, -0.6))}
    problem = flight([0, 0, 0], [1, 0, 0], {"ball": BALL, **posts}, [[0, 1, -1], [0, 2, -1]], [0.1, 0.7])
    near, far = proof(problem).pairs[::-1]
    assert (near.bodies[1], far.bodies[1]) == ("post 0", "post 1")
    assert near.missed == 0
    assert far.missed == pytest.approx(0.2, abs=0.01)


def test_the_nearest_pair_is_named_however_loose_the_bound_of_another() -> None:
    """Distant pairs have a bound only, which may be below the smallest distance of the closest pair."""
    far = {f"far {k}": Hull(-1, np.array([[0.4, y, 0.0]]), 0.0) for k, y in enumerate(np.linspace(0.31, 0.9, 200))}
    hulls = {"ball": BALL, "near": Hull(-1, np.array([[0.5, 0.3, 0.0]]), 0.0), **far}
    result = proof(flight([0, 0, 0], [1, 0, 0], hulls, [[0, k, -1] for k in range(1, len(hulls))], 0.0))
    assert result.worst is not None
    assert result.worst.bodies == ("ball", "near")
    assert result.worst.distance == min(one.distance for one in result.pairs)


@pytest.mark.parametrize(("thickness", "horizon"), [(1e-2, 1e2), (1e-4, 1.0), (1e-6, 1e-2), (1e-6, 1e2)])
def test_a_wall_thinner_than_the_step_between_two_samples(thickness: float, horizon: float) -> None:
    wall = np.array([[0.437, y, z] for y in (-1, 1) for z in (-1, 1)], dtype=float)
    point = Hull(0, np.zeros((1, 3)), 0.0)
    problem = flight(
        [0, 0, 0], [1, 0, 0], {"point": point, "wall": Hull(-1, wall, thickness)}, [[0, 1, -1]], 0.0, horizon
    )
    audit = solve(problem, Collocation(4, 3)).audit()
    assert not audit["clearance"].passed
    assert not audit.feasible
    assert audit.clearances["clearance"].settled
    assert audit["clearance"].time == pytest.approx(audit.clearances["clearance"].pairs[0].time)


@given(st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_bounds_lie_below_a_fine_sampling_and_near_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = {
        f"body {i}": Hull(int(rng.integers(-1, 1)), rng.normal(size=(m, 3)) * 0.3, 0.05)
        for i, m in enumerate((1, 2, 4, 8))
    }
    bodies["flying"] = Hull(0, rng.normal(size=(2, 3)) * 0.3, 0.1)
    names = list(bodies)
    pairs = [[names.index("flying"), i, -1] for i in range(4) if bodies[f"body {i}"].frame == -1]
    if not pairs:
        return
    problem = flight([-2, 0.1, 0], [2, 0.1, 0.3], bodies, pairs, 0.0)
    solution = solve(problem, Collocation(5, 3))
    result = solution.audit().clearances["clearance"]
    q = solution.at(np.linspace(0, 1, 4001))["q"]
    for one in result.pairs:
        a, b = (bodies[name] for name in one.bodies)
        sides = [part.core[None] + (q[:, None] if part.frame == 0 else 0 * q[:, None]) for part in (a, b)]
        sampled = (gap_along(nearest_directions(*sides)[0], *sides) - a.radius - b.radius).min()
        if sampled < -a.radius - b.radius:  # the hulls overlap, by a depth that is known from below alone
            assert one.least < 0
            continue
        assert one.least <= sampled + 1e-9
        assert one.distance >= sampled - 1e-3
        if result.settled and one is result.worst and 0 <= sampled < 0.2:
            assert one.least >= sampled - 0.021 * sampled - 1e-6 - 1e-6


def test_bodies_moved_by_time_alone() -> None:
    """A post that crosses the way: seen at the right time, in between."""
    problem = Problem("crossing")
    q = problem.state("q", initial=[0, 0, 0], terminal=[1, 0, 0])
    u = problem.control("u", 3)
    problem.horizon(1.0)
    problem.dynamics(q, u)
    problem.minimize(ca.sumsqr(u) / 2)
    post = ca.vertcat(EYE, 0.5, 1.0 - 2.0 * problem.time, 0.0)
    hulls = {"ball": BALL, "post": Hull(1, np.zeros((1, 3)), 0.1)}
    problem.separate(
        "clearance", ca.vertcat(EYE, q, post), hulls, [[0, 1, -1]], least=0.0,
        levers={"q": np.ones((1, 3))}, turns={"q": np.zeros((1, 3))},
    )  # fmt: skip
    result = proof(problem, 3)
    assert result.worst is not None
    assert result.worst.missed > 0.19
    assert_allclose(result.worst.time, 0.5, atol=0.01)


def test_a_half_space() -> None:
    ground = Hull(-1, np.array([[5.0, 7.0, -0.5]]), 0.0, np.array([0.0, 0.0, 1.0]))
    rod = Hull(0, np.array([[0, 0, 0.2], [0, 0, -0.2]]), 0.05)
    for pair in ([0, 1, -1], [1, 0, -1]):
        result = proof(flight([0, 0, 0], [0, 0, -0.2], {"ground": ground, "rod": rod}, [pair], 0.0))
        assert result.worst is not None
        assert_allclose(result.worst.distance, 0.05, atol=1e-9)
        assert 0.04 <= result.worst.least <= 0.05


def test_time_and_length_rescaled_change_no_verdict() -> None:
    for scale, horizon in ((1.0, 1.0), (1.0, 1e3), (1.0, 1e-3), (10.0, 1.0)):
        hulls = {
            "ball": Hull(0, np.zeros((1, 3)), 0.1 * scale),
            "post": Hull(-1, np.array([[0.5, 0.3, 0.0]]) * scale, 0.05 * scale),
        }
        problem = flight([0, 0, 0], [scale, 0, 0], hulls, [[0, 1, -1]], 0.1 * scale, horizon)
        result = proof(problem)
        assert result.settled
        assert result.worst is not None
        assert_allclose(result.worst.distance / scale, 0.15, rtol=0.03)
        assert_allclose(result.worst.time / horizon, 0.5, atol=0.05)


# ---- what is hollow ----------------------------------------------------------------------------------------------

BARS = {
    f"bar {k}": Hull(-1, np.array([[0.2, y, z], [0.8, y, z]]), 0.05)
    for k, (y, z) in enumerate(((0.3, 0.0), (-0.3, 0.0), (0.0, -0.5)))
}
HOLLOW = {"ball": BALL, "frame": Hull(-1, np.vstack([bar.core for bar in BARS.values()]), 0.05), **BARS}
"""A ball, the hull of three bars, and the bars, between which it flies."""
OF_BARS = {0: [[0, 2], [0, 3], [0, 4]]}


def test_distances_inside_a_hollow_are_those_of_its_cover() -> None:
    """The hull fills it; the nearest bar is 0.15 m off all the way, which is proven to a micrometre."""
    hull = proof(flight([0, 0, 0], [1, 0, 0], HOLLOW, [[0, 1, -1]], 0.1)).worst
    assert hull is not None
    assert hull.distance < -0.1
    for request, passes in ((0.1, True), (0.15 - 2e-6, True), (0.15 + 2e-6, False)):
        result = proof(flight([0, 0, 0], [1, 0, 0], HOLLOW, [[0, 1, -1]], request, covers=OF_BARS))
        assert result.settled
        assert result.worst is not None
        assert (result.worst.missed == 0) == passes
        assert result.worst.bodies == ("ball", "frame")
        assert_allclose(result.worst.distance, 0.15, atol=1e-9)
        assert result.worst.least == pytest.approx(0.15, abs=1.1e-3)
        assert result.n_intervals < 2000  # the bound of second order holds for what covers, too
        ball, bar = result.worst.points
        assert_allclose(bar, [min(max(ball[0], 0.2), 0.8), np.copysign(0.3, bar[1]), 0.0], atol=1e-9)


def test_covers_that_stand_out_take_nothing_away() -> None:
    """Beside bars that are swelled the hull says more; one bar that always touches leaves what the hull says."""
    thick = {name: replace(bar, radius=0.1) for name, bar in BARS.items()}
    colliding = {**BARS, "bar 2": Hull(0, np.zeros((1, 3)), 0.1)}
    for bars in (thick, colliding):
        problem = flight([0, 0.6, 0], [1, 0.6, 0], {**HOLLOW, **bars}, [[0, 1, -1]], 0.1, covers=OF_BARS)
        result = proof(problem)
        assert result.settled
        assert result.worst is not None
        assert_allclose(result.worst.distance, 0.15, atol=1e-9)


def test_a_fault_between_bars_and_between_nodes_is_found() -> None:
    """A post thinner than a step that stands in the hollow is one of what covers."""
    post = {"bar 1": Hull(-1, np.array([[0.437, 0.1, 0.0]]), 1e-5)}
    for least, passes in ((-1e-3, True), (1e-3, False)):
        problem = flight([0, 0, 0], [1, 0, 0], {**HOLLOW, **post}, [[0, 1, -1]], least, covers=OF_BARS)
        result = proof(problem, 4)
        assert result.settled
        assert result.worst is not None
        assert (result.worst.missed == 0) == passes
        assert not result.worst.missed or result.worst.time == pytest.approx(0.45, abs=0.05)


@pytest.mark.long
@given(st.integers(0, 10**6))
@example(3289)  # the hull says how far they are apart at one end of an interval, what covers it at the other
@settings(max_examples=10, deadline=None)
def test_with_covers_it_is_the_larger_of_both_at_every_time(seed: int) -> None:
    """Beside a fine sampling, however the hulls lie; some pairs with covers and some without, in any order."""
    rng = np.random.default_rng(seed)
    hulls = {"flying": Hull(0, rng.normal(size=(2, 3)) * 0.2, 0.05)}
    pairs, covers = [], {}
    for i in range(3):
        middle, first = rng.normal(size=3) * 0.4, len(hulls)
        parts = [Hull(-1, middle + rng.normal(size=(2, 3)) * 0.3, rng.uniform(0.02, 0.1)) for _ in range(3)]
        whole = Hull(-1, np.vstack([part.core for part in parts]), 0.03)
        hulls |= {f"hull {i}": whole} | {f"part {i} {k}": part for k, part in enumerate(parts)}
        if i != 1:
            covers[i] = [[0, first + 1 + k] for k in range(3)]
        pairs.append([0, first, -1])
    problem = flight([-2, 0.1, 0], [2, 0.1, 0.3], hulls, pairs, 0.0, covers=covers)
    solution = solve(problem, Collocation(5, 3))
    result, bodies = solution.audit().clearances["clearance"], tuple(hulls.values())
    q = solution.at(np.linspace(0, 1, 2001))["q"]

    def apart(other: int) -> np.ndarray:
        sides = bodies[0].core[None] + q[:, None], np.tile(bodies[other].core, (len(q), 1, 1))
        return np.asarray(gap_along(nearest_directions(*sides)[0], *sides) - bodies[0].radius - bodies[other].radius)

    for one in result.pairs:
        i = int(one.bodies[1].split()[1])
        report = apart(pairs[i][1])
        if i in covers:
            report = np.maximum(report, np.min([apart(other) for _, other in covers[i]], axis=0))
        sampled = report.min()
        assert one.least <= max(sampled, 0.0) + 1e-9
        if sampled > 0:
            assert one.distance >= sampled - 2e-3
            if result.settled and one is result.worst:
                assert one.least >= sampled - 0.021 * sampled - 2e-6
        else:
            assert one.least <= 0.0


def test_covers_stay_with_their_pair() -> None:
    """Whichever pairs are taken, however often they are saved."""
    count = 3
    pairs = [[0, 2, -1], [0, 1, -1], [3, 0, -1]]
    apart = Separation(
        "clearance", ca.SX.sym("place", 12), HOLLOW, np.array(pairs), np.zeros(count), {"q": 3},
        np.ones((count, 3)), np.zeros((count, 3)),
        {1: np.array(OF_BARS[0]), 2: np.zeros((0, 2))},
    )  # fmt: skip
    assert list(apart.covers) == [1]
    some = apart.of([2, 1])
    assert list(some.covers) == [1]
    assert_allclose(some.covers[1], OF_BARS[0])
    assert not apart.of([0, 2]).covers
    assert not apart.of([]).covers


def test_covers_are_saved_with_a_plan(tmp_path: Any) -> None:
    solution = solve(flight([0, 0, 0], [1, 0, 0], HOLLOW, [[0, 1, -1]], 0.1, covers=OF_BARS), Collocation(6, 3))
    solution.save(tmp_path / "plan.npz")
    result = Solution.load(tmp_path / "plan.npz").audit().clearances["clearance"].worst
    assert result is not None
    assert result.missed == 0


# ---- what bends, and how finely it is looked at --------------------------------------------------------------------


SETTINGS = ProofSettings()


def swinging(
    low: float, segments: int = 1, smooth: bool = True, request: float = 0.0, settings: ProofSettings = SETTINGS
) -> Clearance:
    """A point on a slide on an arm that turns, past a floor 1 m below where it passes the axis.

    Its distance from the axis grows by 1 m/s, the arm turns by 0.1 rad/s; it passes at a share of the 1 s. The height
    1 + s sin(0.1 s), s = t - share, is least there, and bends by Coriolis' acceleration of 0.2 m/s^2.
    """
    reach = max(low, 1 - low)
    place = ca.SX.sym("place", 12)
    apart = Separation(
        "clearance", place, {"point": Hull(0, np.zeros((1, 3))), "floor": Hull(-1, np.array([[0, -1.0, 0]]), 0.0, UP)},
        np.array([[0, 1, -1]]), np.array([1.0 + request]), {"slide": 1, "turn": 1},
        np.array([[1.0, reach]]), np.array([[0.0, 1.0]]),
    )  # fmt: skip

    def frames(at: np.ndarray) -> Frames:
        s = at - low
        places = np.stack([s * np.cos(0.1 * s), s * np.sin(0.1 * s), 0 * s], axis=1)
        return frames_of(np.hstack([np.tile(EYE, (len(at), 1)), places]))

    rates, seconds = np.tile([[1.0, 0.1]], (segments, 1)), np.zeros((segments, 2))
    track = Track(np.linspace(0, 1, segments + 1), 1.0, rates, seconds, smooth, frames)
    return clearance_along(apart, track, settings)


UP = np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize("low", [0.3, 0.45, 0.6, 0.81])
def test_sliding_on_a_rotating_body_curves_by_coriolis(low: float) -> None:
    """The required clearance is violated briefly, between all samples of the first pass."""
    result = swinging(low, request=4e-4).worst
    assert result is not None
    assert result.missed > 0
    assert result.least <= 1.0 <= result.distance + 1e-15
    clearance_constraints = swinging(low, request=-1e-2)
    assert clearance_constraints.settled
    assert clearance_constraints.worst is not None
    assert clearance_constraints.worst.missed == 0


@pytest.mark.parametrize("smooth", [True, False])
def test_the_proof_does_not_depend_on_the_segmentation_of_a_track(smooth: bool) -> None:
    """The first pass combines segments in blocks; the last of an odd number is separate."""
    for segments in (1, 2, 7, 128, 129, 1001):
        result = swinging(0.3137, segments, smooth, request=-0.5)
        assert result.settled
        assert result.worst is not None
        assert 1.0 - 0.02 * 0.5 <= result.worst.least <= 1.0 <= result.worst.distance <= 1.01
        assert result.n_intervals < 3 * max(segments, 20)


@pytest.mark.parametrize("segments", [1, 5, 129, 300, 1001])
@pytest.mark.parametrize("smooth", [True, False])
def test_collisions_between_the_first_samples_are_detected(segments: int, smooth: bool) -> None:
    """Half way between two of them in some piece, by half as much as it bends in between."""
    for share in (0.1, 0.37, 0.5, 0.63, 0.999):
        low = (np.floor(share * segments) + 0.25) / segments
        result = swinging(low, segments, smooth, request=0.1 * (0.25 / segments) ** 2 / 2).worst
        assert result is not None
        assert result.missed > 0


@pytest.mark.parametrize("segments", [1, 5, 300])
def test_no_time_beyond_the_ends_is_checked(segments: int) -> None:
    """Where it would come nearer after the end, or had come before the start, the end or the start is nearest."""
    for low, time in ((1.3, 1.0), (-0.3, 0.0)):
        result = swinging(low, segments, request=-0.5).worst
        assert result is not None
        assert result.time == time
        assert result.distance == pytest.approx(1 + 0.3 * np.sin(0.03), abs=1e-12)
        assert result.least <= result.distance


@pytest.mark.parametrize("unit", [1e-2, 1.0, 1e2])
def test_the_unit_of_a_state_does_not_matter(unit: float) -> None:
    """A point that dips to a height of 1 m after 0.3 s, in units of cm, m or 100 m."""
    hulls = {"point": Hull(0, np.zeros((1, 3))), "floor": Hull(-1, np.zeros((1, 3)), 0.0, UP)}
    one, rate, second = np.ones((1, 1)), np.array([[1.4 / unit]]), np.array([[2.0 / unit]])

    def frames(at: np.ndarray) -> Frames:
        heights = (1 + (at - 0.3) ** 2)[:, None] * UP
        return frames_of(np.hstack([np.tile(EYE, (len(at), 1)), heights]))

    for request in (0.5, 0.99, 1.0 + 1e-3):
        apart = Separation(
            "clearance", ca.SX.sym("place", 12), hulls, np.array([[0, 1, -1]]), np.array([request]), {"height": 1},
            unit * one, 0 * one,
        )  # fmt: skip
        result = clearance_along(apart, Track(np.array([0.0, 1.0]), 1.0, rate, second, True, frames))
        assert result.settled
        assert result.worst is not None
        assert (result.worst.missed > 0) == (request > 1)
        assert result.worst.least <= 1.0
        assert result.n_intervals < 60


def test_the_least_distance_is_known_to_two_hundredths_and_no_better_than_need_be() -> None:
    """Of what it is more than is asked, over many places and sizes; of a pair that touches as well."""
    for sign in (1.0, -1.0):
        spare = sign * np.geomspace(1e-3, 0.9, 16)
        shares = []
        for k, each in enumerate(spare):
            worst = swinging(0.2 + 0.04 * k, request=-each).worst
            assert worst is not None
            shares.append((worst.distance - worst.least) / abs(worst.distance - worst.required))
        assert 0.01 < max(shares) <= 0.02 + 1e-9
    worst = swinging(0.3137, request=1e-5).worst
    assert worst is not None
    assert 1e-7 < worst.distance - worst.least <= 1e-6


def test_proofs_that_exceed_their_effort_are_inconclusive() -> None:
    """The result is still a lower bound, and the number of intervals stays within its limit."""
    assert swinging(0.3137, request=-1e-5).settled
    short = swinging(0.3137, request=-1e-5, settings=ProofSettings(most_intervals=12))
    assert not short.settled
    assert short.n_intervals <= 12
    assert short.worst is not None
    assert short.worst.least <= 1.0
    assert short.worst.missed > 0
    assert str(short).startswith("not proven")
    assert not swinging(0.3137, request=-1e-5, settings=ProofSettings(halvings=2)).settled


def test_a_plan_of_held_controls_and_one_that_was_saved(tmp_path: Any) -> None:
    hulls = {"ball": BALL, "post": Hull(-1, np.array([[0.5, 0.3, 0.0]]), 0.05)}
    problem = flight([0, 0, 0], [1, 0, 0], hulls, [[0, 1, -1]], 0.1)
    solution = solve(problem, MultipleShooting(12))
    result = solution.audit().clearances["clearance"]
    assert result.settled
    assert result.worst is not None
    assert result.worst.missed == 0
    solution.save(tmp_path / "plan.npz")
    again = Solution.load(tmp_path / "plan.npz").audit().clearances["clearance"]
    assert_allclose(again.pairs[0].least, result.worst.least, rtol=1e-12)
    assert str(pickle.loads(pickle.dumps(problem))) == str(problem)


def test_a_plan_that_was_moved_fails() -> None:
    hulls = {"ball": BALL, "post": Hull(-1, np.array([[0.5, 0.3, 0.0]]), 0.05)}
    solution = solve(flight([0, 0, 0], [1, 0, 0], hulls, [[0, 1, -1]], 0.1), Collocation(6, 3))
    curve = solution.state_interpolant
    values = curve.values.copy()
    values[2:4, :, 1] += 0.2
    moved = replace(solution, state_interpolant=replace(curve, values=values))
    assert not moved.audit()["clearance"].passed


GOOD: dict[str, Any] = {"hulls": {"a": BALL, "b": Hull(-1, np.zeros((1, 3)), 0.1)}, "pairs": [[0, 1, -1]], "least": 0.0}
BAD: dict[str, dict[str, Any]] = {
    "pair-of-itself": {"pairs": [[0, 0, -1]]},
    "pair-of-none": {"pairs": [[0, 2, -1]]},
    "frame-of-none": {"pairs": [[0, 1, 3]]},
    "least-nan": {"least": np.nan},
    "least-of-another-size": {"least": [0.0, 1.0]},
    "covers-of-no-pair": {"covers": {1: [[0, 1]]}},
    "covers-of-a-truth": {"covers": {True: [[0, 1]]}},
    "covers-by-name": {"covers": {"a": [[0, 1]]}},
    "covers-of-itself": {"covers": {0: [[1, 1]]}},
    "covers-of-none": {"covers": {0: [[0, -1]]}},
    "covers-nan": {"covers": {0: [[0, np.nan]]}},
    "covers-of-three": {"covers": {0: [[0, 1, 1]]}},
    "pairs-endless": {"pairs": [[0, np.inf, -1]]},
    "pairs-between-bodies": {"pairs": [[0, 0.5, -1]]},
    "pairs-of-two": {"pairs": [[0, 1]]},
    "covers-text": {"covers": "all"},
    "half-space-that-moves": {"hulls": {"a": BALL, "b": Hull(0, np.zeros((1, 3)), 0.0, np.array([0, 0, 1.0]))}},
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_declarations(case: str) -> None:
    options = {**GOOD, **BAD[case]}
    with pytest.raises(ProblemError):
        flight([0, 0, 0], [1, 0, 0], options.pop("hulls"), options.pop("pairs"), options.pop("least"), **options)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("core", (0, np.zeros((0, 3)))),
        ("core", (0, np.full((1, 3), np.nan))),
        ("radius", (0, np.zeros((1, 3)), -1.0)),
        ("normal", (0, np.zeros((1, 3)), 0.0, np.array([1.0, 1.0, 0.0]))),
    ],
)
def test_invalid_bodies(name: str, values: tuple[Any, ...]) -> None:
    with pytest.raises(ProblemError, match=name):
        Hull(*values)


def test_pairs_ignored_by_assumption_are_reported_with_the_clearance(tmp_path: Any) -> None:
    hulls = {"ball": BALL, "post": Hull(-1, np.array([[0.5, 0.5, 0.0]]), 0.05)}
    assumed = {"hand and box": "always touch", **{f"a{k} and b{k}": "always touch" for k in range(5)}}
    solution = solve(flight([0, 0, 0], [1, 0, 0], hulls, [[0, 1, -1]], 0.1, assumed=assumed), Collocation(6, 3))
    solution.save(tmp_path / "plan.npz")
    for each in (solution, Solution.load(tmp_path / "plan.npz")):
        audit = each.audit()
        note = audit["clearance"].note
        assert note.startswith("proven; least ball and post")
        assert "left out by assumption: hand and box (always touch)" in note
        assert "2 more" in note
        assert audit.clearances["clearance"].assumed == assumed


@pytest.mark.parametrize(
    ("motion", "least", "word"),
    [
        (lambda t: ca.if_else(ca.fabs(t - 0.40321) < 1e-6, ca.fabs(t - 0.40321) / 1e-6, 1.0), -0.2, "violated"),
        (lambda t: ca.if_else(ca.fabs(t - 0.40321) < 1e-6, 0.0, 1.0), -0.2, "violated"),
        (lambda t: 1.0 - 2.0 * (t > 0.40321), -1.2, "not proven.*jumps by up to 2 m at 0.40321 s"),
        (lambda t: 1.0 / (t - 0.40321), -np.inf, "not proven.*has no bound at 0.40321 s"),
        (lambda t: ca.fmax(ca.fabs(8 * t - 4) / 8 + 0.5, 0.6), 0.4, "proven"),
        (lambda t: 0.5 + ca.sqrt(ca.fabs(t - 0.5)), 0.3, "proven"),
    ],
    ids=["spike", "jump there and back", "jump past", "pole", "kinks", "root"],
)
def test_kinks_are_proven_spikes_of_a_microsecond_are_found_and_jumps_are_named(
    motion: Any, least: float, word: str
) -> None:
    problem = Problem("beside")
    q = problem.state("q", initial=[0, 0, 0], terminal=[1, 0, 0])
    u = problem.control("u", 3)
    problem.horizon(1.0)
    problem.dynamics(q, u)
    problem.minimize(ca.sumsqr(u) / 2)
    post = ca.vertcat(EYE, 0.4, motion(problem.time), 0.0)
    hulls = {"ball": BALL, "post": Hull(1, np.zeros((1, 3)), 0.1)}
    problem.separate(
        "clearance", ca.vertcat(EYE, q, post), hulls, [[0, 1, -1]], least=0.0,
        levers={"q": np.ones((1, 3))}, turns={"q": np.zeros((1, 3))},
    )  # fmt: skip
    result = proof(problem, 3)
    assert result.worst is not None
    assert re.match(word, str(result)), str(result)
    assert result.worst.least == pytest.approx(least, abs=0.02)
