"""Families of problems whose optimal cost is known, in closed form or from a solver of another kind.

Each makes of a seed a problem, its optimal cost, and an independent measure of how far a plan is from doing what is
asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import expm

from ocp import Problem, Solution
from tests.ocp.problems import Array, double_integrator

__all__ = ["FAMILIES", "Known", "miss"]

Rate = Callable[[float, Array, Array], Array]  # t, x, u -> dx/dt


@dataclass(frozen=True)
class Known:
    """A problem and what is known of it.

    Attributes:
        problem: What is asked. rate: Its dynamics, written down again.
        start, end: Of the states in the order of ``states``, nan where free. bounds: By name of a state or control.
        cost: The optimal cost; or of a plan, of the extremal beside it (nan where there is none).
    """

    problem: Problem
    rate: Rate
    states: tuple[str, ...]
    start: Array
    end: Array
    cost: Callable[[Solution], float]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)


def miss(known: Known, plan: Solution, places: int = 12) -> float:
    """How far a plan misses what is asked, as a share of the spread of each thing: by Runge-Kutta steps of its own.

    The greatest of the defects within each interval from the plan's own state at its start, at the ends, of bounds.
    """
    curve = plan.control_interpolant
    mesh, n = curve.breaks * plan.horizon, len(curve.breaks) - 1
    order: dict[str, list[int]] = {}  # of the states of the family
    offset = 0
    for name, values in plan.states.items():
        order[name] = list(range(offset, offset + values.shape[1]))
        offset += values.shape[1]
    index = [i for name in known.states for i in order[name]]
    fine = np.linspace(0.0, 1.0, 20 * n + 1)
    x = plan.state_interpolant(fine)[:, index]
    spread = np.maximum(np.ptp(x, axis=0), 1e-9 + 1e-6 * np.abs(x).max())
    worst = 0.0
    for k in range(n):
        state = plan.state_interpolant(curve.breaks[k : k + 1])[0, index]
        step = (mesh[k + 1] - mesh[k]) / places
        for j in range(places):
            u = [curve.within(np.array([k]), np.array([(j + c) / places]))[0] for c in (0.0, 0.5, 1.0)]
            t = mesh[k] + j * step
            k1 = known.rate(t, state, u[0])
            k2 = known.rate(t + step / 2, state + step / 2 * k1, u[1])
            k3 = known.rate(t + step / 2, state + step / 2 * k2, u[1])
            k4 = known.rate(t + step, state + step * k3, u[2])
            state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            here = curve.breaks[k] + (curve.breaks[k + 1] - curve.breaks[k]) * (j + 1) / places - 1e-13
            defect = np.abs(plan.state_interpolant(np.array([here]))[0, index] - state)
            worst = max(worst, float((defect / spread).max()))
    for options, result in ((known.start, x[0]), (known.end, x[-1])):
        held = np.isfinite(options)
        worst = max(worst, float((np.abs(result - options) / spread)[held].max(initial=0.0)))
    segment, place = np.repeat(np.arange(n), 21), np.tile(np.linspace(0, 1, 21), n)
    pushes = curve.within(segment, place)
    for name, (low, high) in known.bounds.items():
        values = x[:, known.states.index(name)] if name in known.states else pushes
        size = max(abs(bound) for bound in (low, high) if np.isfinite(bound))
        worst = max(worst, float(np.maximum(values - high, low - values).max() / size))
    return worst


def regulator(seed: int) -> Known:
    """A random linear-quadratic regulator, stable or not: x0' P(0) x0 / 2 by the Hamiltonian matrix."""
    rng = np.random.default_rng([21, seed])
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    a, b = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    q, f, r = (rng.normal(size=(k, k)) for k in (n, n, m))
    q, f, r = q @ q.T, f @ f.T, r @ r.T + 0.2 * np.eye(m)
    horizon, start = float(rng.uniform(0.5, 3.0)), rng.normal(size=n)
    matrix = np.block([[a, -b @ np.linalg.solve(r, b.T)], [-q, -a.T]])
    frame = np.vstack([np.eye(n), f])
    back = expm(-matrix * horizon / 50)
    for _ in range(50):
        frame = np.linalg.qr(back @ frame)[0]
    cost = float(start @ frame[n:] @ np.linalg.solve(frame[:n], start)) / 2
    problem = Problem("regulator")
    x, u = problem.state("x", n, initial=start), problem.control("u", m)
    problem.dynamics(x, ca.mtimes(a, x) + ca.mtimes(b, u))
    problem.horizon(horizon)
    running = ca.bilin(ca.DM(q), x, x) / 2 + ca.bilin(ca.DM(r), u, u) / 2
    problem.minimize(running, ca.bilin(ca.DM(f), x, x) / 2)
    return Known(problem, lambda t, x, u: a @ x + b @ u, ("x",), start, np.full(n, np.nan), lambda _: cost)


