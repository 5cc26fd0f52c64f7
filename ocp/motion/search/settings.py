"""Settings of the planner: meshes, tolerances and effort."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["PlannerSettings"]


@dataclass(frozen=True)
class PlannerSettings:
    """Settings of `ocp.motion.plan.plan`, chosen by the problem families of tests/sweep where no law gives them.

    Attributes:
        ik_starts: Random starts of inverse kinematics.
        local_steps: Steps of a local motion, besides the breaks of its tasks.
        dampings: Dampings of local motions, relative to the singular values; the next one is tried if none tracks.
        min_intervals: Least number of mesh intervals.
        coarse_degree, fine_degree: Degrees of collocation. One interval of the fine degree represents a smooth segment
            to rounding.
        separated_intervals: Intervals of a coarse mesh with separation constraints, which hold only at its points.
        coarse_options, fine_options: Options of IPOPT. A coarse solve starts from a guess that does its tasks.
        barriers: Default mu_init of IPOPT, and the tolerance at which the barrier parameter ends.
        samples_per_interval: Samples of an interval at which collisions and deviations are checked.
        compared_samples: Samples at which two motions are compared.
        same_cost, same_path: Two candidates count as one motion if either difference is smaller: relative; rad or m.
        negligible_rate: (rad/s)^2 or (m/s)^2: smaller mean squared rates are rounding errors of a motion at rest.
        tip_tolerance: m and rad: largest deviation of a tip from its task at any time, over all rows.
        max_deviation: m and rad: a motion with a larger deviation on its last mesh is rejected without an audit.
        max_refinements, max_splits, max_intervals: Meshes refined for the deviation of the tips; parts into which one
            refinement splits an interval; intervals of the last mesh.
        least_progress: Largest share of the deviation that a refinement may leave if the task may be out of reach.
        max_failures: Failed candidates of a batch after which no further one is repaired; also the number of sorted
            seeds that are tried, and of motions that are audited if all are requested.
        refusal_time: Processor time after which no further candidate is tried if those before failed for other reasons
            than collisions, s.
        batch: Seeds that are solved before the best of them is audited, if each takes seconds.
        max_separations: Solves of one candidate with more, or wider, separation constraints.
        max_cost_ratio: A local motion whose cost exceeds that of the best solve by this factor is not solved.
        gain: Relative cost reduction that a motion must promise to be solved with its start fixed.
        near_bound: A plan whose cost is within this factor of its lower bound is accepted.
    """

    ik_starts: int = 64
    local_steps: int = 64
    dampings: tuple[float, ...] = (0.01, 0.1, 1.0)
    min_intervals: int = 8
    coarse_degree: int = 2
    fine_degree: int = 7
    separated_intervals: int = 24
    coarse_options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 60, "tol": 1e-4, "mu_init": 1e-3})
    fine_options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 150})
    barriers: tuple[float, float] = (0.1, 1e-10)
    samples_per_interval: int = 16
    compared_samples: int = 33
    same_cost: float = 1e-5
    same_path: float = 0.1
    negligible_rate: float = 1e-12
    tip_tolerance: float = 1e-6
    max_deviation: float = float("inf")
    max_refinements: int = 6
    max_splits: int = 4
    max_intervals: int = 400
    least_progress: float = 0.9
    max_failures: int = 8
    refusal_time: float = 20.0
    batch: int = 4
    max_separations: int = 12
    max_cost_ratio: float = 10.0
    gain: float = 0.01
    near_bound: float = 1.05
