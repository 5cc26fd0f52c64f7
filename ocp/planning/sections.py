"""Ways where two directions are free, beside postures in which one joint has one of some values.

The postures at an instant form surfaces, which are too many charts for an arm of eight joints. Where one joint is held
they are curves. Such curves at several values of it lie close enough together for steps to lead from one to another, so
that ways on which the joint moves are found as well; drawn tight through the surfaces they leave the curves. Nothing is
proven by this, and no bound comes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.arrays import Array
from ocp.planning.charts import Charts, Parts, SelfMotions
from ocp.planning.held import Held
from ocp.planning.joint_space import TURN
from ocp.planning.search import Search

__all__ = ["SectionSettings", "Sections", "values_of"]


@dataclass(frozen=True)
class SectionSettings:
    """Which curves are covered.

    Attributes:
        radii: Of the charts at few instants, and at many, rad or m.
        apart: From one value of the joint to the next, at most: of one that slides, m, and of one that turns, rad.
        values: Of the joint, at most.
        charts: Of all instants and values together, of which no steps are kept.
    """

    radii: tuple[float, float] = (0.07, 0.14)
    apart: tuple[float, float] = (0.1, 0.6)
    values: int = 64
    charts: int = 80_000


def values_of(
    slides: bool, lower: float, upper: float, far: float, settings: SectionSettings = SectionSettings()
) -> Array:
    """At which a joint is held: its limits and between, or all round. Shape (V,), rad or m.

    Args:
        slides: Whether it does. far: How far it may go from one instant to the next: values are no farther apart.
    """
    low, high = np.clip((lower, upper), -np.pi, np.pi).tolist()
    count = int(np.ceil(min((high - low) / min(settings.apart[not slides], far), settings.values - 1.0)))
    if not slides and high - low >= TURN - 1e-6:
        return np.linspace(low, high, max(count, 1), endpoint=False)
    return np.linspace(low, high, count + 1)


class Sections(Search):
    """The search for ways beside postures in which one joint has one of some values."""

    def __init__(self, *told: Any, joint: int, values: Array, radius: float, charts: int, **more: Any) -> None:
        """
        Args:
            told, more: As of `Search`; the instants all of one set of postures with two directions free.
            joint: The number of the joint. values: At which it is held. Shape (V,).
            radius: Of the charts, at most. charts: Their number, at most.
        """
        self._joint, self._values, self._radius, self._most = joint, values, radius, charts
        super().__init__(*told, **more)

    def _cover(self, seeds: Callable[[int], Array]) -> list[Charts]:
        """Charts of the curves of each instant, none where no seed leads to one; numbered by values, then instants."""
        whole, count = self.instants[0].sets, len(self.instants)
        numbers, each = [instant.number for instant in self.instants], len(self._values)
        targets = np.tile(whole.targets[numbers], (each, 1))
        others = whole.equations.held if isinstance(whole.equations, Held) else ()
        held = Held(whole.equations.machine, whole.equations.bound, (*others, self._joint))
        self._curves = SelfMotions(self.space, held, np.column_stack([targets, np.repeat(self._values, count)]))
        found = [seeds(k) for k in range(count)]
        own = np.repeat(np.arange(count), [len(some) for some in found])
        layer = (own + count * np.arange(each)[:, None]).ravel()
        joints, good = self._curves.corrected(layer, np.tile(np.concatenate(found), (each, 1)))
        good &= self.space.within(joints)
        charts = self._curves.cover(layer[good], joints[good], self._radius, self._most)
        return [charts.of(charts.layer % count == k) for k in range(count)]

    def _parts(self, charts: Charts, k: int) -> Parts:
        return self._curves.parts(charts)

    def ways(self) -> tuple[list[Array], float]:
        """Of the cheapest way that is found, and of the cheapest on which the joint keeps each of its values."""
        count = len(self.instants)
        found = [path for path in (self.first(np.inf)[1],) if path is not None]
        for value in range(len(self._values)):
            own = copy(self)
            own.layers = [charts.of(charts.layer // count == value) for charts in self.layers]
            if all(len(charts) for charts in own.layers):
                path = own._tight(own._through_centers(own.whole_graph()), own.layers)
                found += [path] if path is not None else []
        return sorted(found, key=self.steps), 0.0
