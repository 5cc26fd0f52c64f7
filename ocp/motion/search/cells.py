"""Forward search for low-cost motions of machines with a moving base, pruned on a grid of joint positions and attitude.

The configurations that such a machine can reach at a time do not form a manifold, since the attitude of the base
depends on the path. The search therefore keeps states that were reached by exact integration of the tasks. Of the
states in one cell of a grid over joint positions and attitude, it keeps the one reached at least cost. Each state is
continued with several self-motions. The cells are as large as the number of states requires. The largest rate of a
self-motion follows from the largest cost that a motion may have: runs with few states estimate this cost, and the last
run, with many states, covers all motions within a multiple of it.

Each final state has a path. Paths that cost less than all neighbouring ones are initial guesses for the optimal control
problem. The search proves nothing: it may miss a motion through a passage narrower
than a cell, and gives no bound.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from models import FreeFloating, find_wheels
from models.checks import Array
from ocp.console import check_time
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.local.rates import LocalMotion
from ocp.motion.search.configurations import REACH_TOLERANCE, PlanRequest, largest_pose_errors, locate_error
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.search.reduced import LimitSide, ReducedKinematics, TaskKinematics, check_floating_reach, limit_rates

Indices = NDArray[np.intp]

MAX_VELOCITY_ERROR = 0.1
"""Largest accepted time integral of the tip's velocity error, relative to the integral of the prescribed speed."""


@dataclass(frozen=True)
class CellSettings:
    """Settings of the forward search over grid cells, such as the numbers of states and of time steps.

    Attributes:
        states: Largest number of states kept at each time, of 1 kB each.
        few: Share of this number that is kept in the runs which estimate the cost.
        searches: Largest number of runs, including those that end early and are repeated with a higher cost limit.
        max_cost_ratio: Motions that cost more than so many times the best one are not searched.
        steps: Least number of time steps.
        halvings: Largest number of halvings of a time step after which no state is left.
        levels: Number of rates tried for a one-dimensional self-motion; for dimension r, r times as many random ones.
        longest: Largest joint displacement in one step, rad or m.
        growth, narrowest: Factor by which cells are resized to fit the number of states; least size, rad or m.
        corrections: Largest number of Newton steps that move a state to the poses of tasks that begin.
        neighbours: Number of paths with which a path is compared, per dimension of the self-motion.
        seats: Number of times at which paths are compared.
        classes: Largest number of paths that are returned, the lowest cost first.
    """

    states: int = 2000
    few: float = 0.25
    searches: int = 6
    max_cost_ratio: float = 10.0
    steps: int = 40
    halvings: int = 6
    levels: int = 15
    longest: float = 1.0
    growth: float = 1.2
    narrowest: float = 1e-3
    corrections: int = 12
    neighbours: int = 8
    seats: int = 5
    classes: int = 48


def tracks_tasks(request: PlanRequest, motions: Sequence[LocalMotion]) -> NDArray[np.bool_]:
    """Return which of K local (resolved-rate) motions reach all task poses and track all prescribed velocities."""
    count = len(motions[0].cost)
    missing, prescribed = np.zeros(count), np.zeros(count)
    for stretch, motion in zip(request.stretches, motions, strict=True):
        kinematics = ReducedKinematics(request.machine, stretch.equations, request.weights)
        for k, step in enumerate(np.diff(motion.t).tolist()):
            base, joints = ((value[:, k] + value[:, k + 1]) / 2 for value in (motion.base, motion.joints))
            speeds = kinematics.velocity_errors(base, joints, motion.rates[:, k], motion.t[k] + step / 2)
            missing, prescribed = missing + step * speeds[0], prescribed + step * speeds[1]
    tracked = largest_pose_errors(motions) <= REACH_TOLERANCE
    return np.asarray(tracked & (missing <= MAX_VELOCITY_ERROR * prescribed))


