"""Extremals of the free-floating example at the paper's horizons, from many first guesses.

A seeded multi-start: what the solver calls optimal is audited, solved again on finer meshes, and then solved by the
minimum principle from there. The best of what was found is named; a better one may exist, nothing here is global.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from models.checks import Array
from ocp import Collocation, Indirect, Problem, Solution, certificate, solve
from scripts.papers.free_floating.false_optima import INTERVALS, MAX_ITERATIONS, Settled, Solvers, first_guess, settle
from scripts.papers.run import Row

MakeProblem: TypeAlias = Callable[..., Problem]  # (horizon, guess_damping=...) -> the problem in joint rates

HORIZONS = (3.5, 4.0, 5.0, 6.0)  # s
DAMPINGS = (0.005, 0.02, 0.03, 0.1, 0.3, 1.0)  # of the local motion to start from; the builder's default is the first
SPREADS = (1.0, 0.5)  # of random guesses
SEEDS = range(6)  # for each spread
STARTS = len(DAMPINGS) + 1 + len(SPREADS) * len(SEEDS)
INDIRECT = (Indirect(20), Indirect(60))  # the second where the curves of the first are too coarse for its audit
AGREE = 1e-3  # largest relative difference of cost, states, costates between direct and indirect
SAME_COST = 1e-3  # relative: plans nearer than this in cost
SAME_RATES = 1e-2  # and in joint rates, relative to the largest, are one
GRID = 2001  # times that peaks are read from

CONFIRMED = "extremal"
NOT_GLOBAL = "These are the best results from the initial guesses; a better extremal may exist"
DIRECT_ONLY = "direct only: not confirmed by the minimum principle"


@dataclass(frozen=True)
class Extremal:
    """A plan that passes its audit and keeps its cost on finer meshes, until it is exact.

    Attributes:
        horizon: s.
        cost: J of (27) by collocation on `intervals`.
        indirect_cost: By the minimum principle, nan where it was not solved.
        newton_steps: Of the minimum principle. segments: On how many it was solved last.
        guess_count: Number of first guesses that lead to it. first_guess: The first of these.
        intervals: Of the direct solution.
        verdict: "extremal" where both methods agree and pass their audits, else that they do not.
        best: Least cost of the extremals found at this horizon; not more than that.
        t: Times. Shape (M,), s.
        joint_rates: Shape (M, n), rad/s.
    """

    horizon: float
    cost: float
    indirect_cost: float
    newton_steps: int
    segments: int
    guess_count: int
    first_guess: str
    intervals: int
    verdict: str
    best: bool
    t: Array
    joint_rates: Array

    @property
    def peaks(self) -> Array:
        """Signed joint rate that is largest in size, of each joint. Shape (n,), rad/s."""
        where = np.abs(self.joint_rates).argmax(axis=0)
        return np.asarray(self.joint_rates[where, np.arange(len(where))])


@dataclass(frozen=True)
class Search:
    """What a multi-start found at one horizon.

    Attributes:
        horizon: s.
        starts: Number of first guesses. solved: How many the solver calls optimal.
        rejected: How many of these do not integrate, or change their cost or fail their audit on finer meshes, or are
            not exact on the finest.
        extremals: By cost.
    """

    horizon: float
    starts: int
    solved: int
    rejected: int
    extremals: tuple[Extremal, ...]

    @property
    def best(self) -> Extremal:
        """The confirmed extremal of least cost.

        Raises:
            RuntimeError: None was found.
        """
        for extremal in self.extremals:
            if extremal.best:
                return extremal
        raise RuntimeError(f"no extremal was found at a horizon of {self.horizon:g} s from {self.starts} guesses")


@dataclass(frozen=True)
class Group:
    """Starts that led to one plan: the first of them, and how many."""

    first: str
    count: int
    plan: Solution


def search(make: MakeProblem, horizon: float, start_base: Array, start_joints: Array) -> Iterator[str | Search]:
    """Multi-start at one horizon: a word after each piece of work, the result at the end.

    Args:
        make: Makes the problem from a horizon and guess_damping, the damping of the local motion that it starts from.
        horizon: s.
        start_base: Shape (3,). start_joints: Shape (n,).
    """
    problem = make(horizon)
    prepared = Solvers(problem, "legendre")
    groups: list[Group] = []
    solved = 0
    for name, start in _starts(make, horizon, start_base, start_joints):
        plan = start if isinstance(start, Solution) else prepared[INTERVALS].solve(guess=start, check=False)
        if plan.success:
            solved += 1
            groups = _joined(groups, Group(name, 1, plan))
        yield name
    sound: list[Group] = []
    meshes: dict[int, int] = {}
    for group in groups:
        settled = _settled(prepared, group.plan)
        if settled is not None and settled.sound and settled.exact:
            meshes[id(settled.plan)] = settled.intervals
            sound = _joined(sound, replace(group, plan=settled.plan))
    extremals = sorted((_polished(problem, group, meshes[id(group.plan)]) for group in sound), key=lambda e: e.cost)
    best = next((e for e in extremals if e.verdict == CONFIRMED), None)
    result = sum(group.count for group in sound)
    yield Search(horizon, STARTS, solved, solved - result, tuple(replace(e, best=e is best) for e in extremals))


def _starts(
    make: MakeProblem, horizon: float, base: Array, joints: Array
) -> Iterator[tuple[str, Solution | dict[str, Any]]]:
    """Names, and the first guesses; of the local motions the plan itself, for they come with the problem."""
    method, limit = Collocation(INTERVALS, scheme="legendre"), {"max_iter": MAX_ITERATIONS}
    for damping in DAMPINGS:
        problem = make(horizon, guess_damping=damping)
        yield f"local motion, damping {damping:g}", solve(problem, method, options=limit, check=False)
    yield "constant", first_guess("constant", -1, base, joints)
    for spread in SPREADS:
        for seed in SEEDS:
            guess = first_guess("smooth", seed, base, joints, horizon, spread)
            yield f"smooth random, spread {spread:g}, seed {seed}", guess


def _settled(prepared: Solvers, plan: Solution) -> Settled | None:
    """The plan on a finer mesh; None if it is not worth one, its states not following from its controls."""
    if not plan.audit()["integration error, relative"].passed:
        return None
    return settle(prepared, plan)


def _joined(groups: Sequence[Group], new: Group) -> list[Group]:
    """The groups with one more, which joins the one that has its plan already."""
    for i, group in enumerate(groups):
        if _same(group.plan, new.plan):
            return [*groups[:i], replace(group, count=group.count + new.count), *groups[i + 1 :]]
    return [*groups, new]


def _same(a: Solution, b: Solution) -> bool:
    if abs(a.cost - b.cost) > SAME_COST * abs(a.cost):
        return False
    fractions = np.linspace(0.0, 1.0, 101)
    rates = a.at_fraction(fractions)["rates"]
    return bool(np.abs(b.at_fraction(fractions)["rates"] - rates).max() < SAME_RATES * np.abs(rates).max())


def _polished(problem: Problem, group: Group, intervals: int) -> Extremal:
    """Solve by the minimum principle from the direct plan, and compare the two."""
    plan = group.plan
    for method in INDIRECT:
        indirect = solve(problem, method, guess=plan, check=False)
        agree = indirect.success and certificate(problem, [plan, indirect], tolerance=AGREE).passed
        if agree:
            break
    t = np.linspace(0.0, plan.horizon, GRID)
    return Extremal(
        horizon=plan.horizon,
        cost=plan.cost,
        indirect_cost=indirect.cost if indirect.success else np.nan,
        newton_steps=indirect.iterations,
        segments=method.segments,
        guess_count=group.count,
        first_guess=group.first,
        intervals=intervals,
        verdict=CONFIRMED if agree else DIRECT_ONLY,
        best=False,
        t=t,
        joint_rates=(indirect if agree else plan).at(t)["rates"],
    )


def table(searches: Sequence[Search], paper_peaks: Sequence[float]) -> list[Row]:
    """Every extremal, and how far its peaks are from the ones in the paper, deg/s."""
    return [
        {
            "horizon_s": e.horizon,
            "cost_direct": f"{e.cost:.12g}",
            "cost_indirect": f"{e.indirect_cost:.12g}" if np.isfinite(e.indirect_cost) else "",
            "found": e.guess_count,
            "starts": one.starts,
            **{f"joint{i + 1}_peak_deg_s": float(peak) for i, peak in enumerate(np.degrees(e.peaks))},
            "largest_difference_from_paper_deg_s": _from_paper(e, paper_peaks),
            "intervals": e.intervals,
            "newton_steps": e.newton_steps,
            "first_found_from": e.first_guess,
            "verdict": e.verdict,
            "best": e.best,
        }
        for one in searches
        for e in one.extremals
    ]


def summary(searches: Sequence[Search], paper_peaks: Sequence[float]) -> dict[str, Any]:
    """What was found, with how many starts, and how near any of it comes to the peaks in the paper."""
    nearest = min((e for one in searches for e in one.extremals), key=lambda e: _from_paper(e, paper_peaks))
    return {
        "note": NOT_GLOBAL,
        "by_horizon": [
            {
                "horizon_s": one.horizon,
                "starts": one.starts,
                "solved": one.solved,
                "rejected": one.rejected,
                "best_cost": one.best.indirect_cost,
                "best_found": one.best.guess_count,
                "best_peak_joint_velocity_deg_s": np.degrees(one.best.peaks),
                "costs": [e.indirect_cost for e in one.extremals if e.verdict == CONFIRMED],
            }
            for one in searches
        ],
        "nearest_to_paper": {
            "horizon_s": nearest.horizon,
            "cost": nearest.cost,
            "peak_joint_velocity_deg_s": np.degrees(nearest.peaks),
            "largest_difference_deg_s": _from_paper(nearest, paper_peaks),
        },
    }


def _from_paper(extremal: Extremal, paper_peaks: Sequence[float]) -> float:
    """Largest difference of a peak from the paper's, deg/s."""
    return float(np.abs(np.degrees(extremal.peaks) - paper_peaks).max())
