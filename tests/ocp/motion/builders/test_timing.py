"""Minimum time along a path as an optimal control problem: closed forms, limits between the points, and schedules."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from models import Path, Scara, SmoothPath, scara_along, smooth
from models.machines.scara import ScaraPath
from ocp import Collocation, ProblemError, minimum_time_problem, solve
from ocp.motion.builders.timing import FastestMotion, largest_demand, solve_minimum_time, table
from ocp.motion.schedule import JointLimits, LineLimits, Schedule, ToolLimits, joint_motion, peak_acceleration, schedule
from tests.models.paths.test_paths import example
from tests.ocp.motion.schedule.test_schedule import line
from tests.ocp.motion.schedule.test_schedule_joints import SLOW, BrokenJoints

pytestmark = [pytest.mark.xdist_group("timing"), pytest.mark.long]  # one process, so that the example is solved once

INTERVALS = 100
HELD = 1e-2
"""What jerks held over so few intervals may cost; the schedule beside them is not bound to them."""
ACCELERATION = peak_acceleration(5.0, 1.0, 200.0)


class Case(NamedTuple):
    path: SmoothPath
    limits: LineLimits
    joints: ScaraPath | None
    plan: Schedule
    best: FastestMotion


def random_path(seed: int) -> tuple[SmoothPath, LineLimits]:
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.normal(size=(int(rng.integers(3, 8)), 3)) * 10.0 ** rng.uniform(-3, 0), axis=0)
    path = smooth(Path.through(points), 0.3 * float(np.linalg.norm(np.diff(points, axis=0), axis=1).min()))
    speed, acceleration = path.length * 10 ** rng.uniform(-0.5, 0.5), path.length * 10 ** rng.uniform(-0.5, 1)
    jerk, bend = path.length * 10 ** rng.uniform(0, 3), acceleration * rng.uniform(0.3, 2)
    return path, LineLimits(speed, acceleration, jerk, bend)


def case(path: SmoothPath, limits: LineLimits, joints: ScaraPath | None = None, intervals: int = INTERVALS) -> Case:
    """The minimum time from the schedule of the same path."""
    plan = schedule(path, limits, joints=joints)
    return Case(path, limits, joints, plan, solve_minimum_time(path, limits, joints, guess=plan, intervals=intervals))


@pytest.fixture(scope="module")
def arm() -> ScaraPath:
    return scara_along(Scara(0.4, 0.4), example("quintic"), "right")


@pytest.fixture(scope="module")
def limited(arm: ScaraPath) -> Case:
    """The paper's example with a SCARA's limits."""
    return case(arm.path, LineLimits(1.0, ACCELERATION, 200.0, 5.0, SLOW), arm)


def worst(solved: Case) -> float:
    """Largest demand at ten times the grid and more, the demands being those of the test's own formulas."""
    profile = solved.best.schedule.profile
    inside = (np.arange(30) + 0.5) / 30
    motion = profile.at((profile.t[:-1, None] + np.diff(profile.t)[:, None] * inside).ravel())
    limits, s = solved.limits, motion.distance
    results: list[Any] = [
        motion.speed / np.max(limits.speed),
        motion.speed**2 * solved.path.curvature(s) / limits.centripetal,
    ]
    results += [np.abs(motion.acceleration) / limits.acceleration, np.abs(motion.jerk) / limits.jerk]
    if solved.joints is not None:
        moved = joint_motion(solved.joints, motion)[1:]
        results += [np.abs(v) / b for v, b in zip(moved, limits.of_joints(4), strict=True)]
    return max(float(value.max()) for value in results)


@pytest.mark.parametrize(
    ("speed", "acceleration", "jerk", "duration"),
    [
        (1.0, 5.0, 200.0, 1.0 + 0.2 + 5.0 / 200),  # seven phases: L/v + v/a + a/j
        (1.0, 5.0, 20.0, 1.0 + 2 * np.sqrt(1 / 20)),  # the acceleration is not reached: L/v + 2 sqrt(v/j)
        (9.0, 9.0, 20.0, 4 * (1 / 40) ** (1 / 3)),  # nor the speed: 4 (L/(2 j))^(1/3)
    ],
)
def test_a_line_takes_the_closed_form_whatever_the_guess(
    speed: float, acceleration: float, jerk: float, duration: float
) -> None:
    path, limits = line(1.0), LineLimits(speed, acceleration, jerk)
    assert schedule(path, limits).duration == pytest.approx(duration, rel=1e-9)
    best = solve_minimum_time(path, limits, intervals=INTERVALS)
    assert best.duration == pytest.approx(duration, rel=1e-6)
    # a guess that knows nothing of the optimum: its nodes are elsewhere, and the jerk held on them costs time
    slow = schedule(path, LineLimits(0.3, 1.0, 10.0))
    other = solve_minimum_time(path, limits, guess=slow, intervals=2 * INTERVALS)
    assert slow.duration > 2 * duration
    assert -1e-6 < other.duration / duration - 1 < 1e-4
    assert other.demand < 1.001


