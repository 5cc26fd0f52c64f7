"""Initial points of a solver: guesses evaluated for the variables of a transcription, and alternative initial points.

If the solver fails from the guess, it may start from a displaced guess, from zeros or from a roll-out of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import rk4_step
from ocp.direct.assembly import Transcription
from ocp.errors import ProblemError, error_names, require
from ocp.problem.formulation import Bounds, Formulation, total
from ocp.problem.values import middle_horizon, numeric, table
from ocp.solution import Guess, Solution
from ocp.solution_data import NODE_TOLERANCE
from ocp.tolerances import ROUNDING_SHARE

Trajectory = Callable[[np.ndarray], np.ndarray]  # fractions of the horizon (M,) -> values (M, n)


def initial_point(form: Formulation, transcription: Transcription, guess: Guess, bounds: Bounds) -> np.ndarray:
    """Return the initial point of the solver, a value for each variable of the program, from a guess. Shape (size,).

    ``guess`` takes precedence over the guess declared with a variable. Without either the values follow a straight line
    between the fixed ends, or the middle of the bounds. A solution on another grid or by another method is read over
    fractions of its horizon.

    Raises:
        ProblemError: An unknown name, a wrong size, or a number that is not finite.
    """
    guesses = dict(form.guesses)
    low, high = (side[form.bounds.places["horizon"][0]] for side in bounds)
    horizon = middle_horizon(low, high) if form.horizon_guess is None else float(np.clip(form.horizon_guess, low, high))
    values: dict[str, Any] = {}
    curves: dict[str, Trajectory] = {}
    if isinstance(guess, Solution):
        curves, horizon = from_solution(form, guess), guess.horizon
    elif isinstance(guess, Mapping):
        values = {name: value for name, value in guess.items() if name != "t"}
        known = [*form.states, *form.controls, "horizon", "t"]
        for name in values:
            if name not in known:
                raise require.unknown("variable in guess", name, known)
    elif guess is not None:
        text = f"guess must be a Solution, a dictionary or None, not {type(guess).__name__}"
        raise ProblemError(text, name="guess", value=guess)
    if "horizon" in values:
        with error_names("horizon"):
            number = numeric("guess of the horizon", values.pop("horizon"))
        if not (number.size == 1 and np.isfinite(number[0]) and number[0] > 0):
            text = f"guess of the horizon must be one positive finite number, not {number.tolist()} s"
            raise ProblemError(text, name="horizon", value=number.tolist())
        horizon = float(number[0])
    guesses.update(values)
    times = None if guess is None or isinstance(guess, Solution) else guess.get("t")

    point = np.zeros(transcription.size)
    point[transcription.variable_role == "horizon"] = horizon
    for role, declared in (("state", form.states), ("control", form.controls)):
        chosen = transcription.variable_role == role
        fractions, slot = np.unique(transcription.variable_fraction[chosen], return_inverse=True)
        table = np.zeros((len(fractions), total(declared)))
        for name, entries in declared.items():
            value = guesses.get(name)
            if name in curves:
                curve = curves[name]
            elif value is None:
                curve = default(form, role, entries, bounds)
            else:
                with error_names(name):
                    curve = _trajectory(name, value, entries.stop - entries.start, horizon, times)
            with error_names(name):
                table[:, entries] = curve(fractions)
            for i in np.flatnonzero(~np.isfinite(table[:, entries]).all(axis=1)):
                text = f"guess of {name!r} is not finite at {fractions[i] * horizon:g} s: {table[i, entries]}"
                raise ProblemError(text, name=name, value=table[i, entries], time=float(fractions[i] * horizon))
        point[chosen] = table[slot, transcription.variable_entry[chosen]]
    return point


def guessed_names(form: Formulation, guess: Guess) -> set[str]:
    """Return the names of states and controls, and ``horizon``, for which the guess or the problem states a value."""
    names = {name for name, value in form.guesses.items() if value is not None}
    if form.horizon_guess is not None:
        names.add("horizon")
    if isinstance(guess, Solution):
        return names | {*guess.states, *guess.controls, "horizon"}
    return names | {*(guess or {})}


def shifted_indices(transcription: Transcription, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each variable and constraint, the index of its counterpart ``intervals`` mesh intervals later.

    Where the horizon ends earlier, it is the index of the variable or row itself.
    """
    step = intervals / (len(transcription.mesh) - 1)
    roles, entries = transcription.variable_role, transcription.variable_entry
    meanings = [f"{role} {entry}" for role, entry in zip(roles, entries, strict=True)]
    variables = meanings, transcription.variable_fraction
    rows = transcription.row_labels, transcription.row_fractions
    indices = []
    for kinds, fractions in (variables, rows):
        _, label = np.unique(kinds, return_inverse=True)
        order = np.lexsort((fractions, label))
        key = label[order] + fractions[order] / 2  # sorted by meaning, then by time
        position = np.searchsorted(key, label + (fractions + step - ROUNDING_SHARE) / 2)
        counterpart = order[np.minimum(position, len(order) - 1)]
        exists = (label[counterpart] == label) & (np.abs(fractions[counterpart] - fractions - step) < ROUNDING_SHARE)
        indices.append(np.where(exists, counterpart, np.arange(len(label))))
    return indices[0], indices[1]


