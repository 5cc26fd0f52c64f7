"""Where the solver starts: guesses of every kind, evaluated at the variables of a transcription.

Where else a solver may start when it fails from the guess: zeros, and a roll-out of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import rk4_step
from ocp.direct.assembly import Fragment
from ocp.errors import ProblemError, error_names, unknown_name
from ocp.problem.formulation import Bounds, Formulation
from ocp.problem.values import numeric, table
from ocp.solution import Guess, Solution
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["ELASTIC", "GUESS", "STARTS", "Samples", "initial_point", "later", "names_told", "other_starts"]

Trajectory = Callable[[np.ndarray], np.ndarray]  # fractions of the horizon (M,) -> values (M, n)


def initial_point(form: Formulation, fragment: Fragment, guess: Guess, bounds: Bounds) -> np.ndarray:
    """Values of all variables to start from. Shape (size,).

    What ``guess`` says comes first, then the guess declared with the variable, then a straight line between the given
    ends or the middle of the bounds. A solution of another grid or method is read over fractions of its horizon.

    Raises:
        ProblemError: An unknown name, a wrong size, a number that is not finite.
    """
    entries = dict(form.guesses)
    horizon = default_horizon(form, bounds)
    given: dict[str, Any] = {}
    curves: dict[str, Trajectory] = {}
    if isinstance(guess, Solution):
        curves, horizon = from_solution(form, guess), guess.horizon
    elif isinstance(guess, Mapping):
        given = {name: value for name, value in guess.items() if name != "t"}
        known = [*form.states, *form.controls, "horizon", "t"]
        for name in given:
            if name not in known:
                raise unknown_name("variable in guess", name, known)
    elif guess is not None:
        words = f"guess must be a Solution, a dictionary or None, not {type(guess).__name__}"
        raise ProblemError(words, name="guess", value=guess)
    if "horizon" in given:
        with error_names("horizon"):
            number = numeric("guess of the horizon", given.pop("horizon"))
        if not (number.size == 1 and np.isfinite(number[0]) and number[0] > 0):
            words = f"guess of the horizon must be one positive finite number, not {number.tolist()} s"
            raise ProblemError(words, name="horizon", value=number.tolist())
        horizon = float(number[0])
    entries.update(given)
    times = None if guess is None or isinstance(guess, Solution) else guess.get("t")

    point = np.zeros(fragment.size)
    point[fragment.variable_role == "horizon"] = horizon
    for role, pool in (("state", form.states), ("control", form.controls)):
        mine = fragment.variable_role == role
        where, slot = np.unique(fragment.variable_fraction[mine], return_inverse=True)
        size = max((place.stop for place in pool.values()), default=0)
        table = np.zeros((len(where), size))
        for name, place in pool.items():
            value = entries.get(name)
            if name in curves:
                curve = curves[name]
            elif value is None:
                curve = default(form, role, place, bounds)
            else:
                with error_names(name):
                    curve = trajectory(name, value, place.stop - place.start, horizon, times)
            with error_names(name):
                table[:, place] = curve(where)
            for i in np.flatnonzero(~np.isfinite(table[:, place]).all(axis=1)):
                words = f"guess of {name!r} is not finite at {where[i] * horizon:g} s: {table[i, place]}"
                raise ProblemError(words, name=name, value=table[i, place], time=float(where[i] * horizon))
        point[mine] = table[slot, fragment.variable_entry[mine]]
    return point


def names_told(form: Formulation, guess: Guess) -> set[str]:
    """Names of states, controls and ``horizon`` of which a guess, or the problem's own, says something."""
    told = {name for name, value in form.guesses.items() if value is not None}
    if form.horizon_guess is not None:
        told.add("horizon")
    if isinstance(guess, Solution):
        return told | {*guess.states, *guess.controls, "horizon"}
    return told | {*(guess or {})}


