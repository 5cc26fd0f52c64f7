"""A robot arm of variable reach turned in least time.

L rho'' = u1, I_theta theta'' = u2, I_phi phi'' = u3, |u| <= 1, I_phi = ((L - rho)^3 + rho^3) / 3, I_theta = I_phi sin^2
phi, L = 5, from rest at (4.5, 0, pi / 4) to rest at (4.5, 2 pi / 3, pi / 4). COPS 3, problem 8. The controls switch.
OptimalControlProblems.jl, robot.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import COPS, TOOLBOX, Entry

LENGTH, REACH, LIFT, TURN = 5.0, 4.5, np.pi / 4, 2 * np.pi / 3


def build() -> Problem:
    problem = Problem("robot arm")
    rho = problem.state("rho", initial=REACH, terminal=REACH, lower=0.0, upper=LENGTH, guess=REACH)
    theta = problem.state("theta", initial=0.0, terminal=TURN, lower=-np.pi, upper=np.pi, guess=lambda t: TURN * t**2)
    phi = problem.state("phi", initial=LIFT, terminal=LIFT, lower=0.0, upper=np.pi, guess=LIFT)
    rates = problem.state("rates", initial=np.zeros(3), terminal=np.zeros(3), guess=lambda t: [0.0, 2 * TURN * t, 0.0])
    u = problem.control("u", 3, lower=-1.0, upper=1.0, guess=0.0)
    horizon = problem.horizon(lower=0.1, upper=100.0, guess=1.0)
    inertia = ((LENGTH - rho) ** 3 + rho**3) / 3
    problem.dynamics(rho, rates[0])
    problem.dynamics(theta, rates[1])
    problem.dynamics(phi, rates[2])
    problem.dynamics(rates, ca.vertcat(u[0] / LENGTH, u[1] / (inertia * ca.sin(phi) ** 2), u[2] / inertia))
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "robot", (COPS, TOOLBOX), build, {COPS: 9.1409}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