def _trajectory(name: str, value: Any, size: int, horizon: float, times: Any) -> Trajectory:
    """Convert a guess (a function of time, a table of samples, or a value) to a function of the horizon fraction."""
    if isinstance(value, Samples) and value.values.shape[1] == size:
        return lambda at: value.over(at * horizon)
    if callable(value):
        return lambda at: np.array([evaluate_guess(name, value, float(s) * horizon, size) for s in at])
    array = table(f"guess of {name!r}", value)
    if array.ndim == 2 and array.shape[0] > 1 and array.shape != (size, 1):
        rows = len(array)
        at = np.linspace(0.0, horizon, rows) if times is None else numeric("guess: its times 't'", times)
        if len(at) != rows or array.shape[1] != size:
            words = f"guess of {name!r} has shape {array.shape}, ({len(at)}, {size}) expected"
            raise ProblemError(words, name=name, value=array.shape, limit=(len(at), size))
        if not (np.all(np.isfinite(at)) and np.all(np.diff(at) > 0)):
            raise ProblemError(f"guess of {name!r}: its times 't' must be finite and increase", name=name)
        sampled = Samples(at, array)
        return lambda s: sampled.over(s * horizon)
    constant = broadcast_guess(name, value, size)
    return lambda s: np.tile(constant, (len(s), 1))


def evaluate_guess(name: str, function: Callable[[float], Any], time: float, size: int) -> np.ndarray:
    """Evaluate a user's guess function of ``size`` entries at a time, s; raise ProblemError if the function fails."""
    try:
        value = function(time)
    except Exception as error:  # any error of the user's function
        words = f"guess of {name!r}: the function fails at {time:g} s: {error!r}"
        raise ProblemError(words, name=name, value=function, time=time) from error
    return broadcast_guess(name, value, size)


@dataclass(frozen=True)
class Samples:
    """A guess given by samples over time, which can be evaluated at one time or at many times.

    Attributes:
        t: Times, s, increasing. Shape (M,).
        values: Shape (M, n).
    """

    t: np.ndarray
    values: np.ndarray

    def over(self, times: np.ndarray) -> np.ndarray:
        """Return the guess at K times by linear interpolation, constant outside of the samples. Shape (K, n)."""
        return np.column_stack([np.interp(times, self.t, column) for column in self.values.T])

    def __call__(self, time: float) -> np.ndarray:
        """Return the guess at one time, s, interpolated between the samples. Shape (n,)."""
        return np.asarray(self.over(np.array([time]))[0])


def from_solution(form: Formulation, guess: Solution) -> dict[str, Trajectory]:
    """Return, by name, the trajectories of the states and controls that an earlier solution shares with a problem.

    At a node, a control has the left limit: a control variable there belongs to the interval that ends there.
    """
    shared: dict[str, Trajectory] = {}
    for name, entries in {**form.states, **form.controls}.items():
        values = guess.states if name in guess.states else guess.controls
        if name not in values:
            continue
        actual, size = values[name].shape[1], entries.stop - entries.start
        if actual != size:
            words = f"guess of {name!r} has {actual} entries, {size} expected"
            raise ProblemError(words, name=name, value=actual, limit=size)
        shift = NODE_TOLERANCE if name in guess.controls else 0.0
        shared[name] = lambda s, name=name, shift=shift: guess.at_fraction(np.maximum(s - shift, 0.0))[name]  # type: ignore[misc]
    if not shared:
        words = f"the guess, plan {guess.name!r}, shares no state or control with problem {form.name!r}"
        raise ProblemError(words, name="guess", value=guess.name, limit=(*form.states, *form.controls))
    return shared


def broadcast_guess(name: str, value: Any, size: int) -> np.ndarray:
    """Return a guess as an array of ``size`` entries; a single number is repeated."""
    array = numeric(f"guess of {name!r}", value)
    if array.size not in (1, size):
        words = f"guess of {name!r} has {array.size} entries, {size} expected"
        raise ProblemError(words, name=name, value=array.size, limit=size)
    return np.broadcast_to(array, size)


