"""Fastest motions along straight motions in joint space that stop at the corners, within actuator limits.

On each straight motion all joints share one profile s(t) of constant jerk (or acceleration) phases. Without friction,
torques of a motion that is slowed down by a factor f are

    torque(q, rate / f, acceleration / f^2) = rest(q) + (torque(q, rate, acceleration) - rest(q)) / f^2,

with rest(q) those of gravity alone, so that the least factor within the torque limits follows directly. The motion is
feasible, and a guess for a motion that passes the corners without a stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.curves import PiecewisePolynomial
from ocp.errors import SolveError, SolverStatus
from ocp.motion.builders.torques import joint_torques
from ocp.motion.schedule.ramps import fastest_motion
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.problem.values import Sampler
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["StoppingMotion", "segment_durations", "stopping_motion"]

NODES = np.array([0.0, 1 / 3, 2 / 3, 1.0])
"""Places of the values in a phase: joints are cubic."""


@dataclass(frozen=True)
class StoppingSettings:
    """Settings of the motions.

    Attributes:
        still: Duration of a motion that stays where it is, s, since problems have a positive one.
        ramp: Time in which joints without an acceleration limit reach their largest rate, s.
        unlimited_rate: Rate of joints without a rate limit, rad/s or m/s.
        samples: Samples of each phase at which torques are evaluated.
        torque_share: Share of the torque limits that is used there, since torques may be larger between the samples.
    """

    still: float = 1e-3
    ramp: float = 0.2
    unlimited_rate: float = 1.0
    samples: int = 16
    torque_share: float = 0.995


SETTINGS = StoppingSettings()


class Phase(NamedTuple):
    """Phase of a motion: its duration, s, and joints with their first three derivatives at its start, (n,) each."""

    duration: float
    joints: Array
    rates: Array
    accelerations: Array
    jerks: Array

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return joints, rates and accelerations at times (M,) since its start. Shape (M, n) each."""
        t = times[:, None]
        accelerations = self.accelerations + t * self.jerks
        rates = self.rates + t * self.accelerations + t**2 / 2 * self.jerks
        return (
            self.joints + t * self.rates + t**2 / 2 * self.accelerations + t**3 / 6 * self.jerks,
            rates,
            accelerations,
        )

    def slower(self, factor: float) -> Phase:
        """Return the phase slowed down by a factor."""
        derivatives = self.rates / factor, self.accelerations / factor**2, self.jerks / factor**3
        return Phase(self.duration * factor, self.joints, *derivatives)


@dataclass(frozen=True, eq=False)
class StoppingMotion:
    """Motion that consists of phases of constant jerk."""

    phases: tuple[Phase, ...]

    @property
    def duration(self) -> float:
        """Duration, s."""
        return float(sum(phase.duration for phase in self.phases))

    def slower(self, factor: float) -> StoppingMotion:
        """Return the motion slowed down by a factor."""
        return StoppingMotion(tuple(phase.slower(factor) for phase in self.phases))

    def solution(self, problem: Problem) -> Solution:
        """Return the motion as a solution of a `dynamics_problem` without power, without multipliers."""
        form, horizon = Formulation.of(problem), self.duration
        breaks = np.append(0.0, np.cumsum([phase.duration for phase in self.phases])) / horizon
        breaks[-1] = 1.0
        values: dict[str, list[Array]] = {"joints": [], "velocities": [], "accelerations": []}
        for phase in self.phases:
            for name, part in zip(values, phase.at(NODES * phase.duration), strict=True):
                values[name].append(part)
        curves = {name: np.array(parts) for name, parts in values.items()}
        states = np.concatenate([curves[name] for name in form.states], axis=2)
        jerks = "jerks" in form.controls
        constant = np.array([phase.jerks if jerks else phase.accelerations for phase in self.phases])
        state_curve = PiecewisePolynomial(breaks, NODES, states)
        control_curve = PiecewisePolynomial(breaks, np.array([0.5]), constant[:, None])
        rows = np.concatenate([states[:, 0], states[-1:, -1]])
        controls = np.concatenate([constant, constant[-1:]])
        p = form.parameter_vector({})
        nodes, weights = np.polynomial.legendre.leggauss(5)
        at = (breaks[:-1, None] + np.diff(breaks)[:, None] * (nodes + 1) / 2).ravel()
        shares = (np.diff(breaks)[:, None] * weights / 2).ravel()
        x, u = state_curve(at), control_curve(at)
        running = form.sampled([form.running], x, u, at * horizon, horizon, p)[0][:, 0]
        final = form.terminal_cost(rows[-1], rows[0], controls[0], horizon=horizon, p=p)
        columns = {name: slice(*entries.indices(form.nx)) for name, entries in form.states.items()}
        return Solution(
            name=problem.name,
            method={"type": "stops at the corners of a path"},
            solver="path",
            success=False,
            status=SolverStatus.ACCEPTABLE,
            message="it stops at the corners of a path, whose optimality no multipliers show",
            cost=float(horizon * shares @ running + final),
            iterations=0,
            horizon=horizon,
            t=breaks * horizon,
            states={name: rows[:, part] for name, part in columns.items()},
            controls=dict.fromkeys(form.controls, controls),
            costates={name: np.zeros_like(rows[:, part]) for name, part in columns.items()},
            parameters={},
            cost_gradients={},
            state_interpolant=state_curve,
            control_interpolant=control_curve,
            costate_interpolant=PiecewisePolynomial(breaks, NODES, np.zeros_like(states)),
            variables=states.ravel(),
            multipliers=np.zeros(0),
            seconds={"build": 0.0, "solve": 0.0},
            problem=problem,
        )


