"""Atlas of the self-motion manifold: charts that cover all configurations which satisfy a task at given time samples.

If a task leaves r of n degrees of freedom undetermined, the configurations that satisfy it at one time form curves
(r = 1), surfaces (r = 2) or isolated points (r = 0). A chart consists of a configuration (its centre), an orthonormal
basis of the tangent space there (the self-motions), and a box in this tangent space, which is near the manifold.

The atlas grows from the solutions of inverse kinematics at all time samples. Wherever the edge of a chart lies in no
other chart, a further chart is added, until the charts have no edge except at the joint limits (Henderson 2002, Int.
J. Bifurcation and Chaos 12). Components are covered completely, also at folds and bifurcations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import ProblemError
from ocp.motion.local.ik_solver import IkBranches, ik_branches
from ocp.motion.local.inverse_kinematics import IkOptions, Unreachable, inverse_kinematics_at
from ocp.motion.search.joint_space import TOLERANCE, JointSpace
from ocp.motion.tasks.equations import TaskEquations
from ocp.problem.values import Sampler
from ocp.tolerances import ROUNDING_SHARE

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class ChartSettings:
    """Settings of the atlas of charts that covers a self-motion manifold.

    Attributes:
        corrections: Largest number of Newton steps of a projection onto the manifold.
        spacing: Distance of a chart's centre from the edge that it covers, relative to its radius; the rest is overlap.
        flatness: Largest distance of the manifold from a chart, relative to its radius, by its dimension. For surfaces,
            half the value takes two to three times as long, and twice the value loses some cost bounds.
        halvings: Largest number of halvings of the radius; the more, the closer the atlas gets to singularities.
        listed: Number of samples of the free parameters at which a solver lists the configurations on all branches.
        starts: Number of random starts of inverse kinematics at a time sample.
        neighbours: Number of nearest charts that are tested for whether they cover a configuration.
    """

    corrections: int = 12
    spacing: float = 0.9
    flatness: tuple[float, float, float, float] = (0.1, 0.1, 0.15, 0.15)
    halvings: int = 7
    listed: int = 64
    starts: int = 16
    neighbours: int = 12


@dataclass(frozen=True, eq=False)
class Charts:
    """Charts of the self-motion manifolds at given time samples; each chart is a box in the tangent space at a point.

    Attributes:
        layer: Index of the time sample. Shape (N,).
        centers: Configurations on the manifold, rad or m. Shape (N, n).
        tangents: Basis of the tangent space, orthonormal in the metric. Shape (N, n, r).
        radii: Half widths of the boxes, in the metric. Shape (N,).
        low, high: Ends of the boxes, cut where the joint limits are nearer. Shape (N, r).
        deviations: Vectors to the manifold from the c points of `_rim` on each box. Shape (N, c, n).
    """

    layer: Indices
    centers: Array
    tangents: Array
    radii: Array
    low: Array
    high: Array
    deviations: Array

    def __len__(self) -> int:
        return len(self.layer)

    def select(self, chosen: Any) -> Charts:
        """Return those charts of the self-motion manifolds that have the given indices."""
        return Charts(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    @property
    def spans(self) -> Array:
        """Largest displacement of each joint from the centre of a chart to a point in the chart. Shape (N, n)."""
        reach = np.maximum(np.abs(self.low), np.abs(self.high))
        return np.asarray((np.abs(self.tangents) * reach[:, None]).sum(axis=2) + self.max_deviation)

    @property
    def max_deviation(self) -> Array:
        """Largest deviation of the manifold from the tangent box of each chart, for each joint. Shape (N, n)."""
        return np.asarray(np.abs(self.deviations).max(axis=1, initial=0.0))

    def points(self, places: Array) -> Array:
        """Return the points (N, n) of the charts' tangent spaces that have given chart coordinates (N, r)."""
        return np.asarray(self.centers + np.einsum("knr,kr->kn", self.tangents, places))

    def curvature(self) -> tuple[Array, Array]:
        """Fit quadratic forms in chart coordinates, by least squares, to the deviations of the manifold from charts.

        Returns:
            The forms, (N, n, r, r), and their residuals at the points of `_rim`, (N, c, n).
        """
        r = self.tangents.shape[2]
        rim, count = _rim(r), self.deviations.shape[1]
        rows, columns = np.triu_indices(r)
        terms = rim[:, rows] * rim[:, columns] * np.where(rows == columns, 0.5, 1.0)
        form = np.zeros((*self.tangents.shape, r))
        if not r or not count:
            return form, self.deviations
        coefficients = np.einsum("tc,kcn->knt", np.linalg.pinv(terms), self.deviations)
        form[:, :, rows, columns] = form[:, :, columns, rows] = coefficients / self.radii[:, None, None] ** 2
        return form, self.deviations - np.einsum("ct,knt->kcn", terms, coefficients)


