"""Schedules are the fastest motions: known optima, other solvers, and what must not change the time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from models import Path, Scara, SmoothPath, scara_along, smooth
from models.machines.scara import ScaraPath
from ocp import ProblemError
from ocp.motion.builders.joint_spline import PlannedJoints
from ocp.motion.builders.timing import solve_minimum_time
from ocp.motion.schedule import (
    JointLimits,
    LineLimits,
    Schedule,
    ToolLimits,
    joint_motion,
    ramp_distance,
    ramp_time,
    schedule,
)
from ocp.motion.schedule import grid as grids
from ocp.motion.schedule import stretch as stretches
from ocp.motion.schedule.grid import make_grid
from ocp.motion.schedule.ramps import reachability_passes
from scripts.timing.schedules import JOINTS, panda_path
from tests.families import some
from tests.models.paths.task_paths import random_arm_path, seeds, turned
from tests.models.paths.test_paths import example
from tests.ocp.motion.schedule.check import dense, largest
from tests.ocp.problems import Array

pytestmark = [
    pytest.mark.filterwarnings("ignore:overlap='shrink'"),  # blends of random paths may overlap
    pytest.mark.xdist_group("fastest"),  # one process, so that the Panda is scheduled once
]

Curve = Callable[[int, Array], Array]
"""(n, distances) -> n-th derivative of a joint by the distance."""
TORQUE = 0.42 * np.asarray(JOINTS.torque)
PANDA = replace(JOINTS, velocity=0.3 * np.asarray(JOINTS.velocity), torque=TORQUE)
"""Limits of its joints, slow and weak so that every kind binds."""
LENGTH, LINE = 2.0, LineLimits(1.0, 5.0, 200.0)


class RandomStretch:
    """Joints that are given functions of the distance."""

    def __init__(self, **curves: Curve) -> None:
        self.names, self.curves = tuple(curves), tuple(curves.values())

    def at(self, distance: Any) -> Any:
        s = np.asarray(distance, dtype=float)
        kinds = ("position", "first", "second", "third")
        return SimpleNamespace(
            **{kind: np.stack([curve(n, s) for curve in self.curves], axis=1) for n, kind in enumerate(kinds)}
        )


def even(size: float = 1.0) -> Curve:
    """A joint that moves with the line."""
    return lambda n, s: size * (s if n == 0 else np.full_like(s, float(n == 1)))


def wave(size: float, turns: float, phase: float, length: float = LENGTH) -> Curve:
    """A joint that swings."""
    w = 2 * np.pi * turns / length
    return lambda n, s: size / w * w**n * np.sin(w * s + phase + n * np.pi / 2)


def straight(length: float = LENGTH) -> SmoothPath:
    return smooth(Path.through([(0, 0, 0), (length, 0, 0)]), 0.1)


def seven_phases(limits: LineLimits, length: float = LENGTH) -> float:
    """Least time from rest to rest where the top speed is reached."""
    v, a, j = float(np.asarray(limits.speed)), limits.acceleration, limits.jerk
    return 2 * ramp_time(v, a, j) + (length - 2 * ramp_distance(0, v, a, j)) / v


def swinging(seed: int) -> tuple[RandomStretch, JointLimits]:
    rng = np.random.default_rng(seed)
    joints = RandomStretch(
        **{name: wave(rng.uniform(0.5, 2), rng.uniform(0.5, 4), rng.uniform(0, 6.28)) for name in "abc"}
    )
    return joints, JointLimits(rng.uniform(0.7, 2, 3), rng.uniform(2, 8, 3), rng.uniform(40, 200, 3))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("kind", ["acceleration", "jerk"])
def test_a_joint_that_moves_with_the_line_is_as_fast_as_the_line_with_its_limit(kind: str, share: float) -> None:
    """The optimum is known: the line's, with the joint's limit for its own."""
    most = share * getattr(LINE, kind)
    plan = schedule(straight(), replace(LINE, joints=JointLimits(**{kind: most})), joints=RandomStretch(a=even()))
    best = seven_phases(replace(LINE, **{kind: most}))
    assert best * (1 - 1e-6) <= plan.duration <= best * 1.003
    assert {dip.cause for dip in plan.dips} == {f"joint 'a' {kind}"}
    # away from its ramps the speed is the asked one
    v = plan.profile.at_distance(np.linspace(0.6, 1.4, 99)).speed
    assert v == pytest.approx(1.0, abs=1e-8)


def test_a_joint_velocity_is_the_line_speed_that_it_leaves() -> None:
    plan = schedule(straight(), replace(LINE, joints=JointLimits(0.8)), joints=RandomStretch(a=even(2.0)))
    best = seven_phases(replace(LINE, speed=0.4))
    assert best * (1 - 1e-6) <= plan.duration <= best * 1.003
    assert plan.profile.at_distance(np.linspace(0.3, 1.7, 99)).speed == pytest.approx(0.4, rel=1e-3)


@settings(max_examples=20)
@given(seeds, st.integers(2, 5), st.booleans())
def test_the_passes_equal_a_linear_program(seed: int, rows: int, reverses: bool) -> None:
    """Both passes are optimal unless a row has a point of zero inertia, p = 0 (Pham and Pham 2018): then, feasible."""
    rng = np.random.default_rng(seed)
    count = 40
    s = np.linspace(0, 1, count + 1)
    h = np.diff(s)
    phase, size = rng.uniform(0, 6.28, (2, rows)), rng.uniform(0.3, 2, rows)
    p = size * (np.cos(2 * np.pi * s[:, None] + phase[0]) + (0.0 if reverses else 1.3))
    q = rng.uniform(0, 2) * np.sin(2 * np.pi * s[:, None] + phase[1])
    most = rng.uniform(0.5, 2, count + 1)
    jumps, before = np.zeros(0, dtype=np.intp), np.zeros((3, rows, 0))
    limits = np.stack([p.T, q.T, 0 * p.T])
    x, first, last = reachability_passes(s, np.where(np.isin(s, [0, 1]), 0.0, most), limits, (jumps, before))
    # unknowns: squared speeds, then accelerations where intervals begin and where they end
    matrix, equal, bounds = [], [], [(0, 0), *((0, top) for top in most[1:-1]), (0, 0), *[(None, None)] * (2 * count)]
    for k in range(count):
        growth = np.zeros(3 * count + 1)
        growth[[k, k + 1, count + 1 + k, 2 * count + 1 + k]] = 1, -1, h[k], h[k]
        equal.append(growth)
        if k in (0, count - 1):  # one acceleration next to rest
            equal.append(np.zeros(3 * count + 1))
            equal[-1][[count + 1 + k, 2 * count + 1 + k]] = 1, -1
        for side in (0, 1):
            for r in range(rows):
                row = np.zeros(3 * count + 1)
                row[k + side], row[(1 + side) * count + 1 + k] = q[k + side, r], p[k + side, r]
                matrix += [row, -row]
    cost = -np.concatenate([np.ones(count + 1), np.zeros(2 * count)])
    result = linprog(cost, np.array(matrix), np.ones(len(matrix)), np.array(equal), np.zeros(count + 2), bounds=bounds)
    solution = np.concatenate([x, first, last])
    if not reverses:
        assert (np.array(matrix) @ solution <= 1 + 1e-9).all()
        assert x.sum() == pytest.approx(-result.fun, rel=1e-9)
    assert np.array(equal) @ solution == pytest.approx(0, abs=1e-12)
    assert x.sum() <= -result.fun * (1 + 1e-9)


@pytest.mark.parametrize("seed", some([38, 41], [41]))
def test_a_random_arm_is_as_fast_as_the_optimal_control_problem(seed: int) -> None:
    """Which holds its jerk in intervals, and so is a little slower than the optimum itself."""
    arm, limits = random_arm(seed)
    plan = schedule(arm.path, limits, joints=arm)
    best = solve_minimum_time(arm.path, limits, arm, guess=plan, intervals=60, rounds=1)
    assert plan.duration <= 1.02 * best.duration
    assert largest(plan, arm).max() <= 1.001


@pytest.mark.parametrize("seed", some([5, 15, 23, 29], 2))
def test_a_finer_grid_is_hardly_faster(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first two lose most of fifty."""
    arm, limits = random_arm(seed)
    plan = schedule(arm.path, limits, joints=arm)
    finer = {name: getattr(grids.SETTINGS, name) / 4 for name in ("build_up", "ramp", "turn", "uneven", "uneven_speed")}
    monkeypatch.setattr(grids, "SETTINGS", replace(grids.SETTINGS, growth=1.05, **finer))
    fine = schedule(arm.path, limits, joints=arm)
    assert len(fine.profile.jerk) > 1.5 * len(plan.profile.jerk)
    assert fine.duration * (1 - 2e-4) <= plan.duration <= fine.duration * 1.005
    assert largest(plan, arm).max() <= 1.001


