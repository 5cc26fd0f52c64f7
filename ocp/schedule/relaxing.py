"""Ramps given back what they need not have lost: gentler only where a joint limit binds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.attempt import TOLERANCE, Attempt
from ocp.schedule.easing import Broken, broken_ramps
from ocp.schedule.limits import JointPath, Limits
from ocp.schedule.zones import plan

__all__ = ["relax_ramps"]

SHARES = (1.0, 0.5, 0.5, 0.5)
"""How much of what a stretch has lost of its limits, by the logarithm, is tried to give back, one after the other."""


def relax_ramps(best: Attempt, limits: Limits, joints: JointPath, slow_down: Callable[[Attempt], bool]) -> Attempt:
    """The plan with full acceleration and jerk, or at least more of them, wherever the joints can follow.

    The path is cut where the plan does not accelerate. All stretches get more at once; those whose ramps then break a
    joint limit go back to what they had, until none does.

    Args:
        best: A plan that keeps all limits.
        limits, joints: What it keeps to.
        slow_down: Lowers speed limits of an attempt whose plan is too fast; False when it is not.
    """
    for share in SHARES:
        trial = _trial(best, limits, joints, slow_down, share)
        if trial is not None and trial.profile.duration <= best.profile.duration:
            best = trial
    return best


def _trial(
    best: Attempt, limits: Limits, joints: JointPath, slow_down: Callable[[Attempt], bool], share: float
) -> Attempt | None:
    lost = limits.acceleration / best.acceleration, limits.jerk / best.jerk
    loss = np.maximum(*lost) > 1 + TOLERANCE
    owner = _stretches(best)
    open_ = np.unique(owner[loss])
    if not open_.size:
        return None
    trial = replace(
        best,
        speed=best.speed.copy(),
        acceleration=best.acceleration * lost[0] ** share,
        jerk=best.jerk * lost[1] ** share,
        ramp_cause=best.ramp_cause.copy(),
    )
    for _ in _rounds():
        trial.profile = plan(trial.zones(), trial.memory)
        if slow_down(trial):
            continue
        broken = broken_ramps(trial, limits, joints)
        if broken is None:
            return trial
        closed = _touched(trial, broken, owner, open_)
        if not closed:
            return None
        for stretch, row in closed.items():
            mine = owner == stretch
            for name in ("speed", "acceleration", "jerk"):
                getattr(trial, name)[mine] = getattr(best, name)[mine]
            trial.ramp_cause[mine & loss] = 1 + len(joints.names) + row
        open_ = np.setdiff1d(open_, list(closed))
    return None


def _rounds() -> Iterator[int]:
    return iter(range(100))


def _stretches(state: Attempt) -> NDArray[np.intp]:
    """Number of the stretch that each interval of the grid belongs to. Shape (G - 1,)."""
    profile = state.profile
    still = np.flatnonzero(profile.acceleration[1:-1] == 0) + 1
    cuts = np.unique([state.interval(float(s)) for s in profile.distance[still]])
    return np.searchsorted(cuts, np.arange(len(state.speed)), side="right")


def _touched(state: Attempt, broken: Broken, owner: NDArray[np.intp], open_: NDArray[np.intp]) -> dict[int, int]:
    """Stretches to go back to what they had, and the row of joint_demands that says so."""
    closed: dict[int, int] = {}
    for one in np.unique(broken.ramp[broken.phase]):
        phases = np.flatnonzero(broken.ramp == one)
        ends = state.profile.distance[[phases[0], phases[-1] + 1]]
        first, last = (int(owner[state.interval(float(s))]) for s in ends)
        mine = broken.ramp[broken.phase] == one
        row = int(broken.row[mine][broken.demand[mine].argmax()])
        inside = open_[(open_ >= first) & (open_ <= last)]
        if not inside.size:  # its neighbours have changed the speed that it comes from or goes to
            inside = np.concatenate([open_[open_ < first][-1:], open_[open_ > last][:1]])
        closed.update(dict.fromkeys(inside.tolist(), row))
    return closed
