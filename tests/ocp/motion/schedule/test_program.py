"""The parts of a schedule's programs: rows and their sums, the jerk that a motion holds, demands between the nodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp.motion.schedule import LineLimits, schedule
from ocp.motion.schedule.grid import make_grid
from ocp.motion.schedule.limits import limit_rows
from ocp.motion.schedule.program import INTERIOR, Program, Spline, SplineRows, _Constraints, least_time
from ocp.motion.schedule.window import SETTINGS, EnforcedRows, Margins, Stretch, Window, limit_usage, motion_profile
from ocp.motion.tasks.speed_profile import LineMotion
from scripts.timing.schedules import JOINTS, panda_path
from tests.models.paths.task_paths import seeds


def random_rows(seed: int, count: int) -> tuple[Program, _Constraints, np.ndarray]:
    """Rows at random places of so many intervals, and coefficients."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 6 * count + 1))
    interval, jerk = rng.integers(0, count, size), rng.uniform(size=size) < rng.uniform()
    rows = SplineRows(interval, rng.uniform(size=size), rng.normal(size=(size, 3)), rng.uniform(1, 2, size), jerk)
    most = np.where(rng.uniform(size=count + 2) < 0.5, 5.0, np.inf)
    spline = Spline(np.cumsum(rng.uniform(0.1, 1.0, count + 1)), rng.uniform(0.5, 1.5, count))
    program = Program(spline, rows, most, (0.0, 0.0), np.arange(0))
    return program, _Constraints(program), rng.uniform(0.5, 2.0, count + 2)


@settings(max_examples=40)
@given(seeds, st.integers(1, 90))
def test_rows_are_those_of_a_matrix(seed: int, count: int) -> None:
    """What they miss and its tangents, sums of values times these, and the diagonals of the sum of their squares."""
    program, every, b = random_rows(seed, count)
    gap, _ = every.evaluate(b)
    matrix = np.array([every.change_of(column) for column in np.eye(len(b))]).T
    values = np.random.default_rng(seed).uniform(0.1, 1.0, len(gap))
    assert every.weighted_gradients(values) == pytest.approx(matrix.T @ values, abs=1e-9)
    normal = matrix.T @ (values[:, None] * matrix)
    for k, diagonal in enumerate(every.outer_products(values)):
        assert diagonal == pytest.approx(np.diag(normal, k), abs=1e-9)
    step = 1e-6 * np.random.default_rng(seed + 1).normal(size=len(b))
    change = matrix @ step
    assert (every.evaluate(b + step)[0] - every.evaluate(b - step)[0]) / 2 == pytest.approx(change, abs=1e-10)

    rows, near = program.rows, np.stack([b[program.rows.interval + k] for k in range(3)])
    x, slope, bend = (program.spline.basis(rows.interval, rows.fraction) * near).sum(axis=1)
    bound = rows.bound * np.where(rows.jerk, x**-0.5, 1.0)
    missed = [(rows.of * np.stack([x, slope, bend], axis=1)).sum(axis=1) - bound, -b[1:-1], b - program.upper]
    every.evaluate(b)
    assert np.sort(gap) == pytest.approx(np.sort(np.concatenate([part[np.isfinite(part)] for part in missed])))


@settings(max_examples=40)
@given(seeds, st.integers(1, 90), st.floats(0.1, 1.0), st.floats(0.1, 1.0))
def test_steps_preserve_positive_variables(seed: int, count: int, share: float, of_positive: float) -> None:
    """At most so much of the way to zero, the coefficients less, and the worst of all just so; they change slowly."""
    _, every, _ = random_rows(seed, count)
    rates = np.random.default_rng(seed).normal(size=len(every.interval)) * 10.0 ** np.random.default_rng(seed).uniform(
        -1, 1
    )
    steps = every.step_lengths(rates, share, of_positive)
    most = np.where(np.arange(len(rates)) < count, of_positive, share)
    gone = -rates * steps[every.interval] / most
    assert gone.max() <= 1 + 1e-12
    assert steps.max() <= 1
    assert steps.min() == pytest.approx(1 / max(1.0, float((-rates / most).max())))
    assert np.abs(np.diff(steps)).max(initial=0.0) <= 1 / INTERIOR.block


