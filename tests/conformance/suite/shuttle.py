"""Re-entry of a space shuttle: greatest cross range.

Altitude h, longitude phi, latitude theta, speed v, flight path gamma and azimuth psi over a spherical Earth with an
exponential atmosphere; lift and drag are polynomials of the angle of attack, and the bank angle tilts the lift. From
(260 000 ft, 25 600 ft/s, -1 deg, 90 deg) to (80 000 ft, 2500 ft/s, -5 deg), greatest latitude, degrees, free time. No
limit of heating. Betts, 2010, section 6.1; PSOPT, example shuttle_reentry.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, TOOLBOX, Entry

EARTH, MU, MASS, SURFACE = 20902900.0, 0.14076539e17, 203000.0 / 32.174, 2690.0
RHO, SCALE_HEIGHT = 0.002378, 23800.0
LIFT, DRAG = (-0.20704, 0.029244), (0.07854, -6.1592e-3, 6.21408e-4)
"""Polynomials of the angle of attack in degrees."""


def build() -> Problem:
    deg = np.pi / 180
    problem = Problem("shuttle re-entry")
    h = problem.state("h", initial=260000.0, terminal=80000.0, lower=0.0, upper=300000.0, unit="ft")
    phi = problem.state("phi", initial=-0.5 * 75.3153 * deg, lower=-45 * deg, upper=45 * deg, guess=0.0, unit="rad")
    theta = problem.state("theta", initial=0.0, lower=-89 * deg, upper=89 * deg, guess=lambda t: 0.3 * t / 1000)
    v = problem.state("v", initial=25600.0, terminal=2500.0, lower=1000.0, upper=40000.0, unit="ft/s")
    gamma = problem.state("gamma", initial=-1 * deg, terminal=-5 * deg, lower=-89 * deg, upper=89 * deg)
    psi = problem.state("psi", initial=90 * deg, lower=-180 * deg, upper=180 * deg, guess=lambda t: 1.57 - t / 1000)
    alpha = problem.control("alpha", lower=-89 * deg, upper=89 * deg, guess=0.0, unit="rad")
    beta = problem.control("beta", lower=-90 * deg, upper=1 * deg, guess=-1 * deg, unit="rad")
    problem.horizon(lower=100.0, upper=4000.0, guess=1000.0)
    radius, attack = EARTH + h, alpha / deg
    gravity = MU / radius**2
    pressure = RHO * ca.exp(-h / SCALE_HEIGHT) * v**2 / 2 * SURFACE / MASS
    lift = pressure * (LIFT[0] + LIFT[1] * attack)
    drag = pressure * (DRAG[0] + DRAG[1] * attack + DRAG[2] * attack**2)
    s, c = ca.sin(gamma), ca.cos(gamma)
    problem.dynamics(h, v * s)
    problem.dynamics(phi, v * c * ca.sin(psi) / (radius * ca.cos(theta)))
    problem.dynamics(theta, v * c * ca.cos(psi) / radius)
    problem.dynamics(v, -drag - gravity * s)
    problem.dynamics(gamma, lift * ca.cos(beta) / v + c * (v / radius - gravity / v))
    problem.dynamics(psi, lift * ca.sin(beta) / (v * c) + v * c * ca.sin(psi) * ca.tan(theta) / radius)
    problem.minimize(terminal=-theta / deg)
    return problem


ENTRY = Entry(
    "shuttle_reentry", (PSOPT, TOOLBOX), build, {PSOPT: -34.1412}, method=Collocation(40, 4),
    second=Collocation(60, 3, "legendre"),
)  # fmt: skip
