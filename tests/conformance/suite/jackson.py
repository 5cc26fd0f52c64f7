"""Two reactions in series with a mixture of two catalysts: greatest yield.

a' = -u (a - 10 b), b' = u (a - 10 b) - (1 - u) b, c' = (1 - u) b, 0 <= u <= 1, from (1, 0, 0), 4 s, greatest c. As
a + b + c = 1, it is `tests.conformance.catalyst_mixing` over 4 s instead of 1 s: bang, singular, bang. Jackson, 1968;
Bocop; OptimalControlProblems.jl, jackson.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

K1, K2, K3 = 1.0, 10.0, 1.0


def build() -> Problem:
    problem = Problem("Jackson")
    a = problem.state("a", initial=1.0, lower=0.0, upper=1.1, guess=0.1)
    b = problem.state("b", initial=0.0, lower=0.0, upper=1.1, guess=0.1)
    c = problem.state("c", initial=0.0, lower=0.0, upper=1.1, guess=0.1)
    u = problem.control("u", lower=0.0, upper=1.0, guess=0.1)
    problem.horizon(4.0)
    problem.dynamics(a, -u * (K1 * a - K2 * b))
    problem.dynamics(b, u * (K1 * a - K2 * b) - (1 - u) * K3 * b)
    problem.dynamics(c, (1 - u) * K3 * b)
    problem.minimize(terminal=-c)
    return problem


ENTRY = Entry(
    "jackson", (TOOLBOX,), build, {"CTDirect": -0.192011}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
