"""Bodies that have to stay apart at every time: what a problem says of them, and what its audit proves.

A body is the convex hull of some points, its core, swelled by a radius; it rides on a frame whose placement is an
expression of states and time. How near two bodies come is no constraint of a method: the audit proves it over all
times, and who declares it adds the constraints that he wants held (:mod:`ocp.motion.builders.clearance`).

To prove anything between two times it has to be known how the states move the bodies. Seen from a frame that is told,
with x the states that move the two, a state of rate x_k' moves no point of them by more than lever_k |x_k'| and turns
none by more than turn_k |x_k'|. A point that is carried by many axes, each by those before it, has at most

    |p'| <= sum lever_k |x_k'|,
    |p''| <= sum lever_k |x_k''| + 2 (sum turn_k |x_k'|) (sum lever_k |x_k'|),

p being one body's point less the other's. (The factor 2 is that of Coriolis: an axis that comes later moves points no
farther than by its lever, and is turned by all before it.) How frames move that time alone places is not told: it is
bounded from their expressions (:mod:`ocp.problem.enclosures`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ocp.errors import ProblemError, checked_mapping, checked_text
from ocp.problem.hulls import CoveredPairs, Hull
from ocp.problem.values import check_finite, table

__all__ = ["Separation", "index_rows", "stack_motion_bounds"]

WORLD = -1
"""In the place of a frame: the world."""


@dataclass(frozen=True, eq=False)
class Separation:
    """Pairs of bodies that have to stay apart.

    Attributes:
        name: Unique among those of a problem.
        placements: Of F frames in world: rotation column by column, and position, one below the other, each an
            expression of states and parameters, or of time and parameters. Shape (12 F, 1).
        hulls: The bodies, by their names.
        pairs: Of each pair the two bodies, by their places in ``hulls``, and the frame in which one is seen from the
            other, -1 for the world. Shape (n, 3).
        least: How far they have to be apart. Shape (n,), m.
        movers: Names of the states that move them, with their sizes.
        levers, turns: As above, of the states in ``movers`` one after the other. Shape (n, k), in m and rad by the unit
            of the state.
        covers: By the place of a pair, pairs of bodies, shape (m, 2), that hold its two between them: where the nearest
            of these is farther apart than the pair is by itself, it is so far apart. Levers and turns hold for all.
        assumed: Pairs of bodies that are not looked at, though no proof says that they may be left, and why. They are
            told wherever the separation is judged.

    Raises:
        ProblemError: Other shapes, what is not finite, or negative, a body or frame that there is none of.
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
        what = f"separation {checked_text('separation: its name', self.name)!r}"
        pairs = index_rows(what, "pairs", self.pairs, 3)
        object.__setattr__(self, "pairs", pairs)
        object.__setattr__(self, "covers", _checked_covers(what, self.covers, len(pairs)))
        for other, why in checked_mapping(f"{what}: assumed", self.assumed).items():
            checked_text(f"{what}: assumed", other)
            checked_text(f"{what}: assumed", why)
        self._check_bodies(what)
        n, k = len(pairs), sum(self.movers.values())
        for label, shape in {"least": (n,), "levers": (n, k), "turns": (n, k)}.items():
            object.__setattr__(self, label, _bounds(what, label, getattr(self, label), shape))

    def _check_bodies(self, what: str) -> None:
        """Raise unless all pairs are of bodies that there are, on frames that there are."""
        frames, rest = divmod(int(self.placements.numel()), 12)
        if rest:
            words = f"{what}: placements have {self.placements.numel()} entries, 12 for each frame expected"
            raise ProblemError(words, name="placements", value=self.placements.numel())
        hulls = tuple(self.hulls.values())
        for label, both in (("pairs", self.pairs[:, :2]), *(("covers", each) for each in self.covers.values())):
            if both.size and (both.min() < 0 or both.max() >= len(hulls) or (both[:, 0] == both[:, 1]).any()):
                words = f"{what}: {label}: a pair is not one of two of the {len(hulls)} bodies"
                raise ProblemError(words, name=label)
        if not all(WORLD <= frame < frames for frame in [*(hull.frame for hull in hulls), *self.pairs[:, 2]]):
            raise ProblemError(f"{what}: a frame is none of the {frames} placed", name="frame", limit=frames)
        rows = CoveredPairs(self.pairs, self.covers).rows
        if any(hulls[k].normal.size and hulls[k].frame != seen for *bodies, seen in rows for k in bodies):
            words = f"{what}: a half-space has to be seen from the frame that it rides on, where it stands still"
            raise ProblemError(words, name="pairs")

    def __str__(self) -> str:
        least = f"{self.least.min():g} m" if len(self) else "nothing"
        return f"{self.name}: {len(self)} pairs of {len(self.hulls)} bodies, at least {least} apart"

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.pairs)

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of each pair."""
        names = tuple(self.hulls)
        return tuple((names[one], names[other]) for one, other, _ in self.pairs)

    def of(self, pairs: Sequence[int]) -> Separation:
        """The same of some pairs alone."""
        keep = list(pairs)
        parts = {label: getattr(self, label)[keep] for label in ("pairs", "least", "levers", "turns")}
        covers = {place: self.covers[pair] for place, pair in enumerate(keep) if pair in self.covers}
        return Separation(
            self.name, self.placements, self.hulls, movers=self.movers, covers=covers, assumed=self.assumed, **parts
        )


def _checked_covers(what: str, covers: Any, count: int) -> dict[int, np.ndarray]:
    """Rows of pairs of bodies by the places of so many pairs; those without rows are left out."""
    found: dict[int, np.ndarray] = {}
    for pair, both in checked_mapping(f"{what}: covers", covers).items():
        if isinstance(pair, bool) or not isinstance(pair, int | np.integer) or not 0 <= pair < count:
            words = f"{what}: covers: there is no pair {pair!r}, only {count}"
            raise ProblemError(words, name="covers", value=pair, limit=count)
        found[int(pair)] = index_rows(what, "covers", both, 2)
    return {pair: both for pair, both in found.items() if len(both)}


def _bounds(what: str, label: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of a shape, or one for all; levers and turns are not negative."""
    found = table(f"{what}: {label}", value)
    found = np.broadcast_to(found, shape) if found.ndim == 0 else found.reshape(shape) if not shape[0] else found
    if found.shape != shape:
        words = f"{what}: {label} has shape {found.shape}, expected {shape}"
        raise ProblemError(words, name=label, value=found.shape, limit=shape)
    check_finite(f"{what}: {label}", found)
    if label != "least" and (found < 0).any():
        raise ProblemError(f"{what}: {label} is negative", name=label, value=float(found.min()), limit=0.0)
    return np.array(found)


def index_rows(what: str, label: str, values: Any, count: int) -> np.ndarray:
    """Rows of so many whole numbers, or ProblemError."""
    found = table(f"{what}: {label}", values)
    shaped = found.size % count == 0 and (found.ndim != 2 or not found.size or found.shape[1] == count)
    if not shaped or not np.isfinite(found).all() or (found % 1 != 0).any():
        words = f"{what}: {label} must be rows of {count} indices, not {values!r}"
        raise ProblemError(words, name=label, value=values)
    return found.astype(int).reshape(-1, count)


def stack_motion_bounds(what: str, given: Mapping[str, Any], movers: Mapping[str, int], count: int) -> np.ndarray:
    """Levers or turns by the name of a state, side by side for all movers; zero of those that are not given.

    Args:
        movers: Size of each state that moves a body. count: Number of pairs.
    """
    columns = [table(what, given.get(each, np.zeros((count, size)))) for each, size in movers.items()]
    return np.hstack([np.zeros((count, 0)), *(np.reshape(column, (count, -1)) for column in columns)])
