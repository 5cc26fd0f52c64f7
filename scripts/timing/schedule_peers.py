"""Peers of `schedule` on random splines of seven joints: toppra without, and copp-py also with jerk limits.

copp-py has the settings with the shortest motions found here: exact derivatives of the joints at its grid points, and
with jerk limits a grid that is denser at both ends. On the even grid of the reference, it linearizes the jerk limits
once; a second time made the first motion 4e-6 shorter. Times are of the processor, of one tool after the other.
"""

from __future__ import annotations

import importlib
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.interpolate import make_interp_spline

from models import FixedBase, paths, smooth
from models.checks import Array
from ocp import ProblemError, SolveError, joint_path
from ocp.motion.schedule import JointLimits, LineLimits, LineMotion, schedule
from scripts.papers.run import progress
from scripts.robots.robots import PANDA
from scripts.timing.measure import least_of_processor
from scripts.timing.schedules import JOINTS, usage

NODES, REFERENCE_NODES = 1001, 4001
"""Numbers of grid points of the peers, and of the grid of copp-py whose duration is the reference."""
EVEN_SHARE = 0.2
"""Share of even spacing in the graded grid of copp-py; the rest follows a motion from rest to rest."""
GOALS = {"acceleration": 1e-4, "jerk": 5e-4}
"""Goals of the random splines: largest relative excess of the duration over the reference, by the highest limit."""
SHORT_RUN_S = 0.5
"""Time of a run below which the least time of three runs is taken."""
UNIT = smooth(paths.Path.through([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]), deviation=1e-3)
"""Line of 1 m along which the random splines run."""


class Timing(NamedTuple):
    """Motion along a path that a tool has planned.

    Attributes:
        duration: Duration, s.
        nodes: Number of nodes.
        at: Returns the motion at times (M,), s.
    """

    duration: float
    nodes: int
    at: Callable[[Array], LineMotion]


Planner: TypeAlias = Callable[[Any, JointLimits], Timing | None]
"""(joints, limits) -> timing, or None if the tool fails."""


class Splines:
    """Seven joints that follow a random spline of degree 5 through six points along a line of 1 m.

    Attributes:
        names: Names of the joints.
        curves: The spline and its first three derivatives.
    """

    def __init__(self, seed: int) -> None:
        knots = np.random.default_rng(seed).uniform(-2.0, 2.0, (6, 7))  # rad
        curve = make_interp_spline(np.linspace(0.0, 1.0, len(knots)), knots, 5)
        self.names = tuple(f"joint{k}" for k in range(7))
        self.curves = [curve, *(curve.derivative(k) for k in (1, 2, 3))]

    def at(self, distance: Any) -> Any:
        """Return joint positions and their first three derivatives by the distance. Shape (M, 7) each."""
        kinds = ("position", "first", "second", "third")
        values = [np.ascontiguousarray(curve(np.asarray(distance, dtype=float))) for curve in self.curves]
        return type("Rates", (), dict(zip(kinds, values, strict=True)))


def spline_limits(seed: int, jerk: bool) -> JointLimits:
    """Return random limits of velocity, acceleration and, if requested, jerk of seven joints."""
    rng = np.random.default_rng(seed + 1000)
    velocity, acceleration, sharp = (rng.uniform(*span, 7) for span in ((1.0, 3.0), (5.0, 20.0), (50.0, 200.0)))
    return JointLimits(velocity, acceleration, sharp if jerk else np.inf)


