"""A uniform rod on a cart swung up in least time.

(M + m) x'' + m (L / 2) (theta'' cos theta - theta'^2 sin theta) = F, (m L^2 / 3) theta'' = -m (L / 2) (x'' cos theta +
g sin theta); L = 1 m, m = 1 kg, M = 0.5 kg, |F| <= 5 N, |x| <= 1 m, |x'| <= 2 m/s, from rest hanging to rest upright.
The velocity of the cart is free at both ends. OptimalControlProblems.jl, cart_pendulum, states the acceleration of the
cart by a constant that it then leaves free; here it follows from the equations of motion.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

GRAVITY, LENGTH, ROD, CART = 9.81, 1.0, 1.0, 0.5


def build() -> Problem:
    problem = Problem("cart and rod")
    x = problem.state("x", initial=0.0, lower=-1.0, upper=1.0, unit="m", guess=0.0)
    v = problem.state("v", lower=-2.0, upper=2.0, unit="m/s", guess=lambda t: np.sin(np.pi * t))
    theta = problem.state("theta", initial=0.0, terminal=np.pi, unit="rad")
    omega = problem.state("omega", initial=0.0, terminal=0.0, unit="rad/s")
    force = problem.control("F", lower=-5.0, upper=5.0, guess=lambda t: 5.0 * np.cos(np.pi * t), unit="N")
    horizon = problem.horizon(lower=0.1, upper=20.0, guess=3.0)
    s, c = ca.sin(theta), ca.cos(theta)
    half, inertia = ROD * LENGTH / 2, ROD * LENGTH**2 / 3
    determinant = (CART + ROD) * inertia - (half * c) ** 2
    push = force + half * omega**2 * s
    acceleration = (inertia * push + half**2 * GRAVITY * s * c) / determinant
    problem.dynamics(x, v)
    problem.dynamics(v, acceleration)
    problem.dynamics(theta, omega)
    problem.dynamics(omega, -half * (acceleration * c + GRAVITY * s) / inertia)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "cart_pendulum", (TOOLBOX,), build, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
