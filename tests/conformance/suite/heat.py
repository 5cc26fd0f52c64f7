"""Heat diffusion: the temperature at one end of a rod follows a course by the flux at the other.

(a1 + a2 y) y_t = q + (y_x (a3 + a4 y))_x on ten points, with boundary values y at x = 0 and 1 continued by v2 and v3:
(v1 - y) g = -(a3 + a4 y) y_x at 0 and y_x = 0 at 1. Least int (y(1, t) - 2 + exp(-t))^2 / 2 + 5e-4 v1^2 dt over 0.5 s,
0 <= v1 <= 0.1. Betts, 2010; PSOPT, example heat. The source q belongs to y = 2 + exp(-t) cos(pi x).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

POINTS = 10
A1, A2, A3, A4, DECAY, GAIN, WEIGHT = 4.0, 1.0, 4.0, -1.0, -1.0, 1.0, 1e-3
PLACES = np.linspace(0.0, 1.0, POINTS)
STEP = 1.0 / (POINTS - 1)


def source(t: Any, x: float) -> Any:
    """Heat that is produced at a place and a time."""
    decay, c, square = ca.exp(DECAY * t), np.cos(np.pi * x), np.pi**2
    return (
        (DECAY * (A1 + 2 * A2) + square * (A3 + 2 * A4)) * decay * c
        - A4 * square * decay**2
        + (2 * A4 * square + DECAY * A2) * decay**2 * c**2
    )


def build() -> Problem:
    start = 2 + np.cos(np.pi * PLACES)
    problem = Problem("heat diffusion")
    y = problem.state("y", initial=start, lower=0.0, upper=3.0, guess=start)
    v = problem.control("v", 3, lower=0.0, upper=[0.1, 3.0, 3.0], guess=[0.1, start[0], start[-1]])
    problem.horizon(0.5)
    t = problem.time
    beyond = ca.vertcat(v[1], y, v[2])
    rates = []
    for i, place in enumerate(PLACES):
        here = y[i]
        curvature = (beyond[i + 2] - 2 * here + beyond[i]) / STEP**2
        slope = (beyond[i + 2] - beyond[i]) / (2 * STEP)
        rates.append((source(t, place) + (A3 + A4 * here) * curvature + A4 * slope**2) / (A1 + A2 * here))
    problem.dynamics(y, ca.vertcat(*rates))
    problem.path("flux at 0", GAIN * (y[0] - v[0]) - (A3 + A4 * y[0]) * (y[1] - v[1]) / (2 * STEP), 0.0, 0.0)
    problem.path("flux at 1", (A3 + A4 * y[POINTS - 1]) * (v[2] - y[POINTS - 2]) / (2 * STEP), 0.0, 0.0)
    problem.minimize(running=((y[POINTS - 1] - 2 + ca.exp(DECAY * t)) ** 2 + WEIGHT * v[0] ** 2) / 2)
    return problem


ENTRY = Entry("heat", (PSOPT,), build, {PSOPT: 4.372837e-5}, method=Collocation(15, 4))
