"""Methods on a mesh of intervals, and the refinement of such a mesh."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np

from models.checks import NOT_NUMBERS, floats
from models.files import INPUT_LIMITS
from ocp.direct.assembly import Transcription
from ocp.errors import ProblemError, error_names, require
from ocp.problem.formulation import Formulation
from ocp.problem.values import numeric
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["MeshedMethod", "check_meshed"]


class MeshedMethod(ABC):
    """A method that turns a problem into a nonlinear program on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        control: Shape of the controls inside an interval.
        mesh: Ends of the intervals as fractions 0..1, N + 1 of them; None for equal intervals.
    """

    intervals: int
    control: str
    mesh: tuple[float, ...] | None

    @property
    @abstractmethod
    def order(self) -> int:
        """Order of the integration error of one interval in its width."""

    @property
    @abstractmethod
    def control_order(self) -> int:
        """Order of the interpolation error of a smooth control in the width."""

    @abstractmethod
    def transcribe(self, form: Formulation, *, staged: bool = False) -> Transcription:
        """Return the nonlinear program of a problem; ``staged`` orders it for a structure-exploiting solver."""

    @property
    def settings(self) -> dict[str, Any]:
        """The method as stored in a solution: its type, and its attributes other than None."""
        values = {k: v for k, v in dataclasses.asdict(self).items() if v is not None}  # type: ignore[call-overload]
        return {"type": type(self).__name__, **values}

    @property
    def fractions(self) -> np.ndarray:
        """Ends of the intervals as fractions of the horizon. Shape (N + 1,)."""
        return np.linspace(0.0, 1.0, self.intervals + 1) if self.mesh is None else np.asarray(self.mesh, dtype=float)

    def with_mesh(self, mesh: np.ndarray) -> Self:
        """Return the method on another mesh (N + 1,)."""
        return dataclasses.replace(self, intervals=len(mesh) - 1, mesh=tuple(mesh.tolist()))  # type: ignore[type-var]

    def halved(self) -> Self:
        """Return the method with every interval halved."""
        if self.mesh is None:
            return dataclasses.replace(self, intervals=2 * self.intervals)  # type: ignore[type-var]
        nodes = self.fractions
        return self.with_mesh(np.union1d(nodes, (nodes[1:] + nodes[:-1]) / 2))

    def with_nodes_at(self, fractions: Any) -> Self:
        """Return the method with additional nodes at fractions 0..1 of the horizon, where the problem has jumps or
        kinks.

        A given mesh keeps its nodes. Without one the intervals between the fractions are equal and no wider than
        before.

        Raises:
            ProblemError: The fractions are not numbers from 0 to 1.
        """
        details: dict[str, Any] = {"name": "fractions", "value": fractions}
        with error_names("fractions"):
            added = numeric("with_nodes_at: fractions", fractions)
        if not np.all((added >= 0.0) & (added <= 1.0)):
            raise ProblemError(f"with_nodes_at: fractions must be numbers from 0 to 1, not {fractions!r}", **details)
        if not added.size:
            return self
        nodes = np.array([0.0, 1.0]) if self.mesh is None else self.fractions
        is_node = np.abs(added[:, None] - nodes).min(axis=1) < ROUNDING_SHARE
        added = np.unique(added[~is_node])
        nodes = np.union1d(nodes, added[np.diff(added, prepend=-1.0) >= ROUNDING_SHARE])
        if self.mesh is None:
            counts = np.maximum(np.ceil(np.diff(nodes) * self.intervals - ROUNDING_SHARE), 1).astype(int)
            segments = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], counts, strict=True)]
            nodes = np.concatenate([*segments, [1.0]])
        return self.with_mesh(nodes)

    def _check_mesh(self, count: str, largest: int = INPUT_LIMITS.count) -> None:
        """Check the mesh and the whole number named ``count``, and convert them to plain Python for storage.

        Raises:
            ProblemError: A number is no positive integer, or the mesh does not increase from 0 to 1 in so many
                intervals.
        """
        name_of_method = type(self).__name__
        for name, most in (("intervals", INPUT_LIMITS.count), (count, largest)):
            object.__setattr__(self, name, require.count(f"{name_of_method}: {name}", getattr(self, name), most=most))
        if self.mesh is None:
            return
        details: dict[str, Any] = {"name": "mesh", "value": self.mesh}
        try:
            mesh = floats(self.mesh)
        except NOT_NUMBERS as error:
            text = f"{name_of_method}: mesh must be fractions from 0 to 1, not {self.mesh!r}"
            raise ProblemError(text, **details) from error
        if mesh.shape != (self.intervals + 1,):
            text = f"{name_of_method}: mesh has {mesh.size} entries, {self.intervals + 1} expected (fractions 0 to 1)"
            raise ProblemError(text, **details)
        if not (mesh[0] == 0.0 and mesh[-1] == 1.0 and np.all(np.diff(mesh) > 0)):
            raise ProblemError(f"{name_of_method}: mesh must increase from 0 to 1, not {mesh.tolist()}", **details)
        object.__setattr__(self, "mesh", tuple(mesh.tolist()))


def check_meshed(caller: str, method: Any, tolerance: Any) -> None:
    """Raise ProblemError unless a method has a mesh of intervals, and the tolerance is positive and finite."""
    if not isinstance(method, MeshedMethod):
        words = f"{caller}: Collocation(...) or MultipleShooting(...) is expected, not {method!r}"
        raise ProblemError(words, name="method", value=method)
    require.positive(f"{caller}: tolerance", tolerance)
