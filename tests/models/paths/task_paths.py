"""Random task paths of lines and arcs, seeded, for tests of geometry and schedules."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import Arc, Helix, Line, ModelError, Path, Scara, scara_along, smooth
from models.machines.scara import ScaraPath
from models.paths import Segment
from models.paths.blends import cubic, curvature, quintic

Array = NDArray[np.float64]
seeds = st.integers(0, 2**32 - 1)


def turned(vector: Any) -> Array:
    """Unit quaternion of a rotation vector."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    return np.concatenate([[np.cos(angle / 2)], np.sinc(angle / 2 / np.pi) / 2 * v])


def product(p: Array, q: Array) -> Array:
    """Quaternion product."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], vector])


def random_path(
    rng: np.random.Generator, count: int, *, turns: bool = False, arcs: float = 0.5, helices: float = 0.0
) -> Path:
    """Segments of 30 to 300 mm, a share of them arcs in any plane up to a full circle; the tool turns if asked.

    Another share are helices of up to three turns, rising or falling by up to half their radius a turn.
    """
    segments: list[Segment] = []
    end, orientation = rng.normal(size=3), turned(rng.normal(size=3))
    while len(segments) < count:
        size = 0.3 * 10 ** rng.uniform(-1, 0)
        last = product(orientation, turned(rng.normal(size=3))) if turns else orientation
        ends = {"start_orientation": orientation, "end_orientation": last}
        across = np.cross(axis := rng.normal(size=3), rng.normal(size=3))
        choice = rng.random()
        try:
            segment: Segment
            if choice > 1 - helices:
                center = end + size * across / np.linalg.norm(across)
                sweep, pitch = rng.uniform(0.1, 3) * 2 * np.pi, rng.uniform(-0.5, 0.5) * size
                segment = Helix(end, center, axis, sweep, pitch * sweep / (2 * np.pi), **ends)
            elif choice > arcs:
                segment = Line(end, end + size * rng.normal(size=3), **ends)
            elif choice > arcs / 2:
                segment = Arc.through(end, *(end + size * rng.normal(size=(2, 3))), **ends)
            else:
                center = end + size * across / np.linalg.norm(across)
                segment = Arc.about(end, center, axis, rng.uniform(-1, 1) * 2 * np.pi, **ends)
            Path((*segments, segment))
        except ModelError:
            continue
        segments.append(segment)
        end, orientation = np.asarray(segment.end), last
    return Path(tuple(segments))


def random_arm_path(rng: np.random.Generator) -> ScaraPath | None:
    """An arm of any proportions along lines within its reach, the tool turning; None if they pass its column."""
    upper, fore = rng.uniform(0.2, 0.6, 2)
    arm = Scara(upper, fore, mount=0.1 * rng.normal(size=3))
    count = int(rng.integers(2, 6))
    angle = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.uniform(-1, 1, count))
    inner = max(arm.inner, 0.1 * arm.outer)
    radius = inner + (arm.outer - inner) * rng.uniform(0.3, 0.9, count)
    points = arm.mount + np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.1, 0.1, count)]
    )
    yaws = np.array([turned((0, 0, yaw)) for yaw in np.cumsum(rng.uniform(-2, 2, count))])
    try:
        path = smooth(Path.through(points, yaws), 10 ** rng.uniform(-2, -0.7))
        return scara_along(arm, path, "left" if rng.random() < 0.5 else "right")
    except ModelError:
        return None


def peak_curvature(shape: float, angle: float, remaining: float, kind: str = "cubic") -> float:
    """Return the largest curvature (1/m) of a blend between two lines, sampled on a grid refined about its maximum."""
    n1, n2 = np.array([1.0, 0.0, 0.0]), np.array([-np.cos(angle), np.sin(angle), 0.0])
    rate, zero = shape * remaining, np.zeros(3)
    start, end = -remaining * n1, remaining * n2
    if kind == "cubic":
        curve = cubic(start, rate * n1, end, rate * n2)
    else:
        curve = quintic((start, rate * n1, zero), (end, rate * n2, zero))
    low, high, best = 0.0, 1.0, 0.0
    for _ in range(5):
        u = np.linspace(low, high, 2001)
        values = curvature(curve, u)
        k = int(values.argmax())
        best = float(values[k])
        low, high = u[max(k - 2, 0)], u[min(k + 2, len(u) - 1)]
    return best
