"""Motions within what actuators give: torques, power, accelerations and jerks that are limited.

A motion without these limits is the guess of the same problem at the level of accelerations, with the same cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from models.arrays import Array
from ocp.direct.guess import Samples
from ocp.errors import SolveError
from ocp.motion.builders.actuator_limits import checked_motors, joint_torques
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics_plan import within_limits
from ocp.motion.builders.tool_motion import ToolMotion
from ocp.motion.plan.motion import CHECKED_TIMES, Plan
from ocp.motion.plan.request import declared_motion
from ocp.motion.search.configurations import PlanRequest
from ocp.motion.tasks.limits import Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["ActuatorDemand", "limits_actuators", "solve_within_actuator_limits", "without_actuators"]

ACTUATOR_LIMITS = ("acceleration", "jerk", "torque", "power")


def limits_actuators(limits: Limits) -> bool:
    """Whether anything but positions and rates is limited."""
    return any(getattr(limits, what) is not None for what in ACTUATOR_LIMITS)


def without_actuators(limits: Limits) -> Limits:
    """The limits of positions and rates alone."""
    return replace(limits, acceleration=None, jerk=None, torque=None, power=None)


@dataclass(frozen=True)
class ActuatorDemand:
    """What a motion takes most of, as a share of its limit.

    Attributes:
        what: "torque", ... joint: Its name. time: s. asked, allowed: In `unit`.
    """

    what: str
    joint: str
    time: float
    asked: float
    allowed: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.what} of {self.joint!r} is {self.asked:.4g} {self.unit} at {self.time:.4g} s, "
            f"{self.allowed:.4g} allowed"
        )

    @classmethod
    def of(cls, plan: Plan, limits: Limits) -> ActuatorDemand | None:
        """Of a plan; None where no actuator is limited."""
        machine = checked_motors("limits", plan.machine)
        robot, bounds = machine.robot, limits.bounds(machine)
        sample = plan.sampled(np.linspace(0.0, plan.horizon, CHECKED_TIMES))
        bases = plan.at(sample.t)["base"] if machine.base_size else np.zeros((CHECKED_TIMES, 0))
        symbols = [ca.SX.sym("v", size) for size in (machine.base_size, *[machine.joint_size] * 3)]
        torques_at = ca.Function("torques", symbols, [joint_torques(machine, *symbols)])
        torques = np.array(
            torques_at.map(CHECKED_TIMES)(bases.T, sample.joints.T, sample.rates.T, sample.accelerations.T)
        ).T
        worst: tuple[float, ActuatorDemand] | None = None
        for what, values, most, units in (
            ("acceleration", np.abs(sample.accelerations), bounds.acceleration, ("rad/s^2", "m/s^2")),
            ("torque", np.abs(torques), bounds.torque, ("N m", "N")),
            ("power", torques * sample.rates, bounds.power, ("W", "W")),
        ):
            shares = values / most
            if not np.isfinite(most).any():
                continue
            row, joint = np.unravel_index(int(np.argmax(shares)), shares.shape)
            if worst is None or shares[row, joint] > worst[0]:
                kind = robot.moving_joints[joint].kind
                told = float(sample.t[row]), float(values[row, joint]), float(most[joint])
                worst = shares[row, joint], cls(what, robot.joint_names[joint], *told, units[kind == "prismatic"])
        return None if worst is None else worst[1]


def solve_within_actuator_limits(request: PlanRequest, start: Array, reference: Array, free: Plan) -> Solution:
    """A motion within the limits of the actuators, from one without; audited from its own start if many are as good.

    Args:
        request: What is asked. start, reference: As of `tool_motion_problem`.
        free: The motion without limits of actuators.

    Raises:
        SolveError: None was found; names the joint, when, what the motion takes without the limit and what it may.
    """
    limits = request.drives
    assert limits is not None
    if request.start is None:
        # a joint that began elsewhere is not ignorable: bodies are separated by it
        start = np.where(np.isclose(free.at(0.0)["joints"], start, rtol=0.0), start, np.nan)

    def planned(begin: Array) -> Solution:
        def declare(clearance_constraints: ClearanceConstraints | None) -> Problem:
            motion = declared_motion(
                request, start=begin, reference=reference, clearance_constraints=clearance_constraints, limits=limits
            )
            _guess(motion, free)
            return motion.problem

        joints = {"": (request.machine, limits)}
        return within_limits(declare, request.clearance_constraints, None, _breaks(request), None, None, joints)

    try:
        solution = planned(start)
        audit = solution.audit()
        if audit.feasible and audit.optimal is None and np.isnan(start).any():
            fixed = planned(solution[f"joints{request.stretches[0].suffix}"][0])
            if fixed.audit().passed:
                return fixed
    except SolveError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise
        raise _beyond(error, ActuatorDemand.of(free, limits)) from error
    return solution


def _beyond(error: SolveError, demand: ActuatorDemand | None) -> SolveError:
    """The error with what the motion takes without the limits."""
    details = {"name": error.name, "value": error.value, "limit": error.limit, "time": error.time}
    words = "no motion holds the limits of its actuators"
    if demand is not None:
        words += f": without them {demand}"
        if demand.asked > demand.allowed:
            details = {"name": demand.joint, "value": demand.asked, "limit": demand.allowed, "time": demand.time}
    return SolveError(f"{words}\n{error}", error.solution, error.conflicts, **details)


def _breaks(request: PlanRequest) -> list[float]:
    """Fractions of the horizon at which tasks are less smooth."""
    parts = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in request.stretches]
    return np.unique(np.concatenate([np.zeros(0), *parts])).tolist()  # type: ignore[no-any-return]


def _guess(motion: ToolMotion, free: Plan) -> None:
    """Give the states and controls of a problem the values of a motion without limits of actuators."""
    fractions = np.linspace(0.0, 1.0, CHECKED_TIMES)
    sample = free.solution.at_fraction(fractions)
    for stretch, part in zip(motion.stretches, free.parts, strict=True):
        given = {
            "base": sample.get(f"base{stretch.suffix}"),
            "joints": sample[f"joints{stretch.suffix}"],
            "velocities": sample[free.rated + stretch.suffix],
            "accelerations": free.accelerations(part, fractions),
        }
        for name, values in given.items():
            for pool in (motion.problem.declared.states, motion.problem.declared.controls):
                if values is not None and (own := pool.get(name + stretch.suffix)) is not None:
                    pool[own.name] = replace(own, guess=Samples(fractions * motion.horizon, values))
