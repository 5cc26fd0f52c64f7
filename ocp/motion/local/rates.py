"""Instantaneous redundancy resolution: at each instant the least joint rates that do the task, blind to the future.

The classical method that optimal plans are compared with, and the source of their first guesses.

Many local motions at once: each keeps its tips on their tasks with the least joint rates, inside the joints' limits.

What posture the motion starts from decides where it leads. Followed on one grid of times from all of them together, a
prediction with the least rates and a correction of the poses that are left, they are found at the cost of a few: where
each one leads, what it costs, and where it cannot follow. They are the guesses of plans, and no plans themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models import CollisionScene, Machine
from models.arrays import Array
from models.spatial import solve_spd
from ocp.console import interruptible
from ocp.curves import integrator
from ocp.errors import MAX_COUNT, NOT_NUMBERS, ProblemError, checked_nonnegative, checked_positive, floats, real
from ocp.motion.local.collisions import checked_collision_scene, distances_along
from ocp.motion.tasks.checks import checked_configuration, checked_tasks, checked_weights, dependent_rows, horizon_of
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["LocalMotion", "LocalSolution", "follow", "least_rates", "resolve"]

INTEGRATOR_STEPS = 20000
"""Between two samples, at most; a smooth motion takes some tens."""


@dataclass(frozen=True)
class LocalSolution:
    """Motion by instantaneous resolution, at M sampled times.

    Attributes:
        t: Times, the first 0. Shape (M,), s.
        base: Base configuration, as the machine defines it. Shape (M, base_size).
        joints: Joint positions. Shape (M, joint_size), rad or m.
        joint_rates: Shape (M, joint_size).
        base_rates: Time derivative of `base`. Shape (M, base_size).
        tip_in_world: Position of the tip. Shape (M, 3), m.
        manipulability: Of the task's rows, undamped. Shape (M,).
        cost: Integral of half the (weighted) squared joint rates, up to each time. Shape (M,).
        tolerance: Absolute and relative tolerance of the integration.
        stopped: Why the motion ends before the horizon; None when it does not.
        clearance: Least distance of two bodies, m, nan where no surroundings were given. Shape (M,).
        nearest: The names of these two at each time, or nothing.
        task_error: Pose wanted less pose found in the rows of the tasks, m and rad; zero for velocities.
            Shape (M, rows of all tasks).
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
    clearance: Array = field(default_factory=lambda: np.zeros(0))
    nearest: tuple[tuple[str, str], ...] = ()

    def __repr__(self) -> str:
        end = f", stopped: {self.stopped}" if self.stopped else ""
        return f"<LocalSolution of {self.t[-1]:.6g} s, {self.joints.shape[1]} joints: cost {self.cost[-1]:.6g}{end}>"

    def at(self, time: float) -> dict[str, Array]:
        """Cubic interpolation of "base" and "joints", linear of "joint_rates"; beyond the ends the end values."""
        time = float(np.clip(time, self.t[0], self.t[-1]))
        rates = np.array([np.interp(time, self.t, column) for column in self.joint_rates.T])
        if len(self.t) == 1:
            return {"base": self.base[0], "joints": self.joints[0], "joint_rates": rates}
        k = int(np.clip(np.searchsorted(self.t, time) - 1, 0, len(self.t) - 2))
        step = self.t[k + 1] - self.t[k]
        s = (time - self.t[k]) / step

        def hermite(value: Array, rate: Array) -> Array:
            mean = (value[k + 1] - value[k]) / step
            bend = (1 - s) * (rate[k] - mean) + s * (mean - rate[k + 1])
            return np.asarray(value[k] + step * s * (mean + (1 - s) * bend))

        base, joints = hermite(self.base, self.base_rates), hermite(self.joints, self.joint_rates)
        return {"base": base, "joints": joints, "joint_rates": rates}


