"""Stances (sets of feet held on footholds) of a legged machine, standing configurations, and an initial guess.

`Steps` is a sequence of stances, each for some time. `standing_configuration` finds a configuration with the feet on
their footholds and the center of mass over a point, near a given configuration. The first guess of steps interpolates
between such configurations, at rest in each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Foot, Foothold, Robot, Stance
from models.checks import Array
from models.paths import rest_to_rest
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, problem_errors, require
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask


@dataclass(frozen=True, eq=False)
class StancePhase:
    """Part of a motion during which the same feet are held on footholds.

    Attributes:
        footholds: Footholds by the names of the feet; the machine is rooted at the first.
        duration: Duration, s, or FreeTime(...).

    Raises:
        ProblemError: There are no footholds, or the duration is invalid.
    """

    footholds: Mapping[str, Foothold]
    duration: float | FreeTime

    def __post_init__(self) -> None:
        footholds = require.mapping("stance phase: footholds", self.footholds)
        if not footholds:
            raise ProblemError("stance phase: footholds are missing; hold at least one foot", name="footholds")
        for name, foothold in footholds.items():
            require.instance(f"stance phase: foothold of {name!r}", foothold, Foothold)
        if not isinstance(self.duration, FreeTime):
            require.positive("horizon", self.duration)
        object.__setattr__(self, "footholds", footholds)

    @property
    def seconds(self) -> float:
        """Duration of the phase or, if the duration is free, its guess, s."""
        return self.duration.guess if isinstance(self.duration, FreeTime) else float(self.duration)


@dataclass(frozen=True, eq=False)
class Swing:
    """Motion of a foot through the air during a phase."""

    name: str
    lifted: Foothold | None  # foothold that it left; None if it was never held before
    landing: Foothold | None  # foothold on which it lands at the end of the phase; None if it does not land then


@dataclass(frozen=True, eq=False)
class Steps:
    """Robot with its feet and its sequence of stances, in each of which some feet are held on footholds.

    Attributes:
        robot: Robot, rooted anywhere; joint vectors are in its order.
        feet: Feet by name.
        phases: Consecutive stances. The foothold of a foot that is held in two consecutive phases must not change.
        gravity: Acceleration of free fall, m/s^2, downwards.
        balance: "static" requires the centre of mass over the support at all times, except in stances with a grip.
        margin: Distance by which centers of pressure, and a constrained center of mass, stay inside the edges, m. It
            must cover how far the machine leans out on compliant ground and joints, which are rigid here. It needs the
            largest value for motions near edges and corners of a sole, as in a balanced walk.
        clearance: Height of a sole above the ground halfway, m; at the share s of the path 64 s^3 (1 - s)^3 of it.
            Higher ground at the landing rises in the first half of the path, lower ground falls in the second half.

    Raises:
        ProblemError: There are no phases; a foot is unknown; a foothold moves while its foot is held; no foot is held
            from a phase to the next; `Stance.on` refuses a stance.
    """

    robot: Robot
    feet: Mapping[str, Foot]
    phases: Sequence[StancePhase]
    gravity: float = 9.81
    balance: Literal["dynamic", "static"] = "dynamic"
    margin: float = 0.0
    clearance: float = 0.02

    def __post_init__(self) -> None:
        require.instance("steps: robot", self.robot, Robot)
        require.choice("steps: balance", self.balance, ("dynamic", "static"))
        for name in ("margin", "clearance"):
            require.nonnegative(f"steps: {name}", getattr(self, name))
        feet = require.mapping("steps: feet", self.feet)
        phases = require.each("steps: phases", self.phases, StancePhase)
        if not phases:
            raise ProblemError("steps: no phases are given", name="phases")
        for name, foot in feet.items():
            require.instance(f"steps: foot {name!r}", foot, Foot)
        for phase in phases:
            for name in phase.footholds:
                if name not in feet:
                    raise require.unknown("foot", name, feet)
        for k, (before, after) in enumerate(pairwise(phases)):
            both = [name for name in before.footholds if name in after.footholds]
            if not both:
                words = f"steps: no foot is held from phase {k} to phase {k + 1}: the machine would leap"
                raise ProblemError(words, name="phases", value=k)
            for name in both:
                first, second = before.footholds[name], after.footholds[name]
                if np.any(first.position != second.position) or np.any(first.rotation != second.rotation):
                    words = f"steps: foot {name!r} is held from phase {k} to phase {k + 1}, but its foothold moves"
                    raise ProblemError(words, name=name, value=k)
        object.__setattr__(self, "feet", feet)
        object.__setattr__(self, "phases", phases)
        with problem_errors():
            _ = self.stances

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the phases; each consists of a number, from 1, and the names of the feet on the ground."""
        return tuple(f"{k + 1} {' + '.join(phase.footholds)}" for k, phase in enumerate(self.phases))

    @cached_property
    def stances(self) -> tuple[Stance, ...]:
        """Model of the machine in each phase, rooted at the first of the feet on the ground."""
        return tuple(Stance.on(self.robot, self.feet, phase.footholds, self.gravity) for phase in self.phases)

    def order(self, stance: Stance) -> NDArray[np.intp]:
        """Return the permutation from the robot's joint order to that of a stance: q_stance = q[order]. Shape (n,)."""
        return np.array([self.robot.joint_names.index(name) for name in stance.robot.joint_names], dtype=np.intp)

    def swings(self, k: int) -> tuple[Swing, ...]:
        """Return the swings in phase k: motions of feet in the air that stood before or land at the phase's end."""
        swings = []
        for name in self.feet:
            if name in self.phases[k].footholds:
                continue
            past = [phase.footholds[name] for phase in self.phases[:k] if name in phase.footholds]
            after = self.phases[k + 1].footholds.get(name) if k + 1 < len(self.phases) else None
            if past or after is not None:
                swings.append(Swing(name, past[-1] if past else None, after))
        return tuple(swings)

    def standing(self, k: int) -> Stance:
        """Return the stance on all feet that are on the ground just before or just after the start of phase k."""
        footholds: dict[str, Foothold] = {}
        for phase in self.phases[max(k - 1, 0) : k + 1]:
            footholds |= phase.footholds
        return Stance.on(self.robot, self.feet, footholds, self.gravity)

    def balanced(self, k: int) -> Array:
        """Return a balanced position of the center of mass at the start of phase k, over the feet that are not lifted.

        The position is the mean of the centers of their soles, or of their footholds if none has a sole. Shape (2,), m.
        """
        phases = self.phases[max(k - 1, 0) : k + 1]
        feet = [name for name in phases[0].footholds if all(name in phase.footholds for phase in phases)]
        soles = [name for name in feet if self.feet[name].sole is not None] or feet
        points = []
        for name in soles:
            foothold, foot = phases[0].footholds[name], self.feet[name]
            center = np.zeros(3) if foot.sole is None else np.append(foot.sole.center, 0.0)
            points.append((np.asarray(foothold.position) + np.asarray(foothold.rotation) @ center)[:2])
        return np.asarray(np.mean(points, axis=0))

    def in_order(self, stance: Stance, values: Array) -> Array:
        """Reorder joint vectors from the joint order of a stance to the joint order of the robot. Shape (M, n)."""
        reordered = np.empty_like(values)
        reordered[:, self.order(stance)] = values
        return reordered


