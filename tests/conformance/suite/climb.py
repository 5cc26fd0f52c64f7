"""Least time to climb for a supersonic aircraft.

h' = v sin gamma, v' = (T cos a - D) / m - mu sin gamma / r^2, gamma' = (T sin a + L) / (m v) + cos gamma (v / r - mu /
(v r^2)), w' = -T / 1600 s, m = w / g0, r = Re + h. Thrust is a table of Mach number and altitude, lift slope, zero-lift
drag and induced drag are tables of the Mach number. From (0, 424.26 ft/s, 0, 42 000 lb) to (65 600 ft, 968.148 ft/s,
0), |a| <= 20 deg. Bryson, Desai & Hoffman, 1969; Betts, 2010; PSOPT, example climb. Its atmosphere applies the lowest
layer of 1976 at all altitudes, as is done here, and its tables are interpolated by cubic splines, as here, but with
other ends: the time depends on both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

GRAVITY, SURFACE, EARTH, IMPULSE, MU = 32.174, 530.0, 20902900.0, 1600.0, 0.14076539e17
MACH = [0.0, 0.4, 0.8, 0.9, 1.0, 1.2, 1.4, 1.6, 1.8]
LIFT_SLOPE = [3.44, 3.44, 3.44, 3.58, 4.44, 3.44, 3.01, 2.86, 2.44]
DRAG = [0.013, 0.013, 0.013, 0.014, 0.031, 0.041, 0.039, 0.036, 0.035]
INDUCED = [0.54, 0.54, 0.54, 0.75, 0.79, 0.78, 0.89, 0.93, 0.93]
THRUST_MACH = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8]
ALTITUDES = [0.0, 5e3, 1e4, 1.5e4, 2e4, 2.5e4, 3e4, 4e4, 5e4, 7e4]
THRUST = np.array([
    [24200, 24000, 20300, 17300, 14500, 12200, 10200, 5700, 3400, 100],
    [28000, 24600, 21100, 18100, 15200, 12800, 10700, 6500, 3900, 200],
    [28300, 25200, 21900, 18700, 15900, 13400, 11200, 7300, 4400, 400],
    [30800, 27200, 23800, 20500, 17300, 14700, 12300, 8100, 4900, 800],
    [34500, 30300, 26600, 23200, 19800, 16800, 14100, 9400, 5600, 1100],
    [37900, 34300, 30400, 26800, 23300, 19800, 16800, 11200, 6800, 1400],
    [36100, 38000, 34900, 31300, 27300, 23600, 20100, 13400, 8300, 1700],
    [34300, 36600, 38500, 36100, 31600, 28100, 24200, 16200, 10000, 2200],
    [32500, 35200, 42100, 38700, 35700, 32000, 28100, 19300, 11900, 2900],
    [30700, 33800, 45700, 41300, 39800, 34600, 31100, 21700, 13300, 3100],
], dtype=float)  # fmt: skip
"""lb, by Mach number and altitude, ft."""
FOOT = 0.3048  # m


def widened(grid: Sequence[float], values: np.ndarray, axis: int = 0) -> tuple[list[float], np.ndarray]:
    """A table continued straight by one interval on both sides: a spline of casadi is zero outside its grid."""
    moved = np.moveaxis(values, axis, 0)
    first, last = 2 * moved[0] - moved[1], 2 * moved[-1] - moved[-2]
    ends = [2 * grid[0] - grid[1], *grid, 2 * grid[-1] - grid[-2]]
    return ends, np.moveaxis(np.concatenate([first[None], moved, last[None]]), 0, axis)


def spline(grid: Sequence[float], values: Sequence[float], at: Any) -> Any:
    """Cubic spline through a table of one variable."""
    ends, table = widened(grid, np.array(values))
    return ca.interpolant("table", "bspline", [ends], table)(at)


def build() -> Problem:
    deg = np.pi / 180
    problem = Problem("climb", ca.MX)
    h = problem.state(
        "h", initial=0.0, terminal=65600.0, lower=0.0, upper=69000.0, unit="ft", guess=line(0, 65600, 500)
    )
    v = problem.state("v", initial=424.26, terminal=968.148, lower=1.0, upper=2000.0, unit="ft/s")
    gamma = problem.state("gamma", initial=0.0, terminal=0.0, lower=-89 * deg, upper=89 * deg, unit="rad")
    w = problem.state("w", initial=42000.0, lower=1.0, upper=45000.0, guess=line(42000, 33600, 500), unit="lb")
    alpha = problem.control("alpha", lower=-20 * deg, upper=20 * deg, guess=0.0, unit="rad")
    horizon = problem.horizon(lower=200.0, upper=500.0, guess=500.0)
    kilometres = h * FOOT / 1000
    temperature = 288.15 - 6.5 * kilometres * 6369 / (kilometres + 6369)  # K
    density = 1.22521 * (temperature / 288.15) ** (34.163195 / 6.5 - 1) * 0.062427960841 / 32.174049  # slug/ft^3
    mach = v * FOOT / (20.0468 * ca.sqrt(temperature))
    machs, table = widened(THRUST_MACH, THRUST)
    altitudes, table = widened(ALTITUDES, table, axis=1)
    thrust = ca.interpolant("thrust", "bspline", [machs, altitudes], table.ravel(order="F"))(ca.vertcat(mach, h))
    slope = spline(MACH, LIFT_SLOPE, mach)
    pressure = density * v**2 * SURFACE / 2
    lift = slope * alpha * pressure
    drag = (spline(MACH, DRAG, mach) + spline(MACH, INDUCED, mach) * slope * alpha**2) * pressure
    mass, radius = w / GRAVITY, EARTH + h
    problem.dynamics(h, v * ca.sin(gamma))
    problem.dynamics(v, (thrust * ca.cos(alpha) - drag) / mass - MU / radius**2 * ca.sin(gamma))
    problem.dynamics(
        gamma, (thrust * ca.sin(alpha) + lift) / (mass * v) + ca.cos(gamma) * (v / radius - MU / (v * radius**2))
    )
    problem.dynamics(w, -thrust / IMPULSE)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "climb", (PSOPT,), build, {PSOPT: 321.1089}, method=Collocation(40, 3), second=Collocation(57, 3, "legendre"),
    note="the time depends on the splines through the tables, which differ",
)  # fmt: skip