def random_arm(seed: int) -> tuple[ScaraPath, LineLimits]:
    rng = np.random.default_rng(seed)
    arm = None
    while arm is None:
        arm = random_arm_path(rng)
    jerk = 10 ** rng.uniform(2, 3.5, 4)
    joints = JointLimits(10 ** rng.uniform(-0.3, 1, 4), 10 ** rng.uniform(0.5, 1.7, 4), jerk)
    speed, acceleration, sharp = 10 ** rng.uniform(-1, 0.5), 10 ** rng.uniform(0, 1.3), 10 ** rng.uniform(1, 3)
    return arm, LineLimits(speed, acceleration, sharp, 10 ** rng.uniform(-1, 1.5), joints)


@pytest.mark.parametrize("seed", some(range(3), 1))
def test_backwards_takes_as_long(seed: int) -> None:
    joints, limits = swinging(seed)
    back = RandomStretch(
        **{
            name: lambda n, s, curve=curve: (-1.0) ** n * curve(n, LENGTH - s)
            for name, curve in zip(joints.names, joints.curves, strict=True)
        }
    )
    plans = [schedule(straight(), replace(LINE, joints=limits), joints=one) for one in (joints, back)]
    assert plans[0].duration == pytest.approx(plans[1].duration, rel=2e-3)