@interruptible
def resolve(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    start_joints: Any,
    horizon: float | None = None,
    *,
    start_base: Any = None,
    weights: Any = None,
    damping: float = 0.0,
    tolerance: float = 1e-10,
    samples: Any = 501,
    scene: CollisionScene | None = None,
) -> LocalSolution:
    """Simulate x2' = G# v, equation (26) of the free-floating paper with u = 0, and the base that follows.

    What the machine does at rest (its drift) and what a pose task feeds back are part of v.

    Args:
        machine: Any machine of `models`, on a fixed or a floating base.
        tasks: What its tips do; several are done at once.
        start_joints: Shape (joint_size,).
        horizon: Final time, s; that of the tasks if None.
        start_base: Base configuration at the start, shape (base_size,); the machine's base_home() if None.
        weights: Of the squared joint rates that are least, positive. Shape (joint_size,); all 1 if None.
        damping: 0 for the pseudo-inverse G# = G' (G G')^-1; otherwise G' (G G' + damping^2 1)^-1, which stays
            bounded where the Jacobian loses rank, at the price of a task error.
        tolerance: Absolute and relative tolerance of the integrator (cvodes, Adams).
        samples: How many equally spaced times to report, or the increasing times themselves from 0 to the
            horizon.
        scene: Of the machine; how near its bodies come to each other and to obstacles is reported, at the
            samples, and changes nothing.

    Returns:
        The motion up to the horizon, or up to the last sample before it breaks down, with the reason in
        `stopped`.

    Raises:
        ProblemError: Something does not fit the machine, or the task is singular already at the start.
    """
    equations = bind(machine, tasks)
    joints, base = checked_configuration(machine, start_joints, start_base)
    duration = horizon_of([part.task for part in equations.bound], horizon)
    heavy = checked_weights(weights, machine.joint_size)
    checked_tasks(equations, base, joints, duration)
    checked_nonnegative("damping", damping)
    checked_positive("tolerance", tolerance)
    times = _times(samples, duration)
    if damping == 0 and (rows_dependent := dependent_rows(equations, base, joints)):
        words = (
            f"{rows_dependent} is singular at the start joints {joints.tolist()}; "
            "start elsewhere, fix fewer rows, or give a damping"
        )
        raise ProblemError(words, name=rows_dependent, value=joints, time=0.0)
    try:
        model = _Model(equations, heavy, damping, ca.SX)
    except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
        model = _Model(equations, heavy, damping, ca.MX)
    states, costs, stopped = _integrate(model, np.concatenate([base, joints]), times, tolerance)
    report = _report(machine, model, times[: len(states)], states, costs, tolerance, stopped)
    if scene is None:
        return replace(report, clearance=np.full(len(report.t), np.nan))
    apart = distances_along(checked_collision_scene(scene, machine), report.base, report.joints, report.t)
    if not apart.shape[1]:
        return replace(report, clearance=np.full(len(report.t), np.inf))
    labels = scene.labels
    near = tuple(labels[k] for k in apart.argmin(axis=1).tolist())
    return replace(report, clearance=apart.min(axis=1), nearest=near)


def least_rates(jacobian: Any, velocity: Any, damping: float = 0.0, weights: Any = None) -> Any:
    """G' (G G' + damping^2 1)^-1 v: the least joint rates that give the velocity, G# v when undamped.

    With weights W^-1 G' (G W^-1 G' + damping^2 1)^-1 v, W their diagonal matrix. Shape (n, k).

    Args:
        jacobian: Rows of the task, G. Shape (m, n), m <= n.
        velocity: v, or several as columns. Shape (m, k).
        damping: In units of the Jacobian.
        weights: Of the squared joint rates, positive numbers. Shape (n,).
    """
    light = jacobian.T if weights is None else ca.mtimes(ca.diag(1 / ca.DM(weights)), jacobian.T)
    square = ca.mtimes(jacobian, light) + damping**2 * ca.DM.eye(jacobian.shape[0])
    return ca.mtimes(light, solve_spd(square, velocity))


def _times(samples: Any, horizon: float) -> Array:
    if not isinstance(samples, list | tuple | np.ndarray):
        count = real(samples)
        if not (2 <= count <= MAX_COUNT and count == int(count)):
            words = f"samples must be at least 2 points or an array of times, not {samples!r}"
            raise ProblemError(words, name="samples", value=samples, limit=2)
        return np.linspace(0.0, horizon, int(count))
    try:
        times = floats(samples)
    except NOT_NUMBERS as error:
        raise ProblemError(f"samples {samples!r} are no times", name="samples", value=samples) from error
    if times.ndim != 1 or len(times) < 2 or times[0] != 0 or not np.isclose(times[-1], horizon, rtol=1e-12):
        words = f"samples must be times from 0 to the horizon {horizon:g} s"
        raise ProblemError(words, name="samples", value=times, limit=(0.0, horizon))
    if not (np.diff(times) > 0).all():
        raise ProblemError("samples must be increasing times", name="samples", value=times)
    return times