def stopping_motion(machine: FixedBase, path: Array, bounds: JointBounds) -> StoppingMotion:
    """Return the fastest motion along a path (M, n) that stops at its corners, within limits up to jerk and torque.

    Raises:
        SolveError: A joint cannot hold the machine at rest somewhere on the path.
    """
    torques = _torques(machine)
    phases: list[Phase] = []
    for first, last in pairwise(path):
        own = _straight(first, last - first, bounds)
        if own and np.isfinite(bounds.torque).any():
            factor = _slowdown(machine, torques, own, bounds.torque)
            own = [phase.slower(factor) for phase in own]
        phases += own
    if not phases:  # the machine stays where it is
        phases.append(Phase(SETTINGS.still, path[0], *np.zeros((3, path.shape[1]))))
    return StoppingMotion(tuple(phases))


def segment_durations(changes: Array, bounds: JointBounds) -> Array:
    """Return the durations of straight motions by changes (K, n) from rest to rest, s, without torque limits."""
    return np.array([sum(phase.duration for phase in _straight(np.zeros(len(c)), c, bounds)) for c in changes])


def _straight(first: Array, change: Array, bounds: JointBounds) -> list[Phase]:
    """Return the fastest phases of a straight motion from rest to rest."""
    moved = np.abs(change)
    if not moved.any():
        return []
    fastest = np.where(np.isfinite(bounds.velocity), bounds.velocity, SETTINGS.unlimited_rate)
    strongest = np.where(np.isfinite(bounds.acceleration), bounds.acceleration, fastest / SETTINGS.ramp)
    with np.errstate(divide="ignore"):
        top, acceleration, jerk = (float((each / moved).min()) for each in (fastest, strongest, bounds.jerk))
    s, rate, force, phases = 0.0, 0.0, 0.0, []
    if np.isfinite(jerk):
        steps = [(time, 0.0, value) for time, value in fastest_motion(1.0, 0.0, 0.0, top, acceleration, jerk)]
    else:
        top = min(top, np.sqrt(acceleration))
        ramp, cruise = top / acceleration, 1 / top - top / acceleration
        steps = [(ramp, acceleration, 0.0), (cruise, 0.0, 0.0), (ramp, -acceleration, 0.0)]
    total = sum(duration for duration, *_ in steps)
    for duration, value, third in steps:
        if duration <= ROUNDING_SHARE * total:
            continue
        force = force if np.isfinite(jerk) else value
        phases.append(Phase(duration, first + s * change, rate * change, force * change, third * change))
        s += duration * (rate + duration * (force / 2 + duration * third / 6))
        rate += duration * (force + duration * third / 2)
        force += duration * third
    return phases


def _torques(machine: FixedBase) -> Sampler:
    """Return the joint torques as a function of joints, rates and accelerations at many samples."""
    symbols = [ca.SX.sym("v", machine.joint_size) for _ in range(3)]
    return Sampler(symbols, [joint_torques(machine, machine.base_home(), *symbols)])


def _slowdown(machine: FixedBase, torques: Sampler, phases: list[Phase], largest: Array) -> float:
    """Return the least factor, at least 1, by which the phases are slowed down to keep the torque limits (n,)."""
    places = np.linspace(0.0, 1.0, SETTINGS.samples)
    parts = [phase.at(places * phase.duration) for phase in phases]
    joints, rates, accelerations = (np.concatenate(part) for part in zip(*parts, strict=True))
    rest = torques(joints, np.zeros_like(joints), np.zeros_like(joints))[0]
    moving = torques(joints, rates, accelerations)[0] - rest
    allowed = SETTINGS.torque_share * largest
    if (np.abs(rest) >= allowed).any():
        row, joint = np.argwhere(np.abs(rest) >= allowed)[0]
        name = machine.robot.joint_names[joint]
        words = f"at rest on the path, joint {name!r} needs {abs(rest[row, joint]):.4g}, {largest[joint]:.4g} allowed"
        raise SolveError(words, name=name, value=float(rest[row, joint]), limit=float(largest[joint]))
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(moving > 0, (allowed - rest) / moving, (allowed + rest) / -moving)
    return float(1 / np.sqrt(min(1.0, float(np.where(moving == 0, np.inf, room).min()))))