@dataclass(frozen=True, eq=False)
class _Layer:
    """States of base and joints that the search reaches at one time.

    Attributes:
        time: Time, s.
        base, joints: Positions of base and joints. Shapes (K, b), (K, n).
        cost: Cost of the motion up to this time. Shape (K,).
        parent: Index of the preceding state in the layer before. Shape (K,).
    """

    time: float
    base: Array
    joints: Array
    cost: Array
    parent: Indices

    def select(self, rows: Any) -> _Layer:
        return _Layer(self.time, self.base[rows], self.joints[rows], self.cost[rows], self.parent[rows])


class CellSearch:
    """Forward search, pruned by grid cells, for motions of a floating-base machine that perform all requested tasks."""

    def __init__(self, request: PlanRequest, configurations: Array, settings: CellSettings = CellSettings()) -> None:
        """Run the search several times, first with few states at each time and finally with many.

        Args:
            request: The request.
            configurations: Joint configurations at the start. Shape (K, n).
            settings: Settings of the search.

        Raises:
            Unreachable: From some time on, a task is out of reach for any attitude of the base.
            DeadEnd: From some time on, no state can be continued.
        """
        self.request, self._settings, self._searches = request, settings, list[_CellPass]()
        machine, weights = request.machine, request.weights
        self._kinematics = [ReducedKinematics(machine, stretch.equations, weights) for stretch in request.stretches]
        max_cost, full = settings.max_cost_ratio * self._cost_estimate(configurations), False
        for number in range(settings.searches):
            last = number == settings.searches - 1
            search = _CellPass(request, self._kinematics, max_cost, full or last, request.seed + number, settings)
            try:
                with np.errstate(all="ignore"):  # diverging states are discarded
                    search.search(configurations)
            except DeadEnd as error:
                if not number:
                    self._check_reach(error)
                if not self._searches and last:
                    raise
                if full:
                    break
                max_cost, full = (max_cost, True) if self._searches else (settings.max_cost_ratio * max_cost, False)
                continue
            self._searches.append(search)
            if full:
                break
            wanted = settings.max_cost_ratio * min(search.cost for search in self._searches)
            max_cost, full = wanted, wanted >= max_cost / 2

    def _check_reach(self, error: DeadEnd) -> None:
        """Raise Unreachable if the search ends because a required pose is out of reach."""
        request, machine, bounds = self.request, self.request.machine, self.request.bounds
        if request.start is None or not isinstance(machine, FreeFloating):
            return  # the path of the centre of mass depends on the start
        assert error.time is not None
        options: dict[str, Any] = {"interval": (error.time, request.horizon), "bounds": bounds, "seed": request.seed}
        try:
            check_floating_reach(machine, request.tasks, request.base, request.start, **options)
        except Unreachable as unreachable:
            raise locate_error(request, unreachable, unreachable.time) from error

    def _cost_estimate(self, configurations: Array) -> float:
        """Estimate the cost of the tasks from the least joint rates that they require at any start configuration."""
        request, total, count = self.request, 0.0, self._settings.seats
        base = np.tile(request.base, (len(configurations), 1))
        for stretch, kinematics in zip(request.stretches, self._kinematics, strict=True):
            for time in np.linspace(stretch.begin, stretch.end, count + 2)[1:-1].tolist():
                squared_rate = float(kinematics.estimate_squared_rates(base, configurations, time).min())
                total += squared_rate / 2 * stretch.duration / count
        return total

    def local_motions(self) -> list[list[LocalMotion]]:
        """Return the motions of locally least cost that each run of the search found; the last run comes first."""
        return [search.local_motions() for search in reversed(self._searches)]


