"""Where the zero moment point of a standing machine may be: rules, and the constraints they come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.standing import Standing
from models.spatial import expression
from ocp.errors import NOT_NUMBERS, ProblemError, real

__all__ = [
    "Anywhere",
    "Following",
    "InFoot",
    "IndexAtLeast",
    "Pinned",
    "ZmpRule",
    "check_rule",
    "checked_point",
    "foot_edges",
    "foot_rows",
    "index_rows",
    "is_finite",
]

PARALLEL = 1e-12
"""Cosine below which an edge of the support is parallel to a direction."""

ROUNDING = 1e-9  # m
REFERENCE_SAMPLES = 201  # times at which a reference is looked at


def is_finite(value: Any) -> bool:
    """Whether it is a single finite number."""
    return bool(np.isfinite(real(value)))


@dataclass(frozen=True)
class InFoot:
    """The zero moment point stays inside the support by a margin, m, zero or positive."""

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not (is_finite(self.margin) and self.margin >= 0):  # beyond the foot it would tip over
            words = f"InFoot: margin must be a finite number of m, not negative, not {self.margin!r}"
            raise ProblemError(words, name="margin", value=self.margin, limit=0.0)

    def check(self, machine: Standing) -> None:
        """Raise ProblemError where the margin leaves no room in the support."""
        directions, support = machine.moving_directions, machine.support
        along = np.ptp(support.vertices @ directions.T, axis=0) / 2
        room = support.inner_radius if len(directions) == 2 else float(along.min(initial=np.inf))
        if self.margin >= room * (1 - 1e-9):
            words = f"InFoot: margin {self.margin!r} m leaves no room in a support that holds no more than {room:g} m"
            raise ProblemError(words, name="margin", value=self.margin, limit=room)


@dataclass(frozen=True)
class IndexAtLeast:
    """The stability index, (5)-(6), stays at or above a value below 1 in x and y, and the point inside the support."""

    value: float

    def __post_init__(self) -> None:
        if not (is_finite(self.value) and self.value < 1):
            words = f"IndexAtLeast: value must be below 1, not {self.value!r}; for 1 use Pinned()"
            raise ProblemError(words, name="value", value=self.value, limit=1.0)

    def region(self, machine: Standing) -> tuple[Array, Array]:
        """Least and greatest (x, y) where the index is as asked. Shape (2,) each, m."""
        radius = machine.half_widths * np.sqrt(1 - self.value)
        return machine.most_stable_point - radius, machine.most_stable_point + radius


@dataclass(frozen=True)
class Pinned:
    """The zero moment point stays at (x, y), m; at the machine's most stable point if None.

    In the directions in which motion moves it, see Standing.moving_directions; inside the support in the others.
    """

    point: Any = None

    def place(self, machine: Standing, time: Any) -> Any:
        """Shape (2, 1), m."""
        given = machine.most_stable_point if self.point is None else self.point
        return checked_point(given, "Pinned: point")


@dataclass(frozen=True)
class Following:
    """The zero moment point follows a reference: a function of a casadi time (s) that returns (x, y), m.

    In the directions in which motion moves it, as Pinned.
    """

    reference: Callable[[Any], Any]

    def place(self, machine: Standing, time: Any) -> Any:
        """Shape (2, 1), m."""
        if not callable(self.reference):
            words = f"Following: a function of time is expected, not {self.reference!r}"
            raise ProblemError(words, name="Following", value=self.reference)
        return checked_point(self.reference(time), "Following: the reference")


def checked_point(given: Any, what: str) -> Any:
    """(x, y) as a casadi column, m; ProblemError unless it is two numbers or expressions."""
    try:
        point = expression(given)
    except NOT_NUMBERS:
        point = ca.DM()
    numeric = isinstance(point, ca.DM)
    if point.numel() != 2 or 1 not in point.shape or (numeric and not np.isfinite(np.array(point)).all()):
        shown = given if numeric else str(given)  # expressions cannot be pickled
        words = f"{what} must be two numbers (x, y), not {given!r}"
        raise ProblemError(words, name=what.rpartition(" ")[2], value=shown)
    return ca.vec(point)


@dataclass(frozen=True)
class Anywhere:
    """The zero moment point is not looked at: the machine may tip over."""


ZmpRule: TypeAlias = InFoot | IndexAtLeast | Pinned | Following | Anywhere


def foot_edges(machine: Standing, zmp: ZmpRule) -> tuple[Array, Array]:
    """Edges of the support, drawn in by a margin, that a rule does not keep the zero moment point from by itself.

    Returns:
        Inward normals n and offsets o: n . point >= o. Shapes (k, 2) and (k,).
    """
    normals = machine.support.normals
    offsets = (normals * machine.support.vertices).sum(axis=1)
    if isinstance(zmp, InFoot):
        return normals, offsets + zmp.margin
    open_edges = np.zeros(len(offsets), dtype=bool)
    if isinstance(zmp, IndexAtLeast):
        corners = np.array(np.meshgrid(*np.transpose(zmp.region(machine)))).reshape(2, 4)
        open_edges = (normals @ corners).min(axis=1) < offsets
    elif isinstance(zmp, Pinned | Following):
        directions = machine.moving_directions
        open_edges = np.abs(normals - normals @ directions.T @ directions).max(axis=1) > PARALLEL
    return normals[open_edges], offsets[open_edges]


def foot_rows(machine: Standing, zmp: ZmpRule, point: Any, pushed: bool) -> Any:
    """How far the zero moment point is inside the foot_edges that a motion can bring it to. Shape (k, 1), m.

    Args:
        point: The zero moment point of the motion. Shape (2, 1).
        pushed: Whether there are wrenches, which may move it in any direction.

    Raises:
        ProblemError: It is always beyond an edge.
    """
    normals, offsets = foot_edges(machine, zmp)
    moved = np.abs(normals @ machine.moving_directions.T).max(axis=1, initial=0.0) > PARALLEL
    rows = ca.mtimes(ca.sparsify(ca.DM(normals)), point) - ca.DM(offsets)
    free = [i for i in range(len(offsets)) if (pushed or moved[i]) and ca.symvar(rows[i])]
    here = machine.nearest_reachable(machine.most_stable_point)
    for i in set(range(len(offsets))) - set(free):
        inside = float(ca.evalf(rows[i])) if pushed else float(normals[i] @ here - offsets[i])
        if inside < -ROUNDING:
            words = (
                f"the zero moment point is {-inside:.4g} m beyond an edge of the support, less its margin, whatever "
                "the joints do: put the foot below the machine"
            )
            raise ProblemError(words, name="zero moment point", value=-inside, limit=0.0)
    return rows[free]


def index_rows(machine: Standing, zmp: IndexAtLeast, point: Any, pushed: bool) -> list[int]:
    """Coordinates of the zero moment point that a motion can bring out of the region of the index.

    Args:
        point, pushed: As foot_rows.

    Raises:
        ProblemError: The other coordinate is out of the region.
    """
    rows = [i for i in (0, 1) if (pushed or i in machine.moving_axes) and ca.symvar(point[i])]
    low, high = zmp.region(machine)
    here = machine.nearest_reachable(machine.most_stable_point)
    for i in {0, 1} - set(rows):
        if not low[i] - ROUNDING <= here[i] <= high[i] + ROUNDING:
            words = (
                f"IndexAtLeast({zmp.value:g}): the zero moment point is at {'xy'[i]} = {here[i]:.4g} m whatever the "
                f"joints do, outside {low[i]:.4g} .. {high[i]:.4g} m: put the foot below the machine"
            )
            raise ProblemError(words, name="zero moment point", value=here[i], limit=(low[i], high[i]))
    return rows


def check_rule(machine: Standing, zmp: ZmpRule, horizon: float) -> None:
    """Raise ProblemError for what is no rule, leaves no room in the support, or asks the machine to tip over."""
    if not isinstance(zmp, ZmpRule):
        words = f"zmp must be InFoot, IndexAtLeast, Pinned, Following or Anywhere, not {zmp!r}"
        raise ProblemError(words, name="zmp", value=zmp, limit=get_args(ZmpRule))
    if isinstance(zmp, InFoot):
        zmp.check(machine)
    if not isinstance(zmp, Pinned | Following):
        return
    name = type(zmp).__name__
    for time in np.linspace(0.0, horizon, REFERENCE_SAMPLES if isinstance(zmp, Following) else 1):
        place = np.array(ca.DM(zmp.place(machine, ca.DM(time)))).ravel()
        if not np.isfinite(place).all():
            words = f"{name}: the zero moment point is to be at {place.tolist()} at {time:.4g} s"
            raise ProblemError(words, name=name, value=place, time=float(time))
        inside = float(machine.support.margin(machine.nearest_reachable(place)))
        if inside < -ROUNDING:
            words = (
                f"{name}: {place.tolist()} m at {time:.4g} s is {-inside:.4g} m outside the support, where the machine "
                "tips over; stay inside, or give another support"
            )
            raise ProblemError(words, name=name, value=place, limit=machine.support.vertices, time=float(time))
