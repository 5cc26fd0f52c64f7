"""Catalyst mixing (COPS 3.0, problem 14): bang, singular, bang.

x1' = u (10 x2 - x1), x2' = u (x1 - 10 x2) - (1 - u) x2 from (1, 0), 1 s, 0 <= u <= 1, least x1 + x2 - 1. With x' = (N
+ u M) x the switching function is l.Mx, its rate l.Cx with C = MN - NM. On the singular arc Mx and Cx are parallel,
which fixes the ratio r = x2/x1: 90 r^2 - 20 r + 1 = 0; u keeps it. Pure first catalyst until the ratio is reached,
pure second from where l.Mx leaves zero.
"""

from __future__ import annotations

from math import exp, log, sqrt

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Switch, fitted, held, shooting, within

HORIZON = 1.0
RATIO = (20 - sqrt(40)) / 180
SINGULAR = 1 / (1 + (1 - 10 * RATIO) * (1 + 1 / RATIO))
X2_ENTRY = RATIO / (1 + RATIO)  # on the first arc x1 + x2 = 1
T1 = -log(1 - 11 * X2_ENTRY) / 11
L_RATIO = (1 - 10 * RATIO) / (1 - 9 * RATIO)  # l2/l1 on the singular arc
T2 = HORIZON + log(L_RATIO)
DECAY = SINGULAR * (1 - 10 * RATIO)  # of both states on the singular arc, 1/s
X1_EXIT = (1 - X2_ENTRY) * exp(-DECAY * (T2 - T1))
L1_ENTRY = exp(-SINGULAR * (1 - L_RATIO) * (T2 - T1))  # l1 is 1 from T2 on
MESH = fitted((T1, T2), 20)


def build() -> Problem:
    problem = Problem("catalyst mixing")
    x1 = problem.state("x1", initial=1.0)
    x2 = problem.state("x2", initial=0.0)
    u = problem.control("u", lower=0.0, upper=1.0)
    problem.horizon(HORIZON)
    problem.dynamics(x1, u * (10 * x2 - x1))
    problem.dynamics(x2, u * (x1 - 10 * x2) - (1 - u) * x2)
    problem.minimize(terminal=x1 + x2 - 1)
    return problem


def optimum(t: Array) -> Extremal:
    first, last = t < T1, t >= T2
    singular_x1 = (1 - X2_ENTRY) * np.exp(-DECAY * (t - T1))
    first_x2 = (1 - np.exp(-11 * t)) / 11
    singular_l1 = np.exp(SINGULAR * (1 - L_RATIO) * (t - T2))
    # first arc: l1 - l2 grows as exp(11 t), 10 l1 + l2 stays
    difference = L1_ENTRY * (1 - L_RATIO) * np.exp(11 * (t - T1))
    kept = L1_ENTRY * (10 + L_RATIO)
    arcs = [first, last]
    return Extremal(
        state={
            "x1": np.select(arcs, [1 - first_x2, np.full_like(t, X1_EXIT)], singular_x1),
            "x2": np.select(arcs, [first_x2, RATIO * X1_EXIT * np.exp(T2 - t)], RATIO * singular_x1),
        },
        control={"u": np.select(arcs, [np.ones_like(t), np.zeros_like(t)], SINGULAR)},
        costate={
            "x1": np.select(arcs, [(kept + difference) / 11, np.ones_like(t)], singular_l1),
            "x2": np.select(arcs, [(kept - 10 * difference) / 11, np.exp(t - HORIZON)], L_RATIO * singular_l1),
        },
    )


RUNS = (
    # held controls: free ones ring along a singular arc. Uniform intervals, then both switches on nodes
    *within(*held(50)[:2], cost=(1e-8, 1e-6), state=2e-3, control=None, costate=2e-2),
    *within(*held(MESH)[:2], cost=(1e-8, 1e-8), state=3e-7, control=1e-4, costate=4e-6),
    # smooth enough but for the switches: shooting with both of them on nodes
    *within(shooting(MESH, "held"), cost=(1e-8, 1e-8), state=3e-7, control=1e-4, costate=4e-6),
)
CASE = Case(
    "catalyst mixing",
    build,
    X1_EXIT * (1 + RATIO * L_RATIO) - 1,
    RUNS,
    horizon=HORIZON,
    optimum=optimum,
    switches=(Switch(T1), Switch(T2)),
)
