"""Where else a solver may start when it fails from the guess: zeros, and a roll-out of the dynamics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ocp.curves import rk4_step
from ocp.direct.fragment import Fragment
from ocp.problem.formulation import Formulation

__all__ = ["ELASTIC", "GUESS", "STARTS", "other_starts"]

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
