"""Local optimisation of paths on self-motion manifolds: dynamic programming over neighbours, then linear programs.

**Dynamic programming.** At every sample, some configurations on either side of the path are taken, and the lowest-cost
path through them replaces it. Their spacing is reduced once the path no longer runs along their edge. Violations are
penalised, so that a path can move out of them.

**Linear programs.** The length of a path, or the sum of its largest joint displacements, is a sum of maxima of linear
functions of the joint positions. In coordinates t of the tangent spaces of the manifolds, the best displacement

    minimise  sum of s_g,   s_g >= a_i . t + c_i  (i in group g),   |t| <= radius,

within linearised joint limits, step limits and clearance, is therefore a linear program. Its solution is projected onto
the manifolds. The trust region grows if the cost decreases as predicted, and shrinks otherwise (Fletcher & Sainz de la
Maza 1989, Math. Program. 43). At a path for which the program predicts no decrease, its dual solution consists of the
multipliers of the first-order conditions: p_k in the subdifferential of the cost of step k, and

    T_k' (p_{k-1} - p_k + multipliers of the limits and of the clearance at sample k) = 0.

The second-order conditions weigh the curvature of the manifolds by these forces. On displacements that keep the kinks
and limits whose multipliers are positive, the cost must not decrease to second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from models import CollisionScene, FixedBase
from models.checks import Array
from ocp.console import time_left
from ocp.motion.local.collisions import distances_along, near_pairs
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import TOLERANCE, JointSpace, TasksWithFixedJoints
from ocp.motion.search.lengths import Homogeneous, PathLength
from ocp.motion.search.steps import Steps
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.tip_task import TipTask
from ocp.tolerances import CLEARANCE_TOLERANCE_M, ROUNDING_SHARE

Indices = NDArray[np.intp]

CURVATURE_RADIUS = 1e-2
"""Distance at which the curvature of a manifold is measured, rad or m: far beyond the tolerance of projections."""
PENALTY = 1e6
"""Penalty for each rad or m by which a limit is violated; the penalty exceeds the cost of any path."""


class PathPoses(NamedTuple):
    """Tool poses that a path must reach at its waypoints, and the largest joint displacement between waypoints.

    Attributes:
        positions, rotations: Poses of the tip at the waypoints, in world. Shapes (N, 3), m, and (N, 3, 3).
        step: Largest displacement of each joint between waypoints. Shape (n,), rad or m.
    """

    positions: Array
    rotations: Array
    step: Array


@dataclass(frozen=True, eq=False)
class PathProblem:
    """Constraints and cost of a path through configurations at time samples.

    Attributes:
        samples: Manifolds of the samples.
        steps: Steps between the samples.
        lower, upper: Limits of the joints. Shape (n,) each.
        scene: Collision scene, without moving obstacles for linear programs, or None.
        margin: Distance by which the clearance is exceeded, m.
    """

    samples: Sequence[TimeSample]
    steps: Steps
    lower: Array
    upper: Array
    scene: CollisionScene | None
    margin: float = CLEARANCE_TOLERANCE_M

    @classmethod
    def through_poses(
        cls, machine: FixedBase, poses: PathPoses, cost: Homogeneous, *, bounds: JointBounds, idle: Array, scene: Any
    ) -> PathProblem:
        """Return the problem of the lowest-cost joint path on which the tool passes through given poses.

        Args:
            machine: The arm.
            poses: Poses, and largest displacements between them.
            cost: Cost of a step.
            bounds: Limits of the joints.
            idle: Configuration, of which the joints that move no task frame keep the positions. Shape (n,).
            scene: Collision scene, or None.

        Raises:
            ProblemError: The poses take more joints than the machine has.
        """
        count, pose = len(poses.positions), bind(machine, TipTask(position=poses.positions[0], orientation=np.eye(3)))
        equations = TasksWithFixedJoints(machine, pose.bound, tuple(np.flatnonzero(pose.idle).tolist()))
        targets = np.zeros((count, 18))
        targets[:, :3] = poses.positions
        targets[:, 6:15] = poses.rotations.transpose(0, 2, 1).reshape(-1, 9)
        targets = np.column_stack([targets, np.tile(idle[pose.idle], (count, 1))])
        space = JointSpace(machine, bounds.lower, bounds.upper, np.ones(machine.joint_size))
        manifolds = SelfMotionManifolds(space, equations, targets)
        steps = Steps(np.arange(float(count)), cost, np.tile(poses.step, (count - 1, 1)))
        return cls([TimeSample(manifolds, k) for k in range(count)], steps, bounds.lower, bounds.upper, scene)

    def restrict(self, first: int, last: int) -> PathProblem:
        """Return the problem of the part of a path between two time samples, both included."""
        steps = Steps(self.steps.times[first : last + 1], self.steps.cost, self.steps.limits[first:last])
        return replace(self, samples=self.samples[first : last + 1], steps=steps)

    @property
    def _manifolds(self) -> list[tuple[Any, Indices, Indices]]:
        """Sets of manifolds, each with the indices of its samples along the path and of their manifolds in the set."""
        sets, rows = [sample.manifolds for sample in self.samples], np.array([sample.row for sample in self.samples])
        masks = [(each, np.flatnonzero([own is each for own in sets])) for each in dict.fromkeys(sets)]
        return [(each, mask, rows[mask]) for each, mask in masks]

    @property
    def weights(self) -> Array:
        """Weights of joint displacements in the cost of a step, which is proportional to the length. Shape (n,)."""
        assert isinstance(self.steps.cost, Homogeneous)
        return self.steps.cost.weights

    @property
    def dimension(self) -> int | None:
        """Dimension of the self-motion manifolds at the time samples; None if their dimensions differ."""
        sizes = {sample.manifolds.size for sample in self.samples}
        return sizes.pop() if len(sizes) == 1 else None

    def tangents(self, joints: Array, like: Array | None) -> Array:
        """Return bases (K, n, r) of the tangent spaces along a path (K, n), aligned with the bases `like`."""
        bases = np.zeros((*joints.shape, self.dimension or 0))
        for manifolds, rows, indices in self._manifolds:
            bases[rows] = manifolds.tangents_at(indices, joints[rows], None if like is None else like[rows])
        return bases

    def project(self, joints: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Project configurations (K, s, n), s at each time sample, onto the manifolds; also return a success mask."""
        projected, converged = np.empty(joints.shape), np.empty(joints.shape[:2], dtype=bool)
        for manifolds, rows, indices in self._manifolds:
            flat = joints[rows].reshape(-1, joints.shape[2])
            points, valid = manifolds.project(np.repeat(indices, joints.shape[1]), flat)
            projected[rows], converged[rows] = points.reshape(joints[rows].shape), valid.reshape(len(rows), -1)
        return projected, converged

    def curvature(self, joints: Array, tangents: Array) -> Array:
        """Return the second derivatives (K, n, r, r) of the manifolds along a path in tangent coordinates."""
        curvature = np.zeros((*tangents.shape, tangents.shape[2]))
        for manifolds, rows, indices in self._manifolds:
            radii = np.full(len(rows), CURVATURE_RADIUS)
            curvature[rows] = manifolds.charts_at(indices, joints[rows], radii, tangents[rows])[0].curvature()[0]
        return curvature

    def cost(self, path: Array) -> float:
        """Return the cost of the steps of a path (K, n)."""
        return float(self.steps.cost.evaluate(np.diff(path, axis=0), np.diff(self.steps.times)[:, None]).sum())

    def violation(self, path: Array) -> float:
        """Return the sum of the amounts by which a path (K, n) violates limits and clearance, rad and m."""
        excess = np.maximum(np.maximum(path - self.upper, self.lower - path), 0.0).sum()
        excess += np.maximum(np.abs(np.diff(path, axis=0)) - self.steps.limits, 0.0).sum()
        excess -= np.minimum(self.distances(path, None)[1], 0.0).sum()
        return float(excess)

    def distances(self, path: Array, change: Array | None) -> tuple[Indices, Array, Array]:
        """Return sample indices of P close body pairs, distances beyond the clearance, m, and gradients of distance.

        Bodies are close if joint displacements `change` (K, n) may bring them below the clearance. If `change` is None,
        they are close if they are below it, and the gradients are not computed. Shapes (P,), (P,), (P, n).
        """
        if self.scene is None:
            return np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros((0, path.shape[1]))
        approach = 0.0 if change is None else float((self.scene.levers.joints @ change.T).max(initial=0.0))
        at, _, distance, gradient = near_pairs(self.scene, path, approach + self.margin, gradients=change is not None)
        return at, distance - self.margin, gradient


