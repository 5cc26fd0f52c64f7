"""The shortest plan found that keeps what a steady speed and the joints permit: limits lowered, interval by interval.

Speed, acceleration and jerk of the line have a limit in each interval of the grid. A plan is made for them, the limits
are lowered wherever it breaks what is permitted, and this is repeated until none is:

- where the plan is faster than a steady speed may be, the speed is lowered (`slow_down`);
- where a ramp breaks a joint limit, it is made gentler: less acceleration and jerk (`ease_ramps`).

Then acceleration and jerk are given back, stretch by stretch, to what need not have lost them: ramps are gentler only
where a joint limit binds (`relax_ramps`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.grid import Grid
from ocp.schedule.limits import JointPath, LineLimits, joint_demands, rates_along
from ocp.schedule.profile import Array, LineMotion, SpeedProfile, piece_of
from ocp.schedule.ramps import Memory, Zones, plan

__all__ = ["KEPT", "Attempt", "Broken", "broken_ramps", "ease_ramps", "relax_ramps", "search", "slow_down"]

KEPT = 1e-9
"""Limits count as kept up to this, relative."""
LOWERINGS = 200
"""Rounds of lowering limits after which an attempt is given up."""
THOROUGH_FROM = 40
"""After so many rounds every place that is still too fast gets its own permitted speed as a limit."""
GENTLER = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
"""Slower ramps tried where joint limits bind on ramps: acceleration over the square, jerk over the cube of these."""
IN_VAIN = 3
"""Gentler ramps in a row that give no shorter plan, after which none gentler still are tried."""
SPREAD = 1.2
"""A stretch of one limit spans permitted speeds up to this ratio."""
STEADY_SHARE = 0.8
"""Where a steady speed alone takes more than this share of a joint limit, a ramp there needs a lower speed as well."""
PER_PHASE = 9
"""Samples of a phase, beside the grid's."""
NEARLY, FINER = 0.9, 16
"""Between two samples a demand is looked at again, so many times finer, where it has a peak above this."""
SHARES = ((1.0, 1.0), (0.5, 0.5), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5), (0.25, 0.25))
"""How much of the acceleration and of the jerk that a stretch has lost, by the logarithm, it gets back, in turn."""
RELAXINGS = 24
"""Rounds in which stretches go back to what they had, after which a trial is given up."""
PATIENCE = 4
"""After each so many of them one more neighbour on either side goes back with a stretch, so that long paths settle."""


@dataclass(eq=False)
class Attempt:
    """Limits in each interval of the grid, lowered until the plan keeps all.

    Attributes:
        grid: Where they are looked at.
        speed, acceleration, jerk: Limits of the line in each interval. Shape (G - 1,), m/s, m/s^2, m/s^3.
        ramp_cause: Row of `cause_names` that made a ramp gentler there, or -1. Shape (G - 1,).
        memory: Motions of zones already found.
        passed: Phases that are known to keep the joint limits: distance, speed, acceleration, jerk, duration.
        profile: The plan.
    """

    grid: Grid
    speed: Array
    acceleration: Array
    jerk: Array
    ramp_cause: NDArray[np.intp]
    memory: Memory = field(default_factory=dict)
    passed: set[tuple[float, ...]] = field(default_factory=set)
    profile: SpeedProfile = field(init=False)

    def zones(self) -> Zones:
        """Neighbours with the same limits as one zone."""
        values = np.stack([self.speed, self.acceleration, self.jerk])
        starts = np.concatenate([[0], 1 + np.flatnonzero((np.diff(values, axis=1) != 0).any(axis=0))])
        return Zones(self.grid.distance[np.append(starts, len(self.speed))], *values[:, starts])

    def interval(self, distance: float) -> int:
        """Index of the interval of the grid that holds a distance (m)."""
        return int(piece_of(self.grid.distance, distance))

    def lower(self, kind: str, where: slice, most: float) -> None:
        """Lower the limits of a kind in a stretch to `most`."""
        limit: Array = getattr(self, kind)[where]
        np.minimum(limit, most, out=limit)


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