class _Model:
    """Rates of the state (base, joints) and what is reported of it, as casadi functions of (time, state)."""

    def __init__(self, equations: TaskEquations, weights: Array, damping: float, symbols: Any) -> None:
        machine = equations.machine
        self.time = symbols.sym("time")
        self.state = symbols.sym("state", machine.base_size + machine.joint_size)
        base, joints = self.state[: machine.base_size], self.state[machine.base_size :]
        targets = equations.targets(self.time)
        jacobian, right = equations.jacobian(base, joints), equations.right(base, joints, targets)
        rates = least_rates(jacobian, right, damping, None if (weights == 1).all() else weights)
        base_rate = machine.base_rate(base, joints, rates)
        self.ode = ca.vertcat(base_rate, rates)
        self.running = ca.dot(rates, ca.DM(weights) * rates) / 2
        if symbols is ca.SX:
            self.ode, self.running = ca.cse([self.ode, self.running])  # both contain the kinematics
        self.rate = ca.Function("rate", [self.time, self.state], [self.ode])
        outputs = [machine.tip_pose(base, joints).position, jacobian, equations.error(base, joints, targets)]
        self.outputs = ca.Function("outputs", [self.time, self.state], outputs)

    def integrator(self, start: float, times: Array, tolerance: float) -> Callable[..., Any]:
        problem = {"t": self.time, "x": self.state, "ode": self.ode, "quad": self.running}
        return self._cvodes(problem, start, times, tolerance)

    def one_interval(self, tolerance: float) -> Callable[..., Any]:
        """From p[0] over p[1] seconds: the same integrator for every interval between samples."""
        span, fraction = type(self.time).sym("span", 2), type(self.time).sym("fraction")
        at = ca.Function("at", [self.time, self.state], [self.ode, self.running])
        ode, running = at(span[0] + fraction * span[1], self.state)
        problem = {"t": fraction, "x": self.state, "p": span, "ode": span[1] * ode, "quad": span[1] * running}
        return self._cvodes(problem, 0.0, np.array([1.0]), tolerance)

    @staticmethod
    def _cvodes(problem: dict[str, Any], start: float, times: Array, tolerance: float) -> Callable[..., Any]:
        built: Callable[..., Any] = integrator(
            "motion", problem, times.tolist(), tolerance=tolerance, max_steps=INTEGRATOR_STEPS, start=start
        )
        return built


def _integrate(model: _Model, first: Array, times: Array, tolerance: float) -> tuple[Array, Array, str | None]:
    """States and costs at as many of the times as can be reached, and why not at all."""
    try:
        found = model.integrator(times[0], times[1:], tolerance)(x0=first)
        states = np.vstack([first, np.array(found["xf"]).T])
        costs = np.concatenate([[0.0], np.array(found["qf"]).ravel()])
        if np.isfinite(states).all() and np.isfinite(costs).all():
            return states, costs, None
    except RuntimeError:
        pass  # go again from sample to sample, to learn how far it goes
    step = model.one_interval(tolerance)
    reached, spent = [first], [0.0]
    for begin, end in pairwise(times):
        try:
            found = step(x0=reached[-1], p=[begin, end - begin])
            state, cost = np.array(found["xf"]).ravel(), float(found["qf"])
            usable = np.isfinite([*state, cost]).all() and np.isfinite(np.array(model.rate(end, state))).all()
        except RuntimeError:
            usable = False
        if not usable:
            manipulability = float(_manipulabilities(np.array(model.outputs(begin, reached[-1])[1])[None])[0])
            reason = (
                f"the integration fails between {begin:g} and {end:g} s, where the manipulability "
                f"falls to {manipulability:.3g}: the task becomes singular; give a damping or another start"
            )
            return np.array(reached), np.array(spent), reason
        reached.append(state)
        spent.append(spent[-1] + cost)
    return np.array(reached), np.array(spent), None


