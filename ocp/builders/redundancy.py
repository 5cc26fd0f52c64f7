"""Redundancy resolved over the whole motion: the least joint velocity that does a task of the tip.

Problem (27) of the free-floating paper (Kim, Kim 2011), for any machine of `models`, on a fixed or a floating
base, and any task of `tip_task`: poses, free tool axes, several arms, a base held still. Declared by
`minimum_velocity_problem`; solved and audited by `plan_minimum_velocity`: a plan that holds, or a reason why there is
none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models import Machine
from models.arrays import Array
from ocp.audit.audit import Audit
from ocp.builders.clearance import Clear, keeping_clear, touching_error
from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.direct.guess import Samples
from ocp.errors import (
    ProblemError,
    SolveError,
    checked_choice,
    checked_each,
    checked_flag,
    checked_instance,
    checked_mapping,
    checked_positive,
)
from ocp.local.inverse_kinematics import check_reach, inverse_kinematics
from ocp.local.rates import LocalSolution, least_rates, resolve
from ocp.methods import solve
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.status import SolverStatus
from ocp.tasks.checks import (
    check_closed,
    checked_configuration,
    checked_horizon,
    checked_tasks,
    checked_weights,
    dependent_rows,
    inside_limits,
)
from ocp.tasks.equations import TaskEquations, bind
from ocp.tasks.tip_task import TipTask, Velocity, one_of

__all__ = ["minimum_velocity_problem", "plan_minimum_velocity"]

Form: TypeAlias = Literal["rates", "null_space"]

GUESS_TOLERANCE = 1e-8
"""Of the integration of the local motion that serves as the guess."""
LARGEST_DAMPING = 1.0
"""Of the guess: the local motion is not damped further where it stops early."""
LOCAL_SAMPLES = 51
"""Of the pseudo-inverse motion that hints at what is out of reach."""
IPOPT = {"max_iter": 150}
MESHES = 3
"""Of each guess, each twice as fine as the one before."""
LARGEST_STRAY = 1e-6
"""Way, m and rad, that the re-integrated tip may stray from its task before a finer mesh is tried."""
LARGEST_CLOSURE = 1e-6
"""Way, m and rad, that a cyclic task may give so that the joints close."""
DEARER = 1e-6
"""Share by which a plan may cost more than the pseudo-inverse without another guess being tried."""


@interruptible
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
    formulation: Form = "rates",
    limits: bool = True,
    guess_damping: float = 0.005,
    clear: Clear | None = None,
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
        machine, tip_velocity, rows, horizon, task, start_base: As of `ocp.local.rates.resolve`.
        start_joints: Shape (joint_size,), rad or m. A guess where the start is free; then inverse kinematics finds one
            if None.
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
        clear: What the motion has to stay clear of, see `ocp.builders.clearance`.
        symbols: casadi.SX; or casadi.MX for the indirect method where a track or velocity calls an interpolant, which
            else becomes a signal (`Problem.signal`).

    Returns:
        The problem, its guesses attached; nothing is solved but the local motion.

    Raises:
        ProblemError: Rows out of range, repeated, none, more than joints, moved by no joint, or dependent everywhere;
            wrong sizes; a start outside the limits, off the task's pose, or singular for the null-space form; a cyclic
            task that is not closed; a horizon or a damping that is not positive; an unknown formulation.
        Unreachable: No start found where it is free and not given (a ProblemError).
    """
    checked_choice("formulation", formulation, get_args(Form))
    checked_positive("guess_damping", guess_damping)
    for what, flag in (("free_start", free_start), ("cyclic", cyclic), ("limits", limits)):
        checked_flag(what, flag)
    equations, duration = bind(machine, one_of(tip_velocity, rows, task)), checked_horizon(horizon)
    if start_joints is None and free_start:
        tasks = [part.task for part in equations.bound]
        start_joints = inverse_kinematics(machine, tasks, base=start_base, limits=limits)[0].joints
    start, place = checked_configuration(machine, start_joints, start_base)
    heavy = checked_weights(weights, machine.joint_size)
    checked_tasks(equations, place, start, duration, start=not free_start)
    if formulation == "null_space" and (task_name := dependent_rows(equations, place, start)):
        message = (
            f"{task_name} is singular at the start joints {start.tolist()}, where the "
            "null-space form does not exist; use formulation='rates' or start elsewhere"
        )
        raise ProblemError(message, name=task_name, value=start)
    if cyclic:
        check_closed(equations, duration)
    robot, unbounded = machine.robot, np.full(machine.joint_size, np.inf)
    lower, upper, speed = (robot.lower, robot.upper, robot.velocity) if limits else (-unbounded, unbounded, unbounded)
    start = inside_limits("start_joints", robot.joint_names, start, lower, upper, "start inside or pass limits=False")
    local = _local_motion(equations, start, place, duration, heavy, guess_damping)
    problem = Problem(f"minimum velocity, {formulation.replace('_', ' ')}", symbols=symbols)
    base: Any = np.zeros(0)
    if machine.base_size:
        unit = "m, rad" if machine.base_size == 3 else "m, 1"  # a quaternion has none
        base = problem.state("base", initial=place, guess=_guess(local, "base"), unit=unit)
    ends = {} if free_start else {"initial": start, "terminal": start if cyclic else None}
    joints = problem.state(
        "joints", machine.joint_size, **ends, lower=lower, upper=upper, guess=_guess(local, "joints"), unit=robot.unit()
    )
    problem.horizon(duration)
    try:
        targets = equations.targets(problem.time)
    except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
        targets = problem.signal("targets", equations.targets)
    closure: Any = ca.DM(equations.size, 1)
    if cyclic and (directions := equations.closing(place, start)).shape[1]:
        slack = problem.state("closure", directions.shape[1], guess=0.0, unit=equations.unit())
        problem.dynamics(slack, np.zeros(directions.shape[1]))
        closure = ca.mtimes(ca.DM(directions), slack)

    running: Any = 0
    per_second = robot.unit("/s")
    if formulation == "rates":
        rates = problem.control("rates", lower=-speed, upper=speed, guess=_guess(local, "joint_rates"), unit=per_second)
        base_rate = machine.base_rate(base, joints, rates)
        residual = equations.residual(base, joints, rates, targets)
        base_rate, residual = ca.cse([base_rate, residual])  # both contain the kinematics
        problem.path("task", residual - closure, lower=0, upper=0, unit=equations.unit())
        for name, stray in equations.strays(base, joints, rates, targets).items():
            problem.watch(name, **stray)
    else:
        # local motion has no part there
        null = problem.control("null", machine.joint_size, guess=0.0, unit=per_second)
        wanted = equations.right(base, joints, targets) + closure
        root = np.sqrt(heavy)  # in the scaled rates root x2' the weights are one
        scaled = ca.mtimes(equations.jacobian(base, joints), ca.diag(1 / ca.DM(root)))
        both = least_rates(scaled, ca.horzcat(wanted, ca.mtimes(scaled, null)))
        idle = both[:, 1]  # G# G u, without effect
        rates = (null + both[:, 0] - idle) / ca.DM(root)
        base_rate, rates, idle = ca.cse([machine.base_rate(base, joints, rates), rates, idle])
        running += ca.dot(idle, idle) / 2
        if np.isfinite(speed).any():
            problem.path("velocity limits", rates, lower=-speed, upper=speed, unit=per_second)
    if machine.base_size:
        problem.dynamics(base, base_rate)
    problem.dynamics(joints, rates)
    if clear is not None:
        name = "base" if machine.base_size else ""
        checked_instance("clear", clear, Clear).declare(problem, base, joints, base_name=name, horizon=duration)
    if free_start:
        _start_conditions(problem, equations, place, start, base, joints)
        if cyclic:
            problem.end("cyclic", joints - problem.at_start(joints), 0, 0, unit=robot.unit())
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
    condition = ca.vertcat(error, equations.holding(base, joints, place, start))
    problem.start("start pose", condition, 0, 0, unit=equations.unit("", ""))


