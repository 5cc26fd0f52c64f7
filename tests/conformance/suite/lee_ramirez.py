"""Fed-batch bioreactor with induced foreign protein: nutrient and inducer feeds of most profit.

Volume x1, cell density x2, nutrient x3, foreign protein x4, inducer x5, and two factors of the growth rate, x6 and x7,
10 h, greatest x1 x4 at the end. Lee & Ramirez, AIChE Journal 40, 1994; PROPT manual; PSOPT, example bioreactor, which
adds (0.1 / nodes) (u1'^2 + u2'^2) to the cost; here the feeds are free, so that a nearly singular feed may ring. The
lower bounds are physical: those of PSOPT, -10, contain poles of the rates.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

START = [1.0, 0.1, 40.0, 0.0, 0.0, 1.0, 0.0]


def build() -> Problem:
    problem = Problem("Lee-Ramirez bioreactor")
    x = problem.state(
        "x",
        initial=START,
        lower=[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        upper=[10.0, 10.0, 50.0, 10.0, 10.0, 10.0, 10.0],
        guess=START,
    )
    u = problem.control("u", 2, lower=0.0, upper=1.0, guess=lambda t: [t / 30, 0.0])
    problem.horizon(10.0)
    volume, cells, nutrient, protein, inducer, shock, recovery = ca.vertsplit(x)
    dilution = (u[0] + u[1]) / volume
    uptake = nutrient / (14.35 + nutrient * (1 + nutrient / 111.5))
    growth = uptake * (shock + 0.22 * recovery / (0.22 + inducer))
    production = 0.233 * uptake * (0.0005 + inducer) / (0.022 + inducer)
    rate = 0.09 * inducer / (0.034 + inducer)
    problem.dynamics(
        x,
        ca.vertcat(
            u[0] + u[1],
            growth * cells - dilution * cells,
            100 * u[0] / volume - dilution * nutrient - growth * cells / 0.51,
            production * cells - dilution * protein,
            4 * u[1] / volume - dilution * inducer,
            -rate * shock,
            rate * (1 - recovery),
        ),
    )
    problem.minimize(terminal=-volume * protein)
    return problem


ENTRY = Entry(
    "bioreactor", (PSOPT,), build, {PSOPT: -6.163913}, method=Collocation(50, 3, control="held"),
    second=Collocation(70, 2, control="held"),
)  # fmt: skip