def fastest(q0: float, v0: float, q1: float, v1: float) -> float:
    """Least time of x'' = u, |u| <= 1, between two states: one switch at most."""
    results = []
    for sign in (1.0, -1.0):
        squared = (v0**2 + v1**2) / 2 + sign * (q1 - q0)
        if squared >= 0:
            for top in (np.sqrt(squared), -np.sqrt(squared)):
                before, after = top - sign * v0, top - sign * v1
                if min(before, after) >= -1e-12:
                    results.append(before + after)
    return float(min(results))


def minimum_time(seed: int) -> Known:
    """The double integrator between random states in the least time, sometimes with the exact time as guess."""
    rng = np.random.default_rng([22, seed])
    q0, v0, q1, v1 = rng.uniform(-2, 2, size=4)
    cost = fastest(q0, v0, q1, v1)
    guess = float(cost if seed % 3 == 0 else rng.uniform(0.5, 2.0) * cost)
    problem, *_ = double_integrator("minimum time", (q0, v0), (q1, v1), horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.01, upper=50.0, guess=guess))
    ends = np.array([q0, v0]), np.array([q1, v1])
    rate: Rate = lambda t, x, u: np.array([x[1], u[0]])  # noqa: E731
    return Known(problem, rate, ("q", "v"), *ends, lambda _: cost, {"u": (-1.0, 1.0)})


def breakwell(seed: int) -> Known:
    """The double integrator turned round below a ceiling, at the least int u^2 / 2 (Breakwell; Bryson, Ho 3.11).

    From speed v to -v in T below l: with c = l / (v T) the cost is v^2 / T times 2 for c >= 1/4, 2 + 6 (1 - 4 c)^2
    down to 1/6, where the ceiling is touched at one point, and 4 / (9 c) below, where it is followed.
    """
    rng = np.random.default_rng([23, seed])
    speed, horizon = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-0.5, 0.5)
    c = float(rng.uniform(*[(1 / 12, 1 / 6), (1 / 6, 1 / 4), (1 / 4, 0.3)][(0, 0, 1, 1, 2)[seed % 5]]))
    factor = 2.0 if c >= 0.25 else 2 + 6 * (1 - 4 * c) ** 2 if c >= 1 / 6 else 4 / (9 * c)
    cost, ceiling = factor * speed**2 / horizon, c * speed * horizon
    problem, _, _, u = double_integrator("Breakwell", (0.0, speed), (0.0, -speed), horizon, ceiling=ceiling)
    problem.minimize(u**2 / 2)
    ends = np.array([0.0, speed]), np.array([0.0, -speed])
    rate: Rate = lambda t, x, u: np.array([x[1], u[0]])  # noqa: E731
    return Known(problem, rate, ("q", "v"), *ends, lambda _: cost, {"q": (-np.inf, ceiling)})


def pendulum(seed: int) -> Known:
    """A pendulum of some length from rest to rest, at the least int u^2: the extremal beside a plan by scipy.

    scipy's collocation of fourth order with residual control starts from the plan, and is integrated once more.
    """
    rng = np.random.default_rng([24, seed])
    stiff, drag = float(10 ** rng.uniform(-0.5, 1.0)), float(rng.uniform(0.0, 0.5))
    ends = rng.uniform(-1.2, 1.2, size=2) + np.array([0.0, np.pi if seed % 3 == 0 else 0.0])
    horizon = float(rng.uniform(0.6, 2.0)) * 2 / np.sqrt(stiff)
    problem = Problem("pendulum")
    a = problem.state("a", initial=ends[0], terminal=ends[1])
    w = problem.state("w", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(a, w)
    problem.dynamics(w, -stiff * ca.sin(a) - drag * w + u)
    problem.horizon(horizon)
    problem.minimize(u**2)

    def canonical(t: Array, y: Array) -> Array:
        return np.array(
            [y[1], -stiff * np.sin(y[0]) - drag * y[1] - y[3] / 2, stiff * np.cos(y[0]) * y[3], -y[2] + drag * y[3]]
        )

    def ends_met(first: Array, last: Array) -> Array:
        return np.array([first[0] - ends[0], first[1], last[0] - ends[1], last[1]])

    def beside(plan: Solution) -> float:
        values = [plan["a"], plan["w"], plan.costate("a"), plan.costate("w")]
        t, keep = np.unique(plan.t, return_index=True)
        result = solve_bvp(canonical, ends_met, t, np.hstack(values)[keep].T, tol=1e-9, max_nodes=20000)
        if not result.success:
            return float("nan")
        spend: Any = lambda t, y: [*canonical(t, y[:4]), y[3] ** 2 / 4]  # noqa: E731
        along = solve_ivp(spend, (0, horizon), [*result.y[:, 0], 0.0], rtol=1e-10, atol=1e-12)
        return float(along.y[4, -1])

    rate: Rate = lambda t, x, u: np.array([x[1], -stiff * np.sin(x[0]) - drag * x[1] + u[0]])  # noqa: E731
    return Known(problem, rate, ("a", "w"), np.array([ends[0], 0.0]), np.array([ends[1], 0.0]), beside)


FAMILIES: dict[str, Callable[[int], Known]] = {
    "regulator": regulator,
    "minimum time": minimum_time,
    "Breakwell": breakwell,
    "pendulum": pendulum,
}
