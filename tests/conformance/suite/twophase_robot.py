"""A point follows the two sides of a corner.

x' = v, v' = u, |u| <= 10, from (0, 0) with v = (0.5, 0) to (0.5, 0.5) with v = (0, 0.5) in 2 s, least int 100 |x - r|^2
+ 500 |v - r'|^2 dt, where r runs along x for 1 s, then along y. PROPT manual; PSOPT, example twophase_robot. The time
of each phase begins at zero.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from ocp import Collocation, Phases, Problem

from .entry import PSOPT, Entry, line


def build() -> Problem:
    legs = {}
    for name in ("across", "up"):
        leg = legs[name] = Problem(name)
        first = name == "across"
        ends: dict[str, Any] = {"lower": -10.0, "upper": 10.0}
        x = leg.state("x", 2, **ends, **_end(first, [0.0, 0.0], [0.5, 0.5]))
        v = leg.state("v", 2, **ends, **_end(first, [0.5, 0.0], [0.0, 0.5]))
        u = leg.control("u", 2, **ends, guess=0.0)
        leg.horizon(1.0)
        leg.dynamics(x, v)
        leg.dynamics(v, u)
        t = leg.time
        place = ca.vertcat(t / 2, 0) if first else ca.vertcat(0.5, t / 2)
        speed = ca.DM([0.5, 0.0] if first else [0.0, 0.5])
        leg.minimize(running=100 * ca.sumsqr(x - place) + 500 * ca.sumsqr(v - speed))
    phases = Phases("corner", legs)
    phases.join("across", "up")
    return phases


def _end(first: bool, start: list[float], end: list[float]) -> dict[str, Any]:
    """Value at the start of the first leg or at the end of the last, and the guess of PSOPT."""
    middle = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
    return {"initial": start, "guess": line(start, middle)} if first else {"terminal": end, "guess": line(middle, end)}


ENTRY = Entry("twophase_robot", (PSOPT,), build, {PSOPT: 1.042568}, method=Collocation(20, 4))
