"""Chaser and target of a capture: their model as one machine, tests for impossible captures, and the initial guess.

The twists match at the grasp, so that there is no impact. The linear momentum of the pair, and the angular momentum
about its common centre of mass, are

    P = P1 + P2,    L = L1 + L2 + (c2 - c1) x (m1 P2 - m2 P1) / (m1 + m2).

Two bounds hold for any motion of the chaser. The grasp may be out of reach of the arm. And the momentum of both may
exceed what the wheels store: a wheel of inertia I and speed limit w stores h a along its axis a with |h| <= I w, and no
more than its motor gives it in the time. The base can turn to align the momentum with any of its axes; hence the
largest norm of the sum of all h a counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from models import FreeFloating, ModelError, Robot, attach_tool, center_of_mass, find_wheels, link_frames
from models.checks import Array
from models.machines.machine import with_tip
from models.spatial import Expression, cross
from ocp.curves import rk4_step
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, require
from ocp.motion.builders.dynamics import QUINTIC
from ocp.motion.tasks.checks import chain_length
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem
from ocp.problem.values import constant


def join_target(chaser: Robot, target: Robot) -> Robot:
    """Attach the target to the chaser's robot as an additional link; the tip frames of both robots coincide."""
    turn = np.asarray(target.tip_rotation).T
    shift = -turn @ np.asarray(target.tip_translation)
    return attach_tool(chaser, target, None, shift, rotation=turn, keep_tip=True)


def checked_pair(chaser: Any, target: Any) -> Robot:
    """Check a chaser and its target, and return them as one robot, joined at their tip frames."""
    for name, machine in (("chaser", chaser), ("target", target)):
        if require.instance(f"capture: {name}", machine, FreeFloating).robot.tip is None:
            raise ProblemError(f"capture: the robot of the {name} needs a tip", name=name, value=machine)
    if target.base != chaser.base:
        words = f"capture: the chaser floats on a {chaser.base} base, the target on a {target.base} one"
        raise ProblemError(words, name="target", value=target.base, limit=chaser.base)
    if target.joint_size or len(target.robot.links) != 1:
        words = "capture: the target must be one body without joints; use simplify(lock_joints(robot, ...))"
        raise ProblemError(words, name="target", value=target)
    if not chaser.joint_size:
        raise ProblemError("capture: the chaser has no joints to reach with", name="chaser", value=chaser)
    try:
        return join_target(chaser.robot, target.robot)
    except ModelError as error:
        raise ProblemError(f"capture: {error}", name="target", value=error.value) from error


def pair_momentum(
    chaser: FreeFloating, target: FreeFloating, *, base: Any, target_base: Any, joints: Any
) -> Expression:
    """Return the `conserved_momentum` of chaser and target together, about their common centre of mass."""
    rows = ca.DM.eye(6)[:, chaser.twist_rows]
    own = rows @ ca.vertcat(chaser.conserved_momentum)
    theirs = rows @ ca.vertcat(target.conserved_momentum)
    m1, m2 = chaser.robot.total_mass, target.robot.total_mass
    arm = center_of_mass(target.robot, ca.DM(0, 1), target.world_from_base(target_base))
    arm -= center_of_mass(chaser.robot, joints, chaser.world_from_base(base))
    crossed = cross(arm, (m1 * theirs[3:6] - m2 * own[3:6]) / (m1 + m2))
    return ca.vertcat(own[0:3] + theirs[0:3] + crossed, own[3:6] + theirs[3:6])[chaser.twist_rows]


def motion_of(problem: Problem) -> tuple[Any, Any, Any]:
    """Return the symbols of a problem's states: base configuration, joint positions and joint velocities."""
    states = problem.declared.states
    return states["base"].symbol, states["joints"].symbol, states["velocities"].symbol


