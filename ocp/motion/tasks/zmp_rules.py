"""Rules for the position of the zero moment point of a standing machine, and the constraints that follow from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.checks import NOT_NUMBERS, Array, real
from models.machines.standing import Standing
from models.spatial import expression
from ocp.errors import ProblemError

__all__ = [
    "Anywhere", "Following", "InFoot", "IndexAtLeast", "Pinned", "ZmpRule", "check_rule", "checked_point",
    "foot_edges", "foot_rows", "index_rows", "is_finite",
]  # fmt: skip

PARALLEL = 1e-12
"""Cosine below which an edge of the support is parallel to a direction."""

ROUNDING_M = 1e-9
REFERENCE_SAMPLES = 201  # times at which a reference is checked


def is_finite(value: Any) -> bool:
    """Return whether a value is a single finite number."""
    return bool(np.isfinite(real(value)))


@dataclass(frozen=True)
class InFoot:
    """The zero moment point stays inside the support polygon by a margin, m, zero or positive."""

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not (is_finite(self.margin) and self.margin >= 0):
            words = f"InFoot: margin must be a finite number of m, not negative, not {self.margin!r}"
            raise ProblemError(words, name="margin", value=self.margin, limit=0.0)

    def check(self, machine: Standing) -> None:
        """Raise ProblemError if no point of the support has the margin."""
        directions, support = machine.moving_directions, machine.support
        half_lengths = np.ptp(support.vertices @ directions.T, axis=0) / 2
        largest = support.inner_radius if len(directions) == 2 else float(half_lengths.min(initial=np.inf))
        if self.margin >= largest * (1 - 1e-9):
            words = f"InFoot: margin {self.margin!r} m is too large for the support, which allows {largest:g} m at most"
            raise ProblemError(words, name="margin", value=self.margin, limit=largest)


@dataclass(frozen=True)
class IndexAtLeast:
    """The stability index, (5)-(6), stays at or above a value below 1 in x and y, and the point inside the support."""

    value: float

    def __post_init__(self) -> None:
        if not (is_finite(self.value) and self.value < 1):
            words = f"IndexAtLeast: value must be below 1, not {self.value!r}; for 1 use Pinned()"
            raise ProblemError(words, name="value", value=self.value, limit=1.0)

    def region(self, machine: Standing) -> tuple[Array, Array]:
        """Return the least and greatest (x, y) with that index. Shape (2,) each, m."""
        radius = machine.half_widths * np.sqrt(1 - self.value)
        return machine.most_stable_point - radius, machine.most_stable_point + radius


@dataclass(frozen=True)
class Pinned:
    """The zero moment point stays at (x, y), m; at the machine's most stable point if None.

    This holds in the directions in which motion moves the point, see Standing.moving_directions; in the others it stays
    inside the support.
    """

    point: Any = None

    def place(self, machine: Standing, time: Any) -> Any:
        """Return the point. Shape (2, 1), m."""
        point = machine.most_stable_point if self.point is None else self.point
        return checked_point(point, "Pinned: point")


@dataclass(frozen=True)
class Following:
    """The zero moment point follows a reference: a function of CasADi time (s) that returns (x, y), m.

    This holds in the directions in which motion moves the point, as for Pinned.
    """

    reference: Callable[[Any], Any]

    def place(self, machine: Standing, time: Any) -> Any:
        """Return the point at a time. Shape (2, 1), m."""
        if not callable(self.reference):
            words = f"Following: a function of time is expected, not {self.reference!r}"
            raise ProblemError(words, name="Following", value=self.reference)
        return checked_point(self.reference(time), "Following: the reference")


def checked_point(value: Any, name: str) -> Any:
    """Return (x, y), m, as a CasADi column; ProblemError unless it is two numbers or expressions."""
    try:
        point = expression(value)
    except NOT_NUMBERS:
        point = ca.DM()
    numeric = isinstance(point, ca.DM)
    if point.numel() != 2 or 1 not in point.shape or (numeric and not np.isfinite(np.array(point)).all()):
        shown = value if numeric else str(value)  # expressions cannot be pickled
        words = f"{name} must be two numbers (x, y), not {value!r}"
        raise ProblemError(words, name=name.rpartition(" ")[2], value=shown)
    return ca.vec(point)


@dataclass(frozen=True)
class Anywhere:
    """The zero moment point is not checked: the machine may tip over."""


ZmpRule: TypeAlias = InFoot | IndexAtLeast | Pinned | Following | Anywhere


def foot_edges(machine: Standing, zmp: ZmpRule) -> tuple[Array, Array]:
    """Return the edges of the support, moved inwards by a margin, that a rule does not imply by itself.

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


