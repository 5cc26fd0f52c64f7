"""A planar lander with two thrusters flies to (5, 5) m in least time.

m p'' = R(theta) (0, F1 + F2) - (0, m g), I theta'' = (D / 2) (F2 - F1), 0 <= F <= 2 g N, from rest upright, to rest
with a free attitude; m = 1 kg, I = 0.1 kg m^2, D = 1 m. OptimalControlProblems.jl, moonlander.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

MASS, GRAVITY, INERTIA, WIDTH = 1.0, 9.81, 0.1, 1.0


def build() -> Problem:
    problem = Problem("moon lander")
    p = problem.state("p", initial=[0.0, 0.0], terminal=[5.0, 5.0], unit="m")
    v = problem.state("v", initial=[0.0, 0.0], terminal=[0.0, 0.0], unit="m/s")
    theta = problem.state("theta", initial=0.0, guess=0.1, unit="rad")
    omega = problem.state("omega", initial=0.0, guess=0.1, unit="rad/s")
    thrust = problem.control("F", 2, lower=0.0, upper=2 * GRAVITY, guess=5.0, unit="N")
    horizon = problem.horizon(lower=0.1, upper=20.0, guess=1.0)
    total = thrust[0] + thrust[1]
    problem.dynamics(p, v)
    problem.dynamics(v, ca.vertcat(-ca.sin(theta) * total / MASS, ca.cos(theta) * total / MASS - GRAVITY))
    problem.dynamics(theta, omega)
    problem.dynamics(omega, WIDTH / 2 * (thrust[1] - thrust[0]) / INERTIA)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "moonlander", (TOOLBOX,), build, {"CTDirect": "0.962"}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
