"""Schwartz's problem: around an ellipse in the plane of states, then to rest.

x1' = x2, x2' = u - 0.1 (1 + 2 x1^2) x2, from (1, 1); for 1 s |u| <= 1, x2 >= -0.8 and 9 (x1 - 1)^2 + ((x2 - 0.4) /
0.3)^2 >= 1; then for 1.9 s |u| <= 50; least 5 |x|^2 at the end, which can be zero. PROPT manual; PSOPT, example
twophase_schwartz.
"""

from __future__ import annotations

from ocp import Collocation, Phases, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    legs = {}
    for name, duration, limit, floor in (("around", 1.0, 1.0, -0.8), ("to rest", 1.9, 50.0, -10.0)):
        leg = legs[name] = Problem(name)
        first = name == "around"
        x1 = leg.state("x1", initial=1.0 if first else None, lower=-20.0, upper=10.0, guess=1.0)
        x2 = leg.state("x2", initial=1.0 if first else None, lower=floor, upper=10.0, guess=1.0)
        u = leg.control("u", lower=-limit, upper=limit, guess=0.0)
        leg.horizon(duration)
        leg.dynamics(x1, x2)
        leg.dynamics(x2, u - 0.1 * (1 + 2 * x1**2) * x2)
        if first:
            leg.path("ellipse", 9 * (x1 - 1) ** 2 + ((x2 - 0.4) / 0.3) ** 2, lower=1.0)
        else:
            leg.minimize(terminal=5 * (x1**2 + x2**2))
    phases = Phases("Schwartz", legs)
    phases.join("around", "to rest")
    return phases


ENTRY = Entry("twophase_schwartz", (PSOPT,), build, {PSOPT: 3.138721e-16}, 0.0, method=Collocation(30, 3))
