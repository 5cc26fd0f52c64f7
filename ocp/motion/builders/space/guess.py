"""Where a capture begins to be looked for: motions that obey the dynamics and end in the grasp, or at rest.

The target's motion is known, whatever the chaser does. Towards it the tip goes by the pseudo-inverse of the generalized
Jacobian, damped, from its own start onto the way of the frame that is grasped, beside it at first, along the axis of
the approach at last. After the grasp the arm slows down evenly while the wheels take the momentum.

Why there is no capture, said before one is planned: bounds that hold whatever the chaser does.

The grasp may be farther off than the arm reaches. And both may have more momentum than the wheels hold: a wheel holds
h a along its axis a, |h| <= I w, and no more than its motor gives it in the time. Turned, the base brings the momentum
along any axis of its own: what counts is the largest sum of all h a.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from models import FreeFloating, Robot, center_of_mass, find_wheels, link_frames
from models.arrays import Array
from ocp.errors import ProblemError
from ocp.motion.builders.dynamics import QUINTIC
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem
from ocp.problem.values import constant

__all__ = [
    "Start",
    "free_motion",
    "guess_approach",
    "guess_braking",
    "guessed",
    "held_by_wheels",
    "require_reach",
    "require_room",
]

Guesses = dict[str, Any]
"""Functions of the time, by the names of states and controls."""


@dataclass(frozen=True)
class GuessSettings:
    """How a capture's first guess is made.

    Attributes:
        steps: Of a motion.
        durations: Of a free time: that many are tried, evenly spread by their logarithms.
        reached: How near the tip has to come, m and rad.
        met: Fraction of the approach after which the tip moves with the target.
        nearing: Fraction of the approach after which the tip comes nearer to the grasp.
        damping: Of the pseudo-inverse, m and 1.
        rounds: Newton steps for the speeds of the wheels at the end, which the attitude depends on.
    """

    steps: int = 200
    durations: int = 9
    reached: float = 1e-3
    met: float = 0.75
    nearing: float = 0.5
    damping: float = 0.05
    rounds: int = 4


GUESS = GuessSettings()


def free_motion(target: FreeFloating, base: Array, times: Array) -> Array:
    """Configurations (M, base_size) of a body that nothing acts on, at evenly spaced times (M,), s.

    By Runge and Kutta's rule of order four.
    """
    b, step, none = ca.SX.sym("b", target.base_size), times[1] - times[0], ca.DM(0, 1)
    rate = ca.Function("rate", [b], [target.base_rate(b, none, none)])
    k1 = rate(b)
    k2 = rate(b + step / 2 * k1)
    k3 = rate(b + step / 2 * k2)
    k4 = rate(b + step * k3)
    after = ca.Function("after", [b], [b + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    moved = after.mapaccum(len(times) - 1)(base)
    return np.vstack([base, np.array(moved).T])


def guess_approach(
    problem: Problem, chaser: FreeFloating, target: FreeFloating, joints: Array, rates: Array, base: Array,
    target_base: Array, out: Array,
) -> None:  # fmt: skip
    """Give an approach its guess, and a free time that of some which ends in the grasp, or nearest to it.

    Args:
        joints, rates, base, target_base: At the start.
        out: From where the tip comes to the grasp at last, in the frame that is grasped. Shape (3,), m.
    """
    horizon = problem.declared.horizon
    assert horizon is not None
    first = guessed(problem)
    tries = [first]
    if not horizon.fixed:
        spread = np.geomspace(constant(horizon.lower)[0], constant(horizon.upper)[0], GUESS.durations)
        tries += sorted(spread, key=lambda duration: abs(np.log(duration / first)))
    nearest = np.inf
    walker = _Walker(problem, chaser, rates)
    for duration in tries:
        times = np.linspace(0.0, duration, GUESS.steps + 1)
        bases = free_motion(target, target_base, times)
        way = _way_of_tip(chaser, target, times, bases, (joints, base), out)
        gap, guesses = walker.along(times, way, joints, base)
        if gap < nearest:
            nearest = gap
            tell(problem, duration, {**guesses, "target": _curve(times, bases)})
        if gap < GUESS.reached:
            return


class _Walker:
    """Takes the tip of a machine along a way, step by step."""

    def __init__(self, problem: Problem, machine: FreeFloating, rates: Array) -> None:
        n, robot = machine.joint_size, machine.robot
        self.rows = machine.twist_rows
        carrying = {joint.name for joint in robot.path_to(str(robot.tip_link))}
        self.arm = [k for k, name in enumerate(robot.joint_names) if name in carrying]
        self.rates = rates
        b, q, v = (ca.SX.sym("z", size) for size in (machine.base_size, n, n))
        tip = machine.tip_pose(b, q)
        jacobian, drift = machine.tip_jacobian(b, q)[self.rows, self.arm], machine.tip_twist(b, q, v)[self.rows]
        self.look = ca.Function("look", [b, q, v], [tip.position, tip.rotation, jacobian, drift])
        self.step = _stepper(machine)
        states = problem.declared.states
        self.low, self.high = (constant(getattr(states["joints"], side)) for side in ("lower", "upper"))
        self.fastest = constant(states["velocities"].upper)

    def along(self, times: Array, way: tuple[Array, Array], joints: Array, base: Array) -> tuple[float, Guesses]:
        """How far from the end of the way the tip comes, m and rad, and the guesses; wheels turn as they do."""
        places, turns = way
        step = times[1]
        speed = self.rates.copy()
        speed[self.arm] = 0.0
        drifting = speed
        found, moving = [(joints, base)], []
        for k in range(GUESS.steps):
            at, home = found[-1]
            position, rotation, matrix, drift = (np.array(part) for part in self.look(home, at, drifting))
            gap = _gap(places[k + 1], turns[k + 1], position, rotation)[self.rows]
            square = matrix @ matrix.T + GUESS.damping**2 * np.eye(len(self.rows))
            speed = drifting.copy()
            speed[self.arm] = matrix.T @ np.linalg.solve(square, gap / step - drift.ravel())
            speed = np.clip(speed, -self.fastest, self.fastest)
            speed = (np.clip(at + step * speed, self.low, self.high) - at) / step
            moving.append(speed)
            found.append((at + step * speed, self.step(step, home, at, speed)))
        at, home = found[-1]
        position, rotation, *_ = (np.array(part) for part in self.look(home, at, drifting))
        left = _gap(places[-1], turns[-1], position, rotation)[self.rows]
        angles, poses = (np.array(part) for part in zip(*found, strict=True))
        return float(np.abs(left).max()), _motion(times, angles, np.array([self.rates, *moving]), poses)


def _gap(place: Array, turn: Array, position: Array, rotation: Array) -> Array:
    """(Turn, way) from one pose to another, world axes. Shape (6,)."""
    return np.concatenate([Rotation.from_matrix(turn @ rotation.T).as_rotvec(), place - position.ravel()])


def _way_of_tip(
    chaser: FreeFloating, target: FreeFloating, times: Array, bases: Array, start: tuple[Array, Array], out: Array
) -> tuple[Array, Array]:
    """Places (M, 3) and axes (M, 3, 3) of the tip: from rest where it is onto the frame that is grasped."""
    b = ca.SX.sym("b", target.base_size)
    pose = target.tip_pose(b, ca.DM(0, 1))
    look = ca.Function("look", [b], [pose.position, ca.vec(pose.rotation)])

    def frames(configurations: Array) -> tuple[Array, Rotation]:
        place, turn = (np.array(part).T for part in look.map(len(configurations))(configurations.T))
        return place, Rotation.from_matrix(turn.reshape(-1, 3, 3).transpose(0, 2, 1))

    share = times / times[-1]
    meeting, nearer = (
        QUINTIC(np.clip(share / GUESS.met, 0, 1)),
        QUINTIC(np.clip((share - GUESS.nearing) / (1 - GUESS.nearing), 0, 1)),
    )
    grasped, turned = frames(bases)
    own = chaser.tip_pose(start[1], start[0])
    first, axes = np.array(ca.DM(own.position)).ravel(), Rotation.from_matrix(np.array(ca.DM(own.rotation)))
    beside = grasped + (1 - nearer[:, None]) * turned.apply(out)
    places = first + meeting[:, None] * (beside - first)
    # onto the attitude at the end, and with it as it was a while before, which is none at last
    before = times[-1] - meeting * (times[-1] - times)
    then = frames(np.column_stack([np.interp(before, times, column) for column in bases.T]))[1]
    vector = (axes.inv() * turned[-1]).as_rotvec()
    turns = axes * Rotation.from_rotvec(meeting[:, None] * vector) * turned[-1].inv() * then
    return places, turns.as_matrix()


def guess_braking(problem: Problem, pair: FreeFloating, joints: Array, rates: Array, base: Array) -> None:
    """Give a detumbling its guess from where it starts: the arm slows down evenly, wheels take the momentum.

    Which speeds of the wheels hold it follows by Newton's method: the attitude at the end depends on them.
    """
    robot, duration = pair.robot, guessed(problem)
    times = np.linspace(0.0, duration, GUESS.steps + 1)
    share = times[:, None] / duration
    slowing = 1 - 3 * share**2 + 2 * share**3
    way = (share - share**3 + share**4 / 2) * duration
    names, wheels = robot.joint_names, find_wheels(robot)
    turning = [k for k, name in enumerate(names) if name in wheels]
    angular = [k for k, row in enumerate(pair.twist_rows) if row < 3]
    b, q, v = (ca.SX.sym("z", size) for size in (pair.base_size, len(joints), len(joints)))
    held = ca.mtimes(pair.momentum_matrices(b, q)[1], v)[angular]
    look = ca.Function("look", [b, q, v], [held, ca.jacobian(held, v)[:, turning]])
    last = np.zeros(len(joints))
    step = _stepper(pair)
    for _ in range(GUESS.rounds if wheels else 1):
        speeds = last + slowing * (rates - last)
        angles = joints + last * times[:, None] + way * (rates - last)
        found = [base]
        for k in range(GUESS.steps):
            middle = (angles[k] + angles[k + 1]) / 2, (speeds[k] + speeds[k + 1]) / 2
            found.append(step(times[1], found[-1], *middle))
        have, matrix = (np.array(part) for part in look(found[-1], angles[-1], last))
        last[turning] += np.linalg.pinv(matrix) @ (np.asarray(pair.conserved_momentum)[angular] - have.ravel())
    tell(problem, duration, _motion(times, angles, speeds, np.array(found)))


def _stepper(machine: FreeFloating) -> Any:
    """The configuration of the base after a step of Heun's rule with joints and rates as they are."""
    b, q, v = (ca.SX.sym("z", size) for size in (machine.base_size, machine.joint_size, machine.joint_size))
    step = ca.SX.sym("step")
    rate = ca.Function("rate", [b, q, v], [machine.base_rate(b, q, v)])
    first = rate(b, q, v)
    after = b + step / 2 * (first + rate(b + step * first, q, v))
    if machine.base == "spatial":
        after = ca.vertcat(after[:3], after[3:] / ca.norm_2(after[3:]))
    function = ca.Function("after", [step, b, q, v], [after])
    return lambda *given: np.array(function(*given)).ravel()


