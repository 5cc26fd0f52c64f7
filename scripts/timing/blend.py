"""How fast a smooth path is planned and followed: samples in compiled C, mapped and by other means; long paths."""

from __future__ import annotations

import importlib
import time
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models import SmoothPath, paths, scara_along, smooth
from models.checks import Array
from models.paths import gauss_newton, march, path_function, predictor_corrector
from models.paths.blends import arc_length, speed
from ocp.motion.builders.timing import solve_minimum_time
from ocp.motion.schedule import LineLimits, Schedule, peak_acceleration, schedule
from scripts import drawing
from scripts.papers.blend.example import (
    ARM,
    CENTRIPETAL,
    ELBOW,
    JERK,
    JOINT_LIMITS,
    MEAN_ACCELERATION,
    REMAINING,
    SPEED,
    example,
)
from scripts.papers.run import text_table
from scripts.timing.measure import against, compiled, has_compiler, least

PERIOD = 1e-3  # s
SEED = 5
TABLE = 1000  # entries of the lookup
TARGET_NS, TARGET_PLAN_MS, TARGET_SCALE_S = 200.0, 20.0, 10.0
DEFAULT = "gauss_newton, cubic, compiled"
"""The row that the first target is for: the paper's example and the default mapping."""
STEPS = (1e-3, 1e-2)  # m, shortest and longest segment of the random task
GRID = 400
ACCELERATIONS = (5.0, 30.0)  # m/s^2, of each axis, for toppra
TASK_SPEED, TASK_ACCELERATION, TASK_DEVIATION = 0.2, 5.0, 2e-4


def run(repeats: int = 5, *, segments: Sequence[int] = (1000, 10_000)) -> dict[str, Any]:
    """All times of one run on one machine.

    Returns:
        "rows": ns a sample and worst error of the distance (um), by method. "planning": ms. "scale": s, by number of
        segments. "toppra": times and speeds, or "not installed". "profiles": speeds (m/s) over distances (m), by
        planner. "targets": each with its figure.
    """
    cubic, quintic = (smooth(example(), REMAINING, kind=kind) for kind in ("cubic", "quintic"))
    limits = LineLimits(SPEED, peak_acceleration(MEAN_ACCELERATION, SPEED, JERK), JERK)
    plan = schedule(cubic, limits)
    rows = [row for path in (cubic, quintic) for row in samples(path, schedule(path, limits), repeats)]
    planned = planning(limits, repeats)
    scale = [long_path(count) for count in segments]
    peer = peer_plans(cubic, repeats)
    s = np.linspace(0, cubic.length, 801)
    profiles = {"ours": {"distance": s, "speed": plan.profile.at_distance(s).speed}}
    profiles |= peer.pop("profiles") if peer else {}
    compiled = next((row["ns_per_sample"] for row in rows if row["method"] == DEFAULT), None)
    targets = {
        "compiled_default_ns": {"figure": compiled, "target": TARGET_NS},
        "planning_example_ms": {"figure": planned[0]["ms"], "target": TARGET_PLAN_MS},
        "largest_scale_s": {"figure": scale[-1]["total_s"], "target": TARGET_SCALE_S, "segments": segments[-1]},
    }
    return {
        "rows": rows,
        "planning": planned,
        "scale": scale,
        "toppra": peer or "not installed",
        "profiles": profiles,
        "targets": targets,
    }


# ---- samples -------------------------------------------------------------------------------------------------


