"""Limits lowered, stretch by stretch, until a plan keeps to what a steady speed and the joints permit."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.grid import Grid
from ocp.schedule.limits import JointPath, Limits, joint_demands
from ocp.schedule.profile import Array, Motion, SpeedProfile
from ocp.schedule.zones import Memory, Zones, plan

__all__ = ["Attempt", "search"]

ROUNDS = 200
RELIEVED = 40
"""After so many rounds every place that is still too fast gets its own permitted speed as a limit."""
SPREAD = 1.2
"""A stretch of one limit spans permitted speeds up to this ratio."""
STEADY_SHARE = 0.8
"""Where a steady speed alone takes more than this share of a joint limit, a ramp there needs a lower speed as well."""
TOLERANCE = 1e-9
GENTLER = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0)
"""Slower ramps tried where joint limits bind on ramps: acceleration over the square, jerk over the cube of these."""


@dataclass(eq=False)
class Attempt:
    """Limits in each interval of the grid, lowered until the plan keeps all.

    Attributes:
        grid: Where they are looked at.
        speed, acceleration, jerk: Limits of each interval. Shape (G - 1,).
        ramp_cause: Row of `cause_names` that made a ramp gentler there, or -1. Shape (G - 1,).
        gentler: Ramps of the whole path are this much slower in time.
        profile: The plan.
    """

    grid: Grid
    speed: Array
    acceleration: Array
    jerk: Array
    ramp_cause: NDArray[np.intp]
    gentler: float = 1.0
    memory: Memory = field(default_factory=dict)
    profile: SpeedProfile = field(init=False)

    def zones(self) -> Zones:
        values = np.stack([self.speed, self.acceleration, self.jerk])
        starts = np.concatenate([[0], 1 + np.flatnonzero((np.diff(values, axis=1) != 0).any(axis=0))])
        return Zones(self.grid.distance[np.append(starts, len(self.speed))], *values[:, starts])


def search(grid: Grid, limits: Limits, joints: JointPath | None) -> Attempt:
    """The shortest plan found: with ramps as fast as asked, and where joint limits bind on them, with slower ones too.

    Raises:
        ProblemError: No attempt kept the limits.
    """
    best = _attempt(grid, limits, joints, 1.0)
    if best is not None and (best.ramp_cause < 0).all():
        return best
    worse = 0
    for gentler in GENTLER:
        other = _attempt(grid, limits, joints, gentler)
        if other is None:
            continue
        if best is None or other.profile.duration < best.profile.duration:
            best, worse = other, 0
        else:
            worse += 1
            if worse == 3:
                break
    if best is None:
        raise ProblemError(
            f"no schedule found that keeps the joint limits, after {ROUNDS} rounds; raise the limits, or keep the path "
            f"away from singular arms (the slowest place permits {float(grid.permitted.min()):.3g} m/s)"
        )
    return best


def _attempt(grid: Grid, limits: Limits, joints: JointPath | None, gentler: float) -> Attempt | None:
    count = len(grid.asked)
    acceleration = np.full(count, float(limits.acceleration) / gentler**2)
    jerk = np.full(count, float(limits.jerk) / gentler**3)
    state = Attempt(grid, grid.asked.copy(), acceleration, jerk, np.full(count, -1, dtype=np.intp), gentler)
    for number in range(ROUNDS):
        state.profile = plan(state.zones(), state.memory)
        if _slow_down(state, state.profile, number >= RELIEVED):
            continue
        if joints is None or not _ease_ramps(state, state.profile, limits, joints):
            return state
    return None


def _slow_down(state: Attempt, profile: SpeedProfile, thoroughly: bool) -> bool:
    """Lower the speed limits where the plan is faster than permitted; False when it is nowhere."""
    grid = state.grid
    if not np.isfinite(grid.permitted).any():
        return False
    # between two points: at most the faster speed, at least the slower permitted one
    speed = profile.at_distance(grid.distance).speed
    permitted = np.minimum(grid.permitted[:-1], grid.permitted[1:])
    fast = np.minimum(np.maximum(speed[:-1], speed[1:]), state.speed) > permitted * (1 + TOLERANCE)
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


def _ease_ramps(state: Attempt, profile: SpeedProfile, limits: Limits, joints: JointPath) -> bool:
    """Lower acceleration and jerk limits where a ramp breaks a joint limit; False when none does."""
    phase, motion = _samples(state.grid, profile)
    if not len(phase):
        return False
    whole, steady = joint_demands(limits, joints.at(motion.distance), motion)
    worst = whole.argmax(axis=0)
    demand = np.take_along_axis(whole, worst[None], axis=0)[0]
    if demand.max() <= 1 + TOLERANCE:
        return False
    share = np.take_along_axis(steady, worst[None], axis=0)[0]
    sign = np.sign(np.diff(profile.speed))
    ramp = np.concatenate([[0], np.cumsum(np.diff(sign) != 0)])  # phases of one sense belong together
    number = len(joints.names)
    for one in np.unique(ramp[phase[demand > 1 + TOLERANCE]]):
        mine = np.flatnonzero((ramp[phase] == one) & (demand > 1 + TOLERANCE))
        at = int(mine[demand[mine].argmax()])
        factor = np.min(
            (1 - np.minimum(share[mine], STEADY_SHARE)) / (demand[mine] - np.minimum(share[mine], STEADY_SHARE))
        )
        factor = float(np.clip(0.99 * factor, 0.3, 0.98))
        phases = np.flatnonzero(ramp == one)
        begin, end = profile.distance[phases[0]], profile.distance[phases[-1] + 1]
        longer = (end - begin) * (1 / factor - 1)
        rising = sign[phases[0]] > 0
        low = begin if rising else begin - longer
        high = end + longer if rising else end
        first, last = _interval(state.grid, low), _interval(state.grid, high)
        worst_interval = _interval(state.grid, float(motion.distance[at]))
        stretch = slice(first, last + 1)
        changed = state.acceleration[stretch] > factor * state.acceleration[worst_interval]
        state.ramp_cause[stretch] = np.where(changed, 1 + number + worst[at], state.ramp_cause[stretch])
        np.minimum(
            state.acceleration[stretch], factor * state.acceleration[worst_interval], out=state.acceleration[stretch]
        )
        np.minimum(state.jerk[stretch], factor * state.jerk[worst_interval], out=state.jerk[stretch])
        hot = mine[share[mine] > STEADY_SHARE]
        if hot.size:
            power = np.where(worst[hot] < number, 2, 3)
            ceiling = float(np.min(motion.speed[hot] * (STEADY_SHARE / share[hot]) ** (1 / power)))
            places = [_interval(state.grid, float(s)) for s in motion.distance[hot]]
            reached = slice(max(min(places) - 1, 0), max(places) + 2)
            np.minimum(state.speed[reached], ceiling, out=state.speed[reached])
    return True


def _interval(grid: Grid, distance: float) -> int:
    return int(np.clip(np.searchsorted(grid.distance, distance, side="right") - 1, 0, len(grid.asked) - 1))


def _samples(grid: Grid, profile: SpeedProfile) -> tuple[NDArray[np.intp], Motion]:
    """Motion on the ramps: at the grid's points, at each phase's ends and inside it, with the jerk of the phase."""
    durations = np.diff(profile.t)
    even = (profile.jerk == 0) & (profile.acceleration[:-1] == 0)
    moving = np.flatnonzero(~even)
    fractions = np.linspace(0, 1, 9)
    inside = (profile.t[moving, None] + durations[moving, None] * fractions).ravel()
    phase = np.repeat(moving, len(fractions))
    at_grid = profile.at_distance(np.concatenate([grid.distance, grid.before])).t
    owner = np.clip(np.searchsorted(profile.t, at_grid, side="right") - 1, 0, len(even) - 1)
    kept = ~even[owner]
    phase = np.concatenate([phase, owner[kept]])
    t = np.concatenate([inside, at_grid[kept]])
    motion = profile.at(np.minimum(t, profile.duration))
    # at a phase's end the profile shows what comes after; the jerk before it counts too
    start = profile.t[phase]
    local = t - start
    j = profile.jerk[phase]
    return phase, motion._replace(jerk=j, acceleration=profile.acceleration[phase] + local * j)