NEIGHBOURS = {1: 5, 2: 2, 3: 1}
"""Number of neighbouring configurations on either side of a path, by the dimension of the manifold."""
MAX_MOVES = 10
"""Largest number of iterations of the dynamic programming with one spacing of the neighbours."""
LEAST_GAIN = 1e-4
"""Relative cost reduction below which the spacing is reduced even if the path runs along the edge of the neighbours."""


def shorten_path(path: Array, problem: PathProblem, widths: tuple[float, float]) -> Array:
    """Return a path near the given path that has a lower cost or smaller violations of limits. Shape (K, n).

    Args:
        path: Configurations that do the tasks at the samples. Shape (K, n).
        problem: Manifolds, all of one dimension from one to three (others leave the path unchanged), steps and limits.
        widths: Initial and final spacing of the configurations, in the metric.
    """
    joints, (width, finest), best_cost, moves = path, widths, np.inf, 0
    steps, dimension, tangents = problem.steps, problem.dimension, None
    if dimension not in NEIGHBOURS:
        return path
    count_per_side = NEIGHBOURS[dimension]
    shifts = np.array(list(product(np.arange(-count_per_side, count_per_side + 1.0), repeat=dimension)))
    while width > finest:
        tangents = problem.tangents(joints, tangents)
        tangent_points = joints[:, None] + width * np.einsum("knr,sr->ksn", tangents, shifts)
        projected, valid = problem.project(tangent_points)
        candidates = np.where(valid[:, :, None], projected, tangent_points)
        violations = np.where(valid, _violation(candidates, problem), 1.0)
        values, back_pointers = PENALTY * violations[0], []
        for k in range(1, len(joints)):
            displacements = candidates[k][None] - candidates[k - 1][:, None]
            excess = np.maximum(np.abs(displacements) - steps.limits[k - 1], 0.0).sum(axis=2)
            step_costs = steps.cost.evaluate(displacements, steps.times[k] - steps.times[k - 1])
            costs = values[:, None] + step_costs + PENALTY * excess
            back_pointers.append(costs.argmin(axis=0))
            values = costs.min(axis=0) + PENALTY * violations[k]
        choice = [int(values.argmin())]
        for pointers in reversed(back_pointers):
            choice.append(int(pointers[choice[-1]]))
        joints = candidates[np.arange(len(joints)), choice[::-1]]
        at_edge, current_cost = np.abs(shifts[choice]).max() == count_per_side, float(values.min())
        moves += 1
        if not (at_edge and current_cost < best_cost * (1 - LEAST_GAIN) and moves < MAX_MOVES):
            width, moves = width / 2, 0
        best_cost = min(best_cost, current_cost)
    return joints


