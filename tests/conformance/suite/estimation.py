"""Estimation of parameters from data at given times: least squares of the residuals at these times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ocp import Phases, Problem

from .entry import samples

Array = npt.NDArray[np.float64]
Declare = Callable[[Problem, Any], Any]
"""Of a problem and its states: declares parameters, controls and limits, and returns the rates of the states."""


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
    measured, at, start = data.shape[1], data if guess is None else guess, times[0]
    problem = Problem(name)
    y = problem.state("y", states, initial=initial, lower=lower, guess=samples([t - start for t in times], at.tolist()))
    problem.horizon(times[-1] - start)
    problem.dynamics(y, declare(problem, y))
    known = 0 if initial is None else 1
    residuals = zip(times[known:], data[known:], strict=True)
    return Phases.with_costs_at(problem, {t - start: ca.sumsqr(y[:measured] - row) for t, row in residuals})
