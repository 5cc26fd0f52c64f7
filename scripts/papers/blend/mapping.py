"""From distance to curve parameter: the errors of the paper's mapping and of the default one."""

from __future__ import annotations

from typing import Any

import numpy as np

from models import SmoothPath
from models.checks import Array
from models.paths import Blend, gauss_newton, march, predictor_corrector
from models.paths.blends import BlendKind, arc_length, polynomial
from ocp.motion.schedule import Schedule, SpeedProfile
from scripts.papers.blend.example import MM, PERIOD, SHAPE, SPEED, corner
from scripts.papers.run import Row

PERIODS = (1e-3, 2e-3, 4e-3)  # s
DISTANCES = tuple(MM * d for d in (5, 10, 20, 50, 100, 150))
DEGREE: dict[BlendKind, int] = {"cubic": 3, "quintic": 5}


def mappings(kind: BlendKind) -> tuple[Any, Any]:
    """The paper's and the default one, for blends of a kind."""
    return predictor_corrector(DEGREE[kind]), gauss_newton(DEGREE[kind])


def mapping_errors(blend: Blend, distances: Array, period: float, mapping: Any) -> dict[str, float]:
    """Errors of a mapping over the samples in a blend, at `distances` (m) from its start; mm/s and um.

    Drift: arc length reached over that asked, at the last sample. Speed errors, over every period from the blend's
    start: of the arc length and of the chord (what differences of positions show), over the planned one; the largest,
    with its sign.
    """
    u = np.concatenate([[0.0], march(mapping, blend.coefficients, distances)])
    distances = np.concatenate([[0.0], distances])
    along = arc_length(blend.coefficients, u)
    points = polynomial(np.repeat(blend.coefficients[None], len(u), axis=0), u)
    planned = np.diff(distances)
    true = (np.diff(along) - planned) / period / MM
    chord = (np.linalg.norm(np.diff(points, axis=0), axis=1) - planned) / period / MM
    return {
        "drift_um": float(along[-1] - distances[-1]) * 1e6,
        "true_speed_error_mm_s": float(true[np.abs(true).argmax()]),
        "chord_speed_error_mm_s": float(chord[np.abs(chord).argmax()]),
    }


def samples_in(blend: Blend, profile: SpeedProfile, period: float) -> Array:
    """Distances from a blend's start of the control instants inside it. Shape (M,), m."""
    time_samples = np.arange(int(profile.duration / period) + 1) * period
    along = profile.at(time_samples).distance - blend.start
    # the first sample at the very start would be a step of rounding size
    return np.asarray(along[(along > 1e-12) & (along < blend.length)])


def mapping_table(path: SmoothPath, profile: SpeedProfile) -> list[Row]:
    """Both mappings on both blends of the example, in its own time schedule."""
    rows: list[Row] = []
    for period in PERIODS:
        for mapping in mappings(path.kind):
            for vertex, name in enumerate(("line-line", "line-arc")):
                blend = path.blend(vertex)
                errors = mapping_errors(blend, samples_in(blend, profile, period), period, mapping)
                rows.append({"mapping": mapping.name(), "blend": name, "period_ms": period / 1e-3, **errors})
    return rows


def small_blend_table() -> list[Row]:
    """Both mappings on 90 deg corners of many sizes at 1000 mm/s, the first sample one period past the blend's start.

    On cubic and quintic blends of the example's shapes.
    """
    rows: list[Row] = []
    for kind in DEGREE:
        for remaining in DISTANCES:
            blend = corner(90, remaining, SHAPE[kind], kind).blend(0)
            for period in PERIODS:
                count = int(blend.length / (SPEED * period))
                if count < 2:
                    continue
                distances = np.arange(1, count + 1, dtype=np.float64) * (SPEED * period)
                for mapping in mappings(kind):
                    rows.append(
                        {
                            "blend": kind,
                            "mapping": mapping.name(),
                            "remaining_mm": remaining / MM,
                            "period_ms": period / 1e-3,
                            "samples": count,
                            **mapping_errors(blend, distances, period, mapping),
                        }
                    )
    return rows


def speed_errors(path: SmoothPath, plan: Schedule, period: float = PERIOD) -> tuple[Array, dict[str, Array]]:
    """What differences of positions show of both mappings over a whole schedule.

    Returns:
        The end of each period, shape (M,), s; and by mapping the chord over the period less the planned speed, (M,),
        mm/s. Blends are marched through as a controller does, segments are exact: a drift ends in one wrong step at
        the blend's end.
    """
    motion = plan.sample(period)
    planned = np.diff(motion.distance)
    errors: dict[str, Array] = {}
    for mapping in mappings(path.kind):
        points = path.at(motion.distance).position
        for vertex in range(len(path.remaining)):
            blend = path.blend(vertex)
            along = motion.distance - blend.start
            inside = np.flatnonzero((along > 1e-12) & (along < blend.length))
            if inside.size:
                u = march(mapping, blend.coefficients, along[inside])
                points[inside] = polynomial(np.repeat(blend.coefficients[None], len(u), axis=0), u)
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        errors[mapping.name()] = (chords - planned) / np.diff(motion.t) / MM
    return motion.t[1:], errors
