"""Limits lowered, stretch by stretch, until a plan keeps to what a steady speed and the joints permit."""

from __future__ import annotations

import numpy as np

from ocp.errors import ProblemError
from ocp.schedule.attempt import Attempt
from ocp.schedule.easing import ease_ramps
from ocp.schedule.grid import Grid
from ocp.schedule.limits import JointPath, Limits
from ocp.schedule.relaxing import relax_ramps
from ocp.schedule.slowing import slow_down
from ocp.schedule.zones import plan

__all__ = ["search"]

ROUNDS = 200
RELIEVED = 40
"""After so many rounds every place that is still too fast gets its own permitted speed as a limit."""
GENTLER = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
"""Slower ramps tried where joint limits bind on ramps: acceleration over the square, jerk over the cube of these."""


def search(grid: Grid, limits: Limits, joints: JointPath | None) -> Attempt:
    """The shortest plan found: with ramps as fast as asked, and where joint limits bind on them, with slower ones.

    Slower ones are tried all along the path, and then made faster again wherever the joints can follow.

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
    return relax_ramps(_found(best, grid), limits, joints)


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
    no_cause = np.full(count, -1, dtype=np.intp)
    state = Attempt(grid, grid.asked.copy(), acceleration, jerk, no_cause, passed=passed)
    for number in range(ROUNDS):
        state.profile = plan(state.zones(), state.memory)
        if slow_down(state, thoroughly=number >= RELIEVED):
            continue
        if joints is None or not ease_ramps(state, limits, joints):
            return state
    return None