def point_chart(joints: Array) -> Charts:
    """Return a chart of dimension 0, which contains only the configuration `joints` of shape (n,)."""
    n, empty = len(joints), np.zeros((1, 0))
    deviations = np.zeros((1, 0, n))
    return Charts(np.zeros(1, dtype=np.intp), joints[None], np.zeros((1, n, 0)), np.zeros(1), empty, empty, deviations)


def concatenate(parts: list[Charts]) -> Charts:
    """Concatenate several sets of charts of the self-motion manifolds."""
    return Charts(*(np.concatenate([getattr(part, name) for part in parts]) for name in Charts.__dataclass_fields__))


class SplitCharts(NamedTuple):
    """Charts of half the radius on a self-motion manifold, with the indices of the charts that they replace.

    Attributes:
        charts, owners: N charts, and the indices of the charts that they replace, (N,).
        low, high: Ends of the part that each of them replaces in the box of the larger chart. Shape (N, r).
    """

    charts: Charts
    owners: Indices
    low: Array
    high: Array


class _Edges(NamedTuple):
    """Points of the manifold at the edges of charts, from which the search for further charts continues.

    Attributes:
        layer, owners: Indices of the time samples and of the charts. Shape (E,).
        points: Configurations. Shape (E, n).
        directions: Unit vectors that lead away from the chart. Shape (E, n).
        radii: Radii of the charts that are to cover these points. Shape (E,).
    """

    layer: Indices
    points: Array
    directions: Array
    owners: Indices
    radii: Array

    def select(self, chosen: Any) -> _Edges:
        return _Edges(*(part[chosen] for part in self))


