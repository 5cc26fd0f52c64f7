"""Hang glider through a thermal updraft: greatest distance while descending 100 m.

Lift and drag act along the velocity relative to the air, which rises by ua = 2.5 (1 - X) exp(-X) m/s with X = (x / 100
- 2.5)^2; 0 <= cL <= 1.4. Bulirsch, Nerz, Pesch & von Stryk, 1993; COPS 3, problem 11; PSOPT, example glider. COPS takes
the drag of the speed relative to the air, PSOPT that of the speed itself; both are stated, with their own ends.
"""

from __future__ import annotations

from functools import partial

import casadi as ca

from ocp import Collocation, Problem

from .entry import COPS, PSOPT, TOOLBOX, Entry, line

MASS, UPDRAFT, WIDTH, C0, C1, SURFACE, DENSITY = 100.0, 2.5, 100.0, 0.034, 0.069662, 14.0, 1.13
ENDS = {PSOPT: (13.2275675, -1.28750052, 9.80665), COPS: (13.23, -1.288, 9.81)}
"""Velocity across and up at both ends, m/s, and gravity, m/s^2."""


def build(suite: str) -> Problem:
    across, up, gravity = ENDS[suite]
    problem = Problem(f"hang glider of {suite}")
    x = problem.state("x", initial=0.0, lower=0.0, upper=1500.0, guess=line(0.0, 1250.0, 105.0), unit="m")
    y = problem.state("y", initial=1000.0, terminal=900.0, lower=0.0, upper=1100.0, unit="m")
    vx = problem.state("vx", initial=across, terminal=across, lower=0.0, upper=15.0, unit="m/s")
    vy = problem.state("vy", initial=up, terminal=up, lower=-4.0, upper=4.0, unit="m/s")
    lift_coefficient = problem.control("cL", lower=0.0, upper=1.4, guess=1.0)
    problem.horizon(lower=0.1, upper=200.0, guess=105.0)
    ring = (x / WIDTH - 2.5) ** 2
    relative = vy - UPDRAFT * (1 - ring) * ca.exp(-ring)
    speed = ca.sqrt(vx**2 + (vy if suite == PSOPT else relative) ** 2)
    pressure = DENSITY * SURFACE * speed / 2  # by the speed, which divides the components below
    lift, drag = lift_coefficient * pressure, (C0 + C1 * lift_coefficient**2) * pressure
    problem.dynamics(x, vx)
    problem.dynamics(y, vy)
    problem.dynamics(vx, -(lift * relative + drag * vx) / MASS)
    problem.dynamics(vy, (lift * vx - drag * relative) / MASS - gravity)
    problem.minimize(terminal=-x)
    return problem


FIRST, SECOND = Collocation(60, 4), Collocation(90, 3, "legendre")
ENTRIES = (
    Entry("glider", (PSOPT,), partial(build, PSOPT), {PSOPT: "-1250.190"}, None, FIRST, SECOND),
    Entry("glider_cops", (COPS, TOOLBOX), partial(build, COPS), {"CTDirect": "-1.248e3"}, None, FIRST, SECOND),
)