@settings(max_examples=40)
@given(seeds)
def test_a_spline_has_the_values_and_derivatives_of_its_basis(seed: int) -> None:
    """And goes through what it is made of; its second derivative is that of the slopes."""
    rng = np.random.default_rng(seed)
    nodes = np.cumsum(rng.uniform(0.1, 1.0, 9))
    spline = Spline(nodes, rng.uniform(0.5, 1.5, len(nodes) - 1))
    b = rng.uniform(0.5, 2.0, len(nodes) + 1)
    x, slope = spline.at_nodes(b)
    assert spline.through(x, slope) == pytest.approx(b)
    interval, fraction = rng.integers(0, 8, 30), rng.uniform(0, 1, 30)
    near = np.stack([b[interval + k] for k in range(3)])
    value, first, second = (spline.basis(interval, fraction) * near).sum(axis=1)
    # the slope is linear in the time of a motion with a speed that is linear in time
    r, width = spline.ratios[interval], np.diff(nodes)[interval]
    times = np.linspace(0.0, 1.0, 2001)
    distances = r[:, None] * times + (1 - r[:, None]) * times**2
    time = np.array([np.interp(f, part, times) for f, part in zip(fraction, distances, strict=True)])
    assert first == pytest.approx(slope[interval] + time * np.diff(slope)[interval], rel=1e-5, abs=1e-5)
    step = 1e-5
    ahead, behind = (
        (spline.basis(interval, np.clip(fraction + side, 0, 1)) * near).sum(axis=1) for side in (step, -step)
    )
    inside = (fraction > step) & (fraction < 1 - step)
    for k, derivative in enumerate((first, second)):
        assert ((ahead[k] - behind[k]) / (2 * step * width))[inside] == pytest.approx(
            derivative[inside], rel=1e-5, abs=1e-5
        )
    ends = (
        spline.basis(np.arange(8), np.full(8, end)) * np.stack([b[k : k + 8] for k in range(3)]) for end in (0.0, 1.0)
    )
    for end, (value, first, _) in enumerate(part.sum(axis=1) for part in ends):
        assert value == pytest.approx(x[end : end + 8])
        assert first == pytest.approx(slope[end : end + 8])


def from_rest_to_rest(seed: int, count: int) -> Program:
    """Speeds, accelerations and jerks that vary along a path."""
    rng = np.random.default_rng(seed)
    spline = Spline(np.cumsum(rng.uniform(0.5, 1.5, count + 1)) / count, rng.uniform(0.5, 1.5, count))
    wave = 1 + 0.5 * np.sin(np.arange(count) * rng.uniform(0.05, 0.3))
    interval, sign = np.repeat(np.arange(count), 4), np.tile([1.0, -1.0, 0.0, 0.0], count)
    bend = np.tile([0.0, 0.0, 1.0, -1.0], count)
    rows = SplineRows(
        interval,
        np.full(4 * count, 0.5),
        np.stack([0 * sign, sign / 2, bend / 2], axis=1),
        np.where(bend == 0, 2.0, 20.0) * wave[interval],
        bend != 0,
    )
    most = np.concatenate([[np.inf], wave, [np.inf]])
    width = float(spline.h[0])
    return Program(spline, rows, most, (width, width), np.zeros(0, dtype=np.intp))


@settings(max_examples=20)
@given(seeds, st.integers(60, 200))
def test_parts_of_the_fastest_motion_between_the_rest_of_it_are_the_fastest_themselves(seed: int, count: int) -> None:
    program, rng = from_rest_to_rest(seed, count), np.random.default_rng(seed)
    start = np.full(count + 2, 1e-2)
    whole = least_time(program, start, accuracy=1e-10, center=1.0)
    edges = np.sort(rng.permutation(count)[:6])
    free = np.concatenate([np.arange(a, b) for a, b in edges.reshape(3, 2)])
    part, at = program.part(free)
    stays = part.fixed
    assert part.spline.at_nodes(whole[at])[0][0] == pytest.approx(program.spline.at_nodes(whole)[0][at[0]])
    moved = np.where(np.isin(np.arange(len(at)), stays), 1.0, 0.9) * whole[at]
    result = least_time(part, moved, accuracy=1e-10, center=0.1)
    assert result[stays] == pytest.approx(whole[at][stays], rel=1e-12)
    assert result == pytest.approx(whole[at], rel=1e-4, abs=1e-6)


@settings(max_examples=40)
@given(st.floats(0.5, 1.5), st.floats(0.1, 10.0))
def test_the_jerk_of_a_spline_is_constant_where_the_speed_is_linear_in_time(ratio: float, mean: float) -> None:
    """However much the speed grows in the interval."""
    s, speed = np.array([0.0, 1.0]), mean * np.array([ratio, 2 - ratio])
    slope = np.array([1.0, 1.0 + 1e-3]) * np.diff(speed**2)[0] + [0.0, 1e-3 * mean**2]
    places = np.linspace(0.0, 1.0, 9)
    at = np.sqrt(speed[0] ** 2 + places * np.diff(speed**2)[0])
    spline = Spline(s, np.array([ratio]))
    second = spline.basis(np.zeros(9, dtype=np.intp), places)[2].T @ spline.through(speed**2, slope)
    assert second * at == pytest.approx((second * at)[0], rel=1e-9)


