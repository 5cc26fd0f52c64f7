"""One certificate for several solutions of one problem: do independent methods agree?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.audit import Audit, audit
from ocp.console import interruptible
from ocp.errors import ProblemError, checked_each, checked_mapping, checked_positive
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import Solution, check_variables_match
from ocp.tolerances import LIMIT_SHARE

__all__ = ["Certificate", "Comparison", "certificate"]


@dataclass(frozen=True)
class Comparison:
    """A solution against the reference, each difference relative to the size of the reference's own.

    The Hamiltonian is judged by the size of its parts, the cost by that of the running cost too: both may vanish.

    Attributes:
        name: The solution. passed: Whether its audit passed.
        cost, horizon: Values. cost_difference, horizon_difference: relative.
        state, costate: Largest difference over time. control: its mean over time, for where a control jumps two
            solutions that switch a moment apart differ by the whole jump. hamiltonian: mean over time.
    """

    name: str
    passed: bool
    cost: float
    horizon: float
    cost_difference: float
    horizon_difference: float
    state: float
    control: float
    costate: float
    hamiltonian: float

    @property
    def worst(self) -> float:
        """The largest difference."""
        differences = (self.cost_difference, self.horizon_difference, self.state, self.control, self.costate)
        return max(*differences, self.hamiltonian)


@dataclass(frozen=True)
class Certificate:
    """What comparing several solutions of one problem found.

    Attributes:
        problem: Its name. reference: Name of the solution that the others are compared with.
        comparisons: One for each solution, the reference first.
        tolerance: Largest difference, relative, at which solutions agree.
        audits: The audit of each solution by name.
    """

    problem: str
    reference: str
    comparisons: tuple[Comparison, ...]
    tolerance: float
    audits: dict[str, Audit]

    @property
    def passed(self) -> bool:
        """Whether all solutions agree and every one passed its audit."""
        return all(c.passed and c.worst <= self.tolerance for c in self.comparisons)

    @property
    def verdict(self) -> str:
        """One sentence."""
        apart = [c.name for c in self.comparisons if not c.worst <= self.tolerance]
        failed = [c.name for c in self.comparisons if not c.passed]
        if self.passed:
            return f"{len(self.comparisons)} solutions agree to {self.tolerance:g}, and each passed its audit"
        parts = [f"{', '.join(apart)} differ from {self.reference} by more than {self.tolerance:g}"] if apart else []
        parts += [f"the audit of {', '.join(failed)} failed"] if failed else []
        return "; ".join(parts)

    def __repr__(self) -> str:
        return f"<Certificate of {self.problem!r}: {self.verdict}>"

    def __str__(self) -> str:
        width = max(len(c.name) for c in self.comparisons)
        head = ("cost", "d cost", "d state", "d control", "d costate", "d H")
        lines = [f"Certificate of {self.problem!r}: {'passed' if self.passed else 'FAILED'}"]
        lines.append(f"  {'solution':<{width}}  {head[0]:>15}" + "".join(f"  {h:>9}" for h in head[1:]) + "  audit")
        for c in self.comparisons:
            values = (c.cost_difference, c.state, c.control, c.costate, c.hamiltonian)
            row = "".join(f"  {v:>9.1e}" for v in values)
            lines.append(f"  {c.name:<{width}}  {c.cost:>15.12g}{row}  {'passed' if c.passed else 'FAILED'}")
        lines.append(f"  differences are relative to {self.reference}; {self.verdict}")
        return "\n".join(lines)


@interruptible
def certificate(
    problem: Problem, solutions: Mapping[str, Solution] | Sequence[Solution], *, tolerance: float = LIMIT_SHARE
) -> Certificate:
    """Compare solutions of one problem by different methods, and audit each.

    Args:
        problem: The problem that all of them solve.
        solutions: By name, or a sequence named after their methods. The reference is the first indirect one, else the
            first.
        tolerance: Largest relative difference at which they agree.

    Raises:
        ProblemError: Fewer than two solutions, one of another problem, or solved at other parameters.
    """
    checked_positive("certificate: tolerance", tolerance)
    named = checked_solutions(solutions)
    if len(named) < 2:
        words = f"a certificate compares at least two solutions, not {len(named)}"
        raise ProblemError(words, name="solutions", value=len(named), limit=2)
    form = Formulation.of(problem)
    for solution in named.values():
        check_variables_match(form, solution)
    order = sorted(named, key=lambda name: named[name].method["type"] != "Indirect")  # stable: indirect first
    reference = order[0]
    p = form.parameter_vector(named[reference].parameters)
    for name, solution in named.items():
        if not np.array_equal(form.parameter_vector(solution.parameters), p):
            raise ProblemError(f"plans {reference!r} and {name!r} were solved at different parameters", name=name)
    audits = {name: audit(problem, named[name]) for name in order}
    first = named[reference]
    spread = (np.arange(400) + 0.5) / 400
    comparisons = []
    for name in order:
        solution = named[name]
        own = solution.t[:-1] / solution.horizon  # costates are best where they are reported
        (mine, _, _), (other, parts, running) = (sample(form, plan, p, spread, own) for plan in (solution, first))
        off = [difference(a, b) for a, b in zip(mine[:3], other[:3], strict=True)]
        off.append(np.abs(mine[3] - other[3]) / (parts or 1.0))
        size = max(abs(first.cost), running * first.horizon) or 1.0
        comparisons.append(
            Comparison(
                name,
                audits[name].passed,
                solution.cost,
                solution.horizon,
                abs(solution.cost - first.cost) / size,
                abs(solution.horizon - first.horizon) / first.horizon,
                float(np.max(off[0], initial=0.0)),
                float(np.max(np.mean(off[1], axis=0), initial=0.0)),
                float(np.max(off[2], initial=0.0)),
                float(np.mean(off[3])),
            )
        )
    return Certificate(problem.name, reference, tuple(comparisons), tolerance, audits)


def checked_solutions(solutions: Any) -> dict[str, Solution]:
    """Solutions by name, those of a sequence by their methods; ProblemError where something else is among them."""
    if not isinstance(solutions, Mapping):
        return name_by_method(checked_each("certificate: solutions", solutions, Solution))
    named = checked_mapping("certificate: solutions", solutions)
    checked_each("certificate: solutions", named.values(), Solution)
    return named


def name_by_method(solutions: Sequence[Solution]) -> dict[str, Solution]:
    """Names such as ``Collocation legendre-3, 50``, numbered where they repeat."""
    named: dict[str, Solution] = {}
    for solution in solutions:
        m = solution.method
        detail = {
            "Collocation": f" {m.get('scheme')}-{m.get('degree')}, {m.get('intervals')}",
            "MultipleShooting": f" {m.get('integrator')} {m.get('control')}, {m.get('intervals')}",
            "Indirect": f" {m.get('shooting')}, {m.get('segments')}",
        }.get(m["type"], "")
        name = base = m["type"] + detail
        count = 1
        while name in named:
            count += 1
            name = f"{base} ({count})"
        named[name] = solution
    return named


def sample(
    form: Formulation, solution: Solution, p: np.ndarray, spread: np.ndarray, own: np.ndarray
) -> tuple[list[np.ndarray], float, float]:
    """States and controls at fractions ``spread``, costates and Hamiltonian at fractions ``own``, and two sizes.

    The sizes are the largest sum of the sizes of the Hamiltonian's parts, for H itself vanishes where the horizon is
    free, and the mean size of the running cost, for the cost may vanish as well.
    """
    lam = solution.costate_interpolant(own)
    symbol = form.sym("lam", form.nx)
    x, u = solution.state_interpolant(own), solution.control_interpolant(own)
    parts = [ca.vertcat(form.running, symbol * form.f)]
    found = form.sampled(parts, x, u, own * solution.horizon, solution.horizon, p, (symbol, lam))[0]
    hamiltonian, size = found.sum(axis=1), float(np.max(np.abs(found).sum(axis=1), initial=0.0))
    x, u = solution.state_interpolant(spread), solution.control_interpolant(spread)
    running = form.sampled([form.running], x, u, spread * solution.horizon, solution.horizon, p)[0]
    return [x, u, lam, hamiltonian], size, float(np.mean(np.abs(running)))


def difference(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Differences relative to the largest entry of the reference."""
    size = float(np.max(np.abs(reference), initial=0.0))
    return np.asarray(np.abs(values - reference) / (size if size > 0 else 1.0))
