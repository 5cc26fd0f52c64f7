"""An equilibrium constraint: the sign of a state as the solution of a linear program, its complementarity penalised.

y' = 2 - s from -1, 2 s, -1 <= s <= 1, y = q - p, p, q >= 0, least (y(2) - 5/3)^2 + int y^2 + 1000 (p (s + 1) + q (1 -
s)) dt. With exact complementarity, s = -1 while y < 0 and 1 afterwards, so that y = 3 t - 1 up to t = 1/3 and t - 1/3
after it: the cost is 1/9 + 125/81. The penalty is finite, and the optimum lies a little below. Betts, 2010; PSOPT,
example mpec.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

PENALTY = 1e3


def build() -> Problem:
    problem = Problem("equilibrium constraint")
    y = problem.state("y", initial=-1.0, lower=-10.0, upper=10.0, guess=-1.0)
    s = problem.control("s", lower=-1.0, upper=1.0, guess=0.0)
    p = problem.control("p", lower=0.0, upper=10.0, guess=0.0)
    q = problem.control("q", lower=0.0, upper=10.0, guess=0.0)
    problem.horizon(2.0)
    problem.dynamics(y, 2 - s)
    problem.path("equilibrium", -y - p + q, 0.0, 0.0)
    problem.minimize(running=y**2 + PENALTY * (p * (s + 1) + q * (1 - s)), terminal=(y - 5 / 3) ** 2)
    return problem


ENTRY = Entry(
    "mpec", (PSOPT,), build, {PSOPT: 1.656309}, method=Collocation(30, 4, control="held"),
    second=Collocation(42, 3, "legendre", control="held"),
)  # fmt: skip
