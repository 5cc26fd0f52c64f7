"""Rest-to-rest joint motions in phases of constant jerk, in closed form, and slowed down to satisfy torque limits.

A joint that moves by d from rest to rest within limits V, A and J of velocity, acceleration and jerk is fastest if it
builds up its acceleration for t_j, keeps it for t_a, and releases it for t_j; then it cruises for t_v, and brakes as it
sped up. With the largest acceleration a that it reaches, its peak velocity is a (t_j + t_a), and

    d = peak (2 t_j + t_a + t_v).

Without friction, torques of a motion that is slowed down by a factor f are

    torque(q, rate / f, acceleration / f^2) = rest(q) + (torque(q, rate, acceleration) - rest(q)) / f^2,

where rest(q) is the gravity torque, so that the least factor within the torque limits follows directly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from models import FixedBase
from models.checks import Array
from ocp.curves import PiecewisePolynomial, gauss_points
from ocp.errors import SolveError, SolverStatus
from ocp.motion.builders.dynamics import joint_torques
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.problem.values import Sampler
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

NODES = np.array([0.0, 1 / 3, 2 / 3, 1.0])
"""Interpolation nodes of a phase, as fractions of its duration; four suffice because positions are cubic in time."""


@dataclass(frozen=True)
class ConstantJerkSettings:
    """Settings of motions that consist of phases of constant jerk."""

    still: float = 1e-3  # duration of a motion that stays where it is, s: a horizon must be positive
    ramp_share: float = 5e-4  # time in which joints without acceleration and jerk limits speed up, per cruise time
    unlimited_rate: float = 1.0  # rate of joints without any of these limits, rad/s or m/s
    samples: int = 16  # number of samples of each phase at which torques are evaluated
    torque_share: float = 0.995  # share of torque and power limits that is used, for larger values between the samples


SETTINGS = ConstantJerkSettings()


class _Ramps(NamedTuple):
    """Phase durations, s, and peak velocities of the fastest rest-to-rest motions of n joints. Shape (..., n) each."""

    build_up: Array
    steady: Array
    cruise: Array
    peak: Array

    @property
    def duration(self) -> Array:
        """Duration of each velocity profile from rest to rest, s."""
        return 4 * self.build_up + 2 * self.steady + self.cruise


def _ramps(distances: Array, velocity: Array, acceleration: Array, jerk: Array) -> _Ramps:
    """Return the fastest rest-to-rest velocity profiles of joints that move by given distances. Shape (..., n).

    At peak velocity V and limits a and j, each ramp lasts r = V / a + a / j, or 2 sqrt(V / j) if it does not reach a.
    Both ramps together cover V r. The rest of the distance is covered at V.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        limited = np.isfinite(acceleration)
        full = np.where(limited, acceleration / jerk, 0.0)  # time until the acceleration limit is reached
        short = np.where(np.isfinite(jerk), (distances * np.sqrt(jerk) / 2) ** (2 / 3), np.inf)
        # V^2 / a + V a / j = distance
        root = np.sqrt(full**2 + 4 * distances / acceleration)
        long = np.where(limited, 2 * distances / (full + root), np.inf)
        peak = np.minimum(np.where(limited & (short > acceleration * full), long, short), velocity)
        reaches = limited & (peak > acceleration * full)
        steady = np.where(reaches, peak / acceleration - full, 0.0)
        build_up = np.where(reaches, full, np.where(np.isfinite(jerk), np.sqrt(peak / jerk), 0.0))
        cruise = np.maximum(distances / peak - 2 * build_up - steady, 0.0)
    moves = (distances > 0) & np.isfinite(peak)
    return _Ramps(*(np.where(moves, each, 0.0) for each in (build_up, steady, cruise, peak)))


def least_durations(distances: Array, bounds: JointBounds) -> Array:
    """Return the least time, s, in which each joint by itself moves by a distance from rest to rest. Shape (..., n)."""
    return _ramps(distances, bounds.velocity, bounds.acceleration, bounds.jerk).duration


def least_squared_velocities(distances: Array, duration: float, acceleration: Array) -> Array:
    """Return each joint's least integral of squared velocity from rest to rest in a given time. Shape (..., n).

    Among motions within acceleration limits a, the one that accelerates by a, moves at the constant velocity v = 2 d /
    (T + sqrt(T^2 - 4 d / a)), and brakes by a has the least integral, v^2 (T - 4/3 v / a). It is infinite where the
    duration T is too short.
    """
    root = np.sqrt(np.maximum(duration**2 - 4 * distances / acceleration, 0.0))
    velocity = np.divide(2 * distances, duration + root, out=np.zeros_like(root), where=distances > 0)
    integrals = velocity**2 * (duration - 4 / 3 * velocity / acceleration)
    return np.asarray(np.where(4 * distances > acceleration * duration**2 * (1 + ROUNDING_SHARE), np.inf, integrals))