def compare_peers(count: int) -> list[dict[str, Any]]:
    """Compare `schedule` with toppra and copp-py on so many random splines; empty if copp-py is not installed.

    All tools plan the same joints under the same limits, and all motions are checked on these joints at the same
    number of times. The reference of a duration is that of copp-py on its finest grid. The last row has no reference:
    the joints of a Panda follow the same splines under limits of velocity, acceleration and torque.

    Returns:
        One row for each kind of limits, named by the highest limited quantity, and each tool: see `summary`; relative
        excess of the duration over the reference (median and worst), number of paths on which it is within the goal,
        and worst relative excess over the shortest motion of any tool. A path on which the tool or the reference
        failed has no excess.
    """
    try:
        copp = importlib.import_module("copp_py")
    except ImportError:
        return []
    even, fine = np.linspace(0.0, 1.0, NODES), np.linspace(0.0, 1.0, REFERENCE_NODES)
    reference = f"copp-py, {REFERENCE_NODES} points"
    tools: dict[str, dict[str, Planner]] = {
        "acceleration": {
            "selfmotion": plan_with_schedule,
            f"toppra, {NODES} points": partial(plan_with_toppra, even),
            f"copp-py, {NODES} points": partial(plan_with_copp, copp, even),
            reference: partial(plan_with_copp, copp, fine),
        },
        "jerk": {
            "selfmotion": plan_with_schedule,
            f"copp-py, {NODES} graded points": partial(plan_with_copp_jerk, copp, graded(even), 2),
            reference: partial(plan_with_copp_jerk, copp, fine, 1),
        },
    }
    try:
        importlib.import_module("toppra").setup_logging("ERROR")
    except ImportError:
        del tools["acceleration"][f"toppra, {NODES} points"]
    rows = []
    for kind, planners in tools.items():
        results = {
            tool: [
                measure_plan(planner, Splines(seed), spline_limits(seed, kind == "jerk"))
                for seed in progress(range(count), f"{kind}, {tool}")
            ]
            for tool, planner in planners.items()
        }
        durations = {tool: durations_of(result) for tool, result in results.items()}
        shortest = np.nanmin([*durations.values()], axis=0)
        rows += [
            {"limits": kind, "tool": tool, **summary(result)}
            | {
                "excess_median": float(np.nanmedian(durations[tool] / durations[reference] - 1)),
                "excess_worst": float(np.nanmax(durations[tool] / durations[reference] - 1)),
                "within_goal": int((durations[tool] / durations[reference] - 1 <= GOALS[kind]).sum()),
                "excess_over_shortest_worst": float(np.nanmax(durations[tool] / shortest - 1)),
            }
            for tool, result in results.items()
        ]
    machine, limits = FixedBase(PANDA.read()), replace(JOINTS, jerk=np.inf)
    panda = [
        measure_plan(plan_with_schedule, joint_path(machine, (even, Splines(seed).at(even).position), UNIT), limits)
        for seed in progress(range(count), "torque, selfmotion")
    ]
    last = {"limits": "torque", "tool": "selfmotion, Panda", **summary(panda)}
    return [*rows, last | {name: "" for name in rows[0] if name not in last}]


def measure_plan(planner: Planner, joints: Any, limits: JointLimits) -> dict[str, float] | None:
    """Return duration (s), number of nodes, time of the processor (s) and usage of a timing; None if planning fails.

    The time is the least of three runs if one is shorter than `SHORT_RUN_S`.
    """
    began = time.process_time()
    timing = planner(joints, limits)
    seconds = time.process_time() - began
    if timing is None:
        return None
    if seconds < SHORT_RUN_S:
        seconds = min(seconds, least_of_processor(lambda: planner(joints, limits), 2))
    return {
        "duration": timing.duration,
        "nodes": timing.nodes,
        "seconds": seconds,
        "usage": usage(timing, joints, limits),
    }


def durations_of(results: Sequence[dict[str, float] | None]) -> Array:
    """Return the durations of motions, nan where planning failed. Shape (len(results),), s."""
    return np.array([np.nan if result is None else result["duration"] for result in results])


def summary(results: Sequence[dict[str, float] | None]) -> dict[str, Any]:
    """Summarise the results of a tool on all paths.

    Returns:
        Number of nodes (median), of paths and of failures; median duration; time of the processor (median and worst);
        largest usage of a limit, where 1 is the limit.
    """
    solved = [result for result in results if result is not None]
    nodes, seconds, used = (np.array([result[name] for result in solved]) for name in ("nodes", "seconds", "usage"))
    return {
        "nodes": int(np.median(nodes)),
        "paths": len(results),
        "failed": len(results) - len(solved),
        "duration_s": float(np.nanmedian(durations_of(results))),
        "median_ms": 1e3 * float(np.median(seconds)),
        "worst_ms": 1e3 * float(seconds.max()),
        "largest_usage": float(used.max()),
    }


def plan_with_schedule(joints: Any, limits: JointLimits) -> Timing | None:
    """Plan with `schedule`, with limits of the line that no motion reaches."""
    line = LineLimits(1e4, 1e5, 1e8 if np.isfinite(limits.jerk).all() else np.inf, joints=limits)
    try:
        plan = schedule(UNIT, line, joints=joints)
    except (ProblemError, SolveError):
        return None
    return Timing(plan.duration, len(plan.profile.jerk) + 1, plan.at)


