"""Redundancy resolved over the whole motion: the least joint velocity that does a task of the tip.

Problem (27) of the free-floating paper (Kim, Kim 2011), for any machine of `models`, on a fixed or a floating
base, and any task of `tip_task`: poses, free tool axes, several arms, a base held still.

Redundancy resolved over the whole motion, solved and audited: a plan that holds, or a reason why there is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import Machine
from ocp.audit.audit import Audit
from ocp.direct.collocation import Collocation
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, SolveError
from ocp.local.inverse_kinematics import inverse_kinematics
from ocp.local.rates import LocalSolution, least_rates, resolve
from ocp.local.reach import check_reach, leaves_limits
from ocp.methods import solve
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tasks.checks import check_closed, checked_tasks, dependent_rows
from ocp.tasks.equations import TaskEquations, bind
from ocp.tasks.start import Array, Velocity, checked_configuration, checked_horizon, checked_weights
from ocp.tasks.tip_task import TipTask, one_of

__all__ = ["minimum_velocity_problem", "plan_minimum_velocity"]

GUESS_TOLERANCE = 1e-8
LARGEST_DAMPING = 1.0


def minimum_velocity_problem(
    machine: Machine,
    tip_velocity: Velocity | None = None,
    rows: Sequence[int] | None = None,
    start_joints: Any = None,
    horizon: float | None = None,
    *,
    task: TipTask | Sequence[TipTask] | None = None,
    start_base: Any = None,
    free_start: bool = False,
    cyclic: bool = False,
    weights: Any = None,
    formulation: Literal["rates", "null_space"] = "rates",
    limits: bool = True,
    guess_damping: float = 0.005,
    symbols: Any = ca.SX,
) -> Problem:
    """Move the tip as told while the integral of half the squared joint rates, 1/2 |x2'|^2, is least (27).

    States "joints" and, on a floating base, "base". Two formulations of the same problem:

    "rates": control "rates" are the joint rates x2', the task G x2' = v is the path equality "task". Regular where the
        Jacobian loses rank as long as v stays in its range; the one to use.
    "null_space": control "null" is u of x2' = (1 - G# G) u + G# v, equation (26), which does the task by itself.
        Fragile: G# is unbounded where the Jacobian loses rank. The part G# G u of the control has no effect on the
        motion; 1/2 |G# G u|^2 is added to the cost, so that the running cost is 1/2 |u|^2 + 1/2 |G# v|^2. It vanishes
        at the optimum and makes the optimal u unique: u lies in the null space and x2' = u + G# v there. Without it
        shooting with linear controls takes hundreds of iterations instead of ten.

    What a machine with momentum does at rest (its drift), and the feedback of a pose task, are part of v.

    Args:
        machine: A FixedBase, a FreeFloating, or anything else that is a Machine.
        tip_velocity: Velocity v of the tip in the task's rows: a constant of shape (len(rows),), or a function that
            takes `problem.time` (s) and returns a casadi vector or a list of expressions.
        rows: Which rows of the tip's twist the task fixes: angular 0..2, linear 3..5, world axes.
        start_joints: Shape (joint_size,), rad or m. A guess where the start is free; then inverse kinematics finds one
            if None.
        horizon: Final time, s.
        task: Instead of tip_velocity and rows: a TipTask, or several that are done at once.
        start_base: Base configuration at the start, shape (base_size,); the machine's base_home() if None.
        free_start: Whether the joints start wherever the tip is where the task begins (path of poses), or where it is
            at start_joints (velocities): the start condition "start pose".
        cyclic: Whether the joints end where they started, after a closed task. What of this follows from the task is
            not asked twice: a constant velocity, state "closure", of the size of the discretisation error is left to
            the task, so that the joints close exactly. The base of a floating machine closes only if the task says so.
        weights: Of the squared joint rates in the cost, positive. Shape (joint_size,); all 1 if None.
        formulation: "rates" or "null_space".
        limits: Whether the robot's position limits bound the state "joints" and its velocity limits the joint rates (a
            bound of the control "rates", or the path constraint "velocity limits" of the null-space form).
        guess_damping: Damping of the local solution (ocp.local.rates.resolve) that is attached as the initial guess,
            relative to the root mean square of the singular values of the task's Jacobian at the start; raised where
            the local motion stops early. Small values start near the pseudo-inverse; large ones avoid its singular
            passages and may lead to another extremal: on the paper's example 0.001 to 0.02 lead to J = 1.7351, 0.03
            to J = 1.7467.
        symbols: casadi.SX, or casadi.MX when a track or velocity calls an interpolant.

    Returns:
        The problem, its guesses attached; nothing is solved but the local motion.

    Raises:
        ProblemError: Rows out of range, repeated, none, more than joints, moved by no joint, or dependent everywhere;
            wrong sizes; a start outside the limits, off the task's pose, or singular for the null-space form; a cyclic
            task that is not closed; a horizon or a damping that is not positive; an unknown formulation.
        Unreachable: No start found where it is free and not given (a ProblemError).
    """
    if formulation not in ("rates", "null_space"):
        raise ProblemError(f"unknown formulation {formulation!r}; use 'rates' or 'null_space'")
    if not (np.isfinite(guess_damping) and guess_damping > 0):
        raise ProblemError(f"guess_damping must be positive, not {guess_damping!r}")
    equations, duration = bind(machine, one_of(tip_velocity, rows, task)), checked_horizon(horizon)
    if start_joints is None and free_start:
        tasks = [part.task for part in equations.bound]
        start_joints = inverse_kinematics(machine, tasks, base=start_base, limits=limits)[0].joints
    start, place = checked_configuration(machine, start_joints, start_base)
    heavy = checked_weights(weights, machine.joint_size)
    checked_tasks(equations, place, start, duration, start=not free_start)
    if formulation == "null_space" and (task_name := dependent_rows(equations, place, start)):
        raise ProblemError(
            f"{task_name} is singular at the start joints {start.tolist()}, where the "
            "null-space form does not exist; use formulation='rates' or start elsewhere"
        )
    if cyclic:
        check_closed(equations, duration)
    lower, upper, speed = _limits(machine, limits)
    _check_inside(machine, start, lower, upper)
    local = _local_motion(equations, start, place, duration, heavy, guess_damping)

    problem = Problem(f"minimum velocity, {formulation.replace('_', ' ')}", symbols=symbols)
    base: Any = np.zeros(0)
    if machine.base_size:
        base = problem.state("base", initial=place, guess=_guess(local, "base"))
    joints = problem.state(
        "joints",
        machine.joint_size,
        initial=None if free_start else start,
        terminal=start if cyclic and not free_start else None,
        lower=lower,
        upper=upper,
        guess=_guess(local, "joints"),
    )
    problem.horizon(duration)
    try:
        targets = equations.targets(problem.time)
    except (RuntimeError, NotImplementedError) as error:
        raise ProblemError("the task calls an interpolant or an external function: pass symbols=casadi.MX") from error
    closure: Any = ca.DM(equations.size, 1)
    if cyclic and (directions := equations.closing(place, start)).shape[1]:
        slack = problem.state("closure", directions.shape[1], guess=0.0)
        problem.dynamics(slack, np.zeros(directions.shape[1]))
        closure = ca.mtimes(ca.DM(directions), slack)

    running: Any = 0
    if formulation == "rates":
        rates = problem.control("rates", lower=-speed, upper=speed, guess=_guess(local, "joint_rates"))
        base_rate = machine.base_rate(base, joints, rates)
        residual = equations.residual(base, joints, rates, targets)
        base_rate, residual = ca.cse([base_rate, residual])  # both contain the kinematics
        problem.path("task", residual - closure, lower=0, upper=0)
    else:
        null = problem.control("null", machine.joint_size, guess=0.0)  # local motion has no part there
        wanted = equations.right(base, joints, targets) + closure
        root = np.sqrt(heavy)  # in the scaled rates root x2' the weights are one
        scaled = ca.mtimes(equations.jacobian(base, joints), ca.diag(1 / ca.DM(root)))
        both = least_rates(scaled, ca.horzcat(wanted, ca.mtimes(scaled, null)))
        idle = both[:, 1]  # G# G u, without effect
        rates = (null + both[:, 0] - idle) / ca.DM(root)
        base_rate, rates, idle = ca.cse([machine.base_rate(base, joints, rates), rates, idle])
        running += ca.dot(idle, idle) / 2
        if np.isfinite(speed).any():
            problem.path("velocity limits", rates, lower=-speed, upper=speed)
    if machine.base_size:
        problem.dynamics(base, base_rate)
    problem.dynamics(joints, rates)
    if free_start:
        _start_conditions(problem, equations, place, start, base, joints)
        if cyclic:
            problem.end("cyclic", joints - problem.at_start(joints), 0, 0)
    problem.minimize(running=running + ca.dot(rates, ca.DM(heavy) * rates) / 2)
    return problem


def _local_motion(
    equations: TaskEquations, start: Array, base: Array, horizon: float, weights: Array, damping: float
) -> LocalSolution:
    """Damped local motion over as much of the horizon as can be, with more damping where it stops early."""
    jacobian = np.array(ca.DM(equations.jacobian(base, start)))
    size, best = float(np.linalg.norm(jacobian)) / np.sqrt(equations.size), None
    while True:
        local = resolve(
            equations.machine,
            task=[part.task for part in equations.bound],
            start_joints=start,
            horizon=horizon,
            start_base=base,
            weights=weights,
            damping=damping * size,
            tolerance=GUESS_TOLERANCE,
            check_start=False,
        )
        best = local if best is None or local.t[-1] > best.t[-1] else best
        if local.stopped is None or damping >= LARGEST_DAMPING:
            return best
        damping = min(5 * damping, LARGEST_DAMPING)


def _start_conditions(
    problem: Problem, equations: TaskEquations, place: Array, start: Array, base: Any, joints: Any
) -> None:
    """The tip is where the pose tasks begin, and for velocity tasks where it is at the joints given."""
    at_zero = equations.target_function()(0.0)
    pose = np.repeat([part.task.is_pose for part in equations.bound], [part.task.size for part in equations.bound])
    error = equations.error(base, joints, at_zero)[np.flatnonzero(pose).tolist()]
    problem.start("start pose", ca.vertcat(error, equations.holding(base, joints, place, start)), 0, 0)


def _limits(machine: Machine, limits: bool) -> tuple[Array, Array, Array]:
    robot = machine.robot
    if limits:
        return robot.lower, robot.upper, robot.velocity
    unbounded = np.full(machine.joint_size, np.inf)
    return -unbounded, unbounded, unbounded


def _check_inside(machine: Machine, joints: Array, lower: Array, upper: Array) -> None:
    for name, value, low, high in zip(machine.robot.joint_names, joints, lower, upper, strict=True):
        if not low <= value <= high:
            raise ProblemError(
                f"start_joints: {name!r} starts at {value:g}, outside its limits {low:g} .. {high:g}; "
                "start inside or pass limits=False"
            )


def _guess(local: LocalSolution, what: str) -> Samples:
    times, values = local.t, getattr(local, what)
    if what == "joint_rates" and local.stopped is not None:  # it stands still from there
        times, values = np.append(times, times[-1] + 1e-9), np.vstack([values, 0 * values[-1:]])
    return Samples(times, values)


OPTIONS = {"max_iter": 150}
"""Of IPOPT."""
LOCAL = ("tip_velocity", "rows", "task", "start_joints", "horizon", "start_base", "weights")
LOOKS = 51
WORSE = 1e-6
GAP = 1e-6
"""Largest way, m and rad, that a cyclic task may give so that the joints close."""
STRAY = 1e-6
"""Way, m and rad, that the re-integrated tip may stray from its task before a finer mesh is tried."""
MESHES = 3
"""Of each guess, each twice as fine as the one before."""


def plan_minimum_velocity(
    machine: Machine,
    *,
    method: Collocation | None = None,
    dampings: Sequence[float] = (0.005, 0.05, 0.3),
    options: Mapping[str, Any] | None = None,
    **asked: Any,
) -> Solution:
    """Solve `minimum_velocity_problem` and audit the plan; from other guesses and finer meshes where it does not hold.

    The first plan that passes its audit and costs no more than the pseudo-inverse is returned; else the cheapest that
    passes. A plan that passes but whose re-integrated tip strays from its task by more than 1e-6 (m, rad) is solved
    again from itself on up to two meshes, each twice as fine; the last of them that passes stands for it. One that
    fails is solved again on a mesh twice as fine, and once more where that halved the failure.

    Args:
        machine: As for minimum_velocity_problem.
        method: Collocation; 50 Radau intervals of degree 4 if None.
        dampings: Of the guesses, in the order in which they are tried.
        options: Of IPOPT, besides those above.
        asked: The other arguments of minimum_velocity_problem: tip_velocity and rows, or task, start_joints, ...

    Raises:
        SolveError: No guess leads to a plan that passes; says what became of each.
        ProblemError: As minimum_velocity_problem; Unreachable, which is one, where a fixed machine cannot reach what
            its tasks ask (see ocp.local.reach).
    """
    if not len(dampings):
        raise ProblemError("dampings are empty: there is no guess to start from")
    if "guess_damping" in asked:
        raise ProblemError("give dampings=(...,) instead of guess_damping")
    how = method or Collocation(intervals=50, degree=4)
    settings = {**OPTIONS, **(options or {})}
    local = _local_start(machine, asked)
    _check_reach(machine, asked, local)
    target = _comparable_cost(asked, local)
    passed: list[Solution] = []
    reasons: list[str] = []
    last: Solution | None = None
    for damping in dampings:
        problem, guess, mesh = minimum_velocity_problem(machine, guess_damping=damping, **asked), None, how
        found: Solution | None = None
        before = np.inf
        for attempt in range(MESHES):
            name = f"damping {damping:g}, {mesh.intervals} intervals"
            # what conflicts is looked for once: it takes long
            final = damping == dampings[-1] and not passed and found is None
            try:
                solution = solve(problem, mesh, options=settings, guess=guess, check=final)
            except SolveError as error:
                last = error.solution or last
                reasons.append(f"{name}: {error}")
                break
            if not solution.success:
                if "User_Requested_Stop" in solution.status:
                    raise SolveError(f"interrupted in the solve with {name}", solution)
                last = solution
                reasons.append(f"{name}: ipopt ended with {solution.status.split(':')[0]}")
                break
            audit = solution.audit()
            gap = float(np.abs(solution["closure"]).max()) * solution.horizon if "closure" in solution.states else 0.0
            if audit.passed and gap <= GAP:
                found, guess, mesh = solution, solution, replace(mesh, intervals=2 * mesh.intervals, mesh=None)
                if _stray(machine, asked, audit) <= STRAY:
                    break
                continue
            worst = audit.failures[0] if audit.failures else None
            why = f"the audit fails, {worst.name} {worst.value:.2g}" if worst else f"the task gives way by {gap:.2g}"
            reasons.append(f"{name}: {why}")
            last, guess, mesh = solution, solution, replace(mesh, intervals=2 * mesh.intervals, mesh=None)
            excess = worst.value / worst.limit if worst and worst.limit else np.inf
            if attempt and not excess < before / 2:
                break  # a finer mesh does not help
            before = excess
        if found is None:
            continue
        passed.append(found)
        if passed[-1].cost <= target * (1 + WORSE):
            return passed[-1]
    if not passed:
        raise SolveError("no plan of minimum velocity passes its audit:\n" + "\n".join(reasons), last)
    return min(passed, key=lambda solution: solution.cost)


def _stray(machine: Machine, asked: Mapping[str, Any], audit: Audit) -> float:
    """Largest time integral of the task's residual along the re-integrated plan, m and rad.

    Of a velocity it is how far the tip ends off its path. The null-space form does its task by itself: 0.
    """
    if "rates" not in audit.controls:
        return 0.0
    equations = bind(machine, one_of(asked.get("tip_velocity"), asked.get("rows"), asked.get("task")))
    sizes = (machine.base_size, machine.joint_size, machine.joint_size)
    base, joints, rates, time = [ca.MX.sym("v", size) for size in (*sizes, 1)]
    targets = equations.target_function()(time)
    residual = ca.Function("r", [base, joints, rates, time], [equations.residual(base, joints, rates, targets)])
    places = audit.states["base"] if machine.base_size else np.zeros((len(audit.t), 0))
    inputs = (places.T, audit.states["joints"].T, audit.controls["rates"].T, audit.t[None])
    off = np.array(residual.map(len(audit.t))(*inputs)).T
    steps = np.diff(audit.t)[:, None] * (off[1:] + off[:-1]) / 2
    return float(np.abs(np.cumsum(steps, axis=0)).max())


def _local_start(machine: Machine, asked: Mapping[str, Any]) -> LocalSolution | None:
    """The pseudo-inverse from the same start; None where the start is singular or not given."""
    try:
        return resolve(machine, **{name: asked[name] for name in LOCAL if name in asked}, samples=LOOKS)
    except ProblemError:
        return None


def _comparable_cost(asked: Mapping[str, Any], local: LocalSolution | None) -> float:
    """Cost of the pseudo-inverse where it answers the same question and reaches the end; else infinite."""
    if local is None or local.stopped or asked.get("free_start") or asked.get("cyclic"):
        return np.inf
    return float(local.cost[-1])


def _check_reach(machine: Machine, asked: Mapping[str, Any], local: LocalSolution | None) -> None:
    """Raise Unreachable where the task is out of reach; looked for only where the local motion hints at it."""
    limits = asked.get("limits", True)
    if local is None or (local.stopped is None and not (limits and leaves_limits(machine, local))):
        return
    tasks = one_of(asked.get("tip_velocity"), asked.get("rows"), asked.get("task"))
    check_reach(machine, tasks, local.joints[0], float(asked["horizon"]), limits, local.joints[:: LOOKS // 5])