def search(grid: Grid, limits: LineLimits, joints: JointPath | None) -> Attempt:
    """The shortest plan found: with ramps as fast as asked, and where joint limits bind on them, with slower ones.

    Slower ones are tried all along the path, and then made faster again wherever the joints can follow.

    Raises:
        ProblemError: No attempt kept the limits.
    """
    passed: set[tuple[float, ...]] = set()
    best = _attempt(grid, limits, joints, 1.0, passed)
    if joints is not None and (best is None or (best.ramp_cause >= 0).any()):
        worse = 0
        for gentler in GENTLER:
            other = _attempt(grid, limits, joints, gentler, passed)
            if other is None:
                continue
            if best is None or other.profile.duration < best.profile.duration:
                best, worse = other, 0
            else:
                worse += 1
                if worse == IN_VAIN:
                    break
        if best is not None:
            return relax_ramps(best, limits, joints)
    if best is None:
        slowest = float(grid.permitted.min())
        message = (
            f"no schedule found that keeps the joint limits, after {LOWERINGS} rounds; raise the limits, or keep the "
            f"path away from singular arms (the slowest place permits {slowest:.3g} m/s)"
        )
        raise ProblemError(message, name="joint limits", value=slowest)
    return best


def _attempt(
    grid: Grid, limits: LineLimits, joints: JointPath | None, gentler: float, passed: set[tuple[float, ...]]
) -> Attempt | None:
    """The plan with ramps so many times slower than asked, or as much slower as it takes; None where none is found."""
    count = len(grid.asked)
    acceleration = np.full(count, float(limits.acceleration) / gentler**2)
    jerk = np.full(count, float(limits.jerk) / gentler**3)
    no_cause = np.full(count, -1, dtype=np.intp)
    state = Attempt(grid, grid.asked.copy(), acceleration, jerk, no_cause, passed=passed)
    for number in range(LOWERINGS):
        state.profile = plan(state.zones(), state.memory)
        if slow_down(state, thoroughly=number >= THOROUGH_FROM):
            continue
        if joints is None or not ease_ramps(state, limits, joints):
            return state
    return None


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
    np.maximum.at(top, piece_of(grid.distance, peaks.distance), peaks.speed)
    permitted = np.minimum(grid.permitted[:-1], grid.permitted[1:])
    fast = np.minimum(top, state.speed) > permitted * (1 + KEPT)
    if not fast.any():
        return False
    if thoroughly:
        state.speed[fast] = permitted[fast]
        return True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fast.astype(np.int8), [0]])))
    for first, last in edges.reshape(-1, 2).tolist():
        inside = permitted[first:last]
        least = int(inside.argmin())
        high = np.flatnonzero(inside > SPREAD * inside[least])
        left = int(high[high < least].max(initial=-1)) + 1 + first
        right = int(high[high > least].min(initial=last - first)) + first
        state.lower("speed", slice(left, right), inside[least])
    return True


def broken_ramps(state: Attempt, limits: LineLimits, joints: JointPath) -> Broken | None:
    """Where the plan's ramps break joint limits; None when nowhere.

    Only phases not seen before are looked at: the others are known to keep the limits.
    """
    profile = state.profile
    even = (profile.jerk == 0) & (profile.acceleration[:-1] == 0)
    rows = (profile.distance[:-1], profile.speed[:-1], profile.acceleration[:-1], profile.jerk, np.diff(profile.t))
    keys = list(zip(*(row.tolist() for row in rows), strict=True))
    fresh = np.array([k for k in np.flatnonzero(~even).tolist() if keys[k] not in state.passed], dtype=np.intp)
    if not fresh.size:
        return None
    phase, motion = _samples(state, fresh)
    whole, steady = joint_demands(limits, rates_along(joints, motion.distance), motion)
    passing = np.setdiff1d(fresh, phase[(whole > 1 + KEPT).any(axis=0)])
    if passing.size:
        finer, more = _between(profile, phase, motion.t, np.where(np.isin(phase, passing), whole, 0.0))
        if len(finer):
            demands = joint_demands(limits, rates_along(joints, more.distance), more)
            whole, steady = (np.concatenate(pair, axis=1) for pair in zip((whole, steady), demands, strict=True))
            phase = np.concatenate([phase, finer])
            motion = LineMotion(*(np.concatenate(pair) for pair in zip(motion, more, strict=True)))
            passing = np.setdiff1d(passing, finer[(demands[0] > 1 + KEPT).any(axis=0)])
        state.passed.update(keys[k] for k in passing.tolist())
    row = whole.argmax(axis=0)
    demand, share = (np.take_along_axis(values, row[None], axis=0)[0] for values in (whole, steady))
    over = np.flatnonzero(demand > 1 + KEPT)
    if not over.size:
        return None
    ramp = np.concatenate([[0], np.cumsum(np.diff(np.sign(np.diff(profile.speed))) != 0)])
    return Broken(ramp, phase[over], motion.distance[over], motion.speed[over], demand[over], share[over], row[over])


