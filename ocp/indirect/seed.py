"""Initial guess of the indirect method from a direct solution (seed): bang-bang arcs, unknowns and data.

The signs of dH/du along the seed determine at which bound each linear control is, and where it switches. A seed with a
singular arc or chattering is rejected. States, costates and switch times of the seed are the first unknowns. The seed
has its variables in the order of the problem (:func:`ocp.solution_data.match_order`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ocp.errors import SolveError
from ocp.indirect.hamiltonian import Hamiltonian
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.values import evaluate_at_samples
from ocp.solution import Solution
from ocp.solution_data import stack
from ocp.tolerances import RESOLVED_SHARE, SOLVER_SHARE


@dataclass(frozen=True)
class SeedSettings:
    """Criteria by which a direct solution, which may be coarse, is rejected as an initial guess (seed).

    Attributes:
        inside: Distance from both bounds, relative to their range, beyond which a control is inside them.
        singular: Share of the horizon, and number of consecutive samples, that a control may spend inside its bounds.
        quick: Consecutive arcs shorter than an interval of the seed that count as chattering.
    """

    inside: float = 0.1
    singular: tuple[float, int] = 0.1, 3
    quick: int = 3


SETTINGS = SeedSettings()


@dataclass(frozen=True)
class ControlArcs:
    """Arcs between the switches of bang-bang controls, which are the controls in which the Hamiltonian is linear.

    Attributes:
        switches: Fractions of the horizon. Shape (A - 1,).
        components: Which linear control switches at each. Length A - 1.
        segments: Number of shooting segments of every arc. Length A.
        bang: Values of the linear controls in every segment. Shape (S, n_linear).
    """

    switches: np.ndarray
    components: tuple[int, ...]
    segments: tuple[int, ...]
    bang: np.ndarray

    @property
    def nodes(self) -> np.ndarray:
        """Index of the shooting node at every switch. Shape (A - 1,)."""
        return np.cumsum(self.segments)[:-1]

    def times(self, horizon: float) -> np.ndarray:
        """Return the times of all shooting nodes, s. Shape (S + 1,)."""
        knots = np.concatenate([[0.0], self.switches, [1.0]]) * horizon
        arcs = [np.linspace(knots[a], knots[a + 1], n + 1)[:-1] for a, n in enumerate(self.segments)]
        return np.concatenate([*arcs, [horizon]])


def read_arcs(
    ham: Hamiltonian, outputs: Any, seed: Solution, p: np.ndarray, *, bounds: Bounds, segments: int
) -> ControlArcs:
    """Return the bang-bang arcs of a direct solution, between the sign changes of its switching functions dH/du.

    Where dH/du > 0, the lower bound is active.

    Raises:
        SolveError: A control in which H is linear stays inside its bounds (a singular arc) or chatters.
    """
    form = ham.form
    if not ham.linear:
        return ControlArcs(np.zeros(0), (), (segments,), np.zeros((segments, 0)))
    index_of = list(ham.linear)
    index = form.bounds.places["control"][index_of]
    low, high = bounds[0][index], bounds[1][index]
    x, lam, u = (stack(pool) for pool in (seed.states, seed.costates, seed.controls))
    guess = np.hstack([u[:, list(ham.smooth)], np.zeros((len(u), len(form.path)))])
    slope = evaluate_at_samples(outputs, x, lam, seed.t[:, None], seed.horizon, p, u[:, index_of], guess)[3]
    seed_low, seed_high = seed_bounds(form, seed)
    check_singular(ham, seed, seed_low[index_of], seed_high[index_of])

    at_lower = signs(slope) > 0
    events: list[tuple[float, int]] = []
    for j in range(len(ham.linear)):
        for k in np.flatnonzero(at_lower[1:, j] != at_lower[:-1, j]):
            before, after = slope[k, j], slope[k + 1, j]
            share = before / (before - after)
            events.append((float(seed.t[k] + share * (seed.t[k + 1] - seed.t[k])) / seed.horizon, j))
    events = sorted(event for event in events if 1e-6 < event[0] < 1 - 1e-6)
    switches = np.array([at for at, _ in events])
    check_chattering(ham, events, seed)
    widths = np.diff(np.concatenate([[0.0], switches, [1.0]]))
    counts = tuple(int(max(2, round(segments * width))) for width in widths)
    state = at_lower[0].copy()
    values = []
    for arc, count in enumerate(counts):
        values += [np.where(state, low, high)] * count
        if arc < len(events):
            state[events[arc][1]] = ~state[events[arc][1]]
    return ControlArcs(switches, tuple(j for _, j in events), counts, np.array(values))


def seed_bounds(form: Formulation, seed: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Return the control bounds under which a direct solution (seed) was computed. Shape (nu,) each."""
    source = form if seed.problem is None else Formulation(seed.problem)
    low, high = source.bound_values(source.parameter_vector(seed.parameters))
    places = source.bounds.places["control"]
    index = np.concatenate([places[source.controls[name]] for name in form.controls])
    return low[index], high[index]


