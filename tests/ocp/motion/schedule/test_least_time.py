"""Least times without jerk limits: published cases, toppra, and what must not make a schedule faster or break it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from models import FixedBase, Path, SmoothPath, planar_chain, smooth
from ocp import joint_path
from ocp.motion.schedule import JointLimits, LineLimits, Schedule, ToolLimits, schedule
from ocp.motion.schedule import grid as grids
from ocp.motion.schedule.grid import GAUSS
from ocp.motion.schedule.stretch import HALF_ERROR
from tests.models.paths.task_paths import seeds
from tests.ocp.problems import Array

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning", "ignore:overlap='shrink'")
FREE = LineLimits(1e4, 1e5, np.inf)
"""Limits of the line that no case reaches."""
LENGTHS = "build_up", "ramp", "ramp_without_jerk", "turn", "least_build_up"
"""Settings of the grid to which the lengths of its intervals are proportional."""
UNIT = smooth(Path.through([(0, 0, 0), (1, 0, 0)]), 0.01)
TOTG = [(1427, 368, 690), (1427, 368, 790), (952.499938964844, 433, 1051), (452.5, 533, 1051), (452.5, 533, 951)]


class Axes:
    """The three coordinates of a path as its joints."""

    names = ("x", "y", "z")

    def __init__(self, path: SmoothPath) -> None:
        self.path = path

    def at(self, distance: Any) -> Any:
        place = self.path.at(np.asarray(distance))
        return SimpleNamespace(
            position=place.position, first=place.tangent, second=place.curvature, third=place.curvature_rate
        )


class Curves:
    """Seven joints that follow a random spline of degree 5 over a line of 1 m."""

    def __init__(self, seed: int, points: int = 6, backward: bool = False) -> None:
        knots = np.random.default_rng(seed).uniform(-2, 2, (points, 7))
        curve = make_interp_spline(np.linspace(0, 1, points), knots[::-1] if backward else knots, 5)
        self.names = tuple(f"joint{k}" for k in range(7))
        self.curves = [curve, *(curve.derivative(k) for k in (1, 2, 3))]

    def at(self, distance: Any) -> Any:
        kinds = ("position", "first", "second", "third")
        return SimpleNamespace(**{kind: curve(distance) for kind, curve in zip(kinds, self.curves, strict=True)})


def random_limits(seed: int) -> JointLimits:
    rng = np.random.default_rng(seed + 1000)
    return JointLimits(rng.uniform(1, 3, 7), rng.uniform(5, 20, 7))


def line_of(length: float) -> SmoothPath:
    return smooth(Path.through([(0, 0, 0), (length, 0, 0)]), length / 10)


def greatest_usage(plan: Schedule, samples: int = 200_000) -> float:
    """Largest joint velocity, acceleration or jerk over its limit."""
    motion = plan.at(np.linspace(0, plan.duration, samples + 1))
    assert plan.joints is not None
    joints = plan.joints.at(np.clip(motion.distance, 0, plan.path.length))
    v, a, j = (kind[:, None] for kind in (motion.speed, motion.acceleration, motion.jerk))
    values = [joints.first * v, joints.first * a + joints.second * v**2]
    limits = plan.limits.of_joints(len(plan.joints.names))
    if np.isfinite(limits[2]).any():
        values.append(joints.first * j + 3 * joints.second * v * a + joints.third * v**3)
    return max(float((np.abs(value) / limit).max()) for value, limit in zip(values, limits, strict=False))


def rest_to_rest(distance: Array, velocity: Array, acceleration: Array) -> float:
    """Least time of a straight motion of several joints with bang-bang acceleration."""
    v, a = np.min(velocity / distance), np.min(acceleration / distance)
    return float(2 / np.sqrt(a) if v * v > a else 1 / v + v / a)


@pytest.mark.parametrize(
    ("distance", "velocity", "acceleration", "published"),
    [
        ([1.0, 0.000549316406, 3.0], [1.3, 0.67, 0.67], [0.00249] * 3, None),
        ([0.718599], [4.54], [28.0], 0.320401),
        ([1e-5], [1e3], [1000.0], 0.0002),
        ([1e-3, 1e-3], [1.0, 1.0], [1e2, 1e4], None),
        ([1e-5, 2e-5], [1.0, 1.0], [1e2, 1e4], None),
        ([1e-7, -1e-7], [1.0, 1.0], [1e2, 1e4], None),
    ],
)
def test_a_straight_motion_takes_the_closed_form_however_short(
    distance: list[float], velocity: list[float], acceleration: list[float], published: float | None
) -> None:
    """Cases of the time-optimal trajectory generation of Kunz and Stilman, and of toppra's robustness suite."""
    change = np.array(distance)
    length = float(np.linalg.norm(change))
    curve = np.linspace(0, length, 31)
    joints = joint_path(
        FixedBase(planar_chain([1.0] * len(change), [1.0] * len(change))),
        (curve, curve[:, None] / length * change),
        line_of(length),
    )
    limits = replace(FREE, acceleration=1e6, joints=JointLimits(velocity, acceleration))
    plan = schedule(line_of(length), limits, joints=joints)
    assert plan.duration == pytest.approx(
        rest_to_rest(np.abs(change), np.array(velocity), np.array(acceleration)), 1e-6
    )
    assert published is None or plan.duration == pytest.approx(published, rel=1e-3)
    assert plan.at([plan.duration]).distance[0] == length


