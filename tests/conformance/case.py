"""What a reference problem is: its statement, its known optimum, and the error each method may make."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ocp import Collocation, MultipleShooting, Problem

Array: TypeAlias = npt.NDArray[np.float64]
Grid: TypeAlias = int | tuple[float, ...]  # equal intervals, or a mesh


@dataclass(frozen=True)
class Extremal:
    """A trajectory that satisfies the minimum principle, sampled: arrays by name, each (M,) or (M, n).

    Attributes:
        state: States.
        control: Controls; at a switch either of the two values.
        costate: d(optimal cost)/d(state), so that H = L + costate . f is least over the controls.
    """

    state: Mapping[str, Array]
    control: Mapping[str, Array]
    costate: Mapping[str, Array]


@dataclass(frozen=True)
class Switch:
    """A corner of the optimal control.

    Attributes:
        time: When it happens, s.
        function: Of states and costates by name, (M, n) each; its only simple zero near `time` is the switch. None
            where the switching function is identically zero on one side (a singular arc).
    """

    time: float
    function: Callable[[Mapping[str, Array], Mapping[str, Array]], Array] | None = None


@dataclass(frozen=True)
class Run:
    """One discretisation of a problem, and the error it is entitled to.

    Attributes:
        method: The transcription.
        cost: How far under and how far over the optimum the cost may come. Under it by the solver's tolerance where
            every plan of the discretised problem is admissible in the original one; elsewhere by what the quadrature
            and the polynomials between the points can cheat. Over it by the discretisation error.
        state, control, costate: Largest allowed error at the reported times; None where controls are not compared, for
            a reason that stands beside the run.
        time: Largest allowed error of the horizon and of the switching times, s.
    """

    method: Collocation | MultipleShooting
    cost: tuple[float, float]
    state: float
    control: float | None
    costate: float
    time: float | None = None

    def __str__(self) -> str:
        m = self.method
        scheme = f"{m.scheme}{m.degree}" if isinstance(m, Collocation) else m.integrator
        return f"{scheme}-{m.control}-{m.intervals}{'' if m.mesh is None else '-fitted'}"


@dataclass(frozen=True)
class Case:
    """A reference problem with its known optimum.

    Attributes:
        name: As in the table of reference problems.
        build: The statement.
        cost: The optimal cost.
        runs: The methods that suit the problem.
        horizon: The optimal final time, s.
        optimum: The optimal trajectory at times (M,) in [0, horizon], in closed form or from the minimum principle.
        switches: Corners of the optimal control, in order.
        jumps: Times at which a costate jumps (entry and exit of a constrained arc), s.
    """

    name: str
    build: Callable[[], Problem]
    cost: float
    runs: tuple[Run, ...]
    horizon: float
    optimum: Callable[[Array], Extremal]
    switches: tuple[Switch, ...] = ()
    jumps: tuple[float, ...] = ()


def fitted(corners: Sequence[float], per_arc: int) -> tuple[float, ...]:
    """Mesh with a node on every corner (fractions 0..1 of the horizon) and `per_arc` intervals between them."""
    ends = (0.0, *corners, 1.0)
    arcs = [np.linspace(a, b, per_arc, endpoint=False) for a, b in pairwise(ends)]
    return (*(float(node) for arc in arcs for node in arc), 1.0)


def radau(intervals: Grid, degree: int = 3, control: str = "points", scheme: str = "radau") -> Collocation:
    """Radau collocation on equal intervals or a mesh."""
    number, mesh = (intervals, None) if isinstance(intervals, int) else (len(intervals) - 1, intervals)
    return Collocation(number, degree, scheme, control, mesh)


def legendre(intervals: Grid, degree: int = 3, control: str = "points") -> Collocation:
    """Legendre collocation on equal intervals or a mesh."""
    return radau(intervals, degree, control, "legendre")


def shooting(intervals: Grid, control: str, steps: int = 1, integrator: str = "rk4") -> MultipleShooting:
    """Multiple shooting on equal intervals or a mesh."""
    like = radau(intervals)
    return MultipleShooting(like.intervals, integrator, steps, control, like.mesh)


def held(intervals: Grid) -> tuple[Collocation, Collocation, MultipleShooting]:
    """Radau, Legendre and shooting with one control an interval."""
    collocations = radau(intervals, control="held"), legendre(intervals, control="held")
    return *collocations, shooting(intervals, "held")


def within(
    *methods: Collocation | MultipleShooting,
    cost: tuple[float, float],
    state: float,
    control: float | None,
    costate: float,
    time: float | None = None,
) -> tuple[Run, ...]:
    """Runs of several methods that are entitled to the same errors, as in :class:`Run`."""
    return tuple(Run(method, cost, state, control, costate, time) for method in methods)
