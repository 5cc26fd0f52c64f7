"""One problem of a family by one method: solved, audited, and the verdict held against the truth."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ocp import Collocation, Indirect, MultipleShooting, ProblemError, Solution, SolveError, solve
from tests.sweep.optima import FAMILIES, miss
from tests.sweep.quadratics import Quadratic, least_curvature, random_quadratic

__all__ = ["COUNTS", "METHODS", "OPTIMA", "QUADRATIC", "Verdict", "judged", "table"]

METHODS: dict[str, Callable[[int], Any]] = {
    "held": lambda size: MultipleShooting(4 * size, steps=2),
    "linear": lambda size: MultipleShooting(4 * size, steps=2, control="linear"),
    "radau": lambda size: Collocation(size, 4),
    "legendre": lambda size: Collocation(size, 4, "legendre"),
    "indirect": lambda size: Indirect(),
}
SIZES = (3, 6, 12, 24)
"""Of the meshes, coarse ones among them: a plan that costs too much is as much a test as a good one."""
QUADRATIC = "quadratic"
OPTIMA = tuple(FAMILIES)
COUNTS = {QUADRATIC: 400, **dict.fromkeys(OPTIMA, 150)}
"""Problems of each family in the whole sweep."""
BEYOND = (("Breakwell", "indirect"),)
"""Families that a method does not take: it knows no bounds of states."""
OFF = 1e-3
"""Share of the cost by which a plan that passes may be off."""
CLEARLY = 2e-4
"""Share by which a plan misses what is asked that no audit may fail."""
DECIDED = 0.02
"""Least curvature, relative, from which a discretised second variation decides."""


@dataclass(frozen=True)
class Verdict:
    """What the audit said, and what is true.

    Attributes:
        family, method, seed: Which. outcome: ``pass``, ``false pass``, ``fail``, ``false fail``, ``undecided`` (an
            optimum that is neither passed nor failed), ``unsolved`` or ``unknown`` (no truth to hold it against).
        off: Cost found less optimum, as a share of the optimum; for quadratics the least curvature.
        why: Rows that fail, or what the solver said. seconds: Of solving and auditing.
    """

    family: str
    method: str
    seed: int
    outcome: str
    off: float
    why: str
    seconds: float


def judged(family: str, seed: int, methods: Iterable[str] | None = None, show: bool = False) -> list[Verdict]:
    """Verdicts on one problem by several methods."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if family == QUADRATIC:
            return _quadratic(seed, methods, show)
        known = FAMILIES[family](seed)
        results = []
        for name in methods or [name for name in METHODS if (family, name) not in BEYOND]:
            began = time.monotonic()
            plan, message = _solved(known.problem, METHODS[name](SIZES[seed % 7 % 4]))
            if plan is None:
                results.append(Verdict(family, name, seed, "unsolved", np.nan, message, time.monotonic() - began))
                continue
            audit = plan.audit()
            seconds = time.monotonic() - began
            best = known.cost(plan)
            off = (plan.cost - best) / abs(best)
            missed = miss(known, plan)
            sound = bool(abs(off) <= OFF and missed <= CLEARLY)
            unsound = bool(abs(off) > OFF)
            outcome = _outcome(audit, sound, unsound) if np.isfinite(off) else "unknown"
            if show:
                print(f"{family}, seed {seed}, {name}: {outcome}; cost off by {off:.2e}, missed by {missed:.2e}")
                print(audit)
            results.append(Verdict(family, name, seed, outcome, off, _why(audit), seconds))
        return results