def grasp_wrench(pair: FreeFloating, target: FreeFloating, problem: Problem) -> tuple[Any, Any]:
    """Return force and moment (3, 1) about the tip that the hand exerts on the target, in world axes.

    They are the rates of the target's momentum, m c'' and (I w)' about its centre of mass.
    """
    base, joints, rates = motion_of(problem)
    body = target.robot.links[0]
    middle = with_tip(pair, body.name, body.center_of_mass)
    center, twist = middle.tip_pose(base, joints), middle.tip_twist(base, joints, rates)
    inertia = ca.mtimes([center.rotation, ca.DM(np.asarray(body.inertia)), center.rotation.T])
    at = ca.vertcat(base, joints, rates)
    state_rates = ca.vertcat(*(problem.declared.dynamics[name] for name in ("base", "joints", "velocities")))
    rate = ca.jtimes(ca.vertcat(ca.mtimes(inertia, twist[0:3]), body.mass * twist[3:6]), at, state_rates)
    arm = center.position - pair.tip_pose(base, joints).position
    return rate[3:6], rate[0:3] + cross(arm, rate[3:6])


Guesses = dict[str, Samples]  # by the names of states and controls


@dataclass(frozen=True)
class GuessSettings:
    """Settings of the initial guess of a capture."""

    steps: int = 200  # integration steps of a motion
    durations: int = 9  # number of durations tried if the time is free, evenly spaced in their logarithms
    tolerance: float = 1e-3  # distance to the grasp that counts as reached, m and rad
    meeting: float = 0.75  # fraction of the approach after which the tip moves with the target
    closing: float = 0.5  # fraction of the approach after which the tip approaches the grasp along the axis
    damping: float = 0.05  # damping of the pseudo-inverse, m and 1
    newton_steps: int = 4  # newton steps for the final wheel speeds, which depend on the final attitude


GUESS = GuessSettings()


def free_motion(target: FreeFloating, base: Array, times: Array) -> Array:
    """Return the configurations (M, base_size) of a freely floating body at evenly spaced times (M,), s."""
    b, step, none = ca.SX.sym("b", target.base_size), times[1] - times[0], ca.DM(0, 1)
    rate = ca.Function("rate", [b], [target.base_rate(b, none, none)])
    after = ca.Function("after", [b], [rk4_step(lambda _, x: rate(x), b, step)])
    return np.vstack([base, np.array(after.mapaccum(len(times) - 1)(base)).T])


def guess_approach(problem: Problem, chaser: FreeFloating, target: FreeFloating, start: State, *, out: Array) -> None:
    """Set the initial guess of an approach; if its duration is free, try several until the tip gets to the grasp.

    The tip moves by the damped pseudo-inverse of the generalized Jacobian onto the path of the grasped frame, first
    beside it at the offset `out` (3,), m, in this frame, at last along the approach axis. The guess obeys the dynamics.
    """
    joints, base = start.joints, start.base
    horizon = problem.declared.horizon
    assert horizon is not None
    first = guessed_horizon(problem)
    durations = [first]
    if not horizon.fixed:
        trials = np.geomspace(constant(horizon.lower)[0], constant(horizon.upper)[0], GUESS.durations)
        durations += sorted(trials, key=lambda duration: abs(np.log(duration / first)))
    nearest = np.inf
    tracker = _TipTracker(problem, chaser, np.nan_to_num(start.velocities))
    for duration in durations:
        times = np.linspace(0.0, duration, GUESS.steps + 1)
        bases = free_motion(target, start.target_base, times)
        path = _tip_path(chaser, target, times, bases, (joints, base), out)
        gap, guesses = tracker.follow(times, path, joints, base)
        if gap < nearest:
            nearest = gap
            set_guess(problem, duration, {**guesses, "target": Samples(times, bases)})
        if gap < GUESS.tolerance:
            return


