"""The fastest motion where speeds and accelerations bind alone: exact passes backward and forward in (s, v^2).

With x = v^2 at the nodes and one acceleration u in each interval of width h, x grows by 2 h u, and each row is linear
in (u, x). Backward, the squared speeds from which the end can be reached are an interval at each node: in the rows of
an interval u is eliminated, which leaves bounds on x alone. Forward, the greatest u that stays among them is taken.
(Pham and Pham, A New Approach to Time-Optimal Path Parameterization Based on Reachability Analysis, 2018; the rows
hold at both ends of an interval.)
"""

from __future__ import annotations

import numpy as np

from ocp.errors import ProblemError
from ocp.schedule.profile import Array
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["passes"]


def passes(distance: Array, most: Array, p: Array, q: Array, low: Array, high: Array) -> Array:
    """Greatest squared speeds at nodes, from rest to rest.

    Args:
        distance: Of the nodes. Shape (N + 1,), m.
        most: Greatest squared speed at each. Shape (N + 1,).
        p, q, low, high: low <= p u + q x <= high in each interval, x being that at its first node. Shape (N, R).

    Raises:
        ProblemError: A node that no motion can pass, as its `time` (m).
    """
    h = np.diff(distance)
    floor, ceiling = _alone(p, q, low, high, most[:-1])
    least, top = np.zeros(len(distance)), np.zeros(len(distance))
    # u between lines over x: those with p > 0 bound it from above by `high`, from below by `low`, the others mirrored
    sign = np.sign(p)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(sign == 0, 0.0, -q / p)
        above = np.where(sign == 0, np.inf, np.where(sign > 0, high, low) / p)
        below = np.where(sign == 0, -np.inf, np.where(sign > 0, low, high) / p)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(len(h) - 1, -1, -1):
            # x + 2 h u: its least value must not be above the next interval's end, its greatest not below its start
            bend = 1 + 2 * h[k] * slope[k]
            ends = (top[k + 1] - 2 * h[k] * below[k]) / bend
            starts = (least[k + 1] - 2 * h[k] * above[k]) / bend
            up, down = bend > 0, bend < 0
            high_x = min(ceiling[k], ends[up].min(initial=np.inf), starts[down].min(initial=np.inf))
            low_x = max(floor[k], starts[up].max(initial=0.0), ends[down].max(initial=0.0))
            if not low_x <= high_x * (1 + ROUNDING_SHARE) + 1e-300:
                place = float(distance[k])
                message = f"no motion keeps the limits of acceleration and torque at {place:g} m; raise them"
                raise ProblemError(message, name="acceleration", value=low_x, limit=high_x, time=place)
            least[k], top[k] = min(low_x, high_x), high_x
    if least[0] > 0:
        message = "no motion from rest keeps the limits of acceleration and torque at 0 m; raise them"
        raise ProblemError(message, name="acceleration", value=float(least[0]), limit=0.0, time=0.0)
    x = np.zeros(len(distance))
    for k in range(len(h)):
        u = min(float((above[k] + slope[k] * x[k]).min(initial=np.inf)), (top[k + 1] - x[k]) / (2 * h[k]))
        x[k + 1] = min(max(x[k] + 2 * h[k] * u, least[k + 1]), top[k + 1])
    return x


def _alone(p: Array, q: Array, low: Array, high: Array, most: Array) -> tuple[Array, Array]:
    """Squared speeds at which an interval's rows leave some acceleration: bounds of x. Shape (N,) each."""
    floor, ceiling = np.zeros(len(p)), most.copy()
    count = p.shape[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(count):
            for j in range(i, count):
                # any two rows: u eliminated leaves a row of x between two bounds
                weight = np.where(p[:, i] == 0, 1.0, p[:, j]), np.where(p[:, i] == 0, 0.0, -p[:, i])
                if i == j:
                    weight = np.where(p[:, i] == 0, 1.0, 0.0), np.zeros(len(p))
                of_x = weight[0] * q[:, i] + weight[1] * q[:, j]
                least = sum(np.minimum(w * low[:, r], w * high[:, r]) for w, r in zip(weight, (i, j), strict=True))
                greatest = sum(np.maximum(w * low[:, r], w * high[:, r]) for w, r in zip(weight, (i, j), strict=True))
                ends = least / of_x, greatest / of_x
                some = of_x != 0
                ceiling = np.where(some, np.minimum(ceiling, np.fmax(*ends)), ceiling)
                floor = np.where(some, np.maximum(floor, np.fmin(*ends)), floor)
                ceiling = np.where(~some & ((least > 0) | (greatest < 0)) & (np.abs(weight[0]) > 0), -1.0, ceiling)
    return floor, ceiling
