"""Instantaneous redundancy resolution: at each instant the least joint rates that do the task, blind to the future.

The classical method that optimal plans are compared with, and the source of their first guesses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models import Machine
from models.linear import solve_spd
from models.machine import jacobian_manipulability
from ocp.builders.task import Array, Start, Velocity, checked_start, is_singular, velocity_expression
from ocp.errors import ProblemError

__all__ = ["LocalSolution", "least_rates", "resolve"]

MAX_STEPS = 20000  # of the integrator between two samples; a smooth motion takes some tens


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
        cost: Integral of half the squared joint rates, up to each time. Shape (M,).
        tolerance: Absolute and relative tolerance of the integration.
        stopped: Why the motion ends before the horizon; None when it does not.
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


def resolve(
    machine: Machine,
    tip_velocity: Velocity,
    rows: Sequence[int],
    start_joints: Any,
    horizon: float,
    *,
    start_base: Any = None,
    damping: float = 0.0,
    tolerance: float = 1e-10,
    samples: Any = 501,
) -> LocalSolution:
    """Simulate x2' = G# v, equation (26) of the free-floating paper with u = 0, and the base that follows.

    Args:
        machine: Any machine of `models`, on a fixed or a floating base.
        tip_velocity: Velocity v of the tip in the task's rows: a constant of shape (len(rows),), or a
            function that takes a casadi time (s) and returns a casadi vector or a list of expressions.
        rows: Which rows of the tip's twist v prescribes: angular 0..2, linear 3..5, world axes.
        start_joints: Shape (joint_size,).
        horizon: Final time, s.
        start_base: Base configuration at the start, shape (base_size,); the machine's base_home() if None.
        damping: 0 for the pseudo-inverse G# = G' (G G')^-1; otherwise G' (G G' + damping^2 1)^-1, which stays
            bounded where the Jacobian loses rank, at the price of a task error.
        tolerance: Absolute and relative tolerance of the integrator (cvodes, Adams).
        samples: How many equally spaced times to report, or the increasing times themselves from 0 to the
            horizon.

    Returns:
        The motion up to the horizon, or up to the last sample before it breaks down, with the reason in
        `stopped`.

    Raises:
        ProblemError: Something does not fit the machine, or the task is singular already at the start.
    """
    start = checked_start(machine, rows, start_joints, horizon, start_base)
    for what, number in (("damping", damping), ("tolerance", tolerance)):
        if not (np.isfinite(number) and number >= 0):
            raise ProblemError(f"{what} must be a finite number, zero or above, not {number!r}")
    if tolerance == 0:
        raise ProblemError("tolerance must be positive, not 0")
    times = _times(samples, start.horizon)
    try:
        model = _Model(machine, tip_velocity, start, damping, ca.SX)
    except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
        model = _Model(machine, tip_velocity, start, damping, ca.MX)
    first = np.concatenate([start.base, start.joints])
    if damping == 0 and is_singular(machine, start):
        raise ProblemError(
            f"the task of rows {start.rows} is singular at the start joints {start.joints.tolist()}; "
            "start elsewhere, fix fewer rows, or give a damping"
        )
    states, costs, stopped = _integrate(model, first, times, tolerance)
    return _report(machine, model, times[: len(states)], states, costs, tolerance, stopped)


def least_rates(jacobian: Any, velocity: Any, damping: float = 0.0) -> Any:
    """G' (G G' + damping^2 1)^-1 v: the least joint rates that give the velocity, G# v when undamped.

    Shape (n, k).

    Args:
        jacobian: Rows of the task, G. Shape (m, n), m <= n.
        velocity: v, or several as columns. Shape (m, k).
        damping: In units of the Jacobian.
    """
    square = ca.mtimes(jacobian, jacobian.T) + damping**2 * ca.DM.eye(jacobian.shape[0])
    return ca.mtimes(jacobian.T, solve_spd(square, velocity))


def _times(samples: Any, horizon: float) -> Array:
    if np.ndim(samples) == 0:
        count = int(samples)
        if count != samples or count < 2:
            raise ProblemError(f"samples must be at least 2 points or an array of times, not {samples!r}")
        return np.linspace(0.0, horizon, count)
    times = np.asarray(samples, dtype=float)
    if times.ndim != 1 or len(times) < 2 or times[0] != 0 or not np.isclose(times[-1], horizon, rtol=1e-12):
        raise ProblemError(f"samples must be times from 0 to the horizon {horizon:g} s")
    if not (np.diff(times) > 0).all():
        raise ProblemError("samples must be increasing times")
    return times


class _Model:
    """Rates of the state (base, joints) and what is reported of it, as casadi functions of (time, state)."""

    def __init__(self, machine: Machine, tip_velocity: Velocity, start: Start, damping: float, symbols: Any) -> None:
        self.time = symbols.sym("time")
        self.state = symbols.sym("state", machine.base_size + machine.joint_size)
        base, joints = self.state[: machine.base_size], self.state[machine.base_size :]
        velocity = velocity_expression(tip_velocity, self.time, len(start.rows))
        jacobian = machine.tip_jacobian(base, joints)
        rates = least_rates(jacobian[start.rows, :], velocity, damping)
        base_rate = machine.base_rate(base, joints, rates)
        self.ode = ca.vertcat(base_rate, rates)
        self.running = ca.dot(rates, rates) / 2
        self.rate = ca.Function("rate", [self.time, self.state], [self.ode])
        outputs = [machine.tip_pose(base, joints).position, jacobian_manipulability(jacobian, start.rows)]
        self.outputs = ca.Function("outputs", [self.time, self.state], outputs)

    def integrator(self, start: float, times: Array, tolerance: float) -> Callable[..., Any]:
        problem = {"t": self.time, "x": self.state, "ode": self.ode, "quad": self.running}
        return self._cvodes(problem, start, times, tolerance)

    def one_interval(self, tolerance: float) -> Callable[..., Any]:
        """From p[0] over p[1] seconds: the same integrator for every interval between samples."""
        span = type(self.time).sym("span", 2)
        fraction = type(self.time).sym("fraction")
        at = ca.Function("at", [self.time, self.state], [self.ode, self.running])
        ode, running = at(span[0] + fraction * span[1], self.state)
        problem = {
            "t": fraction,
            "x": self.state,
            "p": span,
            "ode": span[1] * ode,
            "quad": span[1] * running,
        }
        return self._cvodes(problem, 0.0, np.array([1.0]), tolerance)

    @staticmethod
    def _cvodes(problem: dict[str, Any], start: float, times: Array, tolerance: float) -> Callable[..., Any]:
        options = {
            "abstol": tolerance,
            "reltol": tolerance,
            "linear_multistep_method": "adams",
            "max_num_steps": MAX_STEPS,
            "disable_internal_warnings": True,
            "show_eval_warnings": False,
        }
        built: Callable[..., Any] = ca.integrator("motion", "cvodes", problem, start, times.tolist(), options)
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
            manipulability = float(model.outputs(begin, reached[-1])[1])
            reason = (
                f"the integration fails between {begin:g} and {end:g} s, where the manipulability "
                f"falls to {manipulability:.3g}: the task becomes singular; give a damping or another start"
            )
            return np.array(reached), np.array(spent), reason
        reached.append(state)
        spent.append(spent[-1] + cost)
    return np.array(reached), np.array(spent), None


def _report(
    machine: Machine,
    model: _Model,
    times: Array,
    states: Array,
    costs: Array,
    tolerance: float,
    stopped: str | None,
) -> LocalSolution:
    rates = np.array(model.rate.map(len(times))(times[None, :], states.T)).T
    tip, manipulability = model.outputs.map(len(times))(times[None, :], states.T)
    cut = machine.base_size
    return LocalSolution(
        t=times,
        base=states[:, :cut],
        joints=states[:, cut:],
        joint_rates=rates[:, cut:],
        base_rates=rates[:, :cut],
        tip_in_world=np.array(tip).T,
        manipulability=np.array(manipulability).ravel(),
        cost=costs,
        tolerance=tolerance,
        stopped=stopped,
    )
