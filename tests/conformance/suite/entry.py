"""What a problem of a public suite is: its statement, the published cost, and the methods that confirm it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ocp import Collocation, Indirect, MultipleShooting, Problem

Method = Collocation | MultipleShooting | Indirect
FIRST, SECOND = Collocation(30, 4), Collocation(43, 3, "legendre")
PSOPT, COPS, TOOLBOX = "PSOPT", "COPS", "OptimalControlProblems.jl"
"""The suites: github.com/PSOPT/psopt, COPS 3 (github.com/MadNLP/COPSBenchmark.jl), and
github.com/control-toolbox/OptimalControlProblems.jl."""


@dataclass(frozen=True)
class Entry:
    """A problem of one or several suites.

    Attributes:
        name: As in the suite.
        suites: The suites that contain it.
        build: The statement, with the guess that its source gives.
        published: Cost that the source of each name publishes, as text where it is printed in few digits or with
            zeros at the end; the first is the one compared.
        exact: Optimal cost in closed form, or None.
        method: Mesh of the first solve, which is refined afterwards, and on which other tools are compared.
        second: An independent method: another scheme on another mesh, shooting, or the minimum principle.
        note: What a reader has to know to compare the costs.
    """

    name: str
    suites: tuple[str, ...]
    build: Callable[[], Problem]
    published: Mapping[str, float | str] = field(default_factory=dict)
    exact: float | None = None
    method: Collocation | MultipleShooting = FIRST
    second: Method = SECOND
    note: str = ""


def line(start: Any, end: Any, duration: float = 1.0) -> Callable[[float], npt.NDArray[np.float64]]:
    """Guess that runs straight from one value to another over a duration, s."""
    first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    return lambda t: first + (last - first) * t / duration


def samples(times: Sequence[float], values: Sequence[Any]) -> Callable[[float], npt.NDArray[np.float64]]:
    """Guess that runs straight between values (M,) or (M, n) at times (M,), s."""
    table = np.asarray(values, dtype=float).reshape(len(times), -1)
    return lambda t: np.array([np.interp(t, times, column) for column in table.T])
