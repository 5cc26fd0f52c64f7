"""Diagnosis of tasks that no motion satisfies: where motions end, what obstructs them, and how far to relax the tasks.

From the first time sample on, configurations are propagated from chart to chart by all steps within the limits. Each
chart keeps the configuration whose path has the largest clearance. Motions end at the last sample that is reached. The
obstructions are the constraints that steps from there to the next sample would violate. A motion is then sought that
violates only one requirement, by as little as possible. This amount is no bound; another motion may need less.
"""

from __future__ import annotations

from enum import StrEnum
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import SolveError
from ocp.motion.builders.clearance import MARGIN, MAX_SOLVES, ROUNDING
from ocp.motion.local.collisions import distances_along, find_collisions
from ocp.motion.search.charts import Charts
from ocp.motion.search.joint_space import TOLERANCE
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.value import ChartGraph

Indices = NDArray[np.intp]

MAX_TRIALS = 3
"""Largest number of start configurations tried for a step into a manifold chart, and of obstructions in a message."""
NEGLIGIBLE = 1e-9
"""Lower bound of the divisors that scale relaxations of the tasks, m or rad, which avoids division by zero."""


class ObstructionKind(StrEnum):
    """Kinds of constraints that stop a motion: position or step limit, collision, unreachable pose, narrow passage."""

    LIMIT = "limit"
    STEP = "step"
    COLLISION = "collision"
    REACH = "reach"
    NARROW = "narrow"


class RelaxationKind(StrEnum):
    """Kinds of requirements that can be relaxed: tip position, tip orientation and clearance."""

    DEVIATION = "deviation"
    ROTATION = "rotation"
    CLEARANCE = "clearance"


class Obstruction(NamedTuple):
    """Constraint that prevents all motions from continuing beyond a time sample or waypoint.

    Attributes:
        kind: Position limit of a joint; largest step of a joint until the next sample; collision of two bodies; a pose
            out of reach; or a narrow passage, beyond which there are configurations that no propagated path reached.
        name: The joint; two bodies, "one and other"; or "tip".
        value: Value that would be required: position, step, distance or pose error, rad or m.
        limit: Limit of this value.
        before, after: Configurations: the last one reached, and the one that would have to follow. Shape (n,).
    """

    kind: ObstructionKind
    name: str
    value: float
    limit: float
    before: Array
    after: Array

    @property
    def excess(self) -> float:
        """Amount by which the required value violates its limit, rad or m."""
        return abs(self.value - self.limit)

    def __str__(self) -> str:
        return {
            ObstructionKind.LIMIT: f"{self.name!r} would pass its limit {self.limit:.4g} by {self.excess:.3g}",
            ObstructionKind.STEP: f"{self.name!r} would move {self.value:.3g} in one step, {self.limit:.3g} at most",
            ObstructionKind.COLLISION: f"{self.name} would be {self.value:.3g} m apart, {self.limit:.3g} at least",
            ObstructionKind.NARROW: "the passage is too narrow to be followed",
            ObstructionKind.REACH: f"the tip stays {self.value:.3g} off (m or rad)",
        }[self.kind]


class Relaxation(NamedTuple):
    """Motion that would be possible if one requirement were relaxed.

    Attributes:
        kind: Deviation of the tip's position, m; rotation of its axes, rad; or the clearance that remains, m.
        amount: Amount of this deviation, rotation or clearance.
        times: Times of the samples, s, or waypoint numbers. Shape (K,).
        joints: Configurations at the samples. Shape (K, n).
    """

    kind: RelaxationKind
    amount: float
    times: Array
    joints: Array

    def __str__(self) -> str:
        return {
            RelaxationKind.DEVIATION: f"the tip may be {self.amount:.3g} m off",
            RelaxationKind.ROTATION: f"the tip may be turned by {np.degrees(self.amount):.3g} deg",
            RelaxationKind.CLEARANCE: f"the clearance is {self.amount:.3g} m",
        }[self.kind]


