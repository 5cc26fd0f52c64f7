"""Postures of a stance: feet on their footholds, the center of mass where it is wanted, the joints near to others.

A first guess of steps is made of them: from posture to posture, at rest in each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import Foothold, Stance
from models.arrays import Array
from models.paths import rest_to_rest
from ocp.builders.standing.stances import Steps, Swing
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, checked_instance
from ocp.tasks.checks import checked_numbers
from ocp.tasks.equations import TaskEquations, bind
from ocp.tasks.tip_task import TipTask

__all__ = ["PLACED", "check_placed", "first_guess", "foot_task", "hold", "standing_posture"]

PLACED = 1e-6
"""Gap between a foot and its foothold that a start may have, m or rad."""
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-10}


@dataclass(frozen=True)
class PostureSettings:
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


POSTURES = PostureSettings()


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
        rows=stance.held_rows[name],
        position=position,
        orientation=turn,
        link=foot.link,
        point=foot.translation,
        **asked,
    )


def standing_posture(stance: Stance, near: Any, over: Any = None) -> Array:
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
    if stance.others:
        equations = hold(stance, {name: stance.footholds[name] for name in stance.others})
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
    if not stance.others:
        return
    equations = hold(stance, {name: stance.footholds[name] for name in stance.others})
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
    return np.asarray(steps.in_order(stance, standing_posture(stance, near[order], over)[None])[0])


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
