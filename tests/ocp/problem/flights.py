"""Flights in several phases whose optima are published: an orbit raised by two burns, the launch of a Delta III.

Statements: Betts, Practical Methods for Optimal Control, 2010, sections 6.3 and 6.15, as the examples "twoburn" and
"launch" of PSOPT (github.com/PSOPT/psopt) restate them; the numbers are theirs, the formulas written anew.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ocp import Phases, Problem

# ---- an orbit raised by two burns: feet, pounds, seconds ---------------------------------------------------------

EARTH, RADIUS, GRAVITY = 1.407645794e16, 20925662.73, 32.174  # ft^3/s^2, ft, ft/s^2
ZONAL = {2: 1082.639e-6, 3: -2.565e-6, 4: -1.608e-6}
THRUST, IMPULSE = 1.2, 300.0  # lb, s
TIME = np.sqrt(RADIUS**3 / EARTH)  # s, and lengths in radii
PARKING = [21837080.052835 / RADIUS, 0.0, 0.0, -0.25396764647494, 0.0, np.pi]
TARGET = [(19323 * 6076.1154855643 + RADIUS) / RADIUS, 0.0, 0.0, 0.0, 0.0, np.nan]
LEGS = {
    "coast": (2000.0, 3000.0, 2690.0, None),
    "burn": (100.0, 200.0, 150.0, (0.148637e-2, -9.08446)),
    "transfer": (18500.0, 19700.0, 18810.0, None),
    "insert": (20.0, 100.0, 50.0, (-0.136658e-2, 49.7892)),
}
"""Least, most and guessed duration, s; of a burn guesses of the thrust's angles, degrees."""


def equinoctial_rates(x: Any, thrust: Any) -> Any:
    """d/dt of the modified equinoctial elements (p, f, g, h, k, L), in radii and their time.

    Args:
        thrust: Acceleration as a function of the unit vector up, the velocity and the unit vector along the momentum;
            None where it is off.
    """
    p, f, g, h, k, L = ca.vertsplit(x)
    c, s = ca.cos(L), ca.sin(L)
    q, apart, size = 1 + f * c + g * s, h**2 - k**2, 1 + h**2 + k**2
    r = p / q
    place = r / size * ca.vertcat(c + apart * c + 2 * h * k * s, s - apart * s + 2 * h * k * c, 2 * (h * s - k * c))
    velocity = ca.vertcat(
        -(s + apart * s - 2 * h * k * c + g - 2 * f * h * k + apart * g),
        -(-c + apart * c + 2 * h * k * s - f + 2 * g * h * k + apart * f),
        2 * (h * c + k * s + f * h + g * k),
    ) / (size * ca.sqrt(p))
    normal = ca.cross(place, velocity)
    up, normal = place / r, normal / ca.norm_2(normal)
    sine = up[2]  # of the latitude
    north = ca.vertcat(0, 0, 1) - sine * up  # as long as its cosine
    legendre = {2: (3 * sine**2 - 1) / 2, 3: (5 * sine**3 - 3 * sine) / 2, 4: (35 * sine**4 - 30 * sine**2 + 3) / 8}
    slopes = {2: 3 * sine, 3: (15 * sine**2 - 3) / 2, 4: (35 * sine**3 - 15 * sine) / 2}
    pull = sum((j + 1) * r ** -(j + 2) * legendre[j] * ZONAL[j] for j in ZONAL) * up
    pull -= sum(r ** -(j + 2) * slopes[j] * ZONAL[j] for j in ZONAL) * north
    if thrust is not None:
        pull += thrust(up, velocity, normal)
    radial, along, across = ca.dot(up, pull), ca.dot(ca.cross(normal, up), pull), ca.dot(normal, pull)
    root, tilt = ca.sqrt(p), h * s - k * c
    return ca.vertcat(
        2 * p / q * root * along,
        root * (s * radial + ((q + 1) * c + f) / q * along - g / q * tilt * across),
        root * (-c * radial + ((q + 1) * s + g) / q * along + f / q * tilt * across),
        root * size * c / (2 * q) * across,
        root * size * s / (2 * q) * across,
        root * tilt / q * across + root * (q / p) ** 2,
    )