def walk(
    footholds: Mapping[str, Foothold],
    steps: Sequence[tuple[str, Foothold]],
    *,
    shift: float | FreeTime,
    swing: float | FreeTime,
) -> tuple[StancePhase, ...]:
    """Return the phases of a walk, which alternate between all feet on the ground and one foot in the air.

    Args:
        footholds: Footholds at the start, by foot.
        steps: Foot and new foothold of each step.
        shift, swing: Durations of the phases with all feet held, and with one foot in the air.

    Raises:
        ProblemError: A foot has no foothold at the start, or no foot stays where another moves.
    """
    footholds = require.mapping("walk: footholds", footholds)
    steps = require.each("walk: steps", steps, tuple)
    phases = [StancePhase(footholds, shift)]
    for step in steps:
        name, foothold = step if len(step) == 2 else (step, None)
        if not isinstance(name, str) or name not in footholds:
            raise require.unknown("foot", name, footholds)
        rest = {each: place for each, place in footholds.items() if each != name}
        footholds = {**rest, name: foothold}
        phases += [StancePhase(rest, swing), StancePhase(footholds, shift)]
    return tuple(phases)


PLACEMENT_TOLERANCE = 1e-6  # largest accepted gap between a foot and its foothold at the start, m or rad
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-10}


@dataclass(frozen=True)
class ConfigurationSettings:
    """Settings of the search for a standing configuration."""

    near: float = 1.0  # weight of a joint's squared distance from its initial position, 1/rad^2
    over: float = 300.0  # weight of the squared distance of the center of mass from its goal, 1/m^2
    gap: float = 1e-9  # largest gap between a foot and its foothold, m or rad
    steps: int = 40  # number of time steps in the guess of a phase


