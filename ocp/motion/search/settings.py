"""What a planner takes for granted: its meshes, its tolerances, and how much it tries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["PlannerSettings"]


@dataclass(frozen=True)
class PlannerSettings:
    """Settings of `ocp.motion.plan.plan`; those that are no law were chosen by the families of tests/sweep.

    Attributes:
        ik_starts: Random starts of inverse kinematics.
        local_steps: Steps of a local motion, beside the breaks of its tasks.
        dampings: Of local motions, relative to the singular values; the next one where no posture follows with one.
        min_intervals: Of a mesh, where its tasks have fewer pieces.
        coarse_degree, fine_degree: Of collocation. One interval of the fine one meets a smooth piece to rounding.
        separated_intervals: Of a coarse mesh with separation constraints, which hold at its points alone.
        coarse_options, fine_options: Of IPOPT. A coarse solve begins from a guess that does its tasks.
        barriers: IPOPT's own mu_init, and its tolerance, at which the barrier ends.
        samples_per_interval: Times at which collisions and deviations are looked for.
        compared_samples: Times at which two motions are compared.
        same_cost, same_path: Two motions are one if they differ by less than either: relative, and rad or m.
        negligible_rate: (rad/s)^2 or (m/s)^2: mean squared rates below are rounding of what stands still.
        tip_tolerance: m and rad: how far a tip may be from its task anywhere, all rows together.
        max_deviation: m and rad: a motion whose tips are farther off on its last mesh is rejected without an audit.
        max_refinements, max_pieces, max_intervals: Meshes made for the tips; into how many pieces each splits an
            interval; intervals of the last.
        least_progress: Share of the deviation that a finer mesh may leave, where it cannot be known to be in reach.
        max_failures: Candidates of one batch of seeds that fail before no further one is repaired; seeds of a batch
            whose order says which are worth it; motions that are audited where all are asked for.
        batch: Seeds that are solved before the best of them is audited, where each takes seconds.
        max_separations: Solves of one candidate that separate more bodies, or farther.
        max_cost_ratio: A local motion that costs so many times the cheapest solve is not worth one.
        gain: Share of the cost that a motion has to promise to spare, to be solved with its start fixed.
        near_bound: A plan that costs no more than so many times its lower bound is good enough.
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
    max_pieces: int = 4
    max_intervals: int = 400
    least_progress: float = 0.9
    max_failures: int = 8
    batch: int = 4
    max_separations: int = 12
    max_cost_ratio: float = 10.0
    gain: float = 0.01
    near_bound: float = 1.05
