"""The globally best roll of the captive trajectory rig against dense grids, its arcs, limits and bad input."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import ModelError, Rig, Tunnel, optimal_inverse, reference_rig, reference_tunnel, solve_table
from models.cts.rig import BRANCHES, HOME, INCH, Branch, forward, inverse
from models.cts.roll import ACTIVE, STATUS
from models.cts.table import reachable_rolls
from models.cts.trigonometric import Harmonics, least_point, roots, series_roots
from tests.families import some
from tests.models.cts.cts_oracle import Array, grid_minimum, index_by_geometry, joints_by_geometry, random_targets

LIMITS: dict[str, Any] = {"lower": (0.2, -3.0, -2.0, -1.2, 0.3, -2.0), "upper": (1.6, -0.2, 2.2, 1.1, 2.6, 2.5)}
WIDE: dict[str, Any] = {"lower": (-np.inf, -3.0, -2.0, -1.2, 0.3, -4.0), "upper": (np.inf, 2.9, 2.2, 1.1, 2.6, 4.5)}
REFERENCE = {-15: 0.331364, -7.5: 0.682290, 0: np.pi / 2, 7.5: 2.459303, 15: 2.810229}
seeds = st.integers(0, 2**32 - 1)
RIG, LIMITED, TUNNEL = reference_rig(), reference_rig(**LIMITS), reference_tunnel()


def run(function: Any, targets: Array, previous: Array) -> tuple[Array, Array, Array, Array]:
    joints, cost, active, status = (np.array(part) for part in function.map(targets.shape[1])(targets, previous[None]))
    return joints, cost[0], active[0].astype(int), status[0].astype(int)


def check_against_grid(
    rig: Rig, tunnel: Tunnel, branch: Branch, targets: Array, previous: Array, points: int, rate_weight: float = 0.0
) -> tuple[Array, Array]:
    """No roll of the grid is better, none is found where we say there is none, and the joints hold the target."""
    function = optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight)
    joints, cost, active, status = run(function, targets, previous)
    gain = rate_weight / (2 * np.pi)
    best = grid_minimum(rig, tunnel, targets, branch, points, gain, previous)
    fine = status == 0
    assert np.isnan(joints[:, ~fine]).all()
    assert int((np.where(fine, cost, np.inf) > best + 1e-10).sum()) == 0
    if not fine.any():
        return active[fine], status
    q = joints[:, fine]
    assert (q >= rig.lower[:, None]).all()
    assert (q <= rig.upper[:, None]).all()
    symbol = ca.SX.sym("q", 6)
    pose = np.array(ca.Function("f", [symbol], [forward(rig, symbol)]).map(q.shape[1])(q))
    np.testing.assert_allclose(pose[:3], targets[:3, fine], atol=1e-11)
    np.testing.assert_allclose(np.exp(1j * pose[3:5]), np.exp(1j * targets[3:, fine]), atol=1e-11)
    index = index_by_geometry(rig, tunnel, targets[:, fine], q[5])
    np.testing.assert_allclose(index + gain * (q[5] - previous[fine]) ** 2, cost[fine], atol=1e-11)
    return active[fine], status


@pytest.mark.parametrize("z", REFERENCE)
def test_reference_rolls(z: float) -> None:
    target = np.array([100, 6, z, 0, 0]) * [INCH, INCH, INCH, 1, 1]
    joints, _, active, status = optimal_inverse(RIG, TUNNEL)(target, 0.0)
    assert float(joints[5]) == pytest.approx(REFERENCE[z], abs=1e-6)
    assert (int(active), int(status)) == (0, 0)


@pytest.mark.parametrize("count", some([10_000, 100_000], [10_000]))
def test_no_target_misses_the_global_minimum_of_i1(count: int) -> None:
    rng = np.random.default_rng(5)
    targets, previous = random_targets(rng, count), np.zeros(count)
    active, status = check_against_grid(RIG, TUNNEL, HOME, targets, previous, 120)
    names = {ACTIVE[code] for code in np.unique(active)}
    assert names == {"free", "pitch reach", "yaw reach"}
    assert {STATUS[code] for code in np.unique(status)} == {"ok", "pitch link out of reach", "yaw link out of reach"}
    assert 0.1 < np.mean(active != 0) < 0.5  # the free optimum is often out of reach


@pytest.mark.parametrize("count", some([1000, 10_000], [1000]))
@pytest.mark.parametrize("rate_weight", [0.05, 0.5, 5.0])
def test_no_target_misses_the_global_minimum_of_i2(rate_weight: float, count: int) -> None:
    rng = np.random.default_rng(int(100 * rate_weight))
    targets, previous = random_targets(rng, count), rng.uniform(-4, 4, count)
    check_against_grid(RIG, TUNNEL, HOME, targets, previous, 240, rate_weight)


@pytest.mark.parametrize("limits", [LIMITS, WIDE])
@pytest.mark.parametrize("rate_weight", some([0.0, 0.3, 5.0], [0.0, 0.3]))
def test_joint_limits_hold_and_no_better_roll_is_within_them(limits: dict[str, Any], rate_weight: float) -> None:
    rng = np.random.default_rng(8)
    targets, previous = random_targets(rng, 4000), rng.uniform(-2, 2, 4000)
    rig = reference_rig(**limits)
    active, _ = check_against_grid(rig, reference_tunnel(), HOME, targets, previous, 360, rate_weight)
    if limits is LIMITS:
        assert {f"joint {k}" for k in (1, 2, 3, 5, 6)} <= {ACTIVE[code][:7] for code in active}


@pytest.mark.long
@settings(max_examples=8)  # each builds a search of its own
@given(st.lists(st.floats(0.05, 2.0), min_size=6, max_size=6), seeds, st.sampled_from(BRANCHES))
def test_other_rigs_tunnels_and_branches(sizes: list[float], seed: int, branch: Branch) -> None:
    rng = np.random.default_rng(seed)
    middle, half = rng.uniform(-2, 2, 6), rng.uniform(0.5, 4, 6)
    limits: dict[str, Any] = {"lower": middle - half, "upper": middle + half} if seed % 2 else {}
    rig = Rig(*sizes, **limits)
    tunnel = Tunnel(rng.normal(size=3), rng.uniform(0.3, 2, 3), rng.uniform(0, 2, 3))
    q = np.vstack([rng.uniform(-2, 2, 40), rng.uniform(-np.pi, np.pi, (5, 40))])
    symbol = ca.SX.sym("q", 6)
    targets = np.array(ca.Function("f", [symbol], [forward(rig, symbol)]).map(40)(q))[:5]
    rate_weight = float(rng.choice([0.0, 0.1, 2.0]))
    check_against_grid(rig, tunnel, branch, targets, rng.uniform(-3, 3, 40), 240, rate_weight)


@pytest.mark.long
@pytest.mark.parametrize(
    ("yaw", "limits"),
    [
        (None, {"lower": (1.2, -1.2, -4.8, -2.3, -1.9, -4.0), "upper": (1.6, 3.9, 1.2, 2.8, 2.8, 0.5)}),
        (None, {"lower": (0.2, -3.8, -2.8, -3.7, -3.0, -3.5), "upper": (0.9, 1.2, 3.2, 1.1, 3.1, 2.2)}),
        (0.0, {"lower": (0.5, *[-np.inf] * 5), "upper": (1.0, *[np.inf] * 5)}),
        (np.pi / 2, {}),
        (0.0, {}),
    ],
)
@pytest.mark.parametrize("branch", some([Branch(-1, -1), Branch(1, 1)], 1))
def test_several_arcs_and_special_yaws(yaw: float | None, limits: dict[str, Any], branch: Branch) -> None:
    """Limits that leave out a window, so that arcs end and begin again; equations with double roots."""
    rng = np.random.default_rng(12)
    rig = Rig(0.76, 0.44, 0.22, 1.32, 0.95, 1.5, **limits)
    low, high = np.maximum(rig.lower, -np.pi), np.minimum(rig.upper, np.pi)
    q, symbol = rng.uniform(low[:, None], high[:, None], (6, 1500)), ca.SX.sym("q", 6)
    targets = np.array(ca.Function("f", [symbol], [forward(rig, symbol)]).map(1500)(q))[:5]
    if yaw is not None:
        targets[3] = yaw
        targets[4, ::2] = 0.0
    tunnel = Tunnel((-0.6, -0.8, 2.0), (1.2, 1.7, 1.3), (1.2, 0.8, 0.2))
    for rate_weight in (0.0, 0.5):
        check_against_grid(rig, tunnel, branch, targets, rng.uniform(-3, 3, 1500), 480, rate_weight)


def test_closed_form_without_limits_is_the_least_index_of_all_rolls() -> None:
    rng = np.random.default_rng(2)
    targets = random_targets(rng, 2000)
    _, cost, active, status = run(optimal_inverse(RIG, TUNNEL, limits=False), targets, np.zeros(2000))
    best = np.min([index_by_geometry(RIG, TUNNEL, targets, roll) for roll in np.linspace(-np.pi, np.pi, 720)], axis=0)
    assert (cost[status == 0] <= best[status == 0] + 1e-12).all()
    assert (active == 0).all()
    assert 0.05 < np.mean(status != 0) < 0.9


def test_equal_weights_have_the_closed_form_of_one_harmonic() -> None:
    rig = reference_rig()
    tunnel = Tunnel(reference_tunnel().center, (1.0, 1.0, 1.0))
    target = np.array([2.5, 0.2, 0.1, 0.0, 0.0])
    roll = float(optimal_inverse(rig, tunnel, limits=False)(target, 0.0)[0][5])
    offset = target[:3] - [rig.sting, 0, 0] - tunnel.center
    assert roll == pytest.approx(np.arctan2(offset[1], -offset[2]), abs=1e-12)


def test_the_roll_is_in_the_turn_of_the_previous_roll() -> None:
    function = optimal_inverse(RIG, TUNNEL)
    target = np.array([100, 6, 0, 0, 0]) * [INCH, INCH, INCH, 1, 1]
    for turns in (-3, 0, 2):
        assert float(function(target, 0.3 + 2 * np.pi * turns)[0][5]) == pytest.approx(np.pi / 2 + 2 * np.pi * turns)


def test_compiled_like_use_needs_no_iteration_count() -> None:
    """The number of instructions is fixed: the function has no loop that waits for convergence."""
    function = optimal_inverse(reference_rig(), reference_tunnel(), limits=False)
    assert function.n_instructions() < 50  # calls of straight-line functions


# ---- arcs ------------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(seeds, st.sampled_from(BRANCHES), st.booleans())
def test_arcs_are_the_rolls_that_reach(seed: int, branch: Branch, limited: bool) -> None:
    rng = np.random.default_rng(seed)
    rig = LIMITED if limited else RIG
    target = random_targets(rng, 1)
    arcs = reachable_rolls(rig, target[:, 0], branch)
    rolls = rng.uniform(-np.pi, np.pi, 300)
    joints, inside = joints_by_geometry(rig, np.repeat(target, 300, axis=1), rolls, branch)
    if limited:
        inside &= (joints[0] >= rig.lower[0]) & (joints[0] <= rig.upper[0])
        turn = (joints[1:] - rig.lower[1:, None]) % (2 * np.pi)
        inside &= (turn <= (rig.upper - rig.lower)[1:, None]).all(axis=0)
    for roll, reaches in zip(rolls, inside, strict=True):
        gaps = [((roll - arc.start) % (2 * np.pi), arc.end - arc.start) for arc in arcs]
        if all(min(gap, 2 * np.pi - gap, abs(gap - size)) > 1e-6 for gap, size in gaps):
            assert any(gap < size for gap, size in gaps) == reaches


def test_ends_of_an_arc_sit_on_the_constraint_they_name() -> None:
    targets = random_targets(np.random.default_rng(11), 60)
    pairs = [
        (target, arc) for target in targets.T for arc in reachable_rolls(RIG, target) if arc.constraints[0] != "free"
    ]
    assert len(pairs) > 10
    for target, arc in pairs:
        for roll, name in ((arc.start, arc.constraints[0]), (arc.end, arc.constraints[1])):
            joints, _ = joints_by_geometry(RIG, target[:, None], roll, HOME)
            stretched = {"pitch reach": abs(np.sin(joints[3, 0])), "yaw reach": abs(np.cos(joints[1, 0]))}
            assert stretched[name] == pytest.approx(1, abs=1e-9)


# ---- tables and bad input --------------------------------------------------------------------------------------


def sweep() -> Array:
    return np.array([[100 * INCH, 6 * INCH, z * INCH, 0, 0] for z in np.linspace(-15, 15, 9)])


def test_a_bad_row_is_marked_and_leaves_the_others_alone() -> None:
    rig, tunnel, rows = reference_rig(**WIDE), reference_tunnel(), sweep()
    good = solve_table(rig, tunnel, rows)
    spoilt = rows.copy()
    spoilt[1, 2], spoilt[3, 0], spoilt[5, 2], spoilt[7, 1] = np.nan, np.inf, 50.0, -40.0
    table = solve_table(rig, tunnel, spoilt)
    assert table.status[1] == table.status[3] == "not a number"
    assert table.status[5] == "pitch link out of reach"
    assert table.status[7] == "yaw link out of reach"
    kept = [0, 2, 4, 6, 8]
    np.testing.assert_array_equal(table.joints[kept], good.joints[kept])
    assert np.isnan(table.joints[[1, 3, 5, 7]]).all()
    assert table.ok.tolist() == [True, False] * 4 + [True]
    assert [table.active[k] for k in (1, 3, 5, 7)] == [""] * 4
    assert table.branch[1] is None


def test_joint_limits_are_the_reason_where_reach_is_not() -> None:
    rig = reference_rig(lower=(5.0, *[-np.inf] * 5), upper=(6.0, *[np.inf] * 5))
    table = solve_table(rig, reference_tunnel(), sweep())
    assert set(table.status) == {"joint limits"}


@pytest.mark.long
def test_the_best_of_several_branches_is_taken() -> None:
    rig = reference_rig(lower=(0.5, -9, -2.0, -9, -9, -9), upper=(1.4, 9, 2.2, 9, 9, 9))
    tunnel = reference_tunnel()
    targets = random_targets(np.random.default_rng(4), 300).T
    single = [solve_table(rig, tunnel, targets, branches=[branch]) for branch in BRANCHES]
    both = solve_table(rig, tunnel, targets, branches=BRANCHES)
    least = np.min([np.where(t.ok, t.cost, np.inf) for t in single], axis=0)
    np.testing.assert_allclose(np.where(both.ok, both.cost, np.inf), least, atol=2e-12)
    assert both.ok.sum() > max(table.ok.sum() for table in single)


def test_a_sequence_passes_its_rolls_on() -> None:
    rows = sweep()
    rows[4] = np.nan
    table = solve_table(RIG, TUNNEL, rows, previous=0.1, in_sequence=True, rate_weight=5.0)
    function, roll = optimal_inverse(RIG, TUNNEL, rate_weight=5.0), 0.1
    for k in (0, 1, 2, 3, 5, 6, 7, 8):
        roll = float(function(rows[k], roll)[0][5])
        assert table.joints[k, 5] == pytest.approx(roll, abs=1e-15)


@pytest.mark.parametrize(
    ("targets", "options", "reason"),
    [
        ([], {}, r"\(0,\), expected \(samples, 5\)"),
        (np.zeros((0, 5)), {}, r"\(0, 5\), expected \(samples, 5\), 1 at least"),
        (np.zeros((3, 6)), {}, r"\(3, 6\)"),
        ("poses", {}, "not numeric"),
        (np.zeros((2, 5)), {"branches": []}, "branches"),
        (np.zeros((2, 5)), {"branches": [Branch(0, 1)]}, "yaw=0"),
        (np.zeros((2, 5)), {"previous": np.nan}, "previous"),
        (np.zeros((2, 5)), {"previous": [0.0, 1.0, 2.0]}, "previous"),
        (np.zeros((2, 5)), {"rate_weight": -1.0}, "rate_weight must be a finite number, zero or above, not -1.0"),
    ],
)
def test_invalid_requests_are_refused_by_name(targets: Any, options: dict[str, Any], reason: str) -> None:
    with pytest.raises(ModelError, match=reason):
        solve_table(RIG, TUNNEL, targets, **options)


def test_a_closed_form_with_a_rate_weight_is_refused() -> None:
    with pytest.raises(ModelError, match="limits=False"):
        optimal_inverse(RIG, TUNNEL, rate_weight=1.0, limits=False)


def test_every_branch_reaches_a_pose_near_the_middle_and_none_a_pose_far_away() -> None:
    reached = []
    for target in ([2.54, 0.15, 0.0, 0, 0], [2.5, 0.1, 3.0, 0, 0], [2.5, 3.0, 0.0, 0, 0]):
        margins = [np.array(inverse(RIG, ca.DM(target), 1.0, branch)[1]).min() for branch in BRANCHES]
        reached.append(sum(margin >= 0 for margin in margins))
    assert reached == [4, 0, 0]


# ---- roots of trigonometric polynomials --------------------------------------------------------------------------

coefficient = st.floats(-10, 10).filter(lambda x: x == 0 or abs(x) > 1e-6)


def true_angles(a: Array, b: Array) -> Array:
    """Angles of the roots on the circle, through the companion matrix."""
    head, tail = (a - 1j * b)[::-1][:-1] / 2, (a + 1j * b)[1:] / 2
    z = np.roots(np.concatenate([head, [a[0]], tail]))
    return np.asarray(np.angle(z[np.abs(np.abs(z) - 1) < 1e-9]))


@pytest.mark.long
@given(st.lists(coefficient, min_size=5, max_size=5))
def test_roots_are_among_the_four_points(values: list[float]) -> None:
    a0, a1, b1, a2, b2 = values
    f = Harmonics(*(ca.SX(value) for value in values))
    points = np.array([[float(ca.DM(c)), float(ca.DM(s))] for c, s in roots(f)])
    assert np.isfinite(points).all()
    np.testing.assert_allclose(np.hypot(*points.T), 1, atol=1e-12)
    if not any(values):
        return
    for angle in true_angles(np.array([a0, a1, a2]), np.array([0, b1, b2])):
        slope = f.derivative().value(np.cos(angle), np.sin(angle))
        gap = np.hypot(points[:, 0] - np.cos(angle), points[:, 1] - np.sin(angle)).min()
        assert gap < 1e-5 / max(abs(float(ca.DM(slope))), 1e-3)


@given(st.lists(coefficient, min_size=5, max_size=5), st.booleans())
def test_least_point_is_the_least_of_all(values: list[float], cusp: bool) -> None:
    a0, a1, b1, a2, b2 = values
    if cusp:  # where three stationary points are nearly one
        a1, b1, b2 = -4 * abs(a2) * (1 + 1e-7 * a0), 1e-9 * b1, 0.0
    f = Harmonics(*(ca.SX(value) for value in (a0, a1, b1, a2, b2)))
    c, s = (float(ca.DM(part)) for part in least_point(f))
    assert np.hypot(c, s) == pytest.approx(1, abs=1e-12)
    angles = np.append(np.linspace(-np.pi, np.pi, 3000), np.arctan2(s, c))
    every = a0 + a1 * np.cos(angles) + b1 * np.sin(angles) + a2 * np.cos(2 * angles) + b2 * np.sin(2 * angles)
    assert every[-1] <= every.min() + 1e-13 * (1 + np.abs(values).sum())


def test_roots_of_higher_degree_are_found_all_at_once() -> None:
    rng, function = np.random.default_rng(1), series_roots(4)
    for _ in range(300):
        a, b = rng.normal(size=5), rng.normal(size=5)
        b[0] = 0
        points = np.array(function(np.vstack([a, b])))
        for angle in true_angles(a, b):
            assert np.hypot(points[0] - np.cos(angle), points[1] - np.sin(angle)).min() < 1e-6