def _guess(local: LocalSolution, what: str) -> Samples:
    times, values = local.t, getattr(local, what)
    if what == "joint_rates" and local.stopped is not None:  # it stands still from there
        times, values = np.append(times, times[-1] + 1e-9), np.vstack([values, 0 * values[-1:]])
    return Samples(times, values)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """What is tried: the problem declared with one damping of its local motion, on a mesh.

    Attributes:
        guess: The plan on the mesh before; None for the local motion.
        why: What was wrong with that plan.
    """

    problem: Problem
    damping: float
    mesh: Collocation
    guess: Solution | None = None
    why: str = ""

    def __str__(self) -> str:
        return f"damping {self.damping:g}, {self.mesh.intervals} intervals{self.why and f', from the plan {self.why}'}"


@dataclass(frozen=True, eq=False)
class _Outcome:
    """What became of an attempt.

    Attributes:
        solution: The plan, or the last iterate where there is none.
        failure: What is wrong with it, which is not raised; None where the plan passes.
        flaw: What a finer mesh may mend; None where nothing.
        excess: The audit's worst value over its limit; infinite where there is none.
        touching: That bodies touch, where this alone is wrong with it.
    """

    attempt: _Attempt
    solution: Solution | None
    failure: SolveError | None = None
    flaw: str | None = None
    excess: float = np.inf
    touching: SolveError | None = None

    @property
    def plan(self) -> Solution | None:
        return None if self.failure else self.solution


