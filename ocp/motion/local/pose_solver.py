"""Solvers of the inverse kinematics of six joints of a chain; the positions of further joints are given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.checks import Array
from ocp.motion.local.chain import Axis, Chain, Motion, Solutions

__all__ = ["Mask", "PoseSolver"]

Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class NearbySettings:
    """Settings of the poses near doubtful ones.

    Attributes:
        pairs: Number of pairs of poses.
        distance: Their typical distance, rad and share of the size of the arm.
        seed: Seed of their directions.
    """

    pairs: int = 2
    distance: float = 1e-3
    seed: int = 0


NEARBY = NearbySettings()


@dataclass(frozen=True, eq=False)
class PoseSolver(ABC):
    """Inverse kinematics of a chain in which all joints but a few are redundant.

    Attributes:
        chain: The chain.
        redundant: Numbers of the joints whose positions are given.
    """

    chain: Chain
    redundant: tuple[int, ...]

    @cached_property
    def free(self) -> list[int]:
        """Numbers of the other joints, in the order of the chain."""
        return [j for j in self.chain.order if j not in self.redundant]

    @abstractmethod
    def solve_regular(self, tips: Motion, redundant: Array) -> tuple[Solutions, Mask, Mask]:
        """Return solutions at M poses, all at regular ones.

        Args:
            tips: Poses of the tip in the world.
            redundant: Positions of the redundant joints. Shape (M, len(self.redundant)).

        Returns:
            The solutions; for which poses it is to be confirmed that they are all; and for which some may be missing.
            Shapes (M,), bool.
        """

    def solve(self, positions: Array, rotations: Array, redundant: Array) -> tuple[Solutions, Mask]:
        """Return all isolated solutions at M poses, and for which poses solutions may be missing. Shape (M,).

        Where they may be, and at singularities, solutions at poses nearby are candidates too: isolated solutions depend
        continuously on the pose, and of a family some members are found.

        Args:
            positions, rotations: Poses of the tip in the world. Shapes (M, 3), (M, 3, 3).
            redundant: Positions of the redundant joints. Shape (M, len(self.redundant)).
        """
        tips, count = Motion(rotations, positions), len(positions)
        solutions, unconfirmed, doubtful = self.solve_regular(tips, redundant)
        again = unconfirmed | doubtful
        again[solutions.pose[solutions.singular]] = True
        if again.any():
            chosen, before = np.flatnonzero(again), np.bincount(solutions.pose, minlength=count)
            for nearby in self._nearby(tips.take(chosen)):
                more, _, _ = self.solve_regular(nearby, redundant[chosen])
                refined = self.chain.refine(chosen[more.pose], more.joints, self.free, tips)
                solutions = self.chain.union(solutions, refined, self.free, tips)
            doubtful = doubtful | (unconfirmed & (np.bincount(solutions.pose, minlength=count) > before))
        return solutions, doubtful

    def _nearby(self, tips: Motion) -> Iterator[Motion]:
        """Iterate over poses near others, on opposite sides of them."""
        rng = np.random.default_rng(NEARBY.seed)
        for _ in range(NEARBY.pairs):
            turn, shift = NEARBY.distance * rng.normal(size=(2, 3))
            for sign in (1.0, -1.0):
                rotation = Rotation.from_rotvec(sign * turn).as_matrix()
                yield Motion(tips.turn @ rotation, tips.shift + sign * self.chain.size * shift)

    def solutions(self, positions: Array, rotations: Array, redundant: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the poses (K,) and the joints (K, n) of all isolated solutions; see `solve`."""
        solutions, _ = self.solve(positions, rotations, redundant)
        return solutions.pose, solutions.joints

    def prescribe(self, redundant: Array) -> Array:
        """Return joints with the redundant ones (M, k) at these positions and the others at 0. Shape (M, n)."""
        joints = np.zeros((len(redundant), len(self.chain.axes)))
        joints[:, list(self.redundant)] = redundant
        return joints

    def refine(self, pose: NDArray[np.intp], free: Array, prescribed: Array, goal: Motion) -> Solutions:
        """Return the solutions that Newton's method finds from candidates for the free joints (K, m) at poses (K,)."""
        joints = prescribed[pose]
        joints[:, self.free] = free
        return self.chain.refine(pose, joints, self.free, goal)

    def loop(self, prescribed: Array, goal: Motion) -> tuple[list[Axis], Motion]:
        """Return the axes of the free joints, and the motion that they must make with the others as prescribed."""
        chain = self.chain
        if not self.redundant:
            return list(chain.constant_axes), goal.after(chain.home_motion.inverse)
        fixed, axes = Motion(np.eye(3)[None], np.zeros((1, 3))), list[Axis]()
        for j, constant in zip(chain.order, chain.constant_axes, strict=True):
            axis = constant.moved(fixed)
            if j in self.redundant:
                fixed = axis.by(prescribed[:, j]).after(fixed)
            else:
                axes.append(axis)
        return axes, goal.after(fixed.after(chain.home_motion).inverse)
