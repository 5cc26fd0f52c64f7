"""Nodes where a plan switches: at the ends of the arcs on which its controls, and what they push, keep to their limits.

Plans of least time jump from limit to limit. A polynomial over an interval with such a jump inside it swings beyond the
limits, however fine the mesh is, and costs too much; with a node at the jump it does neither. Where the jump is tells
the plan itself: what it pushes in the interval altogether is what the arcs before and after it push, each to the jump.
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
    """How switches are found.

    Attributes:
        at_limit: Share of the range between two limits, nearer to which a value is at one: as near as audits look.
        jump: Share of that range by which a value jumps at least, where it switches.
        longest: Intervals that a jump may be smeared over.
        too_near: Share of the interval that a switch falls into, nearer to which other nodes give way.
        same: Share of the horizon, nearer to which switches are one.
        rounds: At most.
        worth: Share of the cost by which a plan gets cheaper, where moving its nodes was worth it.
        other: Share of the cost by which a plan gets dearer, where it became another one.
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
"""Of IPOPT, from a plan that is nearly right: it stays the same plan."""


def switches(problem: Problem, solution: Solution) -> np.ndarray:
    """Fractions of the horizon at which a control or path constraint comes onto a limit, or off it. Shape (k,).

    Args:
        problem: What was solved, by collocation with controls at the points.
        solution: Its plan.
    """
    form = Formulation.of(problem)
    breaks, nodes = solution.control_interpolant.breaks, solution.control_interpolant.nodes
    n, width = len(breaks) - 1, np.diff(breaks)
    at = (breaks[:-1, None] + width[:, None] * nodes).ravel()
    owner, place = np.repeat(np.arange(n), len(nodes)), np.tile(nodes, n)
    values, low, high = _pushed(form, solution, at, owner, place)
    span = np.where(np.isfinite(high - low), high - low, np.ptp(values, axis=0))
    near = SETTINGS.at_limit * span
    state = np.where(values >= high - near, 1, np.where(values <= low + near, -1, 0))
    values, state = (part.reshape(n, len(nodes), -1) for part in (values, state))
    same = (state == state[:, :1]).all(axis=1)
    slope = np.einsum("ij,kjr->kir", differentiation_matrix(nodes), values) / width[:, None, None]
    first, last = (lagrange(nodes, np.array([side]))[0] for side in (0.0, 1.0))
    area = np.einsum("q,kqr->kr", quadrature_weights(nodes), values) * width[:, None]
    found = []
    for row in range(values.shape[2]):
        whole = np.flatnonzero(same[:, row])
        for i, j in pairwise(whole.tolist()):
            if state[i, 0, row] == state[j, 0, row] or j - i > SETTINGS.longest:
                continue
            a, b = breaks[i + 1], breaks[j]
            before, after = last @ values[i, :, row], first @ values[j, :, row]
            rise, fall = last @ slope[i, :, row], first @ slope[j, :, row]
            with np.errstate(divide="ignore", invalid="ignore"):  # where the arcs meet, if they do
                there = (before - rise * a - after + fall * b) / (fall - rise)
            if not breaks[i] <= there <= breaks[j + 1]:
                if not abs(after - before) > SETTINGS.jump * span[row]:
                    continue
                # else where as much is pushed as by one up to there, by the other from there
                there = np.clip(a + (area[i + 1 : j, row].sum() - after * (b - a)) / (before - after), a, b)
            found.append(float(there))
    return np.unique(found)


def _pushed(
    form: Formulation, solution: Solution, at: np.ndarray, owner: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Controls and path constraints with controls that have limits, at M places (M, m), and the limits (m,)."""
    p = form.parameter_vector(solution.parameters)
    lower, upper = form.bound_values(p)
    x, u = solution.state_interpolant(at), solution.control_interpolant.within(owner, place)
    g = form.sampled([form.path.expression], x, u, at * solution.horizon, solution.horizon, p)[0]
    index = np.concatenate([form.bounds.places[kind] for kind in ("control", "path")])
    low, high = lower[index], upper[index]
    own = np.concatenate([np.ones(form.nu, bool), form.path.uses_control])
    own &= (np.isfinite(low) | np.isfinite(high)) & (low < high)
    return np.hstack([u, g])[:, own], low[own], high[own]


@interruptible
def solve_at_switches(
    problem: Problem, method: Collocation, plan: Solution, *, parameters: ByName = None, options: ByName = None
) -> Solution:
    """The plan solved again with nodes where it switches, which are found better each time.

    Args:
        problem, parameters, options: As for :func:`ocp.methods.solve`.
        method: What made the plan, with controls at the points; its nodes stay, but for those beside a switch.
        plan: To start from.

    Returns:
        The last plan that is no dearer; ``plan`` itself where nothing switches, or where another solve fails.
    """
    known = np.zeros(0)
    for turn in range(SETTINGS.rounds):
        found = _apart(switches(problem, plan))
        if len(found) == len(known) and np.abs(found - known).max(initial=0.0) < SETTINGS.same:
            break
        mesh = method.with_mesh(_mesh(method.fractions, found))
        given: dict[str, Any] = {"parameters": parameters, "options": {**WARM_START_OPTIONS, **(options or {})}}
        again = solve(problem, mesh, guess=plan, check=False, **given)
        won = (plan.cost - again.cost) / max(abs(plan.cost), abs(again.cost), np.finfo(float).tiny)
        if not again.success or won < -SETTINGS.other:
            break
        settles, known, plan = len(found) == len(known), found, again
        if turn and won < SETTINGS.worth and not settles:
            break
    return plan


def _apart(found: np.ndarray) -> np.ndarray:
    """Switches inside the horizon, of those that are one the first."""
    inside = found[(found > SETTINGS.same) & (found < 1 - SETTINGS.same)]
    return np.asarray(inside[np.diff(inside, prepend=-1.0) > SETTINGS.same])


def _mesh(mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A mesh with nodes at the switches, those of the given one beside them left out."""
    inner, width = mesh[1:-1], np.diff(mesh)
    piece = np.clip(np.searchsorted(mesh, at, side="right") - 1, 0, len(width) - 1)
    near = (np.abs(inner[:, None] - at) < SETTINGS.too_near * width[piece]).any(axis=1)
    return np.unique(np.concatenate([mesh[[0, -1]], inner[~near], at]))
