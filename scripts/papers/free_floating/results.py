"""The free-floating example of Kim, Kim 2011, solved by every method: what its script draws and tabulates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from models import FreeFloating, paper_example
from models.checks import Array
from ocp import Audit, Collocation, MultipleShooting, Problem, RateOptions, Solution, resolve, solve
from scripts.papers.free_floating import extremals, false_optima
from scripts.papers.free_floating.extremals import Search
from scripts.papers.free_floating.false_optima import Trial
from scripts.papers.free_floating.formulations import (
    HORIZON,
    ROWS,
    START_JOINTS,
    TASK,
    TIP_VELOCITY,
    null_space_problem,
    problem,
)
from scripts.papers.free_floating.motion import Laws, Motion, laws, motion_of_local, motion_of_plan
from scripts.papers.free_floating.optimality import BACKWARD, Agreement, agreement
from scripts.papers.run import Row, progress

START_BASE = np.zeros(3)  # printed
STEP = 1e-3  # s, of the grids that peaks are read from
START = np.concatenate([START_BASE, START_JOINTS])

ASSUMED = (
    "Not printed in the paper: links 2 m long, arm mounted at (1, 0) m of the base, centres of mass at mid-link "
    "(identified from the pattern of Table 1)"
)
CHOSEN = f"horizon {HORIZON:g} s (chosen, not printed)"
NOTE = f"{ASSUMED}; {CHOSEN}."

PAPER_PEAKS = {"pseudo-inverse": (157.8240, 69.7189, -113.5345), "optimum": (70.4688, -22.0748, -98.1823)}
"""Table 1, deg/s."""
PAPER_ACCELERATIONS = {"pseudo-inverse": (-154757.4, -14153.14, 148085.1), "optimum": (-811.6214, 136.2558, -296.0277)}
"""Table 2, at the instant of the peak velocity, deg/s^2."""

CAVEATS = {
    "peaks": {
        "pseudo-inverse": "converged; the rest is sensitivity to the geometry that is not printed, see sensitivity.csv",
        "optimum": "not comparable: the paper's horizon is not printed, ours is 5 s; no extremal found at other "
        "horizons has the paper's peaks either, see extremals.csv",
    },
    "accelerations": {
        "pseudo-inverse": "not reproducible: the velocity is smooth, so that its derivative is 0 at a peak inside the "
        "motion",
        "optimum": "not comparable: the paper's horizon is not printed, ours is 5 s",
    },
}
LENGTHS = (1.998, 2.0, 2.001, 2.00214)
"""Link lengths of the sensitivity table, m. The last would bring the first peak to Table 1: shown, never used."""

METHODS: tuple[tuple[str, int, tuple[int, ...], Callable[[int], Any]], ...] = (
    ("Radau 3", 5, (50, 100, 200), lambda n: Collocation(n)),
    ("Legendre 3", 6, (25, 50, 100, 200), lambda n: Collocation(n, scheme="legendre")),
    ("multiple shooting RK4, held control", 2, (50, 100, 200), lambda n: MultipleShooting(n)),
    ("multiple shooting RK4, linear control", 4, (50, 100, 200), lambda n: MultipleShooting(n, control="linear")),
)
"""Name, order of the cost, numbers of intervals."""


@dataclass(frozen=True)
class Results:
    """Everything that is drawn, tabled and summarised.

    Attributes:
        machine: The paper's example.
        local: Pseudo-inverse motion, every millisecond. near_peaks: the same, every microsecond near the peaks.
        optimal: The plan, every millisecond.
        agreement: The optimum by every method. audit, laws: of the plan among them, re-integrated.
        convergence, sensitivity: Rows of the tables.
        trials: False optima.
        searches: Extremals at every horizon.
    """

    machine: FreeFloating
    local: Motion
    near_peaks: Motion
    optimal: Motion
    agreement: Agreement
    audit: Audit
    laws: Laws
    convergence: list[Row]
    sensitivity: list[Row]
    trials: list[Trial]
    searches: list[Search]

    @property
    def tabled(self) -> Mapping[str, Motion]:
        """The motions of Tables 1 and 2, by method."""
        return {"pseudo-inverse": self.near_peaks, "optimum": self.optimal}


def pseudo_inverse(machine: FreeFloating, times: Array) -> Motion:
    """Motion (26) with u = 0 at given times."""
    local = resolve(machine, TASK, times[-1], start=START_JOINTS, samples=times, options=RateOptions(tolerance=1e-12))
    if local.stopped:
        raise RuntimeError(f"the pseudo-inverse motion ends early: {local.stopped}")
    return motion_of_local(machine, local, TIP_VELOCITY, ROWS)


def compute() -> Results:
    """Solve everything."""
    machine = paper_example()
    local = pseudo_inverse(machine, grid())
    around = [np.arange(-STEP, STEP, 1e-6) + peak for peak in local.peak_joint_rates()[1]]
    near_peaks = pseudo_inverse(machine, np.unique(np.concatenate([grid(), *around]).round(9)))

    rates, null_space = problem(), null_space_problem()
    result = agreement(rates, null_space)
    audit = result.plan.audit()
    study = false_optima.trials(problem(false_optima.HORIZON), START_BASE, START_JOINTS)
    return Results(
        machine=machine,
        local=local,
        near_peaks=near_peaks,
        optimal=motion_of_plan(machine, result.plan, grid(), ROWS, result.backward),
        agreement=result,
        audit=audit,
        laws=laws(machine, audit, TIP_VELOCITY),
        convergence=convergence(rates, null_space, result),
        sensitivity=sensitivity(),
        trials=list(progress(study, "false optima", len(false_optima.GUESSES))),
        searches=[search(horizon) for horizon in extremals.HORIZONS],
    )


def search(horizon: float) -> Search:
    """Multi-start at one horizon."""
    work = extremals.search(problem, horizon, START_BASE, START_JOINTS)
    for done in progress(work, f"extremals, {horizon:g} s", extremals.STARTS + 1):
        if isinstance(done, Search):
            return done
    raise AssertionError("a search ends with its result")


def convergence(rates: Problem, null_space: Problem, known: Agreement) -> list[Row]:
    """Cost by every method and mesh, and its difference from the minimum principle's."""
    runs = [(name, order, n, make(n)) for name, order, counts, make in METHODS for n in counts]
    reference = known.backward.cost
    rows: list[Row] = []
    for name, order, intervals, method in progress(runs, "convergence"):
        solution = solve(null_space if isinstance(method, MultipleShooting) else rates, method)
        rows.append(_convergence_row(name, intervals, order, solution, reference))
    for shooting, solution in (("forward multiple", known.multiple), ("backward", known.backward)):
        name = f"minimum principle, {shooting} shooting"
        rows.append(_convergence_row(name, BACKWARD.segments, 0, solution, reference))
    return rows


