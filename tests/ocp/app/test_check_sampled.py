"""Samples are held to what every motion through them needs: those of toppra and ruckig pass, faster ones do not."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import ruckig
import toppra
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog
from toppra.algorithm import TOPPRA
from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

from ocp.app import Check
from ocp.app.check.joint_limits import Motion
from ocp.app.files import RawTrajectory
from tests.ocp.app.motions import check_motion
from tests.ocp.app.test_check_toppra import arm

FASTER = 1.1
SOME, PERIODS = (0.001, 0.01), (0.001, 0.002, 0.004, 0.008, 0.01)

# ---- closed forms ----------------------------------------------------------------------------------------------------


def least(motion: Motion, order: int) -> float:
    """Of the only piece of a motion, the smallest largest derivative of any motion that it is sampled from: a linear
    program of steps of a constant derivative."""
    count, h = 400, float(motion.t[1] - motion.t[0])
    start = np.array([float(one[0, 0]) for one in (motion.q, motion.v, motion.a)[:order]])  # type: ignore[index]
    end = np.array([float(one[1, 0]) for one in (motion.q, motion.v, motion.a)[:order]])  # type: ignore[index]
    step = h / count
    powers = [step**k / [1, 1, 2, 6][k] for k in range(order + 1)]
    one = np.array([[powers[j - i] if j >= i else 0.0 for j in range(order)] for i in range(order)])
    push = np.array([powers[order - i] for i in range(order)])
    columns, whole = [], np.eye(order)
    for _ in range(count):
        columns.append(whole @ push)
        whole = whole @ one
    matrix = np.column_stack([*columns[::-1], np.zeros(order)])
    sizes = np.column_stack([np.vstack([np.eye(count), -np.eye(count)]), -np.ones(2 * count)])
    scale = np.abs(matrix).max(axis=1)
    result = linprog(
        [*np.zeros(count), 1.0],
        sizes,
        np.zeros(2 * count),
        matrix / scale[:, None],
        (end - whole @ start) / scale,
        bounds=[(None, None)] * (count + 1),
    )
    assert result.success
    return float(result.fun)


@pytest.mark.parametrize("seed", range(6))
def test_needed_accelerations_and_jerks_are_those_of_a_linear_program(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.array([0.0, rng.uniform(0.2, 2.0)])
    q, v, a = rng.normal(size=(3, 2, 1))
    assert Motion(t, q, v).needed("acceleration")[0][0, 0] == pytest.approx(least(Motion(t, q, v), 2), rel=1e-2)
    jerk, proven = least(Motion(t, q, v, a), 3), Motion(t, q, v, a).needed("jerk")[0][0, 0]
    assert 0.5 * jerk < proven < 1.001 * jerk


def test_from_rest_to_rest_the_closed_forms_are_met() -> None:
    t, q, rest = np.array([0.0, 2.0]), np.array([[0.0], [1.0]]), np.zeros((2, 1))
    assert Motion(t, q, rest).needed("acceleration")[0][0, 0] == pytest.approx(4 * 1.0 / 2.0**2)
    assert Motion(t, q, rest, rest).needed("jerk")[0][0, 0] == pytest.approx(32 * 1.0 / 2.0**3)
    assert Motion(t, q, rest).needed("velocity")[0][0, 0] == pytest.approx(2 * 1.0 / 2.0)


@given(st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=40), st.integers(1, 7), st.floats(-1.0, 1.0))
def test_no_sampling_of_a_motion_needs_more_than_the_motion_has(pushes: list[float], every: int, speed: float) -> None:
    """Steps of constant acceleration, sampled at some of their times, some between."""
    h, a = 0.01, np.array(pushes)
    knots = h * np.arange(len(a) + 1)
    speeds = speed + np.concatenate([[0.0], np.cumsum(h * a)])
    places = np.concatenate([[0.0], np.cumsum(h * (speeds[1:] + speeds[:-1]) / 2)])
    t = np.unique(np.append(np.arange(0.0, knots[-1], every * 0.37 * h), knots[-1]))
    k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(a) - 1)
    s = t - knots[k]
    v = (speeds[k] + a[k] * s)[:, None]
    motion = Motion(t, (places[k] + speeds[k] * s + a[k] * s**2 / 2)[:, None], v)
    room = 1e-9 + 1e-12 / np.diff(t).min() ** 2
    assert motion.needed("acceleration")[0].max() <= np.abs(a).max() + room
    assert (motion.needed("velocity")[0] >= np.maximum(v[1:], v[:-1])).all()
    assert (motion.needed("velocity")[1] >= -np.minimum(v[1:], v[:-1])).all()


# ---- toppra and ruckig -----------------------------------------------------------------------------------------------

Sampled = tuple[float, Callable[[Any], tuple[Any, ...]], dict[str, Any]]
"""Duration, positions, velocities and accelerations at times, and limits that the motion keeps."""


def of_toppra(seed: int, dof: int) -> Sampled:
    """It keeps its limits at the points of its grid alone: those that it truly keeps are its largest values."""
    rng = np.random.default_rng(seed)
    velocity, acceleration = rng.uniform(1.5, 3.5, dof), rng.uniform(5.0, 15.0, dof)
    toppra.setup_logging("ERROR")
    path = toppra.SplineInterpolator(np.linspace(0, 1, 5), rng.uniform(-1.5, 1.5, (5, dof)))
    limits = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    motion = TOPPRA(limits, path).compute_trajectory(0, 0)
    fine = np.linspace(0.0, motion.duration, 100_001)
    most = {what: np.abs(motion(fine, order)).max(axis=0) for what, order in (("velocity", 1), ("acceleration", 2))}
    return motion.duration, lambda t: tuple(motion(t, order) for order in range(3)), most


def of_ruckig(seed: int, dof: int) -> Sampled:
    """Through five postures, with a rest at each."""
    rng = np.random.default_rng(seed)
    limits = {"velocity": (1.5, 3.5), "acceleration": (5.0, 15.0), "jerk": (50.0, 400.0)}
    most = {what: rng.uniform(*ends, dof) for what, ends in limits.items()}
    configurations = rng.uniform(-1.5, 1.5, (5, dof))
    motions, starts = [], [0.0]
    for begin, end in pairwise(configurations):
        request = ruckig.InputParameter(dof)
        request.current_position, request.target_position = begin.tolist(), end.tolist()
        request.max_velocity, request.max_acceleration, request.max_jerk = (one.tolist() for one in most.values())
        motions.append(ruckig.Trajectory(dof))
        ruckig.Ruckig(dof).calculate(request, motions[-1])
        starts.append(starts[-1] + motions[-1].duration)

    def at(t: Any) -> tuple[Any, ...]:
        which = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(motions) - 1)
        rows = [motions[k].at_time(float(time - starts[k]))[:3] for k, time in zip(which, t, strict=True)]
        return tuple(np.array([row[order] for row in rows]) for order in range(3))

    return starts[-1], at, most


def checked(sampled: Sampled, period: float, rates: int, faster: float = 1.0, **options: Any) -> Check:
    duration, at, most = sampled
    robot = arm(most["velocity"])
    t = np.append(np.arange(0.0, duration - 1e-9, period), duration)
    values = [one * faster**order for order, one in enumerate(at(t)[:rates])]
    lines = np.arange(1, len(t) + 1)
    q, v, a = (*values, None, None)[:3]
    raw = RawTrajectory(robot.joint_names, t / faster, q, v, a, None, lines, True, (), "sampled")
    limits: dict[str, Any] = {
        what: dict(zip(robot.joint_names, one.tolist(), strict=True)) for what, one in most.items()
    }
    return check_motion(robot, raw, **limits, scene=False, **options)


@pytest.mark.parametrize("rates", [1, 2, 3])
@pytest.mark.parametrize(
    ("seed", "periods"),
    [(0, SOME), (1, SOME), *(pytest.param(seed, PERIODS, marks=pytest.mark.long) for seed in range(12))],
)
@pytest.mark.parametrize("result", [of_toppra, of_ruckig])
def test_sampled_motions_pass_and_faster_ones_do_not(
    result: Callable[[int, int], Sampled], seed: int, periods: tuple[float, ...], rates: int
) -> None:
    sampled = result(seed, 6 + seed % 2)
    for period in periods:
        sound = checked(sampled, period, rates)
        assert sound.passed, sound
        fast = checked(sampled, period, rates, FASTER)
        assert {fault.kind for fault in fast.faults} & {"velocity", "acceleration", "jerk"}, fast


def test_a_stated_rule_is_checked_by_its_interpolant() -> None:
    sampled = of_toppra(0, 6)
    check = checked(sampled, 0.01, 2, rule="cubic")
    assert {fault.kind for fault in check.faults} >= {"acceleration"}


def test_distant_waypoints_are_checked_by_their_cubics() -> None:
    """From rest to rest in 1 s a cubic is 1.5 times as fast as the mean; 1.2 times are allowed."""
    t = np.arange(4.0)
    q = np.array([0.0, 1.0, 0.0, 1.0])[:, None] * np.ones(6)
    robot = arm(np.full(6, 1.2))
    lines = np.arange(1, 5)
    raw = RawTrajectory(robot.joint_names, t, q, 0 * q, None, None, lines, True, (), "far")
    check = check_motion(robot, raw, scene=False, time_unit="s")
    assert {fault.kind for fault in check.faults} == {"velocity"}
    assert [abs(fault.value or 0.0) for fault in check.faults] == pytest.approx([1.5] * 6)
