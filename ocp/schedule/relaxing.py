"""Ramps given back what they need not have lost: gentler only where a joint limit binds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.attempt import TOLERANCE, Attempt
from ocp.schedule.easing import Broken, broken_ramps
from ocp.schedule.limits import JointPath, Limits
from ocp.schedule.slowing import slow_down
from ocp.schedule.zones import plan

__all__ = ["relax_ramps"]

SHARES = ((1.0, 1.0), (0.5, 0.5), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5), (0.25, 0.25))
"""How much of the acceleration and of the jerk that a stretch has lost, by the logarithm, it gets back, in turn."""
ROUNDS, PATIENCE = 24, 4
"""After each so many rounds one more neighbour on either side goes back with a stretch, so that long paths settle."""


def relax_ramps(best: Attempt, limits: Limits, joints: JointPath) -> Attempt:
    """The plan with full acceleration and jerk, or at least more of them, wherever the joints can follow.

    Args:
        best: A plan that keeps all limits.
        limits, joints: What it keeps to.
    """
    for share in SHARES:
        trial = _trial(best, limits, joints, share)
        if trial is not None and trial.profile.duration <= best.profile.duration:
            best = trial
    return best


def _trial(best: Attempt, limits: Limits, joints: JointPath, share: tuple[float, float]) -> Attempt | None:
    """All stretches get more; those whose ramps then break a limit go back to what they had, until none does."""
    lost = limits.acceleration / best.acceleration, limits.jerk / best.jerk
    eased = np.maximum(*lost) > 1 + TOLERANCE
    owner = _stretches(best)
    free = np.unique(owner[eased])
    if not free.size:
        return None
    acceleration, jerk = best.acceleration * lost[0] ** share[0], best.jerk * lost[1] ** share[1]
    trial = replace(
        best, speed=best.speed.copy(), acceleration=acceleration, jerk=jerk, ramp_cause=best.ramp_cause.copy()
    )
    for number in range(ROUNDS):
        trial.profile = plan(trial.zones(), trial.memory)
        if slow_down(trial):
            continue
        broken = broken_ramps(trial, limits, joints)
        if broken is None:
            return trial
        row = _touched(trial, broken, owner, free, number // PATIENCE)
        if (row < 0).all():
            return None
        back = row[owner] >= 0
        for kind in ("speed", "acceleration", "jerk"):
            getattr(trial, kind)[back] = getattr(best, kind)[back]
        trial.ramp_cause[back & eased] = 1 + len(joints.names) + row[owner][back & eased]
        free = free[row[free] < 0]
    return None


def _stretches(state: Attempt) -> NDArray[np.intp]:
    """Number of the stretch of each interval of the grid, cut where the plan does not accelerate. Shape (G - 1,)."""
    profile = state.profile
    still = np.flatnonzero(profile.acceleration[1:-1] == 0) + 1
    cuts = np.unique([state.interval(float(s)) for s in profile.distance[still]])
    return np.searchsorted(cuts, np.arange(len(state.speed)), side="right")


def _touched(
    state: Attempt, broken: Broken, owner: NDArray[np.intp], free: NDArray[np.intp], margin: int
) -> NDArray[np.intp]:
    """For each stretch the row of joint_demands that sends it back, -1 if none does. Shape (number of stretches,)."""
    row = np.full(int(owner[-1]) + 1, -1)
    of_sample = broken.ramp[broken.phase]
    for one in np.unique(of_sample):
        phases = np.flatnonzero(broken.ramp == one)
        ends = state.profile.distance[[phases[0], phases[-1] + 1]]
        first, last = (int(owner[state.interval(float(s))]) for s in ends)
        low, high = np.searchsorted(free, [first - margin, last + margin + 1])
        if low == high:  # its neighbours have changed the speed that it comes from or goes to
            low, high = max(low - 1, 0), high + 1
        mine = of_sample == one
        row[free[low:high]] = broken.row[mine][broken.demand[mine].argmax()]
    return row