def signs(slope: np.ndarray) -> np.ndarray:
    """Return the signs of sampled switching functions (M, n); a value near zero takes the next significant sign.

    After the last significant sample its sign continues. A switching function that vanishes at an end, for example at a
    free state, would have the sign of the seed's noise there.
    """
    result = np.sign(slope)
    for j in range(slope.shape[1]):
        significant = np.flatnonzero(np.abs(slope[:, j]) > SOLVER_SHARE * np.max(np.abs(slope[:, j])))
        if significant.size:
            nearest = np.clip(np.searchsorted(significant, np.arange(len(slope))), 0, len(significant) - 1)
            result[:, j] = np.sign(slope[significant[nearest], j])
    return np.asarray(result)


def check_singular(ham: Hamiltonian, seed: Solution, low: np.ndarray, high: np.ndarray) -> None:
    """Raise SolveError if a control in which the Hamiltonian is linear stays inside its bounds for too long."""
    samples = seed.control_interpolant
    widths = np.diff(samples.breaks)
    at = (samples.breaks[:-1, None] + widths[:, None] * samples.nodes).ravel()
    values = samples.values.reshape(len(at), -1)[:, list(ham.linear)]
    for j, index in enumerate(ham.linear):
        margin = SETTINGS.inside * (high[j] - low[j])
        inside = (values[:, j] > low[j] + margin) & (values[:, j] < high[j] - margin)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            width = at[end - 1] - at[begin]
            if width > SETTINGS.singular[0] and end - begin > SETTINGS.singular[1]:
                label = ham.form.control_labels[index]
                raise SolveError(
                    f"control {label!r} has a singular arc from {at[begin] * seed.horizon:.4g} to "
                    f"{at[end - 1] * seed.horizon:.4g} s, where the Hamiltonian does not determine it; use a direct "
                    "method, or add a small quadratic term in it to the cost",
                    name=label,
                    time=float(at[begin] * seed.horizon),
                )


def check_chattering(ham: Hamiltonian, events: list[tuple[float, int]], seed: Solution) -> None:
    """Raise SolveError if a control of a direct solution (seed) switches in several successive mesh intervals."""
    width = 1.5 * float(np.max(np.diff(seed.control_interpolant.breaks)))
    for j, index in enumerate(ham.linear):
        label = ham.form.control_labels[index]
        at = np.array([time for time, component in events if component == j])
        quick = np.diff(at) < width
        for k in range(len(quick) - SETTINGS.quick + 1):
            if quick[k : k + SETTINGS.quick].all():
                raise SolveError(
                    f"control {label!r} switches in every interval from {at[k] * seed.horizon:.4g} s on: "
                    "a singular arc or chattering, where the Hamiltonian does not determine it; use a direct method "
                    "with held controls, or add a small quadratic term in it to the cost",
                    name=label,
                    time=float(at[k] * seed.horizon),
                )


def read_unknowns(
    ham: Hamiltonian, seed: Solution, arcs: ControlArcs, p: np.ndarray, *, bounds: Bounds, backward: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial unknowns and data of a :class:`ocp.indirect.boundary.BoundaryProblem` from a direct solution.

    The unknowns are states and costates at all nodes, switch times, the horizon if free, and multipliers of start and
    end constraints (zero); for backward shooting the end state alone. A seed of another horizon is stretched.
    """
    form = ham.form
    horizon = seed.horizon if form.horizon_is_free else float(form.horizon_at(p))
    times = arcs.times(horizon)
    fractions = times / horizon
    x, lam, _ = sample_seed(seed, fractions)
    places = form.bounds.places
    ends = []
    for end in ("initial", "terminal"):
        fixed = bounds[0][places[end]] == bounds[1][places[end]]
        ends += [fixed, np.where(fixed, bounds[0][places[end]], 0.0)]
    guess = control_guess(ham, seed, 0.5 * (fractions[:-1] + fractions[1:]), horizon=horizon, p=p, bounds=bounds)
    data = np.concatenate([[horizon], p, *ends, arcs.bang.ravel(), guess.ravel()])
    if backward:
        return x[-1], data
    free = [horizon] if form.horizon_is_free else []
    multipliers = np.zeros(len(form.start) + len(form.end))
    return np.concatenate([np.hstack([x, lam]).ravel(), arcs.switches * horizon, free, multipliers]), data


def sample_seed(seed: Solution, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states, costates and controls of a direct solution at K fractions of the horizon. Shape (K, size) each."""
    lam = np.column_stack([np.interp(fractions * seed.horizon, seed.t, column) for column in stack(seed.costates).T])
    return seed.state_interpolant(fractions), lam, seed.control_interpolant(fractions)


def control_guess(
    ham: Hamiltonian, seed: Solution, fractions: np.ndarray, *, horizon: float, p: np.ndarray, bounds: Bounds
) -> np.ndarray:
    """Return a guess of smooth controls and path equality multipliers at fractions of the horizon. Shape (K, n + m).

    With bounds, the control equations cannot be solved from distant multipliers: all controls would be at bounds.
    """
    form, count = ham.form, len(fractions)
    x, lam, control = sample_seed(seed, fractions)
    mu = np.zeros((count, len(form.path)))
    if len(form.path):
        low, high = (bound[form.bounds.places["control"]] for bound in bounds)
        free = (control > low + RESOLVED_SHARE) & (control < high - RESOLVED_SHARE)
        mu = ham.multipliers(free, x, control, lam, t=fractions * horizon, horizon=horizon, p=p)
    return np.hstack([control[:, list(ham.smooth)], mu])
