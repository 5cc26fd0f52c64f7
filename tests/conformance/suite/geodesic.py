"""The shortest flight from New York to London over a spheroid.

r' = V (sin theta cos phi, sin theta sin phi, cos theta), (x^2 + y^2) / a^2 + z^2 / b^2 = 1, a = 6384 km, b = 6353 km, V
= 900 km/h, least length V T at a free time T. PSOPT, example geodesic, whose author gives 5549.6819 km for the
geodesic. Latitudes are read as parametric ones, as there.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Problem

from .entry import PSOPT, Entry

A, B, SPEED = 6384.0, 6353.0, 900.0  # km, km/h
ENDS = np.deg2rad([[90 - 40.6413, 360 - 73.7781], [90 - 51.4700, 360 - 0.4543]])
"""Polar angle and azimuth of New York and of London."""


def place(angles: np.ndarray) -> np.ndarray:
    """Point of the spheroid at a parametric polar angle and an azimuth."""
    polar, azimuth = angles
    return np.array([A * np.sin(polar) * np.cos(azimuth), A * np.sin(polar) * np.sin(azimuth), B * np.cos(polar)])


def build() -> Problem:
    fraction = np.linspace(0.0, 1.0, 201)
    track = np.array([place(ENDS[0] + s * (ENDS[1] - ENDS[0])) for s in fraction])
    ahead = np.gradient(track, axis=0)
    polar = np.arccos(ahead[:, 2] / np.linalg.norm(ahead, axis=1))
    azimuth = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]) % (2 * np.pi))
    duration = float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum() / SPEED)

    def along(values: np.ndarray) -> object:
        table = np.atleast_2d(values.T)
        return lambda t: np.array([np.interp(t / duration, fraction, column) for column in table])

    problem = Problem("geodesic")
    r = problem.state("r", initial=place(ENDS[0]), terminal=place(ENDS[1]), guess=along(track), unit="km")
    theta = problem.control("theta", lower=0.0, upper=np.pi, guess=along(polar))
    phi = problem.control("phi", lower=0.0, upper=2 * np.pi, guess=along(azimuth))
    horizon = problem.horizon(lower=3.0, upper=10.0, guess=duration)
    problem.dynamics(r, SPEED * ca.vertcat(ca.sin(theta) * ca.cos(phi), ca.sin(theta) * ca.sin(phi), ca.cos(theta)))
    problem.path("spheroid", (r[0] ** 2 + r[1] ** 2) / A**2 + r[2] ** 2 / B**2 - 1, 0.0, 0.0)
    problem.minimize(terminal=SPEED * horizon)
    return problem


ENTRY = Entry("geodesic", (PSOPT,), build, {PSOPT: 5549.682})
