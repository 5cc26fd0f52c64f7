"""Switches of a plan: times at which a control, constraint or state reaches or leaves a limit, and nodes there.

Minimum-time plans jump from limit to limit. A polynomial over an interval with such a jump oscillates beyond the limits
on any mesh, and its cost is too high; with a node at the jump it is exact. :func:`locate_switches` finds the jump from
the plan itself: the integral of the control over the interval equals that of the arcs before and after it, each
continued to the jump. Where a state reaches a limit, the control has the jump or the kink.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ocp.console import interruptible
from ocp.curves import differentiation_matrix, lagrange, quadrature_weights
from ocp.direct.discretisation import Collocation
from ocp.methods import solve
from ocp.problem.formulation import Formulation
from ocp.problem.problem import Problem
from ocp.solution import ByName, Solution
from ocp.tolerances import LIMIT_SHARE, RESOLVED_SHARE


@dataclass(frozen=True)
class SwitchingSettings:
    """Settings for locating the switches of a plan: times at which a control or constraint reaches or leaves a limit.

    Attributes:
        at_limit: Distance from a limit, relative to the range of both limits, below which a value is at the limit: the
            audit's tolerance. state_at_limit: The same for states, which approach a limit tangentially.
        jump: Smallest jump of a value at a switch, relative to that range.
        longest: Maximum number of intervals over which a jump may be smeared.
        too_near: Distance from a switch, relative to the wider interval beside it, below which other nodes are removed.
        same: Distance, relative to the horizon, below which two switches count as one.
        rounds: Maximum number of rounds.
        worth: Relative cost reduction below which moving the nodes again is not worthwhile.
        other: Relative cost increase above which the plan has changed into another one.
    """

    at_limit: float = LIMIT_SHARE
    state_at_limit: float = RESOLVED_SHARE
    jump: float = 0.05
    longest: int = 6
    too_near: float = 0.15
    same: float = 1e-7
    rounds: int = 3
    worth: float = RESOLVED_SHARE
    other: float = LIMIT_SHARE


SWITCHING = SwitchingSettings()
WARM_START_OPTIONS = {"mu_init": 1e-4}
"""IPOPT options that keep the iterates close to an initial guess that is nearly optimal."""


class Switches(NamedTuple):
    """Switches of a plan, where limits become active or inactive, and mesh intervals that contain a switch."""

    fractions: np.ndarray  # of the horizon, at the switches; shape (k,)
    smeared: np.ndarray  # mask of the mesh intervals that contain a switch; shape (N,)


def locate_switches(problem: Problem, solution: Solution) -> Switches:
    """Return the switches of a plan, where limits become active or inactive, and the mesh intervals that contain them.

    ``solution`` is a plan of ``problem`` by collocation with controls at the points.
    """
    form = Formulation.of(problem)
    breaks, nodes = solution.control_interpolant.breaks, solution.control_interpolant.nodes
    n, width = len(breaks) - 1, np.diff(breaks)
    values, low, high, has_control = _limited_values(form, solution)
    span = np.where(np.isfinite(high - low), high - low, np.ptp(values, axis=0))
    margin = np.where(has_control, SWITCHING.at_limit, SWITCHING.state_at_limit) * span
    side = np.where(values >= high - margin, 1, np.where(values <= low + margin, -1, 0))
    values, side = (part.reshape(n, len(nodes), -1) for part in (values, side))
    uniform = (side == side[:, :1]).all(axis=1)
    # a narrow interval inside its limits belongs to the switch that it smears
    wider = np.minimum(np.append(width[1:], 0.0), np.append(0.0, width[:-1]))
    inside = side[:, 0] == 0
    uniform &= ~inside | (width >= SWITCHING.too_near * wider)[:, None]
    first, last = (np.einsum("q,kqr->kr", lagrange(nodes, np.array([end]))[0], values) for end in (0.0, 1.0))
    continuous = np.abs(first[1:] - last[:-1]) <= SWITCHING.jump * span
    controls = solution.control_interpolant.values
    curves = _Arcs(breaks, nodes, np.concatenate([values, controls], axis=2))
    spans = np.concatenate([span, np.ptp(controls, axis=(0, 1))])
    fractions, smeared = [], np.zeros(n, bool)
    for row in range(values.shape[2]):
        # an arc inside the limits must continue smoothly away from the switch: near a singular arc controls oscillate
        before = uniform[:, row] & (~inside[:, row] | np.append(True, continuous[:, row]))
        after = uniform[:, row] & (~inside[:, row] | np.append(continuous[:, row], True))
        arcs = np.flatnonzero(uniform[:, row])
        for k, m in pairwise(arcs.tolist()):
            if side[k, 0, row] == side[m, 0, row]:
                continue
            i = next((i for i in range(k, -1, -1) if before[i] and side[i, 0, row] == side[k, 0, row]), k)
            j = next((j for j in range(m, n) if after[j] and side[j, 0, row] == side[m, 0, row]), m)
            if j - i > SWITCHING.longest:
                continue
            columns = [row] if has_control[row] else range(values.shape[2], len(spans))
            crossing = curves.crossing(i, j, columns, spans)
            if crossing is not None:
                fractions.append(crossing)
                smeared[i + 1 : j] = True
    inner = np.unique([at for at in fractions if SWITCHING.same < at < 1 - SWITCHING.same])
    return Switches(inner[np.diff(inner, prepend=-1.0) > SWITCHING.same], smeared)


@dataclass(frozen=True)
class _Arcs:
    """Limited quantities and controls of a plan as polynomials (arcs), one per mesh interval, that can be extrapolated.

    Attributes:
        breaks: Ends of the intervals. Shape (N + 1,).
        nodes: Positions of the values in an interval. Shape (d,).
        values: Shape (N, d, m).
    """

    breaks: np.ndarray
    nodes: np.ndarray
    values: np.ndarray

    def crossing(self, i: int, j: int, columns: Any, spans: np.ndarray) -> float | None:
        """Return the horizon fraction where the extrapolated polynomials of intervals i and j meet at a jump or kink.

        The column with the largest jump counts, above a share of its span; a jump is where the arcs enclose the same
        area as the plan. Shape of ``spans``: (m,). None if there is neither.
        """
        first, last = (lagrange(self.nodes, np.array([end]))[0] for end in (0.0, 1.0))
        matrix, width = differentiation_matrix(self.nodes), np.diff(self.breaks)
        a, b = self.breaks[i + 1], self.breaks[j]
        best, crossing = 0.0, None
        for column in columns:
            own, span = self.values[:, :, column], spans[column]
            before, after = last @ own[i], first @ own[j]
            rise, fall = last @ matrix @ own[i] / width[i], first @ matrix @ own[j] / width[j]
            area = float(quadrature_weights(self.nodes) @ own[i + 1 : j].T @ width[i + 1 : j])
            # both arcs continued as lines differ by gap + bend y at a + y, and enclose the area of the plan if
            # bend y^2 / 2 + gap y + excess = 0
            gap, bend = before - after + fall * (b - a), rise - fall
            excess = after * (b - a) - fall * (b - a) ** 2 / 2 - area
            roots = np.roots([bend / 2, gap, excess]) if bend else np.array([-excess / gap if gap else 0.0])
            place = float(min(np.clip(roots.real, 0.0, b - a), key=lambda y: abs(bend / 2 * y**2 + gap * y + excess)))
            jump = abs(gap + bend * place) / span if span > 0 else 0.0
            meeting = a - gap / bend if bend else np.nan
            if jump > max(SWITCHING.jump, best):
                best, crossing = jump, a + place
            elif best == 0.0 and self.breaks[i] <= meeting <= self.breaks[j + 1] and jump <= SWITCHING.jump:
                # a kink that a polynomial over the interval resolves needs no node
                bow = abs(bend) * max(b - a, width[i], width[j]) / 8
                crossing = meeting if bow > SWITCHING.at_limit * span else crossing
        return None if crossing is None else float(crossing)


def _limited_values(form: Formulation, solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the limited quantities at all control nodes, their limits, and whether each depends on a control.

    The values (M, m) are those of controls, path constraints with a control, states, and other path constraints.
    """
    curve, p = solution.control_interpolant, form.parameter_vector(solution.parameters)
    at = (curve.breaks[:-1, None] + np.diff(curve.breaks)[:, None] * curve.nodes).ravel()
    lower, upper = form.bound_values(p)
    x, u = solution.state_interpolant(at), curve.values.reshape(len(at), -1)
    g = form.sampled([form.path.expression], x, u, at * solution.horizon, solution.horizon, p)[0]
    index = np.concatenate([form.bounds.places[kind] for kind in ("control", "path", "state")])
    low, high = lower[index], upper[index]
    has_control = np.concatenate([np.ones(form.nu, bool), form.path.uses_control, np.zeros(form.nx, bool)])
    limited = (np.isfinite(low) | np.isfinite(high)) & (low < high)
    return np.hstack([u, g, x])[:, limited], low[limited], high[limited], has_control[limited]


