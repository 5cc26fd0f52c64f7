"""Lotka-Volterra fishing: prey and predators steered to their equilibrium by a fleet.

x1' = x1 - x1 x2 - 0.4 x1 w1, x2' = -x2 + x1 x2 - 0.2 x2 w2, from (0.5, 0.7), 12 s, least int (x1 - 1)^2 + (x2 - 1)^2
dt. The fleet is in or out; its relaxation 0 <= w <= 1 is the infimum over all sequences of switches, which none
attains: the optimal control has a singular arc. One fleet, w1 = w2, or two. Sager, 2005; PSOPT, examples lotka, lotka2.
"""

from __future__ import annotations

from functools import partial

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

CATCHES = (0.4, 0.2)


def build(fleets: int) -> Problem:
    problem = Problem(f"fishing by {fleets} fleet" + "s" * (fleets - 1))
    prey = problem.state("x1", initial=0.5, lower=0.0, upper=2.0, guess=0.5)
    predators = problem.state("x2", initial=0.7, lower=0.0, upper=2.0, guess=0.7)
    w = problem.control("w", fleets, lower=0.0, upper=1.0, guess=0.5)
    problem.horizon(12.0)
    problem.dynamics(prey, prey - prey * predators - CATCHES[0] * prey * w[0])
    problem.dynamics(predators, -predators + prey * predators - CATCHES[1] * predators * w[fleets - 1])
    problem.minimize(running=(prey - 1) ** 2 + (predators - 1) ** 2)
    return problem


FIRST, SECOND = Collocation(80, 3), Collocation(113, 3, "legendre")
NOTE = "relaxed: the infimum over fleets that are in or out"
ENTRIES = (
    Entry("lotka", (PSOPT,), partial(build, 1), {PSOPT: 1.344093, "Sager": 1.34408}, None, FIRST, SECOND, NOTE),
    Entry("lotka2", (PSOPT,), partial(build, 2), {PSOPT: 1.088024}, None, FIRST, SECOND, NOTE),
)