def _report(
    machine: Machine, model: _Model, times: Array, states: Array, costs: Array, tolerance: float, stopped: str | None
) -> LocalSolution:
    rates = np.array(model.rate.map(len(times))(times[None, :], states.T)).T
    tip, jacobians, error = (np.array(part) for part in model.outputs.map(len(times))(times[None, :], states.T))
    cut, size = machine.base_size, error.size // len(times)
    return LocalSolution(
        t=times,
        base=states[:, :cut],
        joints=states[:, cut:],
        joint_rates=rates[:, cut:],
        base_rates=rates[:, :cut],
        tip_in_world=tip.T,
        manipulability=_manipulabilities(jacobians.reshape(size, len(times), machine.joint_size).transpose(1, 0, 2)),
        cost=costs,
        tolerance=tolerance,
        stopped=stopped,
        task_error=error.reshape(size, len(times)).T,
    )


def _manipulabilities(jacobians: Array) -> Array:
    """sqrt(det(G G')), as the product of the singular values. Shapes (M, m, n) to (M,)."""
    return np.asarray(np.linalg.svd(jacobians, compute_uv=False).prod(axis=-1))


CORRECTIONS = 2
"""Of the poses after each step; the second one leaves about the fourth power of what the step missed."""


@dataclass(frozen=True, eq=False)
class LocalMotion:
    """K local motions at M times.

    Attributes:
        t: Shape (M,), s.
        base: Shape (K, M, base_size).
        joints: Shape (K, M, joint_size), within the limits.
        rates: Mean joint rates from each time to the next, and the last ones again. Shape (K, M, joint_size).
        cost: Integral of half the weighted squared joint rates. Shape (K,).
        misfit: Largest pose error anywhere, m and rad; infinite where a motion ran away. Shape (K,).
        lost_at: When the pose error is largest, s. Shape (K,).
    """

    t: Array
    base: Array
    joints: Array
    rates: Array
    cost: Array
    misfit: Array
    lost_at: Array

    @classmethod
    def resting(cls, times: Array, base: Array, joints: Array) -> LocalMotion:
        """Motions in which nothing moves.

        Args:
            times: Shape (M,), s. base, joints: Shape (K, base_size) and (K, joint_size).
        """
        count, many = len(joints), len(times)
        still, none = np.zeros((count, many, joints.shape[1])), np.zeros(count)
        places, angles = (np.repeat(each[:, None], many, axis=1) for each in (base, joints))
        return cls(times, places, angles, still, none, none, none)

    def of(self, rows: Any) -> LocalMotion:
        """Some of the motions."""
        kept = (self.base, self.joints, self.rates, self.cost, self.misfit, self.lost_at)
        return LocalMotion(self.t, *(part[rows] for part in kept))


