"""Fuller's problem: the optimal control switches infinitely often in finite time.

q' = v, v' = u, |u| <= 1, from (0, 1) to rest at 0 in 3.5 s, least int q^2 dt. The control is u = -sign(q + Z v |v|);
its switching times accumulate at 2.92 s, after which the plan rests. Each arc is the one before it scaled by W in
time and velocity, W^2 in position, so the cost is a geometric series with ratio W^5. At a switch lv = 0, and H = 0
gives lq. Fuller, J. Electronics and Control 15, 1963; Zelikin & Borisov, Theory of Chattering Control, 1994, chapter
2.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from math import sqrt

import numpy as np

from ocp import Problem
from tests.ocp.problems import double_integrator

from .case import Array, Case, Extremal, Switch, fitted, held, legendre, radau, within

HORIZON = 3.5
Z = sqrt((sqrt(33) - 1) / 24)
W = sqrt((0.5 - Z) / (0.5 + Z))
V1 = -1 / sqrt(1 + 2 * Z)  # velocity at the first switch, whose position is Z V1^2


def build() -> Problem:
    problem, q, _, _ = double_integrator("Fuller", (0.0, 1.0), (0.0, 0.0), HORIZON, limit=1.0)
    problem.minimize(running=q**2)
    return problem


def arc(s: Array, q: float, v: float, u: float) -> tuple[Array, Array, Array, Array]:
    """q, v, lq, lv at times s (M,) after (or before) a switch at (q, v), under constant u."""
    lq = -(q**2) / v
    return (
        q + v * s + u * s**2 / 2,
        v + u * s,
        lq - (2 * q * s + v * s**2 + u * s**3 / 3),
        -(lq * s - (q * s**2 + v * s**3 / 3 + u * s**4 / 12)),
    )


@cache
def switch_states() -> tuple[tuple[float, float, float], ...]:
    """Time, position and velocity at the switches, until the velocity is 1e-12."""
    states = [(1 - V1, Z * V1**2, V1)]
    while abs(states[-1][2]) > 1e-12:
        t, q, v = states[-1]
        states.append((t + abs(v) * (1 + W), -(W**2) * q, -W * v))
    return tuple(states)


def optimal_cost() -> float:
    """Integral of q^2: the first arc, and the arc after the first switch times 1 / (1 - W^5)."""

    def squared(q: float, v: float, u: float, s: float) -> float:
        return q**2 * s + q * v * s**2 + (v**2 + q * u) * s**3 / 3 + v * u * s**4 / 4 + u**2 * s**5 / 20

    first = squared(0.0, 1.0, -1.0, 1 - V1)
    second = squared(Z * V1**2, V1, 1.0, -V1 * (1 + W))
    return first + second / (1 - W**5)


def optimum(t: Array) -> Extremal:
    states = switch_states()
    q, v, lq, lv, u = np.zeros((5, t.size))
    begins = [-np.inf, *(state[0] for state in states)]
    for k, (begin, end) in enumerate(pairwise(begins)):
        on = (t >= begin) & (t < end)
        time, position, velocity = states[max(k - 1, 0)]  # the first arc is followed back from its end
        direction = -1.0 if k % 2 == 0 else 1.0
        u[on] = direction
        q[on], v[on], lq[on], lv[on] = arc(t[on] - time, position, velocity, direction)
    return Extremal(state={"q": q, "v": v}, control={"u": u}, costate={"q": lq, "v": lv})


MESH = fitted([t / HORIZON for t, q, v in switch_states()[:4]], 10)

RUNS = (
    # held controls: q^2 is a quartic in time, which both quadratures integrate exactly, so no plan beats the
    # optimum. No mesh can follow the chattering: the controls are not compared
    *within(*held(70)[:2], cost=(1e-8, 2e-4), state=5e-2, control=None, costate=2e-3, time=0.02),
    # the first four switches on nodes; what is left of the motion is W^4 = 1/290 of it
    *within(radau(MESH, control="held"), cost=(1e-8, 1e-8), state=2e-2, control=5e-3, costate=2e-4, time=1e-3),
    *within(legendre(MESH, control="held"), cost=(1e-8, 1e-8), state=2e-2, control=5e-3, costate=3e-5, time=1e-3),
)
SWITCHES = (
    *(Switch(t, lambda x, lam: lam["v"]) for t, q, v in switch_states()[:2]),
    *(Switch(t) for t, q, v in switch_states()[2:]),
)
CASE = Case("Fuller", build, optimal_cost(), RUNS, horizon=HORIZON, optimum=optimum, switches=SWITCHES)
