"""The speed lowered where a steady one breaks a limit."""

from __future__ import annotations

import numpy as np

from ocp.schedule.attempt import TOLERANCE, Attempt

__all__ = ["slow_down"]

SPREAD = 1.2
"""A stretch of one limit spans permitted speeds up to this ratio."""


def slow_down(state: Attempt, *, thoroughly: bool = False) -> bool:
    """Lower the speed limits where the plan is faster than permitted; False when it is nowhere.

    Stretches about the slowest places get one limit each; `thoroughly` gives each place its own permitted speed.
    """
    grid, profile = state.grid, state.profile
    if not np.isfinite(grid.permitted).any():
        return False
    # between two points: the fastest speed, against the slower permitted one
    speed = profile.at_distance(grid.distance).speed
    top = np.maximum(speed[:-1], speed[1:])
    peaks = profile.peaks()
    between = np.clip(np.searchsorted(grid.distance, peaks.distance, side="right") - 1, 0, len(top) - 1)
    np.maximum.at(top, between, peaks.speed)
    permitted = np.minimum(grid.permitted[:-1], grid.permitted[1:])
    fast = np.minimum(top, state.speed) > permitted * (1 + TOLERANCE)
    if not fast.any():
        return False
    if thoroughly:
        state.speed[fast] = permitted[fast]
        return True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fast.astype(np.int8), [0]])))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        inside = permitted[first:last]
        least = int(inside.argmin())
        high = np.flatnonzero(inside > SPREAD * inside[least])
        left = int(high[high < least].max(initial=-1)) + 1 + first
        right = int(high[high > least].min(initial=last - first)) + first
        np.minimum(state.speed[left:right], inside[least], out=state.speed[left:right])
    return True
