"""Hand-made plans, valid or not, and the verdicts that an audit must reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from ocp import Audit, Problem, Solution
from ocp.curves import PiecewisePolynomial
from ocp.errors import SolverStatus
from ocp.problem.formulation import Formulation
from tests.ocp.problems import Array

Curve: TypeAlias = Any
"""A function of times (M,), s: values (M,) or (M, n); or a constant, a number or a list of n."""

LOBATTO = np.array([0.0, 0.5 - np.sqrt(5) / 10, 0.5 + np.sqrt(5) / 10, 1.0])


def sampled(pool: Mapping[str, Curve], t: Array) -> dict[str, Array]:
    """Curves at times t (M,), each (M, n)."""
    by_name = {}
    for name, curve in pool.items():
        values = np.asarray(curve(t) if callable(curve) else curve, dtype=float)
        if values.ndim < 2:
            values = values[:, None] if values.shape == t.shape else np.tile(np.atleast_1d(values), (len(t), 1))
        by_name[name] = values
    return by_name


def random_program(
    problem: Problem,
    states: Mapping[str, Curve],
    controls: Mapping[str, Curve],
    costates: Mapping[str, Curve],
    horizon: float,
    mesh: Any = 20,
    parameters: Mapping[str, Any] | None = None,
) -> Solution:
    """A plan made of curves of time: cubic polynomials between the breaks, with the cost that they have.

    Args:
        problem: Whose names and cost are used; it need not allow the plan.
        states, controls, costates: By name. A control that jumps at a break is asked just beside it.
        mesh: Breaks as fractions 0..1 of the horizon, or how many equal intervals.
    """
    form = Formulation(problem)
    breaks = np.linspace(0.0, 1.0, mesh + 1) if isinstance(mesh, int) else np.asarray(mesh, dtype=float)
    n, d = len(breaks) - 1, len(LOBATTO)
    beside = np.clip(LOBATTO, 1e-9, 1 - 1e-9)
    at = ((breaks[:-1, None] + np.diff(breaks)[:, None] * LOBATTO) * horizon).ravel()
    inside = ((breaks[:-1, None] + np.diff(breaks)[:, None] * beside) * horizon).ravel()
    x = sampled({name: states[name] for name in form.states}, at)
    u = sampled({name: controls[name] for name in form.controls}, inside)
    lam = sampled({name: costates[name] for name in form.states}, inside)
    curves = [
        PiecewisePolynomial(breaks, LOBATTO, np.hstack([np.zeros((n * d, 0)), *pool.values()]).reshape(n, d, -1))
        for pool in (x, u, lam)
    ]
    p = form.parameter_vector(dict(parameters or {}))
    place, weight = np.polynomial.legendre.leggauss(8)
    fine = (breaks[:-1, None] + np.diff(breaks)[:, None] * (place + 1) / 2).ravel()
    running = form.sampled([form.running], curves[0](fine), curves[1](fine), fine * horizon, horizon, p)[0]
    spent = float(np.dot(np.outer(np.diff(breaks), weight / 2).ravel() * horizon, running[:, 0]))
    ends = [curves[0](np.array([end]))[0] for end in (1.0, 0.0)]
    cost = spent + form.terminal_cost(ends[0], ends[1], curves[1](np.zeros(1))[0], horizon=horizon, p=p)
    keep = np.tile(np.arange(d) < d - 1, n)
    keep[-1] = True
    return Solution(
        name=problem.name,
        method={"type": "drawn by hand"},
        solver="none",
        success=True,
        status=SolverStatus.SOLVED,
        message="drawn by hand",
        cost=cost,
        iterations=0,
        horizon=horizon,
        t=at[keep],
        states={name: values[keep] for name, values in x.items()},
        controls={name: values[keep] for name, values in u.items()},
        costates={name: values[keep] for name, values in lam.items()},
        parameters={name: p[place] for name, place in form.parameters.items()},
        cost_gradients={name: np.zeros(place.stop - place.start) for name, place in form.parameters.items()},
        state_interpolant=curves[0],
        control_interpolant=curves[1],
        costate_interpolant=curves[2],
        variables=np.zeros(0),
        multipliers=np.zeros(0),
        seconds={"build": 0.0, "solve": 0.0},
        problem=problem,
    )


def of(plan: Solution, problem: Problem) -> Solution:
    """The same plan, for another problem."""
    return replace(plan, name=problem.name, problem=problem)


def holds(audit: Audit) -> None:
    """Check that the plan is feasible and a local minimum."""
    assert audit.feasible, str(audit)
    assert audit.optimal is True, str(audit)
    assert audit.passed


def is_no_minimum(audit: Audit) -> None:
    """Check that the motion is feasible and no local minimum."""
    assert audit.feasible, str(audit)
    assert audit.optimal is False, str(audit)
    assert not audit.passed


def is_no_proven_minimum(audit: Audit) -> None:
    """Check that the motion is feasible and not accepted as a minimum: rejected, or undetermined with a reason."""
    assert audit.feasible, str(audit)
    assert audit.optimal is not True, str(audit)
    assert audit.optimal is False or audit.undecided
    assert not audit.passed


def violates_its_task(audit: Audit) -> None:
    """Check that the motion is infeasible."""
    assert not audit.feasible, str(audit)
    assert not audit.passed
