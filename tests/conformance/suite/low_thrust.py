"""Low-thrust transfer from a low inclined orbit to an eccentric one, with the most weight left.

Modified equinoctial elements (p, f, g, h, k, L) with zonal harmonics (`tests.ocp.problem.flights`), thrust 4.446618e-3
(1 + tau / 100) lb with a constant -50 <= tau <= 0 that is sought, its direction u in the frame of radius, normal and
momentum with 0.999 <= |u|^2 <= 1.001, w' = -T (1 + tau / 100) / Isp. Betts, 2010, section 6.3; PSOPT, example
low_thrust. Lengths in radii of the Earth. PSOPT's guess is a file; here a
flight over the same time with thrust along the velocity.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem
from tests.ocp.problem.flights import GRAVITY, PARKING, RADIUS, TIME, equinoctial_rates

from .entry import PSOPT, Entry, samples

THRUST, IMPULSE = 4.446618e-3, 450.0  # lb, s
TARGET = 40007346.015232 / RADIUS
DURATION, TAU = 86810.0, -25.0  # s, of the guess, and its tau


def flight() -> Callable[[float], Any]:
    """Elements and weight over the time of a flight with thrust along the velocity, (7,)."""
    y = ca.SX.sym("y", 7)
    force = THRUST * (1 + 0.01 * TAU)

    def ahead(up: Any, velocity: Any, normal: Any) -> Any:
        return force * GRAVITY / y[6] / (RADIUS / TIME**2) * velocity / ca.norm_2(velocity)

    rate = ca.vertcat(equinoctial_rates(y[:6], ahead) / TIME, -force / IMPULSE)
    times = np.linspace(0.0, DURATION, 401)
    run = ca.integrator("flight", "cvodes", {"x": y, "ode": rate}, 0.0, times[1:].tolist())
    start = np.array([*PARKING, 1.0])
    return samples(times.tolist(), np.vstack([start, np.array(run(x0=start)["xf"]).T]).tolist())


def build() -> Problem:
    flown = flight()
    problem = Problem("low-thrust transfer")
    x = problem.state(
        "x", initial=PARKING, terminal=[TARGET, *[np.nan] * 5],
        lower=[10e6 / RADIUS, -0.2, -0.1, -1.0, -0.2, np.pi], upper=[60e6 / RADIUS, 0.2, 1.0, 1.0, 0.2, 20 * np.pi],
        guess=lambda t: flown(t)[:6],
    )  # fmt: skip
    w = problem.state("w", initial=1.0, lower=0.01, upper=2.0, guess=lambda t: flown(t)[6])
    tau = problem.free_parameter("tau", lower=-50.0, upper=0.0, guess=TAU)
    u = problem.control("u", 3, lower=-1.0, upper=1.0, guess=[0.0, 1.0, 0.0])
    problem.horizon(lower=50000.0, upper=100000.0, guess=DURATION)
    force = THRUST * (1 + 0.01 * tau)

    def thrust(up: Any, velocity: Any, normal: Any) -> Any:
        along = ca.cross(normal, up)
        return force * GRAVITY / w / (RADIUS / TIME**2) * (u[0] * up + u[1] * along + u[2] * normal)

    problem.dynamics(x, equinoctial_rates(x, thrust) / TIME)
    problem.dynamics(w, -force / IMPULSE)
    problem.path("direction", ca.sumsqr(u), 0.999, 1.001)
    _, f, g, h, k, _ = ca.vertsplit(x)
    problem.end("eccentricity", f**2 + g**2, 0.73550320568829**2, 0.73550320568829**2)
    problem.end("inclination", h**2 + k**2, 0.61761258786099**2, 0.61761258786099**2)
    problem.end("perigee", f * h + g * k, 0.0, 0.0)
    problem.end("southern", g * h - k * f, -10.0, 0.0)
    problem.minimize(terminal=-w)
    return problem


ENTRY = Entry(
    "low_thrust", (PSOPT,), build, {PSOPT: -0.220338}, method=Collocation(60, 4), second=Collocation(90, 3, "legendre")
)
