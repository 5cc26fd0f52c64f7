"""Integration of the known optima that have no closed form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from .case import Array

Flow: TypeAlias = Callable[[Array], Array]


def flow(
    rates: Callable[[float, Array], Sequence[float] | Array],
    start: Sequence[float] | Array,
    span: tuple[float, float],
) -> Flow:
    """Solution of y' = rates(t, y), y(span[0]) = start, as a function of times (M,) that returns (n, M).

    `span` may run backwards. Eighth order, relative tolerance 1e-13; between its steps good to about 1e-10.
    """
    result = solve_ivp(rates, span, start, method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True)
    assert result.success, result.message

    def at(t: npt.ArrayLike) -> Array:
        return np.asarray(result.sol(np.asarray(t)), dtype=np.float64)

    return at