def later(fragment: Fragment, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """For each variable and each row of a program, the one of the same meaning so many equal intervals later.

    Itself where the horizon ends before.
    """
    step = intervals / (len(fragment.mesh) - 1)
    meanings = [f"{role} {entry}" for role, entry in zip(fragment.variable_role, fragment.variable_entry, strict=True)]
    found = []
    for words, fractions in ((meanings, fragment.variable_fraction), (fragment.row_labels, fragment.row_fractions)):
        _, label = np.unique(words, return_inverse=True)
        order = np.lexsort((fractions, label))
        at = label[order] + fractions[order] / 2  # one meaning after the other, in time
        there = np.searchsorted(at, label + (fractions + step - ROUNDING_SHARE) / 2)
        other = order[np.minimum(there, len(order) - 1)]
        fits = (label[other] == label) & (np.abs(fractions[other] - fractions - step) < ROUNDING_SHARE)
        found.append(np.where(fits, other, np.arange(len(label))))
    return found[0], found[1]


def trajectory(name: str, value: Any, size: int, horizon: float, times: Any) -> Trajectory:
    """A guess as a function of the fraction: from a function of time, samples (M, n) over ``times``, or a value."""
    if isinstance(value, Samples) and value.values.shape[1] == size:
        return lambda at: value.over(at * horizon)
    if callable(value):
        return lambda at: np.array([fitted(name, asked(name, value, float(s) * horizon), size) for s in at])
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
    constant = fitted(name, value, size)
    return lambda s: np.tile(constant, (len(s), 1))


def asked(name: str, function: Callable[[float], Any], time: float) -> Any:
    """What a guess that is a function says at a time, s; ProblemError where it fails."""
    try:
        return function(time)
    except Exception as error:  # of the function's own
        words = f"guess of {name!r}: the function fails at {time:g} s: {error!r}"
        raise ProblemError(words, name=name, value=function, time=time) from error


@dataclass(frozen=True)
class Samples:
    """A guess sampled over time: a function of time that can be asked for many times at once.

    Attributes:
        t: Times, s, increasing. Shape (M,).
        values: Shape (M, n).
    """

    t: np.ndarray
    values: np.ndarray

    def over(self, times: np.ndarray) -> np.ndarray:
        """Values at ``times`` (K,), linear between samples, constant beyond them. Shape (K, n)."""
        return np.column_stack([np.interp(times, self.t, column) for column in self.values.T])

    def __call__(self, time: float) -> np.ndarray:
        """Value at one time. Shape (n,)."""
        return np.asarray(self.over(np.array([time]))[0])


def from_solution(form: Formulation, guess: Solution) -> dict[str, Trajectory]:
    """Curves of an earlier solution, for every state and control that it shares with the problem."""
    shared: dict[str, Trajectory] = {}
    for name, place in {**form.states, **form.controls}.items():
        pool = guess.states if name in guess.states else guess.controls
        if name not in pool:
            continue
        have, size = pool[name].shape[1], place.stop - place.start
        if have != size:
            raise ProblemError(
                f"guess of {name!r} has {have} entries, {size} expected", name=name, value=have, limit=size
            )
        shared[name] = lambda s, name=name: guess.at_fraction(s)[name]  # type: ignore[misc]
    if not shared:
        words = f"the guess, plan {guess.name!r}, shares no state or control with problem {form.name!r}"
        raise ProblemError(words, name="guess", value=guess.name, limit=(*form.states, *form.controls))
    return shared


def fitted(name: str, value: Any, size: int) -> np.ndarray:
    array = numeric(f"guess of {name!r}", value)
    if array.size not in (1, size):
        words = f"guess of {name!r} has {array.size} entries, {size} expected"
        raise ProblemError(words, name=name, value=array.size, limit=size)
    return np.broadcast_to(array, size)


def default_horizon(form: Formulation, bounds: Bounds) -> float:
    """The declared guess, or a value inside the bounds."""
    place = form.bounds.places["horizon"][0]
    low, high = bounds[0][place], bounds[1][place]
    if form.horizon_guess is not None:
        return float(np.clip(form.horizon_guess, low, high))
    return float(np.clip(1.0, low, high) if np.isinf(high) else 0.5 * (low + high))


def default(form: Formulation, role: str, place: slice, bounds: Bounds) -> Trajectory:
    """A straight line between given ends, else the nearest point of the bounds to zero or their middle."""

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


GUESS, ELASTIC = "guess", "elastic plan"


@dataclass(frozen=True)
class StartSettings:
    """Where and for how long a solver starts anew.

    Attributes:
        horizon: Zeros begin with a free horizon so many times the guessed one: a long horizon has a plan in it, too
            short a one none.
        iterations: The most from each start: the solver failed already from another one.
    """

    horizon: float = 4.0
    iterations: int = 200


STARTS = StartSettings()


def other_starts(
    form: Formulation, fragment: Fragment, point: np.ndarray, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]
) -> Iterator[tuple[str, np.ndarray]]:
    """Name and values of all variables of each start after the guess ``point``, made when it is asked for.

    Args:
        bounds: Of the variables, which the starts are moved into.
    """
    zeros = np.where(fragment.variable_role == "horizon", STARTS.horizon * point, 0.0)
    yield "zeros", np.clip(zeros, *bounds)
    yield "roll-out", np.clip(roll_out(form, fragment, point, p), *bounds)


def roll_out(form: Formulation, fragment: Fragment, point: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The controls of a start with the states that they lead to from its initial state. Shape (size,).

    Classical Runge-Kutta from each fraction at which a state stands to the next; from where the states are no longer
    finite they stand still.
    """
    state, control = (fragment.variable_role == role for role in ("state", "control"))
    where, slot = np.unique(fragment.variable_fraction[state], return_inverse=True)
    horizon = float(form.horizon_at(p) if fragment.horizon is None else point[fragment.horizon])
    # controls at the beginning, middle and end of every step
    places = np.concatenate([where[:-1], (where[:-1] + where[1:]) / 2, where[1:]])
    values = np.zeros((form.nu, len(places)))
    for i in range(form.nu):
        mine = np.flatnonzero(control & (fragment.variable_entry == i))
        at, first = np.unique(fragment.variable_fraction[mine], return_index=True)
        values[i] = np.interp(places, at, point[mine][first])
    steps = len(where) - 1
    inputs = np.vstack([*np.split(values, 3, axis=1), where[:-1] * horizon, np.diff(where) * horizon])

    rate = form.function("rate", [form.f], ["f"])
    x, d = ca.MX.sym("x", form.nx), ca.MX.sym("d", 3 * form.nu + 2)

    def slope(place: float, here: ca.MX) -> ca.MX:
        third = round(2 * place) * form.nu
        return rate(here, d[third : third + form.nu], d[-2] + place * d[-1], horizon, p)

    step = ca.Function("step", [x, d], [rk4_step(slope, x, d[-1])])
    start = point[fragment.start]
    found = np.asarray(step.mapaccum("roll_out", steps)(start, inputs).full()) if steps else np.zeros((form.nx, 0))
    states = np.column_stack([start, found])
    broken = ~np.isfinite(states).all(axis=0)
    if broken.any():
        states[:, np.argmax(broken) :] = states[:, [np.argmax(broken) - 1]]
    rolled = point.copy()
    rolled[state] = states[fragment.variable_entry[state], slot]
    return rolled
