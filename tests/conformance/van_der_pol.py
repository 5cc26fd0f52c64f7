"""Van der Pol oscillator, regulated.

x1' = x2, x2' = (1 - x1^2) x2 - x1 + u from (1, 0), 2 s, end free, least int (x1^2 + x2^2 + u^2) / 2 dt. The control
is u = -l2. The initial costate was found by shooting on l(2) = 0; published costs near 1.0479 are coarse-grid values.
"""

from __future__ import annotations

from collections.abc import Sequence

from ocp import Problem

from .case import Array, Case, Extremal, legendre, radau, shooting, within
from .flow import flow

HORIZON = 2.0
COSTATE_AT_START = (1.7171769411736348, 0.0112610850947908)


def build() -> Problem:
    problem = Problem("van der Pol")
    x1 = problem.state("x1", initial=1.0)
    x2 = problem.state("x2", initial=0.0)
    u = problem.control("u")
    problem.horizon(HORIZON)
    problem.dynamics(x1, x2)
    problem.dynamics(x2, (1 - x1**2) * x2 - x1 + u)
    problem.minimize(running=(x1**2 + x2**2 + u**2) / 2)
    return problem


def canonical(t: float, y: Array) -> Sequence[float]:
    x1, x2, l1, l2 = y
    return x2, (1 - x1**2) * x2 - x1 - l2, -x1 + l2 * (2 * x1 * x2 + 1), -x2 - l1 - l2 * (1 - x1**2)


EXTREMAL = flow(canonical, (1.0, 0.0, *COSTATE_AT_START), (0.0, HORIZON))


def optimum(t: Array) -> Extremal:
    x1, x2, l1, l2 = EXTREMAL(t)
    return Extremal(state={"x1": x1, "x2": x2}, control={"u": -l2}, costate={"x1": l1, "x2": l2})


RUNS = (
    *within(radau(20, degree=7), cost=(1e-11, 1e-11), state=1e-9, control=1e-9, costate=1e-9),
    *within(legendre(30, degree=4), cost=(1e-11, 1e-11), state=1e-8, control=1e-7, costate=1e-8),
    *within(shooting(50, "linear"), cost=(1e-9, 2e-7), state=1e-6, control=1e-3, costate=1e-6),
    *within(shooting(50, "linear", integrator="cvodes"), cost=(1e-9, 3e-8), state=1e-7, control=1e-3, costate=4e-8),
    *within(shooting(50, "held"), cost=(1e-8, 3e-4), state=3e-4, control=0.05, costate=3e-4),
)
CASE = Case("van der Pol", build, 1.0478069082203, RUNS, horizon=HORIZON, optimum=optimum)