class DeadEnd(SolveError):
    """Error which states that no motion satisfies the tasks, or that the search found no such motion.

    Attributes:
        time: Time, s, or waypoint number, from which no motion can be continued.
        until: First time, s, or waypoint number that is not reached; nan if unknown.
        name, value, limit: Of the smallest obstruction. With a moving base, whose attitude is not known there: the
            joint whose limit obstructs most states, its position and limit; or "task".
        obstructions: Constraints that stop motions there, each kind and name with its least excess, the least first.
        relaxations: Motions that would do the task with a relaxed requirement, the smallest one found of each kind.
        segments: Number of segments in which the task may be done, see `plan`, search="segments"; None if unknown.
        proven: Whether the search proves, under its assumptions, that no motion exists.
    """

    def __init__(
        self,
        words: str,
        until: float = np.nan,
        obstructions: tuple[Obstruction, ...] = (),
        relaxations: tuple[Relaxation, ...] = (),
        *,
        segments: int | None = None,
        proven: bool = False,
        **details: Any,
    ) -> None:
        super().__init__(words, **details)
        self.until, self.obstructions, self.relaxations = until, obstructions, relaxations
        self.segments, self.proven = segments, proven


def dead_end(
    search: AtlasSearch, unit: str = "{:.4g} s", proven: bool = True, segments: int | None = None
) -> DeadEnd | None:
    """Return an error that says why all motions end before the last time sample; None if a motion reaches this sample.

    Args:
        unit: Format of the sample times in the message.
        proven, segments: As in `DeadEnd`.
    """
    front = _Propagation(search)
    last = front.last
    if last == len(search.times) - 1:
        return None
    obstructions = _find_obstructions(search, front)
    smallest, relaxations = obstructions[0], list[Relaxation]()
    clearances = front.clearance[-1]
    collides = any(obstruction.kind is ObstructionKind.COLLISION for obstruction in obstructions)
    if collides and np.isfinite(clearances.max(initial=-np.inf)):
        best = int(clearances.argmax())
        joints = front.path(len(search.times) - 1, best)
        relaxations.append(Relaxation(RelaxationKind.CLEARANCE, float(clearances[best]), search.times, joints))
    path = _extend_path(search, front, obstructions[0].before)
    for turning, kind in ((False, RelaxationKind.DEVIATION), (True, RelaxationKind.ROTATION)):
        if (relaxation := _find_relaxation(search, path, turning, kind)) is not None:
            relaxations.append(relaxation)
    next_sample = unit.format(search.times[last + 1])
    where = f"none begins at {next_sample}"
    if last >= 0:
        where = f"from {unit.format(search.times[last])} on none continues to {next_sample}"
    first = "no motion does the tasks" if proven else "no motion was found, though the search does not rule one out"
    words = f"{first}: {where}; {'; '.join(map(str, obstructions[:MAX_TRIALS]))}"
    if relaxations:
        words += f"; one exists if {', or '.join(map(str, relaxations))}"
    if segments is not None:
        count = "a reconfiguration" if segments == 2 else f"{segments - 1} reconfigurations"
        words += f"; with {count} on the way one may: search='segments'"
    time, until = float(search.times[max(last, 0)]), float(search.times[last + 1])
    details: dict[str, Any] = {"name": smallest.name, "value": smallest.value, "limit": smallest.limit, "time": time}
    details |= {"segments": segments, "proven": proven}
    return DeadEnd(words, until, tuple(obstructions), tuple(relaxations), **details)