def foot_rows(machine: Standing, zmp: ZmpRule, point: Any, external: bool) -> Any:
    """Return the distances of the zero moment point inside those `foot_edges` that a motion can reach. Shape (k, 1), m.

    Args:
        machine, zmp: The machine and its rule.
        point: The zero moment point of the motion. Shape (2, 1).
        external: Whether there are external wrenches, which may move the point in any direction.

    Raises:
        ProblemError: The point is beyond an edge in every motion.
    """
    normals, offsets = foot_edges(machine, zmp)
    movable = np.abs(normals @ machine.moving_directions.T).max(axis=1, initial=0.0) > PARALLEL
    rows = ca.mtimes(ca.sparsify(ca.DM(normals)), point) - ca.DM(offsets)
    free = [i for i in range(len(offsets)) if (external or movable[i]) and ca.symvar(rows[i])]
    reachable = machine.nearest_reachable(machine.most_stable_point)
    for i in set(range(len(offsets))) - set(free):
        inside = float(ca.evalf(rows[i])) if external else float(normals[i] @ reachable - offsets[i])
        if inside < -ROUNDING_M:
            words = (
                f"the zero moment point is {-inside:.4g} m beyond an edge of the support, less its margin, in every "
                "motion of the joints: move the foot below the machine"
            )
            raise ProblemError(words, name="zero moment point", value=-inside, limit=0.0)
    return rows[free]


def index_rows(machine: Standing, zmp: IndexAtLeast, point: Any, external: bool) -> list[int]:
    """Return the coordinates of the zero moment point that a motion can move out of the region of the index.

    Args:
        machine, zmp, point, external: As for foot_rows.

    Raises:
        ProblemError: A coordinate that no motion moves is outside the region.
    """
    rows = [i for i in (0, 1) if (external or i in machine.moving_axes) and ca.symvar(point[i])]
    low, high = zmp.region(machine)
    reachable = machine.nearest_reachable(machine.most_stable_point)
    for i in {0, 1} - set(rows):
        if not low[i] - ROUNDING_M <= reachable[i] <= high[i] + ROUNDING_M:
            words = (
                f"IndexAtLeast({zmp.value:g}): the zero moment point is at {'xy'[i]} = {reachable[i]:.4g} m in every "
                f"motion, outside {low[i]:.4g} .. {high[i]:.4g} m: move the foot below the machine"
            )
            raise ProblemError(words, name="zero moment point", value=reachable[i], limit=(low[i], high[i]))
    return rows


def check_rule(machine: Standing, zmp: ZmpRule, horizon: float) -> None:
    """Raise ProblemError if a rule has the wrong type, leaves the support, or cannot be met in it."""
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
            words = f"{name}: the zero moment point {place.tolist()} at {time:.4g} s is not finite"
            raise ProblemError(words, name=name, value=place, time=float(time))
        inside = float(machine.support.margin(machine.nearest_reachable(place)))
        if inside < -ROUNDING_M:
            words = (
                f"{name}: {place.tolist()} m at {time:.4g} s is {-inside:.4g} m outside the support, where the machine "
                "tips over; stay inside, or give another support"
            )
            raise ProblemError(words, name=name, value=place, limit=machine.support.vertices, time=float(time))
