"""Bodies as convex hulls of points, the distances between pairs of bodies, and declarations of minimum distances.

A body is the convex hull of points, its core, inflated by a radius. It moves with a frame whose pose is an expression
of states and time. For any direction that the search of nearest points returns (:mod:`models.shapes.hull`), the gap
along it is a lower bound of the distance, so a proof does not depend on the search.
A :class:`Separation` declares minimum distances, which the audit proves at all times and no method enforces. A proof
between two times needs bounds on the relative motion. Let x be the states that move the two bodies, observed from a
given frame. A state of rate x_k' moves no point of them by more than lever_k |x_k'| and rotates none by more than
turn_k |x_k'|. For a point carried by a chain of axes,

    |p'| <= sum lever_k |x_k'|,
    |p''| <= sum lever_k |x_k''| + 2 (sum turn_k |x_k'|) (sum lever_k |x_k'|),

where p is a point of one body relative to the other; the factor 2 is that of the Coriolis acceleration. Bounds for
frames that depend on time alone follow from their expressions (:mod:`ocp.problem.enclosures`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from models.checks import set_fields
from models.shapes.hull import gap_along, is_box, nearest_directions
from ocp.errors import ProblemError, require
from ocp.problem.values import table


@dataclass(frozen=True, eq=False)
class Hull:
    """A body that is fixed in a frame: the convex hull of points, inflated by a radius, or a half-space.

    Attributes:
        frame: Index of the frame with which it moves; -1: the world.
        core: Points in that frame. Shape (m, 3), m.
        radius: Radius by which the hull is inflated, m.
        normal: Outward unit normal of a half-space, whose core is one point of its plane; shape (0,) for a hull.
        link: Name of what carries the body, such as a link of a robot.

    Raises:
        ProblemError: Wrong shapes, a value that is not finite, a negative radius, a normal that is not a unit vector.
    """

    frame: int
    core: np.ndarray
    radius: float = 0.0
    normal: np.ndarray = field(default_factory=lambda: np.zeros(0))
    link: str = ""

    def __post_init__(self) -> None:
        core = require.array("hull: core", self.core, ("m", 3))
        normal = require.array("hull: normal", self.normal, (3,)) if np.size(self.normal) else np.zeros(0)
        radius = require.nonnegative("hull: radius", self.radius, unit="m")
        if normal.size and not abs(np.linalg.norm(normal) - 1) < 1e-9:
            words = f"hull: normal {normal.tolist()} is not a unit vector"
            raise ProblemError(words, name="normal", value=normal.tolist())
        set_fields(self, frame=int(self.frame), core=core, radius=radius, normal=normal)

    @cached_property
    def middle(self) -> np.ndarray:
        """Mean of the points of the hull, in the frame of the body. Shape (3,), m."""
        return np.asarray(self.core.mean(axis=0))

    @cached_property
    def kind(self) -> int:
        """Key by which hulls are evaluated together: 0 for boxes, else the point count rounded up to a power of 2."""
        return 0 if is_box(self.core) else 1 << (len(self.core) - 1).bit_length()

    @cached_property
    def size(self) -> float:
        """Radius of the smallest ball around :attr:`middle` that contains all points of the hull, m."""
        return float(np.linalg.norm(self.core - self.middle, axis=1).max())


class Frames(NamedTuple):
    """Poses of frames in world coordinates at M samples; the last frame is the world itself.

    Attributes:
        rotations: Shape (M, F + 1, 3, 3). positions: Shape (M, F + 1, 3), m.
    """

    rotations: np.ndarray
    positions: np.ndarray


class HullPairs:
    """Pairs of bodies that are evaluated together because their hulls are of the same kinds (see `Hull.kind`).

    Attributes:
        has: Whether a pair is in this group. row: Its index in the group. Shape (n,) each.
        radii: Sum of both radii. Shape (K,).
        flat: Whether one body is a half-space. Shape (K,). normals: Its normal, from the first body to the second.
            Shape (K, 3).
    """

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, members: list[int], kinds: tuple[int, int]) -> None:
        chosen = [[hulls[k] for k in pair[:2]] for pair in pairs[members]]
        self.has = np.zeros(len(pairs), dtype=bool)
        self.has[members] = True
        self.row = np.cumsum(self.has) - 1
        self._cores = []
        for side, kind in enumerate(kinds):
            cores, index = [pair[side].core for pair in chosen], np.arange(kind or 8)
            self._cores.append(np.array([core[np.minimum(index, len(core) - 1)] for core in cores]))  # of one length
        self._boxes = kinds[0] == 0, kinds[1] == 0
        self._frames = [np.array([pair[side].frame for pair in chosen]) for side in (0, 1)]
        self._observer = pairs[members, 2]
        self.radii = np.array([first.radius + second.radius for first, second in chosen])
        self.normals = np.array([_normal(*pair) for pair in chosen])
        self.flat = np.asarray(self.normals.any(axis=1))
        self._box_side = None if set(kinds) not in ({0, 1}, {1}) or self.flat.any() else kinds.index(min(kinds))
        if self._box_side is not None:
            corners = self._cores[self._box_side]
            has_edges = kinds[self._box_side] == 0
            edges = corners[:, [4, 2, 1]] - corners[:, :1] if has_edges else np.zeros((len(corners), 3, 3))
            lengths = np.linalg.norm(edges, axis=2)
            self._halves, self._centres = lengths / 2, corners.mean(axis=1)
            self._axes = np.where(lengths[:, :, None] > 0, edges / np.maximum(lengths, 1e-300)[:, :, None], np.eye(3))

    def points(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> list[np.ndarray]:
        """Return the points of both bodies of each pair in the pair's reference frame. Shapes (K, m, 3), (K, l, 3)."""
        rotations, positions = frames
        turn, origin = rotations[at, self._observer[row]], positions[at, self._observer[row]]
        points = []
        for core, frame in zip(self._cores, self._frames, strict=True):
            relative = np.swapaxes(rotations[at, frame[row]], 1, 2) @ turn
            shift = (positions[at, frame[row]] - origin)[:, None] @ turn
            points.append(core[row] @ relative + shift)
        return points

    def nearest(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return, for each pair, the unit vector from the first to the second body, the gap and the nearest points.

        Directions (unit vectors) and points are in the reference frame of the pair. Shapes (K, 3), (K,), m, and (K, 2,
        3), m.
        """
        first, second = self.points(frames, at, row)
        along, nearest_first, nearest_second = nearest_directions(first, second, self._boxes)
        along = np.where(self.flat[row, None], self.normals[row], along)
        gap = gap_along(along, first, second) - self.radii[row]
        return along, gap, np.stack([nearest_first, nearest_second], axis=1)

    def distances(self, frames: Frames, at: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the distances between the bodies of given pairs at given samples. Shape (K,), m.

        The distance of a ball from a box or from another ball is computed in closed form.
        """
        if self._box_side is None:
            return self.nearest(frames, at, row)[1]
        (rotations, positions), box, ball = frames, self._box_side, 1 - self._box_side
        frame, other = self._frames[ball][row], self._frames[box][row]
        point = (rotations[at, frame] @ self._cores[ball][row, 0, :, None])[..., 0] + positions[at, frame]
        if (other >= 0).any():
            point = ((point - positions[at, other])[:, None] @ rotations[at, other])[:, 0]
        local = (self._axes[row] @ (point - self._centres[row])[..., None])[..., 0]
        excess = np.abs(local) - self._halves[row]
        outside = np.maximum(excess, 0.0)
        outside *= outside
        return np.asarray(np.sqrt(outside.sum(axis=1)) + np.minimum(excess.max(axis=1), 0.0) - self.radii[row])

    def gaps(self, along: np.ndarray, frames: Frames, at: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the gap between the two bodies of each pair along a given unit vector. Shape (K,), m."""
        return np.asarray(gap_along(along, *self.points(frames, at, row)) - self.radii[row])


class CoveredPairs:
    """Pairs of bodies, and pairs of smaller shapes that cover some of the bodies and give sharper distance bounds.

    The covering pairs of a pair together contain its two bodies, so the smallest of their distances is a lower bound of
    the distance of the pair. The distance of the hulls is another lower bound; the larger bound counts. Unlike a hull,
    the covers of parts follow concavities.

    Attributes:
        rows: The n pairs, then the covering pairs, each observed from the frame of its pair. Shape (n + m, 3).
    """

    def __init__(self, pairs: np.ndarray, covers: Mapping[int, np.ndarray]) -> None:
        covering = [np.column_stack([rows, np.full(len(rows), pairs[pair, 2])]) for pair, rows in covers.items()]
        self.rows = np.concatenate([pairs, *covering]).astype(int)
        self._counts, self._first = np.zeros(len(pairs), dtype=int), np.zeros(len(pairs), dtype=int)
        for pair, rows in covers.items():
            self._first[pair] = len(pairs) + self._counts.sum()
            self._counts[pair] = len(rows)

    def of(self, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices (R,) into `pair` and `rows` of the given pairs, then of the covering pairs of their bodies.

        The index into `pair` of a covering pair is that of the given pair whose bodies it covers.
        """
        counts = self._counts[pair]
        place = np.repeat(np.arange(len(pair)), counts)
        own = np.arange(len(place)) - (np.cumsum(counts) - counts)[place]
        return np.concatenate([np.arange(len(pair)), place]), np.concatenate([pair, self._first[pair][place] + own])

    @staticmethod
    def decisive(place: np.ndarray, gap: np.ndarray, count: int) -> np.ndarray:
        """Return, for each pair of bodies, the index of the pair of shapes that determines its distance. Shape (K,).

        Args:
            place: First result of `of`. gap: Distances of the pairs of shapes. Shape (R,), m. count: Number K of pairs.
        """
        rows = np.arange(count)
        order = count + np.lexsort((gap[count:], place[count:]))
        nearest = order[np.unique(place[order], return_index=True)[1]]
        farther = nearest[gap[nearest] > gap[place[nearest]]]
        rows[place[farther]] = farther
        return rows


class SeparatingDirections(NamedTuple):
    """Directions of the shortest distance between the two bodies, or the two covering shapes, of each of R pairs.

    Attributes:
        place, row: From `CoveredPairs.of`. Shape (R,). along: Unit vectors from the first body to the second, in the
            frame of observation. Shape (R, 3).
    """

    place: np.ndarray
    row: np.ndarray
    along: np.ndarray

    def of(self, selected: np.ndarray) -> SeparatingDirections:
        """Return the separating directions of the pairs of bodies that a boolean mask of shape (K,) selects."""
        keep = selected[self.place]
        return SeparatingDirections((np.cumsum(selected) - 1)[self.place[keep]], self.row[keep], self.along[keep])


class BodyPairs:
    """Evaluator of the distances between pairs of bodies, each of which may be covered by several smaller shapes."""

    def __init__(self, hulls: Sequence[Hull], pairs: np.ndarray, covers: Mapping[int, np.ndarray]) -> None:
        self._covered = CoveredPairs(pairs, covers)
        self._kinds = group_pairs(hulls, self._covered.rows)
        self._first, self._second = pairs[:, 0], pairs[:, 1]
        self._frames = np.array([hull.frame for hull in hulls], dtype=int)
        self._middles = np.array([hull.middle for hull in hulls]).reshape(-1, 3)
        sizes = np.array([hull.size + hull.radius for hull in hulls])
        self._reach = sizes[self._first] + sizes[self._second]
        normals = [_normal(hulls[first], hulls[second]) for first, second in pairs[:, :2]]
        self._normals = np.array(normals).reshape(-1, 3)
        self._flat = np.asarray(self._normals.any(axis=1))

    def balls(self, frames: Frames, at: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """Return the gap between the bounding balls of the two bodies of each pair at a given sample. Shape (K,), m."""
        bodies = self._first[pair], self._second[pair]
        first, second = (self._in_world(frames, at, self._middles[k], self._frames[k]) for k in bodies)
        offset = second - first
        along_normal = (offset * self._normals[pair]).sum(axis=-1)
        return np.asarray(np.where(self._flat[pair], along_normal, np.linalg.norm(offset, axis=-1)) - self._reach[pair])

    def distances(self, frames: Frames, near: float = np.inf, pairs: Sequence[int] | None = None) -> np.ndarray:
        """Return the distances of all body pairs at all samples; those above `near` are lower bounds. Shape (M, n), m.

        With `pairs`, the indices of the only pairs that count, the distances of all others are infinite.
        """
        distances = self.all_balls(frames)
        count = distances.shape[1]
        excluded = np.setdiff1d(np.arange(count), np.arange(count) if pairs is None else pairs)
        distances[:, excluded] = np.inf
        at, pair = np.nonzero(~(distances >= near))
        distances[at, pair] = self.gaps(frames, at, pair, near)
        distances = np.where(np.isfinite(distances), distances, -np.inf)
        distances[:, excluded] = np.inf
        return distances

    def all_balls(self, frames: Frames) -> np.ndarray:
        """Return the gaps between the bounding balls of all pairs of bodies at all samples. Shape (M, n), m."""
        middles = self._in_world(frames, np.arange(len(frames.positions))[:, None], self._middles, self._frames)
        square, along_normal = np.zeros((2, len(middles), len(self._first)))
        for axis in range(3):  # one coordinate after the other: arrays of three columns are slow
            offset = middles[:, self._second, axis] - middles[:, self._first, axis]
            square += offset**2
            along_normal += offset * self._normals[:, axis]
        return np.asarray(np.where(self._flat, along_normal, np.sqrt(square)) - self._reach)

    def gaps(self, frames: Frames, at: np.ndarray, pair: np.ndarray, near: float | np.ndarray = np.inf) -> np.ndarray:
        """Return the distances of body pairs at given samples; those above `near` are lower bounds. Shape (K,), m."""
        place, row = self._covered.of(pair)
        gap, count = np.full(len(row), -np.inf), len(pair)

        def measure(subset: np.ndarray) -> None:
            for kind, chosen, own in self._by_kind(row[subset]):
                gap[subset[chosen]] = kind.distances(frames, at[place[subset[chosen]]], own)

        measure(np.arange(count, len(row)))
        covered = gap[self._covered.decisive(place, gap, count)]
        measure(np.flatnonzero(~(covered >= near)))  # hulls are costly: skip those whose covers are far enough apart
        return np.asarray(gap[self._covered.decisive(place, gap, count)])

    def nearest(
        self, frames: Frames, at: np.ndarray, pair: np.ndarray
    ) -> tuple[SeparatingDirections, np.ndarray, np.ndarray]:
        """Return separating directions, distances (K,), m, and closest points (K, 2, 3), m, of the uninflated hulls."""
        place, rows = self._covered.of(pair)
        along, gap, points = np.empty((len(rows), 3)), np.empty(len(rows)), np.empty((len(rows), 2, 3))
        for kind, chosen, row in self._by_kind(rows):
            along[chosen], gap[chosen], points[chosen] = kind.nearest(frames, at[place[chosen]], row)
        decisive = self._covered.decisive(place, gap, len(pair))
        return SeparatingDirections(place, rows, along), gap[decisive], points[decisive]

    def chords(self, facing: SeparatingDirections, frames: Frames, ends: Sequence[np.ndarray]) -> np.ndarray:
        """Return the smallest gap of each pair of bodies along a fixed direction over several samples. Shape (K,), m.

        The same row must separate the bodies at all samples; otherwise nothing follows for the times between.
        """
        gap = np.empty(len(facing.row))
        for kind, chosen, row in self._by_kind(facing.row):
            along, place = facing.along[chosen], facing.place[chosen]
            gap[chosen] = np.min([kind.gaps(along, frames, at[place], row) for at in ends], axis=0)
        return np.asarray(gap[self._covered.decisive(facing.place, gap, len(ends[0]))])

    @staticmethod
    def _in_world(frames: Frames, at: np.ndarray, points: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Transform points that are fixed in moving frames to world coordinates at given samples."""
        return np.asarray((frames.rotations[at, frame] @ points[..., None])[..., 0] + frames.positions[at, frame])

    def _by_kind(self, rows: np.ndarray) -> Iterator[tuple[HullPairs, np.ndarray, np.ndarray]]:
        """Yield each group of pairs with the same kinds of hulls, and its pairs' indices in `rows` and in the group."""
        for kind in self._kinds:
            chosen = np.flatnonzero(kind.has[rows])
            if chosen.size:
                yield kind, chosen, kind.row[rows[chosen]]


def group_pairs(hulls: Sequence[Hull], pairs: np.ndarray) -> list[HullPairs]:
    """Group pairs (n, 3) of bodies by the kinds of the hulls; a row has two bodies and a frame (-1: the world)."""
    kinds: dict[tuple[int, int], list[int]] = {}
    for i, (first, second, _) in enumerate(pairs):
        kinds.setdefault((hulls[first].kind, hulls[second].kind), []).append(i)
    return [HullPairs(hulls, pairs, members, kind) for kind, members in kinds.items()]


def frames_of(placements: np.ndarray) -> Frames:
    """Return the poses of F frames from samples (M, 12 F) of rotation matrices, column by column, and positions.

    The world is added as the last frame.
    """
    count = len(placements)
    world = np.broadcast_to(np.vstack([np.eye(3), np.zeros(3)]), (count, 1, 4, 3))
    values = np.concatenate([placements.reshape(count, placements.shape[1] // 12, 4, 3), world], axis=1)
    return Frames(np.swapaxes(values[:, :, :3], 2, 3), values[:, :, 3])


def _normal(first: Hull, second: Hull) -> np.ndarray:
    """Return a pair's half-space normal, directed from the first to the second body; zero if there is no half-space."""
    return first.normal if first.normal.size else -second.normal if second.normal.size else np.zeros(3)


WORLD = -1
"""Index of the world among the frames."""


@dataclass(frozen=True, eq=False)
class Separation:
    """Declaration of minimum distances between pairs of bodies, which the audit proves along the whole motion.

    Attributes:
        name: Unique among the constraints of a problem.
        placements: Poses of F frames in world, each as the rotation column by column, then the position; expressions of
            states and parameters, or of time and parameters. Shape (12 F, 1).
        hulls: The bodies, by name.
        pairs: Two indices of bodies in ``hulls``, and the index of the frame from which the relative motion is
            observed, -1 for the world. Shape (n, 3).
        least: Minimum distances. Shape (n,), m.
        movers: Names of the states that move the bodies, with their sizes.
        levers, turns: Bounds lever_k and turn_k of the relative motion, for the stacked states in ``movers``. Shape (n,
            k), in m and rad per unit of the state.
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
        pairs, assumed = index_rows(what, "pairs", self.pairs, 3), require.mapping(f"{what}: assumed", self.assumed)
        for reason in assumed.values():
            require.text(f"{what}: assumed", reason)
        set_fields(self, pairs=pairs, covers=_checked_covers(what, self.covers, len(pairs)), assumed=assumed)
        self._check_bodies(what)
        n, k = len(pairs), sum(self.movers.values())
        least = require.broadcast(f"{what}: least", self.least, n, "pairs")
        bounds = {
            label: require.array(f"{what}: {label}", getattr(self, label), (n, k), sign="nonnegative")
            for label in ("levers", "turns")
        }
        set_fields(self, least=least, **bounds)

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
        """Return the number of pairs of bodies."""
        return len(self.pairs)

    @property
    def bodies(self) -> tuple[Hull, ...]:
        """Hulls of all bodies of the separation constraint, in the order of their indices."""
        return tuple(self.hulls.values())

    @property
    def labels(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of each pair, in the order of the pairs."""
        names = tuple(self.hulls)
        return tuple((names[first], names[second]) for first, second, _ in self.pairs)

    def of(self, pairs: Sequence[int]) -> Separation:
        """Return the separation constraint of a subset of the pairs of bodies, given by their indices."""
        keep = list(pairs)
        parts = {label: getattr(self, label)[keep] for label in ("pairs", "least", "levers", "turns")}
        covers = {row: self.covers[pair] for row, pair in enumerate(keep) if pair in self.covers}
        return replace(self, covers=covers, **parts)


def _checked_covers(what: str, covers: Any, count: int) -> dict[int, np.ndarray]:
    """Check and return the pairs of bodies that together cover another pair, by the index of the covered pair."""
    covering: dict[int, np.ndarray] = {}
    for pair, rows in require.mapping(f"{what}: covers", covers, object).items():
        if isinstance(pair, bool) or not isinstance(pair, int | np.integer) or not 0 <= pair < count:
            words = f"{what}: covers: pair {pair!r} does not exist, there are {count}"
            raise ProblemError(words, name="covers", value=pair, limit=count)
        covering[int(pair)] = index_rows(what, "covers", rows, 2)
    return {pair: rows for pair, rows in covering.items() if len(rows)}


def index_rows(what: str, label: str, values: Any, count: int) -> np.ndarray:
    """Convert values to an integer array of shape (n, count); raise ProblemError if that is impossible."""
    array = table(f"{what}: {label}", values)
    shaped = array.size % count == 0 and (array.ndim != 2 or not array.size or array.shape[1] == count)
    if not shaped or not np.isfinite(array).all() or (array % 1 != 0).any():
        words = f"{what}: {label} must be rows of {count} indices, not {values!r}"
        raise ProblemError(words, name=label, value=values)
    return array.astype(int).reshape(-1, count)


def stack_motion_bounds(what: str, bounds: Mapping[str, Any], movers: Mapping[str, int], count: int) -> np.ndarray:
    """Return bounds of the relative displacement of pairs of bodies per unit change of each state. Shape (n, k).

    A state for which `bounds` has no entry has the bound 0.

    Args:
        movers: Size of each state that moves a body. count: Number of pairs.
    """
    columns = [table(what, bounds.get(state, np.zeros((count, size)))) for state, size in movers.items()]
    return np.hstack([np.zeros((count, 0)), *(np.reshape(column, (count, -1)) for column in columns)])
