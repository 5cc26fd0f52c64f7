"""Inverse kinematics of the rig with the globally best roll, in a bounded number of operations.

The best roll on a set of arcs is a stationary point of the index inside an arc or an end of an arc. The least of all is
found first, with a fixed number of operations (harmonics.least_point for I1, descents on convex intervals for I2);
where it is within reach and limits that is all. Else the ends are looked at, those that cost most last and only where
they can matter (cts_search).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.cts import HOME, Branch, Rig, Tunnel
from models.cts_search import Search, choose
from models.errors import ModelError

TURN = 2 * np.pi


def optimal_inverse(
    rig: Rig, tunnel: Tunnel, branch: Branch = HOME, *, rate_weight: float = 0.0, limits: bool = True
) -> Any:
    """Function (target, previous) -> (joints, cost, active, status): the joints with the roll of least index.

    Args:
        rig: Lengths and joint limits.
        tunnel: Centre, ranges and weights of the index.
        branch: Which of the four joint sets.
        rate_weight: w4 of I2 = I1 + w4 / (2 pi) (roll - previous)^2, (37); 0 for I1.
        limits: Whether reach and joint limits bound the roll. Without them the stationary point of least index is
            taken, in closed form only, and the status tells whether the pose is in reach and within limits.

    Returns:
        A casadi Function. Inputs: target (x, y, z, yaw, pitch), shape (5,); previous roll, rad. Outputs: joints,
        shape (6,), nan unless the status is 0; the index; code of the active constraint in cts_roll.ACTIVE; code in
        cts_roll.STATUS. The roll is given in the turn nearest to the previous one that the limits of joint 6 allow,
        or, where they allow less than a turn, in theirs.

    Raises:
        ModelError: A negative or non-finite rate weight; limits=False with a rate weight.
    """
    gain = checked_gain(rate_weight)
    if gain and not limits:
        raise ModelError("limits=False is for the closed form of I1; with a rate weight leave limits on")
    return _built(rig, tunnel, branch, gain, limits)


@lru_cache(maxsize=32)  # rig and tunnel are frozen; a function asked for again is the same
def _built(rig: Rig, tunnel: Tunnel, branch: Branch, gain: float, limits: bool) -> Any:
    search = Search(rig, tunnel, branch, gain)
    target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
    result, done, state, rows = search.direct()(target, previous)
    if limits:
        result = choose(search.thorough(), (9, 1))(done, result, target, previous, state, rows)
    out = ca.vertsplit(result, [0, 6, 7, 8, 9])
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    labels = ["target", "previous"], ["joints", "cost", "active", "status"]
    return ca.Function(name, [target, previous], list(out), *labels)


def checked_gain(rate_weight: float) -> float:
    """w4 / (2 pi); ModelError for a weight that is negative or not finite."""
    if not (np.isfinite(rate_weight) and rate_weight >= 0):
        raise ModelError(f"rate_weight {rate_weight} must be finite and not negative")
    return float(rate_weight) / TURN
