"""Rayleigh's tunnel-diode oscillator, regulated, with a free control and with |u| <= 1.

x1' = x2, x2' = -x1 + (1.4 - 0.14 x2^2) x2 + 4 u from (-5, -5), end free, least int x1^2 + u^2 dt; u = -2 l2, cut off at
its bounds. Over 2.5 s with a free control; published: 29.3760796560. Over 4.5 s with a bounded one, which is saturated
at 1, then at -1, then free. The initial costates were found by shooting on l = 0 at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Run, Switch, fitted, legendre, radau, shooting, within
from .flow import Flow, flow


@dataclass(frozen=True)
class Oscillator:
    """The problem over a horizon, s, with |u| <= limit, and where its extremal begins."""

    name: str
    horizon: float
    limit: float
    costate_at_start: tuple[float, float]

    def build(self) -> Problem:
        problem = Problem(self.name)
        x1 = problem.state("x1", initial=-5.0)
        x2 = problem.state("x2", initial=-5.0)
        u = problem.control("u", lower=-self.limit, upper=self.limit)
        problem.horizon(self.horizon)
        problem.dynamics(x1, x2)
        problem.dynamics(x2, -x1 + (1.4 - 0.14 * x2**2) * x2 + 4 * u)
        problem.minimize(running=x1**2 + u**2)
        return problem

    def feedback(self, l2: Array) -> Array:
        return np.clip(-2 * l2, -self.limit, self.limit)

    def extremal(self) -> Flow:
        def canonical(t: float, y: Array) -> Sequence[float]:
            x1, x2, l1, l2 = y
            push = -x1 + (1.4 - 0.14 * x2**2) * x2 + 4 * float(self.feedback(l2))
            return x2, push, -2 * x1 + l2, -l1 - l2 * (1.4 - 0.42 * x2**2)

        return flow(canonical, (-5.0, -5.0, *self.costate_at_start), (0.0, self.horizon))

    def case(self, cost: float, runs: tuple[Run, ...], switches: tuple[Switch, ...] = ()) -> Case:
        extremal = self.extremal()

        def optimum(t: Array) -> Extremal:
            x1, x2, l1, l2 = extremal(t)
            return Extremal({"x1": x1, "x2": x2}, {"u": self.feedback(l2)}, {"x1": l1, "x2": l2})

        return Case(self.name, self.build, cost, runs, self.horizon, optimum, switches)


FREE = Oscillator("Rayleigh", 2.5, inf, (-8.737062564584093, -2.581398186091974))
CASE = FREE.case(
    29.3760796559429,
    (
        *within(radau(40, degree=7), cost=(1e-10, 1e-10), state=3e-7, control=5e-6, costate=2e-6),
        *within(legendre(60, degree=4), cost=(2e-9, 2e-9), state=3e-5, control=1e-3, costate=2e-5),
        *within(shooting(100, "linear", steps=4), cost=(1e-6, 5e-5), state=2e-4, control=0.1, costate=3e-5),
        *within(shooting(100, "held", steps=4), cost=(1e-6, 2e-2), state=5e-3, control=0.5, costate=5e-3),
    ),
)

BOUNDED = Oscillator("Rayleigh, bounded", 4.5, 1.0, (-12.676339492844, -4.572998809438316))
CORNERS = (1.036328144300, 1.740465855601, 2.836307807717)
MESH = fitted([time / BOUNDED.horizon for time in CORNERS], 20)
CASE_BOUNDED = BOUNDED.case(
    44.6178794900391,
    (
        # corners of the control on nodes
        *within(radau(MESH), cost=(1e-4, 1e-4), state=1e-3, control=1e-3, costate=5e-3, time=5e-6),
        *within(legendre(MESH), cost=(1e-5, 1e-5), state=5e-4, control=2e-4, costate=2e-4, time=5e-6),
        *within(shooting(MESH, "linear", 4), cost=(1e-5, 1e-5), state=1e-3, control=1e-2, costate=1e-3, time=3e-4),
        *within(shooting(100, "held", 4), cost=(1e-6, 5e-3), state=1e-2, control=0.2, costate=5e-3, time=2e-3),
    ),
    (
        Switch(CORNERS[0], lambda x, lam: 2 * lam["x2"] + BOUNDED.limit),
        *(Switch(corner, lambda x, lam: 2 * lam["x2"] - BOUNDED.limit) for corner in CORNERS[1:]),
    ),
)
