"""Integration of the known optima that have no closed form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from scipy.integrate import solve_ivp

from .case import Array

Flow: TypeAlias = Callable[[Array], Array]


def flow(rates: Callable[[float, Array], Sequence[float] | Array], start: Any, span: tuple[float, float]) -> Flow:
    """Solution of y' = rates(t, y), y(span[0]) = start, as a function of times (M,) that returns (n, M).

    `start` is an array, or a function that returns one. Integrated when first asked; `span` may run backwards. Eighth
    order, relative tolerance 1e-13; between its steps good to about 1e-10.
    """

    @cache
    def solution() -> Any:
        first = start() if callable(start) else start
        result = solve_ivp(rates, span, first, method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True)
        assert result.success, result.message
        return result.sol

    return lambda t: np.asarray(solution()(np.asarray(t)), dtype=np.float64)
