"""Time along a path: the asked line speed wherever the limits allow it, slowed smoothly just where they do not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.console import interruptible
from ocp.errors import ProblemError, checked_flag, checked_positive
from ocp.schedule.grid import make_grid
from ocp.schedule.joints import KEPT, Attempt, search
from ocp.schedule.limits import JointPath, LineLimits, PathLike, cause_names, check_line
from ocp.schedule.profile import Array, LineMotion, SpeedProfile, piece_of

__all__ = ["Dip", "Schedule", "schedule"]


@dataclass(frozen=True)
class Dip:
    """A stretch in which the schedule stays below what was asked.

    Attributes:
        start, end: Distances along the path, m.
        cause: The limit that binds, for example "centripetal acceleration" or "joint 'elbow' velocity".
        asked, speed: Asked line speed and lowest one permitted there, m/s.
        acceleration, jerk: Of the line speed, permitted there, m/s^2 and m/s^3; below the limits where a ramp would
            break a joint limit.
    """

    start: float
    end: float
    cause: str
    asked: float
    speed: float
    acceleration: float
    jerk: float

    def __str__(self) -> str:
        slow = f"permits {self.speed:.4g} of {self.asked:.4g} m/s" if self.speed < self.asked else "binds on a ramp"
        return (
            f"{self.start:.6g} to {self.end:.6g} m: {self.cause} {slow}, "
            f"line acceleration {self.acceleration:.4g} m/s^2, jerk {self.jerk:.4g} m/s^3"
        )


@dataclass(frozen=True, eq=False)
class Schedule:
    """When the path is where.

    Attributes:
        path: What it was made for.
        limits: What it keeps to.
        profile: Distance and speed over time.
        dips: Where it is slower than asked, and why; empty if nowhere.
        joints: The joints along the path, if they were limited.
    """

    path: PathLike
    limits: LineLimits
    profile: SpeedProfile
    dips: tuple[Dip, ...]
    joints: JointPath | None = None

    @property
    def duration(self) -> float:
        """s."""
        return self.profile.duration

    def at(self, time: ArrayLike) -> LineMotion:
        """LineMotion at times of [0, duration]. Shape (M,), s."""
        return self.profile.at(time)

    def time_at(self, distance: ArrayLike) -> Array:
        """Times at which the path has the given distances from its start. Shape (M,), s."""
        return self.profile.at_distance(distance).t

    def sample(self, period: float) -> LineMotion:
        """LineMotion every `period` s from the start; the last sample, at the end, comes as early as the duration says.

        Raises:
            ProblemError: A period that is not positive, or nan.
        """
        checked_positive("sample period", period)
        times = np.arange(int(np.ceil(self.duration / period * (1 - 1e-12)))) * period
        return self.at(np.append(times, self.duration))

    def function(self) -> Any:
        """casadi Function of the time, see SpeedProfile.function."""
        return self.profile.function()


@interruptible
def schedule(path: PathLike, limits: LineLimits, *, joints: JointPath | None = None, strict: bool = False) -> Schedule:
    """Plan the line speed along a path from rest to rest.

    One jerk-limited motion if nothing but speed, acceleration and jerk binds; the speed is then constant at the asked
    one, through the blends as well, between its ramps. Where a steady speed breaks a limit, a stretch gets the speed
    that keeps it; where a ramp breaks a joint limit, it gets a gentler one. All limits hold on a grid that resolves
    them to 0.1 %.

    Args:
        path: A models.paths.SmoothPath, or whatever has what PathLike says.
        limits: What to keep to.
        joints: The joints along the path, where limits.joints is given.
        strict: Raise instead of slowing down.

    Raises:
        ProblemError: Joint limits without joints, or a limit that would be broken at the asked speed, if strict;
            limits that no schedule keeps.
    """
    limited = check_line(path, limits, joints)
    checked_flag("strict", strict)
    grid = make_grid(path, limits, limited)
    found = search(grid, limits, limited)
    dips = _dips(found, limits, cause_names(limited.names if limited is not None else ()))
    if strict and dips:
        listed = "\n  ".join(str(dip) for dip in dips[:10])
        hint, one = "ask for less, larger blends, or strict=False", dips[0]
        message = f"the asked speed breaks limits in {len(dips)} place(s); {hint}:\n  {listed}"
        raise ProblemError(message, name=one.cause, value=one.asked, limit=one.speed, time=one.start)
    return Schedule(path, limits, found.profile, dips, joints)


def _dips(state: Attempt, limits: LineLimits, names: tuple[str, ...]) -> tuple[Dip, ...]:
    grid, cause = state.grid, _causes(state, limits)
    dips = []
    for first, last in pairwise(np.flatnonzero(np.diff(cause, prepend=-1, append=-1)).tolist()):
        if cause[first] < 0:
            continue
        inside = slice(first, last)
        lowest = first + int((state.speed[inside] / grid.asked[inside]).argmin())
        ends = (float(grid.distance[first]), float(grid.distance[last]))
        speeds = (float(grid.asked[lowest]), float(state.speed[lowest]))
        ramp = (float(state.acceleration[inside].min()), float(state.jerk[inside].min()))
        dips.append(Dip(*ends, names[int(cause[first])], *speeds, *ramp))
    return tuple(_joined(dips, state))


def _causes(state: Attempt, limits: LineLimits) -> NDArray[np.intp]:
    """Row of cause_names that slows each interval of the grid, -1 where nothing does. Shape (G - 1,)."""
    grid, speed = state.grid, state.speed
    gentle = state.acceleration < limits.acceleration * (1 - KEPT)
    gentle |= state.jerk < limits.jerk * (1 - KEPT)
    cause = np.where(gentle, state.ramp_cause, -1)
    slow = speed < grid.asked * (1 - KEPT)
    # where one speed holds, the slowest place says why
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(speed)), [len(speed)]])
    for first, last in pairwise(starts.tolist()):
        if slow[first:last].any():
            lowest = first + int(grid.permitted[first : last + 1].argmin())
            for_ramp = (state.ramp_cause[first:last] >= 0) & (speed[first] < grid.permitted[lowest] * (1 - KEPT))
            cause[first:last] = np.where(for_ramp, state.ramp_cause[first:last], grid.cause[lowest])
    return cause


def _joined(dips: list[Dip], state: Attempt) -> list[Dip]:
    """Dips of one cause between which the schedule never gets back to the asked speed are one."""
    peaks, grid = state.profile.peaks(), state.grid
    order = np.argsort(peaks.distance)
    places = peaks.distance[order]
    back = peaks.speed[order] >= grid.asked[piece_of(grid.distance, places)] * (1 - KEPT)
    joined: list[Dip] = []
    for dip in dips:
        last = joined[-1] if joined else dip
        between = slice(*np.searchsorted(places, [last.end, dip.start]))
        if joined and (last.cause, last.asked) == (dip.cause, dip.asked) and not back[between].any():
            least = (min(getattr(last, kind), getattr(dip, kind)) for kind in ("speed", "acceleration", "jerk"))
            joined[-1] = Dip(last.start, dip.end, dip.cause, dip.asked, *least)
        else:
            joined.append(dip)
    return joined
