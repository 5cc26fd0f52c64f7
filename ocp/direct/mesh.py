"""Methods on a mesh of intervals, and how such a mesh is refined."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np

from ocp.direct.assembly import Fragment
from ocp.errors import NOT_NUMBERS, ProblemError, checked_count, checked_positive, error_names, floats
from ocp.problem.formulation import Formulation
from ocp.problem.values import numeric
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["MeshedMethod", "check_meshed"]


class MeshedMethod(ABC):
    """A method that turns a problem into a nonlinear program on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        control: How the controls move inside an interval.
        mesh: Fractions 0..1 where intervals begin and end, N + 1 of them; None for equal intervals.
    """

    intervals: int
    control: str
    mesh: tuple[float, ...] | None

    @property
    @abstractmethod
    def order(self) -> int:
        """Power of the width with which the integration error of one interval falls."""

    @property
    @abstractmethod
    def control_order(self) -> int:
        """Power of the width with which a smooth control is missed between its points."""

    @abstractmethod
    def transcribe(self, form: Formulation, *, staged: bool = False) -> Fragment:
        """The nonlinear program of a problem. ``staged`` lays it out for a structure-exploiting solver."""

    @property
    def settings(self) -> dict[str, Any]:
        """The method as a solution tells it: its type, and its attributes but those that are None."""
        own = {k: v for k, v in dataclasses.asdict(self).items() if v is not None}  # type: ignore[call-overload]
        return {"type": type(self).__name__, **own}

    @property
    def fractions(self) -> np.ndarray:
        """Where intervals begin and end, as fractions of the horizon. Shape (N + 1,)."""
        return np.linspace(0.0, 1.0, self.intervals + 1) if self.mesh is None else np.asarray(self.mesh, dtype=float)

    def with_mesh(self, mesh: np.ndarray) -> Self:
        """The same method on another mesh (N + 1,)."""
        return dataclasses.replace(self, intervals=len(mesh) - 1, mesh=tuple(mesh.tolist()))  # type: ignore[type-var]

    def halved(self) -> Self:
        """The same method with every interval cut in two."""
        if self.mesh is None:
            return dataclasses.replace(self, intervals=2 * self.intervals)  # type: ignore[type-var]
        nodes = self.fractions
        return self.with_mesh(np.union1d(nodes, (nodes[1:] + nodes[:-1]) / 2))

    def with_nodes_at(self, fractions: Any) -> Self:
        """The same method with nodes at some fractions 0..1 of the horizon too, where something jumps or bends.

        A mesh that was given keeps its nodes. Without one the intervals between the fractions are equal, as many as
        make none wider than it was.

        Raises:
            ProblemError: Fractions that are no numbers from 0 to 1.
        """
        told: dict[str, Any] = {"name": "fractions", "value": fractions}
        with error_names("fractions"):
            asked = numeric("with_nodes_at: fractions", fractions)
        if not np.all((asked >= 0.0) & (asked <= 1.0)):
            raise ProblemError(f"with_nodes_at: fractions must be numbers from 0 to 1, not {fractions!r}", **told)
        if not asked.size:
            return self
        nodes = np.array([0.0, 1.0]) if self.mesh is None else self.fractions
        own = np.abs(asked[:, None] - nodes).min(axis=1) < ROUNDING_SHARE
        asked = np.unique(asked[~own])
        nodes = np.union1d(nodes, asked[np.diff(asked, prepend=-1.0) >= ROUNDING_SHARE])
        if self.mesh is None:
            counts = np.maximum(np.ceil(np.diff(nodes) * self.intervals - ROUNDING_SHARE), 1).astype(int)
            pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], counts, strict=True)]
            nodes = np.concatenate([*pieces, [1.0]])
        return self.with_mesh(nodes)

    def _settle(self, count: str, most: int | None = None) -> None:
        """Check the mesh and the whole number by the name ``count``; turn them into plain Python, as is saved.

        Raises:
            ProblemError: No positive integers, or a mesh that does not increase from 0 to 1 in so many intervals.
        """
        kind = type(self).__name__
        for name, limit in (("intervals", None), (count, most)):
            object.__setattr__(self, name, checked_count(f"{kind}: {name}", getattr(self, name), most=limit))
        if self.mesh is None:
            return
        told: dict[str, Any] = {"name": "mesh", "value": self.mesh}
        try:
            at = floats(self.mesh)
        except NOT_NUMBERS as error:
            words = f"{kind}: mesh must be fractions from 0 to 1, not {self.mesh!r}"
            raise ProblemError(words, **told) from error
        if at.shape != (self.intervals + 1,):
            words = f"{kind}: mesh has {at.size} entries, {self.intervals + 1} expected (fractions 0 to 1)"
            raise ProblemError(words, **told)
        if not (at[0] == 0.0 and at[-1] == 1.0 and np.all(np.diff(at) > 0)):
            raise ProblemError(f"{kind}: mesh must increase from 0 to 1, not {at.tolist()}", **told)
        object.__setattr__(self, "mesh", tuple(at.tolist()))


def check_meshed(caller: str, method: Any, tolerance: Any) -> None:
    """Raise ProblemError unless a method has a mesh of intervals, and a tolerance is positive and finite."""
    if not isinstance(method, MeshedMethod):
        words = f"{caller}: Collocation(...) or MultipleShooting(...) is expected, not {method!r}"
        raise ProblemError(words, name="method", value=method)
    checked_positive(f"{caller}: tolerance", tolerance)
