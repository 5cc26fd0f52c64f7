"""Goddard's rocket (COPS 3.0, problem 10): full thrust, singular arc, coast.

h' = v, v' = (F - D)/m - 1/h^2, m' = -2 F with D = 310 v^2 exp(-500 (h - 1)), from (1, 0, 1) to m = 0.6, 0 <= F <=
3.5, greatest h at a free final time. Where the switching function vanishes so do its rate and H: three linear
equations in three costates, solvable only on the surface D (1 + 2 v) = m / h^2. Full thrust reaches it at T1; the
thrust that keeps to it burns until m = 0.6 at T2; the coast ends at rest. The times come from integrating these arcs
with events.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp

import casadi as ca
import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Switch, fitted, held, legendre, radau, shooting, within
from .flow import flow

THRUST = 3.5
T1, T2, HORIZON = 0.0235096840414634, 0.0726707434414771, 0.198856262105147
MESH = fitted((T1 / HORIZON, T2 / HORIZON), 20)
COSTATE_AT_START = (-4.5729002321618246, -0.17429930987253683, -0.062249753525907343)


def build() -> Problem:
    problem = Problem("Goddard")
    h = problem.state("h", initial=1.0, guess=1.0)
    v = problem.state("v", initial=0.0, guess=lambda t: 2.5 * t * (0.2 - t) * 4)
    m = problem.state("m", initial=1.0, terminal=0.6, guess=lambda t: 1 - 2 * t)
    thrust = problem.control("F", lower=0.0, upper=THRUST, guess=1.0)
    problem.horizon(lower=0.05, upper=1.0, guess=0.2)
    drag = 310 * v**2 * ca.exp(-500 * (h - 1))
    problem.dynamics(h, v)
    problem.dynamics(v, (thrust - drag) / m - 1 / h**2)
    problem.dynamics(m, -2 * thrust)
    problem.minimize(terminal=-h)
    return problem


def singular_thrust(h: float, v: float, m: float) -> float:
    """Thrust that keeps D (1 + 2 v) - m / h^2 at zero."""
    drag = 310 * v**2 * exp(-500 * (h - 1))
    by_h = -500 * drag * (1 + 2 * v) + 2 * m / h**3
    by_v = 2 * drag / v * (1 + 2 * v) + 2 * drag
    return -(by_h * v - by_v * (drag / m + 1 / h**2)) / (by_v / m + 2 / h**2)


def canonical(thrust_law: Callable[[float, float, float], float]) -> Callable[[float, Array], Sequence[float]]:
    """Rates of states and costates under a law of thrust."""

    def rates(t: float, y: Array) -> Sequence[float]:
        h, v, m, lh, lv, _ = (float(entry) for entry in y)
        thrust = thrust_law(h, v, m)
        density = 310 * exp(-500 * (h - 1))
        drag = density * v**2
        return (
            v,
            (thrust - drag) / m - 1 / h**2,
            -2 * thrust,
            -lv * (500 * drag / m + 2 / h**3),
            -lh + lv * 2 * density * v / m,
            lv * (thrust - drag) / m**2,
        )

    return rates


# states and costates along full thrust, singular arc and coast
BURN = flow(canonical(lambda h, v, m: THRUST), (1.0, 0.0, 1.0, *COSTATE_AT_START), (0.0, T1))
ARC = flow(canonical(singular_thrust), lambda: BURN(np.array(T1)), (T1, T2))
COAST = flow(canonical(lambda h, v, m: 0.0), lambda: ARC(np.array(T2)), (T2, HORIZON))


def optimum(t: Array) -> Extremal:
    y = np.empty((6, t.size))
    where = (t < T1, (t >= T1) & (t < T2), t >= T2)
    for arc, on in zip((BURN, ARC, COAST), where, strict=True):
        if on.any():
            y[:, on] = arc(t[on])
    h, v, m, lh, lv, lm = y
    thrust = np.where(where[0], THRUST, 0.0)
    thrust[where[1]] = [singular_thrust(*x) for x in zip(h[where[1]], v[where[1]], m[where[1]], strict=True)]
    return Extremal(state={"h": h, "v": v, "m": m}, control={"F": thrust}, costate={"h": lh, "v": lv, "m": lm})


RUNS = (
    # held controls: free ones ring along the singular arc and beat the optimum
    *within(*held(60)[:2], cost=(1e-7, 1e-7), state=5e-3, control=None, costate=1e-2, time=3e-6),
    *within(radau(MESH, control="held"), cost=(1e-8, 1e-8), state=2e-4, control=0.2, costate=2e-3, time=2e-6),
    *within(legendre(MESH, control="held"), cost=(1e-8, 1e-8), state=2e-4, control=0.2, costate=2e-4, time=2e-6),
    *within(shooting(MESH, "held"), cost=(1e-8, 3e-7), state=2e-4, control=0.2, costate=1e-3, time=5e-6),
)
CASE = Case(
    "Goddard", build, -1.0128369183175, RUNS, horizon=HORIZON, optimum=optimum, switches=(Switch(T1), Switch(T2))
)
