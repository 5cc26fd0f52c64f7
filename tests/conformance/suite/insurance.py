"""Optimal insurance: reimbursement over the medical expense m, the variable of integration.

I' = (1 - 0.2 t v'(m) / U_R) h, m' = h, x' = I f(t), with v = m^2 / (1 + m^2), U_R = 10 exp(-10 R), the income R = 1 - P
+ I - m, the health H = 1.5 - 0.2 t (1 - v), utility U = 1 - exp(-10 R) + H, and the density f = 0.25 exp(-0.25 t) +
exp(-2.5) / 10; premium P = x(10). From (0, 0.001, 0), 0 <= h <= 25, R, H, U, P >= 0, greatest int U f dt over 10.
Bocop, example insurance; OptimalControlProblems.jl, insurance, with R, H, U and U_R as controls tied by equations.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

GAMMA, LAMBDA, HEALTH, WEALTH, AVERSION, DURATION = 0.2, 0.25, 1.5, 1.0, 10.0, 10.0


def build() -> Problem:
    problem = Problem("insurance")
    indemnity = problem.state("I", initial=0.0, lower=0.0, upper=1.5, guess=0.1)
    expense = problem.state("m", initial=0.001, lower=0.0, upper=1.5, guess=0.1)
    paid = problem.state("x", initial=0.0, lower=0.0, upper=1.5, guess=0.1)
    premium = problem.free_parameter("P", lower=0.0, upper=1.5, guess=0.1)
    h = problem.control("h", lower=0.0, upper=25.0, guess=0.1)
    problem.horizon(DURATION)
    t = problem.time
    density = LAMBDA * ca.exp(-LAMBDA * t) + ca.exp(-LAMBDA * DURATION) / DURATION
    value, slope = expense**2 / (1 + expense**2), 2 * expense / (1 + expense**2) ** 2
    income = WEALTH - premium + indemnity - expense
    health = HEALTH - GAMMA * t * (1 - value)
    marginal = AVERSION * ca.exp(-AVERSION * income)
    utility = 1 - ca.exp(-AVERSION * income) + health
    problem.dynamics(indemnity, (1 - GAMMA * t * slope / marginal) * h)
    problem.dynamics(expense, h)
    problem.dynamics(paid, indemnity * density)
    problem.path("income", income, lower=0.0)
    problem.path("health", health, lower=0.0)
    problem.path("utility", utility, lower=0.0)
    problem.path("marginal utility", marginal, lower=0.001)
    problem.end("premium", premium - paid, 0.0, 0.0)
    problem.minimize(running=-utility * density)
    return problem


ENTRY = Entry(
    "insurance", (TOOLBOX,), build, {"CTDirect": -2.059511}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
