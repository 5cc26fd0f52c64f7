"""A linear regulator that passes a given point on its way.

x' = u, x(0) = 1, x(0.75) = 0.9, x(1) = 0.75, least int x^2 + u^2 dt. Each leg is an extremal x'' = x between its ends,
whose cost is ((x0^2 + x1^2) cosh T - 2 x0 x1) / sinh T. MISER manual; PSOPT, example interior_point.
"""

from __future__ import annotations

from math import cosh, sinh

from ocp import Phases, Problem

from .entry import PSOPT, Entry

LEGS = {"first": (0.75, 1.0, 0.9), "last": (0.25, 0.9, 0.75)}
"""Duration, s, and value at both ends of each leg."""


def build() -> Problem:
    legs = {}
    for name, (duration, start, end) in LEGS.items():
        leg = legs[name] = Problem(name)
        x = leg.state("x", initial=start if name == "first" else None, terminal=end, lower=-1.0, upper=1.0)
        u = leg.control("u", lower=-1.0, upper=1.0)
        leg.horizon(duration)
        leg.dynamics(x, u)
        leg.minimize(running=x**2 + u**2)
    phases = Phases("interior point", legs)
    phases.join("first", "last")
    return phases


def optimum() -> float:
    """Sum over both legs."""
    return sum(((a**2 + b**2) * cosh(t) - 2 * a * b) / sinh(t) for t, a, b in LEGS.values())


ENTRY = Entry("interior_point", (PSOPT,), build, {PSOPT: 0.9205314}, exact=optimum())