@dataclass(frozen=True, eq=False)
class ConstantJerkMotion:
    """Motion of several joints in K consecutive phases of constant jerk."""

    durations: Array  # of the phases, s, (K,)
    joints: Array  # positions where each phase starts, (K, n), as the derivatives
    rates: Array
    accelerations: Array
    jerks: Array

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return float(self.durations.sum())

    def slower(self, factor: float) -> ConstantJerkMotion:
        """Return a motion along the same joint path with the duration multiplied by a factor."""
        derivatives = self.rates / factor, self.accelerations / factor**2, self.jerks / factor**3
        return ConstantJerkMotion(self.durations * factor, self.joints, *derivatives)

    def sampled(self, places: Array) -> tuple[Array, Array, Array]:
        """Return joint positions, rates and accelerations (K, M, n) at fractions (M,) of each phase's duration."""
        t = (self.durations[:, None] * places)[:, :, None]
        values = self.joints, self.rates, self.accelerations, self.jerks
        joints, rates, accelerations, jerks = (each[:, None] for each in values)
        return (
            joints + t * (rates + t * (accelerations / 2 + t * jerks / 6)),
            rates + t * (accelerations + t * jerks / 2),
            accelerations + t * jerks,
        )

    def solution(self, problem: Problem, method: str) -> Solution:
        """Return the motion as a solution of a `dynamics_problem`; the multipliers and the control "power" are missing.

        `method` is a phrase for what the motion does, such as "stops at the corners of a path".
        """
        form, horizon = Formulation.of(problem), self.duration
        breaks = np.append(0.0, np.cumsum(self.durations)) / horizon
        breaks[-1] = 1.0
        samples = dict(zip(("joints", "velocities", "accelerations"), self.sampled(NODES), strict=True))
        states = np.concatenate([samples[name] for name in form.states], axis=2)
        constant = self.jerks if "jerks" in form.controls else self.accelerations
        state_curve = PiecewisePolynomial(breaks, NODES, states)
        control_curve = PiecewisePolynomial(breaks, np.array([0.5]), constant[:, None])
        costate_curve = PiecewisePolynomial(breaks, NODES, np.zeros_like(states))
        p = form.parameter_vector({})
        at, shares = (each.ravel() for each in gauss_points(breaks, 5))
        running = form.sampled([form.running], state_curve(at), control_curve(at), at * horizon, horizon, p)[0][:, 0]
        final = form.terminal_cost(states[-1, -1], states[0, 0], constant[0], horizon=horizon, p=p)
        cost = float(horizon * shares @ running + final)
        message = f"it {method}, without multipliers that show whether it is optimal"
        curves = state_curve, control_curve, costate_curve
        return path_solution(problem, method, curves, horizon=horizon, cost=cost, message=message)


def path_solution(
    problem: Problem, method: str, curves: tuple[PiecewisePolynomial, ...], *, horizon: float, cost: float, message: str
) -> Solution:
    """Return curves of states, controls and costates that no solver computed as a `Solution` of a problem.

    `message` says why it is unknown whether the motion is optimal, and is empty if the motion is optimal.
    """
    form = Formulation.of(problem)
    columns = {name: slice(*entries.indices(form.nx)) for name, entries in form.states.items()}
    states, controls, costates = (np.concatenate([curve.values[:, 0], curve.values[-1:, -1]]) for curve in curves)
    return Solution(
        name=problem.name,
        method={"type": method},
        solver="path",
        success=not message,
        status=SolverStatus.ACCEPTABLE if message else SolverStatus.SOLVED,
        message=message,
        cost=cost,
        iterations=0,
        horizon=horizon,
        t=curves[0].breaks * horizon,
        states={name: states[:, part] for name, part in columns.items()},
        controls=dict.fromkeys(form.controls, controls),
        costates={name: costates[:, part] for name, part in columns.items()},
        parameters={},
        cost_gradients={},
        state_interpolant=curves[0],
        control_interpolant=curves[1],
        costate_interpolant=curves[2],
        variables=states.ravel(),
        multipliers=np.zeros(0),
        seconds={"build": 0.0, "solve": 0.0},
        problem=problem,
    )


