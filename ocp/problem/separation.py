"""Minimum distances between bodies at all times: the declaration, and the bounds on which the audit's proof rests.

A body is the convex hull of points, its core, inflated by a radius. It moves with a frame whose pose is an expression
of states and time. The methods do not enforce the distances: the audit proves them at all times, and constraints that
enforce them are added separately (:mod:`ocp.motion.builders.clearance`).

A proof between two times needs bounds on the relative motion. Let x be the states that move the two bodies, observed
from a given frame. A state of rate x_k' moves no point of them by more than lever_k |x_k'| and rotates none by more
than turn_k |x_k'|. For a point carried by a chain of axes,

    |p'| <= sum lever_k |x_k'|,
    |p''| <= sum lever_k |x_k''| + 2 (sum turn_k |x_k'|) (sum lever_k |x_k'|),

where p is a point of one body relative to a point of the other. (The factor 2 is that of the Coriolis acceleration: a
later axis moves points by at most its lever, and is rotated by all axes before it.) Frames that depend on time alone
need no such bounds: those follow from their expressions (:mod:`ocp.problem.enclosures`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ocp.errors import ProblemError, require
from ocp.problem.hulls import CoveredPairs, Hull
from ocp.problem.values import check_finite, table

__all__ = ["Separation", "index_rows", "stack_motion_bounds"]

WORLD = -1
"""Index of the world among the frames."""


@dataclass(frozen=True, eq=False)
class Separation:
    """Pairs of bodies with a minimum distance.

    Attributes:
        name: Unique among the constraints of a problem.
        placements: Poses of F frames in world, each as the rotation column by column, then the position; expressions of
            states and parameters, or of time and parameters. Shape (12 F, 1).
        hulls: The bodies, by name.
        pairs: Two indices of bodies in ``hulls``, and the index of the frame from which the relative motion is
            observed, -1 for the world. Shape (n, 3).
        least: Minimum distances. Shape (n,), m.
        movers: Names of the states that move the bodies, with their sizes.
        levers, turns: Bounds as above, for the stacked states in ``movers``. Shape (n, k), in m and rad per unit of the
            state.
        covers: By the index of a pair, pairs of bodies, shape (m, 2), that together contain its two bodies: the
            smallest of their distances is a lower bound of the distance of the pair. Levers and turns hold for all of
            them.
        assumed: Pairs of bodies that are skipped without proof, by description, with the reason. Every verdict on the
            separation reports them.

    Raises:
        ProblemError: Wrong shapes, a value that is not finite or is negative, an unknown body or frame.
    """

    name: str
    placements: Any
    hulls: dict[str, Hull]
    pairs: np.ndarray
    least: np.ndarray
    movers: dict[str, int]
    levers: np.ndarray
    turns: np.ndarray
    covers: Mapping[int, np.ndarray] = field(default_factory=dict)
    assumed: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        what = f"separation {require.text('separation: its name', self.name)!r}"
        pairs = index_rows(what, "pairs", self.pairs, 3)
        object.__setattr__(self, "pairs", pairs)
        object.__setattr__(self, "covers", _checked_covers(what, self.covers, len(pairs)))
        for text in (part for item in require.mapping(f"{what}: assumed", self.assumed).items() for part in item):
            require.text(f"{what}: assumed", text)
        self._check_bodies(what)
        n, k = len(pairs), sum(self.movers.values())
        for label, shape in {"least": (n,), "levers": (n, k), "turns": (n, k)}.items():
            object.__setattr__(self, label, _bounds(what, label, getattr(self, label), shape))

    def _check_bodies(self, what: str) -> None:
        """Raise ProblemError unless all pairs refer to existing bodies on existing frames."""
        frames, rest = divmod(int(self.placements.numel()), 12)
        if rest:
            words = f"{what}: placements have {self.placements.numel()} entries, 12 for each frame expected"
            raise ProblemError(words, name="placements", value=self.placements.numel())
        hulls = tuple(self.hulls.values())
        for label, pairs in (("pairs", self.pairs[:, :2]), *(("covers", rows) for rows in self.covers.values())):
            if pairs.size and (pairs.min() < 0 or pairs.max() >= len(hulls) or (pairs[:, 0] == pairs[:, 1]).any()):
                words = f"{what}: {label}: a pair does not consist of two different bodies of the {len(hulls)}"
                raise ProblemError(words, name=label)
        if not all(WORLD <= frame < frames for frame in [*(hull.frame for hull in hulls), *self.pairs[:, 2]]):
            raise ProblemError(f"{what}: a frame index is not one of the {frames} frames", name="frame", limit=frames)
        rows = CoveredPairs(self.pairs, self.covers).rows
        if any(hulls[k].normal.size and hulls[k].frame != frame for *bodies, frame in rows for k in bodies):
            words = f"{what}: the motion of a pair with a half-space must be observed from the frame of the half-space"
            raise ProblemError(words, name="pairs")

    def __str__(self) -> str:
        least = f"{self.least.min():g} m" if len(self) else "nothing"
        return f"{self.name}: {len(self)} pairs of {len(self.hulls)} bodies, at least {least} apart"

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.pairs)

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of each pair."""
        names = tuple(self.hulls)
        return tuple((names[first], names[second]) for first, second, _ in self.pairs)

    def of(self, pairs: Sequence[int]) -> Separation:
        """Return the separation of some of the pairs."""
        keep = list(pairs)
        parts = {label: getattr(self, label)[keep] for label in ("pairs", "least", "levers", "turns")}
        covers = {row: self.covers[pair] for row, pair in enumerate(keep) if pair in self.covers}
        return Separation(
            self.name, self.placements, self.hulls, movers=self.movers, covers=covers, assumed=self.assumed, **parts
        )