def test_blends_take_the_least_time_and_a_jerk_limit_makes_them_slower() -> None:
    path = smooth(Path.through(TOTG), deviation=100.0)
    limits = LineLimits(1.609, 3.464, np.inf, joints=JointLimits([1.3, 0.67, 0.67], 0.002))
    free = schedule(path, limits, joints=Axes(path))
    assert free.duration < 1919.56  # published, with other blends
    assert free.duration == pytest.approx(1775.530, rel=1e-4)  # passes with 128 000 nodes; toppra with 8000: 1775.75
    sharp = replace(limits, jerk=1.0, joints=JointLimits([1.3, 0.67, 0.67], 0.002, 0.001))
    assert free.duration < schedule(path, sharp, joints=Axes(path)).duration


def test_a_joint_that_trembles_is_planned_with_and_without_a_jerk_limit() -> None:
    s = np.linspace(0, 1, 2001)
    trembling = (s + 16e-6 * np.sin(2 * np.pi * 125 * s))[:, None]
    joints = joint_path(FixedBase(planar_chain([1.0], [1.0])), (s, trembling), UNIT)
    times = []
    for jerk in (np.inf, 100.0):
        plan = schedule(UNIT, replace(FREE, jerk=1e4 * jerk, joints=JointLimits(1.0, 2.0, jerk)), joints=joints)
        assert greatest_usage(plan) <= 1.001
        times.append(plan.duration)
    assert times[0] <= times[1]


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 10))])
def test_a_random_path_takes_the_time_of_toppra(seed: int) -> None:
    """Its time, which is of first order in the distance between nodes, is extrapolated to distance 0.

    On path 7 it is 14.12095, 14.11898, 14.11796 and 14.11746 s with 2000, 4000, 8000 and 16 000 intervals.
    """
    toppra = pytest.importorskip("toppra")
    from toppra.algorithm import TOPPRA
    from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

    toppra.setup_logging("ERROR")
    joints, limits = Curves(seed), random_limits(seed)
    plan = schedule(UNIT, replace(FREE, joints=limits), joints=joints)
    both = np.array([[-1.0, 1.0]])
    constraints = [
        JointVelocityConstraint(np.asarray(limits.velocity)[:, None] * both),
        JointAccelerationConstraint(np.asarray(limits.acceleration)[:, None] * both),
    ]

    def time_of_peer(intervals: int) -> float:
        s = np.linspace(0, 1, intervals + 1)
        peer = TOPPRA(constraints, toppra.SplineInterpolator(s, joints.at(s).position), gridpoints=s)
        speed = peer.compute_parameterization(0, 0)[1]
        return float((2 * np.diff(s) / (speed[1:] + speed[:-1])).sum())

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        coarse, fine = time_of_peer(4000), time_of_peer(8000)
    assert plan.duration == pytest.approx(2 * fine - coarse, rel=1e-4)
    assert greatest_usage(plan) <= 1.001