def default(form: Formulation, role: str, place: slice, bounds: Bounds) -> Trajectory:
    """Return a default guess: a line between fixed ends, else the middle of the bounds or the value nearest to zero."""

    def middle(kind: str) -> tuple[np.ndarray, np.ndarray]:
        index = form.bounds.places[kind][place]
        low, high = bounds[0][index], bounds[1][index]
        finite = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            value = np.where(finite, 0.5 * (low + high), np.clip(0.0, low, high))
        return value, low == high

    centre, _ = middle(role)
    if role == "control":
        return lambda s: np.tile(centre, (len(s), 1))
    first, first_fixed = middle("initial")
    last, last_fixed = middle("terminal")
    start = np.where(first_fixed, first, np.where(last_fixed, last, centre))
    end = np.where(last_fixed, last, start)
    return lambda s: np.outer(1.0 - s, start) + np.outer(s, end)


@dataclass(frozen=True)
class StartSettings:
    """Settings of the alternative initial points of a solver.

    Attributes:
        horizon: Factor on the guess of a free horizon when starting from zeros: a long horizon contains a feasible
            plan, one that is too short does not.
        displacement: Displacement of the guess from itself, relative to the size of each state and control: enough to
            leave a symmetry of the problem, or a point at which a derivative does not exist.
        iterations: Largest number of iterations from each start.
    """

    horizon: float = 4.0
    displacement: float = 0.1
    iterations: int = 200


STARTS = StartSettings()


def alternative_starts(
    form: Formulation,
    transcription: Transcription,
    point: np.ndarray,
    p: np.ndarray,
    *,
    bounds: tuple[np.ndarray, np.ndarray],
    sizes: np.ndarray,
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the variables of each alternative initial point of the solver, computed on demand.

    Args:
        point: Values of the variables at the guess.
        bounds: Bounds of the variables, to which the starts are clipped.
        sizes: Typical sizes of the variables.
    """
    yield "displaced guess", np.clip(displace(transcription, point, sizes), *bounds)
    zeros = np.where(transcription.variable_role == "horizon", STARTS.horizon * point, 0.0)
    yield "zeros", np.clip(zeros, *bounds)
    yield "roll-out", np.clip(roll_out(form, transcription, point, p), *bounds)


def displace(transcription: Transcription, point: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return a guess with each state and control displaced by a constant share of its magnitude, with random sign."""
    result, random = point.copy(), np.random.default_rng(0)
    for role in ("state", "control"):
        chosen = np.flatnonzero(transcription.variable_role == role)
        entries = transcription.variable_entry[chosen]
        direction = random.choice([-1.0, 1.0], entries.max(initial=-1) + 1)
        result[chosen] += STARTS.displacement * direction[entries] * sizes[chosen]
    return result


def roll_out(form: Formulation, transcription: Transcription, point: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return a guess whose states are replaced by a simulation of the dynamics under its controls. Shape (size,).

    Classical Runge-Kutta steps between the fractions of the states. From the first state that is not finite on, the
    states are constant.
    """
    state, control = (transcription.variable_role == role for role in ("state", "control"))
    fractions, slot = np.unique(transcription.variable_fraction[state], return_inverse=True)
    horizon = transcription.duration(form, point, p)
    # controls at the beginning, middle and end of every step
    places = np.concatenate([fractions[:-1], (fractions[:-1] + fractions[1:]) / 2, fractions[1:]])
    values = np.zeros((form.nu, len(places)))
    for i in range(form.nu):
        entries = np.flatnonzero(control & (transcription.variable_entry == i))
        times, first = np.unique(transcription.variable_fraction[entries], return_index=True)
        values[i] = np.interp(places, times, point[entries][first])
    steps = len(fractions) - 1
    inputs = np.vstack([*np.split(values, 3, axis=1), fractions[:-1] * horizon, np.diff(fractions) * horizon])

    rate = form.function("rate", [form.f], ["f"])
    x, d = ca.MX.sym("x", form.nx), ca.MX.sym("d", 3 * form.nu + 2)

    def slope(place: float, state_at: ca.MX) -> ca.MX:
        offset = round(2 * place) * form.nu
        return rate(state_at, d[offset : offset + form.nu], d[-2] + place * d[-1], horizon, p)

    step = ca.Function("step", [x, d], [rk4_step(slope, x, d[-1])])
    start = point[transcription.start]
    trajectory = np.asarray(step.mapaccum("roll_out", steps)(start, inputs).full()) if steps else np.zeros((form.nx, 0))
    states = np.column_stack([start, trajectory])
    invalid = ~np.isfinite(states).all(axis=0)
    if invalid.any():
        states[:, np.argmax(invalid) :] = states[:, [np.argmax(invalid) - 1]]
    result = point.copy()
    result[state] = states[transcription.variable_entry[state], slot]
    return result