def test_demands_equal_those_of_dense_samples() -> None:
    """In every interval, by every limit that comes near: no less; and next to no more where that would matter."""
    path, joints = panda_path(4)
    limits = LineLimits(0.5, 5.0, 200.0, 5.0, JOINTS)
    grid, plan = make_grid(path, limits, joints), schedule(path, limits, joints=joints)
    # the nodes of the plan, which splits intervals of the grid
    at = np.searchsorted(plan.profile.distance, grid.distance * (1 - 1e-12))
    grid = grid.split(0, np.maximum(np.diff(at) // 2, 1))
    stretch, every = Stretch(grid, 0, len(grid.requested)), np.arange(len(grid.requested))
    window = Window.build(stretch, 0, len(grid.requested), stretch.ends)
    motion = plan.profile.at_distance(grid.distance)
    profile = motion_profile(window, motion.speed**2, 2 * motion.acceleration)
    used, values = limit_usage(window, profile, every)
    some = np.sort(np.random.default_rng(0).permutation(every)[:50])
    for whole, part in zip((used, values), limit_usage(window, profile, some), strict=True):
        assert part[:, some] == pytest.approx(whole[:, some], abs=1e-12)
        assert not np.delete(part, some, axis=1).any()
    shares = np.linspace(1e-6, 1 - 1e-6, 201)
    places = grid.distance[:-1, None] + shares * np.diff(grid.distance)[:, None]
    dense = profile.at_distance(places.ravel())
    rows = limit_rows(path, limits, joints, places.ravel())
    values = rows.usage(LineMotion(*dense)).reshape(*places.shape, -1)
    for side, sign in zip(used, (1, -1), strict=True):
        most = (sign * values).max(axis=1)
        near = most > 0.9
        assert near.sum() > 50
        # a joint's jerk may turn between places that are looked at, by less than the room that is left for it
        assert (side - most)[near].min() > -2 * SETTINGS.room
        assert (side - most)[side > 1 - 2 * SETTINGS.room].max() < 2 * SETTINGS.room


@settings(max_examples=40)
@given(seeds)
def test_a_spline_remains_possible_when_its_intervals_are_split(seed: int) -> None:
    """And split intervals get initial margins, while the others keep theirs."""
    rng, count = np.random.default_rng(seed), 6
    parts, nodes = rng.integers(1, 5, count), np.cumsum(rng.uniform(0.1, 1.0, count + 1))
    margins = Margins(*(rng.uniform(0.5, 0.9, shape) for shape in ((count,), (count, 2), (count, 3))))
    mask = rng.uniform(size=(4, 2, count, 6)) < 0.5
    enforced = EnforcedRows(margins, margins.times(np.zeros(count)), mask, rng.uniform(0.5, 1.5, count), inherited=2)
    fine = enforced.split(parts)
    assert fine.inherited == parts[:2].sum()
    at, new = np.repeat(np.arange(count), parts), np.repeat(parts > 1, parts)
    for kind, before in zip(fine.margins, margins, strict=True):
        assert (kind[new] == 1 - SETTINGS.room).all()
        assert (kind[~new] == before[at][~new]).all()
    assert (fine.mask == mask[:, :, at]).all()
    spline, b = Spline(nodes, enforced.ratios), rng.uniform(0.5, 2.0, count + 2)
    shares = np.concatenate([np.arange(n) / n for n in parts])
    fine_nodes = np.append(nodes[at] + shares * np.diff(nodes)[at], nodes[-1])
    finer = Spline(fine_nodes, fine.ratios)

    def values(of: Spline, coefficients: np.ndarray, interval: np.ndarray, fraction: np.ndarray) -> np.ndarray:
        near = np.stack([coefficients[interval + k] for k in range(3)])
        return np.asarray((of.basis(interval, fraction) * near).sum(axis=1))

    x, slope, _ = values(spline, b, np.append(at, count - 1), np.append(shares, 1.0))
    every, fraction = np.arange(len(at)), rng.uniform(size=len(at))
    expected = values(spline, b, at, shares + fraction / parts[at])
    assert values(finer, finer.through(x, slope), every, fraction) == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_a_split_grid_keeps_its_nodes_and_where_segments_meet() -> None:
    path, _ = panda_path(4)
    grid = make_grid(path, LineLimits(0.5, 5.0, 200.0, 5.0), None)
    first, last = 3, int(grid.jumps[2])
    parts = np.random.default_rng(0).integers(1, 5, last - first)
    fine = grid.split(first, parts)
    assert (fine.distance[np.append(0, np.cumsum(parts))] == grid.distance[first : last + 1]).all()
    assert np.diff(fine.distance) == pytest.approx(np.repeat(np.diff(grid.distance[first : last + 1]) / parts, parts))
    own = (grid.jumps > first) & (grid.jumps <= last)
    assert (fine.distance[fine.jumps] == grid.distance[grid.jumps[own]]).all()
    assert (fine.before == grid.before[own]).all()
    assert (fine.requested == np.repeat(grid.requested[first:last], parts)).all()
