"""A machine and the stances that it takes one after the other: which feet are held where, and for how long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from models import Foot, Foothold, ModelError, Robot, Stance
from models.arrays import Array
from ocp.builders.standing.problem import FreeTime
from ocp.errors import ProblemError, checked_each, checked_instance, checked_mapping, unknown_name
from ocp.tasks.checks import checked_horizon

__all__ = ["StancePhase", "Steps", "Swing", "walk"]


@dataclass(frozen=True, eq=False)
class StancePhase:
    """For how long which feet are held where.

    Attributes:
        footholds: By the names of the feet; the machine is rooted at the first.
        duration: s, or FreeTime(...).

    Raises:
        ProblemError: No footholds, a duration that is none.
    """

    footholds: Mapping[str, Foothold]
    duration: float | FreeTime

    def __post_init__(self) -> None:
        held = checked_mapping("stance phase: footholds", self.footholds)
        if not held:
            raise ProblemError("stance phase: footholds are missing: nothing stands on nothing", name="footholds")
        for name, place in held.items():
            checked_instance(f"stance phase: foothold of {name!r}", place, Foothold)
        if not isinstance(self.duration, FreeTime):
            checked_horizon(self.duration)
        object.__setattr__(self, "footholds", held)

    @property
    def seconds(self) -> float:
        """The duration, or the guess of it."""
        return self.duration.guess if isinstance(self.duration, FreeTime) else float(self.duration)


@dataclass(frozen=True, eq=False)
class Swing:
    """A foot in the air during a phase: where it lifted, and where it lands at the end; None where it does not."""

    name: str
    lifted: Foothold | None
    landing: Foothold | None


@dataclass(frozen=True, eq=False)
class Steps:
    """A robot, its feet, and the stances that it takes.

    Attributes:
        robot: Rooted anywhere; joint vectors are in its order.
        feet: By name.
        phases: One after the other; a foot held in two phases in a row stays where it is, and so must its foothold.
        gravity: m/s^2, downwards.

    Raises:
        ProblemError: No phases, an unknown foot, a foot whose foothold moves while it is held, no foot that is held in
            two phases in a row; what Stance.on refuses.
    """

    robot: Robot
    feet: Mapping[str, Foot]
    phases: Sequence[StancePhase]
    gravity: float = 9.81

    def __post_init__(self) -> None:
        checked_instance("steps: robot", self.robot, Robot)
        feet = checked_mapping("steps: feet", self.feet)
        phases = checked_each("steps: phases", self.phases, StancePhase)
        if not phases:
            raise ProblemError("steps: no phases are given", name="phases")
        for name, foot in feet.items():
            checked_instance(f"steps: foot {name!r}", foot, Foot)
        for phase in phases:
            for name in phase.footholds:
                if name not in feet:
                    raise unknown_name("foot", name, feet)
        for k, (before, after) in enumerate(pairwise(phases)):
            both = [name for name in before.footholds if name in after.footholds]
            if not both:
                words = f"steps: no foot is held from phase {k} to phase {k + 1}: the machine would leap"
                raise ProblemError(words, name="phases", value=k)
            for name in both:
                one, other = before.footholds[name], after.footholds[name]
                if np.any(one.position != other.position) or np.any(one.rotation != other.rotation):
                    words = f"steps: foot {name!r} is held from phase {k} to phase {k + 1}, but its foothold moves"
                    raise ProblemError(words, name=name, value=k)
        object.__setattr__(self, "feet", feet)
        object.__setattr__(self, "phases", phases)
        try:
            _ = self.stances
        except ModelError as error:
            raise ProblemError(str(error), **vars(error)) from error

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the phases: their number, from 1, and the feet that are held."""
        return tuple(f"{k + 1} {' + '.join(phase.footholds)}" for k, phase in enumerate(self.phases))

    @cached_property
    def stances(self) -> tuple[Stance, ...]:
        """The machine of each phase, rooted at the first of its feet."""
        return tuple(Stance.on(self.robot, self.feet, phase.footholds, self.gravity) for phase in self.phases)

    def order(self, stance: Stance) -> NDArray[np.intp]:
        """Where the entries of a stance's joint vectors are in those of the robot: q_stance = q[order]."""
        return np.array([self.robot.joint_names.index(name) for name in stance.robot.joint_names], dtype=np.intp)

    def swings(self, k: int) -> tuple[Swing, ...]:
        """The feet in the air during phase k that were or will be held."""
        found = []
        for name in self.feet:
            if name in self.phases[k].footholds:
                continue
            past = [phase.footholds[name] for phase in self.phases[:k] if name in phase.footholds]
            after = self.phases[k + 1].footholds.get(name) if k + 1 < len(self.phases) else None
            if past or after is not None:
                found.append(Swing(name, past[-1] if past else None, after))
        return tuple(found)

    def standing(self, k: int) -> Stance:
        """The stance at the beginning of phase k, at the end for the number of phases: all feet that touch there."""
        around = self.phases[max(k - 1, 0) : k + 1]
        held: dict[str, Foothold] = {}
        for phase in around:
            held |= phase.footholds
        return Stance.on(self.robot, self.feet, held, self.gravity)

    def balanced(self, k: int) -> Array:
        """Where a center of mass at the beginning of phase k is well placed: over the feet held before and after. (2,).

        The middle of their soles, m; of the footholds themselves where none has one.
        """
        around = self.phases[max(k - 1, 0) : k + 1]
        held = [name for name in around[0].footholds if all(name in phase.footholds for phase in around)]
        soles = [name for name in held if self.feet[name].sole is not None] or held
        points = []
        for name in soles:
            place, foot = around[0].footholds[name], self.feet[name]
            middle = np.zeros(3) if foot.sole is None else np.append(foot.sole.center, 0.0)
            points.append((np.asarray(place.position) + np.asarray(place.rotation) @ middle)[:2])
        return np.asarray(np.mean(points, axis=0))

    def in_order(self, stance: Stance, values: Array) -> Array:
        """Joint vectors of a stance in the robot's order. Shape (M, n)."""
        found = np.empty_like(values)
        found[:, self.order(stance)] = values
        return found


def walk(
    start: Mapping[str, Foothold],
    steps: Sequence[tuple[str, Foothold]],
    *,
    shift: float | FreeTime,
    swing: float | FreeTime,
) -> tuple[StancePhase, ...]:
    """The phases of steps, one foot after the other: all held, all but one, all held, ..., all held.

    Args:
        start: Where the feet are.
        steps: Which foot goes where, one after the other.
        shift, swing: Durations of the phases in which all feet are held, and in which one is in the air.

    Raises:
        ProblemError: A foot that has no foothold at the start; none that stays where another goes.
    """
    held = checked_mapping("walk: start", start)
    steps = checked_each("walk: steps", steps, tuple)
    found = [StancePhase(held, shift)]
    for step in steps:
        name, place = step if len(step) == 2 else (step, None)
        if not isinstance(name, str) or name not in held:
            raise unknown_name("foot", name, held)
        rest = {other: at for other, at in held.items() if other != name}
        held = {**rest, name: place}
        found += [StancePhase(rest, swing), StancePhase(held, shift)]
    return tuple(found)