def _checked_covers(what: str, covers: Any, count: int) -> dict[int, np.ndarray]:
    """Return the covering pairs by the index of the covered pair, without empty entries."""
    covering: dict[int, np.ndarray] = {}
    for pair, rows in require.mapping(f"{what}: covers", covers).items():
        if isinstance(pair, bool) or not isinstance(pair, int | np.integer) or not 0 <= pair < count:
            words = f"{what}: covers: pair {pair!r} does not exist, there are {count}"
            raise ProblemError(words, name="covers", value=pair, limit=count)
        covering[int(pair)] = index_rows(what, "covers", rows, 2)
    return {pair: rows for pair, rows in covering.items() if len(rows)}


def _bounds(what: str, label: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of a shape, or a number broadcast to it; levers and turns must not be negative."""
    array = table(f"{what}: {label}", value)
    array = np.broadcast_to(array, shape) if array.ndim == 0 else array.reshape(shape) if not shape[0] else array
    if array.shape != shape:
        words = f"{what}: {label} has shape {array.shape}, expected {shape}"
        raise ProblemError(words, name=label, value=array.shape, limit=shape)
    check_finite(f"{what}: {label}", array)
    if label != "least" and (array < 0).any():
        raise ProblemError(f"{what}: {label} is negative", name=label, value=float(array.min()), limit=0.0)
    return np.array(array)


def index_rows(what: str, label: str, values: Any, count: int) -> np.ndarray:
    """Return rows of ``count`` integers, or raise ProblemError."""
    array = table(f"{what}: {label}", values)
    shaped = array.size % count == 0 and (array.ndim != 2 or not array.size or array.shape[1] == count)
    if not shaped or not np.isfinite(array).all() or (array % 1 != 0).any():
        words = f"{what}: {label} must be rows of {count} indices, not {values!r}"
        raise ProblemError(words, name=label, value=values)
    return array.astype(int).reshape(-1, count)


def stack_motion_bounds(what: str, bounds: Mapping[str, Any], movers: Mapping[str, int], count: int) -> np.ndarray:
    """Return levers or turns, given by the name of a state, side by side for all movers; missing ones are zero.

    Args:
        movers: Size of each state that moves a body. count: Number of pairs.
    """
    columns = [table(what, bounds.get(state, np.zeros((count, size)))) for state, size in movers.items()]
    return np.hstack([np.zeros((count, 0)), *(np.reshape(column, (count, -1)) for column in columns)])