class _TipTracker:
    """Step-by-step tracker of a tip path that uses the damped pseudo-inverse of the generalized Jacobian."""

    def __init__(self, problem: Problem, machine: FreeFloating, rates: Array) -> None:
        n, robot = machine.joint_size, machine.robot
        self.rows = machine.twist_rows
        carrying = {joint.name for joint in robot.path_to(str(robot.tip_link))}
        self.arm = [k for k, name in enumerate(robot.joint_names) if name in carrying]
        self.rates = rates
        b, q, v = (ca.SX.sym("z", size) for size in (machine.base_size, n, n))
        tip = machine.tip_pose(b, q)
        jacobian, drift = machine.tip_jacobian(b, q)[self.rows, self.arm], machine.tip_twist(b, q, v)[self.rows]
        self.kinematics = ca.Function("kinematics", [b, q, v], [tip.position, tip.rotation, jacobian, drift])
        self.step = _stepper(machine)
        states = problem.declared.states
        self.low, self.high = (constant(getattr(states["joints"], side)) for side in ("lower", "upper"))
        self.fastest = constant(states["velocities"].upper)

    def follow(self, times: Array, path: tuple[Array, Array], joints: Array, base: Array) -> tuple[float, Guesses]:
        """Track a tip path while reaction wheels keep their speeds; return the pose error, m or rad, and a guess."""
        places, turns = path
        step = times[1]
        speed = self.rates.copy()
        speed[self.arm] = 0.0
        drifting = speed
        configurations, speeds = [(joints, base)], []
        for k in range(GUESS.steps):
            at, home = configurations[-1]
            position, rotation, matrix, drift = (np.array(part) for part in self.kinematics(home, at, drifting))
            gap = _pose_gap(places[k + 1], turns[k + 1], position, rotation)[self.rows]
            square = matrix @ matrix.T + GUESS.damping**2 * np.eye(len(self.rows))
            speed = drifting.copy()
            speed[self.arm] = matrix.T @ np.linalg.solve(square, gap / step - drift.ravel())
            speed = np.clip(speed, -self.fastest, self.fastest)
            speed = (np.clip(at + step * speed, self.low, self.high) - at) / step
            speeds.append(speed)
            configurations.append((at + step * speed, self.step(step, home, at, speed)))
        at, home = configurations[-1]
        position, rotation, *_ = (np.array(part) for part in self.kinematics(home, at, drifting))
        left = _pose_gap(places[-1], turns[-1], position, rotation)[self.rows]
        angles, poses = (np.array(part) for part in zip(*configurations, strict=True))
        return float(np.abs(left).max()), _guesses_of_motion(times, angles, np.array([self.rates, *speeds]), poses)


def _pose_gap(place: Array, turn: Array, position: Array, rotation: Array) -> Array:
    """Return rotation vector and displacement, rad and m, from an actual to a desired tip pose in world. Shape (6,)."""
    turned = scipy.spatial.transform.Rotation.from_matrix(turn @ rotation.T)
    return np.concatenate([turned.as_rotvec(), place - position.ravel()])


def _tip_path(
    chaser: FreeFloating, target: FreeFloating, times: Array, bases: Array, start: tuple[Array, Array], out: Array
) -> tuple[Array, Array]:
    """Return tip positions (M, 3) and rotations (M, 3, 3) on a path from rest to the grasp, for an initial guess."""
    b = ca.SX.sym("b", target.base_size)
    pose = target.tip_pose(b, ca.DM(0, 1))
    pose_at = ca.Function("pose", [b], [pose.position, ca.vec(pose.rotation)])

    def frames(configurations: Array) -> tuple[Array, Any]:
        place, turn = (np.array(part).T for part in pose_at.map(len(configurations))(configurations.T))
        return place, scipy.spatial.transform.Rotation.from_matrix(turn.reshape(-1, 3, 3).transpose(0, 2, 1))

    share = times / times[-1]
    meeting, nearer = (
        QUINTIC(np.clip(share / GUESS.meeting, 0, 1)),
        QUINTIC(np.clip((share - GUESS.closing) / (1 - GUESS.closing), 0, 1)),
    )
    grasped, turned = frames(bases)
    own = chaser.tip_pose(start[1], start[0])
    first = np.array(ca.DM(own.position)).ravel()
    axes = scipy.spatial.transform.Rotation.from_matrix(np.array(ca.DM(own.rotation)))
    beside = grasped + (1 - nearer[:, None]) * turned.apply(out)
    places = first + meeting[:, None] * (beside - first)
    # turn to the final attitude, composed with the target's turn since an earlier time, which vanishes at the end
    before = times[-1] - meeting * (times[-1] - times)
    then = frames(np.column_stack([np.interp(before, times, column) for column in bases.T]))[1]
    vector = (axes.inv() * turned[-1]).as_rotvec()
    turns = axes * scipy.spatial.transform.Rotation.from_rotvec(meeting[:, None] * vector) * turned[-1].inv() * then
    return places, turns.as_matrix()