def steered(acceleration: Any, out: Any, within: Any) -> Callable[[Any, Any, Any], Any]:
    """Acceleration at angles out of and within the plane of velocity and radius, as `equinoctial_rates` takes it."""

    def thrust(up: Any, velocity: Any, normal: Any) -> Any:
        ahead, side = velocity / ca.norm_2(velocity), -normal
        turned = ca.cos(within) * ahead + ca.sin(within) * side
        return acceleration * (ca.cos(out) * turned + ca.sin(out) * ca.cross(ahead, side))

    return thrust


def flown() -> dict[str, Callable[[float], Any]]:
    """Elements over the time of each leg, with the guessed thrust: where the search starts."""
    state = np.array([*PARKING, 1.0])
    by_name: dict[str, Callable[[float], Any]] = {}
    y = ca.SX.sym("y", 7)
    for name, (_, _, duration, angles) in LEGS.items():
        thrust = None if angles is None else steered(_acceleration(y[6]), *np.deg2rad(angles))
        rate = ca.vertcat(equinoctial_rates(y[:6], thrust) / TIME, -THRUST / IMPULSE if angles else 0)
        times = np.linspace(0.0, duration, 61)
        run = ca.integrator("leg", "cvodes", {"x": y, "ode": rate}, 0.0, times[1:].tolist())
        values = np.vstack([state, np.array(run(x0=state)["xf"]).T])
        state = values[-1]

        def at(t: float, times: Any = times, values: Any = values) -> Any:
            return [np.interp(t, times, values[:, j]) for j in range(6)]

        by_name[name] = at
    return by_name


def _acceleration(weight: Any) -> Any:
    return THRUST * GRAVITY / weight / (RADIUS / TIME**2)


def two_burns() -> Phases:
    """From a low inclined orbit to a high equatorial one by two burns, with the most weight left."""
    guesses, legs = flown(), {}
    for name, (least, most, guess, angles) in LEGS.items():
        leg = legs[name] = Problem(name)
        ends: dict[str, Any] = (
            {"initial": PARKING} if name == "coast" else {"terminal": TARGET} if name == "insert" else {}
        )
        box: dict[str, Any] = {"lower": [0.4, -1, -1, -1, -1, np.pi], "upper": [10, 1, 1, 1, 1, 30 * np.pi]}
        x = leg.state("x", 6, guess=guesses[name], **box, **ends)
        thrust = None
        if angles is not None:
            w = leg.state("w", initial=1.0 if name == "burn" else None, lower=0.01, upper=2.0, guess=0.5)
            out, within = (leg.control(each, guess=np.deg2rad(a), lower=-np.pi, upper=np.pi)
                           for each, a in zip(("out", "within"), angles, strict=True))  # fmt: skip
            leg.dynamics(w, -THRUST / IMPULSE)
            thrust = steered(_acceleration(w), out, within)
            if name == "insert":
                leg.minimize(terminal=-w)
        leg.dynamics(x, equinoctial_rates(x, thrust) / TIME)
        leg.horizon(lower=least, upper=most, guess=guess)
    phases = Phases("two burns", legs)
    phases.join("coast", "burn")
    phases.join("burn", "transfer")
    phases.join("transfer", "insert", {"w": phases["burn"].at_end("w")})
    return phases


# ---- the launch of a Delta III: metres, kilograms, seconds -------------------------------------------------------

