"""All postures that do a task at some instants, covered by charts: boxes in tangent spaces of the set of solutions.

Where a task leaves r of n joints free, the postures that do it at one time form curves (r = 1), surfaces (r = 2) or lie
apart (r = 0). A chart is a posture, the r directions in which it can move without moving the tip, and how far a box of
such moves stays near the set. The set is covered from the solutions of inverse kinematics at all instants: wherever the
edge of a chart lies in no other chart, the next one is put there, until the union of the charts has no edge but at the
joints' limits (Henderson 2002, Multiple parameter continuation, Int. J. Bifurcation and Chaos 12). Curves so are found
whole, folds and branches that meet are nothing special, and no angle has to be chosen to list them by.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.errors import ProblemError
from ocp.motion.local.branches import IkBranches, ik_branches
from ocp.motion.local.inverse_kinematics import Unreachable, inverse_kinematics_at
from ocp.motion.search.joint_space import TOLERANCE, JointSpace
from ocp.motion.tasks.equations import TaskEquations
from ocp.problem.values import Sampler
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["ChartSettings", "Charts", "Instant", "Parts", "SelfMotions", "point"]

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class ChartSettings:
    """How sets of postures are covered.

    Attributes:
        corrections: Newton steps at most; from a tangent space a few are enough.
        beyond: Share of its radius by which a chart is put beyond the edge that it is to cover: neighbours overlap by
            the rest.
        bent: Share of its radius by which the set may leave a chart at its edge, by the directions that are free; the
            radius is halved until it does not. Of two directions half as much takes two to three times as long, and
            twice as much loses bounds.
        halvings: Of the radius, at most: nearer to singular postures the cover ends.
        listed: Places of what is free at which closed forms list all postures of an instant.
        starts: Random starts of inverse kinematics at an instant.
        neighbours: Charts in which a point of an edge is looked for.
    """

    corrections: int = 12
    beyond: float = 0.9
    bent: tuple[float, float, float] = (0.1, 0.1, 0.15)
    halvings: int = 7
    listed: int = 64
    starts: int = 16
    neighbours: int = 12


@dataclass(frozen=True, eq=False)
class Charts:
    """Parts of the set of postures, of some instants.

    Attributes:
        layer: Number of the instant. Shape (N,).
        centers: Postures, rad or m. Shape (N, n).
        tangents: Directions that keep the tip where it is, orthonormal in the metric. Shape (N, n, r).
        radii: Half widths of the boxes, in the metric. Shape (N,).
        low, high: Ends of the boxes, nearer where the joints' limits are. Shape (N, r).
        strays: From the corners of the box, and the middles of its sides, to the set. Shape (N, c, n).
    """

    layer: Indices
    centers: Array
    tangents: Array
    radii: Array
    low: Array
    high: Array
    strays: Array

    def __len__(self) -> int:
        return len(self.layer)

    def of(self, chosen: Any) -> Charts:
        """Some of them."""
        return Charts(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    @property
    def spans(self) -> Array:
        """How far the boxes reach from their centres, by joints. Shape (N, n)."""
        reach = np.maximum(np.abs(self.low), np.abs(self.high))
        return np.asarray((np.abs(self.tangents) * reach[:, None]).sum(axis=2) + self.most_stray)

    @property
    def most_stray(self) -> Array:
        """How far the set leaves the boxes, by joints. Shape (N, n)."""
        return np.asarray(np.abs(self.strays).max(axis=1, initial=0.0))

    def bent(self) -> tuple[Array, Array]:
        """How the set leaves the boxes: the quadratic form nearest to that, (N, n, r, r), and the rest, (N, c, n)."""
        r = self.tangents.shape[2]
        rim, count = _rim(r), self.strays.shape[1]
        rows, columns = np.triu_indices(r)
        terms = rim[:, rows] * rim[:, columns] * np.where(rows == columns, 0.5, 1.0)
        bends = np.zeros((*self.tangents.shape, r))
        if not r or not count:
            return bends, self.strays
        found = np.einsum("tc,kcn->knt", np.linalg.pinv(terms), self.strays)
        bends[:, :, rows, columns] = bends[:, :, columns, rows] = found / self.radii[:, None, None] ** 2
        return bends, self.strays - np.einsum("ct,knt->kcn", terms, found)


def point(joints: Array) -> Charts:
    """The chart of a posture (n,) alone."""
    n, none = len(joints), np.zeros((1, 0))
    strays = np.zeros((1, 0, n))
    return Charts(np.zeros(1, dtype=np.intp), joints[None], np.zeros((1, n, 0)), np.zeros(1), none, none, strays)


def together(parts: list[Charts]) -> Charts:
    """One after the other."""
    return Charts(*(np.concatenate([getattr(part, name) for part in parts]) for name in Charts.__dataclass_fields__))


class Parts(NamedTuple):
    """Charts of half the radius.

    Attributes:
        charts: N of them. owners: Whose parts they are. Shape (N,). low, high: Ends of the part. Shape (N, r).
    """

    charts: Charts
    owners: Indices
    low: Array
    high: Array


class _Edges(NamedTuple):
    """Points at the edges of charts.

    Attributes:
        layer: Shape (E,). points: On the set. Shape (E, n). ways: Unit vectors away from the chart. Shape (E, n).
        owners: Charts that they belong to. Shape (E,). radii: Of the charts to be put there. Shape (E,).
    """

    layer: Indices
    points: Array
    ways: Array
    owners: Indices
    radii: Array

    def of(self, chosen: Any) -> _Edges:
        return _Edges(*(part[chosen] for part in self))


class SelfMotions:
    """The sets of postures that do a task at some instants.

    Attributes:
        space: Where they lie.
        size: How many directions are free in a regular posture.
        lost: Edges of charts beyond which nothing was found, near singular postures.
    """

    def __init__(
        self, space: JointSpace, equations: TaskEquations, targets: Array, settings: ChartSettings = ChartSettings()
    ) -> None:
        """
        Args:
            space: Of the machine's joints, which stands on a fixed base.
            equations: Of poses.
            targets: Of the equations at each instant. Shape (K, size).
            settings: How they are covered.
        """
        self.settings = settings
        self.space, self.equations, self.targets = space, equations, targets
        n = equations.machine.joint_size
        self.size, self.lost = n - equations.size, 0
        q, wanted, none = ca.SX.sym("q", n), ca.SX.sym("wanted", targets.shape[1]), ca.SX(0, 1)
        parts = [equations.error(none, q, wanted), equations.jacobian(none, q)]
        self._sampler = Sampler([q, wanted], parts)

    # ---- postures ------------------------------------------------------------------------------------------------

    @cached_property
    def _branches(self) -> IkBranches | None:
        return ik_branches(self.equations, self.space.lower, self.space.upper)

    def seeds(self, number: int, limits: Any, seed: int) -> Array:
        """Postures of an instant within limits, of as many parts of the set as are found. Shape (K, n).

        Some of every branch by closed forms, and those of inverse kinematics from random starts.

        Raises:
            Unreachable: None is found.
        """
        listed, count = np.zeros((0, len(self.space.scale))), self.settings.listed
        if self._branches is not None:
            found = self._branches.solutions(self.targets[number], count, count * number)
            on, good = self.corrected(np.full(len(found), number), found)
            listed = on[good & self.space.within(on)]
        told: dict[str, Any] = {"limits": limits, "seed": seed, "starts": self.settings.starts}
        try:
            sought = [one.joints for one in inverse_kinematics_at(self.equations, self.targets[number], **told)]
        except Unreachable:
            if not len(listed):
                raise
            sought = []
        return np.vstack([listed, *sought])

    def linearised(self, layer: Indices, joints: Array) -> tuple[Array, Array]:
        """What the tasks miss (M, m), and their Jacobian by joints of the metric (M, m, n)."""
        error, jacobian = self._sampler(joints, self.targets[layer])
        m, n = error.shape[1], joints.shape[1]
        return error, jacobian.reshape(-1, n, m).transpose(0, 2, 1) / self.space.scale

    def corrected(self, layer: Indices, joints: Array) -> tuple[Array, NDArray[np.bool_]]:
        """The nearest postures that do the task, by Newton's method, shape (M, n), and whether they do. Shape (M,)."""
        found = joints.copy()
        good = np.zeros(len(found), dtype=bool)
        busy = np.arange(len(found))
        for _ in range(self.settings.corrections):
            if not busy.size:
                break
            error, jacobian = self.linearised(layer[busy], found[busy])
            worst = np.abs(error).max(axis=1, initial=0.0)
            done = worst < TOLERANCE
            good[busy[done]] = True
            on = ~done & np.isfinite(worst)
            busy, error, jacobian = busy[on], error[on], jacobian[on]
            if busy.size:
                step = np.einsum("kmn,km->kn", jacobian, _solved(jacobian @ jacobian.transpose(0, 2, 1), error))
                found[busy] += np.clip(step, -1.0, 1.0) / self.space.scale
        return found, good

    def tangents_at(self, layer: Indices, joints: Array, like: Array | None = None) -> Array:
        """Directions that keep the tips where they are, orthonormal in the metric, turned as others are.

        Args:
            joints: Shape (M, n). like: Directions to be near to, shape (M, n, r).
        """
        _, jacobian = self.linearised(layer, joints)
        r = self.size if like is None else like.shape[2]
        _, _, rows = np.linalg.svd(jacobian, full_matrices=True)
        free = rows[:, rows.shape[1] - r :].transpose(0, 2, 1)
        if like is not None and r:
            left, _, right = np.linalg.svd(free.transpose(0, 2, 1) @ (like * self.space.scale[:, None]))
            free = free @ (left @ right)
        return np.asarray(free / self.space.scale[:, None])

    # ---- charts --------------------------------------------------------------------------------------------------

    def at(self, layer: Indices, joints: Array, radii: Array, like: Array | None = None) -> tuple[Charts, Array]:
        """Charts about postures, their radii halved until the set stays near, and where it is at their rims.

        Returns:
            The charts, and the points of the set at the rims, shape (N, c, n), nan where none was found.
        """
        tangents = self.tangents_at(layer, joints, like)
        rim = _rim(tangents.shape[2])
        radii = radii.copy()
        strays = np.zeros((len(joints), len(rim), joints.shape[1]))
        points = np.full_like(strays, np.nan)
        busy = np.arange(len(joints))
        for halving in range(self.settings.halvings + 1):
            if not busy.size:
                break
            on, apart = self._strays(layer[busy], joints[busy], tangents[busy], radii[busy])
            points[busy], strays[busy] = on, apart
            far = ~(self.space.length(apart) <= self.settings.bent[tangents.shape[2]] * radii[busy, None]).all(axis=1)
            if halving < self.settings.halvings:
                radii[busy[far]] /= 2
            busy = busy[far]
        return self._within(layer, joints, tangents, radii, strays), points

    def _within(self, layer: Indices, joints: Array, tangents: Array, radii: Array, strays: Array) -> Charts:
        """Charts, their boxes cut where no posture of theirs is within the joints' limits."""
        strays = np.nan_to_num(strays)
        stray = np.abs(strays).max(axis=1, initial=0.0)
        reach = np.abs(tangents) * radii[:, None, None]
        others = reach.sum(axis=2)[:, :, None] - reach
        up, down = self.space.upper - joints + stray, joints - self.space.lower + stray
        room = np.stack([up, down])[:, :, :, None] + others
        room[(room < 0) & (room >= -TOLERANCE)] = 0.0  # a joint that is held at its limit is there up to rounding
        with np.errstate(divide="ignore", invalid="ignore"):
            far = room / np.abs(tangents)
        far[np.isnan(far)] = np.inf
        rising, limit = tangents > 0, radii[:, None]
        high = np.where(rising, far[0], far[1]).min(axis=1).clip(-2 * limit, limit)
        low = np.where(rising, far[1], far[0]).min(axis=1).clip(-2 * limit, limit)
        return Charts(layer, joints, tangents, radii, -low, high, strays)

    def _strays(self, layer: Indices, joints: Array, tangents: Array, radii: Array) -> tuple[Array, Array]:
        """Points of the set at the rims of boxes, nan where there are none, and how far they are from these."""
        rim = _rim(tangents.shape[2])
        flat = joints[:, None] + radii[:, None, None] * np.einsum("knr,cr->kcn", tangents, rim)
        on, good = self.corrected(np.repeat(layer, len(rim)), flat.reshape(-1, joints.shape[1]))
        on = np.where(good[:, None], on, np.nan).reshape(flat.shape)
        return on, on - flat

    def inside(self, charts: Charts) -> NDArray[np.bool_]:
        """Which charts have a part within the joints' limits. Shape (N,)."""
        low, high = charts.centers - charts.spans, charts.centers + charts.spans
        reached = ((high >= self.space.lower) & (low <= self.space.upper)).all(axis=1)
        return np.asarray(reached & (charts.low <= charts.high).all(axis=1))

    def cover(self, layer: Indices, joints: Array, radius: float, most: int) -> Charts:
        """Charts of all that is connected with some postures, at their instants or from one instant to the next.

        Args:
            layer, joints: The postures, which do their tasks. Shapes (M,), (M, n).
            radius: Of the charts, at most.
            most: Charts, beyond which the set is too large.

        Raises:
            ProblemError: There are more.
        """
        charts, left = None, np.arange(len(layer))
        while charts is None or left.size:
            # one of each instant, and of what has not grown from it another one
            _, first = np.unique(layer[left], return_index=True)
            charts = self._grown(charts, layer[left[first]], joints[left[first]], radius, most)
            left = np.delete(left, first)
            left = left[~self.covered(charts, layer[left], joints[left])]
        last, new = len(self.targets) - 1, charts
        while len(new):
            layer = np.concatenate([new.layer - 1, new.layer + 1])
            within = np.flatnonzero((layer >= 0) & (layer <= last))
            there, good = self.corrected(layer[within], np.tile(new.centers, (2, 1))[within])
            good &= self.space.within(there)
            layer, there = layer[within][good], there[good]
            fresh = ~self.covered(charts, layer, there)
            before = len(charts)
            charts = self._grown(charts, layer[fresh], there[fresh], radius, most)
            new = charts.of(slice(before, None))
        return charts

    def _grown(self, known: Charts | None, layer: Indices, joints: Array, radius: float, most: int) -> Charts:
        """The charts that are known, and those of all that is connected with some postures at their instants."""
        number = 0 if known is None else len(known)
        charts, edges = self._begun(layer, joints, np.full(len(layer), radius), None, number)
        charts = charts if known is None else together([known, charts])
        edges = edges.of(~self.covered(charts, edges.layer, edges.points, edges.owners))
        while len(edges.layer):
            beyond = edges.points + self.settings.beyond * edges.radii[:, None] * edges.ways
            joints, good = self.corrected(edges.layer, beyond)
            shift = self.space.length(joints - beyond)
            good &= shift <= 2 * self.settings.bent[charts.tangents.shape[2]] * edges.radii
            chosen = np.flatnonzero(good)
            chosen = chosen[self._apart(edges.layer[chosen], joints[chosen], edges.radii[chosen])]
            like = charts.tangents[edges.owners[chosen]]
            new, ends = self._begun(
                edges.layer[chosen], joints[chosen], np.minimum(2 * edges.radii[chosen], radius), like, len(charts)
            )
            tight = edges.radii / 2  # of what is not covered by these: nearer by
            charts = together([charts, new])
            if len(charts) > most:
                words = (
                    f"more than {most} charts of {radius:.3g} rad cover the postures that do the task; "
                    "take larger ones, or fewer instants"
                )
                raise ProblemError(words, name="postures", value=len(charts), limit=most)
            kept = edges._replace(radii=tight)
            narrow = tight < radius / 2**self.settings.halvings
            self.lost += int(narrow.sum())
            kept = kept.of(~narrow)
            edges = _Edges(*(np.concatenate(pair) for pair in zip(kept, ends, strict=True)))
            edges = edges.of(~self.covered(charts, edges.layer, edges.points, edges.owners))
        return charts

    def parts(self, charts: Charts) -> Parts:
        """Charts of half the radius in their place, and what of these they are."""
        r = charts.tangents.shape[2]
        signs = np.array(list(product((-0.5, 0.5), repeat=r))).reshape(2**r, r)
        flat = charts.centers[:, None] + charts.radii[:, None, None] * np.einsum("knr,cr->kcn", charts.tangents, signs)
        shape = flat.shape
        layer = np.repeat(charts.layer, shape[1])
        joints, good = self.corrected(layer, flat.reshape(-1, shape[2]))
        like = np.repeat(charts.tangents, shape[1], axis=0)
        radii = self._half(charts, signs)
        whole = good.reshape(shape[:2]).all(axis=1)
        part = np.flatnonzero(np.repeat(whole, shape[1]))
        layer, joints, radii = layer[part], joints[part], radii[part]
        tangents = self.tangents_at(layer, joints, like[part])
        strays = self._strays(layer, joints, tangents, radii)[1]
        new = self._within(layer, joints, tangents, radii, strays)
        inside, rest = self.inside(new), np.flatnonzero(~whole)
        owners = np.append((part // max(shape[1], 1))[inside], rest)
        sides = np.vstack([signs[part % shape[1]][inside], np.zeros((len(rest), r))])
        ends = charts.low[owners], charts.high[owners]
        low = np.where(sides > 0, np.maximum(ends[0], 0.0), ends[0])
        high = np.where(sides < 0, np.minimum(ends[1], 0.0), ends[1])
        none = low > high  # of a box that ends before: what is there belongs to its other side
        low, high = np.where(none, ends[0], low), np.where(none, ends[1], high)
        return Parts(together([new.of(inside), charts.of(rest)]), owners, low, high)

    def _half(self, charts: Charts, signs: Array) -> Array:
        """Radii of the parts of charts, of middles at signs (c, r) of their boxes. Shape (N c,).

        Beside the middle of a part, where the set leaves the chart by Ds, a shift u in the chart is one by
        (1 + Ds' Ds)^1/2 u in the part, whose axes are turned as little as may be, and Ds' of what the set bends within
        it; beyond that, what it strays from the quadratic form.
        """
        r = charts.tangents.shape[2]
        bends, rest = charts.bent()
        slopes = np.einsum("knab,cb->kcna", bends * self.space.scale[:, None, None], signs)
        lean = charts.radii[:, None] * np.sqrt((slopes**2).sum(axis=(2, 3)))
        longer = 1 + np.sqrt(max(r, 1)) * (np.sqrt(1 + lean**2) - 1)
        bent = self.space.length(charts.strays - rest).max(axis=1, initial=0.0) / 4
        strays = self.space.length(rest).max(axis=1, initial=0.0)
        return np.asarray(charts.radii[:, None] / 2 * longer + lean * bent[:, None] + strays[:, None]).ravel()

    def covered(self, charts: Charts, layer: Indices, joints: Array, but: Indices | None = None) -> NDArray[np.bool_]:
        """Whether postures lie in charts; of edges, in others `but` their own. Shape (M,)."""
        if not len(layer) or not len(charts):
            return np.zeros(len(layer), dtype=bool)
        r = charts.tangents.shape[2]
        within = 2 * float(charts.radii.max()) * np.sqrt(max(r, 1)) + 1e-6
        tree = self.space.tree(charts.centers, charts.layer)
        count = min(self.settings.neighbours * 2 ** max(r - 1, 0), len(charts))
        _, near = tree.query(self.space.placed(joints, layer), k=count, distance_upper_bound=within)
        near = np.reshape(near, (len(layer), -1))
        found = np.zeros(len(layer), dtype=bool)
        for column in near.T:
            rows = np.flatnonzero((column < len(charts)) & ~found)
            if but is not None:
                rows = rows[column[rows] != but[rows]]
            which = column[rows]
            apart = self.space.difference(joints[rows], charts.centers[which]) * self.space.scale
            flat = np.einsum("kn,knr->kr", apart, charts.tangents[which] * self.space.scale[:, None])
            normal = np.sqrt(np.maximum((apart**2).sum(axis=1) - (flat**2).sum(axis=1), 0.0))
            radii = charts.radii[which]
            near = normal <= 2 * self.settings.bent[r] * radii + 1e-6
            found[rows] = near & (np.abs(flat) <= radii[:, None] * (1 + 1e-9)).all(axis=1)
        return found

    def _apart(self, layer: Indices, joints: Array, radii: Array) -> Indices:
        """Of postures to put charts at, those that are not within the radius of one before."""
        if not len(layer):
            return np.zeros(0, dtype=np.intp)
        tree = self.space.tree(joints, layer)
        pairs = tree.query_pairs(float(radii.max()), output_type="ndarray")
        kept = np.ones(len(layer), dtype=bool)
        if len(pairs):
            far = self.space.length(self.space.difference(joints[pairs[:, 0]], joints[pairs[:, 1]]))
            pairs = pairs[far < np.minimum(radii[pairs[:, 0]], radii[pairs[:, 1]])]
            for one, other in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
                if kept[one]:
                    kept[other] = False
        return np.flatnonzero(kept)

    def _begun(
        self, layer: Indices, joints: Array, radii: Array, like: Array | None, number: int = 0
    ) -> tuple[Charts, _Edges]:
        """Charts about postures, and the points of their edges within limits; the first one has the given number."""
        if like is None:
            kept = self._apart(layer, joints, radii)
            layer, joints, radii = layer[kept], joints[kept], radii[kept]
        charts, points = self.at(layer, joints, radii, like)
        good = self.inside(charts)
        charts, points = charts.of(good), points[good]
        owner, side = np.nonzero(self.space.within(points))
        ways = np.einsum("enr,er->en", charts.tangents[owner], _rim(charts.tangents.shape[2])[side])
        return charts, _Edges(charts.layer[owner], points[owner, side], ways, number + owner, charts.radii[owner])


class Instant(NamedTuple):
    """Which set of postures of whose."""

    sets: SelfMotions
    number: int


def _rim(r: int) -> Array:
    """Places at the rim of a box of half width 1: the middles of its sides, and its corners. Shape (c, r)."""
    middles = [side * np.eye(r)[axis] for axis in range(r) for side in (-1.0, 1.0)] if r > 1 else []
    corners = [np.array(signs) for signs in product((-1.0, 1.0), repeat=r)] if r else []
    found = [*middles, *corners]
    return np.array(found).reshape(len(found), r)


def _solved(square: Array, right: Array) -> Array:
    """Solutions (K, m) of normal equations (K, m, m), those that are singular softened."""
    m = square.shape[1]
    if not m:
        return right
    size = np.trace(square, axis1=1, axis2=2)[:, None, None]
    soft = ROUNDING_SHARE**2 * size + np.finfo(float).tiny
    return np.asarray(np.linalg.solve(square + soft * np.eye(m), right[:, :, None])[:, :, 0])
