"""Limits lowered, stretch by stretch, until a plan keeps to what a steady speed and the joints permit."""

from __future__ import annotations

import numpy as np

from ocp.errors import ProblemError
from ocp.schedule.attempt import TOLERANCE, Attempt
from ocp.schedule.easing import ease_ramps
from ocp.schedule.grid import Grid
from ocp.schedule.limits import JointPath, Limits
from ocp.schedule.profile import SpeedProfile
from ocp.schedule.relaxing import relax_ramps
from ocp.schedule.zones import plan

__all__ = ["search"]

ROUNDS = 200
RELIEVED = 40
"""After so many rounds every place that is still too fast gets its own permitted speed as a limit."""
SPREAD = 1.2
"""A stretch of one limit spans permitted speeds up to this ratio."""
GENTLER = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
"""Slower ramps tried where joint limits bind on ramps: acceleration over the square, jerk over the cube of these."""


def search(grid: Grid, limits: Limits, joints: JointPath | None) -> Attempt:
    """The shortest plan found: with ramps as fast as asked, and where joint limits bind on them, with slower ones too.

    Raises:
        ProblemError: No attempt kept the limits.
    """
    passed: set[tuple[float, ...]] = set()
    best = _attempt(grid, limits, joints, 1.0, passed)
    if joints is None or (best is not None and (best.ramp_cause < 0).all()):
        return _found(best, grid)
    worse = 0
    for gentler in GENTLER:
        other = _attempt(grid, limits, joints, gentler, passed)
        if other is None:
            continue
        if best is None or other.profile.duration < best.profile.duration:
            best, worse = other, 0
        else:
            worse += 1
            if worse == 3:
                break
    return relax_ramps(_found(best, grid), limits, joints, lambda state: _slow_down(state, state.profile, True))


def _found(best: Attempt | None, grid: Grid) -> Attempt:
    if best is None:
        raise ProblemError(
            f"no schedule found that keeps the joint limits, after {ROUNDS} rounds; raise the limits, or keep the path "
            f"away from singular arms (the slowest place permits {float(grid.permitted.min()):.3g} m/s)"
        )
    return best


def _attempt(
    grid: Grid, limits: Limits, joints: JointPath | None, gentler: float, passed: set[tuple[float, ...]]
) -> Attempt | None:
    count = len(grid.asked)
    acceleration = np.full(count, float(limits.acceleration) / gentler**2)
    jerk = np.full(count, float(limits.jerk) / gentler**3)
    state = Attempt(
        grid, grid.asked.copy(), acceleration, jerk, np.full(count, -1, dtype=np.intp), gentler, passed=passed
    )
    for number in range(ROUNDS):
        state.profile = plan(state.zones(), state.memory)
        if _slow_down(state, state.profile, number >= RELIEVED):
            continue
        if joints is None or not ease_ramps(state, limits, joints):
            return state
    return None


def _slow_down(state: Attempt, profile: SpeedProfile, thoroughly: bool) -> bool:
    """Lower the speed limits where the plan is faster than permitted; False when it is nowhere."""
    grid = state.grid
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