@pytest.mark.parametrize("seed", some(range(3), 1))
def test_the_units_of_length_and_time_do_not_matter(seed: int) -> None:
    joints, limits = swinging(seed)
    expected = schedule(straight(), replace(LINE, joints=limits), joints=joints).duration
    for unit in (1e-3, 1e3):
        scaled = RandomStretch(
            **{
                name: lambda n, s, curve=curve: curve(n, s / unit) / unit**n  # noqa: B023
                for name, curve in zip(joints.names, joints.curves, strict=True)
            }
        )
        line = LineLimits(unit * 1.0, unit * 5.0, unit * 200.0, joints=limits)
        assert schedule(straight(unit * LENGTH), line, joints=scaled).duration == pytest.approx(expected, rel=1e-4)
        v, a, j = (np.asarray(bound) for bound in (limits.velocity, limits.acceleration, limits.jerk))
        slow = LineLimits(1 / unit, 5 / unit**2, 200 / unit**3, joints=JointLimits(v / unit, a / unit**2, j / unit**3))
        assert schedule(straight(), slow, joints=joints).duration == pytest.approx(unit * expected, rel=1e-4)


@settings(max_examples=8)
@given(seeds)
def test_higher_limits_are_never_slower_and_all_are_kept(seed: int) -> None:
    joints, limits = swinging(seed)
    rng = np.random.default_rng(seed)
    plan = schedule(straight(), replace(LINE, joints=limits), joints=joints)
    kinds = ("velocity", "acceleration", "jerk")
    more = JointLimits(**{kind: np.asarray(getattr(limits, kind)) * rng.uniform(1, 1.5, 3) for kind in kinds})
    faster = schedule(straight(), replace(LINE, joints=more), joints=joints)
    assert faster.duration <= plan.duration * (1 + 2e-3)
    for one in (plan, faster):
        assert largest(one, joints).max() <= 1.001
        inside = dense(one).speed[1:-1]
        assert (inside[2:-2] > 0).all()