def follow(
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
    """Follow tasks from several postures.

    Args:
        equations: Of the tasks, at times of their own.
        joints: At the first time. Shape (K, joint_size).
        base: At the first time. Shape (K, base_size).
        times: Increasing. Shape (M,), s.
        weights: Of the squared joint rates. Shape (joint_size,).
        damping: Relative to the root mean square of the singular values of the tasks' Jacobian.
        lower, upper: Limits of the joints. Shape (joint_size,).
    """
    machine, count, steps = equations.machine, len(joints), np.diff(times)
    targets = np.array(equations.target_function().map(len(times))(times[None, :]))
    task = equations.function().map(count)
    b, q, u = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("u", machine.joint_size)
    moves = ca.Function("moves", [b, q, u], [machine.base_rate(b, q, u)]).map(count) if machine.base_size else None
    posed, most = equations.posed, np.cos(equations.most_lean)
    leaning = _leaning(equations).map(count) if most.size else None
    place, at = np.array(base, dtype=float), np.clip(joints, lower, upper)
    bases, postures, misfits = [place], [at], list[Array]()

    def asked(k: int) -> tuple[Array, Array, Array, Array]:
        """Jacobians (K, m, n), what they are to give (K, m), pose errors (K, m), and misfits (K,)."""
        jacobian, right, error, misfit = (
            np.array(part) for part in task(place.T, at.T, np.repeat(targets[:, k : k + 1], count, axis=1))
        )
        matrix = jacobian.reshape(equations.size, count, machine.joint_size).transpose(1, 0, 2)
        off = np.abs(misfit).max(axis=0, initial=0.0)
        right, error = right.T, np.where(posed, error.T, 0.0)
        if leaning is not None:  # axes that lean too far are turned back, others may turn as they like
            cosines, slopes = (
                np.array(part) for part in leaning(place.T, at.T, np.repeat(targets[:, k : k + 1], count, 1))
            )
            missing = np.maximum(most - cosines.T, 0.0)
            turning = slopes.reshape(most.size, count, machine.joint_size).transpose(1, 0, 2)
            matrix = np.concatenate([matrix, np.where((missing > 0)[:, :, None], turning, 0.0)], axis=1)
            right, error = np.hstack([right, np.zeros_like(missing)]), np.hstack([error, missing])
        return matrix, right, error, np.where(np.isfinite(off), off, np.inf)

    def moved(step: Array, drifting: float) -> Array:
        """The base (K, base_size) after joints moved by `step`, in a time in which it drifts too."""
        if moves is None:
            return place
        still = np.array(moves(place.T, at.T, np.zeros_like(at).T)).T
        return np.asarray(place + np.array(moves(place.T, at.T, step.T)).T - still + drifting * still)

    for k, h in enumerate([*steps, 0.0]):
        matrix, right, error, misfit = asked(k)
        for _ in range(CORRECTIONS if k else 0):
            correction = _least(matrix, error, weights, damping, at, lower, upper)
            place, at = moved(correction, 0.0), np.clip(at + correction, lower, upper)
            matrix, right, error, misfit = asked(k)
        bases[k], postures[k] = place, at
        misfits.append(misfit)
        if h:
            first = h * _least(matrix, right, weights, damping, at, lower, upper)
            start = place, at
            place, at = moved(first, h), np.clip(at + first, lower, upper)
            matrix, right, _, _ = asked(k + 1)
            second = h * _least(matrix, right, weights, damping, at, lower, upper)
            place, at = start
            mean = (first + second) / 2
            place, at = moved(mean, h), np.clip(at + mean, lower, upper)
            bases.append(place)
            postures.append(at)
    path = np.stack(postures, axis=1)
    rates = np.diff(path, axis=1) / steps[:, None]
    off = np.stack(misfits, axis=1)
    worst = off.argmax(axis=1)
    return LocalMotion(
        times,
        np.stack(bases, axis=1),
        path,
        np.concatenate([rates, rates[:, -1:]], axis=1),
        np.asarray(np.einsum("kmn,n,m->k", rates**2, weights, steps) / 2),
        off.max(axis=1),
        times[worst],
    )


def _leaning(equations: TaskEquations) -> Any:
    """casadi Function (base, joints, targets) -> cosines of the angles by which axes lean, and their slopes in q."""
    machine = equations.machine
    b, q, u = (ca.SX.sym("v", size) for size in (machine.base_size, machine.joint_size, machine.joint_size))
    targets = ca.SX.sym("targets", equations.target_function().numel_out())
    cosines = equations.leans(b, q, targets)
    slopes = ca.jacobian(cosines, q)
    if machine.base_size:
        slopes = slopes + ca.mtimes(ca.jacobian(cosines, b), ca.jacobian(machine.base_rate(b, q, u), u))
    return ca.Function("leaning", [b, q, targets], [cosines, ca.densify(slopes)], {"cse": True})


def _least(
    matrix: Array, wanted: Array, weights: Array, damping: float, at: Array, lower: Array, upper: Array
) -> Array:
    """Least weighted rates (K, n) that give what is wanted (K, m); joints at a limit that they would leave are held."""
    finite: Any = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1)
    matrix, wanted = np.where(finite[:, None, None], matrix, 0.0), np.where(finite[:, None], wanted, 0.0)
    size = np.sqrt((matrix**2).sum(axis=(1, 2)) / max(matrix.shape[1], 1))
    soft = ((damping * size) ** 2 + np.finfo(float).tiny)[:, None, None] * np.eye(matrix.shape[1])
    free: Any = np.ones(at.shape, dtype=bool)
    rates = np.zeros_like(at)
    for _ in range(at.shape[1] + 1):
        light = np.where(free[:, None, :], matrix, 0.0) / weights
        square = light @ matrix.transpose(0, 2, 1) + soft
        rates = np.einsum("kmn,km->kn", light, np.linalg.solve(square, wanted[:, :, None])[:, :, 0])
        leaves: Any = free & (((at <= lower) & (rates < 0)) | ((at >= upper) & (rates > 0)))
        if not leaves.any():
            break
        free = np.logical_and(free, np.logical_not(leaves))
    return np.asarray(np.where(free, rates, 0.0))
