"""Ramps made gentler where the joints cannot follow them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.attempt import TOLERANCE, Attempt
from ocp.schedule.limits import JointPath, Limits, joint_demands, rates_along
from ocp.schedule.profile import Array, Motion, SpeedProfile

__all__ = ["Broken", "broken_ramps", "ease_ramps"]

STEADY_SHARE = 0.8
"""Where a steady speed alone takes more than this share of a joint limit, a ramp there needs a lower speed as well."""
PER_PHASE = 9
"""Samples of a phase, beside the grid's."""
NEARLY, FINER = 0.9, 16
"""Between two samples a demand is looked at again, so many times finer, where it has a peak above this."""


class Broken(NamedTuple):
    """Samples of ramps at which joint limits are broken.

    Attributes:
        ramp: Phases of one sense belong to one ramp: number of each phase's. Shape (K,).
        phase: Of each sample. Shape (M,).
        distance, speed: Shape (M,), m and m/s.
        demand: Largest demand over its limit, above 1. Shape (M,).
        steady: The part of it that a steady speed has. Shape (M,).
        row: Of joint_demands. Shape (M,).
    """

    ramp: NDArray[np.intp]
    phase: NDArray[np.intp]
    distance: Array
    speed: Array
    demand: Array
    steady: Array
    row: NDArray[np.intp]


def broken_ramps(state: Attempt, limits: Limits, joints: JointPath) -> Broken | None:
    """Where the plan's ramps break joint limits; None when nowhere.

    Only phases not seen before are looked at: the others are known to keep the limits.
    """
    profile = state.profile
    even = (profile.jerk == 0) & (profile.acceleration[:-1] == 0)
    keys = _keys(profile)
    fresh = np.array([k for k in np.flatnonzero(~even).tolist() if keys[k] not in state.passed], dtype=np.intp)
    if not fresh.size:
        return None
    phase, motion = _samples(state, fresh)
    whole, steady = joint_demands(limits, rates_along(joints, motion.distance), motion)
    passing = np.setdiff1d(fresh, phase[(whole > 1 + TOLERANCE).any(axis=0)])
    if passing.size:
        # a peak may lie between two samples
        finer, more = _between(profile, phase, motion.t, np.where(np.isin(phase, passing), whole, 0.0))
        if len(finer):
            demands = joint_demands(limits, rates_along(joints, more.distance), more)
            whole, steady = (np.concatenate(pair, axis=1) for pair in zip((whole, steady), demands, strict=True))
            phase = np.concatenate([phase, finer])
            motion = Motion(*(np.concatenate(pair) for pair in zip(motion, more, strict=True)))
            passing = np.setdiff1d(passing, finer[(demands[0] > 1 + TOLERANCE).any(axis=0)])
        state.passed.update(keys[k] for k in passing.tolist())
    row = whole.argmax(axis=0)
    demand = np.take_along_axis(whole, row[None], axis=0)[0]
    over = np.flatnonzero(demand > 1 + TOLERANCE)
    if not over.size:
        return None
    share = np.take_along_axis(steady, row[None], axis=0)[0]
    ramp = np.concatenate([[0], np.cumsum(np.diff(np.sign(np.diff(profile.speed))) != 0)])
    return Broken(ramp, phase[over], motion.distance[over], motion.speed[over], demand[over], share[over], row[over])


def ease_ramps(state: Attempt, limits: Limits, joints: JointPath) -> bool:
    """Lower acceleration and jerk limits where a ramp breaks a joint limit; False when none does."""
    broken = broken_ramps(state, limits, joints)
    if broken is None:
        return False
    # ramps whose stretches overlap must not lower each other's limits again and again in one round
    before = state.acceleration.copy(), state.jerk.copy()
    for one in np.unique(broken.ramp[broken.phase]):
        _ease(state, broken, int(one), before, len(joints.names))
    return True


