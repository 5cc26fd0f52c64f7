"""The free-floating optimum by independent methods: minimum principle, costates, Hamiltonian, certificates.

The costates of the direct methods are multipliers of their programs, those of the minimum principle solve a
differential equation: nothing but the problem is common to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.checks import Array
from ocp import Certificate, Collocation, Indirect, MultipleShooting, Problem, Solution, certificate, solve
from scripts.papers.run import Row

PLAN = Collocation(100, degree=3, scheme="legendre")
RADAU = Collocation(100, degree=3, scheme="radau")
SECOND_OPINION = MultipleShooting(100, control="linear")
FORWARD = Indirect(20, shooting="multiple", tolerance=1e-13)
BACKWARD = Indirect(20, shooting="backward", tolerance=1e-13)
AGREE = 1e-4  # relative difference at which a certificate passes


@dataclass(frozen=True)
class Agreement:
    """One optimum, by every method.

    Attributes:
        plan: Legendre 3, 100 intervals. multiple, backward: The minimum principle, seeded by it.
        shooting: Multiple shooting of the null-space form (26).
        rates, null_space: The solutions of each formulation by name.
        certificates: Of each formulation, by its name.
    """

    plan: Solution
    multiple: Solution
    backward: Solution
    shooting: Solution
    rates: dict[str, Solution]
    null_space: dict[str, Solution]
    certificates: dict[str, Certificate]


def agreement(rates: Problem, null_space: Problem) -> Agreement:
    """Solve both formulations by every method that takes them, and compare within each."""
    plan, null_plan = solve(rates, PLAN), solve(null_space, PLAN)
    multiple, backward = (solve(rates, method, guess=plan) for method in (FORWARD, BACKWARD))
    shooting = solve(null_space, SECOND_OPINION)
    by_rates = {
        "minimum principle, multiple shooting": multiple,
        "minimum principle, backward shooting": backward,
        "Legendre 3, 100 intervals": plan,
        "Radau 3, 100 intervals": solve(rates, RADAU),
    }
    by_null_space = {
        "minimum principle, multiple shooting": solve(null_space, FORWARD, guess=null_plan),
        "shooting RK4, linear control, 100 intervals": shooting,
        "Legendre 3, 100 intervals": null_plan,
    }
    return Agreement(
        plan,
        multiple,
        backward,
        shooting,
        by_rates,
        by_null_space,
        {
            "rates": certificate(rates, by_rates, tolerance=AGREE),
            "null space": certificate(null_space, by_null_space, tolerance=AGREE),
        },
    )


def costates(solution: Solution, fractions: Array | None = None) -> Array:
    """Costates of base (x, y, angle) and joints, at the reported times or at fractions of the horizon. Shape (M, 6)."""
    if fractions is None:
        return np.hstack([solution.costate("base"), solution.costate("joints")])
    return np.asarray(solution.costate_interpolant(fractions))


def costate_difference(direct: Solution, indirect: Solution) -> Array:
    """Difference at the times that the direct solution reports, relative to the largest costate. Shape (M, 6)."""
    theirs = costates(indirect, direct.t / direct.horizon)
    return np.asarray((costates(direct) - theirs) / np.abs(theirs).max())


def hamiltonians(result: Agreement) -> dict[str, tuple[Array, Array]]:
    """Times (M,), s, and H (M,), rad^2/s^2, of every solution, by its name and formulation."""
    pools: Mapping[str, Mapping[str, Solution]] = {"rates": result.rates, "null space": result.null_space}
    curves = {}
    for form, pool in pools.items():
        for name, solution in pool.items():
            value = result.certificates[form].audits[name].optimality.hamiltonian.values
            curves[f"{name} ({form})"] = (solution.t, value)
    return curves


def certificate_rows(result: Agreement) -> list[Row]:
    """Both certificates as one table; differences relative to the minimum principle of the same formulation."""
    return [
        {
            "formulation": form,
            "solution": c.name,
            "cost": f"{c.cost:.14g}",
            "cost_difference": c.cost_difference,
            "state_difference": c.state,
            "control_difference": c.control,
            "costate_difference": c.costate,
            "hamiltonian_difference": c.hamiltonian,
            "hamiltonian_drift": one.audits[c.name].optimality.hamiltonian.drift,
            "audit": c.passed,
            "agrees": c.worst <= one.tolerance,
        }
        for form, one in result.certificates.items()
        for c in one.comparisons
    ]


def indirect_summary(result: Agreement, start: Array) -> dict[str, Any]:
    """Numbers of the minimum principle by multiple shooting, and by backward shooting beneath it.

    Args:
        start: States (base, joints) that the motion starts from. Shape (6,).
    """
    audits = result.certificates["rates"].audits
    names = {id(solution): name for name, solution in result.rates.items()}

    def numbers(solution: Solution) -> dict[str, Any]:
        first = np.concatenate([solution["base"][0], solution["joints"][0]])
        return {
            "shooting": solution.method["shooting"],
            "segments": solution.method["segments"],
            "cost": solution.cost,
            "newton_steps": solution.iterations,
            "hamiltonian": audits[names[id(solution)]].optimality.hamiltonian.values.mean(),
            "hamiltonian_drift": audits[names[id(solution)]].optimality.hamiltonian.drift,
            "costate_at_end": np.abs(costates(solution)[-1]).max(),
            "start_error": np.abs(first - start).max(),
            "costate_difference_from_direct": np.abs(costate_difference(result.plan, solution)).max(),
        }

    return {**numbers(result.multiple), "backward": numbers(result.backward)}