def _quadratic(seed: int, methods: Iterable[str] | None, show: bool) -> list[Verdict]:
    """The extremal drawn by hand, and the plan of one method in turn."""
    quadratic, minimum, kind = random_quadratic(seed)
    problem, family = quadratic.problem(), f"{QUADRATIC}, {kind}"
    family += ", given end" if quadratic.fixed else ", free end"
    names = list(methods) if methods else ["drawn", list(METHODS)[seed % len(METHODS)]]
    results = []
    for name in names:
        began = time.monotonic()
        if name == "drawn" and kind == "bounds met":
            continue  # beyond its bounds
        plan, message = (
            (quadratic.plan(problem), "")
            if name == "drawn"
            else _solved(problem, METHODS[name](24), check=False, options={"max_iter": 200})
        )
        if plan is None:
            # a method may see for itself that there is no minimum
            outcome = "unsolved" if minimum and kind != "bounds met" else "fail"
            results.append(Verdict(family, name, seed, outcome, np.nan, message, time.monotonic() - began))
            continue
        audit = plan.audit()
        seconds = time.monotonic() - began
        exact = name == "drawn" or abs(plan.cost - _exact(quadratic)) <= OFF * _size(quadratic)
        curved = least_curvature(quadratic, plan) if not exact or kind == "bounds met" or show else np.nan
        sound, unsound = minimum and exact, not minimum and exact
        if kind == "bounds met" or not exact:  # another extremal, along bounds
            sound, unsound = curved > DECIDED and exact, curved < -DECIDED
        if kind == "bounds met":
            beyond = np.abs(plan.at_fraction(np.linspace(0, 1, 2001))["u"]).max() / quadratic.bound - 1
            sound = curved > DECIDED and beyond < CLEARLY
        outcome = _outcome(audit, bool(sound), bool(unsound))
        if show:
            print(f"{family}, seed {seed}, {name}: {outcome}; minimum: {minimum}, least curvature {curved:.3g}")
            print(audit)
        results.append(Verdict(family, name, seed, outcome, float(curved), _why(audit), seconds))
    return results


def _exact(quadratic: Quadratic) -> float:
    return float(quadratic.plan(quadratic.problem()).cost)


def _size(quadratic: Quadratic) -> float:
    """Of the cost, none of whose parts may cancel."""
    along, _ = quadratic.extremal()
    t = np.linspace(0, quadratic.horizon, 201)
    path = along(t)
    n = len(quadratic.a)
    x, lam = path[:, :n], path[:, n:]
    u = -np.linalg.solve(quadratic.r, quadratic.s.T @ x.T + quadratic.b.T @ lam.T).T
    spent = np.abs(np.einsum("ti,ij,tj->t", x, quadratic.q, x)) + np.einsum("ti,ij,tj->t", u, quadratic.r, u)
    return float(np.trapezoid(spent, t)) / 2 + quadratic.pull * quadratic.horizon + 1e-9


def _solved(problem: Any, method: Any, **how: Any) -> tuple[Solution | None, str]:
    """A plan that the solver calls optimal, or what it says."""
    try:
        plan = solve(problem, method, **how)
        return (plan, "") if plan.success else (None, plan.message)
    except (SolveError, ProblemError) as error:
        return None, str(error).splitlines()[0][:160]


def _outcome(audit: Any, sound: bool, unsound: bool) -> str:
    if audit.passed:
        return "false pass" if unsound else "pass"
    if not sound:
        return "fail"
    return "undecided" if getattr(audit, "optimal", False) is None and audit.feasible else "false fail"


def _why(audit: Any) -> str:
    matches = [f"{f.name} {f.value:.1e}" for f in audit.failures]
    return "; ".join([*matches, *([audit.undecided] if getattr(audit, "undecided", "") else [])])


OUTCOMES = ("pass", "false pass", "fail", "false fail", "undecided", "unsolved", "unknown")


def table(verdicts: Sequence[Verdict]) -> str:
    """Counts by family and method, then every bad one by its seed."""
    lines = [f"{'family':<44}{'method':<10}" + "".join(f"{word:>12}" for word in OUTCOMES) + f"{'s each':>9}"]
    for key in sorted({(v.family, v.method) for v in verdicts}):
        mine = [v for v in verdicts if (v.family, v.method) == key]
        counts = "".join(f"{sum(v.outcome == word for v in mine):>12}" for word in OUTCOMES)
        seconds = f"{np.mean([v.seconds for v in mine]):>9.2f}"
        lines.append(f"{key[0]:<44}{key[1]:<10}{counts}{seconds}")
    for word in ("false pass", "false fail", "undecided", "unsolved", "unknown"):
        mine = [v for v in verdicts if v.outcome == word]
        if mine:
            lines += ["", f"{word}:"]
            lines += [f"  {v.family}, {v.method}, seed {v.seed}: {v.off:.2e}  {v.why}" for v in mine]
    return "\n".join(lines)