def sensitivity() -> list[Row]:
    """Peaks of the pseudo-inverse motion when the links' length, which is not printed, is a little different."""
    rows: list[Row] = []
    for length in LENGTHS:
        peaks, _ = pseudo_inverse(_stretched(length), grid()).peak_joint_rates()
        rows.append({"link_length_m": length, **{f"joint{i + 1}_deg_s": v for i, v in enumerate(np.degrees(peaks))}})
    paper = dict(zip(list(rows[0])[1:], PAPER_PEAKS["pseudo-inverse"], strict=True))
    return [*rows, {"link_length_m": "paper, Table 1", **paper}]


def _stretched(length: float) -> FreeFloating:
    """The example with links of another length, their mass, inertia and centre of mass unchanged."""
    robot = paper_example().robot
    place = (length, 0.0, 0.0)
    joints = [replace(joint, translation=place) if k else joint for k, joint in enumerate(robot.joints)]
    return FreeFloating(replace(robot, joints=tuple(joints), tip_translation=place), base="planar")


def grid() -> Array:
    """Times from 0 to the horizon, one every millisecond."""
    return np.linspace(0.0, HORIZON, round(HORIZON / STEP) + 1)


def _convergence_row(method: str, intervals: int, order: int, result: Solution, reference: float) -> Row:
    return {
        "method": method,
        "intervals": intervals,
        "order": order or "",
        "cost": f"{result.cost:.14g}",
        "difference": result.cost - reference,
        "iterations": result.iterations,
    }
