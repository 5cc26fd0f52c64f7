"""Certificate: do several solutions of one problem, by independent methods, agree?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.audit import Audit, audit
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import Solution, check_variables_match
from ocp.tolerances import LIMIT_SHARE

__all__ = ["Certificate", "Comparison", "certificate"]


@dataclass(frozen=True)
class Comparison:
    """Differences of a solution from the reference, relative to the size of the reference.

    The Hamiltonian is judged by the size of its parts, and the cost also by that of the running cost, since both may
    vanish.

    Attributes:
        name: Name of the solution.
        passed: Whether its audit passed.
        cost, horizon: Values.
        cost_difference, horizon_difference: Relative differences.
        state, costate: Largest difference over time.
        control: Mean difference over time: at a jump, solutions with slightly different switching times differ by the
            full jump.
        hamiltonian: Mean difference over time.
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
    """Comparison of several solutions of one problem.

    Attributes:
        problem: Name of the problem.
        reference: Name of the solution that the others are compared with.
        comparisons: One for each solution, the reference first.
        tolerance: Largest relative difference at which solutions agree.
        audits: The audit of each solution by name.
    """

    problem: str
    reference: str
    comparisons: tuple[Comparison, ...]
    tolerance: float
    audits: dict[str, Audit]

    @property
    def passed(self) -> bool:
        """Whether all solutions agree and every audit passed."""
        return all(c.passed and c.worst <= self.tolerance for c in self.comparisons)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        different = [c.name for c in self.comparisons if not c.worst <= self.tolerance]
        failed = [c.name for c in self.comparisons if not c.passed]
        if self.passed:
            return f"{len(self.comparisons)} solutions agree to {self.tolerance:g}, and each passed its audit"
        parts = []
        if different:
            parts.append(f"{', '.join(different)} differ from {self.reference} by more than {self.tolerance:g}")
        if failed:
            parts.append(f"the audit of {', '.join(failed)} failed")
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
        solutions: By name, or a sequence named after the methods. The reference is the first indirect solution, else
            the first.
        tolerance: Largest relative difference at which solutions agree.

    Raises:
        ProblemError: Fewer than two solutions, a solution of another problem, or different parameters.
    """
    require.positive("certificate: tolerance", tolerance)
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
    fractions = (np.arange(400) + 0.5) / 400
    comparisons = []
    for name in order:
        solution = named[name]
        reported = solution.t[:-1] / solution.horizon  # costates are best where they are reported
        values, _, _ = sample(form, solution, p, fractions, reported)
        expected, hamiltonian_size, running_size = sample(form, first, p, fractions, reported)
        differences = [difference(a, b) for a, b in zip(values[:3], expected[:3], strict=True)]
        differences.append(np.abs(values[3] - expected[3]) / (hamiltonian_size or 1.0))
        size = max(abs(first.cost), running_size * first.horizon) or 1.0
        comparisons.append(
            Comparison(
                name,
                audits[name].passed,
                solution.cost,
                solution.horizon,
                abs(solution.cost - first.cost) / size,
                abs(solution.horizon - first.horizon) / first.horizon,
                float(np.max(differences[0], initial=0.0)),
                float(np.max(np.mean(differences[1], axis=0), initial=0.0)),
                float(np.max(differences[2], initial=0.0)),
                float(np.mean(differences[3])),
            )
        )
    return Certificate(problem.name, reference, tuple(comparisons), tolerance, audits)


def checked_solutions(solutions: Any) -> dict[str, Solution]:
    """Return solutions by name, those of a sequence by their methods; raise ProblemError for anything else."""
    if not isinstance(solutions, Mapping):
        return name_by_method(require.each("certificate: solutions", solutions, Solution))
    named = require.mapping("certificate: solutions", solutions)
    require.each("certificate: solutions", named.values(), Solution)
    return named


def name_by_method(solutions: Sequence[Solution]) -> dict[str, Solution]:
    """Return names such as ``Collocation legendre-3, 50``, numbered if they repeat."""
    named: dict[str, Solution] = {}
    for solution in solutions:
        method = solution.method
        detail = {
            "Collocation": f" {method.get('scheme')}-{method.get('degree')}, {method.get('intervals')}",
            "MultipleShooting": f" {method.get('integrator')} {method.get('control')}, {method.get('intervals')}",
            "Indirect": f" {method.get('shooting')}, {method.get('segments')}",
        }.get(method["type"], "")
        name = base = method["type"] + detail
        count = 1
        while name in named:
            count += 1
            name = f"{base} ({count})"
        named[name] = solution
    return named


def sample(
    form: Formulation, solution: Solution, p: np.ndarray, fractions: np.ndarray, reported: np.ndarray
) -> tuple[list[np.ndarray], float, float]:
    """Return states and controls at ``fractions``, costates and Hamiltonian at ``reported`` fractions, and two sizes.

    The sizes are the largest sum of the absolute parts of the Hamiltonian, which itself vanishes for a free horizon,
    and the mean absolute running cost.
    """
    lam = solution.costate_interpolant(reported)
    symbol = form.sym("lam", form.nx)
    x, u = solution.state_interpolant(reported), solution.control_interpolant(reported)
    expressions = [ca.vertcat(form.running, symbol * form.f)]
    values = form.sampled(expressions, x, u, reported * solution.horizon, solution.horizon, p, (symbol, lam))[0]
    hamiltonian, size = values.sum(axis=1), float(np.max(np.abs(values).sum(axis=1), initial=0.0))
    x, u = solution.state_interpolant(fractions), solution.control_interpolant(fractions)
    running = form.sampled([form.running], x, u, fractions * solution.horizon, solution.horizon, p)[0]
    return [x, u, lam, hamiltonian], size, float(np.mean(np.abs(running)))


def difference(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return differences relative to the largest entry of the reference."""
    size = float(np.max(np.abs(reference), initial=0.0))
    return np.asarray(np.abs(values - reference) / (size if size > 0 else 1.0))
