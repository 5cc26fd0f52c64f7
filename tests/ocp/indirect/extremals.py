"""Problems for the minimum principle: every way in which time, horizon, parameters and conditions can enter it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem
from tests.ocp.problems import plant

FINE = Collocation(60, 4, "legendre")
KINKED = Collocation(320)
HELD = Collocation(240, control="held")


@dataclass(frozen=True)
class Extremum:
    """A problem, what its control law is, and what a fine direct solution may differ by.

    Attributes:
        build: The statement. parameters: Values of its parameters.
        how: How the Hamiltonian determines the smooth controls. switches: Number of switches of the linear ones.
        direct: A fine direct method. cost, state, costate: Largest differences from its solution.
    """

    build: Callable[[], Problem]
    parameters: Mapping[str, Any]
    how: str = "quadratic"
    switches: int = 0
    direct: Collocation = FINE
    cost: float = 1e-10
    state: float = 1e-8
    costate: float = 1e-8


def regulator() -> Problem:
    """min T/2 of x' = a x + u: closed form in test_cost_gradient."""
    problem = Problem("scalar regulator")
    a, x0, horizon = problem.parameter("a"), problem.parameter("x0"), problem.parameter("h")
    x = problem.state("x", initial=x0)
    u = problem.control("u")
    problem.horizon(horizon)
    problem.dynamics(x, a * x + u)
    problem.minimize(running=(x**2 + u**2) / 2)
    return problem


def everything() -> Problem:
    """Free horizon that enters everywhere, time, parameters in every place, start, end and path equalities."""
    problem = Problem("everything")
    k, weight, x0 = problem.parameter("k", 2), problem.parameter("weight"), problem.parameter("x0", 2)
    level, task = problem.parameter("level"), problem.parameter("task")
    x = problem.state("x", initial=x0)
    z = problem.state("z")
    u = problem.control("u", 2)
    t, T = problem.time, problem.horizon(lower=0.2, upper=9.0, guess=1.5)
    problem.dynamics(x, ca.vertcat(x[1] + 0.1 * ca.sin(t), -k[0] * ca.sin(x[0]) + u[0] * (1 + 0.1 * t / T)))
    problem.dynamics(z, -z + u[1] + 0.2 * x[0] * T)
    problem.path("task", u[0] + u[1] * (2 + ca.cos(z)) - 0.3 * x[0], task, task)
    problem.start("tie", z - 0.5 * x[0] + 0.1 * k[1], 0.2 * level, 0.2 * level)
    problem.end("gate", x[0] + 0.1 * T, level, level)
    problem.minimize(
        running=weight * ca.sumsqr(u) / 2 + k[1] * ca.sumsqr(x) / 2 + 0.1 * T * t + 0.3 * z**2,
        terminal=0.4 * T**2 + k[1] * x[1] ** 2 + problem.at_start(z) ** 2,
    )
    return problem


def fixed_horizon() -> Problem:
    """The fixed horizon is a parameter and enters dynamics and both costs; a free end."""
    problem = Problem("fixed horizon")
    h, x0 = problem.parameter("h"), problem.parameter("x0")
    x = problem.state("x", initial=x0)
    u = problem.control("u")
    T = problem.horizon(h)
    problem.dynamics(x, -x * T + u + ca.sin(problem.time))
    problem.minimize(running=u**2 / 2 + x**2 + 0.1 * T, terminal=T * x**2)
    return problem


def free_horizon() -> Problem:
    """The free horizon enters dynamics, both costs and the end constraint."""
    problem, x, u = plant("free horizon", initial=1.0, horizon=None)
    g = problem.parameter("g")
    T = problem.horizon(lower=0.2, upper=5.0, guess=1.0)
    problem.dynamics(x, u * ca.exp(-0.2 * T) - x * problem.time / T)
    problem.end("gate", x - 0.2 * T, g, g)
    problem.minimize(running=u**2 / 2 + 0.3 * T * x**2, terminal=ca.log(1 + T**2) * x + 0.3 * T)
    return problem


def cyclic() -> Problem:
    """A driven oscillator whose end is its start but for a parameter; nothing else is given there."""
    problem, x, u = plant("cyclic", size=2, horizon=2.0)
    a = problem.parameter("a")
    problem.dynamics(x, ca.vertcat(x[1], u - x[0] - 0.2 * x[1] + ca.sin(np.pi * problem.time)))
    problem.end("cyclic", x - problem.at_start(x), a, a)
    problem.minimize(running=u**2 / 2 + (x[0] - 0.5) ** 2)
    return problem


