"""Nodes at the switches of a plan: the ends of the arcs on which controls and path constraints are at their limits.

Minimum-time plans jump from limit to limit. A polynomial over an interval with such a jump oscillates beyond the limits
on any mesh, and its cost is too high; with a node at the jump it is exact. The jump is located from the plan itself:
the integral of the control over the interval equals that of the arcs before and after it, each continued to the jump.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ocp.console import interruptible
from ocp.curves import differentiation_matrix, lagrange, quadrature_weights
from ocp.direct.collocation import Collocation
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import ByName, Solution
from ocp.tolerances import LIMIT_SHARE, RESOLVED_SHARE

__all__ = ["WARM_START_OPTIONS", "solve_at_switches", "switches"]


@dataclass(frozen=True)
class SwitchingSettings:
    """Settings of the location of switches.

    Attributes:
        at_limit: Distance from a limit, relative to the range of both limits, below which a value is at it: the audit's
            tolerance.
        jump: Smallest jump of a value at a switch, relative to that range.
        longest: Maximum number of intervals over which a jump may be smeared.
        too_near: Distance from a switch, relative to its interval, below which other nodes are removed.
        same: Distance, relative to the horizon, below which two switches count as one.
        rounds: Maximum number of rounds.
        worth: Relative cost reduction below which moving the nodes again is not worthwhile.
        other: Relative cost increase above which the plan has changed into another one.
    """

    at_limit: float = LIMIT_SHARE
    jump: float = 0.05
    longest: int = 4
    too_near: float = 0.15
    same: float = 1e-7
    rounds: int = 3
    worth: float = RESOLVED_SHARE
    other: float = LIMIT_SHARE


SETTINGS = SwitchingSettings()
WARM_START_OPTIONS = {"mu_init": 1e-4}
"""Options of IPOPT for a nearly optimal guess, which keep the iterates close to it."""


def switches(problem: Problem, solution: Solution) -> np.ndarray:
    """Return fractions of the horizon at which a control or path constraint reaches or leaves a limit. Shape (k,).

    Args:
        problem: The problem that was solved, by collocation with controls at the points.
        solution: Its plan.
    """
    form = Formulation.of(problem)
    breaks, nodes = solution.control_interpolant.breaks, solution.control_interpolant.nodes
    n, width = len(breaks) - 1, np.diff(breaks)
    at = (breaks[:-1, None] + width[:, None] * nodes).ravel()
    owner, place = np.repeat(np.arange(n), len(nodes)), np.tile(nodes, n)
    values, low, high = _limited_values(form, solution, at, owner, place)
    span = np.where(np.isfinite(high - low), high - low, np.ptp(values, axis=0))
    margin = SETTINGS.at_limit * span
    state = np.where(values >= high - margin, 1, np.where(values <= low + margin, -1, 0))
    values, state = (part.reshape(n, len(nodes), -1) for part in (values, state))
    uniform = (state == state[:, :1]).all(axis=1)
    slope = np.einsum("ij,kjr->kir", differentiation_matrix(nodes), values) / width[:, None, None]
    first, last = (lagrange(nodes, np.array([side]))[0] for side in (0.0, 1.0))
    area = np.einsum("q,kqr->kr", quadrature_weights(nodes), values) * width[:, None]
    fractions = []
    for row in range(values.shape[2]):
        arcs = np.flatnonzero(uniform[:, row])
        for i, j in pairwise(arcs.tolist()):
            if state[i, 0, row] == state[j, 0, row] or j - i > SETTINGS.longest:
                continue
            a, b = breaks[i + 1], breaks[j]
            before, after = last @ values[i, :, row], first @ values[j, :, row]
            rise, fall = last @ slope[i, :, row], first @ slope[j, :, row]
            with np.errstate(divide="ignore", invalid="ignore"):  # intersection of both arcs
                crossing = (before - rise * a - after + fall * b) / (fall - rise)
            if not breaks[i] <= crossing <= breaks[j + 1]:
                if not abs(after - before) > SETTINGS.jump * span[row]:
                    continue
                # otherwise the point at which both arcs enclose the same area as the plan
                crossing = np.clip(a + (area[i + 1 : j, row].sum() - after * (b - a)) / (before - after), a, b)
            fractions.append(float(crossing))
    return np.unique(fractions)


def _limited_values(
    form: Formulation, solution: Solution, at: np.ndarray, owner: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the controls and the path constraints with controls that have limits, at M places (M, m), and the limits
    (m,).
    """
    p = form.parameter_vector(solution.parameters)
    lower, upper = form.bound_values(p)
    x, u = solution.state_interpolant(at), solution.control_interpolant.within(owner, place)
    g = form.sampled([form.path.expression], x, u, at * solution.horizon, solution.horizon, p)[0]
    index = np.concatenate([form.bounds.places[kind] for kind in ("control", "path")])
    low, high = lower[index], upper[index]
    limited = np.concatenate([np.ones(form.nu, bool), form.path.uses_control])
    limited &= (np.isfinite(low) | np.isfinite(high)) & (low < high)
    return np.hstack([u, g])[:, limited], low[limited], high[limited]


@interruptible
def solve_at_switches(
    problem: Problem, method: Collocation, plan: Solution, *, parameters: ByName = None, options: ByName = None
) -> Solution:
    """Solve a plan again with nodes at its switches, whose locations improve in each round.

    Args:
        problem, parameters, options: As for :func:`ocp.methods.solve`.
        method: The method of the plan, with controls at the points; its nodes stay, except those close to a switch.
        plan: The plan to start from.

    Returns:
        The last plan whose cost is not higher; ``plan`` itself without switches, or if another solve fails.
    """
    previous = np.zeros(0)
    for iteration in range(SETTINGS.rounds):
        located = _distinct(switches(problem, plan))
        if len(located) == len(previous) and np.abs(located - previous).max(initial=0.0) < SETTINGS.same:
            break
        mesh = method.with_mesh(_mesh(method.fractions, located))
        arguments: dict[str, Any] = {"parameters": parameters, "options": {**WARM_START_OPTIONS, **(options or {})}}
        candidate = solve(problem, mesh, guess=plan, check=False, **arguments)
        gain = (plan.cost - candidate.cost) / max(abs(plan.cost), abs(candidate.cost), np.finfo(float).tiny)
        if not candidate.success or gain < -SETTINGS.other:
            break
        settled, previous, plan = len(located) == len(previous), located, candidate
        if iteration and gain < SETTINGS.worth and not settled:
            break
    return plan


def _distinct(fractions: np.ndarray) -> np.ndarray:
    """Return the switches inside the horizon, the first of those that count as one."""
    inside = fractions[(fractions > SETTINGS.same) & (fractions < 1 - SETTINGS.same)]
    return np.asarray(inside[np.diff(inside, prepend=-1.0) > SETTINGS.same])


def _mesh(mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return a mesh with nodes at the switches, without the old nodes close to them."""
    inner, width = mesh[1:-1], np.diff(mesh)
    interval = np.clip(np.searchsorted(mesh, at, side="right") - 1, 0, len(width) - 1)
    close = (np.abs(inner[:, None] - at) < SETTINGS.too_near * width[interval]).any(axis=1)
    return np.unique(np.concatenate([mesh[[0, -1]], inner[~close], at]))