def test_without_a_jerk_limit_to_speak_of_a_line_takes_bang_bang_acceleration() -> None:
    best = solve_minimum_time(line(1.0), LineLimits(10.0, 5.0, 1e6), intervals=INTERVALS)
    assert best.duration == pytest.approx(2 * np.sqrt(1 / 5.0), rel=1e-4)
    assert best.demand < 1.001


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    def best(unit: float) -> float:
        corner = Path.through(unit * np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.5, 0.0)]))
        limits = LineLimits(unit, 5 * unit, 200 * unit, 5 * unit)
        return solve_minimum_time(smooth(corner, 0.1 * unit), limits, intervals=50).duration

    assert best(scale) == pytest.approx(best(1.0), rel=1e-6)


def test_the_example_keeps_every_limit_between_the_points(limited: Case) -> None:
    assert worst(limited) < 1.001
    assert limited.best.demand < 1.001
    motion = limited.best.schedule.sample(1e-3)
    demands = largest_demand(limited.path, limited.limits, limited.joints, motion)
    # as fast as it goes: something binds nearly everywhere
    assert np.median(demands) > 0.98


def test_the_motion_of_the_example_is_a_motion_as_fast_as_the_schedule(limited: Case) -> None:
    assert limited.best.duration < limited.plan.duration * (1 + HELD)
    profile = limited.best.schedule.profile
    t = np.diff(profile.t)
    v, a, j = profile.speed[:-1], profile.acceleration[:-1], profile.jerk
    assert (t > 0).all()
    assert profile.distance[-1] == pytest.approx(limited.path.length, rel=1e-12)
    assert np.diff(profile.distance) == pytest.approx(t * (v + t * (a / 2 + t * j / 6)), rel=1e-5, abs=1e-9)
    assert profile.speed[1:] == pytest.approx(v + t * (a + t * j / 2), abs=1e-5)
    assert profile.acceleration[1:] == pytest.approx(a + t * j, abs=1e-5)
    assert profile.duration == pytest.approx(limited.best.solution.cost, rel=1e-6)


