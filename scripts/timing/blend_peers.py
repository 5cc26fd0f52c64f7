"""Peers that the benchmark of the blends compares with, left out where they are not installed."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from models.arrays import Array
from models.paths import SmoothPath
from models.paths.arc_length import speed
from scripts.papers.blend.example import SPEED
from scripts.timing.compiled import least

__all__ = ["GRID", "peer_plans", "roots"]

GRID = 400
ACCELERATIONS = (5.0, 30.0)  # m/s^2, of each axis


def roots(coefficients: Array) -> Callable[[float], float] | None:
    """Distance -> parameter by scipy's brentq on a 20-point Gauss-Legendre length; None without scipy."""
    try:
        brentq = importlib.import_module("scipy.optimize").brentq
    except ImportError:
        return None
    points, weights = np.polynomial.legendre.leggauss(20)
    points, weights = (points + 1) / 2, weights / 2
    curves = np.repeat(coefficients[None], len(points), axis=0)

    def excess(u: float, distance: float) -> float:
        return u * float(weights @ speed(curves, u * points)) - distance

    return lambda distance: float(brentq(excess, 0.0, 1.0, args=(distance,), xtol=1e-14))


def peer_plans(path: SmoothPath, repeats: int) -> dict[str, Any] | None:
    """toppra on the same path, speed and acceleration of each axis limited. None where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            toppra, constraint, algorithm = (
                importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
            )
    except ImportError:
        return None
    toppra.setup_logging("ERROR")
    s = np.linspace(0, path.length, GRID)
    points, one = path.at(s).position, np.ones((3, 1))
    found: dict[str, Any] = {"version": version("toppra"), "grid_points": GRID, "plans": [], "profiles": {}}
    for acceleration in ACCELERATIONS:

        def planned(most: float = acceleration) -> Any:
            curve = toppra.SplineInterpolator(s, points)
            limits = [
                constraint.JointVelocityConstraint(SPEED * one * [-1, 1]),
                constraint.JointAccelerationConstraint(most * one * [-1, 1]),
            ]
            return algorithm.TOPPRA(limits, curve, gridpoints=s).compute_trajectory(0, 0)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            motion = planned()
            ms = 1e3 * least(planned, repeats)
            t = np.linspace(0, motion.duration, 20_001)
            position, velocity = motion(t), np.linalg.norm(motion(t, 1), axis=1)
            rate = np.abs(motion(t, 2)).max()
        passed = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
        inside = (passed > path.bounds[1]) & (passed < path.bounds[2])
        found["plans"].append(
            {
                "axis_acceleration": acceleration,
                "ms": ms,
                "duration_s": motion.duration,
                "least_speed_in_blend": velocity[inside].min(),
                "largest_speed": velocity.max(),
                "acceleration_over_limit": rate / acceleration,
            }
        )
        every = slice(None, None, 25)
        name = f"toppra, {acceleration:g} m/s² an axis"
        found["profiles"][name] = {"distance": passed[every], "speed": velocity[every]}
    return found