@settings(max_examples=4)
@given(seeds, st.sampled_from(["velocity", "acceleration", "jerk"]))
def test_a_further_limit_never_makes_a_motion_faster(seed: int, kind: str) -> None:
    limits = replace(FREE, joints=random_limits(seed % 1000))
    assert limits.joints is not None
    base = schedule(UNIT, limits, joints=Curves(seed)).duration
    value = 100.0 if kind == "jerk" else 0.7 * getattr(limits.joints, kind)
    further = replace(limits, joints=replace(limits.joints, **{kind: value}))
    assert schedule(UNIT, further, joints=Curves(seed)).duration >= base * (1 - 1e-4)


@settings(max_examples=5)
@given(seeds)
def test_a_reversed_path_takes_the_same_time(seed: int) -> None:
    limits = replace(FREE, joints=random_limits(seed % 1000))
    there, back = (schedule(UNIT, limits, joints=Curves(seed, backward=end)).duration for end in (False, True))
    assert there == pytest.approx(back, rel=1e-4)


@pytest.mark.parametrize("jerk", [np.inf, 100.0])
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 10))])
def test_half_the_nodes_never_make_a_motion_faster_than_the_optimum(
    monkeypatch: pytest.MonkeyPatch, seed: int, jerk: float
) -> None:
    """The optimum is that of a grid with four times as many nodes as by default.

    Without jerk limits, intervals of a coarse grid are halved where limits are exceeded between nodes, so that more
    than half of the nodes may remain.
    """
    limits = replace(FREE, jerk=1e4 * jerk, joints=replace(random_limits(seed), jerk=jerk))
    default, plans = grids.SETTINGS, {}
    for spacing in (0.25, 1.0, 2.0):
        lengths = {name: spacing * getattr(default, name) for name in LENGTHS}
        # the error of interpolation grows with the square of the spacing
        errors = {name: spacing**2 * getattr(default, name) for name in ("uneven", "uneven_speed")}
        segments = round(default.segments / spacing)
        monkeypatch.setattr(grids, "SETTINGS", replace(default, segments=segments, **lengths, **errors))
        plans[spacing] = schedule(UNIT, limits, joints=Curves(seed))
        assert greatest_usage(plans[spacing]) <= 1.001
    nodes = {spacing: len(plan.profile.jerk) for spacing, plan in plans.items()}
    most = 1.0 if jerk == np.inf else 0.7
    assert nodes[2.0] < most * nodes[1.0]
    assert 0.7 * nodes[1.0] < 0.3 * nodes[0.25]
    assert min(plans[1.0].duration, plans[2.0].duration) >= plans[0.25].duration * (1 - 1e-4)


