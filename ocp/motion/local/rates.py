"""Instantaneous redundancy resolution at velocity level: the least joint rates that perform the task at each time.

This is the classical method to which optimal plans are compared. `resolve` integrates one motion accurately.
`track_tasks` tracks tasks from many start configurations at once, on one grid of times and within the joint limits, at
low cost: it shows where each start leads, at what cost, and where it cannot track the task. Its motions are guesses of
plans.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
import scipy

from models import FreeFloating, Machine, find_wheels
from models.checks import Array, real
from models.files import INPUT_LIMITS
from models.spatial import solve_spd
from ocp.console import interruptible
from ocp.curves import integrator
from ocp.errors import ProblemError, require
from ocp.motion.tasks.checks import checked_tasks, checked_weights, dependent_rows, horizon_of
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Start
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import on_symbols
from ocp.problem.values import Sampler, symbols_of

MAX_INTEGRATOR_STEPS = 20000  # largest number of integrator steps between two samples; a smooth motion takes some tens


@dataclass(frozen=True)
class LocalSolution:
    """Motion from local redundancy resolution (resolved-rate control) at M sample times.

    Attributes:
        t: Times, the first 0. Shape (M,), s.
        base, joints: Base configuration and joint positions. Shapes (M, base_size), (M, joint_size).
        base_rates, joint_rates: Their time derivatives.
        tip_in_world: Position of the tip. Shape (M, 3), m.
        manipulability: Undamped manipulability of the rows of the tasks. Shape (M,).
        cost: Integral of half the (weighted) squared joint rates, up to each time. Shape (M,).
        tolerance: Absolute and relative tolerance of the integration.
        stopped: Reason why the motion ends before the horizon, None if it does not.
        task_error: Target pose minus pose in the rows of the tasks, m and rad; zero for velocities. Shape (M, rows).
    """

    t: Array
    base: Array
    joints: Array
    joint_rates: Array
    base_rates: Array
    tip_in_world: Array
    manipulability: Array
    cost: Array
    tolerance: float
    stopped: str | None = None
    task_error: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __repr__(self) -> str:
        end = f", stopped: {self.stopped}" if self.stopped else ""
        return f"<LocalSolution of {self.t[-1]:.6g} s, {self.joints.shape[1]} joints: cost {self.cost[-1]:.6g}{end}>"

    def at(self, time: float) -> dict[str, Array]:
        """Interpolate "base" and "joints" cubically and "joint_rates" linearly; times are clipped to the motion."""
        time = float(np.clip(time, self.t[0], self.t[-1]))
        rates = np.array([np.interp(time, self.t, column) for column in self.joint_rates.T])
        if len(self.t) == 1:
            return {"base": self.base[0], "joints": self.joints[0], "joint_rates": rates}
        base, joints = (
            scipy.interpolate.CubicHermiteSpline(self.t, values, slopes)(time)
            for values, slopes in ((self.base, self.base_rates), (self.joints, self.joint_rates))
        )
        return {"base": base, "joints": joints, "joint_rates": rates}


@dataclass(frozen=True, eq=False)
class RateOptions:
    """Options of resolved-rate control: weights and damping of the joint rates, and accuracy of the integration.

    Attributes:
        weights: Positive weights of the squared joint rates that are minimised. Shape (joint_size,); all 1 if None.
        damping: 0 for the pseudo-inverse G# = G' (G G')^-1; otherwise G' (G G' + damping^2 1)^-1, which stays bounded
            where the Jacobian G loses rank, at the price of a task error.
        tolerance: Absolute and relative tolerance of the integrator (cvodes, Adams).

    Raises:
        ProblemError: The damping is negative, or the tolerance is not positive.
    """

    weights: Any = None
    damping: float = 0.0
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        require.nonnegative("damping", self.damping)
        require.positive("tolerance", self.tolerance)


@interruptible
def resolve(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | None = None,
    *,
    start: Any,
    samples: Any = 501,
    options: RateOptions | None = None,
) -> LocalSolution:
    """Compute a motion along tasks by resolved-rate control, with the least joint rates at each time.

    The joint rates are G# v, see `RateOptions`: equation (26) of Kim and Kim 2011 with u = 0. The drift of the machine
    at rest and the feedback of pose tasks are part of v. The motion ends at the horizon, or at the last sample before
    it breaks down, with the reason in `stopped`.

    Args:
        machine: Any machine of `models`, on a fixed or a floating base.
        tasks: Tasks of its tips; several are done at once.
        horizon: Final time, s; that of the tasks if None.
        start: Start configuration, shape (joint_size,), or a `Start` with the joints and the base.
        samples: Number of equidistant times to report, or the increasing times themselves from 0 to the horizon.
        options: Weights, damping and tolerance.

    Raises:
        ProblemError: An argument does not fit the machine, or the task is singular at the start.
    """
    equations = bind(machine, tasks)
    own = RateOptions() if options is None else require.instance("options", options, RateOptions)
    _, joints, base = Start.of(start, machine, known=True)
    duration = horizon_of([part.task for part in equations.bound], horizon)
    rate_weights = checked_weights(own.weights, machine.joint_size)
    checked_tasks(equations, base, joints, duration)
    times = _sample_times(samples, duration)
    if own.damping == 0 and (rows_dependent := dependent_rows(equations, base, joints)):
        words = f"{rows_dependent} is singular at the start joints {joints.tolist()}; start elsewhere, fix fewer rows, "
        words += "or give RateOptions(damping=...)"
        raise ProblemError(words, name=rows_dependent, value=joints, time=0.0)
    model = on_symbols(lambda symbols: _Model(equations, rate_weights, own.damping, symbols))
    states, costs, stopped = _integrate(model, np.concatenate([base, joints]), times, own.tolerance)
    return _report(machine, model, times[: len(states)], states, costs, own.tolerance, stopped)


def least_rates(jacobian: Any, velocity: Any, damping: float = 0.0, weights: Any = None) -> Any:
    """Return the damped least-squares joint rates W^-1 G' (G W^-1 G' + damping^2 1)^-1 v. Shape (n, k).

    G (m, n), m <= n, is the Jacobian, v (m, k) are task velocities, and W = diag(weights) weighs the squared joint
    rates, all by 1 if None. The damping is in units of the Jacobian.
    """
    weighted = jacobian.T if weights is None else ca.mtimes(ca.diag(1 / ca.DM(weights)), jacobian.T)
    square = ca.mtimes(jacobian, weighted) + damping**2 * ca.DM.eye(jacobian.shape[0])
    return ca.mtimes(weighted, solve_spd(square, velocity))


def _sample_times(samples: Any, horizon: float) -> Array:
    """Return sample times, given their number or an array; raise ProblemError unless they cover the horizon."""
    if not isinstance(samples, list | tuple | np.ndarray):
        count = real(samples)
        if not (2 <= count <= INPUT_LIMITS.count and count == int(count)):
            words = f"samples must be at least 2 points or an array of times, not {samples!r}"
            raise ProblemError(words, name="samples", value=samples, limit=2)
        return np.linspace(0.0, horizon, int(count))
    times = require.array("samples", samples, ("times",), least=2)
    if times[0] != 0 or not np.isclose(times[-1], horizon, rtol=1e-12):
        words = f"samples must be times from 0 to the horizon {horizon:g} s"
        raise ProblemError(words, name="samples", value=times, limit=(0.0, horizon))
    if not (np.diff(times) > 0).all():
        raise ProblemError("samples must be increasing times", name="samples", value=times)
    return times


class _Model:
    """Differential equations of the base and the joints in resolved-rate control, with outputs, as CasADi functions."""

    def __init__(self, equations: TaskEquations, weights: Array, damping: float, symbols: Any) -> None:
        machine = equations.machine
        self.time = symbols.sym("time")
        self.state = symbols.sym("state", machine.base_size + machine.joint_size)
        base, joints = self.state[: machine.base_size], self.state[machine.base_size :]
        targets = equations.targets(self.time)
        jacobian, right = equations.jacobian(base, joints), equations.right(base, joints, targets)
        rates = least_rates(jacobian, right, damping, None if (weights == 1).all() else weights)
        self.ode = ca.vertcat(machine.base_rate(base, joints, rates), rates)
        self.running = ca.dot(rates, ca.DM(weights) * rates) / 2
        if symbols is ca.SX:
            self.ode, self.running = ca.cse([self.ode, self.running])  # both contain the kinematics
        self.rate = ca.Function("rate", [self.time, self.state], [self.ode])
        outputs = [machine.tip_pose(base, joints).position, jacobian, equations.error(base, joints, targets)]
        self.outputs = ca.Function("outputs", [self.time, self.state], outputs)


def _integrate(model: _Model, first: Array, times: Array, tolerance: float) -> tuple[Array, Array, str | None]:
    """Return states and costs at the sample times that an integration reaches, and the reason if it ends early."""
    problem = {"t": model.time, "x": model.state, "ode": model.ode, "quad": model.running}
    options: dict[str, Any] = {"tolerance": tolerance, "max_steps": MAX_INTEGRATOR_STEPS, "start": times[0]}
    run = integrator("motion", problem, times[1:].tolist(), **options)
    states, costs = np.full((len(times), first.size), np.nan), np.full(len(times), np.nan)
    states[0], costs[0] = first, 0.0
    memory, evaluate = run.buffer()  # if the integration fails, the samples before the failure remain
    memory.set_arg(run.index_in("x0"), first.data)
    for name, values in (("xf", states), ("qf", costs)):
        memory.set_res(run.index_out(name), values[1:].data)
    with contextlib.suppress(RuntimeError):
        evaluate()
    rates = np.array(model.rate.map(len(times))(times[None, :], states.T)).T
    usable = np.isfinite(np.column_stack([states, costs, rates])).all(axis=1)
    if usable.all():
        return states, costs, None
    count = max(int(usable.argmin()), 1)
    begin, end = times[count - 1 : count + 1]
    manipulability = float(_manipulabilities(np.array(model.outputs(begin, states[count - 1])[1])[None])[0])
    reason = f"the integration fails between {begin:g} and {end:g} s, where the manipulability falls to "
    reason += f"{manipulability:.3g}: the task becomes singular; give RateOptions(damping=...) or another start"
    return states[:count], costs[:count], reason


def _report(
    machine: Machine, model: _Model, times: Array, states: Array, costs: Array, tolerance: float, stopped: str | None
) -> LocalSolution:
    """Return integrated states and costs as a `LocalSolution` with all quantities along the motion."""
    rates = np.array(model.rate.map(len(times))(times[None, :], states.T)).T
    tip, jacobians, error = (np.array(value) for value in model.outputs.map(len(times))(times[None, :], states.T))
    base_size, size = machine.base_size, error.size // len(times)
    return LocalSolution(
        t=times,
        base=states[:, :base_size],
        joints=states[:, base_size:],
        joint_rates=rates[:, base_size:],
        base_rates=rates[:, :base_size],
        tip_in_world=tip.T,
        manipulability=_manipulabilities(jacobians.reshape(size, len(times), machine.joint_size).transpose(1, 0, 2)),
        cost=costs,
        tolerance=tolerance,
        stopped=stopped,
        task_error=error.reshape(size, len(times)).T,
    )


def _manipulabilities(jacobians: Array) -> Array:
    """Return the manipulabilities of Jacobians, the products of their singular values. Shapes (M, m, n) to (M,)."""
    return np.asarray(np.linalg.svd(jacobians, compute_uv=False).prod(axis=-1))


CORRECTIONS = 2  # number of Newton corrections of the pose after each step, each of which squares the error


@dataclass(frozen=True, eq=False)
class LocalMotion:
    """K motions at M times from local redundancy resolution (resolved-rate control)."""

    t: Array  # (M,), s
    base: Array  # (K, M, base_size)
    joints: Array  # within the limits, (K, M, joint_size)
    rates: Array  # mean joint rates from each time to the next; the last ones are repeated, (K, M, joint_size)
    cost: Array  # integral of half the weighted squared joint rates, (K,)
    pose_error: Array  # largest one, m and rad; infinite if a motion diverges, (K,)
    worst_time: Array  # time of the largest pose error, s, (K,)

    @classmethod
    def stationary(cls, times: Array, base: Array, joints: Array) -> LocalMotion:
        """Return motions that stay at given configurations (K, base_size) and (K, joint_size)."""
        count, samples = len(joints), len(times)
        rates, zeros = np.zeros((count, samples, joints.shape[1])), np.zeros(count)
        bases, positions = (np.repeat(each[:, None], samples, axis=1) for each in (base, joints))
        return cls(times, bases, positions, rates, zeros, zeros, zeros)

    @classmethod
    def through(cls, times: Array, base: Array, joints: Array, weights: Array) -> LocalMotion:
        """Return motions through configurations (K, M, n) at times (M,); their rates are forward differences."""
        rates = np.diff(joints, axis=1) / np.diff(times)[:, None]
        rates, zeros = np.concatenate([rates, rates[:, -1:]], axis=1), np.zeros(len(joints))
        return cls(times, base, joints, rates, zeros, zeros, zeros).with_cost(weights)

    def with_cost(self, weights: Array) -> LocalMotion:
        """Return these motions with the costs that follow from weights (n,) of the squared joint rates."""
        cost = np.einsum("kmn,n,m->k", self.rates[:, :-1] ** 2, weights, np.diff(self.t)) / 2
        return replace(self, cost=np.asarray(cost))

    @classmethod
    def joined(cls, motions: Sequence[LocalMotion]) -> LocalMotion:
        """Join several sets of motions over the same times into one."""
        names = ("base", "joints", "rates", "cost", "pose_error", "worst_time")
        return cls(motions[0].t, *(np.concatenate([getattr(motion, name) for motion in motions]) for name in names))

    def straight_to(self, joints: Array) -> LocalMotion:
        """Return straight motions in joint space from the starts of these motions to configurations (K, joint_size)."""
        share = ((self.t - self.t[0]) / (self.t[-1] - self.t[0]))[:, None]
        displacement = (joints - self.joints[:, 0])[:, None]
        rates = np.repeat(displacement / (self.t[-1] - self.t[0]), len(self.t), axis=1)
        return replace(self, joints=self.joints[:, :1] + share * displacement, rates=rates)

    def take(self, rows: Any) -> LocalMotion:
        """Return the motions with the given indices."""
        fields = (self.base, self.joints, self.rates, self.cost, self.pose_error, self.worst_time)
        return LocalMotion(self.t, *(value[rows] for value in fields))


def tracking_weights(machine: Machine, base: Array, joints: Array, weights: Array) -> list[Array]:
    """Return the weights of joint rates, one or two vectors of shape (n,), that a local motion tries in turn.

    They are the given weights and, if these make reaction wheels costly, smaller weights of the wheels. With costly
    wheels a local motion lets the arm hold the attitude of its base, which often ends at a singularity. With the
    smaller weights, wheels that stop a rotation of the base cost no more than an arm joint of the same rate.
    """
    if not isinstance(machine, FreeFloating):
        return [weights]
    light, columns = weights.copy(), [machine.robot.joint_names.index(name) for name in find_wheels(machine.robot)]
    others = np.delete(weights, columns)
    for column, rates in zip(columns, np.eye(len(weights))[columns], strict=True):
        twist = machine.base_twist(base, joints, rates) - machine.base_twist(base, joints, 0 * rates)
        turning = np.linalg.norm(np.array(ca.DM(twist))[: twist.numel() // 2])  # of the base, per rate of the wheel
        light[column] = min(weights[column], turning**2 * others[others > 0].min(initial=np.inf))
    return [weights] if np.array_equal(light, weights) else [weights, light]


def track_tasks(
    equations: TaskEquations,
    joints: Array,
    base: Array,
    times: Array,
    *,
    weights: Array,
    damping: float,
    lower: Array,
    upper: Array,
) -> LocalMotion:
    """Track tasks from several start configurations (K, joint_size) and (K, base_size) by resolved-rate control.

    The `damping` is relative to the root mean square of the singular values of the Jacobian of the tasks; `weights`
    (joint_size,) are those of the squared joint rates.
    """
    machine, count, steps = equations.machine, len(joints), np.diff(times)
    targets = np.array(equations.target_function().map(len(times))(times[None, :]))
    b, q, u = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("u", machine.joint_size)
    motion = ca.Function("moves", [b, q, u], [machine.base_rate(b, q, u)]).map(count) if machine.base_size else None
    pose_rows, min_cosines = equations.pose_rows, np.cos(equations.cone_angles)
    functions = [equations.function, *([equations.cone_function] if min_cosines.size else [])]
    sizes = machine.base_size, machine.joint_size, len(targets)
    symbols = [symbols_of(*functions).sym("input", size) for size in sizes]
    task = Sampler(symbols, [output for function in functions for output in function.call(symbols)])
    base_now, joints_now = np.array(base, dtype=float), np.clip(joints, lower, upper)
    bases, configurations, errors = [base_now], [joints_now], list[Array]()

    def linearise(k: int) -> tuple[Array, Array, Array, Array]:
        """Return Jacobians (K, m, n), task velocities, pose errors (K, m), and the largest errors (K,) at sample k."""
        jacobian, right, error, residual, *leaning = task(base_now, joints_now, targets[:, k])
        matrix = jacobian.reshape(count, machine.joint_size, equations.size).transpose(0, 2, 1)
        errors_along = np.abs(residual).max(axis=1, initial=0.0)
        error = np.where(pose_rows, error, 0.0)
        if leaning:  # axes outside their cones are turned back, others are free
            cosines, columns = leaning
            violation = np.maximum(min_cosines - cosines, 0.0)
            gradients = columns.reshape(count, machine.joint_size, min_cosines.size).transpose(0, 2, 1)
            matrix = np.concatenate([matrix, np.where((violation > 0)[:, :, None], gradients, 0.0)], axis=1)
            right, error = np.hstack([right, np.zeros_like(violation)]), np.hstack([error, violation])
        return matrix, right, error, np.where(np.isfinite(errors_along), errors_along, np.inf)

    def move_base(step: Array, duration: float) -> Array:
        """Return the base configurations (K, base_size) after the joints make a step and the base drifts for a time."""
        if motion is None:
            return base_now
        drift = np.array(motion(base_now.T, joints_now.T, np.zeros_like(joints_now).T)).T
        return np.asarray(base_now + np.array(motion(base_now.T, joints_now.T, step.T)).T - drift + duration * drift)

    for k, h in enumerate([*steps, 0.0]):
        matrix, right, error, residual = linearise(k)
        for _ in range(CORRECTIONS if k else 0):
            correction = _damped_rates(matrix, error, weights, damping, joints_now, lower, upper)
            base_now, joints_now = move_base(correction, 0.0), np.clip(joints_now + correction, lower, upper)
            matrix, right, error, residual = linearise(k)
        bases[k], configurations[k] = base_now, joints_now
        errors.append(residual)
        if h:
            first = h * _damped_rates(matrix, right, weights, damping, joints_now, lower, upper)
            before = base_now, joints_now
            base_now, joints_now = move_base(first, h), np.clip(joints_now + first, lower, upper)
            matrix, right, _, _ = linearise(k + 1)
            second = h * _damped_rates(matrix, right, weights, damping, joints_now, lower, upper)
            base_now, joints_now = before
            mean = (first + second) / 2
            base_now, joints_now = move_base(mean, h), np.clip(joints_now + mean, lower, upper)
            bases.append(base_now)
            configurations.append(joints_now)
    motions = LocalMotion.through(times, np.stack(bases, axis=1), np.stack(configurations, axis=1), weights)
    errors_along = np.stack(errors, axis=1)
    return replace(motions, pose_error=errors_along.max(axis=1), worst_time=times[errors_along.argmax(axis=1)])


def _damped_rates(
    matrix: Array, velocities: Array, weights: Array, damping: float, joints: Array, lower: Array, upper: Array
) -> Array:
    """Return damped least joint rates (K, n) for task velocities (K, m), without motion beyond joint limits."""
    finite: Any = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(velocities).all(axis=1)
    matrix, velocities = np.where(finite[:, None, None], matrix, 0.0), np.where(finite[:, None], velocities, 0.0)
    size = np.sqrt((matrix**2).sum(axis=(1, 2)) / max(matrix.shape[1], 1))
    regularisation = ((damping * size) ** 2 + np.finfo(float).tiny)[:, None, None] * np.eye(matrix.shape[1])
    free: Any = np.ones(joints.shape, dtype=bool)
    rates = np.zeros_like(joints)
    for _ in range(joints.shape[1] + 1):
        weighted = np.where(free[:, None, :], matrix, 0.0) / weights
        square = weighted @ matrix.transpose(0, 2, 1) + regularisation
        rates = np.einsum("kmn,km->kn", weighted, np.linalg.solve(square, velocities[:, :, None])[:, :, 0])
        violates: Any = free & (((joints <= lower) & (rates < 0)) | ((joints >= upper) & (rates > 0)))
        if not violates.any():
            break
        free = np.logical_and(free, np.logical_not(violates))
    return np.asarray(np.where(free, rates, 0.0))
