"""False optima of the free-floating example: plans that a solver calls optimal and that jump across a singularity.

At a horizon of 4 s, from a constant guess and from random ones. Every plan is audited, solved again from itself on
twice the intervals, and again while it may still be an extremal whose mesh is too coarse. An extremal keeps its cost.
The audit's limits say that a plan is sound, not that its cost is exact: that is told by the change from mesh to mesh.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from models.checks import Array
from ocp import Collocation, Problem, Solution, prepare

HORIZON = 4.0  # s
INTERVALS = 50
MAX_INTERVALS = 800
MAX_ITERATIONS = 300  # most starts take 5 to 100
SAME_COST = 1e-2  # relative change of the cost under doubling up to which a plan may be one and the same extremal
GUESSES = ("constant", *["smooth"] * 10, *["rough"] * 10)
EXACT = 1e-6  # the same between the last two meshes, up to which the cost is taken to be that of no mesh
KNOTS = 9  # of a smooth random guess

EXTREMAL, COARSE, FALSE = "extremal", "extremal, mesh too coarse", "false optimum"


@dataclass(frozen=True)
class Trial:
    """One guess and what came of it.

    Attributes:
        guess: "constant" (the start, at rest), "smooth" (random values at nine times) or "rough" (at every point).
        seed: Of the random guess; -1 for the constant one.
        status: The solver's word.
        cost: On 50 intervals, J of (27).
        jump_deg_s: Largest jump of a joint velocity between two intervals, deg/s.
        integration_error: Largest distance of the states from the re-integrated ones, relative.
        task_error_m_s: Largest violation of the tip velocity between the nodes, m/s.
        audit: Whether the plan passes its audit.
        failed: The checks it does not pass.
        intervals: On which the plan was solved last.
        refined_cost: There.
        refined_audit: Whether the plan passes there.
        verdict: "extremal" passes and keeps its cost on finer meshes; "extremal, mesh too coarse" passes on a
            finer mesh at the same cost; "false optimum" does neither.
        t: Reported times of the plan on 50 intervals. Shape (M,), s.
        joint_rates: Shape (M, n), rad/s.
    """

    guess: str
    seed: int
    status: str
    cost: float
    jump_deg_s: float
    integration_error: float
    task_error_m_s: float
    audit: bool
    failed: tuple[str, ...]
    intervals: int
    refined_cost: float
    refined_audit: bool
    verdict: str
    t: Array
    joint_rates: Array

    def row(self) -> dict[str, Any]:
        """The trial without its curves, for a table."""
        curves = ("t", "joint_rates")
        return {
            name: "; ".join(value) if name == "failed" else value
            for name, value in self.__dict__.items()
            if name not in curves
        }


def trials(problem: Problem, start_base: Array, start_joints: Array) -> Iterator[Trial]:
    """One trial after the other.

    Args:
        problem: The "rates" formulation over HORIZON.
        start_base: Shape (3,). start_joints: Shape (n,).
    """
    prepared = Solvers(problem, "radau")
    for number, kind in enumerate(GUESSES):
        seed = number - 1
        first = prepared[INTERVALS].solve(guess=first_guess(kind, seed, start_base, start_joints), check=False)
        audit = first.audit()
        settled = settle(prepared, first)
        verdict = FALSE if not settled.sound else EXTREMAL if audit.passed else COARSE
        yield Trial(
            guess=kind,
            seed=seed,
            status=str(first.status),
            cost=first.cost,
            jump_deg_s=_jump(first),
            integration_error=audit.integration_error,
            task_error_m_s=audit.constraints["task"],
            audit=audit.passed,
            failed=tuple(finding.name for finding in audit.failures),
            intervals=settled.intervals,
            refined_cost=settled.plan.cost,
            refined_audit=settled.passed,
            verdict=verdict,
            t=first.t,
            joint_rates=first["rates"],
        )


class Solver(Protocol):
    """What `ocp.prepare` returns."""

    def solve(self, *, guess: Any = None, check: bool = True) -> Solution: ...


class Solvers(dict[int, Solver]):
    """Collocation of degree 3 by its number of intervals, each built once, when it is asked for."""

    def __init__(self, problem: Problem, scheme: str) -> None:
        super().__init__()
        self._problem, self._scheme = problem, scheme

    def __missing__(self, intervals: int) -> Solver:
        method = Collocation(intervals, scheme=self._scheme)
        self[intervals] = prepare(self._problem, method, options={"max_iter": MAX_ITERATIONS})
        return self[intervals]


@dataclass(frozen=True)
class Settled:
    """What became of a plan on finer meshes.

    Attributes:
        plan: The last one. intervals: On which it was solved.
        passed: Whether it passes its audit.
        same: Whether its cost is that of the first plan. change: Of the cost from the mesh before, relative.
    """

    plan: Solution
    intervals: int
    passed: bool
    same: bool
    change: float

    @property
    def sound(self) -> bool:
        """Whether the first plan was an extremal."""
        return self.passed and self.same

    @property
    def exact(self) -> bool:
        """Whether the cost does not change any more."""
        return self.change < EXACT


def settle(prepared: Solvers, first: Solution) -> Settled:
    """Solve a plan on 50 intervals again from itself on twice as many, until it passes its audit and its cost is exact.

    At least once: an extremal keeps its cost. Once it has changed its cost it is none, and nothing more is solved.
    """
    settled = Settled(first, INTERVALS, passed=False, same=True, change=np.inf)
    while settled.intervals < MAX_INTERVALS and settled.same and not (settled.passed and settled.exact):
        intervals = 2 * settled.intervals
        plan = prepared[intervals].solve(guess=settled.plan, check=False)
        same = plan.success and abs(plan.cost - first.cost) < SAME_COST * abs(first.cost)
        change = abs(plan.cost - settled.plan.cost) / abs(plan.cost)
        settled = Settled(plan, intervals, plan.audit().passed, same, change)
    return settled


def first_guess(
    kind: str, seed: int, base: Array, joints: Array, horizon: float = HORIZON, spread: float = 1.0
) -> dict[str, Array]:
    """What the solver starts from.

    Args:
        kind: "constant" (the start, at rest), "smooth" (random values at nine times) or "rough" (at every point).
        seed: Of the random values.
        base, joints: The start, which the random values spread about.
        horizon: s.
        spread: 1 for standard deviations of 0.5 m and rad of the base, 1 rad and 1 rad/s of the joints.
    """
    if kind == "constant":
        return {"base": base, "joints": joints, "rates": np.zeros_like(joints)}
    rng = np.random.default_rng(seed)
    points = KNOTS if kind == "smooth" else 3 * INTERVALS + 1
    sizes = {"base": (base, 0.5), "joints": (joints, 1.0), "rates": (np.zeros_like(joints), 1.0)}
    guess = {
        name: middle + rng.normal(0.0, size * spread, (points, len(middle))) for name, (middle, size) in sizes.items()
    }
    return {"t": np.linspace(0.0, horizon, points), **guess}


def _jump(plan: Solution) -> float:
    """Largest jump of a joint velocity between two intervals, deg/s."""
    curve = plan.control_interpolant
    segments = np.arange(len(curve.breaks) - 1)
    left = curve.within(segments[:-1], np.ones(len(segments) - 1))
    right = curve.within(segments[1:], np.zeros(len(segments) - 1))
    return float(np.degrees(np.abs(right - left).max()))