class _Propagation:
    """Configurations propagated from time sample to time sample, one for each chart that can be reached.

    Attributes:
        layers: Charts of each sample, no wider than steps, including those in collision.
        joints: Configurations reached. Shapes (N, n).
        clearance: Least clearance on the path to each, at most the required one, m; inf without a scene, -inf where
            none is reached. Shapes (N,).
        parent: Charts from which they are reached. Shapes (N,).
        required: Required clearance, m; inf without a scene.
    """

    def __init__(self, search: AtlasSearch) -> None:
        self.search = search
        self.required = np.inf if search.scene is None else search.scene.clearance
        self.layers = _fine_charts(search)
        count, n = len(search.times), len(search.space.scale)
        self.joints = [np.full((len(charts), n), np.nan) for charts in self.layers]
        self.clearance = [np.full(len(charts), -np.inf) for charts in self.layers]
        self.parent = [np.zeros(len(charts), dtype=np.intp) for charts in self.layers]
        charts = self.layers[0]
        rows = np.arange(len(charts))
        self._record(0, rows, charts.points(np.clip(0.0, charts.low, charts.high)), rows)
        graph = search.graph(self.layers)
        for k in range(count - 1):
            self._propagate(graph, k)

    @property
    def last(self) -> int:
        """Index of the last time sample that is reached with the required clearance; -1 if no sample is reached."""
        return max((k for k, clearance in enumerate(self.clearance) if (clearance >= self.required).any()), default=-1)

    def path(self, k: int, chart: int) -> Array:
        """Return the path from the first time sample to a manifold chart of sample `k`. Shape (k + 1, n)."""
        path = []
        for sample in range(k, -1, -1):
            path.append(self.joints[sample][chart])
            chart = int(self.parent[sample][chart])
        return np.array(path[::-1])

    def _propagate(self, graph: ChartGraph, k: int) -> None:
        """Propagate configurations from time sample `k` to charts of sample `k` + 1, in order of falling clearance."""
        space, limit, successor = self.search.space, self.search.limits[k], k + 1
        reached = np.isfinite(self.joints[k][:, 0])
        parts = [(i[reached[i]], j[reached[i]]) for i, j in graph.edges(k, successor)]
        if not parts:
            return
        i, j = (np.concatenate(part) for part in zip(*parts, strict=True))
        targets = self.layers[successor].select(j)
        delta = space.difference(targets.centers, self.joints[k][i])
        place = -np.einsum("pnr,pn->pr", targets.tangents, space.scale**2 * delta)
        displacement = delta + np.einsum("pnr,pr->pn", targets.tangents, np.clip(place, targets.low, targets.high))
        possible = (np.abs(displacement) <= limit + targets.max_deviation + TOLERANCE).all(axis=1)
        i, j, displacement = i[possible], j[possible], displacement[possible]
        order = np.lexsort((space.length(displacement), -self.clearance[k][i], j))
        i, j, displacement = i[order], j[order], displacement[order]
        nth = np.arange(len(j)) - np.searchsorted(j, j)
        for trial in range(MAX_TRIALS):
            chosen = nth == trial
            self._record(successor, j[chosen], self.joints[k][i[chosen]] + displacement[chosen], i[chosen])

    def _record(self, k: int, charts: Indices, joints: Array, parents: Indices) -> None:
        """Project configurations to the manifold; store for each chart the valid configuration of largest clearance."""
        search = self.search
        sample, required = search.samples[k], self.required
        if k == 0 and search.start is not None:
            joints, valid = np.repeat(search.start[None], len(charts), axis=0), np.ones(len(charts), dtype=bool)
        else:
            joints, valid = sample.manifolds.project(np.full(len(charts), sample.row), joints)
            valid &= search.space.within(joints)
        clearances = np.full(len(charts), np.inf)
        if k:
            clearances = self.clearance[k - 1][parents]
            displacement = np.abs(joints - self.joints[k - 1][parents])
            valid &= (displacement <= search.limits[k - 1] + TOLERANCE).all(axis=1)
        if search.scene is not None:
            valid &= clearances > self.clearance[k][charts]
            distances = distances_along(search.scene, np.zeros(0), joints[valid], search.times[k], cutoff=required)
            clearances[valid] = np.minimum(np.minimum(clearances[valid], distances.min(axis=1)), required)
        valid &= clearances > self.clearance[k][charts]
        rows = charts[valid]
        for recorded, values in ((self.joints, joints), (self.clearance, clearances), (self.parent, parents)):
            recorded[k][rows] = values[valid]