class _CellPass:
    """One run of the cell search, which limits the cost of the motions and the number of states at each time.

    Attributes:
        cost: Cost of the best path.
        layers: States at each time.
        max_cost: Largest cost of a motion.
        states: Largest number of states at each time.
    """

    def __init__(
        self,
        request: PlanRequest,
        kinematics: Sequence[ReducedKinematics],
        max_cost: float,
        full: bool,
        seed: int,
        settings: CellSettings,
    ) -> None:
        """Prepare a run of the search with few states at each time or, if `full`, as many as the settings allow."""
        self.request, self.kinematics, self.max_cost, self._settings = request, kinematics, max_cost, settings
        self.states = settings.states if full else int(settings.few * settings.states)
        self.root, self._rng = np.sqrt(request.weights), np.random.default_rng(seed)
        # the angle of a wheel has no effect
        wheels = find_wheels(request.machine.robot)
        self._effective = np.array([name not in wheels for name in request.machine.robot.joint_names])
        self._max_rate, self._cell_size = np.sqrt(2 * max_cost / request.horizon), settings.narrowest
        self._stretch_layers = list[int]()
        self.layers = list[_Layer]()
        self.cost = np.inf

    def search(self, configurations: Array) -> None:
        """Search for motions from start configurations (K, n) to the end of the requested tasks.

        Raises:
            DeadEnd: No state reaches the end.
        """
        request, layers = self.request, self.layers
        count = len(configurations)
        layers.append(_Layer(0.0, np.tile(request.base, (count, 1)), configurations, np.zeros(count), np.arange(count)))
        for stretch, kinematics in zip(request.stretches, self.kinematics, strict=True):
            if stretch.begin > 0 and any(stretch.new):
                layers.append(self._states_at_new_poses(layers[-1], kinematics))
            self._stretch_layers.append(len(layers) - 1)
            steps = max(int(np.ceil(self._settings.steps * stretch.duration / request.horizon)), 1)
            remaining = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.nodes)[:0:-1].tolist()
            shortest = stretch.duration / steps / 2**self._settings.halvings
            task = kinematics.at(layers[-1].base, layers[-1].joints, stretch.begin)
            while remaining:
                check_time()
                current = layers[-1]
                grown, limit_counts = self._expand(kinematics, current, task, remaining[-1], limited=True)
                if grown is not None:
                    layers.append(grown)
                    task = kinematics.at(grown.base, grown.joints, remaining.pop())
                elif remaining[-1] - current.time > shortest:
                    remaining.append((remaining[-1] + current.time) / 2)
                else:
                    unlimited, _ = self._expand(kinematics, current, task, remaining[-1], limited=False)
                    raise self._dead_end_error(current, limit_counts if unlimited is not None else Counter())
        self.cost = float(layers[-1].cost.min())

    def _expand(
        self, kinematics: ReducedKinematics, layer: _Layer, task: TaskKinematics, time: float, limited: bool
    ) -> tuple[_Layer | None, Counter[tuple[int, int]]]:
        """Propagate the states of one time to a later time, and keep the lowest-cost state in each grid cell.

        Return None if no state remains. If the joints are `limited`, also count the states that each joint limit
        stops, by (joint, `LimitSide`).
        """
        request, step, root = self.request, time - layer.time, self.root
        self_motions = self._sample_self_motions(len(layer.cost), task.null.shape[2])
        parents = np.repeat(np.arange(len(layer.cost)), self_motions.shape[1])
        null_rates = np.asarray(task.null @ self_motions.transpose(0, 2, 1)).transpose(0, 2, 1)
        null_rates = null_rates.reshape(len(parents), -1)
        rates, limit_counts = task.least_rates(task.right)[parents] + null_rates, Counter[tuple[int, int]]()
        if limited:
            bounds, joints = request.bounds, layer.joints[parents]
            max_rates = bounds.velocity * root
            lower = np.maximum(-max_rates, (bounds.lower - joints) / step * root)
            upper = np.minimum(max_rates, (bounds.upper - joints) / step * root)
            rates, violations = limit_rates(rates, task.null[parents], lower, upper, max_rates=max_rates)
            limit_counts.update(map(tuple, violations[violations[:, 0] >= 0].tolist()))
            rates[violations[:, 0] >= 0] = np.nan
        displacement = np.abs(rates / root)[:, self._effective].max(axis=1, initial=0.0) * step
        cost = layer.cost[parents] + step / 2 * (rates**2).sum(axis=1)
        affordable = np.flatnonzero((cost <= self.max_cost) & (displacement <= self._settings.longest))
        if not affordable.size:
            return None, limit_counts
        parents, rates, cost = parents[affordable], rates[affordable], cost[affordable]
        base = layer.base[parents] + step * ((task.base[parents] @ rates[:, :, None])[:, :, 0] + task.drift[parents])
        best = self._best_of_cells(base, layer.joints[parents] + step * rates / root, cost, resize=True)
        parents, rates = parents[best], rates[best]
        start_base, start_joints = layer.base[parents], layer.joints[parents]
        states = start_base, start_joints, task.select(parents), rates
        base, joints, error = kinematics.step(*states, interval=(layer.time, time), tolerance=REACH_TOLERANCE / 10)
        cost = layer.cost[parents] + ((root * (joints - start_joints)) ** 2).sum(axis=1) / (2 * step)
        displacement = np.abs(joints - start_joints)[:, self._effective].max(axis=1, initial=0.0)
        valid = np.isfinite(base).all(axis=1) & (displacement <= self._settings.longest)
        expanded = _Layer(time, base, joints, cost, parents)
        expanded = expanded.select(valid & (cost <= self.max_cost) & (error <= REACH_TOLERANCE))
        expanded = expanded.select(self._valid_states(kinematics, expanded))
        if not len(expanded.cost):
            return None, limit_counts
        best = self._best_of_cells(expanded.base, expanded.joints, expanded.cost, resize=False)
        return expanded.select(best), limit_counts

    def _sample_self_motions(self, count: int, r: int) -> Array:
        """Return self-motion rates to try from each state, as null-space coordinates. Shape (count, C, r)."""
        levels = self._settings.levels
        share = np.linspace(-1.0, 1.0, levels)
        rates = self._max_rate * np.sign(share) * share**2  # finer near zero, where most motions are
        if r <= 1:
            return np.tile(rates[None, :, None] if r else np.zeros((1, 1, 0)), (count, 1, 1))
        samples = self._rng.normal(size=(count, levels * r, r))
        sizes = self._rng.choice(np.abs(rates), size=(*samples.shape[:2], 1))
        samples *= sizes / np.linalg.norm(samples, axis=2, keepdims=True)
        samples[:, 0] = 0.0
        return np.asarray(samples)

    def _best_of_cells(self, base: Array, joints: Array, cost: Array, resize: bool) -> Indices:
        """Return the index of the lowest-cost state in each grid cell; the cell size adapts to the number of states.

        The cells grow if there are more states than may be kept. Only with `resize`, they also shrink if there are few.
        """
        attitude = base[:, 2:] if base.shape[1] == 3 else 2 * base[:, 3:]
        points = np.hstack([(joints * self.root)[:, self._effective], attitude * np.sqrt(np.mean(self.root**2))])
        hash_weights = np.random.default_rng(0).uniform(1.0, 2.0, size=points.shape[1])
        order = np.argsort(cost, kind="stable")
        # without the offset, coordinates of opposite sign would never share a cell
        points = points[order] - points.min(axis=0)

        def winners(width: float) -> Indices:
            return np.asarray(order[np.unique(np.floor(points / width) @ hash_weights, return_index=True)[1]])

        best = winners(self._cell_size)
        while len(best) > self.states:
            self._cell_size *= self._settings.growth
            best = winners(self._cell_size)
        while (
            resize
            and self._cell_size > self._settings.narrowest
            and len(finer := winners(self._cell_size / self._settings.growth)) <= self.states
        ):
            self._cell_size, best = self._cell_size / self._settings.growth, finer
        return best

    def _valid_states(self, kinematics: ReducedKinematics, layer: _Layer) -> NDArray[np.bool_]:
        """Return which states satisfy the tilt limits of the tool and the required clearance. Shape (K,)."""
        valid, times = np.isfinite(layer.cost), np.full(len(layer.cost), layer.time)
        if kinematics.equations is not None and len(times):
            cone_violations = kinematics.equations.cone_violations(times, layer.base, layer.joints)
            valid &= cone_violations.max(axis=1, initial=0.0) <= REACH_TOLERANCE
        if self.request.clearance_constraints is not None and valid.any():
            scene, states = self.request.clearance_constraints.scene, (layer.base[valid], layer.joints[valid])
            distances = distances_along(scene, *states, layer.time, cutoff=scene.clearance)
            valid[valid] = (distances >= scene.clearance).all(axis=1)
        return np.asarray(valid)

    def _states_at_new_poses(self, layer: _Layer, kinematics: ReducedKinematics) -> _Layer:
        """Move states to the poses of the tasks that begin at this time; return the states that reach them."""
        states, max_steps = (layer.base, layer.joints, layer.time), self._settings.corrections
        base, joints, pose_error = kinematics.correct_poses(*states, REACH_TOLERANCE / 10, max_steps=max_steps)
        cost = layer.cost + ((self.root * (joints - layer.joints)) ** 2).sum(axis=1) / (2 * layer.time)
        reached = np.flatnonzero(pose_error <= REACH_TOLERANCE)
        if not reached.size:
            raise self._dead_end_error(layer, Counter())
        return _Layer(layer.time, base, joints, cost, np.arange(len(cost))).select(reached)

    def _dead_end_error(self, layer: _Layer, limit_counts: Counter[tuple[int, int]]) -> DeadEnd:
        """Return an error that says that no state can be continued, and which joint limit stops most states."""
        bounds, names = self.request.bounds, self.request.machine.robot.joint_names
        details: dict[str, Any] = {"time": layer.time, "name": "task"}
        words = "the joint rates would diverge: the tasks lead beyond the workspace or through a singularity"
        if limit_counts:
            (joint, side), _ = limit_counts.most_common(1)[0]
            limit = float((bounds.lower, bounds.upper, -bounds.velocity, bounds.velocity)[side][joint])
            verb = "is at its rate limit" if side >= LimitSide.SLOW else "is at its position limit"
            words = f"{names[joint]!r} {verb} {limit:g}"
            value = float(layer.joints[layer.cost.argmin(), joint])
            details |= {"name": names[joint], "value": value, "limit": limit}
        count = len(layer.cost)
        where = f"no motion continues after {layer.time:.4g} s: in the {count} states reached there"
        return DeadEnd(f"{where}, {words}", **details)

    # ---- results -----------------------------------------------------------------------------------------------------

    def local_motions(self) -> list[LocalMotion]:
        """Return the motions of locally least cost, as one `LocalMotion` for each time interval with the same tasks."""
        layers, request = self.layers, self.request
        final, states = layers[-1], np.arange(len(layers[-1].cost))
        paths = np.empty((len(layers), len(states)), dtype=np.intp)
        for k in range(len(layers) - 1, -1, -1):
            paths[k] = states
            states = layers[k].parent[states]
        cost = final.cost.copy()
        if request.cyclic:
            closing = final.joints - layers[0].joints[paths[0]]
            cost += ((self.root * closing) ** 2).sum(axis=1) / (2 * request.horizon)
        seats = np.unique(np.linspace(0, len(layers) - 1, self._settings.seats + 1).astype(int)).tolist()
        points = np.hstack([layers[k].joints[paths[k]] * self.root for k in seats])
        free_directions = max(request.machine.joint_size - max(each.rows for each in self.kinematics), 1)
        count = min(self._settings.neighbours * free_directions + 1, len(cost))
        neighbours = np.reshape(scipy.spatial.cKDTree(points).query(points, k=count)[1], (len(cost), count))
        minima = np.flatnonzero((cost[:, None] <= cost[neighbours]).all(axis=1))
        chosen = minima[np.argsort(cost[minima])][: self._settings.classes]
        motions, ends = [], [*self._stretch_layers[1:], len(layers) - 1]
        for begin, end in zip(self._stretch_layers, ends, strict=True):
            # a correction where new tasks begin belongs to their stretch
            last = end - 1 if end < len(layers) - 1 and layers[end].time == layers[end - 1].time else end
            part, rows = layers[begin : last + 1], paths[begin : last + 1, chosen]
            times = np.array([layer.time for layer in part])
            base = np.stack([layer.base[row] for layer, row in zip(part, rows, strict=True)], axis=1)
            joints = np.stack([layer.joints[row] for layer, row in zip(part, rows, strict=True)], axis=1)
            joints = np.clip(joints, request.bounds.lower, request.bounds.upper)
            motions.append(LocalMotion.through(times, base, joints, request.weights))
        return motions
