"""Computation time of schedules: a Panda under all kinds of limits, long paths, random arms, and toppra and copp-py.

The memory of a case is the peak of a separate process, which includes Python, the packages and the path. Schedules of
random arms are compared with the package's own optimal control problem, which takes about 15 s for each arm; two
processes share this work. Schedules of random splines of seven joints are compared with toppra and copp-py, one after
the other in one process.
"""

from __future__ import annotations

import multiprocessing
import resource
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
"""Corners of the box in front of the Panda that contains its path, m."""
STEPS = (5e-3, 30e-3)  # m, shortest and longest line
SAMPLES = 10  # number of joint samples per line
JOINTS = JointLimits(
    velocity=[2.175] * 4 + [2.61] * 3,
    acceleration=[15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
    jerk=[750.0, 375.0, 500.0, 625.0, 750.0, 1000.0, 1000.0],
    torque=[87.0] * 4 + [12.0] * 3,
)
"""Limits of the Panda: those of its manufacturer, except the jerk limits, which are a tenth of them."""
CASES = {
    "Panda, joint limits of all kinds": ((300, 1.0, None), (10_000, 30.0, 500.0)),
    "limits of the line and centripetal": ((10_000, None, None), (169_000, 20.0, 1500.0)),
}
"""Numbers of segments with the goals of time (s) and memory (MB), by the case."""
ARMS, WORKERS = 50, 2
LONGER = (0.02, 0.05)
"""Goals of the random arms: largest relative excess of the duration over the reference, median and worst."""
SPLINES = 50
CHECKS = 50_001
"""Number of times at which the limits of a motion are checked."""


def run(repeats: int = 5, *, arms: int = ARMS, most: int = 200_000, splines: int = SPLINES) -> dict[str, Any]:
    """Measure all cases of at most `most` segments, and the given numbers of random arms and random splines.

    Returns:
        "rows": seconds and memory by case. "arms": comparison with optimal control by seed. "peers": comparison with
        toppra and copp-py by kind of limits and tool, empty without copp-py. "goals": those of the random arms.
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
    from scripts.timing.schedule_peers import compare_peers  # which imports this module

    return {
        "rows": rows,
        "arms": longer,
        "peers": compare_peers(splines),
        "goals": {"median": LONGER[0], "worst": LONGER[1]},
    }


def row(case: str, segments: int, repeats: int) -> dict[str, Any]:
    """Measure one schedule in this process."""
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
    """Return random lines in front of a Panda, with corners rounded within 1 mm, and its joints along them.

    The joints follow by damped steps of inverse kinematics.
    """
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
    """Joints that follow sine waves of the distance along a path.

    Attributes:
        names: Names of the joints.
    """

    def __init__(self, names: tuple[str, ...], size: Array, wave: Array, phase: Array) -> None:
        self.names, self.size, self.wave, self.phase = names, size, wave, phase

    def at(self, distance: Any) -> Any:
        """Return joint positions and their first three derivatives by the distance. Shape (M, n) each."""
        angle = np.asarray(distance, dtype=float)[:, None] * self.wave + self.phase
        kinds = ("position", "first", "second", "third")
        values = [self.size * self.wave**k * np.sin(angle + k * np.pi / 2) for k in range(len(kinds))]
        return type("Rates", (), dict(zip(kinds, values, strict=True)))


def random_arm(seed: int) -> tuple[SmoothPath, Along, LineLimits]:
    """Return a path of some lines, two to seven joints that swing along it, and limits of velocity to jerk."""
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


def largest(plan: Schedule, joints: Any) -> float:
    """Return the largest usage of a joint limit by a schedule: 1 is the limit."""
    return usage(plan, joints, plan.limits.joints or JointLimits())


def usage(timing: Any, joints: Any, limits: JointLimits) -> float:
    """Return the largest ratio to its limit of a joint velocity, acceleration, jerk or torque at `CHECKS` times."""
    motion = timing.at(np.linspace(0.0, timing.duration, CHECKS))
    values = dict(zip(("velocity", "acceleration", "jerk"), joint_motion(joints, motion)[1:], strict=True))
    if np.isfinite(limits.torque).any():
        v, a, torques = motion.speed[:, None], motion.acceleration[:, None], joints.torques(motion.distance)
        values["torque"] = torques.inertia * a + torques.drag * v**2 + torques.rest
    return max(float(np.max(np.abs(value) / getattr(limits, kind))) for kind, value in values.items())


def arm_row(seed: int) -> dict[str, Any]:
    """Compare the schedule of a random arm with the least time found by optimal control."""
    path, joints, limits = random_arm(seed)
    plan, seconds = timed(lambda: schedule(path, limits, joints=joints))
    best = solve_minimum_time(path, limits, joints, guess=plan, intervals=60, rounds=0)
    longer = plan.duration / best.duration - 1
    return {"seed": seed, "joints": len(joints.names), "seconds": seconds, "longer": longer} | {
        "largest_demand": largest(plan, joints)
    }


# ---- the page ------------------------------------------------------------------------------------------------


def report(numbers: dict[str, Any]) -> str:
    """Return tables of the times and a sentence on the durations of the random arms."""
    lines = [text_table(numbers["rows"], 4)]
    longer = np.array([one["longer"] for one in numbers["arms"]])
    if longer.size:
        demand = max(one["largest_demand"] for one in numbers["arms"])
        lines.append(
            f"{longer.size} random arms: {np.median(longer):+.3%} in the median, {longer.max():+.3%} at worst, beside "
            f"optimal control (goals {LONGER[0]:.0%} and {LONGER[1]:.0%}); largest demand {demand:.4f} of a limit"
        )
    if numbers["peers"]:
        lines.append(text_table(numbers["peers"], 4))
    return "\n\n".join(lines)


def plot(path: Path, numbers: dict[str, Any]) -> None:
    """Draw the time per segment with the goals, and the relative excess of the duration of the random arms."""
    note = (
        f"Left: one run on one machine; the ticks are the goals. Right: {len(numbers['arms'])} random arms, schedules "
        "compared with the package's own minimum-time problem; negative values are faster."
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
