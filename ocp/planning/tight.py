"""A way through sets of postures drawn tight: the cheapest of those beside it, nearer and nearer.

At every instant some postures are taken on either side of the way, and dynamic programming finds the cheapest way
through these; where it does not run along their edge any more, they come nearer to each other. What is not allowed is
dear, so that a way comes out of it where it can. A way that stays is the cheapest of all beside it, whatever kinks
its cost has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from models import Surroundings
from models.arrays import Array
from ocp.local.touching import distances_along
from ocp.planning.charts import Instant
from ocp.planning.steps import StepCost
from ocp.tolerances import CLEARANCE_TOLERANCE_M

__all__ = ["PENALTY", "TightSettings", "drawn_tight"]

PENALTY = 1e6
"""Cost of a rad or m by which a limit is passed: beyond that of any way."""


@dataclass(frozen=True)
class TightSettings:
    """How a way is drawn tight.

    Attributes:
        beside: Postures on either side, by the directions that are free.
        inside: By so much more than is asked bodies are held apart, m.
        moves: At most, before the postures come nearer to each other.
        still: Share of its cost by which a way at the edge has to get cheaper, or the postures come nearer.
    """

    beside: tuple[int, int, int] = (0, 5, 2)
    inside: float = CLEARANCE_TOLERANCE_M
    moves: int = 10
    still: float = 1e-4


def drawn_tight(
    path: Array,
    instants: Sequence[Instant],
    cost: StepCost,
    times: Array,
    far: Array,
    bounds: tuple[Array, Array],
    around: Surroundings | None,
    widths: tuple[float, float],
    settings: TightSettings = TightSettings(),
) -> Array:
    """A way beside another one that is cheaper, or keeps limits better. Shape (K, n).

    Args:
        path: Joints at the instants, which do the tasks. Shape (K, n).
        instants: All of one free direction, or all of two; of others the way stays.
        cost: Of steps. times: Of the instants. Shape (K,), s.
        far: Limits of the ways of the joints from instant to instant. Shape (K - 1, n).
        bounds: Of the joints. Shape (n,) each.
        around: What has to be clear.
        widths: Distances from one posture to the next, at first and at last, in the metric of the sets.
    """
    joints, (width, last), least, moves = path, widths, np.inf, 0
    whole = {instant.sets for instant in instants}
    sizes = {sets.size for sets in whole}
    if sizes not in ({1}, {2}):
        return path
    size = sizes.pop()
    own = settings.beside[size]
    count = (2 * own + 1) ** size
    shifts = np.array(list(product(np.arange(-own, own + 1.0), repeat=size)))
    rows = [(sets, np.flatnonzero([instant.sets is sets for instant in instants])) for sets in whole]
    number = np.array([instant.number for instant in instants])
    tangents: dict[int, Array] = {}
    while width > last:
        beside, good = np.empty((len(joints), count, joints.shape[1])), np.empty((len(joints), count), bool)
        for side, (sets, those) in enumerate(rows):
            tangents[side] = sets.tangents_at(number[those], joints[those], tangents.get(side))
            flat = joints[those, None] + width * np.einsum("knr,sr->ksn", tangents[side], shifts)
            on, fine = sets.corrected(np.repeat(number[those], count), flat.reshape(-1, flat.shape[2]))
            good[those] = fine.reshape(len(those), -1)
            beside[those] = np.where(good[those][:, :, None], on.reshape(flat.shape), flat)
        wrong = np.where(good, _passed(beside, times, bounds, around, settings.inside), 1.0)
        value, back = PENALTY * wrong[0], []
        for k in range(1, len(joints)):
            way = beside[k][None] - beside[k - 1][:, None]
            over = np.maximum(np.abs(way) - far[k - 1], 0.0).sum(axis=2)
            steps = value[:, None] + cost.of(way, times[k] - times[k - 1]) + PENALTY * over
            back.append(steps.argmin(axis=0))
            value = steps.min(axis=0) + PENALTY * wrong[k]
        seats = [int(value.argmin())]
        for before in reversed(back):
            seats.append(int(before[seats[-1]]))
        joints = beside[np.arange(len(joints)), seats[::-1]]
        at_edge, now = np.abs(shifts[seats]).max() == own, float(value.min())
        moves += 1
        if not (at_edge and now < least * (1 - settings.still) and moves < settings.moves):
            width, moves = width / 2, 0
        least = min(least, now)
    return joints


def _passed(
    beside: Array, times: Array, bounds: tuple[Array, Array], around: Surroundings | None, inside: float
) -> Array:
    """By how much postures (K, s, n) about a way pass limits and clearance at times (K,), rad and m. Shape (K, s)."""
    over = np.maximum(np.maximum(beside - bounds[1], bounds[0] - beside), 0.0).sum(axis=2)
    if around is None:
        return np.asarray(over)
    least, middle, none = around.clearance + inside, beside[:, beside.shape[1] // 2], np.zeros(0)
    span = np.abs(beside - middle[:, None]).max(axis=1) @ around.levers.joints.T
    apart = distances_along(around, none, middle, times, least + float(span.max(initial=0.0)))
    close = np.flatnonzero((apart - span < least).any(axis=1))  # beside the others nothing comes near
    each, then = beside[close].reshape(-1, beside.shape[2]), np.repeat(times[close], beside.shape[1])
    apart = distances_along(around, none, each, then, least)
    over[close] += np.maximum(least - apart, 0.0).max(axis=1, initial=0.0).reshape(len(close), beside.shape[1])
    return np.asarray(over)