def _fine_charts(search: AtlasSearch) -> list[Charts]:
    """Return all charts, split until no chart is wider than the joint step limit or there are too many charts."""
    layers = search.atlas
    reach = search.limits.max(axis=1) / 2
    max_radius = np.minimum(np.append(reach, np.inf), np.append(np.inf, reach))
    while True:
        too_wide = [k for k, charts in enumerate(layers) if len(charts) and (charts.radii > max_radius[k]).any()]
        added = sum((2 ** layers[k].tangents.shape[2] - 1) * len(layers[k]) for k in too_wide)
        if not added or sum(map(len, layers)) + added > search.settings.charts:
            return layers
        layers = [search.split_charts(charts, k) if k in too_wide else charts for k, charts in enumerate(layers)]


def _find_obstructions(search: AtlasSearch, front: _Propagation) -> list[Obstruction]:
    """Return the different constraints that stop motions at the last reached time sample, by rising violation."""
    space, scene, last = search.space, search.scene, front.last
    joints, n, next_sample = search.samples[0].manifolds.equations.machine.robot.joint_names, len(space.scale), last + 1
    before, targets, converged = _continuations(search, front)
    sample = search.samples[next_sample]
    errors = sample.manifolds.linearize(np.full(len(targets), sample.row), targets)[0]
    pose_errors = np.where(converged, 0.0, np.abs(errors).max(axis=1))
    steps = search.limits[last] if last >= 0 else np.full(n, np.inf)
    # one column for each constraint
    kinds = [ObstructionKind.REACH, *[ObstructionKind.LIMIT] * (2 * n), *[ObstructionKind.STEP] * n]
    names, signs = ["tip", *joints, *joints, *joints], np.repeat([1.0, -1.0, 1.0], [1 + n, n, n])
    values = np.column_stack([pose_errors, targets, targets, np.abs(targets - before)])
    limits = np.concatenate([np.zeros(1), space.upper, space.lower, steps])
    if scene is not None:
        distances = distances_along(scene, np.zeros(0), targets, search.times[next_sample], cutoff=scene.clearance)
        kinds += [ObstructionKind.COLLISION] * len(scene.pairs)
        names += [" and ".join(bodies) for bodies in scene.labels]
        values, signs = np.hstack([values, distances]), np.append(signs, np.full(len(scene.pairs), -1.0))
        limits = np.append(limits, np.full(len(scene.pairs), scene.clearance))
    excess = signs * (values - limits)
    excess[~converged, 1:] = 0.0
    worst = excess.argmax(axis=1)
    largest = excess[np.arange(len(worst)), worst]
    smallest: dict[tuple[ObstructionKind, str], Obstruction] = {}
    for row in np.argsort(largest, kind="stable").tolist():
        if largest[row] > TOLERANCE:
            column = int(worst[row])
            value, limit = float(values[row, column]), float(limits[column])
            entry = Obstruction(kinds[column], names[column], value, limit, before[row], targets[row])
            smallest.setdefault((entry.kind, entry.name), entry)
    if not smallest:  # there are configurations at the next sample, but no propagated path reaches them
        charts = front.layers[next_sample].centers
        after = charts[0] if len(charts) else before[0]
        return [Obstruction(ObstructionKind.NARROW, "tip", 0.0, 0.0, before[0], after)]
    return list(smallest.values())