class SelfMotionManifolds:
    """Self-motion manifolds of a task, one at each of the given time samples.

    Attributes:
        space: Joint space.
        size: Dimension r of the manifold at a regular configuration.
        lost: Number of chart edges beyond which no chart was found, close to singular configurations.
    """

    def __init__(
        self, space: JointSpace, equations: TaskEquations, targets: Array, settings: ChartSettings = ChartSettings()
    ) -> None:
        """Prepare the task equations that define the manifolds at all time samples.

        Args:
            space: Joint space of a machine on a fixed base.
            equations: Equations of pose tasks.
            targets: Targets of the equations at each time sample. Shape (K, size).
            settings: Settings of the atlas.
        """
        self.settings = settings
        self.space, self.equations, self.targets = space, equations, targets
        n = equations.machine.joint_size
        self.size, self.lost = n - equations.size, 0
        q, target, base = ca.SX.sym("q", n), ca.SX.sym("wanted", targets.shape[1]), ca.SX(0, 1)
        outputs = [equations.error(base, q, target), equations.jacobian(base, q)]
        self._sampler = Sampler([q, target], outputs)

    # ---- configurations ----------------------------------------------------------------------------------------------

    @cached_property
    def _branches(self) -> IkBranches | None:
        return ik_branches(self.equations, self.space.lower, self.space.upper)

    def seeds(self, index: int, limits: Any, seed: int) -> Array:
        """Return configurations that satisfy the task at a time sample, if possible on every component of the manifold.

        Shape (K, n), within limits. A solver lists some of every branch. Random starts add others unless all are known.

        Raises:
            Unreachable: No configuration was found.
        """
        listed, count = np.zeros((0, len(self.space.scale))), self.settings.listed
        if self._branches is not None:
            solutions = self._branches.configurations(self.targets[index], count, count * index)
            projected, good = self.project(np.full(len(solutions), index), solutions.joints)
            listed = projected[good & self.space.within(projected)]
            if len(listed) and solutions.complete.all():
                return listed
        options: dict[str, Any] = {"options": IkOptions(limits=limits), "seed": seed, "starts": self.settings.starts}
        try:
            random = inverse_kinematics_at(self.equations, self.targets[index], **options)
        except Unreachable:
            if not len(listed):
                raise
            random = []
        return np.vstack([listed, *(solution.joints for solution in random)])

    def linearize(self, layer: Indices, joints: Array) -> tuple[Array, Array]:
        """Return the task errors (M, m), and their Jacobians (M, m, n) with respect to the scaled joint positions."""
        error, jacobian = self._sampler(joints, self.targets[layer])
        m, n = error.shape[1], joints.shape[1]
        return error, jacobian.reshape(-1, n, m).transpose(0, 2, 1) / self.space.scale

    def project(self, layer: Indices, joints: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Project configurations (M, n) onto the manifolds by Newton steps; also return a mask of convergence (M,)."""
        projected, converged = joints.copy(), np.zeros(len(joints), dtype=bool)
        active = np.arange(len(joints))
        for _ in range(self.settings.corrections):
            if not active.size:
                break
            error, jacobian = self.linearize(layer[active], projected[active])
            error_size = np.abs(error).max(axis=1, initial=0.0)
            done = error_size < TOLERANCE
            converged[active[done]] = True
            active, error, jacobian = (part[~done & np.isfinite(error_size)] for part in (active, error, jacobian))
            if active.size:
                solved = _solve_normal_equations(jacobian @ jacobian.transpose(0, 2, 1), error)
                step = np.einsum("kmn,km->kn", jacobian, solved)
                projected[active] += np.clip(step, -1.0, 1.0) / self.space.scale
        return projected, converged

    def tangents_at(self, layer: Indices, joints: Array, like: Array | None = None) -> Array:
        """Return bases (M, n, r) of tangent spaces at configurations (M, n), orthonormal in the joint-space metric.

        Args:
            like: Bases to which the returned ones are aligned as closely as possible. Shape (M, n, r).
        """
        _, jacobian = self.linearize(layer, joints)
        r = self.size if like is None else like.shape[2]
        _, _, right_vectors = np.linalg.svd(jacobian, full_matrices=True)
        null = right_vectors[:, right_vectors.shape[1] - r :].transpose(0, 2, 1)
        if like is not None and r:
            left, _, right = np.linalg.svd(null.transpose(0, 2, 1) @ (like * self.space.scale[:, None]))
            null = null @ (left @ right)
        return np.asarray(null / self.space.scale[:, None])

    # ---- charts ------------------------------------------------------------------------------------------------------

    def charts_at(self, layer: Indices, joints: Array, radii: Array, like: Array | None = None) -> tuple[Charts, Array]:
        """Return charts with given centres; each radius is halved until the manifold is nearly flat in the chart.

        Returns:
            The charts, and the points of the manifold at their rims, nan where none was found. Shape (N, c, n).
        """
        tangents = self.tangents_at(layer, joints, like)
        radii, rim_size = radii.copy(), len(_rim(tangents.shape[2]))
        deviations = np.zeros((len(joints), rim_size, joints.shape[1]))
        points = np.full_like(deviations, np.nan)
        active = np.arange(len(joints))
        for halving in range(self.settings.halvings + 1):
            if not active.size:
                break
            box = layer[active], joints[active], tangents[active], radii[active]
            points[active], deviations[active] = self._deviations(*box)
            largest = self.settings.flatness[tangents.shape[2]] * radii[active, None]
            curved = ~(self.space.length(deviations[active]) <= largest).all(axis=1)
            if halving < self.settings.halvings:
                radii[active[curved]] /= 2
            active = active[curved]
        return self._clip_boxes(layer, joints, tangents, radii, deviations), points

    def _clip_boxes(self, layer: Indices, joints: Array, tangents: Array, radii: Array, deviations: Array) -> Charts:
        """Return charts with given centres and radii, whose boxes are shrunk if they exceed the joint limits."""
        deviations = np.nan_to_num(deviations)
        max_deviation = np.abs(deviations).max(axis=1, initial=0.0)
        reach = np.abs(tangents) * radii[:, None, None]
        other_axes = reach.sum(axis=2)[:, :, None] - reach
        above, below = self.space.upper - joints + max_deviation, joints - self.space.lower + max_deviation
        margin = np.stack([above, below])[:, :, :, None] + other_axes
        margin[(margin < 0) & (margin >= -TOLERANCE)] = 0.0  # a joint fixed at its limit exceeds it by rounding
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = margin / np.abs(tangents)
        reach[np.isnan(reach)] = np.inf
        increasing, radius = tangents > 0, radii[:, None]
        high = np.where(increasing, reach[0], reach[1]).min(axis=1).clip(-2 * radius, radius)
        low = np.where(increasing, reach[1], reach[0]).min(axis=1).clip(-2 * radius, radius)
        return Charts(layer, joints, tangents, radii, -low, high, deviations)

    def _deviations(self, layer: Indices, joints: Array, tangents: Array, radii: Array) -> tuple[Array, Array]:
        """Project boundary points of charts onto the manifold; return projections (nan if failed) and their offsets."""
        rim = _rim(tangents.shape[2])
        tangent_points = joints[:, None] + radii[:, None, None] * np.einsum("knr,cr->kcn", tangents, rim)
        projected, converged = self.project(np.repeat(layer, len(rim)), tangent_points.reshape(-1, joints.shape[1]))
        projected = np.where(converged[:, None], projected, np.nan).reshape(tangent_points.shape)
        return projected, projected - tangent_points

    def within_limits(self, charts: Charts) -> NDArray[np.bool_]:
        """Return which manifold charts lie at least partly within the joint limits. Shape (N,)."""
        low, high = charts.centers - charts.spans, charts.centers + charts.spans
        reached = ((high >= self.space.lower) & (low <= self.space.upper)).all(axis=1)
        return np.asarray(reached & (charts.low <= charts.high).all(axis=1))

    def cover(self, layer: Indices, joints: Array, radius: float, max_charts: int) -> Charts:
        """Return charts that cover the manifold components of given configurations, continued to other time samples.

        Args:
            layer, joints: Indices of time samples and configurations on their manifolds. Shapes (M,), (M, n).
            radius, max_charts: Largest radius and largest number of charts.

        Raises:
            ProblemError: More than `max_charts` charts are needed.
        """
        charts, pending = None, np.arange(len(layer))
        while charts is None or pending.size:
            # one configuration per sample, then another one that is not covered yet
            _, first = np.unique(layer[pending], return_index=True)
            charts = self._grow(charts, layer[pending[first]], joints[pending[first]], radius, max_charts)
            pending = np.delete(pending, first)
            pending = pending[~self.is_covered(charts, layer[pending], joints[pending])]
        last, added = len(self.targets) - 1, charts
        while len(added):
            layer = np.concatenate([added.layer - 1, added.layer + 1])
            within = np.flatnonzero((layer >= 0) & (layer <= last))
            projected, valid = self.project(layer[within], np.tile(added.centers, (2, 1))[within])
            valid &= self.space.within(projected)
            layer, projected = layer[within][valid], projected[valid]
            uncovered = ~self.is_covered(charts, layer, projected)
            before = len(charts)
            charts = self._grow(charts, layer[uncovered], projected[uncovered], radius, max_charts)
            added = charts.select(slice(before, None))
        return charts

    def _grow(self, atlas: Charts | None, layer: Indices, joints: Array, radius: float, max_charts: int) -> Charts:
        """Extend an atlas of charts by the manifold components that contain given configurations."""
        first = 0 if atlas is None else len(atlas)
        charts, edges = self._new_charts(layer, joints, np.full(len(layer), radius), None, first)
        charts = charts if atlas is None else concatenate([atlas, charts])
        edges = edges.select(~self.is_covered(charts, edges.layer, edges.points, edges.owners))
        while len(edges.layer):
            outside = edges.points + self.settings.spacing * edges.radii[:, None] * edges.directions
            joints, valid = self.project(edges.layer, outside)
            shift = self.space.length(joints - outside)
            valid &= shift <= 2 * self.settings.flatness[charts.tangents.shape[2]] * edges.radii
            chosen = np.flatnonzero(valid)
            chosen = chosen[self._thin_out(edges.layer[chosen], joints[chosen], edges.radii[chosen])]
            radii, like = np.minimum(2 * edges.radii[chosen], radius), charts.tangents[edges.owners[chosen]]
            added, added_edges = self._new_charts(edges.layer[chosen], joints[chosen], radii, like, len(charts))
            halved = edges.radii / 2
            charts = concatenate([charts, added])
            if len(charts) > max_charts:
                words = f"the self-motion manifold needs more than {max_charts} charts of radius {radius:.3g} rad; "
                words += "use larger charts or fewer time samples"
                raise ProblemError(words, name="configurations", value=len(charts), limit=max_charts)
            lost = halved < radius / 2**self.settings.halvings
            self.lost += int(lost.sum())
            remaining = edges._replace(radii=halved).select(~lost)  # retried nearer to the edge if still uncovered
            edges = _Edges(*(np.concatenate(pair) for pair in zip(remaining, added_edges, strict=True)))
            edges = edges.select(~self.is_covered(charts, edges.layer, edges.points, edges.owners))
        return charts

    def split(self, charts: Charts) -> SplitCharts:
        """Replace manifold charts by charts of half the radius; keep a chart if its halves cannot be projected."""
        r = charts.tangents.shape[2]
        signs = np.array(list(product((-0.5, 0.5), repeat=r))).reshape(2**r, r)
        offsets = charts.radii[:, None, None] * np.einsum("knr,cr->kcn", charts.tangents, signs)
        tangent_points = charts.centers[:, None] + offsets
        shape = tangent_points.shape
        layer = np.repeat(charts.layer, shape[1])
        joints, valid = self.project(layer, tangent_points.reshape(-1, shape[2]))
        bases = np.repeat(charts.tangents, shape[1], axis=0)
        radii = self._split_radii(charts, signs)
        splittable = valid.reshape(shape[:2]).all(axis=1)
        rows = np.flatnonzero(np.repeat(splittable, shape[1]))
        layer, joints, radii = layer[rows], joints[rows], radii[rows]
        tangents = self.tangents_at(layer, joints, bases[rows])
        deviations = self._deviations(layer, joints, tangents, radii)[1]
        halves = self._clip_boxes(layer, joints, tangents, radii, deviations)
        within_limits, unsplit = self.within_limits(halves), np.flatnonzero(~splittable)
        owners = np.append((rows // max(shape[1], 1))[within_limits], unsplit)
        sides = np.vstack([signs[rows % shape[1]][within_limits], np.zeros((len(unsplit), r))])
        ends = charts.low[owners], charts.high[owners]
        low = np.where(sides > 0, np.maximum(ends[0], 0.0), ends[0])
        high = np.where(sides < 0, np.minimum(ends[1], 0.0), ends[1])
        empty = low > high  # the box ends before this half, which then belongs to the other side
        low, high = np.where(empty, ends[0], low), np.where(empty, ends[1], high)
        return SplitCharts(concatenate([halves.select(within_limits), charts.select(unsplit)]), owners, low, high)

    def _split_radii(self, charts: Charts, signs: Array) -> Array:
        """Return the radii that charts in the halves of a split chart need to cover its part of the manifold.

        Shape (N c,). Their centres are `signs` (c, r) times the radii. At the centre of a half, let the manifold leave
        the chart with slope Ds. A shift u in the chart is then a shift (1 + Ds' Ds)^1/2 u in the half, whose axes are
        aligned as closely as possible. Added are Ds' times the quadratic deviation within the half, and the residual.
        """
        r = charts.tangents.shape[2]
        form, residuals = charts.curvature()
        slopes = np.einsum("knab,cb->kcna", form * self.space.scale[:, None, None], signs)
        tilt = charts.radii[:, None] * np.sqrt((slopes**2).sum(axis=(2, 3)))
        stretch = 1 + np.sqrt(max(r, 1)) * (np.sqrt(1 + tilt**2) - 1)
        quadratic = self.space.length(charts.deviations - residuals).max(axis=1, initial=0.0) / 4
        residual = self.space.length(residuals).max(axis=1, initial=0.0)
        return np.asarray(charts.radii[:, None] / 2 * stretch + tilt * quadratic[:, None] + residual[:, None]).ravel()

    def is_covered(
        self, charts: Charts, layer: Indices, joints: Array, excluded: Indices | None = None
    ) -> NDArray[np.bool_]:
        """Return for each configuration whether a manifold chart other than `excluded` contains it. Shape (M,)."""
        if not len(layer) or not len(charts):
            return np.zeros(len(layer), dtype=bool)
        r = charts.tangents.shape[2]
        search_radius = 2 * float(charts.radii.max()) * np.sqrt(max(r, 1)) + 1e-6
        tree = self.space.tree(charts.centers, charts.layer)
        neighbours = min(self.settings.neighbours * 2 ** max(r - 1, 0), len(charts))
        _, nearest = tree.query(self.space.tree_points(joints, layer), k=neighbours, distance_upper_bound=search_radius)
        nearest = np.reshape(nearest, (len(layer), -1))
        covered = np.zeros(len(layer), dtype=bool)
        for column in nearest.T:
            rows = np.flatnonzero((column < len(charts)) & ~covered)
            if excluded is not None:
                rows = rows[column[rows] != excluded[rows]]
            candidates = column[rows]
            delta = self.space.difference(joints[rows], charts.centers[candidates]) * self.space.scale
            coordinates = np.einsum("kn,knr->kr", delta, charts.tangents[candidates] * self.space.scale[:, None])
            normal = np.sqrt(np.maximum((delta**2).sum(axis=1) - (coordinates**2).sum(axis=1), 0.0))
            radii = charts.radii[candidates]
            close = normal <= 2 * self.settings.flatness[r] * radii + 1e-6
            covered[rows] = close & (np.abs(coordinates) <= radii[:, None] * (1 + 1e-9)).all(axis=1)
        return covered

    def _thin_out(self, layer: Indices, joints: Array, radii: Array) -> Indices:
        """Return the indices of configurations, selected so that none lies within the chart radius of another."""
        if not len(layer):
            return np.zeros(0, dtype=np.intp)
        pairs = self.space.tree(joints, layer).query_pairs(float(radii.max()), output_type="ndarray")
        chosen = np.ones(len(layer), dtype=bool)
        if len(pairs):
            distances = self.space.length(self.space.difference(joints[pairs[:, 0]], joints[pairs[:, 1]]))
            pairs = pairs[distances < np.minimum(radii[pairs[:, 0]], radii[pairs[:, 1]])]
            for first, second in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
                if chosen[first]:
                    chosen[second] = False
        return np.flatnonzero(chosen)

    def _new_charts(
        self, layer: Indices, joints: Array, radii: Array, like: Array | None, first: int = 0
    ) -> tuple[Charts, _Edges]:
        """Return new charts at given configurations, numbered from `first`, and the points at the charts' edges."""
        if like is None:
            chosen = self._thin_out(layer, joints, radii)
            layer, joints, radii = layer[chosen], joints[chosen], radii[chosen]
        charts, points = self.charts_at(layer, joints, radii, like)
        valid = self.within_limits(charts)
        charts, points = charts.select(valid), points[valid]
        owner, side = np.nonzero(self.space.within(points))
        directions = np.einsum("enr,er->en", charts.tangents[owner], _rim(charts.tangents.shape[2])[side])
        return charts, _Edges(charts.layer[owner], points[owner, side], directions, first + owner, charts.radii[owner])


class TimeSample(NamedTuple):
    """Self-motion manifold at one time sample, given by the manifolds of all samples and the index of this sample."""

    manifolds: SelfMotionManifolds
    row: int


def _rim(r: int) -> Array:
    """Return the corners and side midpoints (c, r) of [-1, 1]^r, at which the deviation of a chart is measured."""
    middles = [side * np.eye(r)[axis] for axis in range(r) for side in (-1.0, 1.0)] if r > 1 else []
    corners = [np.array(signs) for signs in product((-1.0, 1.0), repeat=r)] if r else []
    return np.array([*middles, *corners]).reshape(-1 if r else 0, r)


def _solve_normal_equations(square: Array, right: Array) -> Array:
    """Solve K systems of normal equations (K, m, m) for right-hand sides (K, m), regularised against singularity."""
    trace = np.trace(square, axis1=1, axis2=2)[:, None, None]
    regularization = ROUNDING_SHARE**2 * trace + np.finfo(float).tiny
    regular = square + regularization * np.eye(square.shape[1])
    return np.asarray(np.linalg.solve(regular, right[:, :, None])[:, :, 0])