MU, GROUND, TURN = 3.986012e14, 6378145.0, 7.29211585e-5  # m^3/s^2, m, rad/s
BOOSTER, FIRST, SECOND = 628500.0, 1083100.0, 110094.0  # thrusts, N
BURNT = {"booster": 17010 / 75.2, "first": 95550 / 261.0, "second": 16820 / 700.0}  # kg/s
MASS = 4164.0 + 19300 + 104380 + 9 * 19290
"""At the start, kg; the unit of masses, beside the Earth's radius and its time."""
STAGES: dict[str, tuple[float, float, float | None, float]] = {
    "six boosters": (6 * BOOSTER + FIRST, 6 * BURNT["booster"] + BURNT["first"], 75.2, 6 * (19290.0 - 17010)),
    "three boosters": (3 * BOOSTER + FIRST, 3 * BURNT["booster"] + BURNT["first"], 75.2, 3 * (19290.0 - 17010)),
    "first stage": (FIRST, BURNT["first"], 110.6, 104380.0 - 95550),
    "second stage": (SECOND, BURNT["second"], None, 0.0),
}
"""Thrust, N, mass that is burnt, kg/s, duration, s, and mass that is dropped behind, kg."""


def orbit(a: float, e: float, inclination: float, node: float, perigee: float) -> tuple[np.ndarray, np.ndarray]:
    """Place and velocity at the perigee of an orbit, angles in degrees."""

    def about(axis: int, angle: float) -> np.ndarray:
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i] = turn[j, j] = c
        turn[i, j], turn[j, i] = -s, s
        return turn

    turn = about(2, node) @ about(0, inclination) @ about(2, perigee)
    return turn[:, 0] * a * (1 - e), turn[:, 1] * np.sqrt(MU / a * (1 + e) / (1 - e))


def launch() -> Phases:
    """From Cape Canaveral into a transfer orbit, with the most mass; in radii, their time and the mass at the start."""
    time = np.sqrt(GROUND**3 / MU)
    speed, force = GROUND / time, MASS * GROUND / time**2
    latitude = np.deg2rad(28.5)
    site = np.array([np.cos(latitude), 0.0, np.sin(latitude)])
    carried = np.array([0.0, TURN * time * site[0], 0.0])
    high, fast = orbit(24361140.0, 0.7308, 28.5, 269.8, 130.5)
    high, fast = high / GROUND, fast / speed
    momentum = np.cross(high, fast)
    towards = np.cross(fast, momentum) - high / np.linalg.norm(high)  # the perigee, as long as the eccentricity
    stages = {}
    for name, (thrust, burnt, duration, _) in STAGES.items():
        low = name.endswith("boosters")
        start = name == "six boosters"
        stage = stages[name] = Problem(name)
        r = stage.state("r", 3, guess=site if low else high, lower=-2.0, upper=2.0, initial=site if start else None)
        v = stage.state(
            "v", 3, guess=carried if low else fast, lower=-1.3, upper=1.3, initial=carried if start else None
        )
        m = stage.state("m", lower=1e-3, guess=0.5, initial=1.0 if start else None)
        u = stage.control("u", 3, lower=-1.1, upper=1.1, guess=[1.0, 0.0, 0.0] if low else [0.0, 0.0, 1.0])
        radius, wind = ca.norm_2(r), v - TURN * time * ca.vertcat(-r[1], r[0], 0)
        air = 1.225 * ca.exp(-(radius - 1) * GROUND / 7200.0) * 0.5 * 4 * np.pi / 2 * GROUND / MASS
        drag = -air * ca.sqrt(ca.sumsqr(wind) + 1e-16) * wind / m  # which is smooth where there is no wind
        stage.dynamics(r, v / time)
        stage.dynamics(v, (thrust / force * u / m + drag - r / radius**3) / time)
        stage.dynamics(m, -burnt / MASS)
        stage.path("direction", ca.sumsqr(u), 1.0, 1.0)
        if duration is not None:
            stage.horizon(duration)
            continue
        stage.horizon(lower=1.0, upper=700.0, guess=700.0)
        own = ca.cross(r, v)
        stage.end("momentum", own - momentum, 0.0, 0.0)
        stage.end("perigee", (ca.cross(v, own) - r / radius - towards)[:2], 0.0, 0.0)
        stage.minimize(terminal=-m)
    phases = Phases("launch", stages)
    for before, after in itertools.pairwise(stages):
        dropped = STAGES[before][3] / MASS
        phases.join(before, after, {"m": phases[before].at_end("m") - dropped})
    return phases