class TorqueLimits:
    """Joint torques and actuator powers of a machine on a fixed base, and their limits.

    Attributes:
        limited: Indices of the L joints whose torque or power is limited.
        torque, power: Their limits, N m or N, and W; infinite if only the other one is limited. Shape (L,).
        largest: The finite ones among these R limits: those of torques first, then those of powers. Shape (R,).
        two_sided: Whether a quantity is limited in both directions, as torques are; braking power is not. Shape (R,).
    """

    def __init__(self, machine: FixedBase, bounds: JointBounds) -> None:
        self.machine = machine
        self.limited = np.flatnonzero(np.isfinite([bounds.torque, bounds.power]).any(axis=0))
        self.torque, self.power = bounds.torque[self.limited], bounds.power[self.limited]
        both = np.concatenate([self.torque, self.power])
        self._finite = np.flatnonzero(np.isfinite(both))
        self.largest, self.two_sided = both[self._finite], self._finite < len(self.limited)
        self._samplers: dict[bool, Sampler] = {}

    def torques(self, joints: Array, rates: Array, accelerations: Array) -> Array:
        """Return the torques, N m or N, of the L joints with limited torque or power at M samples. Shape (M, L)."""
        return np.asarray(self._sampler(False)(joints, rates, accelerations)[0])

    def linearise(self, joints: Array, rates: Array, accelerations: Array) -> tuple[Array, list[Array]]:
        """Return the limited torques and then powers (M, R), and their Jacobians in position, rate and acceleration."""
        values, *slopes = self._sampler(True)(joints, rates, accelerations)
        size = joints.shape[1]
        return values, [slope.reshape(len(joints), size, -1).swapaxes(1, 2) for slope in slopes]

    def _sampler(self, linearised: bool) -> Sampler:
        if linearised not in self._samplers:
            symbols = [ca.SX.sym("v", self.machine.joint_size) for _ in range(3)]
            chosen = self.limited.tolist()
            torques = joint_torques(self.machine, (self.machine.base_home(), *symbols))[chosen]
            limited = ca.vertcat(torques, torques * symbols[1][chosen])[self._finite.tolist()]
            outputs = [limited, *(ca.jacobian(limited, each) for each in symbols)] if linearised else [torques]
            self._samplers[linearised] = Sampler(symbols, outputs)
        return self._samplers[linearised]

    def slow_down(self, motion: ConstantJerkMotion) -> ConstantJerkMotion:
        """Return the motion slowed down by the smallest factor at which its samples satisfy torque and power limits.

        Raises:
            SolveError: A torque limit is too small to keep the machine at rest somewhere on the path.
        """
        if not len(self.limited):
            return motion
        places = np.linspace(0.0, 1.0, SETTINGS.samples)
        joints, rates, accelerations = (each.reshape(-1, each.shape[-1]) for each in motion.sampled(places))
        rest = self.torques(joints, np.zeros_like(joints), np.zeros_like(joints))
        moving = self.torques(joints, rates, accelerations) - rest
        allowed = SETTINGS.torque_share * self.torque
        if (np.abs(rest) >= allowed).any():
            row, column = np.argwhere(np.abs(rest) >= allowed)[0]
            name, limit = self.machine.robot.joint_names[self.limited[column]], float(self.torque[column])
            words = f"at rest on the path, joint {name!r} needs {abs(rest[row, column]):.4g}, {limit:.4g} allowed"
            raise SolveError(words, name=name, value=float(rest[row, column]), limit=limit)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(moving > 0, (allowed - rest) / moving, (allowed + rest) / -moving)
        speed = float(np.sqrt(min(1.0, float(np.where(moving == 0, np.inf, ratio).min()))))
        holding, driving = rest * rates[:, self.limited], moving * rates[:, self.limited]  # the power at a speed s is
        power = SETTINGS.torque_share * self.power  # s holding + s^3 driving

        def excess(s: float) -> float:
            return float((s * holding + s**3 * driving - power).max())

        if excess(speed) > 0:
            speed = scipy.optimize.brentq(excess, 0.0, speed, rtol=ROUNDING_SHARE)
        return motion.slower(1 / speed)


def synchronised_motion(start: Array, goal: Array, bounds: JointBounds) -> ConstantJerkMotion:
    """Return a time-optimal joint motion from rest to rest within velocity, acceleration and jerk limits.

    A motion takes at least as long as each joint by itself. A straight motion in joint space attains this bound if the
    limits of all joints allow it, else the profile of each joint is slowed down to the common duration.
    """
    change = goal - start
    own = _ramps(np.abs(change), *_finite_limits(np.abs(change), bounds))
    duration = float(own.duration.max())
    straight = _straight_motion(start, change, bounds)
    if duration == 0 or straight.duration <= (1 + ROUNDING_SHARE) * duration:
        return straight
    return _joint_phases(start, np.sign(change), own, duration)


