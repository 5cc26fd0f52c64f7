"""F-8 aircraft brought to level flight in least time by its tail, which has two positions.

Angle of attack x1, pitch x2, pitch rate x3; the deflection w is 0.05236 or -0.05236 rad. The dynamics are cubic in w;
between both values they are here the convex combination, whose optimum is bang-bang, so that both problems agree. Kaya
& Noakes, 2003, give 3.78086 s with three switches, and local minima of 4.400, 5.729, 5.742 and 6.035 s; PSOPT, example
f8. The guess is the known sequence of switches.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, samples

DEFLECTION = 0.05236
SWITCHES = (1.135, 1.482, 3.089)  # s, of the guess: w is positive up to the first
DURATION = 3.781


def rates(x: Any, w: float) -> list[Any]:
    """d/dt of the states at a deflection."""
    a, p, q = x[0], x[1], x[2]
    return [
        -0.877 * a + q - 0.088 * a * q + 0.47 * a**2 - 0.019 * p**2 - a**2 * q + 3.846 * a**3
        - 0.215 * w + 0.28 * a**2 * w + 0.47 * a * w**2 + 0.63 * w**3,
        q,
        -4.208 * a - 0.396 * q - 0.47 * a**2 - 3.564 * a**3
        - 20.967 * w + 6.265 * a**2 * w + 46.0 * a * w**2 + 61.4 * w**3,
    ]  # fmt: skip


def build() -> Problem:
    times = np.linspace(0.0, DURATION, 121)

    def share(t: float) -> float:
        return 1.0 if t < SWITCHES[0] or SWITCHES[1] <= t < SWITCHES[2] else 0.0

    flown = solve_ivp(
        lambda t, x: rates(x, DEFLECTION * (2 * share(t) - 1)), (0.0, DURATION), [0.4655, 0.0, 0.0], t_eval=times,
        max_step=0.005,
    )  # fmt: skip
    problem = Problem("F-8 aircraft")
    x = problem.state(
        "x", initial=[0.4655, 0.0, 0.0], terminal=[0.0, 0.0, 0.0], lower=-2.0, upper=2.0,
        guess=samples(times.tolist(), flown.y.T.tolist()),
    )  # fmt: skip
    positive = problem.control("positive", lower=0.0, upper=1.0, guess=share)
    horizon = problem.horizon(lower=1.0, upper=8.0, guess=DURATION)
    up, down = ca.vertcat(*rates(x, DEFLECTION)), ca.vertcat(*rates(x, -DEFLECTION))
    problem.dynamics(x, positive * up + (1 - positive) * down)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "f8", (PSOPT,), build, {PSOPT: 3.780858, "Kaya & Noakes": 3.78086}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
