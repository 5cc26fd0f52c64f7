"""A delay in the state, by the method of steps.

x1' = x2, x2' = -10 x1 - 5 x2 - 2 x1(t - d) - x2(t - d) + u with d = 0.25 s, x = (1, 1) up to time zero, 5 s, least int
(10 x1^2 + x2^2 + u^2) / 2 dt. Cut into 20 pieces of length d, the delayed state of each is the state of the piece
before it at the same time within the piece: a problem over 0.25 s with 40 states, whose pieces join at their ends.
Luus, 2002; PSOPT, example delay1.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

DELAY, PIECES = 0.25, 20


def build() -> Problem:
    problem = Problem("delay")
    start = [1.0] + [float("nan")] * (PIECES - 1)
    x1 = problem.state("x1", PIECES, initial=start, guess=1.0)
    x2 = problem.state("x2", PIECES, initial=start, guess=1.0)
    u = problem.control("u", PIECES, lower=-100.0, upper=100.0, guess=0.0)
    problem.horizon(DELAY)
    before1, before2 = (ca.vertcat(1, x[: PIECES - 1]) for x in (x1, x2))
    problem.dynamics(x1, x2)
    problem.dynamics(x2, -10 * x1 - 5 * x2 - 2 * before1 - before2 + u)
    for name, x in (("x1", x1), ("x2", x2)):
        problem.end(f"joins of {name}", problem.at_start(x)[1:] - x[: PIECES - 1], 0.0, 0.0)
    problem.minimize(running=(10 * ca.sumsqr(x1) + ca.sumsqr(x2) + ca.sumsqr(u)) / 2)
    return problem


ENTRY = Entry(
    "delay1", (PSOPT,), build, {PSOPT: 2.525738}, method=Collocation(5, 4), second=Collocation(7, 3, "legendre")
)