def stopping_motion(path: Array, bounds: JointBounds, torques: TorqueLimits) -> ConstantJerkMotion:
    """Return a joint motion along a polyline (M, n) that rests at each corner and satisfies the torque limits."""
    moves = np.append(np.diff(path, axis=0).any(axis=1), True)
    corners = path[moves] if moves.sum() > 1 else path[[0, -1]]
    parts = [torques.slow_down(_straight_motion(first, last - first, bounds)) for first, last in pairwise(corners)]
    fields = zip(*(vars(part).values() for part in parts), strict=True)
    return ConstantJerkMotion(*(np.concatenate(values) for values in fields))


def segment_durations(changes: Array, bounds: JointBounds) -> Array:
    """Return the least durations, s, (K,) of straight rest-to-rest displacements (K, n) under all limits but torque."""
    return np.asarray(_straight_profile(changes, bounds).duration)


def _finite_limits(distances: Array, bounds: JointBounds) -> tuple[Array, Array, Array]:
    """Return velocity, acceleration and jerk limits; joints without the last two limits get finite ones."""
    velocity, acceleration, jerk = bounds.velocity, bounds.acceleration, bounds.jerk
    jumps = ~np.isfinite(acceleration) & ~np.isfinite(jerk)
    velocity = np.where(jumps & ~np.isfinite(velocity), SETTINGS.unlimited_rate, velocity)
    with np.errstate(divide="ignore", invalid="ignore"):
        steep = np.where(distances > 0, velocity**2 / (SETTINGS.ramp_share * distances), np.inf)
    return velocity, np.where(jumps, steep, acceleration), jerk


def _straight_profile(changes: Array, bounds: JointBounds) -> _Ramps:
    """Return the fastest profiles of K straight motions over displacements (K, n), as fractions of the displacement."""
    distances = np.abs(changes)
    with np.errstate(divide="ignore", invalid="ignore"):
        least = [
            np.where(distances > 0, each / distances, np.inf).min(axis=1) for each in _finite_limits(distances, bounds)
        ]
    return _ramps(distances.any(axis=1).astype(float), *least)


def _straight_motion(start: Array, change: Array, bounds: JointBounds) -> ConstantJerkMotion:
    """Return the fastest straight joint motion over a displacement (n,), or a short rest if this displacement is 0."""
    profile = _straight_profile(change[None], bounds)
    duration = float(profile.duration[0])
    if duration == 0:
        still = np.zeros((1, len(start)))
        return ConstantJerkMotion(np.array([SETTINGS.still]), start[None], still, still, still)
    share = _joint_phases(np.zeros(1), np.ones(1), profile, duration)
    derivatives = [each * change for each in (share.rates, share.accelerations, share.jerks)]
    return ConstantJerkMotion(share.durations, start + share.joints * change, *derivatives)


def _joint_phases(start: Array, signs: Array, profiles: _Ramps, duration: float) -> ConstantJerkMotion:
    """Return the motion in which each joint follows its own velocity profile (n,), in a direction -1, 0 or 1, slowed
    down to a common duration, s, that is at least the duration of each profile.
    """
    build_up, steady, cruise, peak = profiles
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(profiles.duration > 0, duration / profiles.duration, 1.0)
        acceleration = np.where(peak > 0, peak / (build_up + steady), 0.0)
        jerk = np.where(build_up > 0, acceleration / build_up, 0.0)
    none = np.zeros_like(start)
    lengths = np.array([build_up, steady, build_up, cruise, build_up, steady, build_up]) * factor  # (7, n)
    begins = np.cumsum(np.vstack([none, lengths[:-1]]), axis=0)
    of_phase = signs / factor**2 * np.array([none, *[acceleration] * 2, none, none, *[-acceleration] * 2])
    jerk_of_phase = signs / factor**3 * np.array([jerk, none, -jerk, none, -jerk, none, jerk])
    times = np.unique(np.append(begins.ravel(), duration))
    times = np.append(times[:-1][np.diff(times) > ROUNDING_SHARE * duration], duration)
    times[0] = 0.0
    middles, columns = (times[:-1] + times[1:]) / 2, np.arange(len(start))
    phase = (begins[None] <= middles[:, None, None]).sum(axis=1) - 1  # (K, n)
    durations, jerks = np.diff(times), jerk_of_phase[phase, columns]
    accelerations = of_phase[phase, columns] + jerks * (times[:-1, None] - begins[phase, columns])
    t = durations[:, None]
    rates = np.vstack([none, np.cumsum(t * (accelerations + t * jerks / 2), axis=0)])[:-1]
    steps = t * (rates + t * (accelerations / 2 + t * jerks / 6))
    joints = start + np.vstack([none, np.cumsum(steps, axis=0)])[:-1]
    return ConstantJerkMotion(durations, joints, rates, accelerations, jerks)