def _motion(times: Array, joints: Array, velocities: Array, base: Array) -> Guesses:
    second = np.gradient(velocities, times, axis=0)
    found = {"joints": joints, "velocities": velocities, "accelerations": second, "base": base}
    return {name: _curve(times, samples) for name, samples in found.items()}


def _curve(times: Array, samples: Array) -> Any:
    return lambda t: np.column_stack([np.interp(t, times, column) for column in samples.T])


def guessed(problem: Problem) -> float:
    """The horizon, or what is guessed of it, s."""
    horizon = problem.declared.horizon
    assert horizon is not None
    return float(constant(horizon.lower)[0]) if horizon.guess is None else float(horizon.guess)


def tell(problem: Problem, duration: float, guesses: Guesses) -> None:
    """Give a problem the guess of its horizon, where that is free, and those of states and controls, by name."""
    declared = problem.declared
    assert declared.horizon is not None
    if not declared.horizon.fixed:
        declared.horizon = replace(declared.horizon, guess=float(duration))
    for name, guess in guesses.items():
        for pool in (declared.states, declared.controls):
            if name in pool:
                pool[name] = replace(pool[name], guess=guess)


ROUNDING = 1e-9
"""Relative; and N m s of a momentum."""


class Start(NamedTuple):
    """Where a capture begins, and until when it may take.

    Attributes:
        base, joints, velocities: Of the chaser; velocities that are free are nan.
        target_base: Configuration of the target.
        approach, detumble: How long the phases last at most, s.
    """

    base: Array
    joints: Array
    velocities: Array
    target_base: Array
    approach: float
    detumble: float


