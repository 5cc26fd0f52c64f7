"""From limits that change along the path to one line-speed profile."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import NamedTuple

import numpy as np

from ocp.errors import ProblemError
from ocp.schedule.profile import Array, SpeedProfile
from ocp.schedule.ramps import Phases, fastest, reach

__all__ = ["Memory", "Zones", "plan"]

Memory = MutableMapping[tuple[float, ...], Phases]
"""Motions already found, by their limits and ends."""
MARGIN = 1e-6
"""Share of a zone's length kept back when its ends' speeds are chosen, so that a motion surely exists."""


class Zones(NamedTuple):
    """Stretches of a path with limits of their own.

    Attributes:
        bounds: Distances at which the zones begin, and the end. Shape (Z + 1,), m.
        speed, acceleration, jerk: Limits in each zone. Shape (Z,).
    """

    bounds: Array
    speed: Array
    acceleration: Array
    jerk: Array


def plan(zones: Zones, memory: Memory) -> SpeedProfile:
    """Line speed from rest to rest, as fast as the zones' limits allow with no acceleration at their bounds.

    A backward and a forward pass find the speeds at the bounds, then each zone is the fastest motion between them.
    One zone alone gives the time optimum; more do but for the acceleration that drops to zero at a bound.
    """
    lengths = np.diff(zones.bounds).tolist()
    limits = list(zip(zones.speed.tolist(), zones.acceleration.tolist(), zones.jerk.tolist(), strict=True))
    ends = [0.0, *np.minimum(zones.speed[:-1], zones.speed[1:]).tolist(), 0.0]
    count = len(lengths)
    for i in range(count):
        ends[i + 1] = _limited(ends[i + 1], ends[i], lengths[i], limits[i])
    for i in reversed(range(count)):
        ends[i] = _limited(ends[i], ends[i + 1], lengths[i], limits[i])

    durations: list[float] = []
    jerks: list[float] = []
    rows: list[tuple[float, float, float]] = []  # distance, speed, acceleration at the start of each phase
    for i, ((top, most, jerk), length) in enumerate(zip(limits, lengths, strict=True)):
        first, last = ends[i], ends[i + 1]
        if first == last == top:
            phases: Phases = ((length / top, 0.0),)
        else:
            key = (length, first, last, top, most, jerk)
            known = memory.get(key)
            if known is None:
                known = memory[key] = fastest(*key)
            phases = known
        s, v, a = float(zones.bounds[i]), first, 0.0
        for t, j in phases:
            durations.append(t)
            jerks.append(j)
            rows.append((s, v, a))
            s += t * (v + t * (a / 2 + t * j / 6))
            v = max(v + t * (a + t * j / 2), 0.0)
            a += t * j
            if abs(a) <= 1e-9 * most:
                a = 0.0
    if not durations or not np.isfinite(durations).all():
        raise ProblemError(f"no line-speed profile over {zones.bounds[-1]:g} m: durations {durations[:5]}")
    state = np.array([*rows, (float(zones.bounds[-1]), 0.0, 0.0)])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    return SpeedProfile(times, state[:, 0], state[:, 1], state[:, 2], np.array(jerks))


def _limited(speed: float, other: float, length: float, limits: tuple[float, float, float]) -> float:
    if speed <= other:
        return speed
    return min(speed, reach(other, length * (1 - MARGIN), *limits[1:]))