def _continuations(search: AtlasSearch, front: _Propagation) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return starts (M, n) and ends (M, n) of steps tried between the last reached time sample and the next.

    The ends are the projection of each start to the next sample, and the configurations at this sample which keep all
    limits but are too far away. Also return which ends satisfy the task (M,).
    """
    space, last = search.space, front.last
    sample, layer = search.samples[last + 1], max(last, 0)
    before = front.joints[last][front.clearance[last] >= front.required] if last >= 0 else front.layers[0].centers
    if not len(before):
        before = front.layers[layer].centers
    projections, converged = sample.manifolds.project(np.full(len(before), sample.row), before)
    charts = front.layers[last + 1].select(front.clearance[last + 1] < front.required)
    if last < 0 or not len(charts):
        return before, projections, converged
    tangent_points = charts.points(np.clip(0.0, charts.low, charts.high))
    projected, valid = sample.manifolds.project(np.full(len(tangent_points), sample.row), tangent_points)
    starts = before[space.tree(before).query(space.tree_points(projected))[1]]
    continued = starts + space.difference(projected, starts)
    targets = np.concatenate([projections, continued])
    return np.concatenate([before, starts]), targets, np.concatenate([converged, valid])


# ---- relaxations -----------------------------------------------------------------------------------------------------


def _extend_path(search: AtlasSearch, front: _Propagation, blocked: Array) -> Array:
    """Return an initial guess of a path (K, n): a path to the dead end, continued on a straight line in joint space.

    The line leads to the nearest chart centre of the last time sample.
    """
    space, last, count = search.space, max(front.last, 0), len(search.times)
    distances = np.nan_to_num(space.length(front.joints[last] - blocked), nan=np.inf)
    path = front.path(last, int(distances.argmin())) if np.isfinite(distances).any() else blocked[None]
    displacements = space.difference(front.layers[-1].centers, np.repeat(path[-1:], len(front.layers[-1]), axis=0))
    displacement = displacements[space.length(displacements).argmin()] if len(displacements) else np.zeros(len(blocked))
    share = np.arange(1, count - len(path) + 1)[:, None] / max(count - len(path), 1)
    return np.vstack([path, path[-1] + share * displacement])


def _find_relaxation(search: AtlasSearch, path: Array, turning: bool, kind: RelaxationKind) -> Relaxation | None:
    """Find the path of least tip position error (orientation error if `turning`) near a guess; None on failure."""
    if not any((sample.manifolds.equations.turning == turning).any() for sample in search.samples):
        return None
    scene, pairs = search.scene, list[int]()
    for _ in range(MAX_SOLVES):
        problem = _RelaxedProblem(search, turning, pairs)
        rough = problem.solve(path, None)  # a bound of the largest error component is smooth at zero, unlike a norm
        if rough is None:
            return None
        refined = problem.solve(rough, max(problem.amount(rough), NEGLIGIBLE))
        path = rough if refined is None else refined
        collisions = [] if scene is None else find_collisions(scene, np.zeros(0), path, search.times)
        colliding = [collision.pair for collision in collisions]
        if not colliding:
            return Relaxation(kind, problem.amount(path), search.times, path)
        if set(colliding) <= set(pairs):
            return None
        pairs = sorted({*pairs, *colliding})
    return None


class _RelaxedProblem:
    """Nonlinear program for a path of least position or orientation error of the tips, with given bodies separated."""

    def __init__(self, search: AtlasSearch, turning: bool, pairs: list[int]) -> None:
        self.search, self.turning = search, turning
        count, n = len(search.times), len(search.space.scale)
        self.shape = count, n
        self.joints = ca.MX.sym("joints", n, count)
        constraints, rows, norms_squared = list[ca.MX](), list[ca.MX](), list[ca.MX]()
        if search.start is not None:
            constraints.append(self.joints[:, 0] - search.start)
        for manifolds in dict.fromkeys(sample.manifolds for sample in search.samples):
            indices = [k for k, sample in enumerate(search.samples) if sample.manifolds is manifolds]
            indices = indices[int(search.start is not None and indices[0] == 0) :]
            if not indices:
                continue
            q, target = ca.SX.sym("q", n), ca.SX.sym("wanted", manifolds.targets.shape[1])
            error, turning_rows = manifolds.equations.error(ca.SX(0, 1), q, target), manifolds.equations.turning
            rest = np.zeros(manifolds.equations.size - len(turning_rows), dtype=bool)
            relaxed = np.append(turning_rows == turning, rest)
            ends = np.cumsum([0, *(part.task.size for part in manifolds.equations.bound)]).tolist()
            parts = [a + np.flatnonzero(relaxed[a:b]) for a, b in pairwise(ends)]
            norms = ca.vertcat(*(ca.sumsqr(error[part.tolist()]) for part in parts if part.size))
            errors_by_kind = [error[np.flatnonzero(chosen).tolist()] for chosen in (~relaxed, relaxed)]
            errors = ca.Function("errors", [q, target], [*errors_by_kind, norms]).map(len(indices))
            targets = manifolds.targets[[search.samples[k].row for k in indices]].T
            values = errors(self.joints[:, indices], targets)
            for expressions, part in zip((constraints, rows, norms_squared), values, strict=True):
                expressions.append(ca.vec(part))
        stacked = (ca.vertcat(ca.MX(0, 1), *part) for part in (constraints, rows, norms_squared))
        self._constraints, self._relaxed_rows, self._norms = stacked
        self._largest_norm = ca.Function("size", [self.joints], [ca.mmax(self._norms)])
        self._separations = ca.MX(0, 1)
        if search.scene is not None and pairs:
            q, time = ca.SX.sym("q", n), ca.SX.sym("time")
            distances = search.scene.distances(ca.SX(0, 1), q, time, pairs=pairs, rounding=ROUNDING)
            distances = ca.Function("apart", [q, time], [distances]).map(count)(self.joints, search.times[None, :])
            self._separations = ca.vec(distances) - search.scene.clearance - MARGIN

    def amount(self, path: Array) -> float:
        """Return the largest position error (m) or orientation error (rad) of the tips along a path (K, n)."""
        largest = float(np.sqrt(float(self._largest_norm(path.T))))
        return float(np.arcsin(min(largest, 1.0))) if self.turning else largest

    def solve(self, path: Array, scale: float | None) -> Array | None:
        """Solve the nonlinear program from a guess, and return the joint path (K, n); None if the solver fails."""
        search, slack = self.search, ca.MX.sym("slack")
        if scale is None:
            relaxed_constraints, slack_guess = ca.vertcat(self._relaxed_rows - slack, -self._relaxed_rows - slack), 0.1
        else:
            relaxed_constraints, slack_guess = self._norms / scale**2 - slack**2, 1.0
        steps = self.joints[:, 1:] - self.joints[:, :-1]
        seconds = np.diff(search.times)
        smoothness = ca.sum2(ca.sum1(steps**2) / seconds[None, :])
        # among motions with the same relaxation, prefer the smoother one
        size = max(float((np.diff(path, axis=0) ** 2 / seconds[:, None]).sum()), NEGLIGIBLE)
        program = {
            "x": ca.vertcat(ca.vec(self.joints), slack),
            "f": slack + 1e-4 * smoothness / size,
            "g": ca.vertcat(self._constraints, relaxed_constraints, self._separations, ca.vec(steps)),
        }
        options = {"print_level": 0, "sb": "yes", "max_iter": 100, "bound_relax_factor": 0.0}
        solver_options = {"print_time": False, "ipopt": options, "error_on_fail": False}
        solver = ca.nlpsol("give", "ipopt", program, solver_options)
        counts = [part.numel() for part in (self._constraints, relaxed_constraints, self._separations)]
        max_steps, space, count = search.limits.ravel(), search.space, self.shape[0]
        result = solver(
            x0=np.append(np.clip(path, space.lower, space.upper).ravel(), slack_guess),
            lbx=np.append(np.tile(space.lower, count), 0.0),
            ubx=np.append(np.tile(space.upper, count), np.inf),
            lbg=np.concatenate([np.zeros(counts[0]), np.full(counts[1], -np.inf), np.zeros(counts[2]), -max_steps]),
            ubg=np.concatenate([np.zeros(counts[0]), np.zeros(counts[1]), np.full(counts[2], np.inf), max_steps]),
        )
        if not solver.stats()["success"]:
            return None
        return np.array(result["x"][:-1]).reshape(self.shape)
