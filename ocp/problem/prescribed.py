"""Bodies whose motion time alone prescribes: how far they may get within an interval of time, and off its chord.

Over an interval of length h, let every coordinate of a point stay in a range of width w and have slopes, all difference
quotients, in [l, u] (:mod:`ocp.problem.enclosures`). Then it gets no farther from where it is in the middle than

    min(w, h/2 max(|l|, |u|)),

and stays within h/4 (u - l) of the straight line between its ends. Both hold across kinks. Where a jump cannot be ruled
out the slopes have no bounds, and the width alone counts: it is that of the jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.enclosures import Enclosures
from ocp.problem.hulls import Covered
from ocp.problem.separation import WORLD, Separation
from ocp.problem.values import identity

__all__ = ["PrescribedMotion"]

ENTRIES = 12
"""Of a frame: its rotation column by column, its position."""


class PrescribedMotion:
    """The bodies of some pairs that ride on frames which time alone moves.

    Args:
        apart: The pairs. placements: Theirs, or the same in other symbols. time: Its symbol.
        parameters, values: Symbols of parameters, and their numbers.

    Raises:
        ProblemError: A frame of time and states; one seen from another frame than the world; an operation that has no
            bounds, by its name.
    """

    def __init__(
        self, apart: Separation, placements: Any, time: Any, parameters: Sequence[Any], values: Sequence[Any]
    ) -> None:
        what = f"separation {apart.name!r}"
        parts = [placements[k : k + ENTRIES] for k in range(0, placements.numel(), ENTRIES)]
        frames = [k for k, part in enumerate(parts) if ca.depends_on(part, time)]
        rows = [_of_time(f"{what}: frame {k}", parts[k], time, parameters, values) for k in frames]
        self._enclosures = Enclosures(ca.vertcat(*rows), time, what) if rows else None
        hulls = list(apart.hulls.values())
        covered = Covered(apart.pairs, apart.covers)
        for one, other, seen in covered.rows:
            if seen != WORLD and {seen, hulls[one].frame, hulls[other].frame} & set(frames):
                words = f"{what}: bodies on a frame that time moves have to be seen from the world, -1, not from {seen}"
                raise ProblemError(words, name="pairs", value=int(seen), limit=WORLD)
        self._bodies: list[tuple[int, np.ndarray]] = []
        self._of_pair = np.full((len(apart), 2), -1)
        for pair, side in np.ndindex(*self._of_pair.shape):
            _, mine = covered.of(np.array([pair]))
            riding = [hulls[k] for k in covered.rows[mine, side] if hulls[k].frame in frames]
            if riding:
                core = np.concatenate([hull.core for hull in riding])
                self._of_pair[pair, side] = len(self._bodies)
                self._bodies.append((frames.index(riding[0].frame), _coordinates(core)))

    def bounds(self, pair: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the bodies of pairs get from the middle of intervals of time, and off their chords. Shape (K,), m.

        Args:
            pair, begin, end: The pairs by their places, and the ends of the intervals in the unit of the time, (K,).
        """
        strays, bows = np.zeros(len(pair)), np.zeros(len(pair))
        mine = np.flatnonzero((self._of_pair[pair] >= 0).any(axis=1))
        if self._enclosures is None or not mine.size:
            return strays, bows
        ends, where = np.unique(np.stack([begin[mine], end[mine]]), axis=1, return_inverse=True)
        found = self._enclosures(*ends)
        huge = 1e150  # for a bound that there is none of: products and squares of it are finite
        low, high, least, most = (
            np.clip(np.nan_to_num(side, posinf=huge, neginf=-huge), -huge, huge) for side in found
        )
        half = (ends[1] - ends[0])[:, None] / 2
        bodies = self._of_pair[pair[mine]]
        for body in np.unique(bodies[bodies >= 0]).tolist():
            frame, map_ = self._bodies[body]
            entries = slice(ENTRIES * frame, ENTRIES * (frame + 1))
            up, down = np.maximum(map_, 0.0), np.minimum(map_, 0.0)
            falls = least[:, entries] @ up.T + most[:, entries] @ down.T
            rises = most[:, entries] @ up.T + least[:, entries] @ down.T
            width = (high - low)[:, entries] @ np.abs(map_).T
            stray = _longest(np.minimum(width, half * np.maximum(np.abs(falls), np.abs(rises))))
            bow = _longest(half / 2 * (rises - falls))
            at = np.flatnonzero((bodies == body).any(axis=1))  # no pair has a body twice
            strays[mine[at]] += stray[where.ravel()[at]]
            bows[mine[at]] += bow[where.ravel()[at]]
        return strays, bows


def _of_time(what: str, frame: Any, time: Any, parameters: Sequence[Any], values: Sequence[Any]) -> Any:
    """A frame with the numbers of its parameters."""
    known = {identity(symbol) for symbol in ca.symvar(ca.vertcat(time, *parameters))}
    others = [symbol for symbol in ca.symvar(frame) if identity(symbol) not in known]
    if others and ca.depends_on(frame, ca.vertcat(*map(ca.vec, others))):
        words = f"{what} is moved by time and by states; let a state of its own follow the time"
        raise ProblemError(words, name="placements", value=", ".join(map(str, others)))
    function = ca.Function("frame", [time, *parameters, *others], [frame])
    return function(time, *values, *(ca.DM.zeros(other.shape) for other in others))


def _coordinates(core: np.ndarray) -> np.ndarray:
    """The map from a frame to the coordinates in world of the corners of a box about points. Shape (3 C, 12)."""
    ends = np.stack([core.min(axis=0), core.max(axis=0)])
    corners = np.unique(np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3), axis=0)
    with_one = np.column_stack([corners, np.ones(len(corners))])
    return np.kron(with_one, np.eye(3))


def _longest(coordinates: np.ndarray) -> np.ndarray:
    """Length of the longest of some vectors (M, 3 C), coordinate by coordinate; inf where one is huge. Shape (M,)."""
    found = np.linalg.norm(coordinates.reshape(len(coordinates), -1, 3), axis=2).max(axis=1)
    return np.where(found < 1e100, found, np.inf)
