"""Plan whose motion solves one optimal control problem of several phases, each with its own machine."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.checks import Array
from ocp.motion.result.request import machines_of_phases
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.tasks.targets import tip_poses
from ocp.solution import Solution

__all__ = ["PHASED", "PhasedPlan", "parts_of_phases"]

PHASED = "plan.phased"
"""Name of an array in the files of these plans."""
RATES = "velocities"


@dataclass(frozen=True, eq=False, repr=False)
class PhasedPlan(SolvedPlan):
    """Plan of several phases, one after the other, such as motions to several goals with different loads.

    The suffix of a part is the name of its phase; `plan.solution.phase(name)` is the phase over its own time.

    Attributes:
        machine: Machine of the first phase. All phases have its joints.
        solution, parts, candidates, bound, targets: As in `SolvedPlan`.
    """

    @property
    def phases(self) -> tuple[str, ...]:
        """Names of the phases."""
        return tuple(part.suffix for part in self.parts)

    @cached_property
    def machines(self) -> tuple[Machine, ...]:
        """Machine of each phase; the first one for all, if the problem was declared by the user."""
        machines = machines_of_phases(self.request)
        return machines if len(machines) == len(self.parts) else (self.machine,) * len(self.parts)

    @cached_property
    def _solutions(self) -> dict[str, Solution]:
        return {name: self.solution.phase(name) for name in self.phases}

    @cached_property
    def _orders(self) -> dict[str, NDArray[np.intp]]:
        """Places of the joints of the first machine among those of each phase, by phase. Shape (n,)."""
        orders = {}
        for name, machine in zip(self.phases, self.machines, strict=True):
            joints = list(machine.robot.joint_names)
            orders[name] = np.array([joints.index(joint) for joint in self.names], dtype=np.intp)
        return orders

    @property
    def t(self) -> Array:
        """Times of the grids of all phases, with both copies of the times between them. Shape (M,), s."""
        return np.concatenate([part.begin + self._solutions[part.suffix].t for part in self.parts])

    def _values(self, name: str) -> Array:
        own = RATES if name == "rates" else name
        return np.concatenate([self._in_order(part, name, self._solutions[part.suffix][own]) for part in self.parts])

    def _values_at(self, name: str, times: Array) -> Array:
        own = RATES if name == "rates" else name
        return self._over(
            times,
            lambda part, fraction: self._in_order(part, name, self._solutions[part.suffix].at_fraction(fraction)[own]),
        )

    def _in_order(self, part: Part, name: str, values: Array) -> Array:
        """Return values of joints in the order of the first machine."""
        return values if name == "base" else values[:, self._orders[part.suffix]]

    def _tips_at(self, times: Array, bases: Array, joints: Array) -> Array:
        poses = np.full((len(times), 7), np.nan)
        begins = [part.begin for part in self.parts]
        which = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, len(begins) - 1)
        for number in np.unique(which):
            machine, rows = self.machines[number], which == number
            order = np.argsort(self._orders[self.phases[number]])
            poses[rows] = tip_poses(machine, bases[rows], joints[rows][:, order])
        return poses

    def arrays(self, path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
        """Return the arrays of the file of the plan."""
        return {**super().arrays(path), PHASED: np.ones(1)}

    def solved_parts(self, times: Array) -> list[tuple[Solution, str, Array]]:
        """Return nothing: the phases of one problem are not evaluated one by one."""
        return []

    def _check_parts(self) -> None:
        times = self.solution.phases
        if tuple(times) != self.phases:
            raise ValueError(f"its parts {self.phases} are not the phases {tuple(times)} of its solution")
        if not all(np.allclose(times[part.suffix], part[:2], rtol=1e-9, atol=1e-12) for part in self.parts):
            raise ValueError(f"its parts {self.parts} do not fill the time of its solution one after the other")
        for name, machine in zip(self.phases, self.machines, strict=True):
            states = self._solutions[name].states
            sizes = [values.shape[1] for values in (states.get(each, np.zeros((0, 0))) for each in ("joints", RATES))]
            if set(machine.robot.joint_names) != set(self.names) or sizes != [machine.joint_size] * 2:
                raise ValueError(f"the solution has no joints and velocities of its machine in phase {name!r}")


def parts_of_phases(solution: Solution) -> tuple[Part, ...]:
    """Return the parts of a plan of several phases."""
    return tuple(Part(begin, end, name) for name, (begin, end) in solution.phases.items())