def guess_braking(problem: Problem, pair: FreeFloating, begin: tuple[Array, Array, Array]) -> None:
    """Set the initial guess of a detumbling: the arm slows down smoothly while the wheels take up the momentum.

    The final wheel speeds follow from Newton's method, because the final attitude depends on them.
    """
    joints, rates, base = begin
    robot, duration = pair.robot, guessed_horizon(problem)
    times = np.linspace(0.0, duration, GUESS.steps + 1)
    share = times[:, None] / duration
    slowing = 1 - 3 * share**2 + 2 * share**3
    distance = (share - share**3 + share**4 / 2) * duration
    names, wheels = robot.joint_names, find_wheels(robot)
    turning = [k for k, name in enumerate(names) if name in wheels]
    angular = [k for k, row in enumerate(pair.twist_rows) if row < 3]
    b, q, v = (ca.SX.sym("z", size) for size in (pair.base_size, len(joints), len(joints)))
    momentum = ca.mtimes(pair.momentum_matrices(b, q)[1], v)[angular]
    momentum_at = ca.Function("momentum", [b, q, v], [momentum, ca.jacobian(momentum, v)[:, turning]])
    last = np.zeros(len(joints))
    step = _stepper(pair)
    for _ in range(GUESS.newton_steps if wheels else 1):
        speeds = last + slowing * (rates - last)
        angles = joints + last * times[:, None] + distance * (rates - last)
        bases = [base]
        for k in range(GUESS.steps):
            middle = (angles[k] + angles[k + 1]) / 2, (speeds[k] + speeds[k + 1]) / 2
            bases.append(step(times[1], bases[-1], *middle))
        current, matrix = (np.array(part) for part in momentum_at(bases[-1], angles[-1], last))
        last[turning] += np.linalg.pinv(matrix) @ (np.asarray(pair.conserved_momentum)[angular] - current.ravel())
    set_guess(problem, duration, _guesses_of_motion(times, angles, speeds, np.array(bases)))


def _stepper(machine: FreeFloating) -> Any:
    """Return a function that advances the base by one step of Heun's method, with constant joint rates."""
    b, q, v = (ca.SX.sym("z", size) for size in (machine.base_size, machine.joint_size, machine.joint_size))
    step = ca.SX.sym("step")
    rate = ca.Function("rate", [b, q, v], [machine.base_rate(b, q, v)])
    first = rate(b, q, v)
    after = b + step / 2 * (first + rate(b + step * first, q, v))
    if machine.base == "spatial":
        after = ca.vertcat(after[:3], after[3:] / ca.norm_2(after[3:]))
    function = ca.Function("after", [step, b, q, v], [after])
    return lambda *arguments: np.array(function(*arguments)).ravel()


def _guesses_of_motion(times: Array, joints: Array, velocities: Array, base: Array) -> Guesses:
    """Convert samples of joint positions, joint velocities and base configurations to guesses by name."""
    second = np.gradient(velocities, times, axis=0)
    tables = {"joints": joints, "velocities": velocities, "accelerations": second, "base": base}
    return {name: Samples(times, samples) for name, samples in tables.items()}


def guessed_horizon(problem: Problem) -> float:
    """Return the horizon of a problem or, if it is free, its guess, s."""
    horizon = problem.declared.horizon
    assert horizon is not None
    return float(constant(horizon.lower)[0]) if horizon.guess is None else float(horizon.guess)


def set_guess(problem: Problem, duration: float, guesses: Guesses) -> None:
    """Set the initial guesses of states and controls by name, and the guess of the horizon if it is free."""
    declared = problem.declared
    assert declared.horizon is not None
    if not declared.horizon.fixed:
        declared.horizon = replace(declared.horizon, guess=float(duration))
    declared.set_guesses(guesses)


ROUNDING = 1e-9  # rounding tolerance of the tests for impossible captures: relative, and absolute for a momentum, N m s


class State(NamedTuple):
    """Initial state of a capture, with nan for free velocities, and the longest durations of its phases, s."""

    base: Array
    joints: Array
    velocities: Array
    target_base: Array
    approach: float
    detumble: float


