"""A truck with two trailers is parked at a right angle, 2 m aside.

The positions and headings of truck and trailers follow the kinematic model of hitches M0 and M1 behind the axles; the
speed v0 and the steering angle d0 are limited, and so are their rates, which are the controls. Least T + int b01^2 +
b12^2 dt, where b are the angles between the vehicles, |b| <= pi / 2. Altafini's model; OptimalControlProblems.jl,
truck_trailer, which marks it as not solved.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import MultipleShooting, Problem

from .entry import TOOLBOX, Entry

L0, M0, L1, M1, L2 = 0.4, 0.1, 1.1, 0.2, 0.8  # m
SPEED, STEERING, STEERING_RATE = 0.2, np.pi / 6, np.pi / 10


def build() -> Problem:
    problem = Problem("truck and trailers")
    right = np.pi / 2
    x2 = problem.state("x2", initial=0.0, terminal=0.0, guess=0.1, unit="m")
    y2 = problem.state("y2", initial=0.0, terminal=-2.0, unit="m")
    t2 = problem.state("theta2", initial=0.0, terminal=right, unit="rad")
    t1 = problem.state("theta1", initial=0.0, terminal=right, lower=-right, upper=right, unit="rad")
    t0 = problem.state("theta0", initial=0.0, terminal=right, lower=-right, upper=right, unit="rad")
    v0 = problem.state("v0", lower=-SPEED, upper=SPEED, guess=0.1, unit="m/s")
    d0 = problem.state("delta0", lower=-STEERING, upper=STEERING, guess=0.1, unit="rad")
    dv = problem.control("v0 rate", lower=-1.0, upper=1.0, guess=0.1)
    dd = problem.control("delta0 rate", lower=-STEERING_RATE, upper=STEERING_RATE, guess=0.1)
    horizon = problem.horizon(lower=1.0, upper=1000.0, guess=60.0)
    b01, b12 = t0 - t1, t1 - t2
    dt0 = v0 / L0 * ca.tan(d0)
    dt1 = (v0 * ca.sin(b01) - M0 * ca.cos(b01) * dt0) / L1
    v1 = v0 * ca.cos(b01) + M0 * ca.sin(b01) * dt0
    dt2 = (v1 * ca.sin(b12) - M1 * ca.cos(b12) * dt1) / L2
    v2 = v1 * ca.cos(b12) + M1 * ca.sin(b12) * dt1
    rates = {x2: v2 * ca.cos(t2), y2: v2 * ca.sin(t2), t0: dt0, t1: dt1, t2: dt2, v0: dv, d0: dd}
    for state, rate in rates.items():
        problem.dynamics(state, rate)
    problem.path("first hitch", b01, -right, right)
    problem.path("second hitch", b12, -right, right)
    problem.minimize(running=b01**2 + b12**2, terminal=horizon)
    return problem


ENTRY = Entry(
    "truck_trailer", (TOOLBOX,), build, {"CTDirect": 59.28}, method=MultipleShooting(100, control="held"),
    second=MultipleShooting(140, control="held"),
)  # fmt: skip