def _ease(state: Attempt, broken: Broken, ramp: int, before: tuple[Array, Array], number: int) -> None:
    """Make one ramp gentler, and lower the speed where a steady one alone takes most of a limit."""
    profile = state.profile
    mine = broken.ramp[broken.phase] == ramp
    demand, steady, row = broken.demand[mine], broken.steady[mine], broken.row[mine]
    distance, speed = broken.distance[mine], broken.speed[mine]
    worst = int(demand.argmax())
    share = np.minimum(steady, STEADY_SHARE)
    factor = float(np.clip(0.99 * np.min((1 - share) / (demand - share)), 0.3, 0.98))
    phases = np.flatnonzero(broken.ramp == ramp)
    first, last = phases[0], phases[-1] + 1
    begin, end = profile.distance[first], profile.distance[last]
    longer = (end - begin) * (1 / factor - 1)
    rising = profile.speed[last] > profile.speed[first]
    low, high = (begin, end + longer) if rising else (begin - longer, end)
    stretch = slice(state.interval(low), state.interval(high) + 1)
    at = state.interval(float(distance[worst]))
    acceleration, jerk = factor * before[0][at], factor * before[1][at]
    changed = state.acceleration[stretch] > acceleration
    state.ramp_cause[stretch] = np.where(changed, 1 + number + row[worst], state.ramp_cause[stretch])
    np.minimum(state.acceleration[stretch], acceleration, out=state.acceleration[stretch])
    np.minimum(state.jerk[stretch], jerk, out=state.jerk[stretch])
    hot = steady > STEADY_SHARE
    if hot.any():
        power = np.where(row[hot] < number, 2, 3)
        ceiling = float(np.min(speed[hot] * (STEADY_SHARE / steady[hot]) ** (1 / power)))
        places = [state.interval(float(s)) for s in distance[hot]]
        reached = slice(max(min(places) - 1, 0), max(places) + 2)
        np.minimum(state.speed[reached], ceiling, out=state.speed[reached])


def _keys(profile: SpeedProfile) -> list[tuple[float, ...]]:
    rows = (profile.distance[:-1], profile.speed[:-1], profile.acceleration[:-1], profile.jerk, np.diff(profile.t))
    return list(zip(*(row.tolist() for row in rows), strict=True))


def _samples(state: Attempt, phases: NDArray[np.intp]) -> tuple[NDArray[np.intp], Motion]:
    """Motion in phases: at their ends, inside them, and at the grid's points, with the jerk of the phase."""
    grid, profile = state.grid, state.profile
    fractions = np.linspace(0, 1, PER_PHASE)
    inside = (profile.t[phases, None] + np.diff(profile.t)[phases, None] * fractions).ravel()
    phase = np.repeat(phases, len(fractions))
    places = np.concatenate([grid.distance, grid.before])
    owner = np.clip(np.searchsorted(profile.distance, places, side="left") - 1, 0, len(profile.jerk) - 1)
    wanted = np.isin(owner, phases)
    phase = np.concatenate([phase, owner[wanted]])
    t = np.concatenate([inside, profile.at_distance(places[wanted]).t])
    order = np.lexsort((t, phase))
    return phase[order], _motion(profile, phase[order], t[order])


def _motion(profile: SpeedProfile, phase: NDArray[np.intp], t: Array) -> Motion:
    motion = profile.at(np.minimum(t, profile.duration))
    # at a phase's end the profile shows what comes after; the jerk before it counts too
    local, j = t - profile.t[phase], profile.jerk[phase]
    return motion._replace(t=t, jerk=j, acceleration=profile.acceleration[phase] + local * j)


def _between(
    profile: SpeedProfile, phase: NDArray[np.intp], t: Array, demand: Array
) -> tuple[NDArray[np.intp], Motion]:
    """Motion about the largest demands, (C, M) at times (M,) of the phases: a peak may lie between two samples."""
    padded = np.pad(demand, ((0, 0), (1, 1)))
    peak = (demand >= padded[:, :-2]) & (demand >= padded[:, 2:]) & (demand > NEARLY)
    left = np.flatnonzero(peak[:, :-1].any(axis=0) | peak[:, 1:].any(axis=0))
    left = left[(phase[left] == phase[left + 1]) & (t[left] < t[left + 1])]
    fractions = np.arange(1, FINER) / FINER
    inside = t[left, None] + (t[left + 1] - t[left])[:, None] * fractions
    owner = np.repeat(phase[left], len(fractions))
    return owner, _motion(profile, owner, inside.ravel())
