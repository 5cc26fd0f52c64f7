"""How fast schedules are made: a Panda under limits of all kinds, long paths, random arms, and toppra beside them.

Memory is the peak of a process of its own, with what Python, the packages and the path take. The reference of the
random arms is the package's own optimal control problem, which takes some 15 s an arm: two processes share them.
"""

from __future__ import annotations

import importlib
import multiprocessing
import resource
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, SmoothPath, paths, smooth
from models.checks import Array
from ocp import joint_path
from ocp.motion.builders.joint_spline import PlannedJoints
from ocp.motion.builders.timing import solve_minimum_time
from ocp.motion.schedule import JointLimits, LineLimits, Schedule, joint_motion, schedule
from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.robots.panda import HOME
from scripts.robots.robots import PANDA
from scripts.timing.blend import random_task
from scripts.timing.measure import least, timed

LOW, HIGH = np.array([0.35, -0.2, 0.2]), np.array([0.55, 0.2, 0.45])
"""Corners of the box in front of the Panda that its path stays in, m."""
STEPS = (5e-3, 30e-3)  # m, shortest and longest line
SAMPLES = 10  # of the joints, a line
JOINTS = JointLimits(
    velocity=[2.175] * 4 + [2.61] * 3,
    acceleration=[15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
    jerk=[750.0, 375.0, 500.0, 625.0, 750.0, 1000.0, 1000.0],
    torque=[87.0] * 4 + [12.0] * 3,
)
"""Of the Panda: those of its maker, jerks a tenth of them."""
CASES = {
    "Panda, joint limits of all kinds": ((300, 1.0, None), (10_000, 30.0, 500.0)),
    "limits of the line and centripetal": ((10_000, None, None), (169_000, 20.0, 1500.0)),
}
"""Segments and goals of time (s) and memory (MB), by the case."""
ARMS, WORKERS = 50, 2
LONGER = (0.02, 0.05)
"""Goals of the arms: time over the reference's, less one, in the median and at worst."""


def run(repeats: int = 5, *, arms: int = ARMS, most: int = 200_000) -> dict[str, Any]:
    """All figures, of paths of at most so many segments and of so many arms.

    Returns:
        "rows": seconds and memory by case. "arms": time beside the reference's by seed. "toppra": time beside
        toppra's without a jerk limit, by seed; empty where it is not installed. "goals": of the arms.
    """
    sizes = [(case, size) for case, all_sizes in CASES.items() for size in all_sizes if size[0] <= most]
    spawned: dict[str, Any] = {"mp_context": multiprocessing.get_context("spawn"), "max_tasks_per_child": 1}
    with ProcessPoolExecutor(1, **spawned) as pool:
        rows = [
            pool.submit(row, case, segments, repeats).result() | {"goal_s": seconds, "goal_MB": memory}
            for case, (segments, seconds, memory) in progress(sizes, "schedules")
        ]
    with ProcessPoolExecutor(WORKERS, mp_context=spawned["mp_context"]) as pool:
        longer = list(progress(pool.map(arm_row, range(arms)), "random arms", total=arms))
    return {
        "rows": rows,
        "arms": longer,
        "toppra": [one for seed in range(min(arms, 10)) if (one := peer_row(seed)) is not None],
        "goals": {"median": LONGER[0], "worst": LONGER[1]},
    }


def row(case: str, segments: int, repeats: int) -> dict[str, Any]:
    """One schedule in this process."""
    runs = max(1, min(repeats, 1000 // segments))
    if case.startswith("Panda"):
        path, joints = panda_path(segments)
        limits = LineLimits(0.5, 5.0, 200.0, 5.0, JOINTS)
        plan, seconds = timed(lambda: schedule(path, limits, joints=joints))
        if runs > 1:
            seconds = least(lambda: schedule(path, limits, joints=joints), runs)
    else:
        path, limits = smooth(random_task(segments), deviation=2e-4), LineLimits(0.2, 5.0, 200.0, 5.0)
        plan, seconds = timed(lambda: schedule(path, limits))
    return {
        "case": case,
        "segments": segments,
        "seconds": seconds,
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "duration_s": plan.duration,
        "pieces": len(plan.profile.jerk),
    }


def panda_path(segments: int, seed: int = 1) -> tuple[SmoothPath, PlannedJoints]:
    """Random lines in front of a Panda with corners rounded to 1 mm, and its joints by damped steps along them."""
    rng, points = np.random.default_rng(seed), [np.array([0.45, 0.0, 0.3])]
    while len(points) <= segments:
        step = rng.normal(size=3)
        place = points[-1] + step * rng.uniform(*STEPS) / np.linalg.norm(step)
        if ((place > LOW) & (place < HIGH)).all():
            points.append(place)
    machine, path = FixedBase(PANDA.read()), smooth(paths.Path.through(points), deviation=1e-3)
    s = np.linspace(0.0, path.length, SAMPLES * segments)
    goals = path.at(s).position
    q, goal = ca.SX.sym("q", 7), ca.SX.sym("goal", 3)
    place = machine.tip_pose((), q).position
    slope = ca.jacobian(place, q)
    change = slope.T @ ca.solve(slope @ slope.T + 1e-6 * ca.SX.eye(3), goal - place)
    step = ca.Function("step", [q, goal], [q + change])
    start = ca.DM(HOME)
    for _ in range(50):
        start = step(start, goals[0])
    return path, joint_path(machine, (s, np.array(step.mapaccum(len(s))(start, goals.T)).T), path)


# ---- random arms ---------------------------------------------------------------------------------------------


class Along:
    """Joints at the distances of a path: waves.

    Attributes:
        names: Of the joints.
    """

    def __init__(self, names: tuple[str, ...], size: Array, wave: Array, phase: Array) -> None:
        self.names, self.size, self.wave, self.phase = names, size, wave, phase

    def at(self, distance: Any) -> Any:
        """Joints and three derivatives. Shape (M, n) each."""
        angle = np.asarray(distance, dtype=float)[:, None] * self.wave + self.phase
        kinds = ("position", "first", "second", "third")
        values = [self.size * self.wave**k * np.sin(angle + k * np.pi / 2) for k in range(len(kinds))]
        return type("Rates", (), dict(zip(kinds, values, strict=True)))


def random_arm(seed: int) -> tuple[SmoothPath, Along, LineLimits]:
    """Two to seven joints that swing along some lines, and limits of velocity, acceleration and jerk."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 8))
    points = np.cumsum(rng.uniform(0.1, 0.5, (int(rng.integers(2, 7)), 1)) * rng.normal(size=(1, 3)), axis=0)
    points += 0.1 * rng.normal(size=points.shape)
    path = smooth(paths.Path.through(points), deviation=0.01)
    wave = 2 * np.pi * rng.uniform(0.3, 4.0, count) / path.length
    names = tuple(f"joint{k}" for k in range(count))
    size, phase = rng.uniform(0.3, 1.5, count), rng.uniform(0.0, 6.0, count)
    bounds = JointLimits(*(10 ** rng.uniform(*span, count) for span in ((-0.3, 0.5), (0.3, 1.3), (1.3, 2.5))))
    speed, acceleration = 10 ** rng.uniform(-0.5, 0.5), 10 ** rng.uniform(0.0, 1.0)
    limits = LineLimits(speed, acceleration, 200.0, joints=bounds)
    return path, Along(names, size, wave, phase), limits


def largest(plan: Schedule, joints: Along) -> float:
    """Largest demand of a joint over its limit, between the nodes too."""
    moved = joint_motion(joints, plan.at(np.linspace(0.0, plan.duration, 50_001)))[1:]
    bounds = plan.limits.of_joints(len(joints.names))
    return max(float(np.max(np.abs(value) / bound)) for value, bound in zip(moved, bounds, strict=True))


def arm_row(seed: int) -> dict[str, Any]:
    """The schedule of a random arm beside the least time that optimal control finds."""
    path, joints, limits = random_arm(seed)
    plan, seconds = timed(lambda: schedule(path, limits, joints=joints))
    best = solve_minimum_time(path, limits, joints, guess=plan, intervals=60, rounds=0)
    longer = plan.duration / best.duration - 1
    return {"seed": seed, "joints": len(joints.names), "seconds": seconds, "longer": longer} | {
        "largest_demand": largest(plan, joints)
    }


def peer_row(seed: int) -> dict[str, Any] | None:
    """The schedule of a random arm without limits of jerk beside toppra's; None where that is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            toppra, constraint, algorithm = (
                importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
            )
    except ImportError:
        return None
    toppra.setup_logging("ERROR")
    path, joints, limits = random_arm(seed)
    assert limits.joints is not None
    bounds = JointLimits(limits.joints.velocity, limits.joints.acceleration)
    free = LineLimits(100.0, 1000.0, np.inf, joints=bounds)
    plan, seconds = timed(lambda: schedule(path, free, joints=joints))
    s = np.linspace(0.0, path.length, 1000)
    both = np.array([[-1.0, 1.0]])
    velocity, acceleration = (np.asarray(each)[:, None] * both for each in (bounds.velocity, bounds.acceleration))

    def planned() -> Any:
        curve = toppra.SplineInterpolator(s, joints.at(s).position)
        limited = [constraint.JointVelocityConstraint(velocity), constraint.JointAccelerationConstraint(acceleration)]
        return algorithm.TOPPRA(limited, curve, gridpoints=s).compute_trajectory(0, 0)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        motion, peer_seconds = timed(planned)
        rates = np.abs(motion(np.linspace(0.0, motion.duration, 50_001), 2)).max(axis=0)
    return {
        "seed": seed,
        "seconds": seconds,
        "toppra_s": peer_seconds,
        "longer": float(plan.duration / motion.duration - 1),
        "largest_demand": largest(plan, joints),
        "toppra_acceleration_over_limit": float((rates / acceleration[:, 1]).max()),
    }


# ---- the page ------------------------------------------------------------------------------------------------


def report(numbers: dict[str, Any]) -> str:
    """The times, and what is longer than it need be."""
    lines = [text_table(numbers["rows"], 4)]
    longer = np.array([one["longer"] for one in numbers["arms"]])
    if longer.size:
        demand = max(one["largest_demand"] for one in numbers["arms"])
        lines.append(
            f"{longer.size} random arms: {np.median(longer):+.3%} in the median, {longer.max():+.3%} at worst, beside "
            f"optimal control (goals {LONGER[0]:.0%} and {LONGER[1]:.0%}); largest demand {demand:.4f} of a limit"
        )
    if numbers["toppra"]:
        lines.append(text_table(numbers["toppra"], 4))
    return "\n\n".join(lines)


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Seconds a thousand segments with the goals, and how much longer the arms take."""
    note = (
        f"Left: one run on one machine, ticks the goals. Right: schedules of {len(numbers['arms'])} random arms beside "
        "the package's own minimum-time problem; less than none is faster."
    )
    with drawing.sheet(path, (1, 2), (9.0, 3.2), note) as (_, axes):
        left, right = np.ravel(axes)
        names = [f"{one['case'].split(',')[0]}, {one['segments']}" for one in numbers["rows"]]
        times = [1e3 * one["seconds"] / one["segments"] for one in numbers["rows"]]
        left.barh(names, times, color=drawing.COLORS["blue"])
        for place, one in enumerate(numbers["rows"]):
            if one["goal_s"]:
                left.plot([1e3 * one["goal_s"] / one["segments"]] * 2, [place - 0.4, place + 0.4], color="black", lw=1)
        left.set(xlabel="time a segment, ms")
        right.plot(100 * np.sort([one["longer"] for one in numbers["arms"]]), marker=".", color=drawing.COLORS["green"])
        right.set(xlabel="random arm, in order", ylabel="longer, %")
