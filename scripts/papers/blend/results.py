"""Everything that scripts/blend.py writes and draws about the example of Lee, Ryu, Cheong 2006."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from models import SmoothPath, scara_along, smooth
from models.checks import Array
from models.machines.scara import ScaraPath
from models.paths import gamma
from models.paths.blends import BlendKind, polynomial
from ocp.motion.builders.timing import FastestMotion, solve_minimum_time
from ocp.motion.schedule import LineLimits, Schedule, peak_acceleration, schedule
from scripts.papers.blend.example import (
    ARM,
    CENTRIPETAL,
    ELBOW,
    JERK,
    JOINT_LIMITS,
    MEAN_ACCELERATION,
    MM,
    PAPER_GAMMA,
    REMAINING,
    SHAPE,
    SPEED,
    corner,
    example,
)
from scripts.papers.blend.mapping import mapping_table, small_blend_table, speed_errors
from scripts.papers.run import Row


@dataclass(frozen=True)
class Plan:
    """One path under some limits.

    Attributes:
        path: The example, with either blend.
        joints: The arm along it.
        schedule: The path's own schedule under the limits.
        fastest: The minimum time under the same limits, by optimal control.
    """

    path: SmoothPath
    joints: ScaraPath
    schedule: Schedule
    fastest: FastestMotion


@dataclass(frozen=True)
class Results:
    """Everything computed for the paper.

    Attributes:
        cubic, quintic: The example with either blend.
        mean, peak: Schedule of the cubic, 5000 mm/s^2 being the mean or the peak acceleration of a ramp.
        joints: The arm along the cubic path.
        gamma_table, mappings, small_blends: Rows of tables.
        speed_error_times, speed_errors: What 2 ms differences of positions show of each mapping. Shape (M,), s, mm/s.
        plans: The paths under more and more limits, by name.
    """

    cubic: SmoothPath
    quintic: SmoothPath
    mean: Schedule
    peak: Schedule
    joints: ScaraPath
    gamma_table: list[Row]
    mappings: list[Row]
    small_blends: list[Row]
    speed_error_times: Array
    speed_errors: dict[str, Array]
    plans: dict[str, Plan]


def compute() -> Results:
    """All of it, in under ten seconds."""
    kinds: tuple[BlendKind, ...] = ("cubic", "quintic")
    cubic, quintic = (smooth(example(), REMAINING, kind=kind, shape=SHAPE[kind]) for kind in kinds)
    acceleration = peak_acceleration(MEAN_ACCELERATION, SPEED, JERK)
    mean = schedule(cubic, LineLimits(SPEED, acceleration, JERK))
    peak = schedule(cubic, LineLimits(SPEED, MEAN_ACCELERATION, JERK))
    along, along_quintic = scara_along(ARM, cubic, ELBOW), scara_along(ARM, quintic, ELBOW)
    line = LineLimits(SPEED, acceleration, JERK)
    perturbed = LineLimits(SPEED, acceleration, JERK, CENTRIPETAL)
    whole = LineLimits(SPEED, acceleration, JERK, CENTRIPETAL, JOINT_LIMITS)
    cases = {
        "cubic, line speed": (cubic, along, line),
        "cubic, + centripetal": (cubic, along, perturbed),
        "quintic, line speed": (quintic, along_quintic, line),
        "quintic, + centripetal": (quintic, along_quintic, perturbed),
        "quintic, + joints": (quintic, along_quintic, whole),
    }
    plans = {}
    bar = tqdm(cases.items(), disable=None)
    for name, (path, joints, limits) in bar:
        bar.set_description(f"minimum time, {name}")
        plan = schedule(path, limits, joints=joints)
        plans[name] = Plan(path, joints, plan, solve_minimum_time(path, limits, joints, guess=plan))
    return Results(
        cubic,
        quintic,
        mean,
        peak,
        along,
        gamma_table(),
        mapping_table(cubic, mean.profile),
        small_blend_table(),
        *speed_errors(cubic, mean),
        plans,
    )


def measured_gamma(path: SmoothPath) -> float:
    """Distance vertex to curve over the remaining distance, from the curve itself."""
    points = polynomial(path.coefficients[:1], np.linspace(0, 1, 2001))
    return float(np.linalg.norm(points, axis=1).min() / path.remaining[0])


def gamma_table() -> list[Row]:
    """Table 2: closed form, measured on the curve, printed."""
    rows: list[Row] = []
    for remaining, printed in PAPER_GAMMA.items():
        cases = (
            ("constant_30_90deg", 30 / remaining, 90.0),
            ("shape_1_90deg", 1.0, 90.0),
            ("shape_1_45deg", 1.0, 45.0),
        )
        row: dict[str, Any] = {"remaining_mm": remaining}
        for (name, shape, degrees), paper in zip(cases, printed, strict=True):
            row[name] = gamma(shape, np.radians(degrees))
            row[f"{name}_measured"] = measured_gamma(corner(degrees, remaining * MM, shape))
            row[f"{name}_paper"] = paper
            row[f"{name}_difference"] = row[name] - paper
        rows.append(row)
    return rows


def exit_steps(results: Results, mapping: str = "predictor_corrector") -> list[float]:
    """Speed error of the period in which each blend of the example ends: its drift is made good there, mm/s."""
    ends = results.mean.time_at(results.cubic.bounds[[2, 4]])
    after = np.searchsorted(results.speed_error_times, ends)
    return [float(error) for error in results.speed_errors[mapping][after]]


def required_centripetal(path: SmoothPath) -> list[float]:
    """Largest centripetal acceleration of each blend at the asked speed, m/s^2."""
    peaks = []
    for vertex in range(len(path.remaining)):
        blend = path.blend(vertex)
        s = np.linspace(blend.start, blend.end, 4001)
        peaks.append(float(path.curvature(s).max()) * SPEED**2)
    return peaks