def _samples(state: Attempt, phases: NDArray[np.intp]) -> tuple[NDArray[np.intp], LineMotion]:
    """Motion in phases: at their ends, inside them, and at the grid's points, with the jerk of the phase."""
    grid, profile = state.grid, state.profile
    inside = profile.t[phases, None] + np.diff(profile.t)[phases, None] * np.linspace(0, 1, PER_PHASE)
    places = np.concatenate([grid.distance, grid.before])
    owner = piece_of(profile.distance, places, side="left")
    wanted = np.isin(owner, phases)
    phase = np.concatenate([np.repeat(phases, PER_PHASE), owner[wanted]])
    t = np.concatenate([inside.ravel(), profile.at_distance(places[wanted]).t])
    order = np.lexsort((t, phase))
    return phase[order], _motion(profile, phase[order], t[order])


def _between(
    profile: SpeedProfile, phase: NDArray[np.intp], t: Array, demand: Array
) -> tuple[NDArray[np.intp], LineMotion]:
    """Motion about the largest demands, (C, M) at times (M,) of the phases: a peak may lie between two samples."""
    padded = np.pad(demand, ((0, 0), (1, 1)))
    peak = (demand >= padded[:, :-2]) & (demand >= padded[:, 2:]) & (demand > NEARLY)
    left = np.flatnonzero(peak[:, :-1].any(axis=0) | peak[:, 1:].any(axis=0))
    left = left[(phase[left] == phase[left + 1]) & (t[left] < t[left + 1])]
    inside = t[left, None] + (t[left + 1] - t[left])[:, None] * (np.arange(1, FINER) / FINER)
    owner = np.repeat(phase[left], FINER - 1)
    return owner, _motion(profile, owner, inside.ravel())


def _motion(profile: SpeedProfile, phase: NDArray[np.intp], t: Array) -> LineMotion:
    motion = profile.at(np.minimum(t, profile.duration))
    # at a phase's end the profile shows what comes after; the jerk before it counts too
    local, j = t - profile.t[phase], profile.jerk[phase]
    return motion._replace(t=t, jerk=j, acceleration=profile.acceleration[phase] + local * j)


def ease_ramps(state: Attempt, limits: LineLimits, joints: JointPath) -> bool:
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
    distance, speed, demand, steady, row = (values[mine] for values in broken[2:])
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
    acceleration, jerk = (factor * limit[at] for limit in before)
    changed = state.acceleration[stretch] > acceleration
    state.ramp_cause[stretch] = np.where(changed, 1 + number + row[worst], state.ramp_cause[stretch])
    state.lower("acceleration", stretch, acceleration)
    state.lower("jerk", stretch, jerk)
    hot = steady > STEADY_SHARE
    if hot.any():
        power = np.where(row[hot] < number, 2, 3)
        ceiling = float(np.min(speed[hot] * (STEADY_SHARE / steady[hot]) ** (1 / power)))
        places = piece_of(state.grid.distance, distance[hot])
        state.lower("speed", slice(max(int(places.min()) - 1, 0), int(places.max()) + 2), ceiling)


def relax_ramps(best: Attempt, limits: LineLimits, joints: JointPath) -> Attempt:
    """The plan with full acceleration and jerk, or at least more of them, wherever the joints can follow.

    Args:
        best: A plan that keeps all limits.
        limits, joints: What it keeps to.
    """
    for share in SHARES:
        trial = _relaxed(best, limits, joints, share)
        if trial is not None and trial.profile.duration <= best.profile.duration:
            best = trial
    return best


def _relaxed(best: Attempt, limits: LineLimits, joints: JointPath, share: tuple[float, float]) -> Attempt | None:
    """All stretches get more; those whose ramps then break a limit go back to what they had, until none does."""
    lost = limits.acceleration / best.acceleration, limits.jerk / best.jerk
    eased = np.maximum(*lost) > 1 + KEPT
    owner = _stretches(best)
    free = np.unique(owner[eased])
    if not free.size:
        return None
    trial = replace(best, speed=best.speed.copy(), ramp_cause=best.ramp_cause.copy())
    trial.acceleration, trial.jerk = best.acceleration * lost[0] ** share[0], best.jerk * lost[1] ** share[1]
    for number in range(RELAXINGS):
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
    cuts = np.unique(piece_of(state.grid.distance, profile.distance[still]))
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
        first, last = owner[piece_of(state.grid.distance, ends)].tolist()
        low, high = np.searchsorted(free, [first - margin, last + margin + 1])
        if low == high:  # its neighbours have changed the speed that it comes from or goes to
            low, high = max(low - 1, 0), high + 1
        mine = of_sample == one
        row[free[low:high]] = broken.row[mine][broken.demand[mine].argmax()]
    return row
