"""Motions along tasks within limits of torque, power, acceleration and jerk, or with other costs than squared rates.

The guess is a motion without these limits, of least squared rates, whose problem has the rates as controls. The problem
solved from it has accelerations as controls.

Limits can only increase the cost of a motion. With another cost, that of the guess bounds nothing: every local minimum
of the squared rates is then the guess of one motion, and the lowest of their costs is that of the plan.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array
from models.machines.machine import hold_joints
from ocp.direct.guess import Samples
from ocp.errors import SolveError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import Actuation, checked_motors, joint_torques, running_cost, weights_torques
from ocp.motion.builders.dynamics_plan import within_limits
from ocp.motion.builders.tool_motion import CLOCK, PACE, SLOPES, ToolMotion
from ocp.motion.result.candidate import Reason, Rejection
from ocp.motion.result.plan import CHECKED_TIMES
from ocp.motion.result.request import declared_motion
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.configurations import PlanRequest
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tolerances import RESOLVED_SHARE

ACTUATOR_LIMITS = ("acceleration", "jerk", "torque", "power")


def limits_actuators(limits: Limits) -> bool:
    """Return whether the acceleration, jerk, torque or power of joints is limited."""
    return any(getattr(limits, quantity) is not None for quantity in ACTUATOR_LIMITS)


def weights_actuators(cost: Cost) -> bool:
    """Return whether a cost weights torques, work, accelerations or jerks."""
    return bool({"effort", "energy", "acceleration", "jerk"} & set(cost.terms))


def without_actuators(limits: Limits) -> Limits:
    """Return a copy of the limits of a motion without those of acceleration, jerk, torque and power."""
    return replace(limits, acceleration=None, jerk=None, torque=None, power=None)


def cost_of_motion(plan: SolvedPlan, cost: Cost) -> float:
    """Integrate the cost of a plan's motion by the trapezoidal rule; joints that are held at rest do not count."""
    machine, t, samples = _moving_joints(plan)
    base, *motion = (ca.SX.sym("v", size) for size in (machine.base_size, *[machine.joint_size] * 4))
    torques: Any = None
    if weights_torques(cost):
        torques = joint_torques(checked_motors("cost", machine), (base, *motion[:3]))
    running = running_cost(machine, cost, (base, *motion[:3]), jerks=motion[3], torques=torques)
    if cost.energy:
        running += cost.energy * ca.sum1(ca.fmax(torques * motion[1], 0.0))
    running_at = ca.Function("cost", [base, *motion], [running])
    jerks = np.gradient(samples[-1], t, axis=0)
    values = running_at.map(CHECKED_TIMES)(*(part.T for part in (*samples, jerks)))
    return float(np.trapezoid(np.array(values)[0], t) + cost.time * plan.horizon)


def _moving_joints(plan: SolvedPlan) -> tuple[Any, Array, tuple[Array, ...]]:
    """Return the machine of a plan with the held joints locked, sample times (M,), s, and samples of the motion.

    The samples are base, joints, rates and accelerations. Shape (M, n) each.
    """
    machine = hold_joints(plan.machine, plan.held) if plan.held else plan.machine
    sample = plan.sampled(np.linspace(0.0, plan.horizon, CHECKED_TIMES))
    free = [name not in plan.held for name in plan.names]
    base = plan.at(sample.t)["base"] if machine.base_size else np.zeros((CHECKED_TIMES, 0))
    return machine, sample.t, (base, *(values[:, free] for values in sample[1:4]))


def largest_demand(plan: SolvedPlan, limits: Limits) -> Reason | None:
    """Return which actuator a plan demands most of, relative to its limit; None if no actuator is limited.

    The reason names the joint, the time, and the value and the limit of its torque, power or acceleration. Joints that
    the plan keeps at rest do not count.
    """
    machine, t, samples = _moving_joints(plan)
    bounds = limits.bounds(machine)
    symbols = [ca.SX.sym("v", values.shape[1]) for values in samples]
    torques_at = ca.Function("torques", symbols, [joint_torques(checked_motors("limits", machine), (*symbols,))])
    torques = np.array(torques_at.map(len(t))(*(values.T for values in samples))).T
    _, _, rates, accelerations = samples
    largest, demand = -np.inf, None
    for quantity, values, most_allowed in (
        ("acceleration", np.abs(accelerations), bounds.acceleration),
        ("torque", np.abs(torques), bounds.torque),
        ("power", torques * rates, bounds.power),
    ):
        ratios = values / most_allowed
        row, index = np.unravel_index(int(np.argmax(ratios)), ratios.shape)
        if np.isfinite(most_allowed).any() and ratios[row, index] > largest:
            largest, joint = ratios[row, index], machine.robot.moving_joints[index]
            unit = {"acceleration": f"{joint.unit}/s^2", "torque": joint.effort_unit, "power": "W"}[quantity]
            time, value, allowed = float(t[row]), float(values[row, index]), float(most_allowed[index])
            words = f"{quantity} of {joint.name!r} is {value:.4g} {unit} at {time:.4g} s, {allowed:.4g} allowed"
            demand = Reason(Rejection.ACTUATORS, words, joint.name, value, allowed, time)
    return demand