def test_more_intervals_and_no_schedule_give_the_same_minimum(limited: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_with_joints(path: Any, limits: LineLimits, *, joints: Any = None) -> Schedule:
        if limits.joints is not None:
            raise ProblemError("no schedule found")
        return schedule(path, limits, joints=joints)

    monkeypatch.setattr("ocp.motion.builders.timing.schedule", none_with_joints)
    other = solve_minimum_time(limited.path, limited.limits, limited.joints, intervals=150)
    # held jerks lose time in proportion to the intervals' width
    assert other.duration == pytest.approx(limited.best.duration, rel=3e-3)
    assert other.demand < 1.001


@pytest.mark.parametrize("kind", ["cubic", "quintic"])
def test_centripetal_limits_hold_at_jumps_of_the_curvature(kind: str) -> None:
    perturbed = case(example(kind), LineLimits(1.0, ACCELERATION, 200.0, 5.0))
    assert worst(perturbed) < 1.001
    assert perturbed.best.duration < perturbed.plan.duration * (1 + HELD)


def test_speeds_of_segments_are_kept() -> None:
    path, limits, _, plan, best = case(example("quintic"), LineLimits(np.array([1.0, 0.4, 0.7]), 5.0, 200.0))
    motion = best.schedule.sample(1e-3)
    assert largest_demand(path, limits, None, motion).max() < 1.001
    assert best.duration < plan.duration * (1 + HELD)
    assert motion.speed[np.argmin(np.abs(motion.distance - 0.7))] == pytest.approx(0.4, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_random_paths_are_solved_and_bracketed(seed: int) -> None:
    path, limits = random_path(seed)
    solved = case(path, limits, intervals=60)
    assert worst(solved) < 1.001
    # no motion beats the line alone, without its curvature
    alone = schedule(path, LineLimits(limits.speed, limits.acceleration, limits.jerk)).duration
    assert alone * (1 - 1e-6) < solved.best.duration < solved.plan.duration * (1 + HELD)


def test_joint_limits_far_below_the_requested_speed_are_solved(arm: ScaraPath) -> None:
    tight = case(arm.path, LineLimits(1.0, ACCELERATION, 200.0, 5.0, JointLimits(0.1, 0.2, 1.0)), arm, 60)
    assert worst(tight) < 1.001
    assert tight.best.duration < tight.plan.duration * (1 + HELD)


def test_the_audit_confirms_the_motion_but_not_that_it_is_the_fastest(limited: Case) -> None:
    """Jerks held over intervals cannot follow a limit: time is lost, and the audit says so, and only that."""
    audit = limited.best.solution.audit()
    assert audit.feasible, str(audit)
    assert audit.optimal is False
    assert not audit["cost lost, relative"].passed
    assert audit["cost, relative"].value < 1e-4


def test_free_jerks_at_the_points_are_faster_than_held_ones_and_break_limits_between(limited: Case) -> None:
    """Why held jerks: with any other control the limits hold at the points alone."""
    timing = limited.best.timing
    free = solve(timing.problem, Collocation(len(timing.mesh) - 1, 3, mesh=timing.mesh))
    assert free.cost < limited.best.duration
    assert not free.audit()["bounds of jerk"].passed
    with pytest.raises(ProblemError, match="held"):
        timing.profile(free)


def test_tables_are_exact_between_their_breaks_and_jump_at_them() -> None:
    def columns(x: Any) -> Any:
        return np.column_stack([np.sin(20 * x) + (x >= 0.3), 1e6 / (1e-3 + (x - 0.7) ** 2), np.abs(x - 0.3)])

    function = table(columns, np.array([0.0, 0.3, 1.0]))
    x = np.linspace(0, 1, 4001)
    result = np.array(function.map(len(x))(x[None])).T
    assert (np.abs(result - columns(x)).max(axis=0) < 2e-8 * np.abs(columns(x)).max(axis=0)).all()
    assert np.array(function(0.3))[0, 0] == pytest.approx(np.sin(6.0) + 1, abs=4e-8)
    assert np.array(function(0.3 - 1e-12))[0, 0] == pytest.approx(np.sin(6.0), abs=4e-8)


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (None, "joint limits need"),
        (BrokenJoints("second", np.nan), "not finite"),
        (BrokenJoints("first", np.inf), "not finite"),
        (BrokenJoints("third", np.ones((1, 3))), "shape"),
    ],
)
def test_broken_joints_are_named_errors(joints: Any, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        solve_minimum_time(example("quintic"), LineLimits(1.0, 5.0, 200.0, joints=JointLimits(1.0, 1.0, 1.0)), joints)
    assert (caught.value.name or "unnamed") in str(caught.value)


def test_a_joint_jerk_limit_on_a_path_whose_curvature_jumps_is_refused() -> None:
    path = example("cubic")
    along = scara_along(Scara(0.4, 0.4), path, "right")
    limits = LineLimits(1.0, 5.0, 200.0, joints=SLOW)
    for guess in (None, schedule(path, LineLimits(1.0, 5.0, 200.0))):
        with pytest.raises(ProblemError, match="curvature jumps"):
            solve_minimum_time(path, limits, along, guess=guess)


def test_a_guess_of_another_path_and_too_few_intervals_are_refused() -> None:
    limits = LineLimits(1.0, 5.0, 200.0)
    with pytest.raises(ProblemError, match="guess is for a path"):
        minimum_time_problem(line(1.0), limits, guess=schedule(line(2.0), limits))
    with pytest.raises(ProblemError, match="intervals"):
        minimum_time_problem(line(1.0), limits, intervals=5)


def test_limits_that_a_minimum_time_problem_does_not_have_are_refused() -> None:
    tool = LineLimits(1.0, 5.0, 200.0, tool=ToolLimits(velocity=1.0))
    with pytest.raises(ProblemError, match="no constraints on the tool"):
        minimum_time_problem(line(1.0), tool)
    path = example("quintic")
    along = scara_along(Scara(0.4, 0.4), path, "right")
    torques = LineLimits(1.0, 5.0, 200.0, joints=JointLimits(velocity=1.0, torque=5.0))
    with pytest.raises(ProblemError, match="torque"):
        minimum_time_problem(path, torques, along)