@interruptible
def plan_minimum_velocity(
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
    formulation: Form = "rates",
    limits: bool = True,
    clear: Clear | None = None,
    symbols: Any = ca.SX,
    method: Collocation | None = None,
    dampings: Sequence[float] = (0.005, 0.05, 0.3),
    options: Mapping[str, Any] | None = None,
) -> Solution:
    """Solve `minimum_velocity_problem` and audit the plan; from other guesses and finer meshes where it does not hold.

    The first plan that passes its audit and costs no more than the pseudo-inverse is returned; else the cheapest that
    passes. A plan that passes but whose re-integrated tip strays from its task by more than 1e-6 (m, rad) is solved
    again from itself on up to two meshes, each twice as fine; the last of them that passes stands for it. One that
    fails is solved again on a mesh twice as fine, and once more where that halved the failure.

    Args:
        machine, ..., symbols: As of `minimum_velocity_problem`.
        method: Collocation; 50 Radau intervals of degree 4 if None, with nodes where the pieces of the tasks meet.
        dampings: Of the guesses (`guess_damping`), in the order in which they are tried.
        clear: What the motion has to stay clear of; bodies that touch are held apart, and it is planned anew.
        options: Of IPOPT, besides at most 150 iterations.

    Raises:
        SolveError: No guess leads to a plan that passes; says what became of each, and carries what the last one lacks.
        ProblemError: As minimum_velocity_problem; Unreachable, which is one, where a fixed machine cannot reach what
            its tasks ask (see ocp.local.inverse_kinematics.check_reach).
    """
    for what, flag in (("free_start", free_start), ("cyclic", cyclic), ("limits", limits)):
        checked_flag(what, flag)
    if method is not None:
        checked_instance("method", method, Collocation)
    options = checked_mapping("options", options)
    for damping in checked_each("dampings", dampings, Real):  # type: ignore[type-abstract]
        checked_positive("dampings", damping)
    if not len(dampings):
        raise ProblemError("dampings are empty: there is no guess to start from", name="dampings", value=dampings)
    tasks = one_of(tip_velocity, rows, task)
    asked: dict[str, Any] = {"start_joints": start_joints, "horizon": horizon, "task": tasks}
    asked |= {"start_base": start_base, "weights": weights}
    target = np.inf  # cost of the pseudo-inverse from the same start, where it answers the same question
    try:
        local = resolve(machine, **asked, samples=LOCAL_SAMPLES)
    except ProblemError:  # the start is singular or not given
        pass
    else:
        outside = (local.joints < machine.robot.lower) | (local.joints > machine.robot.upper)
        if local.stopped or (limits and outside.any()):  # hints at what is out of reach
            near = local.joints[:: LOCAL_SAMPLES // 5]
            check_reach(machine, tasks, local.joints[0], checked_horizon(horizon), limits, near)
        if not (local.stopped or free_start or cyclic):
            target = float(local.cost[-1])
    asked |= {"free_start": free_start, "cyclic": cyclic, "formulation": formulation, "limits": limits}
    mesh, settings = method or _default_mesh(tasks, checked_horizon(horizon)), {**IPOPT, **options}

    def run(clear: Clear | None) -> Solution:
        declare = partial(minimum_velocity_problem, machine, **asked, clear=clear, symbols=symbols)
        return _cheapest(machine, tasks, declare, mesh, dampings, target, settings)

    return keeping_clear(clear, run)


def _cheapest(
    machine: Machine,
    tasks: list[TipTask],
    declare: Callable[..., Problem],
    mesh: Collocation,
    dampings: Sequence[float],
    target: float,
    settings: Mapping[str, Any],
) -> Solution:
    """The plan that `plan_minimum_velocity` returns.

    Raises:
        SolveError: As it does; at once where a plan is sound but for bodies that touch.
    """
    tried: list[_Outcome] = []
    for attempt in _attempts(declare, mesh, dampings, target, tried):
        # what conflicts is looked for once: it takes long
        explain = attempt.damping == dampings[-1] and not any(one.plan for one in tried)
        tried.append(_outcome(machine, tasks, attempt, settings, explain))
        if tried[-1].touching:
            raise tried[-1].touching
    standing = {one.attempt.damping: one.plan for one in tried if one.plan}  # of each guess the plan on its finest mesh
    if not standing:
        reasons = "\n".join(f"{one.attempt}: {one.failure}" for one in tried)
        last = next((one.solution for one in reversed(tried) if one.solution), None)
        why = next((one.failure for one in reversed(tried) if one.failure and one.failure.name), SolveError())
        raise SolveError(
            f"no plan of minimum velocity passes its audit:\n{reasons}", last, why.conflicts,
            name=why.name, value=why.value, limit=why.limit, time=why.time,
        )  # fmt: skip
    return min(standing.values(), key=lambda plan: plan.cost)


def _default_mesh(tasks: Sequence[TipTask], horizon: float) -> Collocation:
    """50 intervals, with nodes at the breaks of the tasks."""
    at = np.concatenate([np.zeros(0), *(task.begin + np.asarray(task.breaks) for task in tasks)]) / horizon
    return Collocation(intervals=50, degree=4).with_nodes_at(at[(at > 0) & (at < 1)])


def _attempts(
    declare: Callable[..., Problem], mesh: Collocation, dampings: Sequence[float], target: float, tried: list[_Outcome]
) -> Iterator[_Attempt]:
    """Each guess on meshes refined from the plan before, until a plan stands that is no dearer than the target.

    What became of an attempt must be the last of `tried` when the next one is asked for.
    """
    for damping in dampings:
        attempt, plan, excess = _Attempt(declare(guess_damping=damping), damping, mesh), None, np.inf
        for number in range(MESHES):
            yield attempt
            outcome = tried[-1]
            plan = outcome.plan or plan
            helps = outcome.plan or not number or outcome.excess < excess / 2
            if not (outcome.flaw and helps):
                break
            excess = excess if outcome.plan else outcome.excess
            attempt = replace(attempt, mesh=attempt.mesh.halved(), guess=outcome.solution, why=outcome.flaw)
        if plan and plan.cost <= target * (1 + DEARER):
            return


def _outcome(
    machine: Machine, tasks: list[TipTask], attempt: _Attempt, options: Mapping[str, Any], explain: bool
) -> _Outcome:
    try:
        solution = solve(attempt.problem, attempt.mesh, options=options, guess=attempt.guess, check=explain)
    except SolveError as error:
        return _Outcome(attempt, error.solution, error)
    if not solution.success:
        if solution.status is SolverStatus.INTERRUPTED:
            raise SolveError(f"interrupted in the solve with {attempt}", solution, name=str(attempt))
        ended = SolveError(f"ipopt ended with {solution.status}", name="ipopt", value=solution.message)
        return _Outcome(attempt, solution, ended)
    audit = solution.audit()
    if not audit.passed and audit.failures:  # what is not decided to be a minimum may be run; its audit says so
        touching = touching_error(audit, solution)
        worst = audit.failures[0]
        details = {"value": worst.value, "limit": worst.limit, "time": worst.time}
        failure = SolveError(f"the audit fails, {worst.name} {worst.value:.2g}", name=worst.name, **details)
        excess = worst.value / worst.limit if worst.limit else np.inf
        return _Outcome(attempt, solution, failure, "whose audit fails", excess, touching)
    gap = float(np.abs(solution["closure"]).max()) * solution.horizon if "closure" in solution.states else 0.0
    if gap > LARGEST_CLOSURE:
        failure = SolveError(f"the task gives way by {gap:.2g}", name="task", value=gap, limit=LARGEST_CLOSURE)
        return _Outcome(attempt, solution, failure, "that gives way")
    strays = _stray(machine, tasks, audit) > LARGEST_STRAY
    return _Outcome(attempt, solution, flaw="whose tip strays" if strays else None)


def _stray(machine: Machine, tasks: list[TipTask], audit: Audit) -> float:
    """Largest time integral of the task's residual along the re-integrated plan, m and rad.

    Of a velocity it is how far the tip ends off its path. The null-space form does its task by itself: 0.
    """
    if "rates" not in audit.controls:
        return 0.0
    equations = bind(machine, tasks)
    sizes = (machine.base_size, machine.joint_size, machine.joint_size)
    base, joints, rates, time = [ca.MX.sym("v", size) for size in (*sizes, 1)]
    targets = equations.target_function()(time)
    residual = ca.Function("r", [base, joints, rates, time], [equations.residual(base, joints, rates, targets)])
    places = audit.states["base"] if machine.base_size else np.zeros((len(audit.t), 0))
    inputs = (places.T, audit.states["joints"].T, audit.controls["rates"].T, audit.t[None])
    off = np.array(residual.map(len(audit.t))(*inputs)).T
    steps = np.diff(audit.t)[:, None] * (off[1:] + off[:-1]) / 2
    return float(np.abs(np.cumsum(steps, axis=0)).max())
