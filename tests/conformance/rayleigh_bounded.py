"""Rayleigh's oscillator, |u| <= 1.

As `rayleigh`, over 4.5 s, with u = clip(-2 l2, -1, 1): saturated at 1, then at -1, then free. The initial costate was
found by shooting on l(4.5) = 0.
"""

from __future__ import annotations

from functools import cache

from ocp import Problem

from .case import Array, Case, Extremal, Switch, fitted, legendre, radau, shooting, within
from .flow import Flow
from .rayleigh import extremal, feedback, statement

HORIZON = 4.5
LIMIT = 1.0
COSTATE_AT_START = (-12.676339492844, -4.572998809438316)
CORNERS = (1.036328144300, 1.740465855601, 2.836307807717)
MESH = fitted([time / HORIZON for time in CORNERS], 20)


def build() -> Problem:
    return statement("Rayleigh, bounded", HORIZON, LIMIT)


@cache
def saturated_extremal() -> Flow:
    return extremal(COSTATE_AT_START, HORIZON, LIMIT)


def optimum(t: Array) -> Extremal:
    x1, x2, l1, l2 = saturated_extremal()(t)
    return Extremal(
        state={"x1": x1, "x2": x2},
        control={"u": feedback(l2, LIMIT)},
        costate={"x1": l1, "x2": l2},
    )


CASE = Case(
    name="Rayleigh, bounded",
    build=build,
    cost=44.6178794900391,
    horizon=HORIZON,
    optimum=optimum,
    switches=(
        Switch(CORNERS[0], lambda x, lam: 2 * lam["x2"] + LIMIT),
        Switch(CORNERS[1], lambda x, lam: 2 * lam["x2"] - LIMIT),
        Switch(CORNERS[2], lambda x, lam: 2 * lam["x2"] - LIMIT),
    ),
    runs=(
        # corners of the control on nodes
        *within(radau(MESH), cost=(1e-4, 1e-4), state=1e-3, control=1e-3, costate=5e-3, time=5e-6),
        *within(legendre(MESH), cost=(1e-5, 1e-5), state=5e-4, control=2e-4, costate=2e-4, time=5e-6),
        *within(
            shooting(MESH, "linear", steps=4),
            cost=(1e-5, 1e-5),
            state=1e-3,
            control=1e-2,
            costate=1e-3,
            time=3e-4,
        ),
        *within(
            shooting(100, "held", steps=4),
            cost=(1e-6, 5e-3),
            state=1e-2,
            control=0.2,
            costate=5e-3,
            time=2e-3,
        ),
    ),
)