def samples(path: SmoothPath, plan: Schedule, repeats: int) -> list[dict[str, Any]]:
    """From distance to parameter, by every method, at the control instants inside the first blend of the example."""
    blend = path.blend(0)
    time_samples = np.arange(int(plan.duration / PERIOD) + 1) * PERIOD
    along = plan.at(time_samples).distance
    s = along[(along > blend.start + 1e-12) & (along < blend.end)]
    x, count = s - blend.start, len(s)
    loops, runs = max(1, 10_000 // count), 20 * repeats  # many short runs: nothing else disturbs the least of them
    rows: list[dict[str, Any]] = []

    def add(method: str, how: str, nanoseconds: float, u: Array) -> None:
        error = float(np.abs(arc_length(blend.coefficients, u) - x).max()) * 1e6
        rows.append(_row(method, path.kind, how, nanoseconds, error))

    for make in (predictor_corrector, gauss_newton):
        mapping = make(3 if path.kind == "cubic" else 5)
        name = mapping.name()
        if has_compiler():
            # what march does, each sample from the one before, in one loop of C
            with compiled(mapping, marching=True) as called:
                inputs = [np.zeros((1, 2)), entries(mapping, blend.coefficients)[None], increments(x)]
                states, seconds = called(inputs, loops, runs)
            add(name, "compiled", 1e9 * seconds, states[:, 1])
        u = march(mapping, blend.coefficients, x)
        inputs = mapped_inputs(mapping, blend.coefficients, x, u)
        many = mapping.map(count)
        result = np.array(many.call(inputs)[0])[1]
        add(name, "map", 1e9 * least(lambda many=many, inputs=inputs: many.call(inputs), repeats) / count, result)  # type: ignore[misc]
        add(name, "march", 1e9 * least(lambda m=mapping: march(m, blend.coefficients, x), repeats) / count, u)  # type: ignore[misc]
    if has_compiler():
        with compiled(path_function(path)) as called:
            places, seconds = called([s[:, None]], loops, runs)
        error = float(np.linalg.norm(places[:, :3] - path.at(s).position, axis=1).max()) * 1e6
        rows.append(_row("path_function", path.kind, "compiled", 1e9 * seconds, error))
    add("SmoothPath.parameter", "numpy", 1e9 * least(lambda: path.parameter(s), repeats) / count, path.parameter(s))
    knots = np.linspace(0, 1, TABLE)
    table = arc_length(blend.coefficients, knots)
    interpolated = np.interp(x, table, knots)
    add("table lookup", "numpy", 1e9 * least(lambda: np.interp(x, table, knots), repeats) / count, interpolated)
    root = roots(blend.coefficients)
    if root is not None:
        result = np.array([root(value) for value in x])
        add("brentq", "scipy", 1e9 * least(lambda: [root(value) for value in x], max(1, repeats // 2)) / count, result)
    return rows


def _row(method: str, kind: str, how: str, nanoseconds: float, error: float) -> dict[str, Any]:
    return {"method": f"{method}, {kind}, {how}", "ns_per_sample": nanoseconds, "worst_error_um": error}


def increments(x: Array) -> Array:
    """From distances, shape (M,), m, to the last and the next step to each of them. Shape (M, 2), m."""
    options = np.diff(x, prepend=0.0)
    return np.stack([np.concatenate([[0.0], options[:-1]]), options], axis=1)


def entries(mapping: Any, coefficients: Array) -> Array:
    """As many coefficients of a blend as the mapping takes. Shape (n,)."""
    return coefficients.ravel()[: mapping.numel_in(1)]


def mapped_inputs(mapping: Any, coefficients: Array, x: Array, u: Array) -> list[Any]:
    """What the mapping sees at every sample, side by side."""
    before = np.concatenate([[0.0, 0.0], u])
    constant = np.repeat(entries(mapping, coefficients)[:, None], len(x), axis=1)
    return [ca.DM(np.stack([before[:-2], before[1:-1]])), ca.DM(constant), ca.DM(increments(x).T)]


# ---- plans ---------------------------------------------------------------------------------------------------


def planning(limits: LineLimits, repeats: int) -> list[dict[str, Any]]:
    """From segments to a schedule, and under more limits than the paper's; minimum time beside it."""
    more = LineLimits(limits.speed, limits.acceleration, limits.jerk, CENTRIPETAL)
    all_of_them = LineLimits(limits.speed, limits.acceleration, limits.jerk, CENTRIPETAL, JOINT_LIMITS)

    def limited() -> tuple[SmoothPath, Any, Schedule]:
        path = smooth(example(), REMAINING)
        arm = scara_along(ARM, path, ELBOW)
        return path, arm, schedule(path, all_of_them, joints=arm)

    path, arm, plan = limited()
    works: dict[str, Callable[[], Any]] = {
        "the paper's example: blends and schedule": lambda: schedule(
            smooth(example(), REMAINING, kind="cubic"), limits
        ),
        "centripetal limit too": lambda: schedule(smooth(example(), REMAINING), more),
        "centripetal and joint limits, arm included": limited,
    }
    rows = [{"plan": name, "ms": 1e3 * least(work, repeats), "duration_s": 0.0} for name, work in works.items()]
    for row, result in zip(rows, (*(work() for work in list(works.values())[:2]), plan), strict=True):
        row["duration_s"] = result.duration
    best = solve_minimum_time(path, all_of_them, arm, guess=plan, intervals=100)
    seconds = best.solution.seconds["build"] + best.solution.seconds["solve"]
    name = "the same in minimum time, optimal control"
    return [*rows, {"plan": name, "ms": 1e3 * seconds, "duration_s": best.duration}]


# ---- long paths ----------------------------------------------------------------------------------------------


def random_task(segments: int, seed: int = SEED) -> paths.Path:
    """Random short lines, 1 to 10 mm each, in any direction."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(segments, 3))
    steps *= (rng.uniform(*STEPS, segments) / np.linalg.norm(steps, axis=1))[:, None]
    return paths.Path.through(np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


def long_path(segments: int) -> dict[str, Any]:
    """A random task blended, scheduled under a centripetal limit and sampled every ms; memory in a run of its own."""
    limits = LineLimits(TASK_SPEED, TASK_ACCELERATION, JERK, TASK_ACCELERATION)

    def work() -> tuple[list[float], Array, Schedule]:
        times = [time.perf_counter()]

        def lap() -> None:
            times.append(time.perf_counter())

        task = random_task(segments)
        lap()
        path = smooth(task, deviation=TASK_DEVIATION)
        lap()
        plan = schedule(path, limits)
        lap()
        motion = plan.sample(PERIOD)
        place = path.at(motion.distance)
        lap()
        return np.diff(times).tolist(), np.linalg.norm(np.diff(place.position, axis=0), axis=1) / PERIOD, plan

    (task_s, blend_s, schedule_s, sample_s), speeds, plan = work()
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {
        "segments": segments,
        "length_m": plan.path.length,
        "duration_s": plan.duration,
        "samples": len(speeds) + 1,
        "task_s": task_s,
        "blend_s": blend_s,
        "schedule_s": schedule_s,
        "sample_s": sample_s,
        "total_s": task_s + blend_s + schedule_s + sample_s,
        "peak_memory_kB_per_segment": peak / 1e3 / segments,
        "largest_chord_speed": float(speeds.max()),
    }


# ---- peers ---------------------------------------------------------------------------------------------------


def roots(coefficients: Array) -> Callable[[float], float] | None:
    """Distance -> parameter by scipy's brentq on a 20-point Gauss-Legendre length; None without scipy."""
    try:
        brentq = importlib.import_module("scipy.optimize").brentq
    except ImportError:
        return None
    points, weights = np.polynomial.legendre.leggauss(20)
    points, weights = (points + 1) / 2, weights / 2
    curves = np.repeat(coefficients[None], len(points), axis=0)

    def excess(u: float, distance: float) -> float:
        return u * float(weights @ speed(curves, u * points)) - distance

    return lambda distance: float(brentq(excess, 0.0, 1.0, args=(distance,), xtol=1e-14))


def peer_plans(path: SmoothPath, repeats: int) -> dict[str, Any] | None:
    """toppra on the same path, speed and acceleration of each axis limited. None where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            toppra, constraint, algorithm = (
                importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
            )
    except ImportError:
        return None
    toppra.setup_logging("ERROR")
    s = np.linspace(0, path.length, GRID)
    points, one = path.at(s).position, np.ones((3, 1))
    by_name: dict[str, Any] = {"version": version("toppra"), "grid_points": GRID, "plans": [], "profiles": {}}
    for acceleration in ACCELERATIONS:

        def planned(most: float = acceleration) -> Any:
            curve = toppra.SplineInterpolator(s, points)
            limits = [
                constraint.JointVelocityConstraint(SPEED * one * [-1, 1]),
                constraint.JointAccelerationConstraint(most * one * [-1, 1]),
            ]
            return algorithm.TOPPRA(limits, curve, gridpoints=s).compute_trajectory(0, 0)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            motion = planned()
            ms = 1e3 * least(planned, repeats)
            t = np.linspace(0, motion.duration, 20_001)
            position, velocity = motion(t), np.linalg.norm(motion(t, 1), axis=1)
            rate = np.abs(motion(t, 2)).max()
        passed = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
        inside = (passed > path.bounds[1]) & (passed < path.bounds[2])
        by_name["plans"].append(
            {
                "axis_acceleration": acceleration,
                "ms": ms,
                "duration_s": motion.duration,
                "least_speed_in_blend": velocity[inside].min(),
                "largest_speed": velocity.max(),
                "acceleration_over_limit": rate / acceleration,
            }
        )
        every = slice(None, None, 25)
        name = f"toppra, {acceleration:g} m/s² an axis"
        by_name["profiles"][name] = {"distance": passed[every], "speed": velocity[every]}
    return by_name


# ---- the page ------------------------------------------------------------------------------------------------


def report(summary: dict[str, Any]) -> str:
    """The times, and the figures beside their targets."""
    tables = [summary[part] for part in ("rows", "planning", "scale")]
    if isinstance(summary["toppra"], dict):
        tables.append(summary["toppra"]["plans"])
    return "\n\n".join([*(text_table(rows, 4) for rows in tables), against(summary["targets"], "target")])


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Time of a sample by every method, on a logarithmic axis, and the speed beside toppra's."""
    shown = [row for row in summary["rows"] if "cubic" in row["method"] or "compiled" in row["method"]]
    rows = sorted(shown, key=lambda row: -row["ns_per_sample"])
    note = (
        "Blue: compiled; light: not compiled; numbers: ns, and the worst error of the distance. Left: instants of 1 ms "
        "inside the first blend of the paper's example (line to line, Lr = 150 mm), one core, least of several runs of "
        f"one run. Right: the paper's example at 1 m/s; toppra with {GRID} grid points, speed and acceleration of each "
        "axis limited, no jerk limit."
    )
    exact = [row["ns_per_sample"] for row in rows if row["worst_error_um"] < 1e-3]
    title = "toppra slows down or overshoots on the blends"
    if exact:
        title = f"A position on the curve takes {min(exact):.0f} ns, exact to rounding; {title}"
    with drawing.sheet(path, (1, 2), (10.4, 5.4), note, title=title, width_ratios=(1.25, 1)) as (_, axes):
        ax = axes[0, 0]
        shades = ["blue" if "compiled" in row["method"] else "sky" for row in rows]
        drawing.dots(ax, [row["ns_per_sample"] for row in rows], [row["method"] for row in rows], shades)
        plain = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        for k, row in enumerate(rows):
            text = f"{row['ns_per_sample']:,.0f} ns, {row['worst_error_um']:.1g} µm"
            ax.text(row["ns_per_sample"] * 1.35, k, text, va="center", fontsize=7, bbox=plain)
        least_ns, most_ns = rows[-1]["ns_per_sample"], rows[0]["ns_per_sample"]
        ax.set_xlim(least_ns / 3, 300 * most_ns)
        ax.axvline(TARGET_NS, color=drawing.COLORS["orange"], ls="--", label=f"target of the default, {TARGET_NS:g} ns")
        ax.set(xlabel="time of one sample, ns", title="From arc length to position on the curve")
        ax.legend(loc="upper right")
        ax = axes[0, 1]
        ours = summary["profiles"]["ours"]
        ax.plot(ours["distance"], ours["speed"], label="selfmotion", zorder=3)
        others = [name for name in summary["profiles"] if name != "ours"]
        for name, dash in zip(others, drawing.DASHES[1:], strict=False):
            profile = summary["profiles"][name]
            ax.plot(profile["distance"], profile["speed"], ls=dash, label=name)
        ax.set(xlabel="distance along the path, m", ylabel="line speed, m/s", title="Speed on the same path")
        ax.set_ylim(0, 1.3)
        ax.legend(loc="lower center")
