"""A machine and the stances that it takes one after the other: which feet are held where, and for how long.

Postures of a stance: feet on their footholds, the center of mass where it is wanted, the joints near to others.

A first guess of steps is made of them: from posture to posture, at rest in each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Foot, Foothold, ModelError, Robot, Stance
from models.arrays import Array
from models.paths import rest_to_rest
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, checked_each, checked_instance, checked_mapping, unknown_name
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.checks import checked_horizon, checked_numbers
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask

__all__ = [
    "PLACED",
    "StancePhase",
    "Steps",
    "Swing",
    "check_placed",
    "first_guess",
    "foot_task",
    "hold",
    "standing_configuration",
    "walk",
]


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


PLACED = 1e-6
"""Gap between a foot and its foothold that a start may have, m or rad."""
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-10}


@dataclass(frozen=True)
class ConfigurationSettings:
    """How a standing posture near another is looked for.

    Attributes:
        near: Weight of a joint's square distance from where it was, 1/rad^2.
        over: Weight of the center of mass's, 1/m^2: a centimetre as a tenth of a radian and less.
        kept: Gap between a foot and its foothold, m or rad, that a posture may have.
        steps: Of the guess of a step.
    """

    near: float = 1.0
    over: float = 300.0
    kept: float = 1e-9
    steps: int = 40


POSTURES = ConfigurationSettings()


def hold(stance: Stance, places: dict[str, Foothold]) -> TaskEquations:
    """Equations that hold feet besides the first on footholds: in all directions that the joints can move them."""
    tasks = [foot_task(stance, name, place.position, place.rotation) for name, place in places.items()]
    return bind(stance, tasks)


def foot_task(stance: Stance, name: str, position: Any, rotation: Any, **asked: Any) -> TipTask:
    """A foot besides the first, its sole's frame at a place, or on a way, in all directions that it can be moved."""
    foot = stance.feet[name]
    back = np.asarray(foot.rotation).T
    turn = (lambda t: ca.mtimes(rotation(t), back)) if callable(rotation) else np.asarray(rotation) @ back
    return TipTask(
        rows=stance.load_rows[name],
        position=position,
        orientation=turn,
        link=foot.link,
        point=foot.translation,
        **asked,
    )


def standing_configuration(stance: Stance, near: Any, over: Any = None) -> Array:
    """The posture nearest to another that has all feet on their footholds and the center of mass where it is wanted.

    Args:
        stance: Which feet are held where.
        near: Joints, in the stance's order. Shape (n,), rad or m.
        over: (x, y) that the center of mass is wanted over, as near as the joints allow; anywhere if None. m.

    Returns:
        Joints within their limits. Shape (n,).

    Raises:
        ProblemError: No posture within the limits puts the feet there.
    """
    checked_instance("standing_posture: stance", stance, Stance)
    begin = checked_numbers(near, stance.joint_size, "near", "one entry for each joint")
    lower, upper = stance.robot.lower, stance.robot.upper
    begin = np.clip(begin, lower, upper)
    q, none = ca.SX.sym("q", stance.joint_size), ca.DM(0, 1)
    gap: Any = none
    if stance.other_feet:
        equations = hold(stance, {name: stance.footholds[name] for name in stance.other_feet})
        gap = equations.error(none, q, ca.DM(equations.target_function()(0.0)))
    cost = POSTURES.near * ca.sumsqr(q - begin)
    if over is not None:
        wanted = checked_numbers(over, 2, "over", "x and y on the ground")
        cost += POSTURES.over * ca.sumsqr(stance.center_of_mass(q)[:2] - wanted)
    solver = ca.nlpsol("posture", "ipopt", {"x": q, "f": cost, "g": gap}, {"print_time": False, "ipopt": IPOPT})
    found = solver(x0=begin, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
    left = float(np.abs(np.array(found["g"])).max(initial=0.0))
    if not left < POSTURES.kept * 1e3:
        words = (
            f"no posture within the joint limits puts the feet {list(stance.footholds)} on their footholds: the "
            f"nearest that was found is {left:.3g} m or rad away; put them nearer, or start from another posture"
        )
        raise ProblemError(words, name="footholds", value=left, limit=POSTURES.kept)
    return np.asarray(np.clip(np.array(found["x"]).ravel(), lower, upper))


def check_placed(stance: Stance, joints: Array) -> None:
    """Raise ProblemError where joints of a start, in the stance's order, have a foot off its foothold."""
    if not stance.other_feet:
        return
    equations = hold(stance, {name: stance.footholds[name] for name in stance.other_feet})
    found = np.array(ca.DM(equations.error(ca.DM(0, 1), joints, equations.target_function()(0.0))))
    gap = float(np.abs(found).max())
    if gap > PLACED:
        words = (
            f"start_joints: a foot is {gap:.3g} (m or rad) away from its foothold; standing_posture(stance, near) "
            "finds joints that put it there"
        )
        raise ProblemError(words, name="start_joints", value=gap, limit=PLACED)


def first_guess(steps: Steps, start: Array, lift: float) -> list[dict[str, Any]]:
    """Guesses of joints, velocities and accelerations of each phase, in the orders of their stances.

    Args:
        start: Joints at the start, in the robot's order.
        lift: How far above its way a foot is lifted in the middle, m.
    """
    keys, found = [start], []
    for k in range(1, len(steps.phases) + 1):
        keys.append(_keyed(steps, steps.standing(k), keys[-1], steps.balanced(k)))
    for k, phase in enumerate(steps.phases):
        stance = steps.stances[k]
        order = steps.order(stance)
        postures = [keys[k], keys[k + 1]]
        if raised := _raised(steps.swings(k), lift):
            middle = Stance.on(steps.robot, steps.feet, {**phase.footholds, **raised}, steps.gravity)
            aim = (steps.balanced(k) + steps.balanced(k + 1)) / 2
            postures.insert(1, _keyed(steps, middle, (keys[k] + keys[k + 1]) / 2, aim))
        found.append(_through(np.array(postures)[:, order], phase.seconds))
    return found


def _keyed(steps: Steps, stance: Stance, near: Array, over: Array) -> Array:
    """A posture in the robot's order."""
    order = steps.order(stance)
    return np.asarray(steps.in_order(stance, standing_configuration(stance, near[order], over)[None])[0])


def _raised(swings: tuple[Swing, ...], lift: float) -> dict[str, Foothold]:
    """Places of feet in the middle of their way."""
    found = {}
    for swing in swings:
        if swing.lifted is None or swing.landing is None:
            continue
        ends = np.array([swing.lifted.position, swing.landing.position])
        middle = np.append(ends[:, :2].mean(axis=0), ends[:, 2].max())
        found[swing.name] = Foothold(middle + lift * np.asarray(swing.landing.rotation)[:, 2], swing.landing.rotation)
    return found


def _through(postures: Array, seconds: float) -> dict[str, Any]:
    """From posture to posture over a time: quintics from rest to rest, of two pieces a cubic through the middle."""
    share = np.linspace(0.0, 1.0, POSTURES.steps + 1)
    first, last = postures[0], postures[-1]
    values = first + (last - first) * rest_to_rest(share)[:, None]
    if len(postures) == 3:
        bump = 64 * (share * (1 - share)) ** 3
        middle = first + (last - first) * rest_to_rest(0.5)
        values = values + (postures[1] - middle) * bump[:, None]
    times = share * seconds
    rates = np.gradient(values, times, axis=0)
    second = np.gradient(rates, times, axis=0)
    parts = {"joints": values, "velocities": rates, "accelerations": second}
    return {name: Samples(times, part) for name, part in parts.items()}