@interruptible
def solve_at_switches(
    problem: Problem, method: Collocation, plan: Solution, *, parameters: ByName = None, options: ByName = None
) -> Solution:
    """Solve a problem again with mesh nodes at the switches of its plan, which each round locates more accurately.

    Args:
        problem, parameters, options: As for :func:`ocp.methods.solve`.
        method: The method of the plan, with controls at the points; its nodes stay, except those close to a switch.
        plan: The plan to start from.

    Returns:
        The last plan whose cost is not higher; ``plan`` itself without switches, or if another solve fails.
    """
    previous = np.zeros(0)
    for iteration in range(SWITCHING.rounds):
        located = locate_switches(problem, plan).fractions
        if len(located) == len(previous) and np.abs(located - previous).max(initial=0.0) < SWITCHING.same:
            break
        mesh = method.with_mesh(nodes_at_switches(method.fractions, located))
        arguments: dict[str, Any] = {"parameters": parameters, "options": {**WARM_START_OPTIONS, **(options or {})}}
        candidate = solve(problem, mesh, guess=plan, check=False, **arguments)
        gain = (plan.cost - candidate.cost) / max(abs(plan.cost), abs(candidate.cost), np.finfo(float).tiny)
        if not candidate.success or gain < -SWITCHING.other:
            break
        settled, previous, plan = len(located) == len(previous), located, candidate
        if iteration and gain < SWITCHING.worth and not settled:
            break
    return plan


def nodes_at_switches(mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Add nodes at switches to a mesh, remove the old nodes that are close to a switch, and return the new mesh."""
    width = np.diff(mesh)
    after = np.clip(np.searchsorted(mesh, at, side="right"), 1, len(width)) - 1
    before = np.clip(np.searchsorted(mesh, at, side="left"), 1, len(width)) - 1
    wider = np.maximum(width[before], width[after])
    close = (np.abs(mesh[1:-1, None] - at) < SWITCHING.too_near * wider).any(axis=1)
    return np.unique(np.concatenate([mesh[[0, -1]], mesh[1:-1][~close], at]))