def test_windows_change_the_time_by_next_to_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    joints, limits = swinging(5)
    whole = schedule(straight(), replace(LINE, joints=limits), joints=joints)
    monkeypatch.setattr(stretches, "SETTINGS", replace(stretches.SETTINGS, window=120, overlap=60))
    cut = schedule(straight(), replace(LINE, joints=limits), joints=joints)
    assert cut.duration == pytest.approx(whole.duration, rel=2e-3)
    assert largest(cut, joints).max() <= 1.001


@pytest.fixture(scope="module")
def panda() -> tuple[SmoothPath, PlannedJoints, Schedule]:
    """Short lines with rounded corners, the joints along them, and their schedule in one window."""
    path, joints = panda_path(20)
    limits = LineLimits(0.5, 5.0, 200.0, 5.0, PANDA)
    assert len(make_grid(path, limits, joints).requested) < stretches.SETTINGS.window
    return path, joints, schedule(path, limits, joints=joints)


@pytest.mark.parametrize(("window", "overlap"), [(120, 40), (60, 30)])
def test_seam_after_seam_a_panda_keeps_limits_of_all_kinds_and_loses_no_time(
    panda: tuple[SmoothPath, PlannedJoints, Schedule], window: int, overlap: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the line, and of the joints' velocity, acceleration, jerk and torque, each of which binds somewhere."""
    path, joints, whole = panda
    monkeypatch.setattr(stretches, "SETTINGS", replace(stretches.SETTINGS, window=window, overlap=overlap))
    plan = schedule(path, whole.limits, joints=joints)
    assert len(plan.profile.jerk) > 10 * window
    assert plan.duration == pytest.approx(whole.duration, rel=0.01)
    motion, demand = dense(plan), largest(plan, joints)
    torque = joints.torques(motion.distance)
    used = torque.inertia * motion.acceleration[:, None] + torque.drag * motion.speed[:, None] ** 2 + torque.rest
    of_joints = [*demand[:3], np.abs(used / TORQUE).max()]
    assert max(*demand, *of_joints) <= 1.001
    assert min(of_joints) > 0.99


def test_without_a_jerk_limit_the_time_is_the_limit_of_high_jerks() -> None:
    arm, limits = random_arm(2)
    assert limits.joints is not None
    free = replace(limits, jerk=np.inf, joints=replace(limits.joints, jerk=np.inf))
    none = schedule(arm.path, free, joints=arm)
    assert largest(none, arm)[[0, 1, 3, 4, 6]].max() <= 1.001
    times = [
        schedule(arm.path, replace(limits, jerk=jerk, joints=free.joints), joints=arm).duration for jerk in (1e2, 1e4)
    ]
    assert none.duration * (1 - 1e-3) < times[1] < times[0]
    assert times[1] == pytest.approx(none.duration, rel=1e-2)


def test_without_a_jerk_limit_a_line_takes_bang_bang_acceleration() -> None:
    plan = schedule(straight(1.0), LineLimits(10.0, 5.0, np.inf))
    assert plan.duration == pytest.approx(2 * np.sqrt(1 / 5.0), rel=1e-3)
    assert np.abs(plan.profile.acceleration).max() <= 5.0 * (1 + 1e-9)


def test_the_tool_keeps_its_limits_along_each_axis_and_turns_no_faster() -> None:
    yaw = [turned((0, 0, angle)) for angle in (0.0, 0.8, 2.0)]
    path = smooth(Path.through([(0, 0, 0), (0.3, 0.0, 0.1), (0.3, 0.4, 0.0)], yaw), 0.05)
    tool = ToolLimits([1.0, 2.0, 1.5], [20.0, 30.0, 25.0], 2.0)
    plan = schedule(path, replace(LINE, tool=tool))
    free = schedule(path, LINE)
    motion = dense(plan)
    place, turn = path.at(motion.distance), path.turn(motion.distance)
    v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
    acceleration = place.curvature * v**2 + place.tangent * a
    jerk = place.curvature_rate * v**3 + 3 * place.curvature * v * a + place.tangent * j
    used = [
        (np.abs(acceleration) / tool.acceleration).max(),
        (np.abs(jerk) / tool.jerk).max(),
        (np.linalg.norm(turn.rate, axis=1) * motion.speed / tool.turn_rate).max(),
    ]
    assert max(used) <= 1.001
    assert min(used) > 0.9
    assert plan.duration > free.duration
    assert any(dip.cause.startswith("tool acceleration along") for dip in plan.dips)


class Loaded(RandomStretch):
    """Joints that move with the line and lift a load: torque = inertia a + rest, both given."""

    def torques(self, distance: Any) -> Any:
        s = np.asarray(distance, dtype=float)
        rest = 3.0 + 2.0 * np.sin(np.pi * s / LENGTH)
        flat = np.ones((len(s), 1))
        return SimpleNamespace(inertia=2.0 * flat, drag=0.0 * flat, rest=rest[:, None])


@pytest.mark.parametrize("jerk", [200.0, np.inf])
def test_a_torque_limit_is_reduced_by_the_load(jerk: float) -> None:
    joints, most = Loaded(lift=even()), 6.5
    plan = schedule(straight(), replace(LINE, jerk=jerk, joints=JointLimits(torque=most)), joints=joints)
    motion = dense(plan)
    torque = joints.torques(motion.distance)
    used = torque.inertia[:, 0] * motion.acceleration + torque.rest[:, 0]
    assert 0.99 * most < used.max() <= most * 1.001
    assert any(dip.cause == "joint 'lift' torque" for dip in plan.dips)
    # it brakes harder than it may speed up: the load helps
    assert motion.acceleration.max() < (most - 3.0) / 2.0 * 1.001 < -motion.acceleration.min()


def test_a_torque_that_does_not_hold_the_load_is_refused_by_name_and_place() -> None:
    joints = Loaded(lift=even())
    with pytest.raises(ProblemError, match=r"joint 'lift' torque does not hold the load at 1(\.0\d*)? m") as caught:
        schedule(straight(), replace(LINE, joints=JointLimits(torque=4.9)), joints=joints)
    assert caught.value.name == "joint 'lift' torque"
    assert caught.value.time == pytest.approx(1.0, abs=0.05)
    with pytest.raises(ProblemError, match="torques"):
        schedule(straight(), replace(LINE, joints=JointLimits(torque=9.0)), joints=RandomStretch(lift=even()))


def test_a_dip_names_place_cause_and_amount() -> None:
    arm = scara_along(Scara(0.4, 0.4), example("quintic"), "right")
    plan = schedule(arm.path, replace(LINE, joints=JointLimits([1.0, 9.0, 9.0, 9.0])), joints=arm)
    dip = next(dip for dip in plan.dips if "'shoulder' velocity" in dip.cause)
    inside = dip.start + (dip.end - dip.start) * np.linspace(0.1, 0.9, 400)
    rates = np.abs(arm.at(inside).first[:, 0])
    assert dip.permitted == pytest.approx(1.0 / rates.max(), rel=1e-2)
    speed = plan.profile.at_distance(inside).speed
    assert speed * rates == pytest.approx(1.0, rel=0.03)
    assert (speed < dip.requested).all()


def test_joint_motions_of_a_schedule_are_those_of_its_profile() -> None:
    joints, limits = swinging(1)
    plan: Schedule = schedule(straight(), replace(LINE, joints=limits), joints=joints)
    motion = plan.sample(1e-2)
    velocity = joint_motion(joints, motion)[1]
    assert velocity == pytest.approx(joints.at(motion.distance).first * motion.speed[:, None])