def held_by_wheels(machine: FreeFloating, bounds: JointBounds, start: Start, drives_alone: bool = True) -> float:
    """The largest angular momentum that the wheels of a chaser hold while its base rests, N m s.

    Args:
        bounds: Of its joints.
        start: Of the capture.
        drives_alone: Whether nothing but its motor turns a wheel about its axis: there is no friction.
    """
    robot, time = machine.robot, start.approach + start.detumble
    known = drives_alone and not np.isnan(start.velocities).any()
    spin = np.zeros(6)
    if known:
        twist = np.array(ca.DM(machine.base_twist(start.base, start.joints, start.velocities))).ravel()
        spin[machine.twist_rows] = twist
    spin = np.array(ca.DM(machine.world_from_base(start.base).rotation)).T @ spin[:3]
    frames, free, sides = link_frames(robot, ca.DM(start.joints)), 0.0, [np.zeros(3)]
    for name, inertia in find_wheels(robot).items():
        wheel, k = robot.joint(name), robot.joint_names.index(name)
        size = inertia * bounds.velocity[k]
        if any(joint.moves for joint in robot.path_to(wheel.parent)):  # the arm turns it to any side
            free += size
            continue
        axis = np.array(ca.DM(frames[wheel.parent].rotation)) @ np.asarray(wheel.rotation) @ np.asarray(wheel.axis)
        if known:
            size = min(size, inertia * abs(start.velocities[k] + axis @ spin) + bounds.torque[k] * time)
        if not np.isfinite(size):
            return np.inf
        side = size * (axis if machine.base == "spatial" else axis * [0.0, 0.0, 1.0])
        sides = [corner + sign * side for corner in sides for sign in (1.0, -1.0)]
    return float(free + np.linalg.norm(sides, axis=1).max())


