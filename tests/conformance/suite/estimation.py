"""Estimation of parameters from data at given times: one phase between two times, with the parameters in common.

The names of the parameters are those of free parameters of every phase; `Phases.join` makes them continuous. Each phase
charges the squared residual at its end, the first one also that at its start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ocp import Phases, Problem

from .entry import line

Array = npt.NDArray[np.float64]
Declare = Callable[[Problem, Any], Any]
"""Of a phase and its states: declares parameters, controls and limits, and returns the rates of the states."""


def estimation(
    name: str,
    times: Sequence[float],
    data: Array,
    declare: Declare,
    *,
    states: int,
    initial: Any = None,
    lower: float | None = None,
    guess: Array | None = None,
) -> Phases:
    """Least squares of the first states against ``data`` (M, k) at ``times`` (M,), s.

    Args:
        states: Number of states; those beyond the k measured ones are not.
        initial: Known states at the first time; None where they are sought and measured.
        lower: Bound of all states.
        guess: States at the times, (M, states); by default the data.
    """
    measured = data.shape[1]
    at = data if guess is None else guess
    legs = {}
    for k, (begin, end) in enumerate(pairwise(times)):
        leg = legs[f"p{k}"] = Problem(f"p{k}")
        here = initial if k == 0 else None
        y = leg.state("y", states, initial=here, lower=lower, guess=line(at[k], at[k + 1], end - begin))
        leg.horizon(end - begin)
        leg.dynamics(y, declare(leg, y))
        cost = ca.sumsqr(y[:measured] - data[k + 1])
        if k == 0 and initial is None:
            cost += ca.sumsqr(leg.at_start(y)[:measured] - data[0])
        leg.minimize(terminal=cost)
    phases = Phases(name, legs)
    for before, after in pairwise(legs):
        phases.join(before, after)
    return phases