def _violation(candidates: Array, problem: PathProblem) -> Array:
    """Return the amounts (K, s), rad and m, by which configurations (K, s, n) violate joint limits and clearance."""
    excess = np.maximum(np.maximum(candidates - problem.upper, problem.lower - candidates), 0.0).sum(axis=2)
    scene, times = problem.scene, problem.steps.times
    if scene is None:
        return np.asarray(excess)
    required, middle, base = scene.clearance + problem.margin, candidates[:, candidates.shape[1] // 2], np.zeros(0)
    span = np.abs(candidates - middle[:, None]).max(axis=1) @ scene.levers.joints.T
    distances = distances_along(scene, base, middle, times, cutoff=required + float(span.max(initial=0.0)))
    close = np.flatnonzero((distances - span < required).any(axis=1))  # at the other samples all candidates are clear
    count = candidates.shape[1]
    joints, repeated_times = candidates[close].reshape(-1, candidates.shape[2]), np.repeat(times[close], count)
    distances = distances_along(scene, base, joints, repeated_times, cutoff=required)
    excess[close] += np.maximum(required - distances, 0.0).max(axis=1, initial=0.0).reshape(len(close), count)
    return np.asarray(excess)


# ---- linear programs -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ProgramSettings:
    """Settings of the linear programs that bring a path to a local optimum.

    Attributes:
        first, largest, smallest: First, largest and smallest trust region of the displacements, rad or m.
        accepted, trusted, distrusted: Share of the predicted decrease from which on a step is accepted; from which on
            the trust region grows; below which it shrinks.
        growth, shrinkage: Factors by which it grows and shrinks.
        penalty: Penalty for each rad or m of a violation, relative to the largest weight of the cost.
        least_gain: Predicted decrease, relative to the cost, at which the path counts as optimal.
        most_programs: Largest number of linear programs.
        checked: Displacement up to which the first-order conditions are checked, rad or m.
        active: Multiplier, relative to the largest weight of the cost, from which on a constraint counts as active.
        stiffness: Weight of active constraints beside the curvature of the cost (Finsler's lemma).
        contact: Curvature that the distance of bodies at their clearance may have, relative to the largest weight.
    """

    first: float = 0.02
    largest: float = 0.1
    smallest: float = 1e-7
    accepted: float = 0.1
    trusted: float = 0.75
    distrusted: float = 0.25
    growth: float = 2.0
    shrinkage: float = 0.25
    penalty: float = 100.0
    least_gain: float = 1e-12
    most_programs: int = 60
    checked: float = 1e-3
    active: float = 1e-7
    stiffness: float = 1e6
    contact: float = 1e3


PROGRAM = ProgramSettings()


class _Rows(NamedTuple):
    """Gradients and values of R functions of a path of K configurations, linearised in the joint positions.

    Attributes:
        gradient: Sparse matrix. Shape (R, K n).
        value: Shape (R,).
    """

    gradient: Any
    value: Array


class _LocalProgram:
    """Linear program for the best displacement of a path within a trust region.

    Attributes:
        displacement: Displacement along the tangent spaces. Shape (K, n).
        saved: Predicted decrease of cost and penalty; 0 if the program has no solution.
    """

    def __init__(self, problem: PathProblem, path: Array, tangents: Array, radius: float) -> None:
        self._problem, self._path, self._tangents = problem, path, tangents
        self._size, self._weight = np.abs(tangents).sum(axis=2) * radius, float(problem.weights.max())
        self._basis = scipy.sparse.block_diag([*tangents], format="csr")
        pieces, groups = self._cost_rows()
        single = np.bincount(groups)[groups] == 1  # these stay the largest of their group
        numbers, self._groups = np.unique(groups[~single], return_inverse=True)
        self._fixed = np.asarray(pieces.gradient[np.flatnonzero(single)].sum(axis=0)).ravel()
        self._pieces = _Rows(pieces.gradient[np.flatnonzero(~single)], pieces.value[~single])
        self._limits = self._limit_rows()
        violation = np.maximum(self._limits.value, 0.0)  # a slack relaxes each limit by its violation
        count, size = len(self._groups), self._basis.shape[1]
        members = np.ones(count), (np.arange(count), self._groups)
        self._members = scipy.sparse.csr_array(members, shape=(count, len(numbers)))
        blocks = [
            [self._pieces.gradient @ self._basis, -self._members, None],
            [self._limits.gradient @ self._basis, None, scipy.sparse.coo_array(-violation[:, None])],
        ]
        penalty = PROGRAM.penalty * self._weight * float(violation.sum())
        objective = np.concatenate([self._basis.T @ self._fixed, np.ones(len(numbers)), [penalty]])
        ranges = np.full((len(objective), 2), (-np.inf, np.inf))
        ranges[:size], ranges[-1] = (-radius, radius), (0.0, 1.0)
        right = -np.append(self._pieces.value, self._limits.value)
        matrix = scipy.sparse.block_array(blocks, format="csr")
        self._solution = scipy.optimize.linprog(objective, matrix, right, bounds=ranges, method="highs")
        self.saved, self.displacement = 0.0, np.zeros(path.shape)
        if self._solution.status == 0:
            present = np.full(len(numbers), -np.inf)
            np.maximum.at(present, self._groups, self._pieces.value)
            self.saved = float(present.sum()) + penalty - float(self._solution.fun)
            self.displacement = (self._basis @ self._solution.x[:size]).reshape(path.shape)

    def _step_gradients(self, k: Indices, joint: Indices, factor: Array) -> Any:
        """Return gradients, with respect to the path, of `factor` times displacements of `joint` after samples `k`."""
        n, rows = self._path.shape[1], np.arange(len(k))
        entries = np.append(factor, -factor), (np.tile(rows, 2), np.append((k + 1) * n, k * n) + np.tile(joint, 2))
        return scipy.sparse.csr_array(entries, shape=(len(k), self._path.size))

    def _cost_rows(self) -> tuple[_Rows, Indices]:
        """Return linear functions in groups; in the trust region the cost is the sum of the maxima of all groups."""
        delta, by_joint = np.diff(self._path, axis=0), isinstance(self._problem.steps.cost, PathLength)
        k, joint, sign = (index.ravel() for index in np.indices((*delta.shape, 2)))
        factor, reach = (2.0 * sign - 1.0) * self._problem.weights[joint], self._size[1:] + self._size[:-1]
        value, change = factor * delta[k, joint], np.abs(factor) * reach[k, joint]
        groups = k * delta.shape[1] + joint if by_joint else k
        least = np.full(delta.size, -np.inf)
        np.maximum.at(least, groups, value - change)
        chosen = np.flatnonzero((value + change >= least[groups]) & (factor != 0))
        return _Rows(self._step_gradients(k[chosen], joint[chosen], factor[chosen]), value[chosen]), groups[chosen]

    def _limit_rows(self) -> _Rows:
        """Return linear constraints <= 0 for the joint limits, step limits and clearances that may be violated."""
        problem, path, n = self._problem, self._path, self._path.shape[1]
        gradients, values, reach = list[Any](), list[Array](), self._size[1:] + self._size[:-1]
        for sign, limit in ((1.0, problem.upper), (-1.0, -problem.lower)):
            excess = sign * path - limit
            rows = np.flatnonzero(excess > -self._size)
            entries = np.full(len(rows), sign), (np.arange(len(rows)), rows)
            gradients.append(scipy.sparse.csr_array(entries, shape=(len(rows), path.size)))
            values.append(excess.ravel()[rows])
            excess = sign * np.diff(path, axis=0) - problem.steps.limits
            k, joint = np.nonzero(excess > -reach)
            gradients.append(self._step_gradients(k, joint, np.full(len(k), sign)))
            values.append(excess[k, joint])
        at, distance, gradient = problem.distances(path, self._size)
        entries = -gradient.ravel(), (np.repeat(np.arange(len(at)), n), (at[:, None] * n + np.arange(n)).ravel())
        gradients.append(scipy.sparse.csr_array(entries, shape=(len(at), path.size)))
        self._contacts = at
        return _Rows(scipy.sparse.vstack(gradients).tocsr(), np.concatenate([*values, -distance]))

    def decreases_to_second_order(self) -> bool:
        """Return whether displacements that keep all active constraints may decrease the cost to second order."""
        if self._solution.status != 0:
            return True
        samples, n, r = self._tangents.shape
        count, size = len(self._groups), samples * r
        multipliers = np.maximum(-self._solution.ineqlin.marginals, 0.0)
        shares, pressures = multipliers[:count], multipliers[count:]
        pieces, limits = self._pieces.gradient, self._limits.gradient
        forces = self._fixed + pieces.T @ shares + limits.T @ pressures
        form = self._problem.curvature(self._path, self._tangents)
        curvature = np.einsum("kn,knab->kab", forces.reshape(samples, n), form) / self._weight
        at_clearance = pressures[len(pressures) - len(self._contacts) :] > PROGRAM.active * self._weight
        curvature[np.unique(self._contacts[at_clearance])] -= PROGRAM.contact * np.eye(r)
        # the pieces of a kink differ from their mean, weighted by the multipliers, only off the kink
        mean = self._members.T @ (scipy.sparse.diags_array(shares) @ pieces)
        kinks = (pieces - self._members @ mean)[np.flatnonzero(shares > PROGRAM.active)]
        active = limits[np.flatnonzero(pressures > PROGRAM.active * self._weight)]
        kept = scipy.sparse.vstack([kinks / self._weight, active]).tocsr() @ self._basis
        square = PROGRAM.stiffness * (kept.T @ kept) + scipy.sparse.block_diag([*curvature])
        square += ROUNDING_SHARE * PROGRAM.stiffness * scipy.sparse.eye_array(size)
        bands = np.zeros((2 * r, size))
        for band in range(min(2 * r, size)):
            bands[band, : size - band] = square.diagonal(-band)
        try:
            scipy.linalg.cholesky_banded(bands, lower=True)
        except np.linalg.LinAlgError:
            return True
        return False


def optimise_path(path: Array, problem: PathProblem) -> Array:
    """Return a locally optimal path (K, n) near a given path, by a sequence of linear programs.

    It costs no more than the given path and violates no limit by more. The time limit ends the sequence early.

    Args:
        path: Configurations that do the tasks at the samples. Shape (K, n).
        problem: Manifolds, all of the same dimension (others leave the path unchanged), steps and limits. The cost of
            steps is the weighted sum, or the largest, of the joint displacements.
    """
    if not problem.dimension or len(path) < 2:
        return path
    first_violation, penalty = problem.violation(path), PROGRAM.penalty * float(problem.weights.max())
    best, merit, radius = path, problem.cost(path) + penalty * first_violation, PROGRAM.first
    tangents = problem.tangents(path, None)
    for _ in range(PROGRAM.most_programs):
        if radius < PROGRAM.smallest or time_left() <= 0:
            break
        program = _LocalProgram(problem, best, tangents, radius)
        if program.saved <= PROGRAM.least_gain * merit:
            break
        moved, converged = problem.project((best + program.displacement)[:, None])
        moved_merit = problem.cost(moved[:, 0]) + penalty * problem.violation(moved[:, 0])
        share = (merit - moved_merit) / program.saved if converged.all() else 0.0
        if share >= PROGRAM.accepted:
            best, merit = moved[:, 0], moved_merit
            tangents = problem.tangents(best, tangents)
        if share >= PROGRAM.trusted:
            radius = min(PROGRAM.growth * radius, PROGRAM.largest)
        elif not share >= PROGRAM.distrusted:
            radius *= PROGRAM.shrinkage
    return best if problem.violation(best) <= max(first_violation, TOLERANCE) else path


def optimality_of(path: Array, problem: PathProblem) -> tuple[float, bool]:
    """Return how much cost small displacements of a path (K, n) save to first order, and whether they may save more.

    Second-order terms tell whether they may save more. The displacements are at most `PROGRAM.checked`.
    """
    if not problem.dimension or len(path) < 2:
        return 0.0, False
    program = _LocalProgram(problem, path, problem.tangents(path, None), PROGRAM.checked)
    return max(program.saved, 0.0), program.decreases_to_second_order()