def lines_of_all_sizes(seed: int) -> SmoothPath:
    """A path of rounded lines from 10 um to 1 m."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(int(rng.integers(2, 12)), 3))
    steps *= (10 ** rng.uniform(-5, 0, len(steps)) / np.linalg.norm(steps, axis=1))[:, None]
    return smooth(Path.through(np.cumsum(np.append(np.zeros((1, 3)), steps, axis=0), axis=0)), deviation=1e-4)


SEEDS = [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(3, 100))]


@pytest.mark.parametrize("jerk", [np.inf, 200.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_axes_keep_their_limits_on_segments_of_all_sizes(seed: int, jerk: float) -> None:
    """Segments from 10 um to 1 m, as CAM writes them."""
    path = lines_of_all_sizes(seed)
    limits = LineLimits(1.0, 20.0, 10 * jerk, joints=JointLimits(0.5, 10.0, jerk))
    assert greatest_usage(schedule(path, limits, joints=Axes(path))) <= 1.001


@pytest.mark.parametrize("jerk", [np.inf, 200.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_time_does_not_depend_on_the_number_of_samples(seed: int, jerk: float) -> None:
    """The spline through the samples is no smoother than the path where its segments meet.

    A jerk limit needs third derivatives, and more samples.
    """
    path = lines_of_all_sizes(seed)
    limits = LineLimits(1.0, 20.0, 10 * jerk, joints=JointLimits(0.5, 10.0, jerk))
    exact = schedule(path, limits, joints=Axes(path)).duration
    for samples in (12, 30) if jerk == np.inf else (24, 60):
        parts = [np.linspace(*ends, samples, endpoint=False) for ends in pairwise(path.bounds)]
        s = np.append(np.concatenate(parts), path.length)
        joints = joint_path(FixedBase(planar_chain([1.0] * 3, [1.0] * 3)), (s, path.at(s).position), path)
        plan = schedule(path, limits, joints=joints)
        assert plan.duration == pytest.approx(exact, rel=1e-3)
        assert greatest_usage(plan) <= 1.001


@pytest.mark.parametrize("seed", [10, 85])
def test_samples_closer_than_rounding_resolves_do_not_change_the_time(seed: int) -> None:
    """Segments of 10 um and less with 2000 samples, whose rounding errors would dominate third derivatives."""
    path, times = lines_of_all_sizes(seed), []
    limits = LineLimits(1.0, 20.0, 2000.0, joints=JointLimits(0.5, 10.0, 200.0))
    for samples in (60, 2000):
        parts = [np.linspace(*ends, samples, endpoint=False) for ends in pairwise(path.bounds)]
        s = np.append(np.concatenate(parts), path.length)
        joints = joint_path(FixedBase(planar_chain([1.0] * 3, [1.0] * 3)), (s, path.at(s).position), path)
        plan = schedule(path, limits, joints=joints)
        assert greatest_usage(plan) <= 1.001
        times.append(plan.duration)
    assert times[0] == pytest.approx(times[1], rel=1e-3)


@pytest.mark.parametrize("seed", [6, 8])
def test_finer_nodes_between_slow_bends_are_hardly_faster(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a sharp bend the speed grows manifold in a short part of a line, which needs nodes of its own."""
    path, default = lines_of_all_sizes(seed), grids.SETTINGS
    limits = LineLimits(1.0, 20.0, 2000.0, joints=JointLimits(0.5, 10.0, 200.0))
    plan = schedule(path, limits, joints=Axes(path))
    monkeypatch.setattr(grids, "SETTINGS", replace(default, rise=default.rise / 4, cells=2 * default.cells))
    assert plan.duration <= schedule(path, limits, joints=Axes(path)).duration * 1.001


@pytest.mark.parametrize("seed", SEEDS)
def test_joints_keep_their_limits_where_their_accelerations_jump(seed: int) -> None:
    """A path of ten joints with continuous first derivatives only."""
    rng = np.random.default_rng(seed)
    knots, s = np.linspace(0, 1, 6), np.linspace(0, 1, 401)
    curve = CubicHermiteSpline(knots, rng.uniform(-1, 1, (6, 10)), rng.uniform(-5, 5, (6, 10)))
    joints = joint_path(FixedBase(planar_chain([1.0] * 10, [1.0] * 10)), (s, curve(s)), UNIT)
    limits = JointLimits(rng.uniform(1, 3, 10), 10 ** rng.uniform(0, 2, 10))
    assert greatest_usage(schedule(UNIT, replace(FREE, joints=limits), joints=joints)) <= 1.001


@pytest.mark.parametrize("jerk", [np.inf, 50.0])
def test_an_axis_moves_no_faster_than_its_limit_and_as_fast_where_that_is_what_limits(jerk: float) -> None:
    """On a straight line the speed is the limit of the slowest axis divided by its share of the direction."""
    line = smooth(Path.through([(0, 0, 0), (0.8, 0.6, 0.0)]), deviation=0.01)
    limits = LineLimits(2.0, 5.0, jerk, tool=ToolLimits(velocity=(0.5, 0.3, 0.1)))
    timed = schedule(line, limits)
    motion = timed.at(np.linspace(0.0, timed.duration, 20_001))
    assert motion.speed.max() == pytest.approx(0.5, rel=1e-3)  # along y: 0.3 / 0.6; along x 0.5 / 0.8
    assert motion.speed.max() <= 0.5 * 1.001


def test_half_of_a_cubic_is_nearer_to_its_parabola_than_the_whole_by_the_stated_ratio() -> None:
    """The errors of interpolation of a cubic are multiples of the product of the distances to the nodes."""
    x = np.linspace(0.0, 0.5, 100_001)
    half = np.abs(x * (x - GAUSS[0]) * (x - 0.5)).max()
    whole = np.abs(x * (x - 0.5) * (x - 1.0))
    assert x[whole.argmax()] == pytest.approx(GAUSS[0], abs=1e-5)
    assert half / whole.max() == pytest.approx(HALF_ERROR, rel=1e-3)
