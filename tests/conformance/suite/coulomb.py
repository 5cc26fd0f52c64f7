"""Two masses with Coulomb friction, coupled by springs, in least time.

m1 q1'' = -(k1 + k2) q1 + k2 q2 - mu sign(q1') + u1, m2 q2'' = k2 q1 - k2 q2 - mu sign(q2') + u2, |u| <= 4, from q =
(0, 0), q' = (-1, -2) to rest at (1, 2). The sign is smoothed, v / sqrt(v^2 + 0.01^2). Driessen & Sadegh, 2000; PSOPT,
example coulomb.
"""

from __future__ import annotations

import casadi as ca

from ocp import Problem

from .entry import PSOPT, Entry

K1, K2, FRICTION, M1, M2, SMOOTHING = 0.95, 0.85, 1.0, 1.1, 1.2, 0.01


def build() -> Problem:
    problem = Problem("Coulomb friction")
    q = problem.state("q", initial=[0.0, 0.0], terminal=[1.0, 2.0], lower=-2.0, upper=2.0)
    v = problem.state("v", initial=[-1.0, -2.0], terminal=[0.0, 0.0], lower=-20.0, upper=20.0)
    u = problem.control("u", 2, lower=-4.0, upper=4.0)
    horizon = problem.horizon(lower=1.8, upper=4.0, guess=4.0)
    friction = FRICTION * v / ca.sqrt(v**2 + SMOOTHING**2)
    problem.dynamics(q, v)
    problem.dynamics(
        v,
        ca.vertcat(
            (-(K1 + K2) * q[0] + K2 * q[1] - friction[0] + u[0]) / M1, (K2 * q[0] - K2 * q[1] - friction[1] + u[1]) / M2
        ),
    )
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry("coulomb", (PSOPT,), build, {PSOPT: 2.104992})