def plan_with_toppra(grid: Array, joints: Any, limits: JointLimits) -> Timing | None:
    """Plan with toppra on a grid; the motion has constant path acceleration between its points."""
    toppra, constraint, algorithm = (
        importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
    )
    velocity, acceleration = (
        np.asarray(each)[:, None] * [-1.0, 1.0] for each in (limits.velocity, limits.acceleration)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        curve = toppra.SplineInterpolator(grid, joints.at(grid).position)
        limited = [constraint.JointVelocityConstraint(velocity), constraint.JointAccelerationConstraint(acceleration)]
        speed = algorithm.TOPPRA(limited, curve, gridpoints=grid).compute_parameterization(0, 0)[1]
    return None if speed is None or not np.isfinite(speed).all() else timing_of_speeds(grid, speed)


def copp_robot(copp: Any, grid: Array, joints: Any, limits: JointLimits) -> Any:
    """Return the constraints of copp-py at the points of a grid, from the exact derivatives of the joints."""
    robot, rates = copp.Robot(len(joints.names), capacity=len(grid)), joints.at(grid)
    robot.append_s(grid)
    robot.set_q(rates.position, rates.first, rates.second, 0, dddq=rates.third)
    for kind in ("velocity", "acceleration", "jerk"):
        bound = np.asarray(getattr(limits, kind))
        if np.isfinite(bound).all():
            getattr(robot, f"add_{kind}_limits")(bound, -bound, start_idx_s=0, length=len(grid))
    return robot


def plan_with_copp(copp: Any, grid: Array, joints: Any, limits: JointLimits) -> Timing | None:
    """Plan with copp-py without limits of jerk; the motion has constant path acceleration between the points."""
    second = copp.solver.topp2_ra
    try:
        robot = copp_robot(copp, grid, joints, limits)
        squared = second.solve(second.Problem(robot.constraints, (0, len(grid) - 1), (0.0, 0.0)))
    except copp.CoppError:
        return None
    return timing_of_speeds(grid, np.sqrt(squared))


def plan_with_copp_jerk(copp: Any, grid: Array, rounds: int, joints: Any, limits: JointLimits) -> Timing | None:
    """Plan with copp-py under limits of jerk, which it linearizes in so many rounds."""
    second, third = copp.solver.topp2_ra, copp.solver.topp3_socp
    try:
        robot = copp_robot(copp, grid, joints, limits)
        squared = second.solve(second.Problem(robot.constraints, (0, len(grid) - 1), (0.0, 0.0)))
        acceleration = None
        for _ in range(rounds):
            profile = third.solve(third.Problem(robot.constraints, squared, b_linearization=acceleration))
            squared, acceleration = profile.a, profile.b
        duration, arrivals = copp.interpolation.s_to_t_topp3(grid, profile)
    except copp.CoppError:
        return None

    def at_times(t: Array) -> LineMotion:
        s = copp.interpolation.t_to_s_topp3_samples(grid, profile, arrivals, t)
        s = np.where(np.isfinite(s), s, grid[-1])  # nan at times that rounding puts after the end
        return LineMotion(t, s, *rates_between(grid, squared, profile.b, s))

    return Timing(float(duration), len(grid), at_times)


def rates_between(grid: Array, squared: Array, acceleration: Array, s: Array) -> tuple[Array, Array, Array]:
    """Return speed, acceleration and jerk at distances s (M,) of a motion that copp-py has planned at grid points.

    Between two points the path acceleration is linear in the distance. In the first and in the last interval, at whose
    outer ends the motion is at rest, the jerk is constant.

    Args:
        grid: Distances (N,) of the grid points.
        squared: Squared speeds at the grid points. Shape (N,).
        acceleration: Path accelerations at the grid points. Shape (N,).
        s: Distances at which to evaluate the motion.
    """
    steps = np.diff(grid)
    bends = np.diff(acceleration) / steps
    k = np.clip(np.searchsorted(grid, s, side="right") - 1, 0, len(steps) - 1)
    past = s - grid[k]
    x = np.maximum(squared[k] + past * (2 * acceleration[k] + past * bends[k]), 0.0)
    a, j = acceleration[k] + past * bends[k], bends[k] * np.sqrt(x)
    for interval, rest, node, sign in ((0, 0, 1, 1.0), (len(steps) - 1, -1, -2, -1.0)):
        # with s = j t^3 / 6 from rest, the squared speed is proportional to s^(4/3) and the acceleration to s^(1/3)
        inside, step = k == interval, steps[interval]
        root = np.cbrt(np.abs(s - grid[rest]) / step)
        x = np.where(inside, squared[node] * root**4, x)
        a = np.where(inside, sign * 2 / 3 * squared[node] / step * root, a)
        j = np.where(inside, 2 / 9 * squared[node] ** 1.5 / step**2, j)
    return np.sqrt(x), a, j


def graded(even: Array) -> Array:
    """Return grid points from 0 to 1 that are denser at both ends, from evenly spaced ones.

    A share of the spacing is even; the rest is that of a smooth motion from rest to rest.
    """
    return np.asarray(EVEN_SHARE * even + (1 - EVEN_SHARE) * even**3 * (10 + even * (6 * even - 15)))


def timing_of_speeds(grid: Array, speed: Array) -> Timing:
    """Return the timing with given speeds at grid points and constant path acceleration between them."""
    steps = 2 * np.diff(grid) / (speed[1:] + speed[:-1])
    arrivals, acceleration = np.append(0.0, np.cumsum(steps)), np.diff(speed) / steps

    def at_times(t: Array) -> LineMotion:
        k = np.clip(np.searchsorted(arrivals, t, side="right") - 1, 0, len(steps) - 1)
        past = t - arrivals[k]
        s = grid[k] + past * (speed[k] + past * acceleration[k] / 2)
        return LineMotion(t, s, speed[k] + past * acceleration[k], acceleration[k], np.zeros_like(t))

    return Timing(float(arrivals[-1]), len(grid), at_times)
