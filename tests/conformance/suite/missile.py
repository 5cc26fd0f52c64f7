"""Terminal manoeuvre of a missile: the fastest dive onto a target.

gamma' = ((T - D) sin a + L) / (m V) - g cos gamma / V, V' = ((T - D) cos a - L sin a) / m - g sin gamma, x' = V cos
gamma, h' = V sin gamma; thrust 1 to 6 kN, |a| <= 0.3 rad, load factor |L| <= 4 m g, h >= 30 m before x = 7500 m
(smoothed by a hyperbolic tangent of 10 / m), in least time from (0, 272 m/s, 0, 30 m) to (-90 deg, 310 m/s, 10 km, 0).
Subchan & Zbikowski, 2009; PSOPT, example missile.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

MASS, GRAVITY, SURFACE = 1005.0, 9.81, 0.3376
A1, A2, A3, B1 = -1.9431, -0.1499, 0.2359, 21.9
C1, C2, C3 = 3.312e-9, -1.142e-4, 1.224
STEEPNESS = 10.0


def build() -> Problem:
    problem = Problem("missile")
    gamma = problem.state("gamma", initial=0.0, terminal=-np.pi / 2, lower=-np.pi / 2, upper=np.pi / 2, unit="rad")
    speed = problem.state("V", initial=272.0, terminal=310.0, lower=200.0, upper=310.0, unit="m/s")
    x = problem.state("x", initial=0.0, terminal=10000.0, lower=0.0, upper=10000.0, unit="m")
    h = problem.state("h", initial=30.0, terminal=0.0, lower=0.0, upper=1900.0, unit="m")
    thrust = problem.control("T", lower=1000.0, upper=6000.0, guess=6000.0, unit="N")
    alpha = problem.control("alpha", lower=-0.3, upper=0.3, guess=0.0, unit="rad")
    horizon = problem.horizon(lower=10.0, upper=100.0, guess=50.0)
    pressure = (C1 * h**2 + C2 * h + C3) * speed**2 * SURFACE / 2
    drag, lift = (A1 * alpha**2 + A2 * alpha + A3) * pressure, B1 * alpha * pressure
    s, c = ca.sin(alpha), ca.cos(alpha)
    problem.dynamics(gamma, ((thrust - drag) * s + lift) / (MASS * speed) - GRAVITY * ca.cos(gamma) / speed)
    problem.dynamics(speed, ((thrust - drag) * c - lift * s) / MASS - GRAVITY * ca.sin(gamma))
    problem.dynamics(x, speed * ca.cos(gamma))
    problem.dynamics(h, speed * ca.sin(gamma))
    problem.path("load factor", lift / (MASS * GRAVITY), -4.0, 4.0)
    before = 0.5 * (1 + ca.tanh(STEEPNESS * (7500.0 - x)))
    problem.path("least altitude", h - 30.0 * before, 0.0, 1900.0, unit="m")
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "missile", (PSOPT,), build, {PSOPT: 40.91755}, method=Collocation(60, 3), second=Collocation(85, 3, "legendre")
)