def free_period() -> Problem:
    """A cycle of van der Pol's oscillator from a given point in a free time: its period where the drive is cheap."""
    problem, x, u = plant("free period", size=2, guess=lambda t: [np.cos(t), -np.sin(t)], horizon=None)
    amplitude = problem.parameter("amplitude")
    T = problem.horizon(lower=3.0, upper=9.0, guess=6.0)
    problem.dynamics(x, ca.vertcat(x[1], 0.3 * (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.start("phase", x[1], 0, 0)
    problem.start("amplitude", x[0], amplitude, amplitude)
    problem.end("cyclic", x - problem.at_start(x), 0, 0)
    problem.minimize(running=u**2 / 2, terminal=0.01 * T)
    return problem


def free_start() -> Problem:
    """Nothing at either end is given: natural conditions everywhere."""
    problem, x, u = plant("free start", size=2, horizon=1.5)
    c = problem.parameter("c")
    problem.dynamics(x, ca.vertcat(x[1], u - ca.sin(x[0])))
    start = problem.at_start(x)
    problem.minimize(
        running=u**2 / 2 + (x[0] - c * problem.time) ** 2,
        terminal=x[0] * start[1] + ca.sumsqr(x) / 2 + ca.sumsqr(start - 0.3) * 2,
    )
    return problem


def saturated() -> Problem:
    """Two controls put inside their own bounds, some of them parameters."""
    problem = Problem("saturated")
    limit = problem.parameter("limit", 2)
    x = problem.state("x", 2, initial=[1.0, -0.5])
    u = problem.control("u", 2, lower=-limit, upper=[0.3, 0.9])
    problem.horizon(3.0)
    problem.dynamics(x, ca.vertcat(x[1] + 0.3 * u[0], (1 - x[0] ** 2) * x[1] - x[0] + u[1]))
    problem.minimize(running=ca.sumsqr(x) / 2 + 0.2 * ca.sumsqr(u))
    return problem


def coupled() -> Problem:
    """Bounded controls whose cost couples them: clipping one by one would be wrong."""
    problem = Problem("coupled")
    limit = problem.parameter("limit")
    x = problem.state("x", 2, initial=[1.0, -1.0])
    u = problem.control("u", 2, lower=[-0.5, -limit], upper=[0.5, limit])
    problem.horizon(2.0)
    problem.dynamics(x, ca.vertcat(x[1] + u[0], u[1] - x[0]))
    problem.minimize(running=ca.sumsqr(x) / 2 + ca.sumsqr(u) / 2 + 0.6 * u[0] * u[1])
    return problem


def bounded_task() -> Problem:
    """Bounded controls tied by a path equality."""
    problem = Problem("bounded task")
    c = problem.parameter("c")
    x = problem.state("x", 2, initial=[1.0, -1.0])
    u = problem.control("u", 3, lower=-0.6, upper=0.6)
    problem.horizon(2.0)
    problem.dynamics(x, ca.vertcat(x[1] + u[0], u[1] - x[0] + u[2]))
    problem.path("task", u[0] + u[1] + 0.5 * u[2] - 0.1 * x[0], c, c)
    problem.minimize(running=ca.sumsqr(x) / 2 + ca.sumsqr(u) / 2)
    return problem


def quartic() -> Problem:
    """A Hamiltonian of the fourth order in the control."""
    problem = Problem("quartic")
    end = problem.parameter("end")
    x = problem.state("x", 2, initial=0.0, terminal=ca.vertcat(end, 0))
    u = problem.control("u")
    problem.horizon(1.0)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.minimize(running=u**4 / 4 + u**2 / 2)
    return problem


def heading() -> Problem:
    """Least time across a shear flow, steered by an angle (Zermelo)."""
    problem = Problem("heading")
    shear = problem.parameter("shear")
    x = problem.state("x", 2, initial=[3.0, -2.0], terminal=[0.0, 0.0])
    angle = problem.control("angle", guess=2.0)
    T = problem.horizon(lower=0.5, upper=30.0, guess=4.0)
    problem.dynamics(x, ca.vertcat(ca.cos(angle) - shear * x[1], ca.sin(angle)))
    problem.minimize(terminal=T)
    return problem


def bang_bang() -> Problem:
    """Two bang-bang controls, five switches, two of them 0.03 s apart; bounds are parameters, time enters."""
    problem = Problem("bang-bang")
    b = problem.parameter("b", 2)
    x = problem.state("x", 2, initial=[0.0, 0.0])
    y = problem.state("y", initial=0.2)
    u = problem.control("u", 2, lower=[-1, -b[1]], upper=[b[0], 2.0])
    problem.horizon(6.0)
    t = problem.time
    problem.dynamics(x, ca.vertcat(x[1], -x[0] + u[0]))
    problem.dynamics(y, -0.3 * y + u[1] * ca.cos(1.3 * t) + 0.1 * x[0])
    problem.minimize(running=x[0] * ca.sin(0.7 * t) + 0.2 * y, terminal=0.3 * y**2 + x[1])
    return problem


def mixed() -> Problem:
    """One bang-bang and one quadratic control, a free time, a curved target."""
    problem = Problem("mixed")
    b = problem.parameter("b")
    x = problem.state("x", 2, initial=[1.0, 0.0])
    u = problem.control("u", lower=-b, upper=b)
    w = problem.control("w")
    problem.horizon(lower=0.5, upper=9.0, guess=3.0)
    problem.dynamics(x, ca.vertcat(x[1] + 0.5 * w, -x[0] + u))
    problem.end("target", ca.sumsqr(x), 0.04, 0.04)
    problem.minimize(running=w**2 / 2 + 1 + 0.1 * x[0] ** 2)
    return problem


def tabulated(kind: str) -> Problem:
    """MX: a pendulum whose torque is a B-spline table; quadratic, saturated, bang-bang or tied controls."""
    at = np.linspace(-3, 3, 40)
    table = ca.interpolant("table", "bspline", [at], np.sin(at))
    problem = Problem(f"tabulated, {kind}", ca.MX)
    c = problem.parameter("c")
    x = problem.state("x", 2, initial=[1.0, 0.0])
    limit = 0.3 if kind in ("saturated", "bang-bang") else np.inf
    u = problem.control("u", 2, lower=-limit, upper=limit)
    problem.horizon(3.0)
    problem.dynamics(x, ca.vertcat(x[1] + u[1], -c * table(x[0]) + u[0]))
    if kind == "tied":
        problem.path("task", u[0] + x[1] * u[1], c, c)
    if kind == "bang-bang":
        problem.minimize(running=x[0], terminal=x[1])
    else:
        problem.minimize(running=ca.sumsqr(x) / 2 + ca.sumsqr(u) / 2)
    return problem


EXTREMA: dict[str, Extremum] = {
    "everything": Extremum(everything, {"k": [1.0, 0.7], "weight": 1.3, "x0": [0.5, -0.2], "level": 0.3, "task": 0.25}),
    "fixed horizon": Extremum(fixed_horizon, {"h": 1.7, "x0": 0.4}),
    "free horizon": Extremum(free_horizon, {"g": -0.1}),
    "cyclic": Extremum(cyclic, {"a": 0.1}),
    "free period": Extremum(free_period, {"amplitude": 1.0}, state=1e-7),
    "free start": Extremum(free_start, {"c": 0.8}),
    "saturated": Extremum(
        saturated, {"limit": [0.25, 0.4]}, how="projected", direct=KINKED, cost=1e-7, state=1e-4, costate=1e-4
    ),
    "coupled": Extremum(coupled, {"limit": 0.4}, how="iterated", direct=KINKED, cost=1e-8, state=1e-5, costate=1e-5),
    "bounded task": Extremum(
        bounded_task, {"c": 0.1}, how="iterated", direct=KINKED, cost=1e-7, state=1e-5, costate=1e-5
    ),
    "quartic": Extremum(quartic, {"end": 0.5}, how="iterated", cost=1e-7, state=1e-6, costate=1e-4),
    "heading": Extremum(heading, {"shear": 0.4}, how="iterated"),
    "bang-bang": Extremum(bang_bang, {"b": [0.8, 1.2]}, switches=5, direct=HELD, cost=3e-4, state=3e-2, costate=1e-3),
    "mixed": Extremum(mixed, {"b": 0.5}, switches=1, direct=HELD, cost=2e-5, state=2e-3, costate=2e-3),
    "tabulated": Extremum(lambda: tabulated("free"), {"c": 0.9}, cost=1e-9, state=1e-7, costate=5e-6),
    "tabulated, saturated": Extremum(
        lambda: tabulated("saturated"), {"c": 0.9}, "projected", direct=KINKED, cost=1e-7, state=1e-5, costate=1e-5
    ),
    "tabulated, bang-bang": Extremum(
        lambda: tabulated("bang-bang"), {"c": 0.9}, switches=1, direct=HELD, cost=1e-5, state=2e-3, costate=2e-3
    ),
    "tabulated, tied": Extremum(lambda: tabulated("tied"), {"c": 0.9}, cost=1e-9, state=1e-7, costate=1e-5),
}