def wheel_capacity(machine: FreeFloating, bounds: JointBounds, start: State, frictionless: bool = True) -> float:
    """Return the largest angular momentum that the wheels of a chaser can store while its base is at rest, N m s.

    `frictionless` tells whether only its motor acts on a wheel about its axis.
    """
    robot, time = machine.robot, start.approach + start.detumble
    known = frictionless and not np.isnan(start.velocities).any()
    spin = np.zeros(6)
    if known:
        twist = np.array(ca.DM(machine.base_twist(start.base, start.joints, start.velocities))).ravel()
        spin[machine.twist_rows] = twist
    spin = np.array(ca.DM(machine.world_from_base(start.base).rotation)).T @ spin[:3]
    frames, free, sides = link_frames(robot, ca.DM(start.joints)), 0.0, [np.zeros(3)]
    for name, inertia in find_wheels(robot).items():
        wheel, k = robot.joint(name), robot.joint_names.index(name)
        size = inertia * bounds.velocity[k]
        if any(joint.moves for joint in robot.path_to(wheel.parent)):  # the arm can turn it to any direction
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


def require_capacity(machine: FreeFloating, momentum: Array, capacity: float) -> None:
    """Raise ProblemError if the wheels cannot store the pair's angular momentum in any final attitude of the base."""
    angular = [k for k, row in enumerate(machine.twist_rows) if row < 3]
    size = float(np.linalg.norm(np.asarray(momentum)[angular]))
    if size > capacity * (1 + ROUNDING) + ROUNDING:
        words = f"capture: the pair has an angular momentum of {size:.6g} N m s, of which the wheels hold at most "
        words += f"{capacity:.6g}: {size - capacity:.6g} N m s are missing for rest. Use other wheels, more time, a "
        words += "momentum of the chaser against that of the target, or rest=False"
        raise ProblemError(words, name="momentum", value=size, limit=capacity)


def require_reach(chaser: FreeFloating, target: FreeFloating, start: State, earliest: float) -> None:
    """Raise ProblemError if the grasp is out of reach of the arm during the whole approach.

    Both centres of mass drift uniformly. The tip is never farther from the chaser's centre of mass than with the arm
    stretched.
    """
    reach = _reach(chaser, target)
    offset, drift = _relative_motion(chaser, target, start)
    closest = -(offset @ drift) / (drift @ drift) if drift.any() else earliest
    distance = float(np.linalg.norm(offset + drift * np.clip(closest, earliest, start.approach)))
    if distance > reach * (1 + ROUNDING):
        words = f"capture: the centres of mass of chaser and target are at least {distance:.4g} m apart, and the arm "
        words += f"reaches at most {reach:.4g} m: {distance - reach:.4g} m are missing. Start nearer, or let them "
        words += "drift together"
        raise ProblemError(words, name="reach", value=distance, limit=reach)


def _relative_motion(chaser: FreeFloating, target: FreeFloating, start: State) -> tuple[Array, Array]:
    """Return the vector (3,) from the chaser's to the target's centre of mass, m, and its time derivative, m/s."""
    centers, speeds = [], []
    for machine, base, joints in ((target, start.target_base, np.zeros(0)), (chaser, start.base, start.joints)):
        center = center_of_mass(machine.robot, ca.DM(joints), machine.world_from_base(ca.DM(base)))
        centers.append(np.array(ca.DM(center)).ravel())
        momentum = np.eye(6)[:, machine.twist_rows] @ np.asarray(machine.conserved_momentum)
        speeds.append(momentum[3:] / machine.robot.total_mass)
    return centers[0] - centers[1], speeds[0] - speeds[1]


def _reach(chaser: FreeFloating, target: FreeFloating) -> float:
    """Return an upper bound of the distance between both centres of mass when the tip is at the grasp, m."""
    robot, body = chaser.robot, target.robot
    massive = [link for link in robot.links if link.mass]
    moments = (link.mass * chain_length(robot.path_to(link.name), link.center_of_mass) for link in massive)
    reach = chain_length(robot.path_to(robot.tip_link), robot.tip_translation) + sum(moments) / robot.total_mass
    return reach + float(np.linalg.norm(np.subtract(body.tip_translation, body.links[0].center_of_mass)))
