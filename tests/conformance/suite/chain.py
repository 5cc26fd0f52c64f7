"""Hanging chain: the shape of least potential energy of a chain of length 4.

x' = u, least int x sqrt(1 + u^2) dt with int sqrt(1 + u^2) dt = 4, from x(0) = 1 to x(1) = 3. The shape is a catenary,
x = c cosh((t - m) / c) - mu; its three constants follow from the two ends and the length. COPS 3, problem 3; PSOPT,
example chain.
"""

from __future__ import annotations

from math import cosh, sinh, sqrt

import casadi as ca
from scipy.optimize import brentq

from ocp import Problem

from .entry import COPS, PSOPT, TOOLBOX, Entry, line

START, END, LENGTH = 1.0, 3.0, 4.0


def build() -> Problem:
    problem = Problem("hanging chain")
    x = problem.state("x", initial=START, terminal=END, lower=-10.0, upper=10.0, guess=line(START, END))
    u = problem.control("u", lower=-20.0, upper=20.0, guess=2.0)
    problem.horizon(1.0)
    problem.dynamics(x, u)
    arc = ca.sqrt(1 + u**2)
    problem.integral("length", arc, LENGTH, LENGTH)
    problem.minimize(running=x * arc)
    return problem


def energy() -> float:
    """The integral of x ds along the catenary."""
    rise = END - START
    c = float(brentq(lambda c: 2 * c * sinh(0.5 / c) - sqrt(LENGTH**2 - rise**2), 0.05, 10.0, xtol=1e-15))
    # rise = 2 c sinh(1 / 2c) sinh((1/2 - m) / c)
    m = 0.5 - c * float(brentq(lambda z: 2 * c * sinh(0.5 / c) * sinh(z) - rise, -20.0, 20.0, xtol=1e-15))
    begin, end = -m / c, (1 - m) / c
    mu = c * cosh(begin) - START
    squares = c**2 / 2 * ((end - begin) + (sinh(2 * end) - sinh(2 * begin)) / 2)
    return squares - mu * LENGTH


ENTRY = Entry("chain", (PSOPT, COPS, TOOLBOX), build, {PSOPT: 5.06848, COPS: 5.0686}, exact=energy())