def solve_with_accelerations(request: PlanRequest, start: Array, reference: Array, unlimited: SolvedPlan) -> Solution:
    """Solve a request within its actuator limits; the initial guess is a motion that ignores these limits.

    Args:
        request: The request. If many starts are equally good, that of the first solution is fixed.
        start, reference: As in `tool_motion_problem`.
        unlimited: Motion without actuator limits.

    Raises:
        SolveError: No motion was found. Names the joint, the time, the demand without the limit, and the limit.
    """
    limits = request.actuator_limits or request.limits
    first = request.stretches[0]
    if request.start is None:
        # a joint that started elsewhere moves separated bodies: its start stays free
        initial = unlimited.solution[f"joints{first.suffix}"][0]
        start = np.where(np.isclose(initial, start, rtol=0.0), start, np.nan)

    fractions = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in request.stretches]
    breaks = np.unique(np.concatenate([np.zeros(0), *fractions])).tolist()

    def solve_from(initial: Array) -> Solution:
        def declare(constraints: ClearanceConstraints | None) -> Problem:
            guess: dict[str, Any] = {"start": initial, "reference": reference}
            actuation = Actuation(request.cost, request.rests, _undetermined_rows(request, unlimited))
            motion = declared_motion(request, **guess, constraints=constraints, actuation=actuation)
            _set_guess(motion, unlimited)
            return motion.problem

        joints = {"": (request.machine, limits)}
        return within_limits(declare, request.clearance_constraints, joints, breaks=breaks)

    try:
        solution = solve_from(start)
        audit = solution.audit()
        if audit.feasible and audit.optimal is None and np.isnan(start).any():
            fixed_solution = solve_from(solution[f"joints{first.suffix}"][0])
            if fixed_solution.audit().passed:
                return fixed_solution
    except SolveError as error:
        _add_demand(error, largest_demand(unlimited, limits))
        raise
    return solution


def _undetermined_rows(request: PlanRequest, unlimited: SolvedPlan) -> Array:
    """Return orthonormal rows (k, n) that span the joint velocities which tasks leave undetermined at the end."""
    last = request.stretches[-1]
    if last.equations is None:
        return np.eye(request.machine.joint_size)
    names = [f"{kind}{last.suffix}" for kind in ("base", "joints")]
    base, joints = (unlimited.solution[name][-1] if name in unlimited.solution.states else () for name in names)
    _, sizes, rows = np.linalg.svd(np.array(last.equations.jacobian_function(joints, base)))
    return np.asarray(rows[int((sizes > RESOLVED_SHARE * sizes.max(initial=0.0)).sum()) :])


def _add_demand(error: SolveError, demand: Reason | None) -> None:
    """Add to the text of an error what a motion demands of the actuators if it ignores their limits."""
    words = "no motion within the actuator limits was found"
    if demand is not None:
        words += f"; without them, {demand.detail}"
        assert demand.value is not None
        assert demand.limit is not None
        vars(error).update(demand.fault if demand.value > demand.limit else {})
    error.args = (f"{words}\n{error}",)


def _set_guess(motion: ToolMotion, unlimited: SolvedPlan) -> None:
    """Set the initial guess of the states and controls of a problem to a motion that ignores actuator limits."""
    fractions = np.linspace(0.0, 1.0, CHECKED_TIMES)
    sample = unlimited.solution.at_fraction(fractions)
    pace = sample[PACE] if unlimited.rate_name == SLOPES else 1.0
    for stretch, part in zip(motion.stretches, unlimited.parts, strict=True):
        values_by_name = {
            "base": sample.get(f"base{stretch.suffix}"),
            "joints": sample[f"joints{stretch.suffix}"],
            "velocities": sample[unlimited.rate_name + stretch.suffix] / pace,
            "accelerations": unlimited.accelerations(part, fractions),
        }
        named = {name + stretch.suffix: values for name, values in values_by_name.items()}
        for name, values in {**named, CLOCK: sample.get(CLOCK), PACE: sample.get(PACE)}.items():
            for pool in (motion.problem.declared.states, motion.problem.declared.controls):
                if values is not None and (variable := pool.get(name)) is not None:
                    pool[variable.name] = replace(variable, guess=Samples(fractions * motion.horizon, values))