CONFIGURATIONS = ConfigurationSettings()


def foothold_equations(stance: Stance, footholds: Mapping[str, Foothold] | None = None) -> TaskEquations:
    """Return the tip task equations that keep feet, by default all feet but the first, on their footholds."""
    if footholds is None:
        footholds = {name: stance.footholds[name] for name in stance.other_feet}
    tasks = [foot_task(stance, name, foothold.position, foothold.rotation) for name, foothold in footholds.items()]
    return bind(stance, tasks)


def foot_task(stance: Stance, name: str, position: Any, rotation: Any, **options: Any) -> TipTask:
    """Return the tip task that prescribes the pose of the sole of a foot, constant or as a function of time."""
    foot = stance.feet[name]
    back = np.asarray(foot.rotation).T
    turn = (lambda t: ca.mtimes(rotation(t), back)) if callable(rotation) else np.asarray(rotation) @ back
    return TipTask(
        rows=stance.load_rows[name],
        position=position,
        orientation=turn,
        link=foot.link,
        point=foot.translation,
        **options,
    )


def standing_configuration(stance: Stance, near: Any, over: Any = None) -> Array:
    """Return the configuration nearest to `near` with all feet on footholds and the center of mass over a point.

    Args:
        stance: Feet and their footholds.
        near: Configuration from which the distance is measured, in the stance's order. Shape (n,), rad or m.
        over: Wanted (x, y) of the center of mass, approached as far as the joints allow; None for anywhere. m.

    Returns:
        Joint positions within their limits. Shape (n,).

    Raises:
        ProblemError: No configuration within the limits puts the feet there.
    """
    require.instance("standing_configuration: stance", stance, Stance)
    begin = require.array("near", near, (stance.joint_size,), meaning="one entry for each joint")
    lower, upper = stance.robot.lower, stance.robot.upper
    begin = np.clip(begin, lower, upper)
    q, none = ca.SX.sym("q", stance.joint_size), ca.DM(0, 1)
    gap: Any = none
    if stance.other_feet:
        equations = foothold_equations(stance)
        gap = equations.error(none, q, ca.DM(equations.target_function()(0.0)))
    cost = CONFIGURATIONS.near * ca.sumsqr(q - begin)
    if over is not None:
        wanted = require.array("over", over, (2,), meaning="x and y on the ground")
        cost += CONFIGURATIONS.over * ca.sumsqr(stance.center_of_mass(q)[:2] - wanted)
    solver = ca.nlpsol("configuration", "ipopt", {"x": q, "f": cost, "g": gap}, {"print_time": False, "ipopt": IPOPT})
    result = solver(x0=begin, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
    left = float(np.abs(np.array(result["g"])).max(initial=0.0))
    if not left < CONFIGURATIONS.gap * 1e3:
        words = f"no configuration within the joint limits puts the feet {list(stance.footholds)} on their footholds: "
        words += f"the nearest one is {left:.3g} m or rad away; move the footholds, or start from other joints"
        raise ProblemError(words, name="footholds", value=left, limit=CONFIGURATIONS.gap)
    return np.asarray(np.clip(np.array(result["x"]).ravel(), lower, upper))


def check_placed(stance: Stance, joints: Array) -> None:
    """Raise ProblemError if a foot is off its foothold in a start configuration, given in the stance's joint order."""
    if not stance.other_feet:
        return
    equations = foothold_equations(stance)
    errors = np.array(ca.DM(equations.error(ca.DM(0, 1), joints, equations.target_function()(0.0))))
    gap = float(np.abs(errors).max())
    if gap > PLACEMENT_TOLERANCE:
        words = f"start: a foot is {gap:.3g} (m or rad) away from its foothold; standing_configuration(stance, near) "
        words += "finds joints that put it there"
        raise ProblemError(words, name="start", value=gap, limit=PLACEMENT_TOLERANCE)


def first_guess(steps: Steps, start: Array, lift: float) -> list[dict[str, Any]]:
    """Return initial guesses of the joint positions, velocities and accelerations in each phase, in stance joint order.

    Halfway, a foot is `lift` (m) above the line between its footholds. `start` is in the robot's joint order.
    """
    ends, guesses = [start], []
    for k in range(1, len(steps.phases) + 1):
        ends.append(_configuration(steps, steps.standing(k), ends[-1], steps.balanced(k)))
    for k, phase in enumerate(steps.phases):
        order = steps.order(steps.stances[k])
        configurations = [ends[k], ends[k + 1]]
        if raised := _raised_poses(steps.swings(k), lift):
            middle = Stance.on(steps.robot, steps.feet, {**phase.footholds, **raised}, steps.gravity)
            over = (steps.balanced(k) + steps.balanced(k + 1)) / 2
            configurations.insert(1, _configuration(steps, middle, (ends[k] + ends[k + 1]) / 2, over))
        guesses.append(_interpolate(np.array(configurations)[:, order], phase.seconds))
    return guesses


def _configuration(steps: Steps, stance: Stance, near: Array, over: Array) -> Array:
    """Return a balanced configuration in a stance, near a given one; both are in the joint order of the robot."""
    joints = standing_configuration(stance, near[steps.order(stance)], over)
    return np.asarray(steps.in_order(stance, joints[None])[0])


def _raised_poses(swings: tuple[Swing, ...], lift: float) -> dict[str, Foothold]:
    """Return the poses of swinging feet, keyed by foot name, when they are raised midway between two footholds."""
    raised = {}
    for swing in swings:
        if swing.lifted is None or swing.landing is None:
            continue
        ends = np.array([swing.lifted.position, swing.landing.position])
        middle = np.append(ends[:, :2].mean(axis=0), ends[:, 2].max())
        raised[swing.name] = Foothold(middle + lift * np.asarray(swing.landing.rotation)[:, 2], swing.landing.rotation)
    return raised


def _interpolate(configurations: Array, seconds: float) -> dict[str, Any]:
    """Return a smooth rest-to-rest motion through 2 or 3 configurations (k, n) as a guess of joint variables."""
    share = np.linspace(0.0, 1.0, CONFIGURATIONS.steps + 1)
    first, last = configurations[0], configurations[-1]
    values = first + (last - first) * rest_to_rest(share)[:, None]
    if len(configurations) == 3:
        bump = 64 * (share * (1 - share)) ** 3
        middle = first + (last - first) * rest_to_rest(0.5)
        values = values + (configurations[1] - middle) * bump[:, None]
    times = share * seconds
    rates = np.gradient(values, times, axis=0)
    parts = {"joints": values, "velocities": rates, "accelerations": np.gradient(rates, times, axis=0)}
    return {name: Samples(times, part) for name, part in parts.items()}
