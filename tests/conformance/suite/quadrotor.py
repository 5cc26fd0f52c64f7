"""A quadrotor flies 5 m aside in least time, tilted by at most 0.55 rad.

p'' = R(phi, theta, psi) (0, 0, a) - (0, 0, g), the rates of roll phi and pitch theta are controls, |.| <= 3 rad/s, 0 <=
a <= 45.9 m/s^2, cos theta cos phi >= cos 0.55, and the yaw psi is a control; from rest at (0, 0, 2.5) to rest at (0.01,
5, 2.5), least T + int 1e-8 (a^2 + phi^2 + theta^2 + psi^2) + 100 psi^2 dt. OptimalControlProblems.jl, quadrotor, which
marks it as not solved.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry, line

GRAVITY, TILT, RATE = 9.81, 0.55, 3.0
START, END = [0.0, 0.0, 2.5], [0.01, 5.0, 2.5]


def build() -> Problem:
    problem = Problem("quadrotor")
    p = problem.state("p", initial=START, terminal=END, guess=line(START, END), unit="m")
    v = problem.state("v", initial=np.zeros(3), terminal=np.zeros(3), guess=0.1, unit="m/s")
    tilt = problem.state("tilt", initial=[0.0, 0.0], lower=-np.pi / 2, upper=np.pi / 2, guess=0.1, unit="rad")
    a = problem.control("a", lower=0.0, upper=9.18 * 5, guess=10.0, unit="m/s^2")
    rate = problem.control("rate", 2, lower=-RATE, upper=RATE, guess=0.1, unit="rad/s")
    yaw = problem.control("yaw", guess=0.1, unit="rad")
    horizon = problem.horizon(lower=0.1, upper=20.0, guess=1.0)
    sr, cr, sp, cp = ca.sin(tilt[0]), ca.cos(tilt[0]), ca.sin(tilt[1]), ca.cos(tilt[1])
    sy, cy = ca.sin(yaw), ca.cos(yaw)
    problem.dynamics(p, v)
    problem.dynamics(
        v, a * ca.vertcat(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr) - ca.DM([0, 0, GRAVITY])
    )
    problem.dynamics(tilt, rate)
    problem.path("tilt", cp * cr, lower=np.cos(TILT))
    problem.minimize(running=1e-8 * (a**2 + ca.sumsqr(tilt) + yaw**2) + 100 * yaw**2, terminal=horizon)
    return problem


ENTRY = Entry(
    "quadrotor",
    (TOOLBOX,),
    build,
    {"CTDirect": "1.492"},
    method=Collocation(50, 3),
    second=Collocation(71, 3, "legendre"),
)