def require_room(machine: FreeFloating, momentum: Array, held: float) -> None:
    """Raise where wheels cannot hold the angular momentum, whatever the attitude of the base at the end.

    Args:
        momentum: Of both, at the start, as of `pair_momentum`.
        held: What the wheels hold at most, N m s.
    """
    angular = [k for k, row in enumerate(machine.twist_rows) if row < 3]
    size = float(np.linalg.norm(np.asarray(momentum)[angular]))
    if size > held * (1 + ROUNDING) + ROUNDING:
        words = (
            f"capture: the pair has an angular momentum of {size:.6g} N m s, of which the wheels hold {held:.6g} at "
            f"most: {size - held:.6g} N m s are missing for it to come to rest. Other wheels, more time, momentum of "
            "the chaser against that of the target, or rest=False help"
        )
        raise ProblemError(words, name="momentum", value=size, limit=held)


def require_reach(chaser: FreeFloating, target: FreeFloating, start: Start, earliest: float) -> None:
    """Raise where the grasp is too far off for the arm at any time.

    Both centres of mass go on as they do, w + v t. The tip is no farther from the chaser's centre of mass than all
    joints in a line take it.

    Args:
        start: With the latest time of the grasp. earliest: The earliest, s.
    """
    arm = _arm(chaser, target)
    way, drift = _apart(chaser, target, start)
    nearest = -(way @ drift) / (drift @ drift) if drift.any() else earliest
    off = float(np.linalg.norm(way + drift * np.clip(nearest, earliest, start.approach)))
    if off > arm * (1 + ROUNDING):
        words = (
            f"capture: the centres of mass of chaser and target are {off:.4g} m apart or more, and the arm reaches "
            f"{arm:.4g} m at most: {off - arm:.4g} m are missing. Start nearer, or let them drift together"
        )
        raise ProblemError(words, name="reach", value=off, limit=arm)


def _apart(chaser: FreeFloating, target: FreeFloating, start: Start) -> tuple[Array, Array]:
    """From the chaser's centre of mass to the target's, m, and how fast that changes. Shape (3,) each."""
    centers, speeds = [], []
    for machine, base, joints in ((target, start.target_base, np.zeros(0)), (chaser, start.base, start.joints)):
        center = center_of_mass(machine.robot, ca.DM(joints), machine.world_from_base(ca.DM(base)))
        centers.append(np.array(ca.DM(center)).ravel())
        momentum = np.eye(6)[:, machine.twist_rows] @ np.asarray(machine.conserved_momentum)
        speeds.append(momentum[3:] / machine.robot.total_mass)
    return centers[0] - centers[1], speeds[0] - speeds[1]


def _arm(chaser: FreeFloating, target: FreeFloating) -> float:
    """How far apart the centres of mass of both are at most while the tip holds the grasp, m."""
    robot, body = chaser.robot, target.robot
    middle = sum(link.mass * _longest(robot, link.name, link.center_of_mass) for link in robot.links if link.mass)
    arm = _longest(robot, str(robot.tip_link), robot.tip_translation) + middle / robot.total_mass
    return arm + float(np.linalg.norm(np.subtract(body.tip_translation, body.links[0].center_of_mass)))


def _longest(robot: Robot, link: str, point: object) -> float:
    """How far a point of a link is from the root's origin at most, m; inf beyond a slide without limits."""
    found = float(np.linalg.norm(np.asarray(point, dtype=float)))
    for joint in robot.path_to(link):
        slides = max(abs(joint.lower), abs(joint.upper)) if joint.kind == "prismatic" else 0.0
        found += float(np.linalg.norm(joint.translation)) + slides
    return found
